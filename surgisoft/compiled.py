"""Compilation of inner loops by numba: cached on disk, division as in IEEE 754."""

from __future__ import annotations

import functools
import hashlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast, overload

import numba
from numba import njit
from numba.core.compiler_lock import global_compiler_lock

LEVEL = 2
"""LLVM's level of optimisation, in place of numba's 3: a first call compiles for two thirds of the
processor time, and loops are as fast (measured on the rigs, the arm models and the tasks)."""


@functools.cache
def _source_stamp(folder: Path) -> str:
    """sha256 of a folder's source files that hold compiled functions."""
    sources = [file.read_bytes() for file in sorted(folder.glob("*.py"))]
    return hashlib.sha256(b"".join(s for s in sources if b"@compiled" in s)).hexdigest()


@overload
def compiled(function: Callable) -> Callable: ...


@overload
def compiled(*, reorder: bool = ..., inner: bool = ...) -> Callable[[Callable], Callable]: ...


def compiled(
    function: Callable | None = None, *, reorder: bool = False, inner: bool = False
) -> Callable:
    """Compile a function with numba, without the interpreter's lock, cached on disk between runs.

    numba looks for changes in the file of the function only, so a kernel that calls one of another
    file would go on running the other's old code; the stamp of all files of its folder closes that
    hole. The stamp is part of the index's version too, which numba reads before it unpickles the
    index: a class that was renamed since would stop the program there.

    The first call of a program is mostly compilation, which some expressions make expensive: an
    assignment `a[:] = b` of arrays takes two seconds to compile, for its message about shapes, and
    a loop a tenth of one; a number that is written out as an argument compiles the function that is
    called for that number alone.

    reorder: sums may be added in another order, and products fused with sums, so that loops of
    sums are vectorised; the last digits then depend on the processor, as those of matrix products.
    inner: only compiled functions call it. Its entry from Python, which unpacks every array of its
    arguments, is then left out and takes no time to compile; a call from Python is a TypeError.
    """
    if function is None:
        return functools.partial(_compiled, reorder=reorder, inner=inner)
    return _compiled(function, reorder, inner)


def _compiled(function: Callable, reorder: bool, inner: bool) -> Callable:
    options: dict[str, Any] = {
        "cache": True,
        "nogil": True,
        "error_model": "numpy",
        "fastmath": {"reassoc", "contract"} if reorder else False,
        "no_cfunc_wrapper": True,  # no function is passed as an argument
        "no_cpython_wrapper": inner,
    }
    dispatcher = njit(**options)(function)
    folder = Path(function.__code__.co_filename).parent
    index = dispatcher._cache._cache_file  # private
    index._source_stamp = _source_stamp(folder)
    index._version = f"{numba.__version__} {index._source_stamp}"
    if "NUMBA_OPT" not in os.environ:
        _at_level(dispatcher)
    if inner:
        _without_entry(dispatcher)
    return dispatcher


def _at_level(dispatcher) -> None:
    """Compile a function, and what it calls, at LEVEL; other code of the process as before."""
    compile_types, config = dispatcher.compile, cast(Any, numba.config)

    def compile_at_level(types):
        with global_compiler_lock:
            before = config.OPT
            config.OPT = type(before)(LEVEL)
            try:
                return compile_types(types)
            finally:
                config.OPT = before

    dispatcher.compile = compile_at_level


def _without_entry(dispatcher) -> None:
    """Let a call from Python raise TypeError: numba would jump to an entry that is not there."""

    def refuse(*_, **__):
        raise TypeError(f"{dispatcher.__name__} is called by compiled functions only (inner=True)")

    dispatcher._insert = lambda *_, **__: None  # of an entry, by the types of its arguments
    dispatcher._compile_for_args = refuse  # what is called where no entry fits
