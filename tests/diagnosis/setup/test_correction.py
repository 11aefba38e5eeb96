"""The correction of a set-up: the lines of a map, `--apply`, and what the commands say."""

import json
from dataclasses import replace

import numpy as np
import pytest
import tomli_w

from surgisoft.cli import run
from surgisoft.diagnosis.setup import find_setup_faults
from surgisoft.diagnosis.setup.correction import Correction
from surgisoft.diagnosis.setup.sample import Arrangement
from surgisoft.measurement.histories import history_of
from surgisoft.measurement.importing import import_files, load_map
from surgisoft.measurement.recordings import load_recording, save_recording
from surgisoft.surrogate.checkpoint import save_model
from tests.diagnosis.setup.recordings import driven, in_time, late, turned, with_points
from tests.diagnosis.small import measured, small_arm

ROWS = 1000
"""Rows of the recordings that commands are given."""

WRONG = {
    "frame and cm": lambda r: with_points(
        turned(r, [0.3, 0.1, 1.9], [30.0, 0.0, 8.0]),
        turned(r, [0.3, 0.1, 1.9], [30.0, 0.0, 8.0]).key_points_mm / 10,
    ),
    "mirrored and permuted": lambda r: driven(
        with_points(r, r.key_points_mm * [-1.0, 1.0, 1.0]), lambda u: u[:, [2, 1, 0]]
    ),
    "psi and sign": lambda r: driven(r, lambda u: u * [1.0, -1.0, 1.0] / 6.894757293168361),
    "kPa converted from psi and sign": lambda r: driven(
        r, lambda u: u * [1.0, -1.0, 1.0] * 6.894757293168361
    ),
    "inches converted from cm": lambda r: with_points(r, r.key_points_mm / 2.54),
    "reversed and too large": lambda r: with_points(r, r.key_points_mm[:, ::-1] * 1000),
    "ms and late": lambda r: in_time(late(r, 5), 1e3),
    "s read as ms": lambda r: in_time(r, 1e-3),
    "early": lambda r: late(r, -8),
}


def map_of(recording) -> dict:
    """A map that reads a recording as it is."""
    count = recording.key_points
    return {
        "time": {"column": "t_s"},
        "measured": {},
        "commanded": {},
        "key_points": {
            "positions": [[f"k{k}_{axis}_mm" for axis in "xyz"] for k in range(count)],
            "unit": "mm",
        },
        "runs": {"column": "run"},
    }


@pytest.mark.parametrize("name", WRONG)
def test_the_lines_of_the_map_mend_like_apply(name, tmp_path):
    wrong = WRONG[name](measured())
    found = find_setup_faults(small_arm(), [wrong])
    assert found.correctable
    save_recording(wrong, tmp_path / "raw.parquet")
    table = map_of(wrong)
    for section, fields in found.correction.tables().items():
        table[section] = table.get(section, {}) | fields
    if "columns" in table["measured"] and "unit" not in table["commanded"]:
        order = [name.replace("p", "c", 1) for name in table["measured"]["columns"]]
        table["commanded"] |= {"columns": order, "unit": table["measured"]["unit"]}
    if "to" in table["measured"]:
        table.pop("commanded")
    (tmp_path / "correction.toml").write_text(tomli_w.dumps(table))
    part = import_files(
        [tmp_path / "raw.parquet"], load_map(str(tmp_path / "correction.toml")), None
    )[0]
    corrected = found.corrected([wrong])[0]
    history = history_of([corrected])
    apart = (small_arm().predict(history) - history.key_points).square().sum(-1)
    assert found.after_mm == pytest.approx(float(apart.nanmean().sqrt()), rel=1e-3)
    np.testing.assert_allclose(part.recording.measured, corrected.measured, atol=5e-3)
    np.testing.assert_allclose(np.diff(part.recording.t_s), np.diff(corrected.t_s), atol=1e-9)
    np.testing.assert_allclose(part.recording.key_points_mm, corrected.key_points_mm, atol=2e-2)
    assert find_setup_faults(small_arm(), [part.recording]) is None


@pytest.mark.parametrize(
    ("of_model", "expected"),
    [
        (None, [0.0, 1.0, 0.0]),
        ((0.0, 1.0, 0.0), [0.0, 1.0, 0.0]),
        ((0.0, 0.0, 1.0), [0.0, 1.0, 0.0]),
        ((1.0, 0.0, 0.0), [1.0, 0.0, 0.0]),
    ],
)
def test_stated_gravity_is_turned_with_the_key_points(of_model, expected):
    """A quarter turn about z takes x to y. A direction that is the model's as stated stays."""
    given = replace(measured(50), gravity=np.array([1.0, 0.0, 0.0]))
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    correction = Correction(
        Arrangement.as_recorded(3), tuple(range(5)), "kPa", "kPa", rotation=turn, gravity=of_model
    )
    found = correction.applied(given)
    np.testing.assert_allclose(found.gravity, expected, atol=1e-12)
    x, y, z = np.moveaxis(given.key_points_mm, -1, 0)
    np.testing.assert_allclose(found.key_points_mm, np.stack([-y, x, z], -1), atol=1e-12)


def test_an_origin_in_metres_is_as_fine_as_one_in_millimetres():
    same, origin = Arrangement.as_recorded(3), np.array([12.3456, 0.0, -98.7654])
    correction = Correction(
        same, tuple(range(5)), "kPa", "kPa", mm_per_unit=1000.0, origin_mm=origin
    )
    stated = correction.tables()
    assert stated["key_points"] == {"unit": "m"}
    np.testing.assert_allclose(1000.0 * np.array(stated["frame"]["origin"]), origin, atol=1e-4)


def test_what_was_recorded_besides_stays_with_its_row():
    """The log is two rows late: the last two rows go, and with them their temperature and load."""
    given = measured(50)
    t_s, model = given.t_s, small_arm()
    given = replace(given, temp_C=20.0 + t_s, payload_g=3.0 * t_s, commanded=5.0 * given.measured)
    same = Arrangement.as_recorded(3)
    correction = Correction(same, tuple(range(5)), model.spec.unit, "kPa", delay_s=0.2)
    found = correction.applied(given)
    np.testing.assert_allclose(found.t_s, t_s[:-2])
    np.testing.assert_allclose(found.temp_C, 20.0 + t_s[:-2])
    np.testing.assert_allclose(found.payload_g, 3.0 * t_s[:-2])
    np.testing.assert_allclose(found.key_points_mm, given.key_points_mm[:-2])
    np.testing.assert_allclose(found.measured, given.measured[2:], atol=1e-9)
    np.testing.assert_allclose(found.commanded, given.commanded[2:], atol=1e-9)
    between = replace(correction, delay_s=0.15).applied(given)
    middle = 0.5 * (given.measured[1:-1] + given.measured[2:])
    np.testing.assert_allclose(between.measured, middle, atol=1e-9)
    np.testing.assert_allclose(between.commanded, given.commanded[1:-1], err_msg="held until set")


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    """Folder of the small arm, as commands take it."""
    path = tmp_path_factory.mktemp("arm") / "small"
    save_model(small_arm(), path)
    return str(path)


@pytest.fixture
def folder(tmp_path):
    wrong = turned(measured(ROWS), [0.0, 0.0, 1.5], [40.0, 0.0, 0.0])
    save_recording(replace(wrong, name="day2"), tmp_path / "day2.parquet")
    save_recording(measured(ROWS), tmp_path / "day1.parquet")
    return tmp_path


def test_apply_writes_what_is_mended_and_nothing_else(arm, folder, capsys):
    before = (folder / "day2.parquet").read_bytes()
    out = folder / "corrected"
    given = ["diagnose", arm, str(folder / "day2.parquet"), "--apply", str(out)]
    assert run([*given, "--json", str(folder / "found.json")]) == 0
    text = capsys.readouterr().out
    assert text.startswith("setup: the frame of the key points is turned by 85.9 deg about z")
    assert "[frame]" in text
    assert f"next: surgisoft diagnose {arm} {out}" in text
    assert (folder / "day2.parquet").read_bytes() == before
    assert sorted(path.name for path in out.iterdir()) == ["day2.parquet", "day2.toml"]
    corrected = load_recording(out / "day2.parquet")
    apart = corrected.key_points_mm - measured(ROWS).key_points_mm
    assert np.abs(apart).max() < 0.1
    plain = json.loads((folder / "found.json").read_text())
    assert plain["verdict"]["kind"] == "setup"
    assert plain["setup"]["recordings"] == ["day2"]
    assert find_setup_faults(small_arm(), [corrected]) is None


def test_one_of_two_recordings_of_one_name_is_corrected_but_not_written(arm, folder, capsys):
    """Their files tell them apart; a folder cannot hold both, which is said before the work."""
    wrong, right = folder / "wrong" / "rec.parquet", folder / "right" / "rec.parquet"
    for source, place in (("day2", wrong), ("day1", right)):
        place.parent.mkdir()
        save_recording(load_recording(folder / f"{source}.parquet"), place)
    both = [load_recording(place) for place in (right, wrong)]
    found = find_setup_faults(small_arm(), both)
    assert found.recordings == (str(wrong),)
    fine, corrected = found.corrected(both)
    np.testing.assert_array_equal(fine.key_points_mm, both[0].key_points_mm)
    assert np.abs(corrected.key_points_mm - both[0].key_points_mm).max() < 0.1
    out = folder / "corrected"
    given = ["diagnose", arm, str(right), str(wrong), "--apply", str(out)]
    assert run([*given, "--json", str(folder / "found.json")]) == 2
    assert f"two recordings are called 'rec' ({right}, {wrong})" in capsys.readouterr().err
    assert not (folder / "found.json").exists()


def test_apply_replaces_nothing(arm, folder, capsys):
    given = ["diagnose", arm, str(folder / "day2.parquet"), "--apply", str(folder)]
    assert run(given) == 2
    assert "is not empty" in capsys.readouterr().err


def test_nothing_is_written_where_nothing_is_wrong(arm, folder, capsys):
    out = folder / "corrected"
    assert run(["diagnose", arm, str(folder / "day1.parquet"), "--apply", str(out)]) == 0
    assert "nothing to correct" in capsys.readouterr().out
    assert not out.exists()


def test_the_tests_can_be_left_out(arm, folder, capsys):
    given = ["diagnose", arm, str(folder / "day2.parquet"), "--no-setup-tests"]
    assert run(given) == 0
    assert not capsys.readouterr().out.startswith("setup")


def test_compare_points_to_diagnose(arm, folder, capsys):
    assert run(["compare", arm, str(folder / "day2.parquet")]) == 0
    line = next(x for x in capsys.readouterr().out.splitlines() if x.startswith("set-up:"))
    assert "turned by 85.9 deg about z" in line
    assert "surgisoft diagnose" in line


def test_a_wrong_unit_of_length_is_named_by_the_command(arm, folder, capsys):
    wrong = with_points(measured(ROWS), measured(ROWS).key_points_mm / 1000)
    save_recording(wrong, folder / "metres.parquet")
    assert run(["diagnose", arm, str(folder / "metres.parquet")]) == 0
    text = capsys.readouterr().out
    assert "the positions are in m where mm are stated" in text
    assert 'unit = "m"' in text


def test_import_tests_the_set_up_against_a_model(arm, folder, capsys):
    (folder / "map.toml").write_text(tomli_w.dumps(map_of(measured(ROWS))))
    given = ["import", str(folder / "day2.parquet"), "--map", str(folder / "map.toml")]
    out = ["-o", str(folder / "new.parquet"), "--model", arm]
    assert run([*given, *out]) == 0
    text = capsys.readouterr()
    assert "set-up: the frame of the key points is turned by 85.9 deg" in text.err
    assert "[frame]" in text.out


def test_the_report_shows_what_mends_it(arm, folder):
    given = ["diagnose", arm, str(folder / "day2.parquet"), "--report", str(folder / "page")]
    assert run(given) == 0
    page = (folder / "page" / "diagnosis.html").read_text()
    assert "Set-up of the recordings" in page
    assert "rotation = [[" in page
