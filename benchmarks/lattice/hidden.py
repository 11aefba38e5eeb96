"""Hidden effects of the lattice by name: each changes parameters of its plant.

At strength 1 an effect moves the key points by some per mille to some per cent of the arm's length
(root mean square); signs and places vary with the robot's seed. The laws, and those of the arm
models:

| effect | law here | in the arm model |
|---|---|---|
| `payload` | mass at one side of the tip: a weight coincides | beam, to first order |
| `hysteresis` | friction of Dahl (1976) in each spring | play operators on chambers or on \
strains |
| `gain_mismatch` | two regulators out of calibration: a factor coincides | gain |
| `zero_offset` | two sensors whose zero has shifted, down to no pressure | constant |
| `line_lag` | long capillaries with volumes between them | one lag, laminar to turbulent |
| `creep` | retarded elements that stress hurries (Schapery 1969) | retarded loads or strains, \
log-normal spectrum |
| `misalignment` | rotation and shift of the cameras: coincides | rotation, shift, scale |
| `rate_dependence` | fluid of Cross (1965) in series with springs | Ellis' fluid |
| `contact` | a soft ball that dents the wall, node by node | one key point and a plane |
| `softening` | filaments that break when stretched (Daniels 1945) | exponential or inverse root \
in energy |
| `coupling` | torn ribs: chambers bulge into their neighbours | polynomial of loads; of their \
difference |
| `dead_zone` | bladders that touch the wall later towards the tip | smoothed by a root |
| `drift` | base that turns with the cube root of time (Andrade 1910) | saturating exponential |
| `stiffening` | crimped threads that become taut (Lanir 1979) | exponential (Fung) |
| `twist` | right-handed fibres stiffer than left-handed ones | polynomial of mean load |
| `thermal_drift` | modulus falls exponentially and the wall expands, late | gain by temperature |

`coupling`, `dead_zone` and `twist` have no law of motion at all: what they change follows from the
lattice. A weight, a factor on the pressure and a rigid motion of the cameras coincide with the arm
models by nature; so do slow flow and small stress, where retarded and viscous springs are linear.

Unknown ones are `breathing` (with pauses, no two breaths equal), `stick_slip` (a hose from the tip
through a dry guide), `clamp_slip` (the arm slides and rolls in its clamp at one moment), `buckling`
(one side of the wall snaps short when compressed, and back), `heat_step` (the wall stiffens at
one moment), `leak` (of one chamber, growing with time), `cable` (slack, and pulls from one bend on)
and `lens` (radial distortion of the cameras).
"""

import math
from collections.abc import Iterable

import numpy as np

from benchmarks.generators import EVENT_WINDOW_S, Setup, breath, misalignment, shift_zeros, sideways
from benchmarks.lattice.body import ALONG, LEFT, RIB, RIGHT
from benchmarks.lattice.gas import VOLUMES
from benchmarks.lattice.motion import new_state, settle
from benchmarks.lattice.plant import Plant
from benchmarks.lattice.robot import SLABS, STREAM
from surgisoft.rig.hidden import Hidden, random_direction, switch_on_from


def _length(plant: Plant) -> float:
    """Length of the arm [m]."""
    return float(plant.body.nodes[-1, 2])


def _radius(plant: Plant) -> float:
    """Radius of the arm [m]."""
    return float(np.hypot(*plant.body.nodes[-1, :2]))


def _section(plant: Plant) -> int:
    """Nodes in a cross-section."""
    return 1 + 3 * len(plant.body.faces)


def _last_wall_node(plant: Plant, rng: np.random.Generator) -> int:
    """One of the wall's nodes of the last cross-section."""
    return len(plant.body.nodes) - 1 - int(rng.integers(2 * len(plant.body.faces)))


def _shapes(plant: Plant, rng: np.random.Generator) -> np.ndarray:
    """(12, N, 3) nodes [m] at rest under random pressures in all chambers."""
    alone = plant._replace(ball=np.zeros(5), cable=np.zeros(6), guide=np.zeros(7))
    shapes = []
    for pressures in rng.random((12, len(plant.chambers))):
        state = new_state(alone)
        state.air[VOLUMES] = plant.high * pressures
        settle(alone, state)
        shapes.append(state.nodes.copy())
    return np.array(shapes)


def _compliance(plant: Plant) -> float:
    """Deflection of the tip under a force across the arm, that of a clamped beam [m/N]."""
    section = _section(plant)
    along = plant.rigidity[plant.body.kinds == ALONG][: section - 1]
    bend = 0.5 * float(along @ (plant.body.nodes[1:section, :2] ** 2).sum(axis=1))
    return _length(plant) ** 3 / (3.0 * bend)


def _payload(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    mass = setup.plant.mass.copy()
    mass[_last_wall_node(setup.plant, rng)] += 0.06 * strength * float(mass.sum())
    setup.change(mass=mass)


def _hysteresis(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    limit, way = setup.plant.wall.friction
    setup.change_wall(friction=np.array([limit + 0.05 * strength, way * rng.uniform(0.8, 2.0)]))


def _gain_mismatch(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    gains = setup.plant.gains.copy()
    two = rng.permutation(len(gains))[:2]
    for chamber, share in zip(two, (0.06, -rng.uniform(0.0, 0.04)), strict=True):
        gains[chamber] *= math.exp(strength * share * rng.choice([-1.0, 1.0]))
    setup.change(gains=gains)


def _zero_offset(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    shift_zeros(setup, strength, len(setup.plant.gains), rng)


def _line_lag(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """Capillaries so narrow that a chamber follows within some tenths of a second."""
    line = 20.0 / strength * rng.uniform(0.7, 1.3, len(setup.plant.gains))
    setup.change(gas=setup.plant.gas._replace(line=line))


def _creep(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change_wall(creep=0.15 * strength)


def _misalignment(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(misalignment=misalignment(strength, _length(setup.plant), rng))


def _rate_dependence(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    more = np.array([0.4 * strength, rng.uniform(0.3, 1.0), rng.uniform(0.5, 2.0)])
    setup.change_wall(fluid=np.array([setup.plant.wall.fluid[0] + more[0], *more[1:]]))


def _contact(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """A ball beside the upper half of the arm, on a side to which random pressures bend it.

    At strength 1 it is touched at two of five random pressures; a weaker one is farther away and
    softer.
    """
    plant, section = setup.plant, _section(setup.plant)
    layer = int(rng.integers(SLABS // 2 + 1, SLABS))
    axis = _shapes(plant, rng)[:, layer * section]
    middle = axis.mean(axis=0)
    way = axis[int(rng.integers(len(axis)))] - middle
    way /= np.linalg.norm(way)
    radius = rng.uniform(1.0, 2.5) * _radius(plant)
    touched = float(np.quantile((axis - middle) @ way, 0.35 + 0.5 * math.exp(-0.7 * strength)))
    centre = middle + (touched + radius + _radius(plant)) * way
    # As stiff as the arm several times, shared by the nodes of a few cross-sections.
    stiffness = min(4.0 * strength, 10.0) / _compliance(plant)
    setup.change(ball=np.array([*centre, radius, stiffness]))


def _softening(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change_wall(damage=0.6 * -math.expm1(-0.4 * strength))


def _coupling(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    soft = np.where(setup.plant.body.kinds == RIB, 1.0 / (1.0 + 4.0 * strength), 1.0)
    setup.change(rigidity=setup.plant.rigidity * soft)


def _dead_zone(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(loose=0.06 * strength * setup.plant.high)


def _drift(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(drift=0.025 * strength * sideways(rng))


def _stiffening(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change_wall(threads=setup.plant.wall.threads + 0.3 * strength)


def _twist(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    share = math.tanh(0.3 * strength) * rng.choice([-1.0, 1.0])
    kinds = setup.plant.body.kinds
    more = 1.0 + share * ((kinds == RIGHT).astype(float) - (kinds == LEFT))
    setup.change(rigidity=setup.plant.rigidity * more)


def _thermal_drift(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(warmth=strength * np.array([8e-3, rng.uniform(1e-4, 3e-4)]))


def _breathing(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(breath=breath(strength, _length(setup.plant), rng))


def _stick_slip(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """A hose from the tip to a guide beside the base, as stiff as the arm itself."""
    plant = setup.plant
    node = _last_wall_node(plant, rng)
    anchor = 1.5 * plant.body.nodes[node] * np.array([1.0, 1.0, 0.0])
    stiffness = 2.0 * (_radius(plant) / _length(plant)) ** -2 / _compliance(plant)
    slides = 0.01 * strength * _length(plant) / _compliance(plant) * 4.0
    setup.change(guide=np.array([*anchor, node, stiffness, slides, 0.3 * slides]))


def _clamp_slip(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    shift = -0.006 * strength * _length(setup.plant)
    roll = 0.03 * strength * rng.choice([-1.0, 1.0])
    setup.change(slip=np.array([shift, roll, rng.uniform(*EVENT_WINDOW_S)]))


def _buckling(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """One side of the wall over three slabs of the lower half."""
    plant, section = setup.plant, _section(setup.plant)
    side, slab = sideways(rng), int(rng.integers(0, 3))
    ends = plant.body.ends
    outside = (plant.body.nodes[ends] @ side).min(axis=1) > 0.5 * _radius(plant)
    there = (ends[:, 0] >= slab * section) & (ends[:, 0] < (slab + 3) * section)
    patch = outside & there & (plant.body.kinds == ALONG)
    size = 2.0 * -math.expm1(-0.5 * strength)
    # Shorter by itself, a spring that has buckled returns only when it is stretched.
    setup.change(patch=patch.astype(float), buckling=np.array([size, -0.25, 0.1]))


def _heat_step(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(heat=np.array([0.08 * strength, rng.uniform(*EVENT_WINDOW_S)]))


def _leak(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    chamber = int(rng.integers(len(setup.plant.gains)))
    growing = 1e-3 * strength * setup.plant.gas.line[chamber] / VOLUMES
    setup.change(gas=setup.plant.gas._replace(leak=np.array([growing, chamber])))


def _cable(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """A cable along the wall that is taut at every other of random pressures."""
    plant, shapes = setup.plant, _shapes(setup.plant, rng)
    node = _last_wall_node(plant, rng)
    anchor = 1.3 * plant.body.nodes[node] * np.array([1.0, 1.0, 0.0])
    free = float(np.median(np.linalg.norm(shapes[:, node] - anchor, axis=1)))
    rigidity = 0.05 * strength * (_length(plant) / _radius(plant)) ** 2 / _compliance(plant) * free
    setup.change(cable=np.array([*anchor, node, free, rigidity]))


def _lens(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    length = _length(setup.plant)
    centre = np.array([0.0, 0.0, 0.5 * length]) + 0.2 * length * random_direction(rng)
    bent = 0.04 * strength * rng.choice([-1.0, 1.0]) / (0.5 * length) ** 2
    setup.change(lens=np.array([*sideways(rng), *centre, bent]))


HIDDEN: dict[str, Hidden[Setup]] = {
    "payload": Hidden("body", "unweighed mass at one side of the tip", _payload),
    "hysteresis": Hidden("material", "more friction in the springs (Dahl)", _hysteresis),
    "gain_mismatch": Hidden("line", "two regulators out of calibration", _gain_mismatch),
    "zero_offset": Hidden("sensor", "two pressure sensors whose zero has shifted", _zero_offset),
    "line_lag": Hidden("line", "long capillaries behind the sensors", _line_lag),
    "creep": Hidden("material", "springs that yield faster under stress", _creep),
    "misalignment": Hidden("sensor", "camera frame turned and shifted", _misalignment),
    "rate_dependence": Hidden("material", "a fluid of Cross in the springs", _rate_dependence),
    "contact": Hidden("body", "a soft ball beside the arm", _contact),
    "softening": Hidden("material", "filaments that break when stretched", _softening),
    "coupling": Hidden("material", "torn ribs between the chambers", _coupling),
    "dead_zone": Hidden("material", "bladders loose in their chambers", _dead_zone),
    "drift": Hidden("body", "the base turns with the cube root of time", _drift),
    "stiffening": Hidden("material", "threads that become taut", _stiffening),
    "twist": Hidden("material", "fibres of one handedness are stiffer", _twist),
    "thermal_drift": Hidden("material", "a warming room; temp_C", _thermal_drift),
    "breathing": Hidden("body", "the base moves with a breathing body", _breathing),
    "stick_slip": Hidden("body", "a hose through a dry guide", _stick_slip),
    "clamp_slip": Hidden("body", "the arm slides and rolls in its clamp once", _clamp_slip),
    "buckling": Hidden("material", "one side of the wall snaps short", _buckling),
    "heat_step": Hidden("material", "the wall stiffens at one moment", _heat_step),
    "leak": Hidden("line", "a leak of one chamber that grows", _leak),
    "cable": Hidden("body", "a slack cable that pulls from one bend on", _cable),
    "lens": Hidden("sensor", "radial distortion of the cameras", _lens),
}


def switch_on(setup: Setup, names: Iterable[tuple[str, float]], seed: int) -> Setup:
    """`switch_on_from` the hidden effects of the lattice."""
    return switch_on_from(HIDDEN, setup, names, seed, STREAM)
