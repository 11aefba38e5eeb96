"""The statistical tests of an identification: held-out regression, bootstrap and sign flips.

Neighbouring rows err alike, so rows are no independent samples. What is drawn, flipped or left out
is a block of neighbouring rows (Kunsch 1989, "The jackknife and the bootstrap for general
stationary observations").
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.linalg import cho_factor, cho_solve

BREAK_RIDGE = 1.0
"""Ridge on the columns of a break, of order 1 in each row: the weight of one row."""
DRAWS = 2000
"""Random draws of every bootstrap and of every sign-flip test. The end of a 95 % interval then has
a Monte Carlo error of a fifteenth of the standard error, a p-value of 0.02 one of 0.003."""
LEAST_VARIANCE = 1e-12
"""Least variance of an estimate beside the largest one; keeps weights of exact estimates finite."""
LEVEL = 0.95
"""Confidence level of the intervals."""
PENALTIES = (1e-3, 1e-2, 1e-1)
"""Ridge penalties that are tried, as shares of the number of rows: features have variance 1."""
WHOLE = 0.7
"""Share of a target's rows that may be left out of its fit so that all targets share one fit."""


@lru_cache(maxsize=16)
def _weights(blocks: int, seed: int) -> np.ndarray:
    """(DRAWS, blocks) how often each block comes in each bootstrap sample."""
    drawn = np.random.default_rng(seed).multinomial(blocks, np.full(blocks, 1 / blocks), DRAWS)
    drawn = drawn.astype(np.float64)
    drawn.setflags(write=False)
    return drawn


def block_sums(values: np.ndarray, block: np.ndarray) -> np.ndarray:
    """(K, ...) sums of the rows (S, ...) of each of the K blocks.

    NaN counts as 0; rows of block -1 belong to none.
    """
    inside = block >= 0
    values, block = np.nan_to_num(values[inside]), block[inside]
    flat = values.reshape(len(values), -1).astype(np.float64)
    count = int(block.max(initial=-1)) + 1
    sums = [np.bincount(block, column, minlength=count) for column in flat.T]
    return np.stack(sums, axis=1).reshape(count, *values.shape[1:])


def block_interval(
    statistic: Callable[..., np.ndarray], sums: tuple[np.ndarray, ...], seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper 95 % bound (...) of a statistic of totals, blocks drawn with replacement.

    sums: arrays (K, ...) of block sums, as `block_sums` gives them. statistic: takes their totals,
    each with the draws in front (DRAWS, ...), and gives (DRAWS, ...). A draw in which it is not
    finite is left out; the bounds are NaN where most draws are, or where K < 2.
    """
    count = len(sums[0])
    totals = [np.tensordot(_weights(count, seed), each.astype(float), axes=1) for each in sums]
    with np.errstate(invalid="ignore", divide="ignore"):
        drawn = np.asarray(statistic(*totals))
    if count < 2:
        nothing = np.full(drawn.shape[1:], np.nan)
        return nothing, nothing
    drawn = np.sort(np.where(np.isfinite(drawn), drawn, np.nan), axis=0)  # NaN last
    known = (~np.isnan(drawn)).sum(axis=0)
    low, high = (
        np.where(known > DRAWS // 2, _at(drawn, share * np.maximum(known - 1, 0)), np.nan)
        for share in ((1 - LEVEL) / 2, (1 + LEVEL) / 2)
    )
    return low, high


def _at(drawn: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Values of the sorted draws (DRAWS, ...) at a fractional rank (...)."""
    low = np.floor(where).astype(np.int64)
    high = np.minimum(low + 1, len(drawn) - 1)
    a, b = (np.take_along_axis(drawn, rank[None], axis=0)[0] for rank in (low, high))
    return a + (where - low) * (b - a)


def win_shares(losses: np.ndarray, seed: int = 0) -> np.ndarray:
    """(C,) share of bootstrap samples in which a candidate has the least total loss.

    losses: (C, B) of C candidates on B blocks.
    """
    first = (_weights(losses.shape[1], seed) @ losses.T).argmin(axis=1)
    return np.bincount(first, minlength=len(losses)) / DRAWS


def studentised(gains: np.ndarray) -> np.ndarray:
    """(C,) mean over its standard error, of gains (C, B) by block."""
    count = gains.shape[1]
    spread = gains.std(axis=1, ddof=1) / np.sqrt(count)
    return gains.mean(axis=1) / np.maximum(spread, 1e-12 * np.abs(gains).max(initial=1e-30))


def variance_between(estimates: np.ndarray, variances: np.ndarray) -> float:
    """Variance of a quantity between M samples, beyond that of its estimates (M,) in each of them.

    The moment estimator of random effects (DerSimonian & Laird 1986, "Meta-analysis in clinical
    trials", eq. 8): by how much the heterogeneity Q of Cochran 1954 exceeds its expected value
    under one common value, M - 1. 0 where it does not. variances: (M,) of the estimates; where
    they are all 0 the quantity is known in each sample, and this is the variance of its values.
    """
    if len(estimates) < 2:
        return 0.0
    largest = float(np.max(variances))
    if not largest > 0.0:
        return float(np.var(estimates, ddof=1))
    weights = 1.0 / np.maximum(variances, LEAST_VARIANCE * largest)
    mean = weights @ estimates / weights.sum()
    excess = weights @ np.square(estimates - mean) - (len(estimates) - 1)
    unit = weights.sum() - np.square(weights).sum() / weights.sum()
    return float(max(excess, 0.0) / max(unit, 1e-300))


def sign_flip_p_values(
    gains: np.ndarray,
    group: Sequence[str] | np.ndarray | None = None,
    seed: int = 0,
    draws: int = DRAWS,
) -> np.ndarray:
    """(C,) probability of so large a gain in any of C candidates if none had one.

    Without a gain each block's difference is as likely negative as positive, for all candidates at
    once, so the signs of whole blocks are flipped at random. Candidates of one group (the nonlinear
    parameters of one effect) share their largest statistic, and groups count alike however many
    they hold: the smallest of the groups' own probabilities corrects for their number (Westfall &
    Young 1993, ch. 2, step minP). gains: (C, B) by block; group: (C,) ids.
    """
    rng = np.random.default_rng(seed)
    # The signs as they are come among the draws too: rounding must not set them below what is seen.
    seen = studentised(gains) * (1.0 - 1e-9)
    group = np.arange(len(gains)) if group is None else np.asarray(group)
    signs = rng.choice([-1.0, 1.0], size=(draws, gains.shape[1]))
    # The sum of squares does not change with the signs, so neither does what scales the mean.
    count = gains.shape[1]
    square = (gains**2).sum(axis=1)
    mean = signs @ gains.T / count
    variance = np.maximum(square / count - mean**2, 1e-12 * square.max(initial=1e-30))
    drawn = mean / np.sqrt(variance / (count - 1))
    own = np.empty(len(gains))
    least = np.ones(draws)
    for name in np.unique(group):
        of = group == name
        largest = np.sort(drawn[:, of].max(axis=1))
        own[of] = (1 + draws - np.searchsorted(largest, seen[of], side="left")) / (1 + draws)
        rank = np.searchsorted(largest, drawn[:, of].max(axis=1), side="left")
        least = np.minimum(least, (draws - rank) / draws)
    least.sort()
    return (1 + np.searchsorted(least, own, side="right")) / (1 + draws)


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Predictions of a regression for rows of folds that it was not fitted to."""

    predicted: np.ndarray
    """(S, k) predictions; every row by the fit that left its fold out."""
    penalty: float
    """The penalty with the smallest held-out error."""


def cross_validated_ridge(
    design: np.ndarray,
    target: np.ndarray,
    fold: np.ndarray,
    penalties: tuple[float, ...] = PENALTIES,
) -> HeldOut:
    """Ridge predictions of target (S, k) from design (S, F), fold (S,) after fold left out.

    Ridge regression: Hoerl & Kennard 1970. The intercept is not penalised. A row with NaN in its
    target is left out of the fit, but gets a prediction. Of all penalties the best on the held-out
    rows is taken, the same for all targets and folds.
    """
    x = _standardised(design)
    error = np.zeros(len(penalties))
    fits = []
    for columns in _alike(target):
        seen = ~np.isnan(target[:, columns]).any(axis=1)
        if seen.any():
            weights = _ridges(x, target[:, columns], seen, fold, penalties)
            fits.append((columns, weights))
            for part in range(weights.shape[1]):
                rows = np.flatnonzero(fold == part)
                rows = rows[~np.isnan(target[np.ix_(rows, columns)]).all(axis=1)]
                left = x[rows] @ weights[:, part] - target[np.ix_(rows, columns)]
                error += np.nansum(np.square(left), axis=(1, 2))
    best = int(np.argmin(error))
    predicted = np.zeros_like(target)
    for columns, weights in fits:
        for part in range(weights.shape[1]):
            rows = np.flatnonzero(fold == part)
            predicted[np.ix_(rows, columns)] = x[rows] @ weights[best, part]
    return HeldOut(predicted, penalties[best])


def _standardised(design: np.ndarray) -> np.ndarray:
    """(S, 1 + F') a column of ones, and columns of mean 0 and variance 1 but constant ones."""
    answer = np.empty((len(design), 1 + design.shape[1]))
    answer[:, 0] = 1.0
    centred = np.subtract(design, design.mean(axis=0), out=answer[:, 1:])
    spread = np.sqrt(np.einsum("sf,sf->f", centred, centred) / len(design))
    largest = np.maximum(design.max(axis=0, initial=0), -design.min(axis=0, initial=0))
    kept = spread > 1e-9 * np.maximum(largest, 1e-300)
    if not kept.all():
        answer = np.compress(np.append(True, kept), answer, axis=1)
    answer[:, 1:] /= spread[kept]
    return answer


def _alike(target: np.ndarray) -> list[np.ndarray]:
    """Targets that are fitted together: all, or those that miss the same rows."""
    missing = np.isnan(target)
    whole = ~missing.any(axis=1)
    if whole.sum() >= WHOLE * (~missing).sum(axis=0).max():
        return [np.arange(target.shape[1])]
    _, which = np.unique(missing, axis=1, return_inverse=True)
    which = which.reshape(-1)
    return [np.flatnonzero(which == group) for group in range(which.max() + 1)]


def _ridges(x, target, seen, fold, penalties) -> np.ndarray:
    """(P, folds, F, k) weights of targets that miss the same rows, by penalty and fold left out."""
    grams, moments = [], []
    for part in range(int(fold.max()) + 1):
        rows = (fold == part) & seen
        grams.append(x[rows].T @ x[rows])
        moments.append(x[rows].T @ target[rows])
    whole, moment = sum(grams), sum(moments)
    answer = np.zeros((len(penalties), len(grams), x.shape[1], target.shape[1]))
    for part, (gram, own) in enumerate(zip(grams, moments, strict=True)):
        left = max(int((seen & (fold != part)).sum()), 1)
        for number, penalty in enumerate(penalties):
            ridge = np.full(x.shape[1], penalty * left)
            ridge[0] = 1e-9 * left
            answer[number, part] = cho_solve(
                cho_factor(whole - gram + np.diag(ridge)), moment - own
            )
    return answer


class FoldsOfRidge:
    """Ridge regressions of a target on columns, one fold left out in turn.

    The first column is constant and has no penalty. Breaks enter by blockwise elimination: their
    few columns cost no further factorisation.
    """

    def __init__(self, columns: np.ndarray, target: np.ndarray, fold: np.ndarray):
        """columns (S, F) and target (S, C), mm; fold: (S,) fold of each row."""
        self.columns, self.target = columns, target
        self.held = [np.flatnonzero(fold == number) for number in np.unique(fold)]
        parts = [(columns[rows].T @ columns[rows]).astype(float) for rows in self.held]
        moments = [(columns[rows].T @ target[rows]).astype(float) for rows in self.held]
        self.grams = [sum(parts) - part for part in parts]
        self.moments = [sum(moments) - moment for moment in moments]

    def _factor(self, number: int, ridge: float) -> tuple:
        penalty = np.full(self.columns.shape[1], ridge)
        penalty[0] = 1e-3
        return cho_factor(self.grams[number] + np.diag(penalty), check_finite=False)

    def remainder(self, ridge: float) -> np.ndarray:
        """(S, C) what the columns leave of the rows that are left out, mm."""
        answer = np.empty_like(self.target)
        for number, rows in enumerate(self.held):
            solved = cho_solve(self._factor(number, ridge), self.moments[number])
            answer[rows] = self.target[rows] - self.columns[rows] @ solved.astype(np.float32)
        return answer

    def with_breaks(
        self, ridge: float, state: np.ndarray, rows_before: Sequence[int] | np.ndarray
    ) -> list[np.ndarray]:
        """For each number of rows before a break (S, C) what is left with the state (S, k) behind
        the break as further columns, mm."""
        behind = [np.arange(len(state)) >= first for first in rows_before]
        return self.with_states(ridge, [state * each[:, None] for each in behind])

    def with_states(self, ridge: float, states: Sequence[np.ndarray]) -> list[np.ndarray]:
        """For each state (S, k) what is left (S, C) with it as further columns, mm."""
        wide = np.concatenate(states, axis=1)
        answer = [np.empty_like(self.target) for _ in states]
        size = states[0].shape[1]
        crossed, grams, moments = (
            (other.T @ wide).astype(float) for other in (self.columns, wide, self.target)
        )
        for number, rows in enumerate(self.held):
            factor, out = self._factor(number, ridge), wide[rows]
            solved = cho_solve(factor, self.moments[number])
            own_crossed = crossed - self.columns[rows].T @ out
            freed = cho_solve(factor, own_crossed)
            gram = grams - out.T @ out - own_crossed.T @ freed
            moment = (moments - self.target[rows].T @ out).T - own_crossed.T @ solved
            left = self.target[rows] - self.columns[rows] @ solved.astype(np.float32)
            own = out - self.columns[rows] @ freed.astype(np.float32)
            for place, one in enumerate(answer):
                at = slice(place * size, (place + 1) * size)
                ridged = gram[at, at] + BREAK_RIDGE * np.eye(size)
                amplitudes = np.linalg.solve(ridged, moment[at])
                one[rows] = left - own[:, at] @ amplitudes.astype(np.float32)
        return answer
