"""Compilation of inner loops by numba: cached on disk, division as in IEEE 754."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from pathlib import Path

import numba
from numba import njit


@functools.cache
def _source_stamp(folder: Path) -> str:
    """sha256 of a folder's source files that hold compiled functions."""
    sources = [file.read_bytes() for file in sorted(folder.glob("*.py"))]
    return hashlib.sha256(b"".join(s for s in sources if b"@compiled" in s)).hexdigest()


def compiled(function: Callable) -> Callable:
    """Compile a function with numba, without the interpreter's lock, cached on disk between runs.

    numba looks for changes in the file of the function only, so a kernel that calls one of another
    file would go on running the other's old code; the stamp of all files of its folder closes that
    hole. The stamp is part of the index's version too, which numba reads before it unpickles the
    index: a class that was renamed since would stop the program there.
    """
    dispatcher = njit(cache=True, nogil=True, error_model="numpy")(function)
    folder = Path(function.__code__.co_filename).parent
    index = dispatcher._cache._cache_file  # type: ignore[attr-defined]  # private
    index._source_stamp = _source_stamp(folder)
    index._version = f"{numba.__version__} {index._source_stamp}"
    return dispatcher
