"""Numbers inside names and options."""

import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from surgisoft.numbers_in_text import natural_key, whole_number

LONG = "9" * (sys.get_int_max_str_digits() + 1)
"""More digits than `int` reads."""


def test_names_stand_in_the_order_of_their_numbers():
    names = ["Disc10", "Disc2", "disc1", "Disc", "Disc2b", "Disc02c", "2", "10"]
    ordered = ["2", "10", "Disc", "Disc2", "Disc2b", "Disc02c", "Disc10", "disc1"]
    assert sorted(names, key=natural_key) == ordered


@given(st.integers(0, 10**30), st.integers(0, 10**30))
def test_numbers_compare_by_value(one, other):
    assert (natural_key(f"M{one:020d}") < natural_key(f"M{other}")) == (one < other)


def test_long_numbers_and_other_digits_have_an_order():
    names = [f"M{LONG}", "M²", "M8", "M٣"]
    assert sorted(names, key=natural_key) == ["M8", f"M{LONG}", "M²", "M٣"]


@given(st.integers(-(10**18) + 1, 10**18 - 1))
def test_a_whole_number_is_read(number):
    assert whole_number(str(number)) == number


@pytest.mark.parametrize("text", ["", "+", "+-5", "1.0", "²", "٣", " 1", "1\n", "1e3", "1_0", LONG])
def test_anything_else_is_no_whole_number(text):
    assert whole_number(text) is None
