"""Jumps of a body against ones that were put into smooth motion, and motion that has none."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surgisoft.measurement.jumps import BodyJumps, Jumps, Motion, find_jumps, own_level_mm

STEP_S = 0.05
ROWS = 2000
NOISE_MM = 0.05
TIME = STEP_S * np.arange(ROWS)
RUN = np.zeros(ROWS, int)
NOISE = np.full(3, np.sqrt(3.0) * NOISE_MM)


def smooth_motion():
    """(actuation (N, 2), key points (N, 3, 3) in mm that follow it in proportion)."""
    actuation = np.stack([np.sin(0.7 * TIME), np.sin(1.1 * TIME + 1.0)], axis=1)
    ways = np.array([[2.0, 0.0, -0.5], [0.0, 3.0, -0.5]])
    shares = np.array([0.2, 0.6, 1.0])
    return actuation, 4.0 * shares[:, None] * (actuation @ ways)[:, None, :]


def noise(seed=0):
    return NOISE_MM * np.random.default_rng(seed).normal(size=(ROWS, 3, 3))


def looked_at(measured, predicted=None, actuation=None, time=TIME, run=RUN):
    own, points = smooth_motion()
    predicted = points if predicted is None else predicted
    actuation = own if actuation is None else actuation
    return find_jumps(Motion(time, run, measured, predicted, actuation, NOISE))


def held(signal, seconds):
    """A first-order lag of a series (N, ...), by the exact step of its differential equation."""
    answer, keep = signal.copy(), np.exp(-STEP_S / seconds)
    for row in range(1, len(signal)):
        answer[row] = keep * answer[row - 1] + (1.0 - keep) * signal[row]
    return answer


def test_jumps_are_found_where_they_are_and_as_large_as_they_are():
    points = smooth_motion()[1] + noise()
    for row, size in ((600, 0.8), (1100, 0.5), (1500, 1.2)):
        points[row:] += size * np.array([0.0, 0.6, 0.8])
    found = looked_at(points)
    assert found.rows.tolist() == [1500, 600, 1100]
    assert found.sizes_mm == pytest.approx([1.2, 0.8, 0.5], rel=0.15)
    assert found.minutes == pytest.approx(ROWS * STEP_S / 60.0, rel=0.01)
    # Seven of the ten largest are missing: the root of (1.2^2 + 0.8^2 + 0.5^2) / 10.
    assert found.level_mm == pytest.approx(np.sqrt(0.233), rel=0.1)


def test_noise_and_smooth_motion_have_none():
    for seed in range(5):
        points = smooth_motion()[1] + noise(seed)
        assert not len(looked_at(points).rows)
        # A model that predicts nothing at all: the motion itself is no jump.
        still = np.zeros((ROWS, 3, 3))
        assert not len(looked_at(points, predicted=still).rows)


def test_a_corner_that_comes_later_is_no_jump():
    """Ramps and rests: a body with a lag of 0.2 s has the corners of its actuation later."""
    levels = np.random.default_rng(3).uniform(-1.0, 1.0, (ROWS // 40, 2))
    ramps = np.concatenate([np.linspace(a, b, 20) for a, b in itertools.pairwise(levels)])
    rests = np.repeat(levels[1:], 20, axis=0).reshape(-1, 20, 2)
    plan = np.concatenate([ramps.reshape(-1, 20, 2), rests], axis=1).reshape(-1, 2)
    plan = np.concatenate([plan, np.repeat(plan[-1:], ROWS - len(plan), axis=0)])
    ways = np.array([[8.0, 0.0, -2.0], [0.0, 12.0, -2.0]])
    predicted = np.array([0.2, 0.6, 1.0])[:, None] * (plan @ ways)[:, None, :]
    measured = held(predicted, 0.2)
    assert np.abs(measured - predicted).max() > 20 * NOISE_MM
    assert not len(looked_at(measured + noise(), predicted, plan).rows)


def test_a_jump_of_the_actuation_is_the_actuations():
    actuation, predicted = smooth_motion()
    step = np.where(TIME >= 50.0, 0.3, 0.0)
    jumping, body = actuation + step[:, None], predicted.copy()
    body[:, :, 0] += 2.0 * step[:, None]
    # The model gets half of the step wrong.
    measured = body.copy()
    measured[:, :, 0] += 1.0 * step[:, None]
    assert not len(looked_at(measured + noise(), body, jumping).rows)
    assert len(looked_at(measured + noise(), predicted, actuation).rows) == 1


def steps(seed=0):
    """(N, 2) actuation that jumps between levels every 3 s, and the rows where it does."""
    levels = np.random.default_rng(seed).uniform(-1.0, 1.0, (ROWS // 60 + 1, 2))
    return np.repeat(levels, 60, axis=0)[:ROWS], np.arange(60, ROWS, 60)


def test_a_body_that_jumps_later_than_its_actuation_follows_it():
    """A pure delay of 0.4 s, longer than a jump of the actuation counts as near."""
    actuation, _ = steps()
    ways = np.array([[3.0, 0.0, -0.5], [0.0, 4.0, -0.5]])
    predicted = np.array([0.2, 0.6, 1.0])[:, None] * (actuation @ ways)[:, None, :]
    late = np.concatenate([np.repeat(predicted[:1], 8, axis=0), predicted[:-8]])
    assert not len(looked_at(late + noise(), predicted, actuation).rows)
    still = np.zeros_like(predicted)
    assert len(looked_at(late + noise(), still, np.zeros_like(actuation)).rows) > 20


@pytest.mark.parametrize("flat", [False, True])
def test_nothing_is_said_where_the_actuation_jumps(flat):
    """A quarter of a second after its actuation the body jumps again, either way, as no linear
    filter does. flat: the model has no motion there, and only the actuation's mean effect says how
    much the body may move."""
    actuation, rows = steps()
    ways = np.array([[3.0, 0.0, -0.5], [0.0, 4.0, -0.5]])
    predicted = np.array([0.2, 0.6, 1.0])[:, None] * (actuation @ ways)[:, None, :]
    measured = predicted.copy()
    rng = np.random.default_rng(5)
    for row in rows:
        size = float(np.linalg.norm(predicted[row, -1] - predicted[row - 1, -1]))
        measured[row + 5 :] += (
            0.3 * size * rng.choice([-1.0, 1.0]) * np.array([0.1, 0.2, 0.2])[:, None]
        )
    if flat:
        predicted[1000:] = predicted[1000]
    assert not len(looked_at(measured + noise(), predicted, actuation).rows)


def test_the_first_moments_have_no_past():
    points = smooth_motion()[1] + noise()
    points[10:] += 1.0
    points[30:] += 1.0
    assert looked_at(points).rows.tolist() == [30]


def test_a_stretch_without_key_points_hides_its_jump_alone():
    points = smooth_motion()[1] + noise()
    points[600:] += 1.0
    points[1200:] += 1.0
    points[590:610] = np.nan
    assert looked_at(points).rows.tolist() == [1200]
    # A key point that is never seen takes no part.
    points[:, 0] = np.nan
    assert looked_at(points).rows.tolist() == [1200]


def test_a_fast_swing_beside_few_frames_is_none():
    """An arm overshoots at 3.3 Hz after ramps of its load, filmed at 30 Hz: a straight line through
    four frames is off by its amplitude. Its jump of 4 mm is one all the same."""
    time = TIME * 0.0333 / STEP_S
    swing = np.zeros(ROWS)
    for begin, step in zip(time[100::250], itertools.cycle([3.0, -3.0])):
        # The mean of the responses to steps within 0.15 s is that to a ramp.
        since = (time[:, None] - begin - np.linspace(0.0, 0.15, 50)).clip(0)
        swing += step * (1.0 - np.exp(-2.0 * since) * np.cos(20.7 * since)).mean(1)
    points = smooth_motion()[1] + noise()
    points += np.array([0.0, 0.5, 1.0])[:, None] * swing[:, None, None]
    assert not len(looked_at(points, time=time).rows)
    points[1000:] += 4.0
    assert looked_at(points, time=time).rows.tolist() == [1000]


def test_a_dropped_frame_is_none():
    """Two frames' motion lie across each frame that is missing."""
    fast = np.array([0.0, 5.0, 10.0])[:, None] * np.sin(2.5 * TIME)[:, None, None]
    points = smooth_motion()[1] + fast + noise()
    kept = np.ones(ROWS, bool)
    kept[[300, 611, 922, 1233]] = False
    points[1500:] += 1.5
    own, predicted = smooth_motion()
    given = (TIME, RUN, points, 0.0 * predicted, own)
    found = find_jumps(Motion(*(each[kept] for each in given), NOISE))
    assert found.rows.tolist() == [1496]


def test_a_slower_run_beside_a_faster_one_keeps_its_jumps():
    """A run at 20 Hz behind a longer one at 100 Hz: none of its rows is missing."""
    run = np.where(np.arange(ROWS) >= 1400, 1, 0)
    time = np.where(run == 0, 0.01 * np.arange(ROWS), STEP_S * (np.arange(ROWS) - 1400))
    own, points = smooth_motion()
    measured = points + noise()
    measured[1700:] += 2.0
    found = find_jumps(Motion(time, run, measured, points, own, NOISE))
    assert found.rows.tolist() == [1700]


def test_a_run_that_begins_elsewhere_is_no_jump():
    points, run = smooth_motion()[1] + noise(), np.where(TIME >= 50.0, 1, 0)
    points[run == 1] += 5.0
    assert not len(looked_at(points, run=run).rows)


def test_samples_at_one_time_have_none():
    points = smooth_motion()[1]
    points[1000:] += 5.0
    assert not len(looked_at(points, time=np.zeros(ROWS)).rows)
    assert not len(looked_at(points, time=np.full(ROWS, np.nan)).rows)
    assert not len(looked_at(np.full_like(points, np.nan)).rows)
    assert not len(looked_at(points[:3], points[:3], points[:3, 0], TIME[:3], RUN[:3]).rows)


def test_stick_and_slip_is_many_jumps():
    """A Coulomb slider on a spring that is pulled: between slips it does not move."""
    predicted = np.zeros((ROWS, 3, 3))
    pulled = 6.0 * np.sin(0.5 * TIME)
    stuck, place = np.zeros(ROWS), 0.0
    for row in range(ROWS):
        if abs(pulled[row] - place) > 1.0:
            place = pulled[row]
        stuck[row] = place
    measured = predicted + np.array([0.0, 0.5, 1.0])[:, None] * stuck[:, None, None]
    actuation = pulled[:, None]
    found = looked_at(measured + noise(), predicted, actuation)
    slips = np.flatnonzero(np.diff(stuck)) + 1
    # Those of the first 0.8 s are left out, and slips nearer to each other than 0.4 s count once.
    assert 0.5 * len(slips) <= len(found.rows) <= len(slips)
    assert set(found.rows.tolist()) <= {int(row) + off for row in slips for off in (-1, 0, 1)}


@given(st.floats(0.01, 100.0), st.floats(0.1, 10.0))
def test_units_do_not_matter(length, unit):
    actuation, points = smooth_motion()
    measured = points + noise()
    measured[900:] += 0.7
    one = find_jumps(Motion(TIME, RUN, measured, points, actuation, NOISE))
    other = find_jumps(
        Motion(TIME, RUN, length * measured, length * points, unit * actuation, length * NOISE)
    )
    assert other.rows.tolist() == one.rows.tolist() == [900]
    assert other.sizes_mm == pytest.approx(length * one.sizes_mm, rel=1e-3)


def test_of_an_arm_that_jumps_by_itself_all_jumps_count():
    """Its actuation jumps by several mm every 3 s; without a jump of its own its level is 0."""
    actuation, rows = steps()
    ways = np.array([[3.0, 0.0, -0.5], [0.0, 4.0, -0.5]])
    points = np.array([0.2, 0.6, 1.0])[:, None] * (actuation @ ways)[:, None, :]
    moved = Motion(TIME, RUN, points + noise(), points, actuation, NOISE)
    assert own_level_mm(moved) == 0.0
    jumping = points + noise()
    jumping[rows[5] + 30 :] += 0.5
    found = own_level_mm(replace(moved, measured_mm=jumping))
    sizes = np.sort(np.sqrt(np.square(np.diff(points, axis=0)).sum((1, 2)) / 3.0))[::-1]
    assert found == pytest.approx(np.sqrt(np.square(sizes[:10]).mean()), rel=0.1)
    assert found > 1.0


def test_jumps_of_before_do_not_count():
    ten = Jumps(np.arange(10), np.full(10, 2.0), 5.0)
    assert BodyJumps(ten, before_mm=0.0, error_mm=4.0).share == pytest.approx(0.5)
    # 2^2 less twice 1.2^2 is 1.12, whose root is 1.058.
    assert BodyJumps(ten, before_mm=1.2, error_mm=4.0).share == pytest.approx(
        1.0583 / 4.0, rel=1e-3
    )
    assert BodyJumps(ten, before_mm=2.0, error_mm=4.0).share == 0.0
    assert BodyJumps(ten, before_mm=0.0, error_mm=0.5).share == pytest.approx(1.0)
