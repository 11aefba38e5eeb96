"""The beam of one arm follows a circle on a distant plane (Chen et al. 2025, sec. V, laser)."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.tasks.path_following import FOLLOW_PRESET, FOLLOW_STEPS, Follow, FollowConfig
from surgisoft.tasks.spec import TaskSpec
from surgisoft.tasks.supervision import WITHOUT_SUCCESS
from surgisoft.tasks.track import level_world, points_at_start
from surgisoft.tasks.world.arm import Arm
from surgisoft.tasks.world.world import WorldConfig

LEAST_SLOPE = 0.1
"""Sine of the smallest angle (6 degrees) at which a beam counts as meeting the plane."""


@dataclass(frozen=True)
class LaserPlaneConfig:
    """A path for the beam on a level plane beyond the tip."""

    follow: FollowConfig = field(default_factory=FollowConfig)
    """The path, the observation and the reward."""
    distance_mm: float = 40.0
    """Distance from the tip at the start to the plane, mm: the middle of the working distances of
    the laser in the phantom scene."""
    mean_kPa: float = 20.0
    """Pressure of all chambers that puts the beam's spot at the path's centre, kPa."""
    world: WorldConfig = field(default_factory=WorldConfig)
    """The simulator and its domain randomization."""

    def __post_init__(self):
        if not self.distance_mm > 0.0:
            raise InputError(f"laser_plane: distance_mm is {self.distance_mm}, expected above 0")


def laser_plane(
    config: LaserPlaneConfig | None = None, device: str | torch.device = "cpu"
) -> Follow:
    """The beam of one arm follows a circle of 20 mm diameter on a plane 40 mm beyond the tip."""
    config = config or LaserPlaneConfig()
    world = level_world(config.world, config.mean_kPa, config.follow.arm, device)
    world.arms["arm"].model.require_body("arm 'arm'")
    start = points_at_start(world)
    height = start[0, -1, 2] + config.distance_mm
    spot = BeamSpot(world.arms["arm"], height)
    centre = spot(start)[0]
    return Follow("laser_plane", world, config.follow, spot, centre, directions=2, whole=config)


LASER_PLANE = TaskSpec(
    laser_plane, LaserPlaneConfig(), ("arm",), FOLLOW_PRESET, FOLLOW_STEPS, WITHOUT_SUCCESS
)


@dataclass(frozen=True, eq=False)
class BeamSpot:
    """Where a beam along the axis of an arm's tip meets a level plane."""

    arm: Arm
    """The arm that carries the laser."""
    height_mm: Tensor
    """() mm: z of the plane, world frame."""

    def __call__(self, points_mm: Tensor, mount: Tensor | None = None) -> Tensor:
        """(B, 3) mm, world frame, for key points (B, n, 3) mm and a mount, see `Marker`."""
        mount = self.arm.pose if mount is None else mount
        aim = self.arm.backbone.tip_direction(points_mm, mount)
        return on_plane(points_mm[:, -1], aim, self.height_mm)


def on_plane(origin_mm: Tensor, direction: Tensor, height_mm: Tensor | float) -> Tensor:
    """(B, 3) mm: where rays from (B, 3) mm along unit vectors (B, 3) meet the plane z = height_mm.

    Rays flatter than LEAST_SLOPE, or away from the plane, are cut short, so the result is finite.
    """
    far = (height_mm - origin_mm[:, 2]) / direction[:, 2].clamp(min=LEAST_SLOPE)
    return origin_mm + far[:, None] * direction
