"""Endoscope pictures rendered from an episode's log as JPEG, and the pose of the camera."""

from __future__ import annotations

import io
import math

import numpy as np
import rerun as rr
from scipy.spatial import cKDTree

from surgisoft.progress import Progress, silent
from surgisoft.replay.colours import CONE_COLOUR
from surgisoft.replay.recording import Columns
from surgisoft.replay.shapes import view_cone
from surgisoft.scene import frames
from surgisoft.scene.camera import Camera
from surgisoft.scene.capsules import ArmShape
from surgisoft.scene.dose_patch import LESION
from surgisoft.scene.mesh import Body, Mesh
from surgisoft.scene.render import SAMPLE_MM, Renderer, stained
from surgisoft.tasks.episodes.log import EpisodeLog

PIXELS = 240
"""Width and height of a picture."""
PICTURES_HZ = 2.5
"""Pictures per second."""
JPEG_QUALITY = 82
CONE_MM = 16.0
"""Length of the drawn cone (mm)."""


def camera_entity(endoscope: str) -> str:
    """Entity of a camera's pose and its pictures, for the 2D view."""
    return f"/{endoscope}/camera"


def cone_entity(endoscope: str) -> str:
    """Entity of a camera's field of view as lines: a pinhole is drawn as a pyramid in 3D."""
    return f"/{endoscope}/cone"


def log_camera(
    columns: Columns,
    log: EpisodeLog,
    name: str,
    rows: np.ndarray,
    looks: np.ndarray,
    report: Progress = silent,
) -> None:
    """Log the pose of an endoscope's camera in the log's `rows`, its picture in rows `looks`."""
    arm, camera = log.arms[name], log.cameras[name]
    half, place, cone = 0.5 * camera.fov_rad, camera_entity(name), cone_entity(name)
    pinhole = rr.Pinhole(
        resolution=[PIXELS, PIXELS],
        focal_length=0.5 * PIXELS / math.tan(half),
        camera_xyz=rr.ViewCoordinates.RDF,
    )
    columns.recording.log(place, pinhole, static=True)
    lines = view_cone(np.zeros(3), np.array([0.0, 0.0, 1.0]), half, CONE_MM)
    drawn = rr.LineStrips3D(lines, colors=[CONE_COLOUR] * len(lines), radii=[0.15] * len(lines))
    columns.recording.log(cone, drawn, static=True)
    poses = frames.pose_from_z(arm.line_mm[rows, -1].astype(float), arm.tip_direction[rows])
    for entity in (place, cone):
        moving = rr.Transform3D.columns(
            translation=poses[:, :3, 3], mat3x3=poses[:, :3, :3].astype(np.float32)
        )
        columns.send(entity, rows, moving)
    pictures = jpegs(log, name, looks, report)
    style = rr.EncodedImage.from_fields(media_type="image/jpeg", magnification_filter="linear")
    columns.recording.log(f"{place}/picture", style, static=True)
    shown = rr.EncodedImage.columns(blob=pictures)
    columns.send(f"{place}/picture", looks, shown)


def jpegs(log: EpisodeLog, name: str, rows: np.ndarray, report: Progress = silent) -> list[bytes]:
    """The round picture of an endoscope in each of the log's `rows`, as JPEG files."""
    from PIL import Image

    camera, arm = log.cameras[name], log.arms[name]

    low, high = camera.range_mm
    optics, moves = (
        Camera(camera.fov_rad, (low, high)),
        any(b.motion is not None for b in log.bodies),
    )
    renderer = None
    paint, files = _Paint(log), []
    poses = frames.pose_from_z(arm.line_mm[:, -1].astype(float), arm.tip_direction)
    for row in rows:
        if renderer is None or moves:
            bodies = [Body(b.name, b.role, Mesh(b.moved_mm(row), b.faces)) for b in log.bodies]
            renderer = Renderer(bodies, optics, PIXELS, PIXELS)
        shapes = {name: ArmShape(arm.line_mm[row], arm.radius_mm) for name, arm in log.arms.items()}
        picture = renderer.image(
            poses[row], shapes, name, _visible_beams(log, row), paint.at(int(row))
        )
        file = io.BytesIO()
        Image.fromarray(picture).save(file, "JPEG", quality=JPEG_QUALITY)
        files.append(file.getvalue())
        report(len(files), len(rows), name)
    return files


def _visible_beams(log: EpisodeLog, row: int) -> np.ndarray | None:
    """(L, 2, 3) mm: both ends of the L beams that are on; None where none is."""
    ends = [
        np.stack((log.arms[name].line_mm[row, -1], beam.end_mm[row]))
        for name, beam in log.beams.items()
        if beam.on[row]
    ]
    return np.stack(ends) if ends else None


class _Paint:
    """Colours the organ in the picture: a tint for the lesion, and the dose of a row."""

    def __init__(self, log: EpisodeLog):
        self.dose = log.dose
        if self.dose is not None:
            self.motion = log.body(self.dose.body).motion
            self.tree = cKDTree(self.dose.points_mm)
            self.low = self.dose.points_mm.min(axis=0) - SAMPLE_MM
            self.high = self.dose.points_mm.max(axis=0) + SAMPLE_MM
            self.lesion = np.append(self.dose.zone == LESION, False)

    def at(self, row: int):
        """The `paint` argument of `Renderer.image` for a row; None without a dose."""
        if self.dose is None:
            return None
        motion = self.motion
        to_rest = None if motion is None else np.linalg.inv(motion[row].astype(float))
        share = np.append(self.dose.at(row) / self.dose.threshold_j_per_mm2, 0.0)

        def recolour(_faces, points, colours):
            if to_rest is not None:  # the dose is stored in the frame of the organ at rest
                points = frames.apply(to_rest, points)
            near = ((points >= self.low) & (points <= self.high)).all(axis=1)
            _, sample = self.tree.query(points[near], distance_upper_bound=SAMPLE_MM)
            colours[near] = stained(colours[near], self.lesion[sample], share[sample])
            return colours

        return {self.dose.body: recolour}
