"""Geometry to draw that has no mesh file: tubes along a centreline, cones, surface patches."""

import numpy as np

from surgisoft.scene import frames
from surgisoft.scene.mesh import Mesh


def carried_frames(line_mm: np.ndarray) -> np.ndarray:
    """(K, 3, 3) rotations along a centreline (K, 3), third column its tangent, without twist.

    Double reflection (Wang et al., 2008, "Computation of rotation minimizing frames", section 4).
    """
    steps = np.diff(line_mm, axis=0)
    tangents = frames.normalise(np.vstack((steps[:1], steps[1:] + steps[:-1], steps[-1:])))
    sides = [frames.rotation_from_z(tangents[0])[:, 0]]
    for i, step in enumerate(steps):
        mirror = step / max(step @ step, 1e-300)
        side = sides[-1] - 2.0 * (mirror @ sides[-1]) * step
        ahead = tangents[i] - 2.0 * (mirror @ tangents[i]) * step
        turn = tangents[i + 1] - ahead
        sides.append(side - 2.0 * (turn @ side) / max(turn @ turn, 1e-300) * turn)
    x = frames.normalise(np.array(sides))
    return np.stack((x, np.cross(tangents, x), tangents), axis=-1)


def finer(line_mm: np.ndarray, step_mm: float) -> np.ndarray:
    """The polyline (K, 3) mm with points at most `step_mm` apart, corners rounded by a spline."""
    from scipy.interpolate import CubicSpline

    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(line_mm, axis=0), axis=1))]
    count = max(2, int(np.ceil(along[-1] / step_mm)) + 1)
    return CubicSpline(along, line_mm)(np.linspace(0.0, along[-1], count))


BORE_RINGS = 3
"""Number of vertex rings, the last ones of a tube, that form the wall and floor of its bore."""


def tube(
    line_mm: np.ndarray, radius_mm: float, bore_mm: float = 0.0, sides: int = 40
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A tube along (K, 3) with bevelled flat ends; `bore_mm` is the radius of a hole in the tip.

    Returns vertices (V, 3) mm, faces (F, 3) and vertex normals (V, 3).
    """
    turn = carried_frames(line_mm)
    around = 2.0 * np.pi * np.arange(sides) / sides
    circle = np.stack((np.cos(around), np.sin(around), 0 * around), axis=1)
    bevel = 0.12 * radius_mm
    # a profile of rings: (index along the line, shift along it, radius, normal's share along it)
    last = len(line_mm) - 1
    rings = [(0, 0.0, 0.0, -1.0), (0, 0.0, radius_mm - bevel, -1.0), (0, 0.0, radius_mm, 0.0)]
    rings += [(i, 0.0, radius_mm, 0.0) for i in range(1, last)]
    rings += [(last, -bevel, radius_mm, 0.0), (last, 0.0, radius_mm - bevel, 0.7)]
    rings += [(last, 0.0, radius_mm - bevel, 1.0), (last, 0.0, max(bore_mm, 1e-3), 1.0)]
    if bore_mm > 0.0:
        rings += [(last, 0.0, bore_mm, -0.4), (last, -bore_mm, 0.6 * bore_mm, 0.4)]
        rings += [(last, -bore_mm, 1e-3, 1.0)]
    vertices, normals = [], []
    for i, shift, radius, lean in rings:
        out = circle @ turn[i].T
        vertices.append(line_mm[i] + shift * turn[i][:, 2] + radius * out)
        normals.append(np.sqrt(1.0 - lean**2) * out + lean * turn[i][:, 2])
    return np.concatenate(vertices), _strips(len(rings), sides), np.concatenate(normals)


def _strips(rows: int, sides: int) -> np.ndarray:
    """Faces (F, 3) between `rows` closed rings of `sides` vertices each."""
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(sides), indexing="ij")
    a, b = i * sides + j, i * sides + (j + 1) % sides
    quads = np.stack((a, b, b + sides, a, b + sides, a + sides), axis=-1)
    return quads.reshape(-1, 3)


def polar_patch(circles: list[np.ndarray], centre: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a disc from its centre (3,) and circles (M, 3), innermost first."""
    count = len(circles[0])
    vertices = np.concatenate((centre[None], *circles))
    j = np.arange(count)
    fan = np.stack((0 * j, 1 + j, 1 + (j + 1) % count), axis=1)
    return vertices, np.concatenate((fan, 1 + _strips(len(circles), count)[:, ::-1]))


def view_cone(eye: np.ndarray, axis: np.ndarray, half_rad: float, length_mm: float) -> list:
    """Lines of a camera's cone: eight edges and the circle at `length_mm`; each (n, 3) mm."""
    frame = frames.rotation_from_z(frames.normalise(axis))
    around = np.linspace(0.0, 2.0 * np.pi, 65)
    radius = length_mm * np.tan(half_rad)
    rim = np.stack(
        (radius * np.cos(around), radius * np.sin(around), np.full(65, length_mm)), axis=1
    )
    rim = eye + rim @ frame.T
    return [rim, *(np.stack((eye, point)) for point in rim[:-1:8])]


def creased(mesh: Mesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, faces and normals to draw; coarse meshes with sharp edges get flat shading."""
    cosine = np.einsum("fk,fck->fc", mesh.face_normals, mesh.vertex_normals[mesh.faces])
    if np.mean(cosine < 0.8) < 0.3:
        return mesh.vertices_mm, mesh.faces, mesh.vertex_normals
    vertices = mesh.triangles_mm.reshape(-1, 3)
    return vertices, np.arange(len(vertices)).reshape(-1, 3), np.repeat(mesh.face_normals, 3, 0)


def widest_apart(points_mm: np.ndarray) -> np.ndarray:
    """(3,) mm: the longest of the differences between points (N, 3) mm."""
    apart = points_mm[:, None] - points_mm
    return apart.reshape(-1, 3)[np.linalg.norm(apart, axis=2).argmax()]
