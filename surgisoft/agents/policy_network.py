"""Networks of actors and critics that rsl-rl trains."""

from __future__ import annotations

import math

from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from torch import Tensor, nn

from surgisoft.agents.compiled_network import CompiledNetwork
from surgisoft.agents.presets import Preset

LOG_2_PI = math.log(2.0 * math.pi)


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


class ActionNoise(GaussianDistribution):
    """Gaussian actions whose deviation is one for all rows: rsl-rl's, with fewer operations.

    rsl-rl asks PyTorch's `Normal`, which takes logarithms of the deviation row by row, for the
    likelihood, for the entropy and for the divergence of every minibatch.
    """

    def _deviation(self) -> Tensor:
        """(m,) standard deviations of the present parameters."""
        return self.log_std_param.clamp(*self.log_std_range).exp()

    def log_prob(self, outputs: Tensor) -> Tensor:
        """(B,) log-likelihood of outputs (B, m)."""
        deviation = self._deviation()
        square = ((outputs - self.mean) / deviation).square().sum(dim=-1)
        return -0.5 * square - (deviation.log() + 0.5 * LOG_2_PI).sum()

    @property
    def entropy(self) -> Tensor:
        """(B,) entropy, in every row the same."""
        one = (self._deviation().log() + 0.5 * (1.0 + LOG_2_PI)).sum()
        return one.expand(self.mean.shape[:-1])

    def kl_divergence(
        self, old_params: tuple[Tensor, ...], new_params: tuple[Tensor, ...]
    ) -> Tensor:
        """(B,) Kullback-Leibler divergence of old from new means (B, m) and deviations (B, m).

        The deviation is the same in all rows, because parameters stay while a rollout is collected.
        """
        (old_mean, old), (new_mean, new) = old_params, new_params
        ratio = (old[:1] / new[:1]).square()
        apart = ((old_mean - new_mean) / new[:1]).square().sum(dim=-1)
        return 0.5 * (apart + (ratio - 1.0 - ratio.log()).sum())


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
