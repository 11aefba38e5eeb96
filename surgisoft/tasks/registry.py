"""The list of tasks, and their configurations as values, plain tables and TOML files.

A new task is one file and one line in `TASKS`. Training presets, the promises in
`tests/tasks/test_tasks.py` and the reference in the docs follow from that line; the Gymnasium id of
a task of one agent follows from its name in `surgisoft.environments.ONE_AGENT`. A task in another
package is a `TaskSpec` in the entry point group `surgisoft.tasks`.
"""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

import torch

from surgisoft.config import Where, from_table, merged, read_toml, to_table
from surgisoft.errors import InputError, raised_at, raised_by, unknown_name
from surgisoft.tasks.area_ablation import AREA_ABLATION
from surgisoft.tasks.arguments import check_path, device_of, whole
from surgisoft.tasks.base import DocumentedTask, Task
from surgisoft.tasks.breathing_ablation import BREATHING_ABLATION
from surgisoft.tasks.circle_ablation import CIRCLE_ABLATION
from surgisoft.tasks.contour_ablation import CONTOUR_ABLATION
from surgisoft.tasks.keyhole import KEYHOLE
from surgisoft.tasks.keyhole_ablation import KEYHOLE_ABLATION
from surgisoft.tasks.laser_plane import LASER_PLANE
from surgisoft.tasks.spec import TaskSpec
from surgisoft.tasks.track import TRACK_CIRCLE, TRACK_SQUARE
from surgisoft.tasks.track_body import TRACK_BODY
from surgisoft.tasks.two_laser_ring import TWO_LASER_RING
from surgisoft.tasks.world.world import say_assumed

TASKS: dict[str, TaskSpec] = {
    "track_circle": TRACK_CIRCLE,
    "track_square": TRACK_SQUARE,
    "track_body": TRACK_BODY,
    "laser_plane": LASER_PLANE,
    "keyhole": KEYHOLE,
    "circle_ablation": CIRCLE_ABLATION,
    "contour_ablation": CONTOUR_ABLATION,
    "area_ablation": AREA_ABLATION,
    "breathing_ablation": BREATHING_ABLATION,
    "two_laser_ring": TWO_LASER_RING,
    "keyhole_ablation": KEYHOLE_ABLATION,
}
"""Every task by name."""
MOST_STEPS = 10_000_000
"""Most steps of an episode: eleven days at 0.1 s."""
MOST_COUNT = 1_000
"""Largest count in a task's configuration, such as the points of a centreline: far above any in
use; a damaged file that claims more would take memory or minutes."""
BOUNDED_ELSEWHERE = ("loops", "scene")
"""Fields of a configuration that `MOST_COUNT` is not for: loops are bounded by the steps."""


PATHS = {
    "scene": "the folder of a scene",
    "arm": "the folder of an arm model, or 'default'",
}
"""Fields of a configuration that name a folder, and what it is."""
GROUP = "surgisoft.tasks"
"""Entry point group of tasks in other packages."""


def task_names() -> list[str]:
    """Names of all tasks: those of this package, then those that installed packages offer."""
    return [*TASKS, *(name for name in offered(tuple(sys.path)) if name not in TASKS)]


def spec_of(task: str) -> TaskSpec:
    """The named task's entry; an unknown name raises an InputError that lists the known ones."""
    if task in TASKS:
        return TASKS[task]
    entry = offered(tuple(sys.path)).get(task)
    if entry is None:
        raise unknown_name("task", task, task_names())
    return _loaded(entry)


@functools.cache
def offered(path: tuple[str, ...]) -> dict[str, EntryPoint]:
    """Entry points of tasks by name while the search path is this one; none is loaded."""
    return {entry.name: entry for entry in entry_points(group=GROUP)}


def package_of(task: str) -> str:
    """Name and version of the installed package that offers a task; empty for tasks of this one."""
    entry = None if task in TASKS else offered(tuple(sys.path)).get(task)
    dist = entry.dist if entry else None
    return f"{dist.name} {dist.version}" if dist else ""


@functools.cache
def _loaded(entry: EntryPoint) -> TaskSpec:
    """The task of an installed package."""
    label = f"task '{entry.name}' ({entry.value})"
    try:
        spec = entry.load()
    except Exception as error:
        raise InputError(
            f"{label}: does not load ({raised_at(error)}); correct or remove that package"
        ) from error
    if not isinstance(spec, TaskSpec):
        raise InputError(
            f"{label}: is a {type(spec).__name__}, expected a surgisoft.tasks.spec.TaskSpec"
        )
    return spec


def make_task(name: str, config: Any = None, device: str | torch.device = "cpu") -> DocumentedTask:
    """Build the named task; without a config with its default one.

    Raises InputError for an episode of no step or of more than `MOST_STEPS`, for a delay that is no
    shorter than an episode, for a count in the configuration of one of the package's tasks above
    `MOST_COUNT`, and for an exception in the code that builds a task of another package. Warns
    (`AssumptionWarning`) where only the tip of an arm was measured and the task needs more of it.
    """
    spec = spec_of(name)
    if name in TASKS:
        _check_counts(name, spec.config if config is None else config)
    try:
        task = spec.build(spec.config if config is None else config, device)
        if name not in TASKS:
            _check_own(name, task)
        steps = task.steps
    except OverflowError:  # a time over dt_s is infinite
        steps = MOST_STEPS + 1
    except InputError:
        raise
    except (Exception, SystemExit) as error:
        if name in TASKS:
            raise
        raise raised_by(f"task '{name}'", error, "task") from error
    if steps > MOST_STEPS:
        raise InputError(
            f"{name}: an episode of more than {MOST_STEPS:,} steps; expected shorter times, fewer "
            "loops or a longer dt_s in its configuration"
        )
    if steps < 1:
        raise InputError(
            f"{name}: an episode of no step; expected longer times or a shorter dt_s in its "
            "configuration"
        )
    if (delay := task.world.config.randomisation.delay) >= steps:
        raise InputError(
            f"{name}: world.randomisation.delay is {delay} in episodes of {steps} steps; expected "
            "fewer, so that actions take effect before the end"
        )
    say_assumed(task.name, task.world.arms)
    return task


def _check_own(name: str, task: Any) -> None:
    """Raise InputError where what a package builds as a task is none, or has another name."""
    if not hasattr(task, "name"):
        raise InputError(
            f"task '{name}': what builds it returns a {type(task).__name__}, expected a "
            "surgisoft.tasks.base.Task"
        )
    if task.name != name:
        raise InputError(f"task '{name}': its name is '{task.name}', expected '{name}'")


def _check_counts(name: str, config: Any, place: str = "") -> None:
    """Raise InputError for a count above `MOST_COUNT`; place: prefix of the fields' names."""
    for field in [each.name for each in dataclasses.fields(config)]:
        value = getattr(config, field)
        if field in BOUNDED_ELSEWHERE:
            continue
        if dataclasses.is_dataclass(value):
            _check_counts(name, value, f"{place}{field}.")
        elif type(value) is int and value > MOST_COUNT:
            raise InputError(f"{name}: {place}{field} is {value}, expected at most {MOST_COUNT:,}")


def make_with(
    name: str,
    config: Any = None,
    device: str | torch.device = "cpu",
    scene: str | Path | None = None,
    arm: str | Path | None = None,
    geometry: str | None = None,
    images: str | None = None,
    image_pixels: int | None = None,
) -> Task:
    """Build the named task with fields of its config changed; None leaves one as it is.

    config: the task's whole config, or a TOML file with fields of it; None: its default one. scene:
    a scene's folder. arm: an arm model's folder or `default`. geometry: `fcl` or `batched`, see
    `world.scene.GEOMETRIES`. images, image_pixels: see `world.images.ImageConfig`.
    """
    default = config_of(name)
    if isinstance(config, str | Path):
        config = read_config(name, Path(config))
    config = default if config is None else config
    kind = type(config)
    if not isinstance(config, type(default)):
        of = [f.name for f in dataclasses.fields(default) if type(getattr(default, f.name)) is kind]
        part = f" (with it as the field '{of[0]}')" if of else ""
        raise InputError(
            f"config of '{name}' is of type {kind.__name__}, expected {type(default).__name__}"
            f"{part} or the path of a TOML file"
        )
    changes = {
        "scene": scene,
        "arm": arm,
        "geometry": geometry,
        "images": images,
        "image_pixels": image_pixels,
    }
    given = {field: value for field, value in changes.items() if value is not None}
    for field, what in PATHS.items():
        if field in given:
            check_path(field, given[field], what)
    if not isinstance(given.get("images", ""), str):
        raise InputError(f"images is {images!r}, expected kinds of image with commas in between")
    if "image_pixels" in given:
        given["image_pixels"] = whole("image_pixels", image_pixels)
    return make_task(name, with_fields(config, **given), device_of(device))


def task_of(task: str | Task, device: str | torch.device | None = None, **changes: Any) -> Task:
    """The named task with changes as for `make_with`, or a task that is built already.

    The latter has its own configuration, device and geometry. Raises InputError for another object,
    and for a change of the configuration, or another device or geometry, beside a built task.
    device: None: the task's own, of a named task the CPU.
    """
    if isinstance(task, str):
        return make_with(task, device="cpu" if device is None else device, **changes)
    if not hasattr(task, "world"):
        raise InputError(
            f"task is of type {type(task).__name__}, expected the name of a task or a task; "
            "check the order of the arguments"
        )
    beside = [name for name in changes if changes[name] is not None]
    engine = getattr(getattr(task.world, "config", None), "scene_engine", None)
    if "geometry" in beside and changes["geometry"] == getattr(engine, "geometry", None):
        beside.remove("geometry")
    if device is not None and device_of(device).type != task.world.device.type:
        beside.append("device")
    if beside:
        raise InputError(
            f"{beside[0]} is given beside the task '{task.name}', which is built already; build "
            "the task with it, or name the task"
        )
    return task


def config_of(task: str) -> Any:
    """The named task's default configuration."""
    return spec_of(task).config


def config_from(task: str, table: dict, file: Path, text: str = "") -> Any:
    """The named task's configuration with the fields of a table changed; `file` is for errors.

    Names that a field had in earlier versions are accepted, see `with_present_names`.
    """
    default = config_of(task)
    whole = merged(to_table(default), with_present_names(default, table))
    try:
        return from_table(type(default), whole, Where(file, text))
    except InputError as error:
        raise InputError(str(error) if str(file) in str(error) else f"{file}: {error}") from None


def changed_config(config: Any, changes: dict, file: Path) -> Any:
    """A task's configuration with the fields of a table changed; `file` is for errors."""
    whole = merged(to_table(config), with_present_names(config, changes))
    return from_table(type(config), whole, Where(file))


def read_config(task: str, file: Path) -> Any:
    """The named task's configuration with the fields of a TOML file changed."""
    config_of(task)
    table, where = read_toml(file)
    return config_from(task, table, where.path, where.text)


def with_fields(config: Any, **values: Any) -> Any:
    """The configuration with each named field changed, at any depth.

    A name that no part of it has raises an InputError.
    """
    changed, found = _with_fields(config, values)
    absent = set(values) - found
    if absent:
        raise InputError(
            f"this task has no {', '.join(sorted(absent))}: leave '{sorted(absent)[0]}' out"
        )
    return changed


def with_present_names(config: Any, table: Any) -> Any:
    """A table for `config`, with the field names of earlier versions replaced by the present ones.

    A config class lists them in `FORMER_NAMES`: former name -> present name, with dots where the
    field has moved into a part (`fine_weight` -> `weights.fine`). The present name wins where a
    table has both.
    """
    if not isinstance(table, dict):
        return table
    former: Mapping[str, str] = getattr(config, "FORMER_NAMES", {})
    moved: dict[str, Any] = {}
    result: dict[str, Any] = {}
    for name, value in table.items():
        if name in former:
            for part in reversed(former[name].split(".")):
                value = {part: value}
            moved = merged(moved, value)
        else:
            result[name] = value
    result = merged(moved, result)
    known = {f.name: getattr(config, f.name) for f in dataclasses.fields(config)}
    return {
        name: with_present_names(known[name], value)
        if dataclasses.is_dataclass(known.get(name))
        else value
        for name, value in result.items()
    }


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
