"""A body that leads its actuation is noticed, and nothing else is taken for it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.signal import lfilter

from surgisoft.measurement.importing.timing import body_lead, held_period_s, released, timing_notes
from surgisoft.measurement.recordings import Recording

RATE_HZ = 50


def wander(rng, seconds, channels=3, rate_hz=RATE_HZ, corner_s=0.25):
    """(T, m) smooth random actuation, 0 to 60, whose power ends at about 1 / (2 pi corner_s) Hz."""
    white = rng.normal(size=(seconds * rate_hz, channels))
    smooth = gaussian_filter1d(white, corner_s * rate_hz, axis=0)
    return 30 + 12 * smooth / smooth.std(axis=0)


def bent(p):
    """(T, 2, 3) key points that the actuation (T, 3) bends, saturating, in closed form [mm]."""
    x, y = np.tanh((p[:, 0] - p[:, 1]) / 50), np.tanh((p[:, 2] - 0.5 * p[:, 1] - 15) / 50)
    tip = np.stack([30 * x, 30 * y, 70 - 12 * (x**2 + y**2)], axis=1)
    return np.stack([0.3 * tip, tip], axis=1)


def lagged(p, tau_s, orders=1):
    """The actuation behind first-order lags in a row."""
    a = np.exp(-1 / (RATE_HZ * tau_s)) if tau_s else 0.0
    for _ in range(orders):
        p = lfilter([1 - a], [1, -a], p - p[0], axis=0) + p[0]
    return p


def played(p, width):
    """The actuation behind a play of this half width: hysteresis."""
    out = np.empty_like(p)
    out[0] = p[0]
    for k in range(1, len(p)):
        out[k] = np.clip(out[k - 1], p[k] - width, p[k] + width)
    return out


def recorded(p, points, rng, noise_mm=0.05, noise=0.1, late_rows=0):
    """A recording whose actuation was logged late by so many rows (negative: early)."""
    shift = np.roll(p, late_rows, axis=0) + noise * rng.normal(size=p.shape)
    keep = slice(max(late_rows, 0), len(p) + min(late_rows, 0))
    t_s = np.arange(len(p)) / RATE_HZ
    points = points + noise_mm * rng.normal(size=points.shape)
    return Recording("r", t_s[keep], shift[keep], points[keep])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("rows", [2, 3, 8])
def test_a_late_log_is_measured(seed, rows):
    rng = np.random.default_rng([seed, rows])
    p = wander(rng, 60)
    lead = body_lead(recorded(p, bent(p), rng, late_rows=rows))
    assert lead.seconds == pytest.approx(rows / RATE_HZ, abs=0.15 / RATE_HZ)
    low, high = lead.ci95_s
    assert low - 0.003 < rows / RATE_HZ < high + 0.003


@pytest.mark.parametrize("seed", range(3))
def test_the_lag_of_the_arm_comes_off_the_lead(seed):
    rng = np.random.default_rng(seed)
    p = wander(rng, 60)
    lead = body_lead(recorded(p, bent(lagged(p, 0.04)), rng, late_rows=6))
    assert lead.seconds == pytest.approx(6 / RATE_HZ - 0.04, abs=0.012)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("late_s", [0.6, 1.36, 2.6])
def test_a_log_later_than_the_first_search_is_measured(late_s, seed):
    """Motion so slow that a shift by 0.5 s explains a part of it."""
    rng = np.random.default_rng(seed)
    p = wander(rng, 200, corner_s=1.2 * late_s)
    lead = body_lead(recorded(p, bent(p), rng, late_rows=round(late_s * RATE_HZ)))
    assert lead.seconds == pytest.approx(late_s, rel=0.06)
    assert not lead.at_least


def test_a_lead_at_the_end_of_the_search_is_a_least_one():
    """A log that is 3.6 s late, of a motion so slow that 3 s of them explain most of it."""
    rng = np.random.default_rng(0)
    p = wander(rng, 300, corner_s=3.0)
    late = recorded(p, bent(p), rng, late_rows=round(3.6 * RATE_HZ))
    lead = body_lead(late)
    assert lead.at_least
    assert lead.seconds == pytest.approx(3.0, abs=0.02)
    (note,) = timing_notes(late, {"measured": 0.5})
    assert "moves at least 3.000 s, the largest lead that is tried, before" in note
    assert note.endswith(
        "set delay_s = 3.500 in [measured] of the map, and import again to see what is left"
    )
    assert timing_notes(late, {"measured": 0.5}, lead=False) == []


FOLLOWERS = {
    "at once": lambda p: p,
    "lag 0.02 s": lambda p: lagged(p, 0.02),
    "lag 0.3 s": lambda p: lagged(p, 0.3),
    "lag 2 s": lambda p: lagged(p, 2.0),
    "four lags of 0.2 s": lambda p: lagged(p, 0.2, 4),
    "dead time 0.4 s": lambda p: np.concatenate([p[:1].repeat(20, 0), p[:-20]]),
    "play": lambda p: played(p, 6.0),
    "creep": lambda p: p + 0.3 * lagged(p, 5.0),
    "relaxation": lambda p: p - 0.3 * lagged(p, 5.0),
}


@pytest.mark.parametrize("noise", [0.0, 0.1, 2.0])
@pytest.mark.parametrize("corner_s", [0.1, 0.5])
@pytest.mark.parametrize("name", FOLLOWERS)
def test_an_arm_that_follows_is_left_alone(name, corner_s, noise):
    rng = np.random.default_rng([0, len(name)])
    p = wander(rng, 60, corner_s=corner_s)
    points = bent(FOLLOWERS[name](p))
    assert body_lead(recorded(p, points, rng, 0.02 + noise / 2, noise)) is None


def test_a_periodic_motion_shows_no_lead():
    """A lag by most of a period looks like a lead, so neither is claimed."""
    t_s = np.arange(3000) / RATE_HZ
    p = 30 + 20 * np.stack([np.sin(2 * np.pi * 0.7 * t_s + k) for k in range(3)], axis=1)
    rng = np.random.default_rng(0)
    for rows in (-20, -60, 3):
        assert body_lead(recorded(p, bent(p), rng, late_rows=rows)) is None


def test_steady_state_short_or_still_recordings_have_no_timing():
    rng = np.random.default_rng(0)
    p = wander(rng, 60)
    late = recorded(p, bent(p), rng, late_rows=5)
    still = np.zeros_like(late.key_points_mm)
    for kwargs in ({"kind": "settled"}, {"key_points_mm": still}):
        fields = {"key_points_mm": late.key_points_mm} | kwargs
        assert body_lead(Recording("r", late.t_s, late.measured, **fields)) is None
    assert (
        body_lead(Recording("r", late.t_s[:40], late.measured[:40], late.key_points_mm[:40]))
        is None
    )


def held(p, every):
    return p[np.arange(len(p)) // every * every]


def test_a_slow_sensor_is_noticed_and_put_right():
    rng = np.random.default_rng(0)
    p = wander(rng, 60)
    points = bent(p) + 0.02 * rng.normal(size=(len(p), 2, 3))
    t_s = np.arange(len(p)) / RATE_HZ
    slow = Recording("r", t_s, np.round(held(p, 5), 1), points, commanded=p)
    assert held_period_s(slow) == pytest.approx(0.1)
    better = released(slow, 0.1)
    assert np.abs(slow.measured - p).std() > 3 * np.abs(better.measured - p).std()
    assert held_period_s(better) is None
    assert body_lead(better) is None


def test_rests_steps_and_staircases_are_no_slow_sensor():
    rng = np.random.default_rng(0)
    p = wander(rng, 60)
    points = bent(p) + 0.02 * rng.normal(size=(len(p), 2, 3))
    t_s = np.arange(len(p)) / RATE_HZ
    rests = p[np.maximum.accumulate(np.where(rng.random(len(p)) < 0.02, np.arange(len(p)), 0))]
    for measured, commanded in (
        (p, None),
        (np.round(p), None),  # quantised: repeats come irregularly
        (rests, None),
        (held(p, 5), held(p, 5)),  # the command is the staircase
    ):
        assert held_period_s(Recording("r", t_s, measured, points, commanded)) is None


def test_samples_seconds_apart_have_no_lead():
    """The largest lead that is looked for is shorter than one step of steady-state samples."""
    rng = np.random.default_rng(2)
    p = rng.uniform(0.0, 40.0, (400, 3))
    recording = recorded(p, bent(p), rng)
    slow = replace(recording, t_s=5.0 * np.arange(400))
    assert body_lead(slow) is None
