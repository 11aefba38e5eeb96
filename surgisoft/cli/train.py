"""`surgisoft train` and `surgisoft export`: policies from training runs."""

from pathlib import Path
from typing import Annotated

import typer

from surgisoft.cli import INTERRUPTED, app
from surgisoft.cli.options import SEED_MAX, Arm, EffectFiles, Run, SceneFolder, TaskConfig, Threads
from surgisoft.cli.progress import progress


@app.command()
def train(
    task: Annotated[
        str | None, typer.Option(metavar="TASK", help="Task to learn; not with --resume.")
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            metavar="fast|paper", help="fast (default), or paper: the paper's hyper-parameters."
        ),
    ] = None,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Steps over all episodes; default the task's own.")
    ] = None,
    minutes: Annotated[
        float | None,
        typer.Option(metavar="MIN", help="Time to train, minutes, instead of --steps."),
    ] = None,
    envs: Annotated[int | None, typer.Option(min=1, help="Episodes side by side.")] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, max=SEED_MAX, help="Seed of weights, noise and episodes.")
    ] = None,
    target_error: Annotated[
        float | None,
        typer.Option(
            metavar="MM", help="End when evaluation finds no larger mean error, and full success."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="RUN", help="Folder; default runs/TASK-DATE-TIME."),
    ] = None,
    resume: Annotated[
        Path | None, typer.Option(metavar="RUN", help="Go on with an interrupted run.")
    ] = None,
    arm: Arm = None,
    scene: SceneFolder = None,
    config: TaskConfig = None,
    device: Annotated[
        str, typer.Option(metavar="cpu|cuda", help="Where to simulate and to learn.")
    ] = "cpu",
    threads: Threads = 1,
    effect_files: EffectFiles = None,
) -> None:
    """Train the agents of a task with PPO; every agent learns at once.

    The run's folder is written first and opens by itself. Ctrl-C ends it so that --resume goes on
    as if nothing had been. Several processes: torchrun --nproc-per-node N -m surgisoft train ...
    """
    from surgisoft.errors import InputError

    given = {
        "--task": task, "--preset": preset, "--steps": steps, "--minutes": minutes,
        "--envs": envs, "--seed": seed, "--target-error": target_error, "--output": output,
        "--arm": arm, "--scene": scene, "--config": config,
    }  # fmt: skip
    told = [name for name, value in given.items() if value is not None]
    if resume is not None and told:
        raise InputError(
            f"--resume goes on with what the run was started with: leave {', '.join(told)} out"
        )
    if resume is None and task is None:
        from surgisoft.tasks.registry import TASKS

        raise InputError(f"--task is missing: one of {', '.join(sorted(TASKS))}, or --resume RUN")
    if resume is None:
        plan = _plan(task, preset, steps, minutes, envs, seed, target_error, arm, scene, config)
        folder = _new_folder(task, output)
    else:
        plan, folder = None, resume
    result, leads = _run(plan, folder, device, threads)
    if not leads:
        return
    if not result.done:
        print(
            f"stopped after {result.steps:,} steps; go on with: surgisoft train --resume {folder}"
        )
        raise typer.Exit(INTERRUPTED)
    print(_summary(folder, result))


def _plan(task, preset, steps, minutes, envs, seed, target_error, arm, scene, config):
    from surgisoft.agents.presets import Plan, preset_for, steps_for
    from surgisoft.tasks.registry import config_of, read_config, with_fields

    own = read_config(task, config) if config else config_of(task)
    paths = {"arm": arm, "scene": None if scene is None else str(scene)}
    own = with_fields(own, **{name: value for name, value in paths.items() if value is not None})
    name = preset or "fast"
    numbers = preset_for(name, task, envs=envs)
    if steps is None and minutes is None:
        steps = steps_for(name, task)
    return Plan(task, own, name, numbers, steps, minutes, target_error, seed or 0)


def _new_folder(task: str, output: Path | None) -> Path:
    """The folder of a new run; only processes that torchrun did not number may choose by time."""
    import os

    from surgisoft.agents.run_folder import check_free, default_folder
    from surgisoft.errors import InputError

    if output is None and int(os.environ.get("WORLD_SIZE", "1")) > 1:
        raise InputError("several processes need one folder: name it with -o RUN")
    folder = output or default_folder(task)
    if os.environ.get("RANK", "0") == "0":
        check_free(folder)
    return folder


def _run(plan, folder: Path, device: str, threads: int):
    """Train or resume; the result, and whether this process leads."""
    import torch

    from surgisoft.agents.distributed import processes
    from surgisoft.agents.training import resume, train_new

    torch.set_num_threads(threads)
    with processes(device) as (here, kind), progress(f"train {folder}") as report:

        def tell(p) -> None:
            note = f"{p.steps:,} steps, {p.steps_per_s:,.0f}/s, reward {p.reward:.3f}"
            report(p.share, 1.0, f"{note}, {_measures(p.evaluation)}")

        if plan is None:
            return resume(folder, here, kind, tell), here.leads
        return train_new(folder, plan, here, kind, tell), here.leads


def _measures(found: dict | None) -> str:
    if not found:
        return "not evaluated yet"
    words = []
    if "success" in found:
        words.append(f"success {found['success']:.0%}")
    if "error_mm" in found:
        words.append(f"error {found['error_mm']:.4f} mm")
    return "evaluation: " + ", ".join(words)


def _summary(folder: Path, result) -> str:
    return (
        f"wrote {folder}: {result.steps:,} steps in {result.wall_s:.0f} s "
        f"({result.cpu_s:.0f} s of processor), best {_measures(result.best)}"
    )


@app.command()
def export(
    run: Run,
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="New folder.")],
    which: Annotated[str, typer.Option(metavar="best|last", help="Checkpoint.")] = "best",
) -> None:
    """Write a run's policies as ONNX and TorchScript, one of each for an agent."""
    from surgisoft.agents.export import export as export_policy
    from surgisoft.agents.learned import LearnedPolicy

    for file in export_policy(LearnedPolicy(run, which=which), output):
        print(f"wrote {file}")
