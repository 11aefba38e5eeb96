"""Hidden effects of the virtual rig by name, as `--hidden NAME --strength X` switches them on.

At strength 1 an effect moves the tip by about a millimetre (root mean square over the `mixed`
protocol); benchmarks/collect.py measures it. Signs and places vary with the robot's seed.
"""

import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from scipy.optimize import brentq

from surgisoft.errors import InputError, unknown_name
from surgisoft.rig.arm import STANDARD_GRAVITY, chamber_thrusts, no_equilibrium
from surgisoft.rig.effects import REFERENCE_KPA, Effects
from surgisoft.rig.rod import Loads, Rod, balance, new_shape

EVENT_WINDOW_S = (40.0, 100.0)
"""Default window of time since switching on within which an event that occurs once (a knock, a
broken fibre) falls, evenly distributed [s]: after the first reset (30 s) and some motion of the
intact arm, and well within the shortest protocol (150 s)."""


@dataclass
class Setup:
    """The parameters of a rig that a hidden effect may change."""

    effects: Effects
    """Amplitudes of the effects."""
    loads: Loads
    """External loads."""
    rod: Rod
    """The arm's statics."""
    event_window_s: tuple[float, float] = EVENT_WINDOW_S
    """Window of time in which events that occur once fall [s]."""


AnySetup = TypeVar("AnySetup")
"""Type of what the hidden effects of a rig change."""


@dataclass(frozen=True)
class Hidden(Generic[AnySetup]):
    """One hidden effect of a rig."""

    place: str
    """Where in the chain it acts: line, material, body or sensor."""
    about: str
    """Description in one line."""
    switch_on: Callable[[AnySetup, float, np.random.Generator], None]
    """Switches the effect on: (setup, amplitude, random numbers of the robot's seed)."""


def switch_on_from(
    known: Mapping[str, Hidden[AnySetup]],
    setup: AnySetup,
    names: Iterable[tuple[str, float]],
    seed: int,
    *stream: int,
) -> AnySetup:
    """Apply the named effects of a rig's list to the setup, each with its amplitude (0: off).

    seed, stream: the robot's seed, and numbers that tell its draws from those of other rigs.
    Raises InputError for a name that is unknown or given twice, and for a strength beyond 0 to 10.
    """
    seen: set[str] = set()
    for name, strength in names:
        if name not in known:
            raise unknown_name("hidden effect", name, known)
        if name in seen:
            raise InputError(f"hidden effect '{name}' is given twice, expected once")
        if not (np.isfinite(strength) and 0.0 <= strength <= 10.0):
            raise InputError(f"strength of '{name}' is {strength}, expected 0 to 10")
        seen.add(name)
        if strength > 0:
            rng = np.random.default_rng([seed, zlib.crc32(name.encode()), *stream])
            known[name].switch_on(setup, float(strength), rng)
    return setup


def random_direction(rng: np.random.Generator) -> np.ndarray:
    """(3,) random unit vector."""
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def _set(setup: Setup, **amplitudes) -> None:
    setup.effects = setup.effects._replace(**amplitudes)


def _pattern(rng: np.random.Generator, m: int) -> np.ndarray:
    """(m,) numbers of mean 0 and root mean square 1 (m > 1)."""
    values = rng.permutation(np.linspace(-1.0, 1.0, m)) + rng.normal(0.0, 0.2, m)
    values -= values.mean() if m > 1 else 0.0
    return values / np.sqrt(np.mean(values**2))


def _hysteresis(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    _set(setup, friction=1.0 * strength)


def _rate_dependence(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    _set(setup, rate=0.026 * strength)


def _line_lag(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    _set(setup, line=np.array([1700.0, 950.0]) / strength)


def _creep(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    _set(setup, creep=7.5 * strength)


def _softening(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    _set(setup, softening=0.08 * strength)


def _stiffening(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    _set(setup, stiffening=0.03 * strength)


def _dead_zone(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    _set(setup, dead_zone=1.2 * strength)


def _gain_mismatch(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    _set(setup, gain=0.05 * strength * _pattern(rng, len(setup.effects.gain)))


def _zero_offset(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    _set(setup, zero=1.2 * strength * _pattern(rng, len(setup.effects.zero)))


def _coupling(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    m = len(setup.effects.gain)
    matrix = 3.0 * strength * rng.uniform(0.6, 1.4, (m, m))
    np.fill_diagonal(matrix, 0.0)
    _set(setup, coupling=matrix)


def _payload(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    angle = rng.uniform(0, 2 * np.pi)
    weight = setup.loads.payload + 0.7e-3 * strength * STANDARD_GRAVITY
    at = np.array([2.0 * np.cos(angle), 2.0 * np.sin(angle), 2.0])
    setup.loads = setup.loads._replace(payload=weight, payload_at=at)


def _contact(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """A support across the arm's way: touched at 40 % of the body's reach towards it.

    At strength 1 it keeps the tip back by 4 mm where the free arm would go deepest into it.
    """
    m = len(setup.effects.gain)
    plane = int(rng.integers(2, max(3, len(setup.rod.planes) - 1)))
    angle = rng.uniform(0, 2 * np.pi)
    normal = np.array([np.cos(angle), np.sin(angle), 0.0])
    singles = REFERENCE_KPA * np.eye(m)
    poses = [np.zeros(m), *singles, *(REFERENCE_KPA - singles)]
    towards = [-float(_posed(setup, setup.loads, p)[plane] @ normal) for p in poses]
    deepest = poses[int(np.argmax(towards))]
    free = _posed(setup, setup.loads, deepest)[-1]
    support = setup.loads._replace(
        support=int(setup.rod.planes[plane]),
        support_normal=normal,
        support_gap=-(towards[0] + 0.4 * (max(towards) - towards[0])),
    )

    def kept_back(log_stiffness: float) -> float:
        loads = support._replace(support_stiffness=float(np.exp(log_stiffness)))
        return float(np.linalg.norm(_posed(setup, loads, deepest)[-1] - free)) - 4.0

    stiffness = np.exp(brentq(kept_back, np.log(1e-4), np.log(0.5), xtol=1e-3))
    setup.loads = support._replace(support_stiffness=float(strength * stiffness))


def _posed(setup: Setup, loads: Loads, pressures: np.ndarray) -> np.ndarray:
    """Key planes' centres (n, 3) [mm] of the frictionless arm under pressures (m,) [kPa]."""
    rod, shape = setup.rod, new_shape(setup.rod)
    thrusts = np.empty((len(rod.stiffness), len(pressures)))
    chamber_thrusts(rod, np.asarray(pressures, np.float64), thrusts)
    if not balance(rod, loads, 1.0, thrusts, rod.base, shape):
        raise no_equilibrium()
    return shape.centres


def _misalignment(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    turn = np.radians(0.8) * strength * random_direction(rng)
    shift = 0.4 * strength * random_direction(rng)
    warp = 1e-4 * strength * rng.choice([-1.0, 1.0])
    _set(setup, misalignment=np.concatenate([turn, shift, [warp]]))


def _drift(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    angle = rng.uniform(0, 2 * np.pi)
    turn = np.radians(1.2) * strength
    _set(setup, drift=turn * np.array([np.cos(angle), np.sin(angle), 0.0]))


def _thermal_drift(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    _set(setup, warmth=0.022 * strength)


def _stick_slip(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    _set(setup, stick=np.array([0.5 * strength, 0.04]))


def _leak(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    leak = np.zeros(len(setup.effects.leak))
    leak[rng.integers(len(leak))] = 5.0 * strength
    _set(setup, leak=leak)


def _twist(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    _set(setup, twist=0.5 * strength * rng.choice([-1.0, 1.0]))


def _sensor_crosstalk(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    _set(setup, crosstalk=0.03 * strength)


def _marker_slip(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    marker = rng.integers(3)
    slip = np.array([len(setup.rod.planes) - 1, marker, 4.0 * strength, np.radians(30.0)])
    _set(setup, slip=slip)


def _breathing(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """About 15 breaths a minute."""
    shift = 2.0 * strength * random_direction(rng)
    period = rng.uniform(3.5, 4.5)
    _set(setup, breath=np.array([*shift, period, rng.uniform(0.0, period)]))


def _valve_jam(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    """Every 8 s on average one valve sticks (the clogged valve of Bartys et al. 2006)."""
    gaps = rng.exponential(8.0, 2000)
    lasts = strength * rng.uniform(0.5, 1.5, len(gaps))
    begins = np.cumsum(gaps) + np.concatenate([[0.0], np.cumsum(lasts)[:-1]])
    spells = np.stack([begins, begins + lasts], axis=1)
    _set(setup, jam=spells, jammed=int(rng.integers(len(setup.effects.gain))))


def _knock(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    angle = rng.uniform(0, 2 * np.pi)
    turn = np.radians(1.2) * strength
    moment = rng.uniform(*setup.event_window_s)
    _set(setup, knock=np.array([turn * np.cos(angle), turn * np.sin(angle), 0.0, moment]))


def _fibre_break(setup: Setup, strength: float, rng: np.random.Generator) -> None:
    broken = np.zeros(len(setup.effects.broken))
    broken[rng.integers(len(broken))] = 5.0 * strength
    _set(setup, broken=broken, break_s=float(rng.uniform(*setup.event_window_s)))


HIDDEN: dict[str, Hidden[Setup]] = {
    "hysteresis": Hidden("material", "more friction of the fibres (Preisach)", _hysteresis),
    "rate_dependence": Hidden(
        "material", "viscous wall, force with the root of strain rate", _rate_dependence
    ),
    "line_lag": Hidden(
        "line", "long thin tube: quadratic flow, slower in emptying than in filling", _line_lag
    ),
    "creep": Hidden("material", "power-law creep over three decades of time", _creep),
    "softening": Hidden("material", "Mullins damage by the largest load so far", _softening),
    "stiffening": Hidden("material", "wall stiffens exponentially with strain", _stiffening),
    "dead_zone": Hidden("material", "folds that open smoothly before a chamber pushes", _dead_zone),
    "gain_mismatch": Hidden(
        "material", "chambers push unequally, less so at high pressure", _gain_mismatch
    ),
    "zero_offset": Hidden(
        "sensor", "pressure sensors whose zero has shifted, and their span a little", _zero_offset
    ),
    "coupling": Hidden("material", "a bulging chamber takes push from the others", _coupling),
    "payload": Hidden("body", "unweighed mass at the tip, off its centre", _payload),
    "contact": Hidden("body", "yielding one-sided support in the body's way", _contact),
    "misalignment": Hidden(
        "sensor", "camera frame turned, shifted and slightly warped", _misalignment
    ),
    "drift": Hidden("body", "the bracket tilts with elapsed time, saturating", _drift),
    "thermal_drift": Hidden(
        "material", "the wall softens as the room warms; temp_C", _thermal_drift
    ),
    "stick_slip": Hidden("material", "wall fibres that stick and let go at once", _stick_slip),
    "leak": Hidden("line", "a crack in one chamber that opens with pressure", _leak),
    "twist": Hidden("body", "fibres wound unequally: pressure twists the arm", _twist),
    "sensor_crosstalk": Hidden(
        "sensor", "pressure channels mix in the multiplexer", _sensor_crosstalk
    ),
    "marker_slip": Hidden("sensor", "a tip marker that slips while the arm is bent", _marker_slip),
    "breathing": Hidden("body", "the mount lies on a breathing body", _breathing),
    "valve_jam": Hidden("line", "a valve that sticks shut now and then", _valve_jam),
    "knock": Hidden("body", "the bracket is knocked aside at one moment", _knock),
    "fibre_break": Hidden(
        "material", "a fibre snaps at one moment; its chamber bulges from then on", _fibre_break
    ),
}


def switch_on(setup: Setup, names: Iterable[tuple[str, float]], seed: int) -> Setup:
    """`switch_on_from` the hidden effects of the virtual rig."""
    return switch_on_from(HIDDEN, setup, names, seed)
