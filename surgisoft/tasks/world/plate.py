"""One arm through a slotted plate: the world, and ways of the tip on which the body stays clear."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.mesh import Body
from surgisoft.scene.plate import SlottedPlate
from surgisoft.tasks.world.arm import Arm, ArmPart, Mounted
from surgisoft.tasks.world.random import Stream
from surgisoft.tasks.world.scene import Scenery, judge_of
from surgisoft.tasks.world.world import World, WorldConfig, lone_arm, named_arm

GRID = 14
"""Pressures of each chamber that are tried for targets."""
EDGE = 0.05
"""Share of a chamber's range at either end that targets leave to the arm's memory."""
WAY_POINTS = 9
"""Shapes on the way from the arm at rest to a target's."""
NO_DIAMETER_MM = 15.0
"""Thickness of an arm whose model does not say it (mm): the paper's."""


class Walls:
    """Bodies that an arm keeps clear of, and nothing else; holds no state."""

    def __init__(self, bodies, radii_mm, geometry: str, device, clearance_mm: float = 0.0):
        """clearance_mm: nearer than this is too close; geometry as in `SceneryConfig`."""
        self.clearance_mm, self.geometry = clearance_mm, BatchedScene(bodies, radii_mm, device)
        self.judge = judge_of(geometry, self.geometry)

    def start(self, stream: Stream, parts: Mapping[str, ArmPart]) -> tuple[Stream, Scenery]:
        """How clear the arms are at the start of an episode."""
        return stream, self.step(None, parts)

    def step(self, _scenery, parts: Mapping[str, ArmPart], *_beam) -> Scenery:
        """How clear the moved arms are; there is no beam."""
        lines = {name: part.line_mm for name, part in parts.items()}
        return Scenery(self.judge.clearance(lines))


def plate_world(
    plate: SlottedPlate,
    height_mm: float,
    clearance_mm: float,
    arm: str | Path,
    config: WorldConfig,
    device: str | torch.device,
) -> World:
    """The named arm model, upright, and a plate whose middle it passes at rest.

    height_mm: from the arm's base to the plate's lower side; clearance_mm: nearer is too close.
    """
    model = named_arm(arm, device)
    alone = lone_arm(config, model, device=device).arms["arm"]
    line = alone.backbone.centreline(alone.settled(alone.first[None]))[0].cpu().double().numpy()
    if not 0.0 < height_mm < line[-1, 2] - plate.thickness_mm:
        raise InputError(
            f"plate: height_mm is {height_mm}, expected above 0 and below the tip at rest, "
            f"{line[-1, 2]:.3g} mm, by more than the plate's thickness"
        )
    pose = np.eye(4)
    pose[:2, 3] = [np.interp(height_mm, line[:, 2], line[:, k]) for k in range(2)]
    pose[2, 3] = height_mm
    radii = {"arm": 0.5 * (model.spec.diameter_mm or NO_DIAMETER_MM)}
    bodies = (Body("plate", "keep-out", plate.mesh(), pose),)
    walls = Walls(bodies, radii, config.scenery.geometry, device, clearance_mm)
    return World({"arm": Mounted(model, torch.eye(4))}, config, walls, device)


@dataclass(frozen=True, eq=False)
class Ways:
    """T ways of the tip from the arm at rest into the slots, sorted by slot; world frame."""

    points_mm: Tensor
    """(T, WAY_POINTS, 3) mm: from rest to the target."""
    first: Tensor
    """(S + 1,) int64: slot s has the ways from first[s] to first[s + 1] - 1."""


def clear_ways(
    world: World, plate: SlottedPlate, deep_mm: float, clear_mm: float, wide_rad: float = 0.3
) -> Ways:
    """Ways to shapes whose tip is deep_mm or more from where it rests, along a slot.

    On each, pressures change evenly and no shape comes nearer than clear_mm to the plate.
    """
    arm = world.arms["arm"]
    room = EDGE * (arm.high - arm.low)
    bounds = zip(arm.low + room, arm.high - room, strict=True)
    ends = [torch.linspace(low, high, GRID) for low, high in bounds]
    pressure = torch.cartesian_prod(*ends).to(world.device).reshape(-1, arm.chambers)
    home = arm.settled(arm.first[None])[0, -1]
    aside = (arm.settled(pressure)[:, -1] - home)[:, :2]
    angle = torch.atan2(aside[:, 1], aside[:, 0])
    slots = torch.tensor(plate.directions_rad(), dtype=angle.dtype, device=angle.device)
    off = torch.atan2((angle[:, None] - slots).sin(), (angle[:, None] - slots).cos()).abs()
    chosen = (aside.norm(dim=1) >= deep_mm) & (off.amin(1) <= wide_rad)
    pressure, slot = pressure[chosen], off[chosen].argmin(1)
    points, clear = _walked(world, arm, pressure)
    kept = clear >= clear_mm
    slot, order = slot[kept].sort(stable=True)
    counts = torch.bincount(slot, minlength=plate.slots)
    if (counts == 0).any():
        raise InputError(
            f"keyhole: no shape reaches {deep_mm:g} mm into slot {int(counts.argmin())} with "
            f"{clear_mm:g} mm to spare; expected wider slots, less depth or another arm"
        )
    return Ways(points[kept][order], torch.cat((counts.new_zeros(1), counts.cumsum(0))))


def _walked(world: World, arm: Arm, pressure: Tensor) -> tuple[Tensor, Tensor]:
    """Tips (T, WAY_POINTS, 3) mm on the ways to pressures (T, m), and the least clearance (T,)."""
    share = torch.linspace(0.0, 1.0, WAY_POINTS, device=pressure.device)[:, None]
    steps = arm.first + share * (pressure[:, None] - arm.first)
    bodies = arm.settled(steps.flatten(0, 1))
    lines = arm.backbone.centreline(bodies)
    clear = world.surroundings.geometry.clearance({"arm": lines}).least_mm
    return bodies[:, -1].unflatten(0, (-1, WAY_POINTS)), clear.unflatten(0, (-1, WAY_POINTS)).amin(
        1
    )
