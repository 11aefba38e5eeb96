"""`surgisoft demo`: the package's story in five steps, with pictures."""

from itertools import count
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

    Needs no data. The page DIR/index.html exists after the first step; each step adds its result.
    """
    from surgisoft.demonstration import demo as run_demo

    steps, began = count(1), False

    def show(name: str, sentence: str) -> None:
        number = next(steps)
        print(f"{number}. {name}: {sentence}", flush=True)
        if number == 1:
            print(f"   see {output / 'index.html'}; each further step adds its result", flush=True)

    with progress("demo") as report:

        def told(done: float, total: float, note: str = "") -> None:
            nonlocal began
            if not began:
                print(f"five steps, into {output}; a first run compiles for a minute", flush=True)
            began = True
            report(done, total, note)

        result = run_demo(output, progress=told, on_step=show)
    if result.no_picture:
        print(f"no picture of the replay: {result.no_picture}")
    show_written([result.page, output / "cut.rrd"])
