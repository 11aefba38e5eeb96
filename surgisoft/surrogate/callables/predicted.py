"""Predictions of a model that cannot be called, in the place of the network of an arm model."""

import itertools
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor, nn

from surgisoft.surrogate.arm import centre_and_half
from surgisoft.surrogate.history import History


class PredictedNetwork(nn.Module):
    """Predicted key points of the rows of a history, and their change with the actuation.

    The predictions y of the rows are known; a polynomial P of the actuation, which was fitted to
    them, says how they would change where an effect changes the actuation from u to u':
    y + P(u') - P(u). Without predictions (a planned experiment) the key points are P(u').
    """

    centre: Tensor
    half_range: Tensor
    exponents: Tensor
    coefficients: Tensor

    directions = False
    remembers = False
    runs_only = False
    whole_runs = True

    def __init__(
        self,
        low: Tensor,
        high: Tensor,
        exponents: np.ndarray,
        coefficients: np.ndarray,
        name: str,
        reproduced: float,
    ):
        """Set the polynomial of the scaled actuation.

        low, high: (m,) range in the arm's unit; exponents: (F, m) of each term; coefficients:
        (F, n, 3) in mm; reproduced: share (0..1) of the squared motion that was predicted which P,
        with the past of the actuation beside it, reproduces on blocks left out of its fit.
        """
        super().__init__()
        self.name, self.key_points, self.reproduced = name, coefficients.shape[1], reproduced
        centre, half = centre_and_half(low.double(), high.double())
        self.register_buffer("centre", centre)
        self.register_buffer("half_range", half)
        self.register_buffer("exponents", torch.from_numpy(np.asarray(exponents)))
        self.register_buffer("coefficients", torch.from_numpy(np.asarray(coefficients)))

    def forward(self, pressure: Tensor, direction: Tensor) -> Tensor:
        """Key points (..., n, 3) in mm, base frame, by the polynomial of pressure (..., m)."""
        terms = self._terms(pressure, self.exponents)
        return torch.einsum("...f,fnj->...nj", terms, self.coefficients).to(pressure.dtype)

    def _terms(self, pressure: Tensor, exponents: Tensor) -> Tensor:
        """(..., F) monomials of the scaled actuation, from pressure (..., m), exponents (F, m)."""
        x = (pressure.double() - self.centre) / self.half_range
        terms = [
            torch.stack([x[..., j] ** int(e) for j, e in enumerate(powers)], -1).prod(-1)
            for powers in exponents.tolist()
        ]
        return torch.stack(terms, -1)

    def along(self, actuation: Tensor, history: History, memory: Tensor | None) -> Tensor:
        """Key points (R, T, n, 3) in mm along effective actuation (R, T, m) of a history's runs."""
        points = self(actuation, actuation)
        if history.predicted is None:
            return points
        known = history.pressure.to(actuation)
        return history.predicted.to(points) + points - self(known, known)

    def slope_along(
        self,
        actuation: Tensor,
        history: History,
        memory: Tensor | None,
        rows: Callable[[Tensor], Tensor],
    ) -> Tensor:
        """(S, n, 3, m) derivative of the key points by the row's own actuation, mm a unit.

        It is that of the polynomial: predictions that are known do not depend on the actuation of
        an effect. rows: picks the rows (S, ...) of a (R, T, ...) tensor.
        """
        pressure, slopes = rows(actuation), []
        for chamber in range(pressure.shape[-1]):
            lower = self.exponents.clone()
            lower[:, chamber] = (lower[:, chamber] - 1).clamp(min=0)
            scale = self.exponents[:, chamber] / self.half_range[chamber]
            terms = self._terms(pressure, lower) * scale
            slopes.append(torch.einsum("sf,fnj->snj", terms, self.coefficients))
        return torch.stack(slopes, -1).to(pressure.dtype)


def powers(chambers: int, degree: int) -> np.ndarray:
    """(F, m) exponents of all monomials of m chambers up to a total degree, the constant first."""
    rows = []
    for total in range(degree + 1):
        for picks in itertools.combinations_with_replacement(range(chambers), total):
            rows.append([picks.count(j) for j in range(chambers)])
    return np.array(rows, np.int64).reshape(-1, chambers)


def monomials(x: np.ndarray, exponents: np.ndarray) -> np.ndarray:
    """(S, F) monomials of scaled actuation (S, m)."""
    return np.prod(x[:, None, :] ** exponents, axis=-1)
