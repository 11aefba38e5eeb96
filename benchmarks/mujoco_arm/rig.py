"""The arm in MuJoCo on its bench."""

from collections.abc import Sequence

import numpy as np

from benchmarks.generators import REST_S, Bench, Moved, Setup
from benchmarks.mujoco_arm.hidden import switch_on
from benchmarks.mujoco_arm.motion import Arm
from benchmarks.mujoco_arm.robot import STREAM, make_robot


class MujocoRig(Bench):
    """One robot in MuJoCo; records whole protocols."""

    def __init__(
        self,
        seed: int,
        take: int = 0,
        noise: float = 1.0,
        hidden: Sequence[tuple[str, float]] = (),
    ) -> None:
        """Switch a robot on.

        take: number of the trial, which has noise of its own; noise: factor on all noise; hidden:
        (name, strength) of effects of `benchmarks.mujoco_arm.hidden`.
        """
        robot = make_robot(seed)
        sizes = len(robot.plant.areas), len(robot.plant.keys)
        seeds = (seed, take, STREAM)
        setup = switch_on(Setup(robot.plant), hidden, seed)
        super().__init__(
            robot, robot.plant.high, robot.plant.gravity, sizes, seeds, noise, setup.zero
        )
        self._arm = Arm(setup.plant, -REST_S)

    def rest(self) -> float:
        """Vent the robot and let it rest for REST_S; the time after it since switching on [s]."""
        self._arm.rest(REST_S)
        return self._arm.time

    def run(self, targets: np.ndarray) -> Moved:
        """Follow set points (T, m) [Pa], one a sample, and read after each."""
        return self._arm.run(targets, self.period_s)
