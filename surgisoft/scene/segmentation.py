"""Segmented medical images as meshes: labels of a NIfTI or NRRD file become closed surfaces.

The header gives the unit and the orientation of the voxels. Surfaces are found with marching cubes
(Lorensen & Cline 1987, as in scikit-image) on the smoothed mask of a label. The frame is that of
the patient, RAS: x to the right, y to the front (anterior), z to the head (superior), in mm.

Needs nibabel, pynrrd and scikit-image, the extra `segmentation`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from surgisoft.errors import InputError, unknown_name
from surgisoft.numbers_in_text import whole_number
from surgisoft.scene.mesh import Mesh
from surgisoft.scene.meshio import Part

SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".nhdr")
ROLES = ("organ", "lesion", "keep-out", "support")
"""Roles of a label: those of a body, and `lesion`, which is part of the organ."""
RESOLUTION_MM = 1.0
"""Finest distance of two samples of a mask (mm). Finer voxels are averaged first: a liver then has
about 200,000 faces."""
SMOOTHING = 0.6
"""Standard deviation of the Gaussian that smooths a mask, in samples: removes the steps of voxels
and moves flat surfaces by nothing."""
SMALLEST_ML = 0.05
"""Separate pieces of a label below this volume are noise of the segmentation (ml)."""
MOST_VOXELS = 2**30
"""Largest number of voxels that is read: 1024 x 1024 x 1024."""
DENSEST = 1032
"""Most bytes that one byte of a packed file unpacks to (zlib documentation, 'Maximum compression
factor')."""
MM_PER_UNIT = {"mm": 1.0, "meter": 1000.0, "m": 1000.0, "cm": 10.0, "micron": 1e-3, "um": 1e-3}
LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Label:
    """One label of an image, as the user asked for it."""

    key: str
    """Value of its voxels, or its name in the file."""
    role: str
    """One of ROLES."""
    name: str
    """Name of the body."""


@dataclass(frozen=True, eq=False)
class Image:
    """Labels of an image and where its voxels lie."""

    path: Path
    """The file."""
    layers: np.ndarray
    """(L, I, J, K) integer labels; L is 1 unless segments overlap."""
    to_ras: np.ndarray
    """(4, 4) from voxel indices (i, j, k) to the patient's frame RAS, mm."""
    segments: dict[str, tuple[int, int]]
    """Layer and label of every segment that the file names."""
    oriented: bool
    """Whether the header gives the orientation; if not, the array's axes are taken as R, A, S."""

    @property
    def voxel_ml(self) -> float:
        """Volume of a voxel, ml."""
        return float(abs(np.linalg.det(self.to_ras[:3, :3]))) / 1000.0

    @property
    def voxel_mm(self) -> float:
        """Largest side of a voxel, mm."""
        return float(np.linalg.norm(self.to_ras[:3, :3], axis=0).max())

    @cached_property
    def volumes_ml(self) -> dict[str, float]:
        """Volume of each label by its name, or by its value where it has no name (ml)."""
        named = {place: name for name, place in self.segments.items()}
        counts: dict[tuple[int, int], int] = {}
        for layer, labels in enumerate(self.layers):
            for slab in labels:
                for value, count in zip(*np.unique(slab, return_counts=True), strict=True):
                    place = (layer, int(value))
                    counts[place] = counts.get(place, 0) + int(count)
        return {
            named.get(place, str(place[1])): count * self.voxel_ml
            for place, count in sorted(counts.items())
            if place[1] != 0
        }

    def mask(self, key: str) -> np.ndarray:
        """(I, J, K) bool: the voxels of a label; an InputError lists the labels if it has none."""
        layer, value = self.segments.get(key, (0, None))
        if value is None:
            value = whole_number(key)
        found = self.layers[layer] == value if value is not None else None
        if found is None or not found.any():
            raise InputError(f"{self.path}: there is no label '{key}'; {self.listed()}")
        return found

    def listed(self) -> str:
        """The labels of the file with their volumes, in words."""
        volumes = self.volumes_ml
        rows = ", ".join(f"{name} ({volume:.4g} ml)" for name, volume in volumes.items())
        return f"its labels are {rows}" if rows else "it holds no label above 0"


@dataclass(frozen=True, eq=False)
class SegmentedLesion:
    """The lesion of an image."""

    surface_mm: np.ndarray
    """(V, 3) mm: vertices of its smoothed surface."""
    voxels_mm: np.ndarray
    """(N, 3) mm: centres of its outermost voxels. A lesion that was labelled by the centres of the
    voxels reaches at most half a voxel beyond them, and its smoothed surface on average 2 % of its
    size, because the steps of the voxels stay in it."""
    voxel_mm: float
    """Largest side of a voxel, mm."""

    def moved(self, rotation: np.ndarray, shift_mm: np.ndarray) -> SegmentedLesion:
        """The lesion turned by (3, 3), then shifted by (3,) mm."""
        surface, voxels = (
            each @ rotation.T + shift_mm for each in (self.surface_mm, self.voxels_mm)
        )
        return SegmentedLesion(surface, voxels, self.voxel_mm)


@dataclass(frozen=True, eq=False)
class Segmented:
    """The labels of an image that the user asked for, as surfaces."""

    parts: tuple[Part, ...]
    """Closed surfaces in mm, patient's frame RAS; the organ first."""
    roles: tuple[str, ...]
    """Role of each part: that of a body."""
    lesion: SegmentedLesion | None
    """The lesion, patient's frame RAS; None without a lesion."""
    notes: tuple[str, ...]
    """What was read, left out and taken for granted, one line each."""


def is_segmentation(path: Path) -> bool:
    """Whether the file's name is that of a segmented image."""
    return path.name.lower().endswith(SUFFIXES)


def parse_label(text: str) -> Label:
    """The label that `LABEL:ROLE[:NAME]` asks for, such as `2:lesion:tumour`."""
    key, _, rest = text.partition(":")
    role, _, name = rest.partition(":")
    if not key or not role:
        raise InputError(f"--label '{text}': expected LABEL:ROLE[:NAME], such as 1:organ:liver")
    if role not in ROLES:
        raise unknown_name("role", role, ROLES)
    return Label(key, role, name or (key if whole_number(key) is None else f"{role}_{key}"))


def read_segmentation(
    path: Path, labels: tuple[Label, ...], on_step: Callable[[str], None] = lambda _: None
) -> Segmented:
    """Surfaces of the labels of an image, the organ with its lesion and the vessels within it.

    An InputError lists the file's labels where none was asked for, or one that is not there.
    """
    image = read_image(path)
    if not labels:
        raise InputError(
            f"{path}: say what its labels are with --label LABEL:ROLE[:NAME], such as "
            f"--label 1:organ:liver; {image.listed()}"
        )
    organs = [label for label in labels if label.role == "organ"]
    lesions = [label for label in labels if label.role == "lesion"]
    if len(organs) != 1 or len(lesions) > 1:
        raise InputError(
            f"{path}: {len(organs)} labels with the role organ and {len(lesions)} with the role "
            "lesion; expected one organ and at most one lesion"
        )
    masks = {}
    for label in labels:
        on_step(f"label {label.key}")
        masks[label.key] = image.mask(label.key)
    organ = organs[0]
    notes = [f"{path.name}: {image.listed()}", _orientation(image)]
    given = set(masks)
    left_out = [key for key in image.volumes_ml if key not in given]
    # A segment may be given by its name or, in the first layer, by its value.
    values = {name: str(value) for name, (layer, value) in image.segments.items() if not layer}
    names = {value: name for name, value in values.items()}
    alias = names | values
    left_out = [key for key in left_out if alias.get(key, key) not in given]
    if left_out:
        notes.append(f"{path.name}: left out: {', '.join(left_out)}; name them with --label")
    inner = [masks[label.key] for label in labels if label.role == "keep-out"]
    on_step("filling the organ")
    solid = _solid(masks[organ.key], [masks[label.key] for label in lesions], inner, image)
    parts, roles, lesion = [], [], None
    ordered = [organ, *(label for label in labels if label is not organ)]
    for label in ordered:
        on_step(f"surface of {label.name}")
        mask = solid if label is organ else masks[label.key]
        mesh, kept, dropped = _surface(mask, image, label)
        if dropped:
            notes.append(
                f"{path.name}: {label.name}: {dropped} pieces below {SMALLEST_ML:g} ml left out"
            )
        if label.role == "lesion":
            lesion = SegmentedLesion(mesh.vertices_mm, _outermost_mm(kept, image), image.voxel_mm)
            continue
        parts.append(Part(label.name, mesh.vertices_mm, mesh.faces))
        roles.append(label.role)
    return Segmented(tuple(parts), tuple(roles), lesion, tuple(notes))


def read_image(path: Path) -> Image:
    """The labels of a NIfTI or NRRD file; an InputError says what is wrong with it."""
    if not path.exists():
        raise InputError(f"{path}: there is no such file; expected a segmented image")
    reader = _read_nifti if ".nii" in path.name.lower() else _read_nrrd
    try:
        image = reader(path)
    except ImportError as error:
        raise InputError(
            f"{path}: needs the package {error.name}; install it with "
            "pip install 'surgisoft[segmentation]'"
        ) from None
    except InputError:
        raise
    except Exception as error:  # parsers of foreign files raise anything
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise InputError(
            f"{path}: cannot be read as a segmented image ({reason}); the file is damaged or has "
            "another type"
        ) from None
    if not np.isfinite(image.to_ras).all() or image.voxel_ml == 0.0:
        raise InputError(f"{path}: the header places all voxels on a plane; expected a volume")
    return image


def _orientation(image: Image) -> str:
    spacing = np.linalg.norm(image.to_ras[:3, :3], axis=0)
    voxels = " x ".join(f"{s:.3g}" for s in spacing)
    if not image.oriented:
        return (
            f"{image.path.name}: voxels of {voxels} mm; the header gives no orientation, the "
            "array's axes are taken as right, anterior, superior: set --up where that is wrong"
        )
    return f"{image.path.name}: voxels of {voxels} mm, unit and orientation from the header"


def _labels(data: np.ndarray, path: Path) -> np.ndarray:
    """Integer labels; an InputError for grey values."""
    if data.dtype.kind in "iub":
        return data
    whole = np.rint(data)
    if not np.isfinite(data).all() or not np.array_equal(whole, data):
        raise InputError(f"{path}: holds grey values; expected whole numbers, one label per voxel")
    return whole.astype(np.int32)


def _check_size(shape, path: Path) -> None:
    if len(shape) < 3 or min(shape) < 2:
        raise InputError(f"{path}: an image of shape {tuple(shape)}; expected a volume")
    if float(np.prod([float(n) for n in shape])) > MOST_VOXELS:
        raise InputError(
            f"{path}: {' x '.join(map(str, shape))} voxels; at most 1024 x 1024 x 1024 are read: "
            "crop or resample it"
        )


def _check_claim(size: int, path: Path) -> None:
    """Raise InputError where a header claims more bytes than the file can hold, packed or not."""
    if size > DENSEST * path.stat().st_size:
        raise InputError(
            f"{path}: its header claims {size} bytes, the file has {path.stat().st_size}; the file "
            "is damaged or cut off"
        )


def _read_nifti(path: Path) -> Image:
    import nibabel

    file: Any = nibabel.load(path)
    shape = tuple(int(n) for n in file.shape)
    while len(shape) > 3 and shape[-1] == 1:
        shape = shape[:-1]
    if len(shape) != 3:
        raise InputError(f"{path}: an image of shape {tuple(file.shape)}; expected a volume")
    _check_size(shape, path)
    _check_claim(math.prod(shape) * file.get_data_dtype().itemsize, path)
    labels = _labels(np.asanyarray(file.dataobj).reshape(shape), path)
    unit = file.header.get_xyzt_units()[0]
    to_ras = np.array(file.affine, dtype=float)
    to_ras[:3] *= MM_PER_UNIT.get(unit, 1.0)
    oriented = bool(file.header["sform_code"] > 0 or file.header["qform_code"] > 0)
    if not oriented:  # without a form nibabel mirrors the first axis
        spacing = np.abs(np.array(file.header.get_zooms()[:3], dtype=float))
        to_ras = np.diag([*(MM_PER_UNIT.get(unit, 1.0) * spacing), 1.0])
    return Image(path, labels[None], to_ras, {}, oriented)


def _read_nrrd(path: Path) -> Image:
    import nrrd

    header = nrrd.read_header(str(path))
    shape = tuple(int(n) for n in header["sizes"])
    _check_size(shape[-3:], path)
    if len(shape) > 4:
        raise InputError(f"{path}: an image of shape {shape}; expected a volume")
    if "data file" not in header and "datafile" not in header:
        _check_claim(math.prod(shape), path)
    data, header = nrrd.read(str(path))
    directions = header.get("space directions")
    if directions is None:
        spacings = np.asarray(header.get("spacings", (1.0,) * len(shape)), dtype=float)[-3:]
        axes = np.diag(np.where(np.isfinite(spacings), spacings, 1.0))
    else:
        rows = [row for row in directions if row is not None and np.isfinite(row).all()]
        axes = np.array(rows, dtype=float).T
    if axes.shape != (3, 3):
        raise InputError(f"{path}: {axes.shape[1]} directions of voxels; expected 3")
    to_space = np.eye(4)
    to_space[:3, :3] = axes
    to_space[:3, 3] = header.get("space origin", np.zeros(3))
    units = header.get("space units") or header.get("units") or ["mm"]
    to_space[:3] *= MM_PER_UNIT.get(str(list(units)[-1]).lower(), 1.0)
    space = str(header.get("space", "")).lower()
    turn = {
        "left-posterior-superior": LPS_TO_RAS,
        "lps": LPS_TO_RAS,
        "left-anterior-superior": np.diag([-1.0, 1.0, 1.0, 1.0]),
        "las": np.diag([-1.0, 1.0, 1.0, 1.0]),
        "right-anterior-superior": np.eye(4),
        "ras": np.eye(4),
    }.get(space)
    labels = _labels(data, path)
    layers = labels if labels.ndim == 4 else labels[None]
    oriented = turn is not None and directions is not None
    to_ras = (turn if turn is not None else np.eye(4)) @ to_space
    return Image(path, layers, to_ras, _segments(header), oriented)


def _segments(header) -> dict[str, tuple[int, int]]:
    """Layer and label of the segments that a segmentation of 3D Slicer names in its header."""
    found = {}
    for key, name in header.items():
        if not (key.startswith("Segment") and key.endswith("_Name")):
            continue
        stem = key[: -len("_Name")]
        layer = int(header.get(f"{stem}_Layer", 0))
        found[str(name)] = (layer, int(header.get(f"{stem}_LabelValue", 1)))
    return found


def _box(mask: np.ndarray, margin: np.ndarray) -> tuple[slice, ...]:
    """The slices that hold all voxels of a mask with a margin (3,) around, within the image."""
    slices = []
    for axis in range(3):
        others = tuple(a for a in range(3) if a != axis)
        used = np.flatnonzero(mask.any(axis=others))
        low = max(0, int(used[0]) - int(margin[axis]))
        slices.append(slice(low, int(used[-1]) + 1 + int(margin[axis])))
    return tuple(slices)


def _solid(organ, lesions, inner, image: Image) -> np.ndarray:
    """(I, J, K) bool: the organ with its lesion, and with the vessels and gaps inside it.

    Labels exclude each other, so an organ has a hole where its lesion and its vessels are. A voxel
    of a vessel belongs to the organ where the organ surrounds it in a plane along two voxel axes.
    """
    from scipy.ndimage import binary_fill_holes

    solid = organ.copy()
    for lesion in lesions:
        solid |= lesion
    box = _box(solid, np.zeros(3, dtype=int))
    cut = solid[box]
    if inner:
        others = np.zeros_like(cut)
        for mask in inner:
            others |= mask[box]
        surrounded = np.zeros_like(cut)
        for axis in range(3):
            surrounded |= _surrounded(cut, axis)
        cut = cut | (surrounded & others)
    solid[box] = binary_fill_holes(cut)
    return solid


def _surrounded(solid: np.ndarray, axis: int) -> np.ndarray:
    """(I, J, K) bool: voxels that are not solid, and from which no path of such voxels leads out.

    Paths lie in the plane across the axis.
    """
    from scipy.ndimage import generate_binary_structure, label

    in_plane = generate_binary_structure(3, 1)
    in_plane[tuple(slice(None) if a != axis else [0, 2] for a in range(3))] = False
    numbers, count = label(~solid, structure=in_plane)
    out = np.zeros(count + 1, dtype=bool)
    out[0] = True
    for across in (a for a in range(3) if a != axis):
        for end in (0, -1):
            out[np.unique(np.take(numbers, end, axis=across))] = True
    return ~out[numbers]


def _outermost_mm(mask: np.ndarray, image: Image) -> np.ndarray:
    """(N, 3) mm, frame RAS: centres of the voxels of a mask that have a neighbour outside of it."""
    from scipy.ndimage import binary_erosion

    index = np.argwhere(mask & ~binary_erosion(mask))
    return index @ image.to_ras[:3, :3].T + image.to_ras[:3, 3]


def _surface(mask: np.ndarray, image: Image, label: Label) -> tuple[Mesh, np.ndarray, int]:
    """The closed surface of a mask in mm, frame RAS; the mask without its small pieces, and the
    number of these."""
    from scipy.ndimage import gaussian_filter
    from scipy.ndimage import label as components
    from skimage.measure import marching_cubes

    box = _box(mask, np.zeros(3, dtype=int))
    cut = mask[box]
    numbers, count = components(cut, structure=np.ones((3, 3, 3)))
    sizes = np.bincount(numbers.reshape(-1), minlength=count + 1) * image.voxel_ml
    small = sizes < SMALLEST_ML
    small[0] = True
    if small.all():
        raise InputError(
            f"{image.path}: label '{label.key}' has {sizes[1:].max():.2g} ml in its largest piece; "
            f"expected at least {SMALLEST_ML:g} ml"
        )
    kept = ~small[numbers]
    spacing = np.linalg.norm(image.to_ras[:3, :3], axis=0)
    stride = np.maximum(1, np.floor(RESOLUTION_MM / spacing + 1e-6)).astype(int)
    pad = 3 * stride
    grey = np.pad(kept.astype(np.float32), [(p, p + s) for p, s in zip(pad, stride, strict=True)])
    grey = gaussian_filter(grey, SMOOTHING * stride, mode="constant")
    steps = tuple(slice(None, None, int(s)) for s in stride)
    sampled = np.pad(grey[steps], 1)
    if not sampled.max() > 0.5:
        raise InputError(
            f"{image.path}: label '{label.key}' is thinner than its voxels; expected a body"
        )
    vertices, faces, _, _ = marching_cubes(sampled, 0.5)
    index = (vertices.astype(float) - 1.0) * stride - pad + [part.start for part in box]
    points = index @ image.to_ras[:3, :3].T + image.to_ras[:3, 3]
    mesh = Mesh(points, faces.astype(np.int64))
    if mesh.volume_mm3 < 0.0:
        mesh = Mesh(points, faces[:, ::-1].astype(np.int64))
    whole = np.zeros_like(mask)
    whole[box] = kept
    return mesh, whole, int(small[1:].sum())
