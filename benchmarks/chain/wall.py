"""Wall of the chain's joints: what a joint carries beyond linear elasticity, with memory.

Strains x are counted in units of the robot's reference (one chamber at its limit bends or
stretches the joint by 1); stresses are in units of the stress of x = 1 in a linear wall. Two
components of bending belong together, extension is on its own. Memory counts from the strain at
rest x_0. A joint carries

- friction of a rubber spring (Berg 1998), each component on its own: from the last turning point
  (x_s, f_s) the stress approaches the limit f along a hyperbola,
  f_s + (x - x_s) (f - f_s) / (x_h (1 - f_s / f) + x - x_s) for rising x, mirrored for falling x.
  Only the last turning point is remembered;
- a relaxing network (Bergstrom & Boyce 1998): a share g of the modulus in series with a dashpot
  whose rate is a power of its stress, s' = g x' - s (|s| / s_0)^(n-1) / tau;
- damage (Simo 1987) that grows with the largest energy w = |x - x_0|^2 / 2 so far,
  D(w) = d w / (w + w_0), scaled so that first loading stays as it was;
- stiffening by the polynomial of Yeoh (1993), x (b |x|^2 + b |x|^4 / 5);
- a dashpot of a power of the rate (Ostwald 1929), eta |x'|^(k-1) x', beside the linear one.

The arm models have play operators, sums of retarded elements, Ogden & Roxburgh's energy, Fung's
exponential and Ellis' fluid, all on the chambers' loads and not on strains. The virtual rig has a
Preisach plane, the PyElastica rig Bouc and Wen's friction, Eyring's fluid and logarithmic
relaxation.
"""

import math
from typing import NamedTuple

import numpy as np

from surgisoft.compiled import compiled

DAMAGE_ENERGY = 0.15
"""Energy at which half of the damage has occurred, w_0 [-]."""
RELAXED_STRESS = 0.05
"""Stress scale of the relaxing network, s_0 [-]; only s_0^(n-1) tau matters."""
RELAXATION_POWER = 4.0
"""Power of the relaxing network's rate, n [-] (Bergstrom & Boyce 1998: 4 for filled rubber)."""


class Wall(NamedTuple):
    """Parameters of the wall; zero switches a term off."""

    viscous: float
    """Time constant of the linear dashpot [s]."""
    friction: np.ndarray
    """(2,) limit f [-] and half-way strain x_h [-] of the friction."""
    relaxing: np.ndarray
    """(2,) share g [-] and time tau [s] of the relaxing network."""
    damage: float
    """Largest damage d [-]."""
    locking: float
    """Coefficient b of stiffening [-]."""
    fluid: np.ndarray
    """(2,) eta [s^k] and k [-] of the power-law dashpot."""


class Memory(NamedTuple):
    """What a joint's wall remembers of 3 components: bending about x and y, extension."""

    rest: np.ndarray
    """(N, 3) strain at rest x_0."""
    turned: np.ndarray
    """(N, 3, 2) strain and stress of the friction at its last turning point."""
    rising: np.ndarray
    """(N, 3) direction of the friction's branch: 1, -1, or 0 before the first motion."""
    relaxing: np.ndarray
    """(N, 3) stress of the relaxing network."""
    peak: np.ndarray
    """(N, 2) largest energy of bending and of extension."""


def new_memory(joints: int) -> Memory:
    """Memory of a wall that was never strained."""
    return Memory(
        rest=np.zeros((joints, 3)),
        turned=np.zeros((joints, 3, 2)),
        rising=np.zeros((joints, 3)),
        relaxing=np.zeros((joints, 3)),
        peak=np.zeros((joints, 2)),
    )


def forget(memory: Memory, strain: np.ndarray) -> None:
    """Take the strain (N, 3) as the strain at rest, and remember nothing else."""
    memory.rest[:] = strain
    memory.turned[:, :, 0] = strain
    memory.turned[:, :, 1] = 0.0
    for state in (memory.rising, memory.relaxing, memory.peak):
        state[:] = 0.0


@compiled
def friction(limit: float, half: float, turned: float, held: float, strain: float) -> float:
    """Berg's stress at a strain, on the branch from the turning point (turned, held)."""
    way = strain - turned
    if way >= 0.0:
        return held + way * (limit - held) / (half * (1.0 - held / limit) + way)
    return held + way * (limit + held) / (half * (1.0 + held / limit) - way)


@compiled
def relaxed(stress: float, tau: float, step: float) -> float:
    """Stress >= 0 of the relaxing network after a time [s] of constant strain; exact."""
    power = RELAXATION_POWER - 1.0
    if stress < 1e-9:
        return stress
    return stress * (1.0 + power * step / tau * (stress / RELAXED_STRESS) ** power) ** (
        -1.0 / power
    )


@compiled
def wall_stress(
    wall: Wall, memory: Memory, joint: int, strain: np.ndarray, softness: float, out: np.ndarray
) -> None:
    """Stress (3,) that a joint carries at rates of zero, into out.

    strain: (3,) [-]; softness: share of the modulus lost, to heat or a tear [-].
    """
    for part in range(2):
        first, last = (0, 2) if part == 0 else (2, 3)
        square, energy = 0.0, 0.0
        for d in range(first, last):
            square += strain[d] ** 2
            energy += 0.5 * (strain[d] - memory.rest[joint, d]) ** 2
        factor = 1.0 - softness + wall.locking * (square + 0.2 * square * square)
        damaged = 0.0
        if wall.damage > 0.0:
            worst = max(memory.peak[joint, part], energy)
            now = 1.0 - wall.damage * energy / (energy + DAMAGE_ENERGY)
            damaged = 1.0 - (1.0 - wall.damage * worst / (worst + DAMAGE_ENERGY)) / now
        for d in range(first, last):
            moved = strain[d] - memory.rest[joint, d]
            out[d] = strain[d] * factor - moved * (damaged + wall.relaxing[0])
            out[d] += memory.relaxing[joint, d]
            if wall.friction[0] > 0.0:
                out[d] += friction(
                    wall.friction[0],
                    wall.friction[1],
                    memory.turned[joint, d, 0],
                    memory.turned[joint, d, 1],
                    strain[d],
                )


@compiled
def rate_of(wall: Wall, lack: float, stiffness: float, step: float) -> float:
    """Strain rate [1/s] under a stress that nothing elastic carries; implicit in the step [s].

    lack: [-], stiffness: of all springs at the present strain [-]. With w = |x'|^k the equation
    (viscous + stiffness step) w^(1/k) + eta w = |lack| is convex: Newton's method from above.
    """
    linear = wall.viscous + stiffness * step
    if wall.fluid[0] == 0.0 or lack == 0.0:
        return lack / linear
    size, power = abs(lack), 1.0 / wall.fluid[1]
    w = min(size / wall.fluid[0], (size / linear) ** wall.fluid[1])
    for _ in range(8):
        over = linear * w**power + wall.fluid[0] * w - size
        w -= over / (linear * power * w ** (power - 1.0) + wall.fluid[0])
        w = max(w, 1e-300)
    return math.copysign(w**power, lack)


@compiled
def remember(
    wall: Wall, memory: Memory, joint: int, before: np.ndarray, strain: np.ndarray, step: float
) -> None:
    """Move the memory of a joint from strain (3,) before to strain within a step [s]."""
    for d in range(3):
        moved = strain[d] - before[d]
        if wall.friction[0] > 0.0 and moved != 0.0:
            way = 1.0 if moved > 0.0 else -1.0
            if memory.rising[joint, d] != way:
                limit, half = wall.friction[0], wall.friction[1]
                turned, held = memory.turned[joint, d, 0], memory.turned[joint, d, 1]
                memory.turned[joint, d, 1] = friction(limit, half, turned, held, before[d])
                memory.turned[joint, d, 0] = before[d]
                memory.rising[joint, d] = way
    for part in range(2):
        first, last = (0, 2) if part == 0 else (2, 3)
        energy, square = 0.0, 0.0
        for d in range(first, last):
            energy += 0.5 * (strain[d] - memory.rest[joint, d]) ** 2
            memory.relaxing[joint, d] += wall.relaxing[0] * (strain[d] - before[d])
            square += memory.relaxing[joint, d] ** 2
        memory.peak[joint, part] = max(memory.peak[joint, part], energy)
        if wall.relaxing[0] > 0.0 and square > 0.0:
            stress = math.sqrt(square)
            share = relaxed(stress, wall.relaxing[1], step) / stress
            for d in range(first, last):
                memory.relaxing[joint, d] *= share
