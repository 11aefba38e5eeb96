"""The chain: rigid links with a bending joint in the middle of each, pneumatics and cameras.

A pseudo-rigid-body model of a continuum arm (Howell 2001; Venkiteswaran et al. 2019): N links of
equal length, each with a joint that bends about two axes, extends, and twists by what its fibres
prescribe. There is no inertia: joints follow the couples on them against the wall's dashpots, so
the arm is overdamped. Positions, moments of weight and loads follow from a walk along the links;
each joint then moves by an implicit step under the couples of the step before.

A chamber of area A at (x, y) under pressure p pushes with p A along its link: its joints carry the
couple (y p A, -x p A) and the force p A. SI units, base frame of the arm, z along the arm.
"""

import math
from typing import NamedTuple

import numpy as np

from benchmarks.chain.gas import Gas, fill
from benchmarks.chain.wall import (
    Memory,
    Wall,
    forget,
    new_memory,
    rate_of,
    remember,
    wall_stress,
)
from benchmarks.generators import ROOM_C, rotation, since
from surgisoft.compiled import compiled

STEP_S = 0.01
"""Longest time step [s]."""
VENTED_S = 0.15
"""Time constant with which a chamber vents whose valve has no current [s]."""


class Plant(NamedTuple):
    """All parameters of a robot with N links, m chambers and n key points."""

    link: float
    """Length of a link [m]."""
    mass: np.ndarray
    """(N,) mass of each link [kg]."""
    tip: float
    """Mass at the tip [kg]."""
    gravity: np.ndarray
    """(3,) acceleration of weight [m/s^2]."""
    bend: np.ndarray
    """(N,) bending stiffness of a joint [N m/rad]."""
    axial: np.ndarray
    """(N,) stiffness of its extension [N] per strain."""
    angle: np.ndarray
    """(N,) reference angle of a joint: one chamber at its limit [rad]."""
    stretch: np.ndarray
    """(N,) reference of its extension [-]."""
    bow: np.ndarray
    """(N, 2) bending as cast, in units of the reference [-]."""
    wall: Wall
    """Material."""
    gas: Gas
    """Pneumatics."""
    high: float
    """Upper limit of pressure [Pa]."""
    areas: np.ndarray
    """(m, N) area with which each chamber pushes on each joint [m^2]; 0 where it does not reach."""
    levers: np.ndarray
    """(m, 2) x, y of each chamber's centroid [m]."""
    growth: float
    """Relative growth of an area at the upper limit [-]."""
    unfold: np.ndarray
    """(m,) pressure below which a chamber's bladder does not touch the wall [Pa]."""
    pressed: np.ndarray
    """(m, m) logarithm of chamber i's area lost where chamber j is higher by the limit [-]."""
    fibre: float
    """Twist of the whole arm at a large mean load [rad]."""
    warmth: float
    """Share of the modulus lost per kelvin [1/K]; nonzero: the room is not air-conditioned."""
    drift: np.ndarray
    """(3,) rotation of the base after ten minutes [rad]."""
    misalignment: np.ndarray
    """(6,) rotation [rad] and shift [m] of the cameras' frame."""
    post: np.ndarray
    """(8,) point on the axis [m], direction of the axis and radius [m] of a long round post that
    the arm may touch, and stiffness of contact [N/m^1.5]; stiffness 0: none."""
    breath: np.ndarray
    """(5,) largest shift of the base [m], mean period and phase of a breath [s]."""
    knock: np.ndarray
    """(4,) rotation of the base [rad] from a moment [s] on."""
    tear: np.ndarray
    """(3,) share of its modulus that one joint loses, the joint, and the moment [s]."""
    slip: np.ndarray
    """(3,) way that the markers of one key point slide along the arm [m], its number, and the
    moment [s]."""
    stick: np.ndarray
    """(2,) stress at which a sleeve about the lower quarter breaks away, and at which it holds
    again [-]; 0: none."""
    kink: np.ndarray
    """(3,) bending at which the line of one chamber kinks [-], the chamber, and the share of the
    section that stays open [-]."""
    snap: np.ndarray
    """(5,) bending by which one joint snaps through [-], the joint, stresses at which it snaps out
    and back [-], and the direction [rad]."""
    dropouts: np.ndarray
    """(K, 2) begin and end of each spell in which a valve behind the sensor vents one chamber,
    because its current drops out [s]."""
    vented: int
    """That chamber."""
    keys: np.ndarray
    """(n,) link at whose end each key point is, counted from 1."""
    radius: float
    """Radius of the arm [m]."""


class State(NamedTuple):
    """State of a robot; changed in place."""

    time: np.ndarray
    """(1,) time since the robot was switched on [s]."""
    strain: np.ndarray
    """(N, 3) bending about x and y and extension of each joint [-]."""
    stress: np.ndarray
    """(N, 3) couples and force on each joint by weight and contact [-]."""
    memory: Memory
    """Of the wall."""
    air: np.ndarray
    """(2, m) gauge pressures in lines and chambers [Pa]."""
    flags: np.ndarray
    """(2,) 1 while the sleeve slips; 1 while the joint is snapped through."""
    joints: np.ndarray
    """(N, 3) positions of the joints [m]."""
    frames: np.ndarray
    """(N, 3, 3) axes of the middle of each joint in columns."""
    nodes: np.ndarray
    """(N + 1, 3) ends of the links [m], the base first."""


def new_state(plant: Plant) -> State:
    """A robot that was switched on and hangs at rest."""
    n, m = len(plant.mass), len(plant.areas)
    state = State(
        time=np.zeros(1),
        strain=np.zeros((n, 3)),
        stress=np.zeros((n, 3)),
        memory=new_memory(n),
        air=np.zeros((2, m)),
        flags=np.zeros(2),
        joints=np.zeros((n, 3)),
        frames=np.zeros((n, 3, 3)),
        nodes=np.zeros((n + 1, 3)),
    )
    rest(plant, state, 0.0)
    return state


def rest(plant: Plant, state: State, seconds: float) -> None:
    """Vent the robot and let it hang for a time [s] until it has no memory: the start of a run."""
    state.time[0] += seconds
    state.air[:] = 0.0
    state.flags[:] = 0.0
    calm = plant.wall._replace(
        viscous=0.05, friction=np.zeros(2), relaxing=np.zeros(2), damage=0.0, fluid=np.zeros(2)
    )
    still = plant._replace(wall=calm, stick=np.zeros(2), snap=np.zeros(5))
    forget(state.memory, state.strain)
    for _ in range(400):
        move(still, state, STEP_S)
    forget(state.memory, state.strain)


@compiled
def warmed(time: float) -> float:
    """Temperature of the room [degrees Celsius] under a thermostat: a heater that switches on and
    off every 150 s, above the temperature at which the arm was nominal."""
    cycle = time % 300.0
    rising = -math.expm1(-cycle / 90.0) if cycle < 150.0 else 0.0
    top = -math.expm1(-150.0 / 90.0)
    if cycle >= 150.0:
        rising = top * math.exp(-(cycle - 150.0) / 90.0)
    return ROOM_C + 8.0 * rising


@compiled
def times(one: np.ndarray, two: np.ndarray, out: np.ndarray) -> None:
    """Product of matrices (3, 3), into out."""
    for i in range(3):
        for j in range(3):
            out[i, j] = one[i, 0] * two[0, j] + one[i, 1] * two[1, j] + one[i, 2] * two[2, j]


@compiled(inner=True)
def mean_load(plant: Plant, state: State) -> float:
    """Mean pressure of the chambers over their limit [-]."""
    total = 0.0
    for i in range(state.air.shape[1]):
        total += state.air[1, i]
    return total / (plant.high * state.air.shape[1])


@compiled
def place_links(plant: Plant, state: State) -> None:
    """Positions of the links from their strains; the base turns and shifts with time."""
    count, time = plant.mass.shape[0], state.time[0]
    turn, bent = np.zeros(3), np.zeros(3)
    frame, half, middle = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    slow, sudden = math.sqrt(max(time, 0.0) / 600.0), since(time, plant.knock[3])
    for d in range(3):
        turn[d] = plant.drift[d] * slow + plant.knock[d] * sudden
    rotation(turn, frame)
    breath = 0.0
    if plant.breath[3] > 0.0:
        phase = 2.0 * math.pi * (time - plant.breath[4]) / plant.breath[3]
        phase += 0.3 * math.sin(2.0 * math.pi * time / 37.0)  # no two breaths are equal
        breath = 0.5 - 0.5 * math.cos(phase) + 0.12 * math.sin(2.0 * phase)
    for d in range(3):
        state.nodes[0, d] = breath * plant.breath[d]
    twist = plant.fibre / count * math.tanh(mean_load(plant, state) / 0.6)
    for k in range(count):
        reach = 0.5 * plant.link * (1.0 + plant.stretch[k] * state.strain[k, 2])
        bent[0] = 0.5 * plant.angle[k] * state.strain[k, 0]
        bent[1] = 0.5 * plant.angle[k] * state.strain[k, 1]
        bent[2] = 0.5 * twist
        rotation(bent, half)
        for d in range(3):
            state.joints[k, d] = state.nodes[k, d] + reach * frame[d, 2]
        times(frame, half, middle)
        for d in range(3):
            for e in range(3):
                state.frames[k, d, e] = middle[d, e]
        times(middle, half, frame)
        for d in range(3):
            state.nodes[k + 1, d] = state.joints[k, d] + reach * frame[d, 2]


@compiled(inner=True)
def load_links(plant: Plant, state: State) -> None:
    """Couples and force on every joint by weight and by the post, into state.stress."""
    count = plant.mass.shape[0]
    force, moment, at, away = np.empty(3), np.zeros(3), np.empty(3), np.empty(3)
    for d in range(3):
        force[d] = plant.tip * plant.gravity[d]
        at[d] = state.nodes[count, d]
    for k in range(count - 1, -1, -1):
        x, y, z = at[0] - state.joints[k, 0], at[1] - state.joints[k, 1], at[2] - state.joints[k, 2]
        moment[0] += y * force[2] - z * force[1]
        moment[1] += z * force[0] - x * force[2]
        moment[2] += x * force[1] - y * force[0]
        axes = state.frames[k]
        for d in range(2):
            couple = axes[0, d] * moment[0] + axes[1, d] * moment[1] + axes[2, d] * moment[2]
            state.stress[k, d] = couple / (plant.bend[k] * plant.angle[k])
        pull = axes[0, 2] * force[0] + axes[1, 2] * force[1] + axes[2, 2] * force[2]
        state.stress[k, 2] = pull / (plant.axial[k] * plant.stretch[k])
        for d in range(3):
            force[d] += plant.mass[k] * plant.gravity[d]
            at[d] = state.joints[k, d]
        if plant.post[7] > 0.0:
            along, square = 0.0, 0.0
            for d in range(3):
                along += (at[d] - plant.post[d]) * plant.post[3 + d]
            for d in range(3):
                away[d] = at[d] - plant.post[d] - along * plant.post[3 + d]
                square += away[d] ** 2
            depth = plant.radius + plant.post[6] - math.sqrt(square)
            if depth > 0.0:
                pushed = plant.post[7] * depth * math.sqrt(depth / square)  # Hertz (1881)
                for d in range(3):
                    force[d] += pushed * away[d]


@compiled
def push(plant: Plant, pressures: np.ndarray, chamber: int) -> float:
    """Pressure with which a chamber pushes on its nominal area [Pa]."""
    own = pressures[chamber]
    share = 1.0 + plant.growth * own / plant.high
    for j in range(pressures.shape[0]):
        higher = pressures[j] - own
        if higher > 0.0:
            share *= math.exp(-plant.pressed[chamber, j] * higher / plant.high)
    if plant.unfold[chamber] > 0.0:
        own = math.copysign(max(abs(own) - plant.unfold[chamber], 0.0), own)
    return own * share


@compiled
def move(plant: Plant, state: State, step: float) -> None:
    """Move the links for one step [s] under the pressures in the chambers."""
    place_links(plant, state)
    load_links(plant, state)
    count, m = plant.mass.shape[0], plant.areas.shape[0]
    pushes = np.empty(m)
    for i in range(m):
        pushes[i] = push(plant, state.air[1], i)
    lack, carried, before = np.empty((count, 3)), np.empty(3), np.empty(3)
    warm = plant.warmth * (warmed(state.time[0]) - ROOM_C)
    torn = since(state.time[0], plant.tear[2]) * plant.tear[0]
    held = 0.0
    for k in range(count):
        softness = warm + (torn if k == int(plant.tear[1]) else 0.0)
        wall_stress(plant.wall, state.memory, k, state.strain[k], softness, carried)
        for d in range(3):
            lack[k, d] = state.stress[k, d] - carried[d]
        for d in range(2):
            lack[k, d] += plant.bow[k, d]
        for i in range(m):
            force = pushes[i] * plant.areas[i, k]
            if force != 0.0:
                couple = force / (plant.bend[k] * plant.angle[k])
                lack[k, 0] += plant.levers[i, 1] * couple
                lack[k, 1] -= plant.levers[i, 0] * couple
                lack[k, 2] += force / (plant.axial[k] * plant.stretch[k])
        if plant.snap[0] > 0.0 and k == int(plant.snap[1]):
            along = math.cos(plant.snap[4]) * (state.strain[k, 0] - state.memory.rest[k, 0])
            along += math.sin(plant.snap[4]) * (state.strain[k, 1] - state.memory.rest[k, 1])
            if along > plant.snap[2]:
                state.flags[1] = 1.0
            elif along < plant.snap[3]:
                state.flags[1] = 0.0
            lack[k, 0] += state.flags[1] * plant.snap[0] * math.cos(plant.snap[4])
            lack[k, 1] += state.flags[1] * plant.snap[0] * math.sin(plant.snap[4])
        if 4 * k < count:
            held += math.sqrt(lack[k, 0] ** 2 + lack[k, 1] ** 2) / ((count + 3) // 4)
    stuck = False
    if plant.stick[0] > 0.0:
        # A dry sleeve: static friction above kinetic, so it holds, gives way at once, and holds.
        if held > plant.stick[0]:
            state.flags[0] = 1.0
        elif held < plant.stick[1]:
            state.flags[0] = 0.0
        stuck = state.flags[0] == 0.0
    stiffness = 1.0
    if plant.wall.friction[0] > 0.0:
        stiffness += plant.wall.friction[0] / plant.wall.friction[1]
    for k in range(count):
        if stuck and 4 * k < count:
            continue
        for d in range(3):
            before[d] = state.strain[k, d]
            square = 3.0 * plant.wall.locking * state.strain[k, d] ** 2
            rate = rate_of(plant.wall, lack[k, d], stiffness + square, step)
            state.strain[k, d] += step * rate
        remember(plant.wall, state.memory, k, before, state.strain[k], step)
    state.time[0] += step


@compiled
def run(
    plant: Plant,
    state: State,
    targets: np.ndarray,
    period: float,
    steps: int,
    measured: np.ndarray,
    chambers: np.ndarray,
    points: np.ndarray,
    room: np.ndarray,
) -> None:
    """Follow set points (T, m) [Pa], one a sample, and read after each period [s] of some steps.

    Into measured (T, m) and chambers (T, m) [Pa], points (T, n, 3) [m] and room (T,) [deg C].
    """
    count, m, step = plant.mass.shape[0], targets.shape[1], period / steps
    open_, seen, frame = np.ones(m), np.empty(3), np.empty((3, 3))
    rotation(plant.misalignment[:3], frame)
    for row in range(targets.shape[0]):
        for _ in range(steps):
            if plant.kink[0] > 0.0:
                bent = 0.0
                for k in range((count + 2) // 3):
                    x = state.strain[k, 0] - state.memory.rest[k, 0]
                    y = state.strain[k, 1] - state.memory.rest[k, 1]
                    bent += math.sqrt(x * x + y * y) / ((count + 2) // 3)
                closed = bent > plant.kink[0]
                open_[int(plant.kink[1])] = plant.kink[2] if closed else 1.0
            off = False
            for spell in range(plant.dropouts.shape[0]):
                begin, end = plant.dropouts[spell, 0], plant.dropouts[spell, 1]
                off = off or begin <= state.time[0] < end
            if plant.dropouts.shape[0] > 0:
                open_[plant.vented] = 0.0 if off else 1.0
                state.air[1, plant.vented] *= math.exp(-step / VENTED_S) if off else 1.0
            fill(plant.gas, open_, targets[row], state.air, step)
            move(plant, state, step)
        place_links(plant, state)
        for i in range(m):
            measured[row, i] = state.air[0, i]
            chambers[row, i] = state.air[1, i]
        for j in range(plant.keys.shape[0]):
            node = plant.keys[j]
            way = 0.0
            if plant.slip[0] != 0.0 and j == int(plant.slip[1]):
                way = since(state.time[0], plant.slip[2]) * plant.slip[0]
            back = max(node - 1, 0)
            for d in range(3):
                along = (state.nodes[node, d] - state.nodes[back, d]) / plant.link
                seen[d] = state.nodes[node, d] + way * along
            for d in range(3):
                points[row, j, d] = plant.misalignment[3 + d]
                for e in range(3):
                    points[row, j, d] += frame[d, e] * seen[e]
        room[row] = warmed(state.time[0]) if plant.warmth != 0.0 else ROOM_C
