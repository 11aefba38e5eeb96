"""The tip of one arm follows a circle or a square (Chen et al. 2025, sec. V, simulation)."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from surgisoft.tasks.path_following import FOLLOW_PRESET, FOLLOW_STEPS, Follow, FollowConfig
from surgisoft.tasks.spec import TaskSpec
from surgisoft.tasks.supervision import WITHOUT_SUCCESS
from surgisoft.tasks.world.arm import Randomisation
from surgisoft.tasks.world.random_streams import streams
from surgisoft.tasks.world.world import World, WorldConfig, named_arm, single_arm_world


@dataclass(frozen=True)
class TrackConfig:
    """A level path for the tip, above the base."""

    follow: FollowConfig = field(default_factory=FollowConfig)
    """The path, the observation and the reward."""
    mean_kPa: float = 20.0
    """Pressure of all chambers that puts the tip at the path's centre, kPa."""
    world: WorldConfig = field(default_factory=WorldConfig)
    """The simulator and its domain randomization."""


SQUARE = TrackConfig(FollowConfig(path="square", size_mm=15.0))
"""Default configuration of `track_square`."""


def track_circle(config: TrackConfig | None = None, device: str | torch.device = "cpu") -> Follow:
    """The tip of one arm follows a circle of 20 mm diameter."""
    return _track("track_circle", config or TrackConfig(), device)


def track_square(config: TrackConfig | None = None, device: str | torch.device = "cpu") -> Follow:
    """The tip of one arm follows a square of 15 mm edge."""
    return _track("track_square", config or SQUARE, device)


TRACK_CIRCLE = TaskSpec(
    track_circle, TrackConfig(), ("arm",), FOLLOW_PRESET, FOLLOW_STEPS, WITHOUT_SUCCESS
)
TRACK_SQUARE = TaskSpec(
    track_square, SQUARE, ("arm",), FOLLOW_PRESET, FOLLOW_STEPS, WITHOUT_SUCCESS
)


def tip(points_mm: Tensor, mount: Tensor | None = None) -> Tensor:
    """(B, 3) mm: the tip, which is the last of the key points (B, n, 3) mm, wherever the mount."""
    return points_mm[:, -1]


def _track(name: str, config: TrackConfig, device) -> Follow:
    world = level_world(config.world, config.mean_kPa, config.follow.arm, device)
    centre = tip(points_at_start(world))[0]
    return Follow(name, world, config.follow, tip, centre, directions=3, whole=config)


def level_world(
    config: WorldConfig, mean_kPa: float, arm: str | Path, device: str | torch.device
) -> World:
    """A world of the named arm model alone, which starts with mean_kPa in every chamber."""
    model = named_arm(arm, device)
    return single_arm_world(config, model, (mean_kPa,) * model.spec.chambers, device)


def points_at_start(world: World) -> Tensor:
    """(1, n, 3) mm: key points of the world's only arm at the start, without randomization."""
    plain = Randomisation(history=0, start_kPa=0.0)
    arm = world.arms["arm"]
    config = replace(world.config, randomisation=plain)
    start = tuple(arm.first.tolist())
    still = single_arm_world(config, arm.model, start, world.device)
    return still.start(streams(0, 1, device=world.device)).arms["arm"].points_mm
