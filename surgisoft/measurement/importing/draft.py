"""A draft of a map file from the names of the columns of one raw file, or of several together.

Of a text file the draft also has the separator and the decimal sign. What a name does not say (a
unit, the frame) is marked for the person who checks the draft. Names of columns that another reader
makes are paths, such as `run1.tip_cm.0` in a MATLAB or HDF5 file.
"""

import fnmatch
import glob
import itertools
import json
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from surgisoft.errors import InputError
from surgisoft.measurement.importing.raw import LEAST_NUMBERS, FileRole
from surgisoft.measurement.importing.readers import chosen, no_text, open_raw
from surgisoft.measurement.importing.readers.text import READER as TEXT
from surgisoft.measurement.recordings.columns import MM_PER
from surgisoft.measurement.tables import read_text
from surgisoft.measurement.units import ACTUATION_UNITS, SECONDS_PER

SEPARATORS = (";", "\t", ",", "whitespace")
"""Separators that are tried; the one that gives the most columns of numbers is taken."""
LOOKED_AT = 400
"""Most lines in which the first row of numbers is looked for (a count)."""
SHOWN = 12
"""Most names of columns that a message lists (a count)."""
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


LENGTH_UNIT = re.compile(
    r"(?:length|position|distance)[ _]?units?\s*[,;:=\t]\s*\"?(\w+)|^units?\s*[,;:=\t]\s*\"?(\w+)",
    re.I | re.M,
)
"""The unit of length in the lines above a header, as motion capture writes it."""
LENGTH_NAMES = {
    "meters": "m",
    "metres": "m",
    "centimeters": "cm",
    "centimetres": "cm",
    "millimeters": "mm",
    "millimetres": "mm",
    "inches": "in",
}
"""Units of length by the words for them."""
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
    length_unit: str = ""
    """Unit of length that the lines above the header state; empty: none."""

    def label(self, name: str) -> str:
        """Part of a column's name that describes it: of a path, the name of the array."""
        return A_PLACE.sub("", name).rpartition(".")[2] if self.paths else name


@dataclass(frozen=True)
class MapDraft:
    """A draft of a map, and what it lacks."""

    text: str
    """The map as TOML, to be checked by a person."""
    lacks: tuple[str, ...]
    """Required tables for which no columns are recognised: "measured", "key_points"."""

    @property
    def checks(self) -> int:
        """Number of lines that are marked `check`."""
        return self.text.count("# check:")


@dataclass(frozen=True)
class _Recognised:
    """A raw file and what its columns are taken for; columns are counted from 0."""

    path: Path
    """The file."""
    layout: _Layout
    """Its layout."""
    time: int | None
    """Column of the time."""
    points: list[tuple[int, int, int]]
    """Columns x, y, z of each key point."""
    measured: list[int]
    """Columns of the measured actuation."""
    commanded: list[int]
    """Columns of the commanded actuation."""
    by_command: bool
    """Whether the measured columns are recognised only because their names are like those of the
    command."""
    runs: int | None
    """Column in which a new value begins a new run."""

    def named(self, columns: Sequence[int]) -> list[str]:
        """The columns as TOML."""
        return _columns(self.layout)(columns)

    def labels(self, columns: Sequence[int]) -> list[str]:
        """The parts of the columns' names that describe them."""
        return [self.layout.label(self.layout.names[k]) for k in columns]


def draft_map(path: str | Path | Sequence[str | Path]) -> str:
    """The text of a map for raw files, to be checked by a person; see `draft_of_map`."""
    return draft_of_map([path] if isinstance(path, str | Path) else path).text


def draft_of_map(paths: Sequence[str | Path]) -> MapDraft:
    """A draft of the map for one raw file, or for the files of one recording, joined by time.

    The first file with key points becomes the main file. Raises InputError for a file that no
    reader reads, for one without rows of numbers, where neither key points nor an actuation are
    recognised, and for files that a map cannot tell apart or that are of one kind.
    """
    found = [_recognised(Path(path)) for path in paths]
    if not found:
        raise InputError("no raw file given, expected at least one")
    if not any(each.points or each.measured or each.commanded for each in found):
        raise _nothing_recognised(found)
    _check_kinds(found)
    main = next((each for each in found if each.points), found[0])
    files = [main, *(each for each in found if each is not main)]
    patterns = _patterns([each.path for each in files])
    roles = dict(zip(patterns, files, strict=True)) if len(files) > 1 else {"": main}
    several = len(files) > 1
    lines = [
        f"# Draft of a map for {' and '.join(each.path.name for each in files)}, "
        "from the names of the columns. Check every line:",
        "# units, the order of the channels, the key points from base to tip, the frame.",
        "# docs/recordings.md explains all fields.",
        "",
    ]
    for role, each in roles.items():
        joined = _joined_by(each, main) if each is not main else []
        lines += _file(each.layout, role or "main", patterns[role] if several else "", joined)
    lines += ["[time]"]
    if main.time is None:
        lines += ["rate_hz = 20.0  # check: no column of time is recognised", ""]
    else:
        unit = _unit(main.labels([main.time]), SECONDS_PER, "s")
        lines += [f"column = {main.named([main.time])[0]}", f"unit = {unit}", ""]
    sensed = _first(roles, lambda each: bool(each.measured) and not each.by_command)
    sensed = sensed or _first(roles, lambda each: bool(each.measured))
    wanted = _first(roles, lambda each: bool(each.commanded))
    lines += _actuation(sensed, wanted, several)
    if not sensed and not wanted:
        lines += ["# [measured]  # check: no columns of the actuation are recognised;"]
        lines += _to_add("columns = [...]  # a column per channel", 'unit = "kPa"')
    lines += _key_points_table(main)
    if main.runs is not None:
        lines += [
            "",
            "[runs]  # check: a new value begins a new run",
            f"column = {main.named([main.runs])[0]}",
        ]
    for role, each in roles.items():
        used = {each.time} if each is not main else {each.time, each.runs}
        used |= {column for point in each.points for column in point} if each is main else set()
        used |= {*each.measured} if sensed and sensed[0] == role else set()
        used |= {*each.commanded} if wanted and wanted[0] == role else set()
        unused = [name for k, name in enumerate(each.layout.names) if name and k not in used]
        if unused:
            of = f" of {each.path.name}" if several else ""
            lines += ["", f"# not used{of}: {', '.join(unused)}"]
    lacks = (
        *(() if sensed or wanted else ("measured",)),
        *(() if main.points else ("key_points",)),
    )
    return MapDraft("\n".join(lines) + "\n", lacks)


def _recognised(path: Path) -> _Recognised:
    """What the columns of a raw file are taken for."""
    try:
        layout = _layout(path) if chosen(path, FileRole()) is TEXT else _table_layout(path)
    except InputError as error:
        named = no_text(path, error)
        if named is None:
            raise
        raise named from error
    names = layout.names
    points = [*_key_points(names), *(_key_point_arrays(layout) if layout.paths else [])]
    labels = [layout.label(name) for name in names]
    used = {column for point in points for column in point}
    time = next(
        (k for k, n in enumerate(labels) if TIME.fullmatch(_split(n, SECONDS_PER)[0].strip())), None
    )
    used |= set() if time is None else {time}
    rest = [k for k, name in enumerate(names) if name and k not in used]
    commanded = [k for k in rest if _is_command(labels[k])]
    measured = [k for k in rest if k not in commanded and _is_actuation(labels[k])]
    alike = [] if measured else _called_as(commanded, rest, labels)
    runs = next((k for k in rest if RUN.fullmatch(labels[k]) and k not in commanded), None)
    return _Recognised(path, layout, time, points, measured or alike, commanded, bool(alike), runs)


def _called_as(commanded: Sequence[int], rest: Sequence[int], labels: Sequence[str]) -> list[int]:
    """The columns that are called as the commanded ones but for one text, such as `reg` of `regA1`
    and `regA2` for `set` of `setA1` and `setA2`; none where several texts or none fit."""
    wanted = [labels[k] for k in commanded]
    if len(wanted) < 2:
        return []
    before = len(_common_start(wanted))
    after = len(_common_start([name[before:][::-1] for name in wanted]))
    own = [name[before : len(name) - after] for name in wanted]
    others = {labels[k]: k for k in rest if k not in commanded}
    texts = {
        (name[: match.start()], name[match.end() :])
        for name in others
        for match in re.finditer(re.escape(own[0]), name)
    }
    fit = [
        [others[first + channel + last] for channel in own]
        for first, last in sorted(texts)
        if all(first + channel + last in others for channel in own)
    ]
    return fit[0] if len(fit) == 1 and all(own) else []


def _common_start(texts: Sequence[str]) -> str:
    """The longest start that all texts have."""
    pairs = zip(min(texts), max(texts), strict=False)
    return "".join(a for a, _ in itertools.takewhile(lambda pair: pair[0] == pair[1], pairs))


def _nothing_recognised(found: Sequence[_Recognised]) -> InputError:
    """The error where the files show neither key points nor an actuation."""
    names = [name for each in found for name in each.layout.names if name]
    more = f" and {len(names) - SHOWN} more" if len(names) > SHOWN else ""
    shown = f"{', '.join(names[:SHOWN])}{more}" if names else "unnamed columns"
    advice = "write the map by hand, docs/recordings.md has one to start from"
    if not names:
        advice = (
            "write the map by hand, with header = false in [file.NAME] and the columns by their "
            "numbers, counted from 1; docs/recordings.md has one to start from"
        )
    places = ", ".join(str(each.path) for each in found)
    return InputError(
        f"{places}: no columns x, y, z of key points are recognised among {shown}, and none of an "
        f"actuation; {advice}"
    )


def _check_kinds(found: Sequence[_Recognised]) -> None:
    """Raise where two files are of one kind, or have one name."""
    for first, second in itertools.combinations(found, 2):
        if first.path.name == second.path.name:
            raise InputError(
                f"{first.path} and {second.path}: files of one name, which a map cannot tell "
                "apart, expected names that differ; rename one of them"
            )
        if any(first.layout.names) and first.layout.names == second.layout.names:
            raise InputError(
                f"{first.path} and {second.path}: the same columns, expected one file of each "
                "kind; draft the map from the files of one recording, it fits the others too"
            )


def _patterns(paths: Sequence[Path]) -> dict[str, str]:
    """For each file a name of its table in the map, and the pattern of such files' names.

    A start or an end that all names share up to a mark, such as `take7_` of `take7_air.csv` and
    `take7_cam.csv`, is that of one recording: the pattern has `*` in its place.
    """
    stems = [path.name.partition(".")[0] or path.name for path in paths]
    ends = [path.name[len(stem) :] for path, stem in zip(paths, stems, strict=True)]
    start = re.match(r"(.*[_\-. ])?", _common_start(stems))
    last = re.match(r"(.*[_\-. ])?", _common_start([stem[::-1] for stem in stems]))
    before, after = (len(match[0]) if match else 0 for match in (start, last))
    after = 0 if before else after
    own = [stem[before : len(stem) - after] for stem in stems]
    patterns = [
        f"{'*' if before else ''}{stem[max(before - 1, 0) : len(stem) - max(after - 1, 0)]}"
        f"{'*' if after else ''}{end}"
        for stem, end in zip(stems, ends, strict=True)
    ]
    if any(
        fnmatch.fnmatch(path.name, pattern) != (k == j)
        for k, path in enumerate(paths)
        for j, pattern in enumerate(patterns)
    ):
        patterns = [glob.escape(path.name) for path in paths]
    roles = [re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_") for name in own]
    if not all(roles) or len({*roles}) < len(roles):
        roles = [f"file{k}" for k in range(1, len(paths) + 1)]
    return dict(zip(roles, patterns, strict=True))


def _first(
    roles: dict[str, _Recognised], has: Callable[[_Recognised], bool]
) -> tuple[str, _Recognised] | None:
    """The first file that has something, with its name in the map."""
    return next(((role, each) for role, each in roles.items() if has(each)), None)


def _joined_by(file: _Recognised, main: _Recognised) -> list[str]:
    """The fields by which the rows of a file belong to those of the main file."""
    if file.time is None:
        return [
            'join = "rows"  # check: no column of time is recognised, so row i belongs to row i of '
            f"{main.path.name}"
        ]
    lines = [
        'join = "time"',
        f"time = {file.named([file.time])[0]}",
        f"time_unit = {_unit(file.labels([file.time]), SECONDS_PER, 's')}",
    ]
    if main.time is None:
        return [
            *lines,
            f'clock = "from_start"  # check: {main.path.name} has no time; starts both files at 0',
        ]
    return [*lines, '# clock = "from_start"  # where the two clocks count from different moments']


def _actuation(
    sensed: tuple[str, _Recognised] | None, wanted: tuple[str, _Recognised] | None, several: bool
) -> list[str]:
    """The tables [measured] and [commanded]; sensed, wanted: the files that have their columns."""
    doubt = "" if wanted else "  # check: measured by sensors? Set values are [commanded]"
    if sensed and sensed[1].by_command:
        doubt = "  # check: taken for measured values, because the names are like the command's"
    if not sensed and wanted:
        doubt = "  # check: set values stand in, no sensor is here; fit with --actuation commanded"
    lines = []
    tables = (
        (f"[measured]{doubt}", sensed or wanted, sensed is not None),
        ("[commanded]", wanted, False),
    )
    for table, source, by_sensors in tables:
        if source is None:
            continue
        role, file = source
        columns = file.measured if by_sensors else file.commanded
        unit = _unit(file.labels(columns), (*ACTUATION_UNITS, *MM_PER), "kPa")
        lines += [table, *([f'file = "{role}"'] if several else [])]
        lines += [f"columns = [{', '.join(file.named(columns))}]", f"unit = {unit}"]
        lines += ['# to = "kPa"  # the unit of your model, if it is another one', ""]
    return lines


def _key_points_table(main: _Recognised) -> list[str]:
    """The table [key_points], and the fields of [frame] as comments."""
    triples = ", ".join(f"[{', '.join(main.named(point))}]" for point in main.points)
    stated = main.layout.length_unit
    unit = _unit(main.labels([k for point in main.points for k in point]), MM_PER, "mm", stated)
    lines = ["[key_points]  # check: from base to tip", f"positions = [{triples}]"]
    lines += [f"unit = {unit}", ""]
    if not main.points:
        lines = ["# [key_points]  # check: no columns x, y, z of key points are recognised;"]
        example = '["x0", "y0", "z0"]' if main.layout.header else "[1, 2, 3]"
        lines += _to_add(f"positions = [{example}, ...]  # base to tip", 'unit = "mm"')
    return [
        *lines,
        "# [frame]  # check: the recording's z points along the arm at rest, away from the base",
        '# rotation = "x z -y"  # our x is your x, our y your z, our z minus your y',
        '# origin = "k0"',
        "# gravity = [0, -1, 0]  # direction of weight in your frame",
    ]


def _to_add(*fields: str) -> list[str]:
    """Lines of a required table that the files do not show, as comments to be filled in."""
    return [
        "# import needs this table: fill it in, or draft the map from all files of one recording",
        *(f"# {field}" for field in fields),
        "",
    ]


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
    stated = _stated_length("\n".join(lines[:head]))
    names = [name.strip().removeprefix("#").strip().strip('"') for name in rows[head]]
    if units:
        names = [f"{name} [{unit.strip('[]() ')}]" for name, unit in zip(names, units, strict=True)]
    return _Layout(
        tuple(names),
        separator,
        "," if comma else ".",
        first if units else head,
        not units,
        length_unit=stated,
    )


def _stated_length(above: str) -> str:
    """The unit of length that lines above a header state; empty where they state none."""
    found = LENGTH_UNIT.search(above)
    word = (found[1] or found[2]).lower() if found else ""
    return LENGTH_NAMES.get(word, word if word in MM_PER else "")


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


def _unit(names: Sequence[str], units: Iterable[str], otherwise: str, stated: str = "") -> str:
    """The unit of columns as TOML, marked where their names state none, or several.

    stated: the unit that the lines above the header state, for columns whose names state none.
    """
    found = list(dict.fromkeys(unit for name in names if (unit := _split(name, units)[1])))
    if not found and stated:
        return f'"{stated}"  # as the lines above the header say'
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


def _file(layout: _Layout, role: str, match: str, joined: Sequence[str]) -> list[str]:
    """The table [file.ROLE], where the layout is not the usual one or the map has several files.

    match: pattern of the names, empty where there is one file; joined: fields of the join.
    """
    lines = [f"match = {json.dumps(match, ensure_ascii=False)}"] if match else []
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
    lines += joined
    return [f"[file.{role}]", *lines, ""] if lines else []
