"""Excitation signals: continuous commands as knots of time and pressure, linear between knots.

Each signal excites some effects of an arm more than others: ramps its rate dependence, holds its
creep, reversals its hysteresis. SIGNALS names them all; the protocols of `surgisoft collect` choose
from it.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from surgisoft.errors import InputError

BRISK = 20.0
"""Rate at which a schedule goes to a starting point [kPa/s]."""
QUICK = 60.0
"""Rate of a step [kPa/s]; the experiment design scales rates to the arm's range."""
LEAST_RANGE = 0.1
"""Narrowest range of the chamber with the widest one [kPa]: at the rate of a step it takes 1.7 ms,
and a movement of less than a millisecond is none."""


class Knots:
    """A schedule while it is written; starts at ambient pressure."""

    def __init__(self, limits: np.ndarray) -> None:
        """limits: (m, 2) lowest and highest actuation [kPa].

        Raises InputError where no chamber has a range of `LEAST_RANGE`: no signal would end.
        """
        self.low, self.high = limits.T
        widest = float((self.high - self.low).max())
        if not widest >= LEAST_RANGE:
            raise InputError(
                f"limits {limits.tolist()}: the widest range is {widest:g}, expected at least "
                f"{LEAST_RANGE:g}; state the limits in a smaller unit, such as kPa"
            )
        self.rest = np.clip(np.zeros(len(limits)), self.low, self.high)
        """(m,) actuation of an arm at rest: the one nearest to zero [kPa]."""
        self.far = farthest_from_rest(limits)
        """(m,) end of each chamber's range that is farthest from rest [kPa]."""
        self.near = np.where(self.far == self.high, self.low, self.high)
        """(m,) the other end of each chamber's range [kPa]."""
        self.times = [0.0]
        self.rows = [self.rest]

    @property
    def now(self) -> float:
        """Time of the last knot [s]."""
        return self.times[-1]

    def out(self, share: np.ndarray) -> np.ndarray:
        """(m,) actuation at shares (m,) of the way from rest to the farthest end [kPa]."""
        return self.rest + share * (self.far - self.rest)

    def go(self, target: np.ndarray, rate: float) -> None:
        """To a target (m,) [kPa], the farthest chamber at `rate` [kPa/s]."""
        target = np.clip(target, self.low, self.high)
        seconds = float(np.abs(target - self.rows[-1]).max()) / rate
        if seconds > 1e-3:
            self.times.append(self.now + seconds)
            self.rows.append(target)

    def hold(self, seconds: float) -> None:
        """Hold the present pressures for a time [s]."""
        self.times.append(self.now + seconds)
        self.rows.append(self.rows[-1])

    def cut(self, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """Times (T,) [s] and rows (T, m) [kPa] of the first `seconds`."""
        times, rows = np.array(self.times), np.array(self.rows)
        inside = times < seconds - 1e-9
        last = [np.interp(seconds, times, column) for column in rows.T]
        return np.append(times[inside], seconds), np.vstack([rows[inside], last])


def farthest_from_rest(limits: np.ndarray) -> np.ndarray:
    """(m,) the end of each range in limits (m, 2) that is farthest from rest, same unit.

    Rest is the actuation nearest to zero. The farthest end is the lowest one of a chamber that is
    driven by vacuum; of two ends that are equally far it is the upper one.
    """
    low, high = np.asarray(limits, np.float64).T
    rest = np.clip(0.0, low, high)
    return np.where(high - rest >= rest - low, high, low)


def _some(rng: np.random.Generator, chambers: int) -> np.ndarray:
    """(m,) 1 for the chambers of a random single, pair or larger set."""
    chosen = np.zeros(chambers)
    chosen[rng.permutation(chambers)[: rng.integers(1, chambers + 1)]] = 1.0
    return chosen


def ramps(knots: Knots, seconds: float, rng: np.random.Generator) -> None:
    """Up and down at 2, 4, 8 and 16 kPa/s, one chamber, pairs, all."""
    while knots.now < seconds:
        for rate in rng.permutation([2.0, 4.0, 8.0, 16.0]):
            chosen = _some(rng, len(knots.low))
            top = knots.out(np.full(len(chosen), rng.uniform(0.4, 1.0)))
            bottom = np.where(rng.random() < 0.5, knots.near, knots.rest)
            start = knots.rows[-1]
            knots.go(np.where(chosen > 0, top, start), rate)
            knots.go(np.where(chosen > 0, bottom, start), rate)


def holds(knots: Knots, seconds: float, rng: np.random.Generator) -> None:
    """Quick steps to random pressures, held for 5 to 40 s."""
    while knots.now < seconds:
        target = rng.uniform(knots.low, knots.high)
        if rng.random() < 0.3:
            target = knots.rest
        knots.go(target, BRISK)
        knots.hold(float(np.exp(rng.uniform(np.log(5.0), np.log(40.0)))))


def reversals(knots: Knots, seconds: float, rng: np.random.Generator) -> None:
    """Small back-and-forth movements of 1.5 to 8 kPa about many mean pressures."""
    while knots.now < seconds:
        knots.go(rng.uniform(knots.low, knots.high), 8.0)
        centre = knots.rows[-1]
        for _ in range(int(rng.integers(3, 7))):
            reach = rng.uniform(1.5, 8.0) * _some(rng, len(centre)) * rng.choice([-1, 1])
            rate = float(rng.choice([3.0, 6.0, 12.0]))
            knots.go(centre + reach, rate)
            knots.go(centre - 0.5 * reach, rate)


def ladder(knots: Knots, seconds: float, rng: np.random.Generator) -> None:
    """Triangles from ambient whose amplitude grows to the limit and shrinks again."""
    while knots.now < seconds:
        chosen = _some(rng, len(knots.low))
        rising = np.linspace(0.15, 1.0, 6)
        rate = float(rng.choice([8.0, 16.0]))
        for reach in [*rising, *rising[-2::-1]]:
            knots.go(knots.out(chosen * reach), rate)
            knots.go(knots.rest, rate)
        knots.go(chosen * knots.near, rate)


def wander(knots: Knots, seconds: float, rng: np.random.Generator) -> None:
    """Straight legs between random pressures at random rates."""
    while knots.now < seconds:
        knots.go(rng.uniform(knots.low, knots.high), float(np.exp(rng.uniform(0.7, 3.0))))


def _subset(rng: np.random.Generator, chambers: int) -> np.ndarray:
    """(m,) 1 for the chambers of a random single, pair or larger set, 0 for the others.

    Has the distribution of `_some` but draws the size first: the schedules of a seed depend on it.
    """
    number = int(rng.integers(1, chambers + 1))
    return (rng.permutation(chambers) < number).astype(float)


def two_speeds(knots: Knots, seconds: float, rng: np.random.Generator) -> None:
    """One path at 3, 20 and 60 kPa/s: separates what depends on time from what does not."""
    while knots.now < seconds:
        chosen = _subset(rng, len(knots.low))
        top = knots.out(chosen * rng.uniform(0.5, 1.0)) - knots.rest
        for rate in rng.permutation([3.0, 20.0, 60.0]):
            for share in (1.0, 0.4, 0.8, 0.0):
                knots.go(knots.rest + share * top, rate)


def steps(knots: Knots, seconds: float, rng: np.random.Generator) -> None:
    """Quick steps to random pressures, held for 1.5 to 4 s."""
    while knots.now < seconds:
        knots.go(rng.uniform(knots.low, knots.high), QUICK)
        knots.hold(rng.uniform(1.5, 4.0))


def long_holds(knots: Knots, seconds: float, rng: np.random.Generator) -> None:
    """A quick step far from rest held for 40 s, then 20 s at rest."""
    while knots.now < seconds:
        chosen = _subset(rng, len(knots.low))
        knots.go(knots.out(chosen * rng.uniform(0.6, 1.0)), QUICK)
        knots.hold(40.0)
        knots.go(knots.rest, QUICK)
        knots.hold(20.0)


def returns(knots: Knots, seconds: float, rng: np.random.Generator) -> None:
    """To the same two postures and back to rest, again and again: shows drift and slow recovery."""
    postures = [knots.out(rng.uniform(0.0, 0.9, len(knots.far))) for _ in range(2)]
    for posture in itertools.cycle(postures):
        if knots.now >= seconds:
            return
        for target in (posture, knots.rest):
            knots.go(target, 20.0)
            knots.hold(4.0)


def sets(knots: Knots, seconds: float, rng: np.random.Generator) -> None:
    """Each chamber alone, each pair, all together, up and down in steady sweeps."""
    m = len(knots.far)
    chosen = [c for c in itertools.product([0.0, 1.0], repeat=m) if any(c)] if m <= 4 else []
    while knots.now < seconds:
        order = rng.permutation(len(chosen)) if chosen else range(8)
        for k in order:
            pick = np.array(chosen[k]) if chosen else _subset(rng, m)
            for level in (1.0, 0.5, 1.0, 0.0):
                knots.go(knots.out(pick * level), 16.0)
                knots.hold(0.5)


@dataclass(frozen=True)
class Signal:
    """One kind of excitation."""

    about: str
    """Description in words; {channels} is replaced by the names of the channels."""
    draw: Callable[[Knots, float, np.random.Generator], None]
    """Writes at least so many seconds into knots."""


SIGNALS: dict[str, Signal] = {
    "ramps": Signal("ramps at four speeds", ramps),
    "two_speeds": Signal("the same paths slowly and fast", two_speeds),
    "steps": Signal("quick steps with short stops", steps),
    "long_holds": Signal("high loads held for 40 s, then rest", long_holds),
    "holds": Signal("steps held for 5 to 40 s", holds),
    "reversals": Signal("small reversals about many mean loads", reversals),
    "ladder": Signal("triangles of growing and shrinking amplitude", ladder),
    "returns": Signal("the same two postures and rest, again and again", returns),
    "sets": Signal("single, pair and all {channels} in steady sweeps", sets),
    "wander": Signal("straight legs between random loads at random rates", wander),
}
"""Every excitation signal by name."""


def schedule(
    signals: Sequence[str],
    points: int,
    period_s: float,
    limits: np.ndarray,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Knot times (K,), rows (K, m), run ids (K,): one run a signal, `points` samples in all."""
    times, rows, runs = [], [], []
    edges = np.round(np.linspace(0, points, len(signals) + 1)).astype(int)
    for run, (name, count) in enumerate(zip(signals, np.diff(edges), strict=True)):
        if count == 0:
            continue
        seconds = float(count * period_s)
        knots = Knots(limits)
        SIGNALS[name].draw(knots, seconds, rng)
        t, p = knots.cut(seconds)
        times.append(t)
        rows.append(p)
        runs.append(np.full(len(t), run, np.int64))
    return np.concatenate(times), np.concatenate(rows), np.concatenate(runs)
