"""Readers of raw formats: by name or ending, from other packages, or named as missing."""

import re
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from surgisoft.cli import run
from surgisoft.errors import InputError
from surgisoft.measurement.importing import READERS, RawTable, Reader, import_files, load_map

MAP = """\
[file.log]
format = "FORMAT"
[time]
column = "t"
[measured]
columns = ["u"]
unit = "kPa"
[key_points]
positions = [["x", "y", "z"]]
unit = "mm"
"""

DOCS = Path(__file__).resolve().parents[2] / "docs" / "recordings.md"
PLUGIN = (
    re.search(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL)[1] + 'BROKEN = "no reader"\n'
)
"""The reader that the documentation shows, and one that is wrong."""


def write_map(tmp_path, name):
    path = tmp_path / "map.toml"
    path.write_text(MAP.replace("FORMAT", name))
    return str(path)


def table():
    return np.column_stack([np.arange(5.0), np.random.default_rng(0).normal(size=(5, 4))])


@pytest.fixture
def plugin(tmp_path, monkeypatch):
    """An installed package with two entry points, as pip would leave it."""
    site = tmp_path / "site"
    (site / "npy_reader-1.0.dist-info").mkdir(parents=True)
    (site / "npy_reader.py").write_text(PLUGIN)
    (site / "npy_reader-1.0.dist-info" / "METADATA").write_text("Name: npy_reader\nVersion: 1.0\n")
    (site / "npy_reader-1.0.dist-info" / "entry_points.txt").write_text(
        "[surgisoft.readers]\nnpy = npy_reader:READER\nbroken = npy_reader:BROKEN\n"
        "absent = npy_reader_absent:READER\n"
    )
    monkeypatch.syspath_prepend(str(site))
    yield
    sys.modules.pop("npy_reader", None)


@pytest.mark.parametrize("name", ["parquet", "auto"])
def test_parquet_by_name_and_by_ending(tmp_path, name):
    path, values = tmp_path / "raw.parquet", table()
    pq.write_table(pa.table({c: values[:, i] for i, c in enumerate("tuxyz")}), path)
    (part,) = import_files([path], load_map(write_map(tmp_path, name)), "r")
    np.testing.assert_array_equal(part.recording.measured[:, 0], values[:, 1])


def test_a_reader_of_another_package(tmp_path, plugin):
    path, values = tmp_path / "raw.npy", table()
    np.save(path, values)
    (part,) = import_files([path], load_map(write_map(tmp_path, "npy")), "r")
    np.testing.assert_array_equal(part.recording.key_points_mm[:, 0], values[:, 2:])


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "raw.npy: cannot be read as a numpy array (EOFError: No data left in file)"),
        (b"no array", "raw.npy: cannot be read as a numpy array (ValueError: "),
        (np.zeros((5, 2)), "raw.npy: got 5 rows of 2 columns, expected 5 columns: t, u, x, y, z"),
    ],
)
def test_a_file_that_the_reader_of_the_documentation_cannot_read(
    tmp_path, plugin, monkeypatch, capsys, content, expected
):
    monkeypatch.chdir(tmp_path)
    if isinstance(content, bytes):
        Path("raw.npy").write_bytes(content)
    else:
        np.save("raw.npy", content)
    write_map(tmp_path, "npy")
    assert run(["import", "raw.npy", "--map", "map.toml", "-o", "out.parquet"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"surgisoft: error: {expected}")
    assert not Path("out.parquet").exists()


def test_a_reader_that_names_more_columns_than_its_cells_have(tmp_path, monkeypatch):
    class Cells:
        def numbers(self, positions):
            return np.zeros((3, 2))[:, list(positions)]

    names = ["t", "u", "x", "y", "z"]
    two = Reader("two columns", lambda path, role: RawTable(path, names, Cells()))
    monkeypatch.setitem(READERS, "text", two)
    (tmp_path / "a.csv").write_text("t,u\n")
    with pytest.raises(InputError, match=r"a\.csv: got fewer columns than the 5 that its reader"):
        import_files([tmp_path / "a.csv"], load_map(write_map(tmp_path, "text")), "r")


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("broken", "reader 'broken' of npy_reader:BROKEN: is no Reader; expected an instance"),
        ("absent", "reader 'absent' of npy_reader_absent:READER: cannot be loaded"),
        ("npz", "expected one of auto, text, parquet, motive, mcap, npy, broken, absent"),
    ],
)
def test_what_is_wrong_with_a_reader_of_another_package(tmp_path, plugin, name, expected):
    (tmp_path / "raw.npy").write_bytes(b"")
    with pytest.raises(InputError) as error:
        import_files([tmp_path / "raw.npy"], load_map(write_map(tmp_path, name)), "r")
    assert expected in str(error.value)


@pytest.mark.parametrize(
    ("ending", "kind"),
    [("c3d", "C3D"), ("bag", "ROS bag"), ("mat", "MATLAB"), ("h5", "HDF5"), ("H5", "HDF5")],
)
def test_a_known_format_that_no_reader_reads_is_named(tmp_path, ending, kind):
    with pytest.raises(InputError) as error:
        load_map(write_map(tmp_path, ending))
    assert "map.toml:2: file.log.format: got text" in str(error.value)
    assert f"{kind}" in str(error.value)
    assert f"expected one of auto, {', '.join(READERS)}; export it as CSV" in str(error.value)
    path = tmp_path / f"raw.{ending}"
    path.write_bytes(b"\1\0\2\0" * 100)
    with pytest.raises(InputError, match=rf"raw.{ending}: an? .*{kind}.*which no reader reads"):
        import_files([path], load_map(write_map(tmp_path, "auto")), "r")


def test_text_with_an_ending_of_another_format_is_text(tmp_path):
    path = tmp_path / "raw.mat"
    path.write_text("t,u,x,y,z\n0,1,2,3,4\n1,2,3,4,5\n")
    (part,) = import_files([path], load_map(write_map(tmp_path, "auto")), "r")
    assert part.recording.samples == 2
