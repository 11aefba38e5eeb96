"""Charts of a comparison over every axis, for its page."""

import numpy as np

from surgisoft.diagnosis.body_frame import COMPONENTS
from surgisoft.diagnosis.compare import Comparison
from surgisoft.diagnosis.comparing.axes import AXES
from surgisoft.diagnosis.comparing.bands import NAMES, Band
from surgisoft.report import Picture
from surgisoft.report.charts import AMBER, BLUE, CHART, GREEN, RED, chart, drawing
from surgisoft.report.style import MUTED

COLOURS = (BLUE, RED, GREEN, AMBER, "#8a6fc7", "#48a9a6", "#b0627f", "#7d8b3a")
IN_PLANE = COMPONENTS.index("in plane")


def columns_of(result: Comparison, axis: str) -> dict[str, list[Band]]:
    """The bands of each column of an axis, by the column's title."""
    stem = NAMES.get(axis, f"{axis} ")
    answer: dict[str, list[Band]] = {}
    for band in result.bands:
        number = band.axis.removeprefix(stem)
        if band.axis == axis or (number != band.axis and number.isdigit()):
            answer.setdefault(band.axis, []).append(band)
    return answer


def axis_charts(result: Comparison, unit: str) -> list[Picture]:
    """A chart of each axis that the error was laid out on, the most telling first."""
    names = [each.axis for each in result.axes] or [
        name for name in AXES if columns_of(result, name)
    ]
    with drawing():
        drawn = [_chart(result, name, AXES[name].unit.format(unit=unit)) for name in names]
        return [*drawn, _chart(result, "arc length", "mm")]


def _chart(result: Comparison, axis: str, unit: str) -> Picture:
    """RMSE above, bias below, over an axis; shaded: 95 % intervals."""
    from matplotlib import pyplot as plt

    found = columns_of(result, axis)
    figure, (top, low) = plt.subplots(2, 1, figsize=(CHART[0], 1.35 * CHART[1]), sharex=True)
    for (title, bands), colour in zip(found.items(), COLOURS * len(found), strict=False):
        label = f"chamber {title.split()[-1].removeprefix('p')}" if len(found) > 1 else None
        _line(
            top, bands, [b.rmse_mm for b in bands], [b.rmse_ci95_mm for b in bands], colour, label
        )
        for k in range(3) if len(found) == 1 else (IN_PLANE,):
            values = [band.bias_mm[k] for band in bands]
            spread = [band.bias_ci95_mm[k] for band in bands]
            own = COMPONENTS[k] if len(found) == 1 else None
            _line(low, bands, values, spread, COLOURS[k] if len(found) == 1 else colour, own)
    if result.floor.rmse_mm is not None:
        top.axhline(result.floor.rmse_mm, c=MUTED, lw=0.8, ls=":", label="floor")
    low.axhline(0.0, c=MUTED, lw=0.8)
    top.set_ylim(bottom=0)
    top.set_title(_title(result, axis))
    top.set_ylabel("error [mm]")
    low.set_ylabel("bias [mm]" if len(found) == 1 else "bias in plane [mm]")
    if axis == "direction":
        low.set_xticks([-1, 1], ["falling", "rising"])
    low.set_xlabel(f"{axis} [{unit}]" if unit else axis)
    for panel in (top, low):
        if panel.get_legend_handles_labels()[1]:
            panel.legend(fontsize=7, ncols=2)
    return chart(figure, f"error and bias over {axis}")


def _title(result: Comparison, axis: str) -> str:
    share = next((each for each in result.axes if each.axis == axis), None)
    return axis if share is None else f"{axis}: explains {100 * share.share:.0f} %"


def _line(panel, bands: list[Band], values, spread, colour, label) -> None:
    x = np.array([(band.low + band.high) / 2 for band in bands])
    order = np.argsort(x)
    low, high = np.array(spread).T[:, order]
    panel.plot(x[order], np.array(values)[order], ".-", c=colour, lw=1.2, ms=4, label=label)
    panel.fill_between(x[order], low, high, color=colour, alpha=0.18, lw=0)
