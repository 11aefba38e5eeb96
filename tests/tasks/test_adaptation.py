"""Online adaptation: the disturbance of an arm's key points is learned while the arm moves."""

import copy
import math
from dataclasses import replace

import numpy as np
import pytest
import scipy.linalg
import torch

from surgisoft.errors import InputError
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.checkpoint import default_arm
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import ConstantCurvature
from surgisoft.surrogate.reach import steady_key_points
from surgisoft.tasks.world.adaptation import (
    LAGS,
    USUAL,
    AdaptationPrior,
    DisturbanceEstimator,
)
from surgisoft.tasks.world.arm import Randomisation
from surgisoft.tasks.world.observer import AlphaBetaFilter
from surgisoft.tasks.world.random_streams import streams
from surgisoft.tasks.world.world import WorldConfig, single_arm_world

STILL = AdaptationPrior(
    chambers_kPa=1e-9, shift_mm=1e-9, turn_rad=1e-9, rest_mm=1e-9, memory_s=1e12
)
"""No transients and no forgetting: what is left is Bayesian linear regression."""


@pytest.fixture(scope="module")
def model():
    return default_arm()


def pressures(steps, seed=0):
    """(T, 1, 3) kPa within the range of the arm."""
    return torch.tensor(np.random.default_rng(seed).uniform(-10.0, 45.0, (steps, 1, 3))).float()


def still(estimator):
    """(1, n, 3) mm: the model's key points at rest."""
    return estimator.rest_mm.unflatten(1, (-1, 3))


def learned(estimator, off, at, bodies=None):
    """The memory after disturbances (T, B, n, 3) mm at pressures (T, B, m), and the estimates.

    bodies: (T, B, n, 3) mm, the model's key points; None: they stand still at rest.
    """
    memory, found = estimator.start(off.shape[1]), []
    bodies = still(estimator).expand(len(off), off.shape[1], -1, -1) if bodies is None else bodies
    for each, pressure, body in zip(off, at, bodies, strict=True):
        memory, now, _, _ = estimator.updated(memory, each, pressure, body)
        found.append(now)
    return memory, torch.stack(found)


def test_without_transients_it_is_bayesian_linear_regression(model):
    """The mean of the posterior in closed form, (X'X / s^2 + S^-1)^-1 X'y / s^2, by NumPy."""
    estimator = DisturbanceEstimator(model, 0.1, STILL)
    at = pressures(40)
    off = 0.3 * torch.randn(40, 1, 5, 3, generator=torch.Generator().manual_seed(1))
    memory, _ = learned(estimator, off, at)
    body = still(estimator).expand(40, -1, -1)
    inputs = estimator.errors.displacements(at[:, 0], body).double().flatten(0, 1).numpy()
    precision = inputs.T @ inputs / 0.08**2 + np.eye(inputs.shape[1])
    expected = np.linalg.solve(precision, inputs.T @ off.double().flatten().numpy() / 0.08**2)
    found = memory.mean[0, : len(expected)].double().numpy()
    np.testing.assert_allclose(found, expected, atol=5e-3 * np.abs(expected).max())


def test_a_constant_disturbance_of_any_shape_leaves_no_error(model):
    """The filter integrates: with every doubling of the time the error falls towards zero."""
    estimator = DisturbanceEstimator(model, 0.1)
    shape = torch.randn(1, 1, 5, 3, generator=torch.Generator().manual_seed(2))
    off = shape.expand(1200, -1, -1, -1)
    _, found = learned(estimator, off, pressures(1, 3).expand(1200, -1, -1))
    left = (found - off).flatten(1).norm(dim=1) / shape.norm()
    assert left[0] > 0.03
    assert left[100] > left[400] > left[1199]
    assert left[1199] < 0.01


def test_noise_of_implausible_shapes_hardly_enters(model):
    """Of white noise the estimate keeps less in the last shape than in that of the pushes."""
    estimator = DisturbanceEstimator(model, 0.1)
    off = 0.08 * torch.randn(400, 4, 5, 3, generator=torch.Generator().manual_seed(4))
    _, found = learned(estimator, off, pressures(1).expand(400, 4, -1))
    share = (found[200:].flatten(2) @ estimator.shapes).square().mean((0, 1)).sqrt() / 0.08
    assert share[0] < 0.15
    assert share[-1] > 0.4


def test_a_lost_key_point_is_stood_in_for_by_what_is_expected(model):
    estimator = DisturbanceEstimator(model, 0.1)
    off = torch.ones(50, 1, 5, 3)
    at = pressures(1).expand(50, -1, -1)
    memory, _ = learned(estimator, off[:-1], at[:-1])
    body = still(estimator)
    memory, _, _, expected = estimator.updated(memory, off[-1], at[-1], body)
    lost = expected.clone()
    lost[0, 2] = torch.nan
    after, now, _, _ = estimator.updated(memory, lost, at[0], body)
    torch.testing.assert_close(now, expected, atol=1e-5, rtol=0.0)
    known = estimator.known
    torch.testing.assert_close(after.mean[:, known], memory.mean[:, known], atol=1e-5, rtol=0.0)


THINS = 1.5
"""Rate at which the wall of `moved` gives way, 1/s, for each mm that the body lacks."""


def relaxed(lack):
    """What a wall with a force like the root of its rate lacks 0.1 s later: l' = -`THINS` |l| l."""
    return lack / (1.0 + 0.1 * THINS * lack.norm())


def moved(model, estimator, share):
    """Bodies (T, 1, n, 3) mm of steps of pressure every 2 s, what they lack of them because a share
    of the motion comes late in a viscous wall, and pressures (T, 1, m) kPa; every 0.1 s."""
    at = (0.3 * pressures(15, 5) + 20.0).repeat_interleave(20, 0)
    bodies = torch.tensor(steady_key_points(model, at[:, 0].numpy()), dtype=torch.float32)[:, None]
    before = still(estimator)
    lack, off = torch.zeros_like(before), []
    for body in bodies:
        lack, before = relaxed(lack + body - before), body
        off.append(-share * lack)
    return bodies, torch.stack(off), at


@pytest.mark.parametrize("share", [0.0, 0.7, 1.3])
def test_the_share_of_the_motion_that_comes_late_is_learned(model, share):
    """Of a wall that is none of `LAGS`; above 1 the body first goes the wrong way."""
    estimator = DisturbanceEstimator(model, 0.1)
    bodies, off, at = moved(model, estimator, share)
    memory, _ = learned(estimator, off, at, bodies)
    found = float(estimator.late_share(memory.mean))
    assert found == pytest.approx(share, abs=0.25)


def test_controllers_see_late_motion_through_a_filter_where_most_of_it_is_late(model):
    """After a step of pressure the shown disturbance follows the estimate by `filter_s`; with no
    late motion both are one."""
    estimator = DisturbanceEstimator(model, 0.1)
    leads = {}
    for share in (0.0, 1.3):
        bodies, off, at = moved(model, estimator, share)
        memory, _ = learned(estimator, off, at, bodies)
        at = at[-1] + 5.0
        body = torch.tensor(steady_key_points(model, at.numpy()), dtype=torch.float32)
        found = estimator.updated(memory, share * (bodies[-1] - body), at, body)
        leads[share] = float((found.lead_mm).norm()), float((bodies[-1] - body).norm())
        torch.testing.assert_close(found.next_mm - found.now_mm, found.lead_mm, atol=0.05, rtol=0.0)
    assert leads[0.0][0] < 1e-3
    lead, step = leads[1.3]
    assert lead == pytest.approx(1.3 * step * math.exp(-0.1 / estimator.prior.filter_s), rel=0.15)


def loop_mm(model, late_share):
    """Distances (T,) of the wanted motion, mm, in a loop around a wall with the late share 1.3.

    In each step the controller moves the model's body along the push of one chamber by what is
    missing as it sees the body, as deadbeat inverse kinematics does. late_share: of the prior.
    """
    estimator = DisturbanceEstimator(model, 0.1, AdaptationPrior(late_share=late_share))
    memory, _ = learned(estimator, *(moved(model, estimator, 1.3)[k] for k in (1, 2, 0)))
    at = torch.full((1, 3), 20.0)
    body, ahead = (
        torch.tensor(steady_key_points(model, each), dtype=torch.float32)
        for each in (at.numpy(), at.numpy() + np.eye(3)[:1])
    )
    push = (ahead - body) / (ahead - body).norm()
    place, lack, errors = 0.0, torch.zeros_like(push), []
    for _ in range(150):
        lack = relaxed(lack)
        found = estimator.updated(memory, -1.3 * lack, at, body + place * push)
        memory, seen = found.memory, found.now_mm + found.lead_mm
        errors.append(abs(3.0 - place + 1.3 * float((lack * push).sum())))
        change = 3.0 - place - float((seen * push).sum())
        place, lack = place + change, lack + change * push
    return errors


def test_the_prior_says_what_is_wrong_with_it():
    with pytest.raises(InputError, match=r"noise_mm is 0.0, expected more than 0"):
        AdaptationPrior(noise_mm=0.0)


def test_a_wall_that_first_moves_the_wrong_way_does_not_swing(model):
    """Errors of the loop fall to less than half where the late share is learned."""
    swings, calm = (
        np.sqrt(np.mean(np.square(loop_mm(model, share)[-90:])))
        for share in (1e-6, AdaptationPrior.late_share)
    )
    assert swings > 0.3
    assert calm < 0.5 * swings


def beam_error_mm(observer):
    """Mean distance, mm, 50 mm beyond the tip, of the estimated from the true axis of the tip."""
    vary = Randomisation(mount_mm=0.5, gain=0.05, noise_mm=0.05)
    world = single_arm_world(WorldConfig(randomisation=vary, observer=observer))
    state, arm, off = world.start(streams(0, 16)), world.arms["arm"], []
    phase = 2.0 * np.pi * torch.arange(3) / 3.0
    for step in range(120):
        push = 1.2 * torch.cos(2.0 * np.pi * step / 150.0 + phase)
        state = world.step(state, {"arm": push.expand(16, 3)})
        part = state.arms["arm"]
        ends = [
            p[:, -1] + 50.0 * arm.backbone.tip_direction(p) for p in (part.seen_mm, part.points_mm)
        ]
        off.append((ends[0] - ends[1]).norm(dim=1).mean())
    return float(torch.stack(off[50:]).mean())


def test_the_beam_of_a_simulated_arm_is_known_better_than_by_the_filter():
    filtered = beam_error_mm(AlphaBetaFilter(0.3, 0.01))
    adapted = beam_error_mm(replace(AlphaBetaFilter(), adapts=True))
    assert adapted < 0.85 * filtered


def noisy(rows, seed):
    """(T, 1, 5, 3) mm: white noise of `noise_mm`, as much as the prior expects."""
    return 0.08 * torch.randn(rows, 1, 5, 3, generator=torch.Generator().manual_seed(seed))


def test_what_one_chamber_does_wrong_is_known_at_pressures_that_were_never_measured(model):
    """A chamber pushes 5 % more. After 2 s at each of ten pressures less than half is left at a
    hundred others of what a linear function of the loads for each coordinate leaves, which was
    fitted to the same measurements (NumPy's lstsq)."""
    estimator = DisturbanceEstimator(model, 0.1, STILL)
    at = torch.cat((pressures(10, 6).repeat_interleave(20, 0), pressures(100, 7)))
    more = at * torch.tensor([1.05, 1.0, 1.0])
    bodies, off = (torch.tensor(steady_key_points(model, p[:, 0].numpy())) for p in (at, more))
    bodies, off = bodies.float()[:, None], (off - bodies).float()[:, None]
    measured = off[:200] + noisy(200, 8)
    memory, _ = learned(estimator, measured, at[:200], bodies[:200])
    rows = estimator.errors.displacements(at[200:, 0], bodies[200:, 0])
    found = (rows @ memory.mean[0, estimator.known]).numpy()
    wanted = off[200:, 0].flatten(1).numpy()
    load = np.column_stack((np.ones(300), at[:, 0].numpy()))
    fitted = np.linalg.lstsq(load[:200], measured.flatten(1).numpy(), rcond=None)[0]
    left, others = (np.sqrt(np.mean((e - wanted) ** 2)) for e in (found, load[200:] @ fitted))
    assert left < 0.5 * others
    assert left < 0.1 * np.sqrt(np.mean(wanted**2))


def test_the_variance_of_transients_follows_the_arm(model):
    """It falls where cameras' noise is all there is, and grows where the arm sticks and slips."""
    estimator = DisturbanceEstimator(model, 0.1)
    at = pressures(1, 3).expand(600, -1, -1)
    steps = torch.randint(-1, 2, (60,), generator=torch.Generator().manual_seed(9)).float()
    slips = 0.8 * steps.repeat_interleave(10)[:, None, None, None]
    off = {"quiet": 0.5 * noisy(600, 10), "slips": 0.5 * noisy(600, 10) + slips}
    unrest = {name: float(learned(estimator, each, at)[0].unrest) for name, each in off.items()}
    assert unrest["quiet"] < 0.7
    assert unrest["slips"] > 2.0


def test_an_arm_with_many_chambers_is_adapted():
    """Six chambers have errors of their own loads only, three key points two segments: constant and
    linear pushes, mount, segments (2 shares, 3 kinds by 1 and 6 loads), planes."""
    ends = (0.0,) * 6, (40.0,) * 6
    spec = ArmSpec(6, 3, *ends, length_mm=70.0)
    arm = ArmModel(spec, ConstantCurvature(*(torch.tensor(end) for end in ends), key_points=3))
    estimator = DisturbanceEstimator(arm, 0.1)
    assert estimator.errors.count == 6 + 6 + 6 + 2 * (2 + 3 * 7) + 9
    at = torch.full((200, 2, 6), 20.0)
    body = torch.tensor(steady_key_points(arm, at[0].numpy()), dtype=torch.float32)
    off = torch.full((200, 2, 3, 3), 0.2)
    _, found = learned(estimator, off, at, body.expand(200, -1, -1, -1))
    torch.testing.assert_close(found[-1], off[-1], atol=0.02, rtol=0.0)


class PlainFilter:
    """Kalman's filter (1960) of one arm as the docstring of `adaptation` states it, in float64.

    Gain by a solver, covariance in Joseph's form (Bucy & Joseph 1968), lags as `Lag` states them.
    """

    def __init__(self, estimator):
        self.of, self.prior = estimator, estimator.prior
        k, size = len(estimator.keep), estimator.transient.shape[0]
        self.mean, self.covariance, self.unrest = np.zeros(k), np.eye(k), 1.0
        self.behind = estimator.rest_mm.double().numpy().repeat(len(LAGS), 0)
        self.transient = estimator.transient.double().numpy()
        self.keep = np.ones(k)
        self.keep[-size:] = math.exp(-0.1 / self.prior.transient_s)
        self.grows = np.zeros(k)
        self.grows[: estimator.errors.count] = 0.1 / self.prior.memory_s
        self.grows[estimator.late] = 0.1 / self.prior.late_memory_s

    def updated(self, off, pressure, body):
        """(3 n,) mm: the disturbance after a measurement; off, body (n, 3), pressure (m,)."""
        prior, flat = self.prior, body.double().numpy().reshape(-1)
        gap = self.behind - flat
        for each, lag, turn in zip(gap, LAGS, self.of.turn_mm[:, 0].double().numpy(), strict=True):
            left = math.exp(-0.1 / lag.tau_s / (1.0 + USUAL / lag.turn))
            each *= left / (1.0 + (1.0 - left) * np.linalg.norm(each) / turn)
        known = self.of.errors.displacements(pressure[None], body[None])[0].double().numpy()
        rows = np.hstack((known, prior.late_share * gap.T, self.transient))
        surprise = off.double().numpy().reshape(-1) - rows @ self.mean
        power = rows @ self.covariance @ rows.T + prior.noise_mm**2 * np.eye(len(rows))
        shapes = self.of.moving.double().numpy().T
        ratios = [(u @ surprise) ** 2 / (u @ power @ u) for u in shapes]
        beyond = min(np.mean(ratios), prior.startling) / prior.innovation - 1.0
        stirred = self.unrest * math.exp(0.1 / prior.unrest_s * beyond)
        self.unrest = min(max(stirred, prior.quietest), prior.liveliest)
        gain = np.linalg.solve(power, rows @ self.covariance).T
        mean = self.mean + gain @ surprise
        left = np.eye(len(mean)) - gain @ rows
        covariance = left @ self.covariance @ left.T + prior.noise_mm**2 * gain @ gain.T
        grown = self.grows + self.unrest * (1.0 - self.keep**2)
        self.covariance = covariance * np.outer(self.keep, self.keep) + np.diag(grown)
        self.mean, self.behind = mean * self.keep, gap + flat
        return rows @ mean


def reference(estimator):
    """The estimator without its compiled loops."""
    plain = copy.copy(estimator)
    plain.compiles = False
    return plain


@pytest.mark.parametrize("variant", [lambda each: each, reference], ids=["compiled", "reference"])
def test_it_is_the_plain_kalman_filter_over_a_whole_episode(model, variant):
    """To 1e-5 mm of the estimate, and every variance to 0.01 % (eigenvalues of the
    covariance over that of the plain filter), after a minute of motion over the whole range."""
    estimator = DisturbanceEstimator(model, 0.1)
    plain, variant = PlainFilter(estimator), variant(estimator)
    at = pressures(600, 11)
    bodies = torch.tensor(steady_key_points(model, at[:, 0].numpy()), dtype=torch.float32)[:, None]
    late = 0.2 * (bodies.roll(1, 0) - bodies)
    off = late + 0.3 * torch.sin(0.02 * torch.arange(600))[:, None, None, None] + noisy(600, 12)
    memory, found = learned(variant, off, at, bodies)
    wanted = [
        plain.updated(*(each[0] for each in row)) for row in zip(off, at, bodies, strict=True)
    ]
    gap_mm = found[:, 0].flatten(1).double().numpy() - np.stack(wanted)
    assert np.abs(gap_mm).max() < 1e-5
    assert float(memory.unrest) == pytest.approx(plain.unrest, rel=1e-4)
    covariance = memory.covariance[0].double().numpy()
    np.testing.assert_array_equal(covariance, covariance.T)
    shares = scipy.linalg.eigvalsh(covariance, plain.covariance)
    assert 0.9999 < shares.min() <= shares.max() < 1.0001
