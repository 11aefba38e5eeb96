"""Two arms cut around a lesion: the endoscope looks, then the laser goes round (Chen et al. 2025).

The ring is cut while the endoscope sees enough of it; success is judged on the dose map.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

import surgisoft
from surgisoft.errors import InputError
from surgisoft.tasks.aim import Aim, body_part
from surgisoft.tasks.base import TaskState
from surgisoft.tasks.streams import Stream
from surgisoft.tasks.world import WorldConfig, scene_world

PHANTOM = Path(surgisoft.__file__).parents[1] / "scenes" / "phantom_liver"
"""The scene that comes with the project."""


@dataclass(frozen=True)
class CircleAblationConfig:
    """What is cut, how fast, and what it is worth; times and limits are the scene's own."""

    scene: str | Path = PHANTOM
    """Folder of the scene."""
    arm: str | Path | None = None
    """Arm model of both arms, `default` or a model's folder; None: those that the scene names."""
    cut_s: float = 45.0
    """Time for once around with the beam on, s."""
    fire_mm: float = 0.5
    """The beam is on while its axis passes the target within this, mm."""
    fine_mm: float = 0.1
    """Scale of the laser's second reward term, mm."""
    preview: int = 2
    """Coming targets that the laser arm knows, one a step."""
    world: WorldConfig = field(default_factory=WorldConfig)
    """The world and its randomisation."""

    def __post_init__(self):
        for name in ("cut_s", "fire_mm", "fine_mm", "preview"):
            if not getattr(self, name) > 0:
                raise InputError(f"circle_ablation: {name} is {getattr(self, name)}, expected > 0")


@dataclass(frozen=True, eq=False)
class Cut:
    """How far a batch of cuts is."""

    start: Tensor
    """(B,) 0..1: share of the ring where the cut begins."""
    way: Tensor
    """(B,) +1 or -1: which way round."""
    walked: Tensor
    """(B,) int64: steps that the target has moved on."""
    fired: Tensor
    """(B,) bool: the beam is on."""


class CircleAblation:
    """Agents `laser` and `endoscope` of a scene."""

    name, agents = "circle_ablation", ("laser", "endoscope")

    def __init__(self, config: CircleAblationConfig | None = None, device="cpu"):
        self.config = config or CircleAblationConfig()
        self.world = scene_world(self.config.scene, self.config.world, device, arm=self.config.arm)
        self.surroundings, dt_s = self.world.surroundings, self.world.config.dt_s
        self.spec = self.surroundings.spec
        self.steps = round(self.spec.limits.time_s / dt_s)
        self.round = round(self.config.cut_s / dt_s)
        self.aims = {name: Aim(arm, dt_s) for name, arm in self.world.arms.items()}

    def goal(self, stream: Stream) -> tuple[Stream, Cut]:
        stream, draw = stream.uniform(0.0, 1.0, 2)
        walked = torch.zeros_like(stream.count)
        way = torch.where(draw[:, 1] < 0.5, 1.0, -1.0)
        return stream, Cut(draw[:, 0], way, walked, walked > 0)

    def target_mm(self, cut: Cut, ahead: int = 0) -> Tensor:
        """(B, 3) mm: where the beam should meet the ring, `ahead` steps further on."""
        path = self.surroundings.path_mm
        place = (cut.start + cut.way * (cut.walked + ahead) / self.round) * len(path)
        below = place.floor()
        first = below.long().remainder(len(path))
        return torch.lerp(path[first], path[(first + 1) % len(path)], (place - below)[:, None])

    def beam_error_mm(self, state: TaskState) -> Tensor:
        """(B,) mm: how far the beam's axis passes from its target."""
        laser = state.world.arms["laser"]
        return self.aims["laser"].miss(laser.points_mm, self.target_mm(state.goal)).norm(dim=1)

    def advance(self, state: TaskState, actions: Mapping[str, Tensor], in_place: bool) -> TaskState:
        """The beam fires, and its target goes on, while three things hold.

        The endoscope sees enough of the ring, the axis passes the target closely, and nothing but
        the organ stands in the beam.
        """
        scenery, cut = state.world.scenery, state.goal
        seen = scenery.view.fraction >= self.spec.limits.view_fraction
        near = self.beam_error_mm(state) <= self.config.fire_mm
        fired = seen & near & scenery.hit.on_organ
        cut = replace(cut, walked=cut.walked + fired, fired=fired)
        power = fired * self.spec.laser.power_w
        return TaskState(self.world.step(state.world, actions, power, in_place), cut)

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        """Each arm's body and the other's tip; misses of the beam and of the camera's axis."""
        arms, scenery, cut = state.world.arms, state.world.scenery, state.goal
        laser, eye, count = arms["laser"], arms["endoscope"], len(cut.walked)
        ahead = [self.target_mm(cut, k) for k in range(self.config.preview + 1)]
        misses = [self.aims["laser"].miss(laser.seen_mm, target).asinh() for target in ahead]
        centre = self.surroundings.centre_mm.expand(count, 3)
        look = self.aims["endoscope"].miss(eye.seen_mm, centre).asinh()
        apart = (laser.seen_mm[:, -1] - eye.seen_mm[:, -1]) / 50.0
        time = state.world.steps[:, None] / self.steps
        turn = 2.0 * math.pi * (cut.start + cut.way * cut.walked / self.round)[:, None]
        shared = [scenery.view.fraction[:, None], cut.fired[:, None].float(), time, apart]
        place = [turn.sin(), turn.cos(), cut.way[:, None]]
        return {
            "laser": torch.cat(
                (*body_part(self.world.arms["laser"], laser), *misses, *place, *shared), 1
            ),
            "endoscope": torch.cat(
                (*body_part(self.world.arms["endoscope"], eye), look, *shared), 1
            ),
        }

    def rewards(self, state: TaskState) -> dict[str, dict[str, Tensor]]:
        """Aim and look: exp(-e); cut: the beam is on; contact: too close to anything."""
        error, view, cut = self.beam_error_mm(state), state.world.scenery.view, state.goal
        close = -(state.world.scenery.clearance.least_mm < self.spec.limits.clearance_mm).float()
        laser = {
            "aim": (-error).exp(),
            "fine": (-error / self.config.fine_mm).exp(),
            "cut": cut.fired.float(),
            "contact": close,
        }
        look = {"look": (-view.axis_error_mm / 10.0).exp(), "view": view.fraction}
        return {"laser": laser, "endoscope": {**look, "cut": cut.fired.float(), "contact": close}}

    def ended(self, state: TaskState) -> Tensor:
        """The ring is cut, or something is hit."""
        ring = self.surroundings.ablation.report(state.world.scenery.dose)
        return state.world.scenery.clearance.collides | (ring.completion >= 1.0)

    def measures(self, state: TaskState) -> dict[str, Tensor]:
        scenery = state.world.scenery
        ring = self.surroundings.ablation.report(scenery.dose)
        hit = scenery.clearance.collides
        return {
            "beam_error_mm": self.beam_error_mm(state).where(state.goal.fired, float("nan")),
            "completion": ring.completion,
            "largest_gap_mm": ring.largest_gap_mm,
            "healthy_mm2": ring.healthy_mm2,
            "view_fraction": scenery.view.fraction,
            "clearance_mm": scenery.clearance.least_mm,
            "collided": hit.float(),
            "success": ((ring.completion >= 1.0) & ~hit).float(),
        }

    def trace(self, state: TaskState) -> tuple[Tensor, Tensor]:
        """The place on the ring, and where the beam ends."""
        return self.target_mm(state.goal)[:, None], state.world.scenery.hit.point_mm[:, None]

    def script(self, state: TaskState) -> dict[str, Tensor]:
        """The laser aims at its next target, the endoscope at the lesion's middle."""
        arms, count = state.world.arms, len(state.goal.walked)
        centre = self.surroundings.centre_mm.expand(count, 3)
        on_ring = self.target_mm(state.goal, 1)
        return {
            "laser": self.aims["laser"].action(arms["laser"], on_ring),
            "endoscope": self.aims["endoscope"].action(arms["endoscope"], centre),
        }
