"""Centrelines that a fitted arm can reach, as plain arrays for geometric planning."""

import warnings

import numpy as np
import torch

from surgisoft.errors import AssumptionWarning, InputError
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.model import ArmModel
from surgisoft.units import MM_PER

COUNTS = {1: 41, 2: 41, 3: 15, 4: 8, 5: 6, 6: 5}
"""Samples of each chamber's range, by the number of chambers: at most 16,000 centrelines."""
LEAST_BODY_MM = 3.0
"""A body below this length, at rest, is in another unit than mm: no arm with a tool is so short."""
SAME_LENGTH = 1.5
"""Ratio up to which the body of a model has the stated or measured length, once a wrong unit is
corrected: an arm that stretches is longer than at rest. Its square is less than the smallest ratio
of two factors that are tried (2.54), so that one factor at most is found."""


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


def require_millimetres(model: ArmModel, label: str) -> None:
    """Raise InputError where the key points of an arm are in another unit of length than mm.

    They are where a unit brings the body's length at rest to the one that the model states, or
    where the body is too short for an arm: then metres or another unit stand for mm in both. The
    length of an arm with one key point counts from the origin; if its tip moves farther than that,
    the origin is not the base and the length is not known.

    label: the arm, for the message.
    """
    spec, points = model.spec, model.rest_mm.double().cpu().numpy()
    if spec.key_points == 1:
        points = np.vstack((np.zeros(3), points))
    body = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())
    if spec.key_points == 1:
        alone = np.where(np.eye(spec.chambers) > 0, spec.high, spec.rest)
        moved = steady_key_points(model, alone)[:, -1] - points[-1]
        if np.linalg.norm(moved, axis=1).max() > body:
            return
    came = f"{label}: returns key points in {{}}: along the body, base to tip, they are {body:.3g}"
    advice = "expected mm: multiply them by {:g}"
    for unit, by in MM_PER.items():
        stated = spec.length_mm
        if by > 1.0 and stated and abs(np.log(by * body / stated)) < np.log(SAME_LENGTH):
            raise InputError(
                f"{came.format(unit)} long, where the arm is {stated:.4g} mm long; "
                f"{advice.format(by)}"
            )
    if body < LEAST_BODY_MM:
        unit = "m" if body < 1.0 else "cm"
        raise InputError(
            f"{came.format(unit)} long, where an arm is {LEAST_BODY_MM:g} mm long or more; "
            f"{advice.format(MM_PER[unit])}, and so its length_mm"
        )
