"""Build the phantom's meshes from an implicit liver: `python scenes/phantom_liver/build.py [DIR]`.

Everything is made of formulas in this file. The liver is drawn in its anatomical frame (mm; x from
the right lobe to the left, y upwards to the diaphragm, z to the front) and then laid on a tray on
its under side (world frame, mm, z up). Needs scikit-image, which the extra `dev` brings.
"""

import sys
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial import Delaunay

from surgisoft.scene.mesh import Mesh
from surgisoft.scene.meshio import write_ply

VISCERAL = np.array([0.16, -0.66, -0.74]) / np.linalg.norm([0.16, -0.66, -0.74])
VISCERAL_POINT = np.array([0.0, -8.0, -6.0])


def ellipsoid(points, centre, radii, turn_z_deg=0.0, turn_y_deg=0.0):
    """Signed distance to first order (mm), negative inside (Quilez, 2008, "ellipsoid SDF")."""
    local = turned(points - np.asarray(centre), turn_z_deg, turn_y_deg)
    k0 = np.linalg.norm(local / radii, axis=-1)
    k1 = np.linalg.norm(local / np.square(radii), axis=-1)
    return k0 * (k0 - 1.0) / np.maximum(k1, 1e-12)


def capsule(points, start, end, radius_start, radius_end):
    """Distance (mm) to a segment, less a radius that runs linearly from one end to the other."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    along = end - start
    t = np.clip((points - start) @ along / (along @ along), 0.0, 1.0)
    nearest = start + t[..., None] * along
    radius = radius_start + t * (radius_end - radius_start)
    return np.linalg.norm(points - nearest, axis=-1) - radius


def turned(points, turn_z_deg, turn_y_deg):
    """Points in the frame turned about y, then z (degrees)."""
    a, b = np.radians([turn_z_deg, turn_y_deg])
    about_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    about_y = np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    return points @ (about_z @ about_y)


def union(a, b, blend_mm):
    """Smooth minimum, polynomial (Quilez, 2013, "smooth minimum", quadratic)."""
    h = np.maximum(blend_mm - np.abs(a - b), 0.0) / blend_mm
    return np.minimum(a, b) - 0.25 * blend_mm * h * h


def without(a, b, blend_mm):
    """`a` less `b`, with the edge rounded over `blend_mm`."""
    return -union(-a, b, blend_mm)


def liver(points):
    """The liver in its anatomical frame: lobes joined, under side cut, impressions taken away."""
    dome = ellipsoid(points, (-36, 6, 0), (50, 60, 54))
    lower_right = ellipsoid(points, (-45, -34, -4), (36, 50, 40))
    middle = ellipsoid(points, (-2, -2, 6), (44, 52, 42))
    left = ellipsoid(points, (36, 16, 10), (44, 40, 30), turn_z_deg=-10)
    tip = ellipsoid(points, (62, 25, 8), (32, 22, 18), turn_z_deg=-18)
    right = union(union(dome, lower_right, 36.0), middle, 16.0)
    body = union(right, union(left, tip, 24.0), 9.0)
    body = without(body, heart(points), 14.0)
    body = without(body, under_side(points), 6.0)
    caudate = ellipsoid(resting(points), (-1, 30, 1), (10, 21, 10), turn_z_deg=8)
    body = union(body, caudate, 8.0)
    for impression, blend_mm in impressions(resting(points)):
        body = without(body, impression, blend_mm)
    return without(body, gallbladder(points) - 0.4, 3.0)


def impressions(points):
    """What presses into the under side (points in the resting frame): distance, edge rounding."""
    yield capsule(points, (-16, -4, -3), (16, 0, -3), 6.5, 6.5), 5.0  # porta hepatis
    yield capsule(points, (25, -72, 4), (16, 0, -3), 7, 6), 6.0  # fissure of the round ligament
    yield capsule(points, (16, 0, -3), (12, 54, -5), 6, 6), 5.0  # fissure of the venous ligament
    yield capsule(points, (-12, 24, -9), (-16, 80, -5), 14, 14), 6.0  # inferior vena cava
    yield ellipsoid(points, (-56, 14, -18), (24, 34, 27)), 10.0  # right kidney
    yield ellipsoid(points, (-54, -36, -24), (22, 20, 27)), 9.0  # colon
    yield ellipsoid(points, (56, 22, -18), (36, 36, 26)), 12.0  # stomach


def under_side(points):
    """What the visceral surface cuts off: a large ball behind and below."""
    return ellipsoid(resting(points), (0, 0, -330), (330, 330, 330))


def resting(points):
    """Points from the anatomical frame into the one in which the visceral surface faces -z."""
    left = np.array([1.0, 0.0, 0.0]) - VISCERAL[0] * VISCERAL
    left /= np.linalg.norm(left)
    frame = np.stack([left, np.cross(left, VISCERAL), -VISCERAL], axis=1)
    return (points - VISCERAL_POINT) @ frame


def heart(points):
    """The shallow bed of the heart on the left lobe's upper face."""
    return ellipsoid(points, (34, 92, 34), (46, 40, 40))


def gallbladder(points):
    """A pear: wide fundus under the lower margin, thin neck towards the porta hepatis."""
    points = resting(points)
    return union(
        capsule(points, (-24, -65, 0), (-19, -38, 1), 11.5, 9.5),
        capsule(points, (-19, -38, 1), (-12, -12, 0), 8.5, 4),
        8.0,
    )


def tray():
    """A flat plate with its top at z = 0 (mesh, mm)."""
    corners = np.array([[x, y, z] for x in (-115, 123) for y in (-99, 99) for z in (-8, 0)])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return Mesh(corners, [face for a, b, c, d in sides for face in ((a, b, c), (a, c, d))])


WALL_MM = (145.0, 149.0)
"""Lower and upper face of the wall above the liver (mm)."""
PORT_MM = 24.0
"""Diameter of a port across its axis (mm)."""
PORTS = (
    ((-77.9, -73.43, 158.95), (0.498355, 0.230894, -0.835662)),
    ((30.64, -51.73, 171.39), (-0.375775, -0.353057, -0.856822)),
)
"""A point (mm) on each port's axis and the axis: the mounts of the two arms in `scene.toml`."""


def wall(around=180, spacing_mm=10.0):
    """A plate with two slanting ports (mesh, mm), `around` points on each rim.

    Both faces have the same triangles, Delaunay's of the middle plane; their rims are shifted along
    the axes of the ports.
    """
    turn = 2.0 * np.pi * np.arange(around) / around
    x, y = np.arange(-130.0, 91.0, spacing_mm), np.arange(-130.0, 31.0, spacing_mm)
    grid = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    rims, kept = [], np.ones(len(grid), dtype=bool)
    for start, axis in PORTS:
        axis = np.array(axis) / np.linalg.norm(axis)
        slant = axis[:2] / np.linalg.norm(axis[:2])
        across = np.array([-slant[1], slant[0]])
        long = 0.5 * PORT_MM / abs(axis[2])
        ring = long * np.cos(turn)[:, None] * slant + 0.5 * PORT_MM * np.sin(turn)[:, None] * across
        heights = (*WALL_MM, np.mean(WALL_MM))
        middles = [np.array(start[:2]) + (z - start[2]) / axis[2] * axis[:2] for z in heights]
        rims.append([middle + ring for middle in middles])
        kept &= np.linalg.norm(grid - middles[2], axis=1) > long + 0.5 * spacing_mm
    flat = np.concatenate((*(rim[2] for rim in rims), grid[kept]))
    triangles = Delaunay(flat).simplices
    hole = np.any([(triangles // around == k).all(axis=1) for k in range(len(rims))], axis=0)
    triangles = triangles[~hole]
    a, b, c = (flat[triangles[:, k]] for k in range(3))
    turned = np.cross(b - a, c - a) < 0.0
    triangles[turned] = triangles[turned][:, ::-1]
    faces = []
    for k, z in enumerate(WALL_MM):
        places = np.concatenate((*(rim[k] for rim in rims), grid[kept]))
        faces.append(np.column_stack((places, np.full(len(places), z))))
    edges = np.concatenate([triangles[:, [i, (i + 1) % 3]] for i in range(3)])
    inner = {(int(j), int(i)) for i, j in edges}
    rim_edges = np.array([edge for edge in map(tuple, edges.tolist()) if edge not in inner])
    i, j = rim_edges.T
    above = len(flat)
    sides = np.concatenate(
        (np.stack((i, j, j + above), axis=1), np.stack((i, j + above, i + above), axis=1))
    )
    return Mesh(
        np.concatenate(faces), np.concatenate((triangles[:, ::-1], triangles + above, sides))
    )


def mesh_of(field, spacing_mm, bounds_mm, rounds=40):
    """Vertices (V, 3) mm and faces (F, 3) of the field's zero level, evened out."""
    from skimage.measure import marching_cubes

    low, high = np.asarray(bounds_mm, dtype=float)
    axes = [np.arange(a, b + spacing_mm, spacing_mm) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = np.concatenate([field(slab[None]) for slab in grid])
    vertices, faces, _, _ = marching_cubes(
        values, 0.0, spacing=(spacing_mm,) * 3, gradient_direction="descent"
    )
    return settle(vertices + low, faces, field, rounds, 0.05 * spacing_mm), faces


def settle(vertices, faces, field, rounds, step_mm):
    """Even out the faces along the surface and pull every vertex onto the field's zero level.

    Each round moves the vertices halfway to the mean of their neighbours within the tangent plane
    (Field, 1988, "Laplacian smoothing and Delaunay triangulations", section 2) and then takes one
    Newton step along the field's gradient, found by central differences of `step_mm`.
    """
    solid = trimesh.Trimesh(vertices, faces, process=False)
    neighbours = trimesh.smoothing.laplacian_calculation(solid, equal_weight=True)
    for _ in range(rounds):
        slope = gradient(field, vertices, step_mm)
        normal = slope / np.linalg.norm(slope, axis=1, keepdims=True)
        pull = 0.5 * (neighbours @ vertices - vertices)
        vertices = vertices + pull - np.sum(pull * normal, axis=1, keepdims=True) * normal
        vertices = onto_surface(vertices, field, step_mm)
    return onto_surface(vertices, field, step_mm, steps=3)


def onto_surface(points, field, step_mm, steps=1):
    """Newton steps along the gradient to the zero level, each at most 2 mm."""
    for _ in range(steps):
        slope = gradient(field, points, step_mm)
        move = -(field(points) / np.maximum(np.sum(slope**2, axis=1), 1e-9))[:, None] * slope
        length = np.linalg.norm(move, axis=1, keepdims=True)
        points = points + move * np.minimum(1.0, 2.0 / np.maximum(length, 1e-12))
    return points


def gradient(field, points, step_mm):
    """Gradient (n, 3) of the field at points (n, 3) mm by central differences."""
    steps = step_mm * np.eye(3)
    return np.stack(
        [(field(points + s) - field(points - s)) / (2.0 * step_mm) for s in steps], axis=1
    )


def bodies(fineness=1.0):
    """The phantom's meshes by name, standing on the tray (world frame, mm); finer below 1."""
    raw = {
        "liver": mesh_of(liver, 2.6 * fineness, [[-105, -85, -65], [110, 80, 70]]),
        "gallbladder": mesh_of(gallbladder, 2.2 * fineness, [[-60, -100, -30], [20, 10, 60]]),
    }
    standing = {name: (resting(vertices), faces) for name, (vertices, faces) in raw.items()}
    lowest = min(vertices[:, 2].min() for vertices, _ in standing.values())
    lift = np.array([0.0, 0.0, -lowest])
    meshes = {name: Mesh(vertices + lift, faces) for name, (vertices, faces) in standing.items()}
    return meshes | {"tray": tray(), "wall": wall()}


def main(folder):
    """Write every mesh into the folder."""
    for name, mesh in bodies().items():
        write_ply(mesh, folder / f"{name}.ply")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent)
