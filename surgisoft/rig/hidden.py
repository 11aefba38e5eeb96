"""Hidden effects by name: what `--hidden NAME --strength X` switches on.

At strength 1 an effect changes the tip by about a millimetre (root mean square over the `mixed`
protocol); benchmarks/collect.py measures it. Signs and places vary with the arm's seed.
"""

import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from surgisoft.errors import InputError, unknown_name
from surgisoft.rig.arm import STANDARD_GRAVITY, chamber_thrusts, no_equilibrium
from surgisoft.rig.effects import REFERENCE_KPA, Effects
from surgisoft.rig.rod import Loads, Rod, balance, new_shape

MOMENT_S = (40.0, 100.0)
"""Between when something happens that happens once [s]: within the two and a half minutes of the
shortest recordings, and before their last quarter."""


@dataclass
class Bench:
    """What an effect may change, and the arm that it changes."""

    effects: Effects
    """Amplitudes."""
    loads: Loads
    """Outside loads."""
    rod: Rod
    """The arm's statics."""


@dataclass(frozen=True)
class Hidden:
    """One hidden effect."""

    place: str
    """Where in the chain it acts: line, material, body or sensor."""
    about: str
    """One line."""
    switch_on: Callable[[Bench, float, np.random.Generator], None]
    """Change the bench by a strength, with the arm's own random numbers."""


def _set(bench: Bench, **amplitudes) -> None:
    bench.effects = bench.effects._replace(**amplitudes)


def _pattern(rng: np.random.Generator, m: int) -> np.ndarray:
    """(m,) numbers of mean 0 and root mean square 1 (m > 1)."""
    values = rng.permutation(np.linspace(-1.0, 1.0, m)) + rng.normal(0.0, 0.2, m)
    values -= values.mean() if m > 1 else 0.0
    return values / np.sqrt(np.mean(values**2))


def _direction(rng: np.random.Generator) -> np.ndarray:
    """(3,) random unit vector."""
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def _hysteresis(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    _set(bench, friction=1.0 * strength)


def _rate_dependence(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    _set(bench, rate=0.026 * strength)


def _line_lag(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    _set(bench, line=np.array([1700.0, 950.0]) / strength)


def _creep(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    _set(bench, creep=7.5 * strength)


def _softening(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    _set(bench, softening=0.08 * strength)


def _stiffening(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    _set(bench, stiffening=0.03 * strength)


def _dead_zone(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    _set(bench, dead_zone=1.2 * strength)


def _gain_mismatch(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    _set(bench, gain=0.05 * strength * _pattern(rng, len(bench.effects.gain)))


def _coupling(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    m = len(bench.effects.gain)
    matrix = 3.0 * strength * rng.uniform(0.6, 1.4, (m, m))
    np.fill_diagonal(matrix, 0.0)
    _set(bench, coupling=matrix)


def _payload(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    angle = rng.uniform(0, 2 * np.pi)
    weight = bench.loads.payload + 0.7e-3 * strength * STANDARD_GRAVITY
    at = np.array([2.0 * np.cos(angle), 2.0 * np.sin(angle), 2.0])
    bench.loads = bench.loads._replace(payload=weight, payload_at=at)


def _contact(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    """A support across the arm's way: touched at 40 % of the body's reach towards it.

    At strength 1 it keeps the tip back by 4 mm where the free arm would go deepest into it.
    """
    m = len(bench.effects.gain)
    plane = int(rng.integers(2, max(3, len(bench.rod.planes) - 1)))
    angle = rng.uniform(0, 2 * np.pi)
    normal = np.array([np.cos(angle), np.sin(angle), 0.0])
    singles = REFERENCE_KPA * np.eye(m)
    poses = [np.zeros(m), *singles, *(REFERENCE_KPA - singles)]
    towards = [-float(_posed(bench, bench.loads, p)[plane] @ normal) for p in poses]
    deepest = poses[int(np.argmax(towards))]
    free = _posed(bench, bench.loads, deepest)[-1]
    support = bench.loads._replace(
        support=int(bench.rod.planes[plane]),
        support_normal=normal,
        support_gap=-(towards[0] + 0.4 * (max(towards) - towards[0])),
    )

    def kept_back(log_stiffness: float) -> float:
        loads = support._replace(support_stiffness=float(np.exp(log_stiffness)))
        return float(np.linalg.norm(_posed(bench, loads, deepest)[-1] - free)) - 4.0

    stiffness = np.exp(brentq(kept_back, np.log(1e-4), np.log(0.5), xtol=1e-3))
    bench.loads = support._replace(support_stiffness=float(strength * stiffness))


def _posed(bench: Bench, loads: Loads, pressures: np.ndarray) -> np.ndarray:
    """Key planes' centres (n, 3) [mm] of the frictionless arm under pressures (m,) [kPa]."""
    rod, shape = bench.rod, new_shape(bench.rod)
    thrusts = np.empty((len(rod.stiffness), len(pressures)))
    chamber_thrusts(rod, np.asarray(pressures, np.float64), thrusts)
    if not balance(rod, loads, 1.0, thrusts, rod.base, shape):
        raise no_equilibrium()
    return shape.centres


def _misalignment(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    turn = np.radians(0.8) * strength * _direction(rng)
    shift = 0.4 * strength * _direction(rng)
    warp = 1e-4 * strength * rng.choice([-1.0, 1.0])
    _set(bench, misalignment=np.concatenate([turn, shift, [warp]]))


def _drift(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    angle = rng.uniform(0, 2 * np.pi)
    turn = np.radians(1.2) * strength
    _set(bench, drift=turn * np.array([np.cos(angle), np.sin(angle), 0.0]))


def _thermal_drift(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    _set(bench, warmth=0.022 * strength)


def _stick_slip(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    _set(bench, stick=np.array([0.5 * strength, 0.04]))


def _leak(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    leak = np.zeros(len(bench.effects.leak))
    leak[rng.integers(len(leak))] = 5.0 * strength
    _set(bench, leak=leak)


def _twist(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    _set(bench, twist=0.5 * strength * rng.choice([-1.0, 1.0]))


def _sensor_crosstalk(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    _set(bench, crosstalk=0.03 * strength)


def _marker_slip(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    marker = rng.integers(3)
    slip = np.array([len(bench.rod.planes) - 1, marker, 4.0 * strength, np.radians(30.0)])
    _set(bench, slip=slip)


def _breathing(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    """About 15 breaths a minute."""
    shift = 2.0 * strength * _direction(rng)
    period = rng.uniform(3.5, 4.5)
    _set(bench, breath=np.array([*shift, period, rng.uniform(0.0, period)]))


def _valve_jam(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    """Every 8 s on average one valve sticks (the clogged valve of Bartys et al. 2006)."""
    gaps = rng.exponential(8.0, 2000)
    lasts = strength * rng.uniform(0.5, 1.5, len(gaps))
    begins = np.cumsum(gaps) + np.concatenate([[0.0], np.cumsum(lasts)[:-1]])
    spells = np.stack([begins, begins + lasts], axis=1)
    _set(bench, jam=spells, jammed=int(rng.integers(len(bench.effects.gain))))


def _knock(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    angle = rng.uniform(0, 2 * np.pi)
    turn = np.radians(1.2) * strength
    moment = rng.uniform(*MOMENT_S)
    _set(bench, knock=np.array([turn * np.cos(angle), turn * np.sin(angle), 0.0, moment]))


def _fibre_break(bench: Bench, strength: float, rng: np.random.Generator) -> None:
    broken = np.zeros(len(bench.effects.broken))
    broken[rng.integers(len(broken))] = 5.0 * strength
    _set(bench, broken=broken, break_s=float(rng.uniform(*MOMENT_S)))


HIDDEN: dict[str, Hidden] = {
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
    "stick_slip": Hidden("material", "wall lines that stick and let go at once", _stick_slip),
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


def switch_on(bench: Bench, names: Iterable[tuple[str, float]], seed: int) -> Bench:
    """The bench with the named effects, each with its strength (0: off)."""
    seen: set[str] = set()
    for name, strength in names:
        if name not in HIDDEN:
            raise unknown_name("hidden effect", name, HIDDEN)
        if name in seen:
            raise InputError(f"hidden effect '{name}' is given twice, expected once")
        if not (np.isfinite(strength) and 0.0 <= strength <= 10.0):
            raise InputError(f"strength of '{name}' is {strength}, expected 0 to 10")
        seen.add(name)
        if strength > 0:
            rng = np.random.default_rng([seed, zlib.crc32(name.encode())])
            HIDDEN[name].switch_on(bench, float(strength), rng)
    return bench
