"""Which points the endoscope sees: inside the field of view, in focus, and not hidden.

A camera looks along its pose's z axis, x to the right and y down in the picture (`frames.look_at`
makes such poses). The same code works with FCL (numpy) and with the batched engine (torch).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from surgisoft.errors import InputError
from surgisoft.scene import frames

LIFT_MM = 0.05
"""Lines of sight end this far above the surface, so that it does not hide its own points (mm)."""
SHORT_MM = 0.1 * LIFT_MM
"""What a line of sight meets this near to its end does not hide the point (mm)."""


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with a round field of view."""

    fov_rad: float = math.radians(70.0)
    """Full cone angle of the field of view (rad)."""
    range_mm: tuple[float, float] = (10.0, 100.0)
    """Smallest and largest distance at which the picture is sharp (mm)."""

    def __post_init__(self):
        if not 0.0 < self.fov_rad < math.pi:
            raise InputError(f"camera field of view is {self.fov_rad} rad: expected 0 to pi")
        if not 0.0 <= self.range_mm[0] < self.range_mm[1] < math.inf:
            raise InputError(f"camera range is {self.range_mm} mm: expected two rising distances")


@dataclass(frozen=True, eq=False)
class View:
    """Visibility of M points from a camera; numpy or torch arrays of one leading shape (...)."""

    visible: Any
    """(..., M) bool: inside the cone, in range, and nothing in between."""
    hidden: Any
    """(..., M) bool: inside the cone and in range, but something is in between."""
    fraction: Any
    """(...) 0..1: share of the points that are visible."""
    axis_error_rad: Any
    """(...) rad between the optical axis and the points' middle."""
    axis_error_mm: Any
    """(...) mm from the points' middle to the optical axis."""
    distance_mm: Any
    """(...) mm from the camera to the points' middle."""


def view(
    caster: Any,
    camera: Camera,
    pose: Any,
    points_mm: Any,
    normals: Any,
    arms: Mapping[str, Any] | None = None,
    own: str | None = None,
    **where: Any,
) -> View:
    """Which points (M, 3) or (..., M, 3) mm a camera at pose (..., 4, 4) sees; world frame.

    `caster` casts the lines of sight: a `collision.CollisionChecker` (numpy) or a
    `batched.BatchedScene` (torch, poses (B, 4, 4)). `normals` has the shape of the points. `arms`
    can block the view, as in the caster's `cast`; `own` names the arm that carries the camera;
    further keywords go to `cast`.
    """
    points, normals = _like(pose, points_mm), _like(pose, normals)
    eye, axis = pose[..., :3, 3], pose[..., :3, 2]
    return seen_from(caster, camera, eye, axis, points, normals, arms, own, **where)


def seen_from(
    caster: Any,
    camera: Camera,
    eye_mm: Any,
    axis: Any,
    points_mm: Any,
    normals: Any,
    arms: Mapping[str, Any] | None = None,
    own: str | None = None,
    **where: Any,
) -> View:
    """Which points (..., M, 3) mm a camera at eye_mm (..., 3) along axis (..., 3) sees.

    As `view`, whose poses also say how the picture is turned, which does not matter here.
    """
    if isinstance(eye_mm, torch.Tensor) and getattr(caster, "sights", False):
        return _view_by_sights(caster, camera, eye_mm, axis, points_mm, normals, arms, own, where)
    lib = torch if isinstance(eye_mm, torch.Tensor) else np
    eye, axis = eye_mm[..., None, :], axis[..., None, :]
    rays = points_mm + LIFT_MM * normals - eye
    distance = frames.norm(rays)
    near, far = camera.range_mm
    in_view = frames.angle_between(axis + 0.0 * rays, rays) <= 0.5 * camera.fov_rad
    in_view = in_view & (distance >= near) & (distance <= far)
    hit = caster.cast(eye + 0.0 * rays, rays, 1.01 * far, arms, own, **where)
    clear = hit.distance_mm >= distance - SHORT_MM
    visible = in_view & clear
    to_middle = points_mm.mean(-2) - eye[..., 0, :]
    error = frames.angle_between(axis[..., 0, :] + 0.0 * to_middle, to_middle)
    reach = frames.norm(to_middle)
    return View(
        visible=visible,
        hidden=in_view & ~clear,
        fraction=visible.mean(-1) if lib is np else visible.to(reach.dtype).mean(-1),
        axis_error_rad=error,
        axis_error_mm=reach * lib.sin(error.clip(0.0, 0.5 * math.pi)),
        distance_mm=reach,
    )


def _view_by_sights(caster, camera, eye, axis, points, normals, arms, own, where) -> View:
    """`seen_from` for tensors (B, ...), where `caster` is a `BatchedScene` with lines of sight."""
    count, each = len(eye), points.shape[-2]
    points, normals = points.expand(count, each, 3), normals.expand(count, each, 3)
    near, far = camera.range_mm
    picture = (LIFT_MM, 0.5 * camera.fov_rad, float(near), float(far))
    given = (eye, axis, points, normals, picture, SHORT_MM)
    wanted, clear, middle = caster.look(*given, arms, own, **where)
    error, reach = middle.unbind(1)
    return View(
        visible=clear,
        hidden=wanted & ~clear,
        fraction=clear.to(eye.dtype).mean(-1),
        axis_error_rad=error,
        axis_error_mm=reach * error.clamp(0.0, 0.5 * math.pi).sin(),
        distance_mm=reach,
    )


def _like(pose, array):
    """The array as the same type as the pose, with its precision and device."""
    if isinstance(pose, torch.Tensor):
        return torch.as_tensor(np.array(array) if isinstance(array, np.ndarray) else array).to(pose)
    return np.asarray(array, dtype=np.float64)
