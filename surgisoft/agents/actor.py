"""Actors as they act: what a saved policy computes, without the library that trains it.

A checkpoint holds the weights of rsl-rl's actors (`agents/policy_network.py`). Importing rsl-rl
takes as long as PyTorch itself, and acting needs nothing of it but a multi-layer perceptron, so
the networks here have the same parameters by the same names and compute the same numbers.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor, nn

from surgisoft.agents.presets import Preset

ACTIVATION: dict[str, Callable[[], nn.Module]] = {
    "elu": nn.ELU,
    "selu": nn.SELU,
    "relu": nn.ReLU,
    "crelu": nn.CELU,
    "lrelu": nn.LeakyReLU,
    "tanh": nn.Tanh,
    "sigmoid": nn.Sigmoid,
    "softplus": nn.Softplus,
    "gelu": nn.GELU,
    "swish": nn.SiLU,
    "mish": nn.Mish,
    "identity": nn.Identity,
}
"""The activations of `presets.ACTIVATIONS` by rsl-rl's names."""
NORMALISER_EPS = 1e-2
"""What rsl-rl's normaliser adds to the deviation of an observation (dimensionless)."""


class Normaliser(nn.Module):
    """Observations less their running mean over their running deviation, both fixed."""

    _mean: Tensor
    _std: Tensor

    def __init__(self, width: int):
        """A normaliser of observations of a width, to be filled from a checkpoint."""
        super().__init__()
        for name, value in (("_mean", 0.0), ("_var", 1.0), ("_std", 1.0)):
            self.register_buffer(name, torch.full((1, width), value))
        self.register_buffer("count", torch.tensor(0, dtype=torch.long))

    def forward(self, observation: Tensor) -> Tensor:
        """Normalised observations (B, D)."""
        return (observation - self._mean) / (self._std + NORMALISER_EPS)


class Noise(nn.Module):
    """The deviation of exploration noise: part of every checkpoint, and not of the action."""

    def __init__(self, chambers: int):
        """Parameters for a number of chambers, to be filled from a checkpoint."""
        super().__init__()
        self.log_std_param = nn.Parameter(torch.zeros(chambers))


class Actor(nn.Module):
    """An actor's mean action: (B, D) observations in, (B, m) outputs out."""

    def __init__(self, width: int, chambers: int, preset: Preset):
        """An untrained actor of a preset, for observations of a width."""
        super().__init__()
        self.obs_normalizer = Normaliser(width) if preset.normalise else nn.Identity()
        self.distribution = Noise(chambers)
        layers: list[nn.Module] = []
        for size in preset.hidden:
            layers += [nn.Linear(width, size), ACTIVATION[preset.activation]()]
            width = size
        self.mlp = nn.Sequential(*layers, nn.Linear(width, chambers))

    def forward(self, observation: Tensor) -> Tensor:
        """Outputs (B, m) without noise, in units of `Preset.action_kPa`."""
        return self.mlp(self.obs_normalizer(observation))


class ScaledActor(nn.Module):
    """An actor with action scaling: (B, D) observations to (B, m) changes of pressure, kPa."""

    def __init__(self, network: nn.Module, action_kPa: float, step_kPa: float):
        """Scale a network: action_kPa per output of 1, clipped to the pumps' limit step_kPa."""
        super().__init__()
        self.network, self.scale, self.limit = network, action_kPa, step_kPa

    def forward(self, observation: Tensor) -> Tensor:
        """Actions (B, m) kPa, within the limits of the pumps, from observations (B, D)."""
        return (self.scale * self.network(observation)).clamp(-self.limit, self.limit)
