"""Named blocks of an agent's observation, and those that several tasks share.

An observation is the blocks one after the other. A block's name, unit and scaling stand here or at
the top of the task's file; `surgisoft.tasks.describe` lists them with their index ranges.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from surgisoft.tasks.world.arm import Arm, ArmPart

OBSERVATION_LIMIT = 20.0
"""Observations are clipped to plus and minus this; tasks scale theirs to be far below it."""


@dataclass(frozen=True)
class Block:
    """A named block of an observation; two blocks are the same when their names are."""

    name: str
    """Name, unique within an observation."""
    meaning: str = field(compare=False)
    """What is observed."""
    unit: str = field(compare=False)
    """Unit of x before scaling; `-` where it has none."""
    scale: str = field(compare=False)
    """The observed value as a function of x."""
    low: float = field(default=-OBSERVATION_LIMIT, compare=False)
    """Lowest observed value; noise may carry a measured one past it, as far as the clipping."""
    high: float = field(default=OBSERVATION_LIMIT, compare=False)
    """Highest observed value."""


ObservationBlocks = Mapping[Block, Tensor]
"""Block -> (B, k) scaled values, in the order of the observation."""


def joined(blocks: ObservationBlocks) -> Tensor:
    """(B, D): the blocks one after the other."""
    return torch.cat([*blocks.values()], 1)


LARGEST = 1e18
"""Argument beyond which `asinh` no longer grows, so that its square stays finite."""


def asinh(values: Tensor) -> Tensor:
    """asinh of values, on a processor in a quarter of PyTorch's time and equal to rounding.

    asinh x = sign(x) log(1 + |x| + x^2 / (1 + sqrt(1 + x^2))), which loses no digits near 0.
    Programs that are traced for another runtime keep the one operation.
    """
    traced = torch.jit.is_tracing() or torch.compiler.is_compiling()
    if traced or values.device.type != "cpu":
        return values.asinh()
    size = values.abs().clamp(max=LARGEST)
    square = size * size
    return torch.copysign(torch.log1p(size + square / (1.0 + (1.0 + square).sqrt())), values)


def asinh_of(values: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """`asinh` of each of several tensors of one shape (B, k), in one pass over all of them.

    A single environment has few values, and its time goes into the number of operations.
    """
    if torch.jit.is_tracing() or torch.compiler.is_compiling():
        return tuple(value.asinh() for value in values)
    return asinh(torch.cat([*values])).chunk(len(values))


def numbered(block: Block, values: Iterable[Tensor], unit: str = "step") -> ObservationBlocks:
    """One block for each of the values (B, k) of one kind: now, 1 step ahead, 2 steps ahead, ...

    unit: what `ahead` counts.
    """
    return {
        replace(
            block,
            name=f"{block.name}_{ahead}" if ahead else block.name,
            meaning=block.meaning + f", {ahead} {unit}{'s' * (ahead > 1)} ahead" * (ahead > 0),
        ): value
        for ahead, value in enumerate(values)
    }


SHAPE = Block("shape", "measured key points relative to the base, base excluded", "mm", "x / 50")
COMMAND = Block("command", "commanded pressures", "kPa", "range to -1..1", -1.0, 1.0)
PRESSURE = Block("pressure", "measured pressures", "kPa", "range to -1..1", -1.0, 1.0)
DIRECTION = Block("direction", "the model's direction of pressure change", "-", "x", -1.0, 1.0)
REVERSAL = Block(
    "reversal",
    "pressure change since the last direction change, in dead bands; at -1 or 1 the model's "
    "direction reverses and the arm jumps",
    "-",
    "clip(x, -1.5, 1.5)",
    -1.5,
    1.5,
)
TIME = Block("time", "elapsed share of the episode", "-", "x", 0.0, 1.0)


def elapsed(steps: Tensor, of: int) -> Tensor:
    """(B, 1) 0..1: share of an episode of `of` steps after steps (B,); 1 beyond its end, where an
    experiment gives the task more time."""
    return (steps[:, None] / of).clamp(max=1.0)


def free_points(points_mm: Tensor) -> Tensor:
    """(B, k, 3) mm: the key points (B, n, 3) mm without the base, which is the first of several."""
    return points_mm[:, min(1, points_mm.shape[1] - 1) :]


def body_blocks(arm: Arm, part: ArmPart) -> ObservationBlocks:
    """Observation blocks of an arm's body: measured key points and pressures."""
    shape = (free_points(part.steered_mm - arm.pose[:3, 3]) / 50.0).flatten(1)
    return {SHAPE: shape, **pressure_blocks(arm, part)}


def pressure_blocks(arm: Arm, part: ArmPart) -> ObservationBlocks:
    """Commands, measured pressures, directions of change and distances to a reversal, (B, m) each.

    The last two come from the model beside the arm, fed with the arm's pressures (with an observer:
    with the measured ones).
    """
    half = 0.5 * (arm.high - arm.low)
    beside = part.model_beside
    back = (beside.pressure - beside.anchor) / arm.model.band.clamp(min=1e-3)
    return {
        COMMAND: (part.command - arm.low) / half - 1.0,
        PRESSURE: (part.seen_kPa - arm.low) / half - 1.0,
        DIRECTION: beside.direction,
        REVERSAL: back.clamp(-1.5, 1.5),
    }
