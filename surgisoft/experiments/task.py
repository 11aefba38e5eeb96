"""What a task must offer for experiments: phases, an interlock and results.

`ExperimentTask` is the static part, one value for each task; `Supervision` supplements a task that
was built. `ablation.ABLATION` offers both for `circle_ablation`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from torch import Tensor

from surgisoft.tasks.base import Task, TaskState

Row = dict[str, Any]
"""One episode's results: name -> number or text; None where a number does not apply."""


@dataclass(frozen=True)
class Condition:
    """A condition under which an episode goes on to its next phase."""

    about: str
    """When the condition holds, with the unit of its threshold."""
    within: float
    """Default of the threshold."""
    holds: Callable[[Any, TaskState, float], Tensor]
    """(task, state, within) -> (B,) bool; the task as it was built, without phases."""


class Supervision(Protocol):
    """Access to a task that phases, limits and the interlock need; states are those of the task.

    Tensors have the batch in front.
    """

    task: Task
    """The task, in simulation or on rigs."""
    clearance_limit_mm: float
    """Limit of clearance of the scene, which no experiment can lower, mm."""

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


@dataclass(frozen=True)
class ExperimentTask:
    """What experiments need to know of a task before it is built."""

    name: str
    """The task's name in the registry."""
    config: type
    """Class of its configuration."""
    conditions: Mapping[str, Condition]
    """Every condition by the name that phases use."""
    build: Callable[..., Task]
    """Builds the task of a configuration in a scene that is already open."""
    supervise: Callable[..., Supervision]
    """Lays supervision over a built task."""
    numbers: Mapping[str, str]
    """Numbers of an episode in the report's main table -> their titles, in order."""
    per_episode: tuple[str, ...]
    """Numbers that the report draws for every episode."""
    swept: tuple[str, ...]
    """Numbers that the report draws over what varies."""
    badness: Callable[[Row], tuple]
    """Key that sorts episodes from good to bad."""
