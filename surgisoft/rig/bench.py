"""Pumps, arm and cameras of the virtual rig, stepped together in compiled code.

Random numbers come from the caller as a tape of standard normals, so that stepping sample by sample
and running a whole schedule at once read the same numbers in the same order.
"""

import math
from typing import NamedTuple

import numpy as np

from surgisoft.compiled import compiled
from surgisoft.rig.arm import (
    Memory,
    Robot,
    add_line_forces,
    chamber_thrusts,
    friction_forces,
    new_memory,
    remember,
)
from surgisoft.rig.effects import (
    Effects,
    History,
    add_effect_forces,
    add_twist,
    carry_mount,
    drifted_base,
    effective_pressures,
    follow_lines,
    forget,
    misalign,
    new_history,
    room_temperature,
    shown_pressure,
    slip_marker,
    valve_shut,
)
from surgisoft.rig.motion_capture import (
    Cameras,
    Tracking,
    circle_centre,
    look,
    mark,
    new_tracking,
    normals_per_frame,
    normals_per_pause,
    wander,
)
from surgisoft.rig.pneumatics import (
    CHAMBER,
    PRESSURE,
    Pumps,
    drive_piston,
    fill,
    fill_through_line,
    fill_through_valve,
    read_sensor,
    vent,
    vented,
)
from surgisoft.rig.rod import Loads, Shape, balance, new_shape
from surgisoft.rig.wall import line_strain


class Plant(NamedTuple):
    """All parameters of a virtual rig; constant."""

    robot: Robot
    """Parameters of the arm."""
    loads: Loads
    """External loads on the arm."""
    pumps: Pumps
    """Parameters of the pneumatics."""
    cameras: Cameras
    """Parameters of the motion capture."""
    effects: Effects
    """Amplitudes of the hidden effects."""


class State(NamedTuple):
    """The state of a virtual rig; changed in place."""

    steps: np.ndarray
    """(1,) int64 controller periods since the rig was switched on."""
    gas: np.ndarray
    """(m, COLUMNS) state of the pumps, see `pneumatics`."""
    target: np.ndarray
    """(m,) commanded pressures [kPa]."""
    chamber: np.ndarray
    """(m,) pressures in the chambers [kPa gauge]."""
    effective: np.ndarray
    """(m,) pressures that push on the wall [kPa]."""
    memory: Memory
    """The wall's history."""
    history: History
    """The hidden effects' history."""
    base: np.ndarray
    """(4,) quaternion of the base section."""
    shape: Shape
    """The rod's last equilibrium."""
    tracking: Tracking
    """State of the cameras' tracking."""
    forces: np.ndarray
    """(J,) friction of the wall's fibres [N]."""
    thrusts: np.ndarray
    """(K, m) chamber thrusts along the arm [N]."""
    scratch: np.ndarray
    """(m,) work space."""


class Frames(NamedTuple):
    """Room for F frames."""

    measured: np.ndarray
    """(F, m) sensor readings [kPa]."""
    points: np.ndarray
    """(F, n, 3) circle fits of the seen markers [mm]."""
    clean: np.ndarray
    """(F, n, 3) circle fits without noise and losses [mm]."""
    centres: np.ndarray
    """(F, n, 3) the body's true centres [mm]."""
    chamber: np.ndarray
    """(F, m) true chamber pressures [kPa]."""
    temperature: np.ndarray
    """(F,) readings of the thermometer, in steps of 0.1 degrees Celsius."""


def new_state(plant: Plant) -> State:
    """A vented arm at rest on a rig that was just switched on."""
    rod = plant.robot.rod
    m, lines = len(rod.wall.areas), len(plant.robot.friction.force)
    return State(
        steps=np.zeros(1, np.int64),
        gas=vented(plant.pumps),
        target=np.zeros(m),
        chamber=np.zeros(m),
        effective=np.zeros(m),
        memory=new_memory(lines),
        history=new_history(m, lines),
        base=rod.base.copy(),
        shape=new_shape(rod),
        tracking=new_tracking(plant.cameras),
        forces=np.zeros(lines),
        thrusts=np.zeros((len(rod.stiffness), m)),
        scratch=np.zeros(m),
    )


def new_frames(plant: Plant, count: int) -> Frames:
    """Room for `count` frames."""
    m, n = len(plant.pumps.tube), len(plant.cameras.at)
    return Frames(
        measured=np.empty((count, m)),
        points=np.empty((count, n, 3)),
        clean=np.empty((count, n, 3)),
        centres=np.empty((count, n, 3)),
        chamber=np.empty((count, m)),
        temperature=np.empty(count),
    )


def steps_in(plant: Plant, seconds: float) -> int:
    """Controller periods in a time [s]."""
    return round(seconds / plant.pumps.step)


def tape_of_pause(plant: Plant, steps: int) -> int:
    """Number of standard normals that a pause of so many controller periods consumes."""
    if steps == 0:
        return 0
    return steps * len(plant.pumps.tube) + normals_per_pause(plant.cameras)


def tape_of_sample(plant: Plant) -> int:
    """Number of standard normals that one sample consumes."""
    m = len(plant.pumps.tube)
    return (steps_in(plant, plant.cameras.period) + 1) * m + normals_per_frame(plant.cameras)


def rest(plant: Plant, state: State) -> None:
    """Vent the arm and reset its memory, so that it has no history."""
    vent(plant.pumps, state.gas)
    forget(state.history)
    for memory in (state.target, state.chamber, state.effective, *state.memory[:3]):
        memory[:] = 0
    state.shape.unknown[:] = 0.0
    state.shape.status[:] = 0.0


@compiled(inner=True)
def advance(plant: Plant, state: State, steps: int, tape: np.ndarray, at: int) -> int:
    """Advance pumps and wall by `steps` controller periods.

    Returns the next index of the tape of standard normals, or -1 on failure.
    """
    pumps, effects = plant.pumps, plant.effects
    wall = plant.robot.rod.wall
    for _ in range(steps):
        time = state.steps[0] * pumps.step
        for i in range(state.gas.shape[0]):
            row = state.gas[i]
            shown = shown_pressure(effects, state.gas, PRESSURE, i)
            reading = read_sensor(pumps, shown, tape[at])
            at += 1
            drive_piston(pumps, row, state.target[i], reading)
            stretch = line_strain(state.memory.free, wall.chambers[i, 0], wall.chambers[i, 1])
            shut = effects.jam.shape[0] > 0 and valve_shut(effects, time, i)
            if effects.line[0] > 0.0:
                way = 0.0 if shut else 1.0
                fill_through_line(
                    pumps, row, i, stretch, way * effects.line[0], way * effects.line[1]
                )
            elif effects.jam.shape[0] > 0:
                fill_through_valve(pumps, row, i, stretch, shut)
            else:
                fill(pumps, row, i, stretch)
            state.chamber[i] = row[CHAMBER]
        effective_pressures(
            effects, time, pumps.step, state.chamber, state.history, state.effective
        )
        if not remember(plant.robot, state.effective, state.scratch, state.memory):
            return -1
        follow_lines(effects, pumps.step, state.memory.last, state.history)
        state.steps[0] += 1
    return at


@compiled(inner=True)
def take_shape(plant: Plant, state: State) -> bool:
    """Solve the arm's equilibrium under the present pressures and memory; False on failure."""
    robot, effects, active = plant.robot, plant.effects, state.shape.active
    friction_forces(robot.friction, state.memory, state.forces)
    add_effect_forces(effects, state.memory.last, state.history, state.forces)
    active[:] = 0.0
    add_line_forces(robot.friction, state.forces, active)
    add_twist(effects, state.effective, active)
    chamber_thrusts(robot.rod, state.effective, state.thrusts)
    time = state.steps[0] * plant.pumps.step
    softness = 1.0 - effects.warmth * (room_temperature(time) - 22.0)
    drifted_base(effects, time, robot.rod.base, state.base)
    return balance(robot.rod, plant.loads, softness, state.thrusts, state.base, state.shape)


@compiled(inner=True)
def look_at(
    plant: Plant, state: State, tape: np.ndarray, at: int, frames: Frames, index: int
) -> int:
    """Write the readings of sensors and cameras into frames[index]; returns the next tape index."""
    effects, shape, tracking = plant.effects, state.shape, state.tracking
    time = state.steps[0] * plant.pumps.step
    for i in range(state.gas.shape[0]):
        shown = shown_pressure(effects, state.gas, PRESSURE, i)
        frames.measured[index, i] = read_sensor(plant.pumps, shown, tape[at])
        at += 1
    mark(plant.cameras, tracking, shape.centres, shape.frames, state.chamber)
    slip_marker(effects, time, shape.frames, state.history, tracking.clean)
    carry_mount(effects, time, tracking.clean)
    misalign(effects, tracking.clean)
    at = look(plant.cameras, tracking, tape, at)
    for p in range(shape.centres.shape[0]):
        circle_centre(tracking.seen[p], frames.points[index, p])
        circle_centre(tracking.clean[p], frames.clean[index, p])
    for p in range(shape.centres.shape[0]):
        for d in range(3):
            frames.centres[index, p, d] = shape.centres[p, d]
    carry_mount(effects, time, frames.centres[index : index + 1])
    for i in range(len(state.chamber)):
        frames.chamber[index, i] = state.chamber[i]
    frames.temperature[index] = math.floor(10.0 * room_temperature(time) + 0.5) / 10.0
    return at


@compiled
def run_commands(
    plant: Plant,
    state: State,
    commands: np.ndarray,
    pause: int,
    steps: int,
    count: int,
    tape: np.ndarray,
    frames: Frames,
) -> bool:
    """After each row of commands (P, m) [kPa] a pause, then `count` samples; False on failure.

    pause: controller periods without samples (0: none); steps: controller periods from sample to
    sample; tape: standard normals (tape_of_pause + count * tape_of_sample for each row); frames:
    room for P * count frames.
    """
    at = np.int64(0)
    for point in range(commands.shape[0]):
        for i in range(len(state.target)):
            state.target[i] = commands[point, i]
        for k in range(-1 if pause > 0 else 0, count):
            at = advance(plant, state, pause if k < 0 else steps, tape, at)
            if at < 0:
                return False
            if k < 0:
                at = wander(plant.cameras, state.tracking, pause * plant.pumps.step, tape, at)
            elif not take_shape(plant, state):
                return False
            else:
                at = look_at(plant, state, tape, at, frames, point * count + k)
    return True
