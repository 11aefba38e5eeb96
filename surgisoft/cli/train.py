"""`surgisoft train`: train the agents of a task."""

import os
from pathlib import Path
from typing import Annotated, Any

import typer

from surgisoft.cli import app, stopped
from surgisoft.cli.inputs import warn
from surgisoft.cli.options import (
    SEED_MAX,
    Arm,
    EffectFiles,
    SceneFolder,
    TaskConfig,
    Threads,
    with_effect_files,
)
from surgisoft.cli.progress import progress
from surgisoft.command_line import typed
from surgisoft.errors import InputError

OPTIONS = {
    "task": str, "preset": str, "steps": int, "minutes": float, "envs": int, "seed": int,
    "target_error": float, "arm": str, "scene": str, "config": str,
}  # fmt: skip
"""Options that may be given as FIELD=VALUE, and the types of their values."""


LARGEST_ROUNDING = 0.01
"""Share by which --steps may be rounded up to whole updates without a line that says so."""


def _complete(context: typer.Context, incomplete: str) -> list[str]:
    """Fields that begin so, of the task that the line names so far."""
    from surgisoft.agents.presets import Preset
    from surgisoft.config import field_names
    from surgisoft.tasks.registry import config_of, task_names

    if incomplete.startswith("task="):
        return [
            name
            for name in (f"task={each}" for each in task_names())
            if name.startswith(incomplete)
        ]
    words = context.params.get("changes") or []
    named = [word.removeprefix("task=") for word in words if word.startswith("task=")]
    task: str | None = context.params.get("task") or (named[-1] if named else None)
    fields = [*OPTIONS, *(f"ppo.{name}" for name in field_names(Preset()))]
    if task is not None and task in task_names():
        fields += field_names(config_of(task))
    return [f"{name}=" for name in fields if name.startswith(incomplete)]


def _assigned(changes: list[str], task: str | None, given: dict) -> str | None:
    """The task; assignments of options go into `given`, those of fields into its tables."""
    from surgisoft.config import assignments

    table = assignments(changes)
    for name in [name for name in table if name in OPTIONS]:
        value: Any = table.pop(name)
        kind = OPTIONS[name]
        accepted = (int, float) if kind is float else kind
        if isinstance(value, bool) or not isinstance(value, accepted):
            words = {int: "an integer", float: "a number", str: "text"}
            raise InputError(f"{name}={value}: expected {words[kind]}")
        before = task if name == "task" else given[name]
        if before is not None:
            raise InputError(f"{name}={value} and --{name.replace('_', '-')}: give one of them")
        if name == "task":
            task = str(value)
        else:
            given[name] = value
    given["ppo"] = table.pop("ppo", None)
    given["changes"] = table or None
    return task


def _show_plan(plan) -> None:
    """Print what differs from the task's defaults and from the preset's hyper-parameters, and the
    steps that whole updates take, and warn of a scene whose beams pass its own limits or are too
    weak."""
    from surgisoft.agents.distributed import process_count
    from surgisoft.agents.presets import preset_for
    from surgisoft.agents.session import beam_beyond_limits_of
    from surgisoft.config import differences
    from surgisoft.tasks.registry import config_of

    lines = differences(config_of(plan.task), plan.task_config)
    usual = preset_for(plan.preset_name, plan.task)
    lines += [f"ppo.{line}" for line in differences(usual, plan.preset)]
    if os.environ.get("RANK", "0") != "0":
        return
    if lines:
        print("changed from the default:", *lines, sep="\n  ", flush=True)
    total = plan.whole_steps(process_count())
    if total is not None and total > (1.0 + LARGEST_ROUNDING) * plan.steps:
        print(
            f"{plan.steps:,} steps are rounded up to {total:,}: an update takes "
            f"{plan.preset.rollout} steps of each of {plan.preset.envs:,} episodes"
            + (f" in {process_count()} processes" if process_count() > 1 else ""),
            flush=True,
        )
    if beyond := beam_beyond_limits_of(plan.task_config):
        warn(beyond)
    if getattr(plan.task_config, "scene", None) is not None:
        from surgisoft.tasks.laser_dose import weak_laser
        from surgisoft.tasks.registry import make_task

        if weak := weak_laser(make_task(plan.task, plan.task_config)):
            warn(weak)


@app.command()
def train(
    changes: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[FIELD=VALUE...]",
            help="Fields of the task's configuration (follow.size_mm=12), hyper-parameters "
            "(ppo.gamma=0.95) and options (task=track_circle, seed=3). What differs from the "
            "default is printed.",
            autocompletion=_complete,
        ),
    ] = None,
    task: Annotated[
        str | None, typer.Option(metavar="TASK", help="Task to learn; not with --resume.")
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            metavar="fast|randomised|robust|paper",
            help="fast (default); randomised: with camera noise, mounts and gains that differ "
            "between episodes, and a state observer; robust: for robots that differ from the "
            "model, with random effects in every episode and an observer that learns online; "
            "paper: the hyper-parameters of the paper.",
        ),
    ] = None,
    steps: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Steps over all episodes; default: by the task; --preset paper: 20,000,000.",
        ),
    ] = None,
    minutes: Annotated[
        float | None,
        typer.Option(metavar="MIN", help="Duration of the training, minutes, instead of --steps."),
    ] = None,
    envs: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of episodes that are simulated in parallel; default: by the task, fewer "
            "in a short training, so that the number of updates stays the same.",
        ),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, max=SEED_MAX, help="Seed of weights, noise and episodes.")
    ] = None,
    target_error: Annotated[
        float | None,
        typer.Option(
            metavar="MM",
            help="Stop when an evaluation has at most this mean error, and every episode succeeds.",
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="RUN", help="New folder; default runs/TASK-DATE-TIME."
        ),
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            metavar="RUN",
            help="Continue an interrupted run; with --steps also a finished one of --preset paper, "
            "to that many steps in all.",
        ),
    ] = None,
    arm: Arm = None,
    scene: SceneFolder = None,
    config: TaskConfig = None,
    device: Annotated[
        str,
        typer.Option(
            metavar="cpu|cuda", help="Device of simulation and training; cuda is an NVIDIA GPU."
        ),
    ] = "cpu",
    compile_update: Annotated[
        bool,
        typer.Option(
            "--compile",
            help="Compile the loss of an update with torch.compile, which needs a C++ compiler and "
            "is faster with few --envs only; with --device cuda, compile the step of the arms, "
            "which needs Triton (docs/training.md).",
        ),
    ] = False,
    logger: Annotated[
        str,
        typer.Option(
            metavar="tensorboard|wandb|mlflow|neptune",
            help="Where the curves go in addition to the run's folder. With tensorboard nothing "
            "leaves this machine.",
        ),
    ] = "tensorboard",
    threads: Threads = 1,
    effect_files: EffectFiles = None,
) -> None:
    """Train the agents of a task with PPO, all at the same time.

    The folder of the run holds everything that is needed to open it. After Ctrl-C, --resume
    continues with the same numbers as an uninterrupted run. For several processes:
    torchrun --nproc-per-node N -m surgisoft train ...
    """
    from surgisoft.agents.training_request import shortfall
    from surgisoft.agents.training_request import train as train_agents

    given = {
        "preset": preset, "steps": steps, "minutes": minutes, "envs": envs, "seed": seed,
        "target_error": target_error, "arm": arm, "scene": scene, "config": config,
        "compile": compile_update or None,
    }  # fmt: skip
    task = _assigned(changes or [], task, given)
    with progress(f"train {resume or output or task}") as report:

        def tell(state) -> None:
            note = f"{state.steps:,} steps, {state.steps_per_s:,.0f}/s, reward {state.reward:.3f}"
            report(state.share, 1.0, f"{note}, {_measures(state.evaluation)}")

        run = train_agents(
            task,
            output,
            resume_from=resume,
            device=device,
            threads=threads,
            progress=tell,
            on_plan=_show_plan,
            logger=logger,
            **{name: value for name, value in given.items() if value is not None},
        )
    if not run.leads:
        return
    if not run.result.done:
        stopped(
            f"stopped after {run.result.steps:,} steps; continue with: "
            f"{with_effect_files(f'surgisoft train --resume {typed(run.folder)}')}"
        )
    print(_summary(run.folder, run.result))
    if why := shortfall(run):
        warn(why)
    print(f"next: {with_effect_files(f'surgisoft evaluate {typed(run.folder)}')}")
    print(f"an episode of its last evaluation: surgisoft replay {typed(run.folder)}")


def _measures(found: dict | None) -> str:
    if not found:
        return "not evaluated yet"
    from surgisoft.agents.selection import MEAN_RETURN

    words = []
    if "success" in found:
        words.append(f"success {found['success']:.0%}")
    if "error_mm" in found:
        error = found["error_mm"]
        words.append("error not measured" if error != error else f"error {error:.4f} mm")
    if MEAN_RETURN in found:
        words.append(f"return {found[MEAN_RETURN]:.4g}")
    return "evaluation: " + ", ".join(words)


def _summary(folder: Path, result) -> str:
    if not result.updates:
        return (
            f"{folder} was finished before, and nothing was trained: {result.steps:,} steps, best "
            f"{_measures(result.best)}"
        )
    return (
        f"wrote {folder}: {result.steps:,} steps in {result.wall_s:.0f} s "
        f"({result.cpu_s:.0f} s of processor), best {_measures(result.best)}"
    )
