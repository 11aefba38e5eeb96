"""The noise floor: the error that no model of the arm can go below."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from surgisoft.diagnosis.bootstrap import blocks, folds
from surgisoft.measurement.noise import hold_noise, stated_noise
from surgisoft.measurement.recordings import Recording

if TYPE_CHECKING:
    from surgisoft.diagnosis.residuals import Residuals

ALIKE = 0.02
"""How far actuation and its past may differ, as a share of the range, to count as the same."""
APART_S = 10.0
"""Least time between two rows that repeat each other, s: noise may be slow."""
LEAST_PAIRS = 50
"""Fewest repeats that give an estimate."""
MOST_ROWS = 12_000
"""Rows among which repeats are looked for; more are thinned evenly."""
LEAST_PLACES = 5
"""Fewest blocks of time that repeats must lie in."""


@dataclass(frozen=True)
class Floor:
    """A noise floor and where it comes from."""

    rmse_mm: float | None
    """RMS distance of a measured key point from its true place, mm; None if it is not known."""
    source: str
    """`sidecar`, `holds`, `repeats` or `unknown`."""


def noise_floor(recordings: list[Recording]) -> Floor:
    """The floor of some recordings together: what the lab states, else the scatter in holds.

    A distance has three coordinates' noise.
    """
    stated = stated_noise(recordings)
    if stated is not None:
        return Floor(float(np.sqrt(3.0) * stated), "sidecar")
    return hold_floor(recordings)


def hold_floor(recordings: list[Recording]) -> Floor:
    """The floor from the scatter in holds alone."""
    found = hold_noise(recordings)
    if found is None:
        return Floor(None, "unknown")
    return Floor(float(np.sqrt(3.0) * found), "holds")


def repeat_floor(rest: "Residuals") -> Floor:
    """The floor from inputs that came twice with the same recent history, far apart in time.

    Two such rows differ by twice the variance of one. Their predictions are alike too, so residuals
    are compared: the little that the inputs differ drops out. What the past of the inputs does not
    say (temperature, wear, stick-slip) counts as noise.
    """
    half = np.array(rest.spec.span)[:, None] / 2
    memory = rest.memory
    past = [memory.play - memory.pressure[..., None]]
    if rest.timed.any():
        past.append(memory.low_pass[..., 1:] - memory.pressure[..., None])
    whole = np.concatenate([memory.pressure[..., None], *past], axis=-1) / half
    whole = whole.reshape(len(whole), -1)
    block = blocks(rest.run)
    fold = folds(block)
    seen = ~np.isnan(rest.error_mm).all(axis=1)
    seen[np.arange(len(seen)) % -(-len(seen) // MOST_ROWS) != 0] = False
    halves, places = [], set()
    for part in range(int(fold.max()) + 1):
        here, there = np.flatnonzero((fold == part) & seen), np.flatnonzero((fold != part) & seen)
        if not len(here) or not len(there):
            continue
        tree = cKDTree(whole[there])
        _, nearest = tree.query(whole[here], p=np.inf, distance_upper_bound=2 * ALIKE)
        found = nearest < len(there)
        a, b = here[found], there[nearest[found]]
        apart = (rest.run[a] != rest.run[b]) | (np.abs(rest.t_s[a] - rest.t_s[b]) >= APART_S)
        a, b = a[apart], b[apart]
        halves.append(np.square(rest.residual_mm[a] - rest.residual_mm[b]).sum(-1) / 2)
        places |= set(block[a].tolist())
    half_square = np.concatenate([part.ravel() for part in halves]) if halves else np.zeros(0)
    half_square = half_square[~np.isnan(half_square)]
    if len(half_square) < LEAST_PAIRS * rest.spec.key_points or len(places) < LEAST_PLACES:
        return Floor(None, "unknown")
    return Floor(float(np.sqrt(half_square.mean())), "repeats")
