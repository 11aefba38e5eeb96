"""Hidden effects of the arm in MuJoCo by name: each changes parameters of its plant.

At strength 1 an effect moves the key points by some per mille to some per cent of the arm's length
(root mean square); signs and places vary with the robot's seed. The laws, and those of the arm
models:

| effect | law here | in the arm model |
|---|---|---|
| `payload` | a body on the rim of the tip: a weight coincides | beam, to first order |
| `hysteresis` | MuJoCo's dry friction in the joints: with its spring each is a play operator \
of the joint's couple, which coincides in form | play operators on chambers, or on strains about \
six axes |
| `gain_mismatch` | two chambers of other areas: a factor coincides | gain |
| `zero_offset` | two sensors whose zero has shifted, down to no pressure | constant |
| `line_lag` | MuJoCo's muscle activation, filling unlike venting (Millard et al. 2013) | one lag, \
laminar to turbulent |
| `creep` | a damped joint in series with each joint: linear, so it coincides in form | retarded \
loads or strains, log-normal spectrum |
| `misalignment` | rotation and shift of the cameras: coincides | rotation, shift, scale |
| `rate_dependence` | joint damping that grows with the rate: MuJoCo's polynomial | Ellis' fluid |
| `contact` | a rough ball beside the arm: MuJoCo's contact | one key point and a plane |
| `softening` | damage in proportion to a joint's largest bending (Kachanov 1958) | exponential or \
inverse root in energy |
| `coupling` | walls between chambers bulge as membranes, the cube root of the difference of \
pressures (Hencky 1915) | polynomial of loads; of their difference or its root |
| `dead_zone` | parts of a bladder touch the wall one after the other | smoothed by a root |
| `drift` | mount that creeps with the logarithm of time (Phillips 1905) | saturating exponential |
| `stiffening` | joints whose stiffness grows with the square of bending: MuJoCo's polynomial | \
exponential (Fung) |
| `twist` | chambers' fibres lean over each joint: the tendon's way | polynomial of mean load |
| `thermal_drift` | stiffness by a power of absolute temperature, weight included | gain by \
temperature |

Unknown ones are `breathing` (the base is moved; a quick breath in, and a slow one out),
`stick_slip` (a hose from the tip to a slider with dry friction, static above kinetic), `cable`
(slack, and elastic from one length on), `leak` (a seal that lifts in spells), `loose_mount` (a base
with play in all directions), `wind` (gusts), `snag` (from one moment on a hose holds the tip back)
and `delamination` (from one moment on a chamber pushes on less of its area over the last two thirds
of its length).
"""

import math
from collections.abc import Iterable

import numpy as np

from benchmarks.generators import EVENT_WINDOW_S, Setup, breath, misalignment, shift_zeros, sideways
from benchmarks.mujoco_arm.motion import Arm
from benchmarks.mujoco_arm.robot import LINKS, STREAM, Plant
from surgisoft.rig.hidden import Hidden, switch_on_from

SHAPES = 6
"""Random pressures at which an arm is looked at, to place what it may touch."""


def _tip_stiffness(plant: Plant) -> float:
    """Force across the tip per deflection of the arm as a cantilever, 3 E I / L^3 [N/m]."""
    return 3.0 * float(plant.bend.mean()) / LINKS / plant.length**2


def _shapes(plant: Plant, rng: np.random.Generator) -> np.ndarray:
    """(SHAPES, N + 1, 3) nodes [m] at rest under random pressures."""
    arm, shapes = Arm(plant), []
    for pressures in rng.random((SHAPES, len(plant.areas))):
        arm.rest(0.0)
        arm.run(np.tile(plant.high * pressures, (50, 1)), 0.05)
        shapes.append([arm.data.site(f"n{node}").xpos.copy() for node in range(LINKS + 1)])
    return np.array(shapes)


def _spells(on_s: tuple[float, float], off_s: float, rng: np.random.Generator) -> np.ndarray:
    """(K, 2) begin and end of random spells in the first half hour [s]."""
    begin = np.cumsum(rng.exponential(off_s, 200) + on_s[1])
    return np.stack([begin, begin + rng.uniform(*on_s, 200)], axis=1)


def _payload(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    mass = 0.07 * strength * setup.plant.mass
    setup.change(payload=np.array([mass, rng.uniform(0.0, 2.0 * np.pi)]))


def _hysteresis(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    couple = setup.plant.reach * setup.plant.bend
    setup.change(friction=0.04 * strength * couple * rng.uniform(0.3, 1.7, LINKS))


def _gain_mismatch(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    areas = setup.plant.areas.copy()
    two = rng.permutation(len(areas))[:2]
    for chamber, share in zip(two, (0.06, -rng.uniform(0.0, 0.04)), strict=True):
        areas[chamber] *= math.exp(strength * share * rng.choice([-1.0, 1.0]))
    setup.change(areas=areas)


def _zero_offset(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    shift_zeros(setup, strength, len(setup.plant.areas), rng)


def _line_lag(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    lines = setup.plant.line_s
    more = np.array([0.06, 0.12]) * rng.uniform(0.7, 1.3, lines.shape)
    setup.change(line_s=lines + strength * more)


def _creep(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    times = np.exp(rng.uniform(math.log(3.0), math.log(50.0), LINKS))
    setup.change(creep=np.array([0.15 * strength, *times]))


def _misalignment(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(misalignment=misalignment(strength, setup.plant.length, rng))


def _rate_dependence(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(thick=0.5 * strength, viscous_s=setup.plant.viscous_s + 0.05 * strength)


def _contact(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """A ball beside the upper half of the arm, on a side to which random pressures bend it."""
    plant, node = setup.plant, int(rng.integers(LINKS // 2 + 1, LINKS))
    axis = _shapes(plant, rng)[:, node]
    middle = axis.mean(axis=0)
    way = axis[int(rng.integers(SHAPES))] - middle
    way /= np.linalg.norm(way)
    radius = rng.uniform(1.0, 2.5) * plant.radius
    touched = float(np.quantile((axis - middle) @ way, 0.35 + 0.65 * math.exp(-0.35 * strength)))
    setup.change(ball=np.array([*(middle + (touched + radius + plant.radius) * way), radius]))


def _softening(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(damage=0.7 * -math.expm1(-0.35 * strength))


def _coupling(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(bulge=0.05 * strength)


def _dead_zone(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(touch=0.04 * strength * setup.plant.high)


def _drift(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(drift=0.025 * strength * sideways(rng))


def _stiffening(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(stiffening=setup.plant.stiffening + 0.12 * strength)


def _twist(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(fibre=0.08 * strength * rng.choice([-1.0, 1.0]))


def _thermal_drift(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(warmth=6.0 * strength)


def _breathing(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(breath=breath(strength, setup.plant.length, rng))


def _stick_slip(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    plant = setup.plant
    stiffness = 4.0 * _tip_stiffness(plant)
    static = 0.03 * strength * plant.length * stiffness
    setup.change(hose=np.array([rng.uniform(0, 2 * np.pi), stiffness, static, 0.3 * static]))


def _cable(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    anchor = 1.3 * setup.plant.radius * sideways(rng)
    tips = _shapes(setup.plant, rng)[:, -1]
    free = float(np.median(np.linalg.norm(tips - anchor, axis=1)))
    stiffness = 4.0 * strength * _tip_stiffness(setup.plant)
    setup.change(cable=np.array([*anchor, free, stiffness, 0.0]))


def _leak(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    chamber = int(rng.integers(len(setup.plant.areas)))
    setup.change(leak=_spells((4.0, 15.0), 8.0, rng), leaking=np.array([chamber, 0.12 * strength]))


def _loose_mount(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    setup.change(play=0.015 * strength)


def _wind(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    wind = 12.0 * math.sqrt(strength) * sideways(rng)
    setup.change(wind=wind, gusts=_spells((2.0, 7.0), 3.0, rng))


def _snag(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    anchor = setup.plant.length * (1.5 * sideways(rng) + np.array([0.0, 0.0, rng.uniform(0, 1)]))
    stiffness = 0.05 * strength * _tip_stiffness(setup.plant)
    moment = rng.uniform(*EVENT_WINDOW_S)
    setup.change(cable=np.array([*anchor, 10.0 * setup.plant.length, stiffness, moment]))


def _delamination(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    chamber = int(rng.integers(len(setup.plant.areas)))
    share = -math.expm1(-0.5 * strength)
    setup.change(loosened=np.array([chamber, rng.uniform(*EVENT_WINDOW_S), share]))


HIDDEN: dict[str, Hidden[Setup]] = {
    "payload": Hidden("body", "unweighed mass at one side of the tip", _payload),
    "hysteresis": Hidden("material", "dry friction in the joints", _hysteresis),
    "gain_mismatch": Hidden("material", "two chambers of other areas", _gain_mismatch),
    "zero_offset": Hidden("sensor", "two pressure sensors whose zero has shifted", _zero_offset),
    "line_lag": Hidden("line", "chambers that fill and vent slowly", _line_lag),
    "creep": Hidden("material", "damped joints in series", _creep),
    "misalignment": Hidden("sensor", "camera frame turned and shifted", _misalignment),
    "rate_dependence": Hidden("material", "damping that grows with the rate", _rate_dependence),
    "contact": Hidden("body", "a rough ball beside the arm", _contact),
    "softening": Hidden("material", "damage by the largest bending so far", _softening),
    "coupling": Hidden("material", "walls between chambers bulge", _coupling),
    "dead_zone": Hidden("material", "bladders that touch part by part", _dead_zone),
    "drift": Hidden("body", "the base turns with the logarithm of time", _drift),
    "stiffening": Hidden("material", "joints that stiffen when bent", _stiffening),
    "twist": Hidden("material", "fibres that lean about the axis", _twist),
    "thermal_drift": Hidden("material", "a heated room softens the joints; temp_C", _thermal_drift),
    "breathing": Hidden("body", "the base moves with a breathing body", _breathing),
    "stick_slip": Hidden("body", "a hose on a slider with dry friction", _stick_slip),
    "cable": Hidden("body", "a slack cable that pulls from one length on", _cable),
    "leak": Hidden("line", "a seal that lifts in spells", _leak),
    "loose_mount": Hidden("body", "a base with play", _loose_mount),
    "wind": Hidden("body", "gusts of wind", _wind),
    "snag": Hidden("body", "a hose that catches at one moment", _snag),
    "delamination": Hidden("material", "a chamber that comes loose at one moment", _delamination),
}


def switch_on(setup: Setup, names: Iterable[tuple[str, float]], seed: int) -> Setup:
    """`switch_on_from` the hidden effects of the arm in MuJoCo."""
    return switch_on_from(HIDDEN, setup, names, seed, STREAM)
