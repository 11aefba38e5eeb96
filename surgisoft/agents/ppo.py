"""Independent PPO with centralised critics: one rsl-rl PPO for each agent of a shared world.

Centralised training with decentralised execution (CTDE): an actor sees its agent's observation,
its critic the observations of all agents (`vec_env.STATE`), a privileged input that only training
needs. Agents share neither networks nor rewards (independent learners; De Witt et al. 2020, IPPO;
with the joint observation in the critic as in MAPPO, Yu et al. 2022).
"""

from __future__ import annotations

import contextlib
import copy
import functools
import io
import math
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from tensordict import TensorDict
from torch import Tensor

from surgisoft.agents.compiled_network import CompiledNetwork
from surgisoft.agents.compiled_update import compiled_update
from surgisoft.agents.distributed import Processes
from surgisoft.agents.graphed_update import GraphedUpdate
from surgisoft.agents.policy_network import (
    compile_network,
    network_config,
    noise_config,
)
from surgisoft.agents.presets import Preset
from surgisoft.agents.shared_ppo import SharedPPO
from surgisoft.agents.vec_env import STATE, JointEnv
from surgisoft.threads import rows_on_threads


def algorithm_config(agent: str, preset: Preset, processes: Processes, critic: str = STATE) -> dict:
    """rsl-rl's configuration of one agent; a fresh one each time, for rsl-rl writes into it.

    critic: the group of observations that the critic sees.
    """
    return {
        "obs_groups": {"actor": [agent], "critic": [critic]},
        "num_steps_per_env": preset.rollout,
        "actor": {
            "class_name": "MLPModel",
            **network_config(preset),
            "distribution_cfg": noise_config(preset),
        },
        "critic": {"class_name": "MLPModel", **network_config(preset)},
        "algorithm": {
            "class_name": class_of(processes),
            "num_learning_epochs": preset.epochs,
            "num_mini_batches": preset.batches,
            "gamma": preset.gamma,
            "lam": preset.lam,
            "clip_param": preset.clip,
            "entropy_coef": preset.entropy,
            "learning_rate": preset.learning_rate,
            "schedule": "fixed" if preset.desired_kl is None else "adaptive",
            "desired_kl": preset.desired_kl,
        },
        "multi_gpu": processes.rsl_rl,
    }


def groups_of(agent: str, agents: Collection[str], privileged: bool = False) -> tuple[str, ...]:
    """Groups that an agent's actor (the first) and its critic (the last) see.

    One where the agent is alone and the critic not privileged.
    """
    return (agent, STATE) if len(agents) > 1 or privileged else (agent,)


def class_of(processes: Processes) -> type[PPO]:
    """The class of a process's agents."""
    return SharedPPO if processes.count > 1 else PPO


def make_ppo(env: JointEnv, preset: Preset, processes: Processes) -> dict[str, PPO]:
    """One PPO for each agent: an actor on its observation, a critic on the joint state."""
    seen, by_agent, device = env.get_observations().clone(), {}, env.task.world.device
    for agent in env.task.agents:
        view = SimpleNamespace(
            num_envs=env.num_envs, num_actions=env.task.world.arms[agent].chambers
        )
        groups = groups_of(agent, env.task.agents, env.privileged)
        config = algorithm_config(agent, preset, processes, groups[-1])
        with contextlib.redirect_stdout(io.StringIO()):
            ppo = PPO.construct_algorithm(seen.select(*groups), view, config, str(device))
        with torch.no_grad():
            # Before it has learned anything a policy asks for next to nothing.
            ppo.get_policy().mlp[-1].weight.mul_(0.01)
            ppo.get_policy().mlp[-1].bias.zero_()
        for network in (ppo.actor, ppo.critic):
            compile_network(network)
        for group in ppo.optimizer.param_groups:
            # One call for all weights instead of a dozen small ones for each.
            group["fused"] = True
        each = ppo.storage.mini_batch_generator
        ppo.storage.mini_batch_generator = functools.partial(gathered_once, each)
        if isinstance(ppo, SharedPPO):
            ppo.talk_once()
        if torch.device(ppo.device).type == "cuda":
            if processes.count == 1:  # else gradients are exchanged in every minibatch
                ppo.update = GraphedUpdate(ppo)
        elif preset.compile:
            ppo.update = compiled_update(ppo)
        ppo.train_mode()
        by_agent[agent] = ppo
    return by_agent


def gathered_once(
    generator: Callable[..., Iterator[Any]], batches: int, epochs: int
) -> Iterator[Any]:
    """rsl-rl's minibatches, gathered in the first epoch and given again in the others.

    rsl-rl draws one order for all epochs but gathers every minibatch anew in each, which is a
    tenth of an update.
    """
    held = list(generator(batches, 1))
    for _ in range(epochs):
        for batch in held:
            yield copy.copy(batch)


def set_noise(ppo: PPO, preset: Preset, progress: float) -> None:
    """The actions' deviation after a share 0..1 of the training, where it is scheduled."""
    if preset.last_noise is not None:
        first, last = math.log(preset.noise), math.log(preset.last_noise)
        with torch.no_grad():
            ppo.get_policy().distribution.log_std_param.fill_(first + progress * (last - first))


def update(ppo: PPO) -> dict[str, float]:
    """rsl-rl's update of an agent from its rollout; the means of its losses.

    Compiled networks divide the rows among the threads of torch, which others use themselves.
    """
    networks = (ppo.get_policy(), ppo.critic)
    if all(isinstance(each.mlp, CompiledNetwork) for each in networks):
        with rows_on_threads():
            return ppo.update()
    return ppo.update()


MEASURE = "measure/"
"""What the names of measures begin with, among the means of a rollout."""


@dataclass(frozen=True, eq=False)
class RolloutMeans:
    """Means over the steps of a rollout."""

    rewards: dict[str, float]
    """agent -> reward of a step."""
    terms: dict[str, float]
    """agent/term -> reward of a step; nan or infinite where it was in any step."""
    measures: dict[str, float]
    """name -> measure, where it applies; nan where it never did."""
    episodes: int
    """Episodes that came to their end."""

    @classmethod
    def of(cls, means: dict[str, float], rows: int) -> RolloutMeans:
        """From means over so many rows by the names `reward/AGENT`, `term/AGENT/TERM`,
        `measure/NAME` and `done`."""

        def part(prefix: str) -> dict[str, float]:
            return {n.removeprefix(prefix): v for n, v in means.items() if n.startswith(prefix)}

        return cls(part("reward/"), part("term/"), part(MEASURE), round(means["done"] * rows))


@torch.inference_mode()
@rows_on_threads()
def collect_rollout(env: JointEnv, agents: dict[str, PPO], seen: TensorDict, steps: int):
    """Roll out `steps` steps into the agents' storages; last observations and `RolloutMeans`."""
    notes: dict[str, list[Tensor]] = {}

    def note(name: str, value: Tensor) -> None:
        notes.setdefault(name, []).append(value)

    groups = {agent: groups_of(agent, agents, env.privileged) for agent in agents}
    for _ in range(steps):
        actions = {agent: ppo.act(seen.select(*groups[agent])) for agent, ppo in agents.items()}
        seen, rewards, dones, extras = env.step(actions)
        for agent, ppo in agents.items():
            ppo.process_env_step(
                seen.select(*groups[agent]),
                rewards[agent],
                dones,
                {"time_outs": extras["time_outs"]},
            )
            note(f"reward/{agent}", rewards[agent])
            for term, value in extras["terms"][agent].items():
                note(f"term/{agent}/{term}", value)
        for name, value in extras["measures"].items():
            note(f"{MEASURE}{name}", value)
        note("done", dones)
    for agent, ppo in agents.items():
        ppo.compute_returns(seen.select(*groups[agent]))
    means = {name: _mean(values, name) for name, values in notes.items()}
    return seen, RolloutMeans.of(means, steps * env.num_envs)


def _mean(values: list[Tensor], name: str) -> float:
    """Mean of (T, B) values; of a measure that of its finite ones, nan where nothing is."""
    every = torch.stack(values).float()
    known = (
        every.isfinite() if name.startswith(MEASURE) else torch.ones_like(every, dtype=torch.bool)
    )
    return (every.where(known, 0.0).sum() / known.sum()).item()
