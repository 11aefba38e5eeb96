"""Softening effect: the wall is softer below the largest load that it has carried (Mullins 1969).

The form is that of pseudo-elasticity (Ogden & Roxburgh 1999), with the energy W ~ u^2 of a wall
fibre's load, its largest value so far W_max, and an exponential instead of the error function:

    x_eff = x + own A' (u d(W, W_max)) / |A| + common x d(V, V_max),   u = A x / |A|,
    d(W, W_max) = 1 - exp(-(W_max - W) / (width + growth W_max)),
    W_i = u_i^2,   V = sum_i x_i^2 / m.

A mixes the chambers' loads into those of wall fibres (`fibre_matrix`): a chamber that bends the arm
shortens the wall on the other side. On a first loading W = W_max and nothing changes.

In a symmetric section bending and stretch are apart (`stiffening`): with b the bending, e the
stretch by the loads (`bend_and_stretch`) and their energies B^2 and e^2,

    x_eff = x + own b d(B^2, B^2_max) + common e d(e^2, e^2_max).
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
from surgisoft.surrogate.effects.hypothesis import Hypothesis
from surgisoft.surrogate.effects.readings import Reading
from surgisoft.surrogate.effects.wall_fibres import WallFibres, bend_and_stretch, walls_tried

GRID = ((0.05, 0.02), (0.2, 0.02), (0.8, 0.02), (0.02, 0.2), (0.02, 0.7))
"""Widths that identification tries, in units of the energy at full load, and their growths."""
OTHERS = -0.35
"""Share of the other chambers in a wall fibre's load that identification tries."""


class Softening(WallFibres):
    """Mullins softening by the largest load of a chamber and of all of them."""

    stage = "material"

    def __init__(
        self,
        facts: ArmFacts,
        width: float = 0.2,
        growth: float = 0.02,
        others: float = 0.0,
        ring: bool = False,
        section: bool = False,
    ):
        """Choose the range of energy over which the wall softens, and the fibres.

        width: drop of the energy over which the wall softens, in units of the energy at full load;
        growth: share of the largest energy that is added to the width; others, ring: the mixture of
        the wall fibres' loads (`fibre_matrix`); section: bending and stretch in their place.
        """
        super().__init__(facts)
        self.own = amplitude(1)
        self.common = amplitude(1)
        self.log_width = logarithm(width)
        self.log_growth = logarithm(growth)
        self.set_fibres(others, ring, section)

    def amplitudes(self) -> dict[str, nn.Parameter]:
        """`own` (1,) by each fibre's load and `common` (1,) by all chambers' loads; of a section by
        its bending and its stretch."""
        return {"own": self.own, "common": self.common}

    def memory_parameters(self) -> list[nn.Parameter]:
        """The fibres' mixture."""
        return [] if self.section else [self.others]

    def energy(self, signal: Tensor) -> Tensor:
        """(..., K + 1) energy of each fibre and the chambers' mean, from actuation (..., m); of a
        section (..., 2) that of its bending and that of its stretch."""
        load = self.load(signal)
        if self.section:
            _, size, stretch = bend_and_stretch(load)
            return torch.cat([size, stretch.square()], dim=-1)
        own, mean = (load @ self.fibres.T).square(), load.square().mean(-1, keepdim=True)
        return torch.cat([own, mean], dim=-1)

    def rest(self, signal: Tensor) -> Tensor:
        """(B, K + 1) largest energies of an arm that has only seen the actuation (B, m)."""
        return self.energy(signal)

    def advance(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(B, K + 1) largest energies after the actuation (B, m)."""
        return torch.maximum(memory, self.energy(signal))

    def scan(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(R, T, K + 1) largest energies along the actuation (R, T, m)."""
        return torch.maximum(self.energy(signal).cummax(dim=1).values, memory.unsqueeze(1))

    def _softened(self, signal: Tensor, memory: Tensor) -> tuple[Tensor, Tensor]:
        """Two (..., m) shifts of the actuation at amplitude one: `own` and `common`."""
        below = (memory - self.energy(signal)).clamp(min=0)
        damage = -torch.expm1(-below / (self.log_width.exp() + self.log_growth.exp() * memory))
        load = self.load(signal)
        if self.section:
            bend, _, stretch = bend_and_stretch(load)
            common = (stretch * damage[..., -1:]).expand_as(load)
            return self.reach * bend * damage[..., :-1], self.reach * common
        fibres = self.fibres
        own = ((load @ fibres.T) * damage[..., :-1]) @ fibres
        return self.reach * own, self.reach * load * damage[..., -1:]

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Effective actuation (..., m) from actuation (..., m) and largest energies."""
        own, common = self._softened(signal, memory)
        return signal + self.own * own + self.common * common

    def sensitivities(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(2, ..., m) change of the actuation by each amplitude: closed form."""
        return torch.stack(self._softened(signal, memory)).detach()

    def config(self) -> dict:
        """Whether the fibres stand in a ring, or bending and stretch are in their place."""
        return {**super().config(), "section": self.section}

    def quantities(self) -> list[Quantity]:
        """Shares of push that softening adds, its energy range and the fibres' mixture."""
        rubber = "wide: at most twice the push; a wall does not heal by load (Mullins 1969)"
        total = float((self.own + self.common).detach())
        own, common = ("bend", "stretch") if self.section else ("own", "common")
        quantities = [
            Quantity(f"{own}_share", value_of(self.own), "", -0.5, 1.0, rubber),
            Quantity(f"{common}_share", value_of(self.common), "", -0.5, 1.0, rubber),
            Quantity("total_share", total, "", 0.0, 1.0, rubber),
            Quantity("width_share", value_of(self.log_width.exp()), "", 0.001, 5.0, rubber),
            Quantity("growth_share", value_of(self.log_growth.exp()), "", 1e-4, 5.0, rubber),
        ]
        return [*quantities, *self.mixture()]

    def readings(self, seconds: float | None = None) -> list[Reading]:
        """Change of a chamber's push at half load after a full load, %."""
        with torch.no_grad():
            full = torch.diag(self.reach)
            half = self.origin + 0.5 * full
            after = self.apply(half, self.energy(self.origin + full)) - half
            more = 100 * float((after / (0.5 * self.reach)).diagonal().mean())
        text = "push of a chamber at half load after a full one {+}"
        return [Reading(text, more, "%", signed=True)]


def _grid(facts: ArmFacts, points: Tensor) -> list[Effect]:
    walls = walls_tried(len(facts.low), OTHERS)
    return [Softening(facts, width, growth, *one) for width, growth in GRID for one in walls]


HYPOTHESIS = Hypothesis(Softening, _grid)
