"""Whole-body clearance for many environments at once, compiled for the CPU.

`torch_queries` gives the same results on an accelerator. There are two steps for each arm and body:
the distance field gives a lower bound of the arm's clearance; only if that is below
`exact_within_mm` are the segments measured against the triangles.
"""

from __future__ import annotations

import math

import numpy as np

from surgisoft.compiled import compiled
from surgisoft.scene.bvh import (
    STACK,
    boxes_d2,
    line_triangle,
    point_surface,
    segment_surface_d2,
    segments_d2,
    triangle,
)


@compiled
def field_at(values, origin, cell, p):
    """Trilinear value (mm) of the field at a point, inf outside the grid."""
    x, y, z = (p[0] - origin[0]) / cell, (p[1] - origin[1]) / cell, (p[2] - origin[2]) / cell
    nx, ny, nz = values.shape
    if not (0.0 <= x < nx - 1 and 0.0 <= y < ny - 1 and 0.0 <= z < nz - 1):
        return math.inf
    i, j, k = int(x), int(y), int(z)
    u, v, w = x - i, y - j, z - k
    near = (values[i, j, k] * (1 - w) + values[i, j, k + 1] * w) * (1 - v) + (
        values[i, j + 1, k] * (1 - w) + values[i, j + 1, k + 1] * w
    ) * v
    far = (values[i + 1, j, k] * (1 - w) + values[i + 1, j, k + 1] * w) * (1 - v) + (
        values[i + 1, j + 1, k] * (1 - w) + values[i + 1, j + 1, k + 1] * w
    ) * v
    return near * (1 - u) + far * u


@compiled
def _crossings(p, q, triangles, starts, lower, upper):
    """How many faces the segment p q crosses."""
    low = (min(p[0], q[0]), min(p[1], q[1]), min(p[2], q[2]))
    high = (max(p[0], q[0]), max(p[1], q[1]), max(p[2], q[2]))
    step = (q[0] - p[0], q[1] - p[1], q[2] - p[2])
    leaves = len(starts) - 1
    nodes = np.empty(STACK, np.int64)
    nodes[0], size, count = 0, 1, 0
    while size > 0:
        size -= 1
        node = nodes[size]
        if boxes_d2(low, high, lower, upper, node) > 0.0:
            continue
        if node < leaves - 1:
            nodes[size], nodes[size + 1] = 2 * node + 1, 2 * node + 2
            size += 2
            continue
        leaf = node - (leaves - 1)
        for k in range(starts[leaf], starts[leaf + 1]):
            a, b, c = triangle(triangles, k)
            count += 0.0 <= line_triangle(p, step, a, b, c) <= 1.0
    return count


@compiled
def _is_inside(p, distance, values, origin, cell, tree):
    """Whether p, at a known distance from a closed surface, is inside.

    The nearest node of the field is on the same side if it is nearer to p than the surface is.
    Otherwise the faces between the two are counted.
    """
    i = round((p[0] - origin[0]) / cell)
    j = round((p[1] - origin[1]) / cell)
    k = round((p[2] - origin[2]) / cell)
    q = (origin[0] + i * cell, origin[1] + j * cell, origin[2] + k * cell)
    x, y, z = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    inside = values[i, j, k] < 0.0
    if distance * distance <= x * x + y * y + z * z:
        return inside != (_crossings(p, q, tree[0], tree[1], tree[2], tree[3]) % 2 == 1)
    return inside


@compiled
def _moved(turn, shift, point):
    """turn @ point + shift as a tuple; turn (3, 3), shift (3,), point (3,)."""
    x, y, z = np.float64(point[0]), np.float64(point[1]), np.float64(point[2])
    return (
        turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z + shift[0],
        turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z + shift[1],
        turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z + shift[2],
    )


@compiled
def _gap(p, q):
    """Distance between two points given as tuples."""
    x, y, z = q[0] - p[0], q[1] - p[1], q[2] - p[2]
    return math.sqrt(x * x + y * y + z * z)


@compiled
def _line_bounds(line, given, values_at, lows, values, origin, cell, band, slack):
    """Smallest field value at the points, and the smallest lower bound of any segment (mm).

    line: (K, 3) in the body's frame; fills values_at (K,) and the bounds lows (K - 1,). On a
    segment of length L between field values u and v every distance is at least
    (u + v - L) / 2 - slack.
    """
    estimate, lowest = math.inf, math.inf
    for k in range(len(line)):
        p = (line[k, 0], line[k, 1], line[k, 2])
        values_at[k] = field_at(values, origin, cell, p)
        estimate = min(estimate, values_at[k] if given[k] else abs(values_at[k]))
        if k > 0:
            o = (line[k - 1, 0], line[k - 1, 1], line[k - 1, 2])
            ends = min(values_at[k - 1], band) + min(values_at[k], band)
            lows[k - 1] = 0.5 * (ends - _gap(o, p)) - slack
            lowest = min(lowest, lows[k - 1])
    return estimate, lowest


@compiled
def _exact(
    line, given, best, values_at, lows, closed, values, origin, cell, slack, tree, nodes, reach
):
    """Least of the centreline's distance to the surface and its points' signed distances (mm).

    `best` is an upper bound to start with. The segment with the smallest lower bound goes first.
    """
    count = len(lows)
    first = int(np.argmin(lows))
    for n in range(count):
        k = (first + n) % count
        if lows[k] < best and best > 0.0:
            p = (line[k, 0], line[k, 1], line[k, 2])
            q = (line[k + 1, 0], line[k + 1, 1], line[k + 1, 2])
            d2 = segment_surface_d2(
                p, q, best * best, tree[0], tree[1], tree[2], tree[3], nodes, reach
            )
            best = min(best, math.sqrt(d2))
    if not closed:
        return best
    for k in range(len(line)):
        if given[k] and values_at[k] - slack < min(best, 0.0):
            p = (line[k, 0], line[k, 1], line[k, 2])
            bound = abs(values_at[k]) + slack
            d2 = point_surface(p, bound * bound, tree[0], tree[1], tree[2], tree[3])[0]
            depth = math.sqrt(d2)
            if _is_inside(p, depth, values, origin, cell, tree):
                best = min(best, -depth)
    return best


@compiled
def chains_to_surface(
    lines,
    given,
    turns,
    shifts,
    radius,
    within,
    horizon,
    closed,
    values,
    origin,
    cell,
    band,
    slack,
    tree,
    out,
):
    """Signed clearance (mm) of arms to one body into out (B,), nan for an arm that is not finite.

    lines (B, K, 3) world frame, mm; given (K,) bool, the points at which depth counts; turns
    (B or 1, 3, 3) and shifts (B or 1, 3) world to body.
    """
    count, points, _ = lines.shape
    line = np.empty((points, 3))
    values_at, lows = np.empty(points), np.empty(points - 1)
    nodes, reach = np.empty(STACK, np.int64), np.empty(STACK)
    for b in range(count):
        pose = b if len(turns) > 1 else 0
        total = 0.0
        for k in range(points):
            line[k, 0], line[k, 1], line[k, 2] = _moved(turns[pose], shifts[pose], lines[b, k])
            total += line[k, 0] + line[k, 1] + line[k, 2]
        if not math.isfinite(total):
            out[b] = math.nan
            continue
        estimate, lowest = _line_bounds(
            line, given, values_at, lows, values, origin, cell, band, slack
        )
        if lowest - radius <= within:
            least = min(estimate + slack, horizon + radius)
            estimate = _exact(
                line,
                given,
                least,
                values_at,
                lows,
                closed,
                values,
                origin,
                cell,
                slack,
                tree,
                nodes,
                reach,
            )
        out[b] = min(estimate - radius, horizon)


@compiled
def chains_apart(first, second, radii, horizon, out):
    """Clearance (mm) between two arms (B, K, 3), (B, M, 3) into out (B,); radii is their sum."""
    rows, columns = first.shape[1] - 1, second.shape[1] - 1
    middles, halves = np.empty((columns, 3)), np.empty(columns)
    for n in range(len(out)):
        for j in range(columns):
            half = 0.0
            for i in range(3):
                a, b = np.float64(second[n, j, i]), np.float64(second[n, j + 1, i])
                middles[j, i] = 0.5 * (a + b)
                half += (b - a) * (b - a)
            halves[j] = 0.5 * math.sqrt(half)
        best = horizon + radii
        total = first[n].sum() + second[n].sum()
        for i in range(rows):
            p, q = _point(first, n, i), _point(first, n, i + 1)
            middle = (0.5 * (p[0] + q[0]), 0.5 * (p[1] + q[1]), 0.5 * (p[2] + q[2]))
            half = 0.5 * _gap(p, q)
            for j in range(columns):
                x, y, z = (
                    middles[j, 0] - middle[0],
                    middles[j, 1] - middle[1],
                    middles[j, 2] - middle[2],
                )
                reach = best + half + halves[j]
                if x * x + y * y + z * z < reach * reach:
                    d2 = segments_d2(p, q, _point(second, n, j), _point(second, n, j + 1))
                    best = min(best, math.sqrt(d2))
        out[n] = best - radii if math.isfinite(total) else math.nan


@compiled
def _point(lines, n, k):
    """Point k of line n as a float64 tuple."""
    return np.float64(lines[n, k, 0]), np.float64(lines[n, k, 1]), np.float64(lines[n, k, 2])


@compiled
def chains_folded(lines, radius, gap, horizon, out):
    """Clearance (mm) of arms (B, K, 3) to themselves beyond `gap` mm of arc, into out (B,)."""
    segments = lines.shape[1] - 1
    arc = np.zeros(segments + 1)
    for n in range(len(out)):
        for k in range(segments):
            arc[k + 1] = arc[k] + _gap(_point(lines, n, k), _point(lines, n, k + 1))
        best = horizon + 2.0 * radius
        for i in range(segments):
            p, q = _point(lines, n, i), _point(lines, n, i + 1)
            for j in range(i + 1, segments):
                if arc[j] - arc[i + 1] >= gap:
                    a, b = _point(lines, n, j), _point(lines, n, j + 1)
                    reach = best + (arc[i + 1] - arc[i]) + (arc[j + 1] - arc[j])
                    if _gap(p, a) < reach:
                        best = min(best, math.sqrt(segments_d2(p, q, a, b)))
        out[n] = best - 2.0 * radius if math.isfinite(arc[segments]) else math.nan
