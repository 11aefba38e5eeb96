"""Soft arms that move: short sleeves along the centreline, with bands at the key points."""

from __future__ import annotations

import numpy as np
import rerun as rr

from surgisoft.replay.colours import ARM_COLOURS, BAND_COLOURS, CHARRED, SHAFT_COLOUR
from surgisoft.replay.recording import Columns
from surgisoft.replay.shapes import BORE_RINGS, tube
from surgisoft.scene import frames
from surgisoft.tasks.episodes.parts import ArmLog

BORE_MM = 1.5
"""Radius of the channel in the tip (mm); it is 3 mm across in the paper's arm."""
BAND_MM = 1.4
"""Length of the band at a key point (mm)."""
TIP_MM = 1.2
"""Length of the bevelled end (mm)."""
SOCKET_MM = 3.0
"""Length of the socket that is drawn behind an arm without a shaft (mm)."""
SIDES = 40
"""Corners of a sleeve's section."""
SOLID = rr.components.FillMode.Solid


def log_arm(columns: Columns, name: str, arm: ArmLog, rows: np.ndarray) -> None:
    """Log one arm in the log's `rows`: shaft, body, bands at the key points, tip."""
    colour, band = ARM_COLOURS[arm.tool or "arm"], BAND_COLOURS[arm.tool or "arm"]
    radius, base = arm.radius_mm, arm.mount[:3, 3]
    behind = base - max(arm.shaft_mm, SOCKET_MM) * arm.mount[:3, 2]
    _log_rod(columns.recording, f"/arms/{name}/shaft", behind, base, 1.02 * radius)
    body = arm.line_mm[rows][:, 1 if arm.shaft_mm > 0.0 else 0 :]
    _log_sleeves(columns, f"/arms/{name}/body", rows, body, radius, colour)
    tip, aim = arm.points_mm[rows][:, -1], arm.tip_direction[rows]
    _log_tip(columns, f"/arms/{name}/tip", rows, tip, aim, radius, colour)
    middles, axes = key_planes(arm.points_mm[rows], body)
    # The bands at the ends stay short of them, so that each face is drawn by one body only.
    if middles.shape[1] > 1:
        middles[:, 0] += 0.7 * BAND_MM * axes[:, 0]
    middles[:, -1] -= 1.5 * BAND_MM * axes[:, -1]
    _log_bands(columns, f"/arms/{name}/key_points", rows, middles, axes, 1.03 * radius, band)
    if not np.array_equal(arm.seen_mm, arm.points_mm):
        seen, entity = arm.seen_mm[rows], f"/arms/{name}/measured"
        positions = rr.Points3D.columns(positions=seen.reshape(-1, 3))
        columns.send(entity, rows, positions.partition([seen.shape[1]] * len(rows)))


def joined(line_mm: np.ndarray, radius_mm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cylinders of a tube along lines (T, K, 3): middles (T, K - 1, 3), axes, lengths (T, K - 1).

    Each cylinder is longer than its segment, so that no gap opens on the outer side of a bend; at
    the ends of the tube it is not.
    """
    steps = np.diff(line_mm, axis=1)
    length = frames.norm(steps)
    axes = frames.normalise(steps)
    kink = frames.angle_between(axes[:, :-1], axes[:, 1:])
    more = radius_mm * np.tan(0.5 * np.minimum(kink, 1.0))
    flush = np.zeros_like(more[:, :1])
    before, after = np.concatenate((flush, more), 1), np.concatenate((more, flush), 1)
    middles = 0.5 * (line_mm[:, 1:] + line_mm[:, :-1]) + 0.5 * (after - before)[..., None] * axes
    return middles, axes, length + before + after


def key_planes(points_mm: np.ndarray, line_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Middles (T, n, 3) and axes (T, n, 3) of the key planes at points on lines (T, K, 3)."""
    away = frames.norm(points_mm[:, :, None] - line_mm[:, None])
    near = away.argmin(axis=2)
    last = line_mm.shape[1] - 1
    row = np.arange(len(line_mm))[:, None]
    ahead = line_mm[row, np.minimum(near + 1, last)] - line_mm[row, np.maximum(near - 1, 0)]
    return points_mm.copy(), frames.normalise(ahead)


def _log_sleeves(
    columns: Columns, entity: str, rows, line_mm: np.ndarray, radius_mm: float, colour
) -> None:
    """Log the body along lines (R, K, 3) mm: one open sleeve, drawn K - 1 times in each row."""
    middles, axes, lengths = joined(line_mm, radius_mm)
    middles[:, -1] -= 0.5 * TIP_MM * axes[:, -1]
    lengths[:, -1] -= TIP_MM
    vertices, faces, normals = _sleeve(radius_mm)
    still = rr.Mesh3D(
        vertex_positions=vertices,
        triangle_indices=faces,
        vertex_normals=normals,
        albedo_factor=colour,
    )
    columns.recording.log(entity, still, static=True)
    scales = np.ones((lengths.size, 3))
    scales[:, 2] = lengths.reshape(-1)
    poses = rr.InstancePoses3D.columns(
        translations=middles.reshape(-1, 3),
        quaternions=turns_from_z(axes.reshape(-1, 3)),
        scales=scales,
    )
    columns.send(entity, rows, poses.partition([lengths.shape[1]] * len(rows)))


def _sleeve(radius_mm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, faces and normals of an open cylinder of length 1 about the origin, along z."""
    around = 2.0 * np.pi * np.arange(SIDES) / SIDES
    out = np.stack((np.cos(around), np.sin(around), 0.0 * around), axis=1)
    half = np.array([0.0, 0.0, 0.5])
    vertices = np.concatenate((radius_mm * out - half, radius_mm * out + half))
    a, b = np.arange(SIDES), np.roll(np.arange(SIDES), -1)
    faces = np.concatenate((np.stack((a, b, b + SIDES), 1), np.stack((a, b + SIDES, a + SIDES), 1)))
    return vertices, faces, np.concatenate((out, out))


def _log_tip(columns: Columns, entity: str, rows, tip_mm, aim, radius_mm: float, colour) -> None:
    """Log the bevelled end with its channel, at tips (R, 3) mm along `aim` (R, 3)."""
    line = np.array([[0.0, 0.0, -1.5 * TIP_MM], [0.0, 0.0, -0.5 * TIP_MM], [0.0, 0.0, 0.0]])
    vertices, faces, normals = tube(line, radius_mm, BORE_MM, SIDES)
    hole = np.arange(len(vertices)) >= len(vertices) - BORE_RINGS * SIDES
    colours = np.where(hole[:, None], CHARRED, colour).astype(np.uint8)
    still = rr.Mesh3D(
        vertex_positions=vertices,
        triangle_indices=faces,
        vertex_normals=normals,
        vertex_colors=colours,
    )
    columns.recording.log(entity, still, static=True)
    poses = rr.InstancePoses3D.columns(translations=tip_mm, quaternions=turns_from_z(aim))
    columns.send(entity, rows, poses)


def _log_bands(columns: Columns, entity: str, rows, middles, axes, radius_mm: float, colour):
    """Log a short cylinder at each key point: middles and axes (R, n, 3)."""
    count = middles.shape[1]
    still = rr.Cylinders3D.from_fields(
        lengths=BAND_MM, radii=radius_mm, colors=colour, fill_mode=SOLID
    )
    columns.recording.log(entity, still, static=True)
    moving = rr.Cylinders3D.columns(
        centers=middles.reshape(-1, 3), quaternions=turns_from_z(axes.reshape(-1, 3))
    )
    columns.send(entity, rows, moving.partition([count] * len(rows)))


def turns_from_z(axes: np.ndarray) -> np.ndarray:
    """(N, 4) quaternions x, y, z, w: smallest rotations of the z axis onto unit axes (N, 3)."""
    x, y, z = axes.T
    flipped = z < -1.0 + 1e-6
    turn = np.column_stack((-y, x, np.zeros_like(x), 1.0 + z))
    turn[flipped] = (1.0, 0.0, 0.0, 0.0)
    return (turn / np.linalg.norm(turn, axis=1, keepdims=True)).astype(np.float32)


def _log_rod(recording, entity: str, start, end, radius_mm: float) -> None:
    """Log one cylinder that does not move."""
    axis = end - start
    length = float(np.linalg.norm(axis))
    rod = rr.Cylinders3D(
        lengths=[length],
        radii=[radius_mm],
        centers=[0.5 * (start + end)],
        quaternions=turns_from_z(axis[None] / max(length, 1e-12)),
        colors=[SHAFT_COLOUR],
        fill_mode=SOLID,
    )
    recording.log(entity, rod, static=True)
