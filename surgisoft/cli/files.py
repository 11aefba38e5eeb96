"""Files that commands write: whole or not at all."""

import json
import os
import tempfile
from pathlib import Path

from surgisoft.errors import InputError


def check_free(path: Path | None, field: str) -> None:
    """Raise unless a JSON file may be written there: nothing yet, or an older one of its kind.

    An older one has the named field.
    """
    if path is None:
        return
    check_folder(path.absolute().parent)
    if not path.exists():
        return
    try:
        old = json.loads(path.read_text())
        same = isinstance(old, dict) and field in old
    except (OSError, ValueError):
        same = False
    if not same:
        raise InputError(f"{path}: already there and no older result; choose another file")


def check_folder(path: Path | None) -> None:
    """Raise unless a folder is there or can be made."""
    if path is None:
        return
    above = next(parent for parent in (path.absolute() / "x").parents if parent.exists())
    if not above.is_dir() or not os.access(above, os.W_OK):
        raise InputError(f"{path}: cannot be written, {above} is no writable folder")


def check_replay(path: Path | None) -> None:
    """Raise unless a replay may be written there; an older one is replaced."""
    if path is None:
        return
    if path.suffix != ".rrd":
        raise InputError(f"{path}: suffix '{path.suffix}', expected .rrd")
    if path.is_dir():
        raise InputError(f"{path}: is a folder, expected a file to write")
    check_folder(path.absolute().parent)


def write_json(path: Path, table: dict) -> None:
    """Write numbers and texts as JSON."""
    write_text(path, json.dumps(table, indent=2) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text file through a temporary one beside it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    try:
        with os.fdopen(handle, "w") as file:
            file.write(text)
        os.chmod(name, 0o644)
        os.replace(name, path)
    except BaseException:
        os.unlink(name)
        raise
