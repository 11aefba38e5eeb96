"""The page of an evaluation, and what its charts say of logs whose truth is known."""

import math
from types import SimpleNamespace

import numpy as np
import pytest

from surgisoft.agents.evaluate import Summary
from surgisoft.agents.report import in_words, verdict
from surgisoft.agents.report_charts import broken_at_jumps, path_plane
from surgisoft.cli import run
from tests.report.browser import chromium, look


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
    arguments = ["evaluate", "scripted", "random", "--task", "track_circle", "--episodes", "2"]
    assert run([*arguments, "--report", str(tmp_path / "r")]) == 0
    assert "report.html" in capsys.readouterr().out
    assert [path.name for path in (tmp_path / "r").iterdir()] == ["report.html"]
    text = (tmp_path / "r" / "report.html").read_text()
    assert "Task track_circle, 2 episodes each. scripted: " in text
    assert "First episode of random" in text
    with chromium() as browser:
        for width in (1280, 400):
            overflow, foreign, broken, _ = look(browser, tmp_path / "r" / "report.html", width)
            assert (overflow, foreign, broken) == (0, [], 0)


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
    assert said == "Task t, 9 episodes each. a: 0% success; b: 0% success, mean error 0.4 mm."
