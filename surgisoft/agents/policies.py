"""Drivers: whatever chooses the actions of all agents of a task."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from torch import Tensor

from surgisoft.errors import InputError, unknown_name
from surgisoft.tasks.base import Task, TaskState
from surgisoft.tasks.world.random_streams import Stream, streams


class Driver(Protocol):
    """Chooses actions for a batch of episodes.

    A function of its arguments: what it chooses for one episode does not depend on the others in
    the batch, nor on what was asked before.
    """

    def act(
        self, task: Task, state: TaskState, observations: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """Agent -> (B, m) changes of pressure, kPa; observations: agent -> (B, D)."""


@dataclass(frozen=True)
class Scripted:
    """The task's own solver, which knows the true state."""

    def act(
        self, task: Task, state: TaskState, observations: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """As for `Driver`."""
        return task.script(state)


@dataclass(frozen=True)
class Random:
    """Changes of pressure drawn evenly from all that the pumps allow: what no skill is worth."""

    seed: int = 0
    """Another seed gives other actions in the same episodes."""

    def act(
        self, task: Task, state: TaskState, observations: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """As for `Driver`; an episode's actions follow from its stream, its step and the seed."""
        world, own = state.world, streams(self.seed, 1, device=state.world.steps.device)
        arms = [task.world.arms[agent] for agent in task.agents]
        each = sum(arm.chambers for arm in arms)
        _, draw = Stream(world.stream.key ^ own.key, world.steps * each).uniform(-1.0, 1.0, each)
        parts = draw.split([arm.chambers for arm in arms], 1)
        return {
            agent: arm.pneumatics.step_kPa * part
            for agent, arm, part in zip(task.agents, arms, parts, strict=True)
        }


DRIVERS: dict[str, Callable[[], Driver]] = {"scripted": Scripted, "random": Random}
"""Drivers that need no training, by name."""


def open_driver(name: str, task: Task) -> Driver:
    """A driver by name, or the policy of a training run's folder, which must fit the task."""
    check_driver(name)
    if name in DRIVERS:
        return DRIVERS[name]()
    from surgisoft.agents.learned import LearnedPolicy

    return LearnedPolicy(Path(name), task)


def check_driver(name: str) -> None:
    """Raise unless that is a driver's name or something on disk."""
    if name in DRIVERS or Path(name).exists():
        return
    if Path(name).name == name:
        raise unknown_name("driver", name, [*DRIVERS, "the folder of a training run"])
    raise InputError(f"{name}: no such folder; expected a training run, scripted or random")
