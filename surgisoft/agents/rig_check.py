"""Checks of an exported controller on the virtual rig, over one whole episode, beside `evaluate`.

Same measurements: the policy drives a robot as `evaluate --on rig` does, and the controller is
given the samples of that episode. Both decide about the same robot at every instant, so that they
differ by rounding alone.

Closed loop: the same robot, with the same history, is driven a second time by the controller, from
its own samples. Rounding now comes back through the robot. Arm models with a direction of pressure
change jump where it reverses, and sensors read in steps, so that a policy may rest beside a
reversal at an unstable equilibrium: a difference grows there from decision to decision, until two
trajectories of the same policy are as far apart as any two can be. The distance between the loops
then says nothing about the controller.

The controller's own loop: where the loops differ, the policy is therefore given the samples of the
controller's loop, and both are compared at every decision of it, with the limits of the same
measurements. If they agree, the controller does what the policy does with commands rounded by no
more than these limits, and the robot makes the rest of the difference.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from itertools import islice
from typing import cast

import numpy as np

from surgisoft.agents.controller import named_tensors
from surgisoft.agents.controller_runner import Controller
from surgisoft.agents.on_rig import BuildRig, RigConfig, named_rig, on_rig
from surgisoft.agents.policies import Policy
from surgisoft.agents.rollout import Instant, rollout
from surgisoft.errors import InputError
from surgisoft.rig import Rig, SimulatedRig
from surgisoft.rig.interface import Sample, Truth, checked_command, is_simulated
from surgisoft.tasks.base import Signal, Task, TaskState

TOLERANCE_MM = 1e-4
"""Largest accepted difference of a coordinate, estimated or true, mm."""
TOLERANCE_KPA = 5e-4
"""Largest accepted difference of a command, kPa. Key points of 100 mm in single precision are
8e-6 mm apart; the direction of a tip, and the policy, make 2e-4 kPa of that. A reading of the
virtual rig's pressure sensors has steps of 0.02 kPa."""


@dataclass(frozen=True)
class Differences:
    """Largest differences over an episode."""

    points_mm: float
    """Of any coordinate of a key point at any decision, mm."""
    commands_kPa: float
    """Of any command, kPa."""

    @property
    def accepted(self) -> bool:
        """Whether both are within `TOLERANCE_MM` and `TOLERANCE_KPA`."""
        return self.points_mm <= TOLERANCE_MM and self.commands_kPa <= TOLERANCE_KPA


@dataclass(frozen=True)
class RigCheck:
    """How far a controller and its policy differ in one episode."""

    same: Differences
    """Given the same measurements: commands, and estimated key points."""
    closed: Differences
    """Each in its own closed loop on the same robot: commands, and true key points."""
    decisions: int
    """Decisions of the episode, without the first."""
    own: Differences | None = None
    """Given the measurements of the controller's own loop: as `same`; None where `closed` is
    accepted, or `same` is not."""

    @property
    def amplified(self) -> bool:
        """Whether the closed loops differ by rounding alone, which the loop amplifies."""
        return self.own is not None and self.own.accepted

    @property
    def passed(self) -> bool:
        """Whether the controller does what the policy does."""
        return self.same.accepted and (self.closed.accepted or self.amplified)


class _LoggedRig:
    """A simulated rig that keeps commands and samples; it has the methods of the rig."""

    def __init__(self, build: BuildRig, config: RigConfig, trial: int):
        rig = build(config, trial)
        if not is_simulated(rig):
            raise InputError(
                "the check drives the rig twice from the same start, which a real rig cannot do; "
                "expected a simulated rig"
            )
        self.rig: SimulatedRig = rig
        self.made = config, trial
        self.commands: list[np.ndarray] = []
        self.samples: list[tuple[Sample, Truth]] = []

    def __getattr__(self, name: str):
        return getattr(self.rig, name)

    def command(self, pressures: np.ndarray) -> None:
        self.commands.append(np.array(pressures))
        self.rig.command(pressures)

    def read_beside_truth(self) -> tuple[Sample, Truth]:
        sample, truth = self.rig.read_beside_truth()
        self.samples.append(deepcopy((sample, truth)))
        return sample, truth


class _PlayedRig:
    """A simulated rig that gives the samples of another drive, whatever it is commanded."""

    def __init__(self, rig: Rig, samples: Sequence[tuple[Sample, Truth]]):
        self.rig, self.samples, self.read = rig, samples, 0

    def __getattr__(self, name: str):
        return getattr(self.rig, name)

    def command(self, pressures: np.ndarray) -> None:
        checked_command(pressures, self.rig.limits, self.rig.unit)

    def read_beside_truth(self) -> tuple[Sample, Truth]:
        """The next sample; after the end of the other drive the last one stays."""
        self.read += 1
        return self.samples[min(self.read, len(self.samples)) - 1]


@dataclass(frozen=True, eq=False)
class DrivenEpisode:
    """Episode 0 of a seed as a policy drove it on virtual rigs, with all that was measured."""

    task: Task
    """The simulated task of the policy."""
    states: list[TaskState]
    """The state at the start and at every decision."""
    rigs: dict[str, _LoggedRig]
    """Arm -> its rig with its commands and samples."""

    @property
    def decisions(self) -> int:
        """Decisions without the first."""
        return len(self.states) - 1

    @property
    def period_s(self) -> float:
        """Time between two samples, s."""
        return next(iter(self.rigs.values())).period_s

    @property
    def samples(self) -> int:
        """Samples between two decisions."""
        return round(self.task.world.config.dt_s / self.period_s)

    @property
    def settled(self) -> int:
        """Samples before the episode began, while the arm was brought to its start."""
        return len(next(iter(self.rigs.values())).commands) - self.samples * self.decisions

    def signals(self, decision: int) -> dict[str, float]:
        """The task's signals at a decision as they are in simulation; 0 is the first one."""
        before = self.states[decision - 1] if decision else None
        signals: tuple[Signal, ...] = getattr(self.task, "signals", ())
        after = self.states[decision]
        return {each.name: float(each.true(self.task, before, after)[0]) for each in signals}

    def commanded(self, row: int) -> dict[str, np.ndarray]:
        """Arm -> pressures (m,) kPa that were in force up to a sample."""
        return {name: rig.commands[row] for name, rig in self.rigs.items()}

    def measured(self, row: int) -> tuple[dict, dict]:
        """Pressures and key points of a sample, by arm."""
        samples = {name: rig.samples[row][0] for name, rig in self.rigs.items()}
        pressures = {name: sample.measured for name, sample in samples.items()}
        return pressures, {name: sample.key_points_mm for name, sample in samples.items()}


def drive(
    task: Task,
    policy: Policy,
    config: RigConfig | None = None,
    seed: int = 0,
    build: BuildRig = named_rig,
) -> DrivenEpisode:
    """Episode 0 of a seed on virtual rigs, driven by a policy as `evaluate --on rig` does."""
    moved = on_rig(task, config or RigConfig(), partial(_LoggedRig, build))
    states: list[TaskState] = []

    def keep(instant: Instant) -> None:
        states.append(instant.state)

    rollout(moved, policy, 1, seed, watch=keep)
    rigs = {name: part.plant.rigs.items[0] for name, part in states[0].world.arms.items()}
    return DrivenEpisode(task, states, rigs)


def same_measurements(
    controller: Controller, episode: DrivenEpisode, most: int | None = None
) -> Differences:
    """Differences of a controller that is given the samples and set points of a driven episode.

    most: number of decisions after which it ends; None: the whole episode.
    """
    first = _prepared(controller, episode)
    for row in range(episode.settled - 1):
        asked = episode.commanded(row)
        controller.observe(*episode.measured(row), asked, episode.period_s, **first)
    asked = episode.commanded(episode.settled - 1)
    start = episode.measured(episode.settled - 1)
    command = _begun(controller, episode, start, asked)
    points, commands = [0.0], [0.0]
    for decision, rows in islice(_decisions(episode), most):
        signals = episode.signals(decision)
        for row in rows:
            asked = episode.commanded(row)
            commands.append(_apart(command, asked, episode))
            command = controller.step(*episode.measured(row), episode.period_s, asked, **signals)
        for name, part in episode.states[decision].world.arms.items():
            off = controller.outputs[f"{name}_estimate_mm"] - part.seen_mm[0].numpy()
            points.append(float(np.abs(off).max()))
    return Differences(float(np.max(points)), float(np.max(commands)))


def closed_loop(
    controller: Controller, episode: DrivenEpisode, build: BuildRig = named_rig
) -> tuple[Differences, dict[str, _LoggedRig]]:
    """Differences of a controller that drives the robot of an episode from its own samples.

    What a task observes of its scene is given to the controller as it was in the episode. Also
    returns the rigs by arm, with what they were commanded and measured.
    """
    rigs = {name: _LoggedRig(build, *rig.made) for name, rig in episode.rigs.items()}
    for rig in rigs.values():
        rig.reset()
    first = _prepared(controller, episode)
    for row in range(episode.settled):
        asked = episode.commanded(row)
        measured = _measured(rigs, asked)
        if row < episode.settled - 1:
            controller.observe(*measured[:2], asked, episode.period_s, **first)
    command = _begun(controller, episode, measured[:2], asked)
    points, commands = [0.0], [0.0]
    for decision, rows in _decisions(episode):
        signals = episode.signals(decision)
        for row in rows:
            commands.append(_apart(command, episode.commanded(row), episode))
            measured = _measured(rigs, _by_arm(command, rigs))
            command = controller.step(*measured[:2], episode.period_s, **signals)
        for name, part in episode.states[decision].world.arms.items():
            pose = part.mount[0].double().numpy()
            true = measured[2][name] @ pose[:3, :3].T + pose[:3, 3]
            points.append(float(np.abs(true - part.points_mm[0].numpy()).max()))
    return Differences(float(np.max(points)), float(np.max(commands))), rigs


def replaying(rigs: Mapping[str, _LoggedRig], build: BuildRig = named_rig) -> BuildRig:
    """What makes rigs that give the samples of a closed loop again (`closed_loop`, `drive`)."""
    samples = {rig.made[1]: rig.samples for rig in rigs.values()}

    def played(config: RigConfig, trial: int) -> Rig:
        rig = build(config, trial)
        return cast(Rig, _PlayedRig(rig, samples[trial])) if trial in samples else rig

    return played


def check_on_rig(
    controller: Controller,
    task: Task,
    policy: Policy,
    config: RigConfig | None = None,
    seed: int = 0,
    build: BuildRig = named_rig,
) -> RigCheck:
    """Compare a controller with its policy in episode 0 of a seed, on virtual rigs.

    task: the simulated task of the policy.
    """
    episode = drive(task, policy, config, seed, build)
    same = same_measurements(controller, episode)
    closed, rigs = closed_loop(controller, episode, build)
    if closed.accepted or not same.accepted:
        return RigCheck(same, closed, episode.decisions)
    beside = drive(task, policy, config, seed, replaying(rigs, build))
    own = same_measurements(controller, beside, episode.decisions)
    return RigCheck(same, closed, episode.decisions, own)


def _prepared(controller: Controller, episode: DrivenEpisode) -> dict[str, float]:
    """Reset the controller, set limits and mounts of an episode; the signals at its start."""
    controller.reset()
    first, rigs = episode.states[0], episode.rigs
    low, high = ({name: rig.limits[:, end] for name, rig in rigs.items()} for end in (0, 1))
    controller.limit(low, high)
    if first.world.out_mm is not None:
        controller.set(out_mm=first.world.out_mm[0].numpy())
    for name, part in first.world.arms.items():
        controller.set(**{f"arms__{name}__mount": part.mount[0].numpy()})
    return episode.signals(0)


def _begun(
    controller: Controller, episode: DrivenEpisode, measured: tuple[dict, dict], asked: dict
):
    """Begin with a sample and the goal of an episode; the pressures to command, kPa."""
    first = episode.states[0]
    goal = {
        name.removeprefix("goal."): value[0].numpy()
        for name, value in named_tensors(first.goal, "goal")
    }
    if first.world.scene.lesion is not None:
        goal["lesion"] = first.world.scene.lesion[0].numpy()
    return controller.begin(*measured, asked, episode.period_s, goal=goal, **episode.signals(0))


def _decisions(episode: DrivenEpisode) -> Iterator[tuple[int, range]]:
    """Number of each decision after the first, and the samples up to it."""
    for number in range(episode.decisions):
        row = episode.settled + number * episode.samples
        yield number + 1, range(row, row + episode.samples)


def _apart(command, asked: dict[str, np.ndarray], episode: DrivenEpisode) -> float:
    """Largest difference of a controller's command from what a policy asked for, kPa."""
    given = _by_arm(command, asked)
    off = [
        np.abs(np.clip(given[name], *rig.limits.T) - asked[name]).max()
        for name, rig in episode.rigs.items()
    ]
    return float(np.max(off))


def _by_arm(command, arms: dict) -> dict[str, np.ndarray]:
    return command if isinstance(command, dict) else dict.fromkeys(arms, command)


def _measured(
    rigs: Mapping[str, _LoggedRig], asked: dict[str, np.ndarray]
) -> tuple[dict, dict, dict]:
    """Pressures, key points and true key points of the next sample, by arm."""
    rows: tuple[dict, dict, dict] = ({}, {}, {})
    for name, rig in rigs.items():
        rig.command(np.clip(asked[name], *rig.limits.T))
        sample, truth = rig.read_beside_truth()
        rows[0][name], rows[1][name] = sample.measured, sample.key_points_mm
        rows[2][name] = truth.noise_free_mm[0]
    return rows
