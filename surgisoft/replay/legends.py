"""Legends of the views in space as pictures: bodies by their colours, and colour scales."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np

from surgisoft.error_scale import Scale
from surgisoft.palette import MEASURED_ON_DARK, model_colour
from surgisoft.replay.colours import BACKGROUND, ERROR_STOPS, tissue_colours

LEGEND_INCHES, DPI = (4.0, 2.3), 240
"""Size of a legend's picture, inches, and its resolution, pixels an inch."""
INK = MEASURED_ON_DARK
"""Colour of text."""


def legend_picture(names: Sequence[str], scale: Scale) -> bytes:
    """The legend as a PNG: bodies by their colours, arrows, and the colour scale of the error."""
    figure = _blank(LEGEND_INCHES)
    axis = figure.add_axes((0.04, 0.34, 0.94, 0.64))
    axis.set_axis_off()
    rows = [("measured body", MEASURED_ON_DARK)]
    rows += [
        (f"predicted by {name}" if len(names) > 1 else "predicted body", model_colour(i))
        for i, name in enumerate(names)
    ]
    height = min(1.0 / (len(rows) + 1), 0.25)
    for place, (text, colour) in enumerate(rows):
        y = 1.0 - height * (place + 0.5)
        style = {"lw": 4, "solid_capstyle": "round"}
        if place:  # dashed as in the view in space
            style = {"lw": 6, "ls": (0.0, (0.7, 0.7)), "dash_capstyle": "butt"}
        axis.plot((0.0, 0.10), (y, y), color=colour, **style)
        axis.text(0.14, y, text, color=INK, va="center", fontsize=10)
    y = 1.0 - height * (len(rows) + 0.5)
    arrow = {"arrowstyle": "-|>", "color": _unit(ERROR_STOPS[2]), "lw": 2.5}
    axis.annotate("", xy=(0.11, y), xytext=(-0.01, y), arrowprops=arrow)
    text = f"error, drawn {scale.stretch:g} times as long"
    axis.text(0.14, y, text, color=INK, va="center", fontsize=10)
    axis.set_xlim(0.0, 1.0)
    axis.set_ylim(0.0, 1.0)
    ramp = [_unit(stop) for stop in ERROR_STOPS]
    _scale_bar(figure, ramp, scale.large_mm, "error of a key point [mm]")
    return _png(figure)


def dose_picture(threshold_j_per_mm2: float, cut_j_per_mm2: float, organ) -> bytes:
    """The colours of an organ's tissue over its dose as a PNG, with both thresholds.

    organ: (3,) colour without dose, 0..255.
    """
    most = 1.25 * max(threshold_j_per_mm2, cut_j_per_mm2)
    dose = np.linspace(0.0, most, 256)
    colours = tissue_colours(dose / threshold_j_per_mm2, organ)[:, :3] / 255.0
    figure = _blank((3.0, 1.5))
    axis = _scale_bar(figure, [tuple(c) for c in colours], most, "dose [J/mm²]", (0.42, 0.22))
    marks: dict[float, str] = {}
    for value, text in ((threshold_j_per_mm2, "ablated"), (cut_j_per_mm2, "cut")):
        marks[value] = f"{marks[value]}, {text}" if value in marks else text
    for row, (value, text) in enumerate(marks.items()):  # one above the other: both are long
        side = "left" if value < 0.5 * most else "right"
        axis.axvline(value, color=INK, lw=1.5)
        axis.text(
            value, 1.15 + 0.5 * row, f"{text} from {value:.2g}", color=INK, fontsize=9, ha=side
        )
    return _png(figure)


def _blank(inches: tuple[float, float]):
    """A figure on the background of the views in space."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=inches, dpi=DPI, facecolor=_unit(BACKGROUND))
    FigureCanvasAgg(figure)
    return figure


def _scale_bar(figure, colours, most: float, label: str, place=(0.20, 0.09)):
    """A bar of colours from 0 to a value; place: its lower edge and height in the figure."""
    from matplotlib.colors import LinearSegmentedColormap

    bar = figure.add_axes((0.06, place[0], 0.86, place[1]))
    ramp = LinearSegmentedColormap.from_list("scale", colours)
    extent = (0.0, most, 0.0, 1.0)
    bar.imshow(np.linspace(0.0, 1.0, 256)[None], aspect="auto", cmap=ramp, extent=extent)
    bar.set_yticks([])
    bar.tick_params(colors=INK, labelsize=9)
    bar.set_xlabel(label, color=INK, fontsize=9, labelpad=1)
    return bar


def _png(figure) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, format="png", facecolor=figure.get_facecolor())
    return file.getvalue()


def _unit(colour: tuple[int, int, int]) -> tuple[float, float, float]:
    """sRGB 0..255 as matplotlib's 0..1."""
    red, green, blue = (part / 255.0 for part in colour)
    return red, green, blue
