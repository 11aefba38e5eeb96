"""What can be done on a bench: schedules of actuation, and experimental setups.

A schedule is put together from excitation signals of two minutes, each a run of its own that starts
from a vented, rested arm. An experimental setup leaves the actuation alone: it moves the weight or
takes the support away, and so speaks about effects that no actuation tells apart.
"""

from dataclasses import dataclass

import numpy as np

from surgisoft.measurement.protocols import SIGNALS, Knots, Protocol
from surgisoft.surrogate.effects import hypothesis_of, known_effects

SPAN = 69.0
"""Width of the range that the rates of the excitation signals are meant for, kPa; others are scaled
to it."""
RUN_S = 120.0
"""Length of an excitation signal, s."""
REST_MINUTES = 0.5
"""Time that the arm is vented and rests before each run, minutes."""
INSET = 0.02
"""Share of the range that is left free at both ends, so that no command leaves the arm's range."""

GRAVITY_DIGITS = 4
"""Decimals of a direction of gravity that is asked for: a bench is not turned as finely."""

REFERENCE = ("ramps", "steps", "holds", "reversals", "ladder", "wander")
"""Excitation signals of the varied schedule on which the plausible size of an effect is stated."""


@dataclass(frozen=True)
class Setup:
    """How the bench stands while a schedule is played."""

    name: str
    """Its name, as `Hypothesis.absent_in` gives it."""
    about: str
    """What a person does to the bench, with the places of `Words`; empty: nothing is to be done."""
    minutes: float
    """Time that this takes, minutes."""
    roll_deg: float = 0.0
    """Turn of the base about its own z axis, degrees."""
    flipped: bool = False
    """Whether the bench stands on its head."""
    payload_g: float = 0.0
    """Known mass hung on the tip, g."""

    @property
    def removes(self) -> tuple[str, ...]:
        """Known effects that cannot act in it (`Hypothesis.absent_in`)."""
        known = known_effects()
        return tuple(n for n, kind in known.items() if hypothesis_of(kind).absent_in == self.name)

    @property
    def moves_weight(self) -> bool:
        """Whether the arm's own weight, or a known one, then pulls otherwise."""
        return bool(self.roll_deg or self.flipped or self.payload_g)

    def rig_options(self, weight) -> dict[str, float | tuple[float, float, float]]:
        """Options of `collect` for it on the virtual rig; weight: (3,) as for `gravity`, or None.

        Empty where nothing is to be done, and where the rig has no option for it.
        """
        if self.flipped:
            turned = self.gravity(weight)
            if turned is None:
                return {}
            x, y, z = (round(value, GRAVITY_DIGITS) for value in turned)
            return {"gravity": (x, y, z)}
        values = {"roll_deg": self.roll_deg, "payload_g": self.payload_g}
        return {name: value for name, value in values.items() if value}

    def gravity(self, weight) -> tuple[float, float, float] | None:
        """Unit vector of weight (3,) in the base frame, from that of the bench as it stands."""
        if weight is None:
            return None
        x, y, z = np.asarray(weight, float)
        angle = np.radians(self.roll_deg)
        c, s = np.cos(angle), np.sin(angle)
        sign = -1.0 if self.flipped else 1.0
        return (
            float(sign * (c * x + s * y)),
            float(sign * (-s * x + c * y)),
            float(sign * z),
        )


AS_IT_STANDS = "as_it_stands"
"""The bench as it was when the model was fitted."""

_EVERY_SETUP = (
    Setup(AS_IT_STANDS, "", 0.0),
    Setup(
        "roll_90",
        "turn the arm's base by 90 degrees about its own axis",
        2.0,
        roll_deg=90.0,
    ),
    Setup(
        "roll_180",
        "turn the arm's base by 180 degrees about its own axis",
        2.0,
        roll_deg=180.0,
    ),
    Setup(
        "upside_down",
        "turn the bench upside down, so that the weight pulls the other way",
        3.0,
        flipped=True,
    ),
    Setup(
        "known_mass",
        "hang a known mass on the tip, about a fifth of the arm's own (2 g on the virtual rig)",
        1.0,
        payload_g=2.0,
    ),
    Setup("no_support", "move everything away that the arm's body may lean on", 1.0),
    Setup(
        "bare_tip",
        "take everything off the tip and the body that is not part of the arm",
        2.0,
    ),
    Setup(
        "short_tube",
        "{short_line}",
        3.0,
    ),
    Setup(
        "new_frame",
        "measure the base frame anew with the cameras, with a {resting}",
        3.0,
    ),
)
SETUPS: dict[str, Setup] = {setup.name: setup for setup in _EVERY_SETUP}
"""Every experimental setup by name."""


def on_the_rig() -> tuple[str, ...]:
    """Names of the experimental setups that the virtual rig has an option for."""
    return tuple(name for name, setup in SETUPS.items() if not setup.removes)


def draw_run(
    name: str, limits: np.ndarray, seed: int, seconds: float = RUN_S
) -> tuple[np.ndarray, np.ndarray]:
    """Knot times (T,) [s] and actuations (T, m) of one excitation signal; limits (m, 2), the arm's
    unit."""
    limits = np.asarray(limits, float)
    scale = SPAN / max(float(np.ptp(limits, axis=1).max()), 1e-12)
    knots = Knots(limits * scale)
    rng = np.random.default_rng([seed, list(SIGNALS).index(name)])
    SIGNALS[name].draw(knots, seconds, rng)
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
    assert protocol.t_s is not None, "continuous protocols have times"
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
