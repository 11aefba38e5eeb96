"""Writing of Rerun recordings: nothing of one stays in the process behind it."""

import subprocess
from pathlib import Path

import pytest
import rerun as rr
import rerun.blueprint as rrb

from surgisoft.replay.recording import event_lines, new_recording
from surgisoft.replay.viewer import viewer_command

TASKS = Path("/proc/self/task")


def threads_behind(path, number: int) -> int:
    """Write a recording with a layout; the number of threads behind it."""
    layout = rrb.Blueprint(rrb.TimeSeriesView(origin="/", name="values"))
    with new_recording(path, "test", f"number {number}", layout) as recording:
        recording.log("a", rr.Scalars(1.0))
    return len(list(TASKS.iterdir()))


@pytest.mark.skipif(not TASKS.is_dir(), reason="no list of threads here")
def test_many_recordings_take_no_more_threads_than_two(tmp_path):
    threads = [threads_behind(tmp_path / "a.rrd", number) for number in range(6)]
    assert threads[-1] <= threads[1]


def test_the_layout_is_active_and_not_only_the_default(tmp_path):
    """A browser has opened the recording before its layout arrives, which it would then ignore."""
    layout = rrb.Blueprint(rrb.TimeSeriesView(origin="/", name="values"))
    with new_recording(tmp_path / "a.rrd", "test", "one", layout) as recording:
        recording.log("a", rr.Scalars(1.0))
    command = [viewer_command(), "rrd", "print", str(tmp_path / "a.rrd")]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    activations = [line for line in printed.splitlines() if "BlueprintActivationCommand" in line]
    assert ["make_active: true" in line for line in activations] == [True]


def test_long_events_have_lines_that_the_viewer_shows_whole():
    text = "circle_ablation by runs/long_name in simulation"
    first, *rest = event_lines(3.25, text, 30)
    assert first == "   3.2 s  circle_ablation by"
    assert all(line.startswith(" " * 10) and len(line) <= 40 for line in rest)
    assert " ".join(line[10:] for line in (first, *rest)) == text
