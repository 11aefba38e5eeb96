"""An experiment's file as frozen dataclasses; every bad field is one line with file and line."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from surgisoft.agents.run_folder import PACKAGED
from surgisoft.config import (
    Rule,
    Where,
    describe,
    from_table,
    merged,
    path_beside,
    read_toml,
    to_table,
    without_empty_tables,
    write_toml,
)
from surgisoft.errors import InputError
from surgisoft.files import resolved
from surgisoft.scene.spec import SCENES, Length, Name, Point
from surgisoft.tasks.registry import spec_of, task_names, with_present_names
from surgisoft.tasks.spec import TaskSpec

FORMAT = 1
"""Version of the file's format."""
FILE = "experiment.toml"
"""Name of the exact configuration in a folder of results."""
TIMED = ("at_rim", "beam", "beam_unsafe_longest", "time")
"""Times in the results that a phase of that name would overwrite by its own, NAME_s."""
FIRST_TASK = "circle_ablation"
"""The task of files that name none: the only one of the first experiments."""
CONTROLLERS = ("hold", "rest", "scripted", "policy")
"""Built-in controllers of an arm; a file may define more."""
PLANTS = ("simulation", "rig")
"""Plants: the arm models, or the virtual rig."""
SCRIPTED, NOMINAL = "scripted", "nominal"
"""The task's expert, which knows the true state; the one that assumes the scene's mounts."""

Duration = Annotated[float, Rule("a time from 0 to 100000 s", lambda s: 0.0 <= s <= 1e5)]
Positive = Annotated[float, Rule("a time above 0 s", lambda s: 0.0 < s <= 1e5)]
Count = Annotated[int, Rule("a whole number from 1 to 100000", lambda n: 1 <= n <= 100_000)]
Seed = Annotated[int, Rule("a whole number from 0 to 2147483647", lambda n: 0 <= n < 2**31)]
Format = Annotated[int, Rule(f"{FORMAT}", lambda number: number == FORMAT)]
AnyLength = Annotated[float, Rule("a number from -1000 to 1000 mm", lambda v: abs(v) <= 1000.0)]


A_TASK = Rule("a task's name", lambda value: value in task_names())
"""A task of this package, or of an installed one."""


def _one_of(known: Iterable[str]) -> Rule:
    known = tuple(known)
    return Rule("one of " + ", ".join(known), lambda value: value in known)


@dataclass(frozen=True)
class Phase:
    """One part of an episode: who moves which arm, until when."""

    name: Name
    """Its name, unique in the experiment."""
    timeout_s: Positive
    """Longest time in this phase, s."""
    arms: tuple[tuple[Name, Name], ...] = ()
    """(arm, controller) for each arm of the task, in the file as `ARM = "CONTROLLER"`: hold (the
    default), rest, scripted, policy, or one of `controllers`."""
    beam: bool = False
    """Whether the phase permits the beam; the interlock must permit it, too."""
    until: str = "never"
    """The condition to go on to the next phase, one of those that the task offers."""
    within: Annotated[float, Rule("a number from -1 to 1000", lambda v: -1.0 <= v <= 1e3)] = -1.0
    """Threshold of the condition, in the condition's unit; -1: its default."""
    hold_s: Duration = 0.0
    """Time for which the condition has to hold without interruption, s."""
    on_timeout: Annotated[str, _one_of(("abort", "go on"))] = "abort"
    """What happens when the time of this phase is out."""

    def controller(self, arm: str) -> str:
        """Name of what controls an arm in this phase."""
        return dict(self.arms)[arm]


@dataclass(frozen=True)
class ControllerSpec:
    """A user-defined controller of an arm: a pressure schedule or waypoints."""

    name: Name
    """Name by which phases refer to the controller."""
    schedule: str = ""
    """CSV with t_s and c1_kPa ... cm_kPa, linear between rows, from the phase's begin."""
    waypoints: tuple[tuple[float, float, float, float], ...] = ()
    """Rows [t_s, x, y, z] (s from the phase's begin; mm, world frame) that the axis goes through;
    linear between rows."""


@dataclass(frozen=True)
class Case:
    """One arm of the experiment's design: what is compared side by side."""

    name: Name
    """Its name, unique in the experiment."""
    plant: Annotated[str, _one_of(PLANTS)] = PLANTS[0]
    """Plant: `simulation` for the arm models, `rig` for each arm on a rig."""
    policy: str = SCRIPTED
    """Policy of phases with the controller `policy`: scripted, nominal, or a training run's folder.
    """
    hidden: tuple[str, ...] = ()
    """On the rig: hidden effects, NAME or NAME:AMPLITUDE."""
    robot_seed: Seed = 0
    """On a simulated rig: seed of the robot."""
    rigs: tuple[str, ...] = ("virtual",)
    """On the rig: `NAME[:option=value,...]` for all arms, or `ARM=NAME[:...]` for one of them."""
    preflight: bool = False
    """On a real rig: whether it has to move as its arm model predicts before each setting."""
    arm: str = ""
    """Arm model of all arms: default or a folder; without it the scene's."""
    scene: str = ""
    """Folder of the case's scene, relative to the file; empty: the experiment's."""


@dataclass(frozen=True)
class Lesion:
    """A lesion to cut instead of that of the scene."""

    name: Name
    """Its name, unique in the experiment."""
    centre_mm: Point
    """Centre, within 0.5 mm of the organ's surface, world frame (mm)."""
    diameter_mm: Length = 20.0
    """Diameter of the ring (mm)."""


@dataclass(frozen=True)
class Vary:
    """A field that varies over several values; several such fields make a grid."""

    field: str
    """`task.NAME` (dots go deeper), `hidden.EFFECT` (amplitude, on the rig),
    `rig.robot_seed`, `fault.chamber` or `fault.at_s`."""
    values: Annotated[
        tuple[int | float | str | tuple[int | float, ...], ...],
        Rule("a list of at least one value", lambda v: len(v) > 0),
    ]
    """Values of the field; a value of a field of several numbers is a list of them."""


@dataclass(frozen=True)
class Fault:
    """A failure of a chamber in every episode."""

    arm: Name
    """Arm of the chamber."""
    at_s: Duration
    """Time of the failure, s from the episode's begin."""
    chamber: Count = 1
    """Number of the chamber, from 1: its valve stays open, and it goes to 0 kPa as fast as a pump.
    """


@dataclass(frozen=True)
class Limits:
    """Limits that switch the beam off or abort an episode."""

    time_s: Positive = 60.0
    """Longest time of an episode, s."""
    clearance_mm: AnyLength = 0.0
    """The beam is off while any clearance is below this or below the limit of the scene, mm."""
    abort_clearance_mm: AnyLength = 0.0
    """Aborts below this clearance, mm."""
    view_lost_s: Duration = 2.0
    """Aborts when the lesion is out of sight for longer in a phase with the beam, s."""
    retreat: str = ""
    """The phase that an abort goes to, with the beam off for good; without it the episode ends."""


@dataclass(frozen=True)
class Experiment:
    """Content of an experiment's file, with absolute paths."""

    name: Name
    """Name of the experiment."""
    phases: tuple[Phase, ...]
    """Phases of an episode, in order."""
    scenario: Annotated[str, A_TASK] = FIRST_TASK
    """Name of the task, as in `surgisoft evaluate --task`."""
    scene: str = ""
    """Folder of the scene, relative to the file; empty for a task without a scene."""
    repeats: Count = 1
    """Episodes of each condition."""
    seed: Seed = 0
    """Seed of the episodes, which are equal in each condition."""
    together: Count = 8
    """Episodes that run side by side: the unit of parallel work and of resuming."""
    cases: tuple[Case, ...] = (Case(PLANTS[0]),)
    """Cases that are compared with each other."""
    lesions: tuple[Lesion, ...] = ()
    """Lesions to cut; none: that of the scene."""
    vary: tuple[Vary, ...] = ()
    """Fields that vary."""
    controllers: tuple[ControllerSpec, ...] = ()
    """User-defined controllers that phases name."""
    faults: tuple[Fault, ...] = ()
    """Failures that are injected."""
    limits: Limits = field(default_factory=Limits)
    """Limits that switch the beam off or abort an episode."""
    task: Any = None
    """Fields of the task's configuration, without `scene` and `arm`."""
    note: str = ""
    """Free text, for people."""
    format: Format = FORMAT
    """Version of this file format."""

    @property
    def of(self) -> TaskSpec:
        """The task's entry in the registry."""
        return spec_of(self.scenario)

    @property
    def in_scene(self) -> bool:
        """Whether the task takes place in a scene."""
        return any(each.name == "scene" for each in dataclasses.fields(self.of.config))


def load_experiment(path: str | Path) -> Experiment:
    """Read an experiment's file; an InputError names file, line and field of what is wrong."""
    path = Path(path)
    table, where = read_toml(path)
    name = table.get("scenario", FIRST_TASK)
    if not isinstance(name, str) or name not in task_names():
        known = ", ".join(task_names())
        raise (where / "scenario").error(f"got {describe(name)}", f"one of {known}")
    of = spec_of(name)
    given = table.pop("task", {})
    if not isinstance(given, dict):
        raise (where / "task").error(f"got '{given}'", "a table")
    for name in ("scene", "arm"):
        if name in given:
            raise (where / "task" / name).error(
                "does not belong here", "the scene at the top, the arm in a case"
            )
    plain = to_table(of.config)
    plain |= {"scene": ""} if "scene" in plain else {}
    task = task_config(of, merged(plain, with_present_names(of.config, given)), where)
    table["phases"] = _with_arms(table.get("phases"), of.agents, where / "phases")
    _rename(table, "drivers", "controllers", where)
    for i, case in enumerate(cases if isinstance(cases := table.get("cases"), list) else []):
        if isinstance(case, dict):
            _rename(case, "specimen", "robot_seed", where / "cases" / i)
    spec = dataclasses.replace(from_table(Experiment, table, where), task=task)
    _check_whole(spec, where)
    return _absolute(spec, where)


def _rename(table: dict, former: str, present: str, where: Where) -> None:
    """Give a field its present name; an InputError where the table has both names."""
    if former not in table:
        return
    if present in table:
        raise (where / former).error(f"got {former} and {present}", f"{present} alone")
    table[present] = table.pop(former)


def _with_arms(phases: Any, agents: tuple[str, ...], where: Where) -> Any:
    """The tables of phases with the controllers of all arms, in their order, under `arms`."""
    if not isinstance(phases, list):
        return [] if phases is None else phases
    fields = [each.name for each in dataclasses.fields(Phase) if each.name != "arms"]
    for i, phase in enumerate(phases):
        for name in phase if isinstance(phase, dict) else ():
            if name not in (*fields, *agents):
                known = f"an arm ({', '.join(agents)}) or one of {', '.join(fields)}"
                raise (where / i / name).error("unknown field", known)
    return [
        {name: value for name, value in phase.items() if name not in agents}
        | {"arms": [[agent, phase.get(agent, "hold")] for agent in agents]}
        if isinstance(phase, dict)
        else phase
        for phase in phases
    ]


def task_config(of: TaskSpec, table: dict, where: Where) -> Any:
    """A task's configuration from a whole table; errors name the file and the field."""
    try:
        return from_table(type(of.config), table, where / "task")
    except InputError as error:
        text = str(error)
        raise InputError(
            text if text.startswith(str(where.path)) else f"{where.path}: {text}"
        ) from None


def save_experiment(spec: Experiment, path: Path) -> None:
    """Write the exact configuration, with every default; loading it gives an equal one.

    What the package brings along is written by its name, which holds in every installation.
    """
    folder = resolved(path.parent)
    table = _without_none(to_table(spec))
    for name in ("scene", "arm"):
        table["task"].pop(name, None)
    table["scene"] = _from_folder(spec.scene, folder) if spec.scene else ""
    table["phases"] = [
        {name: value for name, value in phase.items() if name != "arms"} | dict(phase["arms"])
        for phase in table["phases"]
    ]
    for controller in table["controllers"]:
        if controller["schedule"]:
            controller["schedule"] = _from_folder(controller["schedule"], folder)
    for case in table["cases"]:
        for name in ("policy", "arm"):
            if case[name] not in ("", "default", SCRIPTED, NOMINAL):
                case[name] = _from_folder(case[name], folder)
        case["scene"] = _from_folder(case["scene"], folder) if case["scene"] else ""
    table["task"] = without_empty_tables(type(spec.task), table["task"])
    write_toml(path, without_empty_tables(Experiment, table))


def _from_folder(path: str, folder: Path) -> str:
    """A path as a file in the folder names it: a packaged one by its name."""
    if _packaged(Path(path).name) == Path(path):
        return Path(path).name
    try:
        return os.path.relpath(path, folder)
    except ValueError:  # on Windows: another drive
        return path


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_none(part) for key, part in value.items() if part is not None}
    return [_without_none(part) for part in value] if isinstance(value, list) else value


def _packaged(text: str) -> Path | None:
    """The scene or the training run that the package brings along.

    text: its name, or a path to it in an installation of the package that is no longer there.
    """
    path = Path(text)
    places = (("surgisoft", "assets", PACKAGED.name), ("surgisoft", SCENES.name))
    if len(path.parts) > 1 and not any(path.parts[-1 - len(at) : -1] == at for at in places):
        return None
    files = [*PACKAGED.glob("*/config.json"), *SCENES.glob("*/scene.toml")]
    return {file.parent.name: file.parent for file in files}.get(path.name)


def _absolute(spec: Experiment, where: Where) -> Experiment:
    """The experiment with absolute paths; raises an InputError for one that does not exist."""

    def there(text: str, place: Where, what: str) -> str:
        try:
            return str(path_beside(place, text, what))
        except InputError:
            if (packaged := _packaged(text)) is None:
                raise
            return str(packaged)

    def of_case(i: int, case: Case) -> Case:
        place = where / "cases" / i
        policy, arm, scene = case.policy, case.arm, case.scene
        if policy not in (SCRIPTED, NOMINAL):
            policy = there(policy, place / "policy", "scripted, nominal, or a run's folder")
        if arm not in ("", "default"):
            arm = there(arm, place / "arm", "default, or an arm model's folder")
        if scene:
            scene = there(scene, place / "scene", "a scene's folder")
        return dataclasses.replace(case, policy=policy, arm=arm, scene=scene)

    def of_controller(i: int, own: ControllerSpec) -> ControllerSpec:
        if not own.schedule:
            return own
        place = where / "controllers" / i / "schedule"
        return dataclasses.replace(own, schedule=there(own.schedule, place, "a CSV file"))

    return dataclasses.replace(
        spec,
        scene=there(spec.scene, where / "scene", "a scene's folder") if spec.in_scene else "",
        cases=tuple(of_case(i, case) for i, case in enumerate(spec.cases)),
        controllers=tuple(of_controller(i, own) for i, own in enumerate(spec.controllers)),
    )


def _check_whole(spec: Experiment, where: Where) -> None:
    """Raise an InputError for fields that do not fit each other."""
    for name in ("phases", "cases", "lesions", "controllers"):
        _check_names(getattr(spec, name), where / name)
    for name in ("phases", "cases"):
        if not getattr(spec, name):
            raise (where / name).error("none is given", "at least one")
    if bool(spec.scene) != spec.in_scene:
        came = "missing" if spec.in_scene else f"got '{spec.scene}'"
        expected = "a scene's folder" if spec.in_scene else f"none: {spec.scenario} has no scene"
        raise (where / "scene").error(came, expected)
    if spec.lesions and spec.in_scene and not getattr(spec.task, "at_lesion", True):
        raise (where / "lesions").error(
            f"{spec.scenario} treats contours here", "contours in [task], or no contours there"
        )
    if spec.lesions and not spec.in_scene:
        raise (where / "lesions").error("got lesions", f"none: {spec.scenario} has no scene")
    defined = [own.name for own in spec.controllers]
    for i, own in enumerate(spec.controllers):
        place = where / "controllers" / i
        if own.name in CONTROLLERS:
            raise (place / "name").error(f"got '{own.name}'", f"none of {', '.join(CONTROLLERS)}")
        if bool(own.schedule) == bool(own.waypoints):
            raise place.error("got both or neither", "either a schedule or waypoints")
        times = [row[0] for row in own.waypoints]
        if times and (times[0] < 0.0 or sorted(set(times)) != times):
            raise (place / "waypoints").error(f"times {times}", "times that rise from 0 s")
    conditions = spec.of.experiment.conditions
    for i, phase in enumerate(spec.phases):
        if phase.until not in conditions:
            raise (where / "phases" / i / "until").error(
                f"got '{phase.until}'", f"one of {', '.join(conditions)}"
            )
        if phase.within > (most := conditions[phase.until].most):
            raise (where / "phases" / i / "within").error(
                f"got {phase.within:g}", f"at most {most:g}: {conditions[phase.until].about}"
            )
        if phase.name in TIMED:
            raise (where / "phases" / i / "name").error(
                f"got '{phase.name}'", f"another name: '{phase.name}_s' is a column of the results"
            )
        if phase.hold_s > phase.timeout_s:
            raise (where / "phases" / i / "hold_s").error(
                f"got {phase.hold_s:g} s", f"at most timeout_s, {phase.timeout_s:g} s"
            )
        for arm, controller in phase.arms:
            if controller not in (*CONTROLLERS, *defined):
                raise (where / "phases" / i / arm).error(
                    f"got '{controller}'", f"one of {', '.join((*CONTROLLERS, *defined))}"
                )
    for i, fault in enumerate(spec.faults):
        if fault.arm not in spec.of.agents:
            raise (where / "faults" / i / "arm").error(
                f"got '{fault.arm}'", f"one of {', '.join(spec.of.agents)}"
            )
    known = [phase.name for phase in spec.phases]
    if spec.limits.retreat not in ("", *known):
        raise (where / "limits" / "retreat").error(
            f"got '{spec.limits.retreat}'", f"one of the phases: {', '.join(known)}"
        )
    for i, case in enumerate(spec.cases):
        if case.scene and not spec.in_scene:
            raise (where / "cases" / i / "scene").error(
                f"got '{case.scene}'", f"none: {spec.scenario} has no scene"
            )
        given = [
            each
            for each in ("hidden", "robot_seed", "rigs", "preflight")
            if getattr(case, each) != getattr(Case, each)
        ]
        if case.plant != "rig" and given:
            raise (where / "cases" / i / given[0]).error(
                "given for a case in simulation", "it with plant = 'rig' only"
            )


def _check_names(items, where: Where) -> None:
    seen: set[str] = set()
    for i, item in enumerate(items):
        if item.name in seen:
            raise (where / i / "name").error(f"a second '{item.name}'", "names that differ")
        seen.add(item.name)
