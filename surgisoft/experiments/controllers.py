"""Who moves each arm in the phases of an experiment: controllers of single arms, and policies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from surgisoft.agents.policies import Policy, open_policy
from surgisoft.errors import InputError
from surgisoft.experiments.phases import PhasedTask
from surgisoft.experiments.spec import NOMINAL, ControllerSpec, Experiment
from surgisoft.measurement.protocols.schedule_file import load_schedule
from surgisoft.tasks.base import Task, TaskState

Controller = Callable[[PhasedTask, str, TaskState], Tensor]
"""(task, agent, state) -> (B, m) kPa: the actions of one arm."""


def hold(task: PhasedTask, agent: str, state: TaskState) -> Tensor:
    """Hold the commanded pressures."""
    return torch.zeros_like(state.world.arms[agent].command)


def rest(task: PhasedTask, agent: str, state: TaskState) -> Tensor:
    """Return to the pressures of the start, as fast as the pumps can."""
    return task.world.arms[agent].first - state.world.arms[agent].command


class Schedule:
    """A controller that follows the pressures of a CSV file, from the phase's begin."""

    def __init__(self, path: Path, chambers: int):
        """Read the CSV file; chambers: number m of chambers of the arm."""
        protocol = load_schedule(path)
        if protocol.unit != "kPa" or protocol.chambers != chambers:
            raise InputError(
                f"{path}: {protocol.chambers} chambers in {protocol.unit}; expected {chambers} in "
                "kPa, those of the arm"
            )
        if len(protocol.run_rows) > 1:
            raise InputError(f"{path}: {len(protocol.run_rows)} runs; expected one")
        self.times, self.values = _table(protocol.t_s, protocol.commands)

    def __call__(self, task: PhasedTask, agent: str, state: TaskState) -> Tensor:
        """The action that leads to the next value, see `Controller`."""
        wanted = interpolated(self.times, self.values, (state.goal.since + 1) * task.dt_s)
        return wanted - state.world.arms[agent].command


class Waypoints:
    """A controller that points the arm's axis through points in space, from the phase's begin."""

    def __init__(self, rows: Sequence[Sequence[float]]):
        """rows (R, 4): s, then mm in the world frame."""
        table = torch.tensor(rows, dtype=torch.float64)
        self.times, self.values = _table(table[:, 0], table[:, 1:])

    def __call__(self, task: PhasedTask, agent: str, state: TaskState) -> Tensor:
        """The action that leads to the next value, see `Controller`."""
        target = interpolated(self.times, self.values, (state.goal.since + 1) * task.dt_s)
        return task.supervision.action_through(agent, task.plain(state), target)


class Nominal:
    """Scripted expert that assumes the nominal mounts of the scene, not the true ones."""

    def act(
        self, task: PhasedTask, state: TaskState, observations: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """Actions of the expert on the state with nominal mounts, see `Policy.act`.

        A feed that has the bases still behind their mounts is known to the expert.
        """
        arms, out_mm = {}, state.world.out_mm
        for name, part in state.world.arms.items():
            pose = task.world.arms[name].pose
            mount = pose.repeat(len(part.mount), 1, 1)
            if out_mm is not None:
                mount[:, :3, 3] -= out_mm[:, None] * pose[:3, 2]
            arms[name] = replace(part, mount=mount)
        return task.script(replace(state, world=replace(state.world, arms=arms)))


class PhaseControllers:
    """A `Policy` that runs, in each episode and for each arm, the controller of the phase."""

    def __init__(self, spec: Experiment, task: PhasedTask, policy: str):
        """policy: acts in phases whose controller is `policy`; a training run must fit the task."""
        self.policy: Nominal | Policy
        self.policy = Nominal() if policy == NOMINAL else open_policy(policy, task.base)
        self.scripted = open_policy("scripted", task)
        self.defined: dict[tuple[str, str], Controller] = {}
        for agent in task.agents:
            chambers = task.world.arms[agent].chambers
            used = {phase.controller(agent) for phase in spec.phases}
            for own in spec.controllers:
                if own.name in used:
                    self.defined[agent, own.name] = _defined(own, chambers)

    @torch.inference_mode()
    def act(
        self, task: Task, state: TaskState, observations: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """Actions of the controllers of the present phases, see `Policy.act`; a `PhasedTask`."""
        assert isinstance(task, PhasedTask)
        known: dict[str, dict[str, Tensor]] = {}
        actions = {}
        for agent in task.agents:
            chosen = hold(task, agent, state)
            for name in sorted({phase.controller(agent) for phase in task.phases} - {"hold"}):
                phases = [k for k, p in enumerate(task.phases) if p.controller(agent) == name]
                here = torch.isin(state.goal.phase, torch.tensor(phases, device=chosen.device))
                if here.any():
                    wanted = self._asked(name, agent, task, state, observations, known)
                    chosen = chosen.where(~here[:, None], wanted)
            actions[agent] = chosen
        return actions

    def _asked(self, name, agent, task, state, observations, known) -> Tensor:
        if name == "rest":
            return rest(task, agent, state)
        if (agent, name) in self.defined:
            return self.defined[agent, name](task, agent, state)
        name = "scripted" if self.policy == self.scripted else name
        if name not in known:
            policy = self.policy if name == "policy" else self.scripted
            known[name] = policy.act(task, state, observations)
        return known[name][agent]


def _defined(spec: ControllerSpec, chambers: int) -> Controller:
    if spec.schedule:
        return Schedule(Path(spec.schedule), chambers)
    return Waypoints(spec.waypoints)


def _table(times, values) -> tuple[Tensor, Tensor]:
    return torch.as_tensor(times).double().contiguous(), torch.as_tensor(values).float()


def interpolated(times: Tensor, values: Tensor, at_s: Tensor) -> Tensor:
    """(B, k) values at times (B,) s: linear between the rows (R,), constant beyond them."""
    at = at_s.double().clamp(float(times[0]), float(times[-1]))
    above = torch.searchsorted(times, at).clamp(1, max(len(times) - 1, 1))
    if len(times) == 1:
        return values[:1].expand(len(at), -1)
    low, high = times[above - 1], times[above]
    share = ((at - low) / (high - low)).float()[:, None]
    return torch.lerp(values[above - 1], values[above], share)
