"""Frames aligned in closed form: the rotation, shift and scale between two sets of points.

Measured x and predicted y are related by x = s R y + t. The best R, s and t follow from sums over
the points alone (Kabsch 1976; Umeyama 1991, eq. 40-43), so sums of blocks of time give the fit on
any set of blocks, and its error on any other, without another pass over the rows.
"""

from dataclasses import dataclass

import numpy as np

HANDED = {"proper": 1.0, "improper": -1.0}
"""Determinant of the rotation of each kind of frame: turned, or turned and mirrored."""


@dataclass(frozen=True, eq=False)
class Moments:
    """Sums over points of measured x and predicted y; leading shape (...) of cases."""

    count: np.ndarray
    """(...) number of points."""
    x: np.ndarray
    """(..., 3) sum of x, in the recording's unit."""
    y: np.ndarray
    """(..., 3) sum of y, mm."""
    xx: np.ndarray
    """(...) sum of |x|^2."""
    yy: np.ndarray
    """(...) sum of |y|^2."""
    xy: np.ndarray
    """(..., 3, 3) sum of x y^T."""

    def __getitem__(self, at) -> "Moments":
        return Moments(*(part[at] for part in self._parts))

    def __sub__(self, other: "Moments") -> "Moments":
        return Moments(*(a - b for a, b in zip(self._parts, other._parts, strict=True)))

    @property
    def _parts(self) -> tuple[np.ndarray, ...]:
        return self.count, self.x, self.y, self.xx, self.yy, self.xy

    def summed(self, over: np.ndarray | None = None) -> "Moments":
        """Sums over the first axis, of the cases that a mask (K,) picks; default all."""
        parts = self._parts if over is None else self[over]._parts
        return Moments(*(part.sum(axis=0) for part in parts))

    def mean_square(self, frame: "Frame") -> np.ndarray:
        """(...) mean of |R^T (x - t) / s - y|^2, mm^2: the error once the frame is corrected."""
        scale, turn, shift = frame.scale, frame.rotation, frame.shift
        count = np.maximum(self.count, 1e-9)
        turned = np.einsum("...ij,...j->...i", turn, self.y)
        total = (
            self.xx
            + scale**2 * self.yy
            + count * np.sum(shift**2, -1)
            - 2 * scale * np.einsum("...ij,...ij->...", turn, self.xy)
            - 2 * np.sum(shift * self.x, -1)
            + 2 * scale * np.sum(shift * turned, -1)
        )
        return np.maximum(total, 0.0) / (scale**2 * count)


@dataclass(frozen=True, eq=False)
class Frame:
    """The recorded key points x = scale * rotation @ y + shift of true ones y."""

    rotation: np.ndarray
    """(..., 3, 3) rotation, of determinant -1 where the frame is mirrored."""
    shift: np.ndarray
    """(..., 3) place of the true origin, in the recording's unit."""
    scale: np.ndarray | float = 1.0
    """(...) recorded units in one mm."""


def moments(x: np.ndarray, y: np.ndarray) -> Moments:
    """(A, D) moments of D measurements x (D, S, n, 3) and A predictions y (A, S, n, 3).

    A key point of x that is NaN takes no part.
    """
    seen = np.isfinite(x).all(axis=-1)
    cases, many = len(y), len(x)
    x = np.where(seen[..., None], x, 0.0).reshape(many, -1, 3)
    y, weight = y.reshape(cases, -1, 3), seen.reshape(many, -1).astype(float)
    rows = y.transpose(0, 2, 1).reshape(3 * cases, -1)
    xy = rows @ x.transpose(1, 0, 2).reshape(-1, 3 * many)
    wide = (cases, many)
    return Moments(
        count=np.broadcast_to(weight.sum(1), wide),
        x=np.broadcast_to(x.sum(1), (*wide, 3)),
        y=(rows @ weight.T).reshape(cases, 3, many).transpose(0, 2, 1),
        xx=np.broadcast_to(np.square(x).sum((1, 2)), wide),
        yy=np.square(y).sum(2) @ weight.T,
        xy=xy.reshape(cases, 3, many, 3).transpose(0, 2, 3, 1),
    )


def block_moments(x: np.ndarray, y: np.ndarray, block: np.ndarray, count: int) -> Moments:
    """(B,) moments of the blocks (S,) of one measurement x and one prediction y (S, n, 3)."""
    seen = (np.isfinite(x) & np.isfinite(y)).all(axis=-1)[..., None]
    x, y = np.where(seen, x, 0.0), np.where(seen, y, 0.0)
    rows = np.concatenate(
        [
            seen.sum(1),
            x.sum(1),
            y.sum(1),
            np.square(x).sum((1, 2))[:, None],
            np.square(y).sum((1, 2))[:, None],
            np.einsum("sni,snj->sij", x, y).reshape(len(x), 9),
        ],
        axis=1,
    )
    inside = block >= 0
    sums = np.stack(
        [np.bincount(block[inside], column[inside], minlength=count) for column in rows.T], axis=1
    )
    return Moments(
        sums[:, 0],
        sums[:, 1:4],
        sums[:, 4:7],
        sums[:, 7],
        sums[:, 8],
        sums[:, 9:].reshape(-1, 3, 3),
    )


def fitted(given: Moments, determinant: float, scale: np.ndarray | float | None = None) -> Frame:
    """The least-squares frame of given handedness; `scale` (...) is fitted where it is None."""
    count = np.maximum(given.count, 1e-9)[..., None]
    x, y = given.x / count, given.y / count
    spread = given.xy - count[..., None] * x[..., :, None] * y[..., None, :]
    left, values, right = np.linalg.svd(spread)
    sign = np.linalg.det(left) * np.linalg.det(right) * determinant
    last = np.ones_like(values)
    last[..., 2] = np.where(sign < 0, -1.0, 1.0)
    rotation = (left * last[..., None, :]) @ right
    if scale is None:
        power = given.yy - given.count * np.sum(y**2, -1)
        scale = np.maximum((values * last).sum(-1), 1e-12) / np.maximum(power, 1e-12)
    shift = x - np.asarray(scale)[..., None] * np.einsum("...ij,...j->...i", rotation, y)
    return Frame(rotation, shift, scale)


def unturned(like: Moments, scale: np.ndarray | float = 1.0) -> Frame:
    """The frame that is not turned or shifted, for every case (...)."""
    shape = np.shape(like.count)
    return Frame(np.broadcast_to(np.eye(3), (*shape, 3, 3)), np.zeros((*shape, 3)), scale)


def shifted(rotation: np.ndarray, given: Moments, scale: np.ndarray | float) -> Frame:
    """The frame of this rotation and scale with the least-squares shift."""
    count = np.maximum(given.count, 1e-9)[..., None]
    turned = np.einsum("...ij,...j->...i", rotation, given.y / count)
    return Frame(rotation, given.x / count - np.asarray(scale)[..., None] * turned, scale)


def angle(rotation: np.ndarray) -> np.ndarray:
    """(...) angle of rotations (..., 3, 3) of determinant 1, rad."""
    return np.arccos(np.clip((np.trace(rotation, axis1=-2, axis2=-1) - 1) / 2, -1.0, 1.0))
