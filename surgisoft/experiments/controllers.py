"""The ablation task in phases, with an interlock: nothing of the world is done anew here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from surgisoft.agents.policies import Driver, open_driver
from surgisoft.errors import InputError
from surgisoft.experiments.conditions import CONDITIONS
from surgisoft.experiments.spec import NOMINAL, DriverSpec, Experiment
from surgisoft.tasks.base import TaskState
from surgisoft.tasks.circle_ablation import CircleAblation
from surgisoft.tasks.trajectories.closed_path import RingCut
from surgisoft.tasks.world.random_streams import Stream

RUNNING, CLOSE, LOST, LATE = range(4)
REASONS = ("", "too close", "lesion out of sight", "phase took too long")
"""Why an episode was aborted, by number."""


@dataclass(frozen=True, eq=False)
class Progress:
    """How far a batch of episodes is."""

    cut: RingCut
    """How far the cut is."""
    phase: Tensor
    """(B,) int64: number of the phase; one more than the last: all are done."""
    since: Tensor
    """(B,) int64: steps in this phase."""
    held: Tensor
    """(B,) int64: steps in a row that its condition has held."""
    lost: Tensor
    """(B,) int64: steps in a row without the lesion in sight, in phases with the beam."""
    reason: Tensor
    """(B,) int64: why it was aborted, see `REASONS`."""
    where: Tensor
    """(B,) int64: the phase in which it was aborted."""


class PhasedAblation:
    """A `Task`: circle ablation whose phases, limits and faults an experiment gives."""

    def __init__(self, base: CircleAblation, spec: Experiment):
        """`base` may be on the rig."""
        self.base, self.experiment = base, spec
        self.name, self.agents, self.world, self.config = (
            base.name,
            base.agents,
            base.world,
            base.config,
        )
        dt_s, limits, device = base.world.config.dt_s, spec.limits, base.world.device
        self.dt_s, self.steps = dt_s, round(limits.time_s / dt_s)
        self.clear_mm = max(limits.clearance_mm, base.spec.limits.clearance_mm)
        self.lost_steps = round(limits.view_lost_s / dt_s)
        self.phases = spec.phases
        names = [phase.name for phase in spec.phases]
        self.retreat = names.index(limits.retreat) if limits.retreat else len(names)

        def row(values, dtype=torch.int64) -> Tensor:
            return torch.tensor([*values, 0], dtype=dtype, device=device)

        self.timeouts = row(max(1, round(p.timeout_s / dt_s)) for p in spec.phases)
        self.holds = row(round(p.hold_s / dt_s) for p in spec.phases)
        self.beam = row((p.beam for p in spec.phases), torch.bool)
        self.strict = row((p.on_timeout == "abort" for p in spec.phases), torch.bool)
        for fault in spec.faults:
            chambers = self.world.arms[fault.arm].chambers
            if fault.chamber > chambers:
                raise InputError(
                    f"fault: chamber {fault.chamber} of arm '{fault.arm}', expected 1 to {chambers}"
                )

    def plain(self, state: TaskState) -> TaskState:
        """The state as the ablation task knows it."""
        return replace(state, goal=state.goal.cut)

    def goal(self, stream: Stream) -> tuple[Stream, Progress]:
        """As for `Task`."""
        stream, cut = self.base.goal(stream)
        zero = torch.zeros_like(stream.count)
        return stream, Progress(cut, zero, zero, zero, zero, zero, zero)

    def in_sight(self, state: TaskState) -> Tensor:
        """(B,) bool: the endoscope sees as much of the ring as the scene asks for."""
        return state.world.scene.view.fraction >= self.base.spec.limits.view_fraction

    def safe(self, state: TaskState) -> Tensor:
        """(B,) bool: the lesion is in sight and everything is clear: else there is no beam."""
        clearance = state.world.scene.clearance
        clear = (clearance.least_mm >= self.clear_mm) & ~clearance.collides
        return self.in_sight(state) & clear & ~state.world.failed

    def released(self, state: TaskState) -> Tensor:
        """(B,) bool: phase and interlock let the beam on; nothing else can switch it on."""
        goal = state.goal
        return self.beam[goal.phase] & (goal.reason == RUNNING) & self.safe(state)

    def advance(self, state: TaskState, actions: Mapping[str, Tensor]) -> TaskState:
        """As for `Task`."""
        plain = self.plain(state)
        fired = self.base.fires(plain) & self.released(state)
        after = self.base.advance(plain, self._broken(state, actions), fired)
        return replace(after, goal=self._further(state.goal, after))

    def _broken(self, state: TaskState, actions: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """The actions after the faults: a chamber whose valve stays open goes to 0 kPa."""
        done = dict(actions)
        for fault in self.experiment.faults:
            place = fault.chamber - 1
            broken = state.world.steps * self.dt_s >= fault.at_s - 1e-6
            venting = -state.world.arms[fault.arm].command[:, place]
            action = done[fault.arm].clone()
            action[:, place] = action[:, place].where(~broken, venting)
            done[fault.arm] = action
        return done

    def _further(self, old: Progress, after: TaskState) -> Progress:
        """Phases and limits a step later; `after` has the cut as its goal."""
        clearance = after.world.scene.clearance
        holds = torch.zeros_like(after.world.failed)
        for number, phase in enumerate(self.phases):
            here = old.phase == number
            if here.any():
                known = CONDITIONS[phase.until]
                within = known.within if phase.within < 0.0 else phase.within
                holds = holds | (here & known.holds(self.base, after, within))
        since, held = old.since + 1, (old.held + 1) * holds
        lost = (old.lost + 1) * (self.beam[old.phase] & ~self.in_sight(after))
        met = holds & (held >= self.holds[old.phase])
        late = (since >= self.timeouts[old.phase]) & ~met
        reason = torch.zeros_like(old.reason)
        reason = reason.where(~(late & self.strict[old.phase]), LATE)
        reason = reason.where(lost <= self.lost_steps, LOST)
        reason = reason.where(
            clearance.least_mm >= self.experiment.limits.abort_clearance_mm, CLOSE
        )
        newly = (reason > RUNNING) & (old.reason == RUNNING)
        phase = old.phase + (met | late).long()
        phase = phase.where((old.reason == RUNNING) | (phase == old.phase), len(self.phases))
        phase = phase.where(~newly, self.retreat)
        moved = (phase != old.phase) | newly
        return Progress(
            cut=after.goal,
            phase=phase.clamp(max=len(self.phases)),
            since=since * ~moved,
            held=held * ~moved,
            lost=lost,
            reason=reason.where(newly, old.reason),
            where=old.phase.where(newly, old.where),
        )

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        """As the ablation task does, so that its policies fit."""
        return self.base.observe(self.plain(state))

    def rewards(self, state: TaskState) -> dict[str, dict[str, Tensor]]:
        """The ablation task's."""
        return self.base.rewards(self.plain(state))

    def ended(self, state: TaskState) -> Tensor:
        """(B,) bool: all phases are done, or something is hit."""
        done = state.goal.phase >= len(self.phases)
        return done | state.world.scene.clearance.collides

    def measures(self, state: TaskState) -> dict[str, Tensor]:
        """The ablation task's; success asks besides that nothing was aborted.

        `beam` is 1 where it burnt in the step before, `beam_unsafe` where that step ended unsafe.
        """
        goal, plain = state.goal, self.plain(state)
        values = self.base.measures(plain)
        fired = goal.cut.fired
        return values | {
            "success": values["success"] * (goal.reason == RUNNING),
            "phase": goal.phase.float(),
            "reason": goal.reason.float(),
            "reason_phase": goal.where.float(),
            "beam": fired.float(),
            "beam_unsafe": (fired & ~self.safe(state)).float(),
            "safe": self.safe(state).float(),
        }

    def trace(self, state: TaskState) -> tuple[Tensor, Tensor]:
        """As for `Task`."""
        return self.base.trace(self.plain(state))

    def script(self, state: TaskState) -> dict[str, Tensor]:
        """The ablation task's solver, whatever the phase."""
        return self.base.script(self.plain(state))


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
        return task.base.pointing[agent].action(state.world.arms[agent], target)


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
