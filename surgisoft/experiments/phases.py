"""Phases, interlock, limits and faults of an experiment, laid over a task that offers them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.experiments.spec import Experiment
from surgisoft.tasks.base import DONE, TaskState
from surgisoft.tasks.episodes.log import EARLY, EpisodeLog
from surgisoft.tasks.episodes.parts import Event
from surgisoft.tasks.registry import MOST_STEPS
from surgisoft.tasks.supervision import Supervision
from surgisoft.tasks.world.random_streams import Stream

RUNNING, CLOSE, LOST, LATE = range(4)
REASONS = ("", "too close", "lesion out of sight", "phase took too long")
"""Reasons of an abort, by number."""


@dataclass(frozen=True, eq=False)
class PhaseState:
    """How far a batch of episodes is."""

    goal: Any
    """The goal of the task itself."""
    phase: Tensor
    """(B,) int64: number of the phase; one more than the last: all are done."""
    since: Tensor
    """(B,) int64: steps in this phase."""
    held: Tensor
    """(B,) int64: steps in a row that its condition has held."""
    lost: Tensor
    """(B,) int64: steps in a row without the lesion in sight, in phases with the beam."""
    reason: Tensor
    """(B,) int64: reason of the abort, see `REASONS`."""
    where: Tensor
    """(B,) int64: phase of the abort."""
    late: Tensor
    """(B,) int64: one more than the number of the last phase that took too long and was followed by
    the next one; 0: none."""


class PhasedTask:
    """A `Task` in the phases of an experiment, with its interlock, limits and faults.

    Observations, rewards and expert are those of the underlying task, so that its policies fit.
    """

    def __init__(self, supervision: Supervision, spec: Experiment):
        self.supervision, self.experiment = supervision, spec
        base = self.base = supervision.task
        self.name, self.agents, self.world = base.name, base.agents, base.world
        self.config: Any = getattr(base, "config", None)
        dt_s, limits, device = base.world.config.dt_s, spec.limits, base.world.device
        self.dt_s, self.steps = dt_s, round(limits.time_s / dt_s)
        if self.steps < 1:
            raise InputError(
                f"limits.time_s is {limits.time_s:g} s, expected at least a step of {dt_s:g} s: "
                "change time_s"
            )
        if self.steps > MOST_STEPS:
            raise InputError(
                f"limits.time_s is {limits.time_s:g} s, more than {MOST_STEPS:,} steps of {dt_s:g} "
                "s; expected a shorter time_s or a longer dt_s of the task"
            )
        self.clear_mm = max(limits.clearance_mm, supervision.clearance_limit_mm)
        """Clearance below which the beam is off: the file's, but not below the scene's (mm)."""
        self.lost_steps = round(limits.view_lost_s / dt_s)
        self.phases, self.conditions = spec.phases, spec.of.experiment.conditions
        names = [phase.name for phase in spec.phases]
        self.retreat = names.index(limits.retreat) if limits.retreat else len(names)

        def row(values, dtype=torch.int64) -> Tensor:
            return torch.tensor([*values, 0], dtype=dtype, device=device)

        self.timeouts = row(max(1, round(p.timeout_s / dt_s)) for p in spec.phases)
        self.holds = row(round(p.hold_s / dt_s) for p in spec.phases)
        self.beam = row((p.beam for p in spec.phases), torch.bool)
        self.timed = row((p.until == "never" for p in spec.phases), torch.bool)
        self.strict = row((p.on_timeout == "abort" for p in spec.phases), torch.bool)
        for fault in spec.faults:
            chambers = self.world.arms[fault.arm].chambers
            if fault.chamber > chambers:
                raise InputError(
                    f"fault: chamber {fault.chamber} of arm '{fault.arm}', expected 1 to {chambers}"
                )

    def plain(self, state: TaskState) -> TaskState:
        """State of the underlying task, without phases."""
        return replace(state, goal=state.goal.goal)

    def goal(self, stream: Stream) -> tuple[Stream, PhaseState]:
        """Draw goals of the underlying task; every episode begins in phase 0."""
        stream, goal = self.base.goal(stream)
        zero = torch.zeros_like(stream.count)
        return stream, PhaseState(goal, zero, zero, zero, zero, zero, zero, zero)

    def in_sight(self, state: TaskState) -> Tensor:
        """(B,) bool: the target is seen well enough to work on it."""
        return self.supervision.in_sight(self.plain(state))

    def safe(self, state: TaskState) -> Tensor:
        """(B,) bool: the target is in sight and everything is clear; else the beam stays off."""
        supervision, plain = self.supervision, self.plain(state)
        clear = supervision.clearance_mm(plain) >= self.clear_mm
        clear = clear & ~supervision.collides(plain)
        return supervision.in_sight(plain) & clear & ~state.world.failed

    def released(self, state: TaskState) -> Tensor:
        """(B,) bool: phase and interlock permit the beam, which is never on otherwise."""
        goal = state.goal
        return self.beam[goal.phase] & (goal.reason == RUNNING) & self.safe(state)

    def advance(self, state: TaskState, actions: Mapping[str, Tensor]) -> TaskState:
        """Advance one step with faults and interlock, then update phases and limits."""
        plain = self.plain(state)
        fired = self.supervision.fires(plain) & self.released(state)
        after = self.supervision.advance(plain, self._with_faults(state, actions), fired)
        return replace(after, goal=self.progressed(state.goal, after))

    def _with_faults(self, state: TaskState, actions: Mapping[str, Tensor]) -> dict[str, Tensor]:
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

    def progressed(self, old: PhaseState, after: TaskState) -> PhaseState:
        """Phases and limits after a step that led to `after`, a state of the underlying task."""
        supervision = self.supervision
        holds = torch.zeros_like(after.world.failed)
        for number, spec in enumerate(self.phases):
            here = old.phase == number
            if here.any():
                known = self.conditions[spec.until]
                within = known.within if spec.within < 0.0 else spec.within
                holds = holds | (here & known.holds(self.base, after, within))
        since, held = old.since + 1, (old.held + 1) * holds
        lost = (old.lost + 1) * (self.beam[old.phase] & ~supervision.in_sight(after))
        met = holds & (held >= self.holds[old.phase])
        late = (since >= self.timeouts[old.phase]) & ~met
        reason = torch.zeros_like(old.reason)
        reason = reason.where(~(late & self.strict[old.phase]), LATE)
        reason = reason.where(lost <= self.lost_steps, LOST)
        least_mm = self.experiment.limits.abort_clearance_mm
        reason = reason.where(supervision.clearance_mm(after) >= least_mm, CLOSE)
        newly = (reason > RUNNING) & (old.reason == RUNNING)
        phase = old.phase + (met | late).long()
        phase = phase.where((old.reason == RUNNING) | (phase == old.phase), len(self.phases))
        phase = phase.where(~newly, self.retreat)
        moved = (phase != old.phase) | newly
        passed = late & ~self.strict[old.phase] & ~self.timed[old.phase] & ~newly
        passed = passed & (old.reason == RUNNING)
        return PhaseState(
            goal=after.goal,
            phase=phase.clamp(max=len(self.phases)),
            since=since * ~moved,
            held=held * ~moved,
            lost=lost,
            reason=reason.where(newly, old.reason),
            where=old.phase.where(newly, old.where),
            late=(old.phase + 1).where(passed, old.late),
        )

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        """The observations of the task beneath."""
        return self.base.observe(self.plain(state))

    def rewards(self, state: TaskState) -> dict[str, dict[str, Tensor]]:
        """The rewards of the task beneath."""
        return self.base.rewards(self.plain(state))

    def ended(self, state: TaskState) -> Tensor:
        """(B,) bool: all phases are done, or something is hit."""
        done = state.goal.phase >= len(self.phases)
        return done | self.supervision.collides(self.plain(state))

    def measures(self, state: TaskState) -> dict[str, Tensor]:
        """The measures of the task beneath; a success also requires that nothing was aborted.

        `beam` is 1 where it was on in the step before, `beam_unsafe` where that step ended unsafe.
        """
        goal, plain = state.goal, self.plain(state)
        values = self.base.measures(plain)
        fired = self.supervision.fired(plain)
        if "pointing_error_mm" in values:  # where the beam has a target: not on the way to rest
            aims = self.beam[goal.phase]
            pointing = values["pointing_error_mm"].where(aims, torch.nan)
            values = values | {"pointing_error_mm": pointing}
        if "success" in values:
            whole = (goal.reason == RUNNING).float()
            values = values | {"success": values["success"] * whole}
        return values | {
            "phase": goal.phase.float(),
            "reason": goal.reason.float(),
            "reason_phase": goal.where.float(),
            "late_phase": goal.late.float(),
            "beam": fired.float(),
            "beam_unsafe": (fired & ~self.safe(state)).float(),
            "safe": self.safe(state).float(),
        }

    def trace(self, state: TaskState) -> tuple[Tensor, Tensor]:
        """Reference and actual points of the underlying task."""
        return self.base.trace(self.plain(state))

    def script(self, state: TaskState) -> dict[str, Tensor]:
        """Action of the underlying task's expert, in any phase."""
        return self.base.script(self.plain(state))


def with_phase_events(spec: Experiment, log: EpisodeLog) -> EpisodeLog:
    """The log of a phased episode with phases, faults and the abort's reason among its events.

    A phase whose time was out before its condition held is a warning. Where the phases ended the
    episode without success, or after an abort, this is said in place of an early end, or of "done".
    """
    phase, reason = (log.measures[name].astype(int) for name in ("phase", "reason"))
    names = [f"phase {phase.name}" for phase in spec.phases] + ["all phases done"]
    begins = [0, *(np.flatnonzero(np.diff(phase)) + 1)]
    late = log.measures.get("late_phase", np.zeros(log.rows)).astype(int)
    found = []
    for row in np.flatnonzero(np.diff(late, prepend=0)):
        found.append(Event(float(log.time_s[row]), "warning", _out_of_time(spec, late[row] - 1)))
    found += [Event(float(log.time_s[row]), "info", names[phase[row]]) for row in begins]
    for row in np.flatnonzero(reason > RUNNING)[:1]:
        text = f"aborted: {REASONS[reason[row]]}"
        found.append(Event(float(log.time_s[row]), "error", text))
    for fault in spec.faults:
        if fault.at_s <= log.time_s[-1]:
            text = f"fault: chamber {fault.chamber} of {fault.arm} goes to 0 kPa"
            found.append(Event(fault.at_s, "warning", text))
    others = log.events
    if phase[-1] == len(spec.phases) and others and others[-1].text == EARLY:
        others = others[:-1]
        found.append(replace(log.events[-1], level="warning", text="ended without success"))
    elif reason[-1] > RUNNING and others and others[-1].text == DONE:
        others = others[:-1]
        found.append(replace(log.events[-1], level="warning", text="ended after the abort"))
    events = sorted((*others, *found), key=lambda event: event.time_s)
    return replace(log, events=tuple(events))


def _out_of_time(spec: Experiment, number: int) -> str:
    """Text of the event that a phase ended by its time."""
    phase = spec.phases[number]
    return f"time out in phase {phase.name}: '{phase.until}' not met in {phase.timeout_s:g} s"
