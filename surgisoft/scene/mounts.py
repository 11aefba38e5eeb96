"""Search for the mounts of all arms, without contact: lasers cover the ring, endoscopes see it.

Candidates are drawn from how the arm stands at work: the beam's direction and length, how much the
arm is bent, and to which side. The batched engine evaluates the candidates of each arm alone; then
the best of all arms are combined. Endoscopes go to work first, then each plain tip touches the
lesion and withdraws, then the lasers cut, evenly spread over the ring.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from surgisoft.progress import Progress, silent
from surgisoft.scene import frames
from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.camera import view
from surgisoft.scene.distance import chains_apart
from surgisoft.scene.lesion import Ring
from surgisoft.scene.mounted_arm import (
    LANDED_MM,
    TOUCH_GAP_MM,
    EndoscopePose,
    MountedArm,
    RingSolution,
    TouchPose,
    look_at_lesion,
    placed,
    ring_moments,
    solve_ring,
    touch_lesion,
)
from surgisoft.scene.reach import ArmReach
from surgisoft.scene.spec import CameraSpec, LaserSpec, LimitsSpec, MountSpec

BENDS_RAD = np.radians([0.0, 25.0, 50.0])
"""How far the arm is bent when it looks at the lesion's centre (rad)."""
ROLLS = 8
"""Number of directions from the beam in which the base of a bent arm is placed."""
MOST_EVALUATED = 240
"""Number of mounts of each arm that are evaluated on the ring."""
ROUNDS, TRIES = 3, 60
"""Rounds of local search, and mounts per round, if no candidate is sufficient."""
NEAR_RAD, NEAR_MM = np.radians(12.0), 6.0
"""Spread of the local search in its first round: about the lesion (rad), along the beam (mm)."""


@dataclass(frozen=True)
class ScoreWeights:
    """Weights in the score of a mount: covering the ring decides, the others rank what covers it.

    The weights were chosen by hand.
    """

    covered: float = 100.0
    """Fraction of the ring that the laser can cut, or that the endoscope sees without contact."""
    clearance: float = 1.0
    """Smallest clearance as a share of COMFORT_MM, from -1 to 1."""
    above: float = 0.7
    """Vertical component of the unit vector from the lesion to the base."""
    incidence_per_rad: float = 1.0
    """Cost of the beam's mean angle to the surface's normal."""
    spare: float = 0.5
    """Median distance of the commands from their limits, as a share of their range."""
    standoff: float = 2.0
    """Cost of the largest deviation from the middle of the allowed standoff, as a share of it."""
    axis_error_per_rad: float = 2.0
    """Cost of the angle between the camera's axis and the lesion's centre."""
    distance: float = 0.3
    """Cost of the deviation from the middle of the camera's range, as a share of it."""
    slant_per_rad: float = 0.5
    """Cost of the angle between the camera's axis and the lesion's normal."""
    ports: float = 3.0
    """Distance between the shafts of a pair as a share of PORTS_MM, at most 1."""


WEIGHTS = ScoreWeights()
COMFORT_MM = 10.0
"""Clearance beyond this does not improve the score (mm)."""


class Site(Protocol):
    """A mount of an arm, evaluated without the other arms."""

    @property
    def arm(self) -> MountedArm:
        """Reach, pose and shaft."""

    @property
    def score(self) -> float:
        """Higher is better."""

    @property
    def way_mm(self) -> np.ndarray:
        """(N, K, 3) mm: centrelines from rest to work."""

    @property
    def stays_mm(self) -> np.ndarray:
        """(K, 3) mm: centreline while the arms that go to work later do so."""

    @property
    def work_mm(self) -> np.ndarray:
        """(M, K, 3) mm: centrelines at work."""


@dataclass(frozen=True, eq=False)
class LaserSite:
    """A laser mount, evaluated on the ring."""

    arm: MountedArm
    """Reach, pose and shaft."""
    cut: RingSolution
    """The arm's solutions around the ring."""
    landed: np.ndarray
    """(M,) bool: nothing stands between the tip and the point."""
    clearance_mm: np.ndarray
    """(M,) mm against all bodies and itself."""
    good: np.ndarray
    """(M,) bool: the point can be cut."""
    least_mm: float
    """Smallest clearance over the ring, at rest and on the path between (mm)."""
    score: float
    """Higher is better."""

    @cached_property
    def way_mm(self) -> np.ndarray:
        """(N, K, 3) mm: centrelines from rest to the beam on the lesion's centre."""
        return self.arm.lines(self.arm.approach(self.cut.centre))[0]

    @property
    def stays_mm(self) -> np.ndarray:
        """(K, 3) mm: the beam on the lesion's centre."""
        return self.way_mm[-1]

    @property
    def work_mm(self) -> np.ndarray:
        """(M, K, 3) mm: around the ring."""
        return self.cut.lines_mm


@dataclass(frozen=True, eq=False)
class EndoscopeSite:
    """An endoscope mount, evaluated without the laser arm."""

    arm: MountedArm
    """Reach, pose and shaft."""
    look: EndoscopePose
    """The arm turned to the lesion."""
    visible: np.ndarray
    """(M,) bool: ring points inside the picture that no body hides."""
    least_mm: float
    """Smallest clearance at rest, on the path and at the lesion (mm)."""
    score: float
    """Higher is better."""

    @cached_property
    def way_mm(self) -> np.ndarray:
        """(N, K, 3) mm: centrelines from rest to the camera on the lesion's centre."""
        return self.arm.lines(self.arm.approach(self.look.commands))[0]

    @property
    def stays_mm(self) -> np.ndarray:
        """(K, 3) mm: the camera on the lesion's centre."""
        return self.look.line_mm

    @property
    def work_mm(self) -> np.ndarray:
        """(1, K, 3) mm: the camera on the lesion's centre."""
        return self.look.line_mm[None]


@dataclass(frozen=True, eq=False)
class TipSite:
    """A mount of an arm with a plain tip, evaluated without the other arms."""

    arm: MountedArm
    """Reach, pose and shaft."""
    touch: TouchPose
    """The tip at the lesion."""
    least_mm: float
    """Smallest clearance at rest and on the path (mm)."""
    good: bool
    """Whether the tip reaches the lesion with the clearance."""
    score: float
    """Higher is better."""

    @property
    def way_mm(self) -> np.ndarray:
        """(N, K, 3) mm: centrelines from rest to the lesion."""
        return self.touch.way_mm

    @property
    def stays_mm(self) -> np.ndarray:
        """(K, 3) mm: at rest, where the tip withdraws after the touch."""
        return self.touch.way_mm[0]

    @property
    def work_mm(self) -> np.ndarray:
        """(1, K, 3) mm: at rest, while the lasers work."""
        return self.touch.way_mm[:1]


def directions_around(normal: np.ndarray, tilts_rad: Iterable[float], turns: int) -> np.ndarray:
    """(D, 3) unit vectors: `turns` of them around `normal` for each tilt; for tilt 0 one."""
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
    """Rows of the reach table whose bend is nearest to each of `BENDS_RAD`, closest to rest."""
    bend = np.arccos(np.clip(reach.tip_direction[:, 2], -1.0, 1.0))
    away = np.linalg.norm((reach.commands - reach.rest) / reach.span, axis=1)
    slack = np.radians(2.0)
    rows = []
    for wanted in BENDS_RAD:
        miss = np.abs(bend - wanted)
        near = np.flatnonzero(miss <= miss.min() + slack)
        rows.append(near[np.argmin(away[near])])
    return np.unique(rows)


def mount_poses(
    reach: ArmReach, centre_mm: np.ndarray, outward: np.ndarray, distances_mm: np.ndarray
) -> np.ndarray:
    """(C, 4, 4) base poses at which a working shape points at `centre_mm` along -outward (D, 3)."""
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


def laser_sites(
    engine: BatchedScene,
    name: str,
    reach: ArmReach,
    ring: Ring,
    laser: LaserSpec,
    limits: LimitsSpec,
    shaft_mm: float,
    report: Progress,
) -> list[LaserSite]:
    """Laser mounts, best first, including those that cover only part of the ring."""
    low, high = laser.standoff_mm
    tilts = np.radians([0.0, 15.0, 30.0, 45.0])
    distances = low + (high - low) * np.array([0.4, 0.6, 0.8])
    outward = directions_around(ring.normal, tilts, 10)
    poses = mount_poses(reach, ring.centre_mm, outward, distances)
    poses = _standing(engine, name, reach, poses, shaft_mm, limits, ring)

    def evaluate(pose: np.ndarray) -> LaserSite:
        return _evaluate_laser(engine, name, MountedArm(reach, pose, shaft_mm), ring, laser, limits)

    def sufficient(site: LaserSite) -> bool:
        return bool(site.good.all())

    return _best_first(evaluate, poses, ring, sufficient, report, f"{name} mounts")


def _best_first(evaluate, poses, ring: Ring, sufficient, report: Progress, note: str) -> list:
    """Evaluate every pose, best first; while none is sufficient, search around the best ones.

    The local search rotates a pose about the lesion and moves it along the line of sight, at random
    with a fixed seed.
    """
    rng = np.random.default_rng(0)
    total = len(poses) + ROUNDS * TRIES
    sites = []
    for i, pose in enumerate(poses):
        sites.append(evaluate(pose))
        report(i + 1, total, note)
    for number in range(ROUNDS):
        sites.sort(key=lambda site: -site.score)
        if sufficient(sites[0]):
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
            sites.append(evaluate(pose))
            report(len(poses) + number * TRIES + i + 1, total, note)
    return sorted(sites, key=lambda site: -site.score)


def _standing(engine, tool, reach, poses, shaft_mm, limits, ring) -> np.ndarray:
    """Poses whose arm has clearance at rest, those from above first; at most MOST_EVALUATED.

    If none has, the poses with the largest clearance are kept, so that the error can report it.
    """
    rest, _ = reach.shapes(reach.rest[None])
    lines = placed(np.tile(rest, (len(poses), 1, 1)), poses, shaft_mm)
    clearance = engine.clearance({tool: torch.from_numpy(lines)}).bodies_mm.amin((1, 2)).numpy()
    upright = frames.normalise(poses[:, :3, 3] - ring.centre_mm)[:, 2]
    clear = clearance >= limits.clearance_mm
    order = np.argsort(-(np.where(clear, 1e3, clearance) + upright), kind="stable")
    kept = order[: max(int(clear.sum()), 20)]
    if len(kept) > MOST_EVALUATED:
        kept = kept[np.linspace(0, len(kept) - 1, MOST_EVALUATED).astype(int)]
    return poses[kept]


def _evaluate_laser(
    engine, name: str, arm: MountedArm, ring: Ring, laser: LaserSpec, limits: LimitsSpec
):
    cut = solve_ring(arm, ring, laser)
    way, _ = arm.lines(arm.approach(cut.centre))
    lines = torch.from_numpy(np.concatenate((cut.lines_mm, way)))
    found = engine.clearance({name: lines})
    clearance = torch.minimum(found.bodies_mm.amin((1, 2)), found.self_mm.amin(1)).numpy()
    count = len(ring.points_mm)
    hit = engine.cast(
        torch.from_numpy(cut.lines_mm[:, -1]),
        torch.from_numpy(cut.directions),
        laser.standoff_mm[1] + 50.0,
        {name: torch.from_numpy(cut.lines_mm)},
        own=name,
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
        WEIGHTS.covered * good.mean()
        + WEIGHTS.clearance * min(max(least, -COMFORT_MM), COMFORT_MM) / COMFORT_MM
        - WEIGHTS.incidence_per_rad * cut.incidence_rad.mean()
        + WEIGHTS.above * base[2]
        + WEIGHTS.spare * np.median(spare)
        - WEIGHTS.standoff
        * np.abs(cut.standoff_mm - 0.5 * sum(laser.standoff_mm)).max()
        / (laser.standoff_mm[1] - laser.standoff_mm[0])
    )
    return LaserSite(arm, cut, landed, clearance[:count], good, least, float(score))


def endoscope_sites(
    engine: BatchedScene,
    name: str,
    reach: ArmReach,
    ring: Ring,
    camera: CameraSpec,
    limits: LimitsSpec,
    shaft_mm: float,
    report: Progress,
) -> list[EndoscopeSite]:
    """Endoscope mounts, best first."""
    radius = np.linalg.norm(ring.points_mm - ring.centre_mm, axis=1).max()
    nearest = max(camera.range_mm[0], 1.25 * radius / np.tan(np.radians(camera.fov_deg / 2)))
    farthest = min(camera.range_mm[1], max(3.0 * nearest, nearest + 50.0))
    distances = nearest + (farthest - nearest) * np.array([0.15, 0.4, 0.75])
    outward = directions_around(ring.normal, np.radians([0.0, 20.0, 40.0, 60.0]), 12)
    poses = mount_poses(reach, ring.centre_mm, outward, distances)
    poses = _standing(engine, name, reach, poses, shaft_mm, limits, ring)

    def evaluate(pose: np.ndarray) -> EndoscopeSite:
        arm = MountedArm(reach, pose, shaft_mm)
        return _evaluate_endoscope(engine, name, arm, ring, camera, limits)

    def sufficient(site: EndoscopeSite) -> bool:
        return sees(site, limits)

    return _best_first(evaluate, poses, ring, sufficient, report, f"{name} mounts")


def sees(site: EndoscopeSite, limits: LimitsSpec) -> bool:
    """Whether the endoscope sees enough of the ring and keeps its clearance."""
    # without clearance the coverage does not count, and the score stays far below
    clear = site.score > 0.5 * WEIGHTS.covered
    return bool(site.visible.mean() >= limits.view_fraction and clear)


def _evaluate_endoscope(
    engine, name: str, arm: MountedArm, ring: Ring, camera: CameraSpec, limits: LimitsSpec
):
    look = look_at_lesion(arm, ring, camera)
    way, _ = arm.lines(arm.approach(look.commands))
    found = engine.clearance({name: torch.from_numpy(way)})
    least = float(min(found.bodies_mm.min(), found.self_mm.min()))
    needed = max(limits.clearance_mm, 0.5 * np.linalg.norm(np.diff(way, axis=0), axis=-1).max())
    pose = torch.from_numpy(look.pose[None])
    visible = view(engine, camera.camera(), pose, ring.points_mm, ring.normals).visible[0].numpy()
    base = frames.normalise(arm.pose[:3, 3] - ring.centre_mm)
    middle = 0.5 * (camera.range_mm[0] + camera.range_mm[1])
    score = (
        WEIGHTS.covered * visible.mean() * (least >= needed)
        + WEIGHTS.clearance * min(max(least, -COMFORT_MM), COMFORT_MM) / COMFORT_MM
        - WEIGHTS.axis_error_per_rad * look.axis_error_rad
        - WEIGHTS.distance * abs(look.distance_mm - middle) / middle
        + WEIGHTS.above * base[2]
        - WEIGHTS.slant_per_rad * frames.angle_between(-look.direction, ring.normal)
    )
    return EndoscopeSite(arm, look, visible, least, float(score))


def tip_sites(
    engine: BatchedScene,
    name: str,
    reach: ArmReach,
    ring: Ring,
    limits: LimitsSpec,
    shaft_mm: float,
    report: Progress,
) -> list[TipSite]:
    """Mounts of an arm with a plain tip that touches the lesion's centre, best first."""
    outward = directions_around(ring.normal, np.radians([0.0, 20.0, 40.0, 60.0]), 12)
    above = np.array([reach.radius_mm + limits.clearance_mm + TOUCH_GAP_MM])
    poses = mount_poses(reach, ring.centre_mm, outward, above)
    poses = _standing(engine, name, reach, poses, shaft_mm, limits, ring)

    def evaluate(pose: np.ndarray) -> TipSite:
        return _evaluate_tip(engine, name, MountedArm(reach, pose, shaft_mm), ring, limits)

    def sufficient(site: TipSite) -> bool:
        return site.good

    return _best_first(evaluate, poses, ring, sufficient, report, f"{name} mounts")


def _evaluate_tip(engine, name: str, arm: MountedArm, ring: Ring, limits: LimitsSpec) -> TipSite:
    touch = touch_lesion(arm, ring, limits.clearance_mm)
    found = engine.clearance({name: torch.from_numpy(touch.way_mm)})
    least = float(min(found.bodies_mm.min(), found.self_mm.min()))
    step = np.linalg.norm(np.diff(touch.way_mm, axis=0), axis=-1).max()
    good = touch.reached and least >= max(limits.clearance_mm, 0.5 * step)
    base = frames.normalise(arm.pose[:3, 3] - ring.centre_mm)
    spare = np.min(np.abs(touch.commands - arm.reach.bounds) / arm.reach.span)
    score = (
        WEIGHTS.covered * good
        + WEIGHTS.clearance * min(max(least, -COMFORT_MM), COMFORT_MM) / COMFORT_MM
        + WEIGHTS.above * base[2]
        + WEIGHTS.spare * spare
        - min(touch.miss_mm, COMFORT_MM)
    )
    return TipSite(arm, touch, least, good, float(score))


COMBINED = {"laser": 12, "endoscope": 40, "tip": 40}
"""Number of the best mounts of each of two arms that are combined, by tool. Of a tip's mounts the
best touch the lesion almost at rest, in the way of a second tip: with 12 of each no two tips were
found on an ellipsoid of 120 x 100 x 70 mm."""
COMBINED_OF_MANY = 40
"""Number of the best mounts of each arm that are combined where a scene has more than two: with 12
of each laser, no combination of two lasers, endoscope and tip was found on a ball of 60 mm."""
PARTIAL = 5000
"""Most combinations of the first arms to which the next arm is added."""
PORTS_MM = 100.0
"""Distance of two ports in an abdominal wall; a larger one does not improve the score (mm)."""
ARRANGEMENTS = 5
"""Number of arrangements that are handed over to be checked."""
MOVES = ("endoscope", "tip", "laser")
"""Order in which the arms go to work, by tool."""


@dataclass(frozen=True, eq=False)
class Shortfall:
    """Why no arrangement of mounts was found, and how close the best came."""

    sentence: str
    """The reason, as printed for the user."""
    covered: float
    """Fraction of the ring that the best mount of the worst laser can cut; 1 without a laser."""
    viewed: float
    """Fraction of the ring that the best mount of the worst endoscope sees; 1 without one."""


@dataclass(frozen=True, eq=False)
class Arrangement:
    """Mounts for all arms."""

    sites: dict[str, Site]
    """Each arm's mount by its name."""
    view: float
    """Smallest fraction of the ring in an endoscope's view while the lasers go round."""
    score: float
    """Higher is better."""


def arms_apart_mm(first: np.ndarray, second: np.ndarray, radii_mm: float) -> np.ndarray:
    """(B,) skin distances of centrelines (B, K, 3) and (B, L, 3) mm with summed radii."""
    out = np.empty(len(first))
    chains_apart(np.ascontiguousarray(first), np.ascontiguousarray(second), radii_mm, 200.0, out)
    return out


def find_mounts(
    engine: BatchedScene,
    reaches: dict[str, ArmReach],
    mounts: dict[str, MountSpec],
    ring: Ring,
    laser: LaserSpec,
    camera: CameraSpec,
    limits: LimitsSpec,
    report: Progress = silent,
) -> tuple[list[Arrangement], Shortfall | None]:
    """Arrangements of mounts, best first; or none, and the reason.

    mounts: each arm's tool and shaft, by its name as in `reaches`; their places are not used. The
    ring may be coarse here; `check` confirms the chosen arrangement on all its points.
    """
    evaluated: dict[tuple, list] = {}
    sites: dict[str, list] = {}
    for name, mount in mounts.items():
        reach, shaft_mm = reaches[name], mount.shaft_mm
        alike = (mount.tool, mount.arm, reach.radius_mm, shaft_mm)
        if alike not in evaluated:
            found: list
            if mount.tool == "laser":
                found = laser_sites(engine, name, reach, ring, laser, limits, shaft_mm, report)
            elif mount.tool == "endoscope":
                found = endoscope_sites(engine, name, reach, ring, camera, limits, shaft_mm, report)
            else:
                found = tip_sites(engine, name, reach, ring, limits, shaft_mm, report)
            evaluated[alike] = found
        sites[name] = evaluated[alike]
    tools = {name: mount.tool for name, mount in mounts.items()}
    lasers, looks = (
        [each for name, each in sites.items() if tools[name] == tool]
        for tool in ("laser", "endoscope")
    )
    covered = min((float(each[0].good.mean()) for each in lasers), default=1.0)
    viewed = min((float(each[0].visible.mean()) for each in looks), default=1.0)
    good = {
        name: [site for site in each if _suffices(site, limits)] for name, each in sites.items()
    }
    for name, each in good.items():
        if not each:
            best = sites[name][0]
            if isinstance(best, LaserSite):
                sentence = _laser_shortfall(best, laser, limits)
            elif isinstance(best, EndoscopeSite):
                sentence = _endoscope_shortfall(best, limits)
            else:
                sentence = _tip_shortfall(best, limits)
            return [], Shortfall(sentence, covered, viewed)
    few = len(mounts) <= 2
    best_of = {
        name: _spread(each, COMBINED[tools[name]] if few else COMBINED_OF_MANY)
        for name, each in good.items()
    }
    arrangements = _together(engine, best_of, tools, ring, camera, limits)
    if not arrangements:
        who = "two of them" if len(mounts) == 2 else "combination of them"
        room = "both arms" if len(mounts) == 2 else "all arms"
        beside = [f"{100 * limits.view_fraction:.0f} % of the ring in view"] if looks else []
        if lasers:
            beside.append("a free way for each beam")
        sentence = (
            f"each arm finds a mount, but no {who} leave{'s' * (len(mounts) > 2)} room for {room} "
            f"({limits.clearance_mm:g} mm apart)"
        )
        if beside:
            sentence += f" with {' and '.join(beside)}"
        return [], Shortfall(sentence, covered, viewed)
    return arrangements, None


def _suffices(site: LaserSite | EndoscopeSite | TipSite, limits: LimitsSpec) -> bool:
    """Whether the mount is good enough for its arm without the others."""
    if isinstance(site, LaserSite):
        return bool(site.good.all())
    if isinstance(site, EndoscopeSite):
        return sees(site, limits)
    return site.good


def _spread(sites: list, count: int) -> list:
    """The best sites, at most `count`, each with its base at least 25 mm from the others'."""
    chosen: list = []
    for site in sites:
        place = site.arm.pose[:3, 3]
        if all(np.linalg.norm(place - other.arm.pose[:3, 3]) >= 25.0 for other in chosen):
            chosen.append(site)
        if len(chosen) == count:
            break
    return chosen


def _together(
    engine, sites: dict[str, list], tools: dict[str, str], ring, camera, limits
) -> list[Arrangement]:
    """Combinations whose arms keep their clearance and the ring in view, best first."""
    lasers = [name for name, tool in tools.items() if tool == "laser"]
    moments = dict(zip(lasers, ring_moments(len(ring.points_mm), len(lasers)).T, strict=True))
    apart: dict[tuple, float | None] = {}

    def gain(one: tuple[str, int], other: tuple[str, int]) -> float | None:
        """Contribution of a pair of mounts to the score; None if the two arms come too close."""
        if (one, other) not in apart:
            first, second = sites[one[0]][one[1]], sites[other[0]][other[1]]
            apart[one, other] = _pair_score(
                (one[0], tools[one[0]], first), (other[0], tools[other[0]], second), moments, limits
            )
        return apart[one, other]

    partial: list[tuple[float, tuple[tuple[str, int], ...]]] = [(0.0, ())]
    for name, each in sites.items():
        longer = []
        for score, chosen in partial:
            for k, site in enumerate(each):
                total: float | None = score + site.score
                for before in chosen:
                    more = gain(before, (name, k))
                    total = None if total is None or more is None else total + more
                    if total is None:
                        break
                if total is not None:
                    longer.append((total, (*chosen, (name, k))))
        longer.sort(key=lambda one: -one[0])
        partial = longer[:PARTIAL]
    found = []
    for score, chosen in partial:
        arranged = {name: sites[name][k] for name, k in chosen}
        if not beams_land(engine, arranged, moments, ring):
            continue
        least = least_view(engine, arranged, moments, ring, camera)
        if least >= limits.view_fraction:
            found.append(Arrangement(arranged, least, score))
        if len(found) == ARRANGEMENTS:
            break
    return found


def _pair_score(one, other, moments: dict[str, np.ndarray], limits: LimitsSpec) -> float | None:
    """Score of two arms (name, tool, site) beside each other; None where they come too close."""
    (a, first_tool, first), (b, second_tool, second) = sorted(
        (one, other), key=lambda arm: MOVES.index(arm[1])
    )
    radii = first.arm.reach.radius_mm + second.arm.reach.radius_mm
    work = second.way_mm
    if second_tool != "tip":  # a tip at work is at rest, where its way begins
        work = np.concatenate((work, second.work_mm))
    steps = [first.way_mm, work]
    if first_tool == second_tool == "laser":
        rings = first.work_mm[moments[a]], second.work_mm[moments[b]]
        shapes = [(first.stays_mm, second.way_mm), rings]
        steps += rings
    else:
        shapes = [(first.stays_mm, work)]
    shapes.append((first.way_mm, second.way_mm[0]))
    away = min(_least_apart_mm(x, y, radii) for x, y in shapes)
    step = max(np.linalg.norm(np.diff(lines, axis=0), axis=-1).max() for lines in steps)
    if away < max(limits.clearance_mm, 0.5 * step):
        return None
    score = WEIGHTS.clearance * min(away, COMFORT_MM) / COMFORT_MM
    ports = min(_ports_apart_mm(first.arm, second.arm), PORTS_MM)
    return score + WEIGHTS.ports * ports / PORTS_MM


def _least_apart_mm(first: np.ndarray, second: np.ndarray, radii_mm: float) -> float:
    """Smallest skin distance (mm) of centrelines in step; (K, 3) stands for one that rests."""
    count = max(len(lines) for lines in (first, second) if lines.ndim == 3)
    first, second = (
        np.tile(lines, (count, 1, 1)) if lines.ndim == 2 else lines for lines in (first, second)
    )
    return float(arms_apart_mm(first, second, radii_mm).min())


def _ports_apart_mm(first: MountedArm, second: MountedArm) -> float:
    """Smaller of the distances between the bases and between the shafts' far ends (mm)."""
    ends = [
        np.array([arm.pose[:3, 3] - s * arm.pose[:3, 2] for s in (0.0, arm.shaft_mm)])
        for arm in (first, second)
    ]
    return float(np.linalg.norm(ends[0] - ends[1], axis=1).min())


def least_view(
    engine: BatchedScene,
    sites: dict[str, Site],
    moments: dict[str, np.ndarray],
    ring: Ring,
    camera: CameraSpec,
) -> float:
    """Smallest fraction of the ring in an endoscope's view while the lasers go round; 1 without."""
    lines = _lines_at_work(sites, moments, ring)
    count = len(ring.points_mm) if moments else 1
    least = 1.0
    for name, site in sites.items():
        if not isinstance(site, EndoscopeSite):
            continue
        others = {key: torch.from_numpy(line) for key, line in lines.items() if key != name}
        poses = torch.from_numpy(np.tile(site.look.pose, (count, 1, 1)))
        seen = view(engine, camera.camera(), poses, ring.points_mm, ring.normals, others)
        least = min(least, float(seen.fraction.min()))
    return least


def beams_land(
    engine: BatchedScene, sites: dict[str, Site], moments: dict[str, np.ndarray], ring: Ring
) -> bool:
    """Whether each laser's beam ends at its point of the ring while the other arms are at work."""
    lines = {
        name: torch.from_numpy(np.ascontiguousarray(line))
        for name, line in _lines_at_work(sites, moments, ring).items()
    }
    for name, order in moments.items():
        site = sites[name]
        assert isinstance(site, LaserSite), "only lasers go round the ring"
        standoff = site.cut.standoff_mm[order]
        hit = engine.cast(
            lines[name][:, -1],
            torch.from_numpy(site.cut.directions[order]),
            float(standoff.max()) + 50.0,
            lines,
            own=name,
        )
        away = np.abs(hit.distance_mm.numpy() - standoff)
        if not (hit.on_organ.numpy() & (away <= LANDED_MM)).all():
            return False
    return True


def _lines_at_work(
    sites: dict[str, Site], moments: dict[str, np.ndarray], ring: Ring
) -> dict[str, np.ndarray]:
    """Each arm's centrelines (M, K, 3) mm while the lasers go round; M is 1 without a laser."""
    count = len(ring.points_mm) if moments else 1
    return {
        name: site.work_mm[moments[name]]
        if name in moments
        else np.tile(site.stays_mm, (count, 1, 1))
        for name, site in sites.items()
    }


def _laser_shortfall(best: LaserSite, laser: LaserSpec, limits: LimitsSpec) -> str:
    cut = best.cut
    reasons = {
        f"out of reach at {laser.standoff_mm[0]:g} to {laser.standoff_mm[1]:g} mm": ~cut.in_reach,
        f"hit at more than {laser.max_incidence_deg:g} degrees": cut.in_reach & cut.steep,
        "hidden from the beam": cut.in_reach & ~best.landed,
    }
    shown = [f"{100 * bad.mean():.0f} % {why}" for why, bad in reasons.items() if bad.any()]
    if best.least_mm < limits.clearance_mm:
        shown.append(
            f"smallest clearance {best.least_mm:.1f} mm, {limits.clearance_mm:g} mm required"
        )
    why = ", ".join(shown) or "the arm would have to jump from one posture to another"
    return (
        f"no mount lets the laser cut the whole ring: the best covers "
        f"{100 * best.good.mean():.0f} % ({why})"
    )


def _endoscope_shortfall(best: EndoscopeSite, limits: LimitsSpec) -> str:
    return (
        f"no mount lets the endoscope see {100 * limits.view_fraction:.0f} % of the ring: the best "
        f"sees {100 * best.visible.mean():.0f} % with {best.least_mm:.1f} mm of clearance"
    )


def _tip_shortfall(best: TipSite, limits: LimitsSpec) -> str:
    return (
        f"no mount lets the plain tip touch the lesion: the best comes within "
        f"{best.touch.miss_mm:.1f} mm of it with {best.least_mm:.1f} mm of clearance, "
        f"{limits.clearance_mm:g} mm required"
    )
