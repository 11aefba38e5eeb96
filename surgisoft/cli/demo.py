"""`surgisoft demo`: the package's story in five steps, with pictures."""

from pathlib import Path
from typing import Annotated

import typer

from surgisoft.cli import app
from surgisoft.cli.files import show_written
from surgisoft.cli.progress import progress


@app.command("demo")
def demo(
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="New folder for its results.")
    ] = Path("surgisoft_demo"),
) -> None:
    """Show what the package does: two arms cut a ring; a model's missing effect is found.

    Takes about a minute and needs no data. The first run compiles for half a minute more.
    """
    from surgisoft.demonstration import demo as run_demo

    with progress("demo") as report:
        result = run_demo(output, progress=report)
    for number, (name, text) in enumerate(result.sentences.items(), 1):
        print(f"{number}. {name}: {text}")
    if result.no_picture:
        print(f"no picture of the replay: {result.no_picture}")
    show_written([result.page, output / "cut.rrd"])
