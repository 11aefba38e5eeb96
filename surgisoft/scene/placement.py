"""Find mounts for both arms: the laser covers the ring, the endoscope sees it, nothing touches.

The best mounts of each arm are tried together.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch

from surgisoft.progress import Progress, silent
from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.camera import view
from surgisoft.scene.distance import chains_apart
from surgisoft.scene.lesion import Ring
from surgisoft.scene.mount_sites import (
    COMFORT_MM,
    LaserSite,
    LookSite,
    judge_lasers,
    judge_looks,
    sees,
)
from surgisoft.scene.reach import ArmReach
from surgisoft.scene.spec import CameraSpec, LaserSpec, LimitsSpec
from surgisoft.scene.sweep import Held, Look

LASERS, LOOKS = 12, 40
"""How many of the best mounts of each kind are tried together."""
PORTS_MM = 100.0
"""Shafts farther apart than two ports in an abdominal wall gain nothing more (mm)."""


@dataclass(frozen=True, eq=False)
class Shortfall:
    """Why no pair of mounts was found, and how close the best came."""

    sentence: str
    """For the user."""
    covered: float
    """Fraction of the ring that the best laser mount can cut."""
    viewed: float
    """Fraction of the ring that the best endoscope mount sees."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Mounts for both arms."""

    laser: LaserSite
    """The laser's."""
    look: LookSite
    """The endoscope's."""
    view: float
    """Least fraction of the ring in view while the laser goes round."""
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
    """Pairs of mounts, best first; or none and what was lacking.

    The ring may be coarse here; `check` confirms the chosen pair on the whole of it.
    """
    lasers = judge_lasers(engine, reaches["laser"], ring, laser, limits, shafts_mm["laser"], report)
    looks = judge_looks(
        engine, reaches["endoscope"], ring, camera, limits, shafts_mm["endoscope"], report
    )
    whole = [site for site in lasers if site.good.all()]
    wide = [site for site in looks if sees(site, limits)]
    covered, viewed = float(lasers[0].good.mean()), float(looks[0].visible.mean())
    if not whole:
        return [], Shortfall(_laser_lack(lasers[0], laser, limits), covered, viewed)
    if not wide:
        return [], Shortfall(_look_lack(looks[0], limits), covered, viewed)
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
    """Pairs that leave each other room and the ring in view, best first."""
    pairs = []
    for laser in lasers:
        work = np.concatenate(
            (laser.arm.lines(laser.arm.way(laser.cut.centre))[0], laser.cut.lines_mm)
        )
        for look in looks:
            radii = laser.arm.reach.radius_mm + look.arm.reach.radius_mm
            way = look.arm.lines(look.arm.way(look.look.commands))[0]
            turned = arms_apart_mm(work, np.tile(look.look.line_mm, (len(work), 1, 1)), radii)
            resting = arms_apart_mm(np.tile(work[:1], (len(way), 1, 1)), way, radii)
            apart = float(min(turned.min(), resting.min()))
            steps = [np.linalg.norm(np.diff(a, axis=0), axis=-1).max() for a in (work, way)]
            if apart < max(limits.clearance_mm, 0.5 * max(steps)):
                continue
            score = laser.score + look.score + min(apart, COMFORT_MM) / COMFORT_MM
            score += 3.0 * min(_ports_apart_mm(laser.arm, look.arm), PORTS_MM) / PORTS_MM
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


def _ports_apart_mm(first: Held, second: Held) -> float:
    """Distance of the two shafts where they are nearest: at their bases or at their far ends."""
    ends = [
        np.array([arm.pose[:3, 3] - s * arm.pose[:3, 2] for s in (0.0, arm.shaft_mm)])
        for arm in (first, second)
    ]
    return float(np.linalg.norm(ends[0] - ends[1], axis=1).min())


def least_view(engine, look: Look, laser_lines_mm, ring: Ring, camera: CameraSpec) -> float:
    """Least fraction of the ring in view while the laser arm stands at each of its lines."""
    poses = torch.from_numpy(np.tile(look.pose, (len(laser_lines_mm), 1, 1)))
    arms = {"laser": torch.from_numpy(laser_lines_mm)}
    views = view(engine, camera.camera(), poses, ring.points_mm, ring.normals, arms)
    return float(views.fraction.min())


def _laser_lack(best: LaserSite, laser: LaserSpec, limits: LimitsSpec) -> str:
    cut = best.cut
    reasons = {
        f"out of reach at {laser.standoff_mm[0]:g} to {laser.standoff_mm[1]:g} mm": ~cut.in_reach,
        f"hit at more than {laser.max_incidence_deg:g} degrees": cut.in_reach & cut.steep,
        "hidden from the beam": cut.in_reach & ~best.landed,
    }
    said = [f"{100 * bad.mean():.0f} % {why}" for why, bad in reasons.items() if bad.any()]
    if best.least_mm < limits.clearance_mm:
        said.append(f"least clearance {best.least_mm:.1f} mm of {limits.clearance_mm:g} mm")
    return (
        f"no mount lets the laser cut the whole ring: the best covers "
        f"{100 * best.good.mean():.0f} % ({', '.join(said) or 'the arm would have to jump'})"
    )


def _look_lack(best: LookSite, limits: LimitsSpec) -> str:
    return (
        f"no mount lets the endoscope see {100 * limits.view_fraction:.0f} % of the ring: the best "
        f"sees {100 * best.visible.mean():.0f} % with {best.least_mm:.1f} mm of clearance"
    )
