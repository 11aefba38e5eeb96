"""Cases that are asked with and without the recordings from before: wiring, and counts by hand."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks import without_before
from benchmarks.without_before import NOT_TOLD, Answer, Asked, asked, main, markdown, rows
from surgisoft.measurement.histories import arm_spec
from surgisoft.measurement.recordings import Recording, save_recording

RIGHT = Answer("identified", ("creep",), 0.9)
SET = Answer("ambiguous", ("creep", "line_lag"), 0.7)
BOTH = Answer("several", ("creep", "line_lag"), 0.7)
WRONG = Answer("identified", ("drift",), 0.8)
UNSURE = Answer("cannot_tell", (), 0.3)
UNKNOWN = Answer("unknown_effect", (), 0.9)


def case(truth, without, given, size=2.0, faster=False, since_fit=NOT_TOLD):
    return Asked("chain", "cases/001", truth, size, faster, without, given, since_fit)


def test_the_counts_by_hand():
    some = [
        case(("creep",), RIGHT, SET),
        case(("creep",), BOTH, RIGHT),
        case(("creep",), WRONG, UNSURE),
        case(("creep",), WRONG, RIGHT, size=0.9),
        case(("creep", "line_lag"), BOTH, SET),
        case(("creep", "line_lag"), RIGHT, BOTH),
        case(("unknown",), UNSURE, UNKNOWN, size=0.5),
        case((), WRONG, replace(UNSURE, kind="nothing_missing")),
    ]
    assert [each[1:] for each in rows(some)] == [
        ("1 of 3", "2 of 3"),
        ("1 of 3", "0 of 3"),
        ("1 of 3", "0 of 3"),
        ("1 of 2", "1 of 2"),
        ("0 of 1", "1 of 1"),
        ("1 of 1", "0 of 1"),
        ("3 of 8", "0 of 8"),
    ]
    assert rows([case(("creep",), replace(WRONG, confidence=0.79), UNSURE)])[-1][1] == "0 of 1"


def test_faster_motion_has_columns_of_its_own():
    some = [case((), WRONG, UNSURE, faster=True, since_fit=SET), case((), UNSURE, UNSURE)]
    some.append(case((), WRONG, WRONG, faster=True, since_fit=UNSURE))
    said = "| nothing has changed: something named | 0 of 1 | 0 of 1 | 2 of 2 | 1 of 2 | 1 of 2 |"
    assert said in markdown(some)


def test_a_case_is_asked_both_ways_and_read_again(tmp_path, monkeypatch):
    t_s = np.arange(0.0, 20.0, 0.1)
    slow = 50.0 * (1 - np.abs(t_s / 10.0 % 1 * 2 - 1))[:, None]
    made = Recording("slow", t_s, slow, np.random.default_rng(0).normal(size=(len(t_s), 2, 3)))
    fast = replace(made, name="fast", measured=slow[(np.arange(len(t_s)) * 3) % len(t_s)])
    for place, each in (("robots/7/before", made), ("cases/001/after", fast)):
        (tmp_path / place).mkdir(parents=True)
        save_recording(each, tmp_path / place / f"{each.name}.parquet")
    truth = {"robot": "7", "truth": ["creep"], "change_rms_mm": 3.0}
    (tmp_path / "cases/001/truth.json").write_text(json.dumps(truth))
    model = SimpleNamespace(spec=arm_spec([made]), validation=SimpleNamespace(rmse_mm=2.0))
    monkeypatch.setattr(without_before, "model_folder", lambda folder, robot, work: robot)
    monkeypatch.setattr(without_before, "load_model", {"7": model}.get)

    def diagnose(given, after, before, refit):
        assert (given, refit, [each.name for each in after]) == (model, "never", ["fast"])
        if before is None:
            return SimpleNamespace(verdict=WRONG, since_fit=SET)
        assert [each.name for each in before] == ["slow"]
        return SimpleNamespace(verdict=RIGHT, since_fit=None)

    monkeypatch.setattr(without_before, "diagnose", diagnose)
    found = asked("chain", tmp_path, tmp_path / "cases/001/truth.json", tmp_path)
    assert found == case(("creep",), WRONG, RIGHT, size=1.5, faster=True, since_fit=SET)
    assert Asked.read(found.line) == found
    slow = replace(found, faster=False, since_fit=NOT_TOLD)
    assert Asked.read(slow.line) == slow


@pytest.mark.parametrize("given", ["chain", "chain=", "chain=nowhere"])
def test_a_folder_without_cases_is_refused_and_nothing_written(
    given, tmp_path, monkeypatch, capsys
):
    """Cases in the working directory are not taken for those of a folder without a name."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "truth.json").write_text("{}")
    log = tmp_path / "new" / "answers.jsonl"
    with pytest.raises(SystemExit) as ended:
        main([given, "--log", str(log)])
    assert ended.value.code == 2
    assert "expected NAME=FOLDER of cases" in capsys.readouterr().err
    assert not log.parent.exists()
