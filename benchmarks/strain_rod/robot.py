"""One robot for each seed: build, size, mounting, stiffness, chambers, regulators and cameras.

Robots have three or four chambers or two segments of three, 120 to 320 mm, four to nine key points,
20 to 50 Hz and noise of 0.1 to 0.36 mm; they hang, hang tilted, lie level or stand askew.
"""

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre

from benchmarks.generators import STANDARD_GRAVITY, Cameras

STREAM = 0x5708
"""Number that tells this generator's draws from those of other rigs with the same seed."""
PARTS = 12
"""Intervals of an arm; an even number in each of two segments, for Simpson's rule."""
GAUSS = (0.5 - math.sqrt(3.0) / 6.0, 0.5 + math.sqrt(3.0) / 6.0)
"""Places of the two Gauss points of an interval, as shares of it [-]."""
TERMS = (4, 4, 2, 2)
"""Legendre polynomials of a segment for bending about x and y, torsion and stretch."""
TORSION = 0.7
"""Torsional over bending stiffness [-]: 1 / (1 + nu) of a round section, 0.67 in rubber."""


@dataclass(frozen=True)
class Build:
    """What is not drawn of a robot."""

    chambers: int
    """Chambers; six are two segments of three."""
    length_mm: tuple[float, float]
    """Range of its length [mm]."""
    key_points: int
    """Key points."""
    rate_hz: float
    """Frames in a second [Hz]."""
    tilt_deg: float
    """Angle between weight and the arm's axis: 0 hangs, 90 is level, 180 stands upright [deg]."""
    drops: bool
    """Whether its cameras drop frames."""
    before_s: tuple[float, float]
    """Durations of the two recordings before a change [s]."""
    epochs: int
    """Most epochs of the fit to them: 200 is what `fit` takes by itself."""


BUILDS = (
    Build(3, (120.0, 170.0), 4, 50.0, 30.0, False, (180.0, 150.0), 200),
    Build(4, (160.0, 220.0), 6, 25.0, 90.0, True, (180.0, 150.0), 200),
    Build(6, (250.0, 320.0), 9, 20.0, 10.0, False, (180.0, 150.0), 200),
    Build(3, (180.0, 250.0), 5, 40.0, 150.0, True, (150.0, 75.0), 60),
    Build(4, (130.0, 190.0), 7, 25.0, 60.0, False, (150.0, 75.0), 100),
)
"""Builds by seed modulo their number."""


class Wall(NamedTuple):
    """Parameters of the wall; zero switches a term off."""

    viscous: float
    """Time constant of the linear dashpot [s]."""
    locking: float
    """Inverse of the mean square strain at which chains are straight, lambda [-]."""
    friction: np.ndarray
    """(3,) stress at the limit of pressure f [-], share of it without pressure f_0 [-], and strain
    at which fibres slip x_y [-]."""
    flow: np.ndarray
    """(3,) compliance c [-], stress scale s_0 [-] and time tau [s] of creep."""
    fluid: np.ndarray
    """(2,) stress e [-] and time lambda [s] of the fluid."""
    damage: float
    """Largest share d of its stiffness that the wall loses [-]."""
    helix: float
    """Torsion h by which helical fibres turn sections where the arm is stretched by 1 [-]."""


class Gas(NamedTuple):
    """Parameters of the pneumatics of m chambers."""

    regulator: np.ndarray
    """(2,) frequency [rad/s] and damping [-] of a regulator."""
    line: np.ndarray
    """(m,) rate at which each chamber fills through half of its hose [1/s]."""
    swell: float
    """Relative growth of a chamber's volume at the upper limit [-]."""
    relief: np.ndarray
    """(4,) chamber, pressures at which its valve opens and closes [Pa], and rate at which it
    vents [1/s]; rate 0: none."""
    crossed: np.ndarray
    """(3,) two chambers, and rate at which they exchange air [1/s]; rate 0: never."""
    crossing: np.ndarray
    """(K, 2) begin and end of each spell in which they do [s]."""


class Plant(NamedTuple):
    """All parameters of a robot with S segments, G Gauss points and m chambers; zero switches an
    effect off."""

    length: float
    """Length [m]."""
    radius: float
    """Radius [m]."""
    mass: float
    """Mass [kg]."""
    gravity: np.ndarray
    """(3,) acceleration of weight in the frame of the bench [m/s^2]."""
    basis: np.ndarray
    """(G / S, D) polynomials of a segment at its Gauss points [-]."""
    component: np.ndarray
    """(D,) component of strain of each polynomial: 0, 1 bending, 2 torsion, 3 stretch."""
    bend: np.ndarray
    """(G,) bending stiffness [N m^2]."""
    ratio: np.ndarray
    """(4,) stiffness of each component over that of bending [-]; of stretch [1/m^2]."""
    reference: np.ndarray
    """(4,) strain that counts as 1: of one chamber at its limit [1/m]; of stretch [-]."""
    bow: np.ndarray
    """(G, 2) bending as cast [-]."""
    wall: Wall
    """Material."""
    gas: Gas
    """Pneumatics."""
    high: float
    """Upper limit of pressure [Pa]."""
    angles: np.ndarray
    """(m,) place of each chamber around the arm [rad]."""
    offset: np.ndarray
    """(m,) distance of each chamber from the axis [m]."""
    areas: np.ndarray
    """(m,) area of each chamber [m^2]."""
    growth: float
    """Relative growth of an area at the upper limit [-]."""
    keys: np.ndarray
    """(n,) node at which each key point is; the base is node 0."""
    payload: np.ndarray
    """(4,) mass [kg] and its place in the frame of the tip [m]."""
    septum: np.ndarray
    """(2,) share of its area that a chamber gains where its pressure is twice the mean of its
    segment [-], and pressure of the septa's own stiffness [Pa]."""
    slack: np.ndarray
    """(m,) pressure that pulls half of a chamber's fabric taut [Pa]."""
    plate: np.ndarray
    """(8,) point on a plate beside the arm [m], its normal towards the arm, stiffness per length
    of the arm [N/m^2], and depth at which it grows by e [m]; stiffness 0: none."""
    drift: np.ndarray
    """(3,) rotation of the base after ten minutes [rad]."""
    misalignment: np.ndarray
    """(6,) rotation [rad] and shift [m] of the cameras' frame."""
    warmth: float
    """Factor on the change of the modulus with absolute temperature [-]."""
    breath: np.ndarray
    """(5,) shift of the base at the depth of a breath [m], mean period and phase [s]."""
    dragged: np.ndarray
    """(4,) rate at which the base is turned [rad/s], and the axis."""
    slips: np.ndarray
    """(K, 2) moment of each slip [s], and angle of the base behind it [rad]."""
    steps: np.ndarray
    """(K,) moments of steps beside the table [s]."""
    shaken: np.ndarray
    """(5,) turn of the base by a step [rad], frequency [rad/s] and damping [-] of the table."""
    broken: np.ndarray
    """(5,) chamber whose fibres break, first Gauss point, the one behind the last, moment [s], and
    share by which it pushes more there; moment 0: none."""
    hose: np.ndarray
    """(3,) pull at the tip [N], and period [s] and phase [rad] with which it goes around."""
    sun: np.ndarray
    """(2,) bending of the arm whose one side is warm, about x and y [-]."""
    shining: np.ndarray
    """(K, 2) begin and end of each spell of sun [s]."""


@dataclass(frozen=True)
class Robot:
    """A robot as it was built."""

    plant: Plant
    """Its physics."""
    cameras: Cameras
    """Its cameras."""
    low: float
    """Lower limit of pressure [Pa]."""
    length_mm: float
    """Length [mm]."""
    radius_mm: float
    """Radius [mm]."""


def build_of(seed: int) -> Build:
    """The build of a robot's seed."""
    return BUILDS[seed % len(BUILDS)]


def polynomials(parts: int) -> tuple[np.ndarray, np.ndarray]:
    """(2 parts, D) Legendre polynomials of a segment at its Gauss points, and (D,) components."""
    places = (np.arange(parts)[:, None] + np.array(GAUSS)).ravel() / parts
    rows = [
        legendre.legval(2.0 * places - 1.0, np.eye(terms)[k])
        for terms in TERMS
        for k in range(terms)
    ]
    return np.array(rows).T.copy(), np.repeat(np.arange(len(TERMS)), TERMS)


@functools.cache
def make_robot(seed: int) -> Robot:
    """The robot of a seed without hidden effects; nobody may change its arrays."""
    rng = np.random.default_rng([seed, STREAM])
    build = build_of(seed)
    m, points, segments = build.chambers, 2 * PARTS, 2 if build.chambers == 6 else 1
    ring = m // segments
    length = 1e-3 * rng.uniform(*build.length_mm)
    radius = length / segments / rng.uniform(7.5, 10.5)
    mass = rng.uniform(850.0, 1150.0) * math.pi * radius**2 * length
    # Weight over bending stiffness of the whole arm; an upright one buckles at 7.8.
    slack = rng.uniform(0.3, 1.2)
    stiffness = mass * STANDARD_GRAVITY * length**2 / slack
    uneven = 1.0 + rng.uniform(-0.12, 0.12) * np.linspace(-1.0, 1.0, points)
    bend = stiffness * uneven
    axial = rng.uniform(3.0, 6.0) / radius**2  # 4 / R^2 of a solid round section
    reach = math.radians(rng.uniform(40.0, 70.0))  # of a segment under one chamber
    curvature = reach * segments / length
    high = 1e3 * round(rng.uniform(8.0, 28.0)) * 5.0
    part = np.arange(m) // ring
    angles = 2 * np.pi * np.arange(m) / ring + rng.uniform(0, 2 * np.pi) + part * np.pi / ring
    angles += np.radians(rng.normal(0.0, 4.0, m))
    offset = rng.uniform(0.5, 0.65) * radius * (1.0 + rng.normal(0.0, 0.03, m))
    areas = curvature * stiffness / (high * offset.mean()) * (1.0 + rng.normal(0.0, 0.05, m))
    stretch = high * areas.mean() / (axial * stiffness)
    tilt, around = math.radians(build.tilt_deg), rng.uniform(0, 2 * np.pi)
    tilt += math.radians(rng.normal(0.0, 3.0))
    down = [math.sin(tilt) * math.cos(around), math.sin(tilt) * math.sin(around), math.cos(tilt)]
    basis, component = polynomials(PARTS // segments)
    along = np.linspace(0.0, 1.0, points)[:, None]
    bow = rng.normal(0.0, 0.04, 2) + rng.normal(0.0, 0.04, 2) * along
    wall = Wall(
        viscous=rng.uniform(0.04, 0.08),
        locking=rng.uniform(0.01, 0.04),
        friction=np.array([rng.uniform(0.003, 0.012), 0.4, 0.15]),
        flow=np.array([0.0, 0.1, 1.0]),
        fluid=np.array([0.0, 1.0]),
        damage=0.0,
        helix=0.0,
    )
    gas = Gas(
        regulator=np.array([rng.uniform(20.0, 45.0), rng.uniform(0.7, 1.1)]),
        line=rng.uniform(80.0, 120.0, m),
        swell=rng.uniform(0.1, 0.4),
        relief=np.zeros(4),
        crossed=np.zeros(3),
        crossing=np.zeros((0, 2)),
    )
    plant = Plant(
        length=length,
        radius=radius,
        mass=mass,
        gravity=STANDARD_GRAVITY * np.array(down),
        basis=basis,
        component=component,
        bend=bend,
        ratio=np.array([1.0, 1.0, TORSION, axial]),
        reference=np.array([curvature, curvature, curvature, stretch]),
        bow=bow,
        wall=wall,
        gas=gas,
        high=high,
        angles=angles,
        offset=offset,
        areas=areas,
        growth=rng.uniform(-0.03, 0.08),
        keys=np.round(np.linspace(PARTS / build.key_points, PARTS, build.key_points)).astype(
            np.int64
        ),
        payload=np.zeros(4),
        septum=np.array([0.0, 1.0]),
        slack=np.zeros(m),
        plate=np.zeros(8),
        drift=np.zeros(3),
        misalignment=np.zeros(6),
        warmth=0.0,
        breath=np.zeros(5),
        dragged=np.zeros(4),
        slips=np.zeros((0, 2)),
        steps=np.zeros(0),
        shaken=np.zeros(5),
        broken=np.zeros(5),
        hose=np.zeros(3),
        sun=np.zeros(2),
        shining=np.zeros((0, 2)),
    )
    noise = math.exp(rng.uniform(math.log(0.1), math.log(0.36)))
    slow = rng.uniform(0.2, 0.6)
    cameras = Cameras(
        period_s=1.0 / build.rate_hz,
        white_mm=noise * math.sqrt(1.0 - slow**2),
        slow_mm=noise * slow,
        slow_s=rng.uniform(0.2, 2.0),
        dropped=rng.uniform(0.005, 0.03) if build.drops else 0.0,
        burst_s=rng.uniform(0.1, 0.5),
        hidden=rng.uniform(0.002, 0.02) if build.drops else 0.0,
    )
    return Robot(plant, cameras, 0.0, 1e3 * length, 1e3 * radius)
