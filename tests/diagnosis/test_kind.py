"""The kind of an answer, from numbers written down by hand."""

import pytest

from surgisoft.diagnosis.kind import kind_of, unnamed

GOOD = {
    "before_over_floor": 5.0,
    "left_size": 0.8,
    "explained_above_floor": 0.9,
    "box_share": 0.8,
    "box_p": 0.001,
    "box_log_gain": 0.0,
    "motions": 40,
    "static_size": 1.0,
    "static_share": 0.1,
}
"""An effect is missing, and explains nearly all."""


def said(names, rivals=(), further=0.0, wrong=False, **numbers):
    return kind_of(names, rivals, further, wrong, GOOD | numbers)


def test_what_passed_and_explains_nearly_all_is_named():
    assert said(("creep",)) == ("identified", ("creep",))
    assert said(("creep", "payload")) == ("several", ("creep", "payload"))
    assert said(("creep",), ["drift"]) == ("ambiguous", ("creep", "drift"))
    assert said(("creep",), wrong=True) == ("unknown_effect", ())


@pytest.mark.parametrize(
    ("name", "left", "explained", "kind"),
    [
        ("misalignment", 1.6, 0.71, "unknown_effect"),
        ("misalignment", 1.4, 0.71, "identified"),
        ("misalignment", 1.6, 0.97, "identified"),
        ("softening", 1.6, 0.71, "identified"),
        ("softening", 1.6, 0.60, "unknown_effect"),
    ],
)
def test_a_frame_or_a_weight_leaves_less_than_what_rubber_does(name, left, explained, kind):
    numbers = {"left_size": left, "explained_above_floor": explained}
    assert said((name,), **numbers)[0] == kind
    if name != "softening":
        assert said((name, "softening"), **numbers)[0] == "several"


def test_the_next_effect_counts_for_what_rubber_does():
    numbers = {"left_size": 1.6, "explained_above_floor": 0.6}
    assert said(("softening",), further=0.3, **numbers)[0] == "identified"
    assert said(("misalignment",), further=0.3, **numbers)[0] == "unknown_effect"


def test_a_black_box_that_does_far_better_makes_it_unknown_only_where_it_is_sure():
    better = {"left_size": 1.1, "box_share": 0.97, "box_log_gain": 0.4}
    assert said(("creep",), **better)[0] == "unknown_effect"
    assert said(("creep",), **better, motions=5)[0] == "identified"
    assert said(("creep",), **(better | {"left_size": 0.9}))[0] == "identified"


def test_nothing_named_is_nothing_missing_too_far_off_or_badly_trained():
    quiet = GOOD | {"box_share": 0.1, "before_over_floor": 2.5}
    assert unnamed(quiet) == "nothing_missing"
    assert unnamed(quiet | {"left_size": 1.6}) == "unknown_effect"
    assert unnamed(quiet | {"left_size": 1.6, "before_over_floor": 1.2}) == "nothing_missing"
    assert unnamed(quiet | {"left_size": 1.2, "box_share": 0.4}) == "unknown_effect"
    assert unnamed(quiet | {"static_share": 0.6}) == "surrogate_undertrained"
