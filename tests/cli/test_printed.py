"""What commands print of a result, with the work behind them replaced by results by hand."""

import html
import re
import shlex
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from surgisoft.agents.rig_check import Differences, RigCheck
from surgisoft.agents.training import Result
from surgisoft.cli import run
from surgisoft.cli.diagnose import announced
from surgisoft.cli.fit import above_noise
from surgisoft.diagnosis.design.next_experiment import Experiment
from surgisoft.diagnosis.diagnose import Diagnosis, ErrorLevels, Ranked, Verdict
from surgisoft.diagnosis.error_axes import AxisShare
from surgisoft.diagnosis.residuals import ModelFit
from surgisoft.errors import InputError
from surgisoft.measurement.recordings import Recording, save_recording
from surgisoft.surrogate.checkpoint import load_model, save_model
from surgisoft.surrogate.model import Validation

NAN = float("nan")
INF = float("inf")


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A recording of a second, and a folder that is no model."""
    folder = tmp_path_factory.mktemp("bench")
    pressure = np.linspace(0.0, 5.0, 20)[:, None] * [1.0, 1.1, 1.2]
    points = np.arange(1.0, 16.0).reshape(5, 3) * (1.0 + 0.01 * pressure[:, :1, None])
    some = Recording("bench", 0.05 * np.arange(20), pressure, points)
    save_recording(some, folder / "bench.parquet")
    return folder


def result(**fields) -> SimpleNamespace:
    """A result with these fields, whose JSON is empty."""
    return SimpleNamespace(**({"to_json": dict, "notes": (), "interrupted": False} | fields))


def printed(capsys, monkeypatch, target: str, found, *command: str, code: int = 0) -> str:
    """What a command prints where the function behind it returns a result."""
    monkeypatch.setattr(target, lambda *_, **__: found)
    assert run(list(command)) == code
    return capsys.readouterr().out


AXES = (
    AxisShare("pressure", "actuation itself", "kPa", 0.5, (0.4, 0.6), True),
    AxisShare("speed", "", "kPa/s", 0.3, (0.2, 0.4), False),
    AxisShare("room", "", "", 0.01, (0.0, 0.02), True),
)


def comparison(name: str, **fields) -> SimpleNamespace:
    values = {
        "sentence": f"{name} is off", "setup": "", "rmse_mm": 0.5, "tip_rmse_mm": 0.75,
        "floor": SimpleNamespace(rmse_mm=0.05, source="holds"), "samples": 20, "missing": 0,
        "components_mm": {"x": 0.1, "y": 0.2}, "mse_mm2": 0.25, "per_key_point_mm": [0.25, NAN],
        "coverage": None, "time_shift": None, "axes": (), "change_axes": (), "worst": (),
        "explainable": None, "rmse_ci95_mm": (0.4, 0.6), "in_fit": 0.0, "rows_of_fit": "",
        "of_another_arm": False,
    }  # fmt: skip
    table = SimpleNamespace(model=SimpleNamespace(summary=lambda: "an arm"))
    numbers = result(**(values | fields))
    return SimpleNamespace(
        name=name, result=numbers, table=table, sentence=f"{name} is off", summary=f"arm {name}"
    )


def test_compare_prints_what_is_known_and_says_what_is_not(bench, capsys, monkeypatch):
    target, rec = "surgisoft.diagnosis.compare.compare_all", str(bench / "bench.parquet")
    moment = SimpleNamespace(error_mm=1.5, key_point=4, recording="bench", t_s=3.0, along_s=1.0)
    one = comparison(
        "default", tip_rmse_mm=NAN, floor=SimpleNamespace(rmse_mm=None, source="unknown"),
        missing=3, setup="chambers 1 and 2 are swapped", axes=AXES, change_axes=AXES,
        worst=(moment,),
        time_shift=SimpleNamespace(seconds=0.1, ci95_s=(0.05, 0.15)), explainable=0.5,
    )  # fmt: skip
    out = printed(capsys, monkeypatch, target, [one], "compare", "default", rec)
    assert "set-up: chambers 1 and 2 are swapped; `surgisoft diagnose` shows the correction" in out
    assert "RMSE 0.5000 mm, tip not measured, noise floor unknown, 20 samples, 3 rows" in out
    assert "key points base to tip: 0.2500 - mm" in out
    assert "the model states no prediction interval" in out
    assert "the arm trails the model by 0.100 s (0.050 .. 0.150)" in out
    assert re.search(r"pressure +explains +50 % \(40 .. 60\) alone", out)
    assert re.search(r"speed +explains +30 % \(20 .. 40\) beyond actuation", out)
    assert re.search(r"pressure +explains +50 % of the change", out)
    assert "room" not in out, "too small to be shown"
    assert "worst: 1.500 mm at key point k4, bench t = 3.00 s (1.00 s in the report)" in out
    assert f"next, which effect is missing: surgisoft diagnose default {rec}\n" in out
    two = [comparison("default", coverage=0.9), comparison("other", explainable=0.25)]
    out = printed(capsys, monkeypatch, target, two, "compare", "default", "default", rec)
    assert "90.0% of key points within the model's 95 % prediction interval" in out
    assert "\nother is off\narm other\n" in out
    assert re.search(r"other +0\.5000 +0\.4000 \.\. 0\.6000 +0\.7500 +25 %\n", out)
    assert re.search(r"default +0\.5000 .* -\n", out)
    assert "which effect is missing" not in out


@pytest.mark.parametrize(("errors", "named"), [((0.5, 0.1), "new"), ((0.1, 0.5), "default")])
def test_compare_advises_to_diagnose_the_closest_of_several_models(
    errors, named, bench, tmp_path, capsys, monkeypatch
):
    """A model that was amended leaves the old one behind: what it lacks is known by then."""
    rec, new = str(bench / "bench.parquet"), tmp_path / "new"
    save_model(load_model("default"), new)
    two = [
        comparison(name, rmse_mm=error, explainable=0.5)
        for name, error in zip(("default", "new"), errors, strict=True)
    ]
    target = "surgisoft.diagnosis.compare.compare_all"
    out = printed(capsys, monkeypatch, target, two, "compare", "default", str(new), rec)
    path = {"default": "default", "new": new}[named]
    assert out.endswith(f"from the model of the smallest error: surgisoft diagnose {path} {rec}\n")


def summary(mean: float, episodes: int = 9) -> SimpleNamespace:
    ends = {"least": mean - 1.0, "most": mean + 1.0, "episodes": episodes}
    return SimpleNamespace(mean=mean, low=mean - 0.1, high=mean + 0.1, **ends)


def test_evaluate_prints_a_column_for_each_policy(capsys, monkeypatch):
    facts = {
        "instants": 10, "contact_differs": 1, "beam_differs": 2, "beam_off_mm": 0.25,
        "contact_asked": 3, "beams_asked": 4,
    }  # fmt: skip
    scripted = SimpleNamespace(
        policy="scripted", overall={"success": summary(0.5), "error_mm": summary(0.25)},
        checks=object(), to_json=lambda: {"exact_checks": facts},
        per_episode={"error_mean_mm": np.full(6, 0.25)}, episodes=6,
    )  # fmt: skip
    learned = SimpleNamespace(
        policy="runs/ring", overall={"success": summary(NAN, 0)}, checks=None, to_json=dict,
        per_episode={"error_mean_mm": np.array([1.0, 1.5] * 3)}, episodes=6,
    )  # fmt: skip
    found = result(
        task="track_circle", results=[scripted, learned], success_rule="within 1 mm",
        measured_arms=("arm",), logs={}, request=SimpleNamespace(seed=4),
    )  # fmt: skip
    out = printed(
        capsys, monkeypatch, "surgisoft.agents.session.evaluate", found,
        "evaluate", "scripted", "--task", "track_circle", "--on", "rig", "--observer-gain", "0.5",
    )  # fmt: skip
    assert re.search(r"^ +scripted +ring\n", out, re.M)
    assert re.search(r"success +50\.0% \[40\.0%, 60\.0%\] +-\n", out)
    assert re.search(r"error_mm +0\.25 \[0\.15, 0\.35\] +-\n", out)
    # Student's interval of 0.75 and 1.25, three times each: 1 +- 2.5706 * sqrt(0.075 / 6)
    assert "ring minus scripted, episode by episode: error_mean_mm 1 [0.7126, 1.287]\n" in out
    assert "of 10 instants the batched geometry differs on contact in 1 and on what the" in out
    assert "success: within 1 mm\n" in out
    assert "arm: on a real bench, whose true body is not known" in out


def found_setup(**fields) -> SimpleNamespace:
    values = {
        "correctable": False, "recordings": ("bench",),
        "instructions": "turn the tracker\nby a quarter",
        "alternative_instructions": (), "how_to_tell": "", "of_model": "",
        "corrected": lambda some: some,
    }  # fmt: skip
    return SimpleNamespace(**(values | fields))


CHANGE = SimpleNamespace(sentence="moved by 0.9 mm", stretches=())


def diagnosis(**fields) -> SimpleNamespace:
    values = {
        "verdict": SimpleNamespace(kind="setup", sentence="the frame is turned"),
        "error_mm": ErrorLevels(0.5, 0.05, 0.1, discrepancy_alone=0.45), "track": None,
        "setup": None, "next_command": "", "next_experiment": None, "refit": None, "checks": (),
        "shown": (), "not_testable": (), "implausible": (), "seconds": 1.5, "in_fit": 0.0,
        "left_out": "held-out blocks", "change": None, "in_words": (), "since_fit": None,
    }  # fmt: skip
    found = result(**(values | fields))
    found.command = lambda *files: Diagnosis.command(found, *files)
    return found


def test_diagnose_prints_what_mends_a_set_up(bench, tmp_path, capsys, monkeypatch):
    target, rec = "surgisoft.diagnosis.diagnose.diagnose", str(bench / "bench.parquet")
    new = tmp_path / "corrected"
    both = found_setup(alternative_instructions=("swap two tubes",), how_to_tell="shake chamber 1")
    command = ["diagnose", "default", rec]
    found = diagnosis(setup=both)
    out = printed(capsys, monkeypatch, target, found, *command, "--apply", str(new))
    assert "to correct it:\n  turn the tracker\n  by a quarter\nor, for the other expl" in out
    assert "other explanation:\n  swap two tubes\nshake chamber 1\n1.5 s\n" in out
    assert f"{new} was not written: this fault cannot be corrected in the recordings" in out
    assert out.endswith("next: turn the tracker\n")
    assert not new.exists()
    found = diagnosis(setup=found_setup(correctable=True))
    out = printed(capsys, monkeypatch, target, found, *command)
    assert "to correct it (--apply does it), as lines of a map that reads the recording, n" in out
    assert out.endswith(f"next: surgisoft diagnose default {rec} --apply CORRECTED\n")
    either = diagnosis(setup=found_setup(correctable=True, of_model="the model returns m"))
    out = printed(capsys, monkeypatch, target, either, *command)
    assert out.splitlines()[-1].startswith("next, if the recordings are wrong: surgisoft diagnose")
    out = printed(capsys, monkeypatch, target, found, *command, "--apply", str(new))
    assert out.endswith(f"next: surgisoft diagnose default {new}\n")
    assert [path.name for path in new.glob("*.parquet")] == ["bench.parquet"]
    none = diagnosis(verdict=SimpleNamespace(kind="nothing_missing", sentence="fits"))
    out = printed(capsys, monkeypatch, target, none, *command, "--apply", str(tmp_path / "x"))
    assert out.endswith(f"nothing to correct: {tmp_path / 'x'} was not written\n")
    before = ["--before", rec, "--replay", str(tmp_path / "a.rrd")]
    monkeypatch.setattr(target, lambda *_, **__: none)
    assert run([*command, *before]) == 0
    assert "was not written: no rows of the same actuation before and" in capsys.readouterr().err
    assert not (tmp_path / "a.rrd").exists()


@pytest.mark.parametrize(("noise", "above"), [(None, True), (0.4, True), (0.6, False)])
def test_effects_are_advised_where_the_error_is_above_twice_the_noise(noise, above):
    assert above_noise(Validation(1.0, noise_mm=noise)) is above


def test_a_fit_with_the_network_is_announced_once(capsys):
    told = []
    report = announced(lambda done, total, note="": told.append((done, note)))
    report(1.0, 3.0, "a")
    report(2.0, 3.0)
    assert told == [(1.0, "a"), (2.0, "")]
    said = capsys.readouterr().err
    assert said.count("which takes minutes; --refit never skips it") == 1


def test_diagnose_prints_candidates_and_the_next_step(bench, capsys, monkeypatch):
    row = SimpleNamespace(
        effect="creep", ci95=(0.1, 0.2), confidence=0.9, gain_alone=0.5, gain_unique=0.25,
        heldout_rmse_mm=0.15,
    )  # fmt: skip
    tried = SimpleNamespace(
        effect="lag", ci95_mm=(0.01, 0.02), plausible=False, heldout_rmse_mm=0.3, rival_mm=0.4,
        difference_mm=0.1, p_value=0.01,
    )  # fmt: skip
    refit = SimpleNamespace(
        reason="a lag is close", candidates=[tried],
        not_tried=[("leak", "steady-state samples"), ("twist", "named already")],
    )  # fmt: skip
    plan = Experiment("ramps", 5.0, (("creep", "leak"),))
    found = diagnosis(
        verdict=SimpleNamespace(kind="ambiguous", sentence="creep or leak"), refit=refit,
        shown=[row], checks=("the clock is even",), next_experiment=plan,
        not_testable=[SimpleNamespace(effect="drift", reason="too short")],
        implausible=("payload", "twist"), in_words=(("creep", "half of it after 3 s"),),
        next_command="surgisoft next-experiment {model} {data}{before} -o NEW.csv", change=CHANGE,
    )  # fmt: skip
    rec = str(bench / "bench.parquet")
    target = "surgisoft.diagnosis.diagnose.diagnose"
    out = printed(
        capsys, monkeypatch, target, found, "diagnose", "default", rec, "--before", rec
    )  # fmt: skip
    assert "creep, first estimate: half of it after 3 s\n" in out
    assert "check: the clock is even\n" in out
    assert re.search(r"creep +0\.90 +50\.0% +25\.0% +0\.1500 \[0\.1000, 0\.2000\] mm", out)
    assert re.search(r"no effect +0\.4500 mm \(model discrepancy alone\)\n", out)
    assert "not testable: drift: too short" in out
    assert "not ranked, because of implausible parameters: payload, twist" in out
    assert "fitted together with the network, because a lag is close:" in out
    assert re.search(r"lag .*\[0\.0100, 0\.0200\] mm +0\.0100  implausible parameters\n", out)
    assert "not tried, because steady-state samples cannot show them: leak\n" in out
    assert "next experiment: ramps, 5 minutes, distinguishes creep from leak" in out
    assert out.endswith(
        f"next: surgisoft next-experiment default {rec} --before {rec} -o NEW.csv\n"
    )
    plain = SimpleNamespace(reason="x", candidates=[], not_tried=[("twist", "named already")])
    shown = printed(
        capsys, monkeypatch, target, diagnosis(refit=plain), "diagnose", "default", rec
    )  # fmt: skip
    assert "not tried" not in shown


@pytest.mark.parametrize("change", [None, CHANGE])
def test_the_page_of_a_diagnosis_has_the_command_that_is_printed(
    change, bench, tmp_path, capsys, monkeypatch
):
    """With the recordings from before, without which it would explain something else."""
    found = Diagnosis(
        Verdict("identified", ("payload",), "payload is missing", 0.9),
        ErrorLevels(0.5, 0.1, 0.05),
        (
            Ranked(
                "payload", 0.9, 0.5, 0.5, 0.1, (0.1, 0.2), 0.01, 1.0, {"sag_mm": 2.0}, "sag 2 mm"
            ),
        ),
        next_command="surgisoft amend {model} --effect payload --data {data}{before} -o NEW",
        change=change,
    )
    rec, page = str(bench / "bench.parquet"), tmp_path / "page"
    before = ["--before", rec] if change else []
    out = printed(
        capsys, monkeypatch, "surgisoft.diagnosis.diagnose.diagnose", found,
        "diagnose", "default", rec, *before, "--report", str(page),
    )  # fmt: skip
    command = f"surgisoft amend default --effect payload --data {rec}"
    command += f" --before {rec} -o NEW" if change else " -o NEW"
    assert out.endswith(f"next: {command}\n")
    words = re.sub(r"<[^>]*>", "", (page / "diagnosis.html").read_text())
    assert command in html.unescape(words)
    assert "payload: sag 2 mm." in words
    assert "payload, first estimate: sag 2 mm\n" in out
    end = " --before BEFORE -o NEW" if change else " -o NEW"
    assert found.command().endswith(f"--data RECORDINGS{end}")


PARAMETER = SimpleNamespace(
    effect="creep", name="tau", unit="s", interval_text="2 to 4", value=3.0, plausible=False,
    plausible_range=(5.0, 9.0), source="Smith 2001", before=None, may_be_plausible=False,
)  # fmt: skip
UNITLESS = SimpleNamespace(**(vars(PARAMETER) | {"unit": "", "interval_text": "", "name": "share"}))
HAD = SimpleNamespace(**(vars(PARAMETER) | {"before": 2.5, "may_be_plausible": True}))


def test_amend_and_improve_write_nothing_where_nothing_is_claimed(
    bench, tmp_path, capsys, monkeypatch
):
    rec, new, numbers = (str(p) for p in (bench / "bench.parquet", tmp_path / "n", tmp_path / "j"))
    rounds = [
        SimpleNamespace(step="creep", together=True, anew=False, competing=("leak",),
                        verdict="identified", sentence="creep is missing", error_training_mm=0.2),
        SimpleNamespace(step=None, together=False, anew=False, competing=(),
                        verdict="nothing_missing", sentence="it fits", error_training_mm=0.2),
    ]  # fmt: skip
    found = result(
        claimed=False, rounds=rounds, steps=[("creep", 0.3)], parameters=[PARAMETER, UNITLESS],
        held_out=SimpleNamespace(before=0.5, floor=0.1, in_fit=0.0), model_error=None,
        sentence="no significant fall", in_words={"creep": "half of it after 3 s", "leak": ""},
        diagnoses=(),
    )  # fmt: skip
    command = ["improve", "default", rec, "-o", new, "--json", numbers + ".json"]
    target = "surgisoft.diagnosis.improve.improve"
    out = printed(capsys, monkeypatch, target, found, *command, code=1)
    assert "  + creep, fitted together with the network (or leak): error on the training" in out
    assert "round 2: nothing_missing: it fits\n  no further effect: error" in out
    assert "  creep: tau = 3 s (2 to 4)\n  creep: share = 3\n" in out
    assert "\ncreep: half of it after 3 s\nimplausible: creep" in out
    assert "implausible: creep tau = 3, expected 5 to 9 s (Smith 2001)\n" in out
    assert re.search(r"before +0\.5000 mm on the held-out part\n\+ creep +0\.3000 mm\nfloor", out)
    assert out.endswith(f"no significant fall\n{new} was not written\n")
    assert not Path(new).exists()
    assert Path(numbers + ".json").read_text().strip() == "{}"
    found.steps, found.rounds = [], []
    out = printed(capsys, monkeypatch, target, found, *command[:-2], code=1)
    assert out == f"no significant fall\n{new} was not written\n"
    tried = result(
        claimed=False, effects=("creep",), refitted=("creep",), parameters=[HAD], retuned=True,
        refit=SimpleNamespace(sentence="creep lowers it"), sentence="no significant fall",
        in_words={},
    )  # fmt: skip
    out = printed(
        capsys, monkeypatch, "surgisoft.diagnosis.amend.amend", tried,
        "amend", "default", "--effect", "creep", "--data", rec, "-o", new, code=1,
    )  # fmt: skip
    assert "creep: the model had this effect already; its parameters were fitted again\n" in out
    assert "  creep: tau = 3 s (2 to 4), before 2.5 s\n" in out
    assert "(Smith 2001); the 95 % interval reaches plausible values\n" in out
    assert "which lowers the error of the quarters of the training part that were left o" in out
    assert "creep lowers it, with parts of the training data left out\n" in out
    assert f"{new} was not written; --anyway writes it nevertheless" in out
    assert not Path(new).exists()


def test_train_says_how_to_go_on(tmp_path, capsys, monkeypatch):
    def run_of(best, done=True, leads=True, updates=3):
        numbers = Result(done, 1500, 60.0, 50.0, best, updates)
        return SimpleNamespace(leads=leads, result=numbers, folder=Path("runs/x"))

    target = "surgisoft.agents.training_request.train"
    monkeypatch.setattr("surgisoft.agents.training_request.shortfall", lambda run: "")
    command = ["train", "--task", "track_circle"]
    assert printed(capsys, monkeypatch, target, run_of(None, leads=False), *command) == ""
    out = printed(capsys, monkeypatch, target, run_of(None, done=False), *command, code=130)
    assert out == "stopped after 1,500 steps; continue with: surgisoft train --resume runs/x\n"
    idle = run_of({"error_mm": 0.25}, updates=0)
    out = printed(capsys, monkeypatch, target, idle, "train", "--resume", "runs/x")
    assert "runs/x was finished before, and nothing was trained: 1,500 steps, best eval" in out
    assert "wrote" not in out
    for best, said in (
        (None, "best not evaluated yet"),
        ({"success": 0.5}, "best evaluation: success 50%\n"),
        ({"error_mm": NAN}, "best evaluation: error not measured\n"),
        ({"success": 1.0, "error_mm": 0.25}, "best evaluation: success 100%, error 0.2500 mm\n"),
    ):
        out = printed(capsys, monkeypatch, target, run_of(best), *command)
        assert f"(50 s of processor), {said}" in out
        assert "next: surgisoft evaluate runs/x\n" in out


RUN = ["run", "scripted", "-o", "new.parquet"]


def live(**fields) -> SimpleNamespace:
    values = {
        "timing": SimpleNamespace(sentence="on time"), "alarms": (), "tracking": (), "judged": 1.0,
        "tracking_mm": lambda a=0.0, b=1.0: 0.5, "rms_mm": lambda a=0.0, b=1.0: 0.25,
        "detector": SimpleNamespace(judges=True), "statistic": (0.5, NAN, 0.75), "written": (),
        "ended_by": None,
    }  # fmt: skip
    return result(**(values | fields))


@pytest.mark.parametrize(
    ("fields", "said", "not_said"),
    [
        ({}, "error of the model: 0.250 mm\nno alarm; highest alarm level 0.75 of 1\n", "task"),
        ({"tracking": (1,)}, "error of the task: 0.500 mm\n", "judged"),
        ({"tracking": (1,), "tracking_mm": lambda *_: NAN}, "on time", "error of the task"),
        ({"judged": 0.5}, "judged: 50% of the time after the reference; the rest is", "task"),
        ({"detector": None}, "no change detector: the run was shorter than its clean", "alarm"),
        ({"detector": SimpleNamespace(judges=False)},
         "no change detector: its clean reference does not repeat its motions", "alarm"),
        ({"statistic": ()}, "no alarm; highest alarm level 0.00 of 1\n", "task"),
        ({"alarms": (SimpleNamespace(since_s=4.0),), "written": ("a.csv", "b.csv"),
          "rms_mm": lambda a, b: {(-INF, 4.0): 0.25, (4.0, INF): 0.75}[a, b]},
         "error of the model: before the change 0.250 mm, after it 0.750 mm\n", "no alarm"),
    ],
)  # fmt: skip
def test_run_prints_errors_and_what_the_detector_judged(
    fields, said, not_said, capsys, monkeypatch
):
    out = printed(capsys, monkeypatch, "surgisoft.live.session.run", live(**fields), *RUN)
    assert said in out
    assert not_said not in out
    if "alarms" in fields:
        assert out.endswith("next: surgisoft diagnose default b.csv\n")


def test_a_run_that_was_ended_prints_its_result_first(capsys, monkeypatch):
    found = live(ended_by=InputError("the cable was cut"))
    monkeypatch.setattr("surgisoft.live.session.run", lambda *_, **__: found)
    assert run(RUN) == 2
    shown = capsys.readouterr()
    assert "on time" in shown.out
    assert shown.err.endswith("error: the cable was cut\n")


def test_demo_and_replay_print_where_things_are(tmp_path, capsys, monkeypatch):
    def demo(output, progress, on_step):
        for name in ("cut", "diagnose"):
            on_step(name, "done")
        return SimpleNamespace(page=output / "index.html", no_picture=no_picture)

    monkeypatch.setattr("surgisoft.demonstration.demo", demo)
    for no_picture in ("", "no browser"):
        assert run(["demo", "-o", str(tmp_path)]) == 0
        out = capsys.readouterr().out
        assert out.startswith(f"1. cut: done\n   see {tmp_path / 'index.html'}; each further step")
        assert "2. diagnose: done\n" in out
        assert out.count("   see ") == 1
        assert ("no picture of the replay: no browser\n" in out) == bool(no_picture)
    target = "surgisoft.replay.show.open_replay"
    out = printed(capsys, monkeypatch, target, "wrote a.rrd", "replay", "a.npz")
    assert out == "wrote a.rrd\n"
    shot = ["replay", "a.npz", "--screenshot", str(tmp_path / "a.png")]
    assert printed(capsys, monkeypatch, target, None, *shot) == f"wrote {tmp_path / 'a.png'}\n"
    assert printed(capsys, monkeypatch, target, None, "replay", "a.npz") == ""


def test_a_scene_is_shown_where_it_is_asked_for(tmp_path, capsys, monkeypatch):
    shown = []
    for name in ("open_viewer", "serve_viewer", "take_screenshot"):
        target = f"surgisoft.replay.viewer.{name}"
        monkeypatch.setattr(target, lambda *given, name=name: shown.append((name, given[1:])))
    monkeypatch.setattr("surgisoft.replay.scene_view.save_scene_view", lambda *_: None)
    monkeypatch.setattr("surgisoft.tasks.world.reach.reaches_of", lambda scene: {})
    command = ["scene", "show", "phantom_liver"]
    assert run(command) == 0
    assert run([*command, "--web", "--port", "9099"]) == 0
    assert run([*command, "--screenshot", str(tmp_path / "a.png")]) == 0
    assert capsys.readouterr().out == f"wrote {tmp_path / 'a.png'}\n"
    names = [name for name, _ in shown]
    assert names == ["open_viewer", "serve_viewer", "take_screenshot"]
    assert shown[1][1][-1] == 9099
    assert shown[2][1][:2] == (tmp_path / "a.png", "Scene")
    assert run([*command, "--port", "9099"]) == 2
    assert "--port applies to a browser only: give --web too" in capsys.readouterr().err
    monkeypatch.setattr("surgisoft.tasks.world.reach.reaches_of", lambda _: pytest.fail("worked"))
    assert run([*command, "--screenshot", str(tmp_path / "a.jpg")]) == 2
    assert "suffix '.jpg', expected .png" in capsys.readouterr().err


REFUSED = {
    "compare default {rec} --error-scale 1": "--error-scale scales the colours of a replay; add",
    "compare default default": "default: models only; expected recordings",
    "compare lab default {rec} --predictions {rec}": "--predictions is for one model; leave",
    "compare default {rec} default": "default: a model after a recording; give all models first",
    "compare default {rec} --paired maybe": "unknown value of --paired 'maybe'",
    "compare default {rec} --paired always": "nothing to pair with; add --before REC",
    "compare default {rec} --replay {dir}/a.txt": "suffix '.txt', expected .rrd",
    "compare default {rec} --replay {dir}/folder.rrd": "is a folder, expected a file to write",
    "evaluate scripted --on moon": "unknown place 'moon'",
    "evaluate scripted --on simulation --rig virtual": "--rig names the plant, but --on is",
    "evaluate scripted --task track_circle --preflight": "--preflight is for real rigs; name one",
    "evaluate scripted --rules liver --task keyhole": "is an experiment of circle_ablation, not of",
    "evaluate scripted --rules liver --config a.toml": "--config and --rules both set the task",
    "next-experiment default -o {dir}/a.txt": "suffix '.txt', expected .csv, which `collect` can",
    "next-experiment default -o {dir}/a.csv --record {dir}/a.csv": "is given for the schedule (-o)",
    "next-experiment default -o {dir}/full.csv": "full.csv: exists already; choose another name",
    "collect walk --preflight -o {dir}/a.csv": "expected the model of this arm too; add --arm",
    "collect walk --arm default -o {dir}/a.csv": "--arm names the model of the pre-flight check",
    "collect walk --preflight --arm default --dry-run -o {dir}/a.csv": "--dry-run sends nothing",
    "collect walk --dry-run -o {dir}/a.csv": "a dry run is for real rigs, and this one is sim",
    "collect walk --hidden creep:2 --strength 1 -o {dir}/a.csv": "both give amplitudes; use one",
    "collect walk --hidden creep leak --strength 1 -o {dir}/a.csv": "2 --hidden and 1 --strength",
    "import {dir}/full.csv": "-o is missing: a new recording (.csv, .parquet) or a folder",
    "import {dir}/full.csv -o {dir}/a.csv": "--map is missing: a map file states columns",
    "import {dir}/full.csv -o {dir}/a.xlsx": "suffix '.xlsx', expected .csv, .parquet or a folder",
    "import {rec} {rec} --draft {dir}/m.toml": "files of one name, which a map cannot tell apart",
    "import {dir} --draft {dir}/m.toml": "folder, expected one file of it, such as {dir}/a.stl",
    "import {dir}/folder.rrd --draft {dir}/m.toml": "is a folder, expected one file of it",
    "import {dir}/full.csv --draft {dir}/m.txt": "suffix '.txt', expected .toml",
    "import {dir}/full.csv --draft {dir}/old.toml": "old.toml: exists already; choose another",
    "fit {rec} --network kernel --widths 8,8 -o {dir}/m": "kernel has no setting --widths",
    "diagnose default {rec} --apply {dir}/a --no-setup-tests": "leave --no-setup-tests out",
    "run mixed -o {dir}/a.csv --observer-gain 0.2": "a schedule observes nothing: leave --no-cam",
    "run mixed -o {dir}/a.csv --no-cameras": "a schedule observes nothing: leave --no-cameras and",
    "scene show phantom_liver --web --save {dir}/a.rrd": "at most one of --web, --screenshot and",
    "run scripted -o {dir}/a.csv --show --web": "--show and --web: expected at most one of them",
    "improve default {rec} -o default": "is the folder of the model to amend; choose another",
    "scene new a.stl -o {dir}/s --clearance 200": "--clearance is 200; expected 0 to 100 mm",
    "scene new a.stl -o {dir}/s --margin -1": "--margin is -1; expected 0 to 100 mm",
    "scene new a.stl -o {dir}/s --diameter 0.1": "--diameter is 0.1; expected 0.5 to 500 mm",
    "scene new a.stl -o {dir}/s --lesion 0 0 nan": "expected finite coordinates",
    "scene new a.stl -o {dir}/s --lesion-direction 0 0 0": "expected a vector that is not zero",
    "train task=keyhole --task keyhole": "task=keyhole and --task: give one of them",
    "train steps=many": "steps=many: expected an integer",
}


@pytest.mark.parametrize("command", REFUSED)
def test_what_cannot_be_meant_is_one_line(command, bench, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "folder.rrd").mkdir()
    for name in ("full.csv", "old.toml", "a.stl"):
        (tmp_path / name).write_text("x")
    before = sorted(tmp_path.rglob("*"))
    assert run(command.format(rec=bench / "bench.parquet", dir=tmp_path).split()) == 2
    error = capsys.readouterr().err.strip()
    assert REFUSED[command].replace("{dir}", str(tmp_path)) in error
    assert len(error.splitlines()) == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_a_missing_library_is_named_with_its_extra(capsys, monkeypatch):
    def missing(name):
        def raised(*_, **__):
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)

        monkeypatch.setattr("surgisoft.replay.show.open_replay", raised)

    missing("rerun_cli")
    assert run(["replay", "a.npz"]) == 2
    said = capsys.readouterr().err
    assert "'rerun_cli' is missing; install it with: pip install 'surgisoft[replay]'" in said
    missing("a_module_of_the_user")
    assert run(["replay", "a.npz"]) == 2
    said = capsys.readouterr().err
    assert "raised ModuleNotFoundError in test_printed.py line " in said
    assert "No module named 'a_module_of_the_user'; correct the code" in said


def test_a_command_that_a_signal_ended_has_its_exit_code(capsys, monkeypatch):
    from surgisoft.errors import Terminated

    def ended(code):
        def raised(*_, **__):
            raise code

        monkeypatch.setattr("surgisoft.replay.show.open_replay", raised)

    ended(Terminated(15))
    assert run(["replay", "a.npz"]) == 143
    assert capsys.readouterr().err == "surgisoft: ended by SIGTERM\n"
    ended(SystemExit(3))
    with pytest.raises(SystemExit):
        run(["replay", "a.npz"])


def test_a_group_without_a_command_prints_its_help(capsys):
    assert run(["scene"]) == 2
    shown = capsys.readouterr()
    assert "Usage: surgisoft scene" in shown.out
    assert shown.err == ""


def test_what_is_claimed_is_written_with_its_page(bench, tmp_path, capsys, monkeypatch):
    saved, save = [], "surgisoft.surrogate.checkpoint.save_model"
    monkeypatch.setattr(save, lambda made, new, *_: saved.append(str(new)))
    for module in ("surgisoft.cli.amend", "surgisoft.cli.improve"):
        view = f"{module}.write_before_and_after"
        monkeypatch.setattr(view, lambda made, tables, name, file: file)
    monkeypatch.setattr("surgisoft.diagnosis.compare.tables_of", lambda *_: {})
    pages = "surgisoft.diagnosis.pages.amendment"
    monkeypatch.setattr(f"{pages}.amend_page", lambda made, title, about: title)
    monkeypatch.setattr("surgisoft.report.write_page", lambda page, file: f"{file}: {page}")
    monkeypatch.setattr(
        f"{pages}.write_improve_report",
        lambda made, tables, folder, title, command: [f"{folder}: {title}: {command}"],
    )
    rec, new, page = str(bench / "bench.parquet"), str(tmp_path / "new"), str(tmp_path / "page")
    numbers, replay = str(tmp_path / "n.json"), str(tmp_path / "r.rrd")
    options = ["-o", new, "--json", numbers, "--report", page, "--replay", replay]
    found = result(
        claimed=True, rounds=[], steps=[], parameters=[], effects=("creep",), refitted=(),
        in_words={}, retuned=False, refit=None, sentence="the error falls",
        diagnoses=[
            SimpleNamespace(
                next_command="next", command=lambda *names: f"diagnose {' '.join(names).strip()}"
            )
        ],
        model=SimpleNamespace(summary=lambda: "an arm", fitted_rows=None),
    )  # fmt: skip
    out = printed(
        capsys, monkeypatch, "surgisoft.diagnosis.improve.improve", found,
        "improve", "default", rec, *options,
    )  # fmt: skip
    assert f"What default lacks on bench: diagnose {new} {rec}\n" in out
    assert "the error falls\n" in out
    assert f"wrote {new}: an arm\nnext, both models on an unseen recording: surg" in out
    assert saved == [new]
    Path(numbers).unlink()
    out = printed(
        capsys, monkeypatch, "surgisoft.diagnosis.amend.amend", found,
        "amend", "default", "--effect", "creep", "--data", rec, *options, "--force",
    )  # fmt: skip
    assert saved == [new, new]
    assert Path(numbers).read_text().strip() == "{}"
    assert f"{Path(page) / 'report.html'}: default with creep\n" in out
    assert out.endswith(f"next, find further effects: surgisoft diagnose {new} {rec}\n")
    again = ["amend", "default", "--effect", "creep", "--data", rec, "-o", new, "--force"]
    target, after = (
        "surgisoft.diagnosis.amend.amend",
        f"surgisoft improve default {rec} --before {rec}",
    )
    out = printed(capsys, monkeypatch, target, found, *again, "--before", rec)
    assert out.endswith(f"{after} -o OTHER\n")
    out = printed(capsys, monkeypatch, target, found, *again, "--before", rec, "--paired", "never")
    assert out.endswith(f"{after} --paired never -o OTHER\n")


def test_an_import_names_what_looks_wrong(bench, tmp_path, capsys, monkeypatch):
    from surgisoft.measurement.recordings import load_recording

    some = load_recording(bench / "bench.parquet")
    parts = [SimpleNamespace(recording=some, notes=("the clock was set",), files=(), warnings=())]
    monkeypatch.setattr("surgisoft.measurement.importing.import_recordings", lambda *_: parts)
    wrong = SimpleNamespace(sample=4, text="a jump of 30 mm")
    monkeypatch.setattr("surgisoft.measurement.recordings.find_warnings", lambda rec: [wrong])
    faults = "surgisoft.diagnosis.setup.find_setup_faults"
    monkeypatch.setattr(faults, lambda *_: None)
    fit = "surgisoft.diagnosis.residuals.fit_of_model"
    monkeypatch.setattr(fit, lambda *_: ModelFit(0.4, 0.42, 10.0))
    new = str(tmp_path / "new.parquet")
    command = ["import", "raw.csv", "--map", "m.toml", "-o", new, "--dry-run"]
    assert run([*command, "--model", "default"]) == 0
    shown = capsys.readouterr()
    assert "note: the clock was set\n" in shown.out
    assert f"would write {new}: " in shown.out
    assert shown.out.endswith(
        "set-up faults: none found by comparison with default (error 0.4 mm, expected about "
        "0.42 mm)\n"
    )
    assert f"{new}, row 5: a jump of 30 mm" in shown.err
    monkeypatch.setattr(fit, lambda *_: ModelFit(54.0, 0.42, 10.0))
    assert run([*command, "--model", "default"]) == 0
    shown = capsys.readouterr()
    assert "none found by comparison" not in shown.out
    assert "default does not describe this arm's motion of 10 mm (error 54 mm, " in shown.err
    assert "no fault that is tested explains it: check that MODEL is of this arm" in shown.err
    small = SimpleNamespace(sentence="the frame of the key points is turned by 3.0 deg about z")
    monkeypatch.setattr("surgisoft.diagnosis.setup.find_small_frame", lambda *_: (small, 0.6))
    assert run([*command, "--model", "default"]) == 0
    shown = capsys.readouterr()
    assert "turned by 3.0 deg about z (error 54 mm as recorded, about 0.6 mm in that" in shown.err
    assert f"which one: surgisoft diagnose default {new}\n" in shown.err
    assert "does not describe" not in shown.err
    monkeypatch.setattr(
        faults, lambda *_: found_setup(sentence="turned by 90 degrees", recordings=("bench",))
    )
    assert run([*command, "--model", "default"]) == 0
    assert "set-up: turned by 90 degrees" in capsys.readouterr().err
    parts.append(parts[0])
    assert run(command) == 2
    assert "new.parquet: 2 recordings, expected a folder for them" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_an_experiment_that_takes_something_away_is_told_by_hand(
    bench, tmp_path, capsys, monkeypatch
):
    pair = SimpleNamespace(effects=("creep", "payload"), before=0.5, after=0.9)
    model, rec, new = "default", str(bench / "bench.parquet"), str(tmp_path / "new.csv")
    target = "surgisoft.diagnosis.design.next_experiment.next_experiment"
    monkeypatch.setattr("surgisoft.diagnosis.design.schedules.schedule_text", lambda plan: "x")
    commands = SimpleNamespace(commands=np.zeros((2, 3)), unit="kPa", run_rows=[2])
    fields = {
        "name": "walk", "minutes": 5.0, "why": "it tells them apart", "steps": ["unmount it"],
        "chances_in_words": "a chance counts the noise",
        "protocol": commands, "options": "--payload 5", "removes": ("payload",), "pairs": [pair],
        "separates": [], "open": (), "paired": False,
    }  # fmt: skip
    monkeypatch.setattr("surgisoft.cli.next_experiment.warn_all", lambda notes: None)
    for by_hand, said in (
        (
            True,
            "  --as-it-stands proposes an experiment without a change of the bench\n",
        ),
        (False, f"  on the virtual rig: surgisoft collect {new} --payload 5 -o NEW.parquet\n"),
    ):
        plan = result(**(fields | {"by_hand": by_hand}))
        out = printed(
            capsys, monkeypatch, target, plan, "next-experiment", model, rec, "-o", new
        )  # fmt: skip
        Path(new).unlink()
        assert said in out
        assert "the virtual rig has no option" not in out, "no rig is in use"
        linear = f"  on a bench of your own: play {new} run by run, the actuation linear in time "
        assert f"{linear}between its rows\n" in out
        rig = ["--rig", "virtual:seed=3"]
        known = printed(
            capsys, monkeypatch, target, plan, "next-experiment", model, rec, "-o", new, *rig
        )  # fmt: skip
        Path(new).unlink()
        assert ("the virtual rig has no option for that change\n" in known) is by_hand
        assert "bench of your own" not in known
        assert (f" {rec} NEW.parquet" in out) is not by_hand
        assert ("--without payload" in out) is by_hand
        assert "creep or payload: expected chance of the right one 0.50 -> 0.90" in out
        assert "\na chance counts the noise\n" in out
        command = ["next-experiment", "lab", rec, "--predictions", "old.csv", "-o", new]
        out = printed(capsys, monkeypatch, target, plan, *command)
        Path(new).unlink()
        old = "" if by_hand else " old.csv"
        assert f" --predictions{old} PREDICTIONS_OF_NEW.csv\n" in out


def test_no_mounts_are_one_line_with_what_was_repaired(tmp_path, capsys, monkeypatch):
    from surgisoft.scene.author import NoMounts

    def none(*_):
        raise NoMounts("the laser reaches 40 % of the ring", ("organ.stl: unit mm",))

    monkeypatch.setattr("surgisoft.tasks.world.authoring.author", none)
    organ = tmp_path / "organ.stl"
    organ.touch()
    new = tmp_path / "scene"
    command = ["scene", "new", str(organ), "--lesion", "0", "0", "0", "-o", str(new)]
    assert run(command) == 1
    out = capsys.readouterr().out
    assert out.endswith(
        "organ.stl: unit mm\nNo scene was written: the laser reaches 40 % of the ring.\n"
    )
    assert not new.exists()


def test_an_export_without_a_controller_says_why(tmp_path, capsys, monkeypatch):
    run_of = SimpleNamespace(task=lambda: None)
    monkeypatch.setattr(
        "surgisoft.agents.learned.LearnedPolicy", lambda *_, **__: SimpleNamespace(run=run_of)
    )
    (tmp_path / "policy.json").write_text('{"note": "it sees images"}')
    out = printed(
        capsys, monkeypatch, "surgisoft.agents.export.export", [tmp_path / "policy.onnx"],
        "export", "runs/x", "-o", str(tmp_path),
    )  # fmt: skip
    assert "controller: not exported, only the policies: it sees images\n" in out
    assert out.endswith(f"wrote {tmp_path / 'policy.onnx'}\n")
    assert run(["export", "runs/x", "-o", str(tmp_path), "--check"]) == 1, "what was asked for"
    assert "not exported" in capsys.readouterr().out


def test_the_check_of_an_export_says_what_was_compared_and_keeps_no_wrong_file(
    tmp_path, capsys, monkeypatch
):
    run_of = SimpleNamespace(task=lambda: None)
    monkeypatch.setattr(
        "surgisoft.agents.learned.LearnedPolicy", lambda *_, **__: SimpleNamespace(run=run_of)
    )

    def exported(policy, output, task, force, check):
        check(None)
        (tmp_path / "controller.py").touch()
        return [tmp_path / "policy.onnx"]

    monkeypatch.setattr("surgisoft.agents.export.export", exported)
    right, far = Differences(1.5e-5, 0.00013), Differences(0.35, 1.1)
    for check, code, told in (
        (RigCheck(right, Differences(3e-5, 9e-5), 30), 0, "does in the loop what the policy does"),
        (RigCheck(right, far, 456, right), 0, "because the robot amplifies rounding"),
        (RigCheck(right, far, 456, far), 1, "given the measurements of its own closed loop, "),
        (RigCheck(far, far, 456), 1, "given the measurements of the policy's episode, "),
    ):
        (tmp_path / "controller.py").unlink(missing_ok=True)
        monkeypatch.setattr("surgisoft.agents.rig_check.check_on_rig", lambda *_, it=check: it)
        assert run(["export", "runs/x", "-o", str(tmp_path), "--check"]) == code
        *numbers, verdict, last = capsys.readouterr().out.splitlines()
        assert numbers[1].startswith(
            f"same measurements: commands {check.same.commands_kPa:.2g} kPa, estimated key points "
        )
        assert numbers[2] == (
            f"closed loop: commands {check.closed.commands_kPa:.2g} kPa, true key points "
            f"{check.closed.points_mm:.2g} mm"
        )
        if check.own is not None:
            assert numbers[3].endswith(
                f"closed loop: commands {check.own.commands_kPa:.2g} kPa, estimated key points "
                f"{check.own.points_mm:.2g} mm"
            )
        assert verdict.startswith("failed: " if code else "passed: ")
        assert told in verdict
        wrote = f"wrote {tmp_path / 'policy.onnx'}"
        assert last.startswith(f"no file was written to {tmp_path}; without" if code else wrote)
        assert (tmp_path / "controller.py").exists() == (code == 0)


def test_an_interrupted_recording_says_where_its_log_is(tmp_path, capsys, monkeypatch):
    new = tmp_path / "new.parquet"

    def interrupted(*_, log=None, **__):
        log.write_text("half")
        raise KeyboardInterrupt

    monkeypatch.setattr("surgisoft.rig.trial.collect", interrupted)
    rig = "tests.rig.own_rig:OwnRig:port=x"
    assert run(["collect", "walk", "--rig", rig, "-o", str(new)]) == 130
    error = capsys.readouterr().err
    (log,) = tmp_path.iterdir()
    assert f"what was measured so far is in {log}, which every command opens as a" in error


@pytest.mark.parametrize("rig", ["virtual", "tests.rig.own_rig:OwnRig:port=x"])
def test_an_older_log_is_not_what_was_measured(tmp_path, capsys, rig):
    """The protocol is refused before anything is written to the log, which stays as it was."""
    log = tmp_path / "new.log.jsonl"
    log.write_text("older")
    plan = tmp_path / "plan.csv"
    plan.write_text("t_s,c1_kPa\n0,0\n1,1\n")
    new = str(tmp_path / "new.parquet")
    assert run(["collect", str(plan), "--rig", rig, "-o", new, "--force"]) == 2
    error = capsys.readouterr().err
    assert "commands 1 chambers, the rig has 3" in error
    assert "measured so far" not in error
    assert log.read_text() == "older"


@pytest.mark.parametrize(
    ("words", "incomplete", "expected"),
    [
        ([], "task=track_c", ["task=track_circle"]),
        (["task=track_circle"], "follow.weights.f", ["follow.weights.fine="]),
        (["task=nowhere"], "minu", ["minutes="]),
        (["--task", "track_circle"], "follow.loop_", ["follow.loop_s="]),
    ],
)
def test_fields_are_completed_for_the_task_that_is_named(
    words, incomplete, expected, capsys, monkeypatch
):
    line = ["surgisoft", "train", *words]
    monkeypatch.setenv("_SURGISOFT_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", " ".join([*line, incomplete]))
    monkeypatch.setenv("COMP_CWORD", str(len(line)))
    with pytest.raises(SystemExit) as ended:
        run([])
    assert ended.value.code == 0
    assert capsys.readouterr().out.split() == expected


def words_of(line: str) -> list[str]:
    """The words of the command at the end of a line, as a shell reads them."""
    return shlex.split(line[line.index("surgisoft ") :])


@pytest.fixture
def spaced(bench, tmp_path):
    """A recording in a folder whose name holds a space."""
    (tmp_path / "my bench").mkdir()
    return str(shutil.copy(bench / "bench.parquet", tmp_path / "my bench" / "a b.parquet"))


def fitted(monkeypatch, noise_mm: float | None = 0.1) -> None:
    """A fit whose model is far above the noise of the cameras, and is not written."""
    found = SimpleNamespace(
        model=SimpleNamespace(summary=lambda: "an arm", validation=Validation(1.0, noise_mm)),
        report=dict, lines=lambda: (), interrupted=None,
    )  # fmt: skip
    monkeypatch.setattr("surgisoft.measurement.fitting.fit", lambda *_, **__: found)
    monkeypatch.setattr("surgisoft.surrogate.checkpoint.save_model", lambda *_: None)


def test_after_a_fit_the_advice_keeps_the_validation_recordings(spaced, capsys, monkeypatch):
    fitted(monkeypatch)
    new = str(Path(spaced).with_name("new arm"))
    assert run(["fit", spaced, "--valid", spaced, spaced, "-o", new]) == 0
    memory, error = capsys.readouterr().out.splitlines()[-2:]
    assert words_of(memory) == [
        "surgisoft", "fit", spaced, "--valid", spaced, "--effects", "auto", "-o",
        f"{new}_with_effects",
    ]  # fmt: skip
    assert words_of(error)[:4] == ["surgisoft", "compare", new, "TEST.parquet"]
    assert run(["fit", spaced, "-o", new]) == 0
    assert "--valid" not in capsys.readouterr().out


def test_after_a_fit_the_advice_keeps_the_settings_of_the_fit(spaced, capsys, monkeypatch):
    fitted(monkeypatch)
    new = str(Path(spaced).with_name("new arm"))
    given = [
        "--inputs", "pressure", "--prior", "none", "--members", "2", "--widths", "8,8",
        "--actuation", "commanded", "--epochs", "20", "--seed", "3", "--threads", "2",
    ]  # fmt: skip
    assert run(["fit", spaced, *given, "-o", new]) == 0
    memory, _ = capsys.readouterr().out.splitlines()[-2:]
    advised = ["--effects", "auto", "-o", f"{new}_with_effects"]
    assert words_of(memory) == ["surgisoft", "fit", spaced, *given, *advised]
    assert run(["fit", spaced, "-o", new]) == 0
    memory, _ = capsys.readouterr().out.splitlines()[-2:]
    assert words_of(memory) == ["surgisoft", "fit", spaced, *advised]


def test_after_an_amendment_the_advice_keeps_what_is_known_of_the_model(
    spaced, capsys, monkeypatch
):
    monkeypatch.setattr("surgisoft.surrogate.checkpoint.save_model", lambda *_: None)
    found = SimpleNamespace(
        model=SimpleNamespace(summary=lambda: "an arm"), notes=(), claimed=True, refitted=(),
        effects=("creep",), parameters=(), in_words={}, retuned=False, refit=None,
        sentence="less", to_json=dict,
    )  # fmt: skip
    monkeypatch.setattr("surgisoft.diagnosis.amend.amend", lambda *_, **__: found)
    new = str(Path(spaced).with_name("new arm"))
    given = ["--model-error", "0.5", "--refit", "never"]

    def last(*more: str) -> list[str]:
        command = [
            "amend",
            "default",
            "--data",
            spaced,
            "--effect",
            "creep",
            *more,
            *given,
            "-o",
            new,
        ]
        assert run(command) == 0
        return words_of(capsys.readouterr().out.splitlines()[-1])

    assert last() == ["surgisoft", "diagnose", new, spaced, *given[2:]]
    assert last("--before", spaced) == [
        "surgisoft", "improve", "default", spaced, "--before", spaced, *given, "-o", "OTHER",
    ]  # fmt: skip


def test_each_policy_has_a_replay_of_its_own(tmp_path, capsys, monkeypatch):
    """Two runs of one name in two folders, too; one policy alone has the file that was named."""
    asked: list[tuple] = []

    def evaluated(policies, *_, log, **__):
        asked.append(log)
        return SimpleNamespace(
            request=SimpleNamespace(seed=0), interrupted="", task="track_circle", results=(),
            logs={name: f"log of {name}" for name in log}, success_rule="", measured_arms=(),
        )  # fmt: skip

    made: dict[str, str] = {}
    monkeypatch.setattr("surgisoft.agents.session.evaluate", evaluated)
    monkeypatch.setattr(
        "surgisoft.replay.episode_view.write_replay",
        lambda log, path, report: made.update({path.name: log}) or path,
    )
    file = str(tmp_path / "r.v2.rrd")
    names = ["scripted", "a/run", "b/run"]
    assert run(["evaluate", *names, "--task", "track_circle", "--replay", file]) == 0
    assert asked == [names]
    assert made == {
        "r.v2-scripted.rrd": "log of scripted",
        "r.v2-a-run.rrd": "log of a/run",
        "r.v2-b-run.rrd": "log of b/run",
    }
    assert f"wrote {tmp_path / 'r.v2-b-run.rrd'}" in capsys.readouterr().out
    for one in (["scripted"], ["scripted", "scripted"]):
        made.clear()
        assert run(["evaluate", *one, "--task", "track_circle", "--replay", file]) == 0
        assert made == {"r.v2.rrd": "log of scripted"}


def test_a_file_given_twice_is_in_the_next_command_once(bench, capsys, monkeypatch):
    rec = str(bench / "bench.parquet")
    again = str(bench / ".." / bench.name / "bench.parquet")
    found = diagnosis(next_command="surgisoft compare {model} {data}{before}", change=CHANGE)
    command = ["diagnose", "default", rec, again, "--before", again, rec]
    out = printed(capsys, monkeypatch, "surgisoft.diagnosis.diagnose.diagnose", found, *command)
    assert out.endswith(f"next: surgisoft compare default {rec} --before {again}\n")


@pytest.mark.parametrize(
    ("found", "following"),
    [
        (
            {"verdict": SimpleNamespace(kind="cannot_tell"), "next_command":
             "surgisoft next-experiment {model} {data}{before} -o SCHEDULE.csv"},
            "next: surgisoft next-experiment default {rec} -o SCHEDULE.csv\n",
        ),
        (
            {"verdict": SimpleNamespace(kind="identified"), "next_command": "surgisoft amend"},
            "",
        ),
        (
            {"setup": SimpleNamespace(correctable=True)},
            "next: surgisoft diagnose default {rec} --apply CORRECTED\n",
        ),
    ],
)  # fmt: skip
def test_improve_that_adds_nothing_says_why_once_and_what_is_next(
    found, following, bench, capsys, monkeypatch
):
    why = SimpleNamespace(
        verdict="cannot_tell", sentence="cannot tell: a long reason", step=None, anew=False,
        together=False, competing=(), error_training_mm=0.5,
    )  # fmt: skip
    nothing = result(
        claimed=False, rounds=[why], steps=[], diagnoses=[diagnosis(**found)],
        sentence=f"nothing was added: {why.sentence}",
    )  # fmt: skip
    rec = str(bench / "bench.parquet")
    new = str(bench / "not_written")
    out = printed(
        capsys, monkeypatch, "surgisoft.diagnosis.improve.improve", nothing,
        "improve", "default", rec, "-o", new, code=1,
    )  # fmt: skip
    assert out.count(why.sentence) == 1
    said = f"nothing was added\n{new} was not written\n"
    assert out.endswith(said + following.format(rec=rec))


def test_printed_commands_quote_paths_with_spaces(spaced, capsys, monkeypatch):
    folder = Path(spaced).parent
    new = str(folder / "new arm")
    monkeypatch.setattr("surgisoft.surrogate.checkpoint.save_model", lambda *_: None)

    def last(*command: str) -> list[str]:
        assert run(list(command)) == 0
        return words_of(capsys.readouterr().out.splitlines()[-1])

    found = diagnosis(next_command="surgisoft compare {model} {data}{before}", change=CHANGE)
    monkeypatch.setattr("surgisoft.diagnosis.diagnose.diagnose", lambda *_, **__: found)
    given = ["default", spaced, "--before", spaced, "--paired", "never"]
    assert last("diagnose", *given) == ["surgisoft", "compare", *given]
    one = [comparison("default", explainable=0.5)]
    monkeypatch.setattr("surgisoft.diagnosis.compare.compare_all", lambda *_, **__: one)
    assert last("compare", *given) == ["surgisoft", "diagnose", *given]
    amended = result(
        claimed=True, rounds=[], steps=[], parameters=[], effects=("creep",), refitted=(),
        in_words={}, retuned=False, refit=None, sentence="the error falls", diagnoses=[],
        model=SimpleNamespace(summary=lambda: "an arm", fitted_rows=None),
    )  # fmt: skip
    for name in ("amend.amend", "improve.improve"):
        monkeypatch.setattr(f"surgisoft.diagnosis.{name}", lambda *_, **__: amended)
    amend = ["amend", "default", "--effect", "creep", "--data", spaced, "-o", new]
    assert last(*amend) == ["surgisoft", "diagnose", new, spaced]
    assert last("improve", "default", spaced, "-o", new)[2:4] == ["default", new]
    alarm = live(alarms=(SimpleNamespace(since_s=4.0),), written=(spaced,))
    monkeypatch.setattr("surgisoft.live.session.run", lambda *_, **__: alarm)
    again = ["default", spaced, "--before", spaced]
    assert last(*RUN, "--before", spaced) == ["surgisoft", "diagnose", *again]
    (folder / "raw log.csv").write_text("t_s,p1_kPa,x_mm,y_mm,z_mm\n0,1,0,0,50\n1,2,0,0,50\n")
    raw, draft = str(folder / "raw log.csv"), str(folder / "my map.toml")
    following = last("import", raw, "--draft", draft)
    assert following[:5] == ["surgisoft", "import", raw, "--map", draft]
    assert run(["import", raw, "-o", new]) == 2
    said = capsys.readouterr().err
    assert f"'surgisoft import {shlex.quote(raw)} --draft map.toml' writes one" in said
