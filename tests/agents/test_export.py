"""Exported policies: networks and whole controllers, read by programs without surgisoft."""

import json
import os
import re
import subprocess
import sys
from copy import copy
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import onnx
import pytest
import torch
from onnx.reference import ReferenceEvaluator
from torch.utils._python_dispatch import TorchDispatchMode

from surgisoft.agents import export as exporting
from surgisoft.agents.controller import ControllerGraph
from surgisoft.agents.controller_runner import Controller
from surgisoft.agents.distributed import Processes
from surgisoft.agents.export import export, running
from surgisoft.agents.learned import ActorPolicy, LearnedPolicy, agent_sizes
from surgisoft.agents.observer import ObserverGains
from surgisoft.agents.on_rig import RigConfig
from surgisoft.agents.presets import Plan, Preset
from surgisoft.agents.rig_check import (
    TOLERANCE_KPA,
    TOLERANCE_MM,
    Differences,
    RigCheck,
    check_on_rig,
    closed_loop,
    drive,
    replaying,
    same_measurements,
)
from surgisoft.agents.training import train_new
from surgisoft.cli import run as surgisoft
from surgisoft.errors import InputError
from surgisoft.graphs import DoesNotTrace, write_onnx
from surgisoft.rig.motion_capture import CameraDesign
from surgisoft.rig.virtual import VirtualRig
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.registry import TASKS, config_of, make_task, with_fields

TINY = Preset(
    envs=4, rollout=8, epochs=1, batches=2, evaluate_every=9, evaluation_episodes=1, normalise=True
)
SHORT = {
    "track_circle": {"loop_s": 2.0, "approach_s": 0.5},
    "track_body": {"time_s": 2.0, "approach_s": 0.5},
    "laser_plane": {"loop_s": 2.0, "approach_s": 0.5},
    "keyhole": {"time_s": 3.0},
    "circle_ablation": {},
    "contour_ablation": {},
    "area_ablation": {},
    "breathing_ablation": {},
    "keyhole_ablation": {"way_mm": 20.0, "speed_mm_s": 20.0, "wait_s": 0.5},
    "two_laser_ring": {},
}
"""Fields that make an episode of a task short, but not below 25 steps, and its feed begin in it."""
DECISIONS = 6
"""Decisions of the controller of every task. An observer gain of 0.9 then moves true key points by
0.006 mm (`circle_ablation`) and 0.014 mm (`track_circle`), 60 times what is accepted and more."""
AGREE_MM = 1e-4
"""Tolerance of a true key point."""
AGREE_KPA = 1e-4
"""Tolerance of a command."""
STRANGE = RigConfig(seed=1, settle_s=0.3, noise=0.0)
"""Another robot than the one that the model was fitted to. Without noise its pressure sensors read
without steps. With steps of 0.02 kPa a command that differs by 1e-6 kPa can change a reading of the
pumps' controllers, and moves the body by up to 7e-4 mm until the next reading (`laser_plane`)."""

STRANGE_WITH_NOISE = replace(STRANGE, noise=1.0)
"""The same robot with the noise of its cameras and pressure sensors."""


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "run"
    config = with_fields(config_of("track_circle"), **SHORT["track_circle"])
    plan = Plan("track_circle", config, "fast", TINY, steps=64)
    train_new(folder, plan, Processes(), torch.device("cpu"))
    return LearnedPolicy(folder)


@pytest.fixture(scope="module")
def exported(policy, tmp_path_factory):
    """The folder of the exported policy.

    `export` itself compares few samples here: the tests drive a rig with the files.
    """
    folder = tmp_path_factory.mktemp("exported") / "out"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exporting, "CHECKED", 8)  # three after the episode began
        assert surgisoft(["export", str(policy.run.path), "-o", str(folder)]) == 0
    return folder


def seen_and_done(policy):
    """Observations (B, D) of real episodes, 20 times as large too, and the policy's actions."""
    task = policy.run.task()
    play = Episodes(task)
    state = play.seeded(5, 7)
    seen = play.observe(state)["arm"]
    seen = torch.cat((seen, 20.0 * seen))
    return seen, policy.act(task, state, {"arm": seen})["arm"].clone().numpy()


def test_other_programs_get_the_same_actions(policy, exported):
    assert sorted(file.name for file in exported.iterdir()) == [
        *("arm.onnx", "arm.pt", "controller.onnx", "controller.pt", "controller.py"),
        "policy.json",
    ]
    seen, done = seen_and_done(policy)
    assert np.abs(done).max() > 1e-3
    onnx.checker.check_model(str(exported / "arm.onnx"))
    for name in ("arm.onnx", "controller.onnx"):  # nothing of the machine that exported them
        assert b"site-packages" not in (exported / name).read_bytes()
        assert b"controller.py" not in (exported / name).read_bytes()
    session = ReferenceEvaluator(str(exported / "arm.onnx"))
    script = torch.jit.load(str(exported / "arm.pt"))
    for rows in (slice(None), slice(3, 4)):
        (answer,) = session.run(None, {"observation": seen[rows].numpy()})
        np.testing.assert_allclose(answer, done[rows], atol=1e-5)
        np.testing.assert_allclose(script(seen[rows]).numpy(), done[rows], atol=1e-5)
    about = json.loads((exported / "policy.json").read_text())
    assert (about["task"], about["checkpoint"]) == ("track_circle", "best")
    assert about["agents"]["arm"]["observation"] == seen.shape[1]
    with pytest.raises(InputError, match="already exists"):
        export(policy, exported)


@pytest.mark.parametrize("engine", ["torch", "onnxruntime"])
def test_the_exported_controller_does_on_the_rig_what_evaluate_does(engine, policy, exported):
    """To 1e-4 mm, on a robot that the model does not know, from measurements alone."""
    found = check_on_rig(Controller(exported, engine), policy.run.task(), policy, STRANGE, seed=4)
    assert found.decisions == 25
    assert found.closed.points_mm < AGREE_MM
    assert found.closed.commands_kPa < AGREE_KPA
    assert found.same.accepted
    assert found.passed


def test_the_reference_evaluator_of_onnx_runs_the_file_too(policy, exported):
    """The engine that needs no binary library, a hundred times slower: eight decisions."""
    config = replace(STRANGE, settle_s=0.1)
    episode = drive(policy.run.task(), policy, config, seed=4)
    assert episode.decisions == 25
    found = same_measurements(Controller(exported, "onnx"), episode, most=8)
    assert found.points_mm < AGREE_MM
    assert found.commands_kPa < AGREE_KPA


class NoBooleanWhere(TorchDispatchMode):
    """Fails at a `where` of booleans, which onnxruntime does not implement."""

    def __torch_dispatch__(self, operation, types, given=(), options=None):
        if operation.overloadpacket is torch.ops.aten.where and len(given) == 3:
            assert getattr(given[1], "dtype", None) != torch.bool
        return operation(*given, **(options or {}))


def test_a_file_that_onnxruntime_cannot_open_is_not_written(tmp_path):
    class Choice(torch.nn.Module):
        def forward(self, x):
            return (torch.where(x > 1.0, x > 2.0, x < 0.0).float(),)

    with pytest.raises(DoesNotTrace, match=r"onnxruntime cannot open it: .*Where"):
        write_onnx(Choice(), (torch.ones(1, 2),), tmp_path / "x.onnx", ["x"], ["y"])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", SHORT)
def test_the_controller_of_every_task_does_on_the_rig_what_evaluate_does(name):
    task = make_task(name, with_fields(config_of(name), **SHORT[name]))
    task.steps = DECISIONS
    torch.manual_seed(3)
    actors = {
        agent: torch.nn.Linear(size["observation"], size["chambers"]).requires_grad_(False)
        for agent, size in agent_sizes(task).items()
    }
    graph = ControllerGraph(task, actors)
    with NoBooleanWhere(), torch.no_grad():
        graph(*graph.example())
    found = check_on_rig(running(graph), task, ActorPolicy(actors), STRANGE, seed=3)
    assert found.decisions == DECISIONS
    assert found.closed.points_mm < AGREE_MM
    assert found.closed.commands_kPa < AGREE_KPA
    assert found.same.accepted
    assert found.passed


def test_every_task_has_a_controller():
    """`track_square` is `track_circle` on another path."""
    assert {*SHORT, "track_square"} == set(TASKS)


def test_the_check_sees_a_wrong_observer(policy):
    """A controller that filters otherwise drives the robot otherwise."""
    task = policy.run.task()
    other = replace(STRANGE, observer_gain=0.9)
    found = check_on_rig(running(ControllerGraph(task, policy.actors)), task, policy, other)
    assert found.closed.points_mm > 1e-3
    assert not found.same.accepted
    assert not found.passed


def ten_pictures_a_second(config, trial):
    """A rig with one sample for each decision, which takes half the time."""
    cameras = CameraDesign(rate_Hz=10.0)
    return VirtualRig(config.seed, noise=config.noise, take=trial, cameras=cameras)


@pytest.fixture(scope="module")
def ring():
    """The packaged policy, its task in 30 % of the time, and a whole episode of it with noise on
    another robot."""
    policy = LearnedPolicy("ring")
    config = replace(policy.run.plan().task_config, cut_s=12.0)
    task = make_task(policy.run.config["task"], config)
    return policy, task, drive(task, policy, STRANGE_WITH_NOISE, build=ten_pictures_a_second)


def test_the_example_of_the_page_drives_the_controller(ring, monkeypatch):
    """The block of docs/export.md as it stands, with a bench whose arms do as they are told."""
    policy, task, _ = ring
    made = running(ControllerGraph(task, policy.actors))
    made.about = {**made.about, "episode_steps": 3}
    monkeypatch.setitem(sys.modules, "controller", SimpleNamespace(Controller=lambda folder: made))
    page = (Path(__file__).parents[2] / "docs" / "export.md").read_text()
    (block,) = re.findall(r"^```python\n(from controller import.*?)^```", page, re.S | re.M)
    state = Episodes(task).seeded(0, 1)
    points = {name: arm.model.rest_mm.numpy() for name, arm in task.world.arms.items()}
    sent = [{name: part.command[0].numpy() for name, part in state.world.arms.items()}]

    def next_sample():
        return sent[-1], points, sent[-1], 0.1, {"view_fraction": 0.9, "beam_on": 0.0}

    exec(block, {"next_sample": next_sample, "set_pressures": sent.append})
    assert made.done
    assert len(sent) == 1 + 3
    for command in sent[1:]:
        for name in task.agents:
            assert command[name].min() >= 0.0, "lowest of the example's limits"
            assert command[name].max() <= 40.0
            np.testing.assert_array_equal(made.state(f"arms.{name}.plant.highest_kPa"), 40.0)


def test_signals_and_times_out_of_range_are_refused(ring):
    """A share of 5 (in per cent, perhaps), and 3 s without a sample, of which one decision came."""
    policy, task, _ = ring
    made = running(ControllerGraph(task, policy.actors))
    points = {name: arm.model.rest_mm.numpy() for name, arm in task.world.arms.items()}
    rest = {name: np.zeros(3) for name in task.agents}
    made.begin(rest, points, rest, 30.0, view_fraction=1.0, beam_on=0.0)
    for wrong in (5.0, -0.1):
        with pytest.raises(ValueError, match=f"'view_fraction' is {wrong:g}, expected 0 to 1: "):
            made.step(rest, points, 0.1, view_fraction=wrong, beam_on=0.0)
    with pytest.raises(ValueError, match=r"dt_s is 3 s, expected at most 2 s within an episode"):
        made.step(rest, points, 3.0, view_fraction=1.0, beam_on=0.0)
    made.step(rest, points, 1.0, view_fraction=1.0, beam_on=1.0)
    assert made.steps == 1


def test_over_a_whole_episode_the_same_measurements_give_the_same_commands(ring):
    """A ring is cut in 140 decisions and more, with noise: the loops would be far apart by then."""
    policy, task, episode = ring
    assert episode.decisions > 140
    found = same_measurements(running(ControllerGraph(task, policy.actors)), episode)
    assert found.points_mm < AGREE_MM  # 0 where a processor rounds both programs alike
    assert found.commands_kPa < AGREE_KPA


@pytest.mark.parametrize("wrong", ["pumps", "transients"])
def test_a_wrong_constant_of_the_controller_shows_in_the_same_measurements(ring, wrong):
    """A gain of 0.4 in place of 0.3; decays that are 0.9998 of themselves."""
    policy, task, episode = ring
    gains = ObserverGains(pump_gain=0.4 if wrong == "pumps" else 0.3)
    graph = ControllerGraph(task, policy.actors, gains)
    for arm in graph.arms.values():
        if wrong == "transients":
            arm.observer.learner.keep = 0.9998 * arm.observer.learner.keep
    found = same_measurements(running(graph), episode, most=60)
    assert not found.accepted


def test_a_loop_that_amplifies_rounding_is_told_from_a_wrong_controller():
    """The loops may differ as long as, given the same measurements, nothing does on either."""
    right, far = Differences(TOLERANCE_MM, TOLERANCE_KPA), Differences(0.35, 1.1)
    assert RigCheck(right, right, 456).passed
    found = RigCheck(right, far, 456, right)
    assert found.amplified
    assert found.passed
    assert not RigCheck(right, far, 456).passed
    for wrong in (Differences(1.1e-4, 0.0), Differences(0.0, 6e-4), Differences(0.0, np.nan)):
        assert not RigCheck(right, far, 456, wrong).passed
        found = RigCheck(wrong, far, 456, right)
        assert found.amplified
        assert not found.passed


class Moved:
    """A controller whose first command, or every later one, is more by so much."""

    def __init__(self, controller, first_kPa=0.0, later_kPa=0.0):
        self.controller, self.first_kPa, self.later_kPa = controller, first_kPa, later_kPa

    def __getattr__(self, name):
        return getattr(self.controller, name)

    def begin(self, *given, **named):
        command = self.controller.begin(*given, **named)
        return {name: value + self.first_kPa for name, value in command.items()}

    def step(self, *given, **named):
        command = self.controller.step(*given, **named)
        return {name: value + self.later_kPa for name, value in command.items()}


def test_a_loop_that_departs_by_rounding_passes_and_one_by_a_wrong_controller_does_not(ring):
    """One set point of 10^-6 kPa more: after a whole ring the endoscope is 0.02 mm away or more,
    although at every decision the controller computes what the policy computes. A controller whose
    later commands are wrong is told within 20 decisions."""
    policy, task, episode = ring
    for later_kPa in (0.0, 0.002):
        if later_kPa:
            task = copy(task)
            task.steps = 20
            episode = drive(task, policy, STRANGE_WITH_NOISE, build=ten_pictures_a_second)
        controller = running(ControllerGraph(task, policy.actors))
        moved = Moved(controller, first_kPa=1e-6, later_kPa=later_kPa)
        closed, rigs = closed_loop(moved, episode, ten_pictures_a_second)
        assert closed.points_mm > (1.0 if later_kPa else 200.0) * TOLERANCE_MM
        build = replaying(rigs, ten_pictures_a_second)
        beside = drive(task, policy, STRANGE_WITH_NOISE, build=build)
        assert beside.decisions == episode.decisions
        pressures, points = beside.measured(row := beside.settled + 15)
        for name, rig in rigs.items():
            np.testing.assert_array_equal(pressures[name], rig.samples[row][0].measured)
            np.testing.assert_array_equal(points[name], rig.samples[row][0].key_points_mm)
        own = same_measurements(moved, beside)
        check = RigCheck(Differences(0.0, 0.0), closed, episode.decisions, own)
        assert check.passed == (not later_kPa)
        assert own.commands_kPa == pytest.approx(later_kPa, abs=TOLERANCE_KPA)


def wrong_files(monkeypatch, off, wrong):
    """Let export write empty files instead of graphs, of which some answer `off` too much."""

    def written(module, example, file, *names, **options):
        file.write_bytes(b"")
        more = off if file.name in wrong else 0.0

        def answer(*given):
            found = module(*given)
            if isinstance(found, tuple):  # a controller: the state, then what it commands
                return (found[0], *(each + more for each in found[1:]))
            return found + more

        return answer

    monkeypatch.setattr(exporting, "write_torch_script", written)
    monkeypatch.setattr(exporting, "write_onnx", written)
    monkeypatch.setattr(exporting, "CHECKED", 8)


def test_an_export_that_does_not_pass_its_check_leaves_the_folder_as_it_was(
    policy, tmp_path, monkeypatch
):
    wrong_files(monkeypatch, 0.0, [])
    monkeypatch.setattr(exporting, "Controller", lambda folder: (folder / "controller.py").exists())
    seen = []

    def refuse(controller):
        seen.append(controller)
        raise InputError("another command")

    with pytest.raises(InputError, match="another command"):
        export(policy, tmp_path / "out", check=refuse)
    assert list(tmp_path.iterdir()) == []
    files = export(policy, tmp_path / "out", check=seen.append)
    (tmp_path / "out" / "controller.pt").write_text("of before")
    with pytest.raises(InputError, match="another command"):
        export(policy, tmp_path / "out", force=True, check=refuse)
    assert (tmp_path / "out" / "controller.pt").read_text() == "of before"
    assert sorted((tmp_path / "out").iterdir()) == sorted(files)
    assert seen == [True] * 3


@pytest.mark.parametrize("name", ["arm.pt", "arm.onnx"])
def test_a_network_whose_file_computes_otherwise_is_not_exported(
    policy, tmp_path, monkeypatch, name
):
    """More than 1e-5 kPa at any of 64 observations; nothing is left behind."""
    wrong_files(monkeypatch, 2e-5, [name])
    with pytest.raises(RuntimeError, match=rf"{name}: actions differ by \S+ kPa from the policy's"):
        export(policy, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["controller.pt", "controller.onnx"])
@pytest.mark.parametrize(("off", "kept"), [(2e-4, False), (np.nan, False), (2e-5, True)])
def test_a_controller_whose_file_computes_otherwise_is_not_exported(
    policy, tmp_path, monkeypatch, name, off, kept
):
    """More than 1e-4 of any unit in 8 samples: the policies are exported, and the reason said."""
    wrong_files(monkeypatch, off, [name])
    written = {file.name for file in export(policy, tmp_path / "out")}
    about = json.loads((tmp_path / "out" / "policy.json").read_text())
    assert ("controller.py" in written) is kept
    assert (about["controller"] is not None) is kept
    assert len([*(tmp_path / "out").glob("controller.*")]) == 3 * kept
    if not kept:
        assert about["note"].startswith(f"controller: {name} differs by ")


def test_policy_json_names_every_entry_of_the_observation(policy, exported):
    about = json.loads((exported / "policy.json").read_text())
    blocks = about["observations"]["arm"]
    indices = [i for block in blocks for i in range(block["first"], block["last"] + 1)]
    assert indices == list(range(policy.run.agents["arm"]["observation"]))
    assert all(block["unit"] and block["scale"] and block["meaning"] for block in blocks)
    told = about["controller"]
    assert set(told["tensors"]) == {*told["inputs"], *told["outputs"]}
    for name in ("arm_pressure_kPa", "arm_command_kPa"):
        tensor = told["tensors"][name]
        assert (tensor["unit"], tensor["shape"]) == ("kPa", [1, 3])
        assert tensor["low"] < 0.0 < tensor["high"]
    assert {goal["name"] for goal in told["goal"]} >= {"goal.traversal.start"}
    assert all(goal["meaning"] for goal in told["goal"])


DRIVE = """
import json, sys
sys.modules["surgisoft"] = sys.modules["torch"] = None
import numpy as np
from controller import Controller
rows = json.load(open("rows.json"))
controller = Controller(".", "onnx")
controller.limit([0.0] * 3, [40.0] * 3)
found = []
for number, (p, points, commanded) in enumerate(rows):
    if number < 3:
        controller.observe(p, points, commanded, 0.05)
    elif number == 3:
        goal = {"traversal.start": 0.3, "traversal.direction": -1.0}
        found.append(controller.begin(p, points, commanded, 0.05, goal=goal).tolist())
    else:
        found.append(controller.step(p, points, 0.05).tolist())
print(json.dumps([found, controller.steps, controller.outputs["arm_observation"].tolist()]))
"""


def test_the_runner_needs_neither_surgisoft_nor_torch(policy, exported):
    """Two decisions in four samples, within other limits, from a start that is chosen."""
    random, task = np.random.default_rng(0), policy.run.task()
    rest = task.arm.model.rest_mm.numpy()
    rows = []
    for _ in range(8):
        pressure = 20.0 + 3.0 * random.standard_normal(3)
        points = rest + random.standard_normal(rest.shape)
        rows.append([pressure.tolist(), points.tolist(), [20.0, 39.5, 0.2]])
    rows[5][1][2] = [float("nan")] * 3
    (exported / "rows.json").write_text(json.dumps(rows))
    done = subprocess.run(
        [sys.executable, "-c", DRIVE],
        capture_output=True,
        text=True,
        check=True,
        cwd=exported,
        env={k: v for k, v in os.environ.items() if k != "PYTHONPATH"},
    )
    (exported / "rows.json").unlink()
    commands, steps, seen = json.loads(done.stdout)
    assert steps == 2
    assert commands[0] == commands[1] != commands[2]
    assert np.min(commands) >= 0.0
    assert np.max(commands) <= 40.0
    assert np.abs(np.subtract(commands[0], [20.0, 39.5, 0.2])).max() <= 3.0
    assert np.isfinite(seen).all()


def test_the_runner_says_what_is_wrong_with_a_measurement(exported):
    controller = Controller(exported, "torch")
    points, rest = np.zeros((5, 3)), np.zeros(3)
    with pytest.raises(ValueError, match="step before begin"):
        controller.step(rest, points, 0.1)
    with pytest.raises(ValueError, match=r"shape \(2,\), expected \(3,\)"):
        controller.observe([1.0, 2.0], points, rest, 0.1)
    with pytest.raises(ValueError, match="expected finite numbers"):
        controller.observe([1.0, 2.0, np.nan], points, rest, 0.1)
    with pytest.raises(ValueError, match=r"'start' is not known, expected traversal\.start"):
        controller.begin(rest, points, rest, 0.1, goal={"start": 0.5})
    with pytest.raises(ValueError, match="engine 'onx' is not known"):
        Controller(exported, "onx")


def test_command_says_why_a_controller_is_not_exported(policy, tmp_path, capsys, monkeypatch):
    def refuse(*given):
        raise InputError("the observer draws random numbers")

    monkeypatch.setattr("surgisoft.agents.export.ControllerGraph", refuse)
    assert surgisoft(["export", str(policy.run.path), "-o", str(tmp_path / "y")]) == 0
    assert "controller: not exported, only the policies: the observer" in capsys.readouterr().out


def test_command_refuses_a_folder_without_a_run(tmp_path, capsys):
    assert surgisoft(["export", str(tmp_path), "-o", str(tmp_path / "y")]) == 2
    assert "no training run" in capsys.readouterr().err
    assert not (tmp_path / "y").exists()
