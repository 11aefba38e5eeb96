"""A task's episodes as NumPy arrays: the common part of the PettingZoo and Gymnasium adapters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.spaces import Dict as DictSpace

from surgisoft.errors import InputError, unknown_name
from surgisoft.tasks.arguments import action_of, whole
from surgisoft.tasks.base import (
    Episodes,
    LoneEpisode,
    Outcome,
    Task,
    TaskState,
    check_finite,
    check_seen,
    trace_of,
)
from surgisoft.tasks.observations import OBSERVATION_LIMIT
from surgisoft.tasks.world.images import VECTOR, images_of
from surgisoft.tasks.world.picture import WorldPicture
from surgisoft.tasks.world.pytree import rows
from surgisoft.tasks.world.random_streams import joined, streams


def in_one(observation: Any) -> Any:
    """The observation of the only environment of a batch of one."""
    if isinstance(observation, dict):
        return {name: value[0] for name, value in observation.items()}
    return observation[0]


Bounds = tuple[Any, Any, tuple[int, ...], Any]
"""Lowest value, highest value, shape and dtype: the arguments of a Gymnasium Box."""


FAILED = "failed"
"""Entry of a step's info: whether an arm was no longer finite, as after an action of NaN. The
episode then ends with observations and rewards of zero."""
EPISODE = "episode"
"""Option of a reset: number of the episode within the seed, as `evaluate` counts them."""
RGB_ARRAY = "rgb_array"
"""The render mode of the environments: pictures as arrays."""


class Pictures:
    """Pictures of a task's environments, for the render mode `rgb_array`."""

    def __init__(self, task: Task, mode: str | None):
        """mode: `rgb_array`, or None for no pictures."""
        if mode not in (None, RGB_ARRAY):
            raise unknown_name("render_mode", mode, [RGB_ARRAY])
        self._task, self._mode = task, mode
        self._picture: WorldPicture | None = None

    def of(self, state: TaskState | None) -> np.ndarray | None:
        """(H, W, 3) uint8 picture of the first environment, made with the camera's first use."""
        pictures = self.of_each(state, 1)
        return pictures[0] if pictures else None

    @torch.inference_mode()
    def of_each(self, state: TaskState | None, count: int) -> tuple[np.ndarray, ...]:
        """(H, W, 3) uint8 pictures of the first environments; none without a render mode."""
        if self._mode is None:
            return ()
        if state is None:
            raise InputError("render before reset: call reset() first")
        if self._picture is None:
            self._picture = WorldPicture(self._task.world)
        found = []
        for index in range(count):
            one = rows(state, torch.tensor([index], device=state.world.steps.device))
            found.append(self._picture.image(one.world, trace_of(self._task, one)[0]))
        return tuple(found)


def episode_number(seed: int | None, options: Mapping[str, Any] | None) -> int:
    """The number of an episode within its seed from the options of a reset: `episode`, else 0.

    Raises InputError where it is no whole number from 0 on, and for one without a seed.
    """
    given = (options or {}).get(EPISODE)
    if given is None:
        return 0
    number = whole(f"option '{EPISODE}'", given, 0)
    if seed is None:
        raise InputError(
            f"option '{EPISODE}' is {number} without a seed; expected both, as in "
            f"reset(seed=7, options={{'{EPISODE}': {number}}})"
        )
    return number


def entropy_seed() -> int:
    """A seed from the operating system's entropy, for a reset without one."""
    return int(np.random.SeedSequence().generate_state(1, np.uint64)[0])


class NumpyAdapter:
    """Runs episodes of a task with NumPy actions and observations; holds no state.

    Arrays have the batch in front. A state passed to `step` or `restart` is invalid afterwards.
    """

    def __init__(self, task: Task):
        self.task, self.episodes = task, Episodes(task, donate=True)
        first = self.vectors(self.seeded([0]))
        self._width = {agent: seen.shape[1] for agent, seen in first.items()}
        world = task.world
        self.images = images_of(world.scene, world.config.endoscope_images, task.name)

    def observation_space(self, agent: str) -> Box | DictSpace:
        """The space of one agent's observation in one environment.

        A Box (D,); with images a Dict of it, `vector`, and a Box for each image.
        """
        vector = Box(*self.observation_bounds(agent))
        if self.images is None:
            return vector
        images = {
            name: Box(one.low, one.high, one.shape, one.dtype)
            for name, one in self.images.spaces.items()
        }
        return DictSpace({VECTOR: vector, **images})

    def observation_bounds(self, agent: str) -> Bounds:
        """Bounds of one agent's vector of observations in one environment."""
        return -OBSERVATION_LIMIT, OBSERVATION_LIMIT, (self._width[agent],), np.float32

    def action_bounds(self, agent: str) -> Bounds:
        """Bounds of one agent's action in one environment, kPa."""
        arm = self.task.world.arms[agent]
        limit = arm.pneumatics.step_kPa
        return -limit, limit, (arm.chambers,), np.float32

    @torch.inference_mode()
    def seeded(self, seeds: Sequence[int], episode: int = 0) -> TaskState:
        """Start episodes, one for each seed: that of this number, as `evaluate` counts them."""
        parts = [streams(seed, 1, episode, self.task.world.device) for seed in seeds]
        return self.episodes.start(joined(parts))

    @torch.inference_mode()
    def restart(self, state: TaskState, mask: torch.Tensor | None = None) -> TaskState:
        """Start new episodes where mask (B,) is set (None: everywhere), from their streams."""
        mask = torch.ones_like(state.world.failed) if mask is None else mask
        return self.episodes.reset(state, mask)

    @torch.inference_mode()
    def alone(self, state: TaskState) -> LoneEpisode | None:
        """The only environment of a state, advanced without tensors; None where the task cannot."""
        found = getattr(self.task, "alone", None)
        return found(state) if found is not None and self.images is None else None

    def checked(self, actions: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
        """Agent -> (m,) float32 kPa: the actions of one environment; an InputError for others."""
        held = {}
        for agent in self.task.agents:
            expected = (self.task.world.arms[agent].chambers,)
            held[agent] = action_of(agent, actions[agent], expected)
        return held

    @torch.inference_mode()
    def step(
        self, state: TaskState, actions: Mapping[str, np.ndarray]
    ) -> tuple[TaskState, Outcome]:
        """Advance one step; actions: agent -> (B, m), kPa."""
        count, held = len(state.world.steps), {}
        for agent in self.task.agents:
            expected = (count, self.task.world.arms[agent].chambers)
            action = action_of(agent, actions[agent], expected)
            held[agent] = torch.tensor(action, device=self.task.world.device)
        state, outcome = self.episodes.step(state, held)
        check_finite(self.task, outcome.terms)
        return state, outcome

    @torch.inference_mode()
    def observations(self, state: TaskState) -> dict[str, Any]:
        """Observations by agent, as arrays that the caller may change.

        (B, D) float32; with images a dict of it, `vector`, and (B, H, W, C) for each image.
        """
        vectors = self.vectors(state)
        if self.images is None:
            return vectors
        drawn = self.images.of(state.world.arms, state.world.scene)
        found = {}
        for agent, vector in vectors.items():
            images = {name: one.cpu().numpy().copy() for name, one in drawn.items()}
            found[agent] = {VECTOR: vector, **images}
        return found

    @torch.inference_mode()
    def vectors(self, state: TaskState) -> dict[str, np.ndarray]:
        """Observations without images, agent -> (B, D) float32; an InputError where one is NaN."""
        found = self.episodes.observe(state)
        check_seen(self.task, found)
        return {agent: seen.cpu().numpy() for agent, seen in found.items()}
