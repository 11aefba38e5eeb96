"""Hidden effects of the rod by name: each changes parameters of its plant.

At strength 1 an effect moves the key points by some per mille to some per cent of the arm's length
(root mean square); signs and places vary with the robot's seed. The laws, and those of the arm
models:

| effect | law here | in the arm model |
|---|---|---|
| `payload` | weight beside the tip: a weight coincides | beam, to first order |
| `hysteresis` | friction of fibres that pressure presses together (Tondu & Lopez 2000; Wen \
1976) | play operators on chambers or on strains |
| `gain_mismatch` | two chambers of other areas: proportional, so it coincides | gain |
| `zero_offset` | two sensors whose zero has shifted, down to no pressure | constant |
| `line_lag` | turbulent flow in smooth hoses (Blasius 1913) with a volume between | one lag, \
laminar to turbulent |
| `creep` | flow by the hyperbolic sine of stress (Garofalo 1965) against a spring | retarded \
loads or strains, log-normal spectrum |
| `misalignment` | rotation and shift of the cameras: coincides | rotation, shift, scale |
| `rate_dependence` | fluid of Powell & Eyring (1944) beside the wall | Ellis' fluid |
| `contact` | a plate that stiffens exponentially, along the whole body (Winkler 1867) | one key \
point and a plane |
| `softening` | chains pulled out of hard domains (Qi & Boyce 2004) | exponential or inverse root \
in energy |
| `coupling` | septa that move at a constant section of all chambers (Laplace 1806) | polynomial \
of loads; of their difference |
| `dead_zone` | threads of a fabric that become taut at logistic lengths (Verhulst 1838) | \
smoothed by a root |
| `drift` | base that turns with a hyperbola of time (Ross 1937) | saturating exponential |
| `stiffening` | chains of limited length under the section's mean square strain (Kuhn & Gruen \
1942; Cohen 1991) | exponential (Fung) |
| `twist` | helical fibres: stretch turns the sections, and torsion stretches them (Love 1927) | \
polynomial of the mean load |
| `thermal_drift` | entropic modulus, of a wall that follows the room (James & Guth 1943), weight \
included | gain by temperature |

Laws of other generators that come near: `hysteresis` has the form of PyElastica's with another
power and a limit that goes with pressure; `creep` and PyElastica's fast viscosity both have a
hyperbolic sine; chains of limited length are Gent's (PyElastica) to first order. Slow flow in a
hose and small stresses are linear here as in the arm models. A weight, a factor on the pressure and
a rigid motion of the cameras coincide with all of them by nature.

Unknown ones are `breathing` (a ventilator: a constant flow in, an exponential one out),
`stick_slip` (the table is dragged slowly and slips back at irregular moments), `relief` (a valve
behind the sensor that opens above a pressure and closes below a lower one), `crossflow` (two
chambers exchange air in spells), `footsteps` (blows after which the table rings down),
`fibre_break` (from one moment on a chamber pushes more over a part of its length), `winding_hose`
(a pull at the tip that goes around) and `sunbeam` (one side of the arm is warmed in spells, and
bends it).
"""

import math
from collections.abc import Iterable

import numpy as np

from benchmarks.generators import EVENT_WINDOW_S, Setup, breath, misalignment, shift_zeros, sideways
from benchmarks.strain_rod.motion import move, new_state, place_arm
from benchmarks.strain_rod.robot import PARTS, STREAM, Plant
from surgisoft.rig.hidden import Hidden, switch_on_from

SHAPES = 8
"""Random pressures at which an arm is looked at, to place what it may touch."""
SETTLING = 200
"""Steps in which it comes to rest there."""


def _tip_stiffness(plant: Plant) -> float:
    """Force across the tip per deflection of the arm as a cantilever, 3 E I / L^3 [N/m]."""
    return 3.0 * float(plant.bend.mean()) / plant.length**3


def _shapes(plant: Plant, rng: np.random.Generator) -> np.ndarray:
    """(SHAPES, N + 1, 3) nodes [m] at rest under random pressures."""
    state, shapes = new_state(plant), []
    for pressures in rng.random((SHAPES, len(plant.areas))):
        state.air[3] = plant.high * pressures
        for _ in range(SETTLING):
            move(plant, state, 0.01)
        place_arm(plant, state)
        shapes.append(state.nodes.copy())
    return np.array(shapes)


def _spells(on_s: tuple[float, float], off_s: float, rng: np.random.Generator) -> np.ndarray:
    """(K, 2) begin and end of random spells in the first quarter of an hour [s]."""
    gaps = rng.exponential(off_s, 100)
    lasting = rng.uniform(*on_s, 100)
    begin = np.cumsum(gaps) + np.concatenate([[0.0], np.cumsum(lasting[:-1])])
    return np.stack([begin, begin + lasting], axis=1)[begin < 900.0]


def _payload(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    plant = setup.plant
    place = 1.2 * plant.radius * sideways(rng) + np.array([0.0, 0.0, 0.3 * plant.radius])
    setup.change(payload=np.array([0.12 * strength * plant.mass, *place]))


def _hysteresis(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    stress, share, slip = setup.plant.wall.friction
    stress, slip = stress + 0.1 * strength, slip * rng.uniform(0.8, 2.0)
    setup.change_wall(friction=np.array([stress, share, slip]))


def _gain_mismatch(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """Two chambers of other areas, one larger and one smaller."""
    areas = setup.plant.areas.copy()
    two = rng.permutation(len(areas))[:2]
    for chamber, share in zip(two, (0.07, -rng.uniform(0.0, 0.05)), strict=True):
        areas[chamber] *= math.exp(strength * share * rng.choice([-1.0, 1.0]))
    setup.change(areas=areas)


def _zero_offset(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    shift_zeros(setup, strength, len(setup.plant.areas), rng)


def _line_lag(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    line = setup.plant.gas.line
    slower = 1.0 + 8.0 * strength * rng.uniform(0.7, 1.3, len(line))
    setup.change(gas=setup.plant.gas._replace(line=line / slower))


def _creep(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change_wall(flow=np.array([0.12 * strength, 0.15, rng.uniform(8.0, 40.0)]))


def _misalignment(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(misalignment=misalignment(strength, setup.plant.length, rng))


def _rate_dependence(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change_wall(fluid=np.array([0.07 * strength, rng.uniform(3.0, 12.0)]))


def _contact(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """A plate beside the upper half of the arm, on a side to which random pressures bend it."""
    plant, node = setup.plant, int(rng.integers(PARTS // 2 + 1, PARTS))
    shapes = _shapes(plant, rng)
    way = shapes[int(rng.integers(SHAPES)), node] - shapes[:, node].mean(axis=0)
    way[2] *= 0.3
    way /= np.linalg.norm(way)
    deepest = (shapes @ way).max(axis=1)  # of the body in each shape
    low, high = float(deepest.min()), float(deepest.max())
    touched = high - 0.35 * strength**0.45 * (high - low) + plant.radius
    stiffness = 4.0 * _tip_stiffness(plant) / (0.5 * plant.length)
    setup.change(plate=np.array([*(touched * way), *-way, stiffness, 0.05 * plant.length]))


def _softening(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change_wall(damage=0.95 * -math.expm1(-0.5 * strength))


def _coupling(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(septum=np.array([0.12 * strength, 0.3 * setup.plant.high]))


def _dead_zone(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    m = len(setup.plant.areas)
    setup.change(slack=0.04 * strength * setup.plant.high * rng.uniform(0.8, 1.2, m))


def _drift(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(drift=0.03 * strength * sideways(rng))


def _stiffening(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change_wall(locking=setup.plant.wall.locking + 0.1 * strength)


def _twist(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change_wall(helix=0.2 * strength * rng.choice([-1.0, 1.0]))


def _thermal_drift(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(warmth=6.0 * strength)


def _breathing(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(breath=breath(strength, setup.plant.length, rng))


def _stick_slip(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """A table that is turned by 0.02 rad in 12 s, and slips back by most of what it was turned."""
    rate = 0.02 * strength / 12.0
    moments = np.cumsum(rng.uniform(3.0, 20.0, 80))
    turned, slips = 0.0, []
    for before, now in zip(np.concatenate([[0.0], moments[:-1]]), moments, strict=True):
        turned = (turned + rate * (now - before)) * rng.uniform(0.0, 0.4)
        slips.append([now, turned])
    setup.change(slips=np.array(slips), dragged=np.array([rate, *sideways(rng)]))


def _relief(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """It opens at 0.45 of the limit and closes at 0.2 of it."""
    plant = setup.plant
    chamber = int(rng.integers(len(plant.areas)))
    vents = 0.1 * strength * plant.gas.line[chamber]
    relief = np.array([chamber, 0.45 * plant.high, 0.2 * plant.high, vents])
    setup.change(gas=plant.gas._replace(relief=relief))


def _crossflow(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    plant, m = setup.plant, len(setup.plant.areas)
    two = rng.permutation(3 if m == 6 else m)[:2]
    crossed = np.array([*two, 0.06 * strength * plant.gas.line.mean()])
    spells = _spells((3.0, 15.0), 6.0, rng)
    setup.change(gas=plant.gas._replace(crossed=crossed, crossing=spells))


def _footsteps(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    moments = np.cumsum(rng.exponential(2.5, 200))
    turn = 0.04 * strength * sideways(rng)
    frequency = 2.0 * math.pi * rng.uniform(0.8, 2.0)
    setup.change(steps=moments, shaken=np.array([*turn, frequency, rng.uniform(0.05, 0.12)]))


def _fibre_break(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """Over a third of the chamber's length."""
    plant, m = setup.plant, len(setup.plant.areas)
    chamber, each = int(rng.integers(m)), plant.basis.shape[0]
    first = each * (chamber // 3 if m == 6 else 0) + int(rng.integers(1, each // 3))
    moment = rng.uniform(*EVENT_WINDOW_S)
    broken = [chamber, first, first + each // 3, moment, 0.35 * strength]
    setup.change(broken=np.array(broken, dtype=float))


def _winding_hose(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    pull = 0.015 * strength * setup.plant.length * _tip_stiffness(setup.plant)
    setup.change(hose=np.array([pull, rng.uniform(35.0, 80.0), rng.uniform(0.0, 2.0 * np.pi)]))


def _sunbeam(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    sun = 0.05 * strength * sideways(rng)[:2] * (2.0 if len(setup.plant.areas) != 6 else 1.0)
    setup.change(sun=sun, shining=_spells((15.0, 50.0), 20.0, rng))


HIDDEN: dict[str, Hidden[Setup]] = {
    "payload": Hidden("body", "unweighed mass beside the tip", _payload),
    "hysteresis": Hidden("material", "fibres that pressure presses together", _hysteresis),
    "gain_mismatch": Hidden("material", "two chambers of other areas", _gain_mismatch),
    "zero_offset": Hidden("sensor", "two pressure sensors whose zero has shifted", _zero_offset),
    "line_lag": Hidden("line", "narrow hoses behind the sensors", _line_lag),
    "creep": Hidden("material", "a wall that flows by the sinh of stress", _creep),
    "misalignment": Hidden("sensor", "camera frame turned and shifted", _misalignment),
    "rate_dependence": Hidden("material", "a fluid of Powell and Eyring", _rate_dependence),
    "contact": Hidden("body", "a plate beside the arm", _contact),
    "softening": Hidden("material", "chains pulled out of hard domains", _softening),
    "coupling": Hidden("material", "septa that move between chambers", _coupling),
    "dead_zone": Hidden("material", "a fabric whose threads become taut", _dead_zone),
    "drift": Hidden("body", "the base turns with a hyperbola of time", _drift),
    "stiffening": Hidden("material", "chains of limited length", _stiffening),
    "twist": Hidden("material", "helical fibres that couple stretch and torsion", _twist),
    "thermal_drift": Hidden("material", "a warm room stiffens the wall; temp_C", _thermal_drift),
    "breathing": Hidden("body", "the base moves with a ventilated body", _breathing),
    "stick_slip": Hidden("body", "a dragged table that slips back", _stick_slip),
    "relief": Hidden("line", "a relief valve behind a sensor", _relief),
    "crossflow": Hidden("line", "two chambers exchange air in spells", _crossflow),
    "footsteps": Hidden("body", "blows after which the table rings down", _footsteps),
    "fibre_break": Hidden("material", "fibres that break at one moment", _fibre_break),
    "winding_hose": Hidden("body", "a pull at the tip that goes around", _winding_hose),
    "sunbeam": Hidden("body", "one side of the arm is warmed in spells", _sunbeam),
}


def switch_on(setup: Setup, names: Iterable[tuple[str, float]], seed: int) -> Setup:
    """`switch_on_from` the hidden effects of the rod."""
    return switch_on_from(HIDDEN, setup, names, seed, STREAM)
