"""Distinct indices and equal rows against `numpy.unique`; what is kept of equal meshes."""

import numpy as np
import pytest

from surgisoft.scene.mesh import KEPT, Mesh, equal_rows, kept, used_indices
from tests.scene.shapes import ball


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


def test_what_is_made_of_a_mesh_is_kept_for_equal_ones_and_other_arguments_apart():
    made = []

    @kept
    def scaled(mesh, factor):
        made.append((len(mesh.faces), factor))
        return factor * mesh.bounds_mm

    one = ball(20.0, 1)
    first = scaled(one, 2.0)
    np.testing.assert_array_equal(first, 2.0 * one.bounds_mm)
    assert scaled(Mesh(one.vertices_mm, one.faces), 2.0) is first
    moved = np.array(one.vertices_mm)
    moved[one.faces[0, 0]] *= 1.5
    for mesh in (Mesh(moved, one.faces), Mesh(one.vertices_mm, one.faces[:, [0, 2, 1]])):
        np.testing.assert_array_equal(scaled(mesh, 2.0), 2.0 * mesh.bounds_mm)
    np.testing.assert_array_equal(scaled(one, 3.0), 3.0 * one.bounds_mm)
    assert len(made) == 4
    for factor in range(KEPT):
        scaled(one, float(factor + 10))
    assert scaled(one, 2.0) is not first, "only the last few are held"
