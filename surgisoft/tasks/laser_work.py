"""The base of tasks in which lasers work on an organ while an endoscope watches.

`LaserTask` has what all of them share: scene, interlock, observations, measures and signals.
`OneLaserTask` adds what follows from one laser that follows one target: rewards, steps and the
scripted expert. `RingTask` cuts a ring around the lesion, `RouteTask` follows points on the organ.
A task's own file has its config, its reference and what a success is.

Tasks ask their world for the arms, so that a task on rigs (`agents.on_rig`) has the same rules.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar, Generic, Protocol, Self, TypeVar

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.tasks.base import (
    Signal,
    TaskState,
    check_weights,
    clearance,
    term_names,
    weighted,
)
from surgisoft.tasks.inverse_kinematics import Pointing
from surgisoft.tasks.observations import (
    TIME,
    Block,
    ObservationBlocks,
    body_blocks,
    elapsed,
    joined,
    numbered,
)
from surgisoft.tasks.trajectories.closed_path import RingCut, point_on_closed
from surgisoft.tasks.trajectories.routes import RouteProgress
from surgisoft.tasks.world.arm import ArmPart, as_known, measured_exactly
from surgisoft.tasks.world.pytree import TensorDataclass
from surgisoft.tasks.world.random_streams import Stream, streams
from surgisoft.tasks.world.scene import (
    PHANTOM,
    AblationState,
    RingReport,
    SceneEngine,
    SceneState,
    View,
)
from surgisoft.tasks.world.world import WorldConfig, scene_world

LASER, ENDOSCOPE = "laser", "endoscope"
"""Names of the two arms, which are the agents."""
AGENTS = (LASER, ENDOSCOPE)

LASER_PRESET: Mapping[str, Any] = {
    "rollout": 16,
    "last_noise": 0.05,
    "evaluate_every": 50,
    "evaluation_episodes": 16,
}
"""Fields in which the `fast` training preset of these tasks differs from the default."""
LASER_STEPS = 1_500_000
"""Environment steps of a training run with the `fast` preset."""

BEAM_ERROR = Block(
    "beam_error",
    "perpendicular offset of the target from the measured beam",
    "mm",
    "asinh(x / 1 mm)",
)
VIEW_ERROR = Block(
    "view_error",
    "perpendicular offset of what is to be seen from the measured axis of the camera",
    "mm",
    "asinh(x / 1 mm)",
)
VIEW = Block("view", "share of what is to be seen that the endoscope sees", "-", "x", 0.0, 1.0)
FIRED = Block("fired", "1 if the beam was on in the last step, else 0", "-", "x", 0.0, 1.0)
APART = Block("apart", "measured tip of the laser arm minus that of the endoscope", "mm", "x / 50")
RING_PLACE = Block(
    "ring_place", "angle of the target along the ring", "rad", "sin(x), cos(x)", -1.0, 1.0
)
RING_DIRECTION = Block(
    "ring_direction", "direction of travel along the ring, +1 or -1", "-", "x", -1.0, 1.0
)
DONE = Block("done", "share of the route that is followed", "-", "x", 0.0, 1.0)


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
    """Weights of the endoscope's reward terms; e is the distance of the camera's axis from the
    middle of what it has to see, mm."""

    look: float = 1.0
    """1 / (1 + e / far_mm)."""
    view: float = 1.0
    """Share of what is to be seen that the endoscope sees."""
    cut: float = 1.0
    """1 while the beam is on, else 0."""
    contact: float = -1.0
    """1 while the clearance of any arm is below the scene's limit, else 0."""


@dataclass(frozen=True)
class LaserWorkWeights:
    """Weights of the reward terms of both agents."""

    laser: LaserWeights = field(default_factory=LaserWeights)
    """Weights of the laser's reward terms."""
    endoscope: EndoscopeWeights = field(default_factory=EndoscopeWeights)
    """Weights of the endoscope's reward terms."""


@dataclass(frozen=True)
class LaserConfig:
    """Fields that the configurations of these tasks share; each adds its own and `weights`."""

    scene: str | Path = PHANTOM
    """Folder of the scene."""
    arm: str | Path | None = None
    """Arm model of all arms: `default`, or a folder; None: the models that the scene names."""
    fire_mm: float = 0.5
    """Measured distance of a beam from its target within which the beam is switched on, mm."""
    approach_s: float = 5.0
    """Time at the beginning that the measure `pointing_error_mm` leaves out, s."""
    fine_mm: float = 0.1
    """Scale of the reward term `fine`, mm."""
    far_mm: float = 10.0
    """Scale of the reward terms `far` and `look`, mm."""
    preview: int = 2
    """Future targets in a laser's observation, one per step (a count)."""
    world: WorldConfig = field(default_factory=WorldConfig)
    """The simulator and its domain randomization."""

    POSITIVE: ClassVar[tuple[str, ...]] = ("fire_mm", "approach_s", "fine_mm", "far_mm", "preview")
    """Fields that have to be above 0."""


def check_config(name: str, config: Any, *positive: str) -> None:
    """Raise an InputError unless the shared and the named fields of a `LaserConfig` are above 0,
    and the weights of every agent valid."""
    for each in (*positive, *config.POSITIVE):
        if not getattr(config, each) > 0:
            raise InputError(f"{name}: {each} is {getattr(config, each)}, expected > 0")
    for agent, weights in vars(config.weights).items():
        check_weights(f"{name}: {agent}", weights)


class BeamProgress(TensorDataclass, Protocol):
    """Interface of the goal of such a task."""

    @property
    def fired(self) -> Tensor:
        """(B,) bool, with L lasers (B, L): the beam was on in the last step."""

    def after(self, fired: Tensor) -> Self:
        """The goal a step later, in which the beam was on where `fired` is set."""


Progress = TypeVar("Progress", bound=BeamProgress)
"""Type of the goal: the reference of each episode and how far it is followed."""
Cut = TypeVar("Cut", bound=RingCut)
"""Type of the goal of a cut around a ring."""

VIEW_FRACTION = Signal(
    "view_fraction",
    VIEW.meaning,
    "-",
    0.0,
    1.0,
    lambda task, before, after: view(after).fraction,
)
BEAM_ON = Signal(
    "beam_on",
    "1 if the beam was on since the last decision, else 0",
    "-",
    0.0,
    1.0,
    lambda task, before, after: after.goal.fired.float(),
)
RELEASED = Signal(
    "released",
    "1 if the beam was allowed since the last decision, else 0; it was on then, but for the way "
    "from the end of one path to the next",
    "-",
    0.0,
    1.0,
    lambda task, before, after: (after.goal.done - (before or after).goal.done).float(),
)


def view(state: TaskState) -> View:
    """View of the endoscope."""
    return state.world.scene.view


def dose(state: TaskState) -> AblationState:
    """The dose map of the tissue."""
    found = state.world.scene.dose
    assert found is not None, "a task with a laser has tissue"
    return found


def lesion(state: TaskState) -> Tensor:
    """(B,) int64: number of the episode's lesion."""
    found = state.world.scene.lesion
    assert found is not None, "a task with a laser has a lesion"
    return found


class LaserTask(ABC, Generic[Progress]):
    """Arms of a scene: lasers that burn, and the `endoscope`; see `base.Task`."""

    name: str
    """Name in the registry."""
    agents: tuple[str, ...]
    """Names of the agents."""
    signals: tuple[Signal, ...]
    """What an exported controller has to be given beside pressures and key points."""

    def __init__(
        self,
        config: Any,
        device: str | torch.device = "cpu",
        time_s: float | None = None,
        **around: Any,
    ):
        """config: a `LaserConfig`. time_s: duration of an episode, s; None: that of the scene's
        file. around: arguments of `scene_world`, such as what is treated."""
        c = self.config = config
        self.world = scene_world(
            c.scene, c.world, device, arm=c.arm, agents=self.agents, time_s=time_s or 0.0, **around
        )
        scene = self.world.scene
        assert isinstance(scene, SceneEngine)
        self.scene, self.spec, self.dt_s = scene, scene.spec, self.world.config.dt_s
        self.steps = round((self.spec.limits.time_s if time_s is None else time_s) / self.dt_s)
        self.weights = {agent: getattr(c.weights, agent) for agent in self.agents}

    @property
    def pointing(self) -> dict[str, Pointing]:
        """Inverse kinematics of each arm's axis, by the arm's name."""
        world = self.world
        return {name: Pointing(arm, world.config.dt_s) for name, arm in world.arms.items()}

    @abstractmethod
    def goal(self, stream: Stream) -> tuple[Stream, Progress]:
        """Draw the reference of an episode for each random number stream."""

    @abstractmethod
    def fires(self, state: TaskState[Progress]) -> Tensor:
        """(B,) bool: whether a beam would be on."""

    @abstractmethod
    def advance(
        self,
        state: TaskState[Progress],
        actions: Mapping[str, Tensor],
        fired: Tensor | None = None,
    ) -> TaskState[Progress]:
        """Advance arms and tissue by a step; where `fired` (B,) bool is set a beam may burn, and
        the reference moves on where it does. None: where `fires` holds.
        """

    @abstractmethod
    def advance_measured(
        self, state: TaskState[Progress], signals: Mapping[str, Tensor]
    ) -> TaskState[Progress]:
        """Advance by a step in which the beams were on as measured; see `MeasuredTask`."""

    @abstractmethod
    def blocks(self, state: TaskState[Progress]) -> dict[str, ObservationBlocks]:
        """Observation blocks of each agent."""

    def observe(self, state: TaskState[Progress]) -> dict[str, Tensor]:
        """Concatenated observation blocks, agent -> (B, D)."""
        return {agent: joined(blocks) for agent, blocks in self.blocks(state).items()}

    @abstractmethod
    def rewards(self, state: TaskState[Progress]) -> dict[str, dict[str, Tensor]]:
        """Weighted reward terms of each agent."""

    @abstractmethod
    def trace(self, state: TaskState[Progress]) -> tuple[Tensor, Tensor]:
        """Reference points and ends of the beams, each (B, L, 3) mm."""

    @abstractmethod
    def script(self, state: TaskState[Progress]) -> dict[str, Tensor]:
        """Scripted expert, agent -> (B, m) kPa."""

    @abstractmethod
    def measured_error_mm(self, state: TaskState[Progress]) -> Tensor:
        """(B,) mm: distance of the beam's axis from its target as measured or estimated, the
        largest one of several lasers."""

    @abstractmethod
    def measures(self, state: TaskState[Progress]) -> dict[str, Tensor]:
        """Quantities for people, `completion` and `success` among them."""

    def centre_mm(self, state: TaskState[Progress]) -> Tensor:
        """(B, 3) mm: the lesion's centre, where nothing moves it."""
        return self.scene.centres_mm[lesion(state)]

    def report(self, state: TaskState[Progress]) -> RingReport:
        """How much of the path is cut, and what was burnt beside it."""
        return self.scene.ablation.report(dose(state))

    def finished(self, state: TaskState[Progress]) -> Tensor:
        """(B,) bool: the work is done; the path is cut along its whole length."""
        return self.report(state).completion >= 1.0

    def ended(self, state: TaskState[Progress]) -> Tensor:
        """When the whole path is cut, or an arm touches a body, another arm or itself."""
        return self.finished(state) | clearance(state).collides

    def arms_clear(self, state: TaskState[Progress]) -> Tensor:
        """(B,) bool: all arms keep the scene's clearance and touch nothing; no beam is on else."""
        found = clearance(state)
        return (found.least_mm >= self.spec.limits.clearance_mm) & ~found.collides

    def measured_arms(self, state: TaskState[Progress]) -> Mapping[str, ArmPart]:
        """The arms with their bodies where they are measured; the state's own where exact."""
        arms = state.world.arms
        if state.world.scene.measured:  # an exported controller poses them so
            return arms
        if all(measured_exactly(self.world.arms[name], part) for name, part in arms.items()):
            return arms
        return {
            name: self.world.arms[name].posed(as_known(part), part.seen_mm)
            for name, part in arms.items()
        }

    def on_organ(self, state: TaskState[Progress], lasers: tuple[str, ...]) -> list[Tensor]:
        """(B,) bool for each laser: its beam meets the organ, from the measured key points."""
        arms, scene = self.measured_arms(state), state.world.scene
        if arms is state.world.arms:  # the rays were cast already
            return [scene.hits[name].on_organ for name in lasers]
        return [self.scene.aimed(arms, name, scene.breaths).on_organ for name in lasers]

    def reading(self, signal: Signal, state: TaskState[Progress]) -> Tensor:
        """(B,): a signal as it was measured, or as it is in the simulated state."""
        measured = state.world.scene.measured
        return measured[signal.name] if measured else signal.true(self, None, state)

    def measured_scene(self, signals: Mapping[str, Tensor], lesion: Tensor) -> SceneState:
        """The scene of which the signals are known; see `MeasuredTask.measured_scene`."""
        return SceneState(measured=dict(signals), lesion=lesion)

    def held(self) -> dict[str, Tensor]:
        """Actions of one episode that change nothing."""
        return {name: arm.low.new_zeros(1, arm.chambers) for name, arm in self.world.arms.items()}

    def ring_measures(self, state: TaskState[Progress]) -> dict[str, Tensor]:
        """Measures of a cut around a ring: share cut, largest gap, healthy tissue burnt.

        healthy_mm2 counts tissue up to `dose_patch.MARGIN_MM` from the ring, and none farther out.
        """
        ring = self.report(state)
        return {
            "completion": ring.completion,
            "largest_gap_mm": ring.largest_gap_mm,
            "healthy_mm2": ring.healthy_mm2,
        }


class OneLaserTask(LaserTask[Progress]):
    """Two arms of a scene: agents `laser`, which follows one target, and `endoscope`.

    `target_mm` and `watched_mm` are all that this class asks of a task.
    """

    agents = AGENTS
    signals: tuple[Signal, ...] = (VIEW_FRACTION, BEAM_ON)

    @abstractmethod
    def target_mm(self, state: TaskState[Progress], ahead: int = 0) -> Tensor:
        """(B, 3) mm: where the beam has to go, `ahead` steps further on."""

    @abstractmethod
    def watched_mm(self, state: TaskState[Progress]) -> Tensor:
        """(B, 3) mm: where the camera's axis has to go."""

    def beam_error_mm(self, state: TaskState[Progress]) -> Tensor:
        """(B,) mm: true perpendicular distance of the beam's axis from its target."""
        part = state.world.arms[LASER]
        return self._off_target_mm(state, part.points_mm, part.mount)

    def measured_error_mm(self, state: TaskState[Progress]) -> Tensor:
        """(B,) mm: distance of the beam's axis from its target as measured or estimated."""
        part = state.world.arms[LASER]
        return self._off_target_mm(state, part.seen_mm, part.known_mount)

    def _off_target_mm(
        self, state: TaskState[Progress], points_mm: Tensor, mount: Tensor | None
    ) -> Tensor:
        point = self.pointing[LASER]
        return point.offset_mm(points_mm, self.target_mm(state), mount).norm(dim=1)

    def released(self, state: TaskState[Progress]) -> Tensor:
        """(B,) bool: as far as is measured the beam is near its target and meets the organ, the
        endoscope's picture shows enough, and all arms keep the scene's clearance. The true pose of
        the arms does not enter into where the beam goes."""
        seen = view(state).fraction >= self.spec.limits.view_fraction
        near = self.measured_error_mm(state) <= self.config.fire_mm
        (hit,) = self.on_organ(state, (LASER,))
        return seen & self.arms_clear(state) & near & hit

    def fires(self, state: TaskState[Progress]) -> Tensor:
        """(B,) bool: whether the beam would be on: where it is `released`."""
        return self.released(state)

    def advance(
        self,
        state: TaskState[Progress],
        actions: Mapping[str, Tensor],
        fired: Tensor | None = None,
    ) -> TaskState[Progress]:
        """Advance arms and tissue; where `fired` (B,) bool is set the beam burns for the step and
        the reference moves on. None: where `fires` holds.
        """
        fired = self.fires(state) if fired is None else fired
        power_w = {LASER: fired * self.spec.laser.power_w}
        world = self.world.step(state.world, actions, power_w)
        return TaskState(world, state.goal.after(fired))

    def advance_measured(
        self, state: TaskState[Progress], signals: Mapping[str, Tensor]
    ) -> TaskState[Progress]:
        """Advance where the beam was on or off as measured; see `MeasuredTask`."""
        return self.advance(state, self.held(), signals[BEAM_ON.name] > 0.5)

    def laser_blocks(self, state: TaskState[Progress]) -> ObservationBlocks:
        """Observation blocks of the task for the laser alone, after its errors."""
        return {}

    def shared_blocks(self, state: TaskState[Progress]) -> ObservationBlocks:
        """Observation blocks of the task for both agents."""
        return {}

    def blocks(self, state: TaskState[Progress]) -> dict[str, ObservationBlocks]:
        """Observation blocks: body and pointing error of each arm, what the task adds, the beam."""
        arms, point = state.world.arms, self.pointing
        laser, eye = arms[LASER], arms[ENDOSCOPE]
        ahead = [self.target_mm(state, k) for k in range(self.config.preview + 1)]
        offsets = [
            point[LASER].offset_mm(laser.steered_mm, target, laser.known_mount) for target in ahead
        ]
        look = point[ENDOSCOPE].offset_mm(eye.steered_mm, self.watched_mm(state), eye.known_mount)
        own: dict[str, ObservationBlocks] = {
            LASER: {
                **numbered(BEAM_ERROR, [offset.asinh() for offset in offsets]),
                **self.laser_blocks(state),
            },
            ENDOSCOPE: {VIEW_ERROR: look.asinh()},
        }
        shared = {
            **self.shared_blocks(state),
            VIEW: self.reading(VIEW_FRACTION, state)[:, None],
            FIRED: state.goal.fired[:, None].float(),
            TIME: elapsed(state.world.steps, self.steps),
            APART: (laser.seen_mm[:, -1] - eye.seen_mm[:, -1]) / 50.0,
        }
        return {
            name: {**body_blocks(self.world.arms[name], arms[name]), **own[name], **shared}
            for name in AGENTS
        }

    def own_terms(self, state: TaskState[Progress]) -> Mapping[str, Mapping[str, Tensor]]:
        """Reward terms of the task beside those of `LaserWeights` and `EndoscopeWeights`: agent ->
        term -> (B,)."""
        return {}

    def rewards(self, state: TaskState[Progress]) -> dict[str, dict[str, Tensor]]:
        """Weighted reward terms, see `LaserWeights`, `EndoscopeWeights` and `own_terms`."""
        error, config, seen = self.beam_error_mm(state), self.config, view(state)
        limit_mm = self.spec.limits.clearance_mm
        shared = {
            "cut": state.goal.fired.float(),
            "contact": (clearance(state).least_mm < limit_mm).float(),
        }
        terms = {
            LASER: {
                "far": 1.0 / (1.0 + error / config.far_mm),
                "aim": (-error).exp(),
                "fine": (-error / config.fine_mm).exp(),
            },
            ENDOSCOPE: {
                "look": 1.0 / (1.0 + seen.axis_error_mm / config.far_mm),
                "view": seen.fraction,
            },
        }
        own, found = self.own_terms(state), {}
        for agent, weights in self.weights.items():
            every = {**terms[agent], **shared, **own.get(agent, {})}
            found[agent] = weighted({name: every[name] for name in term_names(weights)}, weights)
        return found

    def errors(self, state: TaskState[Progress]) -> dict[str, Tensor]:
        """Measures of the beam's error.

        beam_error_mm: true error while the beam is on. pointing_error_mm: true error at every step
        after `approach_s`, with the beam on or off, so that no gate truncates it.
        """
        error = self.beam_error_mm(state)
        late = state.world.steps * self.dt_s > self.config.approach_s
        return {
            "beam_error_mm": error.where(state.goal.fired, float("nan")),
            "pointing_error_mm": error.where(late, float("nan")),
        }

    def safety(self, state: TaskState[Progress], done: Tensor) -> dict[str, Tensor]:
        """Measures of view, clearance and contact, and of success: `done` (B,) bool, no contact."""
        found = clearance(state)
        hit = found.collides
        return {
            "view_fraction": view(state).fraction,
            "clearance_mm": found.least_mm,
            "collided": hit.float(),
            "success": (done & ~hit).float(),
        }

    def trace(self, state: TaskState[Progress]) -> tuple[Tensor, Tensor]:
        """Reference point and end of the beam, each (B, 1, 3) mm."""
        return self.target_mm(state)[:, None], state.world.scene.hits[LASER].point_mm[:, None]

    def script(self, state: TaskState[Progress]) -> dict[str, Tensor]:
        """Scripted expert: points the laser at its next target, the endoscope at what it has to
        see."""
        return self.pointed(state, self.target_mm(state, 1), self.watched_mm(state))

    def pointed(
        self, state: TaskState[Progress], target_mm: Tensor, watched_mm: Tensor
    ) -> dict[str, Tensor]:
        """Actions that point the beam and the camera at targets (B, 3) mm."""
        point, arms = self.pointing, state.world.arms
        return {
            LASER: point[LASER].action(arms[LASER], target_mm),
            ENDOSCOPE: point[ENDOSCOPE].action(arms[ENDOSCOPE], watched_mm),
        }


class RingTask(OneLaserTask[Cut]):
    """The laser cuts a ring around the lesion once, in either direction; the endoscope looks at it.

    The config has `cut_s`, the time for once around with the beam on, s.
    """

    dose_fields = "cut_s"
    """Fields of the config that decide about the dose on the path."""

    def __init__(self, config: Any, device: str | torch.device = "cpu", **others: Any):
        """The arguments are those of `LaserTask`."""
        super().__init__(config, device, **others)
        self.round = round(config.cut_s / self.dt_s)
        if self.round < 1:
            raise InputError(
                f"{self.name}: cut_s is {config.cut_s:g} s, expected at least a step, "
                f"{self.dt_s:g} s"
            )

    @property
    def pass_steps(self) -> int:
        """Steps of once around with the beam on (a count)."""
        return self.round

    def reference(self, steps: int) -> tuple[Tensor, Tensor, Tensor]:
        """The reference of the first lesion with the beam on for `steps` steps, its organ at rest:
        points (steps + 1, 3) mm, unit normals of the surface, whether the beam is on (bool)."""
        share = torch.arange(steps + 1, device=self.scene.device) / self.round
        points = point_on_closed(self.scene.paths_mm[:1], torch.zeros_like(share).long(), share)
        count = self.scene.paths_mm.shape[1]
        near = (share * count).round().long().remainder(count)
        return points, self.scene.path_normals[0, near], torch.ones_like(near, dtype=torch.bool)

    def target_mm(self, state: TaskState[Cut], ahead: int = 0) -> Tensor:
        """(B, 3) mm: the reference point on the ring `ahead` steps further on."""
        share = state.goal.share(self.round, ahead)
        return point_on_closed(self.scene.paths_mm, lesion(state), share)

    def watched_mm(self, state: TaskState[Cut]) -> Tensor:
        """(B, 3) mm: the lesion's centre."""
        return self.centre_mm(state)

    def laser_blocks(self, state: TaskState[Cut]) -> ObservationBlocks:
        """Place on the ring and direction of travel."""
        angle = 2.0 * math.pi * state.goal.share(self.round)[:, None]
        return {
            RING_PLACE: torch.cat((angle.sin(), angle.cos()), 1),
            RING_DIRECTION: state.goal.direction[:, None],
        }

    def measures(self, state: TaskState[Cut]) -> dict[str, Tensor]:
        """Beam error, progress of the cut, healthy tissue burnt, view, clearance, success."""
        ring = self.ring_measures(state)
        return {
            **self.errors(state),
            **ring,
            **self.safety(state, ring["completion"] >= 1.0),
        }


class RouteTask(OneLaserTask[RouteProgress]):
    """The laser follows the points of paths on the organ, one path after another.

    The config has `speed_mm_s`, the speed of the reference along a path with the beam on, mm/s.
    """

    signals: tuple[Signal, ...] = (VIEW_FRACTION, RELEASED)
    dose_fields = "speed_mm_s"
    """Fields of the config that decide about the dose on the paths."""
    leap_steps: float
    """Two targets farther apart than this many steps of the reference lie on different paths."""

    @property
    def pass_steps(self) -> int:
        """Steps of a route over all paths (a count)."""
        return self.goal(streams(0, 1, device=self.scene.device))[1].steps

    def reference(self, steps: int) -> tuple[Tensor, Tensor, Tensor]:
        """A reference with the beam on for `steps` steps, again from its start after its end:
        points (steps + 1, 3) mm, unit normals of the surface, whether the beam is on in the step
        that leads there (bool)."""
        _, goal = self.goal(streams(0, 1, device=self.scene.device))
        place = torch.arange(steps + 1, device=self.scene.device).remainder(goal.steps)
        points = self.scene.path_mm[goal.route[0, place]]
        normals = self.scene.path_normals[0, goal.route[0, place]]
        step = (points - points.roll(1, 0)).norm(dim=1)
        return points, normals, step <= self.leap_steps * self.config.speed_mm_s * self.dt_s

    def target_mm(self, state: TaskState[RouteProgress], ahead: int = 0) -> Tensor:
        """(B, 3) mm: the reference point on the paths `ahead` steps further on."""
        return self.scene.path_mm[state.goal.point(ahead)]

    def watched_mm(self, state: TaskState[RouteProgress]) -> Tensor:
        """(B, 3) mm: middle of what has to be seen."""
        return self.scene.looks_mm[state.goal.point()].mean(1)

    def leaps(self, state: TaskState[RouteProgress]) -> Tensor:
        """(B,) bool: the reference is at the end of a path, and goes on to the next one."""
        ahead = self.target_mm(state, 1) - self.target_mm(state)
        return ahead.norm(dim=1) > self.leap_steps * self.config.speed_mm_s * self.dt_s

    def fires(self, state: TaskState[RouteProgress]) -> Tensor:
        """(B,) bool: whether the beam would be on: where it is `released`, and never on the way
        from one path to the next."""
        return self.released(state) & ~self.leaps(state)

    def advance(
        self,
        state: TaskState[RouteProgress],
        actions: Mapping[str, Tensor],
        fired: Tensor | None = None,
    ) -> TaskState[RouteProgress]:
        """Advance arms and tissue; where `fired` (B,) bool is set the beam burns for the step and
        the reference moves on. None: where `fires` holds. At the end of a path the reference moves
        on without the beam.
        """
        released, leap = self.released(state), self.leaps(state)
        fired = (released if fired is None else fired) & ~leap
        return self._advanced(state, actions, fired, fired | (released & leap))

    def advance_measured(
        self, state: TaskState[RouteProgress], signals: Mapping[str, Tensor]
    ) -> TaskState[RouteProgress]:
        """Advance where the beam was allowed as measured; see `MeasuredTask`."""
        released = signals[RELEASED.name] > 0.5
        return self._advanced(state, self.held(), released & ~self.leaps(state), released)

    def _advanced(
        self,
        state: TaskState[RouteProgress],
        actions: Mapping[str, Tensor],
        fired: Tensor,
        moved: Tensor,
    ) -> TaskState[RouteProgress]:
        goal = state.goal.after(fired, moved)
        near = replace(state.world.scene, watched=goal.point())
        power_w = {LASER: fired * self.spec.laser.power_w}
        return TaskState(self.world.step(replace(state.world, scene=near), actions, power_w), goal)

    def shared_blocks(self, state: TaskState[RouteProgress]) -> ObservationBlocks:
        """Share of the route that is followed."""
        return {DONE: state.goal.share[:, None]}

    def require_time(self, least: int, what: str) -> None:
        """Raise an InputError where `least` steps are more than an episode has; what: which."""
        c = self.config
        if least > self.steps:
            raise InputError(
                f"{self.name}: {what} {least * self.dt_s:.0f} s at {c.speed_mm_s:g} mm/s, and "
                f"time_s is {c.time_s:g} s; raise time_s or speed_mm_s"
            )
