"""Check of an exported controller: one episode on the virtual rig, beside that of `evaluate`.

The same robot, with the same history, is driven twice: by the policy inside this package, as
`evaluate --on rig` does, and by the controller from samples alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import cast

import numpy as np

from surgisoft.agents.controller import named_tensors
from surgisoft.agents.controller_runner import Controller
from surgisoft.agents.on_rig import BuildRig, RigConfig, named_rig, on_rig
from surgisoft.agents.policies import Policy
from surgisoft.agents.rollout import Instant, rollout
from surgisoft.errors import InputError
from surgisoft.rig import SimulatedRig
from surgisoft.rig.interface import is_simulated
from surgisoft.tasks.base import Signal, Task, TaskState


@dataclass(frozen=True)
class RigCheck:
    """How far two closed loops on one robot lie apart."""

    points_mm: float
    """Largest distance of any coordinate of a true key point at any decision, mm."""
    commands_kPa: float
    """Largest difference of any command, kPa."""
    decisions: int
    """Decisions of the episode, without the first."""


class _LoggedRig:
    """A simulated rig that keeps its commands; it has the methods and attributes of the rig."""

    def __init__(self, build: BuildRig, config: RigConfig, trial: int):
        rig = build(config, trial)
        if not is_simulated(rig):
            raise InputError(
                "the check drives the rig twice from the same start, which a real rig cannot do; "
                "expected a simulated rig"
            )
        self.rig: SimulatedRig = rig
        self.made = (config, trial)
        self.commands: list[np.ndarray] = []

    def __getattr__(self, name: str):
        return getattr(self.rig, name)

    def command(self, pressures: np.ndarray) -> None:
        self.commands.append(np.array(pressures))
        self.rig.command(pressures)


def check_on_rig(
    controller: Controller,
    task: Task,
    policy: Policy,
    config: RigConfig | None = None,
    seed: int = 0,
    build: BuildRig = named_rig,
) -> RigCheck:
    """Compare a controller with its policy in episode 0 of a seed, on virtual rigs.

    task: the simulated task of the policy. What a task observes of its scene is given to the
    controller as it was in the episode of the policy.
    """
    config = config or RigConfig()
    moved = on_rig(task, config, partial(_LoggedRig, build))
    states: list[TaskState] = []

    def keep(instant: Instant) -> None:
        states.append(instant.state)

    rollout(moved, policy, 1, seed, watch=keep)
    first, decisions = states[0], len(states) - 1
    logged = {name: part.plant.rigs.items[0] for name, part in first.world.arms.items()}
    rigs = {name: cast(SimulatedRig, build(*rig.made)) for name, rig in logged.items()}
    controller.reset()
    _as_started(controller, first, rigs)
    period_s = next(iter(rigs.values())).period_s
    samples = round(task.world.config.dt_s / period_s)
    settled = len(next(iter(logged.values())).commands) - samples * decisions
    for rig in rigs.values():
        rig.reset()
    signals = _signals(task, None, first)
    for number in range(settled):
        asked = {name: rig.commands[number] for name, rig in logged.items()}
        measured = _measured(rigs, asked)
        if number < settled - 1:
            controller.observe(measured[0], measured[1], asked, period_s, **signals)
    goal = {
        name.removeprefix("goal."): value[0].numpy()
        for name, value in named_tensors(first.goal, "goal")
    }
    if first.world.scene.lesion is not None:
        goal["lesion"] = first.world.scene.lesion[0].numpy()
    command = controller.begin(measured[0], measured[1], asked, period_s, goal=goal, **signals)
    points, commands = 0.0, 0.0
    for decision in range(decisions):
        before, after = states[decision], states[decision + 1]
        signals = _signals(task, before, after)
        for sample in range(samples):
            asked = _by_arm(command, rigs)
            row = settled + decision * samples + sample
            for name, rig in logged.items():
                gap = np.abs(np.clip(asked[name], *rig.limits.T) - rig.commands[row]).max()
                commands = max(commands, float(gap))
            measured = _measured(rigs, asked)
            command = controller.step(measured[0], measured[1], period_s, **signals)
        for name, part in after.world.arms.items():
            pose = part.mount[0].double().numpy()
            true = measured[2][name] @ pose[:3, :3].T + pose[:3, 3]
            points = max(points, float(np.abs(true - part.points_mm[0].numpy()).max()))
    return RigCheck(points, commands, decisions)


def _as_started(controller: Controller, first: TaskState, rigs: dict[str, SimulatedRig]) -> None:
    """Set limits and mounts of the episode in the controller's state."""
    low, high = ({name: rig.limits[:, end] for name, rig in rigs.items()} for end in (0, 1))
    controller.limit(low, high)
    if first.world.out_mm is not None:
        controller.set(out_mm=first.world.out_mm[0].numpy())
    for name, part in first.world.arms.items():
        controller.set(**{f"arms__{name}__mount": part.mount[0].numpy()})


def _signals(task: Task, before: TaskState | None, after: TaskState) -> dict[str, float]:
    """The task's signals as they are in simulation."""
    signals: tuple[Signal, ...] = getattr(task, "signals", ())
    return {each.name: float(each.true(task, before, after)[0]) for each in signals}


def _by_arm(command, rigs: dict) -> dict[str, np.ndarray]:
    return command if isinstance(command, dict) else dict.fromkeys(rigs, command)


def _measured(rigs: dict[str, SimulatedRig], asked: dict[str, np.ndarray]) -> tuple[dict, ...]:
    """Pressures, key points and true key points of the next sample, by arm."""
    rows: tuple[dict, dict, dict] = ({}, {}, {})
    for name, rig in rigs.items():
        rig.command(np.clip(asked[name], *rig.limits.T))
        sample, truth = rig.read_beside_truth()
        rows[0][name], rows[1][name] = sample.measured, sample.key_points_mm
        rows[2][name] = truth.noise_free_mm[0]
    return rows
