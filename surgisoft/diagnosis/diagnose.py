"""`diagnose`: which physical effect is the model missing?

What is wrong with the set-up of the recordings is tested first (`setup`): where a fault is proved,
the diagnosis ends there. Else it is a system identification of a grey-box model in six steps:

1. Residual table: the model's residuals on the training rows, thinned, in blocks (`residuals`).
2. Sensitivities: what each effect, with each choice of its nonlinear parameters, would change in
   the prediction to first order (`candidates`).
3. Model selection: held-out errors of every effect, the model discrepancy always beside it; effects
   are named one by one while they are beyond chance and large enough (`selection`).
4. Decision: calibrated probabilities from the evidence, and the result that is worth most with
   them (`evidence`, `decision`).
5. Refit: where the error is large and no larger than the validated one, or the network has learned
   part of what is missing, candidates are fitted together with it, and held-out data decide
   (`refit`).
6. Experiment design, where effects cannot be told apart (`design`).
"""

import math
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from surgisoft.diagnosis.black_box import black_box
from surgisoft.diagnosis.candidates import Candidate, candidates
from surgisoft.diagnosis.criteria import SEARCH
from surgisoft.diagnosis.data_quality import (
    alarm_hints,
    collinear_hints,
    data_quality_warnings,
    gap_hints,
    thinning_notes,
    valve_hints,
)
from surgisoft.diagnosis.decision import (
    CLEAR_JUMPS,
    CLEAR_SHIFT,
    LEAST_EXPLAINED,
    MOSTLY_STATIC,
    NAMING,
    Decision,
    Kind,
    Probabilities,
    Reason,
    Statement,
    claimable,
    decide,
    few_or_schedule,
    of_change,
    worth_of_nothing,
)
from surgisoft.diagnosis.design.next_experiment import Experiment, Recommendation, recommend
from surgisoft.diagnosis.design.schedules import SETUPS
from surgisoft.diagnosis.error_axes import shares
from surgisoft.diagnosis.estimation.intervals import values_text
from surgisoft.diagnosis.evidence import Evidence, evidence_of
from surgisoft.diagnosis.inputs import (
    Model,
    Recordings,
    held_out_in_fit,
    open_inputs,
    refuse_amended,
    with_known_residuals,
)
from surgisoft.diagnosis.known_error import known_error, rows_of_fit
from surgisoft.diagnosis.other_models import is_of_other_origin, open_model
from surgisoft.diagnosis.pairs import BeforeAfter, Change, ChangeTrack, Paired, before_and_after
from surgisoft.diagnosis.refit import LINE_OR_WALL, Refit, beside, can_hide, refit_reason
from surgisoft.diagnosis.refit import refit as fit_candidates_together
from surgisoft.diagnosis.residuals import (
    WHOSE_ARM,
    Problem,
    ResidualTable,
    Sealed,
    floor_in_words,
    model_fit,
    residual_table,
)
from surgisoft.diagnosis.selection import (
    Findings,
    Score,
    best_achievable,
    find,
    rmse_interval,
)
from surgisoft.diagnosis.setup import SetupResult, find_setup_faults
from surgisoft.diagnosis.testability import NotTestable, testable
from surgisoft.errors import InputError, Interrupted, unknown_name
from surgisoft.files import with_former_keys
from surgisoft.measurement.histories import check_fits, faster_than_fit
from surgisoft.measurement.recordings import Recording, load_recordings
from surgisoft.progress import Progress as RefitProgress
from surgisoft.progress import silent
from surgisoft.surrogate.effects import (
    FRONT,
    Effect,
    Quantity,
    hypothesis_of,
    in_words,
    known_effects,
)
from surgisoft.surrogate.training_residuals import TrainingResiduals
from surgisoft.workers import torch_threads

MOST_RIVALS = SEARCH.most_refined
"""Most competing effects that an experiment is sought for."""

PRINTED = 0.01
"""Part of the end of a plausible range by which a first estimate has to lie beyond it to be called
implausible: at the end it is printed like the end."""
WORTH_TELLING = 0.2
"""Least probability of an effect that a check mentions though the result does not name it."""
AS_GOOD = 1.64
"""Studentised log gain of two effects over another pair below which the other does as well (5 %,
one-sided)."""
VARIES = 0.04
"""Least variance of an amplitude between motions, in units of its square, that a check mentions: a
standard deviation of a fifth of the amplitude. Chosen before any case was looked at."""
ABOUT = 1.1
"""Ratio up to which the errors that effects of a set would leave are said to be about the same."""
MOSTLY = 0.5
"""Share of what is left in one line of its spectrum from which the motion is said to be periodic:
most of it."""
LOCAL = 3.0
"""Ratio of the RMS error in the worst block of time to that of the median block from which the
error is called local. Chosen on three robots of a trial, 36 blocks each, between the largest ratio
of an unchanged arm (2.5) and the least one of an arm that touched a wall (3.2). It adds a check,
and no result depends on it."""
SHORT_S = 60.0
"""Duration of the rows looked at below which candidates are not fitted together with the network,
unless an effect is named that the network could do as well [s]: twelve motions of five seconds. The
errors of so few motions, a third of which is left out of each training, prove no effect."""
REFIT_INTERRUPTED = (
    "interrupted while candidates were fitted together with the network: the verdict is that of "
    "the residuals alone, from which an effect that the network has learned to imitate is missing; "
    "--refit never asks for no more"
)
"""What is said of a diagnosis whose fits with the network were interrupted."""
NO_PAST = (
    "the model does not keep what is needed to tell what has changed since its fit: give the "
    "recordings of the fit by --before"
)
"""Note on motion faster than that of the fit where `changed_since_fit` gives nothing."""
MOST_FITTED = 3
"""Most effects that a fit is recommended with; `fit` takes those that lower its held-out error."""
REASONS = {
    "network": "the error is {size}, so the model does not describe this arm: fit a model to these "
    "recordings",
    "static": "a function of the actuation alone explains most of the error, which is {size}: fit "
    "a model to these recordings",
    "learned": "the error is {size}, and a black box with memory explains a part of it that no "
    "static function explains, so the network has learned part of the missing effect: fit a "
    "network together with effects",
    "announced": "the error is {size}, and most probably it is the network's own; it needs a "
    "longer fit, more data or a better form",
    "repeatability": "most probably nothing has changed, but the change is not clearly as small as "
    "the differences between recordings of an unchanged arm: record the same schedule twice before "
    "a change, so that these differences are known",
    "before": "the model does not describe the recordings from before the change",
    "arm": "even with the most probable effect the model leaves most of the motion",
    "few_data": "the recordings contain too few different motions",
    "schedule": "on these recordings no cause is probable enough to be named",
}
"""Why a diagnosis cannot tell, or why it calls the model off, in words; {size}: the error beside
the validated one (`ErrorLevels.size`)."""
REASONS_OF_OTHERS = REASONS | {
    "network": "the error is {size}, so the model does not describe this arm: correct its "
    "parameters, its frame or its form",
    "static": "a function of the actuation alone explains most of the error, which is {size}: "
    "correct the parameters or the form of the model",
    "learned": "the error is {size}, and a black box with memory explains a part of it that no "
    "static function explains, so the parameters of the model may make up for a part of the "
    "missing effect",
    "announced": "the error is {size}, and most probably it is the model's own: its parameters or "
    "its form are off",
}
"""The same of a callable or of predictions, which `surgisoft fit` did not make."""
OWN_ERROR_FIRST = "surgisoft improve {model} {earlier} -o NEW"
"""What to run where a change is no larger than the own error of such a model: first lower that, by
recordings from before the change."""
FIT_BEFORE = "surgisoft fit {earlier} -o NEW"
"""The same for a fitted model: recordings after a change would hide it from the new one."""

FAR_BEHIND = 0.05
"""Probability of the second effect of a set below which the sentence names the first: of 21 such
sets on judged robots the first was missing in 17, the second in one."""
PROBABLY = 0.5
"""Probability of the first effect of such a set from which the sentence says so."""
MOSTLY_SMOOTH = 0.5
"""Share of the error: where the discrepancy of the model alone, without an effect, leaves less, a
check says so. It is a half."""
WHERE_IT_ACTS = "surgisoft compare {model} {data}{before} --report PAGE"
"""What to run to see when, where along the body and at which actuations a model errs."""
CANNOT_TELL = "cannot tell what is missing, if anything"
"""Begin of the sentence of `cannot_tell`."""
WITHOUT_SLIP = "surgisoft diagnose {model} REC_BEFORE_THE_SLIP{before}"
"""What to run after a marker has slipped: the rows before it say what the arm lacks."""
CUT_AT_SLIP = "surgisoft recording {{data}} --until {until} -o REC_BEFORE_THE_SLIP.parquet"
"""What to run before that, where there is one recording: it writes these rows."""
SLIP_MARGIN = 0.02
"""How long before the moment of a slip the rows to use end, of the time of the recording: the
moment is found to within about half of that (`change_points.finer`)."""
MENTIONED = {
    "identified": "{} is missing",
    "several": "{} are missing",
    "nothing_missing": "nothing is missing",
    "unknown_effect": "an effect outside the list",
    "surrogate_undertrained": "the model is off",
}
"""Statements that the sentence of "cannot tell" mentions, in words."""

HELD_OUT = "held-out blocks"
"""Blocks of time that took part in no fit, in words."""
LEFT_OUT = "blocks left out of the effects' fit (the model itself was fitted to these recordings)"
"""Blocks of time of recordings that the model was fitted to, which are no held-out data."""

Progress = Callable[[str], None]
"""Called with what is being done."""


@dataclass(frozen=True)
class Verdict:
    """The result of a diagnosis in short."""

    kind: Kind
    """One of the kinds of result."""
    effects: tuple[str, ...]
    """The missing effects, the surest first; all competing ones where they cannot be told apart."""
    sentence: str
    """The result in words."""
    confidence: float = 0.0
    """Calibrated probability that the statement is right: that the named effect is missing, one of
    the set, both of two, nothing, or something unknown."""
    reason: Reason | None = None
    """Why it cannot be told, or why the model is called off where its validated error does not say
    so; None for another kind."""


@dataclass(frozen=True)
class ErrorLevels:
    """RMS distances of a key point, mm."""

    before: float
    """Error of the model as it is, on the training rows."""
    floor: float
    """The noise floor."""
    best_achievable: float
    """Best achievable error: the least that the model, a black box, any effect or the named effects
    leave on held-out blocks."""
    validated: float | None = None
    """The model's validated error, with the noise of these recordings instead of that of its fit,
    so that `before` can be compared with it; None for a paired difference, which holds no error of
    the model, and where the set-up is at fault."""
    discrepancy_alone: float | None = None
    """Error that the model discrepancy alone, without an effect, leaves on held-out blocks: what
    the error with each effect is compared with. None where the set-up is at fault."""

    @property
    def in_words(self) -> str:
        """The error and the noise floor."""
        return f"error {self.before:.3g} mm, floor {floor_in_words(self.floor, '.3g')}"

    @property
    def size(self) -> str:
        """The error beside the validated one in words, with the number that it is compared with."""
        if self.validated is None:
            return "of unknown size beside the model's validated error"
        return (
            f"{beside(self.before, self.validated)} the model's validated error "
            f"({self.validated:.3g} mm with the noise of these recordings)"
        )


@dataclass(frozen=True)
class Ranked:
    """One effect and how well it explains the error."""

    effect: str
    """Its name."""
    confidence: float
    """Calibrated chance that it is missing, 0 to 1."""
    gain_alone: float
    """Share, 0 to 1, of what can be explained of the held-out squared error that this effect alone
    explains."""
    gain_unique: float
    """Share, 0 to 1, that comes back when it is left out of all effects together."""
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
    in_words: str = ""
    """What its parameters mean, in words, of a named effect; empty for the others."""


@dataclass(frozen=True)
class ErrorAlong:
    """RMS error of each of the B blocks of time of the diagnosed rows, with nothing added."""

    from_s: tuple[float, ...]
    """(B,) begin of each block, on the axis that charts and replays share, s."""
    to_s: tuple[float, ...]
    """(B,) end of each block, s."""
    rmse_mm: tuple[float, ...]
    """(B,) RMS distance over key points and rows, mm."""

    @property
    def typical_mm(self) -> float:
        """Median over the blocks, mm."""
        return float(np.median(self.rmse_mm))

    @property
    def local(self) -> tuple[bool, ...]:
        """(B,) whether the error of a block is much larger than that of the median block."""
        return tuple(value > LOCAL * self.typical_mm for value in self.rmse_mm)


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
    """Data-quality warnings, and the alarms of recorded runs."""
    notes: tuple[str, ...] = ()
    """Recordings under another direction of gravity, or beyond the range of the model's fit."""
    axis: str | None = None
    """The axis that the remaining error depends on most, where it is known."""
    seconds: float = 0.0
    """Time that it took, s."""
    statistics: Evidence | None = None
    """The numbers that the decision was made from."""
    not_testable: tuple[NotTestable, ...] = ()
    """Effects that these recordings cannot show; they are not ranked."""
    implausible: tuple[str, ...] = ()
    """Effects that would need parameters outside of their plausible ranges; they are not ranked."""
    probabilities: Probabilities | None = None
    """Calibrated probabilities of what is true."""
    next_command: str = ""
    """What to do, as a command with `{model}`, `{data}`, `{before}` (the option with recordings
    from before, or nothing) and `{earlier}` (these recordings) for the files; empty where nothing
    is to be done."""
    setup: SetupResult | None = None
    """What is wrong with the set-up of the recordings; None where no fault is proved."""
    change: Change | None = None
    """How far the recordings differ from those before the change; None where none were given."""
    track: ChangeTrack | None = None
    """Key points before and after and what the named effects explain, for pictures; None without
    pairs."""
    statements: tuple[Statement, ...] = ()
    """All statements that could be made with these probabilities, worth most first."""
    refit: Refit | None = None
    """What candidates did that were fitted together with the network; None where none was."""
    interrupted: bool = False
    """Whether Ctrl-C ended the fit with the network: the verdict is that of the residuals alone."""
    in_fit: float | None = None
    """Share 0..1 of the rows looked at that the model was fitted to; None where it does not say."""
    along: ErrorAlong | None = None
    """The error (in a paired difference: the change) along the recordings; None without a clock."""
    since_fit: Verdict | None = None
    """What has changed since the fit of the model, where the arm moves faster than it did then;
    None elsewhere, and where the model keeps too little of its fit."""

    @property
    def left_out(self) -> str:
        """The rows that errors with an effect are from, in words."""
        return LEFT_OUT if self.in_fit else HELD_OUT

    def command(
        self,
        model: str = "MODEL",
        data: str = "RECORDINGS",
        before: str = "BEFORE",
        earlier: str = "BEFORE",
    ) -> str:
        """`next_command` with its files, in words for those that are not given.

        model, data, before: as they are typed in a shell (`surgisoft.command_line.typed`).
        before: the recordings from before, with how to pair them, which are left out where none
        were compared, or empty. earlier: the recordings from before by themselves.
        """
        option = f" --before {before}" if self.change is not None and before else ""
        names = {"model": model, "data": data, "before": option, "earlier": earlier}
        return self.next_command.format(**names)

    @property
    def in_words(self) -> tuple[tuple[str, str], ...]:
        """(named effect, what its parameters mean in words), where there is something to tell."""
        named = {row.effect: row.in_words for row in self.ranking}
        words = [(name, named.get(name, "")) for name in self.verdict.effects]
        return tuple(each for each in words if each[1])

    @property
    def shown(self) -> tuple[Ranked, ...]:
        """The ranking in the order of tables and charts: by confidence as it is printed, then by
        the error that is left."""
        return tuple(
            sorted(self.ranking, key=lambda row: (-round(row.confidence, 2), row.heldout_rmse_mm))
        )

    def to_json(self) -> dict:
        """Plain values, as `diagnose --json` writes them."""
        plain = asdict(replace(self, setup=None, track=None, change=None, refit=None))
        del plain["track"]
        plain["error_mm"] = with_former_keys(plain["error_mm"], {"ceiling": "best_achievable"})
        return plain | {
            "setup": self.setup.to_json() if self.setup else None,
            "change": self.change.to_json() if self.change else None,
            "refit": self.refit.to_json() if self.refit else None,
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
    refit: str = "auto",
    refit_progress: RefitProgress = silent,
    processes: int = 1,
    predictions: Iterable[str | Path] | None = None,
    error_mm: float | None = None,
) -> Diagnosis:
    """Name the effects that a model is missing on recordings of its own arm.

    Returns one of the verdicts of docs/diagnosis.md with its confidence, the evidence for it, and
    every effect with its score: cross-validated selection among first-order sensitivities,
    beside a Gaussian-process model discrepancy (Kennedy & O'Hagan 2001), and a fitted decision.
    Errors are in mm, parameters in the units of their effect. Raises InputError where the
    recordings are too short or do not fit the model.

    Model and recordings may be given by their paths; a model of other origin as for `compare`.
    Where `setup_tests` prove a fault of the set-up, the verdict is `setup`, and no effect is
    looked for: `Diagnosis.setup` corrects the recordings.

    Only the training rows are looked at: the key points of all others are removed first (`Sealed`).
    before: recordings from before a change in question. Where they were made with the same
    actuation, the paired difference is explained (`pairs`), else the residuals of the model less
    what of those of `before` can be learned (`known_error`); paired: `auto`, `always` (too few
    common motions are an error) or `never`. reference: recordings, as before; or residuals of the
    model from before, default those that it keeps of its fit. without: effects that cannot act,
    such as a contact on a bench without anything to touch. refit: `auto`, `never` or `always`
    fit candidates together with the network (`surgisoft.diagnosis.refit`), not where recordings
    from before are given; refit_progress: called while that goes on; processes: how many trainings
    then run at once, with the same result. More than one starts new Python processes, so a script
    has to guard its start by `if __name__ == "__main__"`. Ctrl-C during these fits raises
    `Interrupted` (`surgisoft.errors`) with the diagnosis from the residuals alone.
    """
    begin = time.perf_counter()
    report = progress or (lambda text: None)
    model, recordings, before = open_model(model, recordings, before, predictions, error_mm)
    model, recordings, notes = open_inputs(
        model, recordings, sized=not setup_tests, compared=before is not None
    )
    whole, recordings = recordings, Sealed(recordings).training
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
    earlier = [] if before is None else load_recordings(before)
    if before is not None:
        refuse_amended(model, whole, earlier)
        both = before_and_after(table, earlier, paired)
        problem = both.training()
        # The sentence says it where nothing can be told.
        notes = notes if both.strange is not None else (*notes, *both.notes)
    else:
        problem = with_known_residuals(table.training(), reference)
    notes = (*notes, *thinning_notes(problem))
    reason = refit_reason(problem, refit)
    if both is not None and refit == "always":
        raise InputError(
            "--refit always looks for effects that the network has learned to imitate, but with "
            "--before only the change since then is explained, which the network never saw; "
            "leave out one of the two"
        )
    if both is not None:
        result = diagnose_change(problem, both, report, without)
    else:
        report("sensitivities of the effects")
        tried = tried_on(problem, without)
        found, not_testable = findings_of(problem, report, without, tried)
        result = replace(result_of(found), not_testable=not_testable)
        del found  # hundreds of MB
        if not reason and refit == "auto" and model.trainable:
            reason = reason_of_result(result.verdict)
        if reason and refit == "auto" and result.verdict.kind not in NAMING:
            seconds = recorded_s(problem)
            if seconds is not None and seconds < SHORT_S:
                reason, result = "", too_short(result, seconds)
        if reason:
            cannot = [*without, *(each.effect for each in not_testable)]
            try:
                joint = fit_candidates_together(
                    problem, reason, cannot, progress=refit_progress, processes=processes
                )
                result = with_refit(result, joint, problem)
            except KeyboardInterrupt:
                checks = (*result.checks, REFIT_INTERRUPTED)
                result = replace(result, checks=checks, interrupted=True)
        if result.verdict.kind == "unknown_effect":
            result = with_axis(result, problem)
        of_arm = reference is None and result.verdict.reason != "arm"
        asked = of_arm and not result.interrupted
        if asked and not problem.in_fit and faster_than_fit(model.spec, whole):
            report("what has changed since the fit")
            changed = changed_since_fit(table, without, (problem, tried))
            result = replace(result, since_fit=changed)
            notes = notes if changed else (*notes, NO_PAST)
    if result.next_command.startswith("surgisoft amend"):
        unknown = not held_out_in_fit(model, whole, table.held_out)
        result = replace(result, next_command=amend_command(result, unknown))
    valves = valve_hints(whole, earlier, model.spec.actuation)
    checks = (*alarm_hints(whole, recordings), *gap_hints(whole), *valves, *result.checks)
    result = replace(result, checks=checks, notes=notes, seconds=time.perf_counter() - begin)
    if result.interrupted:
        raise Interrupted(result)
    return result


def recorded_s(problem: Problem) -> float | None:
    """Duration of the rows looked at, s: the sum over their blocks of time; None for samples
    without a clock."""
    along = error_along(problem)
    return None if along is None else float(np.sum(np.subtract(along.to_s, along.from_s)))


def too_short(result: Diagnosis, seconds: float) -> Diagnosis:
    """The diagnosis of recordings on which no fit with the network could prove an effect, and which
    say nothing of what it has learned.

    seconds: duration of the rows looked at, s.
    """
    verdict, chances = result.verdict, result.probabilities
    check = (
        f"the diagnosis looked at {seconds:.0f} s of motion, expected {SHORT_S:.0f} s or more to "
        "fit candidates together with the network, which may have learned part of what is missing: "
        "record more motion, or use --refit always"
    )
    result = replace(result, checks=(*result.checks, check))
    if verdict.kind != "cannot_tell" or chances is None:
        return result
    decision = Decision(
        "cannot_tell", (), verdict.confidence, chances, "few_data", result.statements
    )
    sentence = sentence_of(decision, result.error_mm, [result.error_mm.before])
    return replace(
        result,
        verdict=replace(verdict, sentence=sentence, reason="few_data"),
        next_command=next_command(decision),
    )


def reason_of_result(verdict: Verdict) -> str:
    """Why candidates are fitted together with the network after all; empty where they are not.

    Where the residuals cannot tell because the network has learned a part of what is missing, only
    a fit of both can.
    """
    learned = verdict.kind == "cannot_tell" and verdict.reason == "learned"
    return "the network has learned part of what is missing" if learned else ""


def changed_since_fit(
    table: ResidualTable,
    without: Collection[str] = (),
    known: tuple[Problem, list[Candidate]] | None = None,
) -> Verdict | None:
    """What has changed since a model was fitted, by the rows that it keeps of its fit.

    A model may lack an effect of speed from the start that the slower motion of its fit hardly
    shows. What it got wrong then is subtracted (`known_error`). None where the model does not keep
    what came before these rows. known: a problem of the same table and `tried_on` it, which is the
    same for the same rows.
    """
    kept = table.model.training_residuals
    fitted = None if kept is None else rows_of_fit(kept, table.spec)
    if fitted is None:
        return None
    problem = known_error(table, fitted).problem_of(table)
    tried = None
    if known is not None and torch.equal(known[0].index, problem.index):
        tried = known[1]
    found, _ = findings_of(problem, lambda text: None, without, tried)
    evidence = evidence_of(found)
    decision = of_change(decide(evidence), evidence)
    result = with_less(result_of(found, decision, evidence), found)
    sentence = f"since the fit of the model: {result.verdict.sentence}"
    return replace(result.verdict, sentence=sentence)


def diagnose_change(
    problem: Problem, both: BeforeAfter, report: Progress, without: Collection[str] = ()
) -> Diagnosis:
    """Name the effects that explain what has changed between two sets of recordings.

    problem: training rows of the recordings after the change, as `BeforeAfter.training` poses them,
    of the given model or of one that was amended since.
    """
    if both.strange is not None:
        return without_before(both)
    found, not_testable = findings_of(problem, report, without)
    evidence = evidence_of(found)
    decision = of_change(decide(evidence), evidence)
    result = replace(result_of(found, decision, evidence), not_testable=not_testable)
    result = with_less(since(result, both, found), found)
    return with_axis(result, problem) if result.verdict.kind == "unknown_effect" else result


def amend_command(result: Diagnosis, unknown: bool) -> str:
    """The command that adds the named effects; unknown: whether the model has not been fitted to
    the rows that `amend` holds out.

    On rows of the fit no fall is claimed, unless effects and network are fitted together.
    """
    command = result.next_command
    if unknown or "--refit always" in command:
        return command
    if all(map(can_hide, result.verdict.effects)):
        return f"{command} --refit always"
    return command.replace("{data}", "OTHER_REC")


def tried_on(problem: Problem, without: Collection[str]) -> list[Candidate]:
    """The candidates of all effects but some, on the rows of a problem."""
    return candidates(problem, asked_for(without))


def asked_for(without: Collection[str]) -> list[str]:
    """The known effects but some."""
    names = known_effects()
    for name in without:
        if name not in names:
            raise unknown_name("effect", name, names)
    return [name for name in names if name not in without]


def findings_of(
    problem: Problem,
    report: Progress,
    without: Collection[str],
    tried: list[Candidate] | None = None,
) -> tuple[Findings, tuple[NotTestable, ...]]:
    """Findings of model selection on an identification problem, and effects it cannot show.

    tried: the candidates, where they are known (`tried_on`).
    """
    if tried is None:
        report("sensitivities of the effects")
        tried = tried_on(problem, without)
    shown, not_testable = testable(problem, tried, asked_for(without))
    return find(problem, shown, report), not_testable


def since(result: Diagnosis, both: BeforeAfter, found: Findings) -> Diagnosis:
    """The diagnosis of a change: since when, how large it is, and what of it is explained.

    The model's own error is not in a paired difference, so the decision does not call the model off
    there (`decision.statements`).
    """
    verdict = result.verdict
    text = f"since {both.names}: {verdict.sentence}; {both.change.sentence}"
    track = None
    if both.used:
        # Effects that cannot be told apart are alternatives, which do not act at once.
        acting = verdict.effects[:1] if verdict.kind == "ambiguous" else verdict.effects
        track = both.track(found.problem, found.explained_mm(acting))
    command = result.next_command
    if verdict.kind == "surrogate_undertrained" and not verdict.reason:
        other_origin = is_of_other_origin(found.problem.model)
        command = OWN_ERROR_FIRST if other_origin else FIT_BEFORE
    return replace(
        result,
        change=both.change,
        track=track,
        verdict=replace(verdict, sentence=text),
        next_command=command,
    )


def without_before(both: BeforeAfter) -> Diagnosis:
    """The diagnosis of a change where the model does not describe BEFORE: nothing can be told.

    Without pairs the residuals before are what the change is measured from, and residuals of
    another arm, or of another set-up, say nothing about this one. No effect is looked for.
    """
    problem = both.plain.training()
    best = best_achievable(problem, black_box(problem), None)
    head = f"since {both.names}: {CANNOT_TELL}"
    return Diagnosis(
        verdict=Verdict("cannot_tell", (), f"{head}: {both.strange_in_words}", reason="before"),
        error_mm=ErrorLevels(problem.rmse_mm, problem.told_floor_mm, best.rmse_mm),
        ranking=(),
        next_command="surgisoft diagnose {model} {data}",
        change=both.change,
        in_fit=problem.in_fit,
    )


def lacking_before(both: BeforeAfter, report: Progress) -> tuple[str, ...]:
    """A note where the model already lacks effects on the recordings from before the change; else
    none, and none of recordings too short to tell.

    The paired difference takes the network's response for that of the arm: a lag that the arm had
    before changes what a further lag does.
    """
    if both.strange is not None:
        return ()
    report(f"what the model lacks on {both.names}")
    try:
        problem = with_known_residuals(both.earlier.training())
    except InputError:  # too few blocks of time
        return ()
    verdict = result_of(findings_of(problem, lambda text: None, ())[0]).verdict
    if verdict.kind not in NAMING:
        return ()
    named = (" or " if verdict.kind == "ambiguous" else " and ").join(verdict.effects)
    together = problem.in_fit and all(map(can_hide, verdict.effects))
    command = "surgisoft improve --refit always" if together else "surgisoft improve"
    return (
        f"the model already lacks {named} on the recordings from before the change (error "
        f"{problem.rmse_mm:.3g} mm, floor {floor_in_words(problem.told_floor_mm, '.3g')}), so the "
        "parameters of what has changed may be off by more than their intervals say: first run "
        f"'{command}' on the model and {both.names}, then amend the model that it writes",
    )


def with_less(result: Diagnosis, found: Findings) -> Diagnosis:
    """The diagnosis of a change, which says where a named effect acts less than before."""
    verdict, text = result.verdict, result.verdict.sentence
    for score in found.first:
        if score.effect in verdict.effects and found.selection.taken_away(score.option):
            text += f"; there is less {score.effect} than before"
    return replace(result, verdict=replace(verdict, sentence=text))


def with_setup(wrong: SetupResult) -> Diagnosis:
    """The diagnosis of recordings whose set-up is at fault."""
    return Diagnosis(
        verdict=Verdict("setup", (), wrong.sentence),
        error_mm=ErrorLevels(wrong.before_mm, wrong.floor_mm, wrong.after_mm),
        ranking=(),
        setup=wrong,
    )


def with_axis(result: Diagnosis, problem: Problem) -> Diagnosis:
    """The diagnosis with the axis that the error depends on most, where one is clear and no key
    point has shifted."""
    if result.statistics is not None and slipped(result.statistics):
        return result  # what moves with a marker is no cause of its shift
    axis = next((each for each in shares(problem) if each.clear), None)
    if axis is None:
        return result
    most = f"the error depends most on {axis.in_words} ({100 * axis.share:.0f} %)"
    text = f"{result.verdict.sentence}; {most}"
    return replace(result, axis=axis.axis, verdict=replace(result.verdict, sentence=text))


def with_refit(result: Diagnosis, joint: Refit, problem: Problem) -> Diagnosis:
    """The diagnosis in which the refit decides about the effects that it tried.

    A winner is named, alone or with what competes with it. Without one, effects that the residuals
    name are not named any more if all of them were tried: the network alone does as well.
    """
    error = result.error_mm.in_words
    verdict, ranking, checks = result.verdict, result.ranking, result.checks
    plan, competing = result.next_experiment, result.ambiguous_with
    evidence, chances = result.statistics, result.probabilities
    command = result.next_command
    tried = {candidate.effect for candidate in joint.candidates}
    if joint.winner is not None:
        sure = joint.confidence
        kind: Kind = "ambiguous" if joint.ambiguous else "identified"
        effects = joint.names if joint.ambiguous else (joint.winner,)
        head = f"cannot tell {' from '.join(effects)} with these recordings"
        if kind == "identified":
            head = f"{joint.winner} is missing (confidence {sure:.2f})"
        verdict = Verdict(kind, effects, f"{head}: {joint.sentence}; {error}", round(sure, 4))
        order = sorted(ranking, key=lambda row: row.effect not in joint.names)
        order.sort(key=lambda row: row.effect != joint.winner)
        most = min(sure, 1.0 - sure)
        ranking = tuple(
            replace(row, confidence=round(sure if place == 0 else min(row.confidence, most), 4))
            for place, row in enumerate(order)
        )
        ranking = tuple(_as_fitted(row, joint) if row.effect in effects else row for row in ranking)
        competing, plan = joint.competing, None
        like_a_line = hypothesis_of(known_effects()[joint.winner]).like_a_line
        if like_a_line and problem.model.spec.actuation == "measured":
            checks = (*checks, LINE_OR_WALL)
        if kind == "ambiguous":
            plan = recommend(problem, effects[:MOST_RIVALS]).experiment
        if chances is not None:
            command = next_command(Decision(kind, effects, sure, chances))
            command += " --refit always" if kind == "identified" else ""
    else:
        checks = (*checks, joint.sentence)
        if evidence is not None and chances is not None and tried.issuperset(verdict.effects):
            quiet = chances.nothing + chances.network
            none = Decision("cannot_tell", (), quiet, chances, few_or_schedule(evidence))
            if claimable(evidence) and worth_of_nothing(quiet) > 0.0:
                none = Decision("nothing_missing", (), quiet, chances)
            if verdict.effects or verdict.reason == "learned":
                left = without_tried(none, result.statements, tried)
                sentence = sentence_of(left, result.error_mm, [result.error_mm.before])
                verdict = Verdict(none.kind, (), sentence, round(quiet, 4), none.reason)
                ranking = tuple(replace(row, confidence=0.0, in_words="") for row in ranking)
                command, competing, plan = next_command(none), (), None
    was = result.verdict
    if chances is not None and verdict.effects != was.effects:
        stale = second_too(Decision(was.kind, was.effects, was.confidence, chances))
        checks = tuple(each for each in checks if each not in stale)
    return replace(
        result,
        verdict=verdict,
        ranking=ranking,
        ambiguous_with=competing,
        next_experiment=plan,
        checks=checks,
        refit=joint,
        next_command=command,
    )


def without_tried(
    decision: Decision, statements: Iterable[Statement], tried: Collection[str]
) -> Decision:
    """The decision with those statements that name none of the effects that the refit tried: the
    network alone does as well as with one of these."""
    chances = decision.probabilities
    effects = {name: chance for name, chance in chances.effects.items() if name not in tried}
    return replace(
        decision,
        probabilities=replace(chances, effects=effects),
        statements=tuple(each for each in statements if not set(tried).intersection(each.effects)),
    )


def _as_fitted(row: Ranked, joint: Refit) -> Ranked:
    """A row of the ranking with the parameters that were fitted together with the network."""
    fitted = joint.of(row.effect)
    return replace(row, parameters=fitted.parameters, in_words=fitted.in_words)


def result_of(
    found: Findings, decision: Decision | None = None, evidence: Evidence | None = None
) -> Diagnosis:
    """The diagnosis that the findings amount to.

    decision: what was decided from other evidence; None: it is decided from the findings. evidence:
    that of the findings, where it is known.
    """
    problem = found.problem
    best = best_achievable(problem, found.box, found)
    evidence = evidence or evidence_of(found)
    decision = decision or decide(evidence)
    in_fit = problem.in_fit
    where = LEFT_OUT if in_fit else HELD_OUT
    levels = ErrorLevels(
        problem.rmse_mm,
        problem.told_floor_mm,
        best.rmse_mm,
        validated=None if evidence.paired else problem.rmse_mm / evidence.error_over_validated,
        discrepancy_alone=found.selection.rmse_mm(found.selection.losses()),
    )
    other_arm = "" if evidence.paired else of_another_arm(found, decision)
    if other_arm:
        decision = replace(decision, kind="cannot_tell", effects=(), reason="arm")
    kind, effects, sure = decision.kind, decision.effects, decision.confidence
    ranking = tuple(_ranked(found, score, decision) for score in _order(found, decision))
    static = evidence.free_static >= MOSTLY_STATIC * evidence.free_box
    near, reached = nearest(ranking), _reached(found, effects, kind)
    fitted = not is_of_other_origin(problem.model)
    sentence = sentence_of(decision, levels, reached, where, static, near, fitted)
    if other_arm:
        sentence = f"{CANNOT_TELL}: {other_arm}; {levels.in_words}"
    others = _instead(evidence) if kind == "several" else ()
    if others:
        sentence += (
            f"; {' or '.join(others)} explains the recordings about as well as one of the two"
        )
    recordings = len(problem.table.names)
    if kind == "unknown_effect":
        sentence += knock(evidence, recordings) + periodic(evidence)
    told = slipped(evidence, recordings)
    if not told or evidence.jump_count > 1:
        told += jumping(evidence, recordings)
    command = next_command(decision, problem.model.trainable, fitted)
    if kind == "unknown_effect":
        if slipped(evidence):
            command = before_the_slip(evidence, problem.table)
        sentence += "".join(f"; {each}" for each in told)
        told = []
    plan = recommend(problem, effects).experiment if kind == "ambiguous" else None
    along = error_along(problem)
    return Diagnosis(
        verdict=Verdict(kind, effects, sentence, round(sure, 4), decision.reason),
        error_mm=levels,
        ranking=ranking,
        ambiguous_with=effects[1:] if kind == "ambiguous" else others,
        next_experiment=plan,
        checks=(
            *data_quality_warnings(problem),
            *(collinear_hints(problem.table) if kind in NAMING else ()),
            *told,
            *(local_error(along, recordings) if kind not in NAMING else ()),
            *would_explain(found, decision, fitted),
            *second_too(decision),
            *smooth_error(levels, decision),
            *amplitudes_that_vary(evidence, decision),
        ),
        statistics=evidence,
        implausible=tuple(
            name for name in found.selection.options if name not in {row.effect for row in ranking}
        ),
        probabilities=decision.probabilities,
        statements=decision.statements,
        next_command=command,
        in_fit=in_fit,
        along=along,
    )


def of_another_arm(found: Findings, decision: Decision) -> str:
    """Why no effect may be named: with those that the decision names the model still leaves so much
    of the motion that it does not describe this arm (`ModelFit.fits`); empty where it does."""
    if decision.kind not in NAMING:
        return ""
    fit = model_fit(found.problem.table)
    left_mm = min(_reached(found, decision.effects, decision.kind))
    if fit is None or fit.fits or fit.describes(left_mm):
        return ""
    named = (" or " if decision.kind == "ambiguous" else " and ").join(decision.effects)
    return (
        f"with {named} {left_mm:.3g} mm would remain of a motion of {fit.motion_mm:.3g} mm, so the "
        f"model does not describe this arm: {WHOSE_ARM}"
    )


def would_explain(found: Findings, decision: Decision, fitted: bool = True) -> list[str]:
    """Share that an effect would explain of an error that the fit had already.

    fitted: whether `surgisoft fit` made the model.
    """
    if decision.kind not in ("nothing_missing", "surrogate_undertrained", "cannot_tell"):
        return []
    if not found.first or found.selection.whole_size >= 1.0:
        return []
    best = found.first[0]
    chance = decision.probabilities.effects.get(best.effect, 0.0)
    if chance < WORTH_TELLING or found.selection.in_fit(best.effect):
        return []
    text = (
        f"{best.effect} would explain {100 * best.gain:.0f} % of the explainable error, but the "
        f"error is no larger than the model's validated error (both without their noise), so an "
        f"error of the {'fit' if fitted else 'model'} explains it as well"
    )
    if fitted and known_effects()[best.effect].stage in FRONT:
        text += f"; fit the network together with it (fit --effects {best.effect}) and compare"
    return [text]


def second_too(decision: Decision) -> list[str]:
    """An effect that may be missing beside a named one, in words; empty where none is likely."""
    chances = decision.probabilities
    if decision.kind not in ("identified", "ambiguous") or chances.pair < WORTH_TELLING:
        return []
    named = [name for name in chances.two if name in decision.effects]
    others = [name for name in chances.two if name not in decision.effects]
    if len(named) != 1 or len(others) != 1:
        return []
    return [
        f"{others[0]} may be missing beside {named[0]} (probability {chances.pair:.2f} that both "
        f"are): 'surgisoft improve' adds one after the other, as long as each lowers the error"
    ]


def smooth_error(levels: ErrorLevels, decision: Decision) -> list[str]:
    """That much of the error is one of the model itself, beside a named effect, in words.

    Every error on held-out blocks allows for a discrepancy of the model, a smooth function of the
    actuation. A model with the effect and without that function errs more.
    """
    alone = levels.discrepancy_alone
    if decision.kind not in NAMING or alone is None or alone > MOSTLY_SMOOTH * levels.before:
        return []
    return [
        "errors on held-out blocks allow for an error of the model itself, a smooth function of "
        f"the actuation, which alone takes the error from {levels.before:.3g} to {alone:.3g} mm; "
        "'surgisoft amend' says what the named effect leaves without it"
    ]


def amplitudes_that_vary(evidence: Evidence, decision: Decision) -> list[str]:
    """Named effects whose amplitude differs between motions, in words.

    An effect that is there has one amplitude, whatever the motion. Two that are named together are
    looked at beside each other.
    """
    own = {each.effect: each.variation for each in evidence.effects}
    for each in evidence.proposals:
        if decision.kind == "several" and set(each.effects) == set(decision.effects):
            own |= dict(zip(each.effects, each.variation, strict=False))
    found = [(name, own.get(name) or 0.0) for name in decision.effects]
    return [
        f"the amplitude of {name} differs between motions by {100 * math.sqrt(value):.0f} %, and "
        f"a missing effect has one amplitude: another effect, or a second one, may be the cause"
        for name, value in found
        if value >= VARIES
    ]


def _instead(evidence: Evidence) -> tuple[str, ...]:
    """Effects that explain the recordings about as well as one of two."""
    pair = next((each for each in evidence.proposals if len(each.effects) == 2), None)
    if pair is None:
        return ()
    both = zip(pair.instead, pair.instead_margin, strict=True)
    return tuple(dict.fromkeys(name for name, margin in both if margin < AS_GOOD))


def knock(evidence: Evidence, recordings: int = 1) -> str:
    """End of the sentence on an unknown effect: that it may be a knock of the base, or empty.

    Said where a turn at one moment is better than the best effect by 5 %, one-sided. recordings:
    how many there are.
    """
    if evidence.sudden_margin <= AS_GOOD:
        return ""
    best = evidence.proposals[0].effects[0]
    when = f"{evidence.sudden_at_s:.0f} s" + " (all recordings in turn)" * (recordings > 1)
    return f"; a turn of the whole body at {when}, as by a knock, explains more than {best}"


def _reached(found: Findings, effects: tuple[str, ...], kind: Kind) -> list[float]:
    """Held-out error with the named effects, or with each of a set, mm."""
    apart = [(effect,) for effect in effects] if kind == "ambiguous" else [effects]
    return [_left_by(found, each) for each in apart]


def periodic(evidence: Evidence) -> str:
    """End of the sentence on an unknown effect: that it is a periodic motion, or empty.

    Said where most of what a black box with memory leaves is in one line of its spectrum.
    """
    if evidence.line < MOSTLY or not evidence.line_hz:
        return ""
    return (
        f"; {100 * evidence.line:.0f} % of what no function of the actuation explains is a motion "
        f"at {evidence.line_hz:.3g} Hz that the actuation does not have, as of a base that moves"
    )


def jumping(evidence: Evidence, recordings: int = 1) -> list[str]:
    """That the body jumps, in words; empty where jumps are not a part of the error.

    recordings: how many there are.
    """
    if evidence.jumps < CLEAR_JUMPS:
        return []
    often = "once" if evidence.jump_count == 1 else f"{evidence.jump_count} times"
    when = f"at {evidence.jump_largest_s:.2f} s" + ", all recordings in turn" * (recordings > 1)
    return [
        f"the body jumps {often}, by up to {evidence.jump_largest_mm:.3g} mm ({when}), while "
        "neither the actuation nor the predicted motion jumps (possible causes: stick-slip "
        "friction, snap-through of the wall, impacts on the arm or its base, lost markers)"
    ]


def slipped(evidence: Evidence, recordings: int = 1) -> list[str]:
    """That one key point shifts against the others, in words; empty where none does.

    recordings: how many there are.
    """
    if evidence.shift < CLEAR_SHIFT:
        return []
    turn = ", all recordings in turn" * (recordings > 1)
    if evidence.slide_until_s:
        stretch = f"{evidence.slide_from_s:.0f} s to {evidence.slide_until_s:.0f} s"
        return [
            f"key point k{evidence.shift_key_point} slides gradually, by about "
            f"{evidence.slide_mm:.2g} mm against the others from about {stretch}{turn} (or in "
            "several steps): its marker has probably come loose, so fix it and record again, or "
            "leave this key point out"
        ]
    when = f"{evidence.shift_at_s:.0f} s on{turn}"
    return [
        f"key point k{evidence.shift_key_point} is shifted by {evidence.shift_mm:.3g} mm against "
        f"the others from {when}: its marker has probably slipped, so use the rows before that "
        "time or record again"
    ]


def before_the_slip(evidence: Evidence, table: ResidualTable) -> str:
    """The command to run after a marker has slipped, with {model}, {data} and {before}.

    Of one recording the rows before the slip are written; which of several it is in is not said.
    Nothing where the marker slides, because no rows are without an error then.
    """
    if evidence.slide_until_s:
        return ""
    until = int(evidence.shift_at_s - SLIP_MARGIN * table.along_s[-1])
    if len(table.names) > 1 or until <= 0:
        return WITHOUT_SLIP
    return CUT_AT_SLIP.format(until=until)


def error_along(problem: Problem) -> ErrorAlong | None:
    """The error of each block of time; None for samples without a clock."""
    if not problem.table.timed.all():
        return None
    square = np.nansum(np.square(problem.residual), axis=(1, 2))
    rows = np.bincount(problem.block)
    blocks = np.flatnonzero(rows)
    mean = np.bincount(problem.block, square)[blocks] / rows[blocks] / problem.residual.shape[1]
    along_s = problem.table.along_s[problem.index.numpy()]
    times = [along_s[problem.block == block] for block in blocks]
    return ErrorAlong(
        from_s=tuple(float(each.min()) for each in times),
        to_s=tuple(float(each.max()) for each in times),
        rmse_mm=tuple(np.sqrt(mean).tolist()),
    )


def local_error(along: ErrorAlong | None, recordings: int = 1) -> list[str]:
    """Where the error is much larger than elsewhere, in words; empty where it is spread out.

    An effect that acts in few postures, such as a contact, hardly shows in the mean of all rows.
    recordings: how many there are.
    """
    if along is None or not any(along.local):
        return []
    worst = int(np.argmax(along.rmse_mm))
    turn = ", all recordings in turn" * (recordings > 1)
    return [
        f"the error is concentrated from {_stretch(along.from_s[worst], along.to_s[worst])}{turn}: "
        f"{along.rmse_mm[worst]:.3g} mm, {along.rmse_mm[worst] / along.typical_mm:.1f} "
        "times the median of all blocks of time (possible causes: the arm touches something, a "
        "part gives way); 'surgisoft compare --report' shows where on the body"
    ]


def _stretch(from_s: float, to_s: float) -> str:
    """A stretch of time in words, to as many digits as tell its ends apart."""
    digits = next((n for n in range(3) if to_s - from_s >= 10.0**-n), 3)
    return f"{from_s:.{digits}f} to {to_s:.{digits}f} s"


def _left_by(found: Findings, effects: tuple[str, ...]) -> float:
    """Held-out error with effects, mm."""
    selection = found.selection
    for proposal in found.proposals:
        if set(proposal.effects) == set(effects):
            return selection.rmse_mm(selection.losses(proposal.chosen))
    first = next((score for score in found.first if score.effect in effects[:1]), None)
    return selection.rmse_mm(selection.losses() if first is None else first.losses)


def _order(found: Findings, decision: Decision) -> list[Score]:
    """All effects, the named ones first, then the most probable.

    An effect that is plausible only on top of another has its score on top of that one.
    """
    scores = {s.effect: s for proposal in found.proposals for s in proposal.scores}
    scores |= {score.effect: score for score in found.first}
    chances = decision.probabilities.effects
    names = list(decision.effects)
    names += [name for name in chances if name not in names]
    return [scores[name] for name in names if name in scores]


def _ranked(found: Findings, score: Score, decision: Decision) -> Ranked:
    """One row of the ranking."""
    selection, chances = found.selection, decision.probabilities
    sure = chances.effects.get(score.effect, 0.0)
    effect = selection.in_best_form(score, _beside(found, score, decision))
    named = effect is not None and score.effect in decision.effects
    less = named and selection.taken_away(score.option)
    if score.effect in chances.two:
        sure = max(sure, chances.pair)
    return Ranked(
        effect=score.effect,
        confidence=round(float(sure), 4),
        gain_alone=_share(score.gain),
        gain_unique=_share(found.unique.get(score.effect, 0.0)),
        heldout_rmse_mm=selection.rmse_mm(score.losses),
        ci95=rmse_interval(found.problem, score.losses, selection.validation.counts),
        p_value=float(score.p_value),
        log_gain=float(score.log_gain.mean()),
        parameters={} if effect is None else {q.name: q.value for q in effect.quantities()},
        in_words=estimate_in_words(effect, found.problem.covered_s, less)
        if effect and named
        else "",
    )


def _beyond(quantity: Quantity) -> bool:
    """Whether a value lies outside its plausible range by more than it is printed to."""
    slack = PRINTED * max(abs(quantity.low), abs(quantity.high))
    values = np.ravel(quantity.value)
    return bool((values < quantity.low - slack).any() or (values > quantity.high + slack).any())


def estimate_in_words(effect: Effect, seconds: float | None, less: bool = False) -> str:
    """What first estimates mean in words, and which of them is beyond its plausible range.

    seconds: duration of the recordings, s. less: whether the effect acts less than before, so that
    its amplitudes have the other sign.
    """
    text = in_words(effect.readings(seconds))
    wrong = [each for each in effect.quantities() if _beyond(each)]
    if not text or not wrong or less:
        return text
    one = wrong[0]
    return (
        f"{text} (not plausible: {one.name} = {values_text(one.value)}, expected "
        f"{values_text(one.low)} to {values_text(one.high)})"
    )


def _beside(found: Findings, score: Score, decision: Decision) -> tuple[int, ...]:
    """Sensitivities that are fitted beside an effect: those of the others, where two are named."""
    if decision.kind != "several" or score.effect not in decision.effects:
        return ()
    for proposal in found.proposals:
        if set(proposal.effects) == set(decision.effects):
            others = (each.option for each in proposal.scores if each.effect != score.effect)
            return sum((option.chosen for option in others), ())
    return ()


def _share(value: float) -> float:
    return float(min(max(value, 0.0), 1.0))


def nearest(ranking: Sequence[Ranked]) -> str | None:
    """The effect that alone explains most; None where that is next to nothing."""
    best = max(ranking, key=lambda row: row.gain_alone, default=None)
    return best.effect if best is not None and best.gain_alone >= LEAST_EXPLAINED else None


def sentence_of(
    decision: Decision,
    levels: ErrorLevels,
    reached: Sequence[float],
    where: str = HELD_OUT,
    static: bool = False,
    near: str | None = None,
    fitted: bool = True,
) -> str:
    """The verdict in words. reached: error with the named effects, or with each of a set, on blocks
    that these were not fitted to, mm; where: these blocks in words; static: whether a function of
    the actuation alone explains most of what can be explained; near: the effect that comes nearest
    to an unknown one; fitted: whether `surgisoft fit` made the model."""
    kind, effects, sure = decision.kind, decision.effects, decision.confidence
    error = levels.in_words
    if kind == "identified":
        return (
            f"{effects[0]} is missing (confidence {sure:.2f}): with it {reached[0]:.3g} mm remain "
            f"on {where}; {error}"
        )
    if kind == "several":
        together = " and ".join(effects)
        return (
            f"{together} are missing (confidence {sure:.2f} in both): with them "
            f"{reached[0]:.3g} mm remain on {where}; {error}"
        )
    if kind == "ambiguous":
        left = f"each would leave about {reached[0]:.3g} mm on {where}"
        if max(reached) > ABOUT * min(reached):
            left = f"{_each_leaves(decision, reached)} on {where}{_one_alone(decision, reached)}"
        head = f"cannot tell {' from '.join(effects)} with these recordings"
        chances = [decision.probabilities.effects.get(name, 1.0) for name in effects]
        if chances[1] < FAR_BEHIND and chances[0] >= PROBABLY:
            left = left.partition(", which makes it ")[0]
            head = (
                f"{effects[0]} is probably missing, with a probability of {chances[0]:.2f}; "
                f"{effects[1]} comes next, with {chances[1]:.2f}"
            )
        return f"{head} (confidence {sure:.2f} that it is one of them): {left}; {error}"
    if kind == "unknown_effect":
        return (
            f"the missing effect is none of the known ones (confidence {sure:.2f}; "
            f"{f'nearest: {near}' if near else 'none is near'}); {error}"
        )
    if kind == "surrogate_undertrained":
        why = _why(decision.reason or "announced", levels, static, fitted)
        head = f"the model itself is off (confidence {sure:.2f}), so no effect is sought yet"
        return f"{head}: {why}; {error}"
    if kind == "cannot_tell":
        why = _why(decision.reason or "schedule", levels, static, fitted)
        most = _most_probable(decision)
        most = f" (most probable: {most})" if most else ""
        return f"{CANNOT_TELL}: {why}{most}; {error}"
    return f"these recordings show no missing effect (confidence {sure:.2f}); {error}"


def _each_leaves(decision: Decision, reached: Sequence[float]) -> str:
    """The error that each effect of a set would leave, beside its name."""
    first, *others = zip(decision.effects, reached, strict=True)
    parts = [f"{first[0]} would leave {first[1]:.3g} mm"]
    parts += [f"{name} {value:.3g} mm" for name, value in others]
    return " and ".join(parts)


def _one_alone(decision: Decision, reached: Sequence[float]) -> str:
    """Why the effect that leaves least is not named alone: its probability, which was calibrated on
    other arms, where the effect that left more was the missing one in such a share of cases."""
    least = decision.effects[int(np.argmin(reached))]
    alone = decision.probabilities.effects.get(least)
    if alone is None:
        return ""
    return f", which makes it {least} with a probability of {alone:.2f} only"


def _why(reason: str, levels: ErrorLevels, static: bool, fitted: bool) -> str:
    """A reason in words: what is said of the error follows from the numbers."""
    if reason == "network" and static:
        reason = "static"
    return (REASONS if fitted else REASONS_OF_OTHERS)[reason].format(size=levels.size)


def _most_probable(decision: Decision) -> str:
    """The two most probable statements about one effect, two, or none, in words; empty where none
    could be made."""
    if not decision.statements:
        return ""
    said = {
        MENTIONED[one.kind].format(" and ".join(one.effects)): one.probability
        for one in decision.statements
        if one.kind in MENTIONED
    }
    for effect, chance in decision.probabilities.effects.items():
        said.setdefault(MENTIONED["identified"].format(effect), chance)
    most = sorted(said.items(), key=lambda each: -each[1])
    return ", ".join(f"{words} {chance:.2f}" for words, chance in most[:2])


def next_command(decision: Decision, trainable: bool = True, fitted: bool = True) -> str:
    """Command to run after a result, with `{model}`, `{data}` and `{before}` for the files.

    trainable: whether the model can be trained on together with effects. fitted: whether `surgisoft
    fit` made the model; to another one a fit of a network to the recordings is no answer.
    """
    kind, names = decision.kind, decision.effects
    if kind in ("identified", "several"):
        return (
            f"surgisoft amend {{model}} --effect {' '.join(names)} --data {{data}}{{before}} -o NEW"
        )
    if decision.reason == "repeatability":
        return ""
    between = names or tuple(decision.probabilities.effects)[:2]
    plan = "surgisoft next-experiment {model} {data}{before}"
    if between:
        plan += f" --between {' '.join(between)}"
    plan += " -o SCHEDULE.csv"
    if kind == "ambiguous":
        return plan
    off = decision.reason in ("network", "arm") or (
        kind == "surrogate_undertrained" and not decision.reason
    )
    if not fitted and (off or decision.reason == "learned"):
        return WHERE_IT_ACTS
    if off:
        return "surgisoft fit {data} -o NEW"
    if decision.reason == "learned" and trainable:
        return "surgisoft diagnose {model} {data} --refit always"
    if decision.reason == "learned":
        known = known_effects()
        inside = [n for n in decision.probabilities.effects if known[n].stage in FRONT]
        effects = " ".join(inside[:MOST_FITTED])
        return f"surgisoft fit {{data}} --inputs pressure --effects {effects} -o NEW"
    if kind == "cannot_tell":
        return plan
    if kind == "unknown_effect":
        return WHERE_IT_ACTS
    return ""


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
