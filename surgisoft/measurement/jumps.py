"""Jumps of a body: sudden displacements that neither the actuation nor the prediction explains.

An effect that is a continuous function of the actuation and its past makes no jump under
continuous actuation. Stick-slip friction, snap-through of the wall, impacts and lost markers do, so
jumps tell such causes from all continuous effects, whatever their form.

A jump is the difference of two one-sided local linear estimates of a key point's place, from the
rows just before and just behind a moment (Müller 1992, "Change-points in nonparametric regression
analysis", Annals of Statistics 20). What of it a linear filter of the actuation and of the
predicted motion gives is taken out first, by a regression on their own jumps at several delays:
where the actuation has a corner, a body that lags has one a moment later. Where they jump
themselves, by as much as the body does, nothing is said.

A body that swings fast beside the rows of a camera bends away from a straight line within a side: a
swing of 3.3 Hz at 30 rows a second gives linear estimates that differ by its whole amplitude. The
quadratic estimates from the same rows differ by less than a fifth of it, and by the whole of a true
jump. So what they do not show is the curvature of the motion, and is no jump.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import chdtri

WINDOW_S = 0.1
"""Length of each side of a jump, s: longer ones take the curvature of fast motion for jumps."""
ROWS = 4
"""Fewest rows of a side, as far as `LONGEST_S` holds them."""
LEAST_ROWS = 3
"""Fewest rows of a side; two give a line without any averaging of the noise."""
LONGEST_S = 0.25
"""Longest side, s, for the sake of `ROWS`."""
DELAYS_S = (-0.1, -0.05, 0.0, 0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 0.8)
"""Delays of the predicted motion whose jumps may come again in the measured one, s."""
MOST_DIRECTIONS = 7
"""Most principal directions of the predicted motion that are taken for it."""
RIDGE = 1e-3
"""Ridge of the regression, as a share of the mean power of the predicted jumps."""
NEAR_S = 0.3
"""Time for which a jump of the predicted motion may cause one of the measured motion, s."""
LONGEST_STEP = 1.5
"""Longest step of time within both sides, as a multiple of the usual one: where a frame was
dropped, two steps of a motion look like a jump."""
USUAL_STEPS = 0.9
"""Quantile of the steps of time that is the usual one; steps of some recordings all differ."""
LEAST_SHOWN = 1.0 / 3.0
"""Least share of a jump that the quadratic estimates show. Of curvature they show up to a fifth, of
a jump all, and two fifths where a row lies half way."""
CHANCE = 1e-6
"""Chance of a jump in one row from noise alone: a recording has 10,000 rows."""
QUANTILES = (0.5, 0.8)
"""Quantiles of the squared jumps of all rows that the noise is estimated from; most rows have no
jump, and the largest of these and the known noise counts."""
LARGEST = 10
"""Jumps whose mean square is the level of a recording; fewer count as further ones of size 0."""
BY_CHANCE = 2.0
"""Factor on the squared level of jumps of an unchanged arm, up to which another recording of it may
come by chance."""
SEEN = 0.9
"""Least share of the rows in which a key point is known that takes part."""
MOST_ROWS = 60_000
"""Rows that are looked at, the first ones: 50 minutes at 20 Hz. They take about 200 MB for
nine key points and six chambers."""


@dataclass(frozen=True, eq=False)
class Motion:
    """Measured and predicted motion of a body, N rows."""

    t_s: np.ndarray
    """(N,) time, s."""
    run: np.ndarray
    """(N,) run of each row; the rows of a run stand one after another."""
    measured_mm: np.ndarray
    """(N, n, 3) measured key points, mm; NaN where missing."""
    predicted_mm: np.ndarray
    """(N, n, 3) predicted key points, mm, in the same frame."""
    actuation: np.ndarray
    """(N, m) actuation, in any unit."""
    noise_mm: np.ndarray
    """(n,) RMS noise of each measured key point's distance, mm."""


@dataclass(frozen=True, eq=False)
class Jumps:
    """Jumps of a body, the largest first."""

    rows: np.ndarray
    """(J,) the first row behind each jump."""
    sizes_mm: np.ndarray
    """(J,) RMS displacement of the key points in each, mm, without the noise."""
    minutes: float
    """Time that was looked at, minutes."""

    @property
    def level_mm(self) -> float:
        """RMS size of the ten largest, mm; 0 stands in for those that are missing."""
        return float(np.sqrt(np.square(self.sizes_mm[:LARGEST]).sum() / LARGEST))


@dataclass(frozen=True, eq=False)
class BodyJumps:
    """Jumps of the body in recordings, beside those that the arm had before a change."""

    jumps: Jumps
    """Jumps in the recordings."""
    before_mm: float
    """Level of the jumps before (`Jumps.level_mm`), mm; 0 where none is known."""
    error_mm: float
    """RMS error of the model above the noise in the same rows, mm."""

    @property
    def share(self) -> float:
        """Level of the jumps beyond those of before, over the error; at most 1."""
        square = self.jumps.level_mm**2 - BY_CHANCE * self.before_mm**2
        return float(np.sqrt(max(square, 0.0))) / max(self.error_mm, self.jumps.level_mm, 1e-30)


NONE = Jumps(np.zeros(0, int), np.zeros(0), 0.0)


def find_jumps(motion: Motion) -> Jumps:
    """The jumps of the measured key points that the predicted ones lack.

    A row in which a key point is missing has no jump, nor has one near a row that is missing; key
    points that are missing in more than a tenth of the rows do not count. Samples at the same time,
    such as steady states, have no jumps, nor have samples whose times are not known.
    """
    t_s, run, actuation = motion.t_s, motion.run, motion.actuation
    measured_mm, predicted_mm = motion.measured_mm, motion.predicted_mm
    begins = np.flatnonzero(np.diff(run, prepend=run[:1] - 1))
    parts = np.split(np.arange(len(run)), begins[1:])
    steps = np.concatenate([np.zeros(0), *(np.diff(t_s[rows]) for rows in parts)])
    step = float(np.median(steps)) if np.isfinite(steps).all() and len(steps) else 0.0
    seen = np.isfinite(measured_mm).all(2)
    known = seen.any(1)
    if step <= 0.0 or not known.any():
        return NONE
    points = seen[known].mean(0) >= SEEN
    side = _side(step)
    kept, left = [], MOST_ROWS
    for rows in parts:
        kept.append(rows[: max(left, 0)])
        left -= len(kept[-1])
    parts = [rows for rows in kept if len(rows) > 2 * side]
    if not points.any() or not parts:
        return NONE
    own = _Cause.of(predicted_mm[:, points], actuation, side, step)
    flat = [measured_mm[rows][:, points].reshape(len(rows), -1) for rows in parts]
    found, curved = ([_jumps(each, side, degree) for each in flat] for degree in (1, 2))
    theirs = [own.jumps(predicted_mm[rows][:, points], actuation[rows]) for rows in parts]
    size, near, there = (np.concatenate([each[k] for each in theirs]) for k in range(3))
    measured = np.concatenate(found)
    moments = np.concatenate([rows[side : len(rows) - side + 1] for rows in parts])
    even = np.concatenate([_even(t_s[rows], side) for rows in parts])
    # A filter of the motion before the first row is not known.
    whole = np.isfinite(measured).all(1) & even & np.concatenate([each[3] for each in theirs])
    energy = _unexplained(np.where(whole[:, None], measured, 0.0), there, near, whole)
    degrees = measured.shape[1]
    variance = 2.0 * float(np.square(_weights(side)).sum())
    scale = float(np.square(motion.noise_mm[points]).sum()) * variance
    for quantile in QUANTILES:
        if whole.any():
            chance = degrees / chdtri(degrees, 1.0 - quantile)
            scale = max(scale, float(np.quantile(energy.least[whole], quantile)) * chance)
    limit = scale * chdtri(degrees, CHANCE) / degrees
    shown = _shown(energy.jump, np.concatenate(curved))
    excess = np.where(whole & shown, energy.least - np.maximum(energy.explained, size), 0.0)
    picked = _apart(excess, limit, run[moments], 2 * side)
    order = picked[np.argsort(-excess[picked], kind="stable")]
    sizes = np.sqrt(np.maximum(excess[order] - scale, 0.0) / points.sum())
    return Jumps(moments[order], sizes, len(moments) * step / 60.0)


def own_level_mm(motion: Motion) -> float:
    """Level of the jumps that an arm makes by itself, mm; 0 where all have a cause.

    Which jumps have a cause depends on what the columns of the actuation show: commands do not show
    what motors and valves make of them. So where some have none, all jumps of the body count, those
    with a cause too.
    """
    found = find_jumps(motion)
    if not len(found.rows):
        return 0.0
    still = np.zeros_like(motion.measured_mm)
    every = find_jumps(replace(motion, predicted_mm=still, actuation=still[:, 0, :1]))
    return max(found.level_mm, every.level_mm)


def _side(step_s: float) -> int:
    """Rows on each side of a jump."""
    return max(LEAST_ROWS, min(ROWS, int(LONGEST_S / step_s)), round(WINDOW_S / step_s))


def _weights(side: int, degree: int = 1) -> np.ndarray:
    """(side,) weights of the rows before a moment, half a row behind the last of them, in the
    estimate of a straight line or a parabola there."""
    powers = np.arange(degree + 1.0)
    place = np.arange(1.0 - side, 1.0)
    return 0.5**powers @ np.linalg.pinv(place[:, None] ** powers)


def _jumps(values: np.ndarray, side: int, degree: int = 1) -> np.ndarray:
    """(T - 2 side + 1, C) jump of series (T, C) at each moment with `side` rows on both sides."""
    count = len(values) - 2 * side + 1
    answer = np.zeros((count, values.shape[1]))
    for place, weight in enumerate(_weights(side, degree)):
        answer -= weight * values[place : place + count]
        answer += weight * values[2 * side - 1 - place : 2 * side - 1 - place + count]
    return answer


def _even(t_s: np.ndarray, side: int) -> np.ndarray:
    """(T - 2 side + 1,) whether no row is missing within both sides of each moment of a run."""
    steps = np.diff(t_s)
    longest = LONGEST_STEP * float(np.quantile(steps, USUAL_STEPS))
    before = np.concatenate([[0], np.cumsum(steps > longest)])
    return before[2 * side - 1 :] == before[: len(before) - 2 * side + 1]


def _delayed(values: np.ndarray, rows: int) -> np.ndarray:
    """A series (T, C) so many rows later; 0 where it is not known."""
    answer = np.zeros_like(values)
    if abs(rows) < len(values):
        if rows >= 0:
            answer[rows:] = values[: len(values) - rows]
        else:
            answer[:rows] = values[-rows:]
    return answer


@dataclass(frozen=True, eq=False)
class _Cause:
    """What a body may jump with: the predicted motion, and the actuation times its mean effect."""

    mean: np.ndarray
    """(3 n,) mean of the predicted key points, mm."""
    directions: np.ndarray
    """(3 n, D) principal directions of the predicted motion."""
    slope: np.ndarray
    """(m, 3 n) mean effect of the actuation on the predicted motion, mm per unit."""
    side: int
    """Rows on each side of a jump."""
    delays: tuple[int, ...]
    """Delays that are tried, rows."""
    near: int
    """Rows for which a jump may cause another one."""

    @classmethod
    def of(cls, points: np.ndarray, actuation: np.ndarray, side: int, step_s: float) -> "_Cause":
        """From predicted key points (N, n, 3), mm, and actuation (N, m)."""
        some = slice(None, None, max(1, len(points) // 3000))
        flat = points.reshape(len(points), -1)[some]
        mean, moved = flat.mean(0), actuation[some] - actuation[some].mean(0)
        _, _, directions = np.linalg.svd(flat - mean, full_matrices=False)
        slope = np.linalg.lstsq(moved, flat - mean, rcond=1e-6)[0]
        delays = tuple(sorted({round(delay / step_s) for delay in DELAYS_S}))
        near = round(NEAR_S / step_s)
        return cls(mean, directions[:MOST_DIRECTIONS].T, slope, side, delays, near)

    def jumps(
        self, points: np.ndarray, actuation: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of predicted key points (T, n, 3) and actuation (T, m) of a run, for each of M moments:
        (M,) the largest squared jump near it, (M, 3 n) the jump of the predicted motion, (M, K) all
        jumps in all delays, and (M,) whether all delays are known."""
        flat = points.reshape(len(points), -1) - self.mean
        own, given = _jumps(flat, self.side), _jumps(actuation, self.side)
        square = np.maximum(np.square(own).sum(1), np.square(given @ self.slope).sum(1))[:, None]
        size = np.max(
            [_delayed(square, k) for k in range(-self.side, self.side + self.near + 1)], axis=0
        )[:, 0]
        along = np.concatenate(
            [own @ self.directions, given * np.linalg.norm(self.slope, axis=1)], axis=1
        )
        every = np.concatenate([_delayed(along, k) for k in self.delays], axis=1)
        known = np.arange(len(own)) >= self.delays[-1]
        return size, own, every, known


@dataclass(frozen=True, eq=False)
class _Energy:
    """Squared jumps of each moment, mm^2 summed over the key points."""

    jump: np.ndarray
    """(M, C) the smaller one of the measured jump and of what the predicted motion leaves of it,
    mm."""
    least: np.ndarray
    """(M,) its square."""
    explained: np.ndarray
    """(M,) what the predicted motion gives."""


def _unexplained(
    measured: np.ndarray, predicted: np.ndarray, own: np.ndarray, whole: np.ndarray
) -> _Energy:
    """What a linear filter of the jumps of their causes leaves of measured ones (M, C).

    predicted: (M, K) jumps of predicted motion and actuation, delayed; own: (M, C) those of the
    predicted motion, undelayed; whole: (M,) moments that count.
    """
    columns = np.where(whole[:, None], predicted, 0.0)
    gram = columns.T @ columns
    ridge = RIDGE * float(np.trace(gram)) / len(gram) + 1e-9
    given = predicted @ np.linalg.solve(gram + ridge * np.eye(len(gram)), columns.T @ measured)
    left = measured - given
    smaller = np.square(measured).sum(1) <= np.square(left).sum(1)
    jump = np.where(smaller[:, None], measured, left)
    return _Energy(
        jump, np.square(jump).sum(1), np.maximum(np.square(given).sum(1), np.square(own).sum(1))
    )


def _shown(jump: np.ndarray, curved: np.ndarray) -> np.ndarray:
    """(M,) whether quadratic estimates (M, C) show `LEAST_SHOWN` of each jump (M, C), mm."""
    square = np.square(jump).sum(1)
    return np.nansum(jump * curved, axis=1) >= LEAST_SHOWN * square


def _apart(excess: np.ndarray, limit: float, run: np.ndarray, rows: int) -> np.ndarray:
    """Moments whose excess (M,) is above the limit, the largest within so many rows each."""
    answer: list[int] = []
    free = np.ones(len(excess), bool)
    for moment in np.argsort(-excess, kind="stable"):
        if excess[moment] <= limit:
            break
        if free[moment]:
            answer.append(int(moment))
            near = slice(max(0, moment - rows), moment + rows + 1)
            free[near] &= run[near] != run[moment]
    return np.array(answer, int)
