"""Two arms through the ports of a wall: the feed, the scripted expert, the rims and success."""

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.scene.check import check_scene
from surgisoft.scene.folder import open_scene
from surgisoft.scene.spec import PHANTOM
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.keyhole_ablation import PORTS, KeyholeAblation, KeyholeAblationConfig
from surgisoft.tasks.world.reach import reaches_of
from surgisoft.tasks.world.world import Feed
from tests.tasks.scripted import scripted_states


@pytest.fixture(scope="module")
def quick():
    """The same ports and ring in a third of the time."""
    return KeyholeAblation(KeyholeAblationConfig(feed=Feed(70.0, 20.0, wait_s=1.0), cut_s=15.0))


@pytest.fixture(scope="module")
def cut(quick):
    """States and outcomes of two scripted episodes to the end of both."""
    return scripted_states(quick)


def with_clearance(state, bodies_mm):
    clearance = replace(state.world.scene.clearance, bodies_mm=bodies_mm)
    scene = replace(state.world.scene, clearance=clearance)
    return replace(state, world=replace(state.world, scene=scene))


def test_the_script_enters_looks_and_cuts(quick, cut):
    states, outcomes = cut
    for i in range(2):
        end = next(k for k, outcome in enumerate(outcomes) if outcome.terminated[i])
        last = outcomes[end].measures
        assert last["success"][i] == 1.0
        assert last["at_rim_s"][i] == 0.0
        assert min(o.measures["rim_mm"][i] for o in outcomes[: end + 1]) > quick.config.rim_mm
    fired = torch.stack([state.goal.fired for state in states])
    assert not fired[:46].any(), "no beam before the arms are in"


def insertion(scene):
    """The line of `scene check` on the way in."""
    findings = check_scene(scene, reaches_of(scene)).findings
    return next(finding for finding in findings if finding.what.startswith("insertion"))


def test_the_check_knows_the_distance_that_the_script_keeps_on_the_way_in(quick, cut):
    """At the mounts the bodies are 3 mm from the rims, on the way in 2 mm."""
    states, outcomes = cut
    entering = [i for i, state in enumerate(states[1:]) if (quick.out_mm(state) > 0.0).all()]
    least = min(float(outcomes[i].measures["rim_mm"].min()) for i in entering)
    found = insertion(open_scene(PORTS))
    assert found.good
    told = float(found.value.removeprefix("none (closest ").removesuffix(" mm)"))
    assert told == pytest.approx(least, abs=0.1)


@pytest.mark.parametrize(("wider_mm", "told"), [(1.25, "too near, 0.7"), (2.5, "touches wall")])
def test_the_check_refuses_ports_that_are_too_narrow_for_the_way_in(wider_mm, told):
    """The script keeps 2.03 mm: arms with a larger radius come so much nearer."""
    scene = open_scene(PORTS)
    mounts = tuple(
        replace(mount, diameter_mm=mount.diameter_mm + 2.0 * wider_mm)
        for mount in scene.spec.mounts
    )
    found = insertion(replace(scene, spec=replace(scene.spec, mounts=mounts)))
    assert not found.good
    assert told in found.value


def test_no_beam_while_the_arms_are_fed_in(quick, cut):
    """A state with the beam on, but for the carriage of one episode 0.1 mm behind its place."""
    state = next(state for state in cut[0] if quick.fires(state).all())
    out = torch.tensor([0.1, 0.0])
    behind = replace(state, world=replace(state.world, out_mm=out))
    assert quick.released(behind).all()
    assert quick.fires(behind).tolist() == [False, True]
    before = state.world.scene.dose.delivered_j.clone()
    after = quick.advance(behind, {name: torch.zeros(2, 3) for name in quick.agents})
    assert after.goal.fired.tolist() == [False, True]
    assert ((after.world.scene.dose.delivered_j - before) > 0.0).tolist() == [False, True]


def test_the_feed_brings_the_bases_to_their_mounts_along_the_ports(quick, cut):
    """By hand: 70 mm behind the mounts, 10 steps of waiting, 2 mm in a step; tips begin outside."""
    states, _ = cut
    lower = min(p[2] for p in quick.scene.geometry.bodies[-1].mesh.vertices_mm)
    for name, arm in quick.world.arms.items():
        axis = arm.pose[:3, 2]
        for step in (0, 9, 10, 11, 30, 45, 60):
            part = states[step].world.arms[name]
            out = min(70.0, max(0.0, 70.0 - 2.0 * (step - 10)))
            expected = arm.pose[:3, 3] - out * axis
            torch.testing.assert_close(
                part.mount[:, :3, 3], expected.expand(2, 3), rtol=0, atol=1e-3
            )
            torch.testing.assert_close(
                states[step].world.out_mm, torch.full((2,), out), rtol=0, atol=1e-3
            )
            # the body hangs on its base: the first key point is the base
            torch.testing.assert_close(part.points_mm[:, 0], part.mount[:, :3, 3], rtol=0, atol=0.5)
        assert (states[0].world.arms[name].tip_mm[:, 2] > lower).all(), "outside at the beginning"
        assert (states[50].world.arms[name].tip_mm[:, 2] < lower).all(), "inside after the feed"


def test_reset_withdraws_the_arms_again(quick, cut):
    state = cut[0][50]
    again = Episodes(quick).reset(state, torch.tensor([True, False]))
    assert again.world.out_mm.tolist() == [70.0, 0.0]
    assert again.goal.at_rim.tolist() == [0, 0]


def test_time_at_the_rim_is_counted_and_decides(quick, cut):
    """The endoscope 0.5 mm from the wall: penalised alone, counted, and too long is no success."""
    state = cut[0][-1]
    bodies = state.world.scene.clearance.bodies_mm.clone()
    wall = [body.name for body in quick.spec.bodies].index("wall")
    assert bodies[0, :, wall].min() > 1.0
    bodies[0, 1, wall] = 0.5
    near = with_clearance(state, bodies)
    reward, usual = quick.rewards(near), quick.rewards(state)
    weight = quick.weights["endoscope"].rim
    assert weight < 0.0
    assert reward["endoscope"]["rim"].tolist() == [weight, 0.0]
    assert reward["laser"]["rim"].tolist() == [0.0, 0.0]
    assert usual["endoscope"]["rim"].tolist() == [0.0, 0.0]
    assert quick.measures(near)["rim_mm"][0].item() == pytest.approx(0.5)
    assert quick.measures(state)["success"][0] == 1.0
    for steps, good in ((20, 1.0), (21, 0.0)):  # rim_s is 2 s, a step 0.1 s
        held = replace(state, goal=replace(state.goal, at_rim=torch.tensor([steps, 0])))
        assert quick.measures(held)["success"][0] == good
    still = {name: torch.zeros(2, 3) for name in quick.agents}
    wide = KeyholeAblation(replace(quick.config, rim_mm=5.0))
    after = wide.advance(state, still)
    assert (after.goal.at_rim - state.goal.at_rim).tolist() == [1, 1]
    # One body is enough: the limit lies between the distances of the two from the wall.
    both = torch.stack([*quick.rims_mm(quick.advance(state, still)).values()])
    assert (both.amin(0) < both.amax(0) - 0.01).all()
    between = replace(quick.config, rim_mm=both.mean(0)[0].item())
    after = KeyholeAblation(between).advance(state, still)
    assert (after.goal.at_rim - state.goal.at_rim)[0] == 1


def test_the_place_in_the_port_is_rewarded_while_the_arms_enter(quick, cut):
    """A tip 3 mm across and 60 mm along its port's axis; 1 for both once the arms are in."""
    state, arms = cut[0][-1], {}
    for name, part in cut[0][-1].world.arms.items():
        pose, points = quick.world.arms[name].pose, part.points_mm.clone()
        across = 3.0 * pose[:3, 0] if name == "laser" else 0.0
        points[:, -1] = pose[:3, 3] + 60.0 * pose[:3, 2] + across
        arms[name] = replace(part, points_mm=points, seen_mm=points + 0.5 * pose[:3, 1])
    out = torch.tensor([40.0, 0.0])
    there = replace(state, world=replace(state.world, arms=arms, out_mm=out))
    terms, weights = quick.rewards(there), quick.weights
    for name, centred in (("laser", np.exp(-3.0 / quick.config.centred_mm)), ("endoscope", 1.0)):
        found = terms[name]["centred"] / weights[name].centred
        np.testing.assert_allclose(found, [centred, 1.0], rtol=1e-4)
        seen = {block.name: value for block, value in quick.blocks(there)[name].items()}
        np.testing.assert_allclose(seen["out"][:, 0], [0.8, 0.0], atol=1e-6)
        off = seen["centred"].sinh().norm(dim=1)
        np.testing.assert_allclose(off, np.hypot(3.0 * (name == "laser"), 0.5), rtol=1e-3)


def test_a_bent_arm_meets_the_rim_on_its_way_in(quick):
    """Full pressure in one chamber while the feed runs: the tip leaves the port's axis, contact."""
    episodes = Episodes(quick)
    state = episodes.seeded(1, 1)
    bend = {name: torch.tensor([[3.0, 0.0, 0.0]]) for name in quick.agents}
    with torch.inference_mode():
        for _ in range(50):
            state, outcome = episodes.step(state, bend)
            if outcome.terminated[0]:
                break
    assert outcome.terminated[0]
    assert outcome.measures["collided"][0] == 1.0
    assert outcome.measures["rim_mm"][0] < 0.0
    assert state.world.out_mm[0] > 0.0
    off = {a: quick.off_axis_mm(a, state.world.arms[a].points_mm).norm() for a in quick.agents}
    assert max(off.values()) > 4.0, "the port leaves 4.5 mm on each side"


def test_the_manuals_wall_makes_a_scene_of_the_task(tmp_path):
    """Its block, appended to the phantom's scene, whose folder has the mesh."""
    manual = (Path(__file__).resolve().parents[2] / "docs" / "scenes.md").read_text()
    section = manual.partition("## Walls and ports")[2].partition("## From Python")[0]
    (block,) = re.findall(r"```toml\n(.*?)```", section, re.S)
    shutil.copytree(PHANTOM, tmp_path / "scene")
    file = tmp_path / "scene" / "scene.toml"
    file.write_text(file.read_text().partition("[[contours]]")[0] + block)
    assert insertion(open_scene(file.parent)).good
    task = KeyholeAblation(KeyholeAblationConfig(scene=file.parent))
    state = Episodes(task).seeded(0, 1)
    assert task.out_mm(state).tolist() == [80.0]
    assert min(float(rim) for rim in task.rims_mm(state).values()) > 5.0


def test_wrong_scenes_and_numbers_are_one_line():
    with pytest.raises(
        InputError, match=r"liver, gallbladder, tray, expected the wall 'wall'.*add \[\[bodies"
    ):
        KeyholeAblation(KeyholeAblationConfig(scene=PHANTOM))
    with pytest.raises(InputError, match="rim_mm is 0"):
        KeyholeAblationConfig(rim_mm=0.0)
    with pytest.raises(InputError, match="speed_mm_s is nan"):
        Feed(speed_mm_s=np.nan)
