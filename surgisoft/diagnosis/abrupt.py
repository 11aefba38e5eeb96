"""Abrupt changes, which no effect of the list makes: jumps, and a key point that shifts.

Every effect of the list is a continuous function of the actuation, its past and the time, so where
the body jumps and its actuation does not, the cause is outside the list (`measurement.jumps`).

A key point that shifts against its neighbours from one moment on is a marker that has slipped.
Neighbouring key points lie on one body, so whatever physics changes, the residual of one follows
from those of the others and from the actuation. What does not is an error of that key point alone.
A step in it at one moment is sought on held-out blocks (with a known moment: Chow 1960; the moment
is searched, see `change_points`). A marker may also slide, so a gradual change is tried in its
place.
"""

from dataclasses import dataclass, replace
from itertools import combinations_with_replacement

import numpy as np

from surgisoft.diagnosis import change_points
from surgisoft.diagnosis.residuals import Problem, ResidualTable
from surgisoft.diagnosis.statistics import FoldsOfRidge, block_sums
from surgisoft.measurement.jumps import BodyJumps, Jumps, Motion, find_jumps, own_level_mm

RIDGE = 10.0
"""Ridge on columns of mean square 1: the weight of ten rows."""
LEAST_ABOVE = 0.02
"""Least share of the squared error that counts as above the noise."""
ALONE = 1.0 / 3.0
"""Largest step of another key point at that moment, over that of the shifted one: where the whole
body steps, its tip is shifted a little further than noisy neighbours say."""
GRADUAL = 3.0
"""Studentised log gain over blocks of a slide over the best step from which the key point is said
to slide. Both are searched; the slide, with two moments in place of one, has the freer form."""
GRADUAL_GAIN = 0.1
"""Least mean log gain of a slide over the best step: a tenth of the error."""
LEAST_ROWS = 100
"""Fewest rows with all key points; with fewer there is no test."""


def jumps_in(table: ResidualTable) -> Jumps:
    """The jumps of the body in the rows of a table whose key points may be seen."""
    return find_jumps(_motion(table))


def own_jumps_mm(table: ResidualTable) -> float:
    """Level of the jumps that the arm makes by itself, mm (`jumps.own_level_mm`)."""
    return own_level_mm(_motion(table))


def _motion(table: ResidualTable) -> Motion:
    """The motion in a table's continuous recordings."""
    rows = table.timed
    return Motion(
        t_s=table.t_s[rows],
        run=table.run[rows],
        measured_mm=table.measured_mm[rows],
        predicted_mm=table.predicted_mm[rows],
        actuation=table.scaled_pressure[rows],
        noise_mm=table.noise_mm,
    )


def body_jumps(table: ResidualTable, before_mm: float | None = None) -> BodyJumps:
    """The jumps of the body in the training rows of a table.

    before_mm: level of the jumps before the change in question, mm; None: that of the model's fit.
    """
    training = table.only("training")
    square = np.square(training.error_mm)
    noise = np.square(table.noise_mm).mean()
    mean = float(np.nanmean(square))
    known = training.model.validation.jump_mm if before_mm is None else before_mm
    error = float(np.sqrt(max(mean - noise, LEAST_ABOVE * mean)))
    return BodyJumps(jumps_in(training), known or 0.0, error)


@dataclass(frozen=True)
class Slide:
    """A key point that moves evenly against the others from one moment to another."""

    from_s: float
    """Begin, s, all recordings in turn."""
    until_s: float
    """End, s, all recordings in turn."""
    shift_mm: float
    """How far it is shifted at the end, mm."""


@dataclass(frozen=True)
class KeyPointShift:
    """The most probable shift of one key point against the others."""

    key_point: int
    """Its number, from 0 at the base."""
    at_s: float
    """Time from which on it is shifted, s, all recordings in turn (`ResidualTable.along_s`)."""
    shift_mm: float
    """How far it is shifted, mm."""
    share: float
    """Share, 0 to 1, of the whole squared error above the noise that the shift makes."""
    others: float
    """Largest step of another key point at that moment over that of this one, each beside a
    function of the actuation."""
    log_gain: float
    """Mean over blocks of log(held-out error of the key point before / with the shift), the noise
    added to both."""
    slide: "Slide | None" = None
    """The gradual motion of this key point, where that explains clearly more than a step."""

    @property
    def clarity(self) -> float:
        """Root of the share times the log gain; 0 where other key points step with this one."""
        return float(np.sqrt(self.share)) * max(self.log_gain, 0.0) * (self.others <= ALONE)


def key_point_shift(problem: Problem) -> KeyPointShift | None:
    """The shift with the largest log gain; None with too few rows or a single key point."""
    seen = np.isfinite(problem.residual).all(2)
    points = np.flatnonzero(seen.any(0))
    rows = np.flatnonzero(seen[:, points].all(1))
    if len(points) < 2 or len(rows) < LEAST_ROWS:
        return None
    residual = problem.residual[rows][:, points]
    noise = np.square(problem.noise_mm[points])
    square = float(np.square(residual).sum((1, 2)).mean())
    above = max(square - float(noise.sum()), LEAST_ABOVE * square, 1e-30)
    block = np.unique(problem.block[rows], return_inverse=True)[1]
    fold = problem.fold[problem.block[rows]]
    actuation = _quadratic(problem.pressure[rows])
    ones = np.ones((len(rows), 1), np.float32)
    best: KeyPointShift | None = None
    found: tuple = ()
    for place, point in enumerate(points):
        others = np.delete(residual, place, axis=1).reshape(len(rows), -1)
        columns = _scaled(
            np.concatenate([actuation, others, problem.predicted[rows][:, point]], axis=1)
        )
        columns = np.concatenate([ones, columns], axis=1).astype(np.float32)
        target = residual[:, place].astype(np.float32)
        folds = FoldsOfRidge(columns, target, fold)
        left = folds.remainder(RIDGE)
        first, _ = _best_step(folds, ones, change_points.coarse())
        first, stepped = _best_step(folds, ones, change_points.finer(first / len(rows)))
        plain, after = (
            block_sums(np.square(each, dtype=float).sum(1), block) for each in (left, stepped)
        )
        floor = np.bincount(block) * noise[place]
        gain = float(np.log((plain + floor) / (after + floor)).mean())
        if best is not None and gain <= best.log_gain:
            continue
        shift = _step(columns, target, first)
        part = first / len(rows)
        share = float(np.square(shift).sum()) * part * (1.0 - part) / above
        row = problem.index.numpy()[rows[first]]
        best = KeyPointShift(
            key_point=int(point),
            at_s=float(problem.table.along_s[row]),
            shift_mm=float(np.linalg.norm(shift)),
            share=min(share, 1.0),
            others=_others(actuation, residual, place, first),
            log_gain=gain,
        )
        found = (folds, columns, after + floor, block, floor)
    return best if best is None else replace(best, slide=_slide(problem, rows, *found))


def _slide(
    problem: Problem,
    rows: np.ndarray,
    folds: FoldsOfRidge,
    columns: np.ndarray,
    stepped: np.ndarray,
    block: np.ndarray,
    floor: np.ndarray,
) -> Slide | None:
    """The slide of a key point that explains clearly more on held-out rows than its best step.

    Begin and end are searched (`change_points.slides`); the log gains of the blocks say whether it
    explains more (Vuong 1989). folds, columns: of the residual of this key point; stepped: (B,)
    squared error of each block with the step and the noise `floor` (B,), mm^2.
    """
    part = (np.arange(len(rows)) / max(len(rows) - 1, 1))[:, None]
    tried = change_points.slides()
    states = [np.clip((part - a) / (b - a), 0.0, 1.0).astype(np.float32) for a, b in tried]
    left = folds.with_states(RIDGE, states)
    best = int(np.argmin([np.square(each, dtype=float).sum() for each in left]))
    slid = block_sums(np.square(left[best], dtype=float).sum(1), block) + floor
    gain = np.log(stepped / slid)
    error = float(gain.std(ddof=1)) / np.sqrt(len(gain))
    if gain.mean() < GRADUAL_GAIN or gain.mean() < GRADUAL * error:
        return None
    ends = [rows[round(each * (len(rows) - 1))] for each in tried[best]]
    from_s, until_s = problem.table.along_s[problem.index.numpy()[ends]]
    shift = _amplitude(columns, folds.target, states[best])
    return Slide(float(from_s), float(until_s), float(np.linalg.norm(shift)))


def _best_step(
    folds: FoldsOfRidge, ones: np.ndarray, moments: np.ndarray
) -> tuple[int, np.ndarray]:
    """First row of the step that leaves least on held-out rows, and what it leaves (S, 3), mm.

    moments: (M,) shares of the rows before the step that are tried; ones: (S, 1).
    """
    behind = np.unique((moments * len(ones)).astype(int))
    left = folds.with_breaks(RIDGE, ones, behind)
    best = int(np.argmin([np.square(each, dtype=float).sum() for each in left]))
    return int(behind[best]), left[best]


def _quadratic(pressure: np.ndarray) -> np.ndarray:
    """(S, F) actuation (S, m) and its products in twos."""
    pairs = combinations_with_replacement(range(pressure.shape[1]), 2)
    products = [pressure[:, i] * pressure[:, j] for i, j in pairs]
    return np.concatenate([pressure, np.stack(products, axis=1)], axis=1)


def _scaled(columns: np.ndarray) -> np.ndarray:
    """Columns (S, F) without their means, of mean square 1."""
    centred = columns - columns.mean(0)
    return centred / np.maximum(np.sqrt(np.square(centred).mean(0)), 1e-9)


def _others(actuation: np.ndarray, residual: np.ndarray, place: int, first: int) -> float:
    """Largest step of another key point than one of residuals (S, k, 3) from a row on, over its."""
    columns = np.concatenate([np.ones((len(actuation), 1)), _scaled(actuation)], axis=1)
    steps = _step(columns, residual.reshape(len(residual), -1), first).reshape(-1, 3)
    sizes = np.linalg.norm(steps, axis=1)
    return float(np.delete(sizes, place).max() / max(sizes[place], 1e-30))


def _step(columns: np.ndarray, target: np.ndarray, first: int) -> np.ndarray:
    """(C,) step of a target (S, C), mm, from a row on, beside columns (S, F)."""
    return _amplitude(columns, target, (np.arange(len(target)) >= first)[:, None])


def _amplitude(columns: np.ndarray, target: np.ndarray, state: np.ndarray) -> np.ndarray:
    """(C,) amplitude of a state (S, 1) in a target (S, C), mm, beside columns (S, F)."""
    step = state.astype(float)
    wide = columns.astype(float)
    gram = wide.T @ wide + RIDGE * np.eye(wide.shape[1])
    free = step - wide @ np.linalg.solve(gram, wide.T @ step)
    left = target - wide @ np.linalg.solve(gram, wide.T @ target)
    return (free.T @ left / (np.square(free).sum() + 1.0))[0]
