"""What the tasks of a laser and an endoscope share: interlock, observations, rewards, measures.

The laser's beam follows a target on the organ, and is on only near it and while the endoscope sees
what it has to see. Functions here take the task and ask its world for the arms, so that a task on
rigs (`agents.on_rig`) has the same rules.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Protocol

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.tasks.base import Task, TaskState, check_weights, weighted
from surgisoft.tasks.inverse_kinematics import Pointing
from surgisoft.tasks.observations import TIME, Block, ObservationBlocks, body_blocks, numbered

LASER, ENDOSCOPE = "laser", "endoscope"
"""Names of the two arms, which are the agents."""
AGENTS = (LASER, ENDOSCOPE)

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


class LaserTask(Task, Protocol):
    """A task in a scene whose laser follows a target while the endoscope watches.

    Its config has `fire_mm`, `fine_mm`, `far_mm`, `approach_s` and `preview`.
    """

    config: Any
    """Its configuration."""
    spec: Any
    """The scene's file."""
    weights: Mapping[str, Any]
    """agent -> weights of its reward terms."""

    def target_mm(self, state: TaskState, ahead: int = 0) -> Tensor:
        """(B, 3) mm: where the beam has to go, `ahead` steps further on."""

    def watched_mm(self, state: TaskState) -> Tensor:
        """(B, 3) mm: where the camera's axis has to go."""

    def fires(self, state: TaskState) -> Tensor:
        """(B,) bool: the task would switch its beam on."""

    def advance(
        self, state: TaskState, actions: Mapping[str, Tensor], fired: Tensor | None = None
    ) -> TaskState:
        """Advance one step with the beam on where `fired` (B,) is set; None: where `fires`."""


def check_config(name: str, config: Any, fields: tuple[str, ...]) -> None:
    """Raise an InputError unless the fields are above 0 and the weights of both agents valid."""
    for each in fields:
        if not getattr(config, each) > 0:
            raise InputError(f"{name}: {each} is {getattr(config, each)}, expected > 0")
    for agent in AGENTS:
        check_weights(f"{name}: {agent}", getattr(config.weights, agent))


def pointing(task: Task) -> dict[str, Pointing]:
    """Inverse kinematics of each arm's axis, by the arm's name."""
    world = task.world
    return {name: Pointing(arm, world.config.dt_s) for name, arm in world.arms.items()}


def beam_error_mm(task: LaserTask, state: TaskState) -> Tensor:
    """(B,) mm: true perpendicular distance of the beam's axis from its target."""
    return _off_target_mm(task, state, state.world.arms[LASER].points_mm)


def measured_error_mm(task: LaserTask, state: TaskState) -> Tensor:
    """(B,) mm: distance of the beam's axis from its target as measured or estimated."""
    return _off_target_mm(task, state, state.world.arms[LASER].seen_mm)


def _off_target_mm(task: LaserTask, state: TaskState, points_mm: Tensor) -> Tensor:
    return pointing(task)[LASER].offset_mm(points_mm, task.target_mm(state)).norm(dim=1)


def beam_released(task: LaserTask, state: TaskState) -> Tensor:
    """(B,) bool: as far as is measured the beam is near its target and meets the organ, the
    endoscope's picture shows enough, and all arms keep the scene's clearance. The true pose of the
    arms does not enter into where the beam goes."""
    scene, limits = state.world.scene, task.spec.limits
    seen = scene.views[ENDOSCOPE].fraction >= limits.view_fraction
    near = measured_error_mm(task, state) <= task.config.fire_mm
    return seen & arms_clear(task, state) & near & on_organ(task, state)


def arms_clear(task: Any, state: TaskState) -> Tensor:
    """(B,) bool: all arms keep the scene's clearance and touch nothing; no beam is on otherwise."""
    scene = state.world.scene
    return (scene.clearance.least_mm >= task.spec.limits.clearance_mm) & ~scene.clearance.collides


def on_organ(task: LaserTask, state: TaskState) -> Tensor:
    """(B,) bool: the beam meets the organ, from the measured key points of all arms."""
    parts, scene = state.world.arms, state.world.scene
    if all(torch.equal(part.seen_mm, part.points_mm) for part in parts.values()):
        return scene.hits[LASER].on_organ  # what is measured is the truth: the ray was cast already
    seen = {name: task.world.arms[name].posed(part, part.seen_mm) for name, part in parts.items()}
    return task.world.scene.aimed(seen, LASER, scene.breaths).on_organ


def blocks(
    task: LaserTask, state: TaskState, of_laser: ObservationBlocks, of_both: ObservationBlocks
) -> dict[str, ObservationBlocks]:
    """Observation blocks: body and pointing error of each arm, what the task adds, and the beam.

    of_laser, of_both: blocks of the task, for the laser after its errors and for both agents.
    """
    arms, scene, point = state.world.arms, state.world.scene, pointing(task)
    laser, eye = arms[LASER], arms[ENDOSCOPE]
    ahead = [task.target_mm(state, k) for k in range(task.config.preview + 1)]
    offsets = [point[LASER].offset_mm(laser.seen_mm, target) for target in ahead]
    look = point[ENDOSCOPE].offset_mm(eye.seen_mm, task.watched_mm(state))
    of_arm = {
        LASER: {**numbered(BEAM_ERROR, [offset.asinh() for offset in offsets]), **of_laser},
        ENDOSCOPE: {VIEW_ERROR: look.asinh()},
    }
    shared = {
        **of_both,
        VIEW: scene.views[ENDOSCOPE].fraction[:, None],
        FIRED: state.goal.fired[:, None].float(),
        TIME: state.world.steps[:, None] / task.steps,
        APART: (laser.seen_mm[:, -1] - eye.seen_mm[:, -1]) / 50.0,
    }
    return {
        name: {**body_blocks(task.world.arms[name], arms[name]), **of_arm[name], **shared}
        for name in AGENTS
    }


def rewards(
    task: LaserTask,
    state: TaskState,
    of_laser: Mapping[str, Tensor] | None = None,
    of_both: Mapping[str, Tensor] | None = None,
    of_agent: Mapping[str, Mapping[str, Tensor]] | None = None,
) -> dict[str, dict[str, Tensor]]:
    """Weighted reward terms, see `LaserWeights` and `EndoscopeWeights`, and those of the task.

    of_laser, of_both: terms of the task for the laser and for both agents. of_agent: agent -> terms
    of the task in which the agents differ.
    """
    error, scene, config = beam_error_mm(task, state), state.world.scene, task.config
    view = scene.views[ENDOSCOPE]
    shared = {
        "cut": state.goal.fired.float(),
        "contact": (scene.clearance.least_mm < task.spec.limits.clearance_mm).float(),
        **(of_both or {}),
    }
    laser = {
        "far": 1.0 / (1.0 + error / config.far_mm),
        "aim": (-error).exp(),
        "fine": (-error / config.fine_mm).exp(),
        **(of_laser or {}),
    }
    endoscope = {
        "look": 1.0 / (1.0 + view.axis_error_mm / config.far_mm),
        "view": view.fraction,
    }
    own = of_agent or {}
    found = {
        LASER: {**laser, **shared, **own.get(LASER, {})},
        ENDOSCOPE: {**endoscope, **shared, **own.get(ENDOSCOPE, {})},
    }
    return {
        agent: weighted({f.name: terms[f.name] for f in fields(task.weights[agent])}, weights)
        for agent, terms in found.items()
        for weights in (task.weights[agent],)
    }


def errors(task: LaserTask, state: TaskState) -> dict[str, Tensor]:
    """Measures of the beam's error.

    beam_error_mm: true error while the beam is on. pointing_error_mm: true error at every step
    after `approach_s`, with the beam on or off, so that no gate truncates it.
    """
    error = beam_error_mm(task, state)
    late = state.world.steps * task.world.config.dt_s > task.config.approach_s
    return {
        "beam_error_mm": error.where(state.goal.fired, float("nan")),
        "pointing_error_mm": error.where(late, float("nan")),
    }


def safety(state: TaskState, done: Tensor) -> dict[str, Tensor]:
    """Measures of view, clearance and contact, and of success: `done` (B,) bool, no contact."""
    scene = state.world.scene
    hit = scene.clearance.collides
    return {
        "view_fraction": scene.views[ENDOSCOPE].fraction,
        "clearance_mm": scene.clearance.least_mm,
        "collided": hit.float(),
        "success": (done & ~hit).float(),
    }


def script(
    task: LaserTask, state: TaskState, target_mm: Tensor, watched_mm: Tensor
) -> dict[str, Tensor]:
    """Inverse kinematics that points the beam and the camera at targets (B, 3) mm."""
    point = pointing(task)
    return {
        LASER: point[LASER].action(state.world.arms[LASER], target_mm),
        ENDOSCOPE: point[ENDOSCOPE].action(state.world.arms[ENDOSCOPE], watched_mm),
    }
