"""Shapes with known answers, shared by the geometry tests."""

import numpy as np
import trimesh

from surgisoft.scene.mesh import Mesh


def mesh_of(shape) -> Mesh:
    return Mesh(shape.vertices, shape.faces)


def box(size=(40.0, 30.0, 20.0)) -> Mesh:
    """Axis-aligned box about the origin, 12 faces."""
    return mesh_of(trimesh.creation.box(size))


def ball(radius=50.0, subdivisions=4) -> Mesh:
    return mesh_of(trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius))


def lumpy(subdivisions=4, seed=0) -> Mesh:
    """A closed organ-like blob with bulges, a notch and a crease, about 120 mm across."""
    shape = trimesh.creation.icosphere(subdivisions=subdivisions)
    u = shape.vertices
    rng = np.random.default_rng(seed)
    radius = 50.0 + sum(
        rng.uniform(1, 4) * np.sin(u @ rng.normal(size=3) * rng.uniform(1, 4) + rng.uniform(0, 6))
        for _ in range(6)
    )
    radius -= 14.0 * np.exp(-8.0 * abs(u[:, 0] - 0.2)) * (u[:, 2] > -0.3)
    return Mesh(u * radius[:, None] * [1.2, 1.0, 0.8], shape.faces)


def arc_points(length_mm, bend_rad, count, pose=None) -> np.ndarray:
    """Centreline (count, 3) of constant curvature in the xz plane from the origin along z."""
    s = np.linspace(0.0, 1.0, count)
    if abs(bend_rad) < 1e-9:
        points = np.stack((0 * s, 0 * s, length_mm * s), axis=1)
    else:
        radius = length_mm / bend_rad
        points = np.stack(
            (radius * (1 - np.cos(bend_rad * s)), 0 * s, radius * np.sin(bend_rad * s)), axis=1
        )
    return points if pose is None else points @ pose[:3, :3].T + pose[:3, 3]
