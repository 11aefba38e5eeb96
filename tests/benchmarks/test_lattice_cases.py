"""The lattice of springs against closed forms, and what its generator of cases writes."""

import math

import numpy as np
import pytest
from scipy.integrate import quad, solve_ivp

from benchmarks import rig_cases
from benchmarks.generators import Setup
from benchmarks.lattice import motion
from benchmarks.lattice.body import CORE, RIGIDITY, make_body
from benchmarks.lattice.gas import AMBIENT_PA, VOLUMES, Gas, fill
from benchmarks.lattice.hidden import HIDDEN, switch_on
from benchmarks.lattice.motion import new_state, settle
from benchmarks.lattice.plant import load, see
from benchmarks.lattice.rig import LatticeRig
from benchmarks.lattice.robot import BUILDS, SLABS, make_robot
from benchmarks.lattice.wall import (
    BREAKING,
    CRIMP,
    CROSS_POWER,
    HURRYING_STRESS,
    RETARDATION_S,
    Wall,
    broken,
    new_memory,
    remember,
    slid,
    stress,
    taut,
)
from benchmarks.lattice_cases import GENERATOR, UNKNOWN
from benchmarks.rig_cases import KNOWN, LATER_KNOWN, cases

LENGTH, RADIUS, ALONG_N = 0.2, 0.01, 50.0
"""Length and radius of an even arm [m], and rigidity of its springs along the arm [N]."""
PLAIN = Wall(np.array([0.0, 1.0]), 0.0, 0.0, 0.0, np.array([0.0, 1.0, 0.0]))
"""A linear material."""


def even_arm(length=LENGTH, ring=3, turn=0.3, rigidity=RIGIDITY, **fields):
    """An even, weightless arm of linear springs with one ring of chambers."""
    plant, body = make_robot(704).plant, make_body(length, RADIUS, ring, SLABS, turn)
    springs, nodes = len(body.kinds), len(body.nodes)
    fields = {"gravity": np.zeros(3), "wall": PLAIN} | fields
    return plant._replace(
        body=body,
        rigidity=ALONG_N * rigidity[body.kinds],
        mass=fields.pop("mass", np.zeros(nodes)),
        chambers=np.array([(i, 0, SLABS) for i in range(ring)]),
        gains=np.ones(ring),
        patch=np.zeros(springs),
        **fields,
    )


def settled(plant, pressures):
    """(SLABS + 1, q, 3) nodes [m] at rest under pressures [Pa]."""
    state = new_state(plant)
    state.air[VOLUMES] = pressures
    settle(plant, state)
    return state.nodes.reshape(SLABS + 1, -1, 3)


def tilt(nodes):
    """Angle [rad] between the normal of the last cross-section and the axis."""
    wall = nodes[-1, nodes.shape[1] // 3 + 1 :]
    return math.acos(abs(np.linalg.svd(wall - wall.mean(axis=0))[2][-1, 2]))


@pytest.mark.parametrize("ring", [3, 4])
def test_a_chamber_pushes_with_its_pressure_on_its_area_at_the_tip(ring):
    """p A on the last cross-section along the axis and nothing beneath; sideways nothing at all."""
    plant, pressure = even_arm(ring=ring), 2e4
    state = new_state(plant)
    state.air[VOLUMES, 1] = pressure
    load(plant, state, 1.0)
    forces = state.force.reshape(SLABS, -1, 3).sum(axis=1)
    area = RADIUS**2 * math.sin(math.pi / ring)  # of two of the wall's 2 m triangles
    assert forces[-1, 2] == pytest.approx(pressure * area)
    np.testing.assert_allclose(forces[:-1, 2], 0.0, atol=1e-9 * pressure * area)
    np.testing.assert_allclose(forces[:, :2], 0.0, atol=1e-9 * pressure * area)


FIRM = RIGIDITY * np.where(np.arange(len(RIGIDITY)) < CORE, 1e3, 1.0)
"""Rigidities with cross-sections that hardly lose their shape."""


def beam(plant):
    """Stiffness E I [N m^2] and G A [N] of a slab of height h between plane sections.

    Curvature k stretches a spring of length l, whose middle is y off the axis, by k h^2 y / l, and
    shear g one that leans by a in the direction of shear by g h a / l: the energies of all springs
    E A (h / l)^3 y^2 and E A (h / l) (a / l)^2.
    """
    body, count = plant.body, plant.body.faces.max() + 1
    slab = (body.ends[:, 0] < count) & (body.ends[:, 1] >= count)
    one, two = (body.nodes[body.ends[slab, side]] for side in (0, 1))
    steep = (two - one)[:, 2] / body.lengths[slab]
    leaning = (two - one)[:, 1] / body.lengths[slab]
    middle = 0.5 * (one + two)[:, 1]
    rigidity = plant.rigidity[slab]
    return float(rigidity @ (steep**3 * middle**2)), float(rigidity @ (steep * leaning**2))


def test_a_small_pressure_bends_the_arm_as_a_beam():
    """Curvature p A d / (E I) of a beam under the couple p A d; in proportion to the pressure."""
    plant, pressure = even_arm(rigidity=FIRM), 200.0
    area = RADIUS**2 * math.sin(math.pi / 3)
    # Centroid of the chamber: of two equilateral triangles that share the axis and one edge.
    offset = 2.0 / 3.0 * RADIUS * math.cos(math.pi / 6) ** 2
    part = 8  # slabs, so far from the tip that it does not matter how its nodes share the force
    angle = pressure * area * offset * part / SLABS * LENGTH / beam(plant)[0]
    found = tilt(settled(plant, [pressure, 0.0, 0.0])[: part + 1])
    assert found == pytest.approx(angle, rel=0.01)
    half = tilt(settled(plant, [0.5 * pressure, 0.0, 0.0])[: part + 1])
    assert half == pytest.approx(0.5 * found, rel=0.01)


def test_a_weight_at_the_tip_bends_it_as_a_cantilever():
    """F L^3 / (3 E I) + F L / (G A) of a beam with shear (Timoshenko 1921)."""
    plant, force = even_arm(rigidity=FIRM), 1e-4
    mass, count = np.zeros(len(plant.body.nodes)), plant.body.faces.max() + 1
    mass[-count:] = force / 9.81 / count
    heavy = plant._replace(mass=mass, gravity=np.array([0.0, 9.81, 0.0]))
    bending, shear = beam(plant)
    sag = new_state(heavy).nodes[-count:, 1].mean()
    closed = force * LENGTH**3 / (3.0 * bending) + force * LENGTH / shear
    assert sag == pytest.approx(closed, rel=0.01)
    assert force * LENGTH / shear > 0.02 * closed


def test_chambers_are_alike_and_an_even_arm_has_no_handedness():
    """The next chamber moves the arm by the same, a third of a turn on; each in its own plane."""
    plant, pressure = even_arm(), 4e4
    first, next_ = (settled(plant, pressure * np.eye(3)[i]).mean(axis=1) for i in (0, 1))
    cos, sin = math.cos(2 * math.pi / 3), math.sin(2 * math.pi / 3)
    third = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    assert np.linalg.norm(first[-1, :2]) > 0.05 * LENGTH
    np.testing.assert_allclose(next_, first @ third.T, atol=1e-8)
    middle = 0.3 + math.pi / 3  # of the first chamber
    across = np.array([-math.sin(middle), math.cos(middle), 0.0])
    np.testing.assert_allclose(first @ across, 0.0, atol=1e-8)


def test_weight_and_chambers_turned_together_turn_the_shape():
    angle = 0.7
    turn = np.array(
        [[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1.0]]
    )
    mass = np.full(len(make_body(LENGTH, RADIUS, 3, SLABS, 0.3).nodes), 5e-5)
    weight = np.array([4.0, 2.0, -7.0])
    one = even_arm(mass=mass, gravity=weight)
    two = even_arm(mass=mass, gravity=turn @ weight, turn=0.3 + angle)
    pressures = [3e4, 1e4, 0.0]
    np.testing.assert_allclose(settled(two, pressures), settled(one, pressures) @ turn.T, atol=1e-8)


def seen(plant, time):
    """(2, 3) key points [m] of an arm at rest under pressure in one chamber, at a time [s]."""
    state = new_state(plant)
    state.time[0], state.air[VOLUMES, 0] = time, 3e4
    settle(plant, state)
    points = np.empty((2, 3))
    see(plant, state, points)
    return points


def test_a_breath_shifts_the_arm_as_it_is():
    plain, shift = even_arm()._replace(keys=np.array([6, 12])), np.array([1e-3, 2e-3, -1e-3])
    breathing = plain._replace(breath=np.array([*shift, 4.0, 1.0]))
    moved = seen(breathing, 42.5) - seen(plain, 42.5)
    np.testing.assert_allclose(moved, np.broadcast_to(moved[0], (2, 3)), atol=1e-12)
    np.testing.assert_allclose(np.cross(moved[0], shift), 0.0, atol=1e-12)
    assert 0.1 < np.linalg.norm(moved[0]) / np.linalg.norm(shift) < 1.3


def test_an_arm_that_rolls_in_its_clamp_is_one_that_was_clamped_so():
    """Its chambers turn, and its weight does not."""
    roll, mass = 0.2, np.full(len(make_body(LENGTH, RADIUS, 3, SLABS, 0.3).nodes), 5e-5)
    fields = {"mass": mass, "gravity": np.array([4.0, 2.0, -7.0])}
    rolled, plain, clamped = (
        even_arm(turn=turn, **fields)._replace(keys=np.array([6, 12]), slip=np.array(slip))
        for turn, slip in (
            (0.3, [0.0, roll, 1.0]),
            (0.3, [0.0, 0.0, 0.0]),
            (0.3 + roll, [0.0, 0.0, 0.0]),
        )
    )
    np.testing.assert_allclose(seen(rolled, 10.0), seen(clamped, 10.0), atol=1e-8)
    assert np.abs(seen(rolled, 10.0) - seen(plain, 10.0)).max() > 1e-3


def test_friction_is_that_of_dahl():
    """The exact step, forth and back, against the differential equation."""
    limit, half, held = 0.1, 0.2, 0.0
    for way in (0.3, -0.15, 0.4):
        side = math.copysign(1.0, way)
        found = solve_ivp(
            lambda x, f, side=side: limit / half * np.abs(1.0 - side * f / limit) ** 1.5 * side,
            (0.0, abs(way)),
            [held],
            rtol=1e-9,
            atol=1e-12,
        ).y[0, -1]
        held = slid(limit, half, held, way)
        assert held == pytest.approx(found, rel=1e-6)


def test_creep_is_hurried_by_stress_and_flow_thinned_by_its_rate():
    """Held strain against the differential equations of both."""
    wall = PLAIN._replace(creep=0.6, fluid=np.array([0.5, 0.8, 2.0]))
    memory, strain, seconds, count = new_memory(1), 0.9, 4.0, 800
    for _ in range(count):
        remember(wall, memory, 0, strain, seconds / count)

    def rates(_, state):
        creep, flow = state[:2], state[2]
        carried = strain - creep.sum()
        crept = (0.3 * carried - creep) * math.exp(abs(carried) / HURRYING_STRESS) / RETARDATION_S
        # The rate solves r (t_c / (1 + (t_x r)^p)) = x - v.
        rate = 0.0
        for _ in range(60):
            rate = (strain - flow) * (1.0 + (2.0 * rate) ** CROSS_POWER) / 0.8
        return [*crept, rate]

    exact = solve_ivp(rates, (0.0, seconds), [0.0, 0.0, 0.0], rtol=1e-8, atol=1e-10).y[:, -1]
    np.testing.assert_allclose(memory.creep[0], exact[:2], rtol=0.01)
    assert memory.flow[0] == pytest.approx(exact[2], rel=0.02)
    held = stress(wall, memory, 0, strain, 1.0)
    assert held == pytest.approx(strain - exact[:2].sum() + 0.5 * (strain - exact[2]), rel=0.01)


def test_only_extension_breaks_filaments_and_pulls_threads_taut():
    wall = PLAIN._replace(damage=0.5)
    memory = new_memory(1)
    remember(wall, memory, 0, -2.0, 0.01)
    assert stress(wall, memory, 0, -2.0, 1.0) == -2.0
    remember(wall, memory, 0, BREAKING, 0.01)
    remember(wall, memory, 0, 0.2, 0.01)
    assert stress(wall, memory, 0, 0.2, 1.0) == pytest.approx(0.2 * (1.0 - 0.5 * broken(BREAKING)))
    assert broken(BREAKING) == pytest.approx(1.0 - math.exp(-1.0))

    def share(x):
        return min(max((x - CRIMP[0]) / CRIMP[1], 0.0), 1.0)

    for extension in (-1.0, 0.1, 0.6, 1.5):
        carried = quad(share, min(extension, 0.0), extension, points=[CRIMP[0], CRIMP.sum()])[0]
        assert taut(extension) == pytest.approx(carried, abs=1e-7)


def test_a_leak_takes_the_squares_of_pressure_in_proportion():
    """Steady flow through three equal capillaries and a leak, as through resistors in a row."""
    line, leak, front, seconds = 20.0, 0.3, 8e4, 10.0
    gas = Gas(np.array([line, line]), 1e9, np.array([leak / seconds, 1.0]))
    air = np.zeros((1 + VOLUMES, 2))
    for _ in range(20_000):
        fill(gas, np.full(2, front), air, seconds, 0.01)
    high, low = (front + AMBIENT_PA) ** 2, AMBIENT_PA**2
    inside = math.sqrt((high * line / VOLUMES + low * leak) / (line / VOLUMES + leak))
    assert air[VOLUMES, 0] == pytest.approx(front)
    assert air[VOLUMES, 1] == pytest.approx(inside - AMBIENT_PA, rel=1e-6)
    assert air[VOLUMES, 1] < 0.98 * front


def test_the_motion_does_not_depend_on_the_time_step():
    """A sixth of the step moves the arm otherwise by some thousandths of its way."""
    robot = make_robot(704)
    rng = np.random.default_rng(0)
    targets = np.repeat(robot.plant.high * rng.random((4, 4)), 8, axis=0)
    points = [
        motion.run(robot.plant, new_state(robot.plant), targets, 0.05, steps)[2] for steps in (1, 6)
    ]
    way = np.ptp(points[1][:, -1], axis=0).max()
    assert way > 0.1 * robot.length_mm * 1e-3
    assert np.sqrt(np.mean((points[1] - points[0]) ** 2)) < 6e-3 * way


def test_the_generator_has_every_known_effect_and_no_name_for_the_others():
    assert set(HIDDEN) == {*KNOWN, *LATER_KNOWN, *UNKNOWN}
    planned = cases(GENERATOR, [700, 701], 29, seed=1)
    assert {case.names[0] for case in planned if len(case.names) == 1} == {*HIDDEN} - {*LATER_KNOWN}
    assert {build.chambers for build in BUILDS} == {3, 4, 6}


def test_every_effect_changes_the_motion_and_nothing_else_does():
    """Without any the motion is equal to the last bit. Rests between short runs let the moments of
    sudden effects pass."""
    rig = LatticeRig(704, noise=0.0)
    protocol = rig_cases.excitation(rig, "tried", ("steps",) * 6, 9.0, 704)
    plain = rig.record(protocol)[1].noise_free_mm
    again = LatticeRig(704, noise=0.0).record(protocol)[1].noise_free_mm
    np.testing.assert_array_equal(again, plain)
    for name in HIDDEN:
        moved = LatticeRig(704, noise=0.0, hidden=[(name, 2.0)]).record(protocol)[1]
        share = rig_cases.change_mm(moved.noise_free_mm, plain) / rig.arm.length_mm
        assert 3e-4 < share < 0.3, name


def test_a_hidden_effect_leaves_the_robot_as_it_is():
    """Robots are made once and shared."""
    plant = make_robot(704).plant
    before = [plant.rigidity.copy(), plant.mass.copy(), plant.gains.copy()]
    switch_on(Setup(plant), [(name, 1.0) for name in ("payload", "twist", "gain_mismatch")], 704)
    for kept, now in zip(before, (plant.rigidity, plant.mass, plant.gains), strict=True):
        np.testing.assert_array_equal(now, kept)
