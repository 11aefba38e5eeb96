"""Two arms cut around a lesion: the endoscope looks, then the laser goes round (Chen et al. 2025).

The ring is cut while the endoscope sees enough of it; success is judged on the dose map.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.tasks.base import TaskState
from surgisoft.tasks.inverse_kinematics import Aim, body_part
from surgisoft.tasks.trajectories import along, fresh_cut, further
from surgisoft.tasks.world.scene import PHANTOM
from surgisoft.tasks.world.world import WorldConfig, scene_world

FAR_MM = 10.0
"""Scale of the reward terms that reach far, mm."""


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
        self.goal = fresh_cut

    @property
    def aims(self) -> dict[str, Aim]:
        """Each arm's axis, by the arm's name."""
        dt_s = self.world.config.dt_s
        return {name: Aim(arm, dt_s) for name, arm in self.world.arms.items()}

    def target_mm(self, state: TaskState, ahead: int = 0) -> Tensor:
        """(B, 3) mm: where the beam should meet the ring, `ahead` steps further on."""
        share = state.goal.share(self.round, ahead)
        return along(self.surroundings.paths_mm, state.world.scenery.lesion, share)

    def centre_mm(self, state: TaskState) -> Tensor:
        """(B, 3) mm: the middle of the lesion."""
        return self.surroundings.centres_mm[state.world.scenery.lesion]

    def beam_error_mm(self, state: TaskState) -> Tensor:
        """(B,) mm: how far the beam's axis passes from its target."""
        laser = state.world.arms["laser"]
        return self.aims["laser"].miss(laser.points_mm, self.target_mm(state)).norm(dim=1)

    def fires(self, state: TaskState) -> Tensor:
        """(B,) bool: the endoscope sees the ring, the axis passes the target, tissue is hit."""
        scenery = state.world.scenery
        seen = scenery.view.fraction >= self.spec.limits.view_fraction
        near = self.beam_error_mm(state) <= self.config.fire_mm
        return seen & near & scenery.hit.on_organ

    def advance(self, state: TaskState, actions, in_place: bool, fired=None) -> TaskState:
        """The beam is on, and its target goes on, where `fired` (B,) bool says; None: `fires`."""
        fired = self.fires(state) if fired is None else fired
        world = self.world.step(state.world, actions, fired * self.spec.laser.power_w, in_place)
        return TaskState(world, further(state.goal, fired))

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        """Each arm's body and the other's tip; misses of the beam and of the camera's axis."""
        arms, scenery, cut = state.world.arms, state.world.scenery, state.goal
        laser, eye, aim = arms["laser"], arms["endoscope"], self.aims["laser"]
        ahead = [self.target_mm(state, k) for k in range(self.config.preview + 1)]
        misses = [aim.miss(laser.seen_mm, target).asinh() for target in ahead]
        look = self.aims["endoscope"].miss(eye.seen_mm, self.centre_mm(state)).asinh()
        apart = (laser.seen_mm[:, -1] - eye.seen_mm[:, -1]) / 50.0
        time = state.world.steps[:, None] / self.steps
        shared = [scenery.view.fraction[:, None], cut.fired[:, None].float(), time, apart]
        bodies = {name: body_part(self.world.arms[name], part) for name, part in arms.items()}
        own = {"laser": (*misses, *cut.seen(self.round)), "endoscope": (look,)}
        return {name: torch.cat((*bodies[name], *own[name], *shared), 1) for name in self.agents}

    def rewards(self, state: TaskState) -> dict[str, dict[str, Tensor]]:
        """Aim and look; cut: the beam is on; contact: too close to anything.

        exp(-e / scale) is flat tens of mm off, where an episode begins; 1 / (1 + e / FAR_MM) not.
        """
        error, view = self.beam_error_mm(state), state.world.scenery.view
        cut = state.goal.fired.float()
        close = -(state.world.scenery.clearance.least_mm < self.spec.limits.clearance_mm).float()
        aim = {
            "far": 1.0 / (1.0 + error / FAR_MM),
            "aim": (-error).exp(),
            "fine": (-error / self.config.fine_mm).exp(),
        }
        look = {"look": 1.0 / (1.0 + view.axis_error_mm / FAR_MM), "view": view.fraction}
        both = {"cut": cut, "contact": close}
        return {"laser": {**aim, **both}, "endoscope": {**look, **both}}

    def ended(self, state: TaskState) -> Tensor:
        """The ring is cut, or something is hit."""
        done = self.surroundings.ablation.report(state.world.scenery.dose).completion >= 1.0
        return done | state.world.scenery.clearance.collides

    def measures(self, state: TaskState) -> dict[str, Tensor]:
        scenery = state.world.scenery
        ring, hit = self.surroundings.ablation.report(scenery.dose), scenery.clearance.collides
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
        return self.target_mm(state)[:, None], state.world.scenery.hit.point_mm[:, None]

    def script(self, state: TaskState) -> dict[str, Tensor]:
        """The laser aims at its next target, the endoscope at the lesion's middle."""
        aims = {"laser": self.target_mm(state, 1), "endoscope": self.centre_mm(state)}
        return {n: self.aims[n].action(state.world.arms[n], aim) for n, aim in aims.items()}
