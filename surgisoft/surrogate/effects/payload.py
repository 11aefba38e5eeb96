"""Payload effect: weight at the tip and along the body bends the arm.

Euler-Bernoulli beam on the bent centreline r(s) (Love 1927, ch. XVIII; `effects/beam.py`):

    M(s) = (r_tip - r(s)) x F + int_s^L (r(s') - r(s)) x w ds',
    theta(s) = C int_0^s M ds,     u(s) = int_0^s theta x dr,     q = p + u.

The key points of an arm determine only C F and C w, compliance times load. They are given as the
sag that they cause at the tip of the same arm held straight and level: C F L^3 / 3 and C w L^4 / 8.
Where gravity's direction is not known, each is a vector in the base frame.
"""

import torch
from torch import Tensor, nn

from surgisoft.surrogate.effects.base import ArmFacts, Memoryless, Quantity, amplitude, value_of
from surgisoft.surrogate.effects.beam import Beam, cross, displaced
from surgisoft.surrogate.effects.hypothesis import Hypothesis, no_combinations
from surgisoft.surrogate.effects.readings import Reading, each_axis


class Payload(Memoryless):
    """Weight at the tip and along the body."""

    down: Tensor
    lever: Tensor
    chords: Tensor
    collect: Tensor

    stage = "body"

    def __init__(self, facts: ArmFacts):
        super().__init__(facts)
        beam = Beam.through(facts.rest_mm)
        known = facts.gravity is not None
        down = torch.tensor([facts.gravity]) if known else torch.eye(3)
        self.length_mm = beam.length_mm
        self.tip_sag = amplitude(len(down))
        self.body_sag = amplitude(len(down))
        self.register_buffer("down", down.float(), persistent=False)
        # As levers of unit sags: C F = 3 tip_sag / L^3 and C w = 8 body_sag / L^4.
        lever = torch.stack([beam.tip_lever, beam.body_lever])
        self.register_buffer("lever", lever, persistent=False)
        self.register_buffer("chords", beam.chords, persistent=False)
        self.register_buffer("collect", beam.collect, persistent=False)

    def amplitudes(self) -> dict[str, nn.Parameter]:
        """Sag at the tip, mm, by a load at the tip and along the body; (1,), or (3,) by axis."""
        return {"tip_sag": self.tip_sag, "body_sag": self.body_sag}

    def _moved(self, points: Tensor, sags: Tensor) -> Tensor:
        """(..., n, 3) displacement, mm, by sags (2, 3) in mm at the tip and along the body."""
        p = points.mT.contiguous()
        tip, body = (sag.unsqueeze(-1) for sag in sags)
        turned = cross(p @ self.lever[0], tip) + cross(p @ self.lever[1], body)
        return displaced(turned, p @ self.chords, self.collect)

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Loaded key points (..., n, 3) from those of the unloaded arm, mm."""
        return signal + self._moved(signal, torch.stack([self.tip_sag, self.body_sag]) @ self.down)

    def sensitivities(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(K, ..., n, 3) displacement by each unit sag: closed form."""
        with torch.no_grad():
            p = signal.mT.contiguous()
            chords = p @ self.chords
            levers = [p @ lever for lever in self.lever]
            return torch.stack(
                [
                    displaced(cross(lever, axis.unsqueeze(-1)), chords, self.collect)
                    for lever in levers
                    for axis in self.down
                ]
            )

    def config(self) -> dict:
        """No arguments: tensors hold everything."""
        return {}

    def quantities(self) -> list[Quantity]:
        """Sags at the tip by the tip load, by the body load and by both, mm."""
        small = "to first order in the load, so below half the length"
        largest = 0.5 * self.length_mm
        least = -0.1 * self.length_mm if len(self.down) == 1 else -largest
        total = (self.tip_sag + self.body_sag).detach()
        lightest = 0.0 if len(self.down) == 1 else -largest
        return [
            Quantity("tip_sag_mm", value_of(self.tip_sag), "mm", least, largest, small),
            Quantity("body_sag_mm", value_of(self.body_sag), "mm", least, largest, small),
            Quantity("sag_mm", value_of(total), "mm", lightest, largest, "no negative mass"),
        ]

    def readings(self, seconds: float | None = None) -> list[Reading]:
        """Sag of the tip, mm, of the arm held straight and level.

        Grams would need the bending stiffness, which key points do not tell.
        """
        sag = (self.tip_sag + self.body_sag).detach().tolist()
        if len(sag) == 1:
            text = "weight that makes the straight, level arm sag by {} at the tip"
            return [Reading(text, sag[0], "mm", signed=True)]
        return each_axis("load along {axis} that bends the straight arm by {}", sag, "mm", sag)


HYPOTHESIS = Hypothesis(
    Payload,
    combinations=no_combinations,
    absent_in="bare_tip",
    own_weight="body_sag",
    tip_mass="tip_sag",
    measured_body="load",
)
