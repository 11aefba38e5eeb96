"""`surgisoft import` and `surgisoft recording` as a user types them."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from surgisoft.cli import run
from surgisoft.measurement.importing import load_map
from surgisoft.measurement.importing.spec import (
    ActuationMap,
    BaseMap,
    FileRole,
    FrameMap,
    KeyPointsMap,
    RowsMap,
    RunsMap,
    TimeMap,
)
from surgisoft.measurement.recordings import load_recording
from surgisoft.measurement.recordings.sidecar import read_sidecar

DOCS = Path(__file__).resolve().parents[2] / "docs"

MAP = """
[time]
rate_hz = 20
[measured]
columns = ["u"]
unit = "kPa"
[key_points]
positions = [["x", "y", "z"]]
unit = "m"
"""


@pytest.fixture
def lab(tmp_path):
    """Two raw files, their map, and an output path."""
    (tmp_path / "map.toml").write_text(MAP)
    for name, start in (("one", 0), ("two", 10)):
        rows = "\n".join(f"{start + i},0.001,0.002,0.0{i + 1}" for i in range(5))
        (tmp_path / f"{name}.csv").write_text(f"u,x,y,z\n{rows}\n")
    return tmp_path


def surgisoft(*arguments):
    return run([str(argument) for argument in arguments])


def test_a_model_of_another_arm_is_refused_before_anything_is_written(lab, capsys):
    out = lab / "rec.csv"
    given = ["import", lab / "one.csv", "--map", lab / "map.toml", "-o", out, "--model", "default"]
    assert surgisoft(*given) == 2
    assert "chambers: 1, but the model has 3" in capsys.readouterr().err
    assert not out.exists()
    assert not out.with_suffix(".toml").exists()


def test_a_unit_that_is_not_the_model_s_is_corrected_or_converted(lab, capsys):
    """Both ways that the message names lead on: values in kPa are kept, and 1 psi is 6.894757."""
    three = MAP.replace('["u"]', '["u", "v", "w"]').replace(
        '[["x", "y", "z"]]', str([[f"x{k}", "y", "z"] for k in range(5)])
    )
    names = "u,v,w,x0,x1,x2,x3,x4,y,z"
    rows = "\n".join(f"{k},1,2,{','.join(['0.001'] * 7)}" for k in range(5))
    (lab / "raw.csv").write_text(f"{names}\n{rows}\n")
    given = ["import", lab / "raw.csv", "--map", lab / "map.toml", "-o", lab / "rec.csv", "--model"]
    (lab / "map.toml").write_text(three.replace('"kPa"', '"psi"'))
    assert surgisoft(*given, "default") == 2
    said = capsys.readouterr().err
    assert "actuation unit: psi, but the model has kPa; if the values are in kPa, correct" in said
    assert 'if they are in psi, add to = "kPa" there, and import again' in said
    for field, scale in (('"kPa"', 1.0), ('"psi"\nto = "kPa"', 6.894757)):
        (lab / "map.toml").write_text(three.replace('"kPa"', field))
        given[5] = lab / f"rec{scale}.csv"
        assert surgisoft(*given[:-1]) == 0
        read = load_recording(given[5])
        assert read.unit == "kPa"
        np.testing.assert_allclose(read.measured[:, 0], scale * np.arange(5.0), rtol=1e-6)
    (lab / "map.toml").write_text(three.replace('"kPa"', '"deg"'))
    assert surgisoft(*given, "default") == 2
    assert "use recordings of the arm that the model was fitted to" in capsys.readouterr().err


def test_files_become_runs_of_one_recording(lab, capsys):
    out = lab / "new" / "rec.parquet"
    raw = [lab / "one.csv", lab / "two.csv"]
    assert surgisoft("import", *raw, "--map", lab / "map.toml", "-o", out) == 0
    printed = capsys.readouterr().out
    assert f"wrote {out}: continuous, 10 rows, 2 runs, 1 channel in kPa, 1 key point" in printed
    read = load_recording(out)
    np.testing.assert_array_equal(read.measured[:, 0], [0, 1, 2, 3, 4, 10, 11, 12, 13, 14])
    np.testing.assert_allclose(read.key_points_mm[3, 0], [1, 2, 40])


def test_folder_gets_a_recording_a_file(lab):
    raw = [lab / "one.csv", lab / "two.csv"]
    assert surgisoft("import", *raw, "--map", lab / "map.toml", "-o", lab / "out") == 0
    assert sorted(p.name for p in (lab / "out").iterdir()) == [
        "one.parquet",
        "one.toml",
        "two.parquet",
        "two.toml",
    ]


def test_dry_run_shows_and_writes_nothing(lab, capsys):
    before = sorted(lab.iterdir())
    arguments = ("import", lab / "one.csv", "--map", lab / "map.toml", "-o", lab / "rec.csv")
    assert surgisoft(*arguments, "--dry-run") == 0
    assert f"would write {lab}/rec.csv: continuous, 5 rows" in capsys.readouterr().out
    assert sorted(lab.iterdir()) == before


def test_the_clock_of_a_moving_arm_is_looked_at(lab, capsys):
    """Times in ms that the map reads as s, and 40 s without rows."""
    t = np.delete(np.arange(3000), np.s_[1000:1800])
    u, x = 10 + 10 * np.sin(0.1 * t), 0.01 * np.sin(0.1 * t)
    rows = "\n".join(f"{50 * k},{a:.4f},{b:.5f},0,0.05" for k, a, b in zip(t, u, x, strict=True))
    (lab / "ms.csv").write_text(f"t,u,x,y,z\n{rows}\n")
    timed = MAP.replace("rate_hz = 20", 'column = "t"')
    (lab / "s.toml").write_text(timed)
    (lab / "ms.toml").write_text(timed.replace('"t"', '"t"\nunit = "ms"'))
    (lab / "runs.toml").write_text((lab / "ms.toml").read_text() + "[runs]\ngap_s = 60\n")
    notes = {}
    for name in ("s", "ms", "runs"):
        out = ("-o", lab / "rec.csv", "--dry-run")
        assert surgisoft("import", lab / "ms.csv", "--map", lab / f"{name}.toml", *out) == 0
        notes[name] = [x for x in capsys.readouterr().out.splitlines() if x.startswith("note: ")]
    assert "one row each 50 s, expected 0.0005 to 2 s" in notes["s"][0]
    assert 'if the times are in ms, set unit = "ms" in [time]' in notes["s"][0]
    assert len(notes["ms"]) == 1
    assert "a gap without rows inside a run (40.05 s from 49.95 s on)" in notes["ms"][0]
    assert "set gap_s = 1 in [runs] of the map" in notes["ms"][0]
    assert notes["runs"] == []


def test_existing_recordings_are_kept_all_of_them(lab, capsys):
    raw = [lab / "one.csv", lab / "two.csv"]
    out = lab / "out"
    out.mkdir()
    (out / "two.parquet").write_text("mine")
    arguments = ("import", *raw, "--map", lab / "map.toml", "-o", out)
    assert surgisoft(*arguments) == 2
    error = capsys.readouterr().err
    assert error == (
        f"surgisoft: error: {out}/two.parquet: exists already; choose another name or use --force "
        "(in Python force=True)\n"
    )
    assert [p.name for p in out.iterdir()] == ["two.parquet"]
    assert (out / "two.parquet").read_text() == "mine"
    assert surgisoft(*arguments, "--force") == 0
    assert load_recording(out / "two.parquet").samples == 5


def test_bad_row_is_one_line_and_nothing_is_written(lab, capsys):
    (lab / "two.csv").write_text("u,x,y,z\n1,2,3,4\n1,2,3\n")
    raw = [lab / "one.csv", lab / "two.csv"]
    assert surgisoft("import", *raw, "--map", lab / "map.toml", "-o", lab / "out") == 2
    printed = capsys.readouterr()
    assert printed.err == (
        f"surgisoft: error: {lab}/two.csv, line 3: 3 cells, expected 4 as in the header\n"
    )
    assert not (lab / "out").exists()


def test_suffix_that_is_no_recording(lab, capsys):
    out = lab / "rec.txt"
    assert surgisoft("import", lab / "one.csv", "--map", lab / "map.toml", "-o", out) == 2
    assert "suffix '.txt', expected .csv, .parquet or a folder" in capsys.readouterr().err
    assert not out.exists()


def test_recording_shows_what_it_holds(lab, capsys):
    out = lab / "rec.csv"
    surgisoft("import", lab / "one.csv", "--map", lab / "map.toml", "-o", out)
    capsys.readouterr()
    with out.open("a") as file:
        file.write("0.25,,,,\n".replace(",,,,", ",5.0,,,,0"))
    assert surgisoft("recording", out) == 0
    printed = capsys.readouterr().out
    assert "6 rows, 1 run, 1 channel in kPa, 1 key point" in printed
    assert "k0 mm: x 1.0 to 1.0, y 2.0 to 2.0, z 10.0 to 50.0, missing in 1 rows" in printed
    assert surgisoft("recording", lab / "none.csv") == 2
    assert "none.csv: no such file" in capsys.readouterr().err


@pytest.mark.parametrize(("output", "kept"), [("one.csv", "one.csv"), ("map.parquet", "map.toml")])
def test_what_an_import_reads_is_not_replaced_even_by_force(lab, capsys, output, kept):
    before = (lab / kept).read_bytes()
    given = ["import", lab / "one.csv", "--map", lab / "map.toml", "-o", lab / output, "--force"]
    assert surgisoft(*given) == 2
    printed = capsys.readouterr().err
    assert f"{lab / kept}: " in printed
    assert "is read by this import, expected a new file" in printed
    assert (lab / kept).read_bytes() == before
    assert sorted(path.name for path in lab.iterdir()) == ["map.toml", "one.csv", "two.csv"]


@pytest.mark.parametrize(
    "other", [["-o", "rec.csv"], ["--map", "map.toml"], ["--dry-run"], ["--model", "default"]]
)
def test_a_draft_takes_no_options_of_an_import(lab, capsys, other):
    new = lab / "new.toml"
    assert surgisoft("import", lab / "one.csv", "--draft", new, *other) == 2
    assert f"--draft with {other[0]}: --draft only writes a draft" in capsys.readouterr().err
    assert not new.exists()


@pytest.mark.parametrize("other", [["--fps", 10], ["--lerobot-task", "Wave."]])
def test_options_of_a_lerobot_dataset_need_its_folder(lab, capsys, other):
    out = lab / "rec.csv"
    surgisoft("import", lab / "one.csv", "--map", lab / "map.toml", "-o", out)
    capsys.readouterr()
    assert surgisoft("recording", out, *other) == 2
    printed = capsys.readouterr()
    assert f"{other[0]}: for a LeRobotDataset; add --lerobot DIR" in printed.err
    assert printed.out == ""


def test_every_shipped_map_is_valid():
    maps = sorted((DOCS / "examples" / "maps").glob("*.toml"))
    assert len(maps) >= 5
    for path in maps:
        load_map(str(path))


def test_examples_of_the_documentation_are_valid(tmp_path):
    blocks = re.findall(r"```toml\n(.*?)```", (DOCS / "recordings.md").read_text(), re.DOTALL)
    sidecar, example, *formats = blocks
    (tmp_path / "sidecar.toml").write_text(sidecar)
    assert read_sidecar(tmp_path / "sidecar.toml")["noise_mm"] == 0.08
    (tmp_path / "map.toml").write_text(example)
    assert load_map(str(tmp_path / "map.toml")).time.unit == "ms"
    units = []
    for text in formats:
        (tmp_path / "format.toml").write_text(text)
        units.append(load_map(str(tmp_path / "format.toml")).key_points.unit)
    assert units[:2] == ["m", "m"], "LeRobot, MCAP"
    assert len(units) == 3, "C3D, MATLAB and HDF5 have one example"


def test_the_example_of_two_files_imports_as_the_page_says(tmp_path, monkeypatch, capsys):
    """The page's files, map and commands; 0.4 of the way from 1.9 to 2.0 psi is 1.94 psi."""
    text = (DOCS / "recordings.md").read_text().partition("### An example: an air log")[2]
    text = text.partition("\n### ")[0]
    for name, body in re.findall(r"```\w+ title=\"(.*?)\"\n(.*?)```", text, re.DOTALL):
        (tmp_path / name).write_text(body)
    monkeypatch.chdir(tmp_path)
    draft, final = re.findall(r"^surgisoft (.*)$", text, re.MULTILINE)
    assert surgisoft(*draft.split()) == 0
    drafted, checked = load_map("new.toml"), load_map("lab.toml")
    assert [role.match for role in drafted.file.values()] == ["*_cam.csv", "*_air.csv"]
    assert drafted.file == checked.file
    assert drafted.measured.columns == checked.measured.columns
    assert drafted.commanded.columns == checked.commanded.columns
    assert drafted.key_points.positions == checked.key_points.positions
    assert surgisoft(*final.split()) == 0
    assert "interpolated linearly in time" in capsys.readouterr().out
    read = load_recording(tmp_path / "bench.parquet")
    np.testing.assert_allclose(read.t_s, [0.0, 0.033, 0.066], atol=1e-9)
    np.testing.assert_allclose(read.measured, [[1.94, 0.04], [2.42, 0.21], [3.9, 0.9]], atol=1e-9)
    np.testing.assert_allclose(read.commanded, [[2, 0], [4, 1], [4, 1]])
    np.testing.assert_allclose(read.key_points_mm[:, 0], 0.0, atol=1e-9)
    tip = [[0, 0, 180], [1, -2, 180], [4, -6, 179.5]]
    np.testing.assert_allclose(read.key_points_mm[:, 1], tip, atol=1e-9)
    np.testing.assert_allclose(read.gravity, [0, 0, 1], atol=1e-9)


@pytest.mark.parametrize(
    "part", [FileRole, TimeMap, ActuationMap, KeyPointsMap, FrameMap, BaseMap, RowsMap, RunsMap]
)
def test_every_field_of_a_map_is_documented(part):
    text = (DOCS / "recordings.md").read_text()
    for field in dataclasses.fields(part):
        if field.name not in ("name", "file", "points"):
            assert re.search(rf"`[^`]*\b{field.name}\b[^`]*`", text), field.name
