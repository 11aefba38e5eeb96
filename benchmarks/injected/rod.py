"""A Kirchhoff rod of few parameters that follows the measured key points of a real arm coarsely.

The centreline r and the frame R of the cross-section obey (Antman 2005, ch. 8)

    r' = (1 + e) R e_z,      R' = R [k],      k = (k_x, k_y, torsion),

and the arm is divided into sections between neighbouring key points, the base being the first. In
section s the free strain is linear in the loads x of the chambers,

    k_free = K_s x + k_rest,      e_free = E_s x,      no torsion,

which holds the weight of the arm itself as well, since it is fitted to the hanging arm. A load at
the tip or at a support adds the curvature of its moment m over the bending stiffness B, in the
deformed shape (large rotations, Kirchhoff 1859),

    k = k_free + (R^T m)_xy / B,      m(s) = (r(at) - r(s)) x F.

A support is a spring that pushes back what passes a plane (unilateral penalty). The equilibrium is
found by fixed-point iteration over shape and force. Forces are given as F / B.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

PIECES = 6
"""Pieces of constant curvature in each section: the error of a shape is of their square."""
ITERATIONS = 60
"""Most iterations of the equilibrium."""
TOLERANCE_MM = 1e-3
"""Change of the shape at which the iteration ends, mm."""
RELAXATION = 0.5
"""Share of the new curvature that an iteration takes: a load that stiffens the arm overshoots."""
FIT_ROWS = 400
"""Rows to which a rod is fitted."""
RIDGE = 1e-2
"""Weight of the parameters beside the key points' misses in mm: chambers that never moved apart
have no direction of their own."""
BASE_MOTION_MM = 2.0
"""A key point 0 that moves less (RMS) is the base."""


@dataclass(frozen=True, eq=False)
class Rod:
    """The arm as a rod; S sections, m chambers."""

    lengths_mm: np.ndarray
    """(S,) lengths of the sections at rest, mm."""
    base: np.ndarray
    """(3,) rotation vector of the base section, arm base frame, rad."""
    bend: np.ndarray
    """(S, 2, m) curvature by unit load of each chamber, 1/mm."""
    rest: np.ndarray
    """(S, 2) curvature at rest, 1/mm."""
    stretch: np.ndarray
    """(S, m) stretch by unit load of each chamber."""
    based: bool
    """Whether key point 0 is the base; the other key points end one section each."""

    def strains(self, loads: np.ndarray) -> np.ndarray:
        """(T, S, 4) free curvature k_x, k_y, torsion [1/mm] and stretch by loads (T, m)."""
        strains = np.zeros((len(loads), len(self.rest), 4))
        strains[..., :2] = np.einsum("sdm,tm->tsd", self.bend, loads) + self.rest
        strains[..., 3] = np.einsum("sm,tm->ts", self.stretch, loads)
        return strains


@dataclass(frozen=True, eq=False)
class Shape:
    """Shapes of a rod; P = S * PIECES pieces."""

    nodes: np.ndarray
    """(T, P + 1, 3) ends of the pieces, arm base frame, mm."""
    frames: np.ndarray
    """(T, P, 3, 3) rotations of the pieces' middles, axes in columns."""


@dataclass(frozen=True, eq=False)
class Weight:
    """A force on the rod that stays as it is."""

    over_stiffness: np.ndarray
    """(3,) force over bending stiffness, arm base frame, 1/mm^2."""
    node: int
    """Node at which it acts."""


@dataclass(frozen=True, eq=False)
class Support:
    """A unilateral spring."""

    normal: np.ndarray
    """(3,) unit normal of the plane, away from the free side, arm base frame."""
    plane_mm: float
    """Distance of the plane from the origin along the normal, mm."""
    node: int
    """Node that it holds back."""
    share: float
    """Stiffness of the spring times the straight rod's compliance at the node."""


def turned(vectors: np.ndarray) -> np.ndarray:
    """(..., 3, 3) rotations by vectors (..., 3) in rad (Rodrigues 1840)."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    cross = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).reshape(*x.shape, 3, 3)
    safe = np.where(angle > 0, angle, 1.0)
    sine = np.where(angle > 1e-8, np.sin(safe) / safe, 1.0)
    cosine = np.where(angle > 1e-4, (1 - np.cos(safe)) / safe**2, 0.5)
    return np.eye(3) + sine * cross + cosine * cross @ cross


def shape_of(rod: Rod, strains: np.ndarray) -> Shape:
    """Shapes under strains (T, P, 4) of the pieces: curvature, torsion [1/mm] and stretch.

    Each piece is a circular arc, so that the frame is exact; its chord is taken along the frame at
    its middle, with the chord's length sin(a) / a of the arc's for half the angle a.
    """
    count, pieces = strains.shape[:2]
    steps = np.repeat(rod.lengths_mm / PIECES, PIECES)
    nodes = np.zeros((count, pieces + 1, 3))
    frames = np.empty((count, pieces, 3, 3))
    frame = np.broadcast_to(turned(rod.base), (count, 3, 3))
    vectors = strains[..., :3] * steps[:, None]
    halves = turned(vectors / 2)
    angle = np.linalg.norm(vectors[..., :2], axis=2) / 2
    chord = steps * (1 + strains[..., 3]) * np.sinc(angle / np.pi)
    for piece in range(pieces):
        middle = frame @ halves[:, piece]
        frames[:, piece] = middle
        nodes[:, piece + 1] = nodes[:, piece] + chord[:, piece, None] * middle[..., 2]
        frame = middle @ halves[:, piece]
    return Shape(nodes, frames)


def by_pieces(strains: np.ndarray) -> np.ndarray:
    """Strains (T, S, 4) of sections as those of their pieces (T, S * PIECES, 4)."""
    return np.repeat(strains, PIECES, axis=1)


def balanced(rod: Rod, strains: np.ndarray, force: Weight | Support | None = None) -> Shape:
    """Shapes in equilibrium under free strains (T, S, 4) and a force."""
    free = by_pieces(strains)
    shape = shape_of(rod, free)
    if force is None:
        return shape
    now, acts = free.copy(), np.arange(free.shape[1]) < force.node
    push, gain, stiffness = np.zeros((len(free), 3)), 0.0, 0.0
    if isinstance(force, Weight):
        push += force.over_stiffness
    else:
        reach = (np.repeat(rod.lengths_mm / PIECES, PIECES) * acts).sum()
        stiffness = force.share * 3 / reach**3
        gain = 1 / (1 + force.share)
    for _ in range(ITERATIONS):
        if isinstance(force, Support):
            depth = shape.nodes[:, force.node] @ force.normal - force.plane_mm
            wanted = -stiffness * np.maximum(depth, 0.0)[:, None] * force.normal
            push = push + gain * (wanted - push)
        middles = (shape.nodes[:, 1:] + shape.nodes[:, :-1]) / 2
        arm = shape.nodes[:, force.node, None] - middles
        moment = np.cross(arm, push[:, None]) * acts[:, None]
        bend = np.einsum("tpij,tpi->tpj", shape.frames, moment)[..., :2]
        now[..., :2] += RELAXATION * (free[..., :2] + bend - now[..., :2])
        before, shape = shape.nodes, shape_of(rod, now)
        if np.abs(shape.nodes - before).max() < TOLERANCE_MM:
            break
    return shape


def key_points(rod: Rod, shape: Shape) -> np.ndarray:
    """(T, n, 3) key points of shapes, mm."""
    ends = shape.nodes[:, ::PIECES]
    return ends if rod.based else ends[:, 1:]


def fit_rod(loads: np.ndarray, points: np.ndarray) -> tuple[Rod, float]:
    """The rod that follows key points (T, n, 3) [mm] at loads (T, m), and its RMS error, mm.

    Least squares by Levenberg and Marquardt's method on some rows, spread over the recording.
    """
    seen = np.flatnonzero(np.isfinite(points).all((1, 2)))
    rows = seen[np.linspace(0, len(seen) - 1, min(FIT_ROWS, len(seen))).astype(int)]
    x, wanted = loads[rows], points[rows]
    still = np.sqrt(np.mean(np.sum((wanted[:, 0] - wanted[:, 0].mean(0)) ** 2, axis=1)))
    based = bool(still < BASE_MOTION_MM and np.linalg.norm(wanted[:, 0].mean(0)) < BASE_MOTION_MM)
    near_rest = wanted[np.argsort(np.abs(x).sum(1))[: max(1, len(x) // 20)]].mean(0)
    ends = near_rest if based else np.concatenate([np.zeros((1, 3)), near_rest])
    lengths = np.linalg.norm(np.diff(ends, axis=0), axis=1)
    sections, chambers = len(lengths), x.shape[1]
    scale = lengths.sum()
    sizes = (sections, 2, 2 * sections * chambers, 2 * sections, sections * chambers)
    cuts = np.cumsum(sizes)[:-1]

    def rod_of(parameters: np.ndarray) -> Rod:
        length, tilt, bend, rest, stretch = np.split(parameters, cuts)
        return Rod(
            lengths_mm=lengths * np.exp(length),
            base=np.array([tilt[0], tilt[1], 0.0]),
            bend=bend.reshape(sections, 2, chambers) / scale,
            rest=rest.reshape(sections, 2) / scale,
            stretch=stretch.reshape(sections, chambers),
            based=based,
        )

    def misses(parameters: np.ndarray) -> np.ndarray:
        rod = rod_of(parameters)
        found = key_points(rod, balanced(rod, rod.strains(x)))
        miss = (found - wanted).ravel() / np.sqrt(len(x))
        return np.concatenate([miss, RIDGE * parameters])

    solved = least_squares(misses, np.zeros(sum(sizes)), method="trf", max_nfev=30)
    rod = rod_of(solved.x)
    found = key_points(rod, balanced(rod, rod.strains(x)))
    error = np.sqrt(np.mean(np.sum((found - wanted) ** 2, axis=2)))
    return rod, float(error)
