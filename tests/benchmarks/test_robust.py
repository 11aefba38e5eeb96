"""Benchmark `robust`: which robot each episode of a batch is on, and the parts of the error."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from benchmarks.robust import (
    DEFAULT,
    IMPROVED,
    LEARNS,
    OWN,
    Case,
    Method,
    Robots,
    Row,
    Study,
    markdown,
    robust_task,
)
from benchmarks.robust_estimates import Measured, errors_mm, unfiltered
from benchmarks.robust_floor import Floor
from benchmarks.robust_parts import parts
from surgisoft.agents.on_rig import RigConfig, on_rig
from surgisoft.errors import InputError
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.reach import steady_key_points
from surgisoft.tasks.laser_work import LASER
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


@pytest.mark.parametrize("given", ["robots", "own", "improved", "hidden_robots"])
def test_no_model_or_policy_is_judged_on_a_robot_of_the_development(given):
    sets = dict.fromkeys(("robots", "own", "improved", "hidden_robots"), (21,))
    rest = {"episodes": 1, "hidden_methods": (), "hidden_episodes": 1, "hidden": ()}
    Study((CASE.method,), **sets, **rest)
    with pytest.raises(InputError, match="robots 20 took part in the development"):
        Study((CASE.method,), **{**sets, given: (21, 20)}, **rest)


def test_each_model_of_a_robot_has_a_row_of_its_own():
    method = CASE.method
    study = Study((method,), (21,), (21,), (21,), 2, (), (), 1, ())
    numbers = {"pointing_error_mm": [0.2, 0.2], "pointing_error_p95_mm": [0.3, 0.3]}
    numbers |= {"share_on": [0.7, 0.7], "clearance_mm": [23.0, 23.0], "contact": [False, False]}
    rows = [
        Row(method.name, model, 21, "", cut=[True, cut], beam_error_mm=[error, error], **numbers)
        for model, cut, error in ((DEFAULT, True, 0.3), (OWN, True, 0.2), (IMPROVED, False, 0.1))
    ]
    lines = markdown(rows, [Floor(0.5, 0.3, 0.1)], study).splitlines()
    table = [line for line in lines if line.startswith("| scripted")]
    assert [line.split(" | ")[1:4] for line in table] == [
        ["of the package", "2 of 2 (34 to 100 %)", "0.300"],
        ["of the robot", "2 of 2 (34 to 100 %)", "0.200"],
        ["of the package, improved", "1 of 2 (9 to 91 %)", "0.100"],
    ]


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


def test_the_error_of_an_estimate_is_that_of_its_beam():
    """Estimates that are shifted by 0.3 mm across the beam, of recordings of two lengths."""
    task, every = robust_task(None, 3), []
    arm = task.world.arms[LASER]
    pose = arm.pose
    for steps, shift_mm in ((40, 0.3), (30, 0.0)):
        at = np.random.default_rng(steps).uniform(0.0, 40.0, (steps, 3))
        body = torch.tensor(steady_key_points(arm.model, at), dtype=torch.float32)
        true = body @ pose[:3, :3].mT + pose[:3, 3]
        axis = arm.backbone.tip_direction(true)
        across = torch.linalg.cross(axis, torch.tensor([0.0, 0.0, 1.0]).expand_as(axis))
        off = shift_mm * torch.nn.functional.normalize(across, dim=1)[:, None].expand_as(true)
        target = true[:, -1] + 50.0 * axis
        row = (off @ pose[:3, :3], torch.tensor(at), body, pose, true[10:], target[10:])
        every.append(Measured(*row))
    np.testing.assert_allclose(errors_mm(task, every, unfiltered), [0.3, 0.0], atol=1e-4)
