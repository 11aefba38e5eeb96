"""The folder of a training run, which needs no other file: it holds scene and arm models too.

`config.json` is the plan, `metrics.jsonl` the log; `arms/` and `scene/` are parts of the world,
`checkpoints/last.pt` the state from which training resumes, `best.pt` the policies with the best
evaluation. Checkpoints are read as plain tensors and numbers: none runs code.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import platform
import shutil
import zipfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields, replace
from datetime import datetime
from pathlib import Path
from typing import Annotated, Any

import torch

import surgisoft
from surgisoft.agents.presets import Plan, Preset
from surgisoft.command_line import typed
from surgisoft.config import POSITIVE, Where, at_least, from_table, to_table
from surgisoft.errors import InputError
from surgisoft.files import new_folder, read_json, write_atomically
from surgisoft.scene.folder import open_scene
from surgisoft.scene.spec import FILE, arm_names, save_spec
from surgisoft.surrogate.checkpoint import save_model
from surgisoft.tasks.base import Task
from surgisoft.tasks.registry import config_from, make_task, package_of, task_names, with_fields

FORMAT = 1
"""Version of the folder's layout."""
LAST, BEST = "last", "best"
"""The two checkpoints."""


@dataclass(frozen=True)
class AgentSize:
    """Sizes of an agent in a run's `config.json`."""

    observation: Annotated[int, at_least(1)]
    """Width of the observation."""
    chambers: Annotated[int, at_least(1)]
    """Number of chambers, the width of the action."""
    step_kPa: Annotated[float, POSITIVE]
    """Largest change of pressure in a step, kPa."""


@dataclass(frozen=True)
class RunConfig:
    """The fields of a run's `config.json` that opening it needs; `create_run` writes them."""

    task: str
    """Name of the task."""
    task_config: dict[str, Any]
    """Its configuration as a table."""
    scene: dict[str, Any] | None
    """Origin and hash of the scene; None without a scene."""
    agents: dict[str, AgentSize]
    """agent -> its sizes."""
    preset: str
    """Preset that the hyper-parameters come from."""
    hyper_parameters: Preset
    """Hyper-parameters of networks, rollouts and updates."""
    steps: int | None
    """See `Plan`."""
    minutes: float | None
    """See `Plan`."""
    target_error: float | None
    """See `Plan`."""
    seed: int
    """See `Plan`."""


PACKAGED = Path(surgisoft.__file__).parent / "assets" / "policies"
"""Folder of the runs that the package brings along."""


def run_path(path: str | Path) -> Path:
    """The folder of a run; the name of a packaged one, such as `ring`, gives its folder.

    A file or folder of that name in the working directory has precedence.
    """
    path = Path(path)
    named = len(path.parts) == 1 and not path.exists()
    return PACKAGED / path if named and (PACKAGED / path / "config.json").is_file() else path


def packaged_runs() -> list[str]:
    """Names of the runs that the package brings along."""
    return sorted(config.parent.name for config in PACKAGED.glob("*/config.json"))


def default_folder(task: str) -> Path:
    """A free `runs/TASK-DATE-TIME`."""
    base = Path("runs") / f"{task}-{datetime.now():%Y%m%d-%H%M%S}"
    tries = (base.with_name(f"{base.name}-{i}") if i else base for i in range(1000))
    return next(path for path in tries if not path.exists())


def check_free(folder: Path) -> None:
    """Raise unless a new run may be written there."""
    above = next(parent for parent in folder.absolute().parents if parent.exists())
    if not above.is_dir() or not os.access(above, os.W_OK):
        raise InputError(f"{folder}: cannot be written, {above} is not a writable folder")
    if (folder / "config.json").is_file():
        raise InputError(
            f"{folder}: a run already exists; continue it with --resume {folder} or choose "
            "another name"
        )
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InputError(f"{folder}: already exists; choose another name")


def create_run(folder: Path, plan: Plan, task: Task, agents: dict, processes: int) -> RunFolder:
    """Write a new run, whole or not at all; `agents`: agent -> its widths, see `config.json`."""
    check_free(folder)
    with new_folder(folder) as fresh:
        for name, arm in task.world.arms.items():
            (fresh / "arms").mkdir(exist_ok=True)
            save_model(arm.model, fresh / "arms" / name)
        scene = _copied_scene(plan, fresh)
        config = {
            "format": FORMAT,
            "versions": versions(),
            "started": datetime.now().isoformat(timespec="seconds"),
            "task": plan.task,
            "task_package": package_of(plan.task),
            "task_config": to_table(plan.task_config),
            "scene": scene,
            "arms": {
                name: {"model": arm.model.summary(), "effects": [*arm.model.effects]}
                for name, arm in task.world.arms.items()
            },
            "agents": agents,
            "preset": plan.preset_name,
            "hyper_parameters": asdict(plan.preset),
            "steps": plan.steps,
            "minutes": plan.minutes,
            "target_error": plan.target_error,
            "seed": plan.seed,
            "processes": processes,
        }
        (fresh / "checkpoints").mkdir()
        (fresh / "config.json").write_text(json.dumps(config, indent=2) + "\n")
    return RunFolder(folder)


def _copied_scene(plan: Plan, fresh: Path) -> dict | None:
    """Copy the scene into the run's folder; its mounts name the arm models of the run."""
    source = getattr(plan.task_config, "scene", None)
    if source is None:
        return None
    scene = open_scene(source)
    (fresh / "scene").mkdir()
    for name in {body.mesh for body in scene.spec.bodies}:
        target = fresh / "scene" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(scene.folder / name, target)
    mounts = tuple(
        replace(mount, arm=f"../arms/{name}")
        for name, mount in zip(arm_names(scene.spec.mounts), scene.spec.mounts, strict=True)
    )
    save_spec(replace(scene.spec, mounts=mounts), fresh / "scene" / FILE)
    return {"from": str(source), "hash": scene.content_hash}


def versions() -> dict[str, str]:
    """Versions of the software that computed the run."""
    from importlib.metadata import version

    return {
        "surgisoft": surgisoft.__version__,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "rsl-rl-lib": version("rsl-rl-lib"),
    }


class RunFolder:
    """A run that is there."""

    def __init__(self, path: str | Path):
        self.path = run_path(path)
        file = self.path / "config.json"
        if not file.is_file():
            raise InputError(
                f"{path}: no training run there (config.json missing); make one with "
                "'surgisoft train'"
            )
        self.config = read_json(file)
        known = isinstance(self.config, dict) and self.config.get("format") == FORMAT
        if not known or "hyper_parameters" not in self.config:
            raise InputError(f"{file}: not a training run of format {FORMAT}; train it again")
        needed = {field.name for field in fields(RunConfig)}
        table = {name: value for name, value in self.config.items() if name in needed}
        self.checked: RunConfig = from_table(RunConfig, table, Where(file))

    @property
    def agents(self) -> dict[str, dict]:
        """agent -> `observation` (its width), `chambers` and `step_kPa`."""
        return self.config["agents"]

    def plan(self) -> Plan:
        """The plan of the run; its world is built from the parts in the folder."""
        c = self.checked
        return Plan(
            task=c.task,
            task_config=self._task_config(),
            preset_name=c.preset,
            preset=c.hyper_parameters,
            steps=c.steps,
            minutes=c.minutes,
            target_error=c.target_error,
            seed=c.seed,
        )

    def longer_plan(self, steps: int) -> Plan:
        """The plan with more steps, where training on equals a training of so many from the start.

        Raises InputError where it does not: where the noise of the actions has a schedule over the
        whole training, or time decides about its end; and for no more steps than before.
        """
        plan = self.plan()
        if plan.steps is None or plan.minutes is not None:
            raise InputError(
                f"{self.path}: its training ends by --minutes; --steps raises the steps of a run "
                "that was started with --steps alone"
            )
        if steps <= plan.steps:
            raise InputError(
                f"--steps is {steps:,}, and {self.path} was started with {plan.steps:,}; expected "
                "more: all steps count, those before too"
            )
        if plan.preset.last_noise is not None:
            raise InputError(
                f"{self.path}: cannot go on to {steps:,} steps, because the noise of its actions "
                f"(preset {plan.preset_name}) fell to its least over its {plan.steps:,} steps; "
                f"train a new run: surgisoft train --task {plan.task} --preset {plan.preset_name} "
                f"--seed {plan.seed} --steps {steps} -o NEW (runs of --preset paper can go on)"
            )
        return replace(plan, steps=steps)

    def set_steps(self, steps: int) -> None:
        """Write another number of steps into the plan of the run (`longer_plan`)."""
        self.config["steps"] = steps
        write_atomically(self._file, json.dumps(self.config, indent=2) + "\n", noted=False)
        self.checked = replace(self.checked, steps=steps)

    def _task_config(self):
        self._check_task()
        config = config_from(self.config["task"], self.config["task_config"], self._file)
        if self.config["scene"]:
            return with_fields(config, scene=str(self.path / "scene"), arm=None)
        return with_fields(config, arm=str(self.path / "arms" / "arm"))

    def _check_task(self) -> None:
        """Raise InputError where the package that offers the run's task is not installed."""
        name = self.config["task"]
        if name not in task_names():
            package = self.config.get("task_package") or "the package that offers it"
            raise InputError(
                f"{self.path}: was trained on the task '{name}', which is not installed here; "
                f"install {package} first"
            )

    @property
    def _file(self) -> Path:
        return self.path / "config.json"

    def task(self, device: str | torch.device = "cpu") -> Task:
        """The task that the run trains, from the folder alone."""
        return make_task(self.config["task"], self._task_config(), device)

    def arm_parts(self, name: str) -> tuple[bytes, ...] | None:
        """Content of the files that an arm's model is opened from; None without such an arm."""
        folder = self.path / "arms" / name
        if not folder.is_dir():
            return None
        config = read_json(folder / "config.json")
        parts = [config.get(part) for part in ("arm", "network", "effects")]
        return json.dumps(parts).encode(), (folder / "weights.safetensors").read_bytes()

    def checkpoint(self, which: str) -> Path:
        """The file of `last` or `best`."""
        return self.path / "checkpoints" / f"{which}.pt"

    @property
    def chosen(self) -> str:
        """Which checkpoint acts where none is named: `best`, or `last` where there is no best."""
        return BEST if self.checkpoint(BEST).is_file() else LAST

    @property
    def policy_hash(self) -> str | None:
        """sha256 in hex of the chosen checkpoint's file; None where there is no such file yet."""
        file = self.checkpoint(self.chosen)
        return hashlib.sha256(file.read_bytes()).hexdigest() if file.is_file() else None

    def save(self, which: str, content: dict[str, Any]) -> None:
        """Write a checkpoint, whole or not at all."""
        buffer = io.BytesIO()
        torch.save(content, buffer)
        write_atomically(self.checkpoint(which), buffer.getvalue())

    def load(self, which: str, device: str | torch.device = "cpu") -> dict[str, Any]:
        """A checkpoint; opening it runs no code of it."""
        file = self.checkpoint(which)
        if not file.is_file():
            raise InputError(
                f"{file}: there is no such checkpoint yet; continue with 'surgisoft train --resume "
                f"{typed(self.path)}'"
            )
        try:
            _check_packing(file)
            saved = torch.load(file, map_location=device, weights_only=True)
        except Exception as error:
            raise InputError(f"{file}: damaged checkpoint ({str(error)[:100]})") from error
        if not isinstance(saved, dict):
            raise InputError(f"{file}: damaged checkpoint (no table in it); train it again")
        return saved


def _check_packing(file: Path) -> None:
    """Raise ValueError for an archive whose members claim more bytes than the file has.

    `torch.save` stores its members as they are, without compression.
    """
    with zipfile.ZipFile(file) as archive:
        if sum(member.file_size for member in archive.infolist()) > file.stat().st_size:
            raise ValueError("its parts claim more bytes than the file has")


@contextlib.contextmanager
def damaged(file: Path) -> Iterator[None]:
    """Turn what damaged content of a checkpoint makes fail into an InputError."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = f"{type(error).__name__}: {str(error)[:200]}"
        raise InputError(f"{file}: damaged checkpoint ({reason}); train it again") from error
