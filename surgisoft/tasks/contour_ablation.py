"""Two arms cut contours on the organ, one after another, while the endoscope moves along.

A contour is any closed or open path on the organ's surface: points, a circle, or an outline grown
by a margin. What has to be seen is the stretch of path around the laser's target, in the middle of
the picture, so that a camera that stands still is not enough.
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
from surgisoft.tasks.laser_supervision import laser_experiment
from surgisoft.tasks.laser_work import DONE, LaserWorkWeights
from surgisoft.tasks.observations import ObservationBlocks, joined
from surgisoft.tasks.trajectories.routes import RouteProgress, draw_route, route_steps
from surgisoft.tasks.world.random_streams import Stream
from surgisoft.tasks.world.scene import PHANTOM
from surgisoft.tasks.world.treatment import ContourPlan, ContourSpec
from surgisoft.tasks.world.world import WorldConfig, scene_world

OVERLAP_MM = 2.0
"""Length by which a closed cut passes its beginning again, mm: the seam is cut twice."""
LEAP_STEPS = 2.0
"""Two targets farther apart than this many steps of the reference lie on different contours."""


@dataclass(frozen=True)
class ContourAblationConfig:
    """The scene, the contours and the speed of the cut, the observation and the reward.

    Safety limits come from the scene's file.
    """

    scene: str | Path = PHANTOM
    """Folder of the scene."""
    arm: str | Path | None = None
    """Arm model of both arms: `default`, or a folder; None: the models that the scene names."""
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
    fire_mm: float = 0.5
    """Measured distance of the beam from its target within which the beam is switched on, mm."""
    approach_s: float = 5.0
    """Time at the beginning that the measure `pointing_error_mm` leaves out, s."""
    fine_mm: float = 0.1
    """Scale of the reward term `fine`, mm."""
    far_mm: float = 10.0
    """Scale of the reward terms `far` and `look`, mm."""
    weights: LaserWorkWeights = field(default_factory=LaserWorkWeights)
    """Weights of the reward terms."""
    preview: int = 2
    """Future targets in the laser's observation, one per step (a count)."""
    world: WorldConfig = field(default_factory=WorldConfig)
    """The simulator and its domain randomization."""

    @property
    def at_lesion(self) -> bool:
        """Whether the scene's lesion may be what is treated; not with contours of one's own."""
        return not self.contours

    def __post_init__(self):
        positive = ("speed_mm_s", "window_mm", "field_deg", "time_s", "fire_mm", "approach_s")
        laser_work.check_config(
            "contour_ablation", self, (*positive, "fine_mm", "far_mm", "preview")
        )
        if not self.margin_mm >= 0.0:
            raise InputError(f"contour_ablation: margin_mm is {self.margin_mm}, expected >= 0")


def success_rule(config: ContourAblationConfig) -> str:
    """What an episode needs to be a success, in words; `measures` computes it."""
    return (
        "every contour is cut along its whole length, without contact; the beam is on only within "
        f"{config.fire_mm:g} mm of its target (fire_mm), which moves at {config.speed_mm_s:g} mm/s "
        "(speed_mm_s)"
    )


class ContourAblation:
    """Two arms of a scene: agents `laser` and `endoscope`."""

    name, agents = "contour_ablation", laser_work.AGENTS

    def __init__(
        self, config: ContourAblationConfig | None = None, device: str | torch.device = "cpu"
    ):
        c = self.config = config or ContourAblationConfig()
        step_mm = c.speed_mm_s * c.world.dt_s
        plan = ContourPlan(step_mm, c.contours, c.margin_mm, c.window_mm, c.field_deg)
        self.world = scene_world(c.scene, c.world, device, arm=c.arm, agents=self.agents, plan=plan)
        self.scene, self.dt_s = self.world.scene, self.world.config.dt_s
        self.spec = self.scene.spec
        self.steps = round(c.time_s / self.dt_s)
        self.overlap = round(OVERLAP_MM / step_mm)
        least = route_steps(self.scene.stretches, self.overlap)
        if least > self.steps:
            raise InputError(
                f"contour_ablation: the contours take {least * self.dt_s:.0f} s at "
                f"{c.speed_mm_s:g} mm/s, and time_s is {c.time_s:g} s; raise time_s or speed_mm_s"
            )
        self.weights = {"laser": c.weights.laser, "endoscope": c.weights.endoscope}

    def goal(self, stream: Stream) -> tuple[Stream, RouteProgress]:
        """Draw where each contour is begun and in which direction, for each stream."""
        return draw_route(stream, self.scene.stretches, self.overlap)

    def target_mm(self, state: TaskState[RouteProgress], ahead: int = 0) -> Tensor:
        """(B, 3) mm: the reference point on the contours `ahead` steps further on."""
        return self.scene.path_mm[state.goal.point(ahead)]

    def watched_mm(self, state: TaskState[RouteProgress]) -> Tensor:
        """(B, 3) mm: middle of the stretch that has to be seen."""
        return self.scene.looks_mm[state.goal.point()].mean(1)

    def fires(self, state: TaskState[RouteProgress]) -> Tensor:
        """(B,) bool: whether the beam would be on, see `laser_work.beam_released`; never on the way
        from one contour to the next."""
        return laser_work.beam_released(self, state) & ~self.leaps(state)

    def leaps(self, state: TaskState[RouteProgress]) -> Tensor:
        """(B,) bool: the reference is at the end of a contour, and goes on to the next one."""
        ahead = self.target_mm(state, 1) - self.target_mm(state)
        return ahead.norm(dim=1) > LEAP_STEPS * self.config.speed_mm_s * self.dt_s

    def advance(
        self,
        state: TaskState[RouteProgress],
        actions: Mapping[str, Tensor],
        fired: Tensor | None = None,
    ) -> TaskState[RouteProgress]:
        """Advance arms and tissue; where `fired` (B,) bool is set the beam burns for the step and
        the reference moves on. None: where `fires` holds. At the end of a contour the reference
        moves on without the beam.
        """
        released = laser_work.beam_released(self, state)
        leap = self.leaps(state)
        fired = (released if fired is None else fired) & ~leap
        goal = state.goal.after(fired, fired | (released & leap))
        near = replace(state.world.scene, watched=goal.point())
        power_w = {"laser": fired * self.spec.laser.power_w}
        return TaskState(self.world.step(replace(state.world, scene=near), actions, power_w), goal)

    def blocks(self, state: TaskState[RouteProgress]) -> dict[str, ObservationBlocks]:
        """Observation blocks: body and pointing error of each arm, and the state of the cut."""
        return laser_work.blocks(self, state, {}, {DONE: state.goal.share[:, None]})

    def observe(self, state: TaskState[RouteProgress]) -> dict[str, Tensor]:
        """Concatenated observation blocks, agent -> (B, D)."""
        return {agent: joined(blocks) for agent, blocks in self.blocks(state).items()}

    def rewards(self, state: TaskState[RouteProgress]) -> dict[str, dict[str, Tensor]]:
        """Weighted reward terms, see `LaserWeights` and `EndoscopeWeights`."""
        return laser_work.rewards(self, state)

    def ended(self, state: TaskState[RouteProgress]) -> Tensor:
        """When all contours are cut, or an arm touches a body, the other arm or itself."""
        done = self.scene.ablation.report(state.world.scene.dose).completion >= 1.0
        return done | state.world.scene.clearance.collides

    def measures(self, state: TaskState[RouteProgress]) -> dict[str, Tensor]:
        """Beam error, progress of the cut, healthy tissue burnt, view, clearance, success."""
        cut = self.scene.ablation.report(state.world.scene.dose)
        return {
            **laser_work.errors(self, state),
            "completion": cut.completion,
            "healthy_mm2": cut.healthy_mm2,
            "inside_mm2": cut.lesion_mm2,
            **laser_work.safety(state, cut.completion >= 1.0),
        }

    def trace(self, state: TaskState[RouteProgress]) -> tuple[Tensor, Tensor]:
        """Reference point on the contours and end of the beam, each (B, 1, 3) mm."""
        return self.target_mm(state)[:, None], state.world.scene.hits["laser"].point_mm[:, None]

    def script(self, state: TaskState[RouteProgress]) -> dict[str, Tensor]:
        """Scripted expert: points the laser at its next target, the endoscope at its stretch."""
        return laser_work.script(self, state, self.target_mm(state, 1), self.watched_mm(state))


CONTOUR_ABLATION = TaskSpec(
    ContourAblation,
    ContourAblationConfig(),
    laser_work.AGENTS,
    preset={
        "rollout": 16,
        "last_noise": 0.05,
        "evaluate_every": 50,
        "evaluation_episodes": 16,
    },
    training_steps=1_500_000,
    experiment=laser_experiment(
        "share of the contours cut", {}, {"inside_mm2": "burnt inside [mm2]"}
    ),
    success_rule=success_rule,
)
