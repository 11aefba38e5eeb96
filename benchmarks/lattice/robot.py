"""One robot for each seed: build, size, material, cameras, and how well it is fitted.

Robots have three or four chambers or two segments of three, 120 to 300 mm, four to nine key
points, 20 to 50 Hz and noise of 0.1 to 0.35 mm; recordings for the fit are long or short.
"""

import functools
import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from benchmarks.generators import STANDARD_GRAVITY, Cameras, hanging
from benchmarks.lattice.body import ALONG, RIGIDITY, make_body
from benchmarks.lattice.gas import VOLUMES, Gas
from benchmarks.lattice.motion import new_state, settle
from benchmarks.lattice.plant import Plant
from benchmarks.lattice.wall import Wall

STREAM = 0x1A77
"""Number that tells this generator's draws from those of other rigs with the same seed."""
SLABS = 12
"""Slabs of a lattice; divisible by two segments."""


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
    drops: bool
    """Whether its cameras drop frames."""
    before_s: tuple[float, float]
    """Durations of the two recordings before a change [s]."""
    epochs: int
    """Most epochs of the fit to them: 200 is what `fit` takes by itself."""


BUILDS = (
    Build(3, (120.0, 170.0), 4, 50.0, False, (180.0, 150.0), 200),
    Build(4, (160.0, 220.0), 6, 25.0, True, (180.0, 150.0), 200),
    Build(6, (240.0, 300.0), 9, 20.0, False, (180.0, 150.0), 200),
    Build(3, (200.0, 260.0), 5, 40.0, True, (150.0, 75.0), 60),
    Build(4, (120.0, 180.0), 4, 20.0, False, (150.0, 75.0), 100),
)
"""Builds by seed modulo their number."""


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
    """Radius of the outer wall [mm]."""


def build_of(seed: int) -> Build:
    """The build of a robot's seed."""
    return BUILDS[seed % len(BUILDS)]


def tip_turn(plant: Plant, chamber: int, pressure: float) -> float:
    """Angle [rad] by which the last cross-section tilts under a pressure [Pa] in one chamber."""
    state = new_state(plant)
    state.air[VOLUMES, chamber] = pressure
    before = _normal(state.nodes, plant)
    settle(plant, state)
    return math.acos(min(float(before @ _normal(state.nodes, plant)), 1.0))


def _normal(nodes: np.ndarray, plant: Plant) -> np.ndarray:
    """(3,) unit normal of the last cross-section, fitted to the nodes of its wall."""
    ring = len(plant.body.faces)
    wall = nodes[-2 * ring :]
    normal = np.linalg.svd(wall - wall.mean(axis=0))[2][-1]
    return normal * np.sign(normal[2])


@functools.cache
def make_robot(seed: int) -> Robot:
    """The robot of a seed without hidden effects; nobody may change its arrays."""
    rng = np.random.default_rng([seed, STREAM])
    build = build_of(seed)
    m, segments = build.chambers, 2 if build.chambers == 6 else 1
    ring = m // segments
    length = 1e-3 * rng.uniform(*build.length_mm)
    radius = length / segments / rng.uniform(9.0, 12.0)
    body = make_body(length, radius, ring, SLABS, rng.uniform(0.0, 2.0 * np.pi))
    count = len(body.kinds)
    # No casting is even: the wall varies around the arm and from spring to spring.
    side = rng.uniform(0.0, 2.0 * np.pi)
    middle = 0.5 * (body.nodes[body.ends[:, 0]] + body.nodes[body.ends[:, 1]])
    towards = middle[:, :2] @ np.array([math.cos(side), math.sin(side)]) / radius
    uneven = 1.0 + rng.uniform(0.0, 0.08) * towards
    uneven *= np.exp(rng.normal(0.0, 0.04, count))
    reach = math.radians(rng.uniform(35.0, 55.0))  # of a segment under one chamber
    high = 1e3 * round(rng.uniform(12.0, 30.0)) * 5.0
    down = hanging(rng)
    chambers = [
        (i % ring, i // ring * SLABS // segments, (i // ring + 1) * SLABS // segments)
        for i in range(m)
    ]
    nodes = len(body.nodes)
    share = np.ones(nodes)
    share[-(1 + 3 * ring) :] = 0.5  # of a slab's mass
    wall = Wall(
        friction=np.array([rng.uniform(0.005, 0.03), rng.uniform(0.05, 0.15)]),
        creep=0.0,
        damage=0.0,
        threads=rng.uniform(0.0, 0.1),
        fluid=np.array([rng.uniform(0.02, 0.06), rng.uniform(0.1, 0.3), 0.3]),
    )
    gas = Gas(rng.uniform(40.0, 80.0, m), rng.uniform(2.0, 6.0) * high, np.zeros(2))
    plant = Plant(
        body=body,
        rigidity=RIGIDITY[body.kinds] * uneven,
        unit=radius * reach * segments / length,
        mass=np.zeros(nodes),
        gravity=STANDARD_GRAVITY * down,
        wall=wall,
        gas=gas,
        high=high,
        chambers=np.array(chambers),
        gains=np.ones(m),
        loose=0.0,
        warmth=np.zeros(2),
        heat=np.zeros(2),
        patch=np.zeros(count),
        buckling=np.zeros(3),
        ball=np.zeros(5),
        cable=np.zeros(6),
        guide=np.zeros(7),
        drift=np.zeros(3),
        slip=np.zeros(3),
        breath=np.zeros(5),
        misalignment=np.zeros(6),
        lens=np.zeros(7),
        keys=np.round(np.linspace(SLABS / build.key_points, SLABS, build.key_points)).astype(
            np.int64
        ),
    )
    # Without weight the shape depends on pressure over modulus alone. From stiff to soft: an arm
    # that is far too soft has no state of rest.
    firm = 6.0 * high * radius**2
    while tip_turn(_scaled(plant, 0.9 * firm), 0, high) < reach:
        firm *= 0.9
    factor = brentq(
        lambda factor: tip_turn(_scaled(plant, factor * firm), 0, high) - reach, 0.9, 1.0, xtol=1e-2
    )
    plant = _scaled(plant, factor * firm)
    # Weight over bending stiffness of the whole arm.
    along = plant.rigidity[body.kinds == ALONG][: 3 * ring]
    bend = float(along @ (body.nodes[1 : 1 + 3 * ring, :2] ** 2).sum(axis=1)) / 2.0
    weight = rng.uniform(0.4, 1.4) * bend / length**3 * length
    mass = weight / STANDARD_GRAVITY / share.sum() * share
    plant = plant._replace(mass=mass)
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


def _scaled(plant: Plant, rigidity: float) -> Plant:
    """The plant with springs of another rigidity along the arm [N]."""
    return plant._replace(rigidity=plant.rigidity * rigidity)
