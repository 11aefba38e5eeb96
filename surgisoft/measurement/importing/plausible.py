"""Notes of an import about a set-up that cannot be right, as far as no model is needed for it."""

import itertools

import numpy as np

from surgisoft.measurement.recordings import Recording
from surgisoft.measurement.recordings.clock import (
    USUAL_S,
    follows_motion,
    likeliest,
    usual,
    usual_step_s,
)
from surgisoft.measurement.recordings.columns import MM_PER
from surgisoft.measurement.units import SECONDS_PER

LARGEST_RATIO = 2.0
"""Key points that span more than this multiple of the arm's length are in a wrong unit."""
LEAST_RATIO = 0.2
"""Key points that span less than this share of the arm's length are in a wrong unit: trackers may
cover a part of the arm only."""
UNIT_TOLERANCE = 0.5
"""Largest difference, in the logarithm of the length, of a unit that is proposed."""
BASE_MOTION = 3.0
"""Key points are taken for reversed where the first moves so many times more than the last."""


def plausibility_notes(
    recording: Recording, unit: str | None, time_unit: str | None = None
) -> list[str]:
    """Contradictions to the arm's stated length, the order base to tip and a moving arm's rows.

    unit: of positions; time_unit: of the column of times, None where the map states a rate.
    """
    return [*_length(recording, unit), *_order(recording), *_step(recording, time_unit)]


def _step(recording: Recording, time_unit: str | None) -> list[str]:
    """A note where rows are too far apart, or too near, to follow a moving arm."""
    step = usual_step_s([recording])
    if step is None or usual(step):
        return []
    if not follows_motion([recording.measured[run] for run in recording.runs]):
        return []
    low, high = USUAL_S
    text = f"one row each {step:.3g} s, expected {low:g} to {high:g} s of an arm that moves"
    by = SECONDS_PER.get(time_unit or "")
    others = {} if by is None else {u: s / by for u, s in SECONDS_PER.items() if u != time_unit}
    likely = likeliest(step, others.values())
    named = next((u for u, factor in others.items() if factor == likely), None)
    advice = "check rate_hz, column and unit in [time]"
    if named is not None:
        advice = f'if the times are in {named}, set unit = "{named}" in [time]'
    slow = ' (steady-state samples: kind = "settled" in [recording])' if step > high else ""
    return [f"{text}: {advice}{slow}"]


def _length(recording: Recording, unit: str | None) -> list[str]:
    """A note where the key points span far more or less than the arm's length."""
    stated, points = recording.arm.length_mm, recording.key_points_mm
    if stated is None or recording.key_points < 2:
        return []
    links = np.linalg.norm(np.diff(points, axis=1), axis=2)
    known = ~np.isnan(links).any(axis=1)
    if not known.any():
        return []
    span = float(np.median(links[known].sum(axis=1)))
    if LEAST_RATIO * stated <= span <= LARGEST_RATIO * stated:
        return []
    text = f"the key points span {span:.3g} mm, the arm is {stated:.3g} mm long"
    ratio = stated / max(span, 1e-12)
    by = MM_PER.get(unit or "mm", 1.0)
    known_units = {name: mm / by for name, mm in MM_PER.items() if name != unit}
    best = min(known_units, key=lambda name: abs(np.log(known_units[name] / ratio)))
    if abs(np.log(known_units[best] / ratio)) > UNIT_TOLERANCE:
        return [f"{text}: check unit and scale in [key_points] and length_mm in [arm]"]
    return [f'{text}: if the positions are in {best}, set unit = "{best}" in [key_points]']


def _order(recording: Recording) -> list[str]:
    """A note where the key points move less and less from the first to the last."""
    motion = []
    for k in range(recording.key_points):
        point = recording.key_points_mm[:, k]
        seen = ~np.isnan(point[:, 0])  # missing ones are missing as a whole
        if seen.sum() < 2:
            return []
        motion.append(float(np.sqrt(sum(axis[seen].var() for axis in point.T))))
    falls = all(a > b for a, b in itertools.pairwise(motion))
    if len(motion) < 3 or not falls or motion[0] < BASE_MOTION * motion[-1]:
        return []
    order = [*range(recording.key_points)][::-1]
    return [
        f"key point k0 moves by {motion[0]:.3g} mm and the last one by {motion[-1]:.3g} mm (rms), "
        f"expected base to tip: if they are in reverse order, set order = {order} in [key_points]"
    ]
