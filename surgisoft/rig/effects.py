"""Hidden effects in compiled code: deviations of the virtual rig from the nominal arm.

Every amplitude is zero where the effect is off, and then nothing of it is computed. The forms are
those of the mechanics literature where there is one, and none is the formula of an arm model.
"""

import math
from typing import NamedTuple

import numpy as np

from surgisoft.compiled import compiled

CREEP_TIMES = np.array([0.6, 2.4, 9.6, 38.4, 153.6])
"""Retardation times [s] whose sum approximates a power law over three decades (Findley 1976)."""
SLIP_S = 150.0
"""Time constant with which a loose marker slips while the arm is bent [s]."""
REFERENCE_KPA = 54.0
"""Pressure by which amplitudes are scaled [kPa]."""
BREATH_POWER = 6
"""Power of the cosine of a breath: long at rest, short at full breath (Lujan et al. 1999,
cos^2n with n = 3)."""


class Effects(NamedTuple):
    """Amplitudes of all hidden effects; m chambers, J wall fibres."""

    friction: float
    """Added share of the fibres' friction [-]."""
    line: np.ndarray
    """(2,) conductance of a long thin tube, filling and emptying [mm^3/s]; 0: short tube."""
    crosstalk: float
    """Share of the channel before that a sensor channel shows [-]."""
    leak: np.ndarray
    """(m,) pressure lost over the tube at 54 kPa [kPa]."""
    dead_zone: float
    """Pressure below which a chamber does not push [kPa]."""
    zero: np.ndarray
    """(m,) shift of each pressure sensor's zero [kPa]."""
    gain: np.ndarray
    """(m,) relative change of a chamber's push at low pressure [-]."""
    coupling: np.ndarray
    """(m, m) pressure at 54 kPa in chamber j that chamber i loses [kPa]."""
    creep: float
    """Added push after about a minute at 54 kPa [kPa]."""
    rate: float
    """Viscous force of a wall fibre at 0.1 strain a second [N]."""
    stick: np.ndarray
    """(2,) stiffness [N] and break-away strain [-] of lines that stick and slip."""
    softening: float
    """Share of a line's stiffness that a larger load before has broken [-]."""
    stiffening: float
    """Force of a line at strain 0.2 beyond the plain wall's [N]."""
    twist: float
    """Torque of one chamber at 54 kPa [N mm]."""
    drift: np.ndarray
    """(3,) rotation of the base after ten minutes, arm base frame [rad]."""
    knock: np.ndarray
    """(4,) rotation of the base [rad], arm base frame, and moment from which on it has it [s]."""
    warmth: float
    """Stiffness lost per kelvin [-]; nonzero: the room is not air-conditioned."""
    misalignment: np.ndarray
    """(7,) rotation [rad] and shift [mm] of the cameras' frame, and its radial warp [1/mm]."""
    slip: np.ndarray
    """(4,) key plane, marker, largest slip along the arm [mm], bending that moves it [rad]."""
    breath: np.ndarray
    """(5,) largest shift of the mount, arm base frame [mm], period and delay of the breath [s]."""
    jam: np.ndarray
    """(K, 2) begin and end of each spell in which a valve stays shut [s], in order."""
    jammed: int
    """Chamber behind that valve."""
    broken: np.ndarray
    """(m,) pressure at 54 kPa that a chamber with a snapped fibre loses [kPa]."""
    break_s: float
    """Moment at which the fibre snaps [s]."""
    modulus: float
    """Young's modulus of the wall times a line's share of its area [N]."""


class History(NamedTuple):
    """Memory of the effects; updated in place."""

    creep: np.ndarray
    """(m, 5) retarded loads [-]."""
    followed: np.ndarray
    """(J,) strain that each line's fluid has let the wall take [-]."""
    stuck: np.ndarray
    """(J,) strain at which each line stuck last [-]."""
    peak: np.ndarray
    """(J,) largest energy density that each line has seen, over the modulus [-]."""
    slipped: np.ndarray
    """(2,) how far the marker has slipped [mm], time of the last frame [s]; no reset undoes it."""


def no_effects(chambers: int, line_stiffness: float) -> Effects:
    """Amplitudes with every effect off; line_stiffness: modulus times area of one fibre [N]."""
    return Effects(
        friction=0.0,
        line=np.zeros(2),
        crosstalk=0.0,
        leak=np.zeros(chambers),
        dead_zone=0.0,
        zero=np.zeros(chambers),
        gain=np.zeros(chambers),
        coupling=np.zeros((chambers, chambers)),
        creep=0.0,
        rate=0.0,
        stick=np.zeros(2),
        softening=0.0,
        stiffening=0.0,
        twist=0.0,
        drift=np.zeros(3),
        knock=np.zeros(4),
        warmth=0.0,
        misalignment=np.zeros(7),
        slip=np.zeros(4),
        breath=np.zeros(5),
        jam=np.zeros((0, 2)),
        jammed=0,
        broken=np.zeros(chambers),
        break_s=0.0,
        modulus=line_stiffness,
    )


def new_history(chambers: int, lines: int) -> History:
    """History of effects on an arm that never moved."""
    return History(
        creep=np.zeros((chambers, len(CREEP_TIMES))),
        followed=np.zeros(lines),
        stuck=np.zeros(lines),
        peak=np.zeros(lines),
        slipped=np.zeros(2),
    )


def forget(history: History) -> None:
    """Reset the history that venting and resting undo."""
    history.creep[:] = 0.0
    history.followed[:] = 0.0
    history.stuck[:] = 0.0
    history.peak[:] = 0.0


@compiled(inner=True)
def shown_pressure(effects: Effects, gas: np.ndarray, column: int, i: int) -> float:
    """Pressure [kPa] at sensor i; a multiplexer that settles slowly mixes in the channel before."""
    pressure = gas[i, column]
    if effects.crosstalk == 0.0:
        return pressure
    return pressure + effects.crosstalk * (gas[i - 1, column] - pressure)


@compiled(inner=True)
def effective_pressures(
    effects: Effects,
    time: float,
    step: float,
    chamber: np.ndarray,
    history: History,
    effective: np.ndarray,
) -> None:
    """Pressures (m,) [kPa] that push on the wall, from those in the chambers (m,) [kPa].

    time, step: [s]. Leak: a crack that opens above 5 kPa, so that the flow along the tube takes
    pressure away. Zero: a sensor that was overloaded, whose span is another, too. Gain: wears off
    towards high pressure. Coupling: a neighbour's wall bulges with
    its pressure squared. Broken fibre: from one moment on the chamber bulges outwards with its
    pressure squared (without fibres that is where the pressure goes: Polygerinos et al. 2015). Dead
    zone: folds that open smoothly. Creep: a ladder of retarded loads, nonlinear in the load.
    """
    m = chamber.shape[0]
    for i in range(m):
        p = chamber[i]
        push = p
        if effects.leak[i] != 0.0 and p > 5.0:
            push -= effects.leak[i] * ((p - 5.0) / (REFERENCE_KPA - 5.0)) ** 1.5
        if effects.zero[i] != 0.0:
            push += effects.zero[i] * (1.0 - 0.3 * p / REFERENCE_KPA)
        if effects.gain[i] != 0.0:
            push += effects.gain[i] * p * (1.0 - 0.4 * p / REFERENCE_KPA)
        for j in range(m):
            if effects.coupling[i, j] != 0.0:
                push -= effects.coupling[i, j] * chamber[j] * abs(chamber[j]) / REFERENCE_KPA**2
        if effects.broken[i] != 0.0 and time >= effects.break_s:
            push -= effects.broken[i] * p * abs(p) / REFERENCE_KPA**2
        if effects.dead_zone != 0.0:
            push -= effects.dead_zone * math.tanh(push / effects.dead_zone)
        if effects.creep != 0.0:
            load = p / REFERENCE_KPA * (abs(p) / REFERENCE_KPA) ** 0.3
            for k in range(CREEP_TIMES.shape[0]):
                keep = math.exp(-step / CREEP_TIMES[k])
                history.creep[i, k] = load + keep * (history.creep[i, k] - load)
                # Findley: t^n with n = 0.2; each term's share grows like its time to that power.
                share = 0.25 * (CREEP_TIMES[k] / 38.4) ** 0.2
                push += effects.creep * share * history.creep[i, k]
        effective[i] = push


@compiled
def follow_lines(effects: Effects, step: float, strains: np.ndarray, history: History) -> None:
    """Let the lines' memories follow their strains (J,) over one period [s].

    Rate: the wall parallel to a shear-thinning fluid, E d = c sqrt(y' / 0.1), with d = e - y what
    the strain y lacks of the strain e that the wall would take by itself. While e stands still,
    d(t) = d / (1 + 0.1 (E / c)^2 |d| t).
    """
    for j in range(strains.shape[0]):
        strain = strains[j]
        if effects.rate != 0.0:
            lack = strain - history.followed[j]
            quick = 0.1 * (effects.modulus / effects.rate) ** 2 * step
            history.followed[j] = strain - lack / (1.0 + quick * abs(lack))
        if effects.stick[0] != 0.0 and abs(strain - history.stuck[j]) > effects.stick[1]:
            history.stuck[j] = strain
        if effects.softening != 0.0:
            history.peak[j] = max(history.peak[j], 0.5 * strain * strain)


@compiled
def add_effect_forces(
    effects: Effects, strains: np.ndarray, history: History, forces: np.ndarray
) -> None:
    """Add the effects' tension of each line [N] to forces (J,); strains: (J,) [-].

    Rate: what the fluid of `follow_lines` carries. Stick-slip: springs that let go all at once.
    Softening: Ogden & Roxburgh (1999), the share erf((W_max - W) / (m + b W_max)) of the
    damage. Stiffening: exponential, as Fung's (1967) tissue.
    """
    for j in range(strains.shape[0]):
        strain = strains[j]
        forces[j] *= 1.0 + effects.friction
        if effects.rate != 0.0:
            forces[j] += effects.modulus * (strain - history.followed[j])
        if effects.stick[0] != 0.0:
            forces[j] += effects.stick[0] * (strain - history.stuck[j])
        if effects.softening != 0.0:
            peak = history.peak[j]
            broken = math.erf((peak - 0.5 * strain * strain) / (2e-3 + 0.2 * peak))
            forces[j] -= effects.softening * broken * effects.modulus * strain
        if effects.stiffening != 0.0:
            size = abs(strain) / 0.2
            curve = (math.expm1(2.0 * size) - 2.0 * size) / (math.expm1(2.0) - 2.0)
            forces[j] += math.copysign(effects.stiffening * curve, strain)


@compiled(inner=True)
def add_twist(effects: Effects, effective: np.ndarray, active: np.ndarray) -> None:
    """Torque of fibres wound unequally, growing faster than pressure, into active (K, 4) [N mm]."""
    torque = 0.0
    for i in range(effective.shape[0]):
        p = effective[i] / REFERENCE_KPA
        torque += effects.twist * p * (1.0 + 0.5 * p) / 1.5
    for k in range(active.shape[0]):
        active[k, 3] += torque


@compiled
def room_temperature(time: float) -> float:
    """Temperature [degrees Celsius] at a time [s]: the bench warms up, the heating cycles."""
    warm = 5.0 * (1.0 - math.exp(-time / 500.0))
    return 22.0 + warm + 1.0 * math.sin(2.0 * math.pi * time / 1300.0)


@compiled(inner=True)
def drifted_base(effects: Effects, time: float, base: np.ndarray, out: np.ndarray) -> None:
    """Base quaternion (4,) at a time [s]: the bracket yields like a saturating power law, and is
    knocked aside at one moment."""
    for i in range(4):
        out[i] = base[i]
    grown = (time / 600.0) ** 0.6
    share = 1.3 * grown / (1.0 + 0.3 * grown)
    aside = 1.0 if time >= effects.knock[3] else 0.0
    rx = effects.drift[0] * share + effects.knock[0] * aside
    ry = effects.drift[1] * share + effects.knock[1] * aside
    rz = effects.drift[2] * share + effects.knock[2] * aside
    angle = math.sqrt(rx * rx + ry * ry + rz * rz)
    if angle == 0.0:
        return
    s = math.sin(0.5 * angle) / angle
    w, x, y, z = math.cos(0.5 * angle), s * rx, s * ry, s * rz
    a, b, c, d = base[0], base[1], base[2], base[3]
    out[0] = w * a - x * b - y * c - z * d
    out[1] = w * b + x * a + y * d - z * c
    out[2] = w * c - x * d + y * a + z * b
    out[3] = w * d + x * c - y * b + z * a


@compiled(inner=True)
def valve_shut(effects: Effects, time: float, i: int):
    """Whether the valve of chamber i is stuck shut at a time [s]."""
    if i != effects.jammed:
        return False
    k = np.searchsorted(effects.jam[:, 0], time, side="right") - 1
    return k >= 0 and time < effects.jam[k, 1]


@compiled(inner=True)
def carry_mount(effects: Effects, time: float, points: np.ndarray) -> None:
    """Shift points (n, k, 3) [mm] in place with a mount that lies on a breathing body. time: [s].

    The waveform of organ motion of Lujan et al. (1999); zero is the end of exhaling.
    """
    if effects.breath[3] == 0.0:
        return
    phase = math.pi * (time - effects.breath[4]) / effects.breath[3]
    share = math.cos(phase) ** BREATH_POWER
    for p in range(points.shape[0]):
        for k in range(points.shape[1]):
            for d in range(3):
                points[p, k, d] += share * effects.breath[d]


@compiled(inner=True)
def slip_marker(
    effects: Effects, time: float, frames: np.ndarray, history: History, markers: np.ndarray
) -> None:
    """Shift the loose marker of (n, k, 3) [mm] along the arm: it creeps on while the arm is bent.

    time: [s]; frames: (n, 3, 3) rotations of the key planes; what the arm does between two frames
    counts as what it does at the second.
    """
    limit = effects.slip[2]
    if limit == 0.0:
        return
    plane = int(effects.slip[0])
    if frames[plane, 2, 2] < math.cos(effects.slip[3]):
        share = -math.expm1((history.slipped[1] - time) / SLIP_S)
        history.slipped[0] += share * (limit - history.slipped[0])
    history.slipped[1] = time
    marker = markers[plane, int(effects.slip[1])]
    for d in range(3):
        marker[d] += history.slipped[0] * frames[plane, d, 2]


@compiled(inner=True)
def misalign(effects: Effects, points: np.ndarray) -> None:
    """Points (n, k, 3) [mm] as cameras with a wrong calibration place them; in place.

    Rodrigues' rotation, a shift, and a radial warp about the arm's middle.
    """
    v = effects.misalignment
    angle = math.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)
    if angle == 0.0 and v[3] == 0.0 and v[4] == 0.0 and v[5] == 0.0 and v[6] == 0.0:
        return
    axis = np.zeros(3)
    if angle > 0.0:
        for d in range(3):
            axis[d] = v[d] / angle
    c, s = math.cos(angle), math.sin(angle)
    for p in range(points.shape[0]):
        for k in range(points.shape[1]):
            x, y, z = points[p, k, 0], points[p, k, 1], points[p, k, 2]
            along = (1.0 - c) * (axis[0] * x + axis[1] * y + axis[2] * z)
            rx = c * x + s * (axis[1] * z - axis[2] * y) + along * axis[0]
            ry = c * y + s * (axis[2] * x - axis[0] * z) + along * axis[1]
            rz = c * z + s * (axis[0] * y - axis[1] * x) + along * axis[2]
            far = v[6] * math.sqrt(rx * rx + ry * ry + (rz - 35.0) ** 2)
            points[p, k, 0] = rx * (1.0 + far) + v[3]
            points[p, k, 1] = ry * (1.0 + far) + v[4]
            points[p, k, 2] = 35.0 + (rz - 35.0) * (1.0 + far) + v[5]
