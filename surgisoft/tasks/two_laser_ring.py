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
from surgisoft.tasks.base import TaskSpec, TaskState, check_weights, weighted
from surgisoft.tasks.circle_ablation import RING_DIRECTION, RING_PLACE
from surgisoft.tasks.laser_supervision import LASER_EXPERIMENT, LaserSupervision
from surgisoft.tasks.laser_work import BEAM_ERROR, VIEW, VIEW_ERROR, arms_clear, pointing
from surgisoft.tasks.observations import (
    TIME,
    Block,
    ObservationBlocks,
    body_blocks,
    joined,
    numbered,
)
from surgisoft.tasks.trajectories.closed_path import draw_traversal, point_on_closed
from surgisoft.tasks.world.arm import ArmPart
from surgisoft.tasks.world.random_streams import Stream
from surgisoft.tasks.world.scene import PHANTOM
from surgisoft.tasks.world.world import WorldConfig, scene_world

LASERS = ("laser_1", "laser_2")
ENDOSCOPE = "endoscope"
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


@dataclass(frozen=True)
class RingLaserWeights:
    """Weights of a laser's reward terms; e is the distance of its beam from its target, mm."""

    far: float = 1.0
    """1 / (1 + e / far_mm)."""
    aim: float = 1.0
    """exp(-e / 1 mm)."""
    fine: float = 1.0
    """exp(-e / fine_mm)."""
    cut: float = 1.0
    """1 while the own beam is on, else 0."""
    crossed: float = -1.0
    """1 while the path of either beam comes nearer than beam_mm to another arm, else 0."""
    contact: float = -1.0
    """1 while the clearance of any arm is below the scene's limit, else 0."""


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
class TwoLaserRingConfig:
    """The scene, the speed of the cut, the observation and the reward.

    Time and safety limits come from the scene's file.
    """

    scene: str | Path = TWO_LASERS
    """Scene with the arms `laser_1`, `laser_2` and `endoscope`: its folder or file."""
    arm: str | Path | None = None
    """Arm model of all arms: `default`, or a folder; None: the models that the scene names."""
    cut_s: float = 45.0
    """Time in which one laser would go once around with its beam on, s; two share the ring."""
    fire_mm: float = 0.5
    """Measured distance of a beam from its target within which the beam is switched on, mm."""
    beam_mm: float = 3.0
    """Distance of a beam's path from the skin of another arm below which the beam stays off, mm."""
    approach_s: float = 5.0
    """Time at the beginning that the measure `pointing_error_mm` leaves out, s."""
    fine_mm: float = 0.1
    """Scale of the reward term `fine`, mm."""
    far_mm: float = 10.0
    """Scale of the reward terms `far` and `look`, mm."""
    weights: TwoLaserRingWeights = field(default_factory=TwoLaserRingWeights)
    """Weights of the reward terms."""
    preview: int = 2
    """Future targets in a laser's observation, one per step (a count)."""
    world: WorldConfig = field(default_factory=WorldConfig)
    """The simulator and its domain randomization."""

    def __post_init__(self):
        names = ("cut_s", "fire_mm", "beam_mm", "approach_s", "fine_mm", "far_mm", "preview")
        for name in names:
            if not getattr(self, name) > 0:
                raise InputError(f"two_laser_ring: {name} is {getattr(self, name)}, expected > 0")
        for agent in AGENTS:
            check_weights(f"two_laser_ring: {agent}", getattr(self.weights, agent))


def success_rule(config: TwoLaserRingConfig) -> str:
    """What an episode needs to be a success, in words; `measures` computes it."""
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


class TwoLaserRing:
    """Three arms of a scene: agents `laser_1`, `laser_2` and `endoscope`."""

    name, agents = "two_laser_ring", AGENTS

    def __init__(
        self, config: TwoLaserRingConfig | None = None, device: str | torch.device = "cpu"
    ):
        c = self.config = config or TwoLaserRingConfig()
        self.world = scene_world(c.scene, c.world, device, arm=c.arm, agents=self.agents)
        self.scene, self.dt_s = self.world.scene, self.world.config.dt_s
        self.spec = self.scene.spec
        if self.scene.lasers != LASERS or self.scene.endoscopes != (ENDOSCOPE,):
            raise InputError(
                f"scene '{self.spec.name}' has the lasers {', '.join(self.scene.lasers)} and the "
                f"endoscopes {', '.join(self.scene.endoscopes)}; two_laser_ring expects "
                f"{' and '.join(LASERS)}, and {ENDOSCOPE}"
            )
        self.steps = round(self.spec.limits.time_s / self.dt_s)
        self.round = round(c.cut_s / self.dt_s)
        self.weights = {agent: getattr(c.weights, agent) for agent in AGENTS}

    def goal(self, stream: Stream) -> tuple[Stream, SharedCut]:
        """Draw start and direction of the cut for each random number stream."""
        stream, way = draw_traversal(stream, anywhere=True)
        done = torch.zeros_like(stream.count)[:, None].expand(-1, len(LASERS)).clone()
        return stream, SharedCut(way.start, way.direction, done, done > 0)

    def targets_mm(self, state: TaskState[SharedCut], ahead: int = 0) -> list[Tensor]:
        """(B, 3) mm for each laser: its reference point on the ring `ahead` steps further on."""
        lesion = state.world.scene.lesion
        shares = (state.goal.share(k, self.round, ahead) for k in range(len(LASERS)))
        return [point_on_closed(self.scene.paths_mm, lesion, share) for share in shares]

    def centre_mm(self, state: TaskState[SharedCut]) -> Tensor:
        """(B, 3) mm: the lesion's centre."""
        return self.scene.centres_mm[state.world.scene.lesion]

    def beam_errors_mm(self, state: TaskState[SharedCut]) -> Tensor:
        """(B, 2) mm: true perpendicular distance of each beam's axis from its target."""
        return self._off_targets_mm(state, [state.world.arms[n].points_mm for n in LASERS])

    def measured_errors_mm(self, state: TaskState[SharedCut]) -> Tensor:
        """(B, 2) mm: distance of each beam's axis from its target as measured or estimated."""
        return self._off_targets_mm(state, [state.world.arms[n].seen_mm for n in LASERS])

    def measured_error_mm(self, state: TaskState[SharedCut]) -> Tensor:
        """(B,) mm: the larger of the two lasers' measured errors."""
        return self.measured_errors_mm(state).amax(1)

    def _off_targets_mm(self, state: TaskState[SharedCut], points_mm: list[Tensor]) -> Tensor:
        point, targets = pointing(self), self.targets_mm(state)
        off = [
            point[name].offset_mm(points, target).norm(dim=1)
            for name, points, target in zip(LASERS, points_mm, targets, strict=True)
        ]
        return torch.stack(off, 1)

    def spots_seen(self, state: TaskState[SharedCut]) -> Tensor:
        """(B, 2) bool: the endoscope sees the stretch of the ring with each laser's target."""
        visible = state.world.scene.views[ENDOSCOPE].visible
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

    def _measured_arms(self, state: TaskState[SharedCut]) -> Mapping[str, ArmPart]:
        """The arms with their bodies where they are measured; the state itself where exact."""
        arms = state.world.arms
        if all(torch.equal(part.seen_mm, part.points_mm) for part in arms.values()):
            return arms
        return {
            name: self.world.arms[name].posed(part, part.seen_mm) for name, part in arms.items()
        }

    def fires(self, state: TaskState[SharedCut]) -> Tensor:
        """(B,) bool: some beam is released, see `released`."""
        return self.released(state).any(1)

    def released(self, state: TaskState[SharedCut]) -> Tensor:
        """(B, 2) bool: as far as is measured the beam is near its target, clear of the other arms
        and meets the organ, the endoscope sees its target and enough of the ring, and all arms
        keep the scene's clearance."""
        fraction = state.world.scene.views[ENDOSCOPE].fraction
        seen = (fraction >= self.spec.limits.view_fraction)[:, None] & self.spots_seen(state)
        near = self.measured_errors_mm(state) <= self.config.fire_mm
        arms, hits = self._measured_arms(state), state.world.scene.hits
        exact = arms is state.world.arms  # the rays were cast already
        hit = [hits[n] if exact else self.scene.aimed(arms, n) for n in LASERS]
        clear = self.beam_clearance_mm(state, arms) >= self.config.beam_mm
        clear = clear & arms_clear(self, state)[:, None]
        return seen & near & clear & torch.stack([one.on_organ for one in hit], 1)

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
        power_w = {name: on[:, k] * self.spec.laser.power_w for k, name in enumerate(LASERS)}
        world = self.world.step(state.world, actions, power_w)
        return TaskState(world, state.goal.after(on))

    def blocks(self, state: TaskState[SharedCut]) -> dict[str, ObservationBlocks]:
        """Observation blocks: body and pointing error of each arm, and the state of the cut."""
        arms, scene, cut = state.world.arms, state.world.scene, state.goal
        point, tips = pointing(self), {name: arms[name].seen_mm[:, -1] for name in AGENTS}
        ahead = [self.targets_mm(state, k) for k in range(self.config.preview + 1)]
        clear = self.beam_clearance_mm(state, self._measured_arms(state))
        clear = clear.clamp(-20.0, 60.0) / 10.0
        lead = (cut.done[:, :1] - cut.done[:, 1:]) / self.round
        seen, fired = self.spots_seen(state).float(), cut.fired.float()
        own: dict[str, ObservationBlocks] = {}
        for k, name in enumerate(LASERS):
            at = arms[name].seen_mm
            offsets = [point[name].offset_mm(at, targets[k]) for targets in ahead]
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
        look = point[ENDOSCOPE].offset_mm(arms[ENDOSCOPE].seen_mm, self.centre_mm(state))
        own[ENDOSCOPE] = {VIEW_ERROR: look.asinh(), SPOTS: seen, FIRED: fired}
        return {
            name: {
                **body_blocks(self.world.arms[name], arms[name]),
                **own[name],
                VIEW: scene.views[ENDOSCOPE].fraction[:, None],
                TIME: state.world.steps[:, None] / self.steps,
                APART: torch.cat([tips[o] - tips[name] for o in AGENTS if o != name], 1) / 50.0,
            }
            for name in AGENTS
        }

    def observe(self, state: TaskState[SharedCut]) -> dict[str, Tensor]:
        """Concatenated observation blocks, agent -> (B, D)."""
        return {agent: joined(blocks) for agent, blocks in self.blocks(state).items()}

    def rewards(self, state: TaskState[SharedCut]) -> dict[str, dict[str, Tensor]]:
        """Weighted reward terms, see `RingLaserWeights` and `RingEndoscopeWeights`."""
        errors, scene, fired = self.beam_errors_mm(state), state.world.scene, state.goal.fired
        view, c = scene.views[ENDOSCOPE], self.config
        contact = (scene.clearance.least_mm < self.spec.limits.clearance_mm).float()
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
            "look": 1.0 / (1.0 + view.axis_error_mm / c.far_mm),
            "view": view.fraction,
            "spots": self.spots_seen(state).float().mean(1),
            "cut": fired.float().mean(1),
            "contact": contact,
        }
        return {agent: weighted(terms[agent], self.weights[agent]) for agent in AGENTS}

    def ended(self, state: TaskState[SharedCut]) -> Tensor:
        """When the ring is cut all around, or an arm touches a body, another arm or itself."""
        done = self.scene.ablation.report(state.world.scene.dose).completion >= 1.0
        return done | state.world.scene.clearance.collides

    def measures(self, state: TaskState[SharedCut]) -> dict[str, Tensor]:
        """Beam errors, progress of the cut, healthy tissue burnt, view, clearances, success.

        beam_error_mm: mean true error of the beams that are on. pointing_error_mm: mean true error
        of both at every step after `approach_s`, with the beams on or off. spots_seen: share of the
        two targets in view. beam_clearance_mm: least distance of a beam's path from another arm.
        """
        scene, errors, fired = state.world.scene, self.beam_errors_mm(state), state.goal.fired
        ring, hit = self.scene.ablation.report(scene.dose), scene.clearance.collides
        late = state.world.steps * self.dt_s > self.config.approach_s
        return {
            "beam_error_mm": errors.where(fired, float("nan")).nanmean(1),
            "pointing_error_mm": errors.mean(1).where(late, float("nan")),
            "completion": ring.completion,
            "largest_gap_mm": ring.largest_gap_mm,
            "healthy_mm2": ring.healthy_mm2,
            "view_fraction": scene.views[ENDOSCOPE].fraction,
            "spots_seen": self.spots_seen(state).float().mean(1),
            "beam_clearance_mm": self.beam_clearance_mm(state).amin(1),
            "clearance_mm": scene.clearance.least_mm,
            "collided": hit.float(),
            "success": ((ring.completion >= 1.0) & ~hit).float(),
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
        point, arms = pointing(self), state.world.arms
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
    preset={
        "rollout": 16,
        "last_noise": 0.05,
        "evaluate_every": 50,
        "evaluation_episodes": 16,
    },
    training_steps=1_500_000,
    experiment=replace(LASER_EXPERIMENT, supervise=TwoLaserSupervision),
    success_rule=success_rule,
)
