"""The map file of an import as frozen dataclasses; docs/recordings.md describes every field.

A map describes how a laboratory's files become recordings: which files, columns, units and frame.
`load_map` reads one; surgisoft/config.py gives every bad field its line.
"""

import math
import re
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from surgisoft.config import (
    POSITIVE,
    Rule,
    Where,
    at_least,
    describe,
    from_table,
    one_of,
    parse_toml,
    read_toml,
)
from surgisoft.errors import InputError
from surgisoft.measurement.importing.raw import TIME_UNIT, Column, FileRole
from surgisoft.measurement.importing.readers import ADVICE, AUTO, NOT_READ, formats, reader
from surgisoft.measurement.importing.ready_maps import READY_MAPS
from surgisoft.measurement.importing.rotation import parse_rotation
from surgisoft.measurement.recordings import ArmInfo
from surgisoft.measurement.recordings.columns import MM_PER
from surgisoft.measurement.recordings.sidecar import (
    UNIT_VECTOR,
    GravityTable,
    RecordingTable,
    Sidecar,
)
from surgisoft.measurement.units import check_conversion


def _not_empty(value: Any) -> bool:
    return len(value) > 0


def _is_expression(text: str) -> bool:
    try:
        return re.compile(text).groups >= 1
    except re.error:
        return False


Position = Annotated[
    tuple[Column, Column, Column] | str, Rule("three columns or a name", _not_empty)
]
"""Columns of x, y, z, or the name of a motion capture file's body or marker."""
Quaternion = Annotated[
    tuple[Column, Column, Column, Column] | str, Rule("four columns or a name", _not_empty)
]
"""Columns of a quaternion, or the name of a motion capture file's body."""
Plane = Annotated[
    tuple[Position, ...],
    Rule("at least three markers (columns or names)", lambda markers: len(markers) >= 3),
]
"""The markers on a circle around a key point."""
Expression = Annotated[str, Rule("a regular expression with one group", _is_expression)]
Unit = Annotated[
    str,
    Rule(
        'letters and digits only, such as "kPa"',
        lambda text: re.fullmatch(r"[A-Za-z%][A-Za-z0-9%]*", text) is not None,
    ),
]
PerChannel = Annotated[
    float | tuple[float, ...],
    Rule("one number, or one per channel", lambda value: value != ()),
]
PERMUTATION = Rule(
    "each of the numbers 0, 1, ... once", lambda order: sorted(order) == [*range(len(order))]
)
NUMBERS = Rule("numbers >= 0", lambda some: min(some, default=0) >= 0)


@dataclass(frozen=True)
class TimeMap:
    """Table [time] of a map: source of the time."""

    column: Column | None = None
    """Column of the main file."""
    unit: Annotated[str, TIME_UNIT] = "s"
    """A unit of time, or "iso" for dates such as 2024-05-01T12:00:00.25."""
    scale: Annotated[float, POSITIVE] = 1.0
    """Factor of all times of the column, for a clock whose unit has no name here."""
    rate_hz: Annotated[float, POSITIVE] | None = None
    """Nominal rate where there are no time stamps [Hz]; with a column, the column counts frames."""
    zero: Annotated[str, one_of(("file", "recording", "none"))] = "file"
    """"file": each file starts at 0; "recording": the first one does; "none": as it is."""

    def checked(self, where: Where) -> "TimeMap":
        """The table itself; raises InputError unless it has a column or a rate."""
        if self.column is None and self.rate_hz is None:
            raise where.error("neither column nor rate_hz", "a column, a rate, or both")
        if self.rate_hz is not None and self.unit != "s":
            raise (where / "unit").error(
                f"got {describe(self.unit)}", "none beside rate_hz, which states seconds already"
            )
        if self.scale != 1.0 and (self.rate_hz is not None or self.unit == "iso"):
            raise (where / "scale").error(
                f"got {self.scale:g}", "none beside rate_hz or dates, which state seconds already"
            )
        return self


@dataclass(frozen=True)
class ActuationMap:
    """Table [measured] or [commanded] of a map: columns of the actuation."""

    file: str = ""
    """Role of the file; empty: the main file."""
    columns: Annotated[tuple[Column, ...], Rule("a list of columns", _not_empty)] = ()
    """One a channel; none: the columns that are named as in a recording (p1_kPa or c1_kPa)."""
    unit: Unit = ""
    """Unit of the columns."""
    to: str = ""
    """Unit to convert to; empty: as it is."""
    scale: PerChannel | None = None
    """Value = scale * cell + offset, one for all channels or one each."""
    offset: PerChannel | None = None
    """See `scale`."""
    delay_s: float = 0.0
    """Delay of this log: the value logged at t was true at t - delay_s [s]. Positive where the
    body seems to move before its actuation."""
    repeated: Annotated[str, one_of(("keep", "interpolate"))] = "keep"
    """Readings of a sensor that is slower than the log: "keep" them held until the next one, or
    "interpolate" between readings."""
    optional: bool = False
    """Whether [commanded] counts only where the file has columns named as in a recording."""

    def checked(self, where: Where) -> "ActuationMap":
        """The table itself; raises InputError for missing units or numbers that do not fit."""
        if self.columns and self.optional:
            raise (where / "optional").error("got true", "none beside columns, which are required")
        if self.columns and not self.unit:
            raise (where / "unit").error("missing", 'the columns\' unit such as "kPa"')
        if self.to and self.unit:
            check_conversion(self.unit, self.to, where / "to")
        for name in ("scale", "offset"):
            value = getattr(self, name)
            if self.columns and isinstance(value, tuple) and len(value) not in (1, self.channels):
                raise (where / name).error(
                    f"got {describe([*value])}", f"one number, or {self.channels}, one per channel"
                )
        return self

    @property
    def channels(self) -> int:
        """Number of columns."""
        return len(self.columns)


@dataclass(frozen=True)
class PointMap:
    """Table [[key_points.point]] of a map: one key point fixed to a rigid body."""

    position: Position
    """Position of the body, or of the key point itself."""
    quaternion: Quaternion | None = None
    """Orientation of the body, where `offset` is used."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Key point in the axes of the body, relative to its position [unit of the positions]."""

    def checked(self, where: Where) -> "PointMap":
        """The table itself; raises InputError for an offset without an orientation."""
        if any(self.offset) and self.quaternion is None:
            raise (where / "quaternion").error(
                "missing", "the body's orientation, since there is an offset"
            )
        return self


@dataclass(frozen=True)
class KeyPointsMap:
    """Table [key_points] of a map: the key points, base to tip."""

    file: str = ""
    """Role of the file; empty: the main file."""
    positions: tuple[Position, ...] = ()
    """Three columns, or one name, a key point."""
    markers: tuple[Plane, ...] = ()
    """Markers on the rim of each key point's plane; the key point is the centre of their circle."""
    point: tuple[PointMap, ...] = ()
    """Key points fixed to rigid bodies."""
    auto: Annotated[str, one_of(("planes", "bodies"))] | None = None
    """"planes" (circle fit of each group of markers) or "bodies": all that the file has."""
    pattern: Expression = r"(.+):"
    """For `auto`: the first group of this expression, in a marker's name, names its plane."""
    unit: Annotated[str, one_of(MM_PER)] | None = None
    """Unit of the positions; none: as the file states."""
    quaternion_order: Annotated[str, one_of(("xyzw", "wxyz"))] = "xyzw"
    """Order of quaternions' columns: "xyzw" or "wxyz"."""
    repeated: Annotated[str, one_of(("keep", "missing"))] = "keep"
    """Positions that repeat bit-equal: "keep" them, or "missing" where mocap is slower."""
    spikes: Annotated[str, one_of(("keep", "missing"))] = "keep"
    """Key points that jump away and back within a few rows: "keep" or "missing"."""
    max_residual_mm: Annotated[float, POSITIVE] = math.inf
    """A circle that misses its markers by more (rms) is a missing key point [mm]."""
    scale: Annotated[float, POSITIVE] = 1.0
    """Factor of all positions, for files whose unit has no name here."""
    order: Annotated[tuple[int, ...], PERMUTATION] = ()
    """Base to tip, the number from 0 of each key point among those given; none: as given."""
    lost: Annotated[tuple[int, ...], NUMBERS] = ()
    """Numbers from 0, among those given, of key points whose tracker is dead: they are missing."""

    def checked(self, where: Where) -> "KeyPointsMap":
        """The table itself; raises InputError unless the key points have exactly one source."""
        names = ("positions", "markers", "point", "auto")
        given = [name for name in names if getattr(self, name)]
        if len(given) != 1:
            raise where.error(
                f"got {' and '.join(given) or 'nothing'}", f"exactly one of {', '.join(names)}"
            )
        return self


@dataclass(frozen=True)
class BaseMap:
    """Table [frame.base] of a map: a body fixed to the arm's base, which determines the frame."""

    position: Position
    """Position of the body."""
    quaternion: Quaternion
    """Orientation of the body."""
    mode: Annotated[str, one_of(("fixed", "rest", "moving"))] = "fixed"
    """"fixed": average over the file; "rest": over its first rows; "moving": row by row."""


@dataclass(frozen=True)
class FrameMap:
    """Table [frame] of a map: from raw positions to the arm base frame.

    Applied in the order base, origin, rotation, align_z.
    """

    base: BaseMap | None = None
    """Body at the arm's base, if one is tracked."""
    origin: Annotated[
        tuple[float, float, float] | str,
        Rule('three numbers or "k0"', lambda value: value == "k0" or not isinstance(value, str)),
    ] = (0.0, 0.0, 0.0)
    """Subtracted [unit of the positions], or "k0": key point 0 at rest."""
    rotation: Any = "x y z"
    """Arm's axes in the raw frame: signed axes, a 3x3 matrix of rows, or a quaternion xyzw."""
    mirror: bool = False
    """Whether the raw frame is left-handed, so that `rotation` must swap handedness."""
    align_z: Annotated[str, one_of(("rest",))] | None = None
    """"rest": finally rotate so that the arm at rest points along z."""
    gravity: Annotated[tuple[float, float, float], UNIT_VECTOR] | None = None
    """(3,) direction of the weight in the raw frame."""
    rest_rows: Annotated[int, at_least(1)] = 20
    """The arm is at rest during this many first rows."""

    def checked(self, where: Where) -> "FrameMap":
        """The table itself; raises InputError for an invalid rotation."""
        parse_rotation(self.rotation, where / "rotation", self.mirror)
        return self

    @cached_property
    def matrix(self) -> np.ndarray:
        """(3, 3) rotation matrix, whose rows are the arm's axes in the raw frame."""
        return parse_rotation(self.rotation, Where(Path("frame")), self.mirror)


@dataclass(frozen=True)
class RowsMap:
    """Table [rows] of a map: which rows to import."""

    first: Annotated[int, at_least(1)] = 1
    """First row of the main file, counted from 1 without the header."""
    last: int | None = None
    """Last row of the main file to import; none: all."""
    every: Annotated[int, at_least(1)] = 1
    """Keep each n-th row of a run, from its first."""
    repeated_time: Annotated[str, one_of(("error", "drop"))] = "error"
    """Rows whose time does not increase over the row before: "error" or "drop"."""
    duplicates: Annotated[str, one_of(("keep", "drop"))] = "keep"
    """Rows equal to the one before in every value but the time: "keep" or "drop"."""
    frozen: Annotated[str, one_of(("keep", "drop"))] = "keep"
    """Rows in which measured actuation is frozen: "keep" or "drop"."""
    average: Column | None = None
    """Column whose equal values mark rows that are averaged into one steady-state sample."""

    def checked(self, where: Where) -> "RowsMap":
        """The table itself; raises InputError if the last row precedes the first."""
        if self.last is not None and self.last < self.first:
            raise (where / "last").error(f"got {self.last}", f"an integer >= {self.first}")
        return self


@dataclass(frozen=True)
class RunsMap:
    """Table [runs] of a map: what starts a new run, in addition to a new file."""

    column: Column | None = None
    """Column in which a new value starts a run."""
    gap_s: Annotated[float, POSITIVE] | None = None
    """Longest gap in time within a run [s]."""
    time_restarts: bool = False
    """Whether time that jumps back starts a run."""


@dataclass(frozen=True)
class ContextSource:
    """Source of a context value: a column, or a number in the file's name."""

    column: Column | None = None
    """Column of the main file."""
    from_name: Expression | None = None
    """Expression whose first group in the main file's name is the number."""
    otherwise: float | None = None
    """Value where the name has no number."""

    def checked(self, where: Where) -> "ContextSource":
        """The table itself; raises InputError unless it has exactly one source."""
        if (self.column is None) == (self.from_name is None):
            raise where.error("got a table", A_CONTEXT.expected)
        return self


A_CONTEXT = Rule("a number, {column = ...} or {from_name = ...}", lambda _: True)


@dataclass(frozen=True)
class ContextMap:
    """Table [context] of a map: temperature and payload, constant or from a source."""

    temp_C: Annotated[float | ContextSource, A_CONTEXT] | None = None
    """Temperature of the room, degrees Celsius."""
    payload_g: Annotated[float | ContextSource, A_CONTEXT] | None = None
    """Known mass at the tip, g."""


@dataclass(frozen=True, kw_only=True)
class ImportMap:
    """Content of a map file."""

    file: Annotated[dict[str, FileRole], Rule("at least one table [file.NAME]", _not_empty)] = (
        field(default_factory=lambda: {"main": FileRole()})
    )
    """Roles by name; the first one is the main file, whose rows are the samples."""
    time: TimeMap
    """Source of the time."""
    measured: ActuationMap
    """Measured actuation."""
    commanded: ActuationMap | None = None
    """Commanded actuation, if it was logged."""
    key_points: KeyPointsMap
    """Key points, base to tip."""
    frame: FrameMap = FrameMap()
    """From raw positions to the arm base frame."""
    rows: RowsMap = RowsMap()
    """Which rows to import."""
    runs: RunsMap = RunsMap()
    """What starts a new run."""
    context: ContextMap = ContextMap()
    """Temperature and payload."""
    arm: ArmInfo = field(default_factory=ArmInfo)
    """The arm, as in a recording's sidecar."""
    gravity: GravityTable = field(default_factory=GravityTable)
    """Direction of gravity, as in a recording's sidecar."""
    recording: RecordingTable = field(default_factory=RecordingTable)
    """Kind, noise and note, as in a recording's sidecar."""

    @property
    def main(self) -> str:
        """Name of the main file's role."""
        return next(iter(self.file))

    @property
    def sidecar(self) -> dict[str, Any]:
        """Fields of the recording that the map states: arm, kind, noise_mm, note, gravity."""
        return Sidecar(self.arm, self.gravity, self.recording).fields

    def checked(self, where: Where) -> "ImportMap":
        """Roles that are named exist, and sections that name none get the main file."""
        main = self.file[self.main]
        for name, role in self.file.items():
            _check_format(role.format, where / "file" / name / "format")
        if main.join == "time" or main.offset_rows:
            raise (where / "file" / self.main).error(
                "the first file is the main one", "join and offset_rows at the others only"
            )
        if self.measured.optional:
            raise (where / "measured" / "optional").error(
                "got true", "none: every recording has a measured actuation"
            )
        if self.commanded and self.commanded.repeated != "keep":
            raise (where / "commanded" / "repeated").error(
                f"got {describe(self.commanded.repeated)}",
                '"keep": a command is held until the next one',
            )
        for part, name in (
            (self.measured, "measured"),
            (self.commanded, "commanded"),
            (self.key_points, "key_points"),
        ):
            if part and part.file and part.file not in self.file:
                raise (where / name / "file").error(
                    f"got {describe(part.file)}", f"one of {', '.join(self.file)}"
                )
        key_points = replace(self.key_points, file=self.key_points.file or self.main)
        found = self.file[key_points.file or self.main]
        states_unit = found.format != AUTO and reader(found.format).states_unit
        if self.key_points.unit is None and not states_unit:
            raise (where / "key_points" / "unit").error(
                "missing", f"the positions' unit, one of {', '.join(MM_PER)}"
            )
        return replace(
            self,
            measured=replace(self.measured, file=self.measured.file or self.main),
            commanded=self.commanded
            and replace(self.commanded, file=self.commanded.file or self.main),
            key_points=key_points,
        )


def _check_format(name: str, where: Where) -> None:
    known = formats()
    if name not in known:
        kind = NOT_READ.get(name.lower())
        came = f"got {describe(name)}" + (f", {kind}, for which there is no reader" if kind else "")
        expected = f"one of {', '.join(known)}" + (f"; {ADVICE}" if kind else "")
        raise where.error(came, expected)


def load_map(name: str) -> ImportMap:
    """The map of this path, or the ready map of this name."""
    if name in READY_MAPS:
        where = Where(Path(f"ready map '{name}'"), READY_MAPS[name])
        return from_table(ImportMap, parse_toml(where.text, where.path), where)
    path = Path(name)
    if not path.exists():
        raise InputError(
            f"{path}: no such map, expected a TOML file or one of the ready maps "
            f"{', '.join(READY_MAPS)}"
        )
    return from_table(ImportMap, *read_toml(path))
