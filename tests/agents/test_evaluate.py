"""Numbers of episodes and their intervals, held against tables, simulation and the command."""

import json
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.stats import binomtest, ttest_rel

from surgisoft.agents import session
from surgisoft.agents.evaluate import (
    Evaluation,
    cell,
    cells_are,
    differences,
    episode_table,
    student,
    summary,
    wilson,
)
from surgisoft.agents.exact_checks import Contact, EpisodeCheck
from surgisoft.agents.rollout import Rollout, rollout
from surgisoft.agents.run_folder import PACKAGED, RunFolder
from surgisoft.agents.session import EvaluationRequest, evaluate
from surgisoft.cli import run
from surgisoft.errors import InputError, Interrupted
from surgisoft.scene.folder import open_scene
from surgisoft.scene.spec import PHANTOM
from surgisoft.surrogate.checkpoint import load_model, save_model
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.circle_ablation import CircleAblation, CircleAblationConfig
from surgisoft.tasks.registry import make_task, read_config
from surgisoft.tasks.world.reach import beam_beyond_limits
from surgisoft.tasks.world.world import WorldConfig

NAN = float("nan")


@pytest.mark.parametrize(
    ("hits", "count", "low", "high"),
    [(0, 10, 0.0, 0.2775), (5, 10, 0.2366, 0.7634), (99, 100, 0.9455, 0.9982)],
)
def test_interval_of_a_rate_as_in_tables(hits, count, low, high):
    """Newcombe 1998, table I (method 3): Wilson's interval."""
    found = summary("success", np.repeat([1.0, 0.0], [hits, count - hits]))
    assert (found.low, found.high) == pytest.approx((low, high), abs=1e-4)


@pytest.mark.parametrize(
    ("hits", "count"), [(0, 1), (1, 1), (0, 20), (7, 20), (20, 20), (996, 1000)]
)
def test_interval_of_a_rate_as_scipy_has_it(hits, count):
    expected = binomtest(hits, count).proportion_ci(0.95, "wilson")
    assert wilson(hits, count) == pytest.approx(tuple(expected), abs=1e-14)


def test_interval_of_a_mean_as_in_a_textbook():
    """Student 1908, section IX: the difference of hours of sleep by two soporifics, ten patients.

    Mean 1.58 h, standard error 0.389 h, 9 degrees of freedom (2.262): 0.70 to 2.46 h.
    """
    hours = np.array([1.2, 2.4, 1.3, 1.3, 0.0, 1.0, 1.8, 0.8, 4.6, 1.4])
    assert student(hours) == pytest.approx((0.70, 2.46), abs=0.005)


@pytest.mark.parametrize("episodes", [2, 5, 10])
def test_interval_of_a_mean_holds_it_as_often_as_it_says(episodes):
    """95 %, for few episodes as well: within four standard errors of 2,000 draws."""
    draws = np.random.default_rng(1).normal(size=(2000, episodes))
    inside = [low <= 0.0 <= high for low, high in map(student, draws)]
    assert 0.93 <= np.mean(inside) <= 0.97


def test_an_interval_stays_within_what_the_number_can_be():
    """Two numbers: 12.7 standard errors to either side. A clearance may be negative."""
    share = summary("completion", np.array([1.0, 1.0, 0.9]))
    assert share.low < 0.9
    assert share.high == 1.0
    values = np.array([0.1, 0.3])
    for name in ("error_max_mm", "time_s", "healthy_mm2", "largest_gap_mm"):
        assert summary(name, values).low == 0.0
        assert summary(name, values).high == pytest.approx(0.2 + 12.706 * 0.1, abs=1e-3)
    assert summary("clearance_mm", values).low == pytest.approx(0.2 - 12.706 * 0.1, abs=1e-3)


def test_one_episode_has_no_interval():
    found = summary("time_s", np.array([4.0]))
    assert (found.mean, found.episodes) == (4.0, 1)
    assert np.isnan([found.low, found.high]).all()


def test_of_few_episodes_a_cell_has_the_least_and_the_greatest_number():
    """Two clearances of 11.39 and 14.19 mm: Student's interval of their mean, 12.706 standard
    errors of 1.4 mm to either side, would look like contact."""
    two = summary("clearance_mm", np.array([11.39, 14.19]))
    assert two.low == pytest.approx(12.79 - 12.706 * 1.4, abs=1e-3)
    assert cell("clearance_mm", two) == "12.79 (11.39 to 14.19)"
    hit = summary("success", np.array([1.0, 0.0]))
    assert cell("success", hit) == "50.0% [9.5%, 90.5%]", "Wilson's holds for any number"
    assert cells_are([{"success": hit}]) == "mean [95 % interval]"
    assert cells_are([{"success": hit, "clearance_mm": two}]).endswith("or (least to greatest)")
    five = summary("clearance_mm", np.array([1.0, 2.0, 3.0, 4.0, 5.0]))
    assert cell("clearance_mm", five) == "3 [1.037, 4.963]"
    assert cells_are([{"clearance_mm": five}]) == "mean [95 % interval]"


def test_a_summary_leaves_out_what_does_not_apply():
    found = summary("time_s", np.array([1.0, NAN, 3.0]))
    assert (found.mean, found.least, found.most, found.episodes) == (2.0, 1.0, 3.0, 2)
    nothing = summary("time_s", np.array([NAN]))
    assert nothing.episodes == 0
    assert np.isnan(nothing.mean)


def ablation_rollout(**measures):
    """Two episodes of three steps, the second over after two."""
    steps = torch.tensor([3, 2])
    over = torch.tensor([False, True])
    table = {name: torch.tensor(value) for name, value in measures.items()}
    return Rollout("circle_ablation", 0.1, steps, {}, over, ~over & over, table)


def test_each_measure_has_its_summary():
    task = CircleAblation()
    need = task.spec.limits.view_fraction
    played = ablation_rollout(
        beam_error_mm=[[3.0, 4.0, NAN], [NAN, 1.0, NAN]],
        completion=[[0.2, 0.5, 1.0], [0.1, 0.3, NAN]],
        view_fraction=[[need, 0.0, need], [0.0, 0.0, NAN]],
        success=[[0.0, 0.0, 1.0], [0.0, 0.0, NAN]],
        clearance_mm=[[5.0, 2.0, 3.0], [4.0, 6.0, NAN]],
        beam_clearance_mm=[[3.0, 1.5, 2.0], [7.0, 8.0, NAN]],
        rim_mm=[[9.0, 1.0, 5.0], [2.0, 3.0, NAN]],
        collided=[[0.0, 0.0, 0.0], [0.0, 1.0, NAN]],
        inside_mm2=[[0.0, 1.0, 4.0], [0.0, 2.0, NAN]],
        visited=[[0.0, 0.5, 1.0], [0.0, 0.25, NAN]],
        at_rim_s=[[0.0, 0.1, 0.1], [0.0, 0.1, NAN]],
    )
    table = episode_table(task, played)
    expected = {
        "beam_error_mean_mm": [3.5, 1.0],
        "beam_error_rms_mm": [12.5**0.5, 1.0],
        "beam_error_max_mm": [4.0, 1.0],
        "beam_error_p95_mm": [3.95, 1.0],
        "completion": [1.0, 0.3],
        "in_view": [2 / 3, 0.0],
        "clearance_mm": [2.0, 4.0],
        "beam_clearance_mm": [1.5, 7.0],
        "rim_mm": [1.0, 2.0],
        "collided": [0.0, 1.0],
        "inside_mm2": [4.0, 2.0],
        "visited": [1.0, 0.25],
        "at_rim_s": [0.1, 0.1],
        "success": [1.0, 0.0],
        "time_s": [0.3, 0.2],
    }
    for name, values in expected.items():
        np.testing.assert_allclose(table[name], values, rtol=1e-6, err_msg=name)


def test_the_exact_checker_overrules_the_batched_path():
    played = ablation_rollout(
        success=[[0.0, 0.0, 1.0], [0.0, 1.0, NAN]],
        clearance_mm=[[5.0, 2.0, 3.0], [4.0, 6.0, NAN]],
        collided=[[0.0, 0.0, 0.0], [0.0, 0.0, NAN]],
    )
    hit = EpisodeCheck(Contact(0.1, ("laser", "liver")), -0.5, 4, 1, 2.5, 0, 0.0)
    free = EpisodeCheck(None, 3.5, 3, 0, 0.0, 0, 0.0)
    table = episode_table(CircleAblation(), played, [hit, free])
    assert table["success"].tolist() == [0.0, 1.0]
    assert table["collided"].tolist() == [1.0, 0.0]
    assert table["clearance_mm"].tolist() == [-0.5, 3.5]


def test_the_exact_checks_of_all_episodes_are_sums_and_the_largest_differences():
    one = EpisodeCheck(Contact(0.1, ("laser", "liver")), -0.5, 4, 1, 2.5, 2, 0.25, 3, 5, 1)
    other = EpisodeCheck(None, 3.5, 3, 2, 0.5, 1, 0.75, 1, 2, 1)
    told = Evaluation("p", {"success": np.zeros(2)}, {}, [one, other]).to_json()["exact_checks"]
    assert (told["instants"], told["contact_differs"], told["beam_differs"]) == (7, 3, 3)
    assert (told["beam_off_mm"], told["clearance_off_mm"]) == (0.75, 2.5)
    assert (told["contact_asked"], told["beams_asked"], told["contact_audited"]) == (4, 7, 2)
    assert told["contacts"] == [{"time_s": 0.1, "between": ["laser", "liver"]}, None]


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    """A task that is over in two seconds."""
    file = tmp_path_factory.mktemp("config") / "short.toml"
    file.write_text("[follow]\nloop_s = 1.5\napproach_s = 0.5\nsize_mm = 2.0\n")
    return str(file)


def test_the_episodes_of_an_interrupted_policy_bear_its_name(short, monkeypatch):
    """Ctrl-C in the second policy, after the first of its two episodes."""
    monkeypatch.setattr("surgisoft.agents.session.BATCH", 1)
    interrupted = []

    def stop(done, total, name):
        if name == "random" and done > 0.8 * total and not interrupted:
            interrupted.append(name)
            raise KeyboardInterrupt

    with pytest.raises(Interrupted) as ended:
        evaluate(["scripted", "random"], "track_circle", config=short, episodes=2, progress=stop)
    found = ended.value.result
    assert [(one.policy, one.episodes) for one in found.results] == [("scripted", 2), ("random", 1)]
    assert found.interruption == "interrupted; finished of 2 episodes each: scripted 2, random 1"


def test_command_compares_policies_and_writes_all_numbers(tmp_path, capsys, short):
    file = tmp_path / "out" / "numbers.json"
    command = ["evaluate", "scripted", "random", "--task", "track_circle", "--config", short]
    assert run([*command, "--episodes", "3", "--seed", "4", "--json", str(file)]) == 0
    printed = capsys.readouterr().out
    assert "scripted" in printed
    assert "error_mean_mm" in printed
    found = json.loads(file.read_text())
    assert (found["task"], found["on"], found["seed"], found["episodes"]) == (
        "track_circle", "simulation", 4, 3,
    )  # fmt: skip
    assert found["task_config"]["follow"]["loop_s"] == 1.5
    script, chance = found["policies"]["scripted"], found["drivers"]["random"]
    for policy in (script, chance):
        errors = policy["per_episode"]["error_mean_mm"]
        overall = policy["overall"]["error_mean_mm"]
        assert len(errors) == overall["episodes"] == 3
        assert overall["mean"] == pytest.approx(np.mean(errors))
        assert overall["low"] <= overall["mean"] <= overall["high"]
    assert script["overall"]["error_mean_mm"]["most"] < chance["overall"]["error_mean_mm"]["least"]
    first = file.read_text()
    assert run([*command, "--episodes", "3", "--seed", "4", "--json", str(file)]) == 0
    assert file.read_text() == first


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["skripted", "--task", "track_circle"], "skripted"),
        (["scripted"], "--task"),
        (["scripted", "--task", "track_cirlce"], "track_circle"),
        (["runs/nowhere", "--task", "track_circle"], "runs/nowhere"),
        ([".", "--task", "track_circle"], "config.json"),
        (["scripted", "--task", "track_circle", "--on", "moon"], "rig"),
        (["scripted", "--task", "track_circle", "--hidden", "creep"], "--on rig"),
        (["scripted", "--task", "track_circle", "--on", "rig", "--hidden", "creep:much"], "creep"),
        (["scripted", "--task", "track_circle", "--on", "rig", "--hidden", "gremlins"], "creep"),
        (["scripted", "--task", "track_circle", "--scene", "x"], "scene"),
        (["scripted", "--task", "track_circle", "--replay", "x.mp4"], ".rrd"),
        (["scripted", "--task", "track_circle", "--json", "pyproject.toml"], "pyproject.toml"),
    ],
)
def test_bad_input_is_one_line_and_code_2(arguments, named, capsys):
    assert run(["evaluate", *arguments, "--episodes", "1"]) == 2
    message = capsys.readouterr().err.strip()
    assert len(message.splitlines()) == 1
    assert named in message


def test_a_run_brings_its_task_and_refuses_another(tmp_path, capsys, short):
    from surgisoft.agents.actor import Actor
    from surgisoft.agents.learned import agent_sizes
    from surgisoft.agents.presets import Plan, preset_for
    from surgisoft.agents.run_folder import BEST, create_run
    from surgisoft.tasks.registry import read_config

    config, preset = read_config("track_circle", Path(short)), preset_for("fast", "track_circle")
    task, plan = make_task("track_circle", config), Plan("track_circle", config, "fast", preset, 1)
    sizes = agent_sizes(task)
    made = create_run(tmp_path / "run", plan, task, sizes, 1)
    actor = Actor(sizes["arm"]["observation"], sizes["arm"]["chambers"], preset)
    made.save(BEST, {"iteration": 0, "agents": {"arm": actor.state_dict()}})
    folder = str(made.path)

    assert run(["evaluate", folder, "--task", "circle_ablation", "--episodes", "1"]) == 2
    assert "trained on track_circle" in capsys.readouterr().err
    file = tmp_path / "run.json"
    assert run(["evaluate", folder, "--episodes", "2", "--json", str(file)]) == 0
    found = json.loads(file.read_text())
    assert found["task"] == "track_circle"
    assert found["task_config"]["follow"]["loop_s"] == 1.5
    times = found["policies"][folder]["per_episode"]["time_s"]
    assert times == pytest.approx([2.0, 2.0])


def test_another_seed_gives_other_episodes(tmp_path):
    """By the command and in Python; the same seed gives the same ones."""
    (tmp_path / "short.toml").write_text("[follow]\nloop_s = 0.6\napproach_s = 0.2\n")
    config = ["--config", str(tmp_path / "short.toml")]

    def errors(name, *seed):
        file = tmp_path / f"{name}.json"
        arguments = ["evaluate", "random", "--task", "track_circle", "--episodes", "2", *config]
        assert run([*arguments, *seed, "--json", str(file)]) == 0
        found = json.loads(file.read_text())
        return found["seed"], found["policies"]["random"]["per_episode"]["error_mean_mm"]

    given = [
        errors(n, *s) for n, s in zip("abc", ([], ["--seed", "0"], ["--seed", "7"]), strict=True)
    ]
    assert [seed for seed, _ in given] == [0, 0, 7]
    assert given[0][1] == given[1][1]
    assert given[0][1] != given[2][1]
    task = read_config("track_circle", tmp_path / "short.toml")
    asked = evaluate("random", "track_circle", config=task, episodes=2, seed=7)
    assert asked.results[0].per_episode["error_mean_mm"].tolist() == given[2][1]


def test_a_policy_of_another_scene_is_warned_of(tmp_path):
    """The packaged policy was trained on the phantom; the other scene has a smaller ring."""
    other = tmp_path / "other"
    shutil.copytree(PHANTOM, other)
    file = other / "scene.toml"
    file.write_text(file.read_text().replace("diameter_mm = 20.0", "diameter_mm = 18.0", 1))
    told = []
    for scene in (PHANTOM, other):
        EvaluationRequest(("ring",), scene=scene).resolved(told.append)
    assert len(told) == 1
    assert "ring was trained in another scene (phantom_liver) than other" in told[0]


def test_a_beam_beyond_the_limits_of_its_scene_is_warned_of(tmp_path, capsys):
    """The lengths are those of the beam in an episode of the expert, from 6 s to 9 s.

    No task enforces the limits: with the beam too short and too steep the episode is the same."""
    place = tmp_path / "strict"
    shutil.copytree(PHANTOM, place)
    file = place / "scene.toml"
    text = file.read_text().replace("max_incidence_deg = 60.0", "max_incidence_deg = 30.0")
    file.write_text(re.sub(r"standoff_mm = .*", "standoff_mm = [36.0, 60.0]", text))
    said = beam_beyond_limits(open_scene(place))
    found = re.search(r"of 'laser' is (\d+) to (\d+) mm long at the ring \(standoff_mm: 36 ", said)
    task = make_task("circle_ablation")
    episodes, lengths = Episodes(task), []
    state = episodes.seeded(0, 4)
    with torch.inference_mode():
        for step in range(90):
            state, _ = episodes.step(state, task.script(state))
            if step >= 60:
                tip = state.world.arms["laser"].points_mm[:, -1]
                lengths.append((state.world.scene.hit.point_mm - tip).norm(dim=1))
    lengths = torch.stack(lengths)
    assert lengths.min() > float(found[1]) - 1.0
    assert lengths.max() < float(found[2]) + 1.0
    assert re.search(r"up to 33 degrees off the surface's normal \(max_incidence_deg: 30\)", said)
    assert beam_beyond_limits(open_scene(PHANTOM)) == ""
    told = []
    call = {"episodes": 1, "exact_checks": False, "on_warning": told.append}
    config = CircleAblationConfig(world=WorldConfig(dt_s=5.0))
    evaluate("random", "circle_ablation", config=replace(config, scene=place), **call)
    assert told == [said]
    file = tmp_path / "e.toml"
    file.write_text(
        (PHANTOM / "experiments" / "liver.toml").read_text().replace('".."', f'"{place}"')
    )
    assert run(["experiment", "check", str(file)]) == 0
    assert said in " ".join(capsys.readouterr().err.split())


def test_a_run_is_warned_of_that_acts_in_the_world_of_another_one(tmp_path):
    """Two runs on one task: scene, a field, and one arm model of the second differ."""
    first, second = tmp_path / "first", tmp_path / "second"
    for folder in (first, second):
        shutil.copytree(PACKAGED / "ring", folder)
    told = []
    EvaluationRequest((str(first), str(second))).resolved(told.append)
    assert told == []
    scene = second / "scene" / "scene.toml"
    scene.write_text(scene.read_text().replace("diameter_mm = 20.0", "diameter_mm = 18.0", 1))
    about = json.loads((second / "config.json").read_text())
    about["task_config"]["fire_mm"] = 0.75
    about["task_config"]["weights"]["laser"]["fine"] = 3.0
    (second / "config.json").write_text(json.dumps(about))
    model = load_model(second / "arms" / "laser")
    with torch.no_grad():
        next(iter(model.parameters())).add_(0.01)
    save_model(model, second / "arms" / "laser", force=True)
    _, config = EvaluationRequest((str(first), str(second))).resolved(told.append)
    assert config.fire_mm == 0.5
    fields, scenes = told
    assert f"{second} was trained with fire_mm = 0.75 in place of 0.5, another model" in fields
    assert fields.count("in place of") == 1
    assert "another model of the arm 'laser'; it is evaluated" in fields
    assert scenes.startswith(f"{second} was trained in another scene (phantom_liver) than")
    told.clear()
    EvaluationRequest((str(second),)).resolved(told.append)
    assert told == []


def test_the_command_imports_nothing_of_pictures_and_training():
    """Matplotlib and Rerun, which only pages and replays need, and rsl-rl, which only training
    needs, take seconds to import; trimesh, which only meshes of others need, a quarter of one.

    Of the episode 40 steps, in which the beam is on and a part of the ring is cut."""
    code = (
        "import sys; from surgisoft.agents import session; whole = session.rollout; "
        "session.rollout = lambda task, *rest, **more: "
        "(setattr(task, 'steps', 40), whole(task, *rest, **more))[1]; "
        "from surgisoft.cli import run; "
        "assert run('evaluate ring --episodes 1 --no-exact-checks'.split()) == 0; "
        "slow = {'matplotlib', 'rerun', 'rsl_rl', 'tensordict', 'torch', 'torch._dynamo', "
        "'trimesh', 'networkx'}; "
        "print(sorted(slow & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "['torch']"


def test_the_block_of_the_page_drives_the_episodes_of_evaluate(tmp_path, monkeypatch):
    """docs/evaluate.md as it stands: episodes 0 and 1 of seed 7, here 90 steps of a faster ring."""
    page = (Path(__file__).parents[2] / "docs" / "evaluate.md").read_text()
    (block,) = re.findall(r"^```python\n(.*?)^```", page, re.S | re.M)
    packaged = RunFolder("ring")
    shutil.copytree(packaged.path, tmp_path / "runs" / "ring")
    quick = replace(packaged.plan().task_config, cut_s=10.0)

    def brief(task):
        task.steps = 90
        return task

    def rollout_of_brief(task, *given, **named):
        return rollout(brief(task), *given, **named)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(RunFolder, "task", lambda run: brief(make_task("circle_ablation", quick)))
    monkeypatch.setattr(session, "rollout", rollout_of_brief)
    names = {}
    exec(block, names)
    found = evaluate("runs/ring", config=quick, episodes=2, seed=7, exact_checks=False)
    expected = found.results[0].per_episode["beam_error_mean_mm"]
    np.testing.assert_allclose(names["errors"], expected, rtol=0.01)
    assert abs(expected[1] - expected[0]) > 0.02 * expected[0], "two episodes"
    policy, seen = names["policy"], names["seen"]
    both = policy.actions({"laser": np.stack([seen["laser"]] * 2)})["laser"]
    np.testing.assert_allclose(both, [policy.actions(seen)["laser"]] * 2, atol=1e-5)
    with pytest.raises(InputError, match=r"'laser' has shape \(3,\), expected \(\d+,\) or"):
        policy.actions({"laser": np.zeros(3)})
    with pytest.raises(InputError, match=r"unknown agent 'lazer'.*did you mean 'laser'"):
        policy.actions({"lazer": seen["laser"]})


def test_differences_are_those_of_the_same_episodes():
    """The paired t test of scipy; an episode that one policy did not finish is left out."""
    rng = np.random.default_rng(3)
    hard = rng.uniform(1.0, 30.0, 12)
    one, other = hard + rng.normal(0.0, 0.1, 12), hard - 0.5 + rng.normal(0.0, 0.1, 12)
    other[4] = np.nan
    both = [
        Evaluation(name, {"error_mean_mm": error, "success": np.ones(len(error)), **more}, {}, None)
        for name, error, more in (("a", one, {"x": one}), ("b", other[:10], {}))
    ]
    found = differences(*both)
    assert list(found) == ["error_mean_mm"], "of both, and no rate"
    known = np.delete(np.arange(10), 4)
    expected = ttest_rel(other[known], one[known]).confidence_interval(0.95)
    value = found["error_mean_mm"]
    assert value.mean == pytest.approx((other - one)[known].mean())
    assert (value.low, value.high) == pytest.approx((expected.low, expected.high))
    assert (value.least, value.most) == ((other - one)[known].min(), (other - one)[known].max())
    assert value.episodes == 9
    assert value.high < 0.0, "although the two intervals of the means overlap"
    assert summary("error_mean_mm", one).low < summary("error_mean_mm", other).high


def test_a_policy_that_is_given_twice_is_told_and_differences_are_printed(tmp_path, capsys):
    (tmp_path / "short.toml").write_text("[follow]\nloop_s = 0.6\napproach_s = 0.2\n")
    command = ["evaluate", "random", "scripted", "random", "--task", "track_circle"]
    command += ["--config", str(tmp_path / "short.toml"), "--episodes", "2"]
    assert run([*command, "--json", str(tmp_path / "a.json")]) == 0
    said = capsys.readouterr()
    assert "policy random is given more than once; it is evaluated once" in said.err
    found = json.loads((tmp_path / "a.json").read_text())
    one, other = (found["policies"][name]["per_episode"] for name in ("random", "scripted"))
    apart = np.subtract(other["error_mean_mm"], one["error_mean_mm"])
    assert found["differences"]["scripted"]["error_mean_mm"]["mean"] == pytest.approx(apart.mean())
    assert (
        f"scripted minus random, episode by episode: error_mean_mm {apart.mean():.4g} "
        f"({apart.min():.4g} to {apart.max():.4g})\n"
    ) in said.out
