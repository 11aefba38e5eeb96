"""Inputs of training, evaluation and exported controllers that are refused, each in one line."""

import importlib.util
import json
import re
import shutil
import sys
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from surgisoft.agents.controller import ControllerGraph
from surgisoft.agents.controller_runner import Controller
from surgisoft.agents.distributed import processes
from surgisoft.agents.exact_checks import ExactChecks
from surgisoft.agents.export import export
from surgisoft.agents.learned import agent_sizes, check_fits
from surgisoft.agents.loggers import LoggerFailed, check_logger, open_writer
from surgisoft.agents.observer import ObserverGains
from surgisoft.agents.on_rig import RigConfig, on_rig
from surgisoft.agents.policies import check_policy
from surgisoft.agents.presets import Plan, Preset
from surgisoft.agents.run_folder import PACKAGED, RunFolder, check_free, create_run
from surgisoft.agents.session import EvaluationRequest, evaluate
from surgisoft.agents.training import Result
from surgisoft.agents.training_request import TrainedRun, TrainingRequest, shortfall, train
from surgisoft.errors import InputError
from surgisoft.tasks.circle_ablation import CircleAblation
from surgisoft.tasks.path_following import FollowConfig
from surgisoft.tasks.registry import make_task
from surgisoft.tasks.track import TrackConfig, track_circle
from tests.rig.own_rig import OwnRig

SHORT = TrackConfig(FollowConfig(loop_s=0.4, approach_s=0.1))


def plan(**changes) -> Plan:
    return Plan("track_circle", TrackConfig(), "fast", Preset(), **({"steps": 100} | changes))


@pytest.fixture(scope="module")
def packaged(tmp_path_factory):
    """A copy of the package's trained run."""
    (run,) = (path for path in PACKAGED.iterdir() if (path / "config.json").is_file())
    folder = tmp_path_factory.mktemp("runs") / "run"
    shutil.copytree(run, folder)
    return folder


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Preset(epochs=0), "preset: epochs is 0, expected more than 0"),
        (
            lambda: TrainingRequest("track_circle", ppo={"hidden": []}).plan(),
            "ppo.hidden: got a list []; expected a list of 1 to 100 widths from 1 to 10,000",
        ),
        (lambda: Preset(envs=4, rollout=4, batches=9), "leaves fewer than 2 samples in each"),
        (lambda: plan(steps=None), "neither steps nor minutes are given"),
        (lambda: plan(target_error=-1.0), "target_error is -1.0, expected more than 0"),
        (lambda: RigConfig(settle_s=0.0), "settle_s is 0.0, expected more than 0 s"),
        (lambda: train(), "--task is missing: one of track_circle"),
        (lambda: evaluate([]), "no policy is given; expected scripted, random or a run's folder"),
        (lambda: evaluate("random"), "--task is missing; expected one of track_circle"),
        (lambda: ExactChecks(track_circle(SHORT)), "track_circle has no scene, so the exact"),
    ],
)  # fmt: skip
def test_bad_input_is_one_line(make, message):
    with pytest.raises(InputError) as error:
        make()
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_a_training_is_done_by_its_steps_or_by_its_minutes_whichever_comes_first():
    assert plan().share(25, 1e9) == 0.25
    assert plan(steps=None, minutes=2.0).share(10**9, 60.0) == 0.5
    both = plan(minutes=2.0)
    assert (both.share(25, 60.0), both.share(75, 60.0)) == (0.5, 0.75)
    assert both.share(25, 600.0) == 1.0


def test_the_observer_adapts_unless_told_otherwise_or_given_a_gain():
    assert ObserverGains().adapting
    assert not ObserverGains(observer_gain=0.5).adapting
    assert not ObserverGains(adapts=False).adapting
    assert ObserverGains(observer_gain=0.5, adapts=True).adapting
    assert not ObserverGains(cameras=False, adapts=True).adapting


def test_a_run_is_not_written_over_anything(tmp_path):
    (tmp_path / "file").write_text("x")
    for folder, message in (
        (tmp_path / "file" / "run", "file is not a writable folder"),
        (tmp_path / "file", "already exists; choose another name"),
        (tmp_path, "already exists; choose another name"),
    ):
        with pytest.raises(InputError, match=message):
            check_free(folder)
    check_free(tmp_path / "new" / "run")


def test_several_processes_need_a_named_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(InputError, match="several processes need one folder: name it with -o RUN"):
        train("track_circle", steps=100)
    monkeypatch.setenv("RANK", "1")  # which leaves it to the first one to look at the folder
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    with pytest.raises(InputError, match="unknown logger 'x'"):
        train("track_circle", "full", steps=100, logger="x")
    monkeypatch.setenv("RANK", "0")
    with pytest.raises(InputError, match="already exists"):
        train("track_circle", "full", steps=100, logger="x")
    assert [path.name for path in tmp_path.iterdir()] == ["full"]


@pytest.mark.parametrize(
    ("variables", "gpus", "message"),
    [
        ({"WORLD_SIZE": "two"}, 0, "^WORLD_SIZE is 'two', expected a whole number; start several"),
        (
            {"WORLD_SIZE": "2"},
            0,
            "^WORLD_SIZE is 2, but the processes do not find each other .*RANK",
        ),
        ({"WORLD_SIZE": "2", "LOCAL_RANK": "x"}, 0, "^LOCAL_RANK is 'x', expected a whole number"),
        (
            {"WORLD_SIZE": "3", "LOCAL_RANK": "2"},
            2,
            "^process 3 of this machine has no GPU .*finds 2",
        ),
    ],
)
def test_processes_that_torchrun_did_not_start_are_one_line(
    variables, gpus, message, tmp_path, monkeypatch
):
    for name in ("RANK", "LOCAL_RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT"):
        monkeypatch.delenv(name, raising=False)
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpus > 0)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    with pytest.raises(InputError, match=message) as error:
        train("track_circle", tmp_path / "run", steps=100, device="cuda" if gpus else "cpu")
    assert "\n" not in str(error.value)
    assert not list(tmp_path.iterdir())


def test_damaged_runs_are_refused(packaged, tmp_path):
    copy = tmp_path / "run"
    shutil.copytree(packaged, copy)
    config = json.loads((copy / "config.json").read_text())
    for bad in ([], config | {"format": "0"}, {"format": config["format"]}):
        (copy / "config.json").write_text(json.dumps(bad))
        with pytest.raises(InputError, match="not a training run of format"):
            RunFolder(copy)
    (copy / "config.json").write_text(json.dumps(config))
    run = RunFolder(copy)
    with pytest.raises(InputError, match="there is no such checkpoint yet; continue with"):
        run.load("middle")
    run.save("best", [1])
    with pytest.raises(InputError, match=r"damaged checkpoint \(no table in it\); train it again"):
        run.load("best")
    with zipfile.ZipFile(run.checkpoint("best"), "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data.pkl", b"\0" * 10**5)
    with pytest.raises(InputError, match="its parts claim more bytes than the file has"):
        run.load("best")


def test_a_policy_of_other_agents_or_observations_is_refused(packaged):
    run = RunFolder(packaged)
    with pytest.raises(InputError, match=r"with agents .*; task 'track_circle' has arm"):
        check_fits(run, track_circle(SHORT))
    task = run.task()
    agent = next(iter(run.agents))
    run.agents[agent] = run.agents[agent] | {"observation": 7}
    with pytest.raises(InputError, match=f"where '{agent}' has .*7.*; in task '{task.name}' as"):
        check_fits(run, task)


def test_a_short_training_says_why_it_did_not_come_far(packaged):
    def said(**best) -> str:
        return shortfall(TrainedRun(packaged, Result(True, 100, 1.0, 1.0, best), True))

    assert said(success=1.0) == ""
    assert "succeed in 50% of the episodes; train a new run with more --steps (" in said(
        success=0.5
    )
    assert said(error_mm=1e-6) == ""
    assert "its error of 9 mm is above that of the arm model (" in said(error_mm=9.0)
    assert "no error could be measured in its evaluations" in said(error_mm=float("nan"))


def test_no_longer_training_is_advised_where_the_path_is_out_of_reach(packaged, monkeypatch):
    far = track_circle(TrackConfig(FollowConfig(size_mm=500.0)))
    monkeypatch.setattr("surgisoft.agents.run_folder.RunFolder.task", lambda self: far)
    best = {"error_mm": 250.0}
    told = shortfall(TrainedRun(packaged, Result(True, 100, 1.0, 1.0, best), True))
    assert "% of the path of track_circle is out of the arm's reach" in told
    assert "make the path smaller (size_mm) or move its centre" in told
    assert "more --steps" not in told


def test_an_unknown_policy_names_those_of_the_package():
    with pytest.raises(InputError, match=r"known are random, ring, .*did you mean 'ring'"):
        check_policy("rung")


def test_a_logger_needs_its_library(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match="wandb is not installed; pip install wandb"):
        check_logger("wandb")
    with pytest.raises(InputError, match="unknown logger 'paper'"):
        check_logger("paper")


class Writer:
    """What rsl-rl's writers do, kept in place of sent."""

    def __init__(self, folder: str, project_name: str):
        self.begun = (folder, project_name)

    def store_config(self, config, preset):
        self.preset = preset

    def add_scalar(self, tag, value, step):
        self.added = (tag, value, step)


@pytest.mark.parametrize("name", ["wandb", "neptune"])
def test_services_get_the_name_of_the_run_and_its_preset(name, tmp_path, monkeypatch):
    """Stand-ins for the libraries, which need an account."""
    made = []

    def kept(*given, **named):
        made.append(Writer(*given, **named))
        return made[-1]

    service = SimpleNamespace(run=SimpleNamespace(name="random"))
    module = SimpleNamespace(WandbLogWriter=kept, NeptuneLogWriter=kept, wandb=service)
    import rsl_rl.utils

    monkeypatch.setitem(sys.modules, f"rsl_rl.utils.{name}_log_writer", module)
    monkeypatch.setattr(rsl_rl.utils, f"{name}_log_writer", module, raising=False)
    writer = open_writer(name, tmp_path / "ring", plan(), 0)
    (one,) = made
    last = "tensorboard" if name == "wandb" else "ring"
    assert (Path(one.begun[0]).name, one.begun[1]) == (last, "surgisoft")
    assert (one.preset["preset"], one.preset["rollout"]) == ("fast", Preset().rollout)
    assert service.run.name == ("ring" if name == "wandb" else "random")
    writer.add_scalar("error_mm", 0.5, 3)
    assert one.added == ("error_mm", 0.5, 3)
    monkeypatch.setattr(module, "WandbLogWriter", lambda *_, **__: 1 / 0)
    monkeypatch.setattr(module, "NeptuneLogWriter", lambda *_, **__: 1 / 0)
    with pytest.raises(LoggerFailed, match=f"--logger {name}: cannot be opened: division by zero"):
        open_writer(name, tmp_path / "ring", plan(), 0)


class Newtons(OwnRig):
    """A rig whose commands are forces."""

    def __init__(self, port: str):
        super().__init__(port)
        self.unit = "N"


def test_tasks_and_rigs_that_do_not_fit_are_one_line(packaged, tmp_path):
    with pytest.raises(InputError, match="arm 'arm' is commanded in kPa, the rig in N"):
        on_rig(track_circle(SHORT), build=lambda *_: Newtons("x"))
    moved = on_rig(track_circle(SHORT), RigConfig(settle_s=0.05))
    with pytest.raises(InputError, match="arm 'arm' is on a rig already, expected a simulated arm"):
        on_rig(moved)
    linear = {"arm": torch.nn.Linear(1, 3)}
    with pytest.raises(InputError, match="arm 'arm' is on a rig, expected a simulated arm; build"):
        ControllerGraph(moved, linear)

    class Silent(CircleAblation):
        signals = ()

    with pytest.raises(InputError, match="observes its scene and does not state what a controller"):
        ControllerGraph(Silent(), {})
    (tmp_path / "file").touch()
    with pytest.raises(
        InputError, match=r"already exists, without policy\.json; choose another name"
    ):
        export(None, tmp_path)


def about(arms=("one",), signals=()) -> dict:
    """What `policy.json` says of a controller, of arms with two chambers and one key point."""
    return {
        "controller": {
            "arms": [{"name": name, "chambers": 2, "key_points": 1} for name in arms],
            "state": {
                "size": 3,
                "leaves": [{"name": "place", "shape": [3], "first": 0, "last": 3}],
                "initial": [0.0, 0.0, 0.0],
            },
            "signals": list(signals),
            "goal": {},
            "outputs": ["next_state", *(f"{name}_command_kPa" for name in arms)],
        }
    }


def test_the_runner_names_what_a_measurement_lacks(tmp_path):
    phase = {"name": "phase", "default": None, "optional": False, "meaning": "phase of breathing"}
    phase |= {"unit": "-", "low": 0.0, "high": 1.0}
    (tmp_path / "policy.json").write_text(json.dumps({"controller": None, "note": "it branches"}))
    with pytest.raises(ValueError, match=r"policy\.json: has no controller, it branches"):
        Controller(tmp_path)
    given: list = []

    def answer(inputs):
        given.append(inputs)
        return [inputs["state"] + 1.0, np.array([[1.0, 2.0]]), np.array([[3.0, 4.0]])]

    two = Controller.of(about(("one", "two"), [phase]), answer)
    rest, points = {"one": [0.0, 0.0], "two": [0.0, 0.0]}, np.zeros((1, 3))
    both = {"one": points, "two": points}
    for pressure, seen, dt_s, signals, message in (
        (rest, both, float("nan"), {"phase": 0.1}, "dt_s is nan, expected 0 s or more"),
        (rest, both, 0.1, {"phse": 0.1}, "signal 'phse' is not known, expected phase"),
        (rest, both, 0.1, {}, "signal 'phase' is missing: phase of breathing"),
        (rest, both, 0.1, {"phase": 2.0}, "signal 'phase' is 2, expected 0 to 1: phase of breath"),
        ({"one": [0.0, 0.0]}, both, 0.1, {}, "pressure_kPa: arm 'two' is missing, got one"),
        (rest, points, 0.1, {}, "key_points_mm: expected a dict with the arms one, two"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            two.observe(pressure, seen, rest, dt_s, **signals)
    two.observe(rest, both, rest, 0.1, phase=0.25)
    assert given[-1]["phase"].tolist() == [0.25]
    assert given[-1]["two_pressure_kPa"].tolist() == [[0.0, 0.0]]


def test_an_engine_that_is_not_installed_is_named(packaged, tmp_path, monkeypatch):
    said = about()
    said["controller"] |= {"onnx": "controller.onnx", "torch": "controller.pt"}
    (tmp_path / "policy.json").write_text(json.dumps(said))
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(ImportError, match=r"onnx \(asked for: onnxruntime\)"):
        Controller(tmp_path, "onnxruntime")


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_device_that_is_not_there_is_one_line():
    for device, message in (
        ("cuda", "--device 'cuda': PyTorch finds no GPU; use --device cpu"),
        ("tpu", "--device 'tpu': expected cpu or cuda"),
    ):
        with pytest.raises(InputError, match=message), processes(device):
            pass


def test_a_run_of_other_agents_is_one_error_and_no_warning():
    told: list[str] = []
    with pytest.raises(InputError, match="agents laser, endoscope; task 'track_circle' has arm"):
        EvaluationRequest(("ring",), "track_circle", config=SHORT).resolved(told.append)
    assert not told


def test_a_run_of_another_task_is_told_of(tmp_path):
    """Of one with the same agents, observations and actions, which can act here."""
    plan = TrainingRequest("track_square").plan()
    square = make_task("track_square")
    create_run(tmp_path / "run", plan, square, agent_sizes(square), 1)
    told: list[str] = []
    request = EvaluationRequest((str(tmp_path / "run"),), "track_circle")
    task, _ = request.resolved(told.append)
    assert task.name == "track_circle"
    assert len(told) == 1
    assert re.search(r"run was trained on \w+, not on track_circle$", told[0])
