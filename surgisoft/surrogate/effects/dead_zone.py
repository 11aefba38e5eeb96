"""Dead zone: nothing moves before a threshold of push.

Folds, play and slack take up the first of the actuation, smoothly:

    x_eff = x - threshold x / sqrt(x^2 + width^2),      x = load.

Far from rest the push is short by the threshold (Tao & Kokotovic 1996, ch. 2, the dead zone); near
rest the slope is 1 - threshold / width, none at all where both are equal.
"""

from torch import Tensor, nn

from surgisoft.surrogate.effects.base import (
    ArmFacts,
    Memoryless,
    Quantity,
    amplitude,
    logarithm,
)

GRID = (0.04, 0.1, 0.25)
"""Widths that a diagnosis tries, loads."""


class DeadZone(Memoryless):
    """A smooth dead zone around rest, the same for all chambers."""

    stage = "material"

    def __init__(self, facts: ArmFacts, width: float = 0.1):
        """Half width, as a share of full load."""
        super().__init__(facts)
        self.threshold = amplitude(1)
        self.log_width = logarithm(width)

    def strengths(self) -> dict[str, nn.Parameter]:
        return {"threshold": self.threshold}

    @classmethod
    def candidates(cls, facts: ArmFacts, points: Tensor) -> list[Memoryless]:
        return [cls(facts, width) for width in GRID]

    def _lost(self, signal: Tensor) -> Tensor:
        x = self.load(signal)
        return -self.reach * x / (x.square() + (2 * self.log_width).exp()).sqrt()

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Effective actuation (..., m) from actuation (..., m)."""
        return signal + self.threshold * self._lost(signal)

    def columns(self, signal: Tensor, memory: Tensor) -> Tensor:
        return self._lost(signal).unsqueeze(0).detach()

    def config(self) -> dict:
        return {}

    def quantities(self) -> list[Quantity]:
        unit, full = self.facts.unit, float(self.reach.mean())
        folds = "a chamber that pushes in most of its range"
        threshold = full * float(self.threshold.detach())
        width = full * float(self.log_width.detach().exp())
        return [
            Quantity(f"threshold_{unit}", threshold, unit, 0.0, 0.5 * full, folds),
            Quantity(f"width_{unit}", width, unit, 0.002 * full, full, folds),
        ]
