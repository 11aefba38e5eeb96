"""Search for the mounts of both arms: the laser covers the ring, the endoscope sees it, no contact.

Candidates are drawn from how the arm stands at work: the beam's direction and length, how much the
arm is bent, and to which side. The batched engine evaluates the candidates of each arm alone; then
the best of both arms are paired.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

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
    EndoscopePose,
    MountedArm,
    RingSolution,
    look_at_lesion,
    placed,
    solve_ring,
)
from surgisoft.scene.reach import ArmReach
from surgisoft.scene.spec import CameraSpec, LaserSpec, LimitsSpec

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
    """(M,) mm against all bodies."""
    good: np.ndarray
    """(M,) bool: the point can be cut."""
    least_mm: float
    """Smallest clearance over the ring, at rest and on the path between (mm)."""
    score: float
    """Higher is better."""


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
    poses = _standing(engine, "laser", reach, poses, shaft_mm, limits, ring)

    def evaluate(pose: np.ndarray) -> LaserSite:
        return _evaluate_laser(engine, MountedArm(reach, pose, shaft_mm), ring, laser, limits)

    return _best_first(evaluate, poses, ring, lambda site: site.good.all(), report, "laser mounts")


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


def _evaluate_laser(engine, arm: MountedArm, ring: Ring, laser: LaserSpec, limits: LimitsSpec):
    cut = solve_ring(arm, ring, laser)
    way, _ = arm.lines(arm.approach(cut.centre))
    lines = torch.from_numpy(np.concatenate((cut.lines_mm, way)))
    found = engine.clearance({"laser": lines})
    clearance = torch.minimum(found.bodies_mm.amin((1, 2)), found.self_mm.amin(1)).numpy()
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
    poses = _standing(engine, "endoscope", reach, poses, shaft_mm, limits, ring)

    def evaluate(pose: np.ndarray) -> EndoscopeSite:
        return _evaluate_endoscope(engine, MountedArm(reach, pose, shaft_mm), ring, camera, limits)

    def sufficient(site: EndoscopeSite) -> bool:
        return sees(site, limits)

    return _best_first(evaluate, poses, ring, sufficient, report, "endoscope mounts")


def sees(site: EndoscopeSite, limits: LimitsSpec) -> bool:
    """Whether the endoscope sees enough of the ring and keeps its clearance."""
    # without clearance the coverage does not count, and the score stays far below
    clear = site.score > 0.5 * WEIGHTS.covered
    return bool(site.visible.mean() >= limits.view_fraction and clear)


def _evaluate_endoscope(
    engine, arm: MountedArm, ring: Ring, camera: CameraSpec, limits: LimitsSpec
):
    look = look_at_lesion(arm, ring, camera)
    way, _ = arm.lines(arm.approach(look.commands))
    found = engine.clearance({"endoscope": torch.from_numpy(way)})
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


LASERS, LOOKS = 12, 40
"""Number of the best laser and endoscope mounts that are paired."""
PORTS_MM = 100.0
"""Distance of two ports in an abdominal wall; a larger one does not improve the score (mm)."""


@dataclass(frozen=True, eq=False)
class Shortfall:
    """Why no pair of mounts was found, and how close the best came."""

    sentence: str
    """The reason, as printed for the user."""
    covered: float
    """Fraction of the ring that the best laser mount can cut."""
    viewed: float
    """Fraction of the ring that the best endoscope mount sees."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Mounts for both arms."""

    laser: LaserSite
    """The laser's."""
    look: EndoscopeSite
    """The endoscope's."""
    view: float
    """Smallest fraction of the ring in view while the laser goes round."""
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
    ring: Ring,
    laser: LaserSpec,
    camera: CameraSpec,
    limits: LimitsSpec,
    shafts_mm: dict[str, float],
    report: Progress = silent,
) -> tuple[list[Pair], Shortfall | None]:
    """Pairs of mounts, best first; or no pair, and the reason.

    The ring may be coarse here; `check` confirms the chosen pair on all its points.
    """
    lasers = laser_sites(engine, reaches["laser"], ring, laser, limits, shafts_mm["laser"], report)
    looks = endoscope_sites(
        engine, reaches["endoscope"], ring, camera, limits, shafts_mm["endoscope"], report
    )
    whole = [site for site in lasers if site.good.all()]
    wide = [site for site in looks if sees(site, limits)]
    covered, viewed = float(lasers[0].good.mean()), float(looks[0].visible.mean())
    if not whole:
        return [], Shortfall(_laser_shortfall(lasers[0], laser, limits), covered, viewed)
    if not wide:
        return [], Shortfall(_endoscope_shortfall(looks[0], limits), covered, viewed)
    pairs = _together(engine, _spread(whole, LASERS), _spread(wide, LOOKS), ring, camera, limits)
    if not pairs:
        sentence = (
            "each arm finds a mount, but no two of them leave room for both arms "
            f"({limits.clearance_mm:g} mm apart) with {100 * limits.view_fraction:.0f} % of the "
            "ring in view"
        )
        return [], Shortfall(sentence, covered, viewed)
    return pairs, None


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


def _together(engine, lasers, looks, ring, camera, limits) -> list[Pair]:
    """Pairs whose arms keep their clearance and the ring in view, best first."""
    pairs = []
    for laser in lasers:
        work = np.concatenate(
            (laser.arm.lines(laser.arm.approach(laser.cut.centre))[0], laser.cut.lines_mm)
        )
        for look in looks:
            radii = laser.arm.reach.radius_mm + look.arm.reach.radius_mm
            way = look.arm.lines(look.arm.approach(look.look.commands))[0]
            turned = arms_apart_mm(work, np.tile(look.look.line_mm, (len(work), 1, 1)), radii)
            resting = arms_apart_mm(np.tile(work[:1], (len(way), 1, 1)), way, radii)
            apart = float(min(turned.min(), resting.min()))
            steps = [np.linalg.norm(np.diff(a, axis=0), axis=-1).max() for a in (work, way)]
            if apart < max(limits.clearance_mm, 0.5 * max(steps)):
                continue
            score = laser.score + look.score
            score += WEIGHTS.clearance * min(apart, COMFORT_MM) / COMFORT_MM
            score += WEIGHTS.ports * min(_ports_apart_mm(laser.arm, look.arm), PORTS_MM) / PORTS_MM
            pairs.append(Pair(laser, look, float(look.visible.mean()), score))
    pairs.sort(key=lambda pair: -pair.score)
    seen_pairs = []
    for pair in pairs:
        fraction = least_view(engine, pair.look.look, pair.laser.cut.lines_mm, ring, camera)
        if fraction >= limits.view_fraction:
            seen_pairs.append(replace(pair, view=fraction))
        if len(seen_pairs) == 5:
            break
    return seen_pairs


def _ports_apart_mm(first: MountedArm, second: MountedArm) -> float:
    """Smaller of the distances between the bases and between the shafts' far ends (mm)."""
    ends = [
        np.array([arm.pose[:3, 3] - s * arm.pose[:3, 2] for s in (0.0, arm.shaft_mm)])
        for arm in (first, second)
    ]
    return float(np.linalg.norm(ends[0] - ends[1], axis=1).min())


def least_view(
    engine: BatchedScene,
    look: EndoscopePose,
    laser_lines_mm: np.ndarray,
    ring: Ring,
    camera: CameraSpec,
) -> float:
    """Smallest fraction of the ring in view with the laser arm at each of its centrelines."""
    poses = torch.from_numpy(np.tile(look.pose, (len(laser_lines_mm), 1, 1)))
    arms = {"laser": torch.from_numpy(laser_lines_mm)}
    views = view(engine, camera.camera(), poses, ring.points_mm, ring.normals, arms)
    return float(views.fraction.min())


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
    return (
        f"no mount lets the laser cut the whole ring: the best covers "
        f"{100 * best.good.mean():.0f} % ({', '.join(shown) or 'the arm would have to jump'})"
    )


def _endoscope_shortfall(best: EndoscopeSite, limits: LimitsSpec) -> str:
    return (
        f"no mount lets the endoscope see {100 * limits.view_fraction:.0f} % of the ring: the best "
        f"sees {100 * best.visible.mean():.0f} % with {best.least_mm:.1f} mm of clearance"
    )
