"""A policy with all that it needs around it: measurements in, commands out.

`ControllerGraph` holds the observer, the memories of the arm models, the task's reference and
observations, and the actors. It computes what the policy does in `evaluate --on rig`, with the
measurements as inputs and its whole state as one vector, so that it can be written as one graph.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, cast

import torch
from torch import Tensor, nn

from surgisoft.agents.observer import Observer, ObserverGains, Order
from surgisoft.errors import InputError
from surgisoft.surrogate.callables.network import CallableNetwork
from surgisoft.tasks.base import FEED_SIGNAL, Episodes, MeasuredTask, Signal, Task, TaskState
from surgisoft.tasks.describe import field_docs
from surgisoft.tasks.world.adaptation import Adaptation
from surgisoft.tasks.world.arm import ArmPart, ModelArm, require_kPa
from surgisoft.tasks.world.pytree import tree_map
from surgisoft.tasks.world.random_streams import Stream
from surgisoft.tasks.world.scene import SceneEngine, SceneState
from surgisoft.tasks.world.world import WorldState, fed

EARLY = 1e-3
"""Share of the control period by which the last sample of a period may come early."""


@dataclass(frozen=True, eq=False)
class MeasuredPlant:
    """State of an arm that is measured and commanded from outside, as `ArmPart.plant`."""

    target_kPa: Tensor
    """(1, m) kPa: pressures that were commanded last."""
    drift_mm: Tensor
    """(1, n, 3) mm, world frame: by how much the output disturbance grows in a step."""
    shift_kPa: Tensor
    """(1, m) kPa: estimated offset of the pumps at the last decision."""
    expected_kPa: Tensor
    """(1, m) kPa: pressures expected at the next decision."""
    lowest_kPa: Tensor
    """(1, m) kPa: lowest pressure that is commanded."""
    highest_kPa: Tensor
    """(1, m) kPa: highest pressure that is commanded."""
    adaptation: Adaptation | None = None
    """What was learned of the output disturbance; None where it is filtered."""
    arrived: ArmPart | None = None
    """The part at the end of the step, while the task advances."""


class MeasuredArm:
    """An arm of the world whose steps were measured; see the interface `Arm`. Holds no state."""

    def __init__(self, arm: ModelArm, gains: ObserverGains, dt_s: float):
        """arm: the simulated arm of the task; dt_s: time of a step, s."""
        require_kPa(arm, "an exported controller")
        self.simulated = arm
        self.observer = Observer(arm, gains, dt_s, arm.low, arm.high)
        self.name, self.device, self.vary = arm.name, arm.device, arm.vary
        self.chambers, self.key_points = arm.chambers, arm.key_points
        self.model, self.backbone, self.pneumatics = arm.model, arm.backbone, arm.pneumatics
        self.low, self.high, self.first = arm.low, arm.high, arm.first
        self.pose, self.shaft = arm.pose, arm.shaft
        self.predict, self.settled = arm.predict, arm.settled
        self.within_reach, self.action_for = arm.within_reach, arm.action_for
        self.posed = arm.posed

    def at_rest(self, stream: Stream) -> ArmPart:
        """One arm at rest, without history, on its nominal mount, that is not yet controlled."""
        _, part = self.simulated.start(stream)
        model = self.model.initial_state(1)
        pressure = model.pressure
        zero = torch.zeros_like(part.points_mm)
        plant = MeasuredPlant(
            pressure,
            zero,
            torch.zeros_like(pressure),
            pressure,
            self.low[None],
            self.high[None],
            self.observer.memory(1),
        )
        part = replace(
            part,
            command=pressure,
            pressure=pressure,
            queue=part.queue[:, :0],
            gain=torch.ones_like(part.gain),
            mount=self.pose[None],
            arm=model,
            seen_kPa=pressure,
            offset_mm=zero,
            plant=plant,
            belief=None,
            lead_mm=self.observer.no_lead(zero),
            factors=None,
        )
        points = self.observer.followed(part, pressure, 0.0).points_mm
        return replace(self.simulated.posed(part, points), seen_mm=points)

    def start(self, stream: Stream) -> tuple[Stream, ArmPart]:
        """An arm at rest."""
        return stream, self.at_rest(stream)

    def step(
        self, stream: Stream, part: ArmPart, action: Tensor, dt_s: float
    ) -> tuple[Stream, ArmPart]:
        """The part that was measured at the end of the step."""
        return stream, part.plant.arrived


class _MeasuredScene:
    """Stands in for a world's scene: the state of the scene was measured."""

    def step(self, scene: SceneState, parts: Any, power_w: Any, dt_s: float) -> SceneState:
        """The scene as measured."""
        return scene


@dataclass(frozen=True, eq=False)
class Memory:
    """All that a controller remembers between two samples; one robot, (1, ...)."""

    running: Tensor
    """(1,) bool: an episode has begun."""
    elapsed_s: Tensor
    """(1,) s: time since the last decision."""
    steps: Tensor
    """(1,) int64: decisions since the episode began."""
    arms: dict[str, ArmPart]
    """Each arm by name."""
    goal: Any
    """The task's goal."""
    lesion: Tensor
    """(1,) int64: number of the lesion, of tasks with several."""
    out_mm: Tensor | None = None
    """(1,) mm: by how much the arms' bases were behind their mounts; None without a feed."""


@dataclass(frozen=True)
class Leaf:
    """A tensor of the memory and its place in the state vector."""

    name: str
    """Path of the tensor, such as `arms.laser.mount`."""
    first: int
    """Index of its first number."""
    shape: tuple[int, ...]
    """Shape without the batch."""
    kind: torch.dtype
    """Its type; numbers of all types are stored as float32."""

    @property
    def last(self) -> int:
        """Index after its last number."""
        return self.first + math.prod(self.shape)


class ControllerGraph(nn.Module):
    """Samples of one robot in, commands out; the state is one vector, so that the graph has none.

    `forward(state, begin, dt_s, *measured)`, each float32:

    - state (1, S): all memories; `initial` is that of a robot at rest;
    - begin (1,): 1 if the episode begins with this sample, else 0;
    - dt_s (1,): time since the sample before, s;
    - for each arm its measured pressures (1, m) kPa, its measured key points (1, n, 3) mm in its
      base frame, NaN where one is lost, and the pressures (1, m) kPa that are commanded now;
    - each signal of the task (1,).

    Before the episode begins, the models follow the samples, what they get wrong is learned once in
    a control period, and the commands stay as they are. Then the policy decides at its first sample
    and every control period. Returned are the state, and for each arm the pressures (1, m) kPa to
    command, the estimated and the model's key points (1, n, 3) mm in the world frame, and the
    agent's last observation (1, D).
    """

    initial: Tensor
    """(1, S): the state of a robot at rest."""

    def __init__(
        self,
        task: Task,
        actors: Mapping[str, nn.Module],
        gains: ObserverGains | None = None,
    ):
        super().__init__()
        gains = gains or ObserverGains()
        self.signals: tuple[Signal, ...] = getattr(task, "signals", ())
        if task.world.scene is not None and not self.signals:
            raise InputError(
                f"task '{task.name}' observes its scene and does not state what a controller has "
                "to measure of it (Task.signals): only its network can be exported"
            )
        self.control_s = task.world.config.dt_s
        self.actors = nn.ModuleDict({name: actors[name] for name in task.agents})
        world, moved = copy.copy(task.world), copy.copy(task)
        self.arms: dict[str, MeasuredArm] = {}
        for name, arm in world.arms.items():
            if not isinstance(arm, ModelArm):
                raise InputError(
                    f"arm '{name}' is on a rig, expected a simulated arm; build the task without a "
                    "rig and export that"
                )
            self.arms[name] = MeasuredArm(arm, gains, self.control_s)
        world.arms = dict(self.arms)
        if world.scene is not None:
            world.scene = cast(SceneEngine, _MeasuredScene())
        self.feeds, world.feed = world.feed is not None, None  # the carriages are measured
        moved.world = world
        self.simulated = task
        self.task, self.episodes = moved, Episodes(moved)
        self._stream = Stream(torch.zeros(1, dtype=torch.int64), torch.zeros(1, dtype=torch.int64))
        with torch.no_grad():
            self.start = self._at_rest()
            self.leaves = tuple(_leaves(self.start))
            first = self._known(self.start, {s.name: torch.zeros(1) for s in self.signals})
            seen = self.episodes.observe(first)
            joint = torch.cat([seen[agent] for agent in moved.agents], 1)
        self.widths = {agent: seen[agent].shape[1] for agent in moved.agents}
        self.register_buffer("initial", self.packed(self.start, joint))

    @property
    def callables(self) -> list[CallableNetwork]:
        """The arms' models that call Python code of the user, which no graph can have."""
        networks = [arm.model.network for arm in self.arms.values()]
        return [each for each in networks if isinstance(each, CallableNetwork)]

    @property
    def inputs(self) -> list[str]:
        """Names of the arguments of `forward`."""
        kinds = ("pressure_kPa", "key_points_mm", "commanded_kPa")
        arms = [f"{name}_{kind}" for name in self.arms for kind in kinds]
        return ["state", "begin", "dt_s", *arms, *(signal.name for signal in self.signals)]

    @property
    def outputs(self) -> list[str]:
        """Names of the results of `forward`."""
        kinds = ("command_kPa", "estimate_mm", "model_mm", "observation")
        return ["next_state", *(f"{name}_{kind}" for name in self.arms for kind in kinds)]

    def example(self) -> list[Tensor]:
        """Inputs of a robot at rest whose episode does not begin."""
        given = [self.initial.clone(), torch.zeros(1), torch.full((1,), self.control_s)]
        for part in self.start.arms.values():
            given += [part.pressure, torch.zeros_like(part.points_mm), part.pressure]
        return [*given, *(torch.zeros(1) for _ in self.signals)]

    def packed(self, memory: Memory, seen: Tensor) -> Tensor:
        """(1, S) float32: the memory and the last observations (1, sum of D) as one vector."""
        values = [value.reshape(1, -1).float() for _, value in named_tensors(memory)]
        return torch.cat([*values, seen], 1)

    def unpacked(self, state: Tensor) -> tuple[Memory, Tensor]:
        """The memory and the last observations of a state (1, S)."""
        values = iter(self.leaves)

        def value(_: Tensor) -> Tensor:
            leaf = next(values)
            flat = state[:, leaf.first : leaf.last].reshape(1, *leaf.shape)
            if leaf.kind == torch.bool:
                return flat > 0.5
            return flat if leaf.kind.is_floating_point else flat.round().to(leaf.kind)

        return tree_map(value, self.start), state[:, self.leaves[-1].last :]

    def forward(self, state: Tensor, begin: Tensor, dt_s: Tensor, *measured: Tensor):
        """One sample; arguments and results are those of the class."""
        memory, seen = self.unpacked(state)
        readings = [measured[3 * i : 3 * i + 3] for i in range(len(self.arms))]
        signals = dict(
            zip((s.name for s in self.signals), measured[3 * len(self.arms) :], strict=True)
        )
        memory = self._fed(memory, signals)
        begins = begin > 0.5
        elapsed = memory.elapsed_s + dt_s
        over = elapsed >= (1.0 - EARLY) * self.control_s
        due = memory.running & over
        parts, begun, arrived, taught = {}, {}, {}, {}
        for (name, arm), (pressure, points, commanded) in zip(
            self.arms.items(), readings, strict=True
        ):
            part = memory.arms[name]
            plant = replace(part.plant, target_kPa=commanded)
            part = arm.observer.followed(replace(part, plant=plant), pressure, dt_s)
            order = Order(commanded, plant.shift_kPa, plant.expected_kPa)
            parts[name] = part
            lesson = arm.observer.lesson(part, pressure, points)
            taught[name] = arm.observer.learned(part, pressure, points, lesson)
            begun[name] = self._posed(arm, arm.observer.begun(part, pressure, points, lesson))
            came = arm.observer.stepped(part, order, pressure, points, lesson)
            arrived[name] = self._posed(arm, came)
        followed = replace(memory, arms=parts)
        now = self._advanced(followed, arrived, signals)
        now = _where(begins, replace(followed, arms=begun, steps=0 * memory.steps), now)
        observed = self.episodes.observe(self._known(now, signals))
        chosen = {}
        for name, arm in self.arms.items():
            part = now.arms[name]
            order = _ordered(arm.observer, part, self.actors[name](observed[name]))
            plant = replace(
                part.plant,
                target_kPa=order.target_kPa,
                shift_kPa=order.shift_kPa,
                expected_kPa=order.expected_kPa,
            )
            chosen[name] = replace(part, plant=plant)
        decides = begins | due
        learns = over & ~memory.running
        followed = _where(learns, replace(followed, arms=taught), followed)
        after = _where(decides, replace(now, arms=chosen), followed)
        after = replace(
            after,
            running=memory.running | begins,
            elapsed_s=torch.where(decides | over, 0.0 * elapsed, elapsed),
        )
        fresh = torch.cat([observed[name] for name in self.task.agents], 1)
        fresh = torch.where(decides[:, None], fresh, seen)
        results = [self.packed(after, fresh)]
        views = dict(zip(self.widths, fresh.split([*self.widths.values()], 1), strict=True))
        for name, part in after.arms.items():
            model = parts[name].points_mm
            results += [part.plant.target_kPa, part.seen_mm, model, views[name]]
        return tuple(results)

    def _fed(self, memory: Memory, signals: dict[str, Tensor]) -> Memory:
        """The memory with the arms' bases where their carriages are measured."""
        if not self.feeds:
            return memory
        out_mm, before_mm = signals[FEED_SIGNAL], cast(Tensor, memory.out_mm)
        arms = {name: fed(part, before_mm - out_mm) for name, part in memory.arms.items()}
        return replace(memory, arms=arms, out_mm=out_mm)

    def _posed(self, arm: MeasuredArm, part: ArmPart) -> ArmPart:
        """The part with its body where it is estimated."""
        return arm.simulated.posed(part, part.seen_mm)

    def _advanced(self, memory: Memory, arrived: dict[str, ArmPart], signals: dict) -> Memory:
        """The memory a step of the task later."""
        waiting = {
            name: replace(part, plant=replace(part.plant, arrived=arrived[name]))
            for name, part in memory.arms.items()
        }
        state = self._known(replace(memory, arms=waiting), signals)
        if self.signals:
            state = cast(MeasuredTask, self.task).advance_measured(state, signals)
        else:
            none = {name: torch.zeros_like(part.command) for name, part in waiting.items()}
            state = self.task.advance(state, none)
        return replace(memory, arms=state.world.arms, goal=state.goal, steps=state.world.steps)

    def _known(self, memory: Memory, signals: dict[str, Tensor]) -> TaskState:
        """The state of the task, as far as it is measured."""
        scene = SceneState()
        if self.signals:
            scene = cast(MeasuredTask, self.task).measured_scene(signals, memory.lesion)
        failed = torch.zeros(1, dtype=torch.bool)
        world = WorldState(self._stream, memory.steps, memory.arms, scene, failed, memory.out_mm)
        return TaskState(world, memory.goal)

    def _at_rest(self) -> Memory:
        """A robot at rest, with the goal of the first episode of seed 0."""
        _, goal = self.task.goal(self._stream)
        zero = torch.zeros(1)
        arms = {name: arm.at_rest(self._stream) for name, arm in self.arms.items()}
        out_mm = zero if self.feeds else None
        return Memory(zero > 0, zero, zero.long(), arms, goal, zero.long(), out_mm)


def goal_docs(goal: Any, prefix: str = "goal") -> dict[str, str]:
    """Path of each tensor of a goal -> its docstring."""
    found: dict[str, str] = {}
    docs = field_docs(type(goal))
    for field in fields(goal):
        value, path = getattr(goal, field.name), f"{prefix}.{field.name}"
        if is_dataclass(value):
            found |= goal_docs(value, path)
        else:
            found[path] = docs[field.name]
    return found


def _ordered(observer: Observer, part: ArmPart, action: Tensor) -> Order:
    """What to command, within the limits in the state."""
    plant = part.plant
    return observer.order(part, action, plant.lowest_kPa, plant.highest_kPa)


def named_tensors(tree: Any, prefix: str = "") -> Iterator[tuple[str, Tensor]]:
    """Path and value of each tensor of a pytree, in the order of `tree_map`."""
    if isinstance(tree, Tensor):
        yield prefix, tree
    elif isinstance(tree, dict):
        for key, value in tree.items():
            yield from named_tensors(value, f"{prefix}.{key}")
    elif is_dataclass(tree) and not isinstance(tree, type):
        for field in fields(tree):
            path = f"{prefix}.{field.name}" if prefix else field.name
            yield from named_tensors(getattr(tree, field.name), path)


def _leaves(memory: Memory) -> Iterator[Leaf]:
    first = 0
    for name, value in named_tensors(memory):
        leaf = Leaf(name, first, tuple(value.shape[1:]), value.dtype)
        yield leaf
        first = leaf.last


def _where(mask: Tensor, yes: Any, no: Any) -> Any:
    """`yes` where the (1,) mask holds, else `no`: for each tensor of two pytrees."""

    def pick(a: Tensor, b: Tensor) -> Tensor:
        if a is b:
            return a
        this = mask.view(-1, *[1] * (a.ndim - 1))
        if a.dtype == torch.bool:  # onnxruntime implements no Where of booleans
            return (this & a) | (~this & b)
        return torch.where(this, a, b)

    return tree_map(pick, yes, no)
