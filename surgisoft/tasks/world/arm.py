"""One arm of the world: its pumps, what is randomised, its batched state, and how it steps.

`Arm` is the protocol that worlds and tasks use. `ModelArm` implements it with a fitted arm model;
an arm on the virtual rig implements it with a simulated plant for each environment.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.scene import frames
from surgisoft.surrogate.arm import ArmSpec, ArmState
from surgisoft.surrogate.backbone import LEAST_SINE, STRAIGHT_RAD, ArcBackbone, Backbone
from surgisoft.surrogate.compiled_step import CompiledStep
from surgisoft.surrogate.model import ArmModel
from surgisoft.tasks.world.adaptation import AdaptationPrior, DisturbanceEstimator
from surgisoft.tasks.world.arm_errors import ErrorPrior
from surgisoft.tasks.world.compiled_arm import draw_arc, draw_body, drive, place
from surgisoft.tasks.world.observer import AlphaBetaFilter, Belief
from surgisoft.tasks.world.random_effects import RandomEffects
from surgisoft.tasks.world.random_streams import Stream
from surgisoft.threads import over_rows
from surgisoft.units import KPA_PER

STOOD = 40
"""Measurements at each pressure before an episode from which the observer learns, where it adapts:
rigs are held there for 4 s."""
STAND_IN_KPA = 70.0
"""Range of pressures that stands for the widest range of an actuation that is no pressure, kPa:
about that of the package's arm (69 kPa), for which the limits and noises of the tasks are made."""

NO_DIAMETER_MM = 15.0
"""Outer diameter of an arm where neither scene nor model states it, mm: that of the paper's arm."""


def radius_mm(model: ArmModel) -> float:
    """Outer radius of an arm outside of a scene, mm."""
    return 0.5 * (model.spec.diameter_mm or NO_DIAMETER_MM)


@dataclass(frozen=True)
class Pneumatics:
    """A first-order lag between commanded pressure and chamber pressure.

    dp/dt = (command - p) / tau, solved exactly over a step in which the command is held:
    p(t + dt) = command + (p(t) - command) exp(-dt / tau).
    """

    step_kPa: float = 3.0
    """Largest change of a command in one step, kPa (Chen et al. 2025, sec. IV-A)."""
    tau_s: float = 0.2
    """Time constant, s. The virtual rig's pumps reach 63 % of a 3 kPa step after 0.27 s at 0 kPa,
    0.19 s at 20 kPa and 0.15 s at 40 kPa. With 0 the chamber takes the commanded pressure at
    once."""

    def __post_init__(self):
        if not (math.isfinite(self.step_kPa) and self.step_kPa > 0.0):
            raise InputError(f"pneumatics: step_kPa is {self.step_kPa}, expected more than 0 kPa")
        if not (math.isfinite(self.tau_s) and self.tau_s >= 0.0):
            raise InputError(f"pneumatics: tau_s is {self.tau_s}, expected 0 s or more")

    def share(self, dt_s: float) -> float:
        """Fraction of the gap between command and pressure that closes in dt_s seconds."""
        return 1.0 if self.tau_s == 0.0 else -math.expm1(-dt_s / self.tau_s)

    def command(self, command: Tensor, action: Tensor, low: Tensor, high: Tensor) -> Tensor:
        """(B, m) kPa: the command (B, m) changed by the action (B, m), within low, high (m,)."""
        change = action.clamp(-self.step_kPa, self.step_kPa)
        return torch.minimum(torch.maximum(command + change, low), high)

    def follow(self, pressure: Tensor, command: Tensor, dt_s: float) -> Tensor:
        """(B, m) kPa: chamber pressure dt_s seconds later, with the command held."""
        return pressure + self.share(dt_s) * (command - pressure)

    def action_for(self, command: Tensor, pressure: Tensor, wanted: Tensor, dt_s: float) -> Tensor:
        """(B, m) kPa: the action that brings the chambers to `wanted` (B, m), limits left aside."""
        return pressure + (wanted - pressure) / self.share(dt_s) - command


LARGEST_GAIN = 0.3
"""Largest standard deviation of the gains, no unit: of normal numbers one in 2,300 is then below
-1 / 0.3, where a chamber moves the arm backwards; with 1 it is every sixth."""


@dataclass(frozen=True)
class Randomisation:
    """Domain randomization: what differs between episodes. 0 switches an entry off."""

    history: int = 3
    """Random pressures applied to an arm before an episode, so that its hysteresis memory varies
    (a count)."""
    start_kPa: float = 2.0
    """Half width of the uniform distribution of the initial pressures, kPa."""
    mount_mm: float = 0.0
    """Standard deviation of each coordinate of a mount's position, mm."""
    mount_rad: float = 0.0
    """Standard deviation of a mount's rotation about each axis of its base, rad."""
    gain: float = 0.0
    """Standard deviation of the factor between a chamber's pressure and the model's input, no
    unit; at most 0.3."""
    effects_mm: float = 0.0
    """Largest size of the effect out of the library that an episode's arm has and its model lacks:
    root mean square displacement of the tip, mm. Each episode draws the kind and the size."""
    noise_mm: float = 0.0
    """Standard deviation of the noise on each coordinate of a measured key point, mm."""
    noise_kPa: float = 0.0
    """Standard deviation of the noise on a measured pressure, kPa."""
    delay: int = 0
    """Largest action delay, steps, less than an episode has; each episode draws a whole number from
    0 to this."""
    lesion_mm: float = 0.0
    """Largest distance of an episode's lesion from the scene's own, along the organ's surface, mm;
    for tasks in a scene."""
    lesion_size: float = 0.0
    """Half width of the uniform distribution of a lesion's relative diameter, below 1; for tasks in
    a scene."""
    lesions: int = 16
    """Number of lesions laid out in advance (a count); each episode draws one of them."""

    def __post_init__(self):
        if self.lesions < 1:
            raise InputError(f"randomisation: lesions is {self.lesions}, expected at least 1")
        for name, value in vars(self).items():
            if not (math.isfinite(value) and value >= 0):
                raise InputError(f"randomisation: {name} is {value}, expected 0 or more")
        if self.gain > LARGEST_GAIN:
            raise InputError(
                f"randomisation: gain is {self.gain:g}, expected at most {LARGEST_GAIN:g} (0.05 is "
                "5 %); with more, some chambers of some episodes would move the arm backwards"
            )


@dataclass(frozen=True, eq=False)
class Mounted:
    """An arm model and the place and orientation of its base."""

    model: ArmModel
    """The arm; see `units_per_kPa` for one that is not driven in kPa."""
    pose: Tensor
    """(4, 4) base frame to world frame, mm."""
    start_kPa: tuple[float, ...] | None = None
    """(m,) pressures at the start of an episode, kPa; None: at rest."""
    shaft_mm: float = 0.0
    """Straight rigid shaft behind the base, mm."""


@dataclass(frozen=True, eq=False)
class ArmPart:
    """The state of one arm in B environments; world frame."""

    command: Tensor
    """(B, m) kPa: commanded pressure."""
    pressure: Tensor
    """(B, m) kPa: pressure in the chambers."""
    queue: Tensor
    """(B, D, m) kPa: the last D actions, newest last, for actions that come late."""
    delay: Tensor
    """(B,) int64: delay of the episode's actions in steps, at most D."""
    gain: Tensor
    """(B, m): the model's actuation over the chamber pressure in the episode, in units of the model
    per kPa (`units_per_kPa`)."""
    mount: Tensor
    """(B, 4, 4): this episode's base frame to world frame, mm."""
    arm: ArmState
    """The model's state, its effects' memory included."""
    points_mm: Tensor
    """(B, n, 3) mm: key points, base to tip."""
    line_mm: Tensor
    """(B, K, 3) mm: centreline, base to tip, led by the far end of the shaft where there is one."""
    tip_direction: Tensor
    """(B, 3): unit tangent at the tip."""
    seen_mm: Tensor
    """(B, n, 3) mm: key points as measured, or as an observer estimates them from that."""
    seen_kPa: Tensor
    """(B, m) kPa: chamber pressure as measured."""
    offset_mm: Tensor
    """(B, n, 3) mm: known difference of the key points from the model's; 0 in simulation."""
    plant: Any = None
    """State of the plants where simulated rigs move the arm, a pytree with `ObjectBatch`es in it;
    None where the model moves it. Resets and row selections carry it like any tensor."""
    belief: Belief | None = None
    """Memory of the observer of a simulated arm; None where its estimate is the raw measurement."""
    lead_mm: Tensor | None = None
    """(B, n, 3) mm: by how much controllers see the key points ahead of the estimate `seen_mm`,
    because motion comes late (`adaptation`); None without an observer that learns."""
    factors: Tensor | None = None
    """(B, K): factors of the episode's random effects; None without any."""
    known_mount: Tensor | None = None
    """(B, 4, 4): base frame to world frame as far as controllers know it, mm: the nominal mount,
    and the feed. None for arms with two key points or more, whose body needs no base."""

    @property
    def model_beside(self) -> ArmState:
        """State of the model that runs beside the arm, fed with what is measured."""
        return self.arm if self.belief is None else self.belief.arm

    @property
    def steered_mm(self) -> Tensor:
        """(B, n, 3) mm: key points that controllers lead to their targets."""
        return self.seen_mm if self.lead_mm is None else self.seen_mm + self.lead_mm

    @property
    def tip_mm(self) -> Tensor:
        """(B, 3) mm: the last key point."""
        return self.points_mm[:, -1]


def as_known(part: ArmPart) -> ArmPart:
    """The part on the mount that controllers know, where its body depends on that."""
    return part if part.known_mount is None else replace(part, mount=part.known_mount)


class Arm(Protocol):
    """Interface of one arm of a world, batched: states in, states out.

    Every method is a function of its arguments. Tensors have the batch in front; key points, bases
    and directions are in the world frame, pressures in kPa.
    """

    name: str
    """Name in the world."""
    device: torch.device
    """Where its tensors live."""
    vary: Randomisation
    """What is randomised at the start of an episode, and the sensors' noise."""
    chambers: int
    """m, number of chambers."""
    key_points: int
    """n, number of key points, base and tip included."""
    model: ArmModel
    """The fitted arm model: policies and experts predict with it."""
    backbone: Backbone | ArcBackbone
    """The curve through the key points."""
    pneumatics: Pneumatics
    """The pneumatic actuators."""
    low: Tensor
    """(m,) kPa: lowest pressure of each chamber."""
    high: Tensor
    """(m,) kPa: highest pressure of each chamber."""
    first: Tensor
    """(m,) kPa: mean pressure at the start of an episode."""
    pose: Tensor
    """(4, 4) base frame to world frame, mm, nominal mount."""
    shaft: Tensor
    """(1, 3) mm, base frame: far end of the rigid shaft behind the base; (0, 3) without one."""

    def start(self, stream: Stream) -> tuple[Stream, ArmPart]:
        """Draw parameters of an episode for each random number stream; returns (streams, arms)."""

    def step(
        self, stream: Stream, part: ArmPart, action: Tensor, dt_s: float
    ) -> tuple[Stream, ArmPart]:
        """Advance by dt_s seconds with pressure changes (B, m), kPa."""

    def predict(self, part: ArmPart, pressure: Tensor, dt_s: float) -> Tensor:
        """One-step prediction: key points (B, n, 3) mm if the chambers had (B, m) kPa in dt_s."""

    def posed(self, part: ArmPart, points_mm: Tensor) -> ArmPart:
        """The state with its body moved to key points (B, n, 3) mm."""

    def settled(self, pressure: Tensor) -> Tensor:
        """Steady-state key points (B, n, 3) mm at pressures (B, m) kPa, nominal mount."""

    def within_reach(self, part: ArmPart, dt_s: float) -> tuple[Tensor, Tensor]:
        """Lowest and highest pressures (B, m) kPa that the pumps can reach in dt_s seconds."""

    def action_for(self, part: ArmPart, pressure: Tensor, dt_s: float) -> Tensor:
        """(B, m) kPa: the action that brings the chambers to `pressure` (B, m), if in reach."""


def measured_exactly(arm: Arm, part: ArmPart) -> bool:
    """Whether controllers know the body of an arm, in all environments.

    On the CPU the state is asked. On an accelerator that would wait for it, so the configuration
    is: a simulated arm without noise and observer is known, but for one of a single key point that
    is mounted off the pose that controllers know.
    """
    if part.seen_mm.device.type == "cpu":
        same = torch.equal(part.seen_mm, part.points_mm)
        return same and (part.known_mount is None or torch.equal(part.known_mount, part.mount))
    if part.plant is not None or not isinstance(arm, ModelArm):
        return False
    vary = arm.vary
    on_pose = part.known_mount is None or vary.mount_mm == vary.mount_rad == 0.0
    return on_pose and arm.observer.raw and vary.noise_mm == 0.0


def units_per_kPa(spec: ArmSpec) -> float:
    """The actuation of an arm, in its own unit, that a pressure of 1 kPa of a task stands for.

    1 for kPa; a unit of pressure is converted. An actuation that is no pressure (an angle, a
    length, a voltage) is scaled, so that its widest range is `STAND_IN_KPA`.
    """
    if spec.unit in KPA_PER:
        return 1.0 / KPA_PER[spec.unit]
    return max(spec.span) / STAND_IN_KPA


def require_kPa(arm: ModelArm, where: str) -> None:
    """Raise an InputError for an arm that a controller outside of the simulation cannot drive.

    where: what the arm was to be used for.
    """
    if arm.model.spec.unit != "kPa":
        raise InputError(
            f"arm '{arm.name}': its model is driven in {arm.model.spec.unit}, and {where} needs "
            "kPa; convert the recordings by the map of 'surgisoft import' (to = 'kPa' for "
            "pressures, scale for other quantities) and fit again"
        )


class ModelArm:
    """An `Arm` that a fitted arm model moves; holds no state."""

    def __init__(
        self,
        name: str,
        mounted: Mounted,
        pneumatics: Pneumatics,
        randomisation: Randomisation,
        samples: int,
        device: torch.device,
        observer: AlphaBetaFilter | None = None,
        dt_s: float = 0.1,
        alike: ModelArm | None = None,
    ):
        """`samples` is the number K of centreline points; dt_s: time of a step of the world, s.

        alike: an arm of the same model, made with the same arguments but for name and mount; what
        was computed for it is taken from it.
        """
        spec = mounted.model.spec
        self.per_kPa = per_kPa = units_per_kPa(spec)
        """The model's actuation for a pressure of 1 kPa, in the model's unit; 1 for kPa."""
        rest = tuple(value / per_kPa for value in spec.rest)
        start = rest if mounted.start_kPa is None else mounted.start_kPa
        if len(start) != spec.chambers:
            raise InputError(
                f"arm '{name}': {len(start)} pressures to start with, expected {spec.chambers}"
            )
        self.name, self.device, self.vary = name, device, randomisation
        self.observer = observer or AlphaBetaFilter()
        self.chambers, self.key_points = spec.chambers, spec.key_points
        self.model = mounted.model.to(device)
        self.backbone = self.model.backbone(samples)
        # A model of commanded pressure has the pumps' lag in it already.
        late = spec.actuation == "measured"
        self.pneumatics = pneumatics if late else replace(pneumatics, tau_s=0.0)
        row: dict[str, Any] = {"dtype": torch.float32, "device": device}
        self.low = torch.tensor(spec.low, **row) / per_kPa
        self.high = torch.tensor(spec.high, **row) / per_kPa
        self.first = torch.tensor(start, **row)
        self.pose = mounted.pose.to(**row)
        self.shaft = torch.tensor([[0.0, 0.0, -mounted.shaft_mm]], **row)
        self.shaft = self.shaft if mounted.shaft_mm > 0.0 else self.shaft[:0]
        self._compiled = CompiledStep.of(self.model) if device.type == "cpu" else None
        curve = self.backbone
        if isinstance(curve, ArcBackbone):
            self.samples, matrices = len(curve.share), [curve.share]
        else:
            self.samples = len(curve.position)
            matrices = [curve.position, curve.derivative[-1].contiguous()]
        self._drawn = tuple(t.cpu().numpy() for t in (self.shaft, *matrices))
        self._random_effects: RandomEffects | None = None
        self._learner: DisturbanceEstimator | None = None
        if alike is not None:
            self._random_effects, self._learner = alike._random_effects, alike._learner
        else:
            if randomisation.effects_mm > 0:
                self._random_effects = RandomEffects(self.model)
            if self.observer.adapts:
                self._learner = self._new_learner(dt_s)

    def _new_learner(self, dt_s: float) -> DisturbanceEstimator:
        """What learns the arm's difference from its model, with its prior in the model's unit."""
        prior = AdaptationPrior(
            ErrorPrior(push_kPa=self.per_kPa * ErrorPrior.push_kPa),
            chambers_kPa=self.per_kPa * AdaptationPrior.chambers_kPa,
        )
        return DisturbanceEstimator(self.model, dt_s, prior, self.device)

    def reference(self) -> ModelArm:
        """This arm stepped by differentiable tensor operations alone, which agree to rounding."""
        arm = copy.copy(self)
        arm._compiled = None
        if arm._learner is not None:
            arm._learner = copy.copy(arm._learner)
            arm._learner.compiles = False
        return arm

    @property
    def _plant(self) -> ArmModel:
        """The model that moves the simulated arm, which may have effects that `model` lacks."""
        return self.model if self._random_effects is None else self._random_effects.model

    def start(self, stream: Stream) -> tuple[Stream, ArmPart]:
        """Draw parameters of an episode for each random number stream; returns (streams, arms)."""
        vary, m, count = self.vary, self.chambers, len(stream.key)
        stream, share = stream.uniform(0.0, 1.0, vary.history, m)
        stream, spread = stream.uniform(-1.0, 1.0, m)
        stream, normal = stream.normal(m)
        stream, turn = stream.normal(6)
        stream, late = stream.uniform(0.0, vary.delay + 1.0)
        gain = self.per_kPa * (1.0 + vary.gain * normal)
        pressure = (self.first + vary.start_kPa * spread).clamp(self.low, self.high)
        passed = (self.low + (self.high - self.low) * share).unbind(1)
        factors = None
        if self._random_effects is not None:
            stream, factors = self._random_effects.draw(stream, vary.effects_mm)
        state = self._plant.initial_state(count)
        stood, follow = [], None
        if self._learner is None and factors is None:
            follow = self._compiled_for(gain, *passed)
        for target in passed:
            if follow is not None:
                change = gain * target - state.pressure
                state = follow.follow(state, state.pressure + change)
                continue
            state, points = self._advanced(state, gain * target, 1.0, factors)
            stood.append(points)
        state, points = self._advanced(state, gain * pressure, 1.0, factors)
        stood.append(points)
        mount = self._moved(turn)
        points = frames.apply(mount, points)
        part = ArmPart(
            command=pressure,
            pressure=pressure,
            queue=pressure.new_zeros(count, vary.delay, m),
            delay=late.long().clamp(max=vary.delay),
            gain=gain,
            mount=mount,
            arm=state,
            points_mm=points,
            line_mm=self._line(points, mount),
            tip_direction=self.backbone.tip_direction(points, mount),
            seen_mm=points,
            seen_kPa=pressure,
            offset_mm=torch.zeros_like(points),
            factors=factors,
            known_mount=self.pose.repeat(count, 1, 1) if self.key_points == 1 else None,
        )
        stream, part = self._measured(stream, part)
        if self.observer.raw:
            return stream, part
        nominal = self.model.initial_state(count)
        learned = None if self._learner is None else self._learner.start(count)
        for number, target in enumerate((*passed, pressure)):
            nominal, shape = self._advanced(nominal, self.per_kPa * target, 1.0)
            if self._learner is None or learned is None:
                continue
            at = stood[number]
            stream, noise = stream.normal(self.key_points, 3)
            seen = frames.apply(mount, at) + vary.noise_mm / math.sqrt(STOOD) * noise
            off = (seen - frames.apply(self.pose, shape)) @ self.pose[:3, :3]
            told = self.per_kPa * target
            learned = self._learner.updated(learned, off, told, shape, STOOD, True).memory
        offset = part.seen_mm - frames.apply(self.pose, shape)
        zero = torch.zeros_like(offset)
        belief = Belief(nominal, offset, zero, zero[:, :1])
        if self._learner is not None:
            belief = replace(belief, adaptation=learned, offset_mm=zero)
            now, lead, belief = self._learned(belief, offset, part.seen_kPa, shape)
            part = replace(part, seen_mm=part.seen_mm - offset + now, lead_mm=lead)
        return stream, replace(part, belief=belief)

    def step(
        self, stream: Stream, part: ArmPart, action: Tensor, dt_s: float
    ) -> tuple[Stream, ArmPart]:
        """Advance by dt_s seconds with changes (B, m) kPa of the commanded pressures."""
        inputs = (part.command, part.pressure, part.gain, part.mount, part.arm.pressure)
        step = self._compiled_for(*inputs, action)
        if step is not None and part.factors is None:
            part = self._stepped(step, part, action, dt_s)
        else:
            queue, action = self._due(part, action)
            command = self.pneumatics.command(part.command, action, self.low, self.high)
            pressure = self.pneumatics.follow(part.pressure, command, dt_s)
            state, points = self.bent(part, pressure, dt_s)
            part = replace(part, command=command, pressure=pressure, queue=queue, arm=state)
            part = self.posed(part, points)
        stream, part = self._measured(stream, part)
        return stream, self._estimated(part, dt_s)

    def predict(self, part: ArmPart, pressure: Tensor, dt_s: float) -> Tensor:
        """One-step prediction: key points (B, n, 3) mm, world frame, if the chambers had (B, m) kPa
        after dt_s seconds.

        It is differentiable by the pressure, and privileged: it uses the episode's true gain, mount
        and hysteresis memory.
        """
        return self.bent(part, pressure, dt_s)[1] + part.offset_mm

    def settled(self, pressure: Tensor) -> Tensor:
        """Steady-state key points (B, n, 3) mm, world frame, nominal mount, at (B, m) kPa.

        The model's output for constant pressure, without any history of pressure changes.
        """
        state = self.model.initial_state(len(pressure), self.per_kPa * pressure)
        _, points = self.model.step(state, torch.zeros_like(pressure), 1.0)
        return frames.apply(self.pose, points)

    def bent(
        self, part: ArmPart, pressure: Tensor, dt_s: Tensor | float
    ) -> tuple[ArmState, Tensor]:
        """The model's state and key points (B, n, 3) mm, world frame, at pressures (B, m) kPa."""
        state, points = self._advanced(part.arm, part.gain * pressure, dt_s, part.factors)
        if self._compiled_for(points, part.mount) is None:
            return state, frames.apply(part.mount, points)
        return state, _placed(points, part.mount)

    def _advanced(
        self,
        state: ArmState,
        pressure: Tensor,
        dt_s: Tensor | float,
        factors: Tensor | None = None,
    ) -> tuple[ArmState, Tensor]:
        """The model's state and key points (B, n, 3) mm, base frame, at its actuation (B, m).

        factors: (B, K) of random effects, which the state then has the memories of.
        """
        if factors is not None:
            assert self._random_effects is not None
            return self._random_effects.step(state, pressure, dt_s, factors)
        step, change = self._compiled_for(pressure, state.pressure), pressure - state.pressure
        if step is None:
            return self.model.step(state, change, dt_s)
        return step(state, state.pressure + change)

    def posed(self, part: ArmPart, points_mm: Tensor) -> ArmPart:
        """The state with its body moved to key points (B, n, 3) mm, world frame."""
        if self._compiled_for(points_mm, part.mount) is not None:
            line, direction = self._body(points_mm, part.mount)
        else:
            line = self._line(points_mm, part.mount)
            direction = self.backbone.tip_direction(points_mm, part.mount)
        return replace(part, points_mm=points_mm, line_mm=line, tip_direction=direction)

    def _compiled_for(self, *tensors: Tensor) -> CompiledStep | None:
        """The compiled step where it may take these tensors; None where the reference has to.

        It has to where a gradient is asked for, and while a program is traced.
        """
        if self._compiled is None or torch.compiler.is_compiling() or torch.jit.is_tracing():
            return None
        graded = torch.is_grad_enabled()
        for tensor in tensors:
            plain = type(tensor) is Tensor and tensor.dtype == torch.float32
            if not plain or (graded and tensor.requires_grad):
                return None
        return None if graded and self._compiled.learns else self._compiled

    def _stepped(self, step: CompiledStep, part: ArmPart, action: Tensor, dt_s: float) -> ArmPart:
        """The part after a step with the action (B, m) kPa, all but what is measured."""
        kPa = part.command.shape
        command, pressure, target = (part.command.new_empty(kPa) for _ in range(3))
        queue = part.queue.new_empty(part.queue.shape)
        given = (part.command, part.pressure, part.queue, part.delay, part.gain, action)
        before = [t.contiguous().numpy() for t in given]
        beside = part.arm.pressure.contiguous().numpy()
        limits = (self.low.numpy(), self.high.numpy())
        step_kPa, share = self.pneumatics.step_kPa, self.pneumatics.share(dt_s)
        pumps = (*limits, np.float32(step_kPa), np.float32(share))
        after = [t.numpy() for t in (command, pressure, queue, target)]

        shape, points = (part.points_mm.new_empty(part.points_mm.shape) for _ in range(2))
        state, bend = step.prepared(part.arm, target, shape)
        move = _placing(shape, part.mount, points)
        line, direction, draw = self._drawing(points, part.mount)

        def advance(rows: slice) -> None:
            drive(*(a[rows] for a in before), *pumps, beside[rows], *(a[rows] for a in after))
            bend(rows)
            move(rows)
            draw(rows)

        with torch.no_grad():
            over_rows(len(command), advance)
        return replace(
            part,
            command=command,
            pressure=pressure,
            queue=queue,
            arm=state,
            points_mm=points,
            line_mm=line,
            tip_direction=direction,
        )

    def _body(self, points_mm: Tensor, mount: Tensor) -> tuple[Tensor, Tensor]:
        """Centreline (B, K, 3) mm and tip direction (B, 3), compiled."""
        line, direction, draw = self._drawing(points_mm.contiguous(), mount)
        over_rows(len(line), draw)
        return line, direction

    def _drawing(
        self, points_mm: Tensor, mount: Tensor
    ) -> tuple[Tensor, Tensor, Callable[[slice], None]]:
        """Centreline and tip direction as `_body`, and the work that fills their rows (a slice).

        points_mm: contiguous; read when the rows are worked on.
        """
        line = points_mm.new_empty(len(points_mm), len(self.shaft) + self.samples, 3)
        direction = points_mm.new_empty(len(points_mm), 3)
        arrays = [t.numpy() for t in (points_mm, mount.contiguous(), line, direction)]
        return line, direction, lambda rows: self.draw(*(array[rows] for array in arrays))

    def draw(self, points: np.ndarray, mounts: np.ndarray, line: Any, direction: Any) -> None:
        """Fill line (B, K, 3) mm and direction (B, 3) from key points (B, n, 3) mm, compiled.

        mounts: (B, 4, 4); all in the world frame, and line and direction tensors or arrays.
        """
        into = np.asarray(line), np.asarray(direction)
        if isinstance(self.backbone, ArcBackbone):
            limits = np.float32(STRAIGHT_RAD), np.float32(LEAST_SINE)
            draw_arc(points, mounts, *self._drawn, *limits, *into)
        else:
            draw_body(points, mounts, *self._drawn, *into)

    def alone(self, part: ArmPart, dt_s: float) -> LoneArm | None:
        """Steps of one environment's arm in kept arrays; None where the reference has to step it.

        It has to where the model cannot be compiled, where measurements have noise, where an
        observer estimates the key points, where the arm has random effects, and where the axis of
        an arm with one key point is not the one that controllers know.
        """
        vary = self.vary
        plain = self.observer.raw and vary.noise_mm == vary.noise_kPa == 0.0
        plain = plain and part.plant is None and part.belief is None and part.factors is None
        plain = plain and len(part.command) == 1
        if part.known_mount is not None:  # what is seen has the nominal base
            plain = plain and vary.mount_mm == vary.mount_rad == 0.0
        return LoneArm(self, self._compiled, part, dt_s) if plain and self._compiled else None

    def within_reach(self, part: ArmPart, dt_s: float) -> tuple[Tensor, Tensor]:
        """Lowest and highest pressures (B, m) kPa that the pumps can reach in dt_s seconds."""
        pump = self.pneumatics
        ends = [
            pump.follow(
                part.pressure, pump.command(part.command, change, self.low, self.high), dt_s
            )
            for change in (
                part.command.new_tensor(-pump.step_kPa),
                part.command.new_tensor(pump.step_kPa),
            )
        ]
        return ends[0], ends[1]

    def action_for(self, part: ArmPart, pressure: Tensor, dt_s: float) -> Tensor:
        """(B, m) kPa: the action that brings the chambers to `pressure` (B, m), if in reach."""
        return self.pneumatics.action_for(part.command, part.pressure, pressure, dt_s)

    def _due(self, part: ArmPart, action: Tensor) -> tuple[Tensor, Tensor]:
        """The queue with this action in it, and the action that is due now."""
        queue = torch.cat((part.queue, action[:, None]), 1)
        place = (self.vary.delay - part.delay)[:, None, None].expand(-1, 1, self.chambers)
        return queue[:, 1:], queue.gather(1, place)[:, 0]

    def _line(self, points: Tensor, mount: Tensor) -> Tensor:
        line = self.backbone.centreline(points, mount)
        return torch.cat((frames.apply(mount, self.shaft), line), 1) if len(self.shaft) else line

    def _moved(self, normal: Tensor) -> Tensor:
        """(B, 4, 4) mounts displaced by (B, 6) standard normals: three shifts, three rotations."""
        if self.vary.mount_mm == self.vary.mount_rad == 0.0:
            return self.pose.repeat(len(normal), 1, 1)
        turn = self.vary.mount_rad * normal[:, 3:]
        rotation = frames.rotation_from_axis_angle(turn, frames.norm(turn))
        return self.pose @ frames.pose_from(rotation, self.vary.mount_mm * normal[:, :3])

    def _measured(self, stream: Stream, part: ArmPart) -> tuple[Stream, ArmPart]:
        vary = self.vary
        if vary.noise_mm == 0.0 and vary.noise_kPa == 0.0:
            return stream, replace(part, seen_mm=part.points_mm, seen_kPa=part.pressure)
        stream, points = stream.normal(self.key_points, 3)
        stream, pressure = stream.normal(self.chambers)
        seen_mm = part.points_mm + vary.noise_mm * points
        seen_kPa = part.pressure + vary.noise_kPa * pressure
        return stream, replace(part, seen_mm=seen_mm, seen_kPa=seen_kPa)

    def _estimated(self, part: ArmPart, dt_s: float) -> ArmPart:
        """The part with the observer's estimate in place of the raw measurement.

        The nominal model knows neither the episode's gain nor its mount.
        """
        belief = part.belief
        if belief is None:
            return part
        arm, shape = self._advanced(belief.arm, self.per_kPa * part.seen_kPa, dt_s)
        points = frames.apply(self.pose, shape) + belief.fed_mm
        off, lead = part.seen_mm - points, None
        belief = replace(belief, arm=arm)
        if belief.adaptation is None:
            before = belief.offset_mm, belief.drift_mm
            now, offset, drift = self.observer.adopted(off - belief.offset_mm, *before)
            belief = replace(belief, offset_mm=offset, drift_mm=drift)
        else:
            now, lead, belief = self._learned(belief, off, part.seen_kPa, shape)
        return replace(part, seen_mm=points + now, lead_mm=lead, belief=belief)

    def _learned(
        self, belief: Belief, off: Tensor, pressure: Tensor, shape: Tensor
    ) -> tuple[Tensor, Tensor, Belief]:
        """Disturbance now and what controllers see beyond it, each (B, n, 3) mm, world frame, and
        the belief after a measurement `off`; shape: (B, n, 3) mm, base frame, of the model."""
        assert self._learner is not None
        assert belief.adaptation is not None
        turn, told = self.pose[:3, :3], self.per_kPa * pressure
        found = self._learner.updated(belief.adaptation, off @ turn, told, shape)
        belief = replace(belief, adaptation=found.memory, offset_mm=found.next_mm @ turn.mT)
        return found.now_mm @ turn.mT, found.lead_mm @ turn.mT, belief


class LoneArm:
    """A `ModelArm` of one environment: it steps in arrays that are allocated once.

    At a batch of one a tensor operation costs more than its arithmetic, so the compiled loops of
    `ModelArm.step` are called here with arrays that are kept. The arrays have the batch in front.
    """

    def __init__(self, arm: ModelArm, step: CompiledStep, part: ArmPart, dt_s: float):
        self._part, self._arm = part, arm
        self.command, self.pressure, queue, self.delay, self.gain, self.mount = (
            _copied(t)
            for t in (part.command, part.pressure, part.queue, part.delay, part.gain, part.mount)
        )
        self._queue = queue
        self.action = np.zeros_like(self.command)
        """(1, m) kPa: the action of the next step, written by the caller."""
        self.beside = np.empty_like(self.command)
        """(1, m) kPa: the model's actuation."""
        self.model = step.alone(part.arm, self.beside)
        self.points_mm, self.line_mm, self.tip_direction = (
            _copied(t) for t in (part.points_mm, part.line_mm, part.tip_direction)
        )
        self.tip_mm = self.points_mm[:, -1]
        """(1, 3) mm: the last key point."""
        pump = arm.pneumatics
        self._drive = (
            *(self.command, self.pressure, queue, self.delay, self.gain, self.action),
            *(arm.low.numpy(), arm.high.numpy()),
            *(np.float32(pump.step_kPa), np.float32(pump.share(dt_s)), self.beside),
            # The loop reads each entry before it writes it.
            *(self.command, self.pressure, queue, self.beside),
        )

    def step(self) -> None:
        """Advance one step with the changes of pressure in `action`."""
        drive(*self._drive)
        self.model.step()
        place(self.model.points_mm, self.mount, self.points_mm)
        self._arm.draw(self.points_mm, self.mount, self.line_mm, self.tip_direction)

    @property
    def part(self) -> ArmPart:
        """A copy of the present state."""
        held = {
            "command": self.command,
            "pressure": self.pressure,
            "queue": self._queue,
            "points_mm": self.points_mm,
            "line_mm": self.line_mm,
            "tip_direction": self.tip_direction,
        }
        copies: dict[str, Any] = {
            name: torch.from_numpy(array.copy()) for name, array in held.items()
        }
        seen: dict[str, Any] = {"seen_mm": copies["points_mm"], "seen_kPa": copies["pressure"]}
        return replace(self._part, arm=self.model.state, **copies, **seen)


def _copied(tensor: Tensor) -> np.ndarray:
    """A copy of a tensor as a contiguous array."""
    return tensor.detach().contiguous().numpy().copy()


def _placed(points: Tensor, mount: Tensor) -> Tensor:
    """Key points (B, n, 3) mm, world frame, of those in the base frames (B, 4, 4), compiled."""
    out = points.new_empty(points.shape)
    over_rows(len(out), _placing(points.contiguous(), mount, out))
    return out


def _placing(points: Tensor, mount: Tensor, out: Tensor) -> Callable[[slice], None]:
    """The work that fills rows (a slice) of `out` as `_placed`; points: contiguous, read then."""
    before, mounts, after = points.numpy(), mount.contiguous().numpy(), out.numpy()
    return lambda rows: place(before[rows], mounts[rows], after[rows])
