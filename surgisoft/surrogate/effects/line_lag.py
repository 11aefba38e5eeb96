"""Line lag: the chamber's pressure follows the command through a long thin tube.

A chamber fills through the resistance of its tube, a first-order lag (Blackburn, Reethof & Shearer
1960), with another time constant in emptying than in filling (choked and laminar flow, and
the valve's own openings, differ). The tube itself spreads the command's arrival over a dead time
(Schuder & Binder 1959), here a chain of N equal lags of the same mean ("linear chain trick",
MacDonald 1978):

    c_1' = (p - c_1) N / dead,   c_k' = (c_{k-1} - c_k) N / dead
    y'   = (c_N - y) / tau,      tau = tau_up where c_N > y, tau_down elsewhere
    p_out = p + share (y - p).

The command is held between two rows, and each lag is integrated exactly. share = 1 is the lag
itself, 0 no lag at all.
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

CHAIN = 3
"""Lags that make up the dead time."""
GRID = (
    (0.05, 0.05, 0.02),
    (0.15, 0.15, 0.02),
    (0.4, 0.4, 0.02),
    (1.0, 1.0, 0.02),
    (2.5, 2.5, 0.02),
    (0.1, 0.3, 0.02),
    (0.25, 0.8, 0.02),
    (0.5, 2.0, 0.02),
    (0.2, 0.2, 0.2),
    (0.5, 1.0, 0.4),
    (0.9, 3.3, 0.1),
)
"""(filling, emptying, dead time) that a diagnosis tries, s."""


class LineLag(Effect):
    """First-order lag with its own times up and down, and a dead time."""

    stage = "line"

    def __init__(
        self, facts: ArmFacts, up_s: float = 0.3, down_s: float = 0.3, dead_s: float = 0.02
    ):
        """Time constants of filling and emptying and the mean dead time, s."""
        super().__init__(facts)
        self.share = amplitude(1)
        self.log_up = logarithm(up_s)
        self.log_down = logarithm(down_s)
        self.log_dead = logarithm(dead_s)

    def strengths(self) -> dict[str, nn.Parameter]:
        return {"share": self.share}

    def memory_parameters(self) -> list[nn.Parameter]:
        return [self.log_up, self.log_down, self.log_dead]

    @classmethod
    def candidates(cls, facts: ArmFacts, points: Tensor) -> list[Effect]:
        return [cls(facts, *times) for times in GRID]

    def rest(self, signal: Tensor) -> Tensor:
        """(B, m, 1 + CHAIN) the chamber's pressure and the chain's, all at the command (B, m)."""
        return signal.unsqueeze(-1).expand(*signal.shape, 1 + CHAIN)

    def _keeps(self, dt: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(..., 1) share of a difference that is left after dt (...) s: chain, up, down."""
        dt = dt.unsqueeze(-1)
        return tuple(
            torch.exp(-dt * rate)
            for rate in (
                CHAIN * (-self.log_dead).exp(),
                (-self.log_up).exp(),
                (-self.log_down).exp(),
            )
        )

    def advance(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(B, m, 1 + CHAIN) pressures after the command (B, m)."""
        keep, keep_up, keep_down = self._keeps(context.dt_s)
        chain, before = [], signal
        for link in memory[..., 1:].unbind(-1):
            before = keep * link + (1 - keep) * before
            chain.append(before)
        chamber = memory[..., 0]
        keep = torch.where(before > chamber, keep_up, keep_down)
        return torch.stack([keep * chamber + (1 - keep) * before, *chain], dim=-1)

    def scan(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(R, T, m, 1 + CHAIN) pressures along the command (R, T, m)."""
        keep, keep_up, keep_down = self._keeps(context.dt_s)
        chain, before = [], signal
        for link in memory[..., 1:].unbind(-1):
            before = linear_scan(keep, (1 - keep) * before, link)
            chain.append(before)
        start = memory[..., 0]
        with torch.no_grad():
            up = _rising(before, start, keep_up, keep_down)
        keep = torch.where(up, keep_up, keep_down)
        return torch.stack([linear_scan(keep, (1 - keep) * before, start), *chain], dim=-1)

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Chamber pressure (..., m) from the command (..., m)."""
        return signal + self.share * (memory[..., 0] - signal)

    def columns(self, signal: Tensor, memory: Tensor) -> Tensor:
        return (memory[..., 0] - signal).unsqueeze(0).detach()

    def config(self) -> dict:
        return {}

    def quantities(self) -> list[Quantity]:
        tube = "wide: tubes of up to some ten metres; slower is creep"
        return [
            Quantity("share", value_of(self.share), "", 0.0, 1.2, "1: all of the line lags"),
            Quantity("tau_up_s", value_of(self.log_up.exp()), "s", 0.005, 10.0, tube),
            Quantity("tau_down_s", value_of(self.log_down.exp()), "s", 0.005, 20.0, tube),
            Quantity("dead_s", value_of(self.log_dead.exp()), "s", 0.0, 2.0, tube),
        ]


def _rising(target: Tensor, start: Tensor, keep_up: Tensor, keep_down: Tensor) -> Tensor:
    """(R, T, m) bool: whether the target (R, T, m) is above the lag's last value.

    By Newton's method on the whole recording: with the sides taken from the last answer the lag is
    linear and one scan; the next answer gives the next sides. It ends at the sides of stepping,
    because after k passes the first k rows are right; a handful of passes are enough. Where target
    and lag are equal but for rounding, either side gives the same and the last one is kept.
    """
    before = torch.cat([start.unsqueeze(1), target[:, :-1]], dim=1)
    up = target > before
    level = 1e-6 * target.abs().amax(dim=1, keepdim=True)
    for _ in range(target.shape[1]):
        keep = torch.where(up, keep_up, keep_down)
        lagged = linear_scan(keep, (1 - keep) * target, start)
        above = target - torch.cat([start.unsqueeze(1), lagged[:, :-1]], dim=1)
        now = torch.where(above.abs() > level, above > 0, up)
        if torch.equal(now, up):
            break
        up = now
    return up
