"""The page of a comparison."""

import math
from pathlib import Path

from surgisoft.diagnosis.body_frame import COMPONENTS
from surgisoft.diagnosis.compare import Comparison
from surgisoft.diagnosis.comparing.axes import arc_length
from surgisoft.diagnosis.pages.charts import axis_charts
from surgisoft.diagnosis.residuals import Residuals
from surgisoft.report import Facts, Gallery, Page, Picture, Section, Share, Table, Text

HOW = (
    "Residuals are measured less predicted. Each is split in the body's own frame: along the "
    "predicted body, in its bending plane, out of that plane. Shaded bands are 95 % intervals from "
    "a bootstrap of blocks of time.\n\n"
    "A share says how much of the squared error a regression on that axis removes on blocks of "
    "time that it was not fitted to; for axes of memory and context, beyond what the actuation "
    "alone removes. Shares overlap, so they do not add up to 100 %.\n\n"
    "The black box is a regression on the actuation and its past without any physics, judged the "
    "same way. What it removes has a cause in the actuation, in time or in the context; what it "
    "leaves may be noise, or more than it could learn from these recordings."
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
    result: Comparison, rest: Residuals, title: str, about: str, pictures: list[Path] = ()
) -> Page:
    """The page of a comparison; `pictures` are files that `pictures.draw_all` wrote."""
    return Page(
        title=title,
        verdict=_upper(result.sentence) + ".",
        about=about,
        tone="good" if result.explainable is None and result.ceiling else "warn",
        parts=[
            _facts(result),
            _depends(result, rest),
            _along(result, rest),
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
        items.append(("a black box reaches", _mm(result.ceiling.rmse_mm)))
    if result.explainable is not None:
        items.append(("explainable", f"{100 * result.explainable:.0f} %"))
    if result.time_shift is not None:
        items.append(("the arm trails by", f"{result.time_shift.seconds:.3f} s"))
    items.append(("rows", f"{result.samples}"))
    if result.missing:
        items.append(("rows without key points", f"{result.missing}"))
    return Facts(items)


def _depends(result: Comparison, rest: Residuals) -> Section:
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
    table = Table(["axis", "explains", "95 % interval", "counted", "what it is"], rows)
    charts = Gallery(axis_charts(result, rest.spec.unit))
    return Section("What the error depends on", [*([table] if rows else []), charts])


def _along(result: Comparison, rest: Residuals) -> Section:
    bands = {band.low: band for band in result.bands if band.axis == "arc length"}
    rows = []
    for k, way in enumerate(arc_length(rest)):
        band = bands.get(float(way))
        reached = result.ceiling.per_key_point_mm[k] if result.ceiling else None
        bias = ["-"] * 3 if band is None else [f"{value:+.3f}" for value in band.bias_mm]
        error = _mm(result.per_key_point_mm[k])
        rows.append((f"k{k}", f"{way:.1f} mm", error, _mm(reached), *bias))
    header = ["key point", "along the arm", "error", "black box"]
    parts = Facts([(f"residual {name}", _mm(result.components_mm[name])) for name in COMPONENTS])
    table = Table([*header, *(f"bias {name} [mm]" for name in COMPONENTS)], rows)
    return Section("Along the arm", [parts, table])


def _worst(result: Comparison) -> Section:
    rows = [
        (m.recording, f"{m.t_s:.2f} s", f"{m.error_mm:.3f} mm", f"k{m.key_point}")
        for m in result.worst
    ]
    return Section("Worst moments", [Table(["recording", "time", "error", "key point"], rows)])
