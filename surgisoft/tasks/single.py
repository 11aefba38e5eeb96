"""Gymnasium's Env and VectorEnv for tasks of one agent; they translate and nothing else.

`import surgisoft` registers them as `surgisoft/NAME-v0`. `gymnasium.make_vec` makes the batched
one.
"""

from __future__ import annotations

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from surgisoft.environments import register
from surgisoft.errors import InputError
from surgisoft.tasks.base import Task
from surgisoft.tasks.numpy_adapter import Port, unseeded
from surgisoft.tasks.registry import make_task


def _port(task: str | Task, config, device) -> tuple[Port, str]:
    task = make_task(task, config, device) if isinstance(task, str) else task
    if len(task.agents) != 1:
        raise InputError(
            f"task '{task.name}' has agents {', '.join(task.agents)}, expected one; use "
            "surgisoft.parallel_env"
        )
    return Port(task), task.agents[0]


class SingleEnv(gymnasium.Env):
    """One environment. Actions (m,) kPa, observations (D,), both float32."""

    metadata = {"render_modes": []}  # noqa: RUF012  (Gymnasium's own form)

    def __init__(self, task: str | Task, config=None, device: str | torch.device = "cpu"):
        self._port, self._agent = _port(task, config, device)
        self._state = None
        self.observation_space = Box(*self._port.observed(self._agent))
        self.action_space = Box(*self._port.acted(self._agent))

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        super().reset(seed=seed)
        if seed is None:
            seed = int(self.np_random.integers(2**63))
        self._state = self._port.seeded([seed])
        return self._port.observations(self._state)[self._agent][0], {}

    def step(self, action):
        if self._state is None:
            raise InputError("step before reset: call reset() first")
        self._state, outcome = self._port.step(self._state, {self._agent: np.asarray(action)[None]})
        info = {name: value.item() for name, value in outcome.terms[self._agent].items()}
        info |= {n: v.item() for n, v in outcome.measures.items() if v.isfinite().all()}
        return (
            self._port.observations(self._state)[self._agent][0],
            outcome.rewards[self._agent].item(),
            bool(outcome.terminated),
            bool(outcome.truncated),
            info,
        )


class BatchedEnv(VectorEnv):
    """Many environments in one batch; a finished one begins anew in the same step."""

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, task: str | Task, num_envs=1, config=None, device="cpu", **_unused):
        self._port, self._agent = _port(task, config, device)
        self._state, self.num_envs = None, num_envs
        self.single_observation_space = Box(*self._port.observed(self._agent))
        self.single_action_space = Box(*self._port.acted(self._agent))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Environment i is that of `SingleEnv` with seed + i; without a seed the streams go on."""
        if seed is None and self._state is not None:
            self._state = self._port.again(self._state)
        else:
            first = unseeded() if seed is None else seed
            self._state = self._port.seeded(range(first, first + self.num_envs))
        return self._port.observations(self._state)[self._agent], {}

    def step(self, actions):
        if self._state is None:
            raise InputError("step before reset: call reset() first")
        self._state, outcome = self._port.step(self._state, {self._agent: np.asarray(actions)})
        done, info = outcome.done.cpu().numpy(), {}
        for name, value in {**outcome.terms[self._agent], **outcome.measures}.items():
            info[name], info[f"_{name}"] = value.cpu().numpy(), value.isfinite().cpu().numpy()
        if done.any():
            last = self._port.observations(self._state)[self._agent]
            info["final_obs"], info["_final_obs"] = last, done
            self._state = self._port.again(self._state, outcome.done)
        return (
            self._port.observations(self._state)[self._agent],
            outcome.rewards[self._agent].cpu().numpy(),
            outcome.terminated.cpu().numpy(),
            outcome.truncated.cpu().numpy(),
            info,
        )


register()
