"""Rings on surfaces against closed forms, nearest points against brute force."""

import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from surgisoft.errors import InputError
from surgisoft.scene.lesion import (
    OrganSurface,
    circle_on,
    closest_in_triangles,
    directed_site,
    good_sites,
    lesion_ring,
    lesions_like,
    nearest_on_surface,
    patch_normal,
    pointed_site,
)
from surgisoft.scene.mesh import Mesh
from surgisoft.scene.spec import LesionSpec
from tests.scene.shapes import ball, box, lumpy, mesh_of

FINE = ball(50.0, 5)
BOX = box((80.0, 80.0, 80.0))
whole = OrganSurface.whole


@given(seed=st.integers(0, 1000))
def test_nearest_points_agree_with_trimesh(seed):
    rng = np.random.default_rng(seed)
    points, triangles = rng.normal(size=(200, 3)), rng.normal(size=(200, 3, 3))
    mine = np.linalg.norm(closest_in_triangles(points, triangles) - points, axis=1)
    theirs = trimesh.triangles.closest_point(triangles, points)
    np.testing.assert_allclose(mine, np.linalg.norm(theirs - points, axis=1), atol=1e-12)


@given(seed=st.integers(0, 1000), diameter=st.floats(5.0, 60.0))
def test_a_circle_on_a_ball_lies_on_ball_and_cylinder(seed, diameter):
    direction = np.random.default_rng(seed).normal(size=3)
    points, faces = nearest_on_surface(FINE, 60.0 * direction[None] / np.linalg.norm(direction))
    ring = circle_on(FINE, points[0], int(faces[0]), diameter, 48)
    axis = ring.normal
    away = ring.points_mm - points[0]
    flat = away - (away @ axis)[:, None] * axis
    np.testing.assert_allclose(np.linalg.norm(flat, axis=1), 0.5 * diameter, atol=1e-9)
    # edges of 1.8 mm: facets lie at most 1.8^2 / 8 r = 0.01 mm inside the ball
    np.testing.assert_allclose(np.linalg.norm(ring.points_mm, axis=1), 50.0, atol=0.02)
    np.testing.assert_allclose(axis, points[0] / 50.0, atol=0.02)


def test_a_circle_on_a_flat_side_is_that_circle():
    side = box((80.0, 80.0, 80.0))
    ring = circle_on(side, np.array([5.0, -3.0, 40.0]), _face(side, [5.0, -3.0, 40.0]), 20.0, 36)
    np.testing.assert_allclose(ring.points_mm[:, 2], 40.0, atol=1e-12)
    np.testing.assert_allclose(np.hypot(*(ring.points_mm[:, :2] - [5, -3]).T), 10.0)
    np.testing.assert_allclose(ring.normals, [[0.0, 0.0, 1.0]] * 36, atol=1e-12)


def _face(mesh, point):
    return int(nearest_on_surface(mesh, np.array([point]))[1][0])


@pytest.mark.parametrize(
    ("place", "fits"),
    [((0.0, 0.0, 40.0), True), ((29.9, 0.0, 40.0), True), ((30.5, 0.0, 40.0), False)],
)
def test_a_ring_that_hangs_over_an_edge_is_none(place, fits):
    side = box((80.0, 80.0, 80.0))
    assert (circle_on(side, np.array(place), _face(side, place), 20.0) is not None) == fits


def test_the_ring_stays_on_its_sheet_of_a_thin_plate():
    """Two millimetres thick: the far side must not draw the ring, nor cancel the normal."""
    plate = box((80.0, 80.0, 2.0))
    ring = circle_on(plate, np.array([0.0, 0.0, -1.0]), _face(plate, [0.0, 0.0, -1.0]), 20.0)
    np.testing.assert_allclose(ring.points_mm[:, 2], -1.0, atol=1e-12)
    np.testing.assert_allclose(ring.normal, [0.0, 0.0, -1.0], atol=1e-12)


def test_a_lesion_off_the_surface_is_told_where_it_is():
    with pytest.raises(InputError, match=r"lies 10 mm off .* \(0\.0, 0\.0, 50\.0\)"):
        lesion_ring(FINE, LesionSpec("liver", (0.0, 0.0, 60.0)))
    with pytest.raises(InputError, match="extends over an edge"):
        lesion_ring(box((80.0, 80.0, 80.0)), LesionSpec("box", (40.0, 40.0, 0.0)))


def test_a_path_of_ones_own_is_followed_evenly():
    side = box((80.0, 80.0, 80.0))
    square = ((-10.0, -10.0, 40.0), (10.0, -10.0, 40.0), (10.0, 10.0, 40.0), (-10.0, 10.0, 40.0))
    ring = lesion_ring(side, LesionSpec("box", (0.0, 0.0, 40.0), 20.0, square), 80)
    np.testing.assert_allclose(np.abs(ring.points_mm[:, :2]).max(axis=1), 10.0)
    steps = np.linalg.norm(np.roll(ring.points_mm, -1, axis=0) - ring.points_mm, axis=1)
    np.testing.assert_allclose(steps, 1.0)
    lifted = tuple((x, y, 45.0) for x, y, _ in square)
    with pytest.raises(InputError, match="leaves the surface"):
        lesion_ring(side, LesionSpec("box", (0.0, 0.0, 40.0), 20.0, lifted))


def test_pointing_finds_the_nearest_body():
    near, far = ball(30.0), ball(30.0)
    far = type(far)(far.vertices_mm + np.array([100.0, 0.0, 0.0]), far.faces)
    site = pointed_site([whole(near), whole(far)], np.array([100.0, 0.0, 35.0]), 15.0)
    assert site.body == 1
    np.testing.assert_allclose(site.point_mm, [100.0, 0.0, 30.0], atol=0.1)
    assert site.moved_mm == pytest.approx(5.0, abs=0.1)


@pytest.mark.parametrize(("side", "most"), [(80.0, 20.0), (400.0, 40.0)])
def test_a_point_is_near_within_20_mm_or_a_tenth_of_the_body(side, most):
    body = [whole(box((side, side, side)))]
    site = pointed_site(body, np.array([0.0, 0.0, 0.5 * side + most - 1.0]), 15.0)
    assert site.moved_mm == pytest.approx(most - 1.0)
    with pytest.raises(InputError, match=f"lies {most + 1:g} mm from .* at most {most:g} mm"):
        pointed_site(body, np.array([0.0, 0.0, 0.5 * side + most + 1.0]), 15.0)


def test_the_normal_of_a_patch_weighs_faces_by_their_area():
    """A roof of two equal slopes, of which one is made of 2 faces and one of 8."""
    corners = [[-10, -10, -2], [0, -10, 0], [0, 10, 0], [-10, 10, -2], [10, -10, -2], [10, 10, -2]]
    roof = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]], process=False)
    finer = roof.subdivide(face_index=[2, 3])
    mesh = Mesh(np.array(finer.vertices), np.array(finer.faces))
    assert len(mesh.faces) == 10
    found = patch_normal(mesh, np.zeros(3), 0, 30.0)
    np.testing.assert_allclose(found, [0.0, 0.0, 1.0], atol=1e-12)


def test_the_far_side_of_a_thin_plate_does_not_count_to_the_normal():
    plate = trimesh.creation.box((80.0, 80.0, 2.0)).subdivide().subdivide().subdivide()
    mesh = Mesh(np.array(plate.vertices), np.array(plate.faces))
    centre = np.array([0.1, 0.2, -1.0])
    found = patch_normal(mesh, centre, _face(mesh, centre), 20.0)
    np.testing.assert_allclose(found, [0.0, 0.0, -1.0], atol=1e-12)


@pytest.mark.parametrize(("slope", "fits"), [(60.0, True), (75.0, True), (76.0, False)])
def test_a_ring_lies_on_no_flank_steeper_than_75_5_degrees(slope, fits):
    """The plane z = 0 falls off from x = 5 mm on; a ring of 20 mm reaches 5 mm over the edge."""
    down = -30.0 * np.tan(np.radians(slope))
    corners = [
        [-40, -40, 0],
        [5, -40, 0],
        [5, 40, 0],
        [-40, 40, 0],
        [35, -40, down],
        [35, 40, down],
    ]
    mesh = Mesh(np.array(corners), np.array([[0, 1, 2], [0, 2, 3], [1, 4, 5], [1, 5, 2]]))
    ring = circle_on(mesh, np.zeros(3), 0, 20.0)
    assert (ring is not None) is fits


def test_a_face_that_closes_a_hole_wider_than_a_tenth_of_the_ring_is_no_tissue():
    surface = OrganSurface(BOX, np.where(np.arange(len(BOX.faces)) == 1, 2.1, 2.0))
    assert surface.is_lid(np.array([0, 1, 2]), 20.0).tolist() == [False, True, False]
    assert not surface.is_lid(np.array([1]), 22.0).any()


def test_good_sites_are_on_top_apart_and_off_what_closes_an_opening():
    """On a cube the upper side is best; where half of it closes an opening, the other half."""
    cube = BOX
    for _ in range(4):
        cube = mesh_of(trimesh.Trimesh(cube.vertices_mm, cube.faces, process=False).subdivide())
    sites = good_sites([whole(cube)], 16.0)
    assert len(sites) > 2
    assert all(site.ring.normal[2] == pytest.approx(1.0) for site in sites[:3])
    points = np.array([site.point_mm for site in sites])
    apart = np.linalg.norm(points[:, None] - points, axis=2) + 1e9 * np.eye(len(points))
    assert apart.min() >= 24.0
    middles = cube.triangles_mm.mean(axis=1)
    closing = (middles[:, 2] > 39.9) & (middles[:, 0] > 0.0)
    sites = good_sites([OrganSurface(cube, np.where(closing, 40.0, 0.0))], 16.0)
    assert sites[0].ring.normal[2] == pytest.approx(1.0)
    assert not any(closing[site.ring.faces].any() for site in sites)
    assert all(site.point_mm[0] < 0.0 for site in sites if site.ring.normal[2] > 0.5)


def test_no_good_site_is_on_what_closes_a_hole_inside_its_ring():
    """The best place of a cube, when a hole of 4 mm is closed there that the ring goes around."""
    cube = BOX
    for _ in range(4):
        cube = mesh_of(trimesh.Trimesh(cube.vertices_mm, cube.faces, process=False).subdivide())
    best = good_sites([whole(cube)], 16.0)[0]
    middles = cube.triangles_mm.mean(axis=1)
    closing = np.linalg.norm(middles - best.point_mm, axis=1) < 4.0
    assert closing.any()
    assert not closing[best.ring.faces].any()
    sites = good_sites([OrganSurface(cube, np.where(closing, 4.0, 0.0))], 16.0)
    _, faces = nearest_on_surface(cube, np.array([site.point_mm for site in sites]))
    assert not closing[faces].any()


def test_varied_lesions_are_uniform_in_place_and_diameter():
    """In a disc of 5 mm the mean square of the distance is 12.5 mm^2; diameters are 18 to 22 mm."""
    lesion = LesionSpec("box", (0.0, 0.0, 40.0), 20.0)
    found = lesions_like(BOX, lesion, 80, 5.0, 0.1)
    aside = np.array([each.centre_mm for each in found]) - lesion.centre_mm
    assert np.abs(aside[:, 2]).max() < 1e-9
    square = np.square(aside).sum(axis=1)
    assert square.max() <= 25.0
    assert square.mean() == pytest.approx(12.5, abs=2.5)
    diameters = np.array([each.diameter_mm for each in found])
    assert 18.0 <= diameters.min() < 18.5
    assert 21.5 < diameters.max() <= 22.0
    assert diameters.mean() == pytest.approx(20.0, abs=0.4)


def test_varied_lesions_keep_the_clearance_of_a_body_beside_them():
    """Rings of 8 mm on a plane whose centres differ by up to 5 mm; a wall begins at x = 10 mm.

    A ring keeps 3 mm where its centre is at x <= 3 mm: 10 - 3 - 4."""
    lesion = LesionSpec("box", (0.0, 0.0, 40.0), 8.0)
    wall = box((20.0, 60.0, 60.0))
    wall = type(wall)(wall.vertices_mm + np.array([20.0, 0.0, 40.0]), wall.faces)
    free = lesions_like(BOX, lesion, 60, 5.0, 0.0)
    kept = lesions_like(BOX, lesion, 30, 5.0, 0.0, {"wall": wall}, 3.0)
    assert max(each.centre_mm[0] for each in free) > 3.5
    assert kept == tuple(each for each in free if each.centre_mm[0] <= 3.0)[:30]
    with pytest.raises(InputError, match=r"fit on 'box' at least 12 mm from 'wall'; use a smaller"):
        lesions_like(BOX, lesion, 4, 5.0, 0.0, {"wall": wall}, 12.0)


@given(seed=st.integers(0, 1000))
def test_a_direction_finds_the_side_that_faces_it(seed):
    direction = np.random.default_rng(seed).normal(size=3)
    direction /= np.linalg.norm(direction)
    site = directed_site([whole(FINE)], direction, 20.0)
    np.testing.assert_allclose(site.point_mm, 50.0 * direction, atol=0.05)


def test_a_direction_through_a_hole_takes_the_outermost_point():
    torus = mesh_of(trimesh.creation.torus(60.0, 25.0))
    site = directed_site([whole(torus)], np.array([0.0, 0.0, 1.0]), 20.0)
    assert site.point_mm[2] == pytest.approx(25.0)


def test_a_ring_that_does_not_fit_where_pointed_tells_what_fits():
    side = box((80.0, 80.0, 80.0))
    with pytest.raises(InputError, match=r"20 mm does not fit .*a ring of 9 mm fits"):
        pointed_site([whole(side)], np.array([35.2, 0.0, 40.0]), 20.0)


def test_good_sites_are_open_and_the_same_each_time():
    organ = lumpy(4)
    lid = type(organ)(
        box((300.0, 300.0, 10.0)).vertices_mm + np.array([0.0, 0.0, 70.0]), box().faces
    )
    sites = good_sites([whole(organ), whole(lid)], 20.0)
    again = good_sites([whole(organ), whole(lid)], 20.0)
    assert [tuple(site.point_mm) for site in sites] == [tuple(site.point_mm) for site in again]
    # under the lid nothing above the organ is open
    assert sites[0].ring.normal[2] < 0.9


@pytest.mark.parametrize("diameter", [60.0, 200.0])
def test_a_ring_too_large_for_the_organ_tells_one_that_fits(diameter):
    """On a ball of 15 mm radius a ring is at most 30 mm sin(75.5 degrees) = 29 mm wide."""
    small = ball(15.0, 3)
    with pytest.raises(InputError, match=f"no ring of {diameter:g} mm") as caught:
        good_sites([whole(small)], diameter)
    fits = float(re.search(r"a ring of (\S+) mm fits", str(caught.value))[1])
    assert 20.0 <= fits <= 29.1
    assert good_sites([whole(small)], fits)


def test_an_own_path_that_crosses_itself_is_refused_with_the_place():
    """A bow tie on a flat side: its diagonals meet at (2, 3)."""
    tie = tuple((x, y, 40.0) for x, y in ((-4.0, -3.0), (8.0, 9.0), (8.0, -3.0), (-4.0, 9.0)))
    lesion = LesionSpec("organ", (2.0, 3.0, 40.0), path_mm=tie)
    with pytest.raises(InputError, match=r"path_mm crosses itself near \(2\.0, 3\.0, 40\.0\) mm"):
        lesion_ring(BOX, lesion)
    plain = replace(lesion, path_mm=(tie[0], tie[2], tie[1], tie[3]))
    assert np.ptp(lesion_ring(BOX, plain, 96).points_mm, axis=0).tolist() == [12.0, 12.0, 0.0]
