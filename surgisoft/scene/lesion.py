"""The lesion's ring: a circle laid on the organ's surface, and where a lesion can lie at all."""

from dataclasses import dataclass

import numpy as np

from surgisoft.errors import InputError
from surgisoft.scene import frames
from surgisoft.scene.mesh import Mesh
from surgisoft.scene.spec import LesionSpec

RING_POINTS = 72
"""Points on a ring unless asked otherwise: every 5 degrees, 0.87 mm apart on 20 mm."""
STEEPEST = 0.25
"""Least cosine between the lesion's and a ring point's normal (75.5 degrees)."""
ON_SURFACE_MM = 0.5
"""A lesion's centre or path farther than this from the surface is an error (mm)."""


@dataclass(frozen=True, eq=False)
class Ring:
    """A closed path on the organ, world frame."""

    centre_mm: np.ndarray
    """(3,) centre of the lesion on the surface."""
    normal: np.ndarray
    """(3,) mean outward unit normal of the lesion's patch."""
    points_mm: np.ndarray
    """(M, 3) points of the path, in order; the last is followed by the first."""
    normals: np.ndarray
    """(M, 3) outward unit normals at the points."""
    faces: np.ndarray
    """(M,) face of the organ's mesh under each point."""


def nearest_on_surface(mesh: Mesh, points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest surface points (N, 3) mm and their faces (N,) to points (N, 3) mm, mesh's frame."""
    from surgisoft.scene.bvh import build_tree

    points = np.atleast_2d(np.asarray(points_mm, dtype=np.float64))
    _, faces = build_tree(mesh).nearest(points)
    return closest_in_triangles(points, mesh.triangles_mm[faces]), faces


def closest_in_triangles(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """Nearest point (N, 3) of each triangle (N, 3, 3) to each point (N, 3).

    The foot of the perpendicular where it falls inside, else the nearest of the three edges' own.
    """
    a, b, c = np.moveaxis(triangles, 1, 0)
    normal = np.cross(b - a, c - a)
    squared = np.maximum(frames.dot(normal, normal), 1e-300)
    foot = points - (frames.dot(points - a, normal) / squared)[:, None] * normal
    best = np.full(len(points), np.inf)
    result = np.array(a)
    inside = np.ones(len(points), dtype=bool)
    for start, stop in ((a, b), (b, c), (c, a)):
        edge = stop - start
        inside &= frames.dot(np.cross(edge, foot - start), normal) >= 0.0
        share = frames.dot(points - start, edge) / np.maximum(frames.dot(edge, edge), 1e-300)
        here = start + np.clip(share, 0.0, 1.0)[:, None] * edge
        squared_distance = frames.dot(points - here, points - here)
        nearer = squared_distance < best
        result[nearer], best[nearer] = here[nearer], squared_distance[nearer]
    inside &= frames.dot(normal, normal) > 0.0
    result[inside] = foot[inside]
    return result


def patch_normal(mesh: Mesh, centre_mm: np.ndarray, face: int, radius_mm: float) -> np.ndarray:
    """(3,) mean outward normal, by area, of the faces within `radius_mm` that face like `face`."""
    middles = mesh.triangles_mm.mean(axis=1)
    reach = np.linalg.norm(middles - centre_mm, axis=1) <= radius_mm
    alike = mesh.face_normals @ mesh.face_normals[face] > 0.0
    weights = np.where(reach & alike, mesh.face_areas_mm2, 0.0)
    weights[face] = max(weights[face], mesh.face_areas_mm2[face], 1e-12)
    return frames.normalise(weights @ mesh.face_normals)


def circle_on(
    mesh: Mesh, centre_mm: np.ndarray, face: int, diameter_mm: float, count: int = RING_POINTS
) -> Ring | None:
    """The circle of `diameter_mm` about a surface point, laid down along the patch's normal.

    Each point of the flat circle drops to the surface nearest to the circle's plane that faces its
    way. None where it hangs over an edge, a face is steeper than 75 degrees, or the path jumps.
    """
    radius = 0.5 * diameter_mm
    normal = patch_normal(mesh, centre_mm, face, radius)
    side = frames.rotation_from_z(normal)
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    flat = centre_mm + radius * (
        np.cos(angle)[:, None] * side[:, 0] + np.sin(angle)[:, None] * side[:, 1]
    )
    heights, faces = _drop(mesh, flat, centre_mm, normal, diameter_mm)
    if np.any(faces < 0):
        return None
    points = flat + heights[:, None] * normal
    normals = mesh.face_normals[faces]
    steps = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    chord = diameter_mm * np.sin(np.pi / count)
    if steps.max() > 4.0 * chord or (normals @ normal).min() < STEEPEST:
        return None
    return Ring(np.asarray(centre_mm), normal, points, normals, faces)


def _drop(mesh, flat, centre, normal, diameter):
    """Height (M,) over the plane and face (M,) where lines along the normal meet the surface."""
    corners = mesh.triangles_mm
    local = (corners - centre) @ frames.rotation_from_z(normal)
    plane = (flat - centre) @ frames.rotation_from_z(normal)
    reach = 0.51 * diameter
    low, high = local[..., :2].min(axis=1), local[..., :2].max(axis=1)
    near = np.flatnonzero(((low <= reach) & (high >= -reach)).all(axis=1))
    near = near[(mesh.face_normals[near] @ normal) > 0.0]
    a, b, c = np.moveaxis(local[near, :, :2], 1, 0)
    z = local[near, :, 2]
    heights, faces = np.zeros(len(flat)), np.full(len(flat), -1)
    area = _cross2(b - a, c - a)
    for i, point in enumerate(plane[:, :2]):
        u = _cross2(b - point, c - point)
        v = _cross2(c - point, a - point)
        w = area - u - v
        slack = -1e-9 * area
        hit = np.flatnonzero((u >= slack) & (v >= slack) & (w >= slack) & (area > 0.0))
        if not len(hit):
            continue
        height = (u[hit] * z[hit, 0] + v[hit] * z[hit, 1] + w[hit] * z[hit, 2]) / area[hit]
        lowest = np.argmin(np.abs(height))
        heights[i], faces[i] = height[lowest], near[hit[lowest]]
    return heights, faces


def _cross2(p, q):
    """Cross product of plane vectors (..., 2): (...)."""
    return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]


def lesion_ring(mesh: Mesh, lesion: LesionSpec, count: int = RING_POINTS) -> Ring:
    """The lesion's path on the organ's mesh (world frame); an InputError where it cannot lie."""
    centre = np.asarray(lesion.centre_mm)
    on_surface, face = nearest_on_surface(mesh, centre[None])
    off = float(np.linalg.norm(on_surface[0] - centre))
    if off > ON_SURFACE_MM:
        raise InputError(
            f"lesion.centre_mm {tuple(centre.round(3).tolist())} lies {off:.3g} mm off the surface "
            f"of '{lesion.body}'; expected at most {ON_SURFACE_MM} mm; the nearest point is "
            f"{tuple(on_surface[0].round(3).tolist())}"
        )
    if lesion.path_mm:
        return _path_ring(mesh, lesion, on_surface[0], int(face[0]), count)
    ring = circle_on(mesh, on_surface[0], int(face[0]), lesion.diameter_mm, count)
    if ring is None:
        raise InputError(
            f"a ring of {lesion.diameter_mm:g} mm does not lie on '{lesion.body}' about "
            f"{tuple(centre.round(3).tolist())}: it hangs over an edge; choose a flatter place or "
            "a smaller diameter"
        )
    return ring


def path_slack_mm(lesion: LesionSpec) -> float:
    """How far the lesion's own path may leave the surface (mm)."""
    return max(ON_SURFACE_MM, 0.1 * lesion.diameter_mm)


def path_off_mm(mesh: Mesh, lesion: LesionSpec, count: int = RING_POINTS) -> float:
    """How far the lesion's own path, resampled, leaves the mesh's surface (world frame, mm)."""
    path = _resampled(lesion, count)
    points, _ = nearest_on_surface(mesh, path)
    return float(np.linalg.norm(points - path, axis=1).max())


def _resampled(lesion: LesionSpec, count: int) -> np.ndarray:
    """(count, 3) points evenly along the lesion's own closed path (mm)."""
    corners = np.array([*lesion.path_mm, lesion.path_mm[0]])
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))]
    places = np.linspace(0.0, along[-1], count, endpoint=False)
    return np.stack([np.interp(places, along, axis) for axis in corners.T], axis=1)


def _path_ring(mesh, lesion, centre, face, count) -> Ring:
    """The user's own path, evenly resampled along its length and laid on the surface."""
    path = _resampled(lesion, count)
    points, faces = nearest_on_surface(mesh, path)
    off = np.linalg.norm(points - path, axis=1)
    if off.max() > path_slack_mm(lesion):
        raise InputError(
            f"lesion.path_mm leaves the surface of '{lesion.body}' by {off.max():.3g} mm; "
            "expected points on the surface, close enough together to follow it"
        )
    normal = patch_normal(mesh, centre, face, 0.5 * lesion.diameter_mm)
    return Ring(centre, normal, points, mesh.face_normals[faces], faces)
