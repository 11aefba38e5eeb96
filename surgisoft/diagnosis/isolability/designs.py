"""Effects on schedules of actuations: what each would change, nothing measured."""

import copy
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from surgisoft.diagnosis.candidates import Signals, columns_of, more_of, signals
from surgisoft.diagnosis.isolability.moments import sample_time
from surgisoft.diagnosis.next_experiment.catalogue import REFERENCE, draw_run, limits_within
from surgisoft.measurement.protocols import Protocol
from surgisoft.surrogate.arm import centre_and_half
from surgisoft.surrogate.effects import (
    ArmFacts,
    Effect,
    hypothesis_of,
    known_effects,
    make_effect,
)
from surgisoft.surrogate.history import History, pack
from surgisoft.surrogate.model import ArmModel

ROWS = 800
"""Rows of a schedule whose columns are computed; memories follow every row."""
PERIOD_S = 0.1
"""Time between the rows of a planned schedule, s."""
SHAPE_STEP = 0.02
"""Step of a slope by a value of a shape, in units of max(1, the value)."""


@dataclass(frozen=True, eq=False)
class Design:
    """A model on a schedule of actuations, thinned to S rows; nothing is measured."""

    model: ArmModel
    """The model in question."""
    history: History
    """All runs, every row; the key points are void."""
    index: Tensor
    """(S,) the looked-at rows among all rows of the runs one after the other."""
    pressure: np.ndarray
    """(S, m) actuation scaled to [-1, 1] over the model's range."""
    direction: np.ndarray
    """(S, m) directions of change."""
    seconds: float
    """Time that the rows stand for, s."""

    def rows(self, tensor: Tensor) -> Tensor:
        """The looked-at rows of a (R, T, ...) tensor."""
        return self.history.rows(tensor)[self.index]

    @cached_property
    def signals(self) -> Signals:
        """What the stages of the model see along the history."""
        return signals(self)


@dataclass(frozen=True, eq=False)
class Shape:
    """One effect with one choice of its shape."""

    name: str
    """The effect's name."""
    effect: Effect
    """The effect, at zero strength."""
    more: bool = False
    """Whether it is the one that the model has already, stronger or weaker."""
    fitted: bool = False
    """Whether it was fitted to recordings; then its shape, too, may be a little another."""


def shapes_of(
    model: ArmModel,
    reference: Design,
    names: list[str] | None = None,
    facts: ArmFacts | None = None,
) -> list[Shape]:
    """Every shape of the named effects (default: all known) that a diagnosis tries on a model.

    facts: those of the arm as it was recorded, where they are not the model's own.
    """
    known = known_effects()
    names = list(known) if names is None else list(names)
    facts = model.facts if facts is None else facts
    points = reference.rows(reference.signals.body)
    answer = []
    for name in names:
        kind = known[name] if name in known else type(make_effect(name, facts))
        if name in model.effects:
            answer.append(Shape(name, model.effects[name], True))
        answer += [Shape(name, effect) for effect in hypothesis_of(kind).candidates(facts, points)]
    return answer


@torch.no_grad()
def columns_on(
    design: Design, shapes: list[Shape], facts: ArmFacts | None = None
) -> list[np.ndarray]:
    """(S, n, 3, K_j) change of the key points, mm, with each strength of each shape.

    Of a fitted one with each value of its shape too, at the strengths that it has.

    facts: those of the arm as it stands in the experiment, where they are not the model's own.
    """
    signal = design.signals
    points = design.model.spec.key_points
    answer = []
    for shape in shapes:
        if shape.more:
            found = more_of(design, signal, shape.name)
            empty = np.zeros((len(design.index), points, 3, 1), np.float32)
            answer.append(empty if found is None else found.columns)
        else:
            effect = shape.effect if facts is None else under(shape.effect, facts)
            columns = columns_of(design, signal, effect)
            if shape.fitted:
                moved = _slopes(design, signal, effect, columns)
                columns = np.concatenate([columns, moved], axis=3)
            answer.append(columns)
    return answer


def _slopes(design: Design, signal: Signals, effect: Effect, columns: np.ndarray) -> np.ndarray:
    """(S, n, 3, P) change of the key points, mm, with each value of a fitted effect's shape.

    columns: (S, n, 3, K) change with each of its strengths.
    """
    strengths = torch.cat([p.flatten() for p in effect.amplitudes().values()]).numpy()
    now, answer = columns @ strengths, []
    for name, parameter in effect.nonlinear_parameters().items():
        for i, value in enumerate(parameter.flatten().tolist()):
            other = copy.deepcopy(effect)
            step = SHAPE_STEP * max(1.0, abs(value))
            other.get_parameter(name).view(-1)[i] += step
            answer.append((columns_of(design, signal, other) @ strengths - now) / step)
    return np.stack(answer, axis=3) if answer else columns[..., :0]


def under(effect: Effect, facts: ArmFacts) -> Effect:
    """The same effect with the same parameters on an arm that stands otherwise."""
    answer = type(effect)(facts, **effect.config())
    answer.load_state_dict(effect.state_dict())
    return answer


def design_of(model: ArmModel, history: History, rows: int = ROWS) -> Design:
    """A model on the actuations of a history, thinned to about `rows` rows."""
    with torch.no_grad():
        direction = history.rows(model.trace(history).direction)
    total = int(history.valid.sum())
    index = torch.arange(0, total, max(1, round(total / rows)))
    centre, half = (x.numpy() for x in centre_and_half(model.facts.low, model.facts.high))
    pressure = history.rows(history.pressure).double().numpy()[index]
    return Design(
        model,
        history,
        index,
        (pressure - centre) / half,
        direction.double().numpy()[index],
        float(history.dt_s.sum()) + sample_time(history) * history.runs,
    )


def reference_design(model: ArmModel, seconds: float = 40.0, rows: int = 400) -> Design:
    """The varied schedule on which plausible sizes are stated: some of every kind of motion."""
    limits = limits_within(model.spec.low, model.spec.high)
    runs = [draw_run(name, limits, 0, seconds) for name in REFERENCE]
    return design_of(model, planned_history(model, runs), rows)


def planned_history(
    model: ArmModel, runs: list[tuple[np.ndarray, np.ndarray]], period_s: float = PERIOD_S
) -> History:
    """Runs of knot times (T,) [s] and actuations (T, m) as if they had been played exactly."""
    times, rows, start = [], [], 0.0
    for knots, commands in runs:
        t = np.arange(0.0, knots[-1] - knots[0] + 0.5 * period_s, period_s)
        columns = [np.interp(t, knots - knots[0], column) for column in commands.T]
        times.append(torch.from_numpy(start + t))
        rows.append(torch.from_numpy(np.stack(columns, axis=1)))
        start += t[-1] + period_s
    void = [torch.full((len(t), model.spec.key_points, 3), torch.nan) for t in times]
    return pack(times, rows, void)


def history_of_protocol(model: ArmModel, protocol: Protocol) -> History:
    """A protocol as a history: every run played exactly, from an arm at rest."""
    runs = []
    for _, rows in protocol.run_rows:
        if protocol.kind == "settled":
            step = protocol.settle_s + protocol.average_s
            runs.append((step * np.arange(len(protocol.commands[rows])), protocol.commands[rows]))
        else:
            runs.append((protocol.t_s[rows], protocol.commands[rows]))
    period = PERIOD_S if protocol.kind == "continuous" else protocol.settle_s + protocol.average_s
    return planned_history(model, runs, period)


def length_of(model: ArmModel) -> float:
    """Length of the arm at rest, mm: stated, or from its key points."""
    if model.spec.length_mm:
        return float(model.spec.length_mm)
    rest = model.rest_mm.double().cpu().numpy()
    return max(float(np.linalg.norm(rest[-1])), 1.0)
