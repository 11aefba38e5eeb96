"""Error of the estimated beam of `circle_ablation` by several observers on identical measurements.

    OMP_NUM_THREADS=1 python -m benchmarks.robust_estimates

One closed loop is recorded on each robot, with the observer of today; every observer then gets the
same measurements again. Robots and conditions are those on which the observer was developed, so
that the robots of `benchmarks/robust.py` stay unseen.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
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
from surgisoft.tasks.world.arm_errors import ErrorPrior


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


Observe = Callable[[Tensor, Tensor, Tensor], Tensor]
"""Disturbances (T, R, n, 3) mm, base frame, that an observer estimates for R robots from `off_mm`
(T, R, n, 3), `pressure` (T, R, m) and `body_mm` (T, R, n, 3)."""


def learning(task: Task, prior: AdaptationPrior) -> Observe:
    """The observer that learns, with a prior."""
    estimator = DisturbanceEstimator(task.world.arms[LASER].model, task.dt_s, prior)

    def observe(off: Tensor, pressure: Tensor, body: Tensor) -> Tensor:
        memory, found = estimator.start(off.shape[1]), []
        for row in zip(off, pressure, body, strict=True):
            memory, now, _, _ = estimator.updated(memory, *row)
            found.append(now)
        return torch.stack(found)

    return observe


def unfiltered(off: Tensor, pressure: Tensor, body: Tensor) -> Tensor:
    """Single pictures; the model stands in where a key point was lost."""
    return torch.nan_to_num(off)


def filtering(off: Tensor, pressure: Tensor, body: Tensor) -> Tensor:
    """The alpha-beta filter with the gains of rigs."""
    return filtered(ObserverGains(), unfiltered(off, pressure, body))


def observers(task: Task) -> dict[str, Observe]:
    """Observers by their name in the table: two without learning, today's, and today's in parts."""
    today, none = AdaptationPrior(), 1e-9
    errors = ErrorPrior(**{field.name: none for field in fields(ErrorPrior)})
    still = {"chambers_kPa": none, "shift_mm": none, "turn_rad": none, "rest_mm": none}
    priors = {
        "that learns": today,
        "that learns, without model errors": replace(today, errors=errors),
        "that learns, without late motion": replace(today, late_share=none),
        "that learns, without transients": replace(today, **still),
        "that learns, variance of transients fixed": replace(today, quietest=1.0, liveliest=1.0),
    }
    learn = {name: learning(task, prior) for name, prior in priors.items()}
    return {"single pictures": unfiltered, "alpha-beta filter": filtering, **learn}


@torch.inference_mode()
def errors_mm(task: Task, every: list[Measured], observe: Observe) -> list[float]:
    """Of each robot: mean distance of the estimated from the true beam at its target, mm."""
    longest, point, found = max(len(each.off_mm) for each in every), task.pointing[LASER], []

    def side_by_side(name: str) -> Tensor:
        rows = [getattr(each, name) for each in every]
        return torch.stack(
            [torch.cat((r, r[-1:].expand(longest - len(r), *r[0].shape))) for r in rows], 1
        )

    now = observe(*(side_by_side(name) for name in ("off_mm", "pressure", "body_mm")))
    for robot, each in enumerate(every):
        last, size = len(each.off_mm), len(each.true_mm)
        seen = (each.body_mm + now[:last, robot])[last - size :]
        seen = seen @ each.pose[:3, :3].mT + each.pose[:3, 3]
        bodies = (seen, each.true_mm)
        off, true = (point.offset_mm(body, each.target_mm) for body in bodies)
        found.append(float((off - true).norm(dim=1).mean()))
    return found


def main() -> None:
    """Print a table with a row for each observer."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--policy", default="scripted", help="policy of the closed loops")
    options.add_argument("--robots", default=",".join(map(str, DEVELOPMENT)), help="seeds")
    options.add_argument("--hidden", default="", help="hidden effects, a column each; empty: none")
    options.add_argument("--seed", type=int, default=2000, help="seed of the episodes")
    given = options.parse_args()
    robots = [int(robot) for robot in given.robots.split(",")]
    columns: dict[str, dict[str, float]] = {}
    for hidden in given.hidden.split(","):
        task, every = recorded(given.policy, robots, hidden, given.seed)
        columns[f"`{hidden}`" if hidden else "no effect"] = {
            name: float(np.mean(errors_mm(task, every, observe)))
            for name, observe in observers(task).items()
        }
    print("| observer | " + " | ".join(columns) + " |")
    print("|---" * (len(columns) + 1) + "|")
    for name in observers(task):
        print(f"| {name} | " + " | ".join(f"{c[name]:.3f}" for c in columns.values()) + " |")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
