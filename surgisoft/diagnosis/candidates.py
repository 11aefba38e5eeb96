"""What each effect would change in a model's prediction, to first order in its strengths."""

import copy
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from surgisoft.diagnosis.residuals import Problem
from surgisoft.surrogate.effects import (
    ArmFacts,
    Context,
    Effect,
    free_name,
    known_effects,
)
from surgisoft.surrogate.model import ArmModel, context_of


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect with one choice of its shape, added to a model at zero strength."""

    name: str
    """The effect's name."""
    effect: Effect
    """The effect, at zero strength."""
    columns: np.ndarray
    """(S, n, 3, K) change of the key points with each strength, mm."""
    more: bool = False
    """Whether the columns make an effect that the model has already stronger."""
    fitted: bool = False
    """Whether the shape was fitted through the whole chain; else it is one of a grid."""

    @torch.no_grad()
    def with_amplitudes(self, amplitudes: np.ndarray) -> Effect | None:
        """The effect at strengths (K,); None for more of one that the model has."""
        if self.more:
            return None
        effect, first = copy.deepcopy(self.effect), 0
        for parameter in effect.strengths().values():
            part = amplitudes[first : first + parameter.numel()]
            parameter.copy_(torch.as_tensor(part, dtype=parameter.dtype).view_as(parameter))
            first += parameter.numel()
        return effect


def with_effect(model: ArmModel, name: str, effect: Effect) -> ArmModel:
    """The model with one effect more, behind those of its stage; the parts are shared."""
    effects = {**model.effects, free_name(name, model.effects): effect}
    return ArmModel(model.spec, model.network, effects, model.rest_mm, model.validation)


@dataclass(frozen=True, eq=False)
class Signals:
    """What the stages of a model see along a history, every row, and its slope on some."""

    context: Context
    """Times and chamber pressure of every row."""
    line: Tensor
    """(R, T, m) actuation behind the line effects."""
    material: Tensor
    """(R, T, m) effective actuation."""
    body: Tensor
    """(R, T, n, 3) key points before sensor effects, mm."""
    sensor: Tensor
    """(R, T, n, 3) key points, mm."""
    slope: Tensor
    """(S, n, 3, m) change of key points with the effective actuation, mm a unit."""
    rest: dict[str, Tensor]
    """The signal of each stage before the first row, (R, m) or (R, n, 3)."""
    first: Tensor
    """(R, m) actuation at which each run begins."""


@torch.no_grad()
def signals(problem: Problem) -> Signals:
    """The signals of a problem's model."""
    model, history = problem.model, problem.history
    trace = model.trace(history)
    effective = model.effective(trace.pressure, trace.memory)
    points = model.network(effective, trace.direction)
    first = model.first_pressure(history)
    state, rest = model.before(first)
    context = replace(context_of(history), pressure=trace.pressure)
    stages = {}
    for stage in ("body", "sensor"):
        for name, effect in model.stage(stage):
            points = effect.apply(points, effect.scan(state.memory[name], points, context))
        stages[stage] = points
    at, direction = problem.rows(effective), problem.rows(trace.direction)
    slope = network_slope(model, at, direction)
    return Signals(
        context, trace.pressure, effective, stages["body"], stages["sensor"], slope, rest, first
    )


def network_slope(model: ArmModel, effective: Tensor, direction: Tensor) -> Tensor:
    """(S, n, 3, m) change of key points with the effective actuation (S, m), mm a unit."""
    with torch.enable_grad():
        at = effective.detach().clone().requires_grad_(True)
        points = model.network(at, direction).flatten(1)
        parts = [torch.autograd.grad(p.sum(), at, retain_graph=True)[0] for p in points.unbind(1)]
    return torch.stack(parts, 1).unflatten(1, (model.spec.key_points, 3))


@torch.no_grad()
def columns_of(problem: Problem, signal: Signals, effect: Effect) -> np.ndarray:
    """(S, n, 3, K) change of the key points, mm, with each strength of an effect at zero.

    Effects of line and material act through the network's slope; the memory of effects behind
    them is taken to follow.
    """
    at = getattr(signal, effect.stage)
    seen = signal.rest[effect.stage]
    before = problem.model.first_memory(effect, seen, at[:, 0], signal.first)
    memory = effect.scan(before, at, signal.context)
    changes = effect.columns(problem.rows(at), problem.rows(memory))
    if effect.stage in ("line", "material"):
        changes = torch.einsum("snjm,ksm->ksnj", signal.slope, changes)
    return changes.movedim(0, -1).numpy()


@torch.no_grad()
def more_of(problem: Problem, signal: Signals, name: str) -> Candidate | None:
    """An effect that the model has already, stronger or weaker: one column for each output.

    For an effect on the actuation one for each chamber too, in turn.
    """
    model, effect = problem.model, problem.model.effects[name]
    if effect.stage != "material":
        return None
    trace = model.trace(problem.history)
    before = trace.pressure
    for other, part in model.stage("material"):
        after = part.apply(before, trace.memory[other])
        if other == name:
            change = problem.rows(after - before)
            break
        before = after
    each = torch.diag_embed(change).movedim(-1, 0)
    columns = torch.einsum("snjm,ksm->ksnj", signal.slope, torch.cat([change[None], each[:-1]]))
    return Candidate(name, effect, columns.movedim(0, -1).numpy(), more=True)


def facts_of(problem: Problem) -> ArmFacts:
    """What effects may know of the arm; what a room that was warm all along does is not drift."""
    facts, room = problem.model.facts, problem.history.temperature_C
    if facts.temperature_C is None and room is not None:
        return replace(facts, temperature_C=float(room.nanmean()))
    return facts


def candidates(problem: Problem, names: list[str] | None = None) -> list[Candidate]:
    """Every known effect in each of its shapes, as columns."""
    model, signal = problem.model, signals(problem)
    points = problem.rows(signal.body)
    answer, known, facts = [], known_effects(), facts_of(problem)
    for name in names or known:
        more = more_of(problem, signal, name) if name in model.effects else None
        if more is None:
            fresh = known[name].candidates(facts, points)
        else:
            answer.append(more)
            fresh = known[name].further(facts, points)
        for effect in fresh:
            columns = columns_of(problem, signal, effect)
            answer.append(Candidate(name, copy.deepcopy(effect), columns))
    return [c for c in answer if np.isfinite(c.columns).all() and np.abs(c.columns).max() > 1e-6]
