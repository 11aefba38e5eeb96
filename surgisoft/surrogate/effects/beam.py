"""Small deflections of a bent, clamped beam through key points.

Euler-Bernoulli on the bent centreline r(s): a moment M(s) turns the cross-section by
theta(s) = C int_0^s M ds, and moves it by u(s) = int_0^s theta x dr (Love 1927, ch. XVIII, to first
order in the load). The compliance C = 1 / EI is the same in every direction, and s is the length
along the unloaded body, so that a stretched arm keeps its mass. The moment of a force is linear in
the centreline, the centreline in the key points: all integrals (trapezoids over samples of the
B-spline) are constant matrices times key points.
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.interpolate import make_interp_spline
from torch import Tensor, nn

CUTS = 4
"""Intervals of the centreline between two key points."""
BASE_SHARE = 0.02
"""A first key point farther from the base than this share of the length has a clamp below it."""


@dataclass(frozen=True)
class Beam:
    """Constant matrices of an arm that is clamped at its base; K intervals between samples.

    Key points as (..., 3, n) times one of the (n, K) matrices give vectors (..., 3, K) at the
    middles of the intervals.
    """

    chords: Tensor
    """(n, K) the intervals' chords dr, mm."""
    collect: Tensor
    """(K, n) sums what the intervals add into the key points."""
    levers: Tensor
    """(n, n, K) for a force at each key point c: int_0^s (r_c - r) ds', up to c, mm^2."""
    weights: Tensor
    """(n, K) for a load per length: int_0^s int_s'^L (r'' - r') ds'' ds', mm^3."""
    places: Tensor
    """(n, K) the centreline itself less its clamp, r - r(0), mm."""
    length_mm: float
    """Length L of the chords at rest, mm."""
    shares: tuple[float, ...]
    """(n,) share of the body that is nearest to each key point; what is nearest to the clamp counts
    for none."""

    @classmethod
    def through(cls, rest_mm: Tensor) -> "Beam":
        """The beam of an arm whose key points at rest are rest_mm, (n, 3) mm, base frame.

        Where the lowest key point is not at the base, the clamp is at the frame's origin. A rest
        shape that is not known (zeros) counts as evenly spaced points of 1 mm.
        """
        rest, below = shape_at_rest(rest_mm)
        n = len(rest)
        nodes = np.concatenate([np.zeros((int(below), 3)), rest])
        chords = np.linalg.norm(np.diff(nodes, axis=0), axis=1)
        knots = np.concatenate([[0.0], np.cumsum(chords)])
        cuts = knots[:-1, None] + chords[:, None] * np.arange(CUTS) / CUTS
        where = np.append(cuts.ravel(), knots[-1])
        spline = make_interp_spline(knots, np.eye(len(nodes)), k=min(3, len(nodes) - 1))
        position = spline(where)[:, below:]
        key = CUTS * (np.arange(n) + below)

        samples, ds = len(where), np.diff(where)
        up_to = np.tril(np.ones((samples, samples - 1)), -1)
        trapezoid = (np.eye(samples)[1:] + np.eye(samples)[:-1]) / 2
        integral = up_to @ (ds[:, None] * trapezoid)
        middle = trapezoid @ integral
        levers = []
        for end in key:
            ahead = position[end] - position
            # The force's moment ends at its point: the trapezoid's last value there is zero.
            levers.append(middle @ (ahead * (np.arange(samples) <= end)[:, None]))
        beyond = integral[-1] - integral
        weighed = beyond @ position - beyond.sum(1)[:, None] * position

        def matrix(values) -> Tensor:
            return torch.tensor(np.ascontiguousarray(values), dtype=torch.float32)

        return cls(
            matrix(np.diff(position, axis=0).T),
            matrix(up_to[key].T),
            matrix(np.stack([lever.T for lever in levers])),
            matrix((middle @ weighed).T),
            matrix((trapezoid @ (position - position[0])).T),
            float(knots[-1]),
            _shares(knots)[below:],
        )

    @property
    def tip_lever(self) -> Tensor:
        """(n, K) lever of a load at the tip for 1 mm of sag of the arm held straight and level."""
        return self.levers[-1] * (3 / self.length_mm**3)

    @property
    def body_lever(self) -> Tensor:
        """(n, K) the same of a load along the body."""
        return self.weights * (8 / self.length_mm**4)


def shape_at_rest(rest_mm: Tensor) -> tuple[np.ndarray, bool]:
    """((n, 3) key points at rest, mm, whether the clamp lies below the lowest one).

    rest_mm: (n, 3), mm, base frame; one that is not known (zeros) counts as evenly spaced points of
    1 mm. Where the lowest key point is not at the base, the clamp is at the frame's origin.
    """
    rest = np.asarray(rest_mm.detach().cpu(), np.float64)
    steps = np.linalg.norm(np.diff(rest, axis=0), axis=1)
    if not rest.any() or not (steps > 0).all():
        rest = np.arange(1.0, len(rest) + 1)[:, None] * np.array([0.0, 0.0, 1.0])
    below = len(rest) == 1 or np.linalg.norm(rest[0]) > BASE_SHARE * steps.sum()
    return rest, bool(below)


class Sagging(nn.Module):
    """Displacement of key points by the own weight of a body that sags by 1 mm at its tip when it
    is held straight and level."""

    down: Tensor
    lever: Tensor
    chords: Tensor
    collect: Tensor

    def __init__(self, rest_mm: Tensor, gravity: tuple[float, float, float]):
        """rest_mm: (n, 3) key points at rest, mm; gravity: unit vector; base frame."""
        super().__init__()
        beam = Beam.through(rest_mm)
        self.length_mm = beam.length_mm
        self.register_buffer("lever", beam.body_lever, persistent=False)
        self.register_buffer("chords", beam.chords, persistent=False)
        self.register_buffer("collect", beam.collect, persistent=False)
        self.register_buffer("down", torch.tensor(gravity).float().unsqueeze(-1), persistent=False)

    def forward(self, points: Tensor) -> Tensor:
        """(..., n, 3) displacement, mm, of key points (..., n, 3), mm."""
        p = points.mT.contiguous()
        return displaced(cross(p @ self.lever, self.down), p @ self.chords, self.collect)


def _shares(knots: np.ndarray) -> tuple[float, ...]:
    """Share of a body that is nearest to each of its nodes at the lengths knots, base to tip."""
    borders = np.concatenate([knots[:1], (knots[1:] + knots[:-1]) / 2, knots[-1:]])
    return tuple(float(part) for part in np.diff(borders) / knots[-1])


def cross(a: Tensor, b: Tensor) -> Tensor:
    """(..., 3, K) vector product of (..., 3, K), broadcast."""
    (a0, a1, a2), (b0, b1, b2) = a.unbind(-2), b.unbind(-2)
    return torch.stack([a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0], dim=-2)


def displaced(turned: Tensor, chords: Tensor, collect: Tensor) -> Tensor:
    """(..., n, 3) displacement of the key points, mm.

    turned: (..., 3, K) rotation of the intervals, rad; chords: (..., 3, K) mm.
    """
    return (cross(turned, chords) @ collect).mT
