"""The interface of a policy, which chooses the actions of all agents, and untrained policies."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from torch import Tensor

from surgisoft.errors import InputError, unknown_name
from surgisoft.tasks.base import Task, TaskState
from surgisoft.tasks.world.random_streams import Stream, streams


class Policy(Protocol):
    """Chooses actions for a batch of episodes.

    A function of its arguments: the actions of one episode depend neither on the other episodes of
    the batch nor on earlier calls. A policy that reads `state` is privileged: it knows the truth.
    """

    def act(
        self, task: Task, state: TaskState, observations: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """Actions, agent -> (B, m) changes of pressure, kPa; observations: agent -> (B, D)."""


@dataclass(frozen=True)
class Scripted:
    """The task's scripted expert: privileged inverse kinematics on the true state."""

    def act(
        self, task: Task, state: TaskState, observations: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """The expert's actions, see `Policy.act`."""
        return task.script(state)


@dataclass(frozen=True)
class Random:
    """Uniform random changes of pressure within the limits of the pumps: the lower baseline."""

    seed: int = 0
    """Seed of the actions, independent of that of the episodes."""

    def act(
        self, task: Task, state: TaskState, observations: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """Actions drawn from an episode's random number stream, its step and the seed."""
        world, seeded = state.world, streams(self.seed, 1, device=state.world.steps.device)
        arms = [task.world.arms[agent] for agent in task.agents]
        each = sum(arm.chambers for arm in arms)
        _, draw = Stream(world.stream.key ^ seeded.key, world.steps * each).uniform(-1.0, 1.0, each)
        parts = draw.split([arm.chambers for arm in arms], 1)
        return {
            agent: arm.pneumatics.step_kPa * part
            for agent, arm, part in zip(task.agents, arms, parts, strict=True)
        }


POLICIES: dict[str, Callable[[], Policy]] = {"scripted": Scripted, "random": Random}
"""Policies that need no training, by name."""


def open_policy(name: str, task: Task) -> Policy:
    """A policy by name, or the trained one of a run's folder, which must fit the task."""
    check_policy(name)
    if name in POLICIES:
        return POLICIES[name]()
    from surgisoft.agents.learned import LearnedPolicy

    return LearnedPolicy(Path(name), task)


def check_policy(name: str) -> None:
    """Raise InputError unless the name is that of a policy or a path that exists."""
    from surgisoft.agents.run_folder import packaged_runs, run_path

    if name in POLICIES or run_path(name).exists():
        return
    if Path(name).name == name:
        known = [*POLICIES, *packaged_runs(), "the folder of a training run"]
        raise unknown_name("policy", name, known)
    raise InputError(f"{name}: no such folder; expected a training run, scripted or random")
