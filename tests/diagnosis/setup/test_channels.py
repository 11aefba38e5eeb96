"""Dead and frozen channels, and chambers that do not act."""

from dataclasses import replace

import numpy as np
import pytest

from surgisoft.diagnosis.setup import find_setup_faults
from surgisoft.diagnosis.setup.channels import dead_channels
from tests.diagnosis.setup.recordings import turned, with_points
from tests.diagnosis.small import measured, predicted, small_arm


@pytest.fixture(scope="module")
def model():
    return small_arm()


def without_channel(recording, k, commanded=True):
    values = recording.measured.copy()
    values[:, k] = 0.0
    command = recording.commanded if commanded else None
    return replace(recording, measured=values, commanded=command)


def test_a_dead_channel_is_mended_by_its_command(model):
    original = measured()
    wrong = without_channel(original, 1)
    found = find_setup_faults(model, [wrong])
    assert found.kinds == ("dead_chamber",)
    assert found.faults[0].numbers["channel"] == 2
    np.testing.assert_array_equal(found.corrected([wrong])[0].measured, original.measured)


@pytest.mark.parametrize("vector", [(0.0, 0.0, 0.0), (0.4, -0.8, 1.0)])
def test_a_dead_channel_without_a_command_shows_in_the_body(model, vector):
    original = turned(measured(), vector)
    found = find_setup_faults(model, [without_channel(original, 2, commanded=False)])
    assert found.kinds[0] == "dead_chamber"
    assert ("frame" in found.kinds) == any(vector)
    assert not found.correctable
    low, high = np.quantile(original.measured[:, 2], [0.05, 0.95])
    assert found.faults[0].numbers["range"] == pytest.approx([low, high], abs=4.0)


def test_a_channel_that_rests_in_truth_is_not_dead(model):
    import torch

    from surgisoft.measurement.histories import history_of

    still = without_channel(predicted(), 0)
    with torch.no_grad():
        true = model.predict(history_of([still]))[0].double().numpy()
    noise = np.random.default_rng(0).normal(0, 0.05, true.shape)
    assert find_setup_faults(model, [with_points(still, true + noise)]) is None


def test_a_chamber_that_the_arm_leaves_idle_is_not_dead(model):
    """A channel that stands still is dead only where every chamber of the arm moves."""
    still = [without_channel(measured(), 2)]
    assert dead_channels(model.spec, still)[0].chambers == (2,)
    resting = replace(model.spec, idle=(None, None, 0.0))
    assert dead_channels(resting, still)[0].chambers == ()


def test_a_dead_key_point_becomes_missing(model):
    original = measured()
    points = original.key_points_mm.copy()
    points[:, 3] = [1.0, 2.0, 3.0]
    wrong = with_points(original, points)
    found = find_setup_faults(model, [wrong])
    assert found.kinds == ("dead_key_point",)
    assert "k3" in found.sentence
    corrected = found.corrected([wrong])[0].key_points_mm
    assert np.isnan(corrected[:, 3]).all()
    np.testing.assert_array_equal(
        corrected[:, [0, 1, 2, 4]], original.key_points_mm[:, [0, 1, 2, 4]]
    )


def test_a_key_point_frozen_for_a_while_is_missing_there(model):
    original = measured()
    points = original.key_points_mm.copy()
    points[600:1100, 4] = points[600, 4]
    wrong = with_points(original, points)
    found = find_setup_faults(model, [wrong])
    assert found.kinds == ("dead_key_point",)
    lost = np.isnan(found.corrected([wrong])[0].key_points_mm[:, 4, 0])
    assert lost[601:1100].all()
    assert not lost[:600].any()
    assert not lost[1100:].any()


@pytest.mark.parametrize("recording", [measured, predicted], ids=["with noise", "without noise"])
def test_a_base_that_stands_still_is_no_fault(model, recording):
    points = recording().key_points_mm.copy()
    points[:, 0] = points[0, 0]
    assert find_setup_faults(model, [with_points(recording(), points)]) is None


def test_a_chamber_that_does_not_act(model):
    import torch

    from surgisoft.measurement.histories import history_of

    logged = predicted()
    at_rest = without_channel(logged, 0)
    with torch.no_grad():
        true = model.predict(history_of([at_rest]))[0].double().numpy()
    noise = np.random.default_rng(0).normal(0, 0.05, true.shape)
    found = find_setup_faults(model, [with_points(logged, true + noise)])
    assert found.kinds == ("chambers",)
    assert "chamber 1 does not act" in found.sentence
    assert not found.correctable


def sensed(rows=2400):
    """A recording whose pressure sensors have noise, so that no reading comes again."""
    original = measured(rows)
    noise = np.random.default_rng(1).normal(0.0, 0.02, original.measured.shape)
    return replace(original, measured=original.measured + noise)


@pytest.mark.parametrize(("stop", "counts"), [(1100, True), (680, False)])
def test_a_channel_frozen_for_a_while_hides_those_rows(model, stop, counts):
    """A fifth of the rows of one recording of two; or 3 % of one, which is only warned of."""
    original = sensed()
    values = original.measured.copy()
    values[600:stop, 1] = values[600, 1]
    frozen = replace(original, measured=values)
    recordings = [frozen, sensed()] if counts else [frozen]
    dead, masked, driven = dead_channels(model.spec, recordings)
    assert dead.chambers == ()
    lost = np.isnan(masked[0].key_points_mm).all((1, 2))
    if not counts:
        assert not dead
        assert not lost.any()
        return
    assert dead.frozen == {1: pytest.approx(500 / 4800, abs=0.001)}
    assert lost[601:1100].all()
    assert not lost[:600].any()
    assert not lost[1100:].any()
    assert np.isfinite(masked[1].key_points_mm).all()
    assert driven is masked, "the command takes the place of dead channels alone"


def test_a_key_point_frozen_in_few_rows_is_only_warned_of(model):
    original = measured()
    points = original.key_points_mm.copy()
    points[600:700, 4] = points[600, 4]
    dead, masked, _ = dead_channels(model.spec, [with_points(original, points)])
    assert not dead
    np.testing.assert_array_equal(masked[0].key_points_mm, points)
    points[600:760, 4] = points[600, 4]
    dead, masked, _ = dead_channels(model.spec, [with_points(original, points)])
    assert dead.key_points == {4: pytest.approx(160 / 2400, abs=0.001)}
    assert np.isnan(masked[0].key_points_mm[610:750, 4]).all()
    assert np.isfinite(masked[0].key_points_mm[:, :4]).all()


@pytest.mark.parametrize(("share", "dead"), [(0.1, ()), (0.01, ()), (0.001, (1,))])
def test_a_channel_that_moves_a_little_is_not_dead(model, share, dead):
    """A hundredth of the range of the others is a motion, a thousandth is noise."""
    values = measured().measured * [1.0, share, 1.0]
    assert dead_channels(model.spec, [replace(measured(), measured=values)])[0].chambers == dead


def test_a_model_of_commands_has_no_dead_sensor(model):
    """Its chambers follow the commands, whatever a sensor reads."""
    still = [without_channel(measured(), 1)]
    asked = replace(model.spec, actuation="commanded")
    assert dead_channels(asked, still)[0].chambers == ()
    assert dead_channels(model.spec, still)[0].chambers == (1,)
