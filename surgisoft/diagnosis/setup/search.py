"""The search for set-up faults: every kind alone and together, judged on held-out blocks of time.

First a coarse search on few rows: every arrangement of the actuation, a grid of times, orders of
the key points and units of length, each with the best frame in closed form. Then the best of each
combination of kinds is fitted again on more rows, with the time refined, and its error is measured
on blocks of time that took no part in the fit. The combination with the fewest kinds that does as
well as any is taken, and then has to prove itself (`Proof`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from surgisoft.diagnosis.residuals import NOTICED
from surgisoft.diagnosis.setup.alignment import (
    HANDED,
    Frame,
    Moments,
    angle,
    block_moments,
    fitted,
    moments,
    shifted,
    unturned,
)
from surgisoft.diagnosis.setup.arrangements import EXHAUSTIVE, improved, proposed
from surgisoft.diagnosis.setup.sample import (
    Arrangement,
    RowPredictions,
    Sample,
    between,
    neighbours,
)
from surgisoft.measurement.recordings.clock import follows_motion, impossible, time_factors
from surgisoft.measurement.units import unit_mistakes
from surgisoft.surrogate.effects.misalignment import Misalignment
from surgisoft.surrogate.model import LEFT_OF_MOTION, ArmModel

Kind = Literal["chambers", "actuation_unit", "key_points", "length_unit", "frame", "time"]
"""Kinds of faults that one search combines, in the order in which they are told."""
KINDS: tuple[Kind, ...] = (
    "chambers",
    "actuation_unit",
    "key_points",
    "length_unit",
    "frame",
    "time",
)

LENGTH_MISTAKES = unit_mistakes("mm")
"""Millimetres in what the recording calls one, by the true unit and the one it was read as."""
LENGTHS = (1.0, *LENGTH_MISTAKES.values())
"""Millimetres in a recorded unit that are tried."""


@dataclass(frozen=True)
class SearchSettings:
    """Sizes of the search: they decide about its time, not about its result."""

    coarse_rows: int = 400
    """Rows of the coarse search."""
    fine_rows: int = 2500
    """Rows of the fits."""
    times_s: tuple[float, ...] = (0.15, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0)
    """Offsets of the clocks that are tried first, either way, s."""
    fits: int = 10
    """Combinations that are fitted."""
    starts: int = 4
    """Arrangements that are improved by swaps and flips, where not all can be tried."""


@dataclass(frozen=True)
class Proof:
    """Evidence that a correction must show before it is called a fault of the set-up.

    Most numbers were set by reasoning on what they stand for. The test of a lag, the share of
    blocks and the rule for key points were changed after failures on robots of development; the
    robots whose results are reported (142, 143) took no part in that.
    """

    explained: float = 0.9
    """Least share of the squared error above the model's validated error that the correction
    removes on held-out blocks: what a correct set-up would."""
    halved: float = 2.0
    """... or the factor by which the error has to fall where it falls to the level of `noticed`:
    the validated error is no exact measure of what a correct set-up reaches in other recordings."""
    left_of_motion: float = LEFT_OF_MOTION
    """Most error that may be left, as a share of the motion of the key points: with a correct
    set-up a model of the same arm predicts most of its motion, whatever physics is missing."""
    near_validated: float = 2.0
    """... or as a multiple of the validated error and the noise together."""
    noticed: float = NOTICED
    """Least error before the correction, as a multiple of the validated error and the noise."""
    as_good: float = 1.25
    """Corrections whose errors differ by less than this factor do equally well: the simplest of
    them is named, and those of its number of kinds are named together."""
    blocks: float = 0.9
    """Least share of the blocks of time whose error falls, of those with a noticed error that the
    correction changes."""
    changed: float = 0.05
    """Least change of a block's RMS error, as a share of it, that counts: where the wrong channel
    rests, the correction changes nothing but the fit of a small misalignment."""
    tied: float = 0.1
    """Most error that an exchange of channels may leave, as a share of that before, where the
    recordings tie channels that the fit did not: one of very many exchanges that led an
    extrapolating model back to what it knows left 0.24 to 0.32, a true one leaves the model's own
    error."""
    lag_t: float = 3.0
    """By how many standard errors, over blocks of time, the logarithm of the error must be less
    with a pure delay than with any lag, alone or behind a quarter of the delay."""
    lag_gain: float = 0.5
    """Most squared error above the validated one that a pure delay may leave, as a share of what
    the best lag without a delay leaves."""
    apart: float = 1.45
    """Factor by which another scale has to leave a larger error, where a unit was converted that
    was wrong: the ratio of the two scales of such mistakes that are nearest to each other (10, and
    6.89 of psi). A scale that is not exactly that of a mistake is a gain."""
    earliest_s: float = 0.03
    """Least offset of the clocks that is called a fault, s; or one and a half rows."""
    most_kinds: int = 3
    """Most kinds of faults that are named at once."""


LAG_SHARES = (0.0, 0.25)
"""Pure parts of the mixtures of a delay and a lag that a pure delay is compared with."""
LAG_STRETCHES = (0.7, 1.0, 1.3)
"""Time constants of their lags, in units of what is left of the delay."""
HIDDEN_LAGS_S = tuple(float(tau) for tau in np.geomspace(0.01, 1.0, 21).round(3))
"""Lags that are tried in the place of a part of an offset in time, s."""
HIDDEN_SHARES = (0.7, 0.85, 1.0)
"""Delays that are taken off the offset for such a lag, in units of its time constant."""
LAG_MARGIN = 3.0
"""Rows that take no part at the begin of each run, in units of the delay."""
MOST_EQUALS = 3
"""Most other explanations that are named."""
SETTINGS, PROOF = SearchSettings(), Proof()


@dataclass(frozen=True)
class Border:
    """Beyond what a frame is set up wrongly: the plausible range of the effect `misalignment`."""

    turn_rad: float
    """Largest turn that is a misalignment, rad."""
    shift_mm: float
    """Largest shift along an axis that is a misalignment, mm."""

    @classmethod
    def of(cls, model: ArmModel) -> "Border":
        """The border that the effect states."""
        stated = {q.name: q.high for q in Misalignment(model.facts).quantities()}
        return cls(stated["turn_rad"], stated["shift_mm"])

    def holds(self, frame: Frame) -> np.ndarray:
        """(...) whether proper frames stay within it."""
        scale = np.asarray(frame.scale)
        shift = np.abs(frame.shift).max(-1) / scale
        return (angle(frame.rotation) <= self.turn_rad) & (shift <= self.shift_mm)


@dataclass(frozen=True)
class Hypothesis:
    """One combination of set-up faults; the frame's numbers are fitted."""

    arrangement: Arrangement
    """Which channels drive the chambers, and in which unit."""
    points: tuple[int, ...]
    """(n,) recorded key point of each true one."""
    mm_per_unit: float = 1.0
    """Millimetres in a recorded unit."""
    frame: Literal["none", "small", "proper", "improper"] = "small"
    """Frame as it is; within the border of a misalignment; turned and shifted; mirrored too."""
    later_s: float = 0.0
    """By how much the key points are recorded late relative to the actuation, s."""

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """The kinds of faults that it consists of."""
        wrong = {
            "chambers": self.arrangement.rearranged,
            "actuation_unit": self.arrangement.factor != 1.0,
            "key_points": self.points != tuple(range(len(self.points))),
            "length_unit": self.mm_per_unit != 1.0,
            "frame": self.frame in HANDED,
            "time": self.later_s != 0.0,
        }
        return tuple(kind for kind in KINDS if wrong[kind])

    @property
    def what(self) -> tuple:
        """All but the time and the size of the frame: what tells two explanations apart."""
        mirrored = self.frame if self.frame in HANDED else ""
        late = self.later_s != 0.0
        return self.arrangement, self.points, self.mm_per_unit, mirrored, late


@dataclass(frozen=True, eq=False)
class Fitted:
    """A hypothesis with its numbers, and its error on held-out blocks."""

    hypothesis: Hypothesis
    """What is wrong."""
    frame: Frame
    """The frame, from all training rows."""
    blocks: Moments
    """(B,) sums over each block of time."""
    losses: np.ndarray
    """(B,) sum of squared distances on each block with the numbers of the other folds, mm^2."""
    rmse_mm: float
    """Held-out RMS error, mm."""
    later_sd_s: float = 0.0
    """Standard error of the offset in time, s."""
    hidden_lag_s: float = 0.0
    """Largest lag that does as well in the place of a part of the offset in time, s."""
    likelier_lag_s: float = 0.0
    """The lag in the place of a part of it that does clearly better; 0: none, s."""
    likelier_later_s: float = 0.0
    """The offset in time beside that lag, s."""

    @property
    def complexity(self) -> int:
        """Number of kinds of faults."""
        return len(self.hypothesis.kinds)

    def turn_and_shift_errors(self) -> tuple[float, np.ndarray]:
        """Standard errors of the frame's turn, rad, and shift (3,), mm: jackknife over blocks.

        Quenouille 1956 and Tukey 1958, with blocks of time for rows (Kunsch 1989).
        """
        used = np.flatnonzero(self.blocks.count > 0)
        total, count = self.blocks.summed(), len(used)
        if count < 2:
            return float("nan"), np.full(3, np.nan)
        sign = float(np.sign(np.linalg.det(self.frame.rotation)))
        without = fitted(
            Moments(*(t - p for t, p in zip(total._parts, self.blocks[used]._parts, strict=True))),
            sign,
            np.full(count, self.frame.scale),
        )
        apart = angle(np.einsum("bij,kj->bik", without.rotation, self.frame.rotation))
        shift = (without.shift - without.shift.mean(0)) / self.frame.scale
        by = (count - 1) / count
        return float(np.sqrt(by * np.sum(apart**2))), np.sqrt(by * np.sum(shift**2, 0))


@dataclass(frozen=True, eq=False)
class Found:
    """The faults that a search found, with what proves them."""

    best: Fitted
    """The explanation that is named."""
    as_good: tuple[Fitted, ...]
    """Other explanations with as many kinds that do as well."""


@dataclass(frozen=True)
class Levels:
    """Levels that errors are compared with, RMS distances of a key point, mm."""

    noise: float
    """Noise of the measurement."""
    discrepancy: float
    """Validated error of the model, without its noise."""
    told_noise: float = 0.0
    """The noise as it is told, see `floor_to_tell`."""

    @property
    def reference(self) -> float:
        """The error that a correct set-up shows where no physics is missing."""
        return float(np.hypot(self.noise, self.discrepancy))


class Search:
    """One search over a model and recordings of one set-up."""

    def __init__(
        self,
        coarse: Sample,
        fine: Sample,
        full: Sample,
        levels: Levels,
        mistakes: dict[tuple[str, str], float],
        settings: SearchSettings = SETTINGS,
        proof: Proof = PROOF,
        orders: bool = True,
    ):
        """mistakes: those with the unit of actuation that are tried (`unit_mistakes`); orders:
        whether the recordings can show which channel drives which chamber."""
        self.coarse, self.fine, self.full, self.levels = coarse, fine, full, levels
        self.mistakes, self.settings, self.proof = mistakes, settings, proof
        self.orders = orders
        self.factors = (1.0, *mistakes.values())
        self.border = Border.of(coarse.model)
        self.chambers = coarse.history.chambers
        self._measured = fine.measured()[0]
        self.time_factor = 1.0
        """Seconds in what the recordings call one."""
        self._predicted: dict[Arrangement, np.ndarray] = {}
        self._whole: dict[Arrangement, RowPredictions] = {}

    def in_time(self, factor: float) -> "Search":
        """The same search with times so many times as long, in the same blocks of rows."""
        coarse, fine, full = (
            each.with_time(factor) for each in (self.coarse, self.fine, self.full)
        )
        kept = self.levels, self.mistakes, self.settings, self.proof, self.orders
        other = Search(coarse, fine, full, *kept)
        other.time_factor = self.time_factor * factor
        return other

    @cached_property
    def raw(self) -> Fitted:
        """The recordings as they are."""
        return self.fit(replace(self._nothing(), frame="none"))

    @cached_property
    def start(self) -> Fitted:
        """The recordings as they are, but for a small misalignment where that helps."""
        before = self.fit(self._nothing())
        return before if before.rmse_mm < self.raw.rmse_mm else self.raw

    @property
    def limit_mm(self) -> float:
        """Error up to which no fault is looked for, mm."""
        return self.proof.noticed * self.levels.reference

    @property
    def noticed(self) -> bool:
        """Whether the error is large enough for a fault."""
        return self.raw.rmse_mm > self.limit_mm

    def explains(self, before_mm: float, after_mm: float) -> bool:
        """Whether an error before is noticed, and explained by what leaves the error after."""
        noticed = before_mm > self.limit_mm
        return noticed and self._share(before_mm, after_mm) >= self.proof.explained

    def _share(self, before_mm: float, after_mm: float) -> float:
        """Share of the squared error above the reference that falls."""
        least = min(self.levels.reference, after_mm)
        return (before_mm**2 - after_mm**2) / max(before_mm**2 - least**2, 1e-12)

    def motion(self, arrangement: Arrangement) -> np.ndarray:
        """(n,) RMS motion of the predicted key points, mm."""
        return _motion(self._fine(arrangement))

    def run(self) -> Found | None:
        """The faults, where some are proved."""
        if not self.noticed:
            return None
        start = self.start
        tried = [start, *(self.fit(each) for each in self._shortlist(start.hypothesis))]
        best = self._simplest(tried)
        while "time" in best.hypothesis.kinds and not self._pure_delay(best):
            tried = [each for each in tried if "time" not in each.hypothesis.kinds]
            best = self._simplest(tried)
        if not best.hypothesis.kinds:
            return None
        exact = best.rmse_mm <= self.proof.tied * start.rmse_mm
        if "chambers" in best.hypothesis.kinds and not (self.orders or exact):
            return None
        if not self._proved(start, best):
            return None
        others = self._equals(best, tried)
        return Found(self._with_hidden_lag(best), tuple(map(self._with_hidden_lag, others)))

    # Unit of time -----------------------------------------------------------------------------

    def likelier_clock(self) -> tuple["Search", Found | None]:
        """This search or the same with another unit of time, and the other faults found with it.

        Rows that are impossibly far apart, or near, for a moving arm are taken to be in another
        unit wherever the model does not contradict. Else the model has to prove the unit, by an
        error that nothing leaves beside the factor: a factor further in the same direction, which
        takes away the memories or lets them settle, must be clearly worse, because a memory that
        the arm has lost is physics.
        """
        step = self.row_s
        factors = time_factors(step) if self.fine.timed and step > 0.0 else []
        if factors and impossible(step) and self._follows_motion:
            for factor in factors:
                other = self.in_time(factor)
                found = other.run()
                after = found.best if found else other.start
                as_read = self.fit(replace(after.hypothesis, later_s=0.0))
                worst = self.proof.as_good * max(as_read.rmse_mm, self.levels.noise)
                if after.rmse_mm <= worst:
                    return other, found
        found = self.run()
        before = found.best if found else self.start
        if before.rmse_mm <= self.limit_mm:
            return self, found
        for factor in factors:
            other = self.in_time(factor)
            tried = [other.start, other.fit(replace(before.hypothesis, later_s=0.0))]
            after = other._simplest(tried)
            if not other._proved(before, after):
                continue
            further = self.in_time(factor**2).fit(after.hypothesis)
            if self.proof.as_good * after.rmse_mm <= further.rmse_mm:
                return other, Found(after, ()) if after.hypothesis.kinds else None
        return self, found

    @cached_property
    def _follows_motion(self) -> bool:
        """Whether the rows follow the motion of the actuation."""
        history = self.full.history
        runs = [history.pressure[k][history.valid[k]].numpy() for k in range(history.runs)]
        return follows_motion(runs)

    # Coarse search ----------------------------------------------------------------------------

    def _nothing(self) -> Hypothesis:
        points = tuple(range(self.coarse.points[0].shape[1]))
        return Hypothesis(Arrangement.as_recorded(self.chambers), points)

    def _orders(self) -> list[tuple[int, ...]]:
        """Orders of the key points to begin with: as recorded, reversed, and by their motion."""
        count = self.coarse.points[0].shape[1]
        same = tuple(range(count))
        orders = [same, same[::-1]]
        if count > 2:
            measured = _motion(self.coarse.measured()[0])
            predicted = _motion(self._predictions([Arrangement.as_recorded(self.chambers)])[0])
            by_motion = np.empty(count, int)
            by_motion[np.argsort(predicted)] = np.argsort(np.where(measured > 0, measured, np.inf))
            orders.append(tuple(by_motion.tolist()))
        return list(dict.fromkeys(orders))

    def _shortlist(self, start: Hypothesis) -> list[Hypothesis]:
        """The best hypothesis of each combination of kinds, the most promising first."""
        orders = self._orders()
        given = proposed(self.coarse, orders, self.factors)
        table = self._table(given, orders)
        if self.chambers > EXHAUSTIVE:
            for arrangement in self._improved(table, orders):
                if arrangement not in given:
                    given.append(arrangement)
                    table += self._table([arrangement], orders)
        most = self.proof.most_kinds
        best: dict[tuple, list[tuple[float, Hypothesis]]] = {}
        for square, hypothesis in sorted(table, key=lambda row: row[0]):
            kinds = hypothesis.kinds
            if len(kinds) <= most:
                some = best.setdefault(kinds, [])
                if len(some) < 3:
                    some.append((square, hypothesis))
        rows = [row for some in best.values() for row in some if row[1].kinds]
        rows.sort(key=lambda row: row[0] * 1.5 ** len(row[1].kinds))
        picked = [hypothesis for _, hypothesis in rows[: self.settings.fits]]
        simple = [row for row in rows if len(row[1].kinds) == 1]
        return list(dict.fromkeys([*picked, *(row[1] for row in simple[:3])]))

    def _predictions(self, given: Sequence[Arrangement]) -> np.ndarray:
        return self.coarse.predicted(given)

    def _table(
        self, given: Sequence[Arrangement], orders: Sequence[tuple[int, ...]]
    ) -> list[tuple[float, Hypothesis]]:
        """Mean squared error, mm^2, of the best hypotheses of each combination."""
        predicted = self._predictions(given)
        later = [0.0]
        if self.coarse.timed:
            later += [sign * t for t in self.settings.times_s for sign in (1, -1)]
        measured = self.coarse.measured(later)
        rows: list[tuple[float, Hypothesis]] = []
        for order in orders:
            sums = moments(measured[:, :, list(order)], predicted)
            for frame, mm_per_unit, square in self._frames(sums):
                for a, d in _least(square):
                    rows.append(
                        (
                            float(square[a, d]),
                            Hypothesis(given[a], order, float(mm_per_unit[a, d]), frame, later[d]),
                        )
                    )
        return rows

    def _frames(self, sums: Moments):
        """Kind of frame, unit of length (A, D) and mean squared error (A, D), mm^2."""
        enough = sums.count >= 0.5 * sums.count.max()
        for name, determinant in HANDED.items():
            free = fitted(sums, determinant)
            snapped = _snapped(np.asarray(free.scale))
            for mm_per_unit in (np.ones_like(snapped), snapped):
                frame = _rescaled(free, sums, 1.0 / mm_per_unit)
                square = np.where(enough, sums.mean_square(frame), np.inf)
                if name == "proper":
                    within = self.border.holds(frame)
                    yield "small", mm_per_unit, np.where(within, square, np.inf)
                    square = np.where(within, np.inf, square)
                    plain = sums.mean_square(unturned(sums, 1.0 / mm_per_unit))
                    yield "none", mm_per_unit, np.where(enough, plain, np.inf)
                yield name, mm_per_unit, square

    def _improved(self, table, orders) -> list[Arrangement]:
        """Arrangements that swaps and flips lead to from the best ones."""
        found: list[Arrangement] = []
        starts: dict[Arrangement, Hypothesis] = {}
        for _, hypothesis in sorted(table, key=lambda row: row[0]):
            starts.setdefault(hypothesis.arrangement, hypothesis)
            if len(starts) >= self.settings.starts:
                break
        for arrangement, hypothesis in starts.items():
            measured = self.coarse.measured([hypothesis.later_s])[:, :, list(hypothesis.points)]

            def error(given, measured=measured, hypothesis=hypothesis):
                sums = moments(measured, self._predictions(given))
                free = fitted(sums, HANDED.get(hypothesis.frame, 1.0))
                if hypothesis.frame not in HANDED:
                    free = unturned(sums)
                scale = np.full(sums.count.shape, 1.0 / hypothesis.mm_per_unit)
                return sums.mean_square(_rescaled(free, sums, scale))[:, 0]

            found += improved(arrangement, error)
        return list(dict.fromkeys(found))

    # Fits -------------------------------------------------------------------------------------

    def fit(self, hypothesis: Hypothesis) -> Fitted:
        """The hypothesis fitted to the rows of the fine sample, its offset in time refined."""
        if not hypothesis.later_s:
            return self._at(hypothesis, self._fine(hypothesis.arrangement))
        later, spread = self._time(hypothesis)
        hypothesis = replace(hypothesis, later_s=later)
        return self._at(hypothesis, self._late(self._full(hypothesis.arrangement), later), spread)

    def _fine(self, arrangement: Arrangement) -> np.ndarray:
        """(S, n, 3) prediction for the rows of the fine sample, mm."""
        if arrangement not in self._predicted:
            self._predicted[arrangement] = self.fine.predicted([arrangement])[0]
        return self._predicted[arrangement]

    def _full(self, arrangement: Arrangement) -> RowPredictions:
        """Prediction for any of all rows."""
        if arrangement not in self._whole:
            self._whole[arrangement] = self.full.along(arrangement)
        return self._whole[arrangement]

    def _late(self, predicted: Callable[[np.ndarray], np.ndarray], later_s: float) -> np.ndarray:
        """(S, n, 3) prediction, as it was `later_s` before the fine rows.

        predicted: gives the key points (K, n, 3) of any of all rows (K,). The prediction is what is
        interpolated: it has no noise that interpolation would lessen.
        """
        parts, begin = [], 0
        for at, times in zip(self.fine.at, self.full.at, strict=True):
            first, second, share = neighbours(at - later_s, times)
            parts.append((begin + first, begin + second, share))
            begin += len(times)
        first, second, share = (np.concatenate(each) for each in zip(*parts, strict=True))
        rows, place = np.unique(np.concatenate([first, second]), return_inverse=True)
        points = predicted(rows)
        return between(points[place[: len(first)]], points[place[len(first) :]], share)

    def _at(self, hypothesis: Hypothesis, predicted: np.ndarray, spread: float = 0.0) -> Fitted:
        """The hypothesis with its frame fitted, for a prediction (S, n, 3) at its time."""
        measured = self._measured[:, list(hypothesis.points)]
        blocks = block_moments(measured, predicted, self.fine.block, self.fine.blocks)
        return self._fit_blocks(hypothesis, blocks, spread)

    def _fit_blocks(self, hypothesis: Hypothesis, blocks: Moments, spread: float) -> Fitted:
        fold = self.fine.fold
        losses = np.zeros(len(fold))
        for one in np.unique(fold):
            out = fold == one
            frame = self._frame(hypothesis, blocks.summed(~out))
            part = blocks[out]
            losses[out] = part.mean_square(frame) * part.count
        count = max(float(blocks.count.sum()), 1.0)
        return Fitted(
            hypothesis=hypothesis,
            frame=self._frame(hypothesis, blocks.summed()),
            blocks=blocks,
            losses=losses,
            rmse_mm=float(np.sqrt(losses.sum() / count)),
            later_sd_s=spread,
        )

    def _frame(self, hypothesis: Hypothesis, sums: Moments) -> Frame:
        scale = 1.0 / hypothesis.mm_per_unit
        plain = unturned(sums, scale)
        if hypothesis.frame == "none":
            return plain
        frame = fitted(sums, HANDED.get(hypothesis.frame, 1.0), np.asarray(scale))
        if hypothesis.frame == "small" and not self.border.holds(frame):
            return plain
        return frame

    def _time(self, hypothesis: Hypothesis) -> tuple[float, float]:
        """The offset in time with the least error, s, and its standard error."""
        full = self._full(hypothesis.arrangement)
        measured = self._measured[:, list(hypothesis.points)]

        def errors(grid: np.ndarray) -> np.ndarray:
            late = np.stack([self._late(full, later) for later in grid])
            seen = np.isfinite(late).all((0, 2, 3))
            sums = moments(measured[None, seen], late[:, seen])
            scale = np.full(sums.count.shape, 1.0 / hypothesis.mm_per_unit)
            frame = unturned(sums, scale)
            if hypothesis.frame != "none":
                frame = fitted(sums, HANDED.get(hypothesis.frame, 1.0), scale)
            return sums.mean_square(frame)[:, 0]

        tried = np.array([0.0, *self.settings.times_s])
        near = np.sort(np.abs(tried - abs(hypothesis.later_s)))[:2]
        width = max(float(near.sum()), self.row_s)
        best = hypothesis.later_s
        while True:
            grid = best + width * np.linspace(-1.0, 1.0, 7)
            square = errors(grid)
            best = float(grid[int(square.argmin())])
            if width <= 1.5 * self.row_s:
                break
            width /= 3
        best = _lowest(grid, square)
        grid = best + max(self.row_s, 0.01) * np.array([-1.0, 0.0, 1.0])
        losses = [self._at(hypothesis, self._late(full, later)).losses for later in grid]
        return best, _jackknife(grid, np.stack(losses))

    @property
    def row_s(self) -> float:
        """Usual time between rows of the recordings, s."""
        steps = [np.diff(t) for t in self.fine.times if len(t) > 1]
        return float(np.median(np.concatenate(steps))) if steps else 0.0

    # Decision ---------------------------------------------------------------------------------

    def _simplest(self, tried: Sequence[Fitted]) -> Fitted:
        """The explanation with the fewest kinds among those that do as well as any."""
        limit = self._as_good(min(each.rmse_mm for each in tried))
        near = [each for each in tried if each.rmse_mm <= limit]

        def order(e: Fitted) -> tuple[int, int, int, float]:
            changes = e.hypothesis.arrangement.changes
            return e.complexity, changes, self.conversions(e.hypothesis), e.rmse_mm

        return min(near, key=order)

    def conversions(self, hypothesis: Hypothesis) -> int:
        """Number of quantities that were read in a wrong unit and then converted."""
        by, unit = hypothesis.arrangement.factor, self.coarse.model.spec.unit
        read = [read for (_, read), factor in self.mistakes.items() if factor == by]
        mm = hypothesis.mm_per_unit
        read_mm = [read for (_, read), factor in LENGTH_MISTAKES.items() if factor == mm]
        return sum(each != unit for each in read) + sum(each != "mm" for each in read_mm)

    def _as_good(self, least_mm: float) -> float:
        """Error up to which an explanation does as well as one that leaves `least_mm`, mm.

        What a correct set-up shows is as good, however much less a combination of several faults
        may leave: of thousands of arrangements of six chambers one fits a poor model by chance.
        """
        return max(self.proof.as_good * max(least_mm, self.levels.noise), self.levels.reference)

    def _equals(self, best: Fitted, tried: Sequence[Fitted]) -> tuple[Fitted, ...]:
        """Other explanations with as many kinds, each once, that do as well."""
        found = {best.hypothesis.what: best}
        limit = self._as_good(best.rmse_mm)
        for each in sorted(tried, key=lambda one: one.rmse_mm):
            same = each.complexity == best.complexity and each.rmse_mm <= limit
            if same and each.hypothesis.what not in found:
                found[each.hypothesis.what] = each
        return tuple(found.values())[1 : 1 + MOST_EQUALS]

    def _proved(self, before: Fitted, after: Fitted) -> bool:
        """Whether a correction shows what `Proof` asks for."""
        asked = self.proof
        # In a wrong unit of length the error before is in that unit, too: no error falls because
        # positions are divided by ten.
        start = before.rmse_mm * after.hypothesis.mm_per_unit / before.hypothesis.mm_per_unit
        enough = self._share(start, after.rmse_mm) >= asked.explained or (
            after.rmse_mm <= min(asked.noticed * self.levels.reference, start / asked.halved)
        )
        motion = float(np.sqrt(np.mean(self.motion(after.hypothesis.arrangement) ** 2)))
        most = max(asked.near_validated * self.levels.reference, asked.left_of_motion * motion)
        # A fault need not show in a block in which nothing moves.
        counted = (after.blocks.count > 0) & (before.blocks.count > 0)
        counted &= before.losses > self.limit_mm**2 * before.blocks.count
        known = after.hypothesis.mm_per_unit != 1.0 or not counted.any()
        rms = np.sqrt(np.stack([before.losses, after.losses])[:, counted])
        shown = np.abs(rms[1] - rms[0]) >= asked.changed * rms[0]
        falls = (rms[1] < rms[0])[shown]
        share = 1.0 if known else float(np.mean(falls)) if shown.any() else 0.0
        if not (enough and after.rmse_mm <= most and share >= asked.blocks):
            return False
        return self.conversions(after.hypothesis) == 0 or self._exact_scale(after)

    def _exact_scale(self, given: Fitted) -> bool:
        """Whether neither a larger nor a smaller scale explains as much as that of a mistake."""
        hypothesis, arrangement = given.hypothesis, given.hypothesis.arrangement
        others = []
        for by in (self.proof.apart, 1.0 / self.proof.apart):
            if arrangement.factor != 1.0:
                scaled = replace(arrangement, factor=by * arrangement.factor)
                others.append(replace(hypothesis, arrangement=scaled))
            if hypothesis.mm_per_unit != 1.0:
                others.append(replace(hypothesis, mm_per_unit=by * hypothesis.mm_per_unit))
        # Errors in recorded units: one in mm grows with the millimetres in a unit.
        as_recorded = given.rmse_mm / hypothesis.mm_per_unit
        return all(as_recorded < self.fit(other).rmse_mm / other.mm_per_unit for other in others)

    def _pure_delay(self, given: Fitted) -> bool:
        """Whether an offset in time is one of the clocks and no lag of the arm or its line.

        A body that moves before its actuation is no physics. One that moves late may lag: the
        prediction is passed through one or two first-order lags of the same total delay, of which a
        quarter is pure or nothing. The offset counts where the pure delay does clearly better.
        """
        late = given.hypothesis.later_s
        if abs(late) < max(self.proof.earliest_s, 1.5 * self.row_s):
            return False
        if late < 0:
            return True
        pure = self._lagging(given.hypothesis, late, late, 0.0, 1)
        used = given.blocks.count > 0
        count = given.blocks.count[used]
        floor = min(self.levels.reference**2, float(pure.sum() / count.sum())) * count.sum()
        for share in LAG_SHARES:
            mixtures = [
                self._lagging(given.hypothesis, late, share * late, (1 - share) * late * by, lags)
                for by in LAG_STRETCHES
                for lags in (1, 2)
            ]
            lagged = min(mixtures, key=np.sum)
            gain = np.log(np.maximum(lagged[used], 1e-12) / np.maximum(pure[used], 1e-12))
            if gain.mean() < self.proof.lag_t * gain.std(ddof=1) / np.sqrt(len(gain)):
                return False
            small = pure.sum() - floor <= self.proof.lag_gain * (lagged.sum() - floor)
            if share == 0.0 and not small:
                return False
        return True

    def _with_hidden_lag(self, given: Fitted) -> Fitted:
        """The explanation with the lags that do as well as a part of its offset in time.

        The offset is fitted with the lags that the model knows, so most of a lag that has changed
        since is taken for a part of it: a shorter delay behind a first-order lag leaves about the
        same error where that lag is short for the motion.
        """
        offset_s = given.hypothesis.later_s
        if not offset_s:
            return given
        margin_s = max(offset_s, 0.0)  # the first rows of an early body have a known past

        def losses(pure_s: float, tau_s: float) -> np.ndarray:
            return self._lagging(given.hypothesis, margin_s, pure_s, tau_s, 1)

        pure = losses(offset_s, 0.0)
        limit, longest = self.proof.as_good**2 * pure.sum(), 0.0
        best, least = (0.0, 0.0), pure
        for tau_s in HIDDEN_LAGS_S:
            for share in HIDDEN_SHARES:
                lagged = losses(offset_s - share * tau_s, tau_s)
                longest = tau_s if lagged.sum() <= limit else longest
                if lagged.sum() < least.sum():
                    best, least = (tau_s, share * tau_s), lagged
        if self.proof.as_good**2 * least.sum() > pure.sum() or not self._falls(pure, least):
            best = (0.0, 0.0)
        return replace(
            given, hidden_lag_s=longest, likelier_lag_s=best[0], likelier_later_s=offset_s - best[1]
        )

    def _falls(self, before: np.ndarray, after: np.ndarray) -> bool:
        """Whether losses (B,) fall significantly from block to block, mm^2."""
        used = before > 0
        if used.sum() < 2:
            return False
        gain = np.log(before[used] / np.maximum(after[used], 1e-12))
        return bool(gain.mean() >= self.proof.lag_t * gain.std(ddof=1) / np.sqrt(len(gain)))

    def _lagging(
        self, hypothesis: Hypothesis, late_s: float, pure_s: float, tau_s: float, lags: int
    ) -> np.ndarray:
        """(B,) losses of a body behind a pure delay and equal first-order lags, mm^2.

        late_s: the whole delay; rows too near to the begin of a run to know what came before them
        take no part, the same for every mixture. tau_s: time constant of the lags together.
        """
        full, parts, begin = self._full(hypothesis.arrangement).whole, [], 0
        for times in self.full.at:
            part = full[begin : begin + len(times)].astype(float)
            begin += len(times)
            step = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
            for _ in range(lags if tau_s else 0):
                lagged = _first_order(part.reshape(len(part), -1), step, tau_s / lags)
                part = lagged.reshape(part.shape)
            parts.append(part)
        late = self._late(np.concatenate(parts).__getitem__, pure_s)
        late[self._early(LAG_MARGIN * late_s)] = np.nan
        return self._at(replace(hypothesis, later_s=pure_s), late).losses

    def _early(self, margin_s: float) -> np.ndarray:
        """(S,) bool: the rows of the fine sample in the first `margin_s` of a run."""
        return np.concatenate([at - at[0] < margin_s for at in self.fine.at])


def _first_order(values: np.ndarray, step_s: float, tau_s: float) -> np.ndarray:
    """(T, c) of values (T, c), linear between rows, behind y' = (u - y) / tau from steady state.

    Exact for a signal that is linear between rows (ramp-invariant discretisation).
    """
    ratio = step_s / max(tau_s, 1e-6)
    keep = np.exp(-ratio)
    new = 1.0 - (1.0 - keep) / ratio
    old = 1.0 - keep - new
    from scipy.signal import lfilter  # a tenth of a second, which few searches need

    start = values[:1] * (1.0 - new)
    return lfilter([new, old], [1.0, -keep], values, axis=0, zi=start)[0]


def _motion(points: np.ndarray) -> np.ndarray:
    """(n,) RMS distance of each key point (S, n, 3) from its mean; 0 where it is not seen."""
    seen = np.isfinite(points).all(-1)
    count = np.maximum(seen.sum(0), 1)[:, None]
    known = np.where(seen[..., None], points, 0.0)
    away = np.where(seen[..., None], points - known.sum(0) / count, 0.0)
    return np.sqrt(np.square(away).sum((0, 2)) / count[:, 0])


def _snapped(scale: np.ndarray) -> np.ndarray:
    """(...) the tried millimetres in a unit that are nearest to 1 / scale, by ratio."""
    known = np.log(np.array(LENGTHS))
    apart = np.abs(-np.log(np.asarray(scale))[..., None] - known)
    return np.array(LENGTHS)[apart.argmin(-1)]


def _rescaled(frame: Frame, sums: Moments, scale: np.ndarray) -> Frame:
    """The frame with another scale and the shift that goes with it."""
    if not np.any(frame.shift) and np.allclose(frame.rotation, np.eye(3)):
        return Frame(frame.rotation, frame.shift, scale)
    return shifted(frame.rotation, sums, scale)


def _least(square: np.ndarray, many: int = 2) -> list[tuple[int, int]]:
    """Places (a, d) of the smallest finite values: some over all, and some at d = 0."""
    found: list[tuple[int, int]] = []
    for part in (square[:, :1], square):
        order = np.argsort(part, axis=None)[: 3 * many]
        a, d = np.unravel_index(order, part.shape)
        found += zip(a.tolist(), d.tolist(), strict=True)
    # The arrangement and the unit as recorded have a row of their own, as recorded in time too.
    found += [(0, 0), *((0, int(d)) for d in np.argsort(square[0])[:many])]
    return [at for at in dict.fromkeys(found) if np.isfinite(square[at])]


def _lowest(grid: np.ndarray, values: np.ndarray) -> float:
    """Where the parabola through the least value and its neighbours is lowest."""
    at = int(values.argmin())
    if at in (0, len(values) - 1):
        return float(grid[at])
    a, b, _ = np.polyfit(grid[at - 1 : at + 2] - grid[at], values[at - 1 : at + 2], 2)
    return float(grid[at] - b / (2 * a)) if a > 0 else float(grid[at])


def _jackknife(grid: np.ndarray, losses: np.ndarray) -> float:
    """Standard error of the lowest place of losses (K, B), by leaving out each block."""
    count = losses.shape[1]
    if count < 2:
        return float("nan")
    total = losses.sum(1)
    without = np.array([_lowest(grid, total - losses[:, b]) for b in range(count)])
    return float(np.sqrt((count - 1) / count * np.square(without - without.mean()).sum()))
