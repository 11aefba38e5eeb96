"""Mesh files: read STL, OBJ, PLY, OFF and GLB, decide their unit of length, write exact PLY."""

import json
import re
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surgisoft.errors import InputError
from surgisoft.files import write_atomically
from surgisoft.scene.mesh import Mesh, used_indices

MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "inch": 25.4}
GLTF = (".glb", ".gltf")
SUFFIXES = (".stl", ".obj", ".ply", ".off", *GLTF)
PLAUSIBLE_MM = (20.0, 600.0)
"""Plausible largest side of an organ or an organ phantom: from a gland to a whole abdomen (mm)."""
ABSURD = 10.0
"""Factor below or above the plausible range at which a size is an error, not only a warning."""

OWN_HEADER = (
    "ply\nformat binary_little_endian 1.0\ncomment surgisoft, millimetres\n"
    "element vertex {}\nproperty double x\nproperty double y\nproperty double z\n"
    "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
)
"""Header of a PLY file that `write_ply` writes, with the numbers of vertices and of faces."""
OWN_PLY = re.compile(re.escape(OWN_HEADER).replace(r"\{\}", r"(\d{1,9})").encode("ascii"))
TRIANGLE = np.dtype([("count", "u1"), ("corner", "<i4", 3)])
"""A face of such a file: three, and its corners."""


@dataclass(frozen=True, eq=False)
class Part:
    """One named piece of a mesh file, as it stands there."""

    name: str
    """Name inside the file, or the file's own."""
    vertices: np.ndarray
    """(V, 3) float64 in the file's unit and frame."""
    faces: np.ndarray
    """(F, 3) int64, rows of vertex indices."""


DICOM = (".dcm", ".dicom", ".ima")
"""Suffixes of DICOM images, which hold grey values."""


def read_parts(path: str | Path) -> tuple[Part, ...]:
    """All triangle meshes of a file, in the file's unit and frame."""
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path}: there is no such file; expected a mesh")
    if path.is_dir():
        raise InputError(f"{path}: is a folder; expected a mesh file ({', '.join(SUFFIXES)})")
    if path.suffix.lower() in DICOM:
        raise InputError(
            f"{path}: a DICOM image is not read, because a scene needs labels; segment it, with 3D "
            "Slicer for example, and save the segmentation as NIfTI (.nii.gz) or NRRD (.nrrd)"
        )
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"{path}: file type '{path.suffix}' is not read; expected one of "
            f"{', '.join(SUFFIXES)}, which 3D Slicer, ParaView and MeshLab write"
        )
    if path.stat().st_size == 0:
        raise InputError(f"{path}: the file is empty; expected a mesh")
    if path.suffix.lower() == ".stl":
        _check_stl(path)
    if path.suffix.lower() in (".glb", ".gltf"):
        _check_gltf(path)
    own = _load_own(path) if path.suffix.lower() == ".ply" else None
    pieces, points = _load(path) if own is None else ([own], 0)
    if not pieces and points:
        raise InputError(
            f"{path}: holds {points} points or lines but no faces; "
            "expected a surface (build one from the points first)"
        )
    if not pieces:
        raise InputError(f"{path}: holds no triangle; expected a mesh")
    return tuple(_checked(path, part) for part in pieces)


def _check_stl(path: Path) -> None:
    """Raise for a binary STL shorter than its own count, and for a file that is no STL at all."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(84)
    count = struct.unpack("<I", head[80:])[0] if len(head) == 84 else 0
    if len(head) == 84 and size == 84 + 50 * count:
        return
    if head.lstrip()[:5].lower() == b"solid":
        _check_text_stl(path, size)
        return
    if len(head) == 84:
        raise InputError(
            f"{path}: a binary STL of {count} triangles needs {84 + 50 * count} bytes and this "
            f"file has {size}; it is cut off or not an STL"
        )
    raise InputError(f"{path}: is neither a text nor a binary STL; expected a mesh")


def _check_text_stl(path: Path, size: int) -> None:
    """Raise for a text STL that ends before its last line."""
    with path.open("rb") as file:
        file.seek(max(0, size - 1024))
        tail = file.read().lower()
    if b"endsolid" not in tail:
        last = tail.splitlines()[-1].strip().decode("ascii", "replace")[-40:]
        raise InputError(
            f"{path}: the text STL ends with '{last}'; expected 'endsolid' at its end: it is cut "
            "off, export or copy it again"
        )


def _check_gltf(path: Path) -> None:
    """Raise for a glTF file whose parts claim more than the file holds, before memory is taken.

    GLB: a header of 12 bytes (magic, version, length), then chunks, each with its length and type
    before it; the first one is JSON (glTF 2.0 specification, sec. 4.4).
    """
    size, wanted = path.stat().st_size, "the file is damaged or has another type"
    content = path.read_bytes()
    if path.suffix.lower() == ".glb":
        magic, _, length = struct.unpack("<4sII", content[:12].ljust(12, b"\0"))
        if magic != b"glTF" or length != size:
            raise InputError(f"{path}: cannot be read as GLB (its length is wrong); {wanted}")
        at, chunks = 12, []
        while at + 8 <= size:
            length = struct.unpack("<I", content[at : at + 4])[0]
            chunks.append(content[at + 8 : at + 8 + length])
            at += 8 + length
        if at != size or not chunks:
            raise InputError(f"{path}: cannot be read as GLB (a chunk is cut off); {wanted}")
        content = chunks[0]
    try:
        table = json.loads(content)
        accessors = table.get("accessors", [])
        counts = [accessor["count"] for accessor in accessors if "bufferView" not in accessor]
        most = max([0, *counts])
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        reason = f"{type(error).__name__}: {error}"
        raise InputError(f"{path}: cannot be read as glTF ({reason[:120]}); {wanted}") from None
    if most > size:
        raise InputError(f"{path}: claims {most} numbers in {size} bytes; {wanted}")


def _load_own(path: Path) -> Part | None:
    """The mesh of a PLY as `write_ply` writes it, without trimesh, whose import takes longer than
    a scene; None for any other file."""
    content = path.read_bytes()
    match = OWN_PLY.match(content)
    if match is None:
        return None
    count, faces, begin = int(match[1]), int(match[2]), match.end()
    if len(content) != begin + 24 * count + TRIANGLE.itemsize * faces or not count or not faces:
        return None
    rows = np.frombuffer(content, TRIANGLE, faces, begin + 24 * count)
    if (rows["count"] != 3).any():
        return None
    vertices = np.frombuffer(content, "<f8", 3 * count, begin).reshape(-1, 3)
    return Part(path.name, vertices.astype(np.float64), rows["corner"].astype(np.int64))


def _load(path: Path) -> tuple[list[Part], int]:
    """Parts with faces, and the number of points in parts that have none."""
    import trimesh

    options: dict[str, Any] = {"split_objects": True} if path.suffix.lower() == ".obj" else {}
    try:
        scene = trimesh.load_scene(path, process=False, **options)
        order = {name: i for i, name in enumerate(scene.geometry)}
        nodes = [(order[scene.graph[node][1]], node) for node in scene.graph.nodes_geometry]
        parts, points = [], 0
        for _, node in sorted(nodes):
            pose, name = scene.graph[node]
            geometry = scene.geometry[name]
            faces = np.asarray(getattr(geometry, "faces", ()), dtype=np.int64).reshape(-1, 3)
            vertices = np.asarray(geometry.vertices, dtype=np.float64).reshape(-1, 3)
            if len(faces):
                moved = vertices @ pose[:3, :3].T + pose[:3, 3]
                if np.linalg.det(pose[:3, :3]) < 0.0:
                    faces = faces[:, ::-1]
                parts.append(Part(str(node), moved, faces))
            else:
                points += len(vertices)
    except Exception as error:  # parsers of foreign files raise anything
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(
            f"{path}: cannot be read as {path.suffix[1:].upper()} ({reason}); "
            "the file is damaged or has another type"
        ) from None
    return parts, points


def _checked(path: Path, part: Part) -> Part:
    """The part itself; an InputError if its numbers cannot be a mesh."""
    if part.faces.min() < 0 or part.faces.max() >= len(part.vertices):
        raise InputError(
            f"{path}: a face names vertex {part.faces.max()} of {len(part.vertices)}; "
            "the file is damaged"
        )
    bad = ~np.isfinite(part.vertices[used_indices(part.faces)[0]]).all(axis=1)
    if bad.any():
        raise InputError(
            f"{path}: {bad.sum()} of {len(bad)} vertices are NaN or infinite; expected finite "
            "coordinates"
        )
    return part


class UnknownUnit(InputError):
    """A mesh file stores no unit, and its size in mm is not that of an organ."""


@dataclass(frozen=True)
class LengthUnit:
    """The unit of a file's coordinates, and where it comes from."""

    mm: float
    """Millimetres in one unit."""
    sentence: str
    """The unit and its origin, as printed for the user."""


def stored_unit(path: Path, size: float) -> LengthUnit:
    """The unit of a file whose user gave none; `size` is the largest side in the file's unit.

    glTF prescribes metres. The other formats store no unit, and mm is what medical software
    writes. Nothing is scaled by a guess: a size that this unit makes no organ's raises
    UnknownUnit, which lists what each unit would give.
    """
    unit = "m" if path.suffix.lower() in GLTF else "mm"
    why = "glTF prescribes metres" if unit == "m" else f"{path.suffix[1:].upper()} stores no unit"
    low, high = PLAUSIBLE_MM
    size_mm = size * MM_PER_UNIT[unit]
    if low <= size_mm <= high:
        return LengthUnit(
            MM_PER_UNIT[unit],
            f"{unit} ({why}; the mesh is {size_mm:.4g} mm across, another unit needs --unit)",
        )
    options = ", ".join(f"--unit {u} ({size * mm:.4g} mm)" for u, mm in MM_PER_UNIT.items())
    raise UnknownUnit(
        f"{path}: the mesh would be {size_mm:.4g} mm across in {unit} ({why}), and organs measure "
        f"{low:g} to {high:g} mm; give its unit: {options}, or --scale MM_PER_UNIT"
    )


def given_unit(path: Path, size: float, unit: str | None, scale: float | None) -> LengthUnit:
    """The unit that the user gave, by name or as `scale` mm in one unit.

    `size` is the organ's largest side in that unit. A size that is no organ's becomes a warning in
    the sentence, and one more than ABSURD times outside the range an InputError.
    """
    low, high = PLAUSIBLE_MM
    mm = MM_PER_UNIT[unit] if unit is not None else scale
    assert mm is not None, "either the unit or the scale was given"
    what = f"{unit} as given" if unit is not None else f"{mm:g} mm as given"
    size_mm = size * mm
    if low <= size_mm <= high:
        return LengthUnit(mm, f"{what} ({size_mm:.4g} mm across)")
    fits = [u for u, factor in MM_PER_UNIT.items() if low <= size * factor <= high]
    advice = "".join(f"; --unit {u} would give {size * MM_PER_UNIT[u]:.4g} mm" for u in fits)
    sentence = (
        f"{what}, but the mesh would be {size_mm:.4g} mm across; organs measure {low:g} to "
        f"{high:g} mm{advice}"
    )
    if not low / ABSURD <= size_mm <= high * ABSURD:
        raise InputError(f"{path}: unit {sentence}")
    return LengthUnit(mm, sentence)


def write_ply(mesh: Mesh, path: str | Path) -> None:
    """Write a binary PLY with float64 vertices: reading it gives the same mesh, bit for bit."""
    header = OWN_HEADER.format(len(mesh.vertices_mm), len(mesh.faces))
    rows = np.empty(len(mesh.faces), dtype=TRIANGLE)
    rows["count"], rows["corner"] = 3, mesh.faces
    body = mesh.vertices_mm.astype("<f8").tobytes() + rows.tobytes()
    write_atomically(Path(path), header.encode("ascii") + body)


def read_mesh(path: str | Path) -> Mesh:
    """Read a mesh file in mm as one mesh, without repairs; the counterpart of `write_ply`."""
    parts = read_parts(path)
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return Mesh(
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([part.faces + i for part, i in zip(parts, starts, strict=True)]),
    )
