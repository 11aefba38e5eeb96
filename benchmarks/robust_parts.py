"""Parts of the beam's error of `circle_ablation` on a rig: the estimate, and the controller.

    OMP_NUM_THREADS=1 python -m benchmarks.robust_parts --policies ring,scripted

At each step the true offset of the beam from its target is the offset of the estimated beam, which
the controller can see, plus the error of the estimate, which it cannot. Each is divided into a slow
part, its moving average over `SLOW_S`, and the quick rest. Robots and conditions are those on which
the observer was developed, so that the robots of `benchmarks/robust.py` stay unseen.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, fields

import numpy as np
import torch

from benchmarks.robust import DEFAULT, DEVELOPMENT, LEARNS, Case, Method, Robots, robust_task
from surgisoft.agents.on_rig import RigConfig, on_rig
from surgisoft.agents.policies import open_policy
from surgisoft.agents.rollout import Instant, rollout
from surgisoft.tasks.laser_work import LASER
from surgisoft.tasks.world.arm import Randomisation

SLOW_S = 2.0
"""Time over which the slow part is averaged, s."""


@dataclass(frozen=True)
class Parts:
    """Mean lengths of an episode in mm, after the approach; they do not add up."""

    true_mm: float
    """True distance of the beam from its target."""
    estimate_error_mm: float
    """Distance of the estimated beam from the true one, at the target."""
    estimate_error_slow_mm: float
    """The slow part of the estimate's error."""
    estimate_error_quick_mm: float
    """The rest of the estimate's error."""
    control_mm: float
    """Distance of the estimated beam from the target: what the controller leaves."""
    control_slow_mm: float
    """The slow part of what the controller leaves."""
    control_quick_mm: float
    """The rest of what the controller leaves."""


def slow_part(offsets: np.ndarray, steps: int) -> np.ndarray:
    """(T, 3): centred moving average of (T, 3) over `steps` steps, over fewer at both ends."""
    window = np.ones(steps)
    count = np.convolve(np.ones(len(offsets)), window, "same")
    return np.stack([np.convolve(row, window, "same") / count for row in offsets.T], 1)


def parts(true: np.ndarray, estimated: np.ndarray, steps: int) -> Parts:
    """Parts of offsets (T, 3) mm of the true and of the estimated beam; steps: in `SLOW_S`."""
    error = true - estimated
    slow, left = slow_part(error, steps), slow_part(estimated, steps)
    every = (true, error, slow, error - slow, estimated, left, estimated - left)
    return Parts(*(float(np.linalg.norm(each, axis=1).mean()) for each in every))


def measured(policy: str, robots: list[int], hidden: str, seed: int) -> list[Parts]:
    """One episode of a policy on each of the robots, side by side."""
    method = Method(policy, policy, LEARNS)
    poses = Randomisation.history
    cases = [Case(method, DEFAULT, robot, hidden, 1, seed, False, poses) for robot in robots]
    task = on_rig(robust_task(None, poses), RigConfig(adapts=True), Robots(cases))
    point, rows = task.pointing[LASER], [[] for _ in robots]

    def watch(now: Instant) -> None:
        if not now.state.world.steps[0] * task.dt_s > task.config.approach_s:
            return
        part, target = now.state.world.arms[LASER], task.target_mm(now.state)
        both = torch.stack([point.offset_mm(p, target) for p in (part.points_mm, part.seen_mm)], 1)
        for row in now.live.nonzero()[:, 0].tolist():
            rows[int(now.episodes[row])].append(both[row].numpy())

    rollout(task, open_policy(policy, task), len(robots), seed, len(robots), watch=watch)
    steps = round(SLOW_S / task.dt_s)
    return [parts(*np.stack(row, 1), steps) for row in rows if row]


def main() -> None:
    """Print a table with a row for each policy."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--policies", default="ring,scripted", help="policies, with commas")
    options.add_argument("--robots", default=",".join(map(str, DEVELOPMENT)), help="seeds")
    options.add_argument("--hidden", default="", help="a hidden effect, at strength 1")
    options.add_argument("--seed", type=int, default=2000, help="seed of the episodes")
    given = options.parse_args()
    robots = [int(robot) for robot in given.robots.split(",")]
    names = [field.name for field in fields(Parts)]
    print("| policy | " + " | ".join(name.removesuffix("_mm") for name in names) + " |")
    print("|---" * (len(names) + 1) + "|")
    for policy in given.policies.split(","):
        found = measured(policy, robots, given.hidden, given.seed)
        means = [np.mean([getattr(each, name) for each in found]) for name in names]
        cells = " | ".join(f"{mean:.3f}" for mean in means)
        print(f"| {policy} | {cells} |", flush=True)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
