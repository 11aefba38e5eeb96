"""Two arms treat a lesion's whole surface to a dose and spare the healthy tissue beyond a margin.

The laser, defocused to a wider spot, follows a raster over the inside of each outline; a policy may
leave it by as much as `fire_mm`. At the end of the raster the reference begins it again, until the
lesion is treated or the time is out: the measure `passes` counts them. The result is the dose map:
which share of the lesion has the dose and how much healthy tissue was ablated.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.tasks.base import Signal, TaskState, clearance
from surgisoft.tasks.laser_supervision import completed, laser_experiment
from surgisoft.tasks.laser_work import (
    AGENTS,
    LASER,
    LASER_PRESET,
    LASER_STEPS,
    LaserConfig,
    LaserWeights,
    LaserWorkWeights,
    RouteTask,
    check_config,
    dose,
)
from surgisoft.tasks.observations import Block, ObservationBlocks
from surgisoft.tasks.spec import TaskSpec
from surgisoft.tasks.supervision import Condition
from surgisoft.tasks.trajectories.routes import RouteProgress, draw_route, route_steps
from surgisoft.tasks.world.random_streams import Stream
from surgisoft.tasks.world.treatment import AreaPlan, ContourSpec, check_names

TREATED = Block("treated", "share of the lesions' area that has the dose", "-", "x", 0.0, 1.0)
TREATED_SHARE = Signal(
    "treated",
    TREATED.meaning,
    "-",
    0.0,
    1.0,
    lambda task, before, after: task.treated(after)[0],
)


@dataclass(frozen=True)
class AreaLaserWeights(LaserWeights):
    """Weights of the laser's reward terms; e is the distance of the beam from its target, mm."""

    treated: float = 1.0
    """Share of the lesions' area that has the dose."""
    healthy: float = -0.1
    """Area of healthy tissue ablated beyond the margin, mm^2."""


@dataclass(frozen=True)
class AreaAblationWeights(LaserWorkWeights):
    """Weights of the reward terms of both agents."""

    laser: AreaLaserWeights = field(default_factory=AreaLaserWeights)
    """Weights of the laser's reward terms."""


@dataclass(frozen=True)
class AreaAblationConfig(LaserConfig):
    """The scene, the areas and their dose, the raster, the observation and the reward.

    Safety limits come from the scene's file.
    """

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
    """Distance of neighbouring lines of the raster, mm. Where they leave gaps, further passes burn
    the same lines again."""
    overrun_mm: float = 0.5
    """Distance by which the raster reaches beyond the outline, so that its edge has the dose, mm.
    """
    speed_mm_s: float = 6.0
    """Speed of the reference along the raster while the beam is on, mm/s."""
    time_s: float = 75.0
    """Time for all areas, s."""
    fire_mm: float = 1.0
    """Measured distance of the beam from its target within which the beam is switched on, mm."""
    fine_mm: float = 0.3
    """Scale of the reward term `fine`, mm."""
    preview: int = 3
    """Future targets in the laser's observation, one per step (a count)."""
    weights: AreaAblationWeights = field(default_factory=AreaAblationWeights)
    """Weights of the reward terms."""

    @property
    def at_lesion(self) -> bool:
        """Whether the scene's lesion may be what is treated; not with given outlines."""
        return not self.outlines

    def __post_init__(self):
        positive = ("dose_j_per_mm2", "treated_share", "spot_mm", "pitch_mm", "speed_mm_s")
        check_config("area_ablation", self, *positive, "time_s", "spared_mm")
        check_names("area_ablation: outlines", self.outlines)
        for name in ("healthy_mm2", "overrun_mm"):
            if not getattr(self, name) >= 0.0:
                raise InputError(f"area_ablation: {name} is {getattr(self, name)}, expected >= 0")
        if self.treated_share > 1.0:
            raise InputError(
                f"area_ablation: treated_share is {self.treated_share}, expected at most 1"
            )


def success_rule(config: AreaAblationConfig) -> str:
    """Definition of success, in words; `measures` computes it."""
    return (
        f"{100.0 * config.treated_share:g} % of the lesions' area has {config.dose_j_per_mm2:g} "
        f"J/mm2 or more, at most {config.healthy_mm2:g} mm2 of healthy tissue more than "
        f"{config.spared_mm:g} mm outside are ablated, without contact; the beam is on only within "
        f"{config.fire_mm:g} mm of its target (fire_mm)"
    )


class AreaAblation(RouteTask):
    """Two arms of a scene: agents `laser` and `endoscope`."""

    name = "area_ablation"
    signals = (*RouteTask.signals, TREATED_SHARE)
    dose_fields = "pitch_mm, speed_mm_s"
    leap_steps = 2.5
    """At the end of a row the next one begins nearer than this many steps of the reference, or the
    beam would burn on the way."""

    def __init__(
        self, config: AreaAblationConfig | None = None, device: str | torch.device = "cpu"
    ):
        c = config or AreaAblationConfig()
        plan = AreaPlan(
            step_mm=c.speed_mm_s * c.world.dt_s,
            pitch_mm=c.pitch_mm,
            overrun_mm=c.overrun_mm,
            spared_mm=c.spared_mm,
            spot_mm=c.spot_mm,
            dose_j_per_mm2=c.dose_j_per_mm2,
            contours=c.outlines,
        )
        super().__init__(c, device, c.time_s, plan=plan)
        self.require_time(route_steps(self.scene.stretches, 0), "the raster takes")
        self.area_mm2 = self.scene.ablation.zone_areas_mm2[0]

    def goal(self, stream: Stream) -> tuple[Stream, RouteProgress]:
        """Draw from which end each raster is followed, for each random number stream."""
        return draw_route(stream, self.scene.stretches, 0)

    def treated(self, state: TaskState[RouteProgress]) -> tuple[Tensor, Tensor]:
        """(B,) 0..1: share of the lesions' area that has the dose; (B,) mm^2: healthy area
        ablated."""
        areas = dose(state).zone_mm2
        return areas[:, 0] / self.area_mm2, areas[:, 2]

    def shared_blocks(self, state: TaskState[RouteProgress]) -> ObservationBlocks:
        """Share of the raster that is followed, and of the area that is treated."""
        share = self.reading(TREATED_SHARE, state)
        return {**super().shared_blocks(state), TREATED: share[:, None]}

    def own_terms(self, state: TaskState[RouteProgress]) -> dict[str, dict[str, Tensor]]:
        """The laser's terms of `AreaLaserWeights`."""
        share, healthy = self.treated(state)
        return {LASER: {"treated": share, "healthy": healthy}}

    def ended(self, state: TaskState[RouteProgress]) -> Tensor:
        """When the lesions are treated, or an arm touches a body, the other arm or itself."""
        share, _ = self.treated(state)
        return (share >= self.config.treated_share) | clearance(state).collides

    def measures(self, state: TaskState[RouteProgress]) -> dict[str, Tensor]:
        """Beam error, treated share, healthy tissue ablated, view, clearance, success.

        passes: how often the raster was followed, a number with its fraction.
        """
        share, healthy = self.treated(state)
        done = (share >= self.config.treated_share) & (healthy <= self.config.healthy_mm2)
        return {
            **self.errors(state),
            "completion": share,
            "healthy_mm2": healthy,
            "passes": state.goal.done / state.goal.steps,
            **self.safety(state, done),
        }


AREA_ABLATION = TaskSpec(
    AreaAblation,
    AreaAblationConfig(),
    AGENTS,
    preset=LASER_PRESET,
    training_steps=LASER_STEPS,
    experiment=laser_experiment(
        "share of the area treated",
        {"treated": Condition("this share of the area has the dose (0..1)", 0.98, completed, 1.0)},
        {"passes": "passes of the raster"},
    ),
    success_rule=success_rule,
)
