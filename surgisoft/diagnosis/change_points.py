"""Moments from which on something may have changed, tried coarsely and then between neighbours.

The moment of a change is not known and is searched (Andrews 1993, "Tests for parameter instability
and structural change with unknown change point", Econometrica 61): what leaves least on held-out
blocks is taken. Moments are shares of the rows, 0 to 1.
"""

import numpy as np

TRIED = 24
"""Moments that are tried first. The nearest one is off by a fiftieth of the time at most."""
FINER = 8
"""Steps between two of these, in which the best of them is refined."""
MARGIN = 0.04
"""Share of the rows before the first moment, and behind the last one."""


def coarse() -> np.ndarray:
    """(TRIED,) moments in equal steps."""
    return np.linspace(MARGIN, 1.0 - MARGIN, TRIED)


def finer(best: float) -> np.ndarray:
    """(2 FINER - 1,) moments between the neighbours of the best one of `coarse`, it in the middle.

    None lies in a margin.
    """
    step = (1.0 - 2.0 * MARGIN) / (TRIED - 1)
    near = best + np.arange(1 - FINER, FINER) / FINER * step
    return np.clip(near, MARGIN, 1.0 - MARGIN)
