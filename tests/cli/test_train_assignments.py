"""`surgisoft train FIELD=VALUE`: what is changed, what is said, and where the curves go."""

import json
import os
import subprocess
import sys
from dataclasses import dataclass, field
from types import ModuleType

import pytest

from surgisoft.agents.training import Result
from surgisoft.agents.training_request import TrainedRun, shortfall
from surgisoft.cli import run
from surgisoft.config import assignments, differences, field_names
from surgisoft.errors import InputError


def test_values_are_toml_or_text():
    given = ["a.b=2", "a.c=[1, 2.5]", "on=true", "name=ring", 'quoted="x y"', "a.b=3"]
    assert assignments(given) == {
        "a": {"b": 3, "c": [1, 2.5]},
        "on": True,
        "name": "ring",
        "quoted": "x y",
    }
    for wrong in ("size", "=3", "a..b=1", "a b=2"):
        with pytest.raises(InputError, match="expected FIELD=VALUE"):
            assignments([wrong])


def test_differences_name_the_field():
    @dataclass(frozen=True)
    class Inner:
        size: float = 1.0
        name: str = "x"

    @dataclass(frozen=True)
    class Outer:
        inner: Inner = field(default_factory=Inner)
        count: int = 2

    assert differences(Outer(), Outer(Inner(3.0), 5)) == ["inner.size: 1.0 -> 3.0", "count: 2 -> 5"]
    assert differences(Outer(), Outer()) == []
    assert field_names(Outer()) == ["inner.size", "inner.name", "count"]


def test_a_training_with_assignments_and_a_service(tmp_path, monkeypatch, capsys):
    """The run has the values, the diff is printed, and rsl-rl's writer sends the curves."""
    from rsl_rl.utils import wandb_log_writer

    sent, ended = {}, []
    service = ModuleType("wandb")
    service.init = lambda **given: sent.update(given)
    service.log = lambda values, step: sent.setdefault("values", {}).update(values)
    service.config = dict_like = ModuleType("config")
    dict_like.update = lambda values: sent.update(values)
    service.finish = lambda: ended.append(True)
    service.run = ModuleType("run of wandb")
    monkeypatch.setattr(wandb_log_writer, "wandb", service)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: service)
    folder = tmp_path / "run"
    words = "task=track_circle follow.size_mm=12 ppo.gamma=0.95 seed=3 envs=8 steps=96"
    assert run(["train", *words.split(), "--logger", "wandb", "-o", str(folder)]) == 0
    printed = capsys.readouterr()
    assert "follow.size_mm: 20.0 -> 12" in printed.out
    assert "ppo.gamma: 0.6 -> 0.95" in printed.out
    config = json.loads((folder / "config.json").read_text())
    assert config["task_config"]["follow"]["size_mm"] == 12
    assert config["hyper_parameters"]["gamma"] == 0.95
    assert config["seed"] == 3
    assert sent["project"] == "surgisoft"
    assert sent["env_cfg"]["follow"]["size_mm"] == 12
    assert sent["train_cfg"]["gamma"] == 0.95
    assert any(name.startswith("evaluation/") for name in sent["values"])
    assert ended == [True]
    assert service.run.name == "run", "not after the folder of TensorBoard's files"
    assert [*(folder / "tensorboard").glob("events*")]
    assert "did not converge" in printed.err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("task=track_circle follow.sise_mm=3", "did you mean 'size_mm'"),
        ("task=track_circle ppo.gama=3", "did you mean 'gamma'"),
        ("task=track_circle seed=a", "expected an integer"),
        ("task=track_circle --task track_circle", "give one of them"),
        ("task=track_circle --logger nowhere", "unknown logger"),
        ("task=track_circle size", "expected FIELD=VALUE"),
        ("task=track_circle ppo.learning_rate=-1", "ppo.learning_rate: got integer -1; expected a"),
        ("task=track_circle ppo.epochs=0", "command line: ppo.epochs: got integer 0; expected an"),
        ("task=circle_ablation world.endoscope_images.images=rgb", "see vectors only: leave it"),
    ],
)
def test_a_wrong_assignment_is_one_line(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for command in ("make_task", "create_run"):  # neither is begun
        monkeypatch.delattr(f"surgisoft.agents.training.{command}")
    assert run(["train", *words.split()]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_steps_that_are_rounded_up_to_whole_updates_are_told(tmp_path, monkeypatch, capsys):
    """An update takes 32 x 12 steps: 10 become 384, and 384 stay."""
    monkeypatch.chdir(tmp_path)
    short = "--task track_circle --envs 32 ppo.evaluation_episodes=2 ppo.batches=2"
    line = "10 steps are rounded up to 384: an update takes 12 steps of each of 32 episodes"
    for steps, told in ((10, True), (384, False)):
        assert run(["train", *short.split(), "--steps", str(steps), "-o", f"r{steps}"]) == 0
        printed = capsys.readouterr().out
        assert (line in printed) == told
        assert ("rounded" in printed) == told
        assert f"wrote r{steps}: 384 steps in" in printed


def test_success_decides_how_far_a_training_came(tmp_path):
    def trained(best):
        return TrainedRun(tmp_path, Result(True, 10, 1.0, 1.0, best), True)

    assert shortfall(trained({"success": 1.0, "error_mm": 5.0})) == ""
    assert shortfall(trained(None)) == ""


def test_the_shell_completes_fields():
    words = "surgisoft train task=track_circle follow.weights.f"
    asked = {"_SURGISOFT_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": "3"}
    done = subprocess.run(
        [sys.executable, "-m", "surgisoft"],
        env=os.environ | asked,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.stdout.split() == ["follow.weights.fine="]
