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


@compiled(inner=True)
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


GROUP = 5
"""Points of a centreline that one lookup in the field may rule out together (a count)."""


@compiled
def _least_distance(value, band, slack, most):
    """Lower bound (mm) of the distance where the field has a value, at most `most`.

    Where the surface is nearer than band - 2 slack all eight nodes around are exact. Elsewhere a
    node's value may be too large by twice the way to the next coarse node, which is 8 slack.
    """
    if value <= band - 2.0 * slack:
        return value - slack
    return min(max(band - 2.0 * slack, value - 9.0 * slack), most)


@compiled(inner=True)
def _from_afar(
    line, given, turn, shift, longest, values, origin, cell, band, slack, most, tree, bounds
):
    """Smallest field value at the points of a line (K, 3), and a lower bound of all values (mm).

    One lookup in a group of points may rule out the others: where the distance is at least d, a
    field value r away is at least d - r - slack. The distance is at least that to the body's box,
    too. Consecutive points are no farther apart than `longest`, mm. Values of `most` and above are
    all alike. bounds (G,) is working memory.
    """
    count, groups = len(line), len(bounds)
    estimate, least = most, most
    for g in range(groups):
        first = g * GROUP
        last = min(first + GROUP, count)
        middle = min(first + GROUP // 2, count - 1)
        p = _moved(turn, shift, line[middle])
        reach = max(middle - first, last - 1 - middle) * longest + slack
        bounds[g] = math.sqrt(boxes_d2(p, p, tree[2], tree[3], 0)) - reach
        if bounds[g] >= most:
            continue
        value = field_at(values, origin, cell, p)
        estimate = min(estimate, value if given[middle] else abs(value))
        least = min(least, value)
        bounds[g] = max(bounds[g], _least_distance(value, band, slack, most) - reach)
    for g in range(groups):
        if bounds[g] >= estimate and bounds[g] > 0.0:
            least = min(least, bounds[g])
            continue
        first = g * GROUP
        middle = min(first + GROUP // 2, count - 1)
        for k in range(first, min(first + GROUP, count)):
            if k != middle:
                value = field_at(values, origin, cell, _moved(turn, shift, line[k]))
                estimate = min(estimate, value if given[k] else abs(value))
                least = min(least, value)
    return estimate, least


@compiled(inner=True)
def _line_bounds(line, values_at, lows, values, origin, cell, band, slack):
    """Field values at the points (K,), and lower bounds of the segments' distances (K - 1,), mm.

    line: (K, 3) in the body's frame. On a segment of length L between field values u and v every
    distance is at least (u + v - L) / 2 - slack. Returns the smallest of the bounds.
    """
    lowest = math.inf
    for k in range(len(line)):
        p = (line[k, 0], line[k, 1], line[k, 2])
        values_at[k] = field_at(values, origin, cell, p)
        if k > 0:
            o = (line[k - 1, 0], line[k - 1, 1], line[k - 1, 2])
            ends = min(values_at[k - 1], band) + min(values_at[k], band)
            lows[k - 1] = 0.5 * (ends - _gap(o, p)) - slack
            lowest = min(lowest, lows[k - 1])
    return lowest


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
            d2 = segment_surface_d2(p, q, best * best, tree, nodes, reach, False)
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
    bounds = np.empty((points + GROUP - 1) // GROUP)
    nodes, reach = np.empty(STACK, np.int64), np.empty(STACK)
    for b in range(count):
        pose = b if len(turns) > 1 else 0
        longest, last = 0.0, _point(lines, b, 0)
        total = last[0] + last[1] + last[2]
        for k in range(1, points):
            p = _point(lines, b, k)
            total += p[0] + p[1] + p[2]
            x, y, z = p[0] - last[0], p[1] - last[1], p[2] - last[2]
            longest, last = max(longest, x * x + y * y + z * z), p
        if not math.isfinite(total):
            out[b] = math.nan
            continue
        longest = math.sqrt(longest)
        turn, shift = turns[pose], shifts[pose]
        estimate, least = _from_afar(
            lines[b],
            given,
            turn,
            shift,
            longest,
            values,
            origin,
            cell,
            band,
            slack,
            horizon + radius,
            tree,
            bounds,
        )
        if min(least, band) - 0.5 * longest - slack - radius <= within:
            for k in range(points):
                line[k, 0], line[k, 1], line[k, 2] = _moved(turn, shift, lines[b, k])
            lowest = _line_bounds(line, values_at, lows, values, origin, cell, band, slack)
            if lowest - radius <= within:
                best = min(estimate + slack, horizon + radius)
                estimate = _exact(
                    line,
                    given,
                    best,
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
def longest_steps(lines, longest):
    """Longest step (mm) from each point of lines (B, K, 3) to the next, into longest (K - 1,)."""
    for n in range(len(lines)):
        for k in range(len(longest)):
            length = _gap(_point(lines, n, k), _point(lines, n, k + 1))
            if math.isfinite(length):
                longest[k] = max(longest[k], length)


@compiled
def parts_of_steps(line, longest, most, parts):
    """Parts (K - 1,) into which the steps of a line (K, 3) are divided, and their sum.

    No part is longer than `longest` mm, and no step has more than `most` parts.
    """
    total = 0
    for k in range(len(parts)):
        x, y, z = (
            line[k + 1, 0] - line[k, 0],
            line[k + 1, 1] - line[k, 1],
            line[k + 1, 2] - line[k, 2],
        )
        length = math.sqrt(np.float64(x) * x + np.float64(y) * y + np.float64(z) * z)
        wanted = math.ceil(length / longest) if math.isfinite(length) else 1.0
        parts[k] = int(min(max(wanted, 1.0), np.float64(most)))
        total += parts[k]
    return total


@compiled
def divide_steps(lines, parts, out):
    """Lines (B, K, 3) with the step from point k divided into parts[k], into out (B, K', 3)."""
    for n in range(len(lines)):
        for i in range(3):
            out[n, 0, i] = lines[n, 0, i]
            place = 1
            for k in range(len(parts)):
                a, b = lines[n, k, i], lines[n, k + 1, i]
                for step in range(1, parts[k]):
                    out[n, place, i] = a + (step / parts[k]) * (b - a)
                    place += 1
                out[n, place, i] = b
                place += 1


BLOCK = 4
"""Segments of an arm that one bound rules out together (a count)."""


@compiled
def _blocks(lines, n, fat):
    """How far (mm) the points of each block of segments of line n lie from its chord, into (G,)."""
    segments = lines.shape[1] - 1
    for g in range(len(fat)):
        first, last = g * BLOCK, min((g + 1) * BLOCK, segments)
        p, q = _point(lines, n, first), _point(lines, n, last)
        far = 0.0
        for k in range(first + 1, last):
            o = _point(lines, n, k)
            far = max(far, segments_d2(o, o, p, q))
        fat[g] = math.sqrt(far)


@compiled
def chains_apart(first, second, radii, horizon, out):
    """Clearance (mm) between two arms (B, K, 3), (B, M, 3) into out (B,); radii is their sum.

    A block of segments lies within a known distance of its chord. The pair of blocks whose chords
    are nearest goes first, and what it finds rules out most of the others.
    """
    rows, columns = first.shape[1] - 1, second.shape[1] - 1
    high, wide = (rows + BLOCK - 1) // BLOCK, (columns + BLOCK - 1) // BLOCK
    fat_one, fat_two, bounds = np.empty(high), np.empty(wide), np.empty((high, wide))
    for n in range(len(out)):
        total = first[n].sum() + second[n].sum()
        if not math.isfinite(total):
            out[n] = math.nan
            continue
        _blocks(first, n, fat_one)
        _blocks(second, n, fat_two)
        nearest, at = math.inf, 0
        for g in range(high):
            p = _point(first, n, g * BLOCK)
            q = _point(first, n, min((g + 1) * BLOCK, rows))
            for h in range(wide):
                a = _point(second, n, h * BLOCK)
                b = _point(second, n, min((h + 1) * BLOCK, columns))
                apart = math.sqrt(segments_d2(p, q, a, b))
                bounds[g, h] = apart - fat_one[g] - fat_two[h]
                if bounds[g, h] < nearest:
                    nearest, at = bounds[g, h], g * wide + h
        best = horizon + radii
        for turn in range(-1, high * wide):
            place = at if turn < 0 else turn
            g, h = place // wide, place % wide
            if bounds[g, h] >= best or turn == at:
                continue
            for i in range(g * BLOCK, min((g + 1) * BLOCK, rows)):
                p, q = _point(first, n, i), _point(first, n, i + 1)
                for j in range(h * BLOCK, min((h + 1) * BLOCK, columns)):
                    d2 = segments_d2(p, q, _point(second, n, j), _point(second, n, j + 1))
                    if d2 < best * best:
                        best = math.sqrt(d2)
        out[n] = best - radii


@compiled
def _point(lines, n, k):
    """Point k of line n as a float64 tuple."""
    return np.float64(lines[n, k, 0]), np.float64(lines[n, k, 1]), np.float64(lines[n, k, 2])


@compiled
def chains_folded(lines, radius, gap, horizon, out):
    """Clearance (mm) of arms (B, K, 3) to themselves beyond `gap` mm of arc, into out (B,).

    For each segment the nearest one along the arm that may touch it goes first: on a smooth arm
    that is the nearest at all, and rules out the others.
    """
    segments = lines.shape[1] - 1
    arc, first = np.zeros(segments + 1), np.empty(segments, np.int64)
    for n in range(len(out)):
        for k in range(segments):
            arc[k + 1] = arc[k] + _gap(_point(lines, n, k), _point(lines, n, k + 1))
        if not math.isfinite(arc[segments]):
            out[n] = math.nan
            continue
        best, j = horizon + 2.0 * radius, 0
        for i in range(segments):
            j = max(j, i + 1)
            while j < segments and not arc[j] - arc[i + 1] >= gap:
                j += 1
            first[i] = j
            if j < segments:
                best = _nearer(lines, n, i, j, best)
        for i in range(segments):
            p, half = _point(lines, n, i), arc[i + 1] - arc[i]
            for j in range(first[i] + 1, segments):
                reach = best + half + (arc[j + 1] - arc[j])
                a = _point(lines, n, j)
                x, y, z = a[0] - p[0], a[1] - p[1], a[2] - p[2]
                if x * x + y * y + z * z < reach * reach:
                    best = _nearer(lines, n, i, j, best)
        out[n] = best - 2.0 * radius


@compiled(inner=True)
def _nearer(lines, n, i, j, best):
    """The distance (mm) between segments i and j of line n, or `best` where that is less."""
    d2 = segments_d2(
        _point(lines, n, i), _point(lines, n, i + 1), _point(lines, n, j), _point(lines, n, j + 1)
    )
    return math.sqrt(d2) if d2 < best * best else best


@compiled
def nearest_to_surface(line, turn, shift, bound, slack, tree, found, nodes, reach):
    """Which segments of a line (K, 3) mm come nearest to a body, and at what distance (mm).

    Fills found (2,) with the first and the last segment whose distance is within `slack` of the
    least; returns the least, or `bound` where no segment is nearer than that. turn (3, 3) and
    shift (3,): world to body.
    """
    segments, best = len(line) - 1, bound
    distance = np.empty(segments)
    p = _moved(turn, shift, line[segments])
    for k in range(segments - 1, -1, -1):
        q = _moved(turn, shift, line[k])
        limit = best + slack
        d2 = segment_surface_d2(p, q, limit * limit, tree, nodes, reach, True)
        distance[k] = math.inf if d2 >= limit * limit else math.sqrt(d2)
        best, p = min(best, distance[k]), q
    found[0], found[1] = segments, -1
    for k in range(segments):
        if distance[k] <= best + slack:
            found[0], found[1] = min(found[0], k), k
    return best


@compiled
def nearest_of_chains(one, other, bound, slack, found):
    """Which segments of two lines (K, 3), (M, 3) mm come nearest to one another, and how near (mm).

    Fills found (4,) with the first and the last such segment of each line; otherwise as
    `nearest_to_surface`.
    """
    rows, columns, best = len(one) - 1, len(other) - 1, bound
    distance = np.empty((rows, columns))
    for i in range(rows):
        p, q = _point_of(one, i), _point_of(one, i + 1)
        for j in range(columns):
            d2 = segments_d2(p, q, _point_of(other, j), _point_of(other, j + 1))
            distance[i, j] = math.sqrt(d2)
            best = min(best, distance[i, j])
    found[0], found[1], found[2], found[3] = rows, -1, columns, -1
    for i in range(rows):
        for j in range(columns):
            if distance[i, j] <= best + slack:
                found[0], found[1] = min(found[0], i), i
                found[2], found[3] = min(found[2], j), max(found[3], j)
    return best


@compiled
def nearest_fold(line, gap, bound, found):
    """Which parts of a line (K, 3) mm at least `gap` mm of arc apart come nearest (mm).

    Fills found (2,) with a segment that is nearest to a later one, and with that one; returns their
    distance, or `bound` where no two are nearer than that.
    """
    segments, best = len(line) - 1, bound
    arc = np.zeros(segments + 1)
    for k in range(segments):
        arc[k + 1] = arc[k] + _gap(_point_of(line, k), _point_of(line, k + 1))
    for i in range(segments):
        p, q = _point_of(line, i), _point_of(line, i + 1)
        for j in range(i + 1, segments):
            if arc[j] - arc[i + 1] >= gap:
                d2 = segments_d2(p, q, _point_of(line, j), _point_of(line, j + 1))
                if d2 < best * best:
                    best = math.sqrt(d2)
                    found[0], found[1] = i, j
    return best


@compiled
def _point_of(line, k):
    """Point k of a line as a float64 tuple."""
    return np.float64(line[k, 0]), np.float64(line[k, 1]), np.float64(line[k, 2])


@compiled
def beam_near_chain(origin, aim, range_mm, line, radius, gap, slack):
    """Whether a beam may meet an arm (K, 3) mm; segments within `gap` of the tip do not count.

    False only where the beam stays more than `slack` mm away from every capsule that counts.
    """
    end = (
        origin[0] + range_mm * aim[0],
        origin[1] + range_mm * aim[1],
        origin[2] + range_mm * aim[2],
    )
    start, arc = (origin[0], origin[1], origin[2]), 0.0
    for k in range(len(line) - 2, -1, -1):
        p, q = _point_of(line, k), _point_of(line, k + 1)
        if arc >= gap - slack:
            reach = radius + slack
            if segments_d2(start, end, p, q) <= reach * reach:
                return True
        arc += _gap(p, q)
    return False


@compiled
def beam_near_surface(origin, aim, range_mm, turn, shift, slack, tree, nodes, reach):
    """Whether a beam comes within `slack` mm of a body; turn (3, 3), shift (3,): world to body."""
    p = _moved(turn, shift, origin)
    q = _moved(turn, shift, origin + range_mm * aim)
    limit = slack * slack
    return segment_surface_d2(p, q, limit, tree, nodes, reach, True) < limit


@compiled
def beams_beside_chains(origins, aims, ranges, lines, radius, gap, slack, sure):
    """Clear the flags (N,) of beams that may meet an arm (N, K, 3) mm, see `beam_near_chain`."""
    for n in range(len(sure)):
        if sure[n] and beam_near_chain(
            origins[n], aims[n], ranges[n], lines[n], radius, gap, slack
        ):
            sure[n] = False


@compiled
def beams_beside_body(origins, aims, ranges, turn, shift, slack, tree, sure):
    """Clear the flags (N,) of beams that come within `slack` mm of a body; see above."""
    nodes, reach = np.empty(STACK, np.int64), np.empty(STACK)
    for n in range(len(sure)):
        if sure[n] and beam_near_surface(
            origins[n], aims[n], ranges[n], turn, shift, slack, tree, nodes, reach
        ):
            sure[n] = False


@compiled
def beams_inside_faces(ends, faces, bodies, which, turn, shift, triangles, margin, sure):
    """Clear the flags (N,) of beams that end within `margin` mm of an edge of the face they meet.

    ends (N, 3) mm, world frame; faces and bodies (N,); of body number `which`, whose triangles are
    (F, 3, 3) mm in its own frame.
    """
    limit = margin * margin
    for n in range(len(sure)):
        if not sure[n] or bodies[n] != which:
            continue
        p, (a, b, c) = _moved(turn, shift, ends[n]), triangle(triangles, faces[n])
        near = min(segments_d2(p, p, a, b), segments_d2(p, p, b, c), segments_d2(p, p, c, a))
        sure[n] = near >= limit
