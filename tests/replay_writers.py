"""Writers of replays, for a process of their own: imports only what they need."""

import numpy as np
import rerun as rr

from surgisoft.replay import live_view
from surgisoft.replay.recording import new_recording


def a_replay(path):
    """A replay of some points, with a layout."""
    layout = rr.blueprint.Blueprint(rr.blueprint.Spatial3DView(name="the scene"))
    with new_recording(path, "test", "one", layout) as stream:
        stream.log("points", rr.Points3D(np.arange(900.0).reshape(-1, 3)))


def a_live_view(path):
    """The file of a live view that shows nothing yet."""
    live_view.FLUSH_S = 1.0
    bench = live_view.LiveBench(3, 2, "kPa", 70.0, "a bench", False)
    with live_view.live_view(bench, file=path):
        pass
