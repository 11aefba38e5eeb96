"""Reach tables against closed forms of the arc; inverse kinematics against known solutions."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from surgisoft.errors import InputError
from surgisoft.scene.reach import ArmReach, nearest_commands, solve_aim
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import ConstantCurvature
from surgisoft.surrogate.reach import model_table
from tests.scene.arc_table import constant_curvature_table

LENGTH_MM = 70.0
TABLE = constant_curvature_table(LENGTH_MM)
REACH = ArmReach(*TABLE, np.zeros(3), 7.5)


def arc(commands):
    """Tips and directions of exact arcs, by rotating about the arc's centre (not as the table)."""
    x, y, extension = commands.T
    bend = np.pi / 2 * np.stack((x * np.sqrt(1 - y**2 / 2), y * np.sqrt(1 - x**2 / 2)), axis=1)
    tips, directions = [], []
    for (bx, by), longer in zip(bend, extension, strict=True):
        angle = np.hypot(bx, by)
        radius = LENGTH_MM * (1 + longer) / angle
        u = np.array([bx, by]) / angle
        tips.append([*(radius * (1 - np.cos(angle)) * u), radius * np.sin(angle)])
        directions.append([*(np.sin(angle) * u), np.cos(angle)])
    return np.array(tips), np.array(directions)


def random_commands(seed, count):
    rng = np.random.default_rng(seed)
    return REACH.bounds[0] + rng.random((count, 3)) * REACH.span


@given(seed=st.integers(0, 1000))
def test_the_table_interpolates_the_arc(seed):
    commands = random_commands(seed, 50)
    tips, directions = arc(commands)
    lines, ends = REACH.shapes(commands)
    # linear between samples 4.5 degrees apart: sagitta of 70 mm over that angle, 0.05 mm
    np.testing.assert_allclose(lines[:, -1], tips, atol=0.06)
    np.testing.assert_allclose(ends, directions, atol=1e-3)
    steps = np.linalg.norm(np.diff(lines, axis=1), axis=2).sum(axis=1)
    np.testing.assert_allclose(steps, LENGTH_MM * (1 + commands[:, 2]), rtol=3e-3)


def test_bends_reach_ninety_degrees_to_every_side():
    bend = np.arccos(np.clip(REACH.tip_direction[:, 2], -1, 1))
    assert bend.max() == pytest.approx(np.pi / 2)
    rim = REACH.tip_direction[bend > np.radians(89.0)]
    turn = np.sort(np.arctan2(rim[:, 1], rim[:, 0]))
    assert np.diff(turn).max() < np.radians(7.0)


@given(seed=st.integers(0, 1000), distance=st.floats(20.0, 60.0))
def test_aim_hits_every_target_that_some_arm_hits(seed, distance):
    tips, directions = REACH.tips(random_commands(seed, 40))
    targets = tips + distance * directions
    found = solve_aim(REACH, targets, nearest_commands(REACH, targets, (15.0, 65.0)))
    tips, directions = REACH.tips(found.commands)
    away = targets - tips
    across = np.linalg.norm(np.cross(away, directions), axis=1)
    assert found.on_target.all()
    assert across.max() <= 0.02
    assert np.all(found.commands >= REACH.bounds[0])
    assert np.all(found.commands <= REACH.bounds[1])


def test_neighbouring_targets_have_neighbouring_solutions():
    around = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
    ring = np.stack((10 * np.cos(around), 10 * np.sin(around), 0 * around + 110.0), axis=1)
    found = solve_aim(REACH, ring, np.tile(REACH.rest, (72, 1)))
    lines, _ = REACH.shapes(found.commands)
    assert found.on_target.all()
    assert np.linalg.norm(np.roll(lines, -1, axis=0) - lines, axis=2).max() < 0.5
    np.testing.assert_allclose(found.commands[:, 2], 0.0, atol=1e-3)  # no need to stretch


def test_what_lies_behind_is_not_on_target():
    target = np.array([[0.0, 0.0, -40.0]])
    assert not solve_aim(REACH, target, REACH.rest[None]).on_target.any()


def test_a_fitted_model_makes_the_same_table_as_its_arcs():
    """Three chambers whose model is exactly a constant-curvature arc, against its own forward."""
    low, high = torch.zeros(3), torch.full((3,), 60.0)
    network = ConstantCurvature(low, high, 5)
    rest = torch.tensor([[0.0, 0.0, z] for z in (0.0, 17.5, 35.0, 52.5, 70.0)])
    network.set_rest(rest)
    turn = 2.0 * np.pi * np.arange(3) / 3
    with torch.no_grad():
        network.table[0, 0, :3] = torch.tensor(0.5 * np.cos(turn))
        network.table[0, 1, :3] = torch.tensor(0.5 * np.sin(turn))
    model = ArmModel(ArmSpec(3, 5, (0.0,) * 3, (60.0,) * 3), network, rest_mm=rest)
    axes, lines, directions = model_table(model)
    reach = ArmReach(axes, lines, directions, np.array(model.spec.rest), 7.5)
    commands = torch.tensor([[60.0, 0.0, 0.0], [60.0, 60.0, 0.0], [30.0, 30.0, 30.0]])
    exact = network(commands, torch.zeros(3, 3)).detach().numpy()
    found, ends = reach.shapes(commands.double().numpy())
    np.testing.assert_allclose(found[:, -1], exact[:, -1], atol=0.05)
    np.testing.assert_allclose(found[2, -1], [0.0, 0.0, 70.0], atol=0.05)
    # one chamber at 60 of 0..60 kPa, two at 0: a bend of |0.5 - 0.5 cos 120 - ...| = 1 rad
    np.testing.assert_allclose(np.arccos(ends[0, 2]), 1.0, atol=0.02)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda t: (t[0], t[1][:5], t[2]), "centrelines have shape"),
        (lambda t: (t[0], t[1], t[2][:5]), "tip directions have shape"),
        (lambda t: (t[0], t[1] * np.nan, t[2]), "NaN"),
        (lambda t: ((t[0][0][:1], *t[0][1:]), t[1], t[2]), "at least 2 rising"),
    ],
)
def test_a_broken_table_is_one_line(change, says):
    with pytest.raises(InputError, match=says):
        ArmReach(*change(TABLE), np.zeros(3), 7.5)
