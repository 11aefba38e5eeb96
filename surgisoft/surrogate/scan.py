"""Recurrences along recordings: play operators, linear lags, nonlinear lags, directions of change.

Each solves y[t] = f(y[t - 1], u[t]) for whole runs (R, T, ...): on a processor and without
gradients as a plain compiled loop, otherwise as a parallel scan that can be differentiated.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from surgisoft.compiled import compiled


@compiled
def clamp_loop(low: np.ndarray, high: np.ndarray, start: np.ndarray, out: np.ndarray) -> None:
    """y[r, t, c] = clamp(y[r, t - 1, c], low, high) into out; start (R, C), the rest (R, T, C).

    A bound that is not a number makes the result not a number.
    """
    for r in range(out.shape[0]):
        for t in range(out.shape[1]):
            for c in range(out.shape[2]):
                last = start[r, c] if t == 0 else out[r, t - 1, c]
                bottom, top = low[r, t, c], high[r, t, c]
                value = last if last > bottom else bottom
                value = value if value < top else top
                out[r, t, c] = value if last == last and bottom == bottom else last + bottom


@compiled
def play_loop(signal: np.ndarray, radius: np.ndarray, start: np.ndarray, out: np.ndarray) -> None:
    """`clamp_loop` between signal - radius and signal + radius, for signals that share radii.

    signal (R, T, ...), radius (J,), start (R, ..., J) and out (R, T, ..., J).
    """
    runs, steps, radii = out.shape[0], out.shape[1], len(radius)
    loads = signal.reshape(runs, steps, -1)
    plays = out.reshape(runs, steps, -1, radii)
    first = start.reshape(runs, -1, radii)
    for r in range(runs):
        before = first[r]
        for t in range(steps):
            after = plays[r, t]
            for c in range(loads.shape[2]):
                load = loads[r, t, c]
                for j in range(radii):
                    last, bottom, top = before[c, j], load - radius[j], load + radius[j]
                    value = last if last > bottom else bottom
                    value = value if value < top else top
                    after[c, j] = value if last == last and bottom == bottom else last + bottom
            before = after


@compiled
def linear_loop(factor: np.ndarray, addend: np.ndarray, start: np.ndarray, out: np.ndarray) -> None:
    """y[r, t, c] = factor y[r, t - 1, c] + addend into out; start (R, C), the rest (R, T, C)."""
    for r in range(out.shape[0]):
        for t in range(out.shape[1]):
            for c in range(out.shape[2]):
                last = start[r, c] if t == 0 else out[r, t - 1, c]
                out[r, t, c] = factor[r, t, c] * last + addend[r, t, c]


def _looped(loop, bands: tuple[Tensor, Tensor], start: Tensor) -> Tensor | None:
    """A recurrence (R, T, ...) by a compiled loop; None where that does not apply."""
    parts = (*bands, start)
    wanted = torch.is_grad_enabled() and any(part.requires_grad for part in parts)
    plain = all(p.device.type == "cpu" and p.dtype == start.dtype for p in parts)
    if wanted or not plain or start.dtype not in (torch.float32, torch.float64):
        return None
    bands = torch.broadcast_tensors(*bands)
    shape = bands[0].shape
    out = start.new_empty(shape)
    rows = [p.detach().reshape(*shape[:2], -1).numpy() for p in bands]
    first = start.detach().expand(shape[0], *shape[2:]).reshape(shape[0], -1).numpy()
    loop(*rows, first, out.view(*shape[:2], -1).numpy())
    return out


def stepped(
    loop: Callable[..., None],
    rows: tuple[Tensor, ...],
    constants: tuple[Tensor, ...],
    start: Tensor,
) -> Tensor | None:
    """A memory (R, T, ...) that a compiled loop steps; None where that does not apply.

    It does not with gradients or on another device. loop: function of rows (R, T, ...), constants,
    memory before the first row (R, ...) and the array that it fills.
    """
    parts = (*rows, *constants, start)
    wanted = torch.is_grad_enabled() and any(part.requires_grad for part in parts)
    plain = all(p.device.type == "cpu" and p.dtype == start.dtype for p in parts)
    if wanted or not plain or start.dtype not in (torch.float32, torch.float64):
        return None
    out = start.new_empty(*rows[0].shape[:2], *start.shape[1:])
    loop(*(p.detach().contiguous().numpy() for p in parts), out.numpy())
    return out


def clamp_scan(low: Tensor, high: Tensor, start: Tensor) -> Tensor:
    """Recurrence y[:, t] = clamp(y[:, t-1], low[:, t], high[:, t]) with y[:, -1] = start.

    low, high: (R, T, ...); start: (R, ...); returns (R, T, ...).
    """
    looped = _looped(clamp_loop, (low, high), start)
    if looped is not None:
        return looped
    steps = low.shape[1]
    shift = 1
    while shift < steps:
        # Prefix ending at t - shift first, then the one ending at t.
        first_low, first_high = low[:, :-shift], high[:, :-shift]
        then_low, then_high = low[:, shift:], high[:, shift:]
        low = torch.cat(
            [low[:, :shift], torch.minimum(torch.maximum(first_low, then_low), then_high)], dim=1
        )
        high = torch.cat(
            [high[:, :shift], torch.minimum(torch.maximum(first_high, then_low), then_high)], dim=1
        )
        shift *= 2
    return torch.minimum(torch.maximum(start.unsqueeze(1), low), high)


def play_scan(signal: Tensor, radius: Tensor, start: Tensor) -> Tensor:
    """Play operators along a signal: y[:, t] = clamp(y[:, t-1], u - r, u + r).

    Shapes: signal (R, T, ...), radius (...) broadcast to it, start (R, ...). Differentiable: where
    a play last moved, at step s, it is u[s] -+ r, so its gradient is that of a gather at s, and
    that of the start where it has not moved yet.
    """
    plays = None
    if radius.ndim == 1 and signal.ndim > 2 and signal.stride(-1) == 0:
        # Plays of several radii on one signal: nothing as large as the result is made beside it.
        plays = stepped(play_loop, (signal[..., 0],), (radius,), start)
    with torch.no_grad():
        plays = clamp_scan(signal - radius, signal + radius, start) if plays is None else plays
    if not (torch.is_grad_enabled() and (signal.requires_grad or start.requires_grad)):
        return plays
    moved = plays != torch.cat([start.detach().unsqueeze(1), plays[:, :-1]], dim=1)
    steps = torch.arange(signal.shape[1], device=signal.device)
    steps = steps.view(1, -1, *[1] * (signal.ndim - 2)).expand_as(moved)
    last = torch.where(moved, steps, -torch.ones_like(steps)).cummax(dim=1).values
    source = torch.where(
        last >= 0,
        torch.gather(signal.expand_as(plays), 1, last.clamp(min=0)),
        start.unsqueeze(1).expand_as(plays),
    )
    return source + (plays - source.detach())


def last_nonzero(values: Tensor) -> Tensor:
    """Latest value along dim 1 that is not zero, at each step; 0 before the first.

    Shape (R, T, ...) in and out.
    """
    steps = torch.arange(values.shape[1], device=values.device)
    steps = steps.view(1, -1, *[1] * (values.ndim - 2)).expand_as(values)
    index = torch.where(values != 0, steps, torch.zeros_like(steps)).cummax(dim=1).values
    return torch.gather(values, 1, index)


def linear_scan(factor: Tensor, addend: Tensor, start: Tensor) -> Tensor:
    """Recurrence y[:, t] = factor[:, t] y[:, t-1] + addend[:, t] with y[:, -1] = start.

    addend: (R, T, ...); factor: broadcast to it, with its (R, T); start: (R, ...); returns
    (R, T, ...). Real or complex, differentiable; with |factor| <= 1 no intermediate grows. Affine
    maps compose to affine maps (Blelloch 1990, "Prefix sums and their applications", sec. 1.4):
    all blocks of about sqrt(T) rows are stepped at once, then the blocks one after the other.
    """
    looped = _looped(linear_loop, (factor, addend), start)
    if looped is not None:
        return looped
    runs, steps = addend.shape[:2]
    block = max(1, math.isqrt(steps))
    blocks = -(-steps // block)
    if padding := blocks * block - steps:
        factor = torch.cat([factor, factor[:, -1:].expand(-1, padding, *factor.shape[2:])], 1)
        addend = torch.cat([addend, addend[:, -1:].expand(-1, padding, *addend.shape[2:])], 1)
    factor = factor.reshape(runs, blocks, block, *factor.shape[2:])
    addend = addend.reshape(runs, blocks, block, *addend.shape[2:])
    within = [addend[:, :, 0]]
    for scale, plus in zip(factor.unbind(2)[1:], addend.unbind(2)[1:], strict=True):
        within.append(scale * within[-1] + plus)
    share = factor.cumprod(2)
    before = [start]
    for factor_of_block, last in zip(share[:, :, -1].unbind(1), within[-1].unbind(1), strict=True):
        before.append(factor_of_block * before[-1] + last)
    whole = torch.stack(within, 2) + share * torch.stack(before[:-1], 1).unsqueeze(2)
    return whole.flatten(1, 2)[:, :steps]


def follow(
    decayed: Callable[[Tensor], tuple[Tensor, Tensor]],
    target: Tensor,
    start: Tensor,
    tolerance: Tensor | float,
) -> Tensor:
    """Recurrence y[:, t] = target[:, t] - left(target[:, t] - y[:, t-1]) with y[:, -1] = start.

    decayed: function that gives what a row leaves of a gap (R, T, m), and its derivative by the
    gap. target: (R, T, m); start: (R, m); returns (R, T, m).

    Newton's method on the whole recording (Lim et al. 2024, "Parallelizing non-linear sequential
    models over the sequence length"): around the last iterate a row's map of the row before is
    affine, and one scan solves all of them. After k passes the first k rows are those of stepping;
    a handful of passes are enough: they end where nothing moves by more than the tolerance. The
    last pass, at the solution, carries the gradients.
    """

    def solve(lagged: Tensor) -> Tensor:
        before = torch.cat([start.detach().unsqueeze(1), lagged[:, :-1]], dim=1)
        left, slope = decayed(target - before)
        slope = slope.detach()
        return linear_scan(slope, target - left - slope * before, start)

    with torch.no_grad():
        lagged, converged = target, torch.zeros_like(target[:, :1, :1], dtype=torch.bool)
        for _ in range(target.shape[1]):
            last, lagged = lagged, torch.where(converged, lagged, solve(lagged))
            moved = ((lagged - last).abs() > tolerance).flatten(1).any(1)
            converged = converged | ~moved.view(-1, 1, 1)
            if bool(converged.all()):
                break
    return solve(lagged.detach())


def direction_step(
    anchor: Tensor, direction: Tensor, pressure: Tensor, band: Tensor
) -> tuple[Tensor, Tensor]:
    """Confirmed actuation and direction of change (B, m) after a new actuation (B, m).

    The direction is +1 for rising, -1 for falling actuation (Chen et al. 2025, eq. 1) and keeps its
    last value while the actuation rests. A sensor never rests quite, so a move counts only once it
    leaves a dead band around the last confirmed one: a play operator of half width `band` (m,),
    whose motion gives the sign. Before the first confirmed move the direction is 0.
    """
    moved = anchor.clamp(pressure - band, pressure + band)
    sign = (moved - anchor).sign()
    return moved, sign.where(sign != 0, direction)


def direction_scan(pressure: Tensor, band: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
    """Confirmed actuation and direction of change (R, T, m) along actuations (R, T, m).

    `direction_step` over whole runs, each of which starts from rest (m,) without a direction.
    """
    start = rest.expand(len(pressure), -1)
    anchor = clamp_scan(pressure - band, pressure + band, start)
    sign = anchor.diff(dim=1, prepend=start.unsqueeze(1)).sign()
    return anchor, last_nonzero(sign)
