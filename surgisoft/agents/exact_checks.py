"""Exact collision checks (FCL) of evaluated episodes, to verify the batched geometry.

Contact and the beam's end are computed exactly (`scene.collision`) at every step. Exact distances
cost forty times as much, so they are computed only at those steps of each episode at which the
batched geometry finds the least clearance.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np
import torch

from surgisoft.agents.rollout import Instant
from surgisoft.errors import InputError
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.collision import CollisionChecker
from surgisoft.scene.rays import RayHit
from surgisoft.tasks.base import Task, TaskState
from surgisoft.tasks.world.arm import ArmPart
from surgisoft.tasks.world.scene import SceneEngine

CLOSEST = 3
"""Steps of each episode at which exact clearances are computed."""


@dataclass(frozen=True)
class Contact:
    """The first overlap that the exact checker found in an episode."""

    time_s: float
    """Time of the contact, s."""
    between: tuple[str, str]
    """The arm, and the body or arm that it met; twice the same for contact with itself."""


@dataclass(frozen=True, eq=False)
class EpisodeCheck:
    """Exact results of one episode, and how much the batched geometry differed from them."""

    contact: Contact | None
    """The first overlap; None: nothing touched anything."""
    clearance_mm: float
    """Least signed clearance to bodies and between arms, mm; nan where there are none."""
    steps: int
    """Instants checked, the start among them."""
    contact_differs: int
    """Instants at which only one of the two engines finds an overlap."""
    clearance_off_mm: float
    """Largest difference of clearances at the instants with exact ones, mm."""
    beam_differs: int
    """Instants at which the engines differ in what the beam hits (organ, arm, nothing)."""
    beam_off_mm: float
    """Largest distance between both ends of the beam where the engines agree in what it hits, mm.
    """


@dataclass
class _Notes:
    """Intermediate results of one episode while it runs."""

    contact: Contact | None = None
    """See `EpisodeCheck`, as for the next four fields."""
    steps: int = 0
    contact_differs: int = 0
    beam_differs: int = 0
    beam_off_mm: float = 0.0
    closest: list[tuple[float, int, dict[str, ArmShape]]] = field(default_factory=list)
    """(clearance in mm, step, arms) at the steps of least clearance by the batched geometry."""


class ExactChecks:
    """Checks every instant of a rollout of a task in a scene; given as `rollout(watch=...)`."""

    def __init__(self, task: Task):
        """task: a task whose world has obstacles, see `has_obstacles`."""
        around = task.world.scene
        if around is None:
            raise InputError(
                f"task {task.name}: its world is empty, expected bodies to check against"
            )
        self.dt_s, self.radii = task.world.config.dt_s, around.geometry.radii_mm
        self.checker = CollisionChecker(around.geometry.bodies)
        self.beam_mm = around.beam_mm if isinstance(around, SceneEngine) else math.nan
        self._notes: dict[int, _Notes] = defaultdict(_Notes)

    def __call__(self, now: Instant) -> None:
        """Check every live episode of an instant."""
        for row in now.live.nonzero()[:, 0].tolist():
            notes = self._notes[int(now.episodes[row])]
            if not now.state.world.failed[row]:
                self._look(notes, now.state, row)

    def checks(self) -> list[EpisodeCheck]:
        """Result of each episode, in order; computes the exact clearances."""
        return [self._check(notes) for _, notes in sorted(self._notes.items())]

    def _look(self, notes: _Notes, state: TaskState, row: int) -> None:
        world = state.world
        arms = {
            name: ArmShape(part.line_mm[row].cpu().numpy(), self.radii[name])
            for name, part in world.arms.items()
        }
        found, step = self.checker.collisions(arms), int(world.steps[row])
        if found and notes.contact is None:
            notes.contact = Contact(self.dt_s * step, (found[0].arm, found[0].other))
        notes.steps += 1
        clearance = world.scene.clearance
        assert clearance is not None, "a world with bodies has a clearance"
        notes.contact_differs += bool(found) != bool(clearance.collides[row])
        notes.closest.append((float(clearance.least_mm[row]), step, arms))
        notes.closest = sorted(notes.closest, key=lambda seen: seen[:2])[:CLOSEST]
        for laser, hit in world.scene.hits.items():
            self._look_along(notes, world.arms[laser], hit, row, arms, laser)

    def _look_along(
        self, notes: _Notes, beam: ArmPart, hit: RayHit, row: int, arms, laser: str
    ) -> None:
        """Compare the exact end of a laser's beam with that of the batched geometry."""
        origin, aim = (v[row].double().cpu().numpy() for v in (beam.tip_mm, beam.tip_direction))
        exact = self.checker.cast(origin, aim, self.beam_mm, arms, own=laser)
        if int(exact.struck) != int(hit.struck[row]):
            notes.beam_differs += 1
        else:
            off = np.linalg.norm(exact.point_mm - hit.point_mm[row].cpu().numpy())
            notes.beam_off_mm = max(notes.beam_off_mm, float(off))

    def _check(self, notes: _Notes) -> EpisodeCheck:
        exact = [self.checker.clearance(arms).least_mm for _, _, arms in notes.closest]
        offs = [abs(mm - seen[0]) for mm, seen in zip(exact, notes.closest, strict=True)]
        return EpisodeCheck(
            contact=notes.contact,
            clearance_mm=min(exact, default=float("nan")),
            steps=notes.steps,
            contact_differs=notes.contact_differs,
            clearance_off_mm=max(offs, default=0.0),
            beam_differs=notes.beam_differs,
            beam_off_mm=notes.beam_off_mm,
        )


def has_obstacles(task: Task) -> bool:
    """Whether there is anything that an arm could touch."""
    return task.world.scene is not None


def contacts_in(checks: list[EpisodeCheck]) -> torch.Tensor:
    """(N,) bool: the exact checker found an overlap in the episode."""
    return torch.tensor([check.contact is not None for check in checks])
