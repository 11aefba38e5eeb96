"""Time between rows of a recording, and gaps inside its runs."""

from dataclasses import replace

import numpy as np
import pytest

from surgisoft.measurement.recordings import Recording
from surgisoft.measurement.recordings.clock import (
    Gap,
    follows_motion,
    gaps,
    gaps_in_words,
    time_factors,
    usual_step_s,
)


def recording(t_s, **changes) -> Recording:
    t_s = np.asarray(t_s, float)
    rows = len(t_s)
    fields = {"measured": np.zeros((rows, 1)), "key_points_mm": np.zeros((rows, 1, 3))}
    return Recording(name="bench", t_s=t_s, **(fields | changes))


def at(*stretches, step=0.05):
    """Times of stretches (begin, rows), one row each `step` s."""
    return np.concatenate([begin + step * np.arange(rows) for begin, rows in stretches])


def test_a_gap_is_named_with_the_line_that_begins_a_run_behind_it():
    text = gaps_in_words(recording(at((0.0, 100), (40.0, 100))))
    assert text.startswith("a gap without rows inside a run (35.05 s from 4.95 s on), over which")
    assert "set gap_s = 1 in [runs] of the map, so that a new run begins behind it" in text


def test_many_gaps_are_counted():
    text = gaps_in_words(recording(at(*((10.0 * k, 40) for k in range(6)))))
    assert text.startswith("gaps without rows inside a run (8.05 s from 1.95 s on, ")
    assert "8.05 s from 21.95 s on and 2 more)" in text
    assert "behind each" in text


def test_a_slow_recording_that_lost_rows_has_no_gap():
    slow = recording(at((0.0, 50), (60.0, 50), step=1.0))  # eleven steps of 1 s
    assert gaps(slow) == ([Gap(49.0, 60.0)], 10.0)
    assert gaps(recording(at((0.0, 50), (59.0, 50), step=1.0)))[0] == []
    assert gaps(recording(at((0.0, 50), (3.4, 50))))[0] == []  # 0.95 s at 20 Hz


def test_another_run_and_steady_state_samples_have_no_gap():
    t_s = at((0.0, 100), (40.0, 100))
    apart = recording(t_s, run=np.repeat([0, 1], 100))
    assert gaps_in_words(apart) == ""
    assert gaps_in_words(replace(recording(t_s), kind="settled")) == ""
    assert gaps_in_words(recording([0.0])) == ""


def test_the_usual_step_does_not_count_the_time_between_runs():
    t_s = np.repeat(100.0 * np.arange(20), 2) + np.tile([0.0, 0.05], 20)
    assert usual_step_s([recording(t_s, run=np.repeat(np.arange(20), 2))]) == pytest.approx(0.05)
    assert usual_step_s([recording([0.0])]) is None


def test_the_von_neumann_ratio_of_unordered_rows_is_one():
    rng = np.random.default_rng(0)
    assert not follows_motion([rng.normal(size=(500, 2))])
    assert follows_motion([np.cumsum(rng.normal(size=(500, 2)), axis=0)])
    assert not follows_motion([np.ones((500, 2))])


@pytest.mark.parametrize(
    ("step_s", "factors"),
    [(50.0, [1e-3]), (5e4, [1e-6]), (5e-5, [1e3]), (10.0, [1e-3]), (1e-4, [1e3])],
)
def test_only_units_that_give_a_possible_time_between_rows_are_tried(step_s, factors):
    assert time_factors(step_s) == factors
