"""Coupling: a chamber loses push where another one is loaded.

A loaded neighbour bulges into it and stretches the wall that they share; the loss is a series in
the neighbour's load, cut after its second term:

    x_eff_i = x_i - sum_{j != i} (linear x_j + quadratic_ij x_j |x_j|),      x = load.
"""

import torch
from torch import Tensor, nn

from surgisoft.surrogate.effects.base import ArmFacts, Memoryless, Quantity, amplitude, value_of


class Coupling(Memoryless):
    """Loss of push by the other chambers' loads."""

    stage = "material"

    def __init__(self, facts: ArmFacts, pairs: bool = False):
        """pairs: a quadratic loss of its own for each pair, not one for all."""
        super().__init__(facts)
        m = len(facts.low)
        self.pairs = bool(pairs)
        self.linear = amplitude(1)
        self.quadratic = amplitude(m * (m - 1) if self.pairs else 1)
        place = (1 - torch.eye(m)).flatten().nonzero().flatten()
        spread = torch.nn.functional.one_hot(place, m * m).float().view(-1, m, m)
        spread = spread if self.pairs else spread.sum(0, keepdim=True)
        self.register_buffer("spread", spread, persistent=False)

    def strengths(self) -> dict[str, nn.Parameter]:
        return {"linear": self.linear, "quadratic": self.quadratic}

    @classmethod
    def candidates(cls, facts: ArmFacts, points: Tensor) -> list[Memoryless]:
        """One loss for all pairs, and one for each; none for a single chamber."""
        if len(facts.low) == 1:
            return []
        return [cls(facts), cls(facts, pairs=True)]

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Effective actuation (..., m) from actuation (..., m)."""
        x = self.load(signal)
        lost = self.linear * (x.sum(-1, keepdim=True) - x)
        lost = lost + (x * x.abs()) @ torch.einsum("k,kij->ji", self.quadratic, self.spread)
        return signal - self.reach * lost

    def columns(self, signal: Tensor, memory: Tensor) -> Tensor:
        x = self.load(signal).detach()
        linear = (x.sum(-1, keepdim=True) - x).unsqueeze(0)
        quadratic = torch.einsum("kij,...j->k...i", self.spread, x * x.abs())
        return -self.reach * torch.cat([linear, quadratic])

    def config(self) -> dict:
        return {"pairs": self.pairs}

    def quantities(self) -> list[Quantity]:
        wall = "wide: at most half of the push is lost to one neighbour"
        total = float(self.linear.detach()) + float(self.quadratic.detach().sum()) / max(
            self.quadratic.numel(), 1
        )
        return [
            Quantity("linear_share", value_of(self.linear), "", -0.3, 0.5, wall),
            Quantity("quadratic_share", value_of(self.quadratic), "", -0.3, 0.5, wall),
            Quantity("total_share", total, "", -0.2, 0.5, wall),
        ]
