"""One key point in another unit of length than the others."""

import numpy as np
import pytest

from surgisoft.diagnosis.setup import find_setup_faults
from surgisoft.surrogate.checkpoint import default_arm
from tests.diagnosis.setup import recordings
from tests.diagnosis.setup.recordings import turned, with_points
from tests.diagnosis.small import measured, small_arm

CASES = [
    ((2,), 0.1, "as cm beside mm"),
    ((4,), 10.0, "as mm beside cm"),
    ((1, 3), 1.0 / 25.4, "as in beside mm"),
]


def scaled(recording, points, ratio):
    key_points = recording.key_points_mm.copy()
    key_points[:, list(points)] *= ratio
    return with_points(recording, key_points)


@pytest.mark.parametrize(("points", "ratio", "units"), CASES)
def test_key_points_in_another_unit_are_named_with_the_factor(points, ratio, units):
    arm, right = default_arm(), recordings.measured()
    found = find_setup_faults(arm, [scaled(right, points, ratio)])
    assert found is not None
    assert found.kinds == ("length_unit",)
    assert found.faults[0].numbers["key_points"] == list(points)
    assert found.faults[0].numbers["ratio"] == pytest.approx(ratio)
    assert units in found.sentence
    assert not found.correctable
    assert f"multiply the coordinates of k{points[0]}" in found.instructions
    assert f"by {1.0 / ratio:g} in the file" in found.instructions
    apart = (ratio - 1.0) * right.key_points_mm[:, list(points)]
    expected = np.sqrt(np.square(apart).sum() / right.key_points_mm[..., 0].size)
    assert found.before_mm == pytest.approx(expected, rel=0.05)
    assert found.after_mm < 0.5


def test_key_points_that_are_right_are_in_no_other_unit():
    arm, right = small_arm(), measured()
    assert find_setup_faults(arm, [right]) is None
    assert find_setup_faults(arm, [scaled(right, (0,), 0.1)]) is None, "the base is at the origin"
    bumped = turned(right, (0.0, 0.0, 0.0), (1.6, 0.0, 0.0))
    assert find_setup_faults(arm, [bumped]) is None, "a large ratio takes the base back to it"


def test_a_body_that_is_in_another_unit_as_a_whole_is_no_mixture():
    """Its base is at the origin, where the ratio changes nothing but the noise."""
    found = find_setup_faults(small_arm(), [scaled(measured(), range(5), 0.1)])
    assert found is not None
    assert found.kinds == ("length_unit",)
    assert found.correctable
    assert "key_points" not in found.faults[0].numbers


def test_a_body_in_another_unit_from_tip_to_base_is_no_mixture():
    """The key point in the middle has its place and the ratio of the unit; the others have not."""
    recording = scaled(measured(), range(5), 0.1)
    found = find_setup_faults(
        small_arm(), [with_points(recording, recording.key_points_mm[:, ::-1])]
    )
    assert found is not None
    assert found.kinds == ("key_points", "length_unit")


def test_a_frame_that_is_turned_is_no_mixture():
    found = find_setup_faults(small_arm(), [turned(measured(), (0.0, 1.2, 0.0))])
    assert found is not None
    assert found.kinds == ("frame",)
