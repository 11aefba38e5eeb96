"""Inside or outside: of a closed surface, and of the solid that a self-intersecting one encloses.

`winding_numbers` sums solid angles and serves points anywhere. `buried` counts crossings along rays
and serves points on the surface itself: sheets inside the solid that no laser beam can reach.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from surgisoft.compiled import compiled
from surgisoft.scene import frames
from surgisoft.scene.mesh import Mesh, kept
from surgisoft.scene.rays import EmbreeSurface


@compiled
def _solid_angles(points, triangles, out):
    """Sum over triangles of their signed solid angle at each point, in full spheres.

    tan(omega / 2) = det(a, b, c) / (abc + (a.b) c + (b.c) a + (c.a) b): Van Oosterom & Strackee
    1983, equation 8.
    """
    for i in range(points.shape[0]):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        total = 0.0
        for f in range(triangles.shape[0]):
            ax, ay, az = triangles[f, 0, 0] - px, triangles[f, 0, 1] - py, triangles[f, 0, 2] - pz
            bx, by, bz = triangles[f, 1, 0] - px, triangles[f, 1, 1] - py, triangles[f, 1, 2] - pz
            cx, cy, cz = triangles[f, 2, 0] - px, triangles[f, 2, 1] - py, triangles[f, 2, 2] - pz
            la = math.sqrt(ax * ax + ay * ay + az * az)
            lb = math.sqrt(bx * bx + by * by + bz * bz)
            lc = math.sqrt(cx * cx + cy * cy + cz * cz)
            det = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
            below = (
                la * lb * lc
                + (ax * bx + ay * by + az * bz) * lc
                + (bx * cx + by * cy + bz * cz) * la
                + (cx * ax + cy * ay + cz * az) * lb
            )
            total += math.atan2(det, below)
        out[i] = total / (2.0 * math.pi)


def winding_numbers(mesh: Mesh, points_mm: np.ndarray) -> np.ndarray:
    """Winding numbers (N,) of the mesh about points (N, 3) mm, its own frame: 1 inside, 0 outside.

    The cost grows with points times faces. The result is exact to rounding for any closed mesh,
    also where several closed surfaces overlap.
    """
    points = np.ascontiguousarray(points_mm, dtype=np.float64)
    out = np.empty(len(points))
    _solid_angles(points, mesh.triangles_mm, out)
    return out


ABOVE_MM = 1e-3
"""Rays start this far outside the surface, and this far behind each crossing (mm)."""
TILTS = ((0.0, 0.0), (0.23, 0.11), (-0.17, 0.19))
"""Slopes of the three rays to the normal. Two must agree, because one may meet an edge."""
MOST_CROSSINGS = 64
"""A ray is not followed beyond this many crossings."""


def buried(mesh: Mesh, points_mm: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(N,) bool: whether the outer side of surface points (N, 3) mm, with outward unit normals
    (N, 3), lies inside the solid; the mesh's own frame.

    The winding number just outside the sheet, counted along rays to the outside: sheets left minus
    sheets entered (Haines 1994, "Point in polygon strategies", Graphics Gems IV, in space). On a
    surface that does not cross itself it is 0 everywhere.
    """
    if not len(points_mm):
        return np.zeros(0, dtype=bool)
    surface = EmbreeSurface(mesh)
    origins = points_mm + ABOVE_MM * normals
    turn = frames.rotation_from_z(normals)
    votes = np.zeros(len(points_mm), dtype=int)
    for x, y in TILTS:
        aims = frames.normalise(normals + x * turn[:, :, 0] + y * turn[:, :, 1])
        votes += _winding_along(mesh, surface, origins, aims) > 0
    return votes >= 2


def _winding_along(mesh: Mesh, surface: EmbreeSurface, origins, aims) -> np.ndarray:
    """(N,) sheets left minus sheets entered by rays (N, 3) from inside the mesh's bounds."""
    span = 2.0 * float(np.ptp(mesh.bounds_mm, axis=0).sum()) + 1.0
    count, alive = np.zeros(len(origins), dtype=int), np.arange(len(origins))
    here = np.array(origins)
    for _ in range(MOST_CROSSINGS):
        distance, face = surface.first_hit(here, aims[alive], span)
        met = face >= 0
        alive, distance, face = alive[met], distance[met], face[met]
        if not len(alive):
            break
        along = frames.dot(mesh.face_normals[face], aims[alive])
        count[alive] += np.where(along > 0.0, 1, -1)
        here = here[met] + (distance + ABOVE_MM)[:, None] * aims[alive]
    return count


AIMS = ((0.31, 0.47, 0.83), (-0.71, 0.23, 0.67))
"""Directions of the rays of `enclosed`, which are cast both ways; along no axis, since faces and
edges often are."""
NEAR_MM = 10.0 * ABOVE_MM
"""A ray that meets the surface nearer than this says nothing (mm): the point may lie on it."""
FEW_PRODUCTS = 1_000_000
"""Points times faces up to which winding numbers are summed at once, in some 60 ms."""


def enclosed(mesh: Mesh, points_mm: np.ndarray, surface: Callable[[], EmbreeSurface]) -> np.ndarray:
    """(N,) bool: whether a closed mesh winds round points (N, 3) mm, in its own frame, either way.

    Of many points and faces crossings along rays are counted, and winding numbers are summed where
    the rays do not agree. surface: gives the mesh for rays, where these are needed.
    """
    if len(points_mm) * len(mesh.faces) <= FEW_PRODUCTS:
        return np.abs(winding_numbers(mesh, points_mm)) > 0.5
    low, high = mesh.bounds_mm
    near = np.flatnonzero(((points_mm >= low) & (points_mm <= high)).all(axis=1))
    inside, points = np.zeros(len(points_mm), dtype=bool), points_mm[near].astype(np.float64)
    if not len(near):
        return inside
    span, counts = 2.0 * float(np.ptp(mesh.bounds_mm, axis=0).sum()) + 1.0, []
    sure = np.ones(len(near), dtype=bool)
    for aim in (sign * np.array(aim) for aim in AIMS for sign in (1.0, -1.0)):
        aims = np.broadcast_to(aim / np.linalg.norm(aim), points.shape)
        counts.append(_winding_along(mesh, surface(), points, aims))
        sure &= surface().first_hit(points, aims, span)[0] > NEAR_MM
    sure &= np.ptp(counts, axis=0) == 0
    inside[near] = counts[0] != 0
    unsure = near[~sure]
    inside[unsure] = np.abs(winding_numbers(mesh, points_mm[unsure])) > 0.5
    return inside


@kept
def buried_faces(mesh: Mesh) -> int:
    """How many faces have their middle inside the mesh's own solid."""
    return int(buried(mesh, mesh.triangles_mm.mean(axis=1), mesh.face_normals).sum())


def points_inside(mesh: Mesh, points_mm: np.ndarray) -> np.ndarray:
    """(N,) bool: whether a closed mesh encloses points (N, 3) mm, its own frame; open: False."""
    inside = np.zeros(len(points_mm), dtype=bool)
    if not mesh.is_watertight:
        return inside
    low, high = mesh.bounds_mm
    near = ((points_mm >= low) & (points_mm <= high)).all(axis=1)
    inside[near] = winding_numbers(mesh, points_mm[near]) > 0.5
    return inside
