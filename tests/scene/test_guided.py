"""FCL guided by a search, and the queries of a lone environment, against what they stand for."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from surgisoft.scene import collision
from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.bvh import STACK, build_tree
from surgisoft.scene.camera import LIFT_MM, SHORT_MM, Camera, seen_from
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.collision import CollisionChecker, ExactScene, GuidedChecker
from surgisoft.scene.mesh import Body
from tests.scene.shapes import ball, box, lumpy
from tests.scene.test_distance import random_arms

RADII = {"laser": 6.0, "endoscope": 5.0}
NAMES = ("struck", "body", "face", "distance_mm", "point_mm", "normal", "incidence_rad")


@pytest.fixture(scope="module")
def bodies():
    pose, far = np.eye(4), np.eye(4)
    pose[:3, 3], far[:3, 3] = [55.0, 0.0, 10.0], [0.0, 0.0, -130.0]
    block = Body("block", "keep-out", box(), pose)
    return (Body("organ", "organ", lumpy(3)), block, Body("floor", "support", ball(20.0, 2), far))


@pytest.fixture(scope="module")
def checkers(bodies):
    plain = CollisionChecker(bodies)
    return SimpleNamespace(plain=plain, guided=GuidedChecker(plain))


def curled(seed, bend, inwards):
    """Two arms of 90 mm; a bend beyond 5 rad folds one on itself, inwards moves it to a body."""
    rng = np.random.default_rng(seed)
    lines = random_arms(2, seed).double().numpy()
    angle = bend * np.linspace(0.0, 1.0, 21)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    arc = 90.0 / bend * np.stack((1.0 - np.cos(angle), 0.05 * angle, np.sin(angle)), 1)
    lines = [arc @ turn + lines[0, 0], lines[1]]
    return [(line - inwards * line.mean(0)).astype(np.float32) for line in lines]


@settings(max_examples=120, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.1, 8.0), st.floats(0.0, 1.0))
def test_guided_clearances_are_those_of_whole_arms(checkers, seed, bend, inwards):
    """Arms far away, near, across and inside of bodies, and folded on themselves."""
    lines = curled(seed, bend, inwards)
    arms = {n: ArmShape(line, RADII[n]) for n, line in zip(RADII, lines, strict=True)}
    exact, found = checkers.plain.clearance(arms), checkers.guided.clearances(arms)
    expected = [exact.bodies_mm.values(), exact.arms_mm.values(), exact.self_mm.values()]
    for one, other in zip(found, expected, strict=True):
        assert one == pytest.approx([*other], abs=1e-6)


def test_bodies_of_many_faces_are_given_to_fcl_as_a_whole(bodies, checkers, monkeypatch):
    monkeypatch.setattr(collision, "GUIDED_FACES", 100)
    asked = []
    search = collision.nearest_to_surface
    monkeypatch.setattr(
        collision, "nearest_to_surface", lambda *a: asked.append(len(a[5][0])) or search(*a)
    )
    lines = curled(3, 2.0, 0.5)
    arms = {n: ArmShape(line, RADII[n]) for n, line in zip(RADII, lines, strict=True)}
    found, _, _ = GuidedChecker(checkers.plain).clearances(arms)
    expected = checkers.plain.clearance(arms).bodies_mm
    assert found == pytest.approx([*expected.values()], abs=1e-9)
    small = [len(body.mesh.faces) for body in bodies if len(body.mesh.faces) <= 100]
    assert asked == 2 * small
    assert 0 < len(small) < len(bodies)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.integers(1, 40), min_size=3, max_size=12))
def test_the_segments_that_come_nearest_are_those_found(heights):
    """Above a plate as wide as a table, a segment is as near as its lower end."""
    mesh = box((2000.0, 2000.0, 10.0))
    line = np.stack([10.0 * np.arange(len(heights)), 0.0 * np.array(heights), heights], axis=1)
    line[:, 2] += 5.0
    found, work = np.empty(2, np.int64), (np.empty(STACK, np.int64), np.empty(STACK))
    guide = (1000.0, 1e-6, build_tree(mesh).arrays, found, *work)
    least = collision.nearest_to_surface(line.astype(np.float32), np.eye(3), np.zeros(3), *guide)
    lower = np.minimum(heights[1:], heights[:-1])
    nearest = np.flatnonzero(lower == lower.min())
    assert least == pytest.approx(lower.min(), abs=1e-5)
    assert found.tolist() == [nearest[0], nearest[-1]]


def test_the_search_leaves_little_to_whole_arms(bodies):
    guided = GuidedChecker(CollisionChecker(bodies))
    for seed in range(100):
        lines = curled(seed, 3.0, 0.2)
        guided.clearances({n: ArmShape(k, RADII[n]) for n, k in zip(RADII, lines, strict=True)})
    assert guided.asked_whole <= 2


@settings(max_examples=120, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.1, 8.0), st.floats(0.0, 1.0))
def test_guided_beams_meet_what_beams_meet(checkers, seed, bend, inwards):
    lines = curled(seed, bend, inwards)
    arms = {n: ArmShape(line, RADII[n]) for n, line in zip(RADII, lines, strict=True)}
    rng = np.random.default_rng(seed)
    origin = lines[0][-1].astype(float)
    aim = (lines[0][-1] - lines[0][-2] + rng.normal(size=3)).astype(float)
    hit = checkers.plain.cast(origin, aim, 150.0, arms, own="laser")
    found = checkers.guided.cast(origin, aim, 150.0, arms, own="laser")
    for name, value in zip(NAMES, found, strict=True):
        np.testing.assert_allclose(getattr(hit, name), value, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("engine", [BatchedScene, ExactScene])
def test_a_lone_environment_is_a_batch_of_one(bodies, engine):
    """The numbers of the kept arrays are those of the tensors, to the last bit."""
    scene, sight, rng = engine(bodies, RADII), BatchedScene(bodies, RADII), np.random.default_rng(5)
    lines = {name: np.empty((1, 21, 3), np.float32) for name in RADII}
    tips, aims = ({n: np.empty((1, 3), np.float32) for n in RADII} for _ in range(2))
    alone, looks = scene.alone(lines), sight.alone(lines)
    beam = alone.beam(tips["laser"], aims["laser"], 150.0, "laser")
    camera = Camera()
    points = rng.normal(size=(1, 24, 3)).astype(np.float32) * 30.0
    normals = (points / np.linalg.norm(points, axis=2, keepdims=True)).astype(np.float32)
    picture = (LIFT_MM, 0.5 * camera.fov_rad, *camera.range_mm)
    place = (tips["endoscope"], aims["endoscope"], points, normals)
    look, struck, seen = looks.look(*place, picture, SHORT_MM, "endoscope"), set(), 0
    for seed in range(60):
        given = zip(RADII, curled(seed, 0.5 + seed / 15.0, seed / 80.0), strict=True)
        for name, line in given:
            lines[name][0] = line
            tips[name][0], aims[name][0] = line[-1], -line[-1] / np.linalg.norm(line[-1])
        if seed == 30:
            lines["laser"][0, 4] *= 3.0  # a long segment, which is divided
        arms = {name: torch.from_numpy(line) for name, line in lines.items()}
        expected = scene.clearance(arms)
        alone.clearance()
        for name in ("bodies_mm", "arms_mm", "self_mm"):
            assert np.array_equal(getattr(alone, name), getattr(expected, name).numpy()), name
        at = torch.from_numpy(tips["laser"]), torch.from_numpy(aims["laser"])
        hit = scene.cast(*at, 150.0, arms, own="laser")
        beam.cast()
        for name in NAMES:
            assert np.array_equal(getattr(beam, name), getattr(hit, name).numpy()), name
        given = [torch.from_numpy(array) for array in place]
        view, found = seen_from(sight, camera, *given, arms, own="endoscope"), look()
        assert np.array_equal(found.visible, view.visible.numpy())
        assert np.array_equal(found.wanted & ~found.visible, view.hidden.numpy())
        assert found.middle[0, 0] == view.axis_error_rad.item()
        struck.add(int(beam.struck[0]))
        seen += found.visible.sum()
    assert len(struck) >= 3
    assert seen > 50


def test_a_lone_environment_whose_arm_is_not_finite_has_no_clearance(bodies):
    lines = {name: random_arms(1, 3).numpy() for name in RADII}
    lines["laser"][0, 7] = np.nan
    for engine in (BatchedScene, ExactScene):
        alone = engine(bodies, RADII).alone(lines)
        alone.clearance()
        assert np.isnan(alone.bodies_mm[0, 0]).all()
        beam = alone.beam(lines["laser"][:, -1], lines["laser"][:, 7], 90.0, "laser")
        beam.cast()
        assert beam.struck[0] == 0
