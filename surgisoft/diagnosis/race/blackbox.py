"""What any effect could explain at best: a black box with memory on the rows of a diagnosis."""

from dataclasses import dataclass

import numpy as np

from surgisoft.diagnosis.comparing.features import features, memory_of
from surgisoft.diagnosis.problem import Problem
from surgisoft.diagnosis.race.cross_validation import CrossValidation
from surgisoft.diagnosis.race.gates import family_p_values
from surgisoft.diagnosis.race.split import static_features

SIZES = (0.3, 0.05)
"""Sizes of the black box's features, beside those of the surrogate's error, that are tried."""
MOST = 200
"""Most features of the black box beside those of the surrogate's error."""


@dataclass(frozen=True, eq=False)
class BlackBox:
    """A learner without physics on held-out blocks."""

    losses: np.ndarray
    """(B,) held-out sum of squared distances by block, mm^2."""
    rmse_mm: float
    """RMS distance of a key point, mm."""
    p_value: float
    """Chance of such a gain over the surrogate's own error without a cause."""


def black_box(problem: Problem) -> BlackBox:
    """Learn the residual from actuation, its past and the time, out of fold.

    The same folds, rows and static part as the effects have.
    """
    spec, history = problem.model.spec, problem.history
    memory = memory_of(history, spec)
    context = None
    if history.temperature_C is not None:
        context = history.rows(history.temperature_C).double().numpy()[:, None]
    timed = bool((history.dt_s > 0).any())
    inputs = features(memory, spec, context, timed)[problem.index.numpy()]
    spread = inputs.std(axis=0)
    inputs = (inputs - inputs.mean(axis=0)) / np.where(spread > 1e-9, spread, 1.0)
    products = (inputs[:, :, None] * problem.pressure[:, None, :]).reshape(len(inputs), -1)
    wide = principal(np.concatenate([inputs, products], axis=1), MOST)
    static = static_features(problem.pressure, problem.direction)
    null, counts = _held_out(problem, static)
    best = min((null, *(_held_out(problem, static, s * wide)[0] for s in SIZES)), key=np.sum)
    floor = counts * float(np.mean(problem.noise_mm**2))
    gain = np.log((null + floor) / (best + floor))[None]
    chance = float(family_p_values(problem.by_motion(gain))[0]) if gain.any() else 1.0
    return BlackBox(best, float(np.sqrt(best.sum() / counts.sum())), chance)


def principal(wide: np.ndarray, most: int) -> np.ndarray:
    """(S, F) the principal components of features (S, W), at most `most`, mean square 1 in all."""
    wide = wide - wide.mean(axis=0)
    values, vectors = np.linalg.eigh(wide.T @ wide / len(wide))
    kept = vectors[:, values > 1e-6 * values.max()][:, -most:]
    answer = wide @ kept
    return answer / np.sqrt(np.square(answer).sum(axis=1).mean())


def _held_out(problem: Problem, static: np.ndarray, wide: np.ndarray | None = None):
    """((B,) held-out sums of squares, (B,) counts) of the static part and further features."""
    found = CrossValidation.of(
        static if wide is None else np.concatenate([static, wide], axis=1),
        problem.residual,
        np.zeros((*problem.residual.shape, 0)),
        problem.block,
        problem.fold,
        problem.surrogate_mm,
        problem.noise_mm,
    )
    return found.losses(), found.counts
