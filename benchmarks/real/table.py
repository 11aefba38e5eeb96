"""Tables of the benchmark `real` as Markdown."""

import math
from collections.abc import Sequence

from benchmarks.real.study import CLAIMED, CLAIMING, MOST_NAMES, NAMING, Outcome

HEADER = (
    "| entry | change | truth | verdict | names | conf. | truth named | error mm "
    "| held out mm | amended mm | with the truth mm | best achievable mm | validated mm | s |",
    "|---|---|---|---|---|---|---|---|---|---|---|---|---|---|",
)
ERRORS = (
    "*error* is the error of the given model on the training rows of the recordings after the "
    "change. *held out*, *amended* and *with the truth* are errors on the held-out quarter: "
    "without an added effect, with the named effects and with the true ones. Where effects were "
    "fitted together with the network, *held out* is the error of the network alone, trained "
    "for as many epochs."
)
"""What the columns of errors say."""
NAMED_GOAL = 0.9
"""Share of the known changes that are to be named alone or in a set of two (goal)."""


def markdown(outcomes: Sequence[Outcome]) -> str:
    """The entries' table, the summary beside the goals, and the sources."""
    ran = [outcome for outcome in outcomes if outcome.answer]
    lines = [*HEADER, *(row_of(outcome) for outcome in outcomes), "", *summary(ran)]
    lines += ["", ERRORS, "", "## Verdicts in words", ""]
    lines += [f"- `{o.entry.name}`: {o.answer.sentence}" for o in ran if o.answer]
    lines += ["", "## Robots, sources, licences", ""]
    about = dict.fromkeys(
        f"- {o.entry.robot}: {o.entry.source} ({o.entry.licence})" for o in outcomes
    )
    lines += about
    notes = [f"- `{o.entry.name}`: {o.entry.note}" for o in outcomes if o.entry.note]
    if notes:
        lines += ["", "## Notes on the entries", "", *notes]
    return "\n".join(lines) + "\n"


def row_of(outcome: Outcome) -> str:
    """One entry as a row."""
    entry, answer = outcome.entry, outcome.answer
    truth = " + ".join(entry.truth) or "nothing changed"
    truth += f": {' + '.join(entry.faults)}" if entry.faults else ""
    if answer is None:
        return (
            f"| {entry.name} | {entry.change} | {truth} | skipped: {outcome.skipped} |" + 10 * " |"
        )
    joint = " or " if answer.kind == "ambiguous" else " + "
    cells = [
        entry.name,
        entry.change,
        truth,
        answer.kind,
        joint.join(answer.names if answer.kind in NAMING else answer.faults),
        f"{answer.confidence:.2f}",
        "yes" if outcome.named else "no",
        _mm(answer.before_mm),
        _mm(outcome.held_out_mm),
        _mm(outcome.amended_mm),
        _mm(outcome.oracle_mm),
        _mm(answer.best_mm),
        f"{answer.validated_mm:.2f}",
        f"{answer.seconds:.0f}",
    ]
    return f"| {' | '.join(cells)} |"


def _mm(value: float | None) -> str:
    return "-" if value is None or not math.isfinite(value) else f"{value:.2f}"


def summary(ran: Sequence[Outcome]) -> list[str]:
    """Counts beside the goals."""
    known = [o for o in ran if o.entry.truth]
    clean = [o for o in ran if not o.entry.truth]
    alone = [o for o in known if o.named and o.answer and len(o.answer.names) == len(o.entry.truth)]
    first = [o for o in known if o.answer and set(o.answer.ranking[:1]) & set(o.entry.truth)]
    called = [o for o in clean if not o.named]
    return [
        "| | found | goal |",
        "|---|---|---|",
        f"| known change named, alone or in a set of {MOST_NAMES} | "
        f"{sum(o.named for o in known)} of {len(known)} | {NAMED_GOAL:.0%} |",
        f"| known change named alone | {len(alone)} of {len(known)} | |",
        f"| true effect first in the ranking | {len(first)} of {len(known)} | |",
        f"| wrong name with confidence >= {CLAIMED} | {sum(o.misled for o in ran)} of {len(ran)} "
        "| 0 |",
        f"| effect named where nothing changed | {sum(_names(o) for o in called)} of {len(clean)} "
        "| 0 |",
        f"| unknown effect reported where nothing changed | "
        f"{sum(not _names(o) for o in called)} of {len(clean)} | |",
    ]


def _names(outcome: Outcome) -> bool:
    return outcome.answer is not None and outcome.answer.kind in CLAIMING
