"""Rivals at their best: shapes that are fitted instead of taken from a grid.

A diagnosis tries each effect in a few shapes, to first order in its strengths. Between effects that
then explain about as much, the grid decides: a lag whose time constant lies between two of the grid
loses to a viscosity with two strengths that lie well. So the shapes of such rivals are fitted
through the whole chain, and what each changes in the prediction there is one more way to add it.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from surgisoft.diagnosis.candidates import Candidate, with_effect
from surgisoft.diagnosis.refinement.effects import shrink
from surgisoft.diagnosis.refinement.forward import Forward
from surgisoft.diagnosis.refinement.refine import refine
from surgisoft.diagnosis.residuals import Problem
from surgisoft.surrogate.effects import Effect
from surgisoft.surrogate.model import ArmModel

ITERATIONS = 8
"""Most steps of a fit."""
MOST_VALUES = 12
"""Most values of an effect that is fitted: the rows that judge it are those it is fitted to."""


@dataclass(frozen=True, eq=False)
class Refined(Candidate):
    """An effect in its fitted shape; its one column is what it changes at its fitted strengths."""

    @torch.no_grad()
    def with_amplitudes(self, amplitudes: np.ndarray) -> Effect:
        """The effect at a multiple (1,) of its fitted strengths."""
        effect = copy.deepcopy(self.effect)
        for parameter in effect.strengths().values():
            parameter.mul_(float(amplitudes[0]))
        return effect


def refined_candidates(problem: Problem, some: Sequence[tuple[str, Effect]]) -> list[Candidate]:
    """Effects, by name and with amplitudes to start from, with refined nonlinear parameters.

    Those are left out that change nothing or are not fitted (`with_fitted`).
    """
    with torch.no_grad():
        before = Forward(problem.model, problem, [])().double().numpy()
    answer = []
    for name, effect in some:
        model = with_fitted(problem, name, effect)
        if model is None:
            continue
        with torch.no_grad():
            after = Forward(model, problem, [name])().double().numpy()
        column = (after - before)[..., None]
        if np.isfinite(column).all() and np.abs(column).max() > 1e-6:
            fitted = model.effects[name].requires_grad_(False)
            answer.append(Refined(name, fitted, column, fitted=True))
    return answer


def with_fitted(problem: Problem, name: str, effect: Effect) -> ArmModel | None:
    """A problem's model with one effect more, fitted from where it stands to the problem.

    None where the fit ends, and cannot be held, where it is implausible, for an effect that the
    model has already, and for one with many values. Half a lag twice as long is nearly the same
    lag: strengths beyond their range are held at its end while the shapes go on.
    """
    if name in problem.model.effects or _values(effect) > MOST_VALUES:
        return None
    model = with_effect(copy.deepcopy(problem.model), name, copy.deepcopy(effect))
    refine(model, problem, [name], ITERATIONS)
    effect = model.effects[name]
    if not effect.plausible() and effect.shapes() and shrink(effect):
        refine(model, problem, [name], ITERATIONS, held=name)
    return model if effect.plausible() else None


def _values(effect: Effect) -> int:
    """How many numbers a fit of the effect chooses."""
    return sum(p.numel() for p in [*effect.strengths().values(), *effect.shapes().values()])
