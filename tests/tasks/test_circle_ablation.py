"""The two-arm task: the scripted expert cuts the ring; each part of the interlock holds."""

import math
from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
import torch
import trimesh

from surgisoft.errors import InputError
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.circle_ablation import CircleAblation, CircleAblationConfig
from surgisoft.tasks.world.arm import Randomisation
from surgisoft.tasks.world.pytree import rows
from surgisoft.tasks.world.world import WorldConfig
from tests.tasks.scripted import scripted_states


@pytest.fixture(scope="module")
def quick():
    """The same ring in a third of the time."""
    return CircleAblation(CircleAblationConfig(cut_s=15.0))


@pytest.fixture(scope="module")
def cut(quick):
    """States and outcomes of two scripted episodes to the end of both."""
    return scripted_states(quick)


def test_the_script_cuts_the_whole_ring(cut):
    _, outcomes = cut
    done = torch.stack([outcome.terminated for outcome in outcomes])
    ends = done.int().argmax(0)
    assert done.any(0).all(), "ends by itself, before the time is out"
    for i, end in enumerate(ends.tolist()):
        last = {name: value[i].item() for name, value in outcomes[end].measures.items()}
        assert last["success"] == 1.0
        assert last["largest_gap_mm"] == 0.0
        errors = torch.stack([o.measures["beam_error_mm"][i] for o in outcomes[: end + 1]])
        assert errors.nanmean() < 0.05
        assert min(o.measures["clearance_mm"][i] for o in outcomes[: end + 1]) > 1.0


def test_the_dose_lies_on_the_ring(quick, cut):
    """Distance of the cut samples from the ring's circle, on the dose map itself."""
    states, _ = cut
    ablation = quick.scene.ablation
    deep = states[-1].world.scene.dose.dose[0].numpy() >= ablation.cut_dose
    offset = np.abs(ablation.patch.offset_mm[deep])
    assert deep.sum() > 100
    assert np.quantile(offset, 0.99) < 0.6
    energy = states[-1].world.scene.dose.delivered_j
    fired = torch.stack([state.goal.fired for state in states[1:]]).sum(0)
    assert (energy <= 20.0 * 0.1 * fired + 1e-3).all()
    assert (energy >= 20.0 * 0.1 * (fired - 1)).all()


def test_the_beam_waits_until_the_ring_is_seen(cut):
    states, _ = cut
    for before, after in pairwise(states):
        seen = before.world.scene.view.fraction >= 0.95
        assert (after.goal.fired <= seen).all()
        assert torch.equal(after.goal.done, before.goal.done + after.goal.fired)
    assert not states[1].goal.fired.any(), "at rest the endoscope looks elsewhere"
    assert states[60].goal.fired.all()


@pytest.mark.parametrize("what", ["view", "aim", "blocked", "close", "contact", "nothing known"])
def test_each_part_of_the_interlock_stops_the_beam(quick, cut, what):
    """A state in which the beam fires, changed in one respect."""
    state = rows(cut[0][80], torch.tensor([0]))
    still = {name: torch.zeros(1, 3) for name in quick.agents}
    assert quick.advance(state, still).goal.fired.all()
    scene, goal = state.world.scene, state.goal
    if what == "view":
        low = replace(scene.view, fraction=torch.tensor([0.94]))
        scene = replace(scene, views={"endoscope": low})
    elif what == "blocked":
        scene = replace(scene, hits={"laser": replace(scene.hit, struck=torch.tensor([4]))})
    elif what in ("close", "contact", "nothing known"):
        least = {"close": quick.spec.limits.clearance_mm - 1e-3, "contact": 50.0}
        touch = torch.tensor([what == "contact"])
        close = torch.tensor([least.get(what, math.nan)])
        scene = replace(scene, clearance=SimpleNamespace(least_mm=close, collides=touch))
    else:
        goal = replace(goal, done=goal.done + 3)
    changed = replace(state, goal=goal, world=replace(state.world, scene=scene))
    after = quick.advance(changed, still)
    assert not after.goal.fired.any()
    assert torch.equal(after.goal.done, goal.done)


def test_the_target_runs_along_the_scenes_ring(quick):
    """Against a closed polygon walked in numpy, both ways round and over the seam."""
    state = Episodes(quick).seeded(3, 1)
    goal = state.goal
    path = quick.scene.path_mm.double().numpy()
    closed = np.vstack((path, path[:1]))
    for way in (1.0, -1.0):
        for walked in (0, 1, 37, 149):
            cut = replace(goal, done=torch.tensor([walked]), direction=torch.tensor([way]))
            share = (goal.start.item() + way * walked / 150) % 1.0
            expected = [np.interp(share * 360, np.arange(361), axis) for axis in closed.T]
            now = replace(state, goal=cut)
            np.testing.assert_allclose(quick.target_mm(now)[0], expected, atol=2e-3)


def test_the_miss_is_the_distance_from_the_axis(quick):
    aim = quick.pointing["laser"]
    points = Episodes(quick).seeded(0, 1).world.arms["laser"].points_mm
    tip, along = points[:, -1], aim.arm.backbone.tip_direction(points)
    side = torch.linalg.cross(along, torch.tensor([[0.0, 0.0, 1.0]]))
    side = side / side.norm()
    miss = aim.offset_mm(points, tip + 30.0 * along + 2.5 * side)
    torch.testing.assert_close(miss, 2.5 * side, rtol=0, atol=1e-4)
    behind = aim.offset_mm(points, tip - 3.0 * along + 4.0 * side)
    assert behind.norm().item() == pytest.approx(5.0, abs=1e-4)


def test_a_collision_ends_the_episode_and_is_no_success(quick):
    state = Episodes(quick).seeded(0, 2)
    scene = state.world.scene
    bodies = scene.clearance.bodies_mm.clone()
    bodies[1, 0, 0] = -0.5
    hit = replace(scene, clearance=replace(scene.clearance, bodies_mm=bodies))
    state = replace(state, world=replace(state.world, scene=hit))
    assert quick.ended(state).tolist() == [False, True]
    assert quick.measures(state)["success"].tolist() == [0.0, 0.0]
    whole = torch.tensor([True, True])
    assert quick.safety(state, whole)["success"].tolist() == [1.0, 0.0]
    for terms in quick.rewards(state).values():
        assert terms["contact"].tolist() == [0.0, -1.0]


def test_bad_config_is_one_line():
    with pytest.raises(InputError, match="cut_s is nan"):
        CircleAblationConfig(cut_s=math.nan)
    with pytest.raises(InputError, match=r"cut_s is 0\.01 s, expected at least a step, 0\.1 s"):
        CircleAblation(CircleAblationConfig(cut_s=0.01))
    with pytest.raises(InputError, match="there is no such scene"):
        CircleAblation(CircleAblationConfig(scene="no/such/scene"))


@pytest.fixture(scope="module")
def varied():
    """Three lesions up to 4 mm aside and 10 % larger or smaller."""
    vary = Randomisation(lesion_mm=4.0, lesion_size=0.1, lesions=3)
    return CircleAblation(CircleAblationConfig(cut_s=15.0, world=WorldConfig(randomisation=vary)))


def test_lesions_differ_in_place_and_size_and_lie_on_the_organ(varied):
    around = varied.scene
    own = np.array(varied.spec.lesion.centre_mm)
    centres, paths = around.centres_mm.numpy(), around.paths_mm.numpy()
    away = np.linalg.norm(centres - own, axis=1)
    assert (away < 4.0 + 0.5).all()
    assert np.ptp(away) > 0.3
    width = [np.linalg.norm(path[:180] - path[180:], axis=1).mean() for path in paths]
    assert all(17.9 < w < 22.5 for w in width)
    assert np.ptp(width) > 0.3
    organ = around.geometry.bodies[around.organ].world_mesh
    for path in paths:
        _, distance, _ = trimesh.proximity.closest_point(
            trimesh.Trimesh(organ.vertices_mm, organ.faces, process=False), path[::30]
        )
        assert distance.max() < 1e-3
    drawn = Episodes(varied).seeded(0, 300).world.scene.lesion
    assert torch.bincount(drawn, minlength=3).min() > 70


def test_each_episode_is_scored_on_its_ring(varied):
    """Scripted to the end; each environment's burnt samples lie on its own path and no other."""
    episodes, steps = Episodes(varied), 260
    state = episodes.seeded(1, 3)
    lesion = state.world.scene.lesion
    assert len(lesion.unique()) >= 2
    over, measures = torch.zeros(3, dtype=torch.bool), None
    with torch.inference_mode():
        for _ in range(steps):
            state, outcome = episodes.step(state, varied.script(state))
            over |= outcome.done
            if over.all():
                break
    measures = outcome.measures
    assert measures["success"].tolist() == [1.0] * 3
    assert torch.equal(state.world.scene.lesion, lesion)
    ablation, paths = varied.scene.ablation, varied.scene.paths_mm.numpy()
    points = ablation.patch.points_mm
    for i in range(3):
        burnt = points[state.world.scene.dose.dose[i].numpy() >= ablation.cut_dose]
        apart = [np.linalg.norm(burnt[:, None] - path[None], axis=2).min(1).max() for path in paths]
        assert int(np.argmin(apart)) == lesion[i]
        assert apart[lesion[i]] < 1.0


def test_a_reset_draws_another_lesion_and_fresh_tissue(varied):
    episodes = Episodes(varied)
    state = episodes.seeded(5, 40)
    before = state.world.scene.lesion
    mask = torch.arange(40) % 2 == 0
    state = episodes.reset(state, mask)
    after = state.world.scene.lesion
    assert torch.equal(after[~mask], before[~mask])
    assert not torch.equal(after[mask], before[mask])
    assert torch.equal(state.world.scene.dose.ring, after)


def test_impossible_lesions_are_one_line():
    vary = Randomisation(lesion_mm=400.0, lesions=3)
    with pytest.raises(InputError, match="up to 400 mm; expected at most"):
        CircleAblation(CircleAblationConfig(world=WorldConfig(randomisation=vary)))


def test_the_gate_follows_what_is_measured_and_never_the_true_beam(quick, cut):
    """Where cameras see the arm on its path the beam is released, however far it truly is away."""
    states, _ = cut
    on = next(state for state in states if quick.fires(state).all())
    laser = on.world.arms["laser"]
    tilted = laser.points_mm.clone()
    tilted[:, -2] += torch.tensor([1.0, 0.0, 0.0])  # the tip then points past the target

    def with_laser(part):
        world = replace(on.world, arms={**on.world.arms, "laser": part})
        return replace(on, world=world)

    arm = quick.world.arms["laser"]
    truly_off = with_laser(replace(arm.posed(laser, tilted), seen_mm=laser.points_mm))
    assert (quick.beam_error_mm(truly_off) > 2.0).all()
    assert quick.fires(truly_off).all()
    seen_off = with_laser(replace(laser, seen_mm=tilted))
    assert (quick.beam_error_mm(seen_off) < 0.5).all()
    assert not quick.fires(seen_off).any()


def test_the_pointing_error_is_measured_with_the_beam_off_too(quick, cut):
    """No gate truncates it; it leaves out the approach alone."""
    states, outcomes = cut
    measured = torch.stack([o.measures["pointing_error_mm"] for o in outcomes])
    true = torch.stack([quick.beam_error_mm(state) for state in states[1:]])
    begins = round(quick.config.approach_s / quick.dt_s)
    assert measured[: begins - 1].isnan().all()
    torch.testing.assert_close(measured[begins + 1 :], true[begins + 1 :])


def with_scene(state, **parts):
    """The state with fields of its scene replaced."""
    scene = replace(state.world.scene, **parts)
    return replace(state, world=replace(state.world, scene=scene))


def test_each_reward_term_rises_with_what_it_rewards(quick, cut):
    """The formulas of `LaserWeights` and `EndoscopeWeights`, term by term."""
    state = cut[0][5]
    on = torch.tensor([True, False])
    reward = quick.rewards(replace(state, goal=replace(state.goal, fired=on)))
    for agent in quick.agents:
        assert reward[agent]["cut"].tolist() == [1.0, 0.0]
    error = quick.beam_error_mm(state)
    torch.testing.assert_close(reward["laser"]["far"], 10.0 / (10.0 + error))
    torch.testing.assert_close(reward["laser"]["aim"], torch.exp(-error))
    torch.testing.assert_close(reward["laser"]["fine"], torch.exp(-error / 0.1))
    view = replace(
        state.world.scene.view,
        axis_error_mm=torch.tensor([0.0, 10.0]),
        fraction=torch.tensor([0.25, 1.0]),
    )
    looks = quick.rewards(with_scene(state, views={"endoscope": view}))["endoscope"]
    assert looks["look"].tolist() == [1.0, 0.5]
    assert looks["view"].tolist() == [0.25, 1.0]


def test_contact_costs_from_the_scenes_clearance_on(quick, cut):
    state, limit = cut[0][0], quick.spec.limits.clearance_mm
    clearance = state.world.scene.clearance
    near = torch.full_like(clearance.bodies_mm, limit - 0.01)
    near[1] = limit + 0.01
    far = torch.full_like(clearance.arms_mm, 50.0)
    close = with_scene(state, clearance=replace(clearance, bodies_mm=near, arms_mm=far))
    for terms in quick.rewards(close).values():
        assert terms["contact"].tolist() == [-1.0, 0.0]


def test_an_arm_in_front_of_the_camera_or_the_beam_hides_what_is_behind(quick, cut):
    """The other arm lies straight across the line from the tool's tip to the lesion's centre."""
    state = cut[0][40]
    world, engine = state.world, quick.scene
    assert (world.scene.view.fraction == 1.0).all()
    assert world.scene.hit.on_organ.all()
    for tool, other in (("endoscope", "laser"), ("laser", "endoscope")):
        tip, target = world.arms[tool].tip_mm, quick.watched_mm(state)
        if tool == "laser":
            target = world.scene.hit.point_mm
        towards = torch.nn.functional.normalize(target - tip, dim=1)
        across = torch.linalg.cross(towards, torch.tensor([[0.0, 0.0, 1.0]]).expand_as(towards))
        across = torch.nn.functional.normalize(across, dim=1)[:, None]
        along = torch.linspace(-60.0, 60.0, world.arms[other].line_mm.shape[1])[None, :, None]
        line = 0.5 * (tip + target)[:, None] + along * across
        parts = {**world.arms, other: replace(world.arms[other], line_mm=line)}
        seen = engine.step(world.scene, parts, 0.0, quick.dt_s)
        if tool == "endoscope":
            assert (seen.view.fraction < 0.7).all()
        else:
            assert not seen.hit.on_organ.any()
