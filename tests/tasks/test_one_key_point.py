"""Arms of which only the tip was measured: an arc of constant curvature, in every task.

The body is compared with a circle that is tangent to the base's axis and goes through the tip.
"""

import math
import warnings
from dataclasses import replace
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from pettingzoo.test import parallel_api_test

import surgisoft
from surgisoft.agents.policies import Scripted
from surgisoft.agents.rollout import rollout
from surgisoft.cli import run
from surgisoft.errors import AssumptionWarning, InputError
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.collision import CollisionChecker
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.backbone import TIP_TASKS
from surgisoft.surrogate.checkpoint import default_arm, save_model
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import HawNN
from surgisoft.surrogate.reach import model_table
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.inverse_kinematics import Pointing
from surgisoft.tasks.lone_ring import LoneRing
from surgisoft.tasks.parallel import SurgicalEnv
from surgisoft.tasks.registry import TASKS, config_of, make_with, with_fields
from surgisoft.tasks.single import SingleEnv
from surgisoft.tasks.world.arm import ModelArm, Mounted, Randomisation
from surgisoft.tasks.world.observer import AlphaBetaFilter
from surgisoft.tasks.world.random_streams import streams
from surgisoft.tasks.world.world import World, WorldConfig
from tests.tasks.scripted import scripted_states

AGREE_MM = 1e-4
"""Largest difference of a place (mm): rounding of float32 at 100 mm, some ten steps of it."""
LENGTH_MM, TURN_RAD = 70.0, 0.55
"""Length of the arms, and by how much half of a chamber's range turns the tip of `arc_arm`."""
PSI = 6.894757
"""kPa, NIST SP 811 (2008) B.8."""
LIVELY = Randomisation(history=2, start_kPa=15, mount_mm=1.0, mount_rad=0.03, gain=0.05, delay=1)
NOISY = replace(LIVELY, noise_mm=0.1, noise_kPa=0.1)

pytestmark = pytest.mark.filterwarnings("ignore::surgisoft.errors.AssumptionWarning")
every_task = pytest.mark.parametrize("name", TASKS)


def tip_arm(unit="kPa", factor=1.0):
    """The package's arm, of which only the tip is known; its actuation in units of 1 kPa / factor.

    It is a rod with stiff ends, whose body is no arc.
    """
    whole = default_arm()
    low, high = (factor * torch.tensor(end) for end in (whole.spec.low, whole.spec.high))
    network = HawNN(low, high, 1, whole.network.hidden)
    learned = whole.network.state_dict()
    for name in ("mean", "scale", "layers.8.weight", "layers.8.bias"):
        learned[name] = learned[name][-3:]
    for name in ("centre", "half_range"):
        learned[name] = factor * learned[name]
    network.load_state_dict(learned)
    ends = {"low": tuple(low.tolist()), "high": tuple(high.tolist())}
    band = tuple(factor * value for value in whole.spec.band)
    spec = replace(whole.spec, key_points=1, unit=unit, band=band, **ends)
    return ArmModel(spec, network, rest_mm=whole.rest_mm[-1:]).eval().requires_grad_(False)


def arc_arm(chambers=3):
    """Chambers around one segment of 70 mm that bend it to an arc; its tip is the key point."""
    low, high = torch.zeros(chambers), torch.full((chambers,), 60.0)
    network = HawNN(low, high, 1, hidden=(2,), arcs=1)
    rest = torch.tensor([[0.0, 0.0, LENGTH_MM]])
    network.prior.set_rest(rest)
    angle = torch.arange(chambers) * 2.0 * math.pi / chambers
    with torch.no_grad():
        network.layers[-1].weight.zero_()
        network.layers[-1].bias.zero_()
        network.prior.table[0, :2, :chambers] = TURN_RAD * torch.stack((angle.cos(), angle.sin()))
    spec = ArmSpec(chambers, 1, (0.0,) * chambers, (60.0,) * chambers, length_mm=LENGTH_MM)
    return ArmModel(spec, network, rest_mm=rest).eval().requires_grad_(False)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Folders of the same arm in kPa, psi and degrees; `wide` in kPa is `deg` with 70 kPa."""
    place, widest = tmp_path_factory.mktemp("arms"), max(default_arm().spec.span)
    factors = {"kPa": 1.0, "psi": 1.0 / PSI, "deg": 90.0 / widest, "wide": 70.0 / widest}
    for name, factor in factors.items():
        save_model(tip_arm("kPa" if name == "wide" else name, factor), place / name)
    return place


def around(part, share):
    """(B, K, 3) mm body and (B, 3) tip direction on the circle through base and tip, float64.

    A circle that touches the axis z at the base and meets the tip d has the radius d d / (2 d e),
    if e is the unit vector across z towards d.
    """
    base, axis = part.mount[:, :3, 3].double(), part.mount[:, :3, 2].double()
    chord = part.points_mm[:, 0].double() - base
    along = (chord * axis).sum(1)
    across = chord - along[:, None] * axis
    aside = across.norm(dim=1)
    across = across / aside[:, None]
    radius = chord.square().sum(1) / (2.0 * aside)
    turn = torch.atan2(along, radius - aside).remainder(2.0 * math.pi)
    at = turn[:, None] * share.double()
    line = (radius[:, None] * at.sin())[..., None] * axis[:, None]
    line = line + (radius[:, None] * (1.0 - at.cos()))[..., None] * across[:, None]
    aim = turn.cos()[:, None] * axis + turn.sin()[:, None] * across
    return base[:, None] + line, aim


def moved(world, count, steps, seed=0):
    """States of a world during random actions."""
    random, state = torch.Generator().manual_seed(seed), world.start(streams(seed, count))
    for _ in range(steps):
        action = {
            name: 3.0 * torch.randn(count, arm.chambers, generator=random)
            for name, arm in world.arms.items()
        }
        state = world.step(state, action)
    return state


@pytest.mark.parametrize("compiled", [True, False])
@pytest.mark.parametrize("shaft_mm", [0.0, 50.0])
def test_body_and_tip_axis_are_those_of_the_circle_through_base_and_tip(compiled, shaft_mm):
    pose = torch.tensor([[0.0, 0.0, 1.0, 9.0], [1.0, 0, 0, -4.0], [0, 1.0, 0, 2.0], [0, 0, 0, 1.0]])
    mounted = Mounted(tip_arm(), pose, (30.0, 15.0, 15.0), shaft_mm)
    world = World({"arm": mounted}, WorldConfig(randomisation=LIVELY))
    if not compiled:
        world.arms["arm"] = world.arms["arm"].reference()
    for steps in (0, 15):
        part = moved(world, 5, steps).arms["arm"]
        line, aim = around(part, torch.linspace(0.0, 1.0, 21))
        torch.testing.assert_close(line[:, -1], part.points_mm[:, 0].double(), rtol=0, atol=1e-4)
        if shaft_mm:
            end = part.mount[:, :3, 3] - shaft_mm * part.mount[:, :3, 2]
            torch.testing.assert_close(part.line_mm[:, 0], end, rtol=0, atol=AGREE_MM)
        body = part.line_mm[:, 1 if shaft_mm else 0 :].double()
        torch.testing.assert_close(body, line, rtol=0, atol=AGREE_MM)
        torch.testing.assert_close(part.tip_direction.double(), aim, rtol=0, atol=4e-6)


def test_an_arm_that_is_an_arc_has_its_true_body():
    """The body of arcs whose turn follows from the pressures in closed form."""
    mounted = Mounted(arc_arm(), torch.eye(4), (40.0, 20.0, 20.0))
    part = moved(World({"arm": mounted}, WorldConfig(randomisation=LIVELY)), 5, 15).arms["arm"]
    angle, share = torch.arange(3) * 2.0 * math.pi / 3.0, torch.linspace(0.0, 1.0, 21).double()
    loads = (part.gain * part.pressure).double() / 30.0 - 1.0
    across = TURN_RAD * loads @ torch.stack((angle.cos(), angle.sin()), 1).double()
    turn = across.norm(dim=1)[:, None]
    assert turn.max() > 0.3
    way, at = across / turn, turn * share
    aside = LENGTH_MM / turn * (1.0 - at.cos())
    along = LENGTH_MM / turn * at.sin()
    line = torch.stack((aside * way[:, :1], aside * way[:, 1:], along), 2)
    line = torch.einsum("bij,bkj->bki", part.mount[:, :3, :3].double(), line)
    line = line + part.mount[:, None, :3, 3].double()
    torch.testing.assert_close(part.line_mm.double(), line, rtol=0, atol=AGREE_MM)


@every_task
def test_compiled_and_reference_agree_in_every_task(name, folders):
    task = make_with(name, arm=folders / "kPa")
    plain = {arm: body.reference() for arm, body in task.world.arms.items()}
    random, dt_s = torch.Generator().manual_seed(1), task.world.config.dt_s
    state = Episodes(task).seeded(4, 3).world
    found, expected, stream = dict(state.arms), dict(state.arms), state.stream
    for _ in range(25):
        for arm, body in plain.items():
            action = 2.0 * torch.randn(3, body.chambers, generator=random)
            _, expected[arm] = body.step(stream, expected[arm], action, dt_s)
            _, found[arm] = task.world.arms[arm].step(stream, found[arm], action, dt_s)
            for field in ("points_mm", "line_mm", "tip_direction", "seen_mm"):
                off = (getattr(found[arm], field) - getattr(expected[arm], field)).abs().max()
                assert off < AGREE_MM, (arm, field)


def test_the_exact_checker_meets_the_arc(folders):
    """FCL on capsules along the circle, beside the world of a scene in its own engine."""
    task = make_with("circle_ablation", arm=folders / "kPa")
    state = moved(task.world, 4, 25, seed=3)
    checker, share = CollisionChecker(task.scene.geometry.bodies), torch.linspace(0.0, 1.0, 21)
    for i in range(4):
        shapes, tips = {}, {}
        for name, part in state.arms.items():
            line, aim = around(part, share)
            tips[name] = line[i, -1].numpy(), aim[i].numpy()
            shaft = part.line_mm[i, :1].numpy() if len(task.world.arms[name].shaft) else None
            body = line[i].numpy() if shaft is None else np.concatenate((shaft, line[i].numpy()))
            shapes[name] = ArmShape(body, 7.5)
        found, scene = checker.clearance(shapes), state.scene
        assert scene.clearance.least_mm[i].item() == pytest.approx(found.least_mm, abs=0.3)
        hit = checker.cast(*tips["laser"], 110.0, shapes, own="laser")
        assert int(hit.struck) == scene.hit.struck[i].item()
        np.testing.assert_allclose(hit.point_mm, scene.hit.point_mm[i].numpy(), atol=1e-3)


def test_mounts_are_searched_for_an_arm_that_is_an_arc():
    """The reach table holds circles, says what it assumes, and refuses an arm of two segments."""
    with pytest.warns(AssumptionWarning, match="its reach is that of an arc of constant curvature"):
        _, lines, aims = model_table(tip_arm(), points=9)
    some = slice(0, None, 1000)
    lines, aims = (torch.tensor(values[some]) for values in (lines, aims))
    part = SimpleNamespace(points_mm=lines[:, -1:], mount=torch.eye(4).repeat(len(lines), 1, 1))
    line, aim = around(part, torch.linspace(0.0, 1.0, 9))
    torch.testing.assert_close(lines, line, rtol=0, atol=AGREE_MM)
    torch.testing.assert_close(aims, aim, rtol=0, atol=4e-6)
    with pytest.raises(InputError, match="the arm has 6 chambers, several segments"):
        model_table(arc_arm(6))


@pytest.mark.parametrize(
    ("name", "unit"),
    [*((name, "psi") for name in TASKS), ("track_circle", "deg"), ("two_laser_ring", "deg")],
)
def test_every_task_takes_arms_in_psi_and_degrees(name, unit, folders):
    """Observations and rewards are those of the arm in kPa, whose range is as wide in the task.

    The world alone looks at the unit: one arm in degrees, and three around a scene, are enough.
    """
    found = []
    for arm in ({"psi": "kPa", "deg": "wide"}[unit], unit):
        episodes = Episodes(make_with(name, arm=folders / arm))
        state, random = episodes.seeded(2, 2), torch.Generator().manual_seed(0)
        for _ in range(3):
            state, outcome = episodes.step(
                state,
                {
                    agent: 3.0 * torch.randn(2, 3, generator=random)
                    for agent in episodes.task.agents
                },
            )
        found.append((episodes.observe(state), outcome.rewards))
    for one, other in zip(*found, strict=True):
        for agent, value in one.items():
            np.testing.assert_allclose(other[agent], value, atol=2e-3, err_msg=agent)


def test_the_adapters_accept_such_an_arm(folders):
    for name in ("circle_ablation", "two_laser_ring"):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # names of agents without a number
            parallel_api_test(SurgicalEnv(make_with(name, arm=folders / "kPa")), num_cycles=10)
    for name in ("track_circle", "track_body", "laser_plane", "keyhole"):
        env = SingleEnv(make_with(name, arm=folders / "kPa"))
        check_env(env, skip_render_check=True)


def test_one_episode_in_kept_arrays_is_that_of_the_task(folders):
    """`LoneRing` beside a batch of one."""
    task = make_with("circle_ablation", arm=folders / "kPa", geometry="batched")
    env, plain = SurgicalEnv(task), SurgicalEnv(task)
    plain.adapter.alone = lambda state: None
    for one in (env, plain):
        one.reset(seed=5)
    assert isinstance(env.lone, LoneRing)
    rng = np.random.default_rng(0)
    for _ in range(15):
        acts = {agent: rng.uniform(-1.0, 1.0, 3).astype("f4") for agent in env.agents}
        found, expected = env.step(acts), plain.step(acts)
        for agent, value in expected[0].items():
            np.testing.assert_allclose(found[0][agent], value, atol=4.0 * AGREE_MM)
    for name, part in plain.task_state.world.arms.items():
        off = env.task_state.world.arms[name].line_mm - part.line_mm
        assert off.abs().max() < AGREE_MM


@pytest.mark.parametrize("name", ["track_circle", "track_body", "laser_plane"])
def test_the_expert_follows_with_the_tip_alone(name, folders):
    """All coordinates of the tip by three pressures, or the spot of its axis; random mounts."""
    short = {"time_s": 2.0} if name == "track_body" else {"loop_s": 4.0}
    mounts = {"mount_mm": 0.5, "mount_rad": 0.02}
    config = with_fields(config_of(name), arm=str(folders / "kPa"), **short, **mounts)
    found = rollout(make_with(name, config), Scripted(), 1, 0)
    assert float(found.mean("error_mm")) < 0.01


def test_the_axis_is_pointed_from_the_mount_of_the_episode():
    """The expert's offset ends at zero on turned mounts, and is the nominal one where asked so."""
    turned = WorldConfig(randomisation=Randomisation(mount_mm=1.0, mount_rad=0.03))
    world = World({"arm": Mounted(tip_arm(), torch.eye(4), (30.0, 25.0, 20.0))}, turned)
    arm = world.arms["arm"]
    point, state = Pointing(arm, 0.1), world.start(streams(3, 4))
    part = state.arms["arm"]
    target = part.tip_mm + 40.0 * part.tip_direction + torch.tensor([3.0, -2.0, 0.0])
    for _ in range(8):
        action = point.action(state.arms["arm"], target)
        state = world.step(state, {"arm": action})
    part = state.arms["arm"]
    away = target - part.tip_mm
    across = torch.linalg.cross(away, part.tip_direction).norm(dim=1)
    assert across.max() < 0.05
    off = point.offset_mm(part.points_mm, target, part.mount).norm(dim=1)
    torch.testing.assert_close(off, across, rtol=0, atol=1e-4)
    nominal = replace(part, mount=torch.eye(4).repeat(4, 1, 1))
    aim = around(nominal, torch.ones(1))[1].float()
    expected = torch.linalg.cross(away, aim).norm(dim=1)
    assert expected.min() > 0.05
    found = point.offset_mm(part.points_mm, target).norm(dim=1)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-3)


def test_a_policy_is_trained_and_evaluated(folders, tmp_path):
    """A few updates; the policy differs from its start, and its run keeps the arm's model."""
    given = {"arm": folders / "kPa", "steps": 64, "envs": 8, "seed": 5}
    run_ = surgisoft.train("track_circle", tmp_path / "mine", **given)
    assert run_.result.done
    found = surgisoft.evaluate([tmp_path / "mine", "random"], episodes=2, seed=1).to_json()
    mine, other = (each["overall"]["error_mean_mm"] for each in found["policies"].values())
    assert mine != other
    assert [p.name for p in (tmp_path / "mine").rglob("weights.safetensors")]


def test_policies_see_the_tip_and_no_true_mount(folders):
    """Observation and release of the beam follow from what is measured and the nominal mount."""
    for name in ("laser_plane", "circle_ablation", "two_laser_ring"):
        task = make_with(name, arm=folders / "kPa")
        state = Episodes(task).seeded(1, 2)
        arms = {}
        for arm, part in state.world.arms.items():
            seen = part.seen_mm + torch.tensor([1.0, -0.5, 0.25])
            mount = part.mount.clone()
            mount[:, :3, 3] += 3.0
            mount[:, :3, :3] = mount[:, :3, [1, 2, 0]]
            arms[arm] = replace(part, seen_mm=seen), replace(part, seen_mm=seen, mount=mount)
        states = [state] + [
            replace(
                state, world=replace(state.world, arms={a: pair[k] for a, pair in arms.items()})
            )
            for k in (0, 1)
        ]
        before, one, other = (task.blocks(each) for each in states)
        for agent, blocks in one.items():
            same = {
                block.name for block, value in blocks.items() if value.equal(other[agent][block])
            }
            # What the model predicts begins at the true shape, with every arm.
            assert {block.name for block in blocks} - same <= {"predicted_error"}, (name, agent)
            seen = {b.name for b, v in blocks.items() if not v.equal(before[agent][b])}
            assert "shape" in seen
            assert seen & {"error", "beam_error", "view_error"}
    measured = task.measured_arms(states[2])
    for arm, part in task.measured_arms(states[1]).items():
        assert torch.equal(measured[arm].tip_direction, part.tip_direction)
    part, arm = states[2].world.arms["laser_1"], task.world.arms["laser_1"]
    tip = part.seen_mm[:, 0] - arm.pose[:3, 3]
    axis = arm.pose[:3, 2]
    mirrored = 2.0 * (tip @ axis / tip.square().sum(1))[:, None] * tip - axis
    torch.testing.assert_close(measured["laser_1"].tip_direction, mirrored, rtol=0, atol=1e-5)


def test_the_observer_that_learns_takes_an_arm_with_one_key_point():
    """A tip that is pushed aside is estimated better than it is measured."""
    config = WorldConfig(randomisation=NOISY, observer=AlphaBetaFilter(adapts=True))
    world = World({"arm": Mounted(tip_arm(), torch.eye(4))}, config)
    assert isinstance(world.arms["arm"], ModelArm)
    part = moved(world, 64, 60).arms["arm"]
    off = (part.seen_mm - part.points_mm).norm(dim=2).square().mean().sqrt()
    assert off < 0.8 * 0.1 * math.sqrt(3.0)


def test_an_arc_that_is_no_body_enters_the_tasks_of_the_tip_alone(tmp_path):
    """Two segments of three chambers, one key point in all."""
    save_model(arc_arm(6), tmp_path / "two")
    for name in TASKS:
        if name in TIP_TASKS:
            _, outcomes = scripted_states(make_with(name, arm=tmp_path / "two"), 1, 8)
            assert all(term["arm"].isfinite().all() for term in (o.rewards for o in outcomes))
            continue
        with pytest.raises(InputError, match=r"has 6 chambers, several segments .*or track_body$"):
            make_with(name, arm=tmp_path / "two")
    with pytest.raises(InputError, match="6 chambers, several segments"):
        surgisoft.make("keyhole", arm=tmp_path / "two")


def test_the_assumption_is_said_when_the_task_is_made(folders, capsys):
    said = "laser_plane: only the tip of arm 'arm' was measured; body and tip axis are those of an"
    with pytest.warns(AssumptionWarning, match=said):
        surgisoft.make("laser_plane", arm=folders / "kPa")
    with pytest.warns(AssumptionWarning, match="arm 'laser' and 'endoscope' was measured"):
        surgisoft.make("circle_ablation", arm=folders / "kPa")
    with pytest.warns(AssumptionWarning, match=said):
        gymnasium.make("surgisoft/laser_plane-v0", arm=str(folders / "kPa"))
    with warnings.catch_warnings():
        warnings.simplefilter("error", AssumptionWarning)
        surgisoft.make("track_circle", arm=folders / "kPa")
        surgisoft.make("laser_plane")
    arguments = ["random", "--task", "laser_plane", "--arm", str(folders / "kPa")]
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        assert run(["evaluate", *arguments, "--episodes", "1"]) == 0
    assert capsys.readouterr().err.count(f"surgisoft: warning: {said}") == 1
