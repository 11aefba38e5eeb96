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

from surgisoft.errors import InputError
from surgisoft.tasks.base import Signal, TaskSpec, TaskState, check_weights, weighted
from surgisoft.tasks.inverse_kinematics import Pointing
from surgisoft.tasks.laser_supervision import LASER_EXPERIMENT
from surgisoft.tasks.observations import (
    TIME,
    Block,
    ObservationBlocks,
    body_blocks,
    joined,
    numbered,
)
from surgisoft.tasks.trajectories.closed_path import RingCut, draw_cut, point_on_closed
from surgisoft.tasks.world.random_streams import Stream
from surgisoft.tasks.world.scene import PHANTOM, SceneState, measured_view
from surgisoft.tasks.world.world import WorldConfig, scene_world

BEAM_ERROR = Block(
    "beam_error",
    "perpendicular offset of the target from the measured beam",
    "mm",
    "asinh(x / 1 mm)",
)
RING_PLACE = Block(
    "ring_place", "angle of the target along the ring", "rad", "sin(x), cos(x)", -1.0, 1.0
)
RING_DIRECTION = Block(
    "ring_direction", "direction of travel along the ring, +1 or -1", "-", "x", -1.0, 1.0
)
VIEW_ERROR = Block(
    "view_error",
    "perpendicular offset of the lesion's centre from the measured axis of the camera",
    "mm",
    "asinh(x / 1 mm)",
)
VIEW = Block("view", "share of the ring that the endoscope sees", "-", "x", 0.0, 1.0)
FIRED = Block("fired", "1 if the beam was on in the last step, else 0", "-", "x", 0.0, 1.0)
APART = Block("apart", "measured tip of the laser arm minus that of the endoscope", "mm", "x / 50")


@dataclass(frozen=True)
class LaserWeights:
    """Weights of the laser's reward terms; e is the distance of the beam from its target, mm.

    exp(-e / scale) is flat tens of mm away, where an episode begins; `far` is not.
    """

    far: float = 1.0
    """1 / (1 + e / far_mm)."""
    aim: float = 1.0
    """exp(-e / 1 mm)."""
    fine: float = 1.0
    """exp(-e / fine_mm)."""
    cut: float = 1.0
    """1 while the beam is on, else 0."""
    contact: float = -1.0
    """1 while the clearance of any arm is below the scene's limit, else 0."""


@dataclass(frozen=True)
class EndoscopeWeights:
    """Weights of the endoscope's reward terms; e is the camera axis' distance from the ring's
    centre, mm."""

    look: float = 1.0
    """1 / (1 + e / far_mm)."""
    view: float = 1.0
    """Share of the ring that the endoscope sees."""
    cut: float = 1.0
    """1 while the beam is on, else 0."""
    contact: float = -1.0
    """1 while the clearance of any arm is below the scene's limit, else 0."""


@dataclass(frozen=True)
class CircleAblationWeights:
    """Weights of the reward terms of both agents."""

    laser: LaserWeights = field(default_factory=LaserWeights)
    """Weights of the laser's reward terms."""
    endoscope: EndoscopeWeights = field(default_factory=EndoscopeWeights)
    """Weights of the endoscope's reward terms."""


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
    weights: CircleAblationWeights = field(default_factory=CircleAblationWeights)
    """Weights of the reward terms."""
    preview: int = 2
    """Future targets in the laser's observation, one per step (a count)."""
    world: WorldConfig = field(default_factory=WorldConfig)
    """The simulator and its domain randomization."""

    def __post_init__(self):
        for name in ("cut_s", "fire_mm", "approach_s", "fine_mm", "far_mm", "preview"):
            if not getattr(self, name) > 0:
                raise InputError(f"circle_ablation: {name} is {getattr(self, name)}, expected > 0")
        check_weights("circle_ablation: laser", self.weights.laser)
        check_weights("circle_ablation: endoscope", self.weights.endoscope)


def success_rule(config: CircleAblationConfig) -> str:
    """What an episode needs to be a success, in words; `measures` computes it."""
    return (
        f"the whole ring is cut, without contact; the beam is on only within {config.fire_mm:g} mm "
        f"of its target (fire_mm), which goes once around in {config.cut_s:g} s (cut_s)"
    )


class CircleAblation:
    """The two arms of a scene: agents `laser` and `endoscope`."""

    name, agents = "circle_ablation", ("laser", "endoscope")
    signals = (
        Signal("view_fraction", "share of the ring that the endoscope sees", "-", 0.0, 1.0),
        Signal("beam_on", "1 if the beam was on since the last decision, else 0", "-", 0.0, 1.0),
    )

    def __init__(
        self, config: CircleAblationConfig | None = None, device: str | torch.device = "cpu"
    ):
        self.config = config or CircleAblationConfig()
        self.world = scene_world(self.config.scene, self.config.world, device, arm=self.config.arm)
        self.scene, self.dt_s = self.world.scene, self.world.config.dt_s
        self.spec = self.scene.spec
        self.steps = round(self.spec.limits.time_s / self.dt_s)
        self.round = round(self.config.cut_s / self.dt_s)
        weights = self.config.weights
        self.weights = {"laser": weights.laser, "endoscope": weights.endoscope}

    @property
    def pointing(self) -> dict[str, Pointing]:
        """Inverse kinematics of each arm's axis, by the arm's name."""
        return {name: Pointing(arm, self.dt_s) for name, arm in self.world.arms.items()}

    def goal(self, stream: Stream) -> tuple[Stream, RingCut]:
        """Draw start and direction of the cut for each random number stream."""
        return draw_cut(stream)

    def target_mm(self, state: TaskState[RingCut], ahead: int = 0) -> Tensor:
        """(B, 3) mm: the reference point on the ring `ahead` steps further on."""
        share = state.goal.share(self.round, ahead)
        return point_on_closed(self.scene.paths_mm, state.world.scene.lesion, share)

    def centre_mm(self, state: TaskState[RingCut]) -> Tensor:
        """(B, 3) mm: the lesion's centre."""
        return self.scene.centres_mm[state.world.scene.lesion]

    def beam_error_mm(self, state: TaskState[RingCut]) -> Tensor:
        """(B,) mm: true perpendicular distance of the beam's axis from its target."""
        return self._off_target_mm(state, state.world.arms["laser"].points_mm)

    def measured_error_mm(self, state: TaskState[RingCut]) -> Tensor:
        """(B,) mm: distance of the beam's axis from its target as measured or estimated."""
        return self._off_target_mm(state, state.world.arms["laser"].seen_mm)

    def _off_target_mm(self, state: TaskState[RingCut], points_mm: Tensor) -> Tensor:
        return self.pointing["laser"].offset_mm(points_mm, self.target_mm(state)).norm(dim=1)

    def fires(self, state: TaskState[RingCut]) -> Tensor:
        """(B,) bool: as far as is measured the beam is near its target and meets the organ, the
        endoscope's picture shows enough of the ring, and the arms keep the scene's clearance. The
        true pose of the laser arm does not enter into where the beam goes."""
        scene, limits = state.world.scene, self.spec.limits
        seen = scene.view.fraction >= limits.view_fraction
        clear = (scene.clearance.least_mm >= limits.clearance_mm) & ~scene.clearance.collides
        near = self.measured_error_mm(state) <= self.config.fire_mm
        return seen & clear & near & self._on_organ(state)

    def _on_organ(self, state: TaskState[RingCut]) -> Tensor:
        """(B,) bool: the beam meets the organ, from the measured key points of both arms."""
        parts, hit = state.world.arms, state.world.scene.hit
        if all(torch.equal(part.seen_mm, part.points_mm) for part in parts.values()):
            return hit.on_organ  # what is measured is the truth: the ray was cast already
        return self.scene.aimed(
            {name: self.world.arms[name].posed(part, part.seen_mm) for name, part in parts.items()}
        ).on_organ

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
        world = self.world.step(state.world, actions, fired * self.spec.laser.power_w)
        return TaskState(world, state.goal.after(fired))

    def measured_scene(self, signals: Mapping[str, Tensor], lesion: Tensor) -> SceneState:
        """The view of the ring; see `MeasuredTask.measured_scene`."""
        return replace(measured_view(signals["view_fraction"]), lesion=lesion)

    def true_signals(
        self, before: TaskState[RingCut] | None, after: TaskState[RingCut]
    ) -> dict[str, Tensor]:
        """The signals of a simulated step; see `MeasuredTask.true_signals`."""
        return {
            "view_fraction": after.world.scene.view.fraction,
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
        arms, scene, cut = state.world.arms, state.world.scene, state.goal
        laser, eye, pointing = arms["laser"], arms["endoscope"], self.pointing
        ahead = [self.target_mm(state, k) for k in range(self.config.preview + 1)]
        offsets = [pointing["laser"].offset_mm(laser.seen_mm, target) for target in ahead]
        look = pointing["endoscope"].offset_mm(eye.seen_mm, self.centre_mm(state))
        angle = 2.0 * math.pi * cut.share(self.round)[:, None]
        of_arm = {
            "laser": {
                **numbered(BEAM_ERROR, [offset.asinh() for offset in offsets]),
                RING_PLACE: torch.cat((angle.sin(), angle.cos()), 1),
                RING_DIRECTION: cut.direction[:, None],
            },
            "endoscope": {VIEW_ERROR: look.asinh()},
        }
        shared = {
            VIEW: scene.view.fraction[:, None],
            FIRED: cut.fired[:, None].float(),
            TIME: state.world.steps[:, None] / self.steps,
            APART: (laser.seen_mm[:, -1] - eye.seen_mm[:, -1]) / 50.0,
        }
        return {
            name: {**body_blocks(self.world.arms[name], arms[name]), **of_arm[name], **shared}
            for name in self.agents
        }

    def observe(self, state: TaskState[RingCut]) -> dict[str, Tensor]:
        """Concatenated observation blocks, agent -> (B, D)."""
        return {agent: joined(blocks) for agent, blocks in self.blocks(state).items()}

    def rewards(self, state: TaskState[RingCut]) -> dict[str, dict[str, Tensor]]:
        """Weighted reward terms, see `LaserWeights` and `EndoscopeWeights`."""
        error, scene = self.beam_error_mm(state), state.world.scene
        shared = {
            "cut": state.goal.fired.float(),
            "contact": (scene.clearance.least_mm < self.spec.limits.clearance_mm).float(),
        }
        laser = {
            "far": 1.0 / (1.0 + error / self.config.far_mm),
            "aim": (-error).exp(),
            "fine": (-error / self.config.fine_mm).exp(),
        }
        endoscope = {
            "look": 1.0 / (1.0 + scene.view.axis_error_mm / self.config.far_mm),
            "view": scene.view.fraction,
        }
        return {
            "laser": weighted(laser | shared, self.weights["laser"]),
            "endoscope": weighted(endoscope | shared, self.weights["endoscope"]),
        }

    def ended(self, state: TaskState[RingCut]) -> Tensor:
        """When the ring is cut all around, or an arm touches a body, the other arm or itself."""
        done = self.scene.ablation.report(state.world.scene.dose).completion >= 1.0
        return done | state.world.scene.clearance.collides

    def measures(self, state: TaskState[RingCut]) -> dict[str, Tensor]:
        """Beam error, progress of the cut, healthy tissue burnt, view, clearance, success.

        beam_error_mm: true error while the beam is on. pointing_error_mm: true error at every step
        after `approach_s`, with the beam on or off, so that no gate truncates it.
        """
        scene, error = state.world.scene, self.beam_error_mm(state)
        ring, hit = self.scene.ablation.report(scene.dose), scene.clearance.collides
        return {
            "beam_error_mm": error.where(state.goal.fired, float("nan")),
            "pointing_error_mm": error.where(
                state.world.steps * self.dt_s > self.config.approach_s, float("nan")
            ),
            "completion": ring.completion,
            "largest_gap_mm": ring.largest_gap_mm,
            "healthy_mm2": ring.healthy_mm2,
            "view_fraction": scene.view.fraction,
            "clearance_mm": scene.clearance.least_mm,
            "collided": hit.float(),
            "success": ((ring.completion >= 1.0) & ~hit).float(),
        }

    def trace(self, state: TaskState[RingCut]) -> tuple[Tensor, Tensor]:
        """Reference point on the ring and end of the beam, each (B, 1, 3) mm."""
        return self.target_mm(state)[:, None], state.world.scene.hit.point_mm[:, None]

    def script(self, state: TaskState[RingCut]) -> dict[str, Tensor]:
        """Scripted expert: points the laser at its next target, the endoscope at the lesion."""
        targets = {"laser": self.target_mm(state, 1), "endoscope": self.centre_mm(state)}
        pointing = self.pointing
        return {
            name: pointing[name].action(state.world.arms[name], target)
            for name, target in targets.items()
        }


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
