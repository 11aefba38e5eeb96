"""Direction of change of each chamber (Chen et al. 2025, eq. 1: d_i is +1 rising, -1 falling).

The direction keeps its last value while the pressure rests. A sensor never rests quite, so a move
counts only once it leaves a dead band around the last confirmed one: a play operator of half width
`band`, whose motion gives the sign. Before the first confirmed move the direction is 0.
"""

from torch import Tensor

from surgisoft.surrogate.scan import clamp_scan, last_nonzero


def advance(anchor: Tensor, direction: Tensor, pressure: Tensor, band: Tensor):
    """One step for a batch: (anchor, direction), each (B, m), after the new pressure (B, m)."""
    moved = anchor.clamp(pressure - band, pressure + band)
    sign = (moved - anchor).sign()
    return moved, sign.where(sign != 0, direction)


def trace(pressure: Tensor, band: Tensor, rest: Tensor):
    """The same over whole runs: (anchor, direction), each (R, T, m), from pressure (R, T, m).

    Every run starts from rest (m,), without a direction.
    """
    start = rest.expand(len(pressure), -1)
    anchor = clamp_scan(pressure - band, pressure + band, start)
    sign = anchor.diff(dim=1, prepend=start.unsqueeze(1)).sign()
    return anchor, last_nonzero(sign)
