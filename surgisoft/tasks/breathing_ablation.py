"""Two arms cut a ring around a lesion on an organ that moves with respiration.

With `mode = "follow"` beam and camera follow the lesion. With `mode = "gated"` they point at the
lesion's place at the end of exhalation, and the beam is on only while the organ is near it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from surgisoft.errors import unknown_name
from surgisoft.tasks import laser_work
from surgisoft.tasks.base import TaskSpec, TaskState
from surgisoft.tasks.laser_supervision import laser_experiment
from surgisoft.tasks.laser_work import LaserWorkWeights
from surgisoft.tasks.observations import Block, ObservationBlocks, joined
from surgisoft.tasks.trajectories.closed_path import RingCut, draw_cut, point_on_closed
from surgisoft.tasks.world.random_streams import Stream
from surgisoft.tasks.world.respiration import Respiration
from surgisoft.tasks.world.scene import PHANTOM
from surgisoft.tasks.world.world import WorldConfig, scene_world

MODES = ("follow", "gated")
"""What the beam does while the organ moves."""
RING_PLACE = Block(
    "ring_place", "angle of the target along the ring", "rad", "sin(x), cos(x)", -1.0, 1.0
)
RING_DIRECTION = Block(
    "ring_direction", "direction of travel along the ring, +1 or -1", "-", "x", -1.0, 1.0
)
BREATH = Block(
    "breath", "measured displacement of the organ towards the feet", "mm", "x / 10 mm", 0.0, 20.0
)
BREATH_RATE = Block("breath_rate", "rate of that displacement", "mm/s", "x / 20 mm/s")
GATE = Block("gate", "1 while the organ is near the end of exhalation, else 0", "-", "x", 0.0, 1.0)


@dataclass(frozen=True)
class BreathingAblationConfig:
    """The scene, the respiration, the speed of the cut, the observation and the reward.

    Safety limits come from the scene's file.
    """

    scene: str | Path = PHANTOM
    """Folder of the scene."""
    arm: str | Path | None = None
    """Arm model of both arms: `default`, or a folder; None: the models that the scene names."""
    respiration: Respiration = field(default_factory=Respiration)
    """How the organ moves."""
    mode: str = "follow"
    """`follow`: beam and camera follow the lesion; `gated`: they point at its place at the end of
    exhalation, and the beam is on only there."""
    gate_mm: float = 1.0
    """With `gated`: displacement of the organ within which the beam may be on, mm."""
    cut_s: float = 45.0
    """Time for once around with the beam on, s."""
    time_s: float = 180.0
    """Time for the whole ring, s: with `gated` the beam is off most of the time."""
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
    """Future targets in the laser's observation, one per step (a count); the organ's motion is
    extrapolated by its present rate."""
    world: WorldConfig = field(default_factory=WorldConfig)
    """The simulator and its domain randomization."""

    def __post_init__(self):
        if self.mode not in MODES:
            raise unknown_name("mode", self.mode, MODES)
        positive = ("gate_mm", "cut_s", "time_s", "fire_mm", "approach_s", "fine_mm", "far_mm")
        laser_work.check_config("breathing_ablation", self, (*positive, "preview"))


def success_rule(config: BreathingAblationConfig) -> str:
    """What an episode needs to be a success, in words; `measures` computes it."""
    gate = ""
    if config.mode == "gated":
        gate = f" and while the organ is within {config.gate_mm:g} mm of the end of exhalation"
    return (
        f"the whole ring is cut, without contact; the beam is on only within {config.fire_mm:g} mm "
        f"of its target (fire_mm){gate}, which goes once around in {config.cut_s:g} s (cut_s)"
    )


class BreathingAblation:
    """Two arms of a scene: agents `laser` and `endoscope`."""

    name, agents = "breathing_ablation", laser_work.AGENTS

    def __init__(
        self, config: BreathingAblationConfig | None = None, device: str | torch.device = "cpu"
    ):
        c = self.config = config or BreathingAblationConfig()
        self.world = scene_world(
            c.scene,
            c.world,
            device,
            arm=c.arm,
            agents=self.agents,
            respiration=c.respiration,
            time_s=c.time_s,
        )
        self.scene, self.dt_s = self.world.scene, self.world.config.dt_s
        self.spec, self.motion = self.scene.spec, self.scene.motion
        self.steps, self.round = round(c.time_s / self.dt_s), round(c.cut_s / self.dt_s)
        self.follows = c.mode == "follow"
        self.weights = {"laser": c.weights.laser, "endoscope": c.weights.endoscope}

    def goal(self, stream: Stream) -> tuple[Stream, RingCut]:
        """Draw start and direction of the cut for each random number stream."""
        return draw_cut(stream)

    def displacement_mm(self, state: TaskState[RingCut]) -> tuple[Tensor, Tensor]:
        """(B,) mm towards the feet, from the end of exhalation, and (B,) mm/s."""
        return self.motion.displacement_mm(state.world.scene.breaths)

    def in_gate(self, state: TaskState[RingCut]) -> Tensor:
        """(B,) bool: the organ is near its place at the end of exhalation."""
        return self.displacement_mm(state)[0] <= self.config.gate_mm

    def resting_mm(self, state: TaskState[RingCut], ahead: int = 0) -> Tensor:
        """(B, 3) mm: the reference point `ahead` steps further on, at the end of exhalation."""
        share = state.goal.share(self.round, ahead)
        return point_on_closed(self.scene.paths_mm, state.world.scene.lesion, share)

    def centre_mm(self, state: TaskState[RingCut]) -> Tensor:
        """(B, 3) mm: the lesion's centre at the end of exhalation."""
        return self.scene.centres_mm[state.world.scene.lesion]

    def target_mm(self, state: TaskState[RingCut], ahead: int = 0) -> Tensor:
        """(B, 3) mm: where the beam has to go, `ahead` steps further on.

        With `follow` the place on the moving organ, extrapolated by its present rate; with `gated`
        the place at the end of exhalation.
        """
        point = self.resting_mm(state, ahead)
        if not self.follows:
            return point
        now, rate = self.displacement_mm(state)
        later = (now + ahead * self.dt_s * rate).clamp(min=0.0)
        return self.motion.placement(later).points(point)

    def watched_mm(self, state: TaskState[RingCut]) -> Tensor:
        """(B, 3) mm: the lesion's centre now; with `gated` at the end of exhalation."""
        centre = self.centre_mm(state)
        if not self.follows:
            return centre
        return self.scene.placement(state.world.scene.breaths).points(centre)

    def tissue_error_mm(self, state: TaskState[RingCut]) -> Tensor:
        """(B,) mm: distance of the beam's axis from the place on the organ that is to be cut."""
        here = self.scene.placement(state.world.scene.breaths).points(self.resting_mm(state))
        points = state.world.arms[laser_work.LASER].points_mm
        return laser_work.pointing(self)[laser_work.LASER].offset_mm(points, here).norm(dim=1)

    def fires(self, state: TaskState[RingCut]) -> Tensor:
        """(B,) bool: whether the beam would be on, see `laser_work.beam_released`; with `gated`
        only while the organ is near the end of exhalation."""
        released = laser_work.beam_released(self, state)
        return released if self.follows else released & self.in_gate(state)

    def advance(
        self,
        state: TaskState[RingCut],
        actions: Mapping[str, Tensor],
        fired: Tensor | None = None,
    ) -> TaskState[RingCut]:
        """Advance arms, organ and tissue; where `fired` (B,) bool is set the beam burns for the
        step and the reference moves on. None: where `fires` holds.
        """
        fired = self.fires(state) if fired is None else fired
        power_w = {"laser": fired * self.spec.laser.power_w}
        world = self.world.step(state.world, actions, power_w)
        return TaskState(world, state.goal.after(fired))

    def blocks(self, state: TaskState[RingCut]) -> dict[str, ObservationBlocks]:
        """Observation blocks: body and pointing error of each arm, the cut, and respiration."""
        cut, (now, rate) = state.goal, self.displacement_mm(state)
        angle = 2.0 * math.pi * cut.share(self.round)[:, None]
        ring = {
            RING_PLACE: torch.cat((angle.sin(), angle.cos()), 1),
            RING_DIRECTION: cut.direction[:, None],
        }
        breath = {
            BREATH: now[:, None] / 10.0,
            BREATH_RATE: rate[:, None] / 20.0,
            GATE: self.in_gate(state)[:, None].float(),
        }
        return laser_work.blocks(self, state, ring, breath)

    def observe(self, state: TaskState[RingCut]) -> dict[str, Tensor]:
        """Concatenated observation blocks, agent -> (B, D)."""
        return {agent: joined(blocks) for agent, blocks in self.blocks(state).items()}

    def rewards(self, state: TaskState[RingCut]) -> dict[str, dict[str, Tensor]]:
        """Weighted reward terms, see `LaserWeights` and `EndoscopeWeights`."""
        return laser_work.rewards(self, state)

    def ended(self, state: TaskState[RingCut]) -> Tensor:
        """When the ring is cut all around, or an arm touches a body, the other arm or itself."""
        done = self.scene.ablation.report(state.world.scene.dose).completion >= 1.0
        return done | state.world.scene.clearance.collides

    def measures(self, state: TaskState[RingCut]) -> dict[str, Tensor]:
        """Beam error, progress of the cut, healthy tissue burnt, respiration, view, success.

        tissue_error_mm: distance of the beam from the moving place that is to be cut, while the
        beam is on; beside it `beam_error_mm` is the distance from the target.
        """
        ring = self.scene.ablation.report(state.world.scene.dose)
        tissue = self.tissue_error_mm(state)
        return {
            **laser_work.errors(self, state),
            "tissue_error_mm": tissue.where(state.goal.fired, float("nan")),
            "completion": ring.completion,
            "largest_gap_mm": ring.largest_gap_mm,
            "healthy_mm2": ring.healthy_mm2,
            "breath_mm": self.displacement_mm(state)[0],
            "beam_on": state.goal.fired.float(),
            **laser_work.safety(state, ring.completion >= 1.0),
        }

    def trace(self, state: TaskState[RingCut]) -> tuple[Tensor, Tensor]:
        """Reference point and end of the beam, each (B, 1, 3) mm."""
        return self.target_mm(state)[:, None], state.world.scene.hits["laser"].point_mm[:, None]

    def script(self, state: TaskState[RingCut]) -> dict[str, Tensor]:
        """Scripted expert: points the laser at its next target, the endoscope at the lesion.

        It knows the breath, and with `follow` where the organ will be after the step.
        """
        target, centre = self.resting_mm(state, 1), self.centre_mm(state)
        if self.follows:
            next_step = self.scene.placement(state.world.scene.breaths, self.dt_s)
            target, centre = next_step.points(target), next_step.points(centre)
        return laser_work.script(self, state, target, centre)


BREATHING_ABLATION = TaskSpec(
    BreathingAblation,
    BreathingAblationConfig(),
    laser_work.AGENTS,
    preset={
        "rollout": 16,
        "last_noise": 0.05,
        "evaluate_every": 50,
        "evaluation_episodes": 16,
    },
    training_steps=1_500_000,
    experiment=laser_experiment(
        "share cut", {}, {"tissue_error_mean_mm": "error on the tissue, mean [mm]"}
    ),
    success_rule=success_rule,
)
