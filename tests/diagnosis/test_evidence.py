"""Numbers of the evidence that weigh blocks, against values by hand."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from surgisoft.diagnosis.evidence import CALM, announced_by_block, concentration_of, excess_log_gain

BLOCKS = arrays(float, 12, elements=st.floats(0.01, 100.0))


def test_an_error_in_one_of_ten_blocks_is_concentrated():
    """Levels of 1 and once 11, over what is announced with CALM: mean 2, mean logarithm ln 11 / 10.
    As large everywhere, in units of what is announced there, it is not concentrated at all."""
    announced = np.linspace(1.0, 3.0, 10)
    left = (1.0 - CALM) * announced
    assert concentration_of(left, announced) == pytest.approx(0.0, abs=1e-12)
    left[3] += 10.0 * announced[3]
    assert concentration_of(left, announced) == pytest.approx(math.log(2.0) - math.log(11.0) / 10)


@given(BLOCKS, st.permutations(range(12)), st.floats(0.1, 10.0))
def test_concentration_knows_no_order_and_no_unit_and_is_never_below_zero(left, order, unit):
    announced = np.linspace(1.0, 2.0, 12)
    found = concentration_of(left, announced)
    assert found >= -1e-12
    assert concentration_of(left[order], announced[order]) == pytest.approx(found, abs=1e-9)
    assert concentration_of(unit * left, unit * announced) == pytest.approx(found, abs=1e-9)


def selection_of(before, discrepancy_mm=1.0, noise_mm=0.0, floor=0.0):
    """What the functions ask of a model selection: blocks of two rows of one key point."""
    rows = 2 * len(before)
    problem = SimpleNamespace(
        residual=np.zeros((rows, 1, 3)),
        discrepancy_mm=np.array([discrepancy_mm]),
        noise_mm=np.array([noise_mm]),
        block=np.repeat(np.arange(len(before)), 2),
    )
    return SimpleNamespace(
        problem=problem,
        losses=lambda: np.array(before),
        log_ratio=lambda a, b: np.log((a + floor) / (b + floor)),
    )


def test_what_is_announced_in_a_block_is_the_validated_error_and_the_noise_of_its_rows():
    """Two rows of 0.3^2 + 0.4^2 mm^2; of a row that is missing nothing."""
    selection = selection_of([1.0, 1.0], 0.3, 0.4)
    assert announced_by_block(selection.problem) == pytest.approx([0.5, 0.5])
    selection.problem.residual[3] = np.nan
    assert announced_by_block(selection.problem) == pytest.approx([0.5, 0.25])


def test_an_effect_has_to_explain_where_more_is_left_than_was_announced():
    """2 mm^2 are announced in each block. Of one with 20 mm^2, weight 0.9, a tenth is left; of one
    with 4 mm^2, weight 0.5, half; those with 2 and 1 mm^2 have no weight."""
    selection = selection_of([20.0, 4.0, 2.0, 1.0])
    after = np.array([2.0, 2.0, 2.0, 1.5])
    expected = (0.9 * math.log(10.0) + 0.5 * math.log(2.0)) / 1.4
    assert excess_log_gain(selection, after) == pytest.approx(expected)


def test_without_an_excess_every_block_counts():
    selection = selection_of([2.0, 1.0])
    after = np.array([1.0, 1.0])
    assert excess_log_gain(selection, after) == pytest.approx(0.5 * math.log(2.0))
