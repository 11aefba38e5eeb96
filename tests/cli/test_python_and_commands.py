"""The functions of the package and the commands give the same numbers."""

import csv
import inspect
import json
import re
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from surgisoft.agents.on_rig import RigConfig
from surgisoft.agents.session import EvaluationRequest, evaluate
from surgisoft.cli import run
from surgisoft.diagnosis.amend import amend
from surgisoft.diagnosis.compare import compare
from surgisoft.diagnosis.design.next_experiment import next_experiment
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.diagnosis.improve import improve
from surgisoft.errors import InputError
from surgisoft.experiments.session import ExperimentRules, finish_experiment, start_experiment
from surgisoft.live.change import AlarmDesign
from surgisoft.live.session import RunRequest
from surgisoft.measurement.fitting import fit
from surgisoft.measurement.importing import import_recordings
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import load_recording, save_recording
from surgisoft.replay.show import open_replay
from surgisoft.rig import VirtualRig
from surgisoft.rig.trial import collect
from surgisoft.scene.author import Request
from surgisoft.scene.spec import LimitsSpec
from surgisoft.surrogate.checkpoint import default_arm, load_model, save_model
from surgisoft.surrogate.fit import FitConfig
from tests.few_effects import few_effects
from tests.replay.reading import entities, values_of

DOCS = Path(__file__).resolve().parents[2] / "docs"


def python_snippets(page: str) -> list[str]:
    """The Python blocks of a page of the documentation."""
    return re.findall(r"^```python\n(.*?)^```", (DOCS / page).read_text(), re.S | re.M)


@pytest.fixture(scope="module", autouse=True)
def _few_effects():
    with few_effects("creep", "drift", "payload", "misalignment"):
        yield


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A model with its training residuals, a recording with creep, one on a turned bench."""
    folder = tmp_path_factory.mktemp("lab")
    save_model(default_arm(), folder / "arm")
    for name, roll_deg, hidden in (("bench", 0.0, [("creep", 1.0)]), ("turned", 90.0, [])):
        rig = VirtualRig(0, take=7, roll_deg=roll_deg, hidden=hidden)
        recording = rig.record(make_protocol("mixed", rig.limits, 400, seed=2))[0]
        save_recording(recording, folder / f"{name}.parquet")
    return folder


def timeless(values: dict) -> dict:
    """A result's JSON without the time that it took."""
    return {name: value for name, value in values.items() if name != "seconds"}


def as_written(result) -> dict:
    """The JSON of a result after a file, as the command writes it."""
    return timeless(json.loads(json.dumps(result.to_json())))


def of_command(folder: Path, *arguments: str) -> dict:
    """The JSON that a command writes."""
    out = folder / "command.json"
    out.unlink(missing_ok=True)
    assert run([*arguments, "--json", str(out)]) in (0, 1)
    return timeless(json.loads(out.read_text()))


@pytest.fixture(scope="module")
def diagnosed_by_command(lab):
    """The JSON of `surgisoft diagnose` of the recording with creep."""
    return of_command(lab, "diagnose", str(lab / "arm"), str(lab / "bench.parquet"))


def test_the_snippet_of_the_documentation_gives_what_the_command_prints(
    lab, diagnosed_by_command, monkeypatch, capsys
):
    monkeypatch.chdir(lab)
    (snippet,) = (text for text in python_snippets("diagnosis.md") if "diagnose(" in text)
    names = {}
    exec(snippet, names)
    said = capsys.readouterr().out
    assert as_written(names["found"]) == diagnosed_by_command
    assert names["found"].verdict.sentence in said


def test_training_residuals_decide_in_python_too(lab, diagnosed_by_command):
    """A model without them is another question, and the ranking's numbers differ."""
    model = load_model(lab / "arm")
    assert model.training_residuals is not None
    model.training_residuals = None
    without = as_written(diagnose(model, lab / "bench.parquet"))
    assert diagnosed_by_command["statistics"] != without["statistics"]


def test_a_turned_bench_gives_one_result_everywhere(lab, capsys):
    arm, data = str(lab / "arm"), str(lab / "turned.parquet")
    compared, _ = compare(arm, data)
    assert as_written(compared) == of_command(lab, "compare", arm, data)
    diagnosed = diagnose(arm, [data])
    assert as_written(diagnosed) == of_command(lab, "diagnose", arm, data)
    assert diagnosed.ranking[0].effect == "payload"
    amended = amend(arm, data, ["payload"])
    new = ["-o", str(lab / "new"), "--force"]
    command = ["amend", arm, "--effect", "payload", "--data", data, *new]
    assert as_written(amended) == of_command(lab, *command)
    save_model(amended.model, lab / "mine", amended.to_json())
    mine, theirs = (json.loads((lab / f / "report.json").read_text()) for f in ("mine", "new"))
    assert timeless(mine) == timeless(theirs)
    assert (mine["amended_from"], mine["recordings"]) == ("arm", ["turned"])
    assert amended.model.spec.gravity is None
    for result in (compared, diagnosed, amended):
        assert any("35 degrees" in note for note in result.notes)
    warned = capsys.readouterr().err
    assert warned.count("35 degrees") == 3


def test_improve_gives_one_result(lab):
    improved = improve(lab / "arm", lab / "turned.parquet", 1)
    command = ["improve", str(lab / "arm"), str(lab / "turned.parquet"), "--max-effects", "1"]
    page = ["--report", str(lab / "story"), "--replay", str(lab / "story.rrd")]
    found = of_command(lab, *command, "-o", str(lab / "better"), "--force", *page)
    assert as_written(improved) == found
    assert any("35 degrees" in note for note in improved.notes)
    text = (lab / "story" / "report.html").read_text()
    told = ["What was measured", "Where the model failed", "What was missing", "What it is worth"]
    places = [text.index(f"<h2>{part}") for part in [*told, "What is left, and what to record"]]
    assert places == sorted(places)
    first, *others = improved.diagnoses[0].ranking
    assert f"By itself, {first.effect} leaves {first.heldout_rmse_mm:.3f} mm" in text
    least = min(others, key=lambda other: other.heldout_rmse_mm)
    assert f"{least.effect} leaves least, {least.heldout_rmse_mm:.3f} mm" in text
    assert f">{least.effect}</td>" in text
    assert ("<td>added</td>" in text) == bool(improved.steps)
    for name in ("story/bodies.png", "story/waterfall.png", "story.rrd"):
        assert (lab / name).stat().st_size > 10_000
    assert (lab / "story" / "waterfall.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_the_next_experiment_asks_what_diagnose_asks(lab):
    """It distinguishes loads of any direction on a turned bench, as the diagnosis does."""
    arm, data = str(lab / "arm"), str(lab / "turned.parquet")
    found = next_experiment(arm, data, ["payload", "misalignment"], 6.0)
    more = ["--between", "payload", "misalignment", "--minutes", "6", "--force"]
    new = ["-o", str(lab / "s.csv"), "--record", str(lab / "next.parquet")]
    assert as_written(found) == of_command(lab, "next-experiment", arm, data, *more, *new)
    assert any("35 degrees" in note for note in found.notes)
    mine = collect(lab / "s.csv", **found.rig_options)
    theirs = load_recording(lab / "next.parquet")
    np.testing.assert_array_equal(mine.key_points_mm, theirs.key_points_mm)
    np.testing.assert_array_equal(mine.gravity, theirs.gravity)


def test_the_next_experiment_sees_the_problem_of_the_diagnosis(lab, monkeypatch):
    """The rows, the residuals of the fit and the freed direction of gravity that both look at."""
    from surgisoft.diagnosis import diagnose as diagnosing
    from surgisoft.diagnosis.design import next_experiment as proposing

    seen = {}

    class Enough(Exception):
        pass

    def caught(name):
        def stop(problem, *_, **__):
            seen[name] = problem
            raise Enough

        return stop

    monkeypatch.setattr(diagnosing, "candidates", caught("diagnose"))
    monkeypatch.setattr(proposing, "recommend", caught("next"))
    arguments = (lab / "arm", lab / "turned.parquet")
    with pytest.raises(Enough):
        diagnose(*arguments)
    with pytest.raises(Enough):
        next_experiment(*arguments, ["payload", "drift"])
    one, other = seen["diagnose"], seen["next"]
    assert one.index.equal(other.index)
    assert other.model.spec.gravity is None
    assert (one.reference.residual == other.reference.residual).all()


def default_of(parameters, name: str):
    """A default, as the work sees it: nothing given is nothing, whatever the type."""
    value = parameters[name].default
    if isinstance(value, list | tuple):
        value = tuple(value) or None
    return value.get("default") if isinstance(value, dict) else value


SAME_DEFAULTS = [
    ("compare", "compare", compare, {"model_error": "error_mm"}, 5),
    ("diagnose", "diagnose", diagnose, {"model_error": "error_mm"}, 7),
    ("amend", "amend", amend, {"model_error": "error_mm"}, 4),
    ("improve", "improve", improve, {"model_error": "error_mm", "most": "most_effects"}, 3),
    ("next_experiment", "next_experiment", next_experiment, {"model_error": "error_mm"}, 4),
    ("fit", "fit", fit, {}, 3),
    ("fit", "fit", FitConfig, {}, 7),
    ("collect", "collect", collect, {}, 5),
    ("evaluate", "evaluate", EvaluationRequest, {}, 7),
    ("evaluate", "evaluate", RigConfig, {"seed": "seed of the episodes"}, 2),
    ("run_", "run", RunRequest, {"rate": "rate_hz", "reference": "reference_s"}, 11),
    ("run_", "run", AlarmDesign, {"false_alarm": "false_alarm_h"}, 1),
    ("replay", "replay", open_replay, {"time": "time_s"}, 6),
    ("scene", "new", Request, {"margin": "margin_mm", "diameter": "diameter_mm"}, 7),
    ("scene", "new", LimitsSpec, {"clearance": "clearance_mm"}, 1),
    ("experiment", "run", start_experiment, {}, 5),
    ("experiment", "run", finish_experiment, {}, 3),
]
"""Module and function of a command, function or dataclass of its work, names that differ, and how
many options at least both have."""


BY_MEANING = {"observer_gain", "output", "size"}
"""Options whose absence is stated in another way: a gain selects another observer, the command
`run` always writes a recording, and a picture has another default size than a notebook's frame."""


@pytest.mark.parametrize(("module", "command", "work", "names", "least"), SAME_DEFAULTS)
def test_an_option_that_is_not_given_has_one_default(module, command, work, names, least):
    options = inspect.signature(getattr(import_module(f"surgisoft.cli.{module}"), command))
    given = {names.get(name, name): name for name in options.parameters}
    known = inspect.signature(work).parameters
    shared = [name for name in given if name in known]
    assert len(shared) >= least, shared
    for name in set(shared) - BY_MEANING:
        option = default_of(options.parameters, given[name])
        own = default_of(known, name)
        assert option == own, name


@pytest.fixture
def short(tmp_path):
    """An experiment of half a second without a scene."""
    file = tmp_path / "short.toml"
    file.write_text(
        'name = "short"\nscenario = "track_circle"\nseed = 5\n[limits]\ntime_s = 0.6\n'
        "[task.follow]\nsize_mm = 12.0\n"
        '[[phases]]\nname = "go"\ntimeout_s = 9.0\narm = "policy"\n'
    )
    return file


def test_an_experiment_gives_one_result(short, tmp_path):
    spec, folder = start_experiment(short, tmp_path / "mine", repeats=2)
    results, files = finish_experiment(spec, folder, replays=False)
    words = ["--repeats", "2", "--no-replays", "-o", str(tmp_path / "theirs")]
    assert run(["experiment", "run", str(short), *words]) == 0
    assert len(results.rows) == 2
    tables = [path.relative_to(folder) for path in files if path.suffix in (".csv", ".md")]
    assert tables
    for name in tables:
        assert (folder / name).read_text() == (tmp_path / "theirs" / name).read_text(), name


def test_evaluation_under_the_rules_of_an_experiment_gives_one_result(short, tmp_path):
    """Task, fields and seed come from the rules, in Python as on the command line."""
    found = evaluate("scripted", rules=ExperimentRules.of(short), episodes=2)
    rules = ["--rules", str(short), "--episodes", "2"]
    assert as_written(found) == of_command(tmp_path, "evaluate", "scripted", *rules)
    assert found.request.seed == 5
    assert found.to_json()["task_config"]["follow"]["size_mm"] == 12.0


def test_the_options_of_a_rig_make_one_configuration(monkeypatch):
    """Only the call is caught: what it then does is the function's."""
    from surgisoft.agents import session

    seen = {}

    def caught(policies, task, **fields):
        seen.update(fields)
        raise InputError("enough")

    monkeypatch.setattr(session, "evaluate", caught)
    options = "--on rig --robot-seed 3 --hidden creep:0.5 --no-cameras --observer-gain 0.2"
    assert run(["evaluate", "scripted", "--task", "track_circle", *options.split()]) == 2
    hidden = (("creep", 0.5),)
    assert seen["rig"].gains == RigConfig(cameras=False, observer_gain=0.2, adapts=False).gains
    assert (seen["rig"].seed, seen["rig"].hidden) == (3, hidden)
    assert run(["evaluate", "scripted", "--task", "track_circle", "--on", "rig"]) == 2
    assert seen["rig"] == RigConfig()


def test_an_import_gives_one_recording(tmp_path):
    raw, table = tmp_path / "raw", tmp_path / "map.toml"
    raw.mkdir()
    times = np.arange(40) / 20.0
    for take in (1, 2):
        rows = np.stack([times, *(take * np.sin(times + k) + k for k in range(5))], axis=1)
        with (raw / f"take{take}.csv").open("w", newline="") as stream:
            csv.writer(stream).writerows([["t", "u1", "u2", "x", "y", "z"], *rows.tolist()])
    table.write_text(
        '[time]\ncolumn = "t"\n[measured]\ncolumns = ["u1", "u2"]\nunit = "psi"\n'
        '[key_points]\npositions = [["x", "y", "z"]]\nunit = "cm"\n'
    )
    (mine,) = import_recordings(raw, table, "both")
    out = tmp_path / "both.parquet"
    assert run(["import", str(raw), "--map", str(table), "-o", str(out)]) == 0
    theirs = load_recording(out)
    for name in ("t_s", "run", "measured", "key_points_mm"):
        np.testing.assert_array_equal(getattr(mine.recording, name), getattr(theirs, name), name)
    assert (mine.recording.name, mine.recording.unit) == (theirs.name, theirs.unit)
    assert len(mine.recording.runs) == 2
    parts = import_recordings([raw / "take1.csv", raw / "take2.csv"], table)
    assert run(["import", str(raw), "--map", str(table), "-o", str(tmp_path / "each")]) == 0
    for part in parts:
        other = load_recording(tmp_path / "each" / f"{part.recording.name}.parquet")
        np.testing.assert_array_equal(part.recording.key_points_mm, other.key_points_mm)


def test_a_replay_gives_one_file(short, tmp_path):
    command = ["experiment", "run", str(short), "--no-replays", "-o", str(tmp_path / "r")]
    assert run(command) == 0
    (log,) = (tmp_path / "r").rglob("*.npz")
    mine = open_replay(log, save=tmp_path / "mine.rrd")
    assert run(["replay", str(log), "--save", str(tmp_path / "theirs.rrd")]) == 0
    assert mine.path == tmp_path / "mine.rrd"
    seen = entities(tmp_path / "mine.rrd")
    assert seen == entities(tmp_path / "theirs.rrd")
    for entity in sorted(seen):
        values = [values_of(tmp_path / f"{name}.rrd", entity) for name in ("mine", "theirs")]
        assert values[0] == values[1], entity


def test_every_command_is_compared_with_its_function():
    """A new command needs a row above, or a reason why it has no function of its own."""
    from surgisoft.cli import COMMANDS

    compared = {module for module, *_ in SAME_DEFAULTS}
    reasons = {
        "import_": "compared above: its options are arguments of the same names",
        "export": "it calls one function for a run and one for a model",
        "train": "tests/test_api.py compares two runs",
        "demo": "it has no option but the folder",
        "rig": "it lists, or prints the result of one check",
        "benchmark": "studies of the repository",
    }
    assert compared.isdisjoint(reasons)
    assert compared | set(reasons) == set(COMMANDS)


def test_every_option_of_run_reaches_its_argument(tmp_path, monkeypatch):
    """No value is a default, so that none can stand in for another."""
    asked = {}

    def noted(policy, rig, model, **given):
        asked.update(given, policy=policy, rig=rig, model=model)
        raise InputError("asked")

    monkeypatch.setattr("surgisoft.live.session.run", noted)
    line = ["run", "scripted", "-o", str(tmp_path / "r.parquet"), "--rig", "virtual:seed=3"]
    line += ["--model", "default", "--task", "track_square", "--minutes", "3", "--rate", "25"]
    line += ["--clock", "simulated", "--before", "a.parquet", "b.parquet", "--clean", "45"]
    line += ["--false-alarm", "7", "--stop-on-alarm", "--no-cameras", "--observer-gain", "0.4"]
    line += ["--any-model", "--seed", "5", "--force"]
    assert run(line) == 2
    expected = {
        "policy": "scripted",
        "rig": "virtual:seed=3",
        "model": Path("default"),
        "task": "track_square",
        "minutes": 3.0,
        "rate_hz": 25.0,
        "clock": "simulated",
        "before": [Path("a.parquet"), Path("b.parquet")],
        "reference_s": 45.0,
        "alarm": AlarmDesign(false_alarm_h=7.0),
        "stop_on_alarm": True,
        "cameras": False,
        "observer_gain": 0.4,
        "any_model": True,
        "seed": 5,
        "force": True,
        "output": tmp_path / "r.parquet",
    }
    assert {name: asked.get(name) for name in expected} == expected


def test_every_option_of_compare_reaches_its_argument(tmp_path, monkeypatch):
    recording = VirtualRig(0).record(make_protocol("holds", VirtualRig(0).limits, 60))[0]
    save_recording(recording, tmp_path / "r.csv")
    asked = {}

    def noted(models, recordings, **given):
        asked.update(given)
        raise InputError("asked")

    monkeypatch.setattr("surgisoft.diagnosis.compare.compare_all", noted)
    line = ["compare", "default", str(tmp_path / "r.csv"), "--test", "--model-error", "0.7"]
    assert run([*line, "--before", str(tmp_path / "r.csv"), "--paired", "never"]) == 2
    assert [asked[name] for name in ("test", "error_mm", "paired")] == [True, 0.7, "never"]
    assert len(asked["before"]) == 1
