"""The referee in the batched engine's place: FCL decides, one environment after the other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
import torch

from surgisoft.errors import unknown_name
from surgisoft.scene.batched import BatchClearance
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.collision import Referee
from surgisoft.scene.mesh import Body
from surgisoft.scene.rays import RayHit, Struck


class RefereedScene:
    """What `batched.BatchedScene` answers, asked of FCL; bodies stand where the scene puts them.

    Arms map a name to centrelines (B, K, 3) mm, world frame. An environment whose arm or ray is
    not finite gets nan clearances and misses.
    """

    def __init__(self, bodies: Sequence[Body], radii_mm: Mapping[str, float], device="cpu"):
        self.bodies, self.radii_mm = tuple(bodies), dict(radii_mm)
        self.device = torch.device(device)
        self.referee = Referee(self.bodies)

    def radius_mm(self, arm: str) -> float:
        """Radius of an arm by name (mm)."""
        if arm not in self.radii_mm:
            raise unknown_name("arm", arm, self.radii_mm)
        return self.radii_mm[arm]

    def clearance(self, arms: Mapping[str, torch.Tensor]) -> BatchClearance:
        """Signed clearances of every pair; arms name -> (B, K, 3) mm."""
        names, first = list(arms), next(iter(arms.values()))
        pairs = list(combinations(names, 2))
        found = np.full((len(first), len(names) * (len(self.bodies) + 1) + len(pairs)), np.nan)
        for row, shapes in zip(found, self._shapes(arms), strict=True):
            if shapes is not None:
                said = self.referee.clearance(shapes)
                bodies = [said.bodies_mm[name, body.name] for name in names for body in self.bodies]
                row[:] = [*bodies, *(said.arms_mm[p] for p in pairs), *said.self_mm.values()]
        values = torch.as_tensor(found, dtype=first.dtype, device=self.device)
        sizes = (len(names) * len(self.bodies), len(pairs), len(names))
        bodies, apart, own = values.split(sizes, 1)
        return BatchClearance(bodies.unflatten(1, (len(names), len(self.bodies))), apart, own)

    def cast(self, origins_mm, directions, range_mm: float, arms=None, own: str | None = None):
        """First hits of rays (B, ..., 3), world frame, as a `RayHit` of (B, ...) tensors."""
        origins, aims = _numpy(origins_mm), _numpy(directions)
        shapes = self._shapes(arms or {}) if arms else [{}] * len(origins)
        hits = [
            _missed(o, d, range_mm)
            if near is None or not (np.isfinite(o).all() and np.isfinite(d).all())
            else self.referee.cast(o, d, range_mm, near, own)
            for o, d, near in zip(origins, aims, shapes, strict=True)
        ]
        parts = {name: np.stack([getattr(hit, name) for hit in hits]) for name in vars(hits[0])}
        held = {name: torch.as_tensor(part, device=self.device) for name, part in parts.items()}
        kind = origins_mm.dtype
        return RayHit(
            **{
                name: part.to(kind) if part.is_floating_point() else part
                for name, part in held.items()
            }
        )

    def _shapes(self, arms: Mapping[str, torch.Tensor]) -> list[dict[str, ArmShape] | None]:
        """Each environment's arms; None where one of them is not finite."""
        lines = {name: _numpy(line) for name, line in arms.items()}
        count = len(next(iter(lines.values())))
        return [
            {name: ArmShape(line[i], self.radius_mm(name)) for name, line in lines.items()}
            if all(np.isfinite(line[i]).all() for line in lines.values())
            else None
            for i in range(count)
        ]


def _numpy(tensor: torch.Tensor) -> np.ndarray:
    return tensor.detach().cpu().double().numpy()


def _missed(origins: np.ndarray, aims: np.ndarray, range_mm: float) -> RayHit:
    """Rays (..., 3) that meet nothing, finite even where they are not."""
    shape, none = origins.shape[:-1], np.full(origins.shape[:-1], -1, np.int32)
    zero = np.zeros(shape)
    end = np.nan_to_num(origins + range_mm * aims, nan=0.0, posinf=0.0, neginf=0.0)
    return RayHit(
        np.full(shape, int(Struck.NOTHING), np.int8),
        none,
        none,
        zero + range_mm,
        end,
        np.nan_to_num(-aims),
        zero,
    )
