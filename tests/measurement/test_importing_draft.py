"""Drafts of maps from headers: each is used to import the file that it was made from."""

import numpy as np
import pytest
from scipy.io import savemat

from surgisoft.cli import run
from surgisoft.errors import InputError
from surgisoft.measurement.importing import draft_map, draft_of_map, import_files, load_map

ROWS = [[0, 1.5, 2.5, 0, 0, 1, 0.5, 0, 60], [50, 1.75, 2.25, 0, 0, 1, 0.25, 0, 61]] * 6
"""ms, two pressures, two points."""


def lab_file(folder, header, separator=",", comma=False, above=""):
    path = folder / "lab.csv"
    lines = [
        separator.join(f"{k * 50 if c == 0 else v:g}" for c, v in enumerate(row))
        for k, row in enumerate(ROWS)
    ]
    body = "\n".join(lines)
    path.write_text(f"{above}{header}\n{body.replace('.', ',') if comma else body}\n")
    return path


def imported(path, folder):
    (folder / "map.toml").write_text(draft_map(path))
    (part,) = import_files([path], load_map(str(folder / "map.toml")), "lab")
    return part.recording


@pytest.mark.parametrize(
    ("header", "layout", "pressure", "scale"),
    [
        ("time_ms,pA_bar,pB_bar,x0_m,y0_m,z0_m,x1_m,y1_m,z1_m", {}, "bar", 1000.0),
        (
            "Zeit [ms];Druck A [kPa];Druck B [kPa];m1.X [cm];m1.Y [cm];m1.Z [cm];"
            "m2.X [cm];m2.Y [cm];m2.Z [cm]",
            {"separator": ";", "comma": True, "above": "Versuch 7\n1.2.2026\n"},
            "kPa",
            10.0,
        ),
        (
            "t valve1 valve2 base_x base_y base_z tip_x tip_y tip_z\nms psi psi mm mm mm mm mm mm",
            {"separator": " "},
            "psi",
            1.0,
        ),
    ],
    ids=["suffixes", "brackets", "a line of units"],
)
def test_a_draft_imports_its_file(tmp_path, header, layout, pressure, scale):
    found = imported(lab_file(tmp_path, header, **layout), tmp_path)
    assert found.unit == pressure
    np.testing.assert_allclose(found.t_s, 0.05 * np.arange(len(ROWS)), atol=1e-12)
    np.testing.assert_allclose(found.measured, [row[1:3] for row in ROWS])
    expected = scale * np.array([row[3:] for row in ROWS])
    np.testing.assert_allclose(found.key_points_mm.reshape(-1, 6), expected)


@pytest.mark.parametrize(
    ("above", "unit", "mm"),
    [
        ("Exported,2026-11-28,Length Units,Meters,Coordinate Space,Global\n\n", "m", 1000.0),
        ("Length Units: Centimeters\n", "cm", 10.0),
        ("Units,mm\n", "mm", 1.0),
    ],
)
def test_the_unit_of_length_above_a_header_is_drafted(tmp_path, above, unit, mm):
    """Motion capture states it once; the names of the columns then have none."""
    path = lab_file(tmp_path, "t_s,p1_kPa,p2_kPa,a X,a Y,a Z,b X,b Y,b Z", above=above)
    line = next(line for line in draft_map(path).splitlines() if "lines above the header" in line)
    assert line.startswith(f'unit = "{unit}"  #')
    expected = mm * np.array([row[3:] for row in ROWS])
    found = imported(path, tmp_path).key_points_mm.reshape(-1, 6)
    np.testing.assert_allclose(found, expected)


def test_what_a_header_does_not_say_is_marked(tmp_path):
    header = "take,pressure1,set1,x0,y0,z0,target_x,target_y,target_z"
    text = draft_map(lab_file(tmp_path, header))
    assert "rate_hz = 20.0  # check: no column of time" in text
    assert 'columns = ["pressure1"]\nunit = "kPa"  # check: the header names no unit' in text
    assert 'positions = [["x0", "y0", "z0"]]\nunit = "mm"  # check' in text
    assert '[runs]  # check: a new value begins a new run\ncolumn = "take"' in text
    assert '[measured]\ncolumns = ["pressure1"]' in text
    assert '[commanded]\ncolumns = ["set1"]' in text
    assert "# not used: target_x, target_y, target_z" in text


@pytest.mark.parametrize(
    ("names", "table"),
    [
        ("north_set_bar,west_set_bar", "[commanded]"),
        ("target_p1_kPa,target_p2_kPa", "[commanded]"),
        ("Soll 1,Soll 2", "[commanded]"),
        ("Pset_A [psi],Pset_B [psi]", "[commanded]"),
        ("p_ref_1,p_ref_2", "[commanded]"),
        ("north_bar,west_bar", "[measured]  # check: measured by sensors?"),
    ],
)
def test_set_values_are_no_measurements(tmp_path, names, table):
    path = lab_file(tmp_path, f"t_ms,{names},x_m,y_m,z_m,x_soll_m,y_soll_m,z_soll_m")
    text = draft_map(path)
    first, second = names.split(",")
    assert f"{table}" in text
    assert f'columns = ["{first}", "{second}"]' in text
    assert "# not used: x_soll_m, y_soll_m, z_soll_m" in text
    found = imported(path, tmp_path)
    assert (found.commanded is not None) == (table == "[commanded]")
    np.testing.assert_allclose(found.measured, [row[1:3] for row in ROWS])


def test_columns_of_one_name_are_drafted_by_their_numbers(tmp_path):
    path = lab_file(tmp_path, "time_ms,p_bar,p_bar,x_m,y_m,z_m,x_m,y_m,z_m")
    assert "columns = [2, 3]" in draft_map(path)
    found = imported(path, tmp_path)
    np.testing.assert_allclose(found.measured, [row[1:3] for row in ROWS])
    expected = 1000.0 * np.array([row[3:] for row in ROWS])
    np.testing.assert_allclose(found.key_points_mm.reshape(-1, 6), expected)


def test_a_decimal_comma_below_a_first_row_of_whole_numbers_is_drafted(tmp_path):
    path = tmp_path / "lab.csv"
    rows = ["t_s;p_bar;x_mm;y_mm;z_mm", "0;1;0;0;60", "0,05;1,5;0;0;61", "0,1;2;0;0;62"]
    path.write_text("\n".join(rows) + "\n")
    assert 'decimal = ","' in draft_map(path)
    np.testing.assert_allclose(imported(path, tmp_path).t_s, [0.0, 0.05, 0.1])


def test_arrays_of_a_matlab_file_are_drafted(tmp_path):
    """Struct fields: two tendons in mm, two markers of three columns each in cm, a repetition."""
    rows = np.array(ROWS, float)
    log = {
        "t_ms": rows[:, :1],
        "tendon_mm": rows[:, 1:3],
        "marker_cm": rows[:, 3:],
        "rep": rows[:, 0],
    }
    savemat(tmp_path / "lab.mat", {"log": log, "rate": 20.0})
    found = imported(tmp_path / "lab.mat", tmp_path)
    text = (tmp_path / "map.toml").read_text()
    assert found.unit == "mm"
    np.testing.assert_allclose(found.measured, rows[:, 1:3])
    np.testing.assert_allclose(found.key_points_mm.reshape(-1, 6), 10 * rows[:, 3:])
    assert len(found.runs) == len(ROWS)
    assert '[runs]  # check: a new value begins a new run\ncolumn = "log.rep"' in text


def test_of_equal_groups_the_draft_takes_the_first(tmp_path):
    h5py = pytest.importorskip("h5py")
    rows = np.array(ROWS, float)
    with h5py.File(tmp_path / "lab.h5", "w") as file:
        for k in (1, 2):
            group = file.create_group(f"take{k}")
            group["time_ms"], group["valve_bar"] = 50.0 * np.arange(len(rows)), k * rows[:, 1:3]
            group["tip_m"] = rows[:, 3:6]
    found = imported(tmp_path / "lab.h5", tmp_path)
    assert (
        'topic = "take1"  # check: as many arrays are in take2'
        in (tmp_path / "map.toml").read_text()
    )
    assert found.unit == "bar"
    np.testing.assert_allclose(found.measured, rows[:, 1:3])
    np.testing.assert_allclose(found.key_points_mm[:, 0], 1000 * rows[:, 3:6])


def two_logs(folder, air="lab_air.csv", camera="lab_cam.csv"):
    """An air log of 100 Hz whose pressures grow by 10 and 20 a second, and a camera of 20 Hz; the
    clock shows 7 s at the start."""
    rows = [f"{7 + k / 100:.2f},{k / 10:g},{k / 5:g},{k / 10:g},{k / 5:g}" for k in range(101)]
    header = "stamp,setA,setB,regA,regB"
    (folder / air).write_text("\n".join([header, *rows]) + "\n")
    rows = [f"{k},{7 + k / 20:.2f},1,2,{50 + k}" for k in range(20)]
    (folder / camera).write_text("\n".join(["frame,clock,D0x,D0y,D0z", *rows]) + "\n")
    return [folder / air, folder / camera]


@pytest.mark.parametrize(
    ("names", "patterns"),
    [
        (("lab_air.csv", "lab_cam.csv"), ("*_air.csv", "*_cam.csv")),
        (("air-03.csv", "cam-03.csv"), ("air-*.csv", "cam-*.csv")),
        (("valves.csv", "camera.csv"), ("valves.csv", "camera.csv")),
        (("a_cam.csv", "a_cam_cam.csv"), ("a_cam.csv", "a_cam_cam.csv")),
    ],
)
def test_files_of_one_recording_are_drafted_together(tmp_path, names, patterns):
    """The camera's rows are the samples, wherever it stands; at 0.05 s the pressures are 0.5, 1."""
    files = two_logs(tmp_path, *names)
    drafted = draft_of_map(files)
    assert drafted.lacks == ()
    (tmp_path / "map.toml").write_text(drafted.text)
    spec = load_map(str(tmp_path / "map.toml"))
    assert tuple(role.match for role in spec.file.values()) == patterns[::-1]
    (part,) = import_files(files, spec, "lab")
    steps = np.arange(20)
    np.testing.assert_allclose(part.recording.t_s, 0.05 * steps, atol=1e-9)
    expected = np.column_stack([0.5 * steps, 1.0 * steps])
    np.testing.assert_allclose(part.recording.measured, expected, atol=1e-9)
    np.testing.assert_allclose(part.recording.commanded, expected, atol=1e-9)
    np.testing.assert_allclose(part.recording.key_points_mm[:, 0, 2], 50 + steps)


def test_files_without_time_are_joined_by_rows_and_marked(tmp_path):
    files = two_logs(tmp_path)
    files[0].write_text("setA,setB,pA,pB\n" + "\n".join(["1,2,3,4"] * 20) + "\n")
    text = draft_map(files)
    assert 'join = "rows"  # check: no column of time is recognised' in text
    assert '[measured]\nfile = "air"\ncolumns = ["pA", "pB"]' in text


@pytest.mark.parametrize(
    ("header", "measured"),
    [
        ("set1,set2,reg1,reg2", '"reg1", "reg2"'),
        ("A_set,B_set,A_is,B_is", '"A_is", "B_is"'),
        ("set1,set2,reg1,flow2", '"set1", "set2"'),
        ("set1,set2,reg1,reg2,flow1,flow2", '"set1", "set2"'),
    ],
)
def test_columns_called_as_the_command_are_taken_for_its_measured_values(
    tmp_path, header, measured
):
    """Only where all channels have such a column, and no second text fits as well."""
    path = tmp_path / "lab.csv"
    count = header.count(",") + 4
    path.write_text(f"{header},x,y,z\n" + ",".join("1" * count) + "\n")
    text = draft_map(path)
    assert f"columns = [{measured}]" in text.split("[measured]")[1].split("[commanded]")[0]
    assert ("the names are like the command's" in text) == ("set1" not in measured)


def test_a_draft_of_one_of_two_files_says_what_it_lacks(tmp_path, monkeypatch, capsys):
    """The line that comes next is not one that cannot succeed."""
    two_logs(tmp_path)
    monkeypatch.chdir(tmp_path)
    for raw, table in (("lab_air.csv", "key_points"), ("lab_cam.csv", "measured")):
        assert run(["import", raw, "--draft", "map.toml", "--force"]) == 0
        _, lacks, then = capsys.readouterr().out.splitlines()
        assert lacks.startswith(f"lacks [{table}]: no columns of ")
        assert f"surgisoft import {raw} OTHER --draft map.toml --force" in lacks
        assert then.startswith(f"then: surgisoft import {raw} --map map.toml")
        text = (tmp_path / "map.toml").read_text()
        assert f"# [{table}]  # check: no columns" in text
        assert "# import needs this table" in text
    command = "import lab_air.csv lab_cam.csv --draft map.toml --force"
    assert run(command.split()) == 0
    following = capsys.readouterr().out.splitlines()[1].removeprefix("next: surgisoft ")
    assert run(following.split()) == 0
    assert "would write REC.parquet: continuous, 20 rows, 1 run, 2 channels" in (
        capsys.readouterr().out
    )
    assert run(["import", "lab_air.csv", "lab_cam.csv", "-o", "rec.csv"]) == 2
    assert "'surgisoft import lab_air.csv lab_cam.csv --draft" in capsys.readouterr().err


def test_files_of_one_kind_or_one_name_are_not_drafted_together(tmp_path):
    files = two_logs(tmp_path)
    other = tmp_path / "other_cam.csv"
    other.write_bytes(files[1].read_bytes())
    with pytest.raises(InputError, match=r"the same columns, expected one file of each kind"):
        draft_map([*files, other])
    (tmp_path / "b").mkdir()
    two_logs(tmp_path / "b", air="lab_cam.csv", camera="c.csv")
    with pytest.raises(InputError, match=r"files of one name, .*; rename one of them"):
        draft_map([files[1], tmp_path / "b" / "lab_cam.csv"])


def test_a_draft_of_a_file_without_header_says_what_the_map_needs(tmp_path):
    """Together with a log that has names, the draft counts its columns."""
    air, camera = two_logs(tmp_path)
    camera.write_text(camera.read_text().partition("\n")[2])
    with pytest.raises(
        InputError, match=r"among unnamed columns, .* header = false in \[file\.NAME"
    ):
        draft_map(camera)
    drafted = draft_of_map([camera, air])
    assert drafted.lacks == ("key_points",)
    assert 'match = "*_cam.csv"\nheader = false' in drafted.text
    assert "# positions = [[1, 2, 3], ...]" in drafted.text


def test_a_list_of_columns_says_how_many_it_leaves_out(tmp_path):
    path = tmp_path / "a.csv"
    names = [f"n{k}" for k in range(13)]
    path.write_text(",".join(names) + "\n" + ",".join("1" * 13) + "\n")
    with pytest.raises(InputError, match=r"among n0, .*, n11 and 1 more, and none of an actuation"):
        draft_map(path)


def test_no_key_points_and_no_numbers_are_errors(tmp_path):
    with pytest.raises(InputError, match=r"no columns x, y, z .* among a, b, c"):
        draft_map(lab_file(tmp_path, "a,b,c,d,e,f,g,h,i"))
    (tmp_path / "notes.txt").write_text("no numbers here\nnor here\n")
    with pytest.raises(InputError, match="no rows of numbers"):
        draft_map(tmp_path / "notes.txt")


def test_the_command_writes_it_and_names_the_next_one(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    lab_file(tmp_path, "time_ms,pA_bar,pB_bar,x0_m,y0_m,z0_m,x1_m,y1_m,z1_m")

    def said(line, code):
        assert run(line.split()) == code
        out, err = capsys.readouterr()
        return out or err

    draft = "import lab.csv --draft map.toml"
    assert f"'surgisoft {draft}' writes one" in said("import lab.csv -o rec.csv", 2)
    after = "import lab.csv --map map.toml -o REC.parquet --dry-run"
    assert f"next: surgisoft {after}" in said(draft, 0)
    assert "would write REC.parquet" in said(after, 0)
    assert "exists already" in said(draft, 2)
    assert "-o is missing" in said("import lab.csv", 2)
