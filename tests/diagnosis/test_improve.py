"""`improve`: effect after effect until the gates are silent, and the waterfall of it."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest

from surgisoft.cli import run
from surgisoft.diagnosis import improve as loop
from surgisoft.diagnosis.amend import Fall
from surgisoft.diagnosis.decision import Probabilities
from surgisoft.diagnosis.diagnose import Diagnosis, ErrorLevels, Ranked, Verdict
from surgisoft.diagnosis.improve import (
    NETWORK,
    Improvement,
    Round,
    alternatives,
    improve,
    next_effects,
)
from surgisoft.diagnosis.pages.amendment import what_is_left
from surgisoft.diagnosis.residuals import held_out_rows
from surgisoft.errors import InputError
from surgisoft.measurement.recordings import save_recording
from surgisoft.report import Text
from surgisoft.surrogate.checkpoint import load_model, save_model
from surgisoft.surrogate.model import ArmModel
from tests.diagnosis.synthetic import NOISE_MM
from tests.diagnosis.test_estimation import TRUTHS, bare_arm, measured_on, with_truth
from tests.diagnosis.test_estimation import rms as rms_distance
from tests.few_effects import choose_among


def said(kind: str, *effects: str) -> Diagnosis:
    """A diagnosis that says so."""
    return Diagnosis(Verdict(kind, effects, f"{kind} it is"), ErrorLevels(1.0, 0.1, 0.1), ())


@pytest.fixture
def few_candidates(monkeypatch):
    """Diagnoses choose among five effects, of every stage, to save time."""
    choose_among(monkeypatch, "line_lag", "gain_mismatch", "creep", "payload", "misalignment")


@pytest.fixture
def recited(monkeypatch):
    """Diagnoses by rote: what each round hears."""

    def recite(*answers: Diagnosis) -> None:
        left = iter(answers)
        monkeypatch.setattr(loop, "diagnose", lambda model, recordings, **more: next(left))

    return recite


@pytest.mark.usefixtures("few_candidates")
def test_two_hidden_effects_are_found_added_and_judged(tmp_path, capsys):
    """Nothing by rote here: the diagnosis has to name frame and gains by itself."""
    truth = with_truth("gain_mismatch", {"gain": [0.06, -0.02, -0.05]}, TRUTHS["misalignment"])
    save_model(bare_arm(), tmp_path / "arm")
    both = measured_on(truth, rows=200)
    save_recording(both, tmp_path / "both.parquet")
    command = ["improve", str(tmp_path / "arm"), str(tmp_path / "both.parquet")]
    options = ["--json", str(tmp_path / "rounds.json"), "-o", str(tmp_path / "new")]
    assert run([*command, *options]) == 0
    out = capsys.readouterr().out
    assert "round 1:" in out
    assert "floor" in out
    values = json.loads((tmp_path / "rounds.json").read_text())
    assert set(values["effects"]) == {"misalignment", "gain_mismatch"}
    errors = [r["error_mm"] for r in values["rounds"] if r["step"]]
    assert errors == sorted(errors, reverse=True)
    assert values["error_mm"]["after"] == pytest.approx(errors[-1])
    assert values["error_mm"]["rows"] == held_out_rows([both]).sum(), "judged on held-out rows"
    assert values["error_mm"]["after"] < 1.1 * values["error_mm"]["floor"]
    assert set(load_model(tmp_path / "new").effects) == {"misalignment", "gain_mismatch"}


def test_a_held_out_part_without_key_points_is_refused_before_any_fit(monkeypatch, recited):
    """The rounds would be lost at the end: nothing can validate them."""
    made = measured_on(TRUTHS["gain_mismatch"])
    points = made.key_points_mm.copy()
    points[held_out_rows([made])] = np.nan
    recording = replace(made, key_points_mm=points)
    monkeypatch.setattr(loop, "fit_effects", lambda *_, **__: pytest.fail("fitted"))
    for answer in (said("identified", "gain_mismatch"), said("nothing_missing")):
        recited(answer)
        with pytest.raises(InputError, match=r"the held-out part, .* has 0 rows with key points"):
            improve(bare_arm(), [recording])


@pytest.mark.usefixtures("few_candidates")
def test_a_model_that_misses_nothing_is_left_alone(tmp_path, capsys):
    save_model(bare_arm(), tmp_path / "arm")
    save_recording(measured_on(bare_arm()), tmp_path / "clean.parquet")
    command = ["improve", str(tmp_path / "arm"), str(tmp_path / "clean.parquet")]
    assert run([*command, "-o", str(tmp_path / "new")]) == 1
    assert "nothing was added" in capsys.readouterr().out
    assert not (tmp_path / "new").exists()


@pytest.mark.usefixtures("few_candidates")
def test_with_recordings_from_before_only_what_has_changed_is_added(tmp_path, capsys):
    """The frame was turned all along; creep and gains are new. By the end, the change is explained
    to the noise of a difference of two measurements, and the model's error is what it was."""
    turned = TRUTHS["misalignment"]
    now = with_truth("creep", {"amount": [0.15], "log_tau": [2.0], "log_width": [0.3]}, turned)
    now = with_truth("gain_mismatch", {"gain": [0.06, -0.02, -0.05]}, now)
    before, after = measured_on(turned, rows=150), measured_on(now, rows=150, noise_seed=5)
    after = replace(after, name="after")
    save_model(bare_arm(), tmp_path / "arm")
    save_recording(before, tmp_path / "before.parquet")
    save_recording(after, tmp_path / "after.parquet")
    command = ["improve", str(tmp_path / "arm"), str(tmp_path / "after.parquet")]
    command += ["--before", str(tmp_path / "before.parquet"), "-o", str(tmp_path / "new")]
    assert run([*command, "--json", str(tmp_path / "a.json"), "--report", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "unexplained change since before reduced from" in out
    values = json.loads((tmp_path / "a.json").read_text())
    assert set(values["effects"]) == {"creep", "gain_mismatch"}
    assert not values["network_retuned"]
    last = values["rounds"][-1]
    assert (last["step"], last["verdict"]) == (None, "nothing_missing"), "asked of the new model"
    rows = held_out_rows([after])
    assert values["error_mm"]["rows"] == rows.sum()
    changed = (after.key_points_mm - before.key_points_mm)[rows]
    assert values["error_mm"]["before"] == pytest.approx(rms_distance(changed), rel=1e-4)
    assert values["error_mm"]["after"] < 1.1 * np.sqrt(6) * NOISE_MM
    assert set(load_model(tmp_path / "new").effects) == {"creep", "gain_mismatch"}
    own = np.square(
        (
            measured_on(turned, rows=150, noise_seed=5).key_points_mm
            - measured_on(bare_arm(), rows=150).key_points_mm
        )[rows]
    )
    assert values["error_model_mm"]["after"] == pytest.approx(
        np.sqrt(own.sum(2).mean() - 3 * NOISE_MM**2), rel=0.05
    )
    assert "Change that is not explained" in (tmp_path / "report.html").read_text()


@pytest.mark.usefixtures("few_candidates")
def test_a_warning_says_that_the_model_errs_more_though_the_change_is_explained(tmp_path, capsys):
    """The frame was turned before and is straight now, as the model has it."""
    before = measured_on(TRUTHS["misalignment"], rows=150)
    after = measured_on(bare_arm(), rows=150, noise_seed=5)
    save_model(bare_arm(), tmp_path / "arm")
    save_recording(replace(before, name="before"), tmp_path / "before.parquet")
    save_recording(replace(after, name="after"), tmp_path / "after.parquet")
    earlier = ["--before", str(tmp_path / "before.parquet")]
    data = [str(tmp_path / "arm"), "--data", str(tmp_path / "after.parquet")]
    of_amend = ["amend", *data, "--effect", "misalignment", "-o", str(tmp_path / "new")]
    of_amend += ["--report", str(tmp_path / "page")]
    for command in (of_amend, ["improve", *data[::2], "-o", str(tmp_path / "other")]):
        assert run([*command, *earlier]) == 0
        printed = capsys.readouterr()
        assert "misalignment: unexplained change since before reduced from" in printed.out
        assert re.search("error of the model itself [0-9. to]+ mm, which is more", printed.out)
        assert "warning: the new model itself errs more than the given one" in printed.err


@pytest.mark.usefixtures("few_candidates")
def test_a_further_effect_with_which_the_model_errs_more_is_not_added(monkeypatch):
    """The frame was turned before and is straight now, as the model has it; gains have changed."""
    heard = [said("identified", name) for name in ("gain_mismatch", "misalignment", "creep")]
    monkeypatch.setattr(loop, "diagnose_change", lambda *_: heard.pop(0))
    before = measured_on(TRUTHS["misalignment"], rows=120)
    gains = with_truth("gain_mismatch", {"gain": [0.16, -0.12, -0.05]})
    found = improve(bare_arm(), [measured_on(gains, rows=120, noise_seed=5)], before=[before])
    assert [r.step for r in found.rounds] == ["gain_mismatch", None]
    why = "; but misalignment explains some of the change, and the model itself errs more with it"
    assert why in found.rounds[-1].sentence
    turned = before.key_points_mm - measured_on(bare_arm(), rows=120).key_points_mm
    assert found.model_error.after < rms_distance(turned), "the frame of the model is that of now"


def test_recordings_from_before_and_a_refit_exclude_each_other():
    recording = measured_on(bare_arm(), rows=200)
    with pytest.raises(InputError, match="leave out one of the two"):
        improve(bare_arm(), [recording], before=[replace(recording)], refit="always")


def test_a_wrong_diagnosis_is_not_followed(recited):
    """An effect that the whole model cannot use ends the loop and is not added."""
    recited(said("identified", "line_lag"))
    result = improve(bare_arm(), [measured_on(TRUTHS["gain_mismatch"], rows=200)])
    assert result.steps == []
    assert not result.claimed
    assert "does not lower the error" in result.rounds[-1].sentence
    assert list(result.model.effects) == []


def test_an_effect_that_helps_only_beyond_all_plausibility_is_not_added(recited):
    """Gains that differ by so much are no manufacturing spread: amend may add them, improve not."""
    truth = with_truth("gain_mismatch", {"gain": [0.7, -0.1, -0.4]})
    recited(said("identified", "gain_mismatch"))
    result = improve(bare_arm(), [measured_on(truth, rows=200)])
    assert [name for name, _ in result.steps if name != NETWORK] == []
    assert "only with an implausible gain_share" in result.rounds[0].sentence


def test_an_effect_a_little_beyond_plausibility_is_held_at_its_end(recited):
    """A share of 1.3 of the line, where 1.05 is the most: a longer lag does nearly as much."""
    truth = with_truth("line_lag", {"share": 1.3, "log_up": math.log(0.5), "log_down": 0.0})
    recited(said("identified", "line_lag"), said("nothing_missing"))
    result = improve(bare_arm(), [measured_on(truth, rows=300)])
    assert [name for name, _ in result.steps if name != NETWORK] == ["line_lag"]
    share = next(p for p in result.parameters if p.name == "share")
    assert share.value == pytest.approx(1.05, abs=1e-3)
    assert share.plausible
    assert result.claimed


def test_a_plausible_effect_takes_the_place_of_one_that_fits_beyond_plausibility(recited):
    """The lag of a line looks like inertia that no arm has: more than all of it swings."""
    truth = with_truth("line_lag", {"share": 1.0, "log_up": math.log(0.06), "log_down": 0.0})
    either = replace(said("ambiguous", "inertia", "line_lag"), ambiguous_with=("line_lag",))
    recited(either, said("nothing_missing"))
    result = improve(bare_arm(), [measured_on(truth, rows=120)])
    assert [name for name, _ in result.steps if name != NETWORK] == ["line_lag"]
    assert result.rounds[0].competing == ("inertia",)
    assert "line_lag in its place: inertia would lower the error" in result.rounds[0].sentence
    assert "only with an implausible" in result.rounds[0].sentence
    assert result.claimed
    recited(said("identified", "inertia"), said("nothing_missing"))
    alone = improve(bare_arm(), [measured_on(truth, rows=120)])
    assert [name for name, _ in alone.steps if name != NETWORK] == ["inertia"]


def test_alternatives_are_what_the_diagnosis_cannot_tell_from_the_effect():
    either = replace(said("ambiguous", "creep", "twist"), ambiguous_with=("twist",))
    assert alternatives(either, "creep") == ["twist"]
    assert alternatives(either, "twist") == ["creep"]
    assert alternatives(either, "creep", ["twist"]) == []
    both = replace(said("several", "creep", "twist"), ambiguous_with=("drift",))
    assert alternatives(both, "twist") == ["drift"]
    assert alternatives(said("identified", "creep"), "creep") == []


def test_the_loop_ends_when_an_effect_is_named_again_or_enough_were_added(recited):
    recording = measured_on(TRUTHS["misalignment"], rows=100)
    recited(said("identified", "misalignment"), said("identified", "misalignment"))
    again = improve(bare_arm(), [recording])
    assert [name for name, _ in again.steps] == ["misalignment"]
    recited(said("ambiguous", "misalignment", "drift"))
    once = improve(bare_arm(), [recording], most_effects=np.int64(1))
    assert [name for name, _ in once.steps] == ["misalignment"]
    assert once.rounds[0].competing == ("drift",)
    with pytest.raises(InputError, match="expected 1 or more"):
        improve(bare_arm(), [recording], most_effects=0)


def yielding() -> ArmModel:
    """Gains that differ, and a holder that yields as the cube root of the time."""
    arm = with_truth("gain_mismatch", {"gain": [0.12, -0.08, -0.02]})
    strengths = {"turn": [0.03, -0.02, 0.0], "log_tau": 9.0, "log_power": math.log(0.35)}
    return with_truth("drift", strengths, arm, kind="base", power=0.35)


def test_the_form_of_an_effect_is_chosen_beside_the_others(recited):
    """Gains that were fitted alone have taken over some of the drift, and what is left looks like
    gains that drift."""
    recited(said("identified", "gain_mismatch"), said("identified", "drift"), said("cannot_tell"))
    result = improve(bare_arm(), [measured_on(yielding(), rows=400)])
    assert [r.step for r in result.rounds if r.step != NETWORK] == ["gain_mismatch", "drift", None]
    assert result.model.effects["drift"].kind == "base"
    assert result.held_out.after < 1.15 * math.sqrt(3) * NOISE_MM


def test_an_effect_that_is_named_again_is_sought_in_another_form(recited, monkeypatch):
    """A first drift in the form of gains is exchanged for one of the base."""
    drifting = with_truth("drift", {"gain": [0.05, 0.0, 0.0]}, kind="actuation")
    fit_effects = loop.fit_effects

    def first_in_a_wrong_form(problem, names, more):
        monkeypatch.setattr(loop, "fit_effects", fit_effects)
        return replace(fit_effects(problem.with_model(drifting), names), refitted=())

    monkeypatch.setattr(loop, "fit_effects", first_in_a_wrong_form)
    recited(*[said("identified", "drift")] * 3)
    truth = with_truth("drift", {"turn": [0.03, -0.02, 0.0], "log_tau": 6.5}, kind="base")
    result = improve(bare_arm(), [measured_on(truth, rows=250)])
    done = [(r.step, r.anew) for r in result.rounds if r.step != NETWORK]
    assert done == [("drift", False), ("drift", True), (None, False)]
    assert result.model.effects["drift"].kind == "base"
    assert result.to_json()["effects"] == ["drift"]
    assert result.sentence.startswith("drift: error reduced")


def test_what_a_diagnosis_leads_to():
    assert next_effects(said("nothing_missing")) == ()
    assert next_effects(said("unknown_effect")) == ()
    assert next_effects(said("identified", "creep")) == ("creep",)
    assert next_effects(said("several", "creep", "payload")) == ("creep", "payload")
    assert next_effects(said("ambiguous", "creep", "drift")) == ("creep",)
    assert next_effects(said("ambiguous", "creep", "drift"), ["creep"]) == ("drift",)
    assert next_effects(said("several", "creep", "payload"), ["payload"]) == ("creep",)
    assert next_effects(said("identified", "creep"), ["creep"]) == ()
    assert next_effects(said("cannot_tell")) == ()


def test_what_is_more_likely_missing_than_not_is_tried():
    for known, tried in ((0.6, ("creep",)), (0.4, ())):
        chances = Probabilities(0.0, 0.0, 1 - known, {"creep": known - 0.1, "drift": 0.1}, 0.0, ())
        unsure = replace(said("cannot_tell"), probabilities=chances)
        assert next_effects(unsure) == tried
        assert next_effects(unsure, ["payload"]) == (), "less likely than not by itself"
    chances = Probabilities(0.0, 0.0, 0.3, {"creep": 0.6, "drift": 0.1}, 0.0, ())
    likely = replace(said("cannot_tell"), probabilities=chances)
    assert next_effects(likely, ["payload"]) == ("creep",)
    assert next_effects(likely, ["creep"]) == ()


def test_rounds_are_reported_as_they_end(recited):
    recited(said("identified", "gain_mismatch"), said("nothing_missing"))
    heard = []
    result = improve(
        bare_arm(), [measured_on(TRUTHS["gain_mismatch"], rows=200)], progress=heard.append
    )
    assert [r.step for r in heard] == [r.step for r in result.rounds] == ["gain_mismatch", None]
    assert all(r.error_mm is None for r in heard)
    assert result.rounds[-1].error_mm == result.held_out.after


def test_the_second_effect_of_an_answer_does_not_repeat_its_sentence(recited):
    recited(said("several", "misalignment", "gain_mismatch"), said("nothing_missing"))
    truth = with_truth("gain_mismatch", {"gain": [0.06, -0.02, -0.05]}, TRUTHS["misalignment"])
    result = improve(bare_arm(), [measured_on(truth, rows=100)])
    assert [r.step for r in result.rounds] == ["misalignment", "gain_mismatch", None]
    assert result.rounds[0].sentence == "several it is"
    assert result.rounds[1].sentence == "named beside misalignment by the same diagnosis"


def test_no_more_effects_are_added_than_asked_for(recited):
    """A diagnosis names two where one is allowed."""
    recited(said("several", "misalignment", "gain_mismatch"), said("nothing_missing"))
    truth = with_truth("gain_mismatch", {"gain": [0.06, -0.02, -0.05]}, TRUTHS["misalignment"])
    result = improve(bare_arm(), [measured_on(truth, rows=100)], most_effects=1)
    assert list(result.model.effects) == ["misalignment"]


def test_tables_follow_the_confidence_that_they_print():
    """Equal confidences by the error that is left."""
    rows = [("a", 0.001, 0.5), ("b", 0.004, 0.2), ("c", 0.9, 0.4), ("d", 0.06, 0.1)]
    ranking = tuple(
        Ranked(name, confidence, 0.0, 0.0, error, (0.0, 1.0), 1.0, 0.0, {})
        for name, confidence, error in rows
    )
    found = Diagnosis(Verdict("identified", ("c",), "c"), ErrorLevels(1.0, 0.1, 0.1), ranking)
    assert [row.effect for row in found.shown] == ["c", "d", "b", "a"]
    assert found.ranking == ranking


QUIET = Round("nothing_missing", "no effect is missing; error 0.1 mm", None, (), None, 0.1, 0.1)
ADDED = Round("identified", "creep is missing", "creep", (), 0.9, 0.2, 0.2)
TUNED = Round("retuned", "a re-tuned network lowers it", "network", (), None, 0.1, 0.1)


@pytest.mark.parametrize(
    ("rounds", "left"),
    [
        ((ADDED, QUIET), "No effect is missing; error 0.1 mm."),
        (
            (ADDED, QUIET, TUNED),
            "No effect is missing; error 0.1 mm. That was before the network was re-tuned.",
        ),
        ((QUIET,), "No effect is missing; error 0.1 mm."),
        (
            (ADDED,),
            "No diagnosis was made after creep was added, so it is not known whether "
            "an effect is still missing.",
        ),
        (
            (ADDED, TUNED),
            "No diagnosis was made after creep was added, so it is not known "
            "whether an effect is still missing.",
        ),
    ],
)
def test_what_is_left_is_not_what_was_just_added(rounds, left):
    found = Improvement(None, rounds, (), None, (None, None), 0.0, diagnoses=(said("x"),))
    first, *_ = [part.body for part in what_is_left(found).parts if isinstance(part, Text)]
    assert first == left


@pytest.mark.parametrize(
    ("rounds", "fall", "claimed"),
    [
        ((ADDED, QUIET), {}, True),
        ((QUIET,), {}, False),
        ((ADDED, QUIET), {"ci95": (-0.1, 0.3)}, False),
        ((ADDED, QUIET), {"in_fit": 0.3}, False),
        ((replace(ADDED, together=True), QUIET), {"in_fit": 0.3}, True),
        ((replace(ADDED, together=True), QUIET), {"in_fit": 0.3, "ci95": (-0.1, 0.3)}, False),
        ((replace(ADDED, together=True), QUIET), {}, True),
    ],
)
def test_what_is_claimed_of_an_improvement(rounds, fall, claimed):
    """Rows that the given model knew are no test of it, but for a network that was trained on."""
    held_out = replace(Fall(1.2, 1.0, 0.2, 0.2, (0.1, 0.3), rows=9, blocks=3), **fall)
    found = Improvement(None, rounds, (), held_out, (None, None), 0.0)
    assert found.claimed is claimed
    assert found.to_json()["claimed"] is claimed
    assert ("error reduced from" in found.sentence) is claimed
