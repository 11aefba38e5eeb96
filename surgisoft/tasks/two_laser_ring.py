"""Three arms cut a ring around a lesion: two lasers share it, one endoscope keeps both in view.

The lasers begin on opposite points and go round in one direction. No beam is on while it would pass
near another arm. The dose map, to which both beams add, decides about success.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.tasks.base import Signal, TaskState, clearance, term_names, weighted
from surgisoft.tasks.laser_supervision import LASER_EXPERIMENT, LaserSupervision
from surgisoft.tasks.laser_work import (
    BEAM_ERROR,
    ENDOSCOPE,
    LASER_PRESET,
    LASER_STEPS,
    RING_DIRECTION,
    RING_PLACE,
    VIEW,
    VIEW_ERROR,
    VIEW_FRACTION,
    LaserConfig,
    LaserTask,
    LaserWeights,
    check_config,
    lesion,
    view,
)
from surgisoft.tasks.observations import (
    TIME,
    Block,
    ObservationBlocks,
    body_blocks,
    elapsed,
    numbered,
)
from surgisoft.tasks.spec import TaskSpec
from surgisoft.tasks.trajectories.closed_path import draw_traversal, point_on_closed
from surgisoft.tasks.world.arm import ArmPart
from surgisoft.tasks.world.random_streams import Stream
from surgisoft.tasks.world.scene import PHANTOM

LASERS = ("laser_1", "laser_2")
AGENTS = (*LASERS, ENDOSCOPE)
"""Names of the three arms, which are the agents."""
TWO_LASERS = PHANTOM / "two_lasers.toml"
"""The liver phantom with the mounts of three arms."""

LEAD = Block(
    "lead",
    "share of the ring by which the laser is ahead of half a turn before the other one",
    "-",
    "x",
    -2.0,
    2.0,
)
BEAM_CLEARANCE = Block(
    "beam_clearance",
    "least measured distance of the beam's path from the skin of the other arms, own beam first",
    "mm",
    "min(x, 60) / 10",
    -2.0,
    6.0,
)
SPOTS = Block(
    "spots", "1 if the endoscope sees a laser's target, own laser first", "-", "x", 0.0, 1.0
)
FIRED = Block("fired", "1 if a beam was on in the last step, own beam first", "-", "x", 0.0, 1.0)
APART = Block("apart", "measured tips of the other arms minus the own one", "mm", "x / 50")


def _beam_on(k: int) -> Signal:
    return Signal(
        f"{LASERS[k]}_on",
        f"1 if the beam of `{LASERS[k]}` was on since the last decision, else 0",
        "-",
        0.0,
        1.0,
        lambda task, before, after: after.goal.fired[:, k].float(),
    )


def _target_seen(k: int) -> Signal:
    return Signal(
        f"{LASERS[k]}_target_seen",
        f"1 if the endoscope sees the target of `{LASERS[k]}`, else 0",
        "-",
        0.0,
        1.0,
        lambda task, before, after: task.spots_seen(after)[:, k].float(),
    )


BEAMS_ON = tuple(_beam_on(k) for k in range(len(LASERS)))
SPOTS_SEEN = tuple(_target_seen(k) for k in range(len(LASERS)))


@dataclass(frozen=True)
class RingLaserWeights(LaserWeights):
    """Weights of a laser's reward terms; e is the distance of its own beam from its target, mm."""

    crossed: float = -1.0
    """1 while the path of either beam comes nearer than beam_mm to another arm, else 0."""


@dataclass(frozen=True)
class RingEndoscopeWeights:
    """Weights of the endoscope's reward terms; e is the distance of the camera's axis from the
    ring's centre, mm."""

    look: float = 1.0
    """1 / (1 + e / far_mm)."""
    view: float = 1.0
    """Share of the ring that the endoscope sees."""
    spots: float = 1.0
    """Share of the two lasers' targets that the endoscope sees."""
    cut: float = 1.0
    """Share of the two beams that are on."""
    contact: float = -1.0
    """1 while the clearance of any arm is below the scene's limit, else 0."""


@dataclass(frozen=True)
class TwoLaserRingWeights:
    """Weights of the reward terms of all agents."""

    laser_1: RingLaserWeights = field(default_factory=RingLaserWeights)
    """Weights of the first laser's reward terms."""
    laser_2: RingLaserWeights = field(default_factory=RingLaserWeights)
    """Weights of the second laser's reward terms."""
    endoscope: RingEndoscopeWeights = field(default_factory=RingEndoscopeWeights)
    """Weights of the endoscope's reward terms."""


@dataclass(frozen=True)
class TwoLaserRingConfig(LaserConfig):
    """The scene, the speed of the cut, the observation and the reward.

    Time and safety limits come from the scene's file.
    """

    scene: str | Path = TWO_LASERS
    """Scene with the arms `laser_1`, `laser_2` and `endoscope`: its folder or file."""
    cut_s: float = 45.0
    """Time in which one laser would go once around with its beam on, s; two share the ring."""
    beam_mm: float = 3.0
    """Distance of a beam's path from the skin of another arm below which the beam stays off, mm."""
    weights: TwoLaserRingWeights = field(default_factory=TwoLaserRingWeights)
    """Weights of the reward terms."""

    def __post_init__(self):
        check_config("two_laser_ring", self, "cut_s", "beam_mm")


def success_rule(config: TwoLaserRingConfig) -> str:
    """Definition of success, in words; `measures` computes it."""
    return (
        "the whole ring is cut by both beams together, without contact; a beam is on only within "
        f"{config.fire_mm:g} mm of its target (fire_mm), in view, and {config.beam_mm:g} mm clear "
        "of every other arm (beam_mm)"
    )


@dataclass(frozen=True, eq=False)
class SharedCut:
    """Progress of B cuts that two lasers share; laser k begins k / 2 of the ring further on."""

    start: Tensor
    """(B,) 0..1: place where the first laser begins, as a share of the ring's length."""
    direction: Tensor
    """(B,) +1 or -1: direction of travel of both."""
    done: Tensor
    """(B, 2) int64: steps by which each laser's reference has moved."""
    fired: Tensor
    """(B, 2) bool: the laser's beam was on in the last step."""

    def share(self, laser: int, steps: int, ahead: int = 0) -> Tensor:
        """(B,) place of a laser `ahead` steps further on, as a share of the length, not wrapped.

        A reference goes round once in `steps` steps with its beam on.
        """
        moved = self.direction * (self.done[:, laser] + ahead) / steps
        return self.start + laser / len(LASERS) + moved

    def after(self, fired: Tensor) -> SharedCut:
        """The cut one step later; a reference moves where its beam was on, fired (B, 2) bool."""
        return replace(self, done=self.done + fired, fired=fired)


class TwoLaserRing(LaserTask[SharedCut]):
    """Three arms of a scene: agents `laser_1`, `laser_2` and `endoscope`."""

    name, agents = "two_laser_ring", AGENTS
    signals = (VIEW_FRACTION, *BEAMS_ON, *SPOTS_SEEN)

    def __init__(
        self, config: TwoLaserRingConfig | None = None, device: str | torch.device = "cpu"
    ):
        c = config or TwoLaserRingConfig()
        super().__init__(c, device)
        if self.scene.lasers != LASERS or self.scene.endoscopes != (ENDOSCOPE,):
            raise InputError(
                f"scene '{self.spec.name}' has the lasers {', '.join(self.scene.lasers)} and the "
                f"endoscopes {', '.join(self.scene.endoscopes)}; two_laser_ring expects "
                f"{' and '.join(LASERS)}, and {ENDOSCOPE}"
            )
        self.round = round(c.cut_s / self.dt_s)
        if self.round < 1:
            raise InputError(
                f"{self.name}: cut_s is {c.cut_s:g} s, expected at least a step, {self.dt_s:g} s"
            )

    def goal(self, stream: Stream) -> tuple[Stream, SharedCut]:
        """Draw start and direction of the cut for each random number stream."""
        stream, way = draw_traversal(stream, anywhere=True)
        done = torch.zeros_like(stream.count)[:, None].expand(-1, len(LASERS)).clone()
        return stream, SharedCut(way.start, way.direction, done, done > 0)

    def targets_mm(self, state: TaskState[SharedCut], ahead: int = 0) -> list[Tensor]:
        """(B, 3) mm for each laser: its reference point on the ring `ahead` steps further on."""
        shares = (state.goal.share(k, self.round, ahead) for k in range(len(LASERS)))
        return [point_on_closed(self.scene.paths_mm, lesion(state), share) for share in shares]

    def beam_errors_mm(self, state: TaskState[SharedCut]) -> Tensor:
        """(B, 2) mm: true perpendicular distance of each beam's axis from its target."""
        arms = [state.world.arms[name] for name in LASERS]
        return self._off_targets_mm(state, [(part.points_mm, part.mount) for part in arms])

    def measured_errors_mm(self, state: TaskState[SharedCut]) -> Tensor:
        """(B, 2) mm: distance of each beam's axis from its target as measured or estimated."""
        arms = [state.world.arms[name] for name in LASERS]
        return self._off_targets_mm(state, [(part.seen_mm, part.known_mount) for part in arms])

    def measured_error_mm(self, state: TaskState[SharedCut]) -> Tensor:
        """(B,) mm: the larger of the two lasers' measured errors."""
        return self.measured_errors_mm(state).amax(1)

    def _off_targets_mm(
        self, state: TaskState[SharedCut], bodies: list[tuple[Tensor, Tensor | None]]
    ) -> Tensor:
        """(B, 2) mm: bodies: key points (B, n, 3) mm and mount of each laser, see `Pointing`."""
        point, targets = self.pointing, self.targets_mm(state)
        off = [
            point[name].offset_mm(points, target, mount).norm(dim=1)
            for name, (points, mount), target in zip(LASERS, bodies, targets, strict=True)
        ]
        return torch.stack(off, 1)

    def spots_seen(self, state: TaskState[SharedCut]) -> Tensor:
        """(B, 2) bool: the endoscope sees the stretch of the ring with each laser's target."""
        measured = state.world.scene.measured
        if measured:
            return torch.stack([measured[each.name] > 0.5 for each in SPOTS_SEEN], 1)
        visible = view(state).visible
        count = visible.shape[1]
        place = [
            (state.goal.share(k, self.round) * count).floor().long() for k in range(len(LASERS))
        ]
        below = torch.stack(place, 1)
        ends = (visible.gather(1, (below + k).remainder(count)) for k in (0, 1))
        return torch.stack([*ends]).all(0)

    def beam_clearance_mm(
        self, state: TaskState[SharedCut], arms: Mapping[str, ArmPart] | None = None
    ) -> Tensor:
        """(B, 2) mm: least distance of each beam's path to its target from the other arms' skin.

        arms: their state; None: the true one.
        """
        arms, targets = arms or state.world.arms, self.targets_mm(state)
        found = [
            self.scene.path_clearance_mm(arms, name, target)
            for name, target in zip(LASERS, targets, strict=True)
        ]
        return torch.stack(found, 1)

    def fires(self, state: TaskState[SharedCut]) -> Tensor:
        """(B,) bool: some beam is released, see `released`."""
        return self.released(state).any(1)

    def released(self, state: TaskState[SharedCut]) -> Tensor:
        """(B, 2) bool: as far as is measured the beam is near its target, clear of the other arms
        and meets the organ, the endoscope sees its target and enough of the ring, and all arms
        keep the scene's clearance."""
        enough = view(state).fraction >= self.spec.limits.view_fraction
        seen = enough[:, None] & self.spots_seen(state)
        near = self.measured_errors_mm(state) <= self.config.fire_mm
        clear = self.beam_clearance_mm(state, self.measured_arms(state)) >= self.config.beam_mm
        clear = clear & self.arms_clear(state)[:, None]
        return seen & near & clear & torch.stack(self.on_organ(state, LASERS), 1)

    def advance(
        self,
        state: TaskState[SharedCut],
        actions: Mapping[str, Tensor],
        fired: Tensor | None = None,
    ) -> TaskState[SharedCut]:
        """Advance arms and tissue; a beam that is released burns for the step, and its reference
        moves on. fired: (B,) bool, where beams may be on at all; None: everywhere.
        """
        on = self.released(state)
        on = on if fired is None else on & fired[:, None]
        return self._advanced(state, actions, on)

    def advance_measured(
        self, state: TaskState[SharedCut], signals: Mapping[str, Tensor]
    ) -> TaskState[SharedCut]:
        """Advance where the beams were on or off as measured; see `MeasuredTask`."""
        on = torch.stack([signals[each.name] > 0.5 for each in BEAMS_ON], 1)
        return self._advanced(state, self.held(), on)

    def _advanced(
        self, state: TaskState[SharedCut], actions: Mapping[str, Tensor], on: Tensor
    ) -> TaskState[SharedCut]:
        power_w = {name: on[:, k] * self.spec.laser.power_w for k, name in enumerate(LASERS)}
        world = self.world.step(state.world, actions, power_w)
        return TaskState(world, state.goal.after(on))

    def blocks(self, state: TaskState[SharedCut]) -> dict[str, ObservationBlocks]:
        """Observation blocks: body and pointing error of each arm, and the state of the cut."""
        arms, cut, point = state.world.arms, state.goal, self.pointing
        tips = {name: arms[name].seen_mm[:, -1] for name in AGENTS}
        ahead = [self.targets_mm(state, k) for k in range(self.config.preview + 1)]
        clear = self.beam_clearance_mm(state, self.measured_arms(state))
        clear = clear.clamp(-20.0, 60.0) / 10.0
        lead = (cut.done[:, :1] - cut.done[:, 1:]) / self.round
        seen, fired = self.spots_seen(state).float(), cut.fired.float()
        own: dict[str, ObservationBlocks] = {}
        for k, name in enumerate(LASERS):
            at, mount = arms[name].steered_mm, arms[name].known_mount
            offsets = [point[name].offset_mm(at, targets[k], mount) for targets in ahead]
            angle = 2.0 * math.pi * cut.share(k, self.round)[:, None]
            own[name] = {
                **numbered(BEAM_ERROR, [offset.asinh() for offset in offsets]),
                RING_PLACE: torch.cat((angle.sin(), angle.cos()), 1),
                RING_DIRECTION: cut.direction[:, None],
                LEAD: lead if k == 0 else -lead,
                BEAM_CLEARANCE: clear.roll(-k, 1),
                SPOTS: seen.roll(-k, 1),
                FIRED: fired.roll(-k, 1),
            }
        eye = arms[ENDOSCOPE]
        look = point[ENDOSCOPE].offset_mm(eye.steered_mm, self.centre_mm(state), eye.known_mount)
        own[ENDOSCOPE] = {VIEW_ERROR: look.asinh(), SPOTS: seen, FIRED: fired}
        return {
            name: {
                **body_blocks(self.world.arms[name], arms[name]),
                **own[name],
                VIEW: self.reading(VIEW_FRACTION, state)[:, None],
                TIME: elapsed(state.world.steps, self.steps),
                APART: torch.cat([tips[o] - tips[name] for o in AGENTS if o != name], 1) / 50.0,
            }
            for name in AGENTS
        }

    def rewards(self, state: TaskState[SharedCut]) -> dict[str, dict[str, Tensor]]:
        """Weighted reward terms, see `RingLaserWeights` and `RingEndoscopeWeights`."""
        errors, fired = self.beam_errors_mm(state), state.goal.fired
        seen, c = view(state), self.config
        contact = (clearance(state).least_mm < self.spec.limits.clearance_mm).float()
        crossed = (self.beam_clearance_mm(state) < c.beam_mm).any(1).float()
        terms = {
            name: {
                "far": 1.0 / (1.0 + errors[:, k] / c.far_mm),
                "aim": (-errors[:, k]).exp(),
                "fine": (-errors[:, k] / c.fine_mm).exp(),
                "cut": fired[:, k].float(),
                "crossed": crossed,
                "contact": contact,
            }
            for k, name in enumerate(LASERS)
        }
        terms[ENDOSCOPE] = {
            "look": 1.0 / (1.0 + seen.axis_error_mm / c.far_mm),
            "view": seen.fraction,
            "spots": self.spots_seen(state).float().mean(1),
            "cut": fired.float().mean(1),
            "contact": contact,
        }
        return {
            agent: weighted({name: terms[agent][name] for name in term_names(weights)}, weights)
            for agent, weights in self.weights.items()
        }

    def measures(self, state: TaskState[SharedCut]) -> dict[str, Tensor]:
        """Beam errors, progress of the cut, healthy tissue burnt, view, clearances, success.

        beam_error_mm: mean true error of the beams that are on. pointing_error_mm: mean true error
        of both at every step after `approach_s`, with the beams on or off. spots_seen: share of the
        two targets in view. beam_clearance_mm: least distance of a beam's path from another arm.
        """
        errors, fired = self.beam_errors_mm(state), state.goal.fired
        ring, found = self.ring_measures(state), clearance(state)
        late = state.world.steps * self.dt_s > self.config.approach_s
        return {
            "beam_error_mm": errors.where(fired, float("nan")).nanmean(1),
            "pointing_error_mm": errors.mean(1).where(late, float("nan")),
            **ring,
            "view_fraction": view(state).fraction,
            "spots_seen": self.spots_seen(state).float().mean(1),
            "beam_clearance_mm": self.beam_clearance_mm(state).amin(1),
            "clearance_mm": found.least_mm,
            "collided": found.collides.float(),
            "success": ((ring["completion"] >= 1.0) & ~found.collides).float(),
        }

    def trace(self, state: TaskState[SharedCut]) -> tuple[Tensor, Tensor]:
        """Reference points on the ring and ends of the beams, each (B, 2, 3) mm."""
        hits = state.world.scene.hits
        ends = torch.stack([hits[name].point_mm for name in LASERS], 1)
        return torch.stack(self.targets_mm(state), 1), ends

    def script(self, state: TaskState[SharedCut]) -> dict[str, Tensor]:
        """Scripted expert: points each laser at its next target, the endoscope at the lesion."""
        targets = dict(zip(LASERS, self.targets_mm(state, 1), strict=True))
        targets[ENDOSCOPE] = self.centre_mm(state)
        point, arms = self.pointing, state.world.arms
        return {name: point[name].action(arms[name], targets[name]) for name in AGENTS}


class TwoLaserSupervision(LaserSupervision):
    """`Supervision` of two lasers: a phase that allows the beam allows both, each as released."""

    def fired(self, state: TaskState) -> Tensor:
        """(B,) bool: some beam was on in the step that led here."""
        return state.goal.fired.any(1)


TWO_LASER_RING = TaskSpec(
    TwoLaserRing,
    TwoLaserRingConfig(),
    AGENTS,
    preset=LASER_PRESET,
    training_steps=LASER_STEPS,
    experiment=replace(LASER_EXPERIMENT, supervise=TwoLaserSupervision),
    success_rule=success_rule,
)
