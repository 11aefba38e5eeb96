"""Visits to one slot of a plate after another."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surgisoft.tasks.streams import Stream
from surgisoft.tasks.world_plate import Ways


@dataclass(frozen=True, eq=False)
class Tour:
    """Which targets a batch of episodes visits, V of them, and how many it has."""

    ways: Tensor
    """(B, V) int64: the ways to the targets, in order."""
    reached: Tensor
    """(B,) int64: targets reached so far."""


def fresh_tour(stream: Stream, ways: Ways, visits: int) -> tuple[Stream, Tour]:
    """Targets in slots that differ from one visit to the next, anywhere in each."""
    stream, draw = stream.uniform(0.0, 1.0, 2, visits)
    slots = len(ways.first) - 1
    turns = 1 + (draw[:, 0] * (slots - 1)).long()
    slot = torch.cat(((draw[:, :1, 0] * slots).long(), turns[:, 1:]), 1).cumsum(1) % slots
    low, high = ways.first[slot], ways.first[slot + 1]
    which = torch.minimum(low + (draw[:, 1] * (high - low)).long(), high - 1)
    return stream, Tour(which, torch.zeros_like(stream.count))


def way_mm(ways: Ways, tour: Tour) -> Tensor:
    """(B, 2 L - 1, 3) mm: from the last target back to the middle, and on to the next one."""
    number = tour.reached.clamp(max=tour.ways.shape[1] - 1)[:, None]
    onward = ways.points_mm[tour.ways.gather(1, number)[:, 0]]
    back = ways.points_mm[tour.ways.gather(1, (number - 1).clamp(min=0))[:, 0]].flip(1)
    back = torch.where((number > 0)[..., None], back, onward[:, :1])
    return torch.cat((back[:, :-1], onward), 1)
