"""Rotations and quaternions as raw files and maps write them."""

import re

import numpy as np

from surgisoft.config import Where, describe
from surgisoft.errors import InputError

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


def matrices(quaternions: np.ndarray, order: str) -> np.ndarray:
    """Rotation matrices (T, 3, 3) of quaternions (T, 4); NaN where a quaternion is missing.

    A quaternion and its negative give the same matrix, so flips of sign do not matter here. A
    length that is not 1 within 5 % is no orientation and counts as missing. Kuipers, Quaternions
    and Rotation Sequences, 1999, chapter 5.
    """
    q = quaternions if order == "xyzw" else quaternions[:, [1, 2, 3, 0]]
    length = np.linalg.norm(q, axis=1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        x, y, z, w = np.where(np.abs(length - 1) < 0.05, q / length, np.nan).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), -1, 0)


def mean_rotation(quaternions: np.ndarray, order: str) -> np.ndarray:
    """The average orientation (3, 3) of quaternions (T, 4), whatever their signs.

    The eigenvector of the largest eigenvalue of sum q q^T: Markley, Cheng, Crassidis and Oshman,
    Averaging Quaternions, 2007, eqs. 12 and 13.
    """
    length = np.linalg.norm(quaternions, axis=1)
    good = np.abs(length - 1) < 0.05
    if not good.any():
        return np.full((3, 3), np.nan)
    q = quaternions[good] / length[good, None]
    _, vectors = np.linalg.eigh(q.T @ q)
    return matrices(vectors[:, -1][None], order)[0]


def between(first: np.ndarray, second: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Unit quaternions (T, 4) a share (T,) of the shortest way from first to second (T, 4).

    At a constant rate about one axis: Shoemake, Animating Rotation with Quaternion Curves, 1985.
    Either order of the four numbers and either sign of a quaternion will do; NaN where a length
    is not 1 within 5 %. A share of 0 or 1 gives the given quaternion as it is.
    """
    lengths = [np.linalg.norm(q, axis=1, keepdims=True) for q in (first, second)]
    with np.errstate(invalid="ignore", divide="ignore"):
        a, b = (
            np.where(np.abs(length - 1) < 0.05, q / length, np.nan)
            for q, length in zip((first, second), lengths, strict=True)
        )
        cosine = (a * b).sum(axis=1, keepdims=True)
        b = np.where(cosine < 0, -b, b)
        angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
        part = share[:, None]
        far = angle > 1e-6
        sine = np.where(far, np.sin(angle), 1.0)
        turned = np.where(far, np.sin((1 - part) * angle) / sine, 1 - part) * a
        turned += np.where(far, np.sin(part * angle) / sine, part) * b
        turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    return np.where(part == 0, first, np.where(part == 1, second, turned))


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
