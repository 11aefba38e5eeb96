import math
import re

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from surgisoft.errors import InputError
from surgisoft.scene import frames
from surgisoft.scene.mesh import Body, Mesh

finite = st.floats(-10, 10, allow_nan=False)
vector = st.tuples(finite, finite, finite).filter(lambda v: np.linalg.norm(v) > 1e-3)
angle = st.floats(-math.pi, math.pi)


def random_rotations(count, seed=0):
    return Rotation.random(count, random_state=np.random.default_rng(seed))


@given(vector, angle)
def test_axis_angle_agrees_with_scipy(axis, turn):
    unit = np.asarray(axis) / np.linalg.norm(axis)
    np.testing.assert_allclose(
        frames.rotation_from_axis_angle(axis, turn),
        Rotation.from_rotvec(unit * turn).as_matrix(),
        atol=1e-13,
    )


@given(vector, angle, vector)
def test_pose_from_z_is_a_rotation_with_the_asked_axis_and_roll(z, roll, position):
    pose = frames.pose_from_z(position, z, roll)
    turn, unit = pose[:3, :3], np.asarray(z) / np.linalg.norm(z)
    np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)
    np.testing.assert_allclose(turn[:, 2], unit, atol=1e-12)
    np.testing.assert_allclose(pose[:3, 3], position)
    unrolled = frames.rotation_from_z(z)
    np.testing.assert_allclose(
        turn, Rotation.from_rotvec(unit * roll).as_matrix() @ unrolled, atol=1e-12
    )


def test_roll_zero_keeps_world_x_for_upright_and_hanging_arms():
    np.testing.assert_allclose(frames.rotation_from_z([0, 0, 1.0]), np.eye(3))
    np.testing.assert_allclose(frames.rotation_from_z([0, 0, -1.0]), np.diag([1, -1, -1]))
    np.testing.assert_allclose(frames.rotation_from_z([1.0, 0, 0])[:, 0], [0, 1, 0])


@given(vector, vector, vector)
def test_invert_undoes_a_pose(z, position, point):
    pose = frames.pose_from_z(position, z, 0.3)
    there = frames.apply(pose, np.asarray([point]))
    np.testing.assert_allclose(frames.apply(frames.invert(pose), there), [point], atol=1e-10)
    np.testing.assert_allclose(frames.compose(pose, frames.invert(pose)), np.eye(4), atol=1e-10)


@given(vector, vector)
@settings(max_examples=50)
def test_look_at_puts_the_target_on_the_axis_and_up_upwards(eye, target):
    if np.linalg.norm(np.cross(np.subtract(target, eye), [0, 0, 1])) < 1e-2:
        return
    pose = frames.look_at(eye, target)
    seen = frames.apply(frames.invert(pose), np.asarray([target]))[0]
    np.testing.assert_allclose(seen[:2], 0.0, atol=1e-9)
    assert seen[2] > 0
    up_in_image = pose[:3, :3].T @ np.array([0, 0, 1.0])
    assert up_in_image[1] < 0
    assert abs(up_in_image[0]) < 1e-9


def test_look_at_straight_down_is_still_a_rotation():
    turn = frames.look_at([0, 0, 10.0], [0, 0, 0.0])[:3, :3]
    np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(turn[:, 2], [0, 0, -1])


def test_torch_and_numpy_agree_and_keep_their_kind():
    truth = random_rotations(20, seed=3).as_matrix()
    points = np.random.default_rng(1).normal(size=(20, 5, 3))
    position = points[:, 0]
    pose = frames.pose_from(truth, position)
    tensor = frames.pose_from(torch.as_tensor(truth), torch.as_tensor(position))
    assert tensor.dtype == torch.float64
    np.testing.assert_array_equal(tensor.numpy(), pose)
    for function in (frames.apply, frames.rotate):
        there = function(tensor, torch.as_tensor(points)).numpy()
        np.testing.assert_allclose(there, function(pose, points), atol=1e-14)
    axes, turns = torch.as_tensor(position), torch.as_tensor(points[:, 1, 0])
    turned = frames.rotation_from_axis_angle(axes.float(), turns.float())
    assert turned.dtype == torch.float32
    np.testing.assert_allclose(
        turned.numpy(), frames.rotation_from_axis_angle(position, points[:, 1, 0]), atol=1e-6
    )


def tetrahedron():
    """Corner of the unit cube: volume 1/6, areas 1/2 (three times) and sqrt(3)/2."""
    vertices = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
    return Mesh(vertices, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def test_mesh_measures_match_hand_computed_numbers():
    mesh = tetrahedron()
    assert mesh.is_watertight
    assert mesh.volume_mm3 == pytest.approx(1 / 6)
    np.testing.assert_allclose(mesh.face_areas_mm2, [0.5, 0.5, 0.5, math.sqrt(3) / 2])
    np.testing.assert_allclose(mesh.face_normals[3], np.ones(3) / math.sqrt(3))
    np.testing.assert_allclose(mesh.vertex_normals[0], -np.ones(3) / math.sqrt(3))
    np.testing.assert_allclose(mesh.bounds_mm, [[0, 0, 0], [1, 1, 1]])


def test_watertight_knows_holes_and_flipped_faces():
    mesh = tetrahedron()
    assert not Mesh(mesh.vertices_mm, mesh.faces[:3]).is_watertight
    flipped = mesh.faces.copy()
    flipped[0] = flipped[0, ::-1]
    assert not Mesh(mesh.vertices_mm, flipped).is_watertight


def test_content_hash_follows_the_content():
    mesh = tetrahedron()
    assert mesh.content_hash == tetrahedron().content_hash
    moved = mesh.vertices_mm.copy()
    moved[0, 0] = np.nextafter(0.0, 1.0)
    assert Mesh(moved, mesh.faces).content_hash != mesh.content_hash
    assert Mesh(mesh.vertices_mm, mesh.faces[[1, 0, 2, 3]]).content_hash != mesh.content_hash


@pytest.mark.parametrize(
    ("vertices", "faces", "says"),
    [
        ([[0, 0, 0]], [[0, 0, 1]], "0..0"),
        ([[0, 0, np.nan]], [[0, 0, 0]], "vertex 0 is not finite"),
        ([[0, 0]], [[0, 0, 0]], "(1, 2)"),
        ([[0, 0, 0]], np.zeros((0, 3), int), "(0, 3)"),
    ],
)
def test_bad_meshes_are_named(vertices, faces, says):
    with pytest.raises(InputError, match=re.escape(says)):
        Mesh(vertices, faces)


def test_bodies_refuse_unknown_roles_and_scaled_poses():
    with pytest.raises(InputError, match="organ"):
        Body("x", "liver", tetrahedron())
    for pose in (np.diag([2.0, 2, 2, 1]), np.diag([-1.0, 1, 1, 1])):
        with pytest.raises(InputError, match="rotation"):
            Body("x", "organ", tetrahedron(), pose)
    body = Body("x", "organ", tetrahedron(), frames.pose_from_z([1, 2, 3.0], [0, 0, -1.0]))
    np.testing.assert_allclose(body.world_mesh.bounds_mm, [[1, 1, 2], [2, 2, 3]])
