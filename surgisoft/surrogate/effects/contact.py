"""Contact effect: a one-sided support that stops part of the body.

The support is the plane {p : n . p = offset} with the arm's side below it, met by one key point c.
Where that point would be deeper by delta, the support pushes it back by a share of delta and the
whole body yields as a clamped beam under a force at c (Love 1927, ch. XVIII), more towards the tip:

    delta = max(n . p_c - offset, 0),    q = p + share delta u(p) / |u_c(p) . n|,

with u the beam's displacement under a force along -n at c (`surgisoft.surrogate.effects.beam`).
share = 1 is a rigid support, less a yielding one (penalty contact, Wriggers 2006).
"""

import math

import torch
from torch import Tensor, nn

from surgisoft.surrogate.effects.base import (
    ArmFacts,
    Effect,
    Memoryless,
    Quantity,
    amplitude,
    value_of,
)
from surgisoft.surrogate.effects.beam import Beam, cross, displaced
from surgisoft.surrogate.effects.hypothesis import Hypothesis
from surgisoft.surrogate.effects.readings import MOST_PERCENT, Reading

AROUND = 16
"""Directions of the support that identification tries."""
DEPTHS = (0.5, 0.7, 0.86, 0.96)
"""Quantiles of the body's excursion at which identification puts the support."""
LEAST_SHARE = 0.08
"""Least plausible share. A support that yields more is in contact all the time and looks like
a weight, or like a stiffer wall."""
BESIDE = 1
"""Neighbouring directions, on either side, in which identification puts supports at once: the
support may be round, but an arm that is held from all around is a stiffer one."""
STEEP = 0.2
"""Least share of the point's displacement that is along the normal; below it the arm stands on the
support, and to push it back would take no bounded bending."""


class Contact(Memoryless):
    """A one-sided, yielding support at one key point."""

    lever: Tensor
    chords: Tensor
    collect: Tensor

    stage = "body"

    def __init__(
        self,
        facts: ArmFacts,
        point: int = -1,
        azimuth_rad: float = 0.0,
        rise_rad: float = 0.0,
        offset_mm: float = 1.0,
    ):
        """Place a support by the key point that meets it and by its plane.

        point: number of that key point, from 0 at the base; azimuth_rad: angle of the plane's
        normal from x; rise_rad: angle of the normal above the base plane; offset_mm: offset of the
        plane along its normal, base frame.
        """
        super().__init__(facts)
        beam = Beam.through(facts.rest_mm)
        self.last_point = len(beam.levers) - 1
        self.point = int(point) % (self.last_point + 1)
        self.length_mm = beam.length_mm
        self.share = amplitude(1)
        self.azimuth = nn.Parameter(torch.tensor([float(azimuth_rad)]))
        self.rise = nn.Parameter(torch.tensor([float(rise_rad)]))
        # In lengths of the arm, so that a step of any nonlinear parameter has a like size.
        self.offset = nn.Parameter(torch.tensor([float(offset_mm) / self.length_mm]))
        lever = beam.levers[self.point] / self.length_mm**2
        self.register_buffer("lever", lever, persistent=False)
        self.register_buffer("chords", beam.chords, persistent=False)
        self.register_buffer("collect", beam.collect, persistent=False)

    def amplitudes(self) -> dict[str, nn.Parameter]:
        """`share` (1,) of the penetration that the support pushes back; 1: rigid."""
        return {"share": self.share}

    @property
    def normal(self) -> Tensor:
        """(3,) unit vector out of the arm's side into the support, base frame."""
        flat = self.rise.cos()
        return torch.cat([flat * self.azimuth.cos(), flat * self.azimuth.sin(), self.rise.sin()])

    def _yielded(self, points: Tensor) -> Tensor:
        """(..., n, 3) displacement, mm, by a rigid support."""
        normal = self.normal
        deep = points[..., self.point, :] @ normal - self.offset * self.length_mm
        p = points.mT.contiguous()
        turned = cross(p @ self.lever, -normal.unsqueeze(-1))
        moved = displaced(turned, p @ self.chords, self.collect)
        at = moved[..., self.point, :]
        back = torch.maximum(-(at @ normal), STEEP * (at.square().sum(-1) + 1e-12).sqrt())
        return moved * (deep.clamp(min=0) / back)[..., None, None]

    def apply(self, signal: Tensor, memory: Tensor) -> Tensor:
        """Supported key points (..., n, 3) from those of the free arm, mm."""
        return signal + self.share * self._yielded(signal)

    def sensitivities(self, signal: Tensor, memory: Tensor) -> Tensor:
        """(1, ..., n, 3) displacement by a rigid support, mm: closed form."""
        with torch.no_grad():
            return self._yielded(signal).unsqueeze(0)

    def config(self) -> dict:
        """The key point that meets the support."""
        return {"point": self.point}

    def quantities(self) -> list[Quantity]:
        """Share, direction (rad) and offset (mm) of the support, and its key point."""
        length = self.length_mm
        offset = length * float(self.offset.detach())
        reach = "within the arm's reach"
        share = "1: rigid (Wriggers 2006); less than the least one: no support"
        least = LEAST_SHARE if float(self.share.detach()) else 0.0
        return [
            Quantity("share", value_of(self.share), "", least, 1.1, share),
            Quantity("azimuth_rad", value_of(self.azimuth), "rad", -10.0, 10.0, "any direction"),
            Quantity("rise_rad", value_of(self.rise), "rad", -1.6, 1.6, "any direction"),
            Quantity("offset_mm", offset, "mm", -1.5 * length, 1.5 * length, reach),
            Quantity("key_point", self.point, "", 0, self.last_point, "which one meets it, from 0"),
        ]

    def readings(self, seconds: float | None = None) -> list[Reading]:
        """Place of the support (mm), and how much of the depth it pushes back (%)."""
        normal = ", ".join(f"{part:.2f}" for part in self.normal.detach().tolist())
        plane = f"a plane with the normal ({normal}), {{}} from the base along the normal"
        place = f"support of key point k{self.point} by {plane}"
        offset = self.length_mm * float(self.offset.detach())
        share = 100 * float(self.share.detach())
        return [
            Reading(place, offset, "mm", signed=offset < 0.0),
            Reading("it pushes {} of the depth back", share, "%", most=MOST_PERCENT),
        ]


def _grid(facts: ArmFacts, points: Tensor) -> list[Effect]:
    """Supports around the body, each where it would be met in a part of the recording."""
    points = points[torch.isfinite(points).all(-1).all(-1)]
    n = points.shape[1]
    made: list[Effect] = []
    if not len(points):
        return made
    # The lowest of several key points hardly moves.
    point = max(n - 2, min(1, n - 1))
    for turn in range(AROUND):
        azimuth = 2 * math.pi * turn / AROUND
        normal = points.new_tensor([math.cos(azimuth), math.sin(azimuth), 0.0])
        out = points[:, point] @ normal
        if float(out.max() - out.min()) <= 0.0:
            continue
        for offset in out.quantile(out.new_tensor(DEPTHS)).tolist():
            made.append(Contact(facts, point, azimuth, 0.0, offset))
    return made


def _neighbours(some: list[Effect]) -> list[list[int]]:
    """Combinations of the supports in one direction and in the neighbouring directions."""
    turns = [
        round(float(effect.azimuth.detach()) * AROUND / (2 * math.pi))
        for effect in some
        if isinstance(effect, Contact)
    ]
    near = [min(turn, AROUND - turn) <= BESIDE for turn in range(AROUND)]
    return [
        [i for i, turn in enumerate(turns) if near[(turn - middle) % AROUND]]
        for middle in sorted(set(turns))
    ]


HYPOTHESIS = Hypothesis(Contact, _grid, combinations=_neighbours, absent_in="no_support")
