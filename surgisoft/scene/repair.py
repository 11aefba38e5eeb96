"""Repair triangle soups into closed bodies with outward normals, and count the repairs.

The order matters: vertices are joined first, then faces are cleaned and wound consistently, holes
are closed, bodies are turned outwards, and bodies inside other bodies are removed.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from surgisoft.errors import InputError
from surgisoft.scene.inside import enclosed
from surgisoft.scene.mesh import Mesh, equal_rows, used_indices
from surgisoft.scene.rays import EmbreeSurface

JOIN = (1e-7, 1e-6, 1e-5, 1e-4, 5e-4)
"""Distances, relative to the size, at which vertices are joined; tried until the surface closes."""
SPECK = 0.01
"""A closed piece smaller than this fraction of the whole size is a speck and is removed."""
OPEN_SPECK = 0.1
"""An open piece smaller than this fraction of the whole size is a speck and is removed."""
HOLE = 0.3
"""A hole wider than this fraction of its body is an error and is not closed."""
INNER_BODIES = "inner bodies removed"
"""What was done to bodies that lie inside another one; their number follows."""
MOST_BODIES = 16
"""Largest number of separate bodies in one part; more mean a broken file."""


@dataclass(frozen=True)
class Repair:
    """One kind of repair."""

    done: str
    """What was done, as printed for the user."""
    count: int
    """How often."""


@dataclass(frozen=True, eq=False)
class Repaired:
    """Closed bodies, largest first, and the repairs that were needed."""

    bodies: tuple[Mesh, ...]
    """Closed meshes, wound outwards."""
    holes_mm: tuple[np.ndarray, ...]
    """For each body (F,) mm: width of the hole that a face closes, 0 for a face of the file."""
    repairs: tuple[Repair, ...]
    """Kinds of repairs with their counts; empty if none was needed."""


@dataclass(frozen=True, eq=False)
class _Shell:
    """One closed surface, and which of its faces close a hole of the file."""

    mesh: Mesh
    """Wound outwards, mm."""
    hole_mm: np.ndarray
    """(F,) mm: width of the hole that a face closes, 0 for a face of the file."""

    @cached_property
    def surface(self) -> EmbreeSurface:
        """The mesh for rays."""
        return EmbreeSurface(self.mesh)


def repair(
    vertices: np.ndarray,
    faces: np.ndarray,
    what: str,
    on_step: Callable[[str], None] = lambda _: None,
) -> Repaired:
    """Closed bodies from vertices (V, 3) mm and faces (F, 3); `what` names them in errors.

    `on_step` is called with the name of each step, because a million faces take seconds.
    """
    used, _ = used_indices(faces)
    size = float(np.ptp(vertices[used], axis=0).max())
    if size == 0.0:
        raise InputError(f"{what}: all vertices are one point; expected a surface")
    log: dict[str, int] = {}
    on_step("joining corners")
    vertices, faces = _join(vertices, faces, size, log)
    vertices, faces = _unbranch(vertices, faces)
    vertices, faces = _drop_specks(vertices, faces, size, log)
    if len(faces) < 4:
        raise InputError(f"{what}: {len(faces)} faces enclose nothing; expected a closed body")
    on_step("winding faces alike")
    faces = _wind_alike(faces, what, log)
    on_step("closing holes")
    vertices, faces, hole_mm = _close_holes(vertices, faces, what, log)
    shells = _outward(vertices, faces, hole_mm, log)
    if not all(shell.mesh.is_watertight for shell in shells):
        raise InputError(
            f"{what}: the surface crosses itself along edges that three or more faces share, "
            "beyond repair; expected a closed body (remesh it in a mesh editor)"
        )
    solid = [shell for shell in shells if not _is_flat(shell.mesh, size)]
    if not solid:
        raise InputError(f"{what}: the surface is flat and encloses no volume; expected a body")
    bodies = _merge_touching(_drop_inner(solid, log))
    if len(bodies) > MOST_BODIES:
        raise InputError(
            f"{what}: {len(bodies)} separate bodies; expected at most {MOST_BODIES} "
            "(keep the organ and what must not be touched)"
        )
    bodies.sort(key=lambda body: -float(body.mesh.face_areas_mm2.sum()))
    return Repaired(
        tuple(body.mesh for body in bodies),
        tuple(body.hole_mm for body in bodies),
        tuple(Repair(done, n) for done, n in log.items() if n),
    )


def _is_flat(mesh: Mesh, size: float) -> bool:
    """Whether the mesh of a surface `size` mm across encloses next to no volume."""
    return mesh.volume_mm3 <= 1e-6 * size * float(mesh.face_areas_mm2.sum())


def _join(vertices, faces, size, log):
    """Join vertices no more than needed to close the surface: none, equal ones, near ones."""
    used, faces = used_indices(faces)
    vertices = vertices[used]
    first, same, _ = equal_rows(vertices)
    unique, best = vertices[first], None
    for fraction in (None, *JOIN):
        if fraction is None:
            base, label = vertices, np.arange(len(vertices))
        else:
            base, label = unique, _clusters(unique, fraction * size)[same]
        cleaned, counts = _clean_faces(label[faces])
        open_edges = _open_edges(cleaned)
        if best is None or open_edges < best[0]:
            best = (open_edges, base, cleaned, counts, len(vertices) - len(used_indices(label)[0]))
        if open_edges == 0:
            break
    assert best is not None, "the loop runs at least once"
    _, base, cleaned, counts, joined = best
    log["duplicate vertices joined"] = joined
    log["degenerate faces removed"], log["duplicate faces removed"] = counts
    return base, cleaned


def _clusters(points, tolerance):
    """For each point the index of the first point of its cluster; (N,)."""
    pairs = cKDTree(points).query_pairs(tolerance, output_type="ndarray")
    if not len(pairs):
        return np.arange(len(points))
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(points),) * 2)
    _, label = connected_components(graph, directed=False)
    first = np.full(label.max() + 1, len(points))
    np.minimum.at(first, label, np.arange(len(points)))
    return first[label]


def _clean_faces(faces):
    """Faces without repeated corners and without doubles; counts of both.

    A face and its own reverse are a flap without thickness: both go, unless that leaves the
    surface more open than keeping one of the two.
    """
    proper = (
        (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    )
    kept = faces[proper]
    if not len(kept):
        return kept, (len(faces), 0)
    first, which, count = equal_rows(np.sort(kept, axis=1))
    turn = np.bincount(which, weights=_parity(kept), minlength=len(first))
    flap = (count == 2) & (turn == 0)
    without, with_one = kept[np.sort(first[~flap])], kept[np.sort(first)]
    chosen = without if _open_edges(without) <= _open_edges(with_one) else with_one
    return chosen, (len(faces) - len(kept), len(kept) - len(chosen))


def _parity(faces):
    """+1 or -1: whether the corners run as an even or odd permutation of their sorted order."""
    a, b, c = faces.T
    return np.sign((b - a) * (c - b) * (c - a)).astype(float)


def _edges(faces):
    """Sorted edges (3 F, 2) 01, 12, 20 of each face in turn, and the face of each (3 F,)."""
    edges = np.sort(np.stack((faces, np.roll(faces, -1, axis=1)), axis=-1).reshape(-1, 2), axis=1)
    return edges, np.repeat(np.arange(len(faces)), 3)


def _open_edges(faces) -> int:
    """Number of edges that do not lie between exactly two faces."""
    edges, _ = _edges(faces)
    key = np.sort(edges @ [faces.max(initial=0) + 1, 1])
    start = np.flatnonzero(np.r_[True, key[1:] != key[:-1]]) if len(key) else key
    return int(np.sum(np.diff(np.r_[start, len(key)]) != 2))


def _pairs(faces, vertices=None):
    """Half-edges (P, 2) that meet, numbered 3 * face + corner; (P,) whether they have one sense.

    Edges with two faces; with `vertices`, also those with more, resolved by `_around_edge`.
    """
    edges, _ = _edges(faces)
    forward = (faces == edges.reshape(-1, 3, 2)[:, :, 0]).reshape(-1)
    order = np.lexsort(edges.T)
    ranked = edges[order]
    start = np.flatnonzero(np.r_[True, np.any(ranked[1:] != ranked[:-1], axis=1)])
    count = np.diff(np.r_[start, len(ranked)])
    two = start[count == 2]
    pairs = [np.stack((order[two], order[two + 1]), axis=1)]
    if vertices is not None:
        for i in np.flatnonzero(count > 2):
            half_edges = order[start[i] : start[i] + count[i]]
            pairs.append(_around_edge(vertices, faces, half_edges, forward))
    paired = np.concatenate(pairs)
    return paired, forward[paired[:, 0]] == forward[paired[:, 1]]


def _around_edge(vertices, faces, half_edges, forward):
    """Pairs (P, 2) of an edge's half-edges with solid between them, by the faces' winding.

    Seen along the edge, a face that runs it forwards has its solid at smaller angles, one that
    runs it backwards at greater ones; in order of angle the two must alternate (Gueziec et al.,
    2001, "Cutting and stitching", IEEE TVCG 7, section 4.2). Otherwise nothing is paired.
    """
    face, corner = np.divmod(half_edges, 3)
    ends = vertices[np.sort([faces[face[0], corner[0]], faces[face[0], (corner[0] + 1) % 3]])]
    axis = (ends[1] - ends[0]) / max(np.linalg.norm(ends[1] - ends[0]), 1e-300)
    apex = vertices[faces[face, (corner + 2) % 3]] - ends[0]
    x = apex[0] - (apex[0] @ axis) * axis
    angle = np.arctan2(apex @ np.cross(axis, x), apex @ x)
    angle = np.mod(angle.round(9), round(2.0 * np.pi, 9))
    # of two faces in one place, the one that ends a solid comes before the one that starts one
    ring = half_edges[np.lexsort((~forward[half_edges], angle))]
    if forward[ring[0]]:
        ring = np.roll(ring, -1)
    starts, stops = ring[0::2], ring[1::2]
    if len(ring) % 2 or forward[starts].any() or not forward[stops].all():
        return np.empty((0, 2), dtype=np.int64)
    return np.stack((starts, stops), axis=1)


def _components(faces):
    """Component number (F,) of faces joined across edges with two faces."""
    pairs, _ = _pairs(faces)
    return _linked(pairs // 3, len(faces))


def _linked(pairs, count):
    """Component number (count,) of things joined by pairs (P, 2)."""
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def _unbranch(vertices, faces):
    """Give each surface its own vertices where surfaces share an edge or only a vertex."""
    pairs, alike = _pairs(faces, vertices)
    face, corner = np.divmod(pairs, 3)
    after = 3 * face + (corner + 1) % 3
    crossed = np.where(alike[:, None], pairs, np.stack((pairs[:, 0], after[:, 1]), axis=1))
    also = np.where(alike[:, None], after, np.stack((after[:, 0], pairs[:, 1]), axis=1))
    label = _linked(np.concatenate((crossed, also)), 3 * len(faces))
    first = np.unique(label, return_index=True)[1]
    vertex_of = faces.reshape(-1)[first]
    order = np.argsort(vertex_of, kind="stable")
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    return vertices[vertex_of[order]], rank[label].reshape(-1, 3)


def _drop_specks(vertices, faces, size, log):
    """Remove loose pieces that are too small for a body; see `SPECK` and `OPEN_SPECK`."""
    if not len(faces):
        return vertices, faces
    label = _components(faces)
    low, high = (np.full((label.max() + 1, 3), end) for end in (np.inf, -np.inf))
    for corner in faces.T:
        np.minimum.at(low, label, vertices[corner])
        np.maximum.at(high, label, vertices[corner])
    is_open = np.bincount(label, minlength=len(low)) * 3 > 2 * np.bincount(
        label[_pairs(faces)[0][:, 0] // 3], minlength=len(low)
    )
    keep = (high - low).max(axis=1) >= np.where(is_open, OPEN_SPECK, SPECK) * size
    log["small loose pieces removed"] = int(np.sum(~keep))
    used, dense = used_indices(faces[keep[label]])
    return vertices[used], dense


def _wind_alike(faces, what, log):
    """Reverse faces so that neighbours traverse their common edge in opposite directions.

    Each face appears twice in a graph, as it is and reversed; neighbours that fit are joined. The
    two copies of a surface are separate components unless it has only one side.
    """
    count = len(faces)
    pairs, alike = _pairs(faces)
    a, b = (pairs // 3).T
    other = np.where(alike, b + count, b)
    mirror = np.where(alike, b, b + count)
    label = _linked(np.concatenate(([a, other], [a + count, mirror]), axis=1).T, 2 * count)
    if np.any(label[:count] == label[count:]):
        raise InputError(f"{what}: the surface has only one side (Moebius); expected a closed body")
    # of the two ways to wind each piece, the one that turns fewer faces; if both turn as many, the
    # one with the smaller label, so that all faces of the piece agree
    kept_as_is = np.bincount(label[:count], minlength=label.max() + 1)
    as_is, reversed_ = label[:count], label[count:]
    fewer = kept_as_is[as_is] < kept_as_is[reversed_]
    equal = kept_as_is[as_is] == kept_as_is[reversed_]
    turned = fewer | (equal & (as_is > reversed_))
    log["faces reoriented"] = int(turned.sum())
    return np.where(turned[:, None], faces[:, ::-1], faces)


def _boundary_loops(faces):
    """Closed loops of boundary edges as vertex lists, opposite to the faces' winding."""
    directed = np.stack((faces, np.roll(faces, -1, axis=1)), axis=-1).reshape(-1, 2)
    key = np.sort(directed, axis=1) @ [faces.max() + 1, 1]
    _, first, count = np.unique(key, return_index=True, return_counts=True)
    step: dict[int, list[int]] = {}
    for a, b in directed[first[count == 1]]:
        step.setdefault(int(b), []).append(int(a))
    loops = []
    while step:
        start = here = next(iter(step))
        path, place = [start], {start: 0}
        while here in step:
            following = step[here].pop()
            if not step[here]:
                del step[here]
            here = following
            if here in place:
                loops.append(path[place[here] :])
                for vertex in path[place[here] + 1 :]:
                    del place[vertex]
                path = path[: place[here] + 1]
                if here not in step:
                    break
            else:
                place[here] = len(path)
                path.append(here)
    return loops


def _close_holes(vertices, faces, what, log):
    """Close every hole by a fan of faces around its middle; a hole wider than `HOLE` is an error.

    Returns vertices, faces, and (F,) mm: the width of the hole that each face closes, else 0.
    """
    loops = _boundary_loops(faces)
    new_vertices, new_faces, hole_mm = [vertices], [faces], [np.zeros(len(faces))]
    label = _components(faces)
    part_of = np.zeros(len(vertices), dtype=np.int64)
    part_of[faces.reshape(-1)] = np.repeat(label, 3)
    following = len(vertices)
    sizes: dict[int, float] = {}
    for loop in loops:
        rim, part = vertices[loop], int(part_of[loop[0]])
        if part not in sizes:
            body = vertices[used_indices(faces[label == part])[0]]
            sizes[part] = np.ptp(body, axis=0).max()
        width, size = np.ptp(rim, axis=0).max(), sizes[part]
        if width > HOLE * size:
            raise InputError(
                f"{what}: a hole {width:.3g} mm wide in a surface of {size:.3g} mm is too large "
                f"to close (up to {100 * HOLE:.0f} %); expected a closed body"
            )
        if len(loop) == 3:
            new_faces.append(np.array([loop]))
            hole_mm.append(np.array([width]))
            continue
        new_vertices.append(rim.mean(axis=0)[None])
        ring = np.array(loop)
        new_faces.append(np.stack((ring, np.roll(ring, -1), np.full_like(ring, following)), axis=1))
        hole_mm.append(np.full(len(ring), width))
        following += 1
    log["holes closed"] = len(loops)
    return np.concatenate(new_vertices), np.concatenate(new_faces), np.concatenate(hole_mm)


def _outward(vertices, faces, hole_mm, log) -> list[_Shell]:
    """Every connected surface as a shell of its own, turned so that its volume is positive."""
    label = _components(faces)
    shells, turned = [], 0
    for part in range(label.max() + 1):
        own = label == part
        used, dense = used_indices(faces[own])
        mesh = Mesh(vertices[used], dense)
        if mesh.volume_mm3 < 0.0:
            mesh = Mesh(mesh.vertices_mm, mesh.faces[:, ::-1])
            turned += 1
        shells.append(_Shell(mesh, hole_mm[own]))
    log["inside-out bodies flipped"] = turned
    return shells


def _encloses(outer: _Shell, inner: _Shell) -> np.ndarray:
    """Whether each of up to 64 spread vertices of `inner` lies within `outer`: bools."""
    vertices = inner.mesh.vertices_mm
    points = vertices[:: max(1, len(vertices) // 64)]
    return enclosed(outer.mesh, points, lambda: outer.surface)


def _boxes_meet(a: Mesh, b: Mesh) -> bool:
    return bool(
        np.all(a.bounds_mm[0] <= b.bounds_mm[1]) and np.all(b.bounds_mm[0] <= a.bounds_mm[1])
    )


def _drop_inner(shells: list[_Shell], log) -> list[_Shell]:
    """The shells that do not lie wholly inside a larger one, largest volume first."""
    shells = sorted(shells, key=lambda shell: -shell.mesh.volume_mm3)
    kept: list[_Shell] = []
    for shell in shells:
        if not any(_lies_inside(shell, outer) for outer in kept):
            kept.append(shell)
    log[INNER_BODIES] = len(shells) - len(kept)
    return kept


def _lies_inside(inner: _Shell, outer: _Shell) -> bool:
    """Whether all of `inner` lies within `outer`."""
    return _boxes_meet(outer.mesh, inner.mesh) and bool(_encloses(outer, inner).all())


def _overlap(a: _Shell, b: _Shell) -> bool:
    """Whether part of one mesh lies within the other."""
    return _boxes_meet(a.mesh, b.mesh) and bool(_encloses(a, b).any() or _encloses(b, a).any())


def _merge_touching(shells: list[_Shell]) -> list[_Shell]:
    """Shells that overlap become one body of several shells."""
    pairs = [(i, j) for i in range(len(shells)) for j in range(i) if _overlap(shells[i], shells[j])]
    rows, columns = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    graph = coo_matrix((np.ones(len(pairs)), (rows, columns)), shape=(len(shells),) * 2)
    _, label = connected_components(graph, directed=False)
    return [
        _together([shells[i] for i in np.flatnonzero(label == part)])
        for part in range(label.max() + 1)
    ]


def _together(shells: list[_Shell]) -> _Shell:
    meshes = [shell.mesh for shell in shells]
    starts = np.cumsum([0, *(len(mesh.vertices_mm) for mesh in meshes[:-1])])
    mesh = Mesh(
        np.concatenate([mesh.vertices_mm for mesh in meshes]),
        np.concatenate([mesh.faces + i for mesh, i in zip(meshes, starts, strict=True)]),
    )
    return _Shell(mesh, np.concatenate([shell.hole_mm for shell in shells]))
