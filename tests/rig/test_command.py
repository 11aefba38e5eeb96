"""`surgisoft collect` from the command line: what it writes, says and refuses."""

import numpy as np
import pytest

from surgisoft.cli import run
from surgisoft.measurement.recordings import load_recording
from surgisoft.rig.hidden import HIDDEN

OWN = "tests.rig.own_rig:OwnRig"
"""A real rig of three chambers."""


def test_collects_writes_and_prints_one_line(tmp_path, capsys):
    out = tmp_path / "r.csv"
    args = ["collect", "mixed", "-o", str(out), "--points", "200", "--seed", "3"]
    args += ["--hidden", "creep", "--strength", "0.5", "--hidden", "thermal_drift"]
    args += ["--strength", "1", "--payload-g", "2", "--gravity", "0", "0", "1"]
    assert run(args) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 1
    assert "200 continuous samples" in lines[0]
    assert "hidden creep 0.5" in lines[0]
    recording = load_recording(out)
    assert recording.samples == 200
    assert (recording.payload_g == 2.0).all()
    np.testing.assert_allclose(recording.gravity, [0, 0, 1])
    assert recording.temp_C is not None
    assert "creep" not in out.with_suffix(".toml").read_text()  # hidden stays hidden


def test_same_seed_same_file_other_take_other_data(tmp_path):
    files = [tmp_path / f"{k}.parquet" for k in range(3)]
    for file, take in zip(files, "001", strict=True):
        args = ["collect", "validation", "-o", str(file), "--points", "20", "--take", take]
        assert run(args) == 0
    one, again, other = (load_recording(file) for file in files)
    np.testing.assert_array_equal(one.key_points_mm, again.key_points_mm)
    assert (one.commanded != other.commanded).any()
    assert (one.key_points_mm != other.key_points_mm).all()


def test_a_user_defined_schedule(tmp_path):
    plan, out = tmp_path / "plan.csv", tmp_path / "r.parquet"
    plan.write_text("t_s,c1_kPa,c2_kPa,c3_kPa\n0,0,0,0\n1,9,0,0\n2,9,3,0\n")
    assert run(["collect", str(plan), "-o", str(out)]) == 0
    recording = load_recording(out)
    assert recording.samples == 40
    np.testing.assert_allclose(recording.commanded[20], [9, 0, 0], atol=1e-9)


def test_lists(capsys):
    assert run(["collect", "--list-hidden"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(HIDDEN)
    assert run(["collect", "--list-protocols"]) == 0
    assert "grid" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (["gird"], "unknown protocol 'gird'"),
        (["mixed", "--hidden", "crep"], "unknown hidden effect 'crep': known are breathing,"),
        (["mixed", "--hidden", "creep", "--strength", "-1"], "strength of 'creep' is -1.0"),
        (
            ["mixed", "--hidden", "creep", "--hidden", "drift", "--strength", "1"],
            "2 --hidden and 1",
        ),
        (["mixed", "--strength", "1"], "0 --hidden and 1 --strength"),
        (["mixed", "--points", "2"], "--points is 2"),
        (["mixed", "--payload-g", "99"], "payload is 99.0 g"),
        (["mixed", "--gravity", "0", "0", "0"], "gravity is [0.0, 0.0, 0.0]"),
        (["mixed", "--noise-scale", "-1"], "noise scale is -1.0"),
        (["none.csv"], "cannot be read"),
    ],
)
def test_bad_input_is_one_line_exit_2_and_nothing_written(tmp_path, capsys, args, says):
    out = tmp_path / "r.parquet"
    assert run(["collect", *args, "-o", str(out)]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_refuses_to_overwrite_and_unknown_suffixes_before_working(tmp_path, capsys):
    out = tmp_path / "r.parquet"
    out.write_text("mine")
    assert run(["collect", "grid", "-o", str(out)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert out.read_text() == "mine"
    assert run(["collect", "grid", "-o", str(tmp_path / "r.xlsx")]) == 2
    assert "expected .csv or .parquet" in capsys.readouterr().err


@pytest.mark.parametrize("force", [[], ["--force"]])
@pytest.mark.parametrize(
    ("folders", "files", "output", "says"),
    [
        (["r.csv"], [], "r.csv", "r.csv: is a folder, expected the name of a file"),
        (["r.toml"], [], "r.csv", "r.toml: is a folder, expected the name of a file"),
        ([], ["a"], "a/b/r.csv", "b: cannot be written"),
        (["r.log.jsonl"], [], "r.csv", "r.log.jsonl: is a folder, expected the name of a new log"),
    ],
)
def test_what_is_in_the_way_is_refused_before_the_rig_moves(
    tmp_path, capsys, monkeypatch, force, folders, files, output, says
):
    def moved(*_, **__):
        raise AssertionError("the rig was driven")

    monkeypatch.setattr("surgisoft.rig.trial.collect", moved)
    for name in folders:
        (tmp_path / name).mkdir()
    for name in files:
        (tmp_path / name).write_text("mine")
    out = str(tmp_path / output)
    assert run(["collect", "walk", "--rig", f"{OWN}:port=x", "-o", out, *force]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
    assert sorted(each.name for each in tmp_path.iterdir()) == sorted(folders + files)


@pytest.mark.parametrize("name", ["r.toml", "r.log.jsonl"])
def test_what_belongs_to_an_older_recording_is_kept_before_the_rig_moves(
    tmp_path, capsys, monkeypatch, name
):
    monkeypatch.setattr("surgisoft.rig.trial.collect", lambda *_, **__: 1 / 0)
    (tmp_path / name).write_text("mine")
    out = str(tmp_path / "r.csv")
    assert run(["collect", "walk", "--rig", f"{OWN}:port=x", "-o", out]) == 2
    assert "--force" in capsys.readouterr().err
    assert (tmp_path / name).read_text() == "mine"


def test_a_dry_run_writes_nothing_so_an_older_recording_is_not_in_its_way(tmp_path, capsys):
    out, plan = tmp_path / "r.csv", tmp_path / "plan.csv"
    out.write_text("mine")
    plan.write_text("t_s,c1_kPa,c2_kPa,c3_kPa\n0,0,0,0\n0.1,0,0,1\n")
    words = ["collect", str(plan), "--rig", f"{OWN}:port=x", "-o", str(out), "--dry-run"]
    assert run(words) == 0
    shown = capsys.readouterr().out
    assert shown.splitlines()[0] == "vent and rest"
    assert "send    0.000    0.000    0.500 kPa" in shown
    assert out.read_text() == "mine"
    assert run([*words, "--hidden", "creep"]) == 2
    assert "unknown option 'hidden'" in capsys.readouterr().err


@pytest.mark.parametrize("rig", ["virtual", f"{OWN}:port=x"])
@pytest.mark.parametrize("others", ["", "0,0,0,0,1\n1,9,0,0,1\n"])
def test_a_run_too_short_for_a_sample_is_refused(tmp_path, capsys, rig, others):
    """24 ms of a rig that measures every 50 ms, alone and before a run of a second."""
    plan, out = tmp_path / "plan.csv", tmp_path / "r.csv"
    plan.write_text(f"t_s,c1_kPa,c2_kPa,c3_kPa,run\n0,0,0,0,7\n0.024,1,0,0,7\n{others}")
    assert run(["collect", str(plan), "--rig", rig, "-o", str(out)]) == 2
    error = capsys.readouterr().err
    assert "run 7 is too short for a sample of the rig, which measures every 0.05 s" in error
    assert list(tmp_path.iterdir()) == [plan]


def test_the_elastica_rig_without_pyelastica_says_what_to_install(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    out = tmp_path / "r.parquet"
    assert run(["collect", "mixed", "--rig", "elastica", "-o", str(out)]) == 2
    error = capsys.readouterr().err
    assert "PyElastica, which is not installed: pip install 'surgisoft[elastica]'" in error
    assert error.count("\n") == 1
    assert not out.exists()
