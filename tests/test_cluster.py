"""Work on a Dask cluster of two local nodes: a killed worker's cases run again, nothing twice."""

import os
import signal
import time
from collections import Counter
from concurrent.futures import as_completed

import pytest

from surgisoft.errors import InputError
from surgisoft.workers import CLUSTER, workers

distributed = pytest.importorskip("distributed")


@pytest.fixture(scope="module")
def cluster():
    """Two nodes of one worker each, which come back when they are killed."""
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=":0", host="127.0.0.1"
    ) as made:
        yield made.scheduler_address


def case(folder, number: int, seconds: float) -> int:
    """A case: notes that it began, works, and notes that it is done."""
    with (folder / "began.txt").open("a") as file:
        file.write(f"{number} {os.getpid()}\n")
    time.sleep(seconds)
    with (folder / "done.txt").open("a") as file:
        file.write(f"{number}\n")
    return number * number


def began(folder) -> list[list[int]]:
    """(number, process) of each case that began."""
    file = folder / "began.txt"
    lines = file.read_text().splitlines() if file.exists() else []
    return [[int(word) for word in line.split()] for line in lines]


def test_cases_of_a_killed_worker_run_again_and_no_other_twice(cluster, tmp_path):
    with workers(1, cluster=cluster) as pool:
        jobs = [pool.submit(case, tmp_path, number, 0.3) for number in range(10)]
        while len(began(tmp_path)) < 4:
            time.sleep(0.02)
        number, victim = began(tmp_path)[-1]
        os.kill(victim, signal.SIGKILL)
        found = sorted(job.result() for job in as_completed(jobs))
    assert found == [n * n for n in range(10)]
    starts = Counter(number for number, _ in began(tmp_path))
    done = Counter(map(int, (tmp_path / "done.txt").read_text().split()))
    assert starts[number] == 2, "the killed case began again"
    assert set(done) == set(range(10))
    assert sum(starts.values()) <= 10 + 2, "and no case that was not on the killed worker"
    assert len({process for _, process in began(tmp_path)}) >= 2, "both nodes worked"


def prepared() -> None:
    os.environ["PREPARED"] = str(os.getpid())


def read_environment() -> tuple[str | None, int, int]:
    import torch

    return os.environ.get("PREPARED"), os.getpid(), torch.get_num_threads()


def test_environment_variable_names_the_cluster_and_workers_are_prepared(cluster, monkeypatch):
    monkeypatch.setenv(CLUSTER, cluster)
    with workers(1, prepared) as pool:
        seen = [pool.submit(read_environment).result() for _ in range(4)]
    for by, process, threads in seen:
        assert by == str(process) != str(os.getpid())
        assert threads == 1


def fails() -> None:
    raise InputError("a case that cannot be run")


def test_an_error_of_a_case_is_raised_here(cluster):
    with workers(1, cluster=cluster) as pool, pytest.raises(InputError, match="cannot be run"):
        pool.submit(fails).result()


def test_a_cluster_that_is_not_there_is_one_line(monkeypatch):
    monkeypatch.setattr("surgisoft.workers.ANSWERS_S", 0.5)
    with (
        pytest.raises(InputError, match="no Dask scheduler answers") as error,
        workers(1, cluster="tcp://127.0.0.1:9"),
    ):
        pytest.fail("no pool without a cluster")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("nodes", "threads", "words"),
    [(0, 1, "it has no worker"), (1, 2, "has 2 threads, expected 1")],
)
def test_a_cluster_that_cannot_do_the_work_is_one_line(nodes, threads, words):
    with (
        distributed.LocalCluster(
            n_workers=nodes,
            threads_per_worker=threads,
            processes=False,
            protocol="tcp://",
            dashboard_address=":0",
            host="127.0.0.1",
        ) as made,
        pytest.raises(InputError, match=words),
        workers(1, cluster=made.scheduler_address),
    ):
        pytest.fail("no pool")
