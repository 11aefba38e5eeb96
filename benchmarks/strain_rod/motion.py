"""A Kirchhoff rod whose strains are polynomials along the arm, and how it moves.

Strain parametrisation (Renda et al. 2020; Boyer et al. 2021): curvatures u_x and u_y, torsion u_z
and stretch e of each segment are sums of Legendre polynomials with coefficients q; the pose
g(s) in SE(3) follows from g' = g xi, xi = (u_x, u_y, u_z; 0, 0, 1 + e). Over an interval h with
twists xi_1, xi_2 at its two Gauss points the exponential of

    h (xi_1 + xi_2) / 2 + sqrt(3) h^2 / 12 [xi_1, xi_2]

takes it to the next node (Magnus 1954; of fourth order: Hairer, Lubich & Wanner 2006, IV.7). Forces
act at nodes, with the weights of Simpson's rule; their virtual work on the strains is the moment
and force that they exert at the Gauss points, in the frame there, so that no Jacobian is needed.
There is no inertia: the wall's stress with its dashpots, an implicit step by Newton's method,
carries weight, contact and chambers. A chamber of area A at (x, y) under pressure p carries the
couple (y p A, -x p A) and stretches with p A, whatever the pose. SI units, z along the arm.
"""

import math
from typing import NamedTuple

import numpy as np

from benchmarks.generators import ROOM_C, rotation, since
from benchmarks.strain_rod.gas import fill
from benchmarks.strain_rod.robot import GAUSS, PARTS, Plant
from benchmarks.strain_rod.wall import Memory, forget, new_memory, remember, wall_stress
from surgisoft.compiled import compiled

STEP_S = 0.01
"""Longest time step [s]."""
NEWTON = 2
"""Iterations of Newton's method in a step."""
WALL_S = 60.0
"""Time in which the wall follows the temperature of the room (Newton's law of cooling) [s]."""
SUN_S = 12.0
"""Time in which a side of the arm follows the sun [s]."""
RESETS = 300
"""Steps of the weather within a reset."""
SETTLED = 400
"""Steps in which an arm without memory comes to rest."""
KELVIN = 273.15
"""Zero of the Celsius scale [K]."""
DRIFT_S = 250.0
"""Time in which half of a mount's drift has occurred [s]."""
DEEPEST = 2.0
"""Depth in a plate beyond which its force is linear, over the depth at which it grows by e [-]."""


class State(NamedTuple):
    """State of a robot; changed in place."""

    time: np.ndarray
    """(1,) time since the robot was switched on [s]."""
    shape: np.ndarray
    """(S, D) coefficients q of the polynomials [-]."""
    last: np.ndarray
    """(S, D) their change in the last step [-]."""
    strain: np.ndarray
    """(G, 4) strains at the Gauss points [-]."""
    load: np.ndarray
    """(G, 4) couples [N m] and force [N] by what acts from outside, in the frame of the section."""
    memory: Memory
    """Of the wall."""
    air: np.ndarray
    """(4, m) gauge pressures at the sensors [Pa], their rates [Pa/s], pressures in the middle of
    the hoses and in the chambers [Pa]."""
    flags: np.ndarray
    """(1,) 1 while the relief valve is open."""
    warm: np.ndarray
    """(2,) temperature of the wall above the nominal one [K], and share of the sun's bending."""
    nodes: np.ndarray
    """(N + 1, 3) nodes [m], the base first."""
    frames: np.ndarray
    """(N + 1, 3, 3) their axes in columns."""
    points: np.ndarray
    """(G, 3) Gauss points [m]."""
    sections: np.ndarray
    """(G, 3, 3) their axes in columns."""


def new_state(plant: Plant) -> State:
    """A robot that was switched on and is at rest."""
    points = len(plant.bend)
    segments = points // plant.basis.shape[0]
    state = State(
        time=np.zeros(1),
        shape=np.zeros((segments, len(plant.component))),
        last=np.zeros((segments, len(plant.component))),
        strain=np.zeros((points, 4)),
        load=np.zeros((points, 4)),
        memory=new_memory(points),
        air=np.zeros((4, len(plant.areas))),
        flags=np.zeros(1),
        warm=np.zeros(2),
        nodes=np.zeros((PARTS + 1, 3)),
        frames=np.zeros((PARTS + 1, 3, 3)),
        points=np.zeros((points, 3)),
        sections=np.zeros((points, 3, 3)),
    )
    rest(plant, state, 0.0)
    return state


def rest(plant: Plant, state: State, seconds: float) -> None:
    """Vent the robot and let it rest for a time [s] until it has no memory: the start of a run."""
    for _ in range(RESETS):
        state.time[0] += seconds / RESETS
        weather(plant, state, seconds / RESETS)
    state.air[:] = 0.0
    state.flags[:] = 0.0
    calm = plant.wall._replace(
        viscous=0.05,
        friction=np.array([0.0, 0.0, 1.0]),
        flow=np.array([0.0, 1.0, 1.0]),
        fluid=np.array([0.0, 1.0]),
        damage=0.0,
    )
    still = plant._replace(wall=calm)
    forget(state.memory, state.strain)
    for _ in range(SETTLED):
        move(still, state, STEP_S)
    state.last[:] = 0.0
    forget(state.memory, state.strain)


@compiled
def room(time: float) -> float:
    """Temperature above the nominal one of a room that the day warms, with gusts of an air
    conditioner [K]."""
    late = max(time, 0.0)
    swing = math.sin(math.pi * late / 130.0)
    return 7.0 * late / (late + 200.0) + 5.0 * swing * swing * swing * swing


@compiled
def weather(plant: Plant, state: State, step: float) -> None:
    """Let the wall follow room and sun for one step [s]."""
    time = state.time[0]
    if plant.warmth != 0.0:
        state.warm[0] += (room(time) - state.warm[0]) * -math.expm1(-step / WALL_S)
    if plant.shining.shape[0] > 0:
        shines = 0.0
        for spell in range(plant.shining.shape[0]):
            if plant.shining[spell, 0] <= time < plant.shining[spell, 1]:
                shines = 1.0
        state.warm[1] += (shines - state.warm[1]) * -math.expm1(-step / SUN_S)


@compiled
def breathed(time: float, period: float, phase: float) -> float:
    """Depth of a ventilated breath [-]: a constant flow in, and a passive one out, which decays
    exponentially (Otis, Fenn & Rahn 1950)."""
    cycle = (time - phase) / period + 0.06 * math.sin(2.0 * math.pi * time / 41.0)
    cycle -= math.floor(cycle)
    if cycle < 0.35:
        return cycle / 0.35 * -math.expm1(-3.5) + math.exp(-3.5) * (1.0 - cycle / 0.35)
    return math.exp(-3.5 * (cycle - 0.35) / 0.65)


@compiled
def base_turn(plant: Plant, time: float, out: np.ndarray) -> None:
    """Rotation vector (3,) of the base [rad], into out."""
    late = max(time, 0.0)
    # A hyperbola, as concrete creeps (Ross 1937).
    slow = late / (late + DRIFT_S) * (600.0 + DRIFT_S) / 600.0
    for d in range(3):
        out[d] = plant.drift[d] * slow
    if plant.slips.shape[0] > 0 and time > plant.slips[0, 0]:
        # A block that is dragged by a spring and slips (Burridge & Knopoff 1967).
        last = 0
        while last + 1 < plant.slips.shape[0] and plant.slips[last + 1, 0] <= time:
            last += 1
        turn = plant.slips[last, 1] + plant.dragged[0] * (time - plant.slips[last, 0])
        for d in range(3):
            out[d] += turn * plant.dragged[1 + d]
    for step in range(plant.steps.shape[0]):
        after = time - plant.steps[step]
        if 0.0 < after < 5.0:
            # A table that rings down after a blow.
            swing = math.exp(-plant.shaken[4] * plant.shaken[3] * after)
            swing *= math.sin(plant.shaken[3] * after)
            for d in range(3):
                out[d] += plant.shaken[d] * swing


@compiled
def times(one: np.ndarray, two: np.ndarray, out: np.ndarray) -> None:
    """Product of matrices (3, 3), into out."""
    for i in range(3):
        for j in range(3):
            out[i, j] = one[i, 0] * two[0, j] + one[i, 1] * two[1, j] + one[i, 2] * two[2, j]


@compiled
def moved_by(
    turn: np.ndarray,
    shift: np.ndarray,
    place: np.ndarray,
    frame: np.ndarray,
    new_place: np.ndarray,
    new_frame: np.ndarray,
) -> None:
    """Pose behind a pose by the exponential of a twist (turn; shift) in SE(3), into new ones.

    The shift is V shift, V = 1 + (1 - cos a) / a^2 W + (a - sin a) / a^3 W^2 (Murray, Li & Sastry
    1994, eq. 2.36), W the cross product with turn and a = |turn|.
    """
    turned = np.empty((3, 3))
    rotation(turn, turned)
    square = turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2
    angle = math.sqrt(square)
    if angle < 1e-3:
        b, c = 0.5 - square / 24.0, 1.0 / 6.0 - square / 120.0
    else:
        b, c = (1.0 - math.cos(angle)) / square, (angle - math.sin(angle)) / (square * angle)
    x, y, z = turn[0], turn[1], turn[2]
    one = (y * shift[2] - z * shift[1], z * shift[0] - x * shift[2], x * shift[1] - y * shift[0])
    two = (y * one[2] - z * one[1], z * one[0] - x * one[2], x * one[1] - y * one[0])
    for d in range(3):
        new_place[d] = place[d]
        for e in range(3):
            new_place[d] += frame[d, e] * (shift[e] + b * one[e] + c * two[e])
    times(frame, turned, new_frame)


@compiled
def place_arm(plant: Plant, state: State) -> None:
    """Poses of nodes and Gauss points from the strains; the base moves with time."""
    time = state.time[0]
    turn, shift = np.empty(3), np.empty(3)
    one, two = np.empty(4), np.empty(4)
    base_turn(plant, time, turn)
    rotation(turn, state.frames[0])
    depth = 0.0
    if plant.breath[3] > 0.0:
        depth = breathed(time, plant.breath[3], plant.breath[4])
    for d in range(3):
        state.nodes[0, d] = depth * plant.breath[d]
    part = plant.length / PARTS
    wide = math.sqrt(3.0)
    for k in range(PARTS):
        for c in range(4):
            one[c] = plant.reference[c] * state.strain[2 * k, c]
            two[c] = plant.reference[c] * state.strain[2 * k + 1, c]
        one[3] += 1.0
        two[3] += 1.0
        for j in range(2):
            # Twist of the linear interpolation from the node to the Gauss point.
            share = GAUSS[j] * part
            middle = wide * (0.5 * GAUSS[j] - GAUSS[0])
            for d in range(3):
                turn[d] = share * (one[d] + middle * (two[d] - one[d]))
                shift[d] = 0.0
            shift[2] = share * (one[3] + middle * (two[3] - one[3]))
            moved_by(
                turn,
                shift,
                state.nodes[k],
                state.frames[k],
                state.points[2 * k + j],
                state.sections[2 * k + j],
            )
        order = wide * part * part / 12.0
        for d in range(3):
            turn[d] = 0.5 * part * (one[d] + two[d])
        turn[0] += order * (one[1] * two[2] - one[2] * two[1])
        turn[1] += order * (one[2] * two[0] - one[0] * two[2])
        turn[2] += order * (one[0] * two[1] - one[1] * two[0])
        # [xi_1, xi_2] has the shift u_1 x v_2 - u_2 x v_1, v along z.
        shift[0] = order * (one[1] * two[3] - two[1] * one[3])
        shift[1] = order * (two[0] * one[3] - one[0] * two[3])
        shift[2] = 0.5 * part * (one[3] + two[3])
        moved_by(
            turn, shift, state.nodes[k], state.frames[k], state.nodes[k + 1], state.frames[k + 1]
        )


@compiled
def plate_force(plant: Plant, depth: float) -> float:
    """Force per length [N/m] of a plate at a depth [m]: a foundation (Winkler 1867) that stiffens
    exponentially, as tissue does."""
    if depth <= 0.0:
        return 0.0
    share = depth / plant.plate[7]
    held = min(share, DEEPEST)
    return plant.plate[6] * plant.plate[7] * (math.expm1(held) + math.exp(held) * (share - held))


@compiled
def load_arm(plant: Plant, state: State) -> None:
    """Couples and force at every Gauss point by weight, contact and hose, into state.load."""
    part = plant.length / PARTS
    force, moment, at = np.zeros(3), np.zeros(3), np.empty(3)
    own = np.empty(3)
    for d in range(3):
        at[d] = state.nodes[PARTS, d]
    # moment: about the place `at`, of all that acts beyond it.
    if plant.payload[0] > 0.0:
        tip = state.frames[PARTS]
        for d in range(3):
            own[d] = (
                tip[d, 0] * plant.payload[1]
                + tip[d, 1] * plant.payload[2]
                + tip[d, 2] * plant.payload[3]
            )
        x, y, z = own[0], own[1], own[2]
        weight = plant.payload[0]
        moment[0] += weight * (y * plant.gravity[2] - z * plant.gravity[1])
        moment[1] += weight * (z * plant.gravity[0] - x * plant.gravity[2])
        moment[2] += weight * (x * plant.gravity[1] - y * plant.gravity[0])
        for d in range(3):
            force[d] += weight * plant.gravity[d]
    if plant.hose[0] > 0.0:
        around = 2.0 * math.pi * state.time[0] / plant.hose[1] + plant.hose[2]
        force[0] += plant.hose[0] * math.cos(around)
        force[1] += plant.hose[0] * math.sin(around)
    for k in range(PARTS, 0, -1):
        simpson = 1.0 if k == PARTS else (4.0 if k % 2 == 1 else 2.0)
        share = simpson / (3.0 * PARTS) * plant.mass
        for d in range(3):
            force[d] += share * plant.gravity[d]
        if plant.plate[6] > 0.0:
            depth = plant.radius
            for d in range(3):
                depth -= (state.nodes[k, d] - plant.plate[d]) * plant.plate[3 + d]
            pushed = plate_force(plant, depth) * part * (0.5 if k == PARTS else 1.0)
            for d in range(3):
                force[d] += pushed * plant.plate[3 + d]
        for g in (2 * k - 1, 2 * k - 2):
            x = at[0] - state.points[g, 0]
            y = at[1] - state.points[g, 1]
            z = at[2] - state.points[g, 2]
            moment[0] += y * force[2] - z * force[1]
            moment[1] += z * force[0] - x * force[2]
            moment[2] += x * force[1] - y * force[0]
            axes = state.sections[g]
            for d in range(3):
                state.load[g, d] = (
                    axes[0, d] * moment[0] + axes[1, d] * moment[1] + axes[2, d] * moment[2]
                )
                at[d] = state.points[g, d]
            state.load[g, 3] = axes[0, 2] * force[0] + axes[1, 2] * force[1] + axes[2, 2] * force[2]
        x = at[0] - state.nodes[k - 1, 0]
        y = at[1] - state.nodes[k - 1, 1]
        z = at[2] - state.nodes[k - 1, 2]
        moment[0] += y * force[2] - z * force[1]
        moment[1] += z * force[0] - x * force[2]
        moment[2] += x * force[1] - y * force[0]
        for d in range(3):
            at[d] = state.nodes[k - 1, d]


@compiled
def plate_stiffness(plant: Plant, state: State, matrix: np.ndarray) -> None:
    """Stiffness (S, D, D) of the plate against each segment's polynomials, over the weight of a
    Gauss point [N m]: sum over nodes of k J^T J, J by the geometric Jacobian."""
    part, each = plant.length / PARTS, plant.basis.shape[0]
    count = plant.component.shape[0]
    row, lever = np.empty(count), np.empty(4)
    for segment in range(matrix.shape[0]):
        for d in range(count):
            for e in range(count):
                matrix[segment, d, e] = 0.0
    for k in range(1, PARTS + 1):
        depth = plant.radius
        for d in range(3):
            depth -= (state.nodes[k, d] - plant.plate[d]) * plant.plate[3 + d]
        if depth <= 0.0:
            continue
        stiff = plant.plate[6] * math.exp(min(depth / plant.plate[7], DEEPEST))
        stiff *= part * (0.5 if k == PARTS else 1.0) * 0.5 * part
        x, y, z = plant.plate[3], plant.plate[4], plant.plate[5]
        for segment in range(matrix.shape[0]):
            for d in range(count):
                row[d] = 0.0
            for g in range(each):
                point = segment * each + g
                if point >= 2 * k:
                    break
                p = state.nodes[k, 0] - state.points[point, 0]
                q = state.nodes[k, 1] - state.points[point, 1]
                r = state.nodes[k, 2] - state.points[point, 2]
                axes = state.sections[point]
                for c in range(3):
                    # (axis x way) . normal = axis . (way x normal)
                    lever[c] = plant.reference[c] * (
                        axes[0, c] * (q * z - r * y)
                        + axes[1, c] * (r * x - p * z)
                        + axes[2, c] * (p * y - q * x)
                    )
                lever[3] = plant.reference[3] * (axes[0, 2] * x + axes[1, 2] * y + axes[2, 2] * z)
                for d in range(count):
                    row[d] += plant.basis[g, d] * lever[plant.component[d]]
            for d in range(count):
                for e in range(count):
                    matrix[segment, d, e] += stiff * row[d] * row[e]


@compiled
def push(plant: Plant, pressures: np.ndarray, chamber: int) -> float:
    """Pressure with which a chamber pushes on its nominal area [Pa]."""
    m = pressures.shape[0]
    ring = 3 if m == 6 else m
    first = chamber - chamber % ring
    own = pressures[chamber]
    share = 1.0 + plant.growth * own / plant.high
    if plant.septum[0] != 0.0:
        # Septa move until they carry the difference: their tension is that of the mean pressure
        # (Laplace 1806) and their own; the section of all chambers stays as it is.
        mean = 0.0
        for j in range(first, first + ring):
            mean += pressures[j] / ring
        share *= 1.0 + plant.septum[0] * (own - mean) / (max(mean, 0.0) + plant.septum[1])
    slack = plant.slack[chamber]
    if slack > 0.0:
        # Threads of lengths that are distributed logistically (Verhulst 1838): their part that is
        # taut, integrated.
        wide = 0.25 * slack
        own = wide * (
            math.log1p(math.exp((own - slack) / wide)) - math.log1p(math.exp(-slack / wide))
        )
    return own * share


@compiled
def solve(matrix: np.ndarray, right: np.ndarray) -> None:
    """Solve a symmetric positive definite system (D, D) in place (Cholesky 1924); right: (D,)."""
    count = right.shape[0]
    for i in range(count):
        for j in range(i + 1):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = math.sqrt(total) if i == j else total / matrix[j, j]
        for k in range(i):
            right[i] -= matrix[i, k] * right[k]
        right[i] /= matrix[i, i]
    for i in range(count - 1, -1, -1):
        for k in range(i + 1, count):
            right[i] -= matrix[k, i] * right[k]
        right[i] /= matrix[i, i]


@compiled
def move(plant: Plant, state: State, step: float) -> None:
    """Move the arm for one step [s] under the pressures in the chambers."""
    place_arm(plant, state)
    load_arm(plant, state)
    weather(plant, state, step)
    count, m, each = plant.component.shape[0], plant.areas.shape[0], plant.basis.shape[0]
    ring = 3 if m == 6 else m
    weights = np.empty(4)
    for c in range(4):
        weights[c] = plant.ratio[c] * (plant.reference[c] / plant.reference[0]) ** 2
    factor = 1.0 + plant.warmth * state.warm[0] / (KELVIN + ROOM_C)
    broken = since(state.time[0], plant.broken[3]) if plant.broken[3] > 0.0 else 0.0
    segments = state.shape.shape[0]
    touched = np.empty((segments, count, count))
    if plant.plate[6] > 0.0:
        plate_stiffness(plant, state, touched)
    pushes, wanted = np.empty((each, 4)), np.empty((each, 4))
    before, stress, slope = np.empty((each, 4)), np.empty(4), np.empty((4, 4))
    matrix, right, scaled = np.empty((count, count)), np.empty(count), np.empty((4, count))
    for segment in range(segments):
        pressed = 0.0
        for c in range(4):
            for g in range(each):
                pushes[g, c] = 0.0
        for i in range(segment * ring, (segment + 1) * ring):
            pressed += state.air[3, i] / (ring * plant.high)
            force = push(plant, state.air[3], i) * plant.areas[i]
            for g in range(each):
                point = segment * each + g
                own = force
                inside = plant.broken[1] <= point < plant.broken[2]
                if broken > 0.0 and i == int(plant.broken[0]) and inside:
                    own *= 1.0 + broken * plant.broken[4]
                pushes[g, 0] += own * plant.offset[i] * math.sin(plant.angles[i])
                pushes[g, 1] -= own * plant.offset[i] * math.cos(plant.angles[i])
                pushes[g, 3] += own
        for g in range(each):
            point = segment * each + g
            unit = plant.bend[point] * plant.reference[0] ** 2
            for c in range(4):
                before[g, c] = state.strain[point, c]
                wanted[g, c] = plant.reference[c] * (pushes[g, c] + state.load[point, c])
                if c < 2:
                    wanted[g, c] += unit * (plant.bow[point, c] + state.warm[1] * plant.sun[c])
            # Newton's method starts from the rate of the step before.
            for d in range(count):
                state.strain[point, plant.component[d]] += (
                    plant.basis[g, d] * state.last[segment, d]
                )
        for d in range(count):
            state.shape[segment, d] += state.last[segment, d]
        for _ in range(NEWTON):
            for d in range(count):
                right[d] = 0.0
                for e in range(d + 1):
                    matrix[d, e] = 0.0
                if plant.plate[6] > 0.0:
                    for e in range(count):
                        right[d] -= touched[segment, d, e] * state.last[segment, e]
                    for e in range(d + 1):
                        matrix[d, e] = touched[segment, d, e]
            for g in range(each):
                point = segment * each + g
                unit = plant.bend[point] * plant.reference[0] ** 2
                wall_stress(
                    plant.wall,
                    state.memory,
                    point,
                    weights,
                    pressed,
                    factor,
                    before[g],
                    state.strain[point],
                    step,
                    stress,
                    slope,
                )
                for c in range(4):
                    stress[c] = wanted[g, c] - unit * stress[c]
                    for e in range(count):
                        scaled[c, e] = unit * slope[c, plant.component[e]] * plant.basis[g, e]
                for d in range(count):
                    c, basis = plant.component[d], plant.basis[g, d]
                    right[d] += basis * stress[c]
                    for e in range(d + 1):
                        matrix[d, e] += basis * scaled[c, e]
            solve(matrix, right)
            for d in range(count):
                state.shape[segment, d] += right[d]
                state.last[segment, d] += right[d]
            for g in range(each):
                for d in range(count):
                    state.strain[segment * each + g, plant.component[d]] += (
                        plant.basis[g, d] * right[d]
                    )
        for g in range(each):
            point = segment * each + g
            remember(plant.wall, state.memory, point, weights, before[g], state.strain[point], step)
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
    warm: np.ndarray,
) -> None:
    """Follow set points (T, m) [Pa], one a sample, and read after each period [s] of some steps.

    Into measured (T, m) and chambers (T, m) [Pa], points (T, n, 3) [m] and warm (T,) [deg C].
    """
    step = period / steps
    frame = np.empty((3, 3))
    rotation(plant.misalignment[:3], frame)
    for row in range(targets.shape[0]):
        for _ in range(steps):
            fill(plant.gas, targets[row], state.air, state.flags, state.time[0], plant.high, step)
            move(plant, state, step)
        place_arm(plant, state)
        for i in range(targets.shape[1]):
            measured[row, i] = state.air[0, i]
            chambers[row, i] = state.air[3, i]
        for j in range(plant.keys.shape[0]):
            for d in range(3):
                points[row, j, d] = plant.misalignment[3 + d]
                for e in range(3):
                    points[row, j, d] += frame[d, e] * state.nodes[plant.keys[j], e]
        warm[row] = ROOM_C + (room(state.time[0]) if plant.warmth != 0.0 else 0.0)
