"""rsl-rl's losses of PPO as a function of tensors, for what compiles or records an update."""

from __future__ import annotations

from typing import cast

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from torch import Tensor, nn

from surgisoft.agents.policy_network import ActionNoise, divergence, entropy, log_likelihood


class PPOLoss(nn.Module):
    """rsl-rl's losses of a minibatch as one function of tensors."""

    def __init__(self, ppo: PPO):
        super().__init__()
        self.actor, self.critic = ppo.actor, ppo.critic
        self.noise = cast(ActionNoise, ppo.actor.distribution)
        self.clip, self.value_weight = ppo.clip_param, ppo.value_loss_coef
        self.entropy_weight = ppo.entropy_coef

    def forward(
        self,
        seen: Tensor,
        seen_by_critic: Tensor,
        actions: Tensor,
        old_values: Tensor,
        advantages: Tensor,
        returns: Tensor,
        old_log_likelihood: Tensor,
        old_mean: Tensor,
        old_deviation: Tensor,
    ) -> tuple[Tensor, ...]:
        """Loss, and its parts: of values, of actions, entropy; divergence from the old policy."""
        mean = _outputs(self.actor, seen)
        deviation = self.noise.deviation()
        values = _outputs(self.critic, seen_by_critic)
        ratio = (log_likelihood(actions, mean, deviation) - old_log_likelihood.squeeze(-1)).exp()
        gain = -advantages.squeeze(-1)
        bounded = ratio.clamp(1.0 - self.clip, 1.0 + self.clip)
        surrogate = torch.max(gain * ratio, gain * bounded).mean()
        near = old_values + (values - old_values).clamp(-self.clip, self.clip)
        value = torch.max((values - returns).pow(2), (near - returns).pow(2)).mean()
        chaos = entropy(deviation)
        loss = surrogate + self.value_weight * value - self.entropy_weight * chaos
        apart = divergence(old_mean, old_deviation[0], mean.detach(), deviation.detach())
        return loss, value.detach(), surrogate.detach(), chaos.detach(), apart.mean()


def _outputs(network: MLPModel, seen: Tensor) -> Tensor:
    """Outputs of a network by its layers, which torch.compile sees through."""
    value = network.obs_normalizer(seen)
    for layer in network.mlp:
        value = layer(value)
    return value
