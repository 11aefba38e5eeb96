"""Online adaptation: the disturbance of an arm's key points is learned while the arm moves."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.surrogate.checkpoint import default_arm
from surgisoft.tasks.world.adaptation import AdaptationPrior, DisturbanceEstimator
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


def learned(estimator, off, at):
    """The memory after disturbances (T, B, n, 3) mm at pressures (T, B, m), and the estimates."""
    memory, found = estimator.start(off.shape[1]), []
    for each, pressure in zip(off, at, strict=True):
        memory, now = estimator.updated(memory, each, pressure)
        found.append(now)
    return memory, torch.stack(found)


def test_without_transients_it_is_bayesian_linear_regression(model):
    """The mean of the posterior in closed form, (X'X / s^2 + S^-1)^-1 X'y / s^2, by NumPy."""
    estimator = DisturbanceEstimator(model, 0.1, STILL)
    at = pressures(40)
    off = 0.3 * torch.randn(40, 1, 5, 3, generator=torch.Generator().manual_seed(1))
    memory, _ = learned(estimator, off, at)
    spec = model.spec
    rest, low, high = (np.array(each) for each in (spec.rest, spec.low, spec.high))
    inputs = np.ones((40, 4))
    inputs[:, 1:] = (at[:, 0].numpy() - rest) / np.maximum(high - rest, rest - low)
    shapes = estimator.shapes.double().numpy()
    seen = off.double().reshape(40, 15).numpy() @ shapes
    prior = estimator.deviation.double().numpy()[:, :4] ** 2
    for shape in range(15):
        precision = inputs.T @ inputs / 0.08**2 + np.diag(1.0 / prior[shape])
        expected = np.linalg.solve(precision, inputs.T @ seen[:, shape] / 0.08**2)
        found = memory.mean[0, shape, :4].double().numpy() * np.sqrt(prior[shape])
        np.testing.assert_allclose(found, expected, atol=2e-3)


def test_a_constant_disturbance_of_any_shape_leaves_no_error(model):
    """The filter integrates: with every doubling of the time the error falls towards zero."""
    estimator = DisturbanceEstimator(model, 0.1)
    shape = torch.randn(1, 1, 5, 3, generator=torch.Generator().manual_seed(2))
    off = shape.expand(1600, -1, -1, -1)
    _, found = learned(estimator, off, pressures(1, 3).expand(1600, -1, -1))
    left = (found - off).flatten(1).norm(dim=1) / shape.norm()
    assert left[0] > 0.03
    assert left[100] > left[400] > left[1599]
    assert left[1599] < 0.01


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
    memory, _ = learned(estimator, off, at)
    expected = estimator.expected(memory, at[0])
    lost = expected.clone()
    lost[0, 2] = torch.nan
    after, now = estimator.updated(memory, lost, at[0])
    torch.testing.assert_close(now, expected, atol=1e-5, rtol=0.0)
    torch.testing.assert_close(after.mean[..., :-1], memory.mean[..., :-1], atol=1e-5, rtol=0.0)


def test_the_prior_says_what_is_wrong_with_it():
    with pytest.raises(InputError, match=r"noise_mm is 0.0, expected more than 0"):
        AdaptationPrior(noise_mm=0.0)


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
