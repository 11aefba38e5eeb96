"""What an amendment is worth on a generator of robots: which cases, compared with what."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks import amended_cases, elastica_cases, rig_cases
from benchmarks.amended_cases import (
    AmendedCase,
    markdown,
    statements,
    to_amend,
    to_improve,
    unchanged,
)
from benchmarks.decision.evidence_log import Labelled, stored
from benchmarks.decision.table import Judged
from benchmarks.diagnosis.amend import Amended
from benchmarks.rig_cases import Case, load_case, make_case, make_robot
from surgisoft.diagnosis.decision import Decision, Probabilities, fitted_decision
from surgisoft.errors import InputError
from tests.diagnosis.test_decision import GOOD

LABELLED = Labelled(
    source="elastica_b",
    robot="2",
    case="cases/001",
    label="known",
    truth=("creep",),
    memory=True,
    effect_mm=1.0,
    validated_mm=0.5,
    minutes=2.5,
    evidence=GOOD,
    seconds=1.0,
)
CHANCES = Probabilities(
    nothing=0.0,
    network=0.0,
    unknown=0.0,
    effects={"line_lag": 0.6, "creep": 0.4},
    pair=0.1,
    two=("creep", "line_lag"),
)


def said(kind, effects, **changes):
    return Judged(replace(LABELLED, **changes), Decision(kind, effects, 0.9, CHANCES))


def test_the_unchanged_recording_is_that_of_a_case_without_any_change(tmp_path, monkeypatch):
    """The same noise, schedule and robot to the last bit, also in another plan."""
    for module, name in ((elastica_cases, "BEFORE_S"), (rig_cases, "AFTER_S")):
        monkeypatch.setattr(module, name, dict.fromkeys(getattr(module, name), 4.0))
    monkeypatch.setattr(rig_cases, "TRIED_S", 4.0)
    make_robot(elastica_cases.GENERATOR, tmp_path, 2)
    for plan, name in (("round", "001"), ("unknown", "unknown-001")):
        make_case(elastica_cases.GENERATOR, tmp_path, Case(1, 2, (), 1.0, "mixed", plan))
        _, _, after = load_case(tmp_path, name)
        case = replace(LABELLED, case=f"cases/{name}")
        plain = unchanged(elastica_cases.GENERATOR, case, "mixed")
        np.testing.assert_array_equal(plain.key_points_mm, after[0].key_points_mm)
        np.testing.assert_array_equal(plain.commanded, after[0].commanded)


def test_a_model_is_amended_by_what_is_named():
    """By the more probable effect of a set, whatever its order; by both of two."""
    some = [
        said("identified", ("creep",)),
        said("ambiguous", ("creep", "line_lag")),
        said("several", ("creep", "line_lag"), truth=("creep", "line_lag")),
        said("cannot_tell", ()),
        said("unknown_effect", ()),
        said("identified", ("creep",), effect_mm=0.4),
        said("identified", ("creep",), label="clean", truth=()),
        said("identified", ("line_lag",), left_out=("creep",)),
    ]
    assert [named for _, _, named in to_amend(some, 1)] == [("creep",), ("line_lag",)]
    assert [named for _, _, named in to_amend(some, 2)] == [("line_lag", "creep")]
    # `improve` takes every case with a visible effect of the list, whatever is said of it.
    assert [case for case, _, _ in to_improve(some, 1)] == [some[i].case for i in (0, 1, 3, 4)]
    assert [case for case, _, _ in to_improve(some, 2)] == [some[2].case]


def test_shares_of_the_oracle():
    """By hand: falls of 0.9 of 1.0 and of 1.5 of 3.0 mm; where the effect does not show in the
    held-out rows no share is counted."""
    worth = [
        AmendedCase("a", ("creep",), "identified", Amended(("creep",), 2.0, 1.1, 1.0)),
        AmendedCase("b", ("creep",), "identified", Amended(("line_lag",), 4.0, 2.5, 1.0)),
        AmendedCase("c", ("creep",), "identified", Amended(("creep",), 1.05, 1.0, 1.0)),
        AmendedCase("d", ("creep",), "identified", Amended((), 0.3, 0.3, 0.3)),
    ]
    rows = markdown({"chain": worth}).splitlines()
    assert rows[2] == "| chain | 4 | 2 | 2 | 1 | 2 | 70 % | 60 % | 1 | 90 % | 90 % |"
    cells = [row.split("|")[-2].strip() for row in rows if row.startswith("| chain | ")][1:]
    assert sorted(cells) == ["-", "-", "50 %", "90 %"]


def test_the_sources_that_took_no_part_are_judged_by_the_decision_in_force(monkeypatch):
    found = statements("elastica_b")
    assert len(found) == 36
    assert all(one.decision.confidence <= 1.0 for one in found)
    fitted_to = []

    def kept(cases):
        fitted_to.extend(cases)
        return {"models": {}}

    monkeypatch.setattr(amended_cases, "fit", kept)
    monkeypatch.setattr(amended_cases, "model_of", lambda values: fitted_decision())
    asked = statements("mujoco")  # of both kinds of models those of the defaults
    expected = {case.case for case in stored()["mujoco.default"]}
    assert len(expected) > 100
    assert {one.case.case for one in asked} == expected
    assert {one.case.models for one in asked} == {"default"}
    assert "mujoco" not in {case.source for case in fitted_to}
    assert {"strain_rod", "own_rig"} < {case.source for case in fitted_to}
    with pytest.raises(InputError, match="no stored evidence"):
        statements("nobody")
