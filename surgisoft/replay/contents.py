"""Duration and views of a Rerun recording, read in a process of its own.

The library that reads .rrd files ends the process where a file is damaged, see `surgisoft.apart`.
"""

import json
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from surgisoft.apart import read_apart

TIME = "time"
"""Timeline of every replay, s since the start."""
LIBRARIES = ("pyarrow.compute", "rerun.chunk")
"""Modules that `surgisoft.apart` imports before it limits the memory: rerun-sdk 0.41 reserves 1 GiB
and starts its threads when it is imported."""


@dataclass(frozen=True)
class Contents:
    """Contents of a Rerun recording."""

    duration_s: float | None
    """Duration on its timeline of seconds, s; None if it has no such timeline."""
    views: tuple[str, ...]
    """Names of the views of its layout; empty where it holds none."""


def contents(recording: str | Path) -> Contents:
    """Duration and views of an .rrd file; raises InputError for one that cannot be read."""
    path = Path(recording)
    state = path.stat()
    return _contents(path.absolute(), state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=4)
def _contents(path: Path, changed_ns: int, size: int) -> Contents:
    """The contents of a file as it is at a time of change and with a size."""
    found = json.loads(read_apart(__name__, path, "a Rerun recording"))
    return Contents(found["duration_s"], tuple(found["views"]))


def read(recording: Path) -> Contents:
    """Duration and views, read in this process, which a damaged file may end."""
    import pyarrow.compute as pc
    from rerun.chunk import RrdReader

    column = "ViewBlueprint:display_name"
    reader, ends, names = RrdReader(recording), [], []
    for chunk in reader.stream():
        if TIME in chunk.timeline_names and chunk.num_rows:
            ends.append(pc.max(chunk.to_record_batch().column(TIME).cast("int64")).as_py())
    for layout in reader.blueprints():
        for chunk in reader.stream(store=layout):
            batch = chunk.to_record_batch()
            if column in batch.schema.names:
                names += [str(name) for row in batch.column(column).to_pylist() for name in row]
    return Contents(max(ends) * 1e-9 if ends else None, tuple(names))


def as_bytes(recording: Path) -> bytes:
    """Contents of a Rerun recording as JSON."""
    found = read(recording)
    return json.dumps({"duration_s": found.duration_s, "views": found.views}).encode()
