"""Centrelines that a fitted arm can reach, as plain arrays for geometric planning."""

import warnings

import numpy as np
import torch

from surgisoft.errors import AssumptionWarning, InputError
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.model import ArmModel

COUNTS = {1: 41, 2: 41, 3: 15, 4: 8, 5: 6, 6: 5}
"""Samples of each chamber's range, by the number of chambers: at most 16,000 centrelines."""


def model_table(
    model: ArmModel, points: int = 15
) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray]:
    """Centrelines of an arm on a grid over its chambers' ranges, each reached from rest.

    Returns the grid's axes in the arm's unit; centrelines (N, points, 3) in mm and tip directions
    (N, 3), unit, both in the base frame, the last axis running fastest. Raises InputError for an
    arm of more than six chambers, and for one whose body does not follow from its tip. Warns
    (`AssumptionWarning`) where only the tip was measured.
    """
    spec = model.spec
    model.require_body("the arm")
    if spec.key_points == 1:
        warnings.warn(
            "only the tip of an arm was measured; its reach is that of an arc of constant "
            "curvature from the base to the tip, which no data check",
            AssumptionWarning,
            stacklevel=2,
        )
    axes = grid_axes(spec)
    grid = np.stack([a.reshape(-1) for a in np.meshgrid(*axes, indexing="ij")], axis=1)
    backbone = model.backbone(points)
    with torch.no_grad():
        pressure = torch.as_tensor(grid, dtype=torch.float32)
        state = model.initial_state(len(grid), pressure)
        _, key_points = model.step(state, torch.zeros_like(pressure), 1.0)
        lines, directions = backbone.centreline(key_points), backbone.tip_direction(key_points)
    return axes, lines.double().numpy(), directions.double().numpy()


def grid_axes(spec: ArmSpec) -> tuple[np.ndarray, ...]:
    """Values of each chamber, in the arm's unit, of a grid over the chambers' ranges.

    Raises InputError for an arm of more than six chambers.
    """
    if spec.chambers not in COUNTS:
        raise InputError(
            f"an arm of {spec.chambers} chambers needs too large a table; expected at "
            f"most {max(COUNTS)}"
        )
    return tuple(
        np.linspace(low, max(high, low + 1e-6), COUNTS[spec.chambers])
        for low, high in zip(spec.low, spec.high, strict=True)
    )


def steady_key_points(model: ArmModel, actuation: np.ndarray) -> np.ndarray:
    """Steady-state key points (K, n, 3) [mm], base frame, at constant actuation (K, m).

    actuation: in the arm's unit; each is reached from an arm that has stood there without history.
    """
    if np.shape(actuation)[1:] != (model.spec.chambers,):
        raise InputError(
            f"the model has {model.spec.chambers} chambers, got {np.shape(actuation)[-1]}"
        )
    with torch.no_grad():
        pressure = torch.as_tensor(
            np.asarray(actuation), dtype=torch.float32, device=model.rest_mm.device
        )
        state = model.initial_state(len(pressure), pressure)
        _, points = model.step(state, torch.zeros_like(pressure), 1.0)
    return points.double().cpu().numpy()
