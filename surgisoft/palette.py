"""Colours of measured and predicted values that pages, pictures and replays share, as sRGB."""

BLUE, RED, GREEN, AMBER = "#3b82c4", "#d1495b", "#3c9a6b", "#cf9330"
"""Colours with contrast on light and on dark backgrounds."""
MODELS = (RED, BLUE, AMBER, GREEN, "#8a6fc7", "#48a9a6")
"""Colours of the models of a comparison in their order: the first, or the one before a change, is
red, the one after it blue."""
MEASURED_ON_LIGHT, MEASURED_ON_DARK = "#222222", "#e8e8e8"
"""Colour of what was measured."""


def model_colour(number: int) -> str:
    """Colour of a model by its place in a comparison, cyclic."""
    return MODELS[number % len(MODELS)]


def rgb(colour: str) -> tuple[int, int, int]:
    """A colour such as `#d1495b` as three numbers, 0..255."""
    red, green, blue = bytes.fromhex(colour.removeprefix("#"))
    return red, green, blue
