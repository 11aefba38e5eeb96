"""Kernels of NVIDIA Warp: clearance, rays and dose, one thread for each query, or a few.

They walk the same tree and field as the compiled queries of `bvh`, `distance`, `rays` and
`ablation`, in float64, so that results agree to rounding; the formulas and their sources stand
there. Warp translates these functions to C++ and CUDA: `int(0)` declares a variable, `0` a
constant, and float64 constants have names.
"""

import math

from surgisoft.extras import with_advice
from surgisoft.scene.bvh import PARALLEL as PARALLEL_SHARE
from surgisoft.scene.bvh import STACK as STACK_SIZE

with with_advice():
    import warp as wp

wp.config.log_level = wp.LOG_ERROR
wp.init()
wp.set_module_options({"enable_backward": False})

real = wp.float64
vec = wp.vec3d
Stack = wp.types.vector(length=STACK_SIZE, dtype=wp.int32)
Reach = wp.types.vector(length=STACK_SIZE, dtype=wp.float64)
Numbers = wp.array(dtype=wp.float64)
Numbers2 = wp.array2d(dtype=wp.float64)
Points = wp.array(dtype=wp.vec3d)
Points2 = wp.array2d(dtype=wp.vec3d)
Singles = wp.array(dtype=wp.float32)
Singles2 = wp.array2d(dtype=wp.float32)
Labels2 = wp.array2d(dtype=wp.int32)
Whole = wp.array(dtype=wp.int64)
Whole2 = wp.array2d(dtype=wp.int64)

ZERO = wp.constant(wp.float64(0.0))
HALF = wp.constant(wp.float64(0.5))
ONE = wp.constant(wp.float64(1.0))
TWO = wp.constant(wp.float64(2.0))
FAR = wp.constant(wp.float64(math.inf))
NONE = wp.constant(wp.float64(math.nan))
PARALLEL = wp.constant(wp.float64(PARALLEL_SHARE))
SLACK = wp.constant(wp.float64(1e-12))


# Distances of primitives.


@wp.func
def segments_d2(p: vec, q: vec, a: vec, b: vec) -> real:
    """Squared distance of segments p q and a b."""
    d1 = q - p
    d2 = b - a
    r = p - a
    aa = wp.dot(d1, d1)
    ee = wp.dot(d2, d2)
    bb = wp.dot(d1, d2)
    cc = wp.dot(d1, r)
    ff = wp.dot(d2, r)
    aa_safe = wp.where(aa > ZERO, aa, ONE)
    ee_safe = wp.where(ee > ZERO, ee, ONE)
    denominator = aa * ee - bb * bb
    s = real(0.0)
    if denominator > wp.float64(1e-15) * aa * ee:
        s = wp.clamp((bb * ff - cc * ee) / denominator, ZERO, ONE)
    t = wp.clamp((bb * s + ff) / ee_safe, ZERO, ONE)
    s = wp.clamp((bb * t - cc) / aa_safe, ZERO, ONE)
    t = wp.clamp((bb * s + ff) / ee_safe, ZERO, ONE)
    return wp.length_sq(r + s * d1 - t * d2)


@wp.func
def point_triangle_d2(p: vec, a: vec, b: vec, c: vec) -> real:
    """Squared distance of a point to a triangle: over the face, or to the nearest edge."""
    n = wp.cross(b - a, c - a)
    square = wp.dot(n, n)
    if square > ZERO:
        v = wp.dot(wp.cross(p - a, c - a), n) / square
        w = wp.dot(wp.cross(b - a, p - a), n) / square
        if v >= ZERO and w >= ZERO and v + w <= ONE:
            height = wp.dot(p - a, n)
            return height * height / square
    beside = wp.min(segments_d2(p, p, a, b), segments_d2(p, p, b, c))
    return wp.min(beside, segments_d2(p, p, c, a))


@wp.func
def line_triangle(p: vec, d: vec, a: vec, b: vec, c: vec) -> real:
    """Parameter t where p + t d meets a triangle, inf for a miss."""
    e1 = b - a
    e2 = c - a
    h = wp.cross(d, e2)
    det = wp.dot(e1, h)
    size = wp.max(wp.abs(e1)) * wp.max(wp.abs(e2)) * wp.max(wp.abs(d))
    if wp.abs(det) <= PARALLEL * size:
        return FAR
    s = p - a
    u = wp.dot(s, h) / det
    if u < -SLACK or u > ONE + SLACK:
        return FAR
    k = wp.cross(s, e1)
    v = wp.dot(d, k) / det
    if v < -SLACK or u + v > ONE + SLACK:
        return FAR
    return wp.dot(e2, k) / det


@wp.func
def segment_triangle_d2(p: vec, q: vec, a: vec, b: vec, c: vec, bound2: real) -> real:
    """Squared distance of a segment to a triangle, 0 if they cross, at most bound2."""
    n = wp.cross(b - a, c - a)
    above_p = wp.dot(n, p - a)
    above_q = wp.dot(n, q - a)
    nearest = wp.min(wp.abs(above_p), wp.abs(above_q))
    if above_p * above_q > ZERO:
        if nearest * nearest >= bound2 * wp.dot(n, n):
            return bound2
    else:
        t = line_triangle(p, q - p, a, b, c)
        if t >= ZERO and t <= ONE:
            return ZERO
    best = wp.min(bound2, point_triangle_d2(p, a, b, c))
    best = wp.min(best, point_triangle_d2(q, a, b, c))
    best = wp.min(best, segments_d2(p, q, a, b))
    best = wp.min(best, segments_d2(p, q, b, c))
    return wp.min(best, segments_d2(p, q, c, a))


@wp.func
def box_d2(low: vec, high: vec, lower: vec, upper: vec) -> real:
    """Squared distance of two boxes."""
    gap = wp.max(wp.max(lower - high, low - upper), vec(ZERO, ZERO, ZERO))
    return wp.dot(gap, gap)


@wp.func
def capsule_entry(origin: vec, d: vec, a: vec, b: vec, radius: real) -> real:
    """Distance along a ray to capsule a b, inf for a miss; see `rays.capsule_entry`."""
    u = b - a
    length = wp.length(u)
    if length > ZERO:
        u = u / length
    w = origin - a
    height = wp.dot(w, u)
    along = wp.dot(d, u)
    f = w - height * u
    g = d - along * u
    away = w - wp.clamp(height, ZERO, length) * u
    if wp.dot(away, away) <= radius * radius:
        return ZERO
    best = real(FAR)
    slope = wp.dot(g, g)
    if slope > wp.float64(1e-24):
        t = -wp.dot(f, g) / slope
        m = f + t * g
        half = radius * radius - wp.dot(m, m)
        if half >= ZERO:
            t = t - wp.sqrt(half / slope)
            at = height + t * along
            if t >= ZERO and at >= ZERO and at <= length:
                best = t
    for end in range(2):
        c = w - wp.float64(end) * length * u
        t = -wp.dot(c, d)
        m = c + t * d
        half = radius * radius - wp.dot(m, m)
        if half >= ZERO:
            t = t - wp.sqrt(half)
            if t >= ZERO and t < best:
                best = t
    return best


@wp.func
def near_capsule_entry(o: vec, d: vec, a: vec, b: vec, radius: real) -> real:
    """`capsule_entry`, but inf at once where the ray misses the ball around the capsule."""
    away = HALF * (a + b) - o
    away = away - wp.max(ZERO, wp.dot(away, d)) * d
    reach = radius + HALF * wp.length(b - a) + wp.float64(1e-9)
    if wp.length_sq(away) > reach * reach:
        return FAR
    return capsule_entry(o, d, a, b, radius)


# Walks through the tree of a body's faces.


@wp.func
def segment_surface_d2(
    p: vec, q: vec, bound2: real, faces: Points2, starts: Whole, lower: Points, upper: Points
) -> real:
    """Squared distance of a segment (a point, if p is q) to the surface, at most bound2."""
    low = wp.min(p, q)
    high = wp.max(p, q)
    leaves = starts.shape[0] - 1
    nodes = Stack()
    reach = Reach()
    size = int(1)
    reach[0] = box_d2(low, high, lower[0], upper[0])
    best = real(bound2)
    while size > 0:
        size = size - 1
        node = nodes[size]
        if reach[size] < best:
            if node >= leaves - 1:
                leaf = node - (leaves - 1)
                for k in range(int(starts[leaf]), int(starts[leaf + 1])):
                    best = segment_triangle_d2(p, q, faces[k, 0], faces[k, 1], faces[k, 2], best)
            else:
                one = 2 * node + 1
                two = 2 * node + 2
                to_one = box_d2(low, high, lower[one], upper[one])
                to_two = box_d2(low, high, lower[two], upper[two])
                if to_one < to_two:  # the nearer one is taken first, from the top of the stack
                    nodes[size] = two
                    reach[size] = to_two
                    nodes[size + 1] = one
                    reach[size + 1] = to_one
                else:
                    nodes[size] = one
                    reach[size] = to_one
                    nodes[size + 1] = two
                    reach[size + 1] = to_two
                size = size + 2
    return best


@wp.func
def crossings(p: vec, q: vec, faces: Points2, starts: Whole, lower: Points, upper: Points) -> int:
    """How many faces a segment crosses."""
    low = wp.min(p, q)
    high = wp.max(p, q)
    leaves = starts.shape[0] - 1
    nodes = Stack()
    size = int(1)
    count = int(0)
    while size > 0:
        size = size - 1
        node = nodes[size]
        if box_d2(low, high, lower[node], upper[node]) <= ZERO:
            if node >= leaves - 1:
                leaf = node - (leaves - 1)
                for k in range(int(starts[leaf]), int(starts[leaf + 1])):
                    t = line_triangle(p, q - p, faces[k, 0], faces[k, 1], faces[k, 2])
                    if t >= ZERO and t <= ONE:
                        count = count + 1
            else:
                nodes[size] = 2 * node + 1
                nodes[size + 1] = 2 * node + 2
                size = size + 2
    return count


@wp.func
def box_entry(p: vec, inverse: vec, lower: vec, upper: vec) -> real:
    """Where a ray enters a box, inf for a miss; rounding may not lose a box that it grazes."""
    one = wp.cw_mul(lower - p, inverse)
    two = wp.cw_mul(upper - p, inverse)
    first = wp.max(wp.min(one, two))
    last = wp.min(wp.max(one, two))
    if first <= last + wp.float64(1e-9) and last >= wp.float64(-1e-9):
        return wp.max(first, ZERO) - wp.float64(1e-9)
    return FAR


@wp.func
def field_at(values: wp.array3d(dtype=wp.float32), origin: vec, cell: real, p: vec) -> real:
    """Trilinear value (mm) of a distance field at a point, inf outside the grid."""
    x = (p - origin) / cell
    for axis in range(3):
        if not (x[axis] >= ZERO and x[axis] < wp.float64(values.shape[axis] - 1)):
            return FAR
    i = int(x[0])
    j = int(x[1])
    k = int(x[2])
    u = x[0] - wp.float64(i)
    v = x[1] - wp.float64(j)
    w = x[2] - wp.float64(k)
    total = real(0.0)
    for corner in range(8):
        di = corner >> 2
        dj = (corner >> 1) & 1
        dk = corner & 1
        share = wp.where(di == 1, u, ONE - u) * wp.where(dj == 1, v, ONE - v)
        share = share * wp.where(dk == 1, w, ONE - w)
        total = total + share * wp.float64(values[i + di, j + dj, k + dk])
    return total


@wp.func
def is_inside(
    p: vec,
    depth: real,
    values: wp.array3d(dtype=wp.float32),
    origin: vec,
    cell: real,
    faces: Points2,
    starts: Whole,
    lower: Points,
    upper: Points,
) -> bool:
    """Whether p, at a known distance from a closed surface, is inside; see `distance`."""
    x = (p - origin) / cell
    i = int(wp.rint(x[0]))
    j = int(wp.rint(x[1]))
    k = int(wp.rint(x[2]))
    q = origin + cell * vec(wp.float64(i), wp.float64(j), wp.float64(k))
    inside = values[i, j, k] < wp.float32(0.0)
    if depth * depth > wp.length_sq(q - p):
        return inside
    if crossings(p, q, faces, starts, lower, upper) % 2 == 1:
        return not inside
    return inside


@wp.func
def parts_of(p: vec, q: vec, longest: real, most: int) -> int:
    """Parts into which a segment is divided."""
    return int(wp.clamp(wp.ceil(wp.length(q - p) / longest), ONE, wp.float64(most)))


@wp.func
def part_end(p: vec, q: vec, n: int, parts: int) -> vec:
    """End of part n of a segment, 1 to `parts`; the segment's own ends without rounding."""
    if n == 0:
        return p
    if n == parts:
        return q
    return p + wp.float64(n) / wp.float64(parts) * (q - p)


@wp.kernel
def chains_to_surface(
    lines: Points2,
    given: wp.array(dtype=wp.bool),
    turns: wp.array(dtype=wp.mat33d),
    shifts: Points,
    radius: real,
    within: real,
    horizon: real,
    closed: int,
    values: wp.array3d(dtype=wp.float32),
    origin: vec,
    cell: real,
    band: real,
    slack: real,
    faces: Points2,
    starts: Whole,
    lower: Points,
    upper: Points,
    longest: real,
    most: int,
    out: Numbers,
):
    """Clearance of arm `tid` from a body. See `distance`.

    Segments above `longest` mm are divided, into at most `most` parts.
    """
    b = wp.tid()
    pose = wp.where(turns.shape[0] > 1, b, 0)
    turn = turns[pose]
    shift = shifts[pose]
    count = lines.shape[1]
    last = turn * lines[b, 0] + shift
    finite = wp.isfinite(last[0]) and wp.isfinite(last[1]) and wp.isfinite(last[2])
    value = field_at(values, origin, cell, last)
    estimate = real(wp.where(given[0], value, wp.abs(value)))
    lowest = real(FAR)
    first = int(0)
    first_part = int(1)
    for k in range(count - 1):
        start = last
        end = turn * lines[b, k + 1] + shift
        finite = finite and wp.isfinite(end[0]) and wp.isfinite(end[1]) and wp.isfinite(end[2])
        parts = parts_of(lines[b, k], lines[b, k + 1], longest, most)
        for n in range(1, parts + 1):
            p = part_end(start, end, n, parts)
            before = value
            value = field_at(values, origin, cell, p)
            known = n == parts and given[k + 1]
            estimate = wp.min(estimate, wp.where(known, value, wp.abs(value)))
            ends = wp.min(before, band) + wp.min(value, band)
            low = HALF * (ends - wp.length(p - last)) - slack
            if low < lowest:
                lowest = low
                first = k
                first_part = n
            last = p
    if not finite:
        out[b] = NONE
        return
    if lowest - radius <= within:
        best = wp.min(estimate + slack, horizon + radius)
        # The part with the smallest lower bound goes first: it rules out most of the others.
        start = turn * lines[b, first] + shift
        end = turn * lines[b, first + 1] + shift
        parts = parts_of(lines[b, first], lines[b, first + 1], longest, most)
        p = part_end(start, end, first_part - 1, parts)
        q = part_end(start, end, first_part, parts)
        if lowest < best and best > ZERO:
            d2 = segment_surface_d2(p, q, best * best, faces, starts, lower, upper)
            best = wp.min(best, wp.sqrt(d2))
        last = turn * lines[b, 0] + shift
        value = field_at(values, origin, cell, last)
        for k in range(count - 1):
            start = last
            end = turn * lines[b, k + 1] + shift
            parts = parts_of(lines[b, k], lines[b, k + 1], longest, most)
            for n in range(1, parts + 1):
                q = part_end(start, end, n, parts)
                before = value
                value = field_at(values, origin, cell, q)
                ends = wp.min(before, band) + wp.min(value, band)
                low = HALF * (ends - wp.length(q - last)) - slack
                done = k == first and n == first_part
                if low < best and best > ZERO and not done:
                    d2 = segment_surface_d2(last, q, best * best, faces, starts, lower, upper)
                    best = wp.min(best, wp.sqrt(d2))
                last = q
        if closed == 1:
            for k in range(count):
                p = turn * lines[b, k] + shift
                value = field_at(values, origin, cell, p)
                if given[k] and value - slack < wp.min(best, ZERO):
                    bound = wp.abs(value) + slack
                    d2 = segment_surface_d2(p, p, bound * bound, faces, starts, lower, upper)
                    depth = wp.sqrt(d2)
                    if is_inside(p, depth, values, origin, cell, faces, starts, lower, upper):
                        best = wp.min(best, -depth)
        estimate = best
    out[b] = wp.min(estimate - radius, horizon)


@wp.func
def nearest_face(
    p: vec, d: vec, best: real, faces: Points2, starts: Whole, lower: Points, upper: Points
):
    """Distance to and tree index of the first face on a ray before `best`; -1 for none."""
    inverse = vec(FAR, FAR, FAR)
    for axis in range(3):
        inverse[axis] = wp.where(d[axis] == ZERO, wp.float64(1e300), ONE / d[axis])
    nearest = real(best)
    found = int(-1)
    leaves = starts.shape[0] - 1
    nodes = Stack()
    entry = Reach()
    size = int(1)
    entry[0] = box_entry(p, inverse, lower[0], upper[0])
    while size > 0:
        size = size - 1
        node = nodes[size]
        if entry[size] <= nearest:
            if node >= leaves - 1:
                leaf = node - (leaves - 1)
                for k in range(int(starts[leaf]), int(starts[leaf + 1])):
                    t = line_triangle(p, d, faces[k, 0], faces[k, 1], faces[k, 2])
                    if t >= ZERO and t < nearest:
                        nearest = t
                        found = k
            else:
                one = 2 * node + 1
                two = 2 * node + 2
                to_one = box_entry(p, inverse, lower[one], upper[one])
                to_two = box_entry(p, inverse, lower[two], upper[two])
                if to_one < to_two:
                    nodes[size] = two
                    entry[size] = to_two
                    nodes[size + 1] = one
                    entry[size + 1] = to_one
                else:
                    nodes[size] = one
                    entry[size] = to_one
                    nodes[size + 1] = two
                    entry[size + 1] = to_two
                size = size + 2
    return nearest, found


@wp.func
def meets(
    p: vec, d: vec, limit: real, faces: Points2, starts: Whole, lower: Points, upper: Points
) -> bool:
    """Whether the ray from p along the unit vector d meets a face nearer than `limit`."""
    inverse = vec(FAR, FAR, FAR)
    for axis in range(3):
        inverse[axis] = wp.where(d[axis] == ZERO, wp.float64(1e300), ONE / d[axis])
    leaves = starts.shape[0] - 1
    nodes = Stack()
    size = int(1)
    met = bool(False)
    while size > 0 and not met:
        size = size - 1
        node = nodes[size]
        # Box entries are rounded down, so that none that the ray grazes is lost.
        if box_entry(p, inverse, lower[node], upper[node]) <= limit:
            if node >= leaves - 1:
                leaf = node - (leaves - 1)
                for k in range(int(starts[leaf]), int(starts[leaf + 1])):
                    t = line_triangle(p, d, faces[k, 0], faces[k, 1], faces[k, 2])
                    if t >= ZERO and t < limit:
                        met = True
            else:
                nodes[size] = 2 * node + 1
                nodes[size + 1] = 2 * node + 2
                size = size + 2
    return met


@wp.kernel
def aim_rays(
    directions: Points,
    range_mm: real,
    aims: Points,
    struck: wp.array(dtype=wp.int8),
    body: wp.array(dtype=wp.int32),
    face: wp.array(dtype=wp.int32),
    t: Numbers,
    normals: Points,
):
    """Unit direction of ray `tid`, which meets nothing yet."""
    n = wp.tid()
    d = directions[n]
    length = wp.length(d)
    aim = d / wp.where(length > ZERO, length, ONE)
    aims[n] = aim
    normals[n] = -aim
    struck[n] = wp.int8(0)
    body[n] = -1
    face[n] = -1
    t[n] = range_mm


@wp.kernel
def rays_to_body(
    origins: Points,
    aims: Points,
    each: int,
    turns: wp.array(dtype=wp.mat33d),
    shifts: Points,
    faces: Points2,
    starts: Whole,
    order: Whole,
    lower: Points,
    upper: Points,
    outward: Points,
    which: int,
    kind: int,
    struck: wp.array(dtype=wp.int8),
    body: wp.array(dtype=wp.int32),
    face: wp.array(dtype=wp.int32),
    t: Numbers,
    normals: Points,
):
    """First hit of ray `tid` on a body, where it is nearer than t; see `rays.rays_to_body`."""
    n = wp.tid()
    pose = wp.where(turns.shape[0] > 1, n / each, 0)
    turn = turns[pose]
    p = turn * origins[n] + shifts[pose]
    d = turn * aims[n]
    if wp.isfinite(wp.dot(p + d, vec(ONE, ONE, ONE))):
        distance, found = nearest_face(p, d, t[n], faces, starts, lower, upper)
        if found >= 0:
            t[n] = distance
            own = int(order[found])
            face[n] = own
            body[n] = which
            struck[n] = wp.int8(kind)
            normal = wp.transpose(turn) * outward[own]
            size = wp.length_sq(normal)
            if wp.abs(size - ONE) > wp.float64(1e-9):  # a strained body
                normal = normal / wp.sqrt(size)
            normals[n] = normal


@wp.kernel
def rays_to_arm(
    origins: Points,
    aims: Points,
    each: int,
    lines: Points2,
    radius: real,
    gap: real,
    kind: int,
    struck: wp.array(dtype=wp.int8),
    body: wp.array(dtype=wp.int32),
    face: wp.array(dtype=wp.int32),
    t: Numbers,
    normals: Points,
):
    """First hit of ray `tid` on an arm, where it is nearer than t; see `rays.rays_to_chains`."""
    n = wp.tid()
    b = n / each
    o = origins[n]
    d = aims[n]
    best = t[n]
    found = int(-1)
    arc = real(0.0)
    for turn in range(lines.shape[1] - 1):
        k = lines.shape[1] - 2 - turn
        p = lines[b, k]
        q = lines[b, k + 1]
        length = wp.length(q - p)
        if arc >= gap:
            hit = near_capsule_entry(o, d, p, q, radius)
            if hit < best or (found >= 0 and hit == best):  # the one nearest to the base
                best = hit
                found = k
        arc = arc + length
    if found >= 0:
        t[n] = best
        body[n] = -1
        face[n] = -1
        struck[n] = wp.int8(kind)
        a = lines[b, found]
        u = lines[b, found + 1] - a
        x = o + best * d - a
        share = wp.clamp(wp.dot(x, u) / (wp.dot(u, u) + wp.float64(1e-30)), ZERO, ONE)
        x = x - share * u
        length = wp.length(x)
        normals[n] = x / wp.where(length > ZERO, length, ONE)


@wp.kernel
def ray_ends(
    origins: Points, aims: Points, t: Numbers, normals: Points, point: Points, incidence: Numbers
):
    """End of ray `tid` and its angle of incidence, rad."""
    n = wp.tid()
    a = aims[n]
    point[n] = origins[n] + t[n] * a
    sine = wp.length(wp.cross(normals[n], a))
    incidence[n] = wp.atan2(sine, wp.abs(wp.dot(normals[n], a)))


# Lines of sight.


@wp.func
def angle_between(a: vec, b: vec) -> real:
    """Angle of two vectors, rad (Kahan 2006: atan2 form)."""
    return wp.atan2(wp.length(wp.cross(a, b)), wp.dot(a, b))


@wp.kernel
def points_in_picture(
    eyes: Points,
    axes: Points,
    points: Points2,
    normals: Points2,
    lift: real,
    half_fov: real,
    near: real,
    far: real,
    ends: Points2,
    wanted: wp.array2d(dtype=wp.bool),
    clear: wp.array2d(dtype=wp.bool),
    distance: Numbers2,
):
    """Whether camera b has point m in its picture and in focus; see `sight.points_in_picture`."""
    b, m = wp.tid()
    end = points[b, m] + lift * normals[b, m]
    ray = end - eyes[b]
    length = wp.length(ray)
    seen = length >= near and length <= far and angle_between(axes[b], ray) <= half_fov
    ends[b, m] = end
    distance[b, m] = length
    wanted[b, m] = seen
    clear[b, m] = seen


@wp.kernel
def middles(eyes: Points, axes: Points, points: Points2, middle: Numbers2):
    """Angle to the axis, rad, and distance, mm, of the middle of the points of camera `tid`."""
    b = wp.tid()
    total = vec(ZERO, ZERO, ZERO)
    for m in range(points.shape[1]):
        total = total + points[b, m]
    ray = total / wp.float64(points.shape[1]) - eyes[b]
    middle[b, 0] = angle_between(axes[b], ray)
    middle[b, 1] = wp.length(ray)


@wp.kernel
def hide_behind_arm(
    eyes: Points,
    ends: Points2,
    distance: Numbers2,
    short_mm: real,
    lines: Points2,
    radius: real,
    gap: real,
    clear: wp.array2d(dtype=wp.bool),
):
    """Clear the flag of line of sight m of camera b where it meets an arm before its last
    `short_mm`; see `sight.hide_behind_chain`."""
    b, m = wp.tid()
    if not clear[b, m]:
        return
    o = eyes[b]
    d = (ends[b, m] - o) / distance[b, m]
    limit = distance[b, m] - short_mm
    arc = real(0.0)
    for turn in range(lines.shape[1] - 1):
        k = lines.shape[1] - 2 - turn
        p = lines[b, k]
        q = lines[b, k + 1]
        length = wp.length(q - p)
        if arc >= gap and near_capsule_entry(o, d, p, q, radius) < limit:
            clear[b, m] = False
            return
        arc = arc + length


@wp.kernel
def hide_behind_body(
    eyes: Points,
    ends: Points2,
    distance: Numbers2,
    short_mm: real,
    turns: wp.array(dtype=wp.mat33d),
    shifts: Points,
    faces: Points2,
    starts: Whole,
    lower: Points,
    upper: Points,
    clear: wp.array2d(dtype=wp.bool),
):
    """Clear the flag of line of sight m of camera b where it meets a body before its last
    `short_mm`; see `sight.hide_behind_body`."""
    b, m = wp.tid()
    if not clear[b, m]:
        return
    pose = wp.where(turns.shape[0] > 1, b, 0)
    p = turns[pose] * eyes[b] + shifts[pose]
    d = turns[pose] * ((ends[b, m] - eyes[b]) / distance[b, m])
    if meets(p, d, distance[b, m] - short_mm, faces, starts, lower, upper):
        clear[b, m] = False


@wp.kernel
def chains_apart(first: Points2, second: Points2, radii: real, horizon: real, out: Numbers):
    """Clearance (mm) of the two arms of environment `tid`."""
    b = wp.tid()
    best = horizon + radii
    finite = real(0.0)
    for k in range(first.shape[1]):
        finite = finite + wp.dot(first[b, k], vec(ONE, ONE, ONE))
    for k in range(second.shape[1]):
        finite = finite + wp.dot(second[b, k], vec(ONE, ONE, ONE))
    if not wp.isfinite(finite):
        out[b] = NONE
        return
    for i in range(first.shape[1] - 1):
        p = first[b, i]
        q = first[b, i + 1]
        half = HALF * wp.length(q - p)
        for j in range(second.shape[1] - 1):
            c = second[b, j]
            d = second[b, j + 1]
            reach = best + half + HALF * wp.length(d - c)
            if wp.length_sq(HALF * (p + q - c - d)) < reach * reach:
                best = wp.min(best, wp.sqrt(segments_d2(p, q, c, d)))
    out[b] = best - radii


@wp.kernel
def chains_folded(lines: Points2, radius: real, gap: real, horizon: real, out: Numbers):
    """Clearance (mm) of the arm of environment `tid` to itself beyond `gap` mm of arc."""
    b = wp.tid()
    segments = lines.shape[1] - 1
    total = real(0.0)
    for k in range(segments):
        total = total + wp.length(lines[b, k + 1] - lines[b, k])
    if not wp.isfinite(total):
        out[b] = NONE
        return
    best = horizon + TWO * radius
    for i in range(segments):
        p = lines[b, i]
        q = lines[b, i + 1]
        half = HALF * wp.length(q - p)
        between = real(0.0)
        for j in range(i + 1, segments):
            c = lines[b, j]
            d = lines[b, j + 1]
            length = wp.length(d - c)
            if between >= gap:
                reach = best + half + HALF * length
                if wp.length_sq(HALF * (p + q - c - d)) < reach * reach:
                    best = wp.min(best, wp.sqrt(segments_d2(p, q, c, d)))
            between = between + length
    out[b] = best - TWO * radius


LANES = 32
"""Threads that share the samples of one environment's sweep."""
UNIT = wp.constant(wp.float64(2.0**-40))
"""Unit of sums of areas [mm^2] and energies [J] in whole numbers, which the order of the threads
does not change."""


@wp.kernel
def deposit(
    began: Points,
    ended: Points,
    direction: Points,
    energy: Singles,
    ring: Whole,
    waist: real,
    reach: real,
    steepest: real,
    counted: Numbers,
    points: Points,
    normals: Points,
    areas: Numbers,
    zones: Labels2,
    stations: Labels2,
    origin: vec,
    cell: real,
    cells: wp.vec3i,
    starts: Whole,
    dose: Singles2,
    peak: Singles2,
    sums: Whole2,
    in_ring: int,
):
    """Add the sweep of environment `tid[0]` to the samples near its path; see `ablation._deposit`.

    Its `LANES` threads divide each column of cubes, whose samples lie one after another. sums (B,
    6 + stations): energy and area of each zone and area of each station, in `UNIT`; `deposited`
    adds them up. in_ring: number of the zone that is the ring.
    """
    n, lane = wp.tid()
    if not energy[n] > wp.float32(0.0):
        return
    scale = wp.sqrt(TWO) / waist
    p = began[n]
    d = direction[n]
    low = wp.vec3i(0, 0, 0)
    high = wp.vec3i(0, 0, 0)
    for axis in range(3):
        tall = reach * (ONE + wp.abs(d[axis]) / steepest)
        near = wp.min(p[axis], ended[n][axis]) - tall - origin[axis]
        far = wp.max(p[axis], ended[n][axis]) + tall - origin[axis]
        low[axis] = wp.max(0, int(wp.floor(wp.max(near / cell, wp.float64(-1.0)))))
        high[axis] = wp.min(
            cells[axis] - 1, int(wp.floor(wp.clamp(far / cell, wp.float64(-2.0), wp.float64(1e6))))
        )
    if low[2] > high[2]:
        return
    m = ended[n] - p
    m = m - wp.dot(m, d) * d
    length = wp.length(m)
    moving = length > wp.float64(1e-5) * waist
    m = wp.where(moving, m / wp.max(length, wp.float64(1e-300)), vec(ZERO, ZERO, ZERO))
    strength = TWO * wp.float64(energy[n]) / (wp.float64(wp.pi) * waist * waist)
    heat = vec(ZERO, ZERO, ZERO)
    burnt = vec(ZERO, ZERO, ZERO)
    for ci in range(low[0], high[0] + 1):
        for cj in range(low[1], high[1] + 1):
            column = (ci * cells[1] + cj) * cells[2]
            s = int(starts[column + low[2]]) + lane
            end = int(starts[column + high[2] + 1])
            while s < end:
                cosine = -wp.dot(d, normals[s])
                y = points[s] - p
                y = y - wp.dot(y, d) * d
                way = wp.dot(y, m)
                across2 = wp.dot(y, y) - way * way
                beside = across2 > reach * reach or way < -reach or way > length + reach
                if cosine > ZERO and not beside:
                    profile = wp.exp(-scale * scale * wp.max(across2, ZERO))
                    if moving:
                        span = wp.erf(scale * way) - wp.erf(scale * (way - length))
                        root = wp.sqrt(wp.float64(wp.pi))
                        profile = profile * HALF * root * span / (scale * length)
                    gain = strength * profile * cosine
                    old = wp.float64(dose[n, s])
                    after = old + gain
                    kind = zones[int(ring[n]), s]
                    heat[kind] = heat[kind] + gain * areas[s]
                    if after >= counted[kind] and old < counted[kind]:
                        burnt[kind] = burnt[kind] + areas[s]
                        if kind == in_ring:
                            station = stations[int(ring[n]), s]
                            area = wp.int64(wp.rint(areas[s] / UNIT))
                            wp.atomic_add(sums, n, 6 + station, area)
                    if kind == in_ring:
                        wp.atomic_max(peak, n, stations[int(ring[n]), s], wp.float32(after))
                    dose[n, s] = wp.float32(after)
                s = s + LANES
    for kind in range(3):
        if heat[kind] > ZERO:
            wp.atomic_add(sums, n, kind, wp.int64(wp.rint(heat[kind] / UNIT)))
        if burnt[kind] > ZERO:
            wp.atomic_add(sums, n, 3 + kind, wp.int64(wp.rint(burnt[kind] / UNIT)))


@wp.kernel
def deposited(sums: Whole2, joule: Singles2, area: Singles2, band: Singles2):
    """Add sum `tid[1]` of environment `tid[0]` to what it is a sum of, and set it to 0."""
    n, k = wp.tid()
    if sums[n, k] == wp.int64(0):
        return
    more = wp.float64(sums[n, k]) * UNIT
    if k < 3:
        joule[n, k] = wp.float32(wp.float64(joule[n, k]) + more)
    elif k < 6:
        area[n, k - 3] = wp.float32(wp.float64(area[n, k - 3]) + more)
    else:
        band[n, k - 6] = wp.float32(wp.float64(band[n, k - 6]) + more)
    sums[n, k] = wp.int64(0)


@wp.kernel
def ring_cuts(
    peak: Singles2, band: Singles2, cut_dose: wp.float32, cut: Whole, gap: Whole, burnt: Singles
):
    """Cut stations, longest gap and burnt area of ring `tid`; see `ablation.cut_torch`."""
    n = wp.tid()
    count = peak.shape[1]
    done = int(0)
    longest = int(0)
    run = int(0)
    first = int(-1)
    area = wp.float32(0.0)
    for k in range(count):
        if peak[n, k] >= cut_dose:
            done = done + 1
            area = area + band[n, k]
            if first < 0:
                first = k
            run = 0
        else:
            run = run + 1
            longest = wp.max(longest, run)
    # The gap that goes on from the last station to the first.
    if first >= 0:
        longest = wp.max(longest, run + first)
    cut[n] = wp.int64(done)
    burnt[n] = area
    gap[n] = wp.int64(longest)
