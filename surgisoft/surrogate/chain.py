"""The chain of the arm model: line, chambers, direction, material, network, body, sensor.

`Chain.walk` is the one place where a signal passes through these links. What happens in a link
depends on the mode: one time step (`Stepping`), a whole recording (`Scanning`), an arm without
history (`Resting`), an arm that was held for a while (`Standing`), or given memories (`Holding`).
First-order sensitivities use the signals that a scan has recorded.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from surgisoft.errors import InputError
from surgisoft.surrogate.arm import ArmState
from surgisoft.surrogate.callables.network import CallableNetwork
from surgisoft.surrogate.effects import FRONT, Context, Effect, Memoryless, Stage
from surgisoft.surrogate.history import History
from surgisoft.surrogate.networks import rowwise_jacobian
from surgisoft.surrogate.scan import direction_scan, direction_step

STOOD_S = 10.0
"""Time for which an arm is assumed to have been held where a run begins away from rest, s."""
BLOCK_ROWS = 1 << 16
"""Rows that are followed at once where there are more: the temporaries of a block stay in the
processor's cache, and those of two million rows would take gigabytes."""
NETWORK = "network"
"""Key of a recurrent network's state in `ArmState.memory`."""


class Link(NamedTuple):
    """One place of the chain: an effect, the chambers or the network."""

    stage: str
    """Stage of an effect, `chambers` or `network`."""
    name: str
    """Name of the effect in its model; `chambers` or `network` for the other two."""
    part: Any = None
    """The effect, or the network, that acts there; which of the two follows from the stage."""


CHAMBERS_LINK = Link("chambers", "chambers")
BEHIND: dict[str, tuple[Stage, ...]] = {
    "line": ("line",),
    "chambers": ("line", "material"),
    "material": ("material",),
    NETWORK: ("body", "sensor"),
    "body": ("body", "sensor"),
    "sensor": ("sensor",),
}
"""Stages whose output is the signal behind a link of each kind, until a later link replaces it."""


@dataclass(eq=False)
class Signal:
    """The signal between two links. Leading shape (B,) of a step, (R, T) of a scan."""

    value: Tensor
    """(..., m) actuation in front of the network, (..., n, 3) key points in mm behind it."""
    pressure: Tensor | None = None
    """(..., m) chamber pressure, once the chambers are passed, in the arm's unit."""
    direction: Tensor | None = None
    """(..., m) direction of change, once the chambers are passed."""

    def behind_chambers(self) -> tuple[Tensor, Tensor]:
        """Pressure and direction, (..., m) each, of a signal that has passed the chambers."""
        assert self.pressure is not None
        assert self.direction is not None
        return self.pressure, self.direction


@dataclass(frozen=True, eq=False)
class Taps:
    """Signals and memories recorded along the chain; leading shape (B,) of one instant, (R, T) of a
    scan."""

    pressure: Tensor
    """(..., m) chamber pressure, behind the line effects, in the arm's unit."""
    direction: Tensor
    """(..., m) direction of change."""
    memory: dict[str, Tensor]
    """(..., ...) memory of each effect that the signal has passed."""
    behind: dict[Stage, Tensor]
    """Signal behind the effects of each stage that it has passed: (..., m) actuation in the
    arm's unit behind `line` and `material`, (..., n, 3) key points in mm behind `body` and
    `sensor`. An effect that is added to a stage sees it."""


class Before(NamedTuple):
    """Signals behind each stage before the first row of runs: (R, m) for line and material,
    (R, n, 3) in mm for body and sensor."""

    resting: dict[Stage, Tensor]
    """Those of the arm at rest."""
    held: dict[Stage, Tensor]
    """Those of the arm held at the actuation with which the run begins; behind the material those
    at rest, because its effects follow from there."""


class Resting:
    """Chain mode for an arm without history at a constant actuation."""

    def __init__(self):
        self.memory: dict[str, Tensor] = {}

    def direction(self, chain: "Chain", chamber: Tensor) -> Tensor:
        """(B, m) zeros: no chamber has a direction yet."""
        return torch.zeros_like(chamber)

    def effect(self, link: Link, signal: Signal) -> Tensor:
        """Signal behind an effect whose memory is that of rest."""
        self.memory[link.name] = link.part.rest(signal.value)
        return link.part.apply(signal.value, self.memory[link.name])

    def network(self, link: Link, signal: Signal) -> Tensor:
        """(B, n, 3) key points in mm."""
        network = link.part
        if not network.remembers:
            return network(signal.value, signal.direction)
        self.memory[NETWORK] = network.rest(signal.value)
        return network(signal.value, signal.direction, self.memory[NETWORK])


class Stepping:
    """Chain mode for one time step of a batch of arms."""

    def __init__(self, state: ArmState, context: Context):
        """state: arms before the step; context: duration of the step and temperature."""
        self.anchor, self.last = state.anchor, state.direction
        self.memory, self.context = dict(state.memory), context

    def direction(self, chain: "Chain", chamber: Tensor) -> Tensor:
        """(B, m) direction of change after the step."""
        self.anchor, direction = direction_step(self.anchor, self.last, chamber, chain.band)
        self.context = replace(self.context, pressure=chamber)
        return direction

    def effect(self, link: Link, signal: Signal) -> Tensor:
        """Signal behind an effect whose memory has followed for the step."""
        name = link.name
        self.memory[name], value = link.part.step(self.memory[name], signal.value, self.context)
        return value

    def network(self, link: Link, signal: Signal) -> Tensor:
        """(B, n, 3) key points in mm."""
        network = link.part
        if not network.remembers:
            return network(signal.value, signal.direction)
        hidden = network.advance(
            self.memory[NETWORK], signal.value, signal.direction, self.context.dt_s
        )
        self.memory[NETWORK] = hidden
        return network(signal.value, signal.direction, hidden)


class Standing(Stepping):
    """Chain mode for arms that came straight from rest and were held for STOOD_S.

    Lags and oscillations have died away; walls and a recurrent network have followed for that time.
    """

    def __init__(self, state: ArmState):
        """state: arms at rest, before they are held at another actuation.

        The recording begins afterwards, so that no time has elapsed in it yet.
        """
        held = torch.full_like(state.pressure[:, 0], STOOD_S)
        super().__init__(state, Context(held, torch.zeros_like(held)))

    def effect(self, link: Link, signal: Signal) -> Tensor:
        """Signal behind an effect that has followed (`Effect.follows`) or reached steady state."""
        if link.part.follows:
            return super().effect(link, signal)
        self.memory[link.name] = link.part.rest(signal.value)
        return link.part.apply(signal.value, self.memory[link.name])

    def network(self, link: Link, signal: Signal) -> Tensor:
        """(B, n, 3) key points in mm.

        The state of a recurrent network stays that of rest; a callable begins as it says itself.
        """
        network = link.part
        if not network.remembers:
            return network(signal.value, signal.direction)
        if isinstance(network, CallableNetwork):
            hidden = self.memory[NETWORK] = network.rest(signal.value)
        else:
            hidden = network.advance(
                self.memory[NETWORK], signal.value, signal.direction, self.context.dt_s
            )
        return network(signal.value, signal.direction, hidden)


class Scanning:
    """Chain mode for every row of a history at once."""

    def __init__(
        self,
        start: dict[str, Tensor],
        context: Context,
        rows: Callable[[Tensor], Tensor] | None = None,
        direction: Tensor | None = None,
        history: History | None = None,
        keeps: bool = True,
        known: Mapping[str, Tensor] | None = None,
    ):
        """Set where the scan starts and which rows it computes.

        start: (R, ...) memory of each effect before the first row; context: (R, T) times and
        temperatures; rows: picks the rows (S, ...) of a (R, T, ...) tensor that the network and all
        effects behind it compute, which must then have no memory (None: every row); direction: (R,
        T, m) direction of change where it is known, as in a window of a longer scan; history: the
        runs that are scanned, which networks of whole runs need; keeps: whether memories are kept
        where there are very many rows and all are asked for; known: memory (R, T, ...) of effects
        that need not be followed, because they saw the same signal before.
        """
        self.history, self.keeps, self.groups = history, keeps, None
        self.known = known or {}
        if history is not None and _mostly_padding(history):
            self.groups = history.groups
        self.start, self.context, self.rows, self.given = start, context, rows, direction
        self.memory: dict[str, Tensor] = {}

    def context_at(self, signal: Signal) -> Context:
        """Times, temperatures and, behind the line, the chambers' pressure along a signal."""
        if signal.pressure is None:
            return self.context
        return replace(self.context, pressure=signal.pressure)

    @torch.no_grad()
    def direction(self, chain: "Chain", chamber: Tensor) -> Tensor:
        """(R, T, m) direction of change; every run starts from rest."""
        if self.given is not None:
            return self.given
        return self._by_length(
            lambda along: direction_scan(along, chain.band, chain.rest)[1], chamber
        )

    def effect(self, link: Link, signal: Signal) -> Tensor:
        """Signal behind an effect whose memory has followed every row; see `keeps`."""
        part, value = link.part, signal.value
        if self.rows is not None and link.stage in ("body", "sensor"):
            return part.apply(value, value[..., :0, 0])
        start, context = self.start[link.name], self.context_at(signal)
        keeps = self.rows is None and self.keeps
        if _very_many(value) and (not keeps or self.groups is not None):
            answer, whole = torch.zeros_like(value), None
            for place, memory in _followed(part, start, value, context, self.groups):
                answer[place] = part.apply(value[place], memory)
                if keeps:
                    if whole is None:
                        whole = memory.new_zeros(*value.shape[:2], *memory.shape[2:])
                    whole[place] = memory
            if whole is not None:
                self.memory[link.name] = whole
            return answer
        known = self.known.get(link.name)
        memory = memory_along(part, start, value, context) if known is None else known
        self.memory[link.name] = memory
        return part.apply(value, memory)

    def network(self, link: Link, signal: Signal) -> Tensor:
        """(R, T, n, 3), or (S, n, 3), key points in mm."""
        (_, direction), actuation, network = signal.behind_chambers(), signal.value, link.part
        if network.whole_runs:
            points = network.along(actuation, self.history, self.start.get(NETWORK))
            return points if self.rows is None else self.rows(points)
        if self.rows is not None:
            actuation, direction = self.rows(actuation), self.rows(direction)
        if network.remembers:
            return network(actuation, direction, network.scan(actuation, direction))
        if self.rows is None and _very_many(actuation):
            return self._by_length(partial(_in_blocks, network), actuation, direction)
        return network(actuation, direction)

    def _by_length(self, along: Callable[..., Tensor], *signals: Tensor) -> Tensor:
        """(R, T, ...) result of a function of signals (R, T, ...), group of runs by group.

        Where most rows are padding and there are no gradients: the padding behind a group is 0.
        """
        if self.groups is None or not _very_many(signals[0]):
            return along(*signals)
        answer = None
        for runs, steps in self.groups:
            found = along(*(signal[runs, :steps] for signal in signals))
            if answer is None:
                answer = found.new_zeros(*signals[0].shape[:2], *found.shape[2:])
            answer[runs, :steps] = found
        assert answer is not None, "a history has a run"
        return answer


def _mostly_padding(history: History) -> bool:
    """Whether groups of runs of similar length have less than half of the rows of a history."""
    rows = history.valid.numel()
    return rows > BLOCK_ROWS and 2 * sum(len(run) * long for run, long in history.groups) < rows


def _in_blocks(network: Any, actuation: Tensor, direction: Tensor) -> Tensor:
    """(R, T, n, 3) key points of a static network, BLOCK_ROWS rows at once."""
    flat = (t.flatten(0, 1).split(BLOCK_ROWS) for t in (actuation, direction))
    points = torch.cat([network(*some) for some in zip(*flat, strict=True)])
    return points.view(*actuation.shape[:2], *points.shape[1:])


def _very_many(signal: Tensor) -> bool:
    """Whether a signal (R, T, ...) is followed in blocks of rows: without gradients."""
    return not torch.is_grad_enabled() and signal.shape[0] * signal.shape[1] > BLOCK_ROWS


Place = tuple[slice | Tensor, slice]
"""Runs, as a slice or indices (k,), and steps of a block of rows."""


def _followed(
    effect: Effect,
    start: Tensor,
    signal: Tensor,
    context: Context,
    groups: list[tuple[Tensor, int]] | None = None,
) -> Iterator[tuple[Place, Tensor]]:
    """The memory of an effect along a signal (R, T, ...) from (R, ...), block of rows by block.

    Yields the runs and steps of each block, and its memory. A block follows some whole runs, or a
    part of one from the memory that the part before it ends with: that is all of its state. groups:
    runs of similar length (`History.groups`), behind whose longest one nothing is followed.
    """
    runs, most = signal.shape[:2]
    every: list[tuple[Tensor | None, int]] = [*groups] if groups else [(None, most)]
    for group, steps in every:
        count = runs if group is None else len(group)
        wide, long = max(1, BLOCK_ROWS // steps), min(steps, BLOCK_ROWS)
        for run in range(0, count, wide):
            part = slice(run, min(run + wide, count))
            own = part if group is None else group[part]
            memory = start[own]
            for step in range(0, steps, long):
                place = own, slice(step, min(step + long, steps))
                followed = effect.scan(memory, signal[place], _at(context, place))
                yield place, followed
                memory = followed[:, -1]


def _at(context: Context, place: Place) -> Context:
    """The context (R, T) of some steps of some runs."""

    def part(tensor: Tensor | None) -> Tensor | None:
        return None if tensor is None else tensor[place]

    return Context(
        context.dt_s[place],
        part(context.t_s),
        part(context.temperature_C),
        part(context.pressure),
    )


def memory_along(effect: Effect, start: Tensor, signal: Tensor, context: Context) -> Tensor:
    """(R, T, ...) memory of an effect along a signal (R, T, ...), from (R, ...) before it."""
    if not _very_many(signal):
        return effect.scan(start, signal, context)
    answer = None
    for place, memory in _followed(effect, start, signal, context):
        if answer is None:
            answer = memory.new_empty(*signal.shape[:2], *memory.shape[2:])
        answer[place] = memory
    assert answer is not None
    return answer


def memory_at(
    effect: Effect,
    start: Tensor,
    signal: Tensor,
    context: Context,
    rows: Callable[[Tensor], Tensor],
    history: History | None = None,
) -> Tensor:
    """(S, ...) memory of an effect on some rows of a signal (R, T, ...), from (R, ...) before it.

    rows: picks the rows (S, ...) of a (R, T, ...) tensor. Memory follows every row, of which no
    more than BLOCK_ROWS are held at once; history: the runs, whose padding is left out.
    """
    if not _very_many(signal):
        return rows(effect.scan(start, signal, context))
    runs, steps = signal.shape[:2]
    asked = rows(torch.arange(runs * steps).view(runs, steps))
    run, step = asked // steps, asked % steps
    groups = history.groups if history is not None and _mostly_padding(history) else None
    every, answer = torch.arange(runs), None
    for (own, part), memory in _followed(effect, start, signal, context, groups):
        place = torch.full((runs,), -1)
        place[own] = every[: len(every[own])]
        inside = (place[run] >= 0) & (step >= part.start) & (step < part.stop)
        found = memory[place[run[inside]], step[inside] - part.start]
        if answer is None:
            answer = found.new_empty(len(asked), *found.shape[1:])
        answer[inside] = found
    assert answer is not None
    return answer


class Holding:
    """Chain mode with given memories, for example those of rows of an earlier scan."""

    def __init__(self, memory: dict[str, Tensor]):
        self.memory = memory

    def effect(self, link: Link, signal: Signal) -> Tensor:
        """Signal behind an effect with its given memory."""
        return link.part.apply(signal.value, self.memory[link.name])

    def direction(self, chain: "Chain", chamber: Tensor) -> Tensor:
        """Fail: given memories belong to links behind the chambers."""
        raise AssertionError("memories are given behind the chambers only")

    def network(self, link: Link, signal: Signal) -> Tensor:
        """(..., n, 3) key points in mm of a static network."""
        return link.part(signal.value, signal.direction)


Mode = Resting | Stepping | Standing | Scanning | Holding


class Chain:
    """The links of one arm model and the modes to pass them. Holds references, owns nothing."""

    def __init__(
        self,
        network: Any,
        effects: Mapping[str, Effect],
        rest: Tensor,
        band: Tensor,
        still: Tensor,
        idle: Tensor,
    ):
        """Order the links of a network and its effects.

        effects: in the order of the stages. Each (m,) in the arm's unit: rest, the actuation at
        rest; band, half width of the direction's dead band; still, which chambers never moved;
        idle, their actuation.
        """
        self.net, self.rest, self.band, self.still, self.idle = network, rest, band, still, idle
        links = [Link(effect.stage, name, effect) for name, effect in effects.items()]
        behind = next((i for i, e in enumerate(links) if e.stage in ("body", "sensor")), len(links))
        line = next((i for i, e in enumerate(links) if e.stage != "line"), len(links))
        self.inner = (*links[:line], CHAMBERS_LINK, *links[line:behind])
        self.outer = tuple(links[behind:])
        self.static = (*links[line:behind], Link(NETWORK, NETWORK, network))
        self.links = (*self.inner, self.static[-1], *self.outer)

    def chambers(self, pressure: Tensor) -> Tensor:
        """Chamber pressure (..., m); a chamber that never moved in the data stays where it was."""
        return torch.where(self.still, self.idle, pressure)

    def walk(
        self,
        signal: Signal,
        mode: Mode,
        links: tuple[Link, ...] | None = None,
        behind: dict[Stage, Tensor] | None = None,
    ) -> Signal:
        """Pass a signal through links of the chain (default: all); returns the signal behind the
        last.

        behind: is filled with the signal behind each stage that was passed.
        """
        for link in self.links if links is None else links:
            if link is CHAMBERS_LINK:
                chamber = self.chambers(signal.value)
                signal = Signal(chamber, chamber, mode.direction(self, chamber))
            else:
                through = mode.network if link.stage == NETWORK else mode.effect
                signal = Signal(through(link, signal), signal.pressure, signal.direction)
            if behind is not None:
                behind.update(dict.fromkeys(BEHIND[link.stage], signal.value))
        return signal

    def at_rest(self, pressure: Tensor, taps: bool = False) -> tuple[ArmState, Taps | None]:
        """(B) arms without history at `pressure` (B, m), and on request what each stage sees.

        Without taps the network is left out where no effect behind it needs its key points.
        """
        mode = Resting()
        behind: dict[Stage, Tensor] = {}
        links = self.links if taps or self.outer else self.inner
        signal = self.walk(Signal(pressure), mode, links, behind if taps else None)
        if NETWORK not in mode.memory and self.net.remembers:
            mode.memory[NETWORK] = self.net.rest(pressure)
        state = ArmState(pressure, pressure, torch.zeros_like(pressure), mode.memory)
        if not taps:
            return state, None
        return state, Taps(*signal.behind_chambers(), mode.memory, behind)

    def standing(self, pressure: Tensor, signals: bool = True) -> tuple[ArmState, Before]:
        """Arms before the first row of runs that begin at `pressure` (R, m), and their signals.

        An arm that begins away from rest is assumed to have come straight from rest and to have
        been held for STOOD_S. Without `signals` these are not asked for, and the network is left
        out where nothing needs its key points.
        """
        whole = bool(signals or self.outer or self.net.remembers)
        state, taps = self.at_rest(self.rest.expand(len(pressure), -1), whole)
        resting = taps.behind if taps else {}
        seen = Before(resting, dict(resting))
        away = (pressure != self.rest).any(-1)
        if not away.any():
            return state, seen
        mode = Standing(state)
        there: dict[Stage, Tensor] = {}
        signal = self.walk(Signal(pressure), mode, self.links if whole else self.inner, there)
        stages: tuple[Stage, ...] = ("line", "body", "sensor")
        for stage in stages if whole else ():
            wide = away.view(-1, *[1] * (there[stage].ndim - 1))
            seen.held[stage] = there[stage].where(wide, resting[stage])
        stood = ArmState(pressure, mode.anchor, signal.behind_chambers()[1], mode.memory)
        return state.where(away, stood), seen

    def first_memory(
        self, effect: Effect, seen: Before, at_first: Tensor, pressure: Tensor
    ) -> Tensor:
        """(R, ...) memory before the first row of an effect added behind the others of its stage.

        seen: signals of `standing`; at_first (R, ...): what the effect sees in the first row;
        pressure (R, m): actuation at which each run begins.
        """
        memory = effect.rest((seen.resting if effect.follows else seen.held)[effect.stage])
        away = (pressure != self.rest).any(-1)
        if not effect.follows or not away.any():
            return memory
        time = pressure.new_full((len(pressure),), STOOD_S)
        context = Context(time, None, None, self.chambers(pressure))
        stood = effect.advance(memory, at_first, context)
        return stood.where(away.view(-1, *[1] * (memory.ndim - 1)), memory)

    def step(self, state: ArmState, pressure: Tensor, context: Context) -> tuple[ArmState, Tensor]:
        """State and key points (B, n, 3) in mm after `pressure` (B, m) was held for one step."""
        if self.net.runs_only:
            raise InputError(
                f"{self.net.name} is a function of whole runs and cannot be stepped; give it "
                "'initial_state' and 'step', or 'static = True' if each row depends on its own "
                "actuation alone (docs/your_model.md)"
            )
        mode = Stepping(state, context)
        signal = self.walk(Signal(pressure), mode)
        direction = signal.behind_chambers()[1]
        return ArmState(pressure, mode.anchor, direction, mode.memory), signal.value

    def scan(
        self,
        history: History,
        first: Tensor,
        links: tuple[Link, ...] | None = None,
        memories: bool = True,
    ) -> Taps:
        """Signals and memories in each row of a history whose runs begin at `first`, (R, m).

        links: the links to pass; default all. memories: whether those of effects are kept where
        there are very many rows; they are by far the largest part.
        """
        start = self.standing(first, signals=False)[0].memory
        mode = Scanning(start, context_of(history), history=history, keeps=memories)
        behind: dict[Stage, Tensor] = {}
        signal = self.walk(Signal(history.pressure), mode, links, behind)
        return Taps(*signal.behind_chambers(), mode.memory, behind)

    @torch.no_grad()
    def inputs(self, history: History, first: Tensor) -> tuple[Tensor, Tensor]:
        """(R, T, m) actuation and direction of change that the network sees along a history.

        first: (R, m) actuation at which each run begins. Memories are followed and not kept.
        """
        start = self.standing(first, signals=False)[0].memory
        mode = Scanning(start, context_of(history), history=history, keeps=False)
        signal = self.walk(Signal(history.pressure), mode, self.inner)
        return signal.value, signal.behind_chambers()[1]

    def hold(self, pressure: Tensor, direction: Tensor, memory: dict[str, Tensor]) -> Tensor:
        """Key points (..., n, 3) in mm behind the network, of given memories.

        pressure, direction: (..., m) chamber pressure and direction of change.
        """
        return self.walk(Signal(pressure, pressure, direction), Holding(memory), self.static).value

    def around(self, name: str, taps: Taps) -> tuple[Tensor, Tensor]:
        """(..., m) actuation in front of and behind a material effect, from the taps of a scan."""
        place = next(i for i, link in enumerate(self.static) if link.name == name)
        mode = Holding(taps.memory)
        start = Signal(taps.pressure, taps.pressure, taps.direction)
        before = self.walk(start, mode, self.static[:place])
        return before.value, self.walk(before, mode, self.static[place : place + 1]).value

    @torch.no_grad()
    def followed_around(self, name: str, history: History, first: Tensor) -> tuple[Tensor, Tensor]:
        """(R, T, m) actuation in front of and behind a material effect along a history.

        As `around`, but without the taps of a scan: memories are followed and not kept.
        first: (R, m) actuation at which each run begins.
        """
        place = next(i for i, link in enumerate(self.inner) if link.name == name)
        start = self.standing(first, signals=False)[0].memory
        mode = Scanning(start, context_of(history), history=history, keeps=False)
        before = self.walk(Signal(history.pressure), mode, self.inner[:place])
        return before.value, self.walk(before, mode, self.inner[place : place + 1]).value

    def network_slope(self, actuation: Tensor, direction: Tensor) -> Tensor:
        """(S, n, 3, m) derivative of the key points by the effective actuation, mm a unit.

        actuation, direction: (S, m) in front of a static network.
        """
        return rowwise_jacobian(lambda at: self.net(at, direction), actuation)

    @torch.no_grad()
    def slope(
        self, history: History, first: Tensor, taps: Taps, rows: Callable[[Tensor], Tensor]
    ) -> Tensor:
        """(S, n, 3, m) derivative of the key points by the effective actuation, mm a unit.

        first: (R, m) actuation at which each run begins; taps: those of a scan of the history;
        rows: picks the rows (S, ...) of a (R, T, ...) tensor. Of a network that takes whole runs:
        by an actuation that is offset during the whole run.
        """
        actuation = taps.behind["material"]
        if self.net.whole_runs:
            memory = self.standing(first, signals=False)[0].memory.get(NETWORK)
            return self.net.slope_along(actuation, history, memory, rows)
        return self.network_slope(rows(actuation), rows(taps.direction))

    @torch.no_grad()
    def sensitivities(
        self,
        effect: Effect,
        at: Tensor,
        memory: Tensor,
        slope: Tensor | None,
    ) -> Tensor:
        """(K, S, n, 3) derivative of the key points by each amplitude of an effect at zero, mm.

        at: (S, m) actuation or (S, n, 3) key points, mm, that the effect sees; memory: (S, ...)
        its memory; slope: (S, n, 3, m) `slope` on those rows, which line and material
        effects act through. Effects behind the effect are assumed to pass the change on unchanged.
        """
        changes = effect.sensitivities(at, memory)
        if effect.stage in FRONT:
            changes = torch.einsum("snjm,ksm->ksnj", slope, changes)
        return changes


class RepeatedScan:
    """Prediction (S, n, 3) in mm, by calling, while parameters of some effects change.

    Links in front of the first one that may change are computed once. So is the memory of that
    link, as long as the parameters that it depends on stay equal. Memories follow every row; the
    network, and effects behind it unless one of them has memory, compute the requested rows alone.
    Autograd runs through parameters that require it.
    """

    def __init__(
        self,
        chain: Chain,
        history: History,
        first: Tensor,
        keys: set[str],
        rows: Callable[[Tensor], Tensor],
    ):
        """Compute the signal in front of the first link whose parameters change.

        first: (R, m) actuation at which each run begins; keys: names of the effects whose
        parameters change (empty: those of the network); rows: picks the requested rows (S, ...) of
        a (R, T, ...) tensor.
        """
        self.chain, self.history, self.rows = chain, history, rows
        self.first_pressure = first
        # Runs that begin alike have one memory before their first row.
        self.first = first[:1] if (first == first[:1]).all() else first
        self.thin = all(isinstance(link.part, Memoryless) for link in chain.outer)
        wanted = keys or {NETWORK}
        place = next(i for i, link in enumerate(chain.links) if link.name in wanted)
        self.links = chain.links[place:]
        self.context = context_of(history)
        self.followed: Followed | None = None
        with torch.no_grad():
            front = chain.links[:place]
            self.start = chain.walk(Signal(history.pressure), self._mode(), front)

    def __call__(self) -> Tensor:
        """(S, n, 3) key points in mm, base frame."""
        points = self._walked()[1].value
        return points if self.thin else self.rows(points)

    @torch.no_grad()
    def first_memory(self) -> Tensor:
        """(S, ...) memory of the first effect that changes, on the requested rows."""
        effect, signal = self.links[0].part, self.start
        if self.thin and effect.stage in ("body", "sensor"):  # its signal has these rows alone
            return signal.value[..., :0, 0]
        followed = self._still_followed()
        if followed is not None:
            return self.rows(followed.memory)
        return self.rows(self._walked(self.links[:1])[0].memory[self.links[0].name])

    def _mode(self) -> Scanning:
        """A scan from the memories before the first row, for the present parameters."""
        rows, followed = self.rows if self.thin else None, self._still_followed()
        known = {} if followed is None else {self.links[0].name: followed.memory}
        if followed is not None and self._nothing_follows_behind():
            start = followed.start
        else:
            runs = self.history.runs
            start = self.chain.standing(self.first, signals=False)[0].memory
            start = {name: memory.expand(runs, *memory.shape[1:]) for name, memory in start.items()}
        return Scanning(start, self.context, rows, history=self.history, known=known)

    def _walked(self, links: tuple[Link, ...] | None = None) -> tuple[Scanning, Signal]:
        """The scan and the signal behind links (default: all from the first that changes)."""
        mode = self._mode()
        signal = self.chain.walk(self.start, mode, self.links if links is None else links)
        self._keep(mode)
        return mode, signal

    def _on(self) -> list[Tensor] | None:
        """Parameters that the memory of the first link depends on; None where none can be kept."""
        part = self.links[0].part
        if not isinstance(part, Effect) or isinstance(part, Memoryless):
            return None
        on = [parameter.detach() for parameter in part.memory_parameters()]
        return None if on and torch.is_grad_enabled() else on

    def _keep(self, mode: Scanning) -> None:
        """Keep the memory of the first link, where it was followed at once."""
        on, memory = self._on(), mode.memory.get(self.links[0].name)
        if on is None or memory is None or memory.requires_grad or _very_many(self.start.value):
            return
        self.followed = Followed([each.clone() for each in on], memory, mode.start)

    def _still_followed(self) -> "Followed | None":
        """The memory of the first link that was kept, if its parameters are still the same."""
        if self.followed is None:
            return None
        on = self._on()
        if on is None or not all(map(torch.equal, on, self.followed.on)):
            return None
        return self.followed

    def _nothing_follows_behind(self) -> bool:
        """Whether no link behind the first one has a memory that could begin otherwise."""
        parts = [link.part for link in self.links[1:]]
        effects = [part for part in parts if isinstance(part, Effect)]
        return not self.chain.net.remembers and all(isinstance(e, Memoryless) for e in effects)


class Followed(NamedTuple):
    """The memory of an effect along a history, and what it depends on."""

    on: list[Tensor]
    """The parameters that it depends on, as they were."""
    memory: Tensor
    """(R, T, ...) the memory in every row."""
    start: dict[str, Tensor]
    """(R, ...) memory of each effect before the first row."""


def context_of(history: History) -> Context:
    """(R, T) times and temperatures of a history, for the effects' memories."""
    return Context(history.dt_s, history.t_s.float(), history.temperature_C)
