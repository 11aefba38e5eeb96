"""Agreement of recordings and shares of a scenario, both by hand."""

import numpy as np
import pytest

from surgisoft.credibility.domain import States, applicability, percent, rates
from surgisoft.credibility.retest import Estimate, Repeated, Retest, Told, numbers


def repeated(*values: float, half: float = 0.1959964) -> Repeated:
    """Estimates with a standard uncertainty of 0.1."""
    estimates = [Estimate(f"r{i}", v, v - half, v + half) for i, v in enumerate(values)]
    return Repeated("creep", "share", tuple(estimates))


def test_estimates_agree_as_far_as_their_intervals_say():
    """Q = (0.3 / 2)^2 * 2 / 0.1^2 = 4.5 on one degree of freedom; of 0.1 it is 0.5."""
    assert repeated(1.0, 1.3).p_value == pytest.approx(0.033895, rel=1e-3)
    assert repeated(1.0, 1.3).agree is False
    assert repeated(1.0, 1.1).p_value == pytest.approx(0.479500, rel=1e-3)
    assert repeated(1.0, 1.1).agree is True
    assert repeated(1.0).agree is None


def test_a_parameter_is_identifiable_where_its_interval_is_narrow_beside_it():
    assert repeated(0.4, 0.5).identifiable
    assert not repeated(0.5, 0.3).identifiable


def test_diagnoses_agree_by_kind_and_effects():
    def told(kind, *effects):
        return Told("rec", kind, effects, 0.9, "")

    def agree(*diagnoses):
        return Retest(diagnoses, ()).diagnoses_agree

    assert agree(told("several", "creep", "leak"), told("several", "leak", "creep")) is True
    assert agree(told("identified", "creep"), told("identified", "leak")) is False
    assert agree(told("identified", "creep"), told("nothing_missing")) is False
    assert agree(told("identified", "creep"), told("-")) is None
    words = Retest((told("identified", "creep"), told("-")), (repeated(1.0, 1.3),)).sentence
    assert words == (
        "fewer than two recordings allow a diagnosis; 0 of 1 parameters agree within their "
        "intervals; 1 of 1 parameters are identifiable"
    )


def test_numbers_of_nested_lists_have_their_places():
    found = list(numbers([[1.0, 2.0]], [[0.0, 1.0]], [[2.0, 3.0]]))
    assert found == [("[1,1]", 1.0, 0.0, 2.0), ("[1,2]", 2.0, 1.0, 3.0)]
    assert list(numbers(1.0, 0.0, 2.0)) == [("", 1.0, 0.0, 2.0)]


def states(pressure, rate=None, points=None, load=None) -> States:
    pressure = np.array(pressure, float)
    rate = np.full_like(pressure, np.nan) if rate is None else np.array(rate, float)
    return States("s", pressure, rate, points, load)


def test_pressures_are_inside_up_to_a_tenth_of_the_range():
    known = states([[0.0, 0.0], [10.0, 20.0]])
    asked = states([[0.9, 1.9], [1.1, 0.0], [0.0, 2.1], [10.0, 20.0]])
    found = applicability([known], [asked], 70.0)
    assert found.inside.tolist() == [True, False, False, True]
    assert (found.whole, found.rates, found.poses, found.loads) == (0.5, None, None, None)
    assert "rates and poses and loads of the scenario are not known" in found.sentence


def test_each_quantity_can_take_a_state_out():
    rest = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 100.0]])
    known = states([[0.0], [10.0]], [[-1.0], [2.0]], np.stack([rest, rest]), np.array([0.0, 5.0]))
    near, far = rest + np.array([0.0, 4.9, 0.0]), rest.copy()
    far[0, 0] = 5.1
    asked = states(
        [[0.0]] * 5,
        [[2.0], [2.2], [0.0], [0.0], [-2.0]],
        np.stack([near, rest, far, rest, rest]),
        np.array([0.0, 5.0, 1.0, 5.6, 2.0]),
    )
    found = applicability([known], [asked], 100.0)
    assert found.inside.tolist() == [True, False, False, False, True]
    assert (found.pressures, found.rates, found.poses, found.loads) == (1.0, 0.8, 0.8, 0.8)
    assert found.whole == pytest.approx(0.4)


def test_rates_are_taken_over_half_a_second():
    t_s = 0.1 * np.arange(21)
    assert np.allclose(rates(t_s, 3.0 * t_s[:, None]), 3.0)
    step = np.where(t_s < 0.95, 0.0, 1.0)[:, None]
    assert rates(t_s, step).max() == pytest.approx(1.0 / 0.5, rel=0.01)


def test_only_what_is_whole_is_100_percent():
    assert [percent(v) for v in (0.0, 1.0, 0.9999, 0.00001, 0.173)] == [
        "0 %",
        "100 %",
        "99.9 %",
        "0.1 %",
        "17.3 %",
    ]
