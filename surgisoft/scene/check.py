"""Check a whole scene with FCL: meshes, lesion, both arms at rest and at work, the view."""

from dataclasses import dataclass, replace

import numpy as np
import torch

from surgisoft.errors import InputError
from surgisoft.progress import Progress, silent
from surgisoft.scene import frames
from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.camera import view
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.collision import CollisionChecker
from surgisoft.scene.folder import Scene
from surgisoft.scene.lesion import (
    ON_SURFACE_MM,
    circle_on,
    nearest_on_surface,
    path_off_mm,
    path_slack_mm,
)
from surgisoft.scene.mounted_arm import (
    LANDED_MM,
    EndoscopePose,
    MountedArm,
    RingSolution,
    look_at_lesion,
    solve_ring,
)
from surgisoft.scene.reach import ArmReach
from surgisoft.scene.spec import TOOLS

REASONS = ("can be cut", "out of reach", "too steep", "beam blocked", "no clearance", "arm jumps")
"""Meaning of a ring point's code; a point gets the first that applies after the first entry."""
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
    """Both arms at work, point by point of the ring (M of them)."""

    reason: np.ndarray
    """(M,) int: index into REASONS of each ring point."""
    cut: RingSolution
    """Inverse kinematics of the laser arm around the ring."""
    look: EndoscopePose
    """The endoscope arm turned to the lesion."""
    clearance_mm: np.ndarray
    """(M,) mm: smallest clearance of both arms with the beam on each point; -1 for contact."""
    view: np.ndarray
    """(M / VIEW_EVERY,) fraction of the ring in view with the beam on every VIEW_EVERYth point."""

    @property
    def covered(self) -> float:
        """Fraction of the ring that can be cut."""
        return float(np.mean(self.reason == 0))


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
    if check.good and check.work is not None:
        return (
            f"The scene is ready: the laser reaches {100 * check.work.covered:.0f} % of the ring, "
            f"the endoscope sees {100 * check.work.view.min():.0f} % of it, nothing comes closer "
            f"than {check.work.clearance_mm.min():.1f} mm."
        )
    bad = [f"{f.what}: {f.value} (needs {f.wanted})" for f in check.findings if not f.good]
    return f"The scene is not ready: {'; '.join(bad)}."


def mounted_arms(scene: Scene, reaches: dict[str, ArmReach]) -> dict[str, MountedArm]:
    """Both arms at their mounts, by tool."""
    return {tool: MountedArm.at(scene.spec.mount(tool), reaches[tool]) for tool in TOOLS}


def check_scene(
    scene: Scene,
    reaches: dict[str, ArmReach],
    report: Progress = silent,
) -> SceneCheck:
    """Check everything that a task relies on, by FCL on the meshes themselves.

    `reaches` holds the arms' reach tables by tool.
    """
    findings: tuple[Finding, ...] = (*_mesh_findings(scene), _lesion_finding(scene))
    if not findings[-1].good:
        return SceneCheck(findings, None)
    findings = (*findings, *_neighbour_findings(scene))
    checker, arms = CollisionChecker(scene.bodies), mounted_arms(scene, reaches)
    work = _work(scene, checker, arms, report)
    report(len(work.reason) + 1, len(work.reason) + 2, "paths from rest")
    ways = _way_finding(scene, checker, arms, work)
    return SceneCheck((*findings, *_work_findings(scene, work), ways), work)


def _work(
    scene: Scene, checker: CollisionChecker, arms: dict[str, MountedArm], report: Progress
) -> Work:
    """Move the laser once around the ring while the endoscope looks at it."""
    limits, ring = scene.spec.limits, scene.ring
    cut = solve_ring(arms["laser"], ring, scene.spec.laser)
    look = look_at_lesion(arms["endoscope"], ring, scene.spec.camera)
    radius = {tool: arms[tool].reach.radius_mm for tool in TOOLS}
    scope = ArmShape(look.line_mm, radius["endoscope"])
    shapes = [ArmShape(line, radius["laser"]) for line in cut.lines_mm]
    clearance, landed = np.empty(len(shapes)), np.zeros(len(shapes), dtype=bool)
    for i, shape in enumerate(shapes):
        both = {"laser": shape, "endoscope": scope}
        clearance[i] = -1.0 if checker.collisions(both) else checker.clearance(both).least_mm
        reach_mm = max(cut.standoff_mm[i], 0.0) + 50.0
        hit = checker.cast(cut.lines_mm[i, -1], cut.directions[i], reach_mm, both, own="laser")
        landed[i] = bool(hit.on_organ) and abs(hit.distance_mm - cut.standoff_mm[i]) <= LANDED_MM
        report(i + 1, len(shapes) + 2, "ring")
    # The arm moves to both neighbouring points. No point of it is then farther than half a step
    # from a checked shape. A step must be short compared with the arm's thickness.
    step = np.maximum(cut.step_mm, np.roll(cut.step_mm, 1))
    close = clearance < np.maximum(limits.clearance_mm, 0.5 * step)
    tests = (~cut.in_reach, cut.steep, ~landed, close, step > 0.5 * radius["laser"])
    reason = np.select(tests, range(1, len(REASONS)), 0)
    return Work(reason, cut, look, clearance, _view(checker, look, shapes, scene))


def _mesh_findings(scene: Scene) -> tuple[Finding, ...]:
    rows = []
    for body in scene.bodies:
        mesh = body.mesh
        closed = mesh.is_watertight and mesh.volume_mm3 > 0.0
        kind = "closed" if closed else "inside out" if mesh.is_watertight else "open"
        rows.append(
            Finding(
                f"{body.role} '{body.name}'",
                f"{len(mesh.faces)} faces, {kind}, {mesh.volume_mm3 / 1000.0:.4g} ml",
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
    if lies:
        try:
            scene.ring_of()
        except InputError:
            value, lies = f"its ring of {lesion.diameter_mm:g} mm extends over an edge", False
            if lesion.path_mm:
                away = path_off_mm(scene.organ.world_mesh, lesion)
                value = f"its path_mm leaves the surface by {away:.3g} mm"
    wanted = f"{ON_SURFACE_MM:g} mm, whole ring"
    if lesion.path_mm:
        wanted = f"{ON_SURFACE_MM:g} mm, path {path_slack_mm(lesion):g} mm"
    return Finding("lesion on the surface", value, wanted, lies)


def _neighbour_findings(scene: Scene) -> tuple[Finding, ...]:
    """Distance of the cut from each body that must not be touched, such as a vessel below it."""
    least = scene.spec.limits.clearance_mm
    rows = []
    for body in scene.bodies:
        if body.role == "keep-out":
            nearest, _ = nearest_on_surface(body.world_mesh, scene.ring.points_mm)
            away = float(np.linalg.norm(nearest - scene.ring.points_mm, axis=1).min())
            rows.append(
                Finding(f"ring to '{body.name}'", f"{away:.1f} mm", f"{least:g} mm", away >= least)
            )
    return tuple(rows)


def _work_findings(scene: Scene, work: Work) -> tuple[Finding, ...]:
    limits, (low, high) = scene.spec.limits, scene.spec.camera.range_mm
    lacking = [
        f"{100 * np.mean(work.reason == code):.0f} % {REASONS[code]}"
        for code in np.unique(work.reason[work.reason > 0])
    ]
    least, view_least = float(work.clearance_mm.min()), float(work.view.min())
    return (
        Finding(
            "ring in the laser's reach",
            ", ".join((f"{100 * work.covered:.0f} %", *lacking)),
            "100 %",
            not lacking,
        ),
        Finding(
            "clearance at work",
            f"{least:.1f} mm" if least >= 0.0 else "touches",
            f"{limits.clearance_mm:g} mm",
            least >= limits.clearance_mm,
        ),
        Finding(
            "ring in view",
            f"{100 * view_least:.0f} %",
            f"{100 * limits.view_fraction:.0f} %",
            view_least >= limits.view_fraction,
        ),
        Finding(
            "camera to lesion",
            f"{work.look.distance_mm:.0f} mm",
            f"{low:g} to {high:g} mm",
            low <= work.look.distance_mm <= high,
        ),
    )


def _way_finding(
    scene: Scene, checker: CollisionChecker, arms: dict[str, MountedArm], work: Work
) -> Finding:
    touching, least, half_step = _ways(checker, arms, work.cut, work.look)
    clearance = scene.spec.limits.clearance_mm
    return Finding(
        "contacts at rest and on the path",
        ", ".join(touching) or f"none (closest {least:.1f} mm)",
        f"none, {clearance:g} mm clearance",
        not touching and least >= max(clearance, half_step),
    )


def _view(
    checker: CollisionChecker, look: EndoscopePose, shapes: list[ArmShape], scene: Scene
) -> np.ndarray:
    """Fraction of ring points in view with the laser on every VIEW_EVERYth of them."""
    camera, ring = scene.spec.camera.camera(), scene.ring
    looks = (
        view(checker, camera, look.pose, ring.points_mm, ring.normals, {"laser": shape})
        for shape in shapes[::VIEW_EVERY]
    )
    return np.array([one.fraction for one in looks])


def _ways(
    checker: CollisionChecker, arms: dict[str, MountedArm], cut: RingSolution, look: EndoscopePose
):
    """Contacts at rest and on the path to the lesion, endoscope first; smallest clearance (mm).

    The third result is half the largest step (mm). Between two checked shapes no point of an arm is
    farther than that from one of them, so with a larger clearance no contact is missed.
    """
    scope_way = arms["endoscope"].lines(arms["endoscope"].approach(look.commands))[0]
    laser_way = arms["laser"].lines(arms["laser"].approach(cut.centre))[0]
    moments = [(laser_way[0], line) for line in scope_way]
    moments += [(line, scope_way[-1]) for line in laser_way]
    touching: dict[str, None] = {}
    least = np.inf
    for laser_line, scope_line in moments:
        both = {
            "laser": ArmShape(laser_line, arms["laser"].reach.radius_mm),
            "endoscope": ArmShape(scope_line, arms["endoscope"].reach.radius_mm),
        }
        for collision in checker.collisions(both):
            touching[f"{collision.arm} touches {collision.other}"] = None
        least = min(least, checker.clearance(both).least_mm)
    steps = [np.linalg.norm(np.diff(w, axis=0), axis=-1).max() for w in (scope_way, laser_way)]
    return list(touching), float(least), 0.5 * float(max(steps))


@dataclass(frozen=True, eq=False)
class Patch:
    """Reachability of the surface around the lesion for the laser arm."""

    flat_mm: np.ndarray
    """(N, 2) places in the plane of the lesion (mm), its centre at (0, 0)."""
    reason: np.ndarray
    """(N,) int: index into REASONS."""
    incidence_rad: np.ndarray
    """(N,) between beam and surface normal (rad)."""
    ring_flat_mm: np.ndarray
    """(M, 2) the ring in the same plane (mm)."""


def reach_patch(scene: Scene, reaches: dict[str, ArmReach], count: int = 48) -> Patch:
    """Reach and incidence on circles about the lesion's centre, out to 1.6 of its diameter."""
    mesh, ring, laser = scene.organ.world_mesh, scene.ring, scene.spec.laser
    arm = mounted_arms(scene, reaches)["laser"]
    _, face = nearest_on_surface(mesh, ring.centre_mm[None])
    engine = BatchedScene(scene.bodies, {"laser": arm.reach.radius_mm}, most_nodes=PLANNING_NODES)
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
            {"laser": lines},
            own="laser",
        )
        away = np.abs(hit.distance_mm.numpy() - cut.standoff_mm)
        blocked = ~(hit.on_organ.numpy() & (away <= LANDED_MM))
        near = engine.clearance({"laser": lines}).least_mm.numpy()
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
