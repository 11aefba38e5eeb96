"""Find a replay and show it: in a window, in a browser, as a picture, or as a file."""

import contextlib
import difflib
from collections.abc import Callable, Iterator
from pathlib import Path

from surgisoft.errors import InputError, path_of
from surgisoft.progress import Progress, silent
from surgisoft.replay.contents import TIME, contents
from surgisoft.replay.episode_view import Replay, layout_names, write_replay
from surgisoft.replay.recording import SUFFIX
from surgisoft.replay.viewer import (
    NotebookView,
    check_picture,
    check_view,
    open_viewer,
    parse_size,
    serve_viewer,
    take_screenshot,
    temporary_recording,
)
from surgisoft.tasks.episodes.file import load_episode

PLACES = (f"*{SUFFIX}", f"replays/*{SUFFIX}", "replays/*.npz")
"""Patterns of replays in a run's folder."""
MOST_NEAR = 5
"""Most replays that a message suggests for a missing one."""
MAGIC = b"RRF2"
"""First bytes of a Rerun recording, as rerun-sdk 0.41 writes it."""


def find_replay(path: str | Path) -> Path:
    """The given replay (.rrd) or episode log (.npz), or the newest replay in a run's folder."""
    path = path_of("the replay", path)
    if path.is_dir():
        replays = [file for place in PLACES for file in path.glob(place) if file.is_file()]
        if not replays:
            raise InputError(
                f"{path}: holds no replay; expected {' or '.join(PLACES)} in it, as "
                "'surgisoft train' writes them"
            )
        return max(replays, key=lambda file: (file.stat().st_mtime_ns, file.name))
    if not path.is_file():
        near = _near(path)
        hint = f"; did you mean {near}?" if near else ""
        raise InputError(
            f"{path}: there is no such file or folder; expected a replay or a run{hint}"
        )
    if path.suffix not in (SUFFIX, ".npz"):
        raise InputError(
            f"{path}: suffix '{path.suffix}', expected a replay ({SUFFIX}), an episode's log "
            "(.npz) or a run's folder"
        )
    if path.suffix == SUFFIX:
        with path.open("rb") as file:
            start = file.read(len(MAGIC))
        if start != MAGIC:
            raise InputError(
                f"{path}: is not a Rerun recording; expected one as 'replay' writes it"
            )
    return path


def _near(path: Path) -> str:
    """Replays that a missing one may mean, in words; empty where there are none.

    Those that `evaluate --replay` writes beside it for several policies (NAME-POLICY.rrd), else
    those of a similar name.
    """
    beside = path.parent.glob("*") if path.parent.is_dir() else ()
    replays = {file.name for file in beside if file.suffix in (SUFFIX, ".npz")}
    near = sorted(name for name in replays if name.startswith(f"{path.stem}-"))
    near = near or difflib.get_close_matches(path.name[:100], sorted(replays), MOST_NEAR)
    shown = [str(path.with_name(name)) for name in near[:MOST_NEAR]]
    return " or ".join([", ".join(shown[:-1]), shown[-1]] if shown[1:] else shown)


def moment(recording: Path, time_s: float | None) -> tuple[str, float] | None:
    """Timeline and time for a screenshot; the default is two thirds of the episode.

    None for a recording without a timeline of seconds, such as a scene's.
    """
    end = contents(recording).duration_s
    if end is None:
        if time_s is not None:
            raise InputError(f"{recording}: has no timeline '{TIME}'; leave --time out")
        return None
    if time_s is not None and not 0.0 <= time_s <= end + 1e-6:
        raise InputError(f"time is {time_s:g} s, expected 0 to {end:g} s as {recording} lasts")
    return TIME, float(end * 2.0 / 3.0 if time_s is None else time_s)


WINDOW = "1600x1000"
"""Default size of the window of a screenshot, in points."""
FRAME = "1200x750"
"""Default size of the frame in a notebook, in points."""


def open_replay(
    what: str | Path,
    *,
    save: str | Path | None = None,
    screenshot: str | Path | None = None,
    web: bool = False,
    notebook: bool = False,
    port: int | None = None,
    size: str | None = None,
    time_s: float | None = None,
    view: str | None = None,
    progress: Progress = silent,
    on_address: Callable[[str], None] = print,
) -> Replay | NotebookView | None:
    """Open an episode in the Rerun viewer: arms, beam, organ, endoscope, plots, events.

    Positions are in mm in the world frame, times in s. Raises InputError where there is no replay,
    and where options do not fit each other.

    what: a replay (.rrd), the log of an episode (.npz), or a folder whose newest replay is opened.
    save: write the replay of a log to this .rrd file instead. screenshot: write a picture to this
    .png file instead, at `time_s` (default: two thirds of the episode), of one `view` or of all,
    from a window of `size`. web: serve the replay to a browser on this machine; `on_address` is
    called with the address, and `port` fixes that of its page and, one above, that of its data.
    notebook: return the viewer as a frame of `size` that Jupyter shows below the cell.
    """
    window, found = parse_size(size or (FRAME if notebook else WINDOW)), find_replay(what)
    if sum((web, notebook, screenshot is not None, save is not None)) > 1:
        raise InputError("expected at most one of --web, --screenshot and --save (and notebook)")
    if port is not None and not (web or notebook):
        raise InputError("--port applies to a browser only: give --web too")
    if screenshot is None and (time_s is not None or view is not None):
        raise InputError("--time and --view apply to a picture only: give --screenshot too")
    if screenshot is not None:
        check_picture(Path(screenshot))
    if size is not None and screenshot is None and not notebook:
        raise InputError("--size applies to a picture only: give --screenshot too")
    if view is not None and found.suffix != SUFFIX:
        check_view(view, layout_names(load_episode(found)))
    if save is not None:
        if found.suffix == ".rrd":
            raise InputError(f"{found}: is a replay already; --save makes one from an episode log")
        return write_replay(load_episode(found), Path(save), report=progress)
    with _recording(found, progress) as recording:
        if screenshot is not None:
            at = moment(recording, time_s)
            take_screenshot(recording, Path(screenshot), view, at, window)
        elif notebook:
            return NotebookView(recording, port, window)
        elif web:
            serve_viewer(recording, on_address, port)
        else:
            open_viewer(recording)
    return None


@contextlib.contextmanager
def _recording(found: Path, progress: Progress) -> Iterator[Path]:
    """The replay itself, or the replay of a log in a temporary file."""
    if found.suffix == ".rrd":
        contents(found)  # the viewer ends without a word where the file is damaged
        yield found
        return
    with temporary_recording() as recording:
        write_replay(load_episode(found), recording, report=progress)
        yield recording
