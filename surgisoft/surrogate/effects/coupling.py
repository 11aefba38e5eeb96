"""Coupling effect: a chamber pushes less where another chamber is loaded.

A loaded neighbour bulges into the chamber and stretches the wall that they share; the loss is a
series in both loads, truncated after its second order:

    x_eff_i = x_i - sum_{j != i} (linear x_j + quadratic_ij x_j |x_j|),      x = load,

or, where other chambers reduce the push in proportion to it (all of them, or the next or the
previous one of chambers in a ring),

    x_eff_i = x_i - sum_{j != i} linear x_j - product x_i sum_{j in who} x_j,

or, where the wall between neighbours yields to the difference of their loads, so that the chamber
with the higher load gains the section that the other one loses (`beside`: all others in a ring of
three, the two next to it in a larger one),

    x_eff_i = x_i - sum_{j != i} linear x_j - yielded x_i sum_{j beside i} y(x_j - x_i),
    y(d) = d (d^2 + SMOOTH^2)^((power - 1) / 2).

A plate yields in proportion to the difference (power 1: Timoshenko & Woinowsky-Krieger 1959,
ch. 3), a wall whose own tension rises as it bulges less and less.
"""

import torch
from torch import Tensor, nn

from surgisoft.errors import unknown_name
from surgisoft.surrogate.effects.base import (
    ArmFacts,
    Effect,
    Memoryless,
    Quantity,
    amplitude,
    value_of,
)
from surgisoft.surrogate.effects.hypothesis import Hypothesis, no_combinations
from surgisoft.surrogate.effects.readings import Reading

WHO = ("all", "next", "previous")
"""Chambers that may reduce the push of one chamber in proportion to it."""
BESIDE = "beside"
"""Chambers behind a wall that yields to the difference of loads."""
POWERS = (1.0, 0.5)
"""Powers of the difference that identification tries: a plate, and a wall that is between a plate
and a membrane."""
SMOOTH = 0.05
"""Difference of loads below which a wall of any power yields in proportion [-]."""
SEGMENT = 3
"""Chambers in the ring of one segment, of arms whose number of chambers is a multiple of it."""


class Coupling(Memoryless):
    """Loss of push of each chamber by the loads of the other chambers."""

    spread: Tensor

    stage = "material"

    def __init__(
        self, facts: ArmFacts, pairs: bool = False, who: str | None = None, power: float = 1.0
    ):
        """Choose the form of the second-order loss.

        pairs: one quadratic amplitude for each pair of chambers, not one for all pairs; who: one of
        WHO, for a loss by the product of both loads in place of the quadratic one, or BESIDE, for
        one by the difference of the loads; power: that of this difference.
        """
        super().__init__(facts)
        self.power = float(power)
        if who is not None and who not in (*WHO, BESIDE):
            raise unknown_name("kind of chambers", who, (*WHO, BESIDE))
        m = len(facts.low)
        self.pairs, self.who = bool(pairs), who
        self.linear = amplitude(1)
        if who is None:
            self.quadratic = amplitude(m * (m - 1) if self.pairs else 1)
            place = (1 - torch.eye(m)).flatten().nonzero().flatten()
            spread = torch.nn.functional.one_hot(place, m * m).float().view(-1, m, m)
            spread = spread if self.pairs else spread.sum(0, keepdim=True)
        elif who == BESIDE:
            self.yielded = amplitude(1)
            spread = beside(m).unsqueeze(0)
        else:
            self.product = amplitude(1)
            spread = 1 - torch.eye(m) if who == "all" else _neighbour(m, who)
            spread = spread.unsqueeze(0)
        self.register_buffer("spread", spread, persistent=False)

    def amplitudes(self) -> dict[str, nn.Parameter]:
        """`linear` (1,), and `quadratic` (1,) or (m (m - 1),), or `product` (1,), or `yielded`."""
        return {"linear": self.linear, self._second: getattr(self, self._second)}

    @property
    def _second(self) -> str:
        """Name of the amplitudes of second order."""
        return {None: "quadratic", BESIDE: "yielded"}.get(self.who, "product")

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Effective actuation (..., m) from actuation (..., m)."""
        x = self.load(signal)
        lost = self.linear * (x.sum(-1, keepdim=True) - x)
        if self.who == BESIDE:
            return signal - self.reach * (
                lost + self.yielded * _yielded(x, self.spread[0], self.power)
            )
        shares = torch.einsum("k,kij->ji", getattr(self, self._second), self.spread)
        lost = lost + ((x * x.abs()) @ shares if self.who is None else x * (x @ shares))
        return signal - self.reach * lost

    def sensitivities(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(K, ..., m) change of the actuation by each amplitude: closed form."""
        x = self.load(signal).detach()
        linear = (x.sum(-1, keepdim=True) - x).unsqueeze(0)
        if self.who == BESIDE:
            yielded = _yielded(x, self.spread[0], self.power).detach().unsqueeze(0)
            return -self.reach * torch.cat([linear, yielded])
        other = x * x.abs() if self.who is None else x
        second = torch.einsum("kij,...j->k...i", self.spread, other)
        if self.who is not None:
            second = x * second
        return -self.reach * torch.cat([linear, second])

    def config(self) -> dict:
        """The form of the second-order loss: `pairs`, `who` and `power`."""
        return {"pairs": self.pairs, "who": self.who, "power": self.power}

    def quantities(self) -> list[Quantity]:
        """Shares of push that a fully loaded neighbour costs, and their total."""
        wall = "wide: at most half of the push is lost to one neighbour"
        second = getattr(self, self._second)
        total = float(self.linear.detach()) + float(second.detach().sum()) / second.numel()
        least, most = (0.0, 1.0) if self.who == BESIDE else (-0.3, 0.5)
        return [
            Quantity("linear_share", value_of(self.linear), "", -0.3, 0.5, wall),
            Quantity(f"{self._second}_share", value_of(second), "", least, most, wall),
            Quantity(
                "total_share", total, "", 0.0, max(most, 0.5), "neighbours take push and give none"
            ),
        ]

    def readings(self, seconds: float | None = None) -> list[Reading]:
        """Push that a chamber loses to another one where both are fully loaded, %, or at half load
        where the wall between them yields to the difference."""
        linear = float(self.linear.detach())
        second = getattr(self, self._second).detach().tolist()
        both = [linear + one for one in second]
        chambers = range(1, len(self.facts.low) + 1)
        if self.pairs:
            pairs = [(i, j) for i in chambers for j in chambers if i != j]
            texts = [f"chamber {i} loses {{}} of its push to chamber {j}" for i, j in pairs]
        elif self.who in ("next", "previous"):
            texts = [
                f"each chamber loses {{}} of its push to the {self.who} one",
                "{} to every other one",
            ]
            both.append(linear)
        elif self.who == BESIDE:
            loads = self.origin.new_tensor([0.5, 1.0])
            lost = _yielded(loads, torch.eye(2).flip(0), self.power)[0]
            both = [(linear + one * float(lost)) / float(loads[0]) for one in second]
            texts = ["a chamber at half load loses {} of its push to a fully loaded one beside it"]
        else:
            texts = ["each chamber loses {} of its push to every other one"]
        return [
            Reading(text, 100 * share, "%", share, signed=True, instead=_gained(text))
            for text, share in zip(texts, both, strict=True)
        ]


def beside(chambers: int) -> Tensor:
    """(m, m) one where two chambers share a wall: neighbours in the ring of a segment.

    Three chambers, or each three in turn where their number is a multiple of SEGMENT, are a ring,
    as is any other number.
    """
    ring, number = _ring(chambers), torch.arange(chambers)
    apart = (number[:, None] - number[None, :]).abs() % ring
    one = number[:, None] // ring == number[None, :] // ring
    return (one & ((apart == 1) | (apart == ring - 1))).float()


def _ring(chambers: int) -> int:
    """Number of chambers in the ring of a segment."""
    return SEGMENT if chambers % SEGMENT == 0 else chambers


def _neighbour(chambers: int, who: str) -> Tensor:
    """(m, m) one where the second chamber is the `next` or `previous` one in the ring."""
    ring, number = _ring(chambers), torch.arange(chambers)
    turned = (number + (1 if who == "next" else -1)) % ring
    return torch.eye(chambers)[number // ring * ring + turned]


def _yielded(load: Tensor, walls: Tensor, power: float) -> Tensor:
    """(..., m) loss of push at amplitude one by walls that yield to the difference of loads.

    load: (..., m); walls: (m, m) as `beside` gives them.
    """
    more = load.unsqueeze(-2) - load.unsqueeze(-1)
    soft = (more.square() + SMOOTH**2) ** ((power - 1) / 2)
    return load * (walls * more * soft).sum(-1)


def _gained(text: str) -> str:
    """The words of a reading whose chambers gain push from others instead of losing it."""
    gained = text.replace("loses {} of its push", "gains {} of push")
    return gained.replace(" to ", " from ")


def _grid(facts: ArmFacts, points: Tensor) -> list[Effect]:
    """One loss for all pairs, and one for each; none for a single chamber."""
    if len(facts.low) == 1:
        return []
    who = WHO if len(facts.low) > 2 else WHO[:1]
    return [
        Coupling(facts),
        Coupling(facts, pairs=True),
        *(Coupling(facts, who=some) for some in who),
        *(Coupling(facts, who=BESIDE, power=power) for power in POWERS),
    ]


# A chamber loses push in one way; products both ways round the ring would be a twist.
HYPOTHESIS = Hypothesis(Coupling, _grid, combinations=no_combinations)
