"""Rate dependence: a viscous wall resists fast changes.

    y' = (u - y) / tau,   r = (u - y) / tau,                      u = A x, x = load,
    x_eff = x - A' (viscous r + thinning r / (r^2 + r_0^2)^(1/4)),

r is the rate of a wall line's load, filtered over tau. The first resistance is Newton's fluid, the
second the shear-thinning one of Ostwald and de Waele with the power 1/2 (Bird, Armstrong & Hassager
1987, sec. 4.1), smoothed below r_0. A has ones on its diagonal and the share of the other chambers
beside them: a chamber that bends the arm shortens the wall on the other side. The load is held
between two rows.
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
    mixed,
    value_of,
)
from surgisoft.surrogate.scan import linear_scan

SLOW = 0.01
"""Rate r_0 below which the shear-thinning term is linear, 1/s."""
GRID = (0.04, 0.12, 0.4)
"""Filter times that a diagnosis tries, s."""


class RateDependence(Effect):
    """Newtonian and shear-thinning resistance to the rate of the wall lines' loads, all alike."""

    stage = "material"

    def __init__(self, facts: ArmFacts, tau_s: float = 0.2, others: float = 0.0):
        """Time over which the rate is taken, s; share of the other chambers in a line's load."""
        super().__init__(facts)
        self.viscous = amplitude(1)
        self.thinning = amplitude(1)
        self.log_tau = logarithm(tau_s)
        self.others = nn.Parameter(torch.tensor([float(others)]))

    def strengths(self) -> dict[str, nn.Parameter]:
        return {"viscous": self.viscous, "thinning": self.thinning}

    def memory_parameters(self) -> list[nn.Parameter]:
        return [self.log_tau, self.others]

    @classmethod
    def candidates(cls, facts: ArmFacts, points: Tensor) -> list[Effect]:
        return [cls(facts, tau) for tau in GRID]

    def lines(self, signal: Tensor) -> Tensor:
        """(..., m) load of each wall line from the actuation (..., m)."""
        return mixed(self.load(signal), self.others)

    def rest(self, signal: Tensor) -> Tensor:
        """(B, m) filtered loads of an arm that has rested at the actuation (B, m)."""
        return self.lines(signal)

    def advance(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(B, m) filtered loads after the actuation (B, m)."""
        keep = torch.exp(-context.dt_s.unsqueeze(-1) / self.log_tau.exp())
        return keep * memory + (1 - keep) * self.lines(signal)

    def scan(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(R, T, m) filtered loads along the actuation (R, T, m)."""
        keep = torch.exp(-context.dt_s.unsqueeze(-1) / self.log_tau.exp())
        return linear_scan(keep, (1 - keep) * self.lines(signal), memory)

    def _resistances(self, signal: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        rate = (self.lines(signal) - memory) / self.log_tau.exp()
        thin = rate / (rate.square() + SLOW**2).pow(0.25)
        return mixed(rate, self.others), mixed(thin, self.others)

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Effective actuation (..., m) from actuation and filtered loads (..., m)."""
        newton, thin = self._resistances(signal, memory)
        return signal - self.reach * (self.viscous * newton + self.thinning * thin)

    def columns(self, signal: Tensor, memory: Tensor) -> Tensor:
        return -self.reach * torch.stack(self._resistances(signal, memory)).detach()

    def config(self) -> dict:
        return {}

    def quantities(self) -> list[Quantity]:
        rubber = "wide: what is slower than a second is creep"
        passive = "a fluid takes energy at high rates; a little less than 0 for the noise"
        learned = "less than 0 where a network that sees directions has learned too much of it"
        at_one = float((self.viscous + self.thinning).detach())
        return [
            Quantity("viscous_s", value_of(self.viscous), "s", -0.05, 1.0, passive),
            Quantity("thinning_s^0.5", value_of(self.thinning), "s^0.5", -0.5, 1.0, learned),
            Quantity("shift_at_1_per_s_share", at_one, "", 0.0, 1.0, "viscosity takes energy"),
            Quantity("tau_s", value_of(self.log_tau.exp()), "s", 0.01, 10.0, rubber),
            Quantity("others_share", value_of(self.others), "", -1.0, 1.0, "a mixture of shares"),
        ]
