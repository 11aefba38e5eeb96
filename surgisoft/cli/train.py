"""`surgisoft train`: train the agents of a task."""

from pathlib import Path
from typing import Annotated

import typer

from surgisoft.cli import INTERRUPTED, app
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


@app.command()
def train(
    task: Annotated[
        str | None, typer.Option(metavar="TASK", help="Task to learn; not with --resume.")
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(
            metavar="fast|randomised|paper",
            help="fast (default); randomised: with camera noise, mounts and gains that differ "
            "between episodes, and a state observer; or the hyper-parameters of the paper.",
        ),
    ] = None,
    steps: Annotated[
        int | None, typer.Option(min=1, help="Steps over all episodes; default: by the task.")
    ] = None,
    minutes: Annotated[
        float | None,
        typer.Option(metavar="MIN", help="Duration of the training, minutes, instead of --steps."),
    ] = None,
    envs: Annotated[
        int | None, typer.Option(min=1, help="Number of episodes that are simulated in parallel.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, max=SEED_MAX, help="Seed of weights, noise and episodes.")
    ] = None,
    target_error: Annotated[
        float | None,
        typer.Option(
            metavar="MM", help="Stop when an evaluation has no larger mean error, and full success."
        ),
    ] = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "-o", "--output", metavar="RUN", help="New folder; default runs/TASK-DATE-TIME."
        ),
    ] = None,
    resume: Annotated[
        Path | None, typer.Option(metavar="RUN", help="Continue an interrupted run.")
    ] = None,
    arm: Arm = None,
    scene: SceneFolder = None,
    config: TaskConfig = None,
    device: Annotated[
        str, typer.Option(metavar="cpu|cuda", help="Device of simulation and training.")
    ] = "cpu",
    threads: Threads = 1,
    effect_files: EffectFiles = None,
) -> None:
    """Train the agents of a task with PPO, all at the same time.

    The folder of the run holds all that is needed to open it. After Ctrl-C,
    --resume continues with the same numbers as an uninterrupted run. For several processes:
    torchrun --nproc-per-node N -m surgisoft train ...
    """
    from surgisoft.agents.training_request import train as train_agents

    given = {
        "preset": preset, "steps": steps, "minutes": minutes, "envs": envs, "seed": seed,
        "target_error": target_error, "arm": arm, "scene": scene, "config": config,
    }  # fmt: skip
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
            **{name: value for name, value in given.items() if value is not None},
        )
    if not run.leads:
        return
    if not run.result.done:
        print(
            f"stopped after {run.result.steps:,} steps; continue with: "
            f"{with_effect_files(f'surgisoft train --resume {run.folder}')}"
        )
        raise typer.Exit(INTERRUPTED)
    print(_summary(run.folder, run.result))
    print(f"next: {with_effect_files(f'surgisoft evaluate {run.folder}')}")


def _measures(found: dict | None) -> str:
    if not found:
        return "not evaluated yet"
    words = []
    if "success" in found:
        words.append(f"success {found['success']:.0%}")
    if "error_mm" in found:
        error = found["error_mm"]
        words.append("error not measured" if error != error else f"error {error:.4f} mm")
    return "evaluation: " + ", ".join(words)


def _summary(folder: Path, result) -> str:
    return (
        f"wrote {folder}: {result.steps:,} steps in {result.wall_s:.0f} s "
        f"({result.cpu_s:.0f} s of processor), best {_measures(result.best)}"
    )
