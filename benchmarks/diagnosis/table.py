"""Tables of the diagnosis benchmark: goals and results, confusion matrix, reliability diagram."""

import itertools
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy import stats

from benchmarks.diagnosis.after_table import (
    after_rows,
    amendments,
    experiments,
    outside,
    rate,
)
from benchmarks.diagnosis.cases import MEMORY
from benchmarks.diagnosis.study import Outcome

SURE = 0.95
"""Least confidence of a statement that counts as sure."""
BINS = (0.0, 0.5, 0.8, 0.9, 0.95, 1.0)
"""Bins of the reliability diagram."""
OTHER, UNDERTRAINED = "unknown_effect", "surrogate_undertrained"
NAMING = ("identified", "several", "ambiguous")
"""Kinds of verdict that name an effect."""


def markdown(outcomes: list[Outcome]) -> str:
    """All tables as Markdown."""
    parts = [
        _goals(outcomes),
        _confusion(outcomes),
        outside(outcomes),
        experiments(outcomes),
        amendments(outcomes),
        _reliability(outcomes),
    ]
    return "\n\n".join(part for part in parts if part) + "\n"


def single(outcomes: list[Outcome]) -> list[Outcome]:
    """Cases with one hidden effect of the list and a trained surrogate."""
    return [o for o in outcomes if o.case.single]


def first_right(outcome: Outcome, among: int = 1) -> bool:
    """Whether a hidden effect is among the first of the ranking."""
    return outcome.case.truth[0] in outcome.ranking[:among]


def statement_right(outcome: Outcome) -> bool:
    """Whether what is stated is right: the effect is hidden, all of several, or one of a set."""
    hits = [name in outcome.case.truth for name in outcome.effects]
    return bool(hits) and (any(hits) if outcome.kind == "ambiguous" else all(hits))


def named_alone(outcome: Outcome) -> bool:
    """Whether the verdict names the hidden effect and no other."""
    return outcome.kind == "identified" and outcome.effects == outcome.case.truth


def named(outcome: Outcome) -> bool:
    """Whether the verdict names the hidden effect, alone or in a set."""
    return outcome.kind in NAMING and bool(set(outcome.effects) & set(outcome.case.truth))


def both_named(outcome: Outcome) -> bool:
    """Whether the verdict states that two effects are missing, and names exactly those hidden."""
    return outcome.kind == "several" and sorted(outcome.effects) == sorted(outcome.case.truth)


def _goals(outcomes: list[Outcome]) -> str:
    some = single(outcomes)
    at_least = [o for o in some if o.effect_mm >= o.discrepancy_mm]
    twice = [o for o in some if o.effect_mm >= 2 * o.discrepancy_mm]
    rich = [o for o in at_least if o.case.excitation == "rich"]
    clean = [o for o in outcomes if not o.case.hidden and not o.case.undertrained]
    unknown = [o for o in outcomes if "unknown" in o.case.truth]
    seen = [o for o in unknown if o.effect_mm >= o.discrepancy_mm]
    known = [o for o in outcomes if "unknown" not in o.case.truth and not o.case.undertrained]
    under = [o for o in outcomes if o.case.undertrained]
    pairs = [o for o in outcomes if len(o.case.hidden) == 2]
    naming = [o for o in outcomes if o.kind in NAMING]
    sure = [o for o in naming if o.confidence >= SURE]
    extra = [len(set(o.effects) - set(o.case.truth)) for o in pairs if o.kind == "several"]

    lines = ["| measure | goal | measured |", "|---|---|---|"]

    def row(what: str, goal: str, some: list[Outcome], hit: Callable[[Outcome], bool]) -> None:
        lines.append(f"| {what} | {goal} | {rate([hit(o) for o in some])} |")

    def split(some: list[Outcome], memory: bool) -> list[Outcome]:
        return [o for o in some if (o.case.truth[0] in MEMORY) == memory]

    row("right effect first, memory effects", "97 %", split(at_least, True), first_right)
    row("right effect first, static effects", "85 %", split(at_least, False), first_right)
    row("the verdict names it alone, memory effects", "", split(at_least, True), named_alone)
    row("the verdict names it alone, static effects", "", split(at_least, False), named_alone)
    row("the verdict names it, alone or in a set", "90 %", at_least, named)
    row("the same, ten rich minutes, memory", "", split(rich, True), first_right)
    row("the same, ten rich minutes, static", "", split(rich, False), first_right)
    row("right first, at least twice the surrogate's error", "95 %", twice, first_right)
    row("right among the first two, as before", "97 %", twice, lambda o: first_right(o, 2))
    row("an effect named on a clean robot", "2 %", clean, lambda o: o.kind in NAMING)
    row("statements with confidence >= 0.95 right", "97 %", sure, statement_right)
    row("outside the list: `unknown_effect`", "80 %", unknown, lambda o: o.kind == OTHER)
    row("the same, at least the surrogate's error", "", seen, lambda o: o.kind == OTHER)
    row("called so though in the list, or clean", "5 %", known, lambda o: o.kind == OTHER)
    row("two at once, both named", "85 %", pairs, both_named)
    row("undertrained surrogate called so", "", under, lambda o: o.kind == UNDERTRAINED)
    error = calibration_error(naming)
    lines.append(f"| calibration error of the confidence | 0.05 | {error:.3f} |")
    need = clean_needed(0.02)
    enough = f"{len(clean)} of {need}" + ("" if len(clean) >= need else ": too few for the goal")
    lines.append(f"| clean robots; none named of so many shows less than 2 % | {need} | {enough} |")
    mean = float(np.mean(extra)) if extra else 0.0
    lines.append(f"| effects too many, a pair called `several` | 0.1 | {mean:.2f} |")
    seconds = [o.seconds for o in outcomes if o.case.excitation == "rich"]
    if seconds:
        middle, most = np.median(seconds), np.max(seconds)
        lines.append(
            f"| processor time for ten minutes at 20 Hz | 5 s | median {middle:.1f} s, "
            f"longest {most:.1f} s |"
        )
    static = split(at_least, False)
    lines += [
        f"| {what} | {goal} | {said} |" for what, goal, said in after_rows(outcomes, some, static)
    ]
    return "## Goals\n\n" + "\n".join(lines)


def clean_needed(most: float) -> int:
    """Cases without a hit from which the upper end of Wilson's 95 % interval is below `most`.

    With no hit of n that end is z^2 / (n + z^2).
    """
    z2 = float(stats.norm.ppf(0.975)) ** 2
    return int(np.ceil(z2 * (1.0 / most - 1.0)))


def calibration_error(named: list[Outcome]) -> float:
    """Expected calibration error over BINS (Naeini et al. 2015)."""
    if not named:
        return 0.0
    sure = np.array([o.confidence for o in named])
    right = np.array([statement_right(o) for o in named])
    place = np.clip(np.searchsorted(BINS, sure, side="right") - 1, 0, len(BINS) - 2)
    total = 0.0
    for b in range(len(BINS) - 1):
        rows = place == b
        if rows.any():
            total += rows.mean() * abs(sure[rows].mean() - right[rows].mean())
    return float(total)


def _reliability(outcomes: list[Outcome]) -> str:
    named = [o for o in outcomes if o.kind in NAMING]
    lines = ["| confidence | statements | mean confidence | right |", "|---|---|---|---|"]
    for b in range(len(BINS) - 1):
        last = b == len(BINS) - 2
        rows = [
            o
            for o in named
            if BINS[b] <= o.confidence < BINS[b + 1] or (last and o.confidence == 1)
        ]
        if rows:
            mean = np.mean([o.confidence for o in rows])
            right = np.mean([statement_right(o) for o in rows])
            lines.append(
                f"| {BINS[b]:g} to {BINS[b + 1]:g} | {len(rows)} | {mean:.2f} | {right:.2f} |"
            )
    return "## Reliability\n\n" + "\n".join(lines)


def _confusion(outcomes: list[Outcome]) -> str:
    """Confusion matrix: hidden effect by the first effect named, or the kind of verdict."""
    table: dict[str, Counter] = {}
    for o in outcomes:
        if len(o.case.hidden) > 1:
            continue
        hidden = o.case.hidden[0][0] if o.case.hidden else "clean"
        hidden = "undertrained" if o.case.undertrained else hidden
        said = o.effects[0] if o.effects else o.kind
        said += " ?" if o.kind == "ambiguous" else ""
        table.setdefault(hidden, Counter())[said] += 1
    lines = ["| hidden | result (times) |", "|---|---|"]
    for hidden in sorted(table):
        said = ", ".join(f"{name} {count}" for name, count in table[hidden].most_common())
        lines.append(f"| {hidden} | {said} |")
    return (
        "## Confusion\n\nA question mark: called ambiguous, with this one first.\n\n"
        + "\n".join(lines)
    )


def draw(outcomes: list[Outcome], folder: Path) -> Path:
    """Draw the reliability diagram; returns the path of the picture."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    named = [o for o in outcomes if o.kind in NAMING]
    sure = np.array([o.confidence for o in named])
    right = np.array([statement_right(o) for o in named])
    figure, axis = plt.subplots(figsize=(4.6, 3.6), layout="constrained")
    axis.plot([0, 1], [0, 1], c="#888888", lw=1, label="calibrated")
    for low, high in itertools.pairwise(BINS):
        rows = (sure >= low) & ((sure < high) | (high == 1))
        if rows.any():
            share = right[rows].mean()
            ends = stats.binomtest(int(right[rows].sum()), int(rows.sum())).proportion_ci(
                method="wilson"
            )
            axis.plot([sure[rows].mean()] * 2, ends, c="#3b82c4", lw=1.2)
            axis.plot(sure[rows].mean(), share, "o", c="#3b82c4")
            axis.annotate(f" {rows.sum()}", (sure[rows].mean(), share), fontsize=8)
    axis.set_xlabel("confidence of the first effect named")
    axis.set_ylabel("share that is right (95 % interval)")
    axis.set_ylim(-0.04, 1.08)
    axis.legend(frameon=False)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "diagnosis_reliability.png"
    figure.savefig(path, dpi=130)
    plt.close(figure)
    return path
