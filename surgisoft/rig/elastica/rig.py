"""The PyElastica rig: an arm, regulators and cameras of somebody else's mechanics, as a `Rig`.

It is a second independent plant beside the virtual rig, for judging a diagnosis on robots that took
no part in its making: other mechanics (PyElastica's Cosserat rod with inertia), other pneumatics,
other laws of friction, viscosity and creep, and robots of other sizes. It imports nothing of the
arm models and nothing of the diagnosis.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from surgisoft.errors import InputError
from surgisoft.measurement.protocols import Protocol
from surgisoft.measurement.recordings import ArmInfo, Recording
from surgisoft.progress import Progress, silent
from surgisoft.rig.collect import collect, samples_in
from surgisoft.rig.elastica import plant as plants
from surgisoft.rig.elastica.hidden import EVENT_WINDOW_S, Setup, switch_on
from surgisoft.rig.elastica.robot import make_robot, vacuum_limit
from surgisoft.rig.elastica.rod import largest_step
from surgisoft.rig.elastica.wall import stiffest
from surgisoft.rig.interface import Sample, Truth, check_simulated, checked_command
from surgisoft.rig.motion_capture import normals_per_frame, normals_per_pause

REST_S = 30.0
"""Duration of a reset: venting and resting [s]."""
HEAVIEST_G = 100.0
"""Largest payload that is accepted [g]."""
SENSOR_NOISE = 4e-4
"""Standard deviation of one pressure reading, as a share of the upper limit [-]."""


@dataclass(frozen=True)
class ElasticaRigConfig:
    """Which robot is on the PyElastica rig, how it is mounted, and what the rig hides."""

    seed: int = 0
    """Seed of the robot."""
    gravity: tuple[float, float, float] | None = None
    """Direction of weight, arm base frame before the roll; None: as the robot's seed draws it."""
    roll_deg: float = 0.0
    """Rotation of the base about its z axis [deg]."""
    payload_g: float = 0.0
    """Known mass at the tip [g]."""
    noise: float = 1.0
    """Factor on all sensor and camera noise."""
    take: int = 0
    """Number of the trial: another one has other noise on the same robot."""
    hidden: tuple[tuple[str, float], ...] = ()
    """Hidden effects: (name, amplitude), see `hidden`."""
    event_window_s: tuple[float, float] = EVENT_WINDOW_S
    """Window of time since switching on in which hidden events that occur once fall [s]."""
    elements: int = 12
    """Elements of the rod; the time of a recording goes with their square."""

    def __post_init__(self):
        object.__setattr__(self, "hidden", tuple((name, x) for name, x in self.hidden))
        check_simulated(self.seed, self.gravity, self.payload_g, HEAVIEST_G, self.noise)
        if self.elements < 6:
            raise InputError(f"elements is {self.elements}, expected at least 6")


class ElasticaRig:
    """A simulated rig with one arm in PyElastica; satisfies `SimulatedRig`."""

    unit = "kPa"

    def __init__(self, config: ElasticaRigConfig | int = 0, **fields) -> None:
        """Build a rig from a configuration or a robot's seed; fields: of `ElasticaRigConfig`."""
        plain = config if isinstance(config, ElasticaRigConfig) else ElasticaRigConfig(config)
        config = self.config = replace(plain, **fields)
        seed = config.seed
        down = None if config.gravity is None else np.array(config.gravity, np.float64)
        if down is not None:
            down /= np.linalg.norm(down)
        plant, body = make_robot(seed, config.elements, down, config.noise)
        plant = plant._replace(gravity=_rolled(plant.gravity, config.roll_deg))
        body.mass[-1] += 1e-3 * config.payload_g
        setup = switch_on(Setup(plant, body, config.event_window_s), config.hidden, seed)
        self._plant = _with_stable_step(setup.plant, setup.body)
        self._state = plants.new_state(self._plant, setup.body)
        self.chambers, self.key_planes = len(self._plant.areas), len(self._plant.nodes)
        high = self._plant.high
        self.limits = np.tile([1e-3 * vacuum_limit(seed, high), 1e-3 * high], (self.chambers, 1))
        self.period_s = float(self._plant.cameras.period)
        length = float(body.rest_lengths.sum())
        self.arm = ArmInfo(1e3 * length, 2e3 * self._plant.radius)
        self.payload_g = float(config.payload_g) if config.payload_g else None
        self.gravity = self._plant.gravity / np.linalg.norm(self._plant.gravity)
        self._rng = np.random.default_rng([seed, config.take, 0xE1A57])
        self._state.time[0] = -REST_S
        self.reset()

    @property
    def time_s(self) -> float:
        """Time since the rig was switched on [s]."""
        return float(self._state.time[0])

    @property
    def step_s(self) -> float:
        """Time step of the mechanics [s]."""
        return self._plant.step

    def reset(self) -> None:
        """Vent the arm and let it rest until it has no memory of before: the start of a run."""
        plants.rest(self._plant, self._state, REST_S)

    def command(self, pressures: np.ndarray) -> None:
        """Set the pressures (m,) [kPa gauge] that the regulators reach for from now on."""
        self._state.air.target[:] = 1e3 * checked_command(pressures, self.limits, self.unit)

    def wait(self, seconds: float) -> None:
        """Let time [s] pass without reading."""
        plants.advance(self._plant, self._state, round(seconds / self._plant.step), True)
        tape = self._rng.standard_normal(normals_per_pause(self._plant.cameras))
        plants.pause_cameras(self._plant, self._state, float(seconds), tape)

    def read(self) -> Sample:
        """Let one period pass and read sensors and cameras."""
        return self.read_beside_truth()[0]

    def read_beside_truth(self) -> tuple[Sample, Truth]:
        """Do what `read` does, and return the true state of that instant (T = 1) with it."""
        plant, state = self._plant, self._state
        plants.advance(plant, state, round(self.period_s / plant.step), True)
        if not np.isfinite(state.body.position).all():
            raise InputError(
                "the arm in PyElastica became unstable: its loads are beyond what its time step "
                "resolves; use a lighter payload or a weaker effect"
            )
        seen, clean = np.empty((2, self.key_planes, 3))
        tape = self._rng.standard_normal(normals_per_frame(plant.cameras))
        temperature = plants.see(plant, state, tape, seen, clean)
        noise = SENSOR_NOISE * self.config.noise * self._rng.standard_normal(self.chambers)
        sample = Sample(
            t_s=self.time_s,
            measured=1e-3 * (state.air.line + noise * plant.high),
            commanded=1e-3 * state.air.target,
            key_points_mm=seen,
            temp_C=temperature,
        )
        chamber = 1e-3 * state.air.chamber
        return sample, Truth(state.centres[None].copy(), clean[None], chamber[None])

    def record(self, protocol: Protocol, progress: Progress = silent) -> tuple[Recording, Truth]:
        """Record a protocol as `collect` does, and return the true state of each sample with it.

        The truth of a steady-state sample is that of its last frame. progress: called with the
        number of samples done and to do.
        """
        beside = _Beside(self)
        recording = collect(beside, protocol, progress)
        count = 1
        if protocol.kind == "settled":
            count = samples_in(protocol.average_s, self.period_s)
        columns = zip(*((t.centres_mm, t.noise_free_mm, t.pressures_kPa) for t in beside.truths),
                      strict=True)  # fmt: skip
        truth = Truth(*(np.concatenate(column)[count - 1 :: count] for column in columns))
        error = recording.key_points_mm - truth.noise_free_mm
        error = error[np.isfinite(error)]
        noise_mm = float(np.sqrt(np.mean(error**2))) if error.size else 0.0
        return replace(recording, noise_mm=noise_mm), truth


class _Beside:
    """A rig that keeps the truth of every sample that is read from it."""

    def __init__(self, rig: ElasticaRig) -> None:
        self._rig = rig
        self.truths: list[Truth] = []

    def __getattr__(self, name: str):
        return getattr(self._rig, name)

    def read(self) -> Sample:
        sample, truth = self._rig.read_beside_truth()
        self.truths.append(truth)
        return sample


def _with_stable_step(plant: plants.Plant, body) -> plants.Plant:
    """The plant with a time step that its wall allows, a whole part of the cameras' period."""
    step = largest_step(body, max(stiffest(plant.wall), 1.2))
    damping = -math.log(plant.keep) / plant.step
    step = plant.cameras.period / math.ceil(plant.cameras.period / step)
    return plant._replace(step=step, keep=math.exp(-damping * step))


def _rolled(gravity: np.ndarray, roll_deg: float) -> np.ndarray:
    """Weight (3,) in the base frame after the base was turned about its z axis."""
    x, y, z = gravity
    c, s = math.cos(math.radians(roll_deg)), math.sin(math.radians(roll_deg))
    return np.array([c * x + s * y, -s * x + c * y, z])
