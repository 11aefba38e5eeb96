"""The interface of a task (`Task`) and the loop of its episodes (`Episodes`), batched."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.tasks.observations import OBSERVATION_LIMIT, ObservationBlocks
from surgisoft.tasks.world.pytree import TensorDataclass, rows, with_rows
from surgisoft.tasks.world.random_streams import Stream, streams
from surgisoft.tasks.world.scene import BatchClearance, SceneState
from surgisoft.tasks.world.world import World, WorldState
from surgisoft.threads import rows_on_threads

Goal = TypeVar("Goal", bound=TensorDataclass)
"""Type of a task's goal, the part of its state that is not the world: a dataclass of tensors."""
DONE, TIME_OUT = "done", "time out"
"""How episodes end that went to their end: as they should, or by their time."""


@dataclass(frozen=True, eq=False)
class TaskState(Generic[Goal]):
    """The state of B episodes of a task."""

    world: WorldState
    """State of the simulated world."""
    goal: Goal
    """Targets and progress of each episode: a dataclass that the task defines."""


class Task(Protocol):
    """A task: a simulated world, goals and rewards for its agents, and measures of success.

    All methods are functions of their arguments; tensors have the batch in front.
    """

    name: str
    """Name in the registry."""
    world: World
    """The simulated world."""
    agents: tuple[str, ...]
    """Names of the agents, which are arms of the world."""
    steps: int
    """Steps after which an episode is truncated."""

    def goal(self, stream: Stream) -> tuple[Stream, Any]:
        """Draw a new goal for each of the (B,) random number streams; returns (streams, goal)."""

    def advance(self, state: TaskState, actions: Mapping[str, Tensor]) -> TaskState:
        """Advance one step; actions: agent -> (B, m) changes of the commanded pressure, kPa."""

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        """Each agent's observation: agent -> (B, D), scaled to the order of 1."""

    def rewards(self, state: TaskState) -> dict[str, dict[str, Tensor]]:
        """Each agent's weighted reward terms for reaching this state: agent -> term -> (B,)."""

    def ended(self, state: TaskState) -> Tensor:
        """(B,) bool: the episode terminates here, by success or failure, before its time is out."""

    def measures(self, state: TaskState) -> dict[str, Tensor]:
        """Quantities for people: name with unit -> (B,); nan where one does not apply."""

    def trace(self, state: TaskState) -> tuple[Tensor, Tensor]:
        """Reference and actual points, (B, k, 3) mm each, world frame.

        Most tasks have one point; a task of the whole body has its key points, the tip last.
        """

    def script(self, state: TaskState) -> dict[str, Tensor]:
        """Action of the scripted expert, agent -> (B, m) kPa: privileged inverse kinematics."""


@dataclass(frozen=True)
class Signal:
    """A quantity that an exported controller has to be given beside pressures and key points."""

    name: str
    """Name, an input of the controller."""
    meaning: str
    """What is measured."""
    unit: str
    """Unit; `-` where it has none."""
    low: float
    """Lowest value."""
    high: float
    """Highest value."""
    true: Callable[[Any, TaskState | None, TaskState], Tensor] = field(repr=False, compare=False)
    """(task, before, after) -> (B,): the value after a simulated step; before: None at the start of
    an episode."""
    default: float | None = None
    """Value where none is given; None: it has to be given; nan: the controller's own estimate."""


FEED_SIGNAL = "out_mm"
"""Name of the signal that gives by how much the arms' bases are behind their mounts, mm."""


class MeasuredTask(Task, Protocol):
    """A task in a scene whose controller can be exported: what it needs of the scene is measured.

    Tasks in empty space need nothing else than their arms, and none of this. A task whose world has
    a feed has the signal `FEED_SIGNAL`.
    """

    signals: tuple[Signal, ...]
    """What has to be measured."""

    def measured_scene(self, signals: Mapping[str, Tensor], lesion: Tensor) -> SceneState:
        """The scene as far as observations need it, from signals name -> (B,)."""

    def advance_measured(self, state: TaskState, signals: Mapping[str, Tensor]) -> TaskState:
        """Advance one step after which the world is as measured, signals name -> (B,)."""


def clearance(state: TaskState) -> BatchClearance:
    """Clearances of all arms; of a task with bodies."""
    found = state.world.scene.clearance
    assert found is not None, "the task has bodies"
    return found


class DocumentedTask(Task, Protocol):
    """A task of the registry, with named observation blocks and reward weights."""

    weights: Mapping[str, Any]
    """agent -> frozen dataclass of floats: the weight of each reward term."""

    def blocks(self, state: TaskState) -> dict[str, ObservationBlocks]:
        """agent -> the named blocks of its observation, in order."""


class LoneEpisode(Protocol):
    """One episode of a task, advanced in arrays that are allocated once.

    A task may have a method `alone(state)` that gives one for the only environment of a state, or
    None where it can be advanced by the task alone. The numbers are the task's own, to rounding.
    """

    def step(self, actions: Mapping[str, np.ndarray]) -> None:
        """Advance one step; actions: agent -> (m,) changes of the commanded pressure, kPa."""

    @property
    def observations(self) -> dict[str, np.ndarray]:
        """Agent -> (D,) float32, see `Episodes.observe`; arrays that the caller may change."""

    @property
    def terms(self) -> dict[str, dict[str, float]]:
        """Agent -> weighted reward term, see `Outcome`."""

    @property
    def terminated(self) -> bool:
        """See `Outcome`."""

    @property
    def truncated(self) -> bool:
        """See `Outcome`."""

    @property
    def failed(self) -> bool:
        """Whether an arm is no longer finite."""

    @property
    def measures(self) -> dict[str, float]:
        """Quantities for people; nan where one does not apply."""

    @property
    def state(self) -> TaskState:
        """A copy of the present state."""


def term_names(weights: Any) -> list[str]:
    """Names of an agent's reward terms in the order in which they are added: that of the fields of
    its dataclass of weights, `contact` last, so that terms of a class that extends another one
    stand before it."""
    return sorted((f.name for f in fields(weights)), key=lambda name: name == "contact")


def weighted(terms: Mapping[str, Tensor], weights: Any) -> dict[str, Tensor]:
    """Each reward term (B,) times its weight; terms of weight 0 are left out."""
    factors = ((name, getattr(weights, name), value) for name, value in terms.items())
    return {name: weight * value for name, weight, value in factors if weight != 0.0}


def check_weights(task: str, weights: Any) -> None:
    """Raise InputError unless all weights are finite and at least one is not 0."""
    values = asdict(weights)
    for name, value in values.items():
        if not math.isfinite(value):
            raise InputError(f"{task}: weight of '{name}' is {value}, expected a finite number")
    if not any(values.values()):
        raise InputError(f"{task}: all reward weights are 0, expected at least one that is not")


@dataclass(frozen=True, eq=False)
class Outcome:
    """Result of a step: rewards, end of episode and measures of the state before any reset."""

    terms: dict[str, dict[str, Tensor]]
    """agent -> weighted reward term -> (B,); zero in an environment that failed."""
    terminated: Tensor
    """(B,) bool: the task ended the episode, or the environment failed."""
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
        """(B,) bool: terminated or truncated."""
        return self.terminated | self.truncated


def reward_terms(task: Task, state: TaskState) -> dict[str, dict[str, Tensor]]:
    """The task's rewards for reaching a state: agent -> term -> (B,), zero where an arm failed.

    Raises InputError for what is not of this form, which a user-defined `rewards` may return.
    """
    found: Any = task.rewards(state)
    name, failed = f"rewards of the task '{task.name}'", state.world.failed
    if not isinstance(found, Mapping) or found.keys() != set(task.agents):
        is_ = f"of {', '.join(map(str, found))}" if isinstance(found, Mapping) else _type(found)
        raise InputError(f"{name} are {is_}, expected a dict of {', '.join(task.agents)}")
    terms: dict[str, dict[str, Tensor]] = {agent: {} for agent in found}
    for agent, parts in found.items():
        if not isinstance(parts, Mapping) or not parts:
            raise InputError(
                f"{name} for '{agent}' are {_type(parts)}, expected a dict of at least one term by "
                "its name, each a tensor (B,)"
            )
        for term, value in parts.items():
            if not isinstance(value, Tensor) or value.shape != failed.shape:
                shape = f"of shape {tuple(value.shape)}" if isinstance(value, Tensor) else ""
                raise InputError(
                    f"{name}: term '{term}' of '{agent}' is {shape or _type(value)}, expected a "
                    f"tensor of shape {tuple(failed.shape)}, one value for each environment"
                )
            terms[agent][term] = value.masked_fill(failed, 0.0)
    return terms


def _type(value: Any) -> str:
    """Type of a value in words, of an empty dict that it is one."""
    empty = isinstance(value, Mapping) and not value
    return "an empty dict" if empty else f"of type {type(value).__name__}"


def check_finite(task: Task, terms: Mapping[str, Mapping[str, Tensor]]) -> None:
    """Raise InputError where a reward term is NaN or infinite, of which no policy can learn.

    On a GPU, whose results the caller does not wait for, nothing is checked.
    """
    if task.world.device.type != "cpu":
        return
    for agent, parts in terms.items():
        for term, value in parts.items():
            if bad := int((~value.isfinite()).sum()):
                raise InputError(
                    f"rewards of the task '{task.name}': term '{term}' of '{agent}' is NaN or "
                    f"infinite in {bad} of {len(value)} environments; correct this term"
                )


class Episodes:
    """The loop of a task's episodes: start, step, observe and reset. Holds no state.

    With `donate` the caller owns the only reference to each state: a step or reset then writes
    into the dose map of the state it is given instead of copying it, and that state is invalid
    afterwards. A step of 256 ablation episodes is 2.6 times as slow without.
    """

    def __init__(self, task: Task, donate: bool = False):
        self.task, self.donate = task, donate

    @rows_on_threads()
    def start(self, stream: Stream) -> TaskState:
        """Start an episode for each of the (B,) random number streams."""
        stream, goal = self.task.goal(stream)
        world = self.task.world.start(stream)
        return TaskState(world.donated() if self.donate else world, goal)

    def seeded(self, seed: int, count: int, first: int = 0) -> TaskState:
        """Start episodes number `first` to `first + count - 1` of a seed."""
        return self.start(streams(seed, count, first, self.task.world.device))

    @rows_on_threads()
    def reset(self, state: TaskState, mask: Tensor) -> TaskState:
        """Start new episodes where mask (B,) is set, each with its random number stream."""
        index = mask.nonzero()[:, 0]
        if not len(index):
            return state
        stream, goal = self.task.goal(rows(state.world.stream, index))
        world = replace(state.world, stream=with_rows(state.world.stream, index, stream))
        return TaskState(self.task.world.reset(world, mask), with_rows(state.goal, index, goal))

    @rows_on_threads()
    def step(self, state: TaskState, actions: Mapping[str, Tensor]) -> tuple[TaskState, Outcome]:
        """Advance every episode one step; none is reset."""
        task = self.task
        state = task.advance(state, actions)
        failed = state.world.failed
        terms = reward_terms(task, state)
        terminated = task.ended(state) | failed
        truncated = (state.world.steps >= task.steps) & ~terminated
        return state, Outcome(terms, terminated, truncated, task.measures(state))

    def observe_anew(
        self, state: TaskState, index: Tensor, seen: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Observations as `observe` gives them, where only episodes index (R,) int64 are not those
        in which `seen` was observed."""
        fresh = self.observe(rows(state, index))
        return {agent: old.index_copy(0, index, fresh[agent]) for agent, old in seen.items()}

    @rows_on_threads()
    def observe(self, state: TaskState) -> dict[str, Tensor]:
        """Clipped observations, agent -> (B, D): finite; zero where the environment failed."""
        failed = state.world.failed[:, None]
        return {
            agent: seen.masked_fill(failed, 0.0).clamp(-OBSERVATION_LIMIT, OBSERVATION_LIMIT)
            for agent, seen in self.task.observe(state).items()
        }
