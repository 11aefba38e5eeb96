"""Reaching past the plate: the script gets there, FCL agrees, and the straight way does not."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from surgisoft.errors import InputError
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.collision import CollisionChecker
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.checkpoint import save_model
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import ConstantCurvature
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.inverse_kinematics import action_towards
from surgisoft.tasks.keyhole import Keyhole, KeyholeConfig
from surgisoft.tasks.trajectories.waypoints import point_at, progress
from surgisoft.tasks.world.arm import ModelArm


@pytest.fixture(scope="module")
def task():
    return Keyhole()


def walked(task, script, count, steps):
    """States and outcomes until every environment has ended or succeeded."""
    episodes = Episodes(task)
    states, outcomes = [episodes.seeded(2, count)], []
    over = torch.zeros(count, dtype=torch.bool)
    with torch.inference_mode():
        while not over.all() and len(outcomes) < steps:
            state, outcome = episodes.step(states[-1], script(states[-1]))
            states.append(state)
            outcomes.append(outcome)
            over |= outcome.done | (outcome.measures["success"] == 1.0)
    return states, outcomes


@pytest.fixture(scope="module")
def done(task):
    return walked(task, task.script, 4, 150)


def test_the_script_visits_every_slot_without_contact(done):
    _, outcomes = done
    assert outcomes[-1].measures["success"].tolist() == [1.0] * 4
    least = torch.stack([outcome.measures["clearance_mm"] for outcome in outcomes]).amin()
    assert least > 0.5
    assert not torch.stack([outcome.terminated for outcome in outcomes]).any()


def test_fcl_agrees(task, done):
    """The exact checker on every fifth body of the episodes: no contact, the same clearances."""
    checker = CollisionChecker(task.world.scene.geometry.bodies)
    for state in done[0][::5]:
        for i, line in enumerate(state.world.arms["arm"].line_mm.numpy()):
            shape = {"arm": ArmShape(line, 7.5)}
            assert not checker.collisions(shape)
            said = state.world.scene.clearance.least_mm[i].item()
            assert checker.clearance(shape).least_mm == pytest.approx(said, abs=0.1)


def test_the_straight_line_to_the_next_slot_hits_the_plate(task):
    """The same inverse kinematics without the route: the plate is in the way."""

    def straight(state):
        part, target = state.world.arms["arm"], task.route_mm(state)[:, -1]
        tip = part.tip_mm
        step = (target - tip) * (4.0 / (target - tip).norm(dim=1, keepdim=True).clamp(min=4.0))
        action = action_towards(task.arm, part, tip + step, lambda p, t: p[:, -1] - t, task.dt_s)
        return {"arm": action}

    _, outcomes = walked(task, straight, 6, 150)
    hits = torch.stack([outcome.measures["collided"] for outcome in outcomes]).amax(0)
    assert hits.sum() >= 4


def test_targets_lie_deep_in_slots_that_differ(task):
    goal = Episodes(task).seeded(5, 200).goal
    tips = task.routes.points_mm[:, -1]
    home = task.routes.points_mm[0, 0]
    aside = (tips - home)[:, :2]
    assert (aside.norm(dim=1) >= 25.0 - 1e-3).all()
    angle = torch.atan2(aside[:, 1], aside[:, 0])
    slot = (angle / (2.0 * math.pi / 3.0)).round().remainder(3).long()
    visited = slot[goal.order]
    assert (visited[:, 1:] != visited[:, :-1]).all()
    assert torch.bincount(visited[:, 0], minlength=3).min() > 40
    assert tips[:, 2].min() > 50.0, "beyond the plate"


def test_a_target_is_counted_when_the_tip_is_near(task):
    state = Episodes(task).seeded(0, 2)
    arm, target = state.world.arms["arm"], task.route_mm(state)[:, -1]
    points = arm.points_mm.clone()
    points[:, -1] = target + torch.tensor([[0.0, 0.3, 0.4], [0.0, 3.0, 4.0]])
    near = replace(state, world=replace(state.world, arms={"arm": replace(arm, points_mm=points)}))
    torch.testing.assert_close(task.error_mm(near), torch.tensor([0.5, 5.0]), rtol=0, atol=1e-4)
    terms = task.rewards(near)["arm"]
    assert terms["visits"].tolist() == [0.0, 0.0]
    on = replace(near, goal=replace(near.goal, reached=torch.tensor([2, 0])))
    assert task.rewards(on)["arm"]["visits"].tolist() == [6.0, 0.0]


def test_contact_ends_the_episode_and_is_no_success(task):
    state = Episodes(task).seeded(0, 2)
    clearance = state.world.scene.clearance
    low = clearance.bodies_mm.clone()
    low[0] = -0.1
    scene = replace(state.world.scene, clearance=replace(clearance, bodies_mm=low))
    goal = replace(state.goal, reached=torch.tensor([3, 3]))
    hit = replace(state, goal=goal, world=replace(state.world, scene=scene))
    assert task.ended(hit).tolist() == [True, False]
    assert task.measures(hit)["success"].tolist() == [0.0, 1.0]
    assert task.rewards(hit)["arm"]["contact"].tolist() == [-1.0, 0.0]


def test_progress_along_a_bend_by_hand():
    """A polyline of 10 mm along x, then 5 mm along y; its first corner stands twice."""
    line = torch.tensor([[[0.0, 0, 0], [0, 0, 0], [10, 0, 0], [10, 5, 0]]]).expand(4, -1, -1)
    points = torch.tensor([[0.0, 0, 0], [4, -2, 0], [12, 3, 0], [10, 9, 0]])
    found = progress(line, points)
    np.testing.assert_allclose(found.along_mm, [0.0, 4.0, 13.0, 15.0], atol=1e-5)
    np.testing.assert_allclose(found.remaining_mm, [15.0, 13.0, 4.0, 4.0], atol=1e-5)
    there = point_at(line, torch.tensor([0.0, 4.0, 13.0, 99.0]))
    expected = [[0, 0, 0], [4, 0, 0], [10, 3, 0], [10, 5, 0]]
    np.testing.assert_allclose(there, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("config", "says"),
    [
        ({"visits": 0}, "visits is 0"),
        ({"deep_mm": 60.0}, "no shape reaches 60 mm into slot"),
        ({"height_mm": 70.0}, "height_mm is 70.0"),
    ],
)
def test_what_cannot_be_is_one_line(config, says):
    with pytest.raises(InputError, match=says):
        Keyhole(KeyholeConfig(**config))


def test_an_arm_with_six_chambers_is_searched_for_targets_on_a_coarser_grid(tmp_path, monkeypatch):
    """Two segments of three chambers; 14 pressures of each chamber would be 7.5 million shapes."""
    low, high, angle = torch.zeros(6), torch.full((6,), 60.0), torch.arange(3) * 2.0 * math.pi / 3.0
    rest = torch.tensor([[0.0, 0.0, 17.5 * k] for k in range(5)])
    network = ConstantCurvature(low, high, key_points=5)
    network.set_rest(rest)
    push = 0.3 * torch.stack((angle.cos(), angle.sin()))
    network.table.data[0, :2, :3], network.table.data[1, :2, 3:6] = push, push
    spec = ArmSpec(6, 5, tuple(low.tolist()), tuple(high.tolist()), length_mm=70.0)
    save_model(ArmModel(spec, network, rest_mm=rest).requires_grad_(False), tmp_path / "arm")
    asked, settled = [], ModelArm.settled

    def counted(arm, pressure):
        asked.append(len(pressure))
        return settled(arm, pressure)

    monkeypatch.setattr(ModelArm, "settled", counted)
    found = Keyhole(KeyholeConfig(arm=str(tmp_path / "arm")))
    assert 5**6 in asked
    assert max(asked) <= 9 * 5**6
    slots = found.routes.first.diff()
    assert (slots > 0).all()
