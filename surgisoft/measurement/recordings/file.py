"""Recordings from and to files: finding, reading with every check, writing as a whole or not."""

import csv
import itertools
import warnings
from collections.abc import Callable, Iterable
from os import PathLike
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.csv
import pyarrow.parquet as pq

from surgisoft.errors import InputError, exists_already, path_of, wrong_type
from surgisoft.files import new_file, new_folder, resolved
from surgisoft.measurement.recordings.columns import Layout, parse_header
from surgisoft.measurement.recordings.log import SUFFIX as LOG_SUFFIX
from surgisoft.measurement.recordings.log import read_log
from surgisoft.measurement.recordings.quality import copies_of_others, find_warnings
from surgisoft.measurement.recordings.recording import (
    Recording,
    first_run_again,
    first_time_backwards,
)
from surgisoft.measurement.recordings.sidecar import read_sidecar, sidecar_of, sidecar_text
from surgisoft.measurement.tables import DelimitedText, ParquetTable, read_text

SUFFIXES = (".csv", ".parquet")
"""Suffixes of the files that hold recordings."""

Table = DelimitedText | ParquetTable
Warn = Callable[[str], None]


def load_recording(path: str | Path, on_warning: Warn | None = None) -> Recording:
    """Read one recording; data-quality warnings go to `on_warning` (default: warnings.warn).

    Its arrays have one row for each of T samples: `t_s` (T,) s, `measured` (T, m) and `commanded`
    (T, m) in `unit` (kPa, if the file states no other), `key_points_mm` (T, n, 3) mm in the arm
    base frame, NaN where one was not seen. Raises InputError, with file and row, for a file that is
    not such a table.
    """
    return _read(path_of("the recording", path), on_warning or _warn)


def load_recordings(
    paths: Iterable[str | Path | Recording] | str | Path | Recording,
    on_warning: Warn | None = None,
) -> list[Recording]:
    """Read files, and every recording of folders in the order of their names.

    Recordings that are open already stay as they are. Raises InputError where a path does not
    exist, a folder holds no recording, or a file is not one (`load_recording`).
    """
    given = given_recordings(paths)
    if any(isinstance(item, Recording) for item in given):
        read = ([i] if isinstance(i, Recording) else load_recordings(i, on_warning) for i in given)
        return [recording for part in read for recording in part]
    paths_only = [Path(item) for item in given if not isinstance(item, Recording)]
    files = _find(paths_only, on_warning or _warn)
    found = [load_recording(file, on_warning) for file in files]
    for text in copies_of_others(found):
        (on_warning or _warn)(text)
    return found


def given_recordings(
    paths: Iterable[str | Path | Recording] | str | Path | Recording,
) -> list[str | Path | Recording]:
    """One recording or several as a list, not yet read; raises InputError for other types."""
    expected = "a Recording, a path, or several of them"
    if isinstance(paths, str | Path | Recording):
        return [paths]
    if not isinstance(paths, Iterable):
        raise wrong_type("recordings", paths, expected)
    given = list(paths)
    for each in given:
        if not isinstance(each, str | PathLike | Recording):
            raise wrong_type("one of the recordings", each, expected)
    return given


def recording_files(paths: Iterable[str | Path] | str | Path) -> list[Path]:
    """The files that files and folders name, folders in the order of their files' names.

    A file that is named twice counts twice.
    """
    given = [paths] if isinstance(paths, str | Path) else paths
    each = (_in_folder(Path(p)) if Path(p).is_dir() else [Path(p)] for p in given)
    return [file for part in each for file in part]


def _warn(message: str) -> None:
    warnings.warn(message, stacklevel=2)


def _find(paths: list[Path], warn: Warn) -> list[Path]:
    """The recordings that files and folders name, folders in the order of their files' names."""
    if not paths:
        raise InputError("no recording given, expected a file or a folder of recordings")
    found: list[Path] = []
    seen: set[Path] = set()
    for path in paths:
        try:
            files = _in_folder(path) if path.is_dir() else [path]
            places = [resolved(file) for file in files]
        except OSError as error:  # links in a circle, a folder without permission
            raise InputError(
                f"{path}: cannot be read ({error.strerror}), expected a file or a folder of "
                "recordings"
            ) from None
        for file, place in zip(files, places, strict=True):
            if place in seen:
                warn(f"{file}: given twice, read once")
                continue
            seen.add(place)
            found.append(file)
    return found


def _in_folder(folder: Path) -> list[Path]:
    files = sorted(
        file
        for file in folder.iterdir()
        if file.suffix in SUFFIXES and file.is_file() and not file.name.startswith(".")
    )
    if not files and (folder / "config.json").is_file():
        raise InputError(f"{folder}: is a model, expected recordings; the model comes before them")
    if not files:
        raise InputError(f"{folder}: no .csv or .parquet in this folder, expected recordings")
    for before, after in itertools.pairwise(files):
        if before.stem == after.stem:
            raise InputError(
                f"{folder}: both {before.name} and {after.name}, expected a recording once; "
                "remove one of them or name the files"
            )
    return files


def _read(path: Path, warn: Warn) -> Recording:
    """One recording with every check of the format."""
    if path.suffix == LOG_SUFFIX and path.is_file():
        recording, lacking = read_log(path)
        if lacking:
            warn(f"{path}: {lacking}")
        for found in find_warnings(recording):
            warn(f"{path}, sample {found.sample + 1}: {found.text}")
        return recording
    table = open_table(path)
    header = f"{path}, line 1" if path.suffix == ".csv" else f"{path}"
    layout = parse_header(table.names, header)
    for name in layout.ignored:
        warn(f"{path}: column '{name}' is not part of the format and was left out")
    cells = table.numbers(layout.used)
    pa.default_memory_pool().release_unused()
    if len(cells) == 0:
        raise InputError(f"{path}: the table is empty, expected at least one row of numbers")
    at = {column: i for i, column in enumerate(layout.used)}
    _check_finite(table, cells, layout)
    rows = _rows_with_actuation(table, cells, layout, at, warn)
    recording = _assemble(table, cells[rows], rows, layout, at)
    for found in find_warnings(recording):
        warn(f"{table.place(int(rows[found.sample]))}: {found.text}")
    return recording


def open_table(path: Path) -> DelimitedText | ParquetTable:
    """The table of a file; its columns are not read yet."""
    if path.suffix not in SUFFIXES and path.exists() and not path.is_dir():
        raise InputError(
            f"{path}: suffix '{path.suffix}', expected .csv or .parquet; "
            "'surgisoft import' reads other files"
        )
    if path.is_dir():
        raise InputError(f"{path}: is a folder, expected a file")
    if not path.exists():
        raise InputError(f"{path}: no such file, expected a recording (.csv or .parquet)")
    if not path.is_file():
        raise InputError(f"{path}: not a regular file, expected a recording (.csv or .parquet)")
    return ParquetTable.open(path) if path.suffix == ".parquet" else _open_csv(path)


def _open_csv(path: Path) -> DelimitedText:
    head, _, body = read_text(path).partition(b"\n")
    try:
        text = head.decode("utf-8")
    except UnicodeDecodeError as error:
        raise InputError(f"{path}: not text in UTF-8, expected comma-separated values") from error
    if not text.strip():
        raise InputError(f"{path}, line 1: is blank, expected the names of the columns")
    try:
        names = next(csv.reader([text]))
    except csv.Error as error:
        raise InputError(f"{path}, line 1: {error}, expected the names of the columns") from error
    for separator, called in ((";", "semicolons"), ("\t", "tabs")):
        if len(names) < 3 and text.count(separator) >= 3:
            raise InputError(
                f"{path}, line 1: separated by {called}, expected commas; "
                "'surgisoft import' reads other separators"
            )
    return DelimitedText(path, body, 2, names)


def _check_finite(table: Table, cells: np.ndarray, layout: Layout) -> None:
    """No infinite cell anywhere; no missing time or run."""
    needed = [i for i in (layout.time, layout.run) if i is not None]
    strict = np.isin(layout.used, needed)
    bad = np.isinf(cells) | (np.isnan(cells) & strict)
    if bad.any():
        row, column = np.argwhere(bad)[0].tolist()
        value = cells[row, column]
        got = "a missing value" if np.isnan(value) else f"{value}"
        raise InputError(
            f"{table.place(row)}, column '{layout.names[layout.used[column]]}': "
            f"got {got}, expected a finite number"
        )


def _rows_with_actuation(
    table: Table, cells: np.ndarray, layout: Layout, at: dict[int, int], warn: Warn
) -> np.ndarray:
    """Indices of the rows where all of the actuation is known; the others are left out."""
    channels = [*layout.measured, *layout.commanded]
    missing = np.isnan(cells[:, [at[i] for i in channels]])
    if missing.any():
        row, channel = np.argwhere(missing)[0].tolist()
        count = int(missing.any(axis=1).sum())
        place = f"{table.place(row)}, column '{layout.names[channels[channel]]}'"
        if count == len(cells):
            raise InputError(f"{place}: the actuation is missing in every row, expected numbers")
        warn(f"{place}: actuation missing here, {count} such rows of {len(cells)} left out")
    return np.flatnonzero(~missing.any(axis=1))


def _assemble(
    table: Table, cells: np.ndarray, rows: np.ndarray, layout: Layout, at: dict[int, int]
) -> Recording:
    """The recording from its cells (T, columns) and the rows (T,) that they stand in."""

    def required(position: int) -> np.ndarray:
        return np.ascontiguousarray(cells[:, at[position]])

    def column(position: int | None) -> np.ndarray | None:
        return None if position is None else required(position)

    def columns(positions: tuple[int, ...]) -> np.ndarray:
        return np.ascontiguousarray(cells[:, [at[i] for i in positions]])

    points = columns(layout.key_points)
    points = points if layout.mm_per_unit == 1 else points * layout.mm_per_unit
    t_s = required(layout.time)
    run = _run_ids(table, column(layout.run), rows)
    _check_order(table, t_s, run, rows)
    path = table.path
    recording = Recording(
        name=path.stem,
        t_s=t_s,
        measured=columns(layout.measured),
        key_points_mm=points.reshape(len(cells), -1, 3),
        commanded=columns(layout.commanded) if layout.commanded else None,
        run=run,
        unit=layout.unit,
        temp_C=column(layout.temp),
        payload_g=column(layout.payload),
        source=path,
        **read_sidecar(sidecar_of(path)),
    )
    if np.isnan(recording.key_points_mm).all():
        raise InputError(f"{path}: every key point is missing in every row, expected positions")
    return recording


def _run_ids(table: Table, values: np.ndarray | None, rows: np.ndarray) -> np.ndarray:
    if values is None:
        return np.zeros(len(rows), np.int64)
    odd = np.flatnonzero((values != np.round(values)) | (np.abs(values) >= 2**53))
    if len(odd):
        place = table.place(int(rows[odd[0]]))
        raise InputError(f"{place}, column 'run': got {values[odd[0]]}, expected an integer")
    return values.astype(np.int64)


def _check_order(table: Table, t_s: np.ndarray, run: np.ndarray, rows: np.ndarray) -> None:
    again = first_run_again(run)
    if again is not None:
        raise InputError(
            f"{table.place(int(rows[again]))}, column 'run': run {run[again]} appears again "
            "after another run, expected the rows of a run in one block"
        )
    back = first_time_backwards(t_s, run)
    if back is not None:
        raise InputError(
            f"{table.place(int(rows[back]))}, column 't_s': {float(t_s[back])!r} s after "
            f"{float(t_s[back - 1])!r} s, expected time to increase inside a run; "
            "give separate runs a column 'run'"
        )


def after_alarm(path: str | Path) -> Path:
    """The file beside a recording that holds what came after its alarm (`surgisoft run`)."""
    path = Path(path)
    return path.with_name(f"{path.stem}-after{path.suffix}")


def check_writable(path: str | Path, force: bool = False) -> None:
    """Raise where `save_recording` would refuse this path."""
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise InputError(f"{path}: suffix '{path.suffix}', expected .csv or .parquet")
    for target in (path, sidecar_of(path)):
        if target.is_dir():
            raise InputError(f"{target}: is a folder, expected the name of a file")
        if target.exists() and not force:
            raise exists_already(target)


def save_recording(recording: Recording, path: str | Path, force: bool = False) -> None:
    """Write the table (.csv or .parquet by the suffix) and its sidecar (.toml) beside it.

    Both are complete under temporary names before either is renamed. Existing files are not
    replaced unless `force` is set.
    """
    if not isinstance(recording, Recording):
        raise wrong_type("the recording to save", recording, "a Recording")
    path = path_of("the file of the recording", path)
    check_writable(path, force)
    try:
        with new_file(path) as table, new_file(sidecar_of(path)) as sidecar:
            _write_table(_to_arrow(recording), table, path.suffix)
            sidecar.write_text(sidecar_text(recording), encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror or error})") from error


def save_recordings(recordings: Iterable[Recording], folder: str | Path) -> list[Path]:
    """Write recordings as .parquet with their sidecars to a new folder, all of them or none."""
    folder, recordings = Path(folder), list(recordings)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: exists already, expected a new folder; choose another one")
    check_names_differ(recordings)
    try:
        with new_folder(folder) as fresh:
            for recording in recordings:
                save_recording(recording, fresh / f"{recording.name}.parquet")
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror or error})") from error
    return [folder / f"{recording.name}.parquet" for recording in recordings]


def check_names_differ(recordings: Iterable[Recording]) -> None:
    """Raise InputError where two recordings have one name, so that one folder cannot hold both."""
    first: dict[str, Recording] = {}
    for recording in recordings:
        if (other := first.get(recording.name)) is not None:
            raise InputError(
                f"two recordings are called '{recording.name}' ({other.label}, {recording.label}), "
                "expected names that differ; rename a file, or give them one by one"
            )
        first[recording.name] = recording


def _write_table(content: pa.Table, part: Path, suffix: str) -> None:
    if suffix == ".parquet":
        # Measured values hardly repeat: a dictionary of them costs time and saves nothing.
        pq.write_table(content, part, compression="zstd", use_dictionary=["run"])
        return
    with part.open("wb") as file:
        file.write((",".join(content.column_names) + "\n").encode())
        pyarrow.csv.write_csv(content, file, pyarrow.csv.WriteOptions(include_header=False))


def _to_arrow(recording: Recording) -> pa.Table:
    """The table in the order of the format; missing values are nulls."""
    columns: dict[str, np.ndarray] = {"t_s": recording.t_s}
    for letter, values in (("p", recording.measured), ("c", recording.commanded)):
        for i in range(recording.chambers if values is not None else 0):
            assert values is not None
            columns[f"{letter}{i + 1}_{recording.unit}"] = values[:, i]
    for j in range(recording.key_points):
        for a, axis in enumerate("xyz"):
            columns[f"k{j}_{axis}_mm"] = recording.key_points_mm[:, j, a]
    columns["run"] = recording.run
    for name in ("temp_C", "payload_g"):
        if getattr(recording, name) is not None:
            columns[name] = getattr(recording, name)
    arrays = {
        name: pa.array(np.ascontiguousarray(v), from_pandas=True) for name, v in columns.items()
    }
    content = pa.table(arrays)
    parse_header(content.column_names, recording.label)
    return content
