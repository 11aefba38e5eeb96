"""Whole runs: interrupted or not, they give the same rows and one report.

Two processes give the same, too: `tests/cli/test_effect_files.py`, with an effect of the user.
"""

import json
import shutil
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pyarrow.parquet as pq
import pytest
from matplotlib import pyplot as plt

from surgisoft.agents import report_charts, session
from surgisoft.agents.evaluate import Evaluation
from surgisoft.agents.on_rig import RigConfig
from surgisoft.cli import run
from surgisoft.errors import InputError
from surgisoft.experiments import run as experiment_run
from surgisoft.experiments import spec as experiment_spec
from surgisoft.experiments.page import experiment_page, rules, verdict
from surgisoft.experiments.plan import build_task, settings
from surgisoft.experiments.results import drop_logs, sum_up
from surgisoft.experiments.run import open_results, run_experiment
from surgisoft.experiments.session import ExperimentRules, with_policy
from surgisoft.experiments.spec import Case, load_experiment
from surgisoft.report import Picture, Section
from surgisoft.scene.spec import PHANTOM
from surgisoft.tasks.circle_ablation import CircleAblationConfig, success_rule
from surgisoft.tasks.registry import spec_of
from tests.experiments.tiny import BREATHING, TINY, write
from tests.report.browser import chromium, look

PLAYED: dict = {}
"""Blocks of `whole` by setting and first episode, for tests of what is done with them."""


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """An experiment through the command, in one go."""
    folder = tmp_path_factory.mktemp("whole")
    file, results = write(folder), folder / "results"
    play = experiment_run.roll_out_block

    def kept(spec, setting, first, *given):
        PLAYED[setting.label, first] = play(spec, setting, first, *given)
        return PLAYED[setting.label, first]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(experiment_run, "roll_out_block", kept)
        assert run(["experiment", "run", str(file), "-o", str(results), "--no-replays"]) == 0
    return file, results


@pytest.fixture
def undrawn(monkeypatch):
    """Charts of pages are empty: `whole`, and tests of the charts, draw them."""

    def empty(figure, alt, caption="", least_px=0):
        plt.close(figure)
        return Picture(b"<svg/>", alt, caption, "image/svg+xml", least_px)

    monkeypatch.setattr(report_charts, "chart", empty)


def _rows(folder):
    return [json.loads(path.read_text()) for path in sorted((folder / "rows").iterdir())]


def test_a_warning_of_several_blocks_is_given_once(whole, tmp_path, monkeypatch):
    spec, found = load_experiment(whole[0]), []

    def warned(spec, setting, first, *given):
        warnings.warn("a model of another robot", stacklevel=1)
        warnings.warn("overflow", RuntimeWarning, stacklevel=1)
        return PLAYED[setting.label, first]

    monkeypatch.setattr(experiment_run, "roll_out_block", warned)
    open_results(spec, tmp_path / "r")
    with pytest.warns(RuntimeWarning, match="overflow") as others:
        run_experiment(spec, tmp_path / "r", on_warning=found.append)
    assert found == ["a model of another robot"]
    assert {other.category for other in others} == {RuntimeWarning}


def test_tables_hold_every_episode(whole):
    _, folder = whole
    rows = _rows(folder)
    assert [row["episode"] for row in rows] == [0, 1, 2]
    table = pq.read_table(folder / "episodes.parquet").to_pylist()
    assert table == rows
    lines = (folder / "episodes.csv").read_text().splitlines()
    assert len(lines) == 4
    overall = json.loads((folder / "summary.json").read_text())["settings"]["simulation"]["overall"]
    mean = sum(row["clearance_mm"] for row in rows) / 3
    assert overall["clearance_mm"]["mean"] == pytest.approx(mean)
    assert overall["success"]["high"] == pytest.approx(0.5615, abs=1e-3)  # Wilson: 0 of 3
    assert load_experiment(folder / "experiment.toml").repeats == 3


BRIEF = TINY.replace("repeats = 3", "repeats = 2").replace("time_s = 0.5", "time_s = 0.2")
"""Two episodes of two steps."""

THREE_TIMES = """
[[vary]]
field = "task.cut_s"
values = [30.0, 40.0, 50.0]
"""


@pytest.mark.usefixtures("undrawn")
def test_a_setting_whose_code_raises_leaves_the_others_their_report(tmp_path, monkeypatch, capsys):
    text = BRIEF.replace("together = 1", "together = 2")
    file, folder = write(tmp_path, text + THREE_TIMES), tmp_path / "r"
    play, broken = experiment_run.roll_out_block, ["simulation_cut_s=40"]

    def played(spec, setting, *given):
        if setting.label in broken:
            raise ArithmeticError("a singular matrix")
        return play(spec, setting, *given)

    monkeypatch.setattr(experiment_run, "roll_out_block", played)
    command = ["experiment", "run", str(file), "-o", str(folder), "--no-replays"]
    assert run(command) == 2
    printed = capsys.readouterr()
    line = printed.err.strip().splitlines()[-1]
    assert "setting 'simulation_cut_s=40', episodes 0 to 1: raised ArithmeticError in" in line
    assert all(part in line for part in ("test_run.py line", "a singular matrix", "--resume"))
    assert "Failed and left out: 1 of 3 settings." in printed.out
    assert printed.out.startswith("'simulation_cut_s=30': success 0 of 2"), "as the table names it"
    settings_ = json.loads((folder / "summary.json").read_text())["settings"]
    assert list(settings_) == ["simulation_cut_s=30", "simulation_cut_s=50"]
    assert "a singular matrix" in (folder / "report.html").read_text()
    stored = (folder / "failures" / "simulation_cut_s=40-0000.txt").read_text()
    assert "Traceback" in stored
    assert 'raise ArithmeticError("a singular matrix")' in stored
    broken.clear()
    assert run([*command, "--resume"]) == 0
    assert len(json.loads((folder / "summary.json").read_text())["settings"]) == 3
    assert not list((folder / "failures").iterdir())


def test_a_setting_of_which_a_block_fails_is_left_out_whole(tmp_path, monkeypatch):
    """Two blocks of one episode each; the second one of the first setting raises."""
    text = BRIEF + THREE_TIMES
    spec, folder = load_experiment(write(tmp_path, text)), tmp_path / "r"
    play = experiment_run.roll_out_block

    def played(spec, setting, first, *given):
        if (setting.label, first) == ("simulation_cut_s=30", 1):
            raise ArithmeticError("a singular matrix")
        return play(spec, setting, first, *given)

    monkeypatch.setattr(experiment_run, "roll_out_block", played)
    open_results(spec, folder)
    rows = run_experiment(spec, folder)
    assert {row["setting"] for row in rows} == {"simulation_cut_s=40", "simulation_cut_s=50"}
    results = sum_up(spec, folder, rows)
    (failed,) = results.failed
    assert failed.text.startswith("setting 'simulation_cut_s=30', episode 1: raised ArithmeticErr")
    drop_logs(results)
    assert len(results.log("simulation_cut_s=30", 0).time_s), "kept for the run that goes on"


def test_an_experiment_of_which_every_setting_fails_says_so_in_one_line(
    tmp_path, monkeypatch, capsys
):
    def raises(*given):
        raise InputError("model: raised ValueError; correct the model")

    monkeypatch.setattr(experiment_run, "roll_out_block", raises)
    file = write(tmp_path)
    assert run(["experiment", "run", str(file), "-o", str(tmp_path / "r")]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "every setting failed: setting 'simulation', episode 0: model: raised ValueError" in line
    assert "2 further blocks" in line
    assert not (tmp_path / "r" / "report.html").exists()


def test_an_interrupted_command_does_not_call_its_folder_complete(tmp_path, monkeypatch, capsys):
    def interrupt(*given):
        raise KeyboardInterrupt

    monkeypatch.setattr(experiment_run, "roll_out_block", interrupt)
    file, folder = write(tmp_path), tmp_path / "r"
    assert run(["experiment", "run", str(file), "-o", str(folder)]) == 130
    printed = capsys.readouterr()
    assert f"{folder} keeps the finished blocks; continue with: surgisoft exp" in printed.out
    assert "complete" not in printed.err


def test_an_interrupted_run_goes_on_where_it_stopped(whole, tmp_path):
    file, folder = whole
    spec, began = load_experiment(file), []

    def interrupt(done, total, note):
        if done > 1.0:
            raise KeyboardInterrupt

    open_results(spec, tmp_path / "r")
    with pytest.raises(KeyboardInterrupt):
        run_experiment(spec, tmp_path / "r", report=interrupt)
    first = _rows(tmp_path / "r")
    assert [row["episode"] for row in first] == [0]
    open_results(spec, tmp_path / "r", resume=True)
    run_experiment(spec, tmp_path / "r", report=lambda done, total, note: began.append(done))
    assert began[0] == 1.0
    assert _rows(tmp_path / "r") == _rows(folder)


@pytest.mark.usefixtures("undrawn")
def test_cases_of_two_scenes_are_compared(tmp_path, capsys):
    """The rings of the two scenes have radii of 10 and 9 mm; a scene that changes is refused."""
    small = tmp_path / "small"
    shutil.copytree(PHANTOM, small)
    scene = small / "scene.toml"
    scene.write_text(scene.read_text().replace("diameter_mm = 20.0", "diameter_mm = 18.0", 1))
    cases = '[[cases]]\nname = "shipped"\n[[cases]]\nname = "less"\nscene = "small"\n'
    brief = TINY.replace("repeats = 3", "repeats = 1").replace("time_s = 0.5", "time_s = 0.2")
    file, folder = write(tmp_path, brief + cases), tmp_path / "r"
    assert run(["experiment", "run", str(file), "-o", str(folder)]) == 0
    spec = load_experiment(folder / "experiment.toml")
    assert [case.scene for case in spec.cases] == ["", str(small)]
    results = sum_up(spec, folder, run_experiment(spec, folder))
    for label, radius_mm in (("shipped", 10.0), ("less", 9.0)):
        path = results.log(label, 0).path_mm
        away = np.linalg.norm(path - path.mean(0), axis=1)
        np.testing.assert_allclose(away, radius_mm, atol=0.3)
    assert "less: simulation, policy scripted, scene small" in (folder / "report.html").read_text()
    hashes = json.loads((folder / "versions.json").read_text())
    assert hashes["cases"]["less"]["scene"] != hashes["scene_hash"]
    assert "scene" not in hashes["cases"]["shipped"]
    scene.write_text(scene.read_text().replace("diameter_mm = 18.0", "diameter_mm = 17.0", 1))
    for row in (folder / "rows").glob("less-*"):
        row.unlink()
    capsys.readouterr()
    assert run(["experiment", "run", str(file), "-o", str(folder), "--resume"]) == 2
    assert "small' of its case 'less' has changed since the results began" in (
        capsys.readouterr().err
    )


def test_results_go_on_in_another_installation(tmp_path, monkeypatch):
    """What the package brings along is named, not placed; its content has to be the same."""
    case = '[[cases]]\nname = "ours"\npolicy = "ring"\n'
    file = write(tmp_path, TINY.replace("{scene}", "phantom_liver") + case)
    open_results(load_experiment(file), tmp_path / "r")
    here = load_experiment(file).scene
    for folder in ("scenes", "assets/policies"):
        shutil.copytree(
            PHANTOM.parent if folder == "scenes" else experiment_spec.PACKAGED,
            tmp_path / "other" / "surgisoft" / folder,
        )
    monkeypatch.setattr(experiment_spec, "SCENES", tmp_path / "other" / "surgisoft" / "scenes")
    policies = tmp_path / "other" / "surgisoft" / "assets" / "policies"
    monkeypatch.setattr(experiment_spec, "PACKAGED", policies)
    there = load_experiment(file)
    assert there.scene != here
    open_results(there, tmp_path / "r", resume=True)
    text = (tmp_path / "r" / "experiment.toml").read_text()
    placed = text.replace('"ring"', '"../gone/surgisoft/assets/policies/ring"')  # as before
    (tmp_path / "r" / "experiment.toml").write_text(placed)
    open_results(there, tmp_path / "r", resume=True)
    scene = Path(there.scene) / "scene.toml"
    changed = scene.read_text().replace("roll_deg = 55.21", "roll_deg = 56.0")
    assert changed != scene.read_text()
    scene.write_text(changed)
    with pytest.raises(InputError, match="has changed since the results began"):
        open_results(load_experiment(file), tmp_path / "r", resume=True)


def test_results_are_not_overwritten(whole, tmp_path, capsys):
    file, folder = whole
    before = _rows(folder)
    assert run(["experiment", "run", str(file), "-o", str(folder)]) == 2
    assert "--resume continues them, --force replaces them" in capsys.readouterr().err
    other = write(tmp_path, TINY.replace("seed = 3", "seed = 4"))
    with pytest.raises(InputError, match="holds another experiment"):
        open_results(load_experiment(other), folder, resume=True)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "letter.txt").write_text("x")
    with pytest.raises(InputError, match="holds no results of an experiment"):
        open_results(load_experiment(other), tmp_path / "full", force=True)
    assert _rows(folder) == before


def test_the_report_is_self_contained_and_fits_a_telephone(whole, tmp_path):
    _, folder = whole
    text = (folder / "report.html").read_text()
    assert "success 0 of 3" in text
    with chromium() as browser:
        for width in (1280, 400):
            overflow, foreign, broken, _ = look(browser, folder / "report.html", width)
            assert (overflow, foreign, broken) == (0, [], 0)


def test_list_names_what_is_shipped(capsys):
    assert run(["experiment", "list"]) == 0
    out = capsys.readouterr().out
    for name in ("liver", "multi_lesion", "fault", "sweep", "contours", "area", "breathing"):
        assert f"\n{name}: " in f"\n{out}", "by the name that `run` takes"


def test_old_results_stay_until_the_new_ones_have_begun(whole, tmp_path, monkeypatch):
    """What ends --force in the middle leaves all of the old results, and nothing half."""
    file, folder = whole
    results, spec = tmp_path / "results", load_experiment(file)
    shutil.copytree(folder, results)
    before = sorted(path.name for path in results.rglob("*"))
    with monkeypatch.context() as patch:
        patch.setattr(experiment_run, "save_experiment", lambda *_: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            open_results(spec, results, force=True)
    assert sorted(path.name for path in results.rglob("*")) == before
    open_results(spec, results, force=True)
    assert sorted(path.name for path in results.iterdir()) == [
        "experiment.toml",
        "rows",
        "versions.json",
    ]
    assert not list((results / "rows").iterdir())
    assert [path.name for path in tmp_path.iterdir()] == ["results"]


def test_a_damaged_row_is_one_line(whole, tmp_path):
    file, folder = whole
    shutil.copytree(folder, tmp_path / "results")
    spec = load_experiment(file)
    row = sorted((tmp_path / "results" / "rows").iterdir())[1]
    content = json.loads(row.read_text())
    texts = ["[]", "[" * 10**5, json.dumps(content | {"episode": 7})]
    texts += [json.dumps(content | {"clearance_mm": "x"}), json.dumps(content | {"new": 1})]
    texts.append(json.dumps(content | {"clearance_mm": 10**400}))
    texts += [json.dumps(content | {"success": value}) for value in (65536.0, -1.0, 0.5, None, "1")]
    texts += [json.dumps(content | {"outcome": None}), json.dumps(content | {"case": 1.0})]
    for text in texts:
        row.write_text(text)
        with pytest.raises(InputError, match=row.name):
            run_experiment(spec, tmp_path / "results")
    row.write_text(json.dumps(content | {"completion": None}))
    rows = run_experiment(spec, tmp_path / "results")
    assert sum_up(spec, tmp_path / "results", rows).settings[0].overall["completion"].episodes == 2
    row.write_text(json.dumps(content))
    assert len(run_experiment(spec, tmp_path / "results")) == 3


def test_success_is_one_rule_in_experiment_and_evaluate(whole, tmp_path, monkeypatch, capsys):
    """The rules of an experiment's file reach `evaluate`, and both commands state them."""
    file, folder = whole
    spec = load_experiment(file)
    rule = success_rule(spec.task)
    assert "within 50 mm of its target (fire_mm)" in rule
    assert f"Success: {rule}; nothing is aborted." in (folder / "summary.md").read_text()
    assert rule in (folder / "report.html").read_text()
    asked = []

    def stop(policies, task, progress=None, on_warning=None, **fields):
        request = session.EvaluationRequest(tuple(policies), task, **fields).under_rules()
        asked.append((request.task, request.config))
        assert (request.seed, request.rules.spec) == (spec.seed, spec)
        raise InputError("stop here")

    monkeypatch.setattr(session, "evaluate", stop)
    assert run(["evaluate", "scripted", "--rules", str(file)]) == 2
    played = build_task(spec, settings(spec)[0]).base.config
    ((task, config),) = asked
    assert task == "circle_ablation"
    assert replace(config, arm=played.arm) == played, "what the experiment plays"
    assert run(["evaluate", "scripted", "--rules", str(file), "--config", "x.toml"]) == 2
    assert "--config and --rules both" in capsys.readouterr().err
    assert run(["evaluate", "scripted", "--rules", "liver", "--task", "track_circle"]) == 2
    assert "is an experiment of circle_ablation, not of track_circle" in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore:arm '.*its model is")  # the model of robot 0
def test_an_experiment_and_evaluate_by_its_rules_give_the_same_episodes(tmp_path):
    """The packaged policy on robot 1 of the rig: every number of an episode."""
    brief = TINY.replace("[task]", "[task.world.randomisation]\nhistory = 1\n\n[task]")
    spec = load_experiment(write(tmp_path, brief))
    spec = replace(spec, cases=(Case(name="rig", plant="rig", robot_seed=1),))
    *_, setting = settings(with_policy(spec, "ring"))
    assert setting.case.policy != "scripted"
    (row,) = experiment_run.roll_out_block(spec, setting, 0, 1).rows
    rules = ExperimentRules(spec)
    found = session.evaluate("ring", rig=RigConfig(seed=1), rules=rules, episodes=1)
    numbers = found.results[0].per_episode
    assert {"success", "beam_error_mean_mm", "clearance_mm", "time_s"} <= set(numbers)
    for name, values in numbers.items():
        expected = np.nan if row[name] is None else row[name]
        np.testing.assert_array_equal(values, [expected], err_msg=name)


def test_evaluate_tells_what_of_an_experiment_it_leaves_out(tmp_path, monkeypatch):
    """The default of cut_s is 45 s, which is none of the experiment's values."""
    empty = Evaluation("random", {}, {}, None)
    monkeypatch.setattr(session, "rollout", lambda *_, **__: None)
    monkeypatch.setattr(session, "summarised", lambda *_, **__: empty)
    told = []
    lesion = '[[lesions]]\nname = "left"\ncentre_mm = [0.0, 0.0, 0.0]\n'
    for text in (TINY, TINY + THREE_TIMES + lesion):
        spec = load_experiment(write(tmp_path, text))
        session.evaluate("random", rules=ExperimentRules(spec), on_warning=told.append)
    (line,) = told
    assert "varies task.cut_s (30.0, 40.0, 50.0, here 45.0); the lesions left, which" in line
    assert "surgisoft experiment run" in line


def test_evaluate_states_the_rule_of_success(monkeypatch):
    empty = Evaluation("random", {}, {}, None)
    monkeypatch.setattr(session, "rollout", lambda *_, **__: None)
    monkeypatch.setattr(session, "summarised", lambda *_, **__: empty)
    fast = CircleAblationConfig(cut_s=30.0, fire_mm=0.7)
    found = session.evaluate("random", "circle_ablation", config=fast)
    assert found.to_json()["success_rule"] == success_rule(fast)
    assert "within 0.7 mm of its target" in found.success_rule


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("name", ["track_circle", "keyhole"])
def test_a_task_without_a_scene_makes_an_experiment(name, tmp_path, capsys):
    """From a file to its report: phases, the arm's controllers, a fault, numbers of the task."""
    agents = "".join(f'{agent} = "policy"\n' for agent in spec_of(name).agents)
    file = tmp_path / "short.toml"
    file.write_text(
        f'name = "short"\nscenario = "{name}"\n[limits]\ntime_s = 0.6\n'
        f'[[phases]]\nname = "go"\ntimeout_s = 0.3\non_timeout = "go on"\n{agents}'
        '[[phases]]\nname = "wait"\ntimeout_s = 9.0\n'
        f'[[faults]]\narm = "{spec_of(name).agents[0]}"\nchamber = 1\nat_s = 0.4\n'
    )
    assert run(["experiment", "run", str(file), "-o", str(tmp_path / "r"), "--no-replays"]) == 0
    (row,) = _rows(tmp_path / "r")
    assert row["outcome"] == "time out"
    assert row["go_s"] == pytest.approx(0.3), "the steps that ran in it"
    assert row["wait_s"] == pytest.approx(0.3)
    assert row["beam_s"] == 0.0
    page = (tmp_path / "r" / "report.html").read_text()
    assert "chamber 1 goes to 0 kPa from 0.4 s on" in page
    file.write_text(f'scene = "."\n{file.read_text()}')
    capsys.readouterr()
    assert run(["experiment", "check", str(file)]) == 2
    assert f":1: scene: got '.'; expected none: {name} has no scene" in capsys.readouterr().err


@pytest.mark.usefixtures("undrawn")
def test_a_fault_that_never_came_is_said_to_have_not(tmp_path, capsys):
    """And a task without a measure of success has no condition that waits for it."""
    file = tmp_path / "late.toml"
    phase = '[[phases]]\nname = "go"\ntimeout_s = 0.3\non_timeout = "go on"\narm = "policy"\n'
    late = '[[faults]]\narm = "arm"\nchamber = 1\nat_s = 300.0\n'
    file.write_text(f'name = "late"\nscenario = "track_circle"\n{phase}{late}')
    assert run(["experiment", "run", str(file), "-o", str(tmp_path / "r"), "--no-replays"]) == 0
    printed = capsys.readouterr().out
    assert "No episode lasted until the fault at 300 s" in printed
    assert "After the fault" not in printed
    file.write_text(file.read_text().replace("on_timeout", 'until = "succeeded"\non_timeout'))
    assert run(["experiment", "check", str(file)]) == 2
    assert "got 'succeeded'; expected one of at rest, never" in capsys.readouterr().err


@pytest.mark.usefixtures("undrawn")
def test_a_task_without_a_measure_of_success_has_no_rate_of_it(tmp_path, capsys):
    """As `evaluate` prints none; what the verdict counts is who went to the end."""
    file = tmp_path / "path.toml"
    phase = '[[phases]]\nname = "go"\ntimeout_s = 0.3\non_timeout = "go on"\narm = "policy"\n'
    file.write_text(f'name = "path"\nscenario = "track_circle"\nrepeats = 2\n{phase}')
    folder = tmp_path / "r"
    assert run(["experiment", "run", str(file), "-o", str(folder), "--no-replays"]) == 0
    rows, printed = _rows(folder), capsys.readouterr().out
    assert printed.startswith("'simulation': 2 of 2 episodes went to their end.")
    assert "success" not in rows[0]
    assert "| success |" not in printed
    assert "track_circle has no measure of success, so no rate of it is stated." in printed
    assert 'class="verdict plain"' in (folder / "report.html").read_text()
    file.write_text(file.read_text().replace("go on", "abort"))
    assert run(["experiment", "run", str(file), "-o", str(folder), "--no-replays", "--force"]) == 0
    assert "'simulation': 0 of 2 episodes went to their end" in capsys.readouterr().out
    spec = load_experiment(file)
    each = spec_of("track_circle").experiment
    worst = [each.badness({"outcome": o, "error_mean_mm": e}) for o, e in WORSE]
    assert worst == sorted(worst)
    many = [{**row, "setting": f"s{i}"} for i, row in enumerate(rows * 3)]
    for row, error in zip(many, (0.5, 0.3, 0.9, 0.4, 0.6, 0.7), strict=True):
        row["error_mean_mm"] = error
    assert verdict(sum_up(spec, folder, many)) == (
        "6 of 6 episodes went to their end, mean error from 0.3 mm ('s1') to 0.9 mm ('s2')."
    )


WORSE = (("done", 0.1), ("time out", 0.2), ("aborted in go: phase took too long", 0.0))
"""Outcomes and errors of episodes without a measure of success, from good to bad."""


def test_the_verdict_of_a_burn_on_a_moving_organ_is_its_error_on_the_tissue(tmp_path):
    """A gated beam that points exactly may burn beside its place: that error, and its worst."""
    spec = load_experiment(write(tmp_path, BREATHING))
    same = {"setting": "gated", "case": "gated", "outcome": "done", "success": 1.0}
    same |= {"completion": 1.0, "time_s": 9.0, "beam_unsafe_longest_s": 0.0}
    beam, tissue = (0.004, 0.002), (0.1, 0.3)
    rows = [
        {**same, "episode": k, "beam_error_mean_mm": beam[k], "tissue_error_mean_mm": tissue[k]}
        for k in range(2)
    ]
    results = sum_up(spec, tmp_path, rows)
    said = "'gated': success 2 of 2, mean error on the tissue 0.2 mm."
    assert verdict(results).startswith(said)
    assert results.worst == ("gated", 1)


def test_lists_that_vary_have_a_chart_with_their_values_at_the_axis(tmp_path, monkeypatch):
    """Of five settings, of which the report shows no first episodes side by side."""
    amplitudes = [[10, 20], [2.5, 5], [4, 4], [1, 2], [3, 30]]
    vary = f'\n[[vary]]\nfield = "task.respiration.amplitude_mm"\nvalues = {amplitudes}\n'
    spec = load_experiment(write(tmp_path, BREATHING + vary))
    same = {"case": "simulation", "episode": 0, "outcome": "done", "success": 1.0}
    same |= {"completion": 1.0, "time_s": 9.0, "beam_unsafe_longest_s": 0.0}
    same |= {"beam_error_mean_mm": 0.1}
    errors = [0.5, 0.2, 0.3, 0.1, 0.4]
    rows = [
        {**same, **setting.columns, "setting": setting.label, "tissue_error_mean_mm": error}
        for setting, error in zip(settings(spec), errors, strict=True)
    ]
    drawn = {}

    def keep(figure, alt, caption="", least_px=0):
        drawn[alt] = figure.axes[0]
        plt.close(figure)
        return Picture(b"<svg/>", alt, caption, "image/svg+xml", least_px)

    monkeypatch.setattr(report_charts, "chart", keep)
    page = experiment_page(sum_up(spec, tmp_path, rows), {}, {}, "")
    assert "Over task.respiration.amplitude_mm" in [
        part.title for part in page.parts if isinstance(part, Section)
    ]
    title = spec.of.experiment.numbers["tissue_error_mean_mm"]
    axis = drawn[f"{title} over amplitude_mm"]
    named = [label.get_text() for label in axis.get_xticklabels()]
    assert named == ["[10, 20]", "[2.5, 5]", "[4, 4]", "[1, 2]", "[3, 30]"]
    (marks,) = (line for line in axis.lines if line.get_marker() == "o")
    assert dict(zip(marks.get_xdata(), marks.get_ydata(), strict=True)) == dict(enumerate(errors))


def test_the_rule_of_success_has_the_values_of_all_settings(tmp_path):
    """Not the file's, or the default of 45 s, which is that of no setting."""

    def said(text):
        return rules(SimpleNamespace(experiment=load_experiment(write(tmp_path, text))))

    assert "within 50 mm of its target (fire_mm), which goes once around in 45 s" in said(TINY)
    vary = '\n[[vary]]\nfield = "task.fire_mm"\nvalues = [0.5, 5.0]\n'
    both = said(TINY + vary + THREE_TIMES)
    assert "within 0.5 or 5 mm of its target (fire_mm)" in both
    assert "around in 30, 40 or 50 s (cut_s); nothing is aborted." in both
    many = THREE_TIMES.replace("[30.0,", "[10.0, 20.0, 30.0,")
    assert "around in 10 to 50 s (cut_s)" in said(TINY + many)
    other = vary.replace("task.fire_mm", "task.world.randomisation.mount_mm")
    assert said(TINY + other) == said(TINY), "not in the rule"
    area = 'scenario = "area_ablation"\n' + TINY.replace('"cut"\ntimeout', '"treated"\ntimeout')
    margins = vary.replace("task.fire_mm", "task.spared_mm").replace("0.5, 5.0", "0.5, 2.0")
    assert "healthy tissue more than 0.5 or 2 mm outside are ablated" in said(area + margins)
    modes = '\n[[vary]]\nfield = "task.mode"\nvalues = ["follow", "gated"]\n'
    assert said(BREATHING + modes).endswith("(mode: the setting's value); nothing is aborted.")
