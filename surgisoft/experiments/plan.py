"""Settings of an experiment: every case on every lesion with every combination of what varies."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surgisoft.agents.on_rig import RigConfig, on_rig, rigs_by_arm
from surgisoft.config import Where, merged, to_table
from surgisoft.errors import InputError
from surgisoft.experiments.phases import PhasedTask
from surgisoft.experiments.spec import (
    Case,
    Experiment,
    Lesion,
    Vary,
    task_config,
)
from surgisoft.rig.hidden import HIDDEN
from surgisoft.rig.registry import SIMULATED, hidden_of, parse_rig
from surgisoft.scene.folder import Scene, open_scene
from surgisoft.scene.lesion import distance_from_ring_mm
from surgisoft.tasks.registry import with_fields, with_present_names

Value = int | float | str | tuple[int | float, ...]
MOST_SETTINGS = 100_000
"""Most settings of an experiment."""
LONGEST_LABEL = 200
"""Most bytes of a setting's label: a file's name has 255, with a number and an ending."""
LARGE = 1e6
"""Absolute value from which six digits, which are enough below it, would be an exponent."""
ROBOT_SEED = ("rig.robot_seed", "rig.specimen")
"""Names of the field that varies the robot: the present one and that of earlier versions."""


@dataclass(frozen=True)
class Setting:
    """One condition of the experiment, with `repeats` episodes."""

    number: int
    """Number of the setting in the experiment."""
    case: Case
    """Policy and plant."""
    lesion: Lesion | None
    """Lesion to cut; None: that of the scene."""
    values: tuple[tuple[str, Value], ...]
    """Varied fields and their values."""

    @property
    def label(self) -> str:
        """A name of letters, digits, '_', '-', '.' and '=', unique in the experiment."""
        parts = [self.case.name, *([self.lesion.name] if self.lesion else [])]
        parts += [f"{field.split('.')[-1]}={_short(value)}" for field, value in self.values]
        return "_".join(parts)

    @property
    def words(self) -> str:
        """Label of the setting in words."""
        parts = [self.case.name, *([self.lesion.name] if self.lesion else [])]
        return ", ".join([*parts, *(f"{f.split('.')[-1]} {in_words(v)}" for f, v in self.values)])

    @property
    def columns(self) -> dict[str, int | float | str]:
        """Varied fields and their values for a row of results; several numbers as one text."""
        return {f: in_words(v) if isinstance(v, tuple) else v for f, v in self.values}


def in_words(value: Value) -> str:
    """A value as text, several numbers as `[2, 10]`."""
    if not isinstance(value, tuple):
        return f"{value}"
    return f"[{', '.join(f'{number:.15g}' for number in value)}]"


def _short(value: Value) -> str:
    """A value in characters of a file's name; a number from `LARGE` on with all of its digits."""
    if isinstance(value, tuple):
        return "-".join(map(_short, value))
    if isinstance(value, str):
        text = Path(value).name
    else:
        text = f"{value:g}" if abs(value) < LARGE else f"{value:.15g}".replace("+", "")
    return "".join(c if c.isalnum() or c in "-." else "-" for c in text)


def settings(spec: Experiment, where: Where | None = None) -> list[Setting]:
    """Every setting in order; a value that does not fit is one line.

    What varies on a rig only has no values in a case in simulation, so that each of its settings is
    there once.
    """
    place = where or Where(Path(spec.name))
    seen: set[str] = set()
    for i, vary in enumerate(spec.vary):
        _check_vary(spec, vary, place / "vary" / i)
        field = ROBOT_SEED[0] if vary.field in ROBOT_SEED else vary.field
        if field in seen:
            raise (place / "vary" / i / "field").error(
                f"a second '{vary.field}'", "all values of a field in one [[vary]]"
            )
        seen.add(field)
    count = math.prod([len(spec.cases), len(spec.lesions or (None,))])
    count *= math.prod(len(vary.values) for vary in spec.vary)
    if count > MOST_SETTINGS:
        raise (place / "vary").error(f"{count} settings", f"at most {MOST_SETTINGS}")
    lesions = spec.lesions or (None,)
    every = [
        parts
        for case in spec.cases
        for parts in itertools.product((case,), lesions, itertools.product(*_grid(spec, case)))
    ]
    found = [Setting(number, *parts) for number, parts in enumerate(every)]
    for setting in found:
        rig_config(setting, place, spec.of.agents)
    labels = [setting.label for setting in found]
    longest = max(labels, key=lambda label: len(label.encode()))
    if (size := len(longest.encode())) > LONGEST_LABEL:
        raise (place / "vary").error(
            f"the setting '{longest[:40]}...' has {size} bytes in its name",
            f"at most {LONGEST_LABEL}, for the names of its files; shorten values or cases' names",
        )
    if twice := [label for label, number in Counter(labels).items() if number > 1]:
        raise (place / "vary").error(f"'{min(twice)}' appears twice", "values that differ")
    return found


def _grid(spec: Experiment, case: Case) -> list[list[tuple[str, Value]]]:
    """(field, value) of all values of each field that varies in a case."""
    return [
        [(vary.field, value) for value in vary.values]
        for vary in spec.vary
        if case.plant == "rig" or not _on_rig_only(vary.field)
    ]


def _on_rig_only(field: str) -> bool:
    """Whether a field that varies is one of rigs: a hidden effect, or the robot's seed."""
    return field.startswith(("hidden.", "rig."))


def _check_vary(spec: Experiment, vary: Vary, place: Where) -> None:
    top, _, name = vary.field.partition(".")
    if top == "task" and name and name != "scene":
        for i, value in enumerate(vary.values):
            try:
                configured(spec, ((vary.field, value),))
            except InputError as error:
                if not isinstance(value, tuple) and (example := _list_for(spec, vary)):
                    raise (place / "values").error(
                        f"got {value!r}, where a value of {vary.field} is a list of numbers",
                        f"each value as a list itself, such as values = [{example}, ...]",
                    ) from None
                raise (place / "values" / i).error(
                    f"{error}", "a value that the task takes"
                ) from None
    elif vary.field in ROBOT_SEED:
        bad = [value for value in vary.values if not isinstance(value, int) or value < 0]
        if bad:
            raise (place / "values").error(f"got {bad[0]}", "whole numbers from 0")
    elif top == "hidden":
        if name not in HIDDEN:
            raise (place / "field").error(
                f"unknown effect '{name}'", f"one of {', '.join(sorted(HIDDEN))}"
            )
        bad = [v for v in vary.values if not isinstance(v, int | float) or v < 0]
        if bad:
            raise (place / "values").error(f"got {bad[0]!r}", "amplitudes from 0")
    elif top == "fault" and name in ("chamber", "at_s") and spec.faults:
        kind = int if name == "chamber" else int | float
        bad = [v for v in vary.values if not isinstance(v, kind) or v < (name == "chamber")]
        if bad:
            raise (place / "values").error(f"got {bad[0]!r}", f"what a fault has as {name}")
    elif top == "task" and name == "scene":
        raise (place / "field").error(
            f"got '{vary.field}'", "a case for each scene: [[cases]] with scene = 'FOLDER'"
        )
    else:
        raise (place / "field").error(
            f"got '{vary.field}'",
            "task.NAME, hidden.EFFECT, rig.robot_seed, or (with faults) fault.chamber, fault.at_s",
        )
    if _on_rig_only(vary.field) and not any(case.plant == "rig" for case in spec.cases):
        raise (place / "field").error(
            f"got '{vary.field}', which varies on a rig only", "a case with plant = 'rig'"
        )


def _list_for(spec: Experiment, vary: Vary) -> str:
    """A list that the field takes as one value: all that are given, or that of the task; in words.

    Empty for a field that takes none.
    """
    present: Any = to_table(spec.task)
    for part in vary.field.split(".")[1:]:
        present = present.get(part) if isinstance(present, dict) else None
    for value in (vary.values, present):
        given = value if isinstance(value, tuple | list) else ()
        numbers = tuple(each for each in given if isinstance(each, int | float))
        if numbers and len(numbers) == len(given):
            with contextlib.suppress(InputError):
                configured(spec, ((vary.field, numbers),))
                return in_words(numbers)
    return ""


def configured(spec: Experiment, values) -> Any:
    """The task's configuration with pairs (field, value) of what varies; not yet in a scene."""
    table = to_table(spec.task)
    for field, value in values:
        top, _, name = field.partition(".")
        if top == "task":
            change: Any = list(value) if isinstance(value, tuple) else value
            for part in reversed(name.split(".")):
                change = {part: change}
            table = merged(table, with_present_names(spec.task, change))
    try:
        return task_config(spec.of, table, Where(Path(spec.name)))
    except InputError as error:
        raise InputError(str(error).removeprefix(f"{spec.name}: ")) from None


def rig_config(setting: Setting, place: Where, arms: Sequence[str]) -> RigConfig | None:
    """The rig of a setting for these arms; None in simulation."""
    varied: dict[str, Any] = dict(setting.values)
    if setting.case.plant != "rig":
        return None
    hidden: dict[str, float] = {}
    for text in setting.case.hidden:
        name, colon, strength = text.partition(":")
        if name in hidden:
            raise (place / "cases").error(f"a second '{name}'", "each hidden effect once")
        try:
            hidden[name] = float(strength) if colon else 1.0
        except ValueError:
            raise (place / "cases").error(f"got '{text}'", "NAME or NAME:STRENGTH") from None
    for field, value in varied.items():
        if field.startswith("hidden."):
            hidden[field.removeprefix("hidden.")] = float(value)
    rigs = {parse_rig(rig).name for rig in rigs_by_arm(setting.case.rigs, arms).values()}
    for name in hidden:
        for rig in rigs.intersection(SIMULATED):
            if name not in hidden_of(rig):
                raise (place / "cases").error(
                    f"unknown hidden effect '{name}'", f"one of {', '.join(sorted(hidden_of(rig)))}"
                )
    seeds = [varied[name] for name in ROBOT_SEED if name in varied] or [setting.case.robot_seed]
    for effect, amount in hidden.items():
        if not 0.0 <= amount < math.inf:
            raise (place / "cases").error(
                f"strength of '{effect}' is {amount:g}", "a number from 0 on"
            )
    pairs = tuple((name, strength) for name, strength in hidden.items() if strength > 0.0)
    return RigConfig(
        seed=int(seeds[0]), hidden=pairs, rigs=setting.case.rigs, preflight=setting.case.preflight
    )


def scene_folder(spec: Experiment, case: Case) -> str:
    """Folder of the scene of a case: its own, or that of the experiment."""
    return case.scene or spec.scene


def scene_of(spec: Experiment, setting: Setting) -> Scene:
    """The scene with the setting's lesion, in place of its own and of its contours."""
    scene = open_scene(scene_folder(spec, setting.case))
    if setting.lesion is None:
        return scene
    lesion = dataclasses.replace(
        scene.spec.lesion,
        centre_mm=setting.lesion.centre_mm,
        diameter_mm=setting.lesion.diameter_mm,
        path_mm=(),
    )
    moved = scene.with_lesion(lesion)
    moved = dataclasses.replace(moved, spec=dataclasses.replace(moved.spec, contours=()))
    try:
        ring = moved.ring
    except InputError as error:
        raise InputError(f"lesion '{setting.lesion.name}': {error}") from None
    least = moved.spec.limits.clearance_mm
    for name, mesh in moved.keep_out.items():
        if (away := distance_from_ring_mm(mesh, ring)) < least:
            raise InputError(
                f"lesion '{setting.lesion.name}': its ring is {away:.1f} mm from '{name}', "
                f"expected at least {least:g} mm (clearance_mm of the scene); choose another place "
                "or a smaller diameter"
            )
    return moved


def build_task(
    spec: Experiment,
    setting: Setting,
    on_warning: Callable[[str], None] | None = warnings.warn,
) -> PhasedTask:
    """The phased task of a setting, with its arms on the rig where the case has that plant.

    on_warning: is told of arm models that do not predict the rig, see `on_rig`.
    """
    config = configured(spec, setting.values)
    if setting.case.arm:
        config = with_fields(config, arm=setting.case.arm)
    if spec.in_scene:
        config = dataclasses.replace(config, scene=scene_folder(spec, setting.case))
        opened = dataclasses.replace(config, scene=scene_of(spec, setting))
        base = spec.of.build(opened, "cpu")
        base.config = config
    else:
        base = spec.of.build(config, "cpu")
    rig = rig_config(setting, Where(Path(spec.name)), base.agents)
    varied: dict[str, Any] = {
        f.removeprefix("fault."): v for f, v in setting.values if f.startswith("fault.")
    }
    faults = tuple(dataclasses.replace(fault, **varied) for fault in spec.faults)
    spec = dataclasses.replace(spec, faults=faults)
    return PhasedTask(
        spec.of.experiment.supervise(
            base if rig is None else on_rig(base, rig, on_warning=on_warning)
        ),
        spec,
    )
