"""What the values of the decision that are stated, not fitted, change in its results.

    python -m benchmarks.decision.stated_values

`Claim` and `Worth` of `surgisoft.diagnosis.criteria` hold conditions and costs that no fit chooses.
Each of them is halved and doubled (of a ratio that must exceed 1 the part above 1), and all cases
with stored evidence are decided again: those of the fit, and those in `judged/`, which took no part
in it. The fitted weights stay as they are.

Prints a table: cases with another result, and how many of them were right before and wrong after,
or the other way round (`table.Judged.right`; "cannot tell" counts as neither).
"""

from collections.abc import Iterator, Sequence
from dataclasses import fields, replace

from benchmarks.decision.evidence_log import EVIDENCE, JUDGED, Labelled, stored
from benchmarks.decision.table import Judged
from surgisoft.diagnosis.criteria import CLAIM, WORTH, Claim, Worth
from surgisoft.diagnosis.decision import (
    Decision,
    Probabilities,
    chosen,
    fitted_decision,
    probabilities,
)

FACTORS = (0.5, 2.0)
"""Factors on each value."""
MOST_PROBABLE = 0.99
"""Largest value of a probability that a factor gives."""


def verdict(case: Labelled, found: Decision) -> bool | None:
    """Whether a result is right; None for "cannot tell"."""
    return None if found.kind == "cannot_tell" else Judged(case, found).right


def changed(name: str, value: float, factor: float) -> float:
    """The value times the factor: of a ratio above 1 its part above 1, a probability below 1."""
    if name in {field.name for field in fields(Claim)}:
        return 1.0 + (value - 1.0) * factor
    return min(value * factor, MOST_PROBABLE) if name == "least_probability" else value * factor


def variants(worth: Worth = WORTH) -> Iterator[tuple[str, float, float, Worth, Claim]]:
    """Each stated value with each factor: (name, value, new value, costs, conditions)."""
    for given in (CLAIM, worth):
        for field in fields(given):
            value = getattr(given, field.name)
            if not value:
                continue
            for factor in FACTORS:
                other = changed(field.name, value, factor)
                new = replace(given, **{field.name: other})
                costs, claim = (worth, new) if isinstance(new, Claim) else (new, CLAIM)
                yield field.name, value, other, costs, claim


def row(
    some: Sequence[tuple[Labelled, Probabilities, Decision]], worth: Worth, claim: Claim
) -> str:
    """Cells of one group of cases: changed results, lost right ones, gained right ones."""
    other = [(case, was, chosen(case.evidence, p, worth, claim)) for case, p, was in some]
    moved = [
        (verdict(case, was), verdict(case, now))
        for case, was, now in other
        if (was.kind, was.effects) != (now.kind, now.effects)
    ]
    worse = sum(now is False for _, now in moved) - sum(was is False for was, _ in moved)
    better = sum(now is True for _, now in moved) - sum(was is True for was, _ in moved)
    return f"{len(moved)} | {better:+d} | {worse:+d}"


def table() -> str:
    """The table in Markdown."""
    model = fitted_decision()
    groups = []
    for folder in (EVIDENCE, EVIDENCE / JUDGED):
        cases = [case for some in stored(folder).values() for case in some]
        chances = [probabilities(case.evidence, model) for case in cases]
        groups.append(
            [(case, p, chosen(case.evidence, p)) for case, p in zip(cases, chances, strict=True)]
        )
    counts = " and ".join(str(len(group)) for group in groups)
    lines = [
        f"{counts} cases of the fit and of sources that took no part.",
        "",
        "| value | in force | instead | other results | right | wrong "
        "| other results, no part | right | wrong |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, value, other, worth, claim in variants():
        cells = " | ".join(row(group, worth, claim) for group in groups)
        lines.append(f"| `{name}` | {value:.3g} | {other:.3g} | {cells} |")
    return "\n".join(lines)


if __name__ == "__main__":
    print(table())
