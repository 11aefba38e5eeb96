"""The sub-commands of `surgisoft benchmark`: long studies whose results are committed."""

import datetime
from pathlib import Path
from typing import Annotated

import typer

from surgisoft.cli.files import check_folder
from surgisoft.cli.progress import progress
from surgisoft.files import write_atomically

app = typer.Typer(help="Long studies on the virtual rig.", no_args_is_help=True)

Images = Annotated[Path | None, typer.Option(metavar="DIR", help="Draw the pictures here.")]
"""Option of the studies that draw."""
Output = Annotated[
    Path | None, typer.Option("-o", "--output", metavar="FILE", help="Write Markdown here.")
]
"""Option of all studies."""


def _numbers(option: str, text: str) -> list[int]:
    """Whole numbers between commas, or one line that says what was expected."""
    from surgisoft.errors import InputError

    try:
        return [int(word) for word in text.split(",")]
    except ValueError:
        raise InputError(f"{option} '{text}': expected whole numbers such as 1,2,3") from None


def _show(title: str, command: str, body: str, output: Path | None) -> None:
    """Print a study's results under the command and the day, and write them where asked for."""
    today = datetime.date.today().isoformat()
    text = f"# {title}\n\nPrinted by `{command}` on {today}.\n\n{body}"
    if output:
        write_atomically(output, text)
    print(text)


@app.command()
def modelling(
    seeds: Annotated[str, typer.Option(help="Robots, by the seed of their casting.")] = "1,2,3",
    points: Annotated[
        int | None, typer.Option(min=64, help="Training points; default the paper's 13,824.")
    ] = None,
    processes: Annotated[int, typer.Option(min=1, help="Fits that run side by side.")] = 2,
    images: Images = None,
    output: Output = None,
) -> None:
    """The paper's modelling results: architectures, inputs, baselines and memory."""
    from benchmarks.modelling import run

    numbers = _numbers("--seeds", seeds)
    with progress("modelling") as report:
        table = run(numbers, points, processes, report, images)
    command = f"surgisoft benchmark modelling --seeds {seeds}"
    if points:
        command += f" --points {points}"
    _show("Modelling results", command, table, output)


@app.command()
def diagnosis(
    robots: Annotated[
        str,
        typer.Option(help="Robots, by the seed of their casting; 101 to 127 were seen before."),
    ] = "128,129,130,131",
    count: Annotated[int, typer.Option(min=8, help="Robots with their recordings, in all.")] = 400,
    seed: Annotated[
        int, typer.Option(min=0, help="Draws the cases; 1 to 10 were seen before.")
    ] = 11,
    processes: Annotated[int, typer.Option(min=1, help="Robots side by side.")] = 2,
    work: Annotated[
        Path, typer.Option(metavar="DIR", help="Keeps base models and what was said of each robot.")
    ] = Path("runs/benchmark-diagnosis"),
    amend: Annotated[
        int,
        typer.Option(min=0, help="Cases with one effect of the list whose model is amended too."),
    ] = 45,
    images: Images = None,
    output: Output = None,
) -> None:
    """The benchmark of `diagnose`: virtual robots with hidden effects, clean ones, unknown ones."""
    from benchmarks.diagnosis.cases import cases
    from benchmarks.diagnosis.study import run
    from benchmarks.diagnosis.table import draw, markdown

    numbers = _numbers("--robots", robots)
    some = cases(numbers, count, seed)
    with progress("diagnosis") as report:
        outcomes = run(some, work, processes, report, amend)
    command = f"surgisoft benchmark diagnosis --robots {robots} --count {count} --seed {seed}"
    command += f" --amend {amend}"
    if images:
        print(f"wrote {draw(outcomes, images)}")
    _show("Diagnosis results", command, markdown(outcomes), output)


@app.command("hidden-effect")
def hidden_effect(
    effects: Annotated[
        str, typer.Option(help="Effects that the model lacks, one after the other.")
    ] = "creep,line_lag,payload,hysteresis",
    specimen: Annotated[int, typer.Option(min=0, help="Which arm was cast.")] = 0,
    strength: Annotated[float, typer.Option(help="Strength of what is hidden in the rig.")] = 1.0,
    steps: Annotated[int, typer.Option(min=1, help="Training steps of each policy.")] = 2_000_000,
    episodes: Annotated[int, typer.Option(min=2, help="Episodes of each driver.")] = 10,
    seed: Annotated[int, typer.Option(min=0, help="Seed of training and of episodes.")] = 0,
    work: Annotated[
        Path, typer.Option(metavar="DIR", help="Keeps recordings, models and policies: goes on.")
    ] = Path("runs/benchmark-hidden-effect"),
    images: Images = None,
    output: Output = None,
) -> None:
    """The loop closed: train, diagnose on a rig that hides an effect, amend, train anew."""
    import torch

    from benchmarks.hidden_effect.study import StudyConfig, run
    from benchmarks.hidden_effect.table import draw, markdown

    check_folder(work)
    check_folder(images)
    config = StudyConfig(specimen, strength, steps, seed, episodes)
    torch.set_num_threads(1)
    with progress("hidden-effect") as report:
        outcomes = run(effects.split(","), config, work, report)
    command = (
        f"surgisoft benchmark hidden-effect --effects {effects} --specimen {specimen} "
        f"--strength {strength:g} --steps {steps} --episodes {episodes} --seed {seed}"
    )
    shown = ""
    if images:
        paths = draw(outcomes, images)
        shown = "".join(f"\n![{path.stem}](../images/{path.name})\n" for path in paths)
    _show("The loop closed", command, markdown(outcomes, config) + shown, output)


@app.command()
def control(
    runs: Annotated[
        Path,
        typer.Option(
            metavar="DIR",
            help="Training runs as TASK-seed-N: taken as they are, trained where missing.",
        ),
    ] = Path("runs/benchmark-control"),
    tasks: Annotated[
        str | None, typer.Option(help="Tasks, such as track_circle,keyhole; default: all.")
    ] = None,
    seeds: Annotated[str, typer.Option(help="Seeds of the training runs.")] = "1,2,3",
    episodes: Annotated[int, typer.Option(min=2, help="Episodes in simulation.")] = 100,
    rig_episodes: Annotated[int, typer.Option(min=2, help="Episodes on the rig.")] = 20,
    output: Output = None,
) -> None:
    """Learned beside scripted beside random on every task, in simulation and on the rig."""
    import torch

    from benchmarks.control.study import TASKS, ControlConfig, run
    from benchmarks.control.table import markdown

    check_folder(runs)
    numbers = tuple(_numbers("--seeds", seeds))
    chosen = tuple(tasks.split(",")) if tasks else TASKS
    config = ControlConfig(chosen, numbers, episodes, rig_episodes)
    torch.set_num_threads(1)
    with progress("control") as report:
        results = run(config, runs, report)
    command = f"surgisoft benchmark control --seeds {seeds}"
    command += f" --tasks {tasks}" if tasks else ""
    command += f" --episodes {episodes} --rig-episodes {rig_episodes}"
    _show("Control results", command, markdown(results, config), output)
