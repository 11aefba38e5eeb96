"""CUDA graphs: functions of tensors in fixed places whose operations start with one launch.

The processor needs some microseconds to start an operation on a GPU, and a small one takes less
than that. A CUDA graph holds many, with the addresses of their arguments.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import torch

from surgisoft.errors import AssumptionWarning
from surgisoft.graphs import reason_of

Found = TypeVar("Found")
WARM_UP = 2
"""Calls before a graph is captured: kernels are compiled and workspaces allocated in them."""


def cuda_graph(work: Callable[[], Found]) -> Callable[[], Found]:
    """A function that does the operations of `work` again, with the results in the same tensors.

    `work` is called once, but nothing is computed then; it may not read a value of a tensor.
    """
    graph = torch.cuda.CUDAGraph()
    random = torch.cuda.default_generators[torch.cuda.current_device()]
    before = random.clone_state()
    try:
        with torch.cuda.graph(graph):
            found = work()
    except BaseException:
        # The generator takes a capture that failed for one that goes on, and would draw no more.
        random.graphsafe_set_state(before)
        raise

    def again() -> Found:
        graph.replay()
        return found

    return again


def recorded(
    work: Callable[[], Found],
    restore: Callable[[], None],
    device: torch.device,
    record: Callable[[Callable[[], Found]], Callable[[], Found]],
    what: str,
) -> Callable[[], Found]:
    """`work` as `record` makes it, `cuda_graph` or another; `work` itself where that fails.

    restore: undoes what `work` does to tensors; called after each warm-up. what: the work by its
    name, for the warning of a failure.
    """
    with _stream_beside(device):
        for _ in range(WARM_UP):
            work()
            restore()
    try:
        found = record(work)
    except RuntimeError as error:
        warnings.warn(
            f"no CUDA graph could be made of {what}, which is slower without: {reason_of(error)}",
            AssumptionWarning,
            stacklevel=2,
        )
        return work
    restore()
    return found


@contextmanager
def _stream_beside(device: torch.device) -> Iterator[None]:
    """Another stream of a GPU, because a graph is warmed up on one; nothing elsewhere."""
    if device.type != "cuda":
        yield
        return
    beside, present = torch.cuda.Stream(device), torch.cuda.current_stream(device)
    beside.wait_stream(present)
    with torch.cuda.stream(beside):
        yield
    present.wait_stream(beside)
