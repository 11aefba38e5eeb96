"""The lattice on its bench."""

from collections.abc import Sequence

import numpy as np

from benchmarks.generators import REST_S, Bench, Moved, Setup
from benchmarks.lattice import motion
from benchmarks.lattice.hidden import switch_on
from benchmarks.lattice.robot import STREAM, make_robot


class LatticeRig(Bench):
    """One robot of the lattice; records whole protocols."""

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
        sizes = len(robot.plant.chambers), len(robot.plant.keys)
        seeds = (seed, take, STREAM)
        setup = switch_on(Setup(robot.plant), hidden, seed)
        super().__init__(
            robot, robot.plant.high, robot.plant.gravity, sizes, seeds, noise, setup.zero
        )
        self._plant = setup.plant
        self._state = motion.new_state(self._plant)
        self._state.time[0] = -REST_S

    def rest(self) -> float:
        """Vent the robot and let it rest for REST_S; the time after it since switching on [s]."""
        motion.rest(self._plant, self._state, REST_S)
        return float(self._state.time[0])

    def run(self, targets: np.ndarray) -> Moved:
        """Follow set points (T, m) [Pa], one a sample, and read after each."""
        steps = int(np.ceil(self.period_s / motion.STEP_S - 1e-9))
        return Moved(*motion.run(self._plant, self._state, targets, self.period_s, steps))
