"""From where pictures show an arm: with the side up that is up on the bench."""

from collections.abc import Sequence

import numpy as np

STEEP = 0.7
"""Share of the weight along the arm from which the arm is drawn upright or hanging, not lying."""
ELEVATION_DEG, AZIMUTH_DEG = 30.0, -60.0
"""Angles of matplotlib's eye above the horizontal and about the vertical, degrees: its own."""


def upright(
    gravity: Sequence[float] | np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(3,) unit vectors of a view in the arm's base frame: to the right, away from the eye, up.

    Up is against the weight, so that a hanging arm hangs; an arm along z that is held across the
    weight lies to the right. gravity: direction of the weight; None: -z.
    """
    down = np.array([0.0, 0.0, -1.0]) if gravity is None else np.asarray(gravity, np.float64)
    up = -down / np.linalg.norm(down)
    side = np.array([1.0, 0.0, 0.0]) if abs(up[2]) > STEEP else np.array([0.0, 0.0, 1.0])
    side = side - (side @ up) * up
    side /= np.linalg.norm(side)
    return side, np.cross(up, side), up


def upright_axes(gravity: Sequence[float] | np.ndarray | None) -> dict[str, str | float]:
    """The same for axes in space of matplotlib: arguments of `view_init`.

    The axis of the base frame that is nearest to the vertical is drawn vertical; where it points
    down, the view is turned by half a turn, so that the picture is no mirror image.
    """
    up = upright(gravity)[2]
    nearest = int(np.abs(up).argmax())
    turned = bool(up[nearest] < 0.0)
    return {
        "elev": -ELEVATION_DEG if turned else ELEVATION_DEG,
        "azim": AZIMUTH_DEG,
        "roll": 180.0 if turned else 0.0,
        "vertical_axis": "xyz"[nearest],
    }
