"""Files of predictions beside recordings: key points of a model in any language, row by row.

A file has the columns `k0_x_mm` ... of the recording format, and may have `t_s` and `run`, by which
its rows are then matched with those of the recording. Without them its rows are those of the
recording, in order. Other columns are left out, so a copy of the recording with the predicted key
points in place of the measured ones will do.
"""

import re
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from surgisoft.errors import InputError
from surgisoft.measurement.recordings.columns import MM_PER
from surgisoft.measurement.recordings.file import open_table, recording_files
from surgisoft.measurement.recordings.recording import Recording
from surgisoft.measurement.tables import DelimitedText, ParquetTable

KEY_POINT = re.compile(r"k(0|[1-9][0-9]*)_([xyz])_(mm|cm|m|in)")
"""A column of a predicted key point."""
SAME_S = 1e-4
"""Largest difference between the times of two rows that are the same one, s: text files round."""


def with_predictions(
    recordings: Sequence[Recording], files: Iterable[str | Path]
) -> list[Recording]:
    """The recordings with the predicted key points of files, one file a recording, in order.

    A folder stands for its files in the order of their names. Raises InputError where files and
    recordings are not as many, or rows or key points do not match.
    """
    paths = recording_files(files)
    if len(paths) != len(recordings):
        names = ", ".join(recording.name for recording in recordings)
        raise InputError(
            f"{len(paths)} files of predictions for {len(recordings)} recordings ({names}); "
            "expected one for each, in the same order, those of --before last"
        )
    return [
        replace(recording, predicted_mm=_matched(recording, path))
        for recording, path in zip(recordings, paths, strict=True)
    ]


def _matched(recording: Recording, path: Path) -> np.ndarray:
    """(T, n, 3) predicted key points of a recording's rows, mm."""
    table = open_table(path)
    points = _key_points(table, path)
    if points.shape[1] != recording.key_points:
        raise InputError(
            f"{path}: {points.shape[1]} key points, expected {recording.key_points} as in "
            f"{recording.label}, k0 at the base"
        )
    rows = _rows(table, path, recording, len(points))
    points = points[rows]
    bad = ~np.isfinite(points).all((1, 2))
    if bad.any():
        row = int(rows[np.flatnonzero(bad)[0]])
        raise InputError(
            f"{table.place(row)}: the predicted key points are missing or not finite, in "
            f"{int(bad.sum())} of {len(points)} rows; a model predicts every row"
        )
    return points


def _key_points(table: DelimitedText | ParquetTable, path: Path) -> np.ndarray:
    """(T, n, 3) key points of all rows of a file, mm."""
    found = {}
    for position, name in enumerate(table.names):
        match = KEY_POINT.fullmatch(name)
        if match:
            found[int(match[1]), match[2]] = (position, MM_PER[match[3]])
    count = max((number for number, _ in found), default=-1) + 1
    wanted = [(k, axis) for k in range(max(count, 1)) for axis in "xyz"]
    lost = [f"k{k}_{axis}_mm" for k, axis in wanted if (k, axis) not in found]
    if lost:
        raise InputError(
            f"{path}: no column '{lost[0]}', expected the predicted key points as columns "
            "k0_x_mm, k0_y_mm, k0_z_mm, k1_x_mm, ..."
        )
    places, scales = zip(*(found[key] for key in wanted), strict=True)
    return (table.numbers(places) * np.array(scales)).reshape(-1, count, 3)


def _rows(
    table: DelimitedText | ParquetTable, path: Path, recording: Recording, count: int
) -> np.ndarray:
    """(T,) rows of the file that are those of the recording, in order."""
    if "t_s" not in table.names:
        if count != recording.samples:
            raise InputError(
                f"{path}: {count} rows, but {recording.label} has {recording.samples}; expected "
                "one row of predictions for each, or a column 't_s' to match them by"
            )
        return np.arange(count)
    time = table.numbers([table.names.index("t_s")])[:, 0]
    run = np.zeros(count)
    own = recording.run if "run" in table.names else np.zeros(recording.samples, np.int64)
    if "run" in table.names:
        run = table.numbers([table.names.index("run")])[:, 0]
    elif count != recording.samples and len(np.unique(recording.t_s)) < recording.samples:
        raise InputError(
            f"{path}: {count} rows, but {recording.label} has {recording.samples} in "
            f"{len(recording.runs)} runs; expected a column 'run' to match them by"
        )
    if count == recording.samples:
        rows = np.arange(count)
    else:
        rows = np.full(recording.samples, -1)
        for number in np.unique(own):
            here, there = np.flatnonzero(own == number), np.flatnonzero(run == number)
            there = there[np.argsort(time[there], kind="stable")]
            if not len(there):
                continue
            near = np.searchsorted(time[there], recording.t_s[here] - SAME_S)
            rows[here] = there[np.minimum(near, len(there) - 1)]
    off = (rows < 0) | ~(np.abs(time[rows] - recording.t_s) <= SAME_S) | (run[rows] != own)
    if off.any():
        row = int(np.flatnonzero(off)[0])
        at = f"run {recording.run[row]}, {recording.t_s[row]:g} s"
        came = f"row {rows[row] + 1} is at {time[rows[row]]:g} s" if rows[row] >= 0 else "none is"
        raise InputError(
            f"{path}: no row for {at} of {recording.label} ({came}); expected the rows of the "
            "recording, with their times"
        )
    return rows
