"""The error of a fitted network as a change of its weights, and how far that moves fitted values.

How much a network's own error (model discrepancy) looks like an effect cannot be seen in the
recording that the effect is fitted to: there the two are one. It follows from what errors of
networks look like. A network that came out a little differently has slightly other weights, so to
first order (MacKay 1992; as a Gaussian process: Jacot, Gabriel & Hongler 2018; Immer, Korzepa &
Bauer 2021)

    s(x) = sum_w (dy(x) / dw) sigma_w g_w,    g_w ~ N(0, a^2),

with sigma_w the standard deviation of the weights of w's layer, its scale as the layer has it. The
size a is no free number: with it the RMS of s over the range of actuation is the validated error.
Such errors are smooth and much alike all along the body, and more like a gain or a sag than a
random function of the actuation is.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call, jvp

from surgisoft.diagnosis.residuals import Problem
from surgisoft.surrogate.networks import HawEnsemble, HawNN

RANGE_ROWS = 512
"""Random actuations over the range on which the size of the error is taken."""
PROBES = 32
"""Random signs of Hutchinson's (1990) estimate of the size; with 32 it has a relative standard
deviation of a few per cent."""
MOST_BACKWARD = 64
"""Most fields that get a backward pass each; for more, random changes of the weights take the place
of the weights."""
DRAWS = 64
"""Number of these random changes."""


@dataclass(frozen=True, eq=False)
class NetworkError:
    """Prior of the error of a network on some rows."""

    network: HawNN | HawEnsemble
    """A copy of the network."""
    spread: dict[str, float]
    """sigma_w by the name of the weights or biases."""
    actuation: Tensor
    """(S, m) actuation, in the arm's unit."""
    direction: Tensor
    """(S, m) direction of change."""
    size: float = 1.0
    """a [-]."""

    @classmethod
    def of(cls, problem: Problem) -> NetworkError | None:
        """The prior for the network of a problem's model; None where it has no fitted layers.

        A model of few parameters, or a callable, errs by its form and not by its parameters.
        """
        model = problem.model
        if not isinstance(model.network, HawNN | HawEnsemble):
            return None
        network = copy.deepcopy(model.network).requires_grad_(True)
        low, high = np.array(model.spec.low), np.array(model.spec.high)

        def at(pressure: np.ndarray, direction: np.ndarray, size: float) -> NetworkError:
            actuation = low + (high - low) * (pressure + 1.0) / 2.0
            inputs = torch.from_numpy(actuation).float(), torch.from_numpy(direction).float()
            return cls(network, _spread(network), *inputs, size)

        rng = np.random.default_rng(0)
        shape = RANGE_ROWS, len(low)
        over_range = at(rng.uniform(-1.0, 1.0, shape), rng.choice([-1.0, 1.0], shape), 1.0)
        signs = rng.choice([-1.0, 1.0], (RANGE_ROWS, model.spec.key_points, 3, PROBES))
        # Over signs, the mean square of the pull is the sum of the variances of all coordinates.
        total = np.square(over_range.pulls(signs)).sum(1).mean()
        square = total / (RANGE_ROWS * model.spec.key_points)
        size = float(np.sqrt(np.mean(problem.discrepancy_mm**2) / max(square, 1e-30)))
        return at(problem.pressure, problem.direction, size)

    def pulls(self, fields: np.ndarray) -> np.ndarray:
        """(P, W) features: how far W independent standard normal numbers move sums of the error.

        The sums are over rows and coordinates, each with one of the fields (S, n, 3, P).
        """
        weights: dict[str, Tensor] = {n: self.network.get_parameter(n) for n in self.spread}
        if fields.shape[-1] > MOST_BACKWARD:
            draws = self._draws(weights)
            return self.size * np.einsum("sncp,sncw->pw", fields, draws, optimize=True)
        points = self.network(self.actuation, self.direction)
        answer = []
        for field in np.moveaxis(fields, -1, 0):
            along = torch.from_numpy(np.ascontiguousarray(field)).to(points)
            slopes = torch.autograd.grad(points, [*weights.values()], along, retain_graph=True)
            scaled = zip(slopes, self.spread.values(), strict=True)
            answer.append(torch.cat([(sd * slope).flatten() for slope, sd in scaled]))
        return self.size * torch.stack(answer).double().numpy()

    def _draws(self, weights: dict[str, Tensor]) -> np.ndarray:
        """(S, n, 3, DRAWS) the error for random changes of the weights, mm, over their
        number's root."""
        generator, answer = torch.Generator().manual_seed(0), []

        def points(values: dict[str, Tensor]) -> Tensor:
            return functional_call(self.network, values, (self.actuation, self.direction))

        for _ in range(DRAWS):
            change = {
                name: self.spread[name] * torch.randn(values.shape, generator=generator)
                for name, values in weights.items()
            }
            with torch.no_grad():
                answer.append(jvp(points, (weights,), (change,))[1].double().numpy())
        return np.stack(answer, axis=-1) / np.sqrt(DRAWS)


def _spread(network: HawNN | HawEnsemble) -> dict[str, float]:
    """Standard deviation of the weights of the layer of each of its weights and biases, by name."""
    if isinstance(network, HawNN):
        linear = [k for k, layer in enumerate(network.layers) if isinstance(layer, nn.Linear)]
        pairs = [(f"layers.{k}.weight", f"layers.{k}.bias") for k in linear]
    else:
        pairs = [(f"weights.{k}", f"biases.{k}") for k in range(len(network.weights))]
    return {
        name: float(network.get_parameter(weight).detach().std())
        for weight, bias in pairs
        for name in (weight, bias)
    }
