"""The organ's surface around the cut, divided finely enough to colour it by its dose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from surgisoft.scene import frames
from surgisoft.scene.dose_patch import LESION
from surgisoft.scene.mesh import Mesh
from surgisoft.scene.render import corner_normals
from surgisoft.tasks.episodes.parts import DoseLog

EDGE_MM = 0.4
"""Longest edge of the coloured triangles (mm); the narrowest cut is a few of them wide."""
NEAR_MM = 0.6
"""A vertex takes its dose from samples within this distance (mm)."""
NEIGHBOURS = 3
"""Number of samples whose mean a vertex takes."""
COARSE = 8
"""Faces with edges longer than this many EDGE_MM are quartered first, if samples are near."""


@dataclass(frozen=True, eq=False)
class DosedSurface:
    """Triangles that replace the faces `replaced` of the organ's mesh; its frame, mm."""

    vertices_mm: np.ndarray
    """(V, 3) mm."""
    faces: np.ndarray
    """(F, 3)."""
    normals: np.ndarray
    """(V, 3) unit normals."""
    replaced: np.ndarray
    """(R,) faces of the organ's mesh that these triangles replace."""
    samples: np.ndarray
    """(V, NEIGHBOURS) samples of the dose that each vertex takes the mean of; P for none."""

    inside: np.ndarray
    """(V,) bool: inside the ring, so part of the lesion."""

    def heat(self, dose: np.ndarray, threshold: float) -> np.ndarray:
        """(V,) dose at the vertices as a share of the threshold, for doses (P,), J/mm^2."""
        padded = np.append(dose, 0.0) / threshold
        known = np.maximum((self.samples < len(dose)).sum(axis=1), 1)
        return padded[self.samples].sum(axis=1) / known


def dosed_surface(mesh: Mesh, dose: DoseLog, edge_mm: float = EDGE_MM) -> DosedSurface:
    """The faces of the organ's mesh that carry samples of the dose, divided to `edge_mm`."""
    tree = cKDTree(dose.points_mm)
    replaced = np.unique(dose.faces)
    pieces = np.stack((mesh.triangles_mm, corner_normals(mesh)), axis=2)[replaced]
    pieces = _quartered(pieces, tree, COARSE * edge_mm)
    parts = np.where(
        _near(pieces, tree, edge_mm), np.ceil(_longest(pieces) / edge_mm).astype(int), 1
    )
    vertices, triples, count = [], [], 0
    for n in np.unique(parts):
        weights, triangles = _grid(int(n))
        made = np.einsum("wc,qcsx->qwsx", weights, pieces[parts == n])
        vertices.append(made.reshape(-1, 2, 3))
        first = count + len(weights) * np.arange(len(made))
        triples.append((first[:, None, None] + triangles).reshape(-1, 3))
        count += made.shape[0] * made.shape[1]
    points, normals = np.moveaxis(np.concatenate(vertices), 1, 0)
    _, samples = tree.query(points, NEIGHBOURS, distance_upper_bound=NEAR_MM)
    inside = np.append(dose.zone == LESION, False)[samples[:, 0]]
    faces = np.concatenate(triples)
    return DosedSurface(points, faces, frames.normalise(normals), replaced, samples, inside)


def _longest(pieces: np.ndarray) -> np.ndarray:
    """(Q,) mm: longest edge of pieces (Q, 3, 2, 3)."""
    corners = pieces[:, :, 0]
    return frames.norm(np.roll(corners, -1, axis=1) - corners).max(axis=1)


def _near(pieces: np.ndarray, tree: cKDTree, margin_mm: float) -> np.ndarray:
    """(Q,) bool: some sample lies within the margin of the piece's circle."""
    corners = pieces[:, :, 0]
    middles = corners.mean(axis=1)
    size = frames.norm(corners - middles[:, None]).max(axis=1)
    return tree.query(middles)[0] <= size + margin_mm


def _quartered(pieces: np.ndarray, tree: cKDTree, longest_mm: float) -> np.ndarray:
    """The pieces; those near samples are quartered until no edge is longer than longest_mm."""
    done = []
    while len(pieces):
        large = (_longest(pieces) > longest_mm) & _near(pieces, tree, NEAR_MM)
        done.append(pieces[~large])
        a, b, c = np.moveaxis(pieces[large], 1, 0)
        d, e, f = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
        quarters = ((a, d, f), (d, b, e), (f, e, c), (d, e, f))
        pieces = np.concatenate([np.stack(corners, axis=1) for corners in quarters])
    return np.concatenate(done)


def _grid(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Barycentric weights (W, 3) of a triangle's n^2 equal parts, and the parts (n^2, 3)."""
    place = {
        (i, j): k for k, (i, j) in enumerate((i, j) for i in range(n + 1) for j in range(n + 1 - i))
    }
    v, w = np.array(list(place)).T / n
    upright = [
        (place[i, j], place[i + 1, j], place[i, j + 1]) for i in range(n) for j in range(n - i)
    ]
    hanging = [
        (place[i + 1, j], place[i + 1, j + 1], place[i, j + 1])
        for i in range(n)
        for j in range(n - i - 1)
    ]
    return np.stack((1.0 - v - w, v, w), axis=1), np.array(upright + hanging)
