"""The decision of a diagnosis, from evidence written down by hand."""

from dataclasses import replace

import pytest

from surgisoft.diagnosis.criteria import CRITERIA
from surgisoft.diagnosis.decision import Evidence, confidence, decide, unnamed

GOOD = Evidence(
    before_over_floor=5.0,
    static_share=0.1,
    static_size=1.0,
    static_size_after=1.0,
    gain=0.9,
    log_gain=1.0,
    p_value=0.001,
    runner_gain=0.0,
    margin=5.0,
    first_share=1.0,
    unique=0.5,
    explained_above_floor=0.9,
    box_share=0.8,
    box_p=0.001,
    box_log_gain=0.0,
    left_size=0.8,
    loose_share=0.0,
    loose_log_gain=0.0,
    loose_p=1.0,
    motions=40,
    named=0,
    rivals=0,
    steps=(),
    blocks=40,
)
"""An effect is missing, and explains nearly all."""


def evidence(names, rivals=(), further=0.0, wrong=False, **numbers):
    steps = [*((name, 0.5, 0.5, 0.001) for name in names), ("other", further, 0.1, 0.5)]
    return replace(
        GOOD,
        named=len(names),
        steps=tuple(steps),
        rivals=len(rivals),
        competing=tuple(rivals),
        form_wrong=wrong,
        **numbers,
    )


def said(names, rivals=(), further=0.0, wrong=False, **numbers):
    decision = decide(evidence(names, rivals, further, wrong, **numbers))
    return decision.kind, decision.effects


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
    quiet = replace(GOOD, box_share=0.1, before_over_floor=2.5)
    assert unnamed(quiet) == "nothing_missing"
    assert unnamed(replace(quiet, left_size=1.6)) == "unknown_effect"
    assert unnamed(replace(quiet, left_size=1.6, before_over_floor=1.2)) == "nothing_missing"
    assert unnamed(replace(quiet, left_size=1.2, box_share=0.4)) == "unknown_effect"
    assert unnamed(replace(quiet, static_share=0.6)) == "surrogate_undertrained"


def test_confidence_falls_with_the_runner_up_and_with_the_lack_of_fit():
    """Against the logistic curve by hand: 5.38 log odds alone, 1.47 less beside an equal effect."""
    alone = confidence(evidence(("creep",), gain=0.9))
    assert alone == pytest.approx(1 / (1 + 2.718281828**-5.38))
    beside = confidence(evidence(("creep",), gain=0.9, runner_gain=0.9))
    assert beside == pytest.approx(1 / (1 + 2.718281828 ** -(5.38 - 1.47)))
    loose = confidence(evidence(("creep",), loose_share=0.1, loose_log_gain=0.4))
    assert loose == pytest.approx(1 / (1 + 2.718281828 ** -(5.38 - 128 * 0.04)))
    assert confidence(evidence(("coupling",))) < alone
    assert confidence(evidence(())) == 0.0


def test_what_is_hardly_likely_is_not_named():
    unlikely = evidence(("creep",), loose_share=0.5, loose_log_gain=0.5)
    assert decide(unlikely).kind != "identified"
    assert decide(unlikely).effects == ()


def test_other_criteria_give_another_decision():
    asked = replace(CRITERIA, decision=replace(CRITERIA.decision, explained=0.5))
    poor = evidence(("softening",), left_size=1.6, explained_above_floor=0.6)
    assert decide(poor).kind == "unknown_effect"
    assert decide(poor, asked).kind == "identified"
