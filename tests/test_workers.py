"""Workers end with the process that asked, however that ends."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from surgisoft.workers import ONE_THREAD, torch_threads, workers

ASKS = """
import os, sys, time
from surgisoft.workers import workers
if __name__ == "__main__":
    with workers(2) as pool:
        print(pool.submit(os.getppid).result(), flush=True)
        jobs = [pool.submit(time.sleep, 60) for _ in range(4)]
        time.sleep(1.0)
        print(*pool._processes, flush=True)
        jobs[0].result()
"""


def alive(pid: int) -> bool:
    """Whether a process runs; one that ended and waits for its parent does not."""
    status = Path(f"/proc/{pid}/stat")
    if status.parent.parent.joinpath("self").exists():
        return status.exists() and status.read_text().rsplit(")", 1)[1].split()[0] != "Z"
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_killed_process_leaves_no_worker_behind(tmp_path):
    script = tmp_path / "asks.py"
    script.write_text(ASKS)
    asker = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True)
    assert int(asker.stdout.readline()) == asker.pid
    pids = [int(word) for word in asker.stdout.readline().split()]
    assert len(pids) == 2
    assert all(alive(pid) for pid in pids)
    asker.kill()
    asker.wait()
    until = time.monotonic() + 10.0
    while any(alive(pid) for pid in pids) and time.monotonic() < until:
        time.sleep(0.05)
    assert not any(alive(pid) for pid in pids)


def test_a_program_that_is_told_to_end_gives_back_its_semaphores(tmp_path):
    """Python's resource tracker would warn of those that are left."""
    script = tmp_path / "asks.py"
    script.write_text(ASKS)
    asker = subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    asker.stdout.readline()
    pids = [int(word) for word in asker.stdout.readline().split()]
    asker.terminate()
    _, told = asker.communicate(timeout=20.0)
    assert "leaked" not in told
    assert asker.returncode == 128 + signal.SIGTERM
    assert not any(alive(pid) for pid in pids)


UNGUARDED = """
from functools import partial
from surgisoft.workers import workers
with workers(1, partial(len, bytes(1_000_000))) as pool:
    print(pool.submit(len, "two").result())
"""


def test_a_script_without_the_guard_of_its_processes_ends_with_advice(tmp_path):
    """The new process imports the script, which would start another one: it ends at once, before it
    has read what it is prepared with."""
    script = tmp_path / "unguarded.py"
    script.write_text(UNGUARDED)
    asked = [sys.executable, str(script)]
    ended = subprocess.run(asked, capture_output=True, text=True, timeout=60)
    assert ended.returncode == 1
    assert "if __name__ == '__main__':" in ended.stderr
    assert "BrokenProcessPool" in ended.stderr
    script.write_text(
        UNGUARDED.replace("with workers", "if __name__ == '__main__':\n  with workers")
    )
    ended = subprocess.run(asked, capture_output=True, text=True, timeout=60)
    assert ended.stdout == "3\n", ended.stderr


def interrupted() -> None:
    with workers(1) as pool:
        pool.submit(time.sleep, 60)
        raise RuntimeError("enough")


def test_an_error_gives_up_what_is_waiting():
    begin = time.monotonic()
    with pytest.raises(RuntimeError, match="enough"):
        interrupted()
    assert time.monotonic() - begin < 30.0


def own_threads() -> tuple[int, int]:
    """Threads of torch in this process, imported before it was prepared (0: not) and now."""
    early = "torch" in sys.modules and sys.modules["torch"].get_num_threads()
    import torch

    return int(early), torch.get_num_threads()


def test_workers_compute_on_one_thread(monkeypatch):
    """Ctrl-C is held back before `begin_worker` runs: the process is born with it blocked. Torch is
    left to work that needs it."""
    monkeypatch.setenv(ONE_THREAD[0], "7")
    monkeypatch.delenv(ONE_THREAD[1], raising=False)
    with workers(1) as pool:
        if hasattr(signal, "pthread_sigmask"):
            held = pool.submit(signal.pthread_sigmask, signal.SIG_BLOCK, []).result()
            assert signal.SIGINT in held
            assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])
        assert [pool.submit(os.getenv, name).result() for name in ONE_THREAD] == ["1"] * 3
        assert pool.submit(own_threads).result() == (0, 1)
    assert os.environ[ONE_THREAD[0]] == "7"
    assert ONE_THREAD[1] not in os.environ


def spent_by_other_threads() -> list[float]:
    """Processor time, s, that other threads spend on each of five products of matrices.

    Some of it is spent by threads that take no part, such as that of the test runner.
    """
    square = np.ones((1200, 1200))
    spent = []
    for _ in range(5):
        before = time.process_time() - time.thread_time()
        np.matmul(square, square)
        spent.append(time.process_time() - time.thread_time() - before)
    return spent


@pytest.mark.skipif(
    "openblas" not in np.show_config(mode="dicts")["Build Dependencies"]["blas"]["name"],
    reason="another library than OpenBLAS",
)
def test_a_block_of_one_thread_holds_for_products_of_numpy_too():
    with torch_threads(2):
        assert max(spent_by_other_threads()) > 0.002
        with torch_threads(1):
            time.sleep(0.1)  # idle threads of OpenBLAS spin for a moment before they sleep
            assert min(spent_by_other_threads()) < 0.001
        assert max(spent_by_other_threads()) > 0.002
