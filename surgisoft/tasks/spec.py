"""`TaskSpec`: how a task of the registry is built, with its defaults."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from surgisoft.tasks.supervision import BEAMLESS, ExperimentTask


@dataclass(frozen=True)
class TaskSpec:
    """Registry entry of a task: how to build it, and its defaults."""

    build: Any
    """Function that builds the task: build(config, device) -> Task."""
    config: Any
    """Default configuration: a frozen dataclass."""
    agents: tuple[str, ...]
    """Names of the task's agents."""
    preset: Mapping[str, Any] = field(default_factory=dict)
    """Fields of `agents.presets.Preset` in which the task's `fast` preset differs."""
    training_steps: int | None = None
    """Environment steps of a training run with the `fast` preset; None: the paper's 20 million."""
    experiment: ExperimentTask = BEAMLESS
    """What experiments need to know of it."""
    success_rule: Callable[[Any], str] | None = None
    """(config) -> what an episode needs to be a success, in words; None: the task has no success.
    """
