"""The actuation's clock: values between rows, logs that are late, readings that were held."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import numpy as np

from surgisoft.errors import InputError
from surgisoft.measurement.importing.raw import Column, FileRole, RawTable
from surgisoft.measurement.importing.rotation import between
from surgisoft.measurement.importing.spec import ImportMap
from surgisoft.measurement.units import SECONDS_PER

SAME_TIME_S = 1e-6
"""Times that differ by no more are the same [s]."""
EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
"""Date from which times of dates count; a date without an offset is taken for UTC."""
UNIT_RATIOS = (1e3, 1e6, 1e9, 1e-3, 1e-6, 1e-9)
"""How many times as long one log seems as another where s, ms, us and ns are confused."""
SAME_LENGTH = 2.0
"""Largest ratio of the lengths of two logs of one experiment."""
LARGEST_GAP_S = 1.0
"""Longest gap of a late log within which it is still read [s]."""


@dataclass(frozen=True, eq=False)
class Between:
    """Where each time (T,) lies between the rows (R,) of a log."""

    before: np.ndarray
    """(T,) index of the row before or at it."""
    after: np.ndarray
    """(T,) index of the row after it."""
    share: np.ndarray
    """(T,) how far between them, 0 to 1; exactly 0 or 1 on a row, up to SAME_TIME_S."""
    gap_s: np.ndarray
    """(T,) time between the two rows [s]; 0 on a row."""
    inside: np.ndarray
    """(T,) bool: not before the first row nor after the last."""

    @classmethod
    def of(cls, log_s: np.ndarray, t_s: np.ndarray) -> "Between":
        """Places of times t_s (T,) among a log's increasing times (R,) [s]."""
        before = np.searchsorted(log_s, t_s + SAME_TIME_S, side="right") - 1
        before = np.clip(before, 0, max(len(log_s) - 2, 0))
        after = np.minimum(before + 1, len(log_s) - 1)
        gap = log_s[after] - log_s[before]
        share = np.clip((t_s - log_s[before]) / np.where(gap > 0, gap, 1.0), 0, 1)
        share[np.abs(t_s - log_s[before]) <= SAME_TIME_S] = 0
        share[np.abs(t_s - log_s[after]) <= SAME_TIME_S] = 1
        inside = (t_s >= log_s[0] - SAME_TIME_S) & (t_s <= log_s[-1] + SAME_TIME_S)
        return cls(before, after, share, np.where((share == 0) | (share == 1), 0.0, gap), inside)

    def linear(self, values: np.ndarray) -> np.ndarray:
        """(T, c) of the log's values (R, c), on a line between the two rows."""
        first, second = values[self.before], values[self.after]
        share = self.share[:, None]
        line = first + share * (second - first)
        return np.where(share == 0, first, np.where(share == 1, second, line))

    def held(self, values: np.ndarray) -> np.ndarray:
        """(T, c) of the log's values (R, c), each held until the next row."""
        on_next = (self.share == 1)[:, None]
        return np.where(on_next, values[self.after], values[self.before])


def renewed_rows(values: np.ndarray) -> np.ndarray:
    """(F,) rows of values (T, m) that differ from the row before in any column, and the first."""
    return np.flatnonzero(np.r_[True, (values[1:] != values[:-1]).any(axis=1)])


def renewal_s(parts: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """The usual (median) time between two readings [s], of (times (T,), values (T, m)) by run.

    0 where no run has two readings.
    """
    by_run = [np.diff(t_s[renewed_rows(values)]) for t_s, values in parts]
    steps = np.concatenate([np.empty(0), *by_run])
    return float(np.median(steps)) if len(steps) else 0.0


def without_holds(t_s: np.ndarray, values: np.ndarray, period_s: float) -> np.ndarray:
    """(T, m) readings that were held until the next one, on a line between them instead.

    t_s: (T,) [s]; values: (T, m). A reading that repeats for much longer than the period in which
    the sensor is read was renewed with the same value meanwhile: it stays until one period before
    the next one. The last reading of all stays to the end.
    """
    fresh = renewed_rows(values)
    times, known = [t_s[fresh]], [values[fresh]]
    start, end = fresh[:-1], fresh[1:]
    long = t_s[end] - t_s[start] > 1.5 * period_s
    times.append(t_s[end[long]] - period_s)
    known.append(values[start[long]])
    log_s, rows = np.concatenate(times), np.concatenate(known)
    order = np.argsort(log_s, kind="stable")
    return Between.of(log_s[order], np.minimum(t_s, log_s.max())).linear(rows[order])


@dataclass(frozen=True, eq=False)
class Joined:
    """Raw columns of one set of files, joined to one row per sample."""

    main: RawTable
    """The main file, whose rows are the samples."""
    rows: np.ndarray
    """(T,) row of the main file, counted from 0, of each sample."""
    t_s: np.ndarray
    """(T,) the main file's clock [s]."""
    columns: dict[tuple[str, Column], np.ndarray]
    """(T,) by role and column; NaN where missing."""
    notes: list[str]
    """What was done, in words."""

    def take(self, role: str, columns: Sequence[Column]) -> np.ndarray:
        """(T, len(columns)) of one role."""
        return np.column_stack([self.columns[role, column] for column in columns])

    def texts(self, column: Column) -> list[str]:
        """(T,) cells of a column of the main file as they are written."""
        cells = self.main.texts(column)
        return [cells[row] for row in self.rows]


def join(
    tables: dict[str, RawTable],
    spec: ImportMap,
    held: set[tuple[str, Column]],
    needed: dict[str, list[Column]],
    turns: dict[str, list[tuple[Column, ...]]],
) -> Joined:
    """One row a sample of the needed columns by role.

    `held` ones are not interpolated; `turns` are the quaternions among them, by role.
    """
    main_role, *_ = spec.file
    others = {name: role for name, role in spec.file.items() if name != main_role}
    others = {name: role for name, role in others.items() if needed.get(name)}
    main = tables[main_role]
    values = {name: tables[name].numbers(columns) for name, columns in needed.items() if columns}
    count = len(values[main_role]) if main_role in values else None
    t_s = main_times(main, spec, count)
    rows = np.arange(len(t_s))
    notes = [f"{table.path}: {note}" for table in tables.values() for note in table.notes]
    picks: dict[str, np.ndarray] = {}
    keep = np.ones(len(rows), bool)
    for name, role in others.items():
        if role.join == "rows":
            picks[name] = rows - role.offset_rows
            keep &= _paired(role, tables[name], main, len(rows), len(values[name]), notes)
    columns = _columns(main_role, needed, values, rows)
    for name, role in others.items():
        if role.join == "rows":
            pick = np.clip(picks[name], 0, len(values[name]) - 1)
            columns |= _columns(name, needed, values, pick)
        else:
            wanted, table = needed[name], tables[name]
            held_here = [(name, column) in held for column in wanted]
            turned = [[wanted.index(c) for c in turn] for turn in turns.get(name, [])]
            matched, inside = _by_time(role, table, t_s, values[name], held_here, turned)
            columns |= _columns(name, needed, {name: matched}, rows)
            keep &= inside
            _note_time_join(role, table, main, inside, notes)
    if not keep.any():
        by_time = [name for name, role in others.items() if role.join == "time"]
        why = notes if len(by_time) < len(others) else []
        why = [*why, *(_apart(spec, name, tables[name], main, t_s) for name in by_time)]
        raise InputError(
            f"{main.path}: no row is left after joining the files, expected common rows or times"
            + "".join(f"; {text}" for text in why)
        )
    first, last = spec.rows.first, spec.rows.last or len(rows)
    keep &= (rows + 1 >= first) & (rows + 1 <= last)
    if not keep.any():
        raise InputError(
            f"{main.path}: none of its {len(rows)} rows is left by [rows] of the map (first = "
            f"{first}, last = {last}), expected rows of the file that the other files have, too"
        )
    if keep.all():
        return Joined(main, rows, t_s, columns, notes)
    columns = {key: column[keep] for key, column in columns.items()}
    return Joined(main, rows[keep], t_s[keep], columns, notes)


def _columns(
    role: str, needed: dict[str, list[Column]], values: dict[str, np.ndarray], pick: np.ndarray
) -> dict[tuple[str, Column], np.ndarray]:
    names = needed.get(role, [])
    return {(role, name): values[role][pick, i] for i, name in enumerate(names)}


def _paired(
    role: FileRole, table: RawTable, main: RawTable, rows: int, other_rows: int, notes: list[str]
) -> np.ndarray:
    """(rows,) bool: which rows of the main file have a partner, row i - offset_rows."""
    partner = np.arange(rows) - role.offset_rows
    keep = (partner >= 0) & (partner < other_rows)
    left = rows - (other_rows + role.offset_rows)
    if left and role.unpaired == "error":
        longer, by = (main, left) if left > 0 else (table, -left)
        raise InputError(
            f"{longer.path}: {by} rows at the end have no partner ({main.path} has {rows} rows, "
            f"{table.path} {other_rows}, offset_rows {role.offset_rows}), expected the ends to "
            'meet; set offset_rows, or unpaired = "drop" in the map'
        )
    if role.offset_rows:
        ahead, of = (main, table) if role.offset_rows > 0 else (table, main)
        notes.append(
            f"first {abs(role.offset_rows)} rows of {ahead.path} have no partner in {of.path} "
            "(offset_rows), left out"
        )
    if left:
        longer, by = (main, left) if left > 0 else (table, -left)
        notes.append(f"last {by} rows of {longer.path} have no partner, left out")
    return keep


def _by_time(
    role: FileRole,
    table: RawTable,
    t_s: np.ndarray,
    values: np.ndarray,
    held: list[bool],
    turns: list[list[int]],
) -> tuple[np.ndarray, np.ndarray]:
    """The columns (R, c) at times t_s (T,), and (T,) bool: which times lie inside.

    A held column keeps the value of the row before (or at) each time; a quaternion turns at a
    constant rate, and the others are linear between the two rows around it.
    """
    log_s, t_s = _clocks(role, table, t_s)
    at = Between.of(log_s, t_s)
    use_held = np.array(held) | (role.interpolate == "previous")
    found = at.linear(values)
    for turn in turns:
        found[:, turn] = between(values[at.before][:, turn], values[at.after][:, turn], at.share)
    found = np.where(use_held, at.held(values), found)
    return found, at.inside & (at.gap_s <= role.max_gap_s)


def _clocks(role: FileRole, table: RawTable, t_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times of a log's rows (R,) and of the main file's (T,) on one clock [s]."""
    log_s = times(table, role.time, role.time_unit)
    back = np.flatnonzero(~(np.diff(log_s) > 0))
    if len(back):
        place = table.cells.place(int(back[0]) + 1)
        raise InputError(
            f"{place}, column '{role.time}': time does not increase, expected increasing times to "
            "match the files by"
        )
    if role.clock == "from_start":
        log_s, t_s = log_s - log_s[0], t_s - t_s[0]
    log_s = log_s + role.clock_offset_s
    return log_s, t_s


def _apart(spec: ImportMap, name: str, table: RawTable, main: RawTable, t_s: np.ndarray) -> str:
    """Why no row of the main file, at times t_s (T,) [s], has one of a log: both ranges of times,
    and what to change in the map."""
    role = spec.file[name]
    log_s, t_s = _clocks(role, table, t_s)
    text = (
        f"{main.path} has times from {t_s[0]:.6g} to {t_s[-1]:.6g} s, {table.path} from "
        f"{log_s[0]:.6g} to {log_s[-1]:.6g} s"
    )
    longer = max(np.ptp(log_s), 1e-300) / max(np.ptp(t_s), 1e-300)
    ratio = next((by for by in UNIT_RATIOS if 1 / SAME_LENGTH <= longer / by <= SAME_LENGTH), None)
    if ratio is None:
        return (
            f'{text}: if their clocks count from different moments, set clock = "from_start" or '
            f"clock_offset_s in [file.{name}] of the map"
        )
    advice = []
    if unit := _unit_of(role.time_unit, 1 / ratio):
        advice.append(
            f'if the times of {table.path} are in {unit}, set time_unit = "{unit}" in '
            f"[file.{name}] of the map"
        )
    plain = spec.time.column is not None and spec.time.rate_hz is None
    if plain and (unit := _unit_of(spec.time.unit, ratio)):
        advice.append(
            f'if those of {main.path} are in {unit}, set unit = "{unit}" in [time] of the map'
        )
    if not advice:
        advice.append(f"check [time] and time_unit in [file.{name}] of the map")
    times_as_long = f"{ratio:g}" if ratio > 1 else f"1/{1 / ratio:g}"
    return f"{text}, about {times_as_long} times as long: {'; '.join(advice)}"


def _unit_of(unit: str, by: float) -> str | None:
    """The unit of time that is `by` times as long as another one; None where none is."""
    size = SECONDS_PER.get(unit, 0.0) * by
    return next((name for name, own in SECONDS_PER.items() if math.isclose(own, size)), None)


def _note_time_join(
    role: FileRole, table: RawTable, main: RawTable, inside: np.ndarray, notes: list[str]
) -> None:
    how = "held" if role.interpolate == "previous" else "interpolated linearly in time"
    notes.append(f"{table.path}: {how} at the rows of {main.path}")
    lost = int((~inside).sum())
    if lost:
        notes.append(
            f"{lost} rows of {main.path} lie outside of {table.path} or in a gap longer "
            f"than {role.max_gap_s:g} s, left out"
        )


def times(table: RawTable, column: Column, unit: str) -> np.ndarray:
    """(T,) a column of times [s], every cell known."""
    if unit == "iso":
        return _dates(table, column)
    t = table.numbers([column])[:, 0] * SECONDS_PER[unit]
    missing = np.flatnonzero(np.isnan(t))
    if len(missing):
        place = table.cells.place(int(missing[0]))
        raise InputError(f"{place}, column '{column}': no time, expected a number in every row")
    return t


def _dates(table: RawTable, column: Column) -> np.ndarray:
    """(T,) dates as seconds since 1970."""
    seconds = []
    for row, text in enumerate(table.texts(column)):
        try:
            stamp = datetime.fromisoformat(text.strip())
        except ValueError as error:
            raise InputError(
                f"{table.cells.place(row)}, column '{column}': got {text[:40]!r}, expected a date "
                "such as 2024-05-01T12:00:00.25"
            ) from error
        stamp = stamp if stamp.tzinfo else stamp.replace(tzinfo=UTC)
        seconds.append((stamp - EPOCH) / timedelta(seconds=1))
    return np.array(seconds)


def main_times(main: RawTable, spec: ImportMap, count: int | None) -> np.ndarray:
    """(T,) the main file's clock [s]: its time column, or its frames or rows at a nominal rate."""
    if spec.time.column is not None and spec.time.rate_hz is not None:
        return times(main, spec.time.column, "s") / spec.time.rate_hz
    if spec.time.column is not None:
        return times(main, spec.time.column, spec.time.unit) * spec.time.scale
    if count is None:
        count = len(main.numbers([1]))
    assert spec.time.rate_hz is not None, "a [time] table without a column has a rate"
    return np.arange(count) / spec.time.rate_hz
