"""Recordings as histories: what comes with the actuation."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.measurement.histories import (
    actuation_noise,
    arm_spec,
    faster_than_fit,
    history_of,
    moved_together,
    speed_of,
    tied_channels,
)
from surgisoft.measurement.recordings import Recording


def recording(name: str, temperature=None) -> Recording:
    """Two runs of three and two rows, the second long after the first."""
    return Recording(
        name,
        np.array([0.0, 1.0, 2.0, 100.0, 101.0]),
        np.arange(5.0)[:, None],
        np.zeros((5, 2, 3)),
        run=np.array([0, 0, 0, 1, 1]),
        temp_C=temperature,
    )


def test_temperature_goes_with_its_rows_and_is_missing_where_it_was():
    warm = recording("warm", np.array([20.0, 21.0, np.nan, 23.0, 24.0]))
    history = history_of([warm, recording("unknown")])
    nan = torch.nan
    expected = [[20.0, 21.0, nan], [23.0, 24.0, 24.0], [nan] * 3, [nan] * 3]
    assert torch.allclose(history.temperature_C, torch.tensor(expected), equal_nan=True)
    second = history.select(torch.tensor([1]))
    assert second.temperature_C.tolist() == [[23.0, 24.0]]
    assert second.t_s.tolist() == [[100.0, 101.0]]


def test_without_any_temperature_there_is_none():
    assert history_of([recording("unknown")]).temperature_C is None
    nowhere = recording("missing", np.full(5, np.nan))
    assert history_of([nowhere]).temperature_C is None


def test_runs_know_where_the_measured_actuation_stood_when_they_began():
    first = recording("first")
    history = history_of([first, replace(first, kind="settled")])
    nan = torch.nan
    expected = torch.tensor([[0.0], [3.0], [nan], [nan]])
    assert torch.allclose(history.stood, expected, equal_nan=True)
    assert history.select(torch.tensor([1])).stood.tolist() == [[3.0]]
    commanded = replace(first, commanded=first.measured + 50)
    assert history_of([commanded], "commanded").stood.tolist() == [[0.0], [3.0]]


def test_a_step_from_run_to_run_is_no_noise():
    """Thirty runs of two rows, each beginning where the last one ended: steps of 0.1, 0.2, 0.3."""
    steps = np.tile([0.1, 0.2, 0.3], 10)
    ends = np.cumsum(steps * np.tile([1, -1], 15))
    measured = np.stack([np.concatenate([[0.0], ends[:-1]]), ends], axis=1).reshape(60, 1)
    measured = np.concatenate([measured, [[50.0], [51.5]]])  # the range, in a run of its own
    run = np.repeat(np.arange(31), 2)
    made = Recording("pairs", np.arange(62.0), measured, np.zeros((62, 1, 3)), run=run)
    expected = 1.4826 * 0.2 / np.sqrt(2)
    np.testing.assert_allclose(actuation_noise(made), [expected], rtol=1e-6)


def triangles(period_s, seconds=40.0, chambers=2, kind="continuous"):
    """Chamber 1 rises from 0 to 50 kPa and falls in each period, chamber 2 in three of them."""
    t_s = np.arange(0.0, seconds, 0.04)
    wave = [1 - np.abs((t_s / period % 1) * 2 - 1) for period in (period_s, 3 * period_s)]
    return Recording(
        f"triangles of {period_s:g} s",
        t_s,
        50.0 * np.stack(wave, 1),
        np.zeros((len(t_s), 2, 3)),
        kind=kind,
    )


def test_the_speed_is_that_of_the_fastest_chamber_in_its_range():
    """A triangle goes through its whole range twice in a period."""
    assert arm_spec([triangles(8.0)]).speed_per_s == pytest.approx(2 / 8.0, rel=0.03)
    assert speed_of([triangles(8.0)], (50.0, 50.0)) == pytest.approx(2 / 8.0, rel=1e-3)
    assert speed_of([triangles(8.0)], (100.0, 50.0)) == pytest.approx(1 / 8.0, rel=1e-3)
    # One row in twenty may be faster.
    some = [triangles(8.0, 400.0), triangles(2.0, 10.0)]
    assert speed_of(some, (50.0, 50.0)) == pytest.approx(2 / 8.0, rel=1e-3)
    assert speed_of([triangles(8.0), triangles(2.0)], (50.0, 50.0)) == pytest.approx(1.0, rel=1e-3)


def test_no_speed_leads_from_run_to_run_and_steady_states_have_none():
    slow = triangles(8.0)
    lift = np.where(slow.t_s[:, None] < 20.0, 0.0, 50.0)
    broken = replace(slow, measured=slow.measured + lift, run=(slow.t_s >= 20.0).astype(int))
    assert speed_of([broken], (50.0, 50.0)) == pytest.approx(2 / 8.0, rel=1e-3)
    assert speed_of([replace(slow, kind="settled")], (50.0, 50.0)) == 0.0
    # A chamber that rests has no range, and no speed.
    resting = replace(slow, measured=np.full_like(slow.measured, 50.0))
    assert speed_of([resting], (0.0, 0.0)) == 0.0


def test_motion_that_is_faster_than_that_of_the_fit_is_noted():
    spec = arm_spec([triangles(8.0)])
    assert faster_than_fit(spec, [triangles(6.0)]) == []
    (note,) = faster_than_fit(spec, [triangles(2.0)])
    assert "100 % of its range in a second, 4 times as fast as in the recordings of the fit" in note
    assert faster_than_fit(replace(spec, speed_per_s=None), [triangles(2.0)]) == []
    settled = arm_spec([triangles(8.0, kind="settled")])
    assert settled.speed_per_s == 0.0
    (note,) = faster_than_fit(settled, [triangles(8.0)])
    assert "and the recordings of the fit have steady states alone" in note
    assert faster_than_fit(settled, [triangles(8.0, kind="settled")]) == []


def test_channels_that_move_as_one_are_named():
    """Antagonistic tendons; three whose sum is constant; one that does not move."""
    rng = np.random.default_rng(0)
    free = rng.normal(size=(2000, 4))
    assert moved_together(free) == ""
    pairs = np.stack([free[:, 0], free[:, 1], 0.2 * free[:, 2] - free[:, 0], free[:, 1]], axis=1)
    # Of a variance of 1.04, 0.04 is another signal's: r = -1 / sqrt(1.04).
    assert moved_together(pairs) == (
        "channels 1 and 3 move against each other (r = -0.98), "
        "channels 2 and 4 move together (r = 1.00)"
    )
    all_four = free[:, :1] * [1.0, -1.0, 2.0, 1.0] + 0.2 * free[:, 1:2] * [0.0, 0.0, 0.0, 1.0]
    assert moved_together(all_four) == (
        "channels 1, 2, 3 and 4 move together or against each other (r = 0.98)"
    )
    apart = np.stack([free[:, 0], 0.5 * free[:, 1] - free[:, 0]], axis=1)
    assert moved_together(apart) == "", "r = -1 / sqrt(1.25) = -0.89"
    summed = np.stack([free[:, 0], free[:, 1], -free[:, 0] - free[:, 1]], axis=1)
    assert moved_together(summed) == "each of channels 1, 2 and 3 follows from the others"
    assert moved_together(np.column_stack([free[:, 0], np.ones(2000)])) == ""
    assert moved_together(np.zeros((9, 3))) == moved_together(free[:, :1]) == ""
    counts = [tied_channels(some) for some in (free, pairs, all_four, apart, free[:, :1])]
    assert counts == [0, 2, 3, 0, 0]
