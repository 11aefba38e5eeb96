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
SLIDES = 10
"""Steps in which begin and end of a gradual change are tried."""
LEAST_SLIDE = 0.2
"""Shortest gradual change that is tried, as a share of the rows; a shorter one is a step."""
MARGIN = 0.04
"""Share of the rows before the first moment, and behind the last one."""


def slides() -> list[tuple[float, float]]:
    """Begin and end of the gradual changes that are tried, all that last for `LEAST_SLIDE` or
    longer."""
    ends = np.linspace(0.0, 1.0, SLIDES + 1).tolist()
    return [(a, b) for a in ends for b in ends if b - a >= LEAST_SLIDE - 1e-9]


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
