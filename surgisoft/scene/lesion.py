"""The lesion: its ring on the organ's surface, places for it, and random variations of it.

A ring is a circle that is laid on the surface, or the user's own path. `pointed_site`,
`directed_site` and `good_sites` choose a place for a new scene; `lesions_like` varies the lesion of
an existing one for training.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from surgisoft.errors import InputError
from surgisoft.scene import frames
from surgisoft.scene.bvh import tree_of
from surgisoft.scene.crossings import SAMPLED_MM, crossing_mm
from surgisoft.scene.mesh import Mesh
from surgisoft.scene.rays import EmbreeSurface
from surgisoft.scene.spec import LesionSpec

RING_POINTS = 72
"""Default number of ring points: every 5 degrees, 0.87 mm apart on a ring of 20 mm."""
STEEPEST = 0.25
"""Smallest cosine between the lesion's and a ring point's normal (75.5 degrees)."""
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
    points = np.atleast_2d(np.asarray(points_mm, dtype=np.float64))
    _, faces = tree_of(mesh).nearest(points)
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
    """(3,) area-weighted mean normal of the faces within `radius_mm` on the side of `face`."""
    middles = mesh.triangles_mm.mean(axis=1)
    reach = np.linalg.norm(middles - centre_mm, axis=1) <= radius_mm
    alike = mesh.face_normals @ mesh.face_normals[face] > 0.0
    weights = np.where(reach & alike, mesh.face_areas_mm2, 0.0)
    weights[face] = max(weights[face], mesh.face_areas_mm2[face], 1e-12)
    return frames.normalise(weights @ mesh.face_normals)


def circle_on(
    mesh: Mesh, centre_mm: np.ndarray, face: int, diameter_mm: float, count: int = RING_POINTS
) -> Ring | None:
    """The circle of `diameter_mm` about a surface point, projected along the patch's normal.

    Each point of the flat circle moves along the normal to the nearest surface that faces outwards.
    None if the circle extends over an edge, a face is steeper than 75 degrees, or the path jumps.
    """
    radius = 0.5 * diameter_mm
    normal = patch_normal(mesh, centre_mm, face, radius)
    side = frames.rotation_from_z(normal)
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    flat = centre_mm + radius * (
        np.cos(angle)[:, None] * side[:, 0] + np.sin(angle)[:, None] * side[:, 1]
    )
    heights, faces = dropped(mesh, flat, centre_mm, normal, diameter_mm)
    if np.any(faces < 0):
        return None
    points = flat + heights[:, None] * normal
    normals = mesh.face_normals[faces]
    steps = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    chord = diameter_mm * np.sin(np.pi / count)
    if steps.max() > 4.0 * chord or (normals @ normal).min() < STEEPEST:
        return None
    return Ring(np.asarray(centre_mm), normal, points, normals, faces)


MOST_PAIRS = 200_000
"""Pairs of a line and a face that are looked at together (a count): some ten megabytes."""


def dropped(
    mesh: Mesh, flat: np.ndarray, centre: np.ndarray, normal: np.ndarray, diameter: float
) -> tuple[np.ndarray, np.ndarray]:
    """Height (M,) mm over the plane and face (M,) where lines along the normal meet the surface.

    flat (M, 3) mm lies in the plane through centre (3,) across the unit normal (3,), within half of
    the diameter. Of several places the nearest to the plane counts; face -1 where there is none.
    """
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
    slack = -1e-9 * area
    block = max(1, MOST_PAIRS // max(1, len(near)))
    for begin in range(0, len(flat), block):
        point = plane[begin : begin + block, None, :2]
        u = _cross2(b - point, c - point)
        v = _cross2(c - point, a - point)
        w = area - u - v
        row, hit = np.nonzero((u >= slack) & (v >= slack) & (w >= slack) & (area > 0.0))
        u, v, w = (each[row, hit] for each in (u, v, w))
        height = (u * z[hit, 0] + v * z[hit, 1] + w * z[hit, 2]) / area[hit]
        order = np.lexsort((hit, np.abs(height), row))  # the lowest of each row first
        row, first = np.unique(row[order], return_index=True)
        lowest = order[first]
        heights[begin + row], faces[begin + row] = height[lowest], near[hit[lowest]]
    return heights, faces


def _cross2(p, q):
    """Cross product of plane vectors (..., 2): (...)."""
    return p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]


def lesion_ring(mesh: Mesh, lesion: LesionSpec, count: int = RING_POINTS) -> Ring:
    """The lesion's path on the organ's mesh (world frame); an InputError if it does not fit."""
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
            f"a ring of {lesion.diameter_mm:g} mm does not fit on '{lesion.body}' about "
            f"{tuple(centre.round(3).tolist())}: it extends over an edge; choose a flatter place "
            "or a smaller diameter"
        )
    return ring


def path_slack_mm(lesion: LesionSpec) -> float:
    """Largest distance of the user's own path from the surface that is accepted (mm)."""
    return max(ON_SURFACE_MM, 0.1 * lesion.diameter_mm)


def path_off_mm(mesh: Mesh, lesion: LesionSpec, count: int = RING_POINTS) -> float:
    """Largest distance of the user's own path, resampled, from the mesh's surface (mm)."""
    path = _resampled(lesion, count)
    points, _ = nearest_on_surface(mesh, path)
    return float(np.linalg.norm(points - path, axis=1).max())


def path_crossing_mm(mesh: Mesh, lesion: LesionSpec) -> np.ndarray | None:
    """(3,) mm: where the user's own path crosses itself on the mesh; see `crossing_mm`."""
    corners = np.array([*lesion.path_mm, lesion.path_mm[0]])
    length = float(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())
    count = max(3, math.ceil(length / SAMPLED_MM))
    points, faces = nearest_on_surface(mesh, _resampled(lesion, count))
    return crossing_mm(points, mesh.face_normals[faces])


def _resampled(lesion: LesionSpec, count: int) -> np.ndarray:
    """(count, 3) points, evenly spaced along the user's own closed path (mm)."""
    corners = np.array([*lesion.path_mm, lesion.path_mm[0]])
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(corners, axis=0), axis=1))]
    places = np.linspace(0.0, along[-1], count, endpoint=False)
    return np.stack([np.interp(places, along, axis) for axis in corners.T], axis=1)


def _path_ring(mesh, lesion, centre, face, count) -> Ring:
    """The user's own path, resampled evenly along its length and projected on the surface."""
    path = _resampled(lesion, count)
    points, faces = nearest_on_surface(mesh, path)
    off = np.linalg.norm(points - path, axis=1)
    if off.max() > path_slack_mm(lesion):
        raise InputError(
            f"lesion.path_mm leaves the surface of '{lesion.body}' by {off.max():.3g} mm; "
            "expected points on the surface, close enough together to follow it"
        )
    if (place := path_crossing_mm(mesh, lesion)) is not None:
        raise InputError(
            f"lesion.path_mm crosses itself near {tuple(place.round(3).tolist())} mm, so it has no "
            "inside; expected a loop without a crossing: leave out all loops but one"
        )
    normal = patch_normal(mesh, centre, face, 0.5 * lesion.diameter_mm)
    return Ring(centre, normal, points, mesh.face_normals[faces], faces)


TRIED = 400
"""Surface points sampled for the choice of a lesion."""
OPEN_CONE_RAD = np.radians(60.0)
"""Half angle of the cone above a place that should be open to the outside (rad)."""
SITES = 6
"""Number of places that are passed to the search for mounts."""

MOST_RINGS = 80
"""Most places, best first, at which a ring is tried."""
SITES_APART = 1.5
"""Smallest distance between two places, in diameters of the ring."""
OPEN_WEIGHT, FLAT_WEIGHT, TOP_WEIGHT = 2.0, 2.0, 0.7
"""Weights, chosen by hand, of a place's quality: openness, flatness (0 to 1), upward normal."""
QUICK_RING = 12
"""Ring points that are tried before the whole ring in the search for a diameter that fits."""
FAR_POINT_MM = 20.0
"""A given point farther than this from every surface is an error (mm) ..."""
SMALL_HOLE = 0.1
"""A hole up to this share of the ring's diameter is a flaw of the mesh. A wider one is an opening
of the organ (a vessel, a bowel), and the faces that close it are no tissue."""
FAR_POINT = 0.1
"""... unless it is within this share of the body's largest side."""


@dataclass(frozen=True, eq=False)
class OrganSurface:
    """A closed mesh on which a lesion may lie, but for the faces that close a hole of the file."""

    mesh: Mesh
    """Closed, wound outwards, world frame, mm."""
    hole_mm: np.ndarray
    """(F,) mm: width of the hole that a face closes, 0 for a face of the file."""

    @classmethod
    def whole(cls, mesh: Mesh) -> OrganSurface:
        """A mesh that had no hole."""
        return cls(mesh, np.zeros(len(mesh.faces)))

    def is_lid(self, faces: np.ndarray, diameter_mm: float) -> np.ndarray:
        """(N,) bool: faces (N,) that close an opening too wide to lie in a ring's path."""
        return self.hole_mm[faces] > SMALL_HOLE * diameter_mm


@dataclass(frozen=True, eq=False)
class Site:
    """A place for a lesion."""

    body: int
    """Which of the bodies."""
    point_mm: np.ndarray
    """(3,) on the surface."""
    ring: Ring
    """The ring about it."""
    moved_mm: float = 0.0
    """Distance from the point that the user gave (mm)."""


def pointed_site(
    bodies: list[OrganSurface], point_mm: np.ndarray, diameter_mm: float, given: str | None = None
) -> Site:
    """The site at the surface point, of any of these bodies, that is nearest to `point_mm` (3,).

    An InputError if no surface is near; `given` is the point as the user wrote it.
    """
    nearest = [nearest_on_surface(body.mesh, point_mm[None]) for body in bodies]
    away = [float(np.linalg.norm(points[0] - point_mm)) for points, _ in nearest]
    body = int(np.argmin(away))
    points, faces = nearest[body]
    most = max(FAR_POINT_MM, FAR_POINT * float(np.ptp(bodies[body].mesh.bounds_mm, axis=0).max()))
    if away[body] > most:
        given = given or f"the point {tuple(point_mm.round(3).tolist())} mm"
        raise InputError(
            f"{given} lies {away[body]:.4g} mm from the organ's surface; expected at most "
            f"{most:.4g} mm: give it in the first file's own frame and unit, or check --unit"
        )
    site = _with_ring(bodies, body, points[0], int(faces[0]), diameter_mm)
    return replace(site, moved_mm=away[body])


def directed_site(bodies: list[OrganSurface], direction: np.ndarray, diameter_mm: float) -> Site:
    """The site where a ray from outside along -direction (3,) meets the largest body.

    The ray runs through the middle of the body's bounding box. If it misses (a torus), the site is
    the surface point farthest out in that direction.
    """
    away = frames.normalise(np.asarray(direction, dtype=float))
    mesh = bodies[0].mesh
    middle = mesh.bounds_mm.mean(axis=0)
    far = float(np.ptp(mesh.bounds_mm, axis=0).sum())
    origin = middle + far * away
    distance, face = EmbreeSurface(mesh).first_hit(origin[None], -away[None], 2.0 * far)
    if face[0] >= 0:
        return _with_ring(bodies, 0, origin - distance[0] * away, int(face[0]), diameter_mm)
    outermost = mesh.vertices_mm[np.argmax(mesh.vertices_mm @ away)]
    points, faces = nearest_on_surface(mesh, outermost[None])
    return _with_ring(bodies, 0, points[0], int(faces[0]), diameter_mm)


def _with_ring(bodies, body, point, face, diameter_mm) -> Site:
    surface, place = bodies[body], tuple(point.round(1).tolist())
    ring = circle_on(surface.mesh, point, face, diameter_mm)
    under = np.array([face]) if ring is None else np.append(ring.faces, face)
    lids = under[surface.is_lid(under, diameter_mm)]
    if len(lids):
        raise InputError(
            f"a ring of {diameter_mm:g} mm at {place} mm lies on faces that the repair added to "
            f"close a hole {surface.hole_mm[lids].max():.3g} mm wide; the file has no surface "
            "there: choose another place or a smaller --diameter"
        )
    if ring is None:
        fits = _largest_fitting(surface.mesh, point, face, diameter_mm)
        advice = f"a ring of {fits:.0f} mm fits" if fits >= 1.0 else "no ring fits"
        raise InputError(
            f"a ring of {diameter_mm:g} mm does not fit on the surface at "
            f"{place} mm ({advice}); choose another place or --diameter"
        )
    return Site(body, point, ring)


def _largest_fitting(mesh, point, face, diameter_mm) -> float:
    """The largest of nineteen smaller diameters whose ring lies on the surface (mm); 0: none."""
    most = min(diameter_mm, float(np.ptp(mesh.bounds_mm, axis=0).max()))
    for share in np.linspace(0.95, 0.05, 19):
        fits = share * most
        fits = float(np.floor(fits)) if fits >= 1.0 else fits
        if circle_on(mesh, point, face, fits, QUICK_RING) is None:
            continue
        if circle_on(mesh, point, face, fits) is not None:
            return fits
    return 0.0


def good_sites(bodies: list[OrganSurface], diameter_mm: float) -> list[Site]:
    """Sites on the largest body that are open to the outside, flat and on top, best first.

    Points are sampled evenly over the surface, with a fixed seed. Openness is the fraction of
    a cone of rays that leave without touching any body. No place lies on faces that close an
    opening of the file.
    """
    surface, mesh = bodies[0], bodies[0].mesh
    points, faces = _drawn(mesh)
    tissue = ~surface.is_lid(faces, diameter_mm)
    points, faces = points[tissue], faces[tissue]
    normals = mesh.face_normals[faces]
    openness = _openness([body.mesh for body in bodies], points, normals)
    evenness = _evenness(mesh, points, normals, 0.5 * diameter_mm)
    quality = OPEN_WEIGHT * openness + FLAT_WEIGHT * evenness + TOP_WEIGHT * normals[:, 2]
    sites: list[Site] = []
    for i in np.argsort(-quality, kind="stable")[:MOST_RINGS]:
        apart = [float(np.linalg.norm(points[i] - site.point_mm)) for site in sites]
        if min(apart, default=np.inf) < SITES_APART * diameter_mm:
            continue
        ring = circle_on(mesh, points[i], int(faces[i]), diameter_mm)
        if ring is not None and not surface.is_lid(ring.faces, diameter_mm).any():
            sites.append(Site(0, points[i], ring))
        if len(sites) == SITES:
            break
    if not sites:
        size = np.ptp(mesh.bounds_mm, axis=0)
        best = np.argsort(-quality, kind="stable")[:SITES]
        fits = max(_largest_fitting(mesh, points[i], int(faces[i]), diameter_mm) for i in best)
        advice = f"a ring of {fits:g} mm fits" if fits else "no smaller one fits"
        raise InputError(
            f"no ring of {diameter_mm:g} mm fits on a body of "
            f"{' x '.join(f'{s:.3g}' for s in size)} mm ({advice}): it extends over an edge or the "
            "surface is too rough; check --unit, or give a smaller --diameter"
        )
    return sites


def _drawn(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """TRIED surface points (T, 3) mm and their faces, evenly distributed over the area."""
    rng = np.random.default_rng(0)
    share = np.cumsum(mesh.face_areas_mm2)
    picks = (np.arange(TRIED) + rng.random(TRIED)) / TRIED * share[-1]
    faces = np.minimum(np.searchsorted(share, picks), len(share) - 1)
    u, v = rng.random((2, TRIED))
    fold = u + v > 1.0
    u, v = np.where(fold, 1.0 - u, u), np.where(fold, 1.0 - v, v)
    a, b, c = np.moveaxis(mesh.triangles_mm[faces], 1, 0)
    return a + u[:, None] * (b - a) + v[:, None] * (c - a), faces


def _openness(bodies, points, normals, rays: int = 48) -> np.ndarray:
    """(T,) fraction of the rays in a cone about each normal that meet no body."""
    k = np.arange(rays) + 0.5
    cosine = 1.0 - (1.0 - np.cos(OPEN_CONE_RAD)) * k / rays
    turn = np.pi * (1.0 + np.sqrt(5.0)) * k
    sine = np.sqrt(1.0 - cosine**2)
    cone = np.stack((sine * np.cos(turn), sine * np.sin(turn), cosine), axis=1)
    directions = cone @ np.swapaxes(frames.rotation_from_z(normals), 1, 2)
    origins = np.repeat((points + 0.5 * normals)[:, None], rays, axis=1)
    free = np.ones(directions.shape[:2], dtype=bool)
    for mesh in bodies:
        _, face = EmbreeSurface(mesh).first_hit(
            origins.reshape(-1, 3), directions.reshape(-1, 3), 300.0
        )
        free &= (face < 0).reshape(free.shape)
    return free.mean(axis=1)


def _evenness(mesh, points, normals, radius) -> np.ndarray:
    """(T,) mean cosine between a point's normal and those of the surface within `radius`."""
    from scipy.spatial import cKDTree

    middles, weights = mesh.triangles_mm.mean(axis=1), mesh.face_areas_mm2
    around = cKDTree(middles).query_ball_point(points, radius)
    result = np.ones(len(points))
    for i, near in enumerate(around):
        if near:
            cosine = mesh.face_normals[near] @ normals[i]
            result[i] = np.average(cosine, weights=np.maximum(weights[near], 1e-12))
    return result


TRIES = 20
"""Places tried for each lesion before the variation is given up."""


def distance_from_points_mm(mesh: Mesh, points_mm: np.ndarray) -> float:
    """Least distance of a mesh's surface from points (M, 3) mm, both in the world frame (mm)."""
    nearest, _ = nearest_on_surface(mesh, points_mm)
    return float(np.linalg.norm(nearest - points_mm, axis=1).min())


def distance_from_ring_mm(mesh: Mesh, ring: Ring) -> float:
    """Distance of a mesh's surface from the points of a ring, both in the world frame (mm)."""
    return distance_from_points_mm(mesh, ring.points_mm)


def lesions_like(
    mesh: Mesh,
    lesion: LesionSpec,
    count: int,
    shift_mm: float,
    size: float,
    keep_out: Mapping[str, Mesh] | None = None,
    clearance_mm: float = 0.0,
) -> tuple[LesionSpec, ...]:
    """`count` random variations of a lesion on the organ's mesh (world frame), with a fixed seed.

    Centres are uniform within shift_mm of the lesion's centre, along the surface. Diameters are
    uniform within the share `size` of its diameter (0.1: 90 to 110 %). Rings that come nearer than
    clearance_mm to a body of keep_out (name -> mesh, world frame) are left out. With shift_mm and
    size at 0 the result is the lesion itself. Raises InputError where too few rings are found.
    """
    if shift_mm == 0.0 and size == 0.0:
        return (lesion,)
    if lesion.path_mm:
        raise InputError("a lesion with its own path_mm cannot be moved or scaled; leave both at 0")
    if not 0.0 <= size < 1.0:
        raise InputError(f"lesions differ in size by a share of {size}; expected 0 to below 1")
    if shift_mm > lesion.diameter_mm:
        raise InputError(
            f"lesions move by up to {shift_mm:g} mm; expected at most the scene's own diameter of "
            f"{lesion.diameter_mm:g} mm"
        )
    own, face = (part[0] for part in nearest_on_surface(mesh, np.array([lesion.centre_mm])))
    plane = frames.rotation_from_z(patch_normal(mesh, own, int(face), 0.5 * lesion.diameter_mm))
    rng, found, too_near = np.random.default_rng(0), [], dict.fromkeys(keep_out or {}, 0)
    for _ in range(TRIES * count):
        turn, share, spread = rng.uniform((0.0, 0.0, -1.0), (2.0 * np.pi, 1.0, 1.0))
        aside = shift_mm * np.sqrt(share) * np.array([np.cos(turn), np.sin(turn)])
        diameter = lesion.diameter_mm * (1.0 + size * spread)
        centre, face = (part[0] for part in nearest_on_surface(mesh, own + plane[:, :2] @ aside))
        ring = circle_on(mesh, centre, int(face), diameter)
        near = [
            name
            for name, body in (keep_out or {}).items()
            if ring is not None and distance_from_ring_mm(body, ring) < clearance_mm
        ]
        for name in near:
            too_near[name] += 1
        if ring is not None and not near:
            found.append(
                replace(lesion, centre_mm=tuple(centre.tolist()), diameter_mm=float(diameter))
            )
        if len(found) == count:
            return tuple(found)
    close = [f"'{name}'" for name, times in too_near.items() if times]
    off = f" at least {clearance_mm:g} mm from {', '.join(close)}" if close else ""
    raise InputError(
        f"only {len(found)} of {count} lesions up to {shift_mm:g} mm aside and {100 * size:g} % "
        f"larger fit on '{lesion.body}'{off}; use a smaller spread or "
        f"{'another' if close else 'a flatter'} place"
    )
