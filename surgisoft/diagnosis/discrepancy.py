"""Model discrepancy: the surrogate's own error, a term of every fit.

A network that is slightly wrong looks like physics. Kennedy & O'Hagan (2001) therefore give the
difference between model and reality a Gaussian process of its own, and Brynjarsdottir & O'Hagan
(2014) show that it needs an informative prior: here its size is the model's own validated error,
kept in the checkpoint. As a function of the actuation x and the direction of change d,

    s(x, d) ~ GP(0, a^2 k((x, d), (x', d')) S),    S_ij = min(v_i, v_j),

with v_i the validated variance of key point i: an error that grows along the body is the sum of
independent errors of its sections. The size a is bounded (`cross_validation.ROOM`).
"""

import math

import numpy as np

LENGTHS = ((0.45, 0.45), (1.2, 0.45))
"""Length scales of the model discrepancy, in half ranges of the actuation, and their shares; what
is left is a constant."""
TURNS = 0.3
"""Share of the error that depends on the direction of change."""


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
