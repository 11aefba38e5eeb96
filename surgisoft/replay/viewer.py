"""The Rerun viewer as a process that never outlives its caller: window, web server, screenshots.

Screenshots need no display: the native viewer draws them with a Vulkan driver in software.
"""

import atexit
import contextlib
import ctypes
import html
import io
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import rerun as rr

from surgisoft.errors import InputError, unknown_name
from surgisoft.files import check_folder, write_atomically
from surgisoft.replay.contents import contents

LOCAL = "127.0.0.1"
"""The only address that the viewer serves on: this machine."""


def viewer_command() -> str:
    """Path of the viewer's program, which rerun-sdk installs."""
    import rerun_cli

    name = "rerun.exe" if sys.platform == "win32" else "rerun"
    folder = Path(rerun_cli.__file__).parent
    bundle = folder / "Rerun.app" / "Contents" / "MacOS" / "Rerun"  # of macOS
    for program in (bundle, folder / name, Path(sys.executable).with_name(name)):
        if program.exists():
            return str(program)
    raise InputError("the Rerun viewer's program is missing: expected it with rerun-sdk")


def free_port() -> int:
    """A free TCP port of this machine."""
    with socket.socket() as probe:
        probe.bind((LOCAL, 0))
        return probe.getsockname()[1]


@contextlib.contextmanager
def temporary_recording() -> Iterator[Path]:
    """A path for a temporary recording, deleted when the block ends."""
    with tempfile.TemporaryDirectory(prefix="surgisoft-") as folder:
        yield Path(folder) / "scene.rrd"


def _die_with_parent() -> None:
    """Ask Linux to end this process with the one that started it (prctl(2), PR_SET_PDEATHSIG)."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)


def _end(process: subprocess.Popen, patience_s: float = 3.0) -> None:
    """End a process with all that it started: by request, then by force."""
    for force in (False, True):
        with contextlib.suppress(ProcessLookupError):
            if sys.platform == "win32":
                process.kill() if force else process.terminate()
            else:
                os.killpg(process.pid, signal.SIGKILL if force else signal.SIGTERM)
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(patience_s)


@contextlib.contextmanager
def running(*arguments: str, quiet: bool = True) -> Iterator[subprocess.Popen]:
    """Run the viewer in its own session; its process group is ended when the block ends."""
    sink = subprocess.DEVNULL if quiet else None
    process = subprocess.Popen(
        [viewer_command(), *arguments],
        stdout=sink,
        stderr=sink,
        start_new_session=True,
        preexec_fn=_die_with_parent if sys.platform == "linux" else None,
    )
    try:
        yield process
    finally:
        _end(process)


def check_alive(process: subprocess.Popen) -> None:
    """Raise an InputError if the viewer has ended, as it does where it has nothing to draw with."""
    if process.poll() is not None:
        raise InputError(
            f"the Rerun viewer ended with code {process.returncode}; without a display it "
            "needs a Vulkan driver (Debian: mesa-vulkan-drivers)"
        )


def wait_for_port(process: subprocess.Popen, port: int, patience_s: float = 30.0) -> None:
    """Wait until the viewer listens on the port; an InputError if it ends or takes too long."""
    end = time.monotonic() + patience_s
    while time.monotonic() < end:
        check_alive(process)
        with contextlib.suppress(OSError), socket.create_connection((LOCAL, port), 0.2):
            return
        time.sleep(0.05)
    raise InputError(f"the Rerun viewer did not start within {patience_s:g} s")


def open_viewer(recording: Path) -> None:
    """Open the native viewer and wait until it is closed."""
    port = str(free_port())
    with running(str(recording), "--bind", LOCAL, "--port", port, quiet=False) as viewer:
        if viewer.wait() != 0:
            raise InputError(
                "the Rerun viewer could not open a window; use --web or --screenshot without a "
                "display"
            )


@contextlib.contextmanager
def served(recording: Path, port: int | None = None) -> Iterator[tuple[subprocess.Popen, str]]:
    """Serve viewer and recording on this machine until the block ends: its process and address.

    port: that of the page, and the next one is that of the data; None: two free ones. An InputError
    where one of them is in use. The recording is sent to the running server: as an argument of the
    server it would keep one core busy for ever (rerun-sdk 0.41).
    """
    page, data = (free_port(), free_port()) if port is None else (port, port + 1)
    for number in (page, data):
        _check_free(number)
    ports = ("--web-viewer-port", str(page), "--port", str(data))
    with running("--serve-web", "--bind", LOCAL, *ports) as viewer:
        wait_for_port(viewer, page)
        wait_for_port(viewer, data)
        stream = rr.RecordingStream("surgisoft_hand_over")
        stream.connect_grpc(f"rerun+http://{LOCAL}:{data}/proxy")
        stream.log_file_from_path(recording)
        stream.flush()
        stream.disconnect()
        yield viewer, web_address(page, data)


def serve_viewer(
    recording: Path, on_address: Callable[[str], None], port: int | None = None
) -> None:
    """Serve viewer and recording to browsers on this machine until interrupted; see `served`."""
    with served(recording, port) as (viewer, address):
        on_address(address)
        with contextlib.suppress(KeyboardInterrupt):
            viewer.wait()


class NotebookView:
    """The viewer in a frame below a notebook's cell, served until `close` or the kernel's end."""

    def __init__(self, recording: Path, port: int | None, size: tuple[int, int]):
        self.size = size
        self._server = contextlib.ExitStack()
        self.address = self._server.enter_context(served(recording, port))[1]
        atexit.register(self.close)

    def _repr_html_(self) -> str:
        """The frame: as wide as the cell, at most the given width."""
        width, height = self.size
        style = f"width: 100%; max-width: {width}px; height: {height}px; border: 0"
        address = html.escape(self.address)
        return f'<iframe src="{address}" title="Replay" style="{style}" allowfullscreen></iframe>'

    def __repr__(self) -> str:
        return f"replay at {self.address}; close() ends it"

    def close(self) -> None:
        """End the viewer."""
        atexit.unregister(self.close)
        self._server.close()


def _check_free(port: int) -> None:
    """Raise an InputError unless a TCP port of this machine is free."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((LOCAL, port))
        except (OSError, OverflowError):
            raise InputError(
                f"--port {port}: cannot be used; expected a free port above 1023, and the next one"
            ) from None


def web_address(page: int, data: int) -> str:
    """Address of the page that shows the served recording."""
    source = f"rerun%2Bhttp%3A%2F%2F{LOCAL}%3A{data}%2Fproxy"
    return f"http://{LOCAL}:{page}/?url={source}&renderer=webgl"


WINDOW = (1600, 1000)
"""Width and height of the invisible window (pixels)."""
LEAST, MOST = 100, 4000
"""Bounds of width and height (points)."""
NOTICES_S = 7.0
"""Time for which the viewer's start-up notices cover the picture (s)."""
PATIENCE_S = 180.0
"""Longest time for the viewer to load the recording and draw (s); a machine with a load of 20 on
two cores takes 60."""


def parse_size(text: str) -> tuple[int, int]:
    """Width and height from text such as `1600x1000`."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise InputError(f"size is '{text}', expected WIDTHxHEIGHT such as 1600x1000")
    size = int(width), int(height)
    if not (min(size) >= LEAST and max(size) <= MOST):
        raise InputError(f"size is '{text}', expected {LEAST} to {MOST} each way")
    return size


def check_view(view: str, names: Sequence[str]) -> None:
    """Raise an InputError that lists the known views, unless `view` is one or none is known."""
    if names and view not in names:
        raise unknown_name("view", view, sorted(names))


def check_picture(picture: Path) -> None:
    """Raise InputError where a screenshot cannot be written to this file."""
    if picture.suffix.lower() != ".png":
        raise InputError(f"{picture}: suffix '{picture.suffix}', expected .png")
    if picture.is_dir():
        raise InputError(f"{picture}: is a folder, expected a file to write")
    check_folder(picture.absolute().parent)


def take_screenshot(
    recording: Path,
    picture: Path,
    view: str | None = None,
    cursor: tuple[str, float] | None = None,
    size: tuple[int, int] = WINDOW,
    wait_s: float = NOTICES_S,
) -> None:
    """Draw an .rrd file into a .png: one view by its name, or the whole window.

    `cursor` is a timeline and the position on it, s or an integer. `size` is that of the window in
    points, which are the pixels of the file. `wait_s` is the time until the viewer's start-up
    notices disappear.
    """
    picture = Path(picture)
    if view is not None:
        check_view(view, contents(recording).views)
    check_picture(picture)
    port = free_port()
    arguments = (str(recording), "--bind", LOCAL, "--port", str(port), "--headless")
    with running(*arguments, "--window-size", f"{size[0]}x{size[1]}") as viewer:
        wait_for_port(viewer, port)
        write_atomically(picture, _draw(viewer, port, view, cursor, max(size), wait_s))


def _draw(
    viewer: subprocess.Popen,
    port: int,
    view: str | None,
    cursor: tuple[str, Any] | None,
    max_size: int,
    wait_s: float,
) -> bytes:
    """The picture from the running viewer, after its views and their data are loaded.

    A viewer without a graphics driver listens on its port first and ends with its first frame.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from rerun.experimental import ViewerClient

        end = time.monotonic() + PATIENCE_S
        client = found = None
        while found is None and time.monotonic() < end:
            check_alive(viewer)
            with contextlib.suppress(Exception):
                client = client or ViewerClient.connect(f"rerun+http://{LOCAL}:{port}/proxy")
                found = next(v.view_id for v in client.get_state().views if view in (v.name, None))
            time.sleep(0.2)
        if client is None or found is None:
            wanted = "no view" if view is None else f"no view '{view}'"
            raise InputError(f"the Rerun viewer shows {wanted} of the recording")
        if cursor is not None:
            place = {"sequence" if isinstance(cursor[1], int) else "duration": cursor[1]}
            client.set_time(cursor[0], **place, play_state="paused")
        time.sleep(wait_s)
        shown = None if view is None else found
        picture, before = painted(client, shown, max_size, end), b""
        while picture != before and time.monotonic() < end:
            time.sleep(0.3)
            before, picture = picture, painted(client, shown, max_size, end)
        return _packed(picture)


def painted(client: Any, view_id: Any, max_size: int, end: float) -> bytes:
    """The viewer's picture as PNG; it has 15 s for one, and is asked again until the time `end`."""
    while True:
        try:
            return client.take_screenshot(view_id, max_size=max_size)
        except TimeoutError:
            if time.monotonic() > end:
                raise InputError(
                    f"the Rerun viewer drew no picture within {PATIENCE_S:g} s, as on a machine "
                    "that is busy with other work; try again later"
                ) from None


def _packed(png: bytes) -> bytes:
    """The picture without transparency and better compressed."""
    from PIL import Image

    file = io.BytesIO()
    Image.open(io.BytesIO(png)).convert("RGB").save(file, "PNG", optimize=True)
    return file.getvalue()
