"""Wall of the arm on PyElastica: what its bending and extension carry beyond linear elasticity.

Strains are counted in units of the robot's reference: x = (kappa - kappa_rest) / kappa_ref (two
components of bending at each of PyElastica's N - 1 inner nodes) and x = eps / (kappa_ref R) (one
component of extension in each of N elements). The wall carries B kappa_ref (x + y), and y sums:

- friction: elastoplastic elements of two yield strains x_y, each y = f z with the biaxial form of
  Bouc and Wen's law (Park, Wen & Ang 1986): dz = dx / x_y - z (|z . dx| + z . dx) / (2 x_y);
- viscosity: a spring g in series with a fluid of Eyring (1936), dy/dt = g dx/dt less a flow that
  grows with the hyperbolic sine of y / y_0. A time h takes tanh(|y| / (2 y_0)) to its product with
  exp(-h / tau), which is exact;
- creep: stress that relaxes with the logarithm of time, as rubber's does (Derham 1973): equal
  shares of modulus that relax at times a factor of four apart, one after the other;
- softening: a modulus that falls with the largest strain so far by the damage function
  d(x) = s (1 - exp(-x / x_s)) of Miehe (1995), scaled so that first loading stays as it was:
  y = x ((1 - d(x_max)) / (1 - d(|x|)) - 1);
- stiffening: chains of limited length (Gent 1996), y = x (1 / (1 - |x|^2 / J) - 1);
- warmth: a share of the modulus lost.

None of these is the law of an effect in the arm models: those act on pressures, not on strains, and
have play operators, Ellis' fluid, retarded loads with a log-normal spectrum, an exponential of
energy, and Fung's exponential.
"""

import math
from typing import NamedTuple

import numpy as np

from surgisoft.compiled import compiled

RELAXATION_S = np.array([1.0, 4.0, 16.0, 64.0, 256.0])
"""Relaxation times of creep [s]."""
DAMAGE_STRAIN = 0.5
"""Strain over which most of the softening occurs, x_s [-]."""
NEAR_LOCKED = 0.9
"""Largest share of J that |x|^2 reaches in the law of stiffening [-]; beyond, it is linear."""


class Wall(NamedTuple):
    """Parameters of the wall; zero switches a term off."""

    friction: np.ndarray
    """(2,) stress that each friction element carries when it slips, f [-]."""
    slip: np.ndarray
    """(2,) strain at which each friction element slips, x_y [-]."""
    viscous: np.ndarray
    """(3,) modulus g [-], stress scale y_0 [-] and relaxation time tau [s] of the viscous part."""
    creep: float
    """Share of the modulus that relaxes in all [-]."""
    softening: float
    """Largest share of the modulus that damage takes, s [-]."""
    locking: float
    """1 / J: inverse of the squared strain at which the wall locks [-]."""


class Memory(NamedTuple):
    """Memory of a wall with K places and d components of strain; updated in place."""

    last: np.ndarray
    """(d, K) strain x."""
    rest: np.ndarray
    """(d, K) strain at rest, from which creep counts."""
    friction: np.ndarray
    """(2, d, K) state z of the friction elements."""
    viscous: np.ndarray
    """(d, K) stress y of the viscous part."""
    creep: np.ndarray
    """(5, d, K) stress of each creep element."""
    peak: np.ndarray
    """(K,) largest |x|."""


def new_memory(components: int, places: int) -> Memory:
    """Memory of a wall that was never strained."""
    return Memory(
        last=np.zeros((components, places)),
        rest=np.zeros((components, places)),
        friction=np.zeros((2, components, places)),
        viscous=np.zeros((components, places)),
        creep=np.zeros((len(RELAXATION_S), components, places)),
        peak=np.zeros(places),
    )


def forget(memory: Memory) -> None:
    """Take the present strain as the strain at rest, and remember nothing else."""
    memory.rest[:] = memory.last
    for state in (memory.friction, memory.viscous, memory.creep):
        state[:] = 0.0
    memory.peak[:] = np.sqrt(np.square(memory.last).sum(axis=0))


def stiffest(wall: Wall) -> float:
    """Largest factor on the modulus by friction, viscosity and stiffening [-]."""
    friction = float((wall.friction / wall.slip).sum())
    locked = 1.0 + 0.5 * wall.locking if wall.locking else 1.0
    return locked + friction + float(wall.viscous[0])


@compiled
def strain_wall(
    wall: Wall, warmth: float, step: float, strain: np.ndarray, memory: Memory, more: np.ndarray
) -> None:
    """Move the wall to strains (d, K) within a time step [s]; its added stress y into more (d, K).

    warmth: share of the modulus lost to the temperature of the room [-].
    """
    components, places = strain.shape
    flow = math.exp(-step / wall.viscous[2]) if wall.viscous[0] > 0.0 else 0.0
    for k in range(places):
        square = 0.0
        for d in range(components):
            more[d, k] = -warmth * strain[d, k]
            square += strain[d, k] * strain[d, k]
        size = math.sqrt(square)
        for j in range(2):
            if wall.friction[j] == 0.0:
                continue
            along = 0.0
            for d in range(components):
                along += memory.friction[j, d, k] * (strain[d, k] - memory.last[d, k])
            loss = 0.5 * (abs(along) + along) / wall.slip[j]
            for d in range(components):
                gain = (strain[d, k] - memory.last[d, k]) / wall.slip[j]
                memory.friction[j, d, k] += gain - memory.friction[j, d, k] * loss
                more[d, k] += wall.friction[j] * memory.friction[j, d, k]
        if wall.viscous[0] > 0.0:
            carried = 0.0
            for d in range(components):
                memory.viscous[d, k] += wall.viscous[0] * (strain[d, k] - memory.last[d, k])
                carried += memory.viscous[d, k] ** 2
            carried = math.sqrt(carried)
            if carried > 0.0:
                scale = 2.0 * wall.viscous[1]
                left = scale * math.atanh(flow * math.tanh(min(carried / scale, 15.0)))
                for d in range(components):
                    memory.viscous[d, k] *= left / carried
                    more[d, k] += memory.viscous[d, k]
        if wall.creep > 0.0:
            share = wall.creep / RELAXATION_S.shape[0]
            for j in range(RELAXATION_S.shape[0]):
                keep = math.exp(-step / RELAXATION_S[j])
                for d in range(components):
                    held = memory.creep[j, d, k] + share * (strain[d, k] - memory.last[d, k])
                    memory.creep[j, d, k] = keep * held
                    away = strain[d, k] - memory.rest[d, k]
                    more[d, k] += memory.creep[j, d, k] - share * away
        memory.peak[k] = max(memory.peak[k], size)
        if wall.softening > 0.0:
            worst = 1.0 - wall.softening * (1.0 - math.exp(-memory.peak[k] / DAMAGE_STRAIN))
            first = 1.0 - wall.softening * (1.0 - math.exp(-size / DAMAGE_STRAIN))
            for d in range(components):
                more[d, k] += strain[d, k] * (worst / first - 1.0)
        if wall.locking > 0.0:
            taken = min(square * wall.locking, NEAR_LOCKED)
            for d in range(components):
                more[d, k] += strain[d, k] * (1.0 / (1.0 - taken) - 1.0)
        for d in range(components):
            memory.last[d, k] = strain[d, k]
