"""The ablation task in phases, with an interlock: nothing of the world is done anew here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.experiments.conditions import CONDITIONS
from surgisoft.experiments.spec import Experiment
from surgisoft.tasks.base import TaskState
from surgisoft.tasks.circle_ablation import CircleAblation
from surgisoft.tasks.cut import Cut
from surgisoft.tasks.streams import Stream

RUNNING, CLOSE, LOST, LATE = range(4)
REASONS = ("", "too close", "lesion out of sight", "phase took too long")
"""Why an episode was aborted, by number."""


@dataclass(frozen=True, eq=False)
class Progress:
    """How far a batch of episodes is."""

    cut: Cut
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
        return state.world.scenery.view.fraction >= self.base.spec.limits.view_fraction

    def safe(self, state: TaskState) -> Tensor:
        """(B,) bool: the lesion is in sight and everything is clear: else there is no beam."""
        clearance = state.world.scenery.clearance
        clear = (clearance.least_mm >= self.clear_mm) & ~clearance.collides
        return self.in_sight(state) & clear & ~state.world.failed

    def released(self, state: TaskState) -> Tensor:
        """(B,) bool: phase and interlock let the beam on; nothing else can switch it on."""
        goal = state.goal
        return self.beam[goal.phase] & (goal.reason == RUNNING) & self.safe(state)

    def advance(self, state: TaskState, actions: Mapping[str, Tensor], in_place: bool) -> TaskState:
        """As for `Task`."""
        plain = self.plain(state)
        fired = self.base.fires(plain) & self.released(state)
        after = self.base.advance(plain, self._broken(state, actions), in_place, fired)
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
        clearance = after.world.scenery.clearance
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
        return done | state.world.scenery.clearance.collides

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
