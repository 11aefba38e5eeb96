"""The compiled world against the reference in tensor operations, over whole episodes."""

import math
from dataclasses import replace
from importlib.util import find_spec

import pytest
import torch

from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.camera import seen_from
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.observations import OBSERVATION_LIMIT, asinh, asinh_of
from surgisoft.tasks.registry import TASKS, make_task
from surgisoft.tasks.world.scene import ENDOSCOPE, SceneEngine

AGREE_MM = 1e-4
"""Largest difference of a place (mm): rounding of float32 at 100 mm, some ten steps of it."""
EPISODES = 2
MOST, WITH_SCENE, BREATHING = 300, 60, 400
"""Longest stretches of an episode, steps: of a task without a scene, which is then whole; of one
with a scene; of `breathing_ablation`, which are 10 breaths: its arms are those of all tasks with a
scene."""
LOOKS = 2
"""Comparisons of the scenes in an episode, whose state follows from that of the arms."""


@pytest.mark.parametrize("name", TASKS)
def test_compiled_arms_agree_with_the_reference_over_episodes(name):
    task, random = make_task(name), torch.Generator().manual_seed(1)
    plain = {arm: body.reference() for arm, body in task.world.arms.items()}
    around, others, dt_s = task.world.scene, [], task.world.config.dt_s
    if around is not None:
        engines = ["torch"] + ["warp"] * (find_spec("warp") is not None)
        given = (around.geometry.bodies, around.geometry.radii_mm)
        stretch = around.geometry.stretch
        others = [BatchedScene(*given, engine=engine, stretch=stretch) for engine in engines]
    with torch.inference_mode():
        world = Episodes(task).seeded(4, EPISODES).world
        stream, found, expected = world.stream, dict(world.arms), dict(world.arms)
        most = MOST if around is None else BREATHING if name == "breathing_ablation" else WITH_SCENE
        steps = min(task.steps, most)
        for step in range(steps):
            for arm, body in plain.items():
                action = torch.randn(EPISODES, body.chambers, generator=random)
                _, expected[arm] = body.step(stream, expected[arm], action, dt_s)
                stream, found[arm] = task.world.arms[arm].step(stream, found[arm], action, dt_s)
                for field in ("points_mm", "line_mm", "tip_direction", "seen_mm", "pressure"):
                    off = (getattr(found[arm], field) - getattr(expected[arm], field)).abs().max()
                    assert off < AGREE_MM, (arm, field, step)
                assert torch.equal(found[arm].arm.direction, expected[arm].arm.direction)
            if others and step % (steps // LOOKS) == 0:
                stream, scene = around.start(stream, found)
                for other in others:
                    assert_scenes_agree(around, other, replace(world, arms=found, scene=scene))


def assert_scenes_agree(around, other, world):
    """The compiled scene's state is what the engine in tensor operations finds."""
    lines = {name: part.line_mm for name, part in world.arms.items()}
    poses = around.placement(world.scene.breaths) if isinstance(around, SceneEngine) else None
    scene, found = world.scene, other.clearance(lines, poses)
    for field in ("bodies_mm", "arms_mm", "self_mm"):
        off = (getattr(scene.clearance, field) - getattr(found, field)).abs()
        assert off.numel() == 0 or off.max() < AGREE_MM, field
    if not isinstance(around, SceneEngine):
        return
    for laser in around.lasers:
        beam, seen = world.arms[laser], scene.hits[laser]
        hit = other.cast(
            beam.tip_mm, beam.tip_direction, around.beam_mm, lines, own=laser, poses=poses
        )
        assert torch.equal(hit.struck, seen.struck)
        assert (hit.point_mm - seen.point_mm).abs().max() < AGREE_MM
        assert (hit.normal - seen.normal).abs().max() < AGREE_MM
    looks = (around.looks_mm[scene.watched], around.look_normals[scene.watched])
    moved = {} if poses is None else {"poses": poses}
    if poses is not None:
        looks = (poses.points(looks[0]), poses.normals(looks[1]))
    for name in around.endoscopes:
        at = (world.arms[name].tip_mm, world.arms[name].tip_direction)
        view = seen_from(other, around.work_camera, *at, *looks, lines, own=name, **moved)
        assert torch.equal(view.visible, scene.views[name].visible)
        assert torch.equal(view.hidden, scene.views[name].hidden)
        assert (view.axis_error_mm - scene.views[name].axis_error_mm).abs().max() < AGREE_MM


def test_lines_of_sight_are_hidden_where_a_ray_meets_something():
    """A camera that looks at the lesion past the other arm, against rays cast one by one."""
    task, count, random = make_task("circle_ablation"), 64, torch.Generator().manual_seed(2)
    around, parts = task.world.scene, Episodes(task).seeded(0, count).world.arms
    lines = {
        name: part.line_mm + 15.0 * torch.randn(count, 1, 3, generator=random)
        for name, part in parts.items()
    }
    eye = lines[ENDOSCOPE][:, -1]
    axis = around.centre_mm - eye + 6.0 * torch.randn(count, 3, generator=random)
    axis = torch.nn.functional.normalize(axis, dim=1)
    ring = around.looks_mm[0].expand(count, -1, 3), around.look_normals[0].expand(count, -1, 3)
    other = BatchedScene(around.geometry.bodies, around.geometry.radii_mm, engine="torch")
    views = [
        seen_from(engine, around.camera, eye, axis, *ring, lines, own=ENDOSCOPE)
        for engine in (around.geometry, other)
    ]
    assert 0 < views[1].hidden.sum() < views[1].visible.sum()
    for field in ("visible", "hidden", "fraction"):
        assert torch.equal(getattr(views[0], field), getattr(views[1], field)), field


def test_asinh_of_observations_keeps_its_digits():
    size = torch.logspace(-30, 17, 2001)
    x = torch.cat([size, -size, torch.tensor([0.0, math.inf, -math.inf, math.nan])])
    found, truth = asinh(x)[:-1], x.double()[:-1].asinh()
    known = truth.isfinite()
    assert torch.allclose(found[known].double(), truth[known], rtol=2e-7, atol=0.0)
    assert (found[~known].abs() > OBSERVATION_LIMIT).all()
    assert asinh(x)[-1].isnan()


def test_asinh_of_several_tensors_is_that_of_each():
    values = [size * torch.randn(37, 3) for size in (1.0, 30.0, 1e-3)]
    for value, found in zip(values, asinh_of(values), strict=True):
        assert torch.equal(found, asinh(value))
