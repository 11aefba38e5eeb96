"""Gain mismatch: chambers of one make push unequally.

Area, wall and pressure sensor of a chamber differ from the nominal ones by a constant factor, and
the zero of a sensor or regulator may be off:

    x_eff_i = x_i + gain_i x_i + offset_i,      x = load, 0 at rest and 1 at full actuation.
"""

import torch
from torch import Tensor, nn

from surgisoft.surrogate.effects.base import ArmFacts, Effect, Memoryless, Quantity, amplitude


class GainMismatch(Memoryless):
    """A gain, and where asked for an offset, for each chamber."""

    stage = "material"
    side_by_side = False  # with offsets it holds the gains already

    def __init__(self, facts: ArmFacts, zero: bool = False):
        """zero: whether the zeros may be off as well."""
        super().__init__(facts)
        self.gain = amplitude(len(facts.low))
        self.offset = amplitude(len(facts.low)) if zero else None

    def strengths(self) -> dict[str, nn.Parameter]:
        return {"gain": self.gain} | ({} if self.offset is None else {"offset": self.offset})

    @classmethod
    def candidates(cls, facts: ArmFacts, points: Tensor) -> list[Effect]:
        return [cls(facts), cls(facts, zero=True)]

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Effective actuation (..., m) from actuation (..., m)."""
        answer = signal + self.gain * (signal - self.origin)
        return answer if self.offset is None else answer + self.offset * self.reach

    def columns(self, signal: Tensor, memory: Tensor) -> Tensor:
        gains = torch.diag_embed((signal - self.origin).detach()).movedim(-1, 0)
        if self.offset is None:
            return gains
        return torch.cat([gains, torch.diag_embed(self.reach.expand_as(signal)).movedim(-1, 0)])

    def config(self) -> dict:
        return {"zero": self.offset is not None}

    def quantities(self) -> list[Quantity]:
        cast = "wide: half to one and a half times the nominal push"
        answer = [Quantity("gain_share", self.gain.detach().tolist(), "", -0.5, 0.5, cast)]
        if self.offset is not None:
            off = "a zero that is off, not a chamber that is always full"
            value = self.offset.detach().tolist()
            answer.append(Quantity("offset_share", value, "", -0.2, 0.2, off))
        return answer
