"""Raw tables, whatever file they come from: cells by a column's name or number."""

import bz2
import csv
import difflib
import gzip
import io
import lzma
import re
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from surgisoft.errors import InputError
from surgisoft.measurement.importing.spec import Column, FileRole


class Cells(Protocol):
    """Where the cells of a raw table come from."""

    def numbers(self, positions: Sequence[int]) -> np.ndarray:
        """The cells (T, len(positions)) float64 of columns counted from 0; NaN where missing."""

    def texts(self, position: int) -> list[str]:
        """The cells (T,) of a column as they are written."""

    def place(self, row: int) -> str:
        """Where a row, counted from 0, stands in the file, for messages."""


@dataclass(frozen=True, eq=False)
class RawTable:
    """Columns of one raw file, read when asked for."""

    path: Path
    names: list[str]
    """Names of the columns; "" where a column has none."""
    cells: Cells
    """Reads the columns."""
    unit: str = ""
    """Unit of positions, where the file states it."""
    kinds: dict[str, str] = field(default_factory=dict)
    """What each body or marker of a motion capture file is, by its name."""
    notes: list[str] = field(default_factory=list)
    """What was left out while reading, in words."""

    def position(self, column: Column) -> int:
        """Position, counted from 0, of a column by its name or its number from 1."""
        if isinstance(column, int):
            if column > len(self.names):
                raise InputError(
                    f"{self.path}: no column {column}, expected at most {len(self.names)}"
                )
            return column - 1
        if self.names.count(column) == 1:
            return self.names.index(column)
        raise InputError(f"{self.path}: {self._not_one(column)}")

    def _not_one(self, column: str) -> str:
        named = [name for name in self.names if name]
        if not named:
            return (
                f"no column '{column}', the file has no header; "
                "expected a column's number, counted from 1"
            )
        if column in named:
            return (
                f"{named.count(column)} columns are called '{column}', expected one; "
                "give the column's number, counted from 1"
            )
        near = difflib.get_close_matches(column, named, 1)
        shown = ", ".join(named[:8]) + (", ..." if len(named) > 8 else "")
        hint = f"; did you mean '{near[0]}'?" if near else ""
        return f"no column '{column}', expected one of {shown}{hint}"

    def numbers(self, columns: Sequence[Column]) -> np.ndarray:
        """The cells (T, len(columns)) float64, NaN where missing; infinite ones are an error."""
        positions = [self.position(column) for column in columns]
        cells = self.cells.numbers(positions)
        if np.isinf(cells).any():
            row, i = np.argwhere(np.isinf(cells))[0].tolist()
            raise InputError(
                f"{self.cells.place(row)}, column {label(self.names, positions[i])}: "
                f"got {cells[row, i]}, expected a finite number"
            )
        return cells

    def texts(self, column: Column) -> list[str]:
        """The cells (T,) of a column as they are written."""
        return self.cells.texts(self.position(column))


def label(names: Sequence[str], position: int) -> str:
    """A column's name and number, counted from 1, for messages."""
    name = names[position]
    return f"'{name}' ({position + 1})" if name else f"{position + 1}"


@dataclass(frozen=True, eq=False)
class ParquetCells:
    """Cells of a Parquet file."""

    path: Path

    def numbers(self, positions: Sequence[int]) -> np.ndarray:
        table = self._read(positions)
        columns = []
        for column, name in zip(table.columns, table.column_names, strict=True):
            kind = column.type
            if pa.types.is_boolean(kind) or not _casts(column):
                raise InputError(f"{self.path}, column '{name}': holds {kind}, expected numbers")
            columns.append(column.cast(pa.float64(), safe=False).to_numpy())
        return np.column_stack(columns).astype(np.float64, copy=False)

    def texts(self, position: int) -> list[str]:
        column = self._read([position]).column(0)
        return ["" if value is None else str(value) for value in column.to_pylist()]

    def place(self, row: int) -> str:
        return f"{self.path}, row {row + 1}"

    def _read(self, positions: Sequence[int]) -> pa.Table:
        try:
            whole = pq.ParquetFile(self.path)
            names = [whole.schema_arrow.names[i] for i in positions]
            return whole.read(columns=names).select(names)
        except (pa.ArrowException, OSError) as error:
            raise InputError(f"{self.path}: not a readable Parquet file") from error


def _casts(column: pa.ChunkedArray) -> bool:
    try:
        column.cast(pa.float64(), safe=False)
    except pa.ArrowException:
        return False
    return True


def parquet_table(path: Path) -> RawTable:
    """A Parquet file as a raw table."""
    try:
        names = list(pq.read_schema(path).names)
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{path}: not a readable Parquet file") from error
    return RawTable(path, names, ParquetCells(path))


_COMPRESSED = {b"\x1f\x8b": gzip, b"BZh": bz2, b"\xfd7zXZ": lzma}
_MISSING = ("", "NaN", "nan", "NAN")
_NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|[+-]?inf(inity)?", re.I)


def read_bytes(path: Path) -> bytes:
    """The file's content, decompressed, without a byte order mark."""
    try:
        data = path.read_bytes()
        for magic, module in _COMPRESSED.items():
            if data.startswith(magic):
                data = module.decompress(data)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (EOFError, lzma.LZMAError, zlib.error, ValueError) as error:
        raise InputError(f"{path}: the compressed file is damaged ({error})") from error
    if b"\0" in data[:4096]:
        raise InputError(f"{path}: not a text file, expected columns of numbers")
    data = data.removeprefix(b"\xef\xbb\xbf").replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if not data.strip():
        raise InputError(f"{path}: the file is empty, expected a table")
    return data


@dataclass(frozen=True, eq=False)
class TextCells:
    """Cells of a text file below its header."""

    path: Path
    body: bytes
    """The lines below the header; blank ones do not count as rows."""
    first_line: int
    """Number of the body's first line in the file, counted from 1."""
    names: list[str]
    separator: str
    decimal: str
    missing: tuple[str, ...]
    """Texts that mean a missing value."""

    def numbers(self, positions: Sequence[int]) -> np.ndarray:
        try:
            table = self._read(positions, pa.float64())
        except pa.ArrowInvalid:
            return self._numbers_slowly(positions)
        return np.column_stack([c.to_numpy() for c in table.columns]).astype(np.float64, copy=False)

    def texts(self, position: int) -> list[str]:
        try:
            column = self._read([position], pa.string()).column(0)
        except pa.ArrowInvalid:
            return [cells[position].strip() for _, cells in self._rows()]
        return ["" if value is None else value.strip() for value in column.to_pylist()]

    def place(self, row: int) -> str:
        for index, (line, _) in enumerate(self._lines()):
            if index == row:
                return f"{self.path}, line {line}"
        return f"{self.path}, row {row + 1}"

    def _read(self, positions: Sequence[int], kind: pa.DataType) -> pa.Table:
        wanted = [f"f{i}" for i in positions]
        table = pyarrow.csv.read_csv(
            io.BytesIO(self.body),
            read_options=pyarrow.csv.ReadOptions(
                column_names=[f"f{i}" for i in range(len(self.names))]
            ),
            parse_options=pyarrow.csv.ParseOptions(delimiter=self.separator),
            convert_options=pyarrow.csv.ConvertOptions(
                include_columns=sorted(set(wanted), key=wanted.index),
                column_types=dict.fromkeys(wanted, kind),
                null_values=list(self.missing),
                strings_can_be_null=True,
                quoted_strings_can_be_null=True,
                decimal_point=self.decimal,
            ),
        )
        return table.select(wanted)

    def _lines(self) -> Iterator[tuple[int, str]]:
        for number, line in enumerate(self.body.split(b"\n"), self.first_line):
            if line:
                yield number, line.decode("utf-8", errors="replace")

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        for number, line in self._lines():
            cells = next(csv.reader([line], delimiter=self.separator))
            if len(cells) != len(self.names):
                raise InputError(
                    f"{self.path}, line {number}: {len(cells)} cells, expected "
                    f"{len(self.names)} as in the {'header' if any(self.names) else 'first row'}"
                )
            yield number, cells

    def _numbers_slowly(self, positions: Sequence[int]) -> np.ndarray:
        """Cell by cell: for numbers written unusually, and to name the place of a bad one."""
        rows = [
            [self._number(cells[i], number, i) for i in positions] for number, cells in self._rows()
        ]
        return np.array(rows, np.float64).reshape(len(rows), len(positions))

    def _number(self, cell: str, line: int, position: int) -> float:
        text = cell.strip()
        if text in self.missing:
            return np.nan
        text = text.replace(self.decimal, ".")
        if not _NUMBER.fullmatch(text):
            raise InputError(
                f"{self.path}, line {line}, column {label(self.names, position)}: "
                f"got {cell.strip()[:40]!r}, expected a number"
            )
        return float(text)


def text_table(path: Path, role: FileRole) -> RawTable:
    """A text file of columns as a raw table."""
    data = read_bytes(path)
    offset = _offset_of_line(data, role.skip_rows)
    if offset is None:
        raise InputError(f"{path}: fewer than the {role.skip_rows} lines that the map skips")
    head, body, first_line = b"", data[offset:], role.skip_rows + 1
    if role.header:
        while True:  # the first line that is neither blank nor a comment
            head, _, body = body.partition(b"\n")
            first_line += 1
            if not body or (head.strip() and not _is_comment(head, role)):
                break
    return table_of_body(path, role, _header(head, role), body, first_line)


def table_of_body(
    path: Path, role: FileRole, names: list[str], body: bytes, first_line: int
) -> RawTable:
    """The raw table of the lines below a header; no names: as many as the first line has cells."""
    body = _cleaned(body, role)
    first = next((line for line in body.split(b"\n", 1000) if line), b"")
    if not first:
        raise InputError(f"{path}: no rows of numbers, expected at least one")
    separator = "\t" if role.separator == "whitespace" else role.separator
    count = len(next(csv.reader([first.decode("utf-8", "replace")], delimiter=separator)))
    names = names or [""] * count
    if count == len(names) + 1 and first.rstrip().endswith(separator.encode()):
        names = [*names, ""]  # each line ends with a separator
    if count == 1 and len(names) == 1:
        raise InputError(
            f"{path}: one column only when separated by {role.separator!r}; "
            "check the separator in the map"
        )
    body, notes = _without_torn_end(body, separator, len(names))
    missing = (*_MISSING, *role.missing)
    cells = TextCells(path, body, first_line, names, separator, role.decimal, missing)
    return RawTable(path, names, cells, notes=notes)


def _offset_of_line(data: bytes, lines: int) -> int | None:
    """Where the line after this many lines begins; None where there are not so many."""
    offset = 0
    for _ in range(lines):
        end = data.find(b"\n", offset)
        if end < 0:
            return None
        offset = end + 1
    return offset


def _is_comment(line: bytes, role: FileRole) -> bool:
    return bool(role.comment) and line.lstrip().startswith(role.comment.encode())


def _header(line: bytes, role: FileRole) -> list[str]:
    text = line.decode("utf-8", errors="replace").strip().removeprefix("#").strip(" ")
    if not text:
        return []
    if role.separator == "whitespace":
        return text.split()
    return [name.strip() for name in next(csv.reader([text], delimiter=role.separator))]


def _cleaned(body: bytes, role: FileRole) -> bytes:
    """The body with blanks instead of comments (lines keep their numbers), tabs as white space."""
    if role.comment:
        pattern = rb"(?m)^[ \t]*" + re.escape(role.comment.encode()) + rb".*$"
        body = re.sub(pattern, b"", body)
    if role.separator == "whitespace":
        body = re.sub(rb"(?m)^[ \t]+|[ \t]+$", b"", body)
        return re.sub(rb"[ \t]+", b"\t", body)
    return re.sub(rb"(?m)^[ \t]+$", b"", body) if role.separator != "\t" else body


def _without_torn_end(body: bytes, separator: str, count: int) -> tuple[bytes, list[str]]:
    """The body without a last line that was cut off while it was written."""
    kept = body.rstrip(b"\n")
    start = kept.rfind(b"\n") + 1
    last = kept[start:].decode("utf-8", errors="replace")
    cells = len(next(csv.reader([last], delimiter=separator), []))
    if start == 0 or cells >= count or body.endswith(b"\n"):
        return body, []
    return body[:start], [f"the last line was cut off ({cells} of {count} cells) and left out"]
