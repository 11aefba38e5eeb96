"""The functions of the package and the commands give the same numbers."""

import json
import re
from pathlib import Path

import pytest

from surgisoft.cli import run
from surgisoft.diagnosis.amend import amend
from surgisoft.diagnosis.compare import compare
from surgisoft.diagnosis.design.next_experiment import next_experiment
from surgisoft.diagnosis.diagnose import diagnose
from surgisoft.diagnosis.improve import improve
from surgisoft.measurement.protocols import make_protocol
from surgisoft.measurement.recordings import save_recording
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.checkpoint import default_arm, load_model, save_model

DOCS = Path(__file__).resolve().parents[2] / "docs"


def python_snippets(page: str) -> list[str]:
    """The Python blocks of a page of the documentation."""
    return re.findall(r"^```python\n(.*?)^```", (DOCS / page).read_text(), re.S | re.M)


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """A model with its training residuals, a recording with creep, one on a turned bench."""
    folder = tmp_path_factory.mktemp("lab")
    save_model(default_arm(), folder / "arm")
    for name, roll_deg, hidden in (("bench", 0.0, [("creep", 1.0)]), ("turned", 90.0, [])):
        rig = VirtualRig(0, take=7, roll_deg=roll_deg, hidden=hidden)
        recording = rig.record(make_protocol("mixed", rig.limits, 1200, seed=2))[0]
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


def test_the_snippet_of_the_documentation_gives_what_the_command_prints(lab, monkeypatch, capsys):
    monkeypatch.chdir(lab)
    (snippet,) = (text for text in python_snippets("diagnosis.md") if "diagnose(" in text)
    names = {}
    exec(snippet, names)
    said = capsys.readouterr().out
    assert as_written(names["found"]) == of_command(lab, "diagnose", "arm", "bench.parquet")
    assert names["found"].verdict.sentence in said


def test_training_residuals_decide_in_python_too(lab):
    """A model without them is another question, and the ranking's numbers differ."""
    model = load_model(lab / "arm")
    assert model.training_residuals is not None
    with_them = diagnose(model, lab / "bench.parquet")
    model.training_residuals = None
    without = diagnose(model, lab / "bench.parquet")
    assert with_them.to_json()["statistics"] != without.to_json()["statistics"]


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
    for name in ("story/bodies.png", "story.rrd"):
        assert (lab / name).stat().st_size > 10_000


def test_the_next_experiment_asks_what_diagnose_asks(lab):
    """It distinguishes loads of any direction on a turned bench, as the diagnosis does."""
    arm, data = str(lab / "arm"), str(lab / "turned.parquet")
    found = next_experiment(arm, data, ["payload", "misalignment"], 6.0)
    more = ["--between", "payload", "misalignment", "--minutes", "6", "--force"]
    command = ["next-experiment", arm, data, *more, "-o", str(lab / "s.csv")]
    assert as_written(found) == of_command(lab, *command)
    assert any("35 degrees" in note for note in found.notes)


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
