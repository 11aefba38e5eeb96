"""Cases on the PyElastica rig: what is planned, and what a small call writes."""

import json

import numpy as np
import pytest

pytest.importorskip("elastica", reason="PyElastica is not installed (extra `elastica`)")

from benchmarks import elastica_cases, rig_cases
from benchmarks.elastica_cases import GENERATOR
from benchmarks.rig_cases import (
    ALIKE,
    KNOWN,
    Case,
    cases,
    load_case,
    make_case,
    make_robot,
    pairs,
    unknowns,
)
from surgisoft.measurement.recordings import load_recording


def test_a_round_holds_every_effect_pairs_and_clean_robots():
    planned = cases(GENERATOR, [1, 2, 3], 25, seed=4)
    single = {case.names[0] for case in planned if len(case.names) == 1}
    assert single == {*KNOWN, *GENERATOR.unknown}
    assert sum(case.names == () for case in planned) == 4
    assert sum(len(case.names) == 2 for case in planned) == 2
    assert {case.robot for case in planned} == {1, 2, 3}
    assert [case.truth for case in planned if case.names == ("breathing",)] == [["unknown"]]
    assert [case.truth for case in planned if case.names == ("thermal_drift",)] == [["drift"]]


def test_the_plan_follows_from_its_seed_and_only_grows():
    longer = cases(GENERATOR, [1, 2, 3], 60, seed=4)
    assert longer[:25] == cases(GENERATOR, [1, 2, 3], 25, seed=4)
    assert longer[:25] != cases(GENERATOR, [1, 2, 3], 25, seed=5)


def test_pairs_are_every_two_that_are_not_alike_and_have_a_plan_of_their_own():
    """15 effects make 105 pairs, four of which are alike. Every robot has its turn, and the plan
    with more cases begins with the same ones."""
    planned = pairs([1, 2, 3], 101, seed=4)
    assert len({frozenset(case.names) for case in planned}) == 15 * 14 // 2 - len(ALIKE)
    assert not [case for case in planned if set(case.names) in ALIKE]
    assert all(len(set(case.truth)) == 2 for case in planned)
    assert [case.robot for case in planned[:4]] == [1, 2, 3, 1]
    assert planned[:20] == pairs([1, 2, 3], 20, seed=4)
    assert len({case.name for case in [*planned, *cases(GENERATOR, [1], 101, seed=4)]}) == 202


def test_unknown_effects_of_every_kind_come_in_turn():
    planned = unknowns(GENERATOR, [1, 2], 2 * len(GENERATOR.more_unknown), seed=4)
    for part in (planned[: len(GENERATOR.more_unknown)], planned[len(GENERATOR.more_unknown) :]):
        assert (
            {case.names[0] for case in part} == set(GENERATOR.more_unknown) > set(GENERATOR.unknown)
        )
    assert all(case.truth == ["unknown"] for case in planned)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A robot whose recordings take a few seconds; cases are recorded beside it."""
    place = tmp_path_factory.mktemp("cases")
    with pytest.MonkeyPatch.context() as patch:
        for module, name in ((elastica_cases, "BEFORE_S"), (rig_cases, "AFTER_S")):
            patch.setattr(module, name, dict.fromkeys(getattr(module, name), 2.5))
        patch.setattr(rig_cases, "TRIED_S", 2.5)
        make_robot(GENERATOR, place, 2)
        yield place


def test_a_case_repeats_the_actuation_and_differs_by_its_effect(folder):
    make_case(GENERATOR, folder, Case(0, 2, ("payload",), 1.0, "same"))
    make_case(GENERATOR, folder, Case(1, 2, (), 1.0, "same"))
    truth, before, after = load_case(folder, "000")
    assert truth["truth"] == ["payload"]
    assert truth["same_actuation"]
    assert [recording.name for recording in before] == ["mixed", "other"]
    np.testing.assert_array_equal(before[0].commanded, after[0].commanded)
    change = np.linalg.norm(after[0].key_points_mm - before[0].key_points_mm, axis=2)
    found = np.sqrt(np.nanmean(change**2))  # with noise of 0.04 mm in each of six coordinates
    assert found == pytest.approx(truth["change_rms_mm"], abs=0.08)
    assert 0.4 < truth["change_rms_mm"] < 2.5
    clean, _, _ = load_case(folder, "001")
    assert (clean["truth"], clean["change_rms_mm"]) == ([], 0.0)


def test_a_pair_states_what_each_effect_changes(folder):
    """Each alone, on the actuation of the recording; so the two obey the triangle inequality."""
    make_case(GENERATOR, folder, Case(3, 2, ("payload", "misalignment"), 1.0, "mixed", "pair"))
    make_case(GENERATOR, folder, Case(4, 2, ("payload",), 1.0, "mixed"))
    truth, _, _ = load_case(folder, "pair-003")
    single, _, _ = load_case(folder, "004")
    each = {one["effect"]: one["change_rms_mm"] for one in truth["hidden"]}
    assert truth["truth"] == ["payload", "misalignment"]
    assert each["payload"] == pytest.approx(single["change_rms_mm"])
    one, other = each.values()  # of small changes the two add, in whatever directions
    assert abs(one - other) - 0.05 < truth["change_rms_mm"] < one + other + 0.05


def test_what_exists_is_kept(folder):
    file = folder / "robots" / "2" / "before" / "mixed.parquet"
    stamp = file.stat().st_mtime_ns
    make_robot(GENERATOR, folder, 2)
    assert file.stat().st_mtime_ns == stamp
    assert load_recording(file).noise_mm == pytest.approx(0.04, abs=0.01)
    about = json.loads((folder / "robots" / "2" / "robot.json").read_text())
    assert about["seed"] == 2
