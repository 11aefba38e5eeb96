"""Hidden effects of the chain by name: each changes parameters of its plant.

At strength 1 an effect moves the key points by about one per cent of the arm's length (root mean
square); signs and places vary with the robot's seed. The laws, and those of the arm models:

| effect | law here | in the arm model |
|---|---|---|
| `payload` | weight at the tip of the chain: a weight coincides | beam, to first order |
| `hysteresis` | rubber friction of each joint (Berg 1998) | play operators on chambers or on \
strains |
| `gain_mismatch` | two chambers of other areas: proportional, so it coincides | gain |
| `zero_offset` | two sensors whose zero has shifted, down to no pressure | constant |
| `line_lag` | isentropic nozzle, discharge by Perry (1949) | tube, root of the difference |
| `creep` | network that relaxes by a power of its stress (Bergstrom & Boyce 1998) | retarded \
loads or strains |
| `misalignment` | rotation and shift of the cameras: coincides | rotation, shift, scale |
| `rate_dependence` | dashpots of a power of the rate in the joints (Ostwald 1929) | Ellis' fluid |
| `contact` | a round post with Hertz' (1881) law | one key point and a plane |
| `softening` | damage rational in the largest energy (Simo 1987) | exponential or inverse root \
in energy |
| `coupling` | a chamber is pressed in by higher pressure next to it, exponentially | \
polynomial of loads; of their difference |
| `dead_zone` | bladder that pushes from a pressure on: a corner | smoothed by a root |
| `drift` | base that turns with the root of time (Fick 1855: swelling) | saturating exponential |
| `stiffening` | polynomial of strain (Yeoh 1993) in the joints | exponential (Fung) |
| `twist` | torsion that saturates with the mean load | polynomial of the mean load |
| `thermal_drift` | modulus under a thermostat's saw tooth, weight included | gain by temperature |

Unknown ones are `breathing` (unequal breaths), `stick_slip` (a dry sleeve about the lower quarter),
`knock` and `tear` (at one moment), `marker_slip`, `kinked_line` (the line of one chamber closes
while the arm is bent), `snap_through` (a joint that buckles and returns) and `dropout` (a valve
that loses its current now and then).
"""

import math
from collections.abc import Iterable

import numpy as np

from benchmarks.chain.plant import Plant, move, new_state, place_links
from benchmarks.chain.robot import STREAM
from benchmarks.generators import EVENT_WINDOW_S, Setup, breath, misalignment, shift_zeros, sideways
from surgisoft.rig.hidden import Hidden, switch_on_from


def _length(setup: Setup) -> float:
    """Length of the arm [m]."""
    return setup.plant.link * len(setup.plant.mass)


def _payload(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(tip=setup.plant.tip + 0.08 * strength * float(setup.plant.mass.sum()))


def _hysteresis(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    limit, half = setup.plant.wall.friction
    setup.change_wall(friction=np.array([limit + 0.06 * strength, half * rng.uniform(0.8, 2.0)]))


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
    """Lines so narrow that a chamber follows within a good part of a second; unlike lengths."""
    m = len(setup.plant.areas)
    setup.change(gas=setup.plant.gas._replace(line=0.6 / strength * rng.uniform(0.7, 1.3, m)))


def _creep(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    share = 1.0 - math.exp(-0.2 * strength)
    setup.change_wall(relaxing=np.array([share, rng.uniform(1.0, 6.0)]))


def _misalignment(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(misalignment=misalignment(strength, _length(setup), rng))


def _rate_dependence(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change_wall(fluid=np.array([0.1 * strength, rng.uniform(0.4, 0.8)]))


def _contact(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """A post across the upper half of the arm, on the side to which one chamber bends it.

    At strength 1 it is touched at 45 % of the way that the arm goes there, and holds back most of
    the rest; a weaker one is farther away and softer.
    """
    plant = setup.plant
    count, m = len(plant.mass), len(plant.areas)
    joint = int(rng.integers(count // 2, count - 1))
    chamber = int(rng.integers(m))
    start, bent = (_shape(plant, share, chamber)[joint] for share in (0.0, 1.0))
    way = bent - start
    length = float(np.linalg.norm(way))
    share = 0.3 + 0.4 * math.exp(-strength)
    radius = rng.uniform(0.3, 1.0) * plant.radius
    touched = start + share * way
    centre = touched + (plant.radius + radius) * way / length
    # At strength 1 the post is several times as stiff as the arm under a force there.
    soft = float((joint + 1) * plant.link) ** 3 / (3.0 * float(plant.bend.mean()) * plant.link)
    deep = 0.3 * (1.0 - share) * length
    axis = np.cross(np.array([0.0, 0.0, 1.0]), way)
    stiffness = min(6.0 * strength, 12.0) / soft / math.sqrt(max(deep, 1e-3))
    setup.change(post=np.array([*centre, *(axis / np.linalg.norm(axis)), radius, stiffness]))


def _shape(plant: Plant, share: float, chamber: int) -> np.ndarray:
    """(N, 3) joints [m] at rest under a share of the limit in one chamber."""
    plain = plant._replace(post=np.zeros(8))
    state = new_state(plain)
    state.air[1, chamber] = share * plain.high
    for _ in range(400):
        move(plain, state, 0.01)
    place_links(plain, state)
    return state.joints.copy()


def _softening(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change_wall(damage=0.7 * (1.0 - math.exp(-0.6 * strength)))


def _coupling(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """Thin walls between neighbours in the ring of each segment."""
    m = len(setup.plant.areas)
    ring = 3 if m == 6 else m
    pressed = np.zeros((m, m))
    for i in range(m):
        part = i - i % ring
        for j in {part + (i + 1) % ring, part + (i - 1) % ring} - {i}:
            pressed[i, j] = 0.2 * strength * rng.uniform(0.8, 1.2)
    setup.change(pressed=pressed)


def _dead_zone(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    m = len(setup.plant.areas)
    setup.change(unfold=0.03 * strength * setup.plant.high * rng.uniform(0.8, 1.2, m))


def _drift(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(drift=0.03 * strength * sideways(rng))


def _stiffening(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change_wall(locking=setup.plant.wall.locking + 0.08 * strength)


def _twist(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(fibre=0.06 * strength * rng.choice([-1.0, 1.0]))


def _thermal_drift(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(warmth=0.004 * strength)


def _breathing(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(breath=breath(strength, _length(setup), rng))


def _stick_slip(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(stick=np.array([0.25 * strength, 0.05 * strength]))


def _knock(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(knock=np.append(0.02 * strength * sideways(rng), rng.uniform(*EVENT_WINDOW_S)))


def _tear(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    joint = int(rng.integers(0, len(setup.plant.mass) // 2))
    share = 0.8 * (1.0 - math.exp(-0.5 * strength))
    setup.change(tear=np.array([share, float(joint), rng.uniform(*EVENT_WINDOW_S)]))


def _marker_slip(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    key = int(rng.integers(len(setup.plant.keys)))
    way = 0.03 * strength * _length(setup) * rng.choice([-1.0, 1.0])
    setup.change(slip=np.array([way, float(key), rng.uniform(*EVENT_WINDOW_S)]))


def _kinked_line(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """The line of one chamber is nearly shut beyond a bending of the arm's lower third."""
    chamber = int(rng.integers(len(setup.plant.areas)))
    setup.change(kink=np.array([0.35, float(chamber), 0.02 / strength]))


def _snap_through(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """A joint that snaps through towards the side to which one chamber bends it, and is back once
    it is nearly straight without what it snapped by."""
    joint, size = int(rng.integers(1, len(setup.plant.mass) // 2)), 2.0 * -math.expm1(-strength / 4)
    x, y = setup.plant.levers[int(rng.integers(3))]
    setup.change(snap=np.array([size, joint, 0.25, 0.05 + size, math.atan2(-x, y)]))


def _dropout(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """Spells of about half a second, some four a minute."""
    begin = np.cumsum(rng.exponential(15.0, 40))
    spells = np.stack([begin, begin + strength * rng.uniform(0.2, 0.8, 40)], axis=1)
    setup.change(dropouts=spells, vented=int(rng.integers(len(setup.plant.areas))))


HIDDEN: dict[str, Hidden[Setup]] = {
    "payload": Hidden("body", "unweighed mass at the tip", _payload),
    "hysteresis": Hidden("material", "more rubber friction in the joints", _hysteresis),
    "gain_mismatch": Hidden("material", "two chambers of other areas", _gain_mismatch),
    "zero_offset": Hidden("sensor", "two pressure sensors whose zero has shifted", _zero_offset),
    "line_lag": Hidden("line", "narrow lines behind the sensors", _line_lag),
    "creep": Hidden("material", "a network that relaxes", _creep),
    "misalignment": Hidden("sensor", "camera frame turned and shifted", _misalignment),
    "rate_dependence": Hidden("material", "a power-law fluid in the joints", _rate_dependence),
    "contact": Hidden("body", "a round post beside the arm", _contact),
    "softening": Hidden("material", "damage by the largest energy so far", _softening),
    "coupling": Hidden("material", "chambers press each other in", _coupling),
    "dead_zone": Hidden("material", "bladders that push from a pressure on", _dead_zone),
    "drift": Hidden("body", "the base turns with the root of time", _drift),
    "stiffening": Hidden("material", "a wall that stiffens (Yeoh)", _stiffening),
    "twist": Hidden("body", "fibres at an angle: pressure twists the arm", _twist),
    "thermal_drift": Hidden("material", "a thermostat's room softens the wall", _thermal_drift),
    "breathing": Hidden("body", "the base moves with a breathing body", _breathing),
    "stick_slip": Hidden("body", "a dry sleeve that holds and gives way", _stick_slip),
    "knock": Hidden("body", "the base is knocked aside at one moment", _knock),
    "tear": Hidden("material", "one joint tears at one moment", _tear),
    "marker_slip": Hidden("sensor", "a ring of markers slides at one moment", _marker_slip),
    "kinked_line": Hidden("line", "a line that kinks while the arm is bent", _kinked_line),
    "snap_through": Hidden("material", "a joint that buckles and returns", _snap_through),
    "dropout": Hidden("line", "a valve that vents while it has no current", _dropout),
}


def switch_on(setup: Setup, names: Iterable[tuple[str, float]], seed: int) -> Setup:
    """`switch_on_from` the hidden effects of the chain."""
    return switch_on_from(HIDDEN, setup, names, seed, STREAM)
