"""Endoscope pictures rendered from an episode's log as JPEG, and the pose of the camera."""

from __future__ import annotations

import io
import math

import numpy as np
import rerun as rr
from scipy.spatial import cKDTree

from surgisoft.progress import Progress, silent
from surgisoft.replay.colours import CONE_COLOUR, LESION_TINT
from surgisoft.replay.recording import Columns
from surgisoft.replay.shapes import view_cone
from surgisoft.scene import frames
from surgisoft.scene.camera import Camera
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.dose_patch import LESION
from surgisoft.scene.mesh import Body, Mesh
from surgisoft.scene.render import Renderer
from surgisoft.tasks.episodes.log import CameraLog, EpisodeLog
from surgisoft.tasks.world.scene import ENDOSCOPE, LASER

CAMERA = "/endoscope/camera"
"""The camera's pose and its pictures, for the 2D view."""
CONE = "/endoscope/cone"
"""The camera's round field of view as lines, for the 3D view: a pinhole is drawn as a pyramid."""
PIXELS = 240
"""Width and height of a picture."""
PICTURES_HZ = 2.5
"""Pictures per second."""
JPEG_QUALITY = 82
CONE_MM = 16.0
"""Length of the drawn cone (mm)."""
LESION_LINEAR = np.array([0.62, 0.34, 0.16])
BLANCHED_LINEAR = np.array([0.62, 0.50, 0.42])
CHARRED_LINEAR = np.array([0.015, 0.012, 0.010])
"""Linear colours of tissue in the picture."""
SAMPLE_MM = 0.4
"""A pixel takes its dose from a sample within this distance (mm)."""


def log_camera(
    columns: Columns,
    log: EpisodeLog,
    camera: CameraLog,
    rows: np.ndarray,
    looks: np.ndarray,
    report: Progress = silent,
) -> None:
    """Log the camera's pose in the log's `rows`, and its picture in rows `looks`."""
    arm, half = log.arms[ENDOSCOPE], 0.5 * camera.fov_rad
    pinhole = rr.Pinhole(
        resolution=[PIXELS, PIXELS],
        focal_length=0.5 * PIXELS / math.tan(half),
        camera_xyz=rr.ViewCoordinates.RDF,
    )
    columns.recording.log(CAMERA, pinhole, static=True)
    lines = view_cone(np.zeros(3), np.array([0.0, 0.0, 1.0]), half, CONE_MM)
    cone = rr.LineStrips3D(lines, colors=[CONE_COLOUR] * len(lines), radii=[0.15] * len(lines))
    columns.recording.log(CONE, cone, static=True)
    poses = frames.pose_from_z(arm.line_mm[rows, -1].astype(float), arm.tip_direction[rows])
    for entity in (CAMERA, CONE):
        moving = rr.Transform3D.columns(
            translation=poses[:, :3, 3], mat3x3=poses[:, :3, :3].astype(np.float32)
        )
        columns.send(entity, rows, moving)
    pictures = jpegs(log, camera, looks, report)
    style = rr.EncodedImage.from_fields(media_type="image/jpeg", magnification_filter="linear")
    columns.recording.log(f"{CAMERA}/picture", style, static=True)
    shown = rr.EncodedImage.columns(blob=pictures)
    columns.send(f"{CAMERA}/picture", looks, shown)


def jpegs(
    log: EpisodeLog, camera: CameraLog, rows: np.ndarray, report: Progress = silent
) -> list[bytes]:
    """The endoscope's round picture in each of the log's `rows`, as JPEG files."""
    from PIL import Image

    bodies = [Body(b.name, b.role, Mesh(b.vertices_mm, b.faces)) for b in log.bodies]
    low, high = camera.range_mm
    renderer = Renderer(bodies, Camera(camera.fov_rad, (low, high)), PIXELS, PIXELS)
    paint, files = _Paint(log), []
    poses = frames.pose_from_z(
        log.arms[ENDOSCOPE].line_mm[:, -1].astype(float), log.arms[ENDOSCOPE].tip_direction
    )
    for row in rows:
        shapes = {name: ArmShape(arm.line_mm[row], arm.radius_mm) for name, arm in log.arms.items()}
        picture = renderer.image(
            poses[row], shapes, ENDOSCOPE, _visible_beam(log, row), paint.at(int(row))
        )
        file = io.BytesIO()
        Image.fromarray(picture).save(file, "JPEG", quality=JPEG_QUALITY)
        files.append(file.getvalue())
        report(len(files), len(rows), "endoscope")
    return files


def _visible_beam(log: EpisodeLog, row: int) -> np.ndarray | None:
    """(2, 3) mm: the beam's ends while it is on, else None."""
    if log.beam is None or not log.beam.on[row]:
        return None
    return np.stack((log.arms[LASER].line_mm[row, -1], log.beam.end_mm[row]))


class _Paint:
    """Colours the organ in the picture: a tint for the lesion, and the dose of a row."""

    def __init__(self, log: EpisodeLog):
        self.dose = log.dose
        if self.dose is not None:
            self.tree = cKDTree(self.dose.points_mm)
            self.low = self.dose.points_mm.min(axis=0) - SAMPLE_MM
            self.high = self.dose.points_mm.max(axis=0) + SAMPLE_MM
            self.tint = LESION_TINT * np.append(self.dose.zone == LESION, False)[:, None]

    def at(self, row: int):
        """The `paint` argument of `Renderer.image` for a row; None without a dose."""
        if self.dose is None:
            return None
        share = np.append(self.dose.at(row) / self.dose.threshold_j_per_mm2, 0.0)[:, None]

        def recolour(_faces, points, colours):
            near = ((points >= self.low) & (points <= self.high)).all(axis=1)
            _, sample = self.tree.query(points[near], distance_upper_bound=SAMPLE_MM)
            heat, base = share[sample], colours[near]
            base = base + (LESION_LINEAR - base) * self.tint[sample]
            pale = base + (BLANCHED_LINEAR - base) * np.clip(heat, 0.0, 1.0)
            colours[near] = np.where(heat >= 1.0, CHARRED_LINEAR, pale)
            return colours

        return {self.dose.body: recolour}
