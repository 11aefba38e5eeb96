"""Which rows of the joined files become samples, and which samples form a run."""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np

from surgisoft.errors import InputError
from surgisoft.measurement.importing.align import (
    LARGEST_GAP_S,
    Between,
    renewal_s,
    renewed_rows,
    without_holds,
)
from surgisoft.measurement.importing.spec import ImportMap


@dataclass(frozen=True, eq=False)
class Draft:
    """Samples before they become a recording; every array has one entry a sample."""

    row: np.ndarray
    """(T,) row of the main file, counted from 0."""
    t_s: np.ndarray
    """(T,) time [s]."""
    measured: np.ndarray
    """(T, m) actuation, NaN where missing."""
    key_points_mm: np.ndarray
    """(T, n, 3) arm base frame [mm], NaN where missing."""
    commanded: np.ndarray | None
    """(T, m) command, NaN where missing."""
    context: np.ndarray
    """(T, 2) temperature [degrees Celsius] and payload [g], NaN where missing."""
    run: np.ndarray
    """(T,) number of the run inside this set of files."""
    point: np.ndarray
    """(T,) number of the steady-state point that a row belongs to; -1: none."""

    def take(self, rows: np.ndarray) -> "Draft":
        """The samples with these indices, or where a mask is true."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return replace(self, **{k: v[rows] for k, v in values.items() if v is not None})


def tidy(draft: Draft, spec: ImportMap, place: Callable[[int], str]) -> tuple[Draft, list[str]]:
    """The samples that the map keeps, and what was left out; `place` names a row of the file."""
    notes: list[str] = []
    draft = _with_known_actuation(draft, notes, place)
    if spec.rows.duplicates == "drop":
        draft = _without_duplicates(draft, notes)
    draft = _with_increasing_time(draft, spec, notes, place)
    if spec.measured.repeated == "interpolate":
        draft = _without_holds(draft, notes)
    draft = _in_time(draft, spec, notes, place)
    if spec.rows.average is not None:
        draft = _averaged(draft, notes)
    return draft.take(_row_of_run(draft.run) % spec.rows.every == 0), notes


def run_numbers(
    t_s: np.ndarray, labels: list[str] | None, gap_s: float | None, time_restarts: bool
) -> np.ndarray:
    """(T,) number of the run of each row, from 0: a new one at each new label, gap or restart."""
    starts = np.zeros(len(t_s), bool)
    steps = np.diff(t_s)
    if labels is not None:
        starts[1:] |= np.array([a != b for a, b in itertools.pairwise(labels)], bool)
    if gap_s is not None:
        starts[1:] |= steps > gap_s
    if time_restarts:
        starts[1:] |= steps < 0
    return np.cumsum(starts)


def point_numbers(labels: list[str]) -> np.ndarray:
    """(T,) a number that changes with the label; -1 where the label is empty or NaN."""
    changes = [i == 0 or labels[i] != labels[i - 1] for i in range(len(labels))]
    none = np.array([label.lower() in ("", "nan", "none") for label in labels], bool)
    return np.where(none, -1, np.cumsum(changes))


def _row_of_run(run: np.ndarray) -> np.ndarray:
    """(T,) number of each row within its run, from 0; run: (T,) number of the run of each row."""
    row = np.arange(len(run))
    starts = np.r_[True, run[1:] != run[:-1]][: len(run)]
    return row - np.maximum.accumulate(np.where(starts, row, 0))


def _with_known_actuation(draft: Draft, notes: list[str], place: Callable[[int], str]) -> Draft:
    missing = np.isnan(draft.measured).any(axis=1)
    if draft.commanded is not None:
        missing |= np.isnan(draft.commanded).any(axis=1)
    if not missing.any():
        return draft
    first = place(int(draft.row[np.flatnonzero(missing)[0]]))
    if missing.all():
        raise InputError(f"{first}: the actuation is missing in every row, expected numbers")
    notes.append(f"{first}: actuation missing here, {int(missing.sum())} such rows left out")
    return draft.take(~missing)


def _without_duplicates(draft: Draft, notes: list[str]) -> Draft:
    arrays = [draft.measured, draft.key_points_mm.reshape(len(draft.t_s), -1)]
    arrays += [draft.commanded] if draft.commanded is not None else []
    values = np.concatenate(arrays, axis=1)
    same = (values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))
    repeated = np.concatenate([[False], same.all(axis=1) & (np.diff(draft.run) == 0)])
    if repeated.any():
        notes.append(f"{int(repeated.sum())} rows that repeat the row before left out")
    return draft.take(~repeated)


def _with_increasing_time(
    draft: Draft, spec: ImportMap, notes: list[str], place: Callable[[int], str]
) -> Draft:
    late = np.zeros(len(draft.t_s), bool)
    for run in np.unique(draft.run):
        rows = np.flatnonzero(draft.run == run)
        latest = np.maximum.accumulate(draft.t_s[rows])
        late[rows[1:]] = draft.t_s[rows[1:]] <= latest[:-1]
    if not late.any():
        return draft
    first = int(np.flatnonzero(late)[0])
    if spec.rows.repeated_time == "error":
        raise InputError(
            f"{place(int(draft.row[first]))}: time {float(draft.t_s[first])!r} s after "
            f"{float(draft.t_s[first - 1])!r} s, expected an increase; set "
            'repeated_time = "drop" in [rows], or time_restarts = true in [runs]'
        )
    notes.append(f"{int(late.sum())} rows whose time does not increase left out")
    return draft.take(~late)


def _without_holds(draft: Draft, notes: list[str]) -> Draft:
    """Readings that a slow sensor held, on a line between them, run by run."""
    runs = [np.flatnonzero(draft.run == run) for run in np.unique(draft.run)]
    parts = [(draft.t_s[rows], draft.measured[rows]) for rows in runs]
    period = renewal_s(parts)
    measured = draft.measured.copy()
    for rows, (t_s, values) in zip(runs, parts, strict=True):
        measured[rows] = without_holds(t_s, values, period)
    repeats = sum(len(values) - len(renewed_rows(values)) for _, values in parts)
    notes.append(
        f"measured actuation is renewed every {period:.4g} s and held in between: "
        f"{repeats} of {len(draft.t_s)} rows interpolated"
    )
    return replace(draft, measured=measured)


def _in_time(draft: Draft, spec: ImportMap, notes: list[str], place: Callable[[int], str]) -> Draft:
    """The actuation as it was at each row, where its log is late, run by run.

    A measurement is linear between the rows of its log, a command is held. Rows that the log does
    not reach are left out.
    """
    late = spec.measured.delay_s
    command_late = spec.commanded.delay_s if spec.commanded else 0.0
    if late == 0 and command_late == 0:
        return draft
    measured = draft.measured.copy()
    commanded = None if draft.commanded is None else draft.commanded.copy()
    keep = np.ones(len(draft.t_s), bool)
    for run in np.unique(draft.run):
        rows = np.flatnonzero(draft.run == run)
        t_s = draft.t_s[rows]
        at = Between.of(t_s, t_s + late)
        measured[rows] = at.linear(draft.measured[rows])
        keep[rows] &= at.inside & (at.gap_s <= LARGEST_GAP_S)
        if commanded is not None and draft.commanded is not None:
            at = Between.of(t_s, t_s + command_late)
            commanded[rows] = at.held(draft.commanded[rows])
            keep[rows] &= at.inside
    for name, delay in (("measured", late), ("commanded", command_late)):
        if delay:
            notes.append(f"{name} actuation read {delay:+g} s from each row (delay_s)")
    if not keep.any():
        raise InputError(
            f"{place(int(draft.row[0]))}: delay_s {late:g} (commanded {command_late:g}) is longer "
            "than every run, expected a short time; check the map"
        )
    if not keep.all():
        notes.append(f"{int((~keep).sum())} rows that the late log does not reach left out")
    return replace(draft, measured=measured, commanded=commanded).take(keep)


def _averaged(draft: Draft, notes: list[str]) -> Draft:
    """One sample a steady-state point: the mean of its rows, without missing values."""
    draft = draft.take(draft.point >= 0)
    if not len(draft.t_s):
        raise InputError(
            "no row belongs to a steady-state point, expected labels in the column of 'average'"
        )
    keys = np.stack([draft.point, draft.run], axis=1)
    starts = np.flatnonzero(np.r_[True, (np.diff(keys, axis=0) != 0).any(axis=1)])
    notes.append(f"{len(draft.t_s)} rows averaged into {len(starts)} steady-state points")

    def mean(values: np.ndarray) -> np.ndarray:
        known = ~np.isnan(values)
        total = np.add.reduceat(np.where(known, values, 0.0), starts, axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            return total / np.add.reduceat(known.astype(np.float64), starts, axis=0)

    return replace(
        draft.take(starts),
        t_s=mean(draft.t_s),
        measured=mean(draft.measured),
        key_points_mm=mean(draft.key_points_mm),
        commanded=None if draft.commanded is None else mean(draft.commanded),
        context=mean(draft.context),
    )
