"""What an arm recalls of its last steps: how its pressures changed, and where that brought it.

An arm with hysteresis answers a change of pressure more or less, by how far its chambers have come
since they last turned round, and before. What the last steps did tells how it answers now.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Recall:
    """The last R steps of a batch of episodes, newest first; zero before an episode began."""

    kPa: Tensor
    """(B, R, m) kPa: change of the measured pressures in each step."""
    mm: Tensor
    """(B, R, 3) mm: movement of the point that follows, as measured, world frame."""

    def after(self, kPa: Tensor, mm: Tensor) -> Recall:
        """A step later, which changed pressures by (B, m) kPa and moved the point by (B, 3) mm."""
        return Recall(_pushed(self.kPa, kPa), _pushed(self.mm, mm))

    def seen(self) -> tuple[Tensor, ...]:
        """As observed: (B, R m) and (B, R 3), of the order of 1 while a path is followed."""
        return self.kPa.flatten(1), self.mm.flatten(1)


def nothing(count: int, steps: int, chambers: int, device: torch.device) -> Recall:
    """B = `count` episodes that have just begun, which will recall R = `steps` steps."""
    zeros = torch.zeros(count, steps, chambers + 3, device=device)
    return Recall(zeros[..., :chambers], zeros[..., chambers:])


def _pushed(last: Tensor, new: Tensor) -> Tensor:
    return torch.cat((new[:, None], last), 1)[:, : last.shape[1]]
