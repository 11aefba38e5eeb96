"""Two arms enter through the ports of a wall, then one looks at a lesion and the other cuts a ring.

Carriages feed the arms in; the agents keep the soft bodies off the rims of the ports, on the way in
and at work. The arm models know no contact forces, so touching the wall ends an episode.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.tasks.base import FEED_SIGNAL, Signal, TaskState, clearance
from surgisoft.tasks.laser_supervision import LASER_EXPERIMENT
from surgisoft.tasks.laser_work import (
    AGENTS,
    ENDOSCOPE,
    LASER,
    LASER_PRESET,
    LASER_STEPS,
    EndoscopeWeights,
    LaserConfig,
    LaserWeights,
    LaserWorkWeights,
    RingTask,
    check_config,
)
from surgisoft.tasks.observations import Block, ObservationBlocks
from surgisoft.tasks.spec import TaskSpec
from surgisoft.tasks.trajectories.closed_path import RingCut, draw_cut
from surgisoft.tasks.world.arm import Randomisation
from surgisoft.tasks.world.random_streams import Stream
from surgisoft.tasks.world.scene import PHANTOM, WALL
from surgisoft.tasks.world.world import AXIS_MM, Feed, WorldConfig

PORTS = PHANTOM / "ports.toml"
"""The liver phantom below a wall with two ports."""

OUT = Block("out", "distance by which the bases are behind their mounts", "mm", "x / 50", 0.0, 4.0)
RIM = Block(
    "rim", "least distance of the own body from the wall", "mm", "min(x, 20) / 10", -4.0, 2.0
)
CENTRED = Block("centred", "measured tip's offset from the port's axis", "mm", "asinh(x / 1 mm)")


BEHIND = Signal(
    FEED_SIGNAL, OUT.meaning, "mm", 0.0, 200.0, lambda task, before, after: task.out_mm(after)
)


def _rim(agent: str) -> Signal:
    return Signal(
        f"{agent}_rim_mm",
        f"least distance of the body of the arm `{agent}` from the wall",
        "mm",
        -40.0,
        100.0,
        lambda task, before, after: task.wall_mm(after, agent),
    )


RIMS = {agent: _rim(agent) for agent in AGENTS}
"""Arm -> what its controller has to be given of the wall."""


@dataclass(frozen=True)
class CentredWeights:
    """Weight of the place in the port; c is the distance of the own tip from the axis of its port,
    mm, while the arms enter."""

    centred: float = 5.0
    """exp(-c / centred_mm) while the arms enter, 1 afterwards."""


@dataclass(frozen=True)
class PortLaserWeights(LaserWeights, CentredWeights):
    """Weights of the laser's reward terms; e is the distance of the beam from its target, mm; c is
    the distance of the own tip from the axis of its port, mm, while the arms enter."""

    rim: float = -3.0
    """1 while the own body is nearer than rim_mm to the wall, else 0."""


@dataclass(frozen=True)
class PortEndoscopeWeights(EndoscopeWeights, CentredWeights):
    """Weights of the endoscope's reward terms; e is the distance of the camera's axis from the
    ring's centre, mm; c is the distance of the own tip from the axis of its port, mm."""

    rim: float = -3.0
    """1 while the own body is nearer than rim_mm to the wall, else 0."""


@dataclass(frozen=True)
class KeyholeAblationWeights(LaserWorkWeights):
    """Weights of the reward terms of both agents."""

    laser: PortLaserWeights = field(default_factory=PortLaserWeights)
    """Weights of the laser's reward terms."""
    endoscope: PortEndoscopeWeights = field(default_factory=PortEndoscopeWeights)
    """Weights of the endoscope's reward terms."""


@dataclass(frozen=True)
class KeyholeAblationConfig(LaserConfig):
    """The scene, the feed, the speed of the cut, the observation and the reward.

    Time and safety limits come from the scene's file.
    """

    scene: str | Path = PORTS
    """Scene with a wall whose ports the arms `laser` and `endoscope` enter: its folder or file."""
    wall: str = WALL
    """Name of the wall among the scene's bodies."""
    feed: Feed = field(default_factory=Feed)
    """How the carriages feed the arms in."""
    rim_mm: float = 1.0
    """Distance from the wall below which a body counts as at the rim, mm."""
    rim_s: float = 2.0
    """Longest time that the bodies may be at the rim in an episode that is a success, s."""
    cut_s: float = 45.0
    """Time for once around with the beam on, s."""
    approach_s: float = 18.0
    """Time at the beginning that the measure `pointing_error_mm` leaves out, s: feed and approach.
    """
    centred_mm: float = 2.0
    """Scale of the reward term `centred`, mm."""
    weights: KeyholeAblationWeights = field(default_factory=KeyholeAblationWeights)
    """Weights of the reward terms."""
    world: WorldConfig = field(
        default_factory=lambda: WorldConfig(randomisation=Randomisation(start_kPa=1.0))
    )
    """The simulator and its domain randomization."""

    def __post_init__(self):
        check_config("keyhole_ablation", self, "rim_mm", "rim_s", "cut_s", "centred_mm")


def success_rule(config: KeyholeAblationConfig) -> str:
    """Definition of success, in words; `measures` computes it."""
    return (
        f"the whole ring is cut, without contact, with at most {config.rim_s:g} s (rim_s) nearer "
        f"than {config.rim_mm:g} mm (rim_mm) to the wall; the beam is on only within "
        f"{config.fire_mm:g} mm of its target (fire_mm)"
    )


@dataclass(frozen=True, eq=False)
class PortCut(RingCut):
    """Progress of B cuts, and how long the bodies were at the rims of the ports."""

    at_rim: Tensor
    """(B,) int64: steps in which a body was at the rim."""


class KeyholeAblation(RingTask[PortCut]):
    """Two arms of a scene with a wall: agents `laser` and `endoscope`."""

    name = "keyhole_ablation"
    signals = (*RingTask.signals, BEHIND, *RIMS.values())

    def __init__(
        self, config: KeyholeAblationConfig | None = None, device: str | torch.device = "cpu"
    ):
        c = config or KeyholeAblationConfig()
        super().__init__(c, device, feed=c.feed)
        names = [body.name for body in self.spec.bodies]
        if c.wall not in names:
            raise InputError(
                f"scene '{self.spec.name}' has the bodies {', '.join(names)}, expected the wall "
                f"'{c.wall}' among them: add [[bodies]] with this name, a mesh with a port around "
                'the axis of each arm and role = "keep-out", or give the name of another body as '
                "`wall` in --config (docs/scenes.md, Walls and ports)"
            )
        self._wall = names.index(c.wall)

    def goal(self, stream: Stream) -> tuple[Stream, PortCut]:
        """Draw start and direction of the cut for each random number stream."""
        stream, cut = draw_cut(stream)
        return stream, PortCut(**vars(cut), at_rim=torch.zeros_like(stream.count))

    def out_mm(self, state: TaskState[PortCut]) -> Tensor:
        """(B,) mm: by how much the bases are behind their mounts."""
        out = state.world.out_mm
        return torch.zeros_like(state.world.steps, dtype=torch.float32) if out is None else out

    def wall_mm(self, state: TaskState[PortCut], agent: str) -> Tensor:
        """(B,) mm: least distance of an arm's body from the wall, as simulated."""
        return clearance(state).bodies_mm[:, [*self.world.arms].index(agent), self._wall]

    def rims_mm(self, state: TaskState[PortCut]) -> dict[str, Tensor]:
        """Least distance of each arm's body from the wall, by the arm's name, (B,) mm."""
        return {agent: self.reading(signal, state) for agent, signal in RIMS.items()}

    def off_axis_mm(self, agent: str, points_mm: Tensor) -> Tensor:
        """(B, 3) mm: offset of the tip of key points (B, n, 3) mm from the axis of its port."""
        pose = self.world.arms[agent].pose
        away, axis = points_mm[:, -1] - pose[:3, 3], pose[:3, 2]
        return away - (away @ axis)[:, None] * axis

    def fires(self, state: TaskState[PortCut]) -> Tensor:
        """(B,) bool: whether the beam would be on: where the arms are in, and it is `released`."""
        return (self.out_mm(state) <= 0.0) & self.released(state)

    def advance(
        self,
        state: TaskState[PortCut],
        actions: Mapping[str, Tensor],
        fired: Tensor | None = None,
    ) -> TaskState[PortCut]:
        """Advance one step, and count the steps in which a body is at the rim."""
        after = super().advance(state, actions, fired)
        near = torch.stack([*self.rims_mm(after).values()]).amin(0) < self.config.rim_mm
        return replace(after, goal=replace(after.goal, at_rim=after.goal.at_rim + near))

    def shared_blocks(self, state: TaskState[PortCut]) -> ObservationBlocks:
        """By how much the bases are behind their mounts."""
        return {OUT: self.out_mm(state)[:, None] / 50.0}

    def blocks(self, state: TaskState[PortCut]) -> dict[str, ObservationBlocks]:
        """Observation blocks: body, pointing error and place in the port of each arm, the cut."""
        rims, arms = self.rims_mm(state), state.world.arms
        return {
            agent: {
                **blocks,
                RIM: rims[agent][:, None].clamp(-40.0, 20.0) / 10.0,
                CENTRED: self.off_axis_mm(agent, arms[agent].steered_mm).asinh(),
            }
            for agent, blocks in super().blocks(state).items()
        }

    def own_terms(self, state: TaskState[PortCut]) -> dict[str, dict[str, Tensor]]:
        """The terms of `PortLaserWeights` and `PortEndoscopeWeights`."""
        entering, rims, c = self.out_mm(state) > 0.0, self.rims_mm(state), self.config
        own = {}
        for agent in self.agents:
            off = self.off_axis_mm(agent, state.world.arms[agent].points_mm).norm(dim=1)
            centred = (-off / c.centred_mm).exp()
            own[agent] = {
                "centred": centred.where(entering, torch.ones_like(centred)),
                "rim": (rims[agent] < c.rim_mm).float(),
            }
        return own

    def ended(self, state: TaskState[PortCut]) -> Tensor:
        """When the ring is cut all around, or an arm touches the wall, a body, the other arm or
        itself."""
        return super().ended(state)

    def measures(self, state: TaskState[PortCut]) -> dict[str, Tensor]:
        """Beam error, progress of the cut, healthy tissue burnt, place in the ports, view, success.

        rim_mm: least distance of both bodies from the wall. at_rim_s: time at the rim so far.
        """
        ring = self.ring_measures(state)
        at_rim_s = state.goal.at_rim * self.dt_s
        in_time = at_rim_s <= self.config.rim_s + 0.5 * self.dt_s
        return {
            **self.errors(state),
            **ring,
            "rim_mm": torch.stack([*self.rims_mm(state).values()]).amin(0),
            "at_rim_s": at_rim_s,
            **self.safety(state, (ring["completion"] >= 1.0) & in_time),
        }

    def script(self, state: TaskState[PortCut]) -> dict[str, Tensor]:
        """Scripted expert: keeps each arm straight on its port's axis while the arms enter; then
        points the laser at its next target, the endoscope at the lesion."""
        entering = self.out_mm(state) > 0.0
        targets = {LASER: self.target_mm(state, 1), ENDOSCOPE: self.watched_mm(state)}
        for agent, target in targets.items():
            pose = self.world.arms[agent].pose
            ahead = (pose[:3, 3] + AXIS_MM * pose[:3, 2]).expand_as(target)
            targets[agent] = torch.where(entering[:, None], ahead, target)
        return self.pointed(state, *targets.values())


KEYHOLE_ABLATION = TaskSpec(
    KeyholeAblation,
    KeyholeAblationConfig(),
    AGENTS,
    preset=LASER_PRESET,
    training_steps=LASER_STEPS,
    experiment=LASER_EXPERIMENT,
    success_rule=success_rule,
)
