"""Whole numbers and rows that occur again: counted and sorted, fast for millions of them.

`numpy.unique` hashes whole numbers, which takes seconds for a million faces, and compares rows one
by one; both cost more than the repair of a mesh itself.
"""

import numpy as np


def used_indices(index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The indices that occur, rising (U,), and `index` (any shape) numbered by their place there.

    For indices of vertices or labels: whole numbers from 0, not many more than there are.
    """
    flags = np.zeros(int(index.max(initial=-1)) + 1, dtype=bool)
    flags[index] = True
    used = np.flatnonzero(flags)
    place = np.empty(len(flags), dtype=np.int64)
    place[used] = np.arange(len(used))
    return used, place[index]


def equal_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows (N, K) that are equal, one group each: first row (G,), group (N,), size (G,).

    Groups rise with their rows, first column first, as `numpy.unique(axis=0)` has them.
    """
    order = np.lexsort(rows.T[::-1])
    ranked = rows[order]
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (ranked[1:] != ranked[:-1]).any(axis=1)
    start = np.flatnonzero(new)
    group = np.empty(len(rows), dtype=np.int64)
    group[order] = np.cumsum(new) - 1
    # lexsort is stable: the first of a group is its first row
    return order[start], group, np.diff(np.r_[start, len(rows)])
