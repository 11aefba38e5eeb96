"""The known protocols by name."""

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surgisoft.errors import InputError, unknown_name
from surgisoft.measurement.protocols import continuous, steady_state
from surgisoft.measurement.protocols.protocol import Protocol
from surgisoft.measurement.protocols.schedule_file import load_schedule

PERIOD_S = 0.05
"""Samples of a continuous protocol are counted at 20 Hz."""


@dataclass(frozen=True)
class Entry:
    """One protocol of the catalogue."""

    about: str
    """Description in one line."""
    points: int
    """Default number of samples: steady-state points, or frames at 20 Hz."""
    steady_state: Callable | None = None
    """Builder of the pressures of steady-state points."""
    signals: tuple[str, ...] = ()
    """Excitation signals of a continuous schedule, one run each."""


MIXED = ("ramps", "holds", "reversals", "ladder", "wander")
"""Excitation signals of the mixed protocol, in the order of its runs."""

PROTOCOLS: dict[str, Entry] = {
    "grid": Entry(
        "every point of the 24-level lattice once, direction and memory excited everywhere",
        13824,
        steady_state=steady_state.grid,
    ),
    "traverse": Entry(
        "plain back-and-forth traverse of the lattice; the slow chamber only ever rises",
        13824,
        steady_state=steady_state.traverse,
    ),
    "walk": Entry(
        "random walk over 24 levels, all chambers, minor loops",
        13824,
        steady_state=steady_state.walk,
    ),
    "validation": Entry(
        "straight legs between random pressures, off the lattice",
        1000,
        steady_state=steady_state.validation,
    ),
    "test": Entry(
        "smooth oscillations of all chambers, off the lattice", 1000, steady_state=steady_state.test
    ),
    "ramps": Entry("ramps at 2, 4, 8 and 16 kPa/s, 5 minutes", 6000, signals=("ramps",)),
    "holds": Entry("quick steps held for 5 to 40 s, 5 minutes", 6000, signals=("holds",)),
    "reversals": Entry(
        "small reversals about many mean pressures, 5 minutes",
        6000,
        signals=("reversals",),
    ),
    "ladder": Entry(
        "triangles of growing and shrinking amplitude, 5 minutes",
        6000,
        signals=("ladder",),
    ),
    "mixed": Entry(
        "ramps, holds, reversals, ladder and a random walk, one run each, 10 minutes",
        12000,
        signals=MIXED,
    ),
}


def make_protocol(
    name: str | Path, limits: np.ndarray, points: int | None = None, seed: int = 0
) -> Protocol:
    """A protocol of the catalogue, or a schedule file by its path.

    limits: (m, 2) lowest and highest actuation [kPa]; points: samples (default: the catalogue's);
    seed: of the random parts; protocols have different random number streams. Raises InputError for
    an unknown name, too few points, and limits that are no ranges.
    """
    if str(name).endswith(".csv"):
        if points is not None:
            raise InputError(f"--points {points} does not apply to the schedule file {name}")
        return load_schedule(name)
    if name not in PROTOCOLS:
        raise unknown_name("protocol", str(name), [*PROTOCOLS, "SCHEDULE.csv"])
    entry = PROTOCOLS[str(name)]
    points = entry.points if points is None else points
    if points < 10:
        raise InputError(f"--points is {points}, expected at least 10")
    rng = np.random.default_rng([seed, zlib.crc32(str(name).encode())])
    limits = _checked(limits)
    if entry.steady_state:
        commands, run = entry.steady_state(points, limits, rng)
        return Protocol(str(name), "settled", commands, run)
    t_s, commands, run = continuous.schedule(entry.signals, points, PERIOD_S, limits, rng)
    return Protocol(str(name), "continuous", commands, run, t_s)


def _checked(limits: np.ndarray) -> np.ndarray:
    """Limits (m, 2) as float64; raises InputError unless each is a finite lowest and highest."""
    limits = np.asarray(limits, np.float64)
    pairs = limits.ndim == 2 and limits.shape[1] == 2 and len(limits) > 0
    if not (pairs and np.isfinite(limits).all() and (limits[:, 0] < limits[:, 1]).all()):
        raise InputError(
            f"limits {limits.tolist()}: expected a finite lowest and highest actuation of each "
            "chamber, the lowest below the highest"
        )
    return limits
