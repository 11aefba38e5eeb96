"""One robot for each seed: build, size, mounting, stiffness, chambers and cameras.

Robots have three or four chambers or two segments of three, 130 to 300 mm, three to eight key
points, 20 to 50 Hz and noise of 0.1 to 0.35 mm; they stand upright, hang, lie level or hang tilted.
"""

import functools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from benchmarks.generators import STANDARD_GRAVITY, Cameras

STREAM = 0x3007
"""Number that tells this generator's draws from those of other rigs with the same seed."""
LINKS = 12
"""Links of an arm; divisible by two segments."""


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
    Build(3, (130.0, 180.0), 3, 50.0, 0.0, False, (180.0, 150.0), 200),
    Build(4, (170.0, 230.0), 5, 25.0, 90.0, True, (180.0, 150.0), 200),
    Build(6, (240.0, 300.0), 8, 20.0, 20.0, False, (180.0, 150.0), 200),
    Build(3, (180.0, 240.0), 4, 40.0, 180.0, True, (150.0, 75.0), 60),
    Build(4, (130.0, 190.0), 6, 20.0, 55.0, False, (150.0, 75.0), 100),
)
"""Builds by seed modulo their number."""


class Plant(NamedTuple):
    """All parameters of a robot with N links and m chambers; zero switches an effect off."""

    length: float
    """Length [m]."""
    radius: float
    """Radius [m]."""
    mass: float
    """Mass [kg]."""
    gravity: np.ndarray
    """(3,) acceleration of weight in the frame of the base [m/s^2]."""
    bend: np.ndarray
    """(N,) stiffness of each ball joint [N m/rad]."""
    axial: np.ndarray
    """(N,) stiffness of each slide joint [N/m]."""
    viscous_s: float
    """Damping of each joint over its stiffness [s]."""
    high: float
    """Upper limit of pressure [Pa]."""
    angles: np.ndarray
    """(m,) place of each chamber around the arm [rad]."""
    offset: np.ndarray
    """(m,) distance of each chamber from the axis [m]."""
    areas: np.ndarray
    """(m,) area of each chamber [m^2]."""
    first: np.ndarray
    """(m,) first link of each chamber."""
    last: np.ndarray
    """(m,) link behind its last."""
    line_s: np.ndarray
    """(m, 2) time constants of filling and venting at half the limit [s]."""
    reach: float
    """Bending of a joint by one chamber at its limit [rad]."""
    keys: np.ndarray
    """(n,) link at whose middle each key point is, counted from 1."""
    payload: np.ndarray
    """(2,) mass at the tip [kg] and the direction from the axis to its place on the rim [rad]."""
    friction: np.ndarray
    """(N,) dry friction in each ball joint [N m]."""
    creep: np.ndarray
    """(1 + N,) compliance of the joints in series over that of the arm's [-], and their times of
    retardation [s]."""
    misalignment: np.ndarray
    """(6,) rotation [rad] and shift [m] of the cameras' frame."""
    thick: float
    """Share by which damping grows for each reach per second of a joint's rate [-]."""
    ball: np.ndarray
    """(4,) centre and radius of a fixed ball beside the arm [m]; radius 0: none."""
    damage: float
    """Share of its stiffness that a joint loses when it has bent by twice the reach [-]."""
    bulge: float
    """Share of its area that a chamber gains over a neighbour without pressure [-]."""
    touch: float
    """Mean pressure at which a part of a bladder touches the wall [Pa]."""
    drift: np.ndarray
    """(3,) rotation of the base after ten minutes [rad]."""
    stiffening: float
    """Share by which a joint stiffens when it has bent by the reach [-]."""
    fibre: float
    """Angle about the axis by which a chamber's fibres lean over a joint [rad]."""
    warmth: float
    """Power of the absolute temperature with which stiffness falls [-]."""
    breath: np.ndarray
    """(5,) shift of the base at the depth of a breath [m], mean period and phase [s]."""
    hose: np.ndarray
    """(4,) direction of the guide [rad], stiffness [N/m], static and kinetic friction [N]."""
    cable: np.ndarray
    """(6,) anchor [m], free length [m], stiffness [N/m], and moment from which on the length is
    held at what it then is [s]; 0: the free length is that given."""
    leak: np.ndarray
    """(K, 2) begin and end of each spell in which a seal lifts [s]."""
    leaking: np.ndarray
    """(2,) chamber, and square of the ratio of the leak's orifice to the line's [-]."""
    play: float
    """Angle by which the mount is loose [rad]."""
    wind: np.ndarray
    """(3,) wind in a gust [m/s]."""
    gusts: np.ndarray
    """(K, 2) begin and end of each gust [s]."""
    loosened: np.ndarray
    """(3,) chamber that comes loose over its last two thirds, the moment [s], and the share
    of its area there; moment 0: none."""


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


@functools.cache
def make_robot(seed: int) -> Robot:
    """The robot of a seed without hidden effects; nobody may change its arrays."""
    rng = np.random.default_rng([seed, STREAM])
    build = build_of(seed)
    m, n, segments = build.chambers, LINKS, 2 if build.chambers == 6 else 1
    ring = m // segments
    length = 1e-3 * rng.uniform(*build.length_mm)
    radius = length / segments / rng.uniform(7.5, 10.5)
    mass = rng.uniform(900.0, 1150.0) * math.pi * radius**2 * length
    # Weight over bending stiffness of the whole arm; an upright one buckles at 7.8.
    slack = rng.uniform(0.3, 1.2)
    stiffness = mass * STANDARD_GRAVITY * length**2 / slack
    uneven = 1.0 + rng.uniform(-0.12, 0.12) * np.linspace(-1.0, 1.0, n)
    uneven *= np.exp(rng.normal(0.0, 0.03, n))
    bend = stiffness * n / length * uneven
    axial = rng.uniform(1.5, 3.0) * stiffness / radius**2 * n / length * uneven
    reach = math.radians(rng.uniform(40.0, 70.0)) * segments / n
    high = 1e3 * round(rng.uniform(10.0, 30.0)) * 5.0
    part = np.arange(m) // ring
    angles = 2 * np.pi * np.arange(m) / ring + rng.uniform(0, 2 * np.pi) + part * np.pi / ring
    angles += np.radians(rng.normal(0.0, 4.0, m))
    offset = rng.uniform(0.5, 0.65) * radius * (1.0 + rng.normal(0.0, 0.03, m))
    areas = reach * bend.mean() / (high * offset.mean()) * (1.0 + rng.normal(0.0, 0.05, m))
    tilt, around = math.radians(build.tilt_deg), rng.uniform(0, 2 * np.pi)
    tilt += math.radians(rng.normal(0.0, 3.0))
    down = [math.sin(tilt) * math.cos(around), math.sin(tilt) * math.sin(around), math.cos(tilt)]
    plant = Plant(
        length=length,
        radius=radius,
        mass=mass,
        gravity=STANDARD_GRAVITY * np.array(down),
        bend=bend,
        axial=axial,
        viscous_s=rng.uniform(0.04, 0.07),
        high=high,
        angles=angles,
        offset=offset,
        areas=areas,
        first=part * n // segments,
        last=(part + 1) * n // segments,
        line_s=np.stack([np.full(m, 0.02), np.full(m, 0.03)], axis=1),
        reach=reach,
        keys=np.round(np.linspace(n / build.key_points, n, build.key_points)).astype(np.int64),
        payload=np.zeros(2),
        friction=np.zeros(n),
        creep=np.zeros(1 + n),
        misalignment=np.zeros(6),
        thick=0.0,
        ball=np.zeros(4),
        damage=0.0,
        bulge=0.0,
        touch=0.0,
        drift=np.zeros(3),
        stiffening=rng.uniform(0.0, 0.05),
        fibre=0.0,
        warmth=0.0,
        breath=np.zeros(5),
        hose=np.zeros(4),
        cable=np.zeros(6),
        leak=np.zeros((0, 2)),
        leaking=np.zeros(2),
        play=0.0,
        wind=np.zeros(3),
        gusts=np.zeros((0, 2)),
        loosened=np.zeros(3),
    )
    noise = math.exp(rng.uniform(math.log(0.1), math.log(0.35)))
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
