"""A picture of a recording without a display, by the native viewer on a software Vulkan driver."""

import contextlib
import io
import time
import warnings
from pathlib import Path

from surgisoft.errors import InputError
from surgisoft.files import write_atomically
from surgisoft.replay.viewer import LOCAL, free_port, running, wait_for_port

WINDOW = (1600, 1000)
"""Width and height of the invisible window (pixels)."""
LEAST, MOST = 100, 4000
"""Bounds of width and height (points)."""
NOTICES_S = 7.0
"""The viewer's notices about its start lie over the picture for so long (s)."""
PATIENCE_S = 60.0
"""How long the viewer may take to load the recording and draw (s)."""


def parse_size(text: str) -> tuple[int, int]:
    """Width and height from text such as `1600x1000`."""
    width, _, height = text.lower().partition("x")
    if not (width.isdecimal() and height.isdecimal()):
        raise InputError(f"size is '{text}', expected WIDTHxHEIGHT such as 1600x1000")
    size = int(width), int(height)
    if not (min(size) >= LEAST and max(size) <= MOST):
        raise InputError(f"size is '{text}', expected {LEAST} to {MOST} each way")
    return size


def take_screenshot(
    recording: Path,
    picture: Path,
    view: str | None = None,
    cursor: tuple[str, float] | None = None,
    size: tuple[int, int] = WINDOW,
    wait_s: float = NOTICES_S,
) -> None:
    """Draw an .rrd file into a .png: one view by its name, or the whole window.

    `cursor` is a timeline and the place on it, s or a whole number; `size` the window in points,
    which are pixels of the file; before it, `wait_s` for the viewer's notices to go.
    """
    picture = Path(picture)
    if picture.suffix.lower() != ".png":
        raise InputError(f"{picture}: suffix '{picture.suffix}', expected .png")
    if not picture.parent.is_dir():
        raise InputError(f"{picture.parent}: there is no such folder for the picture")
    port = free_port()
    arguments = (str(recording), "--bind", LOCAL, "--port", str(port), "--headless")
    with running(*arguments, "--window-size", f"{size[0]}x{size[1]}") as viewer:
        wait_for_port(viewer, port)
        write_atomically(picture, _draw(port, view, cursor, max(size), wait_s))


def _draw(port: int, view: str | None, cursor, max_size: int, wait_s: float) -> bytes:
    """Ask the running viewer for the picture, once its views are there and their data have come."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from rerun.experimental import ViewerClient

        client = ViewerClient.connect(f"rerun+http://{LOCAL}:{port}/proxy")
        end = time.monotonic() + PATIENCE_S
        found = None
        while found is None and time.monotonic() < end:
            with contextlib.suppress(Exception):
                found = next(v.view_id for v in client.get_state().views if view in (v.name, None))
            time.sleep(0.2)
        if found is None:
            wanted = "no view" if view is None else f"no view '{view}'"
            raise InputError(f"the Rerun viewer shows {wanted} of the recording")
        if cursor is not None:
            place = {"sequence" if isinstance(cursor[1], int) else "duration": cursor[1]}
            client.set_time(cursor[0], **place, play_state="paused")
        time.sleep(wait_s)
        shown = None if view is None else found
        picture, before = client.take_screenshot(shown, max_size=max_size), b""
        while picture != before and time.monotonic() < end:
            time.sleep(0.3)
            before, picture = picture, client.take_screenshot(shown, max_size=max_size)
        return _packed(picture)


def _packed(png: bytes) -> bytes:
    """The same picture in fewer bytes: no transparency, better compressed."""
    from PIL import Image

    file = io.BytesIO()
    Image.open(io.BytesIO(png)).convert("RGB").save(file, "PNG", optimize=True)
    return file.getvalue()
