"""What any effect could explain at best: a black box with memory on the rows of a problem.

A ridge regression on smooth functions of actuation and direction and on products of the
actuation's past and its present, with all of which the residual may be mixed freely in every
output. What it explains on held-out blocks is not noise: some effect of actuation, time or context
causes it. What it leaves may still be explainable by a better learner.
"""

from dataclasses import dataclass

import numpy as np

from surgisoft.diagnosis.cross_validation import (
    ROOM,
    cross_validation_of,
    static_features,
)
from surgisoft.diagnosis.residuals import Problem
from surgisoft.diagnosis.statistics import sign_flip_p_values

SIZES = (0.3, 0.05)
"""Sizes of the black box's features, beside those of the model discrepancy, that are tried."""
FREE_SIZE = 1.0
"""Size of the features of the free black box."""
FREE_ROOMS = (1.0, 3.0)
"""Factors on the size of the error, where that is larger than the validated one, that the free
black box may reach: nothing holds it to the validated size."""
MOST = 200
"""Most features of the black box beside those of the model discrepancy."""


@dataclass(frozen=True, eq=False)
class BlackBox:
    """A learner without physics on held-out blocks."""

    losses: np.ndarray
    """(B,) held-out sum of squared distances by block, mm^2, with the discrepancy held to its
    validated size as it is beside every effect: what effects are compared with."""
    free_losses: np.ndarray
    """(B,) the least held-out sum of squared distances, the learner held to no size."""
    p_value: float
    """Probability of such a gain over the model discrepancy alone without a cause."""


def black_box(problem: Problem) -> BlackBox:
    """Learn the residual from actuation, its past and the time, out of fold.

    The same folds, rows and discrepancy as the effects have.
    """
    inputs = problem.table.features[problem.index.numpy()]
    spread = inputs.std(axis=0)
    inputs = (inputs - inputs.mean(axis=0)) / np.where(spread > 1e-9, spread, 1.0)
    products = (inputs[:, :, None] * problem.pressure[:, None, :]).reshape(len(inputs), -1)
    wide = principal(np.concatenate([inputs, products], axis=1), MOST)
    static = static_features(problem.pressure, problem.direction)
    beyond = problem.rmse_mm / max(float(np.sqrt(np.mean(problem.discrepancy_mm**2))), 1e-12)
    rooms = tuple(ROOM * room * max(1.0, beyond) for room in FREE_ROOMS)
    null = cross_validation_of(problem)

    def learnt(size: float, rooms: tuple[float, ...]) -> list[np.ndarray]:
        """Held-out losses (B,) with features of one size at each ridge."""
        both = np.concatenate([static, size * wide], axis=1)
        return list(cross_validation_of(problem, features=both, rooms=rooms).level_losses())

    tried = [null.losses()]
    for size in SIZES:
        tried += learnt(size, (ROOM,))
    free = tried + learnt(FREE_SIZE, rooms)
    best = min(tried, key=np.sum)
    floor = null.counts * problem.floor_mm**2
    gain = np.log((tried[0] + floor) / (best + floor))[None]
    chance = float(sign_flip_p_values(problem.by_motion(gain))[0]) if gain.any() else 1.0
    return BlackBox(best, min(free, key=np.sum), chance)


def principal(wide: np.ndarray, most: int) -> np.ndarray:
    """(S, F) the principal components of features (S, W), at most `most`, mean square 1 in all."""
    wide = wide - wide.mean(axis=0)
    values, vectors = np.linalg.eigh(wide.T @ wide / len(wide))
    kept = vectors[:, values > 1e-6 * values.max()][:, -most:]
    answer = wide @ kept
    return answer / np.sqrt(np.square(answer).sum(axis=1).mean())
