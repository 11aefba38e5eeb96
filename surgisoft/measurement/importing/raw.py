"""Raw tables: columns of a laboratory's file by name or number, and the interface of readers."""

import difflib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from surgisoft.config import POSITIVE, Rule, at_least, one_of
from surgisoft.errors import InputError
from surgisoft.measurement.tables import LARGEST, Cells, label, too_large
from surgisoft.measurement.units import SECONDS_PER

A_COLUMN = Rule(
    "a column's name or its number, counted from 1",
    lambda column: column != "" if isinstance(column, str) else column >= 1,
)
Column = Annotated[str | int, A_COLUMN]
"""A column by its name or, counted from 1, by its number."""

SEPARATOR = Rule(
    "one character or 'whitespace'", lambda text: text == "whitespace" or len(text) == 1
)
LEAST_NUMBERS = 0.8
"""Least share of the cells of a row of numbers that are numbers or empty [-]; the others may be
words, such as the name of a phase."""
SHOWN_NUMBERS = 3
"""Most of such names that a message lists (a count)."""
TIME_UNIT = one_of((*SECONDS_PER, "iso"))


@dataclass(frozen=True)
class FileRole:
    """Table [file.NAME] of a map: a kind of raw file, its format, and how its rows join the main
    file's."""

    match: str = "*"
    """Pattern of the file names that have this role."""
    format: str = "auto"
    """Name of a reader, or "auto" (by the name's ending)."""
    separator: Annotated[str, SEPARATOR] = ","
    """One character, or "whitespace"."""
    decimal: Annotated[str, one_of((".", ","))] = "."
    """Decimal sign of text files."""
    header: bool = True
    """Whether a line of column names comes first."""
    skip_rows: Annotated[int, at_least(0)] = 0
    """Lines before the header, or before the numbers where there is no header."""
    comment: str = ""
    """Lines that start with this are passed over."""
    missing: tuple[str, ...] = ()
    """Texts that mean a missing value, in addition to the empty cell and NaN."""
    topic: str = ""
    """Topic of an MCAP file, such as "/pressures"; one file serves every role that names one."""
    topics: tuple[str, ...] = ()
    """Several topics whose messages belong together, such as a pose each."""
    join: Annotated[str, one_of(("rows", "time"))] = "rows"
    """"rows": row by row with the main file; "time": matched by time."""
    offset_rows: int = 0
    """Row i of this file belongs to row i + offset_rows of the main file."""
    unpaired: Annotated[str, one_of(("error", "drop"))] = "error"
    """What is done with rows at the end that have no partner: "error" or "drop"."""
    time: Column = "t_s"
    """Time column of a file that is joined by time."""
    time_unit: Annotated[str, TIME_UNIT] = "s"
    """Unit of that column."""
    clock_offset_s: float = 0.0
    """Added to this file's times to get the main file's clock [s]."""
    clock: Annotated[str, one_of(("shared", "from_start"))] = "shared"
    """"shared", or "from_start": both files' times count from their first row."""
    interpolate: Annotated[str, one_of(("linear", "previous"))] = "linear"
    """Between this file's rows: "linear" or "previous"."""
    max_gap_s: Annotated[float, POSITIVE] = 1.0
    """Samples that fall into a longer gap of this file are dropped [s]."""


@dataclass(frozen=True, eq=False)
class RawTable:
    """Columns of one raw file, read when asked for."""

    path: Path
    """Path of the file."""
    names: list[str]
    """Names of the columns; "" where a column has none."""
    cells: Cells
    """Access to the columns' cells."""
    unit: str = ""
    """Unit of positions, where the file states it."""
    bodies: tuple[str, ...] = ()
    """Rigid bodies of a motion capture file; body B has columns B.x B.y B.z B.qx B.qy B.qz B.qw."""
    markers: tuple[str, ...] = ()
    """Markers of a motion capture file; marker M has columns M.x M.y M.z."""
    notes: tuple[str, ...] = ()
    """Notes about what was left out while reading."""
    advice: str = ""
    """What to set in the map if columns are not found; empty where nothing is known."""

    def position(self, column: Column) -> int:
        """Position, counted from 0, of a column by its name or its number from 1."""
        if isinstance(column, int):
            if column > len(self.names):
                advice = f"; {self.advice}" if self.advice else ""
                raise InputError(
                    f"{self.path}: no column {column}, expected at most {len(self.names)}{advice}"
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
        if self.advice:
            count = f"{len(named)} column{'s' * (len(named) > 1)}"
            return f"no column '{column}', the map's separator gives {count}; {self.advice}"
        if sum(_is_number(name) for name in named) >= LEAST_NUMBERS * len(named):
            shown = ", ".join(named[:SHOWN_NUMBERS]) + (", ..." if named[SHOWN_NUMBERS:] else "")
            return (
                f"no column '{column}', the line of names holds numbers ({shown}); if the file has "
                "no header, set header = false in [file.NAME] of the map and give columns by their "
                "numbers, counted from 1"
            )
        near = difflib.get_close_matches(column, named, 1)
        shown = ", ".join(named[:8]) + (", ..." if len(named) > 8 else "")
        hint = f"; did you mean '{near[0]}'?" if near else ""
        return f"no column '{column}', expected one of {shown}{hint}"

    def numbers(self, columns: Sequence[Column]) -> np.ndarray:
        """The cells (T, len(columns)) float64, NaN where missing; infinite ones are an error."""
        positions = [self.position(column) for column in columns]
        try:
            cells = self.cells.numbers(positions)
        except IndexError as error:
            raise InputError(
                f"{self.path}: got fewer columns than the {len(self.names)} that its reader names "
                f"({', '.join(self.names[:8])})"
            ) from error
        if too_large(cells).any():
            row, i = np.argwhere(too_large(cells))[0].tolist()
            raise InputError(
                f"{self.cells.place(row)}, column {label(self.names, positions[i])}: "
                f"got {cells[row, i]}, expected a finite number of a size below {LARGEST:g}"
            )
        return cells

    def texts(self, column: Column) -> list[str]:
        """The cells (T,) of a column as they are written."""
        return self.cells.texts(self.position(column))


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True


def _any_file(_: Path) -> bool:
    return True


@dataclass(frozen=True)
class Reader:
    """A reader of one raw format; a new one is a file with a `READER` and an entry in READERS."""

    about: str
    """Kind of file, for messages: "a Motive CSV export"."""
    read: Callable[[Path, FileRole], RawTable]
    """Opens a file, whose role describes its format. Raises InputError on bad content."""
    suffixes: tuple[str, ...] = ()
    """Endings by which format = "auto" chooses this reader."""
    fits: Callable[[Path], bool] = _any_file
    """Whether a file looks as if it had this format; others do not get a role of this format."""
    is_folder: bool = False
    """Whether one input of this format is a folder as a whole."""
    states_unit: bool = False
    """Whether its files state the unit of positions, so that the map need not."""
