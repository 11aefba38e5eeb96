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
    results = [amend(default_arm(), [each], "gain_mismatch", refit="never") for each in pair]
    assert results[0].parameters == results[1].parameters
    assert results[0].training == results[1].training
    assert results[0].alone.p_value == results[1].alone.p_value
    assert_same_model(results[0].model, results[1].model)
    assert results[0].retuned
    assert results[0].held_out != results[1].held_out


def test_an_improved_model(pair):
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
    with pytest.raises(ValueError, match="opened before"):
        sealed.opened(table)
