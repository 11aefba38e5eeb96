"""Held-out rows: nothing but the final check depends on a key point of theirs."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.diagnosis.amend import amend
from surgisoft.diagnosis.design.next_experiment import next_experiment
from surgisoft.diagnosis.error_axes import shares
from surgisoft.diagnosis.improve import improve
from surgisoft.diagnosis.inputs import identification_problem
from surgisoft.diagnosis.residuals import Sealed, held_out_rows, residual_table
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import Recording
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.checkpoint import default_arm
from surgisoft.surrogate.model import ArmModel
from tests.diagnosis.synthetic import recording as synthetic_recording
from tests.diagnosis.synthetic import resting_together, still_model
from tests.few_effects import choose_among


@pytest.fixture(scope="module")
def pair() -> tuple[Recording, Recording]:
    """A recording of an arm that leaks, and the same with absurd held-out key points.

    The lab states no noise, so that it is estimated from the recording.
    """
    rig = VirtualRig(0, take=3, hidden=[("gain_mismatch", 1.5), ("leak", 1.5)])
    made = replace(rig.record(make_protocol("mixed", rig.limits, 1500, seed=3))[0], noise_mm=None)
    held = held_out_rows([made])
    points, rng = made.key_points_mm.copy(), np.random.default_rng(0)
    points[held] = 1e4 * rng.normal(size=points[held].shape)
    points[np.flatnonzero(held)[::3]] = np.nan
    return made, replace(made, key_points_mm=points)


def assert_same_model(one: ArmModel, other: ArmModel) -> None:
    first, second = one.state_dict(), other.state_dict()
    assert first.keys() == second.keys()
    for name, value in first.items():
        assert torch.equal(value, second[name]), name


def test_the_axis_that_an_unknown_effect_is_described_by(pair):
    problems = [identification_problem(default_arm(), [each]) for each in pair]
    axes = [shares(problem) for problem in problems]
    assert axes[0][0].clear
    assert axes[0] == axes[1]


def test_an_amended_model_and_its_parameters(pair):
    """The network is off by a constant, so that its last layer is re-tuned, too."""
    off = default_arm()
    with torch.no_grad():
        off.network.layers[-1].bias += 0.1
    results = [amend(off, [each], "gain_mismatch", refit="never") for each in pair]
    assert results[0].parameters == results[1].parameters
    assert results[0].training == results[1].training
    assert results[0].alone.p_value == results[1].alone.p_value
    assert_same_model(results[0].model, results[1].model)
    assert results[0].retuned
    assert results[0].held_out != results[1].held_out


def test_an_improved_model(pair, monkeypatch):
    """By a diagnosis that chooses among four effects, to save time."""
    choose_among(monkeypatch, "gain_mismatch", "creep", "payload", "misalignment")
    results = [improve(default_arm(), [each], 1, refit="never") for each in pair]
    assert [name for name, _ in results[0].steps] == [name for name, _ in results[1].steps]
    assert results[0].parameters == results[1].parameters != ()
    assert_same_model(results[0].model, results[1].model)
    assert results[0].held_out != results[1].held_out


def test_the_next_experiment(pair):
    advice = [
        next_experiment(
            default_arm(), [each], ("gain_mismatch", "coupling"), 5.0, ("as_it_stands",)
        )
        for each in pair
    ]
    assert advice[0].to_json() == advice[1].to_json()


@pytest.fixture(scope="module")
def resting() -> tuple[Recording, Recording]:
    """A recording with rests, whose scatter shows the noise; the same, noisier where held out."""
    pressure = resting_together(3000)
    made = synthetic_recording(0.3 * (pressure[:, 0] - 5.0), pressure, noise_mm=None)
    held, rng = held_out_rows([made]), np.random.default_rng(2)
    points = made.key_points_mm.copy()
    points[held] += rng.normal(0.0, 20.0, points[held].shape)
    return made, replace(made, key_points_mm=points)


def test_the_noise_that_an_identification_counts_with(resting):
    """Were the held-out rests looked at, the median of all rests would be a larger noise."""
    problems = [identification_problem(still_model(), [each]) for each in resting]
    assert problems[0].table.floor.source == "holds"
    assert problems[0].floor_mm == problems[1].floor_mm
    assert problems[0].history.noise_mm == problems[1].history.noise_mm
    assert residual_table(still_model(), [resting[1]]).floor != problems[1].table.floor


def test_the_noise_of_an_amended_model(resting):
    results = [amend(still_model(), [each], "misalignment", refit="never") for each in resting]
    assert results[0].alone.floor == results[1].alone.floor
    assert results[0].training == results[1].training


def test_held_out_rows_are_opened_once(pair):
    made = pair[0]
    sealed, held = Sealed([made]), held_out_rows([made])
    assert np.isnan(sealed.training[0].key_points_mm[held]).all()
    np.testing.assert_array_equal(
        sealed.training[0].key_points_mm[~held], made.key_points_mm[~held]
    )
    table = residual_table(default_arm(), sealed.training)
    assert np.isnan(table.history.rows(table.history.key_points).numpy()[held]).all()
    check = sealed.opened(table).final_check()
    np.testing.assert_array_equal(check.measured, made.key_points_mm[held])
    with pytest.raises(ValueError, match="used before"):
        sealed.opened(table)


def test_the_held_out_rows_come_back_once_beside_training_rows_as_they_are():
    """What was changed in the training rows since stays changed, in the history too."""
    made = synthetic_recording(np.zeros(400), resting_together(400))
    held = held_out_rows([made])
    sealed = Sealed([made])
    table = residual_table(still_model(), sealed.training)
    changed = replace(table, measured_mm=table.measured_mm + 1.0)
    opened = sealed.opened(changed)
    expected = made.key_points_mm + 1.0 * ~held[:, None, None]
    np.testing.assert_array_equal(opened.measured_mm, expected)
    inside = opened.history.rows(opened.history.key_points).numpy()
    np.testing.assert_allclose(inside, expected, atol=1e-4)
    with pytest.raises(ValueError, match="used before"):
        sealed.opened(changed)
