"""The term that is always there: the surrogate itself is off.

A network that is slightly wrong looks like physics. Kennedy & O'Hagan (2001) therefore give the
difference between model and reality a Gaussian process of its own, and Brynjarsdottir & O'Hagan
(2014) show that it needs an informative prior: here its size is the model's own validated error,
kept in the checkpoint. As a function of the actuation x and the direction of change d,

    s(x, d) ~ GP(0, a^2 k((x, d), (x', d')) S),    S_ij = min(v_i, v_j),

with v_i the validated variance of key point i: an error that grows along the body is the sum of
independent errors of its sections. The factor a is near 1 (log-normal). Key points are turned
into independent outputs by the generalised eigenvectors of S and the noise.
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import linalg

LENGTHS = ((0.45, 0.45), (1.2, 0.45))
"""Length scales of the model discrepancy, in half ranges of the actuation, and their shares; what
is left is a constant."""
TURNS = 0.3
"""Share of the error that depends on the direction of change."""
SIZES = np.array([0.5, 0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 11.3, 16.0])
"""Factors a on the validated error that are tried."""
SIZE_SPREAD = 0.35
"""Standard deviation of log a: how far the validated error may be off."""


def kernel(x: np.ndarray, d: np.ndarray, x2: np.ndarray, d2: np.ndarray) -> np.ndarray:
    """(S, S2) prior covariance in units of the validated variance.

    x, x2: (S, m) actuation scaled to [-1, 1]; d, d2: (S, m) directions of change.
    """
    gap = np.sqrt(np.maximum(_square_distance(x, x2), 0.0))
    answer = np.full(gap.shape, 1.0 - sum(share for _, share in LENGTHS))
    for length, share in LENGTHS:
        z = math.sqrt(5.0) * gap / length
        answer += share * (1.0 + z + z * z / 3.0) * np.exp(-z)
    return answer * (1.0 - TURNS + TURNS * (d @ d2.T) / max(x.shape[1], 1))


def _square_distance(x: np.ndarray, x2: np.ndarray) -> np.ndarray:
    return (x**2).sum(1)[:, None] + (x2**2).sum(1)[None] - 2.0 * x @ x2.T


def body_covariance(rmse_mm: np.ndarray) -> np.ndarray:
    """(n, n) covariance along the body of one coordinate's error, mm^2, from (n,) RMS distances."""
    variance = np.maximum.accumulate(np.asarray(rmse_mm, float) ** 2 / 3.0)
    return np.minimum(variance[:, None], variance[None])


@dataclass(frozen=True, eq=False)
class Prior:
    """The model discrepancy on given rows, its key points made independent."""

    values: np.ndarray
    """(S,) eigenvalues of the kernel over the rows."""
    vectors: np.ndarray
    """(S, S) its eigenvectors, in columns."""
    mix: np.ndarray
    """(n, n) key points to independent outputs of unit noise."""
    ratio: np.ndarray
    """(n,) prior variance of each output over its noise."""

    @classmethod
    def of(cls, x, d, discrepancy_mm: np.ndarray, noise_mm: np.ndarray) -> "Prior":
        """For rows x, d (S, m), RMS errors and noise (n,) of each key point's distance, mm."""
        values, vectors = linalg.eigh(kernel(x, d, x, d))
        noise = np.diag(np.asarray(noise_mm, float) ** 2 / 3.0)
        ratio, mix = linalg.eigh(body_covariance(discrepancy_mm), noise)
        return cls(np.maximum(values, 0.0), vectors, mix.T, np.maximum(ratio, 0.0))

    def turned(self, field: np.ndarray) -> np.ndarray:
        """(S, n, 3, ...) field in mm as independent outputs in the kernel's own basis."""
        flat = field.reshape(len(field), -1)
        basis = (self.vectors.T @ flat).reshape(field.shape)
        return np.einsum("ij,sj...->si...", self.mix, basis)

    def weight(self, size: float) -> np.ndarray:
        """(S, n) inverse variance of each turned coordinate."""
        return 1.0 / (1.0 + size**2 * self.values[:, None] * self.ratio[None])

    def log_evidence(self, field: np.ndarray, size: float) -> float:
        """Log density of a turned residual (S, n, 3), up to a constant of the rows."""
        weight = self.weight(size)
        fit = float((weight[..., None] * field**2).sum())
        return -0.5 * (fit - field.shape[2] * float(np.log(weight).sum())) + log_size(size)


def log_size(size: float) -> float:
    """Log prior of the factor on the validated error."""
    return -0.5 * (math.log(size) / SIZE_SPREAD) ** 2
