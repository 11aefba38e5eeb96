"""Wall of the rod: what a section carries beyond linear elasticity, with memory.

Strains x (two of bending, torsion, stretch) are counted in units of the robot's reference, stresses
in units of that of x = 1 in a linear wall; a_c is the stiffness of component c over that of bending
in these units. Memory counts from the strain at rest x_0. A section carries

- chains of limited length (Kuhn & Gruen 1942) with the approximation of Cohen (1991),
  x (1 - I / 3) / (1 - I), I = lambda sum_c a_c x_c^2: the section's mean square strain. It is the
  derivative of an energy, so stretch stiffens bending and the other way round;
- friction of fibres that the chambers' pressure presses against each other (Tondu & Lopez 2000),
  f (f_0 + (1 - f_0) p) z, with the vector form of Bouc and Wen's law (Wen 1976) and the power 2,
  dz = dx / x_y - z |z . dx| / x_y;
- creep: a strain y in series, whose flow is the hyperbolic sine of stress (Garofalo 1965) against
  a spring that brings it back, dy/dt = c s_0 sinh(s / s_0) / tau, s = x - x_0 - y / c;
- damage: chains that are pulled out of hard domains and remain so (Qi & Boyce 2004), a
  share d v(X) of the stiffness at the largest X = |x - x_0|_a / 1.5 so far,
  v(X) = 1 - exp(-X / (1 - X)), scaled so that first loading stays as it was;
- a fluid of Powell & Eyring (1944), e asinh(lambda x'), beside the linear dashpot tau x';
- helical fibres that couple stretch and torsion, as those of a wire rope do (Love 1927;
  Cardou & Jolicoeur 1997): the energy a_2 (x_2 - h x_3)^2 / 2 in place of that of torsion.
"""

import math
from typing import NamedTuple

import numpy as np

from benchmarks.strain_rod.robot import Wall
from surgisoft.compiled import compiled

NEAR_STRAIGHT = 0.7
"""I beyond which the stiffness of chains is continued linearly [-]."""
FAR = 1.5
"""Strain at which all chains are pulled out [-]."""
HELD = 0.97
"""Largest X that the damage counts [-]."""


class Memory(NamedTuple):
    """What the wall remembers at its G Gauss points."""

    rest: np.ndarray
    """(G, 4) strain at rest x_0."""
    friction: np.ndarray
    """(G, 4) state z of the friction."""
    crept: np.ndarray
    """(G, 4) strain y of creep."""
    largest: np.ndarray
    """(G,) largest X so far."""


def new_memory(points: int) -> Memory:
    """Memory of a wall that was never strained."""
    return Memory(
        np.zeros((points, 4)), np.zeros((points, 4)), np.zeros((points, 4)), np.zeros(points)
    )


def forget(memory: Memory, strain: np.ndarray) -> None:
    """Take the strain (G, 4) as the strain at rest, and remember nothing else."""
    memory.rest[:] = strain
    for state in (memory.friction, memory.crept, memory.largest):
        state[:] = 0.0


@compiled
def chains(square: float) -> tuple[float, float]:
    """Stiffness of chains at I, and its derivative [-]."""
    held = min(square, NEAR_STRAIGHT)
    slope = (2.0 / 3.0) / (1.0 - held) ** 2
    return (1.0 - held / 3.0) / (1.0 - held) + slope * (square - held), slope


@compiled
def pulled_out(strain: float) -> float:
    """Share v(X) of the chains that are pulled out."""
    held = min(strain, HELD)
    return -math.expm1(-held / (1.0 - held))


@compiled
def slipped(state: np.ndarray, moved: np.ndarray, slip: float, out: np.ndarray) -> None:
    """State z (4,) of the friction after a strain (4,) has moved; implicit: |z| stays below 1."""
    along = 0.0
    for c in range(4):
        along += state[c] * moved[c]
    share = 1.0 / (1.0 + abs(along) / slip)
    for c in range(4):
        out[c] = share * (state[c] + moved[c] / slip)


@compiled
def crept(flow: np.ndarray, strain: float, before: float, step: float) -> float:
    """Strain y of creep after a time [s] of a constant strain x - x_0; exact."""
    compliance, scale = flow[0], flow[1]
    stress = strain - before / compliance
    left = math.tanh(0.5 * min(max(stress / scale, -40.0), 40.0)) * math.exp(-step / flow[2])
    return compliance * (strain - 2.0 * scale * math.atanh(left))


@compiled
def size(strain: np.ndarray, rest: np.ndarray, weights: np.ndarray) -> float:
    """X of a strain (4,): its distance from that at rest over FAR."""
    square = 0.0
    for c in range(4):
        square += weights[c] * (strain[c] - rest[c]) ** 2
    return math.sqrt(square) / FAR


@compiled
def wall_stress(
    wall: Wall,
    memory: Memory,
    point: int,
    weights: np.ndarray,
    pressed: float,
    factor: float,
    before: np.ndarray,
    strain: np.ndarray,
    step: float,
    out: np.ndarray,
    slope: np.ndarray,
) -> None:
    """Stress (4,) that a section carries at the end of a step [s], times a_c, and its derivative.

    weights: (4,) a_c; pressed: mean pressure of the chambers over their limit [-]; factor: on the
    stiffness [-]; before, strain: (4,) at the begin and the end of the step. Into out (4,) and
    slope (4, 4).
    """
    square = 0.0
    for c in range(4):
        square += weights[c] * (strain[c] - memory.crept[point, c]) ** 2
    stiff, more = chains(wall.locking * square)
    more *= 2.0 * wall.locking
    if wall.damage > 0.0:
        now = size(strain, memory.rest[point], weights)
        most = max(now, memory.largest[point])
        factor *= (1.0 - wall.damage * pulled_out(most)) / (1.0 - wall.damage * pulled_out(now))
    rub = wall.friction[0] * (wall.friction[1] + (1.0 - wall.friction[1]) * max(pressed, 0.0))
    slip = wall.friction[2]
    along = 0.0
    for c in range(4):
        along += memory.friction[point, c] * (strain[c] - before[c])
    share = 1.0 / (1.0 + abs(along) / slip)
    for c in range(4):
        elastic = strain[c] - memory.crept[point, c]
        moved = strain[c] - before[c]
        rate = moved / step
        held = share * (memory.friction[point, c] + moved / slip)
        out[c] = factor * stiff * elastic + rub * held + wall.viscous * rate
        for e in range(4):
            back = strain[e] - memory.crept[point, e]
            slope[c, e] = factor * more * weights[c] * elastic * weights[e] * back
        diagonal = factor * stiff + rub * share / slip + wall.viscous / step
        if wall.fluid[0] > 0.0:
            fast = wall.fluid[1] * rate
            out[c] += wall.fluid[0] * math.asinh(fast)
            diagonal += wall.fluid[0] * wall.fluid[1] / math.sqrt(1.0 + fast * fast) / step
        out[c] *= weights[c]
        slope[c, c] += weights[c] * diagonal
    if wall.helix != 0.0:
        # The linear wall's own a_2 x_2 is in the sum above.
        turn = weights[2] * wall.helix
        out[2] -= turn * strain[3]
        out[3] += turn * (wall.helix * strain[3] - strain[2])
        slope[2, 3] -= turn
        slope[3, 2] -= turn
        slope[3, 3] += turn * wall.helix


@compiled
def remember(
    wall: Wall,
    memory: Memory,
    point: int,
    weights: np.ndarray,
    before: np.ndarray,
    strain: np.ndarray,
    step: float,
) -> None:
    """Move the memory of a section from strain (4,) before to strain within a step [s]."""
    moved, state = np.empty(4), np.empty(4)
    for c in range(4):
        moved[c] = strain[c] - before[c]
    slipped(memory.friction[point], moved, wall.friction[2], state)
    for c in range(4):
        memory.friction[point, c] = state[c]
        if wall.flow[0] > 0.0:
            late = memory.crept[point, c]
            memory.crept[point, c] = crept(wall.flow, strain[c] - memory.rest[point, c], late, step)
    memory.largest[point] = max(memory.largest[point], size(strain, memory.rest[point], weights))
