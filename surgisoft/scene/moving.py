"""Bodies that move and deform: rigid motion, and homogeneous strain in fixed levels.

The strain (a linear map about a centre) comes first, the rigid motion second:
x_world = rigid(strain(x_rest)). A straight ray stays straight under such a map, so that the batched
engine casts it in the rest frame. FCL needs the strained surface itself: strain takes one of a few
levels, and the exact checker builds each level's surface once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch


@dataclass(frozen=True, eq=False)
class Placement:
    """Where the moving bodies are in B environments, and how they are strained."""

    at_rest: Mapping[str, torch.Tensor]
    """Name of each moving body -> (4, 4) float64: its frame to the world frame at rest, mm."""
    strains: torch.Tensor
    """(Q, 4, 4) float64: strain of each level, world frame at rest, mm."""
    level: torch.Tensor
    """(B,) int64: level of each environment."""
    rigid: torch.Tensor
    """(B, 4, 4) float64: rigid motion after the strain, world frame, mm."""

    @property
    def map(self) -> torch.Tensor:
        """(B, 4, 4) float64: world frame at rest to world frame now, affine, mm."""
        return self.rigid @ self.strains[self.level]

    @property
    def _inverse(self) -> torch.Tensor:
        # `inv` would wait for an accelerator, to check that the map has an inverse.
        return torch.linalg.inv_ex(self.map)[0]

    def get(self, body: str) -> torch.Tensor | None:
        """(B, 4, 4) body's frame to the world frame now, affine; None for a body at rest."""
        home = self.at_rest.get(body)
        return None if home is None else self.map @ home

    def points(self, points_mm: torch.Tensor) -> torch.Tensor:
        """Where points (B, ..., 3) mm of the organ, world frame at rest, are now."""
        return _applied(self.map, points_mm)

    def at_rest_of(self, points_mm: torch.Tensor) -> torch.Tensor:
        """Points (B, ..., 3) mm, world frame now, in the organ's world frame at rest."""
        return _applied(self._inverse, points_mm)

    def directions_at_rest(self, directions: torch.Tensor) -> torch.Tensor:
        """Unit directions (B, ..., 3), world frame now, as unit directions at rest."""
        return _turned(self._inverse[:, :3, :3], directions)

    def normals(self, normals: torch.Tensor) -> torch.Tensor:
        """Unit normals (B, ..., 3) of the organ's surface at rest, as they are now."""
        return _turned(self._inverse[:, :3, :3].mT, normals)


def _applied(pose: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    flat = points.reshape(len(points), -1, 3).to(pose.dtype)
    moved = flat @ pose[:, :3, :3].mT + pose[:, None, :3, 3]
    return moved.reshape(points.shape).to(points.dtype)


def _turned(turn: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    flat = vectors.reshape(len(vectors), -1, 3).to(turn.dtype)
    turned = torch.nn.functional.normalize(flat @ turn.mT, dim=-1)
    return turned.reshape(vectors.shape).to(vectors.dtype)


def about(centre_mm: np.ndarray, linear: np.ndarray) -> np.ndarray:
    """(..., 4, 4): linear maps (..., 3, 3) about a centre (3,) mm."""
    found = np.zeros((*linear.shape[:-2], 4, 4))
    found[..., :3, :3] = linear
    found[..., :3, 3] = centre_mm - linear @ centre_mm
    found[..., 3, 3] = 1.0
    return found
