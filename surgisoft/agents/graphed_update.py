"""PPO's update on an NVIDIA GPU as one CUDA graph: all epochs and minibatches in one launch.

An update is some four thousand small operations, and the divergence to which rsl-rl adapts the
learning rate is read by the processor in every minibatch. Here the rate is a number on the GPU and
adapted there, by rsl-rl's rule; weights agree with rsl-rl's to rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from torch import Tensor, nn

from surgisoft.agents.ppo_loss import PPOLoss
from surgisoft.agents.shared_ppo import LEAST_RATE, MOST_RATE, RATE_FACTOR, adapts_rate
from surgisoft.cuda_graph import cuda_graph, recorded


class GraphedUpdate:
    """Updates an agent as `PPO.update` does; the order of its minibatches is drawn once an update,
    and no other random number."""

    def __init__(self, ppo: PPO, record: Callable[..., Any] = cuda_graph):
        """record: what makes graphs; in place of `cuda_graph` where there is no GPU."""
        self.ppo, self._record, self._loss = ppo, record, PPOLoss(ppo)
        self._made_for: tuple[int, ...] | None = None
        self._work: Callable[[], None] = self._minibatches

    def __call__(self) -> dict[str, float]:
        """Learn from the rollout in the agent's storage; the means of its losses."""
        ppo, storage = self.ppo, self.ppo.storage
        self._place()
        self._order.copy_(torch.randperm(len(self._order), device=ppo.device))
        self._advantages.copy_(storage.advantages)
        self._rate.fill_(ppo.learning_rate)
        self._sums.zero_()
        groups = ppo.optimizer.param_groups
        capturable = groups[0]["capturable"]
        for group in groups:
            group.update(lr=self._rate, capturable=True)
        if self._made_for != self._places():
            self._work = self._recorded()
            self._made_for = self._places()
        self._work()
        number = ppo.num_learning_epochs * ppo.num_mini_batches
        *means, rate = torch.cat((self._sums / number, self._rate[None])).tolist()
        if adapts_rate(ppo):
            ppo.learning_rate = rate
        for group in groups:
            group.update(lr=ppo.learning_rate, capturable=capturable)
        seen = storage.observations.flatten(0, 1)
        for network in (ppo.actor, ppo.critic):
            network.update_normalization(seen)
        storage.clear()
        return dict(zip(("value", "surrogate", "entropy"), means, strict=True))

    def _place(self) -> None:
        """Tensors in which the graph finds what changes between updates."""
        if self._made_for is not None:
            return
        ppo, storage = self.ppo, self.ppo.storage
        rows = storage.num_envs * storage.num_transitions_per_env
        whole = rows // ppo.num_mini_batches * ppo.num_mini_batches
        self._order = torch.zeros(whole, dtype=torch.int64, device=ppo.device)
        self._advantages = torch.zeros_like(storage.returns)
        self._rate = torch.zeros((), device=ppo.device)
        self._sums = torch.zeros(3, device=ppo.device)

    def _places(self) -> tuple[int, ...]:
        """Addresses of what a checkpoint replaces: the memory of Adam."""
        states = self.ppo.optimizer.state.values()
        return tuple(state["exp_avg"].data_ptr() for state in states)

    def _recorded(self) -> Callable[[], None]:
        """The minibatches as a graph; the agent is as before."""
        ppo, optimizer = self.ppo, self.ppo.optimizer
        held = [self._rate, self._sums, *ppo.actor.parameters(), *ppo.critic.parameters()]
        held += [value for state in optimizer.state.values() for value in state.values()]
        before = [(value, value.detach().clone()) for value in held]
        fresh = not optimizer.state

        @torch.no_grad()
        def restore() -> None:
            for value, old in before:
                value.copy_(old)
            if fresh:
                for state in optimizer.state.values():
                    for value in state.values():
                        value.zero_()

        device = torch.device(ppo.device)
        return recorded(self._minibatches, restore, device, self._record, "the update of PPO")

    def _minibatches(self) -> None:
        """All minibatches of an update: gathered, differentiated, and a step of Adam for each."""
        ppo, storage = self.ppo, self.ppo.storage
        seen = storage.observations.flatten(0, 1)
        networks = (ppo.actor, ppo.critic)
        inputs = [torch.cat([seen[group] for group in n.obs_groups], dim=-1) for n in networks]
        whole = (
            storage.actions,
            storage.values,
            self._advantages,
            storage.returns,
            storage.actions_log_prob,
            *storage.distribution_params,
        )
        whole = (*inputs, *(value.flatten(0, 1) for value in whole))
        batches = [
            [value.index_select(0, index) for value in whole]
            for index in self._order.chunk(ppo.num_mini_batches)
        ]
        for _ in range(ppo.num_learning_epochs):
            for batch in batches:
                self._learn(batch)

    def _learn(self, batch: list[Tensor]) -> None:
        ppo = self.ppo
        ppo.optimizer.zero_grad()
        loss, value, surrogate, chaos, apart = self._loss(*batch)
        loss.backward()
        if adapts_rate(ppo):
            most, least = 2.0 * ppo.desired_kl, 0.5 * ppo.desired_kl
            slower = (self._rate / RATE_FACTOR).clamp(min=LEAST_RATE)
            faster = (self._rate * RATE_FACTOR).clamp(max=MOST_RATE)
            rate = torch.where((apart > 0.0) & (apart < least), faster, self._rate)
            self._rate.copy_(torch.where(apart > most, slower, rate))
        for network in (ppo.actor, ppo.critic):
            nn.utils.clip_grad_norm_(network.parameters(), ppo.max_grad_norm)
        ppo.optimizer.step()
        self._sums.add_(torch.stack((value, surrogate, chaos)))
