"""Policies for other programs: ONNX and TorchScript, one file of each for an agent.

Input `observation` (B, D) float32 as the task gives it, output `action` (B, m) float32, change of
pressure in kPa, within the pumps' largest step; any batch.
"""

from __future__ import annotations

import contextlib
import io
import json
import logging
import warnings
from pathlib import Path

import torch

from surgisoft.agents.learned import LearnedPolicy
from surgisoft.agents.policy_network import ScaledActor
from surgisoft.errors import InputError

TOLERANCE = 1e-5
"""Largest accepted difference between actions of exported and original policy, kPa."""


def export(policy: LearnedPolicy, folder: Path) -> list[Path]:
    """Write `AGENT.onnx`, `AGENT.pt` and `policy.json`, each checked against the policy."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: already there; choose another name")
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for agent, actor in policy.actors.items():
        width = policy.run.agents[agent]["observation"]
        actor = actor.to("cpu")
        written.append(_torch_script(actor, width, folder / f"{agent}.pt"))
        written.append(_onnx(actor, width, folder / f"{agent}.onnx"))
    about = {
        "task": policy.run.config["task"],
        "checkpoint": policy.which,
        "iteration": policy.iteration,
        "input": "observation (B, D) float32",
        "output": "action (B, m) float32, change of pressure, kPa",
        "agents": policy.run.agents,
        "trained_with": policy.run.config["versions"],
    }
    (folder / "policy.json").write_text(json.dumps(about, indent=2) + "\n")
    return [*written, folder / "policy.json"]


def _torch_script(actor: ScaledActor, width: int, file: Path) -> Path:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        script = torch.jit.trace(actor, torch.zeros(2, width))
        script.save(str(file))
        again = torch.jit.load(str(file))
    _check(actor, width, lambda seen: again(seen), file)
    return file


def _onnx(actor: ScaledActor, width: int, file: Path) -> Path:
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        torch.onnx.export(
            actor,
            (torch.zeros(2, width),),
            str(file),
            input_names=["observation"],
            output_names=["action"],
            dynamic_shapes=({0: torch.export.Dim("batch")},),
            external_data=False,
            dynamo=True,
            verbose=False,
        )
    from onnx.reference import ReferenceEvaluator

    session = ReferenceEvaluator(str(file))
    _check(
        actor,
        width,
        lambda seen: torch.from_numpy(next(iter(session.run(None, {"observation": seen.numpy()})))),
        file,
    )
    return file


def _check(actor: ScaledActor, width: int, other, file: Path) -> None:
    """Compare on 64 observations far beyond what tasks give; delete the file if they differ."""
    seen = 3.0 * torch.randn(64, width, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        worst = (actor(seen) - other(seen)).abs().max().item()
    if not worst <= TOLERANCE:
        file.unlink()
        raise RuntimeError(f"{file}: actions differ by {worst:.2g} kPa from the policy's")
