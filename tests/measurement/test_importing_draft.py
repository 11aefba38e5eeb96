"""Drafts of maps from headers: each is used to import the file that it was made from."""

import numpy as np
import pytest
from scipy.io import savemat

from surgisoft.cli import run
from surgisoft.errors import InputError
from surgisoft.measurement.importing import draft_map, import_files, load_map

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
