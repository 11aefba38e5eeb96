"""The compiled world against the reference in tensor operations, over whole episodes."""

import copy

import pytest
import torch

from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.camera import seen_from
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.registry import TASKS, make_task
from surgisoft.tasks.world.scene import ENDOSCOPE, LASER, SceneEngine

AGREE_MM = 1e-4
"""Largest difference of a place (mm): rounding of float32 at 100 mm, some ten steps of it."""
EPISODES = 2
LOOK_EVERY = 100
"""Steps between two comparisons of the scenes."""


def reference(task):
    """The same task with arms stepped by differentiable operations."""
    task, arms = copy.copy(task), task.world.arms
    task.world = task.world.with_arms({name: arm.reference() for name, arm in arms.items()})
    return task


def rolled_out(task, every):
    """Steps a random policy through whole episodes; state and observations after each step."""
    episodes = Episodes(task)
    state = episodes.seeded(4, EPISODES)
    random = torch.Generator().manual_seed(1)
    for step in range(task.steps):
        actions = {
            name: torch.randn(EPISODES, task.world.arms[name].chambers, generator=random)
            for name in task.agents
        }
        state, _ = episodes.step(state, actions)
        yield state, episodes.observe(state) if step % every == 0 else {}


@pytest.mark.parametrize("name", TASKS)
def test_compiled_arms_agree_with_the_reference_over_whole_episodes(name):
    task = make_task(name)
    plain = reference(task)
    around, other = task.world.scene, None
    if around is not None:
        radii = around.geometry.radii_mm
        other = BatchedScene(around.geometry.bodies, radii, engine="torch")
    with torch.inference_mode():
        pairs = zip(rolled_out(task, LOOK_EVERY), rolled_out(plain, LOOK_EVERY), strict=True)
        for step, ((state, seen), (expected, wanted)) in enumerate(pairs):
            for arm, part in state.world.arms.items():
                true = expected.world.arms[arm]
                for field in ("points_mm", "line_mm", "tip_direction", "seen_mm", "pressure"):
                    off = (getattr(part, field) - getattr(true, field)).abs().max()
                    assert off < AGREE_MM, (arm, field, step)
                assert torch.equal(part.arm.direction, true.arm.direction)
            for agent, value in wanted.items():
                assert torch.allclose(seen[agent], value, atol=2e-3), (agent, step)
            if other is not None and step % LOOK_EVERY == 0:
                assert_scenes_agree(around, other, state.world)


def assert_scenes_agree(around, other, world):
    """The compiled scene's state is what the engine in tensor operations finds."""
    lines = {name: part.line_mm for name, part in world.arms.items()}
    scene, found = world.scene, other.clearance(lines)
    for field in ("bodies_mm", "arms_mm", "self_mm"):
        off = (getattr(scene.clearance, field) - getattr(found, field)).abs()
        assert off.numel() == 0 or off.max() < AGREE_MM, field
    if not isinstance(around, SceneEngine):
        return
    beam, eye = world.arms[LASER], world.arms[ENDOSCOPE]
    hit = other.cast(beam.tip_mm, beam.tip_direction, around.beam_mm, lines, own=LASER)
    assert torch.equal(hit.struck, scene.hit.struck)
    assert (hit.point_mm - scene.hit.point_mm).abs().max() < AGREE_MM
    assert (hit.normal - scene.hit.normal).abs().max() < AGREE_MM
    ring = (around.rings_mm[scene.lesion], around.ring_normals[scene.lesion])
    at = (eye.tip_mm, eye.tip_direction)
    view = seen_from(other, around.camera, *at, *ring, lines, own=ENDOSCOPE)
    assert torch.equal(view.visible, scene.view.visible)
    assert torch.equal(view.hidden, scene.view.hidden)
    assert (view.axis_error_mm - scene.view.axis_error_mm).abs().max() < AGREE_MM


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
    ring = around.rings_mm[0].expand(count, -1, 3), around.ring_normals[0].expand(count, -1, 3)
    other = BatchedScene(around.geometry.bodies, around.geometry.radii_mm, engine="torch")
    views = [
        seen_from(engine, around.camera, eye, axis, *ring, lines, own=ENDOSCOPE)
        for engine in (around.geometry, other)
    ]
    assert 0 < views[1].hidden.sum() < views[1].visible.sum()
    for field in ("visible", "hidden", "fraction"):
        assert torch.equal(getattr(views[0], field), getattr(views[1], field)), field
