"""Episodes on an NVIDIA GPU as CUDA graphs: one launch for all operations of a step.

A step of the world is about a thousand small operations, and the processor needs some microseconds
to start each of them, longer than the GPU needs to do it. A CUDA graph holds them all, with the
addresses of their arguments, so the state of the episodes stays in one place and every step writes
over it. The operations are those of `Episodes`, and so are the results.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Generic, TypeVar

import torch
from torch import Tensor

from surgisoft.cuda_graph import cuda_graph, recorded
from surgisoft.tasks.base import Episodes, Outcome, Task, TaskState
from surgisoft.tasks.world.pytree import leaves, rows, tree_map
from surgisoft.tasks.world.random_streams import Stream, streams

Tree = TypeVar("Tree")
LEAST_ROWS = 64
"""Fewest episodes that a graph begins anew; each further size is eight times as large."""


def donated_episodes(task: Task, count: int) -> Episodes | GraphedEpisodes:
    """The loop of `count` episodes whose states only its caller keeps: CUDA graphs on a GPU."""
    if task.world.device.type == "cuda":
        return GraphedEpisodes(task, count)
    return Episodes(task, donate=True)


class GraphedEpisodes:
    """`Episodes` of a task, `count` side by side, whose state stays in the same tensors.

    A state is valid until the next step or reset, as with `Episodes(task, donate=True)`, but all of
    it is written over. Observations and outcomes are the caller's.
    """

    def __init__(self, task: Task, count: int, record: Callable[..., Any] = cuda_graph):
        """record: what makes graphs; in place of `cuda_graph` where there is no GPU."""
        self.task, self.count = task, count
        self.plain = Episodes(task, donate=True)
        """The same episodes, one operation after the other."""
        self._record = record
        self._state: TaskState | None = None
        self._work: dict[tuple, Callable[[], Any]] = {}
        device = task.world.device
        self._actions = {
            agent: torch.zeros(count, task.world.arms[agent].chambers, device=device)
            for agent in task.agents
        }
        self._index: dict[int, Tensor] = {}

    @torch.inference_mode()
    def start(self, stream: Stream) -> TaskState:
        """Start an episode for each of the `count` random number streams."""
        return self.held(self.plain.start(stream))

    def seeded(self, seed: int, count: int, first: int = 0) -> TaskState:
        """Start episodes number `first` to `first + count - 1` of a seed."""
        return self.start(streams(seed, count, first, self.task.world.device))

    @torch.inference_mode()
    def step(self, state: TaskState, actions: Mapping[str, Tensor]) -> tuple[TaskState, Outcome]:
        """Advance every episode one step; none is reset."""
        held = self.held(state)
        for agent, action in actions.items():
            self._actions[agent].copy_(action)
        return held, self._done(("step",), self._stepped).copied()

    @torch.inference_mode()
    def reset(self, state: TaskState, mask: Tensor) -> TaskState:
        """Start new episodes where mask (B,) is set, each with its random number stream."""
        held = self.held(state)
        for _, places in self._parts(mask.nonzero()[:, 0]):
            self._done(("start", len(places)), partial(self._restarted, places))
        return held

    @torch.inference_mode()
    def observe_anew(
        self, state: TaskState, index: Tensor, seen: Mapping[str, Tensor]
    ) -> dict[str, Tensor]:
        """Observations as `observe` gives them, where only episodes index (R,) int64 are not those
        in which `seen` was observed."""
        held, found = self.held(state), dict(seen)
        for part, places in self._parts(index):
            name = ("observation", len(places))
            fresh = self._done(name, partial(self._observed, held, places))
            for agent, value in fresh.items():
                found[agent] = found[agent].index_copy(0, part, value[: len(part)])
        return found

    def _parts(self, index: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Parts of an index, and each in a tensor of one of a few lengths, where graphs find it.

        What is left of its length names the part's first episode again.
        """
        most = LEAST_ROWS
        while most < min(len(index), self.count):
            most *= 8
        most = min(most, self.count)
        for part in index.split(most) if len(index) else ():
            if most not in self._index:
                self._index[most] = part.new_zeros(most)
            places = self._index[most]
            places.copy_(part[:1].expand(most))
            places[: len(part)].copy_(part)
            yield part, places

    @torch.inference_mode()
    def observe(self, state: TaskState) -> dict[str, Tensor]:
        """Clipped observations, agent -> (B, D), see `Episodes.observe`."""
        held = self.held(state)
        seen = self._done(("observation",), partial(self.plain.observe, held))
        return {agent: value.clone() for agent, value in seen.items()}

    def advanced(self, actions: Mapping[str, Tensor]) -> Packed[Outcome]:
        """The operations of a step, for a graph that holds more than them."""
        state, outcome = self.plain.step(self._now, actions)
        packed = Packed.of(outcome)  # its tensors may be those that are written over
        overwrite(self._now, state)
        return packed

    def kept(self) -> Callable[[], None]:
        """A function that brings the present state back."""
        before = tree_map(torch.clone, self._now)
        return lambda: overwrite(self._now, before)

    def _stepped(self) -> Any:
        return self.advanced(self._actions)

    def _restarted(self, index: Tensor) -> None:
        fresh = self.plain.start(rows(self._now.world.stream, index))
        for old, new in zip(leaves(self._now), leaves(fresh), strict=True):
            old.index_copy_(0, index, new)

    def _observed(self, state: TaskState, index: Tensor) -> dict[str, Tensor]:
        return self.plain.observe(rows(state, index))

    def _done(self, name: tuple, work: Callable[[], Any]) -> Any:
        """The results of a recorded function, which is recorded at its first call."""
        if name not in self._work:
            what, device = f"the {name[0]} of {self.task.name}", self.task.world.device
            self._work[name] = recorded(work, self.kept(), device, self._record, what)
        return self._work[name]()

    def held(self, state: TaskState) -> TaskState:
        """The state in the tensors in which graphs find it."""
        if self._state is None:
            self._state = tree_map(torch.clone, state)
        elif state is not self._state:
            overwrite(self._state, state)
        return self._state

    @property
    def _now(self) -> TaskState:
        assert self._state is not None, "episodes are started first"
        return self._state


@dataclass(frozen=True, eq=False)
class Packed(Generic[Tree]):
    """A pytree of many small tensors as a few large ones, which are copied by a few operations."""

    tree: Tree
    """The pytree; its tensors give the order."""
    parts: dict[tuple, Tensor]
    """(type, shape) -> its tensors, stacked."""

    @classmethod
    def of(cls, tree: Tree) -> Packed[Tree]:
        """A pytree's tensors, stacked."""
        groups: dict[tuple, list[Tensor]] = {}
        for value in leaves(tree):
            groups.setdefault(_kind(value), []).append(value)
        return cls(tree, {kind: torch.stack(group) for kind, group in groups.items()})

    def copied(self) -> Tree:
        """A copy of the pytree."""
        return Packed(self.tree, {kind: part.clone() for kind, part in self.parts.items()}).views()

    def views(self) -> Tree:
        """The pytree with views of the large tensors."""
        rows = {kind: iter(part.unbind(0)) for kind, part in self.parts.items()}
        return tree_map(lambda value: next(rows[_kind(value)]), self.tree)


def _kind(value: Tensor) -> tuple:
    return value.dtype, tuple(value.shape)


def overwrite(held: Any, new: Any) -> None:
    """Copy the tensors of a pytree into those of another one of the same structure.

    Some of the new ones may be held ones, in the same place or in another.
    """
    pairs = [
        (old, value)
        for old, value in zip(leaves(held), leaves(new), strict=True)
        if not (old.data_ptr() == value.data_ptr() and old.stride() == value.stride())
    ]
    places = {old.untyped_storage().data_ptr() for old in leaves(held)}
    values = [
        value.clone() if value.untyped_storage().data_ptr() in places else value
        for _, value in pairs
    ]
    for (old, _), value in zip(pairs, values, strict=True):
        old.copy_(value)
