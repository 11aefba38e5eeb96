"""Undecided cases after the recommended experiment: wiring with stand-ins, and counts by hand."""

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import ClassVar

import numpy as np
import pytest

from benchmarks import recommended
from benchmarks.recommended import Settled, main, markdown, outcome, settle
from benchmarks.without_before import Answer
from surgisoft.diagnosis.design.schedules import AS_IT_STANDS
from surgisoft.measurement.protocols import Protocol
from surgisoft.measurement.recordings import Recording, save_recording

RIGHT = Answer("identified", ("creep",), 0.9)
SET = Answer("ambiguous", ("creep", "line_lag"), 0.7)
BOTH = Answer("several", ("creep", "line_lag"), 0.7)
WRONG = Answer("identified", ("drift",), 0.8)
UNSURE = Answer("cannot_tell", (), 0.3)
UNKNOWN = Answer("unknown_effect", (), 0.9)
NOTHING = Answer("nothing_missing", (), 0.9)
OFF = Answer("surrogate_undertrained", (), 0.9)


@pytest.mark.parametrize(
    ("truth", "columns"),
    [
        (("creep",), "right, in a set, wrong, wrong, undecided, wrong, wrong, undecided"),
        (("unknown",), "wrong, wrong, wrong, wrong, undecided, right, wrong, undecided"),
        ((), "wrong, wrong, wrong, wrong, undecided, wrong, right, undecided"),
    ],
)
def test_what_becomes_of_a_case(truth, columns):
    said = (RIGHT, SET, BOTH, WRONG, UNSURE, UNKNOWN, NOTHING, OFF)
    assert [outcome(truth, each) for each in said] == columns.split(", ")


def case(truth, first, after, ordinary, size=2.0, minutes=5.0, experiment="steps"):
    return Settled(
        "chain", "cases/001", truth, size, first, experiment, minutes, 0.9, after, ordinary
    )


def test_the_table_by_hand():
    """Small changes, and cases without an experiment, do not count."""
    some = [
        case(("creep",), SET, RIGHT, SET),
        case(("creep",), SET, WRONG, RIGHT, minutes=15.0),
        case(("creep",), SET, RIGHT, RIGHT, size=0.9),
        case(("creep",), RIGHT, RIGHT, RIGHT, experiment=""),
        case(("drift",), SET, UNSURE, RIGHT),
        case(("unknown",), UNSURE, UNKNOWN, UNSURE),
        case((), UNSURE, NOTHING, RIGHT, size=0.0),
    ]
    assert markdown(some).splitlines()[2:] == [
        "| nothing has changed | 1 | 1 | 0 | 0 | 0 | 0 | 0 | 1 | 0 | 5 |",
        "| one effect, in the first set | 2 | 1 | 0 | 1 | 0 | 1 | 1 | 0 | 0 | 15 |",
        "| one effect, not in the first set | 1 | 0 | 0 | 0 | 1 | 0 | 0 | 1 | 0 | 5 |",
        "| unknown effect | 1 | 1 | 0 | 0 | 0 | 0 | 0 | 0 | 1 | 5 |",
    ]


class Bench:
    """A robot that records set points without noise, and remembers what it was asked for."""

    period_s, limits, unit = 0.1, np.array([[0.0, 40.0]]), "kPa"
    asked: ClassVar[list] = []

    def __init__(self, robot, take, hidden):
        self.made = robot, take, hidden

    def record(self, protocol):
        Bench.asked.append((*self.made, protocol.name))
        t_s = np.arange(0.0, protocol.t_s[-1] + 0.05, 0.1)
        signal = np.interp(t_s, protocol.t_s, protocol.commands[:, 0])[:, None]
        return Recording(protocol.name, t_s, signal, np.zeros((len(t_s), 2, 3))), None


@pytest.mark.parametrize("advised", [True, False])
def test_the_steps_of_a_user_follow(tmp_path, monkeypatch, advised):
    t_s = np.arange(0.0, 10.0, 0.1)
    points = np.random.default_rng(0).normal(size=(len(t_s), 2, 3))
    made = Recording("day", t_s, 10.0 + t_s[:, None], points)
    for place in ("robots/7/before", "cases/001/after"):
        (tmp_path / place).mkdir(parents=True)
        save_recording(made, tmp_path / place / "day.parquet")
    hidden = [{"effect": "creep", "strength": 1.5}]
    truth = {"robot": "7", "truth": ["creep"], "hidden": hidden, "change_rms_mm": 3.0}
    (tmp_path / "cases/001/truth.json").write_text(json.dumps(truth))
    model = SimpleNamespace(validation=SimpleNamespace(rmse_mm=2.0))
    monkeypatch.setattr(recommended, "model_folder", lambda folder, robot, work: robot)
    monkeypatch.setattr(recommended, "load_model", {"7": model}.get)
    said, planned, Bench.asked = [], [], []

    def diagnose(given, after, before, paired="auto", refit="auto"):
        names = [each.name for each in after]
        said.append((names, [each.name for each in before], paired, refit))
        answers = {"day": SET, "steps": RIGHT, "ordinary": WRONG}
        verdict = answers[names[-1]]
        plan = "surgisoft next-experiment {model} {data}{before} --between creep line_lag -o S.csv"
        return SimpleNamespace(verdict=verdict, next_command=plan if advised else "surgisoft fit")

    def plan(given, after, between, settings, before):
        planned.append((between, settings, [each.name for each in before]))
        protocol = Protocol("steps", "continuous", [[0.0], [9.0]], [0, 0], [0.0, 20.0])
        pairs = [SimpleNamespace(after=0.9), SimpleNamespace(after=0.8)]
        return SimpleNamespace(name="steps", minutes=5.0, pairs=pairs, protocol=protocol)

    monkeypatch.setattr(recommended, "diagnose", diagnose)
    monkeypatch.setattr(recommended, "next_experiment", plan)
    generator = SimpleNamespace(rig=Bench)
    found = settle("chain", generator, tmp_path, tmp_path / "cases/001/truth.json", tmp_path, 3)
    if not advised:
        assert found == replace(
            case(("creep",), SET, SET, SET, 1.5, 0.0, experiment=""), expected=0.0
        )
        return
    assert found == replace(case(("creep",), SET, RIGHT, WRONG, 1.5), expected=0.8)
    assert Settled.read(found.line) == found
    assert planned == [(["creep", "line_lag"], (AS_IT_STANDS,), ["day"])]
    own = [("creep", 1.5)]
    assert Bench.asked == [(7, 100_006, own, "steps"), (7, 100_007, own, "ordinary")]
    assert said == [
        (["day"], ["day"], "auto", "never"),
        (["day", "steps"], ["day"], "never", "never"),
        (["day", "ordinary"], ["day"], "never", "never"),
    ]


def test_another_name_than_a_generators_is_refused(tmp_path, capsys):
    (tmp_path / "truth.json").write_text("{}")
    for given in (f"finger={tmp_path}", "chain=", f"chain={tmp_path / 'none'}"):
        with pytest.raises(SystemExit) as ended:
            main([given, "--log", str(tmp_path / "new" / "log.jsonl")])
        assert ended.value.code == 2
        assert "expected NAME=FOLDER with cases; NAME begins with chain," in capsys.readouterr().err
    assert not (tmp_path / "new").exists()
