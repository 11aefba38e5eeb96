"""Nonlinear least squares for the parameters of effects, through the whole chain of a model.

`fit_all` fits the amplitudes and nonlinear parameters of effects together, by Levenberg-Marquardt
(Marquardt 1963) on the fitted rows, with the model discrepancy as a nuisance. Sensitivities are
forward differences whose steps are chosen by what they change in the prediction.

`fit_amplitudes` fits the amplitudes alone of an effect that has very many, such as the weights of
play operators on every wall fibre. They act almost linearly, so a few Gauss-Newton steps with a
ridge (Hoerl & Kennard 1970) about the present values do it. One direction is nearly free: that of
the present values themselves, more or less of everything. The ridge is the one that does best on
held-out parts of the rows. The nonlinear parameters stay as they are.

Parameters of effects that the model has already are fitted like those of new ones.

Why the iteration is not `scipy.optimize.least_squares`: with the same sensitivities, prior and
stopping rule (x_scale "jac", ftol 3e-4), its methods `trf` and `lm` took 6 % more time over fits of
ten effects of known truth, ended at a slightly larger misfit of a contact, and left a poorly
determined time constant of a drift 4 % elsewhere. It also needs W as a square root, that is the
weights of the discrepancy as further rows, and cannot limit the step of the nonlinear parameters
alone. `torch.func.jvp` through the scans would replace the compiled loops by parallel scans of
log2(T) passes for each parameter; forward differences run the compiled loops.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from surgisoft.diagnosis.estimation.nuisance import Nuisance, held_out_parts
from surgisoft.diagnosis.residuals import Problem
from surgisoft.surrogate.chain import RepeatedScan
from surgisoft.surrogate.effects import FRONT
from surgisoft.surrogate.model import ArmModel


@dataclass(frozen=True)
class Options:
    """How `fit_all` iterates; units of max(1, |value|) unless stated."""

    iterations: int = 25
    """Most steps of a fit."""
    least_fall: float = 3e-4
    """Relative fall of the misfit below which a fit has ended."""
    prior_spread: float = 1.5
    """Standard deviation of a nonlinear parameter about its start; most are logarithms. The prior
    keeps those that the data says nothing about where they are."""
    rows_a_sample: float = 50.0
    """Rows that count as one independent sample against that spread."""
    least_change_mm: float = 0.003
    """Least RMS change of the key points by a forward difference, mm."""
    wanted_change_mm: float = 0.02
    """RMS change that its step aims at, mm."""
    largest_change_mm: float = 0.2
    """Largest RMS change by it, mm."""
    first_difference: float = 1e-2
    """First forward difference."""
    longest_difference: float = 0.3
    """Longest forward difference."""
    longest_step: float = 1.0
    """Longest change of a nonlinear parameter in one iteration."""
    first_damping: float = 1e-3
    """Damping of the first step, as a share of the curvature's diagonal."""
    least_damping: float = 1e-6
    """Least damping."""
    damping_factor: float = 6.0
    """Factor on the damping after a step that does not help; one that helps divides by it."""
    tries: int = 6
    """How often a step is tried with more damping."""


OPTIONS = Options()


@dataclass(frozen=True)
class AmplitudeOptions:
    """How `fit_amplitudes` iterates."""

    steps: int = 3
    """Most Gauss-Newton steps."""
    shares: tuple[float, ...] = (1.0, 0.5, 0.25, 0.1)
    """Shares of a step that are tried."""
    ridges: tuple[float, ...] = tuple(10.0 ** np.arange(-5.0, 3.0, 0.5))
    """Ridges that are tried, as shares of the mean power of a sensitivity."""
    along_present: float = 1e-5
    """Share of the ridge that the direction of the present values feels."""
    least_fall: float = 1e-3
    """Relative fall of the misfit below which a fit has ended."""


AMPLITUDES = AmplitudeOptions()


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
    prior_variance: np.ndarray
    """(P,) variance of each value about its start, by which the hold was chosen; 0: not held."""

    def likelihood(self, least: float) -> float:
        """Likelihood of the fit beside one with the misfit `least`, mm^2: exp(-difference / 2 s^2)
        with s^2 the misfit of one independent sample."""
        sample = OPTIONS.rows_a_sample * least / len(self.residual)
        return float(np.exp(min(0.0, 0.5 * (least - self.misfit) / max(sample, 1e-30))))


def free_parameters(
    model: ArmModel, keys: Iterable[str], held: str | None = None
) -> dict[str, nn.Parameter]:
    """Amplitudes, then nonlinear parameters, of each named effect, by their names in the model.

    held: effect whose amplitudes stay as they are.
    """
    free = {}
    for key in keys:
        effect = model.effects[key]
        amplitudes = {} if key == held else effect.amplitudes()
        for name, parameter in (amplitudes | effect.nonlinear_parameters()).items():
            free[f"{key}.{name}"] = parameter
    return free


def vector(parameters: Mapping[str, Tensor]) -> np.ndarray:
    """(P,) all values one after another."""
    return torch.cat([p.detach().flatten() for p in parameters.values()]).double().numpy()


@torch.no_grad()
def set_vector(parameters: Mapping[str, Tensor], values: np.ndarray) -> None:
    """Write (P,) values back into their parameters."""
    flat, begin = torch.from_numpy(np.asarray(values, np.float32)), 0
    for parameter in parameters.values():
        parameter.copy_(flat[begin : begin + parameter.numel()].view_as(parameter))
        begin += parameter.numel()


def _are_nonlinear(model: ArmModel, keys: Iterable[str], held: str | None = None) -> np.ndarray:
    """(P,) bool: which free values belong to nonlinear parameters."""
    kinds = []
    for key in keys:
        effect = model.effects[key]
        amplitudes = {} if key == held else effect.amplitudes()
        for kind, values in ((False, amplitudes), (True, effect.nonlinear_parameters())):
            kinds += [kind] * sum(p.numel() for p in values.values())
    return np.array(kinds, bool)


def repeated_scan(model: ArmModel, problem: Problem, keys: Iterable[str]) -> RepeatedScan:
    """A model's prediction (S, n, 3) in mm on a problem's rows, while the named effects change.

    keys: names of effects; of none, the network may change.
    """
    first = model.first_pressure(problem.history)
    return RepeatedScan(model.chain, problem.history, first, set(keys), problem.rows)


class Prediction:
    """Predictions of a model for values of its free parameters, and their slopes."""

    def __init__(self, forward: RepeatedScan, parameters: Mapping[str, Tensor]):
        self.forward, self.parameters = forward, parameters
        self.steps = OPTIONS.first_difference * np.maximum(np.abs(vector(parameters)), 1.0)

    def __call__(self, values: np.ndarray) -> np.ndarray:
        """(S, n, 3) prediction in mm with the values (P,), which stay in the model."""
        set_vector(self.parameters, values)
        with torch.no_grad():
            return self.forward().double().numpy()

    def sensitivities(self, values: np.ndarray, predicted: np.ndarray) -> np.ndarray:
        """(S, n, 3, P) slopes at the values (P,), whose prediction is known."""
        answer = np.stack(
            [self._sensitivity(i, values, predicted) for i in range(len(values))], axis=-1
        )
        set_vector(self.parameters, values)
        return answer

    def _sensitivity(self, i: int, values: np.ndarray, predicted: np.ndarray) -> np.ndarray:
        """(S, n, 3) slope by value i; its step is kept for the next time."""
        longest = OPTIONS.longest_difference * max(1.0, abs(values[i]))
        for _ in range(3):
            moved = values.copy()
            moved[i] += self.steps[i]
            # Parameters are float32: the step that is taken is what rounding leaves of it.
            step = float(np.float32(moved[i])) - float(np.float32(values[i]))
            change = self(moved) - predicted
            size = float(np.sqrt(np.square(change).sum(-1).mean()))
            if step and OPTIONS.least_change_mm <= size <= OPTIONS.largest_change_mm:
                break
            wanted = OPTIONS.wanted_change_mm / max(size, 1e-9) if np.isfinite(size) else 0.0
            factor = float(np.clip(wanted, 1e-2, 30.0))
            if factor > 1 and self.steps[i] >= longest:
                break
            self.steps[i] = min(self.steps[i] * factor, longest)
        return change / step if step and np.isfinite(size) else np.zeros_like(predicted)


def block_slopes(fit: Fit, block: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(B, P, P) and (B, P): J' W J and J' W r of the rows of each block (S,), mm^2."""
    rest = fit.nuisance.weighted(fit.jacobian)
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


def fit_all(
    model: ArmModel,
    problem: Problem,
    keys: list[str],
    iterations: int = OPTIONS.iterations,
    held: str | None = None,
    slopes_at_end: bool = True,
) -> Fit:
    """Fit the named effects of a model, in place, to a problem's rows; others stay as they are.

    held: effect among them whose amplitudes stay as they are too. slopes_at_end: whether the
    fit's `jacobian` is needed; where it is not, it may be empty, (S, n, 3, 0).
    """
    parameters = free_parameters(model, keys, held)
    predict = Prediction(repeated_scan(model, problem, keys), parameters)
    nonlinear = _are_nonlinear(model, keys, held)
    values = start = vector(parameters)
    predicted = predict(values)
    residual = problem.measured - predicted
    nuisance = Nuisance.of(problem, residual)
    cost = nuisance.misfit(residual)
    # One standard deviation of a nonlinear parameter costs as much as the misfit of one sample.
    spread = OPTIONS.prior_spread * np.maximum(1.0, np.abs(start))
    sample = OPTIONS.rows_a_sample * cost / len(residual)
    hold = np.diag(np.where(nonlinear, sample / spread**2, 0.0))
    prior = np.where(nonlinear, spread**2, 0.0)
    damping = OPTIONS.first_damping
    for _ in range(iterations):
        slopes_now = predict.sensitivities(values, predicted)
        fit = Fit(values, slopes_now, residual, nuisance, hold, cost, prior)
        grams, slopes = block_slopes(fit, np.zeros(len(residual)))
        gram, slope = grams[0] + hold, slopes[0] - hold @ (values - start)
        scale = np.maximum(np.diag(gram), 1e-9 * max(np.diag(gram).max(), 1e-30))
        for _ in range(OPTIONS.tries):
            step = np.linalg.solve(gram + damping * np.diag(scale), slope)
            reach = OPTIONS.longest_step * np.maximum(1.0, np.abs(values))
            trial = values + step / max(1.0, np.abs(step / reach)[nonlinear].max(initial=0.0))
            predicted, away = predict(trial), trial - start
            rest = problem.measured - predicted
            new = nuisance.misfit(rest) + float(away @ hold @ away)
            if new < cost:
                break
            damping *= OPTIONS.damping_factor
        else:
            set_vector(parameters, values)
            return fit
        fall, cost, values, residual = 1.0 - new / cost, new, trial, rest
        damping = max(damping / OPTIONS.damping_factor, OPTIONS.least_damping)
        if fall < OPTIONS.least_fall:
            break
    slopes_now = np.empty((*residual.shape, 0))
    if slopes_at_end:
        slopes_now = predict.sensitivities(values, predicted)
    return Fit(values, slopes_now, residual, nuisance, hold, cost, prior)


@torch.no_grad()
def amplitude_sensitivities(model: ArmModel, forward: RepeatedScan, key: str) -> np.ndarray:
    """(S, n, 3, P) sensitivity of the key points to each amplitude of an effect, mm.

    forward: scan whose one changing effect is the effect `key`. The memory of effects behind it is
    taken to follow.
    """
    effect, signal, rows = model.effects[key], forward.start, forward.rows
    memory, slope = forward.first_memory(), None
    if effect.stage in FRONT:
        taps = model.chain.scan(forward.history, forward.first_pressure, model.chain.inner)
        slope = model.chain.slope(forward.history, forward.first_pressure, taps, rows)
    thin = forward.thin and effect.stage not in FRONT
    at = signal.value if thin else rows(signal.value)
    changes = model.chain.sensitivities(effect, at, memory, slope)
    return changes.movedim(0, -1).numpy()


def fit_amplitudes(model: ArmModel, problem: Problem, key: str) -> Fit:
    """Fit the amplitudes of one effect of a model, in place, to a problem's rows."""
    parameters = {f"{key}.{name}": p for name, p in model.effects[key].amplitudes().items()}
    forward = repeated_scan(model, problem, [key])
    predict = Prediction(forward, parameters)
    values = start = vector(parameters)
    residual = problem.measured - predict(values)
    nuisance = Nuisance.of(problem, residual)
    part = held_out_parts(problem)
    cost, unheld = nuisance.misfit(residual), np.zeros(len(values))
    hold = np.zeros((len(values), len(values)))
    for step_number in range(AMPLITUDES.steps):
        jacobian = amplitude_sensitivities(model, forward, key)
        fit = Fit(values, jacobian, residual, nuisance, hold, cost, unheld)
        grams, slopes = block_slopes(fit, part)
        if not step_number:
            penalty = _penalty(start) * np.trace(grams.sum(0)) / len(start)
            hold = penalty * _best_ridge(grams, slopes, penalty)
        slope = slopes.sum(0) - hold @ (values - start)
        step = np.linalg.solve(grams.sum(0) + hold, slope)
        for share in AMPLITUDES.shares:
            trial = values + share * step
            rest = problem.measured - predict(trial)
            new = nuisance.misfit(rest) + float((trial - start) @ hold @ (trial - start))
            if new < cost:
                break
        else:
            set_vector(parameters, values)
            break
        fall, cost, values, residual = 1.0 - new / cost, new, trial, rest
        if fall < AMPLITUDES.least_fall:
            break
    jacobian = amplitude_sensitivities(model, forward, key)
    return Fit(values, jacobian, residual, nuisance, hold, cost, unheld)


def _penalty(start: np.ndarray) -> np.ndarray:
    """(P, P) unit penalty of a change, little of it along the present values."""
    size = np.linalg.norm(start)
    if size == 0:
        return np.eye(len(start))
    along = start / size
    return np.eye(len(start)) - (1 - AMPLITUDES.along_present) * np.outer(along, along)


def _best_ridge(grams: np.ndarray, slopes: np.ndarray, penalty: np.ndarray) -> float:
    """The ridge whose fits without a part do best on it, all parts together.

    grams (F, P, P), slopes (F, P): J' W J and J' W r of each part.
    """
    losses = np.zeros(len(AMPLITUDES.ridges))
    for gram, slope in zip(grams, slopes, strict=True):
        fitted, pull = grams.sum(0) - gram, slopes.sum(0) - slope
        for i, ridge in enumerate(AMPLITUDES.ridges):
            change = np.linalg.solve(fitted + ridge * penalty, pull)
            losses[i] += change @ gram @ change - 2 * change @ slope
    return float(AMPLITUDES.ridges[losses.argmin()])
