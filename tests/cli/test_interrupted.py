"""Ctrl-C leaves a complete output or none, says which, and gives exit code 130."""

import os

import pytest
import trimesh

import surgisoft.cli.progress
from surgisoft.cli import run
from surgisoft.files import noted_writes, write_atomically


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A short recording, a raw file with its map, and a mesh."""
    folder = tmp_path_factory.mktemp("bench")
    recording = folder / "rec.csv"
    assert run(["collect", "walk", "--points", "300", "-o", str(recording)]) == 0
    (folder / "raw.txt").write_text(recording.read_text())
    points = [[f"k{k}_{axis}_mm" for axis in "xyz"] for k in range(5)]
    (folder / "map.toml").write_text(
        '[time]\ncolumn = "t_s"\nunit = "s"\n[measured]\nunit = "kPa"\n'
        f'[key_points]\nunit = "mm"\npositions = {points}\n'
    )
    trimesh.creation.icosphere(3, 40.0).export(folder / "organ.stl")
    return folder


COMMANDS = {
    "fit": "fit rec.csv --epochs 10 --widths 8 -o NEW",
    "compare": "compare default rec.csv --json j.json --report NEW --replay r.rrd",
    "diagnose": "diagnose default rec.csv --json j.json --report NEW",
    "amend": "amend default --effect creep --data rec.csv -o NEW --anyway --report page",
    "improve": "improve default rec.csv -o NEW --report page",
    "next-experiment": "next-experiment default --between creep line_lag -o NEW.csv",
    "scene new": "scene new organ.stl --unit mm -o NEW",
    "collect": "collect walk --points 300 -o NEW.parquet",
    "evaluate": "evaluate scripted --task track_circle --episodes 1 --json j.json --report NEW",
    "demo": "demo -o NEW",
}


def interrupt(*_):
    raise KeyboardInterrupt


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize("command", COMMANDS)
def test_ctrl_c_during_the_work_leaves_nothing(command, bench, monkeypatch, capsys):
    monkeypatch.chdir(bench)
    before = names(bench)
    monkeypatch.setattr(surgisoft.cli.progress.Pace, "__call__", interrupt)
    assert run(COMMANDS[command].split()) == 130
    said = capsys.readouterr().err.splitlines()
    assert said[-1] == "surgisoft: interrupted; no output was written"
    assert names(bench) == before


@pytest.mark.parametrize(
    "arguments",
    [
        COMMANDS["fit"],
        COMMANDS["collect"],
        "import raw.txt --map map.toml -o NEW.csv",
        "next-experiment default --between creep line_lag --minutes 5 --as-it-stands -o NEW.csv",
    ],
)
def test_ctrl_c_while_the_output_is_written_leaves_nothing(arguments, bench, monkeypatch, capsys):
    monkeypatch.chdir(bench)
    before = names(bench)
    monkeypatch.setattr(os, "replace", interrupt)
    assert run(arguments.split()) == 130
    assert capsys.readouterr().err.splitlines()[-1].endswith("; no output was written")
    assert names(bench) == before


def test_ctrl_c_names_what_is_complete(bench, tmp_path, monkeypatch, capsys):
    """The second file of `compare` is interrupted: the first one stays and is named."""
    replace, done = os.replace, []

    def second(*paths):
        if done:
            raise KeyboardInterrupt
        done.append(replace(*paths))

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "replace", second)
    command = f"compare default {bench / 'rec.csv'} --json j.json --report page"
    assert run(command.split()) == 130
    said = capsys.readouterr().err.splitlines()[-1]
    assert said == "surgisoft: interrupted; written before and complete: j.json; nothing else"
    assert [path.name for path in tmp_path.rglob("*") if path.is_file()] == ["j.json"]


def test_an_interrupted_study_says_what_it_uses_again(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("benchmarks.setup_faults.run", interrupt)
    assert run(["benchmark", "setup-faults", "--work", str(tmp_path)]) == 130
    said = capsys.readouterr().err
    assert f"the same command uses again what is complete in {tmp_path}" in said


def test_caches_are_not_noted(tmp_path):
    with noted_writes() as written:
        write_atomically(tmp_path / "a.field", b"1", noted=False)
        write_atomically(tmp_path / "b.csv", b"2")
    write_atomically(tmp_path / "c.csv", b"3")
    assert written == [tmp_path / "b.csv"]
