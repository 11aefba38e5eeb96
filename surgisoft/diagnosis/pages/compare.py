"""The page of a comparison."""

import math
from pathlib import Path

import numpy as np

from surgisoft.diagnosis.body_frame import COMPONENTS
from surgisoft.diagnosis.compare import Comparison
from surgisoft.diagnosis.error_axes import AXES, NAMES, Band, arc_length
from surgisoft.diagnosis.residuals import ResidualTable
from surgisoft.report import Facts, Gallery, Page, Picture, Section, Share, Table, Text
from surgisoft.report.charts import AMBER, BLUE, CHART, GREEN, RED, chart, drawing
from surgisoft.report.style import MUTED

HOW = (
    "Residuals are measured less predicted. Each is split in the body's own frame: along the "
    "predicted body, in its bending plane, out of that plane. Shaded bands are 95 % intervals from "
    "a bootstrap of blocks of time.\n\n"
    "A share says how much of the squared error a regression on that axis removes on blocks of "
    "time that it was not fitted to; for axes of memory and context, beyond what the actuation "
    "alone removes. Shares overlap, so they do not add up to 100 %.\n\n"
    "The best achievable error is the least that anything left on blocks of time that it was not "
    "fitted to: a black box (a regression on the actuation and its past, without physics), each "
    "known effect and the selected effects. `surgisoft diagnose` reports the same number on the "
    "same rows. What lies between it and the noise floor may be noise, or more than could be "
    "learned from these recordings."
)
PICTURES = {
    "loops": "Tip against actuation, measured and predicted; below, without what pressure explains",
    "body": "The whole body in a few postures",
    "error": "The error over the rows",
}
"""Caption of each picture by the stem of its file."""
BROAD_PX = {"loops": 620, "error": 620}
"""Width below which a picture scrolls, pixels."""


def compare_page(
    result: Comparison, table: ResidualTable, title: str, about: str, pictures: list[Path] = ()
) -> Page:
    """The page of a comparison; `pictures` are files that `pictures.draw_all` wrote."""
    return Page(
        title=title,
        verdict=_upper(result.sentence) + ".",
        about=about,
        tone="good" if result.explainable is None and result.ceiling else "warn",
        parts=[
            _facts(result),
            _depends(result, table),
            _along(result, table),
            Section(
                "Measured and predicted",
                [
                    Picture.from_file(
                        path, PICTURES[path.stem], PICTURES[path.stem], BROAD_PX.get(path.stem, 0)
                    )
                    for path in pictures
                    if path.stem in PICTURES
                ],
            ),
            _worst(result),
            Section("How to read this", [Text(HOW)]),
        ],
    )


def _upper(text: str) -> str:
    return text[:1].upper() + text[1:]


def _mm(value: float | None) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.3f} mm"


def _span(interval: tuple[float, float], pattern: str = "{:.3f}") -> str:
    if any(math.isnan(value) for value in interval):
        return "-"
    return " .. ".join(pattern.format(value) for value in interval)


def _facts(result: Comparison) -> Facts:
    items = [
        ("error (RMS distance)", _mm(result.rmse_mm)),
        ("95 % interval", f"{_span(result.rmse_ci95_mm)} mm"),
        ("tip", _mm(result.tip_rmse_mm)),
        (f"noise floor ({result.floor.source})", _mm(result.floor.rmse_mm)),
    ]
    if result.ceiling is not None:
        items.append(("best achievable error", _mm(result.ceiling.rmse_mm)))
    if result.explainable is not None:
        items.append(("explainable", f"{100 * result.explainable:.0f} %"))
    if result.time_shift is not None:
        items.append(("the arm trails by", f"{result.time_shift.seconds:.3f} s"))
    if result.coverage is not None:
        items.append(("within the 95 % prediction interval", f"{100 * result.coverage:.1f} %"))
    items.append(("rows", f"{result.samples}"))
    if result.missing:
        items.append(("rows without key points", f"{result.missing}"))
    return Facts(items)


def _depends(result: Comparison, table: ResidualTable) -> Section:
    rows = [
        (
            each.axis,
            Share(each.share),
            _span(tuple(100 * value for value in each.ci95), "{:.0f}"),
            "alone" if each.static else "beyond actuation",
            each.about,
        )
        for each in result.axes
    ]
    listed = Table(["axis", "explains", "95 % interval", "counted", "what it is"], rows)
    charts = Gallery(axis_charts(result, table.spec.unit))
    return Section("What the error depends on", [*([listed] if rows else []), charts])


def _along(result: Comparison, table: ResidualTable) -> Section:
    bands = {band.low: band for band in result.bands if band.axis == "arc length"}
    rows = []
    for k, way in enumerate(arc_length(table)):
        band = bands.get(float(way))
        bias = ["-"] * 3 if band is None else [f"{value:+.3f}" for value in band.bias_mm]
        error = _mm(result.per_key_point_mm[k])
        rows.append((f"k{k}", f"{way:.1f} mm", error, *bias))
    header = ["key point", "along the arm", "error"]
    parts = Facts([(f"residual {name}", _mm(result.components_mm[name])) for name in COMPONENTS])
    points = Table([*header, *(f"bias {name} [mm]" for name in COMPONENTS)], rows)
    return Section("Along the arm", [parts, points])


def _worst(result: Comparison) -> Section:
    rows = [
        (m.recording, f"{m.t_s:.2f} s", f"{m.error_mm:.3f} mm", f"k{m.key_point}")
        for m in result.worst
    ]
    return Section("Worst moments", [Table(["recording", "time", "error", "key point"], rows)])


# Charts --------------------------------------------------------------------------------------

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
