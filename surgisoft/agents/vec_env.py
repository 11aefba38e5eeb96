"""rsl-rl adapters of a task's episodes; they translate and nothing else.

`JointEnv` has all agents at once and is what training steps; `OneAgentEnv` is a `VecEnv` of
rsl-rl for tasks of one agent, for rsl-rl's runners.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import cast

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from surgisoft.agents.presets import check_vectors
from surgisoft.errors import InputError
from surgisoft.memory import keep_freed_memory
from surgisoft.tasks.base import Task
from surgisoft.tasks.graphed import donated_episodes
from surgisoft.tasks.world.arm import ArmPart, ModelArm

STATE = "state"
"""Observation group of the critics, privileged in training (CTDE): all agents' observations, and on
request what only the simulation knows (`privileged_state`)."""


def privileged_state(arm: ModelArm, part: ArmPart) -> Tensor:
    """(B, P): what a simulation knows of an arm's episode and no policy may observe.

    True key points less the observed ones, mm; gains less 1, in tenths; shift of the mount, mm, and
    its rotation, as a rotation matrix less the nominal one, in hundredths; factors of random
    effects, mm.
    """
    off = part.points_mm - part.seen_mm
    shift = part.mount[:, :3, 3] - arm.pose[:3, 3]
    turn = 100.0 * (part.mount[:, :3, :3] - arm.pose[:3, :3])
    known = [off.flatten(1), 10.0 * (part.gain / arm.per_kPa - 1.0), shift, turn.flatten(1)]
    return torch.cat(known if part.factors is None else [*known, part.factors], 1)


class JointEnv:
    """B episodes of any task, all agents at once; one that is over begins anew in the same step.

    Actions are in shares of `action_kPa`, so that a policy's output is of the order of 1.
    """

    def __init__(
        self,
        task: Task,
        count: int,
        seed: int,
        action_kPa: float,
        first: int = 0,
        privileged: bool = False,
    ):
        """Episodes `first` to `first + count - 1` of a seed, each at another point of its time.

        privileged: `STATE` also has the `privileged_state` of every arm.
        """
        check_vectors(task.world.config.endoscope_images)
        keep_freed_memory()
        self.task, self.num_envs, self.action_kPa = task, count, action_kPa
        self.privileged = privileged
        self.episodes = donated_episodes(task, count)
        with torch.inference_mode():
            state = self.episodes.seeded(seed, count, first)
            # Else all episodes would be over in the same step for ever.
            spread = (first + torch.arange(count, device=task.world.device)) * 7919 % task.steps
            self.state = replace(state, world=replace(state.world, steps=spread))

    @torch.inference_mode()
    def get_observations(self) -> TensorDict:
        """Agent -> (B, D), and `STATE` -> (B, sum of D, or more where it is privileged); new
        tensors each time."""
        return self.grouped(self.episodes.observe(self.state))

    def grouped(self, seen: Mapping[str, Tensor]) -> TensorDict:
        """Groups of observations from those of the agents in the present state."""
        joint = [seen[agent] for agent in self.task.agents]
        if self.privileged:
            arms = self.task.world.arms
            joint += [
                privileged_state(cast(ModelArm, arms[name]), part)
                for name, part in self.state.world.arms.items()
            ]
        return TensorDict({**seen, STATE: torch.cat(joint, 1)}, batch_size=[self.num_envs])

    @torch.inference_mode()
    def step(
        self, actions: Mapping[str, Tensor]
    ) -> tuple[TensorDict, dict[str, Tensor], Tensor, dict]:
        """Agent -> (B, m) shares of `action_kPa` in; observations, rewards, dones, extras out.

        rewards: agent -> (B,); dones: (B,) bool; extras hold `time_outs` (B,) bool, reward `terms`
        (agent -> term -> (B,)) and `measures` (name -> (B,)) of the step, as rsl-rl wants them.
        """
        asked = {agent: self.action_kPa * action for agent, action in actions.items()}
        state, outcome = self.episodes.step(self.state, asked)
        self.state = self.episodes.reset(state, outcome.done)
        extras = {
            "time_outs": outcome.truncated,
            "terms": outcome.terms,
            "measures": outcome.measures,
        }
        return self.get_observations(), outcome.rewards, outcome.done, extras


class OneAgentEnv(VecEnv):
    """rsl-rl's VecEnv for a task of one agent: groups NAME (the agent's) and `STATE`.

    `obs_groups` of a runner is then {"actor": [NAME], "critic": ["state"]}; docs/training.md has an
    example.
    """

    def __init__(self, task: Task, count: int, seed: int = 0, action_kPa: float = 1.0):
        """Episodes 0 to `count - 1` of a seed, each at another point of its time.

        action_kPa: change of the commanded pressure for an action of 1, kPa; `Pneumatics.step_kPa`
        limits it. Raises InputError for a task of several agents.
        """
        if len(task.agents) != 1:
            raise InputError(
                f"task '{task.name}' has agents {', '.join(task.agents)}, expected one; "
                "use JointEnv"
            )
        self.joint, self.agent = JointEnv(task, count, seed, action_kPa), task.agents[0]
        self.num_envs, self.num_actions = count, task.world.arms[self.agent].chambers
        self.max_episode_length, self.device = task.steps, task.world.device
        self.cfg = {"task": task.name, "seed": seed, "action_kPa": action_kPa}

    @property
    def episode_length_buf(self) -> Tensor:
        """(B,) int64: steps since each episode began."""
        return self.joint.state.world.steps

    @episode_length_buf.setter
    def episode_length_buf(self, steps: Tensor) -> None:
        state = self.joint.state
        self.joint.state = replace(state, world=replace(state.world, steps=steps))

    def get_observations(self) -> TensorDict:
        """Present observations, as rsl-rl expects them."""
        return self.joint.get_observations()

    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict]:
        """Advance one step: (observations, rewards (B,), dones (B,), extras)."""
        seen, rewards, dones, extras = self.joint.step({self.agent: actions})
        log = {f"/{name}": value.mean() for name, value in extras["terms"][self.agent].items()}
        return seen, rewards[self.agent], dones, {"time_outs": extras["time_outs"], "log": log}
