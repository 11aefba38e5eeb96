"""Where a closed path on a surface crosses itself: such a path has no inside and no outside."""

from __future__ import annotations

import numpy as np

from surgisoft.scene import frames

SAMPLED_MM = 0.2
"""Spacing of the points of a path in which its crossings are looked for (mm)."""
SMALLEST_LOOP_MM = 1.0
"""A loop of a shorter length is a slip of the hand that drew the path (mm); its area is below a
tenth of a square millimetre."""
LEAST_SINE = 0.05
"""Sine of the angle (3 degrees) from which two stretches cross; below it they run along each
other."""
ALONG_MM = 1e-3
"""Distance up to which two stretches in one direction are the same stretch, passed twice (mm)."""
END_SLACK = 0.01
"""Share of a step by which two steps of the path may miss each other at their ends."""


def crossing_mm(points_mm: np.ndarray, normals: np.ndarray) -> np.ndarray | None:
    """(3,) mm: where a closed path crosses or touches itself, or is passed twice; None: nowhere.

    points_mm (N, 3) mm: points on a surface about SAMPLED_MM apart, the last followed by the first;
    normals (N, 3): the surface's unit normals there. Two steps cross where they do so as seen along
    the normal and are a step apart at most, so a path around a tube does not cross itself.
    """
    from scipy.spatial import cKDTree

    step = np.roll(points_mm, -1, axis=0) - points_mm
    length = frames.norm(step)
    middle = points_mm + 0.5 * step
    pairs = cKDTree(middle).query_pairs(
        1.01 * float(length.max(initial=0.0)), output_type="ndarray"
    )
    arc = np.cumsum(length) - 0.5 * length
    between = np.abs(arc[pairs[:, 1]] - arc[pairs[:, 0]])
    loop = np.minimum(between, length.sum() - between)
    pairs = pairs[loop >= SMALLEST_LOOP_MM]
    pairs = pairs[(length[pairs] > 0.0).all(axis=1)]
    first, second = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].T
    up = normals[first]
    apart = points_mm[second] - points_mm[first]
    crossed = frames.dot(np.cross(step[first], step[second]), up)
    sine = crossed / (length[first] * length[second])
    slanted = np.abs(sine) >= LEAST_SINE
    safe = np.where(slanted, crossed, 1.0)
    shares = [frames.dot(np.cross(apart, step[other]), up) / safe for other in (second, first)]
    within = [(share >= -END_SLACK) & (share <= 1.0 + END_SLACK) for share in shares]
    meets = slanted & within[0] & within[1]
    alike = frames.dot(step[first], step[second]) > 0.0
    off = apart - (frames.dot(apart, step[first]) / length[first] ** 2)[:, None] * step[first]
    meets |= ~slanted & alike & (frames.norm(off) <= ALONG_MM)
    if not meets.any():
        return None
    found = int(np.argmax(meets))
    share = float(np.clip(shares[0][found], 0.0, 1.0)) if slanted[found] else 0.5
    return points_mm[first[found]] + share * step[first[found]]
