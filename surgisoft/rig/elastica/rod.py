"""PyElastica's Cosserat rod, stepped in one compiled loop.

The mechanics are PyElastica's own (Gazzola, Dudte, McCormick & Mahadevan 2018): its kernels compute
internal forces and torques, accelerations, rotations, gravity and contact with a plane, in the
order of its position Verlet integrator, with its analytical linear damper and its clamped end. Only
the loop around the kernels is new: wall, chambers and air are stepped with the rod, and
PyElastica's loop takes over twice the time of its kernels on a rod of a dozen elements (17 against
7 us a step).
A test holds that both loops give the same motion.

What an arm has beyond PyElastica's linear rod (pressurised chambers, friction, viscosity) enters by
the rod's rest strains: PyElastica's internal couple is B (kappa - rest_kappa) and its internal
force S (sigma - rest_sigma), so a couple c more is rest_kappa less c / B.

Units in this package are SI (m, kg, s, N, Pa); `rig` converts them to mm, g and kPa.
"""

import math
from typing import NamedTuple

import elastica
import numpy as np
from elastica._contact_functions import _calculate_contact_forces_rod_plane
from elastica.rod.cosserat_rod import (
    _compute_bending_twist_strains,
    _compute_internal_forces,
    _compute_internal_torques,
    _compute_shear_stretch_strains,
    _update_accelerations,
    _zeroed_out_external_forces_and_torques,
)
from elastica.rod.data_structures import overload_operator_kinematic_numba

from surgisoft.compiled import compiled

_gravity_forces = elastica.GravityForces.compute_gravity_forces
MARGIN = 0.8
"""Time step as a share of the largest stable one [-]; what is left covers contact and large
deformation."""
CONTACT_TOLERANCE_M = 1e-4
"""Distance from a plane at which PyElastica's rod-plane contact begins [m] (`RodPlaneContact`)."""


class Body(NamedTuple):
    """Arrays of one PyElastica rod of N elements, under PyElastica's names without `_collection`.

    SI units, lab frame; directors (3, 3, N) hold a section's axes d1, d2, d3 as rows. All arrays
    are changed in place.
    """

    position: np.ndarray
    """(3, N + 1) [m]."""
    velocity: np.ndarray
    """(3, N + 1) [m/s]."""
    acceleration: np.ndarray
    """(3, N + 1) [m/s^2]."""
    director: np.ndarray
    """(3, 3, N) [-]."""
    omega: np.ndarray
    """(3, N) angular velocity, section frame [rad/s]."""
    alpha: np.ndarray
    """(3, N) angular acceleration, section frame [rad/s^2]."""
    radius: np.ndarray
    """(N,) [m]."""
    volume: np.ndarray
    """(N,) [m^3]."""
    mass: np.ndarray
    """(N + 1,) mass of each node [kg]."""
    inertia: np.ndarray
    """(3, 3, N) mass second moment of inertia [kg m^2]."""
    inv_inertia: np.ndarray
    """(3, 3, N) its inverse."""
    shear_matrix: np.ndarray
    """(3, 3, N) stiffness in shear and extension [N]."""
    bend_matrix: np.ndarray
    """(3, 3, N - 1) stiffness in bending and torsion [N m^2]."""
    lengths: np.ndarray
    """(N,) [m]."""
    rest_lengths: np.ndarray
    """(N,) [m]."""
    rest_voronoi_lengths: np.ndarray
    """(N - 1,) [m]."""
    tangents: np.ndarray
    """(3, N) [-]."""
    dilatation: np.ndarray
    """(N,) [-]."""
    dilatation_rate: np.ndarray
    """(N,) [1/s]."""
    voronoi_dilatation: np.ndarray
    """(N - 1,) [-]."""
    sigma: np.ndarray
    """(3, N) shear and axial strain [-]."""
    rest_sigma: np.ndarray
    """(3, N) [-]."""
    kappa: np.ndarray
    """(3, N - 1) curvature and twist [1/m]."""
    rest_kappa: np.ndarray
    """(3, N - 1) [1/m]."""
    internal_stress: np.ndarray
    """(3, N) internal force, section frame [N]."""
    internal_couple: np.ndarray
    """(3, N - 1) internal couple, section frame [N m]."""
    internal_forces: np.ndarray
    """(3, N + 1) [N]."""
    internal_torques: np.ndarray
    """(3, N) [N m]."""
    external_forces: np.ndarray
    """(3, N + 1) [N]."""
    external_torques: np.ndarray
    """(3, N) [N m]."""
    ghosts: np.ndarray
    """(0,) int32: PyElastica separates several rods in one block by ghosts; one rod has none."""


def straight_body(
    elements: int, length: float, radius: float, density: float, modulus: float
) -> Body:
    """A straight rod from the origin along z, d1 along x: PyElastica's `straight_rod`. SI units."""
    rod = elastica.CosseratRod.straight_rod(
        elements,
        np.zeros(3),
        np.array([0.0, 0.0, 1.0]),
        np.array([1.0, 0.0, 0.0]),
        length,
        radius,
        density,
        youngs_modulus=modulus,
        shear_modulus=modulus / 3.0,
    )
    names = {
        "inertia": "mass_second_moment_of_inertia",
        "inv_inertia": "inv_mass_second_moment_of_inertia",
    }
    moving = ("position", "velocity", "acceleration", "director", "omega", "alpha")
    arrays = {}
    for field in Body._fields[:-1]:
        name = names.get(field, f"{field}_collection" if field in moving else field)
        arrays[field] = np.ascontiguousarray(getattr(rod, name), np.float64).copy()
    body = Body(**arrays, ghosts=np.zeros(0, np.int32))
    measure_strains(body)
    return body


def largest_step(body: Body, stiffer: float = 1.0) -> float:
    """Largest stable time step [s] of the rod, with a margin.

    The Verlet step is stable below 2 / omega_max. The highest frequency is estimated from the
    shortest element, by axial waves, by shear with the section's rotation, and by bending from
    element to element; stiffer: factor by which internal forces raise stiffness [-].
    """
    dx = body.rest_lengths
    axial = 4.0 * body.shear_matrix[2, 2] * stiffer / dx / body.mass[1:-1].min()
    turning = body.shear_matrix[0, 0] * dx / body.inertia[0, 0]
    bending = 4.0 * body.bend_matrix[0, 0].max() * stiffer / dx / body.inertia[0, 0]
    highest = np.sqrt(np.maximum(axial, turning + bending).max())
    return MARGIN * 2.0 / float(highest)


@compiled
def measure_strains(body: Body) -> None:
    """Update lengths, axial strain and curvature from positions and directors."""
    _compute_shear_stretch_strains(
        body.position,
        body.volume,
        body.lengths,
        body.tangents,
        body.radius,
        body.rest_lengths,
        body.rest_voronoi_lengths,
        body.dilatation,
        body.voronoi_dilatation,
        body.director,
        body.sigma,
    )
    _compute_bending_twist_strains(body.director, body.rest_voronoi_lengths, body.kappa)


@compiled
def move_half(body: Body, step: float, base: np.ndarray, axes: np.ndarray) -> None:
    """Move positions and directors by half a step [s] and clamp the base.

    base: (3,) position of the first node [m]; axes: (3, 3) directors of the first element.
    """
    overload_operator_kinematic_numba(
        0.5 * step, body.position, body.director, body.velocity, body.omega
    )
    for i in range(3):
        body.position[i, 0] = base[i]
        for j in range(3):
            body.director[i, j, 0] = axes[i, j]


@compiled
def accelerate(
    body: Body,
    step: float,
    keep: float,
    gravity: np.ndarray,
    plane: np.ndarray,
    stiffness: float,
    base_velocity: np.ndarray,
) -> None:
    """Change the velocities by one step [s] under all forces on the rod.

    keep: share of velocity that the damper leaves, exp(-damping step); gravity: (3,) [m/s^2];
    plane: (2, 3) origin [m] and normal of an obstacle, used where stiffness [N/m] is not zero;
    base_velocity: (3,) of the clamped node [m/s].
    """
    _compute_internal_forces(
        body.position,
        body.volume,
        body.lengths,
        body.tangents,
        body.radius,
        body.rest_lengths,
        body.rest_voronoi_lengths,
        body.dilatation,
        body.voronoi_dilatation,
        body.director,
        body.sigma,
        body.rest_sigma,
        body.shear_matrix,
        body.internal_stress,
        body.internal_forces,
        body.ghosts,
    )
    _compute_internal_torques(
        body.position,
        body.velocity,
        body.tangents,
        body.lengths,
        body.rest_lengths,
        body.director,
        body.rest_voronoi_lengths,
        body.bend_matrix,
        body.rest_kappa,
        body.kappa,
        body.voronoi_dilatation,
        body.inertia,
        body.omega,
        body.internal_stress,
        body.internal_couple,
        body.dilatation,
        body.dilatation_rate,
        body.internal_torques,
        body.ghosts,
    )
    _gravity_forces(gravity, body.mass, body.external_forces)
    if stiffness > 0.0:
        # Damped by a tenth of what would stop the lightest element within a step.
        damping = 0.1 * body.mass[1] / step
        _calculate_contact_forces_rod_plane(
            plane[0].copy().reshape((3, 1)),
            plane[1],
            CONTACT_TOLERANCE_M,
            stiffness,
            damping,
            body.radius,
            body.mass,
            body.position,
            body.velocity,
            body.internal_forces,
            body.external_forces,
        )
    _update_accelerations(
        body.acceleration,
        body.internal_forces,
        body.external_forces,
        body.mass,
        body.alpha,
        body.inv_inertia,
        body.internal_torques,
        body.external_torques,
        body.dilatation,
    )
    for i in range(3):
        for k in range(body.velocity.shape[1]):
            body.velocity[i, k] = keep * (body.velocity[i, k] + step * body.acceleration[i, k])
        for k in range(body.omega.shape[1]):
            body.omega[i, k] = keep * (body.omega[i, k] + step * body.alpha[i, k])
        body.velocity[i, 0] = base_velocity[i]
        body.omega[i, 0] = 0.0
    _zeroed_out_external_forces_and_torques(body.external_forces, body.external_torques)


@compiled
def sections(body: Body, nodes: np.ndarray, centres: np.ndarray, frames: np.ndarray) -> None:
    """Centres (n, 3) [mm] and axes (n, 3, 3), in columns, of the sections at nodes (n,)."""
    last = body.director.shape[2] - 1
    for p in range(nodes.shape[0]):
        node = nodes[p]
        below, above = max(node - 1, 0), min(node, last)
        for d in range(3):
            centres[p, d] = 1e3 * body.position[d, node]
        for a in range(3):
            size = 0.0
            for d in range(3):
                frames[p, d, a] = body.director[a, d, below] + body.director[a, d, above]
                size += frames[p, d, a] ** 2
            for d in range(3):
                frames[p, d, a] /= math.sqrt(size)
