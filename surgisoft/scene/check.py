"""Check a whole scene with FCL: meshes, lesion, contours, arms at rest and at work, the view."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from surgisoft.errors import InputError
from surgisoft.progress import Progress, silent
from surgisoft.scene import frames
from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.camera import view
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.collision import CollisionChecker
from surgisoft.scene.contours import SurfacePath, contour_path, outline_crossing_mm
from surgisoft.scene.dose_patch import check_apart
from surgisoft.scene.folder import Scene
from surgisoft.scene.inside import buried_faces, points_inside
from surgisoft.scene.lesion import (
    ON_SURFACE_MM,
    RING_POINTS,
    Ring,
    circle_on,
    distance_from_points_mm,
    nearest_on_surface,
    path_crossing_mm,
    path_off_mm,
    path_slack_mm,
)
from surgisoft.scene.mesh import Body
from surgisoft.scene.mounted_arm import (
    FEED_MM,
    FEED_STEP_MM,
    LANDED_MM,
    TOUCHED_MM,
    EndoscopePose,
    MountedArm,
    RingSolution,
    TouchPose,
    look_at_lesion,
    ring_moments,
    solve_ring,
    touch_lesion,
)
from surgisoft.scene.reach import ArmReach
from surgisoft.scene.spec import WALL, CameraSpec

REASONS = ("can be cut", "out of reach", "too steep", "beam blocked", "no clearance", "arm jumps")
"""Meaning of a ring point's code; a point gets the first that applies after the first entry."""
OUT_OF_REACH = 1
"""Code of a ring point that is out of reach."""
CONTOUR_STEP_MM = 0.5
"""Spacing of a contour's points, of which RING_POINTS are checked (mm)."""
PATCH_SHARES = np.linspace(0.1, 1.6, 16)
"""Diameters of the reachability map's circles, as shares of the lesion's diameter."""

VIEW_EVERY = 3
"""The view is checked with the beam on every third ring point: every 15 degrees."""
PLANNING_NODES = 150_000
"""Nodes of the distance fields for planning: few, because distances near surfaces are exact."""


@dataclass(frozen=True)
class Finding:
    """One line of the result table."""

    what: str
    """What was checked."""
    value: str
    """What was found."""
    wanted: str
    """The requirement."""
    good: bool
    """Whether the requirement is met."""


@dataclass(frozen=True, eq=False)
class Work:
    """All arms at work, by name: lasers go round the ring of M points, evenly spread over it.

    At moment i the first laser's beam is on point i. Endoscopes look at the lesion; plain tips are
    at rest, after they have touched it one after another.
    """

    reasons: dict[str, np.ndarray]
    """Laser -> (M,) int: index into REASONS of each ring point."""
    cuts: dict[str, RingSolution]
    """Laser -> inverse kinematics around the ring."""
    looks: dict[str, EndoscopePose]
    """Endoscope -> the arm turned to the lesion."""
    touches: dict[str, TouchPose]
    """Arm with a plain tip -> the tip at the lesion."""
    clearance_mm: np.ndarray
    """(M,) mm: smallest clearance of all arms at each moment; -1 for contact. (1,) without laser.
    """
    views: dict[str, np.ndarray]
    """Endoscope -> (M / VIEW_EVERY,) fraction of the ring in view at every VIEW_EVERYth moment."""

    @property
    def covered(self) -> float:
        """Fraction of the ring that the worst laser can cut; 1 without a laser."""
        return min((float(np.mean(reason == 0)) for reason in self.reasons.values()), default=1.0)

    @property
    def viewed(self) -> float:
        """Smallest fraction of the ring in an endoscope's view; 1 without an endoscope."""
        return min((float(view.min()) for view in self.views.values()), default=1.0)


@dataclass(frozen=True, eq=False)
class SceneCheck:
    """Result of checking a scene with FCL."""

    findings: tuple[Finding, ...]
    """The result table."""
    work: Work | None
    """The arms at work; None if the ring does not lie on the organ."""

    @property
    def good(self) -> bool:
        """Whether the scene meets every requirement."""
        return all(finding.good for finding in self.findings)


def sentence(check: SceneCheck) -> str:
    """The result in one sentence."""
    work = check.work
    if check.good and work is not None:
        parts = [
            f"{_each('laser', work.reasons)} reaches {100 * work.covered:.0f} % of the ring"
            if work.reasons
            else "",
            f"{_each('endoscope', work.views)} sees {100 * work.viewed:.0f} % of it"
            if work.views
            else "",
            f"{_each('plain tip', work.touches)} reaches the lesion" if work.touches else "",
            f"nothing comes closer than {work.clearance_mm.min():.1f} mm at work",
        ]
        return f"The scene is ready: {', '.join(part for part in parts if part)}."
    bad = [f"{f.what}: {f.value} (needs {f.wanted})" for f in check.findings if not f.good]
    return f"The scene is not ready: {'; '.join(bad)}."


def _each(tool: str, arms: Mapping[str, Any]) -> str:
    """`the laser`, or `each laser` of several."""
    return f"the {tool}" if len(arms) == 1 else f"each {tool}"


def mounted_arms(scene: Scene, reaches: dict[str, ArmReach]) -> dict[str, MountedArm]:
    """All arms at their mounts, by name."""
    return {name: MountedArm.at(mount, reaches[name]) for name, mount in scene.spec.arms.items()}


def check_scene(
    scene: Scene,
    reaches: dict[str, ArmReach],
    report: Progress = silent,
) -> SceneCheck:
    """Check everything that a task relies on, by FCL on the meshes themselves.

    `reaches` holds the arms' reach tables by name.
    """
    lesion = _lesion_finding(scene)
    paths, laid = _contour_paths(scene)
    findings: tuple[Finding, ...] = (*_mesh_findings(scene), lesion, *laid)
    if not lesion.good:
        return SceneCheck(findings, None)
    findings = (*findings, *_neighbour_findings(scene, "ring", scene.ring.points_mm))
    checker, arms = CollisionChecker(scene.bodies), mounted_arms(scene, reaches)
    work = _work(scene, scene.ring, True, checker, arms, report)
    moments = len(work.clearance_mm)
    report(moments + 1, moments + 2, "paths from rest")
    ways = _way_finding(scene, checker, arms, work)
    findings = (*findings, *_work_findings(scene, work), ways)
    findings = (*findings, *_insertion_findings(scene, checker, arms))
    for path in paths:
        findings = (*findings, *_contour_findings(scene, path, checker, arms))
    return SceneCheck(findings, work)


def _contour_paths(scene: Scene) -> tuple[list[SurfacePath], list[Finding]]:
    """The scene's contours that lie on the organ, and what was found of each contour's place."""
    mesh, paths, rows = scene.organ.world_mesh, [], []
    for contour in scene.spec.contours:
        what, wanted = f"contour '{contour.name}'", f"{ON_SURFACE_MM:g} mm"
        try:
            path = contour_path(mesh, contour, CONTOUR_STEP_MM)
        except InputError as error:
            fault = str(error).removeprefix(f"{what}: ").partition("; expected")[0]
            rows.append(Finding(f"{what} on the surface", fault, wanted, False))
            continue
        place = outline_crossing_mm(mesh, path.points_mm) if path.closed else None
        if place is not None:
            value = f"crosses itself near {tuple(place.round(1).tolist())} mm"
            rows.append(Finding(f"{what} on the surface", value, "one inside", False))
            continue
        value = f"{path.length_mm:.1f} mm long"
        rows.append(Finding(f"{what} on the surface", value, wanted, True))
        paths.append(path)
    try:
        check_apart(paths)
    except InputError as error:
        rows.append(
            Finding("contours apart", str(error).partition(";")[0], "crossings only", False)
        )
    return paths, rows


def _contour_findings(
    scene: Scene, path: SurfacePath, checker: CollisionChecker, arms: dict[str, MountedArm]
) -> list[Finding]:
    """A contour's distance from what must not be touched, and the lasers' reach along it.

    The endoscopes look at the contour's middle. How much of the contour they see is not checked: a
    task that cuts contours moves them along.
    """
    what = f"contour '{path.name}'"
    nearby = _neighbour_findings(scene, what, path.points_mm)
    count = min(RING_POINTS, len(path.points_mm))
    chosen = np.linspace(0, len(path.points_mm) - 1, count, endpoint=not path.closed).astype(int)
    middle, face = nearest_on_surface(scene.organ.world_mesh, path.middle_mm[None])
    points, normals = path.points_mm[chosen], path.normals[chosen]
    ring = Ring(middle[0], path.normal, points, normals, np.repeat(face, count))
    work = _work(scene, ring, path.closed, checker, arms, silent)
    return [*nearby, *_reach_findings(scene, work, what)]


def _work(
    scene: Scene,
    ring: Ring,
    closed: bool,
    checker: CollisionChecker,
    arms: dict[str, MountedArm],
    report: Progress,
) -> Work:
    """Move the lasers once around a ring while the endoscopes look at it.

    closed: whether the ring's last point is followed by the first.
    """
    spec = scene.spec
    limits = spec.limits
    cuts = {name: solve_ring(arms[name], ring, spec.laser) for name in spec.arms_with("laser")}
    looks = {
        name: look_at_lesion(arms[name], ring, spec.camera) for name in spec.arms_with("endoscope")
    }
    touches = {
        name: touch_lesion(arms[name], ring, limits.clearance_mm) for name in spec.arms_with("tip")
    }
    still = {name: look.line_mm for name, look in looks.items()}
    still |= {name: touch.way_mm[0] for name, touch in touches.items()}
    held = {name: ArmShape(line, arms[name].reach.radius_mm) for name, line in still.items()}
    count = len(ring.points_mm)
    points = ring_moments(count, len(cuts))[: count if cuts else 1]
    scenes = [
        {
            name: ArmShape(cuts[name].lines_mm[i], arms[name].reach.radius_mm)
            for name, i in zip(cuts, row, strict=True)
        }
        | held
        for row in points
    ]
    clearance = np.empty(len(scenes))
    landed = {name: np.zeros(count, dtype=bool) for name in cuts}
    for moment, (row, shapes) in enumerate(zip(points, scenes, strict=True)):
        touching = checker.collisions(shapes)
        clearance[moment] = -1.0 if touching else checker.clearance(shapes).least_mm
        for (name, cut), i in zip(cuts.items(), row, strict=True):
            landed[name][i] = _lands(checker, cut, i, shapes, name)
        report(moment + 1, len(scenes) + 2, "ring")
    # The arm moves to both neighbouring points. No point of it is then farther than half a step
    # from a checked shape. A step must be short compared with the arm's thickness.
    reasons = {}
    for k, (name, cut) in enumerate(cuts.items()):
        near = np.empty(count)
        near[points[:, k]] = clearance
        onward = cut.step_mm if closed else np.append(cut.step_mm[:-1], 0.0)
        step = np.maximum(onward, np.roll(onward, 1))
        close = near < np.maximum(limits.clearance_mm, 0.5 * step)
        jumps = step > 0.5 * arms[name].reach.radius_mm
        tests = (~cut.in_reach, cut.steep, ~landed[name], close, jumps)
        reasons[name] = np.select(tests, range(1, len(REASONS)), 0)
    views = {
        name: _view(checker, name, look, scenes, ring, spec.camera) for name, look in looks.items()
    }
    return Work(reasons, cuts, looks, touches, clearance, views)


def _lands(
    checker: CollisionChecker, cut: RingSolution, point: int, shapes: dict[str, ArmShape], name: str
) -> bool:
    """Whether a laser's beam ends at its ring point, with all arms in their shapes."""
    reach_mm = max(cut.standoff_mm[point], 0.0) + 50.0
    origin, aim = cut.lines_mm[point, -1], cut.directions[point]
    hit = checker.cast(origin, aim, reach_mm, shapes, own=name)
    return bool(hit.on_organ) and abs(hit.distance_mm - cut.standoff_mm[point]) <= LANDED_MM


def _mesh_findings(scene: Scene) -> tuple[Finding, ...]:
    rows = []
    for body in scene.bodies:
        mesh = body.mesh
        closed = mesh.is_watertight and mesh.volume_mm3 > 0.0
        kind = "closed" if closed else "inside out" if mesh.is_watertight else "open"
        volume = f"{mesh.volume_mm3 / 1000.0:.4g} ml"
        if closed and buried_faces(mesh):
            volume = "overlaps itself, volume unknown"  # its integral counts overlaps twice
        rows.append(
            Finding(
                f"{body.role} '{body.name}'",
                f"{len(mesh.faces)} faces, {kind}, {volume}",
                "closed, wound outwards",
                closed,
            )
        )
    return tuple(rows)


def _lesion_finding(scene: Scene) -> Finding:
    lesion = scene.spec.lesion
    centre = np.asarray(lesion.centre_mm)
    nearest, _ = nearest_on_surface(scene.organ.world_mesh, centre[None])
    off = float(np.linalg.norm(nearest[0] - centre))
    value, lies = f"{off:.3f} mm off", off <= ON_SURFACE_MM
    if not lies:
        there = ", ".join(f"{x:.2f}" for x in nearest[0])
        value = f"{off:.3f} mm off, nearest is [{there}]"
    else:
        try:
            scene.ring_of()
        except InputError:
            value, lies = f"its ring of {lesion.diameter_mm:g} mm extends over an edge", False
            if lesion.path_mm:
                value = _path_fault(scene)
    wanted = f"{ON_SURFACE_MM:g} mm, whole ring"
    if lesion.path_mm:
        wanted = f"{ON_SURFACE_MM:g} mm, path {path_slack_mm(lesion):g} mm"
    return Finding("lesion on the surface", value, wanted, lies)


def _path_fault(scene: Scene) -> str:
    """What is wrong with the lesion's own path."""
    mesh, lesion = scene.organ.world_mesh, scene.spec.lesion
    away = path_off_mm(mesh, lesion)
    place = path_crossing_mm(mesh, lesion)
    if away > path_slack_mm(lesion) or place is None:
        return f"its path_mm leaves the surface by {away:.3g} mm"
    return f"its path_mm crosses itself near {tuple(place.round(1).tolist())} mm"


def _neighbour_findings(scene: Scene, what: str, points_mm: np.ndarray) -> tuple[Finding, ...]:
    """Distance of a cut along points (M, 3) mm from each body that must not be touched, such as a
    vessel below it."""
    least = scene.spec.limits.clearance_mm
    rows = []
    for name, mesh in scene.keep_out.items():
        away = distance_from_points_mm(mesh, points_mm)
        rows.append(
            Finding(f"{what} to '{name}'", f"{away:.1f} mm", f"{least:g} mm", away >= least)
        )
    return tuple(rows)


def _reach_findings(scene: Scene, work: Work, what: str) -> list[Finding]:
    """Which share of a path each laser can cut, and what keeps it from the rest.

    Where it reaches none of it: by how much it misses the nearest point, or the body in which its
    base is.
    """
    rows = []
    for name, reason in work.reasons.items():
        lacking = [
            f"{100 * np.mean(reason == code):.0f} % {REASONS[code]}"
            for code in np.unique(reason[reason > 0])
        ]
        if (reason == OUT_OF_REACH).all():
            base = np.asarray(scene.spec.mount(name).position_mm)
            inside = [body.name for body in scene.bodies if _holds(body, base)]
            lacking[-1] += (
                f": its base is inside '{inside[0]}'"
                if inside
                else f", the nearest point by {work.cuts[name].missed_mm.min():.3g} mm"
            )
        whose = "the laser's reach" if len(work.reasons) == 1 else f"reach of {name}"
        covered = ", ".join((f"{100 * np.mean(reason == 0):.0f} %", *lacking))
        rows.append(Finding(f"{what} in {whose}", covered, "100 %", not lacking))
    return rows


def _holds(body: Body, point_mm: np.ndarray) -> bool:
    """Whether a body encloses a point (3,) mm of the world."""
    return bool(points_inside(body.mesh, frames.apply(frames.invert(body.pose), point_mm[None]))[0])


def _work_findings(scene: Scene, work: Work) -> tuple[Finding, ...]:
    limits, (low, high) = scene.spec.limits, scene.spec.camera.range_mm
    least, rows = float(work.clearance_mm.min()), _reach_findings(scene, work, "ring")
    rows.append(
        Finding(
            "clearance at work",
            f"{least:.1f} mm" if least >= 0.0 else "touches",
            f"{limits.clearance_mm:g} mm",
            least >= limits.clearance_mm,
        )
    )
    for name, look in work.looks.items():
        seen = float(work.views[name].min())
        several = len(work.looks) > 1
        rows.append(
            Finding(
                f"ring in view of {name}" if several else "ring in view",
                f"{100 * seen:.0f} %",
                f"{100 * limits.view_fraction:.0f} %",
                seen >= limits.view_fraction,
            )
        )
        rows.append(
            Finding(
                f"{name} to lesion" if several else "camera to lesion",
                f"{look.distance_mm:.0f} mm",
                f"{low:g} to {high:g} mm",
                low <= look.distance_mm <= high,
            )
        )
    for name, touch in work.touches.items():
        value = f"{touch.miss_mm:.1f} mm off its place"
        rows.append(Finding(f"{name} at the lesion", value, f"{TOUCHED_MM:g} mm", touch.reached))
    return tuple(rows)


def _way_finding(
    scene: Scene, checker: CollisionChecker, arms: dict[str, MountedArm], work: Work
) -> Finding:
    return _contacts(scene, "contacts at rest and on the path", *_ways(checker, arms, work))


def _contacts(
    scene: Scene, what: str, touching: list[str], least_mm: float, half_step_mm: float
) -> Finding:
    """The line on contacts of arms, and on the clearance that the steps between shapes ask for."""
    wanted = max(scene.spec.limits.clearance_mm, half_step_mm)
    near = f"none (closest {least_mm:.1f} mm)"
    if least_mm < wanted:
        near = f"too near, {least_mm:.2f} mm"
    return Finding(
        what,
        ", ".join(touching) or near,
        f"none, {wanted:.3g} mm clearance",
        not touching and least_mm >= wanted,
    )


def _insertion_findings(
    scene: Scene, checker: CollisionChecker, arms: dict[str, MountedArm]
) -> list[Finding]:
    """Contacts while all arms are fed in through the ports of a scene's wall, all by the same way.

    `keyhole_ablation` does so. Without a body named `WALL` nothing is checked.
    """
    if WALL not in [body.name for body in scene.bodies]:
        return []
    ways = {name: arm.way_in() for name, arm in arms.items()}
    moments = [dict(zip(ways, lines, strict=True)) for lines in zip(*ways.values(), strict=True)]
    found = _closest(checker, arms, moments)
    what = f"insertion through the ports ({FEED_MM:g} mm)"
    return [_contacts(scene, what, *found, 0.5 * FEED_STEP_MM)]


def _view(
    checker: CollisionChecker,
    name: str,
    look: EndoscopePose,
    scenes: list[dict[str, ArmShape]],
    ring: Ring,
    camera: CameraSpec,
) -> np.ndarray:
    """Fraction of ring points in view of an endoscope at every VIEW_EVERYth moment.

    The endoscope stands still: what the bodies hide from it is found once.
    """
    given = camera.camera(), look.pose, ring.points_mm, ring.normals
    among_bodies, arms_alone = view(checker, *given).visible, CollisionChecker([])
    fractions = []
    for shapes in scenes[::VIEW_EVERY]:
        others = {other: shape for other, shape in shapes.items() if other != name}
        visible = among_bodies & view(arms_alone, *given, others).visible
        fractions.append(visible.mean())
    return np.array(fractions)


def _ways(
    checker: CollisionChecker, arms: dict[str, MountedArm], work: Work
) -> tuple[list[str], float, float]:
    """Contacts at rest and on the paths to the lesion, endoscopes first; smallest clearance.

    Each plain tip goes back to rest before the next arm moves. The third result is half the largest
    step (mm). Between two checked shapes no point of an arm is farther than that from one of them,
    so with a larger clearance no contact is missed.
    """
    ways = {
        name: arms[name].lines(arms[name].approach(look.commands))[0]
        for name, look in work.looks.items()
    }
    ways |= {name: touch.way_mm for name, touch in work.touches.items()}
    ways |= {
        name: arms[name].lines(arms[name].approach(cut.centre))[0]
        for name, cut in work.cuts.items()
    }
    stand = {name: way[0] for name, way in ways.items()}
    moments = []
    for name, way in ways.items():
        moments += [stand | {name: line} for line in way]
        if name not in work.touches:
            stand[name] = way[-1]
    steps = [np.linalg.norm(np.diff(way, axis=0), axis=-1).max() for way in ways.values()]
    return *_closest(checker, arms, moments), 0.5 * float(max(steps))


def _closest(
    checker: CollisionChecker, arms: dict[str, MountedArm], moments: list[dict[str, np.ndarray]]
) -> tuple[list[str], float]:
    """Contacts in words, each once, and the smallest clearance (mm) of arms at some moments.

    moments: centrelines (K, 3) mm of each arm by name, world frame.
    """
    touching: dict[str, None] = {}
    least = np.inf
    for lines in moments:
        shapes = {name: ArmShape(lines[name], arms[name].reach.radius_mm) for name in arms}
        for collision in checker.collisions(shapes):
            touching[f"{collision.arm} touches {collision.other}"] = None
        least = min(least, checker.clearance(shapes).least_mm)
    return list(touching), float(least)


@dataclass(frozen=True, eq=False)
class Patch:
    """Reachability of the surface around the lesion for one laser."""

    flat_mm: np.ndarray
    """(N, 2) places in the plane of the lesion (mm), its centre at (0, 0)."""
    reason: np.ndarray
    """(N,) int: index into REASONS."""
    incidence_rad: np.ndarray
    """(N,) between beam and surface normal (rad)."""
    ring_flat_mm: np.ndarray
    """(M, 2) the ring in the same plane (mm)."""


def reach_patch(
    scene: Scene, reaches: dict[str, ArmReach], count: int = 48, name: str = "laser"
) -> Patch:
    """Reach and incidence on circles about the lesion's centre, out to 1.6 of its diameter.

    name: of the laser arm; no other arm stands in its way.
    """
    mesh, ring, laser = scene.organ.world_mesh, scene.ring, scene.spec.laser
    arm = MountedArm.at(scene.spec.mount(name), reaches[name])
    _, face = nearest_on_surface(mesh, ring.centre_mm[None])
    engine = BatchedScene(scene.bodies, {name: arm.reach.radius_mm}, most_nodes=PLANNING_NODES)
    plane = frames.rotation_from_z(ring.normal)
    flat, reasons, incidences = [], [], []
    for share in PATCH_SHARES:
        circle = circle_on(
            mesh, ring.centre_mm, int(face[0]), share * scene.spec.lesion.diameter_mm, count
        )
        if circle is None:
            break
        cut = solve_ring(arm, replace(circle, centre_mm=ring.centre_mm, normal=ring.normal), laser)
        lines = torch.from_numpy(cut.lines_mm)
        hit = engine.cast(
            lines[:, -1],
            torch.from_numpy(cut.directions),
            laser.standoff_mm[1] + 50.0,
            {name: lines},
            own=name,
        )
        away = np.abs(hit.distance_mm.numpy() - cut.standoff_mm)
        blocked = ~(hit.on_organ.numpy() & (away <= LANDED_MM))
        near = engine.clearance({name: lines}).least_mm.numpy()
        tests = (~cut.in_reach, cut.steep, blocked, near < scene.spec.limits.clearance_mm)
        reasons.append(np.select(tests, range(1, 5), 0))
        incidences.append(cut.incidence_rad)
        flat.append(((circle.points_mm - ring.centre_mm) @ plane)[:, :2])
    return Patch(
        np.concatenate(flat),
        np.concatenate(reasons),
        np.concatenate(incidences),
        ((ring.points_mm - ring.centre_mm) @ plane)[:, :2],
    )


def reach_patches(scene: Scene, reaches: dict[str, ArmReach], count: int = 48) -> dict[str, Patch]:
    """`reach_patch` of each laser of a scene, by name."""
    lasers = scene.spec.arms_with("laser")
    return {name: reach_patch(scene, reaches, count, name) for name in lasers}
