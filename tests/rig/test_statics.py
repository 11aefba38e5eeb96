"""The rod's statics and the wall's law against closed forms, quadrature and another engine."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgisoft.rig.rod import Loads, Rod, balance, new_shape
from surgisoft.rig.wall import NOT_CONVERGED, Wall, strain_under

LENGTH, RADIUS, MODULUS, DENSITY = 60.0, 7.5, 0.15, 1.07e-9  # mm, mm, N/mm^2, t/mm^3
GRAVITY = 9806.65  # mm/s^2
AREA, SECOND = np.pi * RADIUS**2, np.pi / 4 * RADIUS**4


def solid_wall(even=0.0, odd=0.0, modulus=MODULUS, chambers=((0.0, 0.0),), areas=(0.0,), fibre=0.0):
    """A solid round section; its fourth moment is pi R^6 / 8."""
    return Wall(
        modulus=modulus,
        even=even,
        odd=odd,
        area=AREA,
        second=np.array([SECOND, SECOND, 0.0]),
        mean_second=SECOND,
        fourth=np.pi / 8 * RADIUS**6,
        torsion=modulus / 3 * 2 * SECOND,
        shear=modulus / 3 * 27 / 28 * AREA,
        chambers=np.array(chambers, float),
        areas=np.array(areas, float),
        fibre=np.full(len(areas), fibre),
    )


def uniform_rod(wall, weight=0.0, rest=(0.0, 0.0), steps=16):
    """A rod of LENGTH without caps, key planes at every quarter. weight: of the whole rod [N]."""
    stations = 2 * steps + 1
    quarters = np.arange(1, 4) * steps // 4
    return Rod(
        wall=wall,
        steps=np.full(steps, LENGTH / steps),
        stiffness=np.ones(stations),
        taper=np.ones((stations, len(wall.areas))),
        rest=np.tile(np.array(rest, float), (stations, 1)),
        beyond=weight * (1 - np.linspace(0, 1, stations)),
        planes=np.array([-1, *quarters, steps + 1]),
        base_cap=0.0,
        tip_cap=0.0,
        tip_weight=0.0,
        base=np.array([1.0, 0.0, 0.0, 0.0]),
    )


def loads(gravity, tip=0.0, support=0, normal=(1.0, 0.0, 0.0), gap=0.0, stiffness=0.0):
    return Loads(
        gravity=np.array(gravity, float),
        payload=float(tip),
        payload_at=np.zeros(3),
        support=support,
        support_normal=np.array(normal, float),
        support_gap=float(gap),
        support_stiffness=stiffness,
    )


def equilibrium(rod, load, active=(0.0, 0.0, 0.0, 0.0), thrust=0.0):
    shape = new_shape(rod)
    shape.active[:] = active
    thrusts = np.full((len(rod.stiffness), len(rod.wall.areas)), thrust)
    assert balance(rod, load, 1.0, thrusts, rod.base, shape)
    assert shape.status[1] < 1e-7  # the reported residual, N mm
    return shape


def test_end_moment_gives_a_circular_arc():
    """A constant bending moment M bends to an arc of radius E I / M (Euler 1744)."""
    moment = 5.0
    shape = equilibrium(uniform_rod(solid_wall()), loads([0, 0, 1]), active=(0, moment, 0, 0))
    s = np.linspace(0, LENGTH, 5)
    curvature = moment / (MODULUS * SECOND)
    arc = np.stack(
        [0 * s, -(1 - np.cos(curvature * s)) / curvature, np.sin(curvature * s) / curvature], axis=1
    )
    assert curvature * LENGTH > 0.75  # a bend of 46 degrees, not a small one
    np.testing.assert_allclose(shape.centres, arc, atol=2e-5)
    np.testing.assert_allclose(
        shape.frames[-1][:, 2], [0, -np.sin(0.8049), np.cos(0.8049)], atol=2e-4
    )


def test_torque_twists_the_tip():
    """T L / (G J) about the axis (Saint-Venant)."""
    shape = equilibrium(uniform_rod(solid_wall()), loads([0, 0, 1]), active=(0, 0, 0, 2.0))
    angle = 2.0 * LENGTH / (MODULUS / 3 * 2 * SECOND)
    np.testing.assert_allclose(shape.frames[-1][:2, 0], [np.cos(angle), np.sin(angle)], atol=1e-9)


def test_small_cantilever():
    """w L^4 / 8 E I + w L^2 / 2 G A (Timoshenko 1921) for a weight that bends little."""
    weight = 1e-3
    shape = equilibrium(uniform_rod(solid_wall(), weight), loads([1, 0, 0]))
    w = weight / LENGTH
    bending = w * LENGTH**4 / (8 * MODULUS * SECOND)
    shear = w * LENGTH**2 / (2 * MODULUS / 3 * 27 / 28 * AREA)
    assert shape.centres[-1, 0] == pytest.approx(bending + shear, rel=1e-5)


def test_tip_load_on_a_large_cantilever():
    """Elastica of Bisshopp & Drucker (1945): P L^2 / E I = 2 bends the tip down by 0.4935 L.

    Their rod neither stretches nor shears; here both stiffnesses are raised a thousandfold.
    """
    wall = solid_wall()._replace(area=1e3 * AREA, shear=1e6)
    force = 2 * MODULUS * SECOND / LENGTH**2
    shape = equilibrium(uniform_rod(wall), loads([1, 0, 0], tip=force))
    assert shape.centres[-1, 0] / LENGTH == pytest.approx(0.4935, abs=3e-4)
    assert 1 - shape.centres[-1, 2] / LENGTH == pytest.approx(0.1606, abs=3e-4)


def test_extension_by_a_central_chamber():
    """p A / E A stretches the rod; a hanging weight adds half of its own W L / E A."""
    wall = solid_wall(areas=(25.0,))
    thrust, weight = 0.054 * 25.0, 0.1
    shape = equilibrium(uniform_rod(wall, weight), loads([0, 0, 1]), thrust=thrust)
    longer = LENGTH * (thrust + weight / 2) / (MODULUS * AREA)
    assert shape.centres[-1, 2] - LENGTH == pytest.approx(longer, rel=1e-9)


def test_fibre_thrust_follows_chou_and_hannaford():
    """The thrust p A (1 - 3 c^2 L^2) / (1 - c^2) balances E A (L - 1); L from its quadratic."""
    c2, thrust = np.cos(np.radians(80.0)) ** 2, 1.5
    wall = solid_wall(areas=(25.0,), fibre=c2)
    shape = equilibrium(uniform_rod(wall), loads([0, 0, 1]), thrust=thrust)
    stiffness = MODULUS * AREA
    roots = np.roots([3 * c2 * thrust / (1 - c2), stiffness, -stiffness - thrust / (1 - c2)])
    assert shape.centres[-1, 2] == pytest.approx(LENGTH * roots.max(), rel=1e-9)


def test_propped_cantilever():
    """A stiff support at the tip of a uniformly loaded cantilever carries 3 w L / 8.

    It touches over 0.05 mm, where the free tip would go down by 4 mm: 2 % of slack.
    """
    wall, weight = solid_wall()._replace(shear=1e6), 0.05
    rod = uniform_rod(wall, weight)
    assert equilibrium(rod, loads([1, 0, 0])).centres[-1, 0] > 3.5
    load = loads([1, 0, 0], support=16, normal=(-1.0, 0, 0), gap=0.0, stiffness=10.0)
    shape = equilibrium(rod, load)
    assert shape.unknown[3] == pytest.approx(3 * weight / 8, rel=0.02)
    assert abs(shape.centres[-1, 0]) < 0.06


def test_support_only_pushes():
    """Far from its plane the support carries nothing and the shape is the free one."""
    rod = uniform_rod(solid_wall(), 0.1)
    free = equilibrium(rod, loads([1, 0, 0]))
    away = equilibrium(
        rod, loads([1, 0, 0], support=10, normal=(1.0, 0, 0), gap=-30, stiffness=0.1)
    )
    np.testing.assert_allclose(away.centres, free.centres, atol=1e-3)
    assert 0 <= away.unknown[3] < 1e-5
    held = equilibrium(
        rod, loads([-1, 0, 0], support=10, normal=(1.0, 0, 0), gap=-1, stiffness=0.1)
    )
    assert held.unknown[3] > 0.01
    assert held.centres[-1, 0] > -free.centres[-1, 0]


def test_shape_does_not_depend_on_the_step():
    """Runge-Kutta of order 4: 16 steps agree with 64 to a thousandth of a millimetre."""
    wall = solid_wall(even=0.8, odd=4.0)
    tips = []
    for steps in (16, 64):
        rod = uniform_rod(wall, 0.07, rest=(0.01, 0.005), steps=steps)
        shape = equilibrium(rod, loads([0.6, 0, 0.8], tip=0.03), active=(0.5, 4.0, -2.0, 0.3))
        tips.append(shape.centres[-1].copy())
    np.testing.assert_allclose(tips[0], tips[1], atol=1e-3)


@settings(max_examples=60, deadline=None)
@given(
    eps=st.floats(-0.15, 0.3),
    bend=st.floats(0.0, 0.025),
    turn=st.floats(0, 6.28),
)
def test_section_law_is_the_integral_of_the_stress(eps, bend, turn):
    """Resultants of E (e + b e^2 + a e^3) by quadrature over the disc bring back the strains."""
    ux, uy = bend * np.cos(turn), bend * np.sin(turn)
    nodes, weights = np.polynomial.legendre.leggauss(8)
    radius, ring = RADIUS * (nodes + 1) / 2, RADIUS / 2 * weights
    angle = 2 * np.pi * np.arange(16) / 16
    x, y = radius[:, None] * np.cos(angle), radius[:, None] * np.sin(angle)
    area = (radius * ring)[:, None] * np.full(16, 2 * np.pi / 16)
    e = eps + ux * y - uy * x
    stress = MODULUS * (e + 0.8 * e**2 + 4.0 * e**3)
    force, mx, my = (stress * area).sum(), (stress * y * area).sum(), -(stress * x * area).sum()
    strain = np.zeros(3)
    wall = solid_wall(even=0.8, odd=4.0)
    taken = strain_under(wall, 1.0, np.zeros(1), force, mx, my, strain)
    assert taken != NOT_CONVERGED
    np.testing.assert_allclose(strain, [eps, ux, uy], atol=1e-9)


def relaxed_in_pyelastica(gravity, rest, tip, elements):
    """Centre line (3, elements + 1) [mm] of the same rod in PyElastica, damped until at rest."""
    elastica = pytest.importorskip("elastica")
    from elastica.timestepper.symplectic_steppers import PositionVerlet

    class Bench(elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing,
                elastica.Damping):  # fmt: skip
        pass

    bench = Bench()
    rod = elastica.CosseratRod.straight_rod(
        elements, np.zeros(3), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]),
        LENGTH, RADIUS, DENSITY, youngs_modulus=MODULUS, shear_modulus=MODULUS / 3,
    )  # fmt: skip
    rod.rest_kappa[:2] = np.array(rest)[:, None]
    step = 0.3 * LENGTH / elements / np.sqrt(MODULUS / DENSITY)
    bench.append(rod)
    bench.constrain(rod).using(
        elastica.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
    )
    pull = elastica.GravityForces
    bench.add_forcing_to(rod).using(pull, acc_gravity=np.array(gravity) * GRAVITY)
    bench.add_forcing_to(rod).using(
        elastica.EndpointForces, np.zeros(3), np.array(gravity) * tip, ramp_up_time=1e-3
    )
    bench.dampen(rod).using(elastica.AnalyticalLinearDamper, damping_constant=80.0, time_step=step)
    bench.finalize()
    elastica.integrate(PositionVerlet(), bench, 1.0, int(1.0 / step), progress_bar=False)
    return rod.position_collection, rod.shear_matrix[0, 0, 0], rod.bend_matrix[2, 2, 0]


def test_shape_under_gravity_agrees_with_pyelastica():
    """Gravity across a rod curved in space, with a tip weight: a 3D shape of 10 mm deflection.

    PyElastica's discretization is of first order in the element length where the rod has a rest
    curvature; Richardson's extrapolation of 16 and 32 elements removes that.
    """
    gravity, rest, tip = np.array([0.85, 0.5268, 0.0]), (0.006, -0.004), 0.02
    gravity /= np.linalg.norm(gravity)
    coarse, _, _ = relaxed_in_pyelastica(gravity, rest, tip, 16)
    fine, shear, torsion = relaxed_in_pyelastica(gravity, rest, tip, 32)
    other = (2 * fine[:, ::8] - coarse[:, ::4]).T
    wall = solid_wall()._replace(shear=shear, torsion=torsion)
    rod = uniform_rod(wall, DENSITY * AREA * LENGTH * GRAVITY, rest)
    mine = equilibrium(rod, loads(gravity, tip=tip)).centres
    straight = np.stack([np.zeros(5), np.zeros(5), np.linspace(0, LENGTH, 5)], axis=1)
    assert np.linalg.norm(mine - straight, axis=1).max() > 5.0
    np.testing.assert_allclose(mine, other, atol=0.02)
