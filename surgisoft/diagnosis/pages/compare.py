"""The pages of a comparison, of one model and of several."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib import pyplot as plt

from surgisoft.diagnosis.body_frame import COMPONENTS
from surgisoft.diagnosis.compare import Compared, Comparison
from surgisoft.diagnosis.error_axes import (
    AXES,
    NAMES,
    AxisShare,
    Band,
    Profile,
    arc_length,
    axis_in_words,
)
from surgisoft.diagnosis.pages.pictures import bodies, draw_all, mark_recordings, save
from surgisoft.diagnosis.residuals import ResidualTable
from surgisoft.palette import model_colour
from surgisoft.report import (
    Facts,
    Gallery,
    Page,
    Picture,
    Section,
    Share,
    Table,
    Text,
    write_page,
)
from surgisoft.report.charts import AMBER, BLUE, CHART, GREEN, RED, chart, drawing
from surgisoft.report.style import MUTED
from surgisoft.time_axis import with_gaps

HOW = (
    "Residuals are measured minus predicted. Each is split in the body's own frame: along the "
    "predicted body, in its bending plane, out of that plane. Shaded bands around a line are 95 % "
    "intervals from a bootstrap of blocks of time.\n\n"
    "Each chart of an axis shows its share: above, the error without the axis (for axes of memory "
    "and context: what the actuation leaves of it) and the error that is left with it, on blocks "
    "that took no part in the fit. The shaded area between the two is what the axis explains. "
    "Below, the mean residual of the tip along the direction in which it follows the axis.\n\n"
    "Times are seconds from the start of the first recording, in the charts, the table of worst "
    "moments and the replay alike.\n\n"
    "A share says how much of the squared error a regression on that axis removes on blocks of "
    "time that it was not fitted to; for axes of memory and context, beyond what the actuation "
    "alone removes. Shares overlap, so they do not add up to 100 %.\n\n"
    "The best achievable error is the least that anything left on blocks of time that it was not "
    "fitted to: a black box (a regression on the actuation and its past, without physics), each "
    "known effect and the selected effects. It and the noise floor are those that `surgisoft "
    "diagnose` reports, which uses the first three quarters of each recording (of four or more "
    "runs, all but the last quarter of them). The explainable share is that of the error on these "
    "rows; all other numbers are of all rows. What lies between the best achievable error and the "
    "noise floor may be noise, or more than could be learned from these recordings."
)
PICTURES = {
    "loops": (
        "Tip against actuation, measured and predicted, in the rows in which each chamber moves "
        "most and the others least; where these move too, the upper chart shows their motion as "
        "well. Below, less what the actuation of all chambers explains"
    ),
    "body": "The whole body in a few postures, with magnified errors",
    "error": "The error over time",
}
"""Caption of each picture by the stem of its file."""
SIDE_BY_SIDE = "Measured and predicted bodies of each model, with one scale of the errors"
"""Caption of the picture of several models."""
COLOUR_SCALE = "body"
"""Stem of the picture with a colour scale, which keeps its colours on a dark page."""
BROAD_PX = {"loops": 620, "error": 620}
"""Width below which a picture scrolls, pixels."""


def compare_page(
    result: Comparison, table: ResidualTable, title: str, about: str, pictures: Sequence[Path] = ()
) -> Page:
    """The page of a comparison; `pictures` are files that `pictures.draw_all` wrote."""
    return Page(
        title=title,
        verdict=_upper(result.sentence) + ".",
        about=about,
        tone="good" if result.explainable is None and result.best_achievable else "warn",
        parts=[
            _facts(result),
            _depends(result, table),
            _along(result, table),
            Section(
                "Measured and predicted",
                [
                    Picture.from_file(
                        path,
                        PICTURES[path.stem],
                        PICTURES[path.stem],
                        BROAD_PX.get(path.stem, 0),
                        drawn=path.stem != COLOUR_SCALE,
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


def _span(interval: tuple[float, ...], pattern: str = "{:.3f}") -> str:
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
    if result.best_achievable is not None:
        items.append(("error on the rows that diagnose uses", _mm(result.open_rmse_mm)))
        items.append(("best achievable error", _mm(result.best_achievable.rmse_mm)))
    if result.explainable is not None:
        items.append(("explainable", f"{100 * result.explainable:.0f} %"))
    if result.time_shift is not None:
        items.append(("the arm trails by", f"{result.time_shift.seconds:.3f} s"))
    if result.coverage is not None:
        items.append(("within the 95 % prediction interval", f"{100 * result.coverage:.1f} %"))
    items.append(("rows", f"{result.samples}"))
    if result.in_fit:
        items.append(("of them in the model's fit", f"{result.in_fit:.0%}"))
    if result.missing:
        items.append(("rows without key points", f"{result.missing}"))
    return Facts(items)


def _depends(result: Comparison, table: ResidualTable) -> Section:
    rows = [
        (
            each.in_words,
            Share(each.share),
            _span(tuple(100 * value for value in each.ci95), "{:.0f}"),
            "alone" if each.static else "beyond actuation",
            each.about,
        )
        for each in result.axes
    ]
    header = ["axis", "explains", "95 % interval [%]", "counted", "what it is"]
    listed = Table(header, rows)
    charts = Gallery(axis_charts(result, table.spec.unit))
    return Section("What the error depends on", [*([listed] if rows else []), charts])


def _along(result: Comparison, table: ResidualTable) -> Section:
    bands = {band.low: band for band in result.bands if band.axis == "arc length"}
    rows = []
    for k, way in enumerate(arc_length(table)):
        band = bands.get(float(way))
        bias = ["-"] * 3 if band is None else [f"{value:+z.3f}" for value in band.bias_mm]
        error = _mm(result.per_key_point_mm[k])
        rows.append((f"k{k}", f"{way:.1f} mm", error, *bias))
    header = ["key point", "along the arm", "error"]
    parts = Facts([(f"residual {name}", _mm(result.components_mm[name])) for name in COMPONENTS])
    points = Table([*header, *(f"bias {name} [mm]" for name in COMPONENTS)], rows)
    return Section("Along the arm", [parts, points])


def _worst(result: Comparison) -> Section:
    rows = [
        (
            f"{m.along_s:.2f} s",
            f"{m.error_mm:.3f} mm",
            f"k{m.key_point}",
            m.recording,
            f"{m.t_s:.2f} s",
        )
        for m in result.worst
    ]
    header = ["time", "error", "key point", "recording", "time in the recording"]
    return Section("Worst moments", [Table(header, rows)])


# Charts --------------------------------------------------------------------------------------

DRAWN_SHARE = 0.02
"""Smallest share of the error for which an axis gets a chart; the table lists all of them."""
LEAST_AXES = 3
"""Number of axes that are drawn where no share reaches `DRAWN_SHARE`."""
COLOURS = (BLUE, RED, GREEN, AMBER, "#8a6fc7", "#48a9a6", "#b0627f", "#7d8b3a")
CHAMBERS = COLOURS[2:]
"""Colours of chambers, apart from those of the error without and with an axis."""
IN_PLANE = COMPONENTS.index("in plane")


def columns_of(result: Comparison, axis: str) -> dict[str, list[Band]]:
    """The bands of each column of an axis, by the column's title."""
    stem = NAMES.get(axis, f"{axis} ")
    found: dict[str, list[Band]] = {}
    for band in result.bands:
        number = band.axis.removeprefix(stem)
        if band.axis == axis or (number != band.axis and number.isdigit()):
            found.setdefault(band.axis, []).append(band)
    return found


def axis_charts(result: Comparison, unit: str) -> list[Picture]:
    """A chart of each axis that the error was laid out on, the one with the largest share first."""
    telling = [each.axis for each in result.axes if each.share >= DRAWN_SHARE]
    names = telling or [each.axis for each in result.axes[:LEAST_AXES]]
    names = names or [name for name in AXES if columns_of(result, name)]
    shares = {each.axis: each for each in result.axes}
    with drawing():
        drawn = [
            share_chart(shares[name], result.floor.rmse_mm)
            if name in shares and shares[name].profiles
            else _chart(result, name, AXES[name].unit.format(unit=unit))
            for name in names
        ]
        return [*drawn, _chart(result, "arc length", "mm")]


def share_chart(share: AxisShare, floor_mm: float | None) -> Picture:
    """Chart of an axis: above, the error without and with it; below, the tip's residual.

    The upper panel is over the column that explains most. Draw inside `drawing`.
    """
    profiles, many = share.profiles, len(share.profiles) > 1
    most = max(range(len(profiles)), key=lambda k: _won(profiles[k]))
    main = profiles[most]
    figure, (top, low) = plt.subplots(2, 1, figsize=(CHART[0], 1.5 * CHART[1]), sharex=not many)
    before = "error" if share.static else "error beyond actuation"
    top.plot(main.middle, main.without_mm, ".-", c=RED, lw=1.2, ms=4, label=before)
    label = f"left with {share.in_words}"
    top.plot(main.middle, main.left_mm, ".-", c=BLUE, lw=1.2, ms=4, label=label)
    top.fill_between(main.middle, main.left_mm, main.without_mm, color=RED, alpha=0.15, lw=0)
    if floor_mm is not None:
        top.axhline(floor_mm, c=MUTED, lw=0.8, ls=":", label="floor")
    top.set_ylim(bottom=0)
    of = f" ({_of_chamber(main)})" if many else ""
    top.set_title(f"{share.in_words}: explains {100 * share.share:.0f} %{of}")
    top.set_ylabel("error [mm]")
    for number, profile in enumerate(profiles):
        colour = CHAMBERS[number % len(CHAMBERS)] if many else GREEN
        bounds = np.array(profile.shift_ci95_mm).T
        own = _of_chamber(profile) if many else None
        low.plot(profile.middle, profile.shift_mm, ".-", c=colour, lw=1.2, ms=4, label=own)
        low.fill_between(profile.middle, *bounds, color=colour, alpha=0.15, lw=0)
    low.axhline(0.0, c=MUTED, lw=0.8)
    top.set_xlim(low.get_xlim())  # one scale, though the panels may show other chambers
    low.set_ylabel("mean error of the tip [mm]")
    for panel in (top, low):
        if share.axis == "direction":
            panel.set_xticks([-1, 0, 1], ["falling", "", "rising"])
    low.set_xlabel(f"{share.in_words} [{share.unit}]" if share.unit else share.in_words)
    figure.legend(loc="outside lower center", ncols=3, fontsize=8)
    return chart(figure, f"what {share.in_words} explains of the error")


def _won(profile: Profile) -> float:
    """Fall of the mean square that a column's bands show, mm^2."""
    return float(np.nanmean(np.square(profile.without_mm) - np.square(profile.left_mm))) * (
        1e-6 + float(np.ptp(profile.shift_mm))
    )


def _of_chamber(profile: Profile) -> str:
    return f"chamber {profile.column.split()[-1].removeprefix('p')}"


def _chart(result: Comparison, axis: str, unit: str) -> Picture:
    """Chart of RMSE (above) and bias (below) over an axis; 95 % intervals are shaded."""
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
    top.set_title(_title(result, axis, unit))
    top.set_ylabel("error [mm]")
    low.set_ylabel("bias [mm]" if len(found) == 1 else "bias in plane [mm]")
    if axis == "direction":
        low.set_xticks([-1, 1], ["falling", "rising"])
    called = axis_in_words(axis, unit)
    low.set_xlabel(f"{called} [{unit}]" if unit else called)
    for panel in (top, low):
        if panel.get_legend_handles_labels()[1]:
            panel.legend(fontsize=8, ncols=2)
    return chart(figure, f"error and bias over {called}")


def _title(result: Comparison, axis: str, unit: str) -> str:
    share = next((each for each in result.axes if each.axis == axis), None)
    called = axis_in_words(axis, unit)
    return called if share is None else f"{called}: explains {100 * share.share:.0f} %"


def _line(panel, bands: list[Band], values, spread, colour, label) -> None:
    x = np.array([(band.low + band.high) / 2 for band in bands])
    order = np.argsort(x)
    low, high = np.array(spread).T[:, order]
    panel.plot(x[order], np.array(values)[order], ".-", c=colour, lw=1.2, ms=4, label=label)
    panel.fill_between(x[order], low, high, color=colour, alpha=0.18, lw=0)


# Report files --------------------------------------------------------------------------------


def write_report(compared: Sequence[Compared], folder: Path, title: str) -> list[Path]:
    """Write the report of a comparison to a folder; returns its files, the page to open first.

    Of one model: `report.html` and its pictures. Of several: `report.html` shows them together,
    with one scale of their errors, and each has a report of its own in a folder of its number.
    """
    folder = Path(folder)
    if len(compared) == 1:
        (one,) = compared
        drawn = draw_all(one.table, one.table.spec.unit, folder, title)
        page = compare_page(one.result, one.table, title, one.summary, drawn)
        return [write_page(page, folder / "report.html"), *drawn]
    files = []
    for number, one in enumerate(compared, 1):
        files += write_report([one], folder / str(number), one.name)
    drawn = []
    if compared[0].table.spec.key_points > 1:
        figure = bodies({one.name: one.table for one in compared}, title)
        drawn.append(save(figure, folder / "bodies.png"))
    page = together_page(compared, title, drawn)
    return [write_page(page, folder / "report.html"), *drawn, *files]


def together_page(compared: Sequence[Compared], title: str, drawn: Sequence[Path] = ()) -> Page:
    """The page of several models on the same recordings; `drawn`: picture of their bodies."""
    best = min(compared, key=lambda one: one.result.rmse_mm)
    worst = max(compared, key=lambda one: one.result.rmse_mm)
    verdict = (
        f"Model {best.name} has the smallest error, {_mm(best.result.rmse_mm)}; "
        f"{worst.name} has {_mm(worst.result.rmse_mm)}. {_upper(best.result.sentence)}."
    )
    rows = [
        (
            one.name,
            _mm(one.result.rmse_mm),
            f"{_span(one.result.rmse_ci95_mm)} mm",
            _mm(one.result.tip_rmse_mm),
            "-" if one.result.explainable is None else f"{100 * one.result.explainable:.0f} %",
            ", ".join(each.in_words for each in one.result.main_axes) or "no single axis",
            f"{number}/report.html",
        )
        for number, one in enumerate(compared, 1)
    ]
    header = [
        "model",
        "error",
        "95 % interval",
        "tip",
        "explainable",
        "depends most on",
        "its own report",
    ]
    floor = compared[0].result.floor
    known = [("noise floor", f"{_mm(floor.rmse_mm)} ({floor.source})")]
    with drawing():
        charts = [_models_over_time(compared)]
        small = [_models_along(compared)]
        small += [_models_over(compared, name) for name in _telling(compared)]
    pictures = [Picture.from_file(path, SIDE_BY_SIDE, SIDE_BY_SIDE, 620) for path in drawn]
    return Page(
        title=title,
        verdict=verdict,
        about="; ".join(f"{one.name}: {one.summary}" for one in compared),
        tone="plain",
        parts=[
            Table(header, rows),
            Facts(known),
            Section("On the body", pictures),
            Section("Over time", charts),
            Section("What the errors depend on", [Gallery(small)]),
            Section("How to read this", [Text(HOW_TOGETHER)]),
        ],
    )


HOW_TOGETHER = (
    "All models predict the same rows. Errors on the body are magnified by one factor and coloured "
    "by one scale, so that a model with a smaller error also looks better. Times are seconds from "
    "the start of the first recording, as in the replay. Bands around a line are 95 % intervals "
    "from a bootstrap of blocks of time."
)
MOST_AXES = 3
"""Number of axes over which several models are drawn: those with the largest shares of the first
model's error."""
POINTS = 900
"""Points of a line over time."""


def _telling(compared: Sequence[Compared]) -> list[str]:
    return [each.axis for each in compared[0].result.axes[:MOST_AXES]]


def _models_over_time(compared: Sequence[Compared]) -> Picture:
    figure, axis = plt.subplots(figsize=(9.2, 3.2))
    for number, one in enumerate(compared):
        time_s, values = thinned(one.table)
        colour = model_colour(number)
        axis.plot(*with_gaps(time_s, values), c=colour, lw=1, label=one.name)
    if (floor := compared[0].result.floor.rmse_mm) is not None:
        axis.axhline(floor, c=MUTED, lw=0.8, ls=":", label="floor")
    mark_recordings(axis, compared[0].table)
    axis.set_xlabel("time [s]")
    axis.set_ylabel("error [mm]")
    axis.set_ylim(bottom=0)
    figure.legend(loc="outside lower center", ncols=4)
    drawn = chart(figure, "error of each model over time", "RMS error over the key points")
    return replace(drawn, least_px=BROAD_PX["error"])


def thinned(table: ResidualTable, points: int = POINTS) -> tuple[np.ndarray, np.ndarray]:
    """(P,) times and RMS errors over key points, mm, of neighbouring rows together."""
    square = np.square(table.error_mm)
    width = max(1, len(square) // points)
    count = len(square) // width * width
    cells = square[:count].reshape(-1, width * square.shape[1])
    seen = ~np.isnan(cells)
    with np.errstate(invalid="ignore"):
        mean = np.nansum(cells, 1) / np.where(seen.any(1), seen.sum(1), np.nan)
    return table.along_s[:count].reshape(-1, width)[:, 0], np.sqrt(mean)


def _models_along(compared: Sequence[Compared]) -> Picture:
    figure, axis = plt.subplots(figsize=CHART)
    for number, one in enumerate(compared):
        where = arc_length(one.table)
        errors = one.result.per_key_point_mm
        axis.plot(where, errors, ".-", c=model_colour(number), lw=1.2, label=one.name)
    axis.set_xlabel("along the arm [mm]")
    axis.set_ylabel("error [mm]")
    axis.set_ylim(bottom=0)
    axis.set_title("along the arm")
    figure.legend(loc="outside lower center", ncols=3, fontsize=8)
    return chart(figure, "error of each model along the arm")


def _models_over(compared: Sequence[Compared], name: str) -> Picture:
    """The error of each model over the column of an axis on which the first one varies most."""
    first = columns_of(compared[0].result, name)
    column = max(first, key=lambda title: float(np.ptp([band.rmse_mm for band in first[title]])))
    unit = AXES[name].unit.format(unit=compared[0].table.spec.unit)
    figure, axis = plt.subplots(figsize=CHART)
    for number, one in enumerate(compared):
        bands = columns_of(one.result, name).get(column, [])
        if bands:
            spread = [band.rmse_ci95_mm for band in bands]
            values = [band.rmse_mm for band in bands]
            _line(axis, bands, values, spread, model_colour(number), one.name)
    axis.set_ylim(bottom=0)
    chamber = column.split()[-1].removeprefix("p")
    called = axis_in_words(name, unit)
    title = f"{called} of chamber {chamber}" if chamber.isdigit() and len(first) > 1 else called
    axis.set_title(title)
    axis.set_xlabel(f"{called} [{unit}]" if unit else called)
    axis.set_ylabel("error [mm]")
    figure.legend(loc="outside lower center", ncols=3, fontsize=8)
    return chart(figure, f"error of each model over {called}")
