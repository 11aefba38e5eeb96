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
    width: int
    """Number of features, constant ones not counted, with the smallest held-out error."""
    penalty: float
    """The penalty with the smallest held-out error."""


def cross_validate(
    design: np.ndarray,
    target: np.ndarray,
    fold: np.ndarray,
    penalties: tuple[float, ...] = PENALTIES,
    widths: tuple[int, ...] = (),
) -> HeldOut:
    """Ridge predictions of target (S, k) from design (S, F), fold (S,) after fold left out.

    The intercept is not penalised. A row with NaN in its target is left out of the fit, but gets a
    prediction. widths: numbers of leading features that make simpler regressions. Of
    all widths and penalties the best on the held-out rows is taken, the same for all columns and
    folds.
    """
    x, kept = _standardised(design)
    tries = [(int(kept[:w].sum()), p) for w in (*widths, len(kept)) for p in penalties]
    predicted = np.zeros((len(tries), *target.shape))
    for columns in _alike(target):
        seen = ~np.isnan(target[:, columns]).any(axis=1)
        if seen.any():
            predicted[:, :, columns] = _predict(x, target[:, columns], seen, fold, tries)
    error = [np.nansum(np.square(each - target)) for each in predicted]
    best = int(np.argmin(error))
    return HeldOut(predicted[best], tries[best][0], tries[best][1])


def _standardised(design: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(S, F') columns of mean 0 and variance 1, and which (F,) were kept: constant ones are not."""
    spread = design.std(axis=0)
    kept = spread > 1e-9 * np.maximum(np.abs(design).max(axis=0, initial=0), 1e-300)
    return (design[:, kept] - design[:, kept].mean(axis=0)) / spread[kept], kept


def _alike(target: np.ndarray) -> list[np.ndarray]:
    """Columns of the target that are fitted together: all, or those that miss the same rows."""
    missing = np.isnan(target)
    whole = ~missing.any(axis=1)
    if whole.sum() >= WHOLE * (~missing).sum(axis=0).max():
        return [np.arange(target.shape[1])]
    _, which = np.unique(missing, axis=1, return_inverse=True)
    which = which.reshape(-1)
    return [np.flatnonzero(which == group) for group in range(which.max() + 1)]


def _predict(x, target, seen, fold, tries) -> np.ndarray:
    """(tries, S, k) held-out predictions of columns that miss the same rows."""
    x = np.concatenate([np.ones((len(x), 1)), x], axis=1)
    grams, moments = [], []
    for part in range(int(fold.max()) + 1):
        rows = (fold == part) & seen
        grams.append(x[rows].T @ x[rows])
        moments.append(x[rows].T @ target[rows])
    whole, moment = sum(grams), sum(moments)
    answer = np.empty((len(tries), *target.shape))
    for part, (gram, own) in enumerate(zip(grams, moments, strict=True)):
        rows = fold == part
        left = max(int((seen & ~rows).sum()), 1)
        for number, (width, penalty) in enumerate(tries):
            ridge = np.full(1 + width, penalty * left)
            ridge[0] = 1e-9 * left
            own_gram = (whole - gram)[: 1 + width, : 1 + width] + np.diag(ridge)
            solved = cho_solve(cho_factor(own_gram), (moment - own)[: 1 + width])
            answer[number, rows] = x[rows, : 1 + width] @ solved
    return answer
