"""The answer on robots whose truth is known and has other forms than the model's effects."""

import json
import math
from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from surgisoft.cli import run
from surgisoft.diagnosis.candidates import candidates
from surgisoft.diagnosis.diagnose import (
    amplitudes_that_vary,
    diagnose,
    estimate_in_words,
    knock,
    second_too,
    would_explain,
)
from surgisoft.diagnosis.inputs import identification_problem
from surgisoft.diagnosis.residuals import Floor, held_out_rows, residual_table
from surgisoft.diagnosis.testability import DETECTED, cubics
from surgisoft.diagnosis.testability import testable as split_by_testability
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import save_recording
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.checkpoint import default_arm, load_model, load_training_residuals
from surgisoft.surrogate.effects import make_effect
from surgisoft.surrogate.effects.contact import LEAST_SHARE
from tests.few_effects import all_but

FEW = ("gain_mismatch", "hysteresis", "creep", "payload", "misalignment")
"""Effects of every stage, among which a diagnosis chooses where the others are not tested."""


@cache
def recorded(hidden="", take=3, points=700):
    """What a robot with a hidden effect of amplitude 1 does; nobody may change it."""
    hidden = [(hidden, 1.0)] if hidden else []
    rig = VirtualRig(0, take=take, hidden=hidden)
    return rig.record(make_protocol("mixed", rig.limits, points, seed=take))[0]


@pytest.fixture(scope="module")
def found():
    """Diagnoses of a few robots by what is hidden in them."""
    model, names = default_arm(), ("", "creep", "misalignment", "hysteresis")
    return {name: diagnose(model, [recorded(name)]) for name in names}


def test_nothing_is_named_on_a_clean_robot(found):
    verdict = found[""].verdict
    assert verdict.kind == "nothing_missing"
    assert verdict.effects == ()


def test_a_gap_inside_a_run_is_a_check(found):
    whole = recorded()
    kept = np.delete(np.arange(whole.samples), np.s_[300:350])
    values = {
        name: getattr(whole, name)[kept] for name in ("t_s", "measured", "key_points_mm", "run")
    }
    values["commanded"] = whole.commanded[kept] if whole.commanded is not None else None
    with_gap = replace(whole, temp_C=None, payload_g=None, **values)
    checks = diagnose(default_arm(), [with_gap], without=all_but("creep", "payload")).checks
    (check,) = [each for each in checks if "gap" in each]
    assert check.startswith(f"{whole.name}: a gap without rows inside a run (")
    assert not any("gap" in each for each in found[""].checks)


@pytest.mark.parametrize("name", ["creep", "misalignment", "hysteresis"])
def test_the_hidden_effect_is_named(found, name):
    """Alone or in a set of two, whichever the fitted decision finds worth more."""
    answer = found[name]
    assert answer.verdict.kind in ("identified", "ambiguous")
    assert name in answer.verdict.effects
    first = answer.ranking[0]
    assert first.effect == name
    assert first.confidence > 0.6
    assert first.gain_alone > 0.7
    assert first.heldout_rmse_mm < 0.5 * answer.error_mm.before
    assert answer.error_mm.floor < answer.error_mm.before
    assert answer.error_mm.best_achievable <= first.heldout_rmse_mm + 1e-9


def test_command_writes_the_promised_json(tmp_path, capsys):
    """Of a diagnosis among five effects, to save time."""
    from surgisoft.surrogate.checkpoint import save_model

    save_model(default_arm(), tmp_path / "arm")
    before = {p.name: p.read_bytes() for p in (tmp_path / "arm").iterdir()}
    save_recording(recorded("misalignment"), tmp_path / "x.parquet")
    out = tmp_path / "d.json"
    command = ["diagnose", str(tmp_path / "arm"), str(tmp_path / "x.parquet"), "--json", str(out)]
    assert run([*command, "--without", *all_but(*FEW)]) == 0
    said = json.loads(out.read_text())
    assert said["verdict"]["kind"] == "identified"
    assert said["verdict"]["effects"] == ["misalignment"]
    levels = {"before", "floor", "best_achievable", "ceiling", "validated", "discrepancy_alone"}
    assert set(said["error_mm"]) == levels
    assert said["error_mm"]["ceiling"] == said["error_mm"]["best_achievable"]
    assert {"effect", "confidence", "gain_alone", "gain_unique", "heldout_rmse_mm", "ci95"} <= set(
        said["ranking"][0]
    )
    assert {"ambiguous_with", "next_experiment", "checks", "seconds"} <= set(said)
    printed = capsys.readouterr().out
    assert "misalignment is missing" in printed
    words = said["ranking"][0]["in_words"]
    assert f"\nmisalignment, first estimate: {words}\n" in printed
    turn = math.degrees(said["ranking"][0]["parameters"]["turn_rad"][0])
    assert f"frame turned by {turn:+.2g} degrees about x" in words
    assert [row["in_words"] for row in said["ranking"][1:]] == [""] * (len(said["ranking"]) - 1)
    after = {p.name: p.read_bytes() for p in (tmp_path / "arm").iterdir()}
    assert after == before


def test_a_wrong_unit_of_length_is_told(tmp_path, capsys):
    from dataclasses import replace

    short = recorded(points=300)
    save_recording(replace(short, key_points_mm=1e3 * short.key_points_mm), tmp_path / "x.parquet")
    assert run(["diagnose", "default", str(tmp_path / "x.parquet")]) == 0
    printed = capsys.readouterr().out
    assert "setup: the positions are 1000 times too large" in printed
    assert "scale = 0.001" in printed


def test_a_key_point_that_was_never_measured_is_left_out():
    """The other four and the model's known error name the effect, of five, without it."""
    from dataclasses import replace

    recording = recorded("misalignment")
    points = recording.key_points_mm.copy()
    points[:, 2] = np.nan
    said = diagnose(
        load_model("default"),
        [replace(recording, key_points_mm=points)],
        reference=load_training_residuals("default"),
        without=all_but(*FEW),
    )
    assert said.verdict.effects == ("misalignment",)
    assert np.isfinite(said.error_mm.before)


def test_too_little_data_is_told(tmp_path, capsys):
    from dataclasses import replace

    from surgisoft.surrogate.checkpoint import save_model

    save_model(default_arm(), tmp_path / "arm")
    short = recorded(points=1000)
    keep = slice(0, 60)
    short = replace(
        short,
        t_s=short.t_s[keep],
        measured=short.measured[keep],
        commanded=short.commanded[keep],
        key_points_mm=short.key_points_mm[keep],
        run=np.zeros(60, np.int64),
        temp_C=short.temp_C[keep],
    )
    save_recording(short, tmp_path / "x.parquet")
    assert run(["diagnose", str(tmp_path / "arm"), str(tmp_path / "x.parquet")]) == 2
    error = capsys.readouterr().err
    assert "blocks of time" in error
    assert len(error.strip().splitlines()) == 1


def test_an_effect_that_is_plausible_only_beside_another_is_ranked():
    """Named second, absent from the effects alone: its row has its score on top of the first."""
    from surgisoft.diagnosis.candidates import candidates
    from surgisoft.diagnosis.decision import Decision, Probabilities
    from surgisoft.diagnosis.diagnose import result_of
    from surgisoft.diagnosis.residuals import problem_of
    from surgisoft.diagnosis.selection import find

    problem = problem_of(default_arm(), [recorded("creep")], part="training")
    # Creep of the loads alone: it has one amplitude, that of the body has two.
    tried = candidates(problem, ["creep", "misalignment"])
    tried = [one for one in tried if (one.name, one.effect.stage) != ("creep", "body")]
    found = find(problem, tried, lambda text: None)
    second = next(s for s in found.first if s.effect == "misalignment")
    first = [s for s in found.first if s.effect != "misalignment"]
    pair = replace(found.proposals[0], scores=(first[0], second))
    both = replace(found, first=first, proposals=(*found.proposals[:1], pair))
    two = ("creep", "misalignment")
    chances = Probabilities(0.0, 0.0, 0.1, {"creep": 0.9}, 0.85, two)
    result = result_of(both, Decision("several", two, 0.85, chances))
    assert [row.effect for row in result.ranking] == ["creep", "misalignment"]
    assert [row.confidence for row in result.ranking] == [0.9, 0.85]
    assert [name for name, _ in result.in_words] == list(two)
    alone = result_of(found, Decision("identified", ("creep",), 0.9, chances))
    beside, own = (each.ranking[0].parameters["amount_share"] for each in (result, alone))
    amounts = amount_of(found, first[0], second.option.chosen), amount_of(found, first[0])
    assert beside / own == pytest.approx(amounts[0] / amounts[1], rel=1e-5)
    assert beside != own


def amount_of(found, score, base=()) -> float:
    """Amplitude of an effect with one, fitted beside a base."""
    return found.selection.validation.amplitudes(base + score.option.chosen)[-1]


def test_what_was_taken_off_the_bench_is_not_named(tmp_path, capsys):
    off = all_but("gain_mismatch", "creep", "payload")
    said = diagnose(default_arm(), [recorded("misalignment")], without=off)
    assert {row.effect for row in said.ranking} <= {"gain_mismatch", "creep", "payload"}
    assert "misalignment" not in [row.effect for row in said.ranking]
    assert "misalignment" not in said.verdict.effects
    save_recording(recorded(points=1000), tmp_path / "x.parquet")
    files = ["default", str(tmp_path / "x.parquet")]
    assert run(["diagnose", *files, "--without", "friction", "contact"]) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert "friction" in error
    assert "hysteresis" in error


def test_what_is_weak_about_the_data_is_told(found):
    """Loads that the fit never saw, and an arm that shakes while it is held."""
    from surgisoft.diagnosis.data_quality import data_quality_warnings
    from surgisoft.diagnosis.residuals import problem_of

    model, recording = default_arm(), recorded()
    problem = problem_of(model, [recording]).with_reference(load_training_residuals("default"))
    assert data_quality_warnings(problem) == []
    away = replace(problem, pressure=np.full_like(problem.pressure, 3.0))
    assert "far from those that the model was fitted on" in data_quality_warnings(away)[0]
    fit_unknown = model.replace()
    fit_unknown.training_residuals = None
    before = replace(away, model=fit_unknown)
    assert "far from those of the recordings from before" in data_quality_warnings(before)[0]
    twice = problem.with_reference([recording, recording])  # the same actuation, distance 0
    assert data_quality_warnings(twice) == []
    loud = replace(problem.table, noise_mm=problem.noise_mm + 9.0, floor=Floor(9.0, "holds"))
    shaken = replace(problem, table=loud)
    assert "shakes the arm" in data_quality_warnings(shaken)[0]


@pytest.mark.parametrize(
    ("effect", "kind", "chance", "size", "told"),
    [
        ("creep", "nothing_missing", 0.4, 0.9, "fit --effects creep"),
        ("payload", "cannot_tell", 0.4, 0.9, "payload would explain 44 %"),
        ("creep", "nothing_missing", 0.1, 0.9, None),
        ("creep", "identified", 0.4, 0.9, None),
        ("creep", "nothing_missing", 0.4, 1.1, None),
    ],
)
def test_what_would_explain_an_error_of_the_fit_is_told(effect, kind, chance, size, told):
    best = SimpleNamespace(effect=effect, gain=0.44)
    selection = SimpleNamespace(whole_size=size, in_fit=lambda name: False)
    found = SimpleNamespace(first=[best], selection=selection)
    decision = SimpleNamespace(kind=kind, probabilities=SimpleNamespace(effects={effect: chance}))
    checks = would_explain(found, decision)
    assert len(checks) == (told is not None)
    assert told is None or told in checks[0]
    assert told is None or ("fit --effects" in checks[0]) == (effect == "creep")


@pytest.mark.parametrize(
    ("kind", "effects", "both", "told"),
    [
        ("identified", ("drift",), 0.34, True),
        ("ambiguous", ("creep", "drift"), 0.34, True),
        ("identified", ("drift",), 0.1, False),
        ("identified", ("hysteresis",), 0.34, False),
        ("ambiguous", ("twist", "drift"), 0.34, False),
        ("several", ("drift", "twist"), 0.34, False),
        ("cannot_tell", (), 0.34, False),
    ],
)
def test_an_effect_that_may_be_missing_beside_the_named_one_is_told(kind, effects, both, told):
    chances = SimpleNamespace(pair=both, two=("drift", "twist"))
    checks = second_too(SimpleNamespace(kind=kind, effects=effects, probabilities=chances))
    expected = "twist may be missing beside drift (probability 0.34 that both are): 'surgisoft im"
    assert [check.startswith(expected) for check in checks] == [True] * told


def test_a_knock_is_told_where_a_turn_at_one_moment_explains_more(found):
    """A frame that was turned from the beginning is no knock; one with a margin of 3 is."""
    turned = found["misalignment"].statistics
    assert turned.sudden_margin < 0.0
    assert knock(turned) == ""
    assert found["creep"].statistics.sudden_log_gain == 0.0
    assert found["creep"].statistics.sudden_at_s == 0.0
    defined = {row.effect for row in turned.effects if row.by_definition}
    assert defined == {"misalignment", "gain_mismatch", "zero_offset"}
    sudden = replace(turned, sudden_margin=3.0, sudden_at_s=83.04)
    assert knock(sudden).endswith(" at 83 s, as by a knock, explains more than misalignment")
    assert " at 83 s (all recordings in turn), as by" in knock(sudden, recordings=2)
    assert " at 1234 s, as by" in knock(replace(sudden, sudden_at_s=1234.0))


def test_what_is_missing_has_one_amplitude_and_a_check_says_so_where_it_has_not(found):
    """The robots' own effects vary by less than a fifth; of two named together both are looked at
    beside each other."""
    for name in ("creep", "misalignment", "hysteresis"):
        result = found[name]
        assert name in result.verdict.effects
        first = next(each for each in result.statistics.effects if each.effect == name)
        assert first.variation < 0.04
        assert not any("amplitude" in check for check in result.checks)
    evidence = found["creep"].statistics
    creep = replace(evidence.effects[0], effect="creep", variation=0.25)
    other = replace(creep, effect="payload", variation=0.0)
    pair = replace(evidence.proposals[0], effects=("creep", "payload"), variation=(0.01, 0.09))
    evidence = replace(evidence, effects=(creep, other), proposals=(pair,))
    for kind, effects, told in (
        ("identified", ("creep",), "creep differs between motions by 50 %"),
        ("identified", ("payload",), None),
        ("several", ("creep", "payload"), "payload differs between motions by 30 %"),
        ("cannot_tell", (), None),
    ):
        checks = amplitudes_that_vary(evidence, SimpleNamespace(kind=kind, effects=effects))
        assert len(checks) == (told is not None)
        assert told is None or told in checks[0]


def test_steady_state_samples_rank_no_rates(found, tmp_path, capsys):
    """Lag, viscosity and inertia are over when a sample is taken: not ranked, and said to be so."""
    rig = VirtualRig(0, take=4, hidden=[("payload", 1.5)])
    settled = rig.record(make_protocol("grid", rig.limits, 400, seed=4))[0]
    save_recording(settled, tmp_path / "x.parquet")
    rates = ("line_lag", "rate_dependence", "inertia")
    command = ["diagnose", "default", str(tmp_path / "x.parquet")]
    command += ["--without", *all_but(*rates, *FEW)]
    assert run([*command, "--json", str(tmp_path / "x.json")]) == 0
    assert "not testable: line_lag" in capsys.readouterr().out
    result = json.loads((tmp_path / "x.json").read_text())
    absent = {each["effect"]: each["cause"] for each in result["not_testable"]}
    ranked = [row["effect"] for row in result["ranking"]]
    for name in rates:
        assert absent[name] == "no_motion"
        assert name not in ranked
    assert "payload" in ranked
    moving = found[""]
    assert not {"line_lag", "rate_dependence"} & {each.effect for each in moving.not_testable}


def test_an_effect_that_shows_below_its_plausible_range_is_a_candidate():
    """A share of a support that yields more than any real one stands out: larger ones do too."""
    rig = VirtualRig(0, take=7, noise=0.1)
    recording = rig.record(make_protocol("mixed", rig.limits, 600, seed=2))[0]
    problem = identification_problem(default_arm(), [recording])
    least_mm = DETECTED * problem.floor_mm / np.sqrt(len(problem.motion))

    def share(support):
        """The least share that stands out."""
        return least_mm / np.sqrt(np.square(support.sensitivities).sum(2).mean((0, 1)).max())

    some = [each for each in candidates(problem, ["contact"]) if share(each) < LEAST_SHARE]
    assert some
    assert split_by_testability(problem, some, ["contact"]) == (some, ())
    # With much more noise no support of any share would be seen.
    table = replace(problem.table, noise_mm=1e4 * problem.noise_mm)
    kept, absent = split_by_testability(replace(problem, table=table), some, ["contact"])
    assert not kept
    assert [each.cause for each in absent] == ["below_noise"]


def test_a_loop_that_is_a_function_of_the_actuation_cannot_show():
    """Friction whose change is a cubic of the actuation, up to a share of its power of its own."""
    rig = VirtualRig(0, take=7)
    recording = rig.record(make_protocol("mixed", rig.limits, 600, seed=2))[0]
    problem = identification_problem(default_arm(), [recording])
    one = candidates(problem, ["hysteresis"])[0]
    basis = cubics(problem.pressure)
    cubic = basis[:, 1:] @ np.linspace(1.0, 2.0, basis.shape[1] - 1)
    other = np.random.default_rng(0).normal(size=len(cubic))
    other -= basis @ (basis.T @ other)
    cubic, other = cubic / np.linalg.norm(cubic), other / np.linalg.norm(other)
    for own, causes in ((0.03, ["no_reversals"]), (0.07, [])):
        column = np.sqrt(1.0 - own) * cubic + np.sqrt(own) * other
        shape = one.sensitivities.shape
        alike = replace(one, sensitivities=np.broadcast_to(column[:, None, None, None], shape))
        _, absent = split_by_testability(problem, [alike], ["hysteresis"])
        assert [each.cause for each in absent] == causes


def test_an_effect_has_to_stand_out_from_the_noise_of_the_mean_of_all_motions():
    """The largest plausible load changes a key point by so many mm RMS: 3 standard errors are
    three times the noise over the root of the number of blocks."""
    rig = VirtualRig(0, take=7)
    recording = rig.record(make_protocol("mixed", rig.limits, 600, seed=2))[0]
    problem = identification_problem(default_arm(), [recording])
    one = candidates(problem, ["payload"])[0]
    along = np.sqrt(np.square(one.sensitivities).sum(2).mean((0, 1)))
    unit = np.eye(len(along))[along.argmax()]
    quantities = {each.name: each for each in one.with_amplitudes(unit).quantities()}
    sag = quantities["sag_mm"]
    most_mm = along.max() * sag.high / abs(sag.value)
    noise_mm = np.sqrt(len(problem.motion)) * most_mm / 3.0
    for share, causes in ((0.95, []), (1.05, ["below_noise"])):
        table = replace(problem.table, noise_mm=np.full(5, share * noise_mm))
        _, absent = split_by_testability(replace(problem, table=table), [one], ["payload"])
        assert [each.cause for each in absent] == causes


def test_all_shares_of_a_diagnosis_are_between_0_and_1(found):
    for result in found.values():
        for row in result.ranking:
            for value in (row.gain_alone, row.gain_unique, row.confidence):
                assert 0.0 <= value <= 1.0


def test_held_out_rows_change_nothing():
    """The training view holds no other key points: a diagnosis is the same whatever they are."""
    recording = recorded("creep")
    held = held_out_rows([recording])
    assert 0.15 < held.mean() < 0.3
    points = recording.key_points_mm.copy()
    points[held] = 50.0 + 10.0 * np.random.default_rng(0).normal(size=points[held].shape)
    other = replace(recording, key_points_mm=points)
    problem = residual_table(default_arm(), [other]).training()
    assert np.isnan(problem.table.measured_mm[held]).all()
    shown = problem.history.rows(problem.history.key_points).numpy()
    assert np.isnan(shown[held]).all()
    again, expected = (
        diagnose(default_arm(), [each], without=all_but(*FEW)).to_json()
        for each in (other, recording)
    )
    assert "creep" in again["verdict"]["effects"]
    assert {**again, "seconds": 0.0} == {**expected, "seconds": 0.0}


def test_the_final_check_sees_the_held_out_rows_alone():
    recording = recorded()
    held = held_out_rows([recording])
    check = residual_table(default_arm(), [recording]).final_check()
    np.testing.assert_array_equal(check.index.numpy(), np.flatnonzero(held))
    assert np.isnan(check.table.measured_mm[~held]).all()


def test_a_first_estimate_beyond_its_plausible_range_is_said_to_be_so():
    """More than the whole of a change cannot lag; what acts less than before has the other sign."""
    lag = make_effect("line_lag", default_arm().facts)
    with torch.no_grad():
        lag.share.fill_(0.9)
        assert "not plausible" not in estimate_in_words(lag, 600.0)
        lag.share.fill_(1.3)
    words = estimate_in_words(lag, 600.0)
    assert words.endswith(" (not plausible: share = 1.3, expected 0 to 1.05)")
    assert "not plausible" not in estimate_in_words(lag, 600.0, less=True)
