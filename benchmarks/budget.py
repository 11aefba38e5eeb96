"""Budget of a training step: what each part must cost on this machine, and what it costs.

What a part must cost follows from its operations and bytes and from three rates that are measured
in the same run: large matrix products, compiled scalar arithmetic, and copies between arrays that
do not fit the caches. A part costs at least the longest of the three times; the sum over the parts
is the least cost of a step (a roofline model, Williams et al. 2009). What a part costs today is
processor time, measured inside of whole training iterations by timers around its calls; a call
inside of another is counted once, where it belongs.

The operations counted are those of the algorithms in use, not of any possible one. Lookups in
trees and grids count the bytes they load.
"""

from __future__ import annotations

import functools
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from rsl_rl.algorithms import PPO
from torch import nn

import surgisoft.agents.ppo as ppo_module
import surgisoft.tasks.world.scene as scene_module
from benchmarks.control.policies import plan_of
from surgisoft.agents.distributed import Processes
from surgisoft.agents.training import Training
from surgisoft.compiled import compiled
from surgisoft.scene.ablation import REACH_WAISTS, AblationMap
from surgisoft.scene.batched import EXACT_WITHIN_MM, BatchedScene
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.collision import CollisionChecker
from surgisoft.surrogate.effects.hysteresis import Hysteresis
from surgisoft.tasks.base import Episodes
from surgisoft.tasks.batched import BatchedEnv
from surgisoft.tasks.registry import make_task
from surgisoft.tasks.world.arm import ModelArm
from surgisoft.tasks.world.scene import SceneEngine

PARTS = (
    "arms",
    "clearance",
    "beam",
    "dose",
    "view",
    "observations",
    "rewards, measures",
    "resets",
    "policies",
    "update",
    "rest of the loop",
)
"""Parts of a training step, in the order of the table."""
TIMED: tuple[tuple[Any, str, str], ...] = (
    (ModelArm, "step", "arms"),
    (ModelArm, "predict", "arms"),
    (BatchedScene, "clearance", "clearance"),
    (SceneEngine, "_aimed", "beam"),
    (scene_module, "seen_from", "view"),
    (AblationMap, "advance", "dose"),
    (AblationMap, "report", "dose"),
    (Episodes, "observe", "observations"),
    (Episodes, "step", "rewards, measures"),
    (Episodes, "reset", "resets"),
    (PPO, "act", "policies"),
    (PPO, "update", "update"),
    (ppo_module, "collect_rollout", "rest of the loop"),
)
"""What is timed: the owner of a function, its name, and the part that its time belongs to."""
WHOLE = ("resets",)
"""Parts whose calls of other parts count as theirs."""
STATES, WALK = 200, 20
"""Random states that are compared with FCL, and steps to them from the beginnings of episodes."""
LEAST_STEPS, LEAST_S = 6_000, 1.5
"""A row is measured over at least so many steps of an episode, or so many seconds."""


@dataclass(frozen=True)
class Rates:
    """What this machine does in a second of one processor."""

    products: float
    """Operations in a float32 matrix product of 2048 x 2048 x 2048."""
    scalar: float
    """Operations of compiled float64 multiply-adds, none of which waits for another."""
    bytes: float
    """Bytes read and written by copying 200 MB."""

    @classmethod
    def measured(cls) -> Rates:
        """The rates now; the best of three."""
        a, long = torch.randn(2048, 2048), torch.randn(25_000_000)
        copy, few = torch.empty_like(long), np.ones(64)
        _multiply_adds(few, 1)
        rounds = 20_000
        return cls(
            _best(lambda: a @ a, 2 * 2048**3),
            _best(lambda: _multiply_adds(few, rounds), 2 * len(few) * rounds),
            _best(lambda: copy.copy_(long), 8 * len(long)),
        )


@compiled
def _multiply_adds(x, rounds):
    """x = 0.999 x + 0.001, `rounds` times."""
    for _ in range(rounds):
        for i in range(len(x)):
            x[i] = 0.999 * x[i] + 0.001


def _best(work: Callable[[], Any], size: float) -> float:
    """`size` by the shortest processor time of three calls of `work`."""
    work()
    spent = []
    for _ in range(3):
        begin = time.process_time()
        work()
        spent.append(time.process_time() - begin)
    return size / max(min(spent), 1e-9)


@dataclass(frozen=True)
class Work:
    """What a part has to do in one step of one episode."""

    products: float = 0.0
    """Operations in matrix products."""
    scalar: float = 0.0
    """Other operations."""
    bytes: float = 0.0
    """Bytes read and written, states and lookups; what stays in registers is left out."""

    def seconds(self, rates: Rates) -> float:
        """The least time of one processor, s."""
        return max(
            self.products / rates.products, self.scalar / rates.scalar, self.bytes / rates.bytes
        )

    def __add__(self, other: Work) -> Work:
        return Work(
            self.products + other.products, self.scalar + other.scalar, self.bytes + other.bytes
        )


FLOAT = 4
"""Bytes of a float32."""
TRILINEAR = Work(scalar=40, bytes=8 * FLOAT)
"""One lookup in a distance field: eight nodes, seven interpolations and the cell."""
CAPSULE = Work(scalar=30)
"""One bound of a ray or segment against a capsule; the exact distance follows only if it is near.
"""
TREE = Work(scalar=2000, bytes=30 * 48)
"""One ray through a tree over 20,000 faces: some thirty boxes and a few triangles."""


def times(work: Work, count: float) -> Work:
    """`count` times the work."""
    return Work(count * work.products, count * work.scalar, count * work.bytes)


def layers(network: nn.Module) -> list[int]:
    """Operations of each linear layer's product for one sample."""
    return [2 * part.weight.numel() for part in network.modules() if isinstance(part, nn.Linear)]


def required(training: Training) -> dict[str, Work]:
    """Part -> what one step of one episode must do, its share of the update included."""
    task, found = training.task, defaultdict(Work)
    world, around = task.world, task.world.scene
    passes = 2 if getattr(getattr(task, "config", None), "one_step_prediction", False) else 1
    for arm in world.arms.values():
        found["arms"] += times(_arm_work(arm), passes)
    engine = isinstance(around, SceneEngine)
    if around is not None:
        bodies, arms = len(around.geometry.bodies), len(world.arms)
        segments = world.config.samples + (1 if engine else 0)
        found["clearance"] += times(TRILINEAR, segments * bodies * arms)
        found["clearance"] += times(CAPSULE, segments**2 * arms * (arms - 1) / 2)
        found["clearance"] += times(CAPSULE, segments**2 / 2 * arms)
    if engine:
        # Points outside of the picture need no line of sight.
        views = training.env.state.world.scene.views.values()
        rays = sum((v.visible | v.hidden).float().sum(1).mean().item() for v in views)
        blocking = times(CAPSULE, segments * arms)
        found["beam"] += times(TREE + blocking, len(around.lasers))
        found["view"] += times(TREE, rays) + times(blocking, rays)
        lit = samples_lit(around.ablation)
        found["dose"] += Work(scalar=60 * lit, bytes=lit * (7 * 8 + 3 * FLOAT))
        found["dose"] += Work(
            scalar=4 * around.ablation.patch.stations, bytes=FLOAT * around.ablation.patch.stations
        )
    preset = training.plan.preset
    for agent, ppo in training.agents.items():
        width = training.seen[agent].shape[1]
        found["observations"] += Work(scalar=4 * width, bytes=2 * FLOAT * width)
        found["rewards, measures"] += Work(scalar=100, bytes=40 * FLOAT)
        state = sum(p.numel() for net in (ppo.actor, ppo.critic) for p in net.parameters())
        samples = preset.envs * preset.rollout / preset.batches
        for network in (ppo.actor, ppo.critic):
            each = layers(network)
            hidden = sum(preset.hidden)
            found["policies"] += Work(sum(each), 10 * hidden, FLOAT * (width + hidden))
            # Forward, and backward by weights and by inputs, of which the first layer needs none.
            found["update"] += Work(
                preset.epochs * (3 * sum(each) - each[0]),
                preset.epochs * 20 * hidden,
                preset.epochs * FLOAT * (2 * width + 6 * hidden),
            )
        # Adam reads weight, gradient and two moments and writes three of them.
        found["update"] += Work(
            scalar=preset.epochs * 15 * state / samples,
            bytes=preset.epochs * 7 * FLOAT * state / samples,
        )
    return dict(found)


def _arm_work(arm: ModelArm) -> Work:
    """One evaluation of an arm: memories, network, frames and backbone."""
    found = Work(sum(layers(arm.model.network)))
    hidden = sum(getattr(arm.model.network, "hidden", ()))
    found += Work(scalar=15 * hidden, bytes=2 * FLOAT * hidden)
    for effect in arm.model.effects.values():
        if isinstance(effect, Hysteresis):
            plays = len(effect.linear) * len(effect.radii)
            found += Work(scalar=plays * (4 + 4 * arm.chambers), bytes=2 * FLOAT * plays)
    points = arm.backbone.position.shape[0]
    found += Work(scalar=6 * points * arm.key_points + 20 * arm.key_points)
    return found + Work(bytes=2 * FLOAT * (3 * points + 6 * arm.key_points + 12 * arm.chambers))


def samples_lit(ablation: AblationMap) -> float:
    """Samples that the beam lights at once."""
    patch = ablation.patch
    return np.pi * (REACH_WAISTS * ablation.waist_mm) ** 2 / float(np.mean(patch.areas_mm2))


class Timers:
    """Processor time of parts; a call inside of another takes its time out of the outer one."""

    def __init__(self):
        self.spent: dict[str, float] = defaultdict(float)
        self._stack: list[str] = []
        self._last = 0.0

    def _charge(self) -> None:
        now = time.process_time()
        if self._stack:
            self.spent[self._stack[-1]] += now - self._last
        self._last = now

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Count the time inside as the part's, unless a part that keeps its calls is running."""
        if any(outer in WHOLE for outer in self._stack):
            yield
            return
        self._charge()
        self._stack.append(name)
        try:
            yield
        finally:
            self._charge()
            self._stack.pop()

    @contextmanager
    def attached(self) -> Iterator[None]:
        """Timers around the functions of `TIMED`."""
        kept = [(owner, name, getattr(owner, name)) for owner, name, _ in TIMED]
        try:
            for owner, name, part in TIMED:
                setattr(owner, name, self._timed(getattr(owner, name), part))
            yield
        finally:
            for owner, name, function in kept:
                setattr(owner, name, function)

    def _timed(self, function: Callable, part: str) -> Callable:
        @functools.wraps(function)
        def call(*args, **more):
            with self.part(part):
                return function(*args, **more)

        return call


@dataclass(frozen=True)
class Row:
    """One task with one number of parallel episodes."""

    task: str
    """Name of the task."""
    envs: int
    """Parallel episodes."""
    must: dict[str, float]
    """Part -> least cost of a step, s."""
    spent: dict[str, float]
    """Part -> cost of a step, s."""
    products: float
    """Least cost of the matrix products of a step of the world alone, s."""

    @property
    def world(self) -> float:
        """Cost of a step of the world: all but policies, update and the loop, s."""
        out = ("policies", "update", "rest of the loop")
        return sum(value for part, value in self.spent.items() if part not in out)


def measured(task_name: str, envs: int) -> Row:
    """Measure training iterations of a task with so many episodes."""
    plan = plan_of(task_name, 1)
    own = plan.preset
    batches = max(1, min(own.batches, envs * own.rollout // 2))
    plan = replace(plan, preset=replace(own, envs=envs, batches=batches))
    training = Training(plan, make_task(task_name, plan.task_config), Processes())
    training.iterate()
    timers, steps, begin = Timers(), 0, time.process_time()
    size, rates = envs * own.rollout, Rates.measured()
    with timers.attached():
        import surgisoft.agents.training as loop

        kept, loop.collect_rollout = loop.collect_rollout, ppo_module.collect_rollout
        try:
            while steps < LEAST_STEPS and (not steps or time.process_time() - begin < LEAST_S):
                training.iterate()
                steps += size
            while steps < 2 * size:
                training.iterate()
                steps += size
        finally:
            loop.collect_rollout = kept
    work = required(training)
    must = {part: work[part].seconds(rates) for part in PARTS if part in work}
    spent = {part: timers.spent[part] / steps for part in PARTS if timers.spent[part] > 0.0}
    products = work["arms"].products / rates.products
    return Row(task_name, envs, must, spent, products)


@dataclass(frozen=True)
class AgainstFcl:
    """How far the batched geometry, whose speed is measured, is from FCL in random states."""

    states: int
    """Number of states."""
    near: int
    """States in which something is nearer than `EXACT_WITHIN_MM`, or touches."""
    clearance_off_mm: float
    """Largest difference of the least clearance in those states, mm."""
    far_off_mm: float
    """The same in the others, where the batched geometry interpolates in a field."""
    contact_differs: int
    """States in which only one of the two finds an overlap."""
    beams: int
    """Number of beams."""
    beam_off_mm: float
    """Largest distance between both ends of a beam that meets the same thing, mm."""
    beam_differs: int
    """Beams that meet another thing."""

    @property
    def line(self) -> str:
        """The result in one line."""
        found = (
            f"Against FCL in {self.states} random states: clearance at most "
            f"{self.clearance_off_mm:.2g} mm off in the {self.near} states nearer than "
            f"{EXACT_WITHIN_MM:g} mm and {self.far_off_mm:.2g} mm in the others, "
            f"contact differs in {self.contact_differs}"
        )
        if self.beams:
            found += (
                f"; end of the beam at most {self.beam_off_mm:.2g} mm off, what it meets differs "
                f"in {self.beam_differs} of {self.beams}"
            )
        return found + "."


def against_fcl(task_name: str, states: int = STATES, seed: int = 0) -> AgainstFcl | None:
    """Compare clearance, contact and beams of random states with FCL; None without a scene.

    Each of the episodes holds a random change of pressure for `WALK` steps, which are of different
    parts of an episode.
    """
    task = make_task(task_name)
    around = task.world.scene
    if around is None:
        return None
    env, draw = BatchedEnv(task, states, seed, spread=True), torch.Generator().manual_seed(seed)
    held = {
        agent: env.action_limits_kPa[agent] * (2.0 * torch.rand(states, size, generator=draw) - 1.0)
        for agent, size in env.action_sizes.items()
    }
    for _ in range(WALK):
        env.step(held)
    world = env.state.world
    scene = world.scene
    clearance, exact = scene.clearance, CollisionChecker(around.geometry.bodies)
    engine = around if isinstance(around, SceneEngine) else None
    placement = engine.placement(scene.breaths) if engine else None
    lines = {name: part.line_mm.double().numpy() for name, part in world.arms.items()}
    least, touches = clearance.least_mm.numpy(), clearance.collides.numpy()
    off, far_off, near, contacts = 0.0, 0.0, 0, 0
    beam_off, beam_differs = 0.0, 0
    for n in range(states):
        checker = exact if placement is None else exact.moved(placement, n)
        arms = {
            name: ArmShape(line[n], around.geometry.radius_mm(name)) for name, line in lines.items()
        }
        contacts += bool(checker.collisions(arms)) != bool(touches[n])
        away = checker.clearance(arms).least_mm
        if min(away, least[n]) < EXACT_WITHIN_MM:
            near += 1
            off = max(off, abs(away - float(least[n])))
        else:
            far_off = max(far_off, abs(min(away, exact.horizon_mm) - float(least[n])))
        for laser, hit in scene.hits.items():
            beam = world.arms[laser]
            place = (beam.tip_mm[n].double().numpy(), beam.tip_direction[n].double().numpy())
            end = checker.cast(*place, engine.beam_mm, arms, own=laser)
            if int(end.struck) != int(hit.struck[n]):
                beam_differs += 1
            else:
                apart = np.asarray(end.point_mm) - hit.point_mm[n].double().numpy()
                beam_off = max(beam_off, float(np.linalg.norm(apart)))
    beams = states * len(scene.hits)
    return AgainstFcl(states, near, off, far_off, contacts, beams, beam_off, beam_differs)


def markdown(
    rows: list[Row], rates: Rates, exact: dict[str, AgainstFcl | None] | None = None
) -> str:
    """The tables of `docs/results/speed.md`; exact: task -> its error against FCL."""
    lines = [
        f"One processor: matrix products {rates.products / 1e9:.0f} Gop/s, compiled scalar "
        f"arithmetic {rates.scalar / 1e9:.1f} Gop/s, copies {rates.bytes / 1e9:.1f} GB/s (each row "
        "uses the rates measured just before it). Microseconds of one processor for one step of "
        "one episode: least / measured.",
        "",
    ]
    for task in dict.fromkeys(row.task for row in rows):
        some = [row for row in rows if row.task == task]
        lines += [
            f"## {task}",
            "",
            *([found.line, ""] if (found := (exact or {}).get(task)) else []),
            "| part | " + " | ".join(f"{row.envs:,} envs" for row in some) + " |",
            "|---|" + "---|" * len(some),
        ]
        for part in PARTS:
            if any(part in row.spent for row in some):
                cells = [
                    f"{1e6 * row.must.get(part, 0.0):.2f} / {1e6 * row.spent.get(part, 0.0):.2f}"
                    for row in some
                ]
                lines.append(f"| {part} | " + " | ".join(cells) + " |")
        sums = [(sum(row.must.values()), sum(row.spent.values())) for row in some]
        lines += [
            "| **whole step** | " + " | ".join(f"{1e6 * m:.2f} / {1e6 * s:.2f}" for m, s in sums),
            "| share of the least cost | " + " | ".join(f"{m / s:.0%}" for m, s in sums),
            "| training steps/s, one processor | " + " | ".join(f"{1 / s:,.0f}" for _, s in sums),
            "| world steps/s, one processor | "
            + " | ".join(f"{1 / row.world:,.0f}" for row in some),
            "| world: share of the matrix-product limit | "
            + " | ".join(f"{row.products / row.world:.0%}" for row in some),
            "",
        ]
        lines = [
            line + " |" if line.startswith("|") and not line.endswith("|") else line
            for line in lines
        ]
    return "\n".join(lines)


def run(
    tasks: list[str], envs: list[int], report: Callable[..., None] | None = None
) -> tuple[list[Row], Rates]:
    """Measure all tasks with all numbers of episodes, on one thread."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        rates, rows, places = Rates.measured(), [], [(t, n) for t in tasks for n in envs]
        for number, (task, count) in enumerate(places):
            if report:
                report(number, len(places), f"{task}, {count} envs")
            rows.append(measured(task, count))
    finally:
        torch.set_num_threads(before)
    return rows, rates


if __name__ == "__main__":
    import sys

    names = sys.argv[1].split(",")
    found = run(names, [int(n) for n in sys.argv[2].split(",")])
    print(markdown(*found, {name: against_fcl(name) for name in names}))
