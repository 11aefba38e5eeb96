"""Models of other origin as arm models: Python callables, and files of predictions.

A diagnosis needs three things of a model: what it predicts in each row, how the prediction changes
with the actuation, and how large its error was before. A callable is called, and differenced by its
own actuation. A file of predictions is taken as it is; a polynomial of the actuation, fitted to the
predictions beside features of the past of the actuation, gives the change. The features do not
change when the whole actuation is offset, so the polynomial's slope is that of such an offset.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from surgisoft.diagnosis.history_features import RADII, TIMES_S, memory_of
from surgisoft.diagnosis.residuals import blocks, folds, half_range, motions
from surgisoft.errors import InputError
from surgisoft.measurement.histories import arm_spec, history_of
from surgisoft.measurement.noise import known_noise
from surgisoft.measurement.recordings import (
    Recording,
    check_same_arm,
    load_recordings,
    with_predictions,
)
from surgisoft.measurement.recordings.file import SUFFIXES
from surgisoft.measurement.units import PLURAL
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.callables.arm import arm_around, statements, validation_of
from surgisoft.surrogate.callables.named import (
    Named,
    given_callable,
    is_callable_name,
    named_callable,
)
from surgisoft.surrogate.callables.network import CallableNetwork
from surgisoft.surrogate.callables.predicted import PredictedNetwork, monomials, powers
from surgisoft.surrogate.checkpoint import load_model
from surgisoft.surrogate.history import History
from surgisoft.surrogate.model import ArmModel, Validation
from surgisoft.surrogate.reach import SAME_LENGTH
from surgisoft.units import MM_PER

FIT_ROWS = 4000
"""Rows that the polynomial is fitted to, evenly thinned."""
DEGREES = (1, 2, 3, 4, 5)
"""Total degrees of the polynomial that are tried; held-out blocks choose."""
RIDGES = (1e-8, 1e-6, 1e-4, 1e-2)
"""Ridges that are tried, on columns of unit variance, as a share of the rows."""
LARGEST_PLAY = 0.25
"""Largest radius of a play operator beside the polynomial, in half ranges; with a larger one, play
and actuation differ by nearly the actuation itself, whose slope it would take."""
LONGEST_S = 1.5
"""Longest time constant of a low pass beside it, s, for the same reason."""
ROWS_A_TERM = 4
"""Fewest rows for each term of the polynomial and each feature."""
LEAST_REPRODUCED = 0.9
"""Least share of the predicted squared motion that the polynomial, with the features of the past,
has to give back on held-out blocks for effects on the actuation to be judged: the share of the
motion that such an effect changes is then known to about a third (the root of what is left)."""

LENGTH_UNITS = tuple(
    pair for unit in MM_PER if unit != "mm" for pair in ((unit, "mm"), ("mm", unit))
)
"""Wrong readings of a model's key points: the true unit, and the one that they were read as."""
COLUMNS_BY_UNIT = "expected columns named by the unit of their values, such as k0_x_mm or k0_x_m"
"""What to do about a file of predictions in another unit than its columns say."""

Given = Iterable[Recording | str | Path] | Recording | str | Path
"""Recordings, their files, or folders of them."""


class Opened(NamedTuple):
    """A model and the recordings that a command was given."""

    model: ArmModel
    """The model."""
    recordings: list[Recording]
    """The recordings, with the predictions of a file where the model is one."""
    before: list[Recording] | None
    """The recordings from before a change, likewise; None where none were given."""


def is_predictions_file(model: Any) -> bool:
    """Whether what was given as a model is a file of predictions."""
    return isinstance(model, str | Path) and Path(model).suffix in SUFFIXES


def takes_error(model: Any) -> bool:
    """Whether a validated error may be given beside a model: an arm model has its own."""
    if isinstance(model, str | Path):
        return is_predictions_file(model) or is_callable_name(str(model))
    return not isinstance(model, ArmModel)


def name_of(model: Any) -> str:
    """Name of a model that was given by its folder, file or name; empty for an object."""
    return Path(model).name if isinstance(model, str | Path) else ""


def refuse_predictions(model: Any) -> None:
    """Raise InputError where a model to be amended is a file of predictions."""
    if is_predictions_file(model):
        raise InputError(
            f"{model}: predictions of recorded rows cannot be amended, because they say nothing of "
            "any other actuation; give the model as a callable (docs/your_model.md)"
        )


def _refuse_same(measured: list[Recording], before: list[Recording]) -> None:
    """Raise InputError where one recording is given both before and after a change."""
    for recording in measured:
        for other in before:
            files = [each.source and each.source.resolve() for each in (recording, other)]
            if recording is other or (files[0] is not None and files[0] == files[1]):
                raise InputError(
                    f"{recording.label}: is given both before and after the change, expected "
                    "recordings from before it that are others than those after it"
                )


def open_model(
    model: ArmModel | str | Path | Callable,
    recordings: Given,
    before: Given | None = None,
    predictions: Iterable[str | Path] | None = None,
    error_mm: float | None = None,
) -> Opened:
    """The model that a command was given, and its recordings.

    model: an arm model or its folder; a callable, or its name; a file of predictions; with
    `predictions`, any name. predictions: files of predictions, one for each recording, then one for
    each of `before`. error_mm: RMS error of a key point that a callable, or the model behind
    predictions, was validated with; default: what it states, else its error on `before`. Raises
    InputError where a recording is also one of `before`.
    """
    measured = load_recordings(recordings)
    earlier = None if before is None else load_recordings(before)
    _refuse_same(measured, earlier or [])
    name = str(model) if isinstance(model, str | Path) else ""
    if predictions is None and is_predictions_file(model):
        predictions, name = [name], Path(name).stem
    if predictions is not None:
        check_same_arm([*measured, *(earlier or [])])
        if not name:
            raise InputError(
                "predictions take the place of a model: expected a name for it, such as 'abaqus'"
            )
        both = with_predictions([*measured, *(earlier or [])], predictions)
        measured, earlier = both[: len(measured)], both[len(measured) :] or earlier
        return Opened(predicted_arm(name, measured, earlier, error_mm), measured, earlier)
    named = None
    if callable(model) and not isinstance(model, ArmModel):
        named = given_callable(model)
    elif isinstance(model, str | Path) and is_callable_name(name):
        named = named_callable(name)
    elif not isinstance(model, ArmModel | str | Path):
        named = given_callable(model)
    if named is not None:
        check_same_arm([*measured, *(earlier or [])])
        arm = callable_arm(named, measured, earlier, error_mm)
        return Opened(_warning_if_slow(arm), measured, earlier)
    if error_mm is not None:
        raise InputError(
            "the model's folder states its validated error: expected --model-error only with a "
            "callable or with predictions"
        )
    assert isinstance(model, ArmModel | str | Path)
    return Opened(_warning_if_slow(load_model(model)), measured, earlier)


def _warning_if_slow(model: ArmModel) -> ArmModel:
    """The model, whose callable, if it is one, says so where it is slow."""
    if isinstance(model.network, CallableNetwork):
        model.network.warns_if_slow = True
    return model


def callable_arm(
    named: Named,
    recordings: Sequence[Recording],
    before: Sequence[Recording] | None = None,
    error_mm: float | None = None,
) -> ArmModel:
    """The arm model of a callable; what it does not state of its arm the recordings do."""
    known = statements(named)
    errors = known.pop("error_mm", None) if error_mm is None else (error_mm,)
    known.pop("error_mm", None)
    chambers = recordings[0].chambers
    if len(known.get("low", ())) not in (0, chambers):
        raise InputError(
            f"{named.name}: states the range of {len(known['low'])} chambers, but "
            f"{recordings[0].label} has {chambers}"
        )
    seen = [*recordings, *(before or [])]
    spec = replace(arm_spec(seen, known.pop("actuation", "measured")), idle=())
    model = arm_around(named, replace(spec, **known))
    at_rest = model.rest_mm.double().numpy()[None]
    what, advice = f"{named.name}: returns key points", "expected mm: multiply them by {:.6g}"
    _check_length_unit(what, advice, at_rest, seen, model.spec.length_mm)
    return _validated(model, errors, before, named.name)


def predicted_arm(
    name: str,
    recordings: Sequence[Recording],
    before: Sequence[Recording] | None = None,
    error_mm: float | None = None,
) -> ArmModel:
    """The arm model that stands for predictions of recorded rows (`Recording.predicted_mm`)."""
    seen = [*recordings, *(before or [])]
    spec = replace(arm_spec(seen), idle=())
    for recording in seen:
        if recording.predicted_mm is not None:
            what = f"{name}: the key points predicted for {recording.label} are"
            points = recording.predicted_mm
            _check_length_unit(what, COLUMNS_BY_UNIT, points, [recording], spec.length_mm)
    network = polynomial_of(seen, spec, name)
    rest = torch.tensor(spec.rest)
    points = network(rest[None], rest[None])[0]
    model = ArmModel(spec, network, None, points).eval().requires_grad_(False)
    return _validated(model, None if error_mm is None else (error_mm,), before, name)


class BodyLengths(NamedTuple):
    """How long a body is along its key points that a model and the recordings both have, mm."""

    model_mm: float
    """At rest, or as the median of predictions, by a model."""
    measured_mm: float
    """As the median of the recordings."""

    def blame_model(self, length_mm: float) -> bool:
        """Whether the measured body is nearer to the stated length than the model's."""
        model, measured = (abs(np.log(each / length_mm)) for each in self)
        return bool(measured < model)


def body_lengths(points: np.ndarray, recordings: Sequence[Recording]) -> BodyLengths | None:
    """Both lengths, from key points (T, n, 3) of a model; None where one is not known."""
    if points.shape[1] != recordings[0].key_points:
        return None
    gaps = np.stack([_gaps_mm([points]), _gaps_mm([each.key_points_mm for each in recordings])])
    found = BodyLengths(*gaps[:, np.isfinite(gaps).all(0)].sum(1).tolist())
    return found if min(found) > 0 else None


def _check_length_unit(
    what: str,
    advice: str,
    points: np.ndarray,
    recordings: Sequence[Recording],
    length_mm: float | None,
) -> None:
    """Raise InputError where a model's key points (T, n, 3) are in another unit of length than mm.

    They are where its body is longer or shorter than the measured one by the ratio of two units,
    and the measured one is nearer to the stated length. Where that is not known, or there is one
    key point, the unit of the recordings may be wrong as well: the set-up tests say so. what,
    advice: begin and end of the message.
    """
    found = body_lengths(points, recordings)
    if found is None or length_mm is None or not found.blame_model(length_mm):
        return
    for true, read in LENGTH_UNITS:
        by = MM_PER[true] / MM_PER[read]
        if abs(np.log(by * found.model_mm / found.measured_mm)) > np.log(SAME_LENGTH):
            continue
        wrong = f"in {PLURAL.get(true, true)}" if by > 1 else f"{1 / by:g} times too large"
        raise InputError(
            f"{what} {wrong}: along the body, base to tip, they are {found.model_mm:.3g} long, "
            f"where {found.measured_mm:.3g} mm are measured and the arm is {length_mm:.4g} mm "
            f"long; {advice.format(by)}"
        )


def _gaps_mm(points: Sequence[np.ndarray]) -> np.ndarray:
    """(n - 1,) median distances between neighbours of key points (T, n, 3), mm; NaN if not seen."""
    each = np.concatenate([np.linalg.norm(np.diff(part, axis=1), axis=2) for part in points])
    seen = [gap[np.isfinite(gap)] for gap in each.T]
    return np.array([np.median(gap) if len(gap) else np.nan for gap in seen])


def _validated(
    model: ArmModel,
    error_mm: tuple[float, ...] | None,
    before: Sequence[Recording] | None,
    label: str,
) -> ArmModel:
    """The model with its validated error: as stated, or from its residuals on recordings before."""
    count = model.spec.key_points
    if error_mm is not None:
        if not all(np.isfinite(error_mm)) or min(error_mm) <= 0:
            raise InputError(f"model error {error_mm[0]:g} mm, expected more than 0 mm")
        return model.replace(validation=validation_of(error_mm, count, label)).eval()
    if not before or before[0].key_points != count:
        return model
    history = history_of(list(before), model.spec.actuation)
    with torch.no_grad():
        residual = history.rows(history.key_points - model.predict(history)).double()
    square = residual.square().sum(-1).nanmean(0)
    each = tuple(None if value.isnan() else float(value.sqrt()) for value in square)
    whole = [value for value in each if value is not None]
    if not whole:
        return model
    return model.replace(
        validation=Validation(
            rmse_mm=float(np.sqrt(np.mean(np.square(whole)))),
            per_key_point_mm=each,
            rows=len(residual),
            noise_mm=known_noise(list(before)),
        )
    ).eval()


def has_slope(model: ArmModel) -> bool:
    """Whether it is known how a model's predictions change with the actuation."""
    network = model.network
    return not isinstance(network, PredictedNetwork) or network.reproduced >= LEAST_REPRODUCED


def is_of_other_origin(model: ArmModel) -> bool:
    """Whether a model is a callable or predictions, and no fitted network."""
    return isinstance(model.network, CallableNetwork | PredictedNetwork)


def notes_of(model: ArmModel) -> list[str]:
    """Limits of a diagnosis of a model of other origin; empty for a fitted one."""
    network = model.network
    notes: list[str] = []
    if not isinstance(network, CallableNetwork | PredictedNetwork):
        return notes
    if model.validation.rmse_mm is None:
        notes.append(
            f"{network.name} states no validated error: 5 % of the arm's length is taken for it, "
            "and a smaller effect is not told from it; state it (--model-error, or the attribute "
            "'error_mm'), or give recordings from before (--before)"
        )
    if isinstance(network, PredictedNetwork) and not has_slope(model):
        notes.append(
            f"{network.name}: a function of the actuation and its past reproduces "
            f"{100 * network.reproduced:.0f} % of the predicted motion, expected at least "
            f"{100 * LEAST_REPRODUCED:.0f} %: effects on the actuation and the set-up of its "
            "channels cannot be judged from predictions; give the model as a callable"
        )
    return notes


def polynomial_of(recordings: Sequence[Recording], spec: ArmSpec, name: str) -> PredictedNetwork:
    """The polynomial of the actuation that is nearest to predictions of recorded rows.

    Regressors are the monomials of the scaled actuation and features of its past; the degree and
    the ridge are those that do best on blocks of time that are left out, repeated motions together.
    """
    history = history_of(list(recordings), spec.actuation)
    if history.predicted is None:
        raise InputError(
            f"{name}: the recordings have no predicted key points; name the files of predictions"
        )
    target = history.rows(history.predicted).double().numpy()
    step = max(1, -(-len(target) // FIT_ROWS))
    block = blocks(history, np.full(len(target), True), step, least_blocks=1)
    fold = folds(motions(history, half_range(spec), block))[block][::step]
    low, high = np.array(spec.low), np.array(spec.high)
    x = history.rows(history.pressure).double().numpy()
    x = (x - (low + high) / 2) / half_range(spec)
    past = _past(history, spec)
    x, past, y = x[::step], past[::step], target[::step].reshape(-1, target[0].size)
    # Zero at rest without a past, so that the polynomial's constant is the body at rest.
    past = past[:, past.std(0) > 1e-9]
    motion = float(np.square(y - y.mean(0)).sum())
    best: tuple[float, int, float] | None = None
    for degree in DEGREES:
        columns = _columns(x, past, powers(spec.chambers, degree))
        if best is not None and ROWS_A_TERM * columns.shape[1] > len(x):
            break
        for ridge in RIDGES:
            left = 0.0
            for out in np.unique(fold):
                held = fold == out
                if held.all():
                    held = np.arange(len(x)) % 2 == 0
                solved = _ridge(columns[~held], y[~held], ridge)
                left += float(np.square(y[held] - columns[held] @ solved).sum())
            if best is None or left < best[0]:
                best = (left, degree, ridge)
    if best is None:
        raise InputError(
            f"{name}: no rows of predictions, expected one for each row of the recordings"
        )
    left, degree, ridge = best
    exponents = powers(spec.chambers, degree)
    solved = _ridge(_columns(x, past, exponents), y, ridge)[: len(exponents)]
    return PredictedNetwork(
        torch.from_numpy(low),
        torch.from_numpy(high),
        exponents,
        solved.reshape(len(exponents), *target.shape[1:]),
        name,
        1.0 if motion <= 0 else max(0.0, 1.0 - left / motion),
    )


def _past(history: History, spec: ArmSpec) -> np.ndarray:
    """(N, P) directions of change, and how far play operators and low passes lag behind, in half
    ranges: loops and lags of the model. An offset of the whole actuation changes none of them."""
    memory, half = memory_of(history, spec), half_range(spec)
    parts = [memory.direction]
    plays = [k for k, radius in enumerate(RADII) if radius <= LARGEST_PLAY]
    parts += [(memory.play[..., k] - memory.pressure) / half for k in plays]
    if bool((history.dt_s > 0).any()):
        passes = [k for k, time_s in enumerate(TIMES_S) if time_s <= LONGEST_S]
        parts += [(memory.low_pass[..., k] - memory.pressure) / half for k in passes]
    return np.concatenate(parts, axis=1)


def _columns(x: np.ndarray, past: np.ndarray, exponents: np.ndarray) -> np.ndarray:
    """(S, F + P) monomials of scaled actuation (S, m), then the features of its past (S, P)."""
    return np.hstack([monomials(x, exponents), past])


def _ridge(columns: np.ndarray, y: np.ndarray, ridge: float) -> np.ndarray:
    """(F, C) coefficients; the ridge acts on columns of unit spread, and not on the constant."""
    spread = columns.std(0)
    scaled = columns / np.where(spread > 1e-12, spread, 1.0)
    gram = scaled.T @ scaled
    gram += ridge * len(columns) * np.diag(np.where(spread > 1e-12, 1.0, 1e-12))
    solved = np.linalg.lstsq(gram, scaled.T @ y, rcond=None)[0]
    return solved / np.where(spread > 1e-12, spread, 1.0)[:, None]
