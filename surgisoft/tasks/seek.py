"""The scripted pressures that bring points of an arm where they should be."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from surgisoft.tasks.solver import least_squares
from surgisoft.tasks.tree import rows, tree_map
from surgisoft.tasks.world_arm import Arm, ArmPart

STUCK_MM = 1e-3
"""A solver that leaves more than this tries again (mm)."""
OFFSETS_KPA = (1.0, -1.0)
"""Where it begins then, beside the present pressures (kPa): beyond every dead band."""

Error = Callable[[Tensor, Tensor], Tensor]
"""Key points (B, n, 3) mm and targets (B, ...) to what should vanish, (B, r) mm."""


def seek(
    arm: Arm, part: ArmPart, target_mm: Tensor, error: Error, dt_s: float, stuck_mm=STUCK_MM
) -> Tensor:
    """(B, m) kPa: the action after which the error is least, by damped least squares.

    The direction of change makes the arm jump where a chamber turns round, so where the solver is
    stuck it tries again from pressures that turn all chambers one way or the other.
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
    """Pressures (B, m) kPa, sought from `offset` kPa off, and the errors (B,) that they leave."""
    low, high = arm.within_reach(part, dt_s)

    def residual(pressure: Tensor) -> Tensor:
        return error(arm.foresee(part, pressure, dt_s), target)

    pressure = least_squares(residual, part.pressure + offset, low, high)
    return pressure, residual(pressure).norm(dim=1)
