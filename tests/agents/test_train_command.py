"""`surgisoft train` as one types it; several processes; every wrong turn in one line."""

import json
import re
import shutil
import signal
import socket
import sys
from importlib.machinery import ModuleSpec
from types import SimpleNamespace

import pytest
import torch

from surgisoft.agents.run_folder import LAST, RunFolder
from surgisoft.agents.training_request import TrainingRequest
from surgisoft.cli import run as surgisoft
from surgisoft.errors import InputError
from surgisoft.replay.show import find_replay
from surgisoft.scene.spec import PHANTOM
from surgisoft.tasks.episodes.file import load_episode

SMALL = ["--task", "track_circle", "--envs", "16", "--steps", "400"]


def test_trains_and_prints_the_result(tmp_path, capsys):
    folder, file = tmp_path / "run", tmp_path / "task.toml"
    file.write_text("[follow]\nsize_mm = 12.0\n[world.randomisation]\nstart_kPa = 1.0\n")
    code = surgisoft(["train", *SMALL, "--seed", "7", "--config", str(file), "-o", str(folder)])
    assert code == 0
    assert f"wrote {folder}: 576 steps" in capsys.readouterr().out
    config = json.loads((folder / "config.json").read_text())
    assert config["seed"] == 7
    assert config["hyper_parameters"]["envs"] == 16
    assert config["arms"]["arm"]["effects"] == ["hysteresis"]
    assert set(config["versions"]) == {"surgisoft", "python", "torch", "rsl-rl-lib"}
    task = RunFolder(folder).task()
    assert task.config.follow.size_mm == 12.0
    assert task.world.config.randomisation.start_kPa == 1.0
    rows = [json.loads(row) for row in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [row["steps"] for row in rows] == [192, 384, 576]
    assert [*(folder / "tensorboard").glob("events*")]
    log = load_episode(find_replay(folder))
    assert (log.task, log.policy) == ("track_circle", "learned")
    assert len(log.time_s) > 100
    assert surgisoft(["train", "--resume", str(folder)]) == 0
    capsys.readouterr()
    assert surgisoft(["train", "--resume", str(folder), "--steps", "1000"]) == 2
    assert "cannot go on to 1,000 steps" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "--task is missing"),
        (["--task", "nope"], "unknown task 'nope': known are"),
        ([*SMALL, "--preset", "nope"], "unknown preset 'nope': known are fast, paper"),
        ([*SMALL, "--scene", "x"], "this task has no scene"),
        ([*SMALL, "--arm", "nowhere"], "no arm model there"),
        (["--task", "track_circle", "--minutes", "-1"], "minutes is -1"),
        ([*SMALL, "--minutes", "1"], "give only one of them"),
        ([*SMALL, "--device", "abacus"], "abacus"),
        ([*SMALL, "--config", "nofile.toml"], "there is no such file"),
        (["--resume", "nowhere"], "no training run there"),
        (["--resume", "nowhere", "--seed", "1"], "leave out --seed"),
        (
            ["--resume", "nowhere", "follow.size_mm=12", "ppo.gamma=0.9", "seed=3"],
            "leave out --seed, ppo.NAME=VALUE, FIELD=VALUE",
        ),
        (["--task", "track_circle", "--envs", "0"], "--envs"),
    ],
)
def test_wrong_turns_are_one_line_and_leave_nothing(arguments, said, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert surgisoft(["train", *arguments]) == 2
    error = capsys.readouterr().err.strip()
    assert said in error
    assert len(error.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_a_bad_field_is_reported_with_its_line(tmp_path, capsys):
    file = tmp_path / "task.toml"
    file.write_text("[follow]\nsize = 12.0\n")
    code = surgisoft(["train", *SMALL, "--config", str(file), "-o", str(tmp_path / "run")])
    assert code == 2
    assert f"{file}:2: follow.size: unknown field" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


def torchrun(*arguments):
    """What `torchrun` does, in this process; handlers of signals that it sets are taken back."""
    from torch.distributed.run import main

    before = {each: signal.getsignal(each) for each in signal.valid_signals()}
    try:
        main(arguments)
    finally:
        for each, handler in before.items():
            if signal.getsignal(each) != handler:
                signal.signal(each, handler)


def test_two_processes_learn_one_policy(tmp_path):
    """torchrun over gloo: gradients averaged, worlds different, resumed by as many."""
    folder = tmp_path / "run"
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]

    torchrun(
        "--nproc-per-node", "2", "--master-addr", "127.0.0.1", "--master-port", str(port),
        "-m", "surgisoft", "train", *SMALL, "follow.loop_s=2", "follow.approach_s=0.5",
        "-o", str(folder),
    )  # fmt: skip
    run = RunFolder(folder)
    saved = run.load(LAST)
    assert run.config["processes"] == 2
    assert saved["iteration"] == 2, "576 steps are two turns of two times 192"
    one, other = (process["world"] for process in saved["processes"])
    assert not all(torch.equal(a, b) for a, b in zip(one, other, strict=True))
    assert surgisoft(["train", "--resume", str(folder)]) == 2, "one process is not two"


def test_a_logger_that_cannot_be_opened_leaves_nothing(tmp_path, capsys, monkeypatch):
    """A stand-in for the library of a service that is not reached."""

    def unreached(_):
        raise ConnectionError("no server\nat localhost")

    library = SimpleNamespace(set_experiment=unreached, __spec__=ModuleSpec("mlflow", None))
    monkeypatch.setitem(sys.modules, "mlflow", library)
    folder = tmp_path / "run"
    assert surgisoft(["train", *SMALL, "--logger", "mlflow", "-o", str(folder)]) == 2
    said = capsys.readouterr().err.splitlines()
    assert said == ["surgisoft: error: --logger mlflow: cannot be opened: no server at localhost"]
    assert not folder.exists()


def test_a_beam_beyond_limits_or_too_weak_is_warned_of_before_the_training(
    tmp_path, capsys, monkeypatch
):
    """The training ends with its logger; what is said first is what counts here."""
    strict = tmp_path / "strict"
    shutil.copytree(PHANTOM, strict)
    file = strict / "scene.toml"
    file.write_text(re.sub(r"standoff_mm = .*", "standoff_mm = [36.0, 60.0]", file.read_text()))
    monkeypatch.setitem(sys.modules, "mlflow", None)
    given = ["--task", "circle_ablation", "--envs", "2", "--steps", "10", "--logger", "mlflow"]
    run = ["-o", str(tmp_path / "run")]
    for scene, warned in ((strict, True), (PHANTOM, False)):
        assert surgisoft(["train", *given, "--scene", str(scene), *run]) == 2
        said = capsys.readouterr().err
        assert ("mm long at the ring (standoff_mm: 36 to 60)" in said) == warned, said
    file.write_text(file.read_text().replace("power_w = 20.0", "power_w = 0.5"))
    assert surgisoft(["train", *given, "--scene", str(strict), *run]) == 2
    said = capsys.readouterr().err
    assert (
        "the beam of 0.5 W, exactly on its reference for 60 s (1.3 passes), gives at most" in said
    )


def test_hyper_parameters_count_together_with_the_episodes():
    """Two episodes of 12 steps are too few for the 16 minibatches of the task, not for two."""
    plan = TrainingRequest("track_circle", envs=2, ppo={"batches": 2}).plan()
    assert (plan.preset.envs, plan.preset.batches, plan.preset.rollout) == (2, 2, 12)
    assert TrainingRequest("track_circle", envs=2, ppo={"envs": 64}).plan().preset.envs == 64
    with pytest.raises(InputError, match="2 envs x 12 steps in 13 minibatches"):
        TrainingRequest("track_circle", envs=2, ppo={"batches": 13}).plan()
