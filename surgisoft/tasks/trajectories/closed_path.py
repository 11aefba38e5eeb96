"""Closed reference paths: unit circle and square, and progress along a closed path."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from surgisoft.tasks.world.random_streams import Stream


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
class Traversal:
    """Where each of B episodes starts on a closed path, and in which direction it moves."""

    start: Tensor
    """(B,) 0..1: starting place as a share of the path's length."""
    direction: Tensor
    """(B,) +1 or -1: direction of travel."""

    def share(self, steps: Tensor, wait: int, loop: int) -> Tensor:
        """(B,) place after steps (B,), as a share of the length, not wrapped to 0..1.

        The reference waits for `wait` steps, then goes round once in `loop` steps.
        """
        return self.start + self.direction * (steps - wait).clamp(min=0).float() / loop


def draw_traversal(stream: Stream, anywhere: bool) -> tuple[Stream, Traversal]:
    """Draw a start and a direction for (B,) random number streams; not `anywhere`: 0 and +1."""
    stream, draw = stream.uniform(0.0, 1.0, 2)
    if not anywhere:
        return stream, Traversal(torch.zeros_like(draw[:, 0]), torch.ones_like(draw[:, 0]))
    return stream, Traversal(draw[:, 0], torch.where(draw[:, 1] < 0.5, 1.0, -1.0))


@dataclass(frozen=True, eq=False)
class RingCut:
    """Progress of B cuts around a ring."""

    start: Tensor
    """(B,) 0..1: place where the cut begins, as a share of the ring's length."""
    direction: Tensor
    """(B,) +1 or -1: direction of travel."""
    done: Tensor
    """(B,) int64: steps by which the reference has moved."""
    fired: Tensor
    """(B,) bool: the beam was on in the last step."""

    def share(self, steps: int, ahead: int = 0) -> Tensor:
        """(B,) place `ahead` steps further on, as a share of the length, not wrapped to 0..1.

        The reference goes round once in `steps` steps with the beam on.
        """
        return self.start + self.direction * (self.done + ahead) / steps

    def after(self, fired: Tensor) -> Self:
        """The cut one step later; the reference moves where the beam was on, fired (B,) bool."""
        return replace(self, done=self.done + fired, fired=fired)


def draw_cut(stream: Stream) -> tuple[Stream, RingCut]:
    """Draw the start and the direction of a cut for each of the (B,) random number streams."""
    stream, draw = stream.uniform(0.0, 1.0, 2)
    done = torch.zeros_like(stream.count)
    direction = torch.where(draw[:, 1] < 0.5, 1.0, -1.0)
    return stream, RingCut(draw[:, 0], direction, done, done > 0)


def point_on_closed(paths_mm: Tensor, which: Tensor, share: Tensor) -> Tensor:
    """(B, 3) mm: points at shares (B,) of the length of closed paths (K, N, 3) mm.

    which: (B,) int64, number of each environment's path.
    """
    count = paths_mm.shape[1]
    place = share * count
    below = place.floor()
    first = below.long().remainder(count)
    ends = paths_mm[which, first], paths_mm[which, (first + 1) % count]
    return torch.lerp(*ends, (place - below)[:, None])
