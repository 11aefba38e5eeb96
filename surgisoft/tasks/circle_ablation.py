"""Two arms cut a ring around a lesion: one carries the endoscope, one the laser (Chen et al. 2025).

The beam is on only while the endoscope sees enough of the ring. The dose map decides about success.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch

from surgisoft.tasks.base import TaskState
from surgisoft.tasks.laser_supervision import LASER_EXPERIMENT
from surgisoft.tasks.laser_work import (
    AGENTS,
    LASER_PRESET,
    LaserConfig,
    LaserWorkWeights,
    RingTask,
    check_config,
)
from surgisoft.tasks.lone_ring import LoneRing
from surgisoft.tasks.spec import TaskSpec
from surgisoft.tasks.trajectories.closed_path import RingCut, draw_cut
from surgisoft.tasks.world.random_streams import Stream


@dataclass(frozen=True)
class CircleAblationConfig(LaserConfig):
    """The scene, the speed of the cut, the observation and the reward.

    Time and safety limits come from the scene's file.
    """

    cut_s: float = 45.0
    """Time for once around with the beam on, s."""
    weights: LaserWorkWeights = field(default_factory=LaserWorkWeights)
    """Weights of the reward terms."""

    def __post_init__(self):
        check_config("circle_ablation", self, "cut_s")


def success_rule(config: CircleAblationConfig) -> str:
    """Definition of success, in words; `measures` computes it."""
    return (
        f"the whole ring is cut, without contact; the beam is on only within {config.fire_mm:g} mm "
        f"of its target (fire_mm), which goes once around in {config.cut_s:g} s (cut_s)"
    )


class CircleAblation(RingTask[RingCut]):
    """Two arms of a scene: agents `laser` and `endoscope`."""

    name = "circle_ablation"

    def __init__(
        self, config: CircleAblationConfig | None = None, device: str | torch.device = "cpu"
    ):
        super().__init__(config or CircleAblationConfig(), device)

    def goal(self, stream: Stream) -> tuple[Stream, RingCut]:
        """Draw start and direction of the cut for each random number stream."""
        return draw_cut(stream)

    def alone(self, state: TaskState[RingCut]) -> LoneRing | None:
        """The episode of a state of one environment, advanced without tensors; see `LoneRing`.

        None for a class that extends this one: `LoneRing` has the rules of this one alone.
        """
        return LoneRing.of(self, state) if type(self) is CircleAblation else None


CIRCLE_ABLATION = TaskSpec(
    CircleAblation,
    CircleAblationConfig(),
    AGENTS,
    preset=LASER_PRESET,
    training_steps=1_000_000,
    experiment=LASER_EXPERIMENT,
    success_rule=success_rule,
)
