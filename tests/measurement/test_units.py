"""Units and their conversion, against values of NIST SP 811 (2008), appendix B.8, and of the SI."""

import pytest

from surgisoft.measurement.units import SECONDS_PER, factor, same_unit, unit_mistakes, unit_named
from surgisoft.units import MM_PER

VALUES = [
    ("in", "mm", 25.4),
    ("in", "m", 0.0254),
    ("m", "cm", 100.0),
    ("mbar", "Pa", 100.0),
    ("mbar", "kPa", 0.1),
    ("hPa", "mbar", 1.0),
    ("bar", "kPa", 100.0),
    ("psi", "Pa", 6894.757),
    ("atm", "Pa", 101325.0),
    ("mmHg", "Pa", 133.3224),
    ("MPa", "bar", 10.0),
    ("rev", "rad", 6.283185307),
    ("rad", "deg", 57.29577951),
    ("kN", "mN", 1e6),
    ("V", "mV", 1000.0),
]


@pytest.mark.parametrize(("unit", "to", "value"), VALUES)
def test_conversions_are_those_of_nist(unit, to, value):
    assert factor(unit, to) == pytest.approx(value, rel=1e-6)
    assert factor(to, unit) == pytest.approx(1.0 / value, rel=1e-6)


def test_quantities_do_not_mix():
    assert factor("psi", "mm") is None
    assert factor("kPa", "deg") is None


def test_lengths_and_times():
    assert MM_PER == {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}
    assert {unit: SECONDS_PER[unit] for unit in ("ms", "us", "ns", "min", "h")} == {
        "ms": 1e-3,
        "us": 1e-6,
        "ns": 1e-9,
        "min": 60.0,
        "h": 3600.0,
    }


def test_a_unit_is_known_by_its_letters():
    assert unit_named(" kpa ") == "kPa"
    assert unit_named("PSI") == "psi"
    assert unit_named("mn") == "mN"
    assert unit_named("count") is None


@pytest.mark.parametrize("unit", ["kPa", "psi", "mm", "deg"])
def test_every_pair_of_units_that_may_be_mistaken_is_listed_once(unit):
    """Of Pa, kPa, MPa, mbar, bar and psi all ratios but 1: 10 to 1e6 and 6.895 times powers of ten,
    both ways; of mm, cm, m and in 10, 100, 1000, 2.54, 25.4 and 39.37, both ways."""
    known = {
        "mm": ["mm", "cm", "m", "in"],
        "deg": ["deg", "rad"],
    }.get(unit, ["Pa", "kPa", "MPa", "mbar", "bar", "psi"])
    expected = {f"{factor(a, b):.6g}" for a in known for b in known if a != b}
    found = unit_mistakes(unit)
    assert sorted(f"{by:.6g}" for by in found.values()) == sorted(expected)
    for (true, read), by in found.items():
        assert by == pytest.approx(factor(true, read), rel=1e-9)
    assert all((other, unit) in found for other in known if other != unit)


def test_units_of_one_quantity_differ_and_unknown_ones_contradict_nothing():
    assert same_unit("kPa", "kPa") is True
    assert same_unit("bar", "kPa") is False
    assert same_unit("mm", "kPa") is None
    assert same_unit("ms", "mm") is None
    assert same_unit("norm", "kPa") is True
