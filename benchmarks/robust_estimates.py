"""Error of the estimated beam of `circle_ablation` by several observers on identical measurements.

    OMP_NUM_THREADS=1 python -m benchmarks.robust_estimates

One closed loop is recorded on each robot, with the observer of today; every observer then gets the
same measurements again. Robots and conditions are those on which the observer was developed, so
that the robots of `benchmarks/robust.py` stay unseen.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.robust import DEFAULT, DEVELOPMENT, LEARNS, Case, Method, Robots, robust_task
from benchmarks.robust_floor import filtered
from surgisoft.agents.observer import ObserverGains
from surgisoft.agents.on_rig import RigArm, RigConfig, on_rig
from surgisoft.agents.policies import open_policy
from surgisoft.agents.rollout import Instant, rollout
from surgisoft.tasks.base import Task
from surgisoft.tasks.laser_work import LASER
from surgisoft.tasks.world.adaptation import (
    AdaptationPrior,
    DisturbanceEstimator,
    Estimate,
)
from surgisoft.tasks.world.arm import Randomisation


@dataclass(frozen=True)
class Measured:
    """What the observer of one robot's laser arm was given, one row for each of its T updates."""

    off_mm: Tensor
    """(T, n, 3) mm, base frame: measured key points less the model's, nan where one was lost."""
    pressure: Tensor
    """(T, m) kPa."""
    body_mm: Tensor
    """(T, n, 3) mm, base frame: the model's key points."""
    pose: Tensor
    """(4, 4) base frame to world frame, mm."""
    true_mm: Tensor
    """(S, n, 3) mm, world frame: true key points after each of the S steps of the episode that
    follow the approach; the observer's last S updates belong to them."""
    target_mm: Tensor
    """(S, 3) mm, world frame: where the beam should be then."""


class Listener:
    """A `DisturbanceEstimator` that keeps what it is given."""

    def __init__(self, learner: DisturbanceEstimator):
        self._learner, self.heard = learner, list[tuple[Tensor, Tensor, Tensor]]()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._learner, name)

    def updated(self, memory: Any, off_mm: Tensor, pressure: Tensor, points_mm: Tensor) -> Estimate:
        """See `DisturbanceEstimator.updated`."""
        self.heard.append((off_mm, pressure, points_mm))
        return self._learner.updated(memory, off_mm, pressure, points_mm)


def recorded(policy: str, robots: list[int], hidden: str, seed: int) -> tuple[Task, list[Measured]]:
    """The task, and one episode of a policy on each of the robots, side by side."""
    method, poses = Method(policy, policy, LEARNS), Randomisation.history
    cases = [Case(method, DEFAULT, robot, hidden, 1, seed, False, poses) for robot in robots]
    task = on_rig(robust_task(None, poses), RigConfig(adapts=True), Robots(cases))
    arm = task.world.arms[LASER]
    assert isinstance(arm, RigArm)
    assert arm.observer.learner is not None
    listener: Any = Listener(arm.observer.learner)
    arm.observer.learner = listener
    given: list[list[tuple[Tensor, ...]]] = [[] for _ in robots]
    truth: list[list[tuple[Tensor, Tensor]]] = [[] for _ in robots]
    poses_of: dict[int, Tensor] = {}

    def watch(now: Instant) -> None:
        part, target = now.state.world.arms[LASER], task.target_mm(now.state)
        judged = bool(now.state.world.steps[0] * task.dt_s > task.config.approach_s)
        for row in now.live.nonzero()[:, 0].tolist():
            robot = int(now.episodes[row])
            given[robot] += [tuple(each[row] for each in update) for update in listener.heard]
            poses_of[robot] = part.mount[row].clone()
            if judged:
                truth[robot].append((part.points_mm[row].clone(), target[row].clone()))
        listener.heard.clear()

    rollout(task, open_policy(policy, task), len(robots), seed, len(robots), watch=watch)

    def together(rows: list) -> list[Tensor]:
        return [torch.stack(column) for column in zip(*rows, strict=True)]

    return task, [
        Measured(*together(given[robot]), poses_of[robot], *together(truth[robot]))
        for robot in range(len(robots))
    ]


Observe = Callable[[Measured], Tensor]
"""(T, n, 3) mm, base frame: the disturbance that an observer estimates from measurements."""


def learning(task: Task, prior: AdaptationPrior) -> Observe:
    """The observer that learns, with a prior."""
    arm = task.world.arms[LASER]
    estimator = DisturbanceEstimator(arm.model, task.dt_s, prior)

    def observe(measured: Measured) -> Tensor:
        memory, found = estimator.start(1), []
        for row in zip(measured.off_mm, measured.pressure, measured.body_mm, strict=True):
            estimate = estimator.updated(memory, *(each[None] for each in row))
            memory = estimate.memory
            found.append(estimate.now_mm[0])
        return torch.stack(found)

    return observe


def filtering(measured: Measured) -> Tensor:
    """The alpha-beta filter with the gains of rigs."""
    return filtered(ObserverGains(), torch.nan_to_num(measured.off_mm))


@torch.inference_mode()
def errors_mm(task: Task, every: list[Measured], observe: Observe) -> list[float]:
    """Of each robot: mean distance of the estimated from the true beam at its target, mm."""
    point, found = task.pointing[LASER], []
    for measured in every:
        size, turn = len(measured.true_mm), measured.pose[:3, :3]
        seen = (measured.body_mm + observe(measured))[-size:] @ turn.mT + measured.pose[:3, 3]
        bodies = (seen, measured.true_mm)
        off, true = (point.offset_mm(body, measured.target_mm) for body in bodies)
        found.append(float((off - true).norm(dim=1).mean()))
    return found


def main() -> None:
    """Print a table with a row for each observer."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--policy", default="scripted", help="policy of the closed loops")
    options.add_argument("--robots", default=",".join(map(str, DEVELOPMENT)), help="seeds")
    options.add_argument("--hidden", default="", help="hidden effects, one table column each")
    options.add_argument("--seed", type=int, default=2000, help="seed of the episodes")
    given = options.parse_args()
    robots = [int(robot) for robot in given.robots.split(",")]
    columns = {}
    for hidden in given.hidden.split(","):
        task, every = recorded(given.policy, robots, hidden, given.seed)
        today = AdaptationPrior()
        observers: dict[str, Observe] = {
            "alpha-beta filter": filtering,
            "today's": learning(task, today),
            "all parameters": learning(task, replace(today, least_mm=1e-9)),
        }
        columns[hidden or "none"] = {
            name: float(np.mean(errors_mm(task, every, observe)))
            for name, observe in observers.items()
        }
    print("| observer | " + " | ".join(columns) + " |")
    print("|---" * (len(columns) + 1) + "|")
    for name in observers:
        print(f"| {name} | " + " | ".join(f"{c[name]:.3f}" for c in columns.values()) + " |")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
