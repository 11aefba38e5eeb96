"""Lags between command and measurement: of first-order systems in closed form, and of no others."""

import re
import time
from dataclasses import replace

import numpy as np
import pytest

from surgisoft.diagnosis.data_quality import valve_hints
from surgisoft.measurement.recordings import Recording, summary
from surgisoft.measurement.recordings.valves import changed_valves, valve_lags, valve_words

STEP_S, HELD_ROWS = 0.05, 20
"""Time between rows, and rows for which a command is held: 1 s."""


def behind(lags_s, dead_s=0.0, rows=1600, noise_kPa=0.1, seed=0, runs=1) -> Recording:
    """Steps of each chamber between 0 and 50 kPa, and the exact answer of first-order lags.

    A step at row k, which is felt from t_k + dead_s on, decays by exp(-time / lag).
    """
    rng = np.random.default_rng(seed)
    lags = np.asarray(lags_s, float)
    command = np.repeat(rng.uniform(0.0, 50.0, (rows // HELD_ROWS, len(lags))), HELD_ROWS, 0)
    t_s = STEP_S * np.arange(rows)
    measured = np.empty_like(command)
    measured[:] = command[0]
    for start in range(HELD_ROWS, rows, HELD_ROWS):
        since = (t_s - t_s[start] - dead_s)[:, None]
        answer = np.where(since > 0.0, 1.0 - np.exp(-np.maximum(since, 0.0) / lags), 0.0)
        measured += (command[start] - command[start - 1]) * answer
    measured = 1.02 * measured + 0.7 + rng.normal(0.0, noise_kPa, measured.shape)
    run = np.arange(rows) * runs // rows
    for one in range(runs):
        t_s[run == one] -= t_s[run == one][0]
    points = np.zeros((rows, 2, 3))
    return Recording("valves", t_s, measured, points, commanded=command, run=run)


@pytest.mark.parametrize("dead_s", [0.0, 0.1, 0.42])
def test_lag_and_dead_time_are_those_of_the_closed_form(dead_s):
    found = valve_lags(behind([0.1, 0.4, 1.5], dead_s))
    assert [each.lag_s for each in found] == pytest.approx([0.1, 0.4, 1.5], rel=0.05)
    assert [each.dead_s for each in found] == pytest.approx([dead_s] * 3, abs=0.02)


def test_no_dead_time_is_told_that_the_rows_cannot_show():
    """A command that changes smoothly, each value held for a row, and its exact answer."""
    t_s = STEP_S * np.arange(3000)
    waves = np.sin(2 * np.pi * np.outer(t_s, [0.13, 0.31, 0.47]) + [0.3, 1.1, 2.0])
    command = 50.0 + 15.0 * waves @ np.array([[1.0, 1.0], [1.0, -1.0], [0.5, 1.0]])
    measured = command.copy()
    for row in range(1, len(t_s)):
        held = command[row - 1]
        measured[row] = held + np.exp(-STEP_S / 0.2) * (measured[row - 1] - held)
    for seed in range(3):
        noise = np.random.default_rng(seed).normal(0.0, 0.1, measured.shape)
        given = Recording("v", t_s, measured + noise, np.zeros((3000, 2, 3)), commanded=command)
        assert valve_words(given) == "measured follows commanded: lag 0.2, 0.2 s"


def test_many_short_runs_cost_as_much_as_one_long_run():
    def seconds(runs):
        start = time.process_time()
        valve_lags(behind([0.3, 0.3, 0.3], rows=4000, runs=runs))
        return time.process_time() - start

    seconds(1)
    assert seconds(2000) < 6.0 * seconds(1)


def test_a_sensor_with_outliers_and_an_offset_has_the_same_lag():
    given = behind([0.3])
    measured = given.measured.copy()
    measured[::400] += 40.0
    (found,) = valve_lags(replace(given, measured=3.0 * measured + 20.0))
    assert found.lag_s == pytest.approx(0.3, rel=0.1)


def test_every_run_begins_anew():
    given = behind([0.4], rows=2000, runs=4)
    assert valve_lags(given)[0].lag_s == pytest.approx(0.4, rel=0.05)
    assert "measured follows commanded: lag 0.4 s" in "\n".join(summary(given))


def test_nothing_is_said_where_no_first_order_lag_shows():
    """A channel that is not its command's, one that follows within a row, one at rest."""
    given = behind([0.3, 0.3, 0.3])
    measured = given.measured.copy()
    measured[:, 0] = np.random.default_rng(1).uniform(0.0, 50.0, given.samples)
    measured[:, 1] = given.commanded[:, 1]
    found = valve_lags(replace(given, measured=measured))
    assert found[:2] == [None, None]
    assert found[2].lag_s == pytest.approx(0.3, rel=0.05)
    words = valve_words(replace(given, measured=measured))
    assert words.startswith("measured follows commanded: lag -, -, 0.3 s (- where a channel has no")
    still = replace(given, commanded=np.full_like(given.commanded, 20.0))
    assert valve_words(still) == ""
    assert valve_words(replace(given, commanded=None)) == ""
    assert valve_lags(replace(given, kind="settled")) == []
    assert valve_words(replace(given, measured=given.commanded)) == ""


def test_valves_that_became_slower_are_told_by_channel():
    before, after = behind([0.1, 0.2]), behind([0.1, 0.6], seed=3)
    text = changed_valves([after], [before, behind([0.1, 0.2], seed=4)])
    said = re.fullmatch(r"measured .* another delay: channel 2 by (\S+) s, before by (\S+) s", text)
    assert [float(each) for each in said.groups()] == pytest.approx([0.6, 0.2], rel=0.05)
    assert changed_valves([before], [behind([0.11, 0.21], seed=4)]) == ""
    assert changed_valves([after], [replace(before, commanded=None)]) == ""


@pytest.mark.parametrize("before", [[], [replace(behind([0.2]), commanded=None)]])
def test_without_lags_before_none_are_looked_for_after(before, monkeypatch):
    looked = []

    def counted(recording):
        looked.append(recording)
        return valve_lags(recording)

    monkeypatch.setattr("surgisoft.measurement.recordings.valves.valve_lags", counted)
    after = behind([0.2], seed=3)
    assert changed_valves([after], before) == ""
    assert not any(recording is after for recording in looked)


@pytest.mark.parametrize(
    ("actuation", "means"),
    [("measured", "which contains the delay"), ("commanded", "the change is one of line_lag")],
)
def test_a_diagnosis_says_what_slower_valves_mean_for_its_model(actuation, means):
    before, after = behind([0.1, 0.2]), behind([0.1, 0.6], seed=3)
    (hint,) = valve_hints([after], [before], actuation)
    assert "channel 2" in hint
    assert hint.endswith(means)
    assert valve_hints([after], [after], actuation) == valve_hints([after], [], actuation) == ()
