"""The residual table: what was measured and what a model predicts, row by row.

`compare`, `diagnose`, `amend`, `improve` and `next_experiment` all start from one `ResidualTable`,
which is built once from a model and recordings. `ResidualTable.view` hands out the training rows,
the held-out rows or all rows as a `Problem`: the rows of that part alone, thinned, in blocks of
time and folds, with the measurement noise and the model discrepancy that errors are compared
against. Key points of rows outside the part are NaN in a view, so that nothing that works on a
view can see them.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from surgisoft.compiled import compiled
from surgisoft.diagnosis.body_frame import bending, frames
from surgisoft.diagnosis.history_features import Memory, features, memory_of
from surgisoft.errors import InputError
from surgisoft.measurement.histories import actuation_of, check_fits, history_of
from surgisoft.measurement.jumps import BodyJumps
from surgisoft.measurement.noise import hold_noise, stated_noise
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.chain import Taps
from surgisoft.surrogate.history import History
from surgisoft.surrogate.model import LEFT_OF_MOTION, ArmModel
from surgisoft.surrogate.scan import linear_scan
from surgisoft.surrogate.training_residuals import TrainingResiduals
from surgisoft.time_axis import continued

ROWS = 2000
"""Rows that amplitudes are fitted to; memories follow every row."""
EVERY_ROW = 10**9
"""More rows than any recording has: no row is left out."""
HELD_OUT_SHARE = 0.25
"""Share of each recording, its last runs or its last rows, that is held out for a final check."""
RUNS_TO_HOLD_OUT = 4
"""Fewest runs of a recording of which whole runs are held out."""
BLOCK_S = 5.0
"""Length of a block of time, the unit of every test, s."""
BLOCK_ROWS = 8
"""Fewest of the fitted rows in a block."""
LEAST_BLOCKS = 10
"""Fewest blocks of an identification."""
FOLDS = 5
"""Folds that are left out in turn."""
TOGETHER = 2
"""Neighbouring motions that are left out together."""
LEAST_DISCREPANCY = 0.3
"""Least share of a validated error that counts as model discrepancy, however much of it the noise
may have been."""
LEAST_NOISE_MM = 1e-4
"""Least noise that is reckoned with, mm: below it divisions by the noise lose their digits."""

Part = Literal["training", "held_out", "all"]


# Noise ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Floor:
    """A noise floor: the error that no model of the arm can go below, and where it comes from."""

    rmse_mm: float | None
    """RMS distance of a measured key point from its true place, mm; None if it is not known."""
    source: str
    """`sidecar`, `holds`, `second differences`, `repeats`, `pairs` (of a paired difference) or
    `unknown`."""


UNKNOWN = Floor(None, "unknown")


def floor_in_words(floor_mm: float, digits: str) -> str:
    """A noise floor [mm] in words, its number in the format `digits`; `unknown` for the least noise
    that is reckoned with, which stands for noise that nothing shows, see `floor_to_tell`."""
    return "unknown" if 0.0 < floor_mm <= LEAST_NOISE_MM else f"{floor_mm:{digits}} mm"


def floor_to_tell(noise_mm: np.ndarray, source: str) -> float:
    """RMS noise over all key points [mm] from that of each, (n,), as `noise_of` gives it.

    0 for noise that is known, as from a sidecar, to be less than is reckoned with (LEAST_NOISE_MM).
    """
    floor_mm = float(np.sqrt(np.mean(noise_mm**2)))
    return 0.0 if source != "unknown" and floor_mm <= LEAST_NOISE_MM else floor_mm


def noise_of(recordings: list[Recording]) -> tuple[np.ndarray, str]:
    """(n,) RMS noise of each key point's distance, mm, and where it is known from.

    What the lab states in the sidecar; else the scatter in holds; else second differences in time,
    which a smooth motion leaves small (their variance is six times that of white noise). A
    distance has three coordinates' noise.
    """
    count = recordings[0].key_points_mm.shape[1]
    for floor in (_stated_floor(recordings), hold_floor(recordings)):
        if floor.rmse_mm is not None:
            return np.full(count, max(floor.rmse_mm, LEAST_NOISE_MM)), floor.source
    number = [
        np.cumsum(np.diff(r.run, prepend=r.run[:1]) != 0)
        if r.kind == "continuous"
        else np.arange(r.samples)
        for r in recordings
    ]
    return _differences_noise([r.key_points_mm for r in recordings], number)


LEAST_DIFFERENCES = 30
"""Least number of second differences of a coordinate at the lag, in rows, that noise is taken
from. Their median is then within some 20 % of its limit."""
LEAST_STILL = 0.1
"""Least share of the variance of second differences that stays noise: what is left of a larger
motion is not known better."""
MOST_LAG = 100
"""Largest such lag, rows: a camera may be that many times slower than the log."""


def _differences_noise(
    points_mm: Sequence[np.ndarray], run: Sequence[np.ndarray]
) -> tuple[np.ndarray, str]:
    """(n,) RMS noise of each key point's distance, mm, from second differences, and its source.

    points_mm: (T, n, 3) of each recording, NaN where missing; run: (T,) run of each of its rows, a
    number of its own for each row that is not one of a motion. The lag of the differences is the
    least at which there are enough of them. Where the motion makes up more than half of their
    variance, it is taken out of it: at twice the lag that of a smooth motion is 16 times as large,
    that of noise the same (Richardson, 1911). The spread is the median of absolute values, scaled
    to the standard deviation of a normal distribution. One coordinate follows another, because the
    differences of all of them together take several times the memory of the recordings.
    """
    variance = np.zeros((2, *points_mm[0].shape[1:]))
    for place in np.ndindex(*variance.shape[1:]):
        columns = [points[:, *place] for points in points_mm]
        if all(np.isnan(column).all() for column in columns):
            continue
        lags = range(1, min(MOST_LAG, max(len(column) for column in columns) // 2) + 1)
        lag = next((k for k in lags if len(_differences(columns, run, k)) >= LEAST_DIFFERENCES), 1)
        for number, times in enumerate((lag, 2 * lag)):
            second = _differences(columns, run, times)
            if len(second):
                variance[number, *place] = (1.4826 * np.median(np.abs(second))) ** 2 / 6.0
    once, twice = variance.sum(2)
    still = np.maximum(16.0 * once - twice, 15.0 * LEAST_STILL * once) / 15.0
    noise = np.sqrt(np.where(still < once / 2, still, once))
    source = "second differences" if noise.any() else "unknown"
    return np.maximum(noise, LEAST_NOISE_MM), source


def _differences(columns: Sequence[np.ndarray], run: Sequence[np.ndarray], lag: int) -> np.ndarray:
    """Second differences of a coordinate (T,) at a lag, rows, within runs and without gaps."""
    parts = [
        (column[2 * lag :] - 2.0 * column[lag:-lag] + column[: -2 * lag])[
            number[2 * lag :] == number[: -2 * lag]
        ]
        for column, number in zip(columns, run, strict=True)
        if len(column) > 2 * lag
    ]
    second = np.concatenate([*parts, np.zeros(0)])
    return second[~np.isnan(second)]


def _floor_of(noise_mm: np.ndarray, source: str) -> Floor:
    """The floor over all key points from the noise (n,) of each."""
    return Floor(floor_to_tell(noise_mm, source), source) if source != "unknown" else UNKNOWN


def _stated_floor(recordings: list[Recording]) -> Floor:
    stated = stated_noise(recordings)
    return UNKNOWN if stated is None else Floor(float(np.sqrt(3.0) * stated), "sidecar")


def hold_floor(recordings: list[Recording]) -> Floor:
    """The noise floor from the scatter in holds alone."""
    found = hold_noise(recordings)
    return UNKNOWN if found is None else Floor(float(np.sqrt(3.0) * found), "holds")


# Every row -----------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ResidualTable:
    """Residuals of a model on every row of some recordings, all runs one after another: N rows."""

    model: ArmModel
    """The model in question."""
    history: History
    """All runs, every row."""
    names: tuple[str, ...]
    """Names of the recordings."""
    predicted_mm: np.ndarray
    """(N, n, 3) predicted key points, base frame, mm."""
    measured_mm: np.ndarray
    """(N, n, 3) measured key points, base frame, mm; NaN where missing, or not to be seen."""
    pressure: np.ndarray
    """(N, m) actuation, in the arm's unit."""
    commanded: np.ndarray
    """(N, m) commanded actuation, in the arm's unit; NaN where not known."""
    direction: np.ndarray
    """(N, m) direction of change of the chambers' pressure, as the network sees it: -1, 0, 1."""
    t_s: np.ndarray
    """(N,) time of the row in its recording, s."""
    run: np.ndarray
    """(N,) number of the run, counted over all recordings."""
    recording: np.ndarray
    """(N,) number of the recording."""
    timed: np.ndarray
    """(N,) whether the row is one of a continuous recording, not a steady-state sample."""
    gravity: np.ndarray
    """(N, 3) unit vector along the weight, base frame; NaN where not known."""
    temp_C: np.ndarray
    """(N,) temperature, degrees Celsius; NaN where not known."""
    payload_g: np.ndarray
    """(N,) mass attached, g; NaN where not known."""
    held_out: np.ndarray
    """(N,) whether the row is held out for a final check."""
    noise_mm: np.ndarray
    """(n,) RMS noise of each key point's distance, mm."""
    floor: Floor
    """The noise over all key points, and where it is known from."""
    holds: Floor
    """The noise floor from the scatter in holds alone."""
    paired_discrepancy_mm: np.ndarray | None = None
    """(n,) where the residuals are paired differences (`pairs`): what takes the place of the model
    discrepancy, mm; None: the residuals are those of the model."""
    paired_tolerance_mm: np.ndarray | None = None
    """(n,) where they are paired differences: `Problem.tolerance_mm`."""
    taps: Taps | None = None
    """What the model's scan of the history gave: signals in every row, and memories where there are
    not very many rows."""
    body_before_mm: np.ndarray | None = None
    """(N, n, 3) where they are paired differences: key points of BEFORE along the same motion, base
    frame, mm, without gaps."""
    jumps: BodyJumps | None = None
    """Jumps of the body as it was recorded, where recordings from before are known: the residuals
    are then no longer those of the recorded body."""

    @property
    def spec(self) -> ArmSpec:
        """The model's arm."""
        return self.model.spec

    @property
    def rest_mm(self) -> np.ndarray:
        """(n, 3) key points at rest, base frame, mm."""
        return self.model.rest_mm.double().cpu().numpy()

    @property
    def drawn_gravity(self) -> np.ndarray | None:
        """(3,) direction of the weight, base frame, which pictures draw downward: that of the first
        row of which it is known; None where it is known of none."""
        known = np.flatnonzero(np.isfinite(self.gravity).all(axis=1))
        return self.gravity[known[0]] if len(known) else None

    @property
    def residual_mm(self) -> np.ndarray:
        """(N, n, 3) measured less predicted, base frame, mm; NaN where missing."""
        return self.measured_mm - self.predicted_mm

    @cached_property
    def along_s(self) -> np.ndarray:
        """(N,) time on the axis that charts and replays share: all recordings in turn, s."""
        return continued(self.t_s)

    def recorded_s(self, recording: int) -> float:
        """Time of all runs of a recording, by its number, s; pauses between runs do not count."""
        own = self.recording == recording
        return sum(float(np.ptp(self.t_s[own & (self.run == run)])) for run in set(self.run[own]))

    @property
    def error_mm(self) -> np.ndarray:
        """(N, n) distance between predicted and measured key points, mm; NaN where missing."""
        return np.linalg.norm(self.residual_mm, axis=-1)

    @cached_property
    def body_mm(self) -> np.ndarray:
        """(N, n, 3) residual along the predicted body, in its bending plane and out of it, mm."""
        frame = frames(self.predicted_mm, self.rest_mm)
        return (frame @ self.residual_mm[..., None])[..., 0]

    @property
    def bending_mm(self) -> np.ndarray:
        """(N, 2) lateral displacement of the predicted tip from rest, base frame x and y, mm."""
        return bending(self.predicted_mm, self.rest_mm)

    @property
    def scaled_pressure(self) -> np.ndarray:
        """(N, m) actuation scaled to [-1, 1] over the model's range."""
        low, high = np.array(self.spec.low), np.array(self.spec.high)
        pressure = self.history.rows(self.history.pressure).double().numpy()
        return (pressure - (low + high) / 2) / half_range(self.spec)

    @cached_property
    def memory(self) -> Memory:
        """Features of the actuation's past in each row."""
        return memory_of(self.history, self.spec)

    def features_at(self, rows: np.ndarray) -> np.ndarray:
        """(S, F) all that the residual may depend on, of order 1, in rows (S,) of the table
        (`history_features.features`)."""
        context = None if np.isnan(self.temp_C).all() else self.temp_C[:, None] / 10.0
        timed = bool((self.history.dt_s > 0).any())
        return features(self.memory, self.spec, context, timed, rows)

    def only(self, part: Part) -> "ResidualTable":
        """The table of one part: key points of all other rows are NaN, in the history too.

        A noise floor from second differences is then that of the training rows, for either part:
        the held-out rows decide nothing before the final check.
        """
        if part == "all":
            return self
        noise, floor = self.noise_mm, self.floor
        if floor.source == "second differences":
            training = np.where(self.held_out[:, None, None], np.nan, self.measured_mm)
            run = np.where(self.timed, self.run, -1 - np.arange(len(self.run)))
            noise, source = _differences_noise([training], [run])
            floor = _floor_of(noise, source)
        shown = self.held_out if part == "held_out" else ~self.held_out
        if np.isnan(self.measured_mm[~shown]).all():
            return replace(self, noise_mm=noise, floor=floor)
        points = self.history.key_points.clone()
        points[self.history.valid] = points[self.history.valid].masked_fill(
            ~torch.from_numpy(shown)[:, None, None], torch.nan
        )
        return replace(
            self,
            measured_mm=np.where(shown[:, None, None], self.measured_mm, np.nan),
            history=replace(self.history, key_points=points),
            noise_mm=noise,
            floor=floor,
        )

    def view(
        self, part: Part = "all", rows: int = ROWS, least_blocks: int = LEAST_BLOCKS
    ) -> "Problem":
        """The identification problem of one part, thinned to about `rows` rows.

        Memories follow the actuation of every row. least_blocks: fewest blocks of time.
        """
        table = self.only(part)
        seen = np.isfinite(table.measured_mm).all(2).any(1)
        step = max(1, round(seen.sum() / rows))
        block = blocks(table.history, seen, step, least_blocks)
        index = np.flatnonzero(seen)[::step]
        names = np.unique(block[index])
        places = np.where(np.isin(block, names), np.searchsorted(names, block), -1)
        motion = motions(table.history, half_range(self.spec), places)
        discrepancy = self.paired_discrepancy_mm
        if discrepancy is None:
            discrepancy = model_discrepancy(self.model, table.noise_mm)
        tolerance = self.paired_tolerance_mm
        return Problem(
            model=self.model,
            table=table,
            index=torch.from_numpy(index),
            pressure=table.scaled_pressure[index],
            direction=table.direction[index],
            measured=table.measured_mm[index],
            predicted=table.predicted_mm[index],
            time_s=table.t_s[index],
            block=places[index],
            block_of_row=places,
            motion=motion,
            fold=folds(motion),
            discrepancy_mm=discrepancy,
            tolerance_mm=discrepancy if tolerance is None else tolerance,
        )

    def training(self, rows: int = ROWS) -> "Problem":
        """The training rows: all that a diagnosis or a fit may see."""
        return self.view("training", rows)

    def final_check(self) -> "Problem":
        """Every held-out row, for the one look at the end of `amend` and `improve`."""
        return self.view("held_out", EVERY_ROW)


def residual_table(model: ArmModel, recordings: list[Recording]) -> ResidualTable:
    """Evaluate a model on whole recordings, whatever their unit of length."""
    check_fits(model.spec, recordings, sized=False)
    history = history_of(recordings, model.spec.actuation)
    with torch.no_grad():
        taps = model.scan(history, memories=False)
        predicted = history.rows(taps.behind["sensor"])
        direction = history.rows(taps.direction)
    if not torch.isfinite(predicted).all():
        asked, spec = history.rows(history.pressure), model.spec
        raise InputError(
            f"the model predicts values that are not finite for actuation from "
            f"{float(asked.min()):.4g} to {float(asked.max()):.4g} {spec.unit}; it was fitted to "
            f"{min(spec.low):.4g} to {max(spec.high):.4g}. Check the unit, or fit it again"
        )
    noise, source = noise_of(recordings)

    def each(pick, width: tuple[int, ...] = ()) -> np.ndarray:
        """One value a row, from what each recording has; NaN where it has nothing."""
        parts = []
        for recording in recordings:
            value = pick(recording)
            value = np.full(width, np.nan) if value is None else np.asarray(value)
            parts.append(np.broadcast_to(value, (recording.samples, *width)))
        return np.concatenate(parts)

    return ResidualTable(
        model=model,
        history=history,
        names=tuple(recording.name for recording in recordings),
        predicted_mm=predicted.double().numpy(),
        # Not through float32: the measured values are compared as they were recorded.
        measured_mm=joined([recording.key_points_mm for recording in recordings]),
        pressure=np.concatenate([actuation_of(r, model.spec.actuation) for r in recordings]),
        commanded=each(lambda r: r.commanded, (model.spec.chambers,)),
        direction=direction.double().numpy(),
        t_s=history.rows(history.t_s).numpy(),
        run=history.run_of_row.numpy(),
        recording=np.concatenate([np.full(r.samples, i) for i, r in enumerate(recordings)]),
        timed=each(lambda r: r.kind == "continuous"),
        gravity=each(lambda r: r.gravity, (3,)),
        temp_C=each(lambda r: r.temp_C),
        payload_g=each(lambda r: r.payload_g),
        held_out=held_out_rows(recordings),
        noise_mm=noise,
        floor=_floor_of(noise, source),
        holds=hold_floor(recordings),
        taps=taps,
    )


def joined(parts: list[np.ndarray]) -> np.ndarray:
    """The rows of several arrays one after another; a single one is not copied."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def problem_of(
    model: ArmModel, recordings: list[Recording], rows: int = ROWS, part: Part = "all"
) -> "Problem":
    """The identification problem of a model and one part of some recordings."""
    return residual_table(model, recordings).view(part, rows)


def half_range(spec: ArmSpec) -> np.ndarray:
    """(m,) half the width of each chamber's range, in the arm's unit; 1 where it has none."""
    span = np.array(spec.high) - np.array(spec.low)
    return np.where(span > 0, span / 2, 1.0)


def held_out_rows(recordings: list[Recording]) -> np.ndarray:
    """(N,) bool: the rows of all recordings, one after another, that are held out."""
    answer = []
    for recording in recordings:
        held = np.zeros(recording.samples, bool)
        runs = recording.runs
        if len(runs) >= RUNS_TO_HOLD_OUT:
            for run in runs[-max(1, round(HELD_OUT_SHARE * len(runs))) :]:
                held[run] = True
        else:
            held[round((1 - HELD_OUT_SHARE) * recording.samples) :] = True
        answer.append(held)
    return np.concatenate(answer)


class Sealed:
    """Recordings whose held-out rows nothing but the final check can see.

    `training` are the recordings with the key points of their held-out rows missing: all that a
    diagnosis or a fit is given. `opened` gives the held-out rows, once.
    """

    def __init__(self, recordings: list[Recording]):
        held_out = held_out_rows(recordings)
        ends = np.cumsum([recording.samples for recording in recordings])[:-1]
        self.training = [
            replace(r, key_points_mm=np.where(held[:, None, None], np.nan, r.key_points_mm))
            for r, held in zip(recordings, np.split(held_out, ends), strict=True)
        ]
        self._key_points_mm: list[np.ndarray] | None = [r.key_points_mm for r in recordings]

    def check(self, table: ResidualTable) -> None:
        """Raise InputError where the held-out rows are too few for the final check.

        Nothing but which of their key points are missing is looked at.
        """
        assert self._key_points_mm is not None
        there = np.isfinite(np.concatenate(self._key_points_mm)).all(2).any(1) & table.held_out
        try:
            blocks(table.history, there)
        except InputError as error:
            raise InputError(
                f"the held-out part, the last quarter of each recording, has {there.sum()} rows "
                f"with key points, too few to validate an amendment on them: {error}"
            ) from None

    def opened(self, table: ResidualTable) -> ResidualTable:
        """The table of the training rows with the held-out rows in it, for `final_check`.

        Noise and all that a table of the training rows says of errors stay. A second call raises
        ValueError: data that were looked at before a choice are no longer held-out data.
        """
        if self._key_points_mm is None:
            raise ValueError("the held-out rows were used before; they allow one evaluation only")
        whole = np.concatenate(self._key_points_mm)
        measured = np.where(table.held_out[:, None, None], whole, table.measured_mm)
        self._key_points_mm = None
        points = table.history.key_points.clone()
        points[table.history.valid] = torch.from_numpy(measured).to(points)
        return replace(
            table, measured_mm=measured, history=replace(table.history, key_points=points)
        )


def with_training_noise(table: ResidualTable, recordings: list[Recording]) -> ResidualTable:
    """A table of whole recordings with the noise that `diagnose` reckons with on them.

    Held-out rows decide nothing before the final check, so holds and second differences are those
    of the training rows. Where these have no key point, the noise stays that of all rows.
    """
    if np.isnan(table.measured_mm[~table.held_out]).all():
        return table
    training = Sealed(recordings).training
    noise, source = noise_of(training)
    floor, holds = _floor_of(noise, source), hold_floor(training)
    return replace(table, noise_mm=noise, floor=floor, holds=holds)


# The rows of one part ------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Reference:
    """Residuals of a model from before the change in question, such as those of its training."""

    pressure: np.ndarray
    """(S, m) actuation scaled to [-1, 1] over the model's range."""
    direction: np.ndarray
    """(S, m) directions of change."""
    residual: np.ndarray
    """(S, n, 3) measured less predicted, mm; NaN where missing."""


@dataclass(frozen=True, eq=False)
class Problem:
    """An identification problem: one part of a residual table, thinned to S rows."""

    model: ArmModel
    """The model in question."""
    table: ResidualTable
    """Every row; key points outside the part are NaN."""
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
    block_of_row: np.ndarray
    """(N,) block of each row of the table; -1 where no key point may be seen."""
    motion: np.ndarray
    """(B,) motion of each block, from 0: blocks that repeat a motion share it."""
    fold: np.ndarray
    """(B,) fold that each block is left out with; one for all blocks of a motion."""
    discrepancy_mm: np.ndarray
    """(n,) model discrepancy: validated RMS error of each key point without its noise, mm."""
    tolerance_mm: np.ndarray
    """(n,) RMS error, mm, that the right effect may leave: the model discrepancy, and in a paired
    difference what errors of the model's slope do to the sensitivities of the effects."""
    reference: Reference | None = None
    """Residuals from before the change in question; None: the discrepancy is known by its size
    alone."""

    @property
    def history(self) -> History:
        """All runs, every row."""
        return self.table.history

    @property
    def in_fit(self) -> float | None:
        """Share 0..1 of the part's rows that the model was fitted to; None where it does not say.

        Errors on rows of the fit are no test errors.
        """
        known = self.model.fitted_rows
        held_out = self.table.held_out
        return None if known is None else known.certain_part_of(self.history, held_out)

    @property
    def noise_mm(self) -> np.ndarray:
        """(n,) RMS noise of each key point's distance, mm."""
        return self.table.noise_mm

    @property
    def floor_mm(self) -> float:
        """RMS noise over all key points that is reckoned with, mm: `LEAST_NOISE_MM` at least."""
        return float(np.sqrt(np.mean(self.noise_mm**2)))

    @property
    def told_floor_mm(self) -> float:
        """The same as it is told, mm, see `floor_to_tell`."""
        return floor_to_tell(self.noise_mm, self.table.floor.source)

    @property
    def covered_s(self) -> float | None:
        """Time that the longest recording covers, s; None where they have no times."""
        timed = self.table.timed[self.index.numpy()]
        return float(self.time_s[timed].max()) if timed.any() else None

    @property
    def residual(self) -> np.ndarray:
        """(S, n, 3) measured less predicted, mm."""
        return self.measured - self.predicted

    @property
    def rmse_mm(self) -> float:
        """RMS distance between measured and predicted key points, mm."""
        return float(np.sqrt(np.nanmean(np.square(self.residual).sum(2))))

    def by_motion(self, values: np.ndarray) -> np.ndarray:
        """(..., M) means of values (..., B) of the blocks over those that share a motion."""
        sums = np.zeros((int(self.motion.max()) + 1, *values.shape[:-1]))
        np.add.at(sums, self.motion, np.moveaxis(values, -1, 0))
        return np.moveaxis(sums, 0, -1) / np.bincount(self.motion)

    @cached_property
    def _places(self) -> tuple[Tensor, Tensor]:
        """(S,) run and step of each fitted row."""
        runs, steps = self.history.valid.nonzero(as_tuple=True)
        return runs[self.index], steps[self.index]

    def rows(self, tensor: Tensor) -> Tensor:
        """The fitted rows of a (R, T, ...) tensor."""
        return tensor[self._places]

    @property
    def taps(self) -> Taps | None:
        """What a scan of the history by the model gave; None for a model other than the table's."""
        return self.table.taps if self.model is self.table.model else None

    def without_blocks(self, out: np.ndarray) -> "Problem":
        """The problem without the blocks of time where out (B,) bool is set."""
        row, number = ~out[self.block], np.cumsum(~out) - 1
        owner = self.block_of_row
        kept = (owner >= 0) & ~out[owner]
        return replace(
            self,
            index=self.index[torch.from_numpy(row)],
            pressure=self.pressure[row],
            direction=self.direction[row],
            measured=self.measured[row],
            predicted=self.predicted[row],
            time_s=self.time_s[row],
            block=number[self.block[row]],
            block_of_row=np.where(kept, number[owner], -1),
            motion=np.unique(self.motion[~out], return_inverse=True)[1],
            fold=self.fold[~out],
        )

    def with_model(self, model: ArmModel) -> "Problem":
        """The same rows with the residuals of another model of the arm."""
        with torch.no_grad():
            predicted = self.rows(model.predict(self.history)).double().numpy()
        return replace(self, model=model, predicted=predicted)

    def with_reference(self, given: Sequence[Recording] | TrainingResiduals) -> "Problem":
        """The problem with residuals from before the change in question.

        The model discrepancy has to explain these rows too, by the same function of actuation and
        direction, so it cannot be mistaken for what has changed since.
        """
        spec = self.model.spec
        if not isinstance(given, TrainingResiduals):
            check_fits(spec, list(given))
            given = self.model.residuals_on([history_of(list(given), spec.actuation)], ROWS)
        low, half = np.array(spec.low), np.array(spec.span) / 2
        known = Reference(
            pressure=(given.actuation.double().numpy() - low) / half - 1.0,
            direction=given.direction.double().numpy(),
            residual=given.residual_mm.double().numpy(),
        )
        return replace(self, reference=known)


def model_discrepancy(model: ArmModel, noise_mm: np.ndarray) -> np.ndarray:
    """(n,) validated RMS error of each key point, mm, without the noise of its validation.

    noise_mm: (n,) what that noise is taken for where the model does not state it.
    """
    spec, stated = model.spec, model.validation
    validated = np.array(
        [value or 0.0 for value in stated.per_key_point_mm]
        or [0.05 * (spec.length_mm or 50.0)] * spec.key_points
    )
    noise = noise_of_validation(model, noise_mm)
    return np.sqrt(np.maximum(validated**2 - noise**2, (LEAST_DISCREPANCY * validated) ** 2))


def noise_of_validation(model: ArmModel, noise_mm: np.ndarray) -> np.ndarray:
    """(n,) RMS noise of each key point's distance in the rows that validated a model, mm.

    noise_mm: (n,) what it is taken for where the model does not state it.
    """
    own = model.validation.noise_mm
    return noise_mm if own is None else np.full(len(noise_mm), np.sqrt(3.0) * own)


# Whose arm it is ----------------------------------------------------------------------------------

WHOSE_ARM = (
    "check that MODEL is of this arm, and in the map the columns of [measured] and [key_points], "
    "their units and [frame]"
)
"""What to do where a model does not describe an arm."""
NOTICED = 1.5
"""Least error that is noticed, as a multiple of the validated error and the noise together."""


@dataclass(frozen=True)
class ModelFit:
    """How well a model predicts recordings as they are."""

    rmse_mm: float
    """RMS error of a key point, mm."""
    expected_mm: float
    """What it is with a correct set-up where nothing is missing: the model's validated error and
    the noise of the recordings together, mm."""
    motion_mm: float
    """RMS motion of the key points as recorded, mm."""

    @property
    def fits(self) -> bool:
        """Whether the recordings can be of the model's arm: it predicts most of their motion, as it
        does whatever physics is missing. True of an arm that hardly moves, which shows nothing."""
        return self.describes(self.rmse_mm)

    def describes(self, left_mm: float) -> bool:
        """Whether an error [mm], of the model or with an effect added, is as small as `fits` has
        it."""
        if self.motion_mm <= NOTICED * self.expected_mm:
            return True
        most = max(LEFT_OF_MOTION * self.motion_mm, NOTICED * self.expected_mm)
        return left_mm <= most


def model_fit(table: ResidualTable) -> ModelFit | None:
    """How well the model predicts the rows of a table; None where no key point is measured."""
    points = table.measured_mm
    if np.isnan(points).all():
        return None
    seen = np.isfinite(points).all(2)
    away = np.where(seen[..., None], points, 0.0)
    mean = away.sum(0) / np.maximum(seen.sum(0), 1)[:, None]
    motion = np.square(points - mean).sum(2)
    discrepancy = model_discrepancy(table.model, table.noise_mm)
    return ModelFit(
        rmse_mm=float(np.sqrt(np.nanmean(np.square(table.error_mm)))),
        expected_mm=float(np.sqrt(np.mean(table.noise_mm**2) + np.mean(discrepancy**2))),
        motion_mm=float(np.sqrt(np.nanmean(motion))),
    )


def fit_of_model(model: ArmModel, recordings: Sequence[Recording]) -> ModelFit | None:
    """How well a model predicts recordings as they are; None where no key point is measured.

    Raises InputError for recordings of another number of chambers or key points.
    """
    return model_fit(residual_table(model, list(recordings)))


def blocks(
    history: History, seen: np.ndarray, step: int = 1, least_blocks: int = LEAST_BLOCKS
) -> np.ndarray:
    """(N,) block of time of each row; -1 where it is not seen.

    Whole runs where they are many and short; else stretches of runs of about BLOCK_S, at least
    LEAST_BLOCKS of them in all. A block never crosses the border of a run. step: every how many
    rows one is fitted.
    """
    time, shown = history.rows(history.t_s).numpy(), np.flatnonzero(seen)
    # Runs stand one after another.
    _, begins = np.unique(history.run_of_row.numpy()[shown], return_index=True)
    runs = np.split(shown, begins[1:])
    lengths = [float(np.ptp(time[rows])) for rows in runs if len(rows)]
    total = sum(lengths)
    length = min(BLOCK_S, total / (2 * LEAST_BLOCKS)) if total > 0 else 1.0
    answer, count = np.full(len(seen), -1), 0
    for rows, span in zip(runs, lengths, strict=False):
        parts = max(1, min(round(span / max(length, 1e-9)), len(rows) // (step * BLOCK_ROWS)))
        edges = np.linspace(0, len(rows), parts + 1).astype(int)
        for begin, end in itertools.pairwise(edges):
            answer[rows[begin:end]] = count
            count += 1
    if count < least_blocks:
        raise InputError(
            f"the recordings give {count} blocks of time, expected at least {least_blocks} of "
            f"{BLOCK_ROWS} rows: record more"
        )
    return answer


def folds(motion: np.ndarray) -> np.ndarray:
    """(B,) fold of each block: neighbouring motions together, where there are many."""
    count = int(motion.max()) + 1
    if count < 2:
        return np.arange(len(motion)) // TOGETHER % FOLDS
    return motion // (TOGETHER if count >= TOGETHER * FOLDS else 1) % FOLDS


# Motions that repeat -------------------------------------------------------------------------

MOTION_TIMES_S = (0.5, 2.0)
"""Time constants of the low passes of the actuation, s: two rows repeat a motion where the
actuation and its low passes agree within `MOTION_ALIKE`."""
MOTION_ALIKE = 0.1
"""How far actuation and its past may differ, in half ranges, to count as the same motion."""
MOTION_SHARE = 0.5
"""Share of the rows of each of two blocks that must come again in the other, in motion."""
STILL = 0.02
"""How far an actuation is ahead of its past, in half ranges, up to which the arm is still."""
MOTION_ROWS = 6000
"""Rows among which repeated motions are looked for; more are thinned evenly."""


def motions(history: History, half: np.ndarray, block: np.ndarray) -> np.ndarray:
    """(B,) the motion of each block, counted from 0 in the order in which they first appear.

    A sweep that is repeated shows the model discrepancy again and again, always in the same way.
    Blocks that repeat a motion are no further evidence: they are left out of a fit together, and
    in a test they count as one. half: (m,) half ranges of the actuation; block: (N,) block of each
    row, -1 where it is in none.
    """
    rows = np.flatnonzero(block >= 0)
    rows = rows[:: max(1, -(-len(rows) // MOTION_ROWS))]
    state, owner = motion_states(history, half)[rows], block[rows]
    count = int(block.max()) + 1
    whole = np.maximum(np.bincount(owner, minlength=count), 1)
    moving = np.abs(state[:, history.chambers :]).max(1) > STILL
    state, owner = state[moving], owner[moving]
    # Which rows have a row of which block within reach: each block counts once for a row.
    near = np.zeros((len(owner), count), bool)
    near[np.arange(len(owner)), owner] = True
    _reach(np.ascontiguousarray(state), owner, MOTION_ALIKE, near)
    place, other = np.nonzero(near)
    shared = np.bincount(owner[place] * count + other, minlength=count * count).astype(float)
    shared = shared.reshape(count, count) / whole[:, None]
    alike = np.minimum(shared, shared.T) >= MOTION_SHARE
    answer, found = np.full(count, -1), 0
    for first in range(count):
        if answer[first] < 0:
            answer[alike[first] & (answer < 0)] = found
            answer[first] = found
            found += 1
    return answer


@compiled(inner=True)
def agree(points, one, other, most):
    """Whether two rows of points (N, k) differ by at most `most` in every column."""
    for column in range(points.shape[1]):
        if abs(points[one, column] - points[other, column]) > most:
            return False
    return True


@compiled
def _reach(state, owner, most, near):
    """Set near (N, B) where a row has a row of a block within reach: one of state (N, k) that
    differs by at most `most` in every column. owner: (N,) block of each row."""
    for row in range(len(state)):
        for other in range(row):
            if near[row, owner[other]] and near[other, owner[row]]:
                continue
            if agree(state, row, other, most):
                near[row, owner[other]] = True
                near[other, owner[row]] = True


def motion_states(history: History, half: np.ndarray) -> np.ndarray:
    """(N, 3 m) the actuation of every row and how far it runs ahead of its low passes."""
    signal = history.pressure.double() / torch.from_numpy(half)
    decay = torch.exp(-history.dt_s.double().unsqueeze(-1) / torch.tensor(MOTION_TIMES_S))
    decay = decay.unsqueeze(2).expand(*signal.shape, len(MOTION_TIMES_S))
    wide = signal.unsqueeze(-1)
    start = wide[:, 0].expand(-1, -1, len(MOTION_TIMES_S))
    past = linear_scan(decay, (1.0 - decay) * wide, start)
    return history.rows(torch.cat([signal, (wide - past).flatten(2)], -1)).numpy()


# Rows that repeat ----------------------------------------------------------------------------

REPEAT_ALIKE = 0.02
"""How far actuation and its past may differ, as a share of the range, in rows that repeat each
other."""
REPEAT_APART_S = 10.0
"""Least time between two rows that repeat each other, s: noise may be slow."""
REPEAT_PAIRS = 50
"""Fewest repeats that give an estimate."""
REPEAT_PLACES = 5
"""Fewest blocks of time that repeats must lie in."""
REPEAT_ROWS = 12_000
"""Rows among which repeats are looked for; more are thinned evenly."""
REPEAT_GROUPS = 6
"""Groups that blocks are dealt to at random; repeats are looked for between groups."""


def repeat_floor(table: ResidualTable, block: np.ndarray) -> Floor:
    """The noise floor from inputs that came twice with the same recent history, far apart in time.

    Two such rows differ by twice the variance of one. Their predictions are alike too, so residuals
    are compared: the little that the inputs differ drops out. What the past of the inputs does not
    say (temperature, wear, stick-slip) counts as noise. block: (N,) block of each row, or -1.
    """
    half = np.array(table.spec.span)[:, None] / 2
    memory = table.memory
    past = [memory.play - memory.pressure[..., None]]
    if table.timed.any():
        past.append(memory.low_pass[..., 1:] - memory.pressure[..., None])
    whole = np.concatenate([memory.pressure[..., None], *past], axis=-1) / half
    whole = whole.reshape(len(whole), -1)
    seen = (block >= 0) & ~np.isnan(table.error_mm).all(axis=1)
    seen[np.arange(len(seen)) % -(-len(seen) // REPEAT_ROWS) != 0] = False
    dealt = np.random.default_rng(0).permutation(int(block.max(initial=-1)) + 1) % REPEAT_GROUPS
    group = np.where(seen, dealt[block] if len(dealt) else -1, -1)
    residual = table.residual_mm
    halves, places = [], set()
    for part in range(REPEAT_GROUPS):
        here, there = np.flatnonzero(group == part), np.flatnonzero(seen & (group != part))
        if not len(here) or not len(there):
            continue
        tree = cKDTree(whole[there])
        _, nearest = tree.query(whole[here], p=np.inf, distance_upper_bound=2 * REPEAT_ALIKE)
        found = nearest < len(there)
        a, b = here[found], there[nearest[found]]
        apart = np.abs(table.t_s[a] - table.t_s[b]) >= REPEAT_APART_S
        apart |= table.run[a] != table.run[b]
        a, b = a[apart], b[apart]
        halves.append(np.square(residual[a] - residual[b]).sum(-1) / 2)
        places |= set(block[a].tolist())
    half_square = np.concatenate([part.ravel() for part in halves]) if halves else np.zeros(0)
    half_square = half_square[~np.isnan(half_square)]
    few = len(half_square) < REPEAT_PAIRS * table.spec.key_points
    if few or len(places) < REPEAT_PLACES:
        return UNKNOWN
    return Floor(float(np.sqrt(half_square.mean())), "repeats")
