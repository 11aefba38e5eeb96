"""Columns of a map: each once, and in the unit that its name states."""

import numpy as np
import pytest

from surgisoft.errors import InputError
from surgisoft.measurement.importing.convert import import_files
from surgisoft.measurement.importing.spec import load_map

HEADER = ["time [s]", "P1 [kPa]", "P2 [kPa]", "set1 [bar]", "m0 x [mm]", "m0 y [mm]", "m0 z [mm]"]
HEADER += ["m1 x [mm]", "m1 y [mm]", "m1 z [mm]"]
MAP = """
[time]
column = "time [s]"
[measured]
columns = ["P1 [kPa]", "P2 [kPa]"]
unit = "kPa"
[key_points]
positions = [["m0 x [mm]", "m0 y [mm]", "m0 z [mm]"], ["m1 x [mm]", "m1 y [mm]", "m1 z [mm]"]]
unit = "mm"
"""


def notes(tmp_path, content, header=HEADER) -> list[str]:
    """Notes about names in an import of twenty rows."""
    (tmp_path / "map.toml").write_text(content)
    rng = np.random.default_rng(0)
    rows = [[k / 20, *rng.normal(size=len(header) - 1)] for k in range(20)]
    lines = [",".join(header), *(",".join(map(str, row)) for row in rows)]
    (tmp_path / "lab.csv").write_text("\n".join(lines) + "\n")
    found = import_files([tmp_path / "lab.csv"], load_map(str(tmp_path / "map.toml")), "x")[0].notes
    return [note for note in found if "name of column" in note]


def test_names_that_agree_with_the_map_have_no_note(tmp_path):
    assert notes(tmp_path, MAP) == []


WRONG = [
    (
        '["P1 [kPa]", "P2 [kPa]"]',
        '["m0 x [mm]", "P2 [kPa]"]',
        "column 'm0 x [mm]' states mm, expected a column in kPa as unit = \"kPa\" in [measured]",
    ),
    (
        '["P1 [kPa]", "P2 [kPa]"]',
        '["P1 [kPa]", "P1 [kPa]"]',
        "column 'P1 [kPa]' is used twice, in [measured] of the map, expected another column for",
    ),
    (
        '["P1 [kPa]", "P2 [kPa]"]',
        '["P1 [kPa]", 2]',
        "column 'P1 [kPa]' is used twice, in [measured] of the map",
    ),
    (
        'unit = "kPa"',
        'unit = "raw"\n[commanded]\ncolumns = ["time [s]", "P2 [kPa]"]\nunit = "raw"',
        "column 'time [s]' is used twice, in [commanded] and [time] of the map",
    ),
    ('"m1 x [mm]"', '"m0 y [mm]"', "column 'm0 y [mm]' is used twice, in [key_points] of the map"),
    (
        '"m1 x [mm]", "m1 y [mm]", "m1 z [mm]"',
        '"m0 x [mm]", "m0 y [mm]", "m0 z [mm]"',
        "key points 0 and 1 of the map have the same three columns, expected others for each",
    ),
    ('column = "time [s]"', 'column = "P1 [kPa]"', "column 'P1 [kPa]' states kPa, expected a col"),
]


@pytest.mark.parametrize(("old", "new", "message"), WRONG)
def test_a_column_that_cannot_be_meant_is_an_error(tmp_path, old, new, message):
    assert MAP.count(old) == 1
    with pytest.raises(InputError) as caught:
        notes(tmp_path, MAP.replace(old, new))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_another_unit_of_the_same_quantity_is_a_note(tmp_path):
    header = [name.replace("[kPa]", "(psi)").replace("[s]", "[ms]") for name in HEADER]
    content = MAP.replace("[kPa]", "(psi)").replace("[s]", "[ms]")
    found = notes(tmp_path, content, header)
    assert (
        "the name of column 'P1 (psi)' and 1 more states psi, but the map unit = \"kPa\" in "
        '[measured]: if the name is right, set unit = "psi"' in found
    )
    assert any("'time [ms]' states ms, but the map unit = \"s\" in [time]" in x for x in found)


def test_values_that_the_map_scales_may_have_another_unit(tmp_path):
    assert notes(tmp_path, MAP.replace('unit = "kPa"', 'unit = "V"\nscale = 0.02')) == []
    assert notes(tmp_path, MAP.replace('unit = "kPa"', 'unit = "norm"')) == []


def test_a_log_without_sensors_and_an_arm_in_a_plane_use_columns_twice(tmp_path):
    again = 'unit = "kPa"\n[commanded]\ncolumns = ["P1 [kPa]", "P2 [kPa]"]\nunit = "kPa"'
    assert notes(tmp_path, MAP.replace('unit = "kPa"', again)) == []
    assert notes(tmp_path, MAP.replace('"m1 y [mm]"', '"m0 y [mm]"')) == []


def test_scaled_columns_that_the_map_leaves_to_their_names_have_the_unit_of_the_map(tmp_path):
    (tmp_path / "lab.csv").write_text("t,p1_kPa,x,y,z\n0,100,0,0,50\n1,150,1,0,50\n")
    content = """
[time]
column = "t"
[measured]
unit = "bar"
scale = 0.01
[key_points]
positions = [["x", "y", "z"]]
unit = "mm"
"""
    (tmp_path / "map.toml").write_text(content)
    spec = load_map(str(tmp_path / "map.toml"))
    found = import_files([tmp_path / "lab.csv"], spec, "x")[0].recording
    assert found.unit == "bar"
    np.testing.assert_allclose(found.measured[:, 0], [1.0, 1.5])
