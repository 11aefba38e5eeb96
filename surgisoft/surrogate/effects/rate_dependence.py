"""Rate dependence: a viscous wall resists fast changes.

    y' = (x - y) / tau,   r = (x - y) / tau,
    x_eff = x - viscous r - thinning r / (r^2 + r_0^2)^(1/4),     x = load

r is the rate of the load, filtered over tau. The second term is Newton's fluid, the third the
shear-thinning one of Ostwald and de Waele with the power 1/2 (Bird, Armstrong & Hassager 1987, sec.
4.1), smoothed below r_0. The load is held between two rows.
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
from surgisoft.surrogate.scan import linear_scan

SLOW = 0.01
"""Rate r_0 below which the shear-thinning term is linear, 1/s."""
GRID = (0.04, 0.12, 0.4)
"""Filter times that a diagnosis tries, s."""


class RateDependence(Effect):
    """Newtonian and shear-thinning resistance to the load's rate, the same for all chambers."""

    stage = "material"

    def __init__(self, facts: ArmFacts, tau_s: float = 0.2):
        """Time over which the rate is taken, s."""
        super().__init__(facts)
        self.viscous = amplitude(1)
        self.thinning = amplitude(1)
        self.log_tau = logarithm(tau_s)

    def strengths(self) -> dict[str, nn.Parameter]:
        return {"viscous": self.viscous, "thinning": self.thinning}

    def memory_parameters(self) -> list[nn.Parameter]:
        return [self.log_tau]

    @classmethod
    def candidates(cls, facts: ArmFacts, points: Tensor) -> list[Effect]:
        return [cls(facts, tau) for tau in GRID]

    def rest(self, signal: Tensor) -> Tensor:
        """(B, m) filtered load of an arm that has rested at the actuation (B, m)."""
        return self.load(signal)

    def advance(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(B, m) filtered load after the actuation (B, m)."""
        keep = torch.exp(-context.dt_s.unsqueeze(-1) / self.log_tau.exp())
        return keep * memory + (1 - keep) * self.load(signal)

    def scan(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(R, T, m) filtered load along the actuation (R, T, m)."""
        keep = torch.exp(-context.dt_s.unsqueeze(-1) / self.log_tau.exp())
        return linear_scan(keep, (1 - keep) * self.load(signal), memory)

    def _resistances(self, signal: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        rate = (self.load(signal) - memory) / self.log_tau.exp()
        return rate, rate / (rate.square() + SLOW**2).pow(0.25)

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Effective actuation (..., m) from actuation and filtered load (..., m)."""
        newton, thin = self._resistances(signal, memory)
        return signal - self.reach * (self.viscous * newton + self.thinning * thin)

    def columns(self, signal: Tensor, memory: Tensor) -> Tensor:
        return -self.reach * torch.stack(self._resistances(signal, memory)).detach()

    def config(self) -> dict:
        return {}

    def quantities(self) -> list[Quantity]:
        rubber = "wide: what is slower than a second is creep"
        at_one = float((self.viscous + self.thinning).detach())
        return [
            Quantity("viscous_s", value_of(self.viscous), "s", -0.5, 1.0, rubber),
            Quantity("thinning_s^0.5", value_of(self.thinning), "s^0.5", -0.5, 1.0, rubber),
            Quantity("shift_at_1_per_s_share", at_one, "", 0.0, 1.0, "viscosity takes energy"),
            Quantity("tau_s", value_of(self.log_tau.exp()), "s", 0.01, 10.0, rubber),
        ]
