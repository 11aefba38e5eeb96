"""Small deflections of a bent, clamped beam through key points.

Euler-Bernoulli on the bent centreline r(s): a moment M(s) turns the cross-section by
theta(s) = C int_0^s M ds, and moves it by u(s) = int_0^s theta x dr (Love 1927, ch. XVIII, to first
order in the load). The compliance C = 1 / EI is taken to be the same in every direction. All
integrals are trapezoids over samples of the B-spline through the key points.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.interpolate import make_interp_spline
from torch import Tensor

CUTS = 4
"""Intervals of the centreline between two key points."""
BASE_SHARE = 0.02
"""A first key point farther from the base than this share of the length has a clamp below it."""


@dataclass(frozen=True)
class Beam:
    """Constant matrices of an arm's centreline, clamped at its base."""

    position: Tensor
    """(K, n) times key points gives K samples of the centreline, mm; row 0 is the clamp."""
    key: Tensor
    """(n,) sample of each key point."""
    length_mm: float
    """Length of the chords at rest, mm."""

    @classmethod
    def through(cls, rest_mm: Tensor) -> "Beam":
        """The beam of an arm whose key points at rest are rest_mm, (n, 3) mm, base frame.

        Where the lowest key point is not at the base, the clamp is at the frame's origin. A rest
        shape that is not known (zeros) counts as evenly spaced points of 1 mm.
        """
        rest = np.asarray(rest_mm.detach().cpu(), np.float64)
        n = len(rest)
        steps = np.linalg.norm(np.diff(rest, axis=0), axis=1)
        if not rest.any() or not (steps > 0).all():
            rest = np.arange(1.0, n + 1)[:, None] * np.array([0.0, 0.0, 1.0])
        clamped = n == 1 or np.linalg.norm(rest[0]) > BASE_SHARE * steps.sum()
        nodes = np.concatenate([np.zeros((1, 3)), rest]) if clamped else rest
        chords = np.linalg.norm(np.diff(nodes, axis=0), axis=1)
        knots = np.concatenate([[0.0], np.cumsum(chords)])
        cuts = knots[:-1, None] + chords[:, None] * np.arange(CUTS) / CUTS
        where = np.append(cuts.ravel(), knots[-1])
        spline = make_interp_spline(knots, np.eye(len(nodes)), k=min(3, len(nodes) - 1))
        position = torch.tensor(spline(where)[:, int(clamped) :], dtype=torch.float32)
        key = CUTS * (torch.arange(n) + int(clamped))
        return cls(position, key, float(chords.sum()))


def along(values: Tensor, steps: Tensor) -> Tensor:
    """(..., K, 3) integral from the clamp of values (..., K, 3) over steps (..., K-1, 1)."""
    middle = (values[..., 1:, :] + values[..., :-1, :]) / 2 * steps
    return torch.nn.functional.pad(middle.cumsum(-2), (0, 0, 1, 0))


def lengths(line: Tensor) -> Tensor:
    """(..., K-1, 1) lengths of the chords of a centreline (..., K, 3), mm."""
    return line.diff(dim=-2).norm(dim=-1, keepdim=True)


def displaced(line: Tensor, moment: Tensor) -> Tensor:
    """(..., K, 3) displacement of a centreline under moments (..., K, 3) times compliance, 1/mm."""
    turned = along(moment, lengths(line))
    middle = (turned[..., 1:, :] + turned[..., :-1, :]) / 2
    moved = torch.linalg.cross(middle, line.diff(dim=-2)).cumsum(-2)
    return torch.nn.functional.pad(moved, (0, 0, 1, 0))


def force_moment(line: Tensor, force: Tensor, sample: int = -1) -> Tensor:
    """(..., K, 3) moment of a force (3,) at one sample: (r_c - r) x F below it, none above."""
    force = force.expand(line.shape)
    moment = torch.linalg.cross(line[..., sample, None, :] - line, force)
    if sample == -1:
        return moment
    below = torch.arange(line.shape[-2], device=line.device) <= sample
    return moment * below.unsqueeze(-1)


def weight_moment(line: Tensor, weight: Tensor) -> Tensor:
    """(..., K, 3) moment of a load (3,) per mm over the whole line: int_s (r' - r) ds' x w."""
    steps = lengths(line)
    place, length = along(line, steps), along(torch.ones_like(line), steps)
    beyond = (place[..., -1:, :] - place) - line * (length[..., -1:, :] - length)
    return torch.linalg.cross(beyond, weight.expand(beyond.shape))
