"""Multi-layer perceptrons with tanh, forward and backward, in blocks of rows on several threads.

Products are NumPy's, whose OpenBLAS takes 0.8 of the time that torch's MKL does on an AMD
processor, and half again less than MKL for the gradient of a first layer; between them one
compiled loop adds a bias and takes its tanh, and one multiplies with the slope of tanh and sums the
gradient of the bias. A block's activations stay in the second cache of a core.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from surgisoft.compiled import compiled
from surgisoft.threads import over_rows

PADE = 12
"""Order of the Pade approximant of exp(2 x) that the compiled tanh takes: within 5e-8 of tanh up
to `SATURATED`, which is less than the rounding of float32 there."""
SATURATED = np.float32(9.2)
"""Argument beyond which tanh is 1 in float32."""
BLOCK = 768
"""Rows of a block: fewer leave more to the calls, and a minibatch of 3,072 has four of them."""
LEAST_ROWS = 256
"""Fewest rows for which the calls of the loops cost less than they save."""
FEW = 8
"""Most outputs of a layer whose gradient by its inputs is a loop and no product."""
_TERMS = [
    math.comb(PADE, k) * math.factorial(2 * PADE - k) * 2.0**k / math.factorial(2 * PADE)
    for k in range(PADE + 1)
]
ODD = np.array(_TERMS[1::2][::-1], np.float32)
EVEN = np.array(_TERMS[0::2][::-1], np.float32)
"""Terms of odd and of even powers of the approximant's numerator, the highest first: with N(x) its
numerator exp(2 x) is N(x) / N(-x) and tanh x is N's odd part over its even part (Pade 1892)."""


@compiled
def _activate(z, bias):
    """tanh(z + bias) in place of z (N, K)."""
    for i in range(z.shape[0]):
        row = z[i]
        for j in range(len(row)):
            value = row[j] + bias[j]
            value = SATURATED if value > SATURATED else value
            value = -SATURATED if value < -SATURATED else value
            square = value * value
            above, below = ODD[0], EVEN[0]
            for k in range(1, len(ODD)):
                above = above * square + ODD[k]
            for k in range(1, len(EVEN)):
                below = below * square + EVEN[k]
            row[j] = value * above / below


@compiled
def _add(z, bias):
    """z + bias in place of z (N, K)."""
    for i in range(z.shape[0]):
        for j in range(z.shape[1]):
            z[i, j] += bias[j]


@compiled
def _sum(gradient, sums):
    """Sums (K,) of the columns of gradient (N, K)."""
    sums[:] = np.float32(0.0)
    for i in range(gradient.shape[0]):
        for j in range(gradient.shape[1]):
            sums[j] += gradient[i, j]


@compiled
def _slopes(gradient, active, sums):
    """Gradient (N, K) by activations in place by what they are the tanh of; its sums (K,)."""
    sums[:] = np.float32(0.0)
    for i in range(gradient.shape[0]):
        row, out = gradient[i], active[i]
        for j in range(len(row)):
            value = row[j] * (np.float32(1.0) - out[j] * out[j])
            row[j] = value
            sums[j] += value


@compiled
def _narrow_slopes(upper, weight, active, gradient, sums):
    """`_slopes` of the product of upper (N, M) and weight (M, K), for a few M."""
    sums[:] = np.float32(0.0)
    for i in range(upper.shape[0]):
        row, out, first = gradient[i], active[i], upper[i, 0]
        for j in range(len(row)):
            row[j] = first * weight[0, j]
        for m in range(1, weight.shape[0]):
            other = upper[i, m]
            for j in range(len(row)):
                row[j] += other * weight[m, j]
        for j in range(len(row)):
            value = row[j] * (np.float32(1.0) - out[j] * out[j])
            row[j] = value
            sums[j] += value


def _forward(x: np.ndarray, layers: list[tuple[np.ndarray, np.ndarray]], kept: bool):
    """Outputs (N, m) of rows x (N, D), and activations of the hidden layers where they are kept."""
    count = len(x)
    out = np.empty((count, len(layers[-1][1])), np.float32)
    hidden = [np.empty((count, len(bias)), np.float32) for _, bias in layers[:-1]] if kept else []

    def work(rows: slice) -> None:
        active = x[rows]
        for n, (weight, bias) in enumerate(layers[:-1]):
            into = hidden[n][rows] if kept else np.empty((len(active), len(bias)), np.float32)
            np.matmul(active, weight.T, out=into)
            _activate(into, bias)
            active = into
        weight, bias = layers[-1]
        np.matmul(active, weight.T, out=out[rows])
        _add(out[rows], bias)

    over_rows(count, work, BLOCK)
    return out, hidden


def _backward(gradient: np.ndarray, x: np.ndarray, weights: list[np.ndarray], hidden: list):
    """Gradients of weights and biases, layer by layer, from those of the outputs (N, m)."""
    count = len(x)
    blocks = -(-count // BLOCK)
    products = [np.empty((blocks, *weight.shape), np.float32) for weight in weights]
    sums = [np.empty((blocks, len(weight)), np.float32) for weight in weights]

    def work(rows: slice) -> None:
        block = -(-rows.start * blocks // count)  # `over_rows` divides the rows evenly
        upper = gradient[rows]
        _sum(upper, sums[-1][block])
        for n in range(len(weights) - 1, 0, -1):
            active = hidden[n - 1][rows]
            np.matmul(upper.T, active, out=products[n][block])
            lower = np.empty_like(active)
            if len(weights[n]) <= FEW:
                _narrow_slopes(upper, weights[n], active, lower, sums[n - 1][block])
            else:
                np.matmul(upper, weights[n], out=lower)
                _slopes(lower, active, sums[n - 1][block])
            upper = lower
        np.matmul(upper.T, x[rows], out=products[0][block])

    over_rows(count, work, BLOCK)
    # Block by block in their order, so that every number of threads gives the same.
    return [
        (product.sum(axis=0), each.sum(axis=0))
        for product, each in zip(products, sums, strict=True)
    ]


class _Network(torch.autograd.Function):
    """The network as one operation of torch's graph."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, *parameters: Tensor) -> Tensor:
        out, ctx.hidden = _forward(x.numpy(), _layers(parameters), True)
        ctx.save_for_backward(x, *parameters)
        return torch.from_numpy(out)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        x, *parameters = ctx.saved_tensors
        weights = [weight for weight, _ in _layers(parameters)]
        found = _backward(gradient.contiguous().numpy(), x.numpy(), weights, ctx.hidden)
        return None, *(torch.from_numpy(each) for pair in found for each in pair)


def _layers(parameters) -> list[tuple[np.ndarray, np.ndarray]]:
    arrays = [each.detach().numpy() for each in parameters]
    return list(zip(arrays[::2], arrays[1::2], strict=True))


class CompiledNetwork(nn.Sequential):
    """Linear layers with tanh between them, whose batches on a processor are compiled loops.

    Few rows, other devices and other types than float32 go through the layers as before.
    """

    @staticmethod
    def fits(layers: nn.Sequential) -> bool:
        """Whether layers are what this network computes: linear ones, with tanh between them."""
        kinds = [type(layer) for layer in layers]
        hidden = len(kinds) // 2
        return hidden > 0 and kinds == [nn.Linear, nn.Tanh] * hidden + [nn.Linear]

    def forward(self, input: Tensor) -> Tensor:  # noqa: A002  # nn.Sequential names it so
        """Outputs (B, m) of rows (B, D)."""
        plain = input.device.type == "cpu" and input.dtype == torch.float32
        if not plain or input.requires_grad or input.ndim != 2 or len(input) < LEAST_ROWS:
            return super().forward(input)
        rows, parameters = input.contiguous(), list(self.parameters())
        if torch.is_grad_enabled():
            return _Network.apply(rows, *parameters)
        return torch.from_numpy(_forward(rows.numpy(), _layers(parameters), False)[0])
