"""Recommended experiments of ambiguous cases in the diagnosis benchmark.

The steps are those of a user: `next-experiment MODEL OLD --between EFFECTS`, `collect SCHEDULE`,
`diagnose MODEL OLD NEW`. Where the experiment removes something from the setup, NEW alone is
diagnosed, because OLD was recorded on another setup.
"""

from dataclasses import dataclass

from benchmarks.diagnosis.cases import Case
from benchmarks.diagnosis.robots import record_experiment
from surgisoft.diagnosis.design.next_experiment import recommend
from surgisoft.diagnosis.design.schedules import AS_IT_STANDS, SETUPS
from surgisoft.diagnosis.diagnose import MOST_RIVALS, diagnose, effect_left
from surgisoft.diagnosis.residuals import problem_of
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.training_residuals import TrainingResiduals


@dataclass(frozen=True)
class Settled:
    """Result of the recommended experiment of an ambiguous case."""

    experiment: str
    """Name of the experiment."""
    setting: str
    """Change of the experimental setup."""
    minutes: float
    """Duration of the experiment, minutes."""
    expected: float
    """Predicted probability of naming the right effect, for the worst pair."""
    effect: str | None
    """Effect that the new diagnosis names; None where it is still ambiguous."""
    first: str | None
    """That effect, or the first of the new ranking where it is still ambiguous."""


def settle(
    case: Case,
    model: ArmModel,
    known: TrainingResiduals,
    recording: Recording,
    rivals: tuple[str, ...],
    settings: tuple[str, ...] = tuple(SETUPS),
) -> Settled:
    """Record the recommended experiment on the same robot, and diagnose again."""
    advice = recommend(problem_of(model, [recording]), rivals[:MOST_RIVALS], settings=settings)
    new = record_experiment(case, SETUPS[advice.setting], advice.protocol)
    some = [new] if advice.by_hand else [recording, new]
    diagnosis = diagnose(model, some, reference=known, without=advice.removes)
    left = effect_left(advice, diagnosis)
    named = [row.effect for row in diagnosis.ranking]
    return Settled(
        experiment=advice.name,
        setting=advice.setting,
        minutes=advice.minutes,
        expected=min(pair.after for pair in advice.pairs),
        effect=left,
        first=left or (named[0] if named else None),
    )


def settle_both(
    case: Case,
    model: ArmModel,
    known: TrainingResiduals,
    recording: Recording,
    rivals: tuple[str, ...],
) -> tuple[Settled, Settled]:
    """Results of the recommended experiment, and of one without a change of the setup."""
    free = settle(case, model, known, recording, rivals)
    if free.setting == AS_IT_STANDS:
        return free, free
    return free, settle(case, model, known, recording, rivals, (AS_IT_STANDS,))
