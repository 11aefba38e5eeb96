"""`diagnose`: which physical effect is the model missing?

What is wrong with the set-up of the recordings is tested first (`setup`): where a fault is proved,
the diagnosis ends there. Else it is a system identification of a grey-box model in five steps:

1. Residual table: the model's residuals on the training rows, thinned, in blocks (`residuals`).
2. Sensitivities: what each effect, with each choice of its nonlinear parameters, would change in
   the prediction to first order (`candidates`).
3. Model selection: held-out errors of every effect, the model discrepancy always beside it; effects
   are named one by one while they are beyond chance and large enough (`selection`).
4. Decision: what the evidence amounts to, and how sure that is (`decision`).
5. Experiment design, where effects cannot be told apart (`design`).
"""

import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from surgisoft.diagnosis.candidates import candidates
from surgisoft.diagnosis.criteria import CRITERIA
from surgisoft.diagnosis.data_quality import data_quality_warnings
from surgisoft.diagnosis.decision import Evidence, Kind, decide, evidence_of
from surgisoft.diagnosis.design.next_experiment import Experiment, Recommendation, recommend
from surgisoft.diagnosis.design.schedules import SETUPS
from surgisoft.diagnosis.error_axes import shares
from surgisoft.diagnosis.inputs import (
    Model,
    Recordings,
    open_inputs,
    with_known_residuals,
)
from surgisoft.diagnosis.pairs import BeforeAfter, Change, ChangeTrack, Paired, before_and_after
from surgisoft.diagnosis.residuals import Problem, residual_table
from surgisoft.diagnosis.selection import (
    Findings,
    Score,
    best_achievable,
    find,
    rmse_interval,
)
from surgisoft.diagnosis.setup import SetupResult, find_setup_faults
from surgisoft.errors import unknown_name
from surgisoft.measurement.histories import check_fits
from surgisoft.measurement.recordings import Recording, load_recordings
from surgisoft.surrogate.effects import known_effects
from surgisoft.surrogate.training_residuals import TrainingResiduals
from surgisoft.workers import torch_threads

MOST_RIVALS = CRITERIA.selection.most_competing
"""Most competing effects that an experiment is sought for."""

Progress = Callable[[str], None]
"""Called with what is being done."""


@dataclass(frozen=True)
class Verdict:
    """The result of a diagnosis in short."""

    kind: Kind
    """One of the seven kinds of result."""
    effects: tuple[str, ...]
    """The missing effects, the surest first; all competing ones where they cannot be told apart."""
    sentence: str
    """The result in words."""


@dataclass(frozen=True)
class ErrorLevels:
    """RMS distances of a key point, mm."""

    before: float
    """Error of the model as it is, on the training rows."""
    floor: float
    """The noise floor."""
    ceiling: float
    """Best achievable error: the least that the model, a black box, any effect or the named effects
    leave on held-out blocks."""


@dataclass(frozen=True)
class Ranked:
    """One effect and how well it explains the error."""

    effect: str
    """Its name."""
    confidence: float
    """Calibrated chance that it is missing, 0 to 1."""
    gain_alone: float
    """Share of the held-out squared error above the floor that this effect alone explains."""
    gain_unique: float
    """Share that comes back when it is left out of all effects together."""
    heldout_rmse_mm: float
    """Held-out error with this effect and the model discrepancy, mm."""
    ci95: tuple[float, float]
    """95 % interval of the held-out error from a bootstrap of motions, mm."""
    p_value: float
    """Family-wise p-value: chance of such a gain in any of the effects if none were missing."""
    log_gain: float
    """Mean over blocks of log(error before / error with the effect)."""
    parameters: dict
    """Its parameters with units in their names."""


@dataclass(frozen=True)
class Diagnosis:
    """Everything that a diagnosis found."""

    verdict: Verdict
    error_mm: ErrorLevels
    ranking: tuple[Ranked, ...]
    """All effects, the most likely first."""
    ambiguous_with: tuple[str, ...] = ()
    """Effects that explain the data as well as the first."""
    next_experiment: Experiment | None = None
    """The experiment that would tell competing effects apart; None where nothing is open."""
    checks: tuple[str, ...] = ()
    """Data-quality warnings."""
    notes: tuple[str, ...] = ()
    """Recordings under another direction of gravity, or beyond the range of the model's fit."""
    axis: str | None = None
    """The axis that the remaining error depends on most, where it is known."""
    seconds: float = 0.0
    """Time that it took, s."""
    statistics: Evidence | None = None
    """The numbers that the decision was made from."""
    setup: SetupResult | None = None
    """What is wrong with the set-up of the recordings; None where no fault is proved."""
    change: Change | None = None
    """How far the recordings differ from those before the change; None where none were given."""
    track: ChangeTrack | None = None
    """Key points before and after and what the named effects explain, for pictures; None without
    pairs."""

    def to_json(self) -> dict:
        """Plain values, as `diagnose --json` writes them."""
        plain = asdict(replace(self, setup=None, track=None, change=None))
        del plain["track"]
        return plain | {
            "setup": self.setup.to_json() if self.setup else None,
            "change": self.change.to_json() if self.change else None,
        }


@torch_threads(1)
def diagnose(
    model: Model,
    recordings: Recordings,
    progress: Progress | None = None,
    reference: Sequence[Recording] | TrainingResiduals | None = None,
    without: Collection[str] = (),
    setup_tests: bool = True,
    before: Recordings | None = None,
    paired: Paired = "auto",
) -> Diagnosis:
    """Name the effects that a model is missing on recordings of its own arm.

    Model and recordings may be given by their paths. Where `setup_tests` prove a fault of the
    set-up, the verdict is `setup`, and no effect is looked for: `Diagnosis.setup` mends the
    recordings.

    Only the training rows are looked at: the view of the residual table that is worked on holds no
    other key points. before: recordings from before a change in question. Where they were made with
    the same actuation, the paired difference is explained (`pairs`), else the residuals of the
    model, with those of `before` as what was known; paired: `auto`, `always` (too few common
    motions are an error) or `never`. reference: recordings, as before; or residuals of the model
    from before, default those that it keeps of its fit. without: effects that cannot act, such as a
    contact on a bench without anything to touch.
    """
    begin = time.perf_counter()
    report = progress or (lambda text: None)
    model, recordings, notes = open_inputs(model, recordings, sized=not setup_tests)
    if setup_tests:
        report("set-up")
        wrong = find_setup_faults(model, recordings)
        if wrong is not None:
            return replace(with_setup(wrong), notes=notes, seconds=time.perf_counter() - begin)
        check_fits(model.spec, recordings)
    report("predicting")
    table = residual_table(model, recordings)
    if before is None and not isinstance(reference, TrainingResiduals | None):
        before = reference
    both = None
    if before is not None:
        both = before_and_after(table, load_recordings(before), paired)
        problem, notes = both.training(), (*notes, *both.notes)
    else:
        problem = with_known_residuals(table.training(), reference)
    found = findings_of(problem, report, without)
    result = result_of(found)
    if both is not None:
        result = since(result, both, found)
    if result.verdict.kind == "unknown_effect":
        result = with_axis(result, problem)
    return replace(result, notes=notes, seconds=time.perf_counter() - begin)


def findings_of(problem: Problem, report: Progress, without: Collection[str]) -> Findings:
    """What model selection finds on an identification problem."""
    report("sensitivities of the effects")
    names = known_effects()
    for name in without:
        if name not in names:
            raise unknown_name("effect", name, names)
    tried = candidates(problem, [name for name in names if name not in without])
    return find(problem, tried, report)


def since(result: Diagnosis, both: BeforeAfter, found: Findings) -> Diagnosis:
    """The diagnosis of a change: since when, how large it is, and what of it is explained.

    The network's own error is not in a paired difference: what no effect explains there is no
    network that was fitted too little, but something that has changed.
    """
    verdict, change = result.verdict, both.change
    words = verdict.sentence
    if both.used and verdict.kind == "surrogate_undertrained":
        words = "something has changed and it is none of the known effects"
        verdict = replace(verdict, kind="unknown_effect")
    text = f"since {both.names}: {words}; {change.sentence}"
    track = both.track(found.problem, _explained(found, verdict)) if both.used else None
    return replace(result, change=change, track=track, verdict=replace(verdict, sentence=text))


def _explained(found: Findings, verdict: Verdict) -> np.ndarray:
    """(S, n, 3) what the named effects explain, mm; of several that compete, the first."""
    effects = verdict.effects[:1] if verdict.kind == "ambiguous" else verdict.effects
    forms = {score.effect: score.option.chosen for score in found.first}
    chosen = tuple(i for name in effects if name in forms for i in forms[name])
    amplitudes = found.selection.validation.amplitudes(chosen)
    return found.selection.sensitivities[..., list(chosen)] @ amplitudes


def with_setup(wrong: SetupResult) -> Diagnosis:
    """The diagnosis of recordings whose set-up is at fault."""
    return Diagnosis(
        verdict=Verdict("setup", (), wrong.sentence),
        error_mm=ErrorLevels(wrong.before_mm, wrong.floor_mm, wrong.after_mm),
        ranking=(),
        setup=wrong,
    )


def with_axis(result: Diagnosis, problem: Problem) -> Diagnosis:
    """The diagnosis with the axis that the error depends on most, where one is clear."""
    axis = next((each for each in shares(problem) if each.clear), None)
    if axis is None:
        return result
    text = f"{result.verdict.sentence}; it depends most on {axis.axis} ({100 * axis.share:.0f} %)"
    return replace(result, axis=axis.axis, verdict=replace(result.verdict, sentence=text))


def result_of(found: Findings) -> Diagnosis:
    """The diagnosis that the findings amount to."""
    problem, selection = found.problem, found.selection
    best = best_achievable(problem, found.box, found)
    reached = selection.rmse_mm(selection.losses(found.chosen))
    evidence = evidence_of(found)
    decision = decide(evidence)
    kind, effects, sure = decision.kind, decision.effects, decision.confidence
    levels = ErrorLevels(problem.rmse_mm, problem.floor_mm, best.rmse_mm)
    ranking = tuple(
        _ranked(found, score, sure if place == 0 else min(sure, 1.0 - sure))
        for place, score in enumerate(_order(found))
    )
    least = CRITERIA.decision.nearest_gain
    near = [s.effect for s in found.first[:1] if s.gain >= least]
    sentence = sentence_of(kind, effects, levels, reached, sure, near[0] if near else None)
    if kind == "several" and found.competing:
        others = " or ".join(found.competing)
        sentence += f"; {others} would do as well in the place of one of them"
    plan = None
    if kind == "ambiguous":
        plan = recommend(problem, effects[:MOST_RIVALS]).experiment
    return Diagnosis(
        verdict=Verdict(kind, effects, sentence),
        error_mm=levels,
        ranking=ranking,
        ambiguous_with=tuple(found.competing) if kind in ("ambiguous", "several") else (),
        next_experiment=plan,
        checks=(*data_quality_warnings(problem), *within_the_discrepancy(found, kind)),
        statistics=evidence,
    )


def within_the_discrepancy(found: Findings, kind: Kind) -> list[str]:
    """What an effect would explain of an error that is no larger than the validated one."""
    asked = CRITERIA.selection
    if kind != "nothing_missing" or not found.first or found.selection.whole_size >= 1.0:
        return []
    best = found.first[0]
    large = best.gain >= asked.first_gain and best.p_value <= asked.p_value
    if not large or found.selection.in_fit(best.effect):
        return []
    least = asked.first_gain_within_discrepancy
    text = (
        f"{best.effect} would explain {100 * best.gain:.0f} % of the error, but the error is no "
        f"larger than the model's validated error, so that an error of the fit explains it as well "
        f"(an effect is named there from {100 * least:.0f} % on)"
    )
    if known_effects()[best.effect].stage in ("line", "material"):
        text += f"; fit the network together with it (fit --effects {best.effect}) and compare"
    return [text]


def _order(found: Findings) -> list[Score]:
    """All effects, the named ones first.

    An effect that is plausible only on top of another has its score on top of that one.
    """
    alone = {score.effect: score for score in found.first}
    named = [alone.get(score.effect, score) for score in found.named]
    names = [score.effect for score in named]
    return named + [s for s in found.first if s.effect not in names]


def _ranked(found: Findings, score: Score, sure: float) -> Ranked:
    """One row of the ranking."""
    selection = found.selection
    return Ranked(
        effect=score.effect,
        confidence=round(float(sure), 4),
        gain_alone=float(score.gain),
        gain_unique=float(found.unique.get(score.effect, 0.0)),
        heldout_rmse_mm=selection.rmse_mm(score.losses),
        ci95=rmse_interval(found.problem, score.losses, selection.validation.counts),
        p_value=float(score.p_value),
        log_gain=float(score.log_gain.mean()),
        parameters=selection.parameters(score),
    )


def sentence_of(
    kind: Kind,
    effects: tuple[str, ...],
    levels: ErrorLevels,
    reached: float,
    sure: float,
    nearest: str | None,
) -> str:
    """The verdict in words.

    reached: held-out error with the named effects, mm; sure: confidence in the first of them;
    nearest: effect that is nearest to an unknown one, None where none is near.
    """
    error = f"error {levels.before:.3g} mm, floor {levels.floor:.3g} mm"
    if kind == "identified":
        return (
            f"{effects[0]} is missing (confidence {sure:.2f}): with it {reached:.3g} mm remain on "
            f"held-out blocks; {error}"
        )
    if kind == "several":
        together = " and ".join(effects)
        return (
            f"{together} are missing (confidence {sure:.2f} in the first): with them "
            f"{reached:.3g} mm remain on held-out blocks; {error}"
        )
    if kind == "ambiguous":
        return (
            f"cannot tell {' from '.join(effects)} with these recordings: each would leave about "
            f"{reached:.3g} mm on held-out blocks; {error}"
        )
    if kind == "unknown_effect":
        return (
            f"something is missing and it is none of the known effects "
            f"({f'{nearest} is nearest' if nearest else 'none is near'}); {error}"
        )
    if kind == "surrogate_undertrained":
        return (
            f"the network itself is off (its validated error says so too): fit it longer or to "
            f"more data before looking for effects; {error}"
        )
    return f"nothing is missing that these recordings could show; {error}"


# Result of a recommended experiment -----------------------------------------------------------

AT_REST = ("nothing_missing", "surrogate_undertrained")
"""Verdicts that say: no error of an effect is left."""


def rivals_of(advice: Recommendation) -> tuple[str, ...]:
    """The effects that an experiment was recommended for, in order."""
    return tuple(dict.fromkeys(name for pair in advice.pairs for name in pair.effects))


def effect_left(advice: Recommendation, result: Diagnosis) -> str | None:
    """The effect that a recorded experiment shows to be missing; None where that is still open.

    result: the diagnosis of the old and the new recordings together; where the experiment took
    something away from the bench (`advice.by_hand`), of the new recording alone. If the error is
    gone then, it was what was taken away; if it stays, it is one of the others.
    """
    removed = SETUPS[advice.setting].removes
    verdict = result.verdict
    if not removed:
        return verdict.effects[0] if verdict.kind == "identified" else None
    if verdict.kind in AT_REST:
        return removed[0]
    others = [name for name in rivals_of(advice) if name not in removed]
    if len(others) == 1:
        return others[0]
    named = [name for name in verdict.effects if name in others]
    return named[0] if len(named) == 1 else None
