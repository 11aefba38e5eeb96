"""The part of the organ's surface on which the laser's dose is stored: around a ring, or paths.

The mesh's faces are far coarser than a beam, so the faces near the ring are divided into small
triangles, each of which stores the dose at its centroid. With edges up to `SPACING_WAISTS` of the
beam's 1/e^2 radius, the sum over a Gaussian is accurate to 1 % wherever the beam lands.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surgisoft.compiled import compiled
from surgisoft.errors import InputError
from surgisoft.scene import frames
from surgisoft.scene.contours import SurfacePath, inside_outline, resampled
from surgisoft.scene.inside import buried
from surgisoft.scene.mesh import Mesh

LESION, RING, HEALTHY = 0, 1, 2
"""Zones of the patch: inside the ring, the ring itself, outside."""
SPACING_WAISTS = 0.75
"""Longest edge of a sample as a share of the beam's 1/e^2 radius."""
LEAST_FACING = -0.2
"""Faces whose normal has a smaller cosine to the ring's normal are on the organ's far side."""
SEAM_FINER = 4.0
"""Factor by which faces that run into the solid are divided finer: samples count whole or not."""
MOST_SAMPLES = 400_000
"""A patch that needs more samples than this is an error."""


COINCIDE_MM = 0.05
"""Two paths nearer to each other than this coincide (mm)."""
MOST_SHARED_MM = 2.0
"""Length over which two paths may coincide: that of a crossing (mm)."""
MARGIN_MM = 4.0
"""How far a patch reaches beyond the ring, the path, or the margin that is spared (mm). Tissue that
is ablated farther out is no part of any area."""


@dataclass(frozen=True, eq=False)
class DosePatch:
    """P sample triangles around a ring of N stations; frame of the mesh it was cut from.

    Of several paths (`path_patch`) the stations follow one another, and lengths are sums.
    """

    points_mm: np.ndarray
    """(P, 3) float64 mm: centroids, sorted by bucket."""
    normals: np.ndarray
    """(P, 3) float64: outward unit normals of the faces."""
    areas_mm2: np.ndarray
    """(P,) float64 mm^2."""
    faces: np.ndarray
    """(P,) int64: face of the mesh that each sample was cut from."""
    offset_mm: np.ndarray
    """(P,) float64 mm: distance from the ring's path, negative inside the ring."""
    station: np.ndarray
    """(P,) int64: nearest of the N equal stretches of the ring."""
    zone: np.ndarray
    """(P,) int8: LESION, RING or HEALTHY."""
    stations: int
    """N: number of stretches of the ring."""
    ring_length_mm: float
    """Length of the ring's closed path (mm)."""
    spacing_mm: float
    """Longest edge of a sample (mm)."""
    buckets: Buckets
    """Where the samples are, for looking up those near a point."""


@dataclass(frozen=True, eq=False)
class Buckets:
    """Samples by the cubes of a grid: cube c holds samples starts[c] to starts[c + 1]."""

    origin_mm: np.ndarray
    """(3,) mm: lowest corner of the grid."""
    cell_mm: float
    """Edge of a cube (mm)."""
    shape: tuple[int, int, int]
    """Cubes along each axis."""
    starts: np.ndarray
    """(X Y Z + 1,) int64."""
    cubes: np.ndarray
    """(P,) int64: cube of each sample, rising."""


def cut_patch(
    mesh: Mesh,
    ring_mm: np.ndarray,
    ring_normals: np.ndarray,
    centre_mm: np.ndarray,
    spacing_mm: float,
    band_mm: float = 2.0,
    margin_mm: float = MARGIN_MM,
    station_mm: float = 0.5,
) -> DosePatch:
    """The patch of a closed ring (M, 3) mm with outward normals (M, 3) about centre_mm (3,).

    Samples have edges of at most spacing_mm; the ring is the band of width band_mm along its path,
    divided into stations of about station_mm. The patch covers the inside of the ring and reaches
    margin_mm beyond it. Where the surface crosses itself, the part inside the solid is left out.
    """
    ring = (ring_mm, ring_normals, centre_mm)
    return cut_patches(mesh, (ring,), spacing_mm, band_mm, margin_mm, station_mm)[0]


def cut_patches(
    mesh: Mesh,
    rings: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]],
    spacing_mm: float,
    band_mm: float = 2.0,
    margin_mm: float = MARGIN_MM,
    station_mm: float = 0.5,
) -> tuple[DosePatch, ...]:
    """One patch for each ring (points, normals, centre); all patches share the same samples.

    The other arguments are those of `cut_patch`. The rings lie near one another; each has as many
    stations as the longest one.
    """
    rings = [
        (np.asarray(ring, float), np.asarray(normals, float), np.asarray(centre, float))
        for ring, normals, centre in rings
    ]
    for ring, normals, _ in rings:
        if ring.ndim != 2 or len(ring) < 3 or ring.shape != normals.shape:
            raise InputError(
                f"ring has shape {ring.shape}: expected (M, 3) points, M >= 3, normals"
            )
    if not (spacing_mm > 0.0 and 0.0 < band_mm <= 2.0 * margin_mm):
        raise InputError(
            f"dose patch: spacing {spacing_mm} mm, band {band_mm} mm, margin {margin_mm} mm; "
            "expected all above 0 and the band within the margin"
        )
    centre, paths = rings[0][2], np.concatenate([ring for ring, _, _ in rings])
    reach = np.linalg.norm(paths - centre, axis=1).max() + margin_mm
    near = _faces_near(mesh, paths, reach, centre)
    points, faces, areas = _exposed(mesh, near, spacing_mm, reach, centre)
    zoned = [_zoned(mesh, points, faces, ring, band_mm, margin_mm) for ring in rings]
    kept = np.any([one.near for one in zoned], axis=0)
    if not kept.any():
        raise InputError("dose patch: the ring lies nowhere near the organ's surface")
    order, buckets = _fill_buckets(points[kept], max(2.0 * spacing_mm, 0.5))
    chosen = np.flatnonzero(kept)[order]
    points, faces, areas = (x[chosen] for x in (points, faces, areas))
    normals = np.array(mesh.face_normals[faces])
    stations = max(12, round(max(one.length for one in zoned) / station_mm))
    patches = []
    for one in zoned:
        zone, along = one.zone[chosen], one.along[chosen]
        station = np.minimum((along / one.length * stations).astype(np.int64), stations - 1)
        if len(np.unique(station[zone == RING])) < stations:
            raise InputError(
                "dose patch: stretches of the ring have no surface below them; move it"
            )
        shared = (points, normals, areas, faces)
        place = (one.offset[chosen], station, zone)
        patches.append(DosePatch(*shared, *place, stations, one.length, float(spacing_mm), buckets))
    return tuple(patches)


def path_patch(
    mesh: Mesh,
    paths: Sequence[SurfacePath],
    spacing_mm: float,
    band_mm: float = 2.0,
    margin_mm: float = MARGIN_MM,
    station_mm: float = 0.5,
) -> DosePatch:
    """The patch of paths that are all to be treated in one episode.

    LESION is inside of a closed path, RING the band of width band_mm along any path, HEALTHY all
    else up to margin_mm from the paths. With band_mm 0 there is no ring; see `area_patch` for one
    outside of the outline only. Each path has stations of about station_mm, one path after another.
    """
    check_apart(paths)
    samples = _path_samples(mesh, paths, spacing_mm, margin_mm)
    zone = np.where(np.abs(samples.offset) <= 0.5 * band_mm, RING, samples.side)
    patch = samples.patch(mesh, zone, spacing_mm, station_mm)
    missed = patch.stations - len(np.unique(patch.station[patch.zone == RING]))
    if missed:
        raise InputError(
            f"dose patch: {missed} stretches of the paths have no surface below them; move them"
        )
    return patch


def check_apart(paths: Sequence[SurfacePath]) -> None:
    """Raise an InputError for two paths that coincide over more than MOST_SHARED_MM."""
    from scipy.spatial import cKDTree

    for i, one in enumerate(paths):
        for other in paths[:i]:
            line = np.vstack((other.points_mm, other.points_mm[: int(other.closed)]))
            away, _ = cKDTree(resampled(line, COINCIDE_MM)).query(one.points_mm)
            along = one.length_mm * float((away <= COINCIDE_MM).mean())
            if along > MOST_SHARED_MM:
                raise InputError(
                    f"contours '{other.name}' and '{one.name}' coincide over {along:.3g} mm; "
                    "expected contours that at most cross: leave one out, or move it"
                )


def area_patch(
    mesh: Mesh,
    outlines: Sequence[SurfacePath],
    spacing_mm: float,
    spared_mm: float,
    margin_mm: float = MARGIN_MM,
    station_mm: float = 0.5,
) -> DosePatch:
    """The patch of closed outlines whose insides are to be treated.

    LESION is inside of an outline, RING the margin up to spared_mm outside, which may be treated or
    not, HEALTHY all else up to margin_mm beyond that.
    """
    for outline in outlines:
        if not outline.closed:
            raise InputError(f"contour '{outline.name}' is open; an area needs a closed outline")
    samples = _path_samples(mesh, outlines, spacing_mm, spared_mm + margin_mm)
    between = (samples.side == HEALTHY) & (samples.offset <= spared_mm)
    zone = np.where(between, RING, samples.side)
    return samples.patch(mesh, zone, spacing_mm, station_mm)


@dataclass(frozen=True, eq=False)
class _PathSamples:
    """Samples (P, ...) near paths: the nearest path, the place along it, and the distance."""

    points: np.ndarray
    faces: np.ndarray
    areas: np.ndarray
    path: np.ndarray
    along: np.ndarray
    offset: np.ndarray
    side: np.ndarray
    """LESION inside of a closed path, else HEALTHY."""
    lengths: tuple[float, ...]

    def patch(self, mesh: Mesh, zone: np.ndarray, spacing: float, station: float) -> DosePatch:
        """The patch with these zones (P,), sorted by bucket."""
        order, buckets = _fill_buckets(self.points, max(2.0 * spacing, 0.5))
        counts = np.array([max(4, round(length / station)) for length in self.lengths])
        first = np.cumsum(counts) - counts
        share = self.along / np.array(self.lengths)[self.path]
        place = np.minimum((share * counts[self.path]).astype(np.int64), counts[self.path] - 1)
        return DosePatch(
            self.points[order],
            np.array(mesh.face_normals[self.faces[order]]),
            self.areas[order],
            self.faces[order],
            self.offset[order],
            (first[self.path] + place)[order],
            zone[order].astype(np.int8),
            int(counts.sum()),
            float(sum(self.lengths)),
            float(spacing),
            buckets,
        )


def _path_samples(
    mesh: Mesh, paths: Sequence[SurfacePath], spacing: float, margin: float
) -> _PathSamples:
    """Samples inside the paths and within a margin (mm) of them."""
    if not (spacing > 0.0 and margin > 0.0 and paths):
        raise InputError(
            f"dose patch: {len(paths)} paths, spacing {spacing} mm, margin {margin} mm; expected "
            "at least one path and lengths above 0"
        )
    every = np.concatenate([path.points_mm for path in paths])
    centre = 0.5 * (every.min(axis=0) + every.max(axis=0))
    reach = float(np.linalg.norm(every - centre, axis=1).max()) + margin
    near = _faces_near(mesh, every, reach, centre)
    points, faces, areas = _exposed(mesh, near, spacing, reach, centre)
    best = np.full(len(points), np.inf)
    owner, along = np.zeros(len(points), np.int64), np.zeros(len(points))
    offset, inside = np.zeros(len(points)), np.zeros(len(points), dtype=bool)
    for number, path in enumerate(paths):
        line, normals = path.points_mm, path.normals
        if path.closed:
            line, normals = (np.vstack((each, each[:1])) for each in (line, normals))
        steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
        arc, away, side = (np.empty(len(points)) for _ in range(3))
        _nearest_on_line(points, line, normals, steps, arc, away, side)
        below = normals[np.searchsorted(np.cumsum(steps), arc).clip(max=len(line) - 1)]
        facing = frames.dot(mesh.face_normals[faces], below) > LEAST_FACING
        within = np.zeros(len(points), dtype=bool)
        if path.closed:
            name = f"contour '{path.name}'"
            within = inside_outline(mesh, path.points_mm, points, name) & facing
        inside |= within
        nearer = (away < best) & facing
        best, owner = np.where(nearer, away, best), np.where(nearer, number, owner)
        along = np.where(nearer, arc, along)
        offset = np.where(nearer, np.where(within, -away, away), offset)
    kept = (best <= margin) | inside
    if not kept.any():
        raise InputError("dose patch: the paths lie nowhere near the organ's surface")
    return _PathSamples(
        points[kept],
        faces[kept],
        areas[kept],
        owner[kept],
        along[kept],
        offset[kept],
        np.where(inside, LESION, HEALTHY)[kept],
        tuple(path.length_mm for path in paths),
    )


@dataclass(frozen=True, eq=False)
class _Zoned:
    """Samples in the coordinates of one ring."""

    along: np.ndarray
    offset: np.ndarray
    zone: np.ndarray
    near: np.ndarray
    length: float


def _zoned(mesh, points, faces, ring, band, margin) -> _Zoned:
    """Where samples (P, 3) lie by a ring; those turned away from it are healthy tissue."""
    path, normals, centre = ring
    steps = np.linalg.norm(np.roll(path, -1, axis=0) - path, axis=1)
    along, offset = _ring_coordinates(points, path, normals, centre, steps)
    below = normals[np.searchsorted(np.cumsum(steps), along).clip(max=len(path) - 1)]
    facing = frames.dot(mesh.face_normals[faces], below) > LEAST_FACING
    zone = np.where(np.abs(offset) <= 0.5 * band, RING, np.where(offset < 0, LESION, HEALTHY))
    zone = np.where(facing, zone, HEALTHY).astype(np.int8)
    return _Zoned(along, offset, zone, (offset <= margin) & facing, float(steps.sum()))


def _faces_near(mesh: Mesh, ring: np.ndarray, reach: float, centre: np.ndarray) -> np.ndarray:
    """Faces within reach of the centre that are connected to those under the ring."""
    corners = mesh.triangles_mm
    size = np.linalg.norm(corners - corners.mean(axis=1, keepdims=True), axis=2).max(axis=1)
    middles = corners.mean(axis=1)
    candidates = np.flatnonzero(frames.norm(middles - centre) <= reach + size)
    if len(candidates) == 0:
        return candidates
    label = np.arange(len(mesh.vertices_mm))
    faces = mesh.faces[candidates]
    while True:
        least = label[faces].min(axis=1)
        before = label.copy()
        np.minimum.at(label, faces.ravel(), np.repeat(least, 3))
        label = label[label]
        if np.array_equal(before, label):
            break
    below = [np.argmin(frames.norm(middles[candidates] - p)) for p in ring]
    parts = np.unique(label[faces[below, 0]])
    return candidates[np.isin(label[faces[:, 0]], parts)]


def _exposed(mesh: Mesh, faces: np.ndarray, spacing: float, reach: float, centre: np.ndarray):
    """Samples of `_subdivide` outside the solid; finer on faces that lie partly inside it."""
    samples = _subdivide(mesh, faces, spacing, reach, centre)
    hidden = buried(mesh, samples[0], mesh.face_normals[samples[1]])
    if hidden.any():
        seam = np.intersect1d(samples[1][hidden], samples[1][~hidden])
        plain = ~hidden & ~np.isin(samples[1], seam)
        fine = _subdivide(mesh, seam, spacing / SEAM_FINER, reach, centre)
        seen = ~buried(mesh, fine[0], mesh.face_normals[fine[1]])
        samples = tuple(
            np.concatenate((x[plain], y[seen])) for x, y in zip(samples, fine, strict=True)
        )
    return samples


def _subdivide(mesh: Mesh, faces: np.ndarray, spacing: float, reach: float, centre: np.ndarray):
    """Centroids (P, 3), face numbers (P,) and areas (P,) of small triangles within reach.

    Large faces are quartered, leaving out what lies beyond reach, until n^2 equal parts of each
    piece do the rest.
    """
    corners, owner = mesh.triangles_mm[faces], faces
    while True:
        middles = corners.mean(axis=1)
        size = frames.norm(corners - middles[:, None]).max(axis=1)
        kept = frames.norm(middles - centre) <= reach + size
        corners, owner = corners[kept], owner[kept]
        edges = frames.norm(np.roll(corners, -1, axis=1) - corners).max(axis=1, initial=0.0)
        large = edges > 8.0 * spacing
        if not large.any():
            break
        _check_count(len(corners), spacing)
        quarters = np.einsum("qkc,fcx->fqkx", _QUARTERS, corners[large]).reshape(-1, 3, 3)
        corners = np.concatenate((corners[~large], quarters))
        owner = np.concatenate((owner[~large], np.repeat(owner[large], 4)))
    parts = np.maximum(1, np.ceil(edges / spacing).astype(int))
    _check_count(int((parts**2).sum()), spacing)
    area = 0.5 * frames.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    points, owners, areas = [np.empty((0, 3))], [np.empty(0, np.int64)], [np.empty(0)]
    for n in np.unique(parts):
        chosen = parts == n
        weights = _centroid_weights(int(n))
        points.append(np.einsum("kc,fcx->fkx", weights, corners[chosen]).reshape(-1, 3))
        owners.append(np.repeat(owner[chosen], n * n))
        areas.append(np.repeat(area[chosen] / (n * n), n * n))
    return tuple(np.concatenate(x) for x in (points, owners, areas))


def _check_count(count: int, spacing: float) -> None:
    if count > MOST_SAMPLES:
        raise InputError(
            f"dose patch: {count} samples of {spacing} mm and counting; expected at most "
            f"{MOST_SAMPLES}: use a larger spot or a smaller lesion"
        )


_QUARTERS = 0.5 * np.array(
    [
        [[2, 0, 0], [1, 1, 0], [1, 0, 1]],
        [[1, 1, 0], [0, 2, 0], [0, 1, 1]],
        [[1, 0, 1], [0, 1, 1], [0, 0, 2]],
        [[1, 1, 0], [0, 1, 1], [1, 0, 1]],
    ]
)
"""(4, 3, 3) barycentric corners of a triangle's four equal parts."""


def _centroid_weights(n: int) -> np.ndarray:
    """(n^2, 3) barycentric centroids of a triangle cut into n^2 equal ones."""
    upright = [(i + 1 / 3, j + 1 / 3) for i in range(n) for j in range(n - i)]
    hanging = [(i + 2 / 3, j + 2 / 3) for i in range(n) for j in range(n - i - 1)]
    v, w = np.array(upright + hanging).T / n
    return np.stack((1 - v - w, v, w), axis=1)


def _ring_coordinates(points, ring, normals, centre, steps):
    """Arc length along the ring (P,) and signed distance from it (P,), mm, of points (P, 3).

    Negative is the side on which the centre lies, seen along the ring's normal there.
    """
    ring, normals = (np.vstack((each, each[:1])) for each in (ring, normals))
    along, offset, side = np.empty(len(points)), np.empty(len(points)), np.empty(len(points))
    _nearest_on_line(points, ring, normals, steps, along, offset, side)
    at_centre = [np.empty(1) for _ in range(3)]
    _nearest_on_line(centre[None], ring, normals, steps, *at_centre)
    inward = 1.0 if at_centre[2][0] >= 0.0 else -1.0
    return along, np.where(side * inward > 0.0, -offset, offset)


@compiled
def _nearest_on_line(points, ring, normals, steps, along, offset, side):
    """Nearest point of the polyline: its arc length, the distance, and on which side.

    A step that begins farther away than the nearest one so far and its own length is passed over.
    """
    count = len(ring) - 1
    squared = np.empty(count)
    for m in range(count):
        ex, ey, ez = (
            ring[m + 1, 0] - ring[m, 0],
            ring[m + 1, 1] - ring[m, 1],
            ring[m + 1, 2] - ring[m, 2],
        )
        squared[m] = max(ex * ex + ey * ey + ez * ez, 1e-300)
    for p in range(len(points)):
        best, reach, arc = np.inf, np.inf, 0.0
        for m in range(count):
            k = m + 1
            x, y, z = (
                points[p, 0] - ring[m, 0],
                points[p, 1] - ring[m, 1],
                points[p, 2] - ring[m, 2],
            )
            far = reach + steps[m]
            if x * x + y * y + z * z <= far * far:
                ex, ey, ez = (
                    ring[k, 0] - ring[m, 0],
                    ring[k, 1] - ring[m, 1],
                    ring[k, 2] - ring[m, 2],
                )
                share = (x * ex + y * ey + z * ez) / squared[m]
                share = min(max(share, 0.0), 1.0)
                x, y, z = x - share * ex, y - share * ey, z - share * ez
                d2 = x * x + y * y + z * z
                if d2 < best:
                    best, reach = d2, (1.0 + 1e-9) * np.sqrt(d2)
                    along[p] = arc + share * steps[m]
                    nx, ny = normals[m, 0] + normals[k, 0], normals[m, 1] + normals[k, 1]
                    nz = normals[m, 2] + normals[k, 2]
                    side[p] = (
                        nx * (ey * z - ez * y) + ny * (ez * x - ex * z) + nz * (ex * y - ey * x)
                    )
            arc += steps[m]
        offset[p] = np.sqrt(best)


def _fill_buckets(points: np.ndarray, cell: float) -> tuple[np.ndarray, Buckets]:
    """The order (P,) that sorts points (P, 3) mm by bucket, and the buckets then."""
    origin = points.min(axis=0) - 1e-6
    index = np.floor((points - origin) / cell).astype(np.int64)
    last = index.max(axis=0)
    shape = (int(last[0]) + 1, int(last[1]) + 1, int(last[2]) + 1)
    flat = np.ravel_multi_index(tuple(index.T), shape)
    order = np.argsort(flat, kind="stable")
    cubes = flat[order].astype(np.int64)
    starts = np.searchsorted(cubes, np.arange(int(np.prod(shape)) + 1))
    return order, Buckets(origin, cell, shape, starts.astype(np.int64), cubes)


def samples_at(patch: DosePatch, points_mm: np.ndarray) -> np.ndarray:
    """(N,) nearest sample to surface points (N, 3) mm; -1 farther than a bucket from any."""
    grid, out = patch.buckets, np.full(len(points_mm), -1, dtype=np.int64)
    place = (grid.origin_mm, grid.cell_mm, grid.shape, grid.starts)
    _nearest_sample(np.ascontiguousarray(points_mm, dtype=float), patch.points_mm, place, out)
    return out


@compiled
def _nearest_sample(points, samples, place, out):
    origin, cell, shape, starts = place
    for n in range(len(points)):
        best = cell * cell
        low, high = np.empty(3, np.int64), np.empty(3, np.int64)
        for i in range(3):
            index = (points[n, i] - origin[i]) / cell
            index = math.floor(min(max(index, -2.0), shape[i] + 1.0))
            low[i], high[i] = max(index - 1, 0), min(index + 1, shape[i] - 1)
        for ci in range(low[0], high[0] + 1):
            for cj in range(low[1], high[1] + 1):
                for ck in range(low[2], high[2] + 1):
                    cube = (ci * shape[1] + cj) * shape[2] + ck
                    for k in range(starts[cube], starts[cube + 1]):
                        x = samples[k, 0] - points[n, 0]
                        y = samples[k, 1] - points[n, 1]
                        z = samples[k, 2] - points[n, 2]
                        d2 = x * x + y * y + z * z
                        if d2 < best:
                            best, out[n] = d2, k
