"""Fit the parameters of effects through the whole model, memories over every row.

Strengths and shapes together by Levenberg-Marquardt (Marquardt 1963) on the fitted rows, under the
surrogate's own error as a nuisance. Slopes are forward differences whose steps are chosen by what
they change. Parameters of effects that the model has already are fitted like those of new ones.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from surgisoft.diagnosis.refinement.forward import Forward
from surgisoft.diagnosis.refinement.nuisance import Nuisance
from surgisoft.diagnosis.residuals import Problem
from surgisoft.surrogate.model import ArmModel

ITERATIONS = 25
"""Most steps of a fit."""
ENOUGH = 3e-4
"""Relative fall of the misfit below which a fit has ended."""
SHAPE_SPREAD = 1.5
"""Standard deviation of a shape about its start, in units of max(1, its value); shapes are mostly
logarithms. It keeps those that the data says nothing about where they are."""
INDEPENDENT = 50.0
"""Rows that count as one independent sample against that spread."""
CHANGE_MM = (0.003, 0.02, 0.2)
"""Least, wanted and largest RMS change that a forward difference makes, mm."""
FIRST_STEP, LONGEST_STEP = 1e-2, 0.3
"""First and longest forward difference, in units of max(1, the value)."""
STRIDE = 1.0
"""Longest change of a shape in one iteration, in units of max(1, its value)."""
FIRST_DAMPING, LEAST_DAMPING = 1e-3, 1e-6
"""Damping of the first step and the least one, as shares of the slopes' own power."""
HARDER, TRIES = 6.0, 6
"""Factor on the damping after a step that does not help, and how often it is raised."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Parameters at their best, and the linear problem around them."""

    values: np.ndarray
    """(P,) the free values."""
    jacobian: np.ndarray
    """(S, n, 3, P) slope of the key points with each of them, mm."""
    residual: np.ndarray
    """(S, n, 3) measured less predicted, mm; NaN where missing."""
    nuisance: Nuisance
    """The static error that was taken out."""
    hold: np.ndarray
    """(P, P) what holds the values at their start, in the units of the misfit, mm^2."""
    misfit: float
    """Sum of squares that is left, the static error taken out, and what the hold costs, mm^2."""


def free_parameters(
    model: ArmModel, keys: Iterable[str], held: str | None = None
) -> dict[str, nn.Parameter]:
    """Strengths, then shapes, of each named effect, by their names in the model's effects.

    held: effect whose strengths stay as they are.
    """
    answer = {}
    for key in keys:
        effect = model.effects[key]
        strengths = {} if key == held else effect.strengths()
        for name, parameter in (strengths | effect.shapes()).items():
            answer[f"{key}.{name}"] = parameter
    return answer


def vector(parameters: dict[str, Tensor]) -> np.ndarray:
    """(P,) all values one after another."""
    return torch.cat([p.detach().flatten() for p in parameters.values()]).double().numpy()


@torch.no_grad()
def set_vector(parameters: dict[str, Tensor], values: np.ndarray) -> None:
    """Write (P,) values back into their parameters."""
    flat, begin = torch.from_numpy(np.asarray(values, np.float32)), 0
    for parameter in parameters.values():
        parameter.copy_(flat[begin : begin + parameter.numel()].view_as(parameter))
        begin += parameter.numel()


def _are_shapes(model: ArmModel, keys: Iterable[str], held: str | None = None) -> np.ndarray:
    """(P,) bool: which free values are shapes."""
    answer = []
    for key in keys:
        effect = model.effects[key]
        strengths = {} if key == held else effect.strengths()
        for kind, values in ((False, strengths), (True, effect.shapes())):
            answer += [kind] * sum(p.numel() for p in values.values())
    return np.array(answer, bool)


class Predictor:
    """Predictions of a model for values of its free parameters, and their slopes."""

    def __init__(self, forward: Forward, parameters: dict[str, Tensor]):
        self.forward, self.parameters = forward, parameters
        self.steps = FIRST_STEP * np.maximum(np.abs(vector(parameters)), 1.0)

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """(S, n, 3) prediction in mm with the values (P,), which stay in the model."""
        set_vector(self.parameters, values)
        with torch.no_grad():
            return self.forward().double().numpy()

    def slopes(self, values: np.ndarray, predicted: np.ndarray) -> np.ndarray:
        """(S, n, 3, P) slopes at the values (P,), whose prediction is known."""
        answer = np.stack([self._slope(i, values, predicted) for i in range(len(values))], axis=-1)
        set_vector(self.parameters, values)
        return answer

    def _slope(self, i: int, values: np.ndarray, predicted: np.ndarray) -> np.ndarray:
        """(S, n, 3) slope by value i; its step is kept for the next time."""
        least, wanted, most = CHANGE_MM
        longest = LONGEST_STEP * max(1.0, abs(values[i]))
        for _ in range(3):
            moved = values.copy()
            moved[i] += self.steps[i]
            # Parameters are float32: the step that is taken is what rounding leaves of it.
            step = float(np.float32(moved[i])) - float(np.float32(values[i]))
            change = self(moved) - predicted
            size = float(np.sqrt(np.square(change).sum(-1).mean()))
            if step and least <= size <= most:
                break
            factor = float(np.clip(wanted / max(size, 1e-9), 1e-2, 30.0))
            if factor > 1 and self.steps[i] >= longest:
                break
            self.steps[i] = min(self.steps[i] * factor, longest)
        return change / step if step and np.isfinite(size) else np.zeros_like(predicted)


def block_slopes(fit: Fit, block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(B, P, P) and (B, P): J' W J and J' W r of the rows of each block (S,), mm^2."""
    rest = fit.nuisance.rest(fit.jacobian)
    target = np.where(fit.nuisance.seen[..., None], fit.residual, 0.0)
    count = fit.jacobian.shape[-1]
    numbers = np.unique(block)
    grams, slopes = np.empty((len(numbers), count, count)), np.empty((len(numbers), count))
    for i, number in enumerate(numbers):
        rows = block == number
        flat = rest[rows].reshape(-1, count)
        gram = flat.T @ fit.jacobian[rows].reshape(-1, count)
        grams[i] = (gram + gram.T) / 2
        slopes[i] = flat.T @ target[rows].reshape(-1)
    return grams, slopes


def refine(
    model: ArmModel,
    problem: Problem,
    keys: list[str],
    iterations: int = ITERATIONS,
    held: str | None = None,
) -> Fit:
    """Fit the named effects of a model, in place, to a problem's rows; others stay as they are.

    held: effect among them whose strengths stay as they are too.
    """
    parameters = free_parameters(model, keys, held)
    predict = Predictor(Forward(model, problem, keys), parameters)
    shape = _are_shapes(model, keys, held)
    values = start = vector(parameters)
    predicted = predict(values)
    residual = problem.measured - predicted
    nuisance = Nuisance.of(problem, residual)
    cost = nuisance.misfit(residual)
    # One standard deviation of a shape costs as much as the misfit of one independent sample.
    spread = SHAPE_SPREAD * np.maximum(1.0, np.abs(start))
    hold = np.diag(np.where(shape, INDEPENDENT * cost / len(residual) / spread**2, 0.0))
    damping = FIRST_DAMPING
    for _ in range(iterations):
        fit = Fit(values, predict.slopes(values, predicted), residual, nuisance, hold, cost)
        grams, slopes = block_slopes(fit, np.zeros(len(residual)))
        gram, slope = grams[0] + hold, slopes[0] - hold @ (values - start)
        scale = np.maximum(np.diag(gram), 1e-9 * max(np.diag(gram).max(), 1e-30))
        for _ in range(TRIES):
            step = np.linalg.solve(gram + damping * np.diag(scale), slope)
            reach = STRIDE * np.maximum(1.0, np.abs(values))
            trial = values + step / max(1.0, np.abs(step / reach)[shape].max(initial=0.0))
            predicted, away = predict(trial), trial - start
            rest = problem.measured - predicted
            new = nuisance.misfit(rest) + float(away @ hold @ away)
            if new < cost:
                break
            damping *= HARDER
        else:
            set_vector(parameters, values)
            return fit
        fall, cost, values, residual = 1.0 - new / cost, new, trial, rest
        damping = max(damping / HARDER, LEAST_DAMPING)
        if fall < ENOUGH:
            break
    return Fit(values, predict.slopes(values, predicted), residual, nuisance, hold, cost)
