"""Inside or outside a closed surface: the winding number as a sum of solid angles."""

from __future__ import annotations

import math

import numpy as np

from surgisoft.compiled import compiled
from surgisoft.scene.mesh import Mesh


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
    """(N,) how often the mesh winds about points (N, 3) mm of its own frame: 1 inside, 0 outside.

    Cost grows with points times faces; exact to rounding for any closed mesh, also where several
    closed sheets overlap.
    """
    points = np.ascontiguousarray(points_mm, dtype=np.float64)
    out = np.empty(len(points))
    _solid_angles(points, mesh.triangles_mm, out)
    return out
