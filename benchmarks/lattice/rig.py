"""The lattice on its bench: records a protocol with cameras, and knows the truth beside it."""

from collections.abc import Sequence

import numpy as np

from benchmarks.chain.rig import REST_S, as_measured
from benchmarks.lattice import motion
from benchmarks.lattice.hidden import Setup, switch_on
from benchmarks.lattice.robot import STREAM, make_robot
from surgisoft.measurement.protocols import Protocol
from surgisoft.measurement.recordings import ArmInfo, Recording
from surgisoft.rig.collect import check_fits, runs_of
from surgisoft.rig.interface import Truth


class LatticeRig:
    """One robot of the lattice; records whole protocols."""

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
        (name, strength) of effects of `benchmarks.lattice.hidden`.
        """
        robot = make_robot(seed)
        self._plant = switch_on(Setup(robot.plant), hidden, seed).plant
        self._state = motion.new_state(self._plant)
        self._state.time[0] = -REST_S
        self._cameras, self._noise = robot.cameras, noise
        self._rng = np.random.default_rng([seed, take, STREAM])
        self.chambers, self.key_planes = len(robot.plant.chambers), len(robot.plant.keys)
        self.period_s = robot.cameras.period_s
        self.limits = 1e-3 * np.tile([0.0, robot.plant.high], (self.chambers, 1))
        self.arm = ArmInfo(robot.length_mm, 2.0 * robot.radius_mm)
        self.gravity = robot.plant.gravity / np.linalg.norm(robot.plant.gravity)

    def record(self, protocol: Protocol) -> tuple[Recording, Truth]:
        """The recording of a continuous protocol, each run from rest, and its true state."""
        check_fits(self, protocol)  # type: ignore[arg-type]  # it records, and is not read
        steps = int(np.ceil(self.period_s / motion.STEP_S - 1e-9))
        parts = []
        for _, commands in runs_of(protocol, self.period_s):
            motion.rest(self._plant, self._state, REST_S)
            begin = self._state.time[0]
            out = motion.run(self._plant, self._state, 1e3 * commands, self.period_s, steps)
            t_s = begin + self.period_s * np.arange(1, len(commands) + 1)
            parts.append((t_s, commands, *out))
        columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
        high = self._plant.high
        return as_measured(self, protocol, columns, self._cameras, high, self._noise, self._rng)
