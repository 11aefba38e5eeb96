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


def in_time(factor: float, **changes) -> Recording:
    """The recording, one row each 0.1 s, with times so many times as long."""
    return replace(recording(), t_s=factor * recording().t_s, **changes)


@pytest.mark.parametrize(
    ("factor", "unit", "step", "proposed"),
    [(1e3, "s", "100", "ms"), (1e6, "s", "1e+05", "us"), (1e-3, "ms", "0.0001", "s")],
)
def test_rows_that_cannot_follow_a_moving_arm(factor, unit, step, proposed):
    (note,) = plausibility_notes(in_time(factor), "mm", unit)
    assert note.startswith(f"one row each {step} s, expected 0.0005 to 2 s of an arm that moves: ")
    assert f'if the times are in {proposed}, set unit = "{proposed}" in [time]' in note
    assert ("settled" in note) == (factor > 1)


def test_rows_of_a_rate_are_checked_against_the_rate():
    (note,) = plausibility_notes(in_time(1e3), "mm", None)
    assert "check rate_hz, column and unit in [time]" in note


def test_usual_rows_steady_samples_and_jumping_rows_have_no_note_about_time():
    assert plausibility_notes(in_time(19.0), "mm", "s") == []  # one row each 1.9 s
    assert plausibility_notes(in_time(1e3, kind="settled"), "mm", "s") == []
    jumping = np.random.default_rng(0).permutation(recording().measured)
    assert plausibility_notes(in_time(1e3, measured=jumping), "mm", "s") == []
    still = np.zeros_like(recording().measured)
    assert plausibility_notes(in_time(1e3, measured=still), "mm", "s") == []
