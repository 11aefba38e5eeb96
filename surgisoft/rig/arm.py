"""The arm of the virtual rig: its design, and one fabricated robot for each seed.

The design follows Chen et al. (2025, sec. II): 70 mm x 15 mm, a 3 mm channel, three chambers at 120
degrees, fibres wound at 7 degrees from the circumference, magnet caps at both ends. What the paper
does not state (wall thickness, silicone, masses) is chosen so that an arm of that size bends by
60 to 90 degrees with one chamber at 54 kPa. No two robots are equal: areas, offsets, angles,
stiffness, rest shape and friction spread as in casting by hand.
"""

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from surgisoft.compiled import compiled
from surgisoft.errors import InputError
from surgisoft.rig.friction import lag, move, rested
from surgisoft.rig.rod import Loads, Rod, Shape, balance, new_shape
from surgisoft.rig.wall import Wall, line_strain, strain_under

STANDARD_GRAVITY = 9.80665
"""[m/s^2] (CGPM 1901), also N/kg."""


@dataclass(frozen=True)
class ArmDesign:
    """Design of an arm, which its mould and its material fix."""

    length_mm: float = 70.0
    """Length with both caps [mm] (Chen et al. 2025, sec. II)."""
    diameter_mm: float = 15.0
    """Outer diameter [mm] (same)."""
    channel_mm: float = 3.0
    """Diameter of the central channel [mm] (same)."""
    chambers: int = 3
    """Number of chambers, equally spaced (same)."""
    fibre_deg: float = 83.0
    """Fibre angle from the arm's axis [deg]: 7 degrees from the circumference (same)."""
    key_planes: int = 5
    """Key feature planes, equally spaced from the bracket to the tip plane."""
    chamber_mm: float = 5.8
    """Diameter of a round chamber of the same area [mm]; the chamber itself is a ring sector."""
    offset_mm: float = 4.6
    """Distance of a chamber's centroid from the arm's axis [mm]."""
    cap_mm: float = 5.0
    """Length of each magnet cap [mm]."""
    cap_mass_g: float = 2.5
    """Mass of a magnet cap [g]: a ring magnet 12 x 5 x 2.5 mm of 7.5 g/cm^3 in silicone."""
    density_g_mm3: float = 1.07e-3
    """Density of platinum-cure silicone [g/mm^3] (Smooth-On, Dragon Skin 10 data sheet)."""
    modulus_MPa: float = 0.15
    """Young's modulus of the silicone at rest [MPa = N/mm^2] (same sheet: 22 psi at 100 %)."""
    even: float = 0.8
    """Second-order stiffening of the wall in extension [-]."""
    odd: float = 4.0
    """Third-order stiffening of the wall [-]."""
    friction_lines: int = 6
    """Fibres of the wall that carry fibre friction."""
    slip_strain: float = 0.012
    """Strain over which fibres detach after a reversal [-]."""
    largest_gap: float = 0.034
    """Largest up/down gap of the tip over the length [-] (Chen et al. 2025, sec. III)."""
    low_kPa: float = -15.0
    """Lowest pressure [kPa gauge]."""
    high_kPa: float = 54.0
    """Highest pressure [kPa gauge]; 24 levels of 3 kPa from the lowest."""

    @property
    def soft_mm(self) -> float:
        """Length between the caps [mm]."""
        return self.length_mm - 2 * self.cap_mm


class Friction(NamedTuple):
    """Friction of the wall's fibres; see friction.py for the density."""

    at: np.ndarray
    """(J, 2) x, y of each line, body frame [mm]."""
    force: np.ndarray
    """(J,) force of a line per unit of lag [N]."""
    profile: np.ndarray
    """(K, J) factor along the arm [-]."""
    slip: np.ndarray
    """(J,) s [-]."""
    slope: np.ndarray
    """(J,) r1 [-]."""
    bow: np.ndarray
    """(J,) r2 [-]."""


class Robot(NamedTuple):
    """One fabricated arm."""

    rod: Rod
    """Statics of the arm as a rod."""
    friction: Friction
    """Memory of the wall."""


class Memory(NamedTuple):
    """History of the wall's fibres."""

    free: np.ndarray
    """(3,) strains eps, u_x, u_y of a free section under the present pressures."""
    last: np.ndarray
    """(J,) strain of each line."""
    depth: np.ndarray
    """(J,) int64, turning points remembered."""
    stack: np.ndarray
    """(J, DEPTH) turning points."""


def new_memory(lines: int) -> Memory:
    """Memory of a wall without history."""
    return Memory(np.zeros(3), *rested(lines))


@compiled
def remember(robot: Robot, pressures: np.ndarray, thrusts: np.ndarray, memory: Memory) -> bool:
    """Move the strains of the wall's fibres to those of a free section under chamber pressures.

    pressures: (m,) [kPa]; thrusts: (m,) scratch. The free section (no weight) mixes the chambers
    in every line; between two calls the strains must have moved monotonically. Returns False where
    the section has no equilibrium.
    """
    wall = robot.rod.wall
    for i in range(pressures.shape[0]):
        thrusts[i] = pressures[i] * 1e-3 * wall.areas[i]
    taken = strain_under(wall, 1.0, thrusts, 0.0, 0.0, 0.0, memory.free)
    at = robot.friction.at
    for j in range(at.shape[0]):
        strain = line_strain(memory.free, at[j, 0], at[j, 1])
        move(j, strain, memory.last, memory.depth, memory.stack)
    return taken < 50


@compiled(inner=True)
def friction_forces(friction: Friction, memory: Memory, forces: np.ndarray) -> None:
    """(J,) friction force of each line [N], into `forces`; positive while its strain rises."""
    for j in range(forces.shape[0]):
        forces[j] = friction.force[j] * lag(
            j, memory.last, memory.depth, memory.stack,
            friction.slip[j], friction.slope[j], friction.bow[j],
        )  # fmt: skip


@compiled(inner=True)
def add_line_forces(friction: Friction, forces: np.ndarray, active: np.ndarray) -> None:
    """Add the lines' tension (J,) [N] to the internal loads (K, 4) [N, N mm] of the wall.

    A line under tension pulls the section together: it counts against the thrust.
    """
    for k in range(active.shape[0]):
        for j in range(forces.shape[0]):
            pull = forces[j] * friction.profile[k, j]
            active[k, 0] -= pull
            active[k, 1] -= pull * friction.at[j, 1]
            active[k, 2] += pull * friction.at[j, 0]


@compiled
def chamber_thrusts(rod: Rod, pressures: np.ndarray, thrusts: np.ndarray) -> None:
    """(K, m) thrust p_i A_i [N] of each chamber at each station, from (m,) pressures [kPa]."""
    for k in range(thrusts.shape[0]):
        for i in range(pressures.shape[0]):
            thrusts[k, i] = pressures[i] * 1e-3 * rod.wall.areas[i] * rod.taper[k, i]


@compiled
def settle_path(
    robot: Robot, loads: Loads, path: np.ndarray, memory: Memory, shape: Shape, tips: np.ndarray
) -> bool:
    """Quasi-static tips (T, 3) [mm] along chamber pressures (T, m) [kPa]; False: failed."""
    forces = np.empty(robot.friction.force.shape[0])
    scratch = np.empty(path.shape[1])
    thrusts = np.empty((robot.rod.stiffness.shape[0], path.shape[1]))
    for t in range(path.shape[0]):
        if not remember(robot, path[t], scratch, memory):
            return False
        friction_forces(robot.friction, memory, forces)
        shape.active[:] = 0.0
        add_line_forces(robot.friction, forces, shape.active)
        chamber_thrusts(robot.rod, path[t], thrusts)
        if not balance(robot.rod, loads, 1.0, thrusts, robot.rod.base, shape):
            return False
        for d in range(3):
            tips[t, d] = shape.centres[-1, d]
    return True


def plain_loads(gravity: np.ndarray) -> Loads:
    """Weight along `gravity` (3,) (unit vector, base frame) and nothing else."""
    return Loads(
        gravity=np.asarray(gravity, np.float64),
        payload=0.0,
        payload_at=np.zeros(3),
        support=0,
        support_normal=np.array([1.0, 0.0, 0.0]),
        support_gap=0.0,
        support_stiffness=0.0,
    )


def single_chamber_gap(robot: Robot, design: ArmDesign, gravity: np.ndarray) -> float:
    """Largest distance [mm] of the tip between loading and unloading at the same pressure.

    Each chamber alone goes through the whole pressure range twice, in 3 kPa steps; the second
    round counts.
    """
    steps = round((design.high_kPa - design.low_kPa) / 3.0)
    up = np.linspace(design.low_kPa, design.high_kPa, steps + 1)
    largest = 0.0
    for chamber in range(design.chambers):
        path = np.zeros((4 * len(up), design.chambers))
        path[:, chamber] = np.concatenate([up, up[::-1], up, up[::-1]])
        tips = tips_along(robot, plain_loads(gravity), path)
        rising, falling = tips[2 * len(up) : 3 * len(up)], tips[3 * len(up) :][::-1]
        largest = max(largest, float(np.linalg.norm(rising - falling, axis=1).max()))
    return largest


def tips_along(robot: Robot, loads: Loads, path: np.ndarray) -> np.ndarray:
    """Tip centres (T, 3) [mm] of the rested arm along quasi-static pressures (T, m) [kPa]."""
    memory = new_memory(len(robot.friction.force))
    tips = np.empty((len(path), 3))
    shape: Shape = new_shape(robot.rod)
    if not settle_path(robot, loads, np.asarray(path, np.float64), memory, shape, tips):
        raise no_equilibrium()
    return tips


def no_equilibrium() -> InputError:
    """The error for loads that the rod cannot balance."""
    return InputError(
        "the virtual arm found no equilibrium: its loads are beyond what it can carry; "
        "use a lighter payload or a weaker effect"
    )


def calibrated(robot: Robot, design: ArmDesign, gravity: np.ndarray) -> Robot:
    """The robot with its friction scaled so that the largest gap is the design's."""
    target = design.largest_gap * design.length_mm

    def scaled(factor: float) -> Robot:
        friction = robot.friction._replace(force=factor * robot.friction.force)
        return robot._replace(friction=friction)

    def excess(factor: float) -> float:
        return single_chamber_gap(scaled(factor), design, gravity) - target

    upper = 1.0
    while excess(upper) < 0:
        upper *= 2.0
    return scaled(brentq(excess, 0.0, upper, xtol=1e-9, rtol=1e-9))


def fabricate(design: ArmDesign, seed: int, gravity: np.ndarray) -> Robot:
    """Fabricate one robot; its seed draws the tolerances in which cast arms differ.

    gravity: (3,) unit vector of weight in the base frame, under which the friction is calibrated.
    """
    rng = np.random.default_rng([seed, 0xA43])
    steps, planes = _steps(design, rng)
    rod = _rod(design, steps, planes, rng)
    friction = _friction(design, rod, rng)
    return calibrated(Robot(rod, friction), design, gravity)


def _steps(design: ArmDesign, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Step lengths (N,) [mm] of at most 4.5 mm that end on every key plane; the planes' steps."""
    glued = np.linspace(0.0, design.length_mm, design.key_planes)
    glued[1:-1] += rng.normal(0.0, 0.4, design.key_planes - 2)
    start, end = design.cap_mm, design.length_mm - design.cap_mm
    inner = [s for s in glued[1:-1] if start < s < end]
    edges = [start, *inner, end]
    steps, counts = [], []
    for low, high in itertools.pairwise(edges):
        number = math.ceil((high - low) / 4.5)
        steps += [(high - low) / number] * number
        counts.append(number)
    ends = np.cumsum(counts)[: len(inner)]
    return np.array(steps), np.array([-1, *ends, len(steps) + 1], np.int64)


def _stations(steps: np.ndarray) -> np.ndarray:
    """Position along the soft part (K,) from 0 to 1 of every station."""
    edges = np.concatenate([[0.0], np.cumsum(steps)])
    stations = np.empty(2 * len(steps) + 1)
    stations[0::2] = edges
    stations[1::2] = 0.5 * (edges[1:] + edges[:-1])
    return stations / edges[-1]


def _rod(design: ArmDesign, steps, planes, rng: np.random.Generator) -> Rod:
    u = _stations(steps)
    wall = _wall(design, rng)
    near_caps = np.exp(-u * design.soft_mm / 3.0) + np.exp(-(1 - u) * design.soft_mm / 3.0)
    waves = rng.normal(0.0, [[0.05], [0.03], [0.02]])
    phases = rng.uniform(0, 2 * np.pi, (3, 1))
    uneven = (waves * np.cos(np.pi * np.array([[1], [2], [3]]) * u + phases)).sum(axis=0)
    stiffness = (1.0 + 1.5 * near_caps) * np.exp(uneven)
    taper = 1.0 + np.outer(u - 0.5, rng.normal(0.0, 0.03, design.chambers))
    bow, turn = rng.normal(0.0, 6e-4, 2), rng.normal(0.0, 4e-4, 2)
    rest = bow + np.outer(u - 0.5, turn)
    silicone = design.density_g_mm3 * 1e-3 * STANDARD_GRAVITY * wall.area * design.soft_mm
    tip_weight = design.cap_mass_g * 1e-3 * STANDARD_GRAVITY * (1 + rng.normal(0.0, 0.03))
    tilt, azimuth = np.radians(rng.normal(0.0, 0.6)), rng.uniform(0, 2 * np.pi)
    base = [np.cos(tilt / 2), *(np.sin(tilt / 2) * np.array([np.cos(azimuth), np.sin(azimuth), 0]))]
    return Rod(
        wall=wall,
        steps=steps,
        stiffness=stiffness,
        taper=np.ascontiguousarray(taper),
        rest=np.ascontiguousarray(rest),
        beyond=tip_weight + silicone * (1.0 - u),
        planes=planes,
        base_cap=float(design.cap_mm),
        tip_cap=float(design.cap_mm),
        tip_weight=tip_weight,
        base=np.array(base),
    )


def _wall(design: ArmDesign, rng: np.random.Generator) -> Wall:
    m = design.chambers
    outer, inner = design.diameter_mm / 2, design.channel_mm / 2
    radius = design.chamber_mm / 2
    areas = np.pi * radius**2 * (1 + rng.normal(0.0, 0.03, m))
    offsets = design.offset_mm + rng.normal(0.0, 0.12, m)
    angles = np.pi / 2 + 2 * np.pi * np.arange(m) / m + np.radians(rng.normal(0.0, 1.5, m))
    chambers = offsets[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    # Ring less m round holes: A, and by Steiner's theorem int y^2 dA; int y^4 dA of a ring is
    # pi (R^6 - r^6) / 8, of a small hole at offset d averaged over its angle 3/8 A d^4.
    area = np.pi * (outer**2 - inner**2) - areas.sum()
    second = np.pi / 4 * (outer**4 - inner**4)
    second -= float((areas * (offsets**2 / 2 + radius**2 / 4)).sum())
    fourth = np.pi / 8 * (outer**6 - inner**6) - float((areas * 3 / 8 * offsets**4).sum())
    oval, axis = rng.normal(0.0, 0.02), rng.uniform(0, np.pi)
    modulus = design.modulus_MPa * (1 + rng.normal(0.0, 0.04))
    shear_modulus = modulus / 3.0  # silicone keeps its volume: G = E / 3
    fibres = np.radians(design.fibre_deg + rng.normal(0.0, 1.0, m))
    return Wall(
        modulus=modulus,
        even=float(design.even),
        odd=float(design.odd),
        area=area,
        second=second
        * np.array(
            [1 + oval * np.cos(2 * axis), 1 - oval * np.cos(2 * axis), oval * np.sin(2 * axis)]
        ),
        mean_second=second,
        fourth=fourth,
        torsion=shear_modulus * 2.0 * second,
        shear=shear_modulus * 0.85 * area,
        chambers=chambers,
        areas=areas,
        fibre=np.cos(fibres) ** 2,
    )


def _friction(design: ArmDesign, rod: Rod, rng: np.random.Generator) -> Friction:
    lines = design.friction_lines
    u = _stations(rod.steps)
    angles = np.pi / 2 + 2 * np.pi * (np.arange(lines) + 0.25) / lines
    at = 0.42 * design.diameter_mm * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    even = rod.wall.modulus * rod.wall.area / lines
    return Friction(
        at=at,
        force=0.1 * even * np.exp(rng.normal(0.0, 0.15, lines)),
        profile=1.0 + np.outer(u - 0.5, rng.normal(0.0, 0.3, lines)),
        slip=design.slip_strain * np.exp(rng.normal(0.0, 0.15, lines)),
        slope=2.5 * np.exp(rng.normal(0.0, 0.1, lines)),
        bow=np.full(lines, 4.0),
    )
