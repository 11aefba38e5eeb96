"""Reading of a Rerun recording in a process of its own: a damaged file ends that one only."""

import numpy as np
import pytest
import rerun as rr

from surgisoft.cli import run
from surgisoft.errors import InputError
from surgisoft.replay.contents import contents
from surgisoft.replay.recording import Columns, new_recording


@pytest.fixture(scope="module")
def replay(tmp_path_factory):
    path = tmp_path_factory.mktemp("replay") / "a.rrd"
    layout = rr.blueprint.Blueprint(rr.blueprint.Spatial3DView(name="the scene"))
    with new_recording(path, "surgisoft_test", "one", layout) as recording:
        columns = Columns(recording, np.array([0.0, 0.5, 1.5]))
        columns.send("/a", np.arange(3), rr.Scalars.columns(scalars=np.arange(3.0)))
    return path


def test_duration_and_views_of_a_whole_one(replay):
    found = contents(replay)
    assert found.duration_s == pytest.approx(1.5)
    assert found.views == ("the scene",)


@pytest.mark.parametrize("damage", ["claim", "cut"])
def test_a_damaged_one_is_one_line(replay, tmp_path, capsys, damage):
    """A length of 2^60 bytes: in one process the library would end this test run with SIGABRT."""
    content, copy = bytearray(replay.read_bytes()), tmp_path / "a.rrd"
    if damage == "claim":
        content[24:32] = (1 << 60).to_bytes(8, "little")  # length of the first message
    copy.write_bytes(content if damage == "claim" else content[:30])
    with pytest.raises(InputError, match="cannot be read as a Rerun recording"):
        contents(copy)
    assert run(["replay", str(copy), "--web"]) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_the_library_itself_takes_nothing_of_the_memory_of_a_file(tmp_path):
    """Of 1.6 MB: so large that the 1 GiB that Rerun reserves would fit, but not its threads."""
    path = tmp_path / "a.rrd"
    noise = np.random.default_rng(0).integers(0, 256, 1_600_000, np.uint8)
    with rr.RecordingStream("test") as recording:
        recording.save(path)
        recording.set_time("time", duration=1.5)
        recording.log("noise", rr.Tensor(noise))
    recording.disconnect()
    assert 1.5e6 < path.stat().st_size < 1.7e6
    assert contents(path).duration_s == 1.5
