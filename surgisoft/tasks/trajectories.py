"""Closed plane paths of unit size that are followed at even speed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surgisoft.tasks.world.plate import Ways
from surgisoft.tasks.world.random import Stream


def circle(share: Tensor) -> Tensor:
    """(..., 2): the circle of diameter 1 about the origin, at shares (...) of its length."""
    turn = 2.0 * math.pi * share
    return 0.5 * torch.stack((turn.cos(), turn.sin()), -1)


def square(share: Tensor) -> Tensor:
    """(..., 2): the square of edge 1 about the origin, from its right edge's middle upwards."""
    edges = 4.0 * share + 0.5
    return torch.stack((_trapezoid(edges - 0.5), _trapezoid(edges - 1.5)), -1)


def _trapezoid(place: Tensor) -> Tensor:
    """0.5 within 0.5 of 0, -0.5 within 0.5 of 2, straight lines between; period 4."""
    return ((place.remainder(4.0) - 2.0).abs() - 1.0).clamp(-0.5, 0.5)


PATHS: dict[str, Callable[[Tensor], Tensor]] = {"circle": circle, "square": square}
"""Every path by name."""


@dataclass(frozen=True, eq=False)
class Round:
    """How a batch of episodes goes round."""

    start: Tensor
    """(B,) 0..1: share of the path where it begins."""
    way: Tensor
    """(B,) +1 or -1: which way round."""

    def share(self, steps: Tensor, wait: int, loop: int) -> Tensor:
        """(B,) share of the path, any turn, after steps (B,): a wait, then `loop` steps a turn."""
        return self.start + self.way * (steps - wait).clamp(min=0).float() / loop


def fresh_round(stream: Stream, anywhere: bool) -> tuple[Stream, Round]:
    """Rounds for (B,) streams that begin anywhere and run either way, or all alike."""
    stream, draw = stream.uniform(0.0, 1.0, 2)
    if not anywhere:
        return stream, Round(torch.zeros_like(draw[:, 0]), torch.ones_like(draw[:, 0]))
    return stream, Round(draw[:, 0], torch.where(draw[:, 1] < 0.5, 1.0, -1.0))


@dataclass(frozen=True, eq=False)
class Cut:
    """How far a batch of cuts is."""

    start: Tensor
    """(B,) 0..1: share of the ring where the cut begins."""
    way: Tensor
    """(B,) +1 or -1: which way round."""
    walked: Tensor
    """(B,) int64: steps that the target has moved on."""
    fired: Tensor
    """(B,) bool: the beam is on."""

    def share(self, steps: int, ahead: int = 0) -> Tensor:
        """(B,) share of the ring, any turn, `ahead` steps further on; once around in `steps`."""
        return self.start + self.way * (self.walked + ahead) / steps

    def seen(self, steps: int) -> tuple[Tensor, ...]:
        """The place on the ring as sine and cosine, and the way round, each (B, 1)."""
        turn = 2.0 * math.pi * self.share(steps)[:, None]
        return turn.sin(), turn.cos(), self.way[:, None]


def fresh_cut(stream: Stream) -> tuple[Stream, Cut]:
    """Cuts that begin anywhere and go either way round, one for each of the (B,) streams."""
    stream, draw = stream.uniform(0.0, 1.0, 2)
    walked = torch.zeros_like(stream.count)
    way = torch.where(draw[:, 1] < 0.5, 1.0, -1.0)
    return stream, Cut(draw[:, 0], way, walked, walked > 0)


def further(cut: Cut, fired: Tensor) -> Cut:
    """The cut a step later, the beam having been on or not (B,)."""
    return replace(cut, walked=cut.walked + fired, fired=fired)


def along(paths_mm: Tensor, which: Tensor, share: Tensor) -> Tensor:
    """(B, 3) mm: the points at shares (B,) of closed paths (K, N, 3) mm, number which (B,)."""
    count = paths_mm.shape[1]
    place = share * count
    below = place.floor()
    first = below.long().remainder(count)
    ends = paths_mm[which, first], paths_mm[which, (first + 1) % count]
    return torch.lerp(*ends, (place - below)[:, None])


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


@dataclass(frozen=True, eq=False)
class Progress:
    """Where points (B, 3) are along polylines (B, N, 3)."""

    left_mm: Tensor
    """(B,) mm: to the nearest place on the way, and from there to its end."""
    along_mm: Tensor
    """(B,) mm: from the way's beginning to that place."""


def progress(ways_mm: Tensor, points_mm: Tensor) -> Progress:
    """How far points (B, 3) mm are along ways (B, N, 3) mm; the later of two equally near places.

    Points of a way may coincide.
    """
    steps = ways_mm[:, 1:] - ways_mm[:, :-1]
    lengths = steps.norm(dim=2)
    begins = lengths.cumsum(1) - lengths
    away = points_mm[:, None] - ways_mm[:, :-1]
    share = (away * steps).sum(2) / lengths.square().clamp(min=1e-9)
    share = share.clamp(0.0, 1.0)
    gap = (away - share[..., None] * steps).norm(dim=2)
    along = begins + share * lengths
    nearest = (gap - 1e-3 * along).argmin(1, keepdim=True)
    gap, along = gap.gather(1, nearest)[:, 0], along.gather(1, nearest)[:, 0]
    return Progress(gap + lengths.sum(1) - along, along)


def place(ways_mm: Tensor, along_mm: Tensor) -> Tensor:
    """(B, 3) mm: the points of ways (B, N, 3) mm at arc lengths (B,) mm, held to their ends."""
    steps = ways_mm[:, 1:] - ways_mm[:, :-1]
    lengths = steps.norm(dim=2)
    begins = lengths.cumsum(1) - lengths
    share = ((along_mm[:, None] - begins) / lengths.clamp(min=1e-9)).clamp(0.0, 1.0)
    share = torch.where(lengths > 1e-9, share, 0.0)
    return ways_mm[:, 0] + (share[..., None] * steps).sum(1)
