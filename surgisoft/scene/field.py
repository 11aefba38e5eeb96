"""A distance field of a closed or open mesh on a grid, cached on disk by the mesh's content hash.

Nodes within a band around the surface hold the exact distance, negative inside a closed mesh.
Nodes beyond the band hold the distance to the face that is nearest to a neighbouring node: this is
never too small, and never below the band. Between nodes the trilinear value is off by at most
`slack_mm`. So the field gives a lower bound of every distance; where that is not enough, `distance`
queries the tree.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surgisoft.compiled import compiled
from surgisoft.errors import InputError
from surgisoft.files import write_atomically
from surgisoft.scene.bvh import TriangleTree, build_tree, point_surface, point_triangle, triangle
from surgisoft.scene.mesh import Mesh

FORMAT = 1
"""Version of the file format; files of another version are ignored."""
MOST_NODES = 2_000_000
"""The grid is coarsened until it has no more nodes than this."""
FINEST_CELL_MM = 0.5
"""The grid is never finer than this (mm)."""
STRIDE = 4
"""At every STRIDE-th node in each direction the distance is exact, however far the surface is."""


@dataclass(frozen=True, eq=False)
class DistanceField:
    """Distances on a regular grid in the mesh's own frame."""

    values_mm: np.ndarray
    """(X, Y, Z) float32, mm: signed distance at the nodes."""
    origin_mm: np.ndarray
    """(3,) float64, mm: the first node."""
    cell_mm: float
    """Edge of a cell (mm)."""
    margin_mm: float
    """The grid reaches at least this far from the mesh in every direction (mm)."""
    band_mm: float
    """Nodes nearer to the surface than this hold exact distances (mm)."""

    @property
    def slack_mm(self) -> float:
        """Largest error of the trilinear value (mm).

        A distance differs from that at a node by no more than the distance to the node. The
        weighted mean of those distances is largest at a cell's centre, where it is half the
        diagonal; float32 rounding adds 1e-4 mm.
        """
        return 0.5 * math.sqrt(3.0) * self.cell_mm + 1e-4


@compiled
def _node(origin, cell, i, j, k):
    """Position of a node as a tuple."""
    return origin[0] + i * cell, origin[1] + j * cell, origin[2] + k * cell


@compiled
def _coarse(distance, face, origin, cell, triangles, starts, lower, upper):
    """Exact distance and nearest face of every node of a coarse grid.

    The face found for the node before gives an upper bound that speeds up the search.
    """
    _, ny, nz = distance.shape
    for i in range(distance.shape[0]):
        last = -1
        for j in range(ny):
            for k in range(nz):
                p = _node(origin, cell, i, j, k)
                bound = np.inf
                if last >= 0:
                    a, b, c = triangle(triangles, last)
                    bound = point_triangle(p, a, b, c)[0] * (1.0 + 1e-12)
                d2, found, _, _ = point_surface(p, bound, triangles, starts, lower, upper)
                last = found if found >= 0 else last
                distance[i, j, k], face[i, j, k] = np.sqrt(d2), last


@compiled
def _fine(values, first, distance, face, origin, cell, band, triangles, starts, lower, upper):
    """Fill slab values, whose first plane is number `first`, from the coarse grid and the tree."""
    for ii in range(values.shape[0]):
        i = first + ii
        for j in range(values.shape[1]):
            for k in range(values.shape[2]):
                p = _node(origin, cell, i, j, k)
                bound, least, last = np.inf, 0.0, -1
                for n in range(8):
                    ci, cj, ck = i // STRIDE + n // 4, j // STRIDE + n // 2 % 2, k // STRIDE + n % 2
                    q = _node(origin, cell * STRIDE, ci, cj, ck)
                    x, y, z = q[0] - p[0], q[1] - p[1], q[2] - p[2]
                    least = max(least, distance[ci, cj, ck] - np.sqrt(x * x + y * y + z * z))
                    if face[ci, cj, ck] != last:
                        last = face[ci, cj, ck]
                        a, b, c = triangle(triangles, last)
                        bound = min(bound, point_triangle(p, a, b, c)[0])
                if least < band:
                    reach = min(bound, band * band)
                    d2 = point_surface(p, reach, triangles, starts, lower, upper)[0]
                    bound = d2 if d2 < reach else max(bound, reach)
                values[ii, j, k] = np.sqrt(bound)


def _unsigned(shape, origin, cell: float, band_mm: float, tree: TriangleTree) -> np.ndarray:
    """Distances (X, Y, Z) float32 mm at the nodes; threads compute one slab each."""
    values = np.empty(shape, np.float32)
    coarse = np.empty([(n - 1) // STRIDE + 2 for n in shape])
    face = np.empty(coarse.shape, np.int32)
    step = cell * STRIDE

    def fill_coarse(i: int):
        start = origin + np.array([i * step, 0.0, 0.0])
        _coarse(coarse[i : i + 1], face[i : i + 1], start, step, *tree.arrays)

    def fill_fine(i: int):
        _fine(values[i : i + 1], i, coarse, face, origin, cell, band_mm, *tree.arrays)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        list(pool.map(fill_coarse, range(coarse.shape[0])))
        list(pool.map(fill_fine, range(shape[0])))
    return values


@compiled
def _edge_side(ay, az, by, bz, y, z):
    """On which side of the projected edge a..b the point y, z lies; b..a gives the opposite sign.

    The ends are sorted first, so that two faces that share an edge round equally.
    """
    if ay < by or (ay == by and az < bz):
        return (by - ay) * (z - az) - (bz - az) * (y - ay)
    return -((ay - by) * (z - bz) - (az - bz) * (y - by))


@compiled
def _wind(counts, origin, cell, triangles):
    """Add to counts[i, j, k] the signed crossings along +x between node i - 1 and node i.

    Every triangle is projected on the yz plane and intersected with the rows of nodes it covers. A
    row that grazes an edge counts for exactly one of the two faces, as their edges round equally.
    """
    nx, ny, nz = counts.shape
    for f in range(len(triangles)):
        ax, ay, az = triangles[f, 0, 0], triangles[f, 0, 1], triangles[f, 0, 2]
        bx, by, bz = triangles[f, 1, 0], triangles[f, 1, 1], triangles[f, 1, 2]
        cx, cy, cz = triangles[f, 2, 0], triangles[f, 2, 1], triangles[f, 2, 2]
        j0 = max(0, int(np.ceil((min(ay, by, cy) - origin[1]) / cell)))
        j1 = min(ny - 1, int(np.floor((max(ay, by, cy) - origin[1]) / cell)))
        k0 = max(0, int(np.ceil((min(az, bz, cz) - origin[2]) / cell)))
        k1 = min(nz - 1, int(np.floor((max(az, bz, cz) - origin[2]) / cell)))
        for j in range(j0, j1 + 1):
            y = origin[1] + j * cell
            for k in range(k0, k1 + 1):
                z = origin[2] + k * cell
                wa = _edge_side(by, bz, cy, cz, y, z)
                wb = _edge_side(cy, cz, ay, az, y, z)
                wc = _edge_side(ay, az, by, bz, y, z)
                total = wa + wb + wc
                same = (wa >= 0 and wb >= 0 and wc >= 0) or (wa < 0 and wb < 0 and wc < 0)
                if not same or total == 0.0:
                    continue
                x = (wa * ax + wb * bx + wc * cx) / total
                i = int(np.floor((x - origin[0]) / cell)) + 1
                if i < nx:
                    counts[max(i, 0), j, k] += -1 if total > 0 else 1


def _grid(mesh: Mesh, margin_mm: float, most_nodes: int) -> tuple[np.ndarray, float, np.ndarray]:
    """Origin (3,), cell edge and node counts (3,) of the grid around a mesh."""
    low, high = mesh.bounds_mm
    size = high - low + 2.0 * margin_mm
    cell = max(FINEST_CELL_MM, float((np.prod(size) / most_nodes) ** (1.0 / 3.0)))
    while np.prod(np.ceil(size / cell) + 2) > most_nodes:
        cell *= 1.01
    # An offset that no modeller's grid shares keeps rows of nodes off vertices and edges.
    shift = cell * np.array([0.3819660, 0.4142136, 0.2360680])
    return low - margin_mm - shift, cell, np.ceil((size + shift) / cell).astype(int) + 1


def build_field(
    mesh: Mesh,
    margin_mm: float,
    band_mm: float,
    most_nodes: int = MOST_NODES,
    tree: TriangleTree | None = None,
) -> DistanceField:
    """The field of a mesh, reaching margin_mm beyond its box; unsigned if the mesh is open."""
    origin, cell, shape = _grid(mesh, margin_mm, most_nodes)
    tree = tree or build_tree(mesh)
    values = _unsigned(tuple(shape), origin, cell, band_mm, tree)
    if mesh.is_watertight:
        counts = np.zeros(values.shape, np.int16)
        _wind(counts, origin, cell, mesh.triangles_mm)
        np.cumsum(counts, axis=0, out=counts)
        np.negative(values, out=values, where=counts > 0)
    return DistanceField(values, origin, cell, margin_mm, band_mm)


def cache_folder() -> Path:
    """The folder that caches fields: `surgisoft/fields` in the user's cache folder (XDG)."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "surgisoft" / "fields"


def load_field(
    mesh: Mesh,
    margin_mm: float,
    band_mm: float,
    most_nodes: int = MOST_NODES,
    tree: TriangleTree | None = None,
    folder: Path | None = None,
) -> DistanceField:
    """The field of a mesh from the cache on disk; built and stored if it is absent or damaged.

    If the folder cannot be written, the field is built each time.
    """
    if not (margin_mm > 0.0 and band_mm > 0.0):
        raise InputError(f"field margin {margin_mm} mm, band {band_mm} mm: expected more than 0")
    key = f"{FORMAT} {mesh.content_hash} {margin_mm:.9g} {band_mm:.9g} {most_nodes}"
    name = hashlib.sha256(key.encode()).hexdigest()[:32]
    path = (folder or cache_folder()) / f"{name}.field"
    origin, cell, shape = _grid(mesh, margin_mm, most_nodes)
    values = _read(path, tuple(shape))
    if values is None:
        built = build_field(mesh, margin_mm, band_mm, most_nodes, tree)
        with contextlib.suppress(OSError):
            _write(path, built.values_mm)
        return built
    return DistanceField(values, origin, cell, margin_mm, band_mm)


def _read(path: Path, shape: tuple[int, ...]) -> np.ndarray | None:
    """The stored values, None when absent, cut short, altered or of another shape."""
    try:
        with path.open("rb") as file:
            digest = file.read(32)
            content = file.read()
    except OSError:
        return None
    if hashlib.sha256(content).digest() != digest or len(content) != 4 * math.prod(shape):
        return None
    return np.frombuffer(content, "<f4").reshape(shape).astype(np.float32)


def _write(path: Path, values: np.ndarray) -> None:
    """Store values behind their sha256, whole or not at all."""
    content = values.astype("<f4").tobytes()
    write_atomically(path, hashlib.sha256(content).digest() + content, noted=False)
