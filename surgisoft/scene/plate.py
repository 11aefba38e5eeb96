"""A plate with an opening of slots that meet in the middle, as a closed mesh."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surgisoft.errors import InputError
from surgisoft.scene.mesh import Mesh

AROUND = 720
"""Points around the opening and around the rim."""


@dataclass(frozen=True)
class SlottedPlate:
    """A round horizontal plate with equal slots that run outwards from its middle."""

    slots: int = 3
    """Number of slots, evenly about the middle, the first along x."""
    slot_mm: float = 23.0
    """Width of a slot, mm."""
    reach_mm: float = 50.0
    """Length of a slot from the plate's middle, mm."""
    radius_mm: float = 70.0
    """Radius of the plate, mm."""
    thickness_mm: float = 4.0
    """Thickness, mm."""

    def __post_init__(self):
        if self.slots < 1:
            raise InputError(f"plate: slots is {self.slots}, expected at least 1")
        if not 0.0 < 0.5 * self.slot_mm < self.reach_mm < self.radius_mm < np.inf:
            raise InputError(
                f"plate: half of slot_mm {self.slot_mm}, reach_mm {self.reach_mm} and radius_mm "
                f"{self.radius_mm} do not rise; expected each larger than the one before"
            )
        if not 0.0 < self.thickness_mm < np.inf:
            raise InputError(f"plate: thickness_mm is {self.thickness_mm}, expected above 0")

    def directions_rad(self) -> np.ndarray:
        """(slots,) rad from x towards y: where the slots run."""
        return 2.0 * np.pi * np.arange(self.slots) / self.slots

    def opening_mm(self, angle_rad: np.ndarray) -> np.ndarray:
        """(N,) mm from the middle to the edge of the opening in directions (N,) rad.

        The farthest of the slots' straight sides and ends, and of a disc as wide as a slot.
        """
        half = 0.5 * self.slot_mm
        away = np.asarray(angle_rad)[:, None] - self.directions_rad()
        cosine, sine = np.cos(away), np.abs(np.sin(away))
        side = half / np.maximum(sine, 1e-12)
        end = self.reach_mm / np.maximum(cosine, 1e-12)
        slot = np.where(cosine > 0.0, np.minimum(side, end), 0.0)
        return np.maximum(slot.max(axis=1), half)

    def mesh(self) -> Mesh:
        """Closed, wound outwards, mm; the middle of its lower side at the origin."""
        angle = 2.0 * np.pi * np.arange(AROUND) / AROUND
        ray = np.stack((np.cos(angle), np.sin(angle)), axis=1)
        inner, outer = self.opening_mm(angle)[:, None] * ray, self.radius_mm * ray
        rings = [
            np.column_stack((ring, np.full(AROUND, height)))
            for height in (0.0, self.thickness_mm)
            for ring in (inner, outer)
        ]
        here = np.arange(AROUND)
        after = np.roll(here, -1)
        low_in, low_out, high_in, high_out = (AROUND * k for k in range(4))
        strips = [(low_out, low_in), (high_in, high_out), (high_out, low_out), (low_in, high_in)]
        faces = []
        for a, b in strips:
            faces.append(np.stack((a + here, b + here, b + after), axis=1))
            faces.append(np.stack((a + here, b + after, a + after), axis=1))
        return Mesh(np.concatenate(rings), np.concatenate(faces))
