"""Ridge regression judged on blocks that it has not seen (Hoerl & Kennard 1970)."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

PENALTIES = (1e-3, 1e-2, 1e-1)
"""Penalties that are tried, as shares of the rows: features have variance 1."""
WHOLE = 0.7
"""Share of a column's rows that may be left out of its fit so that all columns share one fit."""


@dataclass(frozen=True, eq=False)
class HeldOut:
    """What a regression predicts for rows of blocks that it was not fitted to."""

    predicted: np.ndarray
    """(S, k) predictions; every row by the fit that left its fold out."""
    penalty: float
    """The penalty with the smallest held-out error."""


def cross_validate(
    design: np.ndarray,
    target: np.ndarray,
    fold: np.ndarray,
    penalties: tuple[float, ...] = PENALTIES,
) -> HeldOut:
    """Ridge predictions of target (S, k) from design (S, F), fold (S,) after fold left out.

    The intercept is not penalised. A row with NaN in its target is left out of the fit, but gets a
    prediction. Of the penalties the best on the held-out rows is taken, the same
    for all columns and folds.
    """
    x = _standardised(design)
    predicted = np.zeros((len(penalties), *target.shape))
    for columns in _alike(target):
        seen = ~np.isnan(target[:, columns]).any(axis=1)
        if seen.any():
            predicted[:, :, columns] = _predict(x, target[:, columns], seen, fold, penalties)
    error = [np.nansum(np.square(each - target)) for each in predicted]
    best = int(np.argmin(error))
    return HeldOut(predicted[best], penalties[best])


def _standardised(design: np.ndarray) -> np.ndarray:
    """(S, F') columns of mean 0 and variance 1; constant ones are dropped."""
    spread = design.std(axis=0)
    kept = spread > 1e-9 * np.maximum(np.abs(design).max(axis=0, initial=0), 1e-300)
    return (design[:, kept] - design[:, kept].mean(axis=0)) / spread[kept]


def _alike(target: np.ndarray) -> list[np.ndarray]:
    """Columns of the target that are fitted together: all, or those that miss the same rows."""
    missing = np.isnan(target)
    whole = ~missing.any(axis=1)
    if whole.sum() >= WHOLE * (~missing).sum(axis=0).max():
        return [np.arange(target.shape[1])]
    _, which = np.unique(missing, axis=1, return_inverse=True)
    which = which.reshape(-1)
    return [np.flatnonzero(which == group) for group in range(which.max() + 1)]


def _predict(x, target, seen, fold, penalties) -> np.ndarray:
    """(penalties, S, k) held-out predictions of columns that miss the same rows."""
    x = np.concatenate([np.ones((len(x), 1)), x], axis=1)
    grams, moments = [], []
    for part in range(int(fold.max()) + 1):
        rows = (fold == part) & seen
        grams.append(x[rows].T @ x[rows])
        moments.append(x[rows].T @ target[rows])
    whole, moment = sum(grams), sum(moments)
    answer = np.empty((len(penalties), *target.shape))
    for part, (gram, own) in enumerate(zip(grams, moments, strict=True)):
        rows = fold == part
        left = max(int((seen & ~rows).sum()), 1)
        for number, penalty in enumerate(penalties):
            ridge = np.full(x.shape[1], penalty * left)
            ridge[0] = 1e-9 * left
            solved = cho_solve(cho_factor(whole - gram + np.diag(ridge)), moment - own)
            answer[number, rows] = x[rows] @ solved
    return answer
