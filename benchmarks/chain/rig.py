"""The chain on its bench."""

from collections.abc import Sequence

import numpy as np

from benchmarks.chain import plant as plants
from benchmarks.chain.hidden import switch_on
from benchmarks.chain.robot import STREAM, make_robot
from benchmarks.generators import REST_S, Bench, Moved, Setup


class ChainRig(Bench):
    """One robot of the chain; records whole protocols."""

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
        sizes = len(robot.plant.areas), len(robot.plant.keys)
        seeds = (seed, take, STREAM)
        setup = switch_on(Setup(robot.plant), hidden, seed)
        super().__init__(
            robot, robot.plant.high, robot.plant.gravity, sizes, seeds, noise, setup.zero
        )
        self._plant = setup.plant
        self._state = plants.new_state(self._plant)
        self._state.time[0] = -REST_S

    def rest(self) -> float:
        """Vent the robot and let it rest for REST_S; the time after it since switching on [s]."""
        plants.rest(self._plant, self._state, REST_S)
        return float(self._state.time[0])

    def run(self, targets: np.ndarray) -> Moved:
        """Follow set points (T, m) [Pa], one a sample, and read after each."""
        steps = int(np.ceil(self.period_s / plants.STEP_S - 1e-9))
        count, m, n = len(targets), self.chambers, self.key_planes
        out = Moved(
            np.empty((count, m)), np.empty((count, m)), np.empty((count, n, 3)), np.empty(count)
        )
        plants.run(self._plant, self._state, targets, self.period_s, steps, *out)
        return out
