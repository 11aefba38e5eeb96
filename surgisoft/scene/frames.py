"""Rigid poses and rotations for numpy arrays and torch tensors.

A pose is a (..., 4, 4) matrix that maps points of its own frame into its parent's frame:
`p_parent = pose @ p_own`. World frame: z up, millimetres.
Every function returns the type it was given: numpy stays numpy, torch keeps dtype and device.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from surgisoft.on_device import on_device

Array = Any
"""A numpy array or a torch tensor; every function returns the type that it is given."""


def _library(array):
    """The library of the array: numpy or torch."""
    return torch if isinstance(array, torch.Tensor) else np


def _as_arrays(*values):
    """All values as torch tensors if one of them is, as float64 numpy arrays otherwise."""
    tensors = [v for v in values if isinstance(v, torch.Tensor)]
    if tensors:
        like = tensors[0]
        return [_as_tensor(v, like) for v in values]
    return [np.asarray(v, dtype=np.float64) for v in values]


def _as_tensor(value, like: torch.Tensor) -> torch.Tensor:
    if isinstance(value, (int, float, torch.Tensor)):
        return on_device(value, like)
    return torch.as_tensor(value, dtype=like.dtype, device=like.device)


def _parts(vectors):
    """The three components (...) of (..., 3) vectors."""
    if isinstance(vectors, torch.Tensor):  # one operation; an index for each would be three
        return vectors.unbind(-1)
    return vectors[..., 0], vectors[..., 1], vectors[..., 2]


def norm(vector: Array) -> Array:
    """Euclidean length of (..., 3) vectors: (...)."""
    return _library(vector).sqrt(dot(vector, vector))


def normalise(vector: Array) -> Array:
    """Unit vectors along (..., 3) vectors; a zero vector stays zero."""
    length = norm(vector)[..., None]
    return vector / (length + (length == 0))


def cross(a: Array, b: Array) -> Array:
    """Cross product of (..., 3) vectors, broadcast."""
    (ax, ay, az), (bx, by, bz) = _parts(a), _parts(b)
    return _library(a).stack((ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx), -1)


def dot(a: Array, b: Array) -> Array:
    """Dot product of (..., 3) vectors, broadcast: (...)."""
    x, y, z = _parts(a * b)
    return x + y + z


def pose_from(rotation: Array, position_mm: Array) -> Array:
    """Pose (..., 4, 4) from a rotation (..., 3, 3) and a position (..., 3) in mm."""
    rotation, position_mm = _as_arrays(rotation, position_mm)
    lib = _library(rotation)
    batch = np.broadcast_shapes(tuple(rotation.shape[:-2]), tuple(position_mm.shape[:-1]))
    rotation = lib.broadcast_to(rotation, (*batch, 3, 3))
    position_mm = lib.broadcast_to(position_mm, (*batch, 3))
    top = lib.concatenate((rotation, position_mm[..., None]), -1)
    bottom = lib.zeros_like(top[..., :1, :])
    bottom[..., 3] += 1.0
    return lib.concatenate((top, bottom), -2)


def identity() -> np.ndarray:
    """The pose that changes nothing: (4, 4) float64."""
    return np.eye(4)


def compose(*poses: Array) -> Array:
    """Product of poses (..., 4, 4), outermost first: compose(world_b, b_c) is world_c."""
    arrays = _as_arrays(*poses)
    result = arrays[0]
    for pose in arrays[1:]:
        result = result @ pose
    return result


def invert(pose: Array) -> Array:
    """Inverse of rigid poses (..., 4, 4): transposed rotation, rotated negative position."""
    (pose,) = _as_arrays(pose)
    rotation = _library(pose).swapaxes(pose[..., :3, :3], -1, -2)
    return pose_from(rotation, -(rotation @ pose[..., :3, 3:])[..., 0])


def apply(pose: Array, points_mm: Array) -> Array:
    """Points (..., N, 3) mm of the pose's own frame, in its parent's frame; pose (..., 4, 4)."""
    pose, points_mm = _as_arrays(pose, points_mm)
    if pose.ndim > 2 and _library(pose) is torch and pose.device.type != "cpu":
        # A product of many 3 x 3 matrices takes an accelerator four times as long.
        moved = pose[..., None, :3, 3]
        for k in range(3):
            moved = torch.addcmul(moved, points_mm[..., k : k + 1], pose[..., None, :3, k])
        return moved
    turned = points_mm @ _library(pose).swapaxes(pose[..., :3, :3], -1, -2)
    return turned + pose[..., None, :3, 3]


def rotate(pose: Array, vectors: Array) -> Array:
    """Directions (..., N, 3) of the pose's own frame, in its parent's frame; pose (..., 4, 4)."""
    pose, vectors = _as_arrays(pose, vectors)
    return vectors @ _library(pose).swapaxes(pose[..., :3, :3], -1, -2)


def rotation_from_z(z_axis: Array, roll_rad: Array = 0.0) -> Array:
    """Rotation (..., 3, 3) with third column z_axis (..., 3), turned by roll_rad (...) about it.

    At roll 0 the x axis is the parent's x axis projected into the plane across z (the parent's y
    axis when z runs along x), so arms pointing straight up or down have an unsurprising x.
    """
    z_axis, roll_rad = _as_arrays(z_axis, roll_rad)
    lib = _library(z_axis)
    z = normalise(z_axis)
    ex, ey = lib.zeros_like(z), lib.zeros_like(z)
    ex[..., 0] = 1.0
    ey[..., 1] = 1.0
    along_x = (abs(z[..., :1]) > 1.0 - 1e-9) * lib.ones_like(z)
    reference = lib.where(along_x > 0, ey, ex)
    x = normalise(reference - dot(reference, z)[..., None] * z)
    y = cross(z, x)
    c, s = lib.cos(roll_rad)[..., None], lib.sin(roll_rad)[..., None]
    return lib.stack((c * x + s * y, c * y - s * x, z * lib.ones_like(c)), -1)


def pose_from_z(position_mm: Array, z_axis: Array, roll_rad: Array = 0.0) -> Array:
    """Pose (..., 4, 4) at position_mm (..., 3) z along z_axis (..., 3), see rotation_from_z."""
    position_mm, z_axis, roll_rad = _as_arrays(position_mm, z_axis, roll_rad)
    return pose_from(rotation_from_z(z_axis, roll_rad), position_mm)


def look_at(eye_mm: Array, target_mm: Array, up: Array = (0.0, 0.0, 1.0)) -> Array:
    """Camera pose (..., 4, 4) at eye_mm (..., 3): z looks at target_mm, x right, y down the image.

    `up` (..., 3) is the direction that appears upwards. Looking along `up` itself, the parent's x
    axis takes its place.
    """
    eye_mm, target_mm, up = _as_arrays(eye_mm, target_mm, up)
    lib = _library(eye_mm)
    z = normalise(target_mm - eye_mm)
    right = cross(z, up * lib.ones_like(z))
    across = norm(right)[..., None] > 1e-9
    fallback = rotation_from_z(z)[..., :, 0]
    x = normalise(lib.where(across, right, fallback))
    return pose_from(lib.stack((x, cross(z, x), z), -1), eye_mm)


def rotation_from_axis_angle(axis: Array, angle_rad: Array) -> Array:
    """Rotation (..., 3, 3) by angle_rad (...) about axis (..., 3) (Rodrigues 1840).

    It serves batches in torch; `scipy.spatial.transform` has this for numpy only.
    """
    axis, angle_rad = _as_arrays(axis, angle_rad)
    lib = _library(axis)
    u = normalise(axis)
    c, s = lib.cos(angle_rad)[..., None, None], lib.sin(angle_rad)[..., None, None]
    rows = lib.zeros_like(u[..., None] * u[..., None, :])
    for k in range(3):
        rows[..., k, k] += 1.0
    turned = lib.swapaxes(cross(u[..., None, :], rows), -1, -2)
    return c * rows + s * turned + (1.0 - c) * u[..., None] * u[..., None, :]


def angle_between(a: Array, b: Array) -> Array:
    """Angle in rad between (..., 3) vectors, exact near 0 and pi (Kahan 2006: atan2 form)."""
    a, b = _as_arrays(a, b)
    return _library(a).arctan2(norm(cross(a, b)), dot(a, b))
