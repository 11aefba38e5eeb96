"""Benchmark `real`: entries and their errors, and a complete run on made-up recordings."""

import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.real.entries import FOLDER, Source, files_of, load_entries, part_of
from benchmarks.real.study import Answer, Outcome, misleads, right
from benchmarks.real.table import summary
from surgisoft.cli import run
from surgisoft.errors import InputError
from surgisoft.measurement.recordings import Recording, save_recording

ENTRY = """
robot = "Made-up arm"
change = "one chamber pushes less"
truth = ["gain_mismatch"]
source = "this test"
licence = "none"

[before]
files = ["before.parquet"]

[after]
files = ["after.parquet"]

[fit]
inputs = "pressure"
widths = [16, 16]
epochs = 80
prior = "none"
"""
NOISE_MM = 0.02


def made_up(gain: float, seed: int, rows: int = 1200) -> Recording:
    """A planar arm of two chambers, whose second one has a gain."""
    rng = np.random.default_rng(seed)
    time = 0.05 * np.arange(rows)
    waves = [np.sin(2 * np.pi * time / period) for period in rng.uniform(3, 12, 4)]
    p = 25 + 12 * np.stack([waves[0] + waves[1], waves[2] + waves[3]], axis=1)
    x = p * [1.0, gain]
    points = np.stack([x[:, 0] / 5, x[:, 1] / 5, 40 + 0.0 * time], axis=1)
    tip = np.stack([x[:, 0] * 0.8, x[:, 1] * 0.8, 80 - x.sum(1) / 20], axis=1)
    measured = np.stack([points, tip], axis=1)
    return Recording(
        name="made up",
        t_s=time,
        measured=p,
        key_points_mm=measured + rng.normal(0, NOISE_MM, measured.shape),
        noise_mm=NOISE_MM,
    )


@pytest.fixture
def lab(tmp_path):
    """Folders of entries and of recordings before and after a change of a gain."""
    data, entries = tmp_path / "data", tmp_path / "entries"
    data.mkdir()
    entries.mkdir()
    save_recording(made_up(1.0, 1), data / "before.parquet")
    save_recording(made_up(0.85, 2), data / "after.parquet")
    (entries / "weaker.toml").write_text(ENTRY)
    return data, entries


def test_a_complete_run(lab, tmp_path, capsys):
    data, entries = lab
    (entries / "absent.toml").write_text(ENTRY.replace("after.parquet", "lost.parquet"))
    clean = ENTRY.replace('["gain_mismatch"]', "[]").replace('["after.parquet"]', '["b*.parquet"]')
    clean = clean.replace('files = ["b*.parquet"]', 'files = ["b*.parquet"]\npart = [0.5, 1.0]')
    (entries / "same.toml").write_text(clean)
    out, page = tmp_path / "found.json", tmp_path / "real.md"
    command = ["benchmark", "real", str(entries), "--data", str(data), "-o", str(page)]
    command += ["--work", str(tmp_path / "work"), "--json", str(out)]
    assert run(command) == 0
    absent, same, weaker = json.loads(out.read_text())["entries"]
    assert "lost.parquet" in absent["skipped"]
    assert same["verdict"]["names"] == []
    assert (same["named"], same["misled"]) == (True, False)
    assert "gain_mismatch" in weaker["verdict"]["names"]
    assert weaker["ranking"][0] == "gain_mismatch"
    # By hand: 0.15 of the second chamber's load moves the tip by 0.12 mm/kPa, the middle by 0.03.
    after = made_up(0.85, 2).measured[:, 1]
    change = np.sqrt(np.mean(after**2) * (0.12**2 + 0.03**2 + (0.15 / 20) ** 2) / 2)
    assert weaker["error_mm"]["before"] == pytest.approx(change, rel=0.2)
    assert weaker["error_mm"]["amended"] < 0.3 * weaker["error_mm"]["held_out"]
    models = list((tmp_path / "work").glob("model-*"))
    assert len(models) == 1  # both entries are fitted to the same recording with the same options
    assert "| weaker | one chamber pushes less | gain_mismatch |" in page.read_text()
    assert "lost.parquet" in page.read_text()
    capsys.readouterr()


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ('["gain_mismatch"]', '["gravity"]', "truth[0]: got text 'gravity'; expected one of"),
        ('["gain_mismatch"]', '["setup"]', "kinds of faults where the truth is 'setup'"),
        ('["gain_mismatch"]', '["setup"]\nfaults = ["dust"]', "one of chambers, "),
        ('["gain_mismatch"]', '["setup", "creep"]', "alone, or names of effects"),
        ("[after]", "[later]", "unknown field"),
        ('["after.parquet"]', "[]", "after.files: got a list []; expected at least one file"),
        ('["after.parquet"]', '["/after.parquet"]', "relative to the data folder"),
        ('["after.parquet"]', '["after.parquet"]\nmap = "m.toml"', "no such file 'm.toml'"),
        ('["after.parquet"]', '["after.parquet"]\npart = [0.5, 0.5]', "two shares"),
        ('licence = "none"', "", "licence: missing"),
        ('licence = "none"', "licence = ", "not valid TOML"),
    ],
)
def test_a_bad_entry_is_one_line(lab, capsys, old, new, expected):
    data, entries = lab
    (entries / "weaker.toml").write_text(ENTRY.replace(old, new))
    assert run(["benchmark", "real", str(entries), "--data", str(data)]) == 2
    error = capsys.readouterr().err
    assert "weaker.toml" in error
    assert expected in error
    assert error.count("\n") == 1


def test_missing_data_is_one_line(lab, tmp_path, capsys, monkeypatch):
    data, entries = lab
    monkeypatch.delenv("SURGISOFT_REAL_DATA", raising=False)
    assert run(["benchmark", "real", str(entries)]) == 2
    assert "--data FOLDER or set SURGISOFT_REAL_DATA" in capsys.readouterr().err
    (data / "after.parquet").unlink()
    monkeypatch.setenv("SURGISOFT_REAL_DATA", str(data))
    assert run(["benchmark", "real", str(entries), "--work", str(tmp_path / "work")]) == 2
    assert "weaker: after.parquet: no such file" in capsys.readouterr().err
    assert run(["benchmark", "real", str(entries), "--only", "other"]) == 2
    assert "unknown entry 'other': known are weaker" in capsys.readouterr().err


def test_the_projects_entries_open_and_say_where_they_come_from():
    entries = load_entries([])
    assert {entry.name for entry in entries} == {path.stem for path in FOLDER.glob("*.toml")}
    assert all("github.com" in entry.source for entry in entries)
    assert any(not entry.truth for entry in entries)


def test_part_of_a_recording():
    recording = made_up(1.0, 0, rows=10)
    part = part_of(recording, 0.2, 0.5)
    assert part.t_s.tolist() == pytest.approx([0.1, 0.15, 0.2])
    assert np.array_equal(part.key_points_mm, recording.key_points_mm[2:5])


def test_files_match_as_in_a_shell(tmp_path):
    for name in ("run_2.csv", "run_1.csv", "other.csv"):
        (tmp_path / name).write_text("")
    found = files_of(Source(("run_*.csv",)), tmp_path)
    assert [path.name for path in found] == ["run_1.csv", "run_2.csv"]
    assert len(files_of(Source(("run_*.csv", "run_1.csv")), tmp_path)) == 2
    with pytest.raises(InputError, match="not a pattern of files"):
        files_of(Source(("run**.csv",)), tmp_path)


def outcome(truth: tuple[str, ...], kind: str, names: tuple[str, ...], confidence: float):
    """An outcome without recordings."""
    (entry,) = load_entries([FOLDER / "trunk_0g_100g.toml"])
    answer = Answer(kind, names, confidence, names, "", 2.0, 0.1, 1.0, 1.0, 0.1)
    object.__setattr__(entry, "truth", truth)
    return Outcome(entry, answer=answer)


def test_what_counts_as_named_and_as_misled():
    alone = outcome(("payload",), "identified", ("payload",), 0.9)
    pair = outcome(("payload",), "ambiguous", ("gain_mismatch", "payload"), 0.85)
    three = outcome(("payload",), "ambiguous", ("payload", "creep", "drift"), 0.5)
    wrong = outcome(("payload",), "identified", ("creep",), 0.8)
    unsure = outcome(("payload",), "identified", ("creep",), 0.7)
    clean = outcome((), "nothing_missing", (), 0.0)
    false = outcome((), "identified", ("creep",), 0.6)
    strange = outcome((), "unknown_effect", ("unknown",), 0.1)
    turned = outcome((), "setup", ("setup",), 0.0)
    other_set = outcome(("payload",), "ambiguous", ("creep", "drift"), 0.85)
    some = [alone, pair, three, wrong, unsure, clean, false, strange, turned]
    both = outcome(("payload",), "several", ("payload", "creep"), 0.9)
    assert (other_set.named, other_set.misled) == (False, True)
    assert (both.named, both.misled) == (False, True)
    named = [True, True, False, False, False, True, False, False, False]
    assert [each.named for each in some] == named
    assert [each.misled for each in some] == [False, False, False, True] + 4 * [False] + [True]
    rows = summary(some)
    assert "| known change named, alone or in a set of 2 | 2 of 5 | 90% |" in rows
    assert "| known change named alone | 1 of 5 | |" in rows
    assert "| wrong name with confidence >= 0.8 | 2 of 9 | 0 |" in rows
    assert "| effect named where nothing changed | 2 of 4 | 0 |" in rows
    assert "| unknown effect reported where nothing changed | 1 of 4 | |" in rows


def test_faults_of_the_set_up_have_to_be_those_that_are_true():
    found = outcome(("setup",), "setup", ("setup",), 0.0).answer
    frame = replace(found, faults=("frame",))
    more = replace(found, faults=("chambers", "frame"))
    assert right(frame, ("setup",), ("frame",))
    assert not right(more, ("setup",), ("frame",))
    assert misleads(more, ("setup",), ("frame",))
    assert not misleads(frame, ("setup",), ("frame", "time"))
