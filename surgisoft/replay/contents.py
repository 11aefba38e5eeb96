"""Duration and views of a Rerun recording, read in a process of its own.

The library that reads .rrd files ends the process where a file is damaged (rerun-sdk 0.41 aborts
on several kinds of damage), and a length that a file claims decides how much it allocates. So a
child process with limits reads the file, and its end is an error of one line here.
"""

import json
import subprocess
import sys
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

from surgisoft.errors import InputError

TIME = "time"
"""Timeline of every replay, s since the start."""
MEMORY_BYTES = 4 << 30
"""Address space of the reading process, bytes; most of it is the library's own."""
MEMORY_PER_BYTE = 20
"""Address space beyond that for each byte of the file."""
PATIENCE_S = 120
"""Longest processor time of the reading process, s."""


@dataclass(frozen=True)
class Contents:
    """What a recording holds."""

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
    child = subprocess.run(
        [sys.executable, "-m", "surgisoft.replay.contents", str(path)],
        stdin=subprocess.DEVNULL,
        capture_output=True,
    )
    lines = child.stdout.decode("utf-8", "replace").splitlines()
    if child.returncode != 0 or not lines:
        said = child.stderr.decode("utf-8", "replace").strip().splitlines()[-1:] or ["it ended"]
        raise InputError(
            f"{path}: cannot be read as a Rerun recording ({said[0][:200]}); it is damaged, write "
            "it again"
        )
    found = json.loads(lines[-1])
    return Contents(found["duration_s"], tuple(found["views"]))


def _limit(size: int) -> None:
    """Limit this process: address space, processor time, no core file; Windows has no limits."""
    try:
        import resource
    except ImportError:
        return
    most = MEMORY_BYTES + MEMORY_PER_BYTE * size
    wanted = ((resource.RLIMIT_AS, most), (resource.RLIMIT_CPU, PATIENCE_S))
    for kind, limit in (*wanted, (resource.RLIMIT_CORE, 0)):
        hard = resource.getrlimit(kind)[1]
        limit = limit if hard == resource.RLIM_INFINITY else min(limit, hard)
        resource.setrlimit(kind, (limit, hard))


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


if __name__ == "__main__":
    file = Path(sys.argv[1])
    _limit(file.stat().st_size)
    found = read(file)
    sys.stdout.write(json.dumps({"duration_s": found.duration_s, "views": found.views}) + "\n")
