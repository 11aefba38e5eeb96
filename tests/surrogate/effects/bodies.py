"""A body of many nodes that bends to arcs, for tests of effects on its strains."""

import math

import torch

from surgisoft.surrogate.effects import ArmFacts, Context, Effect
from surgisoft.surrogate.effects.bent_body import BentBody

NODES = 21
LENGTH = 100.0
ALONG = torch.linspace(0.0, 1.0, NODES).double()
STRAIGHT = torch.stack([0 * ALONG, 0 * ALONG, LENGTH * ALONG], -1)


def arc(angle: float, towards: float = 0.0, length: float = LENGTH) -> torch.Tensor:
    """(NODES, 3) key points on an arc from the base, along z there, that turns by an angle."""
    turned, radius = angle * ALONG, length / angle
    out, up = radius * (1 - turned.cos()), radius * turned.sin()
    return torch.stack([out * math.cos(towards), out * math.sin(towards), up], -1)


def facts(rest_mm: torch.Tensor = STRAIGHT, gravity=None) -> ArmFacts:
    """An arm of three chambers with these key points at rest."""
    three = torch.zeros(3)
    return ArmFacts(three, three + 1, three, rest_mm.float(), gravity)


def body(rest_mm: torch.Tensor = STRAIGHT) -> BentBody:
    """The body of an arm with these key points at rest."""
    return BentBody(rest_mm).double()


def along(effect: Effect, *shapes: torch.Tensor) -> torch.Tensor:
    """(T, n, 3) key points behind an effect that sees these shapes, one in a second."""
    signal = torch.stack(shapes).unsqueeze(0).double()
    effect = effect.double()
    memory = effect.scan(effect.rest(signal[:, 0]), signal, Context(torch.ones(1, len(shapes))))
    return effect.apply(signal, memory)[0].detach()
