"""Noise of measured key points: what a lab states, or the scatter while the arm is held."""

import numpy as np

from surgisoft.measurement.recordings import Recording

LEAST_HOLD_S = 1.0
"""Shortest hold whose scatter is used as noise, s."""
LEAST_HOLD_ROWS = 8
"""Fewest rows of such a hold."""
LEAST_HOLDS = 5
"""Fewest holds that give an estimate."""


def known_noise(recordings: list[Recording]) -> float | None:
    """Standard deviation of one coordinate of a key point, mm; None where nothing shows it.

    What the lab states, else the scatter in holds.
    """
    stated = stated_noise(recordings)
    return hold_noise(recordings) if stated is None else stated


def stated_noise(recordings: list[Recording]) -> float | None:
    """Standard deviation of one coordinate of a key point, mm; None where one does not state it."""
    stated = [recording.noise_mm for recording in recordings]
    known = [noise_mm for noise_mm in stated if noise_mm is not None]
    if len(known) < len(stated):
        return None
    square = [noise_mm**2 for noise_mm in known]
    return float(np.sqrt(np.average(square, weights=[r.samples for r in recordings])))


def hold_noise(recordings: list[Recording]) -> float | None:
    """Standard deviation of one coordinate of a key point in holds, mm; None for too few holds.

    The scatter (after a straight line is taken out) misses noise slower than a hold.
    """
    variances = [v for recording in recordings for v in _hold_variances(recording)]
    return float(np.sqrt(np.median(variances))) if len(variances) >= LEAST_HOLDS else None


def _hold_variances(recording: Recording) -> list[float]:
    """Variance of a coordinate (mm^2), mean over key points, in each hold's second half."""
    if recording.kind == "settled":
        return []
    signal = recording.measured if recording.commanded is None else recording.commanded
    span = np.ptp(signal, axis=0)
    still = (np.abs(np.diff(signal, axis=0)) <= 1e-3 * np.where(span > 0, span, 1)).all(1)
    still &= np.diff(recording.run) == 0
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]])))
    found = []
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        begin = (begin + end + 1) // 2
        time = recording.t_s[begin : end + 1]
        if len(time) >= LEAST_HOLD_ROWS and time[-1] - time[0] >= LEAST_HOLD_S:
            value = _scatter(time, recording.key_points_mm[begin : end + 1])
            if value is not None:
                found.append(value)
    return found


def _scatter(time: np.ndarray, points: np.ndarray) -> float | None:
    """Mean over key points of a coordinate's variance (mm^2) about a straight line in time."""
    flat = points.reshape(len(points), -1)
    flat = flat[:, ~np.isnan(flat).any(0)]
    if flat.shape[1] < 3:
        return None
    design = np.stack([np.ones_like(time), time - time.mean()], 1)
    rest = flat - design @ np.linalg.lstsq(design, flat, rcond=None)[0]
    return float(rest.var(axis=0, ddof=2).mean())
