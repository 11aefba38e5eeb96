"""Make a scene from mesh files: read, repair, place the lesion, find mounts, write the folder."""

import os
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from surgisoft.errors import InputError, exists_already, unknown_name
from surgisoft.files import new_folder
from surgisoft.progress import Progress, silent
from surgisoft.scene import frames
from surgisoft.scene.batched import BatchedScene
from surgisoft.scene.check import PLANNING_NODES, SceneCheck, check_scene, sentence
from surgisoft.scene.folder import Scene
from surgisoft.scene.inside import buried_faces
from surgisoft.scene.lesion import (
    OrganSurface,
    Site,
    directed_site,
    dropped,
    good_sites,
    nearest_on_surface,
    patch_normal,
    pointed_site,
)
from surgisoft.scene.mesh import ROLES, Body, Mesh, used_indices
from surgisoft.scene.meshio import (
    ABSURD,
    GLTF,
    MM_PER_UNIT,
    PLAUSIBLE_MM,
    LengthUnit,
    Part,
    given_unit,
    read_parts,
    stored_unit,
    write_ply,
)
from surgisoft.scene.mounted_arm import RingSolution
from surgisoft.scene.mounts import Arrangement, find_mounts
from surgisoft.scene.reach import ArmReach
from surgisoft.scene.repair import INNER_BODIES, repair
from surgisoft.scene.segmentation import (
    Label,
    SegmentedLesion,
    is_segmentation,
    read_segmentation,
)
from surgisoft.scene.spec import (
    FILE,
    BodySpec,
    CameraSpec,
    LaserSpec,
    LesionSpec,
    LimitsSpec,
    MountSpec,
    SceneSpec,
    save_spec,
)

FAR_OFF = 20.0
"""A mesh whose middle is farther from the origin than this many times its size is moved there."""
REPORTED_FROM_MM = 1.0
"""If a given lesion is moved farther than this onto the surface, the distance is printed (mm)."""
UP = {
    "z": np.eye(3),
    "-z": np.diag([1.0, -1.0, -1.0]),
    "y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
    "-y": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "x": np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
    "-x": np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]),
}
"""Rotations that turn an axis of a file up, along the world's z; keys are the axes."""
MARGIN_MM = 5.0
"""Healthy tissue between a segmented lesion and its ring (mm): the margin that ablation of liver
tumours aims at (Ahmed et al. 2014, Radiology 273:241)."""
DIAMETER_MM = 20.0
"""Diameter of the ring where the user gives none and the image holds no lesion (mm)."""
DIAMETERS_MM = (0.5, 500.0)
"""Least and largest diameter of a ring that is accepted (mm): a slip of the unit is outside."""
WIDEST_MM = 100.0
"""Largest margin and clearance that are accepted (mm)."""
CENTRING_STEPS = 8
"""Most turns in which a ring is centred over a segmented lesion (a count)."""
CENTRED_MM = 0.02
"""A ring is centred over a lesion to this distance (mm)."""
COARSE_RING = 36
"""Number of ring points during the search for mounts."""
CROSSING = "the surface intersects itself, only its outermost part counts; faces inside the solid"
"""Note on a body whose surface intersects itself; the number of faces follows."""


INNER_HINT = (
    " (where one was a lesion, place it by --lesion X Y Z; a vessel belongs into a file of its own)"
)
"""Hint behind the number of bodies that lay inside another one."""


@dataclass(frozen=True)
class Request:
    """The request for a new scene, as the user gave it."""

    meshes: tuple[Path, ...]
    """Mesh files; the first holds the organ."""
    roles: tuple[str, ...]
    """Role of each file's bodies: organ, keep-out or support."""
    unit: str | None = None
    """Unit of every mesh file; None: the one that the format prescribes, else mm."""
    scale: float | None = None
    """Millimetres in one unit of every mesh file, in place of `unit`."""
    up: str | None = None
    """Axis of the files that points up, a key of UP; None: y for glTF, which prescribes it, y
    (anterior) for segmented images, else z."""
    labels: tuple[Label, ...] = ()
    """Labels of a segmented image that become bodies, and the lesion."""
    margin_mm: float | None = None
    """Distance of the ring from a segmented lesion (mm); None: MARGIN_MM."""
    lesion: tuple[float, float, float] | None = None
    """Point near which the lesion goes, in the first file's own frame and unit."""
    lesion_direction: tuple[float, float, float] | None = None
    """Side of the organ on which the lesion goes."""
    diameter_mm: float | None = None
    """Diameter of the ring (mm); None: around a segmented lesion with its margin, else
    DIAMETER_MM."""
    laser: LaserSpec = field(default_factory=LaserSpec)
    """The laser."""
    camera: CameraSpec = field(default_factory=CameraSpec)
    """The camera."""
    limits: LimitsSpec = field(default_factory=LimitsSpec)
    """The limits."""

    def __post_init__(self):
        """Raise InputError for contradicting or idle options and for lengths out of range."""
        point, direction, diameter_mm = self.lesion, self.lesion_direction, self.diameter_mm
        if point is not None and direction is not None:
            raise InputError("both --lesion and --lesion-direction are given; expected one of them")
        if direction is not None and not 1e-9 < float(np.linalg.norm(direction)) < np.inf:
            raise InputError(
                f"--lesion-direction is {direction}; expected a vector that is not zero"
            )
        if point is not None and not np.isfinite(point).all():
            raise InputError(f"--lesion is {point}; expected finite coordinates")
        low, high = DIAMETERS_MM
        if diameter_mm is not None and not low <= diameter_mm <= high:
            raise InputError(f"--diameter is {diameter_mm:g}; expected {low:g} to {high:g} mm")
        for name, value in (("margin", self.margin_mm), ("clearance", self.limits.clearance_mm)):
            if value is not None and not 0.0 <= value <= WIDEST_MM:
                raise InputError(f"--{name} is {value:g}; expected 0 to {WIDEST_MM:g} mm")
        self._check_idle()

    def _check_idle(self) -> None:
        """Raise InputError for a margin, a unit or a scale that would have no effect."""
        images = [path for path in self.meshes if is_segmentation(path)]
        for name, given in (("unit", self.unit), ("scale", self.scale)):
            if given is not None and images and len(images) == len(self.meshes):
                raise InputError(
                    f"--{name} is given for {images[0]}, a segmented image, whose header states "
                    f"the size of its voxels; leave --{name} out"
                )
        if self.margin_mm is None:
            return
        if self.diameter_mm is not None:
            raise InputError(
                "both --diameter and --margin are given, and each sets the size of the ring; "
                "expected one of them"
            )
        if self.lesion is not None or self.lesion_direction is not None:
            other = "lesion" if self.lesion is not None else "lesion-direction"
            raise InputError(
                f"--margin is given beside --{other}; expected it for a segmented lesion alone: "
                "give --diameter"
            )
        if not images or (self.labels and all(one.role != "lesion" for one in self.labels)):
            raise InputError(
                "--margin is given without a segmented lesion; expected an image with --label "
                "LABEL:lesion, or --diameter in place of --margin"
            )


@dataclass(frozen=True, eq=False)
class Prepared:
    """Closed bodies in mm, and the repairs of the files."""

    names: tuple[str, ...]
    """Names of the bodies; the first file's come first, largest first."""
    roles: tuple[str, ...]
    """Role of each."""
    operable: tuple[int, ...]
    """Numbers of the bodies on which a lesion may lie: all of a file or label of the role organ."""
    meshes: tuple[Mesh, ...]
    """Closed meshes, world frame, mm."""
    holes_mm: tuple[np.ndarray, ...]
    """For each mesh (F,) mm: width of the hole that a face closes, 0 for a face of the file."""
    to_world: np.ndarray
    """(3, 3) from the first file's own frame and unit to the world frame, mm, before the shift."""
    shift_mm: np.ndarray
    """(3,) by which everything was moved (mm)."""
    lesion: SegmentedLesion | None
    """A segmented lesion, world frame; None without one."""
    notes: tuple[str, ...]
    """Units, directions and repairs, one line each."""


@dataclass(frozen=True, eq=False)
class Authored:
    """A scene that was made, not yet written."""

    scene: Scene
    """The scene; its folder is not yet there."""
    check: SceneCheck
    """Result of checking it with FCL."""
    notes: tuple[str, ...]
    """Units, repairs and choices, one line each."""


_NamedBody = tuple[str, Mesh, np.ndarray]
"""Name, closed mesh, and (F,) mm: width of the hole that each face closes, else 0."""


class NoMounts(InputError):
    """No mounts were found for the lesion; the message gives the best one and its flaw."""

    def __init__(self, message: str, notes: tuple[str, ...] = ()):
        """`notes` are the units and repairs, which may be the reason."""
        super().__init__(message)
        self.notes = notes


def prepare(request: Request, report: Progress = silent) -> Prepared:
    """Read and repair every file; an InputError gives the reason why one cannot be used."""
    for role in request.roles:
        if role not in ROLES:
            raise unknown_name("role", role, ROLES)
    if request.roles[0] != "organ":
        raise InputError(
            f"the first mesh has the role '{request.roles[0]}'; expected the organ first"
        )
    _check_frame(request)
    notes: list[str] = []
    names: list[str] = []
    roles, meshes, holes_mm, frames_to_world = [], [], [], []
    operable: list[int] = []
    lesion: SegmentedLesion | None = None
    unit: LengthUnit | None = None
    organ_mm = np.zeros((2, 3))
    for i, (path, role) in enumerate(zip(request.meshes, request.roles, strict=True)):
        on_step = partial(_report_step, report, i, len(request.meshes), path.name)
        on_step("reading")
        up = request.up or ("y" if is_segmentation(path) or path.suffix.lower() in GLTF else "z")
        if is_segmentation(path):
            image = read_segmentation(path, request.labels, on_step)
            parts, part_roles, scale = image.parts, image.roles, 1.0
            notes += image.notes
            if image.lesion is not None:
                lesion = image.lesion.moved(UP[up], np.zeros(3))
        else:
            parts = read_parts(path)
            part_roles = tuple(role for _ in parts)
            unit = _unit(request, path, _size(path, parts), unit if i else None)
            scale = unit.mm
            doubt = _doubt(path, _box(parts, UP[up]), organ_mm, unit) if i else ""
            notes.append(f"{path.name}: unit {unit.sentence}{doubt}")
        if up != "z":
            what = "anterior (y)" if is_segmentation(path) and up == "y" else up
            notes.append(f"{path.name}: {what} points up; another axis needs --up")
        frames_to_world.append(scale * UP[up])
        if i == 0:
            organ_mm = _box(parts, frames_to_world[0])
        for group, group_role in _by_role(parts, part_roles):
            found = _closed_bodies(path, group, frames_to_world[-1], notes, on_step)
            found = sorted(found, key=lambda body: -_area(body[1]))
            for k, (name, mesh, hole_mm) in enumerate(found):
                if group_role == "organ":
                    operable.append(len(names))
                names.append(_free_name(name, names))
                roles.append(group_role if k == 0 or group_role != "organ" else "keep-out")
                meshes.append(mesh)
                holes_mm.append(hole_mm)
    bounds = meshes[0].bounds_mm
    middle, size = bounds.mean(axis=0), np.ptp(bounds, axis=0).max()
    shift = np.zeros(3)
    if np.linalg.norm(middle) > FAR_OFF * size or lesion is not None:
        shift = -middle
        meshes = [Mesh(mesh.vertices_mm + shift, mesh.faces) for mesh in meshes]
        notes.append(f"moved by {tuple(shift.round(3).tolist())} mm to the origin")
    if len(meshes) > 1:
        listed = ", ".join(f"{name} ({role})" for name, role in zip(names, roles, strict=True))
        notes.append(f"{len(meshes)} bodies: {listed}")
    return Prepared(
        tuple(names),
        tuple(roles),
        tuple(operable),
        tuple(meshes),
        tuple(holes_mm),
        frames_to_world[0],
        shift,
        None if lesion is None else lesion.moved(np.eye(3), shift),
        tuple(notes),
    )


def _check_frame(request: Request) -> None:
    """Raise an InputError for an unknown or contradicting unit, scale or axis, or idle labels."""
    if request.unit is not None and request.unit not in MM_PER_UNIT:
        raise unknown_name("unit", request.unit, MM_PER_UNIT)
    if request.unit is not None and request.scale is not None:
        raise InputError("both --unit and --scale are given; expected one of them")
    if request.scale is not None and not 1e-6 <= request.scale <= 1e6:
        raise InputError(f"--scale is {request.scale:g}; expected 1e-6 to 1e6 mm in one unit")
    if request.up is not None and request.up not in UP:
        raise unknown_name("axis", request.up, UP)
    images = [path for path in request.meshes if is_segmentation(path)]
    if images and images != [request.meshes[0]]:
        raise InputError(f"{images[-1]}: a segmented image; expected it as the first file")
    if request.labels and not images:
        raise InputError("--label is given for meshes; expected a segmented image (NIfTI, NRRD)")


def _size(path: Path, parts: Sequence[Part]) -> float:
    """The largest side of a file's meshes, in the file's unit."""
    corners = np.concatenate([part.vertices[used_indices(part.faces)[0]] for part in parts])
    size = float(np.ptp(corners, axis=0).max())
    if size == 0.0:
        raise InputError(f"{path}: all vertices are one point; expected a surface")
    return size


def _unit(request: Request, path: Path, size: float, first: LengthUnit | None) -> LengthUnit:
    """The unit of a mesh file: the one given, that of the first file, or the format's own."""
    if first is not None:
        if path.suffix.lower() in GLTF and request.unit is None and request.scale is None:
            return stored_unit(path, size)
        return LengthUnit(first.mm, f"that of {request.meshes[0].name}")
    if request.unit is not None or request.scale is not None:
        return given_unit(path, size, request.unit, request.scale)
    return stored_unit(path, size)


def _box(parts: Sequence[Part], to_world: np.ndarray) -> np.ndarray:
    """(2, 3): least and largest coordinates of a file's meshes, turned and scaled by (3, 3)."""
    corners = [part.vertices[used_indices(part.faces)[0]] for part in parts]
    turned = np.concatenate(corners) @ to_world.T
    return np.stack((turned.min(axis=0), turned.max(axis=0)))


def _doubt(path: Path, box: np.ndarray, organ_mm: np.ndarray, unit: LengthUnit) -> str:
    """Words about a further body whose unit seems wrong, with the units that fit; else empty.

    It seems wrong where the body is farther from the organ than the organ is large, or below the
    size at which an organ's is an error. Above it raises InputError.

    box: (2, 3) the body's least and largest coordinates, in the file's unit; organ_mm: (2, 3) mm.
    """
    organ, (low, high) = float(np.ptp(organ_mm, axis=0).max()), PLAUSIBLE_MM

    def placed(mm: float) -> tuple[float, float]:
        apart = np.maximum(mm * box[0] - organ_mm[1], organ_mm[0] - mm * box[1])
        return mm * float(np.ptp(box, axis=0).max()), float(np.linalg.norm(apart.clip(min=0.0)))

    def fits(mm: float) -> bool:
        size, away = placed(mm)
        return away <= organ and low / ABSURD <= size <= high * ABSURD

    def told(mm: float) -> str:
        size, away = (f"{x:.2g}" if x < 10.0 else f"{x:.0f}" for x in placed(mm))
        return f"{size} mm across and about {away} mm away"

    if fits(unit.mm):
        return ""
    others = [f"; in {u} it would be {told(mm)}" for u, mm in MM_PER_UNIT.items() if fits(mm)]
    doubt = (
        f", but the body would be {told(unit.mm)} from the organ, which is {organ:.3g} mm across"
        f"{''.join(others)}"
    )
    if placed(unit.mm)[0] > high * ABSURD:
        raise InputError(
            f"{path}: unit {unit.sentence}{doubt}; expected the unit of the organ: scale this file"
        )
    return f"{doubt}: scale this file if its unit is another"


def _by_role(parts: Sequence[Part], roles: Sequence[str]) -> list[tuple[list[Part], str]]:
    """Parts with one role in a row, together with that role."""
    groups: list[tuple[list[Part], str]] = []
    for part, role in zip(parts, roles, strict=True):
        if groups and groups[-1][1] == role:
            groups[-1][0].append(part)
        else:
            groups.append(([part], role))
    return groups


def _closed_bodies(path, parts, to_world, notes, on_step) -> list[_NamedBody]:
    """Repair every part; if one cannot be repaired, take all parts as one surface.

    If that cannot be repaired either, the broken parts are left out; an error if nothing is left.
    """
    found, failures, done = _repaired(path, parts, to_world, on_step)
    if failures and len(parts) > 1:
        starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
        whole = Part(
            path.stem,
            np.concatenate([part.vertices for part in parts]),
            np.concatenate([part.faces + i for part, i in zip(parts, starts, strict=True)]),
        )
        together, broken, done_together = _repaired(path, [whole], to_world, on_step)
        if not broken:
            notes.append(f"{path.name}: its {len(parts)} parts make up one surface")
            found, failures, done = together, [], done_together
    if not found:
        raise failures[0]
    usual = {INNER_BODIES: INNER_HINT}
    if path.suffix.lower() == ".stl":
        usual["duplicate vertices joined"] = " (an STL repeats every corner)"
    for what, count in done.items():
        note = usual.get(what, "")
        notes.append(f"{path.name}: {what}: {count}{note}")
    notes += [f"left out: {error}" for error in failures]
    return found


def _report_step(report: Progress, number: int, count: int, name: str, what: str) -> None:
    """Report the step for file `number` of `count`; reading is the first 5 % of the work."""
    report(5.0 * number / count, 100, f"{name}: {what}")


def _repaired(path, parts, to_world, on_step) -> tuple[list[_NamedBody], list[InputError], dict]:
    """Named closed bodies of the parts, errors of parts beyond repair, counts of repairs."""
    found, failures = [], []
    done: dict[str, int] = {}
    for part in parts:
        what = str(path) if len(parts) == 1 else f"{path} ({part.name})"
        try:
            repaired = repair(part.vertices @ to_world.T, part.faces, what, on_step)
        except InputError as error:
            failures.append(error)
            continue
        for fix in repaired.repairs:
            done[fix.done] = done.get(fix.done, 0) + fix.count
        on_step("looking for faces inside the solid")
        if inside := sum(buried_faces(mesh) for mesh in repaired.bodies):
            done[CROSSING] = done.get(CROSSING, 0) + inside
        named = len(parts) > 1 or is_segmentation(path)
        name = Path(part.name).stem if named else path.stem
        found += [
            (name, mesh, hole_mm)
            for mesh, hole_mm in zip(repaired.bodies, repaired.holes_mm, strict=True)
        ]
    return found, failures, done


def _area(mesh: Mesh) -> float:
    return float(mesh.face_areas_mm2.sum())


def _free_name(name: str, taken: Sequence[str]) -> str:
    """A valid body name that is not in use."""
    plain = "".join(c if c.isascii() and (c.isalnum() or c in "_-") else "_" for c in name)
    plain = plain.strip("_")[:50] or "body"
    numbers = iter(range(2, len(taken) + 3))
    result = plain
    while result in taken:
        result = f"{plain}_{next(numbers)}"
    return result


def choose_sites(request: Request, prepared: Prepared) -> list[Site]:
    """Places for the lesion: the given or segmented one, otherwise several good ones."""
    surfaces = [
        OrganSurface(mesh, hole_mm)
        for mesh, hole_mm in zip(prepared.meshes, prepared.holes_mm, strict=True)
    ]
    operable = [surfaces[i] for i in prepared.operable]
    diameter_mm = ring_diameter(request, prepared)
    point = given_point_mm(request, prepared)
    if request.lesion is not None and point is not None:
        given = f"--lesion {' '.join(f'{x:g}' for x in request.lesion)}"
        if not np.allclose(point, request.lesion):
            given += f" (in the scene {', '.join(f'{x:.4g}' for x in point)} mm)"
        return [pointed_site(operable, point, diameter_mm, given)]
    if request.lesion_direction is not None:
        direction = prepared.to_world @ np.asarray(request.lesion_direction)
        return [directed_site(operable, direction, diameter_mm)]
    if prepared.lesion is not None:
        point = seen_lesion(request, prepared).point_mm
        return [pointed_site(operable[:1], point, diameter_mm, "the segmented lesion")]
    return good_sites(surfaces, diameter_mm)


def given_point_mm(request: Request, prepared: Prepared) -> np.ndarray | None:
    """(3,) mm: the point that was given for the lesion, world frame; None without one."""
    if request.lesion is None:
        return None
    return prepared.to_world @ np.asarray(request.lesion) + prepared.shift_mm


def ring_diameter(request: Request, prepared: Prepared) -> float:
    """Diameter of the ring (mm): the given one, or around the segmented lesion, or DIAMETER_MM."""
    if request.diameter_mm is not None:
        return request.diameter_mm
    if prepared.lesion is None or request.lesion or request.lesion_direction:
        return DIAMETER_MM
    return seen_lesion(request, prepared).ring_mm


@dataclass(frozen=True, eq=False)
class SeenLesion:
    """A segmented lesion as seen along the normal of its ring."""

    point_mm: np.ndarray
    """(3,) mm: point of the organ's surface over the middle of the lesion, the ring's centre."""
    radius_mm: float
    """Radius of the smallest circle around its voxels' centres (mm)."""
    ring_mm: float
    """Diameter of the ring around it with the margin, or the one that was given (mm)."""
    depth_mm: float
    """Least distance of its surface from the organ's (mm)."""


def seen_lesion(request: Request, prepared: Prepared) -> SeenLesion:
    """Where the ring of a segmented lesion goes, and how large the lesion is as seen from there.

    The normal of a ring is the mean of the surface inside it, so its centre and its size depend on
    each other: both are found by turns, from the surface point nearest to the lesion's middle.
    """
    lesion, organ = prepared.lesion, prepared.meshes[0]
    assert lesion is not None, "the image holds a lesion"
    margin_mm = MARGIN_MM if request.margin_mm is None else request.margin_mm
    middle = lesion.voxels_mm.mean(axis=0)
    spread = float(np.linalg.norm(lesion.voxels_mm - middle, axis=1).max())
    point, face = (part[0] for part in nearest_on_surface(organ, middle[None]))
    given = request.diameter_mm
    ring_mm = given or round(2.0 * (spread + margin_mm), 1)
    radius = spread
    for _ in range(CENTRING_STEPS):
        normal = patch_normal(organ, point, int(face), 0.5 * ring_mm)
        plane = frames.rotation_from_z(normal)[:, :2]
        aside, radius = enclosing_circle((lesion.voxels_mm - point) @ plane)
        ring_mm = given or round(2.0 * (radius + margin_mm), 1)
        flat = (point + plane @ aside)[None]
        height, under = dropped(organ, flat, point, normal, 4.0 * (ring_mm + spread))
        if under[0] < 0:
            break
        point, face = (flat + height[:, None] * normal)[0], under[0]
        if np.linalg.norm(aside) < CENTRED_MM:
            break
    sampled = lesion.surface_mm[:: max(1, len(lesion.surface_mm) // 500)]
    near, _ = nearest_on_surface(organ, sampled)
    depth = float(np.linalg.norm(near - sampled, axis=1).min())
    return SeenLesion(point, radius, ring_mm, depth)


def enclosing_circle(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre (2,) and radius of the smallest circle around plane points (N, 2).

    Each point outside of the circle of the points before it lies on the circle's edge (Welzl 1991).
    """
    from scipy.spatial import ConvexHull, QhullError

    try:
        points = points[ConvexHull(points).vertices]
    except (QhullError, ValueError):  # few points, or all on a line
        points = np.unique(points, axis=0)
    points = np.random.default_rng(0).permutation(points)

    def around(edge: list[np.ndarray]) -> tuple[np.ndarray, float]:
        first = edge[0]
        sides = np.array([other - first for other in edge[1:]]).reshape(-1, 2)
        away = np.linalg.lstsq(2.0 * sides, (sides**2).sum(axis=1), rcond=None)[0]
        return first + away, float(np.linalg.norm(away))

    def smallest(count: int, edge: list[np.ndarray]) -> tuple[np.ndarray, float]:
        centre, radius = around(edge) if edge else (points[0], 0.0)
        for i in range(count):
            outside = np.linalg.norm(points[i] - centre) > radius * (1.0 + 1e-9) + 1e-9
            if outside and len(edge) < 3:
                centre, radius = smallest(i, [*edge, points[i]])
        return centre, radius

    return smallest(len(points), [])


def author(
    request: Request,
    reaches: dict[str, ArmReach],
    mounts: dict[str, MountSpec],
    name: str,
    report: Progress = silent,
) -> Authored:
    """Make and check a scene from mesh files; nothing is written.

    `mounts` gives each arm's tool, model and size by the arm's name, `reaches` its reach table;
    this function finds its place.
    """
    prepared = prepare(request, report)
    report(5, 100, "meshes read")
    request = replace(request, diameter_mm=ring_diameter(request, prepared), margin_mm=None)
    sites = choose_sites(request, prepared)
    report(10, 100, "lesion placed")
    failures: list[tuple[float, str]] = []
    for number, site in enumerate(sites):
        bodies = _bodies(prepared, site)
        engine = BatchedScene(
            bodies,
            {name: reach.radius_mm for name, reach in reaches.items()},
            most_nodes=PLANNING_NODES,
        )
        span = (10 + 80 * number / len(sites), 80 / len(sites))
        arrangements, shortfall = find_mounts(
            engine,
            reaches,
            mounts,
            _coarse(site.ring),
            request.laser,
            request.camera,
            request.limits,
            lambda done, total, note="", span=span: report(
                span[0] + span[1] * done / total / 2, 100, note
            ),
        )
        for arranged in arrangements:
            scene = _scene(request, prepared, site, bodies, arranged, mounts, name)
            check = check_scene(scene, reaches)
            if check.good:
                chosen = _chosen(request, scene, check, site, prepared)
                return Authored(scene, check, (*prepared.notes, *chosen))
            why = sentence(check).removesuffix(".")
            failures.append((check.work.covered if check.work else 0.0, why))
        if shortfall is not None:
            failures.append((shortfall.covered, shortfall.sentence))
    best = max(failures, key=lambda failure: failure[0])[1]
    where = "the lesion" if len(sites) == 1 else f"any of {len(sites)} places for the lesion"
    raise NoMounts(f"no mounts were found for {where}: {best}", prepared.notes)


def _coarse(ring):
    """Every second point of the ring, for the search."""
    step = max(1, len(ring.points_mm) // COARSE_RING)
    return replace(
        ring,
        points_mm=ring.points_mm[::step],
        normals=ring.normals[::step],
        faces=ring.faces[::step],
    )


def _bodies(prepared: Prepared, site: Site) -> tuple[Body, ...]:
    """The scene's bodies, the one with the lesion as an organ."""
    organ = prepared.operable[site.body]
    return tuple(
        Body(name, "organ" if i == organ else role, mesh)
        for i, (name, role, mesh) in enumerate(
            zip(prepared.names, prepared.roles, prepared.meshes, strict=True)
        )
    )


def _scene(request, prepared, site: Site, bodies, arranged: Arrangement, mounts, name) -> Scene:
    arms = {arm: found.arm for arm, found in arranged.sites.items()}
    spec = SceneSpec(
        name=name,
        bodies=tuple(BodySpec(body.name, f"{body.name}.ply", body.role) for body in bodies),
        lesion=LesionSpec(
            prepared.names[prepared.operable[site.body]],
            tuple(site.point_mm.round(4).tolist()),
            float(request.diameter_mm),
        ),
        mounts=tuple(
            replace(mounts[arm], **rounded_mount(at.pose[:3, 3], at.pose[:3, :3]))
            for arm, at in arms.items()
        ),
        laser=request.laser,
        camera=request.camera,
        limits=request.limits,
        note="Made by 'surgisoft scene new' from "
        + ", ".join(path.name for path in request.meshes),
    )
    return Scene(spec, Path(), bodies)


def rounded_mount(position_mm: np.ndarray, rotation: np.ndarray) -> dict[str, Any]:
    """A mount's place, rounded for the file: 0.01 mm, 6 digits of direction, 0.01 degrees of roll.

    position_mm (3,) and rotation (3, 3) of the base frame in the world frame. Returns
    `position_mm`, `direction` and `roll_deg` of a `MountSpec`.
    """
    direction = rotation[:, 2].round(6) + 0.0
    plain = frames.rotation_from_z(direction)
    roll = np.degrees(np.arctan2(rotation[:, 0] @ plain[:, 1], rotation[:, 0] @ plain[:, 0]))
    return {
        "position_mm": tuple((np.asarray(position_mm).round(2) + 0.0).tolist()),
        "direction": tuple(direction.tolist()),
        "roll_deg": float(np.round(roll, 2) + 0.0),
    }


def _nearer_body(request: Request, prepared: Prepared, site: Site) -> str:
    """Which body that is not operated on is nearer to the given point than the lesion; '' none."""
    point = given_point_mm(request, prepared)
    away = {
        name: float(np.linalg.norm(nearest_on_surface(mesh, point[None])[0] - point))
        for i, (name, mesh) in enumerate(zip(prepared.names, prepared.meshes, strict=True))
        if point is not None and i not in prepared.operable
    }
    name = min(away, key=lambda each: away[each], default="")
    if not name or away[name] >= site.moved_mm:
        return ""
    organ = prepared.names[prepared.operable[site.body]]
    return (
        f"the given point is nearer to '{name}' ({away[name]:.3g} mm) than to '{organ}' "
        f"({site.moved_mm:.3g} mm); a lesion lies on the organ, the body of the first file"
    )


def _chosen(
    request: Request, scene: Scene, check: SceneCheck, site: Site, prepared: Prepared
) -> list[str]:
    assert check.work is not None, "a scene that was chosen has its arms at work"
    cuts = check.work.cuts.values()
    centre = ", ".join(f"{x:.1f}" for x in scene.spec.lesion.centre_mm)
    moved = f"the given point was {site.moved_mm:.3g} mm off the surface and was moved onto it"
    segmented, nearer = prepared.lesion is not None, _nearer_body(request, prepared, site)
    if prepared.lesion is not None:
        seen = seen_lesion(request, prepared)
        voxel_mm = prepared.lesion.voxel_mm
        moved = (
            f"segmented lesion: {2.0 * seen.radius_mm:.3g} mm across seen from the surface between "
            f"the centres of its voxels (up to {voxel_mm:.2g} mm more to their edges), its top "
            f"{seen.depth_mm:.2g} mm below it"
        )
    return [
        *([moved] if segmented or site.moved_mm > REPORTED_FROM_MM else []),
        *([nearer] if nearer else []),
        f"lesion of {scene.spec.lesion.diameter_mm:g} mm on '{scene.spec.lesion.body}' at "
        f"[{centre}] mm",
        *([_beams(list(cuts))] if cuts else []),
    ]


def _beams(cuts: list[RingSolution]) -> str:
    """Length and incidence of the lasers' beams."""
    low, high = min(c.standoff_mm.min() for c in cuts), max(c.standoff_mm.max() for c in cuts)
    steepest = np.degrees(max(cut.incidence_rad.max() for cut in cuts))
    return f"beam {low:.0f} to {high:.0f} mm long, incidence up to {steepest:.0f} degrees"


def no_lesion_mesh(path: Path) -> InputError:
    """The error for a mesh file that was given as a lesion, with the point to give instead."""
    corners = np.concatenate(
        [part.vertices[used_indices(part.faces)[0]] for part in read_parts(path)]
    )
    middle = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
    across = float(np.ptp(corners, axis=0).max())
    return InputError(
        f"{path}: a lesion is a ring on the organ's surface, and no mesh; expected --lesion "
        f"{' '.join(f'{x:.4g}' for x in middle)} (the middle of this mesh, which is {across:.3g} "
        "across) and --diameter, or a segmented image with --label LABEL:lesion"
    )


def check_target(folder: Path, force: bool) -> None:
    """Raise an InputError if a scene cannot be written there; --force replaces scenes only."""
    above = next(place for place in folder.absolute().parents if place.exists())
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: cannot be written, {above} is not a writable folder")
    if not folder.exists():
        return
    if not force:
        raise exists_already(folder)
    if not folder.is_dir() or (not (folder / FILE).exists() and any(folder.iterdir())):
        raise InputError(f"{folder}: is not a scene; --force replaces only a scene's folder")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(f"{folder}: cannot be written, it is not a writable folder")


def write_scene(scene: Scene, folder: Path, force: bool = False) -> None:
    """Write meshes and scene.toml, whole or not at all: a temporary folder is moved there."""
    check_target(folder, force)
    with new_folder(folder) as fresh:
        for body, entry in zip(scene.bodies, scene.spec.bodies, strict=True):
            write_ply(body.mesh, fresh / entry.mesh)
        save_spec(scene.spec, fresh / FILE)
