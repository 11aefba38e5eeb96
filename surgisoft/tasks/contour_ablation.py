"""Two arms cut contours on the organ, one after another, while the endoscope moves along.

A contour is any closed or open path on the organ's surface: points, a circle, or an outline grown
by a margin. What has to be seen is the stretch of path around the laser's target, in the middle of
the picture, so that a camera that stands still is not enough.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.tasks.base import TaskState
from surgisoft.tasks.laser_supervision import laser_experiment
from surgisoft.tasks.laser_work import (
    AGENTS,
    LASER_PRESET,
    LASER_STEPS,
    LaserConfig,
    LaserWorkWeights,
    RouteTask,
    check_config,
)
from surgisoft.tasks.spec import TaskSpec
from surgisoft.tasks.trajectories.routes import RouteProgress, draw_route, route_steps
from surgisoft.tasks.world.random_streams import Stream
from surgisoft.tasks.world.treatment import ContourPlan, ContourSpec, check_names

OVERLAP_MM = 2.0
"""Length by which a closed cut passes its beginning again, mm: the seam is cut twice."""


@dataclass(frozen=True)
class ContourAblationConfig(LaserConfig):
    """The scene, the contours and the speed of the cut, the observation and the reward.

    Safety limits come from the scene's file.
    """

    contours: tuple[ContourSpec, ...] = ()
    """Contours, cut in this order; none: those of the scene, or the ring around its lesion."""
    margin_mm: float = 0.0
    """Margin by which every closed contour is grown beyond its own, mm."""
    speed_mm_s: float = 2.5
    """Speed of the reference along a contour while the beam is on, mm/s."""
    window_mm: float = 8.0
    """Length of contour on either side of the target that the endoscope has to see, mm."""
    field_deg: float = 24.0
    """Full cone angle about the camera's axis in which it has to see that, degrees."""
    time_s: float = 60.0
    """Time for all contours, s."""
    weights: LaserWorkWeights = field(default_factory=LaserWorkWeights)
    """Weights of the reward terms."""

    @property
    def at_lesion(self) -> bool:
        """Whether the scene's lesion may be what is treated; not with given contours."""
        return not self.contours

    def __post_init__(self):
        positive = ("speed_mm_s", "window_mm", "field_deg", "time_s")
        check_config("contour_ablation", self, *positive)
        check_names("contour_ablation: contours", self.contours)
        if not self.margin_mm >= 0.0:
            raise InputError(f"contour_ablation: margin_mm is {self.margin_mm}, expected >= 0")


def success_rule(config: ContourAblationConfig) -> str:
    """Definition of success, in words; `measures` computes it."""
    return (
        "every contour is cut along its whole length, without contact; the beam is on only within "
        f"{config.fire_mm:g} mm of its target (fire_mm), which moves at {config.speed_mm_s:g} mm/s "
        "(speed_mm_s)"
    )


class ContourAblation(RouteTask):
    """Two arms of a scene: agents `laser` and `endoscope`."""

    name, leap_steps = "contour_ablation", 2.0

    def __init__(
        self, config: ContourAblationConfig | None = None, device: str | torch.device = "cpu"
    ):
        c = config or ContourAblationConfig()
        step_mm = c.speed_mm_s * c.world.dt_s
        plan = ContourPlan(step_mm, c.contours, c.margin_mm, c.window_mm, c.field_deg)
        super().__init__(c, device, c.time_s, plan=plan)
        self.overlap = round(OVERLAP_MM / step_mm)
        self.require_time(route_steps(self.scene.stretches, self.overlap), "the contours take")

    def goal(self, stream: Stream) -> tuple[Stream, RouteProgress]:
        """Draw where each contour is begun and in which direction, for each stream."""
        return draw_route(stream, self.scene.stretches, self.overlap)

    def ended(self, state: TaskState[RouteProgress]) -> Tensor:
        """When all contours are cut, or an arm touches a body, the other arm or itself."""
        return super().ended(state)

    def measures(self, state: TaskState[RouteProgress]) -> dict[str, Tensor]:
        """Beam error, progress of the cut, healthy tissue burnt, view, clearance, success."""
        cut = self.report(state)
        return {
            **self.errors(state),
            "completion": cut.completion,
            "healthy_mm2": cut.healthy_mm2,
            "inside_mm2": cut.lesion_mm2,
            **self.safety(state, cut.completion >= 1.0),
        }


CONTOUR_ABLATION = TaskSpec(
    ContourAblation,
    ContourAblationConfig(),
    AGENTS,
    preset=LASER_PRESET,
    training_steps=LASER_STEPS,
    experiment=laser_experiment(
        "share of the contours cut", {}, {"inside_mm2": "burnt inside [mm2]"}
    ),
    success_rule=success_rule,
)
