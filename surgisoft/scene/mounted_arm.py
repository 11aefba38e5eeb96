"""An arm at its mount: a laser around the ring, an endoscope turned to the lesion, a tip at it.

The search of mounts evaluates thousands of mounts with these functions and the batched engine;
`check` confirms the chosen ones with FCL. Everything is in the world frame.
"""

from dataclasses import dataclass

import numpy as np

from surgisoft.scene import frames
from surgisoft.scene.lesion import Ring
from surgisoft.scene.reach import ArmReach, nearest_commands, solve_aim, solve_touch
from surgisoft.scene.spec import CameraSpec, LaserSpec, MountSpec

LANDED_MM = 0.3
"""The beam hits a point of the surface if it ends this near (mm): half the laser's spot."""
APPROACH_STEPS = 24
"""Steps in which the path from rest to the lesion is checked."""
TOUCH_STEPS = 96
"""Steps in which the path of a plain tip is checked, which ends close to the organ."""
TOUCH_GAP_MM = 0.5
"""A plain tip has reached the lesion where its skin is this far beyond the scene's least clearance
from the surface (mm): the last stretch is the contact itself."""
AXIS_MM = 1000.0
"""Distance along its base's axis at which an arm that is fed in straight aims (mm)."""
FEED_MM = 80.0
"""Way along its axis by which a carriage feeds an arm in through a port (mm)."""
FEED_STEP_MM = 2.0
"""Spacing of the places of the base in which the way in is checked (mm)."""
TOUCHED_MM = 0.5
"""Largest distance of a tip from the place to which it is sent (mm)."""


@dataclass(frozen=True, eq=False)
class MountedArm:
    """An arm at its mount."""

    reach: ArmReach
    """Shapes that the arm can take, base frame."""
    pose: np.ndarray
    """(4, 4) base frame to world frame, mm."""
    shaft_mm: float
    """Straight shaft behind the base (mm)."""

    @classmethod
    def at(cls, mount: MountSpec, reach: ArmReach) -> "MountedArm":
        """The arm at the mount that the scene file defines."""
        return cls(reach, mount.pose(), mount.shaft_mm)

    def lines(self, commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Centrelines (M, K or K + 1, 3) mm with the shaft, tip directions (M, 3); world frame."""
        line, direction = self.reach.shapes(commands)
        return placed(line, self.pose, self.shaft_mm), frames.rotate(self.pose, direction)

    def inward(self, points_mm: np.ndarray) -> np.ndarray:
        """World points (M, 3) mm in the base frame."""
        return frames.apply(frames.invert(self.pose), points_mm)

    def approach(self, commands: np.ndarray, steps: int = APPROACH_STEPS) -> np.ndarray:
        """Commands (steps, P) in a straight line from rest to `commands` (P,)."""
        share = np.linspace(0.0, 1.0, steps)[:, None]
        return (1.0 - share) * self.reach.rest + share * commands

    def way_in(self) -> np.ndarray:
        """Centrelines (M, K or K + 1, 3) mm with the shaft, world frame: the arm as straight as the
        scripted expert holds it, fed in by FEED_MM to its mount in steps of FEED_STEP_MM."""
        ahead = np.array([[0.0, 0.0, AXIS_MM]])
        straight = solve_aim(self.reach, ahead, np.asarray(self.reach.rest)[None]).commands
        behind = np.arange(FEED_MM, -FEED_STEP_MM / 2.0, -FEED_STEP_MM)
        return self.lines(straight)[0] - behind[:, None, None] * self.pose[:3, 2]


def placed(lines_mm: np.ndarray, poses: np.ndarray, shaft_mm: float) -> np.ndarray:
    """Centrelines (..., K, 3) mm from base to world frame, starting at the shaft's far end."""
    if shaft_mm > 0.0:
        end = np.zeros_like(lines_mm[..., :1, :])
        end[..., 2] = -shaft_mm
        lines_mm = np.concatenate((end, lines_mm), axis=-2)
    return frames.apply(poses, lines_mm)


@dataclass(frozen=True, eq=False)
class RingSolution:
    """Inverse kinematics of the laser arm for M ring points.

    For a point out of reach the commands are those that come nearest.
    """

    centre: np.ndarray
    """(P,) commands with the beam on the lesion's centre; initial guess for all ring points."""
    commands: np.ndarray
    """(M, P) commands with the beam on each ring point."""
    lines_mm: np.ndarray
    """(M, K, 3) centrelines, world frame, shaft included."""
    directions: np.ndarray
    """(M, 3) of the beam."""
    in_reach: np.ndarray
    """(M,) bool: the axis meets the point at an allowed distance."""
    missed_mm: np.ndarray
    """(M,) by how much the axis runs past the point, and the point is beyond the allowed distances
    (mm), as the root of the sum of squares."""
    standoff_mm: np.ndarray
    """(M,) from the tip to the point (mm)."""
    incidence_rad: np.ndarray
    """(M,) between beam and surface normal (rad)."""
    steep: np.ndarray
    """(M,) bool: incidence beyond the limit."""
    step_mm: np.ndarray
    """(M,) farthest that any point of the arm moves to the next ring point (mm)."""


def solve_ring(arm: MountedArm, ring: Ring, laser: LaserSpec) -> RingSolution:
    """Solve the inverse kinematics of the laser arm for every ring point."""
    start = nearest_commands(arm.reach, arm.inward(ring.centre_mm[None]), laser.standoff_mm)
    centre = solve_aim(arm.reach, arm.inward(ring.centre_mm[None]), start).commands[0]
    count = len(ring.points_mm)
    aimed = solve_aim(arm.reach, arm.inward(ring.points_mm), np.tile(centre, (count, 1)))
    lines, directions = arm.lines(aimed.commands)
    low, high = laser.standoff_mm
    incidence = frames.angle_between(-directions, ring.normals)
    away = ring.points_mm - lines[:, -1]
    aside = frames.norm(away - frames.dot(away, directions)[:, None] * directions)
    beyond = aimed.ahead_mm - aimed.ahead_mm.clip(low, high)
    return RingSolution(
        centre=centre,
        commands=aimed.commands,
        lines_mm=lines,
        directions=directions,
        in_reach=aimed.on_target & (aimed.ahead_mm >= low) & (aimed.ahead_mm <= high),
        missed_mm=np.hypot(aside, beyond),
        standoff_mm=aimed.ahead_mm,
        incidence_rad=incidence,
        steep=incidence > np.radians(laser.max_incidence_deg),
        step_mm=np.linalg.norm(np.roll(lines, -1, axis=0) - lines, axis=-1).max(axis=-1),
    )


def ring_moments(count: int, lasers: int) -> np.ndarray:
    """(count, lasers) int: the ring point of each laser at each moment, evenly spread."""
    first = count * np.arange(lasers) // max(lasers, 1)
    return (np.arange(count)[:, None] + first) % count


@dataclass(frozen=True, eq=False)
class EndoscopePose:
    """The endoscope arm turned to the lesion."""

    commands: np.ndarray
    """(P,) commands with the camera's axis on, or nearest to, the lesion's centre."""
    line_mm: np.ndarray
    """(K, 3) centreline, world frame, shaft included."""
    direction: np.ndarray
    """(3,) of the camera's axis."""
    pose: np.ndarray
    """(4, 4) camera frame to world frame, z along its axis, mm."""
    distance_mm: float
    """From the camera to the lesion's centre (mm)."""
    axis_error_rad: float
    """Between the camera's axis and the direction to the lesion's centre (rad)."""


def look_at_lesion(arm: MountedArm, ring: Ring, camera: CameraSpec) -> EndoscopePose:
    """Solve the endoscope arm so that the camera's axis runs through the lesion's centre."""
    target = arm.inward(ring.centre_mm[None])
    aimed = solve_aim(arm.reach, target, nearest_commands(arm.reach, target, camera.range_mm))
    line, direction = arm.lines(aimed.commands)
    towards = ring.centre_mm - line[0, -1]
    return EndoscopePose(
        aimed.commands[0],
        line[0],
        direction[0],
        frames.pose_from_z(line[0, -1], direction[0]),
        float(np.linalg.norm(towards)),
        float(frames.angle_between(direction[0], towards)),
    )


@dataclass(frozen=True, eq=False)
class TouchPose:
    """An arm with a plain tip at the lesion's centre, just before contact."""

    commands: np.ndarray
    """(P,) commands with the tip at its place, or nearest to it."""
    way_mm: np.ndarray
    """(TOUCH_STEPS, K, 3) centrelines from rest to there, world frame, shaft included."""
    miss_mm: float
    """Distance of the tip from its place (mm)."""

    @property
    def reached(self) -> bool:
        """Whether the tip comes to its place."""
        return self.miss_mm <= TOUCHED_MM


def touch_lesion(arm: MountedArm, ring: Ring, clearance_mm: float) -> TouchPose:
    """Solve an arm so that its tip is at the lesion's centre, `clearance_mm` and a gap above it."""
    above = arm.reach.radius_mm + clearance_mm + TOUCH_GAP_MM
    target = arm.inward((ring.centre_mm + above * ring.normal)[None])
    commands, miss = solve_touch(arm.reach, target)
    way, _ = arm.lines(arm.approach(commands[0], TOUCH_STEPS))
    return TouchPose(commands[0], way, float(miss[0]))
