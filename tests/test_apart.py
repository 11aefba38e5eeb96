"""Reading in a process of its own: whatever its end, it is one line here."""

import signal
import sys

import numpy as np
import pytest

from surgisoft import apart
from surgisoft.apart import read_apart, started, unpacked
from surgisoft.errors import InputError
from tests import aborting


def read(path):
    return read_apart(aborting.__name__, path, "a test's file")


def test_what_is_read_comes_back(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("whole")
    facts, (numbers, table) = unpacked(read(path))
    assert facts == {"path": "a.txt"}
    np.testing.assert_array_equal(numbers, [0.0, 1.0, 2.0])
    assert table.tolist() == [[1, 2]]


@pytest.mark.parametrize(
    ("way", "said"),
    [
        ("segmentation fault", "cannot be read as a test's file (its process ended with status -"),
        ("exception", "cannot be read as a test's file (last line)"),
        ("memory", "Unable to allocate 32.0 GiB"),
        pytest.param(
            "more memory than a small file needs",
            "Unable to allocate 1.50 GiB",
            marks=pytest.mark.skipif(sys.platform != "linux", reason="Linux alone limits it"),
        ),
        ("refused", "has no frame; expected one"),
    ],
)
def test_every_end_is_one_line(tmp_path, way, said):
    path = tmp_path / "a.txt"
    path.write_text(way)
    with pytest.raises(InputError) as caught:
        read(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert said in str(caught.value)
    assert str(caught.value).count(str(path)) == 1


def test_a_reader_without_end_is_ended(tmp_path):
    """Processor time is limited by the size of the file: 4 s for a small one, here 0.5 s."""
    pytest.importorskip("resource", reason="Windows has no limits")
    path = tmp_path / "a.txt"
    path.write_text("endless")
    assert apart.PATIENCE_S == 4.0
    with pytest.raises(InputError, match=f"status -{signal.SIGXCPU.value}"):
        read(path)


def test_nothing_that_a_process_writes_is_run(tmp_path):
    """An array of Python objects, which would be unpickled, is refused."""
    path = tmp_path / "a.txt"
    path.write_text("whole")
    out = started(aborting.__name__, path).out
    assert unpacked(out)
    np.savez(tmp_path / "b.npz", facts=np.array([object()]))
    with pytest.raises(ValueError, match="allow_pickle"):
        unpacked((tmp_path / "b.npz").read_bytes())


def test_a_limit_that_the_system_refuses_is_left_out(monkeypatch):
    """macOS refuses a limit of the address space; the others are set all the same."""
    resource = pytest.importorskip("resource", reason="Windows has no limits")
    given = []

    def setrlimit(kind, values):
        if kind == resource.RLIMIT_AS:
            raise ValueError("current limit exceeds maximum limit")
        given.append(kind)

    monkeypatch.setattr(resource, "setrlimit", setrlimit)
    apart.limit(1000)
    memory = [resource.RLIMIT_DATA] if apart.STATM.is_file() else []
    assert given == [resource.RLIMIT_CPU, *memory, resource.RLIMIT_CORE]
