"""Recordings, maps and raw files with unusual or impossible content: what comes, and which line."""

import json
import math
import os
import re
import sys
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scipy.io import savemat

from surgisoft.apart import unpacked
from surgisoft.measurement.histories import actuation_of
from surgisoft.measurement.importing import draft_map, import_files, load_map
from surgisoft.measurement.importing.plausible import plausibility_notes
from surgisoft.measurement.importing.readers import c3d
from surgisoft.measurement.importing.readers.c3d import as_bytes
from surgisoft.measurement.importing.rotation import between, check_pose
from surgisoft.measurement.protocols import Protocol
from surgisoft.measurement.protocols.schedule_file import load_schedule
from surgisoft.measurement.protocols.steady_state import lattice_size
from surgisoft.measurement.recordings import (
    ArmInfo,
    Recording,
    load_recording,
    load_recordings,
    save_recording,
    save_recordings,
    summary,
)
from surgisoft.measurement.recordings.file import check_writable, open_table
from surgisoft.measurement.recordings.lerobot import load_lerobot, save_lerobot
from surgisoft.measurement.recordings.log import read_log
from surgisoft.measurement.recordings.predictions import with_predictions
from surgisoft.measurement.recordings.quality import without_spikes
from surgisoft.measurement.tables import DelimitedText, label
from surgisoft.measurement.units import factor, other_units
from tests.refusals import refusal


def recording(rows: int = 8, **more) -> Recording:
    """Two chambers and two key points, 0.1 s a row."""
    rng = np.random.default_rng(0)
    given = {
        "name": "rec", "t_s": 0.1 * np.arange(rows), "measured": rng.uniform(0, 9, (rows, 2)),
        "key_points_mm": rng.normal(0, 9, (rows, 2, 3)),
    }  # fmt: skip
    return Recording(**(given | more))


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"kind": "live"}, "protocol 'p': kind is 'live', expected one of"),
        ({"commands": np.zeros(3)}, "commands (3,) and runs (3,), expected (T, m) and (T,)"),
        ({"run": np.zeros(2)}, "commands (3, 2) and runs (2,), expected (T, m) and (T,)"),
        ({"commands": np.array([[1, 1], [1, math.nan], [1, 1]])}, "the command of row 2 is not f"),
        (
            {"run": np.array([0, 1, 0])},
            "a run appears again after another run; keep its rows together",
        ),
        ({"kind": "settled", "average_s": 0.0}, "settle_s 3.0 and average_s 0.0, expected >= 0"),
        ({"t_s": None}, "a continuous protocol needs a time for every row"),
        ({"t_s": np.zeros(3)}, "time does not increase at row 2; each run needs rising times"),
        ({"run": np.array([0, 0, 1])}, "a run has one row; a continuous run needs at least two"),
    ],
)
def test_a_protocol_that_cannot_be_run_is_one_line(fields, message):
    given = {
        "name": "p", "kind": "continuous", "commands": np.ones((3, 2)), "run": np.zeros(3),
        "t_s": np.arange(3.0),
    }  # fmt: skip
    assert message in refusal(lambda: Protocol(**(given | fields)))


def test_a_lattice_is_the_smallest_with_as_many_points():
    for chambers in (1, 2, 3, 5):
        for points in range(1, 300):
            levels = lattice_size(points, chambers)
            assert levels**chambers >= points
            assert levels == 2 or (levels - 1) ** chambers < points


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"t_s": np.zeros((8, 1))}, "times have shape (8, 1), expected (T,) with T >= 1"),
        ({"measured": np.zeros(8)}, "measured actuation has shape (8,), expected (T, m) with m >="),
        ({"key_points_mm": np.zeros((8, 6))}, "key points have shape (8, 6), expected (T, n, 3)"),
    ],
)
def test_a_recording_of_another_shape_is_refused(fields, message):
    assert message in refusal(lambda: recording(**fields))


def test_paths_that_cannot_hold_a_recording(tmp_path):
    (tmp_path / "full").mkdir()
    save_recording(recording(), tmp_path / "full" / "a.csv")
    (tmp_path / "b.csv").mkdir()
    os.mkfifo(tmp_path / "pipe.csv")
    twice = [recording(), recording()]
    for call, message in (
        (lambda: check_writable(tmp_path / "a.txt"), "suffix '.txt', expected .csv or .parquet"),
        (lambda: check_writable(tmp_path / "b.csv"), "is a folder, expected the name of a file"),
        (lambda: check_writable(tmp_path / "full/a.csv"), "use --force (in Python force=True)"),
        (lambda: open_table(tmp_path / "pipe.csv"), "not a regular file, expected a recording"),
        (lambda: save_recordings(twice, tmp_path / "new"), "two recordings are called 'rec'"),
        (lambda: save_recordings(twice[:1], tmp_path / "full"), "exists already, expected a new"),
        (lambda: actuation_of(recording(), "guessed"), "unknown actuation 'guessed'"),
    ):
        assert message in refusal(call)
    check_writable(tmp_path / "full/a.csv", force=True)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["b.csv", "full", "pipe.csv"]


def test_cells_of_unusual_tables(tmp_path):
    pq.write_table(pa.table({"t_s": [0.0, 1.0], "p1_kPa": [True, False]}), tmp_path / "a.parquet")
    table = open_table(tmp_path / "a.parquet")
    assert refusal(lambda: table.numbers([1])).endswith("'p1_kPa': holds bool, expected numbers")
    assert label(["a", "b", "a", ""], 1) == "'b'"
    assert label(["a", "b", "a", ""], 2) == "'a' (3)"
    assert label(["a", "b", "a", ""], 3) == "4"
    text = DelimitedText(tmp_path / "x.csv", b'1,NA\n2,"3"\n', 2, ["a", "b"], missing=("NA",))
    np.testing.assert_array_equal(text.numbers([0, 1]), [[1.0, np.nan], [2.0, 3.0]])
    assert text.place(1) == f"{tmp_path / 'x.csv'}, line 3"
    assert text.place(7) == f"{tmp_path / 'x.csv'}, row 8"


@pytest.mark.parametrize(
    "header",
    [
        b"\x00",  # no size
        b"\x25\x01\x15\x00\x00",  # a size of -1
        b"\x25\x02\x15\xfe\xff\xff\xff\x0f\x00",  # a page longer than its column
        b"\x1c" * 20,  # structures in structures
        b"\x15" + b"\xff" * 12,  # a number of more than 64 bits
        b"\x1d\x00",  # a field of no type
        b"\x15\x00\x15\x10\x15\x10\x2c\x15\x80\x89\x7a\x00\x00",  # more values than the column has
        b"\x15\x00\x15\x10\x15\x10\x25\x02\x00",  # a number in the place of the page's own header
        b"\x13\x07\x17" + 8 * b"\0" + b"\x19\x22\x01\x01\x00",  # a byte, a double, a list; no size
        b"\x18\xff\xff\xff\xff\x07",  # a text that is longer than the file
    ],
)
def test_a_page_whose_header_makes_no_sense_is_one_line(header, tmp_path):
    path = tmp_path / "a.parquet"
    save_recording(recording(400), path)
    column = pq.read_metadata(path).row_group(0).column(1)
    at = column.data_page_offset
    if column.has_dictionary_page:
        at = min(at, column.dictionary_page_offset)
    with path.open("r+b") as file:
        file.seek(at)
        file.write(header)
    assert refusal(lambda: load_recording(path)) == f"{path}: not a readable Parquet file"


def test_an_empty_parquet_table_is_one_line(tmp_path):
    names = ["t_s", "p1_kPa", "k0_x_mm", "k0_y_mm", "k0_z_mm"]
    empty = pa.table({name: pa.array([], pa.float64()) for name in names})
    pq.write_table(empty, tmp_path / "a.parquet")
    assert "the table is empty, expected at least one row" in refusal(
        lambda: load_recording(tmp_path / "a.parquet")
    )


def test_units_convert_within_their_quantity():
    assert factor("kPa", "kPa") == 1.0
    assert factor("deg", "kPa") is None
    assert other_units("bar")["kPa"] == pytest.approx(0.01)
    assert other_units("counts") == {}


def test_what_a_recording_lacks_is_in_its_summary():
    points = recording().key_points_mm
    points[:, 1] = np.nan
    lines = "\n".join(summary(recording(key_points_mm=points)))
    assert "  k1: missing in every row" in lines
    one = recording(1)
    assert "  time: 0 s" in "\n".join(summary(one))
    assert without_spikes(one) == (one, [])


def test_positions_of_another_size_than_the_arm_are_noted():
    """A span five times too short is no other unit of length; one ten times is centimetres."""
    points = np.zeros((8, 2, 3))
    points[:, 1, 2] = 80.0
    base = recording(key_points_mm=points)
    for length, note in ((80.0, ""), (410.0, "check unit and scale in"), (800.0, "are in cm, set")):
        found = plausibility_notes(replace(base, arm=ArmInfo(length_mm=length)), "mm")
        assert bool(found) == bool(note)
        assert not note or note in found[0]
    points[:, 1] = np.nan
    unknown = recording(key_points_mm=points, arm=ArmInfo(length_mm=300.0))
    assert plausibility_notes(unknown, "mm") == []


def test_orientations_that_are_missing():
    lost = np.full((2, 4), np.nan)
    assert np.isnan(between(lost, lost, np.array([0.5, 0.5]))).all()
    assert "the base body has no orientation in any row" in refusal(
        lambda: check_pose(np.full((3, 3), np.nan), "a.csv")
    )
    check_pose(np.eye(3), "a.csv")


BASE = """
[time]
column = "t"
{measured}
[key_points]
positions = [["x", "y", "z"]]
unit = "mm"
"""
RAW = "t,u,x,y,z\n0,1,2,3,4\n1,2,3,4,5\n2,3,3,4,6\n"
PLAIN = '[measured]\ncolumns = ["u"]\nunit = "kPa"'


def imported(folder, map_text: str, *contents: str, name: str | None = "lab"):
    """The parts that a map makes of files raw0.csv, raw1.csv, ..."""
    (folder / "map.toml").write_text(map_text)
    files = []
    for number, content in enumerate(contents):
        files.append(folder / f"raw{number}.csv")
        files[-1].write_text(content)
    return import_files(files, load_map(str(folder / "map.toml")), name)


@pytest.mark.parametrize(
    ("measured", "raw", "message"),
    [
        (
            "[measured]",
            RAW.replace("u", "p2_kPa", 1),
            "columns p2_kPa, expected p1_UNIT, p2_UNIT",
        ),
        (
            "[measured]",
            RAW,
            "no column 'p1_kPa' or with another unit, expected the",
        ),
        ('[measured]\nto = "kPa"', RAW.replace("u", "p1_deg", 1), "'deg' cannot be converted to"),
        (
            PLAIN + "\n[rows]\nfirst = 9",
            RAW,
            "rows is left by [rows] of the map (first = 9, last =",
        ),
        (PLAIN, re.sub(r",\d,\d,\d\n", ",,,\n", RAW), "every key point is missing in every row"),
    ],
)
def test_raw_files_that_a_map_does_not_fit(measured, raw, message, tmp_path):
    assert message in refusal(lambda: imported(tmp_path, BASE.format(measured=measured), raw))


def test_maps_that_contradict_themselves(tmp_path):
    plain = BASE.format(measured=PLAIN)
    point = '[[key_points.point]]\nposition = ["x", "y", "z"]\noffset = [1, 0, 0]\n'
    turned = plain.replace('positions = [["x", "y", "z"]]\n', "") + point
    both = plain + '[context.temp_C]\ncolumn = "u"\nfrom_name = "([0-9]+)"\n'
    for text, message in (
        (turned, "quaternion: missing; expected the body's orientation, since there is an offset"),
        (both, "temp_C: got a table"),
    ):
        assert message in refusal(lambda text=text: imported(tmp_path, text, RAW))
    assert "no raw file given, expected at least one" in refusal(lambda: imported(tmp_path, plain))


def test_files_of_other_arms_are_no_runs_of_one_recording(tmp_path):
    text = BASE.format(measured="[measured]")
    one, two = RAW.replace("u", "p1_kPa", 1), RAW.replace("u", "p1_psi", 1)
    assert (
        "raw1: 1 channels in psi and 1 key points, expected 1 in kPa and 1 as in raw0"
        in refusal(lambda: imported(tmp_path, text, one, two))
    )
    assert [part.recording.unit for part in imported(tmp_path, text, one, two, name=None)] == [
        "kPa",
        "psi",
    ]


def test_a_log_whose_time_goes_back_cannot_be_matched(tmp_path):
    text = '[file.main]\nmatch = "raw0*"\n[file.log]\nmatch = "raw1*"\njoin = "time"\n'
    text += 'time = "t"\n'
    text += BASE.format(measured='[measured]\nfile = "log"\ncolumns = ["u"]\nunit = "kPa"')
    back = "t,u\n0,1\n2,2\n1,3\n"
    assert "raw1.csv, line 4, column 't': time does not increase" in refusal(
        lambda: imported(tmp_path, text, RAW, back)
    )


def test_a_file_without_arrays_is_one_line(tmp_path):
    np.savez(tmp_path / "a.npz", note=np.array("nothing"))
    (tmp_path / "map.toml").write_text(BASE.format(measured=PLAIN))
    spec = load_map(str(tmp_path / "map.toml"))
    message = refusal(lambda: import_files([tmp_path / "a.npz"], spec, "a"))
    assert message.startswith(str(tmp_path / "a.npz"))


def test_a_draft_of_numbers_alone_counts_columns(tmp_path):
    """A title above the numbers is no header; without actuation the draft says so."""
    (tmp_path / "a.csv").write_text("x,y,z\n1,2,3\n2,3,4\n")
    assert "# [measured]  # check: no columns of the actuation are" in draft_map(tmp_path / "a.csv")
    (tmp_path / "b.csv").write_text("take seven\n1,2,3\n2,3,4\n")
    assert "no columns x, y, z of key points are recognised among unnamed" in refusal(
        lambda: draft_map(tmp_path / "b.csv")
    )


def test_a_schedule_with_a_hole_names_the_cell(tmp_path):
    (tmp_path / "s.csv").write_text("t_s,c1_kPa\n0,1\n1,nan\n")
    assert "line 3, column 'c1_kPa': got nan, expected a finite number" in refusal(
        lambda: load_schedule(tmp_path / "s.csv")
    )


def predictions(folder, rows, run: bool = True) -> str:
    """A file of predictions: rows of time, run and one number for all coordinates."""
    points = [f"k{j}_{axis}_mm" for j in range(2) for axis in "xyz"]
    names = ["t_s", *(["run"] if run else []), *points]
    lines = [",".join(names)]
    for t_s, number, value in rows:
        lines.append(",".join(map(str, [t_s, *([number] if run else []), *[value] * 6])))
    (folder / "p.csv").write_text("\n".join(lines) + "\n")
    return str(folder / "p.csv")


def test_predictions_are_matched_by_run_and_time(tmp_path):
    two = recording(4, t_s=[0.0, 0.1, 0.0, 0.1], run=[0, 0, 1, 1])
    rows = [(0.0, 0, 1.0), (0.05, 0, 9.0), (0.1, 0, 2.0), (0.0, 1, 3.0), (0.1, 1, 4.0)]
    (found,) = with_predictions([two], [predictions(tmp_path, rows)])
    assert found.predicted_mm[:, 0, 0].tolist() == [1.0, 2.0, 3.0, 4.0]
    plain = predictions(tmp_path, rows, run=False)
    assert "5 rows, but recording 'rec' has 4 in 2 runs; expected a column 'run'" in refusal(
        lambda: with_predictions([two], [plain])
    )
    assert "rec" in refusal(lambda: with_predictions([two], [predictions(tmp_path, rows[:3])]))


def foreign(folder, **changes) -> dict:
    """A dataset of one episode of four frames, and its description with other fields."""
    save_lerobot([recording(4)], folder, fps=10)
    path = folder / "meta" / "info.json"
    info = json.loads(path.read_text())
    path.write_text(json.dumps(info | changes))
    return info


def test_datasets_that_cannot_be_written(tmp_path):
    one, other = recording(), recording(name="other", commanded=np.zeros((8, 2)))
    single = recording(1)
    apart = recording(2, t_s=[0.0, 0.1], run=[0, 1])
    for given, fps, message in (
        ([one], 0, "fps is 0, expected at least 1"),
        ([one, other], None, "recording 'other': other columns than recording 'rec'; expected the"),
        ([single], None, "no run has two samples, expected some"),
        ([apart], 10, "no run of two frames at 10 frames per second"),
    ):
        assert message in refusal(
            lambda given=given, fps=fps: save_lerobot(given, tmp_path / "s", fps=fps)
        )
        assert not (tmp_path / "s").exists()


def test_a_recording_without_commands_returns_from_a_dataset(tmp_path):
    save_lerobot([recording()], tmp_path / "set")
    found = load_lerobot(tmp_path / "set")
    assert found.commanded is None
    np.testing.assert_allclose(found.measured, recording().measured, atol=1e-5)


def test_long_datasets_have_several_files(tmp_path, monkeypatch):
    monkeypatch.setattr("surgisoft.measurement.recordings.lerobot.LARGEST_FILE_MB", 1e-4)
    two = recording(8, run=[0, 0, 0, 0, 1, 1, 1, 1])
    save_lerobot([two], tmp_path / "set")
    files = sorted((tmp_path / "set" / "data").rglob("*.parquet"))
    assert [file.name for file in files] == ["file-000.parquet", "file-001.parquet"]
    np.testing.assert_allclose(load_lerobot(tmp_path / "set").measured, two.measured, atol=1e-5)


def test_datasets_without_frames_or_with_lost_actuation(tmp_path):
    foreign(tmp_path / "a")
    (file,) = (tmp_path / "a" / "data").rglob("*.parquet")
    table = pq.read_table(file)
    states = [list(row) for row in table["observation.state"].to_pylist()]
    states[1][0] = float("nan")
    at = table.column_names.index("observation.state")
    kind = table.schema.field(at).type
    pq.write_table(table.set_column(at, "observation.state", pa.array(states, kind)), file)
    assert (
        "episode 0, frame 1: the actuation is missing, expected numbers in every frame"
        in refusal(lambda: load_lerobot(tmp_path / "a"))
    )
    file.unlink()
    assert "no data/chunk-*/file-*.parquet, expected the frames there" in refusal(
        lambda: load_lerobot(tmp_path / "a")
    )


def test_names_of_older_datasets_are_read(tmp_path):
    """{"motors": [...]} in place of a list; features of pictures or several axes are left out."""
    info = foreign(tmp_path / "a")
    state = info["features"]["observation.state"]
    features = info["features"] | {
        "observation.state": state | {"names": {"motors": state["names"]}},
        "observation.map": {"dtype": "float32", "shape": [2, 2], "names": None},
        "observation.images.top": {"dtype": "video", "shape": [9, 9, 3], "names": None},
    }
    path = tmp_path / "a" / "meta" / "info.json"
    path.write_text(json.dumps(info | {"features": features}))
    np.testing.assert_allclose(
        load_lerobot(tmp_path / "a").measured, recording(4).measured, atol=1e-5
    )


def test_the_tail_of_a_log_that_was_never_written(tmp_path):
    """A disk that lost its power leaves blocks of zeros behind the last line."""
    path = tmp_path / "run.jsonl"
    path.write_bytes(b"1\n")
    assert "line 1: expected a JSON object, not a value" in refusal(lambda: read_log(path))
    path.write_bytes(b"\0\0\0\n")
    assert "is empty, expected a" in refusal(lambda: read_log(path))


def test_folders_of_nothing_are_one_line(tmp_path):
    assert "no .csv or .parquet in this folder" in refusal(lambda: load_recordings([tmp_path]))


TWO = "t,u,x,y,z,a,b,c\n0,1,0,0,0,0,0,9\n1,2,0,0,0,0,1,9\n2,3,0,0,0,0,2,9\n"
TWO_POINTS = 'positions = [["x", "y", "z"], ["a", "b", "c"]]'


@pytest.mark.parametrize(
    ("points", "more", "raw", "message"),
    [
        (
            TWO_POINTS + "\norder = [0]",
            "",
            TWO,
            "order = [0] in the map, expected numbers of its",
        ),
        (TWO_POINTS + "\nlost = [2]", "", TWO, "lost = [2] in the map, expected numbers of its 2"),
        ('auto = "bodies"', "", TWO, "no key point found, expected rigid bodies in the file's hea"),
        (
            TWO_POINTS,
            '[frame]\nalign_z = "rest"\nrest_rows = 1',
            TWO.replace("0,9", "0,0"),
            "align_z needs the first and last key point in the first 1 rows, but they are missing",
        ),
        (
            TWO_POINTS,
            '[frame]\norigin = "k0"\nrest_rows = 1',
            TWO.replace("1,0,0,0", "1,,,"),
            "key point k0 is missing in every row at rest",
        ),
    ],
)
def test_key_points_that_a_file_does_not_have(points, more, raw, message, tmp_path):
    text = BASE.format(measured=PLAIN).replace('positions = [["x", "y", "z"]]', points) + more
    assert message in refusal(lambda: imported(tmp_path, text, raw))


def test_positions_have_a_unit(tmp_path):
    text = BASE.format(measured=PLAIN).replace('unit = "mm"\n', "")
    assert (
        "key_points.unit: missing; expected the positions' unit, one of mm, cm, m, in"
        in refusal(lambda: imported(tmp_path, text, RAW))
    )


def test_an_actuation_that_is_read_later_than_every_run(tmp_path):
    text = BASE.format(measured=PLAIN + "\ndelay_s = {}")
    assert "delay_s 60 (commanded 0) is longer than every run, expected a short time" in refusal(
        lambda: imported(tmp_path, text.format(60), RAW)
    )
    rows = "".join(f"{0.1 * i:.1f},{i},{i},3,4\n" for i in range(20))
    (part,) = imported(tmp_path, text.format(0.5), "t,u,x,y,z\n" + rows)
    assert "measured actuation read +0.5 s from each row (delay_s)" in part.notes
    assert "5 rows that the late log does not reach left out" in part.notes
    assert part.recording.measured[:3, 0] == pytest.approx([5.0, 6.0, 7.0])


def test_the_topic_of_a_file_of_arrays_is_one_of_its_groups(tmp_path):
    savemat(tmp_path / "a.mat", {"arm": {"t": np.arange(9.0), "u": np.arange(9.0)}})
    text = '[file.main]\ntopic = "leg"\n' + BASE.format(measured=PLAIN)
    (tmp_path / "map.toml").write_text(text)
    spec = load_map(str(tmp_path / "map.toml"))
    message = refusal(lambda: import_files([tmp_path / "a.mat"], spec, "a"))
    assert message.endswith("no group or struct 'leg', expected one of arm")
    savemat(tmp_path / "a.mat", {"note": "nothing"})
    spec = replace(spec, file={"main": replace(spec.file["main"], topic="")})
    message = refusal(lambda: import_files([tmp_path / "a.mat"], spec, "a"))
    assert message.endswith("no array of numbers in it, expected time and measurements")


class FakeC3d:
    """The part of ezc3d that is used, with a file of this content."""

    def __init__(self, frames=4, rate=100.0, volts=0, units=("m",)):
        rng = np.random.default_rng(0)
        labels = [f"M{k}" for k in range(2)]
        self.content = {
            "parameters": {
                "POINT": {"LABELS": {"value": labels}, "UNITS": {"value": list(units)}},
                "ANALOG": {"LABELS": {"value": [f"V{k}" for k in range(volts)]}},
            },
            "data": {
                "points": rng.normal(size=(4, 2, frames)),
                "analogs": rng.normal(size=(1, volts, 5 * frames)),
            },
            "header": {"points": {"frame_rate": rate}},
        }

    def c3d(self, path):
        if "broken" in path:
            raise OSError("the header ends early")
        return self.content


@pytest.mark.parametrize(
    ("file", "fields", "message"),
    [
        ("broken.c3d", {}, "cannot be read as a C3D file (the header ends early)"),
        ("a.c3d", {"frames": 0}, "holds no frame, expected at least one; export it again"),
        ("a.c3d", {"rate": 0.0}, "frame rate 0 Hz, expected more than 0"),
    ],
)
def test_c3d_files_without_frames_are_one_line(file, fields, message, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ezc3d", FakeC3d(**fields))
    assert refusal(lambda: as_bytes(tmp_path / file)).endswith(f"{file}: {message}")


def test_voltages_of_a_c3d_file_are_averaged_over_its_frames(tmp_path, monkeypatch):
    for volts, units, unit in ((1, ("m",), "m"), (0, (), "mm")):
        fake = FakeC3d(volts=volts, units=units)
        monkeypatch.setitem(sys.modules, "ezc3d", fake)
        facts, (values,) = unpacked(as_bytes(tmp_path / "a.c3d"))
        assert facts["unit"] == unit
        assert facts["markers"] == ["M0", "M1"]
        assert facts["names"][:4] == ["t_s", "M0.x", "M0.y", "M0.z"]
        assert values.shape == (4, 7 + volts)
        if volts:
            assert values[0, -1] == pytest.approx(fake.content["data"]["analogs"][0, 0, :5].mean())


def test_a_missing_reader_is_named_with_its_extra(tmp_path, monkeypatch):
    (tmp_path / "a.c3d").write_bytes(b"t,u")
    for found, expected in (
        (None, "needs the package ezc3d, which is not installed: pip install 'surgisoft[lab]'"),
        (object(), "its first bytes are not those of a C3D file; export it again"),
    ):
        monkeypatch.setattr(c3d, "find_spec", lambda name, found=found: found)
        assert expected in refusal(lambda: c3d.READER.read(tmp_path / "a.c3d", None))
