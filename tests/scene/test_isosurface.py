"""Surface nets against closed forms: closed, outward, on the level, with evened faces."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surgisoft.scene.isosurface import settle, surface_nets
from surgisoft.scene.mesh import Mesh


def grid(field, half_mm, spacing_mm):
    axis = np.arange(-half_mm, half_mm + spacing_mm, spacing_mm)
    points = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    return surface_nets(field(points), np.full(3, -half_mm), spacing_mm)


def ball(radius):
    return lambda points: np.linalg.norm(points, axis=-1) - radius


def torus(radius, tube):
    def field(points):
        flat = np.hypot(points[..., 0], points[..., 1]) - radius
        return np.hypot(flat, points[..., 2]) - tube

    return field


@given(radius=st.floats(8.0, 18.0))
def test_a_ball_has_its_volume_and_is_closed(radius):
    vertices, faces = grid(ball(radius), 20.0, 1.7)
    mesh = Mesh(settle(vertices, faces, ball(radius), 4, 0.05), faces)
    assert mesh.is_watertight
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices_mm, axis=1), radius, atol=1e-9)
    exact = 4.0 / 3.0 * np.pi * radius**3
    # a flat face of edge h lies up to h^2 / 8 r inside the ball: 3 h^2 / 8 r^2 of the volume
    assert 0.0 < exact - mesh.volume_mm3 < 3.0 * 1.7**2 / (8.0 * radius**2) * exact


def test_a_torus_keeps_its_hole_and_its_volume():
    vertices, faces = grid(torus(20.0, 7.0), 30.0, 1.0)
    mesh = Mesh(vertices, faces)
    edges = len(np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0))
    assert len(vertices) - edges + len(faces) == 0  # Euler's number of a torus
    assert mesh.is_watertight
    assert mesh.volume_mm3 == pytest.approx(2.0 * np.pi**2 * 20.0 * 7.0**2, rel=0.01)


def test_two_sheets_in_one_cell_stay_apart():
    """Balls that nearly touch along a cell's diagonal share cells but neither vertex nor edge."""
    shift = 5.25

    def field(points):
        return np.minimum(ball(9.0)(points - shift), ball(9.0)(points + shift))

    vertices, faces = grid(field, 18.0, 1.5)
    mesh = Mesh(vertices, faces)
    assert mesh.is_watertight
    assert mesh.volume_mm3 == pytest.approx(2 * 4 / 3 * np.pi * 9.0**3, rel=0.03)


def test_settling_evens_the_faces_out():
    field = torus(20.0, 8.0)
    vertices, faces = grid(field, 30.0, 1.5)
    rough = Mesh(vertices, faces).corner_angles_rad.min(axis=1)
    smooth = Mesh(settle(vertices, faces, field, 20, 0.05), faces).corner_angles_rad.min(axis=1)
    assert np.percentile(smooth, 1) > np.percentile(rough, 1)
    assert np.degrees(np.percentile(smooth, 1)) > 30.0
