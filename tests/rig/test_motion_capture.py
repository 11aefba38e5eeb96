"""Cameras: exact circles, true noise, correlation, losses."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surgisoft.rig import motion_capture as mc


def rotation(rng):
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q


@given(seed=st.integers(0, 2**31), markers=st.integers(3, 8), radius=st.floats(1.0, 30.0))
def test_exact_circle_gives_its_centre(seed, markers, radius):
    rng = np.random.default_rng(seed)
    centre, axes = rng.normal(0, 50, 3), rotation(rng)
    angles = 2 * np.pi * (np.arange(markers) + rng.uniform(-0.3, 0.3, markers)) / markers
    circle = radius * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    found = np.empty(3)
    mc.circle_centre(centre + circle @ axes.T, found)
    np.testing.assert_allclose(found, centre, atol=1e-7)


def test_lost_markers_are_left_out():
    angles = np.radians([0, 100, 200, 290])
    points = np.stack([3 + 5 * np.cos(angles), 4 + 5 * np.sin(angles), 0 * angles + 2], axis=1)
    found = np.empty(3)
    points[1] = np.nan
    mc.circle_centre(points, found)
    np.testing.assert_allclose(found, [3, 4, 2], atol=1e-9)
    points[2] = np.nan
    mc.circle_centre(points, found)
    assert np.isnan(found).all()


def test_markers_on_a_line_have_no_centre():
    found = np.empty(3)
    mc.circle_centre(np.outer([0.0, 1.0, 2.0], [1.0, 2.0, 3.0]), found)
    assert np.isnan(found).all()


def build(noise=1.0, **changes):
    design = mc.CameraDesign(**changes)
    return mc.build_cameras(design, 15.0, 3, 5, 54.0, noise, seed=3)


def frames_of(cameras, count, seed=0, pressures=(0.0, 0.0, 0.0)):
    """Markers seen (F, n, k, 3) and without noise (n, k, 3) of a straight, still arm."""
    tracking = mc.new_tracking(cameras)
    centres = np.stack([np.zeros(5), np.zeros(5), np.linspace(0, 70, 5)], axis=1)
    mc.mark(cameras, tracking, centres, np.tile(np.eye(3), (5, 1, 1)), np.array(pressures))
    rng = np.random.default_rng(seed)
    seen = []
    for _ in range(count):
        mc.look(cameras, tracking, rng.standard_normal(mc.normals_per_frame(cameras)), 0)
        seen.append(tracking.seen.copy())
    return np.array(seen), tracking.clean


def test_noise_is_as_stated():
    """Variance is white^2 + slow^2; the correlation of neighbours is that of the AR(1) part."""
    cameras = build(white_mm=0.03, slow_mm=0.05, slow_s=0.4, lost_per_s=0.0)
    seen, clean = frames_of(cameras, 8000)
    error = (seen - clean)[200:].reshape(7800, -1)
    assert error.std() == pytest.approx(np.hypot(0.03, 0.05), rel=0.02)
    for delay in (1, 8):
        product = (error[delay:] * error[:-delay]).mean()
        assert product == pytest.approx(0.05**2 * np.exp(-delay * 0.05 / 0.4), rel=0.06)


def test_a_pause_ages_the_slow_noise_as_frames_do():
    """After a pause of 0.4 s the slow part keeps 1/e of itself and its variance."""
    cameras = build(slow_mm=0.05, slow_s=0.4)
    tracking = mc.new_tracking(cameras)
    rng = np.random.default_rng(1)
    before, after = [], []
    for _ in range(3000):
        before.append(tracking.slow.copy())
        mc.wander(cameras, tracking, 0.4, rng.standard_normal(mc.normals_per_pause(cameras)), 0)
        after.append(tracking.slow.copy())
    before, after = np.array(before[50:]), np.array(after[50:])
    assert after.std() == pytest.approx(0.05, rel=0.02)
    assert (before * after).mean() == pytest.approx(0.05**2 / np.e, rel=0.05)


def test_losses_happen_at_the_stated_rate():
    cameras = build(lost_per_s=0.5, lost_s=0.25)
    seen, _ = frames_of(cameras, 6000)
    # A two-state chain with these chances is lost for the share lose / (lose + find) of the time.
    lose, find = 0.5 / 20, 1 / (0.25 * 20)
    assert np.isnan(seen[..., 0]).mean() == pytest.approx(lose / (lose + find), rel=0.1)


def test_markers_sit_between_the_chambers_and_bulging_moves_them_little():
    cameras = build(noise=0.0)
    _, rest = frames_of(cameras, 1)
    angles = np.degrees(np.arctan2(rest[..., 1], rest[..., 0])) % 120
    assert np.abs(angles - 30).max() < 10  # chambers are at 90, 210 and 330 degrees
    _, blown = frames_of(cameras, 1, pressures=(54.0, 0.0, 0.0))
    shift = np.linalg.norm(blown - rest, axis=-1)
    assert shift[0].max() == shift[-1].max() == 0
    assert 0.03 < shift[2].max() < 0.2
    centre, moved = np.empty(3), np.empty(3)
    mc.circle_centre(rest[2], centre)
    mc.circle_centre(blown[2], moved)
    assert 0.01 < np.linalg.norm(moved - centre) < 0.15
