"""The HTML page of a credibility report."""

from pathlib import Path

import numpy as np

from surgisoft.credibility.assessment import STATEMENT, Assessment, PointError
from surgisoft.credibility.domain import NEAR, NEAR_POSE, Applicability, percent
from surgisoft.credibility.factors import factors
from surgisoft.credibility.software import COMMIT, TESTS
from surgisoft.files import write_json
from surgisoft.report import Facts, Gallery, Page, Picture, Section, Share, Table, Text, write_page
from surgisoft.report.charts import AMBER, BLUE, CHART, GREEN, RED, chart, drawing

NAME = "credibility"
"""Name of the report's files, without suffix."""
DRAWN = 4000
"""Most points of a scatter plot."""
HOW = (
    "The comparison error is E = S - D: prediction of the model minus measurement. Of a key point "
    "it is stated as RMS distance over all measured rows, with the mean of each coordinate as "
    "bias. U_val = 1.96 u_val expands the standard uncertainty u_val, the root of the sum of "
    "squares of noise (u_D), uncertain inputs, uncertain parameters and steps of time, each as "
    "RMS distance; the parts count as independent. The error of the model then lies within E ± "
    "U_val at 95 % (V&V 20-2009). Where E is smaller than U_val the comparison "
    "cannot tell the model's error from these uncertainties. A part that is not known counts as "
    "zero, so that U_val is then too small. On recordings that the model was fitted to, in whole "
    "or in part, E is not a validation error, and no criterion on it is met.\n\n"
    "The area metric is the area between the distribution functions of predicted and measured "
    "coordinates (Roy & Oberkampf 2011), root of the sum of squares over x, y and z. It compares "
    "how often positions occur, not when, and it has the unit of the quantity. Over the body it "
    "is the root of the mean square.\n\n"
    "A criterion on the error is met where the upper end of E ± U_val does not exceed the "
    "limit.\n\n"
    "A state lies inside the validated domain where some measured row had the same pressures up "
    f"to {percent(NEAR)} of each range, some measured row had all key points within "
    f"{percent(NEAR_POSE)} of the arm's length, and rates and load are no larger than measured. "
    "What is not known of a state does not count against it.\n\n"
    "Model form: what `surgisoft diagnose` names on the training rows of all recordings together, "
    "without fitting networks again. Test-retest: the same for each recording alone, and the "
    "effects fitted to each; values agree where Cochran's Q has a p-value of 0.05 or more, and a "
    "parameter is identifiable where half its 95 % interval is no wider than half its value."
)


def write_report(found: Assessment, folder: Path) -> list[Path]:
    """Write `credibility.html` and `credibility.json` into a folder; returns their paths."""
    page = write_page(credibility_page(found), folder / f"{NAME}.html")
    data = folder / f"{NAME}.json"
    stated = {"credibility_factors": [each.to_json() for each in factors(found)]}
    write_json(data, found.to_json() | stated)
    return [page, data]


def credibility_page(found: Assessment) -> Page:
    """The page of an assessment."""
    context = found.context
    tone = {True: "good", False: "bad", None: "plain"}[found.passed]
    with drawing():
        parts = [
            _facts(found),
            Text(STATEMENT),
            _question(found),
            _criteria(found),
            _factors(found),
            _error(found),
            _uncertainty(found),
            _comparators(found),
            _inputs(found),
            _form(found),
            _retest(found),
            _applicability(found),
            *_scenario(found),
            _software(found),
            Section("How to read this", [Text(HOW)]),
        ]
    return Page(
        title=context.title or "Credibility of a model",
        verdict=found.sentence[:1].upper() + found.sentence[1:] + ".",
        about=found.model,
        tone=tone,
        parts=[part for part in parts if part is not None],
    )


def _mm(value: float | None) -> str:
    return "-" if value is None or not np.isfinite(value) else f"{value:.3f} mm"


def _yes(value: bool | None) -> str:
    return {True: "yes", False: "no", None: "not known"}[value]


def _facts(found: Assessment) -> Facts:
    body = found.points[-1]
    items = [
        ("comparison error E", _mm(body.error_mm)),
        ("95 % interval of E", " to ".join(f"{v:.3f}" for v in found.error_ci95_mm) + " mm"),
        ("validation uncertainty U_val", _mm(body.uncertainty_mm)),
        ("area metric", _mm(body.area_mm)),
    ]
    if found.applicability is not None:
        items.append(("states inside", percent(found.applicability.whole)))
    if found.criteria:
        met = sum(each.passed for each in found.criteria)
        items.append(("criteria met", f"{met} of {len(found.criteria)}"))
    return Facts(items)


def _question(found: Assessment) -> Section:
    context = found.context
    risk = context.risk
    rows = [
        ("question of interest", context.question),
        ("context of use", context.use),
        ("model influence", risk.influence),
        ("decision consequence", risk.consequence),
        ("model risk", f"{risk.level} ({risk.reason})" if risk.reason else risk.level),
    ]
    return Section("Question of interest and context of use", [Table(["", "as stated"], rows)])


def _criteria(found: Assessment) -> Section | None:
    if not found.criteria:
        return None
    rows = []
    for each in found.criteria:
        number = (lambda v: f"{v:.3f} mm") if each.unit else percent
        value = number(each.value) if np.isfinite(each.value) else "not known"
        sign = "at least" if each.least else "at most"
        met = "met" if each.passed else "not met"
        rows.append((each.name, value, f"{sign} {number(each.limit)}", met))
    header = ["criterion", "value", "limit", "result"]
    return Section("Acceptance criteria", [Table(header, rows)])


def _factors(found: Assessment) -> Section:
    rows = [
        (each.activity, each.name, each.evidence, each.section or "-") for each in factors(found)
    ]
    text = (
        "The credibility factors of ASME V&V 40-2018, with what this report says about each. The "
        "goal of each factor follows from the model risk and is set by the user."
    )
    header = ["activity", "credibility factor", "in this report", "section"]
    return Section("Credibility factors", [Text(text), Table(header, rows)])


def _error(found: Assessment) -> Section:
    rows = [
        (
            each.label,
            _mm(each.error_mm),
            _mm(each.uncertainty_mm),
            " to ".join(f"{value:.3f}" for value in each.interval_mm) + " mm",
            *(["-"] * 3 if each.bias_mm is None else [f"{v:+.3f}" for v in each.bias_mm]),
            _mm(each.area_mm),
            "yes" if each.resolved else "no",
        )
        for each in found.points
        if np.isfinite(each.error_mm)
    ]
    header = ["key point", "E", "U_val (95 %)", "E ± U_val"]
    header += [f"bias {axis} [mm]" for axis in "xyz"] + ["area metric", "E > U_val"]
    return Section(
        "Comparison error and validation uncertainty",
        [Table(header, rows), Gallery([_error_chart(found.points), _area_chart(found)])],
    )


def _error_chart(points: tuple[PointError, ...]) -> Picture:
    """E with E ± U_val of every key point."""
    from matplotlib import pyplot as plt

    some = [each for each in points if np.isfinite(each.error_mm)]
    figure, axis = plt.subplots(figsize=CHART)
    for place, each in enumerate(some):
        low, high = each.interval_mm
        axis.plot([place, place], [low, high], c=BLUE, lw=6, alpha=0.35, solid_capstyle="butt")
        axis.plot(place, each.error_mm, "o", c=BLUE, ms=5)
        axis.plot(place, each.area_mm, "D", c=AMBER, ms=4)
    axis.plot([], [], "o-", c=BLUE, label="E, E ± U_val")
    axis.plot([], [], "D", c=AMBER, label="area metric")
    axis.set_xticks(range(len(some)), [each.label for each in some])
    axis.set_ylim(bottom=0)
    axis.set_ylabel("[mm]")
    figure.legend(loc="outside lower center", ncols=2, fontsize=8)
    axis.set_title("Along the arm")
    return chart(figure, "Comparison error, validation uncertainty and area metric by key point")


def _area_chart(found: Assessment) -> Picture:
    """Distribution functions of the tip's coordinates, measured and predicted."""
    from matplotlib import pyplot as plt

    table, last = found.table, len(found.points) - 2
    seen = np.isfinite(table.measured_mm[:, last]).all(1)
    figure, axis = plt.subplots(figsize=CHART)
    for k, colour in enumerate((RED, GREEN, BLUE)):
        for values, style in ((table.measured_mm, "-"), (table.predicted_mm, "--")):
            some = np.sort(values[seen, last, k])
            some = some[:: max(1, len(some) // 400)]
            name = f"{'xyz'[k]}, {'measured' if style == '-' else 'predicted'}"
            share = (np.arange(len(some)) + 1) / max(len(some), 1)
            axis.step(some, share, style, c=colour, lw=1.1, where="post", label=name)
    axis.set_xlabel("coordinate [mm]")
    axis.set_ylabel("share of rows")
    figure.legend(loc="outside lower center", ncols=3, fontsize=8)
    axis.set_title("Distributions of the tip (area metric)")
    return chart(figure, "Distribution functions of the tip's coordinates, measured and predicted")


def _uncertainty(found: Assessment) -> Section:
    body, sources = found.uncertainty.body, found.uncertainty.sources
    values = {
        "noise": body.noise_mm,
        "input": body.input_mm,
        "parameters": body.parameters_mm,
        "numerical": body.numerical_mm,
    }
    rows = [(name, _mm(value), sources[name]) for name, value in values.items()]
    rows.append(("u_val", _mm(body.standard_mm), "root of the sum of squares"))
    rows.append(("U_val", _mm(body.expanded_mm), "95 %, 1.96 u_val"))
    parts: list = [Table(["standard uncertainty", "RMS over the body", "known from"], rows)]
    if body.unknown:
        parts.append(
            Text(
                f"Not known, counted as zero: {', '.join(body.unknown)}. U_val is too small by it."
            )
        )
    unit = found.table.spec.unit
    sizes = ", ".join(f"{value:.3g}" for value in found.uncertainty.inputs)
    parts.append(Text(f"Standard uncertainty of the actuation channels: {sizes} {unit}."))
    return Section("Parts of the validation uncertainty", parts)


def _comparators(found: Assessment) -> Section:
    unit = found.table.spec.unit
    rows = [
        (
            each.name,
            each.robot,
            each.date,
            f"{each.rows}",
            f"{each.seconds:.0f} s",
            "; ".join(f"{low:.3g} to {high:.3g}" for low, high in each.range) + f" {unit}",
            "not known" if each.in_fit is None else percent(each.in_fit),
            each.note or "-",
        )
        for each in found.comparators
    ]
    header = ["recording", "robot", "date", "rows", "length", "actuation", "rows in the fit"]
    hashes = [(each.name, each.sha256) for each in found.comparators]
    parts: list = [Table([*header, "note"], rows), Table(["recording", "SHA-256"], hashes)]
    if found.rows_of_fit:
        parts.append(Text(f"{found.rows_of_fit[:1].upper()}{found.rows_of_fit[1:]}."))
    return Section("Comparators", parts)


def _inputs(found: Assessment) -> Section:
    rows = [(i.name, i.measured, i.simulated, _yes(i.equivalent)) for i in found.inputs]
    header = ["input", "comparators", "model", "equivalent"]
    return Section("Equivalence of inputs", [Table(header, rows)])


def _form(found: Assessment) -> Section:
    if found.diagnosis is None:
        return Section("Model form", [Text(f"No diagnosis: {found.no_diagnosis}.")])
    verdict = found.diagnosis.verdict
    rows = [
        (each.effect, Share(each.confidence), Share(each.gain_alone), _mm(each.heldout_rmse_mm))
        for each in found.diagnosis.shown[:6]
    ]
    header = ["effect", "confidence", "explains alone", "held-out error with it"]
    notes = [*found.diagnosis.notes, *found.diagnosis.checks]
    text = verdict.sentence[:1].upper() + verdict.sentence[1:] + "."
    if verdict.kind != "setup":
        text += f" Confidence of this statement: {verdict.confidence:.2f}."
    return Section(
        "Model form",
        [Text(text), *([Table(header, rows)] if rows else []), *(Text(note) for note in notes)],
    )


def _retest(found: Assessment) -> Section:
    again = found.retest
    parts: list = [Text(again.sentence[:1].upper() + again.sentence[1:] + ".")]
    rows = [
        (
            each.recording,
            each.kind,
            ", ".join(each.effects) or "-",
            f"{each.confidence:.2f}" if each.kind != "-" else "-",
            each.sentence,
        )
        for each in again.diagnoses
    ]
    parts.append(Table(["recording", "result", "effects", "confidence", "in words"], rows))
    names = list(dict.fromkeys(e.recording for p in again.parameters for e in p.estimates))
    lines = []
    for each in again.parameters:
        by = {estimate.recording: estimate for estimate in each.estimates}
        cells = [
            f"{by[n].value:.4g} ({by[n].low:.4g} to {by[n].high:.4g})" if n in by else "-"
            for n in names
        ]
        chance = "-" if each.p_value is None else f"{each.p_value:.2g}"
        agree = "-" if each.agree is None else _yes(each.agree)
        lines.append((each.effect, each.name, *cells, chance, agree, _yes(each.identifiable)))
    if lines:
        header = ["effect", "parameter", *names, "p of equal values", "agree", "identifiable"]
        parts.append(Table(header, lines, title="Parameters of each recording, 95 % intervals"))
    return Section("Test and retest", parts)


def _applicability(found: Assessment) -> Section:
    inside = found.applicability
    if inside is None:
        text = "No scenario is given ([scenario] states), so applicability was not assessed."
        return Section("Applicability", [Text(text)])
    shares = [("pressures", inside.pressures), ("rates", inside.rates)]
    shares += [
        ("poses", inside.poses),
        ("loads", inside.loads),
        ("all that is known", inside.whole),
    ]
    rows = [(name, "not known" if v is None else Share(v)) for name, v in shares]
    return Section(
        "Applicability",
        [
            Text(inside.sentence[:1].upper() + inside.sentence[1:] + "."),
            Table(["states inside the validated domain", "share"], rows),
            Text(f"States from {', '.join(inside.labels)}."),
            Gallery(_domain_charts(inside, found.table.spec.unit)),
        ],
    )


def _domain_charts(inside: Applicability, unit: str) -> list[Picture]:
    """Pressures, rates and poses: validated in grey, the scenario inside and outside."""
    known, asked = inside.validated, inside.states
    second = min(1, known.pressure.shape[1] - 1)
    drawn = [
        _scatter(
            (known.pressure[:, [0, second]], asked.pressure[:, [0, second]]),
            inside.inside,
            (f"channel 1 [{unit}]", f"channel {second + 1} [{unit}]"),
            "Pressures",
        )
    ]
    if np.isfinite(known.rate).any() and np.isfinite(asked.rate).any():
        drawn.append(
            _scatter(
                (known.rate[:, [0, second]], asked.rate[:, [0, second]]),
                inside.inside,
                (f"channel 1 [{unit}/s]", f"channel {second + 1} [{unit}/s]"),
                "Rates",
            )
        )
    if inside.poses is not None and known.points_mm is not None and asked.points_mm is not None:
        tips = (known.points_mm[:, -1], asked.points_mm[:, -1])
        for axes, title in (((0, 1), "Tip, across"), ((0, 2), "Tip, along")):
            names = tuple(f"{'xyz'[k]} [mm], base frame" for k in axes)
            pair = (tips[0][:, axes], tips[1][:, axes])
            drawn.append(_scatter(pair, inside.inside, (names[0], names[1]), title))
    return drawn


def _scatter(points, inside: np.ndarray, names: tuple[str, str], title: str) -> Picture:
    from matplotlib import pyplot as plt

    figure, axis = plt.subplots(figsize=CHART)
    known, asked = points
    few = known[:: max(1, len(known) // DRAWN)]
    axis.scatter(few[:, 0], few[:, 1], s=3, c="#8a949e", lw=0, rasterized=True, label="validated")
    step = max(1, len(asked) // DRAWN)
    for held, colour, name in ((True, GREEN, "scenario, inside"), (False, RED, "outside")):
        some = asked[::step][inside[::step] == held]
        if len(some):
            axis.scatter(some[:, 0], some[:, 1], s=4, c=colour, lw=0, rasterized=True, label=name)
    axis.set_xlabel(names[0])
    axis.set_ylabel(names[1])
    figure.legend(loc="outside lower center", ncols=3, fontsize=8, markerscale=2)
    axis.set_title(title)
    return chart(figure, f"{title}: validated states and states of the scenario")


def _scenario(found: Assessment) -> list[Section]:
    if not found.outcomes:
        return []
    rows = []
    for each in found.outcomes:
        spread = "-" if each.uncertainty is None else f"{each.uncertainty:.3g}"
        within = "-"
        if each.uncertainty is not None:
            within = "yes" if abs(each.error) > each.uncertainty else "no"
        count = f"{each.episodes[0]} / {each.episodes[1]}"
        error, area = f"{each.error:+.3g}", f"{each.area:.3g}"
        rows.append((each.name, each.simulated, each.rig, count, error, spread, within, area))
    header = ["number", "simulation", "rig", "episodes", "E of the means", "U_val (95 %)"]
    header += ["|E| > U_val", "area metric"]
    text = (
        "The scenario in simulation against the same on the rig: E is the difference of the means "
        "over episodes, U_val comes from their scatter, numbers in the unit of the first column."
    )
    return [Section("The scenario in simulation and on the rig", [Text(text), Table(header, rows)])]


def _software(found: Assessment) -> Section:
    parts: list = [Table(["software", "version"], list(found.software.items()))]
    if COMMIT not in found.software:
        parts.append(Text("The commit of the source code is not known."))
    parts.append(Text(TESTS))
    if found.agreement is not None:
        text = found.agreement.sentence
        parts.append(Text(text[:1].upper() + text[1:] + "."))
    return Section("Software", parts)
