"""Fit the strengths of an effect that has very many, such as a play's weights on every wall line.

The strengths act almost linearly, so a few Gauss-Newton steps with a ridge (Hoerl & Kennard 1970)
about the present values do it. One direction is nearly free: that of the present values
themselves, "the same with more or less of everything". The ridge is the one that does best on
held-out blocks. The shapes stay as they are.
"""

import numpy as np
import torch

from surgisoft.diagnosis.refinement.forward import Forward
from surgisoft.diagnosis.refinement.nuisance import Nuisance, judging_parts
from surgisoft.diagnosis.refinement.refine import Fit, Predictor, block_slopes, set_vector, vector
from surgisoft.diagnosis.residuals import Problem
from surgisoft.surrogate.model import ArmModel

STEPS = 3
"""Most Gauss-Newton steps."""
SHARES = (1.0, 0.5, 0.25, 0.1)
"""Shares of a step that are tried."""
RIDGES = 10.0 ** np.arange(-5.0, 3.0, 0.5)
"""Ridges that are tried, as shares of the mean power of a column."""
DIFFERENCE = 3e-3
"""Central difference by which the network's slope is taken, as a share of a chamber's range."""
FREE = 1e-5
"""Share of the ridge that the direction of the present values feels."""
ENOUGH = 1e-3
"""Relative fall of the misfit below which a fit has ended."""


@torch.no_grad()
def strength_slopes(model: ArmModel, problem: Problem, key: str) -> np.ndarray:
    """(S, n, 3, P) slopes of the key points with each strength of an effect, mm.

    The memory of effects behind it is taken to follow.
    """
    effect = model.effects[key]
    forward = Forward(model, problem, [key])
    rest = model.first_state(forward.first).memory[key]
    signal = forward.start
    context = forward.context_at(signal)
    memory = problem.rows(effect.scan(rest, signal.value, context))
    changes = effect.columns(problem.rows(signal.value), memory)
    if effect.stage in ("line", "material"):
        trace = model.trace(problem.history)
        at = problem.rows(model.effective(trace.pressure, trace.memory))
        direction = problem.rows(trace.direction)
        step = torch.diag(DIFFERENCE * torch.tensor(model.spec.span))
        slope = torch.stack(
            [
                (model.network(at + one, direction) - model.network(at - one, direction))
                / (2 * one.sum())
                for one in step
            ],
            dim=-1,
        )
        changes = torch.einsum("snjm,ksm->ksnj", slope, changes)
    return changes.movedim(0, -1).numpy()


def refine_large(model: ArmModel, problem: Problem, key: str) -> Fit:
    """Fit the strengths of one effect of a model in place; see the module's head."""
    parameters = {f"{key}.{name}": p for name, p in model.effects[key].strengths().items()}
    predict = Predictor(Forward(model, problem, [key]), parameters)
    values = start = vector(parameters)
    residual = problem.measured - predict(values)
    nuisance = Nuisance.of(problem, residual)
    part = judging_parts(problem)
    hold, cost = None, nuisance.misfit(residual)
    for _ in range(STEPS):
        jacobian = strength_slopes(model, problem, key)
        fit = Fit(values, jacobian, residual, nuisance, hold, cost)
        grams, slopes = block_slopes(fit, part)
        if hold is None:
            penalty = _penalty(start) * np.trace(grams.sum(0)) / len(start)
            hold = penalty * _best_ridge(grams, slopes, penalty)
        slope = slopes.sum(0) - hold @ (values - start)
        step = np.linalg.solve(grams.sum(0) + hold, slope)
        for share in SHARES:
            trial = values + share * step
            rest = problem.measured - predict(trial)
            new = nuisance.misfit(rest) + float((trial - start) @ hold @ (trial - start))
            if new < cost:
                break
        else:
            set_vector(parameters, values)
            break
        fall, cost, values, residual = 1.0 - new / cost, new, trial, rest
        if fall < ENOUGH:
            break
    jacobian = strength_slopes(model, problem, key)
    return Fit(values, jacobian, residual, nuisance, hold, cost)


def _penalty(start: np.ndarray) -> np.ndarray:
    """(P, P) unit penalty of a change, little of it along the present values."""
    size = np.linalg.norm(start)
    if size == 0:
        return np.eye(len(start))
    along = start / size
    return np.eye(len(start)) - (1 - FREE) * np.outer(along, along)


def _best_ridge(grams: np.ndarray, slopes: np.ndarray, penalty: np.ndarray) -> float:
    """The ridge of RIDGES whose fits without a part do best on it, all parts together.

    grams (F, P, P), slopes (F, P): J' W J and J' W r of each part.
    """
    losses = np.zeros(len(RIDGES))
    for gram, slope in zip(grams, slopes, strict=True):
        fitted, pull = grams.sum(0) - gram, slopes.sum(0) - slope
        for i, ridge in enumerate(RIDGES):
            change = np.linalg.solve(fitted + ridge * penalty, pull)
            losses[i] += change @ gram @ change - 2 * change @ slope
    return float(RIDGES[losses.argmin()])
