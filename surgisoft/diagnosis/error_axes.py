"""The axes that an error is laid out on, and how much of it each of them explains.

An axis has columns to sort the rows by, and a design: functions of it, alone and times the
actuation, from which a regression may predict the residual. What it explains is measured on
held-out blocks of time. Static axes (what the arm's posture says) are evaluated alone, axes of
memory and context by what they explain beyond the actuation. Shares overlap: they do not add up.
"""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from surgisoft.diagnosis.history_features import TIMES_S
from surgisoft.diagnosis.residuals import Problem, ResidualTable
from surgisoft.diagnosis.statistics import block_interval, block_sums, cross_validated_ridge
from surgisoft.units import actuation_word

LAG_S = 0.5
"""Low pass whose distance from the actuation is the axis `lag`, s; one of `TIMES_S`."""
PAST_S = 15.0
"""Low pass whose distance from the actuation is the axis `past actuation`, s; one of `TIMES_S`."""
REVERSAL_WAY_SHARES = (0.05, 0.2, 0.6)
"""Ways after a reversal on which its trace may die out, shares of a chamber's range."""
DWELL_TIMES_S = (1.0, 4.0, 16.0)
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
    columns: Callable[[ResidualTable], np.ndarray]
    """(S, c) values: one column, or one a chamber; NaN where not known."""
    design: Callable[[ResidualTable, np.ndarray], np.ndarray]
    """(R, F) functions of the axis, of order 1, that a residual in the base frame may follow, in
    some rows (R,) of a table; scaled by the values of all of its rows."""
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


def _with(
    table: ResidualTable, rows: np.ndarray, values: np.ndarray, *more: np.ndarray
) -> np.ndarray:
    """(R, F) functions (N, f) in some rows (R,), alone and times each column of the actuation, and
    of `more`."""
    gates = np.concatenate([part[rows] for part in (table.scaled_pressure, *more)], axis=1)
    values = values[rows]
    products = (values[:, :, None] * gates[:, None, :]).reshape(len(values), -1)
    return np.concatenate([values, products], axis=1)


def polynomial(x: np.ndarray, degree: int = 3) -> np.ndarray:
    """(S, F) products of up to `degree` of the columns (S, m); degree 2 from five columns on."""
    degree = degree if x.shape[1] < 5 else min(degree, 2)
    return np.stack(
        [
            np.prod(x[:, list(chosen)], axis=1)
            for power in range(1, degree + 1)
            for chosen in itertools.combinations_with_replacement(range(x.shape[1]), power)
        ],
        axis=1,
    )


def lag(table: ResidualTable, time_s: float = LAG_S) -> np.ndarray:
    """(S, m) actuation minus its low pass of one of `TIMES_S`, arm's unit."""
    return table.pressure - table.memory.low_pass[..., TIMES_S.index(time_s)]


def _lags(table: ResidualTable, rows: np.ndarray, times_s: list[float]) -> np.ndarray:
    half = np.array(table.spec.span) / 2
    return _with(table, rows, np.concatenate([lag(table, time) / half for time in times_s], axis=1))


def azimuth(table: ResidualTable) -> np.ndarray:
    """(S,) side that the predicted body bends to, from x towards y, degrees."""
    x, y = table.bending_mm.T
    return np.degrees(np.arctan2(y, x))


def gravity_angle(table: ResidualTable) -> np.ndarray:
    """(S,) angle of the bending plane to the weight's lateral part, degrees, -180 to 180.

    NaN where the weight is not known or pulls along the arm at table.
    """
    side = np.linalg.norm(table.gravity[:, :2], axis=1)
    down = np.degrees(np.arctan2(table.gravity[:, 1], table.gravity[:, 0]))
    angle = (azimuth(table) - down + 180) % 360 - 180
    return np.where(side >= LEAST_SIDE, angle, np.nan)


def _around(degrees: np.ndarray) -> np.ndarray:
    """(S, 4) sine and cosine of an angle (S,) and of its double; NaN becomes 0."""
    turn = np.radians(degrees)
    waves = [wave(k * turn) for k in (1, 2) for wave in (np.sin, np.cos)]
    return np.nan_to_num(np.stack(waves, axis=1))


def _since_reversal(table: ResidualTable) -> np.ndarray:
    way = table.memory.since_reversal / np.array(table.spec.span)
    parts = [table.memory.direction * np.exp(-way / width) for width in REVERSAL_WAY_SHARES]
    return np.concatenate([table.memory.direction, *parts], axis=1)


def _dwell(table: ResidualTable, rows: np.ndarray) -> np.ndarray:
    """Grows with the time at table, differently after a rise and after a fall."""
    grown = np.stack([-np.expm1(-table.memory.dwell_s / time) for time in DWELL_TIMES_S], axis=1)
    return _with(table, rows, grown, table.memory.direction)


def _rate(table: ResidualTable, rows: np.ndarray) -> np.ndarray:
    scale = table.memory.rate.std(axis=0)
    rate = table.memory.rate / np.where(scale > 0, scale, 1.0)
    return _with(table, rows, np.concatenate([rate, np.tanh(rate), np.abs(np.tanh(rate))], axis=1))


def _elapsed(table: ResidualTable, rows: np.ndarray) -> np.ndarray:
    time = np.stack([table.memory.elapsed_s, table.memory.in_run_s], axis=1)
    return _with(
        table, rows, np.concatenate([_powers(time, 2), _powers(np.log1p(time), 1)], axis=1)
    )


AXES: dict[str, Axis] = {
    "pressure": Axis(
        "actuation itself",
        "{unit}",
        lambda table: table.pressure,
        lambda table, rows: polynomial(table.scaled_pressure[rows]),
        static=True,
    ),
    "direction": Axis(
        "whether a chamber last rose (+1) or fell (-1)",
        "",
        lambda table: table.memory.direction,
        lambda table, rows: _with(table, rows, table.memory.direction),
    ),
    "since reversal": Axis(
        "travel of a chamber since its last reversal",
        "{unit}",
        lambda table: table.memory.since_reversal,
        lambda table, rows: _with(table, rows, _since_reversal(table)),
    ),
    "rate": Axis(
        "rate of change of a chamber",
        "{unit}/s",
        lambda table: table.memory.rate,
        _rate,
        timed=True,
    ),
    "lag": Axis(
        f"actuation minus its low pass of {LAG_S:g} s",
        "{unit}",
        lag,
        lambda table, rows: _lags(table, rows, [time for time in TIMES_S if time <= LAG_S]),
        timed=True,
    ),
    "past actuation": Axis(
        f"actuation minus its mean over the past {PAST_S:g} s and longer",
        "{unit}",
        lambda table: lag(table, PAST_S),
        lambda table, rows: _lags(table, rows, [time for time in TIMES_S if time >= PAST_S]),
        timed=True,
    ),
    "dwell": Axis(
        "time since any chamber moved",
        "s",
        lambda table: _column(table.memory.dwell_s),
        _dwell,
        timed=True,
    ),
    "elapsed time": Axis(
        "time since the start of the recording",
        "s",
        lambda table: _column(table.memory.elapsed_s),
        _elapsed,
    ),
    "largest so far": Axis(
        "largest actuation of a chamber so far in its run",
        "{unit}",
        lambda table: table.memory.largest,
        lambda table, rows: _with(table, rows, _powers(table.memory.largest, 2)),
    ),
    "azimuth": Axis(
        "side that the body bends to, from x towards y",
        "deg",
        lambda table: _column(azimuth(table)),
        lambda table, rows: _around(azimuth(table)[rows]),
        static=True,
    ),
    "gravity": Axis(
        "angle of the bending plane to the weight",
        "deg",
        lambda table: _column(gravity_angle(table)),
        lambda table, rows: _around(gravity_angle(table)[rows]),
        static=True,
    ),
    "temperature": Axis(
        "temperature",
        "degC",
        lambda table: _column(table.temp_C),
        lambda table, rows: _with(table, rows, _powers(_column(table.temp_C), 1)),
    ),
    "payload": Axis(
        "mass attached to the arm",
        "g",
        lambda table: _column(table.payload_g),
        lambda table, rows: _with(table, rows, _powers(_column(table.payload_g), 1)),
    ),
}
"""Every axis over rows by name. Arc length runs over the key points: `arc_length`."""


def known(table: ResidualTable) -> dict[str, Axis]:
    """The axes that these rows have values on that differ."""
    answer = {}
    for name, axis in AXES.items():
        if axis.timed and not table.timed.any():
            continue
        values = axis.columns(table)
        seen = ~np.isnan(values)
        if seen.any() and any(np.ptp(column[mask]) > 1e-9 for column, mask in _pairs(values, seen)):
            answer[name] = axis
    return answer


def _pairs(values: np.ndarray, seen: np.ndarray):
    return [(c, m) for c, m in zip(values.T, seen.T, strict=True) if m.any()]


def arc_length(table: ResidualTable) -> np.ndarray:
    """(n,) way along the arm at rest from its first key point's distance to the base on, mm."""
    steps = np.linalg.norm(np.diff(table.rest_mm, axis=0), axis=1)
    return np.linalg.norm(table.rest_mm[0]) + np.concatenate([[0.0], np.cumsum(steps)])


LEAST_SHARE = 0.05
"""Smallest share of the error for which an axis is named."""


@dataclass(frozen=True)
class Profile:
    """Error that one column of an axis explains, by bands of equal count of its values."""

    column: str
    """The column: the axis, with the number of the chamber where it has one."""
    rows: tuple[int, ...]
    """(B,) number of rows of each band."""
    middle: tuple[float, ...]
    """(B,) mean value of the rows of each band, in the axis's unit."""
    without_mm: tuple[float, ...]
    """(B,) RMS distance of a key point before the axis explains anything, mm: the error itself, or
    for an axis of memory or context what the actuation leaves of it."""
    left_mm: tuple[float, ...]
    """(B,) RMS distance that is left when the axis is taken into account too, mm. The share of the
    axis is the fall of the square from `without_mm` to this."""
    shift_mm: tuple[float, ...]
    """(B,) mean residual of the tip along the direction in which it follows the column, mm."""
    shift_ci95_mm: tuple[tuple[float, float], ...]
    """(B,) 95 % interval of it from a bootstrap of blocks; NaN where too few blocks are in it."""


@dataclass(frozen=True)
class AxisShare:
    """How much of the squared error an axis explains on held-out blocks."""

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
    """Whether it was evaluated alone, not beyond the actuation."""
    profiles: tuple[Profile, ...] = ()
    """Error and bias over the values of each column."""

    @property
    def in_words(self) -> str:
        """The axis as texts and charts call it."""
        return axis_in_words(self.axis, self.unit)

    @property
    def clear(self) -> bool:
        """Whether the share is large enough to be named, and surely above zero."""
        return self.share >= LEAST_SHARE and self.ci95[0] > 0


def axis_in_words(axis: str, unit: str) -> str:
    """What texts and charts call an axis, whose values have a unit: not every actuation is a
    pressure."""
    return actuation_word(unit) if axis == "pressure" else axis


def shares(problem: Problem) -> list[AxisShare]:
    """The share of the error that each known axis explains, largest first."""
    table = problem.table
    found = known(table)
    rows = np.flatnonzero(problem.block_of_row >= 0)
    rows = rows[:: max(1, -(-len(rows) // MOST_ROWS))]
    target = (table.measured_mm[rows] - table.predicted_mm[rows]).reshape(len(rows), -1)
    block = problem.block_of_row[rows]
    fold = problem.fold[block]

    def left(design: np.ndarray) -> np.ndarray:
        """(R, 3n) residual that a design leaves, held out; mm."""
        return target - cross_validated_ridge(design, target, fold).predicted

    def squared(residual: np.ndarray) -> np.ndarray:
        """(K,) squared error of each block; mm^2."""
        return block_sums(np.nansum(np.square(residual), axis=1), block)

    static = AXES["pressure"].design(table, rows)
    before = squared(target)
    beyond = left(static)
    base = squared(beyond)
    if base.sum() > before.sum():
        beyond = target
    answer = []
    for name, axis in found.items():
        own = axis.design(table, rows)
        if axis.static:
            without, rest = target, beyond if name == "pressure" else left(own)
            won = before - (base if name == "pressure" else squared(rest))
        else:
            without, rest = beyond, left(np.concatenate([static, own], axis=1))
            won = np.minimum(base, before) - squared(rest)
        total = max(float(before.sum()), 1e-30)
        low, high = block_interval(lambda part, whole: part / whole, (won, before))
        share = max(0.0, float(won.sum()) / total)
        unit = axis.unit.format(unit=table.spec.unit)
        ci95 = (float(low), float(high))
        values = axis.columns(table)[rows]
        laid_out = tuple(
            _profile(_column_title(name, values, column), values[:, column], without, rest, block)
            for column in range(values.shape[1])
            if _varies(values[:, column])
        )
        answer.append(AxisShare(name, axis.about, unit, share, ci95, axis.static, laid_out))
    return sorted(answer, key=lambda each: -each.share)


def _varies(values: np.ndarray) -> bool:
    """Whether there are two different known values (R,)."""
    seen = values[~np.isnan(values)]
    return bool(len(seen)) and bool(np.ptp(seen) > 1e-9)


def _profile(
    title: str, values: np.ndarray, without: np.ndarray, left: np.ndarray, block: np.ndarray
) -> Profile:
    """The profile of a column (R,) with the residuals (R, 3n) without and with its axis, mm."""
    band, _ = _cut(values)
    if len(np.unique(values[~np.isnan(values)])) <= BANDS:
        band = np.unique(values, return_inverse=True)[1].reshape(-1)
    tip = without[:, -3:]
    known = ~np.isnan(values) & ~np.isnan(tip).any(axis=1)
    centred = np.where(known, values - values[known].mean() if known.any() else 0.0, 0.0)
    slope = centred @ np.nan_to_num(tip)
    along = np.nan_to_num(tip) @ (slope / max(float(np.linalg.norm(slope)), 1e-30))
    numbers = np.unique(band[~np.isnan(values)])
    inside = (band[:, None] == numbers) & ~np.isnan(values)[:, None]
    held = inside & known[:, None]
    sums = block_sums(np.where(held, along[:, None], 0.0), block), block_sums(held, block)
    low, high = block_interval(_mean, sums)
    middle = [float(values[rows].mean()) for rows in inside.T]
    return Profile(
        column=title,
        rows=tuple(int(part.sum()) for part in inside.T),
        middle=tuple(middle),
        without_mm=tuple(_rms(without[rows]) for rows in inside.T),
        left_mm=tuple(_rms(left[rows]) for rows in inside.T),
        shift_mm=tuple(map(float, _mean(*(total.sum(axis=0) for total in sums)))),
        shift_ci95_mm=tuple(zip(map(float, low), map(float, high), strict=True)),
    )


def _mean(total: np.ndarray, count: np.ndarray) -> np.ndarray:
    with np.errstate(invalid="ignore", divide="ignore"):
        return total / count


def _rms(residual: np.ndarray) -> float:
    """RMS distance of a key point, mm, of residuals (R, 3n) mm; NaN where none is known."""
    square = np.square(residual.reshape(len(residual), -1, 3)).sum(-1)
    seen = square[~np.isnan(square)]
    return float(np.sqrt(seen.mean())) if len(seen) else float("nan")


def _column_title(axis: str, values: np.ndarray, column: int) -> str:
    """Title of a column (S, c): `p1`, `rate 2`, or the axis where it has one column."""
    if values.shape[1] == 1 and axis not in NAMES:
        return axis
    return NAMES.get(axis, f"{axis} ") + str(column + 1)


# Bands ---------------------------------------------------------------------------------------

BANDS = 8
"""Bands of equal count that an axis is cut into."""
NAMES = {"pressure": "p"}
"""Axes whose columns have a short name; the others are called by their own."""


@dataclass(frozen=True)
class Band:
    """The error in one band of one column of an axis."""

    axis: str
    """What the rows were sorted by: an axis, with the number of the chamber where it has one."""
    label: str
    """The band's bounds with unit."""
    rmse_mm: float
    """RMS distance over all key points, mm."""
    samples: int
    """Number of rows."""
    low: float
    """Lower bound in the axis's unit."""
    high: float
    """Upper bound in the axis's unit."""
    rmse_ci95_mm: tuple[float, float]
    """95 % interval of `rmse_mm`; NaN where too few blocks of time fall into the band."""
    bias_mm: tuple[float, float, float]
    """Mean of measured less predicted: along the body, in its bending plane, out of it, mm."""
    bias_ci95_mm: tuple[tuple[float, float], ...]
    """95 % interval of each of the three, mm."""


def bands(problem: Problem) -> list[Band]:
    """Bands of every known axis, each column of it, and of the arc length."""
    table, block = problem.table, problem.block_of_row
    square = np.square(table.error_mm)
    answer: list[Band] = []
    for name, axis in known(table).items():
        values = axis.columns(table)
        for column in range(values.shape[1]):
            answer += _column_bands(table, square, block, name, axis, values, column)
    return answer + list(_along_the_arm(table, square, block))


def _column_bands(table, square, block, name, axis: Axis, values, column) -> Iterator[Band]:
    title = _column_title(name, values, column)
    own = values[:, column]
    if name == "direction":
        which = np.where(own > 0, 0, np.where(own < 0, 1, -1))
        bounds, labels = [(1.0, 1.0), (-1.0, -1.0)], ["rising", "falling"]
    else:
        which, edges = _cut(own)
        bounds = list(itertools.pairwise(edges))
        unit = axis.unit.format(unit=table.spec.unit)
        labels = [f"{low:.4g} .. {high:.4g} {unit}" for low, high in bounds]
    yield from _banded(title, labels, bounds, which[:, None], table.body_mm, square, block)


def _cut(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(S,) band of each value (S,), -1 where it is NaN, and the edges of the bands."""
    seen = ~np.isnan(values)
    least = values[seen].min()
    above = values[seen & (values > least)]
    if len(above) and len(above) < (1 - 1 / BANDS) * seen.sum():
        # Many rows share the least value, as those without any dwell do: a band of their own.
        edges = np.append(least, np.quantile(above, np.linspace(0, 1, BANDS)))
    else:
        edges = np.quantile(values[seen], np.linspace(0, 1, BANDS + 1))
    edges = np.unique(edges)
    if len(edges) == 1:
        edges = np.repeat(edges, 2)
    band = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    return np.where(seen, band, -1), edges


def _along_the_arm(table: ResidualTable, square: np.ndarray, block: np.ndarray) -> Iterator[Band]:
    where = arc_length(table)
    which = np.broadcast_to(np.arange(len(where)), square.shape)
    labels = [f"{way:.4g} mm" for way in where]
    bounds = [(float(way), float(way)) for way in where]
    yield from _banded("arc length", labels, bounds, which, table.body_mm, square, block)


def _banded(title, labels, bounds, which, body, square, block) -> Iterator[Band]:
    """Bands of values whose band `which` (S, 1) or (S, n) is known; -1 belongs to none."""
    count, number = len(labels), int(block.max()) + 1
    seen = ~np.isnan(square) & (which >= 0) & (block[:, None] >= 0)
    cell = np.where(seen, block[:, None] * count + which, number * count)

    def summed(values: np.ndarray) -> np.ndarray:
        """(K, bands) sums of values (S, n) by block and band."""
        flat = np.bincount(
            cell.ravel(), np.where(seen, values, 0.0).ravel(), minlength=number * count + 1
        )
        return flat[:-1].reshape(number, count)

    total = np.stack(
        [summed(square), *(summed(body[..., k]) for k in range(3)), summed(np.ones_like(square))]
    ).transpose(1, 2, 0)
    low, high = block_interval(_statistic, (total,))
    middle = _statistic(total.sum(0))
    full = np.broadcast_to(which, square.shape)
    for i in range(count):
        samples = int((seen & (full == i)).any(axis=1).sum())
        if not samples:
            continue
        yield Band(
            axis=title,
            label=labels[i],
            rmse_mm=float(middle[i, 0]),
            samples=samples,
            low=float(bounds[i][0]),
            high=float(bounds[i][1]),
            rmse_ci95_mm=(float(low[i, 0]), float(high[i, 0])),
            bias_mm=(float(middle[i, 1]), float(middle[i, 2]), float(middle[i, 3])),
            bias_ci95_mm=tuple((float(low[i, k]), float(high[i, k])) for k in (1, 2, 3)),
        )


def _statistic(total: np.ndarray) -> np.ndarray:
    """(..., 4) RMSE and bias from sums (..., 5): squares, three components, count."""
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = total[..., :4] / total[..., 4:]
    return np.concatenate([np.sqrt(np.maximum(mean[..., :1], 0)), mean[..., 1:]], axis=-1)
