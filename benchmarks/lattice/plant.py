"""The lattice: point masses and springs around pressurised chambers, pneumatics and cameras.

A soft arm as a volume and no rod: nodes on cross-sections that may shift, tilt and lose their
shape, joined by springs (`body`) of a material with memory (`wall`). A chamber under pressure p
pushes on every node by p dV/dx, V being the volume that the chamber encloses: a pressure normal to
each of its faces, wherever they have moved. Bending, stretch, bulging and shear follow from the
springs. There is no inertia: after each step the forces balance, and all memory is in springs, air
and events. `motion` solves for the balance by Newton's method. SI units; forces in the frame of the
base, z along the arm.
"""

import math
from typing import NamedTuple

import numpy as np

from benchmarks.generators import rotation, since
from benchmarks.lattice.body import ALONG, Body
from benchmarks.lattice.gas import VOLUMES, Gas
from benchmarks.lattice.wall import Memory, Wall, remember, slope, stress
from surgisoft.compiled import compiled


class Plant(NamedTuple):
    """All parameters of a robot with K springs, N nodes, m chambers and n key points."""

    body: Body
    """Lattice as cast."""
    rigidity: np.ndarray
    """(K,) force of each spring per strain [N]."""
    unit: float
    """Strain that the material's laws count as 1 [-]."""
    mass: np.ndarray
    """(N,) mass of each node [kg]."""
    gravity: np.ndarray
    """(3,) acceleration of weight [m/s^2]."""
    wall: Wall
    """Material of the springs along the arm and of all diagonals; the others are linear."""
    gas: Gas
    """Pneumatics."""
    high: float
    """Upper limit of pressure [Pa]."""
    chambers: np.ndarray
    """(m, 3) place of each chamber in its ring, its first slab, and the slab behind its last."""
    gains: np.ndarray
    """(m,) pressure in a chamber over that which its sensor is calibrated to [-]."""
    loose: float
    """Mean pressure below which a bladder does not touch the wall [Pa]: it does so later and later
    towards the tip."""
    warmth: np.ndarray
    """(2,) share of the modulus lost [1/K] and thermal expansion [1/K]; nonzero: the room is not
    air-conditioned."""
    heat: np.ndarray
    """(2,) share of the modulus gained at a moment, and the moment [s]."""
    patch: np.ndarray
    """(K,) whether a spring buckles."""
    buckling: np.ndarray
    """(3,) strain by which such a spring is then shorter, and the strains at which it buckles and
    returns [-]."""
    ball: np.ndarray
    """(5,) centre [m] and radius [m] of a soft ball that the arm may touch, and stiffness under
    each node of the outer wall [N/m]; stiffness 0: none."""
    cable: np.ndarray
    """(6,) anchor [m] of a cable, node that it pulls at, free length [m] and rigidity [N]; rigidity
    0: none. It carries no compression."""
    guide: np.ndarray
    """(7,) anchor [m] of a hose's dry guide, node at which the hose is fixed, stiffness [N/m], and
    forces at which it begins and ceases to slide [N]; stiffness 0: none."""
    drift: np.ndarray
    """(3,) rotation of the base after ten minutes [rad]."""
    slip: np.ndarray
    """(3,) shift along the axis [m] and roll about it [rad] of the arm in its clamp, and the moment
    [s]."""
    breath: np.ndarray
    """(5,) shift of the base at the depth of a breath [m], mean period and phase [s]."""
    misalignment: np.ndarray
    """(6,) rotation [rad] and shift [m] of the cameras' frame."""
    lens: np.ndarray
    """(7,) direction of view, centre of the picture [m], and radial distortion [1/m^2]."""
    keys: np.ndarray
    """(n,) cross-section of each key point."""


class State(NamedTuple):
    """State of a robot; changed in place."""

    time: np.ndarray
    """(1,) time since the robot was switched on [s]."""
    nodes: np.ndarray
    """(N, 3) positions in the frame of the base [m]."""
    memory: Memory
    """Of the springs."""
    buckled: np.ndarray
    """(K,) 1 where a spring has buckled."""
    air: np.ndarray
    """(1 + VOLUMES, m) gauge pressures from the regulators to the chambers [Pa]."""
    balanced: np.ndarray
    """(m,) pressures in the chambers in the last step, which the springs' tension balances [Pa]."""
    warm: np.ndarray
    """(1,) temperature of the arm above the room's at which it is nominal [K]."""
    held: np.ndarray
    """(1,) length of the hose behind its guide [m]."""
    force: np.ndarray
    """(3 (N - q),) force on each node that is not clamped [N]."""
    band: np.ndarray
    """(3 (N - q), 6 q) matrix of a step: lower diagonals of each column."""
    factor: np.ndarray
    """Its Cholesky factor, in the same form."""


@compiled
def room(time: float) -> float:
    """Temperature of the room above the nominal one [K]: it warms, and the sun comes and goes."""
    late = max(time, 0.0)
    return 0.01 * late + 4.0 * (1.0 - math.cos(2.0 * math.pi * late / 260.0))


@compiled
def pose(plant: Plant, time: float, frame: np.ndarray, shift: np.ndarray) -> None:
    """Axes (3, 3) and origin (3,) [m] of the base at a time [s], into frame and shift."""
    turn, tilted, rolled = np.zeros(3), np.empty((3, 3)), np.empty((3, 3))
    slow = (max(time, 0.0) / 600.0) ** (1.0 / 3.0)  # Andrade (1910)
    sudden = since(time, plant.slip[2])
    for d in range(3):
        turn[d] = plant.drift[d] * slow
    rotation(turn, tilted)
    for d in range(3):
        turn[d] = 0.0
    turn[2] = plant.slip[1] * sudden
    rotation(turn, rolled)
    breath = 0.0
    if plant.breath[3] > 0.0:
        # A pause at the end of each breath (Lujan et al. 1999), and no two breaths are equal.
        phase = math.pi * (time - plant.breath[4]) / plant.breath[3]
        phase += 0.4 * math.sin(2.0 * math.pi * time / 41.0)
        breath = math.sin(phase) ** 4 * (1.0 + 0.2 * math.sin(2.0 * math.pi * time / 23.0))
    for i in range(3):
        for j in range(3):
            frame[i, j] = 0.0
            for k in range(3):
                frame[i, j] += tilted[i, k] * rolled[k, j]
    for d in range(3):
        shift[d] = breath * plant.breath[d] + sudden * plant.slip[0] * frame[d, 2]


@compiled(inner=True)
def stiffen(band: np.ndarray, one: int, two: int, matrix: np.ndarray, clamped: int) -> None:
    """Add the stiffness (3, 3) [N/m] of a spring between two nodes to the band.

    one < two; nodes below `clamped` do not move; one < 0: the spring holds node two to the room.
    """
    above, below = 3 * (two - clamped), 3 * (one - clamped)
    for e in range(3):
        for d in range(e, 3):
            band[above + e, d - e] += matrix[d, e]
            if one >= clamped:
                band[below + e, d - e] += matrix[d, e]
        if one >= clamped:
            for d in range(3):
                band[below + e, above - below + d - e] -= matrix[d, e]


@compiled(inner=True)
def pull_springs(plant: Plant, state: State, exact: float, clamped: int) -> None:
    """Forces of all springs, and their matrix."""
    way, matrix = np.empty(3), np.empty((3, 3))
    modulus = math.exp(-plant.warmth[0] * state.warm[0])
    modulus *= 1.0 + plant.heat[0] * since(state.time[0], plant.heat[1])
    for k in range(plant.rigidity.shape[0]):
        one, two = plant.body.ends[k, 0], plant.body.ends[k, 1]
        square = 0.0
        for d in range(3):
            way[d] = state.nodes[two, d] - state.nodes[one, d]
            square += way[d] ** 2
        length = math.sqrt(square)
        rigidity = plant.rigidity[k]
        strain = length / plant.body.lengths[k] - 1.0 - plant.warmth[1] * state.warm[0]
        if plant.body.kinds[k] < ALONG:
            tension = rigidity * modulus * strain
            slant = modulus
        else:
            if state.buckled[k] > 0.0:
                strain += plant.buckling[0] * plant.unit
            carried = stress(plant.wall, state.memory, k, strain / plant.unit, modulus)
            tension = rigidity * plant.unit * carried
            slant = slope(plant.wall, state.memory, k, modulus)
        for d in range(3):
            way[d] /= length
            force = tension * way[d]
            if one >= clamped:
                state.force[3 * (one - clamped) + d] += force
            state.force[3 * (two - clamped) + d] -= force
        across = exact * tension / length
        factor = rigidity * slant / plant.body.lengths[k] - across
        for d in range(3):
            for e in range(3):
                matrix[d, e] = factor * way[d] * way[e]
            matrix[d, d] += across
        stiffen(state.band, one, two, matrix, clamped)


@compiled(inner=True)
def push_face(
    state: State,
    one: int,
    two: int,
    three: int,
    sixth: float,
    stiff: float,
    clamped: int,
) -> None:
    """Forces on the corners of a triangle, and their matrix.

    sixth, stiff: a sixth of the pressure now and of the one that is balanced [Pa]; the matrix is
    that of the latter. The force on corner a is p / 6 b x c, b and c being the next corners, and
    its change with b is -p / 6 c x.
    """
    corners = (one, two, three)
    for k in range(3):
        at, a, b = corners[k], corners[(k + 1) % 3], corners[(k + 2) % 3]
        if at < clamped:
            continue
        ax, ay, az = state.nodes[a, 0], state.nodes[a, 1], state.nodes[a, 2]
        bx, by, bz = state.nodes[b, 0], state.nodes[b, 1], state.nodes[b, 2]
        row = 3 * (at - clamped)
        state.force[row] += sixth * (ay * bz - az * by)
        state.force[row + 1] += sixth * (az * bx - ax * bz)
        state.force[row + 2] += sixth * (ax * by - ay * bx)
        if a >= clamped:
            # Rows of node `at`, columns of node a: the matrix of b x; or transposed.
            low, high, sign = at, a, -stiff
            if at > a:
                low, high, sign = a, at, stiff
            column, off = 3 * (low - clamped), 3 * (high - low)
            state.band[column + 1, off - 1] -= sign * bz
            state.band[column + 2, off - 2] += sign * by
            state.band[column, off + 1] += sign * bz
            state.band[column + 2, off - 1] -= sign * bx
            state.band[column, off + 2] -= sign * by
            state.band[column + 1, off + 1] += sign * bx


@compiled(inner=True)
def transmitted(plant: Plant, chamber: int, pressure: float, place: float) -> float:
    """Pressure on a chamber's wall [Pa] at a place along it, 0 at its base and 1 at its end."""
    inside = plant.gains[chamber] * pressure
    if plant.loose > 0.0:
        inside = math.copysign(max(abs(inside) - 2.0 * plant.loose * place, 0.0), inside)
    return inside


@compiled(inner=True)
def push_chambers(plant: Plant, state: State, exact: float, section: int) -> None:
    """Forces p dV/dx of the pressure in each slab of each chamber on the nodes around it.

    The faces of a slab are its two caps and six sides. A side is a quadrilateral that need not be
    flat: the mean of both ways of cutting it into two triangles, so that no handedness comes in.
    """
    for i in range(plant.chambers.shape[0]):
        face = plant.body.faces[plant.chambers[i, 0]]
        first, last = plant.chambers[i, 1], plant.chambers[i, 2]
        below, held_below = 0.0, 0.0
        for z in range(first, last + 1):
            inside, held = 0.0, 0.0
            if z < last:
                place = (z - first + 0.5) / (last - first)
                inside = transmitted(plant, i, state.air[VOLUMES, i], place)
                held = exact * transmitted(plant, i, state.balanced[i], place)
            low, high = z * section, (z + 1) * section
            cap, stiff = (below - inside) / 6.0, (held_below - held) / 6.0
            if cap != 0.0 or stiff != 0.0:
                for k in range(1, 5):
                    one, two, three = low + face[0], low + face[k], low + face[k + 1]
                    push_face(state, one, two, three, cap, stiff, section)
            side, stiff = inside / 12.0, held / 12.0
            if side != 0.0 or stiff != 0.0:
                for k in range(6):
                    a, b = face[k], face[(k + 1) % 6]
                    push_face(state, low + a, low + b, high + b, side, stiff, section)
                    push_face(state, low + a, high + b, high + a, side, stiff, section)
                    push_face(state, low + a, low + b, high + a, side, stiff, section)
                    push_face(state, low + b, high + b, high + a, side, stiff, section)
            below, held_below = inside, held


@compiled(inner=True)
def push_ball(plant: Plant, state: State, section: int) -> None:
    """Forces of a soft ball on the outer wall: springs under its surface (Winkler 1867)."""
    frame, shift, centre = np.empty((3, 3)), np.empty(3), np.zeros(3)
    way, matrix = np.empty(3), np.empty((3, 3))
    pose(plant, state.time[0], frame, shift)
    for d in range(3):
        for e in range(3):
            centre[d] += frame[e, d] * (plant.ball[e] - shift[e])
    inner = (section - 1) // 3 + 1
    for node in range(section, state.nodes.shape[0]):
        if node % section < inner:
            continue
        square = 0.0
        for d in range(3):
            way[d] = state.nodes[node, d] - centre[d]
            square += way[d] ** 2
        depth = plant.ball[3] - math.sqrt(square)
        if depth > 0.0:
            for d in range(3):
                way[d] /= math.sqrt(square)
                state.force[3 * (node - section) + d] += plant.ball[4] * depth * way[d]
            for d in range(3):
                for e in range(3):
                    matrix[d, e] = plant.ball[4] * way[d] * way[e]
            stiffen(state.band, -1, node, matrix, section)


@compiled(inner=True)
def pull_line(
    plant: Plant, state: State, line: np.ndarray, free: float, stiffness: float, section: int
) -> None:
    """Force of a line from an anchor line[:3] [m] to node line[3], free length [m], [N/m]."""
    way, matrix, node, square = np.empty(3), np.empty((3, 3)), int(line[3]), 0.0
    for d in range(3):
        way[d] = state.nodes[node, d] - line[d]
        square += way[d] ** 2
    length = math.sqrt(square)
    for d in range(3):
        way[d] /= length
        state.force[3 * (node - section) + d] -= stiffness * (length - free) * way[d]
    for d in range(3):
        for e in range(3):
            matrix[d, e] = stiffness * way[d] * way[e]
    stiffen(state.band, -1, node, matrix, section)


@compiled
def apart(nodes: np.ndarray, line: np.ndarray) -> float:
    """Distance [m] between the anchor line[:3] of a line and the node line[3] where it is fixed."""
    square = 0.0
    for d in range(3):
        square += (nodes[int(line[3]), d] - line[d]) ** 2
    return math.sqrt(square)


@compiled
def load(plant: Plant, state: State, exact: float) -> None:
    """Forces on all nodes that are not clamped, and their matrix.

    exact: 1 with the change of the directions of springs and pressures, 0 with the springs' stretch
    alone, which makes the matrix positive definite.
    """
    section = 3 * plant.body.faces.shape[0] + 1
    frame, shift = np.empty((3, 3)), np.empty(3)
    pose(plant, state.time[0], frame, shift)
    for i in range(state.band.shape[0]):
        for j in range(state.band.shape[1]):
            state.band[i, j] = 0.0
    for node in range(section, state.nodes.shape[0]):
        for d in range(3):
            weight = 0.0
            for e in range(3):
                weight += frame[e, d] * plant.gravity[e]
            state.force[3 * (node - section) + d] = plant.mass[node] * weight
    pull_springs(plant, state, exact, section)
    push_chambers(plant, state, exact, section)
    if plant.ball[4] > 0.0:
        push_ball(plant, state, section)
    if plant.cable[5] > 0.0 and apart(state.nodes, plant.cable) > plant.cable[4]:
        stiffness = plant.cable[5] / plant.cable[4]
        pull_line(plant, state, plant.cable, plant.cable[4], stiffness, section)
    if plant.guide[4] > 0.0:
        # The hose holds in its guide up to static friction, and slides at once down to kinetic.
        length = apart(state.nodes, plant.guide)
        if abs(length - state.held[0]) * plant.guide[4] > plant.guide[5]:
            left = plant.guide[6] / plant.guide[4]
            state.held[0] = length - math.copysign(left, length - state.held[0])
        pull_line(plant, state, plant.guide, state.held[0], plant.guide[4], section)


@compiled
def follow(plant: Plant, state: State, moved: np.ndarray, step: float) -> None:
    """Move the nodes, and what the springs remember, for one step [s]."""
    section = 3 * plant.body.faces.shape[0] + 1
    for row in range(moved.shape[0]):
        state.nodes[section + row // 3, row % 3] += moved[row]
    for k in range(plant.rigidity.shape[0]):
        if plant.body.kinds[k] < ALONG:
            continue
        square = 0.0
        for d in range(3):
            one, two = plant.body.ends[k, 0], plant.body.ends[k, 1]
            square += (state.nodes[two, d] - state.nodes[one, d]) ** 2
        strain = math.sqrt(square) / plant.body.lengths[k] - 1.0
        strain = (strain - plant.warmth[1] * state.warm[0]) / plant.unit
        if plant.patch[k] > 0.0:
            far = strain - state.memory.rest[k]
            if far < plant.buckling[1]:
                state.buckled[k] = 1.0
            elif far > plant.buckling[2]:
                state.buckled[k] = 0.0
        strain += plant.buckling[0] * state.buckled[k]
        remember(plant.wall, state.memory, k, strain, step)


@compiled
def see(plant: Plant, state: State, points: np.ndarray) -> None:
    """Key points (n, 3) [m] as cameras see them: means of cross-sections, into points."""
    section = 3 * plant.body.faces.shape[0] + 1
    frame, shift, turned = np.empty((3, 3)), np.empty(3), np.empty((3, 3))
    mean, at = np.empty(3), np.empty(3)
    pose(plant, state.time[0], frame, shift)
    rotation(plant.misalignment[:3], turned)
    for j in range(plant.keys.shape[0]):
        for d in range(3):
            mean[d] = 0.0
            for k in range(section):
                mean[d] += state.nodes[plant.keys[j] * section + k, d] / section
        for d in range(3):
            at[d] = shift[d]
            for e in range(3):
                at[d] += frame[d, e] * mean[e]
        if plant.lens[6] != 0.0:
            # Radial distortion of a lens (Brown 1966), in the plane across the direction of view.
            along, square = 0.0, 0.0
            for d in range(3):
                along += (at[d] - plant.lens[3 + d]) * plant.lens[d]
            for d in range(3):
                mean[d] = at[d] - plant.lens[3 + d] - along * plant.lens[d]
                square += mean[d] ** 2
            for d in range(3):
                at[d] += plant.lens[6] * square * mean[d]
        for d in range(3):
            points[j, d] = plant.misalignment[3 + d]
            for e in range(3):
                points[j, d] += turned[d, e] * at[e]
