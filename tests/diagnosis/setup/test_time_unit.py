"""Times in another unit: proved by the model's memory, or by rows that are impossibly far apart."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.diagnosis.setup import find_setup_faults
from surgisoft.measurement.histories import history_of
from surgisoft.measurement.recordings import AlarmInfo
from surgisoft.surrogate.effects.line_lag import LineLag
from tests.diagnosis.setup.recordings import NOISE_MM, in_time, with_points
from tests.diagnosis.small import measured, small_arm


@pytest.fixture(scope="module")
def plain():
    """A model whose predictions do not depend on time: its hysteresis has no rate."""
    return small_arm()


@pytest.fixture(scope="module")
def model(plain):
    """The same arm behind a line that lags by 0.3 s."""
    lag = LineLag(plain.facts, 0.3, 0.3)
    lag.share.data.fill_(1.0)
    return plain.replace(effects={"line_lag": lag, **plain.effects}).eval().requires_grad_(False)


def moved_by(arm, step_s: float):
    """What a model predicts for the usual actuation with rows so far apart [s], with noise."""
    usual = measured()
    timed = replace(usual, t_s=step_s * np.arange(usual.samples))
    with torch.no_grad():
        points = arm.predict(history_of([timed]))[0].double().numpy()
    noise = np.random.default_rng(5).normal(0, NOISE_MM, points.shape)
    return with_points(timed, points + noise)


def test_the_memory_proves_a_unit_that_the_rows_do_not(model):
    right = moved_by(model, 0.002)
    wrong = in_time(right, 1e3)  # one row each 2 s, which is possible
    found = find_setup_faults(model, [wrong])
    assert found.kinds == ("time_unit",)
    assert found.faults[0].numbers == {"s_per_recorded_s": 1e-3}
    np.testing.assert_allclose(found.corrected([wrong])[0].t_s, right.t_s, rtol=1e-12)
    assert find_setup_faults(model, [right]) is None


def test_a_memory_that_the_arm_has_lost_is_physics(model, plain):
    """Read as seconds the rows, 5 ms apart, would take every memory away, as a new line does."""
    still = moved_by(plain, 0.005)
    assert find_setup_faults(model, [still]) is None


def test_a_model_without_memory_leaves_it_to_the_rows(plain):
    right = moved_by(plain, 0.1)
    assert find_setup_faults(plain, [in_time(right, 20.0)]) is None  # one row each 2 s
    found = find_setup_faults(plain, [in_time(right, 1e3)])  # one row each 100 s
    assert found.kinds == ("time_unit",)
    assert "one row each 0.1 s, where 100 s is stated" in found.sentence
    assert "reduces the error" not in found.sentence
    assert 'kind = "settled"' in found.how_to_tell


def test_a_slow_recording_whose_memory_the_model_knows_is_right(model):
    """One row each 20 s: read as ms the model would lag where the arm does not."""
    assert find_setup_faults(model, [moved_by(model, 20.0)]) is None


def test_rows_that_jump_from_value_to_value_are_no_moving_arm(plain):
    right = moved_by(plain, 0.1)
    order = np.random.default_rng(3).permutation(right.samples)
    jumping = replace(
        in_time(right, 300.0),
        measured=right.measured[order],
        commanded=right.commanded[order],
        key_points_mm=right.key_points_mm[order],
    )
    assert find_setup_faults(plain, [jumping]) is None


def test_steady_state_samples_have_no_time(plain):
    settled = replace(in_time(moved_by(plain, 0.1), 1e3), kind="settled")
    assert find_setup_faults(plain, [settled]) is None


def test_one_of_two_recordings_in_another_unit(model):
    right, wrong = moved_by(model, 0.1), replace(in_time(moved_by(model, 0.1), 1e3), name="ms")
    found = find_setup_faults(model, [right, wrong])
    assert (found.kinds, found.recordings) == (("time_unit",), ("ms",))


def test_the_time_of_an_alarm_is_corrected_too(model):
    wrong = replace(in_time(moved_by(model, 0.1), 1e3), alarm=AlarmInfo(2e5, 1e5))
    (corrected,) = find_setup_faults(model, [wrong]).corrected([wrong])
    assert corrected.alarm == AlarmInfo(200.0, 100.0)
