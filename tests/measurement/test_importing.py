"""Importing column-wise files of every kind: what comes out is what was put in."""

import bz2
import gzip
import lzma

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surgisoft.errors import InputError
from surgisoft.measurement.importing import import_files, load_map

NAMES = ["t", "u1", "u2", "x", "y", "z"]
BASE = """
[time]
column = "t"
[measured]
columns = ["u1", "u2"]
unit = "psi"
[key_points]
positions = [["x", "y", "z"]]
unit = "mm"
"""


def table(rows=40, seed=0):
    rng = np.random.default_rng(seed)
    values = rng.normal(size=(rows, 6)) * [1, 10, 10, 30, 30, 30]
    values[:, 0] = np.cumsum(rng.uniform(0.01, 0.1, rows))
    return values


def text(values, separator=",", header=NAMES, end="\n", decimal=".", before=()):
    lines = [*before, separator.join(header)] if header else [*before]
    lines += [
        separator.join("" if np.isnan(v) else repr(v).replace(".", decimal) for v in row)
        for row in values.tolist()
    ]
    return end.join(lines) + end


def spec(tmp_path, content):
    path = tmp_path / "map.toml"
    path.write_text(content)
    return load_map(str(path))


def imported(tmp_path, files, content=BASE, name="x"):
    files = files if isinstance(files, list) else [files]
    parts = import_files(files, spec(tmp_path, content), name)
    assert len(parts) == 1
    return parts[0].recording, parts[0].notes


def written(path, content):
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def check_same(recording, values):
    np.testing.assert_array_equal(recording.t_s, values[:, 0] - values[0, 0])
    np.testing.assert_array_equal(recording.measured, values[:, 1:3])
    np.testing.assert_array_equal(recording.key_points_mm[:, 0], values[:, 3:])


FORMATS = {
    "comma": ("a.csv", lambda v: text(v), ""),
    "semicolon": ("a.csv", lambda v: text(v, ";"), 'separator = ";"'),
    "decimal comma": (
        "a.csv",
        lambda v: text(v, ";", decimal=","),
        'separator = ";"\ndecimal = ","',
    ),
    "tabs by name": ("a.tsv", lambda v: text(v, "\t"), ""),
    "white space": ("a.txt", lambda v: "  " + text(v, "   \t"), 'separator = "whitespace"'),
    "blank after comma": ("a.csv", lambda v: text(v, ",  "), ""),
    "CRLF": ("a.csv", lambda v: text(v, end="\r\n"), ""),
    "old Mac": ("a.csv", lambda v: text(v, end="\r"), ""),
    "byte order mark": ("a.csv", lambda v: "\ufeff" + text(v), ""),
    "gz": ("a.csv.gz", lambda v: gzip.compress(text(v).encode()), ""),
    "gz without its ending": ("a.csv", lambda v: gzip.compress(text(v).encode()), ""),
    "bz2": ("a.csv.bz2", lambda v: bz2.compress(text(v).encode()), ""),
    "xz": ("a.csv.xz", lambda v: lzma.compress(text(v).encode()), ""),
    "lines before": ("a.csv", lambda v: text(v, before=["made by", "a, b", ""]), "skip_rows = 3"),
    "comments": (
        "a.csv",
        lambda v: text(v, before=["% one, two"]).replace("\n", "\n% three\n", 5),
        'comment = "%"',
    ),
    "header behind a hash": ("a.csv", lambda v: "# " + text(v), ""),
    "comma at each end": ("a.csv", lambda v: text(v, end=",\n").replace("z,", "z", 1), ""),
    "quotes": ("a.csv", lambda v: text(v, header=[f'"{n}"' for n in NAMES]), ""),
}


@pytest.mark.parametrize("kind", FORMATS)
def test_every_spelling_gives_the_same_numbers(tmp_path, kind):
    name, write, fields = FORMATS[kind]
    values = table()
    path = written(tmp_path / name, write(values))
    check_same(imported(tmp_path, path, f"[file.log]\n{fields}\n{BASE}")[0], values)


@pytest.mark.parametrize("separator", [",", ";", "whitespace"])
@given(seed=st.integers(0, 2**32))
def test_without_header_by_number(tmp_path_factory, separator, seed):
    tmp_path = tmp_path_factory.mktemp("numbers")
    values = table(5, seed)
    between = {"whitespace": "  "}.get(separator, separator)
    path = written(tmp_path / "a.txt", text(values, between, header=None))
    content = f"""
        [file.log]
        header = false
        separator = "{separator}"
        [time]
        column = 1
        [measured]
        columns = [2, 3]
        unit = "psi"
        [key_points]
        positions = [[4, 5, 6]]
        unit = "mm"
    """
    check_same(imported(tmp_path, path, content)[0], values)


def test_parquet_by_name_and_number(tmp_path):
    values = table()
    path = tmp_path / "a.parquet"
    columns = {name: values[:, i] for i, name in enumerate(NAMES)}
    columns["u1"] = columns["u1"].astype(np.float32)
    pq.write_table(pa.table(columns), path)
    values[:, 1] = values[:, 1].astype(np.float32)
    check_same(imported(tmp_path, path)[0], values)
    check_same(imported(tmp_path, path, BASE.replace('"t"', "1").replace('"x"', "4"))[0], values)


def test_recording_itself_can_be_imported(tmp_path):
    """Columns named as in a recording need no list."""
    values = table()
    path = written(tmp_path / "a.csv", text(values, header=["t", "p1_V", "p2_V", "x", "y", "z"]))
    content = BASE.replace('columns = ["u1", "u2"]\nunit = "psi"', "")
    recording, _ = imported(tmp_path, path, content)
    check_same(recording, values)
    assert recording.unit == "V"


@pytest.mark.parametrize(("unit", "factor"), [("mm", 1.0), ("cm", 10.0), ("m", 1000.0)])
def test_positions_become_millimetres(tmp_path, unit, factor):
    values = table()
    path = written(tmp_path / "a.csv", text(values))
    recording, _ = imported(tmp_path, path, BASE.replace('"mm"', f'"{unit}"'))
    np.testing.assert_array_equal(recording.key_points_mm[:, 0], values[:, 3:] * factor)


def test_actuation_keeps_its_unit_unless_asked(tmp_path):
    values = table()
    path = written(tmp_path / "a.csv", text(values))
    assert imported(tmp_path, path)[0].unit == "psi"
    asked = BASE.replace('"psi"', '"psi"\nto = "kPa"')
    recording, _ = imported(tmp_path, path, asked)
    # 1 psi = 6.894757 kPa (NIST SP 811, 2008, B.8)
    np.testing.assert_allclose(recording.measured, values[:, 1:3] * 6.894757, rtol=1e-7)
    assert recording.unit == "kPa"
    scaled = BASE.replace('"psi"', '"V"\nscale = [2.0, 3.0]\noffset = 0.5')
    recording, _ = imported(tmp_path, path, scaled)
    np.testing.assert_array_equal(recording.measured, values[:, 1:3] * [2, 3] + 0.5)


@pytest.mark.parametrize(
    ("unit", "factor"), [("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("min", 60.0)]
)
def test_time_becomes_seconds_from_the_start(tmp_path, unit, factor):
    values = table()
    path = written(tmp_path / "a.csv", text(values))
    content = BASE.replace('column = "t"', f'column = "t"\nunit = "{unit}"')
    recording, _ = imported(tmp_path, path, content)
    np.testing.assert_allclose(recording.t_s, (values[:, 0] - values[0, 0]) * factor, rtol=1e-9)
    kept, _ = imported(tmp_path, path, content.replace("unit = ", 'zero = "none"\nunit = ', 1))
    np.testing.assert_array_equal(kept.t_s, values[:, 0] * factor)


def test_dates_become_seconds(tmp_path):
    rows = "2024-02-29T23:59:59.5,1,2,3,4,5\n2024-03-01 00:00:01.25Z,1,2,3,4,5\n"
    path = written(tmp_path / "a.csv", ",".join(NAMES) + "\n" + rows)
    content = BASE.replace('column = "t"', 'column = "t"\nunit = "iso"')
    np.testing.assert_allclose(imported(tmp_path, path, content)[0].t_s, [0, 1.75], atol=1e-6)
    written(path, path.read_text().replace("2024-03-01", "1st of March"))
    with pytest.raises(InputError, match=r"a\.csv, line 3, column 't': got '1st of March"):
        imported(tmp_path, path, content)
    for first in ("", "NaT"):
        written(path, ",".join(NAMES) + "\n" + rows.replace("2024-02-29T23:59:59.5", first))
        with pytest.raises(InputError, match=rf"line 2, column 't': got '{first}', expected a da"):
            imported(tmp_path, path, content)


def test_dates_with_an_offset_are_moments(tmp_path):
    """A quarter to one in Berlin is 1.5 s before a quarter to midnight in London."""
    rows = "2024-03-01T00:44:58.5+01:00,1,2,3,4,5\n2024-02-29T23:45Z,1,2,3,4,5\n"
    path = written(tmp_path / "a.csv", ",".join(NAMES) + "\n" + rows)
    content = BASE.replace('column = "t"', 'column = "t"\nunit = "iso"')
    np.testing.assert_allclose(imported(tmp_path, path, content)[0].t_s, [0, 1.5], atol=1e-6)


def test_times_are_scaled_whose_unit_has_no_name(tmp_path):
    values = table()
    path = written(tmp_path / "a.csv", text(values))
    recording, _ = imported(tmp_path, path, BASE.replace('column = "t"', 'column = "t"\nscale = 7'))
    np.testing.assert_allclose(recording.t_s, 7 * (values[:, 0] - values[0, 0]), atol=1e-12)


def test_nominal_rate_where_there_are_no_time_stamps(tmp_path):
    values = table(5)
    path = written(tmp_path / "a.csv", text(values))
    recording, _ = imported(tmp_path, path, BASE.replace('column = "t"', "rate_hz = 50"))
    np.testing.assert_allclose(recording.t_s, [0, 0.02, 0.04, 0.06, 0.08])


def test_counter_of_frames_shows_what_was_dropped(tmp_path):
    values = table(5)
    values[:, 0] = [100, 101, 104, 105, 106]
    path = written(tmp_path / "a.csv", text(values))
    recording, _ = imported(
        tmp_path, path, BASE.replace('column = "t"', 'column = "t"\nrate_hz = 50')
    )
    np.testing.assert_allclose(recording.t_s, [0, 0.02, 0.08, 0.1, 0.12])


def test_missing_cells_are_missing(tmp_path):
    values = table(4)
    values[1, 3:], values[2, 4] = np.nan, np.nan
    path = written(tmp_path / "a.csv", text(values).replace(repr(float(values[3, 5])), "lost"))
    content = f'[file.log]\nmissing = ["lost"]\n{BASE}'
    recording, _ = imported(tmp_path, path, content)
    lost = np.isnan(recording.key_points_mm[:, 0]).all(axis=1)
    np.testing.assert_array_equal(lost, [False, True, True, True])


def test_rows_without_actuation_are_left_out_with_a_note(tmp_path):
    values = table(4)
    values[2, 2] = np.nan
    path = written(tmp_path / "a.csv", text(values))
    recording, notes = imported(tmp_path, path)
    np.testing.assert_array_equal(recording.measured, values[[0, 1, 3], 1:3])
    assert notes[1:] == [f"{path}, line 4: actuation missing here, 1 such rows left out"]


def test_incomplete_last_line_is_left_out_with_a_note(tmp_path):
    values = table(6)
    path = written(tmp_path / "a.csv", text(values)[:-60])
    recording, notes = imported(tmp_path, path)
    check_same(recording, values[: recording.samples])
    assert recording.samples in (4, 5)
    assert "the last line was cut off" in notes[0]


def test_context_constant_from_a_column_or_from_the_name(tmp_path):
    values = table(3)
    path = written(tmp_path / "run_250g.csv", text(values))
    recording, _ = imported(tmp_path, path, BASE + "[context]\npayload_g = 20\n")
    np.testing.assert_array_equal(recording.payload_g, [20, 20, 20])
    assert recording.temp_C is None
    content = BASE + "[context]\npayload_g = { from_name = '_(\\d+)g' }\ntemp_C = {column = 'u2'}\n"
    recording, _ = imported(tmp_path, path, content)
    np.testing.assert_array_equal(recording.payload_g, [250] * 3)
    np.testing.assert_array_equal(recording.temp_C, values[:, 2])
    other = written(tmp_path / "plain.csv", text(values))
    with pytest.raises(InputError, match=r"plain\.csv: no number for payload_g in the file's name"):
        imported(tmp_path, other, content)
    content = content.replace("_(\\d+)g' }", "_(\\d+)g', otherwise = 0 }")
    assert imported(tmp_path, other, content)[0].payload_g[0] == 0
    assert imported(tmp_path, path, content)[0].payload_g[0] == 250


def test_sidecar_of_the_map_goes_into_the_recording(tmp_path):
    path = written(tmp_path / "a.csv", text(table()))
    recording, _ = imported(
        tmp_path,
        path,
        BASE + "[arm]\nlength_mm = 70\n[gravity]\ndirection = [0, 0, 1]\n"
        "[recording]\nkind = 'settled'\nnoise_mm = 0.1\nnote = 'n'\n",
    )
    assert recording.arm.length_mm == 70
    assert (recording.kind, recording.noise_mm, recording.note) == ("settled", 0.1, "n")
    np.testing.assert_array_equal(recording.gravity, [0, 0, 1])
