"""The update of the Kalman filter of `adaptation` for all arms of a batch, compiled.

The covariance of one arm stays in the processor's cache from the first product to the last, and
symmetric products are computed for one half. `adaptation` has the same equations as tensor
operations: they are the reference, and serve other devices, gradients and exports. Arrays are
float32, and what is computed between them float64, as there.
"""

from __future__ import annotations

import math

import numpy as np

from surgisoft.compiled import compiled

TOGETHER = 4
"""Rows of a matrix that are added up in one pass over the result (a count): fewer stores."""


@compiled(reorder=True)
def learn(
    inputs,
    covariance,
    surprise,
    unrest,
    noise,
    shapes,
    rules,
    keep,
    growth,
    stirs,
    change,
    after,
    stirred,
):
    """Change of the mean, next covariance and next variance of transients of B arms.

    See `DisturbanceEstimator.updated`. inputs (B, D, k) mm; covariance (B, k, k), symmetric;
    surprise (B, D) mm; unrest (B,); noise: variance of a measured coordinate, mm^2. shapes (M, D),
    rows of unit length: the directions in which innovations are compared with their variance.
    rules: step over the time constant of `unrest`, expected and largest ratio, least and largest
    `unrest`. keep, growth, stirs (k,): factor of a state in a step, and what its variance grows by,
    always and for `unrest` = 1. Fills change (B, k), after (B, k, k) and stirred (B,).
    """
    count, size, k = inputs.shape
    across, power = np.empty((size, k)), np.empty((size, size))
    rows, white, grown = np.empty((size, k)), np.empty(size), np.empty(k)
    rate, innovation, startling, quietest, liveliest = rules
    for b in range(count):
        for d in range(size):
            for j in range(k):
                rows[d, j] = inputs[b, d, j]
        _product(rows, covariance[b], across)
        for d in range(size):
            for e in range(d + 1):
                total = 0.0
                for j in range(k):
                    total += across[d, j] * rows[e, j]
                power[d, e] = power[e, d] = total
            power[d, d] += noise
        ratio = _strength(shapes, surprise[b], power)
        beyond = min(ratio, startling) / innovation - 1.0
        stirred[b] = min(max(unrest[b] * math.exp(rate * beyond), quietest), liveliest)
        _whiten(power, surprise[b], across, white)
        for j in range(k):
            change[b, j] = 0.0
        for d in range(size):
            for j in range(k):
                change[b, j] += white[d] * across[d, j]
        for i in range(k):
            grown[i] = growth[i] + stirred[b] * stirs[i]
        _subtract(covariance[b], across, keep, grown, after[b])


@compiled(reorder=True)
def _product(rows, matrix, out):
    """rows (D, k) times a symmetric matrix (k, k), into out (D, k)."""
    size, k = rows.shape
    out[:] = 0.0
    full = k - k % TOGETHER
    for i in range(0, full, TOGETHER):
        for d in range(size):
            a, b, c, e = rows[d, i], rows[d, i + 1], rows[d, i + 2], rows[d, i + 3]
            for j in range(k):
                out[d, j] += (
                    a * matrix[i, j]
                    + b * matrix[i + 1, j]
                    + c * matrix[i + 2, j]
                    + e * matrix[i + 3, j]
                )
    for i in range(full, k):
        for d in range(size):
            for j in range(k):
                out[d, j] += rows[d, i] * matrix[i, j]


@compiled(reorder=True)
def _strength(shapes, surprise, power):
    """Mean over the shapes (M, D) of an innovation's square over its variance."""
    total = 0.0
    for shape in shapes:
        found = expected = 0.0
        for d in range(len(shape)):
            found += shape[d] * surprise[d]
            row = 0.0
            for e in range(len(shape)):
                row += power[d, e] * shape[e]
            expected += shape[d] * row
        total += found * found / expected
    return total / len(shapes)


@compiled(reorder=True)
def _whiten(power, surprise, across, white):
    """Solve by the Cholesky factor L of power (D, D): white = L^-1 surprise, across = L^-1 across.

    across (D, k) is changed in place; power's lower triangle becomes L.
    """
    size, k = across.shape
    for d in range(size):
        value = surprise[d]
        for e in range(d):
            total = power[d, e]
            for f in range(e):
                total -= power[d, f] * power[e, f]
            power[d, e] = part = total / power[e, e]
            value -= part * white[e]
            for j in range(k):
                across[d, j] -= part * across[e, j]
        total = power[d, d]
        for e in range(d):
            total -= power[d, e] * power[d, e]
        power[d, d] = math.sqrt(total)
        each = 1.0 / power[d, d]
        white[d] = each * value
        for j in range(k):
            across[d, j] *= each


@compiled(reorder=True)
def _subtract(matrix, rows, keep, grown, out):
    """keep (matrix - rows' rows) keep + grown, of a symmetric matrix (k, k), into out (k, k).

    rows: (D, k); D is a multiple of 3, as there are that many coordinates. keep and grown (k,) are
    diagonals. One rounding to float32: of two, over many steps, an error of `grown` would be left.
    """
    size, k = rows.shape
    row = np.empty(k)
    for i in range(k):
        for j in range(i + 1):
            row[j] = matrix[i, j]
        for d in range(0, size, 3):
            a, b, c = rows[d, i], rows[d + 1, i], rows[d + 2, i]
            for j in range(i + 1):
                row[j] -= a * rows[d, j] + b * rows[d + 1, j] + c * rows[d + 2, j]
        for j in range(i):
            out[i, j] = row[j] * keep[i] * keep[j]
        out[i, i] = row[i] * keep[i] * keep[i] + grown[i]
    for i in range(k):
        for j in range(i):
            out[j, i] = out[i, j]
