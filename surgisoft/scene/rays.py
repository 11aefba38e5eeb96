"""Rays through the scene: what a laser beam or a line of sight meets first.

Both engines return a `RayHit`: the exact one in `collision`, the batched one in `batched`. The rest
of this module is the batched engine's part on the CPU, compiled: the hits on bodies by a walk
through the tree of their faces, those on arms by closed forms. `EmbreeSurface` does the same for
one mesh without arms, as pictures and the placing of lesions need it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from surgisoft.compiled import compiled
from surgisoft.extras import with_advice
from surgisoft.scene.bvh import STACK, line_triangle, triangle
from surgisoft.scene.mesh import Body, Mesh

with with_advice():
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene


class Struck(IntEnum):
    """Kind of body that a ray hits first."""

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


@compiled(inner=True)
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


@compiled
def aim_rays(origins, directions, origin, aim):
    """Origins (N, 3) and unit directions (N, 3) as float64; nan for a ray that is not finite."""
    for n in range(len(origin)):
        x = np.float64(directions[n, 0])
        y = np.float64(directions[n, 1])
        z = np.float64(directions[n, 2])
        length = math.sqrt(x * x + y * y + z * z)
        length = length if length > 0.0 else 1.0
        aim[n, 0], aim[n, 1], aim[n, 2] = x / length, y / length, z / length
        for i in range(3):
            origin[n, i] = origins[n, i]


@compiled(inner=True)
def _nearest_face(p, d, best, triangles, starts, lower, upper, nodes, entry):
    """Distance to and tree index of the first face on a ray before `best`; -1 for none."""
    leaves = len(starts) - 1
    ix = 1.0 / d[0] if d[0] != 0.0 else 1e300
    iy = 1.0 / d[1] if d[1] != 0.0 else 1e300
    iz = 1.0 / d[2] if d[2] != 0.0 else 1e300
    face = -1
    nodes[0], size = 0, 1
    entry[0] = _entry(p, ix, iy, iz, lower, upper, nodes[0])
    while size > 0:
        size -= 1
        node = nodes[size]
        if entry[size] > best:
            continue
        if node >= leaves - 1:
            leaf = node - (leaves - 1)
            for k in range(starts[leaf], starts[leaf + 1]):
                a, b, c = triangle(triangles, k)
                t = line_triangle(p, d, a, b, c)
                if 0.0 <= t < best:
                    best, face = t, k
            continue
        one, two = 2 * node + 1, 2 * node + 2
        to_one = _entry(p, ix, iy, iz, lower, upper, one)
        to_two = _entry(p, ix, iy, iz, lower, upper, two)
        if to_one < to_two:
            one, two, to_one, to_two = two, one, to_two, to_one
        if to_one <= best:
            nodes[size], entry[size] = one, to_one
            size += 1
        if to_two <= best:
            nodes[size], entry[size] = two, to_two
            size += 1
    return best, face


@compiled(inner=True)
def _entry(p, ix, iy, iz, lower, upper, node):
    """Where a ray enters a box, inf for a miss; rounding may not lose a box that it grazes."""
    one, two = (lower[node, 0] - p[0]) * ix, (upper[node, 0] - p[0]) * ix
    first, last = min(one, two), max(one, two)
    one, two = (lower[node, 1] - p[1]) * iy, (upper[node, 1] - p[1]) * iy
    first, last = max(first, min(one, two)), min(last, max(one, two))
    one, two = (lower[node, 2] - p[2]) * iz, (upper[node, 2] - p[2]) * iz
    first, last = max(first, min(one, two)), min(last, max(one, two))
    return max(first, 0.0) - 1e-9 if first <= last + 1e-9 and last >= -1e-9 else math.inf


@compiled
def rays_to_body(
    origins, aims, each, turns, shifts, tree, order, normals, which, kind, struck, body, face, t, n
):
    """First hits of rays (N, 3) on a body, where they are nearer than t (N,) mm.

    `each` rays belong to one environment; turns (B or 1, 3, 3) and shifts (B or 1, 3): world to
    body, rigid or with strain. Writes struck, body and face (N,), distance t (N,) and normal n
    (N, 3), world frame.
    """
    triangles, starts, lower, upper = tree
    nodes, entry = np.empty(STACK, np.int64), np.empty(STACK)
    for k in range(len(t)):
        pose = k // each if len(turns) > 1 else 0
        turn, shift = turns[pose], shifts[pose]
        p, d = _turned(turn, origins, k), _turned(turn, aims, k)
        p = (p[0] + shift[0], p[1] + shift[1], p[2] + shift[2])
        if not math.isfinite(p[0] + p[1] + p[2] + d[0] + d[1] + d[2]):
            continue
        distance, found = _nearest_face(p, d, t[k], triangles, starts, lower, upper, nodes, entry)
        if found >= 0:
            t[k], face[k], body[k], struck[k] = distance, order[found], which, kind
            out, size = normals[order[found]], 0.0
            for i in range(3):
                n[k, i] = turn[0, i] * out[0] + turn[1, i] * out[1] + turn[2, i] * out[2]
                size += n[k, i] * n[k, i]
            if abs(size - 1.0) > 1e-9:  # a strained body
                for i in range(3):
                    n[k, i] /= math.sqrt(size)


@compiled
def _turned(turn, vectors, k):
    """Rotation (3, 3) times vector k, as a tuple."""
    x, y, z = vectors[k, 0], vectors[k, 1], vectors[k, 2]
    return (
        turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z,
        turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z,
        turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z,
    )


@compiled
def chain_hits(origins, aims, each, lines, kind, before, segment, struck, body, face, t, n):
    """Mark rays (N, 3) that meet an arm (B, K, 3) at t (N,) mm, nearer than `before` (N,).

    segment (N,) is the one that is met; the normal n (N, 3) points away from its axis.
    """
    for k in range(len(t)):
        if not t[k] < before[k]:
            continue
        body[k], face[k], struck[k] = -1, -1, kind
        b, s = k // each, segment[k]
        x = origins[k, 0] + t[k] * aims[k, 0] - lines[b, s, 0]
        y = origins[k, 1] + t[k] * aims[k, 1] - lines[b, s, 1]
        z = origins[k, 2] + t[k] * aims[k, 2] - lines[b, s, 2]
        ux = np.float64(lines[b, s + 1, 0]) - np.float64(lines[b, s, 0])
        uy = np.float64(lines[b, s + 1, 1]) - np.float64(lines[b, s, 1])
        uz = np.float64(lines[b, s + 1, 2]) - np.float64(lines[b, s, 2])
        share = (x * ux + y * uy + z * uz) / (ux * ux + uy * uy + uz * uz + 1e-30)
        share = min(max(share, 0.0), 1.0)
        x, y, z = x - share * ux, y - share * uy, z - share * uz
        length = math.sqrt(x * x + y * y + z * z)
        length = length if length > 0.0 else 1.0
        n[k, 0], n[k, 1], n[k, 2] = x / length, y / length, z / length


@compiled
def ray_ends(origins, aims, t, n, point, normal, distance, incidence):
    """Ends (N, 3) mm, normals, distances and angles of incidence of rays that were followed."""
    for k in range(len(t)):
        distance[k] = t[k]
        ax, ay, az = aims[k, 0], aims[k, 1], aims[k, 2]
        for i in range(3):
            point[k, i] = origins[k, i] + t[k] * aims[k, i]
            normal[k, i] = n[k, i]
        cx, cy, cz = (
            n[k, 1] * az - n[k, 2] * ay,
            n[k, 2] * ax - n[k, 0] * az,
            n[k, 0] * ay - n[k, 1] * ax,
        )
        cosine = abs(n[k, 0] * ax + n[k, 1] * ay + n[k, 2] * az)
        incidence[k] = math.atan2(math.sqrt(cx * cx + cy * cy + cz * cz), cosine)
