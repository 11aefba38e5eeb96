"""What generators of robots have in common: cameras, a bench, sudden events, and their cases.

`benchmarks.chain` and `benchmarks.lattice` have robots of their own physics. Nothing here moves an
arm.
"""

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from benchmarks.rig_cases import Generator
from surgisoft.compiled import compiled
from surgisoft.errors import InputError
from surgisoft.measurement.protocols import Protocol as Schedule
from surgisoft.measurement.recordings import ArmInfo, Recording
from surgisoft.rig.collect import check_fits, describe, runs_of
from surgisoft.rig.hidden import random_direction
from surgisoft.rig.interface import Truth

STANDARD_GRAVITY = 9.80665
"""[m/s^2] (CGPM 1901)."""
ROOM_C = 22.0
"""Temperature of the room at which an arm has its nominal modulus [degrees Celsius]."""
REST_S = 30.0
"""Duration of a reset: venting and resting [s]."""
EVENT_S = 0.15
"""Duration of a sudden event [s]."""
EVENT_WINDOW_S = (20.0, 130.0)
"""Window of time since switching on in which an event that occurs once falls [s]: in one of the
first runs of a recording, or between them."""
SENSOR_NOISE = 5e-4
"""Standard deviation of one reading of the actuation, as a share of the upper limit [-]."""
THERMOMETER_K = 0.05
"""Standard deviation of one reading of the room's temperature [K]."""


@compiled
def since(time: float, moment: float) -> float:
    """Share of a sudden event that has happened at a time [s]."""
    return min(max((time - moment) / EVENT_S, 0.0), 1.0)


@compiled
def rotation(turn: np.ndarray, out: np.ndarray) -> None:
    """Rotation matrix (3, 3) of a rotation vector (3,) [rad] (Rodrigues 1840), into out."""
    square = turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2
    angle = math.sqrt(square)
    if angle < 1e-6:
        a, b = 1.0 - square / 6.0, 0.5 - square / 24.0
    else:
        a, b = math.sin(angle) / angle, (1.0 - math.cos(angle)) / square
    for i in range(3):
        for j in range(3):
            out[i, j] = b * turn[i] * turn[j]
        out[i, i] += 1.0 - b * square
    out[2, 1] += a * turn[0]
    out[1, 2] -= a * turn[0]
    out[0, 2] += a * turn[1]
    out[2, 0] -= a * turn[1]
    out[1, 0] += a * turn[2]
    out[0, 1] -= a * turn[2]


def sideways(rng: np.random.Generator) -> np.ndarray:
    """(3,) random unit vector across the arm."""
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([math.cos(angle), math.sin(angle), 0.0])


def hanging(rng: np.random.Generator) -> np.ndarray:
    """(3,) direction of weight of an arm that hangs tilted by up to 95 degrees."""
    tilt, around = np.radians(rng.uniform(0.0, 95.0)), rng.uniform(0, 2 * np.pi)
    return np.array([np.sin(tilt) * np.cos(around), np.sin(tilt) * np.sin(around), np.cos(tilt)])


@dataclass
class Setup:
    """What a hidden effect may change."""

    plant: Any
    """Parameters of the robot, a NamedTuple; their arrays are shared, and replaced, not written
    to."""
    zero: np.ndarray | float = 0.0
    """(m,) reading of each channel's sensor without actuation, over the upper limit [-]."""

    def change(self, **values) -> None:
        """Replace parameters of the robot."""
        self.plant = self.plant._replace(**values)

    def change_wall(self, **values) -> None:
        """Replace parameters of its wall."""
        self.change(wall=self.plant.wall._replace(**values))


def misalignment(strength: float, length: float, rng: np.random.Generator) -> np.ndarray:
    """(6,) rotation [rad] and shift [m] of the cameras' frame beside an arm of a length [m]."""
    turn = 0.012 * strength * random_direction(rng)
    return np.concatenate([turn, 0.004 * strength * length * random_direction(rng)])


def shift_zeros(setup: Setup, strength: float, chambers: int, rng: np.random.Generator) -> None:
    """Sensors of two channels, or homes of two motors, whose zero has shifted."""
    shift = np.zeros(chambers)
    sizes = 0.04 * strength * np.array([1.0, rng.uniform(0.3, 1.0)])
    shift[rng.permutation(chambers)[:2]] = sizes[:chambers] * rng.choice([-1.0, 1.0], 2)[:chambers]
    setup.zero = shift


def breath(strength: float, length: float, rng: np.random.Generator) -> np.ndarray:
    """(5,) shift of the base at the depth of a breath [m], mean period and phase [s]."""
    period = rng.uniform(3.0, 5.5)
    shift = 0.02 * strength * length * random_direction(rng)
    return np.array([*shift, period, rng.uniform(0.0, period)])


@dataclass(frozen=True)
class Cameras:
    """Motion capture."""

    period_s: float
    """Time between frames [s]."""
    white_mm: float
    """Standard deviation of a coordinate, new in each frame [mm]."""
    slow_mm: float
    """Standard deviation of its slow part, an AR(1) process [mm]."""
    slow_s: float
    """Correlation time of the slow part [s]."""
    dropped: float
    """Share of frames that are lost, in bursts [-]."""
    burst_s: float
    """Mean duration of a burst [s]."""
    hidden: float
    """Share of frames in which one key point is hidden from the cameras [-]."""

    def noise(self, frames: int, points: int, rng: np.random.Generator) -> np.ndarray:
        """(T, n, 3) white and slow noise [mm]; the slow part is a stationary AR(1) process."""
        white = self.white_mm * rng.standard_normal((frames, points, 3))
        keep = np.exp(-self.period_s / self.slow_s)
        draws = self.slow_mm * rng.standard_normal((frames, points, 3))
        slow = np.empty_like(draws)
        slow[0] = draws[0]
        for row in range(1, frames):
            slow[row] = keep * slow[row - 1] + np.sqrt(1.0 - keep**2) * draws[row]
        return white + slow

    def drop_frames(self, seen: np.ndarray, rng: np.random.Generator) -> None:
        """Write NaN where whole frames are dropped, in bursts, or one key point is not seen."""
        frames, points, _ = seen.shape
        length = max(self.burst_s / self.period_s, 1.0)
        for share, whole in ((self.dropped, True), (self.hidden, False)):
            for begin in np.flatnonzero(rng.random(frames) < share / length):
                rows = slice(begin, begin + 1 + int(rng.exponential(length)))
                seen[rows, slice(None) if whole else int(rng.integers(points))] = np.nan


class Robot(Protocol):
    """A robot as it was built, as its bench needs it."""

    cameras: Cameras
    """Its cameras."""
    low: float
    """Lower limit of actuation [SI]."""
    length_mm: float
    """Length [mm]."""
    radius_mm: float
    """Radius [mm]."""


class Moved(NamedTuple):
    """What a robot did in a run of T samples."""

    measured: np.ndarray
    """(T, m) actuation at the sensors [SI]."""
    chambers: np.ndarray
    """(T, m) actuation behind them, of the arm itself [SI]."""
    points: np.ndarray
    """(T, n, 3) key points [m]."""
    room: np.ndarray
    """(T,) temperatures of the room [degrees Celsius]."""


class Bench:
    """One robot on a bench: records whole protocols with cameras, and knows the truth beside it.

    A class of a generator sets its robot up and says how it rests and moves.
    """

    unit = "kPa"
    to_unit = 1e-3
    """Actuation in `unit` of one SI unit: kPa of one Pa."""
    to_si = 1e3
    """Actuation in SI units of one `unit`: Pa of one kPa."""
    payload_g = None

    def __init__(
        self,
        robot: Robot,
        high: float,
        gravity: np.ndarray,
        sizes: tuple[int, int],
        seeds: Sequence[int],
        noise: float,
        zero: np.ndarray | float = 0.0,
    ) -> None:
        """The bench of a robot.

        high: upper limit of actuation [SI]; gravity: (3,) in any unit; sizes: chambers and key
        points; seeds: of all noise; noise: factor on it; zero: (m,) reading of each channel's
        sensor without actuation, over the upper limit, which its controller follows.
        """
        self._cameras, self._high, self._noise = robot.cameras, high, noise
        self._rng = np.random.default_rng(seeds)
        self._low, self._zero = robot.low, high * zero
        self.chambers, self.key_planes = sizes
        self.period_s = robot.cameras.period_s
        self.limits = self.to_unit * np.tile([robot.low, high], (self.chambers, 1))
        self.arm = ArmInfo(robot.length_mm, 2.0 * robot.radius_mm)
        self.gravity = gravity / np.linalg.norm(gravity)

    def rest(self) -> float:
        """Vent the robot and let it rest for REST_S; the time after it since switching on [s]."""
        raise NotImplementedError

    def run(self, targets: np.ndarray) -> Moved:
        """Follow set points (T, m) [SI], one a sample, and read after each."""
        raise NotImplementedError

    def record(self, protocol: Schedule) -> tuple[Recording, Truth]:
        """The recording of a continuous protocol, each run from rest, and its true state.

        Raises InputError where the robot's motion is not finite.
        """
        check_fits(self, protocol)  # type: ignore[arg-type]  # it records, and is not read
        times, parts, commanded = [], [], []
        for _, commands in runs_of(protocol, self.period_s):
            times.append(self.rest() + self.period_s * np.arange(1, len(commands) + 1))
            moved = self.run(np.maximum(self.to_si * commands - self._zero, self._low))
            parts.append(moved._replace(measured=moved.measured + self._zero))
            commanded.append(commands)
        whole = Moved(*(np.concatenate(column) for column in zip(*parts, strict=True)))
        return self._as_measured(protocol, np.concatenate(times), np.concatenate(commanded), whole)

    def _as_measured(
        self, protocol: Schedule, t_s: np.ndarray, commanded: np.ndarray, moved: Moved
    ) -> tuple[Recording, Truth]:
        """What sensors and cameras make of T samples, and their true state."""
        clean, noise, rng = 1e3 * moved.points, self._noise, self._rng
        if not np.isfinite(clean).all():
            raise InputError("the arm became unstable: use a weaker effect")
        seen = clean + noise * self._cameras.noise(len(t_s), self.key_planes, rng)
        error = seen - clean
        if noise > 0.0:
            self._cameras.drop_frames(seen, rng)
        draw = rng.standard_normal(moved.measured.shape)
        recording = describe(
            self,  # it records, and is not read
            protocol,
            t_s - t_s[0],
            self.to_unit * (moved.measured + noise * SENSOR_NOISE * self._high * draw),
            seen,
            commanded,
            noise_mm=float(np.sqrt(np.mean(np.square(error)))),
            temp_C=moved.room + noise * THERMOMETER_K * rng.standard_normal(len(moved.room)),
        )
        return recording, Truth(clean, clean, self.to_unit * moved.chambers)


class Build(Protocol):
    """What is not drawn of a robot."""

    before_s: tuple[float, float]
    """Durations of the two recordings before a change [s]."""
    epochs: int
    """Most epochs of the fit to them."""


def generator(
    rig: Callable[..., Bench],
    unknown: tuple[str, ...],
    build_of: Callable[[int], Build],
    make_robot: Callable[[int], Robot],
    tries: int,
) -> Generator:
    """Generator of cases from the builds and robots of seeds.

    Changes are drawn in mm for each 100 mm of the arm, and `robot.json` has the field `fit`, the
    budget of the fit of the robot's model. tries: as of `Generator`.
    """
    before_s, about = (functools.partial(part, build_of) for part in (_before_s, _about))
    scale = functools.partial(_hundreds_of_mm, make_robot)
    return Generator(rig, unknown, unknown, before_s, scale, about, tries)


def _before_s(build_of: Callable[[int], Build], robot: int) -> dict[str, float]:
    """Durations of the recordings before a change [s]: those of the robot's build."""
    return dict(zip(("mixed", "other"), build_of(robot).before_s, strict=True))


def _hundreds_of_mm(make_robot: Callable[[int], Robot], robot: int) -> float:
    """Length of the arm in units of 100 mm."""
    return make_robot(robot).length_mm / 100.0


def _about(build_of: Callable[[int], Build], robot: int) -> dict:
    """Budget of the fit of the robot's model."""
    return {"fit": {"epochs": build_of(robot).epochs}}
