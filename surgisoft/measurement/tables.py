"""Tables of numbers in text and Parquet files, with the place of every cell for messages.

Text is read by pyarrow. Where pyarrow refuses it, the cells are read one by one, which either reads
numbers that are written unusually or names the line of the bad cell.
"""

import bz2
import csv
import gzip
import io
import lzma
import re
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from surgisoft.errors import InputError
from surgisoft.measurement.parquet_pages import MOST_UNPACKED, open_metadata

MISSING = ("", "NaN", "nan", "NAN")
"""Texts that mean a missing value."""
NUMBER = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|[+-]?inf(inity)?", re.I)
"""A number as text files write it, with a decimal point."""
LARGEST = 1e100
"""A number of this size or more is no measurement: its square and cube would be infinite."""
BLOCK_BYTES = 1 << 20
"""Text of up to this size is read cell by cell where pyarrow refuses it; more goes in parts."""
_COMPRESSED = {b"\x1f\x8b": gzip, b"BZh": bz2, b"\xfd7zXZ": lzma}


class Cells(Protocol):
    """Columns of a table that are read when asked for."""

    def numbers(self, positions: Sequence[int]) -> np.ndarray:
        """The cells (T, len(positions)) float64 of columns counted from 0; NaN where missing."""
        ...

    def texts(self, position: int) -> list[str]:
        """The cells (T,) of a column as they are written."""
        ...

    def place(self, row: int) -> str:
        """File and place of a row, counted from 0, for messages."""
        ...


def too_large(cells: np.ndarray) -> np.ndarray:
    """Which cells are infinite or of a size that no measurement has; NaN is not."""
    return np.abs(cells) >= LARGEST


def label(names: Sequence[str], position: int) -> str:
    """A column's name for messages, with its number from 1 where the name is not enough."""
    name = names[position]
    if name and names.count(name) == 1:
        return f"'{name}'"
    return f"'{name}' ({position + 1})" if name else f"{position + 1}"


@dataclass(frozen=True, eq=False)
class ParquetTable:
    """Columns of a Parquet file, read when asked for."""

    path: Path
    """Path of the file."""
    names: list[str]
    """Names of the columns."""

    @classmethod
    def open(cls, path: Path) -> "ParquetTable":
        """Open a Parquet file without reading its columns; InputError if it is unreadable."""
        content = open_metadata(path)
        try:
            return cls(path, list(content.schema.to_arrow_schema().names))
        except (pa.ArrowException, ValueError) as error:
            raise InputError(f"{path}: not a readable Parquet file") from error

    def numbers(self, positions: Sequence[int]) -> np.ndarray:
        """Cells (T, len(positions)) float64 of columns; raises InputError for other types."""
        columns = []
        for column, position in zip(self._read(positions), positions, strict=True):
            try:
                if pa.types.is_boolean(column.type):
                    raise pa.ArrowInvalid("true and false are not numbers")
                values = column.cast(pa.float64(), safe=False)
            except pa.ArrowException:
                dates = (
                    '; unit = "iso" reads dates as times'
                    if pa.types.is_timestamp(column.type)
                    else ""
                )
                raise InputError(
                    f"{self.path}, column {label(self.names, position)}: holds {column.type}, "
                    f"expected numbers{dates}"
                ) from None
            columns.append(values.to_numpy())
        return np.column_stack(columns).astype(np.float64, copy=False)

    def texts(self, position: int) -> list[str]:
        """Cells (T,) of a column as text; empty where missing."""
        (column,) = self._read([position])
        try:
            if pa.types.is_timestamp(column.type):  # Python's dates have microseconds
                zone = "UTC" if column.type.tz else None
                column = column.cast(pa.timestamp("us", zone), safe=False)
            elif column.type in (pa.duration("ns"), pa.time64("ns")):
                column = column.cast(pa.string())
            return ["" if value is None else str(value) for value in column.to_pylist()]
        except (pa.ArrowException, ValueError, OverflowError):
            raise InputError(
                f"{self.path}, column {label(self.names, position)}: holds {column.type} that "
                "cannot be read as text, expected text, numbers or dates"
            ) from None

    def place(self, row: int) -> str:
        """File and row, counted from 1, of a row for messages."""
        return f"{self.path}, row {row + 1}"

    def _read(self, positions: Sequence[int]) -> list[pa.ChunkedArray]:
        names = list(dict.fromkeys(self.names[i] for i in positions))
        try:
            table = pq.ParquetFile(self.path).read(columns=names)
        except (pa.ArrowException, OSError, ValueError) as error:
            raise InputError(f"{self.path}: not a readable Parquet file") from error
        places: dict[str, list[int]] = {}
        for place, name in enumerate(table.column_names):  # in the order of the file
            places.setdefault(name, []).append(place)
        return [
            table.column(places[self.names[i]][self.names[:i].count(self.names[i])])
            for i in positions
        ]


def read_text(path: Path) -> bytes:
    """A text file's content, decompressed, lines ending in a line feed, no byte order mark."""
    try:
        data = path.read_bytes()
        for magic, module in _COMPRESSED.items():
            if data.startswith(magic):
                with module.open(path) as file:
                    data = file.read(MOST_UNPACKED + 1)
                if len(data) > MOST_UNPACKED:
                    raise InputError(
                        f"{path}: holds more than {MOST_UNPACKED >> 20} MiB when it is unpacked; "
                        "unpack it first if that is right"
                    )
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error})") from error
    except (EOFError, lzma.LZMAError, zlib.error, ValueError) as error:
        raise InputError(f"{path}: the compressed file is damaged ({error})") from error
    if (zero := data.find(b"\0", 0, 4096)) >= 0:
        line = data.count(b"\n", 0, zero) + 1
        raise InputError(
            f"{path}, line {line}: a zero byte, not a text file; expected columns of numbers"
        )
    data = data.removeprefix(b"\xef\xbb\xbf")
    if b"\r" in data:
        data = data.replace(b"\r\n", b"\n").replace(b"\r", b"\n")
    if not data.strip():
        raise InputError(f"{path}: the file is empty, expected a table")
    return data


@dataclass(frozen=True, eq=False)
class DelimitedText:
    """Columns of a text file below its header, read when asked for."""

    path: Path
    """Path of the file."""
    body: bytes
    """The lines below the header; blank ones do not count as rows."""
    first_line: int
    """Number of the body's first line in the file, counted from 1."""
    names: list[str]
    """Names of the columns; "" where a column has none."""
    separator: str = ","
    """Character between two cells."""
    decimal: str = "."
    """Decimal point or comma."""
    missing: tuple[str, ...] = MISSING
    """Texts that mean a missing value."""

    def numbers(self, positions: Sequence[int]) -> np.ndarray:
        """Cells (T, len(positions)) float64 of columns, NaN where missing.

        Raises InputError with the line of a cell that is no number.
        """
        try:
            columns = self._read(positions, pa.float64())
        except pa.ArrowInvalid:
            if b'"' in self.body or len(self.body) <= BLOCK_BYTES:
                return self._numbers_by_cell(positions)
            return np.concatenate([block.numbers(positions) for block in self._blocks()])
        values = np.empty((len(columns[0]), len(columns)), order="F")  # a column lies together
        for target, column in zip(values.T, columns, strict=True):
            start = 0
            for chunk in column.chunks:
                target[start : start + len(chunk)] = chunk.to_numpy(zero_copy_only=False)
                start += len(chunk)
        return values

    def texts(self, position: int) -> list[str]:
        """Cells (T,) of a column as text, without surrounding spaces."""
        try:
            (column,) = self._read([position], pa.string())
        except pa.ArrowInvalid:
            return [cells[position].strip() for _, cells in self._rows()]
        return ["" if value is None else value.strip() for value in column.to_pylist()]

    def place(self, row: int) -> str:
        """File and line of a row for messages."""
        for index, (line, _) in enumerate(self._lines()):
            if index == row:
                return f"{self.path}, line {line}"
        return f"{self.path}, row {row + 1}"

    def _blocks(self) -> Iterator["DelimitedText"]:
        """Parts of whole lines, so that only the part with an unusual cell is read by cells."""
        start, line = 0, self.first_line
        while start < len(self.body):
            end = self.body.find(b"\n", start + BLOCK_BYTES // 2) + 1 or len(self.body)
            block = self.body[start:end]
            yield replace(self, body=block, first_line=line)
            start, line = end, line + block.count(b"\n")

    def _read(self, positions: Sequence[int], kind: pa.DataType) -> list[pa.ChunkedArray]:
        wanted = [f"f{i}" for i in positions]
        table = pyarrow.csv.read_csv(
            io.BytesIO(self.body),
            read_options=pyarrow.csv.ReadOptions(
                column_names=[f"f{i}" for i in range(len(self.names))]
            ),
            parse_options=pyarrow.csv.ParseOptions(
                delimiter=self.separator, newlines_in_values=b'"' in self.body
            ),
            convert_options=pyarrow.csv.ConvertOptions(
                include_columns=sorted(set(wanted), key=wanted.index),
                column_types=dict.fromkeys(wanted, kind),
                null_values=list(self.missing),
                strings_can_be_null=True,
                quoted_strings_can_be_null=True,
                decimal_point=self.decimal,
            ),
        )
        return [table.column(name) for name in wanted]

    def _lines(self) -> Iterator[tuple[int, list[str]]]:
        """Line (from 1) and cells of each row; blank lines are passed over."""
        text = io.TextIOWrapper(
            io.BytesIO(self.body), encoding="utf-8", errors="replace", newline="\n"
        )
        reader = csv.reader(text, delimiter=self.separator)
        try:
            for cells in reader:
                if cells:
                    yield self.first_line + reader.line_num - 1, cells
        except csv.Error as error:
            line = self.first_line + reader.line_num - 1
            raise InputError(f"{self.path}, line {line}: {error}") from error

    def _rows(self) -> Iterator[tuple[int, list[str]]]:
        for line, cells in self._lines():
            if len(cells) != len(self.names):
                raise InputError(
                    f"{self.path}, line {line}: {len(cells)} cells, expected "
                    f"{len(self.names)} as in the {'header' if any(self.names) else 'first row'}"
                )
            yield line, cells

    def _numbers_by_cell(self, positions: Sequence[int]) -> np.ndarray:
        rows = [
            [self._number(cells[i], line, i) for i in positions] for line, cells in self._rows()
        ]
        return np.array(rows, np.float64).reshape(len(rows), len(positions))

    def _number(self, cell: str, line: int, position: int) -> float:
        text = cell.strip()
        if text in self.missing:
            return np.nan
        if self.decimal != "." and "." in text:
            raise InputError(
                f"{self.path}, line {line}, column {label(self.names, position)}: "
                f"got {text[:40]!r}, expected a number with a decimal comma and without thousands "
                'separators, since the map says decimal = ","'
            )
        text = text.replace(self.decimal, ".")
        if not NUMBER.fullmatch(text):
            raise InputError(
                f"{self.path}, line {line}, column {label(self.names, position)}: "
                f"got {cell.strip()[:40]!r}, expected a number"
                + " (a missing value is an empty cell or NaN)"
                * bool(self.missing)
            )
        return float(text)
