"""What a map file can say, as frozen dataclasses; docs/recordings.md describes every field."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

Column = str | int
"""A column by its name or, counted from 1, by its number."""


@dataclass(frozen=True)
class FileRole:
    """One kind of raw file: how it is written and how its rows belong to the main file's."""

    name: str
    """Name of the role, as the columns' sections refer to it."""
    match: str = "*"
    """Pattern of the file names that have this role."""
    format: str = "auto"
    """"text", "parquet", "motive" or "auto" (by the name's ending)."""
    separator: str = ","
    """One character, or "whitespace"."""
    decimal: str = "."
    """Decimal sign of text files."""
    header: bool = True
    """Whether a line of column names comes first."""
    skip_rows: int = 0
    """Lines before the header, or before the numbers where there is no header."""
    comment: str = ""
    """Lines that start with this are passed over."""
    missing: tuple[str, ...] = ()
    """Texts that mean a missing value, besides the empty cell and NaN."""
    join: str = "rows"
    """"rows": row by row with the main file; "time": matched by time."""
    offset_rows: int = 0
    """Row i of this file belongs to row i + offset_rows of the main file."""
    unpaired: str = "error"
    """What is done with rows at the end that have no partner: "error" or "drop"."""
    time: Column = "t_s"
    """Time column of a file that is joined by time."""
    time_unit: str = "s"
    """Unit of that column."""
    clock_offset_s: float = 0.0
    """Added to this file's times to get the main file's clock [s]."""
    clock: str = "shared"
    """"shared", or "from_start": both files' times count from their first row."""
    interpolate: str = "linear"
    """Between this file's rows: "linear" or "previous"."""
    max_gap_s: float = 1.0
    """Samples that fall into a longer gap of this file are dropped [s]."""


@dataclass(frozen=True)
class TimeMap:
    """Where the time comes from."""

    file: str
    column: Column | None = None
    """Column of the main file."""
    unit: str = "s"
    """A unit of time, or "iso" for dates such as 2024-05-01T12:00:00.25."""
    rate_hz: float | None = None
    """Nominal rate where there are no time stamps [Hz]; with a column, the column counts frames."""
    zero: str = "file"
    """"file": each file starts at 0; "recording": the first one does; "none": as it is."""


@dataclass(frozen=True)
class ActuationMap:
    """Columns of the measured or commanded actuation."""

    file: str
    columns: tuple[Column, ...] = ()
    """One a channel; none: the columns that are named as in a recording (p1_kPa or c1_kPa)."""
    unit: str = ""
    """Unit of the columns."""
    to: str = ""
    """Unit to convert to; empty: as it is."""
    scale: tuple[float, ...] = ()
    """Value = scale * cell + offset, one for all channels or one each."""
    offset: tuple[float, ...] = ()
    delay_s: float = 0.0
    """By how much this log is late: what stands at t was true at t - delay_s [s]. Positive where
    the body seems to move before its actuation."""
    repeated: str = "keep"
    """Readings of a sensor that is slower than the log: "keep" them held until the next one, or
    "interpolate" between readings."""


@dataclass(frozen=True)
class PointMap:
    """One key point: a position, or at least three markers on a circle around it."""

    positions: tuple[tuple[Column, Column, Column] | str, ...]
    """One entry for a position, three or more for markers; a text names a body or marker."""
    quaternion: tuple[Column, Column, Column, Column] | str = ()
    """Orientation of the body, where `offset` is used."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Key point in the body's own axes, relative to its position [unit of the positions]."""


@dataclass(frozen=True)
class KeyPointsMap:
    """The key points, base to tip."""

    file: str
    points: tuple[PointMap, ...] = ()
    auto: str = ""
    """"planes" (circle fit of each group of markers) or "bodies": all that a Motive file has."""
    pattern: str = r"(.+):"
    """For auto: the first group of this expression, in a marker's name, is its plane."""
    unit: str = ""
    """Unit of the positions; empty: as the Motive file says."""
    quaternion_order: str = "xyzw"
    """Order of quaternions' columns: "xyzw" or "wxyz"."""
    repeated: str = "keep"
    """Positions that repeat bit-equal: "keep" them, or "missing" where mocap is slower."""
    spikes: str = "keep"
    """Key points that jump away and back within a few rows: "keep" or "missing"."""
    max_residual_mm: float = np.inf
    """A circle that misses its markers by more (rms) is a missing key point [mm]."""


@dataclass(frozen=True)
class BaseMap:
    """A body fixed to the arm's base, whose pose sets the frame."""

    position: tuple[Column, Column, Column] | str
    quaternion: tuple[Column, Column, Column, Column] | str
    mode: str = "fixed"
    """"fixed": average over the file; "rest": over its first rows; "moving": row by row."""


@dataclass(frozen=True, eq=False)
class FrameMap:
    """From raw positions to the arm's base frame, in this order: base, origin, rotation, align."""

    base: BaseMap | None = None
    origin: tuple[float, float, float] | str = (0.0, 0.0, 0.0)
    """Subtracted [unit of the positions], or "k0": key point 0 at rest."""
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    """(3, 3); arm = rotation @ raw."""
    align_z: str = ""
    """"rest": turn z onto the line from key point 0 (or the origin) to the tip at rest."""
    gravity: tuple[float, float, float] | None = None
    """Direction of weight in the raw frame."""
    rest_rows: int = 20
    """Rows at the start of a file where the arm is at rest."""


@dataclass(frozen=True)
class RowsMap:
    """Which rows are kept."""

    first: int = 1
    """First row of the main file, counted from 1 without the header."""
    last: int | None = None
    """Last row that is kept."""
    every: int = 1
    """Keep each n-th row."""
    repeated_time: str = "error"
    """Rows whose time does not increase over the row before: "error" or "drop"."""
    duplicates: str = "keep"
    """Rows equal to the one before in every value but the time: "keep" or "drop"."""
    frozen: str = "keep"
    """Rows in which measured actuation is frozen: "keep" or "drop"."""
    average: Column | None = None
    """Column whose equal values mark rows that are averaged into one settled point."""


@dataclass(frozen=True)
class RunsMap:
    """What starts a new run besides a new file."""

    column: Column | None = None
    """A new value in this column."""
    gap_s: float | None = None
    """A gap in time longer than this [s]."""
    time_restarts: bool = False
    """Time that jumps back."""


@dataclass(frozen=True)
class ContextMap:
    """A constant, a column, or a number in the file's name."""

    value: float | None = None
    column: Column | None = None
    from_name: str = ""
    """Expression whose first group in the main file's name is the number."""


@dataclass(frozen=True)
class ImportMap:
    """The whole map."""

    files: tuple[FileRole, ...]
    """Roles; the first one is the main file, whose rows are the samples."""
    time: TimeMap
    measured: ActuationMap
    commanded: ActuationMap | None
    key_points: KeyPointsMap
    frame: FrameMap
    rows: RowsMap
    runs: RunsMap
    context: dict[str, ContextMap]
    """By the recording's column: temp_C, payload_g."""
    sidecar: dict[str, Any]
    """Fields of the recording that the map states: arm, kind, noise_mm, note, gravity."""

    def role(self, name: str) -> FileRole:
        """The role of this name."""
        return next(role for role in self.files if role.name == name)
