"""Lines of sight of many cameras at once, compiled for the CPU.

A line of sight asks less than a ray does: whether anything is in between, not what and where. So
points outside of the picture are left out, the search ends at the first obstacle, and parts of arms
and bodies that lie beside all lines of a camera are ruled out together.
"""

from __future__ import annotations

import math

import numpy as np

from surgisoft.compiled import compiled
from surgisoft.scene.bvh import STACK, line_triangle, triangle
from surgisoft.scene.rays import capsule_entry


@compiled
def points_in_picture(
    eyes, axes, points, normals, lift, half_fov, near, far, ends, wanted, distance, middle
):
    """Which points a camera has in its picture and in focus, and where their middle is.

    eyes, axes (B, 3); points, normals (B, M, 3) mm. Fills the ends of the lines of sight `lift` mm
    above the points (B, M, 3), their lengths (B, M) mm, wanted (B, M) bool, and of the middle
    (B, 2): the angle to the axis, rad, and the distance, mm.
    """
    count = points.shape[1]
    for b in range(len(eyes)):
        ax, ay, az = np.float64(axes[b, 0]), np.float64(axes[b, 1]), np.float64(axes[b, 2])
        ex, ey, ez = np.float64(eyes[b, 0]), np.float64(eyes[b, 1]), np.float64(eyes[b, 2])
        mx, my, mz = 0.0, 0.0, 0.0
        for m in range(count):
            x = points[b, m, 0] + lift * normals[b, m, 0]
            y = points[b, m, 1] + lift * normals[b, m, 1]
            z = points[b, m, 2] + lift * normals[b, m, 2]
            ends[b, m, 0], ends[b, m, 1], ends[b, m, 2] = x, y, z
            mx, my, mz = mx + points[b, m, 0], my + points[b, m, 1], mz + points[b, m, 2]
            x, y, z = x - ex, y - ey, z - ez
            length = math.sqrt(x * x + y * y + z * z)
            distance[b, m] = length
            wanted[b, m] = near <= length <= far and _angle(ax, ay, az, x, y, z) <= half_fov
        mx, my, mz = mx / count - ex, my / count - ey, mz / count - ez
        middle[b, 0] = _angle(ax, ay, az, mx, my, mz)
        middle[b, 1] = math.sqrt(mx * mx + my * my + mz * mz)


@compiled
def _angle(ax, ay, az, bx, by, bz):
    """Angle between two vectors, rad (Kahan 2006: atan2 form)."""
    cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    return math.atan2(math.sqrt(cx * cx + cy * cy + cz * cz), ax * bx + ay * by + az * bz)


@compiled
def _point(lines, b, k):
    """Point k of line b as a float64 tuple."""
    return np.float64(lines[b, k, 0]), np.float64(lines[b, k, 1]), np.float64(lines[b, k, 2])


@compiled
def _point_of(points, b):
    """Point b as a float64 tuple."""
    return np.float64(points[b, 0]), np.float64(points[b, 1]), np.float64(points[b, 2])


@compiled
def _turned(t, x, y, z):
    """Rotation t (3, 3) times a vector, as a tuple."""
    return (
        t[0, 0] * x + t[0, 1] * y + t[0, 2] * z,
        t[1, 0] * x + t[1, 1] * y + t[1, 2] * z,
        t[2, 0] * x + t[2, 1] * y + t[2, 2] * z,
    )


@compiled(inner=True)
def _bundle(eye, ends, wanted, b):
    """Middle of the wanted ends of one camera's lines, and the radius of a ball around them."""
    x, y, z, count = 0.0, 0.0, 0.0, 0
    for m in range(ends.shape[1]):
        if wanted[b, m]:
            x, y, z = x + ends[b, m, 0], y + ends[b, m, 1], z + ends[b, m, 2]
            count += 1
    if count == 0:
        return (0.0, 0.0, 0.0), -1.0
    x, y, z = x / count, y / count, z / count
    radius = 0.0
    for m in range(ends.shape[1]):
        if wanted[b, m]:
            dx, dy, dz = ends[b, m, 0] - x, ends[b, m, 1] - y, ends[b, m, 2] - z
            radius = max(radius, dx * dx + dy * dy + dz * dz)
    return (x, y, z), math.sqrt(radius)


@compiled
def hide_behind_chain(eyes, ends, distance, short, lines, radius, gap, wanted, clear):
    """Clear the flags (B, M) of lines of sight that meet an arm (B, K, 3) of a radius, mm.

    A line counts as far as `short` mm before its end. Segments of the arm within `gap` mm of arc
    from its tip are ignored (a negative gap ignores none).
    """
    segments = lines.shape[1] - 1
    near = np.empty(segments, np.int64)
    for b in range(len(eyes)):
        eye = _point_of(eyes, b)
        centre, ball = _bundle(eye, ends, wanted, b)
        if ball < 0.0:
            continue
        bx, by, bz = centre[0] - eye[0], centre[1] - eye[1], centre[2] - eye[2]
        along2 = max(bx * bx + by * by + bz * bz, 1e-30)
        arc, found = 0.0, 0
        for k in range(segments - 1, -1, -1):
            p, q = _point(lines, b, k), _point(lines, b, k + 1)
            dx, dy, dz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
            before, arc = arc, arc + length
            if before < gap:
                continue
            # All lines lie in the hull of the eye and the ball around their ends, of which no
            # point is farther from the segment eye - centre than the ball's radius.
            x, y, z = 0.5 * (p[0] + q[0]), 0.5 * (p[1] + q[1]), 0.5 * (p[2] + q[2])
            x, y, z = x - eye[0], y - eye[1], z - eye[2]
            share = min(max((x * bx + y * by + z * bz) / along2, 0.0), 1.0)
            x, y, z = x - share * bx, y - share * by, z - share * bz
            reach = radius + ball + 0.5 * length + 1e-9
            if x * x + y * y + z * z <= reach * reach:
                near[found] = k
                found += 1
        if found == 0:
            continue
        for m in range(ends.shape[1]):
            if not clear[b, m]:
                continue
            limit, length = distance[b, m] - short, distance[b, m]
            d = (
                (ends[b, m, 0] - eye[0]) / length,
                (ends[b, m, 1] - eye[1]) / length,
                (ends[b, m, 2] - eye[2]) / length,
            )
            for n in range(found):
                k = near[n]
                p = (
                    np.float64(lines[b, k, 0]),
                    np.float64(lines[b, k, 1]),
                    np.float64(lines[b, k, 2]),
                )
                q = (
                    np.float64(lines[b, k + 1, 0]),
                    np.float64(lines[b, k + 1, 1]),
                    np.float64(lines[b, k + 1, 2]),
                )
                if capsule_entry(eye, d, p, q, radius) < limit:
                    clear[b, m] = False
                    break


@compiled(inner=True)
def _meets(p, d, limit, triangles, starts, lower, upper, nodes):
    """Whether the ray from p along the unit vector d meets a face nearer than `limit`."""
    leaves = len(starts) - 1
    ix = 1.0 / d[0] if d[0] != 0.0 else 1e300
    iy = 1.0 / d[1] if d[1] != 0.0 else 1e300
    iz = 1.0 / d[2] if d[2] != 0.0 else 1e300
    nodes[0], size = 0, 1
    while size > 0:
        size -= 1
        node = nodes[size]
        one, two = (lower[node, 0] - p[0]) * ix, (upper[node, 0] - p[0]) * ix
        first, last = min(one, two), max(one, two)
        one, two = (lower[node, 1] - p[1]) * iy, (upper[node, 1] - p[1]) * iy
        first, last = max(first, min(one, two)), min(last, max(one, two))
        one, two = (lower[node, 2] - p[2]) * iz, (upper[node, 2] - p[2]) * iz
        first, last = max(first, min(one, two)), min(last, max(one, two))
        # Rounding may not lose a box that the ray grazes.
        if first > min(last, limit) + 1e-9 or last < -1e-9:
            continue
        if node < leaves - 1:
            nodes[size], nodes[size + 1] = 2 * node + 1, 2 * node + 2
            size += 2
            continue
        leaf = node - (leaves - 1)
        for k in range(starts[leaf], starts[leaf + 1]):
            a, b, c = triangle(triangles, k)
            if 0.0 <= line_triangle(p, d, a, b, c) < limit:
                return True
    return False


@compiled
def hide_behind_body(eyes, ends, distance, short, turns, shifts, tree, clear):
    """Clear the flags (B, M) of lines of sight that meet a body before their last `short` mm.

    turns (B or 1, 3, 3) and shifts (B or 1, 3): world to body.
    """
    triangles, starts, lower, upper = tree
    nodes = np.empty(STACK, np.int64)
    for b in range(len(eyes)):
        pose = b if len(turns) > 1 else 0
        turn, shift = turns[pose], shifts[pose]
        x, y, z = _point_of(eyes, b)
        turned = _turned(turn, x, y, z)
        eye = (turned[0] + shift[0], turned[1] + shift[1], turned[2] + shift[2])
        for m in range(ends.shape[1]):
            if not clear[b, m]:
                continue
            far = distance[b, m]
            end = _point(ends, b, m)
            d = _turned(turn, (end[0] - x) / far, (end[1] - y) / far, (end[2] - z) / far)
            if _meets(eye, d, far - short, triangles, starts, lower, upper, nodes):
                clear[b, m] = False
