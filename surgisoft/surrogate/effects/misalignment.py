"""Misalignment effect: the cameras' frame differs from the arm's base frame.

    q = (1 + scale) R(turn) p + shift

with R the rotation by the vector `turn` (Rodrigues 1840): the similarity between two frames of
Umeyama (1991, eq. 40).
"""

import torch
from torch import Tensor, nn

from surgisoft.surrogate.effects.base import ArmFacts, Memoryless, Quantity, amplitude, value_of
from surgisoft.surrogate.effects.hypothesis import Hypothesis
from surgisoft.surrogate.effects.readings import Reading, each_axis
from surgisoft.surrogate.effects.rotation import rotate


class Misalignment(Memoryless):
    """A similarity between the frame of the arm's base and that of the measurement."""

    stage = "sensor"

    def __init__(self, facts: ArmFacts):
        super().__init__(facts)
        self.turn = amplitude(3)
        self.shift = amplitude(3)
        self.scale = amplitude(1)

    def amplitudes(self) -> dict[str, nn.Parameter]:
        """`turn` (3,) rad, `shift` (3,) mm and `scale` (1,)."""
        return {"turn": self.turn, "shift": self.shift, "scale": self.scale}

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Measured key points (..., n, 3) from the true ones, mm."""
        turned = rotate(signal, self.turn)
        return turned + self.scale * turned + self.shift

    def sensitivities(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(7, ..., n, 3) change of the key points by each amplitude: closed form."""
        axes = torch.eye(3, dtype=signal.dtype, device=signal.device)
        axes = axes.view(3, *[1] * (signal.ndim - 1), 3).expand(3, *signal.shape)
        p = signal.detach()
        return torch.cat([torch.linalg.cross(axes, p.expand(axes.shape)), axes, p.unsqueeze(0)])

    def config(self) -> dict:
        """No arguments: tensors hold everything."""
        return {}

    def quantities(self) -> list[Quantity]:
        """Rotation vector (rad), shift (mm) and relative scale error."""
        setup = "beyond it the base frame was set up wrongly, not a little off"
        return [
            Quantity("turn_rad", value_of(self.turn), "rad", -0.3, 0.3, setup),
            Quantity("shift_mm", value_of(self.shift), "mm", -20.0, 20.0, setup),
            Quantity("scale_share", value_of(self.scale), "", -0.1, 0.1, "a wand's calibration"),
        ]

    def readings(self, seconds: float | None = None) -> list[Reading]:
        """Turn (degrees) and shift (mm) about and along each axis, and the scale (%)."""
        turn, shift = self.turn.detach(), self.shift.detach().tolist()
        scale = float(self.scale.detach())
        length = self.facts.length_mm or float(self.facts.rest_mm.norm(dim=-1).max()) or 1.0
        angles, moved = torch.rad2deg(turn).tolist(), (length * turn).tolist()
        return [
            *each_axis("frame turned by {+} about {axis}", angles, "degrees", moved),
            *each_axis("shifted by {+} along {axis}", shift, "mm", shift),
            Reading("scaled by {+}", 100 * scale, "%", length * scale, signed=True),
        ]


HYPOTHESIS = Hypothesis(
    Misalignment, exact_form=True, absent_in="new_frame", by_definition=True, moves_base=True
)
