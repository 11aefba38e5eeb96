"""Readers of raw formats by the name that a map's `format` gives.

A new reader is one file here with a `READER`, and its line in READERS. A reader outside this
package is an entry point of the group `surgisoft.readers`: its name is the format, its object a
Reader.
"""

import functools
import sys
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path

from surgisoft.errors import InputError, raised_at
from surgisoft.measurement.importing.raw import FileRole, RawTable, Reader
from surgisoft.measurement.importing.readers import (
    arrays,
    c3d,
    lerobot,
    mcap,
    motive,
    parquet,
    rosbag2,
    text,
)

AUTO = "auto"
"""The format that stands for: by the name's ending, else text."""
GROUP = "surgisoft.readers"
"""Entry points of readers that other packages bring."""

READERS: dict[str, Reader] = {
    "text": text.READER,
    "parquet": parquet.READER,
    "motive": motive.READER,
    "mcap": mcap.READER,
    "rosbag2": rosbag2.READER,
    "c3d": c3d.READER,
    "matlab": arrays.MATLAB,
    "hdf5": arrays.HDF5,
    "lerobot": lerobot.READER,
}
"""The readers of this package."""

OF_TOPICS = ("mcap", "rosbag2")
"""Readers of files that serve every role that names a topic."""

BINARY = ("c3d", "matlab", "hdf5")
"""Readers whose files are never text: a text with their ending is read as text."""

NOT_READ = {
    "bag": "a ROS bag",
    "trc": "a TRC file (motion capture, OpenSim)",
    "mot": "a motion file of OpenSim",
    "vsk": "a Vicon skeleton",
    "tdms": "a LabVIEW TDMS file",
    "npz": "NumPy arrays",
    "npy": "a NumPy array",
    "pkl": "a Python pickle",
    "pickle": "a Python pickle",
    "xlsx": "an Excel workbook",
    "xls": "an Excel workbook",
}
"""Known formats that no reader of this package reads, by their files' ending."""

NEVER_TEXT = ("pkl", "pickle", "npy", "npz")
"""Endings of NOT_READ whose files are never text, though a short one may hold no zero byte."""

ADVICE = "export it as CSV, or add a reader (docs/recordings.md)"
"""What to do with a format that no reader reads."""


def _plugins() -> dict[str, EntryPoint]:
    """Entry points of readers in installed packages by name; none is loaded."""
    return _entries(tuple(sys.path))


@functools.cache
def _entries(path: tuple[str, ...]) -> dict[str, EntryPoint]:
    """Those while the search path is this one: reading them takes 5 ms."""
    return {entry.name: entry for entry in entry_points(group=GROUP)}


def formats() -> list[str]:
    """Every name that a map's `format` may give."""
    return [AUTO, *READERS, *(name for name in _plugins() if name not in READERS)]


def reader(name: str) -> Reader:
    """The reader of this name, this package's or one from another package."""
    if name in READERS:
        return READERS[name]
    entry = _plugins()[name]
    try:
        found = entry.load()
    except Exception as error:
        raise InputError(
            f"reader '{name}' of {entry.value}: cannot be loaded ({raised_at(error)}); "
            "correct or remove that package"
        ) from error
    if not isinstance(found, Reader):
        raise InputError(
            f"reader '{name}' of {entry.value}: is a {type(found).__name__}, expected an instance "
            "of Reader (docs/recordings.md)"
        )
    return found


def chosen(path: Path, role: FileRole) -> Reader:
    """The reader of a file: the role's, or for "auto" the one that claims the name's ending."""
    if role.format != AUTO:
        return reader(role.format)
    for name in formats()[1:]:
        if path.suffix.lower() in (known := reader(name)).suffixes:
            return known if name not in BINARY or _is_binary(path) else text.READER
    kind = NOT_READ.get(_ending(path))
    if kind and (_ending(path) in NEVER_TEXT or _is_binary(path)):
        raise InputError(f"{path}: {kind}, for which there is no reader; {ADVICE}")
    return text.READER


def _ending(path: Path) -> str:
    return path.suffix.lower().removeprefix(".")


def no_text(path: Path, error: InputError) -> InputError | None:
    """The error of a file that was read as text, with its kind; None where no ending tells it."""
    kind = NOT_READ.get(_ending(path))
    if kind is None:
        return None
    reason = str(error).removeprefix(f"{path}: ").partition(":")[0].partition(";")[0]
    return InputError(f"{path}: {kind}, for which there is no reader; {ADVICE} (as text: {reason})")


def _is_binary(path: Path) -> bool:
    with path.open("rb") as file:
        return b"\0" in file.read(4096)


def open_raw(path: Path, role: FileRole) -> RawTable:
    """The raw table of a file.

    A reader checks what it reads; what one of another package does not check is a bad file too.
    """
    found = chosen(path, role)
    try:
        return found.read(path, role)
    except InputError as error:
        as_text = found is text.READER and role.format == AUTO
        named = no_text(path, error) if as_text else None
        if named is None:
            raise
        raise named from error
    except OSError:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0][:200]
        raise InputError(f"{path}: cannot be read as {found.about} ({reason})") from error
