"""Is a gain more than chance, and whose is it? Sign flips and a bootstrap over blocks of time."""

import numpy as np

FLIPS = 2000
"""Random signs of a test."""
DRAWS = 500
"""Bootstrap samples of blocks."""


def studentised(gains: np.ndarray) -> np.ndarray:
    """(C,) mean over its standard error, of gains (C, B) by block."""
    count = gains.shape[1]
    spread = gains.std(axis=1, ddof=1) / np.sqrt(count)
    return gains.mean(axis=1) / np.maximum(spread, 1e-12 * np.abs(gains).max(initial=1e-30))


def family_p_values(gains: np.ndarray, group: np.ndarray | None = None, seed: int = 0):
    """(C,) chance of so large a gain in any of the C candidates, if none had one.

    Without a gain each block's difference is as likely negative as positive, for all candidates at
    once. Candidates of one group (the shapes of one effect) share their largest statistic, and
    groups count alike however many they hold: the smallest of the groups' own chances corrects for
    their number (Westfall & Young 1993, ch. 2, step minP). gains: (C, B) by block; group: (C,) ids.
    """
    rng = np.random.default_rng(seed)
    # The signs as they are come among the draws too: rounding must not set them below what is seen.
    seen = studentised(gains) * (1.0 - 1e-9)
    group = np.arange(len(gains)) if group is None else np.asarray(group)
    signs = rng.choice([-1.0, 1.0], size=(FLIPS, gains.shape[1]))
    # The sum of squares does not change with the signs, so neither does what scales the mean.
    count = gains.shape[1]
    square = (gains**2).sum(axis=1)
    mean = signs @ gains.T / count
    variance = np.maximum(square / count - mean**2, 1e-12 * square.max(initial=1e-30))
    drawn = mean / np.sqrt(variance / (count - 1))
    own = np.empty(len(gains))
    least = np.ones(FLIPS)
    for name in np.unique(group):
        of = group == name
        largest = np.sort(drawn[:, of].max(axis=1))
        own[of] = (1 + FLIPS - np.searchsorted(largest, seen[of], side="left")) / (1 + FLIPS)
        rank = np.searchsorted(largest, drawn[:, of].max(axis=1), side="left")
        least = np.minimum(least, (FLIPS - rank) / FLIPS)
    least.sort()
    return (1 + np.searchsorted(least, own, side="right")) / (1 + FLIPS)


def first_shares(losses: np.ndarray, seed: int = 0) -> np.ndarray:
    """(C,) share of bootstrap samples of blocks in which a candidate has the least loss (C, B)."""
    rng = np.random.default_rng(seed)
    count = losses.shape[1]
    weights = rng.multinomial(count, np.full(count, 1.0 / count), size=DRAWS)
    first = (weights @ losses.T).argmin(axis=1)
    return np.bincount(first, minlength=len(losses)) / DRAWS
