"""What a task offers to experiments: conditions of phases, the interlock, the report's numbers.

`ExperimentTask` is the static part, one value for each task in its `TaskSpec`; `Supervision`
supplements a task that was built. `BEAMLESS` serves every task without a beam;
`laser_supervision` serves those with one.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.tasks.base import DONE, TIME_OUT, Task, TaskState
from surgisoft.tasks.inverse_kinematics import Pointing

MEAN_MM = "_mean_mm"
"""End of the name of an episode's mean error."""
Row = dict[str, Any]
"""One episode's results: name -> number or text; None where a number does not apply."""


MAIN_ERRORS = {
    "tissue_error": "error on the tissue",
    "beam_error": "beam error",
    "error": "error",
}
"""Errors of which one sentence states the first that a task measures -> their titles. The error on
the tissue is that of the burn; beside it the beam's is only that of where it has to point.
"""


def main_error(names: Iterable[str]) -> tuple[str, str] | None:
    """(name, title) of the error that sums an episode up, among the names of its numbers.

    The name is without `_mean_mm`. Of a task that measures none of `MAIN_ERRORS` the first one.
    """
    found = [n.removesuffix(MEAN_MM) for n in names if n.endswith(f"error{MEAN_MM}")]
    name = next((known for known in MAIN_ERRORS if known in found), next(iter(found), None))
    return None if name is None else (name, MAIN_ERRORS.get(name, name.replace("_", " ")))


@dataclass(frozen=True)
class Condition:
    """A condition under which an episode goes on to its next phase."""

    about: str
    """When the condition holds, with the unit of its threshold."""
    within: float
    """Default of the threshold."""
    holds: Callable[[Any, TaskState, float], Tensor]
    """(task, state, within) -> (B,) bool; the task as it was built, without phases."""
    most: float = math.inf
    """Largest threshold that makes sense, in its unit: 1 for a share."""
    scenes: str = ""
    """Limit of the scene that holds in place of a threshold of 0; empty: 0 is 0."""


class Supervision(Protocol):
    """Access to a task that phases, limits and the interlock need; states are those of the task.

    Tensors have the batch in front.
    """

    clearance_limit_mm: float
    """Limit of clearance of the scene, which no experiment can lower, mm."""

    @property
    def task(self) -> Task:
        """The task, in simulation or on rigs."""

    def in_sight(self, state: TaskState) -> Tensor:
        """(B,) bool: the target is seen well enough to work on it."""

    def clearance_mm(self, state: TaskState) -> Tensor:
        """(B,) mm: least clearance to bodies and between arms."""

    def collides(self, state: TaskState) -> Tensor:
        """(B,) bool: an arm touches a body, another arm or itself."""

    def fires(self, state: TaskState) -> Tensor:
        """(B,) bool: the task would switch its beam on."""

    def fired(self, state: TaskState) -> Tensor:
        """(B,) bool: the beam was on in the step that led here."""

    def advance(self, state: TaskState, actions: Mapping[str, Tensor], fired: Tensor) -> TaskState:
        """Advance one step; the beam is on where `fired` (B,) bool is set."""

    def action_through(self, agent: str, state: TaskState, target_mm: Tensor) -> Tensor:
        """(B, m) kPa: the action that points an arm's axis through targets (B, 3) mm, world."""


class BeamlessSupervision:
    """`Supervision` of a task without beam and camera, in simulation or on rigs.

    Nothing has to be seen, and the beam is off. Without bodies the clearance is infinite.
    """

    def __init__(self, task: Task):
        self.task = task
        self.clearance_limit_mm = getattr(task.world.scene, "clearance_mm", 0.0)

    def in_sight(self, state: TaskState) -> Tensor:
        """(B,) bool: always."""
        return torch.ones_like(state.world.failed)

    def clearance_mm(self, state: TaskState) -> Tensor:
        """(B,) mm: least clearance to bodies and between arms."""
        found = state.world.scene.clearance
        if found is None:
            return torch.full_like(state.world.steps, torch.inf, dtype=torch.float32)
        return found.least_mm

    def collides(self, state: TaskState) -> Tensor:
        """(B,) bool: an arm touches a body, another arm or itself."""
        found = state.world.scene.clearance
        return torch.zeros_like(state.world.failed) if found is None else found.collides

    def fires(self, state: TaskState) -> Tensor:
        """(B,) bool: never."""
        return torch.zeros_like(state.world.failed)

    def fired(self, state: TaskState) -> Tensor:
        """(B,) bool: never."""
        return torch.zeros_like(state.world.failed)

    def advance(self, state: TaskState, actions: Mapping[str, Tensor], fired: Tensor) -> TaskState:
        """Advance one step."""
        return self.task.advance(state, actions)

    def action_through(self, agent: str, state: TaskState, target_mm: Tensor) -> Tensor:
        """(B, m) kPa: inverse kinematics of the arm's axis through targets (B, 3) mm."""
        world = self.task.world
        pointing = Pointing(world.arms[agent], world.config.dt_s)
        return pointing.action(state.world.arms[agent], target_mm)


def _never(task: Task, state: TaskState, within: float) -> Tensor:
    return torch.zeros_like(state.world.failed)


def _succeeded(task: Task, state: TaskState, within: float) -> Tensor:
    values = task.measures(state)
    if "success" not in values:
        raise InputError(
            f"until = 'succeeded': {task.name} has no measure of success, expected another "
            "condition, such as 'never'"
        )
    return values["success"] >= within


def _at_rest(task: Task, state: TaskState, within: float) -> Tensor:
    off = [
        (part.seen_kPa - task.world.arms[name].first).abs().amax(1)
        for name, part in state.world.arms.items()
    ]
    return torch.stack(off).amax(0) <= within


NEVER = Condition("only the time ends the phase", 0.0, _never)
"""Condition of a phase that its time ends, the default of every task."""
AT_REST = Condition("chambers of all arms this near to rest (kPa)", 1.0, _at_rest)
"""Condition of a phase in which every arm goes back."""
SUCCEEDED = Condition("the task's measure of success is at least this (0..1)", 1.0, _succeeded, 1.0)
"""Condition of the phase in which the task is done."""


def _unsuccessful(row: Row) -> tuple:
    """Success first, or without such a measure the end in time; then the mean error where there is
    one."""
    errors = [value for name, value in row.items() if name.endswith("error_mean_mm")]
    well = row["success"] if "success" in row else ended_well(row)
    return (1.0 - well, *(error or 0.0 for error in errors))


def ended_well(row: Row) -> bool:
    """Whether an episode went to its end: no abort, no contact, all arms finite."""
    return row["outcome"].startswith((DONE, TIME_OUT))


@dataclass(frozen=True)
class ExperimentTask:
    """Properties of a task that experiments need before it is built."""

    conditions: Mapping[str, Condition] = field(
        default_factory=lambda: {"succeeded": SUCCEEDED, "at rest": AT_REST, "never": NEVER}
    )
    """Every condition by the name that phases use; `never` among them."""
    supervise: Callable[..., Supervision] = BeamlessSupervision
    """Lays supervision over a built task."""
    numbers: Mapping[str, str] = field(
        default_factory=lambda: {
            "success": "success",
            "error_mean_mm": "error, mean [mm]",
            "error_p95_mm": "error, 95 % [mm]",
            "visited": "share of the targets visited",
            "clearance_mm": "least clearance [mm]",
            "time_s": "time [s]",
        }
    )
    """Numbers of an episode in the report's main table -> their titles, in order."""
    per_episode: tuple[str, ...] = ("error_mean_mm", "clearance_mm", "time_s")
    """Numbers that the report draws for every episode."""
    swept: tuple[str, ...] = ("success", "error_mean_mm")
    """Numbers that the report draws over what varies."""
    badness: Callable[[Row], tuple] = _unsuccessful
    """Key that sorts episodes from good to bad."""
    how: str = ""
    """How to read the task's numbers, in sentences for the report."""


BEAMLESS = ExperimentTask()
"""Experiments of a task without a beam."""
WITHOUT_SUCCESS = ExperimentTask(conditions={"at rest": AT_REST, "never": NEVER})
"""Experiments of a task that has no measure of success either."""
