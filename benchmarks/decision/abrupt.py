"""How well jumps of the body and shifts of a key point tell what is outside the list.

Run as `python -m benchmarks.decision.abrupt`. For each kind of case of the stored evidence it
counts those in which `diagnose` mentions jumps (`CLEAR_JUMPS`) or a key point that has shifted
(`CLEAR_SHIFT`).
"""

from collections.abc import Callable, Iterator, Sequence

from benchmarks.decision.evidence_log import EVIDENCE, JUDGED, Labelled, in_order, stored
from surgisoft.diagnosis.decision import CLEAR_JUMPS, CLEAR_SHIFT
from surgisoft.diagnosis.evidence import Evidence

TESTS: dict[str, Callable[[Evidence], bool]] = {
    f"jumps >= {CLEAR_JUMPS:g}": lambda e: e.jumps >= CLEAR_JUMPS,
    f"shift >= {CLEAR_SHIFT:g}": lambda e: e.shift >= CLEAR_SHIFT,
}
"""What is counted."""


def kind_of(case: Labelled) -> str:
    """What is true, in words; an effect outside the list by its generator's name."""
    if case.label == "unknown":
        return f"unknown: {' and '.join(case.truth)}"
    return {"known": "effects of the list", "clean": "nothing", "network": "the model is off"}.get(
        case.label, "model of another robot"
    )


def rows(cases: Sequence[Labelled]) -> Iterator[str]:
    """The table: kinds with their counts, the ones most often mentioned first."""
    kinds: dict[str, list[Labelled]] = {}
    for case in cases:
        if not case.left_out:
            kinds.setdefault(kind_of(case), []).append(case)
    yield f"| what is missing | cases | {' | '.join(TESTS)} |"
    yield f"|---|---|{'---|' * len(TESTS)}"
    counts = {
        kind: [sum(test(case.evidence) for case in some) for test in TESTS.values()]
        for kind, some in kinds.items()
    }
    for kind in sorted(kinds, key=lambda each: (-sum(counts[each]) / len(kinds[each]), each)):
        yield f"| {kind} | {len(kinds[kind])} | {' | '.join(map(str, counts[kind]))} |"


def tables() -> str:
    """Both tables as Markdown."""
    answer = []
    for title, folder in (("Cases of the fit", EVIDENCE), ("Unseen robots", EVIDENCE / JUDGED)):
        cases = [case for some in stored(folder).values() for case in some]
        answer += [f"## {title}", "", *rows(in_order(cases)), ""]
    return "\n".join(answer)


if __name__ == "__main__":
    print(tables())
