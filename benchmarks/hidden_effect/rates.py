"""Errors of models by the rate of actuation: whether the arm trails them or runs ahead."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
from scipy.ndimage import uniform_filter1d

from surgisoft.diagnosis.residuals import EVERY_ROW, problem_of
from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.checkpoint import load_model

BANDS = (1.0, 3.0, 6.0, 10.0, 20.0)
"""Ends of the bands of the fastest chamber's rate, kPa/s."""
SMOOTH_S = 0.5
"""Time over which rates and velocities are averaged, s."""


def by_rate(models: dict[str, Path], recording: Recording) -> list[dict]:
    """For each band of rate: its `low` and `high` [kPa/s], `rows`, and for each model `rmse_mm` and
    `trails_s`, the time by which the arm is behind (positive) or ahead of the model."""
    step_s = float(np.median(np.diff(recording.t_s)))
    width = max(1, round(SMOOTH_S / step_s))
    rate = np.abs(_slope(recording.measured, recording.t_s, width)).max(1)
    velocity = _slope(recording.key_points_mm, recording.t_s, width)
    first, *_ = models.values()
    problem = problem_of(load_model(first), [recording], EVERY_ROW, part="all")
    rows = problem.index.numpy()
    left = {key: problem.with_model(load_model(folder)).residual for key, folder in models.items()}
    rates = []
    for low, high in itertools.pairwise(BANDS):
        inside = (rate[rows] >= low) & (rate[rows] < high)
        band = {"low": low, "high": high, "rows": int(inside.sum())}
        for key, residual in left.items():
            band[key] = {
                "rmse_mm": float(np.sqrt(np.nanmean(np.square(residual[inside]).sum(2)))),
                "trails_s": trails_s(residual[inside], velocity[rows][inside]),
            }
        rates.append(band)
    return rates


def trails_s(residual: np.ndarray, velocity: np.ndarray) -> float:
    """Least-squares time [s] by which measured points are behind predicted ones.

    residual: (S, n, 3) measured less predicted, mm; velocity: (S, n, 3) mm/s. To first order an arm
    that trails by s seconds is at x(t - s) = x(t) - s dx/dt. NaN is left out.
    """
    known = np.isfinite(residual) & np.isfinite(velocity)
    r, v = residual[known], velocity[known]
    return float(-(r @ v) / (v @ v))


def _slope(values: np.ndarray, t_s: np.ndarray, width: int) -> np.ndarray:
    """(T, ...) change of (T, ...) values a second, averaged over so many rows; NaN left out."""
    slope = np.gradient(values, t_s, axis=0)
    known = np.isfinite(slope)
    total = uniform_filter1d(np.where(known, slope, 0.0), width, axis=0)
    share = uniform_filter1d(known.astype(float), width, axis=0)
    return np.where(known, total / np.maximum(share, 1.0 / width), np.nan)
