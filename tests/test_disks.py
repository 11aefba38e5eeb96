"""Full disks, folders that cannot be written, two writers: the old output or the new one."""

import multiprocessing
import os
import re
import subprocess
import sys
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch import nn

import surgisoft
from surgisoft.agents import run_folder
from surgisoft.errors import InputError
from surgisoft.files import new_file, new_folder, write_atomically, write_json
from surgisoft.graphs import write_torch_script
from surgisoft.measurement.recordings import load_recording, save_recording
from surgisoft.surrogate.checkpoint import default_arm, load_model, save_model
from tests.diagnosis.synthetic import recording, walk

resource = pytest.importorskip("resource", reason="limits of a process, which Windows lacks")

FULL = """
import os, sys
from pathlib import Path
import numpy as np
from surgisoft.surrogate.checkpoint import default_arm, save_model
from surgisoft.measurement.recordings import save_recording
from tests.diagnosis.synthetic import recording, walk
disk = Path(sys.argv[1])
made = recording(np.zeros(4000), walk(4000))
for call in (lambda: save_model(default_arm(), disk / "arm", force=True),
             lambda: save_recording(made, disk / "a.csv", force=True)):
    try:
        call()
        print("written")
    except OSError as error:
        print("full" if error.errno == 28 else error)
    except ValueError as error:
        print("full" if "No space left" in str(error) else error)
"""


MODEL = '{"arm":{},"network":{}}'
"""What a folder of a model holds, so that it may be replaced."""


def test_a_full_disk_leaves_the_old_output(tmp_path):
    """A file system of 300 kB in memory, on which a model of 340 kB cannot be written."""
    if os.geteuid() != 0:
        pytest.skip("mounting needs root")
    disk = tmp_path / "disk"
    disk.mkdir()
    script = (
        f"mount -t tmpfs -o size=300k none {disk} || exit 77; mkdir {disk}/arm;"
        f"echo '{MODEL}' > {disk}/arm/config.json; echo old > {disk}/a.csv;"
        f"{sys.executable} -c '{FULL}' {disk} && cat {disk}/arm/config.json {disk}/a.csv;"
        f"ls -A {disk}"
    )
    done = subprocess.run(["unshare", "-m", "sh", "-c", script], capture_output=True, text=True)
    if done.returncode == 77 or "unshare" in done.stderr:
        pytest.skip("no mount namespaces here")
    assert done.stdout.split() == ["full", "full", MODEL, "old", "a.csv", "arm"], done.stderr


def limited(call, path, size: int = 300) -> str:
    """How a write ends in a process that may make no file of more than `size` bytes."""
    reading, writing = os.pipe()
    pid = os.fork()
    if pid == 0:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
        try:
            call(path)
            said = "written"
        except (InputError, OSError) as error:
            said = f"one line, {'File too large' in str(error)}"
        except BaseException as error:
            said = repr(error)
        os.write(writing, said.encode())
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        said = pipe.read()
    return said if os.waitpid(pid, 0)[1] == 0 else "its process was ended"


@pytest.fixture(scope="module")
def limited_alone(tmp_path_factory):
    """As `limited` for each writer of replays and size, in a new process: Rerun's threads do not
    survive a fork. What it says of each writer, and the folder of the writer's file."""
    place = tmp_path_factory.mktemp("alone")
    code = f"""
import resource
from pathlib import Path
from surgisoft.errors import InputError
from tests import replay_writers
for writer, sizes in {REPLAYS!r}.items():
    path = Path({str(place)!r}) / writer / "a.rrd"
    path.parent.mkdir()
    path.write_text("old")
    for size in sizes:
        hard = resource.getrlimit(resource.RLIMIT_FSIZE)[1]
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            getattr(replay_writers, writer)(path)
            said = "written"
        except (InputError, OSError) as error:
            said = "one line, " + str("File too large" in str(error))
        print("result:", writer, said, path.stat().st_size)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    lines = [line.partition(" ")[2] for line in done.stdout.splitlines() if "result: " in line]

    def found(writer):
        said = [line.removeprefix(f"{writer} ") for line in lines if line.startswith(f"{writer} ")]
        assert len(said) == 2, done.stderr
        return said, place / writer

    return found


REPLAYS = {"a_replay": (300, 1 << 30), "a_live_view": (0, 1 << 30)}
"""Writers of `tests.replay_writers`, and the most bytes of a file in two calls of each."""


def a_graph(path):
    with new_file(path) as fresh:
        write_torch_script(nn.Linear(9, 9), [torch.zeros(1, 9)], fresh)


MADE = recording(np.zeros(400), walk(400))
WRITERS = {
    "a.csv": lambda path: save_recording(MADE, path, force=True),
    "a.parquet": lambda path: save_recording(MADE, path, force=True),
    "arm.pt": a_graph,
    "a.json": lambda path: write_json(path, list(range(900))),
}
"""What writes a file of more than 300 bytes, by the file's name."""


@pytest.mark.parametrize("name", WRITERS)
def test_a_write_that_ends_in_the_middle_leaves_the_old_file(tmp_path, name):
    """As where a quota is used up: half of the file is written, and the next write fails."""
    path = tmp_path / name
    path.write_text("old")
    assert limited(WRITERS[name], path) == "one line, True"
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == {name: "old"}
    assert limited(WRITERS[name], path, 1 << 30) == "written"
    assert path.stat().st_size > 300


def test_a_replay_that_ends_in_the_middle_leaves_the_old_file(limited_alone):
    said, folder = limited_alone("a_replay")
    assert said[0] == "one line, True 3"
    assert said[1].startswith("written ")
    assert int(said[1].split()[1]) > 300
    assert [file.name for file in folder.iterdir()] == ["a.rrd"]


def test_a_live_view_ends_where_its_file_cannot_be_written(limited_alone):
    said, _ = limited_alone("a_live_view")
    assert said[0].startswith("one line")
    assert said[0].endswith(" 3"), "the old file"
    assert said[1].startswith("written ")
    assert int(said[1].split()[1]) > 300


@pytest.mark.skipif(getattr(os, "geteuid", lambda: 1)() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_one_line(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="not a writable folder"):
        save_model(default_arm(), tmp_path / "arm")
    with pytest.raises(InputError, match="cannot be written"):
        save_recording(recording([0.0] * 9, walk(9)), tmp_path / "a.csv")


def _write(folder, number):
    for _ in range(60):
        write_atomically(folder / "file", bytes([number]) * 200_000)


def test_of_two_writers_of_a_file_one_wins_whole(tmp_path):
    context = multiprocessing.get_context("fork")
    some = [context.Process(target=_write, args=(tmp_path, number)) for number in (1, 2)]
    for one in some:
        one.start()
    seen = set()
    while any(one.is_alive() for one in some):
        if (tmp_path / "file").is_file():
            content = (tmp_path / "file").read_bytes()
            assert len(content) == 200_000
            seen.add(content[0])
            assert content == content[:1] * 200_000
    assert [one.exitcode for one in some] == [0, 0]
    assert seen <= {1, 2}
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_second_writer_of_a_folder_does_not_mix_with_the_first(tmp_path):
    """The second one finishes while the first is writing; the first replaces it as a whole."""
    target = tmp_path / "made"
    with new_folder(target, own=("a", "b")) as first:
        (first / "a").write_text("1")
        with new_folder(target, own=("a", "b")) as second:
            (second / "a").write_text("2")
            (second / "b").write_text("2")
        assert (target / "b").read_text() == "2"
    assert {path.name: path.read_text() for path in target.iterdir()} == {"a": "1"}


def test_a_clock_that_goes_back_changes_nothing_that_is_read(tmp_path):
    save_model(default_arm(), tmp_path / "arm")
    save_recording(recording([0.0] * 9, walk(9)), tmp_path / "a.csv")
    for path in tmp_path.rglob("*"):
        os.utime(path, (0, 0))
    assert load_model(tmp_path / "arm").spec == default_arm().spec
    assert load_recording(tmp_path / "a.csv").samples == 9


def test_a_clock_that_jumps_decides_nothing():
    """Times are those of the monotonic clock; the wall clock gives names, dates and guesses."""
    package = Path(surgisoft.__file__).parent
    calendar = re.compile(r"time\.time(_ns)?\(|datetime\.(utc)?now|\.(to)?today\(")
    found = {
        str(path.relative_to(package))
        for path in package.rglob("*.py")
        if calendar.search(path.read_text())
    }
    assert found == {
        "agents/run_folder.py",  # name of a new run's folder, which need not be free; its date
        "cli/progress.py",  # when a command will have ended
    }


def test_two_runs_of_one_second_get_two_folders(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run_folder, "datetime", SimpleNamespace(now=lambda: datetime(2026, 1, 1)))
    names = []
    for _ in range(3):
        names.append(run_folder.default_folder("reach"))
        names[-1].mkdir(parents=True)
    assert [path.name for path in names] == [
        f"reach-20260101-000000{end}" for end in ("", "-1", "-2")
    ]
