"""Rays through the scene: what a laser beam or a line of sight meets first.

Both engines return a `RayHit`: the exact one in `collision`, the batched one in `batched`. The rest
of this module is the batched engine's part on the CPU: Embree finds the face, float64 arithmetic
the point on it, and compiled closed forms the hits on arms.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene

from surgisoft.compiled import compiled
from surgisoft.scene.mesh import Body, Mesh


class Struck(IntEnum):
    """What a ray meets first."""

    NOTHING = 0
    ORGAN = 1
    KEEP_OUT = 2
    SUPPORT = 3
    OTHER_ARM = 4
    OWN_ARM = 5


STRUCK_BY_ROLE = {
    "organ": Struck.ORGAN,
    "keep-out": Struck.KEEP_OUT,
    "support": Struck.SUPPORT,
}


def struck_of(body: Body) -> Struck:
    """The `Struck` value of a ray that hits this body."""
    return STRUCK_BY_ROLE[body.role]


@dataclass(frozen=True, eq=False)
class RayHit:
    """First hits of rays; numpy or torch arrays of one leading shape (...). World frame.

    A miss is finite: struck NOTHING, the point at the end of the range, normal against the ray.
    """

    struck: Any
    """(...) int8, a `Struck`: what was met first."""
    body: Any
    """(...) int32, index of the body met, -1 for an arm or nothing."""
    face: Any
    """(...) int32, face of that body's mesh, -1 for an arm or nothing."""
    distance_mm: Any
    """(...) mm along the ray; the range for a miss."""
    point_mm: Any
    """(..., 3) mm, where the ray ends."""
    normal: Any
    """(..., 3) outward unit normal of the surface met."""
    incidence_rad: Any
    """(...) rad in 0..pi/2 between the ray and the surface's normal; 0 for a miss."""

    @property
    def on_organ(self) -> Any:
        """(...) bool: the ray hits the organ first."""
        return self.struck == int(Struck.ORGAN)

    @property
    def missed(self) -> Any:
        """(...) bool: nothing within the range."""
        return self.struck == int(Struck.NOTHING)

    @property
    def blocked(self) -> Any:
        """(...) bool: the ray hits something other than the organ first."""
        return self.struck > int(Struck.ORGAN)


class EmbreeSurface:
    """First hits of many rays on one mesh by Embree, in the mesh's own frame."""

    def __init__(self, mesh: Mesh):
        self._triangles = mesh.triangles_mm
        self._middle = mesh.bounds_mm.mean(axis=0)
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, (mesh.vertices_mm - self._middle).astype(np.float32), mesh.faces)
        self._mesh = mesh

    def __reduce__(self):
        """Pickle the mesh: Embree's scene cannot be pickled, so a copy builds its own."""
        return type(self), (self._mesh,)

    def first_hit(
        self, origins_mm: np.ndarray, directions: np.ndarray, range_mm: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Distances (N,) mm and faces (N,) of unit rays (N, 3) float64; range and -1 for a miss.

        Embree works in float32, so the distance is computed again in float64 in the plane of the
        face. Rays that are not finite miss. A ray aimed exactly at a mesh vertex may pass through
        it (4 in 1,000 such rays; none of 40,000 random ones); FCL does not have this flaw.
        """
        finite = np.isfinite(origins_mm).all(axis=1) & np.isfinite(directions).all(axis=1)
        origins = np.where(finite[:, None], origins_mm - self._middle, 1e6)
        aims = np.where(finite[:, None], directions, [0.0, 0.0, 1.0])
        found = self._scene.run(
            origins.astype(np.float32), aims.astype(np.float32), output=True, query="INTERSECT"
        )
        face = found["primID"].astype(np.int64)
        struck = np.flatnonzero(face >= 0)
        distance = np.full(len(origins), float(range_mm))
        distance[struck] = _plane_hits(
            origins_mm, directions, self._triangles, struck, face, found["tfar"]
        )
        beyond = ~(distance < range_mm)
        face[beyond], distance[beyond] = -1, range_mm
        return distance, face


@compiled
def _plane_hits(origins, directions, triangles, rays, faces, coarse):
    """Distances (M,) mm along rays number `rays` to the planes of their faces.

    For a face seen edge-on the result is Embree's own distance.
    """
    out = np.empty(len(rays))
    for m in range(len(rays)):
        n, f = rays[m], faces[rays[m]]
        ax, ay, az = triangles[f, 0, 0], triangles[f, 0, 1], triangles[f, 0, 2]
        ux, uy, uz = triangles[f, 1, 0] - ax, triangles[f, 1, 1] - ay, triangles[f, 1, 2] - az
        vx, vy, vz = triangles[f, 2, 0] - ax, triangles[f, 2, 1] - ay, triangles[f, 2, 2] - az
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        ox, oy, oz = ax - origins[n, 0], ay - origins[n, 1], az - origins[n, 2]
        along = directions[n, 0] * nx + directions[n, 1] * ny + directions[n, 2] * nz
        if abs(along) > 1e-6 * math.sqrt(nx * nx + ny * ny + nz * nz):
            out[m] = max(0.0, (ox * nx + oy * ny + oz * nz) / along)
        else:
            out[m] = coarse[n]
    return out


@compiled
def capsule_entry(origin, d, a, b, radius):
    """Distance along the ray to capsule a b, inf for a miss; see `capsules.ray_capsule`."""
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    length = math.sqrt(ux * ux + uy * uy + uz * uz)
    if length > 0.0:
        ux, uy, uz = ux / length, uy / length, uz / length
    wx, wy, wz = origin[0] - a[0], origin[1] - a[1], origin[2] - a[2]
    height = wx * ux + wy * uy + wz * uz
    along = d[0] * ux + d[1] * uy + d[2] * uz
    fx, fy, fz = wx - height * ux, wy - height * uy, wz - height * uz
    gx, gy, gz = d[0] - along * ux, d[1] - along * uy, d[2] - along * uz
    held = min(max(height, 0.0), length)
    px, py, pz = wx - held * ux, wy - held * uy, wz - held * uz
    if px * px + py * py + pz * pz <= radius * radius:
        return 0.0
    best = math.inf
    slope = gx * gx + gy * gy + gz * gz
    if slope > 1e-24:
        t = -(fx * gx + fy * gy + fz * gz) / slope
        mx, my, mz = fx + t * gx, fy + t * gy, fz + t * gz
        half = radius * radius - (mx * mx + my * my + mz * mz)
        if half >= 0.0:
            t -= math.sqrt(half / slope)
            if t >= 0.0 and 0.0 <= height + t * along <= length:
                best = t
    for end in range(2):
        cx, cy, cz = wx - end * length * ux, wy - end * length * uy, wz - end * length * uz
        t = -(cx * d[0] + cy * d[1] + cz * d[2])
        mx, my, mz = cx + t * d[0], cy + t * d[1], cz + t * d[2]
        half = radius * radius - (mx * mx + my * my + mz * mz)
        if half >= 0.0:
            t -= math.sqrt(half)
            if 0.0 <= t < best:
                best = t
    return best


@compiled
def rays_to_chains(origins, directions, lines, radius, gap, distance, segment):
    """First hits of rays (B, R, 3) on arms (B, K, 3), mm, into distance, segment (B, R).

    Only hits nearer than the given `distance` count. Segments within `gap` mm of arc from the tip
    are ignored (a negative gap ignores none).
    """
    segments = lines.shape[1] - 1
    halves = np.empty(segments)
    middles, line = np.empty((segments, 3)), np.empty((segments + 1, 3))
    for n in range(len(lines)):
        arc, free = 0.0, 0
        for k in range(segments, -1, -1):
            for i in range(3):
                line[k, i] = lines[n, k, i]
            if k < segments:
                dx, dy, dz = (
                    line[k + 1, 0] - line[k, 0],
                    line[k + 1, 1] - line[k, 1],
                    line[k + 1, 2] - line[k, 2],
                )
                length = math.sqrt(dx * dx + dy * dy + dz * dz)
                halves[k] = 0.5 * length
                free = max(free, k + 1) if arc >= gap else free
                arc += length
                for i in range(3):
                    middles[k, i] = 0.5 * (line[k, i] + line[k + 1, i])
        for r in range(origins.shape[1]):
            o = (origins[n, r, 0], origins[n, r, 1], origins[n, r, 2])
            d = (directions[n, r, 0], directions[n, r, 1], directions[n, r, 2])
            for k in range(free):
                x, y, z = middles[k, 0] - o[0], middles[k, 1] - o[1], middles[k, 2] - o[2]
                t = max(0.0, x * d[0] + y * d[1] + z * d[2])
                x, y, z = x - t * d[0], y - t * d[1], z - t * d[2]
                reach = radius + halves[k] + 1e-9
                if x * x + y * y + z * z <= reach * reach:
                    a = (line[k, 0], line[k, 1], line[k, 2])
                    b = (line[k + 1, 0], line[k + 1, 1], line[k + 1, 2])
                    hit = capsule_entry(o, d, a, b, radius)
                    if hit < distance[n, r]:
                        distance[n, r], segment[n, r] = hit, k
