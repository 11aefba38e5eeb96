"""Bad maps and raw files that do not fit them: one line each, with its place."""

import gzip
import re

import pytest

from surgisoft.errors import InputError
from surgisoft.measurement import tables
from surgisoft.measurement.importing import import_files, load_map
from surgisoft.measurement.importing.draft import draft_map
from surgisoft.measurement.tables import read_text
from tests.measurement.test_importing import BASE

GOOD = """\
[file.log]
header = true
[time]
column = "t"
[measured]
columns = ["u"]
unit = "kPa"
[key_points]
positions = [["x", "y", "z"]]
unit = "mm"
"""

MAPS = [
    ("[time]", "[times]", "times: unknown field (did you mean 'time'?); expected one of file"),
    ("[measured]", "[mesured]", "mesured: unknown field (did you mean 'measured'?)"),
    ('[time]\ncolumn = "t"', "", "time: missing; expected a table [time]"),
    ('column = "t"', "", "time: neither column nor rate_hz; expected a column, a rate, or both"),
    ('column = "t"', "column = 0", "time.column: got integer 0; expected a column's name or its"),
    ('column = "t"', "column = true", "time.column: got boolean true; expected a column's name"),
    ('column = "t"', "rate_hz = -5", "time.rate_hz: got integer -5; expected a number > 0"),
    (
        'column = "t"',
        'column = "t"\nrate_hz = 5\nscale = 2',
        "time.scale: got 2; expected none beside rate_hz or dates",
    ),
    (
        'column = "t"',
        'column = "t"\nunit = "iso"\nscale = 2',
        "time.scale: got 2; expected none beside rate_hz or dates",
    ),
    (
        'column = "t"',
        'column = "t"\nrate_hz = 5\nunit = "ms"',
        "time.unit: got text 'ms'; expected none beside rate_hz, which states seconds already",
    ),
    (
        'column = "t"',
        'column = "t"\nunit = "days"',
        "time.unit: got text 'days'; expected one of s",
    ),
    ('column = "t"', 'colum = "t"', "time.colum: unknown field (did you mean 'column'?)"),
    ("header = true", "heade = true", "file.log.heade: unknown field (did you mean 'header'?)"),
    ("header = true", "header = 1", "file.log.header: got integer 1; expected true or false"),
    ("header = true", 'separator = "--"', "file.log.separator: got text '--'; expected one char"),
    ("header = true", "skip_rows = -1", "skip_rows: got integer -1; expected an integer >= 0"),
    ("header = true", "offset_rows = 1", "file.log: the first file is the main one; expected"),
    ("header = true", 'format = "excel"', "file.log.format: got text 'excel'; expected one of"),
    ('columns = ["u"]', "columns = []", "measured.columns: got a list []; expected a list of col"),
    ('unit = "kPa"', "", "measured.unit: missing; expected the columns' unit such as"),
    ('unit = "kPa"', 'unit = "N/m"', "measured.unit: got text 'N/m'; expected letters and digits"),
    ('unit = "kPa"', 'unit = "kPa"\nto = "deg"', "measured.to: got 'deg'; expected one of Pa, hPa"),
    ('unit = "kPa"', 'unit = "counts"\nto = "V"', "use scale and offset"),
    ('unit = "kPa"', 'unit = "kPa"\nscale = [1, 2]', "measured.scale: got a list [1.0, 2.0]; exp"),
    (
        'unit = "kPa"',
        'unit = "kPa"\nfile = "lok"',
        "measured.file: got text 'lok'; expected one of",
    ),
    (
        '[["x", "y", "z"]]',
        '[["x", "y"]]',
        "key_points.positions[0]: got a list ['x', 'y']; expected three columns",
    ),
    ("positions", 'auto = "planes"\npositions', "got positions and auto; expected exactly one of"),
    ('positions = [["x", "y", "z"]]', "", "key_points: got nothing; expected exactly one of"),
    (
        'positions = [["x", "y", "z"]]',
        'markers = [["a", "b"]]',
        "key_points.markers[0]: got a list",
    ),
    ('unit = "mm"', "", "key_points.unit: missing; expected the positions' unit, one of mm, cm, m"),
    ('unit = "mm"', 'unit = "ft"', "key_points.unit: got text 'ft'; expected one of mm, cm, m"),
    ('unit = "mm"', 'unit = "mm"\npattern = "["', "a regular expression with one group"),
    (
        'unit = "mm"',
        'unit = "mm"\n[frame]\nrotation = "x y"',
        "frame.rotation: got text 'x y'; exp",
    ),
    (
        'unit = "mm"',
        'unit = "mm"\n[frame]\ngravity = [0, 0, 9.81]',
        "three numbers, a unit v",
    ),
    ('unit = "mm"', 'unit = "mm"\n[frame]\norigin = [1, 2]', 'three numbers or "k0"'),
    (
        'unit = "mm"',
        'unit = "mm"\n[frame.base]\nposition = "B"',
        "quaternion: missing; expected",
    ),
    ('unit = "mm"', 'unit = "mm"\n[rows]\nfirst = 5\nlast = 4', "expected an integer >= 5"),
    ('unit = "mm"', 'unit = "mm"\n[context]\npayload_g = "heavy"', "payload_g: got text 'heavy'"),
    (
        'unit = "mm"',
        'unit = "mm"\n[context]\npayload = 3',
        "unknown field (did you mean 'payload_g'",
    ),
    (
        'unit = "mm"',
        'unit = "mm"\n[arm]\nlength = 3',
        "arm.length: unknown field (did you mean",
    ),
    ('unit = "mm"', 'unit = "mm"\n[recording]\nkind = "live"', "kind: got text 'live'; expected o"),
    ('unit = "mm"', 'unit = "mm"\n[extra]\na = 1', "extra: unknown field; expected one of file"),
    ('unit = "mm"', "unit = 'mm", "not valid TOML"),
    ('unit = "mm"', 'unit = "mm"\norder = [1]', "order: got a list [1]; expected each of the num"),
    ('unit = "mm"', 'unit = "mm"\nlost = [-1]', "lost: got a list [-1]; expected numbers >= 0"),
    (
        'positions = [["x", "y", "z"]]',
        'point = [{position = ["x", "y", "z"], offset = [0, 0, 5]}]',
        "quaternion: missing; expected the body's orientation, since there is an offset",
    ),
    (
        'columns = ["u"]',
        'columns = ["u", "v", "w"]\nscale = [1, 2]',
        "measured.scale: got a list [1.0, 2.0]; expected one number, or 3, one per channel",
    ),
    (
        'unit = "mm"',
        'unit = "mm"\n[context]\npayload_g = {column = "u", from_name = "(x)"}',
        "payload_g: got a table; expected a number, {column = ...} or {from_name = ...}",
    ),
    (
        'unit = "mm"',
        'unit = "mm"\n[commanded]\nrepeated = "interpolate"',
        "commanded.repeated: got text 'interpolate'; expected \"keep\": a command is held",
    ),
    ('unit = "kPa"', 'unit = "kPa"\noptional = true', "optional: got true; expected none beside"),
    (
        'columns = ["u"]\nunit = "kPa"',
        "optional = true",
        "optional: got true; expected none: every",
    ),
]

RAW = "t,u,x,y,z\n0,1,2,3,4\n1,2,3,4,5\n"

FILES = [
    (RAW.replace("u", "U", 1), "", "no column 'u', expected one of t, U, x, y, z"),
    (
        RAW.replace("z", "zz", 1),
        "",
        "no column 'z', expected one of t, u, x, y, zz; did you mean 'zz'",
    ),
    (
        RAW.replace("y", "x", 1),
        "",
        "2 columns are called 'x', expected one; give the column's numb",
    ),
    (RAW, "header = false", "no column 'u', the file has no header; expected a column's number"),
    (
        RAW.replace("2,3,4,5", "2,3,far,5"),
        "",
        "line 3, column 'y': got 'far', expected a number",
    ),
    (RAW.replace("2,3,4,5", "2,3,inf,5"), "", "line 3, column 'y': got inf, expected a finite"),
    (RAW.replace("1,2,3,4,5", "1,2,3,4"), "", "line 3: 4 cells, expected 5"),
    (RAW.replace("1,2,3,4,5", ",2,3,4,5"), "", "line 3, column 't': no time, expected a number in"),
    (RAW.replace("1,2,3,4,5", "0,2,3,4,5"), "", "line 3: time 0.0 s after 0.0 s, expected"),
    ("t,u,x,y,z\n0,,2,3,4\n1,,3,4,5\n", "", "line 2: the actuation is missing in every row"),
    ("t,u,x,y,z\n0,1,,3,4\n1,2,,4,5\n", "", "every key point is missing in every row"),
    ("t,u,x,y,z\n", "", "no rows of numbers"),
    ("", "", "the file is empty"),
    (
        RAW.replace(",", ";"),
        "",
        "one column only when separated by ','; set separator = \";\" in [file.NAME] of the map",
    ),
    ("t u x\n0 1 2\n", "", "one column only when separated by ','; check the separator in the map"),
    (
        "t;u;x;y;z\n0,0;1,5;2;3;4\n1,0;2,5;3;4;5\n",
        "",
        "no column 'u', the map's separator gives 1 column; set separator = \";\" and decimal = "
        '"," in [file.NAME] of the map, as --draft writes it',
    ),
    (
        "t;u;x;y;z\n0,0;1,5;2;3;4\n1,0;2,5;3;4;5\n",
        'separator = "\\t"\ndecimal = ","',
        "one column only when separated by '\\t'; set separator = \";\" in [file.NAME] of the map",
    ),
    (
        "t;u;x;y;z\n0,0;1,5;2;3;4\n1,0;1.234;3;4;5\n",
        'separator = ";"\ndecimal = ","',
        "line 3, column 'u': got '1.234', expected a number with a decimal comma and without thous",
    ),
    (
        "t;u;x;y;z\n0,0;1.234,5;2;3;4\n1,0;1,5;3;4;5\n",
        'separator = ";"\ndecimal = ","',
        "line 2, column 'u': got '1.234,5', expected a number with a decimal comma and without th",
    ),
    (
        "0,41.2040,112.050,-84.8,run\n1,2,3,4,run\n2,3,4,5,run\n",
        "",
        "no column 'u', the line of names holds numbers (0, 41.2040, 112.050, ...); if the file "
        "has no header, set header = false in [file.NAME] of the map and give columns by their "
        "numbers, counted from 1",
    ),
    ("t,1,2,3,4\n1,2,3,4,5\n", "", "the line of names holds numbers (t, 1, 2, ...); if the file"),
    ("t,a,b,3,4\n1,2,3,4,5\n", "", "no column 'u', expected one of t, a, b, 3, 4"),
    (RAW, "skip_rows = 9", "fewer than the 9 lines that the map skips"),
    ("\0\1\2" + RAW, "", "not a text file"),
]


def message_of(action):
    with pytest.raises(InputError) as error:
        action()
    assert "\n" not in str(error.value)
    return str(error.value)


@pytest.mark.parametrize(("old", "new", "expected"), MAPS)
def test_bad_map(tmp_path, old, new, expected):
    assert old in GOOD
    path = tmp_path / "map.toml"
    path.write_text(GOOD.replace(old, new, 1))
    message = message_of(lambda: load_map(str(path)))
    assert message.startswith(str(path))
    assert expected in message


def test_map_error_names_its_line(tmp_path):
    path = tmp_path / "map.toml"
    path.write_text(GOOD.replace('unit = "mm"', 'unit = "ft"'))
    assert re.match(
        rf"{re.escape(str(path))}:10: key_points.unit", message_of(lambda: load_map(str(path)))
    )


def test_unknown_map_names_the_ready_ones(tmp_path):
    message = message_of(lambda: load_map("optitrack"))
    assert "optitrack: no such map, expected a TOML file or one of the ready maps motive" in message


@pytest.mark.parametrize(("content", "field", "expected"), FILES)
def test_bad_raw_file(tmp_path, content, field, expected):
    path, map_path = tmp_path / "raw.csv", tmp_path / "map.toml"
    path.write_text(content)
    map_path.write_text(GOOD.replace("header = true", field or "header = true"))
    spec = load_map(str(map_path))
    message = message_of(lambda: import_files([path], spec, "x"))
    assert message.startswith(str(path))
    assert expected in message


def test_damaged_archive(tmp_path):
    path, map_path = tmp_path / "raw.csv.gz", tmp_path / "map.toml"
    path.write_bytes(b"\x1f\x8b\x08\0" + b"rubbish" * 9)
    map_path.write_text(GOOD)
    message = message_of(lambda: import_files([path], load_map(str(map_path)), "x"))
    assert str(path) in message


def causes(error):
    """The error and what it came from, as a traceback follows them, each once."""
    chain = []
    while error is not None and error not in chain:
        chain.append(error)
        error = error.__cause__ or error.__context__
    return chain, error


@pytest.mark.parametrize("name", ["raw.csv.gz", "raw.txt", "raw.trc"])
def test_no_error_of_a_text_file_is_its_own_cause(tmp_path, name):
    """Found by the fuzzer, which follows the causes of an error to their end."""
    path, map_path = tmp_path / name, tmp_path / "map.toml"
    path.write_bytes(gzip.compress(RAW.encode())[:-4] if name.endswith("gz") else b"no, numbers")
    map_path.write_text(GOOD)
    spec = load_map(str(map_path))
    for read in (lambda: import_files([path], spec, "x"), lambda: draft_map(path)):
        with pytest.raises(InputError) as told:
            read()
        chain, left = causes(told.value)
        assert left is None, f"{chain[-1]} comes from itself"


def test_number_beyond_the_last_column(tmp_path):
    path, map_path = tmp_path / "raw.csv", tmp_path / "map.toml"
    path.write_text(RAW)
    map_path.write_text(GOOD.replace('["u"]', "[6]"))
    spec = load_map(str(map_path))
    message = message_of(lambda: import_files([path], spec, "x"))
    assert message == f"{path}: no column 6, expected at most 5"


def test_command_and_measurement_must_fit(tmp_path):
    path, map_path = tmp_path / "raw.csv", tmp_path / "map.toml"
    path.write_text(RAW)
    for extra, expected in (
        ('columns = ["u", "x"]\nunit = "kPa"', "2 commanded columns, expected 1 as in [measured]"),
        ('columns = ["u"]\nunit = "psi"', "command in psi but measured in kPa, expected one unit"),
    ):
        map_path.write_text(f"{GOOD}[commanded]\n{extra}\n")
        spec = load_map(str(map_path))
        assert expected in message_of(lambda spec=spec: import_files([path], spec, "x"))


def test_a_map_of_commands_needs_their_columns(tmp_path):
    path, map_path = tmp_path / "raw.csv", tmp_path / "map.toml"
    path.write_text(RAW)
    map_path.write_text(f'{GOOD}[commanded]\nto = "psi"\n')
    spec = load_map(str(map_path))
    assert message_of(lambda: import_files([path], spec, "x")) == (
        f"{path}: no column 'c1_kPa' or with another unit, expected the commanded actuation; name "
        "its columns in [commanded] of the map, or leave the table out"
    )
    map_path.write_text(f"{GOOD}[commanded]\noptional = true\n")
    (part,) = import_files([path], load_map(str(map_path)), "x")
    assert part.recording.commanded is None
    path.write_text("t,u,x,y,z,c1_kPa\n0,1,2,3,4,7\n1,2,3,4,5,8\n")
    (part,) = import_files([path], load_map(str(map_path)), "x")
    assert part.recording.commanded.tolist() == [[7.0], [8.0]]


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ("scale = [1, 2, 3]", "[measured] scale of the map is [1.0, 2.0, 3.0], expected one num"),
        ("offset = [1, 2, 3]", "[measured] offset of the map is [1.0, 2.0, 3.0], expected one num"),
        (
            'unit = "bar"',
            'columns p1_kPa ... p2_kPa state kPa, but the map unit = "bar" in [measured]',
        ),
    ],
)
def test_what_a_map_says_of_columns_that_it_leaves_to_their_names(tmp_path, fields, expected):
    path, map_path = tmp_path / "raw.csv", tmp_path / "map.toml"
    path.write_text("t,p1_kPa,p2_kPa,x,y,z\n0,1,2,3,4,5\n1,2,3,4,5,6\n")
    map_path.write_text(GOOD.replace('columns = ["u"]\nunit = "kPa"', fields))
    spec = load_map(str(map_path))
    message = message_of(lambda: import_files([path], spec, "x"))
    assert message.startswith(str(path))
    assert expected in message


def test_a_compressed_file_cannot_unpack_without_bound(tmp_path, monkeypatch):
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(b"t,u\n" + b"0,0\n" * 10**6))
    assert len(read_text(tmp_path / "a.csv.gz")) == 4 + 4 * 10**6
    monkeypatch.setattr(tables, "MOST_UNPACKED", 1 << 20)
    with pytest.raises(InputError, match="more than 1 MiB when it is unpacked"):
        read_text(tmp_path / "a.csv.gz")


def test_a_number_that_no_measurement_has(tmp_path):
    text = "t,u1,u2,x,y,z\n0,1,2,3,4,5\n1,1,2,3,4,-1e101\n"
    (tmp_path / "a.csv").write_text(text)
    (tmp_path / "map.toml").write_text(BASE)
    said = r"line 3, column 'z': got -1e\+101, expected a finite number of a size below 1e\+100"
    with pytest.raises(InputError, match=said):
        import_files([tmp_path / "a.csv"], load_map(str(tmp_path / "map.toml")), "x")
