"""Every bad recording gets one line: the file, the place, what came, what was expected."""

import re
import time

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from surgisoft.errors import InputError
from surgisoft.measurement import parquet_pages
from surgisoft.measurement.recordings import load_recording, load_recordings

HEAD = "t_s,p1_kPa,k0_x_mm,k0_y_mm,k0_z_mm"
ROW = "0,1,2,3,4"

HEADERS = [
    ("p1_kPa,k0_x_mm,k0_y_mm,k0_z_mm", "no column 't_s', expected the time in seconds"),
    ("t_s,k0_x_mm,k0_y_mm,k0_z_mm", "no measured actuation, expected 'p1_kPa'"),
    ("t_s,c1_kPa,k0_x_mm,k0_y_mm,k0_z_mm", "no measured actuation, expected 'p1_kPa'"),
    ("t_s,p1_kPa", "no key point, expected 'k0_x_mm'"),
    (f"{HEAD},p1_kPa", "column 6: 'p1_kPa' is repeated, it is column 2 already"),
    ("t_s,p1_kPa,k0_x_mm,k0_y_mm", "key point k0 has only x and y, expected 'k0_z_mm' too"),
    ("t_s,p1_kPa,k0_y_mm", "key point k0 has only y, expected 'k0_x_mm' too"),
    (f"{HEAD},p2_psi", "column 'p2_psi': unit 'psi', expected 'kPa' as in 'p1_kPa'"),
    (f"{HEAD},p1_psi", "column 'p1_psi': repeats 'p1_kPa' in another unit"),
    (f"{HEAD},c1_psi", "column 'c1_psi': unit 'psi', expected 'kPa'"),
    (f"{HEAD},p2_kPa,p4_kpa,p3_kPa", "column 'p4_kpa': unit 'kpa', expected 'kPa'"),
    (f"{HEAD},k1_x_m,k1_y_m,k1_z_m", "column 'k1_x_m': unit 'm', expected 'mm'"),
    (f"{HEAD},k0_x_m", "column 'k0_x_m': repeats 'k0_x_mm' in another unit"),
    ("t_s,p1_kPa,k0_x_ft,k0_y_ft,k0_z_ft", "column 'k0_x_ft': unit 'ft', expected one of mm, cm"),
    (f"{HEAD},p3_kPa", "'p3_kPa' without 'p2_kPa', expected numbers from 1 without gaps"),
    ("t_s,p0_kPa,k0_x_mm,k0_y_mm,k0_z_mm", "column 'p0_kPa': not a column's name"),
    (f"{HEAD},p2_kPa,c2_kPa", "'c2_kPa' without 'c1_kPa'"),
    (f"{HEAD},p2_kPa,c1_kPa", "1 commanded and 2 measured channels"),
    (f"{HEAD},k2_x_mm,k2_y_mm,k2_z_mm", "key point k2 without k1, expected numbers from 0"),
    (f"{HEAD},P2_kPa", "column 'P2_kPa': not a column's name; expected an actuation"),
    (f"{HEAD},p2", "column 'p2': not a column's name; expected an actuation with its unit"),
    (f"{HEAD},k1_x", "column 'k1_x': not a column's name; expected a key point such as 'k0_x_mm'"),
    (f"{HEAD},temp", "column 'temp': not a column's name; expected one of t_s, run, temp_C"),
    (f"{HEAD},payload_kg", "column 'payload_kg': not a column's name; expected one of t_s"),
    ("time,p1_kPa,k0_x_mm,k0_y_mm,k0_z_mm", "column 'time': not a column's name"),
    ("t_s;p1_kPa;k0_x_mm;k0_y_mm;k0_z_mm", "separated by semicolons, expected commas"),
    ("t_s\tp1_kPa\tk0_x_mm\tk0_y_mm\tk0_z_mm", "separated by tabs, expected commas"),
    ("", "is blank, expected the names of the columns"),
]

ROWS = [
    ("0,1,2,3,4\n2,1,2,3,4\n\n1,1,2,3,4\n", "line 5, column 't_s': 1.0 s after 2.0 s, expected"),
    ("0,1,2,3,4\n0,1,2,3,4\n", "line 3, column 't_s': 0.0 s after 0.0 s"),
    ("0,1,2,3,4\n,1,2,3,4\n", "line 3, column 't_s': got a missing value, expected a finite"),
    ("0,1,2,3,4\n1,inf,2,3,4\n", "line 3, column 'p1_kPa': got inf, expected a finite number"),
    ("0,1,2,3,4\n1,1,2,-Inf,4\n", "line 3, column 'k0_y_mm': got -inf, expected a finite number"),
    ("0,1,2,3,4\n1,1,1e999,3,4\n", "line 3, column 'k0_x_mm': got inf"),
    ("0,1,2,3,4\n1,1,2,lost,4\n", "line 3, column 'k0_y_mm': got 'lost', expected a number"),
    ("0,1,2,3,4\n1,1_0,2,3,4\n", "line 3, column 'p1_kPa': got '1_0', expected a number"),
    ("0,1,2,3,4\n1,0x10,2,3,4\n", "line 3, column 'p1_kPa': got '0x10', expected a number"),
    ("0,1,2,3,4\n1,1,2,3\n", "line 3: 4 cells, expected 5 as in the header"),
    ('0,1,2,3,4\n1,"1,5",2,3,4\n', "line 3, column 'p1_kPa': got '1,5', expected a number"),
    ("# a comment\n0,1,2,3,4\n", "line 2: 1 cells, expected 5 as in the header"),
    ("0,,2,3,4\n1,,2,3,4\n", "line 2, column 'p1_kPa': the actuation is missing in every row"),
    ("0,1,,,\n1,1,,3,\n", "every key point is missing in every row"),
    ("", "the table is empty, expected at least one row of numbers"),
    ("\n\n", "the table is empty, expected at least one row of numbers"),
]

RUNS = [
    ("0,1,2,3,4,0\n1,1,2,3,4,0.5\n", "line 3, column 'run': got 0.5, expected an integer"),
    ("0,1,2,3,4,0\n1,1,2,3,4,\n", "line 3, column 'run': got a missing value"),
    ("0,1,2,3,4,0\n1,1,2,3,4,1\n2,1,2,3,4,0\n", "line 4, column 'run': run 0 appears again after"),
    ("0,1,2,3,4,0\n0,1,2,3,4,1\n0,1,2,3,4,1\n", "line 4, column 't_s': 0.0 s after 0.0 s"),
]

SIDECARS = [
    ("[arm]\nlenght_mm = 70", ":2: arm.lenght_mm: unknown field (did you mean 'length_mm'?)"),
    (
        "[robot]\nlength_mm = 70",
        ":1: robot: unknown field; expected one of arm, gravity, rec",
    ),
    ("arm = 70", ":1: arm: got integer 70; expected a table [arm]"),
    ("[arm]\nlength_mm = -70", ":2: arm.length_mm: got integer -70; expected a number > 0"),
    ("[arm]\nlength_mm = '70'", ":2: arm.length_mm: got text '70'; expected a number > 0"),
    (
        "[gravity]\ndirection = [0, 0, 9.81]",
        ":2: gravity.direction: got a list [0, 0, 9.81]; expected t",
    ),
    (
        "[gravity]\ndirection = [0, 1]",
        ":2: gravity.direction: got a list [0, 1]; expected three numb",
    ),
    (
        "[recording]\nkind = 'static'",
        ":2: recording.kind: got text 'static'; expected one of co",
    ),
    (
        "[recording]\nnoise_mm = nan",
        ":2: recording.noise_mm: got nan; expected a finite number",
    ),
    ("[recording]\nnote = 3", ":2: recording.note: got integer 3; expected text"),
    ("[recording\n", "not valid TOML"),
]


def error_of(path):
    with pytest.raises(InputError) as error:
        load_recordings([path], on_warning=lambda _: None)
    message = str(error.value)
    assert message.startswith(str(path.with_suffix("")))
    assert "\n" not in message
    return message


@pytest.mark.parametrize(("header", "expected"), HEADERS)
def test_bad_header(tmp_path, header, expected):
    path = tmp_path / "bad.csv"
    path.write_text(f"{header}\n{ROW}\n")
    message = error_of(path)
    assert message.startswith(f"{path}, line 1")
    assert expected in message


@pytest.mark.parametrize(("header", "expected"), HEADERS[:20])
def test_bad_names_in_parquet(tmp_path, header, expected):
    path = tmp_path / "bad.parquet"
    names = header.split(",")
    pq.write_table(pa.table([pa.array([1.0])] * len(names), names=names), path)
    message = error_of(path)
    assert expected in message


@pytest.mark.parametrize(("rows", "expected"), ROWS)
def test_bad_row(tmp_path, rows, expected):
    path = tmp_path / "bad.csv"
    path.write_text(f"{HEAD}\n{rows}")
    assert expected in error_of(path)


@pytest.mark.parametrize(("rows", "expected"), RUNS)
def test_bad_runs(tmp_path, rows, expected):
    path = tmp_path / "bad.csv"
    path.write_text(f"{HEAD},run\n{rows}")
    assert expected in error_of(path)


@pytest.mark.parametrize(("sidecar", "expected"), SIDECARS)
def test_bad_sidecar(tmp_path, sidecar, expected):
    path = tmp_path / "bad.csv"
    path.write_text(f"{HEAD}\n{ROW}\n")
    path.with_suffix(".toml").write_text(sidecar)
    message = error_of(path)
    assert message.startswith(str(path.with_suffix(".toml")))
    assert expected in message


def test_line_is_found_far_down_and_after_blank_lines(tmp_path):
    path = tmp_path / "bad.csv"
    lines = [HEAD, *(f"{i},1,2,3,4" for i in range(20_000))]
    lines[15_000] = ""
    lines[18_765] = "18764,1,2,x,4"
    path.write_text("\n".join(lines))
    assert "bad.csv, line 18766, column 'k0_y_mm': got 'x'" in error_of(path)
    lines[18_765] = "17000,1,2,3,4"
    path.write_text("\n".join(lines))
    assert "line 18766, column 't_s': 17000.0 s after 18763.0 s" in error_of(path)


def test_parquet_rows_are_counted_from_one(tmp_path):
    path = tmp_path / "bad.parquet"
    columns = {name: np.arange(5.0) for name in HEAD.split(",")}
    columns["t_s"][3] = 1.5
    pq.write_table(pa.table(columns), path)
    assert "bad.parquet, row 4, column 't_s': 1.5 s after 2.0 s" in error_of(path)


def test_parquet_column_of_texts(tmp_path):
    path = tmp_path / "bad.parquet"
    columns = {name: pa.array([1.0]) for name in HEAD.split(",")}
    columns["k0_y_mm"] = pa.array(["far"])
    pq.write_table(pa.table(columns), path)
    assert "bad.parquet, column 'k0_y_mm': holds string, expected numbers" in error_of(path)


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("bad.csv", b"", "the file is empty"),
        ("bad.csv", b"\x89PNG\r\n\x1a\n\0\0\0", "not a text file"),
        ("bad.csv", b"\xff\xfet\0_\0s\0", "not a text file"),
        ("bad.csv", b"\xe9t\xe9,p1\n", "not text in UTF-8"),
        ("bad.parquet", b"", "not a readable Parquet file"),
        ("bad.parquet", b"t_s,p1_kPa\n0,1\n", "not a readable Parquet file"),
        ("bad.parquet", b"PAR1" + b"x" * 100 + b"PAR1", "not a readable Parquet file"),
        ("bad.txt", b"t_s,p1_kPa\n", "suffix '.txt', expected .csv or .parquet"),
        ("bad.CSV", b"t_s,p1_kPa\n", "suffix '.CSV', expected .csv or .parquet"),
        ("bad", b"t_s,p1_kPa\n", "suffix '', expected .csv or .parquet"),
    ],
)
def test_what_is_no_table(tmp_path, name, content, expected):
    path = tmp_path / name
    path.write_bytes(content)
    assert expected in error_of(path)


def test_binary_rubbish_below_a_good_header(tmp_path):
    path = tmp_path / "bad.csv"
    path.write_bytes(f"{HEAD}\n{ROW}\n".encode() + bytes(range(128, 256)) + b",\x00,,,\n")
    assert "bad.csv, line 3" in error_of(path)


def test_what_is_no_file(tmp_path):
    assert "no such file" in error_of(tmp_path / "none.csv")
    assert "no .csv or .parquet in this folder" in error_of(tmp_path)
    (tmp_path / "config.json").write_text("{}")
    assert "is a model, expected recordings; the model comes before them" in error_of(tmp_path)
    with pytest.raises(InputError, match="is a folder, expected a file"):
        load_recording(tmp_path)
    with pytest.raises(InputError, match="no recording given"):
        load_recordings([])


def test_one_unusual_cell_far_down_is_read_with_its_neighbours(tmp_path):
    path = tmp_path / "long.csv"
    rows = np.column_stack([np.arange(60_000.0), np.zeros((60_000, 4))])
    lines = [",".join(f"{x:.6f}" for x in row) for row in rows]
    lines[50_000] = lines[50_000].replace(",0.000000", ", 7. ", 1)
    path.write_text("\n".join([HEAD, *lines]))
    assert path.stat().st_size > 2**21
    measured = load_recording(path, lambda _: None).measured[:, 0]
    assert np.flatnonzero(measured).tolist() == [50_000]
    assert measured[50_000] == 7.0
    lines[59_000] = "59000,1,2,3"
    path.write_text("\n".join([HEAD, *lines]))
    assert "long.csv, line 59002: 4 cells, expected 5 as in the header" in error_of(path)


def test_a_parquet_file_cannot_claim_gigabytes(tmp_path):
    """Constant columns of many rows take next to no space: 400 MB in 200 kB."""
    path = tmp_path / "bad.parquet"
    names = HEAD.split(",")
    zeros = pa.DictionaryArray.from_arrays(pa.array(np.zeros(10**7, np.int8)), pa.array([0.0]))
    pq.write_table(pa.table([zeros] * len(names), names=names), path, row_group_size=10**7)
    assert path.stat().st_size < 300_000
    assert "claims 10000000 rows of 5 columns" in error_of(path)


def test_the_pages_of_a_parquet_file_cannot_claim_gigabytes(tmp_path, monkeypatch):
    """Headers that state 1 MiB for pages of 160 kB; pyarrow takes that memory before it reads."""
    monkeypatch.setattr(parquet_pages, "MOST_UNPACKED", 1 << 20)
    path, names = tmp_path / "bad.parquet", HEAD.split(",")
    table = pa.table([np.zeros(20_000)] * len(names), names=names)
    pq.write_table(table, path, use_dictionary=False, compression="zstd")
    assert "claims" not in error_of(path)
    sizes = re.compile(rb"(\x15\x00\x15)[\x80-\xff]{2}[\x01-\x7f](\x15)")  # PageHeader 1, 2, 3
    most = b"\xfe\xff\x7f"  # 2**20 - 1 in the same three bytes
    content, changed = sizes.subn(lambda found: found[1] + most + found[2], path.read_bytes())
    path.write_bytes(content)
    assert changed == len(names)
    assert f"claims pages of {2 * (2**20 - 1)} bytes" in error_of(path)


def test_damaged_statistics_of_sizes_do_not_end_the_process(tmp_path):
    """pyarrow 26 aborts where it is asked for the place of a column chunk of such a file."""
    path, names = tmp_path / "bad.parquet", HEAD.split(",")
    table = pa.table([[1.0, None, 2.0]] * len(names), names=names)
    pq.write_table(table, path)
    levels, fewer = b"\x26\x02\x04", b"\x16\x82\x04"  # lists of 1 and 2, and of 257 alone
    content = path.read_bytes()
    assert content.count(levels) == len(names)
    path.write_bytes(content.replace(levels, fewer))
    assert "not a readable Parquet file" in error_of(path)


def test_column_chunks_do_not_overlap(tmp_path):
    """A footer may state thousands of chunks in the same bytes, which would be read each time."""
    path, names = tmp_path / "bad.parquet", HEAD.split(",")
    table = pa.table([np.zeros(20_000)] * len(names), names=names)
    pq.write_table(table, path, use_dictionary=False, compression="none")
    assert "Parquet" not in error_of(path)
    content = path.read_bytes()
    sizes = re.compile(rb"(\x16([\x80-\xff]{2}[\x01-\x7f])\x16)\2(\x26)")  # fields 6, 7, 9
    larger = b"\xfe\xff\x1f"  # 2**18 - 1 in the same three bytes, of 160 kB
    bad, changed = sizes.subn(lambda found: found[1] + larger + found[3], content, 1)
    assert changed == 1
    path.write_bytes(bad)
    assert "not a readable Parquet file" in error_of(path)


def test_a_list_in_the_header_of_a_page_ends_with_the_file(tmp_path):
    """A header may claim a list of 2**42 truth values, which take no time to pass over."""
    path, names = tmp_path / "bad.parquet", HEAD.split(",")
    table = pa.table([np.zeros(9)] * len(names), names=names)
    pq.write_table(table, path, use_dictionary=False)
    at = pq.read_metadata(path).row_group(0).column(0).data_page_offset
    content = path.read_bytes()
    listed = b"\x19\xf1" + b"\x80" * 6 + b"\x01"  # field 1: a list; its number, 7 bits a byte
    path.write_bytes(content[:at] + listed + content[at + len(listed) :])
    began = time.process_time()
    assert "not a readable Parquet file" in error_of(path)
    assert time.process_time() - began < 1.0


@pytest.mark.parametrize("name", ["p" + "1" * 5000 + "_kPa", "k" + "9" * 5000 + "_x_mm"])
def test_numbers_of_thousands_of_digits_in_names(tmp_path, name):
    path = tmp_path / "bad.csv"
    path.write_text(f"{HEAD},{name}\n{ROW},1\n")
    assert "not a column's name" in error_of(path)


@pytest.mark.parametrize("name", ["loop.csv", "loop.parquet", "loop", "loop/a.csv"])
def test_links_in_a_circle_are_one_line(name, tmp_path):
    link = tmp_path / name.split("/")[0]
    link.symlink_to(link.name)
    with pytest.raises(InputError) as error:
        load_recordings(tmp_path / name)
    said = str(error.value)
    assert said.startswith(f"{tmp_path / name}: cannot be read (Too many levels of symbolic links)")
    assert "\n" not in said


def test_a_folder_without_permission_is_one_line(tmp_path, monkeypatch):
    def refuse(folder):
        raise PermissionError(13, "Permission denied", str(folder))

    monkeypatch.setattr("pathlib.Path.iterdir", refuse)  # root may read every folder
    with pytest.raises(InputError, match=r"cannot be read \(Permission denied\), expected a file"):
        load_recordings(tmp_path)
