"""Exact collision checks (FCL) of evaluated episodes, to verify the batched geometry.

FCL (`scene.collision`) decides about contact and about what the beam meets wherever its answer may
differ from that of the batched geometry. Where the batched clearance is farther from contact than
its error bound, FCL cannot find a contact; where the beam meets a face well inside its edges and
passes everything else at a distance, FCL cannot find another end (`BatchedScene.sure_hits`). Random
poses test both in `tests/agents/test_exact_checks.py`, and every evaluation audits a share of such
instants by FCL.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from surgisoft.agents.rollout import Instant
from surgisoft.errors import InputError
from surgisoft.scene import frames
from surgisoft.scene.batched import BatchClearance, BatchedScene
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.collision import CollisionChecker
from surgisoft.scene.rays import RayHit
from surgisoft.tasks.base import Task
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
    asked: int = 0
    """Instants at which FCL looked for contact; at the others it cannot find one."""
    beams_asked: int = 0
    """Beams that FCL followed; what the others meet is beyond doubt."""
    audited: int = 0
    """Instants at which FCL looked for contact although it could not find one."""


SURE_FROM_MM = 0.1
"""Clearance by the batched geometry from which FCL cannot find a contact (mm): the largest
difference between both engines near contact that `tests/scene/test_distance.py` allows. What the
batched geometry calls 5 mm or more is a lower bound, see `batched.EXACT_WITHIN_MM`."""
BEAMS_TOGETHER = 256
"""Beams that wait for FCL and are checked together (a count): batches make closed forms cheaper."""
MARGIN_MM = 1.0
"""Clearance that is left, by what arms have moved since it was measured, where it is not measured
again (mm): far more than the batched geometry errs by."""
AUDIT_EVERY = 64
"""One in so many of the instants that need no FCL is given to it anyway, as an audit (a count)."""


@dataclass
class _Notes:
    """Intermediate results of one episode while it runs."""

    contact: Contact | None = None
    """See `EpisodeCheck`, as for the next seven fields."""
    steps: int = 0
    contact_differs: int = 0
    beam_differs: int = 0
    beam_off_mm: float = 0.0
    asked: int = 0
    beams_asked: int = 0
    audited: int = 0
    closest: list[tuple[float, int, dict[str, np.ndarray], CollisionChecker]] = field(
        default_factory=list
    )
    """(clearance in mm, step, centrelines, checker with the bodies of the step) at the steps of
    least clearance by the batched geometry."""


@dataclass(frozen=True, eq=False)
class _Beam:
    """A beam that waits for FCL."""

    notes: _Notes
    """Of its episode."""
    origin_mm: np.ndarray
    """(3,) mm, and aim (3,)."""
    aim: np.ndarray
    lines_mm: dict[str, np.ndarray]
    """Centreline (K, 3) mm of each arm."""
    struck: int
    """What it meets by the batched geometry, a `Struck`, and its end (3,) mm."""
    end_mm: np.ndarray


class ExactChecks:
    """Checks every instant of a rollout of a task in a scene; given as `rollout(watch=...)`.

    The batched geometry is computed anew from the centrelines, because a state may hold something
    else. It only chooses the instants that FCL is asked about: those at which it cannot rule out
    that FCL would answer otherwise, and an audit of the others.
    """

    def __init__(self, task: Task):
        """task: a task whose world has obstacles, see `has_obstacles`."""
        around = task.world.scene
        if around is None:
            raise InputError(
                f"task {task.name} has no scene, so the exact collision checker has no bodies to "
                "check against; use --no-exact-checks"
            )
        self.dt_s, self.radii = task.world.config.dt_s, around.geometry.radii_mm
        self.around, self.checker = around, CollisionChecker(around.geometry.bodies)
        self.beam_mm = around.beam_mm if isinstance(around, SceneEngine) else math.nan
        self._bounds = around.geometry
        if not around.geometry.compiled:
            bodies, stretch = around.geometry.bodies, around.geometry.stretch
            self._bounds = BatchedScene(bodies, self.radii, stretch=stretch)
        self._last = LastClearance(self._bounds)
        self._notes: dict[int, _Notes] = defaultdict(_Notes)
        self._beams: dict[str, list[_Beam]] = defaultdict(list)

    def __call__(self, now: Instant) -> None:
        """Check every live episode of an instant."""
        world = now.state.world
        rows = (now.live & ~world.failed).nonzero()[:, 0]
        for number in now.episodes[now.live].tolist():
            self._notes[number]  # an episode that fails at once has its entry, too
        if not len(rows):
            return
        lines = {name: part.line_mm[rows].float().cpu() for name, part in world.arms.items()}
        numbers, steps = now.episodes[rows].cpu().numpy(), world.steps[rows].cpu().numpy()
        clearance = world.scene.clearance
        assert clearance is not None, "a world with bodies has a clearance"
        least, collides = clearance.least_mm[rows].tolist(), clearance.collides[rows].tolist()
        placement = None
        if isinstance(self.around, SceneEngine):
            placement = self.around.placement(world.scene.breaths)
        audit = (numbers + steps) % AUDIT_EVERY == 0
        checkers = [self.checker] * len(rows)
        clear = np.zeros(len(rows), bool)
        if placement is None:
            clear = self._last.out_of_contact(numbers, lines)
        else:
            checkers = [self.checker.moved(placement, row) for row in rows.tolist()]
        notes = [self._notes[number] for number in numbers.tolist()]
        arrays = {name: line.numpy() for name, line in lines.items()}
        for n, kept in enumerate(notes):
            kept.steps += 1
            place = (least[n], int(steps[n]))
            if len(kept.closest) < CLOSEST or place < kept.closest[-1][:2]:
                own = {name: line[n].copy() for name, line in arrays.items()}
                closest = [*kept.closest, (*place, own, checkers[n])]
                kept.closest = sorted(closest, key=lambda seen: seen[:2])[:CLOSEST]
            if collides[n] and clear[n] and not audit[n]:
                kept.contact_differs += 1
        for n in np.flatnonzero(audit | ~clear).tolist():
            own = {name: line[n] for name, line in arrays.items()}
            found = self._touches(notes[n], own, int(steps[n]), checkers[n])
            notes[n].contact_differs += found != collides[n]
            notes[n].asked += 1
            notes[n].audited += bool(audit[n] and clear[n])
        for laser, hit in world.scene.hits.items():
            self._look_along(notes, world.arms[laser], hit, rows, arrays, laser, checkers, audit)

    def checks(self, episodes: int | None = None) -> list[EpisodeCheck]:
        """Result of each episode, in order; computes the exact clearances.

        episodes: number of the first ones that count; None: all.
        """
        for laser in self._beams:
            self._follow(laser, self.checker)
        return [self._check(notes) for _, notes in sorted(self._notes.items())[:episodes]]

    def _touches(
        self, notes: _Notes, lines: dict[str, np.ndarray], step: int, checker: CollisionChecker
    ) -> bool:
        """Whether FCL finds a contact; keeps the first one."""
        arms = {name: ArmShape(line, self.radii[name]) for name, line in lines.items()}
        found = checker.collisions(arms)
        if found and notes.contact is None:
            notes.contact = Contact(self.dt_s * step, (found[0].arm, found[0].other))
        return bool(found)

    def _look_along(
        self,
        notes: list[_Notes],
        beam: ArmPart,
        hit: RayHit,
        rows: torch.Tensor,
        lines: dict[str, np.ndarray],
        laser: str,
        checkers: list[CollisionChecker],
        audit: np.ndarray,
    ) -> None:
        """Compare the ends of a laser's beam with those of the batched geometry."""
        origin, aim = (v[rows].float().cpu().numpy() for v in (beam.tip_mm, beam.tip_direction))
        struck, ends = hit.struck[rows].cpu().numpy(), hit.point_mm[rows].cpu().numpy()
        at_rest = all(checker is self.checker for checker in checkers)
        asked = np.ones(len(rows), bool)
        if at_rest:
            kind, end, sure = self._bounds.sure_hits(origin, aim, self.beam_mm, lines, laser)
            asked = audit | ~sure
            self._compare(notes, np.flatnonzero(~asked), kind, end, struck, ends)
        for n in np.flatnonzero(asked).tolist():
            notes[n].beams_asked += 1
            own = {name: line[n] for name, line in lines.items()}
            ray = _Beam(notes[n], origin[n], aim[n], own, struck[n], ends[n])
            self._beams[laser].append(ray)
            if not at_rest:
                self._follow(laser, checkers[n])
        if len(self._beams[laser]) >= BEAMS_TOGETHER:
            self._follow(laser, self.checker)

    def _follow(self, laser: str, checker: CollisionChecker) -> None:
        """Follow the beams of a laser that wait for FCL, all among the bodies of one checker."""
        beams, self._beams[laser] = self._beams[laser], []
        if not beams:
            return
        kind, end = checker.cast_each(
            np.array([beam.origin_mm for beam in beams], dtype=float),
            np.array([beam.aim for beam in beams], dtype=float),
            self.beam_mm,
            {
                name: np.array([beam.lines_mm[name] for beam in beams], dtype=float)
                for name in beams[0].lines_mm
            },
            self.radii,
            laser,
        )
        struck = np.array([beam.struck for beam in beams])
        ends = np.array([beam.end_mm for beam in beams])
        notes = [beam.notes for beam in beams]
        self._compare(notes, range(len(beams)), kind, end, struck, ends)

    @staticmethod
    def _compare(
        notes: Sequence[_Notes],
        which: Iterable[int],
        kind: np.ndarray,
        end: np.ndarray,
        struck: np.ndarray,
        ends: np.ndarray,
    ) -> None:
        """Note by how much beams differ: what they meet (N,), and where they end (N, 3) mm."""
        differs, off = (kind != struck).tolist(), frames.norm(end - ends).tolist()
        for n in which:
            if differs[n]:
                notes[n].beam_differs += 1
            elif off[n] > notes[n].beam_off_mm:
                notes[n].beam_off_mm = off[n]

    def _check(self, notes: _Notes) -> EpisodeCheck:
        exact = [
            checker.clearance(
                {name: ArmShape(line, self.radii[name]) for name, line in lines.items()}
            ).least_mm
            for _, _, lines, checker in notes.closest
        ]
        offs = [abs(mm - seen[0]) for mm, seen in zip(exact, notes.closest, strict=True)]
        return EpisodeCheck(
            contact=notes.contact,
            clearance_mm=min(exact, default=float("nan")),
            steps=notes.steps,
            contact_differs=notes.contact_differs,
            clearance_off_mm=max(offs, default=0.0),
            beam_differs=notes.beam_differs,
            beam_off_mm=notes.beam_off_mm,
            asked=notes.asked,
            beams_asked=notes.beams_asked,
            audited=notes.audited,
        )


def out_of_contact(scene: BatchedScene, lines: Mapping[str, torch.Tensor]) -> np.ndarray:
    """(R,) bool: arms (R, K, 3) mm that FCL cannot find in contact, among bodies at rest."""
    found = scene.clearance(lines)
    return (torch.cat((_to_others(found), found.self_mm), 1).amin(1) >= SURE_FROM_MM).numpy()


def _to_others(found: BatchClearance) -> torch.Tensor:
    """(R, P) mm: clearances of arms to bodies and to each other."""
    return torch.cat((found.bodies_mm.flatten(1), found.arms_mm), 1)


class LastClearance:
    """`out_of_contact` of episodes step by step, which measures only what may have become less.

    No point of an arm is farther from where it was than the point of its centreline that has moved
    most, so a clearance to bodies at rest falls by at most that, and one between two arms by twice
    that. That of an arm to itself, which is between parts a length of arc apart, has no such bound.
    """

    def __init__(self, scene: BatchedScene):
        """scene: the bodies at rest."""
        self._scene = scene
        self._mm = np.zeros(0)
        self._lines: dict[str, np.ndarray] = {}

    def out_of_contact(self, episodes: np.ndarray, lines: Mapping[str, torch.Tensor]) -> np.ndarray:
        """(R,) bool for arms (R, K, 3) mm of episodes (R,), as the function says."""
        arrays = {name: line.numpy() for name, line in lines.items()}
        if self._bound(episodes, arrays):
            own = self._scene.clearance_to_itself(lines)
            return (own.amin(1) >= SURE_FROM_MM).numpy()
        found = self._scene.clearance(lines)
        others = _to_others(found).amin(1)
        self._keep(episodes, others.double().numpy(), arrays)
        return (torch.minimum(others, found.self_mm.amin(1)) >= SURE_FROM_MM).numpy()

    def _bound(self, episodes: np.ndarray, arrays: dict[str, np.ndarray]) -> bool:
        """Whether what was measured last keeps all arms away from bodies and from each other."""
        if episodes.max() >= len(self._mm) or not self._fit(arrays):
            return False
        moved = np.zeros(len(episodes))
        for name, line in arrays.items():
            step = line - self._lines[name][episodes]
            far = np.einsum("rkc,rkc->rk", step, step).max(1)
            moved = np.maximum(moved, np.sqrt(far, dtype=float))
        return bool(np.all(self._mm[episodes] - 2.0 * moved >= SURE_FROM_MM + MARGIN_MM))

    def _fit(self, arrays: dict[str, np.ndarray]) -> bool:
        """Whether centrelines have as many points as those that are kept."""
        return all(
            name in self._lines and self._lines[name].shape[1:] == line.shape[1:]
            for name, line in arrays.items()
        )

    def _keep(self, episodes: np.ndarray, mm: np.ndarray, arrays: dict[str, np.ndarray]) -> None:
        """Keep the clearances (R,) mm and centrelines of episodes."""
        if not self._fit(arrays):
            self._mm, self._lines = self._mm[:0], {}
        size = max(int(episodes.max()) + 1, len(self._mm))
        if size > len(self._mm):
            more = size - len(self._mm)
            self._mm = np.concatenate((self._mm, np.full(more, -np.inf)))
            for name, line in arrays.items():
                nothing = np.zeros((more, *line.shape[1:]), line.dtype)
                kept = self._lines.get(name, nothing[:0])
                self._lines[name] = np.concatenate((kept, nothing))
        self._mm[episodes] = mm
        for name, line in arrays.items():
            self._lines[name][episodes] = line


def has_obstacles(task: Task) -> bool:
    """Whether there is anything that an arm could touch."""
    return task.world.scene is not None


def contacts_in(checks: list[EpisodeCheck]) -> torch.Tensor:
    """(N,) bool: the exact checker found an overlap in the episode."""
    return torch.tensor([check.contact is not None for check in checks])
