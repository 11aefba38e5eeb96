"""Candidates: first-order sensitivities of a model's prediction to effects that it may lack.

Where the same motion was recorded before and after a change, the body that a load was hung on is
known: it is what BEFORE measured. What a load or a smaller gain does to it needs no model, and also
holds for motion that no model predicts from the actuation, such as swings. So a paired difference
has further candidates of the effects, on the measured body in place of the predicted one.

A load in motion pulls with its apparent weight m (g - a), a the acceleration of its place
(d'Alembert 1743). In a linear arm with the mass, damping and stiffness M, D, K and the actuation's
force f, before and after obey

    M y0'' + D y0' + K y0 = f,        (M + m) y1'' + D y1' + (K + k) y1 = f,
    y1 - y0 = - A1^-1 (m y0'' + k y0),        A1 = (M + m) d^2/dt^2 + D d/dt + K + k,

whatever the size of m: the load acts on the motion of BEFORE, and the arm gives way with the poles
of AFTER. In the first bending mode (Meirovitch 2001, ch. 8)

    (K + k) A1^-1 = w^2 / (d^2/dt^2 + 2 damping w d/dt + w^2),        w = 2 pi frequency,

times the sag at rest of `effects/payload.py`. A hanging arm is pulled back by a load at rest, as by
a smaller gain. But the faster it swings, the less: a load pulls outward where the arm swings faster
than a pendulum of its length. A smaller gain acts alike at every frequency, so motion tells the two
apart.
"""

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol, TypeVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import Module, Parameter

from surgisoft.diagnosis.residuals import Problem
from surgisoft.surrogate.chain import Before, Taps, context_of, memory_at
from surgisoft.surrogate.effects import (
    ArmFacts,
    Context,
    Effect,
    free_name,
    hypothesis_of,
    known_effects,
)
from surgisoft.surrogate.effects.beam import Beam, cross, displaced
from surgisoft.surrogate.effects.inertia import Inertia
from surgisoft.surrogate.history import History
from surgisoft.surrogate.model import ArmModel

STANDARD_GRAVITY_MM_S2 = 9806.65
"""Standard acceleration of gravity, mm/s^2 (CGPM 1901)."""
FREQUENCIES_HZ = (0.7, 1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0)
"""Undamped frequencies of the loaded arm's first mode that identification tries, Hz: those of soft
arms of centimetres to a metre, in steps of half an octave."""
DAMPING_RATIOS = (0.1, 0.2, 0.4, 0.8)
"""Damping ratios of that mode that are tried: up to nearly no swing."""
SAMPLES_A_PERIOD = 4.0
"""Fewest samples in a period of a mode that is tried."""


Part = TypeVar("Part", bound=Module)
"""An effect, or a module inside one."""


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
    removable: bool = False
    """Whether the effect may also have been taken away, with amplitudes of the other sign: a load
    that hung on the arm before."""
    spread: np.ndarray | None = None
    """(P, K) the effect's P amplitudes for each of the K that are fitted; None: they are the same.
    """

    @property
    def amplitudes(self) -> int:
        """Number of amplitudes that its fit chooses."""
        return self.sensitivities.shape[3]

    @torch.no_grad()
    def with_amplitudes(self, amplitudes: np.ndarray) -> Effect | None:
        """The effect at amplitudes (K,); None for more of one that the model has."""
        if self.more:
            return None
        effect, first = copied(self.effect), 0
        amplitudes = amplitudes if self.spread is None else self.spread @ amplitudes
        for parameter in effect.amplitudes().values():
            part = amplitudes[first : first + parameter.numel()]
            parameter.copy_(torch.as_tensor(part, dtype=parameter.dtype).view_as(parameter))
            first += parameter.numel()
        return effect


def copied(module: Part) -> Part:
    """An effect with parameters of its own; everything else is shared with the given one.

    A diagnosis copies effects by the hundred: `copy.deepcopy`, which also copies what never
    changes, took a tenth of its time.
    """
    twin = copy.copy(module)
    twin._parameters = {
        name: None if own is None else Parameter(own.detach().clone(), own.requires_grad)
        for name, own in module._parameters.items()
    }
    twin._modules = {
        name: None if part is None else copied(part) for name, part in module._modules.items()
    }
    return twin


def with_effect(model: ArmModel, name: str, effect: Effect) -> ArmModel:
    """The model with one effect more, behind those of its stage; the parts are shared."""
    return model.replace(effects={**model.effects, free_name(name, model.effects): effect})


@dataclass(frozen=True, eq=False)
class Signals:
    """Signals at the stages of a model along a history (all rows), and its slope (some rows)."""

    context: Context
    """Times and chamber pressure of every row."""
    taps: Taps
    """Signals behind each stage and memories, every row (R, T, ...)."""
    slope: Tensor
    """(S, n, 3, m) change of key points with the effective actuation, mm a unit."""
    before: Before
    """The signal of each stage before the first row."""
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

    @property
    def taps(self) -> Taps | None:
        """What a scan of the history by the model gave, where one was made."""

    def rows(self, tensor: Tensor) -> Tensor:
        """The looked-at rows of a (R, T, ...) tensor."""


@torch.no_grad()
def signals(problem: RowsOfModel) -> Signals:
    """The signals of a problem's model."""
    chain, history = problem.model.chain, problem.history
    first = problem.model.first_pressure(history)
    taps = problem.taps or chain.scan(history, first)
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
    before = chain.first_memory(effect, signal.before, at[:, 0], signal.first)
    memory = memory_at(effect, before, at, signal.context, problem.rows, problem.history)
    changes = chain.sensitivities(effect, problem.rows(at), memory, signal.slope)
    return changes.movedim(0, -1).numpy()


@torch.no_grad()
def more_of(problem: RowsOfModel, signal: Signals, name: str) -> Candidate | None:
    """An effect of the wall that the model has already, stronger or weaker.

    For one that acts on the actuation a column for all chambers and one for each, in turn; for one
    of the body a column of what it changes in the prediction.
    """
    effect, chain = problem.model.effects[name], problem.model.chain
    if type(effect).stage == "material" and effect.stage == "body":
        some = {key: each for key, each in problem.model.effects.items() if key != name}
        without = problem.model.replace(effects=some).chain.scan(problem.history, signal.first)
        change = signal.taps.behind["sensor"] - without.behind["sensor"]
        column = problem.rows(change).unsqueeze(-1)
        return Candidate(name, effect, column.double().numpy(), more=True)
    if effect.stage != "material":
        return None
    if name in signal.taps.memory:
        before, after = chain.around(name, signal.taps)
    else:
        before, after = chain.followed_around(name, problem.history, signal.first)
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
    """The sensitivities of every known effect (or the named ones) over its grid.

    In a paired difference also those of effects on the measured body of BEFORE.
    """
    return [*model_candidates(problem, names), *measured_candidates(problem, names)]


def model_candidates(problem: Problem, names: list[str] | None = None) -> list[Candidate]:
    """The sensitivities of a model's own prediction to effects over their grids."""
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


# On the measured body --------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Mode:
    """The first bending mode of the arm with its load."""

    frequency_Hz: float
    """Undamped frequency, Hz."""
    damping: float
    """Damping ratio."""

    def follow(
        self, facts: ArmFacts, signal: Tensor, dt_s: Tensor, rows: Callable[[Tensor], Tensor]
    ) -> tuple[Tensor, Tensor]:
        """(S, ...) response y to signals u (R, T, ...) on the looked-at rows, and its acceleration
        y'', in u / s^2.

        The signal is taken for linear between its rows, by its mean over each step. It is followed
        along all rows; rows picks those that are looked at from a (R, T, ...) tensor.
        """
        mode, u = Inertia(facts, self.frequency_Hz, self.damping), signal.flatten(2)
        before = torch.cat([u[:, :1], u[:, :-1]], dim=1)
        state = mode.scan(mode.rest(u[:, 0]), (u + before) / 2, Context(dt_s), rows)
        y, speed = (part.view(-1, *signal.shape[2:]) for part in state.unbind(-1))
        w = 2 * np.pi * self.frequency_Hz
        return y, w**2 * (rows(signal) - y - 2 * self.damping * speed)


@torch.no_grad()
def measured_candidates(problem: Problem, names: Sequence[str] | None = None) -> list[Candidate]:
    """Candidates of the named effects on the body of BEFORE; none for a problem without pairs."""
    body = problem.table.body_before_mm
    if body is None:
        return []
    known, facts, answer = known_effects(), facts_of(problem), []
    fresh = [name for name in names or known if name not in problem.model.effects]
    by_way: dict[str, list[str]] = {"gain": [], "load": []}
    for name in fresh:
        by_way.setdefault(hypothesis_of(known[name]).measured_body, []).append(name)
    for name in by_way["gain"]:
        answer.append(_gain(problem, name, known[name](facts), body))
    for name in by_way["load"]:
        answer += _loads(problem, name, known[name](facts), body)
    return answer


def _gain(problem: Problem, name: str, effect: Effect, body: np.ndarray) -> Candidate:
    """One gain of all chambers: a linear arm's whole motion grows by it, whatever moves it."""
    motion = body[problem.index.numpy()] - problem.table.rest_mm
    spread = np.ones((problem.model.spec.chambers, 1))
    return Candidate(name, effect, motion[..., None], spread=spread)


def _loads(problem: Problem, name: str, effect: Effect, body: np.ndarray) -> list[Candidate]:
    """A load at rest on the measured body, and in motion for each mode."""
    history, facts = problem.history, effect.facts
    shape = (*history.valid.shape, *body.shape[1:])
    points = torch.zeros(shape, dtype=torch.float32)
    points[history.valid] = torch.from_numpy(body).float()
    # Rows of padding are zeros, and none of them is looked at.
    still = effect.sensitivities(points, points.new_zeros(*shape[:2], 0))
    answer = [Candidate(name, effect, _rows(problem, still), removable=True)]
    if facts.gravity is None or not problem.table.timed.any():
        return answer
    beam = Beam.through(facts.rest_mm)
    steps = history.dt_s[history.dt_s > 0]
    fastest = 1.0 / (SAMPLES_A_PERIOD * float(steps.median())) if len(steps) else 0.0
    here = problem.rows(points)
    for frequency in FREQUENCIES_HZ:
        for damping in DAMPING_RATIOS if frequency <= fastest else ():
            mode = Mode(frequency, damping)
            moved = [mode.follow(facts, load, history.dt_s, problem.rows)[0] for load in still]
            _, acceleration = mode.follow(facts, points, history.dt_s, problem.rows)
            pulled = _pulled(beam, here, -acceleration / STANDARD_GRAVITY_MM_S2)
            sensitivities = (torch.stack(moved) + pulled).movedim(0, -1).double().numpy()
            answer.append(Candidate(name, type(effect)(facts), sensitivities, removable=True))
    return answer


def _pulled(beam: Beam, points: Tensor, force: Tensor) -> Tensor:
    """(2, S, n, 3) displacement, mm, by forces at the key points, for 1 mm of each sag.

    points: (S, n, 3) key points, mm; force: (S, n, 3) force of a mass at each key point over its
    weight. The first load is at the tip; the second one lies along the body, the share of each key
    point that of the body nearest to it (`Payload` states the units).
    """
    p = points.mT.contiguous()
    chords, length = p @ beam.chords, beam.length_mm
    tip = cross(p @ beam.levers[-1], force[..., -1, :, None]) * (3 / length**3)
    body = torch.zeros_like(tip)
    for place, share in enumerate(beam.shares):
        lever = p @ beam.levers[place]
        body += cross(lever, force[..., place, :, None]) * (8 / length**3 * share)
    return torch.stack([displaced(turned, chords, beam.collect) for turned in (tip, body)])


def _rows(problem: Problem, fields: Tensor) -> np.ndarray:
    """(S, n, 3, K) the looked-at rows of K fields (K, R, T, n, 3)."""
    return torch.stack([problem.rows(field) for field in fields], dim=-1).double().numpy()
