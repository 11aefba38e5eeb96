"""Several processes that learn one policy: started by torchrun, gradients averaged by rsl-rl.

rsl-rl itself opens nccl only; here gloo is opened on CPUs.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass

import torch
import torch.distributed as dist

from surgisoft.errors import InputError
from surgisoft.graphs import reason_of
from surgisoft.tasks.arguments import device_of

BY_TORCHRUN = (
    "start several processes by torchrun (docs/training.md), and leave WORLD_SIZE unset otherwise"
)
"""What to do where the processes do not find each other."""


@dataclass(frozen=True)
class Processes:
    """The processes that train together, seen from one of them."""

    rank: int = 0
    """Number of this process."""
    count: int = 1
    """How many there are."""
    local: int = 0
    """Number of this process on its machine: its GPU."""

    @property
    def leads(self) -> bool:
        """Whether this process writes the run."""
        return self.rank == 0

    @property
    def rsl_rl(self) -> dict | None:
        """Settings of the process group for rsl-rl; None for a process alone."""
        if self.count == 1:
            return None
        return {"global_rank": self.rank, "local_rank": self.local, "world_size": self.count}

    def any(self, flag: bool) -> bool:
        """Whether the flag is set in any process."""
        if self.count == 1:
            return flag
        value = torch.tensor([float(flag)], device=_device())
        dist.all_reduce(value, op=dist.ReduceOp.MAX)
        return bool(value.item())

    def of_leader(self, value: float) -> float:
        """The leader's number, in every process."""
        if self.count == 1:
            return value
        held = torch.tensor([value], dtype=torch.float64, device=_device())
        dist.broadcast(held, src=0)
        return held.item()

    def gather(self, value) -> list | None:
        """Objects of all processes, in the leader; None in the others."""
        if self.count == 1:
            return [value]
        gathered = [None] * self.count if self.leads else None
        dist.gather_object(value, gathered, dst=0)
        return gathered

    def wait(self) -> None:
        """Until every process has come here."""
        if self.count > 1:
            dist.barrier()


def _device() -> torch.device:
    nccl = dist.get_backend() == "nccl"
    return torch.device("cuda", torch.cuda.current_device()) if nccl else torch.device("cpu")


def process_count() -> int:
    """Number of processes that torchrun started together: `WORLD_SIZE`; 1 without torchrun."""
    return _number("WORLD_SIZE", 1)


def _number(name: str, otherwise: int) -> int:
    """A whole number of the environment that torchrun sets; raises InputError for anything else."""
    given = os.environ.get(name, str(otherwise))
    if not given.isascii() or not given.isdigit():
        raise InputError(f"{name} is '{given}', expected a whole number; {BY_TORCHRUN}")
    return int(given)


@contextlib.contextmanager
def processes(device: str) -> Iterator[tuple[Processes, torch.device]]:
    """Rank and device of this process among those that torchrun started.

    Raises InputError where the environment is not torchrun's, and for more processes than GPUs.
    """
    kind, count = device_of(device, "--device"), process_count()
    if count <= 1:
        yield Processes(), kind
        return
    local = _number("LOCAL_RANK", 0)
    if kind.type == "cuda":
        if local >= (most := torch.cuda.device_count()):
            raise InputError(
                f"process {local + 1} of this machine has no GPU of its own: PyTorch finds {most}; "
                f"start at most {most} (torchrun --nproc-per-node {most})"
            )
        kind = torch.device("cuda", local)
        torch.cuda.set_device(kind)
    try:
        dist.init_process_group("nccl" if kind.type == "cuda" else "gloo")
    except (ValueError, RuntimeError) as error:
        raise InputError(
            f"WORLD_SIZE is {count}, but the processes do not find each other "
            f"({reason_of(error)}); {BY_TORCHRUN}"
        ) from error
    try:
        yield Processes(dist.get_rank(), count, local), kind
    finally:
        dist.destroy_process_group()
