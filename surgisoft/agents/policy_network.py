"""Networks of actors and critics that rsl-rl trains."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules.distribution import GaussianDistribution
from torch import Tensor, nn

from surgisoft.agents.presets import Preset
from surgisoft.compiled import compiled

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
    _exchange_activations(network.mlp, CompiledTanh, nn.Tanh)
    return network


# The hyperbolic tangent ----------------------------------------------------------------------

PADE = 12
"""Order of the Pade approximant of exp(2 x) that the compiled tanh takes: within 5e-8 of tanh up
to `SATURATED`, which is less than the rounding of float32 there."""
LEAST_COMPILED = 1 << 14
"""Fewest numbers for which a call of the compiled loop, 10 to 30 us, costs less than it saves."""
SATURATED = np.float32(9.2)
"""Argument beyond which tanh is 1 in float32."""
_TERMS = [
    math.comb(PADE, k) * math.factorial(2 * PADE - k) * 2.0**k / math.factorial(2 * PADE)
    for k in range(PADE + 1)
]
ODD = np.array(_TERMS[1::2][::-1], np.float32)
EVEN = np.array(_TERMS[0::2][::-1], np.float32)
"""Terms of odd and of even powers of the approximant's numerator, the highest first: with N(x) its
numerator exp(2 x) is N(x) / N(-x) and tanh x is N's odd part over its even part (Pade 1892)."""


@compiled
def _tanh(x, out):
    """tanh of x (N,) into out (N,)."""
    for i in range(len(x)):
        value = x[i]
        value = SATURATED if value > SATURATED else value
        value = -SATURATED if value < -SATURATED else value
        square = value * value
        above, below = ODD[0], EVEN[0]
        for k in range(1, len(ODD)):
            above = above * square + ODD[k]
        for k in range(1, len(EVEN)):
            below = below * square + EVEN[k]
        out[i] = value * above / below


def _compiled_tanh(x: Tensor) -> Tensor:
    x = x.detach().contiguous()
    out = torch.empty_like(x)
    _tanh(x.view(-1).numpy(), out.view(-1).numpy())
    return out


class _TanhFunction(torch.autograd.Function):
    """tanh with the derivative 1 - tanh^2."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        out = _compiled_tanh(x)
        ctx.save_for_backward(out)
        return out

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Tensor:
        return torch.ops.aten.tanh_backward(gradients[0], ctx.saved_tensors[0])


class CompiledTanh(nn.Tanh):
    """A compiled hyperbolic tangent that replaces PyTorch's on a processor.

    It takes a tenth of the time of PyTorch's, which was a fifth of an update of PPO, and is within
    1e-6 of tanh. For few numbers, on other devices and in other types than float32 PyTorch's own
    is called.
    """

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002  # nn.Tanh names it so
        """The hyperbolic tangent of numbers of any shape, in that shape."""
        plain = input.device.type == "cpu" and input.dtype == torch.float32
        if not plain or input.numel() < LEAST_COMPILED:
            return super().forward(input)
        if torch.is_grad_enabled() and input.requires_grad:
            return _TanhFunction.apply(input)
        return _compiled_tanh(input)


def compile_activations(network: MLPModel) -> None:
    """Let an actor or critic that is trained on a processor compute tanh by `CompiledTanh`."""
    _exchange_activations(network.mlp, nn.Tanh, CompiledTanh)


def _exchange_activations(layers: nn.Sequential, old: type[nn.Module], new: type[nn.Tanh]) -> None:
    for place, layer in enumerate(layers):
        if type(layer) is old:
            layers[place] = new()
