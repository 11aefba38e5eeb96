"""The training rows of some recordings, and what a model predicts for other set-ups of them.

A set-up fault changes what enters the model (chambers, unit), when (the clocks) or what is compared
with its output (frame, order, unit of length). A prediction for another actuation needs the model;
all else is a change of what was measured.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch

from surgisoft.diagnosis.residuals import blocks, folds, held_out_rows
from surgisoft.measurement.histories import history_of
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.history import History
from surgisoft.surrogate.model import ArmModel

LEAST_SEEN = 0.5
"""Least share of thinned rows with key points, as a share of that of all rows."""


@dataclass(frozen=True)
class Arrangement:
    """Which recorded channel drives each chamber of the model, and by which factor."""

    order: tuple[int, ...]
    """(m,) recorded channel of each chamber, from 0."""
    sign: tuple[float, ...]
    """(m,) 1 or -1; 0 where the chamber does not act."""
    factor: float = 1.0
    """Model units in one recorded unit."""

    @classmethod
    def as_recorded(cls, chambers: int) -> "Arrangement":
        """Every channel drives its own chamber."""
        return cls(tuple(range(chambers)), (1.0,) * chambers)

    @property
    def gain(self) -> np.ndarray:
        """(m,) factor of each chamber's channel."""
        return self.factor * np.array(self.sign)

    @property
    def rearranged(self) -> bool:
        """Whether channels are permuted, flipped or left out."""
        return self.order != tuple(range(len(self.order))) or any(s != 1.0 for s in self.sign)

    @property
    def changes(self) -> int:
        """Number of chambers that another channel drives, or the same one with another sign."""
        own = enumerate(zip(self.order, self.sign, strict=True))
        return sum(k != given or sign != 1.0 for k, (given, sign) in own)

    def of(self, actuation: np.ndarray) -> np.ndarray:
        """(..., m) actuation of the chambers from the recorded channels (..., m)."""
        return actuation[..., list(self.order)] * self.gain


@dataclass(frozen=True, eq=False)
class Sample:
    """Runs of some recordings, thinned to S rows, of which the training rows are compared."""

    model: ArmModel
    """The model."""
    history: History
    """(R, T) thinned runs with the recorded actuation."""
    times: tuple[np.ndarray, ...]
    """(T_r,) times of every row of each run, s."""
    points: tuple[np.ndarray, ...]
    """(T_r, n, 3) key points of every row of each run, as recorded; NaN outside the training rows
    and where missing."""
    at: tuple[np.ndarray, ...]
    """(S_r,) times of the thinned rows of each run, s."""
    block: np.ndarray
    """(S,) block of time of each row; -1 where it is no training row."""
    timed: bool
    """Whether rows follow one another in time, and are no steady-state samples."""

    @property
    def fold(self) -> np.ndarray:
        """(B,) fold of each block."""
        return folds(np.arange(self.blocks))

    @property
    def blocks(self) -> int:
        """Number of blocks B."""
        return int(self.block.max(initial=-1)) + 1

    @property
    def rows(self) -> int:
        """Number of rows S."""
        return len(self.block)

    def measured(self, later_s: Sequence[float] = (0.0,)) -> np.ndarray:
        """(D, S, n, 3) key points as recorded, each time `later_s` after the row; NaN beyond."""
        return np.stack(
            [
                np.concatenate(
                    [
                        interpolated(at + later, times, points)
                        for at, times, points in zip(self.at, self.times, self.points, strict=True)
                    ]
                )
                for later in later_s
            ]
        )

    def predicted(self, arrangements: Sequence[Arrangement]) -> np.ndarray:
        """(A, S, n, 3) predicted key points, mm, if the channels drove the chambers so."""
        return self.predicted_single(arrangements).astype(float)

    def predicted_single(self, arrangements: Sequence[Arrangement]) -> np.ndarray:
        """Result of `predicted` in single precision, in which models compute."""
        wide = self._arranged(arrangements)
        with torch.no_grad():
            points = wide.rows(self.model.predict(wide)).numpy()
        points[~np.isfinite(points)] = 0.0
        return points.reshape(len(arrangements), -1, *points.shape[1:])

    def along(self, arrangement: Arrangement) -> "RowPredictions":
        """The prediction for single rows, if the channels drove the chambers so."""
        return RowPredictions(self, arrangement)

    def _arranged(self, arrangements: Sequence[Arrangement]) -> History:
        """(A R, T) the thinned runs with the actuation of every arrangement."""
        history, cases = self.history, len(arrangements)

        def each(tensor: torch.Tensor) -> torch.Tensor:
            """(A R, ...) a tensor (R, ...) for every arrangement."""
            return tensor if cases == 1 else tensor.repeat(cases, *[1] * (tensor.ndim - 1))

        def arranged(tensor: torch.Tensor) -> torch.Tensor:
            """(A R, ..., m) actuation (R, ..., m) of the chambers in every arrangement."""
            gains = torch.from_numpy(np.stack([a.gain for a in arrangements])).to(tensor)
            parts = [
                tensor[..., list(a.order)] * g for a, g in zip(arrangements, gains, strict=True)
            ]
            return torch.cat(parts)

        return History(
            t_s=each(history.t_s),
            pressure=arranged(history.pressure),
            key_points=each(history.key_points[:, :, :0]),  # no prediction depends on them
            valid=each(history.valid),
            noise=history.noise,
            temperature_C=None if history.temperature_C is None else each(history.temperature_C),
            stood=None if history.stood is None else arranged(history.stood),
        )

    def with_time(self, factor: float) -> "Sample":
        """The sample with times so many times as long; rows and blocks stay as they are."""
        return replace(
            self,
            history=replace(self.history, t_s=self.history.t_s * factor),
            times=tuple(times * factor for times in self.times),
            at=tuple(times * factor for times in self.at),
        )

    def without(self, lost: np.ndarray) -> "Sample":
        """The sample without key points where a mask (n,) holds."""
        return replace(
            self, points=tuple(np.where(lost[:, None], np.nan, part) for part in self.points)
        )


class RowPredictions:
    """Predicted key points of a sample's rows, mm; the network computes those that are asked for,
    each once.

    Memories follow every row. A network of whole runs, and effects behind the network, which may
    remember key points, need every row computed.
    """

    def __init__(self, sample: Sample, arrangement: Arrangement):
        self._sample, self._arrangement = sample, arrangement
        self._known: list[np.ndarray] = []

    @cached_property
    def _place(self) -> np.ndarray:
        """(S,) place of each row among those of `_known`; -1 where it was never asked for."""
        return np.full(self._sample.rows, -1, np.int32)

    @cached_property
    def whole(self) -> np.ndarray:
        """(S, n, 3) single precision, every row."""
        return self._sample.predicted_single([self._arrangement])[0]

    @cached_property
    def _inputs(self) -> tuple[torch.Tensor, torch.Tensor]:
        """(S, m) each: what the network sees in every row."""
        history = self._sample._arranged([self._arrangement])
        actuation, direction = self._sample.model.inputs(history)
        return history.rows(actuation), history.rows(direction)

    def __call__(self, rows: np.ndarray) -> np.ndarray:
        """(K, n, 3) single precision, of the rows (K,)."""
        if "whole" in vars(self) or not self._sample.model.row_wise:
            return self.whole[rows]
        new = np.unique(rows[self._place[rows] < 0])
        if len(new):
            some, inputs = torch.from_numpy(new), self._inputs
            with torch.no_grad():
                points = self._sample.model.network(inputs[0][some], inputs[1][some]).numpy()
            points[~np.isfinite(points)] = 0.0
            self._place[new] = sum(map(len, self._known)) + np.arange(len(new))
            self._known = [np.concatenate([*self._known, points])]
        return self._known[0][self._place[rows]]


def sample_of(model: ArmModel, recordings: list[Recording], rows: int) -> Sample:
    """About `rows` rows of the recordings, evenly thinned; a recurrent network sees every row."""
    return samples_of(model, recordings, (rows,))[0]


def samples_of(
    model: ArmModel, recordings: list[Recording], sizes: Sequence[int]
) -> tuple[Sample, ...]:
    """Samples of the recordings of about so many rows each, see `sample_of`."""
    whole = history_of(recordings, model.spec.actuation)
    lengths = whole.valid.sum(1).tolist()
    training = ~held_out_rows(recordings)
    measured = np.concatenate([recording.key_points_mm for recording in recordings])
    measured[~training] = np.nan
    seen = np.isfinite(measured).all(2).any(1)
    ends = np.cumsum(lengths)[:-1]
    times = tuple(whole.t_s[run, :length].numpy() for run, length in enumerate(lengths))
    points = tuple(np.split(measured, ends))
    timed = all(recording.kind == "continuous" for recording in recordings)
    samples = []
    for rows in sizes:
        step = 1 if model.remembers else max(1, round(len(measured) / rows))
        # Cameras may be slower than the log: thinned rows must not all fall between their images.
        while step > 1 and _kept(seen, ends, step).mean() < LEAST_SEEN * seen.mean():
            step -= 1
        block = blocks(whole, seen, step, least_blocks=1)
        thinned = replace(
            whole,
            t_s=whole.t_s[:, ::step],
            pressure=whole.pressure[:, ::step],
            key_points=whole.key_points[:, ::step],
            valid=whole.valid[:, ::step],
            temperature_C=None if whole.temperature_C is None else whole.temperature_C[:, ::step],
            noise_mm=None,
            predicted=None,
        )
        samples.append(
            Sample(
                model=model,
                history=thinned,
                times=times,
                points=points,
                at=tuple(each[::step] for each in times),
                block=np.concatenate([part[::step] for part in np.split(block, ends)]),
                timed=timed,
            )
        )
    return tuple(samples)


def _kept(rows: np.ndarray, ends: np.ndarray, step: int) -> np.ndarray:
    """(S,) values of rows (N,) that thinning every run leaves."""
    return np.concatenate([part[::step] for part in np.split(rows, ends)])


def interpolated(at: np.ndarray, times: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(S, n, 3) of points (T, n, 3) at times at (S,), on lines between rows; NaN beyond them."""
    first, second, share = neighbours(at, times)
    return between(points[first], points[second], share)


def neighbours(at: np.ndarray, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(S,) each: the rows of times (T,) before and after times at (S,), and the share of the way
    from one to the other; outside of 0 to 1 beyond the rows."""
    if len(times) < 2:
        only = np.zeros(len(at), int)
        return only, only, np.where(np.abs(at - times[0]) < 1e-9, 0.0, -1.0)
    after = np.clip(np.searchsorted(times, at - 1e-9), 1, len(times) - 1)
    share = (at - times[after - 1]) / (times[after] - times[after - 1])
    return (
        after - 1,
        after,
        np.where(np.abs(share - np.round(share)) < 1e-6, np.round(share), share),
    )


def between(first: np.ndarray, second: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(S, n, 3) on the way from first to second (S, n, 3) at shares (S,); NaN beyond them."""
    first, second = first.astype(float, copy=False), second.astype(float, copy=False)
    part = share[:, None, None]
    # A row that is met exactly does not need its neighbour, which may be missing.
    found = np.where(part == 0, first, np.where(part == 1, second, first + part * (second - first)))
    return np.where(((share < 0) | (share > 1))[:, None, None], np.nan, found)
