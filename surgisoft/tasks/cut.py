"""The cut around a lesion: where it begins, which way round, and how far it is."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surgisoft.tasks.streams import Stream


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
