"""Positions of a room come into the arm's base frame, however the frame is given."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from .test_importing import imported, text, written


def arm_in_a_room(seed, rows=60):
    """Three key points of an arm (T, 3, 3) [mm] in its frame, a mount, and the same in the room."""
    rng = np.random.default_rng(seed)
    t = np.arange(rows) / 20
    bend = 20 * np.sin(t)[:, None] * [0, 0.4, 1.0]
    points = np.stack([bend, 0.3 * bend, np.broadcast_to([0, 40, 80.0], bend.shape)], axis=2)
    mount = Rotation.random(random_state=seed % 2**31)
    return t, points, mount, mount.apply(points.reshape(-1, 3)).reshape(points.shape) + 500, rng


POSE = ["bx", "by", "bz", "qx", "qy", "qz", "qw"]
POSED = """
[time]
column = "t"
[measured]
columns = ["u1"]
unit = "kPa"
[key_points]
positions = [["x0", "y0", "z0"], ["x1", "y1", "z1"], ["x2", "y2", "z2"]]
unit = "mm"
[frame]
gravity = [0, -1, 0]
"""
BODY = """
[frame.base]
position = ["bx", "by", "bz"]
quaternion = ["qx", "qy", "qz", "qw"]
"""


def posed(path, t, room, pose):
    names = ["t", "u1", *(f"{a}{j}" for j in range(3) for a in "xyz"), *POSE]
    columns = [t[:, None], np.ones((len(t), 1)), room.reshape(len(t), 9), pose]
    return written(path, text(np.concatenate(columns, axis=1), header=names))


@pytest.mark.parametrize("mode", ["fixed", "rest", "moving"])
@given(seed=st.integers(0, 2**32))
def test_pose_of_a_base_body_whose_quaternion_flips(tmp_path_factory, mode, seed):
    tmp_path = tmp_path_factory.mktemp("pose")
    t, points, mount, room, rng = arm_in_a_room(seed)
    q = mount.as_quat() * rng.choice([-1, 1], (len(t), 1))
    pose = np.concatenate([np.full((len(t), 3), 500.0), q], axis=1)
    path = posed(tmp_path / "a.csv", t, room, pose)
    recording, _ = imported(tmp_path, path, f'{POSED}{BODY}mode = "{mode}"\n')
    np.testing.assert_allclose(recording.key_points_mm, points, atol=1e-9)
    np.testing.assert_allclose(recording.gravity, mount.inv().apply([0, -1, 0]), atol=1e-12)


def test_moving_base_is_taken_out_row_by_row(tmp_path):
    t, points, _, _, rng = arm_in_a_room(4)
    mounts = Rotation.from_rotvec(np.cumsum(rng.normal(0, 0.05, (len(t), 3)), axis=0))
    shifts = np.cumsum(rng.normal(0, 3, (len(t), 3)), axis=0)
    room = np.einsum("tij,tnj->tni", mounts.as_matrix(), points) + shifts[:, None]
    pose = np.concatenate([shifts, mounts.as_quat()], axis=1)
    pose[7, 3:] = 0.0  # the cameras lost the base
    path = posed(tmp_path / "a.csv", t, room, pose)
    recording, _ = imported(tmp_path, path, f'{POSED}{BODY}mode = "moving"\n')
    expected = points.copy()
    expected[7] = np.nan
    np.testing.assert_allclose(recording.key_points_mm, expected, atol=1e-9)


@given(seed=st.integers(0, 2**32))
def test_constant_rotation_and_origin(tmp_path_factory, seed):
    tmp_path = tmp_path_factory.mktemp("matrix")
    t, points, mount, room, _ = arm_in_a_room(seed)
    path = posed(tmp_path / "a.csv", t, room, np.zeros((len(t), 7)))
    rows = mount.inv().as_matrix().tolist()
    frame = f"rotation = {rows}\norigin = [500, 500, 500]\n"
    recording, notes = imported(tmp_path, path, POSED + frame)
    np.testing.assert_allclose(recording.key_points_mm, points, atol=1e-9)
    np.testing.assert_allclose(recording.gravity, mount.inv().apply([0, -1, 0]), atol=1e-12)
    assert notes == []
    quaternion = mount.inv().as_quat().tolist()
    frame = f"rotation = {quaternion}\norigin = [500, 500, 500]\n"
    np.testing.assert_allclose(
        imported(tmp_path, path, POSED + frame)[0].key_points_mm, points, atol=1e-9
    )


@pytest.mark.parametrize("mode", ["fixed", "rest", "moving"])
def test_base_origin_and_rotation_follow_one_another(tmp_path, mode):
    """A body beside the arm's base, turned against it, in a file in cm.

    What the body sees of an arm at p is turn^-1 p + origin, and the room turns that again.
    """
    t, points, mount, _, _ = arm_in_a_room(3)
    turn, origin_mm = Rotation.from_euler("xyz", [20, -70, 130], degrees=True), [3.0, -40.0, 12.0]
    seen = turn.inv().apply(points.reshape(-1, 3)) + origin_mm
    room = mount.apply(seen).reshape(points.shape) + 500.0
    pose = np.tile([50.0, 50.0, 50.0, *mount.as_quat()], (len(t), 1))
    path = posed(tmp_path / "a.csv", t, room / 10.0, pose)
    frame = f"rotation = {turn.as_matrix().tolist()}\norigin = [0.3, -4.0, 1.2]\n"
    content = POSED.replace('unit = "mm"', 'unit = "cm"') + frame + f'{BODY}mode = "{mode}"\n'
    recording, _ = imported(tmp_path, path, content)
    np.testing.assert_allclose(recording.key_points_mm, points, atol=1e-9)
    expected = turn.apply(mount.inv().apply([0, -1, 0]))
    np.testing.assert_allclose(recording.gravity, expected, atol=1e-12)


def test_the_pose_of_a_base_at_rest_is_that_of_the_first_rows(tmp_path):
    """The holder yields after five rows: its mean over all rows is another frame."""
    t, points, mount, room, _ = arm_in_a_room(8)
    later = Rotation.from_rotvec([0.0, 0.3, 0.0]) * mount
    pose = np.tile([500.0, 500.0, 500.0, *mount.as_quat()], (len(t), 1))
    pose[5:] = [530.0, 500.0, 470.0, *later.as_quat()]
    path = posed(tmp_path / "a.csv", t, room, pose)
    content = f'{POSED}rest_rows = 5\n{BODY}mode = "rest"\n'
    recording, _ = imported(tmp_path, path, content)
    np.testing.assert_allclose(recording.key_points_mm, points, atol=1e-9)


def test_key_points_are_lost_by_their_number_in_the_map(tmp_path):
    """The map's point 0, a dead marker, is the tip: the last one of the arm."""
    t, _, _, room, _ = arm_in_a_room(2)
    path = posed(tmp_path / "a.csv", t, room, np.zeros((len(t), 7)))
    content = POSED.replace("[frame]", "order = [1, 2, 0]\nlost = [0]\n[frame]")
    found = imported(tmp_path, path, content)[0].key_points_mm
    np.testing.assert_allclose(found[:, :2], room[:, 1:], atol=1e-9)
    assert np.isnan(found[:, 2]).all()


@given(seed=st.integers(0, 2**32))
def test_frame_from_the_arm_at_rest(tmp_path_factory, seed):
    """With origin k0 and z along the arm at rest, any mount gives the same up to heading."""
    tmp_path = tmp_path_factory.mktemp("rest")
    t, points, _, room, _ = arm_in_a_room(seed)
    path = posed(tmp_path / "a.csv", t, room, np.zeros((len(t), 7)))
    frame = 'origin = "k0"\nalign_z = "rest"\nrest_rows = 1\n'
    found = imported(tmp_path, path, POSED + frame)[0].key_points_mm
    np.testing.assert_allclose(found[0], points[0], atol=1e-9)
    np.testing.assert_allclose(found[..., 2], points[..., 2], atol=1e-9)
    distances = np.linalg.norm(found[:, None, 2] - found[None, :, 2], axis=2)
    expected = np.linalg.norm(points[:, None, 2] - points[None, :, 2], axis=2)
    np.testing.assert_allclose(distances, expected, atol=1e-9)
    assert np.linalg.det([*found[[20, 40], 2].tolist(), [0, 0, 1]]) == pytest.approx(
        np.linalg.det([*points[[20, 40], 2].tolist(), [0, 0, 1]]), abs=1e-6
    )


def test_arm_that_does_not_point_along_z_is_noted(tmp_path):
    t, points, _, _, _ = arm_in_a_room(0)
    path = posed(tmp_path / "a.csv", t, points[..., [2, 0, 1]], np.zeros((len(t), 7)))
    _, notes = imported(tmp_path, path, POSED)
    chord = points[:20, 2].mean(axis=0) - points[:20, 0].mean(axis=0)
    angle = np.degrees(np.arccos(chord[1] / np.linalg.norm(chord)))
    assert f"in the first 20 rows the arm points {angle:.0f} degrees away from z" in notes[0]
    assert angle > 80


def test_point_beside_a_body_turns_with_it(tmp_path):
    """A key point 22 mm along the body's own z axis: position + R(q) offset."""
    t = np.arange(12) / 10
    turns = Rotation.from_rotvec(t[:, None] * [0, 1, 0])
    position = np.stack([t, 2 * t, 3 * t], axis=1)
    q = turns.as_quat()[:, [3, 0, 1, 2]]
    values = np.concatenate([t[:, None], np.ones((12, 1)), position, q], axis=1)
    names = ["t", "u", "x", "y", "z", "qw", "qx", "qy", "qz"]
    path = written(tmp_path / "a.csv", text(values, header=names))
    content = """
        [time]
        column = "t"
        [measured]
        columns = ["u"]
        unit = "kPa"
        [key_points]
        unit = "cm"
        quaternion_order = "wxyz"
        [[key_points.point]]
        position = ["x", "y", "z"]
        [[key_points.point]]
        position = ["x", "y", "z"]
        quaternion = ["qw", "qx", "qy", "qz"]
        offset = [0, 0, 2.2]
    """
    found = imported(tmp_path, path, content)[0].key_points_mm
    np.testing.assert_allclose(found[:, 0], 10 * position)
    along = np.stack([np.sin(t), 0 * t, np.cos(t)], axis=1)
    np.testing.assert_allclose(found[:, 1] - found[:, 0], 22 * along, atol=1e-12)


def swinging(t):
    """A base that swings about a skew axis and drifts, at any time t (T,): its rotations."""
    axis = np.array([0.6, -0.48, 0.64])
    return Rotation.from_rotvec(np.sin(2 * t)[:, None] * axis) * Rotation.from_euler("y", 1.0)


@pytest.mark.parametrize("order", ["xyzw", "wxyz"])
def test_orientations_turn_between_the_rows_of_a_slower_file(tmp_path, order):
    """The slow file's poses against the true ones, and against scipy's Slerp between its rows."""
    slow, fast = np.arange(0, 3.001, 0.1), np.arange(0, 2.999, 0.0125)
    rng = np.random.default_rng(3)
    arm = np.array([0.0, 0.0, 80.0])
    q = swinging(slow).as_quat() * rng.choice([-1, 1], (len(slow), 1))
    place = np.stack([10 * slow, 0 * slow, -5 * slow], axis=1)
    if order == "wxyz":
        q = q[:, [3, 0, 1, 2]]
    names = ["t", "x", "y", "z", "qa", "qb", "qc", "qd"]
    files = [
        written(tmp_path / "log.csv", text(np.stack([fast, fast], axis=1), header=["t", "u1"])),
        written(tmp_path / "mocap.csv", text(np.column_stack([slow, place, q]), header=names)),
    ]
    content = f"""
        [file.log]
        match = "log*"
        [file.mocap]
        join = "time"
        time = "t"
        [time]
        column = "t"
        [measured]
        columns = ["u1"]
        unit = "kPa"
        [key_points]
        file = "mocap"
        unit = "mm"
        quaternion_order = "{order}"
        [[key_points.point]]
        position = ["x", "y", "z"]
        quaternion = ["qa", "qb", "qc", "qd"]
        offset = [0, 0, 80]
    """
    recording, _ = imported(tmp_path, files, content)
    where = np.stack([10 * fast, 0 * fast, -5 * fast], axis=1)
    tip = Slerp(slow, swinging(slow))(fast).apply(arm) + where
    np.testing.assert_allclose(recording.key_points_mm[:, 0], tip, atol=1e-9)
    # Angular acceleration is at most 4 rad/s2: a constant rate misses 4 / 8 * 0.1^2 rad of 80 mm.
    true = swinging(fast).apply(arm) + where
    assert np.abs(recording.key_points_mm[:, 0] - true).max() < 0.5 * 0.1**2 * 80


def test_a_pose_between_rows_of_a_lost_body_is_missing(tmp_path):
    t, _, _, room, _ = arm_in_a_room(1)
    pose = np.tile([0, 0, 0, 0, 0, 0, 1.0], (len(t), 1))
    pose[10, 3:] = 0.0  # what trackers write for a lost body
    later = t[:-1] + 0.02
    files = [
        written(tmp_path / "log.csv", text(np.stack([later, later], axis=1), header=["t", "u1"])),
        posed(tmp_path / "mocap.csv", t, room, pose),
    ]
    content = (
        '[file.log]\nmatch = "log*"\n[file.mocap]\njoin = "time"\ntime = "t"\n'
        + POSED.replace("[key_points]", '[key_points]\nfile = "mocap"')
        + BODY
    )
    recording, _ = imported(tmp_path, files, content + 'mode = "moving"')
    missing = np.isnan(recording.key_points_mm).any(axis=(1, 2))
    np.testing.assert_array_equal(np.flatnonzero(missing), [9, 10])
    np.testing.assert_allclose(
        recording.key_points_mm[~missing], (0.6 * room[:-1] + 0.4 * room[1:])[~missing], atol=1e-9
    )
    held = content.replace('time = "t"', 'time = "t"\ninterpolate = "previous"')
    points = imported(tmp_path, files, held)[0].key_points_mm
    np.testing.assert_allclose(points, room[:-1])
