"""rsl-rl's PPO in several processes that exchange what they found once in a minibatch."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from torch import Tensor

LEAST_RATE, MOST_RATE = 1e-5, 1e-2
"""Bounds of the adapted learning rate, those of rsl-rl."""
RATE_FACTOR = 1.5
"""By which the learning rate is changed, that of rsl-rl."""


def adapts_rate(ppo: PPO) -> bool:
    """Whether an agent's learning rate is adapted to the divergence of an update."""
    if isinstance(ppo, SharedPPO):
        return ppo.adapts
    return ppo.desired_kl is not None and ppo.schedule == "adaptive"


def adapt_rate(ppo: PPO, divergence: float) -> None:
    """Change the learning rate by rsl-rl's rule."""
    if divergence > 2.0 * ppo.desired_kl:
        ppo.learning_rate = max(LEAST_RATE, ppo.learning_rate / RATE_FACTOR)
    elif 0.0 < divergence < ppo.desired_kl / 2.0:
        ppo.learning_rate = min(MOST_RATE, ppo.learning_rate * RATE_FACTOR)
    for group in ppo.optimizer.param_groups:
        group["lr"] = ppo.learning_rate


class SharedPPO(PPO):
    """rsl-rl's PPO for several processes that talk once in a minibatch in place of three times.

    rsl-rl exchanges the divergence that the learning rate is adapted to, then the learning rate,
    then the gradients. Every exchange is a wait of both processes, after which a processor's caches
    are cold. Here the divergence goes with the gradients, and each process adapts the learning rate
    by the same rule to the same number; the values are those of rsl-rl.
    """

    schedule: str
    learning_rate: float
    adapts = False
    """Whether the learning rate is adapted; rsl-rl's own `schedule` is `fixed` then."""
    batch: Any = None
    """The minibatch of the present update."""

    def talk_once(self) -> None:
        """Take over the adaptation of the learning rate from rsl-rl's update."""
        self.adapts = self.desired_kl is not None and self.schedule == "adaptive"
        self.schedule = "fixed"
        generator = self.storage.mini_batch_generator

        def noted(batches: int, epochs: int) -> Iterator[Any]:
            for batch in generator(batches, epochs):
                self.batch = batch
                yield batch

        self.storage.mini_batch_generator = noted

    def reduce_parameters(self) -> None:
        """Average gradients and divergence over the processes, and adapt the learning rate."""
        present = tuple(each.detach() for each in self.actor.output_distribution_params)
        old = self.batch.old_distribution_params
        self.exchange(self.actor.get_kl_divergence(old, present).mean() if self.adapts else None)

    @torch.no_grad()
    def exchange(self, divergence: Tensor | None) -> None:
        """Average the gradients, and adapt the learning rate where a divergence is given."""
        parameters = [*self.actor.parameters(), *self.critic.parameters()]
        gradients = [each.grad for each in parameters if each.grad is not None]
        parts = [each.view(-1) for each in gradients]
        if divergence is not None:
            parts.append(divergence.view(1))
        packed = torch.cat(parts)
        torch.distributed.all_reduce(packed, op=torch.distributed.ReduceOp.SUM)
        packed /= self.gpu_world_size
        found = packed.split([each.numel() for each in parts])
        for gradient, value in zip(gradients, found, strict=False):
            gradient.copy_(value.view_as(gradient))
        if divergence is not None:
            adapt_rate(self, found[-1].item())
            # Rounded to float32, as rsl-rl's exchange of it rounds.
            self.learning_rate = torch.tensor(self.learning_rate).item()
            for group in self.optimizer.param_groups:
                group["lr"] = self.learning_rate
