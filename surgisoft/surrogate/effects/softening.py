"""Softening: the wall is softer below the largest load that it has seen (Mullins 1969).

As in pseudo-elasticity (Ogden & Roxburgh 1999), with the energy W ~ x^2 of the load and its
largest value so far W_max, and an exponential instead of the error function:

    x_eff_i = x_i (1 + own d(W_i, W_max,i) + common d(V, V_max)),
    d(W, W_max) = 1 - exp(-(W_max - W) / width),   W_i = x_i^2,   V = sum_i x_i^2 / m.

On a first loading W = W_max and nothing changes.
"""

import torch
from torch import Tensor, nn

from surgisoft.surrogate.effects.base import (
    ArmFacts,
    Context,
    Effect,
    Quantity,
    amplitude,
    logarithm,
    value_of,
)

GRID = (0.05, 0.2, 0.8)
"""Widths that a diagnosis tries, in units of the energy at full load."""


class Softening(Effect):
    """Mullins softening by the largest load of a chamber and of all of them."""

    stage = "material"

    def __init__(self, facts: ArmFacts, width: float = 0.2):
        """Fall of the energy over which the wall turns soft, in units of that at full load."""
        super().__init__(facts)
        self.own = amplitude(1)
        self.common = amplitude(1)
        self.log_width = logarithm(width)

    def strengths(self) -> dict[str, nn.Parameter]:
        return {"own": self.own, "common": self.common}

    @classmethod
    def candidates(cls, facts: ArmFacts, points: Tensor) -> list[Effect]:
        return [cls(facts, width) for width in GRID]

    def energy(self, signal: Tensor) -> Tensor:
        """(..., m + 1) energy of each chamber and the mean of all, from actuation (..., m)."""
        own = self.load(signal).square()
        return torch.cat([own, own.mean(-1, keepdim=True)], dim=-1)

    def rest(self, signal: Tensor) -> Tensor:
        """(B, m + 1) largest energies of an arm that has only seen the actuation (B, m)."""
        return self.energy(signal)

    def advance(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(B, m + 1) largest energies after the actuation (B, m)."""
        return torch.maximum(memory, self.energy(signal))

    def scan(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(R, T, m + 1) largest energies along the actuation (R, T, m)."""
        return torch.maximum(self.energy(signal).cummax(dim=1).values, memory.unsqueeze(1))

    def _softened(self, signal: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Two (..., m) shifts of the actuation at strength one: own and common."""
        below = (memory - self.energy(signal)).clamp(min=0)
        damage = -torch.expm1(-below / self.log_width.exp())
        moved = signal - self.origin
        return moved * damage[..., :-1], moved * damage[..., -1:]

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Effective actuation (..., m) from actuation (..., m) and largest energies."""
        own, common = self._softened(signal, memory)
        return signal + self.own * own + self.common * common

    def columns(self, signal: Tensor, memory: Tensor) -> Tensor:
        return torch.stack(self._softened(signal, memory)).detach()

    def config(self) -> dict:
        return {}

    def quantities(self) -> list[Quantity]:
        rubber = "wide: at most twice the push; a wall does not heal by load (Mullins 1969)"
        total = float((self.own + self.common).detach())
        return [
            Quantity("own_share", value_of(self.own), "", -0.5, 1.0, rubber),
            Quantity("common_share", value_of(self.common), "", -0.5, 1.0, rubber),
            Quantity("total_share", total, "", 0.0, 1.0, rubber),
            Quantity("width_share", value_of(self.log_width.exp()), "", 0.005, 5.0, rubber),
        ]
