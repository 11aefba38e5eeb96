"""Pressures of the chambers: what a command asks for, and how fast the pumps follow."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from surgisoft.errors import InputError


@dataclass(frozen=True)
class Pneumatics:
    """A first-order lag between commanded pressure and chamber pressure.

    dp/dt = (command - p) / tau, solved exactly over a step in which the command is held:
    p(t + dt) = command + (p(t) - command) exp(-dt / tau).
    """

    step_kPa: float = 3.0
    """Largest change of a command in one step, kPa (Chen et al. 2025, sec. IV-A)."""
    tau_s: float = 0.2
    """Time constant, s: the virtual rig's pumps have gone 63 % of a 3 kPa step after 0.27 s at
    0 kPa, 0.19 s at 20 kPa and 0.15 s at 40 kPa. 0: the chamber has the pressure at once."""

    def __post_init__(self):
        if not (math.isfinite(self.step_kPa) and self.step_kPa > 0.0):
            raise InputError(f"pneumatics: step_kPa is {self.step_kPa}, expected more than 0 kPa")
        if not (math.isfinite(self.tau_s) and self.tau_s >= 0.0):
            raise InputError(f"pneumatics: tau_s is {self.tau_s}, expected 0 s or more")

    def share(self, dt_s: float) -> float:
        """Share of the way to the command that the chamber goes in dt_s seconds."""
        return 1.0 if self.tau_s == 0.0 else -math.expm1(-dt_s / self.tau_s)

    def command(self, command: Tensor, action: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """(B, m) kPa: the command (B, m) changed by the action (B, m), within low, high (m,)."""
        change = action.clamp(-self.step_kPa, self.step_kPa)
        return torch.minimum(torch.maximum(command + change, low), high)

    def follow(self, pressure: Tensor, command: Tensor, dt_s: float) -> Tensor:
        """(B, m) kPa: chamber pressure dt_s seconds later, with the command held."""
        return pressure + self.share(dt_s) * (command - pressure)

    def action_for(self, command: Tensor, pressure: Tensor, wanted: Tensor, dt_s: float) -> Tensor:
        """(B, m) kPa: the action after which the chambers have `wanted` (B, m), were it free."""
        return pressure + (wanted - pressure) / self.share(dt_s) - command
