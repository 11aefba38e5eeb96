"""The batched distance and ray queries in torch, for accelerators.

They give the same results as the compiled queries of `bvh`, `distance` and `rays`. All queries
descend the tree together: a query keeps a list of boxes that it may still meet; one step replaces
every box by its eight great-grandchildren and drops those beyond the query's bound. The lists are
flat (query, box) pairs, so a step is a handful of tensor operations whatever the mesh. Arithmetic
is float64.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from surgisoft.scene.bvh import PARALLEL, TriangleTree
from surgisoft.scene.capsules import arc_lengths, ray_chain, segment_distance
from surgisoft.scene.field import DistanceField
from surgisoft.scene.frames import cross, dot, norm

LEVELS_A_STEP = 3
"""Tree levels that one step descends."""
QUERIES_AT_ONCE = 16_384
"""Queries that descend the tree together; larger batches are split to bound the memory."""


class TorchTree:
    """A `TriangleTree` on a device."""

    def __init__(self, tree: TriangleTree, device: str | torch.device):
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

    def first_hit(
        self, origin: torch.Tensor, direction: torch.Tensor, reach: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
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


def line_triangle(p: torch.Tensor, d: torch.Tensor, corners: torch.Tensor) -> torch.Tensor:
    """(N,) t where p + t d meets triangles (N, 3, 3), inf for a miss (Moeller & Trumbore 1997)."""
    a, b, c = corners.unbind(1)
    e1, e2, s = b - a, c - a, p - a
    h = cross(d, e2)
    det = dot(e1, h)
    size = e1.abs().amax(1) * e2.abs().amax(1) * d.abs().amax(1)
    parallel = det.abs() <= PARALLEL * size
    inverse = 1.0 / torch.where(parallel, 1.0, det)
    u = dot(s, h) * inverse
    k = cross(s, e1)
    v = dot(d, k) * inverse
    slack = 1e-12
    hit = ~parallel & (u >= -slack) & (v >= -slack) & (u + v <= 1.0 + slack)
    return torch.where(hit, dot(e2, k) * inverse, math.inf)


def point_triangle_d2(p: torch.Tensor, corners: torch.Tensor) -> torch.Tensor:
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


def segment_triangle_d2(p: torch.Tensor, q: torch.Tensor, corners: torch.Tensor) -> torch.Tensor:
    """(N,) squared distance of segments p q (N, 3) to triangles (N, 3, 3) (Ericson 5.1.10)."""
    a, b, c = corners.unbind(1)
    best = torch.minimum(point_triangle_d2(p, corners), point_triangle_d2(q, corners))
    for x, y in ((a, b), (b, c), (c, a)):
        best = torch.minimum(best, segment_distance(p, q, x, y).square())
    t = line_triangle(p, q - p, corners)
    return torch.where((t >= 0.0) & (t <= 1.0), 0.0, best)


PAIRS_AT_ONCE = 4_000_000
"""Segment pairs that are evaluated together; larger batches are split to bound the memory."""


class TorchSurface:
    """One body's surface on a device: its distance field, tree and normals."""

    divides = False

    def __init__(self, tree: TriangleTree, field: DistanceField, device: str | torch.device):
        self._tree = TorchTree(tree, device)
        self._closed = tree.mesh.is_watertight
        self._values = torch.as_tensor(field.values_mm, device=device)
        self._origin = torch.as_tensor(field.origin_mm, device=device)
        self._field = field
        self.normals = torch.tensor(np.array(tree.mesh.face_normals), device=device)

    def first_hit(
        self, origins: torch.Tensor, directions: torch.Tensor, range_mm: float
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance (N,) mm and face (N,) of rays (N, 3) in the body's frame; -1 for none."""
        finite = origins.isfinite().all(1) & directions.isfinite().all(1)
        reach = torch.where(finite, float(range_mm), -1.0).to(origins.dtype)
        o, d = origins.nan_to_num(0.0, 0.0, 0.0), directions.nan_to_num(0.0, 0.0, 0.0)
        distance, face = self._tree.first_hit(o, d, reach)
        return torch.where(face >= 0, distance, float(range_mm)), face

    def clearance(
        self,
        lines: torch.Tensor,
        given: torch.Tensor,
        turn: torch.Tensor,
        shift: torch.Tensor,
        radius: float,
        within: float,
        horizon: float,
    ) -> torch.Tensor:
        """(B,) mm: signed clearance of arms (B, K, 3), world frame, from the surface.

        given (K,) bool: the centreline's own points, where depth inside the body counts.
        """
        line = lines.double() @ turn.mT + shift[:, None]
        finite = line.isfinite().flatten(1).all(1)
        line = torch.where(finite[:, None, None], line, 0.0)
        a, b = line[:, :-1], line[:, 1:]
        at_points = self.field_at(line)
        field, held = self._field, at_points.clamp(max=self._field.band_mm)
        lows = 0.5 * (held[:, :-1] + held[:, 1:] - norm(b - a)) - field.slack_mm
        estimate = torch.where(given, at_points, at_points.abs()).amin(1)
        near = finite & (lows.amin(1) - radius <= within)
        index = near.nonzero()[:, 0]
        least = (estimate[index] + field.slack_mm).clamp(max=horizon + radius)
        least = self._to_segments(a[index], b[index], lows[index], least)
        if self._closed:
            least = self._to_depths(line[index][:, given], at_points[index][:, given], least)
        centre = estimate.clone()
        centre[index] = least
        clear = (centre - radius).clamp(max=horizon)
        return torch.where(finite, clear, math.nan).to(lines.dtype)

    def _to_segments(self, a, b, lows, least):
        """The least of `least` (M,) and the distances of segments a b (M, S, 3) to the surface."""
        row, column = ((lows < least[:, None]) & (least[:, None] > 0.0)).nonzero(as_tuple=True)
        d2 = self._tree.segments_d2(a[row, column], b[row, column], least[row].square())
        return least.scatter_reduce(0, row, d2.sqrt(), "amin")

    def _to_depths(self, points, estimates, least):
        """The least of `least` (M,) and minus the depth of the points (M, K, 3) that are inside."""
        low = estimates - self._field.slack_mm
        row, column = (low < least.clamp(max=0.0)[:, None]).nonzero(as_tuple=True)
        p = points[row, column]
        bound = estimates[row, column].abs() + self._field.slack_mm
        depth = self._tree.points(p, bound.square()).sqrt()
        inside = self._is_inside(p, depth)
        return least.scatter_reduce(0, row, torch.where(inside, -depth, math.inf), "amin")

    def _is_inside(self, p, depth):
        """(N,) bool: points (N, 3) at known distances (N,) from the surface lie inside it."""
        node = ((p - self._origin) / self._field.cell_mm).round().long()
        q = self._origin + node * self._field.cell_mm
        inside = self._values[node[:, 0], node[:, 1], node[:, 2]] < 0.0
        unsure = (depth <= norm(q - p)).nonzero()[:, 0]
        flips = self._tree.crossings(p[unsure], q[unsure]) % 2 == 1
        return inside.index_put((unsure,), inside[unsure] != flips)

    def field_at(self, points: torch.Tensor) -> torch.Tensor:
        """Trilinear value (...) mm of the field at points (..., 3), inf outside the grid."""
        shape = torch.tensor(self._values.shape, device=points.device)
        x = (points - self._origin) / self._field.cell_mm
        within = ((x >= 0) & (x < shape - 1)).all(-1)
        x = torch.where(within[..., None], x, 0.0)
        node = x.long()
        w = x - node
        flat = (node[..., 0] * shape[1] + node[..., 1]) * shape[2] + node[..., 2]
        total = torch.zeros_like(x[..., 0])
        for corner in range(8):
            i, j, k = corner >> 2, corner >> 1 & 1, corner & 1
            share = _side(w[..., 0], i) * _side(w[..., 1], j) * _side(w[..., 2], k)
            total = total + share * self._values.view(-1)[flat + (i * shape[1] + j) * shape[2] + k]
        return torch.where(within, total, math.inf)


def _side(w, upper: int):
    return w if upper else 1.0 - w


def _in_turns(function, count: int, pairs: int, *tensors):
    """function over slices of (B, ...) tensors small enough for memory, results joined."""
    size = max(1, PAIRS_AT_ONCE // pairs)
    parts = [function(*(t[i : i + size] for t in tensors)) for i in range(0, count, size)]
    return torch.cat(parts) if parts else tensors[0].new_empty(0)


def chains_apart_torch(
    first: torch.Tensor, second: torch.Tensor, radii: float, horizon: float
) -> torch.Tensor:
    """(B,) clearance (mm) between arms (B, K, 3) and (B, M, 3); radii is their sum."""

    def measure(one, two):
        a, b = one[:, :-1, None], one[:, 1:, None]
        c, d = two[:, None, :-1], two[:, None, 1:]
        return segment_distance(a, b, c, d).flatten(1).amin(1)

    pairs = (first.shape[1] - 1) * (second.shape[1] - 1)
    return (_in_turns(measure, len(first), pairs, first, second) - radii).clamp(max=horizon)


def chains_folded_torch(
    lines: torch.Tensor, radius: float, gap: float, horizon: float
) -> torch.Tensor:
    """(B,) clearance (mm) of arms (B, K, 3) to themselves beyond `gap` mm of arc."""

    def measure(line):
        arc = arc_lengths(line.double())
        allowed = arc[:, None, :-1] - arc[:, 1:, None] >= gap
        a, b = line[:, :-1], line[:, 1:]
        apart = segment_distance(a[:, :, None], b[:, :, None], a[:, None], b[:, None])
        least = torch.where(allowed, apart, math.inf).flatten(1).amin(1)
        return torch.where(arc[:, -1].isfinite(), least, math.nan).to(line.dtype)

    pairs = (lines.shape[1] - 1) ** 2
    return (_in_turns(measure, len(lines), pairs, lines) - 2.0 * radius).clamp(max=horizon)


def rays_to_chains_torch(
    origins: torch.Tensor,
    directions: torch.Tensor,
    lines: torch.Tensor,
    radius: float,
    gap: float,
    best: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    """First hits of rays (B, R, 3) on arms (B, K, 3) below `best` (B, R): distance, segment."""

    def measure(o, d, line):
        arc = arc_lengths(line.double())
        free = (arc[:, -1:] - arc[:, 1:] >= gap)[:, None]
        t, segment = ray_chain(o, d, line.double()[:, None], radius, free)
        return torch.stack((t, segment.double()), -1)

    pairs = origins.shape[1] * (lines.shape[1] - 1)
    found = _in_turns(measure, len(lines), pairs, origins, directions, lines)
    return torch.minimum(found[..., 0].nan_to_num(math.inf), best), found[..., 1].long()
