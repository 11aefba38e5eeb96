"""Pools of worker processes, one thread each, that end with the process that started them."""

import contextlib
import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables by which libraries of linear algebra set their number of threads."""


def begin_worker(prepare: Callable[[], object] | None = None) -> None:
    """Initialise a worker: one thread, no reaction to Ctrl-C, and end with the parent process.

    The worker also ends when the parent is killed: the system then closes the pipe that is waited
    for. prepare: called in the new process, which begins without the state of its parent.
    """
    import torch

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    parent = multiprocessing.parent_process()
    if parent is None:
        raise RuntimeError("begin_worker is for a new process, and this is the first one")
    parent_exit = parent.sentinel

    def end_with_parent() -> None:
        multiprocessing.connection.wait([parent_exit])
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    if prepare is not None:
        prepare()


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Set the number of torch's threads inside a block, or inside a decorated function.

    The number of threads decides in which order sums are added, and so about their last digits.
    """
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def workers(
    processes: int, prepare: Callable[[], object] | None = None
) -> Iterator[ProcessPoolExecutor]:
    """Pool of so many worker processes; an error in the block cancels the work that waits.

    prepare: called once in each new process.
    """
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(processes, context, initializer=begin_worker, initargs=(prepare,))
    try:
        yield pool
    except BaseException:
        for process in list((pool._processes or {}).values()):
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
