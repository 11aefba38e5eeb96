"""What the task `circle_ablation` offers for experiments."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import torch
from torch import Tensor

from surgisoft.experiments.task import Condition, ExperimentTask, Row
from surgisoft.scene.camera import View
from surgisoft.scene.capsules import BatchClearance
from surgisoft.scene.folder import Scene
from surgisoft.tasks.base import TaskState
from surgisoft.tasks.circle_ablation import CircleAblation, CircleAblationConfig
from surgisoft.tasks.world.scene import SceneEngine


def _view(state: TaskState) -> View:
    view = state.world.scene.view
    assert view is not None, "a circle ablation has an endoscope"
    return view


def _clearance(state: TaskState) -> BatchClearance:
    clearance = state.world.scene.clearance
    assert clearance is not None, "a circle ablation has bodies"
    return clearance


class AblationSupervision:
    """`Supervision` of a circle ablation, in simulation or on rigs."""

    def __init__(self, task: CircleAblation):
        self.task, self.clearance_limit_mm = task, task.spec.limits.clearance_mm

    def in_sight(self, state: TaskState) -> Tensor:
        """(B,) bool: the endoscope sees as much of the ring as the scene requires."""
        return _view(state).fraction >= self.task.spec.limits.view_fraction

    def clearance_mm(self, state: TaskState) -> Tensor:
        """(B,) mm: least clearance to bodies and between arms."""
        return _clearance(state).least_mm

    def collides(self, state: TaskState) -> Tensor:
        """(B,) bool: an arm touches a body, the other arm or itself."""
        return _clearance(state).collides

    def fires(self, state: TaskState) -> Tensor:
        """(B,) bool: the task would switch its beam on, see `CircleAblation.fires`."""
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


def _centred(task: CircleAblation, state: TaskState, within: float) -> Tensor:
    view = _view(state)
    return (view.axis_error_mm <= within) & (view.fraction >= task.spec.limits.view_fraction)


def _aimed(task: CircleAblation, state: TaskState, within: float) -> Tensor:
    return task.measured_error_mm(state) <= within


def _cut(task: CircleAblation, state: TaskState, within: float) -> Tensor:
    dose = state.world.scene.dose
    assert dose is not None, "a circle ablation has a dose map"
    assert isinstance(task.scene, SceneEngine), "a circle ablation takes place in a scene"
    return task.scene.ablation.report(dose).completion >= within


def _retracted(task: CircleAblation, state: TaskState, within: float) -> Tensor:
    first = task.world.arms["laser"].first
    return (state.world.arms["laser"].seen_kPa - first).abs().amax(1) <= within


def _never(task: CircleAblation, state: TaskState, within: float) -> Tensor:
    return torch.zeros_like(state.world.failed)


def _built(config: CircleAblationConfig, scene: Scene) -> CircleAblation:
    """The task in an open scene; its configuration keeps the scene's folder."""
    task = CircleAblation(dataclasses.replace(config, scene=scene))
    task.config = config
    return task


def _badness(row: Row) -> tuple:
    """Success first, then the share that was cut, then the beam's error."""
    error = row.get("beam_error_mean_mm")
    return (1.0 - row["success"], 1.0 - row["completion"], error or 0.0)


ABLATION = ExperimentTask(
    name="circle_ablation",
    config=CircleAblationConfig,
    conditions={
        "centred": Condition("optical axis this near to the lesion (mm), in sight", 1.0, _centred),
        "aimed": Condition("beam's axis this near to its target (mm)", 0.5, _aimed),
        "cut": Condition("this share of the ring is cut (0..1)", 1.0, _cut),
        "retracted": Condition("laser arm's chambers this near to rest (kPa)", 1.0, _retracted),
        "never": Condition("only the time ends the phase", 0.0, _never),
    },
    build=_built,
    supervise=AblationSupervision,
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
    badness=_badness,
)
"""The ring cut of two arms, the only task that experiments are made with so far."""
