"""What any effect could explain at best: a black box with memory on the rows of a problem.

A ridge regression on smooth functions of actuation and direction and on products of the
actuation's past and its present, with all of which the residual may be mixed freely in every
output. What it explains on held-out blocks is not noise: some effect of actuation, time or context
causes it. What it leaves may still be explainable by a better learner.
"""

from dataclasses import dataclass

import numpy as np

from surgisoft.diagnosis.cross_validation import (
    PERSISTENCE,
    ROOM,
    cross_validation_of,
    static_features,
)
from surgisoft.diagnosis.residuals import Problem
from surgisoft.diagnosis.statistics import sign_flip_p_values

FEATURE_SCALES = (0.3, 0.05)
"""Scales of the black box's features relative to those of the model discrepancy (dimensionless),
that are tried: a small scale is a strong ridge."""
FREE_SCALE = 1.0
"""Scale of the features of the free black box."""
FREE_ERROR_FACTORS = (1.0, 3.0)
"""Factors (dimensionless) on the size of the whole error that the free black box may reach, where
the error is larger than the validated one: nothing holds it to the validated size."""
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
    static_losses: np.ndarray
    """(B,) the least that a function of actuation and direction leaves, held to no size: what the
    free black box reaches without memory."""
    p_value: float
    """Probability of such a gain over the model discrepancy alone without a cause."""
    features: np.ndarray
    """(S, F) what the free black box mixes: functions of actuation, its past and the time."""


def black_box(problem: Problem) -> BlackBox:
    """Learn the residual from actuation, its past and the time, out of fold.

    The same folds, rows and discrepancy as the effects have.
    """
    inputs = problem.table.features_at(problem.index.numpy())
    spread = inputs.std(axis=0)
    inputs = (inputs - inputs.mean(axis=0)) / np.where(spread > 1e-9, spread, 1.0)
    products = (inputs[:, :, None] * problem.pressure[:, None, :]).reshape(len(inputs), -1)
    wide = principal(np.concatenate([inputs, products], axis=1), MOST)
    static = static_features(problem.pressure, problem.direction)
    beyond = problem.rmse_mm / max(float(np.sqrt(np.mean(problem.discrepancy_mm**2))), 1e-12)
    rooms = tuple(ROOM * factor * max(1.0, beyond) for factor in FREE_ERROR_FACTORS)
    alone = cross_validation_of(problem, features=static, rooms=(ROOM, *rooms))

    def learnt(scale: float, rooms: tuple[float, ...]) -> list[np.ndarray]:
        """Held-out losses (B,) with features of one scale beside the static ones at each ridge."""
        both = np.concatenate([static, scale * wide], axis=1)
        return list(cross_validation_of(problem, features=both, rooms=rooms).level_losses())

    validated, beyond_it = np.split(alone.level_losses(), [len(PERSISTENCE)])
    tried = [min(validated, key=np.sum)]
    for scale in FEATURE_SCALES:
        tried += learnt(scale, (ROOM,))
    memoryless = [tried[0], *beyond_it]
    free = [*tried, *memoryless, *learnt(FREE_SCALE, rooms)]
    best = min(tried, key=np.sum)
    floor = alone.counts * problem.floor_mm**2
    gain = np.log((tried[0] + floor) / (best + floor))[None]
    chance = float(sign_flip_p_values(problem.by_motion(gain))[0]) if gain.any() else 1.0
    least = min(free, key=np.sum), min(memoryless, key=np.sum)
    features = np.concatenate([static, FREE_SCALE * wide], axis=1)
    return BlackBox(best, *least, chance, features)


def principal(wide: np.ndarray, most: int) -> np.ndarray:
    """(S, F) the principal components of features (S, W), at most `most`, mean square 1 in all."""
    wide = wide - wide.mean(axis=0)
    values, vectors = np.linalg.eigh(wide.T @ wide / len(wide))
    kept = vectors[:, values > 1e-6 * values.max()][:, -most:]
    answer = wide @ kept
    return answer / np.sqrt(np.square(answer).sum(axis=1).mean())
