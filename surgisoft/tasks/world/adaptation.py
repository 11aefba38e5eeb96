"""Online adaptation: what an arm's model gets wrong is learned while the arm moves.

The key points differ from the model's by a disturbance, because the arm is another robot, has
aged, carries something, or is held otherwise. Cameras measure the disturbance with noise, and the
direction of the tip, which a beam follows over tens of millimetres, amplifies the noise of single
key points tenfold. A filter with one gain for all key points (`observer.AlphaBetaFilter`) has to
choose between noise and lag. Here the disturbance is

    d = W (1, x, x x') + G (z - y) + r,    x = 0 at rest and 1 at the end of the range,

a quadratic function of the chambers' loads x, motion that comes late, and a transient r, a
first-order Gauss-Markov process. y is the body of the model, and z the same body behind the lags
`LAGS`: G is the share of the motion that comes late, in a viscous wall or a long line. W and G are
learned. How large transients are differs from arm to arm: their variance follows the innovations
(innovation-based adaptive estimation; Mehra 1970; Mohamed & Schwarz 1999), from quiet arms, whose
estimate is then nearly free of noise, to arms that stick and slip. d is
resolved into orthogonal shapes of the whole body, the eigenvectors of the covariance that
transients have: pushes of the chambers and motions of the base, which the arm's own model provides,
have few shapes, and noise has all. For each shape a Kalman filter (Kalman 1960) estimates its row
of W and G and its transient from one scalar a step: recursive least squares with forgetting (Ljung
1999, sec. 11.2) in which the noise of implausible shapes hardly enters. A constant disturbance of
any shape is learned without a remaining error, because W has a constant term for each shape.

The disturbance of the output is what offset-free model predictive control estimates (Pannocchia &
Rawlings 2003). A controller that takes back at once what it sees of the disturbance swings where
most of the motion comes late: it corrects again what is on its way already. Where the late share is
large, controllers therefore see G (z - y) + r behind a first-order filter, the robustness filter of
internal model control (Garcia & Morari 1982). Tensors have the batch in front; the base frame is
that of the arm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.reach import steady_key_points

USUAL = 0.1
"""Distance of the body, as a share of its range, at which the time constant of a lag is stated."""


@dataclass(frozen=True)
class Lag:
    """A lag of the whole body whose speed grows with the distance left, as in a thinning fluid.

    z' = (y - z) / tau (1 + |y - z| / turn) / (1 + `USUAL` / turn): below `turn` the lag of Newton's
    fluid, above it the force goes with the root of the rate, as for the effects
    `rate_dependence` (Ellis' fluid) and, nearly, `line_lag` (turbulent flow).
    """

    tau_s: float
    """Time constant at a distance of `USUAL`, s."""
    turn: float
    """Distance below which the time constant no longer grows, as a share of the body's range."""


LAGS = (Lag(0.05, 0.01), Lag(0.3, 0.01))
"""Lags whose shares are learned; between them, and slower for small motions, lie those of walls and
lines. A third one of 0.8 s took up creep and friction. Chosen on robots 11 to 18 of the virtual
rig."""
MOST_PRODUCTS = 10
"""Most products of two loads among the regressors (a count): all of up to four chambers. Arms with
more chambers have the squares alone, so that the filter's covariance stays small."""
SAMPLES = 256
"""Pressures, spread over the range of an arm, at which its Jacobian is taken (a count)."""
PROBE = 0.01
"""Half step of that central difference, as a share of a chamber's range."""


@dataclass(frozen=True)
class AdaptationPrior:
    """How large disturbances are expected to be, as standard deviations.

    The values were chosen on robots 0 to 20 of the virtual rig, on robots 11 to 20 with hidden
    lags, friction, breath and a valve that sticks, too. With less than 0.3 kPa the error without a
    hidden effect falls by a further 2 %, but the estimate lags by more behind a valve that comes
    free. `benchmarks/robust.py` judges on other robots.
    """

    noise_mm: float = 0.08
    """Noise of a measured coordinate, mm, as white noise of a step that has the same power at low
    frequencies: cameras with 0.03 mm of white and 0.03 mm of slow noise (0.4 s) have this."""
    constant_mm: float = 0.17
    """A constant disturbance of any shape, each coordinate, mm."""
    gain_share: float = 0.01
    """Relative error of a chamber's push, which grows with the loads."""
    slope_mm: float = 0.4
    """Further disturbance of any shape that grows with the loads, mm at full load."""
    curve_mm: float = 0.15
    """Further disturbance of any shape that grows with products of loads, mm at full load."""
    chambers_kPa: float = 0.3
    """Transient error of a chamber's push (friction, creep, a line), kPa."""
    shift_mm: float = 0.5
    """Transient shift of the base along each axis, mm."""
    turn_rad: float = 0.0025
    """Transient rotation of the base about each axis, rad."""
    rest_mm: float = 0.0063
    """Transient disturbance of any other shape, mm."""
    transient_s: float = 6.0
    """Correlation time of transients, s."""
    quietest: float = 0.4
    """Least variance of an arm's transients, as a share of that which the fields above give."""
    liveliest: float = 8.0
    """Largest variance of an arm's transients, as a share of the same."""
    unrest_s: float = 40.0
    """Time in which that variance grows by a factor e while innovations are twice as strong as
    expected, s; with none at all it falls as quickly."""
    innovation: float = 0.25
    """Expected mean square of an innovation over its predicted variance, no unit: less than 1,
    because `noise_mm` is larger than the noise of one picture."""
    startling: float = 4.0
    """Largest such mean square that counts, no unit: a step of pressure is one startling moment."""
    memory_s: float = 12000.0
    """Time in which W may change by its own standard deviation, s."""
    late_share: float = 0.5
    """Share of the body's motion that comes late by each of the lags `LAGS`, no unit."""
    late_memory_s: float = 300.0
    """Time in which those shares may change by their own standard deviation, s."""
    filter_s: float = 0.5
    """Time constant of the filter through which controllers see the disturbance where all motion
    comes late, s; it falls to 0 at a late share of a half, where the first response is as large
    as what follows. With 0.3 s a viscous wall still swings, with 0.8 s beams trail behind (robots
    11 to 18 of the virtual rig)."""

    def __post_init__(self):
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value > 0.0):
                raise InputError(f"adaptation: {name} is {value}, expected more than 0")


@dataclass(frozen=True, eq=False)
class Adaptation:
    """What was learned of B arms; D = 3 n shapes, K lags, Q products of loads, k = m + Q + K + 2
    coefficients of each.

    The coefficients are in units of their prior standard deviations, which keeps float32 exact
    enough.
    """

    mean: Tensor
    """(B, D, k): constant, slope by the load of each chamber and by each product of loads, share of
    each lag, and transient of each shape."""
    covariance: Tensor
    """(B, D, k, k): covariance of their errors; the unit matrix before the first measurement."""
    behind_mm: Tensor
    """(B, K, D) mm: the model's body behind each lag, in shapes."""
    unrest: Tensor
    """(B,): variance of transients as a share of the prior's."""
    shown_mm: Tensor
    """(B, D) mm: late motion and transient as controllers see them, in shapes."""


class Estimate(NamedTuple):
    """What follows from a measurement of B arms."""

    memory: Adaptation
    """What is known then, as of the next step: transients have decayed, and W and G may have
    changed."""
    now_mm: Tensor
    """(B, n, 3) mm, base frame: the disturbance."""
    lead_mm: Tensor
    """(B, n, 3) mm, base frame: what controllers are shown beyond that."""


class DisturbanceEstimator:
    """Learns the disturbance of an arm's key points; holds constants only, batched, traceable."""

    def __init__(
        self,
        model: ArmModel,
        dt_s: float,
        prior: AdaptationPrior | None = None,
        device: str | torch.device = "cpu",
    ):
        """model: the arm; dt_s: time between two updates, s. Pressures, and `prior.chambers_kPa`,
        are in the unit of the model, which is kPa unless it says otherwise."""
        self.prior = prior = prior or AdaptationPrior()
        spec = model.spec
        rest, low, high = (np.array(each) for each in (spec.rest, spec.low, spec.high))
        reach = np.maximum(high - rest, rest - low)
        reach = np.where(reach > 0.0, reach, 1.0)
        pushes, shifts, turns = _covariances(model, low, high)
        size, m, lags = len(pushes), spec.chambers, len(LAGS)
        pairs = list(combinations_with_replacement(range(m), 2))
        pairs = pairs if len(pairs) <= MOST_PRODUCTS else [(c, c) for c in range(m)]
        self.pairs = tuple(torch.tensor(row, device=device) for row in zip(*pairs, strict=True))
        steady = 1 + m + len(pairs)
        transient = (
            prior.chambers_kPa**2 * pushes
            + prior.shift_mm**2 * shifts
            + prior.turn_rad**2 * turns
            + prior.rest_mm**2 * np.eye(size)
        )
        variance, shapes = np.linalg.eigh(transient)
        gain_mm2 = np.einsum("ij,jk,ki->i", shapes.T, pushes, shapes)
        kPa = prior.gain_share * reach
        first = np.empty((size, steady + lags + 1))
        first[:, 0] = prior.constant_mm**2
        first[:, 1 : m + 1] = prior.slope_mm**2 + gain_mm2[:, None] * kPa**2
        products = np.array([kPa[a] * kPa[b] for a, b in pairs])
        first[:, m + 1 : steady] = prior.curve_mm**2 + gain_mm2[:, None] * products
        first[:, steady:-1] = prior.late_share**2
        first[:, -1] = variance
        keep = np.ones(first.shape[1])
        keep[-1] = math.exp(-dt_s / prior.transient_s)
        grows = np.full(first.shape[1], dt_s / prior.memory_s)
        grows[steady:-1] = dt_s / prior.late_memory_s
        grows[-1] = 0.0
        stirs = np.zeros(first.shape[1])
        stirs[-1] = 1.0 - keep[-1] ** 2
        tau_s, turn = np.array([(lag.tau_s, lag.turn) for lag in LAGS]).T

        def tensor(values: np.ndarray) -> Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)

        self.shapes, self.rest, self.reach = tensor(shapes), tensor(rest), tensor(reach)
        self.deviation, self.keep = tensor(np.sqrt(first)), tensor(keep)
        self.kept, self.growth = self.keep[:, None] * self.keep, torch.diag(tensor(grows))
        self.stirs = torch.diag(tensor(stirs))
        self.dt_s, self.steady, self.late = dt_s, steady, slice(steady, steady + lags)
        self.moving = slice(-(m + 3), None)
        """The shapes that transients have most: pushes of the chambers and shifts of the base."""
        self.left = tensor(np.exp(-dt_s / tau_s / (1.0 + USUAL / turn)))[:, None]
        self.turn_mm = tensor(turn * _range_mm(model, low, high))[:, None]
        self.rest_mm = tensor(steady_key_points(model, rest[None]).reshape(1, -1)) @ self.shapes

    def start(self, count: int) -> Adaptation:
        """Memory of `count` arms at rest of which nothing was measured yet."""
        size, k = self.deviation.shape
        covariance = torch.eye(k, device=self.keep.device).expand(count, size, k, k).clone()
        behind = self.rest_mm.expand(count, len(LAGS), size).clone()
        mean, shown = torch.zeros_like(covariance[..., 0]), torch.zeros_like(behind[:, 0])
        return Adaptation(mean, covariance, behind, torch.ones_like(shown[:, 0]), shown)

    def expected(self, memory: Adaptation, pressure: Tensor) -> Tensor:
        """(B, n, 3) mm, base frame: the disturbance that controllers expect at (B, m) kPa."""
        some = slice(0, self.steady)
        known = memory.mean[..., some] * self._loads(pressure) * self.deviation[:, some]
        transient = memory.mean[..., -1] * self.deviation[:, -1]
        decayed = (1.0 / self.keep[-1] - 1.0) * transient
        return self._body(known.sum(2) + memory.shown_mm - decayed)

    def updated(
        self,
        memory: Adaptation,
        off_mm: Tensor,
        pressure: Tensor,
        points_mm: Tensor,
        samples: int = 1,
        settled: bool = False,
    ) -> Estimate:
        """What is known after a measurement.

        off_mm: (B, n, 3) mm, base frame: measured key points less the model's, nan where one was
        lost; the expected disturbance stands in for it. pressure: (B, m) kPa. points_mm:
        (B, n, 3) mm, base frame: the model's key points. samples: number of measurements at these
        pressures whose mean `off_mm` is. settled: whether the arm has stood there so long that
        nothing comes late any more.
        """
        body = points_mm.flatten(1) @ self.shapes
        gap = self._gap(memory.behind_mm - body[:, None])
        gap = torch.zeros_like(gap) if settled else gap
        inputs = self._inputs(pressure, gap)
        expected = self._body((memory.mean * inputs).sum(2))
        surprise = torch.where(off_mm.isfinite(), off_mm - expected, torch.zeros_like(expected))
        scalar = surprise.flatten(1) @ self.shapes
        across = (memory.covariance * inputs[:, :, None]).sum(3)
        noise = self.prior.noise_mm**2 / samples
        power = (across * inputs).sum(2) + noise
        unrest = self._unrest(memory.unrest, scalar, power)
        gain = across / power[..., None]
        mean = memory.mean + gain * scalar[..., None]
        covariance = memory.covariance - gain[..., None] * across[:, :, None]
        # Joseph's form: 0 but for the rounding, which large motions would let grow.
        rounding = noise * gain - (covariance * inputs[:, :, None]).sum(3)
        covariance = covariance + rounding[..., None] * gain[:, :, None]
        terms = mean * inputs
        passing = terms[..., self.steady :].sum(2)
        adopts = self._adopts(mean, covariance)
        shown = memory.shown_mm + adopts * (passing - memory.shown_mm)
        grown = self.growth + unrest[:, None, None, None] * self.stirs
        after = Adaptation(
            mean * self.keep, covariance * self.kept + grown, gap + body[:, None], unrest, shown
        )
        return Estimate(after, self._body(terms.sum(2)), self._body(shown - passing))

    def late_share(self, mean: Tensor, covariance: Tensor) -> Tensor:
        """(B,): share of the body's motion that comes late by all lags together.

        The mean over the shapes, each weighted by the inverse variance of its own share. mean,
        covariance: as those of `Adaptation`.
        """
        scale = self.deviation[:, self.late]
        share = (mean[..., self.late] * scale).sum(2)
        spread = covariance[..., self.late, self.late] * scale[:, :, None] * scale[:, None]
        weight = 1.0 / spread.sum((2, 3))
        return (share * weight).sum(1) / weight.sum(1)

    def _unrest(self, unrest: Tensor, scalar: Tensor, power: Tensor) -> Tensor:
        """(B,): variance of transients after innovations (B, D) mm of predicted variance `power`.

        Covariance matching: the logarithm integrates by how much innovations are stronger than
        expected, so that it rests where they are as expected.
        """
        prior, some = self.prior, (..., self.moving)
        strength = (scalar[some].square() / power[some]).mean(1).clamp(max=prior.startling)
        beyond = strength / prior.innovation - 1.0
        changed = unrest * torch.exp(self.dt_s / prior.unrest_s * beyond)
        return changed.clamp(prior.quietest, prior.liveliest)

    def _adopts(self, mean: Tensor, covariance: Tensor) -> Tensor:
        """(B, 1): share of a new disturbance that controllers are shown in this step."""
        beyond = (2.0 * self.late_share(mean, covariance) - 1.0).clamp(0.0, 1.0)[:, None]
        time_s = (self.prior.filter_s * beyond).clamp(min=1e-3 * self.dt_s)
        return 1.0 - torch.exp(-self.dt_s / time_s)

    def _gap(self, gap: Tensor) -> Tensor:
        """(B, K, D) mm: what a step leaves of the distances behind the body, by `Lag`, exactly."""
        size = gap.norm(dim=2, keepdim=True)
        return gap * self.left / (1.0 + (1.0 - self.left) * size / self.turn_mm)

    def _loads(self, pressure: Tensor) -> Tensor:
        """(B, 1, 1 + m + Q): 1, the loads of the chambers, and products of two loads."""
        load = (pressure - self.rest) / self.reach
        products = load[:, self.pairs[0]] * load[:, self.pairs[1]]
        return torch.cat((torch.ones_like(load[:, :1]), load, products), 1)[:, None]

    def _inputs(self, pressure: Tensor, gap: Tensor) -> Tensor:
        """(B, D, k) mm: what the coefficients are multiplied with; gap: (B, K, D) mm."""
        gap = gap.mT
        load = self._loads(pressure).expand(-1, gap.shape[1], -1)
        return torch.cat((load, gap, torch.ones_like(gap[..., :1])), 2) * self.deviation

    def _body(self, shares: Tensor) -> Tensor:
        """(B, n, 3) mm, base frame, of shares (B, D) of the shapes."""
        return (shares @ self.shapes.mT).unflatten(1, (-1, 3))


def _covariances(
    model: ArmModel, low: np.ndarray, high: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Second moments (D, D) of the key points' displacements, means over the range of the arm.

    By independent pushes of the chambers (mm^2/kPa^2), by shifts of the base (no unit) and by its
    rotations (mm^2/rad^2), each of standard deviation 1.
    """
    m = model.spec.chambers
    share = torch.quasirandom.SobolEngine(m).draw(SAMPLES).double().numpy()
    step = PROBE * np.where(high > low, high - low, 1.0)
    at = low + step + (high - low - 2.0 * step) * share
    slopes = []
    for chamber in range(m):
        probe = np.zeros(m)
        probe[chamber] = step[chamber]
        ends = [steady_key_points(model, at + sign * probe) for sign in (1.0, -1.0)]
        slopes.append((ends[0] - ends[1]) / (2.0 * step[chamber]))
    points = steady_key_points(model, at)
    shifts, turns = [], []
    for axis in np.eye(3):
        shifts.append(np.broadcast_to(axis, points.shape))
        turns.append(np.cross(axis, points))
    return _moment(slopes), _moment(shifts), _moment(turns)


def _range_mm(model: ArmModel, low: np.ndarray, high: np.ndarray) -> float:
    """Largest distance of the body from its mean over the range of the arm, mm.

    The root of the sum over the key points of their squared distances.
    """
    share = torch.quasirandom.SobolEngine(model.spec.chambers).draw(SAMPLES).double().numpy()
    points = steady_key_points(model, low + (high - low) * share)
    off = (points - points.mean(0)).reshape(SAMPLES, -1)
    return float(np.linalg.norm(off, axis=1).max())


def _moment(displacements: list[np.ndarray]) -> np.ndarray:
    """(D, D): sum over kinds, mean over samples, of displacements (S, n, 3) of each kind."""
    rows = np.stack(displacements).reshape(len(displacements), len(displacements[0]), -1)
    return np.einsum("ksi,ksj->ij", rows, rows) / rows.shape[1]
