"""Softening effect: the wall is softer once it has carried a load (Mullins 1969).

*Below the largest load only.* The form is that of pseudo-elasticity (Ogden & Roxburgh 1999), with
the energy W ~ u^2 of a wall fibre's load, its largest value so far W_max, and an exponential
instead of the error function:

    x_eff = x + own A' (u d(W, W_max)) / |A| + common x d(V, V_max),   u = A x / |A|,
    d(W, W_max) = 1 - exp(-(W_max - W) / (width + growth W_max)),
    W_i = u_i^2,   V = sum_i x_i^2 / m.

A mixes the chambers' loads into those of wall fibres (`fibre_matrix`): a chamber that bends the arm
shortens the wall on the other side. On a first loading W = W_max and nothing changes.

*Damage* (Kachanov 1958; Simo 1987) depends on the largest energy alone: the wall is softer at that
load, too. In the place of d stands a function that rises from 0 to 1,

    r(W_max) = 1 - (1 + W_max / width)^(-1/2).

*Of the section.* In a symmetric section bending and stretch are apart (`stiffening`): with b the
bending, e the stretch by the loads (`bend_and_stretch`) and their energies B^2 and e^2,

    x_eff = x + own b d(B^2, B^2_max) + common e d(e^2, e^2_max).

*Of the body.* A softer wall gives way to all that bends it, weight included, and not to the
chambers alone. So each node of the body bends and stretches more (`bent_body`), by its own largest
strain: with b_k the bending at the node k beyond that at rest, e_k the stretch, and u(p) the sag of
the body by its own weight (`payload`) where gravity is known,

    b_k -> b_k (1 + own d_k),    e_k -> e_k (1 + common d_k),    q = p + sag mean_k d_k u(p).

d_k is r(W_max), or r(W_max) - r(W) below the largest strain only; W is the square of b_k and that
of e_k, each for itself, or the sum of both, in rad^2 over the whole length.
"""

import torch
from torch import Tensor, nn

from surgisoft.surrogate.effects.base import (
    ArmFacts,
    Context,
    Effect,
    Quantity,
    Stage,
    amplitude,
    logarithm,
    value_of,
)
from surgisoft.surrogate.effects.bent_body import most_strained
from surgisoft.surrogate.effects.hypothesis import Hypothesis, no_combinations
from surgisoft.surrogate.effects.readings import Reading
from surgisoft.surrogate.effects.wall_fibres import WallFibres, bend_and_stretch, walls_tried

GRID = ((0.05, 0.02), (0.2, 0.02), (0.8, 0.02), (0.02, 0.2), (0.02, 0.7))
"""Widths that identification tries, in units of the energy at full load, and their growths."""
DAMAGE_GRID = (0.1, 1.0)
"""Widths of damage that identification tries, in units of the energy at full load."""
BODY_GRID = ((0.05, True), (1.0, True), (0.01, False), (0.1, False))
"""Widths that identification tries of the body, in units of the energy of a body that is much
strained, and whether the wall is damaged: a softening below the largest strain is over within a
small part of it."""
OTHERS = -0.35
"""Share of the other chambers in a wall fibre's load that identification tries."""


class Softening(WallFibres):
    """Softening by the largest load of a chamber and of all of them, or by the largest strain."""

    log_growth: nn.Parameter
    """Logarithm of the growth; None with damage and of the body."""
    stage: Stage = "material"

    def __init__(
        self,
        facts: ArmFacts,
        width: float = 0.2,
        growth: float = 0.02,
        others: float = 0.0,
        ring: bool = False,
        section: bool = False,
        damage: bool = False,
        body: str | None = None,
        weight: bool = False,
    ):
        """Choose the range of energy over which the wall softens, and the fibres.

        width: energy over which the wall softens, in units of that at full load, of the body in
        rad^2; growth: share of the largest energy that is added to the width; others, ring: the
        mixture of the wall fibres' loads (`fibre_matrix`); section: bending and stretch in their
        place; damage: whether the wall is softer at the largest load, too; body: one of ENERGIES,
        for the strains of the body in place of loads; weight: whether the softer body also sags by
        its own weight, whose direction must then be known.
        """
        super().__init__(facts)
        self.damage = bool(damage)
        self.own = amplitude(1)
        self.common = amplitude(1)
        self.log_width = logarithm(width)
        spread = None if damage or body else logarithm(growth)
        self.register_parameter("log_growth", spread)
        self.set_fibres(others, ring, section, body, weight)

    def amplitudes(self) -> dict[str, nn.Parameter]:
        """`own` (1,) by each fibre's load and `common` (1,) by all chambers' loads; of a section
        or the body by its bending and its stretch; `sag` (1,) of the body by its weight, mm."""
        return {"own": self.own, "common": self.common, **self.sag_amplitude()}

    def memory_parameters(self) -> list[nn.Parameter]:
        """The fibres' mixture."""
        return [] if self.others is None else [self.others]

    def energy(self, signal: Tensor) -> Tensor:
        """Energies that the wall remembers.

        (..., K + 1) of each fibre and the chambers' mean, from actuation (..., m); of a section
        (..., 2) that of its bending and that of its stretch; of the body (..., K, 2) the same of
        its nodes, from key points (..., n, 3), mm.
        """
        if self.body is not None:
            return self.bent.strained(signal, self.body)
        load = self.load(signal)
        if self.section:
            _, size, stretch = bend_and_stretch(load)
            return torch.cat([size, stretch.square()], dim=-1)
        own, mean = (load @ self.fibres.T).square(), load.square().mean(-1, keepdim=True)
        return torch.cat([own, mean], dim=-1)

    def rest(self, signal: Tensor) -> Tensor:
        """(B, ...) largest energies of an arm that has only seen the signal (B, ...)."""
        return self.energy(signal)

    def advance(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(B, ...) largest energies after the signal (B, ...)."""
        return torch.maximum(memory, self.energy(signal))

    def scan(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(R, T, ...) largest energies along the signal (R, T, ...)."""
        return torch.maximum(self.energy(signal).cummax(dim=1).values, memory.unsqueeze(1))

    def _lost(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Share of the stiffness that is lost at amplitude one, in the shape of the memory."""
        width = self.log_width.exp()

        def damaged(energy: Tensor) -> Tensor:
            return 1 - (1 + energy / width).rsqrt()

        if self.damage:
            return damaged(memory)
        if self.body is not None:
            return damaged(memory) - damaged(self.energy(signal))
        below = (memory - self.energy(signal)).clamp(min=0)
        return -torch.expm1(-below / (width + self.log_growth.exp() * memory))

    def _softened(self, signal: Tensor, memory: Tensor) -> tuple[Tensor, ...]:
        """Changes of the signal, in its shape, at each amplitude of one."""
        lost = self._lost(signal, memory)
        if self.body is not None:
            return self.body_changes(signal, lost)
        load = self.load(signal)
        if self.section:
            bend, _, stretch = bend_and_stretch(load)
            common = (stretch * lost[..., -1:]).expand_as(load)
            return self.reach * bend * lost[..., :-1], self.reach * common
        fibres = self.fibres
        own = ((load @ fibres.T) * lost[..., :-1]) @ fibres
        return self.reach * own, self.reach * load * lost[..., -1:]

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Signal behind the effect, in its shape, from largest energies (..., ...)."""
        return self.with_changes(signal, self._softened(signal, memory))

    def sensitivities(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(2, ...), with a weight (3, ...), change of the signal by each amplitude: closed form."""
        with torch.no_grad():
            return torch.stack(self._softened(signal, memory))

    def config(self) -> dict:
        """The fibres or what stands in their place, and whether the wall is damaged."""
        forms = ("section", "damage", "body", "weight")
        return {**super().config(), **{form: getattr(self, form) for form in forms}}

    def quantities(self) -> list[Quantity]:
        """Shares of push or strain that softening adds, its energy range, the fibres' mixture."""
        if self.body is not None:
            return self._of_body()
        rubber = "wide: at most twice the push; a wall does not heal by load (Mullins 1969)"
        if self.section:  # each share is that of a strain of its own
            quantities = [
                Quantity("bend_share", value_of(self.own), "", -0.1, 1.0, rubber),
                Quantity("stretch_share", value_of(self.common), "", -0.1, 1.0, rubber),
            ]
        else:
            total = float((self.own + self.common).detach())
            quantities = [
                Quantity("own_share", value_of(self.own), "", -0.5, 1.0, rubber),
                Quantity("common_share", value_of(self.common), "", -0.5, 1.0, rubber),
                Quantity("total_share", total, "", 0.0, 1.0, rubber),
            ]
        width = Quantity("width_share", value_of(self.log_width.exp()), "", 0.001, 5.0, rubber)
        quantities.append(width)
        if not self.damage:
            growth = value_of(self.log_growth.exp())
            quantities.append(Quantity("growth_share", growth, "", 1e-4, 5.0, rubber))
        return [*quantities, *self.mixture()]

    def _of_body(self) -> list[Quantity]:
        """Quantities of a body that softens."""
        wall = "wide: at most three quarters of the stiffness; a wall does not heal by load"
        angle = value_of((0.5 * self.log_width).exp())
        return [
            Quantity("bend_share", value_of(self.own), "", 0.0, 3.0, wall),
            Quantity("stretch_share", value_of(self.common), "", -0.1, 3.0, wall),
            Quantity("width_rad", angle, "rad", 1e-3, 20.0, "far below and above what arms bend"),
            *self.sag_quantity(),
        ]

    def readings(self, seconds: float | None = None) -> list[Reading]:
        """Change of a chamber's push at half load after a full load, %; of the body the largest
        loss of stiffness in bending and in stretch, %."""
        if self.body is not None:
            own, common = (100 * float(each.detach()) for each in (self.own, self.common))
            where = "where it was {} most, the body {} more by up to {{}}"
            readings = [
                Reading(where.format("bent", "bends"), own, "%", own),
                Reading(where.format("stretched", "stretches"), common, "%", common),
            ]
            if self.weight:
                text = "as soft everywhere, held straight and level, it would sag {} more"
                readings.append(Reading(text, float(self.sag.detach()), "mm"))
            return readings
        with torch.no_grad():
            full = torch.diag(self.reach)
            half = self.origin + 0.5 * full
            after = self.apply(half, self.energy(self.origin + full)) - half
            more = 100 * float((after / (0.5 * self.reach)).diagonal().mean())
        text = "push of a chamber at half load after a full one {+}"
        return [Reading(text, more, "%", signed=True)]


def _grid(facts: ArmFacts, points: Tensor) -> list[Effect]:
    walls = walls_tried(len(facts.low), OTHERS)
    below = [Softening(facts, width, growth, *one) for width, growth in GRID for one in walls]
    damage = [
        Softening(facts, width, 0.0, *one, damage=True) for width in DAMAGE_GRID for one in walls
    ]
    return [*below, *damage, *_of_body(facts, points)]


def _of_body(facts: ArmFacts, points: Tensor) -> list[Effect]:
    """Softening by the strains of the body; none of a body at rest."""
    return [
        Softening(facts, width * hard, damage=damage, body=body, weight=weight)
        for body, hard in most_strained(facts.rest_mm, points)
        for width, damage in BODY_GRID
        for weight in ((False, True) if facts.gravity is not None else (False,))
    ]


HYPOTHESIS = Hypothesis(Softening, _grid, combinations=no_combinations)
