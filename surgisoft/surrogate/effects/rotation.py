"""Rotations of points by rotation vectors, smooth through zero."""

import torch
from torch import Tensor


def _over(value: Tensor, small: Tensor, square: Tensor) -> Tensor:
    """`value` where the squared angle is not tiny, its series `small` elsewhere."""
    return torch.where(square > 1e-6, value, small)


def rotate(points: Tensor, vector: Tensor) -> Tensor:
    """Rotate points (..., 3) by rotation vectors (..., 3) in rad, broadcast (Rodrigues 1840).

    p + a (v x p) + b v x (v x p) with a = sin|v| / |v|, b = (1 - cos|v|) / |v|^2; differentiable
    at v = 0, where the points come back bit for bit.
    """
    square = vector.square().sum(-1, keepdim=True)
    angle = torch.where(square > 1e-6, square, torch.ones_like(square)).sqrt()
    first = _over(angle.sin() / angle, 1 - square / 6, square)
    second = _over((1 - angle.cos()) / angle.square(), 0.5 - square / 24, square)
    # Not torch.broadcast_shapes, which imports sympy at its first call: most of a second.
    vector, wide = torch.broadcast_tensors(vector, points)
    turned = torch.linalg.cross(vector, wide)
    return points + first * turned + second * torch.linalg.cross(vector, turned)
