"""Two arms treat a lesion's whole surface to a dose and spare the healthy tissue beyond a margin.

The laser, defocused to a wider spot, follows a raster over the inside of each outline; a policy may
leave it by as much as `fire_mm`. The result is the dose map: which share of the lesion has the dose
and how much healthy tissue was ablated.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.tasks import laser_work
from surgisoft.tasks.base import TaskSpec, TaskState
from surgisoft.tasks.laser_supervision import completed, laser_experiment
from surgisoft.tasks.laser_work import DONE, EndoscopeWeights
from surgisoft.tasks.observations import Block, ObservationBlocks, joined
from surgisoft.tasks.supervision import Condition
from surgisoft.tasks.trajectories.routes import RouteProgress, draw_route, route_steps
from surgisoft.tasks.world.random_streams import Stream
from surgisoft.tasks.world.scene import PHANTOM
from surgisoft.tasks.world.treatment import AreaPlan, ContourSpec
from surgisoft.tasks.world.world import WorldConfig, scene_world

LEAP_STEPS = 2.5
"""Two targets farther apart than this many steps of the reference lie in different areas; at the
end of a row the next one begins nearer than that, or the beam would burn on the way."""
TREATED = Block("treated", "share of the lesions' area that has the dose", "-", "x", 0.0, 1.0)


@dataclass(frozen=True)
class AreaLaserWeights:
    """Weights of the laser's reward terms; e is the distance of the beam from its target, mm."""

    far: float = 1.0
    """1 / (1 + e / far_mm)."""
    aim: float = 1.0
    """exp(-e / 1 mm)."""
    fine: float = 1.0
    """exp(-e / fine_mm)."""
    cut: float = 1.0
    """1 while the beam is on, else 0."""
    treated: float = 1.0
    """Share of the lesions' area that has the dose."""
    healthy: float = -0.1
    """Area of healthy tissue ablated beyond the margin, mm^2."""
    contact: float = -1.0
    """1 while the clearance of any arm is below the scene's limit, else 0."""


@dataclass(frozen=True)
class AreaAblationWeights:
    """Weights of the reward terms of both agents."""

    laser: AreaLaserWeights = field(default_factory=AreaLaserWeights)
    """Weights of the laser's reward terms."""
    endoscope: EndoscopeWeights = field(default_factory=EndoscopeWeights)
    """Weights of the endoscope's reward terms."""


@dataclass(frozen=True)
class AreaAblationConfig:
    """The scene, the areas and their dose, the raster, the observation and the reward.

    Safety limits come from the scene's file.
    """

    scene: str | Path = PHANTOM
    """Folder of the scene."""
    arm: str | Path | None = None
    """Arm model of both arms: `default`, or a folder; None: the models that the scene names."""
    outlines: tuple[ContourSpec, ...] = ()
    """Outlines of the lesions, treated in this order; none: the ring around the scene's lesion."""
    dose_j_per_mm2: float = 2.0
    """Dose from which a place counts as treated, J/mm^2; liver is ablated from 0.22 on."""
    treated_share: float = 0.98
    """Share of the lesions' area that has to have the dose."""
    spared_mm: float = 2.0
    """Margin around an outline in which ablated tissue does not count as healthy, mm."""
    healthy_mm2: float = 5.0
    """Most area of healthy tissue beyond the margin that may be ablated, mm^2."""
    spot_mm: float = 2.0
    """Diameter of the defocused beam on the tissue at 1/e^2, mm."""
    pitch_mm: float = 1.2
    """Distance of neighbouring lines of the raster, mm."""
    overrun_mm: float = 0.5
    """Distance by which the raster reaches beyond the outline, so that its edge has the dose, mm.
    """
    speed_mm_s: float = 6.0
    """Speed of the reference along the raster while the beam is on, mm/s."""
    time_s: float = 75.0
    """Time for all areas, s."""
    fire_mm: float = 1.0
    """Measured distance of the beam from its target within which the beam is switched on, mm."""
    approach_s: float = 5.0
    """Time at the beginning that the measure `pointing_error_mm` leaves out, s."""
    fine_mm: float = 0.3
    """Scale of the reward term `fine`, mm."""
    far_mm: float = 10.0
    """Scale of the reward terms `far` and `look`, mm."""
    weights: AreaAblationWeights = field(default_factory=AreaAblationWeights)
    """Weights of the reward terms."""
    preview: int = 3
    """Future targets in the laser's observation, one per step (a count)."""
    world: WorldConfig = field(default_factory=WorldConfig)
    """The simulator and its domain randomization."""

    @property
    def at_lesion(self) -> bool:
        """Whether the scene's lesion may be what is treated; not with outlines of one's own."""
        return not self.outlines

    def __post_init__(self):
        positive = ("dose_j_per_mm2", "treated_share", "spot_mm", "pitch_mm", "speed_mm_s")
        others = ("time_s", "fire_mm", "approach_s", "fine_mm", "far_mm", "preview", "spared_mm")
        laser_work.check_config("area_ablation", self, (*positive, *others))
        for name in ("healthy_mm2", "overrun_mm"):
            if not getattr(self, name) >= 0.0:
                raise InputError(f"area_ablation: {name} is {getattr(self, name)}, expected >= 0")
        if self.treated_share > 1.0:
            raise InputError(
                f"area_ablation: treated_share is {self.treated_share}, expected at most 1"
            )


def success_rule(config: AreaAblationConfig) -> str:
    """What an episode needs to be a success, in words; `measures` computes it."""
    return (
        f"{100.0 * config.treated_share:g} % of the lesions' area has {config.dose_j_per_mm2:g} "
        f"J/mm2 or more, at most {config.healthy_mm2:g} mm2 of healthy tissue more than "
        f"{config.spared_mm:g} mm outside are ablated, without contact; the beam is on only within "
        f"{config.fire_mm:g} mm of its target (fire_mm)"
    )


class AreaAblation:
    """Two arms of a scene: agents `laser` and `endoscope`."""

    name, agents = "area_ablation", laser_work.AGENTS

    def __init__(
        self, config: AreaAblationConfig | None = None, device: str | torch.device = "cpu"
    ):
        c = self.config = config or AreaAblationConfig()
        plan = AreaPlan(
            step_mm=c.speed_mm_s * c.world.dt_s,
            pitch_mm=c.pitch_mm,
            overrun_mm=c.overrun_mm,
            spared_mm=c.spared_mm,
            spot_mm=c.spot_mm,
            dose_j_per_mm2=c.dose_j_per_mm2,
            contours=c.outlines,
        )
        self.world = scene_world(c.scene, c.world, device, arm=c.arm, agents=self.agents, plan=plan)
        self.scene, self.dt_s = self.world.scene, self.world.config.dt_s
        self.spec = self.scene.spec
        self.steps = round(c.time_s / self.dt_s)
        least = route_steps(self.scene.stretches, 0)
        if least > self.steps:
            raise InputError(
                f"area_ablation: the raster takes {least * self.dt_s:.0f} s at {c.speed_mm_s:g} "
                f"mm/s, and time_s is {c.time_s:g} s; raise time_s or speed_mm_s"
            )
        self.area_mm2 = self.scene.ablation.zone_areas_mm2[0]
        self.weights = {"laser": c.weights.laser, "endoscope": c.weights.endoscope}

    def goal(self, stream: Stream) -> tuple[Stream, RouteProgress]:
        """Draw from which end each raster is followed, for each random number stream."""
        return draw_route(stream, self.scene.stretches, 0)

    def target_mm(self, state: TaskState[RouteProgress], ahead: int = 0) -> Tensor:
        """(B, 3) mm: the reference point on the raster `ahead` steps further on."""
        return self.scene.path_mm[state.goal.point(ahead)]

    def watched_mm(self, state: TaskState[RouteProgress]) -> Tensor:
        """(B, 3) mm: middle of the outline that has to be seen."""
        return self.scene.looks_mm[state.goal.point()].mean(1)

    def fires(self, state: TaskState[RouteProgress]) -> Tensor:
        """(B,) bool: whether the beam would be on, see `laser_work.beam_released`; never on the way
        from one area to the next."""
        return laser_work.beam_released(self, state) & ~self.leaps(state)

    def leaps(self, state: TaskState[RouteProgress]) -> Tensor:
        """(B,) bool: the reference is at the end of an area, and goes on to the next one."""
        ahead = self.target_mm(state, 1) - self.target_mm(state)
        return ahead.norm(dim=1) > LEAP_STEPS * self.config.speed_mm_s * self.dt_s

    def advance(
        self,
        state: TaskState[RouteProgress],
        actions: Mapping[str, Tensor],
        fired: Tensor | None = None,
    ) -> TaskState[RouteProgress]:
        """Advance arms and tissue; where `fired` (B,) bool is set the beam burns for the step and
        the reference moves on. None: where `fires` holds. At the end of an area the reference
        moves on without the beam.
        """
        released, leap = laser_work.beam_released(self, state), self.leaps(state)
        fired = (released if fired is None else fired) & ~leap
        goal = state.goal.after(fired, fired | (released & leap))
        near = replace(state.world.scene, watched=goal.point())
        power_w = {"laser": fired * self.spec.laser.power_w}
        return TaskState(self.world.step(replace(state.world, scene=near), actions, power_w), goal)

    def treated(self, state: TaskState[RouteProgress]) -> tuple[Tensor, Tensor]:
        """(B,) 0..1: share of the lesions' area that has the dose; (B,) mm^2: healthy area
        ablated."""
        areas = state.world.scene.dose.zone_mm2
        return areas[:, 0] / self.area_mm2, areas[:, 2]

    def blocks(self, state: TaskState[RouteProgress]) -> dict[str, ObservationBlocks]:
        """Observation blocks: body and pointing error of each arm, raster and treated share."""
        share, _ = self.treated(state)
        more = {DONE: state.goal.share[:, None], TREATED: share[:, None]}
        return laser_work.blocks(self, state, {}, more)

    def observe(self, state: TaskState[RouteProgress]) -> dict[str, Tensor]:
        """Concatenated observation blocks, agent -> (B, D)."""
        return {agent: joined(blocks) for agent, blocks in self.blocks(state).items()}

    def rewards(self, state: TaskState[RouteProgress]) -> dict[str, dict[str, Tensor]]:
        """Weighted reward terms, see `AreaLaserWeights` and `EndoscopeWeights`."""
        share, healthy = self.treated(state)
        return laser_work.rewards(self, state, {"treated": share, "healthy": healthy})

    def ended(self, state: TaskState[RouteProgress]) -> Tensor:
        """When the lesions are treated, or an arm touches a body, the other arm or itself."""
        share, _ = self.treated(state)
        done = share >= self.config.treated_share
        return done | state.world.scene.clearance.collides

    def measures(self, state: TaskState[RouteProgress]) -> dict[str, Tensor]:
        """Beam error, treated share, healthy tissue ablated, view, clearance, success."""
        share, healthy = self.treated(state)
        done = (share >= self.config.treated_share) & (healthy <= self.config.healthy_mm2)
        return {
            **laser_work.errors(self, state),
            "completion": share,
            "healthy_mm2": healthy,
            **laser_work.safety(state, done),
        }

    def trace(self, state: TaskState[RouteProgress]) -> tuple[Tensor, Tensor]:
        """Reference point on the raster and end of the beam, each (B, 1, 3) mm."""
        return self.target_mm(state)[:, None], state.world.scene.hits["laser"].point_mm[:, None]

    def script(self, state: TaskState[RouteProgress]) -> dict[str, Tensor]:
        """Scripted expert: points the laser at its next target, the endoscope at the lesion."""
        return laser_work.script(self, state, self.target_mm(state, 1), self.watched_mm(state))


AREA_ABLATION = TaskSpec(
    AreaAblation,
    AreaAblationConfig(),
    laser_work.AGENTS,
    preset={
        "rollout": 16,
        "last_noise": 0.05,
        "evaluate_every": 50,
        "evaluation_episodes": 16,
    },
    training_steps=1_500_000,
    experiment=laser_experiment(
        "share of the area treated",
        {"treated": Condition("this share of the area has the dose (0..1)", 0.98, completed)},
        {},
    ),
    success_rule=success_rule,
)
