"""Matplotlib figures as SVG pictures of a page, in the colours of the reader's theme.

with drawing():
    figure, axis = plt.subplots(figsize=CHART)
    ...
    picture = chart(figure, "Error over dwell")
"""

import contextlib
import io
from collections.abc import Iterator

import matplotlib as mpl

from surgisoft.palette import AMBER, BLUE, GREEN, RED
from surgisoft.report.parts import Picture
from surgisoft.report.style import DARK_INK, DARK_LINE, DARK_MUTED, INK, LINE, MUTED

mpl.use("Agg")
from typing import Any

from matplotlib import pyplot as plt
from matplotlib.figure import Figure

__all__ = ["AMBER", "BLUE", "BROAD", "BROAD_PX", "CHART", "GREEN", "RED", "chart", "drawing"]

CHART = (4.6, 3.0)
"""Size of a chart that is legible on a phone, inches."""
BROAD = 11.0
"""Width of a chart that fills a page on a screen, inches."""
BROAD_PX = 760
"""Width below which such a chart scrolls, because its text would be too small, pixels."""
_STYLE: Any = {
    "axes.edgecolor": MUTED,
    "axes.facecolor": "none",
    "axes.grid": True,
    "axes.labelcolor": INK,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.titlecolor": INK,
    "axes.titlesize": 10,
    "figure.facecolor": "none",
    "figure.figsize": CHART,
    "figure.constrained_layout.use": True,
    "font.size": 9,
    "grid.color": LINE,
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "savefig.facecolor": "none",
    "svg.fonttype": "path",
    "svg.hashsalt": "surgisoft",
    "text.color": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
}
_THEME = (
    f"<style>:root{{--ink:{INK};--muted:{MUTED};--line:{LINE}}}@media (prefers-color-scheme:dark)"
    f"{{:root{{--ink:{DARK_INK};--muted:{DARK_MUTED};--line:{DARK_LINE}}}}}</style>"
)


@contextlib.contextmanager
def drawing() -> Iterator[None]:
    """Use the pages' matplotlib style inside the block."""
    with mpl.rc_context(_STYLE):
        yield


def chart(figure: Figure, alt: str, caption: str = "", least_px: int = 0) -> Picture:
    """Convert a figure drawn inside `drawing` to an SVG picture, and close the figure.

    Ink, muted and line colours become variables that follow the reader's theme. Draw scatter plots
    of many points with `rasterized=True`; otherwise each point becomes an SVG element.
    """
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", dpi=160, metadata={"Date": None, "Creator": None})
    plt.close(figure)
    text = buffer.getvalue()
    for colour, name in ((INK, "ink"), (MUTED, "muted"), (LINE, "line")):
        text = text.replace(colour, f"var(--{name})")
    head, tag, rest = text.partition("<defs>")
    data = (head + _THEME + tag + rest).encode("utf-8")
    return Picture(data, alt, caption, "image/svg+xml", least_px)
