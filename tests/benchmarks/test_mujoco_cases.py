"""The arm in MuJoCo against closed forms, and what its generator of cases has."""

import math

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="MuJoCo is not installed (pip install 'mujoco>=3.9,<4')")

import mujoco

from benchmarks import rig_cases
from benchmarks.generators import Setup
from benchmarks.mujoco_arm.hidden import HIDDEN, switch_on
from benchmarks.mujoco_arm.motion import STEP_S, Arm, regulated
from benchmarks.mujoco_arm.rig import MujocoRig
from benchmarks.mujoco_arm.robot import BUILDS, LINKS, make_robot
from benchmarks.mujoco_cases import GENERATOR, UNKNOWN
from benchmarks.rig_cases import KNOWN, LATER_KNOWN, cases

ROBOT = 801
"""A level arm with four chambers."""


def even_arm(**fields):
    """The level arm with equal joints and chambers across it, without weight and hidden effects."""
    plant = make_robot(ROBOT).plant
    count = len(plant.areas)
    equal = {name: np.full(LINKS, getattr(plant, name).mean()) for name in ("bend", "axial")}
    about = {
        "angles": 0.5 * np.pi * np.arange(count),
        "offset": np.full(count, plant.offset.mean()),
        "areas": np.full(count, plant.areas.mean()),
        "gravity": np.zeros(3),
        "stiffening": 0.0,
        "keys": np.arange(1, LINKS + 1),
    }
    return plant._replace(**equal | about | fields)


def settled(arm, shares, seconds=4.0):
    """Key points (n, 3) [m] after a time under shares (m,) of the limit in the chambers."""
    targets = np.tile(arm.plant.high * np.asarray(shares), (round(seconds / 0.05), 1))
    return arm.run(targets, 0.05).points[-1]


def turned(arm):
    """Angle [rad] between the last link and the axis."""
    axis = arm.data.body(f"link{LINKS - 1}").xmat.reshape(3, 3)[:, 2]
    return math.acos(min(axis[2], 1.0))


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_a_chamber_bends_every_joint_by_its_couple_over_the_stiffness(share):
    """N p A d / k of N joints of stiffness k under the couple p A d, at large angles, too."""
    plant = even_arm(axial=np.full(LINKS, 1e6))
    arm = Arm(plant)
    settled(arm, [share, 0.0, 0.0, 0.0])
    couple = share * plant.high * plant.areas[0] * plant.offset[0]
    # The way from a site h before a joint to one h behind it, d off the axis: its derivative by
    # the joint's angle a is d cos(a / 2) - h sin(a / 2).
    lean = 0.5 * plant.length / LINKS / plant.offset[0]
    angle = couple / plant.bend[0]
    for _ in range(20):
        angle = couple * (math.cos(0.5 * angle) - lean * math.sin(0.5 * angle)) / plant.bend[0]
    assert turned(arm) == pytest.approx(LINKS * angle, rel=0.01)


def test_equal_pressures_stretch_the_arm_by_their_force_over_its_stiffness():
    plant = even_arm()
    points = settled(Arm(plant), [0.5] * 4)
    force = 4 * 0.5 * plant.high * plant.areas[0]
    assert points[-1, 2] - plant.length == pytest.approx(LINKS * force / plant.axial[0], rel=0.01)
    np.testing.assert_allclose(points[:, :2], 0.0, atol=1e-6)


def test_a_small_weight_at_the_tip_bends_a_level_arm_as_hinged_rods():
    """Sum of (L - z)^2 F / k over joints at z; a cantilever's F L^3 / (3 E I) in the limit."""
    gravity = np.array([0.0, 9.81, 0.0])
    plant, mass = even_arm(gravity=gravity, mass=1e-9), 2e-3
    sag = settled(Arm(plant._replace(payload=np.array([mass, math.pi / 2]))), [0.0] * 4)[-1, 1]
    arms = plant.length * (1.0 - (np.arange(LINKS) + 0.5) / LINKS)
    closed = mass * 9.81 * np.sum(arms**2) / plant.bend[0]
    assert sag == pytest.approx(closed, rel=0.01)
    beam = mass * 9.81 * plant.length**3 / (3.0 * plant.bend[0] * plant.length / LINKS)
    assert closed == pytest.approx(beam, rel=0.01)


def test_energy_falls_without_pressure():
    """The arm is let go where it was bent; kinetic and potential energy fall to those at rest."""
    arm = Arm(make_robot(800).plant)
    arm.model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    settled(arm, [1.0, 0.0, 0.0])
    arm.data.act[:], arm.data.ctrl[:] = 0.0, 0.0
    energies = []
    for _ in range(400):
        mujoco.mj_step(arm.model, arm.data)
        mujoco.mj_energyPos(arm.model, arm.data)
        mujoco.mj_energyVel(arm.model, arm.data)
        energies.append(arm.data.energy.sum())
    fall = energies[0] - energies[-1]
    assert fall > 0.0
    assert np.diff(energies).max() < 1e-3 * fall


def test_half_the_step_changes_the_motion_by_less_than_the_noise():
    robot, rig = make_robot(800), MujocoRig(800, noise=0.0)
    protocol = rig_cases.excitation(rig, "tried", ("wander", "sets"), 8.0, 800)
    samples = np.array_split(np.arange(round(8.0 / rig.period_s)), len(protocol.commands))
    held = [len(part) for part in samples]
    targets = 1e3 * np.repeat(protocol.commands, held, axis=0)
    points = [
        Arm(robot.plant, step=step).run(targets, rig.period_s).points
        for step in (STEP_S, 0.5 * STEP_S)
    ]
    way_mm = 1e3 * np.ptp(points[0][:, -1], axis=0).max()
    error_mm = 1e3 * np.sqrt(np.mean(np.sum((points[1] - points[0]) ** 2, axis=2)))
    assert way_mm > 20.0
    assert error_mm < math.hypot(robot.cameras.white_mm, robot.cameras.slow_mm)


def test_dry_friction_holds_a_joint_within_its_couple():
    """Pressure less than friction does not bend the arm; after more, and back, it stays bent."""
    plant = even_arm()
    couple = plant.high * plant.areas[0] * plant.offset[0]
    arm = Arm(plant._replace(friction=np.full(LINKS, 0.2 * couple)))
    settled(arm, [0.1, 0.0, 0.0, 0.0], 1.0)
    assert turned(arm) < 0.05 * LINKS * plant.reach * 0.1
    settled(arm, [0.6, 0.0, 0.0, 0.0], 2.0)
    loaded = turned(arm)
    settled(arm, [0.0] * 4, 2.0)
    assert 0.3 < turned(arm) / loaded < 0.6  # 0.2 of 0.6 - 0.2, less what slides slowly


def test_a_regulator_settles_at_its_set_point_and_overshoots_as_damped():
    """Overshoot exp(-pi z / sqrt(1 - z^2)) of a second-order system (Ogata 2010)."""
    answer = regulated(np.ones((4000, 1)), 1e-3)[:, 0]
    assert answer[-1] == pytest.approx(1.0, abs=1e-6)
    overshoot = math.exp(-math.pi * 0.8 / math.sqrt(1.0 - 0.8**2))
    assert answer.max() - 1.0 == pytest.approx(overshoot, rel=0.02)


def test_a_bladder_whose_parts_touch_at_exponential_pressures():
    """Its push is the integral of the part that touches; far above, it lacks the mean."""
    arm = Arm(even_arm(touch=0.1 * even_arm().high))
    air = np.array([0.0, 0.05, 0.3, 1.0])
    grid = np.linspace(0.0, air, 20_001)
    push = np.trapezoid(1.0 - np.exp(-grid / 0.1), grid, axis=0)
    np.testing.assert_allclose(arm.push(air), push, atol=1e-6)
    assert arm.push(air)[-1] == pytest.approx(0.9, abs=1e-4)


def test_pressures_alike_bulge_no_wall():
    arm = Arm(even_arm(bulge=0.2))
    np.testing.assert_allclose(arm.push(np.full(4, 0.7)), 0.7)
    push = arm.push(np.array([0.8, 0.0, 0.0, 0.0]))
    assert push[0] == pytest.approx(0.8 * (1.0 + 0.2 * np.cbrt(0.8)))


def test_the_generator_has_every_known_effect_and_no_name_for_the_others():
    assert set(HIDDEN) == {*KNOWN, *LATER_KNOWN, *UNKNOWN}
    planned = cases(GENERATOR, [800, 801], 29, seed=1)
    assert {case.names[0] for case in planned if len(case.names) == 1} == {*HIDDEN} - {*LATER_KNOWN}
    assert {build.chambers for build in BUILDS} == {3, 4, 6}


def test_every_effect_changes_the_motion_and_nothing_else_does():
    """Without any the motion is equal to the last bit. Rests between short runs let the moments of
    sudden effects pass."""
    rig = MujocoRig(804, noise=0.0)
    protocol = rig_cases.excitation(rig, "tried", ("steps",) * 5, 6.0, 804)
    plain = rig.record(protocol)[1].noise_free_mm
    again = MujocoRig(804, noise=0.0).record(protocol)[1].noise_free_mm
    np.testing.assert_array_equal(again, plain)
    for name in HIDDEN:
        moved = MujocoRig(804, noise=0.0, hidden=[(name, 2.0)]).record(protocol)[1]
        share = rig_cases.change_mm(moved.noise_free_mm, plain) / rig.arm.length_mm
        assert 3e-4 < share < 0.3, name


def test_a_hidden_effect_leaves_the_robot_as_it_is():
    """Robots are made once and shared."""
    before = make_robot(804).plant.areas.copy()
    switch_on(Setup(make_robot(804).plant), [("gain_mismatch", 1.0)], 804)
    np.testing.assert_array_equal(make_robot(804).plant.areas, before)
