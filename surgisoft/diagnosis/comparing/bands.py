"""The error and the bias in bands of every axis, with intervals from a bootstrap of blocks."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from surgisoft.diagnosis.bootstrap import block_bootstrap, blocks
from surgisoft.diagnosis.comparing.axes import Axis, arc_length, known
from surgisoft.diagnosis.residuals import Residuals

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


def bands(rest: Residuals) -> list[Band]:
    """Bands of every known axis, each column of it, and of the arc length."""
    block = blocks(rest.run)
    square = np.square(rest.error_mm)
    answer = []
    for name, axis in known(rest).items():
        values = axis.columns(rest)
        for column in range(values.shape[1]):
            answer += _column_bands(rest, square, block, name, axis, values, column)
    return answer + list(_along_the_arm(rest, square, block))


def _column_bands(rest, square, block, name, axis: Axis, values, column) -> Iterator[Band]:
    title = NAMES.get(name, f"{name} ") + str(column + 1) if values.shape[1] > 1 else name
    if values.shape[1] == 1 and name in NAMES:
        title = f"{NAMES[name]}1"
    own = values[:, column]
    if name == "direction":
        which = np.where(own > 0, 0, np.where(own < 0, 1, -1))
        bounds, labels = [(1.0, 1.0), (-1.0, -1.0)], ["rising", "falling"]
    else:
        which, edges = _cut(own)
        bounds = list(itertools.pairwise(edges))
        unit = axis.unit.format(unit=rest.spec.unit)
        labels = [f"{low:.4g} .. {high:.4g} {unit}" for low, high in bounds]
    yield from _banded(title, labels, bounds, which[:, None], rest.body_mm, square, block)


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


def _along_the_arm(rest: Residuals, square: np.ndarray, block: np.ndarray) -> Iterator[Band]:
    where = arc_length(rest)
    which = np.broadcast_to(np.arange(len(where)), square.shape)
    labels = [f"{way:.4g} mm" for way in where]
    bounds = [(float(way), float(way)) for way in where]
    yield from _banded("arc length", labels, bounds, which, rest.body_mm, square, block)


def _banded(title, labels, bounds, which, body, square, block) -> Iterator[Band]:
    """Bands of values whose band `which` (S, 1) or (S, n) is known; -1 belongs to none."""
    count, number = len(labels), int(block.max()) + 1
    seen = ~np.isnan(square) & (which >= 0)
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
    low, high = block_bootstrap(_statistic, (total,))
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
            bias_mm=tuple(float(value) for value in middle[i, 1:]),
            bias_ci95_mm=tuple((float(low[i, k]), float(high[i, k])) for k in (1, 2, 3)),
        )


def _statistic(total: np.ndarray) -> np.ndarray:
    """(..., 4) RMSE and bias from sums (..., 5): squares, three components, count."""
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = total[..., :4] / total[..., 4:]
    return np.concatenate([np.sqrt(np.maximum(mean[..., :1], 0)), mean[..., 1:]], axis=-1)
