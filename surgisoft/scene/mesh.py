"""Triangle meshes in memory, rigid bodies made of them, and index arithmetic on their faces.

Every geometric engine works on these classes. `meshio` reads and writes mesh files.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, lru_cache, wraps
from typing import TypeVar, TypeVarTuple

import numpy as np

from surgisoft.errors import InputError, unknown_name
from surgisoft.scene import frames

ROLES = ("organ", "keep-out", "support")
KEPT = 8
"""Meshes of which `kept` holds what was made, the last ones that were asked for (a count)."""

Given = TypeVarTuple("Given")
Made = TypeVar("Made")


def _frozen(array: np.ndarray) -> np.ndarray:
    array.setflags(write=False)
    return array


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh; outward faces wind counter-clockwise. Arrays are copied and read-only."""

    vertices_mm: np.ndarray
    """(V, 3) float64, mm, in the mesh's own frame."""
    faces: np.ndarray
    """(F, 3) int32, rows of vertex indices."""

    def __post_init__(self):
        vertices = np.array(self.vertices_mm, dtype=np.float64, order="C")
        faces = np.array(self.faces, dtype=np.int64, order="C")
        if vertices.ndim != 2 or vertices.shape[1] != 3 or len(vertices) == 0:
            raise InputError(f"mesh vertices have shape {vertices.shape}: expected (V, 3), V > 0")
        if faces.ndim != 2 or faces.shape[1] != 3 or len(faces) == 0:
            raise InputError(f"mesh faces have shape {faces.shape}: expected (F, 3), F > 0")
        if not np.isfinite(vertices).all():
            bad = int(np.argmin(np.isfinite(vertices).all(axis=1)))
            raise InputError(f"mesh vertex {bad} is not finite: expected millimetres, repair it")
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise InputError(
                f"mesh faces name vertices {faces.min()}..{faces.max()}: "
                f"expected 0..{len(vertices) - 1}"
            )
        object.__setattr__(self, "vertices_mm", _frozen(vertices))
        object.__setattr__(self, "faces", _frozen(faces.astype(np.int32)))

    @cached_property
    def triangles_mm(self) -> np.ndarray:
        """(F, 3, 3) float64, mm: the corners of each face."""
        return _frozen(self.vertices_mm[self.faces])

    @cached_property
    def _area_vectors(self) -> np.ndarray:
        """(F, 3): normal times twice the area, mm^2."""
        a, b, c = np.moveaxis(self.triangles_mm, 1, 0)
        return np.cross(b - a, c - a)

    @cached_property
    def face_areas_mm2(self) -> np.ndarray:
        """(F,) float64, mm^2."""
        return _frozen(0.5 * np.linalg.norm(self._area_vectors, axis=1))

    @cached_property
    def face_normals(self) -> np.ndarray:
        """(F, 3) float64 outward unit normals; zero for a face without area."""
        return _frozen(frames.normalise(self._area_vectors))

    @cached_property
    def corner_angles_rad(self) -> np.ndarray:
        """(F, 3) float64, rad: the face's angle at each of its corners."""
        corners = self.triangles_mm
        ahead = np.roll(corners, -1, axis=1) - corners
        behind = np.roll(corners, 1, axis=1) - corners
        return _frozen(frames.angle_between(ahead, behind))

    @cached_property
    def vertex_normals(self) -> np.ndarray:
        """(V, 3) float64 unit normals, faces weighted by angle (Baerentzen & Aanaes 2005)."""
        weighted = self.face_normals[:, None, :] * self.corner_angles_rad[..., None]
        total = np.zeros_like(self.vertices_mm)
        np.add.at(total, self.faces.ravel(), weighted.reshape(-1, 3))
        return _frozen(frames.normalise(total))

    @property
    def _directed_edges(self) -> np.ndarray:
        """(3 F, 2) edges 01, 12, 20 of each face in turn."""
        return np.stack((self.faces, np.roll(self.faces, -1, axis=1)), axis=-1).reshape(-1, 2)

    @cached_property
    def bounds_mm(self) -> np.ndarray:
        """(2, 3) float64, mm: lowest and highest corner of the axis-aligned box."""
        used = self.vertices_mm[np.unique(self.faces)]
        return _frozen(np.stack((used.min(axis=0), used.max(axis=0))))

    @cached_property
    def is_watertight(self) -> bool:
        """Whether every edge lies between exactly two faces with opposite senses."""
        directed = self._directed_edges.astype(np.int64)
        count = len(self.vertices_mm)
        forward = np.sort(directed[:, 0] * count + directed[:, 1])
        backward = np.sort(directed[:, 1] * count + directed[:, 0])
        once = not (forward[1:] == forward[:-1]).any()
        return bool(once and np.array_equal(forward, backward))

    @cached_property
    def volume_mm3(self) -> float:
        """Enclosed volume by the divergence theorem; positive when the faces wind outwards."""
        corners = self.triangles_mm - self.bounds_mm.mean(axis=0)
        return float(np.einsum("ij,ij->i", corners[:, 0], self._area_vectors).sum() / 6.0)

    @cached_property
    def content_hash(self) -> str:
        """sha256 in hex over the vertices' and faces' little-endian bytes and their counts."""
        digest = hashlib.sha256(f"mesh {len(self.vertices_mm)} {len(self.faces)}\n".encode())
        digest.update(self.vertices_mm.astype("<f8").tobytes())
        digest.update(self.faces.astype("<i4").tobytes())
        return digest.hexdigest()

    def transformed(self, pose: np.ndarray) -> Mesh:
        """This mesh moved by a pose (4, 4): vertices in the pose's parent frame."""
        return Mesh(frames.apply(pose, self.vertices_mm), self.faces)


@dataclass(frozen=True)
class _Named:
    """A mesh, equal to those of equal content."""

    content: str
    mesh: Mesh = field(compare=False)


def kept(make: Callable[[Mesh, *Given], Made]) -> Callable[[Mesh, *Given], Made]:
    """A function of a mesh whose results are kept, for the next scene with an equal mesh.

    The other arguments have a hash. The last `KEPT` results are kept and shared: they are not to be
    changed.
    """

    @lru_cache(maxsize=KEPT)
    def known(named: _Named, *given: *Given) -> Made:
        return make(named.mesh, *given)

    @wraps(make)
    def of(mesh: Mesh, *given: *Given) -> Made:
        return known(_Named(mesh.content_hash, mesh), *given)

    return of


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid body of the scene: a mesh, its pose, and its role."""

    name: str
    """Unique among the scene's bodies."""
    role: str
    """organ (the laser's target), keep-out (must not be touched) or support."""
    mesh: Mesh
    """The surface, mm, in the body's own frame."""
    pose: np.ndarray = field(default_factory=frames.identity)
    """(4, 4) float64: body frame to world frame, mm."""

    def __post_init__(self):
        if self.role not in ROLES:
            raise unknown_name("body role", self.role, ROLES)
        pose = np.array(self.pose, dtype=np.float64)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise InputError(f"body '{self.name}' has a pose of shape {pose.shape}: expected 4x4")
        turn = pose[:3, :3]
        if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-6 or np.linalg.det(turn) < 0:
            raise InputError(
                f"body '{self.name}' has a pose that is not a rotation: scale the mesh"
            )
        object.__setattr__(self, "pose", _frozen(pose))

    @cached_property
    def world_mesh(self) -> Mesh:
        """The mesh in the world frame, mm."""
        return self.mesh.transformed(self.pose)


def used_indices(index: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distinct indices, ascending (U,), and `index` (any shape) renumbered by rank among them.

    Like `numpy.unique(return_inverse=True)`, which takes seconds for a million faces because it
    hashes. The indices are whole numbers from 0, with a maximum not far above their count.
    """
    flags = np.zeros(int(index.max(initial=-1)) + 1, dtype=bool)
    flags[index] = True
    used = np.flatnonzero(flags)
    place = np.empty(len(flags), dtype=np.int64)
    place[used] = np.arange(len(used))
    return used, place[index]


def equal_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Groups of equal rows (N, K): index of the first row (G,), group (N,) of each row, size (G,).

    The groups are in the order of `numpy.unique(axis=0)`, which is slower because it compares row
    by row.
    """
    order = np.lexsort(rows.T[::-1])
    ranked = rows[order]
    new = np.ones(len(rows), dtype=bool)
    new[1:] = (ranked[1:] != ranked[:-1]).any(axis=1)
    start = np.flatnonzero(new)
    group = np.empty(len(rows), dtype=np.int64)
    group[order] = np.cumsum(new) - 1
    # lexsort is stable: the first of a group is its first row
    return order[start], group, np.diff(np.r_[start, len(rows)])
