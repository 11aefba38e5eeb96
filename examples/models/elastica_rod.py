"""A Cosserat rod in PyElastica as a callable model: steady states on a grid of pressures.

Each pressure of a chamber curves and stretches the rod at rest, and the rod sags under its own
weight. PyElastica (Gazzola et al. 2018; Tekinalp et al.) moves the rod from there until it rests,
which takes a fraction of a second for one set of pressures. A recording has thousands of them, so
the rod is solved on a grid once, when it is first called, and interpolated in between: a static
model. Inertia does not count in a steady state, so the density is chosen for a long time step, and
the weight is stated by itself.

The virtual rig `elastica` of the package has a rod of its own, which moves; this file imports
nothing of it, so that it can be copied and changed.

    surgisoft compare examples/models/elastica_rod.py:rod bench.parquet

PyElastica is the extra `elastica`: pip install 'surgisoft[elastica]'.
"""

import itertools

import numpy as np

DAMPING_PER_S = 8.0
"""Damping of the motion towards rest, 1/s: below critical for a first bending mode of 1 Hz."""
REST_S = 4.0
"""Time of that motion, s: it has then fallen by exp(-16)."""


class ElasticaRod:
    """A clamped rod of m chambers around its axis; key points at equal distances along it."""

    static = True
    unit = "kPa"

    def __init__(
        self,
        length_mm=70.0,
        radius_mm=7.5,
        stiffness_kPa=115.0,
        weight_N=0.12,
        gravity=(0.42, 0.0, 0.9075),
        low=(-15.0, -15.0, -15.0),
        high=(55.0, 55.0, 55.0),
        bend_rad_per_kPa=0.019,
        stretch_per_kPa=0.0013,
        levels=4,
        elements=12,
        key_points=5,
    ):
        """bend_rad_per_kPa: angle of the tip; the first chamber lies at y, the others evenly on."""
        self.length_mm, self.radius_mm, self.weight_N = length_mm, radius_mm, weight_N
        self.stiffness_kPa, self.gravity = stiffness_kPa, np.array(gravity)
        self.gravity = self.gravity / np.linalg.norm(self.gravity)
        self.low, self.high = np.array(low), np.array(high)
        angle = np.pi / 2 + 2 * np.pi * np.arange(len(low)) / len(low)
        # A chamber bends the arm away from its side.
        self.bend = -bend_rad_per_kPa * np.array([np.cos(angle), np.sin(angle)])
        self.stretch = stretch_per_kPa
        self.levels, self.elements, self.key_points = levels, elements, key_points
        self._interpolator = None

    def __call__(self, time_s, actuation):
        """Key points (T, n, 3) in mm, base frame, from actuation (T, m) in kPa."""
        if self._interpolator is None:
            self._interpolator = self._table()
        return self._interpolator(np.clip(actuation, self.low, self.high))

    def _table(self):
        from scipy.interpolate import RegularGridInterpolator

        axes = [np.linspace(a, b, self.levels) for a, b in zip(self.low, self.high, strict=True)]
        solved = [self.at_rest(np.array(each)) for each in itertools.product(*axes)]
        shape = (*[self.levels] * len(axes), self.key_points, 3)
        method = "cubic" if self.levels > 3 else "linear"
        return RegularGridInterpolator(axes, np.reshape(solved, shape), method=method)

    def at_rest(self, pressure):
        """(n, 3) key points in mm where the rod rests at pressures (m,) in kPa."""
        import elastica

        class Bench(
            elastica.BaseSystemCollection,
            elastica.Constraints,
            elastica.Forcing,
            elastica.Damping,
        ):
            pass

        # Units of the rod: m, kg, s. The density sets the time scale only: a first bending mode
        # of about 1 Hz, w = 3.52 / L^2 sqrt(E I / (rho A)).
        length, radius = self.length_mm / 1e3, self.radius_mm / 1e3
        modulus, area = 1e3 * self.stiffness_kPa, np.pi * radius**2
        density = modulus * radius**2 / 4 * (3.52 / length**2 / (2 * np.pi)) ** 2
        rod = elastica.CosseratRod.straight_rod(
            self.elements,
            np.zeros(3),
            np.array([0.0, 0.0, 1.0]),
            np.array([1.0, 0.0, 0.0]),
            length,
            radius,
            density,
            youngs_modulus=modulus,
            shear_modulus=modulus / 3.0,
        )
        # A bend b in x, y turns the cross-sections by (-b_y, b_x, 0) from base to tip.
        bend = self.bend @ pressure
        turn = np.array([-bend[1], bend[0], 0.0])
        local = rod.director_collection[..., 0] @ turn
        # The clamp holds the whole first element, so the others share the bend.
        share = self.elements / (self.elements - 1)
        rod.rest_kappa[:] = local[:, None] / length * share
        rod.rest_sigma[2] = self.stretch * float(np.sum(pressure))
        bench = Bench()
        bench.append(rod)
        fixed = {"constrained_position_idx": (0,), "constrained_director_idx": (0,)}
        bench.constrain(rod).using(elastica.OneEndFixedBC, **fixed)
        pull = self.weight_N / (density * area * length) * self.gravity
        bench.add_forcing_to(rod).using(elastica.GravityForces, acc_gravity=pull)
        step = 0.3 * length / self.elements * np.sqrt(density / modulus)
        bench.dampen(rod).using(
            elastica.AnalyticalLinearDamper,
            uniform_damping_constant=DAMPING_PER_S,
            time_step=step,
        )
        bench.finalize()
        stepper = elastica.PositionVerlet()
        time = np.float64(0.0)
        for _ in range(round(REST_S / step)):
            time = stepper.step(bench, time, np.float64(step))
        along = np.linspace(0, 1, self.key_points)
        nodes = np.linspace(0, 1, self.elements + 1)
        points = 1e3 * rod.position_collection
        return np.column_stack([np.interp(along, nodes, axis) for axis in points])


rod = ElasticaRod()
