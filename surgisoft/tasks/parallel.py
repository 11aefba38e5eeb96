"""Tasks as PettingZoo ParallelEnv: an adapter over a batch of one environment."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.spaces import Dict as DictSpace
from pettingzoo import ParallelEnv

from surgisoft.errors import InputError
from surgisoft.tasks.arguments import check_agents
from surgisoft.tasks.base import LoneEpisode, Task, TaskState
from surgisoft.tasks.numpy_adapter import (
    FAILED,
    RGB_ARRAY,
    NumpyAdapter,
    Pictures,
    entropy_seed,
    episode_number,
    in_one,
)
from surgisoft.tasks.registry import task_of


class SurgicalEnv(ParallelEnv):
    """A task as a PettingZoo environment; agents are arms by name.

    Actions are changes of the commanded pressure (m,) float32, kPa. Observations are (D,) float32;
    `surgisoft.tasks.describe` lists their entries; with images they are dicts of that `vector` and
    of (H, W, C) arrays. Each agent's info holds its weighted reward
    terms, the task's measures that apply, and `failed`: whether the episode ended because an
    arm was no longer finite, as after an action of NaN. A measure that does not apply at a step,
    such as the error while the reference waits, is left out, since NaN does not equal itself and
    PettingZoo's test of seeds compares infos.
    """

    def __init__(self, task: Task, render_mode: str | None = None):
        self.metadata = {
            "name": task.name,
            "render_modes": [RGB_ARRAY],
            "render_fps": round(1.0 / task.world.config.dt_s),
            "is_parallelizable": True,
        }
        self.render_mode, self._pictures = render_mode, Pictures(task, render_mode)
        self.task, self.adapter = task, NumpyAdapter(task)
        self._batch: TaskState | None = None
        self.lone: LoneEpisode | None = None
        """What advances the episode in place of the adapter, where the task has such a thing."""
        self.possible_agents = list(task.agents)
        self.agents: list[str] = []
        self._observed = {a: self.adapter.observation_space(a) for a in task.agents}
        self._acted = {a: Box(*self.adapter.action_bounds(a)) for a in task.agents}
        each = [Box(*self.adapter.observation_bounds(a)) for a in task.agents]
        low = np.concatenate([box.low for box in each])
        self.state_space = Box(low, -low)

    def __getstate__(self) -> dict[str, Any]:
        """A copy's state: arrays that share memory with one another cannot be copied one by one."""
        return {**self.__dict__, "_batch": self.task_state, "lone": self.lone is not None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Go on from a copy's state."""
        self.__dict__.update(state)
        batch = self._batch
        self.lone = self.adapter.alone(batch) if state["lone"] and batch is not None else None

    @property
    def task_state(self) -> TaskState | None:
        """State of the episode, a batch of one; None before the first reset."""
        return self._batch if self.lone is None else self.lone.state

    def observation_space(self, agent: str) -> Box | DictSpace:
        """The Box of an agent's observation (D,); with images a Dict of it and of their Boxes."""
        return self._observed[agent]

    def action_space(self, agent: str) -> Box:
        """The Box of an agent's action (m,), changes of pressure in kPa."""
        return self._acted[agent]

    def reset(self, seed: int | None = None, options: dict | None = None):
        """Start an episode; returns observations and empty infos.

        Without a seed the random number stream of the last episode continues. options:
        `{"episode": k}` starts episode k of the seed, as `surgisoft evaluate` counts them; default
        0.
        """
        state, number = self.task_state, episode_number(seed, options)
        if seed is None and state is not None:
            self._batch = self.adapter.restart(state)
        else:
            first = entropy_seed() if seed is None else seed
            self._batch = self.adapter.seeded([first], number)
        self.lone = self.adapter.alone(self._batch)
        self.agents = list(self.possible_agents)
        return self._observations(), {agent: {} for agent in self.agents}

    def step(self, actions: dict):
        """Advance one step: (observations, rewards, terminations, truncations, infos) by agent.

        Raises InputError before the first reset, if a live agent has no action, for the action of
        an agent that the task does not have, and for one that is not (m,) real numbers.
        """
        if self._batch is None:
            raise InputError("step before reset: call reset() first")
        if not self.agents:
            return {}, {}, {}, {}, {}
        check_agents(actions, self.possible_agents)
        if self.lone is not None:
            return self._lone_step(self.lone, actions)
        held = {agent: one[None] for agent, one in self.adapter.checked(actions).items()}
        self._batch, outcome = self.adapter.step(self._batch, held)
        measures = {
            name: value.item() for name, value in outcome.measures.items() if value.isfinite().all()
        }
        live = self.agents
        failed = bool(self._batch.world.failed)
        infos = {
            agent: {
                **{name: v.item() for name, v in outcome.terms[agent].items()},
                **measures,
                FAILED: failed,
            }
            for agent in live
        }
        rewards = {agent: outcome.rewards[agent].item() for agent in live}
        terminated = dict.fromkeys(live, bool(outcome.terminated))
        truncated = dict.fromkeys(live, bool(outcome.truncated))
        observations = self._observations()
        if outcome.done:
            self.agents = []
        return observations, rewards, terminated, truncated, infos

    def _lone_step(self, lone: LoneEpisode, actions: dict):
        """`step` where the task advances its only environment without tensors."""
        lone.step(self.adapter.checked(actions))
        measures = {name: value for name, value in lone.measures.items() if math.isfinite(value)}
        terms, live = lone.terms, self.agents
        infos = {agent: {**terms[agent], **measures, FAILED: lone.failed} for agent in live}
        rewards = {agent: sum(terms[agent].values()) for agent in live}
        terminated, truncated = lone.terminated, lone.truncated
        observations = lone.observations
        if terminated or truncated:
            self.agents = []
        ends = dict.fromkeys(live, terminated), dict.fromkeys(live, truncated)
        return observations, rewards, *ends, infos

    def state(self) -> np.ndarray:
        """(sum of D,) the concatenated vectors of all agents, for centralised critics."""
        if self.lone is not None:
            seen = self.lone.observations
            return np.concatenate([seen[agent] for agent in self.possible_agents])
        if self._batch is None:
            raise InputError("state before reset: call reset() first")
        seen = self.adapter.vectors(self._batch)
        return np.concatenate([seen[agent][0] for agent in self.possible_agents])

    def render(self) -> np.ndarray | None:
        """(H, W, 3) uint8: the present state from outside; None without a render mode."""
        return self._pictures.of(self.task_state)

    def close(self) -> None:
        """Do nothing: the environment holds no resources."""

    def _observations(self) -> dict[str, Any]:
        if self.lone is not None:
            return self.lone.observations
        assert self._batch is not None, "there is one after a reset"
        seen = self.adapter.observations(self._batch)
        return {agent: in_one(seen[agent]) for agent in self.agents}


def parallel_env(
    task: str | Task,
    config: Any = None,
    device: str | torch.device | None = None,
    scene: str | Path | None = None,
    arm: str | Path | None = None,
    geometry: str | None = None,
    render_mode: str | None = None,
    images: str | None = None,
    image_pixels: int | None = None,
) -> SurgicalEnv:
    """The named task, or a task, as a PettingZoo ParallelEnv.

    Observations (D,) are scaled to the order of 1 (docs/environments), actions (m,) are changes of
    the commanded pressure, kPa, both float32. Raises InputError for an unknown task, scene or
    field.

    task: its name, or a task that is built already, which takes no config, scene, arm or images,
    and no other device or geometry. device: default `cpu`, of a built task its own. config: the
    task's whole config, None: its default one. scene: a scene's folder. arm: an arm model's folder
    or `default`. None leaves scene or arm as the config has it. geometry: `fcl`, the exact
    collision checker and the default of a named task, or `batched`, the faster engine of training,
    for contact and for the beam's hit; near contact the two agree to 0.1 mm. render_mode:
    `rgb_array`, for pictures by `render`, or None. images: `rgb`, `depth`, `segmentation` with
    commas in between: what the endoscope shows, in observations that are then dicts; image_pixels:
    its width and height.
    """
    if geometry is None and isinstance(task, str):
        geometry = "fcl"
    built = task_of(
        task, device, config=config, scene=scene, arm=arm, geometry=geometry, images=images,
        image_pixels=image_pixels,
    )  # fmt: skip
    return SurgicalEnv(built, render_mode)
