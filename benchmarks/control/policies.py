"""Policies of benchmarks: trained into a folder once, resumed if interrupted, and rolled out."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from surgisoft.agents.distributed import Processes
from surgisoft.agents.evaluate import evaluate
from surgisoft.agents.on_rig import RigConfig, on_rig
from surgisoft.agents.policies import open_policy
from surgisoft.agents.presets import Plan, preset_for, steps_for
from surgisoft.agents.run_folder import RunFolder
from surgisoft.agents.training import resume, train_new
from surgisoft.errors import InputError
from surgisoft.progress import Progress, noted, silent
from surgisoft.tasks.registry import config_of, make_task, with_fields


@dataclass(frozen=True)
class Cost:
    """Cost of a training run."""

    steps: int
    """Steps over all episodes."""
    wall_s: float
    """Wall time, s."""
    cpu_s: float
    """Time on a processor, s."""

    @property
    def steps_per_s(self) -> float:
        """Steps a second of processor time."""
        return self.steps / self.cpu_s


def plan_of(
    task: str,
    seed: int,
    steps: int | None = None,
    arm: Path | None = None,
    preset: str = "fast",
) -> Plan:
    """Plan of a training run, by default with the task's number of steps and the default arm."""
    config = config_of(task)
    if arm is not None:
        config = with_fields(config, arm=str(arm))
    own = steps_for(preset, task) if steps is None else steps
    return Plan(task, config, preset, preset_for(preset, task), own, seed=seed)


def trained(folder: Path, plan: Plan, report: Progress) -> RunFolder:
    """The training run of a plan: that in the folder, completed if interrupted, or a new one."""
    own, device = Processes(), torch.device("cpu")

    def tell(p) -> None:
        report(p.share, 1.0, f"{p.steps:,} steps, {p.steps_per_s:,.0f}/s")

    if not (folder / "config.json").is_file():
        result = train_new(folder, plan, own, device, tell)
    else:
        _check_same(RunFolder(folder), plan)
        if _finished(folder, plan):
            report(1.0, 1.0, "already trained")
            return RunFolder(folder)
        result = resume(folder, own, device, tell)
    if not result.done:
        raise KeyboardInterrupt
    return RunFolder(folder)


def cost(run: RunFolder) -> Cost:
    """Cost of a run so far."""
    last = _rows(run.path)[-1]
    return Cost(last["steps"], last["wall_s"], last["cpu_s"])


def evaluated(
    task: str,
    policy: str,
    episodes: int,
    seed: int,
    rig: RigConfig | None = None,
    arm: Path | None = None,
    report: Progress = silent,
) -> dict[str, dict]:
    """Evaluation of a policy: name with unit -> fields of `Summary`; contact is checked by FCL.

    policy: `scripted`, `random` or a run's folder. rig: None for simulation.
    """
    config = config_of(task)
    if arm is not None:
        config = with_fields(config, arm=str(arm))
    place = make_task(task, config)
    if rig is not None:
        place = on_rig(place, rig)
    opened = open_policy(policy, place)
    found = evaluate(place, policy, opened, episodes, seed, progress=noted(report, "rollout"))
    return found.to_json()["overall"]


def _check_same(run: RunFolder, plan: Plan) -> None:
    """Raise InputError where a folder holds a run of another plan."""
    came, hyper = run.config, json.loads(json.dumps(asdict(plan.preset)))
    for what, there, expected in (
        ("task", came["task"], plan.task),
        ("seed", came["seed"], plan.seed),
        ("steps", came["steps"], plan.steps),
        ("hyper-parameters", came["hyper_parameters"], hyper),
    ):
        if there != expected:
            raise InputError(
                f"{run.path}: its {what}: {there}, expected {expected}; choose another folder"
            )


def _rows(folder: Path) -> list[dict]:
    file = folder / "metrics.jsonl"
    text = file.read_text() if file.is_file() else ""
    lines = text.rpartition("\n")[0].splitlines()  # the last line may be half written
    if not lines:
        raise InputError(f"{file}: nothing was trained there yet")
    return [json.loads(line) for line in lines]


def _finished(folder: Path, plan: Plan) -> bool:
    """Whether the plan is done; a run interrupted before its first iteration is not."""
    file = folder / "metrics.jsonl"
    if not file.is_file() or not file.read_text().strip():
        return False
    last = _rows(folder)[-1]
    return plan.share(last["steps"], last["wall_s"]) >= 1.0
