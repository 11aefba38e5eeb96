"""Many episodes of any task in one batch, all agents at once: tensors in, tensors out.

For those who bring their own trainer. Nothing is copied to NumPy, and the number of agents and arms
is that of the task.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from surgisoft.memory import keep_freed_memory
from surgisoft.tasks.arguments import actions_of, check_agents, whole
from surgisoft.tasks.base import Task, TaskState, check_finite, check_seen
from surgisoft.tasks.graphed import donated_episodes
from surgisoft.tasks.registry import task_of
from surgisoft.tasks.world.images import VECTOR, images_of
from surgisoft.tasks.world.pytree import tree_map
from surgisoft.tasks.world.random_streams import episode_streams
from surgisoft.threads import rows_on_threads

SPREAD = 7919
"""A prime: spread starts are this many steps apart, modulo the length of an episode."""


@dataclass(frozen=True, eq=False)
class BatchedStep:
    """Results of a step of B environments; an environment whose episode ended has begun anew."""

    observations: dict[str, Any]
    """agent -> (B, D): of the new episode where one ended; with images a dict of this `vector` and
    of the images (B, H, W, C)."""
    rewards: dict[str, Tensor]
    """agent -> (B,): sum of its weighted terms."""
    terminated: Tensor
    """(B,) bool: the task ended the episode, or an arm was no longer finite."""
    truncated: Tensor
    """(B,) bool: the time was out."""
    failed: Tensor
    """(B,) bool: terminated because an arm was no longer finite, as after an action of NaN; rewards
    and final observations are then 0."""
    final_observations: dict[str, Any]
    """agent -> the same: before the reset, for the value of a truncated episode's last state."""
    terms: dict[str, dict[str, Tensor]]
    """agent -> weighted reward term -> (B,)."""
    measures: dict[str, Tensor]
    """name -> (B,), see `Task.measures`; nan where one does not apply."""

    @property
    def done(self) -> Tensor:
        """(B,) bool: terminated or truncated."""
        return self.terminated | self.truncated


class BatchedEnv:
    """B environments of a task; a finished one is reset in the same step.

    Actions are changes of the commanded pressures, kPa, clipped to the pumps' largest step.
    """

    def __init__(self, task: Task, num_envs: int, seed: int = 0, spread: bool = False):
        """seed: environment i begins with the episode of seed + i, as `parallel_env` of that seed;
        spread: the first episodes begin at different steps, so that they do not all end at once.
        """
        num_envs = whole("num_envs", num_envs, 1)
        keep_freed_memory()
        self.task, self.num_envs, self.device = task, num_envs, task.world.device
        self.agents = tuple(task.agents)
        self._episodes = donated_episodes(task, num_envs)
        self._spread = spread
        world = task.world
        self._images = images_of(world.scene, world.config.endoscope_images, task.name)
        self.image_spaces = {} if self._images is None else dict(self._images.spaces)
        self._state: TaskState | None = None
        self.reset(seed)
        seen = self._episodes.observe(self._now)
        self.observation_sizes = {agent: value.shape[1] for agent, value in seen.items()}
        arms = {agent: task.world.arms[agent] for agent in self.agents}
        self.action_sizes = {agent: arm.chambers for agent, arm in arms.items()}
        self.action_limits_kPa = {agent: arm.pneumatics.step_kPa for agent, arm in arms.items()}

    @property
    def max_episode_steps(self) -> int:
        """Steps after which an episode is truncated."""
        return self.task.steps

    @property
    def episode_steps(self) -> Tensor:
        """(B,) int64: steps since each episode began."""
        return self._now.world.steps

    @rows_on_threads()
    @torch.inference_mode()
    def reset(self, seed: int = 0) -> dict[str, Tensor]:
        """Begin all episodes; environment i has seed + i. Returns the observations, which
        are those of a `BatchedStep`."""
        seed = whole("seed", seed)
        state = self._episodes.start(episode_streams(seed, self.num_envs, self.device))
        if self._spread:
            steps = torch.arange(self.num_envs, device=self.device) * SPREAD % self.task.steps
            state = replace(state, world=replace(state.world, steps=steps))
        self._state = state
        vectors = self._episodes.observe(state)
        check_seen(self.task, vectors)
        return self._with_images(vectors, self._drawn(state))

    @rows_on_threads()
    @torch.inference_mode()
    def step(self, actions: Mapping[str, Tensor | np.ndarray]) -> BatchedStep:
        """Advance all environments; actions: agent -> (B, m) kPa, tensors or arrays."""
        shapes = {agent: (self.num_envs, size) for agent, size in self.action_sizes.items()}
        check_agents(actions, shapes)
        held = actions_of(actions, shapes, self.device)
        state, outcome = self._episodes.step(self._now, held)
        check_finite(self.task, outcome.terms)
        failed = state.world.failed.clone()
        images = self._drawn(state)
        vectors = self._episodes.observe(state)
        check_seen(self.task, vectors)
        final = self._with_images(vectors, images)
        now = self._state = self._episodes.reset(state, outcome.done)
        index, seen = outcome.done.nonzero()[:, 0], final
        if len(index):
            if self._images is not None:
                images = self._images.renewed(images, now.world.arms, now.world.scene, index)
            vectors = self._episodes.observe_anew(now, index, vectors)
            seen = self._with_images(vectors, images)
        return BatchedStep(
            observations=seen,
            rewards=outcome.rewards,
            terminated=outcome.terminated,
            truncated=outcome.truncated,
            failed=failed,
            final_observations=final,
            terms=outcome.terms,
            measures=outcome.measures,
        )

    def _drawn(self, state: TaskState) -> dict[str, Tensor]:
        """The endoscopes' images (B, H, W, C); none where the configuration asks for none."""
        if self._images is None:
            return {}
        return self._images.of(state.world.arms, state.world.scene)

    def _with_images(
        self, vectors: dict[str, Tensor], images: Mapping[str, Tensor]
    ) -> dict[str, Any]:
        """Each agent's observation; the agents share the images."""
        if self._images is None:
            return vectors
        return {agent: {VECTOR: vector, **images} for agent, vector in vectors.items()}

    @property
    def state(self) -> TaskState:
        """The true state of all episodes, for what a policy may not see: the task's scripted
        expert (`task.script(state)`), or what a picture shows."""
        return tree_map(torch.clone, self._now)

    @property
    def _now(self) -> TaskState:
        assert self._state is not None, "the constructor resets"
        return self._state


def batched_env(
    task: str | Task,
    num_envs: int,
    seed: int = 0,
    config: Any = None,
    device: str | torch.device | None = None,
    scene: str | Path | None = None,
    arm: str | Path | None = None,
    geometry: str | None = None,
    spread: bool = False,
    images: str | None = None,
    image_pixels: int | None = None,
) -> BatchedEnv:
    """Many episodes of a task in one batch, tensors in and out, for any number of agents.

    Observations are (B, D), scaled to the order of 1 (docs/environments); actions are (B, m),
    changes of the commanded pressure, kPa; B is num_envs. Raises InputError for an unknown task or
    field.

    task: name of the task, or a task; the other arguments are those of `parallel_env` and of
    `BatchedEnv`.
    """
    built = task_of(
        task, device, config=config, scene=scene, arm=arm, geometry=geometry, images=images,
        image_pixels=image_pixels,
    )  # fmt: skip
    return BatchedEnv(built, num_envs, seed, spread)
