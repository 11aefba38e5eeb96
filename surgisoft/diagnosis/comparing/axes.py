"""The axes that an error is laid out on, and how much of it each of them explains.

An axis has columns to sort the rows by, and a design: functions of it, alone and times the
actuation, from which a regression may predict the residual. What it explains is judged on blocks
of time that took no part. Static axes (what the arm's posture says) are judged alone, axes of
memory and context by what they explain beyond the actuation. Shares overlap: they do not add up.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from surgisoft.diagnosis.bootstrap import block_bootstrap, block_sums, blocks, folds
from surgisoft.diagnosis.comparing.features import TIMES_S
from surgisoft.diagnosis.race.ridge import cross_validate
from surgisoft.diagnosis.residuals import Residuals

LAG_S = 0.5
"""Low pass whose distance from the actuation is the axis `lag`, s; one of `TIMES_S`."""
PAST_S = 15.0
"""The same for the axis `past actuation`, s."""
WAYS = (0.05, 0.2, 0.6)
"""Ways after a reversal on which its trace may die out, shares of a chamber's range."""
DWELLS_S = (1.0, 4.0, 16.0)
"""Times of rest on which a trace may die out, s."""
LEAST_SIDE = 0.1
"""Least lateral part of the weight for which the bending plane has an angle to it."""
MOST_ROWS = 6_000
"""Rows that shares are computed from; more are thinned evenly."""


@dataclass(frozen=True)
class Axis:
    """One thing that the error may depend on."""

    about: str
    """What it is, in a few words."""
    unit: str
    """Unit of the columns; `{unit}` is the actuation's."""
    columns: Callable[[Residuals], np.ndarray]
    """(S, c) values: one column, or one a chamber; NaN where not known."""
    design: Callable[[Residuals], np.ndarray]
    """(S, F) functions of the axis, of order 1, that a residual in the base frame may follow."""
    static: bool = False
    """Whether posture alone fixes it: its share is not counted beyond the actuation's."""
    timed: bool = False
    """Whether it needs rows that follow each other in time."""


def _column(values: np.ndarray) -> np.ndarray:
    return values[:, None]


def _powers(values: np.ndarray, degree: int) -> np.ndarray:
    """(S, c * degree) powers of the columns (S, c), each scaled to [-1, 1]; NaN becomes 0."""
    low, high = np.nanmin(values, axis=0), np.nanmax(values, axis=0)
    x = 2 * (values - low) / np.where(high > low, high - low, 1.0) - 1
    x = np.nan_to_num(x)
    return np.concatenate([x**k for k in range(1, degree + 1)], axis=1)


def _with(rest: Residuals, values: np.ndarray, *more: np.ndarray) -> np.ndarray:
    """(S, F) functions (S, f) alone and times each column of the actuation, and of `more`."""
    gates = np.concatenate([rest.scaled_pressure, *more], axis=1)
    products = (values[:, :, None] * gates[:, None, :]).reshape(len(values), -1)
    return np.concatenate([values, products], axis=1)


def polynomial(x: np.ndarray, degree: int = 3) -> np.ndarray:
    """(S, F) products of up to `degree` of the columns (S, m); degree 2 from five columns on."""
    degree = degree if x.shape[1] < 5 else min(degree, 2)
    return np.stack(
        [
            np.prod(x[:, list(picked)], axis=1)
            for power in range(1, degree + 1)
            for picked in itertools.combinations_with_replacement(range(x.shape[1]), power)
        ],
        axis=1,
    )


def lag(rest: Residuals, time_s: float = LAG_S) -> np.ndarray:
    """(S, m) actuation less its low pass of one of `TIMES_S`, arm's unit."""
    return rest.pressure - rest.memory.low_pass[..., TIMES_S.index(time_s)]


def _lags(rest: Residuals, times_s: list[float]) -> np.ndarray:
    half = np.array(rest.spec.span) / 2
    return _with(rest, np.concatenate([lag(rest, time) / half for time in times_s], axis=1))


def azimuth(rest: Residuals) -> np.ndarray:
    """(S,) side that the predicted body bends to, from x towards y, degrees."""
    x, y = rest.bending_mm.T
    return np.degrees(np.arctan2(y, x))


def gravity_angle(rest: Residuals) -> np.ndarray:
    """(S,) angle of the bending plane to the weight's lateral part, degrees, -180 to 180.

    NaN where the weight is not known or pulls along the arm at rest.
    """
    side = np.linalg.norm(rest.gravity[:, :2], axis=1)
    down = np.degrees(np.arctan2(rest.gravity[:, 1], rest.gravity[:, 0]))
    angle = (azimuth(rest) - down + 180) % 360 - 180
    return np.where(side >= LEAST_SIDE, angle, np.nan)


def _around(degrees: np.ndarray) -> np.ndarray:
    """(S, 4) sine and cosine of an angle (S,) and of its double; NaN becomes 0."""
    turn = np.radians(degrees)
    waves = [wave(k * turn) for k in (1, 2) for wave in (np.sin, np.cos)]
    return np.nan_to_num(np.stack(waves, axis=1))


def _since_reversal(rest: Residuals) -> np.ndarray:
    way = rest.memory.since_reversal / np.array(rest.spec.span)
    parts = [rest.direction * np.exp(-way / width) for width in WAYS]
    return np.concatenate([rest.direction, *parts], axis=1)


def _dwell(rest: Residuals) -> np.ndarray:
    """Grows with the time at rest, differently after a rise and after a fall."""
    grown = np.stack([-np.expm1(-rest.memory.dwell_s / time) for time in DWELLS_S], axis=1)
    return _with(rest, grown, rest.direction)


def _rate(rest: Residuals) -> np.ndarray:
    scale = rest.memory.rate.std(axis=0)
    rate = rest.memory.rate / np.where(scale > 0, scale, 1.0)
    return _with(rest, np.concatenate([rate, np.tanh(rate), np.abs(np.tanh(rate))], axis=1))


def _elapsed(rest: Residuals) -> np.ndarray:
    time = np.stack([rest.memory.elapsed_s, rest.memory.in_run_s], axis=1)
    return _with(rest, np.concatenate([_powers(time, 2), _powers(np.log1p(time), 1)], axis=1))


AXES: dict[str, Axis] = {
    "pressure": Axis(
        "actuation itself",
        "{unit}",
        lambda rest: rest.pressure,
        lambda rest: polynomial(rest.scaled_pressure),
        static=True,
    ),
    "direction": Axis(
        "whether a chamber last rose (+1) or fell (-1)",
        "",
        lambda rest: rest.direction,
        lambda rest: _with(rest, rest.direction),
    ),
    "since reversal": Axis(
        "way of a chamber since it last reversed",
        "{unit}",
        lambda rest: rest.memory.since_reversal,
        lambda rest: _with(rest, _since_reversal(rest)),
    ),
    "rate": Axis(
        "rate of change of a chamber",
        "{unit}/s",
        lambda rest: rest.memory.rate,
        _rate,
        timed=True,
    ),
    "lag": Axis(
        f"actuation less its low pass of {LAG_S:g} s",
        "{unit}",
        lag,
        lambda rest: _lags(rest, [time for time in TIMES_S if time <= LAG_S]),
        timed=True,
    ),
    "past actuation": Axis(
        f"actuation less its mean over the past, {PAST_S:g} s and longer",
        "{unit}",
        lambda rest: lag(rest, PAST_S),
        lambda rest: _lags(rest, [time for time in TIMES_S if time >= PAST_S]),
        timed=True,
    ),
    "dwell": Axis(
        "time since any chamber moved",
        "s",
        lambda rest: _column(rest.memory.dwell_s),
        _dwell,
        timed=True,
    ),
    "elapsed time": Axis(
        "time since the start of the recording",
        "s",
        lambda rest: _column(rest.memory.elapsed_s),
        _elapsed,
    ),
    "largest so far": Axis(
        "largest actuation of a chamber so far in its run",
        "{unit}",
        lambda rest: rest.memory.largest,
        lambda rest: _with(rest, _powers(rest.memory.largest, 2)),
    ),
    "azimuth": Axis(
        "side that the body bends to, from x towards y",
        "deg",
        lambda rest: _column(azimuth(rest)),
        lambda rest: _around(azimuth(rest)),
        static=True,
    ),
    "gravity": Axis(
        "angle of the bending plane to the weight",
        "deg",
        lambda rest: _column(gravity_angle(rest)),
        lambda rest: _around(gravity_angle(rest)),
        static=True,
    ),
    "temperature": Axis(
        "temperature",
        "degC",
        lambda rest: _column(rest.temp_C),
        lambda rest: _with(rest, _powers(_column(rest.temp_C), 1)),
    ),
    "payload": Axis(
        "mass attached to the arm",
        "g",
        lambda rest: _column(rest.payload_g),
        lambda rest: _with(rest, _powers(_column(rest.payload_g), 1)),
    ),
}
"""Every axis over rows by name. Arc length runs over the key points: `arc_length`."""


def known(rest: Residuals) -> dict[str, Axis]:
    """The axes that these rows have values on that differ."""
    answer = {}
    for name, axis in AXES.items():
        if axis.timed and not rest.timed.any():
            continue
        values = axis.columns(rest)
        seen = ~np.isnan(values)
        if seen.any() and any(np.ptp(column[mask]) > 1e-9 for column, mask in _pairs(values, seen)):
            answer[name] = axis
    return answer


def _pairs(values: np.ndarray, seen: np.ndarray):
    return [(c, m) for c, m in zip(values.T, seen.T, strict=True) if m.any()]


def arc_length(rest: Residuals) -> np.ndarray:
    """(n,) way along the arm at rest from its first key point's distance to the base on, mm."""
    steps = np.linalg.norm(np.diff(rest.rest_mm, axis=0), axis=1)
    return np.linalg.norm(rest.rest_mm[0]) + np.concatenate([[0.0], np.cumsum(steps)])


@dataclass(frozen=True)
class AxisShare:
    """How much of the squared error an axis explains on blocks that took no part."""

    axis: str
    """Name of the axis."""
    about: str
    """What it is."""
    unit: str
    """Unit of its values."""
    share: float
    """Share of the squared error (0..1); of memory and context beyond what actuation explains."""
    ci95: tuple[float, float]
    """95 % interval of it from a bootstrap of blocks."""
    static: bool
    """Whether it was judged alone, not beyond the actuation."""


def shares(rest: Residuals, seed: int = 0) -> list[AxisShare]:
    """The share that each known axis explains, largest first."""
    found = known(rest)
    step = max(1, -(-len(rest.run) // MOST_ROWS))
    target = rest.residual_mm.reshape(len(rest.run), -1)[::step]
    block = blocks(rest.run[::step])
    fold = folds(block, seed=seed)

    def left(design: np.ndarray) -> np.ndarray:
        """(K,) squared error of each block with a design, held out; mm^2."""
        predicted = cross_validate(design, target, fold).predicted
        return block_sums(np.nansum(np.square(target - predicted), axis=1), block)

    static = AXES["pressure"].design(rest)[::step]
    before = block_sums(np.nansum(np.square(target), axis=1), block)
    base = left(static)
    answer = []
    for name, axis in found.items():
        own = axis.design(rest)[::step]
        if axis.static:
            rows = before - (base if name == "pressure" else left(own))
        else:
            rows = np.minimum(base, before) - left(np.concatenate([static, own], axis=1))
        total = max(float(before.sum()), 1e-30)
        low, high = block_bootstrap(lambda won, all_: won / all_, (rows, before))
        share = max(0.0, float(rows.sum()) / total)
        unit = axis.unit.format(unit=rest.spec.unit)
        ci95 = (float(low), float(high))
        answer.append(AxisShare(name, axis.about, unit, share, ci95, axis.static))
    return sorted(answer, key=lambda each: -each.share)
