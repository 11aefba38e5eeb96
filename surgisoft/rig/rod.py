"""Statics of the arm: an extensible, shearable Cosserat rod under gravity and pressure.

Balance (Antman 2005, ch. 8; Till, Aloi & Rucker 2019) for the internal force n and moment
m over the reference length s, with weight f per length:

    r' = R v,   R' = R [u],   n' = -f,   m' = -r' x n.

Weight is a dead load, so n(s) is the weight beyond s whatever the shape is. Only the moment at the
base is unknown: it is shot for with Newton's method until the moment at the tip cap balances the
cap's weight. A one-sided support adds one unknown, its force. Strains u, v follow from the body
components of n and m by the wall's section law. Both caps are rigid.
"""

import math
from typing import NamedTuple

import numpy as np

from surgisoft.compiled import compiled
from surgisoft.rig.wall import NOT_CONVERGED, Wall, strain_under

TOLERANCE = 1e-7
"""Residual of the tip moment [N mm] (and of a support's force [N]) that counts as balanced."""
MAX_ITERATIONS = 60
"""Newton and Broyden iterations before the solver gives up."""


class Rod(NamedTuple):
    """The arm along its length, at K = 2 N + 1 stations of N integration steps of the soft part."""

    wall: Wall
    """Law of the wall's section."""
    steps: np.ndarray
    """(N,) step lengths [mm]."""
    stiffness: np.ndarray
    """(K,) factor on the wall's modulus [-]."""
    taper: np.ndarray
    """(K, m) factor on each chamber's area [-]."""
    rest: np.ndarray
    """(K, 2) initial curvature u_x, u_y from casting [1/mm]."""
    beyond: np.ndarray
    """(K,) weight beyond the station, tip cap included [N]."""
    planes: np.ndarray
    """(n,) int64: number of steps before each key plane; -1 base bracket, N + 1 tip plane."""
    base_cap: float
    """Length of the base cap [mm]."""
    tip_cap: float
    """Length of the tip cap [mm]."""
    tip_weight: float
    """Weight of the tip cap, at half its length [N]."""
    base: np.ndarray
    """(4,) quaternion w, x, y, z of the base section in the arm base frame."""


class Loads(NamedTuple):
    """External loads on the rod."""

    gravity: np.ndarray
    """(3,) unit vector of weight, arm base frame."""
    payload: float
    """Weight of a mass at the tip plane [N]."""
    payload_at: np.ndarray
    """(3,) its centre from the tip plane's centre, tip frame [mm]."""
    support: int
    """A one-sided support after this many steps; 0: none."""
    support_normal: np.ndarray
    """(3,) unit normal of the support, pointing to the free side, arm base frame."""
    support_gap: float
    """Signed distance of the support plane from the origin along its normal [mm]."""
    support_stiffness: float
    """Penalty stiffness of the support [N/mm]."""


class Shape(NamedTuple):
    """Result and warm start of the solver; arrays are updated in place."""

    unknown: np.ndarray
    """(4,) moment after the base cap [N mm], force of the support [N]."""
    inverse: np.ndarray
    """(4, 4) approximate inverse Jacobian of the residual."""
    status: np.ndarray
    """(3,) 1 where `inverse` holds; last residual; iterations of the last solve."""
    centres: np.ndarray
    """(n, 3) centres of the key planes, arm base frame [mm]."""
    frames: np.ndarray
    """(n, 3, 3) rotations of the key planes to the arm base frame, axes in columns."""
    strain: np.ndarray
    """(3,) strains of the section visited last."""
    active: np.ndarray
    """(K, 4) force [N], moment x, y and torque [N mm] that the wall makes by itself."""


def new_shape(rod: Rod) -> Shape:
    """A solver without a warm start."""
    n, stations = len(rod.planes), len(rod.stiffness)
    return Shape(
        unknown=np.zeros(4),
        inverse=np.zeros((4, 4)),
        status=np.zeros(3),
        centres=np.zeros((n, 3)),
        frames=np.zeros((n, 3, 3)),
        strain=np.zeros(3),
        active=np.zeros((stations, 4)),
    )


@compiled
def _axes(w, x, y, z):
    """Rotation matrix of a quaternion, by rows."""
    return (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@compiled
def _slope(rod, softness, thrusts, active, strain, k, nx, ny, nz, y, out):
    """Derivative of y = (r, q, m) at station k under the internal force n; False: no strain."""
    w, x, yy, z = y[3], y[4], y[5], y[6]
    a, b, c, d, e, f, g, h, i = _axes(w, x, yy, z)
    mx, my, mz = y[7], y[8], y[9]
    factor = softness * rod.stiffness[k]
    shear = factor * rod.wall.shear
    vx = (a * nx + d * ny + g * nz) / shear
    vy = (b * nx + e * ny + h * nz) / shear
    force = c * nx + f * ny + i * nz + active[k, 0]
    moment_x = a * mx + d * my + g * mz + active[k, 1]
    moment_y = b * mx + e * my + h * mz + active[k, 2]
    twist = (c * mx + f * my + i * mz + active[k, 3]) / (factor * rod.wall.torsion)
    found = strain_under(rod.wall, factor, thrusts[k], force, moment_x, moment_y, strain)
    vz = 1.0 + strain[0]
    ux = strain[1] + rod.rest[k, 0]
    uy = strain[2] + rod.rest[k, 1]
    rx = a * vx + b * vy + c * vz
    ry = d * vx + e * vy + f * vz
    rz = g * vx + h * vy + i * vz
    out[0], out[1], out[2] = rx, ry, rz
    out[3] = 0.5 * (-x * ux - yy * uy - z * twist)
    out[4] = 0.5 * (w * ux + yy * twist - z * uy)
    out[5] = 0.5 * (w * uy + z * ux - x * twist)
    out[6] = 0.5 * (w * twist + x * uy - yy * ux)
    out[7] = rz * ny - ry * nz
    out[8] = rx * nz - rz * nx
    out[9] = ry * nx - rx * ny
    return found != NOT_CONVERGED


@compiled(inner=True)
def _keep_plane(shape, plane, y):
    a, b, c, d, e, f, g, h, i = _axes(y[3], y[4], y[5], y[6])
    shape.centres[plane, 0], shape.centres[plane, 1], shape.centres[plane, 2] = y[0], y[1], y[2]
    frame = shape.frames[plane]
    frame[0, 0], frame[0, 1], frame[0, 2] = a, b, c
    frame[1, 0], frame[1, 1], frame[1, 2] = d, e, f
    frame[2, 0], frame[2, 1], frame[2, 2] = g, h, i


@compiled(inner=True)
def shoot(
    rod: Rod,
    loads: Loads,
    softness: float,
    thrusts: np.ndarray,
    base: np.ndarray,
    unknown: np.ndarray,
    shape: Shape,
    residual: np.ndarray,
):
    """Integrate from the base with guessed unknowns (Runge-Kutta 4); the residual at the tip.

    rod, loads: Rod, Loads; softness: factor on every stiffness [-]; thrusts: (K, m) [N]; base: (4,)
    quaternion; unknown: (4,) base moment [N mm] and support force [N]; shape: Shape, whose centres
    and frames are written; residual: (4,) [N mm], [N], written. False where a section failed.
    """
    y = np.empty(10)
    y1 = np.empty(10)
    k1, k2, k3, k4 = np.empty(10), np.empty(10), np.empty(10), np.empty(10)
    _, _, c, _, _, f, _, _, i = _axes(base[0], base[1], base[2], base[3])
    y[0], y[1], y[2] = 0.0, 0.0, 0.0
    for d in range(4):
        y[3 + d] = base[d]
    for d in range(3):
        y[7 + d] = unknown[d]
    for plane in range(rod.planes.shape[0]):
        if rod.planes[plane] < 0:
            _keep_plane(shape, plane, y)
    y[0], y[1], y[2] = c * rod.base_cap, f * rod.base_cap, i * rod.base_cap
    gx, gy, gz = loads.gravity[0], loads.gravity[1], loads.gravity[2]
    active = shape.active
    strain = shape.strain
    strain[0], strain[1], strain[2] = 0.0, 0.0, 0.0
    good = True
    residual[3] = 0.0
    held = unknown[3] if loads.support > 0 else 0.0
    steps = rod.steps.shape[0]
    for j in range(steps):
        length = rod.steps[j]
        k = 2 * j
        push = held if j < loads.support else 0.0
        px = push * loads.support_normal[0]
        py = push * loads.support_normal[1]
        pz = push * loads.support_normal[2]
        wa = rod.beyond[k] + loads.payload
        wb = rod.beyond[k + 1] + loads.payload
        wc = rod.beyond[k + 2] + loads.payload
        good &= _slope(
            rod, softness, thrusts, active, strain, k,
            wa * gx + px, wa * gy + py, wa * gz + pz, y, k1,
        )  # fmt: skip
        for d in range(10):
            y1[d] = y[d] + 0.5 * length * k1[d]
        nx, ny, nz = wb * gx + px, wb * gy + py, wb * gz + pz
        good &= _slope(rod, softness, thrusts, active, strain, k + 1, nx, ny, nz, y1, k2)
        for d in range(10):
            y1[d] = y[d] + 0.5 * length * k2[d]
        good &= _slope(rod, softness, thrusts, active, strain, k + 1, nx, ny, nz, y1, k3)
        for d in range(10):
            y1[d] = y[d] + length * k3[d]
        good &= _slope(
            rod, softness, thrusts, active, strain, k + 2,
            wc * gx + px, wc * gy + py, wc * gz + pz, y1, k4,
        )  # fmt: skip
        for d in range(10):
            y[d] += length / 6.0 * (k1[d] + 2.0 * (k2[d] + k3[d]) + k4[d])
        size = math.sqrt(y[3] ** 2 + y[4] ** 2 + y[5] ** 2 + y[6] ** 2)
        for d in range(3, 7):
            y[d] /= size
        if not good:
            return False
        for plane in range(rod.planes.shape[0]):
            if rod.planes[plane] == j + 1:
                _keep_plane(shape, plane, y)
        if loads.support == j + 1:
            residual[3] = held - _support_force(loads, y)
    _close_at_tip(rod, loads, y, residual)
    for plane in range(rod.planes.shape[0]):
        if rod.planes[plane] > steps:
            _keep_plane(shape, plane, y)
    return True


@compiled(inner=True)
def _support_force(loads, y):
    """Penalty force [N] of the support: zero when free, smooth over 0.02 mm at the touch."""
    normal = loads.support_normal
    depth = loads.support_gap - (normal[0] * y[0] + normal[1] * y[1] + normal[2] * y[2])
    return loads.support_stiffness * 0.5 * (depth + math.sqrt(depth * depth + 4e-4))


@compiled(inner=True)
def _close_at_tip(rod, loads, y, residual):
    """Moment left over at the tip cap [N mm]; y moves on to the tip plane."""
    a, b, c, d, e, f, g, h, i = _axes(y[3], y[4], y[5], y[6])
    at = loads.payload_at
    lx = a * at[0] + b * at[1] + c * (rod.tip_cap + at[2])
    ly = d * at[0] + e * at[1] + f * (rod.tip_cap + at[2])
    lz = g * at[0] + h * at[1] + i * (rod.tip_cap + at[2])
    half = 0.5 * rod.tip_cap * rod.tip_weight
    ax = half * c + loads.payload * lx
    ay = half * f + loads.payload * ly
    az = half * i + loads.payload * lz
    gx, gy, gz = loads.gravity[0], loads.gravity[1], loads.gravity[2]
    residual[0] = y[7] - (ay * gz - az * gy)
    residual[1] = y[8] - (az * gx - ax * gz)
    residual[2] = y[9] - (ax * gy - ay * gx)
    y[0] += c * rod.tip_cap
    y[1] += f * rod.tip_cap
    y[2] += i * rod.tip_cap


@compiled(inner=True)
def _jacobian(rod, loads, softness, thrusts, base, shape, residual):
    """Inverse of the residual's Jacobian by forward differences, into shape.inverse."""
    size = 4 if loads.support > 0 else 3
    matrix = np.zeros((size, size))
    moved = np.empty(4)
    other = np.empty(4)
    for column in range(size):
        for row in range(4):
            moved[row] = shape.unknown[row]
        moved[column] += 1e-5
        if not shoot(rod, loads, softness, thrusts, base, moved, shape, other):
            return False
        for row in range(size):
            matrix[row, column] = (other[row] - residual[row]) / 1e-5
    inverse = np.linalg.inv(matrix)
    for row in range(size):
        for column in range(size):
            shape.inverse[row, column] = inverse[row, column]
    return True


@compiled
def _error(residual):
    return max(max(abs(residual[0]), abs(residual[1])), max(abs(residual[2]), abs(residual[3])))


@compiled
def balance(
    rod: Rod, loads: Loads, softness: float, thrusts: np.ndarray, base: np.ndarray, shape: Shape
) -> bool:
    """Solve for the equilibrium; False where none was found. shape.status reports the residual.

    Broyden's (1965) rank-one update of the inverse Jacobian carries over from solve to solve; a
    fresh Jacobian is taken when the residual does not shrink at least fourfold.
    """
    size = 4 if loads.support > 0 else 3
    residual = np.empty(4)
    after = np.empty(4)
    step = np.empty(4)
    before = np.empty(4)
    good = shoot(rod, loads, softness, thrusts, base, shape.unknown, shape, residual)
    if not good:
        shape.unknown[:] = 0.0
        shape.status[0] = 0.0
        if not shoot(rod, loads, softness, thrusts, base, shape.unknown, shape, residual):
            return False
    error = _error(residual)
    fresh = False
    for iteration in range(MAX_ITERATIONS):
        shape.status[1] = error
        shape.status[2] = iteration
        if error < TOLERANCE:
            return True
        if shape.status[0] == 0.0:
            if not _jacobian(rod, loads, softness, thrusts, base, shape, residual):
                return False
            shape.status[0] = 1.0
            fresh = True
        for row in range(4):
            before[row] = shape.unknown[row]
        for row in range(size):
            step[row] = 0.0
            for column in range(size):
                step[row] -= shape.inverse[row, column] * residual[column]
        scale = 1.0
        while True:
            for row in range(size):
                shape.unknown[row] = before[row] + scale * step[row]
            good = shoot(rod, loads, softness, thrusts, base, shape.unknown, shape, after)
            if good and (_error(after) < error or not fresh):
                break
            scale *= 0.5
            if scale < 1e-4:
                return False
        if not good or _error(after) >= error:
            for row in range(4):
                shape.unknown[row] = before[row]
            shape.status[0] = 0.0
            continue
        _broyden(shape, step, scale, residual, after, size)
        fresh = False
        if _error(after) > 0.25 * error:
            shape.status[0] = 0.0
        error = _error(after)
        for row in range(4):
            residual[row] = after[row]
    return False


@compiled(inner=True)
def _broyden(shape, step, scale, residual, after, size):
    """Broyden's (1965) update of the inverse Jacobian: += (dx - B dF) dx^T B / (dx^T B dF)."""
    product = np.zeros(4)
    row_vector = np.zeros(4)
    for row in range(size):
        for column in range(size):
            product[row] += shape.inverse[row, column] * (after[column] - residual[column])
            row_vector[column] += scale * step[row] * shape.inverse[row, column]
    bottom = 0.0
    for row in range(size):
        bottom += scale * step[row] * product[row]
    if abs(bottom) < 1e-30:
        return
    for row in range(size):
        gap = (scale * step[row] - product[row]) / bottom
        for column in range(size):
            shape.inverse[row, column] += gap * row_vector[column]
