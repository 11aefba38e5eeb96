"""Which replay a path names, and a viewer that is slow to draw it."""

import os
import sys
import time

import pytest

from surgisoft.errors import InputError
from surgisoft.replay import viewer
from surgisoft.replay.show import MAGIC, find_replay, open_replay
from surgisoft.replay.viewer import painted


def test_the_newest_replay_of_a_run_is_found(tmp_path):
    (tmp_path / "replays").mkdir()
    places = [tmp_path / "replays" / "step_9.rrd", tmp_path / "replays" / "step_10.rrd"]
    places.append(tmp_path / "replay.rrd")
    for age, path in zip((30, 10, 20), places, strict=True):
        path.write_bytes(MAGIC)
        os.utime(path, (1e9 - age, 1e9 - age))
    assert find_replay(tmp_path) == places[1]
    assert find_replay(places[0]) == places[0]


@pytest.mark.parametrize(
    ("there", "hint"),
    [
        (["ring-ring.rrd", "ring-random.rrd", "other.rrd"], "ring-random.rrd or {}/ring-ring.rrd?"),
        (["rings.rrd", "unlike.npz", "ring.txt"], "rings.rrd?"),
        (["unlike.npz", "ring.txt"], None),
    ],
)
def test_a_missing_replay_is_told_with_those_of_its_name(tmp_path, there, hint):
    """First those that `evaluate --replay` wrote for several policies."""
    for name in there:
        (tmp_path / name).write_bytes(MAGIC)
    with pytest.raises(InputError) as told:
        find_replay(tmp_path / "ring.rrd")
    missing = (
        f"{tmp_path / 'ring.rrd'}: there is no such file or folder; expected a replay or a run"
    )
    more = f"; did you mean {tmp_path}/{hint.format(tmp_path)}" if hint else ""
    assert str(told.value) == missing + more


def test_a_picture_that_cannot_be_written_is_told_before_the_replay_is_made(tmp_path, monkeypatch):
    (tmp_path / "a.npz").touch()
    (tmp_path / "b.png").mkdir()
    monkeypatch.setattr("surgisoft.replay.show.load_episode", lambda _: pytest.fail("read"))
    for name, message in (("a.jpg", "expected .png"), ("b.png", "is a folder")):
        with pytest.raises(InputError, match=message):
            open_replay(tmp_path / "a.npz", screenshot=tmp_path / name)


class Busy:
    """A viewer that misses its own time limit a number of times before it draws."""

    def __init__(self, misses: int):
        self.misses = misses

    def take_screenshot(self, view_id, *, max_size):
        if self.misses:
            self.misses -= 1
            raise TimeoutError("Deadline expired before operation could complete")
        return f"{view_id} {max_size}".encode()


def test_a_busy_viewer_is_asked_again_until_the_end():
    assert painted(Busy(2), "Scene", 1600, time.monotonic() + 60.0) == b"Scene 1600"
    with pytest.raises(InputError, match="drew no picture within 180 s"):
        painted(Busy(2), "Scene", 1600, time.monotonic() - 1.0)


def test_a_viewer_that_cannot_draw_is_told_at_once(tmp_path, monkeypatch):
    """Without a graphics driver the viewer listens on its port and ends with its first frame."""
    program = tmp_path / "rerun"
    program.write_text(
        f"#!{sys.executable}\n"
        "import socket, sys\n"
        "port = int(sys.argv[sys.argv.index('--port') + 1])\n"
        "socket.create_server(('127.0.0.1', port)).accept()\n"
        "sys.exit(102)\n"
    )
    program.chmod(0o755)
    monkeypatch.setattr(viewer, "viewer_command", lambda: str(program))
    begin = time.monotonic()
    with pytest.raises(InputError, match=r"ended with code 102.*mesa-vulkan-drivers"):
        viewer.take_screenshot(tmp_path / "a.rrd", tmp_path / "a.png")
    assert time.monotonic() - begin < 30.0
    assert not (tmp_path / "a.png").exists()
