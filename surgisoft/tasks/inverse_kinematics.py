"""Inverse kinematics: damped least squares on the differentiable arm model.

The scripted experts of the tasks use it with the true state of the episode (privileged).
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from surgisoft.tasks.world.arm import Arm, ArmPart
from surgisoft.tasks.world.pytree import rows, tree_map

SOLVED_MM = 5e-5
"""Largest residual of a solution, mm. Coordinates of 100 mm in single precision are 8e-6 mm apart,
and the axis of a tip, which a beam follows over tens of millimetres, amplifies that several times;
further steps would follow rounding alone."""


def least_squares(
    residual: Callable[[Tensor], Tensor],
    start: Tensor,
    low: Tensor,
    high: Tensor,
    damping: float = 1e-3,
    iterations: int = 5,
    solved: float = 0.0,
    hold_at_limits: bool = False,
) -> Tensor:
    """Minimise residuals (B, r) over (B, m) within low, high (B, m); returns the best point tried.

    Steps (J^T J + lambda D)^-1 J^T r with D the mean of J^T J's diagonal (Levenberg 1944; Wampler
    1986 for arms), clipped to the box. An environment's damping grows tenfold after a step that
    does not lower its residual, else it falls tenfold. The search ends early, but not on a GPU,
    where no environment has a residual longer than `solved`. `residual` maps (B, m) to (B, r) by
    row; slopes cost more than all else here.

    hold_at_limits: leave a coordinate out of the step where it is at its limit and the residual
    falls beyond. Without this a clipped step, which may lower no residual at any damping, can end
    the search away from the minimum.
    """
    best = torch.minimum(torch.maximum(start, low), high)
    factor = best.new_full((len(best), 1, 1), damping)
    error = _value(residual, best)
    eye = torch.eye(best.shape[1], dtype=best.dtype, device=best.device)
    helped = True
    for _ in range(iterations):
        if helped:
            if not best.is_cuda and bool((error.norm(dim=1) <= solved).all()):
                break
            jacobian = _jacobian(residual, best)
            pull = (jacobian.mT @ error[..., None])[..., 0]
            if hold_at_limits:
                held = ((best <= low) & (pull > 0.0)) | ((best >= high) & (pull < 0.0))
                jacobian = jacobian.masked_fill(held[:, None], 0.0)
                pull = pull.masked_fill(held, 0.0)
            normal = jacobian.mT @ jacobian
            size = normal.diagonal(dim1=1, dim2=2).mean(1)[:, None, None].clamp(min=1e-12)
        move = torch.linalg.solve_ex(normal + factor * size * eye, pull)[0]
        tried = torch.minimum(torch.maximum(best - move, low), high)
        new_error = _value(residual, tried)
        better = new_error.square().sum(1) < error.square().sum(1)
        best = torch.where(better[:, None], tried, best)
        error = torch.where(better[:, None], new_error, error)
        # A GPU does not wait for the answer.
        helped = best.is_cuda or bool(better.any())
        factor = torch.where(better[:, None, None], 0.1 * factor, 10.0 * factor).clamp(1e-6, 1e6)
    return best


def _value(residual: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """Residuals (B, r) at points (B, m), without their slopes, which compiled arms do not have."""
    with torch.no_grad():
        return residual(at)


def _jacobian(residual: Callable[[Tensor], Tensor], at: Tensor) -> Tensor:
    """Jacobians (B, r, m) of residuals (B, r) at points (B, m); works under inference_mode."""
    with torch.inference_mode(False), torch.enable_grad():
        place = at.clone().requires_grad_(True)
        value = residual(place)
        one = torch.eye(value.shape[1], dtype=value.dtype, device=value.device)
        each = one[:, None].expand(-1, len(value), -1)
        slopes = torch.autograd.grad(value, place, each, is_grads_batched=True)[0]
    return slopes.movedim(0, 1)


STUCK_MM = 1e-3
"""Residual above which the solver tries again from other starting points (mm)."""
OFFSETS_KPA = (1.0, -1.0)
"""Offsets of those starting points from the present pressures, beyond every dead band (kPa)."""

Error = Callable[[Tensor, Tensor], Tensor]
"""Residual to be minimised: key points (B, n, 3) mm and targets (B, ...) to (B, r) mm."""


def action_towards(
    arm: Arm,
    part: ArmPart,
    target_mm: Tensor,
    error: Error,
    dt_s: float,
    stuck_mm: float = STUCK_MM,
) -> Tensor:
    """(B, m) kPa: the action that minimises the predicted error after dt_s seconds.

    The model's shape jumps where a chamber's pressure changes direction, which a gradient does not
    show. Where more than stuck_mm remains, the solver therefore tries again from pressures at which
    all chambers rise, and from pressures at which all fall.
    """
    with torch.inference_mode(False):
        part, target = tree_map(torch.clone, part), target_mm.clone()
        best, left = _solved(arm, part, target, error, dt_s, 0.0)
        stuck = (left > stuck_mm).nonzero()[:, 0]
        for offset in OFFSETS_KPA if len(stuck) else ():
            tried, missed = _solved(arm, rows(part, stuck), target[stuck], error, dt_s, offset)
            better = missed < left[stuck]
            best = best.index_copy(0, stuck, tried.where(better[:, None], best[stuck]))
            left = left.index_copy(0, stuck, missed.where(better, left[stuck]))
        return arm.action_for(part, best, dt_s)


def _solved(arm, part, target, error, dt_s, offset) -> tuple[Tensor, Tensor]:
    """Pressures (B, m) kPa found from a start `offset` kPa away, and their residuals (B,) mm."""
    low, high = arm.within_reach(part, dt_s)

    def residual(pressure: Tensor) -> Tensor:
        return error(arm.predict(part, pressure, dt_s), target)

    pressure = least_squares(residual, part.pressure + offset, low, high, solved=SOLVED_MM)
    return pressure, residual(pressure).norm(dim=1)


class Pointing:
    """Inverse kinematics that points the axis of an arm's tip at a target; holds no state."""

    def __init__(self, arm: Arm, dt_s: float):
        self.arm, self.dt_s = arm, dt_s

    def offset_mm(
        self, points_mm: Tensor, target_mm: Tensor, mount: Tensor | None = None
    ) -> Tensor:
        """(B, 3) mm: perpendicular offset of targets (B, 3) mm from the tip's axis.

        points_mm: key points (B, n, 3) mm; mount: (B, 4, 4) mm, base frame of the arm, from which
        the axis of an arm with one key point follows; None: the nominal one. All in the world
        frame. For a target behind the tip the axis ends at the tip.
        """
        aim = self.arm.backbone.tip_direction(points_mm, self.arm.pose if mount is None else mount)
        away = target_mm - points_mm[:, -1]
        along = (away * aim).sum(1, keepdim=True).clamp(min=0.0)
        return away - along * aim

    def action(self, part: ArmPart, target_mm: Tensor) -> Tensor:
        """(B, m) kPa: the action that points the axis at targets (B, 3) mm after one step."""
        with torch.inference_mode(False):
            part, target = tree_map(torch.clone, part), target_mm.clone()
            low, high = self.arm.within_reach(part, self.dt_s)

            def residual(pressure: Tensor) -> Tensor:
                points = self.arm.predict(part, pressure, self.dt_s)
                return self.offset_mm(points, target, part.mount)

            wanted = least_squares(residual, part.pressure, low, high, solved=SOLVED_MM)
            return self.arm.action_for(part, wanted, self.dt_s)
