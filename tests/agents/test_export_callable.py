"""Exported policies whose arm model calls Python code: NumPy code that calls it, too."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from surgisoft.agents import export as exporting
from surgisoft.agents.controller_runner import Controller
from surgisoft.agents.distributed import Processes
from surgisoft.agents.learned import LearnedPolicy
from surgisoft.agents.presets import Plan
from surgisoft.agents.rig_check import check_on_rig
from surgisoft.agents.training import train_new
from surgisoft.cli import run as surgisoft
from surgisoft.surrogate.callables import named
from surgisoft.surrogate.checkpoint import save_model
from surgisoft.tasks.registry import config_of, with_fields
from tests.agents.test_export import AGREE_KPA, AGREE_MM, DRIVE, SHORT, STRANGE, TINY
from tests.surrogate.test_export_callable import MODELS, wrapped


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """A policy of an amended callable that is stepped, and the working folder of its export."""
    folder = tmp_path_factory.mktemp("callable")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(named, "NAMED", {})
        patch.setattr(sys, "path", [*sys.path])
        patch.setattr(exporting, "CHECKED", 8)  # three after the episode began
        patch.chdir(folder)
        Path("arms.py").write_text(MODELS)
        save_model(wrapped("stepped", ("hysteresis", "payload")), "amended")
        fields = {**SHORT["track_circle"], "arm": "amended"}
        config = with_fields(config_of("track_circle"), **fields)
        plan = Plan("track_circle", config, "fast", TINY, steps=64)
        train_new(folder / "run", plan, Processes(), torch.device("cpu"))
        command = ["export", "run", "-o", "out", "--model-code", "arms.py:stepped"]
        assert surgisoft(command) == 0
        yield folder, LearnedPolicy(folder / "run")


def test_the_controller_does_on_the_rig_what_evaluate_does(exported, monkeypatch):
    """To 1e-4 mm, on a robot that the model does not know, from measurements alone."""
    folder, policy = exported
    monkeypatch.chdir(folder)
    assert sorted(file.name for file in Path("out").iterdir()) == [
        *("arm.onnx", "arm.pt", "controller.py", "controller_code.py", "policy.json"),
    ]
    about = json.loads(Path("out/policy.json").read_text())["controller"]
    assert about["python"] == "controller_code.py"
    assert [each["name"] for each in about["model_code"]] == ["arms.py:stepped"]
    found = check_on_rig(Controller("out"), policy.run.task(), policy, STRANGE, seed=4)
    assert found.decisions == 25
    assert found.closed.points_mm < AGREE_MM
    assert found.closed.commands_kPa < AGREE_KPA
    with pytest.raises(ValueError, match="engine 'onnx' is not known, expected numpy"):
        Controller("out", "onnx")


def test_it_needs_numpy_and_the_callable_alone(exported):
    """Two decisions in four samples, where neither surgisoft nor any engine of graphs is there."""
    folder, policy = exported
    random, rest = np.random.default_rng(0), policy.run.task().arm.model.rest_mm.numpy()
    rows = []
    for _ in range(8):
        points = rest + random.standard_normal(rest.shape)
        pressure = 20.0 + 3.0 * random.standard_normal(3)
        rows.append([pressure.tolist(), points.tolist(), [20.0, 39.5, 0.2]])
    (folder / "out" / "rows.json").write_text(json.dumps(rows))
    lacking = "import sys; sys.modules.update(dict.fromkeys(('onnx', 'onnxruntime', 'torch')))\n"
    code = DRIVE.replace(', "onnx"', "")
    assert code != DRIVE
    (folder / "out" / "arms.py").write_text(MODELS)
    done = subprocess.run(
        [sys.executable, "-c", lacking + code],
        capture_output=True,
        text=True,
        check=True,
        cwd=folder / "out",
        env={k: v for k, v in os.environ.items() if k != "PYTHONPATH"},
    )
    commands, steps, seen = json.loads(done.stdout)
    assert steps == 2
    assert commands[0] == commands[1] != commands[2]
    assert np.abs(np.subtract(commands[0], [20.0, 39.5, 0.2])).max() <= 3.0
    assert np.isfinite(seen).all()
