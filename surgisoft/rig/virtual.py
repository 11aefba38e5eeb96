"""The virtual rig: a simulation of the test bench with sensors and cameras.

It is the independent plant on which arm models are evaluated, so it shares no code with them. Some
of its formulas are theirs, where physics leaves one form (`docs/results/index.md` lists them).
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from surgisoft.errors import InputError
from surgisoft.measurement.protocols import Protocol
from surgisoft.measurement.recordings import ArmInfo, Recording
from surgisoft.measurement.recordings.log import average
from surgisoft.progress import Progress, silent
from surgisoft.rig import bench
from surgisoft.rig.arm import (
    STANDARD_GRAVITY,
    ArmDesign,
    Robot,
    fabricate,
    no_equilibrium,
    plain_loads,
)
from surgisoft.rig.collect import (
    check_fits,
    describe,
    runs_of,
    samples_in,
)
from surgisoft.rig.effects import no_effects
from surgisoft.rig.hidden import EVENT_WINDOW_S, Setup, switch_on
from surgisoft.rig.interface import Sample, Truth, check_simulated, checked_command
from surgisoft.rig.motion_capture import CameraDesign, build_cameras
from surgisoft.rig.pneumatics import PumpDesign, build_pumps

MOUNT = (0.42, 0.0, math.sqrt(1.0 - 0.42**2))
"""Default unit vector of weight in the arm base frame: hanging, tilted by 25 degrees."""
REST_S = 30.0
"""Duration of a reset: venting and resting [s]."""
HEAVIEST_G = 20.0
"""Largest payload that is accepted [g]; a hanging arm carries it, an upright one buckles."""
CHUNK = 64
"""Steady-state points between two reports of progress; ten times as many frames of motion."""


@dataclass(frozen=True)
class VirtualRigConfig:
    """Which robot is on the virtual rig, how it is mounted, and what the rig hides."""

    seed: int = 0
    """Seed of the robot: everything in which two fabricated arms differ."""
    gravity: tuple[float, float, float] = MOUNT
    """Direction of weight, arm base frame before the roll; any length but zero."""
    roll_deg: float = 0.0
    """Rotation of the base about its z axis [deg]."""
    payload_g: float = 0.0
    """Known mass at the tip [g]."""
    noise: float = 1.0
    """Factor on all sensor and camera noise."""
    take: int = 0
    """Number of the trial, which `--trial` of `collect` sets: another one has other noise on the
    same robot."""
    hidden: tuple[tuple[str, float], ...] = ()
    """Hidden effects: (name, amplitude), see hidden.py. An entry (name, amplitude, seconds) counts
    to `later`."""
    later: tuple[tuple[str, float, float], ...] = ()
    """Hidden effects that begin during a recording: (name, amplitude, time [s] after the end of the
    first reset), such as a payload that somebody hangs on."""
    event_window_s: tuple[float, float] = EVENT_WINDOW_S
    """Window of time since switching on in which hidden events that occur once fall [s]."""
    design: ArmDesign = field(default_factory=ArmDesign)
    """Design of the arm."""
    pumps: PumpDesign = field(default_factory=PumpDesign)
    """Design of the pneumatics."""
    cameras: CameraDesign = field(default_factory=CameraDesign)
    """Design of the motion capture."""

    def __post_init__(self):
        given = [tuple(effect) for effect in self.hidden]
        late = [tuple(effect) for effect in self.later] + [e for e in given if len(e) == 3]
        object.__setattr__(self, "hidden", tuple(e for e in given if len(e) == 2))
        object.__setattr__(self, "later", tuple(sorted(late, key=lambda effect: effect[2])))
        check_simulated(self.seed, self.gravity, self.payload_g, HEAVIEST_G, self.noise)
        for name, _, begins_s in self.later:
            if not 0.0 <= begins_s < math.inf:
                raise InputError(
                    f"hidden effect '{name}' begins at {begins_s} s, expected a time of 0 s or "
                    "more after the first reset"
                )
        periods = 1.0 / (self.cameras.rate_Hz * self.pumps.step_s) if self.cameras.rate_Hz else 0.0
        if not (round(periods) >= 1 and abs(periods - round(periods)) < 1e-6):
            raise InputError(
                f"cameras take {self.cameras.rate_Hz:g} frames per second, expected a period that "
                f"is a multiple of the pumps' {self.pumps.step_s:g} s, such as 10, 20, 25 or 50"
            )
        first, last = self.event_window_s
        if not 0.0 <= first <= last < math.inf:
            raise InputError(
                f"event_window_s is {self.event_window_s}, expected two times [s], the first "
                "not after the second"
            )


class Part(NamedTuple):
    """Consecutive samples of a recording."""

    t_s: np.ndarray
    """(P,) times since the rig was switched on [s]."""
    commanded: np.ndarray
    """(P, m) [kPa]."""
    frames: bench.Frames
    """P averaged frames."""


class VirtualRig:
    """A simulated rig with one arm; satisfies `SimulatedRig`."""

    unit = "kPa"

    def __init__(self, config: VirtualRigConfig | int = 0, **fields) -> None:
        """Build a rig from a configuration or a robot's seed; fields: of `VirtualRigConfig`."""
        plain = config if isinstance(config, VirtualRigConfig) else VirtualRigConfig(config)
        config = self.config = replace(plain, **fields)
        design, seed, noise = config.design, config.seed, config.noise
        robot = _fabricated(design, seed)
        self.chambers, self.key_planes = design.chambers, design.key_planes
        self.limits = np.tile([design.low_kPa, design.high_kPa], (design.chambers, 1))
        self.arm = ArmInfo(design.length_mm, design.diameter_mm)
        self.gravity = _rolled(config.gravity, config.roll_deg)
        self.payload_g = float(config.payload_g) if config.payload_g else None
        weight_N = config.payload_g * 1e-3 * STANDARD_GRAVITY
        loads = plain_loads(self.gravity)._replace(payload=weight_N)
        rod = robot.rod
        stiffness = rod.wall.modulus * rod.wall.area / design.friction_lines

        def hiding(hidden: Sequence[tuple[str, float]]) -> Setup:
            """The setup with hidden effects (name, amplitude)."""
            effects = no_effects(design.chambers, stiffness)
            return switch_on(Setup(effects, loads, rod, config.event_window_s), hidden, seed)

        setup = hiding(config.hidden)
        volumes = rod.wall.areas * design.soft_mm
        self._plant = bench.Plant(
            robot=robot,
            loads=setup.loads,
            pumps=build_pumps(config.pumps, volumes, noise, seed),
            cameras=build_cameras(
                config.cameras,
                design.diameter_mm,
                design.chambers,
                design.key_planes,
                design.high_kPa,
                noise,
                seed,
            ),
            effects=setup.effects,
        )
        self._changes: list[tuple[int, bench.Plant]] = []
        present = list(config.hidden)
        for name, amplitude, begins_s in config.later:
            present.append((name, amplitude))
            setup = hiding(present)
            plant = self._plant._replace(loads=setup.loads, effects=setup.effects)
            self._changes.append((bench.steps_in(self._plant, begins_s), plant))
        self._begun: int | None = None
        self.period_s = self._plant.cameras.period
        self._rng = np.random.default_rng([seed, config.take, 0x5EED])
        self._state = bench.new_state(self._plant)
        self._steps = bench.steps_in(self._plant, self.period_s)

    @property
    def time_s(self) -> float:
        """Time since the rig was switched on [s]."""
        return float(self._state.steps[0] * self._plant.pumps.step)

    @property
    def plane_frames(self) -> np.ndarray:
        """(n, 3, 3) true axes of the key planes at the last sample, as columns, arm base frame."""
        return self._state.shape.frames.copy()

    def reset(self) -> None:
        """Vent the arm and let it rest until it has no memory of before: the start of a run."""
        bench.rest(self._plant, self._state)
        self._state.steps[0] += bench.steps_in(self._plant, REST_S)
        if self._begun is None:
            self._begun = int(self._state.steps[0])

    def command(self, pressures: np.ndarray) -> None:
        """Set the pressures (m,) [kPa gauge] that the controllers reach for from now on."""
        self._state.target[:] = checked_command(pressures, self.limits, self.unit)

    def wait(self, seconds: float) -> None:
        """Let time [s] pass without reading."""
        self._run(self._state.target[None].copy(), bench.steps_in(self._plant, seconds), 0)

    def read(self) -> Sample:
        """Let one period pass and read sensors and cameras."""
        return self.read_beside_truth()[0]

    def read_beside_truth(self) -> tuple[Sample, Truth]:
        """Do what `read` does, and return the true state of that instant (T = 1) with it."""
        frame = self._run(self._state.target[None].copy(), 0, 1)
        sample = Sample(
            t_s=self.time_s,
            measured=frame.measured[0],
            commanded=self._state.target.copy(),
            key_points_mm=frame.points[0],
            temp_C=float(frame.temperature[0]),
        )
        return sample, Truth(frame.centres, frame.clean, frame.chamber)

    def record(self, protocol: Protocol, progress: Progress = silent) -> tuple[Recording, Truth]:
        """Record a protocol in compiled code, sample by sample equal to `collect`.

        progress: called with the number of samples done and to do.
        """
        check_fits(self, protocol)
        runs = [commands for _, commands in runs_of(protocol, self.period_s)]
        total, done = sum(map(len, runs)), 0
        parts: list[Part] = []
        for rows in runs:
            self.reset()
            size = CHUNK if protocol.kind == "settled" else 10 * CHUNK
            for first in range(0, len(rows), size):
                parts.append(self._part(protocol, rows[first : first + size]))
                done += len(parts[-1].t_s)
                progress(done, total)
        t_s, commanded = (np.concatenate([part[k] for part in parts]) for k in range(2))
        columns = zip(*(part.frames for part in parts), strict=True)
        frames = bench.Frames(*(np.concatenate(column) for column in columns))
        truth = Truth(frames.centres, frames.clean, frames.chamber)
        error = (frames.points - frames.clean)[np.isfinite(frames.points)]
        noise_mm = float(np.sqrt(np.mean(error**2))) if error.size else 0.0
        recording = describe(
            self,
            protocol,
            t_s - t_s[0],
            frames.measured,
            frames.points,
            commanded,
            noise_mm,
            frames.temperature,
        )
        return recording, truth

    def _run(self, commands: np.ndarray, pause: int, count: int) -> bench.Frames:
        """Frames (P * count): `count` samples after each command (P, m) and a pause."""
        frames = bench.new_frames(self._plant, len(commands) * count)
        filled = 0
        for some, rest, samples in self._stretches(commands, pause, count):
            plant = self._plant
            need = bench.tape_of_pause(plant, rest) + samples * bench.tape_of_sample(plant)
            tape = self._rng.standard_normal(len(some) * need)
            room = bench.Frames(*(a[filled : filled + len(some) * samples] for a in frames))
            filled += len(some) * samples
            if not bench.run_commands(
                plant, self._state, some, rest, self._steps, samples, tape, room
            ):
                raise no_equilibrium()
        return frames

    def _stretches(
        self, commands: np.ndarray, pause: int, count: int
    ) -> Iterator[tuple[np.ndarray, int, int]]:
        """Commands (P, m), pause and count of `_run` in parts during which no effect begins.

        A later hidden effect begins with the first pause or sample that starts at or after its
        time, however the samples are asked for; then this changes the plant.
        """
        each = pause + count * self._steps
        while len(commands):
            now = int(self._state.steps[0]) - (self._begun or 0)
            while self._changes and self._changes[0][0] <= now:
                self._plant = self._changes.pop(0)[1]
            if not self._changes:
                yield commands, pause, count
                return
            whole = (self._changes[0][0] - now) // each
            if whole:
                yield commands[:whole], pause, count
            elif pause and count:
                yield from self._stretches(commands[:1], pause, 0)
                yield from self._stretches(commands[:1], 0, count)
            elif count > 1:
                for _ in range(count):
                    yield from self._stretches(commands[:1], 0, 1)
            else:
                yield commands[:1], pause, count
            commands = commands[max(whole, 1) :]

    def _part(self, protocol: Protocol, commands: np.ndarray) -> Part:
        """One recorded sample for each of the commands (P, m) [kPa]."""
        settled = protocol.kind == "settled"
        pause = bench.steps_in(self._plant, protocol.settle_s) if settled else 0
        count = samples_in(protocol.average_s, self.period_s) if settled else 1
        first = self._state.steps[0] + (pause + count * self._steps) * np.arange(len(commands))
        steps = first[:, None] + pause + self._steps * np.arange(1, count + 1)
        frames = self._run(commands, pause, count)
        shaped = (a.reshape(len(commands), count, *a.shape[1:]) for a in frames)
        mean = bench.Frames(*(average(a) for a in shaped))
        return Part(average(steps * self._plant.pumps.step), commands, mean)


@lru_cache(maxsize=64)
def _fabricated(design: ArmDesign, seed: int) -> Robot:
    """The robot of a seed, calibrated in the default mount; nothing changes it later."""
    return fabricate(design, seed, np.array(MOUNT))


def _rolled(gravity, roll_deg: float) -> np.ndarray:
    """Direction of weight (3,) in the base frame after the base was turned about its z axis."""
    x, y, z = np.asarray(gravity, np.float64) / np.linalg.norm(gravity)
    c, s = math.cos(math.radians(roll_deg)), math.sin(math.radians(roll_deg))
    return np.array([c * x + s * y, -s * x + c * y, z])
