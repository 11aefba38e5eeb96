"""Files that belong together, runs, and the rows that are kept."""

import numpy as np
import pytest

from surgisoft.errors import InputError
from surgisoft.measurement.importing import import_files

from .test_importing import spec, text, written

TWO = """
[file.positions]
match = "pos*"
[file.inputs]
match = "inp*"
OFFSET
[time]
rate_hz = 10
[measured]
file = "inputs"
columns = ["u1", "u2"]
unit = "deg"
[key_points]
positions = [["x", "y", "z"]]
unit = "mm"
"""
ONE = """
ROWS
[time]
column = "t"
[measured]
columns = ["u"]
unit = "kPa"
[key_points]
positions = [["x", "y", "z"], ["x", "y", "w"]]
unit = "mm"
KEYS
"""


def positions(rows):
    i = np.arange(rows) * 1.0
    return np.stack([i, 10 + i, 20 + i], axis=1)


def inputs(rows):
    i = np.arange(rows) * 1.0
    return np.stack([100 + i, 200 + i], axis=1)


def pair(tmp_path, rows, input_rows, suffix=""):
    return [
        written(tmp_path / f"inp{suffix}.csv", text(inputs(input_rows), header=["u1", "u2"])),
        written(tmp_path / f"pos{suffix}.csv", text(positions(rows), header=["x", "y", "z"])),
    ]


def run(tmp_path, files, content, name="x"):
    return import_files(files, spec(tmp_path, content), name)


@pytest.mark.parametrize("offset", [-2, -1, 0, 1, 3])
def test_row_i_of_the_second_file_belongs_to_row_i_plus_offset(tmp_path, offset):
    files = pair(tmp_path, 20, 20 - offset)
    (part,) = run(tmp_path, files, TWO.replace("OFFSET", f"offset_rows = {offset}"))
    first = max(0, offset)
    rows = np.arange(first, 20)
    np.testing.assert_array_equal(part.recording.key_points_mm[:, 0, 0], rows)
    np.testing.assert_array_equal(part.recording.measured[:, 0], 100 + rows - offset)
    np.testing.assert_allclose(part.recording.t_s, (rows - first) / 10)
    if offset:
        longer = "pos.csv" if offset > 0 else "inp.csv"
        assert f"first {abs(offset)} rows of {tmp_path}/{longer} have no partner" in part.notes[0]


def test_ends_that_do_not_meet(tmp_path):
    content = TWO.replace("OFFSET", "offset_rows = 1")
    with pytest.raises(InputError, match=r"pos\.csv: 4 rows at the end have no partner") as error:
        run(tmp_path, pair(tmp_path, 20, 15), content)
    assert "20 rows" in str(error.value)
    assert "15, offset_rows 1" in str(error.value)
    with pytest.raises(InputError, match=r"inp\.csv: 6 rows at the end have no partner"):
        run(tmp_path, pair(tmp_path, 20, 25), content)
    dropping = content.replace("offset_rows = 1", 'offset_rows = 1\nunpaired = "drop"')
    (part,) = run(tmp_path, pair(tmp_path, 20, 15), dropping)
    assert part.recording.samples == 15
    assert any("last 4 rows of" in note for note in part.notes)
    (part,) = run(tmp_path, pair(tmp_path, 20, 25), dropping)
    assert part.recording.samples == 19


def test_files_become_runs_in_the_order_given(tmp_path):
    files = [*pair(tmp_path, 5, 5, "_b"), *pair(tmp_path, 3, 3, "_a")]
    (part,) = run(tmp_path, files, TWO.replace("OFFSET", ""))
    recording = part.recording
    np.testing.assert_array_equal(recording.run, [0] * 5 + [1] * 3)
    np.testing.assert_allclose(recording.t_s, [0, 0.1, 0.2, 0.3, 0.4, 0, 0.1, 0.2])
    assert recording.name == "x"


def test_one_input_file_serves_every_run(tmp_path):
    first = pair(tmp_path, 5, 5)
    second = written(tmp_path / "pos2.csv", text(-positions(5), header=["x", "y", "z"]))
    (part,) = run(tmp_path, [*first, second], TWO.replace("OFFSET", ""))
    np.testing.assert_array_equal(part.recording.measured[:5], part.recording.measured[5:])
    np.testing.assert_array_equal(
        part.recording.key_points_mm[:5], -part.recording.key_points_mm[5:]
    )


def test_folder_output_makes_a_recording_of_each_file(tmp_path):
    files = [*pair(tmp_path, 5, 5, "_b"), *pair(tmp_path, 3, 3, "_a")]
    parts = run(tmp_path, files, TWO.replace("OFFSET", ""), name=None)
    assert [(p.recording.name, p.recording.samples) for p in parts] == [("pos_b", 5), ("pos_a", 3)]
    (tmp_path / "other").mkdir()
    twice = [*files[:2], *pair(tmp_path / "other", 5, 5, "_b")]
    with pytest.raises(InputError, match="2 files would become the recording 'pos_b'"):
        run(tmp_path, twice, TWO.replace("OFFSET", ""), name=None)


@pytest.mark.parametrize(
    ("zero", "runs", "alone"),
    [("file", (0, 0), (0, 0)), ("recording", (0, 60), (0, 0)), ("none", (40, 100), (40, 100))],
)
def test_time_is_zero_where_each_file_or_the_recording_begins_or_as_it_is(
    tmp_path, zero, runs, alone
):
    """Two files that begin at 40 s and 100 s of one clock, as runs of one recording and alone."""
    values = np.arange(18.0).reshape(3, 6)
    files = []
    for start in (40.0, 100.0):
        values[:, 0] = start + np.arange(3.0)
        header = ["t", "u", "x", "y", "z", "w"]
        files.append(written(tmp_path / f"a{start:g}.csv", text(values, header=header)))
    content = ONE.replace("ROWS", "").replace("KEYS", "")
    content = content.replace('column = "t"', f'column = "t"\nzero = "{zero}"')
    (part,) = run(tmp_path, files, content)
    for number, first in enumerate(runs):
        inside = part.recording.run == number
        np.testing.assert_allclose(part.recording.t_s[inside], first + np.arange(3.0))
    for each, first in zip(run(tmp_path, files, content, None), alone, strict=True):
        np.testing.assert_allclose(each.recording.t_s, first + np.arange(3.0))


def test_the_runs_of_a_file_are_counted_on_from_those_of_the_files_before(tmp_path):
    """Three runs in the first file, two in the second one."""
    values, files = np.arange(36.0).reshape(6, 6), []
    for name, seconds in (("a", [0, 1, 50, 51, 90, 91]), ("b", [0, 1, 2, 3, 70, 71])):
        values[:, 0] = seconds
        header = ["t", "u", "x", "y", "z", "w"]
        files.append(written(tmp_path / f"{name}.csv", text(values, header=header)))
    content = ONE.replace("ROWS", "").replace("KEYS", "[runs]\ngap_s = 10")
    (part,) = run(tmp_path, files, content)
    np.testing.assert_array_equal(part.recording.run, [0, 0, 1, 1, 2, 2, 3, 3, 3, 3, 4, 4])


def test_runs_of_one_recording_have_one_unit(tmp_path):
    """Units that columns have in their names: of two files, and of two channels of one."""
    content = ONE.replace("ROWS", "").replace("KEYS", "")
    content = content.replace('columns = ["u"]\nunit = "kPa"\n', "")
    values, files = np.arange(21.0).reshape(3, 7), {}
    for one, other in (("p1_kPa", "p2_kPa"), ("p1_psi", "p2_psi"), ("p1_kPa", "p2_psi")):
        header = ["t", one, other, "x", "y", "z", "w"]
        path = tmp_path / f"{one}{other}.csv"
        files[one, other] = written(path, text(values, header=header))
    in_kpa, in_psi, mixed = files.values()
    again = written(tmp_path / "again.csv", in_kpa.read_bytes())
    (part,) = run(tmp_path, [in_kpa, again], content)
    assert part.recording.unit == "kPa"
    with pytest.raises(InputError, match=r"2 channels in psi and .* expected 2 in kPa and 2"):
        run(tmp_path, [in_kpa, in_psi], content)
    with pytest.raises(InputError, match=r"columns p1_kPa, p2_psi, expected .* of one unit"):
        run(tmp_path, [mixed], content)


def test_the_weight_of_runs_is_the_mean_of_their_directions(tmp_path):
    """Two files of an arm along z at rest, the second one's frame tilted by 0.2 rad about y."""
    files = []
    for tilt in (0.0, 0.2):
        values = np.zeros((30, 8))
        values[:, 0] = np.arange(30.0)
        values[:, 5], values[:, 7] = 50 * np.sin(tilt), 50 * np.cos(tilt)
        header = ["t", "u", "x", "y", "z", "x1", "y1", "z1"]
        files.append(written(tmp_path / f"a{tilt:g}.csv", text(values, header=header)))
    content = ONE.replace("ROWS", "").replace('["x", "y", "w"]', '["x1", "y1", "z1"]')
    content = content.replace("KEYS", '[frame]\nalign_z = "rest"\ngravity = [0, 0, 1]')
    each = [part.recording.gravity for part in run(tmp_path, files, content, None)]
    np.testing.assert_allclose(each[0], [0, 0, 1], atol=1e-9)
    np.testing.assert_allclose(each[1], [-np.sin(0.2), 0, np.cos(0.2)], atol=1e-9)
    (part,) = run(tmp_path, files, content)
    np.testing.assert_allclose(part.recording.gravity, [-np.sin(0.1), 0, np.cos(0.1)], atol=1e-9)


def test_runs_have_a_command_if_each_of_their_files_has_one(tmp_path):
    values = np.arange(18.0).reshape(3, 6)
    both = written(tmp_path / "a.csv", text(values, header=["t", "u", "x", "y", "w", "c1_kPa"]))
    lacking = written(tmp_path / "b.csv", text(values, header=["t", "u", "x", "y", "w", "z"]))
    content = ONE.replace("ROWS", "").replace('["x", "y", "z"], ', "")
    content = content.replace("KEYS", "[commanded]\noptional = true")
    again = written(tmp_path / "again.csv", both.read_bytes())
    (part,) = run(tmp_path, [both, again], content)
    np.testing.assert_array_equal(part.recording.commanded[:, 0], [5, 11, 17, 5, 11, 17])
    (part,) = run(tmp_path, [both, lacking], content)
    assert part.recording.commanded is None
    assert part.recording.samples == 6
    assert "the command is left out of all runs, because b has none" in part.notes


def test_a_file_that_is_given_twice_is_no_second_run(tmp_path):
    values = np.arange(18.0).reshape(3, 6)
    path = written(tmp_path / "a.csv", text(values, header=["t", "u", "x", "y", "w", "z"]))
    content = ONE.replace("ROWS", "").replace('["x", "y", "z"], ', "").replace("KEYS", "")
    for twice in ([path, path], [tmp_path, path]):
        with pytest.raises(InputError, match=r"a\.csv: given 2 times, .* expected each raw file"):
            run(tmp_path, twice, content)


def test_number_of_files_must_fit(tmp_path):
    files = [*pair(tmp_path, 5, 5, "_a"), *pair(tmp_path, 5, 5, "_b"), *pair(tmp_path, 5, 5, "_c")]
    content = TWO.replace("OFFSET", "")
    with pytest.raises(InputError, match=r"2 files for \[file.inputs\] and 3 for"):
        run(tmp_path, [p for p in files if p.name != "inp_b.csv"], content)
    with pytest.raises(InputError, match=r"no file for \[file.inputs\].*matches 'inp\*'"):
        run(tmp_path, files[1::2], content)
    stranger = written(tmp_path / "readme.txt", "hello")
    with pytest.raises(InputError, match=r"readme\.txt: fits no file of the map, expected one of"):
        run(tmp_path, [*files, stranger], content)
    with pytest.raises(InputError, match=r"none\.csv: no such file"):
        run(tmp_path, [tmp_path / "none.csv"], content)


def test_a_folder_means_all_raw_files_in_it(tmp_path):
    folder = tmp_path / "raw"
    folder.mkdir()
    pair(folder, 5, 5)
    written(folder / "LICENSE", "not a table")
    (part,) = run(tmp_path, [folder], TWO.replace("OFFSET", ""))
    assert part.recording.samples == 5
    with pytest.raises(InputError, match="no file here fits the map, expected one of"):
        run(tmp_path, [tmp_path], TWO.replace("OFFSET", ""))


BY_TIME = """
[file.positions]
match = "pos*"
[file.inputs]
match = "inp*"
join = "time"
time = "s"
CLOCK
[time]
column = "t"
SCALE
[measured]
file = "inputs"
columns = ["u"]
unit = "kPa"
[key_points]
positions = [["x", "y", "z"]]
unit = "mm"
"""


@pytest.mark.parametrize(
    ("clock", "scale", "moved_s"),
    [
        ("clock_offset_s = 0.25", "", -0.25),
        ("clock_offset_s = -0.25", "", 0.25),
        ('clock = "from_start"', "", -2.0),
        ('clock = "from_start"', "scale = 0.5", -1.0),
        ('clock = "from_start"\nclock_offset_s = -0.25', "", -1.75),
    ],
)
def test_the_clock_of_a_second_file_is_shifted_or_begins_with_the_first(
    tmp_path, clock, scale, moved_s
):
    """Actuation is 10 kPa/s on its own clock, from 0 s on; the positions begin at 2 s on theirs,
    whose seconds may be half as long. An offset is added to the clock of the second file."""
    s = np.arange(100) / 10
    t = 2.0 + np.arange(40) / 10
    u = np.stack([s, 10.0 * s], axis=1)
    where = np.column_stack([t, t, 10 + t, 20 + t])
    files = [
        written(tmp_path / "inp.csv", text(u, header=["s", "u"])),
        written(tmp_path / "pos.csv", text(where, header=["t", "x", "y", "z"])),
    ]
    (part,) = run(tmp_path, files, BY_TIME.replace("CLOCK", clock).replace("SCALE", scale))
    seconds = t * (0.5 if scale else 1.0)
    expected = 10.0 * (seconds + moved_s)
    np.testing.assert_allclose(part.recording.measured[:, 0], expected, atol=1e-9)
    np.testing.assert_allclose(part.recording.key_points_mm[:, 0, 0], t)


@pytest.mark.parametrize(
    ("log_from_to", "clock", "said"),
    [
        (
            (5000.0, 13000.0),
            "",
            r"from 5000 to 13000 s, about 1000 times as long: if the times of .*inp.csv are in ms, "
            r'set time_unit = "ms" in \[file.inputs\] of the map$',
        ),
        (
            (5.0, 13.0),
            'time_unit = "ms"',
            r"from 0.005 to 0.013 s, about 1/1000 times as long: if the times of .*inp.csv are in "
            r's, set time_unit = "s" in .*; if those of .*pos.csv are in ms, set unit = "ms" in ',
        ),
        ((0.0, 9.0e9), "", r'about 1e.09 times as long: .* time_unit = "ns" in'),
        (
            (500.0, 509.0),
            "",
            r"from 500 to 509 s: if their clocks count from different moments, set clock = "
            r'"from_start" or clock_offset_s in \[file.inputs\]',
        ),
    ],
)
def test_files_without_a_common_time_say_both_ranges_and_the_unit(
    tmp_path, log_from_to, clock, said
):
    """The positions are from 2 to 11 s."""
    s = np.linspace(*log_from_to, 90)
    t = np.linspace(2.01, 11.0, 40)
    files = [
        written(tmp_path / "inp.csv", text(np.stack([s, s], axis=1), header=["s", "u"])),
        written(tmp_path / "pos.csv", text(np.stack([t] * 4, axis=1), header=["t", "x", "y", "z"])),
    ]
    expected = "no row is left after joining .*; .*pos.csv has times from 2.01 to 11 s, .*inp.csv "
    with pytest.raises(InputError, match=expected + f".*{said}"):
        run(tmp_path, files, BY_TIME.replace("CLOCK", clock).replace("SCALE", ""))


# --- rows and runs of one file -----------------------------------------------------------------


def log(tmp_path, t, u=None, x=None, label=None):
    t = np.asarray(t, np.float64)
    i = np.arange(len(t)) * 1.0
    u = i if u is None else np.asarray(u)
    x = i if x is None else np.asarray(x)
    columns = [t, u, x, 0 * t, 0 * t, 50 + 0 * t]
    names = ["t", "u", "x", "y", "z", "w"]
    lines = text(np.stack(columns, axis=1), header=names).splitlines()
    if label:
        lines = [f"{line},{end}" for line, end in zip(lines, ["label", *label], strict=True)]
    return written(tmp_path / "log.csv", "\n".join(lines) + "\n")


def one(tmp_path, path, rows="", keys=""):
    content = ONE.replace("ROWS", rows).replace("KEYS", keys)
    (part,) = import_files([path], spec(tmp_path, content), "x")
    return part


def test_time_that_does_not_increase(tmp_path):
    path = log(tmp_path, [0, 1, 1, 2, 1.5, 3])
    with pytest.raises(InputError, match=r"log\.csv, line 4: time 1.0 s after 1.0 s, expected"):
        one(tmp_path, path)
    part = one(tmp_path, path, '[rows]\nrepeated_time = "drop"')
    np.testing.assert_array_equal(part.recording.t_s, [0, 1, 2, 3])
    np.testing.assert_array_equal(part.recording.measured[:, 0], [0, 1, 3, 5])
    assert "2 rows whose time does not increase left out" in part.notes[-1]


def test_time_that_falls_back_is_late_until_it_passes_the_latest_one(tmp_path):
    path = log(tmp_path, [0, 5, 2, 3, 6])
    part = one(tmp_path, path, '[rows]\nrepeated_time = "drop"')
    np.testing.assert_array_equal(part.recording.t_s, [0, 5, 6])
    np.testing.assert_array_equal(part.recording.measured[:, 0], [0, 1, 4])


def test_time_that_restarts_begins_a_run(tmp_path):
    part = one(tmp_path, log(tmp_path, [0, 1, 2, 0, 1, 0.5]), "[runs]\ntime_restarts = true")
    np.testing.assert_array_equal(part.recording.run, [0, 0, 0, 1, 1, 2])


def test_gap_in_time_begins_a_run(tmp_path):
    part = one(tmp_path, log(tmp_path, [0, 1, 2, 12, 13, 14.5]), "[runs]\ngap_s = 5")
    np.testing.assert_array_equal(part.recording.run, [0, 0, 0, 1, 1, 1])


def test_gap_as_long_as_the_limit_begins_no_run(tmp_path):
    """Rows one second apart are one run where gap_s is one second."""
    part = one(tmp_path, log(tmp_path, [0, 1, 2, 3, 4.5]), "[runs]\ngap_s = 1")
    np.testing.assert_array_equal(part.recording.run, [0, 0, 0, 0, 1])


def test_column_of_texts_begins_a_run(tmp_path):
    path = log(tmp_path, np.arange(5.0), label=["up", "up", "down", "up", "up"])
    part = one(tmp_path, path, '[runs]\ncolumn = "label"')
    np.testing.assert_array_equal(part.recording.run, [0, 0, 1, 2, 2])


def test_rows_are_cut_and_thinned(tmp_path):
    path = log(tmp_path, np.arange(20.0))
    part = one(tmp_path, path, "[rows]\nfirst = 3\nlast = 12\nevery = 4")
    np.testing.assert_array_equal(part.recording.measured[:, 0], [2, 6, 10])
    np.testing.assert_array_equal(part.recording.t_s, [0, 4, 8])


def test_thinning_begins_anew_with_each_run(tmp_path):
    """Runs of 5, 2 and 4 rows keep each third row from their first: no run is lost."""
    path = log(tmp_path, np.arange(11.0), label=list("aaaaabbcccc"))
    part = one(tmp_path, path, '[rows]\nevery = 3\n[runs]\ncolumn = "label"')
    np.testing.assert_array_equal(part.recording.t_s, [0, 3, 5, 7, 10])
    np.testing.assert_array_equal(part.recording.run, [0, 0, 1, 2, 2])


def test_rows_that_repeat_are_dropped_when_asked(tmp_path):
    path = log(tmp_path, np.arange(6.0), u=[1, 1, 2, 2, 2, 1], x=[1, 1, 2, 3, 3, 1])
    assert one(tmp_path, path).recording.samples == 6
    part = one(tmp_path, path, '[rows]\nduplicates = "drop"')
    np.testing.assert_array_equal(part.recording.t_s, [0, 2, 3, 5])


def test_first_row_of_a_run_repeats_no_row(tmp_path):
    """A run may begin where the one before it ended."""
    path = log(tmp_path, np.arange(4.0), u=[1, 2, 2, 2], x=[1, 2, 2, 2], label=list("aabb"))
    part = one(tmp_path, path, '[rows]\nduplicates = "drop"\n[runs]\ncolumn = "label"')
    np.testing.assert_array_equal(part.recording.t_s, [0, 1, 2])
    np.testing.assert_array_equal(part.recording.run, [0, 0, 1])


def test_stale_positions_are_missing_when_asked(tmp_path):
    path = log(tmp_path, np.arange(7.0), x=[1, 1, 1, 2, 3, 3, 1])
    assert not np.isnan(one(tmp_path, path).recording.key_points_mm).any()
    part = one(tmp_path, path, keys='repeated = "missing"')
    lost = np.isnan(part.recording.key_points_mm).any(axis=2)
    np.testing.assert_array_equal(lost, np.array([[0, 1, 1, 0, 0, 1, 0]] * 2, bool).T)
    assert "k0 3, k1 3 of 7 rows" in part.notes[0]


def test_positions_are_stale_after_the_row_before_in_their_file_alone(tmp_path):
    """Row 2 lies in a gap of the valves' log and is left out: row 3 does not repeat row 1."""
    x = np.array([1.0, 2.0, 7.0, 2.0, 2.0])
    cells = np.column_stack([np.arange(5.0), x, 0 * x, 0 * x])
    valves = [[0, 0], [1, 1], [3, 3], [4, 4]]
    files = [
        written(tmp_path / "pos.csv", text(cells, header=["t", "x", "y", "z"])),
        written(tmp_path / "inp.csv", text(np.array(valves, float), header=["t", "u1"])),
    ]
    content = TWO.replace("OFFSET", 'join = "time"\ntime = "t"\nmax_gap_s = 1.5')
    content = content.replace("rate_hz = 10", 'column = "t"').replace('["u1", "u2"]', '["u1"]')
    (part,) = run(tmp_path, files, content + 'repeated = "missing"\n')
    np.testing.assert_array_equal(part.recording.t_s, [0, 1, 3, 4])
    np.testing.assert_array_equal(part.recording.key_points_mm[:, 0, 0], [1, 2, 2, np.nan])


def test_steady_state_samples_are_the_means_of_their_rows(tmp_path):
    path = log(
        tmp_path,
        np.arange(8.0),
        u=[1, 2, 3, 10, 20, 5, 7, 9],
        x=[1, 2, 6, np.nan, 8, 0, 0, np.nan],
        label=["a", "a", "a", "", "b", "b", "a", "a"],
    )
    part = one(tmp_path, path, '[rows]\naverage = "label"')
    recording = part.recording
    assert recording.kind == "settled"
    np.testing.assert_allclose(recording.measured[:, 0], [2, 12.5, 8])
    np.testing.assert_allclose(recording.t_s, [0, 3.5, 5.5])
    np.testing.assert_allclose(recording.key_points_mm[:, 0, 0], [3, 4, 0])  # NaN is left out
    assert "7 rows averaged into 3 steady-state points" in part.notes[-1]


def test_a_steady_state_ends_with_its_run(tmp_path):
    """The same label on both sides of a gap: two points."""
    path = log(tmp_path, [0, 1, 50, 51], u=[1, 3, 10, 20], label=list("aaaa"))
    part = one(tmp_path, path, '[rows]\naverage = "label"\n[runs]\ngap_s = 9')
    np.testing.assert_allclose(part.recording.measured[:, 0], [2, 15])
    np.testing.assert_array_equal(part.recording.run, [0, 1])


def test_frozen_rows_are_left_out_when_asked(tmp_path):
    rng = np.random.default_rng(0)
    t = np.arange(600) / 20
    u = 10 * np.sin(t) + rng.normal(0, 0.1, 600)
    u[200:320] = u[200]
    path = log(tmp_path, t, u=u, x=10 * np.sin(t) + rng.normal(0, 0.1, 600))
    assert one(tmp_path, path).recording.samples == 600
    part = one(tmp_path, path, '[rows]\nfrozen = "drop"')
    np.testing.assert_array_equal(part.recording.t_s, np.delete(t, slice(201, 320)))
    assert "p1 frozen at 10.000 s of run 0: 119 rows left out" in part.notes[0]
    assert "a gap without rows inside a run (6 s from 10 s on)" in part.notes[1]


def test_spikes_are_missing_when_asked(tmp_path):
    rng = np.random.default_rng(0)
    t = np.arange(600) / 20
    x = 10 * np.sin(0.3 * t) + rng.normal(0, 0.02, 600)
    x[300:303] += 9
    path = log(tmp_path, t, u=np.sin(0.3 * t) + rng.normal(0, 0.01, 600), x=x)
    content = ONE.replace('["x", "y", "w"]', '["w", "y", "z"]').replace("ROWS", "")
    kept = run(tmp_path, [path], content.replace("KEYS", ""))[0]
    assert not np.isnan(kept.recording.key_points_mm).any()
    marked = run(tmp_path, [path], content.replace("KEYS", 'spikes = "missing"'))[0]
    lost = np.argwhere(np.isnan(marked.recording.key_points_mm).all(axis=2)).tolist()
    assert lost == [[300, 0], [301, 0], [302, 0]]
    assert "spikes of key points count as missing: k0 3 of 600 rows" in marked.notes[-1]
