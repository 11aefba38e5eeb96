"""Hysteresis effect: play operators on mixtures of the chambers (Prandtl-Ishlinskii model).

A play operator of radius r follows its input through a gap of width 2r:
y(t) = clamp(y(t-), u(t) - r, u(t) + r) (Krasnosel'skii & Pokrovskii 1989, ch. 1). Many of them
remember every reversal that no larger one has wiped out. In a soft arm friction sits in the wall,
and several chambers at once move the strain of a wall fibre; therefore play operators run along
several lines l of the actuation space, as in a vector hysteron model (Mayergoyz 2003, ch. 3),

    u_l = sum_i a_li x_i + sum_ij b_lij x_i x_j,      x = actuation scaled to [-1, 1],

whose mixture a, b is fitted with the rest. Superposed (Kuhnen 2003, eq. 8) they give

    x_eff = x + sum_l sum_k (w_lk + v_lk (u_l - u_l(rest))) (y_lk - u_l),

where v lets a loop's width depend on where it lies. Backlash of a valve, a tendon or a joint of one
chamber is a sum of plays of the chamber's own actuation, x_eff_i = x_i + sum_k w_ik (y_ik - x_i).
With w = v = 0 nothing changes.

*Of the body.* Friction in the wall also holds back what weight and other chambers bend. So plays
run along the strains of each node of the body (`body_plays`), with the same weights at all nodes:

    b -> b + sum_k w_k (lag of b by the plays of radius r_k),    the same with v_k for the stretch.
"""

import math

import torch
from torch import Tensor, nn

from surgisoft.surrogate.arm import centre_and_half
from surgisoft.surrogate.effects.base import (
    ArmFacts,
    Context,
    Effect,
    Quantity,
    Stage,
    amplitude,
    value_of,
)
from surgisoft.surrogate.effects.bent_body import most_strained
from surgisoft.surrogate.effects.body_plays import BodyPlays
from surgisoft.surrogate.effects.hypothesis import Hypothesis
from surgisoft.surrogate.effects.readings import Reading
from surgisoft.surrogate.effects.wall_fibres import RINGS, fibre_matrix
from surgisoft.surrogate.scan import play_scan

RADII = (0.02, 0.04, 0.08, 0.14, 0.22, 0.32, 0.44, 0.58, 0.74, 0.90)
"""Radii of the play operators, in units of half a line's range: fine for small reversals, and up to
nearly the half range (an operator of a larger radius never moves)."""
OTHERS = (0.0, -0.2, -0.4)
"""Shares of the other chambers in a line that identification tries."""
SECTION = {3: -0.2, 4: 0.2}
"""Shares of the neighbours in the lines of a plane section: four fifths of a strain bend."""
FEW_RADII = (0.015, 0.04, 0.10, 0.22, 0.44, 0.74)
"""Radii for the test whether an arm has any hysteresis at all."""


class Hysteresis(Effect):
    """Rate-independent hysteresis with minor loops."""

    centre: Tensor
    half_range: Tensor
    origin: Tensor
    radius: Tensor
    use: Tensor
    turns: Tensor
    plays: BodyPlays
    stage: Stage = "material"

    def __init__(
        self,
        facts: ArmFacts,
        radii: tuple[float, ...] = RADII,
        ring: bool = False,
        pairs: bool = True,
        others: float = 0.0,
        section: bool = False,
        chamber: int | None = None,
        body_rad: float | None = None,
    ):
        """Radii of the play operators, in units of half a line's range.

        ring: the chambers are alike and stand in a ring, so that one chamber's weights, turned,
        are those of all; pairs: lines along pairs of neighbours beside those along one chamber;
        others: share of the other chambers in each line to start from, negative where a chamber
        that bends the arm shortens the wall on the other side; section: the lines, those along
        pairs too, are those of a plane section (`fibre_matrix`), others being that of a neighbour;
        chamber: the number of the only chamber that has plays, of its own actuation; body_rad: the
        bending over the whole arm that is the radius 1 of plays on the strains of the body, rad.
        With either of the last two the other choices do not matter.
        """
        super().__init__(facts)
        chambers = len(facts.low)
        self.radii, self.chamber = tuple(radii), chamber
        self.body_rad = None if body_rad is None else float(body_rad)
        several = chamber is None and body_rad is None
        self.ring, self.pairs = bool(ring) and several, bool(pairs) and several
        centre, half = centre_and_half(facts.low, facts.high)
        self.register_buffer("centre", centre)
        self.register_buffer("half_range", half)
        self.register_buffer("origin", facts.rest.clone())
        self.register_buffer("radius", torch.tensor(self.radii))
        self.register_buffer("use", torch.ones(chambers))
        self.others = float(others) if several else 0.0
        self.section = bool(section) and several
        if self.body_rad is not None:
            self.stage = "body"
            self.bend, self.stretch = amplitude(len(self.radii)), amplitude(len(self.radii))
            self.plays = BodyPlays(facts.rest_mm, self.body_rad)
            return
        lines = first_lines(chambers)
        if not self.pairs:
            lines = lines[:chambers]
        if self.section:
            lines = fibre_matrix(torch.tensor(self.others), chambers, ring=True)
            lines = torch.cat([lines[::2], lines[1::2].roll(1, dims=0)])
            lines = lines / lines.abs().sum(1, keepdim=True)
        elif self.others:
            lines = lines + self.others * (lines.sum(1, keepdim=True) - lines)
            lines = lines / lines.abs().sum(1, keepdim=True)
        bent = lines.new_zeros(len(lines), chambers, chambers)
        if chamber is not None:  # along its own actuation alone: no mixture to fit
            self.register_buffer("linear", lines)
            self.register_buffer("bent", bent)
        else:
            self.linear, self.bent = nn.Parameter(lines), nn.Parameter(bent)
        if chamber is not None:
            self.own = nn.Parameter(torch.zeros(len(self.radii)))
        elif self.ring:
            self.turned = nn.Parameter(torch.zeros(len(lines), len(self.radii)))
            self.register_buffer("turns", turns(chambers, len(lines)), persistent=False)
        else:
            shape = (chambers, len(lines), len(self.radii))
            self.weight = nn.Parameter(torch.zeros(shape))
            self.slope = nn.Parameter(torch.zeros(shape))

    def amplitudes(self) -> dict[str, nn.Parameter]:
        """`weight` and `slope` (m, L, J); of alike chambers in a ring `turned` (L, J); of one
        chamber `own` (J,); of the body `bend` and `stretch` (J,)."""
        if self.body_rad is not None:
            return {"bend": self.bend, "stretch": self.stretch}
        if self.chamber is not None:
            return {"own": self.own}
        if self.ring:
            return {"turned": self.turned}
        return {"weight": self.weight, "slope": self.slope}

    @property
    def follows(self) -> bool:
        """True: a wall, of loads or of the body."""
        return True

    def use_chambers(self, use: Tensor) -> None:
        """Exclude chambers (m,) with 0 from every line."""
        self.use.copy_(use)

    def lines(self, signal: Tensor) -> Tensor:
        """(..., L) inputs u of the lines' play operators from the actuation (..., m)."""
        x = (signal - self.centre) / self.half_range * self.use
        products = (x.unsqueeze(-1) * x.unsqueeze(-2)).flatten(-2)
        return x @ self.linear.T + products @ self.bent.flatten(1).T

    def memory_parameters(self) -> list[nn.Parameter]:
        """The lines' mixtures a (L, m) and b (L, m, m); none of one chamber and of the body."""
        several = self.chamber is None and self.body_rad is None
        return [self.linear, self.bent] if several else []

    def inputs(self, signal: Tensor) -> Tensor:
        """Inputs of the play operators: (..., L) from the actuation (..., m); of the body
        (..., K, 7) from its key points (..., n, 3), mm."""
        return self.lines(signal) if self.body_rad is None else self.plays.inputs(signal)

    @property
    def weights(self) -> Tensor:
        """(m, L, J) weight w of each play operator in each chamber."""
        if self.chamber is not None:
            chambers = len(self.use)
            there = torch.zeros(chambers, chambers, 1, dtype=self.own.dtype, device=self.own.device)
            there[self.chamber, self.chamber] = 1.0
            return there * self.own
        return self.turned[self.turns] if self.ring else self.weight

    @property
    def slopes(self) -> Tensor | None:
        """(m, L, J) their change v with the line's input; None where the form has none."""
        return None if self.ring or self.chamber is not None else self.slope

    def rest(self, signal: Tensor) -> Tensor:
        """(B, ..., J) play operators centred on their inputs at the signal (B, ...): no history."""
        u = self.inputs(signal)
        return u[..., None].expand(*u.shape, len(self.radii))

    def advance(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(B, ..., J) play operators after the signal (B, ...); time does not matter."""
        return self._follow(memory, self.inputs(signal))

    def step(self, memory: Tensor, signal: Tensor, context: Context) -> tuple[Tensor, Tensor]:
        """Play operators and the signal behind the effect after the signal (B, ...)."""
        u = self.inputs(signal)
        memory = self._follow(memory, u)
        return memory, self._superpose(signal, u, memory)

    def _follow(self, memory: Tensor, u: Tensor) -> Tensor:
        u = u.unsqueeze(-1)
        return torch.clamp(memory, u - self.radius, u + self.radius)

    def scan(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(R, T, ..., J) play operators along the signal (R, T, ...), from (R, ..., J) before."""
        u = self.inputs(signal).unsqueeze(-1)
        return play_scan(u.expand(*u.shape[:-1], len(self.radii)), self.radius, memory)

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Signal behind the effect, in its shape, from play operators (..., J)."""
        return self._superpose(signal, self.inputs(signal), memory)

    def _superpose(self, signal: Tensor, u: Tensor, memory: Tensor) -> Tensor:
        lag = memory - u.unsqueeze(-1)
        if self.body_rad is not None:
            bend, stretch = lag[..., :-1, :] @ self.bend, lag[..., -1, :] @ self.stretch
            by_bend, by_stretch = self.plays.moved(signal, bend, stretch)
            return signal + by_bend + by_stretch
        slopes = self.slopes
        shift = lag.flatten(-2) @ self.weights.flatten(1).T
        if slopes is not None:
            away = (u - self.lines(self.origin)).unsqueeze(-1)
            shift = shift + (lag * away).flatten(-2) @ slopes.flatten(1).T
        return signal + self.half_range * shift

    def sensitivities(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(K, ...) change of the signal by each weight: closed form."""
        with torch.no_grad():
            u = self.inputs(signal)
            lag = memory - u.unsqueeze(-1)
            if self.body_rad is not None:
                pairs = [
                    self.plays.moved(signal, each[..., :-1], each[..., -1])
                    for each in lag.unbind(-1)
                ]
                return torch.stack([moved for some in zip(*pairs, strict=True) for moved in some])
            if self.chamber is not None:
                each = lag[..., self.chamber, :, None] * self.half_range
                mine = torch.arange(len(self.use), device=lag.device) == self.chamber
                return torch.where(mine, each, 0.0).movedim(-2, 0)
            if self.ring:
                # (m, L) the line that is to each chamber what line l is to the first.
                seen = lag[..., self.turns.argsort(1), :] * self.half_range[:, None, None]
                return seen.movedim((-2, -1), (0, 1)).flatten(0, 1)
            sloped = lag * (u - self.lines(self.origin)).unsqueeze(-1)
            spread = torch.diag(self.half_range)
            moved = [torch.einsum("ci,...q->cq...i", spread, x.flatten(-2)) for x in (lag, sloped)]
            return torch.cat([x.flatten(0, 1) for x in moved])

    def config(self) -> dict:
        """Radii and the choice of lines."""
        return {
            "radii": list(self.radii),
            "ring": self.ring,
            "pairs": self.pairs,
            "others": self.others,
            "section": self.section,
            "chamber": self.chamber,
            "body_rad": self.body_rad,
        }

    def quantities(self) -> list[Quantity]:
        """Half loop widths in the arm's unit, the lines' shares and the radii; of the body half
        loop widths as shares of the bending that is the radius 1."""
        radii = Quantity(
            "radius_share", list(self.radii), "", 0.0, 1.0, "Krasnosel'skii 1989, ch. 1"
        )
        if self.body_rad is not None:
            wide = "wide: a loop as wide as the range"
            loops = [(each.detach() * self.radius).sum() for each in (self.bend, self.stretch)]
            return [
                *(
                    Quantity(f"half_loop_{name}", value_of(loop), "", -1.0, 1.0, wide)
                    for name, loop in zip(("bend", "stretch"), loops, strict=True)
                ),
                radii,
            ]
        weight = self.weights.detach()
        # A full sweep opens each play by its radius on both sides.
        opened = (weight * self.radius).sum(-1) * self.half_range[:, None]
        unit = self.facts.unit
        span = float(self.half_range.max())
        source = "wide: a loop as wide as the range"
        return [
            Quantity(f"half_loop_{unit}", value_of(opened), unit, -span, span, source),
            Quantity("line_share", value_of(self.linear), "", -3.0, 3.0, "a mixture of shares"),
            radii,
        ]

    def readings(self, seconds: float | None = None) -> list[Reading]:
        """Width of the loop of a chamber over its whole range, in the arm's unit: the mean of all
        that have one; of the body its loop in bending, %."""
        if self.body_rad is not None:
            loop = 100 * float(self.plays.loop(self.radius) @ self.bend.detach())
            angle = f"{math.degrees(self.body_rad / 2):.0f}"
            text = "loop of {} of the range between loading and unloading, where the body bends by "
            return [Reading(f"{text}{angle} degrees to either side", loop, "%")]
        unit, full = self.facts.unit, torch.diag(self.facts.high - self.facts.low)
        low, middle = self.facts.low.expand(full.shape), self.facts.low + 0.5 * full
        high = self.facts.low + full
        context = Context(dt_s=full.new_ones(len(full)))
        with torch.no_grad():
            memory = self.advance(self.rest(high), low, context)
            rising = self.advance(memory, middle, context)
            falling = self.advance(self.advance(rising, high, context), middle, context)
            wide = self.apply(middle, falling) - self.apply(middle, rising)
        if self.chamber is not None:
            text = f"loop of {{}} between loading and unloading of chamber {self.chamber + 1}"
            return [Reading(f"{text}, at half load", float(wide[self.chamber, self.chamber]), unit)]
        text = "loop of {} between loading and unloading, at half load of one chamber"
        return [Reading(text, float(wide.diagonal().mean()), unit)]


def turns(chambers: int, lines: int) -> Tensor:
    """(m, L) line of the first chamber that corresponds to each line of each chamber of a ring."""
    rows = []
    for chamber in range(chambers):
        row = [(line - chamber) % chambers for line in range(chambers)]
        pairs = lines - chambers
        row += [chambers + (pair - chamber) % pairs for pair in range(pairs)]
        rows.append(row)
    return torch.tensor(rows)


def first_lines(chambers: int) -> Tensor:
    """(L, m) lines to start from: each chamber, and each with its neighbour; |values| sum to 1."""
    single = torch.eye(chambers)
    if chambers == 1:
        return single
    pairs = (single + single.roll(1, dims=0)) / 2
    return torch.cat([single, pairs[: 1 if chambers == 2 else chambers]])


def _grid(facts: ArmFacts, points: Tensor) -> list[Effect]:
    """Candidates for alike chambers, whose lines differ in the share of the other chambers, and the
    body's."""
    if len(facts.low) == 1:
        return [Hysteresis(facts, FEW_RADII, ring=True, pairs=False), *_of_body(facts, points)]
    return [*_further(facts, points), Hysteresis(facts, FEW_RADII, True, True, OTHERS[1])]


def _further(facts: ArmFacts, points: Tensor) -> list[Effect]:
    """Lines along single chambers, of a plane section, or of the body: loops add up (Kuhnen 2003).

    Where there are not three chambers in a ring, one alone may have loops: a tendon of four, a
    chamber of two sections.
    """
    m, body = len(facts.low), _of_body(facts, points)
    if m == 1:
        return [Hysteresis(facts, FEW_RADII, True, False), *body]
    shares = OTHERS[::2] if m in RINGS else OTHERS
    alike: list[Effect] = [Hysteresis(facts, FEW_RADII, True, False, others) for others in shares]
    if m in RINGS:
        alike.append(Hysteresis(facts, FEW_RADII, True, True, SECTION[m], True))
    if m == 3:
        return [*alike, *body]
    one = [Hysteresis(facts, FEW_RADII, chamber=chamber) for chamber in range(m)]
    return [*alike, *one, *body]


def _of_body(facts: ArmFacts, points: Tensor) -> list[Effect]:
    """Loops of the strains of the body; none of a body at rest."""
    hard = dict(most_strained(facts.rest_mm, points)).get("apart")
    if hard is None:
        return []
    return [Hysteresis(facts, FEW_RADII, body_rad=2 * math.sqrt(hard))]


def _together(some: list[Effect]) -> list[list[int]]:
    """All forms of alike chambers side by side; loops of one chamber and of the body stand
    alone."""
    alone = ("chamber", "body_rad")
    return [
        [i for i, each in enumerate(some) if all(getattr(each, w, None) is None for w in alone)]
    ]


HYPOTHESIS = Hypothesis(Hysteresis, _grid, _further, _together, needs_reversals=True, memory="path")
