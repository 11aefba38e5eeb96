"""Recordings as LeRobotDataset v3.0, the format of Hugging Face's LeRobot; LeRobot is not needed.

A run is an episode. `observation.state` holds measured actuation and key points, `action` the
commanded actuation, each under the names of a recording's columns (`p1_kPa`, `k0_x_mm`, `c1_kPa`),
so that a dataset that `lerobot-record` wrote with the robot of `surgisoft.rig.lerobot` opens here,
too. The action of a frame is what is commanded *after* its observation, hence the command of the
recording's next row. Frames stand on a grid of an integer number of frames per second, as the
format requires.

Source: the format as LeRobot 0.4.4 writes and reads it (`codebase_version` "v3.0").
"""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from surgisoft.config import from_table, read_toml
from surgisoft.errors import InputError
from surgisoft.files import new_folder, read_json
from surgisoft.measurement.parquet_pages import check_claim, open_metadata
from surgisoft.measurement.recordings.columns import parse_header
from surgisoft.measurement.recordings.recording import Recording
from surgisoft.measurement.recordings.sidecar import Sidecar, sidecar_text

VERSION = "v3.0"
"""Version of the format that is written and read."""
INFO = Path("meta", "info.json")
"""File that a dataset is known by."""
SIDECAR = Path("meta", "surgisoft.toml")
"""What LeRobot has no place for: the arm, gravity, noise. Other programs ignore it."""
STATE, ACTION = "observation.state", "action"
"""Features that hold a recording."""
COMMANDED = "commanded"
"""Feature of the commands in force when a frame was measured; LeRobot's own datasets lack it."""
TIME = "t_s"
"""Feature of the time since the recording began [s]: timestamps begin anew in each episode, slow
drifts do not."""
TASK = "Drive the soft arm."
"""Description of every episode's task where none is given; LeRobot requires one."""
ROBOT = "surgisoft_rig"
"""Type of the robot that the plug-in registers with LeRobot."""
LARGEST_FILE_MB = 100
"""Size of a data file beyond which the next episode begins another one (LeRobot's default)."""
FILES_IN_CHUNK = 1000
"""Files in a folder chunk-NNN (LeRobot's default)."""
ON_GRID_S = 1e-4
"""Difference from the grid's times up to which measured values are kept as they are (LeRobot's
tolerance of timestamps)."""
LONGEST_STEP = 2.5
"""Steps of more than this many frames are gaps: an episode ends there."""
WHOLE_RATE = 0.005
"""Share by which a rate may be off an integer number of frames per second."""
QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
"""Quantiles in a dataset's statistics (q01 ... q99)."""
_INDICES = ("timestamp", "frame_index", "episode_index", "index", "task_index")


def is_dataset(folder: Path) -> bool:
    """Whether a folder is a LeRobotDataset."""
    return (folder / INFO).is_file()


@dataclass(frozen=True, eq=False)
class _Episode:
    t_s: np.ndarray
    """(T,) time of each frame since the recording began [s]."""
    state: np.ndarray
    """(T, c) values of `observation.state`."""
    commanded: np.ndarray | None
    """(T, m) commands in force when the frames were measured."""

    @property
    def features(self) -> dict[str, np.ndarray]:
        values = {STATE: self.state}
        if self.commanded is None:
            return values
        following = np.concatenate([self.commanded[1:], self.commanded[-1:]])
        return values | {ACTION: following, COMMANDED: self.commanded}


def save_lerobot(
    recordings: Sequence[Recording],
    folder: str | Path,
    task: str = TASK,
    fps: int | None = None,
) -> list[str]:
    """Write recordings of one arm as a LeRobotDataset; returns notes of what changed on the way.

    folder: a new one, written as a whole. task: what the robot does, in words. fps: frames a
    second; left out, the rate of the recordings, which must then be an integer. Values between the
    samples are linear, commands are held, and a gap in the times ends an episode.

    Raises InputError for steady-state recordings, other columns from recording to recording, a
    rate that is no integer, and a folder that is not empty.
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: exists already, expected a new folder")
    if fps is not None and fps < 1:
        raise InputError(f"fps is {fps}, expected at least 1")
    first = recordings[0]
    names = _names(first)
    for recording in recordings:
        if recording.kind == "settled":
            raise InputError(
                f"{recording.label}: steady-state samples, which have no rate; expected a "
                "continuous recording"
            )
        if _names(recording) != names:
            raise InputError(
                f"{recording.label}: other columns than {first.label}; expected the same chambers, "
                "key points, unit and commands in every recording"
            )
    rate = fps or _rate(recordings)
    notes: list[str] = []
    episodes = [e for recording in recordings for e in _episodes(recording, rate, notes)]
    if not episodes:
        raise InputError(f"{first.label}: no run of two frames at {rate} frames per second")
    lost = sum(int(np.isnan(e.state).any(axis=1).sum()) for e in episodes)
    if lost:
        total = sum(len(e.state) for e in episodes)
        notes.append(f"{lost} of {total} frames lack a key point (NaN); a policy cannot take them")
    notes += _left_out(recordings, names[STATE])
    with new_folder(folder) as draft:
        _write(draft, episodes, names, rate, task)
        # An alarm is that of one recording, and the sidecar counts for all.
        (draft / SIDECAR).write_text(sidecar_text(replace(first, alarm=None)), encoding="utf-8")
    return notes


def _names(recording: Recording) -> dict[str, list[str]]:
    """Names of the values of each feature, in order."""
    chambers = range(1, recording.chambers + 1)
    points = [f"k{j}_{axis}_mm" for j in range(recording.key_points) for axis in "xyz"]
    names = {STATE: [f"p{i}_{recording.unit}" for i in chambers] + points}
    if recording.temp_C is not None and np.isfinite(recording.temp_C).all():
        names[STATE].append("temp_C")
    if recording.commanded is not None:
        names[ACTION] = names[COMMANDED] = [f"c{i}_{recording.unit}" for i in chambers]
    return names


def _left_out(recordings: Sequence[Recording], state: list[str]) -> list[str]:
    """Notes on context of recordings that the values of a frame do not have."""
    notes = []
    for name in ("temp_C", "payload_g"):
        known = [(r.name, getattr(r, name)) for r in recordings if name not in state]
        some = [label for label, x in known if x is not None and np.isfinite(x).any()]
        if some:
            why = "has gaps" if name == "temp_C" else "is no value of a dataset"
            notes.append(f"{name} of {', '.join(some)} {why} and is left out")
    return notes


def _rate(recordings: Sequence[Recording]) -> int:
    """Frames a second of the recordings; InputError where it is no integer."""
    steps = np.concatenate([np.diff(r.t_s[run]) for r in recordings for run in r.runs])
    if not len(steps):
        raise InputError(f"{recordings[0].label}: no run has two samples, expected some")
    rate = 1 / float(np.median(steps))
    if round(rate) < 1 or abs(rate / round(rate) - 1) > WHOLE_RATE:
        raise InputError(
            f"{recordings[0].label}: {rate:.4g} samples per second, and a LeRobotDataset has an "
            "integer number of frames per second; state it with --fps"
        )
    return round(rate)


def _episodes(recording: Recording, fps: int, notes: list[str]) -> Iterator[_Episode]:
    """The runs of a recording on the grid of `fps` frames per second, without their gaps."""
    state = np.hstack([recording.measured, recording.key_points_mm.reshape(recording.samples, -1)])
    if "temp_C" in _names(recording)[STATE]:
        assert recording.temp_C is not None
        state = np.column_stack([state, recording.temp_C])
    moved = 0
    for run in recording.runs:
        t_s = recording.t_s[run]
        usual = float(np.median(np.diff(t_s))) if len(t_s) > 1 else 0.0
        gaps = np.flatnonzero(np.diff(t_s) > LONGEST_STEP * max(usual, 1 / fps)) + 1
        if len(gaps):
            notes.append(f"{recording.label}: {len(gaps)} gaps in the times, where episodes end")
        for rows in np.split(np.arange(run.start, run.stop), gaps):
            grid = (
                recording.t_s[rows[0]]
                + np.arange(
                    1 + int((recording.t_s[rows[-1]] - recording.t_s[rows[0]]) * fps + 0.01)
                )
                / fps
            )
            if len(grid) < 2:
                continue
            same = len(grid) == len(rows)
            same = same and bool(np.abs(grid - recording.t_s[rows]).max() <= ON_GRID_S)
            moved += 0 if same else len(grid)
            command = recording.commanded
            yield _Episode(
                grid,
                state[rows] if same else _linear(grid, recording.t_s[rows], state[rows]),
                None
                if command is None
                else command[rows[np.searchsorted(recording.t_s[rows], grid + 1e-9, "right") - 1]],
            )
    if moved:
        notes.append(f"{recording.label}: {moved} frames interpolated onto {fps} frames per second")


def _linear(grid: np.ndarray, t_s: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(F, c) values (T, c) on a line between samples; NaN beside a missing one."""
    return np.stack([np.interp(grid, t_s, column) for column in values.T], axis=1)


def _write(
    folder: Path, episodes: list[_Episode], names: dict[str, list[str]], fps: int, task: str
) -> None:
    """All files of a dataset in a folder that is empty."""
    features: dict[str, Any] = {
        key: {"dtype": "float32", "shape": [len(some)], "names": some}
        for key, some in names.items()
    }
    features[TIME] = {"dtype": "float64", "shape": [1], "names": None}
    features["timestamp"] = {"dtype": "float32", "shape": [1], "names": None}
    for key in _INDICES[1:]:
        features[key] = {"dtype": "int64", "shape": [1], "names": None}
    width = sum(map(len, names.values()))
    frames, file, size_mb = 0, 0, 0.0
    group: list[pa.Table] = []
    about: list[dict[str, Any]] = []
    parts: dict[str, list[np.ndarray]] = {}
    for index, episode in enumerate(episodes):
        length = len(episode.state)
        mb = length * (4 * width + 44) / 2**20
        if group and size_mb + mb > LARGEST_FILE_MB:
            _table(folder, "data", file, pa.concat_tables(group))
            group, file, size_mb = [], file + 1, 0.0
        values: dict[str, np.ndarray] = {
            key: some.astype(np.float32) for key, some in episode.features.items()
        }
        values |= {
            TIME: episode.t_s,
            "timestamp": (np.arange(length) / fps).astype(np.float32),
            "frame_index": np.arange(length),
            "episode_index": np.full(length, index),
            "index": np.arange(frames, frames + length),
            "task_index": np.zeros(length, np.int64),
        }
        group.append(pa.table({key: _column(some) for key, some in values.items()}))
        size_mb += mb
        for key, some in values.items():
            parts.setdefault(key, []).append(some)
        about.append(
            {
                "episode_index": index,
                "tasks": [task],
                "length": length,
                "data/chunk_index": file // FILES_IN_CHUNK,
                "data/file_index": file % FILES_IN_CHUNK,
                "dataset_from_index": frames,
                "dataset_to_index": frames + length,
            }
            | {
                f"stats/{key}/{name}": number
                for key, some in values.items()
                for name, number in _statistics(some).items()
            }
            | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        )
        frames += length
    _table(folder, "data", file, pa.concat_tables(group))
    _table(folder, "meta/episodes", 0, pa.Table.from_pylist(about))
    pq.write_table(_tasks(task), folder / "meta" / "tasks.parquet")
    statistics = {key: _statistics(np.concatenate(some)) for key, some in parts.items()}
    _json(folder / "meta" / "stats.json", statistics)
    _json(
        folder / INFO,
        {
            "codebase_version": VERSION,
            "robot_type": ROBOT,
            "total_episodes": len(episodes),
            "total_frames": frames,
            "total_tasks": 1,
            "chunks_size": FILES_IN_CHUNK,
            "data_files_size_in_mb": LARGEST_FILE_MB,
            "video_files_size_in_mb": 200,
            "fps": fps,
            "splits": {"train": f"0:{len(episodes)}"},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": None,
            "features": features,
        },
    )


def _table(folder: Path, kind: str, file: int, table: pa.Table) -> None:
    path = folder / kind / f"chunk-{file // FILES_IN_CHUNK:03d}"
    path.mkdir(parents=True, exist_ok=True)
    pq.write_table(table, path / f"file-{file % FILES_IN_CHUNK:03d}.parquet")


def _column(values: np.ndarray) -> pa.Array:
    if values.ndim == 1:
        return pa.array(values)
    flat = pa.array(np.ascontiguousarray(values).reshape(-1))
    return pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _tasks(task: str) -> pa.Table:
    """The table of tasks, whose index in pandas is the description, as LeRobot reads it."""
    table = pa.table({"task_index": pa.array([0], pa.int64()), "task": [task]})
    column = {"field_name": "task", "name": "task", "pandas_type": "unicode", "metadata": None}
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": [
            column
            | {"field_name": "task_index", "name": "task_index", "pandas_type": "int64"}
            | {"numpy_type": "int64"},
            column | {"numpy_type": "object"},
        ],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.0.0",
    }
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})


def _json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=4), encoding="utf-8")


def _statistics(values: np.ndarray) -> dict[str, list[float] | list[int]]:
    """Least, largest, mean, spread and quantiles of each value, without missing ones."""
    table = np.asarray(values, np.float64).reshape(len(values), -1)
    known = ~np.isnan(table)
    gone = ~known.any(axis=0)
    filled = np.where(gone, 0.0, table)
    numbers = {
        "min": np.nanmin(filled, axis=0),
        "max": np.nanmax(filled, axis=0),
        "mean": np.nanmean(filled, axis=0),
        "std": np.nanstd(filled, axis=0),
    }
    numbers |= {f"q{round(100 * q):02d}": np.nanquantile(filled, q, axis=0) for q in QUANTILES}
    lists: dict[str, list[float] | list[int]] = {k: v.tolist() for k, v in numbers.items()}
    return lists | {"count": [len(table)]}


@dataclass(frozen=True, eq=False)
class LeRobotFrames:
    """All frames of a LeRobotDataset without its pictures: columns named FEATURE.NAME.

    `observation.state.p1_kPa`; a feature without names has FEATURE.0, FEATURE.1, ...; a feature of
    one value is called like the feature. Cells for `surgisoft.measurement.tables`.
    """

    folder: Path
    """Folder of the dataset."""
    info: dict[str, Any]
    """Content of meta/info.json."""
    names: list[str]
    """Names of the columns."""
    values: np.ndarray
    """(T, c) float64, episodes in order."""

    @classmethod
    def open(cls, folder: Path) -> "LeRobotFrames":
        """Read a dataset; raises InputError where it is damaged or of another version."""
        info = _info(folder)
        columns = _columns_of(folder, info["features"])
        files = sorted((folder / "data").glob("chunk-*/file-*.parquet"))
        if not files:
            raise InputError(f"{folder}: no data/chunk-*/file-*.parquet, expected the frames there")
        parts = [_frames(file, columns) for file in files]
        names = [name for some in columns.values() for name in some]
        values = np.concatenate(parts)
        episode, frame = (values[:, names.index(key)] for key in ("episode_index", "frame_index"))
        return cls(folder, info, names, values[np.lexsort((frame, episode))])

    def numbers(self, positions: Sequence[int]) -> np.ndarray:
        """Cells (T, len(positions)) of columns counted from 0, NaN where missing."""
        return self.values[:, list(positions)]

    def texts(self, position: int) -> list[str]:
        """Cells (T,) of one column as text."""
        return [f"{value:g}" for value in self.values[:, position]]

    def place(self, row: int) -> str:
        """Where a row, counted from 0, is in the dataset."""
        episode, frame = (
            self.values[row, self.names.index(key)] for key in ("episode_index", "frame_index")
        )
        return f"{self.folder}, episode {episode:.0f}, frame {frame:.0f}"

    @property
    def t_s(self) -> np.ndarray:
        """(T,) time of each frame since the recording began, or since the episode began [s].

        LeRobot's own datasets do not have the first.

        Timestamps are stored as 32-bit numbers; where they are those of the grid, the grid's are
        returned.
        """
        if TIME in self.names:
            return self.values[:, self.names.index(TIME)]
        stamp, frame = (self.values[:, self.names.index(k)] for k in ("timestamp", "frame_index"))
        grid = frame / self.info["fps"]
        return grid if np.abs(stamp - grid).max(initial=0.0) <= ON_GRID_S else stamp


def load_lerobot(folder: str | Path, name: str | None = None) -> Recording:
    """Read a LeRobotDataset whose features have the names of a recording's columns.

    Such datasets come from `save_lerobot`, and from LeRobot with the robot `surgisoft_rig`. Others
    need a map with format = "lerobot" (docs/recordings.md). Raises InputError for what is missing.
    """
    folder = Path(folder)
    frames = LeRobotFrames.open(folder)
    shifted = not any(name.startswith(COMMANDED + ".") for name in frames.names)
    own = {
        column: i
        for i, full in enumerate(frames.names)
        for feature in (STATE, ACTION if shifted else COMMANDED)
        if (column := full.removeprefix(feature + ".")) != full
    }
    try:
        layout = parse_header(["t_s", "run", *own], str(folder))
    except InputError as error:
        raise InputError(
            f'{error}; a dataset with other names needs a map with format = "lerobot"'
        ) from error
    at = [-1, -1, *own.values()]
    episode = frames.values[:, frames.names.index("episode_index")].astype(np.int64)
    rows = np.arange(len(episode))
    before = rows
    if layout.commanded and shifted:  # an episode's first frame has no known command
        rows = np.flatnonzero(np.diff(episode, prepend=episode[:1]) == 0)[1:]
        before = rows - 1
    if not len(rows):
        raise InputError(f"{folder}: no episode of two frames, expected one")

    def cells(positions: Sequence[int], rows: np.ndarray = rows) -> np.ndarray:
        return frames.values[rows][:, [at[i] for i in positions]]

    missing = np.isnan(cells(layout.measured)).any(axis=1)
    missing |= np.isnan(cells(layout.commanded, before)).any(axis=1)
    if missing.any():
        raise InputError(
            f"{frames.place(int(rows[np.flatnonzero(missing)[0]]))}: the actuation is missing, "
            "expected numbers in every frame"
        )
    sidecar = folder / SIDECAR
    facts = from_table(Sidecar, *read_toml(sidecar)).fields if sidecar.is_file() else {}
    points = cells(layout.key_points) * layout.mm_per_unit
    return Recording(
        name=name or folder.name,
        t_s=frames.t_s[rows],
        measured=cells(layout.measured),
        key_points_mm=points.reshape(len(points), -1, 3),
        commanded=cells(layout.commanded, before) if layout.commanded else None,
        run=episode[rows],
        unit=layout.unit,
        temp_C=None if layout.temp is None else cells([layout.temp])[:, 0],
        source=folder,
        **facts,
    )


def _info(folder: Path) -> dict[str, Any]:
    """Content of meta/info.json, checked."""
    path = folder / INFO
    try:
        info = read_json(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not readable as JSON, expected a LeRobotDataset") from error
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if version != VERSION:
        raise InputError(
            f"{path}: codebase_version is {str(version)[:40]!r}, expected {VERSION!r}; LeRobot "
            "converts older datasets"
        )
    fps, features = info.get("fps"), info.get("features")
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not 0 < fps < 1e6:
        raise InputError(f"{path}: fps is {str(fps)[:40]!r}, expected a number above 0")
    if not isinstance(features, dict) or not all(isinstance(f, dict) for f in features.values()):
        raise InputError(f"{path}: no table of features, expected one")
    return info


def _columns_of(folder: Path, features: dict[str, Any]) -> dict[str, list[str]]:
    """Names of the columns that each feature of numbers becomes."""
    columns = {}
    for key, feature in features.items():
        shape = feature.get("shape")
        if feature.get("dtype") in ("image", "video", "string"):
            continue
        if not isinstance(shape, list) or len(shape) != 1 or not isinstance(shape[0], int):
            continue
        names = feature.get("names")
        if isinstance(names, dict):  # as older robots wrote them: {"motors": [...]}
            names = [name for some in names.values() if isinstance(some, list) for name in some]
        if not isinstance(names, list) or len(names) != shape[0]:
            names = [str(i) for i in range(shape[0])] if 0 < shape[0] <= 10_000 else []
        plain = shape[0] == 1 and not feature.get("names")
        columns[key] = [key] if plain else [f"{key}.{name}" for name in names]
    for key in ("timestamp", "episode_index", "frame_index"):
        if columns.get(key) != [key]:
            raise InputError(
                f"{folder / INFO}: no feature '{key}' of one value, expected it in {VERSION}"
            )
    return columns


def _frames(file: Path, columns: dict[str, list[str]]) -> np.ndarray:
    """(T, c) the frames of one file."""
    width = sum(map(len, columns.values()))
    try:
        rows = open_metadata(file).num_rows
        check_claim(file, 8 * rows * width, f"{rows} frames of {width} numbers")
        table = pq.read_table(file, columns=list(columns))
        blocks = [_block(table[key].combine_chunks(), len(columns[key])) for key in columns]
        return np.column_stack(blocks)
    except (pa.ArrowException, OSError, ValueError, KeyError, TypeError) as error:
        reason = str(error).splitlines()[0][:120] if str(error) else type(error).__name__
        raise InputError(f"{file}: not the frames that info.json describes ({reason})") from error


def _block(column: pa.Array, width: int) -> np.ndarray:
    """(T, width) numbers of a feature."""
    if pa.types.is_list(column.type) or pa.types.is_fixed_size_list(column.type):
        if column.null_count:
            raise ValueError("a frame without values")
        lengths = np.asarray(pc.list_value_length(column))
        if (lengths != width).any():
            raise ValueError(f"lists of {lengths[lengths != width][0]} values, expected {width}")
        column = column.flatten()
    return column.cast(pa.float64(), safe=False).to_numpy(zero_copy_only=False).reshape(-1, width)
