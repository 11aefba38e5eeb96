"""Frozen channels and marker jumps: found where they were put, and nowhere else."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surgisoft.measurement.recordings import Recording, load_recordings, save_recording
from surgisoft.measurement.recordings.quality import find_warnings, key_point_jumps, spikes

RATE_HZ = 20.0


def body(p):
    """Three key points (T, 3, 3) [mm] that bend with two actuations (T, 2): a smooth static arm."""
    share = np.array([0.3, 0.7, 1.0])
    x = 30 * np.tanh(p[:, :1] / 50) * share**2
    y = 25 * np.sin(p[:, 1:] / 60) * share**2
    z = 70 * share - (x**2 + y**2) / (100 * share)
    return np.stack([x, y, z], axis=2)


def slow_and_noisy(seed, samples=1200, noise=0.05, hz=0.3):
    """Two chambers on smooth paths with rests, measured with noise at 20 Hz."""
    rng = np.random.default_rng(seed)
    t = np.arange(samples) / RATE_HZ
    rates = rng.uniform(0.2, 1.0, 2) * hz
    wave = np.sin(2 * np.pi * rates * t[:, None] + rng.uniform(0, 6, 2))
    command = 40 + 40 * np.clip(1.5 * wave, -1, 1)
    reading = command + rng.normal(0, 0.1, command.shape)
    points = body(command) + rng.normal(0, noise, (samples, 3, 3))
    return Recording("x", t, reading, points, commanded=command)


def steps(seed, samples=1200):
    """Steps of the command that the arm follows within one row: slow sampling, large motion."""
    rng = np.random.default_rng(seed)
    command = np.repeat(rng.uniform(0, 80, (samples // 25, 2)), 25, axis=0)
    t = np.arange(samples) * 1.0
    points = body(command) + rng.normal(0, 0.03, (samples, 3, 3))
    return Recording("x", t, command + rng.normal(0, 0.1, command.shape), points)


def settled(seed, samples=600):
    """Settled points in random order: large motion from row to row."""
    rng = np.random.default_rng(seed)
    p = rng.uniform(0, 80, (samples, 2))
    points = body(p) + rng.normal(0, 0.02, (samples, 3, 3))
    return Recording("x", np.arange(samples) * 4.0, p, points, kind="settled")


def without_noise(seed, samples=1200):
    """A simulation: exact readings that rest bit-equal for long while the other chamber moves."""
    rng = np.random.default_rng(seed)
    levels = np.cumsum(rng.uniform(0, 8, (samples // 60, 2)), axis=0) % 80
    p = np.repeat(levels, 60, axis=0)
    p[:, 1] = 40 + 40 * np.sin(np.arange(samples) / 30)
    return Recording("x", np.arange(samples) / RATE_HZ, p, body(p), commanded=p.copy())


def random_walk(seed, samples=3000):
    """Tendons without noise, one of which rests: ramps, rests and a random walk, no command.

    The steps of the walk are white, so it zigzags as often as noise, and its rests are bit-equal.
    """
    rng = np.random.default_rng(seed)
    p = np.empty((0, 2))
    while len(p) < samples:
        start, rows = p[-1:] if len(p) else np.full((1, 2), 40.0), int(rng.integers(30, 200))
        walk = start + np.cumsum(rng.normal(0, 1.0, (rows, 2)), axis=0)
        ramp = start + np.linspace(0, 1, rows)[:, None] * (rng.uniform(0, 80, 2) - start)
        moved = walk if rng.random() < 0.4 else ramp
        moved = np.where(rng.random(2) < 0.4, start, moved)
        p = np.concatenate([p, moved, np.repeat(moved[-1:], rng.integers(0, 120), axis=0)])
    p = p[:samples]
    points = body(p) + rng.normal(0, 0.05, (samples, 3, 3))
    return Recording("x", np.arange(samples) / RATE_HZ, p, points)


CLEAN = {
    "slow and noisy": slow_and_noisy,
    "fast": lambda seed: slow_and_noisy(seed, hz=3.0),
    "noise only": lambda seed: slow_and_noisy(seed, noise=3.0),
    "steps": steps,
    "random walk": random_walk,
    "settled": settled,
    "without noise": without_noise,
    "without noise or command": lambda seed: dataclasses.replace(
        without_noise(seed), commanded=None
    ),
}


def test_a_small_step_of_the_tip_may_hide_in_the_noise_of_the_others():
    """The command steps at this row, and the tip by 2 % of its motion."""
    assert find_warnings(steps(21734)) == []


@pytest.mark.parametrize("kind", CLEAN)
@given(seed=st.integers(0, 2**32))
def test_no_false_alarm(kind, seed):
    assert find_warnings(CLEAN[kind](seed)) == []


def appended(first, second):
    """Two recordings as two runs of one, on their own clocks."""
    run = np.repeat([3, 7], [first.samples, second.samples])
    both = {
        name: np.concatenate([getattr(first, name), getattr(second, name)])
        for name in ("t_s", "measured", "key_points_mm", "commanded")
    }
    return dataclasses.replace(first, run=run, **both)


def test_a_run_that_was_appended_twice_is_found():
    clean = slow_and_noisy(1, samples=300)
    lost = clean.key_points_mm.copy()
    lost[40:60, 1] = np.nan
    clean = dataclasses.replace(clean, key_points_mm=lost)
    (found,) = find_warnings(appended(clean, clean))
    assert found.sample == 300
    assert found.text.startswith(
        "300 of 600 rows equal earlier ones bit for bit, from here on those from 0.000 s of run 3"
    )
    part = dataclasses.replace(
        clean, **{n: getattr(clean, n)[100:150] for n in ("t_s", "run", "measured", "commanded")},
        key_points_mm=lost[100:150],
    )  # fmt: skip
    (found,) = find_warnings(appended(clean, part))
    assert found.text.startswith("50 of 350 rows equal earlier ones bit for bit, from here on tho")
    assert "from 5.000 s of run 3 on" in found.text
    assert find_warnings(appended(clean, slow_and_noisy(2, samples=300))) == []


def periodic(periods, rows=80, before=100):
    """A simulation to 3 decimals: a motion, then another one of so many periods of `rows` rows."""
    phase = np.arange(periods * rows)[:, None] / rows
    wave = 40 + 30 * np.sin(2 * np.pi * (phase + np.array([0.0, 0.3])))
    start = wave[:1] + 0.003 * np.square(np.arange(-before, 0.0))[:, None]
    p = np.round(np.concatenate([start, wave]), 3)
    t = np.arange(len(p)) / RATE_HZ
    return Recording("x", t, p, np.round(body(p), 3), commanded=p.copy())


@pytest.mark.parametrize("rows", [15, 80])
def test_a_periodic_motion_without_noise_is_no_copy(rows):
    assert find_warnings(periodic(6, rows)) == []
    twice = periodic(2)
    (found,) = find_warnings(twice)
    assert found.sample == 180
    assert found.text.startswith(
        "80 of 260 rows equal earlier ones bit for bit, from here on those from 5.000 s of run 0 on"
    )
    (found,) = find_warnings(appended(periodic(6), periodic(6)))
    assert found.text.startswith("580 of 1160 rows")


def test_an_arm_at_rest_repeats_its_rows():
    """Coarse sensors give the same row again and again, before and after a motion."""
    clean = slow_and_noisy(1, samples=300)
    rest = dataclasses.replace(
        clean, measured=0.0 * clean.measured, commanded=0.0 * clean.commanded,
        key_points_mm=np.broadcast_to(clean.key_points_mm[:1], clean.key_points_mm.shape),
    )  # fmt: skip
    assert "equal earlier" not in " ".join(w.text for w in find_warnings(appended(rest, rest)))


def test_copies_in_two_files_are_found(tmp_path):
    clean, other, told = slow_and_noisy(1), slow_and_noisy(2), []
    for name, made in (("a", clean), ("b", other), ("c", clean)):
        save_recording(dataclasses.replace(made, name=name), tmp_path / f"{name}.csv")
    load_recordings(tmp_path, on_warning=told.append)
    a, c = tmp_path / "a.csv", tmp_path / "c.csv"
    (text,) = told
    assert text.startswith(f"{c}: 100% of its motion equals that of {a} bit for bit: copies count")


@pytest.mark.parametrize("with_command", [True, False])
@given(seed=st.integers(0, 2**32), start=st.integers(100, 900), length=st.integers(60, 250))
def test_frozen_channel_is_found_with_its_place(with_command, seed, start, length):
    clean = slow_and_noisy(seed)
    reading = clean.measured.copy()
    reading[start : start + length, 1] = reading[start, 1]
    found = find_warnings(
        dataclasses.replace(
            clean, measured=reading, commanded=clean.commanded if with_command else None
        )
    )
    assert [warning.sample for warning in found] == [start]
    seconds = clean.t_s[start + length - 1] - clean.t_s[start]
    assert found[0].text == (
        f"p2_kPa repeat bit-equal for {length} rows ({seconds:.3g} s) while other signals move; "
        "frozen?"
    )


def test_a_noisy_reading_that_freezes_often_is_one_finding():
    """Without a command, many repeats could be rests: the noise between them decides."""
    clean = slow_and_noisy(4, samples=4000, hz=0.001)
    reading = clean.measured.copy()
    for start in (500, 1100, 1700, 2900):
        reading[start : start + 100, 0] = reading[start, 0]
    found = find_warnings(dataclasses.replace(clean, measured=reading, commanded=None))
    assert [warning.text for warning in found] == [
        "p1_kPa repeat bit-equal for 100 rows (4.95 s) while other signals move, "
        "and 3 more times; frozen?"
    ]


def test_channels_that_freeze_together_are_one_finding():
    clean = slow_and_noisy(1)
    reading = clean.measured.copy()
    reading[400:600] = reading[400]
    found = find_warnings(dataclasses.replace(clean, measured=reading))
    assert [warning.sample for warning in found] == [400]
    assert found[0].text.startswith("p1_kPa, p2_kPa repeat bit-equal for 200 rows")


def test_reading_that_ignores_its_command_is_frozen():
    clean = without_noise(3)
    reading = clean.measured.copy()
    reading[:, 1] = reading[0, 1]
    assert "p2_kPa" in find_warnings(dataclasses.replace(clean, measured=reading))[0].text


@given(seed=st.integers(0, 2**32), start=st.integers(100, 900), length=st.integers(60, 250))
def test_frozen_key_point_is_found(seed, start, length):
    clean = slow_and_noisy(seed)
    points = clean.key_points_mm.copy()
    points[start : start + length, 2] = points[start, 2]
    found = find_warnings(dataclasses.replace(clean, key_points_mm=points))
    frozen = [warning for warning in found if "frozen" in warning.text]
    assert [warning.sample for warning in frozen] == [start]
    assert frozen[0].text.startswith(f"key point k2 repeats bit-equal for {length} rows")


def test_fixed_base_and_slow_motion_capture_are_not_frozen():
    clean = slow_and_noisy(5)
    points = clean.key_points_mm[np.arange(1200) // 6 * 6]  # a new frame every sixth row
    points[:, 0] = 0.0
    assert find_warnings(dataclasses.replace(clean, key_points_mm=points)) == []


@given(
    seed=st.integers(0, 2**32),
    row=st.integers(50, 1150),
    j=st.integers(0, 2),
    size=st.floats(8, 60),
)
def test_lasting_jump_is_found_at_its_row(seed, row, j, size):
    clean = slow_and_noisy(seed, hz=0.05)
    points = clean.key_points_mm.copy()
    points[row:, j] += size * np.array([0.6, 0.0, 0.8])
    hits = key_point_jumps(dataclasses.replace(clean, key_points_mm=points))
    assert {k: [at for at, _ in found] for k, found in hits.items()} == {j: [row]}
    assert hits[j][0][1] == pytest.approx(size, abs=3)


@given(
    seed=st.integers(0, 2**32),
    row=st.integers(50, 1100),
    length=st.integers(1, 8),
    size=st.floats(10, 60),
)
def test_spike_is_marked_row_by_row(seed, row, length, size):
    clean = slow_and_noisy(seed, hz=0.05)
    points = clean.key_points_mm.copy()
    points[row : row + length, 1] += size * np.array([0.6, -0.8, 0.0])
    away = spikes(dataclasses.replace(clean, key_points_mm=points))
    expected = np.zeros((1200, 3), bool)
    expected[row : row + length, 1] = True
    np.testing.assert_array_equal(away, expected)


@given(seed=st.integers(0, 2**32), row=st.integers(0, 599))
def test_jump_of_a_steady_state_sample_is_found(seed, row):
    clean = settled(seed)
    points = clean.key_points_mm.copy()
    points[row, 2] += [0, 45, 0]
    found = find_warnings(dataclasses.replace(clean, key_points_mm=points))
    assert [warning.sample for warning in found] == [row]
    assert "key point k2 jumps" in found[0].text


def test_lost_key_points_are_no_jump():
    clean = slow_and_noisy(2)
    points = clean.key_points_mm.copy()
    points[300:420, 1] = np.nan
    points[::7, 2] = np.nan
    assert find_warnings(dataclasses.replace(clean, key_points_mm=points)) == []


def test_a_move_across_dropped_frames_is_no_jump():
    """The tip alone goes on at 2 mm a frame, while 8 frames are not in the log at all; a step of as
    many mm within the usual time is a jump still."""
    rng = np.random.default_rng(0)
    frame = np.delete(np.arange(600), slice(301, 309))
    x = 60 * np.abs((frame / 30 - 0.3) % 2 - 1)
    points = np.zeros((len(frame), 3, 3)) + np.array([[0, 0, 20.0], [0, 0, 45.0], [0, 0, 70.0]])
    points += rng.normal(0, 0.05, points.shape)
    points[:, 2, 0] += x
    actuation = np.repeat(frame[:, None] / 10, 2, axis=1)
    gap = Recording("x", frame / RATE_HZ, actuation, points)
    assert abs(x[301] - x[300]) == pytest.approx(18)
    assert key_point_jumps(gap) == {}
    even = dataclasses.replace(gap, t_s=np.arange(len(frame)) / RATE_HZ)
    ((row, size),) = key_point_jumps(even)[2]
    assert (row, round(size)) == (301, 18)


@pytest.mark.parametrize("samples", [1, 2, 3, 5])
def test_few_samples_are_no_trouble(samples):
    t = np.arange(samples) * 1.0
    points = np.random.default_rng(0).normal(size=(samples, 2, 3))
    for kind in ("continuous", "settled"):
        assert find_warnings(Recording("x", t, np.ones((samples, 1)), points, kind=kind)) == []


def test_loader_names_line_and_channel(tmp_path):
    clean = slow_and_noisy(1)
    reading, points = clean.measured.copy(), clean.key_points_mm.copy()
    reading[400:600, 0] = reading[400, 0]
    points[800:, 2] += 30
    path = tmp_path / "a.csv"
    save_recording(dataclasses.replace(clean, measured=reading, key_points_mm=points), path)
    said = []
    load_recordings(path, on_warning=said.append)
    assert len(said) == 2
    assert said[0].startswith(f"{path}, line 402: p1_kPa repeat bit-equal for 200 rows")
    assert said[1].startswith(f"{path}, line 802: key point k2 jumps by 5")
    said.clear()
    save_recording(
        dataclasses.replace(clean, measured=reading, key_points_mm=points),
        tmp_path / "b.parquet",
    )
    load_recordings(tmp_path / "b.parquet", on_warning=said.append)
    assert said[0].startswith(f"{tmp_path}/b.parquet, row 401: p1_kPa")


def test_a_body_that_moves_under_constant_actuation_is_told():
    """A dead log: the tip goes through 30 tanh(80/50) mm to each side, and less along the arm."""
    alive = slow_and_noisy(0, noise=0.0)
    dead = dataclasses.replace(alive, measured=np.full_like(alive.measured, 50.0), commanded=None)
    (found,) = [each for each in find_warnings(dead) if "no channel" in each.text]
    assert found.sample == 0
    tip = np.quantile(alive.key_points_mm[:, 2], (0.01, 0.99), axis=0)
    moved = np.sqrt(np.square(tip[1] - tip[0]).sum())
    assert f"(50, 50 kPa in every row), while key point k2 moves by {moved:.3g} mm" in found.text
    with_command = dataclasses.replace(dead, commanded=alive.commanded)
    creeping = dataclasses.replace(
        dead,
        key_points_mm=dead.key_points_mm[:1] + 0.05 * (dead.key_points_mm - dead.key_points_mm[:1]),
    )
    for other in (alive, with_command, creeping):
        assert not any("no channel" in each.text for each in find_warnings(other))
