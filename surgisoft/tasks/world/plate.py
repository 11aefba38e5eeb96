"""One arm through a slotted plate: the world, and collision-free routes of the tip."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.scene.mesh import Body
from surgisoft.scene.plate import SlottedPlate
from surgisoft.tasks.world.arm import Arm, Mounted, radius_mm
from surgisoft.tasks.world.scene import ObstacleEngine
from surgisoft.tasks.world.world import World, WorldConfig, named_arm, single_arm_world

GRID = 14
"""Pressures of each chamber in the grid search for targets, of up to four chambers."""
MOST_SHAPES = 40_000
"""Most shapes of that grid: arms with more chambers have fewer pressures of each."""
EDGE = 0.05
"""Margin at either end of a chamber's range that targets leave for hysteresis, as a share of it."""
ROUTE_POINTS = 9
"""Shapes on the route from the arm at rest to a target."""


def plate_world(
    plate: SlottedPlate,
    height_mm: float,
    clearance_mm: float,
    arm: str | Path,
    config: WorldConfig,
    device: str | torch.device,
) -> World:
    """A world with the named arm model, upright, through the middle of a plate.

    height_mm: from the arm's base to the plate's lower side. clearance_mm: limit below which the
    arm counts as too close.
    """
    model = named_arm(arm, device)
    alone = single_arm_world(config, model, device=device).arms["arm"]
    rest = alone.settled(alone.first[None])
    line = alone.backbone.centreline(rest, alone.pose)[0].cpu().double().numpy()
    if not 0.0 < height_mm < line[-1, 2] - plate.thickness_mm:
        raise InputError(
            f"plate: height_mm is {height_mm}, expected above 0 and below the tip at rest, "
            f"{line[-1, 2]:.3g} mm, by more than the plate's thickness"
        )
    pose = np.eye(4)
    pose[:2, 3] = [np.interp(height_mm, line[:, 2], line[:, k]) for k in range(2)]
    pose[2, 3] = height_mm
    radii = {"arm": radius_mm(model)}
    bodies = (Body("plate", "keep-out", plate.mesh(), pose),)
    engine = ObstacleEngine(bodies, radii, config.scene_engine.geometry, device, clearance_mm)
    return World({"arm": Mounted(model, torch.eye(4))}, config, engine, device)


@dataclass(frozen=True, eq=False)
class Routes:
    """T routes of the tip from the arm at rest into the slots, sorted by slot; world frame."""

    points_mm: Tensor
    """(T, ROUTE_POINTS, 3) mm: from rest to the target."""
    first: Tensor
    """(S + 1,) int64: slot s has the routes from first[s] to first[s + 1] - 1."""


def clear_routes(
    world: World, plate: SlottedPlate, deep_mm: float, clear_mm: float, wide_rad: float = 0.3
) -> Routes:
    """Find the routes to shapes whose tip is deep_mm or more from its rest position, along a slot.

    Along a route pressures change linearly, and no shape comes nearer than clear_mm to the plate.
    wide_rad: largest angle between the tip's displacement and the slot.
    """
    arm = world.arms["arm"]
    room = EDGE * (arm.high - arm.low)
    bounds = zip(arm.low + room, arm.high - room, strict=True)
    count = min(GRID, int(MOST_SHAPES ** (1.0 / arm.chambers)))
    ends = [torch.linspace(low, high, count) for low, high in bounds]
    pressure = torch.cartesian_prod(*ends).to(world.device).reshape(-1, arm.chambers)
    home = arm.settled(arm.first[None])[0, -1]
    aside = (arm.settled(pressure)[:, -1] - home)[:, :2]
    angle = torch.atan2(aside[:, 1], aside[:, 0])
    slots = torch.tensor(plate.directions_rad(), dtype=angle.dtype, device=angle.device)
    off = torch.atan2((angle[:, None] - slots).sin(), (angle[:, None] - slots).cos()).abs()
    chosen = (aside.norm(dim=1) >= deep_mm) & (off.amin(1) <= wide_rad)
    pressure, slot = pressure[chosen], off[chosen].argmin(1)
    points, clear = _along_routes(world, arm, pressure)
    kept = clear >= clear_mm
    slot, order = slot[kept].sort(stable=True)
    counts = torch.bincount(slot, minlength=plate.slots)
    if (counts == 0).any():
        raise InputError(
            f"keyhole: no shape reaches {deep_mm:g} mm into slot {int(counts.argmin())} with "
            f"{clear_mm:g} mm to spare; expected wider slots, less depth or another arm"
        )
    return Routes(points[kept][order], torch.cat((counts.new_zeros(1), counts.cumsum(0))))


def _along_routes(world: World, arm: Arm, pressure: Tensor) -> tuple[Tensor, Tensor]:
    """Tips (T, ROUTE_POINTS, 3) mm on routes to pressures (T, m); the least clearances (T,) mm."""
    share = torch.linspace(0.0, 1.0, ROUTE_POINTS, device=pressure.device)[:, None]
    steps = arm.first + share * (pressure[:, None] - arm.first)
    bodies = arm.settled(steps.flatten(0, 1))
    lines = arm.backbone.centreline(bodies, arm.pose)
    assert world.scene is not None, "the plate"
    clear = world.scene.geometry.clearance({"arm": lines}).least_mm
    return bodies[:, -1].unflatten(0, (-1, ROUTE_POINTS)), clear.unflatten(
        0, (-1, ROUTE_POINTS)
    ).amin(1)
