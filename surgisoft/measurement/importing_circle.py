"""Centres of key feature planes from markers on their rim: plane and circle fit in 3D."""

import numpy as np

_COLLINEAR = 0.02
"""Least spread across against spread along the markers for a circle to be defined."""


def circle_centres(markers: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre, radius and rms residual of the circle through each row's markers.

    markers: (T, k, 3) positions in any one unit and frame, NaN where missing. Returns centres
    (T, 3), radii (T,), residuals (T,), all in that unit; NaN where fewer than three markers are
    known or they stand on one line.
    """
    centres = np.full((len(markers), 3), np.nan)
    radii, residuals = np.full(len(markers), np.nan), np.full(len(markers), np.nan)
    known = ~np.isnan(markers).any(axis=2)
    patterns, which = np.unique(known, axis=0, return_inverse=True)
    for i, pattern in enumerate(patterns):
        rows = np.flatnonzero(which.reshape(-1) == i)
        if pattern.sum() >= 3:
            centres[rows], radii[rows], residuals[rows] = _fit(markers[rows][:, pattern])
    return centres, radii, residuals


def _fit(points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Circles through complete markers (T, k, 3), k >= 3."""
    mean = points.mean(axis=1, keepdims=True)
    _, spread, axes = np.linalg.svd(points - mean, full_matrices=False)
    flat = np.einsum("tki,tai->tka", points - mean, axes[:, :2])
    size = np.maximum(spread[:, 0], 1e-300)
    good = (spread[:, 1] > _COLLINEAR * size) & (spread[:, 0] > 0)
    scaled = flat / size[:, None, None]
    centre, radius = _algebraic(scaled, good)
    centre, radius = _geometric(scaled, centre, radius, good)
    distance = np.linalg.norm(scaled - centre[:, None], axis=2) - radius[:, None]
    off_plane = np.einsum("tki,ti->tk", points - mean, np.cross(axes[:, 0], axes[:, 1]))
    square = (distance * size[:, None]) ** 2 + off_plane**2
    centres = mean[:, 0] + np.einsum("ta,tai->ti", centre * size[:, None], axes[:, :2])
    centres[~good], radius[~good] = np.nan, np.nan
    return centres, radius * size, np.where(good, np.sqrt(square.mean(axis=1)), np.nan)


def _algebraic(flat: np.ndarray, good: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Start of the fit: linear least squares of x^2 + y^2 = 2 a x + 2 b y + c (Kasa 1976).

    flat: (T, k, 2) with zero mean. Exact where the points stand on a circle.
    """
    square = (flat**2).sum(axis=2)
    normal = np.einsum("tka,tkb->tab", flat, flat)
    normal[~good] = np.eye(2)
    side = np.einsum("tka,tk->ta", flat, square) / 2
    centre = np.linalg.solve(normal, side[..., None])[..., 0]
    radius = np.sqrt(square.mean(axis=1) + (centre**2).sum(axis=1))
    return centre, radius


def _geometric(
    flat: np.ndarray, centre: np.ndarray, radius: np.ndarray, good: np.ndarray, steps: int = 10
) -> tuple[np.ndarray, np.ndarray]:
    """Least squares of the distances to the circle by Gauss-Newton steps.

    Gander, Golub and Strebel, Least-squares fitting of circles and ellipses, 1994.
    """
    if flat.shape[1] == 3:
        return centre, radius  # three points: the algebraic circle goes through them
    for _ in range(steps):
        away = flat - centre[:, None]
        distance = np.maximum(np.linalg.norm(away, axis=2), 1e-300)
        slopes = np.concatenate([away / distance[..., None], np.ones((*distance.shape, 1))], axis=2)
        normal = np.einsum("tka,tkb->tab", slopes, slopes)
        normal[~good] = np.eye(3)
        side = np.einsum("tka,tk->ta", slopes, distance - radius[:, None])
        normal += 1e-12 * np.eye(3)
        change = np.linalg.solve(normal, side[..., None])[..., 0]
        centre, radius = centre + change[:, :2], radius + change[:, 2]
    return centre, radius
