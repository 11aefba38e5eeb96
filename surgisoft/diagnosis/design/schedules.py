"""What can be done on a bench: schedules of actuation, and experimental setups.

A schedule is put together from excitation signals of two minutes, each a run of its own that starts
from a vented, rested arm. A experimental setup leaves the actuation alone: it moves the weight or
takes the support away, and so speaks about effects that no actuation tells apart.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from surgisoft.diagnosis.effect_knowledge import absent_in
from surgisoft.measurement.protocols import Protocol, continuous
from surgisoft.measurement.protocols.continuous import Knots

SPAN = 69.0
"""Width of the range that the rates of the excitation signals are meant for, kPa; others are scaled
to it."""
RUN_S = 120.0
"""Length of a excitation signal, s."""
REST_MINUTES = 0.5
"""Time that the arm is vented and rests before each run, minutes."""
INSET = 0.02
"""Share of the range that is left free at both ends, so that no command leaves the arm's range."""
QUICK = 60.0
"""Rate of a step, kPa/s on the scale of SPAN."""


@dataclass(frozen=True)
class Excitation:
    """One kind of run."""

    about: str
    """What is done, in words; {channels} stands for what the actuation goes to."""
    draw: Callable[[Knots, float, np.random.Generator], None]
    """Writes at least so many seconds into knots."""


def _some(rng: np.random.Generator, chambers: int) -> np.ndarray:
    """(m,) 1 for the chambers of a random single, pair or larger set, 0 for the others."""
    number = int(rng.integers(1, chambers + 1))
    return (rng.permutation(chambers) < number).astype(float)


def two_speeds(knots: Knots, seconds: float, rng: np.random.Generator) -> None:
    """The same path slowly and fast: what depends on time changes, what does not is the same."""
    while knots.now < seconds:
        chosen = _some(rng, len(knots.low))
        top = chosen * rng.uniform(0.5, 1.0) * knots.high
        for rate in rng.permutation([3.0, 20.0, 60.0]):
            for target in (top, 0.4 * top, 0.8 * top, 0.0 * top):
                knots.go(target, rate)


def steps(knots: Knots, seconds: float, rng: np.random.Generator) -> None:
    """Quick steps to random actuations, held for 1.5 to 4 s."""
    while knots.now < seconds:
        knots.go(rng.uniform(knots.low, knots.high), QUICK)
        knots.hold(rng.uniform(1.5, 4.0))


def long_holds(knots: Knots, seconds: float, rng: np.random.Generator) -> None:
    """A quick step to a high load held for 40 s, then 20 s at rest."""
    while knots.now < seconds:
        chosen = _some(rng, len(knots.low))
        knots.go(chosen * rng.uniform(0.6, 1.0) * knots.high, QUICK)
        knots.hold(40.0)
        knots.go(np.zeros_like(chosen), QUICK)
        knots.hold(20.0)


def returns(knots: Knots, seconds: float, rng: np.random.Generator) -> None:
    """To the same two postures and back to rest, again and again."""
    postures = [rng.uniform(0.0, 0.9, len(knots.high)) * knots.high for _ in range(2)]
    for posture in itertools.cycle(postures):
        if knots.now >= seconds:
            return
        for target in (posture, np.zeros_like(posture)):
            knots.go(target, 20.0)
            knots.hold(4.0)


def sets(knots: Knots, seconds: float, rng: np.random.Generator) -> None:
    """Each chamber alone, each pair, all together, up and down in steady sweeps."""
    m = len(knots.high)
    chosen = [c for c in itertools.product([0.0, 1.0], repeat=m) if any(c)] if m <= 4 else []
    while knots.now < seconds:
        order = rng.permutation(len(chosen)) if chosen else range(8)
        for k in order:
            pick = np.array(chosen[k]) if chosen else _some(rng, m)
            for level in (1.0, 0.5, 1.0, 0.0):
                knots.go(pick * level * knots.high, 16.0)
                knots.hold(0.5)


EXCITATIONS: dict[str, Excitation] = {
    "ramps": Excitation("ramps at four speeds", continuous.ramps),
    "two_speeds": Excitation("the same paths slowly and fast", two_speeds),
    "steps": Excitation("quick steps with short stops", steps),
    "long_holds": Excitation("high loads held for 40 s, then rest", long_holds),
    "holds": Excitation("steps held for 5 to 40 s", continuous.holds),
    "reversals": Excitation("small reversals about many mean loads", continuous.reversals),
    "ladder": Excitation("triangles of growing and shrinking amplitude", continuous.ladder),
    "returns": Excitation("the same two postures and rest, again and again", returns),
    "sets": Excitation("single, pair and all {channels} in steady sweeps", sets),
    "wander": Excitation("straight legs between random loads at random rates", continuous.wander),
}
"""Every excitation signal by name."""

REFERENCE = ("ramps", "steps", "holds", "reversals", "ladder", "wander")
"""Excitation signals of the varied schedule on which the plausible size of an effect is stated."""


@dataclass(frozen=True)
class Setup:
    """How the bench stands while a schedule is played."""

    about: str
    """What a person does to the bench, with the places of `Words`; empty: nothing is to be done."""
    minutes: float
    """Time that this takes, minutes."""
    options: str = ""
    """Options of `surgisoft collect` for the same on the virtual rig."""
    roll_deg: float = 0.0
    """Turn of the base about its own z axis, degrees."""
    flipped: bool = False
    """Whether the bench stands on its head."""
    payload_g: float = 0.0
    """Known mass hung on the tip, g."""
    removes: tuple[str, ...] = ()
    """Effects that are then absent."""

    @property
    def moves_weight(self) -> bool:
        """Whether the arm's own weight, or a known one, then pulls otherwise."""
        return bool(self.roll_deg or self.flipped or self.payload_g)

    def gravity(self, weight) -> tuple[float, float, float] | None:
        """Unit vector of weight (3,) in the base frame, from that of the bench as it stands."""
        if weight is None:
            return None
        x, y, z = np.asarray(weight, float)
        angle = np.radians(self.roll_deg)
        c, s = np.cos(angle), np.sin(angle)
        turned = np.array([c * x + s * y, -s * x + c * y, z])
        return tuple(float(v) for v in (-turned if self.flipped else turned))


AS_IT_STANDS = "as_it_stands"
"""The bench as it was when the model was fitted."""

_SETUPS: dict[str, Setup] = {
    AS_IT_STANDS: Setup("", 0.0),
    "roll_90": Setup(
        "turn the arm's base by 90 degrees about its own axis", 2.0, "--roll-deg 90", 90.0
    ),
    "roll_180": Setup(
        "turn the arm's base by 180 degrees about its own axis", 2.0, "--roll-deg 180", 180.0
    ),
    "upside_down": Setup(
        "turn the bench upside down, so that the weight pulls the other way",
        3.0,
        "--gravity {gravity}",
        flipped=True,
    ),
    "known_mass": Setup(
        "hang a known mass on the tip, about a fifth of the arm's own (2 g on the virtual rig)",
        1.0,
        "--payload-g 2",
        payload_g=2.0,
    ),
    "no_support": Setup("move everything away that the arm's body may lean on", 1.0),
    "bare_tip": Setup(
        "take everything off the tip and the body that is no part of the arm",
        2.0,
    ),
    "short_tube": Setup(
        "{short_line}",
        3.0,
    ),
    "new_frame": Setup(
        "measure the base frame anew with the cameras, with a {resting}",
        3.0,
    ),
}
SETUPS = {name: replace(setup, removes=absent_in(name)) for name, setup in _SETUPS.items()}
"""Every experimental setup by name."""


ON_THE_RIG = tuple(name for name, setting in SETUPS.items() if not setting.removes)
"""Experimental setups that the virtual rig has an option for."""


def draw_run(
    name: str, limits: np.ndarray, seed: int, seconds: float = RUN_S
) -> tuple[np.ndarray, np.ndarray]:
    """Knot times (T,) [s] and actuations (T, m) of one excitation signal; limits (m, 2), the arm's
    unit."""
    limits = np.asarray(limits, float)
    scale = SPAN / max(float(np.ptp(limits, axis=1).max()), 1e-12)
    knots = Knots(limits * scale)
    rng = np.random.default_rng([seed, list(EXCITATIONS).index(name)])
    EXCITATIONS[name].draw(knots, seconds, rng)
    times, rows = knots.cut(seconds)
    return times, np.clip(rows / scale, *limits.T)


def bench_minutes(runs: int) -> float:
    """Time of so many runs with the rest before each, minutes."""
    return runs * (RUN_S / 60.0 + REST_MINUTES)


def schedule(name: str, figures: list[tuple[str, int]], limits: np.ndarray, unit: str) -> Protocol:
    """The protocol that plays excitation signals (name, seed), one run each, within limits (m,
    2)."""
    times, rows, runs = [], [], []
    for run, (figure, seed) in enumerate(figures):
        t, p = draw_run(figure, limits, seed)
        times.append(t)
        rows.append(p)
        runs.append(np.full(len(t), run))
    return Protocol(
        name,
        "continuous",
        np.concatenate(rows),
        np.concatenate(runs),
        np.concatenate(times),
        unit=unit,
    )


def schedule_text(protocol: Protocol) -> str:
    """A continuous protocol as the CSV file that `collect` reads."""
    header = ["t_s", *(f"c{k + 1}_{protocol.unit}" for k in range(protocol.chambers)), "run"]
    lines = [",".join(header)]
    for t, row, run in zip(protocol.t_s, protocol.commands, protocol.run, strict=True):
        lines.append(",".join([f"{t:.3f}", *(f"{value:.4f}" for value in row), str(run)]))
    return "\n".join(lines) + "\n"


def limits_within(low, high) -> np.ndarray:
    """(m, 2) range of commands inside an arm's range low, high (m,); rest stays inside."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    room = INSET * (high - low)
    rest = np.clip(0.0, low, high)
    return np.stack([np.minimum(low + room, rest), np.maximum(high - room, rest)], axis=1)


# Words of the bench ----------------------------------------------------------------------------

PRESSURES = ("Pa", "hPa", "kPa", "MPa", "mbar", "bar", "psi", "atm", "mmHg", "torr")
"""Units of a pneumatic or hydraulic arm."""
TENDONS = ("deg", "rad", "rev", "mm", "cm", "m", "in", "N", "mN", "kN")
"""Units of an arm that motors pull: angles, lengths and forces."""


@dataclass(frozen=True)
class Words:
    """One bench's own words."""

    channels: str
    """What the actuation goes to."""
    resting: str
    """An arm whose actuation is where it rests."""
    short_line: str
    """What is done to shorten the way from the command to the arm."""


_PNEUMATIC = Words(
    "chambers",
    "vented arm",
    "put the valves at the base of the arm: the shortest and widest tubes that fit",
)
_TENDON = Words(
    "tendons",
    "slack arm",
    "put the motors at the base of the arm: the shortest and straightest tendons that fit, and "
    "the quickest settings of their controllers",
)
_OTHER = Words(
    "channels",
    "relaxed arm",
    "put the drives at the base of the arm: the shortest way from the command to the arm",
)


def words_for(unit: str) -> Words:
    """The words for an arm that is driven in this unit."""
    if unit in PRESSURES:
        return _PNEUMATIC
    return _TENDON if unit in TENDONS else _OTHER
