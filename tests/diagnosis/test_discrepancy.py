"""The prior of the model discrepancy."""

import numpy as np
import pytest

from surgisoft.diagnosis.discrepancy import body_covariance, kernel

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


def test_a_key_point_is_as_uncertain_as_any_nearer_to_the_base():
    """Its error is the sum of those of the sections below, even where it was validated to less."""
    matrix = body_covariance(np.array([0.3, 0.1, 0.6]))
    assert np.diag(matrix) == pytest.approx(np.array([0.09, 0.09, 0.36]) / 3)
    assert matrix[1, 2] == pytest.approx(0.03)


def test_errors_of_opposite_directions_have_less_in_common():
    """A share of 0.3 of the error follows the direction: 0.7 - 0.3 where both chambers turn."""
    x, up = np.array([[0.2, -0.4]]), np.ones((1, 2))
    assert kernel(x, up, x, up).item() == pytest.approx(1.0)
    assert kernel(x, up, x, -up).item() == pytest.approx(0.4)
    assert kernel(x, up, x, up * [1.0, -1.0]).item() == pytest.approx(0.7)
