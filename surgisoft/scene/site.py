"""Where on an organ a lesion goes: where the user points, else the most open and even place."""

from dataclasses import dataclass, replace

import numpy as np

from surgisoft.errors import InputError
from surgisoft.scene import frames
from surgisoft.scene.lesion import Ring, circle_on, nearest_on_surface
from surgisoft.scene.mesh import Mesh
from surgisoft.scene.rays import EmbreeSurface

TRIED = 400
"""Surface points drawn for the choice of a lesion."""
OPEN_CONE_RAD = np.radians(60.0)
"""Half angle of the cone above a place that should be open to the outside (rad)."""
SITES = 6
"""Places handed on for the search of mounts."""

QUICK_RING = 12
"""Ring points that are tried before the whole ring, when a diameter that fits is sought."""
FAR_POINT_MM = 20.0
"""A point farther than this from every surface is a slip, not a place on it (mm)..."""
FAR_POINT = 0.1
"""... unless it is within this share of the body's largest side."""


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
    """How far it lies from the point that was pointed at (mm)."""


def pointed_site(
    bodies: list[Mesh], point_mm: np.ndarray, diameter_mm: float, said: str | None = None
) -> Site:
    """The surface point nearest to `point_mm` (3,), on whichever body it lies.

    An InputError where none is near; `said` is the point as the user wrote it.
    """
    nearest = [nearest_on_surface(mesh, point_mm[None]) for mesh in bodies]
    away = [float(np.linalg.norm(points[0] - point_mm)) for points, _ in nearest]
    body = int(np.argmin(away))
    points, faces = nearest[body]
    most = max(FAR_POINT_MM, FAR_POINT * float(np.ptp(bodies[body].bounds_mm, axis=0).max()))
    if away[body] > most:
        said = said or f"the point {tuple(point_mm.round(3).tolist())} mm"
        raise InputError(
            f"{said} lies {away[body]:.4g} mm from the nearest surface; expected at most "
            f"{most:.4g} mm: give it in the first file's own frame and unit, or check --unit"
        )
    site = _with_ring(bodies, body, points[0], int(faces[0]), diameter_mm)
    return replace(site, moved_mm=away[body])


def directed_site(bodies: list[Mesh], direction: np.ndarray, diameter_mm: float) -> Site:
    """Where a ray from outside along -direction (3,) through the largest body's middle lands.

    Where it passes through without touching (a ring's hole), the surface point that lies farthest
    out in that direction.
    """
    away = frames.normalise(np.asarray(direction, dtype=float))
    mesh = bodies[0]
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
    ring = circle_on(bodies[body], point, face, diameter_mm)
    if ring is None:
        fits = _largest_fitting(bodies[body], point, face, diameter_mm)
        advice = f"a ring of {fits:.0f} mm does" if fits >= 1.0 else "no ring does"
        raise InputError(
            f"a ring of {diameter_mm:g} mm does not lie on the surface at "
            f"{tuple(point.round(1).tolist())} mm ({advice}); choose another place or --diameter"
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


def good_sites(bodies: list[Mesh], diameter_mm: float) -> list[Site]:
    """Places on the largest body that are open to the outside, even and on top, best first.

    Points are drawn evenly over the surface (the same ones each time). Openness is the fraction of
    a cone of rays that leave without touching any body.
    """
    mesh = bodies[0]
    points, faces = _drawn(mesh)
    normals = mesh.face_normals[faces]
    openness = _openness(bodies, points, normals)
    evenness = _evenness(mesh, points, normals, 0.5 * diameter_mm)
    quality = 2.0 * openness + 2.0 * evenness + 0.7 * normals[:, 2]
    sites: list[Site] = []
    for i in np.argsort(-quality, kind="stable")[:80]:
        if any(np.linalg.norm(points[i] - site.point_mm) < 1.5 * diameter_mm for site in sites):
            continue
        ring = circle_on(mesh, points[i], int(faces[i]), diameter_mm)
        if ring is not None:
            sites.append(Site(0, points[i], ring))
        if len(sites) == SITES:
            break
    if not sites:
        size = np.ptp(mesh.bounds_mm, axis=0)
        best = np.argsort(-quality, kind="stable")[:SITES]
        fits = max(_largest_fitting(mesh, points[i], int(faces[i]), diameter_mm) for i in best)
        advice = f"a ring of {fits:g} mm does" if fits else "no smaller one does"
        raise InputError(
            f"no ring of {diameter_mm:g} mm lies on a body of "
            f"{' x '.join(f'{s:.3g}' for s in size)} mm ({advice}): it hangs over an edge or the "
            "surface is too rough; give a smaller --diameter or the right --unit"
        )
    return sites


def _drawn(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """TRIED surface points (T, 3) and their faces, evenly over the area."""
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
    """(T,) fraction of a cone of rays about each normal that meet no body."""
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
