"""What an arm recalls of its last steps: how its pressures changed, and where that brought it.

An arm with hysteresis answers a change of pressure more or less, by how far its chambers have come
since they last turned round, and before. What the last steps did tells how it answers now.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from surgisoft.errors import InputError, unknown_name
from surgisoft.tasks.base import TaskState
from surgisoft.tasks.inverse_kinematics import pressure_part, seek
from surgisoft.tasks.trajectories import PATHS, Round, fresh_round
from surgisoft.tasks.world.arm import Arm
from surgisoft.tasks.world.random import Stream
from surgisoft.tasks.world.world import ArmPart, World


@dataclass(frozen=True, eq=False)
class Recall:
    """The last R steps of a batch of episodes, newest first; zero before an episode began."""

    kPa: Tensor
    """(B, R, m) kPa: change of the measured pressures in each step."""
    mm: Tensor
    """(B, R, 3) mm: movement of the point that follows, as measured, world frame."""

    def after(self, kPa: Tensor, mm: Tensor) -> Recall:
        """A step later, which changed pressures by (B, m) kPa and moved the point by (B, 3) mm."""
        return Recall(_pushed(self.kPa, kPa), _pushed(self.mm, mm))

    def seen(self) -> tuple[Tensor, ...]:
        """As observed: (B, R m) and (B, R 3), of the order of 1 while a path is followed."""
        return self.kPa.flatten(1), self.mm.flatten(1)


def nothing(count: int, steps: int, chambers: int, device: torch.device) -> Recall:
    """B = `count` episodes that have just begun, which will recall R = `steps` steps."""
    zeros = torch.zeros(count, steps, chambers + 3, device=device)
    return Recall(zeros[..., :chambers], zeros[..., chambers:])


def _pushed(last: Tensor, new: Tensor) -> Tensor:
    return torch.cat((new[:, None], last), 1)[:, : last.shape[1]]


@dataclass(frozen=True)
class FollowConfig:
    """A path, how it is walked, and what following it is worth."""

    path: str = "circle"
    """`circle` or `square`."""
    size_mm: float = 20.0
    """Diameter or edge, mm."""
    loop_s: float = 20.0
    """Time for once around, s."""
    loops: int = 1
    """Times around."""
    approach_s: float = 3.0
    """Time at the beginning in which the target waits where the path begins, s."""
    any_start: bool = True
    """Whether an episode begins anywhere on the path and runs either way round."""
    preview: int = 2
    """Coming targets that the arm knows, one a step."""
    recall: int = 2
    """Last steps of which the arm knows how they changed its pressures and moved the point; 0: of
    none."""
    foresight: bool = True
    """Whether the arm knows where its model, which follows its pressures as the scripted solver's
    does, expects the point a step from now if the commands are held."""
    fine_mm: float = 0.1
    """Scale of the second reward term, mm."""
    fine_weight: float = 1.0
    """Weight of the second reward term; 0: the paper's reward."""
    arm: str | Path = "default"
    """Arm model: `default`, or the folder of a fitted model."""

    def __post_init__(self):
        if self.path not in PATHS:
            raise unknown_name("path", self.path, PATHS)
        for name in ("size_mm", "loop_s", "loops", "preview", "fine_mm"):
            if not getattr(self, name) > 0:
                raise InputError(f"task: {name} is {getattr(self, name)}, expected more than 0")
        if self.recall < 0:
            raise InputError(f"task: recall is {self.recall}, expected 0 or more")


@dataclass(frozen=True, eq=False)
class Course:
    """Where a batch of episodes goes, and what was of it."""

    round: Round
    """How it goes round."""
    recall: Recall
    """The last steps."""


class Follow:
    """One arm in empty space, one of whose points follows a path."""

    agents = ("arm",)

    def __init__(
        self,
        name: str,
        world: World,
        config: FollowConfig,
        marker: Callable[[Tensor], Tensor],
        centre_mm: Tensor,
        directions: int,
    ):
        """marker: key points (B, n, 3) mm to the point that follows (B, 3) mm, world frame.

        The path lies about centre_mm (3,), level; the solver holds the first `directions`
        coordinates of the point (2 where the third is fixed).
        """
        self.name, self.world, self.config = name, world, config
        self.marker, self.centre = marker, centre_mm
        self.dt_s = world.config.dt_s
        self.approach = round(config.approach_s / self.dt_s)
        self.loop = round(config.loop_s / self.dt_s)
        self.steps = self.approach + self.loop * config.loops
        self._directions = directions
        self._rest = self.arm.model.rest_mm.to(centre_mm)

    @property
    def arm(self) -> Arm:
        """The world's one arm."""
        return self.world.arms["arm"]

    def goal(self, stream: Stream) -> tuple[Stream, Course]:
        stream, way = fresh_round(stream, self.config.any_start)
        size = len(stream.key), self.config.recall, self.arm.chambers
        return stream, Course(way, nothing(*size, self.world.device))

    def target_mm(self, state: TaskState, ahead: int = 0) -> Tensor:
        """(B, 3) mm, world frame: where the point should be `ahead` steps from now."""
        share = state.goal.round.share(state.world.steps + ahead, self.approach, self.loop)
        flat = self.config.size_mm * PATHS[self.config.path](share)
        return self.centre + torch.nn.functional.pad(flat, (0, 1))

    def error_mm(self, state: TaskState) -> Tensor:
        """(B,) mm: distance of the true point from its target."""
        point = self.marker(state.world.arms["arm"].points_mm)
        return (point - self.target_mm(state)).norm(dim=1)

    def advance(self, state: TaskState, actions: Mapping[str, Tensor], in_place: bool) -> TaskState:
        before = state.world.arms["arm"]
        world = self.world.step(state.world, actions, in_place=in_place)
        after = world.arms["arm"]
        moved = self.marker(after.seen_mm) - self.marker(before.seen_mm)
        recall = state.goal.recall.after(after.seen_kPa - before.seen_kPa, moved)
        return TaskState(world, replace(state.goal, recall=recall))

    def observe(self, state: TaskState) -> dict[str, Tensor]:
        """Body, errors now and ahead, pressures, direction of change, last steps, time.

        Errors through asinh, in mm and the first two in `fine_mm` as well: as they are within that
        length, by their logarithm beyond. So is the error that the model expects a step from now
        if the commands are held.
        """
        part = state.world.arms["arm"]
        point = self.marker(part.seen_mm)
        errors = [self.target_mm(state, ahead) - point for ahead in range(self.config.preview + 1)]
        fine = errors[:2]
        if self.config.foresight:
            fine.append(self.target_mm(state, 1) - self.marker(self._held(part)))
        parts = [
            (part.seen_mm - self._rest)[:, 1:].flatten(1) / 10.0,
            *(error.asinh() for error in errors),
            *((error / self.config.fine_mm).asinh() for error in fine),
            *pressure_part(self.arm, part),
            *state.goal.recall.seen(),
            2.0 * state.world.steps[:, None] / self.steps - 1.0,
        ]
        return {"arm": torch.cat(parts, 1)}

    def _held(self, part: ArmPart) -> Tensor:
        """(B, n, 3) mm: where the arm's model expects the key points if the commands are held."""
        pressure = self.arm.pneumatics.follow(part.pressure, part.command, self.dt_s)
        held = self.arm.foresee(part, pressure, self.dt_s)
        if self.arm.vary.noise_mm == 0.0:
            return held
        # The model knows where the arm truly is: of what it expects only the movement is told.
        return part.seen_mm + held - self.arm.foresee(part, part.pressure, self.dt_s)

    def rewards(self, state: TaskState) -> dict[str, dict[str, Tensor]]:
        """track: exp(-e), e in mm (Chen et al. 2025, sec. IV-A); fine: the same, finer scale."""
        error, config = self.error_mm(state), self.config
        terms = {"track": (-error).exp()}
        if config.fine_weight:
            terms["fine"] = config.fine_weight * (-error / config.fine_mm).exp()
        return {"arm": terms}

    def ended(self, state: TaskState) -> Tensor:
        return torch.zeros_like(state.world.failed)

    def measures(self, state: TaskState) -> dict[str, Tensor]:
        """The error on the path; nan while the target waits."""
        return {
            "error_mm": self.error_mm(state).masked_fill(
                state.world.steps <= self.approach, float("nan")
            )
        }

    def trace(self, state: TaskState) -> tuple[Tensor, Tensor]:
        point = self.marker(state.world.arms["arm"].points_mm)
        return self.target_mm(state)[:, None], point[:, None]

    def script(self, state: TaskState) -> dict[str, Tensor]:
        """Damped least squares for the pressures that put the point on the next target."""

        def error(points: Tensor, target: Tensor) -> Tensor:
            return (self.marker(points) - target)[:, : self._directions]

        part, target = state.world.arms["arm"], self.target_mm(state, 1)
        return {"arm": seek(self.arm, part, target, error, self.dt_s)}
