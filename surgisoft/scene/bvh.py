"""A balanced tree of boxes over a mesh's triangles, and exact queries down it.

The tree is complete and implicit: node n has children 2 n + 1 and 2 n + 2, the leaves are the
last level, each with a run of at most `LEAF_FACES` triangles. Compiled queries for the CPU are
here; `torch_bvh` walks the same arrays on an accelerator.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from surgisoft.compiled import compiled
from surgisoft.scene.kernels import boxes_d2, point_triangle, segment_triangle_d2
from surgisoft.scene.mesh import Mesh

LEAF_FACES = 4
"""At most this many triangles in a leaf."""

STACK = 64
"""Boxes that a walk down a tree keeps for later; twice the depth of a tree of 2^31 leaves."""


@compiled
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


@compiled
def segment_surface_d2(p, q, bound2, triangles, starts, lower, upper, nodes, reach):
    """Squared distance from segment p q to the surface if below bound2, bound2 otherwise.

    `nodes` (STACK,) int64 and `reach` (STACK,) float64 are room to work in.
    """
    low = (min(p[0], q[0]), min(p[1], q[1]), min(p[2], q[2]))
    high = (max(p[0], q[0]), max(p[1], q[1]), max(p[2], q[2]))
    leaves = len(starts) - 1
    nodes[0], reach[0] = 0, boxes_d2(low, high, lower, upper, 0)
    size, best = 1, bound2
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
        d_one = boxes_d2(low, high, lower, upper, one)
        d_two = boxes_d2(low, high, lower, upper, two)
        if d_one < d_two:
            one, two, d_one, d_two = two, one, d_two, d_one
        nodes[size], reach[size] = one, d_one
        nodes[size + 1], reach[size + 1] = two, d_two
        size += 2
    return best


@compiled
def point_surface(p, bound2, triangles, starts, lower, upper):
    """Nearest triangle to p within bound2: squared distance, tree index (-1 for none), v, w."""
    leaves = len(starts) - 1
    nodes = np.empty(STACK, np.int64)
    reach = np.empty(STACK, np.float64)
    nodes[0], reach[0] = 0, boxes_d2(p, p, lower, upper, 0)
    size, best, face, best_v, best_w = 1, bound2, -1, 0.0, 0.0
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
        """What the compiled queries walk: triangles, starts, lower, upper."""
        return self.triangles_mm, self.starts, self.lower, self.upper

    def nearest(self, points_mm, bound_mm: float = np.inf) -> tuple[np.ndarray, np.ndarray]:
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
