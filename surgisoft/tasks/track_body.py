"""The whole body of one arm follows a moving reference shape that the arm can take."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.tasks.base import TaskState, check_weights, weighted
from surgisoft.tasks.inverse_kinematics import action_towards
from surgisoft.tasks.observations import (
    Block,
    ObservationBlocks,
    elapsed,
    free_points,
    joined,
    numbered,
    pressure_blocks,
)
from surgisoft.tasks.path_following import FOLLOW_PRESET, FOLLOW_STEPS
from surgisoft.tasks.spec import TaskSpec
from surgisoft.tasks.supervision import WITHOUT_SUCCESS
from surgisoft.tasks.track import level_world
from surgisoft.tasks.world.arm import Arm
from surgisoft.tasks.world.random_streams import Stream
from surgisoft.tasks.world.world import WorldConfig

WAVE_SHARES = (0.6, 0.4)
"""Shares of the slow and the fast wave in the pressure amplitude."""
STUCK_MM = 0.02
"""Residual over all key points above which the expert tries other starting points (mm)."""

SHAPE = Block("shape", "measured key points relative to their rest positions", "mm", "x / 10")
ERROR = Block("error", "target minus measured key points, base excluded", "mm", "asinh(x / 1 mm)")
TIME = Block("time", "elapsed share of the episode", "-", "2 x - 1", -1.0, 1.0)


@dataclass(frozen=True)
class TrackBodyWeights:
    """Weights of the reward terms; e is the mean distance of the key points from theirs, mm."""

    body: float = 1.0
    """exp(-e / 1 mm)."""
    fine: float = 1.0
    """exp(-e / fine_mm)."""


@dataclass(frozen=True)
class TrackBodyConfig:
    """How the reference shape moves, the observation and the reward."""

    arm: str | Path = "default"
    """Arm model: `default`, or the folder of a fitted model."""
    mean_kPa: float = 20.0
    """Mean pressure of every chamber of the reference, kPa."""
    swing_kPa: float = 15.0
    """Largest amplitude of the reference's pressures, kPa; they are clipped to the arm's range."""
    slow_s: float = 12.0
    """Period of the slow wave, s."""
    fast_s: float = 7.0
    """Period of the fast wave, s."""
    approach_s: float = 3.0
    """Time at the beginning during which the reference waits, s."""
    time_s: float = 20.0
    """Time during which the reference moves, s."""
    preview: int = 2
    """Future targets in the observation, one per step (a count)."""
    fine_mm: float = 0.1
    """Scale of the reward term `fine`, mm."""
    weights: TrackBodyWeights = field(default_factory=TrackBodyWeights)
    """Weights of the reward terms."""
    world: WorldConfig = field(default_factory=WorldConfig)
    """The simulator and its domain randomization."""

    def __post_init__(self):
        for name in ("swing_kPa", "slow_s", "fast_s", "time_s", "preview", "fine_mm"):
            if not getattr(self, name) > 0:
                raise InputError(f"track_body: {name} is {getattr(self, name)}, expected above 0")
        if not self.approach_s >= 0.0:
            raise InputError(f"track_body: approach_s is {self.approach_s}, expected 0 or more")
        check_weights("track_body", self.weights)


@dataclass(frozen=True, eq=False)
class Waves:
    """Phases of the reference waves of B episodes."""

    phase: Tensor
    """(B, 2, m) 0..1: phase of the slow and the fast wave of each chamber."""


class TrackBody:
    """One arm in empty space, all of whose key points follow those of a reference shape."""

    name, agents = "track_body", ("arm",)

    def __init__(self, config: TrackBodyConfig | None = None, device: str | torch.device = "cpu"):
        c = self.config = config or TrackBodyConfig()
        self.world = level_world(c.world, c.mean_kPa, c.arm, device)
        self.dt_s, self.weights = c.world.dt_s, {"arm": c.weights}
        self.approach = round(c.approach_s / self.dt_s)
        moving = round(c.time_s / self.dt_s)
        if not moving:
            raise InputError(
                f"track_body: time_s is {c.time_s:g} s, expected at least a step, {self.dt_s:g} s"
            )
        self.steps = self.approach + moving
        row: dict[str, Any] = {"dtype": torch.float32, "device": self.world.device}
        self._pace = torch.tensor([1.0 / c.slow_s, 1.0 / c.fast_s], **row)[:, None]
        self._swing = c.swing_kPa * torch.tensor(WAVE_SHARES, **row)[:, None]
        self._rest = self.arm.model.rest_mm.to(**row)

    @property
    def arm(self) -> Arm:
        """The only arm."""
        return self.world.arms["arm"]

    def goal(self, stream: Stream) -> tuple[Stream, Waves]:
        """Draw the phases of the reference pressures for each random number stream."""
        stream, phase = stream.uniform(0.0, 1.0, 2, self.arm.chambers)
        return stream, Waves(phase)

    def target_mm(self, state: TaskState[Waves], ahead: int = 0) -> Tensor:
        """(B, n, 3) mm, world frame: reference key points `ahead` steps from now.

        They are the steady-state key points of the arm model at the reference pressures.
        """
        moved = (state.world.steps + ahead - self.approach).clamp(min=0).float() * self.dt_s
        turn = 2.0 * math.pi * (self._pace * moved[:, None, None] + state.goal.phase)
        pressure = self.config.mean_kPa + (self._swing * turn.sin()).sum(1)
        return self.arm.settled(torch.minimum(torch.maximum(pressure, self.arm.low), self.arm.high))

    def errors_mm(self, state: TaskState[Waves]) -> Tensor:
        """(B, k) mm: distance of each true key point but the base from its target."""
        off = state.world.arms["arm"].points_mm - self.target_mm(state)
        return free_points(off).norm(dim=2)

    def advance(self, state: TaskState[Waves], actions: Mapping[str, Tensor]) -> TaskState[Waves]:
        """Advance the arm one step."""
        return replace(state, world=self.world.step(state.world, actions))

    def blocks(self, state: TaskState[Waves]) -> dict[str, ObservationBlocks]:
        """Observation blocks: body, errors of all key points now and ahead, and time."""
        part = state.world.arms["arm"]
        ahead = [self.target_mm(state, k) for k in range(self.config.preview + 1)]
        errors = [free_points(target - part.steered_mm).flatten(1).asinh() for target in ahead]
        return {
            "arm": {
                SHAPE: free_points(part.steered_mm - self._rest).flatten(1) / 10.0,
                **numbered(ERROR, errors),
                **pressure_blocks(self.arm, part),
                TIME: 2.0 * elapsed(state.world.steps, self.steps) - 1.0,
            }
        }

    def observe(self, state: TaskState[Waves]) -> dict[str, Tensor]:
        """Concatenated observation blocks, agent -> (B, D)."""
        return {agent: joined(blocks) for agent, blocks in self.blocks(state).items()}

    def rewards(self, state: TaskState[Waves]) -> dict[str, dict[str, Tensor]]:
        """Weighted reward terms, see `TrackBodyWeights`."""
        error = self.errors_mm(state).mean(1)
        terms = {"body": (-error).exp(), "fine": (-error / self.config.fine_mm).exp()}
        return {"arm": weighted(terms, self.config.weights)}

    def ended(self, state: TaskState[Waves]) -> Tensor:
        """Never: an episode lasts its full time."""
        return torch.zeros_like(state.world.failed)

    def measures(self, state: TaskState[Waves]) -> dict[str, Tensor]:
        """Mean error of the key points, and the tip's; none while the reference waits."""
        errors, waits = self.errors_mm(state), state.world.steps <= self.approach
        return {
            "error_mm": errors.mean(1).masked_fill(waits, float("nan")),
            "tip_mm": errors[:, -1].masked_fill(waits, float("nan")),
        }

    def trace(self, state: TaskState[Waves]) -> tuple[Tensor, Tensor]:
        """Reference and true key points, each (B, n, 3) mm."""
        return self.target_mm(state), state.world.arms["arm"].points_mm

    def script(self, state: TaskState[Waves]) -> dict[str, Tensor]:
        """Scripted expert: inverse kinematics for all key points at once, one step ahead."""

        def error(points: Tensor, target: Tensor) -> Tensor:
            return free_points(points - target).flatten(1)

        part, target = state.world.arms["arm"], self.target_mm(state, 1)
        return {"arm": action_towards(self.arm, part, target, error, self.dt_s, STUCK_MM)}


TRACK_BODY = TaskSpec(
    TrackBody, TrackBodyConfig(), ("arm",), FOLLOW_PRESET, FOLLOW_STEPS, WITHOUT_SUCCESS
)
