"""Candidates: first-order sensitivities of a model's prediction to effects that it may lack."""

import copy
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from surgisoft.diagnosis.residuals import Problem
from surgisoft.surrogate.chain import Taps, context_of
from surgisoft.surrogate.effects import (
    ArmFacts,
    Context,
    Effect,
    Stage,
    free_name,
    hypothesis_of,
    known_effects,
)
from surgisoft.surrogate.history import History
from surgisoft.surrogate.model import ArmModel


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect with given nonlinear parameters, added to a model at zero amplitude."""

    name: str
    """The effect's name."""
    effect: Effect
    """The effect, at zero amplitude."""
    sensitivities: np.ndarray
    """(S, n, 3, K) sensitivity of the key points to each amplitude, mm."""
    more: bool = False
    """Whether the sensitivities make an effect that the model has already stronger."""
    fitted: bool = False
    """Whether its nonlinear parameters were fitted and not taken from a grid."""

    @property
    def amplitudes(self) -> int:
        """Number of amplitudes that its fit chooses."""
        return self.sensitivities.shape[3]

    @torch.no_grad()
    def with_amplitudes(self, amplitudes: np.ndarray) -> Effect | None:
        """The effect at amplitudes (K,); None for more of one that the model has."""
        if self.more:
            return None
        effect, first = copy.deepcopy(self.effect), 0
        for parameter in effect.amplitudes().values():
            part = amplitudes[first : first + parameter.numel()]
            parameter.copy_(torch.as_tensor(part, dtype=parameter.dtype).view_as(parameter))
            first += parameter.numel()
        return effect


def with_effect(model: ArmModel, name: str, effect: Effect) -> ArmModel:
    """The model with one effect more, behind those of its stage; the parts are shared."""
    return model.replace(effects={**model.effects, free_name(name, model.effects): effect})


@dataclass(frozen=True, eq=False)
class Signals:
    """What the stages of a model see along a history, every row, and its slope on some."""

    context: Context
    """Times and chamber pressure of every row."""
    taps: Taps
    """Signals behind each stage and memories, every row (R, T, ...)."""
    slope: Tensor
    """(S, n, 3, m) change of key points with the effective actuation, mm a unit."""
    rest: dict[Stage, Tensor]
    """The signal of each stage before the first row, (R, m) or (R, n, 3)."""
    first: Tensor
    """(R, m) actuation at which each run begins."""

    @property
    def body(self) -> Tensor:
        """(R, T, n, 3) key points before sensor effects, mm."""
        return self.taps.behind["body"]


class RowsOfModel(Protocol):
    """A model and the rows at which it is looked at: a `Problem`, or a schedule not yet recorded.

    What identification needs that looks at predictions only.
    """

    @property
    def model(self) -> ArmModel:
        """The model in question."""

    @property
    def history(self) -> History:
        """All runs, every row."""

    def rows(self, tensor: Tensor) -> Tensor:
        """The looked-at rows of a (R, T, ...) tensor."""


@torch.no_grad()
def signals(problem: RowsOfModel) -> Signals:
    """The signals of a problem's model."""
    chain, history = problem.model.chain, problem.history
    first = problem.model.first_pressure(history)
    taps = chain.scan(history, first)
    context = replace(context_of(history), pressure=taps.pressure)
    slope = chain.slope(history, first, taps, problem.rows)
    return Signals(context, taps, slope, chain.standing(first)[1], first)


@torch.no_grad()
def sensitivities_of(problem: RowsOfModel, signal: Signals, effect: Effect) -> np.ndarray:
    """(S, n, 3, K) sensitivity of the key points, mm, to each amplitude of an effect at zero.

    The effect stands behind the others of its stage. Effects of line and material act through the
    network's slope; the memory of effects behind them is taken to follow.
    """
    chain, at = problem.model.chain, signal.taps.behind[effect.stage]
    before = chain.first_memory(effect, signal.rest, at[:, 0], signal.first)
    memory = effect.scan(before, at, signal.context)
    changes = chain.sensitivities(effect, problem.rows(at), problem.rows(memory), signal.slope)
    return changes.movedim(0, -1).numpy()


@torch.no_grad()
def more_of(problem: RowsOfModel, signal: Signals, name: str) -> Candidate | None:
    """An effect that the model has already, stronger or weaker: one column for each output.

    For an effect on the actuation one for each chamber too, in turn.
    """
    effect = problem.model.effects[name]
    if effect.stage != "material":
        return None
    before, after = problem.model.chain.around(name, signal.taps)
    change = problem.rows(after - before)
    each = torch.diag_embed(change).movedim(-1, 0)
    sensitivities = torch.einsum(
        "snjm,ksm->ksnj", signal.slope, torch.cat([change[None], each[:-1]])
    )
    return Candidate(name, effect, sensitivities.movedim(0, -1).numpy(), more=True)


def facts_of(problem: Problem) -> ArmFacts:
    """What effects may know of the arm. A model that does not say how warm its room was takes the
    mean of the recordings: a room that was warm all along causes no drift."""
    facts, room = problem.model.facts, problem.history.temperature_C
    if facts.temperature_C is None and room is not None:
        return replace(facts, temperature_C=float(room.nanmean()))
    return facts


def candidates(problem: Problem, names: list[str] | None = None) -> list[Candidate]:
    """The sensitivities of every known effect (or the named ones) over its grid."""
    model, signal = problem.model, signals(problem)
    points = problem.rows(signal.body)
    answer, known, facts = [], known_effects(), facts_of(problem)
    for name in names or known:
        more = more_of(problem, signal, name) if name in model.effects else None
        hypothesis = hypothesis_of(known[name])
        if more is None:
            fresh = hypothesis.candidates(facts, points)
        else:
            answer.append(more)
            fresh = hypothesis.further(facts, points)
        for effect in fresh:
            sensitivities = sensitivities_of(problem, signal, effect)
            answer.append(Candidate(name, effect, sensitivities))
    return [
        c
        for c in answer
        if np.isfinite(c.sensitivities).all() and np.abs(c.sensitivities).max() > 1e-6
    ]
