"""Pointing an arm's tip at things, and what an arm knows of its own body."""

from __future__ import annotations

import torch
from torch import Tensor

from surgisoft.tasks.solver import least_squares
from surgisoft.tasks.tree import tree_map
from surgisoft.tasks.world import Arm, ArmPart


class Aim:
    """How far an arm's axis passes from a target, and the scripted aim; holds no state."""

    def __init__(self, arm: Arm, dt_s: float):
        self.arm, self.dt_s = arm, dt_s

    def miss(self, points_mm: Tensor, target_mm: Tensor) -> Tensor:
        """(B, 3) mm from the axis to targets (B, 3) mm, across it, for key points (B, n, 3) mm.

        For a target behind the tip the axis ends at the tip.
        """
        aim = self.arm.backbone.tip_direction(points_mm)
        away = target_mm - points_mm[:, -1]
        along = (away * aim).sum(1, keepdim=True).clamp(min=0.0)
        return away - along * aim

    def action(self, part: ArmPart, target_mm: Tensor) -> Tensor:
        """(B, m) kPa: damped least squares for the axis through targets (B, 3) a step from now."""
        with torch.inference_mode(False):
            part, target = tree_map(torch.clone, part), target_mm.clone()
            low, high = self.arm.within_reach(part, self.dt_s)

            def residual(pressure: Tensor) -> Tensor:
                return self.miss(self.arm.foresee(part, pressure, self.dt_s), target)

            wanted = least_squares(residual, part.pressure, low, high)
            return self.arm.action_for(part, wanted, self.dt_s)


def body_part(arm: Arm, part: ArmPart) -> tuple[Tensor, ...]:
    """What an arm knows of itself, each (B, ...): measured shape, commands, pressures, directions.

    The shape is in lengths of 50 mm from the arm's nominal base.
    """
    shape = ((part.seen_mm - arm.pose[:3, 3])[:, 1:] / 50.0).flatten(1)
    return shape, *pressure_part(arm, part)


def pressure_part(arm: Arm, part: ArmPart) -> tuple[Tensor, ...]:
    """Commands, pressures, directions of change and ways back, each (B, m).

    Commands and measured pressures are -1..1 over the range. A way back is how far a pressure has
    come from where its chamber last moved on, in dead bands: beyond -1 or 1 the direction of change
    turns over, and the arm jumps.
    """
    half = 0.5 * (arm.high - arm.low)
    back = (part.arm.pressure - part.arm.anchor) / arm.model.band.clamp(min=1e-3)
    return (
        (part.command - arm.low) / half - 1.0,
        (part.seen_kPa - arm.low) / half - 1.0,
        part.arm.direction,
        back.clamp(-1.5, 1.5),
    )
