"""What a task is, and the one way its episodes run; everything batched, state in, state out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch
from torch import Tensor

from surgisoft.tasks.world.pytree import rows, with_rows
from surgisoft.tasks.world.random import Stream, streams
from surgisoft.tasks.world.world import World, WorldState

OBSERVATION_LIMIT = 20.0
"""Observations are held to plus and minus this; tasks scale theirs to be far below it."""


@dataclass(frozen=True, eq=False)
class TaskState:
    """A batch of episodes at one instant."""

    world: WorldState
    """The world."""
    goal: Any
    """What this episode asks for: a frozen dataclass of tensors, the task's own."""


class Task(Protocol):
    """A task: a world, what is asked in it, and how well it is done.

    All methods are functions of their arguments; tensors have the batch in front.
    """

    name: str
    """Name in the registry."""
    world: World
    """The world it is played in."""
    agents: tuple[str, ...]
    """Who acts: names of arms of the world."""
    steps: int
    """Steps until an episode's time is out."""

    def goal(self, stream: Stream) -> tuple[Stream, Any]:
        """A fresh goal for each of the (B,) streams, and the streams further on."""

    def advance(self, state: TaskState, actions: Mapping[str, Tensor], in_place: bool) -> TaskState:
        """One step of the world: agent -> (B, m) changes of pressure, kPa."""

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        """What each agent measures: agent -> (B, D) without unit, of the order of 1."""

    def rewards(self, state: TaskState) -> dict[str, dict[str, Tensor]]:
        """Each agent's reward for having come to this state: agent -> term -> (B,)."""

    def ended(self, state: TaskState) -> Tensor:
        """(B,) bool: the episode ends here, for good or bad, before its time is out."""

    def measures(self, state: TaskState) -> dict[str, Tensor]:
        """What a person wants to know: name with unit -> (B,); nan where it does not apply."""

    def trace(self, state: TaskState) -> tuple[Tensor, Tensor]:
        """(B, k, 3) mm twice, world frame: where the task's points should be, and where they are.

        Most tasks have one point; a task of the whole body has its key points, the tip last.
        """

    def script(self, state: TaskState) -> dict[str, Tensor]:
        """The scripted solver's actions: agent -> (B, m) kPa. It knows the true state."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """What a step brings; it belongs to the state it came to, before any reset."""

    terms: dict[str, dict[str, Tensor]]
    """agent -> reward term -> (B,); zero in an environment that failed."""
    terminated: Tensor
    """(B,) bool: the task says it is over, or the environment failed."""
    truncated: Tensor
    """(B,) bool: the time is out."""
    measures: dict[str, Tensor]
    """name -> (B,), see `Task.measures`."""

    @property
    def rewards(self) -> dict[str, Tensor]:
        """agent -> (B,): the sum of its terms."""
        return {agent: torch.stack([*terms.values()]).sum(0) for agent, terms in self.terms.items()}

    @property
    def done(self) -> Tensor:
        """(B,) bool: over, one way or the other."""
        return self.terminated | self.truncated


class Episodes:
    """Episodes of any task; holds no state."""

    def __init__(self, task: Task):
        self.task = task

    def start(self, stream: Stream) -> TaskState:
        """Fresh episodes, one for each of the (B,) streams."""
        stream, goal = self.task.goal(stream)
        return TaskState(self.task.world.start(stream), goal)

    def seeded(self, seed: int, count: int, first: int = 0) -> TaskState:
        """Fresh episodes number `first` to `first + count - 1` of a seed."""
        return self.start(streams(seed, count, first, self.task.world.device))

    def reset(self, state: TaskState, mask: Tensor, in_place: bool = False) -> TaskState:
        """Fresh episodes where mask (B,) is set; out of place but for the dose with in_place."""
        index = mask.nonzero()[:, 0]
        if not len(index):
            return state
        stream, goal = self.task.goal(rows(state.world.stream, index))
        world = replace(state.world, stream=with_rows(state.world.stream, index, stream))
        world = self.task.world.reset(world, mask, in_place)
        return TaskState(world, with_rows(state.goal, index, goal))

    def step(
        self, state: TaskState, actions: Mapping[str, Tensor], in_place: bool = False
    ) -> tuple[TaskState, Outcome]:
        """One step of every episode, none of which is reset."""
        task = self.task
        state = task.advance(state, actions, in_place)
        failed = state.world.failed
        terms = {
            agent: {name: value.masked_fill(failed, 0.0) for name, value in parts.items()}
            for agent, parts in task.rewards(state).items()
        }
        terminated = task.ended(state) | failed
        truncated = (state.world.steps >= task.steps) & ~terminated
        return state, Outcome(terms, terminated, truncated, task.measures(state))

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        """agent -> (B, D), finite, within OBSERVATION_LIMIT; zero where the environment failed."""
        failed = state.world.failed[:, None]
        return {
            agent: seen.masked_fill(failed, 0.0).clamp(-OBSERVATION_LIMIT, OBSERVATION_LIMIT)
            for agent, seen in self.task.observe(state).items()
        }
