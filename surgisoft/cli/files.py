"""Output paths: checks before a command spends its time, and lines about what was written."""

from collections import Counter
from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path

from surgisoft.command_line import typed
from surgisoft.errors import InputError
from surgisoft.files import check_folder, read_json


def check_free(path: Path | None, *keys: str) -> None:
    """Raise InputError unless a JSON file may be written: new, or an older result of its kind.

    An older result has one of the keys.
    """
    if path is None:
        return
    check_folder(path.absolute().parent)
    if not path.exists():
        return
    try:
        old = read_json(path)
        same = isinstance(old, dict) and any(key in old for key in keys)
    except (OSError, ValueError):
        same = False
    if not same:
        raise InputError(f"{path}: exists already and is not an older result; choose another file")


def check_new_folder(path: Path | None) -> None:
    """Raise InputError unless a folder can be made there: nothing is replaced."""
    if path is None:
        return
    check_folder(path)
    if path.is_dir() and any(path.iterdir()):
        raise InputError(f"{path}: is not empty, expected a new folder; choose another one")


def check_replay(path: Path | None) -> None:
    """Raise InputError unless a replay may be written there; an older one is replaced.

    Raises ModuleNotFoundError without the Rerun library, which would otherwise be missed only when
    the work is done.
    """
    if path is None:
        return
    if path.suffix != ".rrd":
        raise InputError(f"{path}: suffix '{path.suffix}', expected .rrd")
    if path.is_dir():
        raise InputError(f"{path}: is a folder, expected a file to write")
    check_folder(path.absolute().parent)
    if find_spec("rerun") is None:
        raise ModuleNotFoundError("No module named 'rerun'", name="rerun")


MANY_PICTURES = 4
"""Number of pictures in a folder beyond which the folder is named in their place."""
PICTURES = (".png", ".svg")
"""Suffixes of pictures."""


def show_written(paths: Iterable[object]) -> None:
    """Print each file that was written, and how to look at it where that is not plain.

    Of several pages only the first one is to be opened; the others belong to it. Many pictures of a
    folder are one line.
    """
    given = [(path, Path(getattr(path, "path", str(path)))) for path in paths]
    pictures = Counter(file.parent for _, file in given if file.suffix in PICTURES)
    shown = False
    for path, file in given:
        if file.suffix in PICTURES and pictures[file.parent] > MANY_PICTURES:
            continue
        pages_follow = file.suffix == ".html" and shown
        shown = shown or file.suffix == ".html"
        print(f"wrote {path}{'' if pages_follow else _how_to_look(file)}")
    for folder, count in pictures.items():
        if count > MANY_PICTURES:
            print(f"wrote {count} pictures to {folder}")


def _how_to_look(path: Path) -> str:
    if path.suffix == ".html":
        return ": open it in a browser"
    return f": look at it with 'surgisoft replay {typed(path)}'" if path.suffix == ".rrd" else ""
