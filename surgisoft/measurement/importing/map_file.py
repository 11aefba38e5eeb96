"""Units that raw files come in, and conversion between units of one quantity."""

import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np

from surgisoft.config import Where, read_toml
from surgisoft.errors import InputError
from surgisoft.measurement.importing import section as read
from surgisoft.measurement.importing.rotation import parse_rotation
from surgisoft.measurement.importing.section import Section
from surgisoft.measurement.importing.spec import (
    ActuationMap,
    BaseMap,
    ContextMap,
    FileRole,
    FrameMap,
    ImportMap,
    KeyPointsMap,
    PointMap,
    RowsMap,
    RunsMap,
    TimeMap,
)
from surgisoft.measurement.recordings.columns import MM_PER
from surgisoft.measurement.recordings.sidecar import parse_sidecar

SECONDS_PER = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0, "h": 3600.0}
"""Seconds in each unit of time."""

_KPA_PER = {
    "Pa": 1e-3,
    "hPa": 0.1,
    "kPa": 1.0,
    "MPa": 1e3,
    "mbar": 0.1,
    "bar": 100.0,
    "psi": 6.894757293168361,  # 0.45359237 kg * 9.80665 m/s2 / (0.0254 m)^2, NIST SP 811 (2008) B.8
    "atm": 101.325,  # NIST SP 811 (2008) B.8
    "mmHg": 0.133322387415,  # 13595.1 kg/m3 * 9.80665 m/s2 * 1 mm, NIST SP 811 (2008) B.8
}
_DEGREES_PER = {"deg": 1.0, "rad": 57.29577951308232, "rev": 360.0}
_MM_PER = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}
_VOLTS_PER = {"V": 1.0, "mV": 1e-3}
_NEWTONS_PER = {"N": 1.0, "mN": 1e-3, "kN": 1e3}
_QUANTITIES = (_KPA_PER, _DEGREES_PER, _MM_PER, _VOLTS_PER, _NEWTONS_PER)


def factor(unit: str, to: str) -> float | None:
    """How many of `to` one `unit` is; None where they do not measure the same quantity."""
    if unit == to:
        return 1.0
    for quantity in _QUANTITIES:
        if unit in quantity and to in quantity:
            return quantity[unit] / quantity[to]
    return None


def check_conversion(unit: str, to: str, where: Where) -> None:
    """Raise where a unit cannot be converted."""
    if factor(unit, to) is None:
        known = next((q for q in _QUANTITIES if unit in q), None)
        expected = (
            f"one of {', '.join(known)}, to convert from '{unit}'"
            if known
            else f"'{unit}' itself, a unit that nothing converts to; use scale and offset"
        )
        raise where.error(f"got '{to}'", expected)


_MOTIVE = """# OptiTrack Motive's CSV export and the log of the actuation, matched by time.
#
#   surgisoft import take.csv log.csv --map motive -o recording.parquet
#
# The log is a CSV table with the columns t_s, p1_kPa, p2_kPa, ... (and c1_kPa, ... where there is
# a command); its clock starts with the take's.

[file.take]
format = "motive"

[file.log]
match = "*.csv"
join = "time"             # linear interpolation between the log's rows; the command is held
clock = "from_start"      # both clocks count from their first row
max_gap_s = 1.0           # longer gaps in the log are left out

[time]
column = "Time"

[measured]
file = "log"              # every column named p1_UNIT, p2_UNIT, ...

[commanded]
file = "log"              # every column named c1_UNIT, ..., if there are any

[key_points]
@AUTO@

[frame]
origin = "k0"             # the first plane at rest is the base
align_z = "rest"          # z from the base to the tip at rest
gravity = [0, -1, 0]      # Motive's y points up
rest_rows = 20            # the arm rests during the first rows

[recording]
note = "OptiTrack Motive"
"""

_PLANES = """auto = "planes"           # circle fit of three or more markers a plane,
pattern = '(.+):'         # which are named PLANE:MARKER; planes in the order of their names"""

_BODIES = """auto = "bodies"           # pivot of every rigid body, in the order of their names"""

READY_MAPS = {
    "motive": _MOTIVE.replace("@AUTO@", _PLANES),
    "motive-bodies": _MOTIVE.replace("@AUTO@", _BODIES),
}
"""TOML text of each ready map."""


def load_map(name: str) -> ImportMap:
    """The map of this path, or the ready map of this name."""
    if name in READY_MAPS:
        text = READY_MAPS[name]
        return parse_map(tomllib.loads(text), Where(Path(f"ready map '{name}'"), text))
    path = Path(name)
    if not path.exists():
        raise InputError(
            f"{path}: no such map, expected a TOML file or one of the ready maps "
            f"{', '.join(READY_MAPS)}"
        )
    return parse_map(*read_toml(path))


def parse_map(content: dict[str, Any], where: Where) -> ImportMap:
    """The map out of a TOML file's content."""
    top = Section(content, where)
    files = _files(top)
    main = files[0].name
    parsed = ImportMap(
        files=files,
        time=_time(top, main),
        measured=_actuation(top, "measured", files),
        commanded=_actuation(top, "commanded", files) if "commanded" in content else None,
        key_points=_key_points(top, files),
        frame=_frame(top),
        rows=_rows(top),
        runs=_runs(top),
        context=_context(top),
        sidecar=_sidecar(top),
    )
    top.known.append("commanded")
    top.close()
    return parsed


def _files(top: Section) -> tuple[FileRole, ...]:
    section = top.sub("file")
    if section is None:
        return (FileRole("main"),)
    roles = []
    for name in section.content:
        part = section.sub(name)
        default = FileRole(name)
        roles.append(
            FileRole(
                name=name,
                match=part.text("match", default.match),
                format=part.choice("format", "auto", ("auto", "text", "parquet", "motive")),
                separator=part.take(
                    "separator", ",", "one character or 'whitespace'", read.as_separator
                ),
                decimal=part.choice("decimal", ".", (".", ",")),
                header=part.flag("header", True),
                skip_rows=part.integer("skip_rows", 0, least=0),
                comment=part.text("comment", ""),
                missing=part.take("missing", (), "a list of texts", read.as_texts),
                join=part.choice("join", "rows", ("rows", "time")),
                offset_rows=part.integer("offset_rows", 0),
                unpaired=part.choice("unpaired", "error", ("error", "drop")),
                time=part.column("time", default.time),
                time_unit=part.choice("time_unit", "s", (*SECONDS_PER, "iso")),
                clock_offset_s=part.number("clock_offset_s", 0.0),
                clock=part.choice("clock", "shared", ("shared", "from_start")),
                interpolate=part.choice("interpolate", "linear", ("linear", "previous")),
                max_gap_s=part.number("max_gap_s", default.max_gap_s, least=0.0),
            )
        )
        part.close()
    if not roles:
        raise top.error("file", "at least one table [file.NAME]")
    if roles[0].join == "time" or roles[0].offset_rows:
        raise (section.where / roles[0].name).error(
            "the first file is the main one", "join and offset_rows at the others only"
        )
    return tuple(roles)


def _file_name(section: Section, files: tuple[FileRole, ...]) -> str:
    names = tuple(role.name for role in files)
    return section.choice("file", names[0], names)


def _needed(top: Section, name: str) -> Section:
    section = top.sub(name)
    if section is None:
        raise top.error(name, f"a table [{name}]")
    return section


def _time(top: Section, main: str) -> TimeMap:
    section = _needed(top, "time")
    column = section.column("column", None)
    rate = section.number("rate_hz", None, least=0.0)
    if column is None and rate is None:
        raise section.where.error("neither column nor rate_hz", "a column, a rate, or both")
    unit = section.choice("unit", "s", (*SECONDS_PER, "iso"))
    zero = section.choice("zero", "file", ("file", "recording", "none"))
    section.close()
    return TimeMap(file=main, column=column, unit=unit, rate_hz=rate, zero=zero)


def _actuation(top: Section, name: str, files: tuple[FileRole, ...]) -> ActuationMap:
    section = _needed(top, name)
    columns = section.take("columns", (), "a list of columns", read.as_columns)
    parsed = ActuationMap(
        file=_file_name(section, files),
        columns=columns,
        unit=section.text("unit", ""),
        to=section.text("to", ""),
        scale=section.take("scale", (), "a number or a number a channel", read.as_numbers),
        offset=section.take("offset", (), "a number or a number a channel", read.as_numbers),
        delay_s=section.number("delay_s", 0.0),
        repeated=section.choice("repeated", "keep", ("keep", "interpolate")),
    )
    section.close()
    if name == "commanded" and parsed.repeated != "keep":
        raise section.error("repeated", '"keep": a command is held until the next one')
    if columns and not parsed.unit:
        raise section.error("unit", 'the columns\' unit such as "kPa"')
    if parsed.unit and not re.fullmatch(r"[A-Za-z%][A-Za-z0-9%]*", parsed.unit):
        raise section.error("unit", 'letters and digits only, such as "kPa"')
    if parsed.to and parsed.unit:
        check_conversion(parsed.unit, parsed.to, section.where / "to")
    for what in ("scale", "offset"):
        count = len(getattr(parsed, what))
        if columns and count > 1 and count != len(columns):
            raise section.error(what, f"one number, or {len(columns)}, one a channel")
    return parsed


def _key_points(top: Section, files: tuple[FileRole, ...]) -> KeyPointsMap:
    section = _needed(top, "key_points")
    order = section.choice("quaternion_order", "xyzw", ("xyzw", "wxyz"))
    auto = section.choice("auto", "", ("planes", "bodies"))
    points = (*_positions(section), *_markers(section), *_single_points(section))
    given = [n for n in ("positions", "markers", "point", "auto") if n in section.content]
    if len(given) != 1:
        raise section.where.error(
            f"got {' and '.join(given) or 'nothing'}",
            "exactly one of positions, markers, point, auto",
        )
    parsed = KeyPointsMap(
        file=_file_name(section, files),
        points=points,
        auto=auto,
        pattern=section.take(
            "pattern",
            KeyPointsMap.pattern,
            "a regular expression with one group",
            read.as_expression,
        ),
        unit=section.choice("unit", "", tuple(MM_PER)),
        quaternion_order=order,
        repeated=section.choice("repeated", "keep", ("keep", "missing")),
        spikes=section.choice("spikes", "keep", ("keep", "missing")),
        max_residual_mm=section.number("max_residual_mm", np.inf, least=0.0),
    )
    section.close()
    if not parsed.unit and not any(role.format == "motive" for role in files):
        raise section.error("unit", f"the positions' unit, one of {', '.join(MM_PER)}")
    return parsed


def _positions(section: Section) -> tuple[PointMap, ...]:
    def as_points(value: object) -> tuple[PointMap, ...] | None:
        triples = [read.as_columns_of(3)(v) for v in value] if isinstance(value, list) else []
        if not triples or None in triples:
            return None
        return tuple(PointMap((triple,)) for triple in triples)

    return section.take(
        "positions", (), "a list of three columns (or one name) a key point", as_points
    )


def _markers(section: Section) -> tuple[PointMap, ...]:
    def as_points(value: object) -> tuple[PointMap, ...] | None:
        planes = value if isinstance(value, list) else []
        read_planes = [
            [read.as_columns_of(3)(marker) for marker in plane]
            if isinstance(plane, list)
            else [None]
            for plane in planes
        ]
        if not planes or any(None in plane or len(plane) < 3 for plane in read_planes):
            return None
        return tuple(PointMap(tuple(plane)) for plane in read_planes)

    return section.take(
        "markers",
        (),
        "a list of planes, each of at least three markers (columns or names)",
        as_points,
    )


def _single_points(section: Section) -> tuple[PointMap, ...]:
    section.known.append("point")
    content = section.content.get("point", [])
    if not isinstance(content, list):
        raise section.error("point", "tables [[key_points.point]]")
    points = []
    for i, item in enumerate(content):
        part = Section(item, section.where / "point" / i)
        position = part.take("position", None, "three columns or a name", read.as_columns_of(3))
        quaternion = part.take("quaternion", (), "four columns or a name", read.as_columns_of(4))
        offset = part.vector("offset", (0.0, 0.0, 0.0))
        if position is None:
            raise part.error("position", "three columns or a name")
        if any(offset) and not quaternion:
            raise part.error("quaternion", "the body's orientation, since there is an offset")
        part.close()
        points.append(PointMap((position,), quaternion, offset))
    return tuple(points)


def _frame(top: Section) -> FrameMap:
    section = top.sub("frame")
    if section is None:
        return FrameMap()
    mirror = section.flag("mirror", False)
    rotation = section.take("rotation", np.eye(3), "a rotation", lambda v: v)
    if not isinstance(rotation, np.ndarray):
        rotation = parse_rotation(rotation, section.where / "rotation", mirror)
    gravity = section.vector("gravity", None)
    if gravity is not None and abs(np.linalg.norm(gravity) - 1) > 0.01:
        raise section.error("gravity", "a unit vector")
    parsed = FrameMap(
        base=_base(section),
        origin=section.take(
            "origin",
            (0.0, 0.0, 0.0),
            'three numbers or "k0"',
            lambda v: v if v == "k0" else read.as_vector(v),
        ),
        rotation=rotation,
        align_z=section.choice("align_z", "", ("rest",)),
        gravity=gravity,
        rest_rows=section.integer("rest_rows", 20, least=1),
    )
    section.close()
    return parsed


def _base(section: Section) -> BaseMap | None:
    part = section.sub("base")
    if part is None:
        return None
    position = part.take("position", None, "three columns or a name", read.as_columns_of(3))
    quaternion = part.take("quaternion", None, "four columns or a name", read.as_columns_of(4))
    mode = part.choice("mode", "fixed", ("fixed", "rest", "moving"))
    part.close()
    if position is None or quaternion is None:
        missing = "position" if position is None else "quaternion"
        raise part.error(missing, "both position and quaternion of the base body")
    return BaseMap(position, quaternion, mode)


def _rows(top: Section) -> RowsMap:
    section = top.sub("rows")
    if section is None:
        return RowsMap()
    first = section.integer("first", 1, least=1)
    parsed = RowsMap(
        first=first,
        last=section.integer("last", None, least=first),
        every=section.integer("every", 1, least=1),
        repeated_time=section.choice("repeated_time", "error", ("error", "drop")),
        duplicates=section.choice("duplicates", "keep", ("keep", "drop")),
        frozen=section.choice("frozen", "keep", ("keep", "drop")),
        average=section.column("average", None),
    )
    section.close()
    return parsed


def _runs(top: Section) -> RunsMap:
    section = top.sub("runs")
    if section is None:
        return RunsMap()
    parsed = RunsMap(
        column=section.column("column", None),
        gap_s=section.number("gap_s", None, least=0.0),
        time_restarts=section.flag("time_restarts", False),
    )
    section.close()
    return parsed


def _context(top: Section) -> dict[str, ContextMap]:
    section = top.sub("context")
    if section is None:
        return {}
    parsed = {}
    for name in ("temp_C", "payload_g"):
        section.known.append(name)
        if name not in section.content:
            continue
        if read.is_number(section.content[name]):
            parsed[name] = ContextMap(value=float(section.content[name]))
            continue
        part = Section(section.content[name], section.where / name)
        parsed[name] = ContextMap(
            value=part.number("otherwise", None),
            column=part.column("column", None),
            from_name=part.take(
                "from_name", "", "a regular expression with one group", read.as_expression
            ),
        )
        part.close()
        if (parsed[name].column is None) == (not parsed[name].from_name):
            raise section.error(name, "a number, {column = ...} or {from_name = ...}")
    section.close()
    return parsed


def _sidecar(top: Section) -> dict[str, Any]:
    content = {}
    for name in ("arm", "gravity", "recording"):
        top.known.append(name)
        if name in top.content:
            content[name] = top.content[name]
    return parse_sidecar(content, str(top.where.path))
