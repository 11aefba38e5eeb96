"""Atomic writing of files and folders, and values as strict JSON.

A reader never sees half a file: the content goes to a temporary name beside the target, which is
renamed to the target at the end. What is written has the permissions that the user's umask gives
to new files. `noted_writes` collects what was written, for a message after an interruption.
"""

import contextlib
import errno
import json
import math
import os
import secrets
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import numpy as np

from surgisoft.errors import InputError

LARGEST_JSON = 8_000_000
"""A larger JSON file is none that the package writes, bytes."""

_noted: ContextVar[list[Path] | None] = ContextVar("noted writes", default=None)


@contextlib.contextmanager
def noted_writes() -> Iterator[list[Path]]:
    """Files and folders that are written inside the block, in order, each added when complete.

    Those in a folder that is being filled are listed under its temporary name, which is gone
    later. Work in other threads and processes is not noted, except by `note_written`.
    """
    written: list[Path] = []
    token = _noted.set(written)
    try:
        yield written
    finally:
        _noted.reset(token)


def note_written(path: Path) -> None:
    """Add a file or folder, which is complete, to those of `noted_writes`."""
    written = _noted.get()
    if written is not None:
        written.append(path)


@contextlib.contextmanager
def new_file(path: str | Path, noted: bool = True) -> Iterator[Path]:
    """A temporary path to write to; it becomes `path` when the block ends without an exception.

    The temporary name keeps the suffix, and `path`'s folder is made where it is missing. Where
    `path` is a symbolic link, the file to which it leads is written, and the link stays. noted:
    whether `noted_writes` lists it, as all but caches should be. Raises InputError for a device or
    a pipe, which a new file would replace; an OSError names `path` or another file.
    """
    path = Path(path)
    target = resolved(path)
    if target.exists() and not target.is_file() and not target.is_dir():
        raise InputError(f"{path}: is a device or a pipe, expected a file to write")
    target.parent.mkdir(parents=True, exist_ok=True)
    fresh = _beside(target.parent / path.name)
    try:
        with _named(path, fresh):
            yield fresh
            os.replace(fresh, target)
        if noted:
            note_written(path)
    finally:
        fresh.unlink(missing_ok=True)


def check_folder(path: Path | None) -> None:
    """Raise InputError unless a folder exists or can be made."""
    if path is None:
        return
    above = next(parent for parent in (path.absolute() / "x").parents if parent.exists())
    if not above.is_dir() or not os.access(above, os.W_OK):
        raise InputError(f"{path}: cannot be written, {above} is not a writable folder")


def check_export_folder(folder: str | Path, mark: str, force: bool) -> None:
    """Raise InputError unless a folder is free for an export, or holds one and `force` is given.

    mark: the file by which an earlier export is known.
    """
    folder = Path(folder)
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return
    if not (folder / mark).is_file():
        raise InputError(f"{folder}: already exists, without {mark}; choose another name")
    if not force:
        raise InputError(
            f"{folder}: already exists; choose another name or pass --force (in Python force=True)"
        )


@contextlib.contextmanager
def new_folder(folder: str | Path, own: Sequence[str] = ()) -> Iterator[Path]:
    """A temporary folder to fill; it becomes `folder` when the block ends without an exception.

    Where `folder` exists, the new one replaces it. Old files that the new folder does not have are
    copied to it, except those named in `own`, which belong to the old version. An OSError names
    `folder`, a file in it or another file.
    """
    given, folder = Path(folder), resolved(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    fresh = _beside(folder)
    try:
        with _named(given, fresh):
            fresh.mkdir()
            yield fresh
            if not folder.exists():
                os.replace(fresh, folder)
                note_written(given)
                return
            for kept in folder.iterdir():
                if kept.name not in own and not (fresh / kept.name).exists():
                    copy = shutil.copytree if kept.is_dir() else shutil.copy2
                    copy(kept, fresh / kept.name)
            old = _beside(folder)
            os.replace(folder, old)
            os.replace(fresh, folder)
            note_written(given)
            shutil.rmtree(old)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)


@contextlib.contextmanager
def _named(path: Path, fresh: Path) -> Iterator[None]:
    """Let an OSError name the user's path in place of the temporary one, or of none.

    A failed write, such as on a full disk, names no file.
    """
    try:
        yield
    except OSError as error:
        if error.filename is None and error.errno is not None:
            error.filename = str(path)
        elif str(error.filename).startswith(str(fresh)):
            error.filename = str(path) + str(error.filename).removeprefix(str(fresh))
        raise


def resolved(path: str | Path) -> Path:
    """Where a path leads, links followed; links in a circle raise an OSError in every Python.

    Before Python 3.13 `Path.resolve` raises a RuntimeError for them.
    """
    try:
        return Path(path).resolve()
    except RuntimeError:
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path)) from None


def write_atomically(path: str | Path, content: bytes | str, noted: bool = True) -> None:
    """Write a file whole or not at all; text is written as UTF-8. noted: as for `new_file`."""
    with new_file(path, noted) as fresh:
        fresh.write_bytes(content.encode("utf-8") if isinstance(content, str) else content)


def write_json(path: str | Path, value: Any) -> None:
    """Write a value as strict JSON, whole or not at all; not finite numbers become null."""
    write_atomically(path, json.dumps(json_safe(value), indent=2, allow_nan=False) + "\n")


def read_json(path: str | Path, most_bytes: int = LARGEST_JSON) -> Any:
    """The value in a JSON file; raises InputError for a file that is too large or no JSON."""
    path = Path(path)
    with path.open("rb") as file:
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise InputError(f"{path}: larger than {most_bytes} bytes; expected a smaller JSON file")
    try:
        return json.loads(content)
    except RecursionError:
        raise InputError(f"{path}: not valid JSON: nested too deeply") from None
    except ValueError as error:  # also text that is not UTF-8, and integers of too many digits
        raise InputError(f"{path}: not valid JSON: {error}") from None


def json_safe(value: Any) -> Any:
    """The value for strict JSON: NaN and infinite numbers become None.

    Goes through dicts, lists and tuples; numpy arrays become lists and numpy scalars numbers.
    """
    if isinstance(value, dict):
        return {key: json_safe(part) for key, part in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [json_safe(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def with_former_keys(values: dict[str, Any], former: Mapping[str, str]) -> dict[str, Any]:
    """The values under the deprecated names of some keys, too; former: old name -> present name."""
    return values | {old: values[new] for old, new in former.items()}


def _beside(path: Path) -> Path:
    """A free hidden name in the same folder, with the same suffix."""
    return path.with_name(f".{path.stem}.{secrets.token_hex(6)}{path.suffix}")
