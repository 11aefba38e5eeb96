"""The body's own frame at each key point: along the body, in the bending plane, out of it."""

import numpy as np
from scipy.interpolate import make_interp_spline

COMPONENTS = ("along", "in plane", "out of plane")
"""The axes of the frame, in order."""
STRAIGHT = 1e-6
"""Lateral displacement of the tip below which a body is straight, share of the arm's length."""


def tangents(points: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """(S, n, 3) unit tangents of the body at its key points (S, n, 3), mm, base frame.

    Of the interpolating spline whose parameter is the chord length at rest (n, 3), mm. An arm with
    a single key point is taken for an arc that leaves the base along z: its tangent is the chord
    mirrored at the base's axis.
    """
    if points.shape[1] == 1:
        chord = _unit(points)
        return 2 * chord[..., 2:] * chord - np.array([0.0, 0.0, 1.0])
    steps = np.linalg.norm(np.diff(rest, axis=0), axis=1)
    knots = np.concatenate([[0.0], np.cumsum(np.maximum(steps, 1e-9))])
    spline = make_interp_spline(knots, np.eye(len(rest)), k=min(3, len(rest) - 1))
    return _unit(np.einsum("jk,skx->sjx", spline.derivative()(knots), points))


def bending(points: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """(S, 2) lateral displacement of the tip from rest, base frame x and y, mm."""
    return points[:, -1, :2] - rest[-1, :2]


def frames(points: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """(S, n, 3, 3) frames of a body with key points (S, n, 3): rows are the unit `COMPONENTS`.

    Along is the tangent towards the tip. The bending plane holds the base's axis z and the tip's
    displacement from rest (n, 3); in plane is across the body towards the side it bends to, out of
    plane is along x in-plane, right-handed. A straight body bends towards x by convention.
    """
    along = tangents(points, rest)
    lateral = bending(points, rest)
    size = np.linalg.norm(lateral, axis=1, keepdims=True)
    length = max(float(np.linalg.norm(rest[-1])), 1e-9)
    lateral = np.where(size > STRAIGHT * length, lateral / np.maximum(size, 1e-12), [1.0, 0.0])
    normal = np.stack([-lateral[:, 1], lateral[:, 0], np.zeros(len(lateral))], axis=1)[:, None]
    out = _unit(normal - (normal * along).sum(-1, keepdims=True) * along)
    return np.stack([along, np.cross(out, along), out], axis=-2)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12)
