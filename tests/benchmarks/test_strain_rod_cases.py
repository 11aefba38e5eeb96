"""The rod of polynomial strains against closed forms, and what its generator of cases has."""

import math

import numpy as np
import pytest
from scipy.integrate import solve_bvp, solve_ivp
from scipy.linalg import expm

from benchmarks import rig_cases
from benchmarks.generators import ROOM_C, Setup
from benchmarks.rig_cases import KNOWN, LATER_KNOWN, cases
from benchmarks.strain_rod import motion
from benchmarks.strain_rod.gas import AMBIENT_PA, LAMINAR, SCALE, conductance, fill
from benchmarks.strain_rod.hidden import HIDDEN, switch_on
from benchmarks.strain_rod.motion import (
    KELVIN,
    breathed,
    load_arm,
    move,
    new_state,
    place_arm,
    plate_force,
    plate_stiffness,
    push,
    solve,
)
from benchmarks.strain_rod.rig import StrainRodRig
from benchmarks.strain_rod.robot import BUILDS, PARTS, make_robot
from benchmarks.strain_rod.wall import (
    FAR,
    chains,
    crept,
    new_memory,
    pulled_out,
    remember,
    slipped,
    wall_stress,
)
from benchmarks.strain_rod_cases import GENERATOR, UNKNOWN

ROBOT = 901
"""A level arm with four chambers."""


def linear_wall(wall, **fields):
    """A wall without memory, linear."""
    plain = wall._replace(locking=0.0, friction=np.array([0.0, 0.0, 1.0]))
    return plain._replace(**fields)


def even_arm(robot=ROBOT, **fields):
    """An arm of one stiffness, straight as cast, with equal chambers, without weight."""
    plant = make_robot(robot).plant
    count = len(plant.areas)
    about = {
        "bend": np.full(len(plant.bend), plant.bend.mean()),
        "bow": np.zeros_like(plant.bow),
        "angles": 2.0 * np.pi * np.arange(count) / (3 if count == 6 else count),
        "offset": np.full(count, plant.offset.mean()),
        "areas": np.full(count, plant.areas.mean()),
        "gravity": np.zeros(3),
        "growth": 0.0,
        "wall": linear_wall(plant.wall),
        "keys": np.arange(1, PARTS + 1),
    }
    return plant._replace(**about | fields)


def settled(plant, pressures=None, steps=600):
    """The state [m] after a time under pressures (m,) [Pa] in the chambers."""
    state = new_state(plant)
    state.air[3] = 0.0 if pressures is None else pressures
    for _ in range(steps):
        move(plant, state, 0.01)
    place_arm(plant, state)
    return state


def test_a_chamber_bends_the_arm_to_an_arc():
    """A couple p A d on a stiffness B: the arc of angle p A d L / B on the stretched length."""
    plant = even_arm()
    pressures = plant.high * np.array([1.0, 0.0, 0.0, 0.0])
    state = settled(plant, pressures)
    force = plant.high * plant.areas[0]
    turn = force * plant.offset[0] * plant.length / plant.bend[0]
    length = plant.length * (1.0 + force / (plant.bend[0] * plant.ratio[3]))
    arc = length / turn * np.array([math.cos(turn) - 1.0, 0.0, math.sin(turn)])
    assert turn > 0.6
    np.testing.assert_allclose(state.nodes[-1], arc, atol=1e-5 * length)


def test_equal_pressures_stretch_the_arm_by_their_force_over_its_stiffness():
    plant = even_arm()
    state = settled(plant, np.full(4, 0.5 * plant.high))
    strain = 4 * 0.5 * plant.high * plant.areas[0] / (plant.bend[0] * plant.ratio[3])
    along = plant.length * (1.0 + strain)
    np.testing.assert_allclose(state.nodes[-1], [0.0, 0.0, along], atol=1e-7)


def test_a_level_arm_sags_under_its_own_weight():
    """w L^4 / (8 B) of a clamped beam under an even weight w, for small sag."""
    light = 0.02
    plant = even_arm(gravity=np.array([0.0, light, 0.0]))
    sag = plant.mass * light * plant.length**3 / (8.0 * plant.bend[0])
    assert 1e-5 < sag / plant.length < 1e-2
    assert new_state(plant).nodes[-1, 1] == pytest.approx(sag, rel=2e-3)


def test_a_heavy_level_arm_is_the_elastica_under_its_weight():
    """B theta'' = -w (L - s) cos theta, clamped and free (Euler 1744), by scipy's solve_bvp."""
    strong = 9.81
    plant = even_arm(gravity=np.array([strong, 0.0, 0.0]))
    weight = 2.5 * plant.bend[0] / plant.length**2
    stiff = plant.ratio.copy()
    stiff[3] *= 1e6
    plant = plant._replace(mass=weight / strong, ratio=stiff)

    def slopes(s, y):
        return np.array([y[1], -2.5 * (1.0 - s) * np.cos(y[0])])

    grid = np.linspace(0.0, 1.0, 101)
    found = solve_bvp(
        slopes, lambda a, b: np.array([a[0], b[1]]), grid, np.zeros((2, 101)), tol=1e-8
    )
    angles = found.sol(np.linspace(0.0, 1.0, 2001))[0]
    tip = plant.length * np.array(
        [np.trapezoid(np.sin(angles), dx=1 / 2000), np.trapezoid(np.cos(angles), dx=1 / 2000)]
    )
    assert tip[0] > 0.2 * plant.length
    state = settled(plant)
    np.testing.assert_allclose(state.nodes[-1, [0, 2]], tip, atol=3e-4 * plant.length)


def bent_arm(robot):
    """An arm under weight with random strains."""
    plant = make_robot(robot).plant
    state = new_state(plant)
    rng = np.random.default_rng(7)
    state.shape[:] = 0.4 * rng.standard_normal(state.shape.shape)
    strain_from_shape(plant, state)
    return plant, state, rng


def strain_from_shape(plant, state):
    """Strains and poses of the coefficients of a state."""
    each = len(plant.basis)
    for segment, shape in enumerate(state.shape):
        for c in range(4):
            own = plant.component == c
            state.strain[segment * each : (segment + 1) * each, c] = (
                plant.basis[:, own] @ shape[own]
            )
    place_arm(plant, state)


def test_poses_are_the_exponentials_of_many_short_twists():
    """Magnus' fourth order on 12 intervals against products of 4,800 exponentials (expm)."""
    plant, state, _ = bent_arm(902)
    count = 400
    pose = np.eye(4)
    legendre = np.polynomial.legendre.legval
    for segment, shape in enumerate(state.shape):
        ends = (np.arange(count) + 0.5) / count
        strains = (
            np.array(
                [
                    sum(
                        shape[d] * legendre(2 * ends - 1, np.eye(4)[k])
                        for k, d in enumerate(np.flatnonzero(plant.component == c))
                    )
                    for c in range(4)
                ]
            ).T
            * plant.reference
        )
        for x, y, z, e in strains:
            twist = np.array([[0, -z, y, 0], [z, 0, -x, 0], [-y, x, 0, 1 + e], [0, 0, 0, 0]])
            pose = pose @ expm(twist * plant.length / 2 / count)
        node = PARTS // 2 * (segment + 1)
        np.testing.assert_allclose(state.nodes[node], pose[:3, 3], atol=5e-5 * plant.length)
        np.testing.assert_allclose(state.frames[node], pose[:3, :3], atol=1e-4)


@pytest.mark.parametrize("robot", [900, 902])
def test_loads_do_the_virtual_work_of_weight_and_payload(robot):
    """Generalised forces against differences of the potential energy of the nodes' weights."""
    plant, state, rng = bent_arm(robot)
    plant = plant._replace(payload=np.array([0.3 * plant.mass, 0.01, -0.02, 0.01]))
    simpson = np.array([1, *[4, 2] * (PARTS // 2 - 1), 4, 1]) / (3.0 * PARTS)

    def potential():
        strain_from_shape(plant, state)
        height = simpson @ state.nodes @ plant.gravity * plant.mass
        tip = state.nodes[-1] + state.frames[-1] @ plant.payload[1:]
        return -height - plant.payload[0] * tip @ plant.gravity

    strain_from_shape(plant, state)
    load_arm(plant, state)
    loads = plant.reference * state.load * 0.5 * plant.length / PARTS
    each = len(plant.basis)
    for _ in range(6):
        segment, d = int(rng.integers(len(state.shape))), int(rng.integers(len(plant.component)))
        own = loads[segment * each : (segment + 1) * each, plant.component[d]]
        work = float(plant.basis[:, d] @ own)
        held, energies = state.shape[segment, d], []
        for way in (1e-4, -1e-4):
            state.shape[segment, d] = held + way
            energies.append(potential())
        state.shape[segment, d] = held
        most = np.abs(loads).sum() * 0.2
        assert work == pytest.approx(-(energies[0] - energies[1]) / 2e-4, abs=2e-3 * most)


def test_the_plates_stiffness_is_the_derivative_of_its_force():
    """J^T k J against differences of the generalised force, of a plate that a node barely
    touches, so that the change of J with the pose counts little."""
    plant, state, _ = bent_arm(900)
    way = np.array([0.6, 0.0, 0.8])
    deepest = float((state.nodes[1:] @ way).max())
    plant = plant._replace(
        gravity=np.zeros(3),
        plate=np.array([*((deepest + plant.radius - 1e-6) * way), *-way, 50.0, 0.01]),
    )

    def forces():
        strain_from_shape(plant, state)
        load_arm(plant, state)
        loads = plant.reference * state.load
        return np.einsum("gd,gd->d", plant.basis, loads[:, plant.component])

    matrix = np.zeros((1, 12, 12))
    strain_from_shape(plant, state)
    plate_stiffness(plant, state, matrix)
    d = int(np.argmax(np.diag(matrix[0])))
    begin = forces()
    deeper = -math.copysign(1e-6, begin[d])
    state.shape[0, d] += deeper
    change = (forces() - begin) / deeper
    np.testing.assert_allclose(change, -matrix[0][:, d], rtol=0.05, atol=0.02 * matrix[0, d, d])


def test_a_foundation_pushes_by_the_exponential_and_goes_on_linearly():
    plant = even_arm(plate=np.array([0, 0, 0, 1.0, 0, 0, 30.0, 0.01]))
    assert plate_force(plant, -0.1) == 0.0
    assert plate_force(plant, 0.005) == pytest.approx(30.0 * 0.01 * math.expm1(0.5))
    slope = (plate_force(plant, 0.05) - plate_force(plant, 0.04)) / 0.01
    assert slope == pytest.approx(30.0 * math.exp(motion.DEEPEST))


def test_a_plate_holds_the_arm_back():
    """The arm bends into a plate; without depth it would pass through it."""
    plant = even_arm()
    pressures = plant.high * np.array([1.0, 0.0, 0.0, 0.0])
    free = settled(plant, pressures).nodes[-1, 0]
    at = 0.5 * free - plant.radius
    hard = 3.0 * 200.0 * plant.bend[0] / plant.length**4
    plate = np.array([at, 0.0, 0.0, 1.0, 0.0, 0.0, hard, 0.05 * plant.length])
    held = settled(plant._replace(plate=plate), pressures).nodes[:, 0].min()
    assert free < held < 0.5 * free
    assert held == pytest.approx(0.5 * free, abs=0.12 * plant.length)


def test_a_wall_without_memory_has_an_energy():
    """Its stress has a symmetric derivative, and that is the stress's own by differences."""
    plant = make_robot(900).plant
    weights = plant.ratio * (plant.reference / plant.reference[0]) ** 2
    wall = linear_wall(plant.wall, locking=0.2, viscous=0.0, helix=0.4)
    memory, slope, other = new_memory(1), np.empty((4, 4)), np.empty((4, 4))
    strain = np.array([0.5, -0.3, 0.2, 0.7])

    def stress(at, into):
        out = np.empty(4)
        wall_stress(wall, memory, 0, weights, 0.0, 1.0, strain, at, 0.01, out, into)
        return out

    stress(strain, slope)
    np.testing.assert_allclose(slope, slope.T, atol=1e-14)
    for c in range(4):
        step = 1e-6 * np.eye(4)[c]
        change = (stress(strain + step, other) - stress(strain - step, other)) / 2e-6
        np.testing.assert_allclose(slope[c], change, rtol=1e-6, atol=1e-8)


def test_chains_follow_the_inverse_langevin_function():
    """x (3 - x^2) / (1 - x^2) is within 5 % of the inverse of coth y - 1 / y (Cohen 1991)."""
    for force in (0.5, 2.0, 5.0):
        reach = 1.0 / math.tanh(force) - 1.0 / force
        assert 3.0 * reach * chains(reach**2)[0] == pytest.approx(force, rel=0.05)
    value, slope = chains(0.4)
    assert slope == pytest.approx((chains(0.4 + 1e-6)[0] - value) / 1e-6, rel=1e-4)


def test_friction_follows_bouc_and_wen():
    """dz/dt = (x' - z |z x'|) / x_y with scipy's solve_ivp, over a loop that does not close."""
    slip, reach = 0.2, 0.6

    def rate(t, z):
        speed = reach * math.cos(t) * (1.0 + 0.3 * math.sin(0.37 * t))
        return (speed - z * abs(z[0] * speed)) / slip

    def way(t):
        a, b = 1.37, 0.63
        return reach * (np.sin(t) + 0.15 * ((1 - np.cos(a * t)) / a - (1 - np.cos(b * t)) / b))

    times = np.linspace(0.0, 15.0, 15_001)
    found = solve_ivp(rate, (0.0, 15.0), [0.0], t_eval=times, rtol=1e-8, atol=1e-10, max_step=0.01)
    state, out, states = np.zeros(4), np.zeros(4), [0.0]
    for moved in np.diff(way(times)):
        slipped(state, np.array([moved, 0.0, 0.0, 0.0]), slip, out)
        state[:] = out
        states.append(state[0])
    np.testing.assert_allclose(states, found.y[0], atol=3e-3)
    assert 0.9 < np.max(np.abs(states)) < 1.0


def test_friction_grows_with_the_pressure_on_the_fibres():
    plant = make_robot(900).plant
    wall = linear_wall(plant.wall, viscous=0.0, friction=np.array([0.1, 0.4, 0.2]))
    memory, out, slope = new_memory(1), np.empty(4), np.empty((4, 4))
    memory.friction[0, 0] = 0.8
    stresses = []
    for pressed in (0.0, 1.0):
        wall_stress(
            wall, memory, 0, np.ones(4), pressed, 1.0, np.zeros(4), np.zeros(4), 0.01, out, slope
        )
        stresses.append(out[0])
    np.testing.assert_allclose(stresses, [0.8 * 0.04, 0.8 * 0.1])


def test_creep_follows_the_hyperbolic_sine():
    """dy/dt = c s_0 sinh(s / s_0) / tau, s = x - y / c, with scipy's solve_ivp."""
    flow, strain = np.array([0.3, 0.2, 5.0]), 0.9

    def rate(t, y):
        return flow[0] * flow[1] * np.sinh((strain - y / flow[0]) / flow[1]) / flow[2]

    found = solve_ivp(rate, (0.0, 4.0), [0.0], rtol=1e-9, atol=1e-12)
    late = 0.0
    for _ in range(40):
        late = crept(flow, strain, late, 0.1)
    assert late == pytest.approx(found.y[0, -1], rel=1e-5)
    assert 0.5 * flow[0] * strain < late < flow[0] * strain


def test_a_fluid_carries_the_inverse_hyperbolic_sine_of_the_rate():
    """An arm under a constant couple: (tau + ..) x' + e asinh(lambda x') = couple - x."""
    wall = linear_wall(even_arm().wall, fluid=np.array([0.3, 5.0]))
    plant = even_arm(wall=wall)
    state = new_state(plant)
    state.air[3, 0] = plant.high
    load = plant.high * plant.areas[0] * plant.offset[0] / (plant.bend[0] * plant.reference[0])

    def rate(t, x):
        low, high = 0.0, 50.0
        for _ in range(60):
            middle = 0.5 * (low + high)
            over = wall.viscous * middle + 0.3 * math.asinh(5.0 * middle) > load - x[0]
            low, high = (low, middle) if over else (middle, high)
        return [low]

    found = solve_ivp(rate, (0.0, 0.6), [0.0], rtol=1e-6, max_step=0.01)
    for _ in range(600):
        move(plant, state, 0.001)
    assert 0.2 < found.y[0, -1] / load < 0.9
    assert -state.strain[3, 1] == pytest.approx(found.y[0, -1], rel=5e-3)


def test_damage_keeps_first_loading_and_softens_the_way_back():
    plant = make_robot(900).plant
    wall = linear_wall(plant.wall, viscous=0.0, damage=0.5)
    memory, out, slope, zero = new_memory(1), np.empty(4), np.empty((4, 4)), np.zeros(4)
    top, back = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.5, 0.0, 0.0, 0.0])
    wall_stress(wall, memory, 0, np.ones(4), 0.0, 1.0, zero, top, 0.01, out, slope)
    assert out[0] == pytest.approx(1.0)
    remember(wall, memory, 0, np.ones(4), zero, top, 0.01)
    wall_stress(wall, memory, 0, np.ones(4), 0.0, 1.0, top, back, 0.01, out, slope)
    most, now = (1.0 - math.exp(-x / (1.0 - x)) for x in (1.0 / FAR, 0.5 / FAR))
    assert pulled_out(1.0 / FAR) == pytest.approx(most)
    assert out[0] == pytest.approx(0.5 * (1 - 0.5 * most) / (1 - 0.5 * now))


def test_helical_fibres_turn_the_sections_of_a_stretched_arm():
    """Without a torque torsion is h times the stretch, and stretch is what it was."""
    plant = even_arm()
    plain = settled(plant, np.full(4, 0.6 * plant.high))
    state = settled(
        plant._replace(wall=plant.wall._replace(helix=0.3)), np.full(4, 0.6 * plant.high)
    )
    np.testing.assert_allclose(state.strain[:, 3], plain.strain[:, 3], rtol=1e-6)
    np.testing.assert_allclose(state.strain[:, 2], 0.3 * plain.strain[:, 3], rtol=1e-6)


def test_a_warm_wall_bends_less_by_the_absolute_temperature():
    plant = even_arm(warmth=1.0)
    pressures = plant.high * np.array([1.0, 0.0, 0.0, 0.0])
    state = new_state(plant)
    state.air[3] = pressures
    state.time[0], state.warm[0] = 1e4, motion.room(1e4)
    for _ in range(400):
        move(plant, state, 0.01)
    cold = settled(plant._replace(warmth=0.0), pressures)
    share = 1.0 + state.warm[0] / (KELVIN + ROOM_C)
    assert share > 1.01
    np.testing.assert_allclose(cold.strain[:, 1] / state.strain[:, 1], share, rtol=2e-3)


def test_flow_is_turbulent_for_large_differences_and_linear_for_small_ones():
    """The power 4/7 of d (Blasius 1913), and the rate that is stated at d_0."""
    scale = 1e4
    one, two = (d * conductance(d, 0.0, scale) for d in (4e3, 8e3))
    squares = [d * (1.0 + 0.5 * d / AMBIENT_PA) for d in (4e3, 8e3)]
    assert two / one == pytest.approx((squares[1] / squares[0]) ** (4 / 7), rel=3e-3)
    assert conductance(1.0, 0.0, scale) == pytest.approx(LAMINAR ** (-3 / 7), rel=1e-3)


def test_a_narrow_hose_fills_its_chamber_as_the_differential_equations():
    """Hose and chamber with scipy's solve_ivp, from a regulator at its set point."""
    plant = make_robot(900).plant
    gas = plant.gas._replace(line=np.full(3, 6.0), swell=0.3)
    air, high = np.zeros((4, 3)), plant.high
    target = np.array([0.8 * high, 0.4 * high, 0.0])
    air[0] = target

    def rate(t, y):
        middle, chamber = y
        first = 6.0 * conductance(target[0], middle, SCALE * high) * (target[0] - middle)
        last = 6.0 * conductance(middle, chamber, SCALE * high) * (middle - chamber)
        volume = 1.0 + gas.swell * (2.0 * chamber + AMBIENT_PA) / high
        return [(first - last) / 0.2, last / volume]

    found = solve_ivp(rate, (0.0, 0.4), [0.0, 0.0], method="LSODA", rtol=1e-8)
    for _ in range(4000):
        fill(gas, target, air, np.zeros(1), 0.0, high, 1e-4)
    assert 0.2 < air[3, 0] / target[0] < 0.9
    np.testing.assert_allclose(air[2:, 0], found.y[:, -1], rtol=2e-3)
    np.testing.assert_allclose(air[:, 2], 0.0, atol=1e-9)


def test_a_relief_valve_opens_above_one_pressure_and_closes_below_another():
    plant = make_robot(900).plant
    high, flags, air = plant.high, np.zeros(1), np.zeros((4, 3))
    gas = plant.gas._replace(relief=np.array([0.0, 0.6 * high, 0.3 * high, 5.0]))
    opened = []
    for share in (0.5, 0.7, 0.45, 0.2, 0.5):
        for _ in range(300):
            fill(gas, np.array([share * high, 0.0, 0.0]), air, flags, 0.0, high, 0.01)
        opened.append(flags[0])
    assert opened == [0.0, 1.0, 1.0, 0.0, 0.0]


def test_crossed_chambers_exchange_air_in_their_spells():
    plant = make_robot(900).plant
    high, flags, air = plant.high, np.zeros(1), np.zeros((4, 3))
    gas = plant.gas._replace(
        line=np.full(3, 1e-9), crossed=np.array([0.0, 1.0, 3.0]), crossing=np.array([[1.0, 2.0]])
    )
    air[3] = [0.9 * high, 0.1 * high, 0.5 * high]
    begin = air[3].copy()
    fill(gas, air[0].copy(), air, flags, 0.5, high, 0.01)
    np.testing.assert_allclose(air[3], begin, rtol=1e-6)
    for _ in range(300):
        fill(gas, air[0].copy(), air, flags, 1.5, high, 0.01)
    np.testing.assert_allclose(air[3], 0.5 * high, rtol=1e-3)


def test_septa_leave_the_section_of_all_chambers_as_it_is():
    plant = even_arm(septum=np.array([0.2, 1e4]))
    pressures = np.array([0.9, 0.2, 0.4, 0.0]) * plant.high
    shares = np.array([push(plant, pressures, i) for i in range(3)]) / pressures[:3]
    last = 1.0 - 0.2 * pressures.mean() / (pressures.mean() + 1e4)
    assert shares.sum() + last == pytest.approx(4.0)
    assert shares[0] > 1.0 > shares[1]


def test_threads_become_taut_as_their_lengths_are_distributed():
    """The push is the integral of the taut part, a logistic function of pressure."""
    slack = 2e3
    plant = even_arm(slack=np.full(4, slack))
    grid = np.linspace(0.0, 1.5e4, 20_001)
    taut = 1.0 / (1.0 + np.exp((slack - grid) / (0.25 * slack)))
    closed = np.trapezoid(taut, grid)
    assert push(plant, np.array([1.5e4, 0.0, 0.0, 0.0]), 0) == pytest.approx(closed, rel=1e-6)
    assert push(plant, np.zeros(4), 0) == 0.0


def test_cholesky_solves():
    rng = np.random.default_rng(3)
    root = rng.standard_normal((12, 12))
    matrix, right = root @ root.T + np.eye(12), rng.standard_normal(12)
    found = right.copy()
    solve(matrix.copy(), found)
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right), rtol=1e-9)


def test_a_breath_is_full_after_a_third_of_its_period_and_goes_out_passively():
    times = np.linspace(0.0, 400.0, 40_001)
    depth = np.array([breathed(t, 4.0, 1.0) for t in times])
    assert 0.0 < depth.min() < 0.05
    assert 0.95 < depth.max() <= 1.0
    turns = np.flatnonzero((depth[1:-1] > depth[:-2]) & (depth[1:-1] >= depth[2:]))
    assert len(turns) == pytest.approx(100, abs=1)


def test_half_the_step_changes_the_motion_by_less_than_the_noise(monkeypatch):
    robot = make_robot(903)
    points = []
    for step in (motion.STEP_S, 0.5 * motion.STEP_S):
        monkeypatch.setattr(motion, "STEP_S", step)
        rig = StrainRodRig(903, noise=0.0)
        protocol = rig_cases.excitation(rig, "tried", ("wander", "sets"), 30.0, 903)
        points.append(rig.record(protocol)[1].noise_free_mm)
    noise = math.hypot(robot.cameras.white_mm, robot.cameras.slow_mm)
    assert np.ptp(points[0][:, -1], axis=0).max() > 20.0
    assert rig_cases.change_mm(points[1], points[0]) < 0.3 * noise


def test_the_generator_has_every_known_effect_and_no_name_for_the_others():
    assert set(HIDDEN) == {*KNOWN, *LATER_KNOWN, *UNKNOWN}
    planned = cases(GENERATOR, [900, 901], 29, seed=1)
    assert {case.names[0] for case in planned if len(case.names) == 1} == {*HIDDEN} - {*LATER_KNOWN}
    assert {build.chambers for build in BUILDS} == {3, 4, 6}


def test_every_effect_changes_the_motion_and_nothing_else_does():
    """Without any the motion is equal to the last bit. What is in front of the sensors stays as it
    is, and the sensors show chambers that only lines and valves may change."""
    rig = StrainRodRig(901, noise=0.0)
    protocol = rig_cases.excitation(rig, "tried", ("steps", "sets", "wander"), 30.0, 901)
    recording, truth = rig.record(protocol)
    plain, chambers = truth.noise_free_mm, truth.pressures_kPa
    again = StrainRodRig(901, noise=0.0).record(protocol)[1].noise_free_mm
    np.testing.assert_array_equal(again, plain)
    for name in {*HIDDEN} - {*LATER_KNOWN}:
        seen, moved = StrainRodRig(901, noise=0.0, hidden=[(name, 2.0)]).record(protocol)
        share = rig_cases.change_mm(moved.noise_free_mm, plain) / rig.arm.length_mm
        assert 5e-4 < share < 0.3, name
        np.testing.assert_array_equal(seen.measured, recording.measured)
        air = np.abs(moved.pressures_kPa - chambers).max()
        assert (air > 1e-9) == (HIDDEN[name].place == "line"), name
        warm = np.abs(seen.temp_C - recording.temp_C).max()
        assert (warm > 0.1) == (name == "thermal_drift"), name


def test_the_same_seed_has_the_same_noise_and_another_take_another():
    rig = StrainRodRig(904, take=3)
    protocol = rig_cases.excitation(rig, "tried", ("wander",), 5.0, 904)
    one, two = (StrainRodRig(904, take=3).record(protocol)[0] for _ in range(2))
    np.testing.assert_array_equal(one.key_points_mm, two.key_points_mm)
    other = StrainRodRig(904, take=4).record(protocol)[0]
    assert np.abs(other.key_points_mm - one.key_points_mm).max() > 0.01


def test_a_hidden_effect_leaves_the_robot_as_it_is():
    """Robots are made once and shared."""
    before = make_robot(904).plant.areas.copy()
    switch_on(Setup(make_robot(904).plant), [("gain_mismatch", 1.0)], 904)
    np.testing.assert_array_equal(make_robot(904).plant.areas, before)
