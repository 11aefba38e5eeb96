"""Residuals whose cause is known: made by formulas that the tool does not use."""

import numpy as np
import torch

from surgisoft.measurement.recordings import Recording
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import HawNN

POINTS = np.array([[0.0, 0.0, 5.0], [0.0, 0.0, 30.0], [0.0, 0.0, 70.0]])
PERIOD_S = 0.1
NOISE_MM = 0.05


def still_model(chambers: int = 2, points: np.ndarray = POINTS) -> ArmModel:
    """A model that predicts `points` (n, 3) whatever the pressure."""
    low, high = torch.zeros(chambers), torch.full((chambers,), 10.0)
    network = HawNN(low, high, len(points), hidden=(4,), directions=False)
    network.scale.zero_()
    network.mean.copy_(torch.tensor(points).flatten())
    spec = ArmSpec(
        chambers, len(points), (0.0,) * chambers, (10.0,) * chambers, band=(0.1,) * chambers
    )
    model = ArmModel(spec, network, rest_mm=torch.tensor(points))
    return model.eval().requires_grad_(False)


def walk(rows: int, chambers: int = 2, seed: int = 0) -> np.ndarray:
    """(rows, m) actuation in 0 to 10: ramps of many speeds between random levels, and rests."""
    rng = np.random.default_rng(seed)
    columns = []
    for _ in range(chambers):
        values = [5.0]
        while len(values) < rows:
            if rng.random() < 0.4:
                values += [values[-1]] * int(rng.integers(20, 160))
            else:
                speed = rng.choice([0.05, 0.15, 0.4])
                goal = rng.uniform(0, 10)
                steps = max(1, int(abs(goal - values[-1]) / speed))
                values += list(np.linspace(values[-1], goal, steps + 1)[1:])
        columns.append(values[:rows])
    return np.array(columns).T


def resting_together(rows: int, chambers: int = 2, seed: int = 0) -> np.ndarray:
    """(rows, m) actuation in 0 to 10: all chambers jump together, then rest for 2 to 20 s."""
    rng = np.random.default_rng(seed)
    levels, now = [], 0
    while now < rows:
        length = int(rng.integers(20, 200))
        levels.append(np.repeat(rng.uniform(0, 10, (1, chambers)), length, axis=0))
        now += length
    return np.concatenate(levels)[:rows]


def recording(
    effect: np.ndarray, pressure: np.ndarray, points: np.ndarray = POINTS, seed: int = 1, **more
) -> Recording:
    """The arm at `points`, its tip moved along x by an effect (T,) in mm, with white noise."""
    rng = np.random.default_rng(seed)
    measured = points + rng.normal(0, NOISE_MM, (len(effect), *points.shape))
    measured[:, -1, 0] += effect
    given = {"noise_mm": NOISE_MM} | more
    return Recording(
        name="made",
        t_s=PERIOD_S * np.arange(len(effect)),
        measured=pressure,
        key_points_mm=measured,
        **given,
    )


def backlash(signal: np.ndarray, radius: float) -> np.ndarray:
    """(T,) play operator, step by step."""
    answer, y = np.empty(len(signal)), signal[0]
    for i, u in enumerate(signal):
        y = min(max(y, u - radius), u + radius)
        answer[i] = y
    return answer


def relaxation(signal: np.ndarray, time_s: float) -> np.ndarray:
    """(T,) low pass of a signal, step by step (implicit Euler)."""
    answer, y = np.empty(len(signal)), signal[0]
    for i, u in enumerate(signal):
        y = (y + PERIOD_S / time_s * u) / (1 + PERIOD_S / time_s)
        answer[i] = y
    return answer
