"""`surgisoft benchmark`: long studies whose results are committed."""

import datetime
from pathlib import Path
from typing import Annotated

import typer

from surgisoft.cli import app
from surgisoft.cli.files import write_text
from surgisoft.cli.progress import progress

benchmark = typer.Typer(help="Long studies on the virtual rig.", no_args_is_help=True)
app.add_typer(benchmark, name="benchmark")


@benchmark.command()
def modelling(
    seeds: Annotated[str, typer.Option(help="Robots, by the seed of their casting.")] = "1,2,3",
    points: Annotated[
        int | None, typer.Option(min=64, help="Training points; default the paper's 13,824.")
    ] = None,
    processes: Annotated[int, typer.Option(min=1, help="Fits that run side by side.")] = 2,
    images: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Draw loops and bodies of the first robot.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FILE", help="Write Markdown here.")
    ] = None,
) -> None:
    """The paper's modelling results: architectures, inputs, baselines and memory."""
    from surgisoft.errors import InputError
    from surgisoft.studies.modelling import run

    try:
        numbers = [int(word) for word in seeds.split(",")]
    except ValueError:
        raise InputError(f"--seeds '{seeds}': expected whole numbers such as 1,2,3") from None
    with progress("modelling") as report:
        table = run(numbers, points, processes, report, images)
    command = f"surgisoft benchmark modelling --seeds {seeds}"
    if points:
        command += f" --points {points}"
    today = datetime.date.today().isoformat()
    text = f"# Modelling results\n\nPrinted by `{command}` on {today}.\n\n{table}"
    if output:
        write_text(output, text)
    print(text)
