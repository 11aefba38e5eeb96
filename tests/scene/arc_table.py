"""A table of the shapes of an exact constant-curvature arm, for tests of geometric planning."""

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
