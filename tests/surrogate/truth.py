"""A small arm of known formulas, for tests of fitting: relays decide its hysteresis."""

import numpy as np
import torch

from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.history import History, pack

LOW, HIGH = -15.0, 54.0
SPEC = ArmSpec(3, 3, (LOW,) * 3, (HIGH,) * 3, band=(0.3,) * 3)


def walk(rows: int, rng: np.random.Generator) -> np.ndarray:
    """(T, 3) random walk over levels with reversals of all sizes, kPa."""
    levels = np.linspace(LOW, HIGH, 16)
    place, heading = rng.integers(0, 16, 3), rng.choice([-1, 1], 3)
    path = []
    for _ in range(rows):
        heading = np.where(rng.random(3) < 0.15, -heading, heading)
        heading = np.where((place + heading < 0) | (place + heading > 15), -heading, heading)
        place = place + heading
        path.append(levels[place])
    return np.array(path)


def traverse(levels: int) -> np.ndarray:
    """(levels^3, 3) the plain back-and-forth traverse: chamber 1 slow and only rising, kPa."""
    grid = np.linspace(LOW, HIGH, levels)
    path, row_up, plane_up = [], True, True
    for i in grid:
        for j in grid if plane_up else grid[::-1]:
            path += [[i, j, k] for k in (grid if row_up else grid[::-1])]
            row_up = not row_up
        plane_up = not plane_up
    return np.array(path)


def relays(pressure: np.ndarray, seed: int = 5) -> np.ndarray:
    """(T, 3) mean of 300 Preisach relays a chamber (values -1..1) of an arm that rested at 0 kPa.

    Relays switch up at a and down at b < a (Preisach 1935); no play operator is involved.
    """
    rng = np.random.default_rng(seed)
    width, centre = rng.exponential(8, 300), rng.uniform(LOW, HIGH, 300)
    up, down = centre + width, centre - width
    state = np.tile(np.where(centre < 0, 1, -1), (3, 1))
    answer = []
    for row in pressure:
        state = np.where(row[:, None] >= up, 1, np.where(row[:, None] <= down, -1, state))
        answer.append(state.mean(1))
    return np.array(answer)


def shape(pressure: np.ndarray, hysteresis: float) -> np.ndarray:
    """(T, 3, 3) key points of a planar-arc arm of 70 mm, mm; hysteresis in kPa."""
    effective = (pressure + hysteresis * relays(pressure)) / HIGH
    angle = 2 * np.pi * np.arange(3) / 3
    bend = np.stack([effective @ np.cos(angle), effective @ np.sin(angle)], 1)
    turn = np.linalg.norm(bend, axis=1) + 1e-9
    length = 70 * (1 + 0.05 * effective.sum(1))
    points = []
    for share in (0.0, 0.5, 1.0):
        radial = length * share * 0.5 * turn * share * np.sinc(turn * share / 2 / np.pi) ** 2
        axial = length * share * np.sinc(turn * share / np.pi)
        points.append(np.stack([*(radial * bend.T / turn), axial], 1))
    return np.stack(points, 1)


def history(paths, hysteresis: float = 5.0, noise: float = 0.05, seed: int = 0) -> History:
    """Runs along the paths, each (T, 3) in kPa, with white noise in mm on every coordinate."""
    rng = np.random.default_rng(seed)
    times = [torch.arange(len(path)) * 4.0 for path in paths]
    points = [shape(path, hysteresis) for path in paths]
    points = [value + rng.normal(0, noise, value.shape) for value in points]
    return pack(times, [torch.tensor(p) for p in paths], [torch.tensor(p) for p in points])
