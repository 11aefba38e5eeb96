"""Centres of key feature planes from markers on their rim: plane and circle fit in 3D."""

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surgisoft.errors import InputError
from surgisoft.measurement.importing.align import Joined
from surgisoft.measurement.importing.raw import Column, RawTable
from surgisoft.measurement.importing.rotation import (
    check_pose,
    matrices,
    mean_rotation,
    turn_to_z,
)
from surgisoft.measurement.importing.spec import (
    BaseMap,
    FrameMap,
    KeyPointsMap,
    Position,
    Quaternion,
)
from surgisoft.measurement.recordings.columns import MM_PER
from surgisoft.numbers_in_text import natural_key

_COLLINEAR = 0.02
"""Least spread across against spread along the markers for a circle to be defined."""


def circle_centres(markers: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre, radius and rms residual of the circle through each row's markers.

    markers: (T, k, 3) positions in any one unit and frame, NaN where missing. Returns centres
    (T, 3), radii (T,), residuals (T,), all in that unit; NaN where fewer than three markers are
    known or they stand on one line.
    """
    centres = np.full((len(markers), 3), np.nan)
    radii, residuals = np.full(len(markers), np.nan), np.full(len(markers), np.nan)
    known = ~np.isnan(markers).any(axis=2)
    patterns, which = np.unique(known, axis=0, return_inverse=True)
    for i, pattern in enumerate(patterns):
        rows = np.flatnonzero(which.reshape(-1) == i)
        if pattern.sum() >= 3:
            centres[rows], radii[rows], residuals[rows] = _fit(markers[rows][:, pattern])
    return centres, radii, residuals


def _fit(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Circles through complete markers (T, k, 3), k >= 3."""
    mean = points.mean(axis=1, keepdims=True)
    _, spread, axes = np.linalg.svd(points - mean, full_matrices=False)
    flat = np.einsum("tki,tai->tka", points - mean, axes[:, :2])
    size = np.maximum(spread[:, 0], 1e-300)
    good = (spread[:, 1] > _COLLINEAR * size) & (spread[:, 0] > 0)
    scaled = flat / size[:, None, None]
    centre, radius = _algebraic(scaled, good)
    centre, radius = _geometric(scaled, centre, radius, good)
    distance = np.linalg.norm(scaled - centre[:, None], axis=2) - radius[:, None]
    off_plane = np.einsum("tki,ti->tk", points - mean, np.cross(axes[:, 0], axes[:, 1]))
    square = (distance * size[:, None]) ** 2 + off_plane**2
    centres = mean[:, 0] + np.einsum("ta,tai->ti", centre * size[:, None], axes[:, :2])
    centres[~good], radius[~good] = np.nan, np.nan
    return centres, radius * size, np.where(good, np.sqrt(square.mean(axis=1)), np.nan)


def _algebraic(flat: np.ndarray, good: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Start of the fit: linear least squares of x^2 + y^2 = 2 a x + 2 b y + c (Kasa 1976).

    flat: (T, k, 2) with zero mean. Exact where the points stand on a circle.
    """
    square = (flat**2).sum(axis=2)
    normal = np.einsum("tka,tkb->tab", flat, flat)
    normal[~good] = np.eye(2)
    side = np.einsum("tka,tk->ta", flat, square) / 2
    centre = np.linalg.solve(normal, side[..., None])[..., 0]
    radius = np.sqrt(square.mean(axis=1) + (centre**2).sum(axis=1))
    return centre, radius


def _geometric(
    flat: np.ndarray, centre: np.ndarray, radius: np.ndarray, good: np.ndarray, steps: int = 10
) -> tuple[np.ndarray, np.ndarray]:
    """Least squares of the distances to the circle by Gauss-Newton steps.

    Gander, Golub and Strebel, Least-squares fitting of circles and ellipses, 1994.
    """
    if flat.shape[1] == 3:
        return centre, radius  # three points: the algebraic circle goes through them
    for _ in range(steps):
        away = flat - centre[:, None]
        distance = np.maximum(np.linalg.norm(away, axis=2), 1e-300)
        slopes = np.concatenate([away / distance[..., None], np.ones((*distance.shape, 1))], axis=2)
        normal = np.einsum("tka,tkb->tab", slopes, slopes)
        normal[~good] = np.eye(3)
        side = np.einsum("tka,tk->ta", slopes, distance - radius[:, None])
        normal += 1e-12 * np.eye(3)
        change = np.linalg.solve(normal, side[..., None])[..., 0]
        centre, radius = centre + change[:, :2], radius + change[:, 2]
    return centre, radius


TILT_NOTE_DEG = 30.0
"""Angle between z and the arm at rest from which the report asks to check the frame [deg]."""


@dataclass(frozen=True, eq=False)
class Points:
    """Key points of one set of files."""

    key_points_mm: np.ndarray
    """(T, n, 3) arm base frame [mm], NaN where missing."""
    gravity: np.ndarray | None
    """(3,) unit vector along the weight, arm base frame, where the map states it."""
    notes: list[str]
    """What was done, in words."""


@dataclass(frozen=True)
class KeyPoint:
    """Where one key point comes from."""

    positions: tuple[Position, ...]
    """One position, or at least three markers on a circle around the key point."""
    quaternion: Quaternion | None = None
    """Orientation of the body that the key point is fixed to, where it has an offset."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Key point in the axes of the body, relative to its position [unit of the positions]."""


def key_points_of(spec: KeyPointsMap, table: RawTable) -> tuple[KeyPoint, ...]:
    """The key points of the map, or all that the motion capture file has."""
    if spec.auto is None:
        return (
            *(KeyPoint((position,)) for position in spec.positions),
            *(KeyPoint(markers) for markers in spec.markers),
            *(KeyPoint((p.position,), p.quaternion, p.offset) for p in spec.point),
        )
    if spec.auto == "bodies":
        found = tuple(KeyPoint((name,)) for name in sorted(table.bodies, key=natural_key))
        expected = "rigid bodies in the file's header"
    else:
        groups = planes(table.markers, spec.pattern)
        found = tuple(KeyPoint(tuple(names)) for names in groups)
        expected = f"markers whose names fit the pattern {spec.pattern!r}"
        for names in groups:
            if len(names) < 3:
                raise InputError(
                    f"{table.path}: plane of {', '.join(names)} has {len(names)} markers, expected "
                    'at least 3 for a circle fit; use auto = "bodies" or another pattern'
                )
    if not found:
        raise InputError(f"{table.path}: no key point found, expected {expected}")
    return found


def planes(markers: Sequence[str], pattern: str) -> list[list[str]]:
    """Markers of each plane, planes and markers in natural order.

    A marker belongs to the plane that the expression's first group finds in its name; names that do
    not fit belong to none.
    """
    found: dict[str, list[str]] = {}
    for name in markers:
        match = re.match(pattern, name)
        if match:
            found.setdefault(match[1], []).append(name)
    return [sorted(found[plane], key=natural_key) for plane in sorted(found, key=natural_key)]


def columns_of(entry: tuple[Column, ...] | str, axes: str) -> tuple[Column, ...]:
    """The columns of a position ("xyz") or orientation ("xyzw") given by columns or by a name."""
    if isinstance(entry, str):
        return tuple(f"{entry}.{'q' * (len(axes) == 4)}{axis}" for axis in axes)
    return tuple(entry)


def needed_columns(points: tuple[KeyPoint, ...], frame: FrameMap) -> list[Column]:
    """All columns of positions and orientations."""
    found: list[Column] = []
    for point in points:
        for position in point.positions:
            found += columns_of(position, "xyz")
        if point.quaternion:
            found += columns_of(point.quaternion, "xyzw")
    if frame.base:
        found += columns_of(frame.base.position, "xyz") + columns_of(frame.base.quaternion, "xyzw")
    return found


def quaternions(points: tuple[KeyPoint, ...], frame: FrameMap) -> list[tuple[Column, ...]]:
    """The four columns of every orientation."""
    found = [columns_of(point.quaternion, "xyzw") for point in points if point.quaternion]
    return found + ([columns_of(frame.base.quaternion, "xyzw")] if frame.base else [])


def read_points(
    joined: Joined, spec: KeyPointsMap, maps: tuple[KeyPoint, ...], frame: FrameMap, unit: str
) -> Points:
    """Key points in the arm's base frame; `unit` is the unit of the raw positions."""
    scale = MM_PER[unit] * spec.scale
    notes: list[str] = []
    raw = np.stack(
        [_raw_point(joined, spec, point, j, scale, notes) for j, point in enumerate(maps)], axis=1
    )
    if spec.repeated == "missing":
        notes += _stale_notes(joined, spec, maps)
    raw = _in_order(joined, spec, raw)
    turned, to_base = _relative_to_base(joined, spec, frame.base, raw, scale, frame.rest_rows)
    rest = _rest(turned, frame.rest_rows)
    origin = rest[0] if isinstance(frame.origin, str) else np.array(frame.origin) * scale
    if np.isnan(origin).any():
        raise InputError(f"{joined.main.path}: key point k0 is missing in every row at rest")
    rotation = frame.matrix
    if frame.align_z == "rest":
        rotation = turn_to_z(_chord(joined, rotation @ (rest - origin).T, frame)) @ rotation
    key_points = (turned - origin) @ rotation.T
    gravity = None
    if frame.gravity is not None:
        gravity = rotation @ to_base @ np.array(frame.gravity)
        gravity /= np.linalg.norm(gravity)
    _note_tilt(key_points, frame, notes)
    return Points(key_points, gravity, notes)


def _in_order(joined: Joined, spec: KeyPointsMap, raw: np.ndarray) -> np.ndarray:
    """The positions (T, n, 3) base to tip, dead key points missing."""
    count = raw.shape[1]
    for name, given in (("order", spec.order), ("lost", spec.lost)):
        short = name == "order" and len(given) not in (0, count)
        if short or max(given, default=-1) >= count:
            raise InputError(
                f"{joined.main.path}: [key_points] {name} = {[*given]} in the map, expected "
                f"numbers of its {count} key points, from 0 to {count - 1}"
            )
    raw[:, list(spec.lost)] = np.nan
    return raw[:, list(spec.order)] if spec.order else raw


def _raw_point(
    joined: Joined, spec: KeyPointsMap, point: KeyPoint, j: int, scale: float, notes: list[str]
) -> np.ndarray:
    """One key point (T, 3) in the raw frame [mm]."""
    role = spec.file
    cells = [joined.take(role, columns_of(p, "xyz")) for p in point.positions]
    if len(cells) == 1:
        position = cells[0] * scale
    else:
        position = _circle(joined, np.stack(cells, axis=1) * scale, spec, j, notes)
    if any(point.offset) and point.quaternion is not None:
        q = joined.take(role, columns_of(point.quaternion, "xyzw"))
        arm = np.array(point.offset) * scale
        position = position + matrices(q, spec.quaternion_order) @ arm
    if spec.repeated == "missing":
        stale = _stale(joined, np.concatenate(cells, axis=1))
        position = np.where(stale[:, None], np.nan, position)
    return np.where(np.isnan(position).any(axis=1, keepdims=True), np.nan, position)


def _circle(
    joined: Joined, markers: np.ndarray, spec: KeyPointsMap, j: int, notes: list[str]
) -> np.ndarray:
    """Centre (T, 3) of the markers (T, k, 3), missing where the circle does not fit."""
    centres, radii, residuals = circle_centres(markers)
    if np.isnan(centres).all():
        enough = ((~np.isnan(markers).any(axis=2)).sum(axis=1) >= 3).any()
        came = "stand on one line" if enough else "are never seen three at a time"
        raise InputError(
            f"{joined.main.path}: the markers of key point k{j} {came}, "
            "expected three that define a circle"
        )
    poor = residuals > spec.max_residual_mm
    lost = int(np.isnan(centres).any(axis=1).sum())
    text = (
        f"key point k{j}: circle through {markers.shape[1]} markers, radius "
        f"{np.nanmedian(radii):.3f} mm, residual {np.nanmedian(residuals):.3f} mm (medians)"
    )
    text += f", {lost} rows with fewer than three markers or on a line" if lost else ""
    text += f", {int(poor.sum())} rows beyond max_residual_mm" if poor.any() else ""
    notes.append(text)
    return np.where(poor[:, None], np.nan, centres)


def _stale(joined: Joined, cells: np.ndarray) -> np.ndarray:
    """(T,) bool: cells (T, c) that equal those of the row before in the main file bit for bit."""
    same = (cells[1:] == cells[:-1]).all(axis=1) & (np.diff(joined.rows) == 1)
    return np.concatenate([[False], same])


def _stale_notes(joined: Joined, spec: KeyPointsMap, maps: tuple[KeyPoint, ...]) -> list[str]:
    counts = []
    for point in maps:
        cells = [joined.take(spec.file, columns_of(p, "xyz")) for p in point.positions]
        counts.append(int(_stale(joined, np.concatenate(cells, axis=1)).sum()))
    each = ", ".join(f"k{j} {count}" for j, count in enumerate(counts) if count)
    text = (
        f"positions that repeat the row before count as missing: {each} of {len(joined.rows)} rows"
    )
    return [text] if each else []


def _relative_to_base(
    joined: Joined,
    spec: KeyPointsMap,
    base: BaseMap | None,
    raw: np.ndarray,
    scale: float,
    rest_rows: int,
) -> tuple[np.ndarray, np.ndarray]:
    """The positions (T, n, 3) in the base body's frame, and the (mean) rotation into it (3, 3)."""
    if base is None:
        return raw, np.eye(3)
    position = joined.take(spec.file, columns_of(base.position, "xyz")) * scale
    q = joined.take(spec.file, columns_of(base.quaternion, "xyzw"))
    order = spec.quaternion_order
    some = slice(0, rest_rows) if base.mode == "rest" else slice(None)
    mean = mean_rotation(q[some], order)
    check_pose(mean, joined.main.path)
    if base.mode == "moving":
        turned = np.einsum("tba,tnb->tna", matrices(q, order), raw - position[:, None])
        return turned, mean.T
    known = position[some][~np.isnan(position[some]).any(axis=1)]
    if not len(known):
        raise InputError(f"{joined.main.path}: the base body has no position in any row")
    return (raw - known.mean(axis=0)) @ mean, mean.T


def _rest(points: np.ndarray, rows: int) -> np.ndarray:
    """Mean (n, 3) of each key point over the first rows (T, n, 3); NaN where it is missing."""
    first = points[:rows]
    known = ~np.isnan(first)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(known, first, 0).sum(axis=0) / known.sum(axis=0)


def _chord(joined: Joined, rest: np.ndarray, frame: FrameMap) -> np.ndarray:
    """The line (3,) from key point 0 (or the origin, for one key point) to the tip at rest."""
    tip = rest[:, -1]
    start = rest[:, 0] if rest.shape[1] > 1 else np.zeros(3)
    chord = tip - start
    if np.isnan(chord).any() or np.linalg.norm(chord) < 1e-9:
        raise InputError(
            f"{joined.main.path}: align_z needs the first and last key point in the first "
            f"{frame.rest_rows} rows, but they are missing or in one place; set rest_rows or "
            "rotation in the map"
        )
    return chord


def _note_tilt(key_points: np.ndarray, frame: FrameMap, notes: list[str]) -> None:
    """Add a note where the arm at rest does not point along z."""
    rest = _rest(key_points, frame.rest_rows)
    start = rest[0] if len(rest) > 1 else np.zeros(3)
    chord = rest[-1] - start
    length = np.linalg.norm(chord)
    if np.isnan(length) or length < 1e-9:
        return
    angle = np.degrees(np.arccos(np.clip(chord[2] / length, -1, 1)))
    if angle > TILT_NOTE_DEG:
        notes.append(
            f"in the first {frame.rest_rows} rows the arm points {angle:.0f} degrees away from z; "
            "expected z along the arm at rest: check [frame] in the map"
        )
