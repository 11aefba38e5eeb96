"""A model's prediction on the fitted rows, again and again while some effects' parameters change.

The chain is a list of links (each line effect, the chambers and their directions, each material
effect, the network, each body and sensor effect). What stands before the first link that may
change is computed once; memories follow every row, the network only those that are looked at,
unless an effect behind it remembers.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from surgisoft.diagnosis.residuals import Problem
from surgisoft.surrogate import direction as directions
from surgisoft.surrogate.effects import Context, Memoryless
from surgisoft.surrogate.model import ArmModel, context_of


@dataclass(frozen=True, eq=False)
class Signal:
    """What runs along the chain."""

    value: Tensor
    """(R, T, m) actuation before the network, (..., n, 3) key points in mm behind it."""
    pressure: Tensor | None = None
    """(R, T, m) chamber pressure."""
    direction: Tensor | None = None
    """(R, T, m) direction of change."""


Link = Callable[[Signal, dict[str, Tensor]], Signal]
"""Takes the signal and every effect's memory at rest."""


class Forward:
    """`forward()` is the model's prediction (S, n, 3) in mm with its present parameters.

    The parameters of the effects named by `keys`, and of what stands behind them, may change
    between calls; autograd runs through those that require it.
    """

    def __init__(self, model: ArmModel, problem: Problem, keys: Iterable[str]):
        """keys: names of the effects whose parameters change; of none, those of the network."""
        self.model, self.problem = model, problem
        self.context = context_of(problem.history)
        first = model.first_pressure(problem.history)
        self.first = first[:1] if (first == first[:1]).all() else first
        outer = model.stage("body") + model.stage("sensor")
        self.thin = all(isinstance(effect, Memoryless) for _, effect in outer)
        links: list[tuple[str, Link]] = []
        links += [(name, self._actuation(name)) for name, _ in model.stage("line")]
        links.append(("", self._chamber))
        links += [(name, self._actuation(name)) for name, _ in model.stage("material")]
        links.append(("network", self._network))
        links += [(name, self._points(name)) for name, _ in outer]
        wanted = set(keys) or {"network"}
        first = next(i for i, (name, _) in enumerate(links) if name in wanted)
        self.links = [link for _, link in links[first:]]
        with torch.no_grad():
            self.start = self._run(
                [link for _, link in links[:first]], Signal(problem.history.pressure)
            )

    def __call__(self) -> Tensor:
        """(S, n, 3) key points in mm, base frame."""
        points = self._run(self.links, self.start).value
        return points if self.thin else self.problem.rows(points)

    def context_at(self, signal: Signal) -> Context:
        """Times and, behind the line, the chambers' pressure along a signal."""
        return replace(self.context, pressure=signal.pressure)

    def _run(self, links: list[Link], signal: Signal) -> Signal:
        rest = self.model.first_state(self.first).memory
        runs = self.problem.history.runs
        rest = {name: memory.expand(runs, *memory.shape[1:]) for name, memory in rest.items()}
        for link in links:
            signal = link(signal, rest)
        return signal

    def _actuation(self, name: str) -> Link:
        def link(signal: Signal, rest: dict[str, Tensor]) -> Signal:
            effect = self.model.effects[name]
            memory = effect.scan(rest[name], signal.value, self.context)
            return replace(signal, value=effect.apply(signal.value, memory))

        return link

    def _chamber(self, signal: Signal, rest: dict[str, Tensor]) -> Signal:
        chamber = self.model.chambers(signal.value)
        with torch.no_grad():
            _, direction = directions.trace(chamber, self.model.band, self.model.rest)
        return Signal(chamber, chamber, direction)

    def _network(self, signal: Signal, rest: dict[str, Tensor]) -> Signal:
        actuation, direction = signal.value, signal.direction
        if self.thin:
            actuation, direction = self.problem.rows(actuation), self.problem.rows(direction)
        return replace(signal, value=self.model.network(actuation, direction))

    def _points(self, name: str) -> Link:
        def link(signal: Signal, rest: dict[str, Tensor]) -> Signal:
            effect = self.model.effects[name]
            if self.thin:
                return replace(signal, value=effect.apply(signal.value, signal.value[..., :0, 0]))
            memory = effect.scan(rest[name], signal.value, self.context_at(signal))
            return replace(signal, value=effect.apply(signal.value, memory))

        return link
