"""The whole body of one arm follows shapes that it can take, moving in time."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.tasks.base import TaskState
from surgisoft.tasks.inverse_kinematics import pressure_part, seek
from surgisoft.tasks.track import level_world
from surgisoft.tasks.world.arm import Arm
from surgisoft.tasks.world.random import Stream
from surgisoft.tasks.world.world import WorldConfig

WEIGHTS = (0.6, 0.4)
"""Shares of the slow and the fast wave in the swing."""
STUCK_MM = 0.02
"""The script tries again where it leaves more than this over all key points together (mm)."""


@dataclass(frozen=True)
class TrackBodyConfig:
    """How the target shapes move, and what following them is worth."""

    arm: str | Path = "default"
    """Arm model: `default`, or the folder of a fitted model."""
    mean_kPa: float = 20.0
    """Pressure of every chamber about which the target's pressures swing, kPa."""
    swing_kPa: float = 15.0
    """Greatest swing to either side, kPa; held within the arm's range."""
    slow_s: float = 12.0
    """Period of the slow wave, s."""
    fast_s: float = 7.0
    """Period of the fast wave, s."""
    approach_s: float = 3.0
    """Time at the beginning in which the target waits, s."""
    time_s: float = 20.0
    """Time for which it moves, s."""
    preview: int = 2
    """Coming targets that the arm knows, one a step."""
    fine_mm: float = 0.1
    """Scale of the second reward term, mm."""
    world: WorldConfig = field(default_factory=WorldConfig)
    """The world and its randomisation."""

    def __post_init__(self):
        for name in ("swing_kPa", "slow_s", "fast_s", "time_s", "preview", "fine_mm"):
            if not getattr(self, name) > 0:
                raise InputError(f"track_body: {name} is {getattr(self, name)}, expected above 0")


@dataclass(frozen=True, eq=False)
class Waves:
    """How the targets of a batch of episodes swing."""

    phase: Tensor
    """(B, 2, m) 0..1: phase of the slow and the fast wave of each chamber."""


class TrackBody:
    """One arm in empty space, all of whose key points follow those of a target."""

    name, agents = "track_body", ("arm",)

    def __init__(self, config: TrackBodyConfig | None = None, device: str | torch.device = "cpu"):
        c = self.config = config or TrackBodyConfig()
        self.world = level_world(c.world, c.mean_kPa, c.arm, device)
        self.dt_s = c.world.dt_s
        self.approach = round(c.approach_s / self.dt_s)
        self.steps = self.approach + round(c.time_s / self.dt_s)
        row = {"dtype": torch.float32, "device": self.world.device}
        self._pace = torch.tensor([1.0 / c.slow_s, 1.0 / c.fast_s], **row)[:, None]
        self._swing = c.swing_kPa * torch.tensor(WEIGHTS, **row)[:, None]
        self._rest = self.arm.model.rest_mm.to(**row)

    @property
    def arm(self) -> Arm:
        """The world's one arm."""
        return self.world.arms["arm"]

    def goal(self, stream: Stream) -> tuple[Stream, Waves]:
        stream, phase = stream.uniform(0.0, 1.0, 2, self.arm.chambers)
        return stream, Waves(phase)

    def target_mm(self, state: TaskState, ahead: int = 0) -> Tensor:
        """(B, n, 3) mm, world frame: where the key points should be `ahead` steps from now.

        The shape that an arm without memory of its past takes at the target's pressures.
        """
        moved = (state.world.steps + ahead - self.approach).clamp(min=0).float() * self.dt_s
        turn = 2.0 * math.pi * (self._pace * moved[:, None, None] + state.goal.phase)
        pressure = self.config.mean_kPa + (self._swing * turn.sin()).sum(1)
        return self.arm.settled(torch.minimum(torch.maximum(pressure, self.arm.low), self.arm.high))

    def errors_mm(self, state: TaskState) -> Tensor:
        """(B, n - 1) mm: distance of each true key point but the base from its target."""
        return (state.world.arms["arm"].points_mm - self.target_mm(state)).norm(dim=2)[:, 1:]

    def advance(self, state: TaskState, actions: Mapping[str, Tensor], in_place: bool) -> TaskState:
        return replace(state, world=self.world.step(state.world, actions, in_place=in_place))

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        """Body, errors of all key points now and ahead (asinh of mm), pressures, time."""
        part = state.world.arms["arm"]
        ahead = [self.target_mm(state, k) for k in range(self.config.preview + 1)]
        errors = [(target - part.seen_mm)[:, 1:].flatten(1).asinh() for target in ahead]
        body = (part.seen_mm - self._rest)[:, 1:].flatten(1) / 10.0
        time = 2.0 * state.world.steps[:, None] / self.steps - 1.0
        return {"arm": torch.cat((body, *errors, *pressure_part(self.arm, part), time), 1)}

    def rewards(self, state: TaskState) -> dict[str, dict[str, Tensor]]:
        """body: exp(-e), e the mean error in mm; fine: the same, finer scale."""
        error = self.errors_mm(state).mean(1)
        return {"arm": {"body": (-error).exp(), "fine": (-error / self.config.fine_mm).exp()}}

    def ended(self, state: TaskState) -> Tensor:
        return torch.zeros_like(state.world.failed)

    def measures(self, state: TaskState) -> dict[str, Tensor]:
        """Mean error of the key points, and the tip's; nan while the target waits."""
        errors, waits = self.errors_mm(state), state.world.steps <= self.approach
        return {
            "error_mm": errors.mean(1).masked_fill(waits, float("nan")),
            "tip_mm": errors[:, -1].masked_fill(waits, float("nan")),
        }

    def trace(self, state: TaskState) -> tuple[Tensor, Tensor]:
        return self.target_mm(state), state.world.arms["arm"].points_mm

    def script(self, state: TaskState) -> dict[str, Tensor]:
        """Damped least squares over all key points at once, a step ahead."""

        def error(points: Tensor, target: Tensor) -> Tensor:
            return (points - target)[:, 1:].flatten(1)

        part, target = state.world.arms["arm"], self.target_mm(state, 1)
        return {"arm": seek(self.arm, part, target, error, self.dt_s, STUCK_MM)}
