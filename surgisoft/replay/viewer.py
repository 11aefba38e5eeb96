"""Run the Rerun viewer as a process of its own that never outlives its caller."""

import contextlib
import ctypes
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import rerun as rr

from surgisoft.errors import InputError

LOCAL = "127.0.0.1"
"""The only address ever served on."""


def viewer_command() -> str:
    """The viewer's program, as it came with rerun-sdk."""
    import rerun_cli

    beside = Path(sys.executable).with_name("rerun")
    inside = Path(rerun_cli.__file__).with_name("rerun")
    for program in (inside, beside):
        if program.exists():
            return str(program)
    raise InputError("the Rerun viewer's program is missing: expected it with rerun-sdk")


def free_port() -> int:
    """A port of this machine that nobody listens on."""
    with socket.socket() as probe:
        probe.bind((LOCAL, 0))
        return probe.getsockname()[1]


@contextlib.contextmanager
def temporary_recording() -> Iterator[Path]:
    """A path for a recording that is gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="surgisoft-") as folder:
        yield Path(folder) / "scene.rrd"


def _die_with_parent() -> None:
    """Ask Linux to end this process with the one that started it (prctl(2), PR_SET_PDEATHSIG)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(1, signal.SIGKILL)


@contextlib.contextmanager
def running(*arguments: str, quiet: bool = True) -> Iterator[subprocess.Popen]:
    """The viewer in a session of its own; whatever happens, its whole group ends with the block."""
    sink = subprocess.DEVNULL if quiet else None
    process = subprocess.Popen(
        [viewer_command(), *arguments],
        stdout=sink,
        stderr=sink,
        start_new_session=True,
        preexec_fn=_die_with_parent,
    )
    try:
        yield process
    finally:
        for way, patience in ((signal.SIGTERM, 3.0), (signal.SIGKILL, 3.0)):
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, way)
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(patience)


def wait_for_port(process: subprocess.Popen, port: int, patience_s: float = 30.0) -> None:
    """Until somebody listens on the port; an InputError if the viewer ends or takes too long."""
    end = time.monotonic() + patience_s
    while time.monotonic() < end:
        if process.poll() is not None:
            raise InputError(
                f"the Rerun viewer ended with code {process.returncode}; without a display it "
                "needs a Vulkan driver (Debian: mesa-vulkan-drivers)"
            )
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


def serve_viewer(recording: Path, tell: Callable[[str], None]) -> None:
    """Serve viewer and recording to browsers on this machine until interrupted.

    The recording is handed to the running server: given as an argument of the server, it keeps one
    core busy for ever (rerun-sdk 0.41).
    """
    page, data = free_port(), free_port()
    ports = ("--web-viewer-port", str(page), "--port", str(data))
    with running("--serve-web", "--bind", LOCAL, *ports) as viewer:
        wait_for_port(viewer, page)
        wait_for_port(viewer, data)
        stream = rr.RecordingStream("surgisoft_hand_over")
        stream.connect_grpc(f"rerun+http://{LOCAL}:{data}/proxy")
        stream.log_file_from_path(recording)
        stream.flush()
        stream.disconnect()
        tell(web_address(page, data))
        with contextlib.suppress(KeyboardInterrupt):
            viewer.wait()


def web_address(page: int, data: int) -> str:
    """The page that shows the served recording."""
    source = f"rerun%2Bhttp%3A%2F%2F{LOCAL}%3A{data}%2Fproxy"
    return f"http://{LOCAL}:{page}/?url={source}&renderer=webgl"
