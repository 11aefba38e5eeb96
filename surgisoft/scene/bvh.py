"""A bounding volume hierarchy over a mesh's triangles, and exact distance queries on it.

The tree is complete and implicit: node n has children 2 n + 1 and 2 n + 2, the leaves are the
last level, each with a run of at most `LEAF_FACES` triangles. The compiled queries here run on the
CPU; `torch_queries` walks the same arrays on an accelerator.

The first part holds the primitives: exact distances between points, segments, triangles and boxes
as compiled scalar arithmetic in float64, in one frame and one unit. Functions whose name ends in
`d2` return squared distances. The exact collision checker in `collision` uses none of them; its
queries of a lone environment let them choose what FCL is asked about.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from surgisoft.compiled import compiled
from surgisoft.scene.mesh import Mesh, kept


@compiled
def clamp01(value):
    """The value clamped to 0..1."""
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


@compiled(inner=True)
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


PARALLEL = 1e-14
"""Least volume that a direction and two edges of a face span, as a share of the product of their
largest coordinates: below it lies rounding (up to a dozen times 2^-53), and the line is parallel to
the face, or the face has no area."""


@compiled
def line_triangle(p, d, a, b, c):
    """Parameter t where p + t d meets triangle a b c, inf for a miss (Moeller & Trumbore 1997).

    A line that is parallel to the face misses it.
    """
    e1x, e1y, e1z = b[0] - a[0], b[1] - a[1], b[2] - a[2]
    e2x, e2y, e2z = c[0] - a[0], c[1] - a[1], c[2] - a[2]
    px, py, pz = d[1] * e2z - d[2] * e2y, d[2] * e2x - d[0] * e2z, d[0] * e2y - d[1] * e2x
    det = dot3(e1x, e1y, e1z, px, py, pz)
    size = max(abs(e1x), abs(e1y), abs(e1z)) * max(abs(e2x), abs(e2y), abs(e2z))
    if abs(det) <= PARALLEL * size * max(abs(d[0]), abs(d[1]), abs(d[2])):
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


LEAF_FACES = 4
"""At most this many triangles in a leaf."""

STACK = 64
"""Size of the stack of boxes in a traversal; twice the depth of a tree of 2^31 leaves."""


@compiled(inner=True)
def _select(order, key, start, stop, middle):
    """Reorder order[start:stop] so that keys below `middle` are no larger than those above.

    Quickselect (Hoare 1961), pivot by the median of three.
    """
    left, right = start, stop - 1
    while left < right:
        centre = (left + right) // 2
        a, b, c = key[order[left]], key[order[centre]], key[order[right]]
        pivot = max(min(a, b), min(max(a, b), c))
        i, j = left, right
        while i <= j:
            while key[order[i]] < pivot:
                i += 1
            while key[order[j]] > pivot:
                j -= 1
            if i <= j:
                order[i], order[j] = order[j], order[i]
                i += 1
                j -= 1
        if middle <= j:
            right = j
        elif middle >= i:
            left = i
        else:
            return


@compiled
def _build(centres, depth, order, starts):
    """Split by the median along the longest side, level by level; starts (2^depth + 1,)."""
    leaves = 1 << depth
    starts[0], starts[leaves] = 0, len(order)
    for level in range(depth):
        width = leaves >> level
        for j in range(0, leaves, width):
            start, stop = starts[j], starts[j + width]
            middle = (start + stop) // 2
            starts[j + width // 2] = middle
            axis, longest = 0, -1.0
            for i in range(3):
                low, high = np.inf, -np.inf
                for k in range(start, stop):
                    value = centres[i, order[k]]
                    low, high = min(low, value), max(high, value)
                if high - low > longest:
                    axis, longest = i, high - low
            if middle < stop:
                _select(order, centres[axis], start, stop, middle)


@compiled
def _boxes(triangles, starts, lower, upper):
    """Fill the boxes from the leaves up; triangles in tree order."""
    leaves = len(starts) - 1
    lower[:] = np.inf
    upper[:] = -np.inf
    for leaf in range(leaves):
        node = leaves - 1 + leaf
        for k in range(starts[leaf], starts[leaf + 1]):
            for corner in range(3):
                for i in range(3):
                    value = triangles[k, corner, i]
                    lower[node, i] = min(lower[node, i], value)
                    upper[node, i] = max(upper[node, i], value)
    for node in range(leaves - 2, -1, -1):
        for i in range(3):
            lower[node, i] = min(lower[2 * node + 1, i], lower[2 * node + 2, i])
            upper[node, i] = max(upper[2 * node + 1, i], upper[2 * node + 2, i])


@compiled
def triangle(triangles, k):
    """Corners of triangle k as three tuples."""
    return (
        (triangles[k, 0, 0], triangles[k, 0, 1], triangles[k, 0, 2]),
        (triangles[k, 1, 0], triangles[k, 1, 1], triangles[k, 1, 2]),
        (triangles[k, 2, 0], triangles[k, 2, 1], triangles[k, 2, 2]),
    )


@compiled(inner=True)
def _segment_box_d2(p, q, low, high, lower, upper, node, slanting):
    """Lower bound of the squared distance between segment p q and a box: row `node` (2 N - 1, 3).

    The gap between the segment's own box low..high and the box; if `slanting` and it is larger, the
    gap between both along the line that joins their middles, which is tight for a slanting segment
    that is far away.
    """
    apart = boxes_d2(low, high, lower, upper, node)
    if not slanting:
        return apart
    x = 0.5 * (lower[node, 0] + upper[node, 0] - p[0] - q[0])
    y = 0.5 * (lower[node, 1] + upper[node, 1] - p[1] - q[1])
    z = 0.5 * (lower[node, 2] + upper[node, 2] - p[2] - q[2])
    size2 = x * x + y * y + z * z
    across = (
        abs(x) * (upper[node, 0] - lower[node, 0])
        + abs(y) * (upper[node, 1] - lower[node, 1])
        + abs(z) * (upper[node, 2] - lower[node, 2])
    )
    along = abs(x * (q[0] - p[0]) + y * (q[1] - p[1]) + z * (q[2] - p[2]))
    gap = size2 - 0.5 * (across + along)
    if gap > 0.0:
        return max(apart, gap * gap / size2 * (1.0 - 1e-9))
    return apart


@compiled(inner=True)
def segment_surface_d2(p, q, bound2, tree, nodes, reach, slanting):
    """Squared distance from segment p q to the surface if below bound2, bound2 otherwise.

    tree: arrays of a `TriangleTree`. `nodes` (STACK,) int64 and `reach` (STACK,) float64 are
    working memory. slanting: whether boxes are ruled out by tighter bounds, which pays for few
    segments and many faces; the result is the same.
    """
    triangles, starts, lower, upper = tree[0], tree[1], tree[2], tree[3]
    low = (min(p[0], q[0]), min(p[1], q[1]), min(p[2], q[2]))
    high = (max(p[0], q[0]), max(p[1], q[1]), max(p[2], q[2]))
    leaves = len(starts) - 1
    nodes[0], size, best = 0, 1, bound2
    reach[0] = _segment_box_d2(p, q, low, high, lower, upper, nodes[0], slanting)
    while size > 0:
        size -= 1
        node = nodes[size]
        if reach[size] >= best:
            continue
        if node >= leaves - 1:
            leaf = node - (leaves - 1)
            for k in range(starts[leaf], starts[leaf + 1]):
                a, b, c = triangle(triangles, k)
                best = segment_triangle_d2(p, q, a, b, c, best)
            continue
        one, two = 2 * node + 1, 2 * node + 2
        d_one = _segment_box_d2(p, q, low, high, lower, upper, one, slanting)
        d_two = _segment_box_d2(p, q, low, high, lower, upper, two, slanting)
        if d_one < d_two:
            one, two, d_one, d_two = two, one, d_two, d_one
        nodes[size], reach[size] = one, d_one
        nodes[size + 1], reach[size + 1] = two, d_two
        size += 2
    return best


@compiled(inner=True)
def point_surface(p, bound2, triangles, starts, lower, upper):
    """Nearest triangle to p within bound2: squared distance, tree index (-1 for none), v, w."""
    leaves = len(starts) - 1
    nodes = np.empty(STACK, np.int64)
    reach = np.empty(STACK, np.float64)
    nodes[0], size = 0, 1
    reach[0] = boxes_d2(p, p, lower, upper, nodes[0])
    best, face, best_v, best_w = bound2, -1, 0.0, 0.0
    while size > 0:
        size -= 1
        node = nodes[size]
        if reach[size] >= best:
            continue
        if node >= leaves - 1:
            leaf = node - (leaves - 1)
            for k in range(starts[leaf], starts[leaf + 1]):
                a, b, c = triangle(triangles, k)
                d2, v, w = point_triangle(p, a, b, c)
                if d2 < best:
                    best, face, best_v, best_w = d2, k, v, w
            continue
        one, two = 2 * node + 1, 2 * node + 2
        d_one = boxes_d2(p, p, lower, upper, one)
        d_two = boxes_d2(p, p, lower, upper, two)
        if d_one < d_two:
            one, two, d_one, d_two = two, one, d_two, d_one
        nodes[size], reach[size] = one, d_one
        nodes[size + 1], reach[size + 1] = two, d_two
        size += 2
    return best, face, best_v, best_w


@compiled
def _nearest(points, bound_mm, triangles, starts, lower, upper, distance, face):
    for i in range(len(points)):
        p = (points[i, 0], points[i, 1], points[i, 2])
        d2, face[i], _, _ = point_surface(p, bound_mm**2, triangles, starts, lower, upper)
        distance[i] = np.sqrt(d2)


@dataclass(frozen=True, eq=False)
class TriangleTree:
    """The tree's arrays, mm, in the mesh's own frame. L = 2^depth leaves."""

    mesh: Mesh
    """The surface."""
    order: np.ndarray
    """(F,) int64: face of the mesh at each place of the tree."""
    starts: np.ndarray
    """(L + 1,) int64: each leaf's first place."""
    lower: np.ndarray
    """(2 L - 1, 3) float64 mm: lowest corner of each node's box."""
    upper: np.ndarray
    """(2 L - 1, 3) float64 mm: highest corner of each node's box."""

    @cached_property
    def triangles_mm(self) -> np.ndarray:
        """(F, 3, 3) float64 mm in tree order."""
        return np.ascontiguousarray(self.mesh.triangles_mm[self.order])

    @property
    def arrays(self) -> tuple[np.ndarray, ...]:
        """Arrays that the compiled queries traverse: triangles, starts, lower, upper."""
        return self.triangles_mm, self.starts, self.lower, self.upper

    def nearest(
        self, points_mm: np.ndarray, bound_mm: float = np.inf
    ) -> tuple[np.ndarray, np.ndarray]:
        """Unsigned distance (N,) mm and face (N,) of points (N, 3) mm; bound_mm and -1 beyond."""
        points = np.ascontiguousarray(points_mm, dtype=np.float64)
        distance, place = np.empty(len(points)), np.empty(len(points), np.int64)
        _nearest(points, bound_mm, *self.arrays, distance, place)
        return distance, np.where(place >= 0, self.order[place], -1)


def build_tree(mesh: Mesh) -> TriangleTree:
    """The tree of a mesh; O(F log F)."""
    count = len(mesh.faces)
    depth = max(0, int(np.ceil(np.log2(count / LEAF_FACES))))
    centres = np.ascontiguousarray(mesh.triangles_mm.mean(axis=1).T)
    order = np.arange(count, dtype=np.int64)
    starts = np.zeros((1 << depth) + 1, np.int64)
    _build(centres, depth, order, starts)
    lower = np.empty((2 * (1 << depth) - 1, 3))
    upper = np.empty_like(lower)
    tree = TriangleTree(mesh, order, starts, lower, upper)
    _boxes(tree.triangles_mm, starts, lower, upper)
    return tree


@kept
def tree_of(mesh: Mesh) -> TriangleTree:
    """The tree of a mesh, shared by the scenes that hold an equal one."""
    return build_tree(mesh)
