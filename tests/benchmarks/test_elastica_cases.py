"""Cases on the PyElastica rig: what is planned, and what a small call writes."""

import json

import numpy as np
import pytest

pytest.importorskip("elastica", reason="PyElastica is not installed (extra `elastica`)")

from benchmarks import elastica_cases
from benchmarks.elastica_cases import KNOWN, UNKNOWN, Case, cases, load_case, make_case, make_robot
from surgisoft.measurement.recordings import load_recording


def test_a_round_holds_every_effect_pairs_and_clean_robots():
    planned = cases([1, 2, 3], 25, seed=4)
    single = {case.names[0] for case in planned if len(case.names) == 1}
    assert single == {*KNOWN, *UNKNOWN}
    assert sum(case.names == () for case in planned) == 4
    assert sum(len(case.names) == 2 for case in planned) == 2
    assert {case.robot for case in planned} == {1, 2, 3}
    assert [case.truth for case in planned if case.names == ("breathing",)] == [["unknown"]]
    assert [case.truth for case in planned if case.names == ("thermal_drift",)] == [["drift"]]


def test_the_plan_follows_from_its_seed_and_only_grows():
    longer = cases([1, 2, 3], 60, seed=4)
    assert longer[:25] == cases([1, 2, 3], 25, seed=4)
    assert longer[:25] != cases([1, 2, 3], 25, seed=5)


@pytest.fixture
def brief(monkeypatch):
    """Recordings of a few seconds."""
    for name in ("BEFORE_S", "AFTER_S"):
        monkeypatch.setattr(elastica_cases, name, dict.fromkeys(getattr(elastica_cases, name), 4.0))
    monkeypatch.setattr(elastica_cases, "TRIED_S", 4.0)


def test_a_case_repeats_the_actuation_and_differs_by_its_effect(tmp_path, brief):
    make_robot(tmp_path, 2)
    make_case(tmp_path, Case(0, 2, ("payload",), 1.0, "same"))
    make_case(tmp_path, Case(1, 2, (), 1.0, "same"))
    truth, before, after = load_case(tmp_path, 0)
    assert truth["truth"] == ["payload"]
    assert truth["same_actuation"]
    assert [recording.name for recording in before] == ["mixed", "other"]
    np.testing.assert_array_equal(before[0].commanded, after[0].commanded)
    change = np.linalg.norm(after[0].key_points_mm - before[0].key_points_mm, axis=2)
    found = np.sqrt(np.nanmean(change**2))  # with noise of 0.04 mm in each of six coordinates
    assert found == pytest.approx(truth["change_rms_mm"], abs=0.08)
    assert 0.4 < truth["change_rms_mm"] < 2.5
    clean, _, _ = load_case(tmp_path, 1)
    assert (clean["truth"], clean["change_rms_mm"]) == ([], 0.0)


def test_what_exists_is_kept(tmp_path, brief):
    make_robot(tmp_path, 2)
    file = tmp_path / "robots" / "2" / "before" / "mixed.parquet"
    stamp = file.stat().st_mtime_ns
    make_robot(tmp_path, 2)
    assert file.stat().st_mtime_ns == stamp
    assert load_recording(file).noise_mm == pytest.approx(0.04, abs=0.01)
    about = json.loads((tmp_path / "robots" / "2" / "robot.json").read_text())
    assert about["seed"] == 2
