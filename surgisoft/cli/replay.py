"""`surgisoft replay`: view an episode in a window, a browser or a picture."""

from pathlib import Path
from typing import Annotated

import typer

from surgisoft.cli import app
from surgisoft.cli.options import Port, SaveReplay, Screenshot, Web
from surgisoft.cli.progress import progress


@app.command("replay")
def replay(
    what: Annotated[
        Path,
        typer.Argument(
            metavar="RUN|FILE",
            help="A replay (.rrd), an episode's log (.npz), or a folder: its newest replay.",
        ),
    ],
    web: Web = False,
    port: Port = None,
    screenshot: Screenshot = None,
    size: Annotated[
        str | None,
        typer.Option(
            metavar="WxH", help="Size of the picture's window, in points; default: 1600x1000."
        ),
    ] = None,
    time: Annotated[
        float | None,
        typer.Option(
            metavar="S", help="Time of the picture, in s; default: two thirds of the episode."
        ),
    ] = None,
    view: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="The only view in the picture, such as Scene."),
    ] = None,
    save: SaveReplay = None,
) -> None:
    """View an episode in the Rerun viewer: arms, beam, organ, endoscope, plots, events."""
    from surgisoft.replay.show import open_replay

    with progress("replay") as report:
        written = open_replay(
            what,
            save=save,
            screenshot=screenshot,
            web=web,
            port=port,
            size=size,
            time_s=time,
            view=view,
            progress=report,
            on_address=lambda url: print(f"open {url} (stop with Ctrl-C)", flush=True),
        )
    if written is not None:
        print(written)
    elif screenshot is not None:
        print(f"wrote {screenshot}")
