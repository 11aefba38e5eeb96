"""What a recommended experiment has shown once it is recorded: which rival is left."""

from surgisoft.diagnosis.next_experiment.catalogue import SETTINGS
from surgisoft.diagnosis.next_experiment.propose import Recommendation
from surgisoft.diagnosis.verdict import Diagnosis

AT_REST = ("nothing_missing", "surrogate_undertrained")
"""Verdicts that say: no error of an effect is left."""


def rivals_of(advice: Recommendation) -> tuple[str, ...]:
    """The effects that an experiment was recommended for, in order."""
    return tuple(dict.fromkeys(name for pair in advice.pairs for name in pair.effects))


def effect_left(advice: Recommendation, said: Diagnosis) -> str | None:
    """The effect that is missing after an experiment; None where that is still open.

    said: the diagnosis of the old and the new recordings together; where the experiment took
    something away from the bench (`advice.by_hand`), of the new recording alone. Is the error gone
    then, it was what was taken away; has it stayed, it is one of the others.
    """
    removed = SETTINGS[advice.setting].removes
    verdict = said.verdict
    if not removed:
        return verdict.effects[0] if verdict.kind == "identified" else None
    if verdict.kind in AT_REST:
        return removed[0]
    others = [name for name in rivals_of(advice) if name not in removed]
    if len(others) == 1:
        return others[0]
    named = [name for name in verdict.effects if name in others]
    return named[0] if len(named) == 1 else None
