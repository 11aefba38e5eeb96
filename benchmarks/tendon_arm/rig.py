"""The arm that tendons bend on its bench."""

from collections.abc import Sequence

import numpy as np

from benchmarks.generators import REST_S, Bench, Moved, Setup
from benchmarks.tendon_arm.hidden import switch_on
from benchmarks.tendon_arm.motion import Arm
from benchmarks.tendon_arm.robot import STREAM, build_of, make_robot


class TendonRig(Bench):
    """One robot that tendons bend; records whole protocols. Its actuation is pull in mm."""

    unit = "mm"
    to_unit = 1e3
    to_si = 1e-3

    def __init__(
        self,
        seed: int,
        take: int = 0,
        noise: float = 1.0,
        hidden: Sequence[tuple[str, float]] = (),
    ) -> None:
        """Switch a robot on.

        take: number of the trial, which has noise of its own; noise: factor on all noise; hidden:
        (name, strength) of effects of `benchmarks.tendon_arm.hidden`.
        """
        robot = make_robot(seed)
        plant = robot.plant
        sizes, seeds = (len(plant.offset), len(plant.keys)), (seed, take, STREAM)
        setup = switch_on(Setup(plant), hidden, seed)
        super().__init__(robot, plant.high, plant.gravity, sizes, seeds, noise, setup.zero)
        self._encoders = build_of(seed).encoders
        self._arm = Arm(setup.plant, -REST_S)

    def rest(self) -> float:
        """Home the motors and let the robot rest for REST_S; the time after it since switching
        on [s]."""
        self._arm.rest(REST_S)
        return self._arm.time

    def run(self, targets: np.ndarray) -> Moved:
        """Follow set points (T, m) [m], one a sample, and read after each."""
        moved = self._arm.run(targets, self.period_s)
        return moved if self._encoders else moved._replace(measured=targets)
