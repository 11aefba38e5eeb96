"""Exact distances between points, segments, triangles and boxes: compiled scalar arithmetic.

Everything is float64 and in one frame and one unit; squared distances come back squared. These
are the primitives of the tree in `bvh`; the referee in `collision` shares none of them.
"""

from __future__ import annotations

import math

from surgisoft.compiled import compiled


@compiled
def clamp01(value):
    """The value held within 0..1."""
    return min(max(value, 0.0), 1.0)


@compiled
def dot3(ax, ay, az, bx, by, bz):
    """Dot product."""
    return ax * bx + ay * by + az * bz


@compiled
def segments_d2(p, q, a, b):
    """Squared distance between segments p q and a b (Ericson 2005, section 5.1.9).

    Points are tuples of three. The lines' own s (0 if parallel), then one exact line search in
    each of t, s, t.
    """
    d1x, d1y, d1z = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    d2x, d2y, d2z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    rx, ry, rz = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    aa = dot3(d1x, d1y, d1z, d1x, d1y, d1z)
    ee = dot3(d2x, d2y, d2z, d2x, d2y, d2z)
    bb = dot3(d1x, d1y, d1z, d2x, d2y, d2z)
    cc = dot3(d1x, d1y, d1z, rx, ry, rz)
    ff = dot3(d2x, d2y, d2z, rx, ry, rz)
    aa_safe = aa if aa > 0.0 else 1.0
    ee_safe = ee if ee > 0.0 else 1.0
    denominator = aa * ee - bb * bb
    s = 0.0
    if denominator > 1e-15 * aa * ee:
        s = clamp01((bb * ff - cc * ee) / denominator)
    t = clamp01((bb * s + ff) / ee_safe)
    s = clamp01((bb * t - cc) / aa_safe)
    t = clamp01((bb * s + ff) / ee_safe)
    x, y, z = rx + s * d1x - t * d2x, ry + s * d1y - t * d2y, rz + s * d1z - t * d2z
    return dot3(x, y, z, x, y, z)


@compiled
def point_triangle(p, a, b, c):
    """Nearest point of triangle a b c to p: squared distance, barycentric (v, w) of b and c.

    By Voronoi region (Ericson 2005, section 5.1.5).
    """
    abx, aby, abz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    acx, acy, acz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    apx, apy, apz = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    d1 = dot3(abx, aby, abz, apx, apy, apz)
    d2 = dot3(acx, acy, acz, apx, apy, apz)
    bpx, bpy, bpz = p[0] - b[0], p[1] - b[1], p[2] - b[2]
    d3 = dot3(abx, aby, abz, bpx, bpy, bpz)
    d4 = dot3(acx, acy, acz, bpx, bpy, bpz)
    cpx, cpy, cpz = p[0] - c[0], p[1] - c[1], p[2] - c[2]
    d5 = dot3(abx, aby, abz, cpx, cpy, cpz)
    d6 = dot3(acx, acy, acz, cpx, cpy, cpz)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        v, w = 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        v, w = 1.0, 0.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        v, w = (d1 / (d1 - d3) if d1 > d3 else 0.0), 0.0
    elif d6 >= 0.0 and d5 <= d6:
        v, w = 0.0, 1.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        v, w = 0.0, (d2 / (d2 - d6) if d2 > d6 else 0.0)
    elif va <= 0.0 and d4 >= d3 and d5 >= d6:
        span = (d4 - d3) + (d5 - d6)
        w = (d4 - d3) / span if span > 0.0 else 0.0
        v = 1.0 - w
    else:
        total = va + vb + vc
        v, w = (vb / total, vc / total) if total > 0.0 else (0.0, 0.0)
    x = apx - v * abx - w * acx
    y = apy - v * aby - w * acy
    z = apz - v * abz - w * acz
    return dot3(x, y, z, x, y, z), v, w


@compiled
def line_triangle(p, d, a, b, c):
    """Parameter t where p + t d meets triangle a b c, inf for a miss (Moeller & Trumbore 1997)."""
    e1x, e1y, e1z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    e2x, e2y, e2z = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    px, py, pz = d[1] * e2z - d[2] * e2y, d[2] * e2x - d[0] * e2z, d[0] * e2y - d[1] * e2x
    det = dot3(e1x, e1y, e1z, px, py, pz)
    if det == 0.0:
        return math.inf
    sx, sy, sz = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    u = dot3(sx, sy, sz, px, py, pz) / det
    if u < -1e-12 or u > 1.0 + 1e-12:
        return math.inf
    qx, qy, qz = sy * e1z - sz * e1y, sz * e1x - sx * e1z, sx * e1y - sy * e1x
    v = dot3(d[0], d[1], d[2], qx, qy, qz) / det
    if v < -1e-12 or u + v > 1.0 + 1e-12:
        return math.inf
    return dot3(e2x, e2y, e2z, qx, qy, qz) / det


@compiled
def segment_triangle_d2(p, q, a, b, c, bound2):
    """Squared distance between segment p q and triangle a b c; 0 if they cross, at most bound2.

    The least of both ends to the triangle and of the segment to the three edges, unless the
    segment pierces the face (Ericson 2005, section 5.1.10). A segment wholly on one side of the
    face's plane and farther from it than the bound needs none of these.
    """
    ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    above_p = dot3(nx, ny, nz, p[0] - a[0], p[1] - a[1], p[2] - a[2])
    above_q = dot3(nx, ny, nz, q[0] - a[0], q[1] - a[1], q[2] - a[2])
    nearest = min(abs(above_p), abs(above_q))
    same_side = above_p * above_q > 0.0
    if same_side and nearest * nearest >= bound2 * dot3(nx, ny, nz, nx, ny, nz):
        return bound2
    if not same_side:
        t = line_triangle(p, (q[0] - p[0], q[1] - p[1], q[2] - p[2]), a, b, c)
        if 0.0 <= t <= 1.0:
            return 0.0
    best = min(bound2, point_triangle(p, a, b, c)[0], point_triangle(q, a, b, c)[0])
    best = min(best, segments_d2(p, q, a, b), segments_d2(p, q, b, c))
    return min(best, segments_d2(p, q, c, a))


@compiled
def boxes_d2(low, high, lower, upper, node):
    """Squared distance between the box low..high (tuples) and row `node` of lower and upper."""
    total = 0.0
    for i in range(3):
        gap = max(lower[node, i] - high[i], low[i] - upper[node, i], 0.0)
        total += gap * gap
    return total
