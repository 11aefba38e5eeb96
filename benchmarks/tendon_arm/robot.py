"""One robot for each seed: build, size, mounting, stiffness, tendons, motors and cameras.

Robots have three or four tendons or two sections of three, 120 to 400 mm, 10 to 16 links, four to
eight key points, 10 to 25 Hz, a first mode of 1.5 to 8 Hz and noise of 0.05 to 0.3 mm; they hang,
lie level, stand upright or hang tilted.
"""

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from benchmarks.generators import STANDARD_GRAVITY, Cameras

STREAM = 0x7E4D
"""Number that tells this generator's draws from those of other rigs with the same seed."""


@dataclass(frozen=True)
class Build:
    """What is not drawn of a robot."""

    tendons: int
    """Tendons; six are two sections of three, of which the upper three pass the lower section."""
    links: int
    """Links; divisible by the sections."""
    length_mm: tuple[float, float]
    """Range of its length [mm]."""
    mode_hz: tuple[float, float]
    """Range of the first mode of its backbone without tendons and weight [Hz]."""
    key_points: int
    """Key points."""
    rate_hz: float
    """Frames in a second [Hz]."""
    tilt_deg: float
    """Angle between weight and the arm's axis: 0 hangs, 90 is level, 180 stands upright [deg]."""
    both_ways: bool
    """Whether a motor also pays out, from a tendon that is always tight."""
    tight: float
    """Pull at rest over the upper limit of pull; below zero a tendon is slack at rest [-]."""
    friction: tuple[float, float]
    """Range of the friction of a tendon in its holes [-]."""
    encoders: bool
    """Whether the drums have encoders; otherwise the set points are recorded."""
    drops: bool
    """Whether its cameras drop frames."""
    before_s: tuple[float, float]
    """Durations of the two recordings before a change [s]."""
    epochs: int
    """Most epochs of the fit to them: 200 is what `fit` takes by itself."""


ROLLERS, LOW, HIGH = (0.01, 0.03), (0.03, 0.08), (0.3, 0.45)
"""Friction of a tendon on rollers, of a plastic one in greased holes, and of a steel one in bare
holes [-]."""
BUILDS = (
    Build(3, 16, (220, 300), (1.5, 2.4), 5, 20, 0, False, 0.3, LOW, True, False, (180, 150), 200),
    Build(
        4, 12, (180, 240), (2.5, 4.0), 4, 12.5, 90, True, 2.0, ROLLERS, True, True, (180, 150), 200
    ),
    Build(6, 16, (300, 400), (2.0, 3.0), 8, 20, 20, False, 0.4, LOW, True, False, (180, 150), 200),
    Build(3, 10, (120, 170), (2.5, 3.5), 4, 25, 180, False, 0.5, HIGH, True, True, (150, 75), 100),
    Build(
        4, 14, (160, 220), (3.0, 4.5), 6, 10, 60, False, -0.25, LOW, False, False, (180, 150), 200
    ),
)
"""Builds by seed modulo their number."""
RETARDED = 3
"""Elements of a tendon that creeps."""


class Plant(NamedTuple):
    """All parameters of a robot with N links, m tendons and M segments of them from disk to disk.

    Zero switches an effect off.
    """

    length: float
    """Length [m]."""
    radius: float
    """Radius of its disks [m]."""
    mass: float
    """Mass [kg]."""
    gravity: np.ndarray
    """(3,) acceleration of weight in the frame of the base [m/s^2]."""
    bend: np.ndarray
    """(N,) stiffness of each joint about either axis [N m/rad]."""
    twist: float
    """Stiffness of each joint about the axis where it can twist [N m/rad]."""
    viscous_s: float
    """Damping of each joint over its stiffness [s]."""
    low: float
    """Lower limit of pull [m]."""
    high: float
    """Upper limit of pull [m]."""
    angles: np.ndarray
    """(m,) place of each tendon around the arm [rad]."""
    offset: np.ndarray
    """(m,) distance of each tendon from the axis [m]."""
    ends: np.ndarray
    """(m,) disk at which each tendon ends, counted from 1; its number of segments."""
    pull: np.ndarray
    """(m,) stiffness of each tendon with its motor [N/m]."""
    tight: np.ndarray
    """(m,) stretch of each tendon of the straight arm at rest, below zero its slack [m]."""
    friction: float
    """Friction of a tendon in its holes [-]."""
    wrap: float
    """Angle by which a hole deflects a tendon of the straight arm [rad]."""
    sheath: float
    """Angle by which the way from the motor to the base deflects a tendon [rad]."""
    slip: float
    """Way of a tendon in a hole after which its friction is full [m]."""
    servo: np.ndarray
    """(2,) frequency [rad/s] and damping [-] of a motor's control."""
    reach: float
    """Bending of a joint by one tendon at its limit [rad]."""
    keys: np.ndarray
    """(n,) disk at which each key point is, counted from 1."""
    payload: np.ndarray
    """(2,) mass at the tip [kg] and the direction from the axis to its place on the rim [rad]."""
    gains: np.ndarray
    """(m,) radius of each drum over the stated one [-]."""
    lag_s: np.ndarray
    """(m,) time constant of a drum behind its encoder for small steps [s]."""
    fastest: float
    """Highest speed of such a drum [m/s]."""
    backlash: np.ndarray
    """(m,) play between encoder and drum [m]."""
    creep: np.ndarray
    """(1 + RETARDED,) elongation of a tendon under half the tension of the limit [m], and times of
    retardation [s]."""
    misalignment: np.ndarray
    """(6,) rotation [rad] and shift [m] of the cameras' frame."""
    grease: np.ndarray
    """(2,) drag over speed of a tendon that slides slowly [N s/m], and the speed from which it
    thins [m/s]."""
    post: np.ndarray
    """(7,) ends and radius of a round post beside the arm [m]; radius 0: none."""
    worn: float
    """Share of its stiffness that a joint loses at last [-]."""
    yields: float
    """Compliance of the motors' frame between neighbours over that of a tendon [-]."""
    toe: np.ndarray
    """(m,) stretch up to which a tendon sags [m]."""
    drift: np.ndarray
    """(3,) rotation of the base that it approaches [rad]."""
    sleeve: np.ndarray
    """(2,) bending of a joint from which a sleeve is taut [rad], and its stiffness over the
    joint's [-]."""
    coil: float
    """Couple about the axis over the tension of all tendons [m]."""
    warmth: np.ndarray
    """(m,) elongation of each tendon per kelvin [m/K]."""
    balanced: np.ndarray
    """(2,) mass without weight [kg] and the disk at which it is."""
    draught: np.ndarray
    """(5,) force on the upper half [N], frequency [Hz] and phase [rad]."""
    slides: np.ndarray
    """(K, 3) key point, moment [s] and way along the arm [m] of a marker's slips."""
    loose: np.ndarray
    """(4,) disk, angle by which it turns either way [rad], share of the tension that turns it [-]
    and the side to which it is [rad]; angle 0: none."""
    jumped: np.ndarray
    """(4,) tendon, disk, the moment at which it leaves its hole [s], and the share of its distance
    from the axis that it keeps; moment 0: none."""
    kink: np.ndarray
    """(3,) tendon, and static and kinetic friction in a kink as a stretch [m]."""
    snag: np.ndarray
    """(6,) anchor of a cord [m], the disk that it holds from one moment on, its stiffness [N/m] and
    that moment [s]; stiffness 0: none."""
    screw: np.ndarray
    """(3,) tendon, tension at which its drum slips [N] and way of a slip [m]; way 0: none."""
    steps: np.ndarray
    """(2,) speed at which a motor loses steps [m/s], and way of one loss [m]; way 0: none."""


@dataclass(frozen=True)
class Robot:
    """A robot as it was built."""

    plant: Plant
    """Its physics."""
    cameras: Cameras
    """Its cameras."""
    low: float
    """Lower limit of pull [m]."""
    length_mm: float
    """Length [mm]."""
    radius_mm: float
    """Radius [mm]."""


def build_of(seed: int) -> Build:
    """The build of a robot's seed."""
    return BUILDS[seed % len(BUILDS)]


@functools.cache
def make_robot(seed: int) -> Robot:
    """The robot of a seed without hidden effects; nobody may change its arrays."""
    rng = np.random.default_rng([seed, STREAM])
    build = build_of(seed)
    m, n, sections = build.tendons, build.links, 2 if build.tendons == 6 else 1
    ring = m // sections
    length = 1e-3 * rng.uniform(*build.length_mm)
    radius = length / sections / rng.uniform(13.0, 18.0)
    mass = rng.uniform(500.0, 800.0) * math.pi * radius**2 * length
    # The first mode of a cantilever (Blevins 1979): 3.516 sqrt(B / (m L^3)).
    first = 2.0 * math.pi * rng.uniform(*build.mode_hz)
    beam = mass * length**3 * (first / 3.516) ** 2
    uneven = 1.0 + rng.uniform(-0.1, 0.1) * np.linspace(-1.0, 1.0, n)
    bend = beam * n / length * uneven * np.exp(rng.normal(0.0, 0.03, n))
    part = np.arange(m) // ring
    angles = 2 * np.pi * np.arange(m) / ring + rng.uniform(0, 2 * np.pi) + part * np.pi / ring
    angles += np.radians(rng.normal(0.0, 3.0, m))
    offset = rng.uniform(0.7, 0.8) * radius * (1.0 + rng.normal(0.0, 0.02, m))
    # Stiffness of a tendon over that of a section's backbone, both against bending.
    stiff = rng.uniform(0.7, 2.0)
    pull = stiff * beam * sections / length / offset.mean() ** 2
    turn = math.radians(rng.uniform(45.0, 75.0)) / (1.6 if build.both_ways else 1.0)
    against = 0.5 * ring if build.tight > 0.0 else 0.5
    high = 1e-3 * round(1e3 * turn * offset.mean() * (1.0 + stiff * against) / stiff)
    tilt, around = math.radians(build.tilt_deg), rng.uniform(0, 2 * np.pi)
    tilt += math.radians(rng.normal(0.0, 3.0))
    down = [math.sin(tilt) * math.cos(around), math.sin(tilt) * math.sin(around), math.cos(tilt)]
    plant = Plant(
        length=length,
        radius=radius,
        mass=mass,
        gravity=STANDARD_GRAVITY * np.array(down),
        bend=bend,
        twist=0.5 * float(bend.mean()),
        viscous_s=2.0 * rng.uniform(0.07, 0.25) / first,
        low=-high if build.both_ways else 0.0,
        high=high,
        angles=angles,
        offset=offset,
        ends=(part + 1) * n // sections,
        pull=pull * np.exp(rng.normal(0.0, 0.04, m)),
        tight=build.tight * high * np.exp(rng.normal(0.0, 0.05, m)),
        friction=rng.uniform(*build.friction),
        wrap=rng.uniform(0.05, 0.1),
        sheath=rng.uniform(0.3, 1.0),
        slip=rng.uniform(0.01, 0.025) * high,
        servo=np.array([rng.uniform(25.0, 45.0), rng.uniform(0.75, 1.0)]),
        reach=turn * sections / n,
        keys=np.round(np.linspace(n / build.key_points, n, build.key_points)).astype(np.int64),
        payload=np.zeros(2),
        gains=np.ones(m),
        lag_s=np.zeros(m),
        fastest=1.0,
        backlash=np.zeros(m),
        creep=np.zeros(1 + RETARDED),
        misalignment=np.zeros(6),
        grease=np.zeros(2),
        post=np.zeros(7),
        worn=0.0,
        yields=0.0,
        toe=np.zeros(m),
        drift=np.zeros(3),
        sleeve=np.zeros(2),
        coil=0.0,
        warmth=np.zeros(m),
        balanced=np.zeros(2),
        draught=np.zeros(5),
        slides=np.zeros((0, 3)),
        loose=np.zeros(4),
        jumped=np.zeros(4),
        kink=np.zeros(3),
        snag=np.zeros(6),
        screw=np.zeros(3),
        steps=np.zeros(2),
    )
    noise = math.exp(rng.uniform(math.log(0.05), math.log(0.3)))
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
    return Robot(plant, cameras, plant.low, 1e3 * length, 1e3 * radius)
