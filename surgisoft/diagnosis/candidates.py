"""What each effect would change in a model's prediction, to first order in its strengths."""

import copy
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from surgisoft.diagnosis.problem import Problem
from surgisoft.surrogate.effects import EFFECTS, Effect
from surgisoft.surrogate.model import ArmModel

MORE = "_more"
"""Ending of the name of a second instance of an effect that the model has already."""


@dataclass(frozen=True, eq=False)
class Candidate:
    """One effect with one choice of its shape, added to a model at zero strength."""

    name: str
    """The effect's name."""
    effect: Effect
    """The effect, at zero strength."""
    columns: np.ndarray
    """(S, n, 3, K) change of the key points with each strength, mm."""


def key_of(model: ArmModel, name: str) -> str:
    """Key under which one more effect of a name goes into a model."""
    key = name
    while key in model.effects:
        key += MORE
    return key


def with_effect(model: ArmModel, name: str, effect: Effect) -> ArmModel:
    """The model with one effect more, behind those of its stage; the parts are shared."""
    effects = {**model.effects, key_of(model, name): effect}
    return ArmModel(model.spec, model.network, effects, model.rest_mm, model.validation)


@dataclass(frozen=True, eq=False)
class Signals:
    """What the stages of a model see along a history, every row, and its slope on some."""

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


@torch.no_grad()
def signals(problem: Problem) -> Signals:
    """The signals of a problem's model."""
    model, history = problem.model, problem.history
    trace = model.trace(history)
    effective = model.effective(trace.pressure, trace.memory)
    points = model.network(effective, trace.direction)
    start, dt = model.initial_state(history.runs).memory, history.dt_s
    stages = {}
    for stage in ("body", "sensor"):
        for name, effect in model.stage(stage):
            points = effect.apply(points, effect.scan(start[name], points, dt))
        stages[stage] = points
    at, direction = problem.rows(effective), problem.rows(trace.direction)
    units = torch.eye(model.spec.chambers)
    slope = torch.stack(
        [
            torch.func.jvp(lambda p: model.network(p, direction), (at,), (unit.expand_as(at),))[1]
            for unit in units
        ],
        dim=-1,
    )
    return Signals(trace.pressure, effective, stages["body"], stages["sensor"], slope)


@torch.no_grad()
def columns_of(problem: Problem, signal: Signals, effect: Effect) -> np.ndarray:
    """(S, n, 3, K) change of the key points, mm, with each strength of an effect at zero.

    Effects of line and material act through the network's slope; the memory of effects behind
    them is taken to follow.
    """
    at = getattr(signal, effect.stage)
    memory = effect.scan(effect.rest(at[:, 0]), at, problem.history.dt_s)
    changes = effect.columns(problem.rows(at), problem.rows(memory))
    if effect.stage in ("line", "material"):
        changes = torch.einsum("snjm,ksm->ksnj", signal.slope, changes)
    return changes.movedim(0, -1).numpy()


def candidates(problem: Problem, names: list[str] | None = None) -> list[Candidate]:
    """Every known effect in each of its shapes, as columns."""
    model, signal = problem.model, signals(problem)
    points = problem.rows(signal.body)
    answer = []
    for name in names or EFFECTS:
        for effect in EFFECTS[name].candidates(model.facts, points):
            columns = columns_of(problem, signal, effect)
            power = np.nanmean(columns**2, axis=(0, 1, 2))
            kept = power > 1e-12 * max(power.max(), 1e-30)
            if kept.any() and np.isfinite(columns).all():
                answer.append(Candidate(name, copy.deepcopy(effect), columns))
    return answer
