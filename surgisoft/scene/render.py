"""The endoscope's picture by ray casting: shaded bodies, arms, the beam and the burnt tissue.

Each pixel is one ray: Embree finds the hits on bodies, closed forms those on arms. A lamp beside
the lens lights the scene. The picture is round, as wide as the field of view, with black corners.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from surgisoft.compiled import compiled
from surgisoft.scene import frames
from surgisoft.scene.camera import Camera
from surgisoft.scene.capsules import ArmShape, self_contact_gap_mm
from surgisoft.scene.mesh import Body, Mesh
from surgisoft.scene.rays import EmbreeSurface, rays_to_chains

BODY_COLOURS = {
    "organ": (0.38, 0.095, 0.07),
    "keep-out": (0.23, 0.37, 0.07),
    "support": (0.36, 0.42, 0.40),
}
"""Linear colour of a body by its role; the hues are those of the 3D view (`replay.colours`)."""
ARM_COLOUR = (0.72, 0.70, 0.66)
"""Linear colour of the arms: light silicone."""
BEAM_COLOUR = (0.15, 1.0, 0.35)
"""Linear colour of the aiming beam."""
BEAM_RADIUS_MM = 0.4
"""Half-width of the beam's glow in the picture (mm)."""
LESION_LINEAR = (0.62, 0.34, 0.16)
"""Linear colour of a lesion."""
LESION_TINT = 0.35
"""Share of the lesion's colour that is mixed into the organ's inside the ring."""
BLANCHED_LINEAR = (0.62, 0.50, 0.42)
"""Linear colour of tissue just below the threshold of ablation."""
CHARRED_LINEAR = (0.015, 0.012, 0.010)
"""Linear colour of ablated tissue."""
SAMPLE_MM = 0.4
"""A pixel takes its dose from a sample within this distance (mm)."""
BACKGROUND = (0.020, 0.008, 0.007)
"""Linear colour where a ray meets nothing: the dark of the body's cavity."""
SHARP_COSINE = 0.8
"""Corners whose vertex normal is farther from the face's than this stay sharp (37 degrees)."""
LAMP_HALF_MM = 70.0
"""Distance at which the lamp's light has fallen to a half (mm)."""


class Renderer:
    """Renders pictures of a fixed set of bodies; built once, one picture per call."""

    def __init__(
        self,
        bodies: Sequence[Body],
        camera: Camera,
        width: int = 160,
        height: int = 120,
        lamp_half_mm: float = LAMP_HALF_MM,
        round_view: bool = True,
    ):
        """lamp_half_mm: distance at which the light has fallen to a half; round_view: whether the
        corners are black, as in an endoscope's picture."""
        meshes = [body.world_mesh for body in bodies]
        starts = np.cumsum([0, *(len(m.vertices_mm) for m in meshes)])
        vertices = np.concatenate([m.vertices_mm for m in meshes])
        faces = [m.faces + start for m, start in zip(meshes, starts, strict=False)]
        self._mesh = Mesh(vertices, np.concatenate(faces))
        self._corner_normals = corner_normals(self._mesh)
        colours = [
            np.full((len(m.faces), 3), BODY_COLOURS[b.role])
            for b, m in zip(bodies, meshes, strict=True)
        ]
        self._face_colours = np.concatenate(colours)
        self._first_face = np.cumsum([0, *(len(m.faces) for m in meshes)])
        self._names = [body.name for body in bodies]
        self._surface = EmbreeSurface(self._mesh)
        self._camera, self.width, self.height = camera, width, height
        self._rays, inside = pixel_rays(camera, width, height)
        self._inside = inside if round_view else np.ones_like(inside)
        self._lamp_half_mm = lamp_half_mm

    def image(
        self,
        pose: np.ndarray,
        arms: Mapping[str, ArmShape] | None = None,
        own: str | None = None,
        beam_mm: np.ndarray | None = None,
        paint: Mapping[str, Callable] | None = None,
        beam_radius_mm: float = BEAM_RADIUS_MM,
    ) -> np.ndarray:
        """(height, width, 3) uint8 picture from pose (4, 4).

        `own` carries the camera; beam_mm (2, 3) or (L, 2, 3) mm are the ends of the visible beams,
        beam_radius_mm the half-width of their glow; `paint` maps a body's name to a function of
        (faces (N,), points (N, 3) mm world, colours (N, 3)) that returns new linear colours.
        """
        pose = np.asarray(pose, dtype=np.float64)
        origin = pose[:3, 3]
        rays = self._rays @ pose[:3, :3].T
        origins = np.tile(origin, (len(rays), 1))
        farthest = 4.0 * self._camera.range_mm[1]
        distance, face = self._surface.first_hit(origins, rays, farthest)
        points = origin + distance[:, None] * rays
        colour = np.zeros_like(rays)
        normal = np.zeros_like(rays)
        met = np.flatnonzero(face >= 0)
        colour[met] = self._face_colours[face[met]]
        _smooth_normals(met, face, points, self._mesh.triangles_mm, self._corner_normals, normal)
        for name, recolour in (paint or {}).items():
            self._paint(name, recolour, face, points, colour)
        for name, shape in (arms or {}).items():
            gap = self_contact_gap_mm(shape.radius_mm) if name == own else -1.0
            self._draw_arm(shape, gap, origins, rays, distance, colour, normal)
        beams = np.zeros((0, 2, 3)) if beam_mm is None else np.asarray(beam_mm, dtype=np.float64)
        beam = np.zeros(len(rays))
        for ends in beams.reshape(-1, 2, 3):
            beam = np.maximum(beam, _glow(origin, rays, distance, ends, beam_radius_mm))
        return self._developed(rays, distance, normal, colour, beam)

    def _paint(self, name: str, recolour: Callable, face, points, colour) -> None:
        body = self._names.index(name)
        first, last = self._first_face[body], self._first_face[body + 1]
        seen = np.flatnonzero((face >= first) & (face < last))
        colour[seen] = recolour(face[seen] - first, points[seen], colour[seen])

    def _draw_arm(self, shape: ArmShape, gap, origins, rays, distance, colour, normal) -> None:
        before, segment = distance.copy(), np.zeros((1, len(rays)), np.int64)
        rays_to_chains(
            origins[None],
            rays[None],
            shape.centreline_mm[None].astype(np.float32),  # as simulations have it: one compilation
            shape.radius_mm,
            gap,
            distance[None],
            segment,
        )
        drawn = np.flatnonzero(distance < before)
        points = origins[drawn] + distance[drawn, None] * rays[drawn]
        a = shape.centreline_mm[segment[0, drawn]]
        axis = shape.centreline_mm[segment[0, drawn] + 1] - a
        share = frames.dot(points - a, axis) / np.maximum(frames.dot(axis, axis), 1e-30)
        normal[drawn] = frames.normalise(points - a - share.clip(0, 1)[:, None] * axis)
        colour[drawn] = ARM_COLOUR

    def _developed(self, rays, distance, normal, colour, beam) -> np.ndarray:
        """Apply light, gloss and gamma: linear colours to (H, W, 3) uint8."""
        facing = np.abs(frames.dot(normal, rays))
        lamp = 1.0 / (1.0 + (distance / self._lamp_half_mm) ** 2)
        gloss = 0.35 * facing**40
        light = (colour * (0.06 + 0.94 * facing[:, None]) + gloss[:, None]) * lamp[:, None]
        met = np.any(normal != 0.0, axis=1)[:, None]
        light = np.where(met, 1.7 * light, BACKGROUND)
        light += beam[:, None] * np.array(BEAM_COLOUR)
        film = np.clip(light, 0.0, 1.0) ** (1.0 / 2.2) * self._inside[:, None]
        return (255.0 * film + 0.5).astype(np.uint8).reshape(self.height, self.width, 3)


def stained(colours: np.ndarray, lesion: np.ndarray, heat: np.ndarray) -> np.ndarray:
    """Linear colours (N, 3) of tissue by lesion (N,) bool and dose over threshold, heat (N,)."""
    tint, heat = LESION_TINT * lesion[:, None], heat[:, None]
    base = colours + (np.array(LESION_LINEAR) - colours) * tint
    pale = base + (np.array(BLANCHED_LINEAR) - base) * np.clip(heat, 0.0, 1.0)
    return np.where(heat >= 1.0, np.array(CHARRED_LINEAR), pale)


def pixel_rays(camera: Camera, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit rays (H W, 3) of a picture's pixels in the camera's frame, and which lie in the cone.

    The shorter side spans the field of view.
    """
    focal = 0.5 * min(width, height) / math.tan(0.5 * camera.fov_rad)
    x = np.arange(width) + 0.5 - 0.5 * width
    y = np.arange(height) + 0.5 - 0.5 * height
    grid = np.stack(np.broadcast_arrays(x[None, :], y[:, None], focal), axis=-1).reshape(-1, 3)
    rays = frames.normalise(grid)
    return rays, rays[:, 2] >= math.cos(0.5 * camera.fov_rad)


def corner_normals(mesh: Mesh) -> np.ndarray:
    """(F, 3, 3) unit normals for shading: the vertex's, or the face's at a sharp edge."""
    smooth = mesh.vertex_normals[mesh.faces]
    flat = np.broadcast_to(mesh.face_normals[:, None], smooth.shape)
    return np.where(frames.dot(smooth, flat)[..., None] > SHARP_COSINE, smooth, flat)


@compiled
def _smooth_normals(pixels, face, points, triangles, normals, out):
    """Normals (F, 3, 3) of the corners blended at the points met."""
    for n in pixels:
        f = face[n]
        a, b, c, d, e = 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(3):
            e1 = triangles[f, 1, i] - triangles[f, 0, i]
            e2 = triangles[f, 2, i] - triangles[f, 0, i]
            s = points[n, i] - triangles[f, 0, i]
            a, b, c, d, e = a + e1 * e1, b + e1 * e2, c + e2 * e2, d + s * e1, e + s * e2
        area = a * c - b * b
        v, w = 0.0, 0.0
        if area > 0.0:
            v, w = (c * d - b * e) / area, (a * e - b * d) / area
        length = 0.0
        for i in range(3):
            blend = (1.0 - v - w) * normals[f, 0, i] + v * normals[f, 1, i] + w * normals[f, 2, i]
            out[n, i] = blend
            length += blend * blend
        if length > 0.0:
            length = math.sqrt(length)
            for i in range(3):
                out[n, i] /= length


@compiled
def _glow(origin, rays, distance, beam, radius):
    """(N,) 0..1: how brightly the beam (2, 3) shows on each ray, before what the ray meets.

    By the nearest approach of the ray to the beam (Ericson 2005, section 5.1.8), as a Gaussian.
    """
    out = np.zeros(len(rays))
    e, f = 0.0, 0.0
    for i in range(3):
        along = beam[1, i] - beam[0, i]
        e, f = e + along * along, f + along * (origin[i] - beam[0, i])
    if e == 0.0:
        return out
    for n in range(len(rays)):
        b, c = 0.0, 0.0
        for i in range(3):
            b += rays[n, i] * (beam[1, i] - beam[0, i])
            c += rays[n, i] * (origin[i] - beam[0, i])
        denominator = e - b * b
        s = (b * f - c * e) / denominator if denominator > 1e-12 * e else 0.0
        s = min(max(s, 0.0), distance[n] + radius)
        t = min(max((b * s + f) / e, 0.0), 1.0)
        s = min(max(b * t - c, 0.0), distance[n] + radius)
        gap2 = 0.0
        for i in range(3):
            gap = origin[i] - beam[0, i] + s * rays[n, i] - t * (beam[1, i] - beam[0, i])
            gap2 += gap * gap
        out[n] = math.exp(-2.0 * gap2 / (radius * radius))
    return out
