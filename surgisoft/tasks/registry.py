"""Every task's configuration by name, as a value, as a plain table and from a TOML file."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from surgisoft.config import Where, from_table, merged, read_toml, to_table
from surgisoft.errors import InputError, unknown_name
from surgisoft.tasks.base import Task
from surgisoft.tasks.circle_ablation import CircleAblation, CircleAblationConfig
from surgisoft.tasks.keyhole import Keyhole, KeyholeConfig
from surgisoft.tasks.laser_plane import LaserPlaneConfig, laser_plane
from surgisoft.tasks.track import SQUARE, TrackConfig, track_circle, track_square
from surgisoft.tasks.track_body import TrackBody, TrackBodyConfig

CONFIGS: dict[str, Any] = {
    "track_circle": TrackConfig(),
    "track_square": SQUARE,
    "track_body": TrackBodyConfig(),
    "laser_plane": LaserPlaneConfig(),
    "keyhole": KeyholeConfig(),
    "circle_ablation": CircleAblationConfig(),
}
"""Name -> the configuration that the task has without one."""


def config_of(task: str) -> Any:
    """The named task's own configuration; an unknown name answers with the known ones."""
    if task not in CONFIGS:
        raise unknown_name("task", task, CONFIGS)
    return CONFIGS[task]


def config_from(task: str, table: dict, file: Path, text: str = "") -> Any:
    """The named task's configuration with the fields of a table changed; `file` is for errors."""
    own = config_of(task)
    whole = merged(to_table(own), table)
    try:
        return from_table(type(own), whole, Where(file, text))
    except InputError as error:
        raise InputError(str(error) if str(file) in str(error) else f"{file}: {error}") from None


def read_config(task: str, file: Path) -> Any:
    """The named task's configuration with the fields of a TOML file changed."""
    config_of(task)
    table, where = read_toml(file)
    return config_from(task, table, where.path, where.text)


def with_fields(config: Any, **values: Any) -> Any:
    """The configuration with each named field changed, at whatever depth it is.

    A name that no part of it has is an error.
    """
    changed, found = _with_fields(config, values)
    absent = set(values) - found
    if absent:
        raise InputError(
            f"this task has no {', '.join(sorted(absent))}: leave '{sorted(absent)[0]}' out"
        )
    return changed


def _with_fields(config: Any, values: dict[str, Any]) -> tuple[Any, set[str]]:
    changes, found = {}, set()
    for field in dataclasses.fields(config):
        part = getattr(config, field.name)
        if field.name in values:
            changes[field.name] = values[field.name]
            found.add(field.name)
        elif dataclasses.is_dataclass(part):
            changes[field.name], inner = _with_fields(part, values)
            found |= inner
    return dataclasses.replace(config, **changes), found


TASKS: dict[str, Callable[..., Task]] = {
    "track_circle": track_circle,
    "track_square": track_square,
    "track_body": TrackBody,
    "laser_plane": laser_plane,
    "keyhole": Keyhole,
    "circle_ablation": CircleAblation,
}
"""Name -> builder(config=None, device="cpu"); without a config the task's own."""


def make_task(name: str, config=None, device: str | torch.device = "cpu") -> Task:
    """The named task; an unknown name answers with the known ones."""
    if name not in TASKS:
        raise unknown_name("task", name, TASKS)
    return TASKS[name](config, device)
