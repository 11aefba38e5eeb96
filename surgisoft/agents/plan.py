"""What a training run is asked for."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from surgisoft.agents.presets import Preset
from surgisoft.errors import InputError


@dataclass(frozen=True)
class Plan:
    """One training run."""

    task: str
    """Name of the task."""
    task_config: Any
    """The task's own configuration."""
    preset_name: str
    """Preset that the hyper-parameters come from."""
    preset: Preset
    """Hyper-parameters."""
    steps: int | None
    """Steps to train, over all episodes; None: until the time is out."""
    minutes: float | None = None
    """Time to train, minutes; None: until the steps are done."""
    target_error: float | None = None
    """Training ends when evaluation finds no more than this error, mm, and full success."""
    seed: int = 0
    """Seed of weights, noise and episodes."""

    def __post_init__(self):
        if self.steps is None and self.minutes is None:
            raise InputError("train: neither steps nor minutes are given; expected one of them")
        for name in ("steps", "minutes", "target_error"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise InputError(f"train: {name} is {value}, expected more than 0")

    def share(self, steps: int, seconds: float) -> float:
        """Share 0..1 of the training that is done."""
        done = [0.0]
        if self.steps is not None:
            done.append(steps / self.steps)
        if self.minutes is not None:
            done.append(seconds / (60.0 * self.minutes))
        return min(1.0, max(done))
