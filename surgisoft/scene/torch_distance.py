"""The batched queries in torch alone, for accelerators; the same answers as the compiled ones."""

from __future__ import annotations

import math

import numpy as np
import torch

from surgisoft.scene.capsules import arc_lengths, ray_chain, segment_distance
from surgisoft.scene.frames import norm
from surgisoft.scene.torch_bvh import TorchTree

PAIRS_AT_ONCE = 4_000_000
"""Segment pairs that are measured together; larger batches are taken in turns."""


class TorchSurface:
    """One body's surface on a device: its field, its tree, its normals."""

    def __init__(self, tree, field, device):
        self._tree = TorchTree(tree, device)
        self._closed = tree.mesh.is_watertight
        self._values = torch.as_tensor(field.values_mm, device=device)
        self._origin = torch.as_tensor(field.origin_mm, device=device)
        self._field = field
        self.normals = torch.tensor(np.array(tree.mesh.face_normals), device=device)

    def first_hit(self, origins, directions, range_mm) -> tuple[torch.Tensor, torch.Tensor]:
        """Distance (N,) mm and face (N,) of rays (N, 3) in the body's frame; -1 for none."""
        finite = origins.isfinite().all(1) & directions.isfinite().all(1)
        reach = torch.where(finite, float(range_mm), -1.0).to(origins.dtype)
        o, d = origins.nan_to_num(0.0, 0.0, 0.0), directions.nan_to_num(0.0, 0.0, 0.0)
        distance, face = self._tree.first_hit(o, d, reach)
        return torch.where(face >= 0, distance, float(range_mm)), face

    def clearance(self, lines, given, turn, shift, radius, within, horizon) -> torch.Tensor:
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

    def field_at(self, points):
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


def chains_apart_torch(first, second, radii: float, horizon: float):
    """(B,) clearance (mm) between arms (B, K, 3) and (B, M, 3); radii is their sum."""

    def measure(one, two):
        a, b = one[:, :-1, None], one[:, 1:, None]
        c, d = two[:, None, :-1], two[:, None, 1:]
        return segment_distance(a, b, c, d).flatten(1).amin(1)

    pairs = (first.shape[1] - 1) * (second.shape[1] - 1)
    return (_in_turns(measure, len(first), pairs, first, second) - radii).clamp(max=horizon)


def chains_folded_torch(lines, radius: float, gap: float, horizon: float):
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


def rays_to_chains_torch(origins, directions, lines, radius: float, gap: float, best):
    """First hits of rays (B, R, 3) on arms (B, K, 3) below `best` (B, R): distance, segment."""

    def measure(o, d, line):
        arc = arc_lengths(line.double())
        free = (arc[:, -1:] - arc[:, 1:] >= gap)[:, None]
        t, segment = ray_chain(o, d, line.double()[:, None], radius, free)
        return torch.stack((t, segment.double()), -1)

    pairs = origins.shape[1] * (lines.shape[1] - 1)
    found = _in_turns(measure, len(lines), pairs, origins, directions, lines)
    return torch.minimum(found[..., 0].nan_to_num(math.inf), best), found[..., 1].long()
