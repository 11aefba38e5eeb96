"""Two arms cut a ring around a lesion: one carries the endoscope, one the laser (Chen et al. 2025).

The beam is on only while the endoscope sees enough of the ring. The dose map decides about success.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from surgisoft.tasks import laser_work
from surgisoft.tasks.base import Signal, TaskSpec, TaskState
from surgisoft.tasks.inverse_kinematics import Pointing
from surgisoft.tasks.laser_supervision import LASER_EXPERIMENT
from surgisoft.tasks.laser_work import LaserWorkWeights
from surgisoft.tasks.lone_ring import LoneRing
from surgisoft.tasks.observations import Block, ObservationBlocks, joined
from surgisoft.tasks.trajectories.closed_path import RingCut, draw_cut, point_on_closed
from surgisoft.tasks.world.random_streams import Stream
from surgisoft.tasks.world.scene import PHANTOM, SceneState, measured_view
from surgisoft.tasks.world.world import WorldConfig, scene_world

RING_PLACE = Block(
    "ring_place", "angle of the target along the ring", "rad", "sin(x), cos(x)", -1.0, 1.0
)
RING_DIRECTION = Block(
    "ring_direction", "direction of travel along the ring, +1 or -1", "-", "x", -1.0, 1.0
)


@dataclass(frozen=True)
class CircleAblationConfig:
    """The scene, the speed of the cut, the observation and the reward.

    Time and safety limits come from the scene's file.
    """

    scene: str | Path = PHANTOM
    """Folder of the scene."""
    arm: str | Path | None = None
    """Arm model of both arms: `default`, or a folder; None: the models that the scene names."""
    cut_s: float = 45.0
    """Time for once around with the beam on, s."""
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

    def __post_init__(self):
        positive = ("cut_s", "fire_mm", "approach_s", "fine_mm", "far_mm", "preview")
        laser_work.check_config("circle_ablation", self, positive)


def success_rule(config: CircleAblationConfig) -> str:
    """What an episode needs to be a success, in words; `measures` computes it."""
    return (
        f"the whole ring is cut, without contact; the beam is on only within {config.fire_mm:g} mm "
        f"of its target (fire_mm), which goes once around in {config.cut_s:g} s (cut_s)"
    )


class CircleAblation:
    """Two arms of a scene: agents `laser` and `endoscope`."""

    name, agents = "circle_ablation", ("laser", "endoscope")
    signals = (
        Signal("view_fraction", "share of the ring that the endoscope sees", "-", 0.0, 1.0),
        Signal("beam_on", "1 if the beam was on since the last decision, else 0", "-", 0.0, 1.0),
    )

    def __init__(
        self, config: CircleAblationConfig | None = None, device: str | torch.device = "cpu"
    ):
        self.config = config or CircleAblationConfig()
        c = self.config
        self.world = scene_world(c.scene, c.world, device, arm=c.arm, agents=self.agents)
        self.scene, self.dt_s = self.world.scene, self.world.config.dt_s
        self.spec = self.scene.spec
        self.steps = round(self.spec.limits.time_s / self.dt_s)
        self.round = round(self.config.cut_s / self.dt_s)
        weights = self.config.weights
        self.weights = {"laser": weights.laser, "endoscope": weights.endoscope}

    @property
    def pointing(self) -> dict[str, Pointing]:
        """Inverse kinematics of each arm's axis, by the arm's name."""
        return laser_work.pointing(self)

    def goal(self, stream: Stream) -> tuple[Stream, RingCut]:
        """Draw start and direction of the cut for each random number stream."""
        return draw_cut(stream)

    def target_mm(self, state: TaskState[RingCut], ahead: int = 0) -> Tensor:
        """(B, 3) mm: the reference point on the ring `ahead` steps further on."""
        share = state.goal.share(self.round, ahead)
        return point_on_closed(self.scene.paths_mm, state.world.scene.lesion, share)

    def watched_mm(self, state: TaskState[RingCut]) -> Tensor:
        """(B, 3) mm: the lesion's centre."""
        return self.scene.centres_mm[state.world.scene.lesion]

    def fires(self, state: TaskState[RingCut]) -> Tensor:
        """(B,) bool: whether the beam would be on, see `laser_work.beam_released`."""
        return laser_work.beam_released(self, state)

    def advance(
        self,
        state: TaskState[RingCut],
        actions: Mapping[str, Tensor],
        fired: Tensor | None = None,
    ) -> TaskState[RingCut]:
        """Advance arms and tissue; where `fired` (B,) bool is set the beam burns for the step and
        the reference moves on. None: where `fires` holds.
        """
        fired = self.fires(state) if fired is None else fired
        power_w = {"laser": fired * self.spec.laser.power_w}
        world = self.world.step(state.world, actions, power_w)
        return TaskState(world, state.goal.after(fired))

    def measured_scene(self, signals: Mapping[str, Tensor], lesion: Tensor) -> SceneState:
        """The view of the ring; see `MeasuredTask.measured_scene`."""
        return replace(measured_view(signals["view_fraction"]), lesion=lesion)

    def true_signals(
        self, before: TaskState[RingCut] | None, after: TaskState[RingCut]
    ) -> dict[str, Tensor]:
        """The signals of a simulated step; see `MeasuredTask.true_signals`."""
        return {
            "view_fraction": after.world.scene.views["endoscope"].fraction,
            "beam_on": after.goal.fired.float(),
        }

    def advance_measured(
        self, state: TaskState[RingCut], signals: Mapping[str, Tensor]
    ) -> TaskState[RingCut]:
        """Advance where the beam was on or off as measured; see `MeasuredTask`."""
        none = {name: arm.low.new_zeros(1, arm.chambers) for name, arm in self.world.arms.items()}
        return self.advance(state, none, signals["beam_on"] > 0.5)

    def blocks(self, state: TaskState[RingCut]) -> dict[str, ObservationBlocks]:
        """Observation blocks: body and pointing error of each arm, and the state of the cut."""
        cut = state.goal
        angle = 2.0 * math.pi * cut.share(self.round)[:, None]
        ring = {
            RING_PLACE: torch.cat((angle.sin(), angle.cos()), 1),
            RING_DIRECTION: cut.direction[:, None],
        }
        return laser_work.blocks(self, state, ring, {})

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
        """Beam error, progress of the cut, healthy tissue burnt, view, clearance, success."""
        ring = self.scene.ablation.report(state.world.scene.dose)
        return {
            **laser_work.errors(self, state),
            "completion": ring.completion,
            "largest_gap_mm": ring.largest_gap_mm,
            "healthy_mm2": ring.healthy_mm2,
            **laser_work.safety(state, ring.completion >= 1.0),
        }

    def alone(self, state: TaskState[RingCut]) -> LoneRing | None:
        """The episode of a state of one environment, advanced without tensors; see `LoneRing`."""
        return LoneRing.of(self, state)

    def trace(self, state: TaskState[RingCut]) -> tuple[Tensor, Tensor]:
        """Reference point on the ring and end of the beam, each (B, 1, 3) mm."""
        return self.target_mm(state)[:, None], state.world.scene.hits["laser"].point_mm[:, None]

    def script(self, state: TaskState[RingCut]) -> dict[str, Tensor]:
        """Scripted expert: points the laser at its next target, the endoscope at the lesion."""
        return laser_work.script(self, state, self.target_mm(state, 1), self.watched_mm(state))


CIRCLE_ABLATION = TaskSpec(
    CircleAblation,
    CircleAblationConfig(),
    ("laser", "endoscope"),
    preset={
        "rollout": 16,
        "last_noise": 0.05,
        "evaluate_every": 50,
        "evaluation_episodes": 16,
    },
    training_steps=1_000_000,
    experiment=LASER_EXPERIMENT,
    success_rule=success_rule,
)
