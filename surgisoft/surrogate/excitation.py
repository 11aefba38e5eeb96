"""What a recording excites: which inputs of a model it can support.

A network cannot tell an input's effect from the pressure's where the pressure already says what
that input is. After a plain traverse of the pressure cube the slow chamber has only ever risen:
its direction is a constant, its memory a function of its pressure. And where a chamber has only
ever swept its whole range, nothing says what a small reversal does.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from surgisoft.surrogate import direction as directions
from surgisoft.surrogate.history import History

NEIGHBOURS = 24
"""Rows of nearby pressure that are compared with each row."""
LEAST_CONTRAST = 0.15
"""Least share of a direction's variance that pressure must leave unexplained."""
LEAST_REVERSALS = 8
"""Least number of reversals of a chamber."""
INNER = (0.03, 0.8)
"""Sweeps of these shares of the range are inner (minor) loops."""
LEAST_INNER = 0.1
"""Least share of inner sweeps among all, so that partial reversals are represented."""
MOST_ROWS = 4000
"""Rows that are compared with their neighbours; more are thinned evenly."""


@dataclass(frozen=True)
class ChamberExcitation:
    """How one chamber was moved."""

    chamber: int
    """Number of the chamber, from 1."""
    contrast: float
    """Share (0..1) of the direction's variance that nearby pressures leave unexplained."""
    reversals: int
    """Number of changes of direction."""
    inner: float
    """Share of the sweeps between reversals that are inner loops."""

    @property
    def direction(self) -> bool:
        """Whether both directions were seen at like pressures."""
        return self.contrast >= LEAST_CONTRAST and self.reversals >= LEAST_REVERSALS

    @property
    def minor_loops(self) -> bool:
        """Whether reversals inside the range were seen, beside sweeps through all of it."""
        return self.direction and self.inner >= LEAST_INNER

    def complaint(self) -> str:
        """Why direction or memory is not supported; empty if both are."""
        if self.minor_loops:
            return ""
        if self.reversals < LEAST_REVERSALS:
            why = f"it reversed only {self.reversals} times"
        elif self.contrast < LEAST_CONTRAST:
            why = (
                "its direction follows from the pressures themselves "
                f"(contrast {self.contrast:.2f}, at least {LEAST_CONTRAST} needed)"
            )
        else:
            why = (
                f"it swept its whole range ({self.inner:.0%} inner reversals, at least "
                f"{LEAST_INNER:.0%} needed)"
            )
        return f"chamber {self.chamber}: {why}"


def excitation(
    history: History, low: Tensor, high: Tensor, band: Tensor
) -> list[ChamberExcitation]:
    """What a history excites, one answer a chamber; low, high, band (m,) in the arm's unit."""
    rest = torch.zeros_like(low).clamp(low, high)
    _, direction = directions.trace(history.pressure, band, rest)
    pressure = history.rows(history.pressure)
    span = (high - low).where(high > low, torch.ones_like(low))
    scaled = ((pressure - low) / span).double().numpy()
    sign = history.rows(direction).numpy()
    contrast = _contrast(scaled, sign)
    answer = []
    for chamber in range(history.chambers):
        sweeps = [
            _sweeps(
                history.pressure[run, history.valid[run], chamber].numpy(),
                direction[run, history.valid[run], chamber].numpy(),
            )
            for run in range(history.runs)
        ]
        shares = np.concatenate(sweeps) / float(span[chamber])
        inner = (shares > INNER[0]) & (shares < INNER[1])
        answer.append(
            ChamberExcitation(
                chamber=chamber + 1,
                contrast=float(contrast[chamber]),
                reversals=int(sum(max(len(run) - 1, 0) for run in sweeps)),
                inner=float(inner.mean()) if len(shares) else 0.0,
            )
        )
    return answer


def _contrast(scaled: np.ndarray, sign: np.ndarray) -> np.ndarray:
    """(m,) mean over rows of 1 - (mean direction of the neighbours)^2; rows (S, m)."""
    neighbours = min(NEIGHBOURS, len(scaled) - 1)
    if neighbours < 2:
        return np.zeros(scaled.shape[1])
    picked = np.linspace(0, len(scaled) - 1, min(len(scaled), MOST_ROWS)).astype(int)
    _, index = cKDTree(scaled).query(scaled[picked], k=neighbours + 1)
    mean = sign[index].mean(1)
    power = np.square(sign[index]).mean(1)
    return (power - np.square(mean)).mean(0)


def _sweeps(pressure: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Heights of the monotone sweeps of one chamber in one run, in its unit."""
    turns = np.flatnonzero(np.diff(direction) != 0) + 1
    pieces = np.split(pressure, turns)
    corners = [piece.max() if d >= 0 else piece.min() for piece, d in _signed(pieces, direction)]
    return np.abs(np.diff([pressure[0], *corners]))


def _signed(pieces: list[np.ndarray], direction: np.ndarray):
    start = 0
    for piece in pieces:
        yield piece, direction[start]
        start += len(piece)
