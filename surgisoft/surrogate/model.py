"""The arm model: a network between line and material effects in front, body and sensor behind."""

import dataclasses
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from surgisoft.errors import InputError, counted
from surgisoft.on_device import on_device
from surgisoft.surrogate.arm import ArmSpec, ArmState
from surgisoft.surrogate.backbone import ArcBackbone, Backbone, require_body
from surgisoft.surrogate.callables.network import CallableNetwork
from surgisoft.surrogate.callables.predicted import PredictedNetwork
from surgisoft.surrogate.chain import Chain, Taps
from surgisoft.surrogate.effects import STAGES, ArmFacts, Context, Effect, Stage
from surgisoft.surrogate.fitted_rows import FittedRows
from surgisoft.surrogate.history import History
from surgisoft.surrogate.interval import LEVEL, ErrorInterval, distance_to
from surgisoft.surrogate.networks import (
    ConstantCurvature,
    HawEnsemble,
    HawNN,
    KernelArm,
    RecurrentArm,
)
from surgisoft.surrogate.training_residuals import PAST_ROWS, ROWS, Past, TrainingResiduals
from surgisoft.units import actuation_word

AWAY_SHARE = 0.15
"""A run begins away from rest where a chamber's measured actuation is farther from it than this
share of its range."""
LEFT_OF_MOTION = 0.35
"""Most error of a model of an arm, as a share of the motion of the key points: with a correct
set-up it predicts most of the motion, whatever physics is missing."""

Network = (
    HawNN
    | HawEnsemble
    | KernelArm
    | ConstantCurvature
    | RecurrentArm
    | CallableNetwork
    | PredictedNetwork
)
"""Networks that the chain may have; the last two stand for models of other origin."""


@dataclass(frozen=True)
class Validation:
    """Error of a model on the validation rows of its fit."""

    rmse_mm: float | None = None
    """RMSE of the distance of all key points, mm; None where the model was never validated."""
    per_key_point_mm: tuple[float | None, ...] = ()
    """RMSE of each key point's distance, base to tip, mm; None where it was never measured."""
    rows: int = 0
    """Number of validation rows."""
    noise_mm: float | None = None
    """Standard deviation of one coordinate of the key points in those rows, mm, where known."""
    interval: ErrorInterval | None = None
    """How far measured key points lie from predicted ones; None for models that were fitted before
    this was computed, and after effects were added to the fitted ones."""
    jump_mm: float | None = None
    """Level of the jumps that the arm makes by itself in the recordings of the fit, mm
    (`measurement.jumps.own_level_mm`); None where it is not known."""


@dataclass(frozen=True, eq=False)
class PredictionInterval:
    """Balls around predicted key points in which measured ones lie."""

    key_points_mm: Tensor
    """(R, T, n, 3) predicted key points, mm, base frame."""
    radius_mm: Tensor
    """(R, T, n) radius around each, mm."""
    coverage: float
    """Share (0..1) of measured key points that lie inside, on runs like those of the fit."""


class ArmModel(nn.Module):
    """Batched, differentiable arm: `step` advances simulated arms, `predict` a whole recording.

    Both pass signals through the same `Chain` and agree.
    """

    effects: dict[str, Effect]
    network: Network
    rest_mm: Tensor
    band: Tensor
    still: Tensor
    idle: Tensor
    rest: Tensor

    training_residuals: TrainingResiduals | None = None
    """Residuals of the model on rows of its fit; None where they are not known."""
    fitted_rows: FittedRows | None = None
    """Which measured rows the model was fitted to; None for models that were fitted before this
    was kept."""

    def __init__(
        self,
        spec: ArmSpec,
        network: Network,
        effects: dict[str, Effect] | None = None,
        rest_mm: Tensor | None = None,
        validation: Validation | None = None,
    ):
        """rest_mm: (n, 3) key points at rest, mm, base frame."""
        super().__init__()
        effects = effects or {}
        order = sorted(effects, key=lambda name: STAGES.index(effects[name].stage))
        self.spec = spec
        self.network = network
        self.effects = nn.ModuleDict(  # type: ignore[assignment]  # a mapping of modules
            {name: effects[name] for name in order}
        )
        self.validation = validation or Validation()
        rest = torch.zeros(spec.key_points, 3) if rest_mm is None else rest_mm.float()
        self.register_buffer("rest_mm", rest)
        self.register_buffer("band", torch.tensor(spec.band, dtype=torch.float32))
        still = torch.tensor([value is not None for value in spec.idle])
        self.register_buffer("still", still, persistent=False)
        idle = torch.tensor([value or 0.0 for value in spec.idle])
        self.register_buffer("idle", idle, persistent=False)
        self.register_buffer("rest", torch.tensor(spec.rest, dtype=torch.float32))

    def replace(
        self,
        *,
        spec: ArmSpec | None = None,
        network: Network | None = None,
        effects: dict[str, Effect] | None = None,
        rest_mm: Tensor | None = None,
        validation: Validation | None = None,
    ) -> "ArmModel":
        """A model with some parts replaced; it shares all others with this one.

        Training residuals and prediction intervals belong to the network and effects that were
        fitted together: a model with another network or other effects has none.
        """
        changed = network is not None or effects is not None
        kept = self.validation
        if changed and kept.interval is not None:
            kept = dataclasses.replace(kept, interval=None)
        fresh = ArmModel(
            spec or self.spec,
            network or self.network,
            dict(self.effects) if effects is None else effects,
            self.rest_mm if rest_mm is None else rest_mm,
            validation or kept,
        )
        if not changed:
            fresh.training_residuals = self.training_residuals
        fresh.fitted_rows = self.fitted_rows
        return fresh.to(self.rest_mm.device).train(self.training)

    @torch.no_grad()
    def residuals_on(self, histories: Iterable[History], rows: int = ROWS) -> TrainingResiduals:
        """Residuals of this model on at most `rows` measured rows of histories, evenly thinned."""
        parts, runs, begun = [], 0, []
        for history in histories:
            residual = history.rows(history.key_points - self.predict(history))
            direction = history.rows(self.trace(history).direction)
            run = history.run_of_row + runs
            runs += history.runs
            begun.append(history.stood)
            given = history.rows(history.t_s), history.rows(history.pressure)
            parts.append((*given, run, direction, residual))
        t_s, actuation, run, direction, residual = map(torch.cat, zip(*parts, strict=True))
        seen = torch.nonzero((~residual.isnan()).all(-1).any(-1)).flatten()
        chosen = seen[:: max(1, -(-len(seen) // rows))].contiguous()
        thin = max(1, -(-len(t_s) // PAST_ROWS))
        every = torch.arange(0, len(t_s), thin, device=t_s.device)
        kept = torch.cat([every, chosen]).unique()
        row = torch.searchsorted(kept, chosen)
        known = [each for each in begun if each is not None]
        # Of a history with more rows than are kept, a run of few rows may have none.
        named = run[kept].unique()
        stood = torch.cat(known)[named].float() if len(known) == len(begun) else None
        return TrainingResiduals(
            actuation=actuation[chosen].float(),
            direction=direction[chosen].float(),
            residual_mm=residual[chosen].float(),
            past=Past(t_s[kept], actuation[kept].float(), run[kept].int(), row.int(), stood),
        )

    @property
    def chain(self) -> Chain:
        """The chain of this model's links."""
        return Chain(self.network, self.effects, self.rest, self.band, self.still, self.idle)

    def freeze(self) -> None:
        """Fix what the network's program takes from its parameters, so that it can be a graph."""
        if isinstance(self.network, ConstantCurvature):
            self.network.fix_sections()

    @property
    def facts(self) -> ArmFacts:
        """The properties of this arm that effects may use, on the CPU."""
        return arm_facts(self.spec, self.rest_mm)

    def stage(self, stage: Stage) -> list[tuple[str, Effect]]:
        """The effects of one stage, by name, in order."""
        return [(name, effect) for name, effect in self.effects.items() if effect.stage == stage]

    @property
    def remembers(self) -> bool:
        """Whether key points depend on the past in the network itself, so that every row counts."""
        network = self.network
        return network.remembers or (isinstance(network, CallableNetwork) and network.whole_runs)

    @property
    def takes_effects(self) -> bool:
        """Whether effects can be placed around the network: not around the recurrent baseline."""
        return not isinstance(self.network, RecurrentArm)

    @property
    def trainable(self) -> bool:
        """Whether the network has weights that can be trained together with effects."""
        return isinstance(self.network, HawNN | HawEnsemble | ConstantCurvature)

    def backbone(self, samples: int = 21, degree: int = 3) -> Backbone | ArcBackbone:
        """The B-spline through this arm's key points; an arc for an arm with one key point."""
        if self.spec.key_points == 1:
            return ArcBackbone.of(samples).to(self.rest_mm.device)
        return Backbone.through(self.rest_mm, samples, degree).to(self.rest_mm.device)

    def require_body(self, label: str) -> None:
        """Raise InputError where the body does not follow from the key points, see `backbone`."""
        require_body(self.spec, self.rest_mm.cpu(), label)

    def initial_state(self, batch: int = 1, pressure: Tensor | None = None) -> ArmState:
        """(B) arms without history at `pressure` (B, m) in the arm's unit.

        Without a pressure: at rest (`ArmSpec.rest`).
        """
        if pressure is None:
            pressure = self.rest.expand(batch, -1)
        return self.chain.at_rest(pressure)[0]

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

        A recording does not state what happened before. The arm is assumed to have come straight
        from rest and to have been held for `STOOD_S`: lags and oscillations have died away, the
        material remembers.
        """
        return self.chain.standing(pressure, signals=False)[0]

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
        dt = on_device(dt, pressure).expand(len(pressure))
        return self.chain.step(state, pressure, Context(dt, None, temperature_C))

    def trace(self, history: History) -> Taps:
        """Inputs of the network, and memories in front of it, in each row of a history.

        Every run starts from `first_pressure`.
        """
        chain = self.chain
        return chain.scan(history, self.first_pressure(history), chain.inner)

    @property
    def row_wise(self) -> bool:
        """Whether the key points of a row follow from what the network sees in it (`inputs`)."""
        return not (self.remembers or self.chain.outer)

    def inputs(self, history: History) -> tuple[Tensor, Tensor]:
        """(R, T, m) actuation and direction of change that the network sees in each row."""
        return self.chain.inputs(history, self.first_pressure(history))

    def shape(self, pressure: Tensor, direction: Tensor, memory: dict[str, Tensor]) -> Tensor:
        """Key points (..., n, 3) in mm before body and sensor effects, of a static network.

        Chamber pressure and direction (..., m) and memories are those of rows of a `trace`.
        """
        return self.chain.hold(pressure, direction, memory)

    def predict(self, history: History) -> Tensor:
        """Key points (R, T, n, 3) in mm, base frame, for whole runs; padding rows are void."""
        return self.scan(history, memories=False).behind["sensor"]

    def scan(self, history: History, memories: bool = True) -> Taps:
        """Signals behind each stage, key points too, and memories in each row of a history.

        memories: whether those are kept where there are very many rows.
        """
        return self.chain.scan(history, self.first_pressure(history), memories=memories)

    @property
    def states_interval(self) -> bool:
        """Whether `predict_interval` knows how far off this model may be."""
        interval = self.validation.interval
        return interval is not None and (
            not any(interval.growth) or self.training_residuals is not None
        )

    @torch.no_grad()
    def error_radius(self, actuation: Tensor, coverage: float = LEVEL) -> Tensor:
        """(S, n) radii in mm around predicted key points within which measured ones lie.

        actuation: (S, m) in the arm's unit; coverage: share (0..1) of measured key points to
        enclose, on runs like those of the fit. Raises InputError where the model states none.
        """
        if not 0 < coverage < 1:
            raise InputError(f"coverage {coverage:g}: expected a share between 0 and 1")
        if not self.states_interval:
            raise InputError(
                "this model states no prediction interval: it was fitted by an earlier version, "
                "or effects were added to it since; fit it again"
            )
        interval, distance = self.validation.interval, torch.zeros_like(actuation[:, 0])
        assert interval is not None
        if any(interval.growth) and self.training_residuals is not None:
            span = torch.tensor(self.spec.span, dtype=actuation.dtype, device=actuation.device)
            reference = self.training_residuals.actuation.to(actuation)
            distance = distance_to(actuation, reference, span)
        return interval.radius_mm(distance, coverage)

    @torch.no_grad()
    def predict_interval(self, history: History, coverage: float = LEVEL) -> PredictionInterval:
        """Predicted key points of whole runs, and the radii within which measured ones lie.

        Arguments and error as those of `error_radius`.
        """
        radius = self.error_radius(history.pressure.flatten(0, 1), coverage)
        shaped = radius.view(*history.valid.shape, -1)
        return PredictionInterval(self.predict(history), shaped, coverage)

    def summary(self) -> str:
        """One line of text: inputs, network and effects."""
        inputs = actuation_word(self.spec.unit) + "+direction" * self.network.directions
        effects = " + ".join(self.effects) or "none"
        kind = type(self.network).__name__
        if isinstance(self.network, HawEnsemble):
            kind = f"{self.network.members} x HawNN"
        if isinstance(self.network, KernelArm):
            kind = f"arcs + kernel regression on {self.network.landmarks} landmarks"
            kind += " with memory" * self.network.remembers
        if isinstance(self.network, CallableNetwork):
            kind = f"callable {self.network.name}"
        if isinstance(self.network, PredictedNetwork):
            kind = f"predictions of {self.network.name}"
        return (
            f"{kind} ({inputs}), {counted(self.spec.chambers, 'chamber')} in {self.spec.unit} "
            f"({self.spec.actuation}), {counted(self.spec.key_points, 'key point')}, "
            f"effects: {effects}"
        )


def arm_facts(spec: ArmSpec, rest_mm: Tensor) -> ArmFacts:
    """Properties for the effects of an arm; rest_mm: (n, 3) key points at rest, mm."""
    low, high, rest = (torch.tensor(x) for x in (spec.low, spec.high, spec.rest))
    rest_mm = rest_mm.detach().cpu()
    return ArmFacts(
        low, high, rest, rest_mm, spec.gravity, spec.length_mm, spec.unit, spec.temperature_C
    )
