"""The body's frame against arcs in closed form."""

import numpy as np
import pytest

from surgisoft.diagnosis.body_frame import bending, frames, tangents

REST = np.stack([np.zeros(5), np.zeros(5), np.linspace(0, 60, 5)], axis=1)


def arc(angle: float, azimuth: float) -> tuple[np.ndarray, np.ndarray]:
    """Key points (5, 3) and tangents (5, 3) of an arc of 60 mm that bends by an angle."""
    way = np.linspace(0, 60, 5)
    turn = angle * way / 60
    side, up = 60 / angle * (1 - np.cos(turn)), 60 / angle * np.sin(turn)
    to = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    z = np.array([0.0, 0.0, 1.0])
    points = side[:, None] * to + up[:, None] * z
    return points, np.sin(turn)[:, None] * to + np.cos(turn)[:, None] * z


@pytest.mark.parametrize("azimuth", [0.0, 1.0, -2.5])
def test_frame_of_an_arc(azimuth):
    points, along = arc(1.2, azimuth)
    frame = frames(points[None], REST)[0]
    assert np.abs(frame[:, 0] - along).max() < 0.02
    out = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    assert np.abs(frame[:, 2] - out).max() < 1e-9
    # In plane points to the side that the body bends to.
    assert (frame[:, 1] @ [np.cos(azimuth), np.sin(azimuth), 0.0] > 0.3).all()
    assert np.abs(frame @ frame.transpose(0, 2, 1) - np.eye(3)).max() < 1e-9
    assert np.linalg.det(frame) == pytest.approx(np.ones(5))


def test_one_key_point_is_the_end_of_an_arc():
    points, along = arc(0.9, 0.4)
    assert tangents(points[None, -1:], REST[-1:])[0, 0] == pytest.approx(along[-1], abs=1e-9)


def test_a_straight_body_has_a_frame_too():
    frame = frames(REST[None], REST)[0]
    assert np.isfinite(frame).all()
    assert frame[:, 1] == pytest.approx(np.tile([1.0, 0.0, 0.0], (5, 1)))


def test_the_plane_of_an_arm_that_is_bent_at_rest_is_that_of_its_motion():
    """At rest it bends towards x; moved towards y from there, it bends towards y."""
    rest, _ = arc(0.5, 0.0)
    moved = rest + np.outer(np.linspace(0, 1, 5), [0.0, 4.0, 0.0])
    assert bending(moved[None], rest).tolist() == [[0.0, 4.0]]
    frame = frames(moved[None], rest)[0]
    assert (np.abs(frame[:, 2] @ [0.0, 1.0, 0.0]) < 0.1).all(), "out of plane is along x"
