"""Visibility and rendered pictures against geometry that is worked out by hand."""

import math

import numpy as np
import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.scene import frames
from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.camera import Camera, view
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.collision import CollisionChecker
from surgisoft.scene.mesh import Body
from surgisoft.scene.rays import EmbreeSurface
from surgisoft.scene.render import Renderer, pixel_rays
from tests.scene.shapes import arc_points, ball, box, lumpy

CAMERA = Camera(math.radians(70.0), (10.0, 100.0))


def flat_ring(radius, height, count=360):
    turn = np.arange(count) * 2 * math.pi / count
    return np.stack((radius * np.cos(turn), radius * np.sin(turn), 0 * turn + height), axis=1)


def on_box(arms_in_the_way=None, eye=(0.0, 0, 60), target=(0.0, 0, 10), ring=None, camera=CAMERA):
    ring = flat_ring(10.0, 10.0) if ring is None else ring
    checker = CollisionChecker([Body("slab", "organ", box((80, 80, 20)))])
    up = np.tile([0, 0, 1.0], (len(ring), 1))
    pose = frames.look_at(np.array(eye), np.array(target))
    return view(checker, camera, pose, ring, up, arms_in_the_way)


def test_a_ring_straight_ahead_is_wholly_seen():
    seen = on_box()
    assert seen.fraction == 1.0
    assert seen.axis_error_rad == pytest.approx(0.0, abs=1e-9)
    assert seen.distance_mm == pytest.approx(50.0)


def test_axis_error_and_distance_are_trigonometry():
    seen = on_box(eye=(30.0, 0, 50), target=(30.0, 0, 10))
    assert seen.axis_error_rad == pytest.approx(math.atan2(30, 40))
    assert seen.axis_error_mm == pytest.approx(30.0)
    assert seen.distance_mm == pytest.approx(50.0)


def test_the_cone_cuts_the_ring_where_it_should():
    """Camera 20 mm up, 10 mm aside: the cone's circle meets the ring's at a known angle."""
    radius = 20.0 * math.tan(math.radians(35.0))
    seen = on_box(eye=(10.0, 0, 30), target=(10.0, 0, 10))
    cosine = (10**2 + 10**2 - radius**2) / (2 * 10 * 10)
    assert seen.fraction == pytest.approx(math.acos(cosine) / math.pi, abs=0.01)
    assert not seen.hidden.any()


@pytest.mark.parametrize(("height", "sharp"), [(15.0, False), (25.0, True), (125.0, False)])
def test_out_of_focus_is_out_of_view(height, sharp):
    tiny = flat_ring(0.5, 10.0)
    assert on_box(eye=(0.0, 0, height), ring=tiny).fraction == float(sharp)


def test_an_arm_in_front_hides_its_shadow():
    """A thin straight arm across the view hides a strip of the ring: similar triangles."""
    radius = 2.0
    arm = ArmShape([[-40.0, 0, 35], [40, 0, 35]], radius)
    seen = on_box({"laser": arm})
    half_angle = math.asin(radius / 25.0)
    strip = 50.0 * math.tan(half_angle)
    assert seen.hidden.mean() == pytest.approx(2 * math.asin(strip / 10) / math.pi, abs=0.01)
    assert seen.fraction + seen.hidden.mean() == pytest.approx(1.0)


def test_the_far_side_of_a_ball_is_hidden_by_the_ball():
    """From distance D the cap within acos(R / D) of its centre is seen (tangent rays)."""
    radius, eye = 30.0, np.array([0, 0, 80.0])
    limit = math.acos(radius / 80.0)
    checker = CollisionChecker([Body("ball", "organ", ball(radius, 5))])
    camera = Camera(math.radians(100), (1.0, 200.0))
    for angle in (0.2, limit - 0.1, limit + 0.1, 2.5):
        ring = radius * flat_ring(math.sin(angle), math.cos(angle), 40)
        seen = view(checker, camera, frames.look_at(eye, np.zeros(3)), ring, ring / radius)
        assert seen.fraction == float(angle < limit)


def test_batched_view_agrees_with_fcl(tmp_path):
    bodies = [Body("organ", "organ", lumpy(4))]
    engine = BatchedScene(bodies, {"laser": 5.0, "scope": 5.0}, most_nodes=20_000, cache=tmp_path)
    checker = CollisionChecker(bodies)
    rng = np.random.default_rng(0)
    count, vertices = 60, bodies[0].mesh.vertices_mm
    start = bodies[0].mesh.vertices_mm[:, 2].argmax()
    near = np.argsort(np.linalg.norm(vertices - vertices[start], axis=1))[:30]
    ring, normals = vertices[near], bodies[0].mesh.vertex_normals[near]
    eyes = ring.mean(0) + frames.normalise(rng.normal([0, 0, 1], size=(count, 3))) * 50
    poses = frames.look_at(eyes, ring.mean(0) + rng.normal(size=(count, 3)) * 8)
    places = frames.pose_from_z(
        ring.mean(0) + [0, 0, 70] + rng.normal(size=(count, 3)) * 12, [0, 0, -1.0]
    )
    lasers = frames.apply(places, np.tile(arc_points(60.0, 0.8, 12), (count, 1, 1)))
    arms = {"laser": torch.tensor(lasers)}
    found = view(engine, CAMERA, torch.tensor(poses), ring, normals, arms)
    for i in range(count):
        truth = view(checker, CAMERA, poses[i], ring, normals, {"laser": ArmShape(lasers[i], 5.0)})
        assert np.mean(found.visible[i].numpy() != truth.visible) <= 1 / 30
        assert found.axis_error_mm[i].item() == pytest.approx(truth.axis_error_mm, abs=1e-6)
    assert 0.1 < found.fraction.mean() < 0.95
    assert found.hidden.any()


def test_bad_cameras_are_named():
    with pytest.raises(InputError, match="field of view"):
        Camera(fov_rad=4.0)
    with pytest.raises(InputError, match="rising"):
        Camera(range_mm=(10.0, 5.0))


def ball_picture(**options):
    camera = Camera(math.radians(70.0), (10.0, 200.0))
    bodies = [Body("ball", "organ", ball(20.0, 5))]
    pose = frames.look_at(np.array([0, 0, 80.0]), np.zeros(3))
    return Renderer(bodies, camera, 320, 240).image(pose, **options)


def test_a_ball_covers_the_disc_that_perspective_gives_it():
    picture = ball_picture()
    focal = 120 / math.tan(math.radians(35))
    disc = focal * math.tan(math.asin(20.0 / 80.0))
    lit = picture.max(axis=2) > 60
    assert lit.sum() == pytest.approx(math.pi * disc**2, rel=0.02)
    assert not picture[0, 0].any()
    assert picture[120, 160, 0] > picture[120, 160, 2]


def test_paint_and_beam_show_where_they_are():
    plain = ball_picture().astype(int)

    def burnt(faces, points, colours):
        return np.where(points[:, :1] > 0.0, 0.0, colours)

    painted = ball_picture(paint={"ball": burnt}).astype(int)
    changed = np.abs(painted - plain).sum(axis=2) > 10
    assert changed[100:140, 175:200].mean() > 0.9
    assert not changed[:, :158].any()
    beam = ball_picture(beam_mm=np.array([[30.0, 0, 30], [10, 0, 17.3]])).astype(int)
    greener = (beam - plain)[..., 1] > 40
    rows, columns = np.nonzero(greener)
    assert greener.sum() > 20
    assert (columns > 170).all()
    assert (np.abs(rows - 120) < 8).all()


def test_arms_are_drawn_in_front_and_hide_what_is_behind():
    plain = ball_picture()
    arm = ArmShape([[-60.0, 0, 40], [60, 0, 40]], 4.0)
    covered = ball_picture(arms={"laser": arm})
    strip = 120 / math.tan(math.radians(35)) * math.tan(math.asin(4.0 / 40.0))
    column = np.abs(covered[:, 160].astype(int) - plain[:, 160]).sum(axis=1) > 20
    assert column.sum() == pytest.approx(2 * strip, abs=3)


def test_pixels_are_evenly_spaced_on_the_picture_plane():
    rays, inside = pixel_rays(CAMERA, 160, 120)
    plane = (rays / rays[:, 2:]).reshape(120, 160, 3)
    steps = np.diff(plane[..., 0], axis=1)
    np.testing.assert_allclose(steps, math.tan(math.radians(35)) / 60, rtol=1e-12)
    assert inside.sum() == pytest.approx(math.pi * 60**2, rel=0.01)


def test_a_picture_is_one_launch_of_one_ray_a_pixel(monkeypatch):
    """Arms and beam are closed forms: they cast no ray more (benchmarks/geometry.py times it)."""
    launched = []
    first_hit = EmbreeSurface.first_hit

    def counted(self, origins_mm, directions, range_mm):
        launched.append(np.shape(directions))
        return first_hit(self, origins_mm, directions, range_mm)

    monkeypatch.setattr(EmbreeSurface, "first_hit", counted)
    renderer = Renderer(
        [Body("organ", "organ", lumpy(3)), Body("box", "organ", box((9, 9, 9)))], CAMERA
    )
    pose = frames.look_at(np.array([0, 0, 90.0]), np.zeros(3))
    arms = {"laser": ArmShape(arc_points(70, 0.5, 25) + np.array([20, 0, 50.0]), 7.5)}
    beam = np.array([[20.0, 0, 50], [0, 0, 40]])
    for _ in range(2):
        renderer.image(pose, arms, beam_mm=beam)
    assert launched == [(160 * 120, 3)] * 2
