"""Area metric against closed forms, uncertainties and criteria by hand."""

import math

import numpy as np
import pytest

from surgisoft.credibility.metrics import (
    Criterion,
    ValidationUncertainty,
    area_in_space,
    area_metric,
)


def test_the_area_between_shifted_gaussians_is_the_shift():
    drawn = np.random.default_rng(0).normal(size=4000)
    assert area_metric(drawn + 0.7, drawn) == pytest.approx(0.7, abs=1e-12)
    other = np.random.default_rng(1).normal(size=4000)
    assert area_metric(drawn + 3.0, other) == pytest.approx(3.0, abs=0.06)


def test_the_area_between_gaussians_of_two_widths():
    """Of N(0, 1) and N(0, 2^2) it is E|z| (2 - 1) = sqrt(2 / pi)."""
    drawn = np.random.default_rng(0).normal(size=200_000)
    assert area_metric(2.0 * drawn, drawn) == pytest.approx(math.sqrt(2 / math.pi), rel=0.01)


def test_equal_samples_in_any_order_have_no_area():
    drawn = np.random.default_rng(0).normal(size=500)
    assert area_metric(drawn[::-1], drawn) == 0.0


def test_steps_by_hand():
    """F rises at 0 and 1, S_n at 0.5 and 2: half from 0 to 0.5 and from 1 to 2."""
    assert area_metric(np.array([0.0, 1.0]), np.array([0.5, 2.0])) == pytest.approx(0.75)
    assert area_metric(np.array([0.0, np.nan, 1.0]), np.array([0.5, 2.0])) == pytest.approx(0.75)
    # One step against three: 2/3 from 0 to 1, 1/3 from 1 to 3.
    assert area_metric(np.array([0.0]), np.array([0.0, 1.0, 3.0])) == pytest.approx(4 / 3)
    assert math.isnan(area_metric(np.array([np.nan]), np.array([1.0])))


def test_areas_of_the_coordinates_add_as_squares():
    measured = np.random.default_rng(0).normal(size=(50, 3))
    assert area_in_space(measured + np.array([3.0, 4.0, 12.0]), measured) == pytest.approx(13.0)


def test_a_row_that_was_not_measured_counts_in_neither_sample():
    measured = np.zeros((3, 3))
    measured[2] = np.nan
    predicted = np.zeros((3, 3))
    predicted[2] = 100.0
    assert area_in_space(predicted, measured) == 0.0


def test_the_validation_uncertainty_by_hand():
    found = ValidationUncertainty(3.0, 4.0, 12.0, None)
    assert found.standard_mm == pytest.approx(13.0)
    assert found.expanded_mm == pytest.approx(13.0 * 1.959964, rel=1e-6)
    assert found.unknown == ("numerical",)


@pytest.mark.parametrize("least", [False, True])
def test_a_micrometre_decides(least):
    above = Criterion("error", 1.0, 1.001, "mm", least)
    below = Criterion("error", 1.0, 0.999, "mm", least)
    assert (above.passed, below.passed) == ((False, True) if least else (True, False))
    assert Criterion("error", 1.0, 1.0, "mm", least).passed
    assert not Criterion("error", float("nan"), 1.0, "mm", least).passed
