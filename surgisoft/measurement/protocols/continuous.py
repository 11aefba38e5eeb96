"""Continuous schedules: knots of time and pressure, between which the command is linear."""

import numpy as np

BRISK = 20.0
"""Rate at which a schedule goes to a starting point [kPa/s]."""


class Knots:
    """A schedule while it is written; starts at ambient pressure."""

    def __init__(self, limits: np.ndarray) -> None:
        self.low, self.high = limits.T
        self.times = [0.0]
        self.rows = [np.clip(np.zeros(len(limits)), self.low, self.high)]

    @property
    def now(self) -> float:
        """Time of the last knot [s]."""
        return self.times[-1]

    def go(self, target: np.ndarray, rate: float) -> None:
        """To a target (m,) [kPa], the farthest chamber at `rate` [kPa/s]."""
        target = np.clip(target, self.low, self.high)
        seconds = float(np.abs(target - self.rows[-1]).max()) / rate
        if seconds > 1e-3:
            self.times.append(self.now + seconds)
            self.rows.append(target)

    def hold(self, seconds: float) -> None:
        """Stay [s]."""
        self.times.append(self.now + seconds)
        self.rows.append(self.rows[-1])

    def cut(self, seconds: float) -> tuple[np.ndarray, np.ndarray]:
        """Times (T,) [s] and rows (T, m) [kPa] of the first `seconds`."""
        times, rows = np.array(self.times), np.array(self.rows)
        inside = times < seconds - 1e-9
        last = [np.interp(seconds, times, column) for column in rows.T]
        return np.append(times[inside], seconds), np.vstack([rows[inside], last])


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
            top = rng.uniform(0.4, 1.0) * knots.high
            bottom = np.where(rng.random() < 0.5, knots.low, 0.0)
            start = knots.rows[-1]
            knots.go(np.where(chosen > 0, top, start), rate)
            knots.go(np.where(chosen > 0, bottom, start), rate)


def holds(knots: Knots, seconds: float, rng: np.random.Generator) -> None:
    """Quick steps to random pressures, held for 5 to 40 s."""
    while knots.now < seconds:
        target = rng.uniform(knots.low, knots.high)
        if rng.random() < 0.3:
            target = np.zeros_like(target)
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
            knots.go(chosen * reach * knots.high, rate)
            knots.go(np.zeros_like(chosen), rate)
        knots.go(chosen * knots.low, rate)


def wander(knots: Knots, seconds: float, rng: np.random.Generator) -> None:
    """Straight legs between random pressures at random rates."""
    while knots.now < seconds:
        knots.go(rng.uniform(knots.low, knots.high), float(np.exp(rng.uniform(0.7, 3.0))))


def schedule(figures, points: int, period_s: float, limits: np.ndarray, rng: np.random.Generator):
    """Knot times, rows and run ids of one run a figure, `points` samples together."""
    times, rows, runs = [], [], []
    edges = np.round(np.linspace(0, points, len(figures) + 1)).astype(int)
    for run, (figure, count) in enumerate(zip(figures, np.diff(edges), strict=True)):
        if count == 0:
            continue
        seconds = float(count * period_s)
        knots = Knots(limits)
        figure(knots, seconds, rng)
        t, p = knots.cut(seconds)
        times.append(t)
        rows.append(p)
        runs.append(np.full(len(t), run, np.int64))
    return np.concatenate(times), np.concatenate(rows), np.concatenate(runs)
