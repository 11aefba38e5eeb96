"""Tables of numbers from CSV and Parquet files, and the place of each cell for messages."""

import csv
import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from surgisoft.errors import InputError

SUFFIXES = (".csv", ".parquet")
_MISSING = ("", "NaN", "nan", "NAN")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|[+-]?inf(inity)?", re.I)


def read_header(path: Path) -> list[str]:
    """The names of the columns."""
    if path.suffix == ".parquet":
        return list(_parquet_schema(path).names)
    return _csv_header(path)


def read_numbers(path: Path, names: Sequence[str], columns: Sequence[int]) -> np.ndarray:
    """The cells (T, len(columns)) float64 of the columns at these positions; NaN where missing."""
    if path.suffix == ".parquet":
        return _parquet_numbers(path, names, columns)
    return _csv_numbers(path, names, columns)


def header_place(path: Path) -> str:
    """Where the names stand, for messages."""
    return f"{path}, line 1" if path.suffix == ".csv" else f"{path}"


def row_place(path: Path, row: int) -> str:
    """Where a row, counted from 0, stands: the line of the text file, the row (from 1) of a table.

    Lines are counted from 1, as editors show them.
    """
    if path.suffix == ".parquet":
        return f"{path}, row {row + 1}"
    for index, (line, _) in enumerate(_csv_cells(path)):
        if index == row:
            return f"{path}, line {line}"
    return f"{path}, row {row + 1}"


def check_is_file(path: Path) -> None:
    """Raise where there is no such file."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder, expected a file")
    if not path.exists():
        raise InputError(f"{path}: no such file, expected a recording (.csv or .parquet)")
    if not path.is_file():
        raise InputError(f"{path}: not a regular file, expected a recording (.csv or .parquet)")


def _csv_header(path: Path) -> list[str]:
    try:
        with path.open("rb") as file:
            first = file.readline()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from error
    if b"\0" in first:
        raise InputError(f"{path}: not a text file, expected comma-separated values")
    try:
        text = first.decode("utf-8-sig").rstrip("\r\n")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not text in UTF-8, expected comma-separated values") from error
    if not first:
        raise InputError(f"{path}: the file is empty, expected a table")
    if not text.strip():
        raise InputError(f"{path}, line 1: is blank, expected the names of the columns")
    names = next(csv.reader([text]))
    for separator, called in ((";", "semicolons"), ("\t", "tabs")):
        if len(names) < 3 and text.count(separator) >= 3:
            raise InputError(
                f"{path}, line 1: separated by {called}, expected commas; "
                "'surgisoft import' reads other separators"
            )
    return names


def _csv_numbers(path: Path, names: Sequence[str], columns: Sequence[int]) -> np.ndarray:
    """Read by pyarrow; where it stumbles, read cell by cell to name the place."""
    wanted = [f"f{i}" for i in columns]
    try:
        table = pyarrow.csv.read_csv(
            path,
            read_options=pyarrow.csv.ReadOptions(
                skip_rows=1, column_names=[f"f{i}" for i in range(len(names))]
            ),
            convert_options=pyarrow.csv.ConvertOptions(
                include_columns=wanted,
                column_types={name: pa.float64() for name in wanted},
                null_values=list(_MISSING),
                quoted_strings_can_be_null=True,
            ),
        )
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except pa.ArrowInvalid:
        return _csv_numbers_slowly(path, names, columns)
    return np.column_stack([_float64(table.column(name)) for name in wanted])


def _float64(column: pa.ChunkedArray) -> np.ndarray:
    """The values (T,) of a numeric column; NaN for nulls."""
    return column.cast(pa.float64(), safe=False).to_numpy().astype(np.float64, copy=False)


def _csv_cells(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Line (from 1) and cells of each row below the header; blank lines are passed over."""
    with path.open(encoding="utf-8-sig", errors="replace", newline="") as file:
        reader = csv.reader(file)
        next(reader)
        try:
            for cells in reader:
                if cells:
                    yield reader.line_num, cells
        except csv.Error as error:
            raise InputError(f"{path}, line {reader.line_num}: {error}") from error


def _csv_numbers_slowly(path: Path, names: Sequence[str], columns: Sequence[int]) -> np.ndarray:
    rows = []
    for line, cells in _csv_cells(path):
        if len(cells) != len(names):
            raise InputError(
                f"{path}, line {line}: {len(cells)} cells, expected {len(names)} as in line 1"
            )
        rows.append([_number(cells[i], path, line, names[i]) for i in columns])
    return np.array(rows, np.float64).reshape(len(rows), len(columns))


def _number(cell: str, path: Path, line: int, name: str) -> float:
    text = cell.strip()
    if text in _MISSING:
        return np.nan
    if not _NUMBER.fullmatch(text):
        raise InputError(
            f"{path}, line {line}, column '{name}': got {cell[:40]!r}, "
            "expected a number (a missing value is an empty cell or NaN)"
        )
    return float(text)


def _parquet_schema(path: Path) -> pa.Schema:
    try:
        return pq.read_schema(path)
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{path}: not a readable Parquet file") from error


def _parquet_numbers(path: Path, names: Sequence[str], columns: Sequence[int]) -> np.ndarray:
    schema = _parquet_schema(path)
    for i in columns:
        kind = schema.field(i).type
        if not (pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_null(kind)):
            raise InputError(f"{path}, column '{names[i]}': holds {kind}, expected numbers")
    try:
        table = pq.read_table(path, columns=[names[i] for i in columns])
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{path}: not a readable Parquet file") from error
    return np.column_stack([_float64(table.column(names[i])) for i in columns])
