"""A closed triangle surface from a scalar field on a grid: surface nets with a vertex per sheet.

Each cell that the surface crosses gets one vertex for each sheet of surface inside it, at the mean
of the sheet's crossings with the cell's edges; every crossed grid edge gives one quadrilateral
(Gibson, 1998, "Constrained elastic surface nets", MICCAI, section 3; sheets kept apart as by
Nielson, 2004, "Dual marching cubes", IEEE Visualization, section 2). The faces are closer to
equilateral than those of marching cubes.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from scipy import sparse

Field = Callable[[np.ndarray], np.ndarray]


def surface_nets(
    values: np.ndarray, origin_mm: np.ndarray, spacing_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """The zero level of `values` (X, Y, Z), negative inside, on a grid that starts at `origin_mm`.

    Returns vertices (V, 3) in mm and faces (F, 3) int32, wound outwards. The surface must not
    touch the border of the grid.
    """
    inside = values < 0.0
    sheet, sheets = _sheet_table()
    code = _corner_code(inside)
    number = np.cumsum(sheets[code].ravel()) - sheets[code].ravel()
    number = number.reshape(code.shape)
    total = np.zeros((int(sheets[code].sum()), 3))
    count = np.zeros(len(total))
    quads = []
    for axis in range(3):
        index, crossing, leaving = _crossings(values, inside, axis)
        corners = np.empty((len(index), 4), dtype=np.int64)
        for i, offset in enumerate(_around(axis)):
            cell = tuple((index - offset).T)
            edge = _edge(axis, offset)
            corners[:, i] = number[cell] + sheet[code[cell], edge]
            np.add.at(total, corners[:, i], crossing)
            np.add.at(count, corners[:, i], 1.0)
        corners[~leaving] = corners[~leaving, ::-1]
        quads.append(corners)
    vertices = total / count[:, None] * spacing_mm + origin_mm
    return vertices, _split(vertices, np.concatenate(quads))


def _crossings(
    values: np.ndarray, inside: np.ndarray, axis: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Inner grid edges along `axis` that cross: lower corner (n, 3), point (n, 3), leaving (n,)."""
    low, high = [slice(1, -1)] * 3, [slice(1, -1)] * 3
    low[axis], high[axis] = slice(None, -1), slice(1, None)
    inner = np.argwhere(inside[tuple(low)] != inside[tuple(high)])
    a = values[tuple(low)][tuple(inner.T)]
    b = values[tuple(high)][tuple(inner.T)]
    index = inner + (np.arange(3) != axis)
    point = index.astype(float)
    point[:, axis] += a / (a - b)
    return index, point, a < 0.0


def _around(axis: int) -> np.ndarray:
    """Offsets (4, 3) from an edge's lower corner back to the four cells around the edge."""
    u, v = (axis + 1) % 3, (axis + 2) % 3
    offsets = np.zeros((4, 3), dtype=np.int64)
    offsets[:, u] = [0, 1, 1, 0]
    offsets[:, v] = [0, 0, 1, 1]
    return offsets


def _edge(axis: int, lower_corner: np.ndarray) -> int:
    """Number 0..11 of a cell's edge along `axis` whose lower corner is given (3,), 0 or 1 each."""
    return 4 * axis + int(lower_corner[(axis + 1) % 3] + 2 * lower_corner[(axis + 2) % 3])


def _corner_code(inside: np.ndarray) -> np.ndarray:
    """(X-1, Y-1, Z-1) uint8: bit i + 2 j + 4 k says whether corner (i, j, k) is inside."""
    code = np.zeros(np.array(inside.shape) - 1, dtype=np.uint8)
    for corner in range(8):
        part = tuple(slice(b, n - 1 + b) for b, n in zip(_bits(corner), inside.shape, strict=True))
        code |= inside[part].astype(np.uint8) << np.uint8(corner)
    return code


def _bits(corner: int) -> np.ndarray:
    return np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1])


@cache
def _sheet_table() -> tuple[np.ndarray, np.ndarray]:
    """For each corner code: the sheet of each edge (256, 12), and how many sheets (256,)."""
    sheet, sheets = np.full((256, 12), -1), np.zeros(256, dtype=np.int64)
    for code in range(256):
        group = {edge: edge for edge in range(12) if _is_crossed(code, edge)}
        for first, second in _links(code):
            old, new = group[first], group[second]
            group = {edge: new if root == old else root for edge, root in group.items()}
        roots = sorted(set(group.values()))
        sheets[code] = len(roots)
        for edge, root in group.items():
            sheet[code, edge] = roots.index(root)
    return sheet, sheets


def _edge_ends(edge: int) -> tuple[int, int]:
    """Corner numbers of an edge's lower and upper end."""
    axis, rest = divmod(edge, 4)
    low = ((rest & 1) << (axis + 1) % 3) + ((rest >> 1) << (axis + 2) % 3)
    return low, low + (1 << axis)


def _is_crossed(code: int, edge: int) -> bool:
    low, high = _edge_ends(edge)
    return (code >> low & 1) != (code >> high & 1)


def _links(code: int):
    """Pairs of crossed edges joined across a face; a face crossed four times keeps inside apart."""
    for axis in range(3):
        for side in range(2):
            on_face = [
                edge
                for edge in range(12)
                if all((corner >> axis & 1) == side for corner in _edge_ends(edge))
            ]
            crossed = [edge for edge in on_face if _is_crossed(code, edge)]
            if len(crossed) == 2:
                yield crossed[0], crossed[1]
            elif len(crossed) == 4:
                for corner in range(8):
                    if code >> corner & 1 and (corner >> axis & 1) == side:
                        first, second = [e for e in crossed if corner in _edge_ends(e)]
                        yield first, second


def _split(vertices: np.ndarray, quads: np.ndarray) -> np.ndarray:
    """Two triangles a quadrilateral, cut along the shorter diagonal."""
    corner = vertices[quads]
    first = np.linalg.norm(corner[:, 0] - corner[:, 2], axis=1)
    second = np.linalg.norm(corner[:, 1] - corner[:, 3], axis=1)
    quads = np.where((first <= second)[:, None], quads, np.roll(quads, -1, axis=1))
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)


def settle(
    vertices: np.ndarray, faces: np.ndarray, field: Field, rounds: int, step_mm: float
) -> np.ndarray:
    """Even out the faces along the surface and pull every vertex onto the field's zero level.

    Each round moves vertices (V, 3, mm) halfway to the mean of their neighbours within the tangent
    plane (Field, 1988, "Laplacian smoothing and Delaunay triangulations", section 2) and then takes
    one Newton step along the field's gradient, found by central differences of `step_mm`.
    """
    neighbours = neighbour_mean(len(vertices), faces)
    for _ in range(rounds):
        gradient = field_gradient(field, vertices, step_mm)
        normal = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
        pull = 0.5 * (neighbours @ vertices - vertices)
        vertices = vertices + pull - np.sum(pull * normal, axis=1, keepdims=True) * normal
        vertices = onto_surface(field, vertices, step_mm)
    return onto_surface(field, vertices, step_mm, steps=3)


def onto_surface(field: Field, points: np.ndarray, step_mm: float, steps: int = 1) -> np.ndarray:
    """Newton steps along the gradient to the zero level; each at most 2 mm (points (n, 3), mm)."""
    for _ in range(steps):
        gradient = field_gradient(field, points, step_mm)
        squared = np.sum(gradient**2, axis=1)
        move = -(field(points) / np.maximum(squared, 1e-9))[:, None] * gradient
        length = np.linalg.norm(move, axis=1, keepdims=True)
        points = points + move * np.minimum(1.0, 2.0 / np.maximum(length, 1e-12))
    return points


def field_gradient(field: Field, points: np.ndarray, step_mm: float) -> np.ndarray:
    """Gradient (n, 3) of the field at points (n, 3, mm) by central differences."""
    steps = step_mm * np.eye(3)
    return np.stack(
        [(field(points + s) - field(points - s)) / (2.0 * step_mm) for s in steps], axis=1
    )


def neighbour_mean(count: int, faces: np.ndarray) -> sparse.csr_matrix:
    """Sparse (V, V) matrix that takes vertex values to the mean over edge neighbours."""
    pairs = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    pairs = np.concatenate([pairs, pairs[:, ::-1]])
    ones = np.ones(len(pairs))
    matrix = sparse.coo_matrix((ones, (pairs[:, 0], pairs[:, 1])), shape=(count, count)).tocsr()
    matrix.data[:] = 1.0
    degree = np.maximum(np.asarray(matrix.sum(axis=1)).ravel(), 1.0)
    return sparse.diags(1.0 / degree) @ matrix
