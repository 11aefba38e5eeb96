"""One robot for each seed: size, material, chambers, regulators and cameras, drawn at random.

Soft pneumatic arms of silicone between 60 and 150 mm, two to four chambers, three to six key
planes. Nothing is drawn to resemble a known arm; ranges are those of the literature of soft
continuum arms where a line states none other (Rus & Tolley 2015; Polygerinos et al. 2017).
"""

import math
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from surgisoft.rig.elastica.gas import AMBIENT_PA, Gas
from surgisoft.rig.elastica.plant import Plant
from surgisoft.rig.elastica.rod import Body, largest_step, straight_body
from surgisoft.rig.elastica.wall import Wall, stiffest
from surgisoft.rig.motion_capture import CameraDesign, build_cameras

STANDARD_GRAVITY = 9.80665
"""[m/s^2] (CGPM 1901)."""
PERIODS_S = (0.05, 0.08, 0.1)
"""Times between samples that a robot's cameras may have [s]: 20, 12.5 and 10 Hz."""


class Outline(NamedTuple):
    """What is drawn of a robot first; everything else follows from it or is drawn after it."""

    length: float
    """Length at rest [m]."""
    radius: float
    """Outer radius [m]."""
    density: float
    """Density of the silicone with its chambers [kg/m^3]."""
    modulus: float
    """Young's modulus [Pa]."""
    chambers: int
    """Number m of chambers."""
    planes: int
    """Number n of key planes."""


def _outline(rng: np.random.Generator) -> Outline:
    """The outline of the robot whose draws begin."""
    length = rng.uniform(0.06, 0.15)
    radius = length / rng.uniform(7.0, 10.5)
    density = rng.uniform(850.0, 1150.0)  # silicone with empty chambers, up to filled silicone
    modulus = math.exp(rng.uniform(math.log(6e4), math.log(1.4e5)))
    # Weight over bending stiffness: beyond about 8 an upright column buckles (Greenhill 1881).
    slack = 4.0 * density * STANDARD_GRAVITY * length**3 / radius**2
    modulus = max(modulus, slack / 3.5)
    chambers = int(rng.choice([2, 3, 3, 3, 4]))
    return Outline(length, radius, density, modulus, chambers, int(rng.integers(3, 7)))


def robot_size(seed: int) -> tuple[int, int]:
    """Numbers of chambers and key planes of the robot of a seed, which is not made."""
    outline = _outline(_draws(seed))
    return outline.chambers, outline.planes


def _draws(seed: int) -> np.random.Generator:
    return np.random.default_rng([seed, 0xE1A])


def make_robot(
    seed: int, elements: int, gravity: np.ndarray | None, noise: float
) -> tuple[Plant, Body]:
    """The robot of a seed on its rig.

    elements: of the rod; gravity: (3,) unit vector of weight, arm base frame (None: drawn,
    hanging); noise: factor on the cameras' noise.
    """
    rng = _draws(seed)
    length, radius, density, modulus, m, planes = _outline(rng)
    body = straight_body(elements, length, radius, density, modulus)
    uneven = np.exp(_smooth(rng, elements, 0.04))
    body.shear_matrix[:] *= uneven
    body.bend_matrix[:] *= 0.5 * (uneven[1:] + uneven[:-1])
    body.mass[-1] += rng.uniform(0.0, 0.08) * body.mass.sum()  # cap and markers
    nodes = np.round(np.linspace(0, elements, planes)).astype(np.int64)

    around = 2 * np.pi * (np.arange(m) / m) + rng.uniform(0, 2 * np.pi)
    angles = around + np.radians(rng.normal(0.0, 2.0, m))
    offset = rng.uniform(0.48, 0.62) * radius * (1 + rng.normal(0.0, 0.03, m))
    areas = np.pi * (rng.uniform(0.24, 0.32) * radius) ** 2 * (1 + rng.normal(0.0, 0.04, m))
    bend = body.bend_matrix[0, 0].copy()
    curvature = math.radians(rng.uniform(40.0, 75.0)) / length
    high = curvature * bend.mean() / (areas.mean() * offset.mean())
    high = 1e3 * round(min(max(high, 2e4), 9e4) / 1e3)
    curvature = high * areas.mean() * offset.mean() / bend.mean()
    volumes = areas * length

    fluid = rng.uniform(0.05, 0.25)
    wall = Wall(
        friction=rng.uniform(0.0, 0.012) * np.array([0.4, 0.6]),
        slip=np.array([0.05, 0.2]) * rng.uniform(0.7, 1.4),
        viscous=np.array([0.3, rng.uniform(0.001, 0.006), fluid]),
        creep=0.0,
        softening=0.0,
        locking=rng.uniform(0.0, 0.06),
    )
    period = float(rng.choice(PERIODS_S))
    supply = AMBIENT_PA + 2.0 * high + 5e4
    gas = Gas(
        supply=supply,
        vacuum=AMBIENT_PA - 6e4,
        # Full supply would fill an empty chamber within 0.1 to 0.25 s.
        valve=float(volumes.mean() * high / supply / rng.uniform(0.1, 0.25)) * 1.6,
        band=0.1 * high,
        tube=volumes.mean() * rng.uniform(0.4, 0.8, m),
        line=volumes.mean() / rng.uniform(0.15, 0.4) * np.ones(m),
        leak=np.zeros(m),
        opens=0.4 * high,
        bulge=rng.uniform(0.0, 0.3) / high,
    )
    tilt = np.radians(rng.normal(0.0, 0.6, 2))
    base = _turned(np.array([tilt[0], tilt[1], 0.0]))
    swing = 3.516 * math.sqrt(bend.mean() / (density * np.pi * radius**2)) / length**2
    damping = 2.0 * swing * rng.uniform(0.35, 0.9)
    down = _hanging(rng) if gravity is None else np.asarray(gravity, np.float64)
    body.director[:] = base[:, :, None]
    body.position[:] = base[2][:, None] * np.linspace(0.0, length, elements + 1)
    cameras = build_cameras(
        CameraDesign(rate_Hz=1.0 / period), 2e3 * radius, m, planes, 1e-3 * high, noise, seed
    )
    step = largest_step(body, max(stiffest(wall), 1.2))
    plant = Plant(
        step=period / math.ceil(period / step),
        keep=1.0,
        gravity=STANDARD_GRAVITY * down,
        wall=wall,
        bend=bend,
        twist_stiffness=body.bend_matrix[2, 2].copy(),
        axial=body.shear_matrix[2, 2].copy(),
        bow=rng.normal(0.0, 0.03, 2)[:, None] * curvature * np.ones(elements - 1),
        curvature=curvature,
        radius=radius,
        gas=gas,
        high=high,
        areas=areas,
        levers=(offset * np.stack([np.cos(angles), np.sin(angles)])).T.copy(),
        taper=rng.normal(0.0, 0.05, m),
        growth=rng.uniform(-0.05, 0.15),
        volumes=volumes,
        unfold=np.zeros(m),
        stolen=np.zeros((m, m)),
        fibre=0.0,
        plane=np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]),
        plane_stiffness=0.0,
        base=base,
        drift=np.zeros(3),
        knock=np.zeros(4),
        breath=np.zeros(5),
        bracket=np.zeros(2),
        tear=np.zeros(3),
        slip=np.zeros(3),
        warmth=0.0,
        misalignment=np.zeros(6),
        nodes=nodes,
        cameras=cameras,
    )
    return damped(plant, damping), body


def damped(plant: Plant, damping: float) -> Plant:
    """The plant with PyElastica's linear damper of a rate [1/s]."""
    return plant._replace(keep=math.exp(-damping * plant.step))


def vacuum_limit(seed: int, high: float) -> float:
    """Lowest pressure [Pa gauge] that the robot's regulators accept: some have a vacuum line."""
    rng = np.random.default_rng([seed, 0x7AC])
    return -1e3 * round(rng.uniform(0.1, 0.25) * high / 1e3) if rng.random() < 0.35 else 0.0


def _smooth(rng: np.random.Generator, count: int, size: float) -> np.ndarray:
    """(count,) smooth random numbers of standard deviation `size` along the arm."""
    u = (np.arange(count) + 0.5) / count
    waves = np.array([1.0, 2.0, 3.0])[:, None]
    phases = rng.uniform(0, 2 * np.pi, (3, 1))
    sizes = rng.normal(0.0, size, (3, 1)) / waves
    return (sizes * np.cos(np.pi * waves * u + phases)).sum(axis=0)


def _hanging(rng: np.random.Generator) -> np.ndarray:
    """(3,) direction of weight of an arm that hangs tilted by up to 70 degrees."""
    tilt, around = np.radians(rng.uniform(0.0, 70.0)), rng.uniform(0, 2 * np.pi)
    return np.array([np.sin(tilt) * np.cos(around), np.sin(tilt) * np.sin(around), np.cos(tilt)])


def _turned(turn: np.ndarray) -> np.ndarray:
    """(3, 3) base axes as rows, rotated by a small rotation vector (3,) [rad]."""
    return np.ascontiguousarray(Rotation.from_rotvec(turn).as_matrix().T)
