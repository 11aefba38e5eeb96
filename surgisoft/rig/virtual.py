"""The virtual rig: a bench in numbers that stands in where there is none.

It is the truth that arm models are judged on, so it shares nothing with them: no code, no formulas.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from surgisoft.errors import InputError
from surgisoft.measurement.protocols import Protocol
from surgisoft.measurement.recordings import ArmInfo, Recording
from surgisoft.rig import bench
from surgisoft.rig.arm import (
    STANDARD_GRAVITY,
    ArmDesign,
    Specimen,
    fabricate,
    no_equilibrium,
    plain_loads,
)
from surgisoft.rig.collect import (
    average,
    check_fits,
    describe,
    runs_of,
    samples_in,
)
from surgisoft.rig.effects import no_effects
from surgisoft.rig.hidden import Bench, switch_on
from surgisoft.rig.interface import Sample
from surgisoft.rig.motion_capture import CameraDesign, build_cameras
from surgisoft.rig.pneumatics import PumpDesign, build_pumps

MOUNT = (0.42, 0.0, math.sqrt(1.0 - 0.42**2))
"""Default unit vector of weight in the arm base frame: hanging, tilted by 25 degrees."""
REST_S = 30.0
"""Time that a reset takes: venting and resting [s]."""
HEAVIEST_G = 20.0
"""Largest payload that is taken for meant [g]; a hanging arm carries it, an upright one buckles."""
CHUNK = 64
"""Points or frames times ten that are computed between two reports of progress."""


@dataclass(frozen=True, eq=False)
class Truth:
    """What no bench can measure, sample by sample beside a recording; for studies only."""

    centres_mm: np.ndarray
    """(T, n, 3) centres of the key planes, arm base frame [mm]."""
    noise_free_mm: np.ndarray
    """(T, n, 3) what the cameras would measure without noise, arm base frame [mm]."""
    pressures_kPa: np.ndarray
    """(T, m) pressures in the chambers [kPa]."""


class Part(NamedTuple):
    """Consecutive samples of a recording."""

    t_s: np.ndarray
    """(P,) times since the bench was switched on [s]."""
    commanded: np.ndarray
    """(P, m) [kPa]."""
    frames: bench.Frames
    """P averaged frames."""


class VirtualRig:
    """A simulated bench with one arm; satisfies `Rig`.

    seed: which specimen was cast. gravity: (3,) direction of weight in the base frame; roll_deg:
    turns the base about its axis. payload_g: known mass at the tip. noise: factor on all sensor
    and camera noise. take: another number gives other noise on the same arm. hidden: names and
    strengths of hidden effects, see hidden.py.
    """

    unit = "kPa"

    def __init__(
        self,
        seed: int = 0,
        *,
        gravity=MOUNT,
        roll_deg: float = 0.0,
        payload_g: float = 0.0,
        noise: float = 1.0,
        take: int = 0,
        hidden: Iterable[tuple[str, float]] = (),
        design: ArmDesign | None = None,
        pumps: PumpDesign | None = None,
        cameras: CameraDesign | None = None,
    ) -> None:
        design = design or ArmDesign()
        check_options(seed, gravity, payload_g, noise)
        specimen = _cast(design, seed)
        self.chambers, self.key_planes = design.chambers, design.key_planes
        self.limits = np.tile([design.low_kPa, design.high_kPa], (design.chambers, 1))
        self.arm = ArmInfo(design.length_mm, design.diameter_mm)
        self.gravity = _rolled(gravity, roll_deg)
        self.payload_g = float(payload_g) if payload_g else None
        loads = plain_loads(self.gravity)._replace(payload=payload_g * 1e-3 * STANDARD_GRAVITY)
        rod = specimen.rod
        stiffness = rod.wall.modulus * rod.wall.area / design.friction_lines
        secret = switch_on(Bench(no_effects(design.chambers, stiffness), loads, rod), hidden, seed)
        volumes = specimen.rod.wall.areas * design.soft_mm
        self._plant = bench.Plant(
            specimen=specimen,
            loads=secret.loads,
            pumps=build_pumps(pumps or PumpDesign(), volumes, noise, seed),
            cameras=build_cameras(
                cameras or CameraDesign(),
                design.diameter_mm,
                design.chambers,
                design.key_planes,
                design.high_kPa,
                noise,
                seed,
            ),
            effects=secret.effects,
        )
        self._thermometer = secret.effects.warmth != 0.0
        self.period_s = self._plant.cameras.period
        self._rng = np.random.default_rng([seed, take, 0x5EED])
        self._state = bench.new_state(self._plant)
        self._steps = bench.steps_in(self._plant, self.period_s)

    @property
    def time_s(self) -> float:
        """Time since the bench was switched on [s]."""
        return float(self._state.steps[0] * self._plant.pumps.step)

    def reset(self) -> None:
        """Vent the arm and let it rest until it has forgotten: the start of a run."""
        bench.rest(self._plant, self._state)
        self._state.steps[0] += bench.steps_in(self._plant, REST_S)

    def command(self, pressures: np.ndarray) -> None:
        """Tell the controllers the pressures (m,) [kPa gauge] to reach from now on."""
        pressures = np.asarray(pressures, np.float64)
        if pressures.shape != (self.chambers,) or not np.isfinite(pressures).all():
            raise InputError(
                f"command has shape {pressures.shape} with values {pressures.tolist()}, "
                f"expected {self.chambers} finite pressures in kPa"
            )
        low, high = self.limits.T
        if (pressures < low - 1e-9).any() or (pressures > high + 1e-9).any():
            raise InputError(
                f"command {pressures.tolist()} kPa leaves the rig's limits "
                f"{low.min():g} to {high.max():g} kPa"
            )
        self._state.target[:] = pressures

    def wait(self, seconds: float) -> None:
        """Let time [s] pass without reading."""
        self._play(self._state.target[None].copy(), bench.steps_in(self._plant, seconds), 0)

    def read(self) -> Sample:
        """Let one period pass and read sensors and cameras."""
        return self.read_beside_truth()[0]

    def read_beside_truth(self) -> tuple[Sample, Truth]:
        """`read`, and what no bench can measure at that instant (T = 1); for studies only."""
        frame = self._play(self._state.target[None].copy(), 0, 1)
        sample = Sample(
            t_s=self.time_s,
            measured=frame.measured[0],
            commanded=self._state.target.copy(),
            key_points_mm=frame.points[0],
            temp_C=float(frame.temperature[0]) if self._thermometer else None,
        )
        return sample, Truth(frame.centres, frame.clean, frame.chamber)

    def record(
        self, protocol: Protocol, progress: Callable[[int, int], None] | None = None
    ) -> tuple[Recording, Truth]:
        """The recording that `collect` makes, sample by sample the same, at full speed.

        progress: called with the number of samples done and to do.
        """
        check_fits(self, protocol)
        report = progress or (lambda done, total: None)
        runs = [commands for _, commands in runs_of(protocol, self.period_s)]
        total, done = sum(map(len, runs)), 0
        parts: list[Part] = []
        for rows in runs:
            self.reset()
            size = CHUNK if protocol.kind == "settled" else 10 * CHUNK
            for first in range(0, len(rows), size):
                parts.append(self._part(protocol, rows[first : first + size]))
                done += len(parts[-1].t_s)
                report(done, total)
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
            frames.temperature if self._thermometer else None,
        )
        return recording, truth

    def _play(self, commands: np.ndarray, pause: int, count: int) -> bench.Frames:
        """Frames (P * count) of `count` samples after each command (P, m) and pause."""
        plant = self._plant
        need = bench.tape_of_pause(plant, pause) + count * bench.tape_of_sample(plant)
        tape = self._rng.standard_normal(len(commands) * need)
        frames = bench.new_frames(plant, len(commands) * count)
        found = bench.play(plant, self._state, commands, pause, self._steps, count, tape, frames)
        if not found:
            raise no_equilibrium()
        return frames

    def _part(self, protocol: Protocol, commands: np.ndarray) -> Part:
        """One recorded sample for each of the commands (P, m) [kPa]."""
        settled = protocol.kind == "settled"
        pause = bench.steps_in(self._plant, protocol.settle_s) if settled else 0
        count = samples_in(protocol.average_s, self.period_s) if settled else 1
        first = self._state.steps[0] + (pause + count * self._steps) * np.arange(len(commands))
        steps = first[:, None] + pause + self._steps * np.arange(1, count + 1)
        frames = self._play(commands, pause, count)
        shaped = (a.reshape(len(commands), count, *a.shape[1:]) for a in frames)
        mean = bench.Frames(*(average(a) for a in shaped))
        return Part(average(steps * self._plant.pumps.step), commands, mean)


@lru_cache(maxsize=64)
def _cast(design: ArmDesign, seed: int) -> Specimen:
    """The specimen of a seed, calibrated in the default mount; nothing changes it later."""
    return fabricate(design, seed, np.array(MOUNT))


def check_options(seed: int, gravity, payload_g: float, noise: float) -> None:
    """One line for an option that makes no sense."""
    direction = np.asarray(gravity, np.float64)
    if seed < 0:
        raise InputError(f"seed is {seed}, expected a whole number >= 0")
    if direction.shape != (3,) or not np.isfinite(direction).all() or not direction.any():
        raise InputError(f"gravity is {direction.tolist()}, expected a direction of three numbers")
    if not 0.0 <= payload_g <= HEAVIEST_G:
        raise InputError(f"payload is {payload_g} g, expected 0 to {HEAVIEST_G:g} g")
    if not (np.isfinite(noise) and noise >= 0.0):
        raise InputError(f"noise scale is {noise}, expected a number >= 0")


def _rolled(gravity, roll_deg: float) -> np.ndarray:
    """Direction of weight (3,) in the base frame after the base was turned about its z axis."""
    x, y, z = np.asarray(gravity, np.float64) / np.linalg.norm(gravity)
    c, s = math.cos(math.radians(roll_deg)), math.sin(math.radians(roll_deg))
    return np.array([c * x + s * y, -s * x + c * y, z])
