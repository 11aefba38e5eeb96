"""Change detection: when has a model stopped holding?

The residual (measured less predicted key points) of a good model is not white: camera noise is
correlated over tenths of a second, the model's own error over seconds, and both differ by
direction. The detector therefore works on the residual's means over blocks of time and whitens
them with what a clean *reference* shows (residuals of the same model on an arm that is known to be
unchanged): principal components in space, and in time a first-order autoregression of each,

    y_i(j) = phi_i y_i(j - 1) + s_i sqrt(1 - phi_i^2) z_i(j),    z_i white.

Each component has two charts, cumulative sums of log-likelihood ratios (CUSUM; Page 1954) against
the same normal distribution with lambda times the scale:

    C(j) = max(0, C(j - 1) + x(j)),
    level:       x = [y^2 (1 - lambda^-2) / (2 s^2) - log lambda] / T,
    innovation:  x =  z^2 (1 - lambda^-2) / 2        - log lambda,

with T = (1 + phi^2) / (1 - phi^2) the number of blocks in which the square of an autoregression is
worth one independent value. The level finds errors that last, the innovation those that come fast.
The alarm is raised where any chart passes

    h = log(M K),

M the wanted mean number of blocks between false alarms and K the number of charts: by Lorden
(1971) a CUSUM of log-likelihood ratios runs for at least exp(h) samples on average without a
change. So the threshold follows from the wanted rate alone.

What the reference cannot state exactly enlarges the scale s. A variance that was estimated from N
independent values counts with the upper end of its 95 % confidence interval. Then s is enlarged
until resampled hours of the reference (moving blocks of 20 s; Künsch 1989), judged by statistics
that were estimated without them, raise no more false alarms than wanted: errors of a network have
heavier tails than a normal distribution.

A reference says nothing about motions that are not in it: a network errs more in the corners of its
range. A block counts only where some block of the reference has an actuation, and a change of it
since the block before, within 15 % of the actuation's range; elsewhere the charts stand still.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree
from scipy.stats import chi2

from surgisoft.errors import InputError

LIKE_SHARE = 0.15
"""Largest difference in actuation, and in its change from block to block, at which a block of the
reference covers one of a run, as a share of the actuation's range [-]."""
LEAST_BLOCKS = 60
"""Fewest blocks of a reference: half a minute with the default block."""
LARGEST_PHI = 0.98
"""Largest autoregression coefficient that is accepted: a correlation time of 25 s."""
FOLDS = 5
"""Parts of a reference that are judged by statistics of the others."""
CONFIDENCE = 0.95
"""Level of the upper confidence bound of a variance (Chew 1966)."""
ENLARGE = 1.1
"""Factor between two tried enlargements of the scale."""
HIGHEST = 1.25
"""Charts are held at this share of the threshold, so that they come back after a change is gone."""
OVER = 0.25
"""Share of the threshold below which a standing alarm is over."""
LARGEST_SCALE = 10.0
"""Largest enlargement of the scale; a reference that needs more shows no stable error."""


@dataclass(frozen=True)
class AlarmDesign:
    """What is to be detected, and how often a false alarm is accepted."""

    false_alarm_h: float = 10.0
    """Mean time between false alarms that the threshold is set for [h]. Ten times the hour that is
    promised, because a run may differ from its reference."""
    scale: float = 3.0
    """lambda: how many times larger than in the reference the error is after a change [-]."""
    block_s: float = 0.5
    """Length of a block of time [s]: longer than the correlation of camera noise."""
    resample_s: float = 20.0
    """Length of the resampled stretches of the reference [s]: longer than the correlation of the
    model's own error."""
    resample_h: float = 20.0
    """Time of the resampled reference on which the scale is tested [h]."""
    least_mm: float = 0.01
    """Standard deviation that is added to every component [mm], so that noiseless simulations do
    not divide by zero."""

    def __post_init__(self):
        if not (np.isfinite(self.false_alarm_h) and 1e-3 <= self.false_alarm_h <= 1e6):
            raise InputError(
                f"time between false alarms is {self.false_alarm_h:g} h, expected 0.001 to 1e6 h"
            )
        if not 1.1 <= self.scale <= 100.0:
            raise InputError(f"scale is {self.scale:g}, expected 1.1 to 100")


@dataclass(frozen=True, eq=False)
class Whitening:
    """Statistics of a clean residual's block means: d = 3 n components."""

    mean_mm: np.ndarray
    """(d,) mean [mm]."""
    axes: np.ndarray
    """(d, d) principal components as columns."""
    level_mm: np.ndarray
    """(d,) standard deviation of each component, its upper confidence bound [mm]."""
    innovation_mm: np.ndarray
    """(d,) standard deviation of what the autoregression leaves of it [mm]."""
    phi: np.ndarray
    """(d,) coefficient of each component's autoregression [-]."""
    worth: np.ndarray
    """(d,) 1 / T: independent values that one block counts for [-]."""

    def components(self, blocks_mm: np.ndarray) -> np.ndarray:
        """(..., d) components of block means (..., d) [mm]."""
        return (blocks_mm - self.mean_mm) @ self.axes

    def squares(self, now: np.ndarray, before: np.ndarray) -> np.ndarray:
        """(..., 2 d) squares of levels and innovations, in units of their variances.

        now, before: (..., d) components of a block and of the one before [mm].
        """
        level = now / self.level_mm
        innovation = (now - self.phi * before) / self.innovation_mm
        return np.concatenate([level, innovation], axis=-1) ** 2

    @property
    def weights(self) -> np.ndarray:
        """(2 d,) independent values that one block counts for in each chart."""
        return np.concatenate([self.worth, np.ones_like(self.worth)])


def block_means(t_s: np.ndarray, residual_mm: np.ndarray, block_s: float) -> np.ndarray:
    """(J, D) means of values (T, ...) over whole blocks of time; t_s: (T,) of one run.

    A key point of a residual that is missing throughout a block keeps its last mean.
    """
    flat = np.asarray(residual_mm, np.float64).reshape(len(t_s), -1)
    place = np.floor((t_s - t_s[0]) / block_s + 1e-6).astype(int)
    rows = [flat[place == j] for j in range(place[-1])]
    means = np.array([_mean(part) for part in rows if len(part)]).reshape(-1, flat.shape[1])
    for j, mean in enumerate(means):
        missing = np.isnan(mean)
        mean[missing] = means[j - 1][missing] if j else 0.0
    return means


def _mean(rows: np.ndarray) -> np.ndarray:
    """(d,) means of the known values of rows (N, d); NaN where none is known."""
    known = np.isfinite(rows)
    count = known.sum(axis=0)
    total = np.where(known, rows, 0.0).sum(axis=0)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def whitening(
    runs: Sequence[np.ndarray], design: AlarmDesign, elsewhere_mm2: np.ndarray | None = None
) -> Whitening:
    """Statistics of a reference: block means (J, d) of each run [mm].

    elsewhere_mm2: (d, d) covariance of the model's error over its whole range [mm^2], which is
    added to that of the reference, because a run may go where the reference did not.
    """
    every = np.concatenate(runs)
    size = every.shape[1]
    mean = every.mean(axis=0)
    covariance = np.cov(every.T) + design.least_mm**2 * np.eye(size)
    variance, axes = np.linalg.eigh(covariance)
    parts = [(run - mean) @ axes for run in runs]
    before = np.concatenate([part[:-1] for part in parts])
    after = np.concatenate([part[1:] for part in parts])
    phi = np.clip((before * after).sum(0) / (before**2).sum(0), 0.0, LARGEST_PHI)
    worth = (1.0 - phi**2) / (1.0 + phi**2)
    level = _upper(variance, len(every) * worth)
    innovation = _upper(np.mean((after - phi * before) ** 2, axis=0), float(len(after)))
    if elsewhere_mm2 is not None:
        level = level + np.einsum("ki,kl,li->i", axes, elsewhere_mm2, axes)
    return Whitening(mean, axes, np.sqrt(level), np.sqrt(innovation), phi, worth)


def _upper(variance: np.ndarray, count: np.ndarray | float) -> np.ndarray:
    """Upper confidence bounds of variances that were estimated from `count` independent values."""
    count = np.maximum(count, 2.0)
    return variance * count / chi2.ppf(1.0 - CONFIDENCE, count)


@dataclass(frozen=True, eq=False)
class Detector:
    """A change detector for one model and one reference; `Charts` runs it along a residual."""

    design: AlarmDesign
    """What is to be detected."""
    whitening: Whitening
    """Statistics of the reference."""
    coverage: Coverage
    """The reference's motions."""
    enlargement: float
    """Factor on the reference's standard deviations [-]."""
    reference_mm: float
    """RMS distance between measured and predicted key points in the reference [mm]."""
    reference_s: float
    """Length of the reference [s]."""

    @property
    def threshold(self) -> float:
        """h: value of a chart at which the alarm is raised [-]."""
        return threshold(self.design, len(self.whitening.phi))

    def increments(self, squares: np.ndarray) -> np.ndarray:
        """(..., 2 d) increments of the charts from squares as `Whitening.squares` gives them."""
        design, weights = self.design, self.whitening.weights
        return increments(squares / self.enlargement**2, weights, design, self.threshold)


def threshold(design: AlarmDesign, components: int) -> float:
    """h for two charts of each component: log(blocks between false alarms x charts)."""
    blocks = design.false_alarm_h * 3600.0 / design.block_s
    return float(np.log(blocks * 2 * components))


def increments(
    squares: np.ndarray, weights: np.ndarray, design: AlarmDesign, limit: float
) -> np.ndarray:
    """Log-likelihood ratios of squares (..., K), times the weights (K,) of the charts.

    None is above a quarter of `limit`, so that no single block, such as a marker's glitch, which
    counts on its way out and on its way back, raises an alarm.
    """
    gain = 0.5 * (1.0 - design.scale**-2)
    ratio = weights * (gain * squares - np.log(design.scale))
    return np.minimum(ratio, limit / 4.0)


class Stretch(NamedTuple):
    """T samples of a run without a reset or a gap."""

    t_s: np.ndarray
    """(T,) times [s]."""
    residual_mm: np.ndarray
    """(T, n, 3) measured less predicted key points [mm]; NaN where missing."""
    actuation: np.ndarray
    """(T, m) actuation [unit of the arm]."""


@dataclass(frozen=True, eq=False)
class Coverage:
    """The motions of a reference."""

    tree: cKDTree
    """Blocks of the reference: actuation and its change, in tolerances."""
    tolerance: np.ndarray
    """(m,) largest difference that counts as alike [unit of the arm]."""

    @classmethod
    def of(cls, runs: Sequence[np.ndarray], span: np.ndarray) -> Coverage:
        """The motions of runs of blocks with actuations (J, m); span: (m,) its range."""
        tolerance = LIKE_SHARE * np.asarray(span, np.float64)
        return cls(
            cKDTree(np.concatenate([motion(run) / np.tile(tolerance, 2) for run in runs])),
            tolerance,
        )

    def covers(self, moved: np.ndarray) -> np.ndarray:
        """(...,) whether motions (..., 2 m), as `motion` gives them, are in the reference."""
        return self.tree.query(moved / np.tile(self.tolerance, 2), p=np.inf)[0] <= 1.0


def motion(actuation: np.ndarray) -> np.ndarray:
    """(J - 1, 2 m) actuation of blocks (J, m) from the second on, and its change [unit]."""
    return np.concatenate([actuation[1:], np.diff(actuation, axis=0)], axis=1)


class _Run(NamedTuple):
    """Blocks of one run."""

    residual: np.ndarray
    """(J, d) means of the residual [mm]."""
    actuation: np.ndarray
    """(J, m) means of the actuation [unit]."""


def _blocks(stretch: Stretch, block_s: float) -> _Run:
    return _Run(*(block_means(stretch.t_s, values, block_s) for values in stretch[1:]))


def fit_detector(
    reference: Sequence[Stretch],
    span: np.ndarray,
    design: AlarmDesign | None = None,
    elsewhere_mm2: np.ndarray | None = None,
) -> Detector:
    """The detector that a clean reference gives, one stretch for each run.

    span: (m,) range of the actuation [unit]. elsewhere_mm2: see `whitening`. Raises InputError
    where the reference is too short.
    """
    design = design or AlarmDesign()
    blocks = [_blocks(stretch, design.block_s) for stretch in reference]
    blocks = [run for run in blocks if len(run.residual) > 1]
    runs = [run.residual for run in blocks]
    count = sum(map(len, runs))
    if count < LEAST_BLOCKS:
        raise InputError(
            f"the clean reference has {count * design.block_s:g} s, expected at least "
            f"{LEAST_BLOCKS * design.block_s:g} s; record longer"
        )
    found = whitening(runs, design, elsewhere_mm2)
    distance = np.concatenate([stretch.residual_mm for stretch in reference])
    reference_mm = float(np.sqrt(np.nanmean((distance**2).sum(-1))))
    squares = _judged_by_others(blocks, span, design, elsewhere_mm2)
    enlargement = _enlargement(squares, found.weights, design)
    coverage = Coverage.of([run.actuation for run in blocks], span)
    return Detector(design, found, coverage, enlargement, reference_mm, count * design.block_s)


def _judged_by_others(blocks, span, design: AlarmDesign, elsewhere_mm2) -> list[np.ndarray]:
    """Squares (J, 2 d) of each part of a reference with statistics of the other parts.

    Blocks that the other parts do not cover are left out, as in a run.
    """
    folds = [[run] for run in blocks] if len(blocks) >= FOLDS else _fifths(blocks)
    judged = []
    for k, fold in enumerate(folds):
        others = [run for j, other in enumerate(folds) if j != k for run in other]
        known = whitening([run.residual for run in others], design, elsewhere_mm2)
        coverage = Coverage.of([run.actuation for run in others], span)
        for run in fold:
            part = known.components(run.residual)
            covered = coverage.covers(motion(run.actuation))
            judged.append(known.squares(part[1:], part[:-1])[covered])
    return [squares for squares in judged if len(squares)]


def _fifths(runs: Sequence[_Run]) -> list[list[_Run]]:
    """Five folds of consecutive blocks of a few runs."""
    folds: list[list[_Run]] = [[] for _ in range(FOLDS)]
    for run in runs:
        for k, rows in enumerate(np.array_split(np.arange(len(run.residual)), FOLDS)):
            if len(rows) > 1:
                folds[k].append(_Run(run.residual[rows], run.actuation[rows]))
    return [fold for fold in folds if fold]


def _enlargement(squares: list[np.ndarray], weights, design: AlarmDesign) -> float:
    """Smallest tried factor on the scale with few enough alarms on the resampled reference."""
    if not squares:
        return 1.0
    accepted = max(1.0, design.resample_h / design.false_alarm_h)
    draws = resampled(squares, design)
    h = threshold(design, len(weights) // 2)
    factor = 1.0
    while factor < LARGEST_SCALE:
        if alarms_in(increments(draws / factor**2, weights, design, h), h) <= accepted:
            return factor
        factor *= ENLARGE
    raise InputError(
        "the clean reference shows no stable error of the model: its parts differ by more than "
        f"{LARGEST_SCALE:g} times; record a longer reference, or fit the model again"
    )


def resampled(squares: Sequence[np.ndarray], design: AlarmDesign) -> np.ndarray:
    """(S, G, 2 d) squares of G chains of S blocks: random stretches of the reference, joined."""
    rng = np.random.default_rng(0)
    stretch = max(1, round(design.resample_s / design.block_s))
    total = round(design.resample_h * 3600.0 / design.block_s)
    starts = np.array(
        [
            first
            for begin, run in zip(np.cumsum([0, *map(len, squares[:-1])]), squares, strict=True)
            for first in range(begin, begin + max(1, len(run) - stretch + 1))
        ]
    )
    every = np.concatenate(squares)
    joined = max(2, round(0.1 * 3600.0 / design.resample_s))
    chains = max(1, total // (joined * stretch))
    first = rng.choice(starts, (joined, chains))
    rows = np.minimum(first[:, None] + np.arange(stretch)[None, :, None], len(every) - 1)
    return every[rows.reshape(joined * stretch, chains)]


def alarms_in(steps: np.ndarray, h: float) -> int:
    """Number of alarms of charts with increments (S, G, K); the charts of a chain begin again."""
    charts, alarms = np.zeros(steps.shape[1:]), 0
    for step in steps:
        charts = np.maximum(charts + step, 0.0)
        over = (charts > h).any(axis=-1)
        alarms += int(over.sum())
        charts[over] = 0.0
    return alarms


@dataclass(frozen=True)
class Alarm:
    """The model has stopped holding."""

    at_s: float
    """Time of the sample after which the alarm was raised [s]."""
    since_s: float
    """Estimated time of the change: the chart that raised it was at zero until then [s]."""
    chart: str
    """`level`, of an error that lasts, or `innovation`, of one that came fast."""
    before_mm: float
    """RMS distance of the key points from the model in the reference [mm]."""
    after_mm: float
    """RMS distance since the estimated time of the change [mm]."""

    @property
    def sentence(self) -> str:
        """The alarm in words."""
        return (
            f"the model stopped holding at {self.since_s:.1f} s, found at {self.at_s:.1f} s "
            f"({self.at_s - self.since_s:.1f} s later): error {self.before_mm:.3f} mm in the "
            f"reference, {self.after_mm:.3f} mm since"
        )


@dataclass(eq=False)
class Charts:
    """The charts of a detector along a run, sample by sample."""

    detector: Detector
    """The detector."""
    statistic: float = 0.0
    """Largest chart over the threshold: 1 raises the alarm [-]."""
    alarm: Alarm | None = None
    """The alarm that is standing, None where the model holds."""
    alarms: list[Alarm] = field(default_factory=list)
    """All alarms so far."""
    judged: int = 0
    """Blocks that the charts have taken."""
    left_out: int = 0
    """Blocks whose motion is not in the reference."""
    _charts: np.ndarray | None = None
    _zero_s: np.ndarray | None = None
    _before: np.ndarray | None = None
    _mean: np.ndarray | None = None
    _moved: np.ndarray | None = None
    _rows: list[np.ndarray] = field(default_factory=list)
    _actuations: list[np.ndarray] = field(default_factory=list)
    _begin_s: float | None = None
    _recent: list[tuple[float, float]] = field(default_factory=list)

    def update(self, t_s: float, residual_mm: np.ndarray, actuation: np.ndarray) -> Alarm | None:
        """Take the residual (n, 3) [mm] and the actuation (m,) of a time [s].

        Returns an alarm where one begins.
        """
        block_s = self.detector.design.block_s
        if self._begin_s is None or t_s - self._begin_s > 4.0 * block_s or t_s < self._begin_s:
            self.pause()
            self._begin_s = t_s
        begun = None
        if t_s >= self._begin_s + block_s - 1e-6 * block_s:
            begun = self._close(t_s)
            self._begin_s += block_s
        self._rows.append(np.asarray(residual_mm, np.float64).reshape(-1))
        self._actuations.append(np.asarray(actuation, np.float64))
        return begun

    def pause(self) -> None:
        """The samples that follow do not continue those before: a reset, or a gap in time."""
        self._rows, self._actuations = [], []
        self._before = self._moved = self._begin_s = None

    def _close(self, t_s: float) -> Alarm | None:
        """Let the charts take the block that ends at t_s."""
        rows, self._rows = np.array(self._rows), []
        actuations, self._actuations = np.array(self._actuations), []
        if not len(rows):
            return None
        mean = _mean(rows)
        last = np.zeros_like(mean) if self._mean is None else self._mean
        self._mean = np.where(np.isnan(mean), last, mean)
        whole = rows.reshape(len(rows), -1, 3)
        distance = (whole**2).sum(-1)
        if np.isfinite(distance).any():
            self._recent.append((t_s, float(np.nanmean(distance))))
        detector = self.detector
        now = detector.whitening.components(self._mean)
        before, self._before = self._before, now
        moved, self._moved = self._moved, actuations.mean(axis=0)
        if before is None or moved is None:
            return None
        if not detector.coverage.covers(motion(np.array([moved, self._moved])))[0]:
            self.left_out += 1
            return None
        self.judged += 1
        steps = detector.increments(detector.whitening.squares(now, before))
        if self._charts is None or self._zero_s is None:
            self._charts = np.zeros_like(steps)
            self._zero_s = np.full_like(steps, t_s - detector.design.block_s)
        h = detector.threshold
        self._charts = np.clip(self._charts + steps, 0.0, HIGHEST * h)
        self._zero_s[self._charts == 0.0] = t_s
        self.statistic = float(self._charts.max() / h)
        if self.alarm is None and self.statistic > 1.0:
            return self._raise(t_s)
        if self.alarm is not None and self.statistic < OVER:
            self.alarm = None
        if self.alarm is None:
            self._recent = self._recent[-round(120.0 / detector.design.block_s) :]
        return None

    def _raise(self, t_s: float) -> Alarm:
        assert self._charts is not None
        assert self._zero_s is not None
        over = np.flatnonzero(self._charts > self.detector.threshold)
        chart = int(over[self._zero_s[over].argmin()])
        since_s = float(self._zero_s[chart])
        kind = "level" if chart < len(self._charts) // 2 else "innovation"
        squares = [square for at_s, square in self._recent if at_s > since_s]
        after = float(np.sqrt(np.mean(squares))) if squares else float("nan")
        self.alarm = Alarm(t_s, since_s, kind, self.detector.reference_mm, after)
        self.alarms.append(self.alarm)
        return self.alarm


def stretches(
    t_s: np.ndarray, run: np.ndarray, residual_mm: np.ndarray, actuation: np.ndarray
) -> list[Stretch]:
    """The runs of a recording, as `fit_detector` takes them; run: (T,) its number."""
    edges = [0, *(np.flatnonzero(np.diff(run)) + 1).tolist(), len(run)]
    return [
        Stretch(t_s[a:b], residual_mm[a:b], actuation[a:b]) for a, b in itertools.pairwise(edges)
    ]
