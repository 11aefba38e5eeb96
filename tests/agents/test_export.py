"""Exported policies: read by other programs, with the same actions."""

import json

import numpy as np
import onnx
import pytest
import torch
from onnx.reference import ReferenceEvaluator

from surgisoft.agents.distributed import Processes
from surgisoft.agents.export import export
from surgisoft.agents.learned import LearnedPolicy
from surgisoft.agents.presets import Plan, Preset
from surgisoft.agents.training import train_new
from surgisoft.cli import run as surgisoft
from surgisoft.errors import InputError
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.registry import config_of

TINY = Preset(envs=4, rollout=8, epochs=1, batches=2, evaluate_every=9, evaluation_episodes=1)


@pytest.fixture(scope="module", params=[False, True], ids=["plain", "normalised"])
def policy(request, tmp_path_factory):
    preset = Preset(**{**vars(TINY), "normalise": request.param})
    folder = tmp_path_factory.mktemp("runs") / "run"
    plan = Plan("track_circle", config_of("track_circle"), "fast", preset, steps=64)
    train_new(folder, plan, Processes(), torch.device("cpu"))
    return LearnedPolicy(folder)


def seen_and_done(policy):
    """Observations (B, D) of real episodes, 20 times as large too, and the policy's actions."""
    task = policy.run.task()
    play = Episodes(task)
    state = play.seeded(5, 7)
    seen = play.observe(state)["arm"]
    seen = torch.cat((seen, 20.0 * seen))
    return seen, policy.act(task, state, {"arm": seen})["arm"].clone().numpy()


def test_other_programs_get_the_same_actions(policy, tmp_path):
    assert surgisoft(["export", str(policy.run.path), "-o", str(tmp_path / "out")]) == 0
    assert sorted(file.name for file in (tmp_path / "out").iterdir()) == [
        "arm.onnx",
        "arm.pt",
        "policy.json",
    ]
    seen, done = seen_and_done(policy)
    assert np.abs(done).max() > 1e-3
    onnx.checker.check_model(str(tmp_path / "out" / "arm.onnx"))
    session = ReferenceEvaluator(str(tmp_path / "out" / "arm.onnx"))
    script = torch.jit.load(str(tmp_path / "out" / "arm.pt"))
    for rows in (slice(None), slice(3, 4)):
        (answer,) = session.run(None, {"observation": seen[rows].numpy()})
        np.testing.assert_allclose(answer, done[rows], atol=1e-5)
        np.testing.assert_allclose(script(seen[rows]).numpy(), done[rows], atol=1e-5)
    about = json.loads((tmp_path / "out" / "policy.json").read_text())
    assert about["task"] == "track_circle"
    assert about["agents"]["arm"]["observation"] == seen_and_done(policy)[0].shape[1]
    with pytest.raises(InputError, match="already there"):
        export(policy, tmp_path / "out")


def test_command_refuses_a_folder_without_a_run(tmp_path, capsys):
    assert surgisoft(["export", str(tmp_path), "-o", str(tmp_path / "y")]) == 2
    assert "no training run" in capsys.readouterr().err
    assert not (tmp_path / "y").exists()
