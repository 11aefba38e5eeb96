"""Mounts of one arm, judged alone: what the laser covers from there, what the endoscope sees.

Mounts are drawn from how the arm stands at work: from where the beam comes, how far off, how much
the arm is bent then and to which side. Each is judged by the batched engine.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from surgisoft.progress import Progress
from surgisoft.scene import frames
from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.camera import view
from surgisoft.scene.lesion import Ring
from surgisoft.scene.reach import ArmReach
from surgisoft.scene.spec import CameraSpec, LaserSpec, LimitsSpec
from surgisoft.scene.sweep import (
    LANDED_MM,
    Cut,
    Held,
    Look,
    cut_ring,
    look_at_lesion,
    placed,
)

BENDS_RAD = np.radians([0.0, 25.0, 50.0])
"""How far the arm is bent when it looks at the lesion's centre (rad)."""
ROLLS = 8
"""Sides to which a bent arm's base may lie, seen along the beam."""
MOST_JUDGED = 240
"""How many mounts of each kind are judged on the whole ring."""
ROUNDS, TRIES = 3, 60
"""How often, and at how many mounts each, the search goes on around the best when none will do."""
NEAR_RAD, NEAR_MM = np.radians(12.0), 6.0
"""How far from the best such a mount is tried at first: about the lesion (rad), along it (mm)."""
COMFORT_MM = 10.0
"""Clearance beyond this is worth nothing more (mm)."""


@dataclass(frozen=True, eq=False)
class LaserSite:
    """A laser mount judged on the ring."""

    arm: Held
    """Reach, pose and shaft."""
    cut: Cut
    """The arm's solutions around the ring."""
    landed: np.ndarray
    """(M,) bool: nothing stands between the tip and the point."""
    clearance_mm: np.ndarray
    """(M,) mm against all bodies."""
    good: np.ndarray
    """(M,) bool: the point can be cut."""
    least_mm: float
    """Least clearance over the ring, the rest and the way between (mm)."""
    score: float
    """Higher is better."""


@dataclass(frozen=True, eq=False)
class LookSite:
    """An endoscope mount judged alone."""

    arm: Held
    """Reach, pose and shaft."""
    look: Look
    """The arm turned to the lesion."""
    visible: np.ndarray
    """(M,) bool: ring points in the picture and not hidden by a body."""
    least_mm: float
    """Least clearance at rest, on the way and at the lesion (mm)."""
    score: float
    """Higher is better."""


def directions_around(normal: np.ndarray, tilts_rad: Iterable[float], turns: int) -> np.ndarray:
    """(D, 3) unit vectors at each tilt from `normal`, `turns` of them around; tilt 0 once."""
    frame = frames.rotation_from_z(normal)
    around = 2.0 * np.pi * np.arange(turns) / turns
    rows = []
    for i, tilt in enumerate(tilts_rad):
        turn = around[:1] if tilt == 0.0 else around + 0.5 * i * (2.0 * np.pi / turns)
        ring = np.stack(
            (np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn), np.cos(tilt) + 0 * turn), 1
        )
        rows.append(ring @ frame.T)
    return np.concatenate(rows)


def working_shapes(reach: ArmReach) -> np.ndarray:
    """Rows of the reach table bent about as much as `BENDS_RAD`, else as near to rest as can be."""
    bend = np.arccos(np.clip(reach.tip_direction[:, 2], -1.0, 1.0))
    away = np.linalg.norm((reach.commands - reach.rest) / reach.span, axis=1)
    slack = np.radians(2.0)
    rows = []
    for wanted in BENDS_RAD:
        miss = np.abs(bend - wanted)
        near = np.flatnonzero(miss <= miss.min() + slack)
        rows.append(near[np.argmin(away[near])])
    return np.unique(rows)


def mount_poses(reach: ArmReach, centre_mm, outward: np.ndarray, distances_mm) -> np.ndarray:
    """(C, 4, 4) bases from which a working shape looks at `centre_mm` along -outward (D, 3)."""
    poses = []
    for row in working_shapes(reach):
        tip = frames.pose_from_z(reach.centreline_mm[row, -1], reach.tip_direction[row])
        straight = reach.tip_direction[row, 2] > np.cos(np.radians(3.0))
        rolls = np.arange(1 if straight else ROLLS) * (2.0 * np.pi / ROLLS)
        for distance in distances_mm:
            for roll in rolls:
                wanted = frames.pose_from_z(centre_mm + distance * outward, -outward, roll)
                poses.append(wanted @ frames.invert(tip))
    return np.concatenate(poses)


def judge_lasers(
    engine: BatchedScene,
    reach: ArmReach,
    ring: Ring,
    laser: LaserSpec,
    limits: LimitsSpec,
    shaft_mm: float,
    report: Progress,
) -> list[LaserSite]:
    """Laser mounts, best first; also those that cover only part of the ring."""
    low, high = laser.standoff_mm
    tilts = np.radians([0.0, 15.0, 30.0, 45.0])
    distances = low + (high - low) * np.array([0.4, 0.6, 0.8])
    outward = directions_around(ring.normal, tilts, 10)
    poses = mount_poses(reach, ring.centre_mm, outward, distances)
    poses = _standing(engine, "laser", reach, poses, shaft_mm, limits, ring)

    def judge(pose: np.ndarray) -> LaserSite:
        return _judge_laser(engine, Held(reach, pose, shaft_mm), ring, laser, limits)

    return _best_first(judge, poses, ring, lambda site: site.good.all(), report, "laser mounts")


def _best_first(judge, poses, ring: Ring, enough, report: Progress, note: str) -> list:
    """Judge every pose; while none is enough, try around the best ones. Best first.

    The tries around a pose turn it about the lesion and move it along the line of sight, at random
    but the same each time.
    """
    rng = np.random.default_rng(0)
    total = len(poses) + ROUNDS * TRIES
    sites = []
    for i, pose in enumerate(poses):
        sites.append(judge(pose))
        report(i + 1, total, note)
    for number in range(ROUNDS):
        sites.sort(key=lambda site: -site.score)
        if enough(sites[0]):
            break
        spread = NEAR_RAD / (number + 1)
        for i in range(TRIES):
            pose = sites[i % min(8, len(sites))].arm.pose.copy()
            axis = frames.normalise(rng.normal(size=3))
            turn = Rotation.from_rotvec(spread * rng.normal() * axis).as_matrix()
            away = frames.normalise(pose[:3, 3] - ring.centre_mm)
            pose[:3, :3] = turn @ pose[:3, :3]
            pose[:3, 3] = ring.centre_mm + turn @ (pose[:3, 3] - ring.centre_mm)
            pose[:3, 3] += NEAR_MM / (number + 1) * rng.normal() * away
            sites.append(judge(pose))
            report(len(poses) + number * TRIES + i + 1, total, note)
    return sorted(sites, key=lambda site: -site.score)


def _standing(engine, tool, reach, poses, shaft_mm, limits, ring) -> np.ndarray:
    """Poses whose arm is clear at rest, those nearest to the middle first, at most MOST_JUDGED.

    When none is clear the ones that come nearest to it are kept, to tell how close they come.
    """
    rest, _ = reach.shapes(reach.rest[None])
    lines = placed(np.tile(rest, (len(poses), 1, 1)), poses, shaft_mm)
    clearance = engine.clearance({tool: torch.from_numpy(lines)}).bodies_mm.amin((1, 2)).numpy()
    upright = frames.normalise(poses[:, :3, 3] - ring.centre_mm)[:, 2]
    clear = clearance >= limits.clearance_mm
    order = np.argsort(-(np.where(clear, 1e3, clearance) + upright), kind="stable")
    kept = order[: max(int(clear.sum()), 20)]
    if len(kept) > MOST_JUDGED:
        kept = kept[np.linspace(0, len(kept) - 1, MOST_JUDGED).astype(int)]
    return poses[kept]


def _judge_laser(engine, arm: Held, ring: Ring, laser: LaserSpec, limits: LimitsSpec):
    cut = cut_ring(arm, ring, laser)
    way, _ = arm.lines(arm.way(cut.centre))
    lines = torch.from_numpy(np.concatenate((cut.lines_mm, way)))
    answer = engine.clearance({"laser": lines})
    clearance = torch.minimum(answer.bodies_mm.amin((1, 2)), answer.self_mm.amin(1)).numpy()
    count = len(ring.points_mm)
    hit = engine.cast(
        torch.from_numpy(cut.lines_mm[:, -1]),
        torch.from_numpy(cut.directions),
        laser.standoff_mm[1] + 50.0,
        {"laser": torch.from_numpy(cut.lines_mm)},
        own="laser",
    )
    landed = hit.on_organ.numpy() & (np.abs(hit.distance_mm.numpy() - cut.standoff_mm) <= LANDED_MM)
    needed = np.maximum(limits.clearance_mm, 0.5 * np.maximum(cut.step_mm, np.roll(cut.step_mm, 1)))
    way_step = np.linalg.norm(np.diff(way, axis=0), axis=-1).max()
    way_good = clearance[count:].min() >= max(limits.clearance_mm, 0.5 * way_step)
    good = cut.in_reach & ~cut.steep & landed & (clearance[:count] >= needed) & way_good
    least = float(clearance.min())
    spare = np.min(np.abs(cut.commands[:, None] - arm.reach.bounds) / arm.reach.span, axis=(1, 2))
    base = frames.normalise(arm.pose[:3, 3] - ring.centre_mm)
    score = (
        100.0 * good.mean()
        + min(max(least, -COMFORT_MM), COMFORT_MM) / COMFORT_MM
        - cut.incidence_rad.mean()
        + 0.7 * base[2]
        + 0.5 * np.median(spare)
        - 2.0
        * np.abs(cut.standoff_mm - 0.5 * sum(laser.standoff_mm)).max()
        / (laser.standoff_mm[1] - laser.standoff_mm[0])
    )
    return LaserSite(arm, cut, landed, clearance[:count], good, least, float(score))


def judge_looks(
    engine: BatchedScene,
    reach: ArmReach,
    ring: Ring,
    camera: CameraSpec,
    limits: LimitsSpec,
    shaft_mm: float,
    report: Progress,
) -> list[LookSite]:
    """Endoscope mounts, best first."""
    radius = np.linalg.norm(ring.points_mm - ring.centre_mm, axis=1).max()
    nearest = max(camera.range_mm[0], 1.25 * radius / np.tan(np.radians(camera.fov_deg / 2)))
    farthest = min(camera.range_mm[1], max(3.0 * nearest, nearest + 50.0))
    distances = nearest + (farthest - nearest) * np.array([0.15, 0.4, 0.75])
    outward = directions_around(ring.normal, np.radians([0.0, 20.0, 40.0, 60.0]), 12)
    poses = mount_poses(reach, ring.centre_mm, outward, distances)
    poses = _standing(engine, "endoscope", reach, poses, shaft_mm, limits, ring)

    def judge(pose: np.ndarray) -> LookSite:
        return _judge_look(engine, Held(reach, pose, shaft_mm), ring, camera, limits)

    def enough(site: LookSite) -> bool:
        return sees(site, limits)

    return _best_first(judge, poses, ring, enough, report, "endoscope mounts")


def sees(site: LookSite, limits: LimitsSpec) -> bool:
    """Whether the endoscope sees enough of the ring without touching anything."""
    return bool(site.visible.mean() >= limits.view_fraction and site.score > 50.0)


def _judge_look(engine, arm: Held, ring: Ring, camera: CameraSpec, limits: LimitsSpec):
    look = look_at_lesion(arm, ring, camera)
    way, _ = arm.lines(arm.way(look.commands))
    answer = engine.clearance({"endoscope": torch.from_numpy(way)})
    least = float(min(answer.bodies_mm.min(), answer.self_mm.min()))
    needed = max(limits.clearance_mm, 0.5 * np.linalg.norm(np.diff(way, axis=0), axis=-1).max())
    pose = torch.from_numpy(look.pose[None])
    visible = view(engine, camera.camera(), pose, ring.points_mm, ring.normals).visible[0].numpy()
    base = frames.normalise(arm.pose[:3, 3] - ring.centre_mm)
    middle = 0.5 * (camera.range_mm[0] + camera.range_mm[1])
    score = (
        100.0 * visible.mean() * (least >= needed)
        + min(max(least, -COMFORT_MM), COMFORT_MM) / COMFORT_MM
        - 2.0 * look.axis_error_rad
        - 0.3 * abs(look.distance_mm - middle) / middle
        + 0.7 * base[2]
        - 0.5 * frames.angle_between(-look.direction, ring.normal)
    )
    return LookSite(arm, look, visible, least, float(score))
