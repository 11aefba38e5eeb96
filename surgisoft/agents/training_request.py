"""Train the agents of a task by its name, into the folder of a run."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgisoft.agents.compiled_update import check_compiler
from surgisoft.agents.distributed import process_count, processes
from surgisoft.agents.loggers import TENSORBOARD, check_logger
from surgisoft.agents.presets import Plan, Preset, config_for, envs_for, preset_for, steps_for
from surgisoft.agents.run_folder import RunFolder, check_free, default_folder
from surgisoft.agents.selection import has_goal
from surgisoft.agents.session import task_config
from surgisoft.agents.training import Result, TrainingProgress, resume, train_new
from surgisoft.config import COMMAND_LINE, Where, from_table, merged, to_table
from surgisoft.errors import InputError
from surgisoft.tasks.arguments import whole
from surgisoft.tasks.path_following import beyond_reach
from surgisoft.tasks.registry import changed_config, task_names
from surgisoft.workers import torch_threads


@dataclass(frozen=True)
class TrainingRequest:
    """Request for a training, before it is resolved to a `Plan`."""

    task: str
    """Name of the task."""
    preset: str = "fast"
    """`fast`; `randomised`: the same under domain randomization; `robust`: for robots that differ
    from the model; or `paper`: the hyper-parameters of Chen et al. 2025."""
    steps: int | None = None
    """Steps over all episodes; None: the number that the task names, unless minutes are given."""
    minutes: float | None = None
    """Time to train in place of steps, minutes."""
    envs: int | None = None
    """Episodes side by side; None: the preset's, and fewer in a short training."""
    compile: bool = False
    """Whether `torch.compile` builds the loss of an update; on a GPU the arms' step."""
    seed: int = 0
    """Seed of weights, noise and episodes."""
    target_error: float | None = None
    """Training ends when evaluation finds no larger mean error, mm, and full success."""
    arm: str | Path | None = None
    """Arm model of all arms; None: the configuration's."""
    scene: str | Path | None = None
    """Scene; None: the configuration's."""
    config: Any = None
    """Configuration of the task, or a TOML file with fields of it."""
    changes: dict | None = None
    """Fields of the configuration to change, as nested tables: `{"follow": {"size_mm": 12}}`."""
    ppo: dict | None = None
    """Hyper-parameters to change, by the names of `Preset`."""

    def plan(self) -> Plan:
        """Resolve the request to a `Plan`; raises InputError for contradicting options."""
        if self.steps is not None and self.minutes is not None:
            raise InputError(
                f"--steps {self.steps} and --minutes {self.minutes:g}: give only one of them; "
                "either of them ends the training"
            )
        config = task_config(self.task, self.config, self.arm, self.scene)
        envs = self.envs
        if envs is None and self.steps is not None:
            envs = envs_for(self.preset, self.task, self.steps)
        given = {"envs": envs, "compile": self.compile or None}
        if self.ppo:
            known = {name: value for name, value in given.items() if value is not None}
            usual = to_table(preset_for(self.preset, self.task)) | known
            changed = merged(usual, self.ppo)
            numbers = from_table(Preset, changed, Where(COMMAND_LINE, keys=("ppo",)))
        else:
            numbers = preset_for(self.preset, self.task, **given)
        config = config_for(self.preset, config)
        if self.changes:
            config = changed_config(config, self.changes, COMMAND_LINE)
        steps = self.steps
        if steps is None and self.minutes is None:
            steps = steps_for(self.preset, self.task)
        return Plan(
            self.task,
            config,
            self.preset,
            numbers,
            steps,
            self.minutes,
            self.target_error,
            self.seed,
        )


ASSIGNED = {"changes": "FIELD=VALUE", "ppo": "ppo.NAME=VALUE"}
"""Fields of `TrainingRequest` that the command takes as assignments, as they are written there."""


@dataclass(frozen=True)
class TrainedRun:
    """A training run after its training."""

    folder: Path
    """Folder of the run."""
    result: Result
    """How training ended."""
    leads: bool
    """Whether this process wrote the folder, where torchrun started several."""


def train(
    task: str | None = None,
    output: str | Path | None = None,
    *,
    resume_from: str | Path | None = None,
    device: str = "cpu",
    threads: int = 1,
    progress: Callable[[TrainingProgress], None] | None = None,
    on_plan: Callable[[Plan], None] | None = None,
    logger: str = TENSORBOARD,
    **fields: Any,
) -> TrainedRun:
    """Train the agents of a task at the same time with PPO (Schulman et al. 2017).

    Each agent has its own actor, which sees its own observation, and a critic, which sees those of
    all agents (centralised training, decentralised execution). Returns the run's folder, which
    opens without further code, and the result of its last evaluation. Raises InputError before any
    step for options that do not fit each other.

    output: folder of the new run; default `runs/TASK-DATE-TIME`.
    resume_from: folder of an interrupted run that goes on, in place of a task and its fields; with
    `steps`, more than it was started with, also a finished one whose noise has no schedule.
    fields: other fields of `TrainingRequest`, such as `steps=100_000` or `arm="my_arm"`.
    progress: called with the state of the training after each iteration. on_plan: called with the
    plan of a new run before training. logger: where curves go beside the folder, one of `LOGGERS`.
    """
    report, steps = progress or (lambda state: None), None
    if resume_from is not None:
        steps = fields.pop("steps", None)
        steps = None if steps is None else whole("steps", steps, 1)
        names = [*(["task"] if task else []), *(["output"] if output else []), *fields]
        if names:
            given = ", ".join(ASSIGNED.get(n, f"--{n.replace('_', '-')}") for n in names)
            raise InputError(f"--resume continues with the options of the run: leave out {given}")
        plan, folder = None, Path(resume_from)
    elif task is None:
        raise InputError(f"--task is missing: one of {', '.join(task_names())}, or --resume RUN")
    else:
        plan = TrainingRequest(task, **fields).plan()
        folder = _new_folder(task, output)
        if on_plan is not None:
            on_plan(plan)
    check_logger(logger)
    with torch_threads(threads), processes(device) as (here, kind):
        if plan is not None and plan.preset.compile:
            check_compiler(kind)
        if plan is None:
            result = resume(folder, here, kind, report, logger, steps)
        else:
            result = train_new(folder, plan, here, kind, report, logger)
        return TrainedRun(folder, result, here.leads)


def shortfall(run: TrainedRun) -> str:
    """Why a finished training did not converge, in words; empty where it did.

    It did not where its best policies do not succeed in every episode, or, in a task without
    success, where they are farther off than the arm model itself is. Of a task that measures
    neither, it is not known.
    """
    best = run.result.best or {}
    why = ""
    if "success" in best:
        if best["success"] < 1.0:
            why = f"its best policies succeed in {best['success']:.0%} of the episodes"
    elif math.isfinite(error := best.get("error_mm", math.nan)):
        task = RunFolder(run.folder).task()
        arms = task.world.arms.values()
        known = [arm.model.validation.rmse_mm for arm in arms]
        model = max((each for each in known if each is not None), default=math.inf)
        if error > model:
            why = f"its error of {error:.3g} mm is above that of the arm model ({model:.2g} mm)"
            if beyond := beyond_reach(task):
                return (
                    f"the training did not converge: {why}; {beyond}, where no training helps; "
                    "make the path smaller (size_mm) or move its centre"
                )
    elif best and not has_goal(best):
        return (
            f"whether the training converged is not known: measures of the task "
            f"'{RunFolder(run.folder).config['task']}' has neither 'success' nor a name that ends "
            "in 'error_mm', and the policies with the largest return are kept as best; add one to "
            "measures"
        )
    elif best:
        why = "no error could be measured in its evaluations"
    if not why:
        return ""
    usual = steps_for("fast", RunFolder(run.folder).config["task"])
    more = ""
    if run.result.steps < usual:
        more = f"train a new run with more --steps ({usual:,} are usual) or "
    return f"the training did not converge: {why}; {more}try another --seed"


def _new_folder(task: str, output: str | Path | None) -> Path:
    """The folder of a new run; several processes cannot each name it by the time."""
    if output is None and process_count() > 1:
        raise InputError("several processes need one folder: name it with -o RUN")
    folder = Path(output) if output else default_folder(task)
    if os.environ.get("RANK", "0") == "0":
        check_free(folder)
    return folder
