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

*Of the body.* A stiffer wall resists all that bends it, weight included, and not the chambers
alone. So each node of the body bends and stretches less (`bent_body`), by its own strain: with b_k
the bending at the node k beyond that at rest, e_k the stretch, W the square of b_k and that of e_k,
each for itself, or the sum of both, and u(p) the sag of the body by its own weight (`payload`)
where gravity is known,

    b_k -> b_k (1 - bend h(W / full)),    e_k -> e_k (1 - own h(W / full)),
    q = p - sag mean_k h(W / full) u(p).

`full` is the energy of the most strained node where the arm is much strained, one for bending and
one for stretch, so that amplitudes are losses there. Beyond it, and beyond the energy at full load,
h continues along its tangent: predictions beyond the range of the fit must not blow up.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from surgisoft.surrogate.effects.base import (
    ArmFacts,
    Effect,
    Memoryless,
    Quantity,
    Stage,
    amplitude,
    logarithm,
    value_of,
)
from surgisoft.surrogate.effects.bent_body import SLENDERNESS, hardest_strained
from surgisoft.surrogate.effects.hypothesis import Hypothesis, no_combinations
from surgisoft.surrogate.effects.readings import Reading
from surgisoft.surrogate.effects.wall_fibres import WallFibres, bend_and_stretch, walls_tried

GRID = (0.1, 2.0, 5.0)
"""Steepnesses k that identification tries: nearly cubic, and exponential."""
BODY_GRID = (0.1, 3.0)
"""Steepnesses that identification tries of the body."""
OTHERS = -0.35
"""Share of the other chambers in a wall fibre's load that identification tries."""


class Stiffening(WallFibres, Memoryless):
    """Progressive loss of push, equal for all chambers, or of strain along the body."""

    stage: Stage = "material"
    energy_at_full: Tensor

    def __init__(
        self,
        facts: ArmFacts,
        steepness: float = 1.0,
        others: float = 0.0,
        ring: bool = False,
        section: bool = False,
        body: str | None = None,
        full: float | Sequence[float] = 1.0,
        weight: bool = False,
    ):
        """steepness: k of the exponential; towards 0 a cubic spring.

        others, ring: the mixture of the wall fibres' loads (`fibre_matrix`); section: bending and
        stretch of the section in their place; body: one of ENERGIES, for the strains of the body in
        place of loads; full: energies of the body, of bending and of stretch, at which it loses the
        shares that the amplitudes say, rad^2 (a number: the same for both); weight: whether the
        body also sags less by its own weight, whose direction must then be known.
        """
        super().__init__(facts)
        both = (full, full) if isinstance(full, (int, float)) else full
        self.full = tuple(float(each) for each in both)
        self.register_buffer("energy_at_full", torch.tensor(self.full), persistent=False)
        self.own = amplitude(1)
        self.bend = amplitude(1)
        self.log_steepness = logarithm(steepness)
        self.set_fibres(others, ring, section, body, weight)

    def amplitudes(self) -> dict[str, nn.Parameter]:
        """`own` (1,) by each fibre's load, or the stretch, and `bend` (1,) by the arm's bending;
        `sag` (1,) of the body by its weight, mm."""
        return {"own": self.own, "bend": self.bend, **self.sag_amplitude()}

    def _share(self, energy: Tensor) -> Tensor:
        """Share of the loss at full load, at an energy over that at full load."""
        k = self.log_steepness.exp()
        inside = torch.expm1(k * energy.clamp(max=1.0)) / torch.expm1(k)
        return inside - k / torch.expm1(-k) * (energy - 1.0).clamp(min=0.0)

    def _lost(self, signal: Tensor) -> tuple[Tensor, ...]:
        """Changes of the signal, in its shape, at each amplitude of one."""
        if self.body is not None:
            less = -self._share(self.bent.strained(signal, self.body) / self.energy_at_full)
            by_bend, by_stretch, *by_sag = self.body_changes(signal, less)
            return by_stretch, by_bend, *by_sag
        x = self.load(signal)
        bend, size, stretch = bend_and_stretch(x)

        def lost(load: Tensor, q: Tensor) -> Tensor:
            return -load * self._share(q)

        if self.section:
            own = lost(stretch, stretch.square()).expand_as(x)
            return self.reach * own, self.reach * lost(bend, size)
        fibres = self.fibres
        u = x @ fibres.T
        own = lost(u, u.square()) @ fibres
        return self.reach * own, self.reach * lost(x, size)

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """The signal behind the effect, in its shape."""
        return self.with_changes(signal, self._lost(signal))

    def sensitivities(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(2, ...), with a weight (3, ...), change of the signal by each amplitude: closed form."""
        with torch.no_grad():
            return torch.stack(self._lost(signal))

    def config(self) -> dict:
        """The fibres, or what stands in their place."""
        forms = ("section", "body", "full", "weight")
        return {**super().config(), **{form: getattr(self, form) for form in forms}}

    def quantities(self) -> list[Quantity]:
        """Shares of push lost at full load, the steepness and the fibres' mixture."""
        rubber = "wide: a rest of the push is left"
        wall = "a wall that stiffens takes push and leaves some"
        steepness = Quantity(
            "steepness", value_of(self.log_steepness.exp()), "", 0.005, 12.0, rubber
        )
        if self.others is None:  # each share is that of a strain of its own
            shares = [
                Quantity("stretch_share", value_of(self.own), "", -0.1, 0.9, wall),
                Quantity("bend_share", value_of(self.bend), "", -0.1, 0.9, wall),
            ]
            return [*shares, steepness, *self.sag_quantity()]
        total = float((self.own + self.bend).detach())
        return [
            Quantity("own_share", value_of(self.own), "", -0.5, 0.9, rubber),
            Quantity("bend_share", value_of(self.bend), "", -0.5, 0.9, rubber),
            Quantity("total_share", total, "", 0.0, 0.9, wall),
            steepness,
            *self.mixture(),
        ]

    def readings(self, seconds: float | None = None) -> list[Reading]:
        """Push that is lost at full load, of one chamber alone and of all chambers at once, %; of
        the body what it bends and stretches less, %, and sags less, mm."""
        if self.body is not None:
            bend, own = (100 * float(each.detach()) for each in (self.bend, self.own))
            angle, length = map(math.sqrt, self.full)
            most = f"{math.degrees(angle):.0f} degrees", f"{100 * length / SLENDERNESS:.2g} %"
            readings = [
                Reading(
                    f"bent by {most[0]} from base to tip, the body bends {{}} less", bend, "%", bend
                ),
                Reading(f"stretched by {most[1]}, it stretches {{}} less", own, "%", own),
            ]
            if self.weight:
                text = "as stiff everywhere, held straight and level, it would sag {} less"
                readings.append(Reading(text, float(self.sag.detach()), "mm"))
            return readings
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
    of_loads = [Stiffening(facts, steepness, *some) for steepness in GRID for some in walls]
    return [*of_loads, *_of_body(facts, points)]


def _of_body(facts: ArmFacts, points: Tensor) -> list[Effect]:
    """Stiffening by the strains of the body; none of a body at rest."""
    return [
        Stiffening(facts, steepness, body=body, full=full, weight=weight)
        for body, full in hardest_strained(facts.rest_mm, points)
        for steepness in BODY_GRID
        for weight in ((False, True) if facts.gravity is not None else (False,))
    ]


HYPOTHESIS = Hypothesis(Stiffening, _grid, combinations=no_combinations)
