"""A task's episodes as NumPy arrays: the common part of the PettingZoo and Gymnasium adapters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from surgisoft.errors import InputError, unknown_name
from surgisoft.tasks.base import Episodes, Outcome, Task, TaskState
from surgisoft.tasks.observations import OBSERVATION_LIMIT
from surgisoft.tasks.world.picture import WorldPicture
from surgisoft.tasks.world.random_streams import joined, streams

Bounds = tuple[Any, Any, tuple[int, ...], Any]
"""Lowest value, highest value, shape and dtype: the arguments of a Gymnasium Box."""


RGB_ARRAY = "rgb_array"
"""The render mode of the environments: pictures as arrays."""


class Pictures:
    """Pictures of a task's first environment, for the render mode `rgb_array`."""

    def __init__(self, task: Task, mode: str | None):
        """mode: `rgb_array`, or None for no pictures."""
        if mode not in (None, RGB_ARRAY):
            raise unknown_name("render_mode", mode, [RGB_ARRAY])
        self._task, self._mode = task, mode
        self._picture: WorldPicture | None = None

    @torch.inference_mode()
    def of(self, state: TaskState | None) -> np.ndarray | None:
        """(H, W, 3) uint8 picture of a state, made with the camera's first use."""
        if self._mode is None:
            return None
        if state is None:
            raise InputError("render before reset: call reset() first")
        if self._picture is None:
            self._picture = WorldPicture(self._task.world)
        return self._picture.image(state.world, self._task.trace(state)[0])


def entropy_seed() -> int:
    """A seed from the operating system's entropy, for a reset without one."""
    return int(np.random.SeedSequence().generate_state(1, np.uint64)[0])


class NumpyAdapter:
    """Runs episodes of a task with NumPy actions and observations; holds no state.

    Arrays have the batch in front. A state passed to `step` or `restart` is invalid afterwards.
    """

    def __init__(self, task: Task):
        self.task, self.episodes = task, Episodes(task, donate=True)
        first = self.observations(self.seeded([0]))
        self._width = {agent: seen.shape[1] for agent, seen in first.items()}

    def observation_bounds(self, agent: str) -> Bounds:
        """Bounds of one agent's observation in one environment."""
        return -OBSERVATION_LIMIT, OBSERVATION_LIMIT, (self._width[agent],), np.float32

    def action_bounds(self, agent: str) -> Bounds:
        """Bounds of one agent's action in one environment, kPa."""
        arm = self.task.world.arms[agent]
        limit = arm.pneumatics.step_kPa
        return -limit, limit, (arm.chambers,), np.float32

    @torch.inference_mode()
    def seeded(self, seeds: Sequence[int]) -> TaskState:
        """Start episodes, one for each seed."""
        parts = [streams(int(seed), 1, 0, self.task.world.device) for seed in seeds]
        return self.episodes.start(joined(parts))

    @torch.inference_mode()
    def restart(self, state: TaskState, mask: torch.Tensor | None = None) -> TaskState:
        """Start new episodes where mask (B,) is set (None: everywhere), from their streams."""
        mask = torch.ones_like(state.world.failed) if mask is None else mask
        return self.episodes.reset(state, mask)

    @torch.inference_mode()
    def step(
        self, state: TaskState, actions: Mapping[str, np.ndarray]
    ) -> tuple[TaskState, Outcome]:
        """Advance one step; actions: agent -> (B, m), kPa."""
        count, held = len(state.world.steps), {}
        for agent in self.task.agents:
            expected = (count, self.task.world.arms[agent].chambers)
            if np.shape(actions[agent]) != expected:
                raise InputError(
                    f"action of '{agent}' has shape {np.shape(actions[agent])}, expected {expected}"
                )
            held[agent] = torch.tensor(
                np.asarray(actions[agent]), dtype=torch.float32, device=self.task.world.device
            )
        return self.episodes.step(state, held)

    @torch.inference_mode()
    def observations(self, state: TaskState) -> dict[str, np.ndarray]:
        """Observations, agent -> (B, D) float32, as arrays that the caller may change."""
        return {agent: seen.cpu().numpy() for agent, seen in self.episodes.observe(state).items()}
