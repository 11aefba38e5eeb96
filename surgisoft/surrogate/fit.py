"""Fit an arm model to histories: from simple to rich, and no further than held-out runs reward.

A model grows in stages (pressure, then direction, then each effect). Each stage starts as the very
function that the stage before ended with - new weights are zero - and is kept only where it
lowers the error on held-out data by more than chance; so the result is never worse there than the
simpler model. Training follows Chen et al. 2025, sec. III-A: motion-range weighted MSE, validation
every 10 epochs, patience of 10 validations.
"""

import copy
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field

import torch
from torch import Tensor

from surgisoft.errors import InputError, unknown_name
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.constant_curvature import ConstantCurvature
from surgisoft.surrogate.effects import EFFECTS, make_effect
from surgisoft.surrogate.excitation import ChamberExcitation, excitation
from surgisoft.surrogate.fit_recurrent import held_rows, new_recurrent, train_recurrent
from surgisoft.surrogate.history import History
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.network import HIDDEN, HawNN
from surgisoft.surrogate.rows import (
    Rows,
    hold_out,
    known_to,
    make_rows,
    measured_rows,
    model_rows,
    normalise,
    rest_shape,
    validated_error,
)
from surgisoft.surrogate.training import CHECK_EVERY, PATIENCE
from surgisoft.surrogate.training import train as train_rows

INPUTS = ("pressure", "pressure+direction")
LEAST_ROWS = 30
"""Fewest rows with key points that a fit accepts."""


@dataclass(frozen=True)
class FitConfig:
    """How to fit."""

    network: str = "haw_nn"
    """`haw_nn`, `constant_curvature` or `recurrent`."""
    inputs: str = "pressure+direction"
    """`pressure` or `pressure+direction`."""
    effects: tuple[str, ...] = ()
    """Names of effects to add, in order."""
    hidden: tuple[int, ...] = HIDDEN
    """Widths of the hidden layers of HAW-NN."""
    sections: int = 0
    """Constant-curvature sections; 0: one for every 3 chambers."""
    epochs: int = 400
    """Most epochs of each stage; the first has `first_share` of them where more follow."""
    first_share: float = 0.5
    """Share of the epochs for every stage but the last."""
    batch: int = 512
    """Rows a step."""
    learning_rate: float = 3e-3
    """Adam's largest learning rate; it falls along a cosine."""
    seed: int = 0
    """Seed of weights, order of rows and held-out blocks."""
    check_excitation: bool = True
    """Whether inputs that the data cannot support are left out."""


@dataclass
class StageReport:
    """One stage of the growth."""

    name: str
    valid_rmse_mm: float
    epochs: int
    seconds: float
    kept: bool
    reason: str = ""


@dataclass
class FitResult:
    """A fitted model and how it came about."""

    model: ArmModel
    stages: list[StageReport]
    excitation: list[ChamberExcitation]
    warnings: list[str]
    seconds: float
    loss: list[tuple[str, int, float, float]] = field(default_factory=list)
    """(stage, epoch, training loss, validation loss), losses in mm^2."""

    def report(self) -> dict:
        """What happened, for a JSON file beside the model."""
        return {
            "stages": [asdict(stage) for stage in self.stages],
            "excitation": [asdict(chamber) for chamber in self.excitation],
            "warnings": self.warnings,
            "seconds": self.seconds,
            "loss": [
                dict(zip(("stage", "epoch", "training_mm2", "held_out_mm2"), row, strict=True))
                for row in self.loss
            ],
        }

    def lines(self) -> list[str]:
        """What happened, for a person."""
        lines = [
            f"{stage.name:20s} held-out RMSE {stage.valid_rmse_mm:8.4f} mm  "
            f"{stage.epochs:4d} epochs {stage.seconds:6.1f} s  "
            f"{'kept' if stage.kept else 'left out'}"
            for stage in self.stages
        ]
        lines += [f"note: {warning}" for warning in self.warnings]
        error = self.model.validation
        points = " ".join(f"{value:.4f}" for value in error["per_key_point_mm"])
        lines.append(
            f"held-out RMSE {error['rmse_mm']:.4f} mm over {error['rows']} rows; "
            f"key points base to tip: {points} mm"
        )
        return lines


Progress = Callable[[str, int, int, float], None]
"""Called with (stage, epoch, epochs, validation loss in mm^2)."""


def fit(
    train: History, valid: History | None, spec: ArmSpec, config: FitConfig, progress=None
) -> FitResult:
    """Fit a model to `train`; choose by `valid`, or by held-out blocks of `train` without it."""
    _check(train, valid, spec, config)
    start = time.perf_counter()
    torch.manual_seed(config.seed)
    low, high, band = (torch.tensor(x) for x in (spec.low, spec.high, spec.band))
    excited = excitation(train, low, high, band)
    judge = _Judge.make(train, valid, spec, config, low, high, band)
    result = FitResult(None, [], excited, [], 0.0)
    if config.network == "recurrent":
        _fit_recurrent(train, valid, spec, config, judge.held, result, progress)
        result.seconds = time.perf_counter() - start
        return result
    for name in _stages(config):
        candidate = _grow(result.model, name, spec, config, excited, judge, train, result.warnings)
        if candidate is not None:
            _stage(candidate, name, config, judge, train, valid, result, progress)
    model = result.model.eval().requires_grad_(False)
    rows = judge.rows(model, train, valid)[1]
    model.validation = validated_error(rows.target, model_rows(model, rows))
    result.seconds = time.perf_counter() - start
    return result


def _fit_recurrent(train, valid, spec, config, held, result: FitResult, progress) -> None:
    model = new_recurrent(spec)
    normalise(model.network, train)
    model.rest_mm.copy_(rest_shape(train))
    result.loss, epochs = train_recurrent(
        model, train, held, valid, config.epochs, config.learning_rate, config.seed,
        CHECK_EVERY, PATIENCE, progress,
    )  # fmt: skip
    predicted, measured = held_rows(model, train, held, valid)
    model.validation = validated_error(measured, predicted)
    result.model = model.eval().requires_grad_(False)
    result.stages.append(StageReport("recurrent", model.validation["rmse_mm"], epochs, 0.0, True))


def _check(train: History, valid: History | None, spec: ArmSpec, config: FitConfig) -> None:
    if config.inputs not in INPUTS:
        raise unknown_name("inputs", config.inputs, INPUTS)
    for name in config.effects:
        if name not in EFFECTS:
            raise unknown_name("effect", name, EFFECTS)
    for history in (train, valid):
        if history is None:
            continue
        seen = int((~history.key_points.isnan()).all(-1).any(-1).sum())
        if seen < LEAST_ROWS:
            raise InputError(
                f"{seen} rows with key points, expected at least {LEAST_ROWS}; record more"
            )
    if (~train.key_points.isnan()).flatten(0, 1).any(0).logical_not().any():
        raise InputError("a key point is missing in every row of the training recordings")
    if train.chambers != spec.chambers:
        raise InputError(f"{train.chambers} chambers recorded, expected {spec.chambers}")


def _stages(config: FitConfig) -> list[str]:
    if config.network == "constant_curvature":
        return ["constant curvature"]
    names = ["pressure"]
    if config.inputs == "pressure+direction":
        names.append("direction")
    return names + list(config.effects)


@dataclass(frozen=True)
class _Judge:
    """Splits rows into training and held-out ones."""

    held: Tensor | None
    """(R, T) rows of the training history that are held out; None with a validation history."""
    inner: bool
    """Whether the held-out data itself has reversals inside the range in every chamber."""

    @classmethod
    def make(cls, train, valid, spec, config, low, high, band) -> "_Judge":
        judged = train if valid is None else valid
        inner = all(chamber.minor_loops for chamber in excitation(judged, low, high, band))
        return cls(hold_out(train, config.seed) if valid is None else None, inner)

    def rows(self, model: ArmModel, train: History, valid: History | None) -> tuple[Rows, Rows]:
        """(training, held-out) rows as the model sees them."""
        if valid is not None:
            return make_rows(model, train), make_rows(model, valid)
        every = make_rows(model, train)
        held = train.rows(self.held)
        held = held[measured_rows(train)]
        return every.take(~held), every.take(held)


def _grow(model, name, spec, config, excited, judge, train, warnings) -> ArmModel | None:
    """The model with one stage more, the same function as before; None if data forbids it."""
    low, high = torch.tensor(spec.low), torch.tensor(spec.high)
    if name == "pressure":
        network = HawNN(low, high, spec.key_points, config.hidden, directions=False)
        normalise(network, train)
        return ArmModel(spec, network)
    if name == "constant curvature":
        network = ConstantCurvature(low, high, spec.key_points, config.sections)
        network.set_rest(rest_shape(train))
        return ArmModel(spec, network)
    use = torch.tensor([float(chamber.direction) for chamber in excited])
    if not judge.inner:
        use = use * torch.tensor([float(chamber.minor_loops) for chamber in excited])
    if name != "direction":
        use = use * torch.tensor([float(chamber.minor_loops) for chamber in excited])
    if not config.check_excitation:
        use = torch.ones_like(use)
    for chamber, used in zip(excited, use, strict=True):
        if not used:
            warnings.append(f"{name} left out for {chamber.complaint()}")
    if not use.any():
        return None
    grown = copy.deepcopy(model)
    if name == "direction":
        grown.network = grown.network.with_directions(use)
        return grown
    effect = make_effect(name, low, high)
    effect.use.copy_(use)
    return ArmModel(spec, grown.network, {**grown.effects, name: effect})


def _stage(candidate, name, config, judge, train, valid, result, progress) -> None:
    """Train one stage and keep it if held-out data rewards it."""
    begin = time.perf_counter()
    fitted, held = judge.rows(candidate, train, valid)
    last = name == _stages(config)[-1]
    epochs = config.epochs if last else max(CHECK_EVERY, round(config.epochs * config.first_share))
    before = None
    if result.model is not None:
        before = (model_rows(result.model, known_to(result.model, held)) - held.target).square()
    done = train_rows(candidate, fitted, held, name, epochs, config, result.loss, progress)
    after = (model_rows(candidate, held) - held.target).square()
    rmse = math.sqrt(float(after.sum(-1).nanmean()))
    kept, reason = True, ""
    if before is not None:
        kept, reason = _better(before, after, held.block)
        if not kept:
            result.warnings.append(f"{name} left out: {reason}")
    if kept:
        candidate.rest_mm.copy_(rest_shape(train))
        result.model = candidate
    seconds = time.perf_counter() - begin
    result.stages.append(StageReport(name, rmse, done, seconds, kept, reason))


def _better(before: Tensor, after: Tensor, block: Tensor) -> tuple[bool, str]:
    """Whether the squared error (S, n, 3) fell by more than twice its standard error by blocks."""
    gain = (before - after).nanmean(dim=(1, 2)).nan_to_num()
    blocks = int(block.max()) + 1
    total = torch.zeros(blocks).index_add(0, block, gain)
    mean = float(gain.mean())
    error = float((total - total.mean()).square().sum().sqrt()) / len(gain)
    if mean > 2 * error:
        return True, ""
    share = mean / max(float(before.nanmean()), 1e-12)
    return False, (
        f"the held-out squared error changes by {-share:+.1%} (standard error "
        f"{error / max(float(before.nanmean()), 1e-12):.1%}), which is no gain beyond chance"
    )
