"""`amend`: put a named effect into a model and evaluate it on held-out data.

The parameters are fitted to the training rows, three quarters of each recording; together with the
whole network where that may have imitated the effect. The held-out quarter is opened once, for the
error before and after, and chooses nothing: the new model's parameters are the same whatever is in
it. The error that the model states of itself is no less than that on these rows (`amended_error`).

A fall of the error is claimed only where its 95 % interval, from a bootstrap of blocks of time, is
above zero, where the fall is large enough to matter, and where the network's own error would hardly
have been fitted by so much of the effects.
"""

import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from surgisoft.diagnosis.amended_error import state_error, state_residuals
from surgisoft.diagnosis.data_quality import FAR_ROWS, collinear_hints, far_share
from surgisoft.diagnosis.diagnose import lacking_before
from surgisoft.diagnosis.estimation.effects import fit_effects
from surgisoft.diagnosis.estimation.intervals import Estimates, Parameter, beside_former
from surgisoft.diagnosis.estimation.network import retune
from surgisoft.diagnosis.inputs import Model, Recordings, open_inputs, refuse_amended
from surgisoft.diagnosis.other_models import name_of, open_model, refuse_predictions
from surgisoft.diagnosis.pairs import Change, Paired, before_and_after
from surgisoft.diagnosis.refit import Refit, apart_mm, can_hide, fit_together, refit_reason
from surgisoft.diagnosis.refit import refit as refit_effects
from surgisoft.diagnosis.residuals import Problem, Sealed, floor_in_words, residual_table
from surgisoft.diagnosis.statistics import block_interval, block_sums
from surgisoft.errors import InputError
from surgisoft.files import with_former_keys
from surgisoft.measurement.recordings import load_recordings
from surgisoft.progress import Progress as RefitProgress
from surgisoft.progress import silent
from surgisoft.surrogate.effects import FRONT, named_effects
from surgisoft.surrogate.fitted_rows import FittedRows
from surgisoft.surrogate.model import ArmModel
from surgisoft.workers import torch_threads

LEVEL = 0.05
"""Largest p-value of an effect's amplitudes with which a fall is claimed for it: on an arm that
lacks nothing a fall is claimed at most so often."""
LEAST_FALL = 0.05
"""Least fall of the error that is claimed, as a share of what stands above the noise floor."""

Progress = Callable[[str], None]
"""Called with what is being done."""


@dataclass(frozen=True)
class Fall:
    """The error of two models on the same rows."""

    before: float
    """RMS distance of a key point by the old model, mm."""
    after: float
    """RMS distance of a key point by the new model, mm."""
    floor: float
    """RMS measurement noise, mm."""
    fall: float
    """Before less after, mm."""
    ci95: tuple[float, float]
    """95 % interval of the fall by blocks of time, mm."""
    rows: int
    """Held-out rows."""
    blocks: int
    """Blocks of time that they make."""
    p_value: float | None = None
    """Probability that noise and the network's own error alone would have been fitted by so much of
    the effects; None where that was not tested."""

    in_fit: float | None = 0.0
    """Share of the rows that the old model had been fitted to: there its error is no test. None
    where that is not known."""

    @property
    def claimed(self) -> bool:
        """Whether a fall on unseen data is claimed: it is significant, and the old model
        had been fitted to none of the rows."""
        return self.significant and not self.in_fit

    @property
    def significant(self) -> bool:
        """Whether the fall is significant, large enough to matter, and due to the effects.

        An effect also lowers the error of an arm that lacks nothing, where it happens to resemble
        the error of the network.
        """
        return self.ci95[0] > 0 and self._matters and not self._by_chance

    @property
    def rises(self) -> bool:
        """Whether the new model errs more: the 95 % interval of the fall lies below zero."""
        return self.ci95[1] < 0

    @property
    def _matters(self) -> bool:
        room = max(self.before - self.floor, 0.1 * self.before)
        return self.fall >= LEAST_FALL * room

    @property
    def _by_chance(self) -> bool:
        return self.p_value is not None and self.p_value >= LEVEL

    @property
    def sentence(self) -> str:
        """The fall in words."""
        low = self.ci95[0]
        if self.in_fit and self.significant:
            return (
                "no reduction on unseen data is claimed, because the model had been fitted "
                f"to {self.in_fit:.0%} of the held-out rows: {self.numbers('there')}"
            )
        numbers = self.numbers(
            f"on rows of which the model had been fitted to {self.in_fit:.0%}"
            if self.in_fit
            else "on held-out data"
        )
        if self.claimed:
            return f"error reduced from {numbers}"
        why = "is too small"
        if low <= 0:
            why = "is not significant"
        elif self._matters:
            why = f"may be the model's own error, which the effect resembles (p {self.p_value:.2g})"
        return f"no reduction of the error is claimed: {numbers} {why}"

    def numbers(self, where: str) -> str:
        """Both errors and the fall; where: on which rows, in words."""
        low, high = self.ci95
        return (
            f"{self.before:.3f} to {self.after:.3f} mm {where} "
            f"(reduction {self.fall:.3f} mm, 95 % {low:.3f} to {high:.3f}; "
            f"floor {floor_in_words(self.floor, '.3f')})"
        )

    def to_json(self) -> dict:
        """Plain values; `held_out`: whether the old model had been fitted to none of them."""
        apart = None if self.in_fit is None else not self.in_fit
        values = asdict(self) | {"ci95": list(self.ci95), "held_out": apart}
        return with_former_keys(values, {"took_no_part": "held_out"})


@dataclass(frozen=True, eq=False)
class Track:
    """The error along the recordings, for pictures."""

    time_s: np.ndarray
    """(S,) time on the axis that charts and replays share, s."""
    before_mm: np.ndarray
    """(S,) RMS distance over the key points by the old model, mm; NaN where not measured."""
    after_mm: np.ndarray
    """(S,) RMS distance over the key points by the new model, mm."""
    start: np.ndarray
    """(S,) bool: first row of a run."""


@dataclass(frozen=True, eq=False)
class Amendment:
    """An amended model and what it is worth."""

    model: ArmModel
    """The new model, which shares nothing with the old one."""
    effects: tuple[str, ...]
    """The effects asked for."""
    refitted: tuple[str, ...]
    """Effects that the model had before and whose parameters were fitted again."""
    parameters: tuple[Parameter, ...]
    """The fitted parameters in physical units, beside those that the model had before."""
    held_out: Fall
    """The error on the held-out rows."""
    alone: Fall
    """What the effects do on the held-out rows: with the network left as it was; where both were
    fitted together, compared with the network trained for as many epochs without the effects."""
    training: Fall
    """The error on the training rows, to which the parameters were fitted."""
    retuned: bool
    """Whether the network's last layer was re-tuned too."""
    tracks: tuple[Track, Track]
    """The error along the training and along the held-out rows."""
    seconds: float
    """Time that it took, s."""
    notes: tuple[str, ...] = ()
    """Recordings under another direction of gravity, or beyond the range of the model's fit."""
    change: Change | None = None
    """How far the recordings differ from those before the change; where rows are paired, errors are
    those of the paired difference, and None where no recordings from before were given."""
    model_error: Fall | None = None
    """The error of the model itself on the held-out rows, where the others are paired
    differences."""
    refit: Refit | None = None
    """The comparison that fitted network and effects together; None where they were not."""
    amended_from: str = ""
    """Name of the given model; empty for one that was given as an object."""
    recordings: tuple[str, ...] = ()
    """Names of the recordings."""
    in_words: dict[str, str] = field(default_factory=dict)
    """What the parameters mean, by effect; empty where the recordings do not tell."""

    @property
    def claimed(self) -> bool:
        """Whether a fall of the error is claimed for the effects, and for the new model.

        A network that is trained on together with the effects does not see the held-out rows. If
        the given model had been fitted to some of them, its error there is no test, and what counts
        is the network that was trained on from the same weights for as long without the effects:
        that comparison is claimed, and no error on unseen data. Of paired recordings the change is
        what is explained, also where the model itself errs more (`errs_more`).
        """
        if self._seen_before:
            return self.alone.significant
        return self.alone.claimed and self.held_out.claimed

    @property
    def _seen_before(self) -> bool:
        """Whether a joint fit is compared with a model that had been fitted to held-out rows."""
        return self.refit is not None and bool(self.held_out.in_fit)

    @property
    def sentence(self) -> str:
        """The outcome in words."""
        if self.refit is not None:
            return f"{' + '.join(self.effects)}: {self._together}"
        text = f"{' + '.join(self.effects)}: {self.alone.sentence}"
        if self.model_error is not None:
            change = of_change(self.alone, self.change, self.model_error)
            text = f"{' + '.join(self.effects)}: {change}"
            return f"{text}, its network's last layer re-tuned" if self.retuned else text
        if not self.retuned:
            return text
        # The held-out rows choose nothing, so the layer stays where it errs more on them.
        more = round(self.alone.after, 3) < round(self.held_out.after, 3)
        if not self.claimed:
            than = ", more than with the effects alone" if more else ""
            tuned = f"{self.held_out.after:.3f} mm with the network's last layer re-tuned"
            return f"{text}; {tuned}{than}"
        lower = ", which is lower on these rows" if more else ""
        return (
            f"{' + '.join(self.effects)}: {self.held_out.sentence}, with the network's last layer "
            f"re-tuned; {self.alone.after:.3f} mm with the effects alone{lower}"
        )

    @property
    def _together(self) -> str:
        """The outcome of a joint fit in words."""
        if self._seen_before:
            head = "error reduced from"
            if not self.alone.significant:
                head = "no reduction of the error is claimed:"
            where = "on rows that neither training saw"
            return (
                f"{head} {self.alone.numbers(where)}, fitted together with the network, compared "
                "with the network alone, trained for as many epochs from the same weights; the "
                f"given model, which had been fitted to {self.held_out.in_fit:.0%} of these rows, "
                f"has {self.held_out.before:.3f} mm there, so none of these errors is on unseen "
                "data"
            )
        network = (
            f"the network alone, trained for as many epochs, reaches {self.alone.before:.3f} mm"
        )
        if self.held_out.claimed and not self.alone.claimed:
            return (
                f"no reduction of the error is claimed for the effects: {network}, and with them "
                f"{self.alone.after:.3f} mm remain"
            )
        return f"{self.held_out.sentence}, fitted together with the network; {network}"

    def to_json(self) -> dict:
        """Plain values, as `amend --json` writes them.

        The new model's folder keeps them too: `save_model(found.model, folder, found.to_json())`.
        """
        held_out, training = self.held_out, self.training
        values = {
            "effects": list(self.effects),
            "refitted": list(self.refitted),
            "claimed": self.claimed,
            "sentence": self.sentence,
            "error_mm": held_out.to_json(),
            "error_effects_alone_mm": self.alone.to_json(),
            "error_training_mm": training.to_json(),
            "parameters": [parameter.to_json() for parameter in self.parameters],
            "in_words": self.in_words,
            "network_retuned": self.retuned,
            "refit": None if self.refit is None else self.refit.to_json(),
            "notes": list(self.notes),
            "seconds": self.seconds,
            "change": self.change and self.change.to_json(),
            "error_model_mm": self.model_error and self.model_error.to_json(),
            "amended_from": self.amended_from,
            "recordings": list(self.recordings),
        }
        return with_former_keys(values, {"error_open_mm": "error_training_mm"})


@torch_threads(1)
def amend(
    model: Model,
    recordings: Recordings,
    effects: str | Path | Iterable[str | Path],
    retune_network: bool = True,
    progress: Progress | None = None,
    before: Recordings | None = None,
    paired: Paired = "auto",
    refit: str = "auto",
    refit_progress: RefitProgress = silent,
    processes: int = 1,
    error_mm: float | None = None,
) -> Amendment:
    """The model with the named effects fitted to the recordings; the given model stays as it is.

    The effects' parameters are fitted to the first three quarters of each recording, and the error
    is validated on the last quarter: `Amendment.claimed` says whether it fell significantly, and
    `Amendment.model` is the new model. Key points are in mm in the arm base frame. Raises
    InputError for an unknown effect, and where a model cannot take effects or does not fit the
    recordings.

    Model and recordings may be given by their paths; a callable, or its name, is a model too, with
    error_mm as its validated error, mm (docs/your_model.md).

    effects: names, or files of user-defined effects (`my_effect.py`), which are run.
    retune_network: also re-tune the network's last layer, where the effects alone make the error of
    the training rows fall and the new layer lowers it in the quarters of them that are left out of
    both fits in turn (`estimation.network`). before: recordings
    from before a change. Where they were made with the same actuation, effects are fitted to the
    paired difference (`pairs`), so that the network's error does not enter; otherwise to the
    model's residuals, as without before (a note says so); paired: as for `diagnose`.
    refit: `always` fits the whole network together with the
    effects, `never` does not, `auto` does where a network may have imitated them
    (`surgisoft.diagnosis.refit`) and the joint fit leaves less on left-out rows than the network
    alone, and than the effects fitted to the network as it is; refit_progress and processes as for
    `diagnose`.
    """
    begin = time.perf_counter()
    tell = progress or (lambda text: None)
    names = named_effects([effects] if isinstance(effects, str | Path) else effects)
    if not names:
        raise InputError(
            "no effect is named to amend the model with, expected at least one, such as creep; "
            "'surgisoft diagnose' tells which one is missing"
        )
    refuse_predictions(model)
    given = name_of(model)
    model, recordings, before = open_model(model, recordings, before, None, error_mm)
    model, recordings, notes = open_inputs(model, recordings)
    tell("predicting")
    sealed = Sealed(recordings)
    plain = table = residual_table(model, sealed.training)
    sealed.check(table)
    both, earlier = None, []
    if before is not None:
        earlier = load_recordings(before)
        refuse_amended(model, recordings, earlier)
        both = before_and_after(plain, earlier, paired).with_final_check()
        if both.strange is not None:
            raise InputError(both.strange_in_words)
        notes, table = (*notes, *both.notes_of_fit, *lacking_before(both, tell)), both.table
    problem = table.training()
    names = list(dict.fromkeys(names))
    judged = None
    reason = refit_reason(problem, refit) if both is None else ""
    if refit == "always" and (both is not None or not retune_network):
        raise InputError(
            "--refit always trains the network too, which --keep-network forbids, and which "
            "--before rules out, because only the change since then is explained; leave out "
            "--refit always, or leave out the other two"
        )
    if reason and (refit == "always" or (retune_network and all(map(can_hide, names)))):
        judged = refit_effects(
            problem, reason, together=names, progress=refit_progress, processes=processes
        )
    if judged is not None and judged.winner is not None and refit == "auto":
        joint_mm = judged.candidates[0].heldout_rmse_mm
        plain_mm = apart_mm(problem, names)
        if plain_mm is not None and plain_mm <= joint_mm:
            judged = None
            notes = (
                *notes,
                f"on rows left out in turn the network as it is leaves {plain_mm:.3f} mm with the "
                f"effects, fitted together with them {joint_mm:.3f} mm: it stays as it is",
            )
    if judged is not None and (refit == "always" or judged.winner is not None):
        joint = fit_together(problem, names, judged.candidates[0], progress=refit_progress)
        better, retuned = joint.model, False
        parameters, words = joint.parameters, joint.in_words
        refitted = tuple(name for name in names if name in model.effects)
        held_out = whole = sealed.opened(plain).final_check()
        # Both start from the same weights, whatever these were fitted to.
        alone = fall_of(held_out.with_model(joint.alone), held_out.with_model(better))
        far = far_share(problem.pressure, held_out.pressure)
        if far > FAR_ROWS:
            notes = (
                *notes,
                f"{far:.0%} of the held-out rows are at actuations far from those that were "
                "trained on, where a network errs whatever effect it has: record runs that repeat "
                "the actuation of others",
            )
    else:
        judged = None
        tell(f"fitting {' + '.join(names)}")
        fitted = fit_effects(problem, names, more=names)
        names = [fitted.key(name) for name in names]
        parameters, words, refitted = fitted.parameters, fitted.in_words, fitted.refitted
        better, retuned = fitted.model, False
        shown_by_training = fall_of(problem, problem.with_model(better), fitted.p_value).significant
        if retune_network and shown_by_training:
            tell("re-tuning the network")
            # Tuned to what was measured: the network's own error is not in a paired difference.
            rows = plain.training()
            # In a paired difference the effects are fitted to other residuals than the layer.
            tried = retune(better, rows, () if both is not None and both.used else names)
            pair = rows.with_model(better), rows.with_model(tried.model)
            if tried.kept and fall_of(*pair).significant:
                better, retuned = tried.model, True
        tell("evaluating on the held-out part")
        held_out = whole = (opened := sealed.opened(plain)).final_check()
        if both is not None and both.used:
            held_out = before_and_after(opened, earlier, "always").table.final_check()
        alone = fall_of(held_out, held_out.with_model(fitted.model), fitted.p_value)
        state_residuals(better, model, retuned)
        if alone.claimed:
            state_error(better, model, whole)
    own = FittedRows.of_amending(plain.history, trained=retuned or judged is not None)
    better.fitted_rows = own.joined(model.fitted_rows)
    found = Estimates(list(parameters), words)
    parameters, words = beside_former(found, model, problem.covered_s)
    if any(better.effects[name].stage in FRONT for name in names):
        notes = (*notes, *collinear_hints(plain))
    is_paired = both is not None and both.used
    # The paired difference holds for the network that predicted BEFORE.
    shown = fitted.model if is_paired else better
    falls = [(part, part.with_model(shown)) for part in (problem, held_out)]
    tested = alone.p_value if judged is None and not retuned else None
    model_error = fall_of(whole, whole.with_model(better)) if is_paired else None
    return Amendment(
        model=better,
        effects=tuple(names),
        refitted=refitted,
        parameters=parameters,
        held_out=fall_of(*falls[1], tested),
        alone=alone,
        training=fall_of(*falls[0]),
        retuned=retuned,
        tracks=(track_of(*falls[0]), track_of(*falls[1])),
        seconds=time.perf_counter() - begin,
        notes=(*notes, *errs_more(model_error)),
        change=None if both is None else both.change,
        model_error=model_error,
        refit=judged,
        amended_from=given,
        recordings=tuple(each.name for each in recordings),
        in_words=words,
    )


def fall_of(before: Problem, after: Problem, p_value: float | None = None) -> Fall:
    """The fall of the error between two models on the same rows, with its interval.

    p_value: of the effects' amplitudes, see `Fall.p_value`.
    """
    seen = np.isfinite(before.residual).all(2).sum(1)
    sums = [
        block_sums(np.nansum(np.square(problem.residual), axis=(1, 2)), before.block)
        for problem in (before, after)
    ]
    count = block_sums(seen.astype(float), before.block)
    low, high = block_interval(_fall, (*sums, count))
    rmse = [float(np.sqrt(each.sum() / count.sum())) for each in sums]
    return Fall(
        before=rmse[0],
        after=rmse[1],
        floor=before.told_floor_mm,
        fall=rmse[0] - rmse[1],
        ci95=(float(low), float(high)),
        rows=len(before.index),
        blocks=len(count),
        p_value=p_value,
        in_fit=before.in_fit,
    )


def _fall(before: np.ndarray, after: np.ndarray, count: np.ndarray) -> np.ndarray:
    """(...) fall of the RMS error from sums of squares and counts (...)."""
    count = np.maximum(count, 1)
    return np.sqrt(before / count) - np.sqrt(after / count)


def of_change(fall: Fall, change: Change | None, whole: Fall) -> str:
    """The sentence of a fall of the paired difference, with the model's own error beside it."""
    since = f" since {' + '.join(change.before)}" if change is not None else ""
    text = fall.sentence.replace("error ", f"unexplained change{since} ", 1)
    more = ", which is more" if whole.rises else ""
    return f"{text}; error of the model itself {whole.before:.3f} to {whole.after:.3f} mm{more}"


def errs_more(whole: Fall | None) -> tuple[str, ...]:
    """A note where a model with the effects of a change errs more than the given one; else none.

    The effects are those of the change all the same: the network's own error is not in the paired
    difference that they were fitted to, and had cancelled the change in part.

    whole: of the error of the model itself on the held-out rows; None without pairs.
    """
    if whole is None or not whole.rises:
        return ()
    low, high = whole.ci95
    return (
        f"the new model itself errs more than the given one on the held-out rows: "
        f"{whole.before:.3f} to {whole.after:.3f} mm (rise {-whole.fall:.3f} mm, 95 % "
        f"{-high:.3f} to {-low:.3f}). The given model's own error and the change cancel in part. "
        "To predict this arm, first lower that error on the recordings from before the change "
        "('surgisoft improve MODEL BEFORE -o OTHER', or fit the model again), then amend",
    )


def track_of(before: Problem, after: Problem) -> Track:
    """The error of two models along the same rows."""
    seen = np.isfinite(before.residual).all(2)
    count = np.where(seen.any(1), seen.sum(1), np.nan)
    was_mm, is_mm = (
        np.sqrt(np.nansum(np.square(problem.residual), axis=(1, 2)) / count)
        for problem in (before, after)
    )
    run = before.history.run_of_row[before.index].numpy()
    time_s = before.table.along_s[before.index.numpy()]
    return Track(time_s, was_mm, is_mm, np.diff(run, prepend=-1) != 0)
