"""Where the curves of a training go: TensorBoard's files in its folder, or a service besides.

rsl-rl's own writers send them to Weights & Biases and Neptune, and write TensorBoard's files too.
"""

from __future__ import annotations

import importlib.util
from dataclasses import asdict
from pathlib import Path
from typing import Any

from surgisoft.agents.presets import Plan
from surgisoft.config import to_table
from surgisoft.errors import InputError, unknown_name

TENSORBOARD = "tensorboard"
"""TensorBoard's files alone: nothing leaves the machine."""
LOGGERS = {TENSORBOARD: "tensorboard", "wandb": "wandb", "neptune": "neptune", "mlflow": "mlflow"}
"""Name of each logger and of the library that it needs."""
PROJECT = "surgisoft"
"""Name of the project or experiment at a service."""


def check_logger(name: str) -> None:
    """Raise InputError for an unknown logger, or one whose library is not installed."""
    if name not in LOGGERS:
        raise unknown_name("logger", name, LOGGERS)
    if importlib.util.find_spec(LOGGERS[name]) is None:
        raise InputError(
            f"--logger {name}: {LOGGERS[name]} is not installed; pip install {LOGGERS[name]}"
        )


class LoggerFailed(InputError):
    """A logger whose service could not be opened."""


def open_writer(name: str, folder: Path, plan: Plan, purge_step: int) -> Any:
    """The writer of a logger, with `add_scalar(tag, value, step)` and `close()`.

    folder: of the run. purge_step: TensorBoard drops what it has from this step on. Raises
    LoggerFailed, with what the service's library says, where it cannot be opened.
    """
    if name == TENSORBOARD:
        return _board(folder, purge_step)
    try:
        if name == "mlflow":
            return MlflowWriter(folder, plan, purge_step)
        return _of_rsl_rl(name, folder, plan)
    except Exception as error:  # each library has exceptions of its own
        raise LoggerFailed(f"--logger {name}: cannot be opened: {error}") from error


def _of_rsl_rl(name: str, folder: Path, plan: Plan) -> _Stopped:
    """One of rsl-rl's writers; it names its run at the service after the last part of a path."""
    if name == "wandb":
        from rsl_rl.utils import wandb_log_writer as of_wandb

        writer = of_wandb.WandbLogWriter(str(folder / "tensorboard"), project_name=PROJECT)
        if (run := getattr(of_wandb.wandb, "run", None)) is not None:
            run.name = folder.name
    else:
        from rsl_rl.utils.neptune_log_writer import NeptuneLogWriter as Writer

        writer = Writer(str(folder), project_name=PROJECT)
    writer.store_config(_Config(plan), {"preset": plan.preset_name, **asdict(plan.preset)})
    return _Stopped(writer)


def _board(folder: Path, purge_step: int) -> Any:
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder / "tensorboard"), purge_step=purge_step)


class _Config:
    """A task's configuration as rsl-rl's writers read it."""

    def __init__(self, plan: Plan):
        self._plan = plan

    def to_dict(self) -> dict:
        """Plain values."""
        return {"task": self._plan.task, **to_table(self._plan.task_config)}


class _Stopped:
    """One of rsl-rl's writers, which is also told when the run ends."""

    def __init__(self, writer: Any):
        self._writer = writer

    def add_scalar(self, tag: str, value: float, step: int) -> None:
        """Write one value."""
        self._writer.add_scalar(tag, value, step)

    def close(self) -> None:
        """Write what is left and end the run at the service."""
        self._writer.close()
        self._writer.stop()


class MlflowWriter:
    """TensorBoard's files, and the same values in an MLflow run (rsl-rl has no writer for it)."""

    def __init__(self, folder: Path, plan: Plan, purge_step: int):
        import mlflow

        self._mlflow = mlflow
        mlflow.set_experiment(PROJECT)
        mlflow.start_run(run_name=folder.name)
        mlflow.log_params({"task": plan.task, "seed": plan.seed, "preset": plan.preset_name})
        mlflow.log_dict(_Config(plan).to_dict(), "task_config.json")
        self._board = _board(folder, purge_step)

    def add_scalar(self, tag: str, value: float, step: int) -> None:
        """Write one value."""
        self._board.add_scalar(tag, value, step)
        self._mlflow.log_metric(tag, float(value), step=step)

    def close(self) -> None:
        """Write what is left and end the run."""
        self._board.close()
        self._mlflow.end_run()
