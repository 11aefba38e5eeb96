"""Contours on an organ: closed or open paths from a file, grown outlines, and rasters within them.

A path follows the surface: its points lie on the mesh, one after another at even steps of arc
length. Margins and rasters are laid out in the plane across the outline's mean normal and dropped
onto the surface along it, as rings are (`lesion.circle_on`), so that they are lengths as seen along
that normal.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from surgisoft.errors import InputError
from surgisoft.scene import frames
from surgisoft.scene.crossings import SAMPLED_MM, crossing_mm
from surgisoft.scene.lesion import ON_SURFACE_MM, circle_on, dropped, nearest_on_surface
from surgisoft.scene.mesh import Mesh
from surgisoft.scene.spec import ContourSpec

FINE_MM = 0.2
"""Spacing of a path's points while it is laid on the surface (mm)."""
GRID_MM = 0.1
"""Cell of the grid on which an outline is grown (mm); the outline is between its nodes, linear."""
OUTSIDE_PITCHES = 0.5
"""Share of a raster's pitch by which the way from one line to the next may lead farther outside
than the lines reach: outlines are not quite convex as seen along their normal."""
MOST_NODES = 4_000_000
"""Most nodes of that grid: 200 x 200 mm."""


@dataclass(frozen=True, eq=False)
class SurfacePath:
    """A path on the organ's surface, world frame."""

    name: str
    """Its name."""
    points_mm: np.ndarray
    """(M, 3) mm: evenly spaced points on the surface; of a closed path the first comes once."""
    normals: np.ndarray
    """(M, 3): outward unit normals of the surface there."""
    normal: np.ndarray
    """(3,): mean outward unit normal."""
    closed: bool
    """Whether the last point is followed by the first."""
    length_mm: float
    """Arc length (mm), back to the first point where it is closed."""

    @property
    def middle_mm(self) -> np.ndarray:
        """(3,) mm: mean of the points."""
        return self.points_mm.mean(axis=0)


def contour_path(mesh: Mesh, contour: ContourSpec, step_mm: float) -> SurfacePath:
    """The contour as a path on the organ's mesh (world frame) with points about step_mm apart.

    An InputError names a contour that leaves the surface.
    """
    name = f"contour '{contour.name}'"
    if contour.centre_mm:
        given = _circle(mesh, contour, name)
    else:
        given = np.array(contour.points_mm, float)
        on_surface, _ = nearest_on_surface(mesh, given)
        off = np.linalg.norm(on_surface - given, axis=1)
        worst = int(off.argmax())
        if off[worst] > ON_SURFACE_MM:
            raise InputError(
                f"{name}: point {worst + 1} of {len(given)}, {_text(given[worst])} mm, lies "
                f"{off[worst]:.3g} mm off the organ's surface; expected at most "
                f"{ON_SURFACE_MM} mm; the nearest point is {_text(on_surface[worst])}"
            )
    if contour.margin_mm:
        given = grown(mesh, given, contour.margin_mm, name)
    return laid(mesh, given, contour.closed, step_mm, contour.name)


def laid(
    mesh: Mesh, corners_mm: np.ndarray, closed: bool, step_mm: float, name: str = "path"
) -> SurfacePath:
    """The polyline (N, 3) mm laid on the mesh, with even steps of arc length of about step_mm.

    Between two corners the path is the straight line, projected on the nearest surface.
    """
    corners = np.vstack((corners_mm, corners_mm[:1])) if closed else np.asarray(corners_mm)
    fine = resampled(corners, FINE_MM)
    fine, _ = nearest_on_surface(mesh, fine)
    length = arc_length_mm(fine)
    if not length > 0.0:
        raise InputError(f"contour '{name}' has no length: its points coincide")
    points = resampled(fine, step_mm)
    points, faces = nearest_on_surface(mesh, points[:-1] if closed else points)
    normals = mesh.face_normals[faces]
    mean = frames.normalise(normals.sum(axis=0))
    return SurfacePath(name, points, normals, mean, closed, length)


def arc_length_mm(line_mm: np.ndarray) -> float:
    """Length of a polyline (N, 3), mm."""
    return float(np.linalg.norm(np.diff(line_mm, axis=0), axis=1).sum())


def resampled(line_mm: np.ndarray, step_mm: float) -> np.ndarray:
    """(M + 1, 3): a polyline (N, 3) in M even steps of arc length, the fewest up to step_mm."""
    lengths = np.linalg.norm(np.diff(line_mm, axis=0), axis=1)
    along = np.r_[0.0, np.cumsum(lengths)]
    places = np.linspace(0.0, along[-1], max(1, math.ceil(along[-1] / step_mm - 1e-9)) + 1)
    return np.stack([np.interp(places, along, axis) for axis in np.asarray(line_mm).T], axis=1)


@dataclass(frozen=True, eq=False)
class Plane:
    """The plane across an outline's mean normal, through its middle."""

    middle_mm: np.ndarray
    """(3,) mm: origin of the plane's coordinates, world frame."""
    axes: np.ndarray
    """(3, 3): the columns are the plane's two axes and its normal, world frame."""

    @classmethod
    def of(cls, mesh: Mesh, outline_mm: np.ndarray, what: str = "the outline") -> Plane:
        """The plane of a closed outline (N, 3) mm on the mesh.

        The normal is that of the polygon (Newell's sum of cross products), on the outer side of the
        surface under it. An InputError names `what` where it crosses itself.
        """
        if (place := outline_crossing_mm(mesh, outline_mm)) is not None:
            raise InputError(
                f"{what} crosses itself near {_text(place)} mm, so it has no inside; expected a "
                "loop without a crossing: divide it into several, or, where it is only followed, "
                "make it open (closed = false)"
            )
        middle = outline_mm.mean(axis=0)
        away = outline_mm - middle
        newell = np.cross(away, np.roll(away, -1, axis=0)).sum(axis=0)
        _, faces = nearest_on_surface(mesh, outline_mm)
        outward = mesh.face_normals[faces].sum(axis=0)
        size = np.linalg.norm(newell)
        normal = newell / size if size > 1e-9 else frames.normalise(outward)
        if normal @ outward < 0.0:
            normal = -normal
        return cls(middle, frames.rotation_from_z(normal))

    def flat(self, points_mm: np.ndarray) -> np.ndarray:
        """(N, 2) mm: points (N, 3) mm seen along the normal."""
        return ((points_mm - self.middle_mm) @ self.axes)[:, :2]

    def on(self, mesh: Mesh, flat_mm: np.ndarray, what: str) -> np.ndarray:
        """(N, 3) mm: points (N, 2) mm of the plane, dropped onto the mesh along the normal."""
        points = self.middle_mm + flat_mm @ self.axes[:, :2].T
        size = 2.0 * float(np.linalg.norm(flat_mm, axis=1).max(initial=1.0))
        heights, faces = dropped(mesh, points, self.middle_mm, self.axes[:, 2], size)
        if (faces < 0).any():
            raise InputError(f"{what} extends over an edge of the organ; choose a flatter place")
        return points + heights[:, None] * self.axes[:, 2]


def outline_crossing_mm(mesh: Mesh, outline_mm: np.ndarray) -> np.ndarray | None:
    """(3,) mm: where a closed outline (N, 3) mm on the mesh crosses itself; see `crossing_mm`."""
    fine = resampled(np.vstack((outline_mm, outline_mm[:1])), SAMPLED_MM)[:-1]
    points, faces = nearest_on_surface(mesh, fine)
    return crossing_mm(points, mesh.face_normals[faces])


def grown(mesh: Mesh, outline_mm: np.ndarray, margin_mm: float, what: str = "path") -> np.ndarray:
    """(M, 3) mm: the closed outline (N, 3) mm on the mesh, grown outwards by a margin.

    The set of points at the margin's distance outside the outline, as the zero line of the signed
    distance on a grid (marching squares). It rounds convex corners and keeps the outermost line.
    """
    from contourpy import contour_generator

    plane = Plane.of(mesh, outline_mm, what)
    polygon = plane.flat(outline_mm)
    edge = margin_mm + 4.0 * GRID_MM
    low, high = polygon.min(axis=0) - edge, polygon.max(axis=0) + edge
    counts = np.ceil((high - low) / GRID_MM).astype(int) + 1
    if counts.prod() > MOST_NODES:
        raise InputError(f"{what} is {(high - low).max():.0f} mm wide, expected at most 200 mm")
    x, y = (low[i] + GRID_MM * np.arange(counts[i]) for i in (0, 1))
    nodes = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    away = signed_distance_mm(nodes, polygon).reshape(len(y), len(x))
    lines = contour_generator(x, y, away).lines(margin_mm)
    if not lines:
        raise InputError(f"{what}: a margin of {margin_mm:g} mm leaves no outline")
    longest = max((np.asarray(line) for line in lines), key=arc_length_mm)
    return plane.on(mesh, longest[:-1], f"{what} with its margin of {margin_mm:g} mm")


def signed_distance_mm(points: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """(P,) mm: distance of plane points (P, 2) from a closed polygon (N, 2), negative inside."""
    best = np.full(len(points), np.inf)
    for start, stop in zip(polygon, np.roll(polygon, -1, axis=0), strict=True):
        edge = stop - start
        share = (points - start) @ edge / max(float(edge @ edge), 1e-300)
        away = points - start - np.clip(share, 0.0, 1.0)[:, None] * edge
        best = np.minimum(best, np.einsum("pi,pi->p", away, away))
    return np.where(_inside(points, polygon), -1.0, 1.0) * np.sqrt(best)


def inside_outline(
    mesh: Mesh, outline_mm: np.ndarray, points_mm: np.ndarray, what: str = "the outline"
) -> np.ndarray:
    """(P,) bool: points (P, 3) mm inside a closed outline (N, 3) mm, seen along its normal.

    An InputError names `what` where the outline crosses itself.
    """
    plane = Plane.of(mesh, outline_mm, what)
    return _inside(plane.flat(points_mm), plane.flat(outline_mm))


def _inside(points: np.ndarray, polygon: np.ndarray) -> np.ndarray:
    """(P,) bool: plane points (P, 2) inside a closed polygon (N, 2)."""
    from matplotlib.path import Path as Polygon

    return Polygon(np.vstack((polygon, polygon[:1])), closed=True).contains_points(points)


def raster(
    mesh: Mesh, outline_mm: np.ndarray, pitch_mm: float, inset_mm: float, step_mm: float
) -> tuple[SurfacePath, ...]:
    """Open paths in parallel lines over the inside of a closed outline (N, 3) mm on the mesh.

    Lines are pitch_mm apart and run to and fro along the outline's longer side, at least inset_mm
    inside of it (negative: so far beyond it). The points are about step_mm apart. A convex outline
    has one path. A concave one is divided where a line has a gap (boustrophedon cells, Choset 2000,
    Auton. Robots 9:247), and where the way from one line to the next leads outside.
    """
    plane = Plane.of(mesh, outline_mm)
    polygon = plane.flat(outline_mm)
    _, _, sides = np.linalg.svd(polygon - polygon.mean(axis=0), full_matrices=False)
    turned = polygon @ sides.T
    low, high = turned.min(axis=0) + inset_mm, turned.max(axis=0) - inset_mm
    room = max(0.0, float(high[1] - low[1]))
    count = max(1, round(room / pitch_mm) + 1)
    rows = 0.5 * (low[1] + high[1]) + pitch_mm * (np.arange(count) - 0.5 * (count - 1))
    along = np.arange(low[0], high[0] + 0.5 * FINE_MM, FINE_MM)
    lines: list[list[np.ndarray]] = []
    for number, row in enumerate(rows):
        line = np.stack((along, np.full_like(along, row)), axis=1)
        inside = np.flatnonzero(signed_distance_mm(line, turned) <= -inset_mm + 1e-9)
        parts = np.split(inside, np.flatnonzero(np.diff(inside) > 1) + 1) if len(inside) else []
        lines.append([line[part] if number % 2 == 0 else line[part[::-1]] for part in parts])
    outside_mm = -inset_mm + OUTSIDE_PITCHES * pitch_mm
    corners = [
        np.concatenate(piece)
        for cell in _cells(lines)
        for piece in _unbroken(cell, turned, outside_mm)
        if sum(map(len, piece)) > 1
    ]
    if not corners:
        raise InputError(f"no line fits {inset_mm:g} mm inside the outline; choose a smaller inset")
    return tuple(
        laid(mesh, plane.on(mesh, each @ sides, "the raster"), False, step_mm, "raster")
        for each in corners
    )


def _cells(lines: Sequence[Sequence[np.ndarray]]) -> list[list[np.ndarray]]:
    """Parts (P, 2) of successive lines in cells of one part of each line.

    A part belongs to the cell of the one part beside it in the line before, unless that one has
    several parts beside it.
    """
    cells: list[list[np.ndarray]] = []
    last: list[int] = []  # numbers of the cells in the line before
    for parts in lines:
        beside = [[k for k in last if _overlap(cells[k][-1], part)] for part in parts]
        last = []
        for part, near in zip(parts, beside, strict=True):
            if len(near) != 1 or sum(near[0] in others for others in beside) != 1:
                near = [len(cells)]
                cells.append([])
            cells[near[0]].append(part)
            last.append(near[0])
    return cells


def _overlap(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two parts (P, 2) of parallel lines lie beside each other."""
    (a, b), (c, d) = (sorted((part[0, 0], part[-1, 0])) for part in (one, other))
    return bool(a <= d and c <= b)


def _unbroken(
    cell: Sequence[np.ndarray], polygon: np.ndarray, outside_mm: float
) -> list[list[np.ndarray]]:
    """The parts (P, 2) of a cell in pieces within which no way from one part to the next leads
    farther than outside_mm out of the polygon (N, 2)."""
    pieces = [[cell[0]]]
    for before, part in pairwise(cell):
        way = resampled(np.stack((before[-1], part[0])), FINE_MM)
        if signed_distance_mm(way, polygon).max() > outside_mm:
            pieces.append([])
        pieces[-1].append(part)
    return pieces


def _circle(mesh: Mesh, contour: ContourSpec, name: str) -> np.ndarray:
    centre = np.array(contour.centre_mm, float)
    points, faces = nearest_on_surface(mesh, centre[None])
    off = float(np.linalg.norm(points[0] - centre))
    if off > ON_SURFACE_MM:
        raise InputError(
            f"{name}: centre_mm {_text(centre)} lies {off:.3g} mm off the organ's surface; "
            f"expected at most {ON_SURFACE_MM} mm; the nearest point is {_text(points[0])}"
        )
    count = max(36, math.ceil(math.pi * contour.diameter_mm / FINE_MM))
    ring = circle_on(mesh, points[0], int(faces[0]), contour.diameter_mm, count)
    if ring is None:
        raise InputError(
            f"{name}: a circle of {contour.diameter_mm:g} mm extends over an edge of the organ; "
            "choose a flatter place or a smaller diameter"
        )
    return ring.points_mm


def _text(point: np.ndarray) -> str:
    return str(tuple(point.round(3).tolist()))
