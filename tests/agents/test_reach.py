"""A path that the arm cannot reach: the hint of `evaluate`, against geometry."""

import math

import pytest
import torch

from surgisoft.cli import run
from surgisoft.tasks.path_following import FollowConfig
from surgisoft.tasks.registry import make_task
from surgisoft.tasks.track import TrackConfig, track_circle

FLAT = """
import numpy as np

class Arm:
    static = True
    low, high, error_mm = (0.0, 0.0), (60.0, 60.0), 0.1

    def __call__(self, time_s, actuation):
        tip = np.stack([actuation[:, 0] - actuation[:, 1], 0 * actuation[:, 0]], 1)
        share = np.linspace(0, 1, 5)
        across = tip[:, None] * share[:, None] ** 2
        along = np.broadcast_to(70.0 * share, across.shape[:2])
        return np.concatenate([across, along[..., None]], axis=-1)

arm = Arm()
"""
"""An arm of two chambers whose tip moves on a line: x from -60 to 60 mm, y = 0, z = 70 mm."""

OPPOSED = """
import numpy as np

class Arm:
    static = True
    low, high, error_mm = (0.0,) * 4, (60.0,) * 4, 0.5

    def __call__(self, time_s, kPa):
        bend = (kPa[:, :2] - kPa[:, 2:]) * 3e-4
        length = 60.0 + 0.02 * kPa.sum(1)
        curvature = np.hypot(bend[:, 0], bend[:, 1]) + 1e-9
        angle = np.linspace(0, 1, 5) * (length * curvature)[:, None]
        aside = (1 - np.cos(angle)) / curvature[:, None]
        across = aside[..., None] * (bend / curvature[:, None])[:, None]
        along = np.sin(angle) / curvature[:, None]
        return np.concatenate([across, along[..., None]], axis=-1)

arm = Arm()
"""
"""An arm of constant curvature and four opposed chambers; where one is at 0 the other bends."""


@pytest.fixture
def flat(tmp_path):
    file = tmp_path / "flat.py"
    file.write_text(FLAT)
    return f"{file}:arm"


def test_the_distance_of_a_circle_from_a_line(flat):
    """Points of a circle of radius 10 mm about a point of the line are 10 |sin| mm away from it."""
    off = track_circle(TrackConfig(FollowConfig(arm=flat))).out_of_reach_mm()
    angle = 2 * math.pi * torch.arange(40) / 40
    assert sorted(off.tolist()) == pytest.approx(
        sorted((10 * angle.sin().abs()).tolist()), abs=1e-3
    )


@pytest.mark.parametrize("task", ["track_circle", "track_square", "laser_plane"])
def test_the_default_arm_reaches_its_paths(task):
    assert make_task(task).out_of_reach_mm().max() < 0.01


@pytest.mark.parametrize("size_mm", [20.0, 30.0])
def test_opposed_chambers_at_their_lower_limits_reach_a_circle(tmp_path, size_mm):
    """15 mm aside at the path's height of 61.6 mm the arc bends by 2 atan(15 / 61.6) = 0.48 and is
    64.0 mm long: the chambers of a pair differ by 25 kPa and all four sum to 200 of 240 kPa."""
    file = tmp_path / "opposed.py"
    file.write_text(OPPOSED)
    task = track_circle(TrackConfig(FollowConfig(arm=f"{file}:arm", size_mm=size_mm)))
    assert task.out_of_reach_mm().max() < 0.01


def test_evaluate_warns_of_a_path_out_of_reach(flat, capsys):
    """38 of the 40 points are more than 0.1 mm off, and 2 / pi of 10 mm is the mean."""
    command = ["evaluate", "random", "--task", "track_circle", "--episodes", "1"]
    assert run([*command, "--arm", flat]) == 0
    said = capsys.readouterr().err
    assert (
        "95 % of the path of track_circle is out of the arm's reach, by up to 10.00 mm (mean over "
        "the path 6.35 mm)" in said
    )
    assert run(command) == 0
    assert "reach" not in capsys.readouterr().err
