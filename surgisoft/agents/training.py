"""Training as a state that goes on: world, agents, random numbers; saved and loaded whole."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from surgisoft.agents.distributed import Processes
from surgisoft.agents.plan import Plan
from surgisoft.agents.ppo import Gathered, gather, make_ppo, set_noise
from surgisoft.agents.vec_env import JointEnv
from surgisoft.errors import InputError
from surgisoft.tasks.base import Task
from surgisoft.tasks.tree import tree_map

_FAR = 1 << 20
"""Episodes of different processes are further apart than this."""


@dataclass
class Clock:
    """Time that training took so far, over all its resumptions."""

    wall_s: float = 0.0
    """Wall time, s."""
    cpu_s: float = 0.0
    """Time of all threads of this process on a processor, s."""
    _last: tuple[float, float] = field(
        default_factory=lambda: (time.monotonic(), time.process_time())
    )

    def tick(self) -> None:
        """Count the time since the last tick."""
        now = (time.monotonic(), time.process_time())
        self.wall_s += now[0] - self._last[0]
        self.cpu_s += now[1] - self._last[1]
        self._last = now


@dataclass(frozen=True, eq=False)
class Iteration:
    """What one turn of rollout and update brought."""

    gathered: Gathered
    """Rewards and measures of the rollout."""
    losses: dict[str, float]
    """agent/loss -> value of the update."""
    learning_rate: float
    """Of the first agent's optimiser."""
    noise: float
    """Mean standard deviation of the first agent's actions, in outputs."""


class Training:
    """The agents of a task while they learn; `state` and `load_state` are all that changes.

    `iteration` counts the turns, `share` 0..1 is how much of the plan is done, `best` what
    evaluation found for the best policies so far.
    """

    def __init__(self, plan: Plan, task: Task, processes: Processes):
        self.plan, self.task, self.processes = plan, task, processes
        preset, rank = plan.preset, processes.rank
        torch.manual_seed(plan.seed)
        self.env = JointEnv(task, preset.envs, plan.seed, preset.action_kPa, rank * _FAR)
        self.agents = make_ppo(self.env, preset, processes)
        if processes.count > 1:
            torch.manual_seed(plan.seed + rank * _FAR)
            for ppo in self.agents.values():
                ppo.broadcast_parameters()
        self.seen = self.env.get_observations()
        self.iteration, self.clock = 0, Clock()
        self.best: dict[str, float] | None = None
        self.share = 0.0

    @property
    def steps(self) -> int:
        """Steps so far, over the episodes of all processes."""
        preset = self.plan.preset
        return self.iteration * preset.envs * preset.rollout * self.processes.count

    def _shared(self) -> float:
        """Share of the training that is done; all processes ask together."""
        seconds = 0.0
        if self.plan.minutes is not None:
            seconds = self.processes.of_leader(self.clock.wall_s)
        return self.plan.share(self.steps, seconds)

    def turn(self) -> Iteration:
        """One rollout, and one update of every agent."""
        preset = self.plan.preset
        for ppo in self.agents.values():
            set_noise(ppo, preset, self.share)
        self.seen, gathered = gather(self.env, self.agents, self.seen, preset.rollout)
        losses = {}
        for agent, ppo in self.agents.items():
            for name, value in ppo.update().items():
                losses[f"{agent}/{name}"] = value
        self.iteration += 1
        self.clock.tick()
        self.share = self._shared()
        first = next(iter(self.agents.values()))
        noise = first.get_policy().distribution.log_std_param.detach().exp().mean().item()
        return Iteration(gathered, losses, first.learning_rate, noise)

    def policies(self) -> dict[str, dict[str, Tensor]]:
        """agent -> weights of its actor, copied."""
        return {
            agent: _copied(ppo.save()["actor_state_dict"]) for agent, ppo in self.agents.items()
        }

    def state(self) -> dict[str, Any] | None:
        """All that goes on from here, as plain tensors and numbers; None but in the leader.

        Worlds and random numbers are those of every process, in the order of their ranks.
        """
        parts: list[Tensor] = []
        tree_map(lambda value: parts.append(value.detach().cpu().clone()) or value, self.env.state)
        device, random = self.task.world.device, {"cpu": torch.get_rng_state()}
        if device.type == "cuda":
            random["cuda"] = torch.cuda.get_rng_state(device)
        own = {"world": parts, "random": random}
        everyone = self.processes.gather(own)
        if everyone is None:
            return None
        agents = {
            agent: {**ppo.save(), "learning_rate": ppo.learning_rate}
            for agent, ppo in self.agents.items()
        }
        return {
            "iteration": self.iteration,
            "wall_s": self.clock.wall_s,
            "cpu_s": self.clock.cpu_s,
            "best": self.best,
            "agents": agents,
            "processes": everyone,
        }

    def load_state(self, saved: dict[str, Any]) -> None:
        """Go on from a saved state; as many processes as it was saved by."""
        count, device = len(saved["processes"]), self.task.world.device
        if count != self.processes.count:
            raise InputError(
                f"the run was trained by {count} processes, came {self.processes.count}; resume "
                f"it with torchrun --nproc-per-node {count}"
            )
        for agent, ppo in self.agents.items():
            content = dict(saved["agents"][agent])
            rate = content.pop("learning_rate")
            ppo.load(content, None, strict=True)
            ppo.learning_rate = rate
        own = saved["processes"][self.processes.rank]
        parts = iter(own["world"])
        with torch.inference_mode():
            self.env.state = tree_map(lambda _: next(parts).to(device).clone(), self.env.state)
        self.seen = self.env.get_observations()
        torch.set_rng_state(own["random"]["cpu"].cpu())
        if device.type == "cuda":
            torch.cuda.set_rng_state(own["random"]["cuda"].cpu(), device)
        self.iteration, self.best = saved["iteration"], saved["best"]
        self.clock = Clock(saved["wall_s"], saved["cpu_s"])
        self.share = self._shared()


def _copied(weights: dict[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.detach().cpu().clone() for name, value in weights.items()}
