"""The decision of a diagnosis, from evidence and fitted weights written down by hand."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgisoft.diagnosis.criteria import CLAIM, Worth
from surgisoft.diagnosis.decision import (
    ASSET,
    FEATURES,
    SCHEMA,
    Curve,
    DecisionModel,
    Logistic,
    Probabilities,
    chosen,
    claimable,
    content_hash,
    decide,
    features_of,
    load_decision,
    of_change,
    probabilities,
    reason_of,
    shares_of,
    statements,
)
from surgisoft.diagnosis.evidence import EffectEvidence, Evidence, ProposalEvidence
from surgisoft.errors import InputError

CREEP = EffectEvidence("creep", 0.95, 1.2, 3.2, 0.0, 0.0, 0.4, 1.0, 1, False, 0.0, 0.0, 0.0)
"""An effect that explains nearly all."""
LAG = replace(CREEP, effect="line_lag", gain=0.5, log_gain=0.4, left=1.4, margin=6.0, unique=0.0)
"""An effect that explains half."""
ALONE = ProposalEvidence(
    effects=("creep",),
    gain=0.95,
    left_size=0.5,
    left_log_box=-0.5,
    form_gain=0.0,
    form_log_gain=0.0,
    form_z=0.0,
    last_gain=0.95,
    last_log_gain=1.2,
    last_z=3.2,
    last_alone=1.0,
    better=2.0,
)
GOOD = Evidence(
    error_over_floor=5.0,
    error_over_validated=3.0,
    size=3.0,
    size_beside_discrepancy=2.5,
    held_static=0.1,
    free_static=0.3,
    free_box=0.9,
    error_over_box=3.0,
    box_gain=0.8,
    box_log_gain=0.8,
    box_z=3.2,
    blocks=48,
    motions=40,
    effects=(CREEP, LAG),
    proposals=(ALONE,),
)
"""An effect is missing, and explains nearly all."""


def given_odds(missing=9.0, known=9.0, two=-9.0, network=-9.0, first=()):
    """A decision whose probabilities do not depend on the evidence but for the first effect."""
    constants = {"missing": missing, "known": known, "two": two, "network": network, "first": 0.0}
    models = {
        name: Logistic((0.0,) * len(features), constants[name])
        for name, features in FEATURES.items()
    }
    weights = [dict(first).get(feature.name, 0.0) for feature in FEATURES["first"]]
    models["first"] = Logistic(tuple(weights))
    return DecisionModel(models, {})


CLEAR = (("left", -9.0),)
"""The effect that leaves least is the one."""
PAIR = replace(ALONE, effects=("creep", "payload"))
PAIR_WITH_LAG = replace(ALONE, effects=("creep", "line_lag"))
QUIET = replace(GOOD, error_over_floor=1.1, error_over_validated=0.9, error_over_box=1.1)
STATIC = replace(QUIET, error_over_floor=2.0, error_over_box=1.6, free_static=0.85)


@pytest.mark.parametrize(
    ("evidence", "model", "kind", "effects"),
    [
        (GOOD, given_odds(first=CLEAR), "identified", ("creep",)),
        (GOOD, given_odds(), "ambiguous", ("creep", "line_lag")),
        (
            replace(GOOD, proposals=(ALONE, PAIR)),
            given_odds(two=9.0, first=CLEAR),
            "several",
            ("creep", "payload"),
        ),
        (GOOD, given_odds(known=-3.0), "unknown_effect", ()),
        (QUIET, given_odds(missing=-9.0), "nothing_missing", ()),
        (STATIC, given_odds(missing=-9.0, network=3.0), "surrogate_undertrained", ()),
        (GOOD, given_odds(missing=0.0, known=0.0, first=CLEAR), "cannot_tell", ()),
    ],
)
def test_every_kind_of_result(evidence, model, kind, effects):
    found = decide(evidence, model)
    assert (found.kind, found.effects) == (kind, effects)
    assert 0.0 <= found.confidence <= 1.0
    assert (found.reason is not None) == (kind == "cannot_tell")


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"free_static": 0.85}, "network"),
        ({"error_over_validated": 1.0}, "learned"),
        ({"motions": 12}, "few_data"),
        ({}, "schedule"),
    ],
)
def test_why_it_cannot_be_told(changes, reason):
    quiet = given_odds(missing=0.0, known=-0.5)
    found = decide(replace(GOOD, **changes), quiet, Worth(wrong_network=-4.0))
    assert (found.kind, found.reason) == ("cannot_tell", reason)


def test_a_model_from_before_a_change_has_learned_nothing_of_it():
    evidence = replace(GOOD, error_over_validated=1.0)
    quiet = given_odds(missing=0.0, known=-0.5)
    for motions, reason in ((200, "schedule"), (12, "few_data")):
        seen = replace(evidence, motions=motions)
        found = decide(seen, quiet, Worth(wrong_network=-4.0))
        assert found.reason == "learned"
        assert of_change(found, seen) == replace(found, reason=reason)
    off = replace(found, kind="surrogate_undertrained")
    assert of_change(off, evidence).reason is None
    other = replace(found, reason="network")
    assert of_change(other, evidence) == other


@pytest.mark.parametrize(
    ("missing", "motions", "reason"),
    [
        (-0.3, 200, "repeatability"),
        (0.3, 200, "schedule"),
        (0.3, 12, "schedule"),
        (0.3, 11, "few_data"),
    ],
)
def test_a_paired_difference_is_never_blamed_on_the_model(missing, motions, reason):
    """Even if a static function explains most of it, or it is as small as the validated error."""
    odds = given_odds(missing=missing, known=-0.5)
    for changes in ({"free_static": 0.85}, {"error_over_validated": 1.0}, {"free_box": 0.0}):
        evidence = replace(GOOD, paired=True, motions=motions, **changes)
        assert reason_of(evidence, probabilities(evidence, odds)) == reason


@pytest.mark.parametrize("over", [1.6, 3.0, 9.0])
def test_an_error_far_above_the_validated_one_is_never_nothing(over):
    sure_of_nothing = given_odds(missing=-20.0)
    found = decide(replace(QUIET, error_over_validated=over), sure_of_nothing)
    assert found.kind != "nothing_missing"
    assert decide(QUIET, sure_of_nothing).kind == "nothing_missing"


def test_nothing_is_claimed_near_the_floor_or_near_the_black_box_alone():
    assert claimable(replace(QUIET, error_over_box=3.0))
    assert claimable(replace(QUIET, error_over_floor=5.0))
    far = replace(QUIET, error_over_floor=5.8, error_over_box=1.8)
    assert not claimable(far)
    assert decide(far, given_odds(missing=-9.0)).kind == "cannot_tell"
    assert claimable(far, replace(CLAIM, near_box=2.0))


def test_probabilities_by_hand():
    """The rival leaves 0.52 of what the best one leaves 0.07, so log(0.52 / 0.07) / 2, weight 2."""
    found = probabilities(GOOD, given_odds(1.0, 2.0, network=-1.0, first=(("left", -2.0),)))

    def chance(odds):
        return 1.0 / (1.0 + math.exp(-odds))

    first = chance(1.0) * chance(2.0) * chance(math.log(0.52 / 0.07))
    assert found.effects["creep"] == pytest.approx(first)
    assert found.effects["line_lag"] == pytest.approx(
        chance(1.0) * chance(2.0) * chance(-math.log(0.52 / 0.07))
    )
    assert found.unknown == pytest.approx(chance(1.0) * chance(-2.0) * chance(1.0))
    assert found.nothing == pytest.approx(chance(-1.0) * chance(1.0))
    assert found.network == pytest.approx((1.0 - chance(1.0) * chance(2.0)) * chance(-1.0))
    total = found.nothing + found.network + found.unknown + found.known
    assert total == pytest.approx(1.0)


CURVED = (Curve(-0.1, 1.1), Curve(-0.2, 1.2))
"""Calibrations of the first effect and of the set."""


def with_curves(model, name, both):
    return replace(model, curves={"name": name, "set": both})


def test_calibration_by_hand():
    """First effect and set get the log odds of the curves; the others share what remains to 1."""
    plain = given_odds(1.0, 2.0, network=-1.0, first=(("left", -2.0),))
    raw = probabilities(GOOD, plain)
    found = probabilities(GOOD, with_curves(plain, *CURVED))
    first, second = raw.effects.values()

    def odds(p):
        return math.log(p / (1.0 - p))

    both = sum(found.effects.values())
    assert odds(found.effects["creep"]) == pytest.approx(-0.1 + 1.1 * odds(first))
    assert odds(both) == pytest.approx(-0.2 + 1.2 * odds(first + second))
    assert found.nothing + found.network + found.unknown + both == pytest.approx(1.0)
    assert found.unknown / found.nothing == pytest.approx(raw.unknown / raw.nothing)


@given(
    missing=st.floats(-6, 9),
    known=st.floats(-6, 9),
    first=st.floats(-9, 0),
    name=st.tuples(st.floats(-2, 2), st.floats(0.3, 3)),
    both=st.tuples(st.floats(-2, 2), st.floats(0.3, 3)),
)
def test_calibrated_probabilities_are_probabilities(missing, known, first, name, both):
    """They sum to 1, none is negative, and the most probable effect stays the first."""
    model = given_odds(missing, known, first=(("left", first),))
    evidence = replace(GOOD, proposals=(ALONE, PAIR))
    raw, found = (
        probabilities(evidence, one)
        for one in (model, with_curves(model, Curve(*name), Curve(*both)))
    )
    chances = [found.nothing, found.network, found.unknown, *found.effects.values()]
    assert min(chances) >= 0.0
    assert sum(chances) == pytest.approx(1.0)
    assert 0.0 <= found.pair <= found.known + 1e-12
    assert next(iter(found.effects)) == next(iter(raw.effects))


def test_no_model_is_off_where_a_paired_difference_is_explained():
    """Nothing has changed up to what BEFORE does not repeat; more than that is not "nothing"."""
    quiet = given_odds(missing=-9.0, network=9.0)
    assert decide(STATIC, quiet).kind == "surrogate_undertrained"
    assert decide(replace(STATIC, paired=True), quiet).kind == "nothing_missing"
    large = replace(STATIC, paired=True, error_over_validated=3.0)
    assert probabilities(large, quiet).network == 0.0
    assert decide(large, quiet).kind == "cannot_tell"


def test_a_name_is_given_where_it_is_more_probably_right_than_wrong():
    """By the cost of a wrong name alone: 1 to 1 needs 1/2, 2 to 1 needs 2/3."""
    for chance, cost, kind in ((0.52, 1.0, "identified"), (0.64, 2.0, "cannot_tell")):
        model = given_odds(missing=math.log(chance / (1.0 - chance)), known=9.0, first=CLEAR)
        worth = Worth(wrong_name=-cost, needless_name=-cost, wrong_network=-4.0)
        found = decide(replace(GOOD, free_static=0.85), model, worth)
        assert found.kind == kind
        worths = [one.worth for one in found.statements]
        assert worths == sorted(worths, reverse=True)
        named = next(one for one in found.statements if one.kind == "identified")
        assert named.probability == pytest.approx(chance, abs=2e-3)


def test_a_statement_below_the_least_probability_is_not_made():
    """Free of cost it would be worth telling."""
    vague = given_odds(missing=2.0, known=-1.0, first=CLEAR)
    free = Worth(wrong_unknown=0.0, least_probability=0.6)
    assert decide(GOOD, vague, free).kind == "unknown_effect"
    free = replace(free, least_probability=0.7)
    assert decide(GOOD, vague, free).kind == "cannot_tell"


def test_nothing_that_cannot_be_claimed_is_not_called_unknown():
    """Of 0.4 for "unknown" and 0.55 or 0.35 for "nothing", where the error is too large for it."""
    for quiet, kind in ((0.55, "cannot_tell"), (0.35, "unknown_effect")):
        effects = {"creep": 0.6 - quiet}
        chances = Probabilities(quiet, 0.0, 0.4, effects, 0.0, ())
        found = chosen(GOOD, chances, Worth(wrong_unknown=-0.5))
        assert found.kind == kind


def test_two_that_do_the_same_are_named_as_a_set_and_never_one_of_them():
    twins = replace(GOOD, effects=(CREEP, replace(CREEP, effect="gain_mismatch")))
    found = decide(twins, given_odds(first=CLEAR))
    assert found.kind == "ambiguous"
    assert set(found.effects) == {"creep", "gain_mismatch"}
    assert found.probabilities.effects["creep"] == pytest.approx(0.5, abs=0.01)


MOST_FEATURES = max(map(len, FEATURES.values()))
weights = st.lists(st.floats(0.0, 5.0), min_size=MOST_FEATURES, max_size=MOST_FEATURES)


@settings(max_examples=60, deadline=None)
@given(weights, st.floats(-4.0, 4.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_more_that_is_explained_makes_nothing_less_probable(values, constant, low, high):
    """For any weights of the right signs the probability that something is missing rises with the
    share that is explained, and that of something unknown falls."""
    models = {
        name: Logistic(tuple(f.sign * w for f, w in zip(features, values, strict=False)), constant)
        for name, features in FEATURES.items()
    }
    model = DecisionModel(models, {})
    low, high = sorted((low, high))
    less, more = (replace(GOOD, proposals=(replace(ALONE, gain=gain),)) for gain in (low, high))
    quiet, loud = probabilities(less, model), probabilities(more, model)
    assert loud.nothing + loud.network <= quiet.nothing + quiet.network + 1e-12
    known = [one.known / max(1.0 - one.nothing - one.network, 1e-12) for one in (quiet, loud)]
    assert known[1] >= known[0] - 1e-9


@settings(max_examples=60, deadline=None)
@given(st.sampled_from(["gain", "margin", "collinear"]), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_an_effect_is_less_probable_the_less_it_does(name, a, b):
    """With the weights in force: that explains less, or that the best one beats by more."""
    worse, better = sorted((a, b), reverse=name == "margin")
    chances = [
        probabilities(replace(GOOD, effects=(CREEP, replace(LAG, **{name: value})))).effects
        for value in (worse, better)
    ]
    assert chances[0]["line_lag"] <= chances[1]["line_lag"] + 1e-12


def test_how_sure_the_blocks_are_does_not_tell_two_apart_that_do_the_same():
    """At an angle of 0.1 the margin counts up to sqrt(0.01 / 0.02) standard errors."""
    twin = replace(LAG, gain=CREEP.gain, collinear=0.99)
    place = [feature.name for feature in FEATURES["first"]].index("margin")
    for margin in (2.0, 20.0):
        rows = features_of("first", replace(GOOD, effects=(CREEP, replace(twin, margin=margin))))
        assert rows[1, place] == pytest.approx(math.sqrt(0.5) / 3.0)


def test_a_second_effect_that_mends_the_form_of_the_first_says_nothing_of_two():
    """What is left of the first's 99 % is within what its form is wrong by; of 80 % it is not."""
    second = replace(
        PAIR, own_gain=0.5, own_log_gain=0.7, own_z=3.3, last_log_gain=0.7,
        instead=("contact", "contact"), instead_left=(0.05, 0.05), instead_margin=(0.5, 0.5),
    )  # fmt: skip
    names = [feature.name for feature in FEATURES["two"]]
    chances, rows = [], []
    for left in (0.01, 0.2):
        alone, both = replace(ALONE, gain=1.0 - left), replace(second, gain=1.0 - left / 2)
        evidence = replace(GOOD, proposals=(alone, both))
        rows.append(dict(zip(names, features_of("two", evidence), strict=True)))
        chances.append(probabilities(evidence).pair)
    assert rows[0]["own_gain"] == pytest.approx(0.5 * 0.01 / 0.03)
    assert rows[1]["own_gain"] == pytest.approx(0.5 * 0.2 / 0.22)
    assert rows[0]["better"] == pytest.approx(math.log(0.03 / 0.025))
    assert chances[0] < chances[1]


@pytest.mark.parametrize(
    ("free", "broken", "line"), [(0.5, 0.7, 0.8), (-math.log(2.0), 0.7 - math.log(2.0), 0.4)]
)
def test_where_an_effect_explains_them_there_is_no_break_and_no_line(free, broken, line):
    """A break that gains 0.7 over a black box gains as much less over what is better than that.
    Where an effect leaves half of what the black box does, half of the line is explained."""
    names = [feature.name for feature in FEATURES["known"]]
    worse = replace(ALONE, left_log_free=free + 1.0)
    best = replace(ALONE, left_log_free=free)
    evidence = replace(
        GOOD, proposals=(worse, best), free_log_gain=1.8, break_log_gain=0.7, line=0.8
    )
    row = dict(zip(names, features_of("known", evidence), strict=True))
    assert row["break"] == pytest.approx(broken)
    assert row["line"] == pytest.approx(line)


def test_a_proposal_whose_relaxed_form_explains_more_is_less_probably_known():
    """The largest quantile of the proposals counts, 1.5 of 3 here."""
    place = [feature.name for feature in FEATURES["known"]].index("form_z")
    lacking = replace(ALONE, form_z=1.5)
    row = features_of("known", replace(GOOD, proposals=(lacking, replace(PAIR, form_z=0.5))))
    assert row[place] == pytest.approx(0.5)
    chances = [probabilities(replace(GOOD, proposals=(each,))).known for each in (ALONE, lacking)]
    assert chances[1] < chances[0]


def test_an_effect_that_helps_in_few_blocks_only_is_uneven():
    """It leaves a fifth of the squared error. Of every block it leaves a fifth as well; or only two
    of ten blocks, which hold nearly all of the error, fall at all, to a fifth: exp(-0.2 ln 5)."""
    place = [feature.name for feature in FEATURES["known"]].index("uneven")
    chances = []
    for blocks, uneven in ((1.0, 0.0), (0.2, 5.0**-0.2 - 0.2), (2.0, 0.0)):
        best = replace(CREEP, gain=0.8, log_gain=blocks * math.log(5.0))
        evidence = replace(GOOD, effects=(best, LAG))
        assert features_of("known", evidence)[place] == pytest.approx(uneven)
        chances.append(probabilities(evidence).known)
    assert chances[1] < chances[0] == chances[2]


@pytest.mark.parametrize(("third", "distinct"), [(0.4, 0.4), (3.0, 1.0), (None, 0.0)])
def test_an_effect_is_distinct_as_far_as_the_third_one_leaves_more(third, distinct):
    """The second one may be a relative of it that does the same."""
    place = [feature.name for feature in FEATURES["missing"]].index("distinct")
    others = (LAG,) if third is None else (LAG, replace(LAG, effect="drift", left=third))
    row = features_of("missing", replace(GOOD, effects=(CREEP, *others)))
    assert row[place] == pytest.approx(distinct)


def test_an_effect_is_unique_by_its_share_of_what_returns():
    """Of three effects that return 0.06, 0.02 and nothing the first has 0.6, and 0.02 is chance.

    Of two proposed effects the lesser counts.
    """
    effects = (
        replace(CREEP, unique=0.06),
        replace(LAG, unique=0.02),
        replace(LAG, effect="drift", unique=-0.01),
    )
    evidence = replace(GOOD, effects=effects, proposals=(ALONE, PAIR_WITH_LAG))
    place = [feature.name for feature in FEATURES["first"]].index("unique")
    assert features_of("first", evidence)[:, place] == pytest.approx([0.6, 0.2, 0.0])
    place = [feature.name for feature in FEATURES["two"]].index("unique")
    assert features_of("two", evidence)[place] == pytest.approx(0.2)


@settings(max_examples=60, deadline=None)
@given(weights, st.floats(-4.0, 4.0), st.floats(0.0, 2.0), st.floats(0.0, 1.0))
def test_two_are_never_more_probable_than_that_one_of_them_is_missing(values, constant, left, own):
    """For any weights: P(both) is at most P(one of them)."""
    models = {
        name: Logistic(tuple(f.sign * w for f, w in zip(features, values, strict=False)), constant)
        for name, features in FEATURES.items()
    }
    pair = replace(PAIR_WITH_LAG, own_gain=own, own_z=3.0)
    drift = replace(LAG, effect="drift", gain=0.8, left=0.1)
    effects = (CREEP, drift, replace(LAG, left=left))
    evidence = replace(GOOD, effects=effects, proposals=(ALONE, pair))
    found = probabilities(evidence, DecisionModel(models, {}))
    assert found.pair <= found.effects["creep"] + found.effects["line_lag"] + 1e-12
    assert found.pair <= found.known


@pytest.mark.parametrize(
    ("effect", "by_definition"), [("creep", True), ("creep", False), ("drift", True)]
)
def test_what_is_a_formula_by_definition_is_refuted_by_its_relaxed_form(effect, by_definition):
    """Its quantile, 2.4 of 3, counts once more for the best single proposal, and for no other."""
    place = [feature.name for feature in FEATURES["known"]].index("definition_z")
    effects = (replace(CREEP, effect=effect, by_definition=by_definition), LAG)
    proposals = (replace(ALONE, form_z=2.4), replace(PAIR, form_z=3.0))
    row = features_of("known", replace(GOOD, effects=effects, proposals=proposals))
    assert row[place] == pytest.approx(0.8 if effect == "creep" and by_definition else 0.0)


def test_a_second_effect_that_few_motions_show_puts_neither_of_the_two_first():
    """What the second explains counts by its quantile, 1.5 of 3 here; none where it is chance."""
    place = [feature.name for feature in FEATURES["first"]].index("proposed")
    for z, share in ((0.0, 0.0), (1.5, 0.5), (9.0, 1.0)):
        pair = replace(PAIR, effects=("creep", "line_lag"), own_gain=0.6, own_z=z)
        evidence = replace(GOOD, proposals=(replace(ALONE, gain=0.8), pair))
        rows = features_of("first", evidence)
        assert rows[:, place] == pytest.approx(0.6 * share * 0.2 / 0.22)


def test_a_sudden_turn_speaks_against_an_effect_that_moves_the_base():
    chances = [
        probabilities(replace(GOOD, sudden_log_gain=gain, sudden_margin=margin)).known
        for gain, margin in ((-0.5, -4.0), (0.0, 0.0), (0.1, 3.0), (0.8, 9.0))
    ]
    assert chances[0] == chances[1] > chances[2] >= chances[3]


def test_the_weights_in_force_have_the_signs_of_their_features():
    model = load_decision()
    for name, features in FEATURES.items():
        for feature, weight in zip(features, model.models[name].weights, strict=True):
            assert weight * feature.sign >= 0.0, (name, feature.name)


@pytest.mark.parametrize(("z", "counts"), [(0.8, False), (0.9, True)])
def test_two_effects_count_only_where_the_second_is_beyond_chance(z, counts):
    """A p-value of 0.2 is the quantile 0.84. The two leave 0.1 of 0.5 that one effect leaves."""
    one = replace(ALONE, gain=0.5, left_size=2.0, form_z=0.6, left_log_free=0.4)
    two = replace(PAIR, gain=0.9, left_size=0.8, form_z=1.5, left_log_free=0.1, last_z=z)
    evidence = replace(GOOD, proposals=(one, two), line=0.5, free_log_gain=9.0)
    said = {}
    for model in ("missing", "known"):
        names = [f"{model} {feature.name}" for feature in FEATURES[model]]
        said |= dict(zip(names, features_of(model, evidence), strict=True))
    gain, left = (0.9, 0.8) if counts else (0.5, 2.0)
    assert said["missing explained"] == pytest.approx(gain)
    assert said["missing of_box"] == pytest.approx(gain / 0.9)
    assert said["missing stays"] == pytest.approx(math.log(left / 3.0))
    assert said["known explained"] == pytest.approx(-0.5 * math.log(1.0 - gain + 0.02))
    assert said["known left_size"] == pytest.approx(math.log(left))
    assert said["known form_z"] == pytest.approx(0.5 if counts else 0.2)


def test_features_by_hand():
    """What is 0 or at a bound in other tests: sizes of what is left, and the two in one's place."""
    exact = replace(CREEP, exact_form=True)
    left = replace(ALONE, left_size=2.0)
    pair = replace(
        PAIR_WITH_LAG, gain=0.97, left_size=1.8, last_z=1.2, last_log_gain=0.5,
        own_gain=0.4, own_log_gain=0.3, instead_margin=(1.5, 4.5), instead_left=(0.6, 0.2),
    )  # fmt: skip
    evidence = replace(GOOD, effects=(exact, LAG), proposals=(left, pair), free_box=0.6)
    known, two, missing = (
        {f.name: v for f, v in zip(FEATURES[name], features_of(name, evidence), strict=True)}
        for name in ("known", "two", "missing")
    )
    assert known["exact_left"] == pytest.approx(math.log(1.8))
    assert known["left_size"] == pytest.approx(math.log(1.8))
    assert missing["of_box"] == pytest.approx(1.0), "never more than all"
    beyond = 0.05 / (0.05 + 0.02)
    assert two["last_z"] == pytest.approx(0.4)
    assert two["last_log_gain"] == pytest.approx(0.5 * beyond)
    assert two["own_gain"] == pytest.approx(0.4 * beyond)
    assert two["own_log_gain"] == pytest.approx(0.3 * beyond)
    assert two["better"] == pytest.approx(math.log(0.07 / 0.05))
    assert two["instead_margin"] == pytest.approx(0.5), "the lesser of both"
    assert two["instead_left"] == pytest.approx(math.log((0.03 * math.exp(0.2) + 0.02) / 0.05))
    plain = replace(evidence, effects=(CREEP, LAG))
    place = [feature.name for feature in FEATURES["known"]].index("exact_left")
    assert features_of("known", plain)[place] == 0.0
    place = [feature.name for feature in FEATURES["first"]].index("exact_left")
    lag = replace(LAG, exact_form=True, gain=0.5, left=0.4)
    rows = features_of("first", replace(evidence, effects=(CREEP, lag)))
    assert rows[:, place] == pytest.approx([0.0, 0.5 * (math.log(2.5) + 0.2)])


def test_features_are_finite_of_order_one():
    for evidence in (GOOD, QUIET, replace(GOOD, effects=(), proposals=())):
        for name in FEATURES:
            values = features_of(name, evidence)
            assert np.isfinite(values).all()
            assert (np.abs(values) <= 4.0).all()


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda v: v["models"]["missing"]["weights"].update(above_floor=99.0), "hash"),
        (lambda v: v.update(schema=99), "schema 99"),
        (lambda v: v.update(schema=SCHEMA - 1), f"expected {SCHEMA}; fit it again"),
        (lambda v: v["models"]["missing"]["weights"].pop("above_floor"), "hash"),
    ],
)
def test_a_damaged_asset_is_refused_in_one_line(tmp_path, change, told):
    values = json.loads(ASSET.read_text())
    change(values)
    bad = tmp_path / "decision.json"
    bad.write_text(json.dumps(values))
    with pytest.raises(InputError, match=told) as caught:
        load_decision(bad)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            lambda v: v["models"]["missing"].update(constant="1"),
            "a weight that is not a finite number",
        ),
        (
            lambda v: v["calibration"].update(other={"constant": 0.0, "slope": 1.0}),
            "'other' is not",
        ),
        (lambda v: v.update(calibration="name"), "calibration is not a table"),
    ],
)
def test_an_asset_with_its_hash_but_no_numbers_is_refused(tmp_path, change, told):
    values = json.loads(ASSET.read_text())
    change(values)
    bad = tmp_path / "decision.json"
    bad.write_text(json.dumps(values | {"sha256": content_hash(values)}))
    with pytest.raises(InputError, match=told):
        load_decision(bad)


def test_an_asset_of_other_features_is_refused(tmp_path):
    values = json.loads(ASSET.read_text())
    values["models"]["missing"]["weights"] = {"other": 1.0}
    values["sha256"] = content_hash(values)
    bad = tmp_path / "decision.json"
    bad.write_text(json.dumps(values))
    with pytest.raises(InputError, match="expected above_floor"):
        load_decision(bad)
    bad.write_text("no json")
    with pytest.raises(InputError, match="no fitted decision"):
        load_decision(bad)


def test_evidence_survives_json():
    full = replace(GOOD, proposals=(ALONE, replace(PAIR, instead=("drift",), instead_left=(0.1,))))
    assert Evidence.from_json(json.loads(json.dumps(full.to_json()))) == full
    assert not any(name.startswith("slide") for name in full.to_json()), "as stored evidence"
    slides = replace(full, slide_until_s=9.0, slide_mm=2.0)
    assert Evidence.from_json(slides.to_json()) == slides


@given(
    missing=st.floats(-6, 9), known=st.floats(-6, 9), two=st.floats(-9, 9), network=st.floats(-9, 6)
)
def test_the_confidence_is_the_probability_of_what_is_said(missing, known, two, network):
    """Summed by hand from the probabilities, for every kind of result."""
    model = given_odds(missing, known, two, network, CLEAR)
    for evidence in (GOOD, QUIET, STATIC, replace(GOOD, proposals=(ALONE, PAIR))):
        found, p = decide(evidence, model), probabilities(evidence, model)
        right = {
            "identified": sum(p.effects.get(name, 0.0) for name in found.effects),
            "ambiguous": sum(p.effects.get(name, 0.0) for name in found.effects),
            "several": p.pair,
            "unknown_effect": p.unknown,
            "nothing_missing": p.nothing + p.network,
        }
        if found.kind in right:
            assert found.confidence == pytest.approx(right[found.kind])
        if found.kind == "surrogate_undertrained":
            assert found.confidence in (p.network, p.nothing + p.network)


def test_a_paired_difference_that_nothing_can_be_stated_of_is_not_told():
    """No effect can be tested, too large for "nothing", too probably nothing for "unknown"."""
    nothing = replace(
        GOOD, effects=(), proposals=(), paired=True, error_over_validated=1.55, size=0.1
    )
    model = given_odds(missing=-3.0, known=0.0)
    found = decide(nothing, model)
    assert (found.kind, found.effects, found.statements) == ("cannot_tell", (), ())
    assert found.confidence == pytest.approx(probabilities(nothing, model).nothing)


def test_a_result_without_worth_is_not_told():
    """Missing for sure, and in the list or not by the toss of a coin: any name may harm."""
    found = decide(GOOD, given_odds(missing=0.0, known=0.0, first=CLEAR))
    assert found.kind == "cannot_tell"
    sure = decide(GOOD, given_odds(missing=2.5, known=2.5, first=CLEAR), Worth(needless_name=-9.0))
    assert sure.kind == "cannot_tell"
    assert decide(GOOD, given_odds(missing=2.5, known=2.5, first=CLEAR)).kind == "identified"


def test_two_effects_that_both_are_missing_stand_above_one_that_explains_much_of_both():
    """By hand: alone 0.5, 0.3 and 0.2; with 0.8 both of the last two are, in shares 3 to 2.

    0.5 x 0.2, 0.3 x 0.2 + 0.8 x 3/5, 0.2 x 0.2 + 0.8 x 2/5.
    """
    names = ("hysteresis", "creep", "payload")
    left = [-math.log(chance) for chance in (0.5, 0.3, 0.2)]
    effects = tuple(replace(CREEP, effect=name) for name in names)
    two = math.log(0.8 / 0.2)
    evidence = replace(GOOD, effects=effects, proposals=(ALONE, PAIR))
    model = given_odds(missing=50.0, known=50.0, two=two)
    first = Logistic(tuple(-1.0 if f.name == "amplitudes" else 0.0 for f in FEATURES["first"]))
    sizes = [math.exp(each) - 1.0 for each in left]
    sized = zip(effects, sizes, strict=True)
    effects = tuple(replace(one, free_amplitudes=size) for one, size in sized)
    model.models["first"] = first
    found = probabilities(replace(evidence, effects=effects), model)
    assert shares_of(replace(evidence, effects=effects), first)["creep"] == pytest.approx(0.3)
    assert found.pair == pytest.approx(0.8)
    assert found.effects == pytest.approx({"creep": 0.54, "payload": 0.36, "hysteresis": 0.1})


def test_two_wrong_names_cost_what_one_costs():
    """Of 90 % that an effect of the list is missing, 40 are both, 20 one of the two, 30 neither."""
    effects = {"creep": 0.4, "payload": 0.2, "contact": 0.3}
    chances = Probabilities(0.1, 0.0, 0.0, effects, 0.4, ("creep", "payload"))
    worth = Worth(needless_name=-1.0, wrong_name=-2.0, half_pair=0.0)
    found = {one.kind: one for one in statements(GOOD, chances, worth)}
    assert found["several"].probability == 0.4
    assert found["several"].worth == pytest.approx(0.4 - 2.0 * 0.3 - 1.0 * 0.1)
