"""Online adaptation: what an arm's model gets wrong is learned while the arm moves.

The key points differ from the model's by a disturbance, because the arm is another robot, has
aged, carries something, or is held otherwise. Cameras measure the disturbance with noise, and the
direction of the tip, which a beam follows over tens of millimetres, amplifies the noise of single
key points tenfold. A filter with one gain for all key points (`observer.AlphaBetaFilter`) has to
choose between noise and lag. Here the disturbance is

    d = B(x, y) w + sum over l of g_l (z_l - y) + r,    x = 0 at rest and 1 at the end of the range.

w are the parameters of the arm's model errors, which `arm_errors` describes: B(x, y) are the
displacements of the key points by them, at the loads x of the chambers, if the model's body is y.
g_l are the shares of the motion that come late, in a viscous wall or a long line: z_l is the body
behind the lag l of `LAGS`. r is a transient, a first-order Gauss-Markov process, whose covariance
has the shapes of pushes of the chambers and motions of the base, which the arm's own model
provides. One Kalman filter (Kalman 1960) estimates w, g and r together: recursive least squares
with forgetting (Ljung 1999, sec. 11.2) in which the noise of implausible shapes hardly enters. How
large transients are differs from arm to arm: their variance follows the innovations
(innovation-based adaptive estimation; Mehra 1970; Mohamed & Schwarz 1999), from quiet arms, whose
estimate is then nearly free of noise, to arms that stick and slip. A constant disturbance of any
shape is learned without a remaining error, because B has the place of each key plane.

The disturbance of the output is what offset-free model predictive control estimates (Pannocchia &
Rawlings 2003). A controller that takes back at once what it sees of the disturbance swings where
most of the motion comes late: it corrects again what is on its way already. Where the late share is
above 1, controllers therefore see g (z - y) + r behind a first-order filter, the robustness filter
of internal model control (Garcia & Morari 1982). Tensors have the batch in front; the base frame is
that of the arm.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.reach import steady_key_points
from surgisoft.tasks.world.arm_errors import ArmErrors, ErrorPrior, jacobians
from surgisoft.tasks.world.compiled_adaptation import learn
from surgisoft.threads import over_rows

USUAL = 0.1
"""Distance of the body, as a share of its range, at which the time constant of a lag is stated."""
LEARN_BLOCK = 32
"""Rows of a block of the filter's update, which takes 25 µs a row (a count)."""


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
FILTERED = (1.0, 1.25)
"""Late shares from which controllers see the disturbance through a filter, and with all of it, no
unit: at 1 the arm does not move at once, above it first moves the wrong way. On up to six robots of
the virtual rig (11 to 18, 31 to 33) the share is 1.3 to 1.5 with the effect `rate_dependence`, up
to 0.8 with a valve that sticks, which a filter would follow too slowly, up to 0.5 with others."""
SAMPLES = 256
"""Pressures, spread over the range of an arm, over which transients are averaged (a count)."""


@dataclass(frozen=True)
class AdaptationPrior:
    """How large disturbances are expected to be, as standard deviations.

    The values were chosen on robots 11 to 20 of the virtual rig, some of them with hidden lags,
    friction and hysteresis, too. `benchmarks/robust.py` judges on other robots.
    """

    errors: ErrorPrior = field(default_factory=ErrorPrior)
    """Model errors of the arm."""
    noise_mm: float = 0.08
    """Noise of a measured coordinate, mm, as white noise of a step that has the same power at low
    frequencies: cameras with 0.03 mm of white and 0.03 mm of slow noise (0.4 s) have this."""
    chambers_kPa: float = 0.6
    """Transient error of a chamber's push (friction, creep, a line), kPa."""
    shift_mm: float = 0.5
    """Transient shift of the base along each axis, mm."""
    turn_rad: float = 0.0025
    """Transient rotation of the base about each axis, rad."""
    rest_mm: float = 0.01
    """Transient disturbance of any other shape, mm."""
    transient_s: float = 20.0
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
    """Time in which model errors may change by their own standard deviation, s."""
    late_share: float = 0.5
    """Share of the body's motion that comes late by each of the lags `LAGS`, no unit."""
    late_memory_s: float = 300.0
    """Time in which those shares may change by their own standard deviation, s."""
    filter_s: float = 0.5
    """Time constant of the filter through which controllers see the disturbance where all motion
    comes late, s; it falls to 0 at the first of the late shares `FILTERED`. With 0.3 s a viscous
    wall still swings, with 0.8 s beams trail behind (robots 11 to 18 of the virtual rig)."""

    def __post_init__(self):
        for name, value in vars(self).items():
            if name != "errors" and not (math.isfinite(value) and value > 0.0):
                raise InputError(f"adaptation: {name} is {value}, expected more than 0")


@dataclass(frozen=True, eq=False)
class Adaptation:
    """Estimates for B arms; D = 3 n coordinates, F model errors, L lags, k = F + L + D.

    The state is in units of its prior standard deviations, so that float32 is exact enough to keep
    it in.
    """

    mean: Tensor
    """(B, k): parameters of the model errors, share of each lag, and transient of each shape."""
    covariance: Tensor
    """(B, k, k): covariance of their errors; the unit matrix before the first measurement."""
    behind_mm: Tensor
    """(B, L, D) mm, base frame: the model's body behind each lag."""
    unrest: Tensor
    """(B,): variance of transients as a share of the prior's."""
    shown_mm: Tensor
    """(B, D) mm, base frame: late motion and transient as controllers see them."""


class Estimate(NamedTuple):
    """Estimates that follow from a measurement of B arms."""

    memory: Adaptation
    """What is known then, as of the next step: transients have decayed, and all may have
    changed."""
    now_mm: Tensor
    """(B, n, 3) mm, base frame: the disturbance."""
    lead_mm: Tensor
    """(B, n, 3) mm, base frame: what controllers are shown beyond that."""
    next_mm: Tensor
    """(B, n, 3) mm, base frame: the disturbance that controllers expect in the next step, at the
    same pressures."""


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
        self.compiles = True
        """Whether compiled loops are taken where they can be; else the tensor operations."""
        self.errors = ArmErrors(model, prior.errors, device)
        spec = model.spec
        low, high = (np.array(each) for each in (spec.low, spec.high))
        pushes, shifts, turns = _covariances(model)
        size, lags, some = len(pushes), len(LAGS), self.errors.count
        transient = (
            prior.chambers_kPa**2 * pushes
            + prior.shift_mm**2 * shifts
            + prior.turn_rad**2 * turns
            + prior.rest_mm**2 * np.eye(size)
        )
        variance, shapes = np.linalg.eigh(transient)
        keep = np.ones(some + lags + size)
        keep[-size:] = math.exp(-dt_s / prior.transient_s)
        grows = np.full(len(keep), dt_s / prior.memory_s)
        grows[some:-size] = dt_s / prior.late_memory_s
        grows[-size:] = 0.0
        stirs = 1.0 - keep**2
        tau_s, turn = np.array([(lag.tau_s, lag.turn) for lag in LAGS]).T

        def tensor(values: np.ndarray) -> Tensor:
            return torch.tensor(values, dtype=torch.float32, device=device)

        self.shapes, self.keep = tensor(shapes), tensor(keep)
        """Shapes (D, D) of transients, in columns: orthogonal, the likeliest one last."""
        self.transient = tensor(shapes * np.sqrt(variance))
        """(D, D) mm: what transients of one standard deviation add to each coordinate."""
        self.growth, self.stirs = tensor(grows), tensor(stirs)
        self.dt_s, self.known, self.late = dt_s, slice(0, some), slice(some, some + lags)
        self.passing = slice(some, None)
        self.moving = self.shapes[:, -(spec.chambers + 3) :]
        """The shapes that transients have most: pushes of the chambers and shifts of the base."""
        self.left = tensor(np.exp(-dt_s / tau_s / (1.0 + USUAL / turn)))[:, None]
        # A model that does not move at all has no motion that comes late.
        range_mm = max(_range_mm(model, low, high), 1e-3)
        self.turn_mm = tensor(turn * range_mm)[:, None]
        rest = steady_key_points(model, np.array(spec.rest)[None])
        self.rest_mm = tensor(rest.reshape(1, -1))

    def start(self, count: int) -> Adaptation:
        """Memory of `count` arms at rest of which nothing was measured yet."""
        k = len(self.keep)
        covariance = torch.eye(k, device=self.keep.device).expand(count, k, k).clone()
        behind = self.rest_mm.expand(count, len(LAGS), -1).clone()
        mean, shown = torch.zeros_like(covariance[:, 0]), torch.zeros_like(behind[:, 0])
        return Adaptation(mean, covariance, behind, torch.ones_like(shown[:, 0]), shown)

    def updated(
        self,
        memory: Adaptation,
        off_mm: Tensor,
        pressure: Tensor,
        points_mm: Tensor,
        samples: int = 1,
        settled: bool = False,
    ) -> Estimate:
        """Estimates after a measurement.

        off_mm: (B, n, 3) mm, base frame: measured key points less the model's, nan where one was
        lost; the expected disturbance stands in for it. pressure: (B, m) kPa. points_mm:
        (B, n, 3) mm, base frame: the model's key points. samples: number of measurements at these
        pressures whose mean `off_mm` is. settled: whether the arm has stood there so long that
        nothing comes late any more.
        """
        body = points_mm.flatten(1)
        gap = self._gap(memory.behind_mm - body[:, None])
        gap = torch.zeros_like(gap) if settled else gap
        inputs = self._inputs(pressure, points_mm, gap)
        measured = off_mm.flatten(1)
        surprise = measured - _times(inputs, memory.mean)
        surprise = torch.where(measured.isfinite(), surprise, torch.zeros_like(surprise))
        fast = self.compiles and _plain(inputs, memory.covariance)
        absorb = self._absorbed if fast else self._absorbed_reference
        change, covariance, unrest = absorb(memory, inputs, surprise, samples)
        mean = memory.mean + change
        passing = _times(inputs[..., self.passing], mean[:, self.passing])
        shown = memory.shown_mm + self._adopts(mean) * (passing - memory.shown_mm)
        after = Adaptation(mean * self.keep, covariance, gap + body[:, None], unrest, shown)
        now, lead = _times(inputs, mean), shown - passing
        decays = 1.0 - self.keep[-1]
        ends = _times(inputs[..., self.late.stop :], decays * mean[:, self.late.stop :])
        found = (each.view_as(points_mm) for each in (now, lead, now + lead - ends))
        return Estimate(after, *found)

    def late_share(self, mean: Tensor) -> Tensor:
        """(B,): share of the body's motion that comes late by all lags together.

        mean: (B, k), as that of `Adaptation`.
        """
        return self.prior.late_share * mean[:, self.late].sum(1)

    def _absorbed_reference(
        self, memory: Adaptation, inputs: Tensor, surprise: Tensor, samples: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Change of the mean (B, k), covariance (B, k, k) as of the next step, and `unrest` (B,).

        inputs: (B, D, k) mm; surprise: (B, D) mm, the innovation; samples: see `updated`. With the
        Cholesky factor of the innovation's covariance, S = L L', the covariance becomes
        P - W W', W = P H' L^-T. In float64: the condition number of S is 1,000 and more, and the
        gain would amplify the rounding of float32 as much.
        """
        before, inputs, surprise = (each.double() for each in (memory.covariance, inputs, surprise))
        across = inputs @ before
        noise = self.prior.noise_mm**2 / samples
        eye = torch.eye(inputs.shape[1], dtype=torch.float64, device=inputs.device)
        power = across @ inputs.mT + noise * eye
        unrest = self._unrest(memory.unrest, surprise, power)
        white = _whitened(power, torch.cat((surprise[..., None], across), 2))
        change = _times(white[..., 1:].mT, white[..., 0])
        after = before - white[..., 1:].mT @ white[..., 1:]
        after = 0.5 * (after + after.mT) * (self.keep[:, None] * self.keep)
        grown = torch.diag(self.growth) + unrest[:, None, None] * torch.diag(self.stirs)
        return change.float(), (after + grown).float(), unrest.float()

    def _absorbed(
        self, memory: Adaptation, inputs: Tensor, surprise: Tensor, samples: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The same as `_absorbed_reference`, compiled."""
        change, after = torch.empty_like(memory.mean), torch.empty_like(memory.covariance)
        unrest, prior = torch.empty_like(memory.unrest), self.prior
        rate = self.dt_s / prior.unrest_s
        rules = (rate, prior.innovation, prior.startling, prior.quietest, prior.liveliest)
        given = (inputs, memory.covariance, surprise, memory.unrest)
        before = [each.contiguous().numpy() for each in given]
        constants = (
            np.float32(prior.noise_mm**2 / samples),
            self.moving.mT.contiguous().numpy(),
            np.array(rules, np.float32),
            *(each.numpy() for each in (self.keep, self.growth, self.stirs)),
        )
        found = [each.numpy() for each in (change, after, unrest)]

        def learn_rows(rows: slice) -> None:
            learn(*(a[rows] for a in before), *constants, *(a[rows] for a in found))

        over_rows(len(change), learn_rows, block=LEARN_BLOCK)
        return change, after, unrest

    def _unrest(self, unrest: Tensor, surprise: Tensor, power: Tensor) -> Tensor:
        """(B,): variance of transients after innovations (B, D) mm of covariance `power`.

        Covariance matching: the logarithm integrates by how much innovations are stronger than
        expected, so that it rests where they are as expected.
        """
        prior, shapes = self.prior, self.moving.to(power)
        found = (surprise @ shapes).square()
        strength = found / (shapes * (power @ shapes)).sum(1)
        beyond = strength.mean(1).clamp(max=prior.startling) / prior.innovation - 1.0
        changed = unrest * torch.exp(self.dt_s / prior.unrest_s * beyond)
        return changed.clamp(prior.quietest, prior.liveliest)

    def _adopts(self, mean: Tensor) -> Tensor:
        """(B, 1): share of a new disturbance that controllers are shown in this step."""
        first, last = FILTERED
        beyond = ((self.late_share(mean) - first) / (last - first)).clamp(0.0, 1.0)[:, None]
        time_s = (self.prior.filter_s * beyond).clamp(min=1e-3 * self.dt_s)
        return 1.0 - torch.exp(-self.dt_s / time_s)

    def _gap(self, gap: Tensor) -> Tensor:
        """(B, L, D) mm: what a step leaves of the distances behind the body, by `Lag`, exactly."""
        size = gap.norm(dim=2, keepdim=True)
        return gap * self.left / (1.0 + (1.0 - self.left) * size / self.turn_mm)

    def _inputs(self, pressure: Tensor, points: Tensor, gap: Tensor) -> Tensor:
        """(B, D, k) mm: what the state is multiplied with; gap: (B, L, D) mm."""
        rows = self.errors.displacements(pressure, points)
        late = self.prior.late_share * gap.mT
        return torch.cat((rows, late, self.transient.expand(len(rows), -1, -1)), 2)


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    """(B, r): product of matrices (B, r, c) and vectors (B, c)."""
    return (matrix @ vector[..., None])[..., 0]


def _whitened(power: Tensor, across: Tensor) -> Tensor:
    """(B, D, c): L^-1 across, with L the Cholesky factor of power (B, D, D); across: (B, D, c).

    By elimination: ONNX has neither a factorization nor a solver.
    """
    left, rows = torch.cat((power, across), 2), []
    for i in range(power.shape[1]):
        row = left[:, 0] / left[:, 0, i, None].sqrt()
        left = left[:, 1:] - row[:, i + 1 : power.shape[1], None] * row[:, None]
        rows.append(row)
    return torch.stack(rows, 1)[..., power.shape[2] :]


def _plain(*tensors: Tensor) -> bool:
    """Whether the compiled loops may take these tensors, which have no gradient and no tracer."""
    if torch.compiler.is_compiling() or torch.jit.is_tracing():
        return False
    if any(type(tensor) is not Tensor or tensor.dtype != torch.float32 for tensor in tensors):
        return False
    graded = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    return not graded and all(tensor.device.type == "cpu" for tensor in tensors)


def _covariances(model: ArmModel) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Second moments (D, D) of the key points' displacements, means over the range of the arm.

    By independent pushes of the chambers (mm^2/kPa^2), by shifts of the base (no unit) and by its
    rotations (mm^2/rad^2), each of standard deviation 1.
    """
    at, slopes = jacobians(model, SAMPLES)
    points = steady_key_points(model, at)
    shifts, turns = [], []
    for axis in np.eye(3):
        shifts.append(np.broadcast_to(axis, points.shape))
        turns.append(np.cross(axis, points))
    return _moment([*np.moveaxis(slopes, -1, 0)]), _moment(shifts), _moment(turns)


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
