"""Line-lag effect: the chamber's pressure follows the command through a long thin tube.

A chamber fills through the resistance of its tube (Blackburn, Reethof & Shearer 1960), with another
time constant in emptying than in filling (choked and laminar flow, and the openings of the valve,
differ). Slow flow in a tube is laminar, in proportion to the difference of pressure (Hagen &
Poiseuille); fast flow is turbulent and goes with its root (Darcy & Weisbach). Forchheimer (1901)
adds both resistances; here they pass into each other at the difference `turn`. The tube itself
spreads the command's arrival over a dead time (Schuder & Binder 1959), here a chain of N equal lags
of the same mean ("linear chain trick", MacDonald 1978):

    c_1' = (p - c_1) N / dead,   c_k' = (c_{k-1} - c_k) N / dead
    y'   = (c_N - y) / (tau s(|c_N - y| / reach)),   tau = tau_up where c_N > y, tau_down elsewhere
    s(d) = sqrt((turn + d) / (turn + 1/10))
    p_out = p + share (y - p).

So tau is the time constant at a difference of a tenth of the range, and turn -> infinity the linear
lag. share = 1 is the lag itself, 0 no lag at all. The command is held between two rows; the chain
is integrated exactly, the chamber by the exponential midpoint rule (Hochbruck & Ostermann 2010),
which is exact where s is constant and never overshoots.
"""

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from surgisoft.compiled import compiled
from surgisoft.surrogate.effects.base import (
    ArmFacts,
    Context,
    Effect,
    Quantity,
    amplitude,
    logarithm,
    value_of,
)
from surgisoft.surrogate.effects.hypothesis import Hypothesis, no_combinations
from surgisoft.surrogate.effects.readings import MOST_PERCENT, Reading
from surgisoft.surrogate.scan import follow, linear_scan, stepped

CHAIN = 3
"""Lags that make up the dead time."""
USUAL = 0.1
"""Difference, as a share of the range, at which the time constants are stated."""
LAMINAR = 100.0
"""Difference, as a share of the range, up to which flow is laminar by default."""
TURBULENT = 0.003
"""Difference up to which the turbulent flow that identification tries is laminar."""
GRID = (
    (0.05, 0.05, 0.02, LAMINAR),
    (0.15, 0.15, 0.02, LAMINAR),
    (0.4, 0.4, 0.02, LAMINAR),
    (1.0, 1.0, 0.02, LAMINAR),
    (2.5, 2.5, 0.02, LAMINAR),
    (0.1, 0.3, 0.02, LAMINAR),
    (0.25, 0.8, 0.02, LAMINAR),
    (0.5, 2.0, 0.02, LAMINAR),
    (0.2, 0.2, 0.2, LAMINAR),
    (0.5, 1.0, 0.4, LAMINAR),
    (0.9, 3.3, 0.1, LAMINAR),
    (0.1, 0.1, 0.02, TURBULENT),
    (0.3, 0.3, 0.02, TURBULENT),
    (1.0, 1.0, 0.02, TURBULENT),
    (0.1, 0.2, 0.02, TURBULENT),
    (0.2, 0.4, 0.02, TURBULENT),
    (0.35, 0.7, 0.02, TURBULENT),
    (0.6, 1.2, 0.02, TURBULENT),
)
"""(filling, emptying, dead time) in s and the difference at which flow becomes turbulent."""
TOLERANCE = 1e-6
"""Change of the lag, as a share of the range, below which the iteration over a recording ends."""


class Flow(NamedTuple):
    """Decay of the pressure difference between chamber and end of the tube, over one row each."""

    up: Tensor
    """(..., 1) time of the row over the time constant of filling."""
    down: Tensor
    """(..., 1) time of the row over the time constant of emptying."""
    turn: Tensor
    """(m,) difference at which flow becomes turbulent, in the signal's unit."""
    usual: Tensor
    """(m,) difference at which the time constants are stated, in the signal's unit."""

    def decayed(self, gap: Tensor) -> tuple[Tensor, Tensor]:
        """Remaining part of a gap (..., m) after the row, and its derivative by the gap."""
        times = torch.where(gap > 0, self.up, self.down)
        size = gap.abs()
        speed, drop = self._speed(times, size)
        half = torch.exp(-0.5 * speed)
        middle, slope = size * half, half * (1 + 0.5 * size * speed * drop)
        speed, drop = self._speed(times, middle)
        left = torch.exp(-speed)
        return gap * left, left * (1 + size * speed * drop * slope)

    def _speed(self, times: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
        """Decay (..., m) over the row, were it constant, and its relative fall with the size."""
        sum_ = self.turn + size
        return times * ((self.turn + self.usual) / sum_).sqrt(), 0.5 / sum_


class LineLag(Effect):
    """Lag of laminar or turbulent flow, with time constants up and down and a dead time."""

    stage = "line"

    def __init__(
        self,
        facts: ArmFacts,
        up_s: float = 0.3,
        down_s: float = 0.3,
        dead_s: float = 0.02,
        turn: float = LAMINAR,
    ):
        """Time constants of filling and emptying and the mean dead time, s.

        turn: difference at which flow becomes turbulent, as a share of the range.
        """
        super().__init__(facts)
        self.share = amplitude(1)
        self.log_up = logarithm(up_s)
        self.log_down = logarithm(down_s)
        self.log_dead = logarithm(dead_s)
        self.log_turn = logarithm(turn)

    def amplitudes(self) -> dict[str, nn.Parameter]:
        """`share` (1,) of the command that lags; 1: all of it."""
        return {"share": self.share}

    def memory_parameters(self) -> list[nn.Parameter]:
        """Time constants, dead time and turbulence threshold, each (1,)."""
        return [self.log_up, self.log_down, self.log_dead, self.log_turn]

    def rest(self, signal: Tensor) -> Tensor:
        """(B, m, 1 + CHAIN) pressures of the chamber and of the chain, at the command (B, m)."""
        return signal.unsqueeze(-1).expand(*signal.shape, 1 + CHAIN)

    def _keep(self, dt: Tensor) -> Tensor:
        """(..., 1) share of a link's difference that is left after dt (...) s."""
        return torch.exp(-dt.unsqueeze(-1) * CHAIN * (-self.log_dead).exp())

    def _flow(self, dt: Tensor) -> Flow:
        """The flow over rows of dt (...) s."""
        dt = dt.unsqueeze(-1)
        up, down = dt * (-self.log_up).exp(), dt * (-self.log_down).exp()
        return Flow(up, down, self.log_turn.exp() * self.reach, USUAL * self.reach)

    def advance(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(B, m, 1 + CHAIN) pressures after the command (B, m)."""
        keep = self._keep(context.dt_s)
        chain, before = [], signal
        for link in memory[..., 1:].unbind(-1):
            before = keep * link + (1 - keep) * before
            chain.append(before)
        left, _ = self._flow(context.dt_s).decayed(before - memory[..., 0])
        return torch.stack([before - left, *chain], dim=-1)

    def scan(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(R, T, m, 1 + CHAIN) pressures along the command (R, T, m)."""
        keep, flow = self._keep(context.dt_s), self._flow(context.dt_s)
        out = stepped(_fill, (signal, keep, flow.up, flow.down), flow[2:], memory)
        if out is not None:
            return out
        chain, before = [], signal
        for link in memory[..., 1:].unbind(-1):
            before = linear_scan(keep, (1 - keep) * before, link)
            chain.append(before)
        chamber = follow(flow.decayed, before, memory[..., 0], TOLERANCE * self.reach)
        return torch.stack([chamber, *chain], dim=-1)

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Chamber pressure (..., m) from the command (..., m)."""
        return signal + self.share * (memory[..., 0] - signal)

    def sensitivities(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(1, ..., m) lagging pressure minus command: closed form."""
        return (memory[..., 0] - signal).unsqueeze(0).detach()

    def config(self) -> dict:
        """No arguments: tensors hold everything."""
        return {}

    def quantities(self) -> list[Quantity]:
        """Share, time constants and dead time (s), and the turbulence threshold."""
        tube = "wide: tubes of up to some ten metres; slower is creep"
        both = "from turbulent in every flow to laminar in every flow"
        return [
            Quantity("share", value_of(self.share), "", 0.0, 1.05, "1: all of the line lags"),
            Quantity("tau_up_s", value_of(self.log_up.exp()), "s", 0.005, 10.0, tube),
            Quantity("tau_down_s", value_of(self.log_down.exp()), "s", 0.005, 20.0, tube),
            Quantity("dead_s", value_of(self.log_dead.exp()), "s", 0.0, 2.0, tube),
            Quantity("turn", value_of(self.log_turn.exp()), "", 0.0, 1e4, both),
        ]

    def readings(self, seconds: float | None = None) -> list[Reading]:
        """Time constants and dead time (s), and how much of the command they delay (%)."""
        up, down, dead = (
            float(p.detach().exp()) for p in (self.log_up, self.log_down, self.log_dead)
        )
        share = 100 * float(self.share.detach())
        slowest = max(up, down)
        return [
            Reading("time constant of a rise {}", up, "s", slowest),
            Reading("time constant of a fall {}", down, "s", slowest),
            Reading("dead time {}", dead, "s", dead),
            Reading("{} of the command lags", share, "%", most=MOST_PERCENT),
        ]


@compiled
def _fill(signal, keep, up, down, turn, usual, memory, out):
    """Step `LineLag.advance` along commands (R, T, m), from memory (R, m, 1 + CHAIN), into out.

    keep, up, down (R, T, 1): see `LineLag._keep` and `Flow`, as are turn and usual (m,).
    """
    half = np.float32(0.5)
    runs, steps, chambers = signal.shape
    for r in range(runs):
        before = memory[r]
        for t in range(steps):
            after = out[r, t]
            share, filling, emptying = keep[r, t, 0], up[r, t, 0], down[r, t, 0]
            for m in range(chambers):
                end = signal[r, t, m]
                for link in range(1, after.shape[1]):
                    end = share * before[m, link] + (np.float32(1.0) - share) * end
                    after[m, link] = end
                gap = end - before[m, 0]
                times = filling if gap > 0 else emptying
                size, stated = abs(gap), turn[m] + usual[m]
                middle = size * math.exp(-half * times * math.sqrt(stated / (turn[m] + size)))
                after[m, 0] = end - gap * math.exp(-times * math.sqrt(stated / (turn[m] + middle)))
            before = after


def _grid(facts: ArmFacts, points: Tensor) -> list[Effect]:
    return [LineLag(facts, *values) for values in GRID]


# A chamber has one line; lags of both signs together would be a lead.
HYPOTHESIS = Hypothesis(
    LineLag,
    _grid,
    combinations=no_combinations,
    needs_motion=True,
    memory="time",
    absent_in="short_tube",
)
