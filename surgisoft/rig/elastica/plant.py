"""The arm, its regulators and its cameras, stepped together in compiled code.

One step: air flows into the chambers, the clamped base moves, the rod moves by half a step, wall
and chambers set the rod's rest strains, the rod's velocities change, and it moves by another half.

A chamber of area A at (x, y) in the section, under pressure p, pushes with F = p A along the arm:
the wall carries the axial force F and the couple (y F, -x F) against it. What an area loses by
folds or to a bulging neighbour is lost to both.
"""

import math
from typing import NamedTuple

import numpy as np

from surgisoft.compiled import compiled
from surgisoft.rig.elastica.gas import Air, Gas, fill_chambers, vented
from surgisoft.rig.elastica.rod import Body, accelerate, measure_strains, move_half, sections
from surgisoft.rig.elastica.wall import Memory, Wall, forget, new_memory, strain_wall
from surgisoft.rig.motion_capture import (
    Cameras,
    Tracking,
    circle_centre,
    look,
    mark,
    new_tracking,
    wander,
)

ROOM_C = 22.0
"""Temperature of the room when the rig is switched on [degrees Celsius]."""
BULGE = 0.5
"""Pressure over which a chamber bulges into its neighbours, as a share of the upper limit [-]."""


class Plant(NamedTuple):
    """All parameters of a rig with N elements, m chambers and n key planes; constant. SI units."""

    step: float
    """Time step [s]."""
    keep: float
    """Share of velocity that PyElastica's linear damper leaves in a step [-]."""
    gravity: np.ndarray
    """(3,) acceleration of weight, arm base frame [m/s^2]."""
    wall: Wall
    """Material beyond linear elasticity."""
    bend: np.ndarray
    """(N - 1,) bending stiffness [N m^2]."""
    twist_stiffness: np.ndarray
    """(N - 1,) torsional stiffness [N m^2]."""
    axial: np.ndarray
    """(N,) axial stiffness [N]."""
    bow: np.ndarray
    """(2, N - 1) curvature of the unloaded arm [1/m]."""
    curvature: float
    """Reference of strain: curvature by one chamber at the upper limit [1/m]."""
    radius: float
    """Radius of the arm [m]."""
    gas: Gas
    """Pneumatics."""
    high: float
    """Upper limit of pressure [Pa]."""
    areas: np.ndarray
    """(m,) area of each chamber [m^2]."""
    levers: np.ndarray
    """(m, 2) x, y of each chamber's centroid [m]."""
    taper: np.ndarray
    """(m,) relative change of area from base to tip, zero at the middle [-]."""
    growth: float
    """Relative growth of a chamber's area at the upper limit [-]."""
    volumes: np.ndarray
    """(m,) volumes of the chambers at rest [m^3]."""
    unfold: np.ndarray
    """(m,) pressure that unfolds each chamber's membrane [Pa]; 0: no folds."""
    stolen: np.ndarray
    """(m, m) share of chamber i's area that the fully bulged chamber j takes [-]."""
    fibre: float
    """Tangent of the mean angle between fibres and section [-]: pressure twists the arm."""
    plane: np.ndarray
    """(2, 3) origin [m] and normal of an obstacle."""
    plane_stiffness: float
    """Stiffness of the obstacle [N/m]; 0: none."""
    base: np.ndarray
    """(3, 3) directors of the clamped base as rows."""
    drift: np.ndarray
    """(3,) rotation of the base after ten minutes [rad]."""
    knock: np.ndarray
    """(4,) rotation of the base [rad] and the moment [s] at which it is knocked so."""
    breath: np.ndarray
    """(5,) largest shift of the base [m], period and delay of a breath [s]."""
    bracket: np.ndarray
    """(2,) compliance of the base [rad/(N m)] and the couple that its dry friction holds [N m]."""
    tear: np.ndarray
    """(3,) share of bending stiffness that the wall loses at one inner node [-], the number of that
    node, and the moment [s]; share 0: none."""
    slip: np.ndarray
    """(3,) way that the markers of one key plane slide along the arm [mm], the number of that
    plane, and the moment [s]; way 0: none."""
    warmth: float
    """Logarithm of modulus lost per kelvin [1/K]; nonzero: the room is not air-conditioned."""
    misalignment: np.ndarray
    """(6,) rotation [rad] and shift [mm] of the cameras' frame."""
    nodes: np.ndarray
    """(n,) int64 node of each key plane."""
    cameras: Cameras
    """Motion capture."""


class State(NamedTuple):
    """The state of a rig; changed in place."""

    time: np.ndarray
    """(1,) time since the rig was switched on [s]."""
    body: Body
    """The rod."""
    bending: Memory
    """The wall's memory of bending."""
    stretch: Memory
    """The wall's memory of extension."""
    air: Air
    """Pressures."""
    slipped: np.ndarray
    """(3,) rotation of the base's bracket about x and y [rad], and 1 while it slips."""
    hung: np.ndarray
    """(2,) couple on the bracket about x and y at rest, to which it has yielded long ago [N m]."""
    clamp: np.ndarray
    """(3,) position of the base [m]."""
    axes: np.ndarray
    """(3, 3) directors of the base as rows."""
    tracking: Tracking
    """Cameras."""
    centres: np.ndarray
    """(n, 3) centres of the key planes at the last sample [mm]."""
    frames: np.ndarray
    """(n, 3, 3) their axes in columns."""


def new_state(plant: Plant, body: Body) -> State:
    """An arm as cast, before gravity acts; `body` becomes part of the state."""
    n = len(plant.nodes)
    return State(
        time=np.zeros(1),
        body=body,
        bending=new_memory(2, body.kappa.shape[1]),
        stretch=new_memory(1, body.sigma.shape[1]),
        air=vented(plant.volumes),
        slipped=np.zeros(3),
        hung=np.zeros(2),
        clamp=np.zeros(3),
        axes=plant.base.copy(),
        tracking=new_tracking(plant.cameras),
        centres=np.zeros((n, 3)),
        frames=np.zeros((n, 3, 3)),
    )


SETTLE_S = 1.5
"""Time for which a vented arm swings out, twice, before it counts as at rest [s]."""
SWINGS_OUT = 20.0
"""Damping while an arm swings out [1/s]."""


def rest(plant: Plant, state: State, seconds: float) -> None:
    """Vent the chambers, let the arm hang at rest under its weight for a time [s], and forget.

    The arm swings out without friction and viscosity, as if it had been left alone for long; only
    the end of the time is stepped.
    """
    air = state.air
    for pressures in (air.target, air.line, air.chamber):
        pressures[:] = 0.0
    air.volume[:] = plant.volumes
    state.slipped[:] = 0.0
    plain = plant.wall._replace(friction=np.zeros(2), viscous=np.zeros(3), creep=0.0)
    calm = plant._replace(wall=plain, keep=math.exp(-SWINGS_OUT * plant.step), bracket=np.zeros(2))
    for memory in (state.bending, state.stretch):
        memory.peak[:] = 0.0
    state.time[0] += seconds - 2 * SETTLE_S
    before = state.clamp.copy()
    place_base(calm, state.time[0], state.slipped, state.clamp, state.axes)
    state.body.position[:] += (state.clamp - before)[:, None]
    state.body.velocity[:] = 0.0
    state.body.omega[:] = 0.0
    for _ in range(2):
        advance(calm, state, round(SETTLE_S / plant.step), False)
        forget(state.bending)
        forget(state.stretch)
    base_couple(plant, state.body, state.hung)
    chamber_volumes(plant, state, air.volume)


@compiled
def warmed(time: float) -> float:
    """Temperature of the room [degrees Celsius] at a time [s]: a hyperbolic approach to warmer."""
    return ROOM_C + 7.0 * time / (time + 600.0)


@compiled
def place_base(plant: Plant, time: float, slipped: np.ndarray, clamp: np.ndarray, axes: np.ndarray):
    """Position (3,) [m] and directors (3, 3) of the base at a time [s], into `clamp` and `axes`.

    The bracket creeps with the logarithm of time, a knock takes a fifth of a second, and a breath
    is a raised cosine that is shorter in than out.
    """
    turn = np.zeros(3)
    slow = math.log(1.0 + max(time, 0.0) / 40.0) / math.log(1.0 + 600.0 / 40.0)
    knocked = after(time, plant.knock[3])
    for d in range(3):
        turn[d] = plant.drift[d] * slow + plant.knock[d] * knocked
    turn[0] += slipped[0]
    turn[1] += slipped[1]
    share = 0.0
    if plant.breath[3] > 0.0:
        phase = ((time - plant.breath[4]) / plant.breath[3]) % 1.0
        phase = phase / 0.8 if phase < 0.4 else 0.5 + (phase - 0.4) / 1.2
        share = 0.5 - 0.5 * math.cos(2.0 * math.pi * phase)
    for d in range(3):
        clamp[d] = share * plant.breath[d]
    for i in range(3):
        rotate(turn, plant.base[i], axes[i])


@compiled
def after(time: float, moment: float) -> float:
    """Share of a sudden event that has happened at a time [s]: it takes a fifth of a second."""
    return min(max((time - moment) / 0.2, 0.0), 1.0)


@compiled
def rotate(turn: np.ndarray, vector: np.ndarray, out: np.ndarray) -> None:
    """Rotate a vector (3,) by a rotation vector (3,) [rad] (Rodrigues), into `out`."""
    angle = math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)
    if angle == 0.0:
        for d in range(3):
            out[d] = vector[d]
        return
    x, y, z = turn[0] / angle, turn[1] / angle, turn[2] / angle
    c, s = math.cos(angle), math.sin(angle)
    a, b, e = vector[0], vector[1], vector[2]
    along = (1.0 - c) * (x * a + y * b + z * e)
    out[0] = c * a + s * (y * e - z * b) + along * x
    out[1] = c * b + s * (z * a - x * e) + along * y
    out[2] = c * e + s * (x * b - y * a) + along * z


@compiled
def base_couple(plant: Plant, body: Body, couple: np.ndarray) -> None:
    """Couple (2,) [N m] of the first inner node about the base's x and y, into `couple`."""
    couple[:] = 0.0
    for d in range(2):
        for axis in range(2):
            couple[axis] += plant.base[d, axis] * body.internal_couple[d, 0]


@compiled(inner=True)
def slip_bracket(plant: Plant, state: State) -> None:
    """Let the base's bracket stick, or slip under the couple of the first inner node.

    It sticks until the couple leaves the elastic one by what dry friction holds, then slips until
    nearly all is released (Coulomb friction with a lower kinetic than static value).
    """
    compliance, held = plant.bracket[0], plant.bracket[1]
    couple = np.empty(2)
    base_couple(plant, state.body, couple)
    lack_x = couple[0] - state.hung[0] - state.slipped[0] / compliance
    lack_y = couple[1] - state.hung[1] - state.slipped[1] / compliance
    lack = math.sqrt(lack_x**2 + lack_y**2)
    if lack > held:
        state.slipped[2] = 1.0
    elif lack < 0.1 * held:
        state.slipped[2] = 0.0
    if state.slipped[2] == 1.0:
        share = plant.step / 0.03
        state.slipped[0] += share * compliance * lack_x
        state.slipped[1] += share * compliance * lack_y


@compiled(inner=True)
def load_wall(plant: Plant, state: State, loaded: np.ndarray, added: np.ndarray) -> None:
    """Set the rod's rest strains from chambers and wall; (2, N - 1) and (1, N) scratch.

    `loaded` and `added` hold the wall's stresses of bending and extension.
    """
    body, air = state.body, state.air
    m, places, elements = plant.areas.shape[0], body.kappa.shape[1], body.sigma.shape[1]
    axial_scale = plant.curvature * plant.radius
    bending = np.empty((2, places))
    stretch = np.empty((1, elements))
    for k in range(places):
        for d in range(2):
            bending[d, k] = (body.kappa[d, k] - plant.bow[d, k]) / plant.curvature
    for k in range(elements):
        stretch[0, k] = body.sigma[2, k] / axial_scale
    warm = warmed(state.time[0]) - ROOM_C
    lost = -math.expm1(-plant.warmth * warm)
    strain_wall(plant.wall, lost, plant.step, bending, state.bending, loaded)
    strain_wall(plant.wall, lost, plant.step, stretch, state.stretch, added)
    if plant.tear[0] > 0.0:
        # A crack across the wall: there it carries less of its couple from one moment on.
        torn = int(plant.tear[1])
        for d in range(2):
            share = plant.tear[0] * after(state.time[0], plant.tear[2])
            loaded[d, torn] -= share * bending[d, torn]
    for k in range(elements):
        body.rest_sigma[2, k] = -axial_scale * added[0, k]
    for k in range(places):
        body.rest_kappa[0, k] = plant.bow[0, k] - plant.curvature * loaded[0, k]
        body.rest_kappa[1, k] = plant.bow[1, k] - plant.curvature * loaded[1, k]
        body.rest_kappa[2, k] = 0.0
    for i in range(m):
        pressure = air.chamber[i]
        if plant.unfold[i] > 0.0:
            # Folds open one after the other around the unfolding pressure: a softened ramp.
            width = 0.3 * plant.unfold[i]
            open_ = math.log1p(math.exp(min((abs(pressure) - plant.unfold[i]) / width, 500.0)))
            shut = math.log1p(math.exp(-plant.unfold[i] / width))
            pressure = math.copysign(width * (open_ - shut), pressure)
        share = 1.0 + plant.growth * air.chamber[i] / plant.high
        for j in range(m):
            if plant.stolen[i, j] != 0.0:
                bulged = -math.expm1(-max(air.chamber[j], 0.0) / (BULGE * plant.high))
                share -= plant.stolen[i, j] * bulged
        push = pressure * plant.areas[i] * share
        x, y = plant.levers[i, 0], plant.levers[i, 1]
        for k in range(elements):
            along = 1.0 + plant.taper[i] * ((k + 0.5) / elements - 0.5)
            body.rest_sigma[2, k] += push * along / plant.axial[k]
        for k in range(places):
            along = 1.0 + plant.taper[i] * ((k + 1.0) / elements - 0.5)
            body.rest_kappa[0, k] += y * push * along / plant.bend[k]
            body.rest_kappa[1, k] -= x * push * along / plant.bend[k]
            if plant.fibre != 0.0:
                # Stretching turns the fibres towards the axis: less twist per push.
                turned = plant.fibre / (1.0 + body.sigma[2, k]) ** 2
                lever = math.sqrt(x * x + y * y)
                body.rest_kappa[2, k] += push * lever * turned / plant.twist_stiffness[k]


@compiled
def chamber_volumes(plant: Plant, state: State, volumes: np.ndarray) -> None:
    """Volumes (m,) [m^3] of the chambers before they bulge, stretched with the arm's wall."""
    body = state.body
    axial, first, second = 0.0, 0.0, 0.0
    for k in range(body.sigma.shape[1]):
        axial += body.sigma[2, k] / body.sigma.shape[1]
    for k in range(body.kappa.shape[1]):
        first += body.kappa[0, k] / body.kappa.shape[1]
        second += body.kappa[1, k] / body.kappa.shape[1]
    for i in range(volumes.shape[0]):
        strain = axial + plant.levers[i, 1] * first - plant.levers[i, 0] * second
        volumes[i] = plant.volumes[i] * (1.0 + strain)


@compiled
def advance(plant: Plant, state: State, steps: int, on: bool) -> None:
    """Advance by so many time steps; on: whether the regulators work (else all is vented)."""
    body = state.body
    loaded = np.zeros((2, body.kappa.shape[1]))
    added = np.zeros((1, body.sigma.shape[1]))
    volumes = np.empty(plant.areas.shape[0])
    before, speed = np.empty(3), np.empty(3)
    for _ in range(steps):
        if on:
            chamber_volumes(plant, state, volumes)
            fill_chambers(plant.gas, state.air, plant.step, volumes)
        if plant.bracket[0] > 0.0:
            slip_bracket(plant, state)
        for d in range(3):
            before[d] = state.clamp[d]
        place_base(plant, state.time[0], state.slipped, state.clamp, state.axes)
        for d in range(3):
            speed[d] = (state.clamp[d] - before[d]) / plant.step
        move_half(body, plant.step, state.clamp, state.axes)
        measure_strains(body)
        load_wall(plant, state, loaded, added)
        accelerate(
            body, plant.step, plant.keep, plant.gravity, plant.plane, plant.plane_stiffness, speed
        )
        move_half(body, plant.step, state.clamp, state.axes)
        state.time[0] += plant.step


@compiled
def see(plant: Plant, state: State, tape: np.ndarray, seen: np.ndarray, clean: np.ndarray) -> float:
    """Take a camera frame; centres (n, 3) [mm] with noise and without into `seen` and `clean`.

    tape: standard normals. Returns the temperature of the room [degrees Celsius].
    """
    tracking = state.tracking
    sections(state.body, plant.nodes, state.centres, state.frames)
    if plant.slip[0] != 0.0:
        moved_on = plant.slip[0] * after(state.time[0], plant.slip[2])
        loose = int(plant.slip[1])
        for d in range(3):
            state.centres[loose, d] += moved_on * state.frames[loose, d, 2]
    mark(plant.cameras, tracking, state.centres, state.frames, 1e-3 * state.air.chamber)
    moved = np.empty(3)
    for p in range(tracking.clean.shape[0]):
        for k in range(tracking.clean.shape[1]):
            rotate(plant.misalignment[:3], tracking.clean[p, k], moved)
            for d in range(3):
                tracking.clean[p, k, d] = moved[d] + plant.misalignment[3 + d]
    look(plant.cameras, tracking, tape, 0)
    for p in range(seen.shape[0]):
        circle_centre(tracking.seen[p], seen[p])
        circle_centre(tracking.clean[p], clean[p])
    return math.floor(10.0 * warmed(state.time[0]) + 0.5) / 10.0


def pause_cameras(plant: Plant, state: State, seconds: float, tape: np.ndarray) -> None:
    """Let the cameras' slow noise go on for a time [s] without frames; tape: standard normals."""
    wander(plant.cameras, state.tracking, seconds, tape, 0)
