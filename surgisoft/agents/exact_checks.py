"""Exact collision checks (FCL) of evaluated episodes, to verify the batched geometry.

The end of the beam is computed exactly (`scene.collision`) at every step, and contact at every step
at which there may be one. An exact clearance proves that there is none for a while: where no point
of an arm's centreline has moved by as much since, the arm has not come to touch anything. Every
point of a segment moves at most as far as the farther of its ends, so the bound holds for whole
arms, and it needs nothing from the batched geometry.
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass, field

import numpy as np
import torch

from surgisoft.agents.rollout import Instant
from surgisoft.errors import InputError
from surgisoft.scene import frames
from surgisoft.scene.capsules import ArmShape, folding_pairs
from surgisoft.scene.collision import CollisionChecker
from surgisoft.scene.rays import RayHit
from surgisoft.tasks.base import Task
from surgisoft.tasks.world.arm import ArmPart
from surgisoft.tasks.world.scene import SceneEngine, SceneState

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


PROVEN_FROM_MM = 0.5
"""Clearance by the batched geometry from which an exact one is worth its cost (mm): it serves for
as long as the arms move less. It does not decide what is found."""


@dataclass(frozen=True, eq=False)
class _Proof:
    """Exact clearances of one pose of the arms."""

    lines_mm: dict[str, np.ndarray]
    """Centreline (K, 3) mm of each arm."""
    free_mm: dict[tuple[str, ...], float]
    """Clearance of each arm from the bodies, (arm,), and of each pair of arms, mm."""

    def holds(self, lines_mm: dict[str, np.ndarray]) -> bool:
        """Whether no arm has moved far enough since to touch a body or another arm."""
        if any(line.shape != self.lines_mm[name].shape for name, line in lines_mm.items()):
            return False
        moved = {
            name: float(np.sqrt(((line - self.lines_mm[name]) ** 2).sum(axis=1).max()))
            for name, line in lines_mm.items()
        }
        return all(
            sum(moved[name] for name in names) < free for names, free in self.free_mm.items()
        )


@dataclass
class _Notes:
    """Intermediate results of one episode while it runs."""

    contact: Contact | None = None
    """See `EpisodeCheck`, as for the next four fields."""
    steps: int = 0
    contact_differs: int = 0
    beam_differs: int = 0
    beam_off_mm: float = 0.0
    closest: list[tuple[float, int, dict[str, ArmShape], CollisionChecker]] = field(
        default_factory=list
    )
    """(clearance in mm, step, arms, checker with the bodies of the step) at the steps of least
    clearance by the batched geometry."""
    proof: _Proof | None = None
    """The last exact clearance, where there was any."""
    collision_checks: int = 0
    """Instants at which FCL looked for contact or for the clearance."""


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
        self.around, self.checker = around, CollisionChecker(around.geometry.bodies)
        self.beam_mm = around.beam_mm if isinstance(around, SceneEngine) else math.nan
        self._notes: dict[int, _Notes] = defaultdict(_Notes)

    def __call__(self, now: Instant) -> None:
        """Check every live episode of an instant."""
        world = now.state.world
        rows = (now.live & ~world.failed).nonzero()[:, 0]
        for number in now.episodes[now.live].tolist():
            self._notes[number]  # an episode that fails at once has its entry, too
        if not len(rows):
            return
        lines = {
            name: part.line_mm[rows].double().cpu().numpy() for name, part in world.arms.items()
        }
        numbers, steps = now.episodes[rows].tolist(), world.steps[rows].tolist()
        clearance = world.scene.clearance
        assert clearance is not None, "a world with bodies has a clearance"
        least, collides = clearance.least_mm[rows].tolist(), clearance.collides[rows].tolist()
        folds, checkers = self._may_fold(lines), self._checkers(world.scene, rows)
        for n, number in enumerate(numbers):
            own = {name: line[n] for name, line in lines.items()}
            notes = self._notes[number]
            self._look(notes, own, steps[n], least[n], collides[n], bool(folds[n]), checkers[n])
        for laser, hit in world.scene.hits.items():
            self._look_along(numbers, world.arms[laser], hit, rows, lines, laser, checkers)

    def _checkers(self, scene: SceneState, rows: torch.Tensor) -> list[CollisionChecker]:
        """For each of the rows (R,) of the batch the checker with the bodies where they are."""
        placement = None
        if isinstance(self.around, SceneEngine):
            placement = self.around.placement(scene.breaths)
        if placement is None:
            return [self.checker] * len(rows)
        return [self.checker.moved(placement, row) for row in rows.tolist()]

    def _may_fold(self, lines: dict[str, np.ndarray]) -> np.ndarray:
        """(B,) bool: parts of an arm (B, K, 3) mm may touch one another."""
        found = []
        for name, line in lines.items():
            steps = line[:, 1:] - line[:, :-1]
            middles, halves = 0.5 * (line[:, 1:] + line[:, :-1]), 0.5 * frames.norm(steps)
            apart = frames.norm(middles[:, :, None] - middles[:, None])
            apart = apart - halves[:, :, None] - halves[:, None]
            touching = apart <= 2.0 * self.radii[name]
            found.append((touching & folding_pairs(line, self.radii[name])).any(axis=(1, 2)))
        return np.any(found, axis=0)

    def checks(self) -> list[EpisodeCheck]:
        """Result of each episode, in order; computes the exact clearances."""
        return [self._check(notes) for _, notes in sorted(self._notes.items())]

    def _look(
        self,
        notes: _Notes,
        lines: dict[str, np.ndarray],
        step: int,
        least_mm: float,
        collides: bool,
        folds: bool,
        checker: CollisionChecker,
    ) -> None:
        """Check one pose of the arms (K, 3) mm; least_mm and collides: by the batched geometry."""
        notes.steps += 1
        place = (least_mm, step)
        close = len(notes.closest) < CLOSEST or place < notes.closest[-1][:2]
        shown = not folds and notes.proof is not None and notes.proof.holds(lines)
        if shown and not close:
            notes.contact_differs += collides
            return
        arms = {name: ArmShape(line, self.radii[name]) for name, line in lines.items()}
        if close:
            notes.closest = sorted(
                [*notes.closest, (*place, arms, checker)], key=lambda seen: seen[:2]
            )
            notes.closest = notes.closest[:CLOSEST]
        found = False if shown else self._touches(notes, arms, step, least_mm, folds, checker)
        notes.contact_differs += found != collides

    def _touches(
        self,
        notes: _Notes,
        arms: dict[str, ArmShape],
        step: int,
        least_mm: float,
        folds: bool,
        checker: CollisionChecker,
    ) -> bool:
        """Whether FCL finds a contact; keeps a proof for the next steps, or the first contact.

        Among bodies that move no clearance proves anything about the next step.
        """
        notes.collision_checks += 1
        if least_mm >= PROVEN_FROM_MM and not folds and checker is self.checker:
            notes.proof = self._proof(arms)
            if min(notes.proof.free_mm.values(), default=math.inf) > 0.0:
                return False
            notes.proof = None
        found = checker.collisions(arms)
        if found and notes.contact is None:
            notes.contact = Contact(self.dt_s * step, (found[0].arm, found[0].other))
        return bool(found)

    def _proof(self, arms: dict[str, ArmShape]) -> _Proof:
        """Exact clearances of the arms."""
        exact = self.checker.clearance(arms)
        free: dict[tuple[str, ...], float] = {
            (one, other): clearance for (one, other), clearance in exact.arms_mm.items()
        }
        for (arm, _), clearance in exact.bodies_mm.items():
            free[arm,] = min(free.get((arm,), math.inf), clearance)
        return _Proof({name: shape.centreline_mm for name, shape in arms.items()}, free)

    def _look_along(
        self,
        numbers: list[int],
        beam: ArmPart,
        hit: RayHit,
        rows: torch.Tensor,
        lines: dict[str, np.ndarray],
        laser: str,
        checkers: list[CollisionChecker],
    ) -> None:
        """Compare the exact ends of a laser's beam with those of the batched geometry."""
        origin, aim = (v[rows].double().cpu().numpy() for v in (beam.tip_mm, beam.tip_direction))
        if all(checker is self.checker for checker in checkers):
            cast = self.checker.cast_each(origin, aim, self.beam_mm, lines, self.radii, laser)
        else:
            each = [
                checker.cast_each(
                    origin[n : n + 1],
                    aim[n : n + 1],
                    self.beam_mm,
                    {name: line[n : n + 1] for name, line in lines.items()},
                    self.radii,
                    laser,
                )
                for n, checker in enumerate(checkers)
            ]
            cast = (np.concatenate([one[0] for one in each]), np.concatenate([o[1] for o in each]))
        struck, ends = hit.struck[rows].cpu().numpy(), hit.point_mm[rows].cpu().numpy()
        off = frames.norm(cast[1] - ends)
        for n, number in enumerate(numbers):
            notes = self._notes[number]
            if cast[0][n] != struck[n]:
                notes.beam_differs += 1
            else:
                notes.beam_off_mm = max(notes.beam_off_mm, float(off[n]))

    def _check(self, notes: _Notes) -> EpisodeCheck:
        exact = [checker.clearance(arms).least_mm for _, _, arms, checker in notes.closest]
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
