"""Two arms cut a ring around a lesion on an organ that moves with respiration.

With `mode = "follow"` beam and camera follow the lesion. With `mode = "gated"` they point at the
lesion's place at the end of exhalation, and the beam is on only while the organ is near it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from surgisoft.errors import unknown_name
from surgisoft.tasks.base import Signal, TaskState
from surgisoft.tasks.laser_supervision import laser_experiment
from surgisoft.tasks.laser_work import (
    AGENTS,
    LASER,
    LASER_PRESET,
    LASER_STEPS,
    LaserConfig,
    LaserWorkWeights,
    RingTask,
    check_config,
)
from surgisoft.tasks.observations import Block, ObservationBlocks
from surgisoft.tasks.spec import TaskSpec
from surgisoft.tasks.trajectories.closed_path import RingCut, draw_cut
from surgisoft.tasks.world.random_streams import Stream
from surgisoft.tasks.world.respiration import OrganMotion, Respiration

MODES = ("follow", "gated")
"""What the beam does while the organ moves."""
BREATH = Block(
    "breath", "measured displacement of the organ towards the feet", "mm", "x / 10 mm", 0.0, 20.0
)
BREATH_RATE = Block("breath_rate", "rate of that displacement", "mm/s", "x / 20 mm/s")
GATE = Block("gate", "1 while the organ is near the end of exhalation, else 0", "-", "x", 0.0, 1.0)
BREATH_MM = Signal(
    "breath_mm", BREATH.meaning, "mm", 0.0, 40.0, lambda task, before, after: task.breath(after)[0]
)
BREATH_MM_S = Signal(
    "breath_mm_s",
    "rate of the organ's displacement towards the feet",
    "mm/s",
    -100.0,
    100.0,
    lambda task, before, after: task.breath(after)[1],
)


@dataclass(frozen=True)
class BreathingAblationConfig(LaserConfig):
    """The scene, the respiration, the speed of the cut, the observation and the reward.

    Safety limits come from the scene's file.
    """

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
    preview: int = 2
    """Future targets in the laser's observation, one per step (a count); the organ's motion is
    extrapolated by its present rate."""
    weights: LaserWorkWeights = field(default_factory=LaserWorkWeights)
    """Weights of the reward terms."""

    def __post_init__(self):
        if self.mode not in MODES:
            raise unknown_name("mode", self.mode, MODES)
        check_config("breathing_ablation", self, "gate_mm", "cut_s", "time_s")


def success_rule(config: BreathingAblationConfig) -> str:
    """Definition of success, in words; `measures` computes it."""
    gate = ""
    if config.mode == "gated":
        gate = f" and while the organ is within {config.gate_mm:g} mm of the end of exhalation"
    return (
        f"the whole ring is cut, without contact; the beam is on only within {config.fire_mm:g} mm "
        f"of its target (fire_mm){gate}, which goes once around in {config.cut_s:g} s (cut_s)"
    )


class BreathingAblation(RingTask[RingCut]):
    """Two arms of a scene: agents `laser` and `endoscope`."""

    name = "breathing_ablation"
    signals = (*RingTask.signals, BREATH_MM, BREATH_MM_S)

    def __init__(
        self, config: BreathingAblationConfig | None = None, device: str | torch.device = "cpu"
    ):
        c = config or BreathingAblationConfig()
        super().__init__(c, device, time_s=c.time_s, respiration=c.respiration)
        assert self.scene.motion is not None
        self.motion: OrganMotion = self.scene.motion
        self.follows = c.mode == "follow"

    def goal(self, stream: Stream) -> tuple[Stream, RingCut]:
        """Draw start and direction of the cut for each random number stream."""
        return draw_cut(stream)

    def breath(self, state: TaskState[RingCut]) -> tuple[Tensor, Tensor]:
        """(B,) mm towards the feet, from the end of exhalation, and (B,) mm/s, as simulated."""
        breaths = state.world.scene.breaths
        assert breaths is not None, "the organ moves"
        return self.motion.displacement_mm(breaths)

    def displacement_mm(self, state: TaskState[RingCut]) -> tuple[Tensor, Tensor]:
        """(B,) mm towards the feet, from the end of exhalation, and (B,) mm/s."""
        measured = state.world.scene.measured
        if measured:
            return measured[BREATH_MM.name], measured[BREATH_MM_S.name]
        return self.breath(state)

    def in_gate(self, state: TaskState[RingCut]) -> Tensor:
        """(B,) bool: the organ is near its place at the end of exhalation."""
        return self.displacement_mm(state)[0] <= self.config.gate_mm

    def resting_mm(self, state: TaskState[RingCut], ahead: int = 0) -> Tensor:
        """(B, 3) mm: the reference point on the ring at the end of exhalation."""
        return super().target_mm(state, ahead)

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
        return self._moved(state, centre) if self.follows else centre

    def _moved(self, state: TaskState[RingCut], points_mm: Tensor, ahead_s: float = 0.0) -> Tensor:
        """Where points (B, 3) mm of the organ at the end of exhalation are `ahead_s` from now."""
        if ahead_s == 0.0:
            return self.motion.placement(self.displacement_mm(state)[0]).points(points_mm)
        breaths = state.world.scene.breaths
        assert breaths is not None, "the organ moves"
        later, _ = self.motion.displacement_mm(breaths, ahead_s)
        return self.motion.placement(later).points(points_mm)

    def tissue_error_mm(self, state: TaskState[RingCut]) -> Tensor:
        """(B,) mm: distance of the beam's axis from the place on the organ that is to be cut."""
        here = self._moved(state, self.resting_mm(state))
        part = state.world.arms[LASER]
        return self.pointing[LASER].offset_mm(part.points_mm, here, part.mount).norm(dim=1)

    def fires(self, state: TaskState[RingCut]) -> Tensor:
        """(B,) bool: whether the beam would be on: where it is `released`; with `gated` only while
        the organ is near the end of exhalation."""
        released = self.released(state)
        return released if self.follows else released & self.in_gate(state)

    def shared_blocks(self, state: TaskState[RingCut]) -> ObservationBlocks:
        """Respiration, as it is measured."""
        now, rate = self.displacement_mm(state)
        return {
            BREATH: now[:, None] / 10.0,
            BREATH_RATE: rate[:, None] / 20.0,
            GATE: self.in_gate(state)[:, None].float(),
        }

    def measures(self, state: TaskState[RingCut]) -> dict[str, Tensor]:
        """Beam error, progress of the cut, healthy tissue burnt, respiration, view, success.

        tissue_error_mm: distance of the beam from the moving place that is to be cut, while the
        beam is on; beside it `beam_error_mm` is the distance from the target.
        """
        ring = self.ring_measures(state)
        tissue = self.tissue_error_mm(state)
        return {
            **self.errors(state),
            "tissue_error_mm": tissue.where(state.goal.fired, float("nan")),
            **ring,
            "breath_mm": self.displacement_mm(state)[0],
            "beam_on": state.goal.fired.float(),
            **self.safety(state, ring["completion"] >= 1.0),
        }

    def script(self, state: TaskState[RingCut]) -> dict[str, Tensor]:
        """Scripted expert: points the laser at its next target, the endoscope at the lesion.

        It knows the breath, and with `follow` where the organ will be after the step.
        """
        target, centre = self.resting_mm(state, 1), self.centre_mm(state)
        if self.follows:
            target = self._moved(state, target, self.dt_s)
            centre = self._moved(state, centre, self.dt_s)
        return self.pointed(state, target, centre)


BREATHING_ABLATION = TaskSpec(
    BreathingAblation,
    BreathingAblationConfig(),
    AGENTS,
    preset=LASER_PRESET,
    training_steps=LASER_STEPS,
    experiment=laser_experiment(
        "share cut", {}, {"tissue_error_mean_mm": "error on the tissue, mean [mm]"}
    ),
    success_rule=success_rule,
)
