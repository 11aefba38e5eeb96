"""Frames in closed form, against scipy's solution and sums over the points themselves."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from surgisoft.diagnosis.setup.alignment import angle, block_moments, fitted, moments, unturned

SEEDS = st.integers(0, 10_000)


def points(seed: int, rows: int = 40, count: int = 4) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(rows, count, 3)) * [20.0, 30.0, 10.0]


@settings(max_examples=40, deadline=None)
@given(seed=SEEDS, mirrored=st.booleans(), scale=st.sampled_from([0.001, 0.1, 1.0, 25.4]))
def test_a_frame_is_recovered_to_numeric_precision(seed, mirrored, scale):
    rng = np.random.default_rng(seed)
    true = points(seed)
    rotation = Rotation.random(random_state=seed).as_matrix()
    rotation = rotation @ np.diag([1.0, -1.0, 1.0]) if mirrored else rotation
    shift = rng.uniform(-200, 200, 3)
    recorded = scale * true @ rotation.T + shift
    sums = moments(recorded[None], true[None])[0, 0]
    frame = fitted(sums, -1.0 if mirrored else 1.0)
    np.testing.assert_allclose(frame.rotation, rotation, atol=1e-9)
    np.testing.assert_allclose(frame.shift, shift, atol=1e-7)
    assert frame.scale == pytest.approx(scale, rel=1e-9)


def test_the_rotation_of_noisy_points_is_that_of_scipy():
    true = points(1)
    rng = np.random.default_rng(2)
    recorded = Rotation.from_rotvec([0.4, -1.0, 0.2]).apply(true.reshape(-1, 3))
    recorded += rng.normal(0, 3.0, recorded.shape)
    centred = recorded - recorded.mean(0)
    expected, _ = Rotation.align_vectors(centred, true.reshape(-1, 3) - true.mean((0, 1)))
    frame = fitted(
        moments(recorded.reshape(1, *true.shape), true[None])[0, 0], 1.0, np.asarray(1.0)
    )
    np.testing.assert_allclose(frame.rotation, expected.as_matrix(), atol=1e-9)


def test_a_mirrored_frame_is_not_taken_for_a_turned_one():
    true = points(7)
    recorded = true * [1.0, 1.0, -1.0]
    sums = moments(recorded[None], true[None])[0, 0]
    frame = fitted(sums, 1.0, np.asarray(1.0))
    assert np.linalg.det(frame.rotation) == pytest.approx(1.0)
    flat = [part.reshape(-1, 3) - part.mean((0, 1)) for part in (recorded, true)]
    expected, _ = Rotation.align_vectors(*flat)
    np.testing.assert_allclose(frame.rotation, expected.as_matrix(), atol=1e-9)


def test_the_error_is_the_mean_over_the_points_that_are_seen():
    true, recorded = points(3), points(4)
    recorded[5:9, 1] = np.nan
    sums = moments(recorded[None], true[None])
    frame = fitted(sums, 1.0)
    turned = frame.scale[0, 0] * true @ frame.rotation[0, 0].T + frame.shift[0, 0]
    square = np.square(recorded - turned).sum(2) / frame.scale[0, 0] ** 2
    assert sums.mean_square(frame)[0, 0] == pytest.approx(np.nanmean(square))
    plain = np.square(recorded - true).sum(2)
    assert sums.mean_square(unturned(sums))[0, 0] == pytest.approx(np.nanmean(plain))


def test_sums_of_blocks_add_up_and_leave_out_what_is_in_none():
    true, recorded = points(5), points(6)
    block = np.repeat([0, 1, -1, 2], 10)
    parts = block_moments(recorded, true, block, 3)
    inside = block >= 0
    whole = moments(recorded[None, inside], true[None, inside])[0, 0]
    total = parts.summed()
    np.testing.assert_allclose(total.xy, whole.xy)
    np.testing.assert_allclose(total.x, whole.x)
    assert total.count == whole.count == 4 * 30
    assert parts[1].yy == pytest.approx(np.square(true[10:20]).sum())


def test_the_angle_of_a_rotation():
    turn = Rotation.from_rotvec([0.0, 0.7, 0.0]).as_matrix()
    assert angle(turn) == pytest.approx(0.7)
