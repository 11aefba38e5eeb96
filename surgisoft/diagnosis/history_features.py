"""What a learner without physics may look at: actuation, its past on many time scales, its context.

Three kinds of memory cover what soft robots are known to do: first-order low passes (lag, creep,
relaxation), play operators (hysteresis with minor loops: Kuhnen 2003) and the largest actuation so
far (softening). Nothing here is fitted.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.history import History
from surgisoft.surrogate.scan import direction_scan, last_nonzero, linear_scan, play_scan

TIMES_S = (0.15, 0.5, 1.5, 5.0, 15.0, 50.0, 150.0)
"""Time constants of the low passes, s."""
RADII = (0.03, 0.1, 0.25, 0.5)
"""Radii of the plays, in half ranges of a chamber."""
BLOCK_ROWS = 1 << 16
"""Rows that are followed at once where there are more: what is computed on the way is several times
larger than what is kept."""
SINGLE = ("low_pass", "play")
"""What is kept in single precision of a history of more rows than BLOCK_ROWS: two thirds of a
memory, 0.5 GB at two million rows. The actuation is in single precision, too."""
SHORT_S = 0.25
"""Time constant over which a rate is taken, s: shorter, and it shows the sensor's noise."""


@dataclass(frozen=True, eq=False)
class Memory:
    """Features of the past of each row of a history, (S, ...) rows of all runs in order."""

    pressure: np.ndarray
    """(S, m) actuation, arm's unit."""
    direction: np.ndarray
    """(S, m) direction of change: -1, 0, 1."""
    rate: np.ndarray
    """(S, m) rate of change of the actuation over `SHORT_S`, arm's unit a second."""
    low_pass: np.ndarray
    """(S, m, len(TIMES_S)) low-passed actuation, arm's unit; each run starts settled."""
    play: np.ndarray
    """(S, m, len(RADII)) play operators, arm's unit; each run starts centred."""
    since_reversal: np.ndarray
    """(S, m) way of the actuation since its direction last changed, arm's unit."""
    largest: np.ndarray
    """(S, m) largest actuation so far in the run, arm's unit."""
    dwell_s: np.ndarray
    """(S,) time since any chamber last moved out of its dead band, s."""
    elapsed_s: np.ndarray
    """(S,) time since the start of the recording, s."""
    in_run_s: np.ndarray
    """(S,) time since the start of the run, s."""


def memory_of(history: History, spec: ArmSpec) -> Memory:
    """Follow the actuation of every run of a history, of a long one some runs at a time."""
    runs, steps = history.valid.shape
    wide = max(1, BLOCK_ROWS // steps)
    if wide >= runs:
        return _memory_of(history, spec)
    answer, begin = {}, 0
    for first in range(0, runs, wide):
        some = torch.arange(first, min(first + wide, runs))
        for name, values in vars(_memory_of(history.select(some), spec)).items():
            if name not in answer:
                kept = np.float32 if name in SINGLE else np.float64
                answer[name] = np.empty((int(history.valid.sum()), *values.shape[1:]), kept)
            answer[name][begin : begin + len(values)] = values
        begin += len(values)
    return Memory(**answer)


def _memory_of(history: History, spec: ArmSpec) -> Memory:
    signal = history.pressure.double()
    half = torch.tensor(spec.span, dtype=torch.float64) / 2
    start = signal[:, 0]
    dt = torch.zeros_like(history.t_s)
    dt[:, 1:] = (history.t_s[:, 1:] - history.t_s[:, :-1]).clamp(min=0)
    low = _low_passes(signal, dt, torch.tensor((*TIMES_S, SHORT_S), dtype=torch.float64))
    radius = half[:, None] * torch.tensor(RADII, dtype=torch.float64)
    wide = signal.unsqueeze(-1).expand(*signal.shape, len(RADII))
    play = play_scan(wide, radius, start.unsqueeze(-1).expand(*start.shape, len(RADII)))
    band = torch.tensor(spec.band, dtype=torch.float64)
    anchor, direction = direction_scan(signal, band, torch.tensor(spec.rest, dtype=torch.float64))
    moved = (anchor.diff(dim=1, prepend=anchor[:, :1]) != 0).any(-1)
    last = torch.where(moved, history.t_s, history.t_s[:, :1]).cummax(dim=1).values

    def rows(tensor: Tensor) -> np.ndarray:
        return history.rows(tensor).numpy()

    return Memory(
        pressure=rows(signal),
        direction=rows(direction),
        rate=rows((signal - low[..., -1]) / SHORT_S),
        low_pass=rows(low[..., :-1]),
        play=rows(play),
        since_reversal=rows(_since_reversal(anchor, direction)),
        largest=rows(signal.cummax(dim=1).values),
        dwell_s=rows(history.t_s - last),
        elapsed_s=rows(history.t_s),
        in_run_s=rows(history.t_s - history.t_s[:, :1]),
    )


def _low_passes(signal: Tensor, dt: Tensor, times: Tensor) -> Tensor:
    """(R, T, m, K) first-order low passes, exact for a signal linear between its rows.

    y' = (u - y) / tau: with a = exp(-dt / tau) and g = (1 - a) tau / dt,
    y_1 = a y_0 + (g - a) u_0 + (1 - g) u_1.
    """
    step = dt[:, :, None] / times
    decay = torch.exp(-step)
    gain = torch.where(step > 1e-6, -torch.expm1(-step) / step.clamp(min=1e-6), 1 - step / 2)
    before = torch.cat([signal[:, :1], signal[:, :-1]], dim=1)
    addend = (gain - decay)[:, :, None] * before[..., None]
    addend = addend + (1 - gain)[:, :, None] * signal[..., None]
    start = signal[:, 0, :, None].expand(-1, -1, len(times))
    return linear_scan(decay[:, :, None].expand_as(addend), addend, start)


def _since_reversal(anchor: Tensor, direction: Tensor) -> Tensor:
    """(R, T, m) way of the anchor (R, T, m) since the direction (R, T, m) last changed."""
    before = torch.cat([direction[:, :1], direction[:, :-1]], dim=1)
    turned = direction != before
    way = anchor.diff(dim=1, prepend=anchor[:, :1]).abs().cumsum(dim=1)
    # The way at the row before a turn, kept until the next turn; 1 is added to tell 0 from none.
    mark = torch.where(turned, torch.cat([way[:, :1], way[:, :-1]], dim=1) + 1, torch.zeros(()))
    mark = last_nonzero(mark)
    return way - torch.where(mark > 0, mark - 1, torch.zeros_like(mark))


def features(
    memory: Memory,
    spec: ArmSpec,
    context: np.ndarray | None,
    timed: bool,
    rows: np.ndarray | slice = slice(None),
) -> np.ndarray:
    """(S, F) numbers of order 1 for some rows: all that the residual may depend on.

    memory: that of N rows; context: (N, c) further columns such as temperature, NaN where missing;
    timed: whether rows follow each other in time (not so for settled points, whose order alone
    counts); rows: (S,) those that are asked for, scaled by what all N are.
    """
    half = np.array(spec.span) / 2
    x = memory.pressure[rows] / half
    parts = [x, memory.direction[rows]]
    parts += [memory.play[rows, :, k] / half - x for k in range(memory.play.shape[-1])]
    parts.append(memory.largest[rows] / half - x)
    for elapsed in (memory.elapsed_s, memory.in_run_s):
        scaled = elapsed[rows] / max(float(elapsed.max()), 1e-9)
        parts.append(np.stack([scaled, scaled**2], axis=1))
    if timed:
        parts += [x - memory.low_pass[rows, :, k] / half for k in range(len(TIMES_S))]
        parts.append(np.log1p(memory.dwell_s[rows])[:, None])
    if context is not None and context.shape[1]:
        known = ~np.isnan(context)
        mean = np.where(known, context, 0).sum(0) / np.maximum(known.sum(0), 1)
        parts.append(np.where(known, context, mean)[rows])
    return np.concatenate(parts, axis=1)
