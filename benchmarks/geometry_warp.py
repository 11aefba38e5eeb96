"""Mesh queries as NVIDIA Warp kernels: what `geometry_engines.py` holds against the project's own.

Warp's mesh is float32. Kernels with float64 in their names take the face from Warp and repeat the
arithmetic in float64.
"""

import numpy as np
import warp as wp

wp.config.log_level = wp.LOG_ERROR
Lines = wp.array2d(dtype=wp.vec3)
Points = wp.array(dtype=wp.vec3)
Points64 = wp.array(dtype=wp.vec3d)
Numbers = wp.array(dtype=wp.float32)
Numbers64 = wp.array(dtype=wp.float64)
Faces = wp.array(dtype=wp.int32)
FAR = wp.constant(1e6)


@wp.func
def segments_d2(p: wp.vec3d, q: wp.vec3d, a: wp.vec3d, b: wp.vec3d):
    """Squared distance of two segments, as `bvh.segments_d2`."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    d1 = q - p
    d2 = b - a
    r = p - a
    aa = wp.dot(d1, d1)
    ee = wp.dot(d2, d2)
    bb = wp.dot(d1, d2)
    cc = wp.dot(d1, r)
    ff = wp.dot(d2, r)
    aa_safe = wp.where(aa > zero, aa, one)
    ee_safe = wp.where(ee > zero, ee, one)
    s = zero
    if aa * ee - bb * bb > wp.float64(1e-15) * aa * ee:
        s = wp.clamp((bb * ff - cc * ee) / (aa * ee - bb * bb), zero, one)
    t = wp.clamp((bb * s + ff) / ee_safe, zero, one)
    s = wp.clamp((bb * t - cc) / aa_safe, zero, one)
    t = wp.clamp((bb * s + ff) / ee_safe, zero, one)
    return wp.length_sq(r + s * d1 - t * d2)


@wp.func
def over_d2(p: wp.vec3d, a: wp.vec3d, n: wp.vec3d, b: wp.vec3d, c: wp.vec3d, far: wp.float64):
    """Squared height of p over the face a b c with normal n, `far` if it stands beside the face."""
    zero = wp.float64(0.0)
    square = wp.dot(n, n)
    if square == zero:
        return far
    v = wp.dot(wp.cross(p - a, c - a), n) / square
    w = wp.dot(wp.cross(b - a, p - a), n) / square
    if v < zero or w < zero or v + w > wp.float64(1.0):
        return far
    height = wp.dot(p - a, n)
    return height * height / square


@wp.func
def segment_triangle_d2(
    p: wp.vec3d, q: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d, bound2: wp.float64
):
    """Squared distance of a segment to a triangle, at most bound2, as in `bvh`."""
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    n = wp.cross(b - a, c - a)
    above_p = wp.dot(n, p - a)
    above_q = wp.dot(n, q - a)
    nearest = wp.min(wp.abs(above_p), wp.abs(above_q))
    best = bound2
    if above_p * above_q > zero:
        if nearest * nearest >= bound2 * wp.dot(n, n):
            return best
    elif above_p != above_q:
        share = above_p / (above_p - above_q)
        at = p + share * (q - p)
        if share >= zero and share <= one and over_d2(at, a, n, b, c, one) < wp.float64(0.5):
            return zero
    best = wp.min(best, over_d2(p, a, n, b, c, best))
    best = wp.min(best, over_d2(q, a, n, b, c, best))
    best = wp.min(best, segments_d2(p, q, a, b))
    best = wp.min(best, segments_d2(p, q, b, c))
    return wp.min(best, segments_d2(p, q, c, a))


@wp.kernel
def rays(mesh: wp.uint64, o: Points, d: Points, reach: float, out: Numbers, face: Faces):
    """Distance and face of each ray, in float32."""
    i = wp.tid()
    hit = wp.mesh_query_ray(mesh, o[i], d[i], reach)
    out[i] = reach
    face[i] = -1
    if hit.result:
        out[i] = hit.t
        face[i] = hit.face


@wp.kernel
def rays_float64(
    mesh: wp.uint64,
    corners: Points64,
    o: Points64,
    d: Points64,
    reach: wp.float64,
    out: Numbers64,
    face: Faces,
):
    """Distance and face of each ray; the distance is recomputed in float64 in the face's plane."""
    i = wp.tid()
    hit = wp.mesh_query_ray(mesh, wp.vec3(o[i]), wp.vec3(d[i]), wp.float32(reach))
    out[i] = reach
    face[i] = -1
    if hit.result:
        face[i] = hit.face
        a = corners[3 * hit.face]
        n = wp.cross(corners[3 * hit.face + 1] - a, corners[3 * hit.face + 2] - a)
        along = wp.dot(d[i], n)
        out[i] = wp.float64(hit.t)
        if wp.abs(along) > wp.float64(1e-6) * wp.length(n):
            out[i] = wp.max(wp.float64(0.0), wp.dot(a - o[i], n) / along)


@wp.kernel
def points(mesh: wp.uint64, p: Points, out: Numbers, face: Faces):
    """Distance and nearest face of each point."""
    i = wp.tid()
    found = wp.mesh_query_point_no_sign(mesh, p[i], FAR)
    at = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
    out[i] = wp.length(at - p[i])
    face[i] = found.face


@wp.kernel
def inside_three_rays(mesh: wp.uint64, p: Points, out: wp.array(dtype=wp.bool)):
    """Whether each point is inside, by three rays."""
    out[wp.tid()] = wp.mesh_query_point(mesh, p[wp.tid()], FAR).sign < 0.0


@wp.kernel
def inside_parity(mesh: wp.uint64, p: Points, out: wp.array(dtype=wp.bool)):
    """Whether each point is inside, by the parity of hits."""
    out[wp.tid()] = wp.mesh_query_point_sign_parity(mesh, p[wp.tid()], FAR, 3).sign < 0.0


@wp.kernel
def inside_winding(mesh: wp.uint64, p: Points, out: wp.array(dtype=wp.bool)):
    """Whether each point is inside, by the winding number."""
    out[wp.tid()] = wp.mesh_query_point_sign_winding_number(mesh, p[wp.tid()], FAR).sign < 0.0


@wp.func
def distance_below(mesh: wp.uint64, p: wp.vec3, bound: float):
    """Distance of p to the surface if below bound, bound otherwise."""
    found = wp.mesh_query_point_no_sign(mesh, p, bound)
    if not found.result:
        return bound
    at = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
    return wp.min(wp.length(at - p), bound)


@wp.func
def with_depth(mesh: wp.uint64, lines: Lines, row: int, centre: float, unsure: float):
    """Least of the centreline's distance and its points' signed distances (mm).

    One point tells the side of all where the surface does not cut the line: where the distance,
    known to `unsure` mm, is not zero.
    """
    count = lines.shape[1]
    hit = wp.mesh_query_ray(mesh, lines[row, 0], wp.vec3(0.36, 0.48, 0.8), FAR)
    outside = not hit.result or hit.sign > 0.0
    if outside and centre > unsure:
        return centre
    least = centre
    for k in range(count):
        found = wp.mesh_query_point(mesh, lines[row, k], FAR)
        if found.sign < 0.0:
            at = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
            least = wp.min(least, -wp.length(at - lines[row, k]))
    return least


@wp.kernel
def chains_sampled(
    mesh: wp.uint64, lines: Lines, radius: float, horizon: float, step: float, out: Numbers
):
    """Clearance from points no farther than `step` mm apart on the centreline."""
    i = wp.tid()
    best = horizon + radius
    for k in range(lines.shape[1] - 1):
        p = lines[i, k]
        q = lines[i, k + 1]
        parts = wp.int32(wp.ceil(wp.length(q - p) / step))
        for j in range(parts + 1):
            at = p + (q - p) * (wp.float32(j) / wp.float32(wp.max(parts, 1)))
            best = distance_below(mesh, at, best)
    out[i] = wp.min(with_depth(mesh, lines, i, best, step) - radius, horizon)


@wp.kernel
def chains_bounded(
    mesh: wp.uint64,
    lines: Lines,
    radius: float,
    horizon: float,
    within: float,
    tolerance: float,
    out: Numbers,
):
    """Clearance to `tolerance` mm, farther than `within` to 1 mm, by halving the segments.

    A distance changes by no more than the way. So a part of half length h about a point at
    distance d holds nothing below d - h.
    """
    i = wp.tid()
    best = horizon + radius
    for k in range(lines.shape[1] - 1):
        best = distance_below(mesh, 0.5 * (lines[i, k] + lines[i, k + 1]), best)
    for k in range(lines.shape[1] - 1):
        p = lines[i, k]
        q = lines[i, k + 1]
        length = wp.length(q - p)
        level = wp.int32(0)
        place = wp.int32(0)
        while level >= 0:
            parts = wp.float32(1 << level)
            half = 0.5 * length / parts
            slack = wp.where(best - radius > within + 1.0, 1.0, tolerance)
            bound = best - slack + half
            descend = wp.bool(False)
            if bound > 0.0 and best > tolerance and level < 24:
                at = p + (q - p) * ((wp.float32(place) + 0.5) / parts)
                d = distance_below(mesh, at, bound)
                if d < bound:
                    best = wp.min(best, d)
                    slack = wp.where(best - radius > within + 1.0, 1.0, tolerance)
                    descend = d - half < best - slack
            if descend:
                level = level + 1
                place = 2 * place
            else:
                while level > 0 and place % 2 == 1:
                    level = level - 1
                    place = place / 2
                if level == 0:
                    level = -1
                else:
                    place = place + 1
    out[i] = wp.min(with_depth(mesh, lines, i, best, 1.1 * tolerance) - radius, horizon)


@wp.kernel
def chains_boxes_float64(
    mesh: wp.uint64,
    corners: Points64,
    lines: Lines,
    radius: float,
    horizon: float,
    within: float,
    out: Numbers,
):
    """Clearance from every face in the boxes that may hold the nearest, in float64."""
    i = wp.tid()
    best = horizon + radius
    longest = wp.float32(0.0)
    for k in range(lines.shape[1] - 1):
        best = distance_below(mesh, 0.5 * (lines[i, k] + lines[i, k + 1]), best)
        longest = wp.max(longest, wp.length(lines[i, k + 1] - lines[i, k]))
    if best - 0.5 * longest - radius <= within:
        best64 = wp.float64(best) + wp.float64(1e-3)
        for k in range(lines.shape[1] - 1):
            p = lines[i, k]
            q = lines[i, k + 1]
            reach = wp.float32(best64) + 1e-3
            bound = reach + 0.5 * wp.length(q - p)
            if best64 > wp.float64(0.0) and distance_below(mesh, 0.5 * (p + q), bound) < bound:
                span = wp.vec3(reach, reach, reach)
                query = wp.mesh_query_aabb(mesh, wp.min(p, q) - span, wp.max(p, q) + span)
                face = wp.int32(0)
                p64 = wp.vec3d(p)
                q64 = wp.vec3d(q)
                while wp.mesh_query_aabb_next(query, face):
                    a = corners[3 * face]
                    b = corners[3 * face + 1]
                    c = corners[3 * face + 2]
                    d2 = segment_triangle_d2(p64, q64, a, b, c, best64 * best64)
                    best64 = wp.min(best64, wp.sqrt(d2))
        best = wp.float32(best64)
    out[i] = wp.min(with_depth(mesh, lines, i, best, 1e-4) - radius, horizon)


@wp.func
def field_at(
    values: wp.array3d(dtype=wp.float32), origin: wp.vec3, cell: float, p: wp.vec3, far: float
):
    """Trilinear value (mm) of the project's distance field, `far` outside its grid."""
    x = (p - origin) / cell
    i = wp.int32(wp.floor(x[0]))
    j = wp.int32(wp.floor(x[1]))
    k = wp.int32(wp.floor(x[2]))
    if i < 0 or j < 0 or k < 0:
        return far
    if i >= values.shape[0] - 1 or j >= values.shape[1] - 1 or k >= values.shape[2] - 1:
        return far
    w = x[2] - wp.float32(k)
    v = x[1] - wp.float32(j)
    near = wp.lerp(
        wp.lerp(values[i, j, k], values[i, j, k + 1], w),
        wp.lerp(values[i, j + 1, k], values[i, j + 1, k + 1], w),
        v,
    )
    beyond = wp.lerp(
        wp.lerp(values[i + 1, j, k], values[i + 1, j, k + 1], w),
        wp.lerp(values[i + 1, j + 1, k], values[i + 1, j + 1, k + 1], w),
        v,
    )
    return wp.lerp(near, beyond, x[0] - wp.float32(i))


@wp.kernel
def chains_field_float64(
    mesh: wp.uint64,
    corners: Points64,
    values: wp.array3d(dtype=wp.float32),
    origin: wp.vec3,
    cell: float,
    band: float,
    slack: float,
    lines: Lines,
    radius: float,
    horizon: float,
    within: float,
    out: Numbers,
):
    """Clearance as the project takes it, its tree replaced by Warp's boxes: field, then float64."""
    i = wp.tid()
    estimate = wp.float32(FAR)
    lowest = wp.float32(FAR)
    first = wp.int32(0)
    before = wp.float32(0.0)
    for k in range(lines.shape[1]):
        value = field_at(values, origin, cell, lines[i, k], FAR)
        estimate = wp.min(estimate, value)
        if k > 0:
            ends = wp.min(before, band) + wp.min(value, band)
            low = 0.5 * (ends - wp.length(lines[i, k] - lines[i, k - 1])) - slack
            if low < lowest:
                lowest = low
                first = k - 1
        before = value
    if lowest - radius <= within:
        best = wp.min(estimate + slack, horizon + radius)
        if best > 0.0:
            best = distance_below(mesh, 0.5 * (lines[i, first] + lines[i, first + 1]), best)
        best64 = wp.float64(best) + wp.float64(1e-4)
        count = lines.shape[1] - 1
        for n in range(count):
            k = (first + n) % count
            p = lines[i, k]
            q = lines[i, k + 1]
            ends = wp.min(field_at(values, origin, cell, p, FAR), band)
            ends = ends + wp.min(field_at(values, origin, cell, q, FAR), band)
            low = 0.5 * (ends - wp.length(q - p)) - slack
            if wp.float64(low) < best64 and best64 > wp.float64(0.0):
                reach = wp.float32(best64) + 1e-3
                span = wp.vec3(reach, reach, reach)
                query = wp.mesh_query_aabb(mesh, wp.min(p, q) - span, wp.max(p, q) + span)
                face = wp.int32(0)
                p64 = wp.vec3d(p)
                q64 = wp.vec3d(q)
                while wp.mesh_query_aabb_next(query, face):
                    a = corners[3 * face]
                    b = corners[3 * face + 1]
                    c = corners[3 * face + 2]
                    d2 = segment_triangle_d2(p64, q64, a, b, c, best64 * best64)
                    best64 = wp.min(best64, wp.sqrt(d2))
        least = wp.float32(best64)
        for k in range(lines.shape[1]):
            value = field_at(values, origin, cell, lines[i, k], FAR)
            if value - slack < wp.min(least, 0.0):
                found = wp.mesh_query_point(mesh, lines[i, k], wp.abs(value) + slack)
                if found.result and found.sign < 0.0:
                    at = wp.mesh_eval_position(mesh, found.face, found.u, found.v)
                    least = wp.min(least, -wp.length(at - lines[i, k]))
        estimate = least
    out[i] = wp.min(estimate - radius, horizon)


class WarpSurface:
    """One mesh on a Warp device."""

    def __init__(self, mesh, device="cpu", field=None):
        wp.init()
        self.device = device
        self.mesh = wp.Mesh(
            wp.array(mesh.vertices_mm.astype(np.float32), dtype=wp.vec3, device=device),
            wp.array(mesh.faces.reshape(-1), dtype=wp.int32, device=device),
            support_winding_number=True,
        )
        corners = np.ascontiguousarray(mesh.triangles_mm.reshape(-1, 3))
        self.corners = wp.array(corners, dtype=wp.vec3d, device=device)
        if field is not None:
            self.field = (
                wp.array(field.values_mm, dtype=wp.float32, device=device),
                wp.vec3(*field.origin_mm),
                field.cell_mm,
                field.band_mm,
                field.slack_mm,
            )

    def _ask(self, kernel, count, inputs, kinds):
        outputs = [wp.empty(count, dtype=kind, device=self.device) for kind in kinds]
        wp.launch(kernel, count, [self.mesh.id, *inputs], outputs, device=self.device)
        return [out.numpy() for out in outputs]

    def _in(self, array, kind=wp.vec3):
        return wp.array(array, dtype=kind, device=self.device, copy=False)

    def rays(self, origins, aims, reach):
        """Distances (N,) float32 mm and faces (N,) of float32 rays."""
        given = self._in(origins), self._in(aims), reach
        return self._ask(rays, len(origins), given, (wp.float32, wp.int32))

    def rays_float64(self, origins, aims, reach):
        """Distances (N,) float64 mm and faces (N,) of rays, recomputed in the face's plane."""
        given = self.corners, self._in(origins, wp.vec3d), self._in(aims, wp.vec3d), reach
        return self._ask(rays_float64, len(origins), given, (wp.float64, wp.int32))

    def points(self, p):
        """Distances (N,) mm and faces (N,) of points."""
        return self._ask(points, len(p), (self._in(p),), (wp.float32, wp.int32))

    def inside(self, kernel, p):
        """(N,) bool by one of the three kernels."""
        return self._ask(kernel, len(p), (self._in(p),), (wp.bool,))[0]

    def chains(self, kernel, lines, *numbers):
        """Clearances (B,) mm of arms (B, K, 3) float32 by one of the kernels."""
        given = (self._in(lines), *numbers)
        if kernel is chains_boxes_float64:
            given = (self.corners, *given)
        if kernel is chains_field_float64:
            given = (self.corners, *self.field, *given)
        return self._ask(kernel, len(lines), given, (wp.float32,))[0]
