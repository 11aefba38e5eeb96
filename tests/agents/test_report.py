"""The page of an evaluation, and what its charts say of logs whose truth is known."""

import json
import math
import re
import shutil
from types import SimpleNamespace

import numpy as np
import pytest

from surgisoft.agents import learning_curves as curves_of
from surgisoft.agents.evaluate import Summary
from surgisoft.agents.learning_curves import learning_curves, metrics_of
from surgisoft.agents.report import in_words, verdict
from surgisoft.agents.report_charts import broken_at_jumps, path_plane
from surgisoft.agents.run_folder import RunFolder
from surgisoft.cli import run
from tests.report.browser import chromium, look

SHORT = ["follow.loop_s=2", "follow.approach_s=0.5"]
"""Fields of `track_circle` with which an episode has 25 steps."""


def test_the_plane_of_a_tilted_circle_shows_a_circle():
    turn = np.linspace(0.0, 2.0 * np.pi, 90)
    flat = 7.0 * np.stack((np.cos(turn), np.sin(turn), 0.0 * turn), 1)
    tilt, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    middle, plane = path_plane(flat[:-1] @ tilt.T + 5.0)
    assert middle == pytest.approx([5.0] * 3, abs=1e-9)
    assert plane.T @ plane == pytest.approx(np.eye(2), abs=1e-9)
    seen = (flat @ tilt.T) @ plane
    assert np.linalg.norm(seen, axis=1) == pytest.approx(7.0)


def test_lines_break_where_the_target_jumps():
    points = np.array([[0.0, 0.0], [1.0, 0.0], [9.0, 0.0], [9.5, 0.0]])
    broken = broken_at_jumps(points)
    assert np.flatnonzero(np.isnan(broken[:, 0])).tolist() == [2]
    assert len(broken) == 5


def test_evaluate_writes_one_self_contained_page(tmp_path, capsys):
    file = tmp_path / "short.toml"
    file.write_text("\n".join(SHORT))
    arguments = ["evaluate", "scripted", "random", "--task", "track_circle", "--episodes", "2"]
    arguments += ["--config", str(file)]
    assert run([*arguments, "--report", str(tmp_path / "r")]) == 0
    assert "report.html" in capsys.readouterr().out
    assert [path.name for path in (tmp_path / "r").iterdir()] == ["report.html"]
    text = (tmp_path / "r" / "report.html").read_text()
    assert "Task track_circle, 2 episodes each. scripted: " in text
    assert "First episode of random" in text
    cards = re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", text)
    assert [name for name, _ in cards] == ["scripted: mean error", "random: mean error"]
    assert f"scripted: mean error {cards[0][1]}; random: mean error {cards[1][1]}." in text
    assert cards[0][1] != cards[1][1]
    assert "Differences from scripted" in text
    assert "random minus scripted" in text
    with chromium() as browser:
        for width in (1280, 400):
            overflow, foreign, broken, _ = look(browser, tmp_path / "r" / "report.html", width)
            assert (overflow, foreign, broken) == (0, [], 0)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two short trainings that are two evaluations long, of other seeds."""
    folder = tmp_path_factory.mktemp("runs")
    for seed in (1, 2):
        options = f"--steps 768 --envs 32 --seed {seed} ppo.evaluation_episodes=2"
        options += f" ppo.evaluate_every=1 -o {folder / f'seed{seed}'}"
        assert run(["train", "--task", "track_circle", *options.split(), *SHORT]) == 0
    return [folder / "seed1", folder / "seed2"]


def test_learning_curves_of_several_runs_are_compared(runs, tmp_path, monkeypatch):
    """Each line against the numbers of the run's own log."""
    drawn = []

    def keep(figure, alt, caption=""):
        drawn.append((figure, alt))
        return plain(figure, alt, caption)

    plain = curves_of.chart
    monkeypatch.setattr(curves_of, "chart", keep)
    names = [str(each) for each in runs]
    assert run(["evaluate", *names, "--episodes", "1", "--report", str(tmp_path / "r")]) == 0
    text = (tmp_path / "r" / "report.html").read_text()
    assert "Learning curves" in text
    assert [alt for _, alt in drawn] == [
        "learning curve: reward of a step",
        "learning curve: error in evaluations [mm]",
    ], "the task has no success"
    for (figure, _), number in zip(drawn, ("reward/arm", "evaluation/error_mm"), strict=True):
        for line, folder in zip(figure.axes[0].lines, runs, strict=True):
            rows = [json.loads(row) for row in (folder / "metrics.jsonl").read_text().splitlines()]
            assert line.get_label() == folder.name
            assert list(line.get_xdata()) == [384.0, 768.0]
            np.testing.assert_allclose(line.get_ydata(), [row[number] for row in rows])


def test_a_damaged_log_costs_its_damaged_lines_only(runs, tmp_path):
    shutil.copytree(runs[0], tmp_path / "run")
    file = tmp_path / "run" / "metrics.jsonl"
    whole = metrics_of(RunFolder(tmp_path / "run"))
    assert [row["steps"] for row in whole] == [384.0, 768.0]
    broken = '[1]\n{"steps": "a"}\n{"steps": 1' + "0" * 400 + '}\n{"ste\n\x00' + "[" * 10**5 + "\n"
    file.write_text(broken + file.read_text())
    assert metrics_of(RunFolder(tmp_path / "run")) == whole
    file.unlink()
    assert metrics_of(RunFolder(tmp_path / "run")) == []
    assert learning_curves([tmp_path / "run"]) == []


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("beam_error_max_mm", "beam error max [mm]"),
        ("healthy_mm2", "healthy [mm²]"),
        ("time_s", "time [s]"),
        ("collided", "collided"),
        ("clearance_mm", "least clearance [mm]"),
    ],
)
def test_numbers_have_names_with_units(name, words):
    assert in_words(name) == words


def test_an_error_that_never_applied_is_no_number_of_the_verdict():
    never = Summary(math.nan, math.nan, math.nan, math.nan, math.nan, 0)
    none, all_ = Summary(0.0, 0.0, 0.2, 0.0, 0.0, 9), Summary(0.4, 0.3, 0.5, 0.1, 0.7, 9)
    found = [
        SimpleNamespace(policy=policy, overall=overall, episodes=9)
        for policy, overall in (
            ("a", {"success": none, "beam_error_mean_mm": never}),
            ("runs/b", {"success": none, "beam_error_mean_mm": all_}),
        )
    ]
    said = verdict("t", found)
    assert said == "Task t, 9 episodes each. a: 0% success; b: 0% success, mean beam error 0.4 mm."


def test_the_verdict_states_the_error_on_the_tissue_where_there_is_one():
    """A gated beam that points exactly may burn beside its place on the moving organ."""
    beam, tissue = (Summary(mean, mean, mean, mean, mean, 9) for mean in (0.002, 0.2))
    overall = {"beam_error_mean_mm": beam, "tissue_error_mean_mm": tissue}
    found = [SimpleNamespace(policy="a", overall=overall, episodes=9)]
    assert verdict("t", found) == "Task t, 9 episodes each. a: mean error on the tissue 0.2 mm."
