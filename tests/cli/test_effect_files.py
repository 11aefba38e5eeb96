"""A model that holds a user-defined effect opens in every command, and only with its file named."""

import json
import shutil
from pathlib import Path

import pytest
import torch

from surgisoft.cli import command_line, run
from surgisoft.errors import InputError
from surgisoft.experiments import run as experiment_run
from surgisoft.experiments.run import open_results, run_experiment
from surgisoft.experiments.spec import load_experiment
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import save_recording
from surgisoft.measurement.recordings.lerobot import save_lerobot
from surgisoft.rig import VirtualRig
from surgisoft.scene.meshio import write_ply
from surgisoft.surrogate.checkpoint import default_arm, load_model, save_model
from surgisoft.surrogate.effects import make_effect, register_effect_file, user_defined
from surgisoft.surrogate.model import ArmModel
from tests.few_effects import few_effects
from tests.scene.shapes import ball
from tests.surrogate.effects.test_user_defined import EXAMPLE

ROOT = Path(__file__).resolve().parents[2]

EXPERIMENT = """
name = "follow"
scenario = "track_circle"
repeats = 2
together = 1

[limits]
time_s = 0.3

[[phases]]
name = "go"
arm = "policy"
timeout_s = 0.3
on_timeout = "go on"

[[cases]]
name = "user"
policy = "scripted"
arm = "arm"
"""

IN_SCENE = """
name = "short"
scene = "scene"
repeats = 2
together = 1

[limits]
time_s = 0.3

[[phases]]
name = "look"
endoscope = "policy"
timeout_s = 0.3
on_timeout = "go on"

[[cases]]
name = "user"
policy = "scripted"
"""

NO_MODEL = {
    "demo": "shows the default arm",
    "recording": "reads recordings",
    "rig list": "lists rigs and their options",
    "replay": "shows what was recorded",
    "experiment list": "reads experiment files",
}
"""Commands that open no arm model, and why."""

COMMANDS = {
    "collect": "collect few.csv --rig tests.rig.own_rig:OwnRig:port=x "
    "--arm arm --preflight -o few.parquet",
    "import": "import dataset -o imported.parquet --model arm",
    "compare": "compare arm bench.parquet",
    "diagnose": "diagnose arm bench.parquet",
    "amend": "amend arm --effect creep --data bench.parquet -o amended --anyway",
    "improve": "improve arm bench.parquet --max-effects 1 -o improved",
    "next-experiment": "next-experiment arm --between creep line_lag --minutes 6",
    "run": "run mixed --model arm --any-model --minutes 1 --clean 40 --clock simulated -o r.csv",
    "rig check": "rig check virtual --model arm",
    "train": "train --task track_circle --arm arm --envs 8 --steps 64 -o run",
    "export": "export arm -o exported",
    "evaluate": "evaluate random --task track_circle --arm arm --episodes 1",
    "scene new": "scene new ball.ply --unit mm --arm arm -o placed",
    "scene check": "scene check scene",
    "scene show": "scene show scene --save view.rrd",
    "experiment check": "experiment check short.toml",
    "experiment run": "experiment run follow.toml --processes 2 --no-replays -o results --force",
}
"""What opens a model that holds the effect of the documentation, by command."""

NEXT = {"compare": 1, "amend": 1, "train": 1}
"""Lines with the command to run next that these always print."""


@pytest.fixture(scope="module", autouse=True)
def _few_effects():
    with few_effects("creep", "line_lag", "payload"):
        yield


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A default arm with the documentation's effect alone, a recording, a scene and experiments."""
    folder = tmp_path_factory.mktemp("lab")
    (folder / "slack.py").write_text(EXAMPLE)
    register_effect_file(folder / "slack.py")
    arm = default_arm()
    effect = make_effect("slack", arm.facts)
    effect.loss.data.fill_(0.3)
    with_slack = ArmModel(arm.spec, arm.network, {"slack": effect}, arm.rest_mm, arm.validation)
    save_model(with_slack, folder / "arm")
    user_defined.FILES.clear()
    rig = VirtualRig(0, take=7)
    recording = rig.record(make_protocol("mixed", rig.limits, 600, seed=2))[0]
    save_recording(recording, folder / "bench.parquet")
    save_lerobot([recording], folder / "dataset", "Drive the soft arm.", None)
    (folder / "few.csv").write_text("t_s,c1_kPa,c2_kPa,c3_kPa\n0,0,0,0\n1,5,0,0\n")
    write_ply(ball(60.0, 2), folder / "ball.ply")
    shutil.copytree(ROOT / "scenes" / "phantom_liver", folder / "scene")
    scene = (folder / "scene" / "scene.toml").read_text()
    (folder / "scene" / "scene.toml").write_text(scene.replace('"default"', '"../arm"'))
    (folder / "short.toml").write_text(IN_SCENE)
    (folder / "follow.toml").write_text(EXPERIMENT)
    return folder


@pytest.fixture(autouse=True)
def _in_the_lab_without_files(lab, monkeypatch):
    monkeypatch.setattr(user_defined, "FILES", {})
    monkeypatch.chdir(lab)


def _leaves(path=(), command=None):
    """(name, command) of every command but the long studies."""
    command = command or command_line()
    if not hasattr(command, "commands"):
        yield " ".join(path), command
        return
    for name, inner in command.commands.items():
        if name != "benchmark":
            yield from _leaves((*path, name), inner)


def test_every_command_that_opens_a_model_has_the_option():
    having = {
        name
        for name, command in _leaves()
        if any("--effect-file" in option.opts for option in command.params)
    }
    assert having == {name for name, _ in _leaves()} - set(NO_MODEL)
    assert having == set(COMMANDS) | {"fit"}


@pytest.mark.parametrize("name", ["compare", "experiment run", "fit", "scene check", "train"])
def test_the_help_names_both_names_of_the_option(name, capsys, monkeypatch):
    """Also where the column of the names has no room for the second one: 80 columns."""
    monkeypatch.setenv("COLUMNS", "80")
    assert run([*name.split(), "--help"]) == 0
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= 80
    assert "--effect-file" in shown
    assert "--model-code " in shown


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_opens_the_model_only_with_its_file(name, capsys, monkeypatch):
    asked, pool = [], experiment_run.workers

    def one_worker(processes, *given):
        asked.append(processes)
        return pool(1, *given)

    monkeypatch.setattr(experiment_run, "workers", one_worker)
    arguments = COMMANDS[name].split()
    assert run(arguments) == 2
    error = capsys.readouterr().err
    assert "its effect 'slack' is code in" in error
    assert "--effect-file" in error
    assert not user_defined.FILES
    code = run([*arguments, "--effect-file", "slack.py"])
    refused = {"amend": (0, 1), "improve": (0, 1), "scene check": (0, 1)}
    printed = capsys.readouterr()
    assert code in refused.get(name, (0,)), printed.err
    following = [
        line for line in printed.out.splitlines() if line.startswith("next") and "surgisoft" in line
    ]
    assert len(following) == NEXT.get(name, len(following))
    assert all(line.endswith(" --effect-file slack.py") for line in following), following
    assert asked == ([2] if name == "experiment run" else [])
    if name == "experiment run":
        same_rows_in_one_process()


def same_rows_in_one_process():
    """The process of `experiment run`, which needs the file too, gave the rows of this one."""
    both = sorted(Path("results", "rows").iterdir())
    assert len(both) == 2, "two episodes, each one a block of work"
    rows = [json.loads(path.read_text()) for path in both]
    spec, alone = load_experiment("follow.toml"), Path("alone")
    open_results(spec, alone)
    assert run_experiment(spec, alone) == rows
    assert rows[0] != rows[1]


def test_amend_takes_the_file_as_the_effect_that_the_model_has(capsys):
    command = "amend arm --effect slack.py --data bench.parquet -o anew --anyway"
    assert run(command.split()) in (0, 1)
    assert "slack: the model had this effect already" in capsys.readouterr().out


def test_fit_takes_the_file_in_both_ways():
    rest = "--epochs 2 --widths 8,8 --inputs pressure --prior none"
    assert run(f"fit bench.parquet -o one --effects slack.py {rest}".split()) == 0
    user_defined.FILES.clear()
    more = f"fit bench.parquet -o other --effects slack --effect-file slack.py {rest}"
    assert run(more.split()) == 0


def test_python_names_the_file_when_it_loads():
    with pytest.raises(InputError, match=r"load_model\(folder, effect_files="):
        load_model("arm")
    model = load_model("arm", effect_files=["slack.py"])
    assert torch.equal(model.effects["slack"].loss, torch.tensor([0.3]))


def test_a_run_keeps_an_arm_that_needs_the_file(tmp_path, capsys):
    """Training stores the arm; evaluating and resuming that run need the file again."""
    train = f"train --task track_circle --arm arm --envs 8 --steps 64 -o {tmp_path / 'run'}"
    assert run([*train.split(), "--effect-file", "slack.py"]) == 0
    evaluate = f"evaluate {tmp_path / 'run'} --episodes 1".split()
    user_defined.FILES.clear()
    assert run(evaluate) == 2
    assert "--effect-file" in capsys.readouterr().err
    assert run([*evaluate, "--effect-file", "slack.py"]) == 0


def test_a_missing_file_is_one_line(capsys):
    assert run(["compare", "arm", "bench.parquet", "--effect-file", "nothing.py"]) == 2
    error = capsys.readouterr().err
    assert "nothing.py: no such file" in error
    assert error.count("\n") == 1
