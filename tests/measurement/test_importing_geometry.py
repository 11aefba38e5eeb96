"""Circle fit, rotations and averages of quaternions against exact geometry."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from surgisoft.config import Where
from surgisoft.errors import InputError
from surgisoft.measurement.importing.points import circle_centres
from surgisoft.measurement.importing.rotation import (
    matrices,
    mean_rotation,
    parse_rotation,
    turn_to_z,
)

MAP = Where(Path("map.toml"))
SEEDS = st.integers(0, 2**32)


def on_circles(rng, rows, markers, radius=7.5, arc=2 * np.pi):
    """Markers (T, k, 3) on circles of random pose, and the circles' centres (T, 3)."""
    angle = (
        rng.uniform(0, 2 * np.pi, (rows, 1))
        + arc * (np.arange(markers) + rng.uniform(-0.3, 0.3, (rows, markers))) / markers
    )
    flat = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=2) * radius
    poses = Rotation.random(rows, random_state=rng.integers(2**31)).as_matrix()
    centres = rng.normal(size=(rows, 3)) * 100
    return np.einsum("tij,tkj->tki", poses, flat) + centres[:, None], centres


@given(seed=SEEDS, markers=st.integers(3, 8), radius=st.floats(0.5, 200))
def test_exact_circle_of_any_pose_gives_its_centre(seed, markers, radius):
    points, centres = on_circles(np.random.default_rng(seed), 20, markers, radius)
    found, radii, residuals = circle_centres(points)
    np.testing.assert_allclose(found, centres, atol=1e-9 * (200 + radius))
    np.testing.assert_allclose(radii, radius, rtol=1e-8)
    assert residuals.max() < 1e-9 * (200 + radius)


@given(seed=SEEDS)
def test_quarter_of_a_circle_is_enough(seed):
    points, centres = on_circles(np.random.default_rng(seed), 10, 5, arc=np.pi / 2)
    np.testing.assert_allclose(circle_centres(points)[0], centres, atol=1e-6)


@given(seed=SEEDS)
def test_three_markers_give_the_circumcentre(seed):
    a, b, c = np.random.default_rng(seed).normal(size=(3, 3)) * 10
    # barycentric weights of the circumcentre, from the squares of the sides
    sides = [((b - c) ** 2).sum(), ((c - a) ** 2).sum(), ((a - b) ** 2).sum()]
    total = sum(sides)
    weights = np.array([side * (total - 2 * side) for side in sides])
    centre = (weights / weights.sum()) @ np.array([a, b, c])
    found = circle_centres(np.array([[a, b, c]]))[0][0]
    if np.isnan(found).any():  # too near to a line to be fitted
        spread = np.linalg.svd(np.array([a, b, c]) - (a + b + c) / 3)[1]
        assert spread[1] < 0.03 * spread[0]
    else:
        scale = np.sqrt(sides[0]) + np.linalg.norm(centre - a)
        np.testing.assert_allclose(found, centre, atol=1e-7 * scale)


@given(seed=SEEDS, markers=st.integers(4, 7))
def test_noisy_circle_is_the_least_squares_one(seed, markers):
    """Against scipy's minimum of the distances in the plane of least squares."""
    rng = np.random.default_rng(seed)
    points = on_circles(rng, 1, markers)[0][0] + rng.normal(0, 0.2, (markers, 3))
    mean = points.mean(axis=0)
    axes = np.linalg.svd(points - mean)[2]
    flat = (points - mean) @ axes[:2].T

    def distance(x):
        return np.linalg.norm(flat - x[:2], axis=1) - x[2]

    best = least_squares(distance, [0, 0, 7.5], xtol=1e-14, ftol=1e-14, gtol=1e-14)
    found, radii, residuals = circle_centres(points[None])
    np.testing.assert_allclose(found[0], mean + best.x[:2] @ axes[:2], atol=1e-4)
    assert radii[0] == pytest.approx(best.x[2], abs=1e-4)
    off_plane = (points - mean) @ axes[2]
    expected = np.sqrt(np.mean(distance(best.x) ** 2 + off_plane**2))
    assert residuals[0] == pytest.approx(expected, abs=1e-4)


def test_lost_markers_are_done_without_and_two_are_not_enough():
    points, centres = on_circles(np.random.default_rng(0), 4, 5)
    points[1, 0] = np.nan
    points[2, :2, 1] = np.nan
    points[3, 1:4] = np.nan
    found, radii, _ = circle_centres(points)
    np.testing.assert_allclose(found[:3], centres[:3], atol=1e-9)
    assert np.isnan(found[3]).all()
    assert np.isnan(radii[3])


def test_markers_on_a_line_or_in_a_point_have_no_circle():
    line = np.array([0.0, 1.0, 3.0])[:, None] * np.array([1.0, 2.0, -1.0])
    found, _, _ = circle_centres(np.stack([line, np.ones((3, 3))]))
    assert np.isnan(found).all()


@given(seed=SEEDS)
def test_quaternions_turn_as_scipy_says_whatever_their_sign(seed):
    rng = np.random.default_rng(seed)
    rotations = Rotation.random(9, random_state=seed % 2**31)
    q = rotations.as_quat() * rng.choice([-1, 1], (9, 1)) * rng.uniform(0.96, 1.04, (9, 1))
    np.testing.assert_allclose(matrices(q, "xyzw"), rotations.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(
        matrices(q[:, [3, 0, 1, 2]], "wxyz"), rotations.as_matrix(), atol=1e-12
    )


@given(seed=SEEDS)
def test_mean_of_flipping_quaternions_is_scipys_mean(seed):
    rng = np.random.default_rng(seed)
    centre = Rotation.random(random_state=seed % 2**31)
    rotations = centre * Rotation.from_rotvec(rng.normal(0, 0.1, (30, 3)))
    q = rotations.as_quat() * rng.choice([-1, 1], (30, 1))
    q[3], q[7] = np.nan, 0.0  # lost rows
    kept = Rotation.from_quat(np.delete(q, [3, 7], axis=0))
    np.testing.assert_allclose(mean_rotation(q, "xyzw"), kept.mean().as_matrix(), atol=1e-9)


def test_lost_orientation_is_missing():
    q = np.array([[0, 0, 0, 0], [np.nan] * 4, [0, 0, 0, 2.0]])
    assert np.isnan(matrices(q, "xyzw")).all()
    assert np.isnan(mean_rotation(q, "xyzw")).all()


@given(
    direction=npst.arrays(np.float64, 3, elements=st.floats(-1, 1)).filter(
        lambda v: np.linalg.norm(v) > 1e-3
    )
)
def test_turn_to_z_is_a_rotation_onto_z(direction):
    turn = turn_to_z(direction)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1)
    np.testing.assert_allclose(turn @ direction, [0, 0, np.linalg.norm(direction)], atol=1e-12)


@pytest.mark.parametrize(
    ("value", "vector", "expected"),
    [
        ("x z -y", [1, 2, 3], [1, 3, -2]),
        ("x -y -z", [1, 2, 3], [1, -2, -3]),
        ("+y z x", [1, 2, 3], [2, 3, 1]),
        ([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [1, 2, 3], [-2, 1, 3]),
        ([0, 0, np.sqrt(0.5), np.sqrt(0.5)], [1, 2, 3], [-2, 1, 3]),
    ],
)
def test_rotation_of_a_map(value, vector, expected):
    np.testing.assert_allclose(parse_rotation(value, MAP / "rotation") @ vector, expected)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("x y", "three signed axes"),
        ("x y q", "three signed axes"),
        ("x x y", "a rotation"),
        ("x y -z", "swaps handedness"),
        ([[1, 0, 0], [0, 1, 0], [0, 0, 2]], "a rotation"),
        ([0, 0, 0, 2], "a quaternion"),
        ([[1, 0], [0, 1]], "a 3x3 matrix"),
        (3, "a 3x3 matrix"),
        ([["a"] * 3] * 3, "a 3x3 matrix"),
    ],
)
def test_what_is_no_rotation(value, expected):
    with pytest.raises(InputError) as error:
        parse_rotation(value, MAP / "frame" / "rotation")
    assert "map.toml: frame.rotation: got" in str(error.value)
    assert expected in str(error.value)


def test_mirror_must_be_asked_for_and_then_be_one():
    np.testing.assert_array_equal(parse_rotation("x y -z", MAP, mirror=True), np.diag([1, 1, -1]))
    with pytest.raises(InputError, match="keeps handedness"):
        parse_rotation("x y z", MAP / "rotation", mirror=True)
