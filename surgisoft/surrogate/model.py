"""The arm model: line effects -> material effects -> network -> body effects -> sensor effects."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from surgisoft.surrogate import direction as directions
from surgisoft.surrogate.arm import ArmSpec, ArmState
from surgisoft.surrogate.backbone import Backbone
from surgisoft.surrogate.effects import STAGES, ArmFacts, Context, Effect, Stage
from surgisoft.surrogate.history import History
from surgisoft.surrogate.networks import ConstantCurvature, HawNN, RecurrentArm

if TYPE_CHECKING:
    from surgisoft.surrogate.known_error import KnownError

AWAY_SHARE = 0.15
"""A run begins away from rest where a chamber's measured actuation is farther from it than this
share of its range."""
STOOD_S = 10.0
"""Time for which an arm has stood where a run begins away from rest, s."""
NETWORK = "network"
"""Key of a remembering network's state in `ArmState.memory`."""


@dataclass(frozen=True)
class Trace:
    """What the network and the material effects see in each row of a history."""

    pressure: Tensor
    """(R, T, m) chamber pressure, after the line effects."""
    direction: Tensor
    """(R, T, m) direction of change."""
    memory: dict[str, Tensor]
    """(R, T, ...) memory of each line and material effect."""


class ArmModel(nn.Module):
    """Batched, differentiable arm: `step` for worlds, `predict` for whole recordings.

    Both are built from the same `advance`, `scan` and `apply` of each part and agree.
    """

    training_residuals: "KnownError | None" = None
    """Residuals of the model on rows of its own fit; None where they are not known."""

    def __init__(
        self,
        spec: ArmSpec,
        network: HawNN | ConstantCurvature | RecurrentArm,
        effects: dict[str, Effect] | None = None,
        rest_mm: Tensor | None = None,
        validation: dict | None = None,
    ):
        """`rest_mm` (n, 3): key points at rest, base frame; `validation`: the validated error."""
        super().__init__()
        effects = effects or {}
        order = sorted(effects, key=lambda name: STAGES.index(effects[name].stage))
        self.spec = spec
        self.network = network
        self.effects = nn.ModuleDict({name: effects[name] for name in order})
        self.validation = dict(validation or {})
        rest = torch.zeros(spec.key_points, 3) if rest_mm is None else rest_mm.float()
        self.register_buffer("rest_mm", rest)
        self.register_buffer("band", torch.tensor(spec.band, dtype=torch.float32))
        still = torch.tensor([value is not None for value in spec.idle])
        self.register_buffer("still", still, persistent=False)
        idle = torch.tensor([value or 0.0 for value in spec.idle])
        self.register_buffer("idle", idle, persistent=False)
        self.register_buffer("rest", torch.tensor(spec.rest, dtype=torch.float32))

    @property
    def facts(self) -> ArmFacts:
        """What effects may know of this arm, on the CPU."""
        return arm_facts(self.spec, self.rest_mm)

    def stage(self, stage: Stage) -> list[tuple[str, Effect]]:
        """The effects of one stage, by name, in order."""
        return [(name, effect) for name, effect in self.effects.items() if effect.stage == stage]

    def chambers(self, pressure: Tensor) -> Tensor:
        """Chamber pressure (..., m) with the still chambers at where they stood."""
        return torch.where(self.still, self.idle, pressure)

    @property
    def remembers(self) -> bool:
        """Whether the network itself has a state."""
        return isinstance(self.network, RecurrentArm)

    def backbone(self, samples: int = 21, degree: int = 3) -> Backbone:
        """The B-spline through this arm's key points."""
        return Backbone.through(self.rest_mm, samples, degree).to(self.rest_mm.device)

    def initial_state(self, batch: int = 1, pressure: Tensor | None = None) -> ArmState:
        """(B) arms without history at `pressure` (B, m) in the arm's unit.

        Without a pressure: at rest (`ArmSpec.rest`).
        """
        if pressure is None:
            pressure = self.rest.expand(batch, -1)
        memory = {}
        signal = pressure
        for stage in ("line", "material"):
            for name, effect in self.stage(stage):
                memory[name] = effect.rest(signal)
                signal = effect.apply(signal, memory[name])
            signal = self.chambers(signal)
        if self.remembers:
            memory[NETWORK] = self.network.rest(pressure)
        if self.stage("body") or self.stage("sensor"):
            points = self._network(signal, torch.zeros_like(pressure), memory)
            for name, effect in self.stage("body") + self.stage("sensor"):
                memory[name] = effect.rest(points)
                points = effect.apply(points, memory[name])
        return ArmState(pressure, pressure, torch.zeros_like(pressure), memory)

    def first_pressure(self, history: History) -> Tensor:
        """(R, m) actuation at which each run begins, in the arm's unit.

        At rest (`ArmSpec.rest`); or at the first row, where its measured actuation is away from
        rest: a chamber's pressure does not jump, so the arm has been there. A command may jump in
        the first row, so it does not decide.
        """
        rest = self.rest.expand(history.runs, -1)
        if history.stood is None:
            return rest
        span = torch.tensor(self.spec.span, device=rest.device)
        away = ((history.stood - rest).abs() > AWAY_SHARE * span) & ~self.still
        return torch.where(away.any(-1, keepdim=True), history.pressure[:, 0], rest)

    def first_state(self, pressure: Tensor) -> ArmState:
        """(R) arms before the first row of runs that begin at `first_pressure`, (R, m).

        Nobody knows how such an arm came there. It is taken to have come straight from rest and to
        have stood for STOOD_S: lags and oscillations have died away, the material remembers.
        """
        return self.before(pressure)[0]

    def before(self, pressure: Tensor) -> tuple[ArmState, dict[Stage, Tensor]]:
        """The same, and what an effect added behind the others of each stage sees there.

        (R, m) for line and material, (R, n, 3) in mm for body and sensor.
        """
        state = self.initial_state(len(pressure))
        seen = self._seen_at_rest(state)
        away = (pressure != self.rest).any(-1)
        if not away.any():
            return state, seen
        memory, there, signal = dict(state.memory), {}, pressure
        for name, effect in self.stage("line"):
            memory[name] = effect.rest(signal)
            signal = effect.apply(signal, memory[name])
        there["line"] = signal = self.chambers(signal)
        context = Context(pressure.new_full((len(pressure),), STOOD_S), None, None, signal)
        anchor, direction = directions.advance(state.anchor, state.direction, signal, self.band)
        for name, effect in self.stage("material"):
            memory[name], signal = effect.step(memory[name], signal, context)
        hidden = memory
        if self.remembers:
            hidden = {NETWORK: self.network.advance(memory[NETWORK], signal, direction)}
        points = self._network(signal, direction, hidden)
        for stage in ("body", "sensor"):
            for name, effect in self.stage(stage):
                memory[name] = effect.rest(points)
                points = effect.apply(points, memory[name])
            there[stage] = points
        for stage, signal in there.items():
            seen[stage] = signal.where(away.view(-1, *[1] * (signal.ndim - 1)), seen[stage])
        return state.where(away, ArmState(pressure, anchor, direction, memory)), seen

    def first_memory(self, effect: Effect, seen: Tensor, signal: Tensor, first: Tensor) -> Tensor:
        """Memory before the first row of an effect that is added behind the others of its stage.

        seen: what `before` says of its stage; signal (R, ...): what it sees in the first row;
        first (R, m): `first_pressure`.
        """
        memory = effect.rest(seen)
        away = (first != self.rest).any(-1)
        if effect.stage != "material" or not away.any():
            return memory
        context = Context(first.new_full((len(first),), STOOD_S), None, None, self.chambers(first))
        stood = effect.advance(memory, signal, context)
        return stood.where(away.view(-1, *[1] * (memory.ndim - 1)), memory)

    def _seen_at_rest(self, state: ArmState) -> dict[Stage, Tensor]:
        """What an effect added behind the others of each stage sees of arms at rest."""
        seen, signal = {}, state.pressure
        for stage in ("line", "material"):
            for name, effect in self.stage(stage):
                signal = effect.apply(signal, state.memory[name])
            seen[stage] = signal = self.chambers(signal)
        points = self._network(signal, torch.zeros_like(signal), state.memory)
        for stage in ("body", "sensor"):
            for name, effect in self.stage(stage):
                points = effect.apply(points, state.memory[name])
            seen[stage] = points
        return seen

    def _network(self, pressure: Tensor, direction: Tensor, memory: dict[str, Tensor]) -> Tensor:
        if self.remembers:
            return self.network(pressure, direction, memory[NETWORK])
        return self.network(pressure, direction)

    def step(
        self,
        state: ArmState,
        dp: Tensor,
        dt: Tensor | float,
        temperature_C: Tensor | None = None,
    ) -> tuple[ArmState, Tensor]:
        """Change the actuation by dp (B, m), in the arm's unit, over dt seconds.

        temperature_C: (B,) of the room, degrees Celsius; None: that of the effects' reference.
        Returns the new state and the key points (B, n, 3) in mm, base frame.
        """
        pressure = state.pressure + dp
        dt = torch.as_tensor(dt, dtype=pressure.dtype, device=pressure.device).expand(len(pressure))
        memory = dict(state.memory)
        context = Context(dt, None, temperature_C)

        def advance(stage: Stage, signal: Tensor) -> Tensor:
            for name, effect in self.stage(stage):
                memory[name], signal = effect.step(memory[name], signal, context)
            return signal

        chamber = self.chambers(advance("line", pressure))
        context = replace(context, pressure=chamber)
        anchor, direction = directions.advance(state.anchor, state.direction, chamber, self.band)
        effective = advance("material", chamber)
        if self.remembers:
            memory[NETWORK] = self.network.advance(memory[NETWORK], effective, direction)
        points = advance("sensor", advance("body", self._network(effective, direction, memory)))
        return ArmState(pressure, anchor, direction, memory), points

    def trace(self, history: History) -> Trace:
        """What `shape` needs in each row; every run starts from `first_pressure`."""
        context = context_of(history)
        start = self.first_state(self.first_pressure(history)).memory
        memory, signal = {}, history.pressure
        for name, effect in self.stage("line"):
            memory[name] = effect.scan(start[name], signal, context)
            signal = effect.apply(signal, memory[name])
        chamber = signal = self.chambers(signal)
        _, direction = directions.trace(chamber, self.band, self.rest)
        for name, effect in self.stage("material"):
            memory[name] = effect.scan(start[name], signal, context)
            signal = effect.apply(signal, memory[name])
        return Trace(chamber, direction, memory)

    def effective(self, pressure: Tensor, memory: dict[str, Tensor]) -> Tensor:
        """Effective actuation (..., m) from chamber pressure (..., m) and memories."""
        for name, effect in self.stage("material"):
            pressure = effect.apply(pressure, memory[name])
        return pressure

    def shape(self, pressure: Tensor, direction: Tensor, memory: dict[str, Tensor]) -> Tensor:
        """Key points (..., n, 3) in mm before body and sensor effects, of a static network."""
        return self.network(self.effective(pressure, memory), direction)

    def predict(self, history: History) -> Tensor:
        """Key points (R, T, n, 3) in mm, base frame, for whole runs; padding rows are void."""
        trace = self.trace(history)
        if self.remembers:
            effective = self.effective(trace.pressure, trace.memory)
            hidden = self.network.scan(effective, trace.direction)
            points = self.network(effective, trace.direction, hidden)
        else:
            points = self.shape(trace.pressure, trace.direction, trace.memory)
        outer = self.stage("body") + self.stage("sensor")
        if outer:
            context = replace(context_of(history), pressure=trace.pressure)
            start = self.first_state(self.first_pressure(history)).memory
            for name, effect in outer:
                points = effect.apply(points, effect.scan(start[name], points, context))
        return points

    def summary(self) -> str:
        """One line: inputs, network, effects."""
        inputs = "pressure+direction" if self.network.directions else "pressure"
        effects = " + ".join(self.effects) or "none"
        return (
            f"{type(self.network).__name__} ({inputs}), {self.spec.chambers} chambers in "
            f"{self.spec.unit} ({self.spec.actuation}), {self.spec.key_points} key points, "
            f"effects: {effects}"
        )


def arm_facts(spec: ArmSpec, rest_mm: Tensor) -> ArmFacts:
    """What effects may know of the arm whose key points at rest are rest_mm, (n, 3) in mm."""
    low, high, rest = (torch.tensor(x) for x in (spec.low, spec.high, spec.rest))
    rest_mm = rest_mm.detach().cpu()
    return ArmFacts(
        low, high, rest, rest_mm, spec.gravity, spec.length_mm, spec.unit, spec.temperature_C
    )


def context_of(history: History) -> Context:
    """(R, T) times and temperatures of a history, for the effects' memories."""
    return Context(history.dt_s, history.t_s.float(), history.temperature_C)
