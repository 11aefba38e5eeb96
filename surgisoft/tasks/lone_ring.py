"""One episode of `circle_ablation`, advanced by compiled loops in preallocated arrays.

`CircleAblation` in a batch of one makes some hundred tensor operations a step, each of which costs
more than its arithmetic. `LoneRing` gives the same numbers, to rounding, for the one environment of
a PettingZoo adapter; `tests/tasks/test_lone_ring.py` compares both over whole episodes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields, replace

import numpy as np
import torch

from surgisoft.compiled import compiled
from surgisoft.tasks.base import TaskState, term_names
from surgisoft.tasks.laser_work import ENDOSCOPE, LASER, RingTask
from surgisoft.tasks.observations import OBSERVATION_LIMIT
from surgisoft.tasks.trajectories.closed_path import RingCut
from surgisoft.tasks.world.world import LoneWorld

SHAPE_MM, APART_MM = 50.0, 50.0
"""Scales of the blocks `shape` and `apart`, see `observations.SHAPE` and `laser_work.APART`."""
LEAST_BAND_KPA, LARGEST_REVERSAL = 1e-3, 1.5
"""Bounds of the block `reversal`, see `observations.pressure_blocks`."""
TERMS = ("far", "aim", "fine", "cut", "contact", "look", "view")
"""Reward terms in the order in which `_terms` writes them, of both agents."""


class LoneRing:
    """One episode of `circle_ablation`: what the adapter of a single environment asks for."""

    def __init__(self, task: RingTask[RingCut], state: TaskState, world: LoneWorld):
        self.task, self.world, self._goal = task, world, state.goal
        config, spec = task.config, task.spec
        lesion = state.world.scene.lesion
        assert lesion is not None, "a scene has a lesion"
        paths, centres = task.scene.paths_mm, task.scene.centres_mm
        self._targets = np.empty((config.preview + 1, 3), np.float32)
        self._cut = np.zeros(1, np.int64)
        self._reference = (
            paths[lesion[0]].contiguous().numpy(),
            np.float32(state.goal.start[0].item()),
            np.float32(state.goal.direction[0].item()),
            np.float32(task.round),
            self._targets,
        )
        self._seen: dict[str, np.ndarray] = {}
        self._bodies, self._blocks = {}, {}
        for name, arm in world.arms.items():
            given, keys = task.world.arms[name], arm.points_mm.shape[1]
            low, high = given.low.numpy(), given.high.numpy()
            band = given.model.band.clamp(min=LEAST_BAND_KPA).numpy()
            base = given.pose[:3, 3].contiguous().numpy()
            self._bodies[name] = (
                arm.points_mm,
                base,
                arm.command,
                arm.pressure,
                low,
                high,
                arm.beside,
                band,
            )
            width = 3 * max(keys - 1, 1) + 4 * arm.command.shape[1]
            more = 3 * len(self._targets) + 3 if name == LASER else 3
            self._seen[name] = np.empty(width + more + 6, np.float32)
            self._blocks[name] = width
        laser, eye = world.arms[LASER], world.arms[ENDOSCOPE]
        centre = centres[lesion[0]].contiguous().numpy()
        self._errors = np.empty(2, np.float32)
        self._offsets = (
            *(laser.points_mm, laser.tip_direction, eye.points_mm, eye.tip_direction),
            *(self._targets, centre, self._errors),
        )
        self._terms = np.empty(len(TERMS), np.float32)
        self._weights = {
            agent: [
                (each.name, TERMS.index(each.name), np.float32(getattr(weights, each.name)))
                for each in fields(weights)
                if getattr(weights, each.name) != 0.0
            ]
            for agent, weights in task.weights.items()
        }
        self._scales = (np.float32(config.far_mm), np.float32(config.fine_mm))
        self._limits, self._power_w = spec.limits, spec.laser.power_w
        self.fired = bool(state.goal.fired[0])
        """The beam was on in the last step."""
        self._done = int(state.goal.done[0])
        self._find()

    @classmethod
    def of(cls, task: RingTask[RingCut], state: TaskState) -> LoneRing | None:
        """The episode of a state of one environment; None where only the task can advance it.

        `task` is a `CircleAblation` and of no class that extends it.
        """
        if any(not set(term_names(weights)) <= set(TERMS) for weights in task.weights.values()):
            return None
        world = LoneWorld.of(task.world, state.world)
        return None if world is None else cls(task, state, world)

    def step(self, actions: Mapping[str, np.ndarray]) -> None:
        """Advance one step; actions: agent -> (m,) kPa."""
        fired = self._fires()
        self.world.step(actions, self._power_w if fired else 0.0)
        self.fired, self._done = fired, self._done + fired
        self._find()

    def _fires(self) -> bool:
        """See `OneLaserTask.released`; what is measured is the truth here."""
        limits = self._limits
        clear = self.least_mm >= limits.clearance_mm and not self.collides
        near = float(self._errors[0]) <= self.task.config.fire_mm
        seen = bool(self.fraction >= limits.view_fraction)
        return seen and clear and near and self.world.scene.on_organ

    def _find(self) -> None:
        """Everything that follows from the world's state and the goal."""
        scene = self.world.scene
        view = scene.view
        self.least_mm, self.collides = scene.least_mm, scene.collides
        self.fraction = np.float32(view.visible.sum() / view.visible.size)
        _reference(*self._reference, self._done)
        _offsets(
            *self._offsets,
            self._seen[LASER],
            self._blocks[LASER],
            self._seen[ENDOSCOPE],
            self._blocks[ENDOSCOPE],
        )
        self.completion, self.gap_mm, self.healthy_mm2 = scene.dose.progress()
        close = self.least_mm < self._limits.clearance_mm
        _terms(
            self._errors[0],
            view.middle,
            self.fraction,
            self.fired,
            close,
            *self._scales,
            self._terms,
        )
        turn, way = self._reference[1:3]
        ring = (turn, way, self._reference[3], self._done)
        share = np.float32(self.world.steps) / np.float32(self.task.steps)
        place = (self.world.arms[LASER].points_mm, self.world.arms[ENDOSCOPE].points_mm)
        for name, body in self._bodies.items():
            model, seen = self.world.arms[name].model, self._seen[name]
            _body(*body, model.direction, model.anchor, seen)
            _shared(*ring, self.fraction, self.fired, share, *place, name == LASER, seen)

    @property
    def observations(self) -> dict[str, np.ndarray]:
        """Agent -> (D,) float32, arrays that the caller may change."""
        if self.world.failed:
            return {agent: np.zeros_like(self._seen[agent]) for agent in self.task.agents}
        limit = OBSERVATION_LIMIT
        return {agent: self._seen[agent].clip(-limit, limit) for agent in self.task.agents}

    @property
    def terms(self) -> dict[str, dict[str, float]]:
        """Agent -> weighted reward term; zero where the environment failed."""
        values = np.zeros_like(self._terms) if self.world.failed else self._terms
        return {
            agent: {name: float(weight * values[place]) for name, place, weight in each}
            for agent, each in self._weights.items()
        }

    @property
    def terminated(self) -> bool:
        """The ring is cut, an arm touches something, or the environment failed."""
        return self.completion >= 1.0 or self.collides or self.world.failed

    @property
    def failed(self) -> bool:
        """An arm is no longer finite."""
        return self.world.failed

    @property
    def truncated(self) -> bool:
        """The time is out."""
        return self.world.steps >= self.task.steps and not self.terminated

    @property
    def measures(self) -> dict[str, float]:
        """See `CircleAblation.measures`; nan where one does not apply."""
        error = float(self._errors[0])
        late = self.world.steps * self.world.dt_s > self.task.config.approach_s
        return {
            "beam_error_mm": error if self.fired else math.nan,
            "pointing_error_mm": error if late else math.nan,
            "completion": self.completion,
            "largest_gap_mm": self.gap_mm,
            "healthy_mm2": self.healthy_mm2,
            "view_fraction": float(self.fraction),
            "clearance_mm": self.least_mm,
            "collided": float(self.collides),
            "success": float(self.completion >= 1.0 and not self.collides),
        }

    @property
    def state(self) -> TaskState:
        """A copy of the present state."""
        goal = replace(
            self._goal,
            done=torch.full_like(self._goal.done, self._done),
            fired=torch.full_like(self._goal.fired, self.fired),
        )
        return TaskState(self.world.state, goal)


@compiled
def _share(start, way, loop, done):
    """Place on the ring after `done` steps, see `RingCut.share`, in single precision as there."""
    return start + way * np.float32(done) / loop


@compiled
def _reference(path, start, way, loop, targets, done):
    """Targets (K, 3) mm now and in the next steps on a closed path, see `point_on_closed`."""
    count = len(path)
    for ahead in range(len(targets)):
        place = _share(start, way, loop, done + ahead) * np.float32(count)
        below = np.float32(math.floor(place))
        first, weight = int(below) % count, place - below
        for i in range(3):
            a, b = path[first, i], path[(first + 1) % count, i]
            targets[ahead, i] = a + weight * (b - a)


@compiled
def _off_axis(points, direction, target, offset):
    """Offset (3,) mm of a target from a tip's axis, and its length; see `Pointing.offset_mm`."""
    last, along = points.shape[1] - 1, np.float32(0.0)
    for i in range(3):
        offset[i] = target[i] - points[0, last, i]
        along += offset[i] * direction[0, i]
    along, total = max(along, np.float32(0.0)), np.float32(0.0)
    for i in range(3):
        offset[i] -= along * direction[0, i]
        total += offset[i] * offset[i]
    return math.sqrt(total)


@compiled
def _offsets(laser, aim, eye, axis, targets, watched, errors, of_laser, at_laser, of_eye, at_eye):
    """Blocks of the pointing errors, and the errors (2,) mm of the beam and of the camera."""
    offset = np.empty(3, np.float32)
    errors[1] = _off_axis(eye, axis, watched, offset)
    for i in range(3):
        of_eye[at_eye + i] = math.asinh(offset[i])
    for k in range(len(targets)):
        length = _off_axis(laser, aim, targets[k], offset)
        if k == 0:
            errors[0] = length
        for i in range(3):
            of_laser[at_laser + 3 * k + i] = math.asinh(offset[i])


@compiled
def _body(points, base, command, pressure, low, high, beside, band, direction, anchor, out):
    """Blocks of an arm's body, see `observations.body_blocks`."""
    at, chambers = 0, len(low)
    for k in range(min(1, points.shape[1] - 1), points.shape[1]):
        for i in range(3):
            out[at] = (points[0, k, i] - base[i]) / np.float32(SHAPE_MM)
            at += 1
    for m in range(chambers):
        half = np.float32(0.5) * (high[m] - low[m])
        back = (beside[0, m] - anchor[0, m]) / band[m]
        out[at + m] = (command[0, m] - low[m]) / half - np.float32(1.0)
        out[at + chambers + m] = (pressure[0, m] - low[m]) / half - np.float32(1.0)
        out[at + 2 * chambers + m] = direction[0, m]
        out[at + 3 * chambers + m] = min(max(back, -LARGEST_REVERSAL), LARGEST_REVERSAL)


@compiled
def _shared(start, way, loop, done, fraction, fired, time, laser, eye, of_laser, out):
    """The last blocks of an observation: the ring's for the laser, then those of both agents."""
    at = len(out) - 6
    if of_laser:
        angle = np.float32(2.0 * math.pi) * _share(start, way, loop, done)
        out[at - 3], out[at - 2], out[at - 1] = math.sin(angle), math.cos(angle), way
    out[at], out[at + 1], out[at + 2] = fraction, fired, time
    one, other = laser.shape[1] - 1, eye.shape[1] - 1
    for i in range(3):
        out[at + 3 + i] = (laser[0, one, i] - eye[0, other, i]) / np.float32(APART_MM)


@compiled
def _terms(error, middle, fraction, fired, close, far_mm, fine_mm, out):
    """Reward terms without their weights in the order of `TERMS`, see `laser_work.rewards`."""
    one, angle = np.float32(1.0), middle[0, 0]
    angle = min(max(angle, np.float32(0.0)), np.float32(0.5 * math.pi))
    away = middle[0, 1] * np.float32(math.sin(angle))
    out[0] = one / (one + error / far_mm)
    out[1] = math.exp(-error)
    out[2] = math.exp(-error / fine_mm)
    out[3], out[4] = fired, close
    out[5] = one / (one + away / far_mm)
    out[6] = fraction
