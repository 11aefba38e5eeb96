"""Rows of a batch on several threads: the same results, errors that are raised, forks that work."""

import os
import threading
import time
from collections.abc import Iterator

import pytest
import torch

from surgisoft.tasks.batched import batched_env
from surgisoft.threads import BLOCK, over_rows, rows_on_threads


@pytest.fixture(autouse=True)
def _same_threads_after() -> Iterator[None]:
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.mark.parametrize("count", [0, 1, 7, 8, 9, 100])
@pytest.mark.parametrize("threads", [1, 2, 5])
def test_every_row_is_worked_on_once(count, threads):
    torch.set_num_threads(threads)
    times = torch.zeros(count, dtype=torch.int64)

    def work(rows: slice) -> None:
        assert rows.stop - rows.start <= 8
        times[rows] += 1

    over_rows(count, work, block=8)
    assert times.eq(1).all()


def test_blocks_are_worked_on_at_the_same_time():
    torch.set_num_threads(3)
    meeting = threading.Barrier(3, timeout=30)
    over_rows(3, lambda _: meeting.wait(), block=1)  # with fewer threads it would not be passed


def test_one_thread_of_torch_keeps_the_rows_on_the_calling_thread():
    torch.set_num_threads(1)
    seen = set()
    over_rows(20, lambda _: seen.add(threading.get_ident()), block=1)
    assert seen == {threading.get_ident()}


def test_torch_has_one_thread_inside_and_its_own_again_outside():
    torch.set_num_threads(3)
    meeting, inside = threading.Barrier(3, timeout=30), []

    @rows_on_threads()
    def step(fails: bool) -> None:
        inside.append(torch.get_num_threads())
        over_rows(3, lambda _: (meeting.wait(), inside.append(torch.get_num_threads())), block=1)
        if fails:
            raise ValueError("not today")

    # What a thread has first used of torch's threads it keeps.
    over_rows(3, lambda _: (meeting.wait(), torch.get_num_threads()), block=1)
    step(False)
    assert torch.get_num_threads() == 3
    with pytest.raises(ValueError, match="not today"):
        step(True)
    assert torch.get_num_threads() == 3
    assert inside == [1] * 8


def test_later_threads_have_those_of_torch():
    torch.set_num_threads(4)
    over_rows(4, lambda _: None, block=1)
    seen = []
    later = threading.Thread(target=lambda: seen.append(torch.get_num_threads()))
    later.start()
    later.join()
    assert seen == [4]


def test_an_error_in_another_thread_is_raised():
    torch.set_num_threads(2)
    meeting = threading.Barrier(2, timeout=30)

    def work(_: slice) -> None:
        meeting.wait()
        if threading.current_thread() is not threading.main_thread():
            raise ValueError("a row of another thread")

    with pytest.raises(ValueError, match="another thread"):
        over_rows(2, work, block=1)


def test_tensors_of_inference_mode_are_written_by_all_threads():
    torch.set_num_threads(2)
    meeting = threading.Barrier(2, timeout=30)
    with torch.inference_mode():
        found = torch.zeros(2, 3)

        def work(rows: slice) -> None:
            meeting.wait()
            torch.add(found[rows], 1.0, out=found[rows])

        over_rows(2, work, block=1)
    assert found.eq(1.0).all()


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
def test_a_fork_makes_threads_of_its_own():
    torch.set_num_threads(2)
    over_rows(4, lambda _: None, block=1)
    child = os.fork()
    if child == 0:
        done = []
        over_rows(4, done.append, block=1)
        os._exit(0 if len(done) == 4 else 1)
    for _ in range(300):
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            break
        time.sleep(0.1)
    else:
        os.kill(child, 9)
        os.waitpid(child, 0)
        pytest.fail("the fork waits for threads that it does not have")
    assert os.waitstatus_to_exitcode(status) == 0


@pytest.mark.parametrize("task", ["circle_ablation", "track_circle"])
def test_episodes_do_not_depend_on_the_number_of_threads(task):
    count = BLOCK + 100  # two blocks
    found = []
    for threads in (1, 2):
        torch.set_num_threads(threads)
        env, draw = batched_env(task, count, 0, spread=True), torch.Generator().manual_seed(0)
        for _ in range(3):
            actions = {
                agent: 2.0 * torch.rand(count, size, generator=draw) - 1.0
                for agent, size in env.action_sizes.items()
            }
            step = env.step(actions)
        found.append((step.observations, step.rewards))
    for one, other in zip(*found, strict=True):
        for agent in one:
            assert torch.equal(one[agent], other[agent])
