"""A point of one arm follows a closed path: the common part of the path-following tasks."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from surgisoft.errors import InputError, unknown_name
from surgisoft.tasks.base import Task, TaskState, check_weights, weighted
from surgisoft.tasks.inverse_kinematics import action_towards, least_squares
from surgisoft.tasks.observations import (
    Block,
    ObservationBlocks,
    asinh_of,
    elapsed,
    free_points,
    joined,
    numbered,
    pressure_blocks,
)
from surgisoft.tasks.trajectories.closed_path import PATHS, Traversal, draw_traversal
from surgisoft.tasks.world.arm import Arm, units_per_kPa
from surgisoft.tasks.world.random_streams import Stream
from surgisoft.tasks.world.reach import actuation_grid
from surgisoft.tasks.world.world import ArmPart, World

FOLLOW_PRESET = {
    "envs": 1024,
    "batches": 16,
    "gamma": 0.6,
    "desired_kl": 0.03,
    "evaluate_every": 25,
}
"""Fields of the `fast` training preset for path following. Each action shows its effect in the next
step, hence the small discount. Many minibatches, because the number of gradient steps decides the
final error."""
FOLLOW_STEPS = 4_000_000
"""Environment steps of a training run of path following with the `fast` preset."""

REACH_POINTS = 40
"""Points of a path that are compared with the arm's reach (a count)."""
REACHED_MM = 0.1
"""Distance from which a point of a path counts as out of reach, mm: the scale of fine errors."""
REACH_STARTS = 16
"""Places of a grid from which the nearest shape is searched for a point out of reach (a count)."""
REACH_GAIN_MM = 1e-3
"""A further search for the nearest shape has to come nearer by this much, mm."""

SHAPE = Block("shape", "measured key points relative to their rest positions", "mm", "x / 10")
ERROR = Block("error", "target minus measured point", "mm", "asinh(x / 1 mm)")
FINE = Block("fine_error", "target minus measured point", "mm", "asinh(x / fine_mm)")
PREDICTED = Block(
    "predicted_error",
    "target minus the model's one-step prediction of the point with the commands held",
    "mm",
    "asinh(x / fine_mm)",
)
PRESSURE_HISTORY = Block(
    "pressure_history", "changes of the measured pressures, newest first", "kPa", "x / 1 kPa"
)
POINT_HISTORY = Block(
    "point_history", "movements of the measured point, newest first", "mm", "x / 1 mm"
)
TIME = Block("time", "elapsed share of the episode", "-", "2 x - 1", -1.0, 1.0)


@dataclass(frozen=True, eq=False)
class ObservationHistory:
    """Pressure changes and motions of the last R steps of B episodes, newest first.

    Zero before an episode began. An arm with hysteresis responds more or less to a change of
    pressure, depending on its past. The effect of the last steps informs a policy of the present
    response.
    """

    kPa: Tensor
    """(B, R, m) kPa: change of the measured pressures in each step."""
    mm: Tensor
    """(B, R, 3) mm: movement of the measured point in each step, world frame."""

    @classmethod
    def empty(
        cls, count: int, steps: int, chambers: int, device: torch.device
    ) -> ObservationHistory:
        """Histories of R = `steps` steps for B = `count` episodes that have just begun."""
        zeros = torch.zeros(count, steps, chambers + 3, device=device)
        return cls(zeros[..., :chambers], zeros[..., chambers:])

    def after(self, kPa: Tensor, mm: Tensor) -> ObservationHistory:
        """Append a step that changed pressures by (B, m) kPa and moved the point by (B, 3) mm."""
        return ObservationHistory(_appended(self.kPa, kPa), _appended(self.mm, mm))


def _appended(last: Tensor, new: Tensor) -> Tensor:
    return torch.cat((new[:, None], last), 1)[:, : last.shape[1]]


@dataclass(frozen=True)
class FollowWeights:
    """Weights of the reward terms; e is the distance of the true point from its target, mm."""

    track: float = 1.0
    """exp(-e / 1 mm) (Chen et al. 2025, sec. IV-A)."""
    fine: float = 1.0
    """exp(-e / fine_mm); with weight 0 the reward is the paper's."""


@dataclass(frozen=True)
class FollowConfig:
    """A closed path, how the reference moves along it, the observation and the reward."""

    path: str = "circle"
    """`circle` or `square`."""
    size_mm: float = 20.0
    """Diameter or edge, mm."""
    loop_s: float = 20.0
    """Time for once around, s."""
    loops: int = 1
    """Times around (a count)."""
    approach_s: float = 3.0
    """Time at the beginning during which the reference waits at its start, s."""
    any_start: bool = True
    """Whether the start on the path and the direction are drawn for each episode."""
    preview: int = 2
    """Future targets in the observation, one per step (a count)."""
    history_steps: int = 2
    """Last steps in the observation: changes of pressure, movements of the point. 0: none."""
    one_step_prediction: bool = True
    """Whether the observation holds the model's prediction of the error after the next step, with
    the commands held. The model runs beside the arm and is fed with its pressures."""
    fine_mm: float = 0.1
    """Scale of the reward term `fine` and of the fine errors observed, mm."""
    weights: FollowWeights = field(default_factory=FollowWeights)
    """Weights of the reward terms."""
    arm: str | Path = "default"
    """Arm model: `default`, or the folder of a fitted model."""

    FORMER_NAMES: ClassVar[dict[str, str]] = {
        "recall": "history_steps",
        "foresight": "one_step_prediction",
        "fine_weight": "weights.fine",
    }

    def __post_init__(self):
        if self.path not in PATHS:
            raise unknown_name("path", self.path, PATHS)
        for name in ("size_mm", "loop_s", "loops", "preview", "fine_mm"):
            if not getattr(self, name) > 0:
                raise InputError(f"task: {name} is {getattr(self, name)}, expected more than 0")
        for name in ("approach_s", "history_steps"):
            if not getattr(self, name) >= 0:
                raise InputError(f"task: {name} is {getattr(self, name)}, expected 0 or more")
        check_weights("task", self.weights)


@dataclass(frozen=True, eq=False)
class FollowGoal:
    """The reference of B episodes, and what the last steps did."""

    traversal: Traversal
    """Where the reference starts, and in which direction it moves."""
    history: ObservationHistory
    """The last steps."""


Marker = Callable[[Tensor, Tensor | None], Tensor]
"""Key points (B, n, 3) mm and mount (B, 4, 4) mm of an arm, None for the nominal one, to the point
(B, 3) mm that follows; world frame."""


class Follow:
    """One arm in empty space, one of whose points follows a closed path."""

    agents = ("arm",)

    def __init__(
        self,
        name: str,
        world: World,
        config: FollowConfig,
        marker: Marker,
        centre_mm: Tensor,
        directions: int,
        whole: Any = None,
    ):
        """Build the task for a level path with its centre at centre_mm, (3,) mm.

        marker: see `Marker`. The expert controls the first `directions` coordinates of that
        point: 2 where the third is constant. whole: the configuration of which `config` is a part;
        None: it has no other.
        """
        self.name, self.world, self.follow = name, world, config
        self.config: Any = config if whole is None else whole
        """The whole configuration of the task, as `config=` of the environments takes it."""
        self.marker, self.centre = marker, centre_mm
        self.dt_s = world.config.dt_s
        self.approach = round(config.approach_s / self.dt_s)
        self.loop = round(config.loop_s / self.dt_s)
        self.steps = self.approach + self.loop * config.loops
        if self.steps and not self.loop:  # the approach alone
            raise InputError(
                f"{name}: loop_s is {config.loop_s:g} s, expected at least a step, {self.dt_s:g} s"
            )
        self.weights = {"arm": config.weights}
        self._directions = directions
        self._rest = self.arm.model.rest_mm.to(centre_mm)

    @property
    def arm(self) -> Arm:
        """The only arm."""
        return self.world.arms["arm"]

    def goal(self, stream: Stream) -> tuple[Stream, FollowGoal]:
        """Draw start and direction on the path for each random number stream; empty history."""
        stream, traversal = draw_traversal(stream, self.follow.any_start)
        size = len(stream.key), self.follow.history_steps, self.arm.chambers
        return stream, FollowGoal(traversal, ObservationHistory.empty(*size, self.world.device))

    def target_mm(self, state: TaskState[FollowGoal], ahead: int = 0) -> Tensor:
        """(B, 3) mm, world frame: the reference `ahead` steps from now."""
        traversal = state.goal.traversal
        share = traversal.share(state.world.steps + ahead, self.approach, self.loop)
        flat = self.follow.size_mm * PATHS[self.follow.path](share)
        return self.centre + torch.nn.functional.pad(flat, (0, 1))

    def out_of_reach_mm(self) -> Tensor:
        """(K,) mm: distance of points along the path from the nearest that the arm reaches.

        In steady states of the model without history, over the whole ranges of its chambers: damped
        least squares from the nearest of a grid. A search can end at the limit of a chamber, away
        from the nearest shape: where more than REACHED_MM remains it starts again, from the
        REACH_STARTS nearest of the grid and from what was found for the points before and behind,
        until these come no nearer. Raises InputError for an arm of more than six chambers.
        """
        spec = self.arm.model.spec
        share = torch.linspace(0.0, 1.0, REACH_POINTS + 1, device=self.centre.device)[:-1]
        flat = self.follow.size_mm * PATHS[self.follow.path](share)
        target = self.centre + torch.nn.functional.pad(flat, (0, 1))
        grid = actuation_grid(spec).to(target) / units_per_kPa(spec)
        low, high = grid.amin(0), grid.amax(0)

        def point(pressure: Tensor) -> Tensor:
            points = self.arm.settled(pressure)
            return self.marker(points, self.arm.pose.expand(len(points), 4, 4))

        def nearest(rows: Tensor, starts: Tensor) -> tuple[Tensor, Tensor]:
            """Best pressures (R, m) for R points from starts (R, S, m), and distances (R,) mm."""
            wanted = target[rows].repeat_interleave(starts.shape[1], 0)
            tried = starts.flatten(0, 1)
            found = least_squares(
                lambda pressure: point(pressure) - wanted,
                tried,
                low.expand(len(tried), -1),
                high.expand(len(tried), -1),
                iterations=20,
                hold_at_limits=True,
            )
            off, which = (point(found) - wanted).norm(dim=1).unflatten(0, (len(rows), -1)).min(1)
            return found.view_as(starts)[torch.arange(len(rows), device=rows.device), which], off

        with torch.inference_mode(False), torch.no_grad():
            places = torch.cdist(target, point(grid))
            near = places.topk(min(REACH_STARTS, len(grid)), dim=1, largest=False).indices
            everywhere = torch.arange(len(target), device=target.device)
            best, off = nearest(everywhere, grid[near[:, :1]])
            starts = grid[near]
            while len(rows := (off > REACHED_MM).nonzero()[:, 0]):
                found, missed = nearest(rows, starts[rows])
                gained = missed < off[rows] - REACH_GAIN_MM
                if not gained.any():
                    break
                best = best.index_copy(0, rows, found.where(gained[:, None], best[rows]))
                off = off.index_copy(0, rows, missed.where(gained, off[rows]))
                starts = torch.stack((best.roll(1, 0), best.roll(-1, 0)), 1)
            return off

    def error_mm(self, state: TaskState[FollowGoal]) -> Tensor:
        """(B,) mm: distance of the true point from its target."""
        return (self._marked(state) - self.target_mm(state)).norm(dim=1)

    def advance(
        self, state: TaskState[FollowGoal], actions: Mapping[str, Tensor]
    ) -> TaskState[FollowGoal]:
        """Advance the arm, and append the step to the history."""
        before = state.world.arms["arm"]
        world = self.world.step(state.world, actions)
        after = world.arms["arm"]
        moved = self.marker(after.seen_mm, after.known_mount)
        moved = moved - self.marker(before.seen_mm, before.known_mount)
        history = state.goal.history.after(after.seen_kPa - before.seen_kPa, moved)
        return TaskState(world, replace(state.goal, history=history))

    def blocks(self, state: TaskState[FollowGoal]) -> dict[str, ObservationBlocks]:
        """Observation blocks: body, errors now and ahead, history of steps and time.

        Errors are scaled by asinh: linear within the length named, logarithmic beyond. The first
        two and the predicted one are also scaled with `fine_mm`.
        """
        part, history = state.world.arms["arm"], state.goal.history
        point = self.marker(part.steered_mm, part.known_mount)
        preview = self.follow.preview
        targets = [self.target_mm(state, ahead) for ahead in range(max(preview, 1) + 1)]
        errors = [target - point for target in targets[: preview + 1]]
        close = errors[:2]
        if self.follow.one_step_prediction:
            close = [*close, targets[1] - self.marker(self._held(part), part.known_mount)]
        scaled = asinh_of([*errors, *(error / self.follow.fine_mm for error in close)])
        wide, fine = scaled[: len(errors)], scaled[len(errors) :]
        blocks = {
            SHAPE: free_points(part.steered_mm - self._rest).flatten(1) / 10.0,
            **numbered(ERROR, wide),
            **numbered(FINE, fine[: len(errors[:2])]),
        }
        if self.follow.one_step_prediction:
            blocks[PREDICTED] = fine[-1]
        blocks |= pressure_blocks(self.arm, part)
        blocks[PRESSURE_HISTORY] = history.kPa.flatten(1)
        blocks[POINT_HISTORY] = history.mm.flatten(1)
        blocks[TIME] = 2.0 * elapsed(state.world.steps, self.steps) - 1.0
        return {"arm": blocks}

    def observe(self, state: TaskState[FollowGoal]) -> dict[str, Tensor]:
        """Concatenated observation blocks, agent -> (B, D)."""
        return {agent: joined(blocks) for agent, blocks in self.blocks(state).items()}

    def _held(self, part: ArmPart) -> Tensor:
        """(B, n, 3) mm: key points that the model predicts for the next step, commands held."""
        pressure = self.arm.pneumatics.follow(part.pressure, part.command, self.dt_s)
        held = self.arm.predict(part, pressure, self.dt_s)
        if self.arm.vary.noise_mm == 0.0:
            return held
        # The model starts from the arm's true shape. Adding only the predicted movement to the
        # measured shape keeps the sensors' noise in the observation.
        return part.steered_mm + held - self.arm.predict(part, part.pressure, self.dt_s)

    def rewards(self, state: TaskState[FollowGoal]) -> dict[str, dict[str, Tensor]]:
        """Weighted reward terms, see `FollowWeights`."""
        error = self.error_mm(state)
        terms = {"track": (-error).exp(), "fine": (-error / self.follow.fine_mm).exp()}
        return {"arm": weighted(terms, self.follow.weights)}

    def ended(self, state: TaskState[FollowGoal]) -> Tensor:
        """Never: an episode lasts its full time."""
        return torch.zeros_like(state.world.failed)

    def measures(self, state: TaskState[FollowGoal]) -> dict[str, Tensor]:
        """The error on the path; none while the reference waits (`approach_s`)."""
        return {
            "error_mm": self.error_mm(state).masked_fill(
                state.world.steps <= self.approach, float("nan")
            )
        }

    def trace(self, state: TaskState[FollowGoal]) -> tuple[Tensor, Tensor]:
        """The target and the true point, each (B, 1, 3) mm."""
        return self.target_mm(state)[:, None], self._marked(state)[:, None]

    def script(self, state: TaskState[FollowGoal]) -> dict[str, Tensor]:
        """Scripted expert: inverse kinematics for the point on the next target."""

        def error(points: Tensor, wanted: Tensor) -> Tensor:
            target, mount = wanted[:, :3], wanted[:, 3:].unflatten(1, (4, 4))
            return (self.marker(points, mount) - target)[:, : self._directions]

        part = state.world.arms["arm"]
        wanted = torch.cat((self.target_mm(state, 1), part.mount.flatten(1)), 1)
        return {"arm": action_towards(self.arm, part, wanted, error, self.dt_s)}

    def _marked(self, state: TaskState[FollowGoal]) -> Tensor:
        """(B, 3) mm: the true point that follows."""
        part = state.world.arms["arm"]
        return self.marker(part.points_mm, part.mount)


def beyond_reach(task: Task) -> str:
    """How much of a task's path its arm cannot reach, in words; empty where it reaches all."""
    if not isinstance(task, Follow):
        return ""
    off = task.out_of_reach_mm()
    beyond = off > REACHED_MM
    if not beyond.any():
        return ""
    return (
        f"{100 * float(beyond.float().mean()):.0f} % of the path of {task.name} is out of the "
        f"arm's reach, by up to {float(off.max()):.2f} mm (mean over the path "
        f"{float(off.mean()):.2f} mm)"
    )
