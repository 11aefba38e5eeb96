"""Show what was recorded: in a window, in a browser, as a picture, or as a file."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path

from surgisoft.errors import InputError
from surgisoft.progress import Progress, silent
from surgisoft.replay.episode_view import Replay, write_replay
from surgisoft.replay.find import find_replay, moment
from surgisoft.replay.screenshot import parse_size, take_screenshot
from surgisoft.replay.viewer import open_viewer, serve_viewer, temporary_recording
from surgisoft.tasks.episodes.file import load_episode

WINDOW = "1600x1000"
"""Size of a picture's window, in points."""


def open_replay(
    what: str | Path,
    *,
    save: str | Path | None = None,
    screenshot: str | Path | None = None,
    web: bool = False,
    size: str = WINDOW,
    time_s: float | None = None,
    view: str | None = None,
    progress: Progress = silent,
    on_address: Callable[[str], None] = print,
) -> Replay | None:
    """Open an episode in the Rerun viewer: arms, beam, organ, endoscope, plots, events.

    what: a replay (.rrd), the log of an episode (.npz), or a folder, whose newest replay it is.
    save: write the replay of a log there (.rrd) instead. screenshot: write a picture there, of the
    moment `time_s` (default: two thirds through), of one `view` or all, in a window of `size`.
    web: serve it to a browser on this machine; `on_address` is called with the address.
    """
    window, found = parse_size(size), find_replay(what)
    if sum((web, screenshot is not None, save is not None)) > 1:
        raise InputError("expected at most one of --web, --screenshot and --save")
    if screenshot is None and (time_s is not None or view is not None):
        raise InputError("--time and --view are for a picture: give --screenshot too")
    if save is not None:
        if found.suffix == ".rrd":
            raise InputError(f"{found}: is a replay already; --save makes one of an episode's log")
        return write_replay(load_episode(found), Path(save), report=progress)
    with _recording(found, progress) as recording:
        if screenshot is not None:
            at = moment(recording, time_s)
            take_screenshot(recording, Path(screenshot), view, at, window)
        elif web:
            serve_viewer(recording, on_address)
        else:
            open_viewer(recording)
    return None


@contextlib.contextmanager
def _recording(found: Path, progress: Progress) -> Iterator[Path]:
    """A replay itself; the replay of a log for the time of the block."""
    if found.suffix == ".rrd":
        yield found
        return
    with temporary_recording() as recording:
        write_replay(load_episode(found), recording, report=progress)
        yield recording
