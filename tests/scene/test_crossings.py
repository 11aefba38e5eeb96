"""Crossings of closed paths against places computed by hand."""

import numpy as np
import pytest

from surgisoft.scene.crossings import SAMPLED_MM, crossing_mm

UP = np.array([0.0, 0.0, 1.0])


def sampled(corners):
    """A closed polyline (N, 2) mm at z = 0 as points SAMPLED_MM apart, and normals along z."""
    line = np.column_stack((np.vstack((corners, corners[:1])), np.zeros(len(corners) + 1)))
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))]
    places = np.linspace(0.0, along[-1], int(np.ceil(along[-1] / SAMPLED_MM)), endpoint=False)
    points = np.stack([np.interp(places, along, axis) for axis in line.T], axis=1)
    return points, np.tile(UP, (len(points), 1))


def curve(x, y, count=720):
    """Corners (count, 2) of x(t), y(t) for t from 0 to 2 pi."""
    t = 2.0 * np.pi * np.arange(count) / count
    return np.stack((x(t), y(t)), axis=1)


def polar(radius):
    """Corners of the curve radius(t), mm."""
    return curve(lambda t: radius(t) * np.cos(t), lambda t: radius(t) * np.sin(t))


SLIT = [(-9, -9), (9, -9), (9, 9), (0.05, 9), (0.05, 0), (-0.05, 0), (-0.05, 9), (-9, 9)]
CROSSED = {
    "eight": (curve(lambda t: 10 * np.sin(t), lambda t: 8 * np.sin(t) * np.cos(t)), [0.0, 0.0]),
    "eight with a corner in the crossing": (
        np.array([[0, 0], [5, 4], [5, -4], [0, 0], [-5, 4], [-5, -4]], float),
        [0.0, 0.0],
    ),
    "bow tie": (np.array([[0, 0], [6, 6], [6, 0], [0, 2]], float), [1.5, 1.5]),
    "inner loop": (polar(lambda t: 2 + 4 * np.cos(t)), [0.0, 0.0]),
}
SIMPLE = {
    "circle": polar(lambda t: 10.0),
    "first corner repeated": np.array([[0, 0], [6, 0], [6, 6], [0, 0]], float),
    "star": polar(lambda t: 8 + 4 * np.cos(5 * t)),
    "slit of 0.1 mm": np.array(SLIT, float),
}


@pytest.mark.parametrize("name", CROSSED)
def test_a_crossing_is_found_where_it_is(name):
    corners, place = CROSSED[name]
    for turned in (corners, corners[::-1], np.roll(corners, 7, axis=0)):
        found = crossing_mm(*sampled(turned))
        assert found is not None
        np.testing.assert_allclose(found[:2], place, atol=0.01)


@pytest.mark.parametrize("name", SIMPLE)
def test_a_loop_with_one_inside_has_no_crossing(name):
    for turned in (SIMPLE[name], SIMPLE[name][::-1]):
        assert crossing_mm(*sampled(turned)) is None


def test_a_circle_passed_twice_is_a_crossing():
    twice = np.tile(SIMPLE["circle"], (2, 1))
    place = crossing_mm(*sampled(twice))
    assert np.linalg.norm(place) == pytest.approx(10.0, abs=0.01)


def test_a_path_around_a_tube_crosses_itself_only_as_seen_from_the_side():
    """Front and back, z = 4 cos(3 t) and -4 cos(3 t) mm, meet as seen along x at t = 30 degrees."""
    t = 2.0 * np.pi * np.arange(300) / 300
    points = np.stack((5 * np.cos(t), 5 * np.sin(t), 4 * np.cos(3 * t)), axis=1)
    normals = np.stack((np.cos(t), np.sin(t), 0 * t), axis=1)
    assert crossing_mm(points, normals) is None
    place = crossing_mm(points * [0.0, 1.0, 1.0], np.tile([1.0, 0.0, 0.0], (300, 1)))
    np.testing.assert_allclose(np.abs(place), [0.0, 2.5, 0.0], atol=0.02)
