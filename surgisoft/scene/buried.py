"""Where a surface that crosses itself lies inside its own solid: sheets that no beam can reach."""

import numpy as np

from surgisoft.scene import frames
from surgisoft.scene.mesh import Mesh
from surgisoft.scene.rays import EmbreeSurface

ABOVE_MM = 1e-3
"""Points are asked about this far outside their own sheet (mm); crossings are parted by it too."""
TILTS = ((0.0, 0.0), (0.23, 0.11), (-0.17, 0.19))
"""Rays leave at these slopes to the normal; two of three must agree: one may meet an edge."""
MOST_CROSSINGS = 64
"""A ray that crosses more sheets than this is no longer followed."""


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


def buried_faces(mesh: Mesh) -> int:
    """How many faces have their middle inside the mesh's own solid."""
    return int(buried(mesh, mesh.triangles_mm.mean(axis=1), mesh.face_normals).sum())
