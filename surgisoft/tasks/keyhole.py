"""One arm reaches past a slotted plate: into one slot after the other, its whole body clear of it.

Between two slots stands the plate, so that the way from one to the next leads back to the middle.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.tasks.base import TaskState
from surgisoft.tasks.inverse_kinematics import body_part, seek
from surgisoft.tasks.trajectories import Tour, fresh_tour, place, progress, way_mm
from surgisoft.tasks.world.arm import Arm
from surgisoft.tasks.world.plate import SlottedPlate, clear_ways, plate_world
from surgisoft.tasks.world.random import Stream
from surgisoft.tasks.world.world import WorldConfig


@dataclass(frozen=True)
class KeyholeConfig:
    """The plate, what is to be reached beyond it, and what that is worth."""

    arm: str | Path = "default"
    """Arm model: `default`, or the folder of a fitted model."""
    plate: SlottedPlate = field(default_factory=SlottedPlate)
    """The plate."""
    height_mm: float = 46.0
    """From the arm's base to the plate's lower side, mm."""
    deep_mm: float = 25.0
    """Least distance of a target from the tip at rest, across the arm, mm."""
    clear_mm: float = 2.0
    """Least clearance of the shapes on the way to a target, mm: what makes it reachable."""
    limit_mm: float = 0.5
    """The arm is too close to the plate where its clearance is less, mm."""
    visits: int = 3
    """Targets of an episode, each in another slot than the one before."""
    reach_mm: float = 1.0
    """A target is reached when the tip is this near, mm."""
    time_s: float = 30.0
    """Time for all targets, s."""
    far_mm: float = 20.0
    """Scale of the reward for the way that is left, mm."""
    world: WorldConfig = field(default_factory=WorldConfig)
    """The world and its randomisation."""

    def __post_init__(self):
        for name in ("deep_mm", "clear_mm", "visits", "reach_mm", "time_s", "far_mm"):
            if not getattr(self, name) > 0:
                raise InputError(f"keyhole: {name} is {getattr(self, name)}, expected above 0")


class Keyhole:
    """One arm and a slotted plate."""

    name, agents = "keyhole", ("arm",)

    def __init__(self, config: KeyholeConfig | None = None, device: str | torch.device = "cpu"):
        c = self.config = config or KeyholeConfig()
        self.world = plate_world(c.plate, c.height_mm, c.limit_mm, c.arm, c.world, device)
        self.dt_s = c.world.dt_s
        self.steps = round(c.time_s / self.dt_s)
        self.ways = clear_ways(self.world, c.plate, c.deep_mm, c.clear_mm)
        # In a step the tip goes no farther than this.
        self._stride_mm = 4.0 * self.arm.pneumatics.step_kPa / 3.0

    @property
    def arm(self) -> Arm:
        """The world's one arm."""
        return self.world.arms["arm"]

    def goal(self, stream: Stream) -> tuple[Stream, Tour]:
        return fresh_tour(stream, self.ways, self.config.visits)

    def way_mm(self, state: TaskState) -> Tensor:
        """(B, N, 3) mm: from the last target back to the middle, and on to the next one."""
        return way_mm(self.ways, state.goal)

    def error_mm(self, state: TaskState) -> Tensor:
        """(B,) mm: from the true tip to its target."""
        return (state.world.arms["arm"].tip_mm - self.way_mm(state)[:, -1]).norm(dim=1)

    def advance(self, state: TaskState, actions: Mapping[str, Tensor], in_place: bool) -> TaskState:
        """One step; a target that the tip has come to is followed by the next."""
        state = replace(state, world=self.world.step(state.world, actions, in_place=in_place))
        near = (self.error_mm(state) <= self.config.reach_mm) & ~self.ended(state)
        reached = (state.goal.reached + near).clamp(max=self.config.visits)
        return replace(state, goal=replace(state.goal, reached=reached))

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        """Body; tip to target, and to the way a stride on (asinh of mm); clearance; visits."""
        part, way = state.world.arms["arm"], self.way_mm(state)
        tip = part.seen_mm[:, -1]
        onward = place(way, progress(way, tip).along_mm + self._stride_mm)
        clear = state.world.scenery.clearance.least_mm[:, None] / 10.0
        visits = state.goal.reached[:, None] / self.config.visits
        time = state.world.steps[:, None] / self.steps
        errors = (way[:, -1] - tip).asinh(), (onward - tip).asinh()
        return {"arm": torch.cat((*body_part(self.arm, part), *errors, clear, visits, time), 1)}

    def rewards(self, state: TaskState) -> dict[str, dict[str, Tensor]]:
        """Way and near: what is left of the way; visits: targets reached; contact: too close.

        A visit is worth more than the other terms together, which fall when the next one begins.
        """
        clear, tip = state.world.scenery.clearance.least_mm, state.world.arms["arm"].tip_mm
        left = progress(self.way_mm(state), tip).left_mm
        terms = {
            "way": (-left / self.config.far_mm).exp(),
            "near": (-left / self.config.reach_mm).exp(),
            "visits": 3.0 * state.goal.reached,
            "contact": -(clear < self.config.limit_mm).float(),
        }
        return {"arm": terms}

    def ended(self, state: TaskState) -> Tensor:
        """The arm touches the plate or itself."""
        return state.world.scenery.clearance.collides

    def measures(self, state: TaskState) -> dict[str, Tensor]:
        clearance, tour = state.world.scenery.clearance, state.goal
        done, hit = tour.reached >= self.config.visits, clearance.collides
        way = progress(self.way_mm(state), state.world.arms["arm"].tip_mm)
        return {
            "left_mm": way.left_mm,
            "visited": tour.reached / self.config.visits,
            "clearance_mm": clearance.least_mm,
            "collided": hit.float(),
            "success": (done & ~hit).float(),
        }

    def trace(self, state: TaskState) -> tuple[Tensor, Tensor]:
        return self.way_mm(state)[:, -1:], state.world.arms["arm"].tip_mm[:, None]

    def script(self, state: TaskState) -> dict[str, Tensor]:
        """Damped least squares for the tip a stride on along the way."""
        part, way = state.world.arms["arm"], self.way_mm(state)
        onward = place(way, progress(way, part.tip_mm).along_mm + self._stride_mm)
        return {"arm": seek(self.arm, part, onward, _tip_error, self.dt_s)}


def _tip_error(points_mm: Tensor, target_mm: Tensor) -> Tensor:
    return points_mm[:, -1] - target_mm
