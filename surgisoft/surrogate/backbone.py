"""The whole body as a B-spline through its key points (Chen et al. 2025, sec. III-A).

The parameters of the key points are fixed (their share of the chord length at rest), so that the
spline's values and derivatives are a constant matrix times the key points, whatever the batch.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.interpolate import make_interp_spline
from torch import Tensor

from surgisoft.errors import InputError


@dataclass(frozen=True)
class Backbone:
    """Constant matrices of an interpolating B-spline (de Boor 1978, ch. XIII)."""

    position: Tensor
    """(K, n) float32: times key points (..., n, 3) gives K centreline points, mm."""
    derivative: Tensor
    """(K, n) float32: times key points gives the derivative by the spline's parameter, mm."""

    @classmethod
    def through(cls, rest_mm: Tensor, samples: int = 21, degree: int = 3) -> "Backbone":
        """A backbone for an arm whose key points at rest are `rest_mm`, (n, 3) in mm."""
        where = np.linspace(0.0, 1.0, samples)
        return cls._at(rest_mm, degree, lambda _: where)

    @classmethod
    def at_key_points(cls, rest_mm: Tensor, degree: int = 3) -> "Backbone":
        """The same backbone, sampled at the n key points themselves (K = n)."""
        return cls._at(rest_mm, degree, lambda knots: knots)

    @classmethod
    def _at(
        cls, rest_mm: Tensor, degree: int, where: Callable[[np.ndarray], np.ndarray]
    ) -> "Backbone":
        """A backbone that is sampled where a function of the key points' parameters (n,) says."""
        rest = np.asarray(rest_mm.detach().cpu(), dtype=np.float64)
        if len(rest) < 2:
            raise InputError(
                f"backbone: {len(rest)} key point given, expected at least 2 to draw a body"
            )
        steps = np.linalg.norm(np.diff(rest, axis=0), axis=1)
        if not (steps > 0).all():
            raise InputError("backbone: two key points coincide at rest, expected a proper chain")
        knots = np.concatenate([[0.0], np.cumsum(steps)]) / steps.sum()
        spline = make_interp_spline(knots, np.eye(len(rest)), k=min(degree, len(rest) - 1))
        at = where(knots)
        return cls(
            torch.tensor(spline(at), dtype=torch.float32),
            torch.tensor(spline.derivative()(at), dtype=torch.float32),
        )

    def to(self, device: str | torch.device) -> "Backbone":
        """Copy of the backbone on another device."""
        return Backbone(self.position.to(device), self.derivative.to(device))

    def centreline(self, key_points: Tensor) -> Tensor:
        """(..., K, 3) points in mm from key points (..., n, 3) in mm, same frame."""
        return self.position @ key_points

    def tangents(self, key_points: Tensor) -> Tensor:
        """(..., K, 3) unit tangents, base to tip, from key points (..., n, 3) in mm."""
        return torch.nn.functional.normalize(self.derivative @ key_points, dim=-1)

    def tip_direction(self, key_points: Tensor) -> Tensor:
        """(..., 3) unit tangent at the tip from key points (..., n, 3) in mm."""
        return torch.nn.functional.normalize(self.derivative[-1] @ key_points, dim=-1)
