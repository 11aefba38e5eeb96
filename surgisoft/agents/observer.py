"""The observer: an estimate of an arm's body and of its pumps from what a rig measures.

The arm's model runs beside the rig, driven by the measured pressures, and its output is corrected
by an output disturbance, as in offset-free model predictive control (Pannocchia & Rawlings 2003).
The disturbance is learned while the arm moves (`tasks.world.adaptation`), or filtered with one gain
for all key points. Tasks on a rig and exported controllers use the same observer.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.scene import frames
from surgisoft.tasks.world.adaptation import Adaptation, DisturbanceEstimator
from surgisoft.tasks.world.arm import ArmPart, ModelArm
from surgisoft.tasks.world.observer import AlphaBetaFilter


@dataclass(frozen=True)
class ObserverGains:
    """How much of a measurement the estimate adopts in a step of a task."""

    cameras: bool = True
    """Whether cameras measure the key points; else the model alone estimates them."""
    observer_gain: float = 0.3
    """Share of the innovation (cameras minus estimate) that the estimate adopts in a step, 0..1:
    the alpha of an alpha-beta filter. A value other than the default asks for that filter."""
    drift_gain: float = 0.01
    """Share of the innovation that is added to the disturbance's rate, 0..1: the filter's beta."""
    pump_gain: float = 0.3
    """Share of the difference between measured and expected pressure that the estimated offset of
    the pumps adopts in a step, 0..1."""
    adapts: bool | None = None
    """Whether the disturbance is learned online instead of filtered with one gain; None: unless the
    gain or the drift gain differs from its default."""

    @property
    def adapting(self) -> bool:
        """Whether the disturbance is learned online."""
        if self.adapts is not None:
            return self.cameras and self.adapts
        usual = type(self).observer_gain, type(self).drift_gain
        return self.cameras and (self.observer_gain, self.drift_gain) == usual

    def __post_init__(self):
        for name in ("observer_gain", "drift_gain", "pump_gain"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise InputError(f"rig: {name} is {getattr(self, name)}, expected 0 to 1")


class Order(NamedTuple):
    """Commands to the pumps for one step of a task."""

    target_kPa: Tensor
    """(B, m) kPa: pressures to command."""
    shift_kPa: Tensor
    """(B, m) kPa: estimated offset of the pumps when the action was chosen."""
    expected_kPa: Tensor
    """(B, m) kPa: pressures expected at the end of the step."""


class Lesson(NamedTuple):
    """What one sample teaches of the disturbance of B arms; all in the world frame."""

    now_mm: Tensor
    """(B, n, 3) mm: the disturbance."""
    lead_mm: Tensor
    """(B, n, 3) mm: `ArmPart.lead_mm`."""
    offset_mm: Tensor
    """(B, n, 3) mm: the disturbance that is expected in the next step."""
    memory: Adaptation
    """What is known then."""


class Observer:
    """Estimates one arm from measurements; a function of its arguments, batched, differentiable.

    `ArmPart.plant` has to be a dataclass with `target_kPa` (B, m) kPa, the pressures that were
    commanded last, `drift_mm` (B, n, 3) mm, world frame, by how much the output disturbance grows
    in a step, and `adaptation`, what was learned of it, as from `memory`. `part.command` is the
    command after which a pump of the simulated arm would give what the rig's pump gives: the two
    differ by an offset, which is estimated here.
    """

    def __init__(
        self, arm: ModelArm, gains: ObserverGains, dt_s: float, lowest: Tensor, highest: Tensor
    ):
        """dt_s: time of a step of the task, s; lowest, highest: (m,) kPa, limits of a command."""
        self.arm, self.gains, self.dt_s = arm, gains, dt_s
        self.lowest, self.highest = lowest, highest
        self.filter = AlphaBetaFilter(gains.observer_gain, gains.drift_gain)
        self.learner = None
        if gains.adapting:
            self.learner = DisturbanceEstimator(arm.model, dt_s, device=arm.device)

    def memory(self, count: int) -> Adaptation | None:
        """Prior of the disturbance of `count` arms, before the first measurement."""
        return None if self.learner is None else self.learner.start(count)

    def no_lead(self, points_mm: Tensor) -> Tensor | None:
        """`ArmPart.lead_mm` of arms with key points (B, n, 3) mm before the first measurement."""
        return None if self.learner is None else torch.zeros_like(points_mm)

    def followed(self, part: ArmPart, pressure: Tensor, dt_s: Tensor | float) -> ArmPart:
        """The model after pressures (B, m) kPa were measured dt_s after the sample before."""
        model, points = self.arm.bent(part, pressure, dt_s)
        return replace(part, arm=model, points_mm=points, pressure=pressure)

    def order(
        self,
        part: ArmPart,
        action: Tensor,
        lowest: Tensor | None = None,
        highest: Tensor | None = None,
    ) -> Order:
        """Commands for changes of pressure (B, m) kPa, and the predicted result.

        lowest, highest: (B, m) kPa, other limits of a command than those of the observer.
        """
        pump, target = self.arm.pneumatics, part.plant.target_kPa.to(action)
        shift = part.command - target
        low = self.lowest if lowest is None else lowest
        high = self.highest if highest is None else highest
        target = pump.command(target, action, low, high)
        return Order(target, shift, pump.follow(part.pressure, target + shift, self.dt_s))

    def lesson(self, part: ArmPart, pressure: Tensor, points_mm: Tensor) -> Lesson | None:
        """What a sample teaches of the disturbance; the arguments are those of `begun`.

        `begun`, `stepped` and `learned` find it themselves. Whoever calls several of them with one
        sample, as a graph of all branches does, gives it to each. None for a filter.
        """
        if self.learner is None:
            return None
        turn = part.mount[:, :3, :3]
        off = (frames.apply(part.mount, points_mm) - part.points_mm) @ turn
        body = (part.points_mm - part.mount[:, None, :3, 3]) @ turn
        found = self.learner.updated(part.plant.adaptation, off, pressure, body)
        now, lead, offset = (
            each @ turn.mT for each in (found.now_mm, found.lead_mm, found.next_mm)
        )
        return Lesson(now, lead, offset, found.memory)

    def begun(
        self, part: ArmPart, pressure: Tensor, points_mm: Tensor, lesson: Lesson | None = None
    ) -> ArmPart:
        """The part at the begin of an episode, of which the last sample was measured just now.

        pressure: (B, m) kPa; points_mm: (B, n, 3) mm, base frame, nan where one was lost; lesson:
        that of this sample where it is known already. The whole first innovation is taken over.
        """
        part = replace(part, command=pressure)
        return self._seen(part, pressure, points_mm, lesson, begins=True)

    def stepped(
        self,
        part: ArmPart,
        order: Order,
        pressure: Tensor,
        points_mm: Tensor,
        lesson: Lesson | None = None,
    ) -> ArmPart:
        """The part at the end of a step, whose last sample was measured just now.

        order: what was asked for the step; the other arguments are those of `begun`.
        """
        surprise = (pressure - order.expected_kPa) / self.arm.pneumatics.share(self.dt_s)
        shift = order.shift_kPa + self.gains.pump_gain * surprise
        part = replace(part, command=order.target_kPa + shift)
        return self._seen(part, pressure, points_mm, lesson)

    def learned(
        self, part: ArmPart, pressure: Tensor, points_mm: Tensor, lesson: Lesson | None = None
    ) -> ArmPart:
        """The part before the episode, after a sample; the arguments are those of `begun`.

        Call it once in each step of a task while the arm is brought to its start, so that the
        disturbance is known when the episode begins. A filter has nothing to learn from that.
        """
        lesson = lesson or self.lesson(part, pressure, points_mm)
        return part if lesson is None else _taught(part, lesson)

    def _seen(
        self,
        part: ArmPart,
        pressure: Tensor,
        points_mm: Tensor,
        lesson: Lesson | None,
        begins: bool = False,
    ) -> ArmPart:
        """The part as estimated; its key points so far are the model's.

        By how much the body lies off the model is learned, or estimated by an alpha-beta filter
        (Kalata 1984), which follows a steady drift without lag.
        """
        seen, offset, plant = part.points_mm, part.offset_mm, part.plant
        lesson = lesson or self.lesson(part, pressure, points_mm)
        if lesson is not None:
            part = _taught(part, lesson)
            seen, offset, plant = seen + lesson.now_mm, part.offset_mm, part.plant
        elif self.gains.cameras:
            measured = frames.apply(part.mount, points_mm)
            surprise = torch.where(measured.isfinite(), measured - seen - offset, 0.0)
            filtered = AlphaBetaFilter() if begins else self.filter
            now, offset, drift = filtered.adopted(surprise, offset, plant.drift_mm)
            seen, plant = seen + now, replace(plant, drift_mm=drift)
        return replace(part, seen_mm=seen, seen_kPa=pressure, offset_mm=offset, plant=plant)


def _taught(part: ArmPart, lesson: Lesson) -> ArmPart:
    """The part with what a sample teaches."""
    plant = replace(part.plant, adaptation=lesson.memory)
    return replace(part, plant=plant, offset_mm=lesson.offset_mm, lead_mm=lesson.lead_mm)
