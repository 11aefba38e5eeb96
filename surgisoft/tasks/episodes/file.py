"""Episode logs as single .npz files; opening one never runs code of others."""

from __future__ import annotations

import io
import json
import math
import tokenize
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surgisoft.config import value_text
from surgisoft.errors import InputError
from surgisoft.files import write_atomically
from surgisoft.tasks.episodes.consistency import contradiction
from surgisoft.tasks.episodes.log import EpisodeLog
from surgisoft.tasks.episodes.parts import ArmLog, BeamLog, BodyLog, CameraLog, DoseLog, Event

MOST_BYTES = 1 << 29
"""Most bytes that the arrays of an episode may claim; ten minutes of two arms are a tenth of it."""
_HEADERS: dict[tuple[int, int], Any] = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}
SUFFIX = ".npz"
"""Suffix of the file of an episode."""
FORMAT = "surgisoft episode 3"
"""Name and version of the file format."""
SECOND_FORMAT = "surgisoft episode 2"
"""Former format, in which the name of the policy is `driver`."""
FIRST_FORMAT = "surgisoft episode 1"
"""Format before that, of one laser named `laser` and one endoscope named `endoscope`."""


def save_episode(log: EpisodeLog, path: str | Path) -> None:
    """Write the log to an .npz file, whole or not at all."""
    path = Path(path)
    if path.suffix != SUFFIX:
        raise InputError(f"{path}: suffix '{path.suffix}', expected {SUFFIX} for an episode")
    arrays: dict[str, np.ndarray] = {}
    table = {"format": FORMAT, "log": _split(log, "", arrays)}
    arrays["table"] = np.frombuffer(json.dumps(table).encode(), dtype=np.uint8)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **arrays)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, buffer.getvalue())


def load_episode(path: str | Path) -> EpisodeLog:
    """Read a log that `save_episode` wrote; an InputError for anything else."""
    path = Path(path)
    wanted = "expected an episode's log, such as one in 'logs' of an experiment's results"
    if not path.is_file():
        raise InputError(f"{path}: there is no such file; {wanted}")
    try:
        arrays = _arrays(path)
    except (OSError, EOFError, ValueError, NotImplementedError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be read as .npz ({error}); {wanted}") from None
    except (zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: cannot be read as .npz ({error}); {wanted}") from None
    try:
        table = json.loads(arrays.pop("table").tobytes())
        version = table["format"]
        if version not in (FORMAT, SECOND_FORMAT, FIRST_FORMAT):
            raise InputError(f"{path}: format {value_text(version)}, expected '{FORMAT}'")
        joined = _joined(table["log"], arrays)
        log = _log(_present(joined, version))
    except InputError:
        raise
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError):
        raise InputError(f"{path}: is not a complete episode; {wanted}") from None
    complaint = contradiction(log)
    if complaint is not None:
        raise InputError(f"{path}: {complaint}; {wanted}")
    return log


def _arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an .npz file, none of which claims more than the file holds.

    Unsigned integers become signed ones, whose differences have a sign. A ValueError states the
    first array that claims more; nothing is allocated for it.
    """
    arrays = {}
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        total = sum(member.file_size for member in members)
        if total > MOST_BYTES:
            raise ValueError(f"it claims {total} bytes, expected at most {MOST_BYTES}")
        for member in members:
            with archive.open(member) as file:
                version = np.lib.format.read_magic(file)
                if version not in _HEADERS:
                    raise ValueError(f"'{member.filename}' has an unknown version of .npy")
                try:
                    shape, fortran, kind = _HEADERS[version](file)
                except tokenize.TokenError:  # NumPy reads headers of Python 2 by its tokens
                    raise ValueError(f"'{member.filename}' has no header of .npy") from None
                claimed = math.prod(shape) * kind.itemsize
                if kind.hasobject:
                    raise ValueError(f"'{member.filename}' holds Python objects, not numbers")
                if min(shape, default=0) < 0 or claimed > member.file_size:
                    raise ValueError(f"'{member.filename}' claims an array that is not in it")
                content = file.read(claimed)
            if len(content) < claimed:
                raise ValueError(f"'{member.filename}' is cut off")
            flat = np.frombuffer(content, kind)
            whole = flat.reshape(shape[::-1]).T if fortran else flat.reshape(shape)
            name = member.filename.removesuffix(".npy")
            unsigned = kind.kind == "u" and name != "table"
            arrays[name] = whole.astype(np.int64) if unsigned else whole
    return arrays


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


def _present(table: dict[str, Any], version: str) -> dict[str, Any]:
    """The table of a log of any format as one of the present format."""
    if version in (SECOND_FORMAT, FIRST_FORMAT):
        table["policy"] = table.pop("driver")
    if version != FIRST_FORMAT:
        return table
    beam, camera, view = (table.pop(name) for name in ("beam", "camera", "view_fraction"))
    table["beams"] = {} if beam is None else {"laser": beam}
    table["cameras"] = {} if camera is None else {"endoscope": camera}
    table["views"] = {} if view is None else {"endoscope": view}
    if beam is not None:
        for name, arm in table["arms"].items():
            arm["tool"] = name if name in ("laser", "endoscope") else ""
    return table


def _log(table: dict[str, Any]) -> EpisodeLog:
    table["arms"] = {name: ArmLog(**arm) for name, arm in table["arms"].items()}
    for name, kind in (("beams", BeamLog), ("cameras", CameraLog)):
        table[name] = {arm: kind(**part) for arm, part in table[name].items()}
    table["dose"] = None if table["dose"] is None else DoseLog(**table["dose"])
    table["bodies"] = tuple(BodyLog(**body) for body in table["bodies"])
    table["events"] = tuple(Event(**event) for event in table["events"])
    return EpisodeLog(**table)
