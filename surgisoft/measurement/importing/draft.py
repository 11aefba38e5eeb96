"""A draft of a map file from the names of a raw file's columns.

Of a text file the draft also has the separator and the decimal sign. What a name does not say (a
unit, the frame) is marked for the person who checks the draft. Names of columns that another reader
makes are paths, such as `run1.tip_cm.0` in a MATLAB or HDF5 file.
"""

import json
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from surgisoft.errors import InputError
from surgisoft.measurement.importing.raw import FileRole
from surgisoft.measurement.importing.readers import chosen, no_text, open_raw
from surgisoft.measurement.importing.readers.text import READER as TEXT
from surgisoft.measurement.recordings.columns import MM_PER
from surgisoft.measurement.tables import read_text
from surgisoft.measurement.units import ACTUATION_UNITS, SECONDS_PER

SEPARATORS = (";", "\t", ",", "whitespace")
"""Separators that are tried; the one that gives the most columns of numbers is taken."""
LOOKED_AT = 400
"""Most lines in which the first row of numbers is looked for (a count)."""
LEAST_NUMBERS = 0.8
"""Least share of the cells of a row of numbers that are numbers or empty [-]; the others may be
words, such as the name of a phase."""
NUMBER = re.compile(r"[-+]?(\d+([.,]\d*)?|[.,]\d+)([eE][-+]?\d+)?|nan|n/a|", re.I)
"""A cell of a row of numbers: a number, or one that is missing. The patterns below are of column
names in English and German, and what they find is marked for checking."""
TIME = re.compile(r"t|time.*|zeit.*|(time)?stamps?|elapsed.*|clock|sec(onds)?", re.I)
COMMAND = re.compile(
    r"cmd|command|soll|set[ _]?point|desired|reference|target|goal"
    r"|(^|_)[cu]_?\d|[ _]set($|[ _])|(^|_)p?set[ _]?\w|(^|[ _])(ref|des)($|[ _])",
    re.I,
)
ACTUATION = re.compile(
    r"press|druck|pneu|valve|ventil|motor|servo|tendon|cable|chamber|kammer|bellow|actuat|(^|_)p_?\w$",
    re.I,
)
NOT_MEASURED = re.compile(r"target|goal|soll|reference|desired|predict|\bvel|\bacc", re.I)
"""Words in the names of positions that are no measured ones."""
RUN = re.compile(r"(run|take|trial|episode|repeat|rep)([_ ]?(id|nr|no|number|index))?", re.I)
AN_X = re.compile(r"(?<![A-Za-z])[xX](?![A-Za-z])|(?<=[a-z0-9])X(?![a-z])")
"""An x that stands for the axis: `x0`, `tip_x`, `tipX`."""
AN_AXIS = re.compile(r"(^|[_ .])[xyz]($|[_ .\d])", re.I)
"""An axis in the name of a position."""


A_PLACE = re.compile(r"((\.\d+)+)$")
"""The place of a column in an array of several columns: `.2` of `tip_cm.2`."""


@dataclass(frozen=True)
class _Layout:
    """How a file is laid out."""

    names: tuple[str, ...]
    """Names of the columns."""
    separator: str = ","
    decimal: str = "."
    skip_rows: int = 0
    """Lines before the header, or before the numbers where the header is not read."""
    header: bool = True
    """Whether the line before the numbers is the header."""
    paths: bool = False
    """Whether the names are paths of arrays and their columns, as in MATLAB and HDF5 files."""
    topic: str = ""
    """The group or struct to which the draft limits the file."""
    groups: tuple[str, ...] = ()
    """All groups or structs that hold the same columns as that one."""

    def label(self, name: str) -> str:
        """Part of a column's name that describes it: of a path, the name of the array."""
        return A_PLACE.sub("", name).rpartition(".")[2] if self.paths else name


def draft_map(path: str | Path) -> str:
    """The text of a map for a raw file, to be checked by a person.

    Raises InputError for a file that no reader reads, for one without rows of numbers, and where no
    columns of key points are recognised.
    """
    path = Path(path)
    try:
        layout = _layout(path) if chosen(path, FileRole()) is TEXT else _table_layout(path)
    except InputError as error:
        named = no_text(path, error)
        if named is None:
            raise
        raise named from error
    names = layout.names
    points = [*_key_points(names), *(_key_point_arrays(layout) if layout.paths else [])]
    if not points:
        shown = ", ".join(name for name in names[:12] if name)
        raise InputError(
            f"{path}: no columns x, y, z of key points are recognised among {shown or 'unnamed'}; "
            "write the map by hand, docs/recordings.md has one to start from"
        )
    labels = [layout.label(name) for name in names]
    used = {column for point in points for column in point}
    time = next(
        (k for k, n in enumerate(labels) if TIME.fullmatch(_split(n, SECONDS_PER)[0].strip())), None
    )
    used |= set() if time is None else {time}
    rest = [k for k, name in enumerate(names) if name and k not in used]
    commanded = [k for k in rest if _is_command(labels[k])]
    measured = [k for k in rest if k not in commanded and _is_actuation(labels[k])]
    lines = [
        f"# Draft of a map for {path.name}, from the names of its columns. Check every line:",
        "# units, the order of the channels, the key points from base to tip, the frame.",
        "# docs/recordings.md explains all fields.",
        "",
        *_file(layout),
        "[time]",
    ]
    column = _columns(layout)
    if time is None:
        lines += ["rate_hz = 20.0  # check: no column of time is recognised", ""]
    else:
        unit = _unit([labels[time]], SECONDS_PER, "s")
        lines += [f"column = {column([time])[0]}", f"unit = {unit}", ""]
    doubt = "" if commanded else "  # check: measured by sensors? Set values are [commanded]"
    if commanded and not measured:
        measured = commanded
        doubt = "  # check: set values stand in, no sensor is here; fit with --actuation commanded"
    for table, found in ((f"[measured]{doubt}", measured), ("[commanded]", commanded)):
        if found:
            unit = _unit([labels[k] for k in found], (*ACTUATION_UNITS, *MM_PER), "kPa")
            lines += [table, f"columns = [{', '.join(column(found))}]", f"unit = {unit}"]
            lines += ['# to = "kPa"  # the unit of your model, if it is another one', ""]
    if not measured and not commanded:
        lines += ["# [measured]  # check: no columns of the actuation are recognised", ""]
    triples = ", ".join(f"[{', '.join(column(point))}]" for point in points)
    lines += [
        "[key_points]  # check: from base to tip",
        f"positions = [{triples}]",
        f"unit = {_unit([labels[k] for point in points for k in point], MM_PER, 'mm')}",
        "",
        "# [frame]  # check: the recording's z points along the arm at rest, away from the base",
        '# rotation = "x z -y"  # our x is your x, our y your z, our z minus your y',
        '# origin = "k0"',
        "# gravity = [0, -1, 0]  # direction of weight in your frame",
    ]
    runs = next((k for k in rest if RUN.fullmatch(labels[k]) and k not in commanded), None)
    if runs is not None:
        lines += [
            "",
            "[runs]  # check: a new value begins a new run",
            f"column = {column([runs])[0]}",
        ]
    unused = [names[k] for k in rest if k not in (*measured, *commanded, runs)]
    if unused:
        lines += ["", f"# not used: {', '.join(unused)}"]
    return "\n".join(lines) + "\n"


def _table_layout(path: Path) -> _Layout:
    """The layout of a file that a reader turns into columns with names.

    Of several groups with the same arrays, such as one for each run, the draft takes the first.
    """
    names = open_raw(path, FileRole()).names
    arrays: dict[str, list[str]] = {}
    for name in names:
        group, dot, rest = name.partition(".")
        arrays.setdefault(group, []).append(rest if dot else "")
    first = next(iter(arrays))
    groups = tuple(group for group, inside in arrays.items() if inside == arrays[first])
    if len(groups) > 1 and any(re.search(r"[^\d.]", name) for name in arrays[first]):
        return _Layout(tuple(arrays[first]), paths=True, topic=first, groups=groups)
    return _Layout(tuple(names), paths=True)


def _layout(path: Path) -> _Layout:
    """The layout with the most columns of numbers."""
    text = read_text(path).decode("utf-8", errors="replace")
    lines = text.lstrip("\ufeff").splitlines()[:LOOKED_AT]
    best, most = None, 1
    for separator in SEPARATORS:
        rows = [_cells(line, separator) for line in lines]
        numbers = [
            bool(line.strip()) and _numeric(row) for line, row in zip(lines, rows, strict=True)
        ]
        first = next((k for k, numeric in enumerate(numbers) if numeric and len(rows[k]) > 1), None)
        if first is not None and len(rows[first]) > most:
            best, most = (separator, rows, first), len(rows[first])
    if best is None:
        raise InputError(
            f"{path}: no rows of numbers are recognised, expected a text file of columns; "
            "docs/recordings.md lists the other formats"
        )
    separator, rows, first = best
    comma = separator != "," and any(
        "," in cell for row in rows[first:] if _numeric(row) for cell in row
    )
    above = [k for k in range(first) if any(cell.strip("# ") for cell in rows[k])]
    head = above[-1] if above else None
    units: list[str] = []
    if len(above) > 1 and _all_units(rows[above[-1]]) and len(rows[above[-2]]) == most:
        units, head = rows[above[-1]], above[-2]
    if head is None or len(rows[head]) != most or (head + 1 < first and not units):
        head = None
    if head is None:
        return _Layout(("",) * most, separator, "," if comma else ".", first, False)
    names = [name.strip().removeprefix("#").strip().strip('"') for name in rows[head]]
    if units:
        names = [f"{name} [{unit.strip('[]() ')}]" for name, unit in zip(names, units, strict=True)]
    return _Layout(
        tuple(names), separator, "," if comma else ".", first if units else head, not units
    )


def _cells(line: str, separator: str) -> list[str]:
    return line.split() if separator == "whitespace" else line.rstrip(separator).split(separator)


def _numeric(row: Sequence[str]) -> bool:
    """Whether most cells are numbers, and not all are empty."""
    numbers = [NUMBER.fullmatch(cell.strip().strip('"')) is not None for cell in row]
    return sum(numbers) >= LEAST_NUMBERS * len(row) and any(
        any(c.isdigit() for c in cell) for cell in row
    )


def _all_units(row: Sequence[str]) -> bool:
    """Whether a line below the header holds units."""
    known = {unit.lower() for unit in (*SECONDS_PER, *MM_PER, *ACTUATION_UNITS)}
    found = [cell.strip().strip('[]()#" ').lower() for cell in row]
    return any(found) and all(cell in known or cell in ("", "-") for cell in found)


def _split(name: str, units: Iterable[str]) -> tuple[str, str]:
    """A column's name without its unit, and the unit; empty where it names none of `units`."""
    match = re.fullmatch(r"(.*?)[ _.]*[\[(]([^\])]*)[\])]", name) or re.fullmatch(
        r"(.*)[ _.]([A-Za-z%]+)", name
    )
    if match:
        for unit in units:
            if match[2].lower() == unit.lower():
                return match[1], unit
    return name, ""


def _key_points(names: Sequence[str]) -> list[tuple[int, int, int]]:
    """Columns x, y, z of each measured point, counted from 0, in the order of the file.

    Where several columns have one name, the second x belongs to the second y and z.
    """
    places: dict[str, list[int]] = {}
    for k, name in enumerate(names):
        places.setdefault(name, []).append(k)
    found = []
    for k, name in enumerate(names):
        stem = _split(name, MM_PER)[0]
        for match in AN_X.finditer(stem):
            put = [
                name[: match.start()]
                + (axis if match[0] == "x" else axis.upper())
                + name[match.end() :]
                for axis in "yz"
            ]
            if all(other in places for other in put) and not NOT_MEASURED.search(name):
                nth = places[name].index(k)
                y, z = (places[other][min(nth, len(places[other]) - 1)] for other in put)
                found.append((k, y, z))
                break
    return found


def _key_point_arrays(layout: _Layout) -> list[tuple[int, int, int]]:
    """Columns x, y, z of the points in arrays of three columns each, in the order of the file."""
    arrays: dict[str, list[int]] = {}
    for column, name in enumerate(layout.names):
        if A_PLACE.search(name):
            arrays.setdefault(A_PLACE.sub("", name), []).append(column)
    found = []
    for array, columns in arrays.items():
        label = layout.label(array)
        ours = ACTUATION.search(label) or COMMAND.search(label) or NOT_MEASURED.search(label)
        in_mm = bool(_split(label, MM_PER)[1])
        if len(columns) % 3 == 0 and not ours and (in_mm or not _is_actuation(label)):
            found += [
                (columns[k], columns[k + 1], columns[k + 2]) for k in range(0, len(columns), 3)
            ]
    return found


def _is_command(name: str) -> bool:
    """Whether a column is an actuation that was asked for, and no position that was."""
    stem = _split(name, ACTUATION_UNITS)[0]
    wanted = NOT_MEASURED.search(name) and not re.search("soll", name, re.I)
    position = wanted or AN_AXIS.search(stem) or _split(name, MM_PER)[1]
    return COMMAND.search(stem) is not None and (_is_actuation(name) or not position)


def _is_actuation(name: str) -> bool:
    stem, unit = _split(name, ACTUATION_UNITS)
    return bool(unit) or ACTUATION.search(stem) is not None


def _unit(names: Sequence[str], units: Iterable[str], otherwise: str) -> str:
    """The unit of columns as TOML, marked where their names state none, or several."""
    found = list(dict.fromkeys(unit for name in names if (unit := _split(name, units)[1])))
    if not found:
        return f'"{otherwise}"  # check: the header names no unit'
    more = "" if len(found) == 1 else f"  # check: the header names {', '.join(found)}"
    return f'"{found[0]}"{more}'


def _columns(layout: _Layout) -> Callable[[Sequence[int]], list[str]]:
    """Function that gives columns, counted from 0, as TOML: by name, or by number where names
    cannot be used."""

    def columns(places: Sequence[int]) -> list[str]:
        names = [layout.names[k] for k in places]
        if layout.header and all(layout.names.count(name) == 1 for name in names):
            return [json.dumps(name, ensure_ascii=False) for name in names]
        return [str(k + 1) for k in places]

    return columns


def _file(layout: _Layout) -> list[str]:
    """The table [file.main] where the layout is not the usual one."""
    lines = []
    if layout.topic:
        more = ", ".join(layout.groups[1:4]) + (", ..." if len(layout.groups) > 4 else "")
        lines.append(
            f"topic = {json.dumps(layout.topic)}  # check: as many arrays are in {more}; a map "
            "reads one group, so import each by a map of its own"
        )
    if layout.separator != ",":
        lines.append(f"separator = {json.dumps(layout.separator)}")
    if layout.decimal != ".":
        lines.append(f'decimal = "{layout.decimal}"')
    if layout.skip_rows:
        lines.append(f"skip_rows = {layout.skip_rows}")
    if not layout.header:
        named = ", ".join(f"{k} {name}" for k, name in enumerate(layout.names, 1) if name)
        lines.append(f"header = false{f'  # columns: {named}' if named else ''}")
    return ["[file.main]", *lines, ""] if lines else []
