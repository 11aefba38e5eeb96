"""Tables of the diagnosis benchmark on recommended experiments, amendments and unknown effects."""

from collections import Counter

import numpy as np
from scipy import stats

from benchmarks.diagnosis.experiment import Settled
from benchmarks.diagnosis.study import Outcome
from surgisoft.diagnosis.design.schedules import AS_IT_STANDS

SHOWS = 1.1
"""Least factor by which a hidden effect must raise the error of the held-out quarter."""


def rate(hits: list[bool]) -> str:
    """Share with its Wilson interval and the count."""
    if not hits:
        return "none tried"
    low, high = stats.binomtest(sum(hits), len(hits)).proportion_ci(method="wilson")
    share = 100 * sum(hits) / len(hits)
    return f"{share:.1f} % ({sum(hits)} of {len(hits)}; {100 * low:.0f} to {100 * high:.0f} %)"


def open_cases(some: list[Outcome]) -> list[Outcome]:
    """All cases with the verdict ambiguous and a recorded experiment, whatever is hidden.

    An experiment that leaves a case open, or whose competing effects did not hold the hidden one,
    has not named the right one.
    """
    return [o for o in some if o.settled is not None]


def right_after(outcome: Outcome) -> bool:
    """Whether the hidden effect ranks first after the experiment of an ambiguous case."""
    if outcome.settled is not None:
        return outcome.settled.first == outcome.case.truth[0]
    return outcome.ranking[:1] == outcome.case.truth


def judged_amendments(some: list[Outcome]) -> list[Outcome]:
    """Cases with an attempted amendment and a hidden effect no smaller than the model discrepancy.

    The effect must also raise the error of the held-out quarter, or no fall could show.
    """
    return [
        o
        for o in some
        if o.amended is not None
        and o.effect_mm >= o.discrepancy_mm
        and o.amended.before >= SHOWS * o.amended.oracle
    ]


def after_rows(
    every: list[Outcome], some: list[Outcome], static: list[Outcome]
) -> list[tuple[str, str, str]]:
    """Rows (measure, goal, measured) about what follows a diagnosis.

    every: all cases; some: those with one effect of the list; static: those of a static effect at
    least as large as the surrogate's error.
    """
    asked = open_cases(every)
    rows = [
        (
            "ambiguous: the recommended experiment names the right one",
            "90 %",
            rate([_right(o, o.settled) for o in asked]),
        ),
        (
            "the same where nobody may change the bench",
            "",
            rate([_right(o, o.settled_untouched) for o in asked]),
        ),
    ]
    if asked:
        wrong = [o.settled.effect is not None and not _right(o, o.settled) for o in asked]
        minutes = [o.settled.minutes for o in asked]
        rows += [
            ("ambiguous: the experiment names a wrong one", "", rate(wrong)),
            (
                "minutes on the bench",
                "15",
                f"median {np.median(minutes):.1f}, longest {np.max(minutes):.1f}",
            ),
        ]
    rows.append(
        (
            "right first, static effects, after the experiment",
            "95 %",
            rate(list(map(right_after, static))),
        )
    )
    judged = judged_amendments(some)
    if judged:
        rows.append(("fall of the error by `amend`, share of the oracle's", "95 %", _fall(judged)))
    return rows


def _right(outcome: Outcome, settled: Settled) -> bool:
    return settled.effect is not None and settled.effect in outcome.case.truth


def pooled_share(judged: list[Outcome]) -> float:
    """Ratio of the summed falls of the error to those of the oracle."""
    falls = [(o.amended.before - o.amended.after) for o in judged]
    best = [(o.amended.before - o.amended.oracle) for o in judged]
    return float(np.sum(falls) / np.sum(best))


def _fall(judged: list[Outcome]) -> str:
    middle = np.median([o.amended.share for o in judged])
    right = [o for o in judged if o.amended.effects == o.case.truth]
    text = f"median {100 * middle:.0f} %, pooled {100 * pooled_share(judged):.0f} %"
    text += f" ({len(judged)} cases"
    if right and len(right) < len(judged):
        known = np.median([o.amended.share for o in right])
        text += f"; median of the {len(right)} that had the right name alone {100 * known:.0f} %"
    return text + ")"


def _best_gain(outcome: Outcome) -> float:
    """Share of what can be explained that the best effect of the list explains alone."""
    return max((one["gain"] for one in outcome.statistics["effects"]), default=0.0)


def outside(outcomes: list[Outcome]) -> str:
    """Verdicts on effects outside the list, and how well the nearest known one imitates them."""
    kinds: dict[str, list[Outcome]] = {}
    for o in outcomes:
        if o.case.truth == ("unknown",):
            kinds.setdefault(o.case.hidden[0][0], []).append(o)
    if not kinds:
        return ""
    lines = [
        "| hidden | called `unknown_effect` | nearest of the list | it explains, median |",
        "|---|---|---|---|",
    ]
    for name, some in sorted(kinds.items()):
        called = sum(o.kind == "unknown_effect" for o in some)
        nearest = Counter(o.ranking[0] for o in some if o.ranking).most_common(1)
        share = np.median([_best_gain(o) for o in some])
        lines.append(
            f"| {name} | {called} of {len(some)} | {nearest[0][0] if nearest else ''} "
            f"| {100 * share:.0f} % |"
        )
    note = "What the best effect of the list explains alone of the held-out error above the floor."
    return f"## Outside the list\n\n{note}\n\n" + "\n".join(lines)


def experiments(outcomes: list[Outcome]) -> str:
    """Table of every ambiguous case with its experiment."""
    asked = [o for o in outcomes if o.settled is not None]
    if not asked:
        return ""
    lines = [
        "| hidden | competing | experiment | min | expected | result | bench untouched |",
        "|---|---|---|---|---|---|---|",
    ]
    for o in asked:
        said, kept = o.settled, o.settled_untouched
        same = said.setting == AS_IT_STANDS
        lines.append(
            f"| {', '.join(name for name, _ in o.case.hidden) or 'clean'} | {', '.join(o.effects)} "
            f"| {said.experiment} | {said.minutes:g} | {said.expected:.2f} "
            f"| {said.effect or 'open'} "
            f"| {'the same' if same or kept is None else kept.effect or 'open'} |"
        )
    return "## Recommended experiments\n\n" + "\n".join(lines)


def amendments(outcomes: list[Outcome]) -> str:
    """Mean errors before and after, and of the oracle, for each hidden effect."""
    kinds: dict[str, list[Outcome]] = {}
    for o in judged_amendments(outcomes):
        kinds.setdefault(o.case.hidden[0][0], []).append(o)
    if not kinds:
        return ""
    lines = ["| hidden | amended by (times) | before | after | oracle | share |"]
    lines.append("|---|---|---|---|---|---|")
    for name, some in sorted(kinds.items()):
        by = Counter(" + ".join(o.amended.effects) or "nothing" for o in some)
        levels = [
            np.mean([getattr(o.amended, key) for o in some])
            for key in ("before", "after", "oracle")
        ]
        numbers = " | ".join(f"{level:.3f}" for level in levels)
        what = ", ".join(f"{effect} {count}" for effect, count in by.most_common())
        lines.append(f"| {name} | {what} | {numbers} | {100 * pooled_share(some):.0f} % |")
    note = (
        "Errors in mm on the held-out quarter. Oracle: the same model on the same robot with "
        "nothing hidden, re-tuned where that pays. Share: of the oracle's fall."
    )
    return f"## Amendments\n\n{note}\n\n" + "\n".join(lines)
