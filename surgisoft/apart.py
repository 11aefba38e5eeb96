"""Reading of a file in a process of its own, by a library that may end the process it is in.

rerun-sdk 0.41 aborts on several kinds of damage. ezc3d 1.7, SciPy 1.17's `loadmat` and HDF5 (h5py
3.16) end in a segmentation fault on some bytes, and a length that a file claims decides how much
they allocate. A child process with limits calls the library; its end is an error of one line here.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import json
import math
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surgisoft.errors import InputError

ADDRESS_BYTES = 4 << 30
"""Address space of the reading process, bytes; most of it is the libraries' own."""
MEMORY_BYTES = 1 << 30
"""Memory that the reading process may take for a file, bytes; on Linux alone."""
MEMORY_PER_BYTE = 20
"""Address space and memory beyond these for each byte of the file."""
PATIENCE_S, PATIENCE_S_PER_MB = 4.0, 1.0
"""Longest processor time for reading a file, s, and s more for each MB of it."""
STATM = Path("/proc/self/statm")
"""Pages of memory of this process on Linux (proc(5)); the sixth number are data and stack."""
REFUSED = 2
"""Exit status of a reading process that says in one line why it does not read the file."""


@dataclass(frozen=True)
class Ended:
    """How a reading process ended."""

    code: int
    """Its exit status; negative: the signal that ended it."""
    out: bytes
    """What it wrote to the standard output."""
    errors: bytes
    """What it wrote to the standard error."""

    @property
    def reason(self) -> str:
        """The last line that it wrote, or which signal ended it."""
        said = self.errors.decode("utf-8", "replace").strip().splitlines()
        return said[-1][:200] if said else f"its process ended with status {self.code}"


def read_apart(module: str, path: Path, what: str) -> bytes:
    """Result of `module.as_bytes(path)`, computed in a separate process.

    what: the kind of file in words. Raises the InputError that the reader raises there, or one
    where the process does not end well.
    """
    ended = started(module, path)
    if ended.code == REFUSED:
        raise InputError(ended.reason if ended.errors else f"{path}: is not read as {what}")
    if ended.code != 0:
        raise InputError(
            f"{path}: cannot be read as {what} ({ended.reason}); it is damaged, write it again"
        )
    return ended.out


def started(module: str, path: Path) -> Ended:
    """Run the reading process to its end."""
    child = subprocess.run(
        [sys.executable, "-m", "surgisoft.apart", module, str(path)],
        stdin=subprocess.DEVNULL,
        capture_output=True,
    )
    return Ended(child.returncode, child.stdout, child.stderr)


def packed(facts: Any, *arrays: np.ndarray) -> bytes:
    """Facts, as JSON, and arrays as the bytes of an .npz file."""
    out = io.BytesIO()
    text = np.frombuffer(json.dumps(facts).encode(), np.uint8)
    named: dict[str, Any] = {f"a{i}": array for i, array in enumerate(arrays)}
    np.savez(out, facts=text, **named)
    return out.getvalue()


def unpacked(content: bytes) -> tuple[Any, list[np.ndarray]]:
    """The facts and arrays of `packed`; nothing in them is run."""
    with np.load(io.BytesIO(content), allow_pickle=False) as file:
        arrays = [file[f"a{i}"] for i in range(len(file.files) - 1)]
        return json.loads(file["facts"].tobytes()), arrays


def limit(size: int) -> None:
    """Limit this process for a file of so many bytes, as far as the system can.

    Address space, memory beyond what the process has already, processor time, no core file. Windows
    has no limits, and macOS refuses one of the address space.
    """
    try:
        import resource
    except ImportError:
        return
    more = MEMORY_PER_BYTE * size
    longest_s = math.ceil(time.process_time() + PATIENCE_S + PATIENCE_S_PER_MB * 1e-6 * size)
    wanted = [(resource.RLIMIT_AS, ADDRESS_BYTES + more), (resource.RLIMIT_CPU, longest_s)]
    if STATM.is_file():  # only Linux counts mapped memory in RLIMIT_DATA
        own = int(STATM.read_text().split()[5]) * resource.getpagesize()
        wanted.append((resource.RLIMIT_DATA, own + MEMORY_BYTES + more))
    for kind, value in (*wanted, (resource.RLIMIT_CORE, 0)):
        hard = resource.getrlimit(kind)[1]
        value = value if hard == resource.RLIM_INFINITY else min(value, hard)
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(kind, (value, hard))


def answer(module: str, path: Path) -> int:
    """Read the file in this process and write what was found; the exit status."""
    reader = importlib.import_module(module)
    for library in getattr(reader, "LIBRARIES", ()):
        importlib.import_module(library)
    limit(path.stat().st_size)
    try:
        found = reader.as_bytes(path)
    except InputError as error:
        sys.stderr.write(f"{error}\n")
        return REFUSED
    sys.stdout.buffer.write(found)
    sys.stdout.buffer.flush()
    return 0


if __name__ == "__main__":
    sys.exit(answer(sys.argv[1], Path(sys.argv[2])))
