"""PettingZoo's ParallelEnv over a batch of one; it translates and nothing else."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv

from surgisoft.errors import InputError
from surgisoft.tasks.base import Task
from surgisoft.tasks.numpy_adapter import Port, unseeded
from surgisoft.tasks.registry import config_of, make_task, with_fields


class SurgicalEnv(ParallelEnv):
    """Any task; agents are arms by name.

    Actions: (m,) float32 changes of pressure, kPa. Observations: (D,) float32, see the task. The
    infos hold each agent's reward terms and the task's measures where they apply.
    """

    def __init__(self, task: Task):
        self.metadata = {"name": task.name, "render_modes": [], "is_parallelizable": True}
        self.render_mode = None
        self.task, self._port, self._state = task, Port(task), None
        self.possible_agents = list(task.agents)
        self.agents: list[str] = []
        self._observed = {a: Box(*self._port.observed(a)) for a in task.agents}
        self._acted = {a: Box(*self._port.acted(a)) for a in task.agents}
        low = np.concatenate([self._observed[a].low for a in task.agents])
        self.state_space = Box(low, -low)

    def observation_space(self, agent: str) -> Box:
        return self._observed[agent]

    def action_space(self, agent: str) -> Box:
        return self._acted[agent]

    def reset(self, seed: int | None = None, options: dict | None = None):
        """A fresh episode; without a seed the last one's random stream goes on."""
        if seed is None and self._state is not None:
            self._state = self._port.again(self._state)
        else:
            self._state = self._port.seeded([unseeded() if seed is None else seed])
        self.agents = list(self.possible_agents)
        return self._observations(), {agent: {} for agent in self.agents}

    def step(self, actions: dict):
        if self._state is None:
            raise InputError("step before reset: call reset() first")
        if not self.agents:
            return {}, {}, {}, {}, {}
        absent = [agent for agent in self.agents if agent not in actions]
        if absent:
            raise InputError(f"no action for {', '.join(absent)}: expected one for each live agent")
        held = {agent: np.asarray(actions[agent])[None] for agent in self.agents}
        self._state, outcome = self._port.step(self._state, held)
        measures = {
            name: value.item() for name, value in outcome.measures.items() if value.isfinite().all()
        }
        live = self.agents
        infos = {
            agent: {**{name: v.item() for name, v in outcome.terms[agent].items()}, **measures}
            for agent in live
        }
        rewards = {agent: outcome.rewards[agent].item() for agent in live}
        terminated = dict.fromkeys(live, bool(outcome.terminated))
        truncated = dict.fromkeys(live, bool(outcome.truncated))
        observations = self._observations()
        if outcome.done:
            self.agents = []
        return observations, rewards, terminated, truncated, infos

    def state(self) -> np.ndarray:
        """(sum of D,) what all agents observe, one after the other."""
        seen = self._port.observations(self._state)
        return np.concatenate([seen[agent][0] for agent in self.possible_agents])

    def render(self) -> None:
        """Nothing is drawn here: `surgisoft.replay` draws."""

    def close(self) -> None:
        """Nothing is held open."""

    def _observations(self) -> dict[str, np.ndarray]:
        seen = self._port.observations(self._state)
        return {agent: seen[agent][0] for agent in self.agents}


def parallel_env(
    task: str,
    config=None,
    device: str | torch.device = "cpu",
    scene: str | Path | None = None,
    arm: str | Path | None = None,
    geometry: str = "fcl",
) -> SurgicalEnv:
    """The named task as a PettingZoo ParallelEnv; `config` is the task's own.

    scene: a scene's folder; arm: an arm model's folder or `default`; both change the config, None
    leaves it as it is. geometry: `fcl`, the referee, decides about contact and the beam's hit, or
    `batched`, the faster engine of training, which agrees with it to 0.1 mm near contact.
    """
    config = config_of(task) if config is None else config
    changes = {"scene": scene, "arm": arm}
    config = with_fields(config, **{n: v for n, v in changes.items() if v is not None})
    config = with_fields(config, geometry=geometry)
    return SurgicalEnv(make_task(task, config, device))
