"""Model errors of an arm: how its key points move if it differs from its model in some way.

Robots of one make differ in what was cast, glued and mounted: a chamber pushes more, a wall is
softer in one place, a marker plane sits elsewhere, the base is tilted. Each such difference has one
parameter, and moves all key points together, as in the calibration of rigid arms (Mooring, Roth &
Driels 1991). In first order the displacement is

    d = sum over c of J_c(x) dp_c(x)                     errors of the chambers' pushes
        + u + w x p                                      shift u and rotation w of the base
        + sum over k < j of (th_k x (p_j - m_k) + s_k)   segment k bends by th_k, stretches by s_k
        + R_j o                                          key plane j sits elsewhere in its own frame

for key point j, with J_c the steady-state Jacobian of the model (mm/kPa), x the loads of the
chambers (0 at rest, 1 at the end of the range), p the model's key points, and m_k the middle of
segment k between two of them. dp, th and s are functions of the loads with a constant and a linear
part; in addition, th has a part in proportion to the segment's own bending, and s one in proportion
to its own stretch. These are the kinematics of a discrete Cosserat rod (Renda et al. 2018) in first
order, with a segment between each two key points. The parameters are shared by all key points and
pressures: the default arm has 89, and a quadratic polynomial of the loads for each coordinate of
each key point has 150.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.scene import frames
from surgisoft.surrogate.backbone import Backbone
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.reach import steady_key_points

MOST_CROSSED = 4
"""Most chambers of which each may push by the load of another one (a count); arms with more have
errors of their own loads alone, so that the number of parameters stays small."""
DEGREE = 3
"""Degree of the polynomial of the loads that gives the Jacobian: of the default arm's Jacobian it
leaves 1.2 % (root mean square)."""
PROBE = 0.01
"""Half step of the Jacobian's central difference, as a share of a chamber's range."""
SAMPLES = 256
"""Least number of pressures, spread over the range of an arm, at which its Jacobian is taken."""


@dataclass(frozen=True)
class ErrorPrior:
    """How large model errors are expected to be, as standard deviations of the parameters.

    Orders of magnitude for arms that are cast and assembled by hand. The estimate hardly depends on
    them: half or twice of those of the pushes, of stretch and of the planes changed its error on
    robots 11 to 20 of the virtual rig by less than 1 %, that of the bending by up to 2 %.
    """

    push_kPa: float = 0.3
    """Constant error of a chamber's push, kPa."""
    push_share: float = 0.05
    """Error of a chamber's push that grows with the load of a chamber, as a share of the range."""
    shift_mm: float = 0.5
    """Shift of the base along each axis, mm."""
    turn_rad: float = 0.01
    """Rotation of the base about each axis, rad."""
    bend_share: float = 0.05
    """Error of a segment's bending and of its stretch, as a share of both."""
    bend_rad: float = 0.0075
    """Further bending of a segment about each axis across it: constant, and at full load of each
    chamber, rad."""
    stretch_share: float = 0.012
    """Further stretch of a segment as a share of its length: constant, and at full load."""
    plane_mm: float = 0.15
    """Place of a key plane along each axis of its own frame, mm."""

    def __post_init__(self):
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value > 0.0):
                raise InputError(f"arm errors: {name} is {value}, expected more than 0")


class ArmErrors:
    """Displacements of key points by model errors; holds constants only, batched, traceable."""

    def __init__(self, model: ArmModel, prior: ErrorPrior, device: str | torch.device = "cpu"):
        """model: the arm; pressures, and `prior.push_kPa`, are in the unit of the model."""
        self.prior, spec = prior, model.spec
        m, n = spec.chambers, spec.key_points
        self.chambers, self.points = m, n
        rest, low, high = (np.array(each) for each in (spec.rest, spec.low, spec.high))
        reach = np.maximum(high - rest, rest - low)
        reach = np.where(reach > 0.0, reach, 1.0)

        def tensor(values: np.ndarray) -> Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)

        self.rest, self.reach = tensor(rest), tensor(reach)
        powers = list(combinations_with_replacement(range(m + 1), DEGREE))
        self.powers = tuple(torch.tensor(row, device=device) for row in zip(*powers, strict=True))
        at, slopes = jacobians(model, max(SAMPLES, 4 * len(powers)))
        load = np.column_stack((np.ones(len(at)), (at - rest) / reach))
        terms = np.prod([load[:, list(row)] for row in zip(*powers, strict=True)], axis=0)
        flat = slopes.reshape(len(at), -1)
        self.slopes = tensor(np.linalg.lstsq(terms, flat, rcond=None)[0])
        pairs = [(c, c) for c in range(m)]
        if m <= MOST_CROSSED:
            pairs = [(c, other) for c in range(m) for other in range(m)]
        self.pushed, self.loaded = (
            torch.tensor(row, device=device) for row in zip(*pairs, strict=True)
        )
        body = torch.tensor(steady_key_points(model, rest[None])[0])
        self.based = n == 1
        """The base takes part as a key point before the only one, which has no segment else."""
        if self.based:
            body = torch.cat((torch.zeros_like(body), body))
        self.axes = torch.eye(3, device=device)
        self.tangents = Backbone.at_key_points(body).derivative.to(device)
        self.lengths = tensor(np.linalg.norm(np.diff(body.numpy(), axis=0), axis=1))
        beyond = np.tril(np.ones((len(body), len(body))), -1)[:, :-1]
        self.beyond = tensor(beyond)
        """(n, n - 1): 1 for key points beyond a segment; the base counts where it takes part."""
        body = body[-n:].to(dtype=torch.float32, device=device)
        self.count: int = self.displacements(self.rest[None], body[None]).shape[2]
        """Number F of parameters."""

    def displacements(self, pressure: Tensor, points_mm: Tensor) -> Tensor:
        """(B, 3 n, F) mm, base frame: displacement by one standard deviation of each parameter.

        pressure: (B, m) kPa; points_mm: (B, n, 3) mm, base frame: the model's key points.
        """
        load = (pressure - self.rest) / self.reach
        one = torch.cat((torch.ones_like(load[:, :1]), load), 1)
        parts = (self._pushes(load, one), self._mount(points_mm), *self._body(one, points_mm))
        return torch.cat([part.flatten(1, 2) for part in parts], 2)

    def _pushes(self, load: Tensor, one: Tensor) -> Tensor:
        """(B, n, 3, m + pairs) mm: constant and linear errors of the chambers' pushes."""
        a, b, c = self.powers
        slopes = (one[:, a] * one[:, b] * one[:, c]) @ self.slopes
        slopes = slopes.unflatten(1, (self.points, 3, self.chambers))
        share = self.prior.push_share * self.reach[self.pushed] * load[:, self.loaded]
        linear = slopes[..., self.pushed] * share[:, None, None]
        return torch.cat((self.prior.push_kPa * slopes, linear), 3)

    def _mount(self, points: Tensor) -> Tensor:
        """(B, n, 3, 6) mm: shifts and rotations of the base."""
        shift = self.prior.shift_mm * self.axes.expand(*points.shape[:2], 3, 3)
        turned = self.prior.turn_rad * frames.cross(self.axes, points[:, :, None])
        return torch.cat((shift, turned.mT), 3)

    def _body(self, one: Tensor, points: Tensor) -> list[Tensor]:
        """Errors of the segments, and of the key planes' places, each (B, n, 3, ...) mm."""
        prior = self.prior
        if self.based:
            points = torch.cat((torch.zeros_like(points), points), 1)
        tangent = frames.normalise(self.tangents @ points)
        across = self._across(tangent)
        chord = points[:, 1:] - points[:, :-1]
        middle = 0.5 * (points[:, 1:] + points[:, :-1])
        arm = points[:, :, None] - middle[:, None]
        length = frames.norm(chord)[..., None]
        bent = frames.cross(tangent[:, :-1], tangent[:, 1:])
        grown = chord * (1.0 - self.lengths[:, None] / length)
        own = torch.stack((frames.cross(bent[:, None], arm), grown[:, None].expand_as(arm)), 4)
        turns = [frames.cross(axis[:, None, :-1], arm) for axis in across]
        any_kind = torch.stack(
            (
                *(prior.bend_rad * turn for turn in turns),
                (prior.stretch_share * chord)[:, None].expand_as(arm),
            ),
            4,
        )
        loaded = any_kind[..., None] * one[:, None, None, None, None]
        kinds = torch.cat((prior.bend_share * own, loaded.flatten(4)), 4)
        segments = kinds * self.beyond[:, :, None, None]
        planes = torch.stack((*across, tangent), 3)
        rows = slice(1 if self.based else 0, None)
        return [segments[:, rows].movedim(2, 3).flatten(3), self._each_plane(planes[:, rows])]

    def _each_plane(self, planes: Tensor) -> Tensor:
        """(B, n, 3, 3 n) mm: shifts of each key point along the axes of its plane.

        planes: (B, n, 3, 3), the axes in columns.
        """
        own = torch.eye(self.points, device=planes.device)[:, None, :, None]
        return (self.prior.plane_mm * own * planes[:, :, :, None]).flatten(3)

    def _across(self, tangent: Tensor) -> tuple[Tensor, Tensor]:
        """Two unit vectors across each of the tangents (B, n, 3), carried along without twist.

        From key point to key point by the least rotation (parallel transport; Bishop 1975).
        """
        before = self.axes[2].expand_as(tangent[:, 0])
        first, rows = self.axes[0].expand_as(before), []
        for after in tangent.unbind(1):
            both = before + after
            share = frames.dot(first, after) / (1.0 + frames.dot(before, after)).clamp(min=1e-3)
            first, before = first - share[:, None] * both, after
            rows.append(first)
        one = frames.normalise(torch.stack(rows, 1))
        return one, frames.cross(tangent, one)


def jacobians(model: ArmModel, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Pressures (S, m) [kPa] spread over the range of an arm, and the steady-state Jacobian there.

    The Jacobian is (S, n, 3, m) mm/kPa, base frame, by central differences.
    """
    low, high = (np.array(each) for each in (model.spec.low, model.spec.high))
    m = model.spec.chambers
    share = torch.quasirandom.SobolEngine(m).draw(count).double().numpy()
    step = PROBE * np.where(high > low, high - low, 1.0)
    at = low + step + (high - low - 2.0 * step) * share
    slopes = []
    for probe in np.diag(step):
        ends = [steady_key_points(model, at + sign * probe) for sign in (1.0, -1.0)]
        slopes.append((ends[0] - ends[1]) / (2.0 * probe.sum()))
    return at, np.stack(slopes, -1)
