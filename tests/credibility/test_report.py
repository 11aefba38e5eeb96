"""The report of a comparison and of an experiment, from CONTEXT.toml to its files."""

import dataclasses
import hashlib
import json
import re
from pathlib import Path

import pytest

import surgisoft
from surgisoft.cli import run
from surgisoft.credibility.assessment import Assessment, Comparator, PointError, criteria_of
from surgisoft.credibility.context import Risk, load_context
from surgisoft.credibility.of_experiment import assess_experiment
from surgisoft.credibility.software import TESTS, commit_of
from surgisoft.errors import InputError
from surgisoft.experiments.results import sum_up
from surgisoft.experiments.run import run_experiment
from surgisoft.experiments.session import start_experiment
from tests.experiments import tiny
from tests.few_effects import few_effects
from tests.report.browser import chromium, look

CONTEXT = """
question = "May <b>the tip</b> be sent there?"
use = "Planning on the virtual rig."
recordings = ["a.parquet"]

[risk]
influence = "low"
consequence = "medium"

[limits]
error_mm = 2.0
applicable = 0.5

[uncertainty]
input = [0.1]

[[sources]]
name = "a"
robot = "virtual rig, robot 0"
date = "2026-11-22"

[scenario]
states = ["a.parquet"]
"""


@pytest.fixture(scope="module", autouse=True)
def _few_effects():
    with few_effects("payload", "creep", "misalignment"):
        yield


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """Half a minute of the virtual rig, its context, and the report of the package's arm on it."""
    folder = tmp_path_factory.mktemp("bench")
    collect = ["collect", "mixed", "--points", "300", "--seed", "0"]
    assert run([*collect, "-o", str(folder / "a.parquet")]) == 0
    (folder / "context.toml").write_text(CONTEXT)
    command = ["compare", "default", str(folder / "a.parquet"), "--report", str(folder / "report")]
    assert run([*command, "--credibility", str(folder / "context.toml")]) == 0
    return folder


def test_the_report_has_what_both_standards_ask_for(bench):
    found = json.loads((bench / "report/credibility.json").read_text())
    assert found["question_of_interest"] == "May <b>the tip</b> be sent there?"
    assert found["model_risk"]["level"] == "medium"
    (comparator,) = found["comparators"]
    digest = hashlib.sha256((bench / "a.parquet").read_bytes()).hexdigest()
    assert (comparator["sha256"], comparator["robot"]) == (digest, "virtual rig, robot 0")
    assert [each["label"] for each in found["key_points"]] == ["k0", "k1", "k2", "k3", "k4", "body"]
    parts = found["validation_uncertainty"]["parts_mm"]
    whole = sum((value or 0.0) ** 2 for value in parts.values()) ** 0.5
    assert found["validation_uncertainty"]["expanded_mm"] == pytest.approx(1.959964 * whole)
    body = found["key_points"][-1]
    assert body["error_mm"] == pytest.approx(found["comparison"]["rmse_mm"])
    assert body["interval_mm"][1] == pytest.approx(body["error_mm"] + 1.959964 * whole)
    assert 0.0 < body["area_mm"] < body["error_mm"]  # no area is larger than the distance
    assert found["model_form"]["kind"] == found["test_retest"]["diagnoses"][0]["kind"]
    assert found["applicability"]["share"] == 1.0  # its own states
    assert found["passed"] is all(each["passed"] for each in found["criteria"])
    assert found["software"]["surgisoft"] == surgisoft.__version__
    assert found["software"].get("commit") == commit_of()
    assert found["software_tests"] == TESTS
    factors = {each["name"]: each for each in found["credibility_factors"]}
    assert len(factors) == 13
    assert not factors["numerical code verification"]["assessed"]  # the context names no episode
    domain = factors["relevance of the validation activities to the context of use"]
    assert domain["evidence"] == found["applicability"]["sentence"]
    assert f"U_val {body['uncertainty_mm']:.3g} mm" in factors["output comparison"]["evidence"]
    assert factors["test samples"]["evidence"] == "recordings: 1; robots: 1 stated"


def test_every_factor_names_a_section_of_the_report(bench):
    found = json.loads((bench / "report/credibility.json").read_text())
    titles = re.findall(r"<h2[^>]*>([^<]+)</h2>", (bench / "report/credibility.html").read_text())
    named = {each["section"] for each in found["credibility_factors"]} - {""}
    assert named <= set(titles)
    assert "Credibility factors" in titles


def test_the_page_says_it_and_escapes_what_the_user_wrote(bench, tmp_path):
    text = (bench / "report/credibility.html").read_text()
    assert "May &lt;b&gt;the tip&lt;/b&gt; be sent there?" in text
    assert "In a form usable for" in text
    assert "<code>make mutants</code>" in text
    assert (commit_of() or "The commit of the source code is not known.") in text
    assert not re.search(r"\bcompliant\b|\bcomplies\b", text)
    with chromium() as browser:
        page = bench / "report/credibility.html"
        assert look(browser, page, 390, "dark")[:3] == (0, [], 0)


def test_a_micrometre_on_a_limit_flips_the_result(tmp_path):
    """The upper end of E with its uncertainty counts, of the worst key point."""
    (tmp_path / "a.parquet").touch()
    (tmp_path / "context.toml").write_text(CONTEXT)
    context = load_context(tmp_path / "context.toml")
    points = (
        PointError("k0", 0.2, None, 0.1, 0.05),
        PointError("k1", 0.5, None, 0.25, 0.15),
        PointError("body", 0.4, None, 0.2, 0.1),
    )
    for limit, passed in ((0.751, True), (0.749, False)):
        limits = dataclasses.replace(context.limits, error_mm=limit, area_mm=None, applicable=None)
        (found,) = criteria_of(dataclasses.replace(context, limits=limits), points, None)
        assert found.passed is passed
        assert "k1" in found.name
    for limit, passed in ((0.151, True), (0.149, False)):
        limits = dataclasses.replace(context.limits, error_mm=None, area_mm=limit, applicable=None)
        (found,) = criteria_of(dataclasses.replace(context, limits=limits), points, None)
        assert found.passed is passed
    (_, share) = criteria_of(context, points, None)
    assert not share.passed  # no scenario was compared


def test_no_validation_is_claimed_on_recordings_of_the_fit(tmp_path):
    """Limits that the error is far below are not met where the model was fitted to comparators."""
    (tmp_path / "a.parquet").touch()
    (tmp_path / "context.toml").write_text(CONTEXT)
    context = load_context(tmp_path / "context.toml")
    limits = dataclasses.replace(
        context.limits, error_mm=9.0, tip_error_mm=9.0, area_mm=9.0, applicable=None
    )
    context = dataclasses.replace(context, limits=limits)
    points = (PointError("k0", 0.2, None, 0.1, 0.05), PointError("body", 0.4, None, 0.2, 0.1))
    assert [each.passed for each in criteria_of(context, points, None)] == [True] * 3
    criteria = criteria_of(context, points, None, fitted=True)
    assert [each.passed for each in criteria] == [False] * 3
    assert "on unseen data" in criteria[0].name
    about = dict.fromkeys(field.name for field in dataclasses.fields(Assessment))
    seen = Comparator("a", "", "", "", "", "continuous", 9, 1.0, (), 0.4)
    about |= {"points": points, "criteria": criteria, "comparators": (seen,)}
    found = Assessment(**about)
    assert found.sentence.startswith("no validation: the model was fitted to 40 % of a;")
    assert "the model's error lies between" not in found.sentence
    new = dataclasses.replace(found, comparators=(dataclasses.replace(seen, in_fit=0.0),))
    assert "the model's error lies between" in new.sentence


def test_an_experiment_gets_the_report_of_its_scenario(bench, tmp_path):
    two = '[[cases]]\nname = "simulation"\n[[cases]]\nname = "rig"\nplant = "rig"\n'
    text = tiny.TINY.replace("repeats = 3", "repeats = 1") + two
    spec, folder = start_experiment(tiny.write(tmp_path, text), tmp_path / "out")
    results = sum_up(spec, folder, run_experiment(spec, folder))
    context = load_context(bench / "context.toml")
    found = assess_experiment(context, results).to_json()
    labels = found["applicability"]["states"]
    assert "out/simulation-0000 laser" in labels
    assert "out/rig-0000 endoscope" in labels
    assert found["agreement"]["contact_differs"] == 0
    assert found["agreement"]["instants"] == 2 * 6  # the start and five steps of each
    rows = {each["name"]: each for each in found["scenario"]}
    assert rows["time [s]"]["error"] == 0.0
    assert rows["least clearance [mm]"]["area"] == abs(rows["least clearance [mm]"]["error"])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('influence = "low"', 'influence = "tiny"', "context.toml:7: risk.influence: got text"),
        ("error_mm = 2.0", "error_mm = 0.0", "limits.error_mm: got number 0.0; expected a number"),
        ("question", "qestion", "qestion: unknown field (did you mean 'question'?)"),
        ('states = ["a', 'states = ["b', "there is no 'b.parquet' beside this file"),
        ('states = ["a', 'states = ["\\u0000', "there is no '\\x00.parquet' beside this file"),
        ('states = ["a', 'states = ["' + 300 * "a", "there is no 'aaaa"),
        ("[scenario]", '[[sources]]\nname = "a"\n[scenario]', "a second 'a'; expected each"),
    ],
)
def test_a_wrong_context_is_one_line(tmp_path, old, new, message):
    (tmp_path / "a.parquet").touch()
    path = tmp_path / "context.toml"
    path.write_text(CONTEXT.replace(old, new, 1))
    with pytest.raises(InputError, match=re.escape(message)):
        load_context(path)


def test_what_is_missing_is_said_before_anything_is_computed(tmp_path, capsys):
    (tmp_path / "a.parquet").touch()
    assert run(["compare", "default", str(tmp_path / "a.parquet"), "--credibility", "c.toml"]) == 2
    assert "add --report DIR" in capsys.readouterr().err
    plain = tmp_path / "plain.toml"
    plain.write_text(CONTEXT.replace('recordings = ["a.parquet"]\n', ""))
    out = str(tmp_path / "out")
    command = ["experiment", "run", str(tiny.write(tmp_path)), "-o", out]
    assert run([*command, "--credibility", str(plain)]) == 2
    assert "names no recordings of the arm" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("influence", "consequence", "level"),
    [("low", "low", "low"), ("high", "low", "medium"), ("medium", "high", "high")],
)
def test_the_risk_grows_with_both(influence, consequence, level):
    assert Risk(influence, consequence).level == level
    assert Risk(consequence, influence).level == level


def test_the_examples_of_the_documentation_are_read(tmp_path):
    for path in sorted(Path("docs/examples/credibility").glob("*.toml")):
        text = path.read_text()
        for name in re.findall(r'"(\w+\.parquet)"', text):
            (tmp_path / name).touch()
        (tmp_path / path.name).write_text(text)
        assert load_context(tmp_path / path.name).limits.applicable == 0.95
