"""Report of the decision: each source judged with the whole source left out of the fit."""

import itertools
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from benchmarks.decision.evidence_log import Labelled, in_order
from benchmarks.decision.fit import (
    OFF,
    WEAK,
    fit,
    model_of,
    names_truth,
    names_wrongly,
)
from surgisoft.diagnosis.criteria import WORTH, Worth
from surgisoft.diagnosis.decision import NAMING, Decision, DecisionModel, decide

BINS = (0.0, 0.5, 0.8, 0.9, 0.95, 1.0)
"""Bins of the reliability table."""
SURE = 0.95
"""Least confidence of a statement that counts as sure."""
COSTS = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 8.0)
"""Costs of a wrong name of the trade-off, in units of what a right one gains."""
SERIOUS = 0.8
"""Least confidence from which a wrong name is serious."""
QUIET = ("nothing_missing", "surrogate_undertrained")
"""Kinds of result that say that nothing is missing from the list."""


@dataclass(frozen=True)
class Judged:
    """A case and what was decided of it."""

    case: Labelled
    decision: Decision

    @property
    def right(self) -> bool:
        """Whether the statement is right: the named effect is missing, one of the set, both of two;
        something unknown; nothing, or too little to be seen."""
        kind, case = self.decision.kind, self.case
        if kind in NAMING:
            return not names_wrongly(case, self.decision)
        if kind == "unknown_effect":
            return case.label == "unknown"
        return case.label not in ("known", "unknown") or case.size < WEAK

    @property
    def first(self) -> str | None:
        """The most probable effect."""
        return next(iter(self.decision.probabilities.effects), None)

    @property
    def names_truth(self) -> bool:
        """Whether the result names the missing effect, alone, as one of two, or in a set of two."""
        return names_truth(self.case, self.decision)


def judged(cases: Sequence[Labelled], model: DecisionModel, worth: Worth = WORTH) -> list[Judged]:
    """What a fitted decision says of cases."""
    return [Judged(case, decide(case.evidence, model, worth)) for case in cases]


def fits_without(cases: Sequence[Labelled]) -> dict[str, DecisionModel]:
    """For each source the decision that is fitted to the others."""
    answer = {}
    for source in sorted({case.source for case in cases}):
        others = [case for case in cases if case.source != source]
        if others:
            answer[source] = model_of(fit(others))
    return answer


def left_out(
    cases: Sequence[Labelled], models: dict[str, DecisionModel] | None = None
) -> dict[str, list[Judged]]:
    """For each source what a decision that was fitted to the others says of it."""
    models = fits_without(cases) if models is None else models
    return {
        source: judged([case for case in cases if case.source == source], model)
        for source, model in models.items()
    }


def robots_left_out(cases: Sequence[Labelled], alone: Sequence[Labelled] = ()) -> list[Judged]:
    """Each robot judged by a decision that was fitted to all other robots of all sources.

    alone: cases that take part in fits and are not judged.
    """
    answer = []
    for source, robot in sorted({(case.source, case.robot) for case in cases}):
        own = [case for case in cases if (case.source, case.robot) == (source, robot)]
        others = [case for case in (*cases, *alone) if (case.source, case.robot) != (source, robot)]
        answer += judged(own, model_of(fit(in_order(others))))
    return answer


def default_models(cases: Sequence[Labelled], default: bool = True) -> list[Labelled]:
    """The cases of default models, and of sources that have none; or, without default, the others:
    of networks alone in sources that have both."""
    both = {case.source for case in cases if case.models == "default"}
    return [
        case for case in cases if (case.models == "default" or case.source not in both) == default
    ]


def rate(hits: Sequence[bool]) -> str:
    """Share with number and 95 % interval (Wilson 1927), as a table's cell."""
    if not hits:
        return "-"
    found = stats.binomtest(int(sum(hits)), len(hits)).proportion_ci(method="wilson")
    share = 100 * sum(hits) / len(hits)
    return (
        f"{share:.0f} % ({sum(hits)} of {len(hits)}; {100 * found.low:.0f}-{100 * found.high:.0f})"
    )


def calibration_error(confidence: np.ndarray, right: np.ndarray) -> float:
    """Expected calibration error over BINS (Naeini et al. 2015)."""
    if not len(confidence):
        return 0.0
    total = 0.0
    for low, high in itertools.pairwise(BINS):
        rows = (confidence >= low) & ((confidence < high) | (high == 1.0))
        if rows.any():
            total += rows.mean() * abs(confidence[rows].mean() - right[rows].mean())
    return float(total)


Test = Callable[[Judged], bool]

ROWS: tuple[tuple[str, str, Test, Test], ...] = (
    (
        "right effect first, memory",
        "97 %",
        lambda j: _single(j) and j.case.memory,
        lambda j: j.first in j.case.truth,
    ),
    (
        "right effect first, static",
        "95 %",
        lambda j: _single(j) and not j.case.memory,
        lambda j: j.first in j.case.truth,
    ),
    ("named, alone or in a set of two", "90 %", lambda j: _single(j), lambda j: j.names_truth),
    (
        "named alone",
        "",
        lambda j: _single(j),
        lambda j: j.decision.kind == "identified" and j.names_truth,
    ),
    (
        "statements with confidence >= 0.95 right",
        "97 %",
        lambda j: j.decision.kind in NAMING and j.decision.confidence >= SURE,
        lambda j: j.right,
    ),
    (
        "a wrong name with confidence >= 0.8, of all cases",
        "0",
        lambda j: True,
        lambda j: j.decision.kind in NAMING and j.decision.confidence >= SERIOUS and not j.right,
    ),
    (
        "unknown called unknown",
        "80 %",
        lambda j: j.case.label == "unknown",
        lambda j: j.decision.kind == "unknown_effect",
    ),
    (
        "the same, as large as the validated error",
        "",
        lambda j: j.case.label == "unknown" and j.case.size >= 1.0,
        lambda j: j.decision.kind == "unknown_effect",
    ),
    (
        "known or nothing called unknown",
        "5 %",
        lambda j: j.case.label in ("known", "clean"),
        lambda j: j.decision.kind == "unknown_effect",
    ),
    (
        "an effect named on a clean robot",
        "2 %",
        lambda j: j.case.label == "clean",
        lambda j: j.decision.kind in NAMING,
    ),
    (
        "an effect named where the network is off",
        "",
        lambda j: j.case.label in OFF,
        lambda j: j.decision.kind in NAMING,
    ),
    (
        "two effects, both named",
        "85 %",
        lambda j: j.case.label == "known" and len(j.case.truth) == 2,
        lambda j: set(j.case.truth) <= set(j.decision.effects) and j.decision.kind == "several",
    ),
    (
        "`nothing_missing` though something as large as the validated error is",
        "0",
        lambda j: j.case.label in ("known", "unknown") and j.case.size >= 1.0,
        lambda j: j.decision.kind == "nothing_missing",
    ),
    ("`cannot_tell`", "", lambda j: True, lambda j: j.decision.kind == "cannot_tell"),
    (
        "wrong statements of any kind",
        "",
        lambda j: True,
        lambda j: j.decision.kind != "cannot_tell" and not j.right,
    ),
)
"""(what is counted, goal, of which real cases, which of them)."""
TWIN_ROWS: tuple[tuple[str, str, Test, Test], ...] = (
    (
        "a known effect that was no candidate: called unknown",
        "",
        lambda j: True,
        lambda j: j.decision.kind == "unknown_effect",
    ),
    (
        "a known effect that was no candidate: another one named",
        "",
        lambda j: True,
        lambda j: j.decision.kind in NAMING,
    ),
)
"""The same of cases whose truth was no candidate (`without_truth`)."""


def _single(one: Judged) -> bool:
    """One effect of the list is missing, at least as large as the validated error."""
    return one.case.label == "known" and len(one.case.truth) == 1 and one.case.size >= 1.0


def real(some: Sequence[Judged]) -> list[Judged]:
    """Without the cases whose truth was no candidate."""
    return [one for one in some if not one.case.left_out]


def goals(columns: dict[str, list[Judged]]) -> str:
    """Table of the goals, one column for each group of cases."""
    head = "| measure | goal | " + " | ".join(columns) + " |"
    lines = [head, "|---|---|" + "---|" * len(columns)]
    parts = [(ROWS, [real(some) for some in columns.values()])]
    twins = [[one for one in some if one.case.left_out] for some in columns.values()]
    parts += [(TWIN_ROWS, twins)] if any(twins) else []
    for rows, groups in parts:
        for what, goal, of, hit in rows:
            cells = [rate([hit(one) for one in some if of(one)]) for some in groups]
            lines.append(f"| {what} | {goal} | {' | '.join(cells)} |")
    errors, seconds = [], []
    for some in parts[0][1]:
        named = [one for one in some if one.decision.kind in NAMING]
        sure = np.array([one.decision.confidence for one in named])
        errors.append(f"{calibration_error(sure, np.array([one.right for one in named])):.3f}")
        seconds.append(f"{np.median([one.case.seconds for one in some]):.1f} s")
    lines.append(f"| calibration error of the confidence in a name | 0.05 | {' | '.join(errors)} |")
    lines.append(f"| processor time of a diagnosis, median | 5 s | {' | '.join(seconds)} |")
    return "\n".join(lines)


def reliability(some: Sequence[Judged]) -> str:
    """How often statements of each confidence were right."""
    lines = ["| confidence | statements | mean confidence | right |", "|---|---|---|---|"]
    stated = [one for one in real(some) if one.decision.kind in NAMING]
    for low, high in itertools.pairwise(BINS):
        rows = [
            one
            for one in stated
            if low <= one.decision.confidence < high or (high == 1.0 == one.decision.confidence)
        ]
        if rows:
            mean = np.mean([one.decision.confidence for one in rows])
            right = rate([one.right for one in rows])
            lines.append(f"| {low:g} to {high:g} | {len(rows)} | {mean:.2f} | {right} |")
    return "\n".join(lines)


def kinds(some: Sequence[Judged]) -> str:
    """What is true by what was said."""
    table: dict[str, Counter] = {}
    for one in real(some):
        label = one.case.label
        if label == "known":
            label = "two effects" if len(one.case.truth) == 2 else "one effect"
        said = one.decision.kind
        if said in NAMING:
            said += "" if one.right else " (wrong)"
        table.setdefault(label, Counter())[said] += 1
    lines = ["| true | result (times) |", "|---|---|"]
    for label in sorted(table):
        said = ", ".join(f"{name} {count}" for name, count in table[label].most_common())
        lines.append(f"| {label.replace('_', ' ')} | {said} |")
    return "\n".join(lines)


def serious(some: Sequence[Judged]) -> str:
    """Every wrong name of at least the confidence SERIOUS, the surest first."""
    wrong = [
        one
        for one in real(some)
        if one.decision.kind in NAMING and one.decision.confidence >= SERIOUS and not one.right
    ]
    lines = ["| source | case | true | named | confidence | motions |", "|---|---|---|---|---|---|"]
    for one in sorted(wrong, key=lambda one: -one.decision.confidence):
        case, decision = one.case, one.decision
        joined = " and " if decision.kind == "several" else " or "
        lines.append(
            f"| {case.source} | {case.case} | {' and '.join(case.truth) or label_of(case)} "
            f"| {joined.join(decision.effects)} | {decision.confidence:.2f} "
            f"| {case.evidence.motions} |"
        )
    return "\n".join(lines) if wrong else "None."


def label_of(case: Labelled) -> str:
    """What is true of a case, in words."""
    return case.label.replace("_", " ")


def neighbours(some: Sequence[Judged]) -> str:
    """Results of cases in which the missing effect was no candidate, by that effect."""
    table: dict[str, list[Judged]] = {}
    for one in some:
        if len(one.case.left_out) == 1:
            table.setdefault(one.case.left_out[0], []).append(one)
    lines = ["| no candidate | cases | called unknown | named in its place (times) |"]
    lines += ["|---|---|---|---|"]
    for name in sorted(table):
        own = table[name]
        unknown = sum(one.decision.kind == "unknown_effect" for one in own)
        named = Counter(
            " or ".join(sorted(one.decision.effects))
            if one.decision.kind != "several"
            else " and ".join(sorted(one.decision.effects))
            for one in own
            if one.decision.kind in NAMING
        )
        text = ", ".join(f"{effects} {count}" for effects, count in named.most_common())
        lines.append(f"| {name} | {len(own)} | {unknown} | {text or '-'} |")
    return "\n".join(lines)


def weights(values: dict) -> str:
    """The fitted weights of an asset's values."""
    lines = ["| model | cases | without truth (weight of each) | ridge | constant and weights |"]
    lines += ["|---|---|---|---|---|"]
    for name, one in values["models"].items():
        text = ", ".join(f"{key} {value:+.2f}" for key, value in one["weights"].items())
        twins = f"{one['without_truth']} ({one['twin_weight']:g})" if one["without_truth"] else "-"
        lines.append(
            f"| {name} | {one['cases']} | {twins} | {one['penalty']:g} "
            f"| {one['constant']:+.2f}; {text} |"
        )
    return "\n".join(lines)


def sources(cases: Sequence[Labelled]) -> str:
    """Number of cases of each source by what is true."""
    lines = ["| source | robots | cases | of them | more without their truth |"]
    lines += ["|---|---|---|---|---|"]
    for source in sorted({case.source for case in cases}):
        own = [case for case in cases if case.source == source]
        count = Counter(label_of(c) for c in own if not c.left_out)
        text = ", ".join(f"{label} {number}" for label, number in count.most_common())
        robots, twins = len({case.robot for case in own}), sum(bool(c.left_out) for c in own)
        lines.append(f"| {source} | {robots} | {len(own) - twins} | {text} | {twins} |")
    return "\n".join(lines)


def trade_off(cases: Sequence[Labelled], models: dict[str, DecisionModel]) -> str:
    """What more caution costs: each source left out, names at several costs of a wrong one."""
    lines = [
        "| cost of a wrong name | least probability | one effect named | a wrong name | with "
        "confidence >= 0.8 | on a clean robot | where the network is off | unknown named | "
        "`cannot_tell` |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for cost in COSTS:
        some = []
        for source, model in models.items():
            own = [case for case in cases if case.source == source and not case.left_out]
            worth = replace(WORTH, wrong_name=-cost, needless_name=-cost)
            some += judged(own, model, worth)
        wrong = [one for one in some if one.decision.kind in NAMING and not one.right]
        named = {id(one) for one in some if one.decision.kind in NAMING}

        def share(of: Test, hit: Test, some: list[Judged] = some) -> str:
            rows = [hit(one) for one in some if of(one)]
            return f"{100 * np.mean(rows):.0f} % ({sum(rows)} of {len(rows)})" if rows else "-"

        def says(one: Judged, named: set = named) -> bool:
            return id(one) in named

        cells = [
            f"{cost:g}",
            f"{cost / (1.0 + cost):.2f}",
            share(_single, lambda one: one.names_truth),
            f"{len(wrong)} of {len(some)}",
            f"{sum(one.decision.confidence >= SERIOUS for one in wrong)} of {len(some)}",
            share(lambda one: one.case.label == "clean", says),
            share(lambda one: one.case.label in OFF, says),
            share(lambda one: one.case.label == "unknown", says),
            share(lambda one: True, lambda one: one.decision.kind == "cannot_tell"),
        ]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def curves(values: dict) -> str:
    """The fitted calibrations of an asset's values."""
    texts = [
        f"`{name}` {one['constant']:+.2f} {one['slope']:+.2f} x log odds"
        for name, one in values["calibration"].items()
    ]
    return f"Calibration: {'; '.join(texts)}."


def markdown(
    cases: Sequence[Labelled],
    values: dict,
    aside: Sequence[Labelled] = (),
    each_robot: bool = False,
) -> str:
    """The whole report.

    aside: cases that took no part in any fit; each_robot: whether each robot is left out, too,
    which takes one fit for each of them.
    """
    models, alone = fits_without(cases), default_models(cases, default=False)
    cases, aside_alone = default_models(cases), default_models(aside, default=False)
    aside = default_models(aside)
    by_source = left_out(cases, models)
    together = [one for some in by_source.values() for one in some]
    columns = by_source | ({"together": together} if len(by_source) > 1 else {})
    parts = ["## Cases", sources([*cases, *aside])]
    if alone or aside_alone:
        parts += ["### The same with networks alone", sources([*alone, *aside_alone])]
    if columns:
        parts += ["## Each source left out of the fit", goals(columns)]
        parts += ["### Results by true effect", kinds(together)]
        parts += ["### Reliability", reliability(together)]
        parts += ["### Wrong names with a confidence of 0.8 or more", serious(together)]
        if any(case.left_out for case in cases):
            parts += ["### Known effects that were no candidates", neighbours(together)]
        if alone:
            some = {name: own for name, own in left_out(alone, models).items() if own}
            columns = some | {"together": [one for own in some.values() for one in own]}
            parts += ["### The same cases with networks alone", goals(columns)]
        parts += ["### More or fewer names", trade_off(cases, models)]
    if aside:
        new = {f"{name}, fitted to all": some for name, some in _asides(aside, values).items()}
        for name in sorted({case.source for case in aside}):
            kin = next((source for source in models if name.startswith(source)), None)
            own = [case for case in aside if case.source == name]
            if kin:
                new[f"{name}, fitted without {kin}"] = judged(own, models[kin])
        parts += ["## Unseen robots", goals(new)]
        for name, some in new.items():
            parts += [f"### Results by true effect, {name}", kinds(some)]
        if aside_alone:
            parts += ["### The same unseen robots with networks alone"]
            parts += [goals(_asides(aside_alone, values))]
    if each_robot:
        inside = robots_left_out(cases, alone)
        parts += ["## Each robot left out of the fit", goals({"all sources": inside})]
        parts += ["### Results by true effect, robots left out", kinds(inside)]
    parts += ["## The fitted weights", weights(values), curves(values)]
    return "\n\n".join(parts) + "\n"


def _asides(aside: Sequence[Labelled], values: dict) -> dict[str, list[Judged]]:
    """Cases that took no part in any fit, judged by the fit to all others, by source."""
    model = model_of(values)
    names = sorted({case.source for case in aside})
    return {name: judged([c for c in aside if c.source == name], model) for name in names}
