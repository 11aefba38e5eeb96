"""Wall fibres: which loads they carry."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from surgisoft.surrogate.effects.wall_fibres import RINGS, fibre_matrix, fibres_tried


@given(st.floats(-1.0, 1.0), st.integers(1, 8), st.booleans())
def test_all_lines_together_hold_back_no_more_than_there_is(others, chambers, ring):
    lines = fibre_matrix(torch.tensor(others).double(), chambers, ring and chambers in RINGS)
    assert float(torch.linalg.matrix_norm(lines, 2)) == pytest.approx(1.0)


def test_lines_along_chambers_see_the_others_by_their_share():
    lines = fibre_matrix(torch.tensor([-0.5]), 3)
    assert torch.allclose(lines[1], torch.tensor([-0.5, 1.0, -0.5]) / 1.5)
    assert fibre_matrix(torch.tensor([0.7]), 1).tolist() == [[1.0]]


def test_between_two_chambers_a_ring_carries_what_a_plane_section_asks_for():
    """Strains of a plane through those at three chambers, 1, 0 and 0, by hand."""
    lines = fibre_matrix(torch.tensor([0.0]), 3, ring=True) * math.sqrt(2.0)
    assert torch.allclose(lines[0], torch.tensor([1.0, 0.0, 0.0]), atol=1e-6)
    assert torch.allclose(lines[1], torch.tensor([2.0, 2.0, -1.0]) / 3, atol=1e-6)
    assert torch.allclose(lines[3], torch.tensor([-1.0, 2.0, 2.0]) / 3, atol=1e-6)


def test_of_four_chambers_the_opposite_one_takes_away_what_bends():
    lines = fibre_matrix(torch.tensor([0.0]), 4, ring=True)
    assert torch.allclose(lines[0] / lines[0, 0], torch.tensor([1.0, 0.0, -1.0, 0.0]), atol=1e-6)


def test_arms_whose_chambers_may_stand_otherwise_get_no_ring():
    assert fibres_tried(1, -0.5) == [(0.0, False)]
    assert fibres_tried(3, -0.5) == [(0.0, False), (0.0, True)]
    assert fibres_tried(6, -0.5) == [(0.0, False), (-0.5, False)]
