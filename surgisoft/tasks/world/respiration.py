"""Respiration: how the organ moves and deforms with breathing, batched.

The displacement of a breath follows Lujan et al. (1999, Med. Phys. 26:715):
z(t) = z0 - b cos^2n(pi t / tau - phi), with z0 the place at the end of exhalation, where the organ
rests longest, b the amplitude, tau the period and n = 1, 2, 3 the asymmetry. Each breath has its
own b and tau; breaths join at the end of exhalation, where the displacement and its rate are 0.

The lesion moves towards the feet and a share of that forwards; about it the organ turns about the
lateral axis, and is strained in proportion: shorter from head to feet, deeper from back to front,
and sheared. In quiet breathing the liver moves by 5 to 25 mm from head to feet (studies collected
by Keall et al. 2006, AAPM TG-76, Med. Phys. 33:3874) and deforms by some millimetres beside
(Rohlfing et al. 2004, Med. Phys. 31:427); the strains here make 2.4 mm at 80 mm from the lesion and
a breath of 20 mm. Strain is homogeneous: bending is not modelled.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.scene import frames
from surgisoft.scene.mesh import Body
from surgisoft.scene.moving import Placement, about
from surgisoft.tasks.world.random_streams import Stream

MOVING = ("organ", "keep-out")
"""Roles of the bodies that move with respiration; supports stay."""
LEVELS = 12
"""Levels of the strain between none and that of the largest displacement."""
LEAST_SHARE, MOST_SHARE = 0.4, 1.6
"""Smallest and largest amplitude and period of a breath, in those of the episode."""


@dataclass(frozen=True)
class Respiration:
    """How the organ breathes; each episode draws its mean amplitude and rate uniformly."""

    amplitude_mm: tuple[float, float] = (5.0, 20.0)
    """Smallest and largest mean displacement of the lesion towards the feet, mm."""
    rate_per_min: tuple[float, float] = (10.0, 20.0)
    """Smallest and largest mean number of breaths in a minute."""
    irregular: float = 0.15
    """Standard deviation of a breath's amplitude and of its period, as a share of the mean."""
    asymmetry: int = 3
    """Lujan's n: 1, 2 or 3; the larger, the longer the organ rests at the end of exhalation."""
    feet: tuple[float, float, float] = (0.0, 1.0, 0.0)
    """Direction towards the patient's feet, world frame, any length."""
    front: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction towards the patient's front, world frame, any length."""
    forwards: float = 0.25
    """Displacement towards the front as a share of that towards the feet."""
    pitch_deg_per_mm: float = 0.1
    """Turn about the lateral axis per displacement, degrees/mm."""
    shorten_per_mm: float = 0.0015
    """Strain from head to feet per displacement, shorter, 1/mm."""
    deepen_per_mm: float = 0.001
    """Strain from back to front per displacement, deeper, 1/mm."""
    shear_per_mm: float = 0.001
    """Shear towards the feet with depth per displacement, 1/mm."""

    def __post_init__(self):
        for name in ("amplitude_mm", "rate_per_min"):
            low, high = getattr(self, name)
            if not (0.0 < low <= high < math.inf):
                raise InputError(
                    f"respiration: {name} is {low:g} to {high:g}, expected two rising numbers > 0"
                )
        if not 0.0 <= self.irregular <= 0.5:
            raise InputError(f"respiration: irregular is {self.irregular}, expected 0 to 0.5")
        if self.asymmetry not in (1, 2, 3):
            raise InputError(f"respiration: asymmetry is {self.asymmetry}, expected 1, 2 or 3")
        feet, front = (np.asarray(each, float) for each in (self.feet, self.front))
        if not np.linalg.norm(np.cross(feet, front)) > 1e-3:
            raise InputError("respiration: feet and front lie along each other, or one is 0")


@dataclass(frozen=True, eq=False)
class Breaths:
    """The breaths of B episodes, and the time."""

    begins_s: Tensor
    """(B, K) s: beginnings of the breaths, at the end of exhalation; the first is at most 0."""
    period_s: Tensor
    """(B, K) s: their durations."""
    amplitude_mm: Tensor
    """(B, K) mm: their displacements at the end of inhalation."""
    time_s: Tensor
    """(B,) s since the episode began."""

    def after(self, dt_s: float) -> Breaths:
        """The breathing states after dt_s seconds."""
        return replace(self, time_s=self.time_s + dt_s)

    def displacement_mm(self, asymmetry: int, ahead_s: float = 0.0) -> tuple[Tensor, Tensor]:
        """(B,) mm towards the feet, from the end of exhalation, and (B,) mm/s its rate."""
        at = (self.time_s + ahead_s)[:, None]
        place = ((self.begins_s <= at).sum(1) - 1).clamp(min=0)[:, None]
        begin, period, amplitude = (
            each.gather(1, place)[:, 0]
            for each in (self.begins_s, self.period_s, self.amplitude_mm)
        )
        return lujan(at[:, 0] - begin, amplitude, period, asymmetry)


def lujan(since_s: Tensor, amplitude: Tensor, period_s: Tensor, n: int) -> tuple[Tensor, Tensor]:
    """Displacement and its rate `since_s` after the end of exhalation (Lujan et al. 1999).

    b cos^2n(pi t / tau - phi) with phi = pi / 2, which puts the end of exhalation at t = 0.
    """
    angle = math.pi * since_s / period_s
    sine, cosine = angle.sin(), angle.cos()
    value = amplitude * sine ** (2 * n)
    rate = amplitude * 2 * n * sine ** (2 * n - 1) * cosine * math.pi / period_s
    return value, rate


class OrganMotion:
    """Respiration of the bodies of a scene; built once, holds no state."""

    def __init__(
        self,
        respiration: Respiration,
        bodies: Sequence[Body],
        centre_mm: np.ndarray,
        time_s: float,
        device: torch.device,
    ):
        """centre_mm (3,): the lesion's centre, whose displacement is that of the breath, and about
        which the organ turns and is strained, so that levels of strain do not move it. time_s:
        longest episode, s, which sets the number of breaths that are drawn.
        """
        self.config, self.device = respiration, device
        shortest_s = LEAST_SHARE * 60.0 / respiration.rate_per_min[1]
        self.count = math.ceil(time_s / shortest_s) + 2
        self.largest_mm = MOST_SHARE * respiration.amplitude_mm[1]
        self.centre_mm = np.asarray(centre_mm, float)
        feet = frames.normalise(np.asarray(respiration.feet, float))
        front = np.asarray(respiration.front, float)
        front = frames.normalise(front - (front @ feet) * feet)
        self._axes = np.stack((feet, front, np.cross(feet, front)), axis=1)
        levels = self.largest_mm * np.arange(LEVELS + 1) / LEVELS
        own = np.zeros((LEVELS + 1, 3, 3))
        own[:, 0, 0] = -respiration.shorten_per_mm * levels
        own[:, 1, 1] = respiration.deepen_per_mm * levels
        own[:, 0, 1] = respiration.shear_per_mm * levels
        linear = np.eye(3) + self._axes @ own @ self._axes.T
        self._strains = torch.tensor(about(self.centre_mm, linear), device=device)
        self.stretch = float(1.0 / np.linalg.svd(linear, compute_uv=False).min())
        """Largest factor by which a length is longer at rest than under a strain."""
        self._at_rest = {
            body.name: torch.tensor(np.array(body.pose), device=device)
            for body in bodies
            if body.role in MOVING
        }
        self._lateral = torch.tensor(self._axes[:, 2], device=device)
        self._centre = torch.tensor(self.centre_mm, device=device)
        self._shift = torch.tensor(feet + respiration.forwards * front, device=device)

    def start(self, stream: Stream) -> tuple[Stream, Breaths]:
        """Draw the breaths of an episode for each random number stream, at any phase."""
        c, count = self.config, self.count
        stream, share = stream.uniform(0.0, 1.0, 3)
        stream, spread = stream.normal(2, count)
        low, high = c.amplitude_mm
        amplitude = low + (high - low) * share[:, 0]
        rate = c.rate_per_min[0] + (c.rate_per_min[1] - c.rate_per_min[0]) * share[:, 1]
        factor = (1.0 + c.irregular * spread).clamp(LEAST_SHARE, MOST_SHARE)
        period = (60.0 / rate)[:, None] * factor[:, 0]
        begins = period.cumsum(1) - period - (share[:, 2] * period[:, 0])[:, None]
        breaths = Breaths(begins, period, amplitude[:, None] * factor[:, 1], torch.zeros_like(rate))
        return stream, breaths

    def displacement_mm(self, breaths: Breaths, ahead_s: float = 0.0) -> tuple[Tensor, Tensor]:
        """(B,) mm towards the feet and (B,) mm/s, `ahead_s` seconds from now."""
        return breaths.displacement_mm(self.config.asymmetry, ahead_s)

    def placement(self, displacement_mm: Tensor) -> Placement:
        """Where the moving bodies are at displacements (B,) mm towards the feet."""
        s = displacement_mm.double()
        share = s / self.largest_mm * LEVELS
        level = share.round().long().clamp(0, LEVELS)
        angle = math.radians(self.config.pitch_deg_per_mm) * s
        turn = frames.rotation_from_axis_angle(self._lateral.expand(len(s), 3), angle)
        shift = self._centre - turn @ self._centre + s[:, None] * self._shift
        return Placement(self._at_rest, self._strains, level, frames.pose_from(turn, shift))
