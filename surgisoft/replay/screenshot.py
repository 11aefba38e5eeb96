"""A picture of a recording without a display, by the native viewer on a software Vulkan driver."""

import contextlib
import time
import warnings
from pathlib import Path

from surgisoft.errors import InputError
from surgisoft.replay.viewer import LOCAL, free_port, running, wait_for_port
from surgisoft.toml_config import write_atomically

WINDOW = (1600, 1000)
"""Width and height of the invisible window (pixels)."""
NOTICES_S = 7.0
"""The viewer's notices about its start lie over the picture for so long (s)."""
PATIENCE_S = 60.0
"""How long the viewer may take to load the recording and draw (s)."""


def take_screenshot(
    recording: Path,
    picture: Path,
    view: str = "Scene",
    timeline: tuple[str, int] | None = ("ring_point", 0),
    max_size: int = 1600,
) -> None:
    """Draw one view of an .rrd file into a .png; `timeline` puts the cursor (name, sequence)."""
    picture = Path(picture)
    if picture.suffix.lower() != ".png":
        raise InputError(f"{picture}: suffix '{picture.suffix}', expected .png")
    if not picture.parent.is_dir():
        raise InputError(f"{picture.parent}: there is no such folder for the picture")
    port = free_port()
    size = f"{WINDOW[0]}x{WINDOW[1]}"
    arguments = (str(recording), "--bind", LOCAL, "--port", str(port), "--headless")
    with running(*arguments, "--window-size", size) as viewer:
        wait_for_port(viewer, port)
        write_atomically(picture, _draw(port, view, timeline, max_size))


def _draw(port: int, view: str, timeline, max_size: int) -> bytes:
    """Ask the running viewer for the picture, once the view is there and its data have come."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        from rerun.experimental import ViewerClient

        client = ViewerClient.connect(f"rerun+http://{LOCAL}:{port}/proxy")
        end = time.monotonic() + PATIENCE_S
        found = None
        while found is None and time.monotonic() < end:
            with contextlib.suppress(Exception):
                found = next(v.view_id for v in client.get_state().views if v.name == view)
            time.sleep(0.2)
        if found is None:
            raise InputError(f"the Rerun viewer shows no view '{view}' of the recording")
        if timeline is not None:
            client.set_time(timeline[0], sequence=timeline[1], play_state="paused")
        time.sleep(NOTICES_S)
        picture, before = client.take_screenshot(found, max_size=max_size), b""
        while picture != before and time.monotonic() < end:
            time.sleep(0.3)
            before, picture = picture, client.take_screenshot(found, max_size=max_size)
        return picture
