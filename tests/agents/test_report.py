"""The page of an evaluation, and what its charts say of logs whose truth is known."""

import numpy as np
import pytest

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
    assert "track_circle, 2 episodes each. scripted: " in text
    assert "First episode of random" in text
    with chromium() as browser:
        for width in (1280, 400):
            overflow, foreign, broken, _ = look(browser, tmp_path / "r" / "report.html", width)
            assert (overflow, foreign, broken) == (0, [], 0)
