"""Hidden effects of the arm that tendons bend, by name: each changes parameters of its plant.

At strength 1 an effect moves the key points by some per mille to some per cent of the arm's length
(root mean square); signs and places vary with the robot's seed. The laws, and those of the arm
models:

| effect | law here | in the arm model |
|---|---|---|
| `payload` | a body on the rim of the tip, with its inertia: a weight coincides | beam, to first \
order |
| `hysteresis` | bare holes: friction in proportion to the tension and to the angle by which a \
hole deflects a tendon (Euler 1775), none in a slack one | play operators of one width on \
chambers, or on strains |
| `backlash` | play between the encoder and the drum of two motors: one play operator, which \
coincides; truth `hysteresis` | play operators |
| `gain_mismatch` | two drums of other radii: a factor coincides | gain |
| `zero_offset` | drums of two motors that were homed elsewhere, down to the lower limit | \
constant |
| `line_lag` | a drum that follows its encoder late, and no faster than a highest speed | one lag, \
laminar to turbulent |
| `creep` | tendons that elongate by a power of their tension, which depends on the posture, too | \
retarded loads or strains, log-normal spectrum |
| `misalignment` | rotation and shift of the cameras: coincides | rotation, shift, scale |
| `rate_dependence` | thickened grease in the holes: a fluid of Carreau (1972), by the speed of \
each tendon | Ellis' fluid |
| `contact` | a rough round post beside the arm: MuJoCo's contact | one key point and a plane |
| `softening` | parts of each joint fail at bendings of Weibull's (1939) distribution | \
exponential or inverse root in energy |
| `coupling` | the frame of the motors yields: the tension of a tendon slackens its neighbours | \
polynomial of loads; of their difference |
| `dead_zone` | tendons that sag: a parabola of the stretch, then a line | smoothed by a root |
| `drift` | base that turns by a hyperbola of time | saturating exponential |
| `stiffening` | a sleeve that is taut from a bending of each joint on: a corner | exponential \
(Fung) of loads |
| `twist` | a backbone that is a coil untwists in proportion to the tension of all tendons, which \
depends on the posture | polynomial of mean load |
| `inertia` | a mass near the tip that a balancer carries: it swings and has no weight | one \
linear oscillator of the actuation |
| `thermal_drift` | tendons in long sheaths that expand, each by its own length: a shift of the \
pull, which coincides in form | gain and offset by temperature |

Unknown ones are `draught` (a wind that swells and falls at one frequency), `marker_slip` (a ring of
markers that slides twice), `loose_disk` (a disk that turns in its seat to one side or the other),
`jumped_tendon` (from one moment on a tendon is out of its hole in one disk), `kinked_sheath` (a
tendon that sticks and slips in its sheath, static friction above kinetic), `snag` (from one moment
on a cord holds a disk back), `loose_screw` (a drum that slips on its shaft under high tension) and
`lost_steps` (motors that lose steps when they are fast, until they are homed).
"""

import math
from collections.abc import Iterable

import numpy as np

from benchmarks.generators import EVENT_WINDOW_S, Setup, misalignment, shift_zeros, sideways
from benchmarks.tendon_arm.motion import Arm
from benchmarks.tendon_arm.robot import RETARDED, STREAM, Plant
from surgisoft.rig.hidden import Hidden, switch_on_from

SHAPES = 6
"""Random pulls at which an arm is looked at, to place what it may touch."""


def _tip_stiffness(plant: Plant) -> float:
    """Force across the tip per deflection of the backbone as a cantilever, 3 E I / L^3 [N/m]."""
    return 3.0 * float(plant.bend.mean()) / len(plant.bend) / plant.length**2


def _shapes(plant: Plant, rng: np.random.Generator) -> np.ndarray:
    """(SHAPES, N + 1, 3) axis of the disks [m] at rest under random pulls."""
    arm, shapes, span = Arm(plant), [], plant.high - plant.low
    for share in rng.random((SHAPES, len(plant.offset))):
        arm.rest(0.0)
        arm.run(np.tile(plant.low + span * share, (60, 1)), 0.05)
        names = [f"n{node}" for node in range(len(plant.bend) + 1)]
        shapes.append([arm.data.site(name).xpos.copy() for name in names])
    return np.array(shapes)


def _payload(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    mass = 0.12 * strength * setup.plant.mass
    setup.change(payload=np.array([mass, rng.uniform(0.0, 2.0 * np.pi)]))


def _hysteresis(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(friction=setup.plant.friction + 0.05 * strength)


def _backlash(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    play = np.zeros(len(setup.plant.offset))
    two = rng.permutation(len(play))[:2]
    play[two] = 0.06 * strength * setup.plant.high * np.array([1.0, rng.uniform(0.0, 0.7)])
    setup.change(backlash=play)


def _gain_mismatch(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    gains = setup.plant.gains.copy()
    two = rng.permutation(len(gains))[:2]
    for tendon, share in zip(two, (0.06, -rng.uniform(0.0, 0.04)), strict=True):
        gains[tendon] *= math.exp(strength * share * rng.choice([-1.0, 1.0]))
    setup.change(gains=gains)


def _zero_offset(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    shift_zeros(setup, strength, len(setup.plant.offset), rng)


def _line_lag(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    lag = 0.08 * strength * rng.uniform(0.7, 1.3, len(setup.plant.offset))
    setup.change(lag_s=lag, fastest=setup.plant.high * rng.uniform(0.6, 2.0) / strength)


def _creep(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    times = np.exp(rng.uniform(math.log(2.0), math.log(60.0), RETARDED))
    setup.change(creep=np.array([0.15 * strength * setup.plant.high, *times]))


def _misalignment(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(misalignment=misalignment(strength, setup.plant.length, rng))


def _rate_dependence(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    plant = setup.plant
    speed = plant.high * rng.uniform(0.3, 1.0)
    setup.change(grease=np.array([0.06 * strength * float(plant.pull.mean()), speed]))


def _contact(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """A post across the upper half of the arm, on a side to which random pulls bend it."""
    plant, count = setup.plant, len(setup.plant.bend)
    disk = int(rng.integers(count // 2 + 1, count))
    axis = _shapes(plant, rng)[:, disk]
    middle = axis.mean(axis=0)
    way = axis[int(rng.integers(SHAPES))] - middle
    way /= np.linalg.norm(way)
    radius = rng.uniform(0.4, 1.2) * plant.radius
    touched = float(((axis - middle) @ way).max()) * 1.25 * math.exp(-0.3 * strength)
    centre = middle + (touched + radius + plant.radius) * way
    along = np.cross(way, np.array([0.0, 0.0, 1.0]))
    along *= 0.15 * plant.length / max(np.linalg.norm(along), 1e-9)
    setup.change(post=np.array([*(centre - along), *(centre + along), radius]))


def _softening(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(worn=0.8 * -math.expm1(-0.4 * strength))


def _coupling(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(yields=0.45 * -math.expm1(-0.2 * strength))


def _dead_zone(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    plant = setup.plant
    toe = 0.15 * strength * plant.high * rng.uniform(0.6, 1.4, len(plant.offset))
    setup.change(toe=toe)


def _drift(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(drift=0.03 * strength * sideways(rng))


def _stiffening(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    taut = setup.plant.reach * rng.uniform(0.15, 0.4)
    setup.change(sleeve=np.array([taut, 0.6 * strength]))


def _twist(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """A turn of the tip by 0.2 rad under half the tension of the limit in one tendon."""
    plant = setup.plant
    couple = 0.2 * strength * plant.twist / len(plant.bend)
    tension = 0.5 * float(plant.pull.mean()) * plant.high
    setup.change(coil=couple / tension * rng.choice([-1.0, 1.0]))


def _inertia(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    count = len(setup.plant.bend)
    disk = int(rng.integers(2 * count // 3, count)) + 1
    setup.change(balanced=np.array([0.6 * strength * setup.plant.mass, disk]))


def _thermal_drift(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    share = rng.uniform(0.0, 1.0, len(setup.plant.offset))
    setup.change(warmth=0.015 * strength * setup.plant.high * share)


def _draught(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    plant = setup.plant
    force = 0.03 * strength * plant.length * _tip_stiffness(plant) * sideways(rng)
    setup.change(draught=np.array([*force, rng.uniform(0.2, 0.9), rng.uniform(0, 2 * np.pi)]))


def _marker_slip(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    plant, moments = setup.plant, np.sort(rng.uniform(*EVENT_WINDOW_S, 2))
    key, way = int(rng.integers(len(plant.keys))), rng.choice([-1.0, 1.0])
    ways = 0.02 * strength * plant.length * way * rng.uniform(0.5, 1.5, 2)
    setup.change(slides=np.column_stack([[key, key], moments, ways]))


def _loose_disk(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    disk = int(rng.integers(2, len(setup.plant.bend) // 2 + 1))
    play = 0.15 * strength
    held = rng.uniform(0.005, 0.02)
    setup.change(loose=np.array([disk, play, held, rng.uniform(0, 2 * np.pi)]))


def _jumped_tendon(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    plant, tendon = setup.plant, int(rng.integers(len(setup.plant.offset)))
    disk = int(rng.integers(2, plant.ends[tendon]))
    share = 1.0 - 0.5 * -math.expm1(-0.3 * strength)
    setup.change(jumped=np.array([tendon, disk, rng.uniform(*EVENT_WINDOW_S), share]))


def _kinked_sheath(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    static = 0.12 * strength * setup.plant.high
    tendon = int(rng.integers(len(setup.plant.offset)))
    setup.change(kink=np.array([tendon, static, 0.25 * static]))


def _snag(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    plant, count = setup.plant, len(setup.plant.bend)
    anchor = plant.length * (1.3 * sideways(rng) + np.array([0.0, 0.0, rng.uniform(0, 1)]))
    disk, stiffness = int(rng.integers(count // 2, count)) + 1, _tip_stiffness(plant)
    moment = rng.uniform(*EVENT_WINDOW_S)
    setup.change(snag=np.array([*anchor, disk, 0.3 * strength * stiffness, moment]))


def _loose_screw(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    plant, tendon = setup.plant, int(rng.integers(len(setup.plant.offset)))
    most = plant.tight[tendon] + 0.9 * plant.high
    limit = float(plant.pull[tendon]) * most * math.exp(-0.05 * strength)
    setup.change(screw=np.array([tendon, limit, 0.02 * plant.high * strength**0.5]))


def _lost_steps(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    speed = 1e-3 * rng.uniform(12.0, 18.0)
    setup.change(steps=np.array([speed, 0.004 * strength * setup.plant.high]))


HIDDEN: dict[str, Hidden[Setup]] = {
    "payload": Hidden("body", "unweighed mass at one side of the tip", _payload),
    "hysteresis": Hidden("material", "bare holes: friction by tension", _hysteresis),
    "backlash": Hidden("line", "play between encoder and drum of two motors", _backlash),
    "gain_mismatch": Hidden("line", "two drums of other radii", _gain_mismatch),
    "zero_offset": Hidden("sensor", "two motors that were homed elsewhere", _zero_offset),
    "line_lag": Hidden("line", "drums that follow late and no faster than they can", _line_lag),
    "creep": Hidden("material", "tendons that elongate under tension", _creep),
    "misalignment": Hidden("sensor", "camera frame turned and shifted", _misalignment),
    "rate_dependence": Hidden("material", "thick grease in the holes", _rate_dependence),
    "contact": Hidden("body", "a rough post beside the arm", _contact),
    "softening": Hidden("material", "joints that fail part by part", _softening),
    "coupling": Hidden("line", "a frame that yields to the motors", _coupling),
    "dead_zone": Hidden("material", "tendons that sag", _dead_zone),
    "drift": Hidden("body", "the base turns by a hyperbola of time", _drift),
    "stiffening": Hidden("material", "a sleeve that is taut from one bending on", _stiffening),
    "twist": Hidden("material", "a coil that untwists under tension", _twist),
    "inertia": Hidden("body", "a balanced mass near the tip", _inertia),
    "thermal_drift": Hidden("line", "tendons expand in a warming room; temp_C", _thermal_drift),
    "draught": Hidden("body", "wind that swells and falls at one frequency", _draught),
    "marker_slip": Hidden("sensor", "a ring of markers slides twice", _marker_slip),
    "loose_disk": Hidden("body", "a disk that turns in its seat", _loose_disk),
    "jumped_tendon": Hidden("body", "a tendon leaves its hole at one moment", _jumped_tendon),
    "kinked_sheath": Hidden("line", "a tendon that sticks and slips", _kinked_sheath),
    "snag": Hidden("body", "a cord that catches at one moment", _snag),
    "loose_screw": Hidden("line", "a drum that slips under high tension", _loose_screw),
    "lost_steps": Hidden("line", "motors that lose steps when they are fast", _lost_steps),
}


def switch_on(setup: Setup, names: Iterable[tuple[str, float]], seed: int) -> Setup:
    """`switch_on_from` the hidden effects of the arm that tendons bend."""
    return switch_on_from(HIDDEN, setup, names, seed, STREAM)
