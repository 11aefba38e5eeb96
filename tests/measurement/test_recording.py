"""Recordings in memory and on disk: round trips, folders, atomic writing."""

import dataclasses
import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

import surgisoft.cli
from surgisoft.errors import InputError
from surgisoft.measurement.recordings import (
    AlarmInfo,
    ArmInfo,
    Recording,
    check_rows,
    check_same_arm,
    load_recording,
    load_recordings,
    part_of,
    save_recording,
    summary,
)

NUMBER = st.floats(allow_nan=False, allow_infinity=False)
ARRAYS = ("t_s", "measured", "commanded", "key_points_mm", "run", "temp_C", "payload_g", "gravity")


@st.composite
def recordings(draw):
    samples = draw(st.integers(1, 12))
    m, n = draw(st.integers(1, 4)), draw(st.integers(1, 3))
    runs = draw(st.integers(1, min(3, samples)))
    starts = sorted(draw(st.permutations(range(1, samples)))[: runs - 1])
    ids = draw(st.lists(st.integers(-(2**50), 2**50), min_size=runs, max_size=runs, unique=True))
    run = np.repeat(ids, np.diff([0, *starts, samples]))
    times = draw(
        st.lists(
            st.floats(-1e6, 1e6, allow_nan=False), min_size=samples, max_size=samples, unique=True
        )
    )

    def array(*shape, missing=False):
        values = draw(npst.arrays(np.float64, shape, elements=NUMBER))
        if missing:
            lost = draw(npst.arrays(bool, shape[:2]))
            values = np.where(lost.reshape(lost.shape + (1,) * (len(shape) - 2)), np.nan, values)
        return values

    points = array(samples, n, 3, missing=True)
    points[0, 0] = 1.0  # at least one key point is seen
    maybe = draw(st.tuples(st.booleans(), st.booleans(), st.booleans(), st.booleans()))
    direction = draw(npst.arrays(np.float64, 3, elements=st.floats(0.1, 1)))
    sizes = st.none() | st.floats(1e-3, 1e6)
    return Recording(
        name="x",
        t_s=np.sort(times),
        measured=array(samples, m),
        key_points_mm=points,
        commanded=array(samples, m) if maybe[0] else None,
        run=run,
        unit=draw(st.sampled_from(["kPa", "deg", "psi", "mm", "V", "norm", "bar"])),
        temp_C=array(samples, 1, missing=True)[:, 0] if maybe[1] else None,
        payload_g=array(samples) if maybe[2] else None,
        arm=ArmInfo(draw(sizes), draw(sizes)),
        gravity=direction / np.linalg.norm(direction) if maybe[3] else None,
        kind=draw(st.sampled_from(["continuous", "settled"])),
        noise_mm=draw(st.none() | st.floats(0, 1e3)),
        note=draw(st.text(st.characters(exclude_categories=["Cs", "Cc"]), max_size=20)),
    )


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@given(recording=recordings())
def test_what_is_saved_is_read_bit_by_bit(tmp_path_factory, suffix, recording):
    path = tmp_path_factory.mktemp("round") / f"x{suffix}"
    save_recording(recording, path)
    read = load_recording(path, on_warning=lambda _: None)
    for name in ARRAYS:
        saved, loaded = getattr(recording, name), getattr(read, name)
        assert (saved is None) == (loaded is None), name
        if saved is not None:
            assert saved.dtype == loaded.dtype
            np.testing.assert_array_equal(saved, loaded, err_msg=name)
    for name in ("unit", "kind", "noise_mm", "note", "name"):
        assert getattr(recording, name) == getattr(read, name)
    assert recording.arm == read.arm
    assert read.source == path


def small(**changes):
    t = np.arange(6) * 0.05
    recording = Recording(
        name="small",
        t_s=t,
        measured=np.stack([10 + t, 20 - t], axis=1),
        key_points_mm=np.stack([t, 2 * t, 3 * t + 1], axis=1)[:, None, :] * np.ones((1, 2, 1)),
    )
    return dataclasses.replace(recording, **changes)


def test_runs_are_blocks_of_equal_ids_in_order():
    recording = small(run=[7, 7, 3, 3, 3, 5])
    assert recording.runs == [slice(0, 2), slice(2, 5), slice(5, 6)]
    assert (recording.samples, recording.chambers, recording.key_points) == (6, 2, 2)


def test_missing_run_is_one_run():
    assert small().runs == [slice(0, 6)]
    assert small().run.dtype == np.int64


def test_partly_missing_key_point_is_missing_as_a_whole():
    points = np.ones((6, 2, 3))
    points[2, 1, 0] = np.nan
    np.testing.assert_array_equal(
        np.isnan(small(key_points_mm=points).key_points_mm[2]), [[False] * 3, [True] * 3]
    )


def test_gravity_within_tolerance_gets_unit_length():
    gravity = small(gravity=[0.42, 0.0, 0.9075]).gravity
    assert np.linalg.norm(gravity) == pytest.approx(1, abs=1e-15)
    np.testing.assert_allclose(gravity, [0.42, 0, 0.9075], rtol=3e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"t_s": [0, 1, 2, 2, 3, 4.0]}, "time of sample 3 is 2.0 s after 2.0 s"),
        ({"run": [0, 0, 1, 1, 0, 0]}, "run 0 appears again at sample 4"),
        ({"measured": np.full((6, 2), np.nan)}, "measured of sample 0 is not finite"),
        ({"measured": np.ones((5, 2))}, "measured has shape (5, 2), expected (6, 2)"),
        ({"commanded": np.ones((6, 1))}, "commanded has shape (6, 1), expected (6, 2)"),
        ({"key_points_mm": np.ones((6, 3))}, "expected (T, n, 3)"),
        ({"key_points_mm": np.full((6, 1, 3), np.inf)}, "key_points_mm of sample 0 is infinite"),
        ({"kind": "static"}, "kind is 'static', expected one of continuous, settled"),
        ({"gravity": [0, 0, 2]}, "expected a unit vector"),
        ({"noise_mm": -1.0}, "noise_mm is -1.0"),
        ({"arm": ArmInfo(length_mm=0.0)}, "length_mm is 0.0"),
    ],
)
def test_inconsistent_recording_is_refused(changes, message):
    with pytest.raises(InputError) as error:
        small(**changes)
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_same_arm_names_the_file_that_differs(tmp_path):
    save_recording(small(), tmp_path / "a.csv")
    for i, (changes, what) in enumerate(
        [
            ({"measured": np.ones((6, 3))}, "3 actuation channels, expected 2"),
            ({"key_points_mm": np.ones((6, 1, 3))}, "1 key points, expected 2"),
            ({"unit": "psi"}, "psi as unit of the actuation, expected kPa"),
        ]
    ):
        other = tmp_path / f"b{i}.parquet"
        save_recording(small(**changes), other)
        with pytest.raises(InputError) as error:
            check_same_arm(load_recordings([tmp_path / "a.csv", other]))
        assert str(other) in str(error.value)
        assert what in str(error.value)
    check_same_arm([small(), small(unit="kPa")])


def test_too_few_rows_name_the_purpose():
    check_rows([small(), small()], 12, "fit a model")
    with pytest.raises(InputError, match="12 rows, expected at least 13 to fit a model"):
        check_rows([small(), small()], 13, "fit a model")


def test_folder_is_read_in_the_order_of_names(tmp_path):
    for name in ("b.csv", "a.parquet", "c.csv"):
        save_recording(small(), tmp_path / name)
    (tmp_path / "readme.md").write_text("no recording")
    assert [r.name for r in load_recordings(tmp_path)] == ["a", "b", "c"]
    assert [r.name for r in load_recordings([tmp_path / "c.csv", tmp_path / "a.parquet"])] == [
        "c",
        "a",
    ]


def test_recording_given_twice_is_read_once(tmp_path):
    save_recording(small(), tmp_path / "a.csv")
    said = []
    read = load_recordings([tmp_path, tmp_path / "a.csv"], on_warning=said.append)
    assert len(read) == 1
    assert said == [f"{tmp_path}/a.csv: given twice, read once"]


def test_folder_with_one_recording_in_two_forms_is_refused(tmp_path):
    save_recording(small(), tmp_path / "a.csv")
    save_recording(small(), tmp_path / "a.parquet", force=True)
    with pytest.raises(InputError, match=r"both a\.csv and a\.parquet"):
        load_recordings(tmp_path)
    assert len(load_recordings(tmp_path / "a.csv")) == 1


def test_existing_recording_or_sidecar_is_kept(tmp_path):
    path = tmp_path / "a.csv"
    save_recording(small(), path)
    before = path.read_bytes()
    with pytest.raises(InputError, match=r"a\.csv: exists already"):
        save_recording(small(unit="psi"), path)
    assert path.read_bytes() == before
    with pytest.raises(InputError, match=r"a\.toml: exists already"):
        save_recording(small(), tmp_path / "a.parquet")
    save_recording(small(unit="psi", kind="settled"), path, force=True)
    assert load_recording(path).unit == "psi"
    assert load_recording(path).kind == "settled"


def test_nothing_is_left_when_writing_fails(tmp_path, monkeypatch):
    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(InputError, match="No space left on device"):
        save_recording(small(), tmp_path / "a.csv")
    assert list(tmp_path.iterdir()) == []


def test_unit_that_no_column_can_carry_is_refused(tmp_path):
    with pytest.raises(InputError, match="p1_N/m"):
        save_recording(small(unit="N/m"), tmp_path / "a.csv")
    assert list(tmp_path.iterdir()) == []


def test_lengths_in_other_units_are_converted(tmp_path):
    for unit, factor in (("mm", 1), ("cm", 10), ("m", 1000)):
        path = tmp_path / f"{unit}.csv"
        path.write_text(f"t_s,p1_deg,k0_x_{unit},k0_y_{unit},k0_z_{unit}\n0,1,2,3,-4\n1,2,,,\n")
        points = load_recording(path).key_points_mm
        np.testing.assert_array_equal(points[0, 0], np.array([2, 3, -4]) * factor)
        assert np.isnan(points[1, 0]).all()


def test_columns_may_come_in_any_order(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(
        "k0_z_mm,c2_V,p2_V,run,k0_x_mm,c1_V,t_s,k0_y_mm,p1_V\n3,22,12,5,1,21,0.5,2,11\n"
    )
    read = load_recording(path)
    np.testing.assert_array_equal(read.key_points_mm, [[[1, 2, 3]]])
    np.testing.assert_array_equal(read.measured, [[11, 12]])
    np.testing.assert_array_equal(read.commanded, [[21, 22]])
    assert (read.t_s[0], read.run[0]) == (0.5, 5)


@pytest.mark.parametrize(
    "text",
    [
        "t_s,p1_V,k0_x_mm,k0_y_mm,k0_z_mm\r\n0,1,2,3,4\r\n\r\n1,2,3,4,5\r\n",
        "\ufefft_s,p1_V,k0_x_mm,k0_y_mm,k0_z_mm\n0,1,2,3,4\n1,2,3,4,5",
        '"t_s","p1_V","k0_x_mm","k0_y_mm","k0_z_mm"\n"0",1,2,3,4\n 1 , 2,+3,4.0e0,5.\n',
    ],
    ids=["CRLF and blank lines", "byte order mark", "quotes, blanks, odd numbers"],
)
def test_spreadsheets_spellings_of_the_same_table(tmp_path, text):
    path = tmp_path / "a.csv"
    path.write_bytes(text.encode())
    read = load_recording(path)
    np.testing.assert_array_equal(read.t_s, [0, 1])
    np.testing.assert_array_equal(read.measured, [[1], [2]])
    np.testing.assert_array_equal(read.key_points_mm, [[[2, 3, 4]], [[3, 4, 5]]])


def test_rows_without_actuation_are_left_out_with_a_note(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text(
        "t_s,p1_V,k0_x_mm,k0_y_mm,k0_z_mm\n0,1,2,3,4\n1,,3,4,5\n\n2,NaN,3,4,5\n3,4,5,6,7\n"
    )
    said = []
    read = load_recording(path, on_warning=said.append)
    np.testing.assert_array_equal(read.t_s, [0, 3])
    assert said == [
        f"{path}, line 3, column 'p1_V': actuation missing here, 2 such rows of 4 left out"
    ]


def test_column_outside_of_the_format_is_noted(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t_s,p1_V,k0_x_mm,k0_y_mm,k0_z_mm,humidity\n0,1,2,3,4,wet\n")
    said = []
    load_recording(path, on_warning=said.append)
    assert said == [f"{path}: column 'humidity' is not part of the format and was left out"]
    with pytest.warns(UserWarning, match="humidity"):
        load_recording(path)


def test_summary_describes_the_recording():
    points = np.ones((6, 2, 3))
    points[:3, 1] = np.nan
    lines = "\n".join(summary(small(key_points_mm=points, run=[0, 0, 0, 1, 1, 1])))
    assert "continuous, 6 rows, 2 runs, 2 channels in kPa, 2 key points" in lines
    assert "0.2 s in all, one row each 0.05 s" in lines
    assert "missing in 3 rows (50.0%)" in lines


@pytest.mark.parametrize("name", ["run.csv", "run.parquet"])
def test_the_alarm_of_a_run_stays_with_its_recording(tmp_path, name):
    """In the sidecar, whose files without one open as before."""
    path = tmp_path / name
    plain = Recording("run", np.arange(3.0), np.zeros((3, 1)), np.ones((3, 1, 3)))
    save_recording(plain, path)
    assert "alarm" not in path.with_suffix(".toml").read_text()
    assert load_recording(path).alarm is None
    save_recording(dataclasses.replace(plain, alarm=AlarmInfo(2.5, 1.25)), path, force=True)
    assert "[alarm]\nraised_s = 2.5\nsince_s = 1.25\n" in path.with_suffix(".toml").read_text()
    assert load_recording(path).alarm == AlarmInfo(2.5, 1.25)
    path.with_suffix(".toml").write_text("[alarm]\nraised_s = 2.5\n")
    with pytest.raises(InputError, match="since_s"):
        load_recording(path)
    path.with_suffix(".toml").write_text("[alarm]\nraised_s = nan\nsince_s = 1.0\n")
    with pytest.raises(InputError, match="nan"):
        load_recording(path)


def test_a_part_has_the_rows_between_two_times_since_the_first_row():
    """Two runs of ten rows at 2 Hz; the clock begins at 100 s and starts again in the second."""
    t_s = np.concatenate([100.0 + 0.5 * np.arange(10), 0.5 * np.arange(10)])
    rows = np.arange(20.0)
    whole = Recording(
        "whole",
        t_s,
        np.stack([rows, -rows], axis=1),
        rows[:, None, None] * np.ones((20, 2, 3)),
        run=np.repeat([3, 8], 10),
        temp_C=20.0 + rows,
        gravity=np.array([0.0, 0.0, -1.0]),
        alarm=AlarmInfo(103.0, 102.0),
    )
    # The second run continues one step after the first: its rows lie at 5.0 to 9.5 s.
    part = part_of(whole, 2.0, 6.0)
    assert part.measured[:, 0].tolist() == list(range(4, 12))
    assert part.temp_C.tolist() == [20.0 + row for row in range(4, 12)]
    assert part.t_s.tolist() == [102.0, 102.5, 103.0, 103.5, 104.0, 104.5, 0.0, 0.5]
    assert part.run.tolist() == [3] * 6 + [8] * 2
    assert part.key_points_mm[:, 1, 2].tolist() == list(range(4, 12))
    assert part.gravity.tolist() == [0.0, 0.0, -1.0]
    assert part.commanded is None
    assert part_of(whole, None, 2.0).measured[:, 0].tolist() == [0, 1, 2, 3]
    assert part_of(whole, 9.0).measured[:, 0].tolist() == [18, 19]
    with pytest.raises(InputError, match=r"no row from 10 s on and before inf s, .* 0 to 9\.5 s"):
        part_of(whole, 10.0)
    with pytest.raises(InputError, match="begins at -1 s, expected >= 0"):
        part_of(whole, -1.0)
    with pytest.raises(InputError, match="ends at nan s"):
        part_of(whole, None, np.nan)


def test_an_alarm_stays_with_its_row():
    t_s = np.arange(10.0)
    made = Recording("r", t_s, np.zeros((10, 1)), np.zeros((10, 1, 3)), alarm=AlarmInfo(6.0, 4.0))
    assert part_of(made, 5.0).alarm == AlarmInfo(6.0, 4.0)
    assert part_of(made, None, 6.0).alarm is None


def test_the_command_writes_a_part(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rows = np.arange(40.0)
    made = Recording("rec", rows, rows[:, None], np.ones((40, 1, 3)), unit="mm", note="bench 2")
    save_recording(made, tmp_path / "rec.parquet")
    before = (tmp_path / "rec.parquet").read_bytes()
    call = ["recording", "rec.parquet", "--from", "10", "--until", "30", "-o", "part.csv"]
    assert surgisoft.cli.run(call) == 0
    assert "wrote part.csv: 20 rows" in capsys.readouterr().out
    part = load_recording("part.csv")
    assert part.measured[:, 0].tolist() == list(range(10, 30))
    assert (part.unit, part.note, part.name) == ("mm", "bench 2", "part")
    for wrong, words in (
        (["rec.parquet", "--until", "3"], "add -o PART"),
        (["rec.parquet", "-o", "p.csv"], "add --from S, --until S or both"),
        (["rec.parquet", "part.csv", "--from", "3", "-o", "p.csv"], "got 2 recordings"),
        (["rec.parquet", "--from", "3", "-o", "rec.parquet", "--force"], "is the recording itself"),
        (["rec.parquet", "--from", "3", "-o", "part.csv"], "exists already"),
        (["rec.parquet", "--from", "99", "-o", "p.csv"], "no row from 99 s on"),
    ):
        assert surgisoft.cli.run(["recording", *wrong]) == 2
        error = capsys.readouterr().err
        assert words in error.splitlines()[-1]
        assert error.count("surgisoft: error") == 1
    assert not (tmp_path / "p.csv").exists()
    assert (tmp_path / "rec.parquet").read_bytes() == before
