"""What a task with a laser and an endoscope offers to experiments: interlock and numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from surgisoft.tasks.base import TaskState, clearance
from surgisoft.tasks.laser_work import LaserTask, view
from surgisoft.tasks.supervision import (
    MEAN_MM,
    NEVER,
    Condition,
    ExperimentTask,
    Row,
    main_error,
)


class LaserSupervision:
    """`Supervision` of a task with a laser and an endoscope, in simulation or on rigs."""

    def __init__(self, task: LaserTask):
        self.task, self.clearance_limit_mm = task, task.spec.limits.clearance_mm

    def in_sight(self, state: TaskState) -> Tensor:
        """(B,) bool: the endoscope sees as much of the target as the scene requires."""
        return view(state).fraction >= self.task.spec.limits.view_fraction

    def clearance_mm(self, state: TaskState) -> Tensor:
        """(B,) mm: least clearance to bodies and between arms."""
        return clearance(state).least_mm

    def collides(self, state: TaskState) -> Tensor:
        """(B,) bool: an arm touches a body, the other arm or itself."""
        return clearance(state).collides

    def fires(self, state: TaskState) -> Tensor:
        """(B,) bool: the task would switch its beam on, see `LaserTask.fires`."""
        return self.task.fires(state)

    def fired(self, state: TaskState) -> Tensor:
        """(B,) bool: the beam was on in the step that led here."""
        return state.goal.fired

    def advance(self, state: TaskState, actions: Mapping[str, Tensor], fired: Tensor) -> TaskState:
        """Advance one step; the beam burns where `fired` (B,) bool is set."""
        return self.task.advance(state, actions, fired)

    def action_through(self, agent: str, state: TaskState, target_mm: Tensor) -> Tensor:
        """(B, m) kPa: inverse kinematics of the arm's axis through targets (B, 3) mm."""
        return self.task.pointing[agent].action(state.world.arms[agent], target_mm)


def _centred(task: LaserTask, state: TaskState, within: float) -> Tensor:
    found = view(state)
    return (found.axis_error_mm <= within) & (found.fraction >= task.spec.limits.view_fraction)


def _seen(task: LaserTask, state: TaskState, within: float) -> Tensor:
    return view(state).fraction >= max(within, task.spec.limits.view_fraction)


def _aimed(task: LaserTask, state: TaskState, within: float) -> Tensor:
    return task.measured_error_mm(state) <= within


def completed(task: LaserTask, state: TaskState, within: float) -> Tensor:
    """(B,) bool: the measure `completion` is at least `within`."""
    return task.measures(state)["completion"] >= within


def _retracted(task: LaserTask, state: TaskState, within: float) -> Tensor:
    """Every arm but the endoscope's is near the pressures of its start."""
    off = [
        (part.seen_kPa - task.world.arms[name].first).abs().amax(1)
        for name, part in state.world.arms.items()
        if not name.startswith("endoscope")
    ]
    return torch.stack(off).amax(0) <= within


def _incomplete(row: Row) -> tuple:
    """Success first, then the share that was completed, then the error of the beam."""
    found, share = main_error(row), row.get("completion")
    error = None if found is None else row[found[0] + MEAN_MM]
    return (1.0 - row["success"], 1.0 - (share or 0.0), error or 0.0)


HOW = (
    "The beam's error is the distance of its axis from its target while it is on.\n\n"
    "Interlock: the beam is off in every step that begins with the target out of sight, with a "
    "clearance below the limit, or after an abort. A step that becomes unsafe while it runs is "
    "stopped at its end; the last number of the table is the longest time of such steps in a row."
)
"""How to read a report of a task with a laser."""

LASER_EXPERIMENT = ExperimentTask(
    conditions={
        "centred": Condition("optical axis this near to the lesion (mm), in sight", 1.0, _centred),
        "seen": Condition(
            "this share of what is to be seen is seen (0..1)",
            0.0,
            _seen,
            1.0,
            "view_fraction of the scene",
        ),
        "aimed": Condition("beam's axis this near to its target (mm)", 0.5, _aimed),
        "cut": Condition("this share of the ring is cut (0..1)", 1.0, completed, 1.0),
        "retracted": Condition("laser arm's chambers this near to rest (kPa)", 1.0, _retracted),
        "never": NEVER,
    },
    supervise=LaserSupervision,
    numbers={
        "success": "success",
        "completion": "share cut",
        "beam_error_mean_mm": "beam error, mean [mm]",
        "beam_error_p95_mm": "beam error, 95 % [mm]",
        "healthy_mm2": "healthy tissue [mm2]",
        "in_view": "time in sight",
        "clearance_mm": "least clearance [mm]",
        "time_s": "time [s]",
        "beam_s": "beam on [s]",
        "beam_unsafe_longest_s": "beam on while unsafe, longest [s]",
    },
    per_episode=("completion", "beam_error_mean_mm", "clearance_mm", "time_s"),
    swept=("success", "completion", "beam_error_mean_mm", "in_view"),
    badness=_incomplete,
    how=HOW,
)
"""Experiments of a cut along a ring or another path."""


def laser_experiment(
    completion: str, conditions: Mapping[str, Condition], numbers: Mapping[str, str]
) -> ExperimentTask:
    """Experiments of a task with a laser that has more to offer than those of a cut.

    completion: title of the measure `completion`. conditions: further ones by name. numbers:
    further numbers of the main table -> their titles, after the completion.
    """
    plain = LASER_EXPERIMENT
    first = {"success": "success", "completion": completion, **numbers}
    errors = tuple(name for name in numbers if name.endswith(f"error{MEAN_MM}"))
    return replace(
        plain,
        per_episode=(plain.per_episode[0], *errors, *plain.per_episode[1:]),
        swept=(*plain.swept[:2], *errors, *plain.swept[2:]),
        conditions={**conditions, **plain.conditions},
        numbers=first | {k: v for k, v in plain.numbers.items() if k not in first},
    )
