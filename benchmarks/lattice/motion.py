"""Motion of the lattice: one Newton step after another, at rest and under changing pressures."""

import math

import numpy as np
from scipy.linalg import lapack

from benchmarks.generators import ROOM_C
from benchmarks.lattice.gas import VOLUMES, fill
from benchmarks.lattice.plant import Plant, State, follow, load, room, see
from benchmarks.lattice.wall import forget, new_memory
from surgisoft.errors import InputError

STEP_S = 0.05
"""Longest time step [s]."""
CLOSE_M = 1e-3
"""A Newton step that moves a coordinate by more is followed by another one [m]."""
NEWTON_STEPS = 4
"""Most Newton steps in a time step."""
GAS_STEPS = 4
"""Steps of the air in one of the lattice."""
MOST_MOVED = 5e-3
"""Most that a coordinate moves in one step [m]; a longer Newton step is shortened."""
ARM_S = 40.0
"""Time constant with which an arm follows the temperature of the room [s]."""


def new_state(plant: Plant) -> State:
    """A robot that was switched on and hangs at rest."""
    nodes, springs = plant.body.nodes, len(plant.rigidity)
    section = 1 + 3 * len(plant.body.faces)
    free = 3 * (len(nodes) - section)
    state = State(
        time=np.zeros(1),
        nodes=nodes.copy(),
        memory=new_memory(springs),
        buckled=np.zeros(springs),
        air=np.zeros((1 + VOLUMES, len(plant.chambers))),
        balanced=np.zeros(len(plant.chambers)),
        warm=np.zeros(1),
        held=np.zeros(1),
        force=np.zeros(free),
        band=np.zeros((free, 6 * section)),
        factor=np.zeros((free, 6 * section)),
    )
    rest(plant, state, 0.0)
    return state


def rest(plant: Plant, state: State, seconds: float) -> None:
    """Vent the robot and let it hang for a time [s] until it has no memory: the start of a run."""
    state.time[0] += seconds
    warmer = room(state.time[0]) if plant.warmth.any() else 0.0
    state.warm[0] = warmer + (state.warm[0] - warmer) * math.exp(-seconds / ARM_S)
    state.air[:] = 0.0
    state.balanced[:] = 0.0
    state.nodes[:] = plant.body.nodes
    state.buckled[:] = 0.0
    forget(state.memory)
    settle(plant._replace(guide=np.zeros(7)), state)
    forget(state.memory)
    state.held[0] = np.linalg.norm(state.nodes[int(plant.guide[3])] - plant.guide[:3])


def settle(plant: Plant, state: State) -> None:
    """Move the nodes of an arm without memory to rest under the pressures in its chambers.

    The pressures rise in steps, as without the walls' tension they would buckle the arm.
    """
    calm = plant.wall._replace(
        friction=np.zeros(2), creep=0.0, damage=0.0, threads=0.0, fluid=np.array([0.0, 1.0, 0.0])
    )
    still, pressures = plant._replace(wall=calm), state.air.copy()
    for rise in np.linspace(0.05, 1.0, 20) if pressures.any() else [1.0]:
        state.air[:] = rise * pressures
        for _ in range(50):
            if advance(still, state, STEP_S) < (1e-9 if rise == 1.0 else 1e-4):
                break


def move(plant: Plant, state: State, step: float) -> None:
    """Move the nodes for one step [s] under the pressures in the chambers."""
    if plant.warmth.any():
        warmer = room(state.time[0])
        state.warm[0] += (warmer - state.warm[0]) * -math.expm1(-step / ARM_S)
    state.time[0] += step
    for _ in range(NEWTON_STEPS):
        if advance(plant, state, step) < CLOSE_M:
            break
        step = 0.0


def advance(plant: Plant, state: State, step: float) -> float:
    """Take one Newton step towards balance; the farthest that a coordinate moves [m].

    step: time in which the springs' memory moves [s]. Where the exact matrix is not positive
    definite, because pressure has changed suddenly, it goes half of the way that the stretch of the
    springs alone would let it go.
    """
    load(plant, state, 1.0)
    share = 1.0
    if not _factorise(state):
        load(plant, state, 0.0)
        _factorise(state)
        share = 0.5
    moved, _ = lapack.dpbtrs(state.factor.T, state.force, lower=1)
    most = share * float(np.abs(moved).max())
    if not np.isfinite(most):
        raise InputError("the lattice became unstable: use a weaker effect")
    follow(plant, state, moved * (share * min(1.0, MOST_MOVED / max(most, 1e-12))), step)
    state.balanced[:] = state.air[VOLUMES]
    return most


def _factorise(state: State) -> bool:
    """Cholesky factor of the matrix; whether it is positive definite."""
    np.copyto(state.factor, state.band)
    return lapack.dpbtrf(state.factor.T, lower=1, overwrite_ab=1)[1] == 0


def run(plant: Plant, state: State, targets: np.ndarray, period: float, steps: int) -> tuple:
    """Follow set points (T, m) [Pa], one a sample, and read after each period [s] of some steps.

    Returns pressures at the sensors and in the chambers, each (T, m) [Pa], key points (T, n, 3) [m]
    and temperatures of the room (T,) [degrees Celsius].
    """
    rows, step = len(targets), period / steps
    measured, chambers = np.empty_like(targets), np.empty_like(targets)
    points, warm = np.empty((rows, len(plant.keys), 3)), np.full(rows, ROOM_C)
    for row in range(rows):
        for _ in range(steps):
            for _ in range(GAS_STEPS):
                fill(plant.gas, targets[row], state.air, state.time[0], step / GAS_STEPS)
            move(plant, state, step)
        measured[row], chambers[row] = state.air[0], state.air[VOLUMES]
        see(plant, state, points[row])
        if plant.warmth.any():
            warm[row] += room(state.time[0])
    return measured, chambers, points, warm
