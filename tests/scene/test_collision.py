"""The exact collision checker against closed forms and engines that share none of its code."""

import math

import numpy as np
import pytest
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st
from trimesh.ray.ray_pyembree import RayMeshIntersector

from surgisoft.errors import InputError
from surgisoft.scene import frames
from surgisoft.scene.capsules import ArmShape, segment_distance
from surgisoft.scene.collision import CollisionChecker
from surgisoft.scene.inside import points_inside
from surgisoft.scene.mesh import Body, Mesh
from surgisoft.scene.rays import Struck
from tests.scene.shapes import arc_points, ball, box, lumpy

BOX = np.array([40.0, 30.0, 20.0])
POSE = frames.pose_from_z([12.0, -7.0, 30.0], [0.3, -0.5, 0.8], 0.7)


def box_checker(**options):
    return CollisionChecker([Body("box", "organ", box(BOX), POSE)], **options)


def box_distance(points, half=BOX / 2):
    """Signed distance of points in the box's own frame to its surface, closed form."""
    q = np.abs(points) - half
    return np.linalg.norm(np.maximum(q, 0), axis=-1) + np.minimum(q.max(axis=-1), 0)


def straight(start, end, radius=2.0, count=9):
    """A straight arm given in the box's frame, placed in the world with it."""
    line = np.linspace(start, end, count)
    return ArmShape(frames.apply(POSE, line), radius)


coordinate = st.floats(-45, 45)
point = st.tuples(coordinate, coordinate, coordinate)


@example((-35.5854266720841, 0.0, 0.0), (0.0, 0.0, 0.0), 1.0)
@given(point, point, st.floats(0.5, 8.0))
@settings(max_examples=60, deadline=None)
def test_clearance_of_a_box_is_the_closed_form(start, end, radius):
    arm = straight(start, end, radius)
    dense = box_distance(np.linspace(start, end, 4001))
    found = box_checker().clearance({"a": arm}).bodies_mm["a", "box"]
    outside = dense.min() > 1e-6
    if outside:
        spacing = np.linalg.norm(np.subtract(end, start)) / 4000
        slack = math.hypot(dense.min(), spacing / 2) - dense.min()
        assert dense.min() - slack - 1e-9 <= found + radius <= dense.min() + 1e-9
    else:
        points = box_distance(np.linspace(start, end, 9))
        assert found + radius == pytest.approx(min(0.0, points.min()), abs=1e-9)


@pytest.mark.parametrize("gap", [-1.0, -1e-6, 1e-6, 1.0, 25.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_touching_a_face_is_decided_to_a_nanometre(gap, axis):
    start = np.zeros(3)
    start[axis] = BOX[axis] / 2 + 2.0 + gap
    along = np.roll([1.0, 0, 0], axis + 1)
    arm = straight(start - 5 * along, start + 5 * along)
    checker = box_checker()
    assert checker.clearance({"a": arm}).bodies_mm["a", "box"] == pytest.approx(gap, abs=1e-9)
    assert bool(checker.collisions({"a": arm})) == (gap < 0)


def test_an_arm_wholly_inside_is_found_though_it_touches_no_surface():
    arm = straight([-5, 0, 0], [5, 0, 0])
    (found,) = box_checker().collisions({"a": arm})
    assert (found.inside, found.kind, found.other) == (True, "body", "box")
    assert box_checker().clearance({"a": arm}).bodies_mm["a", "box"] == pytest.approx(-12.0)


def test_a_body_wholly_inside_the_arm_is_found():
    grain = Mesh(box((0.1, 0.1, 0.1)).vertices_mm, box().faces)
    checker = CollisionChecker([Body("grain", "keep-out", grain)])
    arm = ArmShape([[-30.0, 1.0, 0], [30, 1, 0]], 5.0)
    assert checker.collisions({"a": arm})[0].other == "grain"
    assert checker.clearance({"a": arm}).least_mm == pytest.approx(0.95 - 5.0)


def test_every_overlapping_pair_is_found():
    """Default FCL callbacks stop early: six bodies through one arm, two arms through each other."""
    poses = [frames.pose_from_z([0, 0, 20.0 * i], [0, 0, 1.0]) for i in range(6)]
    bodies = [Body(f"b{i}", "keep-out", box((8, 8, 8)), pose) for i, pose in enumerate(poses)]
    arms = {
        "a": ArmShape(arc_points(110.0, 0.0, 30), 3.0),
        "b": ArmShape(np.add(arc_points(110.0, 0.0, 30), [1, 0, 0]), 3.0),
    }
    found = {(c.arm, c.other) for c in CollisionChecker(bodies).collisions(arms)}
    assert found == {(arm, f"b{i}") for arm in "ab" for i in range(6)} | {("a", "b")}


@given(point, point, point, point)
@settings(max_examples=60, deadline=None)
def test_arms_keep_the_distance_of_their_centrelines(a, b, c, d):
    dense = np.linspace(0, 1, 301)[:, None]
    first, second = a + dense * np.subtract(b, a), c + dense * np.subtract(d, c)
    brute = np.linalg.norm(first[:, None] - second[None], axis=-1).min()
    slack = (math.dist(a, b) + math.dist(c, d)) / 600
    exact = segment_distance(*(np.array(p, dtype=float) for p in (a, b, c, d)))
    parallel = 1e-7 * math.dist(a, b)  # lines closer to parallel than this are taken as parallel
    rounding = 1e-9  # coordinates of tens of millimetres in double precision
    assert brute - slack - rounding <= exact <= brute + parallel + rounding
    arms = {"one": ArmShape([a, b], 1.5), "two": ArmShape([c, d], 2.5)}
    checker = CollisionChecker([], horizon_mm=1000.0)
    assert checker.clearance(arms).arms_mm["one", "two"] == pytest.approx(exact - 4, abs=1e-5)
    if abs(exact - 4) > 1e-4:
        assert bool(checker.collisions(arms)) == (exact < 4)


def test_an_arm_meets_itself_only_where_it_folds():
    checker = CollisionChecker([])
    radius, length = 5.0, 120.0
    for bend, folds in ((0.0, False), (3.0, False), (2 * math.pi, True)):
        arm = ArmShape(arc_points(length, bend, 60), radius)
        assert bool(checker.collisions({"a": arm})) is folds
        assert (checker.clearance({"a": arm}).self_mm["a"] < 0) is folds
    tightest = ArmShape(arc_points(math.pi * 6.0, math.pi, 60), 5.9)
    assert not checker.collisions({"a": tightest})


def test_self_clearance_of_a_hairpin_is_the_gap_between_its_legs():
    leg = arc_points(50, 0, 26)
    arm = ArmShape(np.concatenate((leg, np.add(leg[::-1], [14, 0, 0]))), 4.0)
    assert CollisionChecker([]).clearance({"a": arm}).self_mm["a"] == pytest.approx(6.0, abs=1e-9)


def test_far_clearances_saturate_at_the_horizon():
    arm = straight([0, 0, 500], [0, 0, 520])
    assert box_checker(horizon_mm=30.0).clearance({"a": arm}).least_mm == 30.0


def test_open_meshes_have_no_inside():
    closed = ball()
    opened = Mesh(closed.vertices_mm, closed.faces[1:])
    assert points_inside(closed, np.zeros((1, 3)))[0]
    assert not points_inside(opened, np.zeros((1, 3)))[0]


def test_inside_agrees_with_a_ray_parity_engine():
    mesh = lumpy()
    points = np.random.default_rng(0).uniform(*mesh.bounds_mm * 1.1, size=(4000, 3))
    solid = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False)
    np.testing.assert_array_equal(points_inside(mesh, points), solid.contains(points))


def test_rays_hit_a_ball_where_the_sphere_says():
    mesh, radius = ball(50.0, subdivisions=5), 50.0
    rng = np.random.default_rng(2)
    origins = frames.normalise(rng.normal(size=(300, 3))) * 90.0
    aims = frames.normalise(rng.normal(size=(300, 3))) * radius * rng.uniform(0, 0.9, (300, 1))
    directions = frames.normalise(aims - origins)
    hit = CollisionChecker([Body("ball", "organ", mesh)]).cast(origins, directions, 300.0)
    half = frames.dot(origins, directions)
    truth = -half - np.sqrt(half**2 - 90.0**2 + radius**2)
    assert hit.on_organ.all()
    sagitta = 0.02  # the facets of this ball lie at most this far below the sphere
    cosine = -frames.dot(directions, frames.normalise(hit.point_mm))
    assert (hit.distance_mm - truth > -1e-9).all()
    assert ((hit.distance_mm - truth) * cosine < 3 * sagitta).all()


def test_rays_agree_with_embree_to_floating_point():
    mesh = lumpy()
    checker = CollisionChecker([Body("organ", "organ", mesh, POSE)])
    rng = np.random.default_rng(5)
    origins = rng.normal(size=(1500, 3)) * 60
    directions = frames.normalise(rng.normal(size=(1500, 3)))
    hit = checker.cast(frames.apply(POSE, origins), frames.rotate(POSE, directions), 400.0)
    solid = trimesh.Trimesh(mesh.vertices_mm, mesh.faces, process=False)
    points, ray, face = RayMeshIntersector(solid).intersects_location(
        origins, directions, multiple_hits=False
    )
    struck = np.flatnonzero(hit.face >= 0)
    np.testing.assert_array_equal(struck, np.sort(ray))
    order = np.argsort(ray)
    np.testing.assert_allclose(hit.point_mm[struck], frames.apply(POSE, points[order]), atol=1e-9)
    assert (hit.face[struck] == face[order]).mean() > 0.999


def test_incidence_and_normal_of_a_plane_are_exact():
    checker = CollisionChecker([Body("box", "organ", box(BOX))])
    for degrees in (0, 30, 60, 89):
        tilt = math.radians(degrees)
        direction = np.array([math.sin(tilt), 0, -math.cos(tilt)])
        hit = checker.cast([1.0, 2.0, 10.0] - 15 * direction, direction, 100.0)
        np.testing.assert_allclose(hit.incidence_rad, tilt, atol=1e-12)
        np.testing.assert_allclose(hit.normal, [0, 0, 1], atol=1e-12)
        np.testing.assert_allclose(hit.point_mm, [1, 2, 10], atol=1e-12)


def test_a_ray_along_an_edge_of_the_mesh_is_not_lost():
    checker = CollisionChecker([Body("box", "organ", box(BOX))])
    on_diagonals = np.linspace(-0.99, 0.99, 41)[:, None] * [20, 15, 0] + [0, 0, 50]
    for flip in ([1, 1, 1], [1, -1, 1]):
        hit = checker.cast(on_diagonals * flip, np.tile([0, 0, -1.0], (41, 1)), 100.0)
        np.testing.assert_allclose(hit.distance_mm, 40.0, atol=1e-9)


def test_what_stands_in_the_beam_is_named():
    bodies = [
        Body("organ", "organ", box((40, 40, 10))),
        Body("vessel", "keep-out", box((4, 4, 4)), frames.pose_from_z([10, 0, 12], [0, 0, 1])),
        Body("table", "support", box((90, 90, 2)), frames.pose_from_z([0, 0, -20], [0, 0, 1])),
    ]
    checker = CollisionChecker(bodies)
    arms = {
        "laser": ArmShape([[0.0, 0, 90], [0, 0, 50]], 3.0),
        "scope": ArmShape([[-10.0, -30, 30], [-10, 30, 30]], 2.0),
    }
    origins = np.array([[0, 0, 50], [10, 0, 50], [-10, 0, 50], [40, 0, 50], [90, 0, 50.0]])
    down = np.tile([0, 0, -1.0], (5, 1))
    hit = checker.cast(origins, down, 80.0, arms, own="laser")
    kinds = [Struck.ORGAN, Struck.KEEP_OUT, Struck.OTHER_ARM, Struck.SUPPORT, Struck.NOTHING]
    assert hit.struck.tolist() == kinds
    np.testing.assert_allclose(hit.distance_mm, [45, 36, 18, 69, 80])
    np.testing.assert_allclose(hit.point_mm[4], [90, 0, -30])
    assert hit.blocked.tolist() == [False, True, True, True, False]
    assert np.isfinite(hit.point_mm).all()


def test_a_folded_arm_blocks_its_own_beam():
    turn = np.linspace(math.pi, -math.pi / 2, 60)
    hook = np.stack((12 + 12 * np.cos(turn), 0 * turn, 60 + 12 * np.sin(turn)), axis=1)
    line = np.concatenate((arc_points(60.0, 0.0, 40), hook[1:]))
    arms = {"laser": ArmShape(line, 2.0)}
    hit = CollisionChecker([]).cast(line[-1], [-1.0, 0, 0], 100.0, arms, own="laser")
    assert hit.struck == Struck.OWN_ARM
    assert hit.distance_mm == pytest.approx(10.0, abs=1e-9)
    np.testing.assert_allclose(hit.normal, [1, 0, 0], atol=1e-9)
    straight_arm = {"laser": ArmShape(arc_points(70, 0.5, 20), 5.0)}
    line = straight_arm["laser"].centreline_mm
    assert (
        CollisionChecker([])
        .cast(line[-1], line[-1] - line[-2], 100.0, straight_arm, "laser")
        .missed
    )


def test_bad_shapes_are_named():
    with pytest.raises(InputError, match="diverged"):
        ArmShape([[0.0, 0, 0], [0, 0, np.nan]], 1.0)
    with pytest.raises(InputError, match="radius is 0"):
        ArmShape([[0.0, 0, 0], [0, 0, 1]], 0.0)
    body = Body("x", "organ", box())
    with pytest.raises(InputError, match="repeat"):
        CollisionChecker([body, body])
