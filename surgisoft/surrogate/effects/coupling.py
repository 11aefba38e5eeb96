"""Coupling: a chamber loses push where another one is loaded.

A loaded neighbour bulges into it and stretches the wall that they share; the loss is a series in
both loads, cut after its second order:

    x_eff_i = x_i - sum_{j != i} (linear x_j + quadratic_ij x_j |x_j|),      x = load,

or, where the neighbour takes a share of what the chamber pushes,

    x_eff_i = x_i - sum_{j != i} (linear x_j + product_ij x_i x_j).
"""

import torch
from torch import Tensor, nn

from surgisoft.surrogate.effects.base import ArmFacts, Memoryless, Quantity, amplitude, value_of


class Coupling(Memoryless):
    """Loss of push by the other chambers' loads."""

    stage = "material"

    def __init__(self, facts: ArmFacts, pairs: bool = False, product: bool = False):
        """pairs: a loss of second order of its own for each pair, not one for all; product: that
        loss goes with both loads."""
        super().__init__(facts)
        m = len(facts.low)
        self.pairs, self.of_both = bool(pairs), bool(product)
        self.linear = amplitude(1)
        second = amplitude(m * (m - 1) if self.pairs else 1)
        if self.of_both:
            self.product = second
        else:
            self.quadratic = second
        place = (1 - torch.eye(m)).flatten().nonzero().flatten()
        spread = torch.nn.functional.one_hot(place, m * m).float().view(-1, m, m)
        spread = spread if self.pairs else spread.sum(0, keepdim=True)
        self.register_buffer("spread", spread, persistent=False)

    def strengths(self) -> dict[str, nn.Parameter]:
        return {"linear": self.linear, self._second: getattr(self, self._second)}

    @property
    def _second(self) -> str:
        """Name of the amplitudes of second order."""
        return "product" if self.of_both else "quadratic"

    @classmethod
    def candidates(cls, facts: ArmFacts, points: Tensor) -> list[Memoryless]:
        """One loss for all pairs, and one for each; none for a single chamber."""
        if len(facts.low) == 1:
            return []
        return [cls(facts), cls(facts, pairs=True), cls(facts, pairs=True, product=True)]

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Effective actuation (..., m) from actuation (..., m)."""
        x = self.load(signal)
        lost = self.linear * (x.sum(-1, keepdim=True) - x)
        shares = torch.einsum("k,kij->ji", getattr(self, self._second), self.spread)
        lost = lost + (x * (x @ shares) if self.of_both else (x * x.abs()) @ shares)
        return signal - self.reach * lost

    def columns(self, signal: Tensor, memory: Tensor) -> Tensor:
        x = self.load(signal).detach()
        linear = (x.sum(-1, keepdim=True) - x).unsqueeze(0)
        second = torch.einsum("kij,...j->k...i", self.spread, x if self.of_both else x * x.abs())
        if self.of_both:
            second = x * second
        return -self.reach * torch.cat([linear, second])

    def config(self) -> dict:
        return {"pairs": self.pairs, "product": self.of_both}

    def quantities(self) -> list[Quantity]:
        wall = "wide: at most half of the push is lost to one neighbour"
        second = getattr(self, self._second)
        total = float(self.linear.detach()) + float(second.detach().sum()) / second.numel()
        return [
            Quantity("linear_share", value_of(self.linear), "", -0.3, 0.5, wall),
            Quantity(f"{self._second}_share", value_of(second), "", -0.3, 0.5, wall),
            Quantity("total_share", total, "", -0.2, 0.5, wall),
        ]
