"""A model, recordings and what is left between them: what a diagnosis works on."""

import itertools
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from surgisoft.diagnosis.comparing.floor import noise_floor
from surgisoft.diagnosis.motions import motions
from surgisoft.errors import InputError
from surgisoft.measurement.histories import check_fits, history_of
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.history import History
from surgisoft.surrogate.known_error import KnownError
from surgisoft.surrogate.model import ArmModel

ROWS = 2000
"""Rows that amplitudes are fitted to; memories follow every row."""
BLOCK_S = 5.0
"""Length of a block of time, the unit of every test, s."""
TOGETHER = 2
"""Neighbouring motions that are held out together."""
BLOCK_ROWS = 8
"""Fewest of the fitted rows in a block."""
LEAST_BLOCKS = 10
"""Fewest blocks of a diagnosis."""
FOLDS = 5
"""Parts that take turns in judging."""
LOCKED_SHARE = 0.25
"""Share of each recording, its last runs or its last rows, that only a final check may see."""
RUNS_TO_LOCK = 4
"""Fewest runs of a recording of which whole runs are locked away."""

LEAST_OWN = 0.3
"""Least share of a validated error that is the model's own, whatever its noise is taken for."""

Part = Literal["open", "locked", "all"]


@dataclass(frozen=True, eq=False)
class Reference:
    """A model's residual on recordings on which nothing is missing but what its network lacks."""

    pressure: np.ndarray
    """(S, m) actuation scaled to [-1, 1] over the model's range."""
    direction: np.ndarray
    """(S, m) directions of change."""
    residual: np.ndarray
    """(S, n, 3) measured less predicted, mm; NaN where missing."""


@dataclass(frozen=True, eq=False)
class Problem:
    """A model on recordings, thinned to S rows."""

    model: ArmModel
    """The model in question."""
    history: History
    """All runs, every row."""
    index: Tensor
    """(S,) the fitted rows among all rows of the runs one after the other."""
    pressure: np.ndarray
    """(S, m) actuation scaled to [-1, 1] over the model's range."""
    direction: np.ndarray
    """(S, m) directions of change."""
    measured: np.ndarray
    """(S, n, 3) measured key points, mm; NaN where missing."""
    predicted: np.ndarray
    """(S, n, 3) what the model predicts, mm."""
    time_s: np.ndarray
    """(S,) time in the recording, s."""
    block: np.ndarray
    """(S,) block of time of each row, from 0."""
    motion: np.ndarray
    """(B,) motion of each block, from 0: blocks that repeat a motion share it."""
    fold: np.ndarray
    """(B,) part that each block judges in; one for all blocks of a motion."""
    surrogate_mm: np.ndarray
    """(n,) validated RMS error of each key point, measurement noise taken out, mm."""
    noise_mm: np.ndarray
    """(n,) RMS noise of each key point's distance, mm."""
    floor_source: str
    """Where the noise is known from."""
    reference: "Reference | None" = None
    """What the model's own error is known from; None: from its validated size alone."""

    @property
    def residual(self) -> np.ndarray:
        """(S, n, 3) measured less predicted, mm."""
        return self.measured - self.predicted

    def by_motion(self, values: np.ndarray) -> np.ndarray:
        """(..., M) means of values (..., B) of the blocks over those that share a motion."""
        sums = np.zeros((int(self.motion.max()) + 1, *values.shape[:-1]))
        np.add.at(sums, self.motion, np.moveaxis(values, -1, 0))
        return np.moveaxis(sums, 0, -1) / np.bincount(self.motion)

    def rows(self, tensor: Tensor) -> Tensor:
        """The fitted rows of a (R, T, ...) tensor."""
        return self.history.rows(tensor)[self.index]

    def with_model(self, model: ArmModel) -> "Problem":
        """The same rows under another model of the same arm."""
        with torch.no_grad():
            predicted = self.rows(model.predict(self.history)).double().numpy()
        return replace(self, model=model, predicted=predicted)


def own_error(model: ArmModel, noise_mm: np.ndarray) -> np.ndarray:
    """(n,) validated RMS error of each key point, mm, without the noise of its validation.

    noise_mm: (n,) what that noise is taken for where the model does not say it.
    """
    spec, told = model.spec, model.validation
    validated = np.array(
        [value or 0.0 for value in told.per_key_point_mm]
        or [0.05 * (spec.length_mm or 50.0)] * spec.key_points
    )
    stated = told.noise_mm
    noise = noise_mm if stated is None else np.full(len(validated), np.sqrt(3.0) * stated)
    return np.sqrt(np.maximum(validated**2 - noise**2, (LEAST_OWN * validated) ** 2))


def locked_rows(recordings: list[Recording]) -> np.ndarray:
    """(N,) bool: the rows of all recordings, one after another, that are locked away."""
    answer = []
    for recording in recordings:
        locked = np.zeros(recording.samples, bool)
        runs = recording.runs
        if len(runs) >= RUNS_TO_LOCK:
            for run in runs[-max(1, round(LOCKED_SHARE * len(runs))) :]:
                locked[run] = True
        else:
            locked[round((1 - LOCKED_SHARE) * recording.samples) :] = True
        answer.append(locked)
    return np.concatenate(answer)


def pose(
    model: ArmModel, recordings: list[Recording], rows: int = ROWS, part: Part = "all"
) -> Problem:
    """The problem of a model and recordings; memories follow all rows, `part` is looked at."""
    check_fits(model.spec, recordings)
    history = history_of(recordings, model.spec.actuation)
    with torch.no_grad():
        predicted = history.rows(model.predict(history))
        direction = history.rows(model.trace(history).direction)
    if not torch.isfinite(predicted).all():
        raise InputError("the model predicts values that are not finite; fit it again")
    measured = np.concatenate([recording.key_points_mm for recording in recordings])
    seen = np.isfinite(measured).all(2).any(1)
    if part != "all":
        seen &= locked_rows(recordings) == (part == "locked")
    step = max(1, round(seen.sum() / rows))
    block = blocks(history, seen, step)
    index = np.flatnonzero(seen)[::step]
    names, kept = np.unique(block[index], return_inverse=True)
    spec = model.spec
    low, high = np.array(spec.low), np.array(spec.high)
    half = np.where(high > low, (high - low) / 2, 1.0)
    pressure = history.rows(history.pressure).double().numpy()
    places = np.where(np.isin(block, names), np.searchsorted(names, block), -1)
    motion = motions(history, half, places)
    noise, source = noise_of(recordings, measured)
    return Problem(
        model=model,
        history=history,
        index=torch.from_numpy(index),
        pressure=((pressure - (low + high) / 2) / half)[index],
        direction=direction.double().numpy()[index],
        measured=measured[index],
        predicted=predicted.double().numpy()[index],
        time_s=history.rows(history.t_s).numpy()[index],
        block=kept,
        motion=motion,
        fold=folds(motion),
        surrogate_mm=own_error(model, noise),
        noise_mm=noise,
        floor_source=source,
    )


def with_reference(problem: Problem, given: list[Recording] | KnownError) -> Problem:
    """The problem, told where its model was wrong before anything changed.

    The model's own error has to explain these rows too, by the same function of actuation and
    direction, so it cannot pass for what has changed since.
    """
    spec = problem.model.spec
    if not isinstance(given, KnownError):
        check_fits(spec, given)
        given = KnownError.of(problem.model, [history_of(given, spec.actuation)], ROWS)
    low, half = np.array(spec.low), np.array(spec.span) / 2
    known = Reference(
        pressure=(given.actuation.double().numpy() - low) / half - 1.0,
        direction=given.direction.double().numpy(),
        residual=given.residual_mm.double().numpy(),
    )
    return replace(problem, reference=known)


def noise_of(recordings: list[Recording], measured: np.ndarray) -> tuple[np.ndarray, str]:
    """(n,) RMS noise of a key point's distance, mm, and where it is known from.

    Without a statement or holds: from second differences in time, which a smooth motion leaves
    small (their variance is six times that of white noise).
    """
    floor = noise_floor(recordings)
    count = measured.shape[1]
    if floor.rmse_mm is not None:
        return np.full(count, max(floor.rmse_mm, 1e-4)), floor.source
    second = [np.diff(r.key_points_mm[run], 2, axis=0) for r in recordings for run in r.runs]
    second = np.concatenate([part for part in second if len(part)] or [np.zeros((1, count, 3))])
    with np.errstate(invalid="ignore"):
        spread = 1.4826 * np.nanmedian(np.abs(second), axis=0) / np.sqrt(6.0)
    spread = np.nan_to_num(spread, nan=0.0)
    return np.maximum(np.sqrt((spread**2).sum(1)), 1e-4), "second differences"


def folds(motion: np.ndarray) -> np.ndarray:
    """(B,) part that each block judges in: neighbouring motions together, where there are many."""
    count = int(motion.max()) + 1
    if count < 2:
        return np.arange(len(motion)) // TOGETHER % FOLDS
    return motion // (TOGETHER if count >= TOGETHER * FOLDS else 1) % FOLDS


def blocks(history: History, seen: np.ndarray, step: int = 1) -> np.ndarray:
    """(N,) block of time of each row; -1 where it is not seen.

    Whole runs where they are many and short; else stretches of runs of about BLOCK_S, at least
    LEAST_BLOCKS of them in all. step: every how many rows one is fitted.
    """
    run = np.where(seen, history.run_of_row.numpy(), -1)
    time = history.rows(history.t_s).numpy()
    lengths = {r: float(np.ptp(time[run == r])) for r in np.unique(run[seen])}
    total = sum(lengths.values())
    length = min(BLOCK_S, total / (2 * LEAST_BLOCKS)) if total > 0 else 1.0
    answer, count = np.full(len(run), -1), 0
    for r, span in lengths.items():
        rows = np.flatnonzero(run == r)
        parts = max(1, min(round(span / max(length, 1e-9)), len(rows) // (step * BLOCK_ROWS)))
        edges = np.linspace(0, len(rows), parts + 1).astype(int)
        for begin, end in itertools.pairwise(edges):
            answer[rows[begin:end]] = count
            count += 1
    if count < LEAST_BLOCKS:
        raise InputError(
            f"the recordings give {count} blocks of time, expected at least {LEAST_BLOCKS} of "
            f"{BLOCK_ROWS} rows: record more"
        )
    return answer
