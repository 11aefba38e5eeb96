"""Benchmark `robust`: which robot each episode of a batch is on, and the parts of the error."""

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.robust import DEFAULT, LEARNS, Case, Method, Robots
from benchmarks.robust_parts import parts
from surgisoft.agents.on_rig import RigConfig, on_rig
from surgisoft.rig import VirtualRig
from surgisoft.tasks.registry import make_task
from surgisoft.tasks.world.random_streams import streams

CASE = Case(Method("scripted", "scripted", LEARNS), DEFAULT, 21, "", 2, 2000, False, 3)
"""Two episodes of robot 21."""


def tip_mm(rig):
    """(3,) mm: the tip without noise at 20 kPa in the first chamber."""
    rig.reset()
    rig.command(np.array([20.0, 0.0, 0.0]))
    for _ in range(60):
        _, truth = rig.read_beside_truth()
    return truth.noise_free_mm[0, -1]


def test_each_episode_is_on_the_robot_of_its_case():
    """As robots of the seeds and hidden effects move; a second arm is served as the first."""
    cases = [CASE, replace(CASE, robot=22, hidden="twist")]
    place = on_rig(make_task("track_circle"), RigConfig(settle_s=0.1), Robots(cases))
    twisted = VirtualRig(22, hidden=(("twist", 1.0),))
    wanted = [tip_mm(VirtualRig(21))] * 2 + [tip_mm(twisted)] * 2
    for _ in range(2):
        arms = place.world.start(streams(2000, 4)).arms
        found = [tip_mm(rig) for rig in arms["arm"].plant.rigs.items]
        np.testing.assert_allclose(found, wanted, atol=0.05)


def test_the_parts_of_an_error_are_those_of_a_known_one():
    """A steady error of 3 mm of the estimate; a controller 4 mm off that shakes by 1 mm."""
    steps = 400
    shaking = np.where(np.arange(steps) % 2, 1.0, -1.0)[:, None] * [0.0, 0.0, 1.0]
    estimated = shaking + np.array([0.0, 4.0, 0.0])
    found = parts(estimated + np.array([3.0, 0.0, 0.0]), estimated, 20)
    assert found.estimate_error_mm == pytest.approx(3.0)
    assert found.estimate_error_slow_mm == pytest.approx(3.0)
    assert found.estimate_error_quick_mm == pytest.approx(0.0, abs=1e-12)
    assert found.control_mm == pytest.approx(17.0**0.5)
    assert found.control_slow_mm == pytest.approx(4.0, abs=0.01)
    assert found.control_quick_mm == pytest.approx(1.0, abs=0.01)
    assert found.true_mm == pytest.approx(26.0**0.5)
