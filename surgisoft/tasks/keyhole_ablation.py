"""Two arms enter through the ports of a wall, then one looks at a lesion and the other cuts a ring.

Carriages feed the arms in; the agents keep the soft bodies off the rims of the ports, on the way in
and at work. The arm models know no contact forces, so touching the wall ends an episode.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.tasks import laser_work
from surgisoft.tasks.base import TaskSpec, TaskState
from surgisoft.tasks.circle_ablation import RING_DIRECTION, RING_PLACE
from surgisoft.tasks.inverse_kinematics import Pointing
from surgisoft.tasks.laser_supervision import LASER_EXPERIMENT
from surgisoft.tasks.observations import Block, ObservationBlocks, joined
from surgisoft.tasks.trajectories.closed_path import RingCut, draw_cut, point_on_closed
from surgisoft.tasks.world.arm import Randomisation
from surgisoft.tasks.world.random_streams import Stream
from surgisoft.tasks.world.scene import PHANTOM
from surgisoft.tasks.world.world import Feed, WorldConfig, scene_world

PORTS = PHANTOM / "ports.toml"
"""The liver phantom below a wall with two ports."""
AXIS_MM = 1000.0
"""Distance along a port's axis at which the scripted expert aims while the arms enter, mm."""

OUT = Block("out", "distance by which the bases are behind their mounts", "mm", "x / 50", 0.0, 4.0)
RIM = Block(
    "rim", "least distance of the own body from the wall", "mm", "min(x, 20) / 10", -4.0, 2.0
)
CENTRED = Block("centred", "measured tip's offset from the port's axis", "mm", "asinh(x / 1 mm)")


@dataclass(frozen=True)
class PortLaserWeights:
    """Weights of the laser's reward terms; e is the distance of the beam from its target, mm; c is
    the distance of the own tip from the axis of its port, mm, while the arms enter."""

    centred: float = 5.0
    """exp(-c / centred_mm) while the arms enter, 1 afterwards."""
    far: float = 1.0
    """1 / (1 + e / far_mm)."""
    aim: float = 1.0
    """exp(-e / 1 mm)."""
    fine: float = 1.0
    """exp(-e / fine_mm)."""
    cut: float = 1.0
    """1 while the beam is on, else 0."""
    rim: float = -3.0
    """1 while the own body is nearer than rim_mm to the wall, else 0."""
    contact: float = -1.0
    """1 while the clearance of any arm is below the scene's limit, else 0."""


@dataclass(frozen=True)
class PortEndoscopeWeights:
    """Weights of the endoscope's reward terms; e is the distance of the camera's axis from the
    ring's centre, mm; c is the distance of the own tip from the axis of its port, mm."""

    centred: float = 5.0
    """exp(-c / centred_mm) while the arms enter, 1 afterwards."""
    look: float = 1.0
    """1 / (1 + e / far_mm)."""
    view: float = 1.0
    """Share of what is to be seen that the endoscope sees."""
    cut: float = 1.0
    """1 while the beam is on, else 0."""
    rim: float = -3.0
    """1 while the own body is nearer than rim_mm to the wall, else 0."""
    contact: float = -1.0
    """1 while the clearance of any arm is below the scene's limit, else 0."""


@dataclass(frozen=True)
class KeyholeAblationWeights:
    """Weights of the reward terms of both agents."""

    laser: PortLaserWeights = field(default_factory=PortLaserWeights)
    """Weights of the laser's reward terms."""
    endoscope: PortEndoscopeWeights = field(default_factory=PortEndoscopeWeights)
    """Weights of the endoscope's reward terms."""


@dataclass(frozen=True)
class KeyholeAblationConfig:
    """The scene, the feed, the speed of the cut, the observation and the reward.

    Time and safety limits come from the scene's file.
    """

    scene: str | Path = PORTS
    """Scene with a wall whose ports the arms `laser` and `endoscope` enter: its folder or file."""
    wall: str = "wall"
    """Name of the wall among the scene's bodies."""
    arm: str | Path | None = None
    """Arm model of both arms: `default`, or a folder; None: the models that the scene names."""
    feed: Feed = field(default_factory=Feed)
    """How the carriages feed the arms in."""
    rim_mm: float = 1.0
    """Distance from the wall below which a body counts as at the rim, mm."""
    rim_s: float = 2.0
    """Longest time that the bodies may be at the rim in an episode that is a success, s."""
    cut_s: float = 45.0
    """Time for once around with the beam on, s."""
    fire_mm: float = 0.5
    """Measured distance of the beam from its target within which the beam is switched on, mm."""
    approach_s: float = 18.0
    """Time at the beginning that the measure `pointing_error_mm` leaves out, s: feed and approach.
    """
    centred_mm: float = 2.0
    """Scale of the reward term `centred`, mm."""
    fine_mm: float = 0.1
    """Scale of the reward term `fine`, mm."""
    far_mm: float = 10.0
    """Scale of the reward terms `far` and `look`, mm."""
    weights: KeyholeAblationWeights = field(default_factory=KeyholeAblationWeights)
    """Weights of the reward terms."""
    preview: int = 2
    """Future targets in the laser's observation, one per step (a count)."""
    world: WorldConfig = field(
        default_factory=lambda: WorldConfig(randomisation=Randomisation(start_kPa=1.0))
    )
    """The simulator and its domain randomization."""

    def __post_init__(self):
        positive = ("rim_mm", "rim_s", "cut_s", "fire_mm", "approach_s", "centred_mm")
        positive = (*positive, "fine_mm", "far_mm", "preview")
        laser_work.check_config("keyhole_ablation", self, positive)


def success_rule(config: KeyholeAblationConfig) -> str:
    """What an episode needs to be a success, in words; `measures` computes it."""
    return (
        f"the whole ring is cut, without contact, with at most {config.rim_s:g} s (rim_s) nearer "
        f"than {config.rim_mm:g} mm (rim_mm) to the wall; the beam is on only within "
        f"{config.fire_mm:g} mm of its target (fire_mm)"
    )


@dataclass(frozen=True, eq=False)
class PortCut:
    """Progress of B cuts, and how long the bodies were at the rims of the ports."""

    cut: RingCut
    """The cut around the ring."""
    at_rim: Tensor
    """(B,) int64: steps in which a body was at the rim."""

    @property
    def fired(self) -> Tensor:
        """(B,) bool: the beam was on in the last step."""
        return self.cut.fired


class KeyholeAblation:
    """Two arms of a scene with a wall: agents `laser` and `endoscope`."""

    name, agents = "keyhole_ablation", laser_work.AGENTS

    def __init__(
        self, config: KeyholeAblationConfig | None = None, device: str | torch.device = "cpu"
    ):
        c = self.config = config or KeyholeAblationConfig()
        self.world = scene_world(
            c.scene, c.world, device, arm=c.arm, agents=self.agents, feed=c.feed
        )
        self.scene, self.dt_s = self.world.scene, self.world.config.dt_s
        self.spec = self.scene.spec
        names = [body.name for body in self.spec.bodies]
        if c.wall not in names:
            raise InputError(
                f"scene '{self.spec.name}' has the bodies {', '.join(names)}, expected the wall "
                f"'{c.wall}' among them"
            )
        self.steps = round(self.spec.limits.time_s / self.dt_s)
        self.round = round(c.cut_s / self.dt_s)
        self.weights = {agent: getattr(c.weights, agent) for agent in self.agents}
        self._wall = names.index(c.wall)

    @property
    def pointing(self) -> dict[str, Pointing]:
        """Inverse kinematics of each arm's axis, by the arm's name."""
        return laser_work.pointing(self)

    def goal(self, stream: Stream) -> tuple[Stream, PortCut]:
        """Draw start and direction of the cut for each random number stream."""
        stream, cut = draw_cut(stream)
        return stream, PortCut(cut, torch.zeros_like(stream.count))

    def target_mm(self, state: TaskState[PortCut], ahead: int = 0) -> Tensor:
        """(B, 3) mm: the reference point on the ring `ahead` steps further on."""
        share = state.goal.cut.share(self.round, ahead)
        return point_on_closed(self.scene.paths_mm, state.world.scene.lesion, share)

    def watched_mm(self, state: TaskState[PortCut]) -> Tensor:
        """(B, 3) mm: the lesion's centre."""
        return self.scene.centres_mm[state.world.scene.lesion]

    def out_mm(self, state: TaskState[PortCut]) -> Tensor:
        """(B,) mm: by how much the bases are behind their mounts."""
        out = state.world.out_mm
        return torch.zeros_like(state.world.steps, dtype=torch.float32) if out is None else out

    def rims_mm(self, state: TaskState[PortCut]) -> dict[str, Tensor]:
        """Least distance of each arm's body from the wall, by the arm's name, (B,) mm."""
        bodies = state.world.scene.clearance.bodies_mm
        return {name: bodies[:, k, self._wall] for k, name in enumerate(self.world.arms)}

    def off_axis_mm(self, agent: str, points_mm: Tensor) -> Tensor:
        """(B, 3) mm: offset of the tip of key points (B, n, 3) mm from the axis of its port."""
        pose = self.world.arms[agent].pose
        away, axis = points_mm[:, -1] - pose[:3, 3], pose[:3, 2]
        return away - (away @ axis)[:, None] * axis

    def fires(self, state: TaskState[PortCut]) -> Tensor:
        """(B,) bool: the arms are in, and the beam is released, see `laser_work.beam_released`."""
        return (self.out_mm(state) <= 0.0) & laser_work.beam_released(self, state)

    def advance(
        self,
        state: TaskState[PortCut],
        actions: Mapping[str, Tensor],
        fired: Tensor | None = None,
    ) -> TaskState[PortCut]:
        """Advance arms and tissue; where `fired` (B,) bool is set the beam burns for the step and
        the reference moves on. None: where `fires` holds.
        """
        fired = self.fires(state) if fired is None else fired
        power_w = {laser_work.LASER: fired * self.spec.laser.power_w}
        world = self.world.step(state.world, actions, power_w)
        after = TaskState(world, replace(state.goal, cut=state.goal.cut.after(fired)))
        near = torch.stack([*self.rims_mm(after).values()]).amin(0) < self.config.rim_mm
        return replace(after, goal=replace(after.goal, at_rim=after.goal.at_rim + near))

    def blocks(self, state: TaskState[PortCut]) -> dict[str, ObservationBlocks]:
        """Observation blocks: body, pointing error and place in the port of each arm, the cut."""
        cut = state.goal.cut
        angle = 2.0 * math.pi * cut.share(self.round)[:, None]
        ring = {
            RING_PLACE: torch.cat((angle.sin(), angle.cos()), 1),
            RING_DIRECTION: cut.direction[:, None],
        }
        found = laser_work.blocks(self, state, ring, {OUT: self.out_mm(state)[:, None] / 50.0})
        rims, arms = self.rims_mm(state), state.world.arms
        return {
            agent: {
                **blocks,
                RIM: rims[agent][:, None].clamp(-40.0, 20.0) / 10.0,
                CENTRED: self.off_axis_mm(agent, arms[agent].seen_mm).asinh(),
            }
            for agent, blocks in found.items()
        }

    def observe(self, state: TaskState[PortCut]) -> dict[str, Tensor]:
        """Concatenated observation blocks, agent -> (B, D)."""
        return {agent: joined(blocks) for agent, blocks in self.blocks(state).items()}

    def rewards(self, state: TaskState[PortCut]) -> dict[str, dict[str, Tensor]]:
        """Weighted reward terms, see `PortLaserWeights` and `PortEndoscopeWeights`."""
        entering, rims, c = self.out_mm(state) > 0.0, self.rims_mm(state), self.config
        own = {}
        for agent in self.agents:
            off = self.off_axis_mm(agent, state.world.arms[agent].points_mm).norm(dim=1)
            centred = (-off / c.centred_mm).exp()
            own[agent] = {
                "centred": centred.where(entering, torch.ones_like(centred)),
                "rim": (rims[agent] < c.rim_mm).float(),
            }
        return laser_work.rewards(self, state, of_agent=own)

    def ended(self, state: TaskState[PortCut]) -> Tensor:
        """When the ring is cut all around, or an arm touches the wall, a body, the other arm or
        itself."""
        done = self.scene.ablation.report(state.world.scene.dose).completion >= 1.0
        return done | state.world.scene.clearance.collides

    def measures(self, state: TaskState[PortCut]) -> dict[str, Tensor]:
        """Beam error, progress of the cut, healthy tissue burnt, place in the ports, view, success.

        rim_mm: least distance of both bodies from the wall. at_rim_s: time at the rim so far.
        """
        ring = self.scene.ablation.report(state.world.scene.dose)
        at_rim_s = state.goal.at_rim * self.dt_s
        done = (ring.completion >= 1.0) & (at_rim_s <= self.config.rim_s + 0.5 * self.dt_s)
        return {
            **laser_work.errors(self, state),
            "completion": ring.completion,
            "largest_gap_mm": ring.largest_gap_mm,
            "healthy_mm2": ring.healthy_mm2,
            "rim_mm": torch.stack([*self.rims_mm(state).values()]).amin(0),
            "at_rim_s": at_rim_s,
            **laser_work.safety(state, done),
        }

    def trace(self, state: TaskState[PortCut]) -> tuple[Tensor, Tensor]:
        """Reference point on the ring and end of the beam, each (B, 1, 3) mm."""
        end = state.world.scene.hits[laser_work.LASER].point_mm
        return self.target_mm(state)[:, None], end[:, None]

    def script(self, state: TaskState[PortCut]) -> dict[str, Tensor]:
        """Scripted expert: keeps each arm straight on its port's axis while the arms enter; then
        points the laser at its next target, the endoscope at the lesion."""
        entering = self.out_mm(state) > 0.0
        targets = {
            laser_work.LASER: self.target_mm(state, 1),
            laser_work.ENDOSCOPE: self.watched_mm(state),
        }
        for agent, target in targets.items():
            pose = self.world.arms[agent].pose
            ahead = (pose[:3, 3] + AXIS_MM * pose[:3, 2]).expand_as(target)
            targets[agent] = torch.where(entering[:, None], ahead, target)
        return laser_work.script(self, state, *targets.values())


KEYHOLE_ABLATION = TaskSpec(
    KeyholeAblation,
    KeyholeAblationConfig(),
    laser_work.AGENTS,
    preset={
        "rollout": 16,
        "last_noise": 0.05,
        "evaluate_every": 50,
        "evaluation_episodes": 16,
    },
    training_steps=1_500_000,
    experiment=LASER_EXPERIMENT,
    success_rule=success_rule,
)
