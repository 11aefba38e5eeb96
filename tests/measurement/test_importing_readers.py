"""Readers of raw formats: by name or ending, from other packages, or named as missing."""

import re
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat

from benchmarks.fuzz.targets import make_c3d, make_matlab
from surgisoft import apart
from surgisoft.cli import run
from surgisoft.errors import InputError
from surgisoft.measurement.importing import READERS, RawTable, Reader, import_files, load_map
from surgisoft.measurement.importing.readers import arrays

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


@pytest.mark.parametrize("zone", [None, "UTC", "Europe/Berlin"])
def test_dates_in_nanoseconds_are_times(tmp_path, zone):
    """As pandas writes them; Python's own dates have microseconds."""
    path, values = tmp_path / "raw.parquet", table()
    steps = np.array([0, 50_000_007, 100_000_014, 150_000_021, 200_000_028])
    dates = pa.array(1_714_564_800_000_000_000 + steps, pa.timestamp("ns", zone))
    columns = {c: values[:, i] for i, c in enumerate("tuxyz")}
    pq.write_table(pa.table(columns | {"t": dates}), path)
    spec = write_map(tmp_path, "auto")
    with pytest.raises(InputError, match=r'column \'t\': holds timestamp.*; unit = "iso" reads'):
        import_files([path], load_map(spec), "r")
    Path(spec).write_text(Path(spec).read_text().replace('"t"\n', '"t"\nunit = "iso"\n', 1))
    (part,) = import_files([path], load_map(spec), "r")
    np.testing.assert_allclose(part.recording.t_s, steps / 1e9, atol=2e-6)


def test_columns_of_one_name_are_read_by_their_numbers(tmp_path):
    path, values = tmp_path / "raw.parquet", table()
    arrays_ = [pa.array(values[:, i]) for i in range(5)]
    pq.write_table(pa.Table.from_arrays(arrays_, names=["t", "u", "x", "x", "x"]), path)
    spec = write_map(tmp_path, "auto")
    Path(spec).write_text(Path(spec).read_text().replace('"x", "y", "z"', "5, 3, 4"))
    (part,) = import_files([path], load_map(spec), "r")
    np.testing.assert_array_equal(part.recording.key_points_mm[:, 0], values[:, [4, 2, 3]])


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
        (
            "broken",
            "reader 'broken' of npy_reader:BROKEN: is a str, expected an instance of Reader",
        ),
        ("absent", "reader 'absent' of npy_reader_absent:READER: cannot be loaded"),
        ("npz", f"expected one of auto, {', '.join(READERS)}, npy, broken, absent"),
    ],
)
def test_what_is_wrong_with_a_reader_of_another_package(tmp_path, plugin, name, expected):
    (tmp_path / "raw.npy").write_bytes(b"")
    with pytest.raises(InputError) as error:
        import_files([tmp_path / "raw.npy"], load_map(write_map(tmp_path, name)), "r")
    assert expected in str(error.value)


@pytest.mark.parametrize(
    ("ending", "kind"),
    [("bag", "ROS bag"), ("tdms", "TDMS"), ("XLSX", "Excel")],
)
def test_a_known_format_that_no_reader_reads_is_named(tmp_path, ending, kind):
    with pytest.raises(InputError) as error:
        load_map(write_map(tmp_path, ending))
    assert "map.toml:2: file.log.format: got text" in str(error.value)
    assert f"{kind}" in str(error.value)
    assert f"expected one of auto, {', '.join(READERS)}; export it as CSV" in str(error.value)
    path = tmp_path / f"raw.{ending}"
    path.write_bytes(b"\1\0\2\0" * 100)
    with pytest.raises(
        InputError, match=rf"raw.{ending}: an? .*{kind}.*for which there is no reader"
    ):
        import_files([path], load_map(write_map(tmp_path, "auto")), "r")


def test_text_with_an_ending_of_another_format_is_text(tmp_path):
    path = tmp_path / "raw.mat"
    path.write_text("t,u,x,y,z\n0,1,2,3,4\n1,2,3,4,5\n")
    (part,) = import_files([path], load_map(write_map(tmp_path, "auto")), "r")
    assert part.recording.samples == 2


# C3D, MATLAB, HDF5 ---------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["auto", "matlab"])
def test_a_matlab_file_of_row_vectors(tmp_path, name):
    """MATLAB's vectors are often rows; what has another length is left out and named."""
    from scipy.io import savemat

    values = table()
    content = {c: values[:, i][None] for i, c in enumerate("tuxyz")}
    savemat(tmp_path / "raw.mat", content | {"gain": np.eye(3), "who": "me"})
    (part,) = import_files([tmp_path / "raw.mat"], load_map(write_map(tmp_path, name)), "r")
    np.testing.assert_array_equal(part.recording.measured[:, 0], values[:, 1])
    np.testing.assert_array_equal(part.recording.key_points_mm[:, 0], values[:, 2:])
    assert any("gain (3 x 3)" in note for note in part.notes)


IN_STRUCT = """\
[file.log]
topic = "trial"
[time]
column = "t"
[measured]
columns = ["p.0", "p.1"]
unit = "kPa"
[key_points]
positions = [["k.0.0", "k.0.1", "k.0.2"], ["k.1.0", "k.1.1", "k.1.2"]]
unit = "m"
"""


def struct():
    rng = np.random.default_rng(2)
    return np.arange(6.0), rng.normal(size=(6, 2)), rng.normal(size=(6, 2, 3))


def check_struct(path, tmp_path):
    _, p, k = struct()
    (tmp_path / "struct.toml").write_text(IN_STRUCT)
    (part,) = import_files([path], load_map(str(tmp_path / "struct.toml")), "r")
    np.testing.assert_array_equal(part.recording.measured, p)
    np.testing.assert_allclose(part.recording.key_points_mm, 1000.0 * k, rtol=1e-12)


def test_structs_of_a_matlab_file(tmp_path):
    from scipy.io import savemat

    t, p, k = struct()
    savemat(tmp_path / "raw.mat", {"trial": {"t": t, "p": p, "k": k}, "other": {"t": t[:3]}})
    check_struct(tmp_path / "raw.mat", tmp_path)


@pytest.mark.parametrize("name", ["raw.h5", "raw.mat"])
def test_groups_of_an_hdf5_file_and_of_matlab_7_3(tmp_path, name):
    """MATLAB writes the axes in the other order, behind a user block of 512 bytes."""
    h5py = pytest.importorskip("h5py", reason="the extra 'lab' is not installed")
    t, p, k = struct()
    matlab = name.endswith("mat")
    with h5py.File(tmp_path / name, "w", userblock_size=512 if matlab else 0) as file:
        group = file.create_group("trial")
        group["t"], group["p"] = (t[None], p.T) if matlab else (t, p)
        group["k"] = k
        file["image"] = np.zeros((40, 30))
    check_struct(tmp_path / name, tmp_path)


@pytest.mark.parametrize("block", [0, 512])
def test_a_process_of_its_own_reads_hdf5(tmp_path, monkeypatch, block):
    """HDF5 writes beyond its memory on some damaged files, which ends the process it is in."""
    h5py = pytest.importorskip("h5py", reason="the extra 'lab' is not installed")
    with h5py.File(tmp_path / "raw.mat", "w", userblock_size=block) as file:
        file["log"] = table()
    started = []

    def ended(module, path):
        started.append((module, path))
        return apart.Ended(-11, b"", b"")

    monkeypatch.setattr(apart, "started", ended)
    (tmp_path / "map.toml").write_text(MAP.replace('format = "FORMAT"', 'topic = "log"'))
    with pytest.raises(InputError, match=r"cannot be read as an HDF5 file .*status -11"):
        import_files([tmp_path / "raw.mat"], load_map(str(tmp_path / "map.toml")), "r")
    assert started == [("surgisoft.measurement.importing.readers.arrays", tmp_path / "raw.mat")]


def test_a_compound_dataset_has_a_column_for_each_field(tmp_path):
    h5py = pytest.importorskip("h5py", reason="the extra 'lab' is not installed")
    values = table()
    rows = np.rec.fromarrays(values.T, names="t,u,x,y,z")
    with h5py.File(tmp_path / "raw.hdf5", "w") as file:
        file["log"] = rows
    text = MAP.replace('format = "FORMAT"', 'topic = "log"')
    (tmp_path / "map.toml").write_text(text)
    (part,) = import_files([tmp_path / "raw.hdf5"], load_map(str(tmp_path / "map.toml")), "r")
    np.testing.assert_array_equal(part.recording.measured[:, 0], values[:, 1])


def test_a_c3d_file_with_a_lost_marker_and_analog_pressures(tmp_path):
    ezc3d = pytest.importorskip("ezc3d", reason="the extra 'lab' is not installed")
    rng = np.random.default_rng(3)
    markers, pressure = rng.normal(size=(8, 2, 3)) * 100.0, rng.normal(size=16)
    markers[4, 1] = np.nan
    made = ezc3d.c3d()
    made["parameters"]["POINT"]["RATE"]["value"] = [50]
    made["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    made["parameters"]["POINT"]["LABELS"]["value"] = ("base", "tip")
    made["parameters"]["ANALOG"]["RATE"]["value"] = [100]
    made["parameters"]["ANALOG"]["LABELS"]["value"] = ("valve",)
    points = np.ones((4, 2, 8))
    points[:3] = np.nan_to_num(markers).transpose(2, 1, 0)  # zeros where it was lost
    residuals = np.zeros((1, 2, 8))
    residuals[0, 1, 4] = -1.0
    made["data"]["meta_points"]["residuals"] = residuals
    made["data"]["points"], made["data"]["analogs"] = points, pressure[None, None]
    made.write(str(tmp_path / "raw.c3d"))
    (tmp_path / "map.toml").write_text(
        '[file.take]\nformat = "c3d"\n[time]\ncolumn = "t_s"\n'
        '[measured]\ncolumns = ["valve"]\nunit = "kPa"\n'
        '[key_points]\npositions = [["base.x", "base.y", "base.z"], ["tip.x", "tip.y", "tip.z"]]\n'
    )
    (part,) = import_files([tmp_path / "raw.c3d"], load_map(str(tmp_path / "map.toml")), "r")
    found = part.recording
    np.testing.assert_allclose(found.t_s, np.arange(8) / 50.0)
    np.testing.assert_allclose(found.key_points_mm, markers, rtol=1e-6)
    means = pressure.reshape(8, 2).mean(axis=1)
    np.testing.assert_allclose(found.measured[:, 0], means, rtol=1e-5)


@pytest.mark.parametrize("ending", ["c3d", "mat", "h5"])
def test_a_damaged_file_of_a_lab_is_one_line(tmp_path, ending):
    path = tmp_path / f"raw.{ending}"
    path.write_bytes(b"\1\0\2\0" * 300)
    with pytest.raises(InputError, match=f"raw.{ending}: "):
        import_files([path], load_map(write_map(tmp_path, "auto")), "r")


@pytest.mark.parametrize(
    ("make", "file", "changes"),
    [
        (make_c3d, "one/raw.c3d", {765: 255, 766: 255, 767: 255, 768: 255}),
        (make_matlab, "plain/raw.mat", {66: 0, 175: 1, 176: 0}),
    ],
)
def test_what_ends_a_library_is_one_line(tmp_path, make, file, changes):
    """Bytes at which ezc3d 1.7 and SciPy 1.17 end in a segmentation fault."""
    pytest.importorskip("ezc3d", reason="the extra 'lab' is not installed")
    make(tmp_path)
    path = tmp_path / file
    content = bytearray(path.read_bytes())
    for at, value in changes.items():
        content[at] = value
    path.write_bytes(content)
    with pytest.raises(InputError, match=f"{path.name}: cannot be read as a .* file"):
        import_files([path], load_map(str(path.parent / "map.toml")), "r")


@pytest.mark.parametrize("ending", ["mat", "h5"])
def test_packed_numbers_take_no_gigabytes(tmp_path, monkeypatch, ending):
    """Zeros of one byte each, 200 kB packed in less than 10 kB, become 1.6 MB of real numbers."""
    h5py = pytest.importorskip("h5py", reason="the extra 'lab' is not installed")
    path, zeros = tmp_path / f"raw.{ending}", np.zeros(200_000, np.uint8)
    if ending == "mat":
        savemat(path, {"t": zeros}, do_compression=True)
    else:
        with h5py.File(path, "w") as file:
            file.create_dataset("t", data=zeros, compression="gzip")
    assert path.stat().st_size < 10_000
    monkeypatch.setattr(arrays, "MOST_UNPACKED", 1 << 20)
    with pytest.raises(InputError, match=r"raw\..* (holds|claims) 1600000 bytes"):
        arrays.as_bytes(path)
    monkeypatch.setattr(arrays, "MOST_UNPACKED", 1 << 21)
    assert arrays.as_bytes(path)


def test_a_matlab_file_that_memory_does_not_hold_is_not_called_damaged(tmp_path, monkeypatch):
    def loadmat(*_, **__):
        raise MemoryError

    path = tmp_path / "raw.mat"
    savemat(path, {"t": np.arange(3.0)})
    monkeypatch.setattr("scipy.io.loadmat", loadmat)
    with pytest.raises(InputError, match=r"raw\.mat: unpacks to more memory than .*compress"):
        arrays.as_bytes(path)


def test_an_hdf5_file_cannot_claim_gigabytes_or_other_files(tmp_path):
    h5py = pytest.importorskip("h5py", reason="the extra 'lab' is not installed")
    path, secret = tmp_path / "raw.h5", tmp_path / "secret.bin"
    secret.write_bytes(np.arange(40.0).tobytes())
    with h5py.File(path, "w") as file:
        file.create_dataset("t", (10**9,), "f8", chunks=True)
    with pytest.raises(InputError, match="'t' claims 8000000000 bytes, in a file of"):
        import_files([path], load_map(write_map(tmp_path, "hdf5")), "r")
    with h5py.File(path, "w") as file:
        file.create_dataset("t", (40,), "f8", external=[(str(secret), 0, 320)])
        file["u"] = np.arange(3.0)
    with pytest.raises(InputError, match=r"expected one of u$"):  # the other file is left out
        import_files([path], load_map(write_map(tmp_path, "hdf5")), "r")


TRC = (
    "PathFileType\t4\t(X/Y/Z)\tcapture.trc\nDataRate\tCameraRate\tNumFrames\tUnits\n"
    "100\t100\t2\tmm\nFrame#\tTime\ttip\n\t\tX1\tY1\tZ1\n\n1\t0.0\t1\t2\t3\n2\t0.01\t1\t2\t4\n"
)


@pytest.mark.parametrize(
    ("name", "content", "kind"),
    [
        ("capture.trc", TRC.encode(), "a TRC file (motion capture"),
        ("state.pkl", b"\x80\x03]q.", "a Python pickle"),
        ("state.pickle", b"(lp0\n.", "a Python pickle"),
        ("state.npy", b"\x93NUMPY\1", "a NumPy array"),
    ],
)
def test_a_known_format_without_a_zero_byte_is_named_too(tmp_path, name, content, kind):
    """The text of a motion capture system, and short files of Python."""
    (tmp_path / name).write_bytes(content)
    said = rf"{name}: {re.escape(kind)}.*, for which there is no reader; export it as CSV"
    with pytest.raises(InputError, match=said) as error:
        import_files([tmp_path / name], load_map(write_map(tmp_path, "auto")), "r")
    assert "\n" not in str(error.value)


def test_a_draft_of_a_pickle_names_the_format(tmp_path, capsys):
    (tmp_path / "state.pkl").write_bytes(b"\x80\x03]q.")
    command = ["import", str(tmp_path / "state.pkl"), "--draft", str(tmp_path / "new.toml")]
    assert run(command) == 2
    assert "state.pkl: a Python pickle, for which there is no reader" in capsys.readouterr().err
