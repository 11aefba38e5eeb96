"""Waypoint sequences: routes to one target after another, and progress along a polyline."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surgisoft.tasks.world.plate import Routes
from surgisoft.tasks.world.random_streams import Stream


@dataclass(frozen=True, eq=False)
class WaypointSequence:
    """The V targets that each of B episodes visits, and how many it has reached."""

    order: Tensor
    """(B, V) int64: numbers of the routes to the targets, in order."""
    reached: Tensor
    """(B,) int64: number of targets reached."""


def draw_sequence(stream: Stream, routes: Routes, visits: int) -> tuple[Stream, WaypointSequence]:
    """Draw `visits` targets for each of the (B,) random number streams; no slot twice in a row."""
    stream, draw = stream.uniform(0.0, 1.0, 2, visits)
    slots = len(routes.first) - 1
    turns = 1 + (draw[:, 0] * (slots - 1)).long()
    slot = torch.cat(((draw[:, :1, 0] * slots).long(), turns[:, 1:]), 1).cumsum(1) % slots
    low, high = routes.first[slot], routes.first[slot + 1]
    which = torch.minimum(low + (draw[:, 1] * (high - low)).long(), high - 1)
    return stream, WaypointSequence(which, torch.zeros_like(stream.count))


def route_mm(routes: Routes, sequence: WaypointSequence) -> Tensor:
    """(B, 2 L - 1, 3) mm: from the last target back to the centre, and on to the next target."""
    number = sequence.reached.clamp(max=sequence.order.shape[1] - 1)[:, None]
    onward = routes.points_mm[sequence.order.gather(1, number)[:, 0]]
    back = routes.points_mm[sequence.order.gather(1, (number - 1).clamp(min=0))[:, 0]].flip(1)
    back = torch.where((number > 0)[..., None], back, onward[:, :1])
    return torch.cat((back[:, :-1], onward), 1)


@dataclass(frozen=True, eq=False)
class Progress:
    """How far points (B, 3) are along polylines (B, N, 3)."""

    remaining_mm: Tensor
    """(B,) mm: distance to the nearest point of the polyline plus arc length from it to the end."""
    along_mm: Tensor
    """(B,) mm: arc length from the beginning to that nearest point."""


def progress(lines_mm: Tensor, points_mm: Tensor) -> Progress:
    """Project points (B, 3) mm on polylines (B, N, 3) mm.

    Of two equally near places the later one counts. Points of a polyline may coincide.
    """
    steps = lines_mm[:, 1:] - lines_mm[:, :-1]
    lengths = steps.norm(dim=2)
    begins = lengths.cumsum(1) - lengths
    away = points_mm[:, None] - lines_mm[:, :-1]
    share = (away * steps).sum(2) / lengths.square().clamp(min=1e-9)
    share = share.clamp(0.0, 1.0)
    gap = (away - share[..., None] * steps).norm(dim=2)
    along = begins + share * lengths
    nearest = (gap - 1e-3 * along).argmin(1, keepdim=True)
    gap, along = gap.gather(1, nearest)[:, 0], along.gather(1, nearest)[:, 0]
    return Progress(gap + lengths.sum(1) - along, along)


def point_at(lines_mm: Tensor, along_mm: Tensor) -> Tensor:
    """(B, 3) mm: points of polylines (B, N, 3) mm at arc lengths (B,) mm, clipped to their ends."""
    steps = lines_mm[:, 1:] - lines_mm[:, :-1]
    lengths = steps.norm(dim=2)
    begins = lengths.cumsum(1) - lengths
    share = ((along_mm[:, None] - begins) / lengths.clamp(min=1e-9)).clamp(0.0, 1.0)
    share = torch.where(lengths > 1e-9, share, 0.0)
    return lines_mm[:, 0] + (share[..., None] * steps).sum(1)
