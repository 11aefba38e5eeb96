"""The scene file `scene.toml` as frozen dataclasses: bodies, lesion, mounts, laser, camera.

Lengths are in mm, times in s. Angles are in degrees in the file, where the field's name ends in
`_deg`, else in radians. World frame: z up. An arm's base frame: z along the arm at rest.
"""

import csv
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Annotated

import numpy as np
from scipy.spatial.transform import Rotation

from surgisoft.config import (
    Rule,
    Where,
    from_table,
    read_toml,
    to_table,
    without_empty_tables,
    write_toml,
)
from surgisoft.errors import InputError, path_of, unknown_name
from surgisoft.numbers_in_text import natural_key
from surgisoft.scene import frames
from surgisoft.scene.camera import Camera
from surgisoft.scene.mesh import ROLES

_PACKAGE = Path(__file__).resolve().parents[1]
SCENES = (_PACKAGE if (_PACKAGE / "scenes").is_dir() else _PACKAGE.parent) / "scenes"
"""Folder of the packaged scenes: in the installed package, or beside it in a checkout."""
PHANTOM = SCENES / "phantom_liver"
"""Folder of the liver phantom."""


def packaged_scene(path: str | Path) -> Path:
    """The folder of the packaged scene of that name, or a scene file in it; other paths unchanged.

    A file or folder of that name in the working directory has precedence.
    """
    path = path_of("the scene", path)
    if path.exists() or path.is_absolute() or ".." in path.parts:
        return path
    there = SCENES / path
    return there if spec_file(there).is_file() else path


def spec_file(path: Path) -> Path:
    """The scene file in a folder, or the file itself."""
    return path if path.suffix == ".toml" else path / FILE


FORMAT = 1
FILE = "scene.toml"
WALL = "wall"
"""Name of the body through whose ports the arms are fed in, in scenes that have one."""
TOOLS = ("laser", "endoscope", "tip")
"""Tools of an arm: the laser's beam, the endoscope's camera, a plain tip that pushes and touches.
The order is that of the arms in a world, whatever their order in the file."""


def _one_of(known: tuple[str, ...]) -> Rule:
    return Rule("one of " + ", ".join(known), lambda value: value in known)


def _between(low: float, high: float, unit: str) -> Rule:
    unit = f" {unit}" if unit else ""
    return Rule(f"a number from {low:g} to {high:g}{unit}", lambda value: low <= value <= high)


def _is_inside_path(text: str) -> bool:
    path = PurePosixPath(text)
    return bool(text) and not path.is_absolute() and ".." not in path.parts and "\\" not in text


Length = Annotated[float, Rule("a length above 0 mm", lambda mm: 0.0 < mm <= 1e4)]
Distance = Annotated[float, _between(0.0, 1e4, "mm")]
Coordinate = Annotated[float, _between(-1e6, 1e6, "mm")]
Angle = Annotated[float, _between(-360.0, 360.0, "degrees")]
Point = Annotated[
    tuple[Coordinate, Coordinate, Coordinate], Rule("3 numbers [x, y, z] in mm", lambda p: True)
]
Angles = Annotated[
    tuple[Angle, Angle, Angle], Rule("3 numbers [x, y, z] in degrees", lambda p: True)
]
Direction = Annotated[
    tuple[float, float, float],
    Rule("3 numbers [x, y, z], not all zero", lambda d: 1e-6 < np.linalg.norm(d) < 1e6),
]
Range = Annotated[
    tuple[Distance, Distance],
    Rule("2 numbers [nearest, farthest] in mm, rising from 0", lambda r: 0.0 <= r[0] < r[1]),
]
MOST_LETTERS = 64
"""Most characters of a name (a count)."""
Name = Annotated[
    str,
    Rule(
        f"a name of letters, digits, '_' and '-' (at most {MOST_LETTERS})",
        lambda text: (
            re.fullmatch(r"[A-Za-z0-9_-]+", text) is not None and len(text) <= MOST_LETTERS
        ),
    ),
]
_NAME_OR_EMPTY = Rule(
    "a name of letters, digits, '_' and '-' (at most 64), or nothing",
    lambda text: re.fullmatch(r"[A-Za-z0-9_-]{0,64}", text) is not None,
)
MeshPath = Annotated[
    str, Rule("a file inside the scene's folder, such as 'liver.stl'", _is_inside_path)
]


@dataclass(frozen=True)
class BodySpec:
    """One closed mesh that does not move."""

    name: Name
    """Name of the body, unique in the scene."""
    mesh: MeshPath
    """Mesh file in mm, relative to the scene's folder."""
    role: Annotated[str, _one_of(ROLES)]
    """`organ` is operated on, `keep-out` must not be touched, `support` carries the others."""
    position_mm: Point = (0.0, 0.0, 0.0)
    """Origin of the mesh in the world frame (mm)."""
    rotation_deg: Angles = (0.0, 0.0, 0.0)
    """Turns about the world's x, then y, then z axis (degrees), before the shift."""

    def pose(self) -> np.ndarray:
        """Mesh frame to world frame, (4, 4) homogeneous, mm."""
        turn = Rotation.from_euler("xyz", self.rotation_deg, degrees=True)
        return frames.pose_from(turn.as_matrix(), self.position_mm)


@dataclass(frozen=True)
class LesionSpec:
    """The lesion: the laser cuts along a ring around it."""

    body: Name
    """The organ that carries the lesion."""
    centre_mm: Point
    """Centre on the organ's surface, world frame (mm)."""
    diameter_mm: Length = 20.0
    """Diameter of the ring, measured in the plane of the surface at the centre (mm)."""
    path_mm: tuple[Point, ...] = ()
    """Closed path on the surface to cut in place of the circle, world frame (mm); empty: circle."""


CLOSED_POINTS, OPEN_POINTS = 3, 2
"""Least number of points of a closed and of an open contour."""


@dataclass(frozen=True)
class ContourSpec:
    """A path on the organ, by points on its surface or as a circle."""

    name: Name
    """Name of the contour, unique among them."""
    points_mm: tuple[Point, ...] = ()
    """Points on the organ's surface, in order, world frame (mm)."""
    file: str = ""
    """CSV with the columns x, y, z (mm, world frame), beside this file, in place of `points_mm`."""
    centre_mm: tuple[Coordinate, ...] = ()
    """Centre of a circle on the surface, world frame (mm), in place of points."""
    diameter_mm: Length = 20.0
    """Diameter of that circle (mm)."""
    closed: bool = True
    """Whether the last point is followed by the first."""
    margin_mm: Distance = 0.0
    """The path is the outline grown outwards by this (mm); closed contours only."""

    def checked(self, where: Where) -> "ContourSpec":
        """The contour with the points of its file; an InputError where fields do not fit."""
        given = [bool(self.points_mm), bool(self.file), bool(self.centre_mm)]
        if sum(given) != 1:
            raise where.error(
                f"{sum(given)} of points_mm, file and centre_mm are given", "one of them"
            )
        if self.centre_mm and len(self.centre_mm) != 3:
            raise (where / "centre_mm").error(f"got {len(self.centre_mm)} numbers", "3, in mm")
        if not self.closed and (self.margin_mm or self.centre_mm):
            came = "margin_mm" if self.margin_mm else "centre_mm"
            raise (where / came).error("got it for an open contour", "it for a closed one only")
        points = self.points_mm
        if self.file:
            points = _points_of(where.path.parent / self.file, where / "file")
        least = CLOSED_POINTS if self.closed else OPEN_POINTS
        if not self.centre_mm and len(points) < least:
            raise (where / "points_mm").error(f"got {len(points)} points", f"at least {least}")
        return replace(self, points_mm=points, file="")


COLUMNS = ("x", "y", "z")
"""Columns of a contour's file, mm."""


def _points_of(path: Path, where: Where) -> tuple[tuple[float, float, float], ...]:
    """The columns x, y and z of a CSV file, mm."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            table = csv.reader(file, skipinitialspace=True)
            header = [name.strip() for name in next(table, [])]
            rows = [(table.line_num, row) for row in table if row]
    except OSError as error:
        raise where.error(
            f"{path} cannot be read ({error.strerror})", "a CSV file with the columns x, y, z in mm"
        ) from None
    except (UnicodeDecodeError, csv.Error):
        raise where.error(
            f"{path} is no text of comma-separated values", "a CSV file with the columns x, y, z"
        ) from None
    if lacking := [name for name in COLUMNS if name not in header]:
        has = ", ".join(header)[:60] or "nothing"
        raise where.error(
            f"{path} has no column {', '.join(lacking)}; its first line is: {has}",
            "a first line with the columns x, y, z in mm, separated by commas",
        )
    places, points = [header.index(name) for name in COLUMNS], []
    for line, row in rows:
        try:
            x, y, z = (float(row[place]) for place in places)
        except (ValueError, IndexError):
            raise where.error(
                f"line {line} of {path} is: {','.join(row)[:60]}", "numbers for x, y and z in mm"
            ) from None
        if not np.isfinite((x, y, z)).all():
            raise where.error(f"line {line} of {path} has a number that is not finite", "mm")
        points.append((x, y, z))
    return tuple(points)


@dataclass(frozen=True)
class MountSpec:
    """The mount of one arm, and the tool that the arm carries."""

    tool: Annotated[str, _one_of(TOOLS)]
    """`laser`, `endoscope`, or `tip`, a plain tip for pushing and touching."""
    position_mm: Point
    """Centre of the arm's base, world frame (mm)."""
    direction: Direction
    """Direction of the arm at rest, world frame; any length."""
    roll_deg: Angle = 0.0
    """Turn of the arm about its own axis (degrees)."""
    arm: Annotated[str, Rule("an arm model's name or folder", bool)] = "default"
    """Arm model: `default`, or the folder of a fitted model."""
    length_mm: Length = 70.0
    """Length of the arm at rest (mm)."""
    diameter_mm: Length = 15.0
    """Outer diameter of the arm (mm)."""
    shaft_mm: Distance = 100.0
    """Straight rigid shaft behind the base, as thick as the arm (mm); 0: none."""
    name: Annotated[str, _NAME_OR_EMPTY] = ""
    """Name of the arm, unique in the scene; empty: its tool, numbered where several carry it."""

    def pose(self) -> np.ndarray:
        """Base frame to world frame, (4, 4) homogeneous, mm.

        z is `direction`; x lies as `frames.rotation_from_z` puts it, turned by `roll_deg`.
        """
        return frames.pose_from_z(self.position_mm, self.direction, np.radians(self.roll_deg))


@dataclass(frozen=True)
class LaserSpec:
    """The beam that leaves the laser arm's tip along the tip's direction."""

    power_w: Annotated[float, _between(0.0, 1e4, "W")] = 20.0
    """Optical power (W)."""
    spot_mm: Length = 0.6
    """Diameter of the Gaussian beam at 1/e^2 of its peak (mm); the beam is collimated."""
    wavelength_nm: Annotated[float, _between(100.0, 20000.0, "nm")] = 1940.0
    """Wavelength in vacuum (nm); 1940 nm is a thulium fibre laser."""
    absorption_per_mm: Annotated[
        float, Rule("an absorption coefficient above 0 1/mm", lambda a: 0.0 < a <= 1e5)
    ] = 9.0
    """Absorption by the tissue, 1/mm; liver: 0.745 of water's 12.4 at 1940 nm, Segelstein 1981."""
    standoff_mm: Range = (20.0, 60.0)
    """Smallest and largest distance from the tip to the tissue (mm): of the search for mounts and
    of `scene check`; tasks do not enforce it."""
    max_incidence_deg: Annotated[float, _between(0.0, 89.0, "degrees")] = 60.0
    """Largest angle between the beam and the surface's normal (degrees), used as `standoff_mm`."""


@dataclass(frozen=True)
class CameraSpec:
    """The camera in the endoscope arm's tip, looking along the tip's direction."""

    fov_deg: Annotated[float, _between(1.0, 179.0, "degrees")] = 70.0
    """Full cone angle of the round field of view (degrees)."""
    range_mm: Range = (10.0, 100.0)
    """Smallest and largest distance at which the picture is sharp (mm)."""

    def camera(self) -> Camera:
        """The camera with its angle in radians."""
        return Camera(float(np.radians(self.fov_deg)), self.range_mm)


@dataclass(frozen=True)
class LimitsSpec:
    """Limits that hold for every task in this scene."""

    clearance_mm: Distance = 1.0
    """Smallest distance between an arm's skin and any body or other arm (mm)."""
    time_s: Annotated[float, Rule("a time above 0 s", lambda t: 0.0 < t <= 1e6)] = 60.0
    """Time for the whole ring (s)."""
    view_fraction: Annotated[float, _between(0.0, 1.0, "")] = 0.95
    """Smallest fraction of the ring that the endoscope must see."""


@dataclass(frozen=True)
class SceneSpec:
    """A whole scene file."""

    name: Name
    """Name of the scene."""
    bodies: tuple[BodySpec, ...]
    """All bodies; at least one organ."""
    lesion: LesionSpec
    """The lesion on one organ."""
    mounts: tuple[MountSpec, ...]
    """The mounts of the arms, at least one."""
    laser: LaserSpec = field(default_factory=LaserSpec)
    """The laser's beam."""
    camera: CameraSpec = field(default_factory=CameraSpec)
    """The endoscope's camera."""
    limits: LimitsSpec = field(default_factory=LimitsSpec)
    """Limits of every task."""
    note: str = ""
    """Free text."""
    format: Annotated[int, Rule(f"{FORMAT}", lambda number: number == FORMAT)] = FORMAT
    """Version of this file format."""
    contours: tuple[ContourSpec, ...] = ()
    """Paths on the lesion's organ that a task may follow, in this order."""

    @property
    def arms(self) -> dict[str, MountSpec]:
        """Each mount by its arm's name: by tool in the order of `TOOLS`, then by name.

        The order of the mounts in the file has no influence on the order of the arms.
        """
        named = dict(zip(arm_names(self.mounts), self.mounts, strict=True))
        ordered = sorted(named, key=lambda name: arm_rank(named[name].tool, name))
        return {name: named[name] for name in ordered}

    def mount(self, name: str) -> MountSpec:
        """The mount of the arm of that name."""
        arms = self.arms
        if name not in arms:
            raise unknown_name("arm", name, arms)
        return arms[name]

    def arms_with(self, tool: str) -> tuple[str, ...]:
        """Names of the arms that carry `tool`, in the order of `arms`."""
        return tuple(name for name, mount in self.arms.items() if mount.tool == tool)

    def body(self, name: str) -> BodySpec:
        """The body of that name."""
        return next(body for body in self.bodies if body.name == name)


def arm_names(mounts: Sequence[MountSpec]) -> tuple[str, ...]:
    """Name of each mount's arm: its own, else its tool, numbered from 1 where several carry it."""
    tools = [mount.tool for mount in mounts]
    return tuple(
        mount.name or (tool if tools.count(tool) == 1 else f"{tool}_{tools[: i + 1].count(tool)}")
        for i, (mount, tool) in enumerate(zip(mounts, tools, strict=True))
    )


def arm_rank(tool: str, name: str) -> tuple:
    """Key that sorts arms by tool, then by name, with numbers by their value."""
    return TOOLS.index(tool), natural_key(name)


def spec_path(path: str | Path) -> Path:
    """The scene file of a scene folder, of a packaged scene's name, or the file itself."""
    path = packaged_scene(path)
    return path / FILE if path.is_dir() else path


def load_spec(path: str | Path) -> SceneSpec:
    """Read a `scene.toml`, given as the file, its folder, or the name of a packaged scene.

    A bad field is an InputError with file, line and field.
    """
    path = packaged_scene(path)
    if not path.exists():
        raise InputError(f"{path}: there is no such scene; expected a folder with {FILE}")
    if path.is_dir() and not (path / FILE).exists():
        raise InputError(f"{path}: holds no {FILE}; make a scene with 'surgisoft scene new'")
    table, where = read_toml(spec_path(path))
    spec = from_table(SceneSpec, table, where)
    _check_whole(spec, where)
    return spec


def save_spec(spec: SceneSpec, path: str | Path) -> None:
    """Write the scene file; loading it gives an equal spec."""
    path = Path(path)
    table, where = to_table(spec), Where(path)
    _check_whole(from_table(SceneSpec, table, where), where)
    write_toml(path, without_empty_tables(SceneSpec, table))


def _check_whole(spec: SceneSpec, where: Where) -> None:
    """Check the conditions that involve several fields."""
    seen: set[str] = set()
    for i, body in enumerate(spec.bodies):
        if body.name in seen:
            raise (where / "bodies" / i / "name").error(
                f"a second body '{body.name}'", "names that differ"
            )
        seen.add(body.name)
    contours = [contour.name for contour in spec.contours]
    for i, name in enumerate(contours):
        if name in contours[:i]:
            raise (where / "contours" / i / "name").error(
                f"a second contour '{name}'", "names that differ"
            )
    organs = [body.name for body in spec.bodies if body.role == "organ"]
    if not organs:
        raise (where / "bodies").error("no body has the role 'organ'", "at least one organ")
    if spec.lesion.body not in organs:
        raise (where / "lesion" / "body").error(
            f"got '{spec.lesion.body}'", f"one of the organs: {', '.join(organs)}"
        )
    if 0 < len(spec.lesion.path_mm) < 3:
        raise (where / "lesion" / "path_mm").error(
            f"got {len(spec.lesion.path_mm)} points", "no point (a circle) or at least 3"
        )
    if not spec.mounts:
        raise (where / "mounts").error("got no mount", "at least one arm")
    names = arm_names(spec.mounts)
    for i, name in enumerate(names):
        if name in names[:i]:
            raise (where / "mounts" / i / "name").error(
                f"a second arm '{name}'", "names that differ"
            )
