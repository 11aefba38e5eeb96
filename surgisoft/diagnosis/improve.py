"""`improve`: diagnose and amend in turn, until no further effect is significant.

Every round adds an effect that a diagnosis names and fits it together with those that were added
before. The network's last layer is re-tuned at the end, where the quarters of the training rows
that are left out of the fits in turn reward it (`estimation.network`). All of this sees the
training rows of the recordings only; the held-out rows are evaluated once, at the end, for the
errors of all rounds, and decide nothing but whether the whole fall is claimed.

With recordings from before a change, every round diagnoses and amends that change: the paired
difference, of which the given model predicts BEFORE in all rounds, or the model's residuals less
what of those on BEFORE can be learned. The network, which was fitted to neither, stays as it is.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from numbers import Integral

from surgisoft.diagnosis.amend import Fall, Track, errs_more, fall_of, of_change, track_of
from surgisoft.diagnosis.amended_error import state_error, state_residuals
from surgisoft.diagnosis.data_quality import collinear_hints
from surgisoft.diagnosis.diagnose import (
    Diagnosis,
    diagnose,
    diagnose_change,
    lacking_before,
    with_setup,
)
from surgisoft.diagnosis.estimation.effects import Fitted, fit_effects, fit_plausible
from surgisoft.diagnosis.estimation.intervals import (
    Estimates,
    Parameter,
    beside_former,
    values_text,
)
from surgisoft.diagnosis.estimation.network import retune
from surgisoft.diagnosis.inputs import Model, Recordings, open_inputs, refuse_amended
from surgisoft.diagnosis.other_models import name_of, open_model, refuse_predictions
from surgisoft.diagnosis.pairs import Change, Paired, before_and_after
from surgisoft.diagnosis.refit import JointFit, apart_mm, fit_together, in_front
from surgisoft.diagnosis.residuals import Sealed, model_discrepancy, residual_table
from surgisoft.diagnosis.setup import find_setup_faults
from surgisoft.errors import InputError, Interrupted, wrong_type
from surgisoft.files import with_former_keys
from surgisoft.measurement.recordings import Recording, load_recordings
from surgisoft.progress import Progress as RefitProgress
from surgisoft.progress import silent
from surgisoft.surrogate.effects import FRONT
from surgisoft.surrogate.effects.user_defined import kind_of
from surgisoft.surrogate.fitted_rows import FittedRows
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.training_residuals import TrainingResiduals
from surgisoft.workers import torch_threads

MOST_EFFECTS = 6
"""Most effects that are added."""
PLAUSIBLE_GAIN = 0.95
"""Least share of the fall of the squared error that an effect must keep at the end of its plausible
range; it is then held there."""
NEARLY = 0.9
"""Least share of the fall of the squared error by an implausible effect that a plausible one has to
reach to take its place."""
LIKELY = 0.5
"""Probability that an effect of the list is missing from which the most probable one is tried."""
NETWORK = "network"
"""Name of the step that re-tunes the network."""
RETUNED = "retuned"
"""Kind of the verdict of that step: no diagnosis is made for it."""
INTERRUPTED = "interrupted"
"""Kind of the verdict of the last round where Ctrl-C ended the loop."""


FORMER_KEYS = {"rivals": "competing", "error_open_mm": "error_training_mm"}
"""Deprecated keys of the JSON of a round, each with its present name."""


@dataclass(frozen=True, eq=False)
class Round:
    """One round: the result of a diagnosis and what was done."""

    verdict: str
    """Kind of the verdict."""
    sentence: str
    """The verdict in words."""
    step: str | None
    """The effect that was added or fitted anew, or `network`; None where the loop ended."""
    competing: tuple[str, ...]
    """Effects that would fit about as well."""
    confidence: float | None
    """Confidence in it, 0 to 1."""
    error_training_mm: float
    """RMS distance on the training rows after the round, mm."""
    error_mm: float | None = None
    """RMS distance on the held-out rows after the round, known when all rounds have ended, mm."""
    together: bool = False
    """Whether the effect was fitted together with the whole network."""
    anew: bool = False
    """Whether it is an effect of a former round, of which another form was sought."""

    def to_json(self) -> dict:
        """Plain values; see `FORMER_KEYS` for deprecated names."""
        return with_former_keys(asdict(self) | {"competing": list(self.competing)}, FORMER_KEYS)


Progress = Callable[[Round], None]
"""Called after each round."""


@dataclass(frozen=True)
class _Made:
    """A model of the loop, with what belongs to it."""

    model: ArmModel
    fitted: ArmModel
    """The model of the fit: the given one, or that of the last fit together with the network."""
    parameters: tuple[Parameter, ...] = ()
    in_words: dict[str, str] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _Tried:
    """An effect, fitted beside those that were added before."""

    name: str
    """Name of the effect."""
    fitted: Fitted | JointFit
    """The model with it."""
    fall: Fall
    """Fall of the error on the training rows."""
    doubt: str
    """Why it is not added; empty where it may be."""

    @property
    def strange(self) -> str:
        """That the error falls by it with implausible values alone; empty where they are plausible,
        or where it does not fall."""
        return _implausible(self.name, self.fall, self.fitted.parameters, lambda p: p.plausible)

    def gives_way_to(self, other: "_Tried") -> bool:
        """Whether another effect does nearly as much, with plausible values."""
        return not (other.doubt or other.strange) and _as_good(other.fall, self.fall, NEARLY)


@dataclass(frozen=True, eq=False)
class Improvement:
    """A model with every effect that was significant and lowered the error."""

    model: ArmModel
    """The new model; the given one where nothing was added."""
    rounds: tuple[Round, ...]
    """What happened; the last one gives the reason why the loop ended."""
    parameters: tuple[Parameter, ...]
    """The fitted parameters of all added effects, beside those that the given model had."""
    held_out: Fall
    """The error on the held-out rows, before the first and after the last round; of the paired
    difference where there is one."""
    tracks: tuple[Track, Track]
    """The error along the training and along the held-out rows."""
    seconds: float
    """Time that it took, s."""
    notes: tuple[str, ...] = ()
    """Recordings under another direction of gravity, or beyond the range of the model's fit."""
    diagnoses: tuple[Diagnosis, ...] = ()
    """The diagnosis of each model in turn: the first is that of the given one."""
    amended_from: str = ""
    """Name of the given model; empty for one that was given as an object."""
    recordings: tuple[str, ...] = ()
    """Names of the recordings."""
    change: Change | None = None
    """How far the recordings differ from those before the change; where rows are paired, errors are
    those of the paired difference, and None where no recordings from before were given."""
    model_error: Fall | None = None
    """The error of the model itself on the held-out rows, where the others are paired
    differences."""
    in_words: dict[str, str] = field(default_factory=dict)
    """What the parameters mean, by effect; empty where the recordings do not tell."""

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended the loop: the rounds are those that were finished before."""
        return self.rounds[-1].verdict == INTERRUPTED

    @property
    def steps(self) -> list[tuple[str, float]]:
        """(what was added, error on the held-out rows after it in mm), in order."""
        return [
            (r.step, r.error_mm)
            for r in self.rounds
            if r.step is not None and r.error_mm is not None
        ]

    @property
    def claimed(self) -> bool:
        """Whether something was added and the error fell by it.

        Where the given model had been fitted to held-out rows, its error there is smaller than on
        data that took no part. A network that was trained on together with effects is compared with
        it all the same, and with the network alone in its round; any other fall is not claimed.
        """
        if self.held_out.in_fit and any(done.together for done in self.rounds):
            return bool(self.steps) and self.held_out.significant
        return bool(self.steps) and self.held_out.claimed

    @property
    def sentence(self) -> str:
        """The outcome in words."""
        if not self.steps:
            return f"nothing was added: {self.rounds[-1].sentence}"
        names, fall = " + ".join(dict.fromkeys(name for name, _ in self.steps)), self.held_out
        if self.claimed and fall.in_fit:
            where = f"on rows of which the given model had been fitted to {fall.in_fit:.0%}"
            return (
                f"{names}: error reduced from {fall.numbers(where)}, fitted together with the "
                "network; none of these errors is on unseen data"
            )
        text = fall.sentence
        if self.model_error is not None:
            text = of_change(fall, self.change, self.model_error)
        return f"{names}: {text}"

    def to_json(self) -> dict:
        """Plain values, as `improve --json` writes them.

        The new model's folder keeps them too: `save_model(found.model, folder, found.to_json())`.
        """
        return {
            "sentence": self.sentence,
            "claimed": self.claimed,
            "interrupted": self.interrupted,
            "effects": [name for name in dict(self.steps) if name != NETWORK],
            "network_retuned": any(name == NETWORK for name, _ in self.steps),
            "error_mm": self.held_out.to_json(),
            "rounds": [each.to_json() for each in self.rounds],
            "parameters": [parameter.to_json() for parameter in self.parameters],
            "in_words": self.in_words,
            "notes": list(self.notes),
            "seconds": self.seconds,
            "amended_from": self.amended_from,
            "recordings": list(self.recordings),
            "change": self.change and self.change.to_json(),
            "error_model_mm": self.model_error and self.model_error.to_json(),
        }


@torch_threads(1)
def improve(
    model: Model,
    recordings: Recordings,
    most_effects: int = MOST_EFFECTS,
    progress: Progress | None = None,
    reference: Sequence[Recording] | TrainingResiduals | None = None,
    refit: str = "auto",
    refit_progress: RefitProgress = silent,
    processes: int = 1,
    error_mm: float | None = None,
    before: Recordings | None = None,
    paired: Paired = "auto",
) -> Improvement:
    """Add effects to a model one by one, until no further one is significant.

    Each round is `diagnose` on the first three quarters of each recording, and the fit of the
    effect that it names; `Improvement` has the rounds, the model, and its error on the last
    quarter, mm. The given model stays as it is. Raises InputError as `amend` does. Ctrl-C raises
    `Interrupted` (`surgisoft.errors`) with the rounds that are finished, or KeyboardInterrupt where
    none has added anything.

    Model and recordings may be given by their paths; a callable, or its name, is a model too, with
    error_mm as its validated error, mm (docs/your_model.md).

    before, paired, reference, refit, refit_progress, processes: as for `diagnose`. An effect that a
    refit names is fitted together with the whole network. With recordings from before a change,
    every round names and adds what has changed since, and the network stays as it is; where rows
    are paired, errors are those of the paired difference, and `Improvement.model_error` is that of
    the model itself.
    """
    if not isinstance(most_effects, Integral):
        raise wrong_type("the largest number of effects", most_effects, "an integer")
    if most_effects < 1:
        raise InputError(f"largest number of effects is {most_effects}, expected 1 or more")
    begin = time.perf_counter()
    tell = progress or (lambda done: None)
    refuse_predictions(model)
    given = name_of(model)
    if before is None and not isinstance(reference, TrainingResiduals | None):
        before, reference = reference, None
    model, recordings, before = open_model(model, recordings, before, None, error_mm)
    model, recordings, notes = open_inputs(model, recordings, compared=before is not None)
    sealed = Sealed(recordings)
    recordings = sealed.training
    table = residual_table(model, recordings)
    problem = table.training()
    both, earlier = None, []
    if before is not None:
        if refit == "always":
            raise InputError(
                "--refit always trains the network too, but with --before only the change since "
                "then is explained, which the network never saw; leave out one of the two"
            )
        earlier = load_recordings(before)
        refuse_amended(model, recordings, earlier)
        both = before_and_after(table, earlier, paired).with_final_check()
        # Named by the change, which residuals tell without pairs, and fitted to the residuals.
        limits = (*both.notes, *both.notes_of_fit, *lacking_before(both, lambda text: None))
        notes = (*notes, *dict.fromkeys(limits))
        problem = both.table.training()
        asked = both.training()
    is_paired = both is not None and both.used
    of_model = table.training()
    made, rounds = [_Made(model, model)], []
    diagnoses: list[Diagnosis] = []
    added: list[str] = []
    anew: list[str] = []  # of these, what was fitted in another form
    trained = False  # whether the network was trained on these rows

    def note(done: Round) -> None:
        rounds.append(done)
        tell(done)

    def diagnosis_of(current: _Made) -> Diagnosis:
        if both is not None:
            wrong = None if added else find_setup_faults(current.model, recordings)
            if wrong is not None:
                return with_setup(wrong)
            return diagnose_change(asked.with_model(current.model), both, lambda text: None)
        return diagnose(
            current.model,
            recordings,
            reference=current.fitted.training_residuals if reference is None else reference,
            refit=refit,
            refit_progress=refit_progress,
            processes=processes,
            setup_tests=not added,
        )

    def in_another_form(found: Diagnosis, current: Round) -> bool:
        """Fit an effect anew that was added before and is named again; whether that helps.

        Its form was chosen while others were missing, and another form may now do more.
        """
        again = [name for name in found.verdict.effects if name in added and name not in anew]
        if not again:
            return False
        name = again[0]
        anew.append(name)
        model, posed = made[-1].model, problem.with_model(made[-1].model)
        less = {key: effect for key, effect in model.effects.items() if key != name}
        others = [key for key in added if key != name]
        without = problem.with_model(model.replace(effects=less))
        fitted = fit_effects(without, [*others, name])
        fall = fall_of(posed, problem.with_model(fitted.model))
        if _doubt(name, fall, fitted.parameters):
            return False
        made.append(_Made(fitted.model, made[-1].fitted, fitted.parameters, fitted.in_words))
        note(replace(_step(current, name, found, fall.after), anew=True))
        return True

    def attempt(name: str, found: Diagnosis) -> _Tried:
        """Fit an effect beside those that were added; together with the network where the diagnosis
        did so and that leaves less."""
        posed = problem.with_model(made[-1].model)
        fitted: Fitted | JointFit
        together = found.refit is not None and found.refit.winner == name
        if found.refit is not None and together and refit == "auto" and not trained:
            plain_mm = apart_mm(posed, [*added, name])
            together = plain_mm is None or plain_mm > found.refit.of(name).heldout_rmse_mm
        if found.refit is not None and together:
            validated = found.refit.of(name)
            trained_with = [*in_front(added), name]
            fitted = fit_together(posed, trained_with, validated, progress=refit_progress)
            fitted = fitted.beside(made[-1].parameters, made[-1].in_words)
        else:
            fitted = fit_effects(posed, [*added, name], more=[name])
            name = fitted.key(name)
        fall = fall_of(posed, problem.with_model(fitted.model))
        doubt = _doubt(name, fall, fitted.parameters)
        if not doubt and isinstance(fitted, JointFit):
            alone, both_ = (problem.with_model(each) for each in (fitted.alone, fitted.model))
            doubt = _idle(name, fall_of(alone, both_))
        if not doubt and is_paired and added:
            was, now = (of_model.with_model(each) for each in (made[-1].model, fitted.model))
            doubt = _harmful(name, fall_of(was, now))
        tried = _Tried(name, fitted, fall, doubt)
        if tried.strange and isinstance(fitted, Fitted):
            held = fit_plausible(posed, fitted, [*added, name], name)
            if held is not None:
                less = fall_of(posed, problem.with_model(held.model))
                held_doubt = _doubt(name, less, held.parameters)
                if _as_good(less, fall) and not held_doubt:
                    return _Tried(name, held, less, held_doubt)
        return tried

    def add_effects() -> None:
        nonlocal problem, trained
        going = True
        while going and len(added) < most_effects:
            found = diagnosis_of(made[-1])
            diagnoses.append(found)
            error = fall_of(problem, problem.with_model(made[-1].model)).after
            current = Round(found.verdict.kind, found.verdict.sentence, None, (), None, error)
            kinds = [kind_of(name) for name in added]
            names = next_effects(found, kinds)
            if names:
                sealed.check(table)
            going = False
            for name in names[: most_effects - len(added)]:
                if name in added:  # in the place of another one of the same diagnosis
                    continue
                tried = attempt(name, found)
                if tried.strange:
                    rivals = (attempt(each, found) for each in alternatives(found, name, kinds))
                    other = next(filter(tried.gives_way_to, rivals), None)
                    if other is not None:
                        why = f"{other.name} in its place: {tried.strange}"
                        current = replace(current, sentence=f"{current.sentence}; {why}")
                        tried = other
                if tried.doubt:
                    current = replace(current, sentence=f"{current.sentence}; but {tried.doubt}")
                    continue
                going = True
                added.append(tried.name)
                of_fit = made[-1].fitted
                if isinstance(tried.fitted, JointFit):
                    trained = True
                    of_fit = tried.fitted.model
                    discrepancy = model_discrepancy(tried.fitted.model, problem.noise_mm)
                    problem = replace(problem, discrepancy_mm=discrepancy)
                made.append(
                    _Made(
                        tried.fitted.model, of_fit, tried.fitted.parameters, tried.fitted.in_words
                    )
                )
                together = isinstance(tried.fitted, JointFit)
                note(
                    replace(_step(current, tried.name, found, tried.fall.after), together=together)
                )
                current = replace(
                    current, sentence=f"named beside {tried.name} by the same diagnosis"
                )
            if not going and not names:
                going = in_another_form(found, current)
            if not going:
                note(current)
        tuned = retune(made[-1].model, problem, added) if added and both is None else None
        if tuned is not None and tuned.kept:
            after = fall_of(problem, problem.with_model(tuned.model)).after
            why = (
                f"the network's last layer, re-tuned, lowers the squared error by "
                f"{100 * tuned.gain:.0f} % in the quarters of the training part that were left out "
                "of its fit and of the effects' fit in turn"
            )
            made.append(replace(made[-1], model=tuned.model))
            note(Round(RETUNED, why, NETWORK, (), None, after))

    try:
        add_effects()
    except KeyboardInterrupt:
        steps = [done for done in rounds if done.step is not None]
        if not steps:  # nor is a diagnosis, which `Interrupted` may hold, a result of this function
            raise KeyboardInterrupt from None
        del made[len(steps) + 1 :]
        rounds.append(_interrupted(steps))
    final_model = made[-1].model
    if final_model is not model:
        retuned = any(done.step == NETWORK for done in rounds)
        of_fit = made[-1].fitted
        state_residuals(final_model, of_fit, retuned)
        trained = retuned or any(done.together for done in rounds)
        own = FittedRows.of_amending(table.history, trained)
        final_model.fitted_rows = own.joined(model.fitted_rows)
    sealed.check(table)
    opened = sealed.opened(table)
    held_out = whole = opened.final_check()
    if is_paired:
        held_out = before_and_after(opened, earlier, "always").table.final_check()
    after_round = iter([held_out.with_model(each.model) for each in made[1:]])
    final, shown = held_out, []
    for done in rounds:
        final = next(after_round) if done.step is not None else final
        shown.append(replace(done, error_mm=fall_of(held_out, final).after))
    last = Estimates(list(made[-1].parameters), made[-1].in_words)
    parameters, words = beside_former(last, model, problem.covered_s)
    new = [effect for name, effect in final_model.effects.items() if name in added]
    if any(effect.stage in FRONT for effect in new):
        notes = (*notes, *collinear_hints(table))
    model_error = fall_of(whole, whole.with_model(final_model)) if is_paired else None
    result = Improvement(
        model=final_model,
        rounds=tuple(shown),
        parameters=parameters,
        held_out=fall_of(held_out, final),
        tracks=(track_of(problem, problem.with_model(final_model)), track_of(held_out, final)),
        seconds=time.perf_counter() - begin,
        notes=(*notes, *errs_more(model_error)),
        diagnoses=tuple(diagnoses),
        amended_from=given,
        recordings=tuple(each.name for each in recordings),
        change=None if both is None else both.change,
        model_error=model_error,
        in_words=words,
    )
    if result.held_out.claimed:
        state_error(final_model, made[-1].fitted, whole)
    if result.interrupted:
        raise Interrupted(result)
    return result


def next_effects(found: Diagnosis, added: Sequence[str] = ()) -> tuple[str, ...]:
    """The effects to add after a diagnosis, in order; none where the loop ends.

    Of effects that cannot be told apart the first is taken that was not added before: the error
    falls with any of them. Where the first diagnosis cannot tell, but an effect of the list is more
    likely missing than not, the most probable one is tried: it stays only if the error falls by it.
    Later that one itself has to be more likely missing than not: what an added effect's formula
    gets wrong looks as much like another effect (docs/results/decision.md#two-effects-and-improve).

    None is tried where the model does not describe the arm.

    added: effects of former rounds.
    """
    kind, chances = found.verdict.kind, found.probabilities
    effects = found.verdict.effects
    if found.verdict.reason == "arm":
        return ()
    if kind == "cannot_tell" and chances is not None:
        first = next(iter(chances.effects), None)
        if first is None or first in added:
            return ()
        return (first,) if (chances.effects[first] if added else chances.known) > LIKELY else ()
    left = tuple(name for name in effects if name not in added)
    return left[:1] if kind == "ambiguous" else left


def _as_good(held: Fall, free: Fall, share: float = PLAUSIBLE_GAIN) -> bool:
    """Whether the squared error falls by nearly as much: in the plausible range as beyond it, or by
    another effect."""
    gains = [one.before**2 - one.after**2 for one in (held, free)]
    return gains[0] >= share * gains[1]


def alternatives(found: Diagnosis, name: str, added: Sequence[str] = ()) -> list[str]:
    """Effects that a diagnosis cannot tell from the named one, and that were not added.

    They are tried where the named one fits with implausible values only: what a lag of the line
    leaves may look most like inertia, with more than the whole of the arm swinging. Other effects
    are not, whatever they explain: on robots of another physics they took the place of effects that
    were missing.
    """
    either = found.verdict.effects if found.verdict.kind == "ambiguous" else ()
    others = dict.fromkeys((*either, *found.ambiguous_with))
    return [other for other in others if other != name and other not in added]


def _doubt(name: str, fall: Fall, parameters: tuple[Parameter, ...]) -> str:
    """Why an effect is not added, whatever the diagnosis says; empty where it may be."""
    if not fall.significant:
        return f"{name}, fitted through the whole model, does not lower the error"
    return _implausible(name, fall, parameters, lambda p: p.may_be_plausible)


def _implausible(
    name: str,
    fall: Fall,
    parameters: tuple[Parameter, ...],
    plausible: Callable[[Parameter], bool],
) -> str:
    """That the error falls by an effect with an implausible value; empty where that is not so."""
    wrong = [p for p in parameters if p.effect == name and not plausible(p)]
    if not wrong or not fall.significant:
        return ""
    low, high = wrong[0].plausible_range
    return (
        f"{name} would lower the error to {fall.after:.3f} mm only with an implausible "
        f"{wrong[0].name} = {values_text(wrong[0].value)}, expected {values_text(low)} to "
        f"{values_text(high)}"
    )


def _idle(name: str, fall: Fall) -> str:
    """Why an effect that was fitted together with the network is not added; empty if it may be.

    fall: from the network trained for as many epochs without the effect to the network with it.
    """
    if fall.significant:
        return ""
    return f"the network alone, trained for as many epochs as with {name}, lowers the error as far"


def _harmful(name: str, fall: Fall) -> str:
    """Why an effect that explains some of a change is not added to others; empty if it may be.

    The first effect of a change is added even where it cancels an error of the model: it tells what
    has changed. Little of the change is left for a further one, and the model is to gain by it.

    fall: of the error of the model itself on the training rows.
    """
    if fall.fall >= 0.0:
        return ""
    return (
        f"{name} explains some of the change, and the model itself errs more with it: "
        f"{fall.before:.3f} to {fall.after:.3f} mm on the training part"
    )


def _interrupted(steps: list[Round]) -> Round:
    """The last round of a loop that Ctrl-C ended after some steps."""
    names = " and ".join(str(done.step) for done in steps)
    why = f"Ctrl-C ended the loop after {names}; whether an effect is still missing was not decided"
    return Round(INTERRUPTED, why, None, (), None, steps[-1].error_training_mm)


def _step(current: Round, name: str, found: Diagnosis, error_mm: float) -> Round:
    """The round in which the named effect was added."""
    either = found.verdict.effects if found.verdict.kind == "ambiguous" else ()
    competing = tuple(other for other in either if other != kind_of(name))
    sure = next((row.confidence for row in found.ranking if row.effect == kind_of(name)), None)
    return replace(
        current, step=name, competing=competing, confidence=sure, error_training_mm=error_mm
    )
