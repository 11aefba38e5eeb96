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
        measured=30.0 * np.sin(t)[:, None],
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


@pytest.mark.parametrize(
    ("by", "unit", "proposed"),
    [(0.01, "kPa", "bar"), (1e-3, "kPa", "MPa"), (1e3, "kPa", "Pa"), (0.145, "psi", None)],
)
def test_pressures_that_no_arm_moves_at(by, unit, proposed):
    """60 kPa in another unit read as kPa; 8.7 psi are 60 kPa."""
    right = recording()
    notes = plausibility_notes(replace(right, measured=by * right.measured, unit=unit), "mm")
    if proposed is None:
        assert notes == []
        return
    assert f'if the values are in {proposed}, set unit = "{proposed}" in [measured]' in notes[0]
    assert f"moves by {np.ptp(by * right.measured):.3g} kPa at most" in notes[0]
    resting = replace(right, measured=by * right.measured, unit=unit)
    resting = replace(resting, key_points_mm=right.key_points_mm[:1].repeat(300, axis=0))
    assert plausibility_notes(resting, "mm") == []


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


def driven(measured_by, shift_s: float = 0.0, seed: int = 0, **changes) -> Recording:
    """Five minutes at 20 Hz of three chambers, each ramped to a new command every two seconds.

    measured_by: a function from the commands (T, 3), late by `shift_s`, to the measured actuation.
    """
    rng = np.random.default_rng(seed)
    t = 0.05 * np.arange(6000)
    knots = rng.uniform(0.0, 20.0, (200, 3))

    def commands(at):
        return np.stack([np.interp(at, 2.0 * np.arange(200), k) for k in knots.T], axis=1)

    points = np.zeros((len(t), 1, 3))
    points[:, 0, 2] = 50.0
    measured = measured_by(commands(t - shift_s)) + 0.05 * rng.standard_normal((len(t), 3))
    return Recording(
        name="arm",
        t_s=t,
        measured=measured,
        key_points_mm=points,
        commanded=changes.pop("commanded", commands(t)),
        **changes,
    )


@pytest.mark.parametrize("shift_s", [0.0, 0.8, -0.4])
@pytest.mark.parametrize(
    ("order", "said"),
    [
        ([1, 0, 2], "channels 1 and 2 follow commanded channels 2 and 1 (correlation"),
        ([1, 2, 0], "channels 1, 2 and 3 follow commanded channels 2, 3 and 1 (correlation"),
    ],
)
def test_measured_channels_in_another_order_than_the_commands(order, said, shift_s):
    """Measured column k holds command order[k]; the proposed order undoes that."""
    swapped = driven(lambda command: command[:, order], shift_s)
    (note,) = plausibility_notes(swapped, "mm", "s")
    assert said in note
    proposed = [
        int(k) - 1 for k in note.partition("in the order [")[2].partition("]")[0].split(",")
    ]
    right = replace(swapped, measured=swapped.measured[:, proposed])
    assert np.array_equal(np.array(order)[proposed], [0, 1, 2])
    assert not any("order" in note for note in plausibility_notes(right, "mm", "s"))


def test_each_run_is_compared_on_its_own_clock():
    """Times of every run begin at 0; row i of the second run is no row of the first."""
    swapped = driven(lambda command: command[:, [1, 0, 2]], 0.4)
    runs = np.repeat([0, 1, 2], 2000)
    swapped = replace(swapped, run=runs, t_s=swapped.t_s - 100.0 * runs)
    (note,) = plausibility_notes(swapped, "mm", "s")
    assert "correlation 1.00 and 1.00" in note
    assert "in the order [2, 1, 3]" in note


def first_order_lag(command, time_constant_s):
    """(T, m) commands at 20 Hz behind a lag of first order, computed step by step."""
    lagging = command.copy()
    for k in range(1, len(command)):
        lagging[k] += np.exp(-0.05 / time_constant_s) * (lagging[k - 1] - command[k])
    return lagging


def with_channel(values, column):
    """The values with another one in all rows of the first channel."""
    changed = values.copy()
    changed[:, 0] = column
    return changed


@pytest.mark.parametrize(
    "measured_by",
    [
        lambda command: command,
        lambda command: 3.3 * command + 3.0,
        lambda command: first_order_lag(command, 4.0),
        lambda command: np.minimum(command, 8.0),
        lambda command: with_channel(command, 5.0),
        lambda command: with_channel(command, command[:, 1]),
        lambda command: np.zeros_like(command),
    ],
    ids=["exact", "scaled", "slow line", "clipped", "dead", "read twice", "no pressure"],
)
@pytest.mark.parametrize("seed", range(3))
def test_lagging_clipped_and_dead_channels_are_in_their_order(measured_by, seed):
    assert plausibility_notes(driven(measured_by, seed=seed), "mm", "s") == []


def test_commands_that_are_alike_and_travelling_waves_are_in_their_order():
    """Where channels share one command, or have it one after the other, a lag of a third of the
    period makes each measured channel equal to another command; its own explains it as well."""
    shared = driven(lambda command: command)
    shared = replace(shared, commanded=np.repeat(shared.commanded[:, :1], 3, axis=1))
    shared = replace(shared, measured=first_order_lag(shared.commanded, 0.5))
    assert plausibility_notes(shared, "mm", "s") == []
    for period_s in (1.0, 3.0):
        phase = 2 * np.pi * (np.arange(6000)[:, None] * 0.05 / period_s - np.arange(3) / 3)
        wave = replace(shared, commanded=np.sin(phase), measured=np.sin(phase - 2 * np.pi / 3))
        assert plausibility_notes(wave, "mm", "s") == []


@pytest.mark.parametrize("lead_s", [0.15, 0.2, 1.0])
def test_measured_actuation_ahead_of_its_command(lead_s):
    (note,) = plausibility_notes(driven(lambda command: command, -lead_s), "mm", "s")
    assert f"moves about {lead_s:.2f} s before its command" in note
    assert "the same delay_s in [measured] and [commanded]" in note


def test_a_command_that_is_held_between_the_rows_of_its_log_is_not_late():
    """Logged each 0.4 s and held, it seems up to 0.4 s later than the channel that follows it."""
    followed = driven(lambda command: command)
    held = followed.commanded[np.arange(6000) // 8 * 8]
    assert plausibility_notes(replace(followed, commanded=held), "mm", "s") == []


@pytest.mark.parametrize(
    ("unit", "factor", "said"),
    [
        ("mm", 10.0, "times its command, as if one were in cm and the other in mm"),
        ("mm", 1 / 25.4, "times its command, as if one were in inches and the other in mm"),
        ("kPa", 6.895, "times its command, as if one were in psi and the other in kPa"),
        ("mm", 3.3, None),
        ("kPa", 1.0, None),
    ],
)
def test_measured_actuation_that_is_another_unit_times_its_command(unit, factor, said):
    scaled = driven(lambda command: factor * first_order_lag(command, 0.1), unit=unit)
    notes = plausibility_notes(scaled, "mm", "s")
    assert len(notes) == (said is not None)
    assert all(said in note for note in notes)
    assert [float(note.split()[3]) for note in notes] == pytest.approx([factor] * len(notes), 0.05)
    one = driven(lambda command: with_channel(factor * command, 2.0 * command[:, 0]), unit=unit)
    assert plausibility_notes(one, "mm", "s") == []


def test_steady_state_samples_in_another_order_are_noted_too():
    """Without rows that follow one another in time, no shift is tried."""
    rng = np.random.default_rng(4)
    steps = rng.uniform(0.0, 20.0, (6000, 3))
    settled = driven(lambda _: steps[:, [0, 2, 1]], commanded=steps, kind="settled")
    (note,) = plausibility_notes(settled, "mm")
    assert "measured channels 2 and 3 follow commanded channels 3 and 2" in note
