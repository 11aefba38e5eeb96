"""Blocks of time, and what they say about uncertainty.

Neighbouring rows err alike, so rows are no independent samples: what is drawn, or left out, is a
block of neighbouring rows (Kunsch 1989, "The jackknife and the bootstrap for general stationary
observations"). A block never crosses the border of a run.
"""

from collections.abc import Callable

import numpy as np

BLOCKS = 30
"""Blocks that a set of recordings is cut into; more where it has more runs."""
LEAST_ROWS = 8
"""Fewest rows of a block, where its run has that many."""
DRAWS = 400
"""Draws of a bootstrap."""
FOLDS = 6
"""Parts that the blocks are dealt to when part after part is left out."""
LEVEL = 0.95
"""Confidence of the intervals."""


def blocks(run: np.ndarray, number: int = BLOCKS) -> np.ndarray:
    """(S,) number of the block of each row, from 0; run (S,) ids in contiguous stretches."""
    edges = np.flatnonzero(np.diff(run, prepend=run[:1] - 1) != 0)
    sizes = np.diff(np.append(edges, len(run)))
    longest = max(len(run) / number, LEAST_ROWS)
    answer, first = np.empty(len(run), np.int64), 0
    for begin, size in zip(edges, sizes, strict=True):
        parts = max(1, round(size / longest))
        answer[begin : begin + size] = first + np.arange(size) * parts // size
        first += parts
    return answer


def folds(block: np.ndarray, number: int = FOLDS, seed: int = 0) -> np.ndarray:
    """(S,) the fold of each row: whole blocks dealt at random to at most `number` folds."""
    count = int(block.max()) + 1
    order = np.random.default_rng(seed).permutation(count)
    dealt = np.empty(count, np.int64)
    dealt[order] = np.arange(count) % min(number, count)
    return dealt[block]


def block_sums(values: np.ndarray, block: np.ndarray) -> np.ndarray:
    """(K, ...) sums of the rows (S, ...) of each of the K blocks; NaN counts as nothing."""
    values = np.nan_to_num(values)
    edges = np.flatnonzero(np.diff(block, prepend=block[:1] - 1) != 0)
    return np.add.reduceat(values, edges, axis=0)


def block_bootstrap(
    statistic: Callable[..., np.ndarray],
    sums: tuple[np.ndarray, ...],
    draws: int = DRAWS,
    level: float = LEVEL,
    seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bound (...) of a statistic of totals, blocks drawn with replacement.

    sums: arrays (K, ...) of block sums, as `block_sums` gives them; statistic: takes their totals,
    each with the draws in front (draws, ...), and gives (draws, ...). NaN where K < 2.
    """
    count = len(sums[0])
    rng = np.random.default_rng(seed)
    weight = rng.multinomial(count, np.full(count, 1 / count), size=draws).astype(np.float64)
    totals = [np.tensordot(weight, each.astype(np.float64), axes=1) for each in sums]
    with np.errstate(invalid="ignore", divide="ignore"):
        drawn = np.asarray(statistic(*totals))
    if count < 2:
        nothing = np.full(drawn.shape[1:], np.nan)
        return nothing, nothing
    drawn = np.where(np.isfinite(drawn), drawn, np.nan)
    drawn = np.sort(drawn, axis=0)  # NaN last
    known = (~np.isnan(drawn)).sum(axis=0)
    return tuple(
        np.where(known > draws // 2, _at(drawn, share * np.maximum(known - 1, 0)), np.nan)
        for share in ((1 - level) / 2, (1 + level) / 2)
    )


def _at(drawn: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Values of the sorted draws (draws, ...) at a fractional rank (...)."""
    low = np.floor(where).astype(np.int64)
    high = np.minimum(low + 1, len(drawn) - 1)
    a, b = (np.take_along_axis(drawn, rank[None], axis=0)[0] for rank in (low, high))
    return a + (where - low) * (b - a)
