"""Zero-offset effect: the zero of a chamber's actuation is shifted by a constant.

A pressure sensor whose zero has moved, a regulator that was adjusted, a motor that lost its home
position and a wall with a permanent set act like a constant load that no reading shows (zero error:
JCGM 200:2012, 4.28):

    x_eff_i = x_i + offset_i reach_i,      reach = actuation from rest to the end of the range.

A steady misreading that grows with the actuation is a gain (`gain_mismatch`), one that grows with
time is `drift`.
"""

import torch
from torch import Tensor, nn

from surgisoft.surrogate.effects.base import ArmFacts, Memoryless, Quantity, amplitude
from surgisoft.surrogate.effects.hypothesis import Hypothesis
from surgisoft.surrogate.effects.readings import Reading, each_chamber


class ZeroOffset(Memoryless):
    """One constant offset for each chamber."""

    stage = "material"

    def __init__(self, facts: ArmFacts):
        super().__init__(facts)
        self.offset = amplitude(len(facts.low))

    def amplitudes(self) -> dict[str, nn.Parameter]:
        """`offset` (m,): shift of each chamber's actuation, as a share of full load."""
        return {"offset": self.offset}

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Effective actuation (..., m) from actuation (..., m)."""
        return signal + self.offset * self.reach

    def sensitivities(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(m, ..., m) change of the actuation by each offset: closed form."""
        return torch.diag_embed(self.reach.expand(signal.shape).detach()).movedim(-1, 0)

    def config(self) -> dict:
        """No arguments: tensors hold everything."""
        return {}

    def quantities(self) -> list[Quantity]:
        """Offsets by chamber, in the arm's unit."""
        unit, full = self.facts.unit, float(self.reach.max())
        offsets = (self.reach * self.offset.detach()).tolist()
        wide = "wide: half of the range"
        return [Quantity(f"offset_{unit}", offsets, unit, -0.5 * full, 0.5 * full, wide)]

    def readings(self, seconds: float | None = None) -> list[Reading]:
        """Shift of each chamber's zero, in the arm's unit."""
        offset = self.offset.detach()
        values, sizes = (self.reach * offset).tolist(), offset.tolist()
        text = "zero of chamber {chamber} shifted by {+}"
        return each_chamber(text, values, self.facts.unit, sizes)


HYPOTHESIS = Hypothesis(ZeroOffset, by_definition=True)
