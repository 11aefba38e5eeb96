"""`python -m benchmarks.interlock`: adversarial policies against the interlock and the limits.

Every arm follows, for a few steps at a time and drawn at random, the expert or an adversary: aim at
the other arm, at healthy tissue, at the other arm's base, act on what was observed long ago, drive
every chamber to one end, random numbers, 1e30, infinite, NaN. After every step `Audit` checks what
must never happen, the clearance and contact with FCL and the beam's axis with its own formula.
docs/safety.md has the requirements and the recorded run.
"""

import argparse
import sys
import time
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from surgisoft.agents.on_rig import RigConfig, on_rig
from surgisoft.scene.batched import EXACT_WITHIN_MM
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.collision import CollisionChecker
from surgisoft.tasks.base import Episodes, Task, TaskState
from surgisoft.tasks.registry import TASKS, config_of, make_task, with_fields
from surgisoft.tasks.supervision import BeamlessSupervision

ROUNDING = 1e-4
"""How far a float32 number may exceed a limit, in its unit."""
CLOSE_MM = 2.0
"""Clearance above its limit up to which FCL computes the exact one, mm: further away the batched
one is checked by `agents.exact_checks`."""
EXACT_MM, FIELD_MM = 1e-3, 1.0
"""How far the batched clearance may exceed the exact one, mm: up to 5 mm from a surface, and
beyond, where it is the value of a distance field (docs/results/geometry.md)."""
BLOCK = 6
"""Mean number of steps for which an arm follows one adversary."""
STALE = 12
"""Oldest observation that an adversary acts on, steps."""
EXPERT = 0.75
"""Share of the time in which an arm follows the expert, so that the beam comes on at all."""
WARM = 50
"""Steps in which all arms follow the expert at first: as many until the beam is on."""
TIGHT_MM = 24.0
"""Limit of the clearance in half of the episodes, mm: the expert comes as near as 21 in the
phantom, so that the limit is crossed again and again with the beam on its path."""
STAGES = {"keyhole_ablation": (175, 1.5)}
"""Task -> WARM and TIGHT_MM of its own: arms that enter through ports need longer until the beam is
on, and are never 24 mm from the wall."""
ADVERSARIES = (
    "expert",
    "other arm",
    "healthy tissue",
    "port",
    "stale",
    "random",
    "one end",
    "1e30",
    "infinite",
    "NaN",
)
"""What an arm can follow; `port` is where the other arm enters."""


def laser_tasks() -> list[str]:
    """Names of all tasks of the registry that have a laser."""
    found = (spec.experiment.supervise for spec in TASKS.values())
    return [
        name for name, kind in zip(TASKS, found, strict=True) if kind is not BeamlessSupervision
    ]


class Adversaries:
    """Draws what each arm of each episode follows, and the actions of it."""

    def __init__(
        self, task: Task, count: int, seed: int, without: tuple[str, ...] = (), warm: int = WARM
    ):
        """count: number B of episodes; without: adversaries that are left out; warm: steps of the
        expert at first."""
        self.task, self.rng, self.warm = task, np.random.default_rng(seed), warm
        self.supervision = TASKS[task.name].experiment.supervise(task)
        self.names = [name for name in ADVERSARIES if name not in without]
        self.chosen = {agent: np.zeros(count, int) for agent in task.agents}
        self.old: deque[dict[str, Tensor]] = deque(maxlen=STALE)

    def actions(self, state: TaskState) -> dict[str, Tensor]:
        """Actions of all agents, agent -> (B, m) kPa."""
        expert = self.task.script(state)
        self.old.append(expert)
        if self.warm > 0:
            self.warm -= 1
            return expert
        found = {}
        for agent in self.task.agents:
            chosen = self._drawn(agent)
            action = expert[agent].clone()
            for number, name in enumerate(self.names):
                mask = torch.from_numpy(chosen == number)
                if name != "expert" and mask.any():
                    other = self.old[0][agent] if name == "stale" else self._of(name, agent, state)
                    action = torch.where(mask[:, None], other, action)
            found[agent] = action
        return found

    def _drawn(self, agent: str) -> np.ndarray:
        """(B,) number of what each episode's arm follows now."""
        chosen, rng = self.chosen[agent], self.rng
        weights = np.ones(len(self.names))
        weights[0] = 0.0
        if "NaN" in self.names:  # it ends the episode
            weights[self.names.index("NaN")] = 0.05
        weights *= (1.0 - EXPERT) / weights.sum()
        weights[0] = EXPERT
        fresh = rng.choice(len(self.names), len(chosen), p=weights)
        self.chosen[agent] = np.where(rng.random(len(chosen)) < 1.0 / BLOCK, fresh, chosen)
        return self.chosen[agent]

    def _of(self, name: str, agent: str, state: TaskState) -> Tensor:
        """(B, m) kPa: the action of one adversary."""
        command, rng = state.world.arms[agent].command, self.rng
        shape = tuple(command.shape)
        signs = torch.from_numpy(rng.choice([-1.0, 1.0], shape)).to(command)
        if name == "random":
            return 3.0 * signs * torch.from_numpy(rng.random(shape)).to(command)
        if name == "one end":
            return 100.0 * signs[:, :1].expand(shape)
        if name in ("1e30", "infinite"):
            return signs * (1e30 if name == "1e30" else torch.inf)
        if name == "NaN":
            some = torch.from_numpy(rng.random(shape) < 0.5)
            return torch.where(some, torch.nan, signs)
        others = [part for key, part in state.world.arms.items() if key != agent]
        if name == "other arm" and others:
            aim = others[0].tip_mm
        elif name == "port" and others:
            aim = others[0].points_mm[:, 0]
        else:  # healthy: as far beyond the target again as it is from the middle
            target, _ = self.task.trace(state)
            middle = target.mean(0, keepdim=True)
            aim = middle[:, 0] + 1.8 * (target[:, 0] - middle[:, 0])
            aim = aim + torch.from_numpy(rng.normal(0.0, 4.0, tuple(aim.shape))).to(aim)
        return self.supervision.action_through(agent, state, aim)


@dataclass
class Findings:
    """What an audit has seen."""

    steps: int = 0
    """Steps of single episodes that were checked."""
    fired: int = 0
    """Steps with the beam on."""
    exact: int = 0
    """Of these, steps whose clearance FCL computed."""
    unsafe: Counter = field(default_factory=Counter)
    """Steps that began with each reason to keep the beam off: these are the tests."""
    alone: Counter = field(default_factory=Counter)
    """Steps that began with this reason and no other: without it the beam could have been on."""
    over_mm: float = -np.inf
    """Largest amount by which the clearance by FCL was below its limit with the beam on, mm."""
    failed: int = 0
    """Episodes that ended because a command was no number."""
    broken: list[str] = field(default_factory=list)
    """What must never happen, and did."""

    def joined(self, other: "Findings") -> "Findings":
        """Both together."""
        return Findings(
            self.steps + other.steps,
            self.fired + other.fired,
            self.exact + other.exact,
            self.unsafe + other.unsafe,
            self.alone + other.alone,
            max(self.over_mm, other.over_mm),
            self.failed + other.failed,
            self.broken + other.broken,
        )


class Audit:
    """Checks every step of a task with a laser, in simulation or on rigs."""

    def __init__(self, task: Task, clearance_mm: float | None = None):
        """clearance_mm: the limit where it is stricter than the scene's."""
        self.task, self.found = task, Findings()
        self.supervision = TASKS[task.name].experiment.supervise(task)
        near = task.world.scene
        assert near is not None, "a task with a laser has a scene"
        self.checker, self.radii = CollisionChecker(near.geometry.bodies), near.geometry.radii_mm
        self.lasers = near.lasers
        self.moving = getattr(near, "motion", None) is not None
        self.limit_mm = max(self.supervision.clearance_limit_mm, clearance_mm or -np.inf)
        self.fire_mm = float(task.config.fire_mm)
        self.before: dict[str, Tensor] = {}

    def look(self, state: TaskState) -> None:
        """Keep what decides of a state: the next step may overwrite it."""
        supervision = self.supervision
        parts = state.world.arms
        lasers = [(parts[name], self.task.world.arms[name]) for name in self.lasers]
        along = [arm.backbone.tip_direction(part.seen_mm) for part, arm in lasers]
        every = getattr(self.task, "targets_mm", None)
        targets = [self.task.target_mm(state)] if every is None else every(state)
        self.before = {
            "sight": supervision.in_sight(state).clone(),
            "clearance": supervision.clearance_mm(state).clone(),
            "collides": supervision.collides(state).clone(),
            "failed": state.world.failed.clone(),
            "tip": torch.stack([part.seen_mm[:, -1] for part, _ in lasers], 1),
            "along": torch.stack(along, 1),
            "target": torch.stack(list(targets), 1),
            "energy": state.world.scene.dose.delivered_j.clone(),
            **{f"line {name}": part.line_mm.clone() for name, part in parts.items()},
            **{f"command {name}": _command(part).clone() for name, part in parts.items()},
        }

    def step(self, after: TaskState, live: Tensor) -> None:
        """Check the step from the state that was looked at to this one; live: (B,) bool."""
        before, found = self.before, self.found
        beams = after.goal.fired.reshape(len(live), -1) & live[:, None]  # (B, L)
        fired = beams.any(1)
        reasons = {
            "out of sight": ~before["sight"],
            "too close": ~(before["clearance"] >= self.limit_mm),
            "collision": before["collides"],
            "off the path": ~(self._off_mm() <= self.fire_mm + ROUNDING),
            "failed": before["failed"],
        }
        found.steps += int(live.sum())
        found.fired += int(fired.sum())
        reasons = {name: holds.reshape(len(live), -1) for name, holds in reasons.items()}
        number = sum((holds.int() for holds in reasons.values()), torch.zeros_like(beams).int())
        for name, holds in reasons.items():
            found.unsafe[name] += int((holds.any(1) & live).sum())
            found.alone[name] += int(((holds & (number == 1)).any(1) & live).sum())
            if (holds & beams).any():
                found.broken.append(f"the beam is on: {name}")
        for row in fired.nonzero()[:, 0].tolist():
            self._exact(row)
        burnt = after.world.scene.dose.delivered_j - before["energy"]
        if (burnt[live & ~fired] > 0.0).any():
            found.broken.append("energy reaches the organ with the beam off")
        found.failed += int((after.world.failed & ~before["failed"] & live).sum())
        self._pressures(after, live)

    def _off_mm(self) -> Tensor:
        """(B, L) mm: distance of each target from its beam's axis, |(t - o) x d| / |d|."""
        before = self.before
        gap, along = (before[name].double() for name in ("tip", "along"))
        gap = before["target"].double() - gap
        return torch.linalg.cross(gap, along).norm(dim=-1) / along.norm(dim=-1)

    def _exact(self, row: int) -> None:
        """Contact and clearance of a row with the beam on, by FCL; not where bodies move, which
        the checker holds at rest."""
        if self.moving:
            return
        shapes = {
            name: ArmShape(self.before[f"line {name}"][row].double().numpy(), self.radii[name])
            for name in self.task.world.arms
        }
        if self.checker.collisions(shapes):
            self.found.broken.append("the beam is on: collision by FCL")
        if float(self.before["clearance"][row]) < self.limit_mm + CLOSE_MM:
            self.found.exact += 1
            over_mm = self.limit_mm - self.checker.clearance(shapes).least_mm
            self.found.over_mm = max(self.found.over_mm, over_mm)
            if over_mm > (EXACT_MM if self.limit_mm <= EXACT_WITHIN_MM else FIELD_MM):
                self.found.broken.append("the beam is on: too close by FCL")

    def _pressures(self, after: TaskState, live: Tensor) -> None:
        """Commands within their range, and no faster than the pumps."""
        healthy = live & ~after.world.failed
        for name, part in after.world.arms.items():
            arm, command = self.task.world.arms[name], _command(part)
            low, high = (getattr(arm, end, None) for end in ("lowest", "highest"))
            low = arm.low if low is None else low
            high = arm.high if high is None else high
            off = torch.maximum(low - command, command - high).amax(1)
            rate = (command - self.before[f"command {name}"]).abs().amax(1)
            if not (off[healthy] <= ROUNDING).all():
                self.found.broken.append(f"{name}: a command leaves its range")
            if not (rate[healthy] <= arm.pneumatics.step_kPa + ROUNDING).all():
                self.found.broken.append(f"{name}: a command changes faster than the pumps may")
            if (
                part.plant is None
                and not (
                    torch.maximum(low - part.pressure, part.pressure - high).amax(1)[healthy]
                    <= ROUNDING
                ).all()
            ):
                self.found.broken.append(f"{name}: a pressure leaves its range")


def _command(part) -> Tensor:
    """(B, m) kPa: what is commanded, on a rig what is sent to it."""
    return part.command if part.plant is None else part.plant.target_kPa


@torch.inference_mode()
def attack(
    task: Task,
    count: int,
    steps: int,
    seed: int,
    without: tuple[str, ...] = (),
    warm: int = WARM,
    audit: Audit | None = None,
    base: Task | None = None,
) -> Findings:
    """Roll out `count` episodes under adversaries and audit each step.

    base: the task whose states and expert adversaries use, where `task` wraps it (phases).
    """
    base = base or task
    audit = audit or Audit(base)
    plain = getattr(task, "plain", lambda state: state)
    adversaries = Adversaries(base, count, seed, without, warm)
    episodes = Episodes(task)
    state = episodes.seeded(seed, count)
    live = torch.ones(count, dtype=torch.bool)
    for _ in range(steps):
        audit.look(plain(state))
        actions: Mapping[str, Tensor] = adversaries.actions(plain(state))
        state, outcome = episodes.step(state, actions)
        audit.step(plain(state), live)
        live = live & ~outcome.done
        if not live.any():
            break
    return audit.found


def varied(
    name: str,
    delay: int = 1,
    scene: str | None = None,
    clearance_mm: float | None = None,
    **fields: float,
) -> Task:
    """A task with late actions, noise and displaced mounts: what is measured is not the truth.

    clearance_mm: limit of the clearance in place of the scene's. fields: of the task's config.
    """
    config = with_fields(config_of(name), **fields)
    vary = replace(config.world.randomisation, delay=delay, noise_mm=0.05, mount_mm=0.5, gain=0.02)
    config = replace(with_fields(config, randomisation=vary), fire_mm=1.0)
    task = make_task(name, config if scene is None else with_fields(config, scene=scene))
    if clearance_mm is not None:
        limits = replace(task.spec.limits, clearance_mm=clearance_mm)
        task.spec = replace(task.spec, limits=limits)
    return task


def main() -> int:
    """Parse, attack, print; exit code 1 where something broke."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.interlock", description=__doc__)
    parser.add_argument("--episodes", type=int, default=512, help="episodes in simulation")
    parser.add_argument("--rig-episodes", type=int, default=32, help="episodes on the virtual rig")
    parser.add_argument("--steps", type=int, default=400, help="longest episode, steps")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", choices=laser_tasks(), default=laser_tasks())
    parser.add_argument("--scene", nargs="*", default=[], help="further scenes, folders")
    given = parser.parse_args()
    broken = 0
    columns = ("task", "scene", "plant", "steps", "beam on", "by FCL", "below limit [mm]")
    print("|", " | ".join((*columns, "ended by NaN", "broken", "seconds")), "|")
    print("|---|---|---|---|---|---|---|---|---|---|")
    reasons: Counter = Counter()
    for name in given.only:
        for scene in (None, *given.scene):
            for plant, count in (("simulation", given.episodes), ("rig", given.rig_episodes)):
                began, found = time.perf_counter(), Findings()
                plants = []
                warm, tight_mm = STAGES.get(name, (WARM, TIGHT_MM))
                for limit in (None, tight_mm):
                    task = varied(name, scene=scene, clearance_mm=limit)
                    config = RigConfig(seed=1, settle_s=0.5)
                    plants.append(on_rig(task, config) if plant == "rig" else task)
                batch = 16 if plant == "rig" else 64
                for number, first in enumerate(range(0, count, batch)):
                    moved = plants[number % 2]
                    # A command that is no number ends a run on the virtual rig with an error.
                    without = ("NaN",) if plant == "rig" else ()
                    size = min(batch, count - first)
                    found = found.joined(
                        attack(moved, size, given.steps, given.seed + first, without, warm)
                    )
                reasons += found.unsafe
                broken += len(found.broken)
                seconds = f"{time.perf_counter() - began:.0f}"
                cells = [name, scene or "own", plant, found.steps, found.fired, found.exact]
                cells += [
                    f"{max(found.over_mm, 0.0):.4f}",
                    found.failed,
                    len(found.broken),
                    seconds,
                ]
                print("|", " | ".join(map(str, cells)), "|", flush=True)
                for text, times in Counter(found.broken).items():
                    print(f"broken {times} times: {text}")
    print()
    print("steps that began with a reason to keep the beam off:")
    print(", ".join(f"{name} {count}" for name, count in reasons.most_common()))
    return int(broken > 0)


if __name__ == "__main__":
    sys.exit(main())
