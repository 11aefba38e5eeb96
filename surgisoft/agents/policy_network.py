"""Networks of actors and critics that rsl-rl trains."""

from __future__ import annotations

import math

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from torch import Tensor, nn

from surgisoft.agents.compiled_network import CompiledNetwork
from surgisoft.agents.presets import Preset

LOG_2_PI = math.log(2.0 * math.pi)
SAME = 1e-9
"""Largest divergence of a policy from itself: products of a row are rounded by the batch that it is
in, which makes up to 2e-12. One step of Adam makes 1e-5 and more."""


def network_config(preset: Preset) -> dict:
    """rsl-rl's arguments of an actor or critic: a new dict each time, because rsl-rl changes it."""
    return {
        "hidden_dims": list(preset.hidden),
        "activation": preset.activation,
        "obs_normalization": preset.normalise,
    }


def noise_config(preset: Preset) -> dict:
    """rsl-rl's arguments of an actor's distribution."""
    return {
        "class_name": ActionNoise,
        "init_std": preset.noise,
        "std_type": "log",
        "learn_std": preset.last_noise is None,
    }


def log_likelihood(outputs: Tensor, mean: Tensor, deviation: Tensor) -> Tensor:
    """(B,) log-likelihood of outputs (B, m) under Gaussians with means (B, m), deviations (m,)."""
    square = ((outputs - mean) / deviation).square().sum(dim=-1)
    return -0.5 * square - (deviation.log() + 0.5 * LOG_2_PI).sum()


def entropy(deviation: Tensor) -> Tensor:
    """Entropy of a Gaussian with deviations (m,)."""
    return (deviation.log() + 0.5 * (1.0 + LOG_2_PI)).sum()


def divergence(old_mean: Tensor, old: Tensor, new_mean: Tensor, new: Tensor) -> Tensor:
    """(B,) Kullback-Leibler divergence of old from new Gaussians; zero where they are the same.

    rsl-rl leaves the learning rate as it is where the mean divergence is zero, as in the first
    minibatch of an update. Means are (B, m); the deviations, (m,) or (1, m), are the same in all
    rows, because parameters stay while a rollout is collected.
    """
    ratio = (old / new).square()
    apart = ((old_mean - new_mean) / new).square().sum(dim=-1)
    found = 0.5 * (apart + (ratio - 1.0 - ratio.log()).sum())
    return found.where(found.mean() > SAME, 0.0)


class ActionNoise(GaussianDistribution):
    """Gaussian actions whose deviation is one for all rows: rsl-rl's, with fewer operations.

    rsl-rl asks PyTorch's `Normal`, which takes logarithms of the deviation row by row, for the
    likelihood, for the entropy and for the divergence of every minibatch.
    """

    def deviation(self) -> Tensor:
        """(m,) standard deviations of the present parameters."""
        return self.log_std_param.clamp(*self.log_std_range).exp()

    def sample(self) -> Tensor:
        """(B, m) outputs, drawn."""
        mean = self.mean
        if mean.device.type == "cpu":
            return super().sample()
        # PyTorch's `normal` waits for an accelerator, to check that no deviation is negative.
        return torch.addcmul(mean, self.deviation(), torch.randn_like(mean))

    def log_prob(self, outputs: Tensor) -> Tensor:
        """(B,) log-likelihood of outputs (B, m)."""
        return log_likelihood(outputs, self.mean, self.deviation())

    @property
    def entropy(self) -> Tensor:
        """(B,) entropy, in every row the same."""
        return entropy(self.deviation()).expand(self.mean.shape[:-1])

    def kl_divergence(
        self, old_params: tuple[Tensor, ...], new_params: tuple[Tensor, ...]
    ) -> Tensor:
        """(B,) Kullback-Leibler divergence of old from new means (B, m) and deviations (B, m)."""
        (old_mean, old), (new_mean, new) = old_params, new_params
        return divergence(old_mean, old[:1], new_mean, new[:1])


def acting(actor: MLPModel) -> nn.Module:
    """A copy of an actor that acts as a saved policy does: observations (B, D) in, outputs (B, m).

    What is evaluated during a training is then what the saved policy computes, to the last bit.
    """
    network = actor.as_jit()
    network.mlp = nn.Sequential(*network.mlp)
    return network


def compile_network(network: MLPModel) -> None:
    """Let an actor or critic that is trained compute by `CompiledNetwork`, where it has tanh."""
    if CompiledNetwork.fits(network.mlp):
        network.mlp = CompiledNetwork(*network.mlp)
