"""Rollouts on an NVIDIA GPU as CUDA graphs: acting, the step of the world and rsl-rl's storage.

A step of a rollout is three launches: one graph from the observations to the rewards, one that puts
them in the storage, one that observes. Where episodes end, a fourth begins them anew.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from tensordict import TensorDict
from torch import Tensor

from surgisoft.agents.ppo import MEASURE, RolloutMeans, collect_rollout, groups_of
from surgisoft.agents.vec_env import JointEnv
from surgisoft.cuda_graph import cuda_graph, recorded
from surgisoft.tasks.base import Outcome
from surgisoft.tasks.graphed import GraphedEpisodes, overwrite


def rollouts(
    env: JointEnv, agents: dict[str, PPO], steps: int
) -> Callable[[TensorDict], tuple[TensorDict, RolloutMeans]]:
    """A function that rolls out agents for `steps` steps: observations in, the last ones and means
    out, and the steps in the agents' storages. On a GPU by CUDA graphs."""
    if isinstance(env.episodes, GraphedEpisodes):
        return GraphedRollout(env, agents, steps)
    return lambda seen: collect_rollout(env, agents, seen, steps)


class GraphedRollout:
    """Rolls out agents in an environment whose episodes are `GraphedEpisodes`."""

    def __init__(
        self,
        env: JointEnv,
        agents: dict[str, PPO],
        steps: int,
        record: Callable[..., Any] = cuda_graph,
    ):
        """record: what makes graphs; in place of `cuda_graph` where there is no GPU."""
        assert isinstance(env.episodes, GraphedEpisodes)
        self.env, self.agents, self.steps = env, agents, steps
        self._episodes, self._record = env.episodes, record
        groups = {agent: groups_of(agent, agents, env.privileged) for agent in agents}
        self._seen = env.get_observations()
        self._views = {agent: self._seen.select(*groups[agent]) for agent in agents}
        self._work: dict[str, Callable[[], Any]] = {}
        self.latest: tuple[dict[str, Tensor], Tensor, Tensor, dict[str, Tensor]] | None = None
        """Results of the last step, see `stepped`."""
        self._transitions: dict[str, Any] = {}
        self._notes: Tensor | None = None

    @torch.inference_mode()
    def __call__(self, seen: TensorDict) -> tuple[TensorDict, RolloutMeans]:
        """Roll out from observations into the agents' storages; last observations, and means."""
        env = self.env
        env.state = self._episodes.held(env.state)
        overwrite(self._seen.to_dict(), seen.to_dict())
        for k in range(self.steps):
            self.latest = latest = self._done("step", self.stepped)
            self._store(k)
            env.state = self._episodes.reset(env.state, latest[1])
            self._done("observation", self._observed)
        means = self._done("returns", self._ended).tolist()
        rows = self.steps * env.num_envs
        return self._seen.clone(), RolloutMeans.of(dict(zip(latest[3], means, strict=True)), rows)

    def stepped(self) -> tuple[dict[str, Tensor], Tensor, Tensor, dict[str, Tensor]]:
        """Act and step: rewards by agent, dones, time-outs, and everything by its name."""
        asked = {}
        for agent, ppo in self.agents.items():
            asked[agent] = self.env.action_kPa * ppo.act(self._views[agent])
            self._transitions[agent] = copy.copy(ppo.transition)
        outcome = self._episodes.advanced(asked).views()
        return outcome.rewards, outcome.done, outcome.truncated, notes_of(outcome)

    def _store(self, k: int) -> None:
        """Put the step in the storages: by a graph, if the results of a step have fixed places."""
        work = functools.partial(self._stored, k)
        if self._work["step"] == self.stepped:  # no graph could be made of it
            work()
        else:
            self._done(f"storage {k}", work)

    def _stored(self, k: int) -> None:
        """Put the step in the agents' storages as number k."""
        assert self.latest is not None
        rewards, done, late, notes = self.latest
        for agent, ppo in self.agents.items():
            ppo.transition, ppo.storage.step = copy.copy(self._transitions[agent]), k
            ppo.process_env_step(self._views[agent], rewards[agent], done, {"time_outs": late})
        values = torch.stack([value.float() for value in notes.values()])
        if self._notes is None:
            self._notes = values.new_zeros(self.steps, *values.shape)
        self._notes[k].copy_(values)

    def _observed(self) -> None:
        seen = self.env.grouped(self._episodes.plain.observe(self.env.state))
        overwrite(self._seen.to_dict(), seen.to_dict())

    def _ended(self) -> Tensor:
        """Returns and advantages of the agents; the mean of every note, of measures where they are
        finite."""
        for agent, ppo in self.agents.items():
            ppo.compute_returns(self._views[agent])
        assert self._notes is not None
        assert self.latest is not None
        every = self._notes.transpose(0, 1).flatten(1)
        known = every.isfinite()
        # By slices: a graph cannot copy a list of names. Measures stand between terms and `done`.
        measures = sum(name.startswith(MEASURE) for name in self.latest[3])
        known[: len(every) - 1 - measures] = True
        return every.where(known, 0.0).sum(1) / known.sum(1)

    def _done(self, name: str, work: Callable[[], Any]) -> Any:
        """The results of a recorded function, which is recorded at its first call."""
        if name not in self._work:
            before, restore_state = self._seen.clone(), self._episodes.kept()

            def restore() -> None:
                restore_state()
                overwrite(self._seen.to_dict(), before.to_dict())

            what, device = f"the {name} of a rollout", self.env.task.world.device
            self._work[name] = recorded(work, restore, device, self._record, what)
        return self._work[name]()


def notes_of(outcome: Outcome) -> dict[str, Tensor]:
    """What a training reports of a step: rewards, their terms, measures and ends, each (B,)."""
    notes = {f"reward/{agent}": value for agent, value in outcome.rewards.items()}
    for agent, terms in outcome.terms.items():
        notes |= {f"term/{agent}/{term}": value for term, value in terms.items()}
    notes |= {f"{MEASURE}{name}": value for name, value in outcome.measures.items()}
    return {**notes, "done": outcome.done}
