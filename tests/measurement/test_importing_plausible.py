"""Notes of an import about a set-up that cannot be right."""

from dataclasses import replace

import numpy as np
import pytest

from surgisoft.measurement.importing.plausible import plausibility_notes
from surgisoft.measurement.recordings import ArmInfo, Recording


def recording(scale: float = 1.0, reverse: bool = False, length_mm: float | None = 90.0):
    """An arm of 90 mm whose tip swings by 30 mm."""
    t = 0.1 * np.arange(300)
    points = np.zeros((300, 4, 3))
    points[..., 2] = [0.0, 30.0, 60.0, 90.0]
    points[..., 0] = np.sin(t)[:, None] * np.array([0.0, 3.0, 12.0, 30.0])
    points = points[:, ::-1] if reverse else points
    return Recording(
        name="arm",
        t_s=t,
        measured=np.sin(t)[:, None],
        key_points_mm=scale * points,
        arm=ArmInfo(length_mm=length_mm),
    )


def test_a_right_set_up_has_no_notes():
    assert plausibility_notes(recording(), "mm") == []
    assert plausibility_notes(recording(length_mm=None), "mm") == []


@pytest.mark.parametrize(
    ("scale", "unit", "proposed"), [(0.1, "mm", "cm"), (0.001, "mm", "m"), (1000.0, "m", "mm")]
)
def test_a_length_that_contradicts_the_arm(scale, unit, proposed):
    (note,) = plausibility_notes(recording(scale), unit)
    assert f'set unit = "{proposed}"' in note
    assert "the arm is 90 mm long" in note


def test_a_length_that_no_unit_explains():
    (note,) = plausibility_notes(replace(recording(), arm=ArmInfo(1100.0)), "mm")
    assert "check unit and scale" in note or 'unit = "cm"' in note


def test_reversed_key_points():
    (note,) = plausibility_notes(recording(reverse=True), "mm")
    assert "order = [3, 2, 1, 0]" in note
