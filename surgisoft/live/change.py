"""Change detection: since when is a model no longer valid?

The residual (measured less predicted key points) of a good model is not white: camera noise is
correlated over tenths of a second, and the model's own error is a function of where the arm is and
how it came there. It returns with every motion, it stands still while the arm does, and it changes
as fast as the arm moves. The detector works on the residual's means over blocks of time and whitens
them with what a clean *reference* shows (residuals of the same model on an arm that is known to be
unchanged):

- The *static error* m(x, d) of actuation x and direction of its change d is a Gaussian process
  (model discrepancy; Kennedy & O'Hagan 2001) given the reference: its posterior mean is subtracted,
  and where the reference was not, its posterior variance counts.
- What is left, in its principal components, is correlated along the path, not along time: it is the
  sum of white noise and of an Ornstein-Uhlenbeck process in time and path length,

      corr(y(j), y(j - 1)) = rho(j) = (1 - w) exp(-|x(j) - x(j - 1)| / l - block / tau).

  Its innovation z = (y(j) - rho y(j - 1)) / (s sqrt(1 - rho^2)) is small in a hold and large in a
  fast move; w, l and tau are the most likely ones for the reference.

Each component has three charts, cumulative sums of log-likelihood ratios (CUSUM; Page 1954) against
the same normal distribution with lambda times the scale:

    C(j) = max(0, C(j - 1) + x(j)),
    level:       x = [y^2 (1 - lambda^-2) / (2 s^2) - log lambda] / T,
    innovation:  x =  z^2 (1 - lambda^-2) / 2        - log lambda,
    fast moves:  x = that of the innovation where 1 / T >= 1 / 2, else 0,

with T = (1 + r^2) / (1 - r^2), r = rho / (1 - w), the number of blocks in which the square of the
slow part is worth one independent value: none while the arm stands still. The level finds errors
that last, the innovation those that come fast, and the chart of fast moves those that come with
each of them (a slower line), as it forgets nothing in the slow motion in between.
The alarm is raised where any chart passes

    h = log(M K),

M the wanted mean number of blocks between false alarms and K the number of charts: by Lorden
(1971) a CUSUM of log-likelihood ratios runs for at least exp(h) samples on average without a
change. So the threshold follows from the wanted rate alone.

What the reference cannot state exactly enlarges the scale s. A variance that was estimated from N
independent values counts with the upper end of its 95 % confidence interval, so that each chart
keeps its rate with that probability (exceedance criterion: Albers & Kallenberg 2004). The chart of
fast moves has a variance of its own, since z^2 is often larger in them than rho states; ten minutes
of a task hold 10 to 20 fast moves, and each of them is one value. Then s is enlarged
until resampled hours of the reference (moving blocks of 20 s; Künsch 1989), judged by statistics
that were estimated without them, raise no more false alarms than wanted: errors of a network have
heavier tails than a normal distribution. Ten minutes hold some fifty independent values of the slow
part, and hours hold rarer ones; so no independent value may add more than h / 3, and what comes
within three seconds no more than h / 2.

A CUSUM of many small steps is slow where the error is large at once, so a Shewhart chart stands
beside it (combined Shewhart-CUSUM: Lucas 1982). Its value is the mean square of the level over all
components, and the alarm is raised where that was, in every block of two seconds,

    mean(y^2 / s^2) > max(lambda^2, 4 q)   while the arm moves (sum of 1 / T at least 1 / 2),

q the largest value of the same in the reference, each part judged by the others: an error twice as
large as the reference's largest, in two seconds without a pause. On the resampled reference it
raises no alarm by construction, so it takes nothing of the rate that h is set for.

A reference says nothing about motions that are not in it: a network errs more in the corners of its
range. A block counts only where the reference came at least twice to an actuation, and a change of
it since the block before, within 15 % of the actuation's range; elsewhere the charts stand still.
They also stand still while less than half of the last half minute was such motion: a chart sums
over a time, and what it sums there is mostly of ways into and out of the reference.
A reference of which less than two thirds are like other parts of it shows no error that returns:
nothing is judged by it.
"""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
from scipy import linalg
from scipy.spatial import cKDTree
from scipy.special import chdtri

from surgisoft.diagnosis.discrepancy import kernel
from surgisoft.errors import InputError

LIKE_SHARE = 0.15
"""Largest difference in actuation, and in its change from block to block, at which a block of the
reference covers one of a run, as a share of the actuation's range [-]."""
VISITS = 2
"""How often the reference must have come to a motion, and left it in between, to cover it: what it
shows once says nothing of how the model's error there varies."""
LEFT_S = 2.0
"""Time away from a motion after which coming back is another visit [s]."""
LEAST_REPEATED = 2 / 3
"""Least share of a reference whose motions its other parts cover. On the robots 200, 201 and 203 it
was 0.81 to 1.00 in a minute of a repeated task and 0.69 to 0.87 in ten minutes of the protocol
`mixed`, but 0.34 to 0.47 in two minutes of that protocol, with which 10 of 11 false alarms came."""
RECENT_S, LEAST_RECENT = 30.0, 0.5
"""Time [s] of which at least this share must be motion of the reference for a block to count. On
the robots 201 to 203, with two minutes of `mixed` as reference, 4 false alarms in 0.54 h became
none in 0.35 h; 10 s left one."""
TURN = 0.01
"""Least change from block to block that turns a chamber's direction, in half ranges: more than the
noise of a pressure sensor."""
LEAST_BLOCKS = 60
"""Fewest blocks of a reference: half a minute with the default block."""
CENTRES = 300
"""Most blocks of the reference that carry the static error's features."""
RIDGES = (0.5, 2.0, 8.0, 32.0)
"""Tried variances of what is not static, in variances of the static error [-]; the one that leaves
least on held-out parts of the reference is taken."""
REACHES = (0.1, 0.2, 0.4, 0.8, 1.6, 3.2)
"""Tried path lengths over which what is left decorrelates [half ranges of the actuation]."""
TIMES_S = (3.0, 10.0, 30.0, 100.0, np.inf)
"""Tried times in which it decorrelates [s]; infinite: it stands still while the arm does."""
WHITE = (0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
"""Tried shares of white noise in its variance [-]."""
FOLDS = 5
"""Parts of a reference that are judged by statistics of the others."""
CONFIDENCE = 0.95
"""Level of the upper confidence bound of a variance (Chew 1966)."""
MOST_BLOCK, MOST_VALUE = 1 / 4, 1 / 3
"""Most that one block, and one independent value, may add to a chart, as shares of the threshold: a
marker's glitch is two blocks, out and back, and three motions in which the model errs by much more
than in the reference raise no alarm yet."""
MOST_MOVE, MOVE_S = 1 / 2, 3.0
"""Most that a chart may rise within a time [s], as a share of the threshold: blocks of one fast
move have one cause, such as a way that the reference does not show, and alone raise no alarm."""
CHARTS = 3
"""Charts of each component."""
SUDDEN_S = 2.0
"""Time for which an error must be large without a pause to raise an alarm at once [s]: longer than
a marker that jumps, or one fast move."""
SUDDEN_WORTH = 0.5
"""Independent values of the slow part that this time must hold at least [-]: an error that stands
still while the arm does is one value, however large."""
SUDDEN_TIMES = 2.0
"""How many times as large as the largest of the reference it must be [-]."""
RISEN = 0.5
"""Share of the threshold above which a chart takes part in the estimate of when the change came
[-]. No alarm depends on it."""
FAST = 0.5
"""Independent values of the slow part in a block from which on the arm moves fast [-]."""
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
    """Change to be detected, and accepted rate of false alarms."""

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


class Stretch(NamedTuple):
    """T samples of a run without a reset or a gap."""

    t_s: np.ndarray
    """(T,) times [s]."""
    residual_mm: np.ndarray
    """(T, n, 3) measured less predicted key points [mm]; NaN where missing."""
    actuation: np.ndarray
    """(T, m) actuation [unit of the arm]."""


class Blocks(NamedTuple):
    """Means over J blocks of time of one run."""

    residual_mm: np.ndarray
    """(J, d) residual [mm]."""
    position: np.ndarray
    """(J, m) actuation [half ranges]."""
    direction: np.ndarray
    """(J, m) direction of its last change: -1, 1, or 0 before the first one."""

    @property
    def path(self) -> np.ndarray:
        """(J - 1,) distance from each block to the next [half ranges]."""
        return np.linalg.norm(np.diff(self.position, axis=0), axis=1)

    def part(self, rows: np.ndarray) -> Blocks:
        """Some consecutive blocks."""
        return Blocks(*(values[rows] for values in self))


def blocks_of(stretch: Stretch, half_range: np.ndarray, block_s: float) -> Blocks:
    """The blocks of a run; half_range: (m,) half the actuation's range [unit]."""
    position = block_means(stretch.t_s, stretch.actuation, block_s) / half_range
    direction = np.zeros_like(position)
    for j in range(1, len(position)):
        direction[j] = turned(direction[j - 1], position[j] - position[j - 1])
    return Blocks(block_means(stretch.t_s, stretch.residual_mm, block_s), position, direction)


def turned(direction: np.ndarray, change: np.ndarray) -> np.ndarray:
    """(m,) direction after a change of position (m,) [half ranges] from a direction before it."""
    return np.where(np.abs(change) > TURN, np.sign(change), direction)


@dataclass(frozen=True, eq=False)
class StaticError:
    """The model's error as a function of position and direction, given a reference.

    A Gaussian process with the covariance of `diagnosis.discrepancy`, by its values at a few blocks
    of the reference (deterministic training conditional; Quinonero-Candela & Rasmussen 2005).
    """

    mean_mm: np.ndarray
    """(d,) mean over the reference [mm]."""
    centres: tuple[np.ndarray, np.ndarray]
    """(C, m) positions and (C, m) directions of the blocks that carry it."""
    root: np.ndarray
    """(C, F) with which the covariances to the centres become unit-normal features."""
    weights_mm: np.ndarray
    """(F, d) weight of each feature [mm]."""
    spread: np.ndarray
    """(F, F) covariance of the weights, in units of the static error's variance [-]."""

    @classmethod
    def fitted(cls, runs: Sequence[Blocks], ridges: Sequence[float]) -> list[StaticError]:
        """The static error given runs, for each of some ridges (`RIDGES`)."""
        every = Blocks(*(np.concatenate(parts) for parts in zip(*runs, strict=True)))
        count = len(every.position)
        chosen = np.unique(np.linspace(0, count - 1, min(CENTRES, count)).round().astype(int))
        centres = every.position[chosen], every.direction[chosen]
        values, vectors = linalg.eigh(kernel(*centres, *centres))
        kept = values > 1e-6 * values.max()
        root = vectors[:, kept] / np.sqrt(values[kept])
        features = kernel(every.position, every.direction, *centres) @ root
        square = features.T @ features
        mean = every.residual_mm.mean(axis=0)
        found = []
        for ridge in ridges:
            spread = linalg.inv(square / ridge + np.eye(features.shape[1]))
            weights = spread @ features.T @ (every.residual_mm - mean) / ridge
            found.append(cls(mean, centres, root, weights, spread))
        return found

    def features(self, blocks: Blocks) -> np.ndarray:
        """(J, F) unit-normal features of blocks; those of every ridge are the same."""
        return kernel(blocks.position, blocks.direction, *self.centres) @ self.root

    def given(
        self, blocks: Blocks, features: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """What it leaves of a residual, (J, d) [mm], and (J,) its own variance there [0..1].

        features: those of the blocks, where they are known.
        """
        if features is None:
            features = self.features(blocks)
        left = blocks.residual_mm - self.mean_mm - features @ self.weights_mm
        away = np.maximum(1.0 - (features**2).sum(axis=1), 0.0)
        return left, away + ((features @ self.spread) * features).sum(axis=1)


@dataclass(frozen=True, eq=False)
class Memory:
    """How what the static error leaves is correlated from block to block, for d components."""

    white: np.ndarray
    """(d,) w, share of white noise in the variance [-]."""
    reach: np.ndarray
    """(d,) l, path length over which the rest decorrelates [half ranges]."""
    time_s: np.ndarray
    """(d,) tau, time in which it does [s]."""
    block_s: float
    """Length of a block [s]."""

    @classmethod
    def fitted(
        cls, parts: Sequence[np.ndarray], paths: Sequence[np.ndarray], block_s: float
    ) -> Memory:
        """The most likely memory of components (J, d) with paths (J - 1,) of each run.

        The likelihood is that of each block given the one before, at the most likely variance.
        """
        before = np.concatenate([part[:-1] for part in parts])
        after = np.concatenate([part[1:] for part in parts])
        path = np.concatenate(paths)[:, None]
        best, found = np.full(before.shape[1], np.inf), np.zeros((3, before.shape[1]))
        for reach, time_s in itertools.product(REACHES, TIMES_S):
            kept = np.exp(-path / reach - block_s / time_s)
            for white in WHITE:
                rho = (1.0 - white) * kept
                left = 1.0 - rho**2
                variance = np.mean((after - rho * before) ** 2 / left, axis=0)
                cost = np.log(variance) + np.mean(np.log(left))
                found[:, cost < best] = np.array([white, reach, time_s])[:, None]
                best = np.minimum(best, cost)
        return cls(found[0], found[1], found[2], block_s)

    def kept(self, path: np.ndarray) -> np.ndarray:
        """(..., d) correlation of the slow part over a path (...,) in one block."""
        return np.exp(-np.asarray(path)[..., None] / self.reach - self.block_s / self.time_s)

    def worth(self, path: np.ndarray) -> np.ndarray:
        """(..., d) 1 / T: independent values of the slow part in a block with a path (...,)."""
        kept = self.kept(path)
        return (1.0 - kept**2) / (1.0 + kept**2)


@dataclass(frozen=True, eq=False)
class Whitening:
    """Statistics of a clean residual's block means: d = 3 n components."""

    axes: np.ndarray
    """(d, d) principal components of what the static error leaves, as columns."""
    level_mm: np.ndarray
    """(d,) standard deviation of each component, its upper confidence bound [mm]."""
    memory: Memory
    """How each component is correlated along the path."""
    elsewhere_mm2: np.ndarray
    """(d,) variance of the model's error over its whole range along each component [mm^2]."""
    fast: np.ndarray
    """(d,) variance of the innovation in fast moves, over the one that the memory gives; its upper
    confidence bound, at least 1, and infinite where the reference has no fast move [-]."""

    def squares(
        self, now: np.ndarray, before: np.ndarray, path: np.ndarray, unknown: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(..., 3 d) squares of the charts' values, and the independent values that each is.

        They are levels, innovations, and innovations that count in fast moves only, in units of
        their variances. now, before: (..., d) what the static error
        leaves of a block and of the one before [mm]; path: (...,) between them [half ranges];
        unknown: (...,) variance of the static error in the block [0..1].
        """
        rho = (1.0 - self.memory.white) * self.memory.kept(path)
        variance = self.level_mm**2 + np.asarray(unknown)[..., None] * self.elsewhere_mm2
        level = (now @ self.axes) ** 2 / variance
        step = now @ self.axes - rho * (before @ self.axes)
        innovation = step**2 / (variance * (1.0 - rho**2))
        worth = self.memory.worth(path)
        fast = np.where(worth >= FAST, 1.0, 0.0)
        counts = np.concatenate([worth, np.ones_like(rho), fast], axis=-1)
        return np.concatenate([level, innovation, innovation / self.fast], axis=-1), counts


def _upper(variance: np.ndarray, count: np.ndarray | float) -> np.ndarray:
    """Upper confidence bounds of variances that were estimated from `count` independent values."""
    count = np.maximum(count, 2.0)
    return variance * count / chdtri(count, CONFIDENCE)


@dataclass(frozen=True, eq=False)
class Detector:
    """A change detector for one model and one reference; `Charts` runs it along a residual."""

    design: AlarmDesign
    """What is to be detected."""
    half_range: np.ndarray
    """(m,) half the actuation's range [unit]."""
    static: StaticError
    """The model's static error in the reference."""
    whitening: Whitening
    """Statistics of what it leaves."""
    coverage: Coverage
    """The reference's motions."""
    enlargement: float
    """Factor on the reference's standard deviations [-]."""
    reference_mm: float
    """RMS distance between measured and predicted key points in the reference [mm]."""
    reference_s: float
    """Length of the reference [s]."""
    repeated: float
    """Share of the reference whose motions its other parts cover [-]."""
    largest: float = 0.0
    """Largest mean square of the level over the components for `SUDDEN_S`, in the reference [-]."""

    @property
    def sudden_limit(self) -> float:
        """Mean square of the level over the components for `SUDDEN_S` that raises the alarm [-]."""
        return max(self.design.scale**2, SUDDEN_TIMES**2 * self.largest)

    def size(self, squares: np.ndarray) -> np.ndarray:
        """(...) mean square of the level over the components, of (..., 3 d) squares as
        `Whitening.squares` gives them."""
        return sizes(squares / self.enlargement**2)

    @property
    def judges(self) -> bool:
        """Whether the reference repeats its motions: from one that does not nothing can be said of
        how the model's error varies, and no block is judged."""
        return self.repeated >= LEAST_REPEATED

    @property
    def threshold(self) -> float:
        """h: value of a chart at which the alarm is raised [-]."""
        return threshold(self.design, len(self.whitening.level_mm))

    def increments(self, squares: np.ndarray, counts: np.ndarray) -> np.ndarray:
        """(..., 3 d) increments of the charts from what `Whitening.squares` gives.

        No independent value, which may last for many blocks, adds more than `MOST_VALUE`. The
        enlargement was found without that bound.
        """
        limit = self.threshold
        steps = increments(squares / self.enlargement**2, counts, self.design, limit)
        return np.minimum(steps, MOST_VALUE * counts * limit)


def sizes(squares: np.ndarray) -> np.ndarray:
    """(...) mean over the levels among squares (..., 3 d) of charts."""
    return squares[..., : squares.shape[-1] // CHARTS].mean(axis=-1)


def lasting(values: np.ndarray, blocks: int) -> np.ndarray:
    """(J - blocks + 1,) least of each so many consecutive values (J,); empty for fewer."""
    if len(values) < blocks:
        return values[:0]
    return np.lib.stride_tricks.sliding_window_view(values, blocks).min(axis=1)


def threshold(design: AlarmDesign, components: int) -> float:
    """h for the charts of all components: log(blocks between false alarms x charts)."""
    blocks = design.false_alarm_h * 3600.0 / design.block_s
    return float(np.log(blocks * CHARTS * components))


def increments(
    squares: np.ndarray, counts: np.ndarray, design: AlarmDesign, limit: float
) -> np.ndarray:
    """Log-likelihood ratios of squares (..., K), times the independent values that each counts for.

    None is above `MOST_BLOCK` of `limit`.
    """
    gain = 0.5 * (1.0 - design.scale**-2)
    ratio = counts * (gain * squares - np.log(design.scale))
    return np.minimum(ratio, MOST_BLOCK * limit)


@dataclass(frozen=True, eq=False)
class Coverage:
    """The motions of a reference."""

    tree: cKDTree
    """Blocks of the reference: position and its change [half ranges]."""
    time_s: np.ndarray
    """(J,) time of each block, all runs one after another and more than `LEFT_S` apart [s]."""

    @classmethod
    def of(cls, runs: Sequence[np.ndarray], block_s: float) -> Coverage:
        """The motions of runs of blocks with positions (J, m) [half ranges]."""
        moved = [motion(run) for run in runs]
        lengths = [block_s * (len(part) + 1) + LEFT_S for part in moved]
        begins = np.cumsum([0.0, *lengths[:-1]])
        times = [
            begin + block_s * np.arange(len(part))
            for begin, part in zip(begins, moved, strict=True)
        ]
        return cls(cKDTree(np.concatenate(moved)), np.concatenate(times))

    def covers(self, moved: np.ndarray) -> np.ndarray:
        """(...,) whether motions (..., 2 m), as `motion` gives them, are in the reference."""
        return self.visits(moved) >= VISITS

    def visits(self, moved: np.ndarray) -> np.ndarray:
        """(...,) how often the reference came to motions (..., 2 m), and left them in between."""
        near = self.tree.query_ball_point(
            moved.reshape(-1, moved.shape[-1]), 2.0 * LIKE_SHARE, p=np.inf, return_sorted=True
        )
        counts = [1 + (np.diff(self.time_s[some]) > LEFT_S).sum() if some else 0 for some in near]
        return np.array(counts, int).reshape(moved.shape[:-1])


def motion(position: np.ndarray) -> np.ndarray:
    """(J - 1, 2 m) position of blocks (J, m) from the second on, and its change."""
    return np.concatenate([position[1:], np.diff(position, axis=0)], axis=1)


def fit_detector(
    reference: Sequence[Stretch],
    span: np.ndarray,
    design: AlarmDesign | None = None,
    elsewhere_mm2: np.ndarray | None = None,
) -> Detector:
    """The detector that a clean reference gives, one stretch for each run.

    span: (m,) range of the actuation [unit]. elsewhere_mm2: (d, d) covariance of the model's error
    over its whole range [mm^2], which is added where the reference does not show the error. Raises
    InputError where the reference is too short.
    """
    design = design or AlarmDesign()
    half_range = np.asarray(span, np.float64) / 2.0
    runs = [blocks_of(stretch, half_range, design.block_s) for stretch in reference]
    runs = [run for run in runs if len(run.position) > 1]
    count = sum(len(run.position) for run in runs)
    if count < LEAST_BLOCKS:
        raise InputError(
            f"the clean reference has {count * design.block_s:g} s, expected at least "
            f"{LEAST_BLOCKS * design.block_s:g} s; record longer"
        )
    held = _held_out(_folds(runs), design.block_s)
    ridge = min(RIDGES, key=lambda each: sum((part.left**2).sum() for part in held[each]))
    found, squares, counts = _whitened(held[ridge], design, elsewhere_mm2)
    enlargement = _enlargement(squares, counts, design)
    long = round(SUDDEN_S / design.block_s)
    lasted = [lasting(sizes(part / enlargement**2), long) for part in squares]
    distance = np.concatenate([stretch.residual_mm for stretch in reference])
    covered = np.concatenate([part.covered for part in held[ridge]])
    return Detector(
        design,
        half_range,
        StaticError.fitted(runs, (ridge,))[0],
        found,
        Coverage.of([run.position for run in runs], design.block_s),
        enlargement,
        float(np.sqrt(np.nanmean((distance**2).sum(-1)))),
        count * design.block_s,
        float(covered.mean()),
        float(np.concatenate(lasted).max(initial=0.0)) if lasted else 0.0,
    )


class _HeldOut(NamedTuple):
    """A run, or a part of one, judged by the other parts of a reference."""

    fold: int
    """Number of the fold that it belongs to."""
    left: np.ndarray
    """(J, d) what the others' static error leaves of its residual [mm]."""
    unknown: np.ndarray
    """(J,) variance of that static error [0..1]."""
    path: np.ndarray
    """(J - 1,) distance from each block to the next [half ranges]."""
    covered: np.ndarray
    """(J - 1,) whether the others cover the motion from the second block on."""


def _held_out(folds: Sequence[Sequence[Blocks]], block_s: float) -> dict[float, list[_HeldOut]]:
    """Every run of every fold, judged by the other folds, with each of `RIDGES`."""
    found: dict[float, list[_HeldOut]] = {ridge: [] for ridge in RIDGES}
    for k, fold in enumerate(folds):
        others = [run for j, other in enumerate(folds) if j != k for run in other]
        statics = StaticError.fitted(others, RIDGES)
        coverage = Coverage.of([run.position for run in others], block_s)
        for run in fold:
            covered = coverage.covers(motion(run.position))
            features = statics[0].features(run)
            for ridge, static in zip(RIDGES, statics, strict=True):
                judged = static.given(run, features)
                found[ridge].append(_HeldOut(k, *judged, run.path, covered))
    return found


def _whitened(
    parts: Sequence[_HeldOut], design: AlarmDesign, elsewhere_mm2: np.ndarray | None
) -> tuple[Whitening, list[np.ndarray], list[np.ndarray]]:
    """Statistics of a reference, and its squares and counts with the scales of the other folds.

    Blocks that the other folds do not cover are left out of the squares, as in a run.
    """
    every = np.concatenate([part.left for part in parts])
    size = every.shape[1]
    least = design.least_mm**2
    _, axes = np.linalg.eigh(every.T @ every / len(every) + least * np.eye(size))
    memory = Memory.fitted(
        [part.left @ axes for part in parts], [part.path for part in parts], design.block_s
    )
    known = np.zeros((size, size)) if elsewhere_mm2 is None else elsewhere_mm2
    elsewhere = np.einsum("ki,kl,li->i", axes, known, axes)

    def of(some: Sequence[_HeldOut]) -> Whitening:
        squares = np.concatenate([part.left @ axes for part in some]) ** 2
        number = sum(memory.worth(part.path).sum(axis=0) for part in some)
        level = np.sqrt(_upper(squares.mean(axis=0) + least, number))
        equal = Whitening(axes, level, memory, elsewhere, np.ones(size))
        return replace(equal, fast=_fast_variance(equal, some))

    squares, counts = [], []
    for part in parts:
        others = of([other for other in parts if other.fold != part.fold])
        rows, count = others.squares(part.left[1:], part.left[:-1], part.path, part.unknown[1:])
        if part.covered.any():
            squares.append(rows[part.covered])
            counts.append(count[part.covered])
    return of(parts), squares, counts


def _fast_variance(whitening: Whitening, parts: Sequence[_HeldOut]) -> np.ndarray:
    """(d,) `Whitening.fast` of the parts of a reference, for statistics without it.

    The blocks of one move are one independent value, however many they are.
    """
    size = len(whitening.level_mm)
    total, blocks, moves = np.zeros(size), np.zeros(size), np.zeros(size)
    for part in parts:
        rows, counts = whitening.squares(part.left[1:], part.left[:-1], part.path, part.unknown[1:])
        fast = (counts[:, 2 * size :] > 0) & part.covered[:, None]
        total += np.where(fast, rows[:, 2 * size :], 0.0).sum(axis=0)
        blocks += fast.sum(axis=0)
        moves += fast[:1].sum(axis=0) + (fast[1:] & ~fast[:-1]).sum(axis=0)
    bound = _upper(total / np.maximum(blocks, 1), moves)
    return np.where(moves >= VISITS, np.maximum(bound, 1.0), np.inf)


def repeated_share(
    schedule: Sequence[tuple[np.ndarray, np.ndarray]],
    span: np.ndarray,
    design: AlarmDesign | None = None,
) -> float:
    """Share of a reference whose motions its other parts cover, by what will be commanded [-].

    schedule: times (T,) [s] and actuation (T, m) [unit] of each run; span: (m,) range of the
    actuation [unit]. What is measured follows with lags and noise, so that its share is about that.
    1 where there is less than two folds to compare.
    """
    design = design or AlarmDesign()
    half_range = np.asarray(span, np.float64) / 2.0
    stretches = [Stretch(t_s, np.zeros((len(t_s), 1, 3)), u) for t_s, u in schedule]
    runs = [blocks_of(stretch, half_range, design.block_s) for stretch in stretches]
    runs = [run for run in runs if len(run.position) > 1]
    folds = _folds(runs) if runs else []
    if len(folds) < 2:
        return 1.0
    covered = []
    for k, fold in enumerate(folds):
        others = [run.position for j, other in enumerate(folds) if j != k for run in other]
        coverage = Coverage.of(others, design.block_s)
        covered += [coverage.covers(motion(run.position)) for run in fold]
    return float(np.concatenate(covered).mean())


def _folds(runs: Sequence[Blocks]) -> list[list[Blocks]]:
    """The folds of a reference: its runs, or parts of them where they are few."""
    return [[run] for run in runs] if len(runs) >= FOLDS else _fifths(runs)


def _fifths(runs: Sequence[Blocks]) -> list[list[Blocks]]:
    """Five folds of consecutive blocks of a few runs, one run after another.

    Runs often repeat one motion, whose same part is in other folds then and judges it.
    """
    folds: list[list[Blocks]] = [[] for _ in range(FOLDS)]
    of_run = np.repeat(np.arange(len(runs)), [len(run.position) for run in runs])
    of_block = np.concatenate([np.arange(len(run.position)) for run in runs])
    for k, rows in enumerate(np.array_split(np.arange(len(of_run)), FOLDS)):
        for number in np.unique(of_run[rows]):
            part = of_block[rows[of_run[rows] == number]]
            if len(part) > 1:
                folds[k].append(runs[number].part(part))
    return [fold for fold in folds if fold]


def _enlargement(squares: list[np.ndarray], counts: list[np.ndarray], design: AlarmDesign) -> float:
    """Smallest tried factor on the scale with few enough alarms on the resampled reference."""
    if not squares:
        return 1.0
    accepted = max(1.0, design.resample_h / design.false_alarm_h)
    rows = resampled([len(each) for each in squares], design)
    drawn, number = np.concatenate(squares)[rows], np.concatenate(counts)[rows]
    h = threshold(design, drawn.shape[-1] // CHARTS)
    factor = 1.0
    while factor < LARGEST_SCALE:
        if alarms_in(increments(drawn / factor**2, number, design, h), h) <= accepted:
            return factor
        factor *= ENLARGE
    raise InputError(
        "the clean reference shows no stable error of the model: its parts differ by more than "
        f"{LARGEST_SCALE:g} times; record a longer reference, or fit the model again"
    )


def resampled(lengths: Sequence[int], design: AlarmDesign) -> np.ndarray:
    """(S, G) rows of a reference in G chains of S blocks: random stretches of its runs, joined.

    lengths: blocks of each run.
    """
    rng = np.random.default_rng(0)
    stretch = max(1, round(design.resample_s / design.block_s))
    total = round(design.resample_h * 3600.0 / design.block_s)
    begins = np.cumsum([0, *lengths[:-1]])
    starts = np.concatenate(
        [
            begin + np.arange(max(1, length - stretch + 1))
            for begin, length in zip(begins, lengths, strict=True)
        ]
    )
    joined = max(2, round(0.1 * 3600.0 / design.resample_s))
    chains = max(1, total // (joined * stretch))
    first = rng.choice(starts, (joined, chains))
    rows = np.minimum(first[:, None] + np.arange(stretch)[None, :, None], sum(lengths) - 1)
    return rows.reshape(joined * stretch, chains)


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
    """The model is no longer valid."""

    at_s: float
    """Time of the sample after which the alarm was raised [s]."""
    since_s: float
    """Estimated time of the change: the median of the times until which the charts that have risen
    to half the threshold were at zero [s]."""
    chart: str
    """`level`, of an error that lasts, `innovation`, of one that came fast, `fast moves`, of one
    that comes with each of them, or `sudden`, of one that is large at once."""
    before_mm: float
    """RMS distance of the key points from the model in the reference [mm]."""
    after_mm: float
    """RMS distance since the estimated time of the change [mm]."""

    @property
    def sentence(self) -> str:
        """The alarm in words."""
        return (
            f"the model has not been valid since {self.since_s:.1f} s; this was detected at "
            f"{self.at_s:.1f} s ({self.at_s - self.since_s:.1f} s later): error "
            f"{self.before_mm:.3f} mm in the reference, {self.after_mm:.3f} mm since"
        )


@dataclass(eq=False)
class Charts:
    """The charts of a detector along a run, sample by sample."""

    detector: Detector
    """The detector."""
    statistic: float = 0.0
    """Largest chart over its threshold: 1 raises the alarm [-]."""
    alarm: Alarm | None = None
    """The alarm that is standing, None where the model holds."""
    alarms: list[Alarm] = field(default_factory=list)
    """All alarms so far."""
    judged: int = 0
    """Blocks that the charts have taken."""
    left_out: int = 0
    """Blocks whose motion, or most of the motion before them, is not in the reference."""
    _charts: np.ndarray | None = None
    _recent_charts: deque[np.ndarray] = field(default_factory=deque)
    _covered: deque[bool] = field(default_factory=deque)
    _sizes: deque[tuple[float, float]] = field(default_factory=deque)
    _zero_s: np.ndarray | None = None
    _mean: np.ndarray | None = None
    _before: np.ndarray | None = None
    _position: np.ndarray | None = None
    _direction: np.ndarray | None = None
    _rows: list[np.ndarray] = field(default_factory=list)
    _actuations: list[np.ndarray] = field(default_factory=list)
    _begin_s: float | None = None
    _recent: list[tuple[float, float]] = field(default_factory=list)

    def __post_init__(self):
        block_s = self.detector.design.block_s
        self._recent_charts = deque(maxlen=round(MOVE_S / block_s))
        self._covered = deque(maxlen=round(RECENT_S / block_s))
        self._sizes = deque(maxlen=round(SUDDEN_S / block_s))

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
        self._sizes.clear()
        self._before = self._position = self._direction = self._begin_s = None

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
        before, last_position = self._before, self._position
        position = self._position = actuations.mean(axis=0) / detector.half_range
        change = np.zeros_like(position) if last_position is None else position - last_position
        if self._direction is None:
            self._direction = np.zeros_like(position)
        self._direction = turned(self._direction, change)
        block = Blocks(*(each[None] for each in (self._mean, position, self._direction)))
        (now,), unknown = detector.static.given(block)
        self._before = now
        if before is None or last_position is None:
            return None
        moved = np.concatenate([position, change])
        covered = bool(detector.coverage.covers(moved))
        self._covered.append(covered)
        if not (detector.judges and covered and np.mean(self._covered) >= LEAST_RECENT):
            self.left_out += 1
            self._sizes.clear()
            return None
        self.judged += 1
        squares, counts = detector.whitening.squares(
            now, before, np.asarray(np.linalg.norm(change)), unknown[0]
        )
        steps = detector.increments(squares, counts)
        if self._charts is None or self._zero_s is None:
            self._charts = np.zeros_like(steps)
            self._recent_charts.append(self._charts)
            self._zero_s = np.full_like(steps, t_s - detector.design.block_s)
        h = detector.threshold
        self._charts = np.clip(self._charts + steps, 0.0, HIGHEST * h)
        self._charts = np.minimum(self._charts, np.min(self._recent_charts, axis=0) + MOST_MOVE * h)
        self._recent_charts.append(self._charts)
        self._zero_s[self._charts == 0.0] = t_s
        self._sizes.append((float(detector.size(squares)), float(sizes(counts))))
        self.statistic = max(float(self._charts.max() / h), self._sudden())
        if self.alarm is None and self.statistic > 1.0:
            return self._raise(t_s)
        if self.alarm is not None and self.statistic < OVER:
            self.alarm = None
        if self.alarm is None:
            self._recent = self._recent[-round(120.0 / detector.design.block_s) :]
        return None

    def _sudden(self) -> float:
        """Least size of the last blocks over its limit, 0 while they are too few or the arm hardly
        moved."""
        if len(self._sizes) < (self._sizes.maxlen or 0):
            return 0.0
        if sum(worth for _, worth in self._sizes) < SUDDEN_WORTH:
            return 0.0
        least = min(size for size, _ in self._sizes)
        return min(least / self.detector.sudden_limit, HIGHEST)

    def _raise(self, t_s: float) -> Alarm:
        assert self._charts is not None
        assert self._zero_s is not None
        kinds = ("level", "innovation", "fast moves")
        chart = int(self._charts.argmax())
        h = self.detector.threshold
        sudden = self._charts.max() <= h
        # One chart may have risen before the change; the most that have risen did so with it.
        risen = self._charts >= min(RISEN * h, self._charts.max())
        since_s = float(np.quantile(self._zero_s[risen], 0.5, method="lower"))
        if sudden:
            since_s = min(since_s, t_s - SUDDEN_S)
        squares = [square for at_s, square in self._recent if at_s > since_s]
        after = float(np.sqrt(np.mean(squares))) if squares else float("nan")
        name = "sudden" if sudden else kinds[chart * CHARTS // len(self._charts)]
        self.alarm = Alarm(t_s, since_s, name, self.detector.reference_mm, after)
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
