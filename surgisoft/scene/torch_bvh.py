"""The same tree and the same answers in torch, for accelerators: all queries go down together.

A query keeps a list of boxes it may still meet; one step opens every box into its eight
grandchildren and drops what lies beyond the query's bound. Lists are flat (query, box) pairs, so a
step is a handful of tensor operations whatever the mesh. Arithmetic is float64.
"""

from __future__ import annotations

import math

import torch

from surgisoft.scene.bvh import TriangleTree
from surgisoft.scene.capsules import segment_distance
from surgisoft.scene.frames import cross, dot

LEVELS_A_STEP = 3
"""Tree levels that one step goes down."""
QUERIES_AT_ONCE = 16_384
"""Queries that go down together; more are taken in turns to bound the memory."""


class TorchTree:
    """A `TriangleTree` on a device."""

    def __init__(self, tree: TriangleTree, device):
        self.leaves = len(tree.starts) - 1
        self.depth = self.leaves.bit_length() - 1
        self.lower = torch.as_tensor(tree.lower, device=device)
        self.upper = torch.as_tensor(tree.upper, device=device)
        self.order = torch.as_tensor(tree.order, device=device)
        self.starts = torch.as_tensor(tree.starts, device=device)
        self.triangles = torch.as_tensor(tree.triangles_mm, device=device)
        self.leaf_size = int((tree.starts[1:] - tree.starts[:-1]).max())

    def _children(self, level: int, box: torch.Tensor) -> tuple[int, torch.Tensor]:
        """The next level to open and, for boxes (N,) of `level`, their descendants there (N, W)."""
        down = min(LEVELS_A_STEP, self.depth - level)
        width = 1 << down
        return level + down, box[:, None] * width + torch.arange(width, device=box.device)

    def _faces(self, query: torch.Tensor, leaf: torch.Tensor):
        """(query, place) pairs of all triangles in the leaves (N,) of the queries (N,)."""
        place = self.starts[leaf][:, None] + torch.arange(self.leaf_size, device=leaf.device)
        held = place < self.starts[leaf + 1][:, None]
        return query[:, None].expand_as(place)[held], place[held]

    def _node(self, level: int, box: torch.Tensor) -> torch.Tensor:
        return (1 << level) - 1 + box

    def _within(self, keep, count: int, device):
        """Flat (query, leaf) pairs whose boxes pass keep(query, node) all the way down."""
        query = torch.arange(count, device=device)
        box = torch.zeros_like(query)
        level = 0
        while level < self.depth:
            level, children = self._children(level, box)
            query = query[:, None].expand_as(children).reshape(-1)
            box = children.reshape(-1)
            kept = keep(query, self._node(level, box))
            query, box = query[kept], box[kept]
        return query, box

    def segments_d2(self, p: torch.Tensor, q: torch.Tensor, bound2: torch.Tensor) -> torch.Tensor:
        """(N,) squared distance of segments p q (N, 3) mm to the surface, at most bound2 (N,)."""
        parts = [
            self._segments_d2(*part)
            for part in zip(*(x.split(QUERIES_AT_ONCE) for x in (p, q, bound2)), strict=True)
        ]
        return torch.cat(parts) if parts else bound2.clone()

    def _segments_d2(self, p, q, bound2):
        low, high = torch.minimum(p, q), torch.maximum(p, q)

        def boxes_d2(query, node):
            gap = torch.maximum(self.lower[node] - high[query], low[query] - self.upper[node])
            return gap.clamp(min=0.0).square().sum(-1)

        best = torch.minimum(bound2, self._first_guess(p, q, boxes_d2))
        query, leaf = self._within(
            lambda query, node: boxes_d2(query, node) < best[query], len(p), p.device
        )
        return self._refine(p, q, best, query, leaf)

    def _first_guess(self, p, q, boxes_d2):
        """Squared distances (N,) to the leaf that a greedy walk down the nearest boxes ends in."""
        query = torch.arange(len(p), device=p.device)
        box, level = torch.zeros_like(query), 0
        while level < self.depth:
            level, children = self._children(level, box)
            d2 = boxes_d2(query[:, None].expand_as(children), self._node(level, children))
            box = children.gather(1, d2.argmin(1, keepdim=True))[:, 0]
        return self._refine(p, q, torch.full_like(p[:, 0], math.inf), query, box)

    def _refine(self, p, q, best, query, leaf):
        query, place = self._faces(query, leaf)
        d2 = segment_triangle_d2(p[query], q[query], self.triangles[place])
        return best.scatter_reduce(0, query, d2, "amin")

    def points(self, p: torch.Tensor, bound2: torch.Tensor) -> torch.Tensor:
        """(N,) squared distance of points p (N, 3) mm to the surface, at most bound2 (N,)."""
        return self.segments_d2(p, p, bound2)

    def crossings(self, p: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """(N,) int64: how many faces the segments p q (N, 3) mm cross."""
        t, query, _ = self._meetings(p, q - p, torch.ones_like(p[:, 0]))
        return torch.zeros(len(p), dtype=torch.int64, device=p.device).scatter_add(
            0, query, (t <= 1.0).long()
        )

    def first_hit(self, origin, direction, reach):
        """First faces on rays (N, 3), distances up to reach (N,): (distance, face), -1 for none."""
        parts = [
            self._first_hit(*part)
            for part in zip(
                *(x.split(QUERIES_AT_ONCE) for x in (origin, direction, reach)), strict=True
            )
        ]
        if not parts:
            return reach.clone(), torch.zeros_like(reach, dtype=torch.int64)
        return torch.cat([d for d, _ in parts]), torch.cat([f for _, f in parts])

    def _first_hit(self, origin, direction, reach):
        t, query, place = self._meetings(origin, direction, reach)
        nearest = reach.scatter_reduce(0, query, t, "amin")
        first = t == nearest[query]
        face = torch.full_like(reach, -1, dtype=torch.int64)
        face = face.scatter_reduce(0, query[first], self.order[place[first]], "amax")
        return torch.where(face >= 0, nearest, reach), face

    def _meetings(self, origin, direction, reach):
        """All (t, query, place) where origin + t direction, 0 <= t <= reach, meets a triangle."""
        inverse = 1.0 / torch.where(direction == 0.0, 1e-300, direction)

        def keep(query, node):
            one = (self.lower[node] - origin[query]) * inverse[query]
            two = (self.upper[node] - origin[query]) * inverse[query]
            enter = torch.minimum(one, two).amax(-1).clamp(min=0.0)
            leave = torch.minimum(torch.maximum(one, two).amin(-1), reach[query])
            return enter <= leave * (1.0 + 1e-12) + 1e-12

        query, leaf = self._within(keep, len(origin), origin.device)
        query, place = self._faces(query, leaf)
        t = line_triangle(origin[query], direction[query], self.triangles[place])
        met = (t >= 0.0) & (t <= reach[query])
        return t[met], query[met], place[met]


def line_triangle(p, d, corners):
    """(N,) t where p + t d meets triangles (N, 3, 3), inf for a miss (Moeller & Trumbore 1997)."""
    a, b, c = corners.unbind(1)
    e1, e2, s = b - a, c - a, p - a
    h = cross(d, e2)
    det = dot(e1, h)
    inverse = 1.0 / torch.where(det == 0.0, 1.0, det)
    u = dot(s, h) * inverse
    k = cross(s, e1)
    v = dot(d, k) * inverse
    slack = 1e-12
    hit = (det != 0.0) & (u >= -slack) & (v >= -slack) & (u + v <= 1.0 + slack)
    return torch.where(hit, dot(e2, k) * inverse, math.inf)


def point_triangle_d2(p, corners):
    """(N,) squared distance of points (N, 3) to triangles (N, 3, 3).

    The plane's where the foot is inside, otherwise the nearest edge's (Ericson 2005, 5.1.5).
    """
    a, b, c = corners.unbind(1)
    e1, e2, s = b - a, c - a, p - a
    normal = cross(e1, e2)
    square = dot(normal, normal)
    safe = torch.where(square > 0.0, square, 1.0)
    v, w = dot(cross(s, e2), normal) / safe, dot(cross(e1, s), normal) / safe
    over = (square > 0.0) & (v >= 0.0) & (w >= 0.0) & (v + w <= 1.0)
    edges = [segment_distance(p, p, x, y).square() for x, y in ((a, b), (b, c), (c, a))]
    beside = torch.minimum(torch.minimum(edges[0], edges[1]), edges[2])
    return torch.where(over, dot(s, normal).square() / safe, beside)


def segment_triangle_d2(p, q, corners):
    """(N,) squared distance of segments p q (N, 3) to triangles (N, 3, 3) (Ericson 5.1.10)."""
    a, b, c = corners.unbind(1)
    best = torch.minimum(point_triangle_d2(p, corners), point_triangle_d2(q, corners))
    for x, y in ((a, b), (b, c), (c, a)):
        best = torch.minimum(best, segment_distance(p, q, x, y).square())
    t = line_triangle(p, q - p, corners)
    return torch.where((t >= 0.0) & (t <= 1.0), 0.0, best)
