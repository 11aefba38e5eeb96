"""Episode logs as single .npz files; opening one never runs code of others."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surgisoft.errors import InputError
from surgisoft.files import write_atomically
from surgisoft.tasks.episodes.log import EpisodeLog
from surgisoft.tasks.episodes.parts import ArmLog, BeamLog, BodyLog, CameraLog, DoseLog, Event

SUFFIX = ".npz"
"""Suffix of the file of an episode."""
FORMAT = "surgisoft episode 1"
"""Name and version of the file format."""


def save_episode(log: EpisodeLog, path: str | Path) -> None:
    """Write the log to an .npz file, whole or not at all."""
    path = Path(path)
    if path.suffix != SUFFIX:
        raise InputError(f"{path}: suffix '{path.suffix}', expected {SUFFIX} for an episode")
    arrays: dict[str, np.ndarray] = {}
    table = {"format": FORMAT, "log": _split(log, "", arrays)}
    arrays["table"] = np.frombuffer(json.dumps(table).encode(), dtype=np.uint8)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, buffer.getvalue())


def load_episode(path: str | Path) -> EpisodeLog:
    """Read a log that `save_episode` wrote; an InputError for anything else."""
    path = Path(path)
    wanted = "expected an episode's log as 'surgisoft evaluate --log' writes it"
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; {wanted}")
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        table = json.loads(arrays.pop("table").tobytes())
        if table["format"] != FORMAT:
            raise InputError(f"{path}: format '{table['format']}', expected '{FORMAT}'")
        return _log(_joined(table["log"], arrays))
    except (OSError, EOFError, zipfile.BadZipFile):
        raise InputError(f"{path}: cannot be read as .npz; {wanted}") from None
    except InputError:
        raise
    except (AttributeError, KeyError, TypeError, ValueError):
        raise InputError(f"{path}: is not a complete episode; {wanted}") from None


def _split(value: Any, name: str, arrays: dict[str, np.ndarray]) -> Any:
    """The value as JSON; its arrays go to `arrays`, and their names stand in their place."""
    if isinstance(value, np.ndarray):
        arrays[name] = value
        return {"array": name}
    if is_dataclass(value):
        value = {field.name: getattr(value, field.name) for field in fields(value)}
    if isinstance(value, Mapping):
        return {
            "table": {key: _split(part, f"{name}/{key}", arrays) for key, part in value.items()}
        }
    if isinstance(value, tuple):
        return [_split(part, f"{name}/{i}", arrays) for i, part in enumerate(value)]
    return value


def _joined(value: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """What `_split` made, with dataclasses as dicts."""
    if isinstance(value, list):
        return tuple(_joined(part, arrays) for part in value)
    if isinstance(value, dict) and "array" in value:
        return arrays[value["array"]]
    if isinstance(value, dict):
        return {key: _joined(part, arrays) for key, part in value["table"].items()}
    return value


def _log(table: dict[str, Any]) -> EpisodeLog:
    table["arms"] = {name: ArmLog(**arm) for name, arm in table["arms"].items()}
    for name, kind in (("beam", BeamLog), ("camera", CameraLog), ("dose", DoseLog)):
        table[name] = None if table[name] is None else kind(**table[name])
    table["bodies"] = tuple(BodyLog(**body) for body in table["bodies"])
    table["events"] = tuple(Event(**event) for event in table["events"])
    return EpisodeLog(**table)
