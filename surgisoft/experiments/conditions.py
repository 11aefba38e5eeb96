"""Conditions under which an episode goes on to its next phase."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from surgisoft.tasks.base import TaskState
from surgisoft.tasks.circle_ablation import CircleAblation


@dataclass(frozen=True)
class Condition:
    """One condition; `within` is its number."""

    about: str
    """When it holds, with the number's unit."""
    within: float
    """The number where a phase gives none."""
    holds: Callable[[CircleAblation, TaskState, float], Tensor]
    """(task, state, within) -> (B,) bool."""


def _centred(task: CircleAblation, state: TaskState, within: float) -> Tensor:
    view = state.world.scene.view
    return (view.axis_error_mm <= within) & (view.fraction >= task.spec.limits.view_fraction)


def _aimed(task: CircleAblation, state: TaskState, within: float) -> Tensor:
    return task.beam_error_mm(state) <= within


def _cut(task: CircleAblation, state: TaskState, within: float) -> Tensor:
    return task.scene.ablation.report(state.world.scene.dose).completion >= within


def _retracted(task: CircleAblation, state: TaskState, within: float) -> Tensor:
    first = task.world.arms["laser"].first
    return (state.world.arms["laser"].pressure - first).abs().amax(1) <= within


def _never(task: CircleAblation, state: TaskState, within: float) -> Tensor:
    return torch.zeros_like(state.world.failed)


CONDITIONS: dict[str, Condition] = {
    "centred": Condition("optical axis this near to the lesion (mm), in sight", 1.0, _centred),
    "aimed": Condition("beam's axis this near to its target (mm)", 0.5, _aimed),
    "cut": Condition("this share of the ring is cut (0..1)", 1.0, _cut),
    "retracted": Condition("laser arm's chambers this near to rest (kPa)", 1.0, _retracted),
    "never": Condition("only the time ends the phase", 0.0, _never),
}
"""Every condition by the name that phases use."""
