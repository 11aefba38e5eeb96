"""What the noise of the cameras alone does to the estimated beam of `circle_ablation`.

The pressures of a whole ring, as the scripted expert commands them in simulation, are commanded to
a rig. Only the difference of the measured from the noise-free key points is taken from it: this is
the noise of its cameras, white and slow. Added to the arm model's own key points it makes an arm
that is exactly the model, so that every remaining error of the estimate is the cameras'.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch import Tensor

from surgisoft.agents.observer import ObserverGains
from surgisoft.agents.policies import Scripted
from surgisoft.agents.rollout import Instant, rollout
from surgisoft.rig import VirtualRig
from surgisoft.surrogate.reach import steady_key_points
from surgisoft.tasks.inverse_kinematics import Pointing
from surgisoft.tasks.registry import make_task
from surgisoft.tasks.world.adaptation import DisturbanceEstimator
from surgisoft.tasks.world.arm import ModelArm, Randomisation
from surgisoft.tasks.world.observer import AlphaBetaFilter

APPROACH_S = 5.0
"""Time at the beginning of an episode that is left out, as in `pointing_error_mm`, s."""
HELD_S = 4.0
"""Time at each pressure before the episode, as on rigs, s."""


@dataclass(frozen=True)
class Floor:
    """Mean distance of the estimated beam from the true one at its target, by noise alone, mm."""

    raw_mm: float
    """Of single pictures."""
    filter_mm: float
    """Of the alpha-beta filter with the gains of rigs."""
    learns_mm: float
    """Of the observer that learns online."""


@cache
def _ring() -> tuple[ModelArm, np.ndarray, np.ndarray, np.ndarray]:
    """Laser arm, its pressures (T, m) kPa, key points (T, n, 3) and targets (T, 3) in mm, world
    frame, of an episode of the scripted expert in simulation."""
    task, rows = make_task("circle_ablation"), []

    def watch(now: Instant) -> None:
        part = now.state.world.arms["laser"]
        target = task.target_mm(now.state)
        rows.append([each[0].numpy() for each in (part.pressure, part.points_mm, target)])

    rollout(task, Scripted(), 1, 2000, watch=watch)
    columns = (np.stack(column) for column in zip(*rows, strict=True))
    arm = task.world.arms["laser"]
    assert isinstance(arm, ModelArm)
    return arm, *columns


@torch.no_grad()
def floor(robot: int, poses: int = Randomisation.history) -> Floor:
    """The floor with the cameras of a robot; poses: random pressures before the episode."""
    arm, pressures, points, targets = _ring()
    rig = VirtualRig(robot)
    reads = round(0.1 / rig.period_s)
    before = round(HELD_S / rig.period_s)
    random = np.random.default_rng(robot)
    low, high = rig.limits.T
    held = [*random.uniform(low, high, (poses, len(low))), pressures[0]]
    rig.reset()
    noise, at = [], []
    for target, count in [*((p, before) for p in held), *((p, reads) for p in pressures[1:])]:
        rig.command(np.clip(target, low, high))
        for number in range(count):
            sample, truth = rig.read_beside_truth()
            if (number + 1) % reads == 0:
                noise.append(sample.key_points_mm - truth.noise_free_mm[0])
                at.append(sample.measured)
    off = torch.tensor(np.array(noise), dtype=torch.float32)[:, None]
    kPa = torch.tensor(np.array(at), dtype=torch.float32)[:, None]
    gains, estimator = ObserverGains(), DisturbanceEstimator(arm.model, 0.1)
    first = len(off) - len(pressures)
    after = round(APPROACH_S / 0.1)
    true, goal = torch.tensor(points)[after:], torch.tensor(targets)[after:]
    learned, memory = [], estimator.start(1)
    rest = steady_key_points(arm.model, kPa[:, 0].double().numpy())
    bodies = torch.tensor(rest, dtype=torch.float32)[:, None]
    for each, pressure, body in zip(off, kPa, bodies, strict=True):
        found = estimator.updated(memory, each, pressure, body)
        memory = found.memory
        learned.append(found.now_mm[0])
    raw = torch.nan_to_num(off[first:, 0])
    return Floor(
        raw_mm=_beam_mm(arm, true, goal, raw[after:]),
        filter_mm=_beam_mm(arm, true, goal, filtered(gains, raw)[after:]),
        learns_mm=_beam_mm(arm, true, goal, torch.stack(learned)[first + after :]),
    )


def filtered(gains: ObserverGains, off: Tensor) -> Tensor:
    """(T, n, 3) mm: the disturbance that the alpha-beta filter estimates from measured ones."""
    alpha_beta = AlphaBetaFilter(gains.observer_gain, gains.drift_gain)
    offset, drift, found = off[0], torch.zeros_like(off[0]), []
    for each in off:
        now, offset, drift = alpha_beta.adopted(each - offset, offset, drift)
        found.append(now)
    return torch.stack(found)


def _beam_mm(arm: ModelArm, true: Tensor, goal: Tensor, error: Tensor) -> float:
    """Mean distance of the beam at its target by errors (T, n, 3) mm, base frame, of key points."""
    point = Pointing(arm, 0.1)
    seen = true + error @ arm.pose[:3, :3].mT
    off = point.offset_mm(seen, goal) - point.offset_mm(true, goal)
    return float(off.norm(dim=1).mean())
