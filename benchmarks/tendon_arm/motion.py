"""An arm that tendons bend, in MuJoCo: its model, and how it moves.

The backbone is a chain of rigid links on joints that bend about two axes, with MuJoCo's springs and
dampers, in the middle of each part of length L / N; each link is a thick disk. A tendon goes
through a hole in each disk: its segment in each gap between disks is one of MuJoCo's spatial
tendons, pulled by the tension there. A drum that a servomotor turns pulls the tendon, which is
elastic up to the base and not behind it, and cannot push. In every hole the tension falls by the
law of a belt on a drum (Euler 1775), with a way after which friction is full. SI units; z along the
arm.
"""

import math
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.signal import cont2discrete, lfilter

from benchmarks.generators import ROOM_C, Moved, rotation, since
from benchmarks.tendon_arm.robot import RETARDED, Plant
from surgisoft.compiled import compiled

STEP_S = 0.0025
"""Time step [s]."""
GAP = 0.2
"""Gap between two disks over the length of a part [-]."""
ENTRAINED_S = 0.004
"""Inertia about a joint beside that of its links, of tendons and sleeve, over its damping [s]."""
SETTLED_S = (6.0, 2.0)
"""Time in which an arm comes to rest, from straight and from where it rested before [s]."""
QUIET = 4.0
"""Factor on its damping while it does [-]."""
CREEP_POWER = 1.5
"""Power of the tension with which a tendon creeps [-]."""
DRIFT_S = 150.0
"""Time after which the base has drifted half of its way [s]."""


class Line(NamedTuple):
    """State of m tendons with M segments."""

    lagged: np.ndarray
    """(m,) pull of each drum behind its encoder [m]."""
    played: np.ndarray
    """(m,) the same behind its play [m]."""
    kinked: np.ndarray
    """(m,) pull that has passed a kink [m]."""
    lost: np.ndarray
    """(m,) pull that was lost for good, or until the motors are homed [m]."""
    strain: np.ndarray
    """(m, RETARDED) elongation by creep [m]."""
    force: np.ndarray
    """(m,) tension at the drum [N]."""
    rest: np.ndarray
    """(m,) the same at rest [N]."""
    sheared: np.ndarray
    """(M,) friction in the hole before each segment over the full one, -1 to 1 [-]."""
    beyond: np.ndarray
    """(M,) length of each tendon from that hole to its end [m]."""
    tension: np.ndarray
    """(M,) tension in each segment [N]."""
    straight: np.ndarray
    """(m,) length of each tendon on the straight arm [m]."""
    fast: np.ndarray
    """(m,) whether each motor is faster than it can follow [-]."""


def new_line(plant: Plant, straight: np.ndarray) -> Line:
    """Tendons of an arm at rest; straight: (m,) their lengths on the straight arm [m]."""
    m, segments = len(plant.offset), int(plant.ends.sum())
    zeros = [np.zeros(m) for _ in range(4)]
    return Line(
        *zeros,
        np.zeros((m, RETARDED)),
        np.zeros(m),
        np.zeros(m),
        *(np.zeros(segments) for _ in range(3)),
        straight,
        np.zeros(m),
    )


@compiled
def taut(stretch: float, toe: float) -> float:
    """Stretch [m] that pulls, of a tendon that sags up to a stretch `toe` [m], and never pushes."""
    if stretch <= 0.0:
        return 0.0
    return 0.5 * stretch**2 / toe if stretch < toe else stretch - 0.5 * toe


@compiled
def drum(plant: Plant, line: Line, i: int, encoder: float, before: float, step: float) -> float:
    """Pull of a drum [m] whose encoder reads a pull, and read another one a step before [m]."""
    pulled = encoder
    if plant.lag_s[i] > 0.0:
        behind = encoder - line.lagged[i]
        share = behind / (plant.lag_s[i] * plant.fastest)
        line.lagged[i] += step * behind / plant.lag_s[i] / math.sqrt(1.0 + share**2)
        pulled = line.lagged[i]
    if plant.backlash[i] > 0.0:
        half = 0.5 * plant.backlash[i]
        line.played[i] = min(max(line.played[i], pulled - half), pulled + half)
        pulled = line.played[i]
    if plant.steps[1] > 0.0:
        speed = (encoder - before) / step
        fast = abs(speed) > plant.steps[0]
        if fast and line.fast[i] == 0.0:
            line.lost[i] += plant.steps[1] * (1.0 if speed > 0.0 else -1.0)
        line.fast[i] = 1.0 if fast else 0.0
    pulled = plant.gains[i] * pulled - line.lost[i]
    if plant.kink[1] > 0.0 and i == int(plant.kink[0]):
        behind = pulled - line.kinked[i]
        if abs(behind) > plant.kink[1]:
            line.kinked[i] = pulled - math.copysign(plant.kink[2], behind)
        pulled = line.kinked[i]
    return pulled


@compiled
def tighten(
    plant: Plant,
    line: Line,
    encoders: np.ndarray,
    before: np.ndarray,
    warm: float,
    lengths: np.ndarray,
    joints: np.ndarray,
    step: float,
    moving: bool,
) -> None:
    """Tensions of all segments, into the state.

    encoders, before: (m,) pulls that the encoders read, and read a step before [m]; warm:
    temperature above the nominal one [K]; lengths: (M,) of the segments [m]; joints: (N, K)
    bending about two axes first [rad]; step: [s]; moving: whether tendons rub and creep.
    """
    m, at = len(encoders), 0
    ring = 3 if m == 6 else m
    full = plant.pull[0] * plant.high
    pulling = line.force.copy()
    for i in range(m):
        count = plant.ends[i]
        length = 0.0
        for j in range(count):
            length += lengths[at + j]
        pulled = drum(plant, line, i, encoders[i], before[i], step)
        stretch = plant.tight[i] + pulled - (line.straight[i] - length) - plant.warmth[i] * warm
        if plant.yields > 0.0:
            part = i - i % ring
            for k in (1, ring - 1):
                near = part + (i - part + k) % ring
                stretch -= plant.yields * (pulling[near] - line.rest[near]) / plant.pull[near]
        for k in range(RETARDED):
            stretch -= line.strain[i, k]
        force = plant.pull[i] * taut(stretch, plant.toe[i])
        line.force[i] = force
        if moving and plant.creep[0] > 0.0:
            now = (force / (0.5 * full)) ** CREEP_POWER
            now -= (line.rest[i] / (0.5 * full)) ** CREEP_POWER
            for k in range(RETARDED):
                towards = plant.creep[0] / RETARDED * now - line.strain[i, k]
                line.strain[i, k] += step * towards / plant.creep[1 + k]
        slips = moving and plant.screw[2] > 0.0 and i == int(plant.screw[0])
        if slips and force > plant.screw[1]:
            line.lost[i] += plant.screw[2]
        for j in range(count):
            place = at + j
            if moving:
                sheared = line.sheared[place] + (line.beyond[place] - length) / plant.slip
                line.sheared[place] = min(max(sheared, -1.0), 1.0)
            line.beyond[place] = length
            bent = plant.wrap + math.hypot(joints[j, 0], joints[j, 1])
            angle = plant.sheath if j == 0 else bent
            force *= math.exp(-plant.friction * angle * line.sheared[place])
            line.tension[place] = force
            length -= lengths[place]
        at += count


@compiled
def brace(plant: Plant, line: Line, joints: np.ndarray, applied: np.ndarray) -> None:
    """Couples (N, K) [N m] in the joints of a sleeve and of a backbone that untwists, into applied;
    joints: (N, K) their angles [rad]."""
    for j in range(len(joints)):
        if plant.sleeve[1] > 0.0:
            bent = math.hypot(joints[j, 0], joints[j, 1])
            if bent > plant.sleeve[0]:
                couple = -plant.sleeve[1] * plant.bend[j] * (1.0 - plant.sleeve[0] / bent)
                applied[j, 0], applied[j, 1] = couple * joints[j, 0], couple * joints[j, 1]
        if plant.coil != 0.0:
            at, pressed = 0, 0.0
            for i in range(len(plant.ends)):
                if j < plant.ends[i]:
                    pressed += line.tension[at + j]
                at += plant.ends[i]
            applied[j, 2] = plant.coil * pressed


def room(time: float) -> float:
    """Temperature above the nominal one of a room that is aired now and then [K]."""
    late = max(time, 0.0)
    return 8.0 * late / (late + 200.0) + 1.5 * math.sin(2.0 * math.pi * late / 110.0) ** 3


def hole(plant: Plant, tendon: int, turned: float = 0.0, share: float = 1.0) -> tuple[float, float]:
    """(x, y) [m] of a tendon's hole in a disk that is turned by an angle [rad]; share: of its
    distance from the axis."""
    angle, offset = plant.angles[tendon] + turned, share * plant.offset[tendon]
    return offset * math.cos(angle), offset * math.sin(angle)


def xml(plant: Plant, step: float = STEP_S) -> str:
    """MuJoCo's model of an arm; step: time step [s]."""
    n, m = len(plant.bend), len(plant.offset)
    part = plant.length / n
    post, lag = plant.post[6] > 0.0, plant.viscous_s * ENTRAINED_S

    def sites(node: int, height: float) -> str:
        """Middle of a disk, and each hole's lower and upper end."""
        text, half = f'<site name="n{node}" pos="0 0 {height}"/>', 0.5 * (1.0 - GAP) * part
        for i in range(m):
            x, y = hole(plant, i)
            for name, z in (("a", height - half), ("b", height + half)):
                text += f'<site name="{name}{node}_{i}" pos="{x} {y} {z}"/>'
        return text

    bodies, closed = sites(0, 0.0), ""
    for j in range(n):
        share = 0.5 if j == n - 1 else 1.0
        mass, long = share * plant.mass / n, share * part
        across = mass * (3.0 * plant.radius**2 + long**2) / 12.0
        about = 0.5 * mass * plant.radius**2
        height = 0.5 * part if j == 0 else part
        spring = f'stiffness="{plant.bend[j]}" damping="{plant.bend[j] * plant.viscous_s}" '
        joints = "".join(
            f'<joint name="{name}{j}" axis="{axis}" {spring} armature="{lag * plant.bend[j]}"/>'
            for name, axis in (("x", "1 0 0"), ("y", "0 1 0"))
        )
        if plant.coil:
            joints += (
                f'<joint name="z{j}" axis="0 0 1" stiffness="{plant.twist}" '
                f'damping="{plant.twist * plant.viscous_s}" armature="{lag * plant.twist}"/>'
            )
        skin = (
            f'<geom type="capsule" fromto="0 0 0 0 0 {long}" size="{plant.radius}" mass="0" '
            'contype="1" conaffinity="0"/>'
            if post
            else ""
        )
        bodies += (
            f'<body name="link{j}" pos="0 0 {height}"><inertial pos="0 0 {0.5 * long}" '
            f'mass="{mass}" diaginertia="{across} {across} {about}"/>{joints}{skin}'
            f"{sites(j + 1, 0.5 * part)}"
        )
        if plant.balanced[0] > 0.0 and j + 1 == int(plant.balanced[1]):
            even = 0.4 * plant.balanced[0] * plant.radius**2
            bodies += (
                f'<body pos="0 0 {0.5 * part}" gravcomp="1"><inertial pos="0 0 0" '
                f'mass="{plant.balanced[0]}" diaginertia="{even} {even} {even}"/></body>'
            )
        closed += "</body>"
    if plant.payload[0] > 0.0:
        x, y = (plant.radius * f(plant.payload[1]) for f in (math.cos, math.sin))
        bodies += (
            f'<body pos="{x} {y} {0.5 * part}"><inertial pos="0 0 0" mass="{plant.payload[0]}" '
            'diaginertia="1e-8 1e-8 1e-8"/></body>'
        )
    tendons, actuators, world = "", "", ""
    for i in range(m):
        for j in range(plant.ends[i]):
            ways = f'<site site="b{j}_{i}"/><site site="a{j + 1}_{i}"/>'
            tendons += f'<spatial name="t{i}_{j}">{ways}</spatial>'
            actuators += f'<motor tendon="t{i}_{j}" gear="-1"/>'
    if plant.grease[0] > 0.0:
        for i in range(m):
            ways = "".join(
                f'<site site="b{j}_{i}"/><site site="a{j + 1}_{i}"/>' for j in range(plant.ends[i])
            )
            tendons += f'<spatial name="w{i}" damping="{plant.grease[0]}">{ways}</spatial>'
    if plant.snag[4] > 0.0:
        world += '<site name="anchor" pos="{} {} {}"/>'.format(*plant.snag[:3])
        tendons += (
            f'<spatial name="snag" stiffness="{plant.snag[4]}" '
            f'springlength="0 {10.0 * plant.length}"><site site="anchor"/>'
            f'<site site="n{int(plant.snag[3])}"/></spatial>'
        )
    if post:
        ends = " ".join(str(value) for value in plant.post[:6])
        world += (
            f'<geom type="capsule" fromto="{ends}" size="{plant.post[6]}" contype="0" '
            'conaffinity="1" friction="0.3" solref="0.03 1"/>'
        )
    gravity = "{} {} {}".format(*plant.gravity)
    return (
        f'<mujoco><compiler angle="radian"/><option timestep="{step}" integrator="implicitfast" '
        f'gravity="{gravity}"/><worldbody>{world}<body name="base" mocap="true">{bodies}'
        f"{closed}</body></worldbody><tendon>{tendons}</tendon>"
        f"<actuator>{actuators}</actuator></mujoco>"
    )


class Arm:
    """An arm in motion."""

    def __init__(self, plant: Plant, begin_s: float = 0.0, step: float = STEP_S) -> None:
        """An arm at rest.

        begin_s: time since it was switched on [s]; step: time step [s].
        """
        self.plant, self.step, self.time = plant, step, begin_s
        self.model = mujoco.MjModel.from_xml_string(xml(plant, step))
        self.data = mujoco.MjData(self.model)
        self._n, self._m = len(plant.bend), len(plant.offset)
        self._segments = int(plant.ends.sum())
        mujoco.mj_forward(self.model, self.data)
        lengths = self.data.ten_length[: self._segments]
        first = np.cumsum(plant.ends) - plant.ends
        self.line = new_line(plant, np.add.reduceat(lengths, first))
        hinges = [[self.model.joint(f"{axis}{j}").id for axis in "xy"] for j in range(self._n)]
        self._hinges = np.array(hinges)
        self._sites = np.array([self.model.site(f"n{key}").id for key in plant.keys])
        self._links = np.array([self.model.body(f"link{key - 1}").id for key in plant.keys])
        self._damping = self.model.dof_damping.copy()
        self._worst = np.zeros(self._n)
        self._turned = self._held = 0.0
        self._settled: np.ndarray | None = None
        self.rest(0.0)

    @property
    def joints(self) -> np.ndarray:
        """(N, K) angles of the joints [rad], about two axes first."""
        return self.data.qpos.reshape(self._n, -1)

    def rest(self, seconds: float) -> None:
        """Home the motors and let the arm rest for a time [s] until it has no memory."""
        model, data, line = self.model, self.data, self.line
        self.time += seconds
        mujoco.mj_resetData(model, data)
        if self._settled is not None:
            data.qpos[:] = self._settled
        for part in (line.lagged, line.played, line.kinked, line.strain, line.sheared, line.fast):
            part[:] = 0.0
        if self.plant.steps[1] > 0.0:
            line.lost[:] = 0.0
        model.jnt_stiffness[self._hinges] = self.plant.bend[:, None]
        model.dof_damping[:] = QUIET * self._damping
        self._surroundings()
        none = np.zeros(self._m)
        for _ in range(round(SETTLED_S[self._settled is not None] / self.step)):
            self._step(none, none, moving=False)
            line.rest[:] = line.force
        data.qvel[:] = 0.0
        model.dof_damping[:] = self._damping
        self._settled = data.qpos.copy()
        self._straight = self.joints[:, :2].copy()
        self._worst[:] = 0.0

    def _step(self, encoders: np.ndarray, before: np.ndarray, moving: bool) -> None:
        """One time step with pulls (m,) at the encoders, and those a step before [m]."""
        plant, model, data = self.plant, self.model, self.data
        mujoco.mj_step1(model, data)
        joints, lengths = self.joints, data.ten_length[: self._segments]
        warm = room(self.time) if plant.warmth.any() else 0.0
        tighten(plant, self.line, encoders, before, warm, lengths, joints, self.step, moving)
        data.ctrl[:] = self.line.tension
        if plant.sleeve[1] > 0.0 or plant.coil:
            applied = np.zeros(joints.shape)
            brace(plant, self.line, joints, applied)
            data.qfrc_applied[:] = applied.ravel()
        if plant.grease[0] > 0.0:
            # A fluid that thins with the rate (Carreau 1972).
            rates = data.ten_velocity[self._segments :][: self._m]
            model.tendon_damping[self._segments :][: self._m] = (
                plant.grease[0] * (1.0 + (rates / plant.grease[1]) ** 2) ** -0.3
            )
        if moving and plant.draught[3] > 0.0:
            phase = 2.0 * math.pi * plant.draught[3] * self.time + plant.draught[4]
            phase += 0.6 * math.sin(2.0 * math.pi * self.time / 37.0)
            upper = self._n // 2
            data.xfrc_applied[2 + upper : 2 + self._n, :3] = (
                plant.draught[:3] * (0.5 + math.sin(phase)) / upper
            )
        mujoco.mj_step2(model, data)
        self.time += self.step if moving else 0.0

    def _surroundings(self) -> None:
        """Pose of the base, and what happens at a moment or to a disk."""
        plant, model, data, time = self.plant, self.model, self.data, self.time
        if plant.drift.any():
            late = max(time, 0.0)
            turn = plant.drift * late / (late + DRIFT_S)
            size = float(np.linalg.norm(turn))
            mujoco.mju_axisAngle2Quat(data.mocap_quat[0], turn / max(size, 1e-12), size)
        if plant.snag[4] > 0.0 and time >= plant.snag[5] and not self._held:
            tendon = model.tendon("snag").id
            self._held = model.tendon_lengthspring[tendon, 1] = data.ten_length[tendon]
        if plant.jumped[2] > 0.0:
            tendon, disk = int(plant.jumped[0]), int(plant.jumped[1])
            share = 1.0 - (1.0 - plant.jumped[3]) * since(time, plant.jumped[2])
            self._place_hole(disk, tendon, 0.0, share)
        if plant.loose[1] > 0.0:
            pulled = self.line.force
            side = pulled @ np.cos(plant.angles - plant.loose[3]) / max(pulled.sum(), 1e-9)
            if abs(side) > plant.loose[2]:
                self._turned = math.copysign(plant.loose[1], side)
            disk = int(plant.loose[0])
            for i in range(self._m):
                self._place_hole(disk, i, self._turned)

    def _place_hole(self, disk: int, tendon: int, turned: float, share: float = 1.0) -> None:
        """Move a tendon's hole of a disk; turned, share: as of `hole`."""
        for end in "ab":
            site = self.model.site(f"{end}{disk}_{tendon}").id
            self.model.site_pos[site, :2] = hole(self.plant, tendon, turned, share)

    def _wear(self) -> None:
        """Lose stiffness by the largest bending so far: the parts of a joint fail at bendings of
        Weibull's (1939) distribution."""
        bent = np.linalg.norm(self.joints[:, :2] - self._straight, axis=1)
        self._worst = np.maximum(self._worst, bent)
        failed = -np.expm1(-((self._worst / (0.6 * self.plant.reach)) ** 2))
        left = 1.0 - self.plant.worn * failed
        self.model.jnt_stiffness[self._hinges] = (self.plant.bend * left)[:, None]

    def run(self, targets: np.ndarray, period: float) -> Moved:
        """Follow set points (T, m) [m], one a sample, and read after each period [s]."""
        plant, model, data = self.plant, self.model, self.data
        rows, steps = len(targets), round(period / self.step)
        encoders = served(np.repeat(targets, steps, axis=0), self.step, plant.servo)
        pulls, points = np.empty((rows, self._m)), np.empty((rows, len(plant.keys), 3))
        warm = np.full(rows, ROOM_C)
        turned = np.empty((3, 3))
        rotation(plant.misalignment[:3], turned)
        before = np.zeros(self._m)
        for row in range(rows):
            self._surroundings()
            if plant.worn > 0.0:
                self._wear()
            for k in range(row * steps, (row + 1) * steps):
                self._step(encoders[k], before, moving=True)
                before = encoders[k]
            mujoco.mj_kinematics(model, data)
            pulls[row] = before
            seen = data.site_xpos[self._sites].copy()
            for key, moment, way in plant.slides:
                axis = data.xmat[self._links[int(key)]].reshape(3, 3)[:, 2]
                seen[int(key)] += way * since(self.time, moment) * axis
            points[row] = seen @ turned.T + plant.misalignment[3:]
            if plant.warmth.any():
                warm[row] += room(self.time)
        return Moved(encoders[steps - 1 :: steps], pulls, points, warm)


def served(targets: np.ndarray, step: float, servo: np.ndarray) -> np.ndarray:
    """Pulls (T, m) that servomotors reach from rest under set points (T, m), in steps [s].

    servo: frequency [rad/s] and damping [-] of their control.
    """
    frequency, damping = servo
    over, under, _ = cont2discrete(
        ([frequency**2], [1.0, 2.0 * damping * frequency, frequency**2]), step
    )
    return lfilter(over.ravel(), under, targets, axis=0)
