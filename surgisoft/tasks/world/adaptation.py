"""Online adaptation: what an arm's model gets wrong is learned while the arm moves.

The key points differ from the model's by a disturbance, because the arm is another robot, has
aged, carries something, or is held otherwise. Cameras measure the disturbance with noise, and the
direction of the tip, which a beam follows over tens of millimetres, amplifies the noise of single
key points tenfold. A filter with one gain for all key points (`observer.AlphaBetaFilter`) has to
choose between noise and lag. Here the disturbance is a linear function of the chambers' loads x,

    d = W (1, x) + r,    x = 0 at rest and 1 at the end of the range,

whose coefficients W are learned, and a transient r, a first-order Gauss-Markov process. d is
resolved into orthogonal shapes of the whole body, the eigenvectors of the covariance that
transients have: pushes of the chambers and motions of the base, which the arm's own model provides,
have few shapes, and noise has all. For each shape a Kalman filter (Kalman 1960) estimates its row
of W and its transient from one scalar a step: recursive least squares with forgetting (Ljung 1999,
sec. 11.2) in which the noise of implausible shapes hardly enters. A constant disturbance of any
shape is learned without a remaining error, because W has a constant term for each shape.

The disturbance of the output is what offset-free model predictive control estimates (Pannocchia &
Rawlings 2003). Tensors have the batch in front; the base frame is that of the arm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.reach import steady_key_points

SAMPLES = 256
"""Pressures, spread over the range of an arm, at which its Jacobian is taken (a count)."""
PROBE = 0.01
"""Half step of that central difference, as a share of a chamber's range."""


@dataclass(frozen=True)
class AdaptationPrior:
    """How large disturbances are expected to be, as standard deviations.

    The values were chosen on robots 0 to 6 of the virtual rig, with each hidden effect on robots 0
    and 6; the error of the estimate grows by at most 15 % where any of them is halved or
    doubled. `benchmarks/robust.py` judges on other robots.
    """

    noise_mm: float = 0.08
    """Noise of a measured coordinate, mm, as white noise of a step that has the same power at low
    frequencies: cameras with 0.03 mm of white and 0.03 mm of slow noise (0.4 s) have this."""
    constant_mm: float = 0.25
    """A constant disturbance of any shape, each coordinate, mm."""
    gain_share: float = 0.1
    """Relative error of a chamber's push, which grows with the loads."""
    slope_mm: float = 0.3
    """Further disturbance of any shape that grows with the loads, mm at full load."""
    chambers_kPa: float = 0.3
    """Transient error of a chamber's push (friction, creep, a line), kPa."""
    shift_mm: float = 0.1
    """Transient shift of the base along each axis, mm."""
    turn_rad: float = 0.005
    """Transient rotation of the base about each axis, rad."""
    rest_mm: float = 0.006
    """Transient disturbance of any other shape, mm."""
    transient_s: float = 4.0
    """Correlation time of transients, s."""
    memory_s: float = 3000.0
    """Time in which W may change by its own standard deviation, s."""

    def __post_init__(self):
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value > 0.0):
                raise InputError(f"adaptation: {name} is {value}, expected more than 0")


@dataclass(frozen=True, eq=False)
class Adaptation:
    """What was learned of B arms; D = 3 n shapes, k = m + 2 coefficients of each.

    The coefficients are in units of their prior standard deviations, which keeps float32 exact
    enough.
    """

    mean: Tensor
    """(B, D, k): constant, slope by the load of each chamber, and transient of each shape."""
    covariance: Tensor
    """(B, D, k, k): covariance of their errors; the unit matrix before the first measurement."""


class DisturbanceEstimator:
    """Learns the disturbance of an arm's key points; holds constants only, batched, traceable."""

    def __init__(
        self,
        model: ArmModel,
        dt_s: float,
        prior: AdaptationPrior | None = None,
        device: str | torch.device = "cpu",
    ):
        """model: the arm, in kPa; dt_s: time between two updates, s."""
        self.prior = prior = prior or AdaptationPrior()
        spec = model.spec
        rest, low, high = (np.array(each) for each in (spec.rest, spec.low, spec.high))
        reach = np.maximum(high - rest, rest - low)
        reach = np.where(reach > 0.0, reach, 1.0)
        pushes, shifts, turns = _covariances(model, low, high)
        size, m = len(pushes), spec.chambers
        transient = (
            prior.chambers_kPa**2 * pushes
            + prior.shift_mm**2 * shifts
            + prior.turn_rad**2 * turns
            + prior.rest_mm**2 * np.eye(size)
        )
        variance, shapes = np.linalg.eigh(transient)
        gain_mm2 = np.einsum("ij,jk,ki->i", shapes.T, pushes, shapes)
        first = np.empty((size, m + 2))
        first[:, 0] = prior.constant_mm**2
        first[:, 1:-1] = prior.slope_mm**2 + gain_mm2[:, None] * (prior.gain_share * reach) ** 2
        first[:, -1] = variance
        keep = np.ones(m + 2)
        keep[-1] = math.exp(-dt_s / prior.transient_s)
        grows = np.full(m + 2, dt_s / prior.memory_s)
        grows[-1] = 1.0 - keep[-1] ** 2

        def tensor(values: np.ndarray) -> Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)

        self.shapes, self.rest, self.reach = tensor(shapes), tensor(rest), tensor(reach)
        self.deviation, self.keep = tensor(np.sqrt(first)), tensor(keep)
        self.kept, self.growth = self.keep[:, None] * self.keep, torch.diag(tensor(grows))

    def start(self, count: int) -> Adaptation:
        """Memory of `count` arms of which nothing was measured yet."""
        size, k = self.deviation.shape
        covariance = torch.eye(k, device=self.keep.device).expand(count, size, k, k).clone()
        return Adaptation(torch.zeros_like(covariance[..., 0]), covariance)

    def expected(self, memory: Adaptation, pressure: Tensor) -> Tensor:
        """(B, n, 3) mm, base frame: the disturbance that is expected at pressures (B, m) kPa."""
        return self._body((memory.mean * self._inputs(pressure)).sum(2))

    def updated(
        self, memory: Adaptation, off_mm: Tensor, pressure: Tensor, samples: int = 1
    ) -> tuple[Adaptation, Tensor]:
        """Memory after a measurement, and the disturbance (B, n, 3) mm, base frame, as estimated.

        off_mm: (B, n, 3) mm, base frame: measured key points less the model's, nan where one was
        lost; the expected disturbance stands in for it. pressure: (B, m) kPa. samples: number of
        measurements at these pressures whose mean `off_mm` is. The memory returned
        is that of the next step: transients have decayed, and W may have changed.
        """
        inputs = self._inputs(pressure)
        expected = self.expected(memory, pressure)
        surprise = torch.where(off_mm.isfinite(), off_mm - expected, torch.zeros_like(expected))
        scalar = surprise.flatten(1) @ self.shapes
        across = (memory.covariance * inputs[:, :, None]).sum(3)
        power = (across * inputs).sum(2) + self.prior.noise_mm**2 / samples
        gain = across / power[..., None]
        mean = memory.mean + gain * scalar[..., None]
        covariance = memory.covariance - gain[..., None] * across[:, :, None]
        now = self.expected(Adaptation(mean, covariance), pressure)
        return Adaptation(mean * self.keep, covariance * self.kept + self.growth), now

    def _inputs(self, pressure: Tensor) -> Tensor:
        """(B, D, k) mm: what the coefficients are multiplied with."""
        load = (pressure - self.rest) / self.reach
        one = torch.ones_like(load[:, :1])
        return torch.cat((one, load, one), 1)[:, None] * self.deviation

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


def _moment(displacements: list[np.ndarray]) -> np.ndarray:
    """(D, D): sum over kinds, mean over samples, of displacements (S, n, 3) of each kind."""
    rows = np.stack(displacements).reshape(len(displacements), len(displacements[0]), -1)
    return np.einsum("ksi,ksj->ij", rows, rows) / rows.shape[1]
