"""An arm in MuJoCo: its model, and how it moves.

Links are rigid bodies joined by a slide joint along the arm and a ball joint, both with MuJoCo's
springs and dampers; joints are in the middle of each part of length L / N. A chamber is a spatial
tendon through sites off the axis, from link to link, and an actuator that pushes with pressure
times area: couples and levers follow from the tendon's way. The pressure behind the sensor is the
actuator's activation: its rate is that of MuJoCo's muscles (Millard et al. 2013), other for filling
than for venting. A regulator is a linear system of second order. The base is a mocap body.
SI units; z along the arm.
"""

import math

import mujoco
import numpy as np
from scipy.signal import cont2discrete, lfilter

from benchmarks.generators import ROOM_C, Moved, rotation, since
from benchmarks.mujoco_arm.robot import LINKS, Plant

STEP_S = 0.0025
"""Time step [s]."""
REGULATOR = (35.0, 0.8)
"""Frequency [rad/s] and damping [-] of a regulator."""
DRY = 'solreffriction="0.011 1" solimpfriction="0.9999 0.9999"'
"""Nearly rigid dry friction: by default MuJoCo's slides slowly under any couple."""
ENTRAINED_S = 0.005
"""Inertia about a joint beside that of its links, of hoses and air, over its damping [s]."""
SETTLED_S = 6.0
"""Time in which an arm without memory comes to rest [s]."""
SLIDING_M_S = 5e-4
"""Speed of a hose below which it is held by static friction [m/s]."""


def room(time: float) -> float:
    """Temperature above the nominal one of a room that is heated from the start [K]: a heater of
    constant power and a window that is opened at times."""
    late = max(time, 0.0)
    return 9.0 * -math.expm1(-late / 240.0) - 2.0 * (math.sin(2.0 * math.pi * late / 170.0) > 0.6)


def xml(plant: Plant, step: float = STEP_S) -> str:
    """MuJoCo's model of an arm; step: time step [s]."""
    part, creep = plant.length / LINKS, plant.creep[0] > 0.0
    m = len(plant.areas)
    chambers = [
        (i, *(plant.offset[i] * f(plant.angles[i]) for f in (np.cos, np.sin))) for i in range(m)
    ]
    leaning = [
        (i, *(plant.offset[i] * f(plant.angles[i] + plant.fibre) for f in (np.cos, np.sin)))
        for i in range(m)
    ]

    def sites(node: int, height: float) -> str:
        text = [f'<site name="u{node}_{i}" pos="{x} {y} {height}"/>' for i, x, y in chambers]
        if plant.fibre:
            text += [f'<site name="l{node}_{i}" pos="{x} {y} {height}"/>' for i, x, y in leaning]
        return "".join(text) + f'<site name="n{node}" pos="0 0 {height}"/>'

    bodies, closed = sites(0, 0.0), ""
    if plant.play > 0.0:
        loose = plant.bend.mean() * plant.viscous_s
        bodies += (
            f'<body><inertial pos="0 0 0" mass="{0.02 * plant.mass}" diaginertia="'
            f'{" ".join(3 * [str(1e-3 * plant.mass * plant.radius**2)])}"/>'
            f'<joint name="play" type="ball" damping="{loose}" range="0 {plant.play}" '
            f'armature="{0.1 * plant.mass * plant.length**2}" solimplimit="0.999 0.9999"/>'
        )
        closed = "</body>"
    for i in range(LINKS):
        share = 0.5 if i == LINKS - 1 else 1.0
        mass, long = share * plant.mass / LINKS, share * part
        across = mass * (3.0 * plant.radius**2 + long**2) / 12.0
        inertia = f"{across} {across} {0.5 * mass * plant.radius**2}"
        height = 0.5 * part if i == 0 else part
        joints = (
            f'<joint name="s{i}" type="slide" axis="0 0 1" stiffness="{plant.axial[i]}" '
            f'damping="{plant.axial[i] * plant.viscous_s}"/>'
            f'<joint name="b{i}" type="ball" stiffness="{plant.bend[i]}" '
            f'damping="{plant.bend[i] * plant.viscous_s}" frictionloss="{plant.friction[i]}" '
            f'armature="{plant.bend[i] * plant.viscous_s * ENTRAINED_S}" {DRY}/>'
        )
        if creep:
            stiffness = plant.bend[i] / plant.creep[0]
            small = " ".join(3 * [str(0.1 * across)])
            bodies += (
                f'<body pos="0 0 {height}"><inertial pos="0 0 0" mass="{1e-2 * mass}" '
                f'diaginertia="{small}"/>{joints}'
            )
            joints = (
                f'<joint name="c{i}" type="ball" stiffness="{stiffness}" '
                f'damping="{stiffness * plant.creep[1 + i]}"/>'
            )
            height, closed = 0.0, closed + "</body>"
        geom = (
            f'<geom type="capsule" fromto="0 0 0 0 0 {long}" size="{plant.radius}" mass="0" '
            'contype="1" conaffinity="0"/>'
            if plant.ball[3] > 0.0
            else ""
        )
        bodies += (
            f'<body name="link{i}" pos="0 0 {height}"><inertial pos="0 0 {0.5 * long}" '
            f'mass="{mass}" diaginertia="{inertia}"/>{joints}{geom}{sites(i + 1, 0.5 * part)}'
        )
        closed += "</body>"
    if plant.payload[0] > 0.0:
        x, y = (plant.radius * f(plant.payload[1]) for f in (math.cos, math.sin))
        bodies += (
            f'<body pos="{x} {y} {0.5 * part}"><inertial pos="0 0 0" mass="{plant.payload[0]}" '
            'diaginertia="1e-8 1e-8 1e-8"/></body>'
        )
    tendons, actuators, ends, world = "", "", "", ""
    for i in range(m):
        first, last = int(plant.first[i]), int(plant.last[i])
        gain = plant.areas[i] * plant.high
        rise, fall = plant.line_s[i]
        way = f'<general ctrllimited="false" dyntype="muscle" dynprm="{rise} {fall} 0" gainprm="'
        tendons += f'<spatial name="t{i}">{_way(plant, i, first, last)}</spatial>'
        actuators += f'{way}{gain}" tendon="t{i}"/>'
        if plant.loosened[1] > 0.0 and i == int(plant.loosened[0]):
            from_ = last - 2 * (last - first) // 3
            tendons += f'<spatial name="off">{_way(plant, i, from_, last)}</spatial>'
            ends = f'{way}0" tendon="off"/>'
    if plant.hose[1] > 0.0:
        x, y = (1.6 * plant.radius * f(plant.hose[0]) for f in (math.cos, math.sin))
        world += (
            f'<body name="hose" pos="{x} {y} 0"><inertial pos="0 0 0" mass="0.02" '
            'diaginertia="1e-6 1e-6 1e-6"/><joint name="hose" type="slide" axis="0 0 1" '
            f'damping="{0.02 * plant.hose[1]}" frictionloss="{plant.hose[2]}" {DRY}/>'
            '<site name="guide"/></body>'
        )
        tendons += (
            f'<spatial name="hose" stiffness="{plant.hose[1]}" damping="{0.02 * plant.hose[1]}">'
            f'<site site="guide"/><site site="n{LINKS}"/></spatial>'
        )
    if plant.cable[4] > 0.0:
        world += '<site name="anchor" pos="{} {} {}"/>'.format(*plant.cable[:3])
        tendons += (
            f'<spatial name="cable" stiffness="{plant.cable[4]}" springlength="0 {plant.cable[3]}" '
            f'damping="0"><site site="anchor"/><site site="n{LINKS}"/></spatial>'
        )
    if plant.ball[3] > 0.0:
        centre = "{} {} {}".format(*plant.ball[:3])
        world += (
            f'<geom type="sphere" size="{plant.ball[3]}" pos="{centre}" contype="0" '
            'conaffinity="1" friction="0.3" solref="0.04 1"/>'
        )
    fluid = 'density="1.2"' if plant.wind.any() else ""
    gravity = "{} {} {}".format(*plant.gravity)
    return (
        f'<mujoco><compiler angle="radian"/><option timestep="{step}" integrator="implicitfast" '
        f'gravity="{gravity}" {fluid}/><worldbody>{world}<body name="base" mocap="true">{bodies}'
        f"{closed}</body></worldbody><tendon>{tendons}</tendon>"
        f"<actuator>{actuators}{ends}</actuator></mujoco>"
    )


def _way(plant: Plant, chamber: int, first: int, last: int) -> str:
    """Sites of a chamber's tendon, from one node to another.

    Where its fibres lean, it goes over each joint at their angle, and back within the link.
    """
    text = f'<site site="u{first}_{chamber}"/>'
    for node in range(first + 1, last + 1):
        if plant.fibre:
            text += f'<site site="l{node}_{chamber}"/>'
        text += f'<site site="u{node}_{chamber}"/>' if not plant.fibre or node < last else ""
    return text


class Arm:
    """An arm in motion."""

    def __init__(self, plant: Plant, begin_s: float = 0.0, step: float = STEP_S) -> None:
        """An arm at rest.

        begin_s: time since it was switched on [s]; step: time step [s].
        """
        self.plant, self.step, self.time = plant, step, begin_s
        self.model = mujoco.MjModel.from_xml_string(xml(plant, step))
        self.data = mujoco.MjData(self.model)
        self._m = len(plant.areas)
        names = [f"b{i}" for i in range(LINKS)]
        ball = np.array([self.model.joint(name).id for name in names])
        self._ball, self._places = ball, self.model.jnt_qposadr[ball][:, None] + np.arange(4)
        # Polynomials of MuJoCo: of the absolute angle of a ball joint, and of its dofs' rates.
        self.model.jnt_stiffnesspoly[ball, 1] = (
            plant.bend * plant.stiffening / max(plant.reach, 1e-9) ** 2
        )
        if plant.thick > 0.0:
            dofs = self.model.jnt_dofadr[ball][:, None] + np.arange(3)
            self.model.dof_dampingpoly[dofs, 0] = (
                self.model.dof_damping[dofs] * plant.thick / plant.reach
            )
        self._stiffness = self.model.jnt_stiffness[ball].copy()
        self._friction = self.model.dof_frictionloss.copy()
        self._gain = self.model.actuator_gainprm[: self._m, 0].copy()
        self._sites = np.array([self.model.site(f"n{key}").id for key in plant.keys])
        self._held = np.array(
            [self.model.jnt_dofadr[self.model.joint(f"c{i}").id] for i in range(LINKS)]
            if plant.creep[0] > 0.0
            else [],
            dtype=int,
        )
        self._caught = False
        self._settled: np.ndarray | None = None
        self.rest(0.0)

    def rest(self, seconds: float) -> None:
        """Vent the arm and let it rest for a time [s] until it has no memory."""
        model, data, plant = self.model, self.data, self.plant
        self.time += seconds
        mujoco.mj_resetData(model, data)
        if self._settled is not None:
            data.qpos[:] = self._settled
        model.jnt_stiffness[self._ball] = self._stiffness
        model.dof_frictionloss[:] = 0.0
        if len(self._held):
            # What creeps has no strain at rest: it counts from there.
            held = self._held[:, None] + np.arange(3)
            damping = model.dof_damping[held]
            model.dof_damping[held] = 1e3 * damping
        self._surroundings()
        for _ in range(round(SETTLED_S / self.step)):
            mujoco.mj_step(model, data)
        data.qvel[:] = 0.0
        if len(self._held):
            model.dof_damping[held] = damping
            for i in range(LINKS):
                data.qpos[model.joint(f"c{i}").qposadr[0] + np.arange(4)] = [1.0, 0.0, 0.0, 0.0]
            mujoco.mj_forward(model, data)
            data.qfrc_applied[held] = data.qfrc_bias[held] - data.qfrc_passive[held]
        self._settled = data.qpos.copy()
        model.dof_frictionloss[:] = self._friction
        self._straight = data.qpos[self._places].copy()
        self._farthest = np.zeros(LINKS)
        if plant.hose[1] > 0.0:
            tendon = model.tendon("hose").id
            model.tendon_lengthspring[tendon] = data.ten_length[tendon]

    def _surroundings(self) -> None:
        """Pose of the base, temperature, wind, and what happens at a moment."""
        plant, model, data, time = self.plant, self.model, self.data, self.time
        if plant.drift.any():
            # A mount that creeps with the logarithm of time (Phillips 1905).
            turn = plant.drift * math.log1p(max(time, 0.0) / 30.0) / math.log1p(20.0)
            mujoco.mju_axisAngle2Quat(
                data.mocap_quat[0], turn / max(np.linalg.norm(turn), 1e-12), np.linalg.norm(turn)
            )
        if plant.breath[3] > 0.0:
            data.mocap_pos[0] = plant.breath[:3] * breathing(time, plant.breath[3], plant.breath[4])
        if plant.warmth:
            kelvin = ROOM_C + 273.15
            soft = ((kelvin + room(time)) / kelvin) ** -plant.warmth
            model.jnt_stiffness[self._ball] = self._stiffness * soft
        if plant.wind.any():
            blows = np.sum((plant.gusts[:, 0] <= time) & (time < plant.gusts[:, 1]))
            model.opt.wind[:] = min(blows, 1) * plant.wind
        if plant.loosened[1] > 0.0:
            lost = since(time, plant.loosened[1]) * self._gain[int(plant.loosened[0])]
            lost *= plant.loosened[2]
            model.actuator_gainprm[self._m, 0] = -lost
        if plant.cable[5] > 0.0:
            tendon = model.tendon("cable").id
            if time >= plant.cable[5] and not self._caught:
                model.tendon_lengthspring[tendon, 1] = data.ten_length[tendon]
                self._caught = True

    def _remember(self) -> None:
        """Lose stiffness by the largest bending so far (Kachanov 1958: damage of the area)."""
        now = self.data.qpos[self._places]
        turned = 2.0 * np.arccos(np.clip(np.abs(np.sum(now * self._straight, axis=1)), 0.0, 1.0))
        self._farthest = np.maximum(self._farthest, turned)
        worn = np.minimum(self._farthest / (2.0 * self.plant.reach), 1.0)
        self.model.jnt_stiffness[self._ball] = self._stiffness * (1.0 - self.plant.damage * worn)

    def push(self, air: np.ndarray) -> np.ndarray:
        """(m,) push of chambers at pressures (m,) over the limit, over that at the limit [-]."""
        plant, pushed = self.plant, air.copy()
        if plant.touch > 0.0:
            # Parts of a bladder touch at pressures that are distributed exponentially.
            touch = plant.touch / plant.high
            pushed = air + touch * np.expm1(-air / touch)
        if plant.bulge > 0.0:
            # The wall between neighbours bulges as a membrane (Hencky 1915): the cube root.
            ring = 3 if self._m == 6 else self._m
            parts = air.reshape(-1, ring)
            more = sum(np.cbrt(parts - np.roll(parts, k, axis=1)) for k in (1, -1))
            pushed = pushed * (1.0 + 0.5 * plant.bulge * more.ravel())
        return pushed

    def run(self, targets: np.ndarray, period: float) -> Moved:
        """Follow set points (T, m) [Pa], one a sample, and read after each period [s]."""
        plant, model, data = self.plant, self.model, self.data
        rows, m, steps = len(targets), self._m, round(period / self.step)
        sensed = regulated(np.repeat(targets, steps, axis=0) / plant.high, self.step)
        lines = np.clip(sensed, 0.0, 1.0)
        moments = self.time + self.step * np.arange(len(lines))
        if len(plant.leak):
            lifted = np.any(
                (plant.leak[:, 0] <= moments[:, None]) & (moments[:, None] < plant.leak[:, 1]),
                axis=1,
            )
            lines[lifted, int(plant.leaking[0])] /= 1.0 + plant.leaking[1]
        if plant.loosened[1] > 0.0:
            lines = np.column_stack([lines, lines[:, int(plant.loosened[0])]])
        shaped = plant.touch > 0.0 or plant.bulge > 0.0
        chambers, points = np.empty((rows, m)), np.empty((rows, len(plant.keys), 3))
        warm = np.full(rows, ROOM_C)
        hose = model.joint("hose").dofadr[0] if plant.hose[1] > 0.0 else -1
        turned = np.empty((3, 3))
        rotation(plant.misalignment[:3], turned)
        for row in range(rows):
            self._surroundings()
            if plant.damage > 0.0:
                self._remember()
            for k in range(row * steps, (row + 1) * steps):
                data.ctrl[:] = lines[k]
                if shaped:
                    air = data.act[:m]
                    model.actuator_gainprm[:m, 0] = (
                        self._gain * self.push(air) / np.maximum(air, 1e-6)
                    )
                if hose >= 0:
                    slides = abs(data.qvel[hose]) > SLIDING_M_S
                    model.dof_frictionloss[hose] = plant.hose[3 if slides else 2]
                mujoco.mj_step(model, data)
                self.time += self.step
            mujoco.mj_kinematics(model, data)
            chambers[row] = data.act[:m]
            points[row] = data.site_xpos[self._sites] @ turned.T + plant.misalignment[3:]
            if plant.warmth:
                warm[row] += room(self.time)
        return Moved(plant.high * sensed[steps - 1 :: steps], plant.high * chambers, points, warm)


def breathing(time: float, period: float, phase: float) -> float:
    """Depth of a breath at a time [s]: a quick breath in, and a slow one out (van der Pol 1926)."""
    late = 2.0 * math.pi * (time - phase) / period + 0.35 * math.sin(2.0 * math.pi * time / 29.0)
    return math.exp(1.2 * (math.sin(late + 0.5 * math.sin(late)) - 1.0))


def regulated(targets: np.ndarray, step: float) -> np.ndarray:
    """Pressures (T, m) that regulators reach from rest under set points (T, m), in steps [s]."""
    frequency, damping = REGULATOR
    over, under, _ = cont2discrete(
        ([frequency**2], [1.0, 2.0 * damping * frequency, frequency**2]), step
    )
    return lfilter(over.ravel(), under, targets, axis=0)
