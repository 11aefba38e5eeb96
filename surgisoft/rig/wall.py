"""The wall's section law: strains of one cross-section under axial force and bending moment.

The wall's stress along a fibre line of strain e is the odd-even cubic

    sigma(e) = E (e + b e^2 + a e^3),   b^2 < 3 a  (stiffness positive at every strain),

soft at rest and limited by the fibres when stretched. Plane sections stay plane (Kirchhoff 1859):
e(x, y) = eps + u_x y - u_y x. Integrating the energy over a section with area A, second moment I
and fourth moment J = int y^4 dA gives the resultants below, so the law has a potential.

A chamber of area A_i at (x_i, y_i) pushes with the thrust of a fibre-wound tube (Chou & Hannaford
1996: virtual work p dV of a tube whose fibres do not stretch),

    p_i A_i (1 - 3 c^2 L^2) / (1 - c^2),   L = 1 + e(x_i, y_i),

with c the cosine of the fibres' angle from the arm's axis.
"""

from typing import NamedTuple

import numpy as np

from surgisoft.compiled import compiled

LAST_STEP = 3e-6
"""Newton's method ends after a step in strain [-] below this; it converges quadratically, so the
error left is of the order of the step's square."""
NOT_CONVERGED = 99
"""Iterations that stand for a section without equilibrium."""


class Wall(NamedTuple):
    """The wall at stiffness factor 1; mm, N, kPa."""

    modulus: float
    """Young's modulus E [N/mm^2]."""
    even: float
    """Coefficient b of the even term of the stress [-]."""
    odd: float
    """Coefficient a of the odd term of the stress [-]."""
    area: float
    """Area A of the section [mm^2]."""
    second: np.ndarray
    """(3,) I_xx, I_yy, I_xy of the linear term [mm^4]."""
    mean_second: float
    """Second moment I of the nonlinear terms [mm^4]."""
    fourth: float
    """Fourth moment J [mm^6]."""
    torsion: float
    """G times polar moment [N mm^2]."""
    shear: float
    """G times shear area [N]."""
    chambers: np.ndarray
    """(m, 2) chamber centroids x_i, y_i, body frame [mm]."""
    areas: np.ndarray
    """(m,) chamber areas A_i [mm^2]."""
    fibre: np.ndarray
    """(m,) c^2 = cos(fibre angle)^2 [-]."""


@compiled
def strain_under(
    wall: Wall,
    factor: float,
    thrusts: np.ndarray,
    force: float,
    moment_x: float,
    moment_y: float,
    strain: np.ndarray,
) -> int:
    """Strains of a section that carries a load; Newton's method from the values in `strain`.

    wall: Wall; factor: stiffness factor [-]; thrusts: (m,) p_i A_i [N]; force: axial force of the
    loads, without the thrust [N]; moment_x, moment_y: bending moment of the loads [N mm];
    strain: (3,) eps [-], u_x, u_y [1/mm], start and result. Returns the iterations
    taken, NOT_CONVERGED where it found none.
    """
    e_mod = wall.modulus * factor
    area, second, fourth = wall.area, wall.mean_second, wall.fourth
    even, odd = wall.even, wall.odd
    for iteration in range(50):
        eps, ux, uy = strain[0], strain[1], strain[2]
        bend = ux * ux + uy * uy
        linear = 2.0 * even * eps + 3.0 * odd * eps * eps
        common = second * linear + odd * fourth * bend
        g0 = e_mod * (
            area * eps * (1.0 + even * eps + odd * eps * eps)
            + second * bend * (even + 3.0 * odd * eps)
        )
        g1 = e_mod * (wall.second[0] * ux + wall.second[2] * uy + common * ux)
        g2 = e_mod * (wall.second[1] * uy + wall.second[2] * ux + common * uy)
        cross = 2.0 * second * (even + 3.0 * odd * eps)
        h00 = e_mod * (area * (1.0 + linear) + 3.0 * odd * second * bend)
        h01 = e_mod * cross * ux
        h02 = e_mod * cross * uy
        h11 = e_mod * (wall.second[0] + common + 2.0 * odd * fourth * ux * ux)
        h22 = e_mod * (wall.second[1] + common + 2.0 * odd * fourth * uy * uy)
        h12 = e_mod * (wall.second[2] + 2.0 * odd * fourth * ux * uy)
        g0 -= force
        g1 -= moment_x
        g2 -= moment_y
        for i in range(thrusts.shape[0]):
            x, y, c2 = wall.chambers[i, 0], wall.chambers[i, 1], wall.fibre[i]
            stretch = 1.0 + eps + ux * y - uy * x
            push = thrusts[i] * (1.0 - 3.0 * c2 * stretch * stretch) / (1.0 - c2)
            slope = -6.0 * thrusts[i] * c2 * stretch / (1.0 - c2)
            g0 -= push
            g1 -= push * y
            g2 += push * x
            h00 -= slope
            h01 -= slope * y
            h02 += slope * x
            h11 -= slope * y * y
            h22 -= slope * x * x
            h12 += slope * x * y
        # The symmetric 3 x 3 system, solved by cofactors.
        a00 = h11 * h22 - h12 * h12
        a01 = h02 * h12 - h01 * h22
        a02 = h01 * h12 - h02 * h11
        a11 = h00 * h22 - h02 * h02
        a12 = h01 * h02 - h00 * h12
        a22 = h00 * h11 - h01 * h01
        det = h00 * a00 + h01 * a01 + h02 * a02
        d0 = (a00 * g0 + a01 * g1 + a02 * g2) / det
        d1 = (a01 * g0 + a11 * g1 + a12 * g2) / det
        d2 = (a02 * g0 + a12 * g1 + a22 * g2) / det
        size = abs(d0) + 10.0 * (abs(d1) + abs(d2))
        if size > 0.5:
            d0, d1, d2 = d0 * 0.5 / size, d1 * 0.5 / size, d2 * 0.5 / size
        strain[0] = eps - d0
        strain[1] = ux - d1
        strain[2] = uy - d2
        if size < LAST_STEP:
            return iteration + 1
    return NOT_CONVERGED


@compiled
def line_strain(strain: np.ndarray, x: float, y: float) -> float:
    """Strain [-] of the wall at (x, y) [mm] in a section with strains (3,) eps, u_x, u_y."""
    return strain[0] + strain[1] * y - strain[2] * x
