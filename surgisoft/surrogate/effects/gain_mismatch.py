"""Gain-mismatch effect: chambers that are nominally equal push unequally.

Area, wall and pressure sensor of a chamber differ from the nominal ones by a constant factor:

    x_eff_i = x_i + gain_i x_i,      x = load, 0 at rest and 1 at full actuation.
"""

import torch
from torch import Tensor, nn

from surgisoft.surrogate.effects.base import ArmFacts, Memoryless, Quantity, amplitude
from surgisoft.surrogate.effects.hypothesis import Hypothesis
from surgisoft.surrogate.effects.readings import Reading, each_chamber


class GainMismatch(Memoryless):
    """One relative gain error for each chamber."""

    stage = "material"

    def __init__(self, facts: ArmFacts):
        super().__init__(facts)
        self.gain = amplitude(len(facts.low))

    def amplitudes(self) -> dict[str, nn.Parameter]:
        """`gain` (m,): relative error of each chamber's gain."""
        return {"gain": self.gain}

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Effective actuation (..., m) from actuation (..., m)."""
        return signal + self.gain * (signal - self.origin)

    def sensitivities(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(m, ..., m) change of the actuation by each gain: closed form."""
        return torch.diag_embed((signal - self.origin).detach()).movedim(-1, 0)

    def config(self) -> dict:
        """No arguments: tensors hold everything."""
        return {}

    def quantities(self) -> list[Quantity]:
        """Relative gain errors, by chamber."""
        cast = "wide: half to one and a half times the nominal push"
        return [Quantity("gain_share", self.gain.detach().tolist(), "", -0.5, 0.5, cast)]

    def readings(self, seconds: float | None = None) -> list[Reading]:
        """Change of each chamber's push, %."""
        gains = self.gain.detach().tolist()
        return each_chamber("push of chamber {chamber} {+}", [100 * g for g in gains], "%", gains)


HYPOTHESIS = Hypothesis(GainMismatch, measured_body="gain", by_definition=True)
