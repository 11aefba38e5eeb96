"""Material of the lattice's springs: what a spring carries beyond linear elasticity, with memory.

Strains x are counted in units of the robot's reference (bending of a segment by one chamber at its
limit, times the radius); stresses are in units of the stress of x = 1 in a linear spring. Memory
counts from the strain at rest x_0. Each spring along the arm and each diagonal carries

- friction of Dahl (1976) with the exponent 3/2: df/dx = (f_c / x_h) |1 - f / f_c|^(3/2) for rising
  x, mirrored for falling x. With u = 1 - f / f_c a way dx takes u^(-1/2) to its sum with
  dx / (2 x_h), which is exact;
- creep: two retarded elements in series with the spring, dz/dt = (g s / 2 - z) exp(|s| / s_0) / tau
  with s = x - x_0 - z_1 - z_2 its elastic strain: time runs faster under stress (Schapery 1969);
- damage: a bundle of filaments with Weibull's (1939) distribution of strengths (Daniels 1945). The
  share 1 - exp(-(x_max / x_d)^2) of those that can break is broken, x_max being the largest
  extension so far. Compression breaks none, and the first loading is softer, too. A rest heals;
- stiffening: crimped threads that become taut one after the other between the extensions x_t and
  x_t + x_w and are linear beyond (Lanir 1979); they carry no compression;
- viscosity: a spring g_v in series with a fluid of Cross (1965), whose relaxation time
  t_c / (1 + (t_x |v'|)^0.8) falls with the rate v' of its flow.

None of these is the law of an effect in the arm models, which have play operators, retarded loads
with a log-normal spectrum, Ogden & Roxburgh's energy, Fung's exponential and Ellis' fluid, all on
the chambers' loads; slow flow and small stress make any of them linear. Other generators have
Preisach, Bouc & Wen and Berg; relaxation by a power or the logarithm of time, Bergstrom & Boyce;
Miehe and Simo; Gent and Yeoh; Eyring and Ostwald.
"""

import math
from typing import NamedTuple

import numpy as np

from surgisoft.compiled import compiled

RETARDATION_S = np.array([3.0, 30.0])
"""Retardation times of creep without stress, tau [s]."""
HURRYING_STRESS = 0.8
"""Stress that makes creep e times as fast, s_0 [-]."""
BREAKING = 0.7
"""Extension at which 63 % of the filaments that can break are broken, x_d [-]."""
CRIMP = np.array([0.15, 0.9])
"""Extension x_t at which the first threads are taut, and range x_w of the others [-]."""
CROSS_POWER = 0.8
"""Power of the rate in the law of Cross [-]."""


class Wall(NamedTuple):
    """Parameters of the material; zero switches a term off."""

    friction: np.ndarray
    """(2,) limit f_c [-] and way x_h [-] of the friction."""
    creep: float
    """Compliance g of both retarded elements over that of the spring [-]."""
    damage: float
    """Share of the filaments that can break [-]."""
    threads: float
    """Stiffness of all taut threads over that of the spring [-]."""
    fluid: np.ndarray
    """(3,) g_v [-], t_c [s] and t_x [s] of the viscosity."""


class Memory(NamedTuple):
    """What K springs remember; changed in place."""

    rest: np.ndarray
    """(K,) strain at rest x_0 [-]."""
    last: np.ndarray
    """(K,) strain after the last step [-]."""
    flow: np.ndarray
    """(K,) strain v of the fluid [-]."""
    rate: np.ndarray
    """(K,) its rate in the last step [1/s]."""
    friction: np.ndarray
    """(K,) stress of the friction [-]."""
    creep: np.ndarray
    """(K, 2) strain z of the retarded elements [-]."""
    longest: np.ndarray
    """(K,) largest extension since the rest [-]."""


def new_memory(springs: int) -> Memory:
    """Memory of springs that were never strained."""
    return Memory(*np.zeros((5, springs)), np.zeros((springs, 2)), np.zeros(springs))


def forget(memory: Memory) -> None:
    """Take the last strain as the strain at rest, and remember nothing else."""
    memory.rest[:] = memory.last
    for state in (memory.flow, memory.rate, memory.friction, memory.creep, memory.longest):
        state[:] = 0.0


@compiled
def slid(limit: float, half: float, held: float, way: float) -> float:
    """Stress of the friction after a way [-] from the stress held; exact."""
    side = 1.0 if way > 0.0 else -1.0
    left = max(1.0 - side * held / limit, 1e-12)
    root = 1.0 / math.sqrt(left) + 0.5 * side * way / half
    return side * limit * (1.0 - 1.0 / (root * root))


@compiled
def taut(extension: float) -> float:
    """Stress of the crimped threads over their stiffness at an extension from rest [-]."""
    over = extension - CRIMP[0]
    if over <= 0.0:
        return 0.0
    if over < CRIMP[1]:
        return 0.5 * over * over / CRIMP[1]
    return over - 0.5 * CRIMP[1]


@compiled
def broken(longest: float) -> float:
    """Share of the filaments that can break which are broken after an extension [-]."""
    return -math.expm1(-((longest / BREAKING) ** 2))


@compiled
def stress(wall: Wall, memory: Memory, spring: int, strain: float, modulus: float) -> float:
    """Stress that a spring carries at the strain that it remembers [-].

    strain: that strain; modulus: of the linear spring, over the nominal one [-].
    """
    moved = strain - memory.rest[spring]
    slipped = memory.creep[spring, 0] + memory.creep[spring, 1]
    lost = wall.damage * broken(memory.longest[spring]) if wall.damage > 0.0 else 0.0
    carried = modulus * (strain - slipped - lost * (moved - slipped))
    if wall.threads > 0.0:
        carried += wall.threads * taut(moved)
    carried += wall.fluid[0] * (moved - memory.flow[spring])
    return carried + memory.friction[spring]


@compiled
def slope(wall: Wall, memory: Memory, spring: int, modulus: float) -> float:
    """Stress per strain of a spring that is stretched at once; friction as at a turn [-]."""
    over = memory.last[spring] - memory.rest[spring] - CRIMP[0]
    steep = modulus + wall.fluid[0] + wall.threads * min(max(over / CRIMP[1], 0.0), 1.0)
    if wall.damage > 0.0:
        steep -= modulus * wall.damage * broken(memory.longest[spring])
    if wall.friction[0] > 0.0:
        steep += wall.friction[0] / wall.friction[1]
    return steep


@compiled
def remember(wall: Wall, memory: Memory, spring: int, strain: float, step: float) -> None:
    """Move the memory of a spring to its strain [-] after a step [s]; 0: the strain alone."""
    way = strain - memory.last[spring]
    if wall.friction[0] > 0.0 and way != 0.0:
        memory.friction[spring] = slid(
            wall.friction[0], wall.friction[1], memory.friction[spring], way
        )
    moved = strain - memory.rest[spring]
    memory.longest[spring] = max(memory.longest[spring], moved)
    if wall.creep > 0.0:
        carried = moved - memory.creep[spring, 0] - memory.creep[spring, 1]
        hurry = math.exp(min(abs(carried) / HURRYING_STRESS, 5.0))
        for k in range(2):
            share = -math.expm1(-step * hurry / RETARDATION_S[k])
            left = 0.5 * wall.creep * carried - memory.creep[spring, k]
            memory.creep[spring, k] += share * left
    if wall.fluid[0] > 0.0:
        thin = 1.0 + (wall.fluid[2] * abs(memory.rate[spring])) ** CROSS_POWER
        flown = (moved - memory.flow[spring]) * -math.expm1(-step * thin / wall.fluid[1])
        memory.flow[spring] += flown
        if step > 0.0:
            memory.rate[spring] = flown / step
    memory.last[spring] = strain
