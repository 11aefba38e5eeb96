"""A few robots of the diagnosis benchmark, and its table counted by hand."""

import itertools
import json
import os
import shutil
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, fields, replace

import numpy as np
import pytest
import torch

from benchmarks.diagnosis import experiment as diagnosis_experiment
from benchmarks.diagnosis import study as diagnosis
from benchmarks.diagnosis.amend import Amended
from benchmarks.diagnosis.cases import EXCITATIONS, KNOWN, LEFT_OUT, UNKNOWN, Case, cases
from benchmarks.diagnosis.experiment import Settled
from benchmarks.diagnosis.robots import bent, record, record_experiment, validation_of
from benchmarks.diagnosis.study import Outcome, read_outcomes, run, run_case, to_amend
from benchmarks.diagnosis.table import calibration_error, markdown
from surgisoft.diagnosis.design.next_experiment import Pair, Recommendation
from surgisoft.diagnosis.design.schedules import SETUPS, schedule
from surgisoft.diagnosis.diagnose import (
    Diagnosis,
    ErrorLevels,
    Verdict,
    diagnose,
    effect_left,
    rivals_of,
)
from surgisoft.diagnosis.evidence import EffectEvidence, Evidence
from surgisoft.errors import InputError
from surgisoft.rig.hidden import HIDDEN
from surgisoft.surrogate.checkpoint import DEFAULT_FOLDER, default_arm
from tests.few_effects import few_effects

CLEAN = Case(0, (), 0.0, "white", "medium", take=5)
BRIEF = replace(CLEAN, excitation="poor")
"""On one kind of motion."""


@pytest.fixture(scope="module", autouse=True)
def _short_recordings():
    """Recordings of 70 s, with which the diagnoses below are as sure as with longer ones."""
    with pytest.MonkeyPatch.context() as patch:
        for name, (protocol, _) in EXCITATIONS.items():
            patch.setitem(EXCITATIONS, name, (protocol, 1400))
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Base models: that of specimen 0 is the arm of the package."""
    place = tmp_path_factory.mktemp("base")
    shutil.copytree(DEFAULT_FOLDER, place / "robot-0")
    return place


@pytest.mark.parametrize(
    ("case", "kind", "effects"),
    [
        (CLEAN, "nothing_missing", ()),
        (replace(BRIEF, hidden=(("softening", 2.0),)), "identified", ("softening",)),
        (
            replace(BRIEF, hidden=(("gain_mismatch", 1.0),), discrepancy_mm=0.25),
            "identified",
            ("gain_mismatch",),
        ),
    ],
)
def test_robots_with_known_hidden_effects(folder, case, kind, effects):
    said = run_case(case, folder, amending=bool(case.hidden))
    assert said.kind == kind
    if case.hidden:
        worth = said.amended
        assert worth.effects == effects
        assert worth.before > 1.5 * worth.oracle
        assert 0.5 < worth.share < 1.2
    assert said.effects == effects
    assert (said.effect_mm > 0.2) == bool(case.hidden)
    assert said.discrepancy_mm >= case.discrepancy_mm - 0.02


def test_a_bent_surrogate_has_the_wanted_error():
    model = default_arm()
    worse = bent(model, 0, 0.3, seed=4)
    assert worse.validation.rmse_mm == pytest.approx(0.3, rel=0.05)
    assert model.validation.rmse_mm < 0.15


def test_a_bent_surrogate_of_an_arm_that_is_the_model_itself_is_off_by_the_wanted_error():
    """The error of the model it was made from is no error of that arm. The cameras' noise counts in
    a validated error; the distance from the arm has the rest of it."""
    model = default_arm()
    worse = bent(model, 0, 0.3, seed=4, arm=model)
    assert worse.validation.rmse_mm == pytest.approx(0.3, rel=0.05)
    history = validation_of(0)
    with torch.no_grad():
        away = (worse.predict(history) - model.predict(history)).square().sum(-1)
    noise = 3.0 * history.noise_mm**2
    assert away.mean().item() == pytest.approx(worse.validation.rmse_mm**2 - noise, rel=0.03)


def test_correlated_noise_is_stated():
    quiet = record(replace(CLEAN, excitation="poor"))
    plain = quiet.recording
    noisy = record(replace(CLEAN, excitation="poor", noise="correlated")).recording
    assert quiet.effect_mm == 0.0
    added = noisy.key_points_mm - plain.key_points_mm
    assert np.nanstd(added[:, -1]) == pytest.approx(0.05, rel=0.4)
    assert noisy.noise_mm == pytest.approx((plain.noise_mm**2 + 0.05**2) ** 0.5)


def test_cases_are_those_of_their_seed():
    some = cases([1, 2], 80, seed=3)
    assert some == cases([1, 2], 80, seed=3)
    assert some != cases([1, 2], 80, seed=4)
    kinds = Counter(len(case.hidden) for case in some)
    assert kinds[2] == 8
    assert sum(not case.hidden and not case.undertrained for case in some) == 20


def test_one_kind_of_case_alone():
    """189 unchanged robots without a name show less than 2 %; a quarter of all cases is clean."""
    some = cases([1, 2], 40, seed=3, kinds=("clean",))
    assert len({case.take for case in some}) == 40
    assert not any(case.hidden or case.undertrained for case in some)
    two = cases([1, 2], 40, seed=3, kinds=("unknown", "pair"))
    assert Counter(len(case.hidden) for case in two) == {1: 20, 2: 20}
    with pytest.raises(InputError, match="kind of case 'clear': expected one of single, clean"):
        cases([1, 2], 40, seed=3, kinds=("clear",))


def test_every_hidden_effect_of_the_rig_has_a_place_in_the_cases():
    places = [*KNOWN, *UNKNOWN, *LEFT_OUT]
    assert sorted(HIDDEN) == sorted(places)


def test_the_twin_with_nothing_hidden_has_the_same_schedule_and_noise():
    hidden = replace(CLEAN, hidden=(("misalignment", 1.0),), excitation="poor")
    both = record(hidden)
    clean = record(replace(hidden, hidden=()))
    np.testing.assert_array_equal(both.plain.key_points_mm, clean.recording.key_points_mm)
    np.testing.assert_array_equal(both.plain.commanded, both.recording.commanded)
    change = both.recording.key_points_mm - both.plain.key_points_mm
    rms = np.sqrt(np.nanmean(np.square(change).sum(2)))
    assert rms == pytest.approx(both.effect_mm, rel=0.02)  # the noise is not in it


def test_an_experiment_takes_away_what_it_names_and_nothing_else():
    case = replace(CLEAN, hidden=(("misalignment", 2.0),), noise="loud")
    limits = np.array([[-10.0, 50.0]] * 3)
    plan = schedule("x", [("steps", 0)], limits, "kPa")
    still, anew, heavy = (
        record_experiment(case, SETUPS[name], plan)
        for name in ("as_it_stands", "new_frame", "known_mass")
    )
    clean = record_experiment(replace(case, hidden=()), SETUPS["as_it_stands"], plan)
    np.testing.assert_array_equal(anew.key_points_mm, clean.key_points_mm)
    assert np.nanmax(np.abs(still.key_points_mm - anew.key_points_mm)) > 0.5
    assert heavy.payload_g[0] == 2.0


@pytest.mark.parametrize(
    ("rivals", "setting", "kind", "named", "left"),
    [
        (("creep", "drift"), "as_it_stands", "identified", ("drift",), "drift"),
        (("creep", "drift"), "as_it_stands", "ambiguous", ("drift", "creep"), None),
        (("creep", "drift"), "as_it_stands", "several", ("drift", "creep"), None),
        (("contact", "payload"), "no_support", "nothing_missing", (), "contact"),
        (("contact", "payload"), "no_support", "surrogate_undertrained", (), "contact"),
        (("contact", "payload"), "no_support", "unknown_effect", (), "payload"),
        (("contact", "payload", "twist"), "no_support", "identified", ("twist",), "twist"),
        (("contact", "payload", "twist"), "no_support", "identified", ("contact",), None),
    ],
)
def test_what_an_experiment_leaves(rivals, setting, kind, named, left):
    pairs = tuple(Pair(pair, 0.6, 0.99) for pair in itertools.combinations(rivals, 2))
    advice = Recommendation("x", None, setting, 8.0, pairs, ())
    answer = Diagnosis(Verdict(kind, named, ""), ErrorLevels(1.0, 0.1, 0.2), ())
    assert rivals_of(advice) == rivals
    assert effect_left(advice, answer) == left


def test_an_ambiguous_robot_gets_its_experiment_and_the_outcome_is_kept(
    folder, monkeypatch, tmp_path
):
    """Where the first answer leaves two rivals open, the second is made from both recordings."""
    case = replace(CLEAN, hidden=(("creep", 1.0),), excitation="poor")
    asked = []

    def unsure(model, recordings, reference, without=()):
        asked.append(len(recordings))
        found = diagnose(model, recordings, reference=reference, without=without)
        if len(recordings) > 1:
            return found
        return replace(found, verdict=Verdict("ambiguous", ("drift", "creep"), ""))

    monkeypatch.setattr(diagnosis, "diagnose", unsure)
    monkeypatch.setattr(diagnosis_experiment, "diagnose", unsure)
    with few_effects("creep", "drift", "line_lag"):
        said = run_case(case, folder)
    assert asked[:2] == [1, 2]
    assert said.settled.effect == "creep"
    assert said.settled.minutes <= 15.0
    assert said.settled.setting in SETUPS
    log = tmp_path / "x.jsonl"
    log.write_text(json.dumps(asdict(said)) + "\n{broken")
    assert read_outcomes(log) == {case: said}


def test_a_run_goes_on_where_it_was_cut_off(folder, monkeypatch):
    """A kept outcome is taken as it is; one that lacks its amendment is made again."""
    some = [replace(CLEAN, hidden=(("creep", 1.0),)), CLEAN]
    kept = [said(some[0], "identified", ("creep",), 0.9), said(some[1], "ambiguous", ("x",), 0.5)]
    asked = []

    def quick(case, place, amending):
        asked.append((case, place, amending))
        return replace(kept[0], case=case, amended=Amended(("creep",), 0.6, 0.2, 0.1))

    monkeypatch.setattr(diagnosis, "run_case", quick)
    monkeypatch.setattr(diagnosis, "workers", ThreadPoolExecutor)
    monkeypatch.setattr(diagnosis, "fingerprint", lambda: "x")
    log = folder / "outcomes-x.jsonl"
    log.write_text("".join(json.dumps(asdict(o)) + "\n" for o in kept))
    assert run(some, folder, 1, lambda *_: None) == kept
    assert not asked
    again = run(some, folder, 1, lambda *_: None, amend=1)
    assert again[0].amended is not None
    assert again[1] == kept[1]
    assert run(some, folder, 1, lambda *_: None, amend=1) == again
    assert asked == [(some[0], folder, True)]


def test_processes_of_their_own_run_the_cases(folder, tmp_path, monkeypatch):
    """What a process needs goes there and what it finds comes back; here without a diagnosis."""
    shutil.copytree(folder / "robot-0", tmp_path / "robot-0")
    monkeypatch.setattr(diagnosis, "run_case", in_another_process)
    (found,) = run([CLEAN], tmp_path, 1, lambda *_: None)
    assert found == replace(said(CLEAN, "identified", ("creep",), 0.9), effects=found.effects)
    assert found.effects != (str(os.getpid()),)


def in_another_process(case, place, amending):
    """In place of a diagnosis: an outcome that names the process it was made in."""
    assert (place / "robot-0" / "config.json").is_file()
    return replace(said(case, "identified", ("creep",), 0.9), effects=(str(os.getpid()),))


def test_each_effect_is_amended_once_before_any_twice():
    some = cases([1], 200, seed=2)
    assert Counter(case.truth for case in to_amend(some, 15)) == Counter(
        (KNOWN[name],) for name in KNOWN
    )
    assert not any("unknown" in case.truth for case in to_amend(some, 1000))


def said(
    case: Case,
    kind: str,
    ranking: tuple[str, ...],
    confidence: float,
    named=True,
    **more,
):
    effects = ranking[:1] if named else ()
    return Outcome(case, kind, effects, ranking, confidence, 0.5, 0.1, 2.0, {"effects": []}, **more)


def explains(*gains: float) -> dict:
    """The evidence of a diagnosis, as far as the tables read it; `Evidence` has these names."""
    found = {each.name for each in fields(Evidence)}, {each.name for each in fields(EffectEvidence)}
    assert "effects" in found[0]
    assert "gain" in found[1]
    return {"effects": [{"effect": str(n), "gain": gain} for n, gain in enumerate(gains)]}


def test_table_counts():
    creep = replace(CLEAN, hidden=(("creep", 1.0),))
    lag = replace(CLEAN, hidden=(("line_lag", 1.0),))
    leak = replace(CLEAN, hidden=(("leak", 1.0),))
    outcomes = [
        said(creep, "identified", ("creep", "drift"), 0.99),
        said(lag, "identified", ("creep", "line_lag"), 0.6),
        said(CLEAN, "nothing_missing", ("creep",), 0.0, named=False),
        said(leak, "unknown_effect", ("coupling",), 0.0, named=False),
    ]
    text = markdown(outcomes)
    assert "| right effect first, memory effects | 97 % | 50.0 % (1 of 2;" in text
    assert "| right among the first two, as before | 97 % | 100.0 % (2 of 2;" in text
    assert "| the verdict names it alone, memory effects |  | 50.0 % (1 of 2;" in text
    assert "| the verdict names it, alone or in a set | 90 % | 50.0 % (1 of 2;" in text
    assert "| an effect named on a clean robot | 2 % | 0.0 % (0 of 1;" in text
    assert "less than 2 % | 189 | 1 of 189: too few for the goal |" in text
    assert "| outside the list: `unknown_effect` | 80 % | 100.0 % (1 of 1;" in text
    assert "| statements with confidence >= 0.95 right | 97 % | 100.0 % (1 of 1;" in text
    # Two statements: 0.99 that is right, 0.6 that is wrong.
    assert calibration_error(outcomes[:2]) == pytest.approx((0.01 + 0.6) / 2)


def test_only_a_verdict_of_exactly_both_names_both():
    """A set of two of which one is missing, one name more, and right first alone do not count."""
    pair = replace(CLEAN, hidden=(("creep", 1.0), ("payload", 1.0)))
    verdicts = [
        ("several", ("payload", "creep")),
        ("ambiguous", ("creep", "payload")),
        ("several", ("creep", "payload", "drift")),
        ("identified", ("creep",)),
    ]
    outcomes = [
        replace(said(pair, kind, effects, 0.9), effects=effects) for kind, effects in verdicts
    ]
    assert "| two at once, both named | 85 % | 25.0 % (1 of 4;" in markdown(outcomes)


def test_experiments_and_amendments_are_counted():
    """Three ambiguous robots: settled rightly, wrongly, and one whose effect was no rival."""
    twist, lag, drift = (
        replace(CLEAN, hidden=((name, 1.0),)) for name in ("twist", "line_lag", "thermal_drift")
    )
    right = Settled("steps", "as_it_stands", 15.0, 0.97, "twist", "twist")
    away = Settled("short_tube: steps", "short_tube", 8.0, 1.0, "rate_dependence", "x")
    free = Settled("ramps", "as_it_stands", 5.0, 0.9, None, "line_lag")
    first = said(twist, "ambiguous", ("coupling", "twist"), 0.6, settled=right)
    outcomes = [
        replace(first, effects=("coupling", "twist"), settled_untouched=right),
        replace(
            said(lag, "ambiguous", ("rate_dependence", "line_lag"), 0.6, settled=away),
            effects=("rate_dependence", "line_lag"),
            settled_untouched=free,
        ),
        said(drift, "ambiguous", ("creep", "drift"), 0.6, settled=away, settled_untouched=free),
    ]
    text = markdown(outcomes)
    assert (
        "| ambiguous: the recommended experiment names the right one | 90 % | 33.3 % (1 of 3;"
        in text
    )
    assert "| the same where nobody may change the bench |  | 33.3 % (1 of 3;" in text
    assert "| ambiguous: the experiment names a wrong one |  | 66.7 % (2 of 3;" in text
    assert "| minutes on the bench | 15 | median 8.0, longest 15.0 |" in text
    assert "| right effect first, static effects | 85 % | 0.0 % (0 of 1;" in text
    assert "| right first, static effects, after the experiment | 95 % | 100.0 % (1 of 1;" in text
    assert "| line_lag | rate_dependence, line_lag | short_tube: steps | 8 | 1.00 " in text
    assert "| rate_dependence | open |" in text
    assert "| twist | coupling, twist | steps | 15 | 0.97 | twist | the same |" in text


def test_falls_are_counted_as_shares_of_the_oracles():
    """0.4 of 0.5, 0.6 of 0.6 and nothing of 0.4 mm; one hardly shows and does not count."""
    worth = [
        ("creep", Amended(("creep",), 0.6, 0.2, 0.1)),
        ("creep", Amended(("creep",), 0.8, 0.2, 0.2)),
        ("twist", Amended((), 0.5, 0.5, 0.1)),
        ("contact", Amended(("contact",), 0.105, 0.2, 0.1)),
    ]
    assert [each.share for _, each in worth[:3]] == pytest.approx([0.8, 1.0, 0.0])
    outcomes = [
        said(replace(CLEAN, hidden=((name, 1.0),)), "identified", each.effects, 0.9, amended=each)
        for name, each in worth
    ]
    text = markdown(outcomes)
    whole = "median 80 %, pooled 67 % (3 cases; median of the 2 that had the right name alone 90 %)"
    assert whole in text
    assert "| creep | creep 2 | 0.700 | 0.200 | 0.150 | 91 % |" in text
    assert "| twist | nothing 1 | 0.500 | 0.500 | 0.100 | 0 % |" in text
    assert "| contact |" not in text[text.index("## Amendments") :]


def test_effects_outside_the_list_are_counted_by_kind():
    leaks = [replace(CLEAN, hidden=(("leak", size),)) for size in (1.0, 2.0)]
    unknown = said(leaks[0], "unknown_effect", ("coupling",), 0.0, False)
    some = [
        replace(unknown, statistics=explains(0.2, 0.1)),
        replace(said(leaks[1], "identified", ("coupling",), 0.9), statistics=explains(0.1, 0.8)),
    ]
    assert "| leak | 1 of 2 | coupling | 50 % |" in markdown(some)
