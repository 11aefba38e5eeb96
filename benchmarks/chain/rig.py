"""The chain on its bench: records a protocol with cameras, and knows the truth beside it."""

from collections.abc import Sequence

import numpy as np

from benchmarks.chain import plant as plants
from benchmarks.chain.hidden import Setup, switch_on
from benchmarks.chain.robot import STREAM, Cameras, make_robot
from surgisoft.errors import InputError
from surgisoft.measurement.protocols import Protocol
from surgisoft.measurement.recordings import ArmInfo, Recording
from surgisoft.rig.collect import check_fits, describe, runs_of
from surgisoft.rig.interface import Truth

REST_S = 30.0
"""Duration of a reset: venting and resting [s]."""
SENSOR_NOISE = 5e-4
"""Standard deviation of one pressure reading, as a share of the upper limit [-]."""
THERMOMETER_K = 0.05
"""Standard deviation of one reading of the room's temperature [K]."""


class ChainRig:
    """One robot of the chain; records whole protocols."""

    unit = "kPa"
    payload_g = None

    def __init__(
        self,
        seed: int,
        take: int = 0,
        noise: float = 1.0,
        hidden: Sequence[tuple[str, float]] = (),
    ) -> None:
        """Switch a robot on.

        take: number of the trial, which has noise of its own; noise: factor on all noise; hidden:
        (name, strength) of effects of `benchmarks.chain.hidden`.
        """
        robot = make_robot(seed)
        self._plant = switch_on(Setup(robot.plant), hidden, seed).plant
        self._state = plants.new_state(self._plant)
        self._state.time[0] = -REST_S
        self._cameras, self._noise = robot.cameras, noise
        self._rng = np.random.default_rng([seed, take, STREAM])
        self.chambers, self.key_planes = len(robot.plant.areas), len(robot.plant.keys)
        self.period_s = robot.cameras.period_s
        self.limits = 1e-3 * np.tile([robot.low, robot.plant.high], (self.chambers, 1))
        self.arm = ArmInfo(robot.length_mm, 2e3 * robot.plant.radius)
        self.gravity = robot.plant.gravity / np.linalg.norm(robot.plant.gravity)

    def record(self, protocol: Protocol) -> tuple[Recording, Truth]:
        """The recording of a continuous protocol, each run from rest, and its true state."""
        check_fits(self, protocol)  # type: ignore[arg-type]  # it records, and is not read
        steps = int(np.ceil(self.period_s / plants.STEP_S - 1e-9))
        parts = []
        for _, commands in runs_of(protocol, self.period_s):
            count, m, n = len(commands), self.chambers, self.key_planes
            out = np.empty((count, m)), np.empty((count, m)), np.empty((count, n, 3))
            room = np.empty(count)
            plants.rest(self._plant, self._state, REST_S)
            begin = self._state.time[0]
            plants.run(self._plant, self._state, 1e3 * commands, self.period_s, steps, *out, room)
            parts.append((begin + self.period_s * np.arange(1, count + 1), commands, *out, room))
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        high = self._plant.high
        return as_measured(self, protocol, columns, self._cameras, high, self._noise, self._rng)


def as_measured(
    rig,
    protocol: Protocol,
    columns: Sequence[np.ndarray],
    cameras: Cameras,
    high: float,
    noise: float,
    rng: np.random.Generator,
) -> tuple[Recording, Truth]:
    """What sensors and cameras make of T samples of a robot on its bench, and their true state.

    columns: times (T,) [s], commands (T, m) [kPa], pressures at the sensors and in the chambers,
    each (T, m) [Pa], key points (T, n, 3) [m] and the room's temperatures (T,) [degrees Celsius];
    high: upper limit of pressure [Pa]; noise: factor on all noise.
    Raises InputError for key points that are not finite.
    """
    t_s, commanded, measured, chambers, points, room = columns
    clean = 1e3 * points
    if not np.isfinite(clean).all():
        raise InputError("the arm became unstable: use a weaker effect")
    seen = clean + noise * camera_noise(cameras, len(t_s), rig.key_planes, rng)
    error = seen - clean
    if noise > 0.0:
        drop_frames(cameras, seen, rng)
    draw = rng.standard_normal(measured.shape)
    recording = describe(
        rig,  # it records, and is not read
        protocol,
        t_s - t_s[0],
        1e-3 * (measured + noise * SENSOR_NOISE * high * draw),
        seen,
        commanded,
        noise_mm=float(np.sqrt(np.mean(np.square(error)))),
        temp_C=room + noise * THERMOMETER_K * rng.standard_normal(len(room)),
    )
    return recording, Truth(clean, clean, 1e-3 * chambers)


def camera_noise(
    cameras: Cameras, frames: int, points: int, rng: np.random.Generator
) -> np.ndarray:
    """(T, n, 3) white and slow noise [mm]; the slow part is a stationary AR(1) process."""
    white = cameras.white_mm * rng.standard_normal((frames, points, 3))
    keep = np.exp(-cameras.period_s / cameras.slow_s)
    draws = cameras.slow_mm * rng.standard_normal((frames, points, 3))
    slow = np.empty_like(draws)
    slow[0] = draws[0]
    for row in range(1, frames):
        slow[row] = keep * slow[row - 1] + np.sqrt(1.0 - keep**2) * draws[row]
    return white + slow


def drop_frames(cameras: Cameras, seen: np.ndarray, rng: np.random.Generator) -> None:
    """Write NaN where cameras drop whole frames, in bursts, or do not see one key point."""
    frames, points, _ = seen.shape
    length = max(cameras.burst_s / cameras.period_s, 1.0)
    for share, whole in ((cameras.dropped, True), (cameras.hidden, False)):
        for begin in np.flatnonzero(rng.random(frames) < share / length):
            rows = slice(begin, begin + 1 + int(rng.exponential(length)))
            seen[rows, slice(None) if whole else int(rng.integers(points))] = np.nan
