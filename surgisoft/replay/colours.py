"""Colours that all 3D views and plots share, as sRGB 0..255."""

import numpy as np

from surgisoft.palette import MEASURED_ON_DARK, RED, rgb

ROLE_COLOURS = {
    "organ": (142, 58, 48),
    "keep-out": (112, 140, 62),
    "support": (128, 136, 146),
}
"""Colour of a body by its role."""
ROLE_NAMES = {"organ": "red-brown", "keep-out": "olive green", "support": "grey"}
"""Name of the colour of each role."""
ARM_COLOURS = {
    "laser": (236, 226, 208),
    "endoscope": (120, 158, 196),
    "tip": (176, 196, 160),
    "arm": (236, 226, 208),
}
"""Colour of a soft body by its arm's tool; `arm` is one without a tool."""
BAND_COLOURS = {
    "laser": (196, 132, 56),
    "endoscope": (48, 92, 150),
    "tip": (84, 120, 64),
    "arm": (196, 132, 56),
}
"""Colour of the bands that mark an arm's key points, by its tool."""
SHAFT_COLOUR = (88, 94, 102)
MEASURED_COLOUR = rgb(MEASURED_ON_DARK)
"""Colour of a measured body beside a predicted one."""
PREDICTED_COLOUR = rgb(RED)
"""Colour of the body that one model predicts."""
LESION_COLOUR = (214, 172, 118)
PLAN_COLOUR = (255, 214, 64)
"""Colour of the reference: ring, path, target."""
REAL_COLOUR = (70, 225, 240)
"""Colour of the actual path."""
BEAM_COLOUR = (80, 255, 120)
"""Colour of the beam: green, as in the endoscope's picture, because red is lost on an organ."""
CONE_COLOUR = (90, 200, 250)
BACKGROUND = (24, 28, 34)
LIMIT_COLOUR = (255, 96, 80)
"""Colour of a limit in a plot."""
SERIES = (
    (86, 180, 233),
    (230, 159, 0),
    (0, 190, 140),
    (240, 228, 66),
    (213, 94, 0),
    (204, 121, 167),
    (150, 150, 250),
    (200, 200, 200),
)
"""Colours of a plot's lines: safe for colour-blind viewers (Okabe & Ito 2008), on black."""

BLANCHED = (204, 186, 172)
"""Colour of tissue at the threshold of ablation."""
CHARRED = (26, 20, 18)
"""Colour of ablated tissue."""


def series_colour(number: int) -> tuple[int, int, int]:
    """The colour of a plot's line by its number, cyclic."""
    return SERIES[number % len(SERIES)]


def paler(colour: tuple[int, int, int], share: float = 0.5) -> tuple[int, int, int]:
    """The colour mixed with the plot's dark background."""
    red, green, blue = (round(share * part + (1.0 - share) * 40) for part in colour)
    return red, green, blue


def tissue_colours(heat: np.ndarray, base: np.ndarray | tuple[int, int, int]) -> np.ndarray:
    """(V, 4) uint8 colours of tissue at `heat` (V,): dose divided by the threshold of ablation.

    `base` (3,) or (V, 3) is the colour without dose. Tissue turns pale up to the threshold and is
    charred beyond it.
    """
    share = np.clip(heat, 0.0, 1.0)[:, None]
    colour = np.array(base) + (np.array(BLANCHED) - np.array(base)) * share
    colour = np.where(heat[:, None] >= 1.0, np.array(CHARRED), colour)
    return np.column_stack((colour, np.full(len(heat), 255))).astype(np.uint8)


ERROR_STOPS = ((72, 60, 140), (48, 104, 150), (40, 160, 130), (140, 205, 70), (253, 231, 37))
"""Colours from no error to the end of the scale, evenly spaced: after viridis (van der Walt &
Smith 2015), apart from the models' red and blue, and safe for colour-blind viewers."""
ERROR_NAMES = ("violet", "yellow")
"""Names of the first and of the last of them."""


def error_colours(error: np.ndarray, largest: float) -> np.ndarray:
    """(..., 3) uint8 from violet by green to yellow for errors (...) from 0 to `largest`."""
    stops = np.array(ERROR_STOPS, float)
    place = np.clip(np.nan_to_num(error) / max(largest, 1e-12), 0.0, 1.0) * (len(stops) - 1)
    low = np.minimum(place.astype(int), len(stops) - 2)
    share = (place - low)[..., None]
    return (stops[low] + (stops[low + 1] - stops[low]) * share + 0.5).astype(np.uint8)
