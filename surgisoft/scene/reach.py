"""The shapes that an arm can take, as a sampled table, and inverse kinematics on that table.

This module is geometry only. The table is sampled from any arm model over a grid of its commands.
"""

from dataclasses import dataclass
from functools import cached_property, reduce
from itertools import product
from operator import mul

import numpy as np

from surgisoft.errors import InputError
from surgisoft.scene import frames

ROUNDS = 12
"""Most Gauss-Newton steps of the inverse kinematics; a smooth arm needs three or four."""
AIMED_MM = 0.02
"""The tool's axis counts as on its target if it passes this near (mm)."""


@dataclass(frozen=True, eq=False)
class ArmReach:
    """Shapes of one arm over a regular grid of commands, base frame (z along the arm at rest)."""

    axes: tuple[np.ndarray, ...]
    """P ascending arrays: the commands along each axis of the grid, any unit."""
    centreline_mm: np.ndarray
    """(N, K, 3) mm, base to tip; N = product of the axes' lengths, last axis running fastest."""
    tip_direction: np.ndarray
    """(N, 3) unit vectors along the tool's axis."""
    rest: np.ndarray
    """(P,) commands at rest."""
    radius_mm: float
    """Radius of the body (mm)."""

    def __post_init__(self):
        axes = tuple(np.asarray(axis, dtype=np.float64) for axis in self.axes)
        count = int(np.prod([len(axis) for axis in axes]))
        if any(len(axis) < 2 or np.any(np.diff(axis) <= 0) for axis in axes) or not axes:
            raise InputError("reach table: each axis needs at least 2 rising commands")
        line = np.asarray(self.centreline_mm, dtype=np.float64)
        tip = np.asarray(self.tip_direction, dtype=np.float64)
        if line.ndim != 3 or line.shape[0] != count or line.shape[2] != 3 or line.shape[1] < 2:
            raise InputError(
                f"reach table: centrelines have shape {line.shape}; expected ({count}, K, 3)"
            )
        if tip.shape != (count, 3):
            raise InputError(
                f"reach table: tip directions have shape {tip.shape}; expected ({count}, 3)"
            )
        if not (np.isfinite(line).all() and np.isfinite(tip).all()):
            raise InputError("reach table: holds NaN or infinite shapes; expected finite ones")
        object.__setattr__(self, "axes", axes)
        object.__setattr__(self, "centreline_mm", line)
        object.__setattr__(self, "tip_direction", frames.normalise(tip))
        object.__setattr__(self, "rest", np.asarray(self.rest, dtype=np.float64))

    @cached_property
    def commands(self) -> np.ndarray:
        """(N, P): the command of each sampled shape."""
        return np.stack([g.reshape(-1) for g in np.meshgrid(*self.axes, indexing="ij")], axis=1)

    @cached_property
    def bounds(self) -> np.ndarray:
        """(2, P): lowest and highest command."""
        return np.array([[axis[0] for axis in self.axes], [axis[-1] for axis in self.axes]])

    @cached_property
    def span(self) -> np.ndarray:
        """(P,): range of each command."""
        return self.bounds[1] - self.bounds[0]

    @cached_property
    def _tip_table(self) -> np.ndarray:
        """(N, 6): tip position (mm) and direction of each sampled shape."""
        return np.concatenate((self.centreline_mm[:, -1], self.tip_direction), axis=1)

    @cached_property
    def _line_table(self) -> np.ndarray:
        """(N, 3 K + 3): the centreline (mm) and tip direction of each sampled shape."""
        flat = self.centreline_mm.reshape(len(self.centreline_mm), -1)
        return np.concatenate((flat, self.tip_direction), axis=1)

    def _blend(self, table: np.ndarray, commands: np.ndarray) -> np.ndarray:
        """Multilinear interpolation of table rows at commands (M, P), clipped to the grid."""
        shape = tuple(len(axis) for axis in self.axes)
        first, shares = np.zeros(len(commands), np.int64), []
        for axis, value in zip(self.axes, commands.T, strict=True):
            cell = np.searchsorted(axis, value, side="right") - 1
            cell = np.minimum(np.maximum(cell, 0), len(axis) - 2)
            part = (value - axis[cell]) / (axis[cell + 1] - axis[cell])
            part = np.minimum(np.maximum(part, 0.0), 1.0)
            first = first * len(axis) + cell
            shares.append((1.0 - part, part))
        result = np.zeros((len(commands), table.shape[1]))
        for corner in product((0, 1), repeat=len(self.axes)):
            weight = reduce(mul, (share[c] for share, c in zip(shares, corner, strict=True)))
            rows = table.take(first + np.ravel_multi_index(corner, shape), axis=0)
            result += weight[:, None] * rows
        return result

    def tips(self, commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Tip positions (M, 3) mm and directions (M, 3), base frame, at commands (M, P)."""
        row = self._blend(self._tip_table, commands)
        return row[:, :3], frames.normalise(row[:, 3:])

    def shapes(self, commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Centrelines (M, K, 3) mm and tip directions (M, 3), base frame, at commands (M, P)."""
        row = self._blend(self._line_table, commands)
        return row[:, :-3].reshape(len(commands), -1, 3), frames.normalise(row[:, -3:])


@dataclass(frozen=True, eq=False)
class AimSolution:
    """Result of the inverse kinematics: commands that point the tool's axis at targets."""

    commands: np.ndarray
    """(M, P) commands within the arm's range."""
    miss_mm: np.ndarray
    """(M,) distance from the target to the tool's axis (mm)."""
    ahead_mm: np.ndarray
    """(M,) distance from the tip to the target along the axis (mm); negative is behind."""

    @property
    def on_target(self) -> np.ndarray:
        """(M,) bool: the axis passes through the target, which lies ahead of the tip."""
        return (self.miss_mm <= AIMED_MM) & (self.ahead_mm > 0.0)


def _miss(reach: ArmReach, commands: np.ndarray, targets_mm: np.ndarray):
    """Vector (M, 3) from the tool's axis to the targets, how far ahead (M,), the axis (M, 3)."""
    tip, direction = reach.tips(commands)
    away = targets_mm - tip
    ahead = frames.dot(away, direction)
    return away - ahead[:, None] * direction, ahead, direction


def solve_aim(reach: ArmReach, targets_mm: np.ndarray, start: np.ndarray) -> AimSolution:
    """Inverse kinematics: commands at which the tool's axis runs through targets (M, 3) mm.

    Targets are in the base frame.

    Damped Gauss-Newton from commands `start` (M, P), smallest change of commands first (Nocedal &
    Wright, 2006, section 10.3), clipped to the arm's range. M arms are solved at once.
    """
    commands = np.clip(start, *reach.bounds)
    count = commands.shape[1]
    step = 1e-3 * reach.span
    miss, ahead, axis = _miss(reach, commands, targets_mm)
    for _ in range(ROUNDS):
        todo = np.flatnonzero(np.linalg.norm(miss, axis=1) > 0.1 * AIMED_MM)
        if not len(todo):
            break
        here = commands[todo]
        inward = np.where(here + step > reach.bounds[1], -step, step)
        moved = here[:, None, :] + inward[:, :, None] * np.eye(count)
        shifted, _, _ = _miss(
            reach, moved.reshape(-1, count), np.repeat(targets_mm[todo], count, axis=0)
        )
        change = shifted.reshape(-1, count, 3) - miss[todo][:, None, :]
        jacobian = np.swapaxes(change / (inward / reach.span)[:, :, None], 1, 2)
        # along the axis nothing can be missed: only what moves the axis sideways counts
        along = np.einsum("mi,mip->mp", axis[todo], jacobian)
        jacobian -= axis[todo][:, :, None] * along[:, None, :]
        change = _smallest_change(jacobian, miss[todo])
        stuck = ((here <= reach.bounds[0]) & (change < 0)) | (
            (here >= reach.bounds[1]) & (change > 0)
        )
        if stuck.any():
            change = _smallest_change(jacobian * ~stuck[:, None, :], miss[todo])
        length = np.linalg.norm(change, axis=1, keepdims=True)
        change = change * np.minimum(1.0, 0.25 / np.maximum(length, 1e-12))
        commands[todo] = np.clip(here + change * reach.span, *reach.bounds)
        miss[todo], ahead[todo], axis[todo] = _miss(reach, commands[todo], targets_mm[todo])
    return AimSolution(commands, np.linalg.norm(miss, axis=1), ahead)


def _smallest_change(jacobian: np.ndarray, miss: np.ndarray) -> np.ndarray:
    """(M, P) smallest change that removes misses (M, 3), by damped normal equations."""
    gram = jacobian @ np.swapaxes(jacobian, 1, 2) + 1e-3 * np.eye(3)
    return -(np.swapaxes(jacobian, 1, 2) @ np.linalg.solve(gram, miss[:, :, None]))[:, :, 0]


def nearest_commands(
    reach: ArmReach, targets_mm: np.ndarray, range_mm: tuple[float, float]
) -> np.ndarray:
    """Commands (M, P) of the sampled shapes whose axes pass nearest to targets (M, 3), base frame.

    Among those within 2 mm more of the nearest, the one closest to rest; the target must lie
    within `range_mm` (nearest, farthest) ahead of the tip, if any shape manages that.
    """
    tip, direction = reach.centreline_mm[:, -1], reach.tip_direction
    from_rest = np.linalg.norm((reach.commands - reach.rest) / reach.span, axis=1)
    chosen = np.empty(len(targets_mm), dtype=np.int64)
    for i, target in enumerate(targets_mm):
        away = target - tip
        ahead = frames.dot(away, direction)
        miss = np.sqrt(np.maximum(frames.dot(away, away) - ahead**2, 0.0))
        miss = miss + np.maximum(range_mm[0] - ahead, 0.0) + np.maximum(ahead - range_mm[1], 0.0)
        near = np.flatnonzero(miss <= miss.min() + 2.0)
        chosen[i] = near[np.argmin(from_rest[near])]
    return reach.commands[chosen].copy()


def solve_touch(reach: ArmReach, targets_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse kinematics of the tip's place: commands (M, P), and the tip's distances (M,) mm.

    Targets (M, 3) mm are in the base frame. Damped Gauss-Newton from the nearest sampled tip, as in
    `solve_aim`.
    """
    away = np.linalg.norm(reach.centreline_mm[:, -1] - targets_mm[:, None], axis=-1)
    commands = reach.commands[away.argmin(axis=1)].copy()
    step = 1e-3 * reach.span
    miss = reach.tips(commands)[0] - targets_mm
    for _ in range(ROUNDS):
        if np.linalg.norm(miss, axis=1).max() <= AIMED_MM:
            break
        inward = np.where(commands + step > reach.bounds[1], -step, step)
        moved = commands[:, None, :] + inward[:, :, None] * np.eye(commands.shape[1])
        tips = reach.tips(moved.reshape(-1, commands.shape[1]))[0].reshape(*moved.shape[:2], 3)
        slope = (tips - targets_mm[:, None] - miss[:, None]) / (inward / reach.span)[:, :, None]
        change = _smallest_change(np.swapaxes(slope, 1, 2), miss)
        length = np.linalg.norm(change, axis=1, keepdims=True)
        change = change * np.minimum(1.0, 0.25 / np.maximum(length, 1e-12))
        tried = np.clip(commands + change * reach.span, *reach.bounds)
        left = reach.tips(tried)[0] - targets_mm
        better = np.linalg.norm(left, axis=1) < np.linalg.norm(miss, axis=1)
        commands = np.where(better[:, None], tried, commands)
        miss = np.where(better[:, None], left, miss)
    return commands, np.linalg.norm(miss, axis=1)
