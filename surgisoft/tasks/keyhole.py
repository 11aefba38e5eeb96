"""One arm reaches through a slotted plate into one slot after another without touching the plate.

The plate stands between the slots, so the route from one to the next leads back to the centre.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.tasks.base import Signal, TaskState, check_weights, clearance, weighted
from surgisoft.tasks.inverse_kinematics import action_towards
from surgisoft.tasks.observations import (
    TIME,
    Block,
    ObservationBlocks,
    body_blocks,
    elapsed,
    joined,
)
from surgisoft.tasks.spec import TaskSpec
from surgisoft.tasks.trajectories.waypoints import (
    WaypointSequence,
    draw_sequence,
    point_at,
    progress,
    route_mm,
)
from surgisoft.tasks.world.arm import Arm
from surgisoft.tasks.world.plate import SlottedPlate, clear_routes, plate_world
from surgisoft.tasks.world.random_streams import Stream
from surgisoft.tasks.world.scene import SceneState, measured_clearance
from surgisoft.tasks.world.world import WorldConfig

TARGET = Block("target", "target minus measured tip", "mm", "asinh(x / 1 mm)")
ONWARD = Block(
    "onward", "point of the route one stride ahead minus measured tip", "mm", "asinh(x / 1 mm)"
)
CLEARANCE = Block("clearance", "least distance of the arm from the plate", "mm", "x / 10")
VISITS = Block("visits", "share of the targets reached", "-", "x", 0.0, 1.0)


@dataclass(frozen=True)
class KeyholeWeights:
    """Weights of the reward terms; r is the remaining length of the route to the target, mm.

    A visit is worth more than `way` and `near` together, which fall when the next route begins.
    """

    way: float = 1.0
    """exp(-r / far_mm)."""
    near: float = 1.0
    """exp(-r / reach_mm)."""
    visits: float = 3.0
    """Number of targets reached."""
    contact: float = -1.0
    """1 while the clearance is below limit_mm, else 0."""


@dataclass(frozen=True)
class KeyholeConfig:
    """The plate, the targets beyond it, and the reward."""

    arm: str | Path = "default"
    """Arm model: `default`, or the folder of a fitted model."""
    plate: SlottedPlate = field(default_factory=SlottedPlate)
    """The plate."""
    height_mm: float = 46.0
    """Distance from the arm's base to the plate's lower side, mm."""
    deep_mm: float = 25.0
    """Least distance of a target from the tip at rest, perpendicular to the arm, mm."""
    clear_mm: float = 2.0
    """Least clearance of the shapes along a route, mm; targets without such a route are unused."""
    limit_mm: float = 0.5
    """Clearance below which the arm counts as too close to the plate, mm."""
    visits: int = 3
    """Targets of an episode (a count), each in another slot than the one before."""
    reach_mm: float = 1.0
    """Distance of the tip at which a target is reached, mm."""
    time_s: float = 30.0
    """Time for all targets, s."""
    far_mm: float = 20.0
    """Scale of the reward term `way`, mm."""
    weights: KeyholeWeights = field(default_factory=KeyholeWeights)
    """Weights of the reward terms."""
    world: WorldConfig = field(default_factory=WorldConfig)
    """The simulator and its domain randomization."""

    def __post_init__(self):
        for name in ("deep_mm", "clear_mm", "visits", "reach_mm", "time_s", "far_mm"):
            if not getattr(self, name) > 0:
                raise InputError(f"keyhole: {name} is {getattr(self, name)}, expected above 0")
        check_weights("keyhole", self.weights)


class Keyhole:
    """One arm and a slotted plate."""

    name, agents = "keyhole", ("arm",)
    signals = (
        Signal(
            "clearance_mm",
            "least distance of the arm from the plate",
            "mm",
            -20.0,
            100.0,
            lambda task, before, after: clearance(after).least_mm,
        ),
        Signal(
            "at_target",
            "1 if the tip is within reach_mm of its target, else 0",
            "-",
            0.0,
            1.0,
            lambda task, before, after: task.visited(before, after).float(),
            float("nan"),
        ),
    )

    def __init__(self, config: KeyholeConfig | None = None, device: str | torch.device = "cpu"):
        c = self.config = config or KeyholeConfig()
        self.world = plate_world(c.plate, c.height_mm, c.limit_mm, c.arm, c.world, device)
        self.dt_s, self.weights = c.world.dt_s, {"arm": c.weights}
        self.steps = round(c.time_s / self.dt_s)
        self.routes = clear_routes(self.world, c.plate, c.deep_mm, c.clear_mm)
        # Upper bound of the tip's movement in a step.
        self._stride_mm = 4.0 * self.arm.pneumatics.step_kPa / 3.0

    @property
    def arm(self) -> Arm:
        """The only arm."""
        return self.world.arms["arm"]

    def goal(self, stream: Stream) -> tuple[Stream, WaypointSequence]:
        """Draw the sequence of targets for each random number stream."""
        return draw_sequence(stream, self.routes, self.config.visits)

    def route_mm(self, state: TaskState[WaypointSequence]) -> Tensor:
        """(B, N, 3) mm: from the last target back to the centre, and on to the next target."""
        return route_mm(self.routes, state.goal)

    def error_mm(self, state: TaskState[WaypointSequence]) -> Tensor:
        """(B,) mm: distance of the true tip from its target."""
        return (state.world.arms["arm"].tip_mm - self.route_mm(state)[:, -1]).norm(dim=1)

    def advance(
        self,
        state: TaskState[WaypointSequence],
        actions: Mapping[str, Tensor],
        at_target: Tensor | None = None,
    ) -> TaskState[WaypointSequence]:
        """Advance the arm; when the tip reaches a target, the next one becomes active.

        at_target: (B,) 1 where the tip is at its target, 0 where it is not, nan or None where the
        state decides.
        """
        state = replace(state, world=self.world.step(state.world, actions))
        near = self.error_mm(state) <= self.config.reach_mm
        if at_target is not None:
            # In place of torch.where: onnxruntime implements no Where of booleans.
            near = (near & at_target.isnan()) | (at_target > 0.5)
        near = near & ~self.ended(state)
        reached = (state.goal.reached + near).clamp(max=self.config.visits)
        return replace(state, goal=replace(state.goal, reached=reached))

    def measured_scene(self, signals: Mapping[str, Tensor], lesion: Tensor) -> SceneState:
        """The arm's clearance; see `MeasuredTask.measured_scene`."""
        return measured_clearance(signals["clearance_mm"])

    def visited(
        self, before: TaskState[WaypointSequence] | None, after: TaskState[WaypointSequence]
    ) -> Tensor:
        """(B,) int64: targets reached in the step from `before`, or since the episode began."""
        return after.goal.reached - (0 if before is None else before.goal.reached)

    def advance_measured(
        self, state: TaskState[WaypointSequence], signals: Mapping[str, Tensor]
    ) -> TaskState[WaypointSequence]:
        """Advance with the targets that were reached as measured; see `MeasuredTask`."""
        none = {"arm": self.arm.low.new_zeros(1, self.arm.chambers)}
        return self.advance(state, none, signals["at_target"])

    def blocks(self, state: TaskState[WaypointSequence]) -> dict[str, ObservationBlocks]:
        """Observation blocks: body, target, next stride, clearance, visits and time."""
        part, route = state.world.arms["arm"], self.route_mm(state)
        tip = part.steered_mm[:, -1]
        onward = point_at(route, progress(route, tip).along_mm + self._stride_mm)
        return {
            "arm": {
                **body_blocks(self.arm, part),
                TARGET: (route[:, -1] - tip).asinh(),
                ONWARD: (onward - tip).asinh(),
                CLEARANCE: clearance(state).least_mm[:, None] / 10.0,
                VISITS: state.goal.reached[:, None] / self.config.visits,
                TIME: elapsed(state.world.steps, self.steps),
            }
        }

    def observe(self, state: TaskState[WaypointSequence]) -> dict[str, Tensor]:
        """Concatenated observation blocks, agent -> (B, D)."""
        return {agent: joined(blocks) for agent, blocks in self.blocks(state).items()}

    def rewards(self, state: TaskState[WaypointSequence]) -> dict[str, dict[str, Tensor]]:
        """Weighted reward terms, see `KeyholeWeights`."""
        clear, tip = clearance(state).least_mm, state.world.arms["arm"].tip_mm
        left = progress(self.route_mm(state), tip).remaining_mm
        terms = {
            "way": (-left / self.config.far_mm).exp(),
            "near": (-left / self.config.reach_mm).exp(),
            "visits": state.goal.reached,
            "contact": (clear < self.config.limit_mm).float(),
        }
        return {"arm": weighted(terms, self.config.weights)}

    def ended(self, state: TaskState[WaypointSequence]) -> Tensor:
        """When the arm touches the plate or itself."""
        return clearance(state).collides

    def measures(self, state: TaskState[WaypointSequence]) -> dict[str, Tensor]:
        """Remaining route, share of visits, clearance, collision and success."""
        found, goal = clearance(state), state.goal
        done, hit = goal.reached >= self.config.visits, found.collides
        route = progress(self.route_mm(state), state.world.arms["arm"].tip_mm)
        return {
            "left_mm": route.remaining_mm,
            "visited": goal.reached / self.config.visits,
            "clearance_mm": found.least_mm,
            "collided": hit.float(),
            "success": (done & ~hit).float(),
        }

    def trace(self, state: TaskState[WaypointSequence]) -> tuple[Tensor, Tensor]:
        """The target and the true tip, each (B, 1, 3) mm."""
        return self.route_mm(state)[:, -1:], state.world.arms["arm"].tip_mm[:, None]

    def script(self, state: TaskState[WaypointSequence]) -> dict[str, Tensor]:
        """Scripted expert: inverse kinematics for the tip one stride ahead on the route."""
        part, route = state.world.arms["arm"], self.route_mm(state)
        onward = point_at(route, progress(route, part.tip_mm).along_mm + self._stride_mm)
        return {"arm": action_towards(self.arm, part, onward, _tip_error, self.dt_s)}


def _tip_error(points_mm: Tensor, target_mm: Tensor) -> Tensor:
    return points_mm[:, -1] - target_mm


KEYHOLE = TaskSpec(Keyhole, KeyholeConfig(), ("arm",), training_steps=2_000_000)
