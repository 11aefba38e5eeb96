"""Schedules of one's own: a CSV file with the columns t_s, c1_kPa ... cm_kPa and maybe run."""

import csv
import re
from pathlib import Path

import numpy as np

from surgisoft.errors import InputError
from surgisoft.measurement.protocols.protocol import Protocol

COMMAND = re.compile(r"c(\d+)_(\w+)")


def load_schedule(path: str | Path) -> Protocol:
    """The continuous protocol in a CSV file; the command is linear between its rows."""
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            lines = [line for line in csv.reader(file) if line]
    except OSError as error:
        raise InputError(f"{path}: cannot read the schedule ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: the schedule is not a text file") from error
    if len(lines) < 3:
        raise InputError(f"{path}: {max(len(lines) - 1, 0)} rows, a schedule needs at least two")
    header = [name.strip() for name in lines[0]]
    columns, unit = _command_columns(path, header)
    table = _numbers(path, header, lines[1:])
    run = table[:, header.index("run")] if "run" in header else np.zeros(len(table))
    if (run != np.round(run)).any():
        raise InputError(f"{path}: column run has a value that is not a whole number")
    times = table[:, header.index("t_s")]
    try:
        return Protocol(path.stem, "continuous", table[:, columns], run, times, unit=unit)
    except InputError as error:
        raise InputError(f"{path}: {error}") from error


def _command_columns(path: Path, header: list[str]) -> tuple[list[int], str]:
    """Places of c1 ... cm in the header, and their unit."""
    doubled = {name for name in header if header.count(name) > 1}
    if doubled:
        raise InputError(f"{path}: column {doubled.pop()} appears twice")
    found = {}
    for place, name in enumerate(header):
        match = COMMAND.fullmatch(name)
        if match:
            found[int(match[1])] = (place, match[2])
        elif name not in ("t_s", "run"):
            raise InputError(f"{path}: unknown column '{name}', expected t_s, c1_kPa ... and run")
    if "t_s" not in header or sorted(found) != list(range(1, len(found) + 1)) or not found:
        raise InputError(f"{path}: columns {', '.join(header)}, expected t_s, c1_kPa ... cm_kPa")
    units = {unit for _, unit in found.values()}
    if len(units) > 1:
        raise InputError(f"{path}: commands in {', '.join(sorted(units))}, expected one unit")
    return [found[i][0] for i in sorted(found)], units.pop()


def _numbers(path: Path, header: list[str], lines: list[list[str]]) -> np.ndarray:
    """The table (T, columns) behind the header."""
    table = np.empty((len(lines), len(header)))
    for row, line in enumerate(lines):
        if len(line) != len(header):
            raise InputError(
                f"{path}: row {row + 2} has {len(line)} cells, the header has {len(header)}"
            )
        for column, cell in enumerate(line):
            try:
                table[row, column] = float(cell)
            except ValueError:
                table[row, column] = np.nan
            if not np.isfinite(table[row, column]):
                raise InputError(
                    f"{path}: row {row + 2}, column {header[column]} is '{cell.strip()}', "
                    "expected a number"
                )
    return table
