"""Closed plane paths of unit size that are followed at even speed."""

import math
from collections.abc import Callable

import torch
from torch import Tensor


def circle(share: Tensor) -> Tensor:
    """(..., 2): the circle of diameter 1 about the origin, at shares (...) of its length."""
    turn = 2.0 * math.pi * share
    return 0.5 * torch.stack((turn.cos(), turn.sin()), -1)


def square(share: Tensor) -> Tensor:
    """(..., 2): the square of edge 1 about the origin, from its right edge's middle upwards."""
    edges = 4.0 * share + 0.5
    return torch.stack((_trapezoid(edges - 0.5), _trapezoid(edges - 1.5)), -1)


def _trapezoid(place: Tensor) -> Tensor:
    """0.5 within 0.5 of 0, -0.5 within 0.5 of 2, straight lines between; period 4."""
    return ((place.remainder(4.0) - 2.0).abs() - 1.0).clamp(-0.5, 0.5)


PATHS: dict[str, Callable[[Tensor], Tensor]] = {"circle": circle, "square": square}
"""Every path by name."""
