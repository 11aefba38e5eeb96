"""Distinct indices and equal rows against `numpy.unique`."""

import numpy as np
import pytest

from surgisoft.scene.mesh import equal_rows, used_indices


@pytest.mark.parametrize("shape", [(0, 3), (1, 3), (400, 3)])
def test_used_indices_are_numpys_unique(shape):
    index = np.random.default_rng(0).integers(0, 500, shape)
    used, dense = used_indices(index)
    expected, inverse = np.unique(index, return_inverse=True)
    assert np.array_equal(used, expected)
    assert np.array_equal(dense, inverse.reshape(shape))


@pytest.mark.parametrize("rows", [0, 1, 600])
@pytest.mark.parametrize("kind", [np.int64, np.float64])
def test_equal_rows_are_numpys_unique_of_rows(rows, kind):
    table = np.random.default_rng(1).integers(-3, 3, (rows, 3)).astype(kind)
    table[rows // 2 :] *= -1  # floats: 0.0 and -0.0 are equal
    first, group, count = equal_rows(table)
    if not rows:
        assert len(first) == len(group) == len(count) == 0
        return
    expected = np.unique(table, axis=0, return_index=True, return_inverse=True, return_counts=True)
    assert np.array_equal(table[first], expected[0])
    assert np.array_equal(first, expected[1])
    assert np.array_equal(group, expected[2].reshape(-1))
    assert np.array_equal(count, expected[3])
