"""Ways through space as polylines: how far along a point is, and where it goes next."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


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
