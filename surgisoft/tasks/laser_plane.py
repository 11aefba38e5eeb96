"""The beam of one arm follows a circle on a distant plane (Chen et al. 2025, sec. V, laser)."""

from __future__ import annotations

from dataclasses import dataclass, field

from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.tasks.path_following import Follow, FollowConfig
from surgisoft.tasks.track import level_world, points_at_start
from surgisoft.tasks.world.world import WorldConfig

LEAST_SLOPE = 0.1
"""A beam flatter to the plane than this sine (6 degrees) is taken to end before it."""


@dataclass(frozen=True)
class LaserPlaneConfig:
    """A path for the beam on a level plane beyond the tip."""

    follow: FollowConfig = field(default_factory=FollowConfig)
    """The path and how it is walked."""
    distance_mm: float = 40.0
    """From the tip at the start to the plane, mm; the middle of the scene's laser's standoff."""
    mean_kPa: float = 20.0
    """Pressure of all chambers with which the beam meets the path's middle, kPa."""
    world: WorldConfig = field(default_factory=WorldConfig)
    """The world and its randomisation."""

    def __post_init__(self):
        if not self.distance_mm > 0.0:
            raise InputError(f"laser_plane: distance_mm is {self.distance_mm}, expected above 0")


def laser_plane(config: LaserPlaneConfig | None = None, device: str = "cpu") -> Follow:
    """A circle of 20 mm diameter on a plane 40 mm beyond the tip."""
    config = config or LaserPlaneConfig()
    world = level_world(config.world, config.mean_kPa, config.follow.arm, device)
    start, backbone = points_at_start(world), world.arms["arm"].backbone
    height = start[0, -1, 2] + config.distance_mm

    def spot(points_mm: Tensor) -> Tensor:
        return on_plane(points_mm[:, -1], backbone.tip_direction(points_mm), height)

    return Follow("laser_plane", world, config.follow, spot, spot(start)[0], directions=2)


def on_plane(origin_mm: Tensor, direction: Tensor, height_mm: Tensor | float) -> Tensor:
    """(B, 3) mm: where rays (B, 3) along (B, 3) meet the plane z = height_mm.

    A ray that runs flatter than LEAST_SLOPE, or away, ends before the plane: always finite.
    """
    far = (height_mm - origin_mm[:, 2]) / direction[:, 2].clamp(min=LEAST_SLOPE)
    return origin_mm + far[:, None] * direction
