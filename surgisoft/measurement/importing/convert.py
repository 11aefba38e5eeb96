"""Conversion of a laboratory's files to recordings, as a map describes it.

The steps: every file gets its role, files that belong together form a set, a set's files are joined
to one row a sample, positions are brought into the arm's base frame, rows are tidied, and the sets
become the runs of one recording or a recording each.
"""

import fnmatch
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from surgisoft.command_line import typed
from surgisoft.errors import InputError, path_of
from surgisoft.files import resolved
from surgisoft.measurement.importing.align import Joined, join
from surgisoft.measurement.importing.following import following, warnings_of
from surgisoft.measurement.importing.names import check_columns, uses
from surgisoft.measurement.importing.plausible import plausibility_notes
from surgisoft.measurement.importing.points import (
    key_points_of,
    needed_columns,
    quaternions,
    read_points,
)
from surgisoft.measurement.importing.raw import Column, RawTable
from surgisoft.measurement.importing.readers import (
    AUTO,
    OF_TOPICS,
    READERS,
    chosen,
    open_raw,
    reader,
)
from surgisoft.measurement.importing.rows import (
    Draft,
    point_numbers,
    run_numbers,
    tidy,
)
from surgisoft.measurement.importing.spec import (
    ActuationMap,
    ContextSource,
    ImportMap,
    load_map,
)
from surgisoft.measurement.importing.timing import timing_notes
from surgisoft.measurement.recordings import Recording
from surgisoft.measurement.recordings.clock import gaps_in_words
from surgisoft.measurement.recordings.lerobot import is_dataset, load_lerobot
from surgisoft.measurement.recordings.log import SUFFIX as LOG_SUFFIX
from surgisoft.measurement.recordings.log import read_log
from surgisoft.measurement.recordings.quality import without_frozen, without_spikes
from surgisoft.measurement.units import factor, unit_named

COLUMN_LETTERS = {"measured": "p", "commanded": "c"}
"""First letter of the columns of an actuation that the map leaves to their names."""
DRAFTED = 3
"""Most raw files that are taken for those of one recording where a draft of a map is proposed."""
_ENDINGS = (".gz", ".bz2", ".xz", ".csv", ".tsv", ".txt", ".dat", ".log", ".parquet")


@dataclass(frozen=True, eq=False)
class Imported:
    """A recording and what was done to get it."""

    recording: Recording
    """The recording, not yet saved."""
    notes: list[str]
    """What was left out, joined or fitted, in words."""
    files: tuple[Path, ...] = ()
    """The files that it was read from."""
    warnings: tuple[str, ...] = ()
    """What says that the files do not belong together, in words."""


def import_files(paths: Sequence[Path], spec: ImportMap, name: str | None) -> list[Imported]:
    """All files as the runs of one recording of this name, or (no name) each set as a recording."""
    parts = [_import_set(files, spec) for files in sets_of_files(paths, spec)]
    if name is None:
        named = [
            replace(p, recording=_started_at(p.recording, spec, float(p.recording.t_s[0])))
            for p in parts
        ]
        return [_finished(part, spec) for part in _named_apart(named)]
    return [_finished(_as_runs(parts, spec, name), spec)]


def import_recordings(
    raw: Iterable[str | Path] | str | Path,
    map_file: str | Path | None = None,
    name: str | None = None,
    delay_s: float | None = None,
) -> list[Imported]:
    """The recordings in a laboratory's files, not yet saved, with notes on what was done.

    Key points are in mm in the arm base frame, times in s. Raises InputError where files and map do
    not fit each other.

    raw: files or folders. map_file: a map (docs/recordings.md), or `motive`; None: the files are
    logs of interrupted recordings (.jsonl) or LeRobotDatasets with a recording's names, which need
    none. name: the files are the runs of one recording of this name; None: each set of files is a
    recording, named after its main file. delay_s: delay of the actuation's log [s], in place of
    that of the map: of [measured], and of [commanded] where it is in the same file.
    """
    if delay_s is not None and not np.isfinite(delay_s):
        raise InputError(f"delay_s: got {delay_s}, expected a finite number of seconds")
    if delay_s is not None and map_file is None:
        raise InputError(
            f"delay_s {delay_s:g} without a map: it takes the place of delay_s in [measured] of a "
            "map, expected one; give it with --map"
        )
    given = [raw] if isinstance(raw, str | Path) or not isinstance(raw, Iterable) else raw
    paths = [path_of("a raw file", path) for path in given]
    if map_file is not None:
        spec = load_map(str(map_file))
        return import_files(paths, spec if delay_s is None else _delayed(spec, delay_s), name)
    if paths and all(path.suffix == LOG_SUFFIX for path in paths):
        return _named_apart([import_log(path, name or path.stem) for path in paths])
    if paths and all(is_dataset(path) for path in paths):
        return _named_apart([import_lerobot(path, name or path.name) for path in paths])
    shown = f" {typed(*paths[: DRAFTED if len(paths) <= DRAFTED else 1])}" if paths else ""
    raise InputError(
        "--map is missing: a map file states columns, units and frames; "
        f"'surgisoft import{shown} --draft map.toml' writes one to start from"
    )


def _delayed(spec: ImportMap, delay_s: float) -> ImportMap:
    """The map with another delay of the log of its actuation."""
    measured, command = replace(spec.measured, delay_s=delay_s), spec.commanded
    if command is not None and command.file == measured.file:
        command = replace(command, delay_s=delay_s)
    return replace(spec, measured=measured, commanded=command)


def import_log(path: Path, name: str) -> Imported:
    """The recording in a log of a recording, such as one that was interrupted; it needs no map."""
    recording, lacking = read_log(path)
    return Imported(replace(recording, name=name), [lacking] if lacking else [], (path,))


def import_lerobot(folder: Path, name: str) -> Imported:
    """The recording in a LeRobotDataset whose values have a recording's names; it needs no map."""
    return Imported(load_lerobot(folder, name), [])


def sets_of_files(paths: Sequence[Path], spec: ImportMap) -> list[dict[str, Path]]:
    """The files that belong together: one of each role, in the order in which they are given.

    A role with one file serves every set.
    """
    by_role: dict[str, list[Path]] = {name: [] for name in spec.file}
    for path in _files(paths, spec):
        for name in _roles_served(path, spec):
            by_role[name].append(path)
    main = by_role[spec.main]
    needed = {s.file for s in (spec.measured, spec.commanded, spec.key_points) if s}
    for name, role in spec.file.items():
        count = len(by_role[name])
        if count == 0 and (name == spec.main or name in needed):
            kind = "" if role.format == AUTO else f" and is {reader(role.format).about}"
            raise InputError(
                f"no file for [file.{name}] of the map, expected one that matches "
                f"'{role.match}'{kind}"
            )
        if count not in (0, 1, len(main)):
            raise InputError(
                f"{count} files for [file.{name}] and {len(main)} for "
                f"[file.{spec.main}], expected one, or one for each"
            )
    return [
        {name: files[i if len(files) > 1 else 0] for name, files in by_role.items() if files}
        for i in range(len(main))
    ]


def _files(paths: Sequence[Path], spec: ImportMap) -> list[Path]:
    """The files given, and those of folders that have a role."""
    found: list[Path] = []
    for path in paths:
        if path.is_dir() and any(
            role.format != AUTO and (known := reader(role.format)).is_folder and known.fits(path)
            for role in spec.file.values()
        ):
            found.append(path)
        elif path.is_dir():
            inside = sorted(p for p in path.iterdir() if p.is_file() and _roles_of(p, spec))
            if not inside:
                raise InputError(f"{path}: no file here fits the map, expected {_patterns(spec)}")
            found += inside
        elif path.is_file():
            found.append(path)
        else:
            raise InputError(f"{path}: no such file, expected a raw file to import")
    if not found:
        raise InputError("no raw file given, expected at least one")
    places = [resolved(path) for path in found]
    for path, place in zip(found, places, strict=True):
        if places.count(place) > 1:
            raise InputError(
                f"{path}: given {places.count(place)} times, alone or in a folder, expected each "
                "raw file once: a repeated one would count as another run"
            )
    return found


def _roles_of(path: Path, spec: ImportMap) -> list[str]:
    """The roles whose pattern and format fit."""
    return [
        name
        for name, role in spec.file.items()
        if fnmatch.fnmatch(path.name, role.match)
        and (role.format == AUTO or reader(role.format).fits(path))
    ]


def _roles_served(path: Path, spec: ImportMap) -> list[str]:
    """The first role that fits, and for a file of topics every other role that names a topic."""
    roles = _roles_of(path, spec)
    if not roles:
        raise InputError(f"{path}: fits no file of the map, expected {_patterns(spec)}")
    if chosen(path, spec.file[roles[0]]) not in [READERS[name] for name in OF_TOPICS]:
        return roles[:1]
    topics = [name for name in roles[1:] if spec.file[name].topic or spec.file[name].topics]
    return [roles[0], *topics]


def _patterns(spec: ImportMap) -> str:
    return "one of " + ", ".join(
        f"[file.{name}] '{role.match}'" for name, role in spec.file.items()
    )


def _import_set(files: dict[str, Path], spec: ImportMap) -> Imported:
    """One set of files as a recording on the clock of the main file."""
    tables = {name: open_raw(path, spec.file[name]) for name, path in files.items()}
    measured = _with_columns(spec.measured, tables, "measured")
    commanded = _with_columns(spec.commanded, tables, "commanded") if spec.commanded else None
    commanded = commanded if commanded and commanded.columns else None
    _check_actuation(measured, commanded, tables)
    said = check_columns(uses(spec, measured, commanded), tables)
    points = key_points_of(spec.key_points, tables[spec.key_points.file])
    needed: dict[str, list[Column]] = {name: [] for name in tables}
    needed[measured.file] += measured.columns
    needed[spec.key_points.file] += needed_columns(points, spec.frame)
    held: set[tuple[str, Column]] = set()
    if commanded:
        needed[commanded.file] += commanded.columns
        held = {(commanded.file, column) for column in commanded.columns}
    main = spec.main
    sources = (spec.context.temp_C, spec.context.payload_g)
    needed[main] += [
        source.column
        for source in sources
        if isinstance(source, ContextSource) and source.column is not None
    ]
    needed = {name: list(dict.fromkeys(columns)) for name, columns in needed.items()}
    turns = {spec.key_points.file: quaternions(points, spec.frame)}
    joined = join(tables, spec, held, needed, turns)
    unit_mm = spec.key_points.unit or tables[spec.key_points.file].unit
    if not unit_mm:
        raise InputError(
            f"{tables[spec.key_points.file].path}: does not state the unit of the positions, "
            "expected unit in [key_points] of the map"
        )
    said += _other_unit_than_stated(spec, tables[spec.key_points.file])
    placed = read_points(joined, spec.key_points, points, spec.frame, unit_mm)
    draft = Draft(
        row=joined.rows,
        t_s=joined.t_s,
        measured=_actuation(joined, measured),
        key_points_mm=placed.key_points_mm,
        commanded=_actuation(joined, commanded) if commanded else None,
        context=_context(joined, spec, main),
        run=_runs(joined, spec),
        point=_steady_state_numbers(joined, spec),
    )
    draft, notes = tidy(draft, spec, joined.main.cells.place)
    recording = _recording(draft, spec, measured.to or measured.unit, placed.gravity, joined)
    notes = [*said, *joined.notes, *placed.notes, *notes]
    return Imported(recording, notes, tuple(files.values()))


def _other_unit_than_stated(spec: ImportMap, table: RawTable) -> list[str]:
    """A note where the map reads positions in another unit than the file states."""
    unit = spec.key_points.unit
    if unit is None or spec.key_points.scale != 1.0 or table.unit in ("", unit):
        return []
    return [
        f"{table.path} states that its positions are in {table.unit}, but the map unit = "
        f'"{unit}" in [key_points]: if the file is right, leave out unit'
    ]


def _with_columns(spec: ActuationMap, tables: dict[str, RawTable], part: str) -> ActuationMap:
    """The map's columns, or those named as in a recording, with the unit of their suffix.

    part: the table of the map, [measured] or [commanded]. Raises InputError where the map's unit,
    scale or offset do not fit the columns that are found.
    """
    if spec.columns:
        return spec
    table, letter = tables[spec.file], COLUMN_LETTERS[part]
    pattern = re.compile(rf"{letter}([1-9][0-9]{{0,8}})_([A-Za-z%][A-Za-z0-9%]*)")
    found = sorted(
        (int(match[1]), match[2], name)
        for name in table.names
        if (match := pattern.fullmatch(name))
    )
    units = {unit for _, unit, _ in found}
    if len(units) > 1 or [number for number, _, _ in found] != list(range(1, len(found) + 1)):
        raise InputError(
            f"{table.path}: columns {', '.join(name for _, _, name in found)}, expected "
            f"{letter}1_UNIT, {letter}2_UNIT, ... of one unit without gaps, or columns in the map"
        )
    if not found and spec.optional:
        return spec
    if not found:
        paths = dict.fromkeys(each.path for each in tables.values())
        otherwise = (
            "leave the table out"
            if part == "commanded"
            else f"draft a map of these files: surgisoft import {typed(*paths)} --draft map.toml"
        )
        raise InputError(
            f"{table.path}: no column '{letter}1_kPa' or with another unit, expected the {part} "
            f"actuation; name its columns in [{part}] of the map, or {otherwise}"
        )
    names = tuple(name for _, _, name in found)
    counted = f"{names[0]}{f' ... {names[-1]}' if names[1:] else ''}"
    for field in ("scale", "offset"):
        value = getattr(spec, field)
        if isinstance(value, tuple) and len(value) not in (1, len(names)):
            raise InputError(
                f"{table.path}: {len(names)} columns {counted}, but [{part}] {field} of the map is "
                f"{[*value]}, expected one number, or {len(names)}, one per channel"
            )
    unit = units.pop()
    if spec.unit in ("", unit):
        return replace(spec, columns=names, unit=unit)
    converts = spec.scale is not None or spec.offset is not None
    if not converts and spec.unit != unit_named(unit):
        raise InputError(
            f"{table.path}: columns {counted} state {unit}, but the map unit = "
            f'"{spec.unit}" in [{part}], expected the same unit; leave out unit, or use to = '
            f'"{spec.unit}" to convert, or name the columns in the map if their names are wrong'
        )
    return replace(spec, columns=names)


def _check_actuation(
    measured: ActuationMap, commanded: ActuationMap | None, tables: dict[str, RawTable]
) -> None:
    if commanded is None:
        return
    path = tables[commanded.file].path
    if len(commanded.columns) != len(measured.columns):
        raise InputError(
            f"{path}: {len(commanded.columns)} commanded columns, expected "
            f"{len(measured.columns)} as in [measured] of the map"
        )
    units = [spec.to or spec.unit for spec in (measured, commanded)]
    if units[0] != units[1]:
        raise InputError(
            f"{path}: command in {units[1]} but measured in {units[0]}, expected one unit; "
            "use 'to' in the map"
        )


def _actuation(joined: Joined, spec: ActuationMap) -> np.ndarray:
    """(T, m) in the unit that the map asks for; untouched where it asks for nothing."""
    values = joined.take(spec.file, spec.columns)
    if spec.scale is not None:
        values = values * np.array(spec.scale)
    if spec.offset is not None:
        values = values + np.array(spec.offset)
    by = factor(spec.unit, spec.to) if spec.to else 1.0
    if by is None:
        raise InputError(f"{joined.main.path}: '{spec.unit}' cannot be converted to '{spec.to}'")
    return values if by == 1.0 else values * by


def _context(joined: Joined, spec: ImportMap, main: str) -> np.ndarray:
    """(T, 2) temperature and payload, NaN where the map states nothing."""
    values = np.full((len(joined.t_s), 2), np.nan)
    for i, name in enumerate(("temp_C", "payload_g")):
        source = getattr(spec.context, name)
        if source is not None:
            values[:, i] = _context_value(joined, source, name, main)
    return values


def _context_value(
    joined: Joined, spec: float | ContextSource, name: str, main: str
) -> np.ndarray | float:
    if isinstance(spec, float):
        return spec
    if spec.column is not None:
        return joined.columns[main, spec.column]
    assert spec.from_name is not None, "a source is a value, a column or a part of the file's name"
    match = re.search(spec.from_name, joined.main.path.name)
    if match is None and spec.otherwise is not None:
        return spec.otherwise
    try:
        return float(match[1] if match else "")
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{joined.main.path}: no number for {name} in the file's name by {spec.from_name!r}, "
            "expected one, or 'otherwise' in the map"
        ) from error


def _runs(joined: Joined, spec: ImportMap) -> np.ndarray:
    labels = joined.texts(spec.runs.column) if spec.runs.column is not None else None
    return run_numbers(joined.t_s, labels, spec.runs.gap_s, spec.runs.time_restarts)


def _steady_state_numbers(joined: Joined, spec: ImportMap) -> np.ndarray:
    if spec.rows.average is None:
        return np.zeros(len(joined.t_s), np.int64)
    return point_numbers(joined.texts(spec.rows.average))


def _recording(
    draft: Draft, spec: ImportMap, unit: str, gravity: np.ndarray | None, joined: Joined
) -> Recording:
    about = dict(spec.sidecar)
    if spec.rows.average is not None:
        about.setdefault("kind", "settled")
    if gravity is not None:
        about.setdefault("gravity", gravity)
    if np.isnan(draft.key_points_mm).all():
        raise InputError(
            f"{joined.main.path}: every key point is missing in every row, expected positions"
        )
    return Recording(
        name=_stem(joined.main.path),
        t_s=draft.t_s,
        measured=draft.measured,
        key_points_mm=draft.key_points_mm,
        commanded=draft.commanded,
        run=draft.run,
        unit=unit,
        temp_C=draft.context[:, 0] if spec.context.temp_C is not None else None,
        payload_g=draft.context[:, 1] if spec.context.payload_g is not None else None,
        **about,
    )


def _stem(path: Path) -> str:
    name = path.name
    while Path(name).suffix in _ENDINGS and Path(name).stem:
        name = Path(name).stem
    return name


def _started_at(recording: Recording, spec: ImportMap, zero: float) -> Recording:
    """Times that count from the file's start, the recording's start, or as they are."""
    if spec.time.zero == "none":
        return recording
    start = recording.t_s[0] if spec.time.zero == "file" else zero
    return replace(recording, t_s=recording.t_s - start)


def _as_runs(parts: list[Imported], spec: ImportMap, name: str) -> Imported:
    """The sets as runs of one recording, numbered in the order of the files."""
    recordings = [part.recording for part in parts]
    first = recordings[0]
    for other in recordings[1:]:
        if (other.chambers, other.key_points, other.unit) != (
            first.chambers,
            first.key_points,
            first.unit,
        ):
            raise InputError(
                f"{other.name}: {other.chambers} channels in {other.unit} and "
                f"{other.key_points} key points, expected {first.chambers} in {first.unit} and "
                f"{first.key_points} as in {first.name}"
            )
    placed = [_started_at(r, spec, float(first.t_s[0])) for r in recordings]
    before = np.cumsum([0, *(int(r.run[-1]) + 1 for r in recordings)])
    stacked = {
        field: np.concatenate([getattr(r, field) for r in placed])
        for field in ("t_s", "measured", "key_points_mm", "commanded", "temp_C", "payload_g")
        if all(getattr(r, field) is not None for r in placed)
    }
    run = np.concatenate([r.run + b for r, b in zip(recordings, before, strict=False)])
    changed: dict[str, Any] = {"commanded": None, "gravity": _common_gravity(recordings)}
    whole = replace(first, name=name, run=run, **(changed | stacked))
    notes = [f"{p.recording.name}: {n}" if len(parts) > 1 else n for p in parts for n in p.notes]
    notes = [*_left_out_of_runs(recordings), *notes]
    return Imported(whole, notes, tuple(file for part in parts for file in part.files))


def _left_out_of_runs(recordings: list[Recording]) -> list[str]:
    """A note where some files have a command and others none: then no run of the recording has."""
    lacking = [recording.name for recording in recordings if recording.commanded is None]
    if len(lacking) in (0, len(recordings)):
        return []
    return [f"the command is left out of all runs, because {', '.join(lacking)} has none"]


def _common_gravity(recordings: list[Recording]) -> np.ndarray | None:
    """(3,) mean of the files' directions, which differ because each file has another rest frame."""
    known = [recording.gravity for recording in recordings if recording.gravity is not None]
    if not known:
        return None
    mean = np.mean(known, axis=0)
    return mean / np.linalg.norm(mean)


def _named_apart(parts: list[Imported]) -> list[Imported]:
    """The recordings, whose names differ; InputError where two have one name."""
    names = [part.recording.name for part in parts]
    for name in names:
        if names.count(name) > 1:
            raise InputError(
                f"{names.count(name)} files would become the recording '{name}', expected names "
                "that differ"
            )
    return parts


def _finished(part: Imported, spec: ImportMap) -> Imported:
    recording, notes = part.recording, part.notes
    if spec.rows.frozen == "drop":
        recording, left_out = without_frozen(recording)
        notes = [*notes, *left_out]
    if spec.key_points.spikes == "missing":
        recording, marked = without_spikes(recording)
        notes = [*notes, *marked]
    time_unit = spec.time.unit if spec.time.rate_hz is None and spec.time.scale == 1.0 else None
    notes = [*notes, *plausibility_notes(recording, spec.key_points.unit, time_unit)]
    if spec.runs.gap_s is None and (found := gaps_in_words(recording)):
        notes = [*notes, found]
    delays_s = {"measured": spec.measured.delay_s}
    command = spec.commanded
    if command and recording.commanded is not None and command.file == spec.measured.file:
        delays_s["commanded"] = command.delay_s
    follows = following(recording)
    apart = follows is not None and follows.apart
    notes = [*notes, *timing_notes(recording, delays_s, lead=not apart)]
    warnings = tuple(warnings_of(follows, delays_s))
    return replace(part, recording=recording, notes=notes, warnings=warnings)
