"""Benchmark `robust`: which robot each episode of a batch is on."""

from dataclasses import replace

import numpy as np

from benchmarks.robust import DEFAULT, LEARNS, Case, Method, Robots
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
