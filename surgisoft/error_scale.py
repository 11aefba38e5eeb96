"""How errors of a body are drawn: magnified and coloured by one scale in every picture.

Measured and predicted bodies nearly coincide. Pages and replays draw each error as an arrow that is
longer by a round factor, and colour it up to a round error; both are chosen here, once for all
models that are shown together.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

STRETCH_OF_ERROR = 0.15
"""Length of the drawn error at the end of the scale, as a share of the workspace's diagonal."""
LARGE = 0.95
"""Quantile of the errors of the worst model at which the colour scale ends, rounded up."""
BAR_SHARE = 0.25
"""Length of the scale bar, as a share of the body's length, rounded down."""


@dataclass(frozen=True)
class Scale:
    """How errors are drawn: the same for every model of a picture."""

    large_mm: float
    """Error at which the colour scale ends, mm."""
    stretch: float
    """Factor by which the drawn errors are longer than they are."""
    body_mm: float
    """Length of the body, mm."""

    @property
    def bar_mm(self) -> float:
        """Length of the scale bar, mm."""
        return bar_length(BAR_SHARE * self.body_mm)


def error_scale(
    measured_mm: np.ndarray, errors_mm: Sequence[np.ndarray], large_mm: float | None = None
) -> Scale:
    """The scale for measured key points (S, n, 3) mm and the errors (S, n) mm of each model.

    large_mm: error at which the colours end; None: the largest of the models' 95 % quantiles,
    rounded up to 1, 2 or 5 times a power of ten.
    """
    if large_mm is None:
        large_mm = rounded_up(max(quantile(error) for error in errors_mm))
    return Scale(large_mm, stretch_of(measured_mm, large_mm), body_size(measured_mm))


def quantile(error_mm: np.ndarray) -> float:
    """The 95 % quantile of the known errors; 0 where none is known."""
    known = error_mm[np.isfinite(error_mm)]
    return float(np.quantile(known, LARGE)) if len(known) else 0.0


def rounded_up(value: float) -> float:
    """The next of 1, 2 and 5 times a power of ten, so that scales of several pictures agree."""
    if value <= 0.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(value))
    return next(float(k * power) for k in (1.0, 2.0, 5.0, 10.0) if k * power >= value * (1 - 1e-9))


def bar_length(most_mm: float) -> float:
    """The largest of 1, 2 and 5 times a power of ten within a length, mm."""
    power = 10.0 ** np.floor(np.log10(max(most_mm, 1e-9)))
    return float(max(k * power for k in (1.0, 2.0, 5.0) if k * power <= most_mm * (1 + 1e-9)))


def body_size(points_mm: np.ndarray) -> float:
    """Length of the body, mm: its longest polyline through key points; of one, its motion."""
    known = np.isfinite(points_mm).all((1, 2))
    if points_mm.shape[1] > 1 and known.any():
        steps = np.linalg.norm(np.diff(points_mm[known], axis=1), axis=-1)
        return max(float(steps.sum(axis=1).max()), 1e-3)
    seen = points_mm[np.isfinite(points_mm).all(-1)]
    return max(float(np.linalg.norm(np.ptp(seen, axis=0))), 1e-3) if len(seen) else 1.0


def stretch_of(points_mm: np.ndarray, large_mm: float) -> float:
    """The round factor by which drawn errors are magnified, for errors of up to large_mm."""
    points = points_mm[np.isfinite(points_mm).all(-1)]
    size = float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 1.0
    factor = STRETCH_OF_ERROR * size / max(large_mm, 1e-9)
    rounds = [k * 10.0**p for p in range(4) for k in (1.0, 2.0, 5.0)]
    return max((r for r in rounds if r <= factor), default=1.0)
