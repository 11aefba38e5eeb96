"""The fit and the report of the decision, against independent formulas and by hand."""

import json
from dataclasses import asdict, fields, replace
from functools import lru_cache

import numpy as np
import pytest

from benchmarks.decision import stated_values
from benchmarks.decision.evidence_log import (
    EVIDENCE,
    JUDGED,
    Labelled,
    append,
    in_order,
    keep,
    posed_on,
    read,
    stored,
    without_truth,
)
from benchmarks.decision.fit import (
    PRIORS,
    about,
    case_weights,
    curve_of,
    fit,
    fit_one,
    log_losses,
    model_of,
    sample,
)
from benchmarks.decision.own_rig import ROUND, Plan, draw
from benchmarks.decision.study import Collected, run
from benchmarks.decision.table import (
    BINS,
    Judged,
    calibration_error,
    default_models,
    goals,
    left_out,
    markdown,
    neighbours,
    rate,
    serious,
)
from surgisoft.diagnosis.criteria import CLAIM, WORTH, Claim, Worth
from surgisoft.diagnosis.decision import (
    ASSET,
    FEATURES,
    Curve,
    Decision,
    Logistic,
    Probabilities,
    chosen,
    content_hash,
    features_of,
    probabilities,
)
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.errors import InputError
from tests.diagnosis.synthetic import recording, still_model, walk
from tests.diagnosis.test_decision import ALONE, CREEP, GOOD, LAG

NOTHING = replace(GOOD, effects=(replace(CREEP, gain=0.02, log_gain=0.01, z=0.0),), proposals=())


def case(number, source="a", label="known", truth=("creep",), evidence=GOOD, size=2.0, robot="1"):
    return Labelled(source, robot, str(number), label, truth, True, size, 1.0, 5.0, evidence, 3.0)


def some_cases(source="a", count=40, seed=0):
    """Cases of which an effect explains a random share; the more, the more often it is missing."""
    rng = np.random.default_rng(seed)
    answer = []
    for number in range(count):
        gain = float(rng.uniform())
        missing = rng.uniform() < gain
        best = replace(CREEP, gain=gain, log_gain=gain)
        evidence = replace(
            GOOD, effects=(best, LAG), proposals=(replace(ALONE, gain=gain, last_gain=gain),)
        )
        label = "known" if missing else "clean"
        truth = ("creep",) if missing else ()
        one = case(number, source, label, truth, evidence, 2.0 if missing else 0.0)
        answer.append(replace(one, robot=str(number % 4)))
    return answer


def test_calibration_error_by_hand():
    """Three bins: 2 x |0.55 - 0.5|, 1 x |0.85 - 1|, 1 x |0.97 - 0|, over 4."""
    sure, right = np.array([0.5, 0.6, 0.85, 0.97]), np.array([1.0, 0.0, 1.0, 0.0])
    expected = (2 * 0.05 + 0.15 + 0.97) / 4
    assert calibration_error(sure, right) == pytest.approx(expected)
    assert calibration_error(np.ones(3), np.ones(3)) == 0.0
    assert BINS[-1] == 1.0


def test_a_wilson_interval_by_its_formula():
    n, hits, z = 40, 37, 1.959964
    p = hits / n
    middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    text = rate([True] * hits + [False] * (n - hits))
    assert text == f"92 % (37 of 40; {100 * (middle - half):.0f}-{100 * (middle + half):.0f})"


def test_signs_hold_whatever_the_cases_say():
    """Where what explains less is missing more often, the weight is 0 and not negative."""
    cases = some_cases()
    turned = []
    for one in cases:
        missing = one.label == "clean"
        label, truth = ("known", ("creep",)) if missing else ("clean", ())
        turned.append(replace(one, label=label, truth=truth, effect_mm=2.0 * missing))
    model = fit_one("missing", sample("missing", turned), 0.1)
    place = [feature.name for feature in FEATURES["missing"]].index("explained")
    assert model.weights[place] == pytest.approx(0.0, abs=1e-9)
    assert fit_one("missing", sample("missing", cases), 0.1).weights[place] > 0.1


def test_the_fit_is_at_the_least_penalised_loss():
    """No small change of any free weight lowers the loss, computed from the losses of each case."""
    some = sample("missing", some_cases(count=60))
    model = fit_one("missing", some, 1.0)
    weights = case_weights("missing", some)

    def loss(values):
        losses = log_losses("missing", Logistic(tuple(values[:-1]), values[-1]), some)
        return weights @ losses + 0.5 * values[:-1] @ values[:-1] + 0.005 * values[-1] ** 2

    best = np.array([*model.weights, model.constant])
    for place in range(len(best)):
        for step in (1e-2, -1e-2):
            moved = best.copy()
            moved[place] += step
            if place == len(best) - 1 or moved[place] >= 0.0:
                assert loss(moved) >= loss(best) - 1e-6


def test_the_conditional_logit_is_a_softmax():
    some = sample("first", some_cases())
    model = fit_one("first", some, 0.3)
    rows = features_of("first", GOOD)
    odds = rows @ np.array(model.weights)
    share = np.exp(odds) / np.exp(odds).sum()
    one = [(rows, np.array([1.0, 0.0]), case(0))]
    assert log_losses("first", model, one)[0] == pytest.approx(-np.log(share[0]))
    assert share[0] > 0.8


def drawn(source, true, false):
    """A sample with so many cases of a source of which the statement is true, and false."""
    return [
        (np.zeros(1), np.array(float(right)), case(number, source))
        for right, count in ((1, true), (0, false))
        for number in range(count)
    ]


def test_every_source_counts_alike():
    weights = case_weights("known", drawn("a", 20, 10) + drawn("b", 6, 4))
    assert weights[:30].sum() == pytest.approx(weights[30:].sum())
    assert weights.mean() == pytest.approx(1.0)
    few = case_weights("known", drawn("a", 20, 10) + drawn("b", 20, 10) + drawn("c", 1, 0))
    assert few[-1] < 0.25 * few[:30].sum()


def test_how_often_pairs_were_drawn_does_not_count():
    """Of a source that is half pairs and of one that has few, pairs have the same weight."""
    weights = case_weights("two", drawn("a", 10, 10) + drawn("b", 10, 30))
    assert weights[:10].sum() / weights[:20].sum() == pytest.approx(PRIORS["two"])
    assert weights[20:30].sum() / weights[20:].sum() == pytest.approx(PRIORS["two"])


def test_two_effects_are_asked_about_wherever_an_effect_of_the_list_is_missing():
    pair = replace(GOOD, proposals=(ALONE, replace(ALONE, effects=("creep", "line_lag"))))
    truths = (("creep", "line_lag"), ("creep",), ("drift",), ("line_lag", "drift"))
    cases = [case(n, truth=truth, evidence=pair) for n, truth in enumerate(truths)]
    cases.append(case(4, label="unknown", truth=(), evidence=pair))
    first = Logistic((0.0,) * len(FEATURES["first"]))
    some = sample("two", cases, first)
    assert [(one.case, float(right)) for _, right, one in some] == [
        ("0", 1), ("1", 0), ("2", 0), ("3", 0),
    ]  # fmt: skip
    place = [feature.name for feature in FEATURES["two"]].index("one_of_them")
    assert [row[place] for row, _, _ in some] == [0.0] * 4, "creep or the lag, of these two"


def test_a_calibration_gives_back_how_often_effects_are_missing():
    """Of effects that were given 0.73, half are missing; of 0.27, one in twenty."""
    predicted = []
    for chance, count, hits in ((0.73, 200, 100), (0.27, 200, 10)):
        for number in range(count):
            known = number < hits
            one = case(number, label="known" if known else "clean", truth=("creep",) * known)
            predicted.append((one, Probabilities(1 - chance, 0, 0, {"creep": chance}, 0, ())))
    curve = curve_of(1, predicted)
    assert curve(0.73) == pytest.approx(0.5, abs=0.02)
    assert curve(0.27) == pytest.approx(0.05, abs=0.02)
    assert curve_of(2, predicted) == Curve()


def test_cases_without_their_truth_share_the_weight_of_unknown_ones():
    """Six known cases, four of an unknown effect and ten without their truth, at 0.3 of a real one.

    The two kinds count alike (PRIORS), 5 of 10 each, and of the unknown ones' 5 the ten have 3 / 7.
    Where no share is stated, in `missing`, they take nothing from cases where nothing is missing.
    """
    known = [case(n) for n in range(6)]
    unknown = [case(n, label="unknown", truth=("leak",)) for n in range(6, 10)]
    twins = [replace(case(n, label="unknown"), left_out=("creep",)) for n in range(10, 20)]
    weights = case_weights("known", sample("known", known + unknown + twins), 0.3)
    assert weights[:6] == pytest.approx(6 * [5 / 6])
    assert weights[6:10] == pytest.approx(4 * [5 * 4 / 7 / 4])
    assert weights[10:] == pytest.approx(10 * [5 * 3 / 7 / 10])
    clean = [case(n, label="clean", truth=(), size=0.0) for n in range(20, 30)]
    weights = case_weights("missing", sample("missing", known + unknown + twins + clean), 0.3)
    assert weights[-10:] == pytest.approx(10 * [1.0])
    assert weights[:20].sum() == pytest.approx(10.0)


def test_the_table_counts_cases_without_their_truth_apart():
    some = [
        said("unknown_effect", (), label="unknown", truth=("leak",)),
        said("unknown_effect", (), label="unknown", left_out=("creep",)),
        said("identified", ("drift",), label="unknown", left_out=("creep",)),
    ]
    lines = {line.split("|")[1].strip(): line for line in goals({"all": some}).splitlines()}
    assert "100 % (1 of 1" in lines["unknown called unknown"]
    assert "50 % (1 of 2" in lines["a known effect that was no candidate: called unknown"]
    assert "50 % (1 of 2" in lines["a known effect that was no candidate: another one named"]
    assert "| creep | 2 | 1 | drift 1 |" in neighbours(some)


def test_a_source_is_judged_without_its_own_cases(monkeypatch):
    from benchmarks.decision import table

    seen = []
    monkeypatch.setattr(
        table, "fit", lambda some: seen.append({c.source for c in some}) or fit(some)
    )
    found = left_out([*some_cases("a"), *some_cases("b", seed=1), *some_cases("c", seed=2)])
    assert list(found) == ["a", "b", "c"]
    assert seen == [{"b", "c"}, {"a", "c"}, {"a", "b"}]
    assert all({one.case.source for one in some} == {name} for name, some in found.items())


def said(kind, effects, sure=0.9, left_out=(), **about):
    chances = Probabilities(0.0, 0.0, 0.0, dict.fromkeys(effects, sure), 0.0, ())
    return Judged(
        replace(case(0, **about), left_out=left_out), Decision(kind, effects, sure, chances)
    )


@pytest.mark.parametrize(
    ("one", "right"),
    [
        (said("identified", ("creep",)), True),
        (said("identified", ("drift",)), False),
        (said("ambiguous", ("drift", "creep")), True),
        (said("several", ("drift", "creep")), False),
        (said("several", ("payload", "creep"), truth=("creep", "payload")), True),
        (said("identified", ("drift",), label="unknown", truth=("leak",)), False),
        (said("unknown_effect", (), label="unknown", truth=("leak",)), True),
        (said("unknown_effect", ()), False),
        (said("nothing_missing", (), label="clean", truth=()), True),
        (said("nothing_missing", ()), False),
        (said("nothing_missing", (), size=0.3), True),
    ],
)
def test_what_a_right_statement_is(one, right):
    assert one.right is right


def test_the_table_counts_by_hand():
    some = [
        said("identified", ("creep",), 0.97),
        said("identified", ("drift",), 0.97),
        said("ambiguous", ("creep", "drift"), 0.9),
        said("cannot_tell", (), 0.3),
    ]
    lines = {line.split("|")[1].strip(): line for line in goals({"all": some}).splitlines()}
    assert "50 % (2 of 4" in lines["named, alone or in a set of two"]
    assert "50 % (1 of 2" in lines["statements with confidence >= 0.95 right"]
    assert "25 % (1 of 4" in lines["`cannot_tell`"]
    assert "25 % (1 of 4" in lines["a wrong name with confidence >= 0.8, of all cases"]


def test_wrong_names_with_confidence_are_listed_one_by_one():
    some = [
        said("identified", ("creep",), 0.97),
        said("identified", ("drift",), 0.79),
        said("several", ("drift", "creep"), 0.81),
        said("ambiguous", ("drift", "twist"), 0.9, label="clean", truth=()),
    ]
    lines = serious(some).splitlines()[2:]
    assert [line.split("|")[3:6] for line in lines] == [
        [" clean ", " drift or twist ", " 0.90 "],
        [" creep ", " drift and creep ", " 0.81 "],
    ]
    assert serious(some[:2]) == "None."


def test_a_log_survives_a_broken_line_and_another_version(tmp_path):
    log = tmp_path / "a.jsonl"
    append(log, case(1))
    append(log, replace(case(2), version=99))
    with log.open("a") as file:
        file.write('{"source": "a", "rob')
    assert read(log) == [case(1)]


def all_of(files):
    """All cases of stored files in the order in which a fit reads them."""
    return in_order([one for own in files.values() for one in own])


@lru_cache
def evidence():
    """All stored cases of the fit, read once."""
    return all_of(stored())


def test_the_asset_was_fitted_to_the_stored_evidence():
    """Sources, numbers of cases and hashes are those that the asset in force states."""
    values = json.loads(ASSET.read_text())
    cases = evidence()
    assert {name: about(name, cases) for name in {one.source for one in cases}} == values["sources"]


@pytest.mark.parametrize("name", list(FEATURES))
def test_the_stored_evidence_gives_the_weights_of_the_asset(name):
    """At the penalties that the asset states. (L-BFGS ends within 0.01 of the least loss' weights
    on any processor.)"""
    one = json.loads(ASSET.read_text())["models"][name]
    values = json.loads(ASSET.read_text())["models"]["first"]
    first = Logistic(tuple(values["weights"].values()))
    model = fit_one(name, sample(name, evidence(), first), one["penalty"], one["twin_weight"])
    assert model.constant == pytest.approx(one["constant"], abs=0.01)
    assert model.weights == pytest.approx(list(one["weights"].values()), abs=0.01)


def test_stated_values_are_varied_one_at_a_time():
    tried = list(stated_values.variants())
    names = {field.name for some in (Claim, Worth) for field in fields(some)}
    assert {name for name, *_ in tried} == names
    for name, value, other, costs, claim in tried:
        both = asdict(costs) | asdict(claim)
        default = asdict(WORTH) | asdict(CLAIM)
        assert {key for key in both if both[key] != default[key]} == {name}
        assert (both[name], default[name]) == (other, value)
    assert stated_values.changed("near_floor", 1.3, 2.0) == pytest.approx(1.6)
    assert stated_values.changed("least_probability", 0.7, 2.0) < 1.0
    assert stated_values.changed("wrong_nothing", -2.0, 0.5) == -1.0


def test_a_stated_value_changes_the_results_that_it_decides():
    """Where "nothing is missing" may never be claimed, just these results change."""
    cases = [case for case in stored()["own_rig"] if case.label == "clean"][:8]
    some = [
        (case, chances := probabilities(case.evidence), chosen(case.evidence, chances))
        for case in cases
    ]
    assert stated_values.row(some, WORTH, CLAIM) == "0 | +0 | +0"
    never = replace(CLAIM, most_over_validated=0.0)
    quiet = sum(found.kind == "nothing_missing" for _, _, found in some)
    assert quiet > 0
    assert int(stated_values.row(some, WORTH, never).split(" | ")[0]) == quiet


def test_robots_that_judge_took_no_part_in_the_fit():
    """No recording of a judged case is one of a case of the fit, nor of its robot."""
    fitted = {(one.source, one.robot) for some in stored().values() for one in some}
    assert fitted
    judges = stored(EVIDENCE / JUDGED)
    assert "elastica_b" in judges
    for name, some in judges.items():
        kin = next((source for source, _ in fitted if name.startswith(source)), name)
        assert not fitted & {(kin, one.robot) for one in some}


def test_stored_evidence_is_read_back_and_does_not_depend_on_the_order(tmp_path):
    some = [replace(one, effect_mm=1.0 / 3.0) for one in some_cases("a", 5)]
    keep(tmp_path, "a", some)
    first = (tmp_path / "a.jsonl.gz").read_bytes()
    keep(tmp_path, "a", some[::-1])
    assert (tmp_path / "a.jsonl.gz").read_bytes() == first
    (back,) = stored(tmp_path).values()
    assert [one.case for one in back] == [one.case for one in some]
    assert back[0].effect_mm == 0.33333
    assert about("a", back) == about("a", some)
    assert [Labelled.from_json(one.to_json()) for one in back] == back


def test_without_options_the_fit_is_to_the_stored_evidence(tmp_path):
    keep(tmp_path, "a", some_cases("a"))
    keep(tmp_path, "b", some_cases("b", 30, seed=1))
    keep(tmp_path / JUDGED, "a_b", some_cases("a_b", 10, seed=2))
    default = [replace(one, models="default") for one in some_cases("a_b", 10, seed=2)]
    keep(tmp_path / JUDGED, "a_b.default", default)
    new = Collected(Plan([1], []))
    cases, aside, values = run(new, tmp_path / "work", 1, lambda *_: None, tmp_path)
    assert (len(cases), len(aside)) == (70, 20)
    assert {name: one["cases"] for name, one in values["sources"].items()} == {"a": 40, "b": 30}
    assert values["command"] == "surgisoft benchmark decision"
    assert not (tmp_path / "work").exists()
    new = Collected(Plan([1], []), included=["a_b"])
    cases, aside, values = run(new, tmp_path / "work", 1, lambda *_: None, tmp_path)
    assert (len(cases), len(aside)) == (90, 0)
    assert values["sources"]["a_b"]["cases"] == 20
    assert values["command"] == "surgisoft benchmark decision --include a_b"
    new = Collected(Plan([1], []), included=["b"])
    with pytest.raises(InputError, match="--include b: expected a source that is only judged: a_b"):
        run(new, tmp_path / "work", 1, lambda *_: None, tmp_path)


def test_default_models_are_reported_and_networks_alone_beside_them(tmp_path):
    alone, own = some_cases("a"), some_cases("b", 30, seed=1)
    default = [replace(one, models="default") for one in some_cases("a", 40, seed=2)]
    keep(tmp_path, "a", alone)
    keep(tmp_path, "a.default", default)
    keep(tmp_path, "b", own)
    cases, _, values = run(Collected(Plan([1], [])), tmp_path / "work", 1, print, tmp_path)
    assert values["sources"]["a"]["cases"] == 80
    asked = [(one.source, one.models) for one in default_models(cases)]
    assert asked == [("a", "default")] * 40 + [("b", "alone")] * 30
    left = [(one.source, one.models) for one in default_models(cases, default=False)]
    assert left == [("a", "alone")] * 40
    table = markdown(cases, values)
    first, second = table.split("### The same cases with networks alone")
    assert "| a | 4 | 40 |" in first
    of = f"of {sum(one.label == 'known' and len(one.truth) == 1 for one in default)}"
    assert of in first.split("named, alone")[1].splitlines()[0]
    assert "| b |" not in second.split("### More or fewer names")[0]
    new = [replace(one, models="default") for one in some_cases("c", 12, seed=3)]
    table = markdown(cases, values, [*some_cases("c", 8, seed=4), *new])
    unseen, beside = table.split("## Unseen robots")[1].split("### The same unseen robots")
    assert "of 12)" in unseen.split("`cannot_tell`")[1].splitlines()[0].replace(";", ")")
    assert "of 8)" in beside.split("`cannot_tell`")[1].splitlines()[0].replace(";", ")")


def test_without_any_evidence_the_message_says_what_to_do(tmp_path):
    with pytest.raises(InputError, match="no stored evidence; give --count or --cases"):
        run(Collected(Plan([1], [])), tmp_path / "work", 1, lambda *_: None, tmp_path)


def test_the_asset_names_its_cases():
    cases = [*some_cases("a"), *some_cases("b", 20, seed=1)]
    cases = [replace(one, robot=str(int(one.robot) % 2)) for one in cases]
    values = fit(cases, "command")
    assert values["sources"]["a"]["cases"] == 40
    assert values["sha256"] == content_hash(values)
    other = fit([replace(cases[0], effect_mm=3.0), *cases[1:]], "command")
    assert other["sources"]["a"]["evidence_sha256"] != values["sources"]["a"]["evidence_sha256"]
    assert other["sources"]["b"] == values["sources"]["b"]
    assert model_of(json.loads(json.dumps(values))).models["missing"].weights
    table = markdown(cases, values, each_robot=True)
    assert "| a | 2 | 40 |" in table
    assert "## Each robot left out of the fit" in table


def test_rounds_of_cases_have_the_shares_that_are_stated():
    drawn = draw(Plan([1, 2, 3], [1]), 4 * len(ROUND), 5)
    kinds = [len(case.hidden) for case, _ in drawn]
    assert kinds.count(2) == 4 * ROUND.count("pair")
    assert sum(case.undertrained for case, _ in drawn) == 4
    assert sum(asked != case.robot for case, asked in drawn) == 4
    assert len({case.take for case, _ in drawn}) == len(drawn)
    assert draw(Plan([1, 2, 3], [1]), 7, 5) == drawn[:7]


def test_without_its_truth_a_case_is_diagnosed_as_without_the_effect():
    """The effect is no candidate, alone, in pairs or relaxed: as `diagnose --without` finds it."""
    recorded = recording(np.linspace(0.0, 1.0, 240), walk(240))
    posed = posed_on(still_model(), [recorded])
    one = case(1, truth=("drift",))
    twin = without_truth(one, posed)
    assert (twin.label, twin.left_out, twin.robot) == ("unknown", ("drift",), one.robot)
    found = diagnose(still_model(), [recorded], without=["drift"], setup_tests=False)
    assert twin.evidence == found.statistics
    names = {each.name for each in posed.tried}
    assert {each.effect for each in twin.evidence.effects} == names - {"drift"} < names
    assert without_truth(twin, posed) is None
