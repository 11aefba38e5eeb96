"""Kernel regression with memory: exact where it can be computed by hand, honest about its error."""

import copy
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.surrogate import kernel_fit, prior_mean
from surgisoft.surrogate.fit import FitConfig, fit
from surgisoft.surrogate.history import pack
from surgisoft.surrogate.interval import coverage_of
from surgisoft.surrogate.networks import HawNN, KernelArm
from surgisoft.surrogate.training import Data
from tests.surrogate.test_fit import NOISE, lagging, rmse, runs
from tests.surrogate.truth import SPEC

KERNEL = FitConfig(network="kernel")


def lagged(seeds, rows: int = 200):
    """Runs of an arm whose line lags, one a seed."""
    some = [lagging(rows, seed) for seed in seeds]
    return pack(*([run[k] for run in some] for k in range(3)))


@pytest.fixture(scope="module", autouse=True)
def short_fits():
    """Fewer landmarks, folds and trials than by default: the fits of this file are short."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernel_fit, "LANDMARKS", 150)
        patch.setattr(kernel_fit, "FOLDS", 3)
        patch.setattr(prior_mean, "MOST_ROWS", 300)
        patch.setattr(kernel_fit, "FOLD_ITERATIONS", 8)
        patch.setattr(kernel_fit, "WIDTHS", (1.0, 2.0))
        yield


@pytest.fixture(scope="module")
def fitted():
    """Kernel regression on eight runs of an arm whose line lags."""
    return fit(lagged(range(8)), None, SPEC, KERNEL)


def without_clock(history):
    """The history as steady-state samples."""
    return replace(history, stood=torch.full_like(history.pressure[:, 0], torch.nan))


def test_the_memory_of_a_line_is_learned(fitted):
    fresh = lagged(range(20, 26))
    static = fit(without_clock(lagged(range(8))), None, SPEC, KERNEL)
    assert not static.model.remembers
    assert rmse(fitted.model, fresh) < 0.35 * rmse(static.model, fresh)


def test_its_error_is_known_on_runs_that_took_no_part(fitted):
    fresh = lagged(range(30, 42))
    validation = fitted.model.validation
    assert validation.interval.source == "cross-validation"
    assert (validation.interval.groups, validation.rows) == (8, 1600)
    assert np.sqrt(3) * rmse(fitted.model, fresh) == pytest.approx(validation.rmse_mm, rel=0.35)
    found = fitted.model.predict_interval(fresh)
    error = (found.key_points_mm - fresh.key_points).norm(dim=-1)
    assert 0.92 <= coverage_of(error, found.radius_mm) <= 0.99


def test_without_memory_it_is_the_mean_of_a_gaussian_process():
    """With every row a landmark: k (K + ridge I)^-1 (y - arcs), solved here by NumPy."""
    train = without_clock(runs(range(6), 25))
    result = fit(train, None, SPEC, KERNEL)
    network = result.model.network
    assert network.landmarks == 150
    settings = re.fullmatch(r"width (\S+), .* ridge (\S+)", result.stages[0].settings)
    width, ridge = map(float, settings.groups())
    low, high = np.array(SPEC.low), np.array(SPEC.high)

    def scaled(pressure):
        return (pressure.double().numpy() - (low + high) / 2) / ((high - low) / 2) / width

    def kernel(a, b):
        return np.exp(-np.square(a[:, None] - b).sum(-1) / 2)

    def arcs(pressure):
        return network.prior(pressure).double().numpy()

    pressure = train.rows(train.pressure)
    x, y = scaled(pressure), train.rows(train.key_points).double().numpy() - arcs(pressure)
    solved = np.linalg.solve(kernel(x, x) + ridge * np.eye(len(x)), y.reshape(len(x), -1))
    fresh = runs(range(60, 62), 40)
    at = fresh.rows(fresh.pressure)
    expected = arcs(at) + (kernel(scaled(at), x) @ solved).reshape(-1, 3, 3)
    found = result.model.predict(fresh)[fresh.valid].numpy()
    added = np.sqrt(np.square(expected - arcs(at)).mean())
    assert added > 0.5 * NOISE, "else there is nothing to compare"
    assert np.sqrt(np.square(found - expected).mean()) < 0.02 * added, "all but the jitter"


def test_missing_key_points_are_left_out_one_by_one(fitted):
    train, fresh = lagged(range(8)), lagged(range(20, 26))
    points = train.key_points.clone()
    points[:, ::2, 1] = torch.nan
    gappy = fit(replace(train, key_points=points), None, SPEC, KERNEL).model
    assert rmse(gappy, fresh) < 1.2 * rmse(fitted.model, fresh)


def test_the_slope_is_that_of_whole_runs_that_are_offset(fitted):
    model, history = fitted.model, lagged([50], 60)
    chain, first = model.chain, model.first_pressure(history)
    slope = chain.slope(history, first, model.scan(history), history.rows)
    start = chain.standing(first, signals=False)[0].memory["network"].double()
    network = copy.deepcopy(model.network).double()
    for chamber in range(3):
        ends = []
        for h in (0.01, -0.01):
            pressure, memory = history.pressure.double(), start.clone()
            pressure[..., chamber] += h
            memory[:, chamber] += h
            ends.append(network.along(pressure, history, memory)[0])
        expected = (ends[0] - ends[1]) / 0.02
        assert torch.allclose(slope[..., chamber].double(), expected, atol=2e-3)


def test_auto_takes_the_network_or_the_kernel_by_held_out_error():
    small = FitConfig(network="auto", hidden=(16,), epochs=10, inputs="pressure", batch=128)
    with_lag = fit(lagged(range(6), 150), None, SPEC, small)
    assert isinstance(with_lag.model.network, KernelArm)
    stage = with_lag.stages[-1]
    assert stage.kept
    assert stage.valid_rmse_mm < stage.simpler_rmse_mm
    lines = "\n".join(with_lag.lines())
    assert "lags x" in lines
    assert with_lag.covered is None, "every run of the training took part"
    valid = lagged(range(20, 23))
    mirrored = replace(valid, key_points=valid.key_points * torch.tensor([-1.0, -1.0, 1.0]))
    other = fit(lagged(range(6), 150), mirrored, SPEC, small)
    assert isinstance(other.model.network, HawNN), "less wrong there, for it learned less"
    assert not other.stages[-1].kept


def test_a_run_takes_no_part_in_its_own_left_out_prediction():
    """One run bends the other way: arcs and weights of the others cannot know."""
    train = lagged(range(6), 100)
    turned = train.key_points.clone()
    turned[3, ..., :2] *= -1.0
    data = Data.split(replace(train, key_points=turned), None, 0)
    found = kernel_fit.fit_kernel(data, SPEC, True, 0, lambda *of: None)
    mine = torch.arange(6).repeat_interleave(100) == 3
    mirror = torch.tensor([-1.0, -1.0, 1.0])
    off = (found.predicted_mm - found.measured_mm)[mine].square().sum(-1).mean()
    as_others = (found.predicted_mm - mirror * found.measured_mm)[mine].square().sum(-1).mean()
    assert as_others < 0.2 * off


def test_rows_held_out_share_no_fold_with_others():
    """One of two runs is held out: a single fold would leave no rows to predict them from."""
    train = lagged(range(5), 60)
    points = train.key_points.clone()
    points[2:] = torch.nan
    held = torch.zeros_like(train.valid)
    held[0] = True
    data = Data(replace(train, key_points=points), None, held)
    found = kernel_fit.fit_kernel(data, SPEC, True, 0, lambda *of: None)
    assert found.held.tolist() == 60 * [True] + 60 * [False]
    assert not found.predicted_mm.isnan().any()


def test_effects_are_left_to_amend():
    with pytest.raises(InputError, match="kernel is fitted without any, and 'amend'"):
        fit(runs(range(6)), None, SPEC, replace(KERNEL, effects=("line_lag",)))


def test_an_unknown_network_is_named():
    with pytest.raises(InputError, match=r"unknown network 'kernels'.*kernel"):
        fit(runs(range(6)), None, SPEC, replace(KERNEL, network="kernels"))
