"""Compilation of inner loops by numba: cached on disk, division as in IEEE 754."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import overload

import numba
from numba import njit


@functools.cache
def _source_stamp(folder: Path) -> str:
    """sha256 of a folder's source files that hold compiled functions."""
    sources = [file.read_bytes() for file in sorted(folder.glob("*.py"))]
    return hashlib.sha256(b"".join(s for s in sources if b"@compiled" in s)).hexdigest()


@overload
def compiled(function: Callable) -> Callable: ...


@overload
def compiled(*, reorder: bool) -> Callable[[Callable], Callable]: ...


def compiled(function: Callable | None = None, *, reorder: bool = False) -> Callable:
    """Compile a function with numba, without the interpreter's lock, cached on disk between runs.

    numba looks for changes in the file of the function only, so a kernel that calls one of another
    file would go on running the other's old code; the stamp of all files of its folder closes that
    hole. The stamp is part of the index's version too, which numba reads before it unpickles the
    index: a class that was renamed since would stop the program there.

    reorder: sums may be added in another order, and products fused with sums, so that loops of
    sums are vectorised; the last digits then depend on the processor, as those of matrix products.
    """
    if function is None:
        return functools.partial(_compiled, reorder=reorder)
    return _compiled(function, reorder)


def _compiled(function: Callable, reorder: bool) -> Callable:
    fast = {"reassoc", "contract"} if reorder else False
    dispatcher = njit(cache=True, nogil=True, error_model="numpy", fastmath=fast)(function)
    folder = Path(function.__code__.co_filename).parent
    index = dispatcher._cache._cache_file  # type: ignore[attr-defined]  # private
    index._source_stamp = _source_stamp(folder)
    index._version = f"{numba.__version__} {index._source_stamp}"
    return dispatcher
