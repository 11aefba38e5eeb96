"""Which blocks of time repeat a motion that was recorded before.

A sweep that is played over and over shows the surrogate's own error over and over, always in the
same way. Such blocks are no further evidence: they are left out of a fit together, and in a test
they count as one.
"""

import numpy as np
import torch
from scipy.spatial import cKDTree

from surgisoft.surrogate.history import History
from surgisoft.surrogate.scan import linear_scan

TIMES_S = (0.5, 2.0)
"""Time constants of the low passes that say how an actuation came about, s."""
ALIKE = 0.1
"""How far actuation and its past may differ, in half ranges, to count as the same."""
SHARE = 0.5
"""Share of the rows of each of two blocks that must come again in the other, in motion."""
STILL = 0.02
"""Way that an actuation is ahead of its past, in half ranges, up to which the arm is still."""
MOST_ROWS = 6000
"""Rows among which repeats are looked for; more are thinned evenly."""


def motions(history: History, half: np.ndarray, block: np.ndarray) -> np.ndarray:
    """(B,) the motion of each block, counted from 0 in the order in which they first appear.

    half: (m,) half ranges of the actuation; block: (N,) block of each row, -1 where it is in none.
    """
    rows = np.flatnonzero(block >= 0)
    rows = rows[:: max(1, -(-len(rows) // MOST_ROWS))]
    state, owner = _states(history, half)[rows], block[rows]
    count = int(block.max()) + 1
    whole = np.maximum(np.bincount(owner, minlength=count), 1)
    moving = np.abs(state[:, history.chambers :]).max(1) > STILL
    state, owner = state[moving], owner[moving]
    shared = np.zeros((count, count))
    # A row of one block and those of all blocks within reach of it, each block counted once.
    near = cKDTree(state).query_ball_point(state, ALIKE, p=np.inf)
    for own, some in zip(owner, near, strict=True):
        shared[own, np.unique(owner[some])] += 1.0
    shared /= whole[:, None]
    alike = np.minimum(shared, shared.T) >= SHARE
    answer, found = np.full(count, -1), 0
    for first in range(count):
        if answer[first] < 0:
            answer[alike[first] & (answer < 0)] = found
            answer[first] = found
            found += 1
    return answer


def _states(history: History, half: np.ndarray) -> np.ndarray:
    """(N, 3 m) the actuation of every row and how far it runs ahead of its low passes."""
    signal = history.pressure.double() / torch.from_numpy(half)
    decay = torch.exp(-history.dt_s.double().unsqueeze(-1) / torch.tensor(TIMES_S))
    decay = decay.unsqueeze(2).expand(*signal.shape, len(TIMES_S))
    wide = signal.unsqueeze(-1)
    past = linear_scan(decay, (1.0 - decay) * wide, wide[:, 0].expand(-1, -1, len(TIMES_S)))
    return history.rows(torch.cat([signal, (wide - past).flatten(2)], -1)).numpy()
