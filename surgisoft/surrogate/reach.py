"""The shapes that a constant-curvature arm can take, as plain arrays for geometric planning."""

import numpy as np


def constant_curvature_table(
    length_mm: float,
    largest_bend_rad: float = np.pi / 2,
    largest_extension: float = 0.15,
    counts: tuple[int, int, int] = (41, 41, 4),
    points: int = 15,
) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray]:
    """Sampled arms over a grid of commands (x, y, extension), x and y in -1..1.

    The arc's angle times its direction is the largest bend times a point of the unit disc, onto
    which the square of (x, y) is pressed (Nowell, 2005, "Mapping a square to a circle"), so that
    every command is within the arm's range. Arc: Webster & Jones 2010, eq. 1-3.

    Returns the grid's axes; centrelines (N, points, 3) in mm, base frame, z along the arm at rest,
    last axis running fastest; tip directions (N, 3), unit.
    """
    axes = (
        np.linspace(-1.0, 1.0, counts[0]),
        np.linspace(-1.0, 1.0, counts[1]),
        np.linspace(0.0, largest_extension, counts[2]),
    )
    x, y, extension = (a.reshape(-1) for a in np.meshgrid(*axes, indexing="ij"))
    bend = largest_bend_rad * np.stack(
        (x * np.sqrt(1.0 - 0.5 * y**2), y * np.sqrt(1.0 - 0.5 * x**2)), axis=1
    )
    share = np.linspace(0.0, 1.0, points)
    bends = bend[:, None, :] * share[:, None]
    lengths = length_mm * (1.0 + extension)[:, None] * share
    return axes, arc_ends(bends, lengths), arc_directions(bend)


def arc_ends(bend: np.ndarray, length_mm: np.ndarray) -> np.ndarray:
    """End (..., 3) in mm of an arc from the origin along z; bend (..., 2) rad, length (...) mm.

    x, y = L (1 - cos a) / a^2 bend, z = L sin(a) / a (Webster & Jones 2010, eq. 2).
    """
    angle = np.linalg.norm(bend, axis=-1)
    across = 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * length_mm
    along = np.sinc(angle / np.pi) * length_mm
    return np.concatenate((across[..., None] * bend, along[..., None]), axis=-1)


def arc_directions(bend: np.ndarray) -> np.ndarray:
    """Unit tangent (..., 3) at the end of an arc of bend (..., 2) rad that starts along z."""
    angle = np.linalg.norm(bend, axis=-1, keepdims=True)
    return np.concatenate((np.sinc(angle / np.pi) * bend, np.cos(angle)), axis=-1)


COUNTS = {1: 41, 2: 41, 3: 15, 4: 8, 5: 6, 6: 5}
"""Samples of each chamber's range, by the number of chambers: at most 16,000 shapes."""


def model_table(model, points: int = 15) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray]:
    """The same for a fitted model: a grid over its chambers' ranges, each shape reached from rest.

    Axes in the arm's own unit, centrelines (N, points, 3) mm and tip directions (N, 3), base frame.
    """
    import torch

    from surgisoft.errors import InputError

    spec = model.spec
    if spec.chambers not in COUNTS:
        raise InputError(
            f"an arm of {spec.chambers} chambers has too many shapes for a table; expected at "
            f"most {max(COUNTS)}"
        )
    count = COUNTS[spec.chambers]
    axes = tuple(
        np.linspace(low, max(high, low + 1e-6), count)
        for low, high in zip(spec.low, spec.high, strict=True)
    )
    grid = np.stack([a.reshape(-1) for a in np.meshgrid(*axes, indexing="ij")], axis=1)
    backbone = model.backbone(points)
    with torch.no_grad():
        pressure = torch.as_tensor(grid, dtype=torch.float32)
        state = model.initial_state(len(grid), pressure)
        _, key_points = model.step(state, torch.zeros_like(pressure), 1.0)
        lines, directions = backbone.centreline(key_points), backbone.tip_direction(key_points)
    return axes, lines.double().numpy(), directions.double().numpy()
