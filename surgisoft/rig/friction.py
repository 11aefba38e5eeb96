"""Rate-independent friction between fibres and wall: a Preisach memory of each wall fibre's strain.

The wall is divided into lines along the arm. Sliding fibres make the stress of a line depend on
the history of its strain through the Preisach plane (Preisach 1935; Mayergoyz 1986): relays that
switch up at strain `a` and down at `b`, with h = (a - b) / 2 and centre c = (a + b) / 2, have the
density

    q(h) r(c),   q(h) = exp(-h / s) / s,   r(c) = 1 + r1 c + r2 c^2.

The factor r makes friction grow where the fibres are taut; with it the density is not the one of
play operators, whose relays are equally dense at every c. Only the turning points of the strain
are kept (Mayergoyz 1986): the closed forms below integrate the density over triangles.
"""

import math

import numpy as np

from surgisoft.compiled import compiled

DEPTH = 64
"""Turning points that a line can remember; a deeper history loses its smallest loop."""


@compiled
def _weighted_powers(width, slip):
    """Integrals over h from 0 to `width` of q(h) (width - h)^n for n = 1, 2, 3."""
    if width <= 0.0:
        return 0.0, 0.0, 0.0
    rise = -math.expm1(-width / slip)
    first = width - slip * rise
    second = width * width - 2.0 * slip * first
    third = width**3 - 3.0 * slip * second
    return first, second, third


@compiled
def everett(upper: float, lower: float, slip: float, slope: float, bow: float) -> float:
    """Everett (1955) integral: the density over the triangle lower <= b <= a <= upper.

    upper, lower: strains [-]; slip: s [-]; slope: r1 [-]; bow: r2 [-].
    """
    centre = 0.5 * (upper + lower)
    first, _, third = _weighted_powers(0.5 * (upper - lower), slip)
    return 4.0 * (1.0 + slope * centre + bow * centre**2) * first + 4.0 / 3.0 * bow * third


@compiled
def virgin(strain: float, slip: float, slope: float, bow: float) -> float:
    """Output on the first loading of a rested wall, whose relays are up where c < 0.

    strain: [-]; the relays between c = 0 and the strain have switched, each by 2.
    """
    first, second, third = _weighted_powers(abs(strain), slip)
    odd = 4.0 * (first + bow / 3.0 * third)
    even = 2.0 * slope * second
    return odd + even if strain >= 0.0 else even - odd


@compiled
def move(line: int, strain: float, last: np.ndarray, depth: np.ndarray, stack: np.ndarray) -> None:
    """Move the strain of one fibre to a new value: reversal points are added and wiped out.

    last: (J,) strain before; depth: (J,) number of turning points; stack: (J, DEPTH) turning
    points, oldest first; all three are updated. Between two calls the strain moved monotonically.
    """
    before = last[line]
    if strain == before:
        return
    count = depth[line]
    start = stack[line, count - 1] if count > 0 else 0.0
    if (strain > before and before < start) or (strain < before and before > start):
        if count == DEPTH:
            count -= 2
        stack[line, count] = before
        count += 1
    count = _wipe_out(line, strain, count, stack)
    depth[line] = count
    last[line] = strain


@compiled
def _wipe_out(line, strain, count, stack):
    """Drop the turning points that the new strain has passed; the number that remain."""
    while count >= 2:
        rising = strain > stack[line, count - 1]
        bound = stack[line, count - 2]
        if (rising and strain < bound) or (not rising and strain > bound):
            return count
        count -= 2
    if count == 1 and abs(strain) >= abs(stack[line, 0]):
        count = 0
    return count


@compiled
def lag(
    line: int,
    last: np.ndarray,
    depth: np.ndarray,
    stack: np.ndarray,
    slip: float,
    slope: float,
    bow: float,
) -> float:
    """How far the output of one line lags behind its frictionless value [-]: the friction.

    Positive while the strain rises. last, depth, stack as in `move`; slip, slope, bow: density.
    """
    strain = last[line]
    free = 4.0 * (strain + slope / 2.0 * strain**2 + bow / 3.0 * strain**3)
    count = depth[line]
    if count == 0:
        return free - virgin(strain, slip, slope, bow)
    before = stack[line, 0]
    output = virgin(before, slip, slope, bow)
    for k in range(1, count + 1):
        after = stack[line, k] if k < count else strain
        if after > before:
            output += 2.0 * everett(after, before, slip, slope, bow)
        else:
            output -= 2.0 * everett(before, after, slip, slope, bow)
        before = after
    return free - output


def rested(lines: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Memory of a rested wall: last (J,) strain, depth (J,), stack (J, DEPTH)."""
    return np.zeros(lines), np.zeros(lines, np.int64), np.zeros((lines, DEPTH))
