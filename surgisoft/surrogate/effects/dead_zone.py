"""Dead-zone effect: the arm moves little below a threshold of push.

Folds, play and slack absorb the first part of the actuation, smoothly:

    x_eff = x - threshold x / sqrt(x^2 + width^2),      x = load.

with one threshold or one for each chamber. Far from rest the push is short by the threshold (Tao &
Kokotovic 1996, ch. 2, the dead zone); near rest the slope is 1 - threshold / width, none at all
where both are equal.
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
from surgisoft.surrogate.effects.readings import Reading, each_chamber

GRID = (0.04, 0.1, 0.25)
"""Widths that identification tries, loads."""


class DeadZone(Memoryless):
    """A smooth dead zone around rest, one for all chambers or one for each."""

    stage = "material"

    def __init__(self, facts: ArmFacts, width: float = 0.1, each: bool = False):
        """width: half width, as a share of full load; each: one threshold for each chamber."""
        super().__init__(facts)
        self.each = bool(each)
        self.threshold = amplitude(len(facts.low) if self.each else 1)
        self.log_width = logarithm(width)

    def amplitudes(self) -> dict[str, nn.Parameter]:
        """`threshold` (1,) or (m,): loss of push far from rest, as a share of full load."""
        return {"threshold": self.threshold}

    def _lost(self, signal: Tensor) -> Tensor:
        x = self.load(signal)
        return -self.reach * x / (x.square() + (2 * self.log_width).exp()).sqrt()

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Effective actuation (..., m) from actuation (..., m)."""
        return signal + self.threshold * self._lost(signal)

    def sensitivities(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(K, ..., m) change of the actuation by each threshold: closed form."""
        lost = self._lost(signal).detach()
        return torch.diag_embed(lost).movedim(-1, 0) if self.each else lost.unsqueeze(0)

    def config(self) -> dict:
        """Whether each chamber has a threshold."""
        return {"each": self.each}

    def quantities(self) -> list[Quantity]:
        """Threshold and half width, in the arm's unit."""
        unit, full = self.facts.unit, float(self.reach.mean())
        folds = "a chamber that pushes in most of its range"
        threshold = value_of(full * self.threshold)
        width = full * float(self.log_width.detach().exp())
        return [
            Quantity(f"threshold_{unit}", threshold, unit, 0.0, 0.5 * full, folds),
            Quantity(f"width_{unit}", width, unit, 0.002 * full, full, folds),
        ]

    def readings(self, seconds: float | None = None) -> list[Reading]:
        """Push that is lost, in the arm's unit."""
        lost, unit = self.threshold.detach(), self.facts.unit
        sizes = lost.tolist()
        if self.each:
            text, more = (
                "chamber {chamber} loses {} of its push",
                "chamber {chamber} gains {} of push",
            )
            return each_chamber(text, (self.reach * lost).tolist(), unit, sizes, more)
        full = float(self.reach.mean())
        text, more = "each chamber loses {} of its push", "each chamber gains {} of push"
        return [Reading(text, full * sizes[0], unit, sizes[0], signed=True, instead=more)]


def _grid(facts: ArmFacts, points: Tensor) -> list[Effect]:
    each = (False, True) if len(facts.low) > 1 else (False,)
    return [DeadZone(facts, width, one) for one in each for width in GRID]


HYPOTHESIS = Hypothesis(DeadZone, _grid)
