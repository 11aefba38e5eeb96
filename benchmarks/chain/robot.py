"""One robot for each seed: build, size, material, cameras, and how well it is fitted.

Robots differ as those of laboratories do: three or four chambers or two segments of three, 150 to
400 mm, four to nine key points, 20 to 50 Hz, noise of 0.05 to 0.5 mm, cameras that drop frames,
and recordings for the fit that are long or short. `BUILDS` has two robots of each build, so that
each has another one whose model can be asked by mistake.
"""

import math
from dataclasses import dataclass

import numpy as np

from benchmarks.chain.gas import Gas
from benchmarks.chain.plant import Plant
from benchmarks.chain.wall import Wall
from benchmarks.generators import STANDARD_GRAVITY, Cameras, hanging

STREAM = 0xC4A1
"""Number that tells this generator's draws from those of other rigs with the same seed."""
LINKS = 18
"""Links of a chain; divisible by two segments."""


@dataclass(frozen=True)
class Build:
    """What is not drawn of a robot."""

    chambers: int
    """Chambers; six are two segments of three."""
    key_points: int
    """Key points."""
    before_s: tuple[float, float]
    """Durations of the two recordings before a change [s]."""
    epochs: int
    """Most epochs of the fit to them: 200 is what `fit` takes by itself."""


BUILDS = (
    Build(3, 5, (180.0, 150.0), 200),
    Build(3, 5, (150.0, 75.0), 60),
    Build(4, 4, (180.0, 150.0), 200),
    Build(4, 4, (100.0, 50.0), 25),
    Build(6, 9, (180.0, 150.0), 200),
    Build(6, 9, (150.0, 75.0), 60),
)
"""Builds by seed modulo their number: good, mediocre and poor fits."""


@dataclass(frozen=True)
class Robot:
    """A robot as it was built."""

    plant: Plant
    """Its physics."""
    cameras: Cameras
    """Its cameras."""
    low: float
    """Lower limit of pressure [Pa]; below 0 with a vacuum line."""
    length_mm: float
    """Length [mm]."""
    radius_mm: float
    """Radius [mm]."""


def build_of(seed: int) -> Build:
    """The build of a robot's seed."""
    return BUILDS[seed % len(BUILDS)]


def make_robot(seed: int) -> Robot:
    """The robot of a seed without hidden effects."""
    rng = np.random.default_rng([seed, STREAM])
    build = build_of(seed)
    m, n, segments = build.chambers, LINKS, 2 if build.chambers == 6 else 1
    length = rng.uniform(0.25, 0.4) if segments == 2 else rng.uniform(0.15, 0.28)
    radius = length / segments / rng.uniform(7.0, 10.0)
    density = rng.uniform(700.0, 1100.0)
    down = hanging(rng)
    link, area = length / n, math.pi * radius**2
    second = math.pi * radius**4 / 4.0
    # Weight over bending stiffness of the whole arm: hanging arms may be softer than lying ones.
    slack = rng.uniform(0.4, 1.6)
    modulus = density * area * STANDARD_GRAVITY * length**3 / (second * slack)
    taper = 1.0 + rng.uniform(-0.15, 0.15) * (np.arange(n) / (n - 1) - 0.5)
    uneven = taper * np.exp(rng.normal(0.0, 0.03, n))
    bend = modulus * second * uneven / link
    axial = modulus * area * rng.uniform(0.6, 1.0) * uneven

    a_segment = m // segments
    angles = 2 * np.pi * np.arange(m) / a_segment + rng.uniform(0, 2 * np.pi)
    angles += np.repeat(np.arange(segments), a_segment) * np.pi / a_segment
    angles += np.radians(rng.normal(0.0, 3.0, m))
    offset = rng.uniform(0.5, 0.65) * radius * (1 + rng.normal(0.0, 0.03, m))
    chamber = np.pi * (rng.uniform(0.24, 0.33) * radius) ** 2 * (1 + rng.normal(0.0, 0.05, m))
    reach = math.radians(rng.uniform(45.0, 85.0))  # of a segment under one chamber
    high = reach / (length / segments) * modulus * second / (chamber.mean() * offset.mean())
    limit = 1e3 * round(math.exp(rng.uniform(math.log(40.0), math.log(120.0))))
    high, chamber = limit, chamber * high / limit  # wide bellows at low pressures
    angle = high * chamber.mean() * offset.mean() / bend
    stretch = high * chamber.mean() / axial
    areas = np.zeros((m, n))
    for i in range(m):
        part = i // a_segment
        areas[i, part * n // segments : (part + 1) * n // segments] = chamber[i]
    keys = np.round(np.linspace(n / build.key_points, n, build.key_points)).astype(np.int64)

    wall = Wall(
        viscous=rng.uniform(0.03, 0.08),
        friction=np.array([rng.uniform(0.005, 0.03), rng.uniform(0.05, 0.15)]),
        relaxing=np.zeros(2),
        damage=0.0,
        locking=rng.uniform(0.0, 0.05),
        fluid=np.array([0.0, 0.5]),
    )
    gas = Gas(line=np.full(m, rng.uniform(5.0, 12.0)), rate=rng.uniform(2.0, 6.0) * high)
    plant = Plant(
        link=link,
        mass=density * area * link * uneven,
        tip=rng.uniform(0.0, 0.06) * density * area * length,
        gravity=STANDARD_GRAVITY * down,
        bend=bend,
        axial=axial,
        angle=angle,
        stretch=stretch,
        bow=rng.normal(0.0, 0.05, 2) + rng.normal(0.0, 0.02, (n, 2)),
        wall=wall,
        gas=gas,
        high=high,
        areas=areas,
        levers=(offset * np.stack([np.cos(angles), np.sin(angles)])).T.copy(),
        growth=rng.uniform(-0.08, 0.15),
        unfold=np.zeros(m),
        pressed=np.zeros((m, m)),
        fibre=0.0,
        warmth=0.0,
        drift=np.zeros(3),
        misalignment=np.zeros(6),
        post=np.zeros(8),
        breath=np.zeros(5),
        knock=np.zeros(4),
        tear=np.zeros(3),
        slip=np.zeros(3),
        stick=np.zeros(2),
        kink=np.zeros(3),
        snap=np.zeros(5),
        dropouts=np.zeros((0, 2)),
        vented=0,
        keys=keys,
        radius=radius,
    )
    noise = math.exp(rng.uniform(math.log(0.05), math.log(0.5)))
    slow = rng.uniform(0.2, 0.6)
    drops = rng.random() < 0.5
    cameras = Cameras(
        period_s=float(rng.choice([0.05, 0.04, 0.025, 0.02])),
        white_mm=noise * math.sqrt(1.0 - slow**2),
        slow_mm=noise * slow,
        slow_s=rng.uniform(0.2, 2.0),
        dropped=rng.uniform(0.005, 0.04) if drops else 0.0,
        burst_s=rng.uniform(0.1, 0.5),
        hidden=rng.uniform(0.002, 0.02) if rng.random() < 0.5 else 0.0,
    )
    vacuum = -1e3 * round(rng.uniform(0.1, 0.25) * high / 1e3) if rng.random() < 0.3 else 0.0
    return Robot(plant, cameras, vacuum, 1e3 * length, 1e3 * radius)
