"""Raw tables, whatever file they come from: cells by a column's name or number."""

import difflib
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from surgisoft.errors import InputError
from surgisoft.measurement.importing_spec import Column


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
