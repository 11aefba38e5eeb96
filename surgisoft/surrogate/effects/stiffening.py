"""Stiffening effect: the wall resists more, the farther it is strained.

The share of push that is lost grows with the load u of each wall fibre and with the bending of the
arm, after Fung's exponential (Fung 1967), whose first term is the cubic spring:

    x_eff = x - own A' (u h(u^2)) / |A| - bend x h(B^2),   u = A x / |A|,
    h(q) = (exp(k q) - 1) / (exp(k) - 1),
    B^2 = sum_i (x_i - mean x)^2 m / (m - 1),

with B = 1 where one chamber alone is fully loaded; of four chambers, which stand in a ring, opposed
ones bend nothing, and B^2 = (x_1 - x_3)^2 + (x_2 - x_4)^2. A mixes the
chambers' loads into those of wall fibres (`fibre_matrix`): a chamber that bends the arm shortens
the wall on the other side.

In a symmetric section bending and stretch are apart, and each has a nonlinear law of its own (the
moment-curvature law of a nonlinear beam, Antman 2005, ch. 4): with b the bending and e the stretch
by the loads (`bend_and_stretch`),

    x_eff = x - own e h(e^2) - bend b h(B^2).
"""

import torch
from torch import Tensor, nn

from surgisoft.surrogate.effects.base import (
    ArmFacts,
    Effect,
    Memoryless,
    Quantity,
    amplitude,
    logarithm,
    value_of,
)
from surgisoft.surrogate.effects.hypothesis import Hypothesis
from surgisoft.surrogate.effects.readings import Reading
from surgisoft.surrogate.effects.wall_fibres import WallFibres, bend_and_stretch, walls_tried

GRID = (0.1, 2.0, 5.0)
"""Steepnesses k that identification tries: nearly cubic, and exponential."""
OTHERS = -0.35
"""Share of the other chambers in a wall fibre's load that identification tries."""


class Stiffening(WallFibres, Memoryless):
    """Progressive loss of push, equal for all chambers."""

    stage = "material"

    def __init__(
        self,
        facts: ArmFacts,
        steepness: float = 1.0,
        others: float = 0.0,
        ring: bool = False,
        section: bool = False,
    ):
        """steepness: k of the exponential; towards 0 a cubic spring.

        others, ring: the mixture of the wall fibres' loads (`fibre_matrix`); section: bending and
        stretch of the section in their place.
        """
        super().__init__(facts)
        self.own = amplitude(1)
        self.bend = amplitude(1)
        self.log_steepness = logarithm(steepness)
        self.set_fibres(others, ring, section)

    def amplitudes(self) -> dict[str, nn.Parameter]:
        """`own` (1,) by each fibre's load, or the stretch, and `bend` (1,) by the arm's bending."""
        return {"own": self.own, "bend": self.bend}

    def _lost(self, signal: Tensor) -> tuple[Tensor, Tensor]:
        """Two (..., m) shifts of the actuation at amplitude one: `own` and `bend`."""
        x, k = self.load(signal), self.log_steepness.exp()
        bend, size, stretch = bend_and_stretch(x)

        def lost(load: Tensor, q: Tensor) -> Tensor:
            # A recording beyond the fitted range must not blow up.
            return -load * torch.expm1(k * q.clamp(max=4.0)) / torch.expm1(k)

        if self.section:
            own = lost(stretch, stretch.square()).expand_as(x)
            return self.reach * own, self.reach * lost(bend, size)
        fibres = self.fibres
        u = x @ fibres.T
        own = lost(u, u.square()) @ fibres
        return self.reach * own, self.reach * lost(x, size)

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Effective actuation (..., m) from actuation (..., m)."""
        own, bend = self._lost(signal)
        return signal + self.own * own + self.bend * bend

    def sensitivities(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(2, ..., m) change of the actuation by each amplitude: closed form."""
        return torch.stack(self._lost(signal)).detach()

    def config(self) -> dict:
        """Whether the fibres stand in a ring, or bending and stretch are in their place."""
        return {**super().config(), "section": self.section}

    def quantities(self) -> list[Quantity]:
        """Shares of push lost at full load, the steepness and the fibres' mixture."""
        rubber = "wide: a rest of the push is left"
        total = float((self.own + self.bend).detach())
        own = "stretch_share" if self.section else "own_share"
        quantities = [
            Quantity(own, value_of(self.own), "", -0.5, 0.9, rubber),
            Quantity("bend_share", value_of(self.bend), "", -0.5, 0.9, rubber),
            Quantity(
                "total_share",
                total,
                "",
                0.0,
                0.9,
                "a wall that stiffens takes push and leaves some",
            ),
            Quantity("steepness", value_of(self.log_steepness.exp()), "", 0.005, 12.0, rubber),
        ]
        return [*quantities, *self.mixture()]

    def readings(self, seconds: float | None = None) -> list[Reading]:
        """Push that is lost at full load, of one chamber alone and of all chambers at once, %."""
        with torch.no_grad():
            full = torch.diag(self.reach)
            full = torch.cat([full, self.reach.unsqueeze(0)])
            bent = self.apply(self.origin + full, full.new_zeros(len(full), 0)) - self.origin
            lost = 100 * (1 - bent / self.reach)
        alone, together = float(lost[:-1].diagonal().mean()), float(lost[-1].mean())
        texts = (
            (
                "at full load one chamber alone loses {} of its push",
                "at full load one chamber alone gains {} of push",
            ),
            ("all chambers at once lose {}", "all chambers at once gain {}"),
        )
        values = (alone, together) if len(full) > 2 else (alone,)
        return [
            Reading(text, value, "%", value, signed=True, instead=more)
            for (text, more), value in zip(texts, values, strict=False)
        ]


def _grid(facts: ArmFacts, points: Tensor) -> list[Effect]:
    walls = walls_tried(len(facts.low), OTHERS)
    return [Stiffening(facts, steepness, *some) for steepness in GRID for some in walls]


HYPOTHESIS = Hypothesis(Stiffening, _grid)
