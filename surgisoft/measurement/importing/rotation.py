"""Rotations and quaternions as raw files and maps write them.

`scipy.spatial` is imported where a quaternion is read: its import takes longer than most files do.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from surgisoft.config import Where, describe
from surgisoft.errors import InputError

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

_TOLERANCE = 1e-3
"""How far a matrix or quaternion of a map may be from a rotation; it is made exact within it."""

_EXPECTED = 'three signed axes such as "x z -y", a 3x3 matrix of rows, or a quaternion [x, y, z, w]'


def parse_rotation(value: object, where: Where, mirror: bool = False) -> np.ndarray:
    """The rotation (3, 3) out of a map; with `mirror` it must swap handedness instead."""
    array = _axes(value) if isinstance(value, str) else _numbers(value)
    if array is None:
        raise where.error(f"got {describe(value)}", _EXPECTED)
    matrix = matrices(array[None], "xyzw")[0] if array.shape == (4,) else array
    if np.isnan(matrix).any() or np.abs(matrix @ matrix.T - np.eye(3)).max() > _TOLERANCE:
        raise where.error(f"got {describe(value)}", f"a rotation: {_EXPECTED}")
    if (np.linalg.det(matrix) < 0) != mirror:
        came = "keeps handedness" if mirror else "swaps handedness (mirrors the arm)"
        raise where.error(
            f"got {describe(value)}, which {came}",
            "a mirroring, as mirror = true says" if mirror else "a rotation; flip one axis",
        )
    left, _, right = np.linalg.svd(matrix)
    return matrix if isinstance(value, str) else left @ right


def _axes(text: str) -> np.ndarray | None:
    names = text.split()
    if len(names) != 3 or not all(re.fullmatch(r"[+-]?[xyz]", name) for name in names):
        return None
    matrix = np.zeros((3, 3))
    for row, name in enumerate(names):
        matrix[row, "xyz".index(name[-1])] = -1.0 if name[0] == "-" else 1.0
    return matrix


def _numbers(value: object) -> np.ndarray | None:
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError):
        return None
    if array.shape == (4,) and abs(np.linalg.norm(array) - 1) > _TOLERANCE:
        return None
    return array if array.shape in ((3, 3), (4,)) and np.isfinite(array).all() else None


LENGTH_TOLERANCE = 0.05
"""A quaternion whose length is off by more is no orientation and counts as missing."""


def _known(quaternions: np.ndarray) -> np.ndarray:
    """(T,) bool: which quaternions (T, 4) are orientations."""
    return np.abs(np.linalg.norm(quaternions, axis=1) - 1) < LENGTH_TOLERANCE


def _rotations(quaternions: np.ndarray, order: str) -> Rotation:
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat(quaternions, scalar_first=order == "wxyz")


def matrices(quaternions: np.ndarray, order: str) -> np.ndarray:
    """Rotation matrices (T, 3, 3) of quaternions (T, 4) in the order "xyzw" or "wxyz".

    NaN where a quaternion is missing. A quaternion and its negative give the same matrix.
    """
    known = _known(quaternions)
    found = np.full((len(quaternions), 3, 3), np.nan)
    if known.any():
        found[known] = _rotations(quaternions[known], order).as_matrix()
    return found


def mean_rotation(quaternions: np.ndarray, order: str) -> np.ndarray:
    """The mean orientation (3, 3) of quaternions (T, 4), whatever their signs; NaN where none.

    Markley, Cheng, Crassidis and Oshman, Averaging Quaternions, 2007, by scipy.
    """
    known = _known(quaternions)
    if not known.any():
        return np.full((3, 3), np.nan)
    return _rotations(quaternions[known], order).mean().as_matrix()


def between(first: np.ndarray, second: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Unit quaternions (T, 4) a share (T,) of the shortest way from first to second (T, 4).

    At a constant rate about one axis: Shoemake, Animating Rotation with Quaternion Curves, 1985.
    The way is a great circle of the unit quaternions, so either order of the four numbers will do.
    The sign of a result is free. NaN where a quaternion is missing; a share of 0 or 1 gives the
    given quaternion as it is.
    """
    from scipy.spatial.transform import Rotation

    found = np.full(first.shape, np.nan)
    known = _known(first) & _known(second)
    if known.any():
        start, end = Rotation.from_quat(first[known]), Rotation.from_quat(second[known])
        way = (start.inv() * end).as_rotvec()
        found[known] = (start * Rotation.from_rotvec(share[known, None] * way)).as_quat()
    part = share[:, None]
    return np.where(part == 0, first, np.where(part == 1, second, found))


def turn_to_z(direction: np.ndarray) -> np.ndarray:
    """The rotation (3, 3) whose z axis is this direction (3,), x staying as near to x as it can.

    Rows are the new axes in the old frame: z along the direction, x the old x (or y, where the
    direction is along x) without its share along z.
    """
    z = direction / np.linalg.norm(direction)
    start = np.eye(3)[0] if abs(z[0]) < 0.9 else np.eye(3)[1]
    x = start - z * (z @ start)
    x /= np.linalg.norm(x)
    return np.array([x, np.cross(z, x), z])


def check_pose(rotation: np.ndarray, path: object) -> None:
    """Raise where no row gave the base body an orientation."""
    if np.isnan(rotation).any():
        raise InputError(
            f"{path}: the base body has no orientation in any row that was asked for, "
            "expected unit quaternions; check the columns and quaternion_order"
        )
