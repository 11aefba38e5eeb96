"""Soft arms that move: short cylinders along the centreline, with bands at the key points."""

from __future__ import annotations

import numpy as np
import rerun as rr

from surgisoft.replay.colours import ARM_COLOURS, BAND_COLOURS, CHARRED, SHAFT_COLOUR
from surgisoft.replay.recording import Columns
from surgisoft.scene import frames
from surgisoft.tasks.episode_parts import ArmLog

BORE_MM = 1.5
"""Radius of the dark mark on the tip: the paper's arm has a channel 3 mm across (mm)."""
BAND_MM = 1.4
"""Length of the band at a key point (mm)."""
SOLID = rr.components.FillMode.Solid


def log_arm(columns: Columns, name: str, arm: ArmLog, rows: np.ndarray) -> None:
    """One arm in the log's `rows`: its shaft once, its body, its bands, its tip."""
    colour = ARM_COLOURS.get(name, ARM_COLOURS["arm"])
    band = BAND_COLOURS.get(name, BAND_COLOURS["arm"])
    radius, base = arm.radius_mm, arm.mount[:3, 3]
    if arm.shaft_mm > 0.0:
        behind = base - arm.shaft_mm * arm.mount[:3, 2]
        _log_rod(columns.recording, f"/arms/{name}/shaft", behind, base, 1.02 * radius)
    body = arm.line_mm[rows][:, 1 if arm.shaft_mm > 0.0 else 0 :]
    log_cylinders(columns, f"/arms/{name}/body", rows, *joined(body, radius), radius, colour)
    middles, axes = key_planes(arm.points_mm[rows], body)
    # The bands at the ends stay short of the ends, so that each face is drawn by one body only.
    middles[:, 0] += 0.7 * BAND_MM * axes[:, 0]
    middles[:, -1] -= 0.7 * BAND_MM * axes[:, -1]
    lengths = np.full(middles.shape[:2], BAND_MM)
    ends = (middles, axes, lengths)
    log_cylinders(columns, f"/arms/{name}/key_points", rows, *ends, 1.03 * radius, band)
    tip, aim = arm.points_mm[rows][:, -1:], arm.tip_direction[rows][:, None]
    mark = (tip, aim, np.full((len(rows), 1), 0.3))
    log_cylinders(columns, f"/arms/{name}/tip", rows, *mark, BORE_MM, CHARRED)
    if not np.array_equal(arm.seen_mm, arm.points_mm):
        seen = arm.seen_mm[rows]
        positions = rr.Points3D.columns(positions=seen.reshape(-1, 3))
        columns.send(
            f"/arms/{name}/measured", rows, positions.partition([seen.shape[1]] * len(rows))
        )


def joined(line_mm: np.ndarray, radius_mm: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cylinders of a tube along lines (T, K, 3): middles (T, K - 1, 3), axes, lengths (T, K - 1).

    Each is longer than its stretch by what closes the gap on the outer side of a bend, but for the
    ends of the tube.
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
    """Middles (T, n, 3) and axes (T, n, 3) of the key planes of points on lines (T, K, 3)."""
    away = frames.norm(points_mm[:, :, None] - line_mm[:, None])
    near = away.argmin(axis=2)
    last = line_mm.shape[1] - 1
    row = np.arange(len(line_mm))[:, None]
    ahead = line_mm[row, np.minimum(near + 1, last)] - line_mm[row, np.maximum(near - 1, 0)]
    return points_mm.copy(), frames.normalise(ahead)


def log_cylinders(
    columns: Columns, entity: str, rows, middles, axes, lengths, radius_mm: float, colour
) -> None:
    """Cylinders (R, C, ...) of one radius and colour, in the log's `rows` (R,)."""
    count = middles.shape[1]
    still = rr.Cylinders3D.from_fields(radii=radius_mm, colors=colour, fill_mode=SOLID)
    columns.recording.log(entity, still, static=True)
    moving = rr.Cylinders3D.columns(
        lengths=lengths.reshape(-1),
        centers=middles.reshape(-1, 3),
        quaternions=turns_from_z(axes.reshape(-1, 3)),
    )
    columns.send(entity, rows, moving.partition([count] * len(rows)))


def turns_from_z(axes: np.ndarray) -> np.ndarray:
    """(N, 4) quaternions x, y, z, w that turn the z axis the short way onto unit axes (N, 3)."""
    x, y, z = axes.T
    flipped = z < -1.0 + 1e-6
    turn = np.column_stack((-y, x, np.zeros_like(x), 1.0 + z))
    turn[flipped] = (1.0, 0.0, 0.0, 0.0)
    return (turn / np.linalg.norm(turn, axis=1, keepdims=True)).astype(np.float32)


def _log_rod(recording, entity: str, start, end, radius_mm: float) -> None:
    """One cylinder that never moves."""
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
