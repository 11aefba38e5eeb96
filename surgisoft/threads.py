"""The rows of a batch on several threads: compiled loops and products of matrices, block by block.

Loops compiled by `compiled` and operations of torch run without the interpreter's lock. torch would
divide each operation among its own threads, which wake for every one of them: most operations of a
step of a batch are too short for that. `rows_on_threads` gives the threads the rows instead.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from itertools import pairwise

import torch

from surgisoft.workers import openblas_threads

BLOCK = 512
"""Rows of a block (a count): the activations of a network of 128 neurons, 256 kB in float32, stay
in the second cache of a core; `python -m benchmarks.threads --blocks 128,256,512,1024`."""


class _Rows(threading.local):
    """What `rows_on_threads` keeps for the thread that called it."""

    threads = 0
    """Threads for the rows; 0: as many as torch uses."""


_rows = _Rows()
_pools: dict[int, ThreadPoolExecutor] = {}


@contextmanager
def rows_on_threads() -> Iterator[None]:
    """Inside a block or a decorated function torch and NumPy's OpenBLAS work on one thread, and
    `over_rows` on all that torch had before.

    `torch.set_num_threads(1)` before it keeps all of it on the calling thread.
    """
    if _rows.threads:
        yield
        return
    before = torch.get_num_threads()
    _rows.threads = before
    torch.set_num_threads(1)
    try:
        with openblas_threads(1):
            yield
    finally:
        torch.set_num_threads(before)
        _rows.threads = 0


def over_rows(count: int, work: Callable[[slice], object], block: int | None = None) -> None:
    """Call work(rows) for slices that divide `count` rows into blocks, on several threads.

    work: calls compiled loops, or torch without gradients, for the rows of a slice, and no
    `over_rows`. No row depends on another, and blocks do not depend on the number of threads, so
    that every number of them gives the same. block: rows of a block; None: `BLOCK`.
    """
    block = BLOCK if block is None else block
    blocks = -(-count // block)
    threads = min(_rows.threads or torch.get_num_threads(), blocks)
    bounds = [count * n // max(blocks, 1) for n in range(blocks + 1)]
    slices = iter([slice(*pair) for pair in pairwise(bounds)])
    if threads < 2:
        for rows in slices:
            work(rows)
        return
    inference = torch.is_inference_mode_enabled()

    def take() -> None:
        # The modes of torch are those of a thread.
        with torch.inference_mode() if inference else torch.no_grad():
            for rows in slices:  # of a list: each goes to one thread
                work(rows)

    pool = _pool(threads - 1)
    others = [pool.submit(take) for _ in range(threads - 1)]
    try:
        take()
    finally:
        wait(others)
    for other in others:
        other.result()


def _pool(threads: int) -> ThreadPoolExecutor:
    """A pool of so many threads, which is kept."""
    if threads not in _pools:
        before, started = torch.get_num_threads(), threading.Barrier(threads)
        pool = ThreadPoolExecutor(threads, "rows", _keep_one_thread)
        wait([pool.submit(started.wait) for _ in range(threads)])
        torch.set_num_threads(before)  # for threads that are started later
        _pools[threads] = pool
    return _pools[threads]


def _keep_one_thread() -> None:
    """Let torch work on one thread where this one calls it."""
    torch.set_num_threads(1)
    torch.get_num_threads()  # a thread takes over the number when it first asks for it


if hasattr(os, "register_at_fork"):
    # A fork has none of the threads of its process, and would wait for a pool's for ever.
    os.register_at_fork(after_in_child=_pools.clear)
