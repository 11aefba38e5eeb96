"""A chamber whose sensor is dead: is the body moved as if the chamber were driven?

With the other chambers known, one number a row, the missing pressure, has to explain all key
points of the row. The prediction is computed for levels of the missing pressure, and each row takes
the level (by parabola between levels) that fits it best, in turn with the frame (alternating least
squares). One more fault of the set-up is looked for beside it.
"""

import itertools
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from surgisoft.diagnosis.setup.alignment import (
    HANDED,
    Frame,
    Moments,
    block_moments,
    fitted,
    moments,
    unturned,
)
from surgisoft.diagnosis.setup.arrangements import EXHAUSTIVE
from surgisoft.diagnosis.setup.sample import Arrangement, Sample
from surgisoft.diagnosis.setup.search import LENGTHS, Fitted, Hypothesis, Search
from surgisoft.diagnosis.setup.words import SetupFault, faults_of

LEVELS = 9
"""Levels of the missing pressure, over the range of the model."""
COARSE_LEVELS = 5
"""Levels of the first look at every hypothesis."""
ROUNDS = 8
"""Alternations of levels and frame."""
LEAST_SWING = 0.1
"""Least range that the missing pressure must have gone through, as a share of the model's."""
START_ROWS = 120
"""Rows of the first look."""
STARTS = 5
"""Hypotheses that are fitted on all rows of the coarse sample."""


@dataclass(frozen=True, eq=False)
class Blind:
    """A dead channel that the body shows to have been driven."""

    channel: int
    """Recorded channel, from 0."""
    range: tuple[float, float]
    """5 % and 95 % quantile of the pressure that the body shows, in the model's unit."""
    unit: str
    """The model's unit."""
    rmse_mm: float
    """RMS error with that pressure, corrected for one number a row, mm."""
    hypothesis: Hypothesis
    """What is wrong besides."""
    frame: Frame
    """The frame of the key points."""
    blocks: Moments
    """(B,) sums over each block of time."""

    def further(self, unit: str, mistake: tuple[str, str]) -> list[SetupFault]:
        """The faults beside the dead channel, as `faults_of` words them."""
        losses = np.zeros(len(self.blocks.count))
        late = 0.5 * TIME_STEP_S
        given = Fitted(self.hypothesis, self.frame, self.blocks, losses, self.rmse_mm, late)
        return faults_of(given, self.frame, unit, mistake)


@dataclass(frozen=True, eq=False)
class _Tried:
    """A hypothesis beside the dead channel, with the frame that it starts from or has reached."""

    hypothesis: Hypothesis
    frame: Frame
    error_mm: float = np.inf
    share: np.ndarray | None = None

    @property
    def cost(self) -> float:
        """Error, made larger for a hypothesis with a fault."""
        return self.error_mm * PENALTY ** len(self.hypothesis.kinds)


PENALTY = 1.3
"""Factor by which a further fault must lower the error."""
TIME_STEP_S = 0.05
"""Resolution of an offset in time beside a dead channel, s."""


def blind_channel(search: Search, channel: int) -> Blind | None:
    """The dead channel's missing pressure, where it explains the error; None where it does not."""
    sample, spec = search.coarse, search.coarse.model.spec
    look = _Look(search, channel, COARSE_LEVELS)
    rows = np.flatnonzero(sample.block >= 0)
    few = rows[:: max(1, len(rows) // START_ROWS)]
    first = [look.fit(each, 3, few) for each in _hypotheses(search, channel)]
    first.sort(key=lambda tried: tried.cost)
    look = _Look(search, channel, LEVELS)
    found = [look.fit(each, ROUNDS, rows) for each in _distinct(first)]
    best = min((look.settled(each, rows) for each in found), key=lambda tried: tried.cost)
    chamber = best.hypothesis.arrangement.order.index(channel)
    low, high = spec.low[chamber], spec.high[chamber]
    assert best.share is not None, "what was fitted has the missing pressure"
    swing = low + np.quantile(best.share, [0.05, 0.95]) * (high - low)
    before = search.start.rmse_mm * max(1.0, best.hypothesis.mm_per_unit)
    asked, after = search.proof, best.error_mm
    motion = float(np.sqrt(np.mean(search.motion(best.hypothesis.arrangement) ** 2)))
    most = max(asked.near_validated * search.levels.reference, asked.left_of_motion * motion)
    driven = swing[1] - swing[0] >= LEAST_SWING * spec.span[chamber]
    if not search.explains(before, after) or after > most or not driven:
        return None
    x, there = look.measured(best.hypothesis)[rows], look.there(best, rows)
    blocks = block_moments(x, there, sample.block[rows], sample.blocks)
    ends = (float(swing[0]), float(swing[1]))
    return Blind(channel, ends, spec.unit, after, best.hypothesis, best.frame, blocks)


def _distinct(tried: list[_Tried]) -> list[_Tried]:
    """The most promising hypotheses, and in any case that of no further fault."""
    plain = next(each for each in tried if not each.hypothesis.kinds)
    return [plain, *(each for each in tried[:STARTS] if each is not plain)]


def _hypotheses(search: Search, channel: int) -> list[_Tried]:
    """No further fault, and each single one."""
    count = search.coarse.points[0].shape[1]
    same, chambers = tuple(range(count)), search.chambers
    plain = Arrangement.as_recorded(chambers)
    nothing = Hypothesis(plain, same, frame="none")
    as_it_is = Frame(np.eye(3), np.zeros(3), 1.0)
    found = [_Tried(nothing, as_it_is)]
    if count > 1:
        found.append(_Tried(replace(nothing, points=same[::-1]), as_it_is))
    for mm in LENGTHS[1:]:
        found.append(_Tried(replace(nothing, mm_per_unit=mm), replace(as_it_is, scale=1.0 / mm)))
    for factor in search.factors[1:]:
        scaled = replace(nothing, arrangement=replace(plain, factor=factor))
        if not search.conversions(scaled):
            found.append(_Tried(scaled, as_it_is))
    if chambers <= EXHAUSTIVE:
        orders = list(itertools.permutations(range(chambers)))
    else:
        orders = [_swapped(chambers, a, b) for a in range(chambers) for b in range(a)]
    for order in (plain.order, *orders):
        for signs in itertools.product(
            (1.0, -1.0), repeat=chambers if chambers <= EXHAUSTIVE else 0
        ):
            signs = signs or (1.0,) * chambers
            if signs[order.index(channel)] == 1.0:
                some = Arrangement(tuple(order), tuple(signs))
                found.append(_Tried(replace(nothing, arrangement=some), as_it_is))
    turns = Rotation.from_euler("z", np.arange(12)[:, None] * np.pi / 6).as_matrix()
    turns = np.concatenate([turns, Rotation.create_group("O").as_matrix()])
    kinds: tuple[Literal["proper", "improper"], ...] = ("proper", "improper")
    for name in kinds:
        for turn in turns @ np.diag([1.0, HANDED[name], 1.0]):
            found.append(_Tried(replace(nothing, frame=name), Frame(turn, np.zeros(3), 1.0)))
    if search.coarse.timed:
        for late in search.settings.times_s:
            for later in (late, -late):
                found.append(_Tried(replace(nothing, later_s=later), as_it_is))
    return found


def _swapped(count: int, a: int, b: int) -> tuple[int, ...]:
    order = list(range(count))
    order[a], order[b] = order[b], order[a]
    return tuple(order)


class _Look:
    """Predictions of the coarse sample for levels of the missing pressure."""

    def __init__(self, search: Search, channel: int, levels: int):
        self.search, self.channel, self.levels = search, channel, levels
        self._known: dict[Arrangement, np.ndarray] = {}
        self._seen: dict[float, np.ndarray] = {}

    def measured(self, hypothesis: Hypothesis) -> np.ndarray:
        """(S, n, 3) key points as recorded, at the time and in the order of a hypothesis."""
        later = hypothesis.later_s
        if later not in self._seen:
            self._seen[later] = self.search.coarse.measured([later])[0]
        return self._seen[later][:, list(hypothesis.points)]

    def predicted(self, arrangement: Arrangement) -> np.ndarray:
        """(L, S, n, 3) predictions, mm."""
        if arrangement not in self._known:
            spec = self.search.coarse.model.spec
            chamber = arrangement.order.index(self.channel)
            gain = float(arrangement.gain[chamber])
            levels = np.linspace(spec.low[chamber], spec.high[chamber], self.levels) / gain
            sample = self.search.coarse
            self._known[arrangement] = np.stack(
                [_held(sample, self.channel, level).predicted([arrangement])[0] for level in levels]
            )
        return self._known[arrangement]

    def there(self, tried: _Tried, rows: np.ndarray) -> np.ndarray:
        """(K, n, 3) prediction with the missing pressure that was found, mm."""
        assert tried.share is not None, "what was fitted has the missing pressure"
        return _between(self.predicted(tried.hypothesis.arrangement)[:, rows], tried.share)

    def fit(self, tried: _Tried, rounds: int, rows: np.ndarray) -> _Tried:
        """The hypothesis with its frame and the missing pressure fitted to some rows."""
        hypothesis = tried.hypothesis
        x = self.measured(hypothesis)[rows]
        predicted = self.predicted(hypothesis.arrangement)[:, rows]
        error, frame, share = _alternate(x, predicted, hypothesis.frame, tried.frame, rounds)
        if hypothesis.frame == "proper" and self.search.border.holds(frame):
            hypothesis = replace(hypothesis, frame="small")
        return _Tried(hypothesis, frame, error, share)

    def settled(self, tried: _Tried, rows: np.ndarray) -> _Tried:
        """The hypothesis with its offset in time, if any, refined."""
        late = tried.hypothesis.later_s
        if not late:
            return tried
        near = late + TIME_STEP_S * np.arange(-5, 6)
        each = [replace(tried, hypothesis=replace(tried.hypothesis, later_s=t)) for t in near if t]
        return min((self.fit(one, 0, rows) for one in each), key=lambda one: one.error_mm)


def _held(sample: Sample, channel: int, level: float) -> Sample:
    """The sample with one recorded channel held at one level."""
    pressure = sample.history.pressure.clone()
    pressure[..., channel] = level
    stood = sample.history.stood
    if stood is not None:
        stood = stood.clone()
        stood[..., channel] = level
    return replace(sample, history=replace(sample.history, pressure=pressure, stood=stood))


def _alternate(
    x: np.ndarray, predicted: np.ndarray, name: str, frame: Frame, rounds: int
) -> tuple[float, Frame, np.ndarray]:
    """RMS error, mm, frame and share (S,) of the range of the missing pressure, in turn."""
    share = _shares(x, predicted, frame)
    for _ in range(rounds if name in HANDED else 0):
        sums = moments(x[None], _between(predicted, share)[None])[0, 0]
        frame = fitted(sums, HANDED[name], np.asarray(frame.scale))
        share = _shares(x, predicted, frame)
    sums = moments(x[None], _between(predicted, share)[None])[0, 0]
    if name == "none":
        frame = unturned(sums, frame.scale)
    seen = np.isfinite(x).all(2).sum(1)
    freedom = 3 * seen.sum() / max(3 * seen.sum() - (seen > 0).sum(), 1)
    return float(np.sqrt(sums.mean_square(frame) * freedom)), frame, share


def _shares(x: np.ndarray, predicted: np.ndarray, frame: Frame) -> np.ndarray:
    """(S,) where between the first level (0) and the last (1) each row's error is least."""
    true = ((x - frame.shift) / frame.scale) @ frame.rotation
    apart = np.nan_to_num(np.square(true[None] - predicted)).sum((2, 3))
    last = len(apart) - 1
    at = np.clip(apart.argmin(0), 1, last - 1)
    rows = np.arange(apart.shape[1])
    low, middle, high = (apart[at + k, rows] for k in (-1, 0, 1))
    curve = low - 2 * middle + high
    move = np.where(curve > 0, 0.5 * (low - high) / np.where(curve > 0, curve, 1.0), 0.0)
    return np.clip(at + np.clip(move, -1.0, 1.0), 0, last) / last


def _between(predicted: np.ndarray, share: np.ndarray) -> np.ndarray:
    """(S, n, 3) prediction at a share (S,) of the levels (L, S, n, 3), on lines between levels."""
    place = share * (len(predicted) - 1)
    low = np.minimum(place.astype(int), len(predicted) - 2)
    part = (place - low)[:, None, None]
    rows = np.arange(predicted.shape[1])
    return (1 - part) * predicted[low, rows] + part * predicted[low + 1, rows]
