"""The interface of a task (`Task`) and the loop of its episodes (`Episodes`), batched."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Generic, Protocol, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from surgisoft.errors import AssumptionWarning, InputError
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
    _check_agents(f"{name} are", task, found)
    terms: dict[str, dict[str, Tensor]] = {agent: {} for agent in found}
    for agent, parts in found.items():
        if not isinstance(parts, Mapping) or not parts:
            raise InputError(
                f"{name} for '{agent}' are {_type(parts)}, expected a dict of at least one term by "
                "its name, each a tensor (B,)"
            )
        for term, value in parts.items():
            _check_values(f"{name}: term '{term}' of '{agent}' is", value, len(failed))
            terms[agent][term] = value.masked_fill(failed, 0.0)
    return terms


def goal_of(task: Task, stream: Stream) -> tuple[Stream, Any]:
    """The task's goals for (B,) random number streams, and the advanced streams.

    Raises InputError for what is no such pair, which a user-defined `goal` may return.
    """
    found: Any = task.goal(stream)
    pair = isinstance(found, tuple | list) and len(found) == 2
    if not (pair and isinstance(found[0], Stream) and len(found[0].key) == len(stream.key)):
        raise InputError(
            f"goal of the task '{task.name}' is {_type(found)}, expected a pair: the "
            f"{len(stream.key)} random number streams after the draws, and the goals"
        )
    return found[0], found[1]


def advanced(task: Task, state: TaskState, actions: Mapping[str, Tensor]) -> TaskState:
    """The state after a step of the task; raises InputError where it returns no state."""
    found: Any = task.advance(state, actions)
    if not isinstance(found, TaskState):
        raise InputError(
            f"advance of the task '{task.name}' is {_type(found)}, expected a TaskState"
        )
    return found


def check_ended(task: Task, ended: Any, count: int) -> None:
    """Raise InputError unless what a task's `ended` returned is (B,) bool, B = count."""
    name = f"ended of the task '{task.name}'"
    _check_values(f"{name} is", ended, count, "a bool tensor")
    if ended.dtype != torch.bool:
        raise InputError(f"{name} is of type {ended.dtype}, expected torch.bool")


def check_measures(task: Task, measures: Any, count: int) -> None:
    """Raise InputError unless what a task's `measures` returned is name -> (B,), B = count."""
    name = f"measures of the task '{task.name}'"
    if not isinstance(measures, Mapping):
        raise InputError(f"{name} are {_type(measures)}, expected a dict of tensors (B,) by name")
    for measure, value in measures.items():
        _check_values(f"{name}: '{measure}' is", value, count)


def check_observations(task: Task, seen: Any, count: int) -> None:
    """Raise InputError unless what a task's `observe` returned is agent -> (B, D), B = count."""
    name = f"observe of the task '{task.name}'"
    _check_agents(f"{name} is", task, seen)
    for agent, value in seen.items():
        if not isinstance(value, Tensor) or value.ndim != 2 or len(value) != count:
            raise InputError(
                f"{name}: the observation of '{agent}' is {_shape(value)}, expected a tensor of "
                f"shape ({count}, D), one row for each environment"
            )
        if value.dtype != torch.float32:
            raise InputError(
                f"{name}: the observation of '{agent}' is of type {value.dtype}, expected "
                "torch.float32"
            )


def warn_of_width(task: Task, state: TaskState, seen: Mapping[str, Tensor]) -> None:
    """Warn (`AssumptionWarning`) of a class that overrides `observe` but not `blocks`, where the
    blocks have another number of columns than the observations agent -> (B, D)."""
    places = {each: _defined_in(type(task), each) for each in ("observe", "blocks")}
    if not places["observe"] < places["blocks"] < len(type(task).__mro__):
        return
    for agent, blocks in cast(DocumentedTask, task).blocks(state).items():
        width = sum(block.shape[1] for block in blocks.values())
        if agent in seen and seen[agent].shape[1] != width:
            warnings.warn(
                f"observe of the task '{task.name}': the observation of '{agent}' has "
                f"{seen[agent].shape[1]} columns, its blocks have {width}; policies see the "
                "former: override blocks, of which observe is made, to change both",
                AssumptionWarning,
                stacklevel=2,
            )


def _defined_in(kind: type, method: str) -> int:
    """Number of the class, in the order of search, that defines a method; their count if none."""
    order = kind.__mro__
    return next((n for n, each in enumerate(order) if method in vars(each)), len(order))


def trace_of(task: Task, state: TaskState) -> tuple[Tensor, Tensor]:
    """The task's reference and actual points, see `Task.trace`.

    Raises InputError for what is not of this form, which a user-defined `trace` may return.
    """
    found: Any = task.trace(state)
    name, count = f"trace of the task '{task.name}'", len(state.world.failed)
    pair = isinstance(found, tuple | list) and len(found) == 2
    for points in found if pair else (found,):
        fits = isinstance(points, Tensor) and points.ndim == 3 and points.shape[::2] == (count, 3)
        if not (pair and fits and points.shape == found[0].shape):
            raise InputError(
                f"{name} is {_shape(points)}, expected two tensors of the same shape "
                f"({count}, k, 3): reference and actual points, mm"
            )
    return tuple(found)


def _check_agents(is_: str, task: Task, found: Any) -> None:
    """Raise InputError unless something is a dict of all agents of a task; is_: `rewards are`."""
    if isinstance(found, Mapping) and found.keys() == set(task.agents):
        return
    given = f"of {', '.join(map(str, found))}" if isinstance(found, Mapping) and found else ""
    raise InputError(f"{is_} {given or _type(found)}, expected a dict of {', '.join(task.agents)}")


def _check_values(is_: str, value: Any, count: int, kind: str = "a tensor") -> None:
    """Raise InputError unless something is a tensor (B,), B = count; is_: such as `ended is`."""
    if not isinstance(value, Tensor) or value.shape != (count,):
        raise InputError(
            f"{is_} {_shape(value)}, expected {kind} of shape ({count},), one value for each "
            "environment"
        )


def _shape(value: Any) -> str:
    """Shape of a tensor in words, of another value its type."""
    return f"of shape {tuple(value.shape)}" if isinstance(value, Tensor) else _type(value)


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


def check_seen(task: Task, seen: Mapping[str, Tensor]) -> None:
    """Raise InputError where an observation, agent -> (B, D), is NaN: its policy would be too.

    On a GPU nothing is checked, as by `check_finite`.
    """
    if task.world.device.type != "cpu":
        return
    for agent, value in seen.items():
        if value.sum().isnan():  # clipped numbers have a finite sum; to look at each takes longer
            bad = int(value.isnan().any(1).sum())
            raise InputError(
                f"observe of the task '{task.name}': the observation of '{agent}' is NaN in {bad} "
                f"of {len(value)} environments; correct this method"
            )


class Episodes:
    """The loop of a task's episodes: start, step, observe and reset. Holds no state.

    What the task's methods return is checked once for each number of episodes side by side.

    With `donate` the caller owns the only reference to each state: a step or reset then writes
    into the dose map of the state it is given instead of copying it, and that state is invalid
    afterwards. A step of 256 ablation episodes is 2.6 times as slow without.
    """

    def __init__(self, task: Task, donate: bool = False):
        self.task, self.donate = task, donate
        self._stepped: set[int] = set()
        """Numbers of episodes side by side for which the outcome of a step is checked."""
        self._observed: set[int] = set()
        """The same for the observations."""

    @rows_on_threads()
    def start(self, stream: Stream) -> TaskState:
        """Start an episode for each of the (B,) random number streams."""
        stream, goal = goal_of(self.task, stream)
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
        stream, goal = goal_of(self.task, rows(state.world.stream, index))
        world = replace(state.world, stream=with_rows(state.world.stream, index, stream))
        return TaskState(self.task.world.reset(world, mask), with_rows(state.goal, index, goal))

    @rows_on_threads()
    def step(self, state: TaskState, actions: Mapping[str, Tensor]) -> tuple[TaskState, Outcome]:
        """Advance every episode one step; none is reset."""
        task = self.task
        state = advanced(task, state, actions)
        failed = state.world.failed
        terms = reward_terms(task, state)
        ended, measures = task.ended(state), task.measures(state)
        if (count := len(failed)) not in self._stepped:
            check_ended(task, ended, count)
            check_measures(task, measures, count)
            self._stepped.add(count)
        terminated = ended | failed
        truncated = (state.world.steps >= task.steps) & ~terminated
        return state, Outcome(terms, terminated, truncated, measures)

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
        failed, found = state.world.failed[:, None], self.task.observe(state)
        if (count := len(failed)) not in self._observed:
            check_observations(self.task, found, count)
            if not self._observed:
                warn_of_width(self.task, state, found)
            self._observed.add(count)
        return {
            agent: seen.masked_fill(failed, 0.0).clamp(-OBSERVATION_LIMIT, OBSERVATION_LIMIT)
            for agent, seen in found.items()
        }
