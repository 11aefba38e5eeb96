"""Walking round a closed path at even speed, after a wait where it begins."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from surgisoft.tasks.streams import Stream


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
