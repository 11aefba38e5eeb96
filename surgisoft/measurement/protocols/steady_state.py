"""Protocols of steady-state points: grid, traverse, random walk, validation and test.

The order of the points decides what a data set can teach about hysteresis. After a plain back-and-
forth traverse the slow chamber has only ever risen, and the direction of the others follows from
the position: direction and memory are then confounded with position. `grid` visits the same lattice
so that at every position every chamber has been approached from both sides, after reversals of all
sizes.
"""

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from surgisoft.errors import InputError

RUNS = 8
"""Runs that a long protocol is divided into, so that whole runs can be held out."""

MOST_INDICES = 2**26
"""Most indices of a lattice's points, one a point and chamber (a count; half a GiB)."""
MOST_ARRANGED = 7
"""Most chambers of which every order with every direction is listed: 645,120 for seven, and 16
times as many for eight (a count)."""


def lattice_size(points: int, chambers: int) -> int:
    """Levels a chamber of the smallest lattice with at least so many points.

    Raises InputError where that lattice has more than `MOST_INDICES` indices.
    """
    levels = max(2, round(points ** (1.0 / chambers)))
    while levels**chambers < points:
        levels += 1
    while levels > 2 and (levels - 1) ** chambers >= points:
        levels -= 1
    if levels**chambers * chambers > MOST_INDICES:
        raise InputError(
            f"a lattice of {levels} levels for each of {chambers} chambers has "
            f"{levels**chambers:.3g} set-points, expected at most {MOST_INDICES // chambers:.3g}; "
            "use the protocol 'walk', or fewer points"
        )
    return levels


def _pressures(indices: np.ndarray, levels: int, limits: np.ndarray) -> np.ndarray:
    """Lattice indices (T, m) to pressures (T, m) between limits (m, 2)."""
    low, high = limits.T
    return low + (high - low) * indices / (levels - 1)


def _in_runs(count: int, runs: int) -> np.ndarray:
    """Run ids (count,) of runs of about equal length."""
    return np.arange(count, dtype=np.int64) * min(runs, count) // count


def back_and_forth(
    lows: Sequence[int] | np.ndarray,
    highs: Sequence[int] | np.ndarray,
    order: Sequence[int],
    signs: Sequence[int],
) -> np.ndarray:
    """Every lattice point of a box once (T, m): neighbours in a row, the last axis of `order` fast.

    lows, highs: (m,) first and last index a chamber; order: chambers from slow to fast; signs: (m,)
    +1 where a chamber's first pass rises.
    """
    path = np.zeros((1, len(order)), np.int64)
    for axis in reversed(order):
        levels = np.arange(lows[axis], highs[axis] + 1)[:: signs[axis]]
        block = np.repeat(path[None], len(levels), axis=0)
        block[1::2] = block[1::2, ::-1]
        block[:, :, axis] = levels[:, None]
        path = block.reshape(-1, path.shape[1])
    return path


def traverse(points: int, limits: np.ndarray, rng: np.random.Generator):
    """The plain traverse of the cube: chamber 1 slow and only ever rising, the last one fast."""
    m = len(limits)
    levels = lattice_size(points, m)
    path = back_and_forth([0] * m, [levels - 1] * m, range(m), [1] * m)[:points]
    return _pressures(path, levels, limits), np.zeros(len(path), np.int64)


def grid(points: int, limits: np.ndarray, rng: np.random.Generator):
    """Every point of the lattice once, with direction and memory excited everywhere.

    The lattice is cut at random into boxes of many sizes; each box is traversed back and forth with
    its own order of the chambers, slow to fast, and its own directions, and the boxes follow each
    other at random. So every chamber is the slow one, rising and falling, and reversals range from
    two levels to the whole range.
    """
    m = len(limits)
    levels = lattice_size(points, m)
    boxes = _cut(np.zeros(m, np.int64), np.full(m, levels - 1), rng)
    boxes.sort(key=lambda box: -int((box[1] - box[0] + 1).prod()))
    parts = [
        back_and_forth(lows, highs, order, directions)
        for (lows, highs), (order, directions) in zip(boxes, _arrangements(m, rng), strict=False)
    ]
    rng.shuffle(parts)
    path = np.concatenate(parts)
    if len(path) > points:
        path = path[np.sort(rng.choice(len(path), points, replace=False))]
    return _pressures(path, levels, limits), _in_runs(len(path), RUNS)


def _arrangements(
    chambers: int, rng: np.random.Generator
) -> Iterator[tuple[Sequence[int], Sequence[int]]]:
    """Orders of the chambers, slow to fast, and directions of each, without end.

    Each round gives boxes of like size every order with every direction once. Of more than
    `MOST_ARRANGED` chambers there are more than boxes, and each is drawn alone.
    """
    if chambers > MOST_ARRANGED:
        while True:
            yield rng.permutation(chambers).tolist(), rng.choice([-1, 1], chambers).tolist()
    signs = itertools.product([-1, 1], repeat=chambers)
    deck = list(itertools.product(itertools.permutations(range(chambers)), signs))
    while True:
        rng.shuffle(deck)
        yield from deck


def _cut(lows: np.ndarray, highs: np.ndarray, rng: np.random.Generator) -> list:
    """A box of the lattice, cut at random until its parts are small enough."""
    sizes = highs - lows + 1
    enough = np.exp(rng.uniform(np.log(12.0), np.log(250.0)))
    if sizes.prod() <= enough:
        return [(lows, highs)]
    axis = rng.choice(len(sizes), p=(sizes - 1) / (sizes - 1).sum())
    at = int(rng.integers(lows[axis], highs[axis]))
    first, second = highs.copy(), lows.copy()
    first[axis], second[axis] = at, at + 1
    return _cut(lows, first, rng) + _cut(second, highs, rng)


def walk(points: int, limits: np.ndarray, rng: np.random.Generator):
    """A random walk over the 24 levels: every chamber keeps its direction for a while, or rests."""
    m, levels = len(limits), 24
    path = np.empty((points, m), np.int64)
    runs = _in_runs(points, RUNS)
    at, heading = np.zeros(m, np.int64), np.ones(m, np.int64)
    turn, stay = np.full(m, 0.2), np.full(m, 0.2)
    for t in range(points):
        if t == 0 or runs[t] != runs[t - 1]:
            at = np.round(-limits[:, 0] / (limits[:, 1] - limits[:, 0]) * (levels - 1)).astype(int)
            at = np.clip(at, 0, levels - 1)
        if t % 40 == 0:
            turn, stay = rng.choice([0.03, 0.1, 0.4], m), rng.choice([0.1, 0.4, 0.8], m)
        heading = np.where(rng.random(m) < turn, -heading, heading)
        heading = np.where(at + heading > levels - 1, -1, np.where(at + heading < 0, 1, heading))
        at = np.clip(at + np.where(rng.random(m) < stay, 0, heading), 0, levels - 1)
        path[t] = at
    return _pressures(path, levels, limits), runs


def validation(points: int, limits: np.ndarray, rng: np.random.Generator):
    """Straight legs between uniformly drawn corners, each leg in one to nine steps; off lattice."""
    low, high = limits.T
    rows: list[np.ndarray] = []
    at = np.clip(0.0, low, high)
    while len(rows) < points:
        corner = rng.uniform(low, high)
        steps = int(rng.integers(1, 10))
        rows += [at + (corner - at) * (k + 1) / steps for k in range(steps)]
        at = corner
    return np.array(rows[:points]), _in_runs(points, 4)


def test(points: int, limits: np.ndarray, rng: np.random.Generator):
    """Smooth oscillations of all chambers about drifting centres; now and then some rest."""
    low, high = limits.T
    m = len(limits)
    runs = _in_runs(points, 4)
    wave = np.empty((points, m))
    for run in np.unique(runs):
        rows = np.flatnonzero(runs == run)
        phase = np.cumsum(np.where(rng.random((len(rows), m)) < 0.15, 0.0, 1.0), axis=0)
        periods = rng.uniform(6.0, 60.0, (4, m))
        weights = rng.uniform(0.3, 1.0, (4, m))
        angles = rng.uniform(0, 2 * np.pi, (4, m))
        parts = weights[:, None] * np.sin(2 * np.pi * phase / periods[:, None] + angles[:, None])
        wave[rows] = parts.sum(axis=0) / np.sqrt((weights**2).sum(axis=0) / 2)
    return 0.5 * (low + high) + 0.5 * (high - low) * np.tanh(0.75 * wave), runs
