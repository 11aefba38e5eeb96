"""Twist effect: actuation rotates the cross-sections about the centreline.

Fibres that are wound unequally rotate every slice of the body by an angle per length that grows
with the chambers' mean load l (Connolly, Walsh & Bertoldi 2017, fibre-reinforced actuators):

    theta(s) = (linear l + quadratic l |l|) / L  int_0^s t ds = (...) (r(s) - r(0)) / L,
    q = p + int_0^s theta x dr,

with t the tangent of the bent centreline r(s) of length L. On a straight arm the effect is
invisible.

The bending by the chambers turns with the body, the one by its own weight does not: the moment of
weight keeps its direction in space, whatever wall it acts on (Love 1927, ch. XVIII, equilibrium of
a rod under forces at rest). To first order in the bending its part of the displacement, that of the
shape r_0 at rest times the share `hanging` of it that weight has bent, is missing:

    q = p + int theta x dr - hanging int theta_0 x dr_0,      theta_0 = (...) (r_0(s) - r_0(0)) / L.
"""

import math

import torch
from torch import Tensor, nn

from surgisoft.surrogate.effects.base import (
    ArmFacts,
    Context,
    Effect,
    Quantity,
    amplitude,
    value_of,
)
from surgisoft.surrogate.effects.beam import Beam, displaced
from surgisoft.surrogate.effects.hypothesis import Hypothesis, no_combinations
from surgisoft.surrogate.effects.readings import Reading

LEAST_BENT = 0.01
"""Displacement of a key point of the arm at rest by a twist of 1 rad, as a share of its length,
from which identification asks whether weight bends the arm."""


class Twist(Effect):
    """Torsion of the body by the mean load of the chambers."""

    places: Tensor
    chords: Tensor
    collect: Tensor
    at_rest: Tensor
    hanging: nn.Parameter | None

    stage = "body"

    def __init__(self, facts: ArmFacts, hanging: float | None = None):
        """hanging: share of the bending at rest that weight causes; None: no such share."""
        super().__init__(facts)
        beam = Beam.through(facts.rest_mm)
        self.linear = amplitude(1)
        self.quadratic = amplitude(1)
        self.register_buffer("places", beam.places / beam.length_mm, persistent=False)
        self.register_buffer("chords", beam.chords, persistent=False)
        self.register_buffer("collect", beam.collect, persistent=False)
        share = None if hanging is None else nn.Parameter(torch.tensor([float(hanging)]))
        self.register_parameter("hanging", share)
        at_rest = self._moved(facts.rest_mm.to(self.places))
        self.register_buffer("at_rest", at_rest, persistent=False)

    def amplitudes(self) -> dict[str, nn.Parameter]:
        """Twist of the tip against the base at full load, rad."""
        return {"linear": self.linear, "quadratic": self.quadratic}

    @property
    def follows(self) -> bool:
        """True: a wall that is loaded where the arm is held."""
        return True

    def rest(self, signal: Tensor) -> Tensor:
        """(B, 1) mean load of the chambers of an arm at rest: zero."""
        return signal.new_zeros(len(signal), 1)

    def advance(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(B, 1) present mean load of the chambers; the last one if `context` has no pressure."""
        if context.pressure is None:
            return memory
        return self.load(context.pressure).mean(-1, keepdim=True)

    def scan(self, memory: Tensor, signal: Tensor, context: Context) -> Tensor:
        """(R, T, 1) mean load of the chambers."""
        if context.pressure is None:
            return memory.unsqueeze(1).expand(*signal.shape[:2], 1)
        return self.load(context.pressure).mean(-1, keepdim=True)

    def _moved(self, points: Tensor) -> Tensor:
        """(..., n, 3) displacement, mm, where all of the body turns by 1 rad from base to tip."""
        p = points.mT.contiguous()
        return displaced(p @ self.places, p @ self.chords, self.collect)

    def _turned(self, points: Tensor) -> Tensor:
        """(..., n, 3) displacement, mm, by a twist of 1 rad from base to tip."""
        moved = self._moved(points)
        return moved if self.hanging is None else moved - self.hanging * self.at_rest

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Twisted key points (..., n, 3), mm, from the mean load (..., 1)."""
        angle = self.linear * memory + self.quadratic * memory * memory.abs()
        return signal + angle.unsqueeze(-1) * self._turned(signal)

    def sensitivities(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(2, ..., n, 3) displacement by each amplitude: closed form."""
        with torch.no_grad():
            turned, load = self._turned(signal), memory.unsqueeze(-1)
            return torch.stack([load * turned, load * load.abs() * turned])

    def config(self) -> dict:
        """The share that weight bends at rest, where there is one."""
        return {"hanging": None if self.hanging is None else value_of(self.hanging)}

    def quantities(self) -> list[Quantity]:
        """Linear and quadratic part of the twist of the tip at full load, and the twist at half of
        it, rad."""
        fibres = "arms that are meant to bend, not to twist (Connolly et al. 2017)"
        parts = "of opposite signs where the twist saturates or sets in late"
        half = float((self.linear / 2 + self.quadratic / 4).detach())
        twist = [
            Quantity("linear_rad", value_of(self.linear), "rad", -4.0, 4.0, parts),
            Quantity("quadratic_rad", value_of(self.quadratic), "rad", -4.0, 4.0, parts),
            Quantity("half_load_rad", half, "rad", -1.0, 1.0, fibres),
        ]
        if self.hanging is None:
            return twist
        bent = "0: bent as cast, 1: bent by weight; beyond 1 as cast against its weight"
        return [*twist, Quantity("hanging_share", value_of(self.hanging), "", 0.0, 1.5, bent)]

    def readings(self, seconds: float | None = None) -> list[Reading]:
        """Twist of the tip at full load of all chambers, degrees."""
        angle = math.degrees(float((self.linear + self.quadratic).detach()))
        text = "the tip turns by {+} about the arm at full load of all chambers"
        return [Reading(text, angle, "degrees", signed=True)]


def _grid(facts: ArmFacts, points: Tensor) -> list[Effect]:
    """A body that is bent at rest as it was cast, and one that weight bends."""
    hanging = Twist(facts, hanging=1.0)
    length = float(Beam.through(facts.rest_mm).length_mm)
    bent = bool(hanging.at_rest.abs().max() > LEAST_BENT * length)
    return [Twist(facts), *([hanging] if bent else [])]


# A body is bent at rest in one way.
HYPOTHESIS = Hypothesis(Twist, _grid, combinations=no_combinations)
