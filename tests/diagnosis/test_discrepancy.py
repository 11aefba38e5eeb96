"""The surrogate's own error as a Gaussian process, against dense linear algebra."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from surgisoft.diagnosis.discrepancy import Prior, body_covariance, kernel, log_size

ROWS, POINTS, CHAMBERS = 7, 3, 2


@pytest.fixture
def rows():
    rng = np.random.default_rng(0)
    return rng.uniform(-1, 1, (ROWS, CHAMBERS)), rng.choice([-1.0, 1.0], (ROWS, CHAMBERS)), rng


def test_kernel_is_a_covariance(rows):
    x, d, _ = rows
    matrix = kernel(x, d, x, d)
    assert matrix == pytest.approx(matrix.T)
    assert np.diag(matrix) == pytest.approx(np.ones(ROWS))
    assert np.linalg.eigvalsh(matrix).min() > -1e-9


def test_errors_grow_along_the_body():
    matrix = body_covariance(np.array([0.1, 0.3, 0.6]))
    assert np.diag(matrix) == pytest.approx(np.array([0.01, 0.09, 0.36]) / 3)
    assert matrix[0, 2] == matrix[0, 0]


def dense(x, d, surrogate, noise, size):
    """(S n, S n) covariance of one coordinate, key point by key point within a row."""
    k = kernel(x, d, x, d)
    return np.kron(k, size**2 * body_covariance(surrogate)) + np.kron(
        np.eye(len(x)), np.diag(noise**2 / 3)
    )


def test_evidence_is_the_normal_density(rows):
    """Differences of the log evidence are those of scipy's density of the whole covariance."""
    x, d, rng = rows
    surrogate, noise = np.array([0.1, 0.2, 0.4]), np.array([0.05, 0.06, 0.07])
    residual = rng.normal(0, 0.3, (ROWS, POINTS, 3))
    prior = Prior.of(x, d, surrogate, noise)
    field = prior.turned(residual)
    ours, truth = [], []
    for size in (0.7, 2.0):
        ours.append(prior.log_evidence(field, size) - log_size(size))
        density = multivariate_normal(cov=dense(x, d, surrogate, noise, size))
        truth.append(sum(density.logpdf(residual[..., c].reshape(-1)) for c in range(3)))
    assert ours[1] - ours[0] == pytest.approx(truth[1] - truth[0], rel=1e-6)
