"""Networks of actors and critics for rsl-rl, and the actor with its outputs scaled to kPa."""

from __future__ import annotations

import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import Tensor, nn

from surgisoft.agents.presets import Preset


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
        "class_name": "GaussianDistribution",
        "init_std": preset.noise,
        "std_type": "log",
        "learn_std": preset.last_noise is None,
    }


def empty_actor(agent: str, width: int, chambers: int, preset: Preset) -> MLPModel:
    """An untrained actor: (B, width) observations in, (B, chambers) outputs out."""
    seen = TensorDict({agent: torch.zeros(1, width)}, batch_size=[1])
    config = {**network_config(preset), "distribution_cfg": noise_config(preset)}
    return MLPModel(seen, {"actor": [agent]}, "actor", chambers, **config)


class ScaledActor(nn.Module):
    """An actor with action scaling: (B, D) observations to (B, m) changes of pressure, kPa."""

    def __init__(self, actor: MLPModel, action_kPa: float, step_kPa: float):
        """Scale an actor: action_kPa per output of 1, clipped to the pumps' limit step_kPa."""
        super().__init__()
        self.network, self.scale, self.limit = actor.as_jit(), action_kPa, step_kPa

    def forward(self, observation: Tensor) -> Tensor:
        """Actions (B, m) kPa, within the limits of the pumps, from observations (B, D)."""
        return (self.scale * self.network(observation)).clamp(-self.limit, self.limit)
