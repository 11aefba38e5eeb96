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
from surgisoft.tasks.trajectories.waypoints import (
    WaypointSequence,
    point_at,
    progress,
    route_mm,
)
from surgisoft.tasks.world.arm import ModelArm
from surgisoft.tasks.world.plate import Routes


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


def test_a_target_counts_once_without_contact_and_as_measured_where_it_is(task, monkeypatch):
    """The tip on its target in every episode, but for the last; the world stands still."""
    monkeypatch.setattr(task.world, "step", lambda world, actions: world)
    state = Episodes(task).seeded(0, 4)
    arm, clearance = state.world.arms["arm"], state.world.scene.clearance
    state = replace(state, goal=replace(state.goal, reached=torch.tensor([1, 0, 3, 0])))
    points, low = arm.points_mm.clone(), clearance.bodies_mm.clone()
    points[:, -1] = task.route_mm(state)[:, -1] + torch.tensor([0.9, 0.0, 0.0])
    points[3, -1, 0] += 0.2
    low[1] = -0.1
    scene = replace(state.world.scene, clearance=replace(clearance, bodies_mm=low))
    arms = {"arm": replace(arm, points_mm=points)}
    there = replace(state, world=replace(state.world, arms=arms, scene=scene))
    none = {"arm": torch.zeros(4, 3)}
    nan = float("nan")
    for measured, reached in (
        (None, [2, 0, 3, 0]),
        ([nan, nan, nan, nan], [2, 0, 3, 0]),
        ([0.0, 1.0, 1.0, 1.0], [1, 0, 3, 1]),
    ):
        given = None if measured is None else torch.tensor(measured)
        after = task.advance(there, none, given)
        assert after.goal.reached.tolist() == reached
        assert (
            task.visited(there, after).tolist()
            == (after.goal.reached - state.goal.reached).tolist()
        )
        assert torch.equal(task.visited(None, after), after.goal.reached)


def test_the_rewards_of_the_way_by_hand(task):
    """The tip on the first route, 10 mm and 1 mm of arc length before its end."""
    state = Episodes(task).seeded(0, 2)
    route, arm = task.route_mm(state), state.world.arms["arm"]
    length = progress(route, route[:, -1]).along_mm
    points = arm.points_mm.clone()
    points[:, -1] = point_at(route, length - torch.tensor([10.0, 1.0]))
    there = replace(state, world=replace(state.world, arms={"arm": replace(arm, points_mm=points)}))
    terms = task.rewards(there)["arm"]
    for name, scale in (("way", 20.0), ("near", 1.0)):
        expected = [math.exp(-10.0 / scale), math.exp(-1.0 / scale)]
        np.testing.assert_allclose(terms[name], expected, rtol=0.02)
    np.testing.assert_allclose(task.measures(there)["left_mm"], [10.0, 1.0], atol=0.02)
    low = replace(
        there.world.scene.clearance,
        bodies_mm=torch.full_like(there.world.scene.clearance.bodies_mm, 0.4),
    )
    near = replace(
        there, world=replace(there.world, scene=replace(there.world.scene, clearance=low))
    )
    assert task.rewards(near)["arm"]["contact"].tolist() == [-1.0, -1.0], "within limit_mm"
    assert task.measures(near)["collided"].tolist() == [0.0, 0.0]


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
    fewer = replace(hit, goal=replace(goal, reached=torch.tensor([2, 2])))
    assert task.measures(fewer)["success"].tolist() == [0.0, 0.0]
    np.testing.assert_allclose(task.measures(fewer)["visited"], 2.0 / 3.0)
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


def test_of_a_way_there_and_back_the_later_place_counts():
    line = torch.tensor([[[0.0, 0, 0], [10, 0, 0], [0, 0, 0]]])
    found = progress(line, torch.tensor([[4.0, 0.5, 0.0]]))
    np.testing.assert_allclose(found.along_mm, [16.0], atol=1e-5)
    np.testing.assert_allclose(found.remaining_mm, [4.5], atol=1e-5)


def test_a_route_leads_back_to_the_centre_and_on_to_the_next_target_by_hand():
    """Three routes from rest at 0 to 10, 20 and 30 mm; two of them are visited."""
    along = torch.tensor([[0.0, 10.0], [0.0, 20.0], [0.0, 30.0]])
    routes = Routes(along[..., None] * torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0, 1, 2, 3]))
    order = torch.tensor([[1, 2]]).expand(3, 2)
    found = route_mm(routes, WaypointSequence(order, torch.tensor([0, 1, 2])))
    assert found[..., 0].tolist() == [[0.0, 0.0, 20.0], [20.0, 0.0, 30.0], [20.0, 0.0, 30.0]]


def test_observations_by_hand(task):
    """Measured key points 0.5 mm off the true ones; 4 mm of clearance, one of three visits."""
    state = Episodes(task).seeded(0, 1)
    arm, scene = state.world.arms["arm"], state.world.scene
    seen = arm.points_mm + torch.tensor([0.5, 0.0, 0.0])
    low = torch.full_like(scene.clearance.bodies_mm, 4.0)
    scene = replace(scene, clearance=replace(scene.clearance, bodies_mm=low))
    world = replace(state.world, arms={"arm": replace(arm, seen_mm=seen)}, scene=scene)
    goal = replace(state.goal, reached=torch.tensor([1]))
    state = replace(state, world=replace(world, steps=torch.tensor([60])), goal=goal)
    found = {block.name: value[0].tolist() for block, value in task.blocks(state)["arm"].items()}
    tip, route = seen[0, -1], task.route_mm(state)
    assert found["target"] == pytest.approx((route[0, -1] - tip).asinh().tolist())
    # A stride is what the pumps' step moves the tip by at most: 4 mm in three steps of 1 kPa.
    stride = 4.0 / 3.0 * task.arm.pneumatics.step_kPa
    onward = point_at(route, progress(route, tip[None]).along_mm + stride)[0]
    assert found["onward"] == pytest.approx((onward - tip).asinh().tolist())
    assert found["clearance"] == pytest.approx([0.4])
    assert found["visits"] == pytest.approx([1.0 / 3.0])
    assert found["time"] == pytest.approx([60.0 / 300.0])


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
