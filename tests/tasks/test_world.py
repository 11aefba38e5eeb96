"""The batched core: numbers by hand, a batch of N against N of one, resets, what goes wrong."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from surgisoft.agents.controller import ControllerGraph
from surgisoft.agents.on_rig import on_rig
from surgisoft.agents.policies import Scripted
from surgisoft.agents.rollout import rollout
from surgisoft.errors import InputError
from surgisoft.scene import frames
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.collision import CollisionChecker
from surgisoft.scene.folder import open_scene
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.checkpoint import default_arm, save_model
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import ConstantCurvature
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.path_following import FollowConfig
from surgisoft.tasks.registry import config_of, make_task, with_fields
from surgisoft.tasks.track import TrackConfig
from surgisoft.tasks.world.arm import Pneumatics, Randomisation
from surgisoft.tasks.world.observer import AlphaBetaFilter
from surgisoft.tasks.world.pytree import rows, tree_map
from surgisoft.tasks.world.random_streams import streams
from surgisoft.tasks.world.scene import SceneEngineConfig
from surgisoft.tasks.world.world import Mounted, World, WorldConfig, scene_world, single_arm_world
from tests.scene.engines import ON_ACCELERATORS

STILL = Randomisation(history=0, start_kPa=0.0)
LIVELY = Randomisation(
    history=2, start_kPa=5.0, mount_mm=1.0, mount_rad=0.02, gain=0.05, noise_mm=0.1, noise_kPa=0.1,
    delay=2,
)  # fmt: skip


@pytest.fixture(scope="module")
def phantom():
    return open_scene(Path(__file__).resolve().parents[2] / "scenes" / "phantom_liver")


@pytest.fixture(scope="module")
def theatre(phantom):
    return scene_world(phantom, WorldConfig(randomisation=LIVELY))


def actions_of(world, count, steps, seed=0):
    """Random actions, each step a mapping of (count, m) kPa; some beyond the pumps' limits."""
    rng = torch.Generator().manual_seed(seed)
    size = {name: (count, arm.chambers) for name, arm in world.arms.items()}
    return [
        {name: 3.0 * torch.randn(shape, generator=rng) for name, shape in size.items()}
        for _ in range(steps)
    ]


def leaves(tree):
    found = []
    tree_map(lambda value: found.append(value) or value, tree)
    return found


def assert_close(one, other):
    for a, b in zip(leaves(one), leaves(other), strict=True):
        assert a.dtype == b.dtype
        torch.testing.assert_close(a, b, rtol=1e-4, atol=2e-4, equal_nan=True)


@pytest.mark.parametrize("compiled", [True, False])
def test_pressure_by_hand(compiled):
    """Commands +3 (clipped from 5) and -1 kPa from 20 kPa; tau = 0.2 s, dt = 0.1 s."""
    world = single_arm_world(WorldConfig(randomisation=STILL), start_kPa=(20.0, 20.0, 20.0))
    if not compiled:
        world.arms["arm"] = world.arms["arm"].reference()
    state = world.start(streams(0, 1))
    state = world.step(state, {"arm": torch.tensor([[5.0, -1.0, 0.0]])})
    share = 1.0 - math.exp(-0.5)
    arm = state.arms["arm"]
    assert arm.command[0].tolist() == [23.0, 19.0, 20.0]
    expected = [20.0 + 3.0 * share, 20.0 - share, 20.0]
    assert arm.pressure[0].tolist() == pytest.approx(expected, abs=1e-5)
    state = world.step(state, {"arm": torch.zeros(1, 3)})
    share = 1.0 - math.exp(-1.0)
    expected = [20.0 + 3.0 * share, 20.0 - share, 20.0]
    assert state.arms["arm"].pressure[0].tolist() == pytest.approx(expected, abs=1e-5)
    assert state.steps.tolist() == [2]


@pytest.mark.parametrize("compiled", [True, False])
def test_pressure_stays_within_the_arms_limits(compiled):
    world = single_arm_world(WorldConfig(randomisation=STILL))
    if not compiled:
        world.arms["arm"] = world.arms["arm"].reference()
    state = world.start(streams(0, 2))
    for _ in range(40):
        state = world.step(state, {"arm": torch.tensor([[3.0] * 3, [-3.0] * 3])})
    spec = default_arm().spec
    assert state.arms["arm"].command[0].tolist() == pytest.approx(spec.high)
    assert state.arms["arm"].command[1].tolist() == pytest.approx(spec.low)
    assert state.arms["arm"].pressure[0].tolist() == pytest.approx(spec.high, abs=1e-3)


def test_the_body_is_the_models_body():
    """The same pressures given to the arm model alone, moved to the world by hand."""
    model, turn = default_arm(), math.radians(90.0)
    pose = frames.pose_from(frames.rotation_from_axis_angle([1.0, 0, 0], turn), [10.0, 20.0, 30.0])
    mounted = Mounted(model, torch.tensor(pose), (10.0, 0.0, 5.0), shaft_mm=50.0)
    world = World(
        {"arm": mounted}, WorldConfig(randomisation=STILL, pneumatics=Pneumatics(tau_s=0))
    )
    state = world.start(streams(0, 1))
    alone = model.initial_state(1)
    alone, _ = model.step(alone, torch.tensor([[10.0, 0.0, 5.0]]), 1.0)
    for change in ([1.0, 2.0, -2.0], [-2.0, 2.0, 0.5]):
        state = world.step(state, {"arm": torch.tensor([change])})
        alone, points = model.step(alone, torch.tensor([change]), 0.1)
    x, y, z = points[0].T
    by_hand = torch.stack((x + 10.0, -z + 20.0, y + 30.0), 1)
    arm = state.arms["arm"]
    torch.testing.assert_close(arm.points_mm[0], by_hand, rtol=0, atol=1e-4)
    torch.testing.assert_close(arm.line_mm[0, 0], torch.tensor([10.0, 70.0, 30.0]))
    torch.testing.assert_close(arm.line_mm[0, -1], by_hand[-1], rtol=0, atol=1e-4)
    aim = model.backbone().tip_direction(points)[0]
    by_hand = torch.stack((aim[0], -aim[2], aim[1]))
    torch.testing.assert_close(arm.tip_direction[0], by_hand, rtol=0, atol=1e-5)


def test_late_actions_come_late():
    vary = replace(STILL, delay=3)
    world = single_arm_world(WorldConfig(randomisation=vary, pneumatics=Pneumatics(tau_s=0.0)))
    state = world.start(streams(1, 64))
    delay = state.arms["arm"].delay
    assert sorted(delay.unique().tolist()) == [0, 1, 2, 3]
    seen = []
    for change in (1.0, 0.0, 0.0, 0.0):
        state = world.step(state, {"arm": torch.full((64, 3), change)})
        seen.append(state.arms["arm"].pressure[:, 0])
    expected = [(delay <= step).float() for step in range(4)]
    torch.testing.assert_close(torch.stack(seen), torch.stack(expected))


def test_a_batch_of_n_is_n_batches_of_one(theatre):
    """Two arms, all randomisation on, the laser cutting; the streams are bit for bit the same."""
    count, steps = 5, 12
    actions = actions_of(theatre, count, steps)
    together = theatre.start(streams(4, count))
    for action in actions:
        together = theatre.step(together, action, 20.0)
    for i in range(count):
        alone = theatre.start(streams(4, 1, first=i))
        for action in actions:
            alone = theatre.step(alone, {name: a[i : i + 1] for name, a in action.items()}, 20.0)
        assert torch.equal(alone.stream.count[0], together.stream.count[i])
        assert_close(alone, rows(together, torch.tensor([i])))


def test_geometry_is_the_referees(theatre, phantom):
    state = theatre.start(streams(7, 6))
    for action in actions_of(theatre, 6, 10, seed=2):
        state = theatre.step(state, action)
    checker, scene = CollisionChecker(phantom.bodies), state.scene
    for i in range(6):
        shapes = {name: ArmShape(part.line_mm[i].numpy(), 7.5) for name, part in state.arms.items()}
        least = checker.clearance(shapes).least_mm
        assert scene.clearance.least_mm[i].item() == pytest.approx(least, abs=0.3)
        laser = state.arms["laser"]
        hit = checker.cast(
            laser.tip_mm[i].numpy(), laser.tip_direction[i].numpy(), 110.0, shapes, own="laser"
        )
        assert int(hit.struck) == scene.hit.struck[i].item()
        np.testing.assert_allclose(hit.point_mm, scene.hit.point_mm[i].numpy(), atol=1e-3)


@pytest.mark.parametrize("engine", ON_ACCELERATORS)
def test_the_accelerators_engine_gives_the_same_world(theatre, phantom, engine):
    """Engines for accelerators, here on the CPU, beside the compiled one."""
    other = scene_world(phantom, theatre.config, engine=engine)
    one, two = theatre.start(streams(7, 3)), other.start(streams(7, 3))
    for action in actions_of(theatre, 3, 4, seed=2):
        one, two = theatre.step(one, action, 20.0), other.step(two, action, 20.0)
    for name in ("least_mm", "self_mm"):
        a, b = (getattr(state.scene.clearance, name) for state in (one, two))
        torch.testing.assert_close(a, b, rtol=0, atol=0.3)
    assert torch.equal(one.scene.hit.struck, two.scene.hit.struck)
    torch.testing.assert_close(one.scene.hit.point_mm, two.scene.hit.point_mm, rtol=0, atol=1e-3)
    assert torch.equal(one.scene.view.visible, two.scene.view.visible)


def test_energy_on_the_organ_is_power_times_time(theatre):
    """At both ends of a step on the organ: all of the step's energy; at one end: half of it."""
    state = theatre.start(streams(11, 16))
    expected, organ = torch.zeros(16), theatre.scene.organ
    on = state.scene.hit.on_organ & (state.scene.hit.body == organ)
    for action in actions_of(theatre, 16, 15, seed=5):
        state = theatre.step(state, action, 8.0)
        now = state.scene.hit.on_organ & (state.scene.hit.body == organ)
        expected += 8.0 * 0.1 * 0.5 * (on.float() + now.float())
        on = now
    assert expected.max() > 1.0
    torch.testing.assert_close(state.scene.dose.delivered_j, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("donate", [False, True])
def test_a_masked_reset_leaves_the_others_alone(theatre, donate):
    actions = actions_of(theatre, 4, 6, seed=3)
    state = theatre.start(streams(2, 4))
    for action in actions:
        state = theatre.step(state, action, 20.0)
    before = tree_map(torch.clone, state)
    mask = torch.tensor([False, True, False, True])
    after = theatre.reset(state.donated() if donate else state, mask)
    kept, fresh = torch.tensor([0, 2]), torch.tensor([1, 3])
    for a, b in zip(leaves(rows(after, kept)), leaves(rows(before, kept)), strict=True):
        assert torch.equal(a.nan_to_num(), b.nan_to_num())
    if not donate:
        for a, b in zip(leaves(state), leaves(before), strict=True):
            assert torch.equal(a, b), "a reset changed the state it was given"
    assert after.steps.tolist() == [6, 0, 6, 0]
    assert after.scene.dose.dose[fresh].abs().max() == 0.0
    again = theatre.start(rows(before.stream, fresh))
    assert_close(rows(after, fresh), again)
    first = theatre.start(streams(2, 4))
    assert not torch.equal(first.arms["laser"].pressure[1], after.arms["laser"].pressure[1])


@pytest.mark.parametrize("name", ["laser", "endoscope"])
def test_a_diverged_environment_poisons_nobody(theatre, name):
    actions = actions_of(theatre, 5, 8, seed=6)
    good = bad = theatre.start(streams(3, 5))
    for i, action in enumerate(actions):
        good = theatre.step(good, action, 20.0)
        if i == 2:
            spoilt = action[name].clone()
            spoilt[3, 1] = math.nan
            action = {**action, name: spoilt}
        bad = theatre.step(bad, action, 20.0)
    assert bad.failed.tolist() == [False, False, False, True, False]
    others = torch.tensor([0, 1, 2, 4])
    for a, b in zip(leaves(rows(bad, others)), leaves(rows(good, others)), strict=True):
        assert torch.equal(a, b)
    healed = theatre.reset(bad, bad.failed)
    assert not healed.failed.any()
    for value in leaves(healed):
        assert value.isfinite().all()


def test_the_same_seed_gives_the_same_run(theatre):
    def run(seed):
        state = theatre.start(streams(seed, 3))
        for i, action in enumerate(actions_of(theatre, 3, 9)):
            state = theatre.step(state, action, 20.0)
            if i == 4:
                state = theatre.reset(state, torch.tensor([True, False, True]))
        return state

    for a, b in zip(leaves(run(5)), leaves(run(5)), strict=True):
        assert torch.equal(a, b)
    assert not torch.equal(run(5).arms["laser"].points_mm, run(6).arms["laser"].points_mm)


def test_states_cross_the_border_of_inference_mode(theatre):
    """Stepped and reset inside, then outside, the buffers donated throughout."""
    action = actions_of(theatre, 2, 1)[0]
    with torch.inference_mode():
        state = theatre.start(streams(0, 2)).donated()
        state = theatre.step(state, action, 20.0)
        state = theatre.reset(state, torch.tensor([True, False]))
    state = theatre.step(state, action, 20.0)
    state = theatre.reset(state, torch.tensor([False, True]))
    assert state.steps.tolist() == [1, 0]


def test_a_donated_dose_map_is_overwritten_and_gives_the_same_dose(theatre):
    plain, given = theatre.start(streams(8, 4)), theatre.start(streams(8, 4)).donated()
    first, kept = given.scene.dose.dose, plain.scene.dose.dose
    for action in actions_of(theatre, 4, 6):
        plain = theatre.step(plain, action, 20.0)
        given = theatre.step(given, action, 20.0)
    assert torch.equal(plain.scene.dose.dose, given.scene.dose.dose)
    assert given.scene.dose.dose is first
    assert not kept.any(), "a step changed the state it was given"


@pytest.fixture(scope="module")
def tripod():
    """Makes three chambers that bend one arc, of which each is driven from 0 to `high`, saved."""

    def made(unit, high):
        spec = ArmSpec(3, 5, (0.0,) * 3, (high,) * 3, unit=unit, length_mm=70.0)
        network = ConstantCurvature(torch.zeros(3), torch.full((3,), high), key_points=5)
        rest = torch.tensor([[0.0, 0.0, 17.5 * k] for k in range(5)])
        network.set_rest(rest)
        angle = torch.arange(3) * 2.0 * math.pi / 3.0
        network.table.data[0, :2, :3] = 0.5 * torch.stack((angle.cos(), angle.sin()))
        return ArmModel(spec, network, rest_mm=rest).eval().requires_grad_(False)

    return made


PSI = 6.894757
"""kPa, NIST SP 811 (2008) B.8."""


def test_an_arm_in_psi_moves_and_is_estimated_as_the_same_arm_in_kpa(tripod):
    """Random gains and mounts, noise, delays, and an observer that learns; all in kPa outside."""
    config = WorldConfig(randomisation=LIVELY, observer=AlphaBetaFilter(adapts=True))
    one, other = (
        World({"arm": Mounted(model, torch.eye(4))}, config)
        for model in (tripod("kPa", 60.0), tripod("psi", 60.0 / PSI))
    )
    states = [world.start(streams(8, 4)) for world in (one, other)]
    for action in [None, *actions_of(one, 4, 12)]:
        if action is not None:
            states = [w.step(s, action) for w, s in zip((one, other), states, strict=True)]
        plain, psi = (state.arms["arm"] for state in states)
        for name in ("command", "pressure", "seen_kPa", "points_mm", "seen_mm", "line_mm"):
            found = getattr(psi, name).numpy()
            np.testing.assert_allclose(found, getattr(plain, name), atol=2e-3, err_msg=name)
    np.testing.assert_allclose(psi.arm.pressure * PSI, plain.arm.pressure, atol=1e-3)
    at = torch.tensor([[10.0, 20.0, 30.0]])
    settled = [world.arms["arm"].settled(at) for world in (one, other)]
    np.testing.assert_allclose(*settled, atol=1e-3)


def test_an_arm_in_degrees_follows_a_path(tripod, tmp_path):
    """Its 90 degrees stand for 70 kPa. The circle is level with the straight arm, above the tips
    that an arc of constant length reaches: the expert holds the tip at the nearest of them. These
    are as far from every point of the circle, of which two fifths are followed."""
    save_model(tripod("deg", 90.0), tmp_path / "arm")
    config = TrackConfig(FollowConfig(arm=str(tmp_path / "arm"), loop_s=5.0, approach_s=2.0))
    task = make_task("track_circle", config)
    assert task.world.arms["arm"].high.tolist() == pytest.approx([70.0] * 3)
    task.steps = 40
    found = rollout(task, Scripted(), 1, 0)
    bend = np.linspace(0.01, 0.6, 10_000)
    radius, height = 70.0 * (1.0 - np.cos(bend)) / bend, 70.0 * np.sin(bend) / bend
    nearest = np.hypot(radius - 10.0, height - 70.0).min()
    assert float(found.mean("error_mm")) == pytest.approx(nearest, abs=0.005)
    with pytest.raises(InputError, match="is driven in deg, and a rig needs kPa"):
        on_rig(task)
    with pytest.raises(InputError, match="driven in deg, and an exported controller needs kPa"):
        ControllerGraph(task, {"arm": torch.nn.Identity()})


def test_each_arm_adapts_by_its_own_model(tripod):
    """What an arm learns does not depend on the model of the arm before it."""
    config = WorldConfig(
        randomisation=Randomisation(gain=0.1), observer=replace(AlphaBetaFilter(), adapts=True)
    )
    seen = []
    for other in (tripod("kPa", 70.0), default_arm()):
        arms = {"other": Mounted(other, torch.eye(4)), "arm": Mounted(default_arm(), torch.eye(4))}
        world = World(arms, config)
        state = world.start(streams(0, 2))
        for action in actions_of(world, 2, 5):
            state = world.step(state, action)
        seen.append(state.arms["arm"].seen_mm)
    torch.testing.assert_close(seen[0], seen[1], rtol=0.0, atol=1e-6)


def test_a_scene_takes_arms_in_psi(tripod, tmp_path):
    """Rewards of random actions are those of the same arms in kPa."""
    rewards = []
    for unit, high in (("kPa", 60.0), ("psi", 60.0 / PSI)):
        save_model(tripod(unit, high), tmp_path / unit)
        config = with_fields(config_of("circle_ablation"), arm=str(tmp_path / unit))
        episodes = Episodes(make_task("circle_ablation", config))
        state = episodes.seeded(2, 3)
        for action in actions_of(episodes.task.world, 3, 4):
            state, outcome = episodes.step(state, action)
        rewards.append(outcome.rewards)
    for agent, reward in rewards[0].items():
        np.testing.assert_allclose(rewards[1][agent], reward, atol=1e-3)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: WorldConfig(dt_s=0.0), "dt_s is 0.0"),
        (lambda: WorldConfig(samples=1), "samples is 1"),
        (lambda: SceneEngineConfig(view_points=0), "view_points is 0, expected above 0"),
        (lambda: Pneumatics(step_kPa=-1.0), "step_kPa is -1.0"),
        (lambda: Pneumatics(tau_s=math.nan), "tau_s is nan"),
        (lambda: Randomisation(noise_mm=-0.1), "noise_mm is -0.1"),
        (lambda: single_arm_world(start_kPa=(1.0,)), "1 pressures to start with, expected 3"),
    ],
)
def test_bad_numbers_are_one_line(make, message):
    with pytest.raises(InputError, match=message):
        make()
