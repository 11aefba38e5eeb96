"""FCL looks over evaluated episodes: contact and the beam at every step, clearance where it counts.

Whether anything overlaps, and where the beam ends, is asked of `scene.collision.Referee` at every
step. Exact distances cost forty times as much, so they are asked only at the steps of each episode
at which the batched path finds the least clearance.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np
import torch

from surgisoft.agents.rollout import Instant
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.collision import Referee
from surgisoft.tasks.base import Task, TaskState
from surgisoft.tasks.world.scene import LASER

CLOSEST = 3
"""Steps of each episode at which exact clearances are asked for."""


@dataclass(frozen=True)
class Contact:
    """The first overlap that the referee found in an episode."""

    time_s: float
    """When, s."""
    between: tuple[str, str]
    """The arm, and the body or arm that it met; twice the same for contact with itself."""


@dataclass(frozen=True, eq=False)
class Verdict:
    """What the referee says of one episode, and how far the batched path was from it."""

    contact: Contact | None
    """The first overlap; None: nothing touched anything."""
    clearance_mm: float
    """Least signed clearance to bodies and between arms, mm; nan where nothing is around."""
    steps: int
    """Instants looked at, the start among them."""
    contact_differs: int
    """Instants at which only one of the two says that something overlaps."""
    clearance_off_mm: float
    """Largest difference of clearances at the instants looked at exactly, mm."""
    beam_differs: int
    """Instants at which the beam meets another kind of thing."""
    beam_off_mm: float
    """Largest distance between the two places where the beam ends on the same kind of thing, mm."""


@dataclass
class _Notes:
    """What is kept of one episode while it runs."""

    contact: Contact | None = None
    steps: int = 0
    contact_differs: int = 0
    beam_differs: int = 0
    beam_off_mm: float = 0.0
    closest: list[tuple[float, int, dict[str, ArmShape]]] = field(default_factory=list)


class EpisodeReferee:
    """Watches a rollout of a task in a scene; see `rollout(watch=...)`."""

    def __init__(self, task: Task):
        """The task's world has surroundings, see `has_referee`."""
        around = task.world.scene
        self.dt_s, self.radii = task.world.config.dt_s, around.geometry.radii_mm
        self.referee = Referee(around.geometry.bodies)
        self.beam_mm = around.beam_mm if LASER in task.world.arms else None
        self._notes: dict[int, _Notes] = defaultdict(_Notes)

    def __call__(self, now: Instant) -> None:
        """Look at every live episode of an instant."""
        for row in now.live.nonzero()[:, 0].tolist():
            notes = self._notes[int(now.episodes[row])]
            if not now.state.world.failed[row]:
                self._look(notes, now.state, row)

    def verdicts(self) -> list[Verdict]:
        """One for each episode, in order; asks for the exact clearances."""
        return [self._verdict(notes) for _, notes in sorted(self._notes.items())]

    def _look(self, notes: _Notes, state: TaskState, row: int) -> None:
        world = state.world
        arms = {
            name: ArmShape(part.line_mm[row].cpu().numpy(), self.radii[name])
            for name, part in world.arms.items()
        }
        found, step = self.referee.collisions(arms), int(world.steps[row])
        if found and notes.contact is None:
            notes.contact = Contact(self.dt_s * step, (found[0].arm, found[0].other))
        notes.steps += 1
        clearance = world.scene.clearance
        notes.contact_differs += bool(found) != bool(clearance.collides[row])
        notes.closest.append((float(clearance.least_mm[row]), step, arms))
        notes.closest = sorted(notes.closest, key=lambda seen: seen[:2])[:CLOSEST]
        if LASER in world.arms:
            self._look_along(notes, state, row, arms)

    def _look_along(self, notes: _Notes, state: TaskState, row: int, arms) -> None:
        """The beam's end by the referee beside that of the batched path."""
        beam, hit = state.world.arms[LASER], state.world.scene.hit
        origin, aim = (v[row].double().cpu().numpy() for v in (beam.tip_mm, beam.tip_direction))
        exact = self.referee.cast(origin, aim, self.beam_mm, arms, own=LASER)
        if int(exact.struck) != int(hit.struck[row]):
            notes.beam_differs += 1
        else:
            off = np.linalg.norm(exact.point_mm - hit.point_mm[row].cpu().numpy())
            notes.beam_off_mm = max(notes.beam_off_mm, float(off))

    def _verdict(self, notes: _Notes) -> Verdict:
        exact = [self.referee.clearance(arms).least_mm for _, _, arms in notes.closest]
        offs = [abs(mm - seen[0]) for mm, seen in zip(exact, notes.closest, strict=True)]
        return Verdict(
            contact=notes.contact,
            clearance_mm=min(exact, default=float("nan")),
            steps=notes.steps,
            contact_differs=notes.contact_differs,
            clearance_off_mm=max(offs, default=0.0),
            beam_differs=notes.beam_differs,
            beam_off_mm=notes.beam_off_mm,
        )


def has_referee(task: Task) -> bool:
    """Whether there is anything around that an arm could touch."""
    return task.world.scene is not None


def contacts_of(verdicts: list[Verdict]) -> torch.Tensor:
    """(N,) bool: the referee found an overlap in the episode."""
    return torch.tensor([verdict.contact is not None for verdict in verdicts])
