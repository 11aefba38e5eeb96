"""How large the surrogate's own error would have to be, as a factor on its validated size."""

from dataclasses import dataclass

import numpy as np

from surgisoft.diagnosis.problem import Problem
from surgisoft.diagnosis.race.discrepancy import SIZES, Prior
from surgisoft.diagnosis.race.ranking import Race

ROWS = 500
"""Most rows of the Gaussian process."""


@dataclass(frozen=True)
class StaticError:
    """The most likely factor on the validated error, see `discrepancy`."""

    before: float
    """Without any effect."""
    after: float
    """With the named effects."""


def static_error(problem: Problem, race: Race, picked: tuple[int, ...]) -> StaticError:
    """The factor before and after the effects whose columns are picked."""
    whole = np.flatnonzero(np.isfinite(problem.residual).all((1, 2)))
    if len(whole) < 50:
        return StaticError(1.0, 1.0)
    rows = whole[:: max(1, round(len(whole) / ROWS))]
    losses = race.losses(picked)
    left = float(losses.sum() / race.validation.counts.sum())
    noise = np.sqrt(np.maximum(problem.noise_mm**2, left))
    prior = Prior.of(problem.pressure[rows], problem.direction[rows], problem.surrogate_mm, noise)
    residual = problem.residual[rows]
    columns = race.columns[rows][..., list(picked)]
    amplitude = race.validation.amplitudes(picked)
    return StaticError(_size(prior, residual), _size(prior, residual - columns @ amplitude))


def _size(prior: Prior, residual: np.ndarray) -> float:
    field = prior.turned(residual)
    return float(max(SIZES, key=lambda size: prior.log_evidence(field, size)))
