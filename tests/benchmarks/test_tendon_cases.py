"""The arm that tendons bend against closed forms, and what its generator of cases has."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

pytest.importorskip("mujoco", reason="MuJoCo is not installed (pip install 'mujoco>=3.9,<4')")

from benchmarks import rig_cases
from benchmarks.generators import Setup
from benchmarks.rig_cases import FURTHER_KNOWN, KNOWN, LATER_KNOWN, Case, cases
from benchmarks.tendon_arm.hidden import HIDDEN, switch_on
from benchmarks.tendon_arm.motion import GAP, STEP_S, Arm, new_line, served, taut, tighten
from benchmarks.tendon_arm.rig import TendonRig
from benchmarks.tendon_arm.robot import BUILDS, make_robot
from benchmarks.tendon_cases import GENERATOR, UNKNOWN

ROBOT = 1001
"""A level arm with four tendons."""
LINKS = BUILDS[ROBOT % len(BUILDS)].links


def even_arm(**fields):
    """The level arm with equal joints and tendons across it, without weight and friction."""
    plant = make_robot(ROBOT).plant
    count = len(plant.offset)
    equal = {name: np.full(count, getattr(plant, name).mean()) for name in ("offset", "pull")}
    about = {
        "bend": np.full(LINKS, plant.bend.mean()),
        "angles": 0.5 * np.pi * np.arange(count),
        "tight": np.full(count, plant.tight.mean()),
        "gravity": np.zeros(3),
        "friction": 0.0,
        "keys": np.arange(1, LINKS + 1),
    }
    return plant._replace(**equal | about | fields)


def settled(arm, shares, seconds=4.0):
    """Key points (n, 3) [m] after a time under shares (m,) of the limit of pull."""
    targets = np.tile(arm.plant.high * np.asarray(shares), (round(seconds / 0.05), 1))
    return arm.run(targets, 0.05).points[-1]


def turned(arm):
    """Angle [rad] between the last link and the axis."""
    axis = arm.data.body(f"link{LINKS - 1}").xmat.reshape(3, 3)[:, 2]
    return math.acos(min(axis[2], 1.0))


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_a_tendon_bends_every_joint_by_its_tension_times_its_lever(share):
    """Over a joint at angle a, d off the axis and h / 2 before and behind it, a tendon is
    h cos(a / 2) - 2 d sin(a / 2) long; its lever is the derivative by the angle."""
    plant = even_arm()
    plant = plant._replace(pull=plant.pull * [1, 0, 0, 0], tight=np.zeros(4))
    arm = Arm(plant)
    settled(arm, [share, 0.0, 0.0, 0.0])
    gap, d = GAP * plant.length / LINKS, plant.offset[0]

    def rest(angle):
        shorter = LINKS * (gap * (1.0 - math.cos(0.5 * angle)) + 2.0 * d * math.sin(0.5 * angle))
        lever = d * math.cos(0.5 * angle) + 0.5 * gap * math.sin(0.5 * angle)
        return plant.pull[0] * (share * plant.high - shorter) * lever - plant.bend[0] * angle

    assert turned(arm) == pytest.approx(LINKS * brentq(rest, 0.0, 1.0), rel=1e-3)


def test_equal_pulls_tighten_a_straight_arm_and_do_not_bend_it():
    plant = even_arm()
    arm = Arm(plant)
    points = settled(arm, [0.5] * 4)
    np.testing.assert_allclose(points[:, :2], 0.0, atol=1e-6)
    force = plant.pull[0] * (plant.tight[0] + 0.5 * plant.high)
    np.testing.assert_allclose(arm.line.force, force, rtol=1e-6)


def test_a_small_weight_at_the_tip_bends_a_level_arm_as_hinged_rods():
    """Sum of (L - z)^2 F / k over joints at z."""
    plant, mass = even_arm(gravity=np.array([0.0, 9.81, 0.0]), mass=1e-9, pull=np.zeros(4)), 2e-4
    sag = settled(Arm(plant._replace(payload=np.array([mass, math.pi / 2]))), [0.0] * 4)[-1, 1]
    arms = plant.length * (1.0 - (np.arange(LINKS) + 0.5) / LINKS)
    assert sag == pytest.approx(mass * 9.81 * np.sum(arms**2) / plant.bend[0], rel=0.01)


def first_mode_hz(plant):
    """Frequency at which the tip swings after a push aside, without tendons [Hz]."""
    arm = Arm(plant._replace(pull=np.zeros(len(plant.pull)), viscous_s=1e-3))
    arm.data.qpos[:: arm.joints.shape[1]] = 0.01 * np.linspace(1.0, 0.1, LINKS)
    tip = arm.run(np.zeros((400, 4)), 0.005).points[:, -1, 1]
    crossings = 0.005 * np.flatnonzero(np.diff(np.sign(tip)))
    return 0.5 / np.mean(np.diff(crossings))


def test_the_first_mode_is_that_of_a_cantilever():
    """3.516 sqrt(E I / (m L^3)) / (2 pi) (Blevins 1979)."""
    plant = even_arm()
    beam = plant.bend[0] * plant.length / LINKS
    expected = 3.516 * math.sqrt(beam / (plant.mass * plant.length**3)) / (2.0 * math.pi)
    assert first_mode_hz(plant) == pytest.approx(expected, rel=0.05)


def test_a_balanced_mass_slows_the_arm_and_does_not_pull_it_down():
    """At the tip it is as heavy for the first mode as about four times its share of the arm's
    mass: m L^3 in place of 33 / 140 m L^3 (Rayleigh 1877)."""
    plant = even_arm()
    heavy = plant._replace(balanced=np.array([plant.mass, LINKS]))
    ratio = first_mode_hz(heavy) / first_mode_hz(plant)
    assert ratio == pytest.approx(math.sqrt(33.0 / 140.0 / (1.0 + 33.0 / 140.0)), rel=0.05)
    gravity = np.array([0.0, 9.81, 0.0])
    sags = [settled(Arm(one._replace(gravity=gravity)), [0.0] * 4)[-1, 1] for one in (plant, heavy)]
    assert sags[1] == pytest.approx(sags[0], rel=1e-3)


def test_half_the_step_changes_the_motion_by_less_than_the_noise():
    robot, rig = make_robot(1000), TendonRig(1000, noise=0.0)
    protocol = rig_cases.excitation(rig, "tried", ("wander", "sets"), 8.0, 1000)
    samples = np.array_split(np.arange(round(8.0 / rig.period_s)), len(protocol.commands))
    held = [len(part) for part in samples]
    targets = 1e-3 * np.repeat(protocol.commands, held, axis=0)
    points = [
        Arm(robot.plant, step=step).run(targets, rig.period_s).points
        for step in (STEP_S, 0.5 * STEP_S)
    ]
    way_mm = 1e3 * np.ptp(points[0][:, -1], axis=0).max()
    error_mm = 1e3 * np.sqrt(np.mean(np.sum((points[1] - points[0]) ** 2, axis=2)))
    assert way_mm > 20.0
    assert error_mm < 0.01 * way_mm


def test_tension_falls_from_hole_to_hole_as_about_a_drum():
    """exp(-friction times angle) each (Euler 1775), once a tendon has slid far enough."""
    plant = even_arm(friction=0.2)
    count = len(plant.offset)
    lengths = np.full(int(plant.ends.sum()), GAP * plant.length / LINKS)
    line = new_line(plant, np.full(count, LINKS * lengths[0]))
    still, joints = np.full(count, plant.high), np.zeros((LINKS, 2))
    for shorter in (1.0, 1.0 - 10.0 * plant.slip / lengths[0]):
        moving = shorter < 1.0
        tighten(plant, line, still, still, 0.0, shorter * lengths, joints, STEP_S, moving)
    holes = np.arange(LINKS)
    expected = np.exp(-0.2 * (plant.sheath + plant.wrap * holes))
    np.testing.assert_allclose(line.tension[:LINKS] / line.force[0], expected, rtol=1e-9)


def test_a_tendon_sags_before_it_pulls_and_never_pushes():
    """A parabola, and then a line that touches it and lacks half of the sag."""
    assert taut(-1e-3, 0.0) == taut(-1e-3, 2e-3) == 0.0
    assert taut(3e-3, 0.0) == 3e-3
    assert taut(1e-3, 2e-3) == pytest.approx(0.25e-3)
    assert taut(5e-3, 2e-3) == pytest.approx(4e-3)
    assert taut(2e-3 - 1e-9, 2e-3) == pytest.approx(taut(2e-3 + 1e-9, 2e-3), abs=1e-8)


def test_play_of_a_motor_is_lost_at_each_reversal():
    """Up to a pull and back by less than the play, the arm stays where it was."""
    plant = even_arm()
    arm = Arm(plant._replace(backlash=np.array([0.2 * plant.high, 0.0, 0.0, 0.0])))
    free = Arm(plant)
    targets = plant.high * np.repeat([0.8, 0.65], 100)[:, None] * [1.0, 0.0, 0.0, 0.0]
    tips, plain = (one.run(targets, 0.05).points[:, -1, 0] for one in (arm, free))
    assert tips[-1] == pytest.approx(tips[99], abs=1e-6)
    assert abs(plain[-1] - plain[99]) > 2e-3
    less = 0.1 * plant.high * np.array([1.0, 0.0, 0.0, 0.0])
    pulled = Arm(plant).run(targets - less, 0.05).points[99, -1, 0]
    assert tips[99] == pytest.approx(pulled, abs=1e-6)


def test_a_servomotor_settles_at_its_set_point_and_overshoots_as_damped():
    """Overshoot exp(-pi z / sqrt(1 - z^2)) of a second-order system (Ogata 2010)."""
    answer = served(np.ones((4000, 1)), 1e-3, np.array([30.0, 0.8]))[:, 0]
    assert answer[-1] == pytest.approx(1.0, abs=1e-6)
    overshoot = math.exp(-math.pi * 0.8 / math.sqrt(1.0 - 0.8**2))
    assert answer.max() - 1.0 == pytest.approx(overshoot, rel=0.02)


def test_the_generator_has_every_known_effect_and_no_name_for_the_others():
    assert set(HIDDEN) == {*KNOWN, *FURTHER_KNOWN, *LATER_KNOWN, *UNKNOWN}
    planned = cases(GENERATOR, [1000, 1001], 31, seed=1)
    assert {case.names[0] for case in planned if len(case.names) == 1} == {*HIDDEN} - {*LATER_KNOWN}
    assert {build.tendons for build in BUILDS} == {3, 4, 6}
    assert Case(0, 1000, ("backlash", "inertia"), 1.0, "same").truth == ["hysteresis", "inertia"]


def test_a_recording_states_pulls_in_mm_within_the_limits():
    """Set points where drums have no encoders, otherwise the pulls of the drums."""
    for robot, encoders in ((1001, True), (1004, False)):
        rig = TendonRig(robot, noise=0.0)
        recording, _ = rig.record(rig_cases.excitation(rig, "tried", ("steps",), 6.0, robot))
        assert (recording.unit, float(rig.limits[0, 1])) == (
            "mm",
            1e3 * make_robot(robot).plant.high,
        )
        same = np.allclose(recording.measured, recording.commanded)
        assert same is not encoders


def test_every_effect_changes_the_motion_and_nothing_else_does():
    """Without any the motion is equal to the last bit. Rests between short runs let the moments of
    sudden effects pass."""
    rig = TendonRig(1004, noise=0.0)
    protocol = rig_cases.excitation(rig, "tried", ("steps", "wander") * 3, 12.0, 1004)
    plain = rig.record(protocol)[1].noise_free_mm
    again = TendonRig(1004, noise=0.0).record(protocol)[1].noise_free_mm
    np.testing.assert_array_equal(again, plain)
    for name in HIDDEN:
        moved = TendonRig(1004, noise=0.0, hidden=[(name, 4.0)]).record(protocol)[1]
        share = rig_cases.change_mm(moved.noise_free_mm, plain) / rig.arm.length_mm
        assert 3e-4 < share < 0.3, name


def test_a_hidden_effect_leaves_the_robot_as_it_is():
    """Robots are made once and shared."""
    before = make_robot(1004).plant.gains.copy()
    switch_on(Setup(make_robot(1004).plant), [("gain_mismatch", 1.0)], 1004)
    np.testing.assert_array_equal(make_robot(1004).plant.gains, before)
