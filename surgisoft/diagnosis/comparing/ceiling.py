"""The explainable ceiling: how small a learner without physics can make the error.

A ridge regression on products of actuation and memory and on random nonlinear features of them
(Rahimi & Recht 2008, "Weighted sums of random kitchen sinks"), judged on blocks of time that it
has not seen. What it explains is not noise: some effect of actuation, time or context causes it.
What it leaves may still be explainable by a better learner.
"""

from dataclasses import dataclass

import numpy as np

from surgisoft.diagnosis.bootstrap import block_bootstrap, block_sums, folds
from surgisoft.diagnosis.race.ridge import HeldOut, cross_validate

RANDOM = 350
"""Random nonlinear features of all inputs."""
GATED = 150
"""Random nonlinear features of the gates alone: static errors live in few dimensions."""
STEEP = 2.0
"""Steepness of those."""
PRODUCTS = 400
"""Most products of an input and a gate; more gates are reduced to their principal components."""
MOST_ROWS = 12_000
"""Rows that the learner sees; more are thinned evenly."""


@dataclass(frozen=True, eq=False)
class Ceiling:
    """What a black box with memory reaches on held-out blocks."""

    rmse_mm: float
    """RMS distance over all key points that is left, mm; never above the model's own."""
    ci95_mm: tuple[float, float]
    """95 % interval of it from a bootstrap of blocks, mm."""
    per_key_point_mm: tuple[float, ...]
    """The same of each key point, mm."""


def ceiling(
    residual: np.ndarray, inputs: np.ndarray, gates: np.ndarray, block: np.ndarray, seed: int = 0
) -> Ceiling:
    """The ceiling of a residual (S, n, 3) in mm, NaN where missing.

    inputs: (S, F) features of order 1; gates: (S, g) those of order 1 that may change what the
    others do, such as actuation and direction; block: (S,) numbers of the blocks of time.
    """
    step = max(1, -(-len(residual) // MOST_ROWS))
    residual, inputs, gates, block = (values[::step] for values in (residual, inputs, gates, block))
    flat = residual.reshape(len(residual), -1)
    found = _learn(inputs, gates, flat, folds(block, seed=seed), seed)
    left = np.square(flat - found.predicted).reshape(residual.shape).sum(-1)
    before = np.square(residual).sum(-1)
    if np.nansum(left) > np.nansum(before):
        left = before
    seen = ~np.isnan(left)
    low, high = block_bootstrap(
        lambda total, count: np.sqrt(total.sum(1) / count.sum(1)),
        (block_sums(left, block), block_sums(seen, block)),
    )
    with np.errstate(invalid="ignore"):
        points = np.sqrt(np.nansum(left, axis=0) / np.where(seen.any(0), seen.sum(0), np.nan))
    return Ceiling(
        rmse_mm=float(np.sqrt(np.nansum(left) / max(int(seen.sum()), 1))),
        ci95_mm=(float(low), float(high)),
        per_key_point_mm=tuple(float(value) for value in points),
    )


def _principal(values: np.ndarray, most: int) -> np.ndarray:
    """(S, k) centred values (S, g), or their first principal components if k = `most` < g."""
    if values.shape[1] <= most:
        return values
    vectors = np.linalg.eigh(values.T @ values)[1]
    return values @ vectors[:, ::-1][:, :most]


def _learn(inputs, gates, target, fold, seed) -> HeldOut:
    """Held-out predictions by the richest set of features that the rows can support."""
    parts = design(inputs, gates, seed)
    widths = tuple(np.cumsum([part.shape[1] for part in parts[:-1]]).tolist())
    return cross_validate(np.concatenate(parts, axis=1), target, fold, widths=widths)


def design(inputs: np.ndarray, gates: np.ndarray, seed: int = 0) -> list[np.ndarray]:
    """Ever richer sets of features of the inputs (S, F) and gates (S, g), each (S, D).

    Smooth steps of the gates; the inputs; their products with the gates; smooth steps of them.
    """
    scale = inputs.std(axis=0)
    z = (inputs - inputs.mean(axis=0)) / np.where(scale > 1e-9, scale, 1.0)
    x = _principal(gates - gates.mean(axis=0), max(1, PRODUCTS // z.shape[1]))
    products = (z[:, :, None] * x[:, None, :]).reshape(len(z), -1)
    rng = np.random.default_rng(seed)
    return [_kinks(gates, GATED, STEEP, rng), z, products, _kinks(z, RANDOM, 1.0, rng)]


def _kinks(values: np.ndarray, number: int, steep: float, rng: np.random.Generator) -> np.ndarray:
    """(S, number) smooth steps across random directions of the values (S, F)."""
    width = values.shape[1]
    mixed = values @ rng.normal(0, steep / np.sqrt(width), (width, number))
    return np.tanh(mixed + rng.uniform(-steep, steep, number))
