"""Hysteresis: superposed play operators with memory (Prandtl-Ishlinskii).

A play operator of radius r follows its input through a gap of width 2r:
y(t) = clamp(y(t-), x(t) - r, x(t) + r) (Krasnosel'skii & Pokrovskii 1989, ch. 1). Many of them
remember every reversal that no larger one has wiped out. The effective actuation is

    p_eff_i = p_i + sum_k sum_j (w_ikj + v_ikj x_k) (y_kj - p_k),     x_k = p_k scaled to [-1, 1]

with thresholds j and chambers i, k: w is the classical superposition (Kuhnen 2003, eq. 8) with
cross terms between the chambers, v lets the loop's width depend on the pressure, as in a Preisach
density that is not constant along the diagonal (Mayergoyz 2003, ch. 1).
"""

import torch
from torch import Tensor, nn

from surgisoft.surrogate.arm import centre_and_half
from surgisoft.surrogate.effects.base import Effect, Quantity
from surgisoft.surrogate.scan import clamp_scan

RADII = (0.01, 0.02, 0.04, 0.07, 0.11, 0.16, 0.22, 0.29, 0.37, 0.45)
"""Radii of the play operators as shares of the chamber's range: fine for small reversals, and up
to nearly half of it (a radius above one half never moves)."""


class Hysteresis(Effect):
    """Rate-independent hysteresis with minor loops."""

    stage = "material"

    def __init__(self, low: Tensor, high: Tensor, radii: tuple[float, ...] = RADII):
        """Pressure range low, high (m,) in the arm's unit; radii as shares of it."""
        super().__init__()
        centre, half = centre_and_half(low, high)
        self.radii = tuple(radii)
        self.register_buffer("centre", centre)
        self.register_buffer("half_range", half)
        self.register_buffer("radius", 2 * half[:, None] * torch.tensor(self.radii))
        self.register_buffer("use", torch.ones(len(low)))
        shape = (len(low), len(low), len(self.radii))
        self.weight = nn.Parameter(torch.zeros(shape))
        self.slope = nn.Parameter(torch.zeros(shape))

    def rest(self, signal: Tensor) -> Tensor:
        """(B, m, J) plays centred on the pressure (B, m): no remembered history."""
        return signal.unsqueeze(-1).expand(*signal.shape, len(self.radii))

    def advance(self, memory: Tensor, signal: Tensor, dt: Tensor) -> Tensor:
        """(B, m, J) plays after the pressure (B, m); dt does not matter."""
        x = signal.unsqueeze(-1)
        return torch.minimum(torch.maximum(memory, x - self.radius), x + self.radius)

    def scan(self, signal: Tensor, dt: Tensor) -> Tensor:
        """(R, T, m, J) plays along the pressures (R, T, m)."""
        x = signal.unsqueeze(-1)
        return clamp_scan(x - self.radius, x + self.radius, self.rest(signal[:, 0]))

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Effective actuation (..., m) from pressure (..., m) and plays (..., m, J)."""
        lag = (memory - signal.unsqueeze(-1)) * self.use[:, None]
        x = (signal - self.centre) / self.half_range
        both = torch.cat([lag.flatten(-2), (lag * x.unsqueeze(-1)).flatten(-2)], dim=-1)
        table = torch.cat([self.weight.flatten(1), self.slope.flatten(1)], dim=1)
        return signal + both @ table.T

    def config(self) -> dict:
        return {"radii": list(self.radii)}

    def quantities(self) -> list[Quantity]:
        own = self.weight.detach().diagonal().T * self.use[:, None]
        return [
            Quantity("radius", self.radius.tolist(), "actuation"),
            Quantity("weight", own.tolist(), ""),
            Quantity("loop_share", own.sum(1).tolist(), ""),
        ]
