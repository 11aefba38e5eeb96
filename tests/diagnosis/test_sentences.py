"""What results made by hand say: amendments, diagnoses and what is left after an experiment."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from surgisoft.diagnosis.amend import Amendment, Fall, Track, errs_more
from surgisoft.diagnosis.data_quality import LONG_ROWS, data_quality_warnings, thinning_notes
from surgisoft.diagnosis.decision import (
    ASSET,
    Decision,
    Probabilities,
    Statement,
    content_hash,
    load_decision,
)
from surgisoft.diagnosis.design.schedules import SETUPS
from surgisoft.diagnosis.diagnose import (
    Diagnosis,
    ErrorLevels,
    Ranked,
    Verdict,
    effect_left,
    error_along,
    local_error,
    nearest,
    next_command,
    periodic,
    sentence_of,
    since,
    smooth_error,
    with_refit,
)
from surgisoft.diagnosis.estimation.intervals import Parameter
from surgisoft.diagnosis.improve import Improvement
from surgisoft.diagnosis.other_models import callable_arm, open_model, polynomial_of
from surgisoft.diagnosis.pages.amendment import amend_page
from surgisoft.diagnosis.pages.diagnosis import diagnosis_page
from surgisoft.diagnosis.weight import under_weight
from surgisoft.errors import InputError
from surgisoft.surrogate.callables.named import given_callable
from tests.diagnosis.synthetic import recording, still_model, walk
from tests.diagnosis.test_decision import QUIET


def fall(before=0.5, after=0.2, **fields) -> Fall:
    values = {"floor": 0.1, "fall": before - after, "ci95": (0.1, 0.4), "rows": 90, "blocks": 9}
    return Fall(before, after, **(values | fields))


def amendment(**fields) -> Amendment:
    values = {
        "model": None, "effects": ("creep",), "refitted": (), "parameters": (),
        "held_out": fall(0.5, 0.15), "alone": fall(), "training": fall(), "retuned": False,
        "tracks": (None, None), "seconds": 1.0,
    }  # fmt: skip
    return Amendment(**(values | fields))


CHANGE = SimpleNamespace(before=("monday", "tuesday"))
NUMBERS = (
    "0.500 to 0.200 mm on held-out data (reduction 0.300 mm, 95 % 0.100 to 0.400; floor 0.100 mm)"
)


@pytest.mark.parametrize(
    ("fields", "sentence"),
    [
        ({}, f"creep: error reduced from {NUMBERS}"),
        (
            {"retuned": True},
            "creep: error reduced from 0.500 to 0.150 mm on held-out data (reduction 0.350 mm, "
            "95 % 0.100 to 0.400; floor 0.100 mm), with the network's last layer re-tuned; "
            "0.200 mm with the effects alone",
        ),
        (
            {"retuned": True, "alone": fall(ci95=(-0.1, 0.4))},
            "is not significant; 0.150 mm with the network's last layer re-tuned",
        ),
        (
            {"retuned": True, "held_out": fall(0.5, 0.25)},
            "re-tuned; 0.200 mm with the effects alone, which is lower on these rows",
        ),
        (
            {"retuned": True, "held_out": fall(0.5, 0.25, ci95=(-0.1, 0.4))},
            "; 0.250 mm with the network's last layer re-tuned, more than with the effects alone",
        ),
        (
            {"alone": fall(ci95=(-0.1, 0.4))},
            "creep: no reduction of the error is claimed: 0.500 to",
        ),
        (
            {"change": CHANGE, "model_error": fall(2.0, 1.5)},
            "creep: unexplained change since monday + tuesday reduced from 0.500 to 0.200 mm",
        ),
        (
            {"change": CHANGE, "model_error": fall(2.0, 1.5), "alone": fall(ci95=(-0.1, 0.4))},
            "creep: no reduction of the unexplained change since monday + tuesday is claimed: ",
        ),
        (
            {"refit": object()},
            "fitted together with the network; the network alone, trained for as many epochs, rea",
        ),
        (
            {"refit": object(), "held_out": fall(in_fit=0.25)},
            "the given model, which had been fitted to 25% of these rows, has 0.500 mm there",
        ),
        (
            {"refit": object(), "alone": fall(ci95=(-0.1, 0.4))},
            "no reduction of the error is claimed for the effects: the network alone, trained for ",
        ),
    ],
)
def test_an_amendment_says_what_it_is_worth(fields, sentence):
    assert sentence in amendment(**fields).sentence


def test_errors_that_are_printed_alike_are_not_called_lower():
    made = amendment(retuned=True, alone=fall(0.5, 0.2001), held_out=fall(0.5, 0.2004))
    assert made.sentence.endswith("0.200 mm with the effects alone")


def test_a_fall_is_claimed_where_it_is_certain_large_and_due_to_the_effects():
    assert fall().claimed
    assert not fall(ci95=(-0.01, 0.4)).claimed
    assert "is not significant" in fall(ci95=(-0.01, 0.4)).sentence
    assert not fall(fall=1e-4, ci95=(1e-5, 2e-4)).claimed
    assert fall(fall=1e-4, ci95=(1e-5, 2e-4)).sentence.endswith("is too small")
    assert not fall(p_value=0.9).claimed
    assert (
        "may be the model's own error, which the effect resembles (p 0.9)"
        in fall(p_value=0.9).sentence
    )
    changed = amendment(change=CHANGE, model_error=fall(2.0, 1.5), retuned=True)
    assert changed.sentence.endswith("2.000 to 1.500 mm, its network's last layer re-tuned")


def test_a_note_says_where_the_model_itself_errs_more():
    """The change is explained, and the model's own error had cancelled it in part."""
    worse = fall(0.7, 0.9, ci95=(-0.3, -0.05))
    changed = amendment(change=CHANGE, model_error=worse)
    assert changed.claimed, "what has changed"
    assert changed.sentence.endswith("; error of the model itself 0.700 to 0.900 mm, which is more")
    (note,) = errs_more(worse)
    assert note.startswith("the new model itself errs more than the given one on the held-out rows")
    assert "0.700 to 0.900 mm (rise 0.200 mm, 95 % 0.050 to 0.300)" in note
    unclear = fall(0.7, 0.9, ci95=(-0.3, 0.05))
    sentence = amendment(change=CHANGE, model_error=unclear).sentence
    assert sentence.endswith("; error of the model itself 0.700 to 0.900 mm")
    assert errs_more(unclear) == errs_more(None) == ()


def test_an_improvement_says_what_was_added():
    rounds = (SimpleNamespace(step="creep", error_mm=0.2), SimpleNamespace(step=None, error_mm=0.2))
    found = Improvement(None, rounds, (), fall(), (None, None), 1.0)
    assert found.claimed
    assert found.sentence == f"creep: error reduced from {NUMBERS}"
    nothing = Improvement(
        None, (SimpleNamespace(step=None, error_mm=None, sentence="it fits"),), (), fall(),
        (None, None), 1.0,
    )  # fmt: skip
    assert not nothing.claimed
    assert nothing.sentence == "nothing was added: it fits"


CHANCES = Probabilities(0.1, 0.1, 0.1, {"creep": 0.5, "drift": 0.2}, 0.0, ())
NONE = Probabilities(0.1, 0.1, 0.8, {}, 0.0, ())
LEVELS = ErrorLevels(0.5, 0.1, 0.2, validated=0.4)
STATEMENTS = (
    Statement("identified", ("creep",), 0.4, 0.3),
    Statement("ambiguous", ("creep", "drift"), 0.9, 0.2),
    Statement("nothing_missing", (), 0.3, 0.1),
)


def decision(kind, *effects, reason=None, chances=CHANCES, statements=()) -> Decision:
    return Decision(kind, effects, 0.75, chances, reason, statements)


@pytest.mark.parametrize(
    ("given", "sentence", "command"),
    [
        (decision("identified", "creep"), "creep is missing (confidence 0.75): with it 0.15 mm rem",
         "surgisoft amend {model} --effect creep --data {data}{before} -o NEW"),
        (decision("several", "creep", "drift"), "creep and drift are missing (confidence 0.75 in b",
         "surgisoft amend {model} --effect creep drift --data {data}{before} -o NEW"),
        (decision("ambiguous", "creep", "drift"), "cannot tell creep from drift with these record",
         "surgisoft next-experiment {model} {data}{before} --between creep drift -o SCHEDULE.csv"),
        (decision("unknown_effect"), "none of the known ones (confidence 0.75; none is near)",
         "surgisoft compare {model} {data}{before} --report PAGE"),
        (decision("surrogate_undertrained"), "and most probably it is the network's own; it needs",
         "surgisoft fit {data} -o NEW"),
        (decision("surrogate_undertrained", reason="network"), "the model does not describe this a",
         "surgisoft fit {data} -o NEW"),
        (decision("surrogate_undertrained", reason="learned"), "has learned part of the missing ef",
         "surgisoft diagnose {model} {data} --refit always"),
        (decision("cannot_tell", reason="few_data", statements=STATEMENTS),
         "(most probable: creep is missing 0.40, nothing is missing 0.30); error 0.5 mm, floor 0.1",
         "surgisoft next-experiment {model} {data}{before} --between creep drift -o SCHEDULE.csv"),
        (decision("cannot_tell", chances=NONE), "on these recordings no cause is probable enough",
         "surgisoft next-experiment {model} {data}{before} -o SCHEDULE.csv"),
        (decision("cannot_tell", reason="repeatability"), "record the same schedule twice before a",
         ""),
        (decision("nothing_missing"), "show no missing effect (confidence 0.75); error",
         ""),
    ],
)  # fmt: skip
def test_each_kind_of_result_has_its_sentence_and_its_next_command(given, sentence, command):
    assert sentence in sentence_of(given, LEVELS, [0.15])
    assert next_command(given) == command


PAGE = "surgisoft compare {model} {data}{before} --report PAGE"


@pytest.mark.parametrize(
    ("reason", "static", "said"),
    [
        (None, False, "most probably it is the model's own: its parameters or its form are off;"),
        ("network", False, "the model does not describe this arm: correct its parameters, its fr"),
        ("network", True, "explains most of the error, which is 1.25 times the model's validated"),
        ("learned", False, "so the parameters of the model may make up for a part of the missin"),
    ],
)
def test_a_model_of_other_origin_is_not_to_be_replaced_by_a_network(reason, static, said):
    given = decision("surrogate_undertrained", reason=reason)
    text = sentence_of(given, LEVELS, [0.15], static=static, fitted=False)
    assert said in text
    assert "network" not in text
    assert "fit " not in text
    assert next_command(given, trainable=False, fitted=False) == PAGE


@pytest.mark.parametrize(
    ("of", "command"),
    [
        ("called", "surgisoft improve M B.parquet -o NEW"),
        ("fitted", "surgisoft fit B.parquet -o NEW"),
    ],
)
def test_a_change_within_the_error_of_the_model_asks_for_less_of_it_before(of, command):
    """Recordings after the change would teach the model the change."""
    given = decision("surrogate_undertrained")
    verdict = Verdict(given.kind, (), sentence_of(given, LEVELS, [0.15]))
    found = Diagnosis(verdict, LEVELS, (), next_command=next_command(given))
    both = SimpleNamespace(names="B", used=False, change=SimpleNamespace(sentence="not paired"))
    model = still_model()
    if of == "called":
        model = callable_arm(given_callable(bend), [recording(np.zeros(400), walk(400, 2))])
    told = since(found, both, SimpleNamespace(problem=SimpleNamespace(model=model)))
    assert told.command("M", "A.parquet", "B.parquet --paired never", "B.parquet") == command


def bend(time_s, actuation):
    """Key points (T, 2, 3), mm: the tip moves by a millimetre per kPa of the first chamber."""
    points = np.zeros((len(actuation), 2, 3))
    points[:, 1] = np.stack([actuation[:, 0], 0 * time_s, 100 + 0 * time_s], axis=1)
    return points


def test_a_model_that_cannot_be_trained_on_is_fitted_anew_where_it_has_learned_an_effect():
    learned = decision("surrogate_undertrained", reason="learned")
    fit_anew = "surgisoft fit {data} --inputs pressure --effects creep -o NEW"
    assert next_command(learned, trainable=False) == fit_anew


@pytest.mark.parametrize(("nothing", "kind"), [(0.5, "cannot_tell"), (0.8, "nothing_missing")])
def test_without_a_winner_nothing_is_missing_only_where_that_is_probable_enough(nothing, kind):
    """A wrong "nothing" costs twice what a right one is worth: two thirds are needed."""
    chances = Probabilities(nothing - 0.1, 0.1, 0.0, {"creep": 1.0 - nothing}, 0.0, ())
    named = Diagnosis(
        Verdict("identified", ("creep",), ""), LEVELS, (), statistics=QUIET, probabilities=chances
    )
    joint = SimpleNamespace(
        winner=None, candidates=[SimpleNamespace(effect="creep")], sentence="none does better"
    )
    found = with_refit(named, joint, None)
    assert found.verdict.kind == kind
    assert found.verdict.confidence == nothing
    assert found.checks == ("none does better",)


def test_without_a_winner_the_most_probable_of_what_is_left_is_told():
    """Creep was tried: with it the network does no better than alone. A payload was not."""
    chances = Probabilities(0.44, 0.05, 0.02, {"creep": 0.35, "payload": 0.14}, 0.0, ())
    statements = (
        Statement("nothing_missing", (), 0.44, 0.0),
        Statement("identified", ("creep",), 0.35, 0.0),
        Statement("ambiguous", ("creep", "payload"), 0.49, 0.1),
    )
    residuals = Diagnosis(
        Verdict("cannot_tell", (), "", reason="learned"), LEVELS, (), statistics=QUIET,
        probabilities=chances, statements=statements, next_command="surgisoft fit",
    )  # fmt: skip
    joint = SimpleNamespace(
        winner=None, candidates=[SimpleNamespace(effect="creep")], sentence="none does better"
    )
    found = with_refit(residuals, joint, None)
    told = "(most probable: nothing is missing 0.44, payload is missing 0.14); error"
    assert told in found.verdict.sentence
    assert found.probabilities == chances
    assert found.statements == statements


def test_what_cannot_be_told_mentions_the_two_most_probable_causes():
    """Also an effect that no statement of its own could be made of."""
    some = (Statement("identified", ("creep",), 0.4, 0.3), Statement("unknown_effect", (), 0.1, 0))
    chances = Probabilities(0.1, 0.1, 0.1, {"creep": 0.4, "drift": 0.3}, 0.0, ())
    given = decision("cannot_tell", reason="few_data", chances=chances, statements=some)
    text = "(most probable: creep is missing 0.40, drift is missing 0.30); error"
    assert text in sentence_of(given, LEVELS, [0.15])


@pytest.mark.parametrize(("here_mm", "told"), [(4.1, 1), (3.9, 0)])
def test_an_error_that_is_large_in_one_stretch_is_called_local(here_mm, told):
    """Two key points, each off by 4 / 3 mm along one axis elsewhere; a fifth of the rows here."""
    residual = np.zeros((50, 2, 3))
    residual[..., 1] = 4.0 / 3.0
    residual[20:30, :, 1] = here_mm
    rows = {"residual": residual, "block": np.arange(50) // 10, "index": torch.arange(50)}
    timed = SimpleNamespace(timed=np.ones(50, bool), along_s=0.5 * np.arange(50))
    along = error_along(SimpleNamespace(table=timed, **rows))
    assert along.from_s == (0.0, 5.0, 10.0, 15.0, 20.0)
    assert along.to_s == (4.5, 9.5, 14.5, 19.5, 24.5)
    assert along.rmse_mm == pytest.approx([4 / 3, 4 / 3, here_mm, 4 / 3, 4 / 3])
    found = local_error(along)
    assert len(found) == told
    if told:
        assert (
            "concentrated from 10 to 14 s: 4.1 mm, 3.1 times the median of all blocks" in found[0]
        )
        assert "from 10 to 14 s, all recordings in turn: 4.1 mm" in local_error(along, 2)[0]
        begin, end = ([value / 12 for value in ends] for ends in (along.from_s, along.to_s))
        short = replace(along, from_s=tuple(begin), to_s=tuple(end))
        assert "concentrated from 0.8 to 1.2 s: 4.1 mm" in local_error(short)[0]
    shown = Diagnosis(Verdict("nothing_missing", (), ""), LEVELS, (), along=along)
    (picture,) = next(
        part.parts
        for part in diagnosis_page(shown, "x").parts
        if getattr(part, "title", "") == "Along the recordings"
    )
    assert ("red: more than 3 times the median" in picture.alt) == bool(told)
    untimed = SimpleNamespace(table=SimpleNamespace(timed=np.zeros(50, bool)), **rows)
    assert error_along(untimed) is None
    assert local_error(None) == []


def test_the_effect_nearest_to_an_unknown_one_is_that_which_alone_explains_most():
    """The ranking has the more probable one first. Less than 5 % is next to nothing."""
    rows = [
        Ranked(name, 0.1, gain, 0.0, 1.0, (0.9, 1.1), 0.5, 0.0, {})
        for name, gain in (("creep", 0.002), ("drift", 0.15), ("twist", 0.04))
    ]
    assert nearest(rows) == "drift"
    assert nearest(rows[::2]) is None
    assert nearest([]) is None
    text = sentence_of(decision("unknown_effect"), LEVELS, [], near="drift")
    assert "(confidence 0.75; nearest: drift)" in text


@pytest.mark.parametrize("reason", [None, "network", "learned"])
@pytest.mark.parametrize(
    ("validated", "size"),
    [
        (
            0.4,
            "the error is 1.25 times the model's validated error (0.4 mm with the noise of these",
        ),
        (0.499, "the error is as large as the model's validated error (0.499 mm with the noise"),
        (0.5, "the error is no larger than the model's validated error (0.5 mm with the noise"),
        (0.6, "the error is no larger than the model's validated error (0.6 mm with the noise"),
    ],
)
def test_the_error_is_called_as_large_as_it_is_beside_the_validated_one(reason, validated, size):
    """What is compared is printed, and the words follow from it."""
    given = decision("surrogate_undertrained", reason=reason)
    text = sentence_of(given, replace(LEVELS, validated=validated), [])
    assert size in text
    assert text.endswith("; error 0.5 mm, floor 0.1 mm")


def test_a_static_function_is_named_only_where_it_explains_most():
    given = decision("surrogate_undertrained", reason="network")
    assert "so the model does not describe this arm" in sentence_of(given, LEVELS, [])
    text = "a function of the actuation alone explains most of the error, which is 1.25 times"
    assert text in sentence_of(given, LEVELS, [], static=True)
    assert text not in sentence_of(given, LEVELS, [])


@pytest.mark.parametrize(
    ("second", "head"),
    [
        (
            0.03,
            "creep is probably missing, with a probability of 0.72; drift comes next, with 0.0",
        ),
        (0.06, "cannot tell creep from drift with these recordings (confidence 0.75 that it is on"),
    ],
)
def test_of_a_set_whose_second_effect_is_far_behind_the_first_is_named(second, head):
    chances = replace(CHANCES, effects={"creep": 0.72, "drift": second})
    given = decision("ambiguous", "creep", "drift", chances=chances)
    assert sentence_of(given, LEVELS, [0.15, 0.16]).startswith(head)
    told = sentence_of(given, LEVELS, [0.15, 0.3])
    assert ("with a probability of 0.72 only" in told) == (second > 0.05)
    weak = replace(CHANCES, effects={"creep": 0.45, "drift": 0.03})
    given = decision("ambiguous", "creep", "drift", chances=weak)
    assert sentence_of(given, LEVELS, [0.15, 0.16]).startswith("cannot tell creep from drift")


def test_an_error_that_is_mostly_the_models_own_is_told_beside_a_name():
    """Of 9.7 mm a smooth function of the actuation takes all but 2.8 mm, and none of a 1 mm."""
    own = replace(LEVELS, before=9.7, discrepancy_alone=2.8)
    (text,) = smooth_error(own, decision("identified", "creep"))
    assert "which alone takes the error from 9.7 to 2.8 mm" in text
    assert smooth_error(own, decision("cannot_tell")) == []
    for alone in (0.74, None):
        levels = replace(LEVELS, before=1.02, discrepancy_alone=alone)
        assert smooth_error(levels, decision("several", "creep", "drift")) == []


def test_effects_of_a_set_that_leave_different_errors_have_one_each():
    given = decision("ambiguous", "creep", "drift")
    assert "each would leave about 0.15 mm on" in sentence_of(given, LEVELS, [0.15, 0.16])
    alone = given.probabilities.effects["creep"]
    text = (
        "creep would leave 0.15 mm and drift 0.3 mm on held-out blocks, which makes it creep with "
    )
    text += f"a probability of {alone:.2f} only; error"
    assert text in sentence_of(given, LEVELS, [0.15, 0.3])
    other = given.probabilities.effects["drift"]
    said = sentence_of(given, LEVELS, [0.3, 0.15])
    assert f"makes it drift with a probability of {other:.2f}" in said
    unknown = decision("ambiguous", "creep", "drift", chances=NONE)
    said = sentence_of(unknown, LEVELS, [0.15, 0.3])
    assert "would leave 0.15 mm and drift 0.3 mm on held-out blocks; error" in said


def test_a_periodic_motion_is_said_with_its_frequency():
    said = periodic(SimpleNamespace(line=0.83, line_hz=0.249))
    assert "83 % of what no function of the actuation explains is a motion at 0.249 Hz" in said
    assert periodic(SimpleNamespace(line=0.4, line_hz=0.249)) == ""


def test_what_an_experiment_leaves():
    """By hand something is taken away: the error goes with it, or it is one of the others."""
    taking, plain = (
        next(name for name, setup in SETUPS.items() if bool(setup.removes) == removes)
        for removes in (True, False)
    )
    taken = SETUPS[taking].removes[0]

    def advice(setting, *effects):
        return SimpleNamespace(setting=setting, pairs=(SimpleNamespace(effects=effects),))

    def result(kind, *effects):
        return SimpleNamespace(verdict=SimpleNamespace(kind=kind, effects=effects))

    assert effect_left(advice(plain, "a", "b"), result("identified", "a")) == "a"
    assert effect_left(advice(plain, "a", "b"), result("ambiguous", "a", "b")) is None
    assert effect_left(advice(taking, taken, "b"), result("nothing_missing")) == taken
    assert effect_left(advice(taking, taken, "b"), result("identified", "c")) == "b"
    three = advice(taking, taken, "b", "c")
    assert effect_left(three, result("identified", "c")) == "c"
    assert effect_left(three, result("ambiguous", "b", "c")) is None


def test_a_damaged_decision_is_one_line(tmp_path):
    good = json.loads(ASSET.read_text())
    name = next(iter(good["models"]))
    weights = good["models"][name]["weights"]
    first = next(iter(weights))

    def model(**fields) -> dict:
        return {"models": good["models"] | {name: good["models"][name] | fields}}

    path = tmp_path / "decision.json"
    for changes, message in (
        ({"schema": True}, "a fitted decision of schema True, expected"),
        (model(weights={}), f"model '{name}' has the features , expected"),
        (model(weights=weights | {first: None}), "has a weight that is not a finite number"),
        (model(constant="x"), "has a weight that is not a finite number"),
        ({"calibration": []}, "calibration is not a table; fit it again"),
        ({"calibration": {"ghost": {"constant": 0.0, "slope": 1.0}}}, "calibration 'ghost' is not"),
    ):
        values = good | changes
        path.write_text(json.dumps(values | {"sha256": content_hash(values)}))
        with pytest.raises(InputError, match=r"^decision\.json: ") as error:
            load_decision(path)
        assert message in str(error.value)
        assert "\n" not in str(error.value)
    path.write_text(json.dumps(good | {"sha256": "0"}))
    with pytest.raises(InputError, match="does not match its hash; install again"):
        load_decision(path)
    with pytest.raises(InputError, match=r"none\.json: no fitted decision"):
        load_decision(tmp_path / "none.json")
    path.write_text(ASSET.read_text())
    assert set(load_decision(path).models) == set(good["models"])


class Wide:
    """A callable that states the range of four chambers."""

    low, high = [0.0] * 4, [9.0] * 4

    def __call__(self, time_s, actuation):
        return np.zeros((len(actuation), 3, 3))


def test_models_of_other_origin_that_do_not_fit():
    some = recording(np.zeros(60), walk(60))
    with pytest.raises(InputError, match="states the range of 4 chambers, but recording 'made'"):
        callable_arm(given_callable(Wide()), [some])
    with pytest.raises(InputError, match="take the place of a model: expected a name for it"):
        open_model(still_model(), [some], predictions=["a.csv"])
    with pytest.raises(InputError, match="expected --model-error only with a callable or"):
        open_model(still_model(), [some], error_mm=0.5)
    opened = open_model(still_model(), [some])
    assert opened.model.spec.chambers == 2


def test_a_model_of_a_bench_that_stood_otherwise_is_diagnosed_with_loads_of_any_direction():
    some = recording(np.zeros(60), walk(60))
    plain = still_model()
    down, aside = (0.0, 0.0, -1.0), (1.0, 0.0, 0.0)
    stood = plain.replace(spec=replace(plain.spec, gravity=down))
    here, there = replace(some, gravity=down), replace(some, gravity=aside)
    assert under_weight(plain, [there]) == (plain, [])
    assert under_weight(stood, [some]) == (stood, [])
    assert under_weight(stood, [here]) == (stood, [])
    changed, notes = under_weight(stood, [there])
    assert changed.spec.gravity is None
    assert (
        "the weight pulls along (1.00, 0.00, 0.00), 90 degrees from (0.00, 0.00, -1.00)"
        in (notes[0])
    )
    assert "stands for the arm's own weight as well there" in notes[1]
    for several in ([here, there], [there, some]):
        same, notes = under_weight(stood, several)
        assert same is stood
        assert "give those of one direction at a time" in notes[1]


def test_warnings_about_recordings_are_a_sentence_each():
    def problem(**fields):
        values = {
            "table": table(), "floor_mm": 0.1,
            "motion": np.arange(8), "measured": np.zeros((10, 2, 3)),
            "model": SimpleNamespace(
                validation=SimpleNamespace(rmse_mm=0.05),
                spec=SimpleNamespace(actuation="measured"), training_residuals=None,
            ), "reference": None,
        }  # fmt: skip
        return SimpleNamespace(**(values | fields))

    def table(source="stated", commanded=1.0):
        return SimpleNamespace(
            floor=SimpleNamespace(source=source), pressure=np.zeros((10, 2)),
            commanded=np.full((10, 2), commanded),
        )  # fmt: skip

    holes = np.zeros((10, 2, 3))
    holes[:5] = np.nan
    lost = np.zeros((10, 6, 3))
    lost[:, 1, 2] = np.nan
    unknown, held, smooth = table("unknown"), table("holds"), table("second differences")
    for fields, message in (
        ({}, None),
        ({"measured": holes}, "50 % of the key points are missing"),
        ({"measured": lost}, "key point k1 is missing in every row: an effect that moves it alone"),
        ({"motion": np.zeros(8, int)}, "their 8 blocks of time show 1 different motions"),
        ({"table": smooth}, "second differences in time; state noise_mm in the sidecar for a"),
        ({"table": unknown}, "the noise floor is not known; state noise_mm in the sidecar"),
        (
            {"table": table(commanded=0.0)},
            "measured and commanded actuation are equal in every row",
        ),
        ({"table": table(commanded=np.nan)}, None),
        ({"table": held}, "scatter by 0.1 mm, more than the model's whole validated error (0.05"),
    ):
        found = data_quality_warnings(problem(**fields))
        assert len(found) == (message is not None)
        assert message is None or message in found[0]
    many = SimpleNamespace(block_of_row=np.zeros(LONG_ROWS, int), index=np.arange(1000))
    (note,) = thinning_notes(many)
    assert f"{LONG_ROWS:,} rows are thinned: effects are fitted to 1,000 of them" in note
    assert thinning_notes(SimpleNamespace(block_of_row=np.zeros(9, int))) == ()


def test_a_polynomial_needs_predictions():
    some = recording(np.zeros(60), walk(60))
    with pytest.raises(InputError, match="me: the recordings have no predicted key points; name"):
        polynomial_of([some], still_model().spec, "me")


def test_the_page_of_an_amendment_has_the_words_of_its_sentence():
    """Plausible ranges as the terminal prints them; each fall of the model that it belongs to."""
    track = Track(np.arange(20.0), np.full(20, 0.5), np.full(20, 0.2), np.arange(20) == 0)
    values = ("creep", "tau_s", 4428.0, 0.05, 5000.0, "s", False, (0.1, 2000.0), "the elements")
    made = amendment(
        retuned=True, held_out=fall(0.5, 0.15, ci95=(0.3, 0.4)), parameters=(Parameter(*values),),
        tracks=(track, track),
    )  # fmt: skip
    facts, parameters = amend_page(made, "t", "a").parts[:2]
    shown = dict(facts.items)
    assert shown["after, network re-tuned"] == "0.150 mm"
    assert shown["reduction, 95 %, network re-tuned"] == "0.300 to 0.400 mm"
    assert shown["reduction, 95 %, effects alone"] == "0.100 to 0.400 mm"
    assert shown["reduction, 95 %, network re-tuned"][:-3] in made.sentence
    ((*_, plausible, source),) = parameters.parts[0].rows
    assert (plausible, source) == ("0.1 to 2000: outside", "the elements")
    plain = dict(amend_page(replace(made, retuned=False), "t", "a").parts[0].items)
    assert plain["reduction, 95 %"] == "0.300 to 0.400 mm"
    assert "reduction, 95 %, effects alone" not in plain
