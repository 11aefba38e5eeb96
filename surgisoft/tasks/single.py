"""Tasks of one agent as Gymnasium Env and VectorEnv: adapters over a batch.

`import surgisoft` registers them as `surgisoft/NAME-v0`. `gymnasium.make_vec` makes the batched
one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from torch import Tensor

from surgisoft.environments import register
from surgisoft.errors import InputError, unknown_name
from surgisoft.tasks.arguments import whole
from surgisoft.tasks.base import DocumentedTask, Task, TaskState
from surgisoft.tasks.numpy_adapter import (
    FAILED,
    RGB_ARRAY,
    NumpyAdapter,
    Pictures,
    entropy_seed,
    episode_number,
    in_one,
)
from surgisoft.tasks.observations import ObservationBlocks
from surgisoft.tasks.registry import task_of


def _adapter(
    task: str | Task,
    config: Any,
    device: str | torch.device | None,
    scene: str | Path | None,
    arm: str | Path | None,
    geometry: str | None,
    agent: str | None,
    images: str | None,
    image_pixels: int | None,
) -> tuple[NumpyAdapter, str]:
    """The adapter of a task of one agent, and that agent; arguments as for `registry.make_with`.

    agent: the one that learns in a task of several, see `OneAgent`.
    """
    task = task_of(
        task, device, config=config, scene=scene, arm=arm, geometry=geometry, images=images,
        image_pixels=image_pixels,
    )  # fmt: skip
    if agent is not None:
        task = one_agent(task, agent)
    if len(task.agents) != 1:
        raise InputError(
            f"task '{task.name}' has agents {', '.join(task.agents)}, expected one; use "
            "surgisoft.parallel_env, or name one with agent="
        )
    return NumpyAdapter(task), task.agents[0]


class OneAgent:
    """A task of several agents in which one acts, and the scripted expert drives the others.

    All else is the task's own. The expert sees the true state, see `Task.script`.
    """

    def __init__(self, task: Task, agent: str):
        self._task, self.agents = cast(DocumentedTask, task), (agent,)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "_task":
            raise AttributeError(name)
        return getattr(self._task, name)

    def advance(self, state: TaskState, actions: Mapping[str, Tensor]) -> TaskState:
        """Advance one step; the agents without an action follow the scripted expert."""
        return self._task.advance(state, {**self._task.script(state), **actions})

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        """The agent's observation, (B, D)."""
        return {agent: self._task.observe(state)[agent] for agent in self.agents}

    def blocks(self, state: TaskState) -> dict[str, ObservationBlocks]:
        """The blocks of the agent's observation."""
        return {agent: self._task.blocks(state)[agent] for agent in self.agents}

    def rewards(self, state: TaskState) -> dict[str, dict[str, Tensor]]:
        """The agent's weighted reward terms."""
        return {agent: self._task.rewards(state)[agent] for agent in self.agents}


def one_agent(task: Task, agent: str) -> Task:
    """The task with `agent` as its only one; the scripted expert drives the others."""
    if agent not in task.agents:
        raise unknown_name("agent", agent, task.agents)
    return cast(Task, OneAgent(task, agent))


class SingleEnv(gymnasium.Env):
    """One environment of a task. Actions (m,) kPa and observations (D,) are float32.

    The info of a step holds the weighted reward terms, the measures that apply, and `failed`:
    whether the episode ended because the arm was no longer finite, as after an action of NaN. A
    measure that does not apply at a step, such as the error while the reference waits, is left out:
    `info.get("error_mm")` is then None.
    """

    metadata = {"render_modes": [RGB_ARRAY], "render_fps": 10}  # noqa: RUF012  (Gymnasium's form)

    def __init__(
        self,
        task: str | Task,
        config: Any = None,
        device: str | torch.device | None = None,
        scene: str | Path | None = None,
        arm: str | Path | None = None,
        geometry: str | None = None,
        render_mode: str | None = None,
        agent: str | None = None,
        images: str | None = None,
        image_pixels: int | None = None,
    ):
        """The task's name, and changes to its config as for `registry.make_with`; or a task.

        render_mode: `rgb_array`, for pictures by `render`, or None. agent: the one that acts, in a
        task of several: the scripted expert drives the others. images, image_pixels: as for
        `parallel_env`.
        """
        shown = (agent, images, image_pixels)
        self.adapter, self._agent = _adapter(task, config, device, scene, arm, geometry, *shown)
        self._pictures = Pictures(self.adapter.task, render_mode)
        self.render_mode = render_mode
        fps = round(1.0 / self.adapter.task.world.config.dt_s)
        self.metadata = {**self.metadata, "render_fps": fps}
        self._state: TaskState | None = None
        self.observation_space = self.adapter.observation_space(self._agent)
        self.action_space = Box(*self.adapter.action_bounds(self._agent))

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start an episode; returns (observation, empty info).

        options: `{"episode": k}` starts episode k of the seed, as `surgisoft evaluate` counts them;
        default 0.
        """
        number = episode_number(seed, options)
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**63))
        self._state = self.adapter.seeded([seed], number)
        return in_one(self.adapter.observations(self._state)[self._agent]), {}

    def step(self, action: np.ndarray):
        """Advance one step: (observation, reward, terminated, truncated, info).

        Raises InputError before the first reset.
        """
        if self._state is None:
            raise InputError("step before reset: call reset() first")
        held = self.adapter.checked({self._agent: action})[self._agent]
        self._state, outcome = self.adapter.step(self._state, {self._agent: held[None]})
        info = {name: value.item() for name, value in outcome.terms[self._agent].items()}
        info |= {n: v.item() for n, v in outcome.measures.items() if v.isfinite().all()}
        info[FAILED] = bool(self._state.world.failed)
        return (
            in_one(self.adapter.observations(self._state)[self._agent]),
            outcome.rewards[self._agent].item(),
            bool(outcome.terminated),
            bool(outcome.truncated),
            info,
        )

    def render(self) -> np.ndarray | None:
        """(H, W, 3) uint8: the present state from outside; None without a render mode."""
        return self._pictures.of(self._state)


class BatchedEnv(VectorEnv):
    """Many environments of a task in one batch; a finished one is reset in the same step."""

    metadata = {  # noqa: RUF012  (Gymnasium's form)
        "render_modes": [RGB_ARRAY],
        "render_fps": 10,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        task: str | Task,
        num_envs: int = 1,
        config: Any = None,
        device: str | torch.device | None = None,
        scene: str | Path | None = None,
        arm: str | Path | None = None,
        geometry: str | None = None,
        agent: str | None = None,
        images: str | None = None,
        image_pixels: int | None = None,
        render_mode: str | None = None,
    ):
        """The task's name, and changes to its config as for `registry.make_with`; or a task.

        render_mode, agent, images and image_pixels are as for `SingleEnv`.
        """
        num_envs = whole("num_envs", num_envs, 1)
        shown = (agent, images, image_pixels)
        self.adapter, self._agent = _adapter(task, config, device, scene, arm, geometry, *shown)
        self._pictures = Pictures(self.adapter.task, render_mode)
        self.render_mode = render_mode
        fps = round(1.0 / self.adapter.task.world.config.dt_s)
        self.metadata = {**self.metadata, "render_fps": fps}
        self._state: TaskState | None = None
        self.num_envs = num_envs
        self.single_observation_space = self.adapter.observation_space(self._agent)
        self.single_action_space = Box(*self.adapter.action_bounds(self._agent))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed: int | Sequence[int | None] | None = None, options: dict | None = None):
        """Start episodes; environment i has seed + i, and equals a `SingleEnv` of that seed.

        A list has the seed of each environment, None for any. Without a seed the random number
        streams of the last episodes continue. Raises InputError for another seed or length.
        """
        if seed is None and self._state is not None:
            self._state = self.adapter.restart(self._state)
        else:
            self._state = self.adapter.seeded(self._seeds(seed))
        return self.adapter.observations(self._state)[self._agent], {}

    def _seeds(self, seed: Any) -> list[int]:
        """The seed of each environment, see `reset`."""
        if not isinstance(seed, list | tuple) and not getattr(seed, "ndim", 0):
            first = entropy_seed() if seed is None else whole("seed", seed, 0)
            return list(range(first, first + self.num_envs))
        if len(seed) != self.num_envs:
            raise InputError(
                f"seed is a list of {len(seed)}, expected one for each of {self.num_envs} "
                "environments, or one whole number"
            )
        named = ((f"seed[{i}]", each) for i, each in enumerate(seed))
        return [entropy_seed() if one is None else whole(name, one, 0) for name, one in named]

    def step(self, actions: np.ndarray):
        """Advance all environments: (observations, rewards, terminated, truncated, infos).

        Finished environments are reset; `final_obs` in the infos holds their last observations.
        """
        if self._state is None:
            raise InputError("step before reset: call reset() first")
        self._state, outcome = self.adapter.step(self._state, {self._agent: actions})
        done, info = outcome.done.cpu().numpy(), {}
        for name, value in {**outcome.terms[self._agent], **outcome.measures}.items():
            info[name], info[f"_{name}"] = value.cpu().numpy(), value.isfinite().cpu().numpy()
        failed = self._state.world.failed.cpu().numpy().copy()
        info[FAILED], info[f"_{FAILED}"] = failed, np.ones_like(failed)
        if done.any():
            last = self.adapter.observations(self._state)[self._agent]
            info["final_obs"], info["_final_obs"] = last, done
            self._state = self.adapter.restart(self._state, outcome.done)
        return (
            self.adapter.observations(self._state)[self._agent],
            outcome.rewards[self._agent].cpu().numpy(),
            outcome.terminated.cpu().numpy(),
            outcome.truncated.cpu().numpy(),
            info,
        )

    def render(self) -> tuple[np.ndarray, ...] | None:
        """(H, W, 3) uint8 of every environment from outside; None without a render mode."""
        return self._pictures.of_each(self._state, self.num_envs) or None


register()
