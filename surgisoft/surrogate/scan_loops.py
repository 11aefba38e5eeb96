"""Recurrences along recordings as plain compiled loops, for processors and without gradients."""

from __future__ import annotations

from surgisoft.compiled import compiled


@compiled
def clamp_loop(low, high, start, out):
    """y[r, t, c] = clamp(y[r, t - 1, c], low, high) into out; start (R, C), the rest (R, T, C).

    A bound that is not a number makes the answer none.
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
def linear_loop(factor, addend, start, out):
    """y[r, t, c] = factor y[r, t - 1, c] + addend into out; start (R, C), the rest (R, T, C)."""
    for r in range(out.shape[0]):
        for t in range(out.shape[1]):
            for c in range(out.shape[2]):
                last = start[r, c] if t == 0 else out[r, t - 1, c]
                out[r, t, c] = factor[r, t, c] * last + addend[r, t, c]
