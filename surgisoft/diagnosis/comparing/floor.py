"""The noise floor: the error that no model of the arm can go below."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from surgisoft.diagnosis.bootstrap import blocks, folds
from surgisoft.measurement.recording import Recording

if TYPE_CHECKING:
    from surgisoft.diagnosis.residuals import Residuals

LEAST_HOLD_S = 1.0
"""Shortest hold whose scatter is taken for noise, s."""
LEAST_HOLD_ROWS = 8
"""Fewest rows of such a hold."""
LEAST_HOLDS = 5
"""Fewest holds that give an estimate."""
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

    The sidecar states one coordinate's standard deviation; a distance has three of them. The
    scatter in holds (after a straight line is taken out) misses noise slower than a hold.
    """
    if all(recording.noise_mm is not None for recording in recordings):
        square = [3 * recording.noise_mm**2 for recording in recordings]
        weight = [recording.samples for recording in recordings]
        return Floor(float(np.sqrt(np.average(square, weights=weight))), "sidecar")
    return hold_floor(recordings)


def hold_floor(recordings: list[Recording]) -> Floor:
    """The floor from the scatter in holds alone."""
    variances = [v for recording in recordings for v in _hold_variances(recording)]
    if len(variances) >= LEAST_HOLDS:
        return Floor(float(np.sqrt(np.median(variances))), "holds")
    return Floor(None, "unknown")


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


def _hold_variances(recording: Recording) -> list[float]:
    """Variance of the distance (mm^2), mean over key points, in each hold's second half."""
    if recording.kind == "settled":
        return []
    signal = recording.measured if recording.commanded is None else recording.commanded
    span = np.ptp(signal, axis=0)
    still = (np.abs(np.diff(signal, axis=0)) <= 1e-3 * np.where(span > 0, span, 1)).all(1)
    still &= np.diff(recording.run) == 0
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]])))
    answer = []
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        begin = (begin + end + 1) // 2
        time = recording.t_s[begin : end + 1]
        if len(time) >= LEAST_HOLD_ROWS and time[-1] - time[0] >= LEAST_HOLD_S:
            value = _scatter(time, recording.key_points_mm[begin : end + 1])
            if value is not None:
                answer.append(value)
    return answer


def _scatter(time: np.ndarray, points: np.ndarray) -> float | None:
    """Mean over key points of the summed variance (mm^2) about a straight line in time."""
    flat = points.reshape(len(points), -1)
    flat = flat[:, ~np.isnan(flat).any(0)]
    if flat.shape[1] < 3:
        return None
    design = np.stack([np.ones_like(time), time - time.mean()], 1)
    rest = flat - design @ np.linalg.lstsq(design, flat, rcond=None)[0]
    return float(3 * rest.var(axis=0, ddof=2).mean())
