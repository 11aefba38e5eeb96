"""A training run with the paper's number of steps by two processes under torchrun."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from pathlib import Path

from benchmarks.control.policies import cost
from surgisoft.agents.run_folder import RunFolder
from surgisoft.errors import InputError
from surgisoft.progress import Progress

ENVS = 4096
"""Parallel episodes in each process: they share the overhead of small tensor operations."""
LOOK_S = 2.0
"""Time between two checks of the processes' progress, s."""


def arguments(task: str, steps: int, folder: Path) -> list[str]:
    """Arguments of torchrun for a new run, or for resuming the one in the folder."""
    resumed = (folder / "config.json").is_file()
    new = ["--task", task, "--steps", str(steps), "--envs", str(ENVS), "-o", str(folder)]
    own = ["--resume", str(folder)] if resumed else new
    return ["--nproc-per-node", "2", "-m", "surgisoft", "train", *own]


def trained_by_two(folder: Path, task: str, steps: int, report: Progress) -> RunFolder:
    """The run in a folder; where it is missing, two processes train it with preset `fast`."""
    if (folder / "config.json").is_file() and _checked(folder, task) and _steps(folder) >= steps:
        return RunFolder(folder)
    log = folder.with_suffix(".log")
    command = [sys.executable, "-m", "torch.distributed.run", *arguments(task, steps, folder)]
    with open(log, "w") as lines, subprocess.Popen(command, stdout=lines, stderr=lines) as process:
        try:
            while _going(process):
                report(_steps(folder), steps, f"{_steps(folder):,} steps")
        except BaseException:
            process.terminate()
            raise
    if process.returncode or _steps(folder) < steps:
        raise InputError(f"{folder}: the two processes ended early, see {log}")
    return _checked(folder, task)


def _going(process: subprocess.Popen) -> bool:
    """Whether a process goes on after a while."""
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(LOOK_S)
    return process.returncode is None


def _steps(folder: Path) -> int:
    """Steps that are done; 0 where nothing was trained yet."""
    try:
        return cost(RunFolder(folder)).steps
    except InputError:
        return 0


def _checked(folder: Path, task: str) -> RunFolder:
    """The run, of that task and by two processes."""
    run = RunFolder(folder)
    came = (run.config["task"], run.config["processes"])
    if came != (task, 2):
        raise InputError(
            f"{folder}: {came[0]} by {came[1]} processes, expected {task} by 2; choose another "
            "folder"
        )
    return run
