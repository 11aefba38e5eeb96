"""Hidden effects of the PyElastica rig by name: each changes the parameters of its plant.

At strength 1 an effect moves the key points of most robots by about a millimetre (root mean square
over the `mixed` protocol). Signs and places vary with the robot's seed.

Two effects coincide with the arm model's by nature: `misalignment` (cameras that are turned and
shifted see a rigid motion) and the force of `payload` (a weight at the tip). A chamber of another
area (`gain_mismatch`) pushes in proportion, as a gain does, but its centroid moves too. All others
have another law, stated in `wall`, `gas` and `plant`, and act on the rod's strains, couples, air
and clamp rather than on pressures or key points.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from surgisoft.rig.elastica.plant import Plant, advance, new_state, rest
from surgisoft.rig.elastica.rod import Body
from surgisoft.rig.hidden import EVENT_WINDOW_S, Hidden, random_direction, switch_on_from

STREAM = 0xE1A
"""Number that tells this rig's draws from those of the virtual rig with the same seed."""


@dataclass
class Setup:
    """Parameters that a hidden effect may change."""

    plant: Plant
    """Parameters of the rig."""
    body: Body
    """The rod as cast; its masses may change."""
    event_window_s: tuple[float, float] = EVENT_WINDOW_S
    """Window of time in which events that occur once fall [s]."""


def _set(setup: Setup, **values) -> None:
    setup.plant = setup.plant._replace(**values)


def _set_wall(setup: Setup, **values) -> None:
    _set(setup, wall=setup.plant.wall._replace(**values))


def _set_gas(setup: Setup, **values) -> None:
    _set(setup, gas=setup.plant.gas._replace(**values))


def _sideways(rng: np.random.Generator) -> np.ndarray:
    """(3,) random unit vector across the arm."""
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([math.cos(angle), math.sin(angle), 0.0])


def _length(setup: Setup) -> float:
    """Length of the arm [m]."""
    return float(setup.body.rest_lengths.sum())


def _hysteresis(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    more = 0.1 * strength * np.array([0.4, 0.6])
    _set_wall(setup, friction=setup.plant.wall.friction + more)


def _rate_dependence(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    _, scale, _ = setup.plant.wall.viscous
    viscous = np.array([0.8, scale + 0.1 * strength, rng.uniform(0.4, 1.2)])
    _set_wall(setup, viscous=viscous)


def _creep(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    _set_wall(setup, creep=1.0 - math.exp(-0.3 * strength))


def _softening(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    _set_wall(setup, softening=0.85 * (1.0 - math.exp(-strength)))


def _stiffening(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    _set_wall(setup, locking=setup.plant.wall.locking + 0.12 * strength)


def _line_lag(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """Tubes so narrow that a chamber follows within a good part of a second; unlike lengths."""
    m = len(setup.plant.areas)
    narrow = setup.plant.volumes.mean() / (5.0 * strength * rng.uniform(0.8, 1.25, m))
    _set_gas(setup, line=narrow)


def _dead_zone(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    m = len(setup.plant.areas)
    _set(setup, unfold=0.035 * strength * setup.plant.high * rng.uniform(0.85, 1.15, m))


def _gain_mismatch(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """One chamber with another area; what it gains lies outside, so its centroid moves too."""
    chamber, sign = int(rng.integers(len(setup.plant.areas))), rng.choice([-1.0, 1.0])
    areas, levers = setup.plant.areas.copy(), setup.plant.levers.copy()
    areas[chamber] *= math.exp(0.08 * strength * sign)
    levers[chamber] *= math.exp(0.02 * strength * sign)
    _set(setup, areas=areas, levers=levers)


def _zero_offset(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """A permanent set: the wall stays bent, the more the nearer to the base."""
    count, curvature = setup.plant.bow.shape[1], 0.05 * strength * setup.plant.curvature
    share = np.linspace(1.3, 0.7, count)
    _set(setup, bow=setup.plant.bow + curvature * _sideways(rng)[:2, None] * share)


def _coupling(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """Thin walls between neighbours in the ring of chambers."""
    m = len(setup.plant.areas)
    stolen = np.zeros((m, m))
    for i in range(m):
        for j in {(i + 1) % m, (i - 1) % m} - {i}:
            stolen[i, j] = 0.09 * strength * rng.uniform(0.8, 1.2)
    _set(setup, stolen=stolen)


def _inertia(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """A damper that holds less: the rod's own inertia lets the arm swing after a step."""
    _set(setup, keep=setup.plant.keep ** math.exp(-1.2 * strength))


def _payload(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.body.mass[-1] += 0.03 * strength * setup.body.mass.sum()


def _misalignment(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    turn = 0.04 * strength / (_length(setup) / 0.02) * random_direction(rng)
    _set(setup, misalignment=np.concatenate([turn * 2.0, 0.4 * strength * random_direction(rng)]))


def _drift(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    _set(setup, drift=2e-3 * strength / _length(setup) * _sideways(rng))


def _knock(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    turn = 2e-3 * strength / _length(setup) * _sideways(rng)
    _set(setup, knock=np.append(turn, rng.uniform(*setup.event_window_s)))


def _twist(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    _set(setup, fibre=0.12 * strength * rng.choice([-1.0, 1.0]))


def _thermal_drift(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    _set(setup, warmth=0.03 * strength)


def _contact(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """A wall beside the arm, at a share of the way that the arm goes towards it; roughly on the
    side to which one chamber bends the arm.

    At strength 1 it stands at 70 % of that way, at large strengths at 10 %.
    """
    m, high = len(setup.plant.areas), setup.plant.high
    singles = high * np.eye(m)
    shapes = [_shape(setup, p) for p in [np.zeros(m), *singles, *(high - singles)]]
    aside = (shapes[1 + int(rng.integers(m))] - shapes[0])[:2, -1]
    angle = math.atan2(aside[1], aside[0]) + math.radians(rng.uniform(-40.0, 40.0))
    towards = np.array([math.cos(angle), math.sin(angle), 0.0])
    reaches = [float((towards @ shape).max()) for shape in shapes]
    share = 0.1 + 0.6 * 2.0 ** (1.0 - strength) if strength > 1.0 else 0.95 - 0.25 * strength
    surface = reaches[0] + share * (max(reaches) - reaches[0])
    origin = (surface + setup.plant.radius) * towards
    # A wall much stiffer than the arm under a force at its tip, and soft enough for the time step.
    stiffness = 100.0 * 3.0 * setup.plant.bend.mean() / _length(setup) ** 3
    stable = 0.1 * setup.body.mass[1:-1].min() / setup.plant.step**2
    _set(setup, plane=np.stack([origin, -towards]), plane_stiffness=float(min(stiffness, stable)))


def _shape(setup: Setup, pressures: np.ndarray) -> np.ndarray:
    """(3, N + 1) centre line [m] of the arm some seconds after a step to pressures (m,) [Pa]."""
    plant = setup.plant
    body = Body(*(array.copy() for array in setup.body))
    state = new_state(plant, body)
    rest(plant, state, 0.0)
    state.air.target[:] = pressures
    advance(plant, state, round(2.0 / plant.step), True)
    return body.position


def _breathing(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    period = rng.uniform(3.2, 5.0)
    shift = 2e-3 * strength * random_direction(rng)
    _set(setup, breath=np.array([*shift, period, rng.uniform(0.0, period)]))


def _stick_slip(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """A bracket that yields in jerks, each of a quarter of what one chamber can turn it by."""
    couple = float(setup.plant.bend.mean() * setup.plant.curvature)
    turned = 2.5e-3 * strength / _length(setup)
    _set(setup, bracket=np.array([turned / couple, 0.25 * couple]))


def _leak(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """A crack in one chamber that opens at high pressure: the flow along the tube takes pressure
    away. (A hole that is always open takes a share of the pressure, which is another gain.)"""
    leak = np.zeros(len(setup.plant.areas))
    chamber = int(rng.integers(len(leak)))
    leak[chamber] = 0.3 * strength * setup.plant.gas.line[chamber]
    _set_gas(setup, leak=leak)


def _tear(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """The wall tears across the arm in its lower half, so that it bends more there."""
    node = int(rng.integers(1, max(2, len(setup.plant.bend) // 2)))
    share = 1.0 - math.exp(-0.25 * strength)
    moment = rng.uniform(*setup.event_window_s)
    _set(setup, tear=np.array([share, float(node), moment]))


def _marker_slip(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """The ring of markers of one key plane slides towards the base or the tip."""
    plane = int(rng.integers(len(setup.plant.nodes)))
    way = 3.0 * strength * rng.choice([-1.0, 1.0])
    moment = rng.uniform(*setup.event_window_s)
    _set(setup, slip=np.array([way, float(plane), moment]))


HIDDEN: dict[str, Hidden[Setup]] = {
    "hysteresis": Hidden("material", "more elastoplastic friction in the wall", _hysteresis),
    "rate_dependence": Hidden("material", "an Eyring fluid in the wall", _rate_dependence),
    "line_lag": Hidden("line", "narrow tubes behind the sensors, ISO 6358 flow", _line_lag),
    "creep": Hidden("material", "stress that relaxes with the logarithm of time", _creep),
    "softening": Hidden("material", "damage by the largest strain so far", _softening),
    "stiffening": Hidden("material", "chains of limited length (Gent)", _stiffening),
    "dead_zone": Hidden("material", "folded membranes that have to unfold", _dead_zone),
    "gain_mismatch": Hidden("material", "one chamber of another area", _gain_mismatch),
    "zero_offset": Hidden("material", "a wall with a permanent set", _zero_offset),
    "coupling": Hidden("material", "chambers bulge into their neighbours", _coupling),
    "inertia": Hidden("material", "less damping: the arm swings", _inertia),
    "payload": Hidden("body", "unweighed mass at the tip", _payload),
    "contact": Hidden("body", "a stiff wall beside the arm", _contact),
    "misalignment": Hidden("sensor", "camera frame turned and shifted", _misalignment),
    "drift": Hidden("body", "the bracket creeps with the logarithm of time", _drift),
    "thermal_drift": Hidden("material", "a warming room softens the wall; temp_C", _thermal_drift),
    "twist": Hidden("body", "fibres at an angle: pressure twists the arm", _twist),
    "breathing": Hidden("body", "the base moves with a breathing body", _breathing),
    "stick_slip": Hidden("body", "a bracket with dry friction that yields in jerks", _stick_slip),
    "leak": Hidden("line", "a crack in one chamber that opens at high pressure", _leak),
    "knock": Hidden("body", "the bracket is knocked aside at one moment", _knock),
    "tear": Hidden("material", "the wall tears at one place, at one moment", _tear),
    "marker_slip": Hidden("sensor", "a ring of markers slides at one moment", _marker_slip),
}


def switch_on(setup: Setup, names: Iterable[tuple[str, float]], seed: int) -> Setup:
    """`switch_on_from` the hidden effects of the PyElastica rig."""
    return switch_on_from(HIDDEN, setup, names, seed, STREAM)
