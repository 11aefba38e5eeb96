"""Who moves each arm in each phase: `Hands` is the driver of a phased episode.

A hand gives one arm's action for the whole batch: (task, agent, state, observations) -> (B, m) kPa.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from surgisoft.agents.policies import Driver, open_driver
from surgisoft.errors import InputError
from surgisoft.experiments.phased import PhasedAblation
from surgisoft.experiments.spec import NOMINAL, DriverSpec, Experiment
from surgisoft.tasks.base import TaskState

Hand = Callable[[PhasedAblation, str, TaskState, dict[str, Tensor]], Tensor]


def hold(task: PhasedAblation, agent: str, state: TaskState, seen) -> Tensor:
    """The command stays as it is."""
    return torch.zeros_like(state.world.arms[agent].command)


def rest(task: PhasedAblation, agent: str, state: TaskState, seen) -> Tensor:
    """Back to the pressures of the start, as fast as the pumps can."""
    return task.world.arms[agent].first - state.world.arms[agent].command


class Schedule:
    """The command follows a CSV file, from the phase's begin."""

    def __init__(self, path: Path, chambers: int):
        """chambers: m of the arm that it moves."""
        from surgisoft.measurement.protocols.schedule_file import load_schedule

        protocol = load_schedule(path)
        if protocol.unit != "kPa" or protocol.chambers != chambers:
            raise InputError(
                f"{path}: {protocol.chambers} commands in {protocol.unit}; expected {chambers} in "
                "kPa, as the arm has chambers"
            )
        if len(protocol.run_rows) > 1:
            raise InputError(f"{path}: {len(protocol.run_rows)} runs; expected one")
        self.times, self.values = _table(protocol.t_s, protocol.commands)

    def __call__(self, task: PhasedAblation, agent: str, state: TaskState, seen) -> Tensor:
        """As for `Hand`."""
        wanted = _between(self.times, self.values, (state.goal.since + 1) * task.dt_s)
        return wanted - state.world.arms[agent].command


class Waypoints:
    """The arm's axis goes through points in space, from the phase's begin."""

    def __init__(self, rows):
        """rows (R, 4): s, then mm in the world frame."""
        table = torch.tensor(rows, dtype=torch.float64)
        self.times, self.values = _table(table[:, 0], table[:, 1:])

    def __call__(self, task: PhasedAblation, agent: str, state: TaskState, seen) -> Tensor:
        """As for `Hand`."""
        target = _between(self.times, self.values, (state.goal.since + 1) * task.dt_s)
        return task.base.aims[agent].action(state.world.arms[agent], target)


class Nominal:
    """The task's solver, that takes the arms to be mounted just where the scene says."""

    def act(
        self, task: PhasedAblation, state: TaskState, observations: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """As for `Driver`."""
        arms = {
            name: replace(part, mount=task.world.arms[name].pose.expand_as(part.mount))
            for name, part in state.world.arms.items()
        }
        return task.script(replace(state, world=replace(state.world, arms=arms)))


class Hands:
    """A `Driver`: each phase's hands, asked only where an episode is in that phase."""

    def __init__(self, spec: Experiment, task: PhasedAblation, policy: str):
        """policy: who acts in phases that say so; a training run must fit the task."""
        self.policy: Driver = Nominal() if policy == NOMINAL else open_driver(policy, task.base)
        self.scripted = open_driver("scripted", task)
        self.own: dict[tuple[str, str], Hand] = {}
        for agent in task.agents:
            chambers = task.world.arms[agent].chambers
            used = {getattr(phase, agent) for phase in spec.phases}
            for driver in spec.drivers:
                if driver.name in used:
                    self.own[agent, driver.name] = _own(driver, chambers)

    @torch.inference_mode()
    def act(
        self, task: PhasedAblation, state: TaskState, observations: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """As for `Driver`."""
        known: dict[str, dict[str, Tensor]] = {}
        actions = {}
        for agent in task.agents:
            chosen = hold(task, agent, state, observations)
            for name in sorted({getattr(phase, agent) for phase in task.phases} - {"hold"}):
                phases = [k for k, p in enumerate(task.phases) if getattr(p, agent) == name]
                here = torch.isin(state.goal.phase, torch.tensor(phases, device=chosen.device))
                if here.any():
                    wanted = self._asked(name, agent, task, state, observations, known)
                    chosen = chosen.where(~here[:, None], wanted)
            actions[agent] = chosen
        return actions

    def _asked(self, name, agent, task, state, observations, known) -> Tensor:
        if name == "rest":
            return rest(task, agent, state, observations)
        if (agent, name) in self.own:
            return self.own[agent, name](task, agent, state, observations)
        name = "scripted" if self.policy == self.scripted else name
        if name not in known:
            driver = self.policy if name == "policy" else self.scripted
            known[name] = driver.act(task, state, observations)
        return known[name][agent]


def _own(driver: DriverSpec, chambers: int) -> Hand:
    if driver.schedule:
        return Schedule(Path(driver.schedule), chambers)
    return Waypoints(driver.waypoints)


def _table(times, values) -> tuple[Tensor, Tensor]:
    return torch.as_tensor(times).double().contiguous(), torch.as_tensor(values).float()


def _between(times: Tensor, values: Tensor, at_s: Tensor) -> Tensor:
    """(B, k) values at times (B,) s: linear between rows (R,), the ends' beyond them."""
    at = at_s.double().clamp(float(times[0]), float(times[-1]))
    above = torch.searchsorted(times, at).clamp(1, max(len(times) - 1, 1))
    if len(times) == 1:
        return values[:1].expand(len(at), -1)
    low, high = times[above - 1], times[above]
    share = ((at - low) / (high - low)).float()[:, None]
    return torch.lerp(values[above - 1], values[above], share)
