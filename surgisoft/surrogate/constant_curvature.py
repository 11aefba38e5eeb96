"""Piecewise constant curvature: the conventional model that HAW-NN is measured against.

Each section is a circular arc whose curvature vector and stretch are linear in the actuation
(Webster & Jones 2010, "Design and kinematic modeling of constant curvature continuum robots",
eqs. 1-6); its few parameters and the pose of its base are fitted to the same data.
"""

import math

import torch
from torch import Tensor, nn

from surgisoft.errors import InputError
from surgisoft.surrogate.arm import centre_and_half


def _rotation(vector: Tensor) -> Tensor:
    """(..., 3, 3) rotation matrices from rotation vectors (..., 3) in rad (Rodrigues 1840)."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    return torch.linalg.matrix_exp(cross)


def arc_point(bend: Tensor, length: Tensor) -> Tensor:
    """End of an arc that starts at the origin along z.

    bend (..., 2) in rad is the arc's angle times its direction in x and y, length (...,) in mm;
    answer (..., 3) in mm: x, y = L (1 - cos a) / a^2 bend, z = L sin(a) / a.
    """
    square = bend.square().sum(-1)
    angle = (square + 1e-12).sqrt()
    across = 0.5 * torch.sinc(angle / (2 * math.pi)).square()
    along = torch.sinc(angle / math.pi)
    return torch.cat([(length * across)[..., None] * bend, (length * along)[..., None]], -1)


def arc_rotation(bend: Tensor) -> Tensor:
    """(..., 3, 3) rotation from the start to the end of an arc of bend (..., 2) rad, no twist."""
    x, y = bend.unbind(-1)
    return _rotation(torch.stack([-y, x, torch.zeros_like(x)], -1))


class ConstantCurvature(nn.Module):
    """Key points of a chain of constant-curvature arcs; ignores directions."""

    directions = False

    def __init__(self, low: Tensor, high: Tensor, key_points: int, sections: int = 0):
        """Pressure range (m,) in the arm's unit; `sections` 0 means one for every 3 chambers."""
        super().__init__()
        chambers = len(low)
        sections = sections or max(1, math.ceil(chambers / 3))
        if key_points < 2:
            raise InputError("constant curvature needs at least 2 key points; this arm has 1")
        self.key_points, self.sections = key_points, sections
        centre, half = centre_and_half(low, high)
        self.register_buffer("centre", centre)
        self.register_buffer("half_range", half)
        self.fraction = nn.Parameter(torch.linspace(0, 1, key_points))
        self.register_buffer("length", torch.ones(()))
        self.table = nn.Parameter(torch.zeros(sections, 3, chambers + 1))
        self.base_turn = nn.Parameter(torch.zeros(3))
        self.base_mm = nn.Parameter(torch.zeros(3))

    def set_rest(self, rest: Tensor) -> None:
        """Lengths from the key points at rest, (n, 3) in mm, base frame."""
        steps = rest.diff(dim=0).norm(dim=-1)
        if not float(steps.sum()) > 0:
            raise InputError("constant curvature: all key points coincide, expected a chain")
        self.length.copy_(steps.sum())
        self.fraction.data.copy_(torch.cat([steps.new_zeros(1), steps.cumsum(0)]) / steps.sum())
        self.base_mm.data.copy_(rest[0])

    def forward(self, pressure: Tensor, direction: Tensor) -> Tensor:
        """Key points (..., n, 3) in mm, base frame, from pressure (..., m)."""
        x = (pressure - self.centre) / self.half_range
        x = torch.cat([x, torch.ones_like(x[..., :1])], -1)
        values = torch.einsum("scm,...m->...sc", self.table, x)
        turn = _rotation(self.base_turn).expand(*x.shape[:-1], 3, 3)
        start = self.base_mm.expand(*x.shape[:-1], 3)
        points = [start] * self.key_points
        for section in range(self.sections):
            bend = values[..., section, :2]
            length = self.length / self.sections * values[..., section, 2].exp()
            for k in range(self.key_points):
                share = self.fraction[k] * self.sections - section
                last = section == self.sections - 1
                if (share >= 0 or section == 0) and (share < 1 or last):
                    local = arc_point(bend * share, length * share)
                    points[k] = start + (turn @ local[..., None])[..., 0]
            start = start + (turn @ arc_point(bend, length)[..., None])[..., 0]
            turn = turn @ arc_rotation(bend)
        return torch.stack(points, -2)
