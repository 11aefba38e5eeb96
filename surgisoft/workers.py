"""Pools of worker processes: on this machine, or on a Dask cluster of several.

Processes on this machine have one thread each and end with the process that started them. Workers
of a cluster are started by its owner (`dask worker ADDRESS --nworkers N --nthreads 1`), see the
same files, and outlive the pool; Dask gives the work of a worker that was killed to another one.
"""

import contextlib
import ctypes
import functools
import multiprocessing
import multiprocessing.connection
import os
import pickle
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from surgisoft.errors import InputError, Terminated

if TYPE_CHECKING:
    from distributed import Client

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
"""Environment variables by which libraries of linear algebra set their number of threads."""
LINKED_TO_OPENBLAS = {"numpy.linalg._umath_linalg": "64_", "scipy.linalg._fblas": ""}
"""Modules that are linked to an OpenBLAS, with the end of its functions' names."""
CLUSTER = "SURGISOFT_CLUSTER"
"""Environment variable with the address of a Dask scheduler, such as tcp://host:8786."""
ANSWERS_S = 15.0
"""Time within which the scheduler of a cluster has to answer, s."""


def begin_worker(prepared: Path | None = None) -> None:
    """Initialise a worker: one thread, no reaction to Ctrl-C, and end with the parent process.

    The worker also ends when the parent is killed: the system then closes the pipe that is waited
    for. prepared: file with the pickled function that is called in the new process, which begins
    without the state of its parent.
    """
    parent = multiprocessing.parent_process()
    if parent is None:
        raise RuntimeError("begin_worker is for a new process, and this is the first one")
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _compute_on_one_thread()
    parent_exit = parent.sentinel

    def end_with_parent() -> None:
        multiprocessing.connection.wait([parent_exit])
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()
    if prepared is not None:
        pickle.loads(prepared.read_bytes())()


def _compute_on_one_thread() -> None:
    """Let torch have one thread in this process.

    It takes more than a second to import, so it is left to the work that needs it, and then reads
    `ONE_THREAD`.
    """
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Set the number of threads of torch, NumPy and SciPy inside a block or a decorated function.

    The number of threads decides in which order sums are added, and so about their last digits.
    OpenBLAS, in NumPy and SciPy, also keeps its threads spinning between products: on a machine
    that does other work a diagnosis took three times its processor time.
    """
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        with openblas_threads(count):
            yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def openblas_threads(count: int) -> Iterator[None]:
    """Set the number of threads of each OpenBLAS, that of NumPy and that of SciPy."""
    loaded = [_openblas(module) for module in LINKED_TO_OPENBLAS if module in sys.modules]
    libraries = [(each[0], each[1]()) for each in loaded if each is not None]
    for set_threads, _ in libraries:
        set_threads(count)
    try:
        yield
    finally:
        for set_threads, own in libraries:
            set_threads(own)


@functools.cache
def _openblas(module: str) -> tuple[Callable[[int], object], Callable[[], int]] | None:
    """What sets and what gives the number of threads of the OpenBLAS that a module is linked to.

    NumPy and SciPy from their wheels have one each. Other builds, such as those with MKL, have no
    such functions.
    """
    library, suffix = ctypes.CDLL(sys.modules[module].__file__), LINKED_TO_OPENBLAS[module]
    try:
        set_threads = getattr(library, f"scipy_openblas_set_num_threads{suffix}")
        return set_threads, getattr(library, f"scipy_openblas_get_num_threads{suffix}")
    except AttributeError:
        return None


def check_processes(processes: int, cluster: str | None = None) -> None:
    """Raise InputError where several processes are asked for and a cluster does the work.

    cluster: see `workers`.
    """
    address = cluster or os.environ.get(CLUSTER)
    if processes == 1 or not address:
        return
    source = "--cluster" if cluster else f"the environment variable {CLUSTER}"
    unset = "" if cluster else ", or unset the variable"
    raise InputError(
        f"--processes {processes} has no effect: the workers of {address}, by {source}, do the "
        f"work; leave --processes out{unset}"
    )


@contextlib.contextmanager
def workers(
    processes: int, prepare: Callable[[], object] | None = None, cluster: str | None = None
) -> Iterator[Executor]:
    """Pool of worker processes; an error in the block cancels the work that waits.

    A script that calls this needs `if __name__ == "__main__":`, since each new process imports it.
    Without, the processes end with Python's advice on that, and the pool with BrokenProcessPool.

    processes: their number on this machine. prepare: called once in each new process. cluster:
    address of a Dask scheduler whose workers take the place of processes on this machine; default:
    that of the environment variable `CLUSTER`. Raises InputError where no such cluster answers,
    where it has no worker, and where one has several threads.
    """
    address = cluster or os.environ.get(CLUSTER)
    if address:
        with _cluster(address, prepare) as executor:
            yield executor
        return
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    context = multiprocessing.get_context("spawn")
    folder = tempfile.TemporaryDirectory(prefix="surgisoft-")
    # By a file: what goes through the pipe of a process that ends before it reads waits for ever.
    prepared = Path(folder.name) / "prepare.pickle" if prepare is not None else None
    if prepared is not None:
        prepared.write_bytes(pickle.dumps(prepare))
    pool = ProcessPoolExecutor(processes, context, initializer=begin_worker, initargs=(prepared,))
    try:
        with _raised_at_end():
            with _held_interrupt():
                pool.submit(os.getpid)  # starts the processes, which inherit what is held
            yield pool
    except BaseException:
        for process in list((pool._processes or {}).values()):
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
        folder.cleanup()
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextlib.contextmanager
def _held_interrupt() -> Iterator[None]:
    """Hold Ctrl-C back inside the block; processes that start in it never see one.

    A terminal sends it to them too, and one that comes before `begin_worker` would print the
    traceback of an import that it ended.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextlib.contextmanager
def _raised_at_end() -> Iterator[None]:
    """Raise `Terminated` in the block on SIGTERM, so that what the pool holds is given back.

    By default the process would end at once, and Python would warn of the pool's semaphores. A
    handler of the program's own stays in force.
    """
    main = threading.current_thread() is threading.main_thread()
    if not main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        signal.signal(number, signal.SIG_IGN)  # the first one ends the program
        raise Terminated(number)

    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


@contextlib.contextmanager
def _cluster(address: str, prepare: Callable[[], object] | None) -> Iterator[Executor]:
    """Pool of the workers of a Dask cluster; see `workers`."""
    from distributed import Client

    try:
        client = Client(address, timeout=ANSWERS_S, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        raise InputError(
            f"cluster {address}: no Dask scheduler answers; start one with 'dask scheduler', and "
            "give its address, such as tcp://host:8786"
        ) from error
    with client:
        _check_workers(client, address)
        client.register_plugin(_begin_plugin(prepare))
        # A job that has begun may have written files: it is run again only where its worker died.
        executor = client.get_executor(pure=False, retries=0)
        try:
            yield executor
        except BaseException:
            executor.shutdown(wait=False)
            raise


def _check_workers(client: "Client", address: str) -> None:
    """Raise InputError unless every worker has one thread, and there is one."""
    threads: dict[str, int] = client.nthreads()
    if not threads:
        raise InputError(
            f"cluster {address}: it has no worker; start some with 'dask worker {address} "
            "--nworkers N --nthreads 1'"
        )
    many = [worker for worker, count in threads.items() if count != 1]
    if many:
        raise InputError(
            f"cluster {address}: worker {many[0]} has {threads[many[0]]} threads, expected 1; "
            "start it with --nthreads 1"
        )


def _begin_plugin(prepare: Callable[[], object] | None) -> Any:
    """What each worker does before its first job, also one that joins later."""
    from distributed import WorkerPlugin

    class Begin(WorkerPlugin):
        name = "surgisoft"

        def setup(self, worker: Any) -> None:
            _compute_on_one_thread()
            if prepare is not None:
                prepare()

    return Begin()
