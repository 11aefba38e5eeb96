"""Rate-dependence effect: a viscous wall resists fast changes.

    y' = (u - y) / tau  (1 + |u - y| / turn) / (1 + 1/10 / turn),      u = A x / |A|, x = load,
    x_eff = x + share A' (y - u) / |A|.

u is the load of a wall fibre, y the part of it that the fibre has followed, and u - y the stress
that its fluid carries. With share = 1 a fibre is a spring parallel to a dashpot (Kelvin & Voigt),
with less the rest of the wall follows at once (the standard linear solid, Zener 1948). The fluid is
that of Ellis with the exponent 2 (Bird, Armstrong & Hassager 1987, sec. 4.1): Newtonian at stresses
below `turn`, beyond it shear-thinning with a stress like the root of the rate (Ostwald & de Waele).
So tau is the time constant at a stress of a tenth of the range; turn -> infinity is a Newtonian
fluid. A mixes the chambers' loads into those of the fibres (`fibre_matrix`): a chamber that bends
the arm shortens the wall on the other side; what moves all fibres most is held back by the whole
share. The load is held between two rows; over one of them the equation, a logistic one, is solved
exactly.
"""

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
from surgisoft.surrogate.effects.wall_fibres import WallFibres, fibres_tried
from surgisoft.surrogate.scan import follow, stepped

USUAL = 0.1
"""Stress, as a share of the largest load, at which the time constant is stated."""
NEWTON = 100.0
"""Stress up to which a fluid is Newton's by default."""
THIN = 0.01
"""Stress up to which the shear-thinning fluid that identification tries is Newton's."""
NEWTONS, THINS = (0.04, 0.1, 0.25, 0.6), (0.01, 0.04, 0.15, 0.6)
"""Time constants of Newton's and of shear-thinning fluids that identification tries, s."""
OTHERS = -0.5
"""Share of the other chambers in a wall fibre's load that identification tries."""
TOLERANCE = 1e-6
"""Change of a whole recording's loads at which their iteration ends."""


class RateDependence(WallFibres):
    """Newtonian or shear-thinning resistance to the rate of the wall fibres' loads, all alike."""

    stage = "material"

    def __init__(
        self,
        facts: ArmFacts,
        tau_s: float = 0.2,
        turn: float = NEWTON,
        others: float = 0.0,
        ring: bool = False,
    ):
        """Time constant, s; stress at which the fluid thins, as a share of the largest load; the
        mixture of the wall fibres' loads (`fibre_matrix`)."""
        super().__init__(facts)
        self.share = amplitude(1)
        self.log_tau = logarithm(tau_s)
        self.log_turn = logarithm(turn)
        self.set_fibres(others, ring)

    def amplitudes(self) -> dict[str, nn.Parameter]:
        """`share` (1,) of the load that the fluid holds back at first; 1: all of it."""
        return {"share": self.share}

    def memory_parameters(self) -> list[nn.Parameter]:
        """Time constant, thinning stress and the fibres' mixture, each (1,)."""
        return [self.log_tau, self.log_turn, self.others]

    def rest(self, signal: Tensor) -> Tensor:
        """(B, K) loads that the fibres of an arm at rest at the actuation (B, m) have followed."""
        return self.fibre_loads(signal)

    def _keep(self, dt: Tensor) -> Tensor:
        """Share of a stress near zero that dt (..., 1) s leave."""
        return torch.exp(-dt * (-self.log_tau).exp() / (1 + USUAL / self.log_turn.exp()))

    def _decayed(self, dt: Tensor, stress: Tensor) -> tuple[Tensor, Tensor]:
        """What dt (..., 1) s leave of a stress (..., K), and its derivative by the stress."""
        turn, keep = self.log_turn.exp(), self._keep(dt)
        faster = 1 + (1 - keep) * stress.abs() / turn
        return stress * keep / faster, keep / faster.square()

    def advance(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(B, K) loads that the fibres have followed after the actuation (B, m)."""
        u = self.fibre_loads(signal)
        return u - self._decayed(context.dt_s.unsqueeze(-1), u - memory)[0]

    def scan(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(R, T, K) loads that the fibres have followed along the actuation (R, T, m)."""
        dt, loads = context.dt_s.unsqueeze(-1), self.fibre_loads(signal)
        out = stepped(_flow, (loads, self._keep(dt)), (self.log_turn.exp(),), memory)
        if out is not None:
            return out
        return follow(lambda s: self._decayed(dt, s), loads, memory, TOLERANCE)

    def _behind(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(..., m) part of the loads that the fluid holds back, at share 1."""
        return (memory - self.fibre_loads(signal)) @ self.fibres

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Effective actuation (..., m) from actuation (..., m) and followed loads."""
        return signal + self.reach * self.share * self._behind(signal, memory)

    def sensitivities(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(1, ..., m) actuation that the fluid holds back: closed form."""
        return (self.reach * self._behind(signal, memory)).unsqueeze(0).detach()

    def quantities(self) -> list[Quantity]:
        """Share, time constant (s), thinning stress and the fibres' mixture."""
        rubber = "wide: what is slower than a second is creep"
        fluid = "1: a fluid keeps all of a step back; it cannot push"
        both = "from shear-thinning at every stress to Newton's at every stress"
        return [
            Quantity("share", value_of(self.share), "", 0.0, 1.05, fluid),
            Quantity("tau_s", value_of(self.log_tau.exp()), "s", 0.005, 10.0, rubber),
            Quantity("turn", value_of(self.log_turn.exp()), "", 0.0, 1e4, both),
            *self.mixture(),
        ]

    def readings(self, seconds: float | None = None) -> list[Reading]:
        """Time constant (s) and the share of the load that is held back at first (%)."""
        share = 100 * float(self.share.detach())
        return [
            Reading("time constant {}", float(self.log_tau.detach().exp()), "s"),
            Reading("{} of a change of load is held back at first", share, "%", most=MOST_PERCENT),
        ]


@compiled
def _flow(loads, keep, turn, memory, out):
    """Step `RateDependence.advance` along loads (R, T, K), from memory (R, K), into out.

    keep (R, T, 1): see `RateDependence._keep`; turn (1,): thinning stress.
    """
    runs, steps, fibres = loads.shape
    one = np.float32(1.0)
    for r in range(runs):
        before = memory[r]
        for t in range(steps):
            left, after = keep[r, t, 0], out[r, t]
            for k in range(fibres):
                stress = loads[r, t, k] - before[k]
                faster = one + (one - left) * abs(stress) / turn[0]
                after[k] = loads[r, t, k] - stress * left / faster
            before = after


def _grid(facts: ArmFacts, points: Tensor) -> list[Effect]:
    newton = [RateDependence(facts, tau) for tau in NEWTONS]  # any fibres do nearly the same
    fibres = fibres_tried(len(facts.low), OTHERS)
    thin = [RateDependence(facts, tau, THIN, *some) for tau in THINS for some in fibres]
    return [*newton, *thin]


# A wall has one fluid; several of both signs together would be a lead.
HYPOTHESIS = Hypothesis(
    RateDependence,
    _grid,
    combinations=no_combinations,
    needs_motion=True,
    like_a_line=True,
    memory="time",
)
