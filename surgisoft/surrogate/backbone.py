"""The whole body of an arm from its key points.

Through two key points and more it is a B-spline (Chen et al. 2025, sec. III-A). The parameters of
the key points are fixed (their share of the chord length at rest), so that the spline's values and
derivatives are a constant matrix times the key points, whatever the batch.

An arm with one key point, its tip, is an arc of constant curvature that leaves the base along z
(Webster & Jones 2010): base, tangent at the base and tip determine it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.interpolate import make_interp_spline
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.surrogate.arm import ArmSpec

STRAIGHT_RAD = 1e-3
"""Angle between chord and base axis below which an arc counts as straight, rad: points between base
and tip then differ by less than 1e-7 of its length."""
LEAST_SINE = 1e-6
"""Least sine of that angle in a division: a tip behind the base on its axis has no arc."""
TIP_TASKS = ("track_circle", "track_square", "track_body")
"""Tasks of the key points alone, which take every arm; all others need its body."""
MOST_LEAN_RAD = math.radians(30.0)
"""Angle between the base axis and the line from the base to the tip at rest, above which the frame
is not that of the base: `import` asks to check the frame from the same angle on."""
MOST_OFF_LENGTH = 0.2
"""Largest relative difference between the stated length of an arm and its arc at rest: markers may
be before or behind the end of the body."""
MOST_CHAMBERS = 4
"""Chambers or tendons of an arm of one segment: three, or two pairs. An arm with more has several
segments, which bend apart from each other."""


@dataclass(frozen=True)
class Backbone:
    """Constant matrices of an interpolating B-spline (de Boor 1978, ch. XIII).

    Its methods take the pose of the base for the sake of `ArcBackbone` and do not need it.
    """

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

    def centreline(self, key_points: Tensor, base: Tensor | None = None) -> Tensor:
        """(..., K, 3) points in mm from key points (..., n, 3) in mm, same frame."""
        return _weighted(self.position, key_points)

    def tangents(self, key_points: Tensor) -> Tensor:
        """(..., K, 3) unit tangents, base to tip, from key points (..., n, 3) in mm."""
        return torch.nn.functional.normalize(_weighted(self.derivative, key_points), dim=-1)

    def tip_direction(self, key_points: Tensor, base: Tensor | None = None) -> Tensor:
        """(..., 3) unit tangent at the tip from key points (..., n, 3) in mm."""
        last = _weighted(self.derivative[-1:], key_points)[..., 0, :]
        return torch.nn.functional.normalize(last, dim=-1)


FEW_POINTS = 8
"""Up to so many key points an accelerator sums in place of multiplying by a matrix. With the five
of the default arm, and with sums in `frames.apply`, a step on an H200 took 0.8 in place of 1.0 ms
(docs/results/speed.md); no other number was measured."""


def _weighted(weights: Tensor, key_points: Tensor) -> Tensor:
    """(..., K, 3): key points (..., n, 3) weighted by (K, n)."""
    count = weights.shape[1]
    if key_points.device.type == "cpu" or count > FEW_POINTS:
        return weights @ key_points
    total = weights[:, :1] * key_points[..., :1, :]
    for k in range(1, count):
        total = torch.addcmul(total, weights[:, k : k + 1], key_points[..., k : k + 1, :])
    return total


@dataclass(frozen=True)
class ArcBackbone:
    """An arc of constant curvature from the base to the tip, the only key point.

    With the chord d from base to tip, its length c and its angle a to the axis z of the base, the
    arc turns by 2 a, and its point at the share s of its length is (Webster & Jones 2010)

        r(s) = c f(s) f(1 - s) z + f(s)^2 d,    f(s) = sin(s a) / sin(a).

    base: (..., 4, 4) pose of the base in the frame of the key points; None: the base frame itself.
    """

    share: Tensor
    """(K,) float32: places of the samples on the arc, as shares of its length."""

    @classmethod
    def of(cls, samples: int = 21) -> "ArcBackbone":
        """An arc that is sampled at so many points, base and tip included."""
        return cls(torch.linspace(0.0, 1.0, samples))

    def to(self, device: str | torch.device) -> "ArcBackbone":
        """Copy of the backbone on another device."""
        return ArcBackbone(self.share.to(device))

    def centreline(self, key_points: Tensor, base: Tensor | None = None) -> Tensor:
        """(..., K, 3) points in mm from the key point (..., 1, 3) in mm, same frame."""
        origin, axis, chord = _chord(key_points, base)
        length = torch.linalg.vector_norm(chord, dim=-1, keepdim=True)
        angle = _half_turn(axis, chord, length)
        straight = angle < STRAIGHT_RAD
        bent = torch.where(straight, torch.ones_like(angle), angle)
        sine = bent.sin().clamp(min=LEAST_SINE)

        def part(share: Tensor) -> Tensor:
            return torch.where(straight, share, (share * bent).sin() / sine)[..., None]

        done, left = part(self.share), part(1.0 - self.share)
        along = (length[..., None] * done * left) * axis[..., None, :]
        return origin[..., None, :] + along + done.square() * chord[..., None, :]

    def tip_direction(self, key_points: Tensor, base: Tensor | None = None) -> Tensor:
        """(..., 3) unit tangent at the tip: the axis of the base mirrored at the chord."""
        _, axis, chord = _chord(key_points, base)
        chord = torch.nn.functional.normalize(chord, dim=-1)
        return 2.0 * (axis * chord).sum(-1, keepdim=True) * chord - axis


def _chord(key_points: Tensor, base: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
    """Base (..., 3) mm, its unit axis (..., 3) and the chord (..., 3) mm to the tip."""
    tip = key_points[..., -1, :]
    if base is None:
        base = torch.eye(4, dtype=tip.dtype, device=tip.device)
    origin, axis = base[..., :3, 3], base[..., :3, 2]
    return origin, axis, tip - origin


def _half_turn(axis: Tensor, chord: Tensor, length: Tensor) -> Tensor:
    """(..., 1) rad: angle between chord (..., 3) and axis (..., 3), half of what the arc turns by.

    tan(a / 2) = sin(a) / (1 + cos(a)) keeps its digits where the arc is nearly straight.
    """
    along = (chord * axis).sum(-1, keepdim=True)
    aside = torch.linalg.vector_norm(chord - along * axis, dim=-1, keepdim=True)
    return 2.0 * (aside / (length + along).clamp(min=1e-12)).atan()


def require_body(spec: ArmSpec, rest_mm: Tensor, label: str) -> None:
    """Raise InputError where the body of an arm does not follow from its key points.

    Two key points and more have a body. A single one has an arc, where it is the tip of one
    segment in a frame whose origin is the base and whose z points along the arm at rest.

    rest_mm: (n, 3) key points at rest, mm, base frame; label: the arm, for the message.
    """
    if spec.key_points != 1:
        return
    reason, advice = None, "correct the frame of the recordings (origin at the base, z along it)"
    x, y, z = (float(value) for value in rest_mm[-1])
    lean = math.atan2(math.hypot(x, y), z)
    length = math.hypot(x, y, z) * (lean / math.sin(lean) if lean > STRAIGHT_RAD else 1.0)
    if spec.chambers > MOST_CHAMBERS:
        reason = f"has {spec.chambers} chambers, several segments with one key point in all"
        advice = "measure at least the end of each segment"
    elif not lean <= MOST_LEAN_RAD:
        reason = (
            f"has its only key point {math.degrees(lean):.0f} degrees from the z axis at rest, "
            f"expected at most {math.degrees(MOST_LEAN_RAD):.0f}"
        )
    elif spec.length_mm is not None and abs(length / spec.length_mm - 1.0) > MOST_OFF_LENGTH:
        reason = (
            f"states a length of {spec.length_mm:g} mm, and the arc from the origin to its only "
            f"key point at rest has {length:.3g} mm"
        )
    if reason is not None:
        raise InputError(
            f"{label} {reason}: its body does not follow from its tip; {advice}, or take a task "
            f"of the tip: {', '.join(TIP_TASKS[:-1])} or {TIP_TASKS[-1]}"
        )
