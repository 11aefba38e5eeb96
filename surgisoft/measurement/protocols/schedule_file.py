"""User-defined schedules: a CSV file with columns t_s, c1_kPa ... cm_kPa, optionally run."""

import re
from pathlib import Path

import numpy as np

from surgisoft.errors import InputError
from surgisoft.measurement.protocols.protocol import Protocol
from surgisoft.measurement.tables import DelimitedText, read_text

COMMAND = re.compile(r"c([0-9]{1,6})_(\w{1,40})")


def load_schedule(path: str | Path) -> Protocol:
    """The continuous protocol in a CSV file; the command is linear between its rows."""
    path = Path(path)
    head, _, body = read_text(path).partition(b"\n")
    header = [name.strip() for name in head.decode("utf-8", "replace").split(",")]
    columns, unit = _command_columns(path, header)
    cells = DelimitedText(path, body, 2, header, missing=())
    table = cells.numbers(range(len(header)))
    if len(table) < 2:
        raise InputError(f"{path}: {len(table)} rows, a schedule needs at least two")
    bad = np.argwhere(~np.isfinite(table))
    if len(bad):
        row, column = bad[0].tolist()
        raise InputError(
            f"{cells.place(row)}, column '{header[column]}': got {table[row, column]}, "
            "expected a finite number"
        )
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
