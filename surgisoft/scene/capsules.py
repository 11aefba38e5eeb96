"""The geometric model of an arm: a centreline with a radius, which is a chain of capsules.

Closed forms for capsules against rays and against each other, batched, for numpy and torch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from surgisoft.errors import InputError
from surgisoft.scene.frames import Array, dot, norm, normalise

HORIZON_MM = 60.0
"""Clearances saturate at this value in both engines (mm)."""
LONGEST_SEGMENT_MM = 6.0
"""Longer segments of a centreline are divided before the distance to the bodies is taken (mm)."""
MOST_PARTS = 256
"""No segment is cut into more parts than this."""


@dataclass(frozen=True, eq=False)
class ArmShape:
    """The shape of one arm at one moment: a chain of K - 1 capsules with round ends."""

    centreline_mm: np.ndarray
    """(K, 3) float64, mm, world frame, base to tip."""
    radius_mm: float
    """Radius of the body (mm)."""

    def __post_init__(self):
        points = np.array(self.centreline_mm, dtype=np.float64)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2:
            raise InputError(f"arm centreline has shape {points.shape}: expected (K, 3), K >= 2")
        if not np.isfinite(points).all():
            raise InputError("arm centreline is not finite: the arm model diverged")
        if not (math.isfinite(self.radius_mm) and self.radius_mm > 0.0):
            raise InputError(f"arm radius is {self.radius_mm} mm: expected a positive length")
        points.setflags(write=False)
        object.__setattr__(self, "centreline_mm", points)


@dataclass(frozen=True, eq=False)
class BatchClearance:
    """Signed clearances (mm) of B environments, as `collision.Clearance` defines them."""

    bodies_mm: torch.Tensor
    """(B, A, N) arm by body, in the order of the scene's arms and bodies."""
    arms_mm: torch.Tensor
    """(B, A (A - 1) / 2) each pair of arms once, in the order of itertools.combinations."""
    self_mm: torch.Tensor
    """(B, A) each arm against itself."""

    @property
    def least_mm(self) -> torch.Tensor:
        """(B,) the smallest against bodies and other arms, mm."""
        return torch.cat((self.bodies_mm.flatten(1), self.arms_mm), 1).amin(1)

    @property
    def collides(self) -> torch.Tensor:
        """(B,) bool: any arm overlaps a body, the other arm or itself."""
        parts = (self.bodies_mm.flatten(1), self.arms_mm, self.self_mm)
        return (torch.cat(parts, 1) < 0.0).any(1)


def self_contact_gap_mm(radius_mm: float) -> float:
    """Arc length (mm) between two parts of one arm beyond which an overlap counts as contact.

    A body of radius r cannot bend tighter than a circle of radius r without folding its own inner
    side, and an arc of length s on such a curve has a chord of at least 2 r sin(s / 2 r) (Schur
    1921). At s = pi r that chord is 2 r: closer than that is contact, not mere neighbourhood.
    """
    return math.pi * radius_mm


def arc_lengths(centreline_mm: Array) -> Array:
    """(..., K) mm along the polyline (..., K, 3), zero at the base."""
    steps = norm(centreline_mm[..., 1:, :] - centreline_mm[..., :-1, :])
    lib = torch if isinstance(steps, torch.Tensor) else np
    return lib.concatenate((lib.zeros_like(steps[..., :1]), lib.cumsum(steps, -1)), -1)


def folding_pairs(centreline_mm: Array, radius_mm: float) -> Array:
    """(..., K-1, K-1) bool: segment pairs i < j far enough apart along the arm to touch."""
    arc = arc_lengths(centreline_mm)
    gap = arc[..., None, :-1] - arc[..., 1:, None]
    return gap >= self_contact_gap_mm(radius_mm)


def ray_free_segments(centreline_mm: Array, radius_mm: float) -> Array:
    """(..., K-1) bool: segments far enough from the tip to block the beam that leaves it."""
    arc = arc_lengths(centreline_mm)
    return arc[..., -1:] - arc[..., 1:] >= self_contact_gap_mm(radius_mm)


def segment_distance(p1: Array, q1: Array, p2: Array, q2: Array) -> Array:
    """Distance (...) between segments p1 q1 and p2 q2, each (..., 3) mm, broadcast.

    Ericson, Real-Time Collision Detection (2005), section 5.1.9; segments of length zero allowed.
    The first s is that of the two infinite lines (0 if parallel). One exact line search in each of
    t, s, t then meets the bounds of both segments.
    """
    lib = torch if isinstance(p1, torch.Tensor) else np
    d1, d2, r = q1 - p1, q2 - p2, p1 - p2
    a, e, f = dot(d1, d1), dot(d2, d2), dot(d2, r)
    b, c = dot(d1, d2), dot(d1, r)
    a_safe, e_safe = lib.where(a > 0, a, 1.0), lib.where(e > 0, e, 1.0)
    denominator = a * e - b * b
    crossing = denominator > 4 * lib.finfo(p1.dtype).eps * a * e
    s = lib.where(crossing, (b * f - c * e) / lib.where(crossing, denominator, 1.0), 0.0)
    t = ((b * s.clip(0, 1) + f) / e_safe).clip(0, 1)
    s = ((b * t - c) / a_safe).clip(0, 1)
    t = ((b * s + f) / e_safe).clip(0, 1)
    return norm(r + s[..., None] * d1 - t[..., None] * d2)


def ray_capsule(origin: Array, direction: Array, a: Array, b: Array, radius_mm: float) -> Array:
    """Distance (...) mm along a unit ray to the capsule a b of radius_mm; inf for a miss.

    Origin, direction, a, b: (..., 3) mm, broadcast. Zero when the origin lies inside. The entry
    is the nearest of the three surfaces' own entries; each is taken from the point of closest
    approach, which keeps float32 sound (Haines et al. 2019, Ray Tracing Gems, chapter 7).
    """
    lib = torch if isinstance(origin, torch.Tensor) else np
    far = math.inf
    axis = b - a
    length = norm(axis)
    unit = axis / lib.where(length > 0, length, 1.0)[..., None]
    from_a = origin - a
    along = dot(direction, unit)
    height = dot(from_a, unit)
    flat_d = direction - along[..., None] * unit
    flat_o = from_a - height[..., None] * unit
    slope = dot(flat_d, flat_d)
    slanted = slope > 1e-12
    safe = lib.where(slanted, slope, 1.0)
    t_near = -dot(flat_o, flat_d) / safe
    miss = flat_o + t_near[..., None] * flat_d
    half = radius_mm**2 - dot(miss, miss)
    t_wall = t_near - lib.sqrt(half.clip(0) / safe)
    y = height + t_wall * along
    on_wall = slanted & (half >= 0) & (t_wall >= 0) & (y >= 0) & (y <= length)
    best = lib.where(on_wall, t_wall, far)
    for centre in (from_a, origin - b):
        t_ball = -dot(centre, direction)
        off = centre + t_ball[..., None] * direction
        half = radius_mm**2 - dot(off, off)
        t_cap = t_ball - lib.sqrt(half.clip(0))
        best = lib.where((half >= 0) & (t_cap >= 0) & (t_cap < best), t_cap, best)
    within = height.clip(0)
    within = lib.where(within < length, within, length)
    inside = norm(from_a - within[..., None] * unit) <= radius_mm
    return lib.where(inside, 0.0, best)


def ray_chain(
    origin: Array,
    direction: Array,
    centreline_mm: Array,
    radius_mm: float,
    free: Array | None = None,
) -> tuple[Array, Array]:
    """First hit of unit rays (..., 3) on an arm's centreline (..., K, 3): distance, segment.

    Returns (...) mm, inf for a miss, and (...) the segment's index. Segments where `free`
    (..., K-1) bool is False are ignored (those near the tip that the beam leaves).
    """
    lib = torch if isinstance(origin, torch.Tensor) else np
    a, b = centreline_mm[..., :-1, :], centreline_mm[..., 1:, :]
    t = ray_capsule(origin[..., None, :], direction[..., None, :], a, b, radius_mm)
    if free is not None:
        t = lib.where(free, t, math.inf)
    segment = t.argmin(-1)
    return lib.amin(t, -1), segment


def chain_normal(point_mm: Array, centreline_mm: Array, segment: Array) -> Array:
    """Outward unit normals (..., 3) of a chain at surface points (..., 3) on given segments (...).

    The direction from the segment's nearest point; centreline (..., K, 3) mm, segment int.
    """
    start = segment[..., None, None]
    if isinstance(point_mm, torch.Tensor):
        start = start.expand(*segment.shape, 1, 3)
        take: Callable[..., Any] = torch.take_along_dim
    else:
        take = np.take_along_axis
    a = take(centreline_mm, start, -2)[..., 0, :]
    b = take(centreline_mm, start + 1, -2)[..., 0, :]
    axis = b - a
    share = dot(point_mm - a, axis) / (dot(axis, axis) + 1e-30)
    return normalise(point_mm - a - share.clip(0, 1)[..., None] * axis)
