"""`surgisoft replay`: look at what was recorded, in a window, a browser or a picture."""

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from surgisoft.cli import app
from surgisoft.cli.options import SaveReplay, Screenshot, Web


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
    screenshot: Screenshot = None,
    size: Annotated[
        str, typer.Option(metavar="WxH", help="Size of the picture's window, in points.")
    ] = "1600x1000",
    time: Annotated[
        float | None,
        typer.Option(metavar="S", help="Moment of the picture, in s; default: two thirds through."),
    ] = None,
    view: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Only this view in the picture, such as Scene."),
    ] = None,
    save: SaveReplay = None,
) -> None:
    """Look at an episode in the Rerun viewer: arms, beam, organ, endoscope, plots, events."""
    from surgisoft.errors import InputError
    from surgisoft.replay.find import find_replay, moment
    from surgisoft.replay.screenshot import parse_size, take_screenshot
    from surgisoft.replay.viewer import open_viewer, serve_viewer

    window, found = parse_size(size), find_replay(what)
    if sum((web, screenshot is not None, save is not None)) > 1:
        raise InputError("expected at most one of --web, --screenshot and --save")
    if screenshot is None and (time is not None or view is not None):
        raise InputError("--time and --view are for a picture: give --screenshot too")
    if save is not None:
        if found.suffix == ".rrd":
            raise InputError(f"{found}: is a replay already; --save makes one of an episode's log")
        print(_written(found, save))
        return
    with _recording(found) as recording:
        if screenshot is not None:
            take_screenshot(recording, screenshot, view, moment(recording, time), window)
            print(f"wrote {screenshot}")
        elif web:
            serve_viewer(recording, lambda url: print(f"open {url} (Ctrl-C ends it)", flush=True))
        else:
            open_viewer(recording)


@contextlib.contextmanager
def _recording(found: Path) -> Iterator[Path]:
    """The replay itself; of a log one that is gone afterwards."""
    from surgisoft.replay.viewer import temporary_recording

    if found.suffix == ".rrd":
        yield found
        return
    with temporary_recording() as recording:
        _written(found, recording)
        yield recording


def _written(log: Path, recording: Path):
    """The replay of an episode's log."""
    from surgisoft.cli.progress import progress
    from surgisoft.replay.episode_view import write_replay
    from surgisoft.tasks.episodes.file import load_episode

    with progress("replay") as report:
        return write_replay(load_episode(log), recording, report=report)
