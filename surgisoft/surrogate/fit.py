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
from dataclasses import dataclass, field

import torch
from torch import Tensor, nn

from surgisoft.errors import InputError, unknown_name
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.constant_curvature import ConstantCurvature
from surgisoft.surrogate.effects import EFFECTS, make_effect
from surgisoft.surrogate.excitation import ChamberExcitation, excitation
from surgisoft.surrogate.history import History
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.network import HIDDEN, HawNN, range_weights, weighted_mse
from surgisoft.surrogate.recurrent import RecurrentArm

INPUTS = ("pressure", "pressure+direction")
LEAST_ROWS = 30
"""Fewest rows with key points that a fit accepts."""
CHECK_EVERY = 10
"""Epochs between validations (Chen et al. 2025)."""
PATIENCE = 10
"""Validations without improvement before training stops (Chen et al. 2025)."""
AVERAGE_EPOCHS = 3
"""Span of the running average of the weights (Polyak & Juditsky 1992) that is validated."""
HOLD_BLOCKS = 20
"""Blocks that a single run is cut into where no validation recording is given."""


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


@dataclass(frozen=True)
class Rows:
    """Rows of histories without padding, with what a static model sees in each."""

    pressure: Tensor
    direction: Tensor
    memory: dict[str, Tensor]
    target: Tensor
    block: Tensor
    """(S,) id of the block of time that a row belongs to, for bootstraps."""

    def take(self, index: Tensor) -> "Rows":
        """The rows at an index or mask (S,)."""
        return Rows(
            self.pressure[index],
            self.direction[index],
            {name: value[index] for name, value in self.memory.items()},
            self.target[index],
            self.block[index],
        )


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
    if config.network == "recurrent":
        from surgisoft.surrogate.fit_recurrent import fit_recurrent

        return fit_recurrent(train, valid, spec, config, excited, judge.held, progress)
    result = FitResult(None, [], excited, [], 0.0)
    for name in _stages(config):
        candidate = _grow(result.model, name, spec, config, excited, judge, train, result.warnings)
        if candidate is not None:
            _stage(candidate, name, config, judge, train, valid, result, progress)
    model = result.model.eval().requires_grad_(False)
    rows = judge.rows(model, train, valid)[1]
    model.validation = validated_error(rows.target, model_rows(model, rows))
    result.seconds = time.perf_counter() - start
    return result


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
        held = held[_seen(train)]
        return every.take(~held), every.take(held)


def hold_out(history: History, seed: int) -> Tensor:
    """(R, T) mask of held-out rows: a fifth of the runs, or of long blocks where runs are few."""
    generator = torch.Generator().manual_seed(seed)
    held = torch.zeros_like(history.valid)
    if history.runs >= 5:
        order = torch.randperm(history.runs, generator=generator)
        held[order[: max(1, round(0.2 * history.runs))]] = True
        return held & history.valid
    for run in range(history.runs):
        length = int(history.valid[run].sum())
        edges = torch.linspace(0, length, HOLD_BLOCKS + 1).round().long()
        for block in torch.randperm(HOLD_BLOCKS, generator=generator)[: HOLD_BLOCKS // 5].tolist():
            held[run, edges[block] : edges[block + 1]] = True
    return held


def _seen(history: History) -> Tensor:
    """(S,) rows, without padding, in which at least one key point was measured."""
    return history.rows((~history.key_points.isnan()).all(-1).any(-1))


def make_rows(model: ArmModel, history: History, block_rows: int = 25) -> Rows:
    """The measured rows of a history as the model sees them."""
    with torch.no_grad():
        trace = model.trace(history)
    seen = _seen(history)
    steps = torch.arange(history.valid.shape[1]).expand_as(history.valid)
    block = history.rows(steps // block_rows) + 1_000_000 * history.run_of_row
    return Rows(
        history.rows(trace.pressure)[seen],
        history.rows(trace.direction)[seen],
        {name: history.rows(value)[seen] for name, value in trace.memory.items()},
        history.rows(history.key_points)[seen],
        torch.unique(block[seen], return_inverse=True)[1],
    )


def model_rows(model: ArmModel, rows: Rows) -> Tensor:
    """(S, n, 3) key points in mm that a static model predicts for rows."""
    with torch.no_grad():
        return torch.cat(
            [
                model.shape(
                    rows.pressure[at], rows.direction[at], {k: v[at] for k, v in rows.memory.items()}
                )
                for at in torch.arange(len(rows.pressure)).split(16384)
            ]
        )


def validated_error(target: Tensor, predicted: Tensor) -> dict:
    """Held-out error: RMSE of each key point's distance and of all, mm; and the number of rows."""
    square = (predicted - target).square().sum(-1)
    return {
        "rmse_mm": math.sqrt(float(square.nanmean())),
        "per_key_point_mm": [math.sqrt(float(x)) for x in square.nanmean(0)],
        "rows": len(target),
    }


def _grow(model, name, spec, config, excited, judge, train, warnings) -> ArmModel | None:
    """The model with one stage more, the same function as before; None if data forbids it."""
    low, high = torch.tensor(spec.low), torch.tensor(spec.high)
    if name == "pressure":
        network = HawNN(low, high, spec.key_points, config.hidden, directions=False)
        _normalise(network, train)
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


def _normalise(network: nn.Module, history: History) -> None:
    points = history.rows(history.key_points)
    seen = ~points.isnan()
    count = seen.sum(0).clamp(min=1)
    mean = points.nan_to_num().sum(0) / count
    spread = (((points - mean).nan_to_num() * seen).square().sum(0) / count).sqrt()
    network.mean.copy_(mean.flatten())
    network.scale.copy_(spread.clamp(min=1e-6).flatten())


def rest_shape(history: History) -> Tensor:
    """(n, 3) key points in mm where the actuation is nearest to zero: mean of 20 such rows."""
    size = history.rows(history.pressure).abs().sum(-1)
    points = history.rows(history.key_points)
    whole = ~points.isnan().any(-1).any(-1)
    if not whole.any():
        return points.nanmean(0)
    nearest = size[whole].argsort()[:20]
    return points[whole][nearest].mean(0)


def _stage(candidate, name, config, judge, train, valid, result, progress) -> None:
    """Train one stage and keep it if held-out data rewards it."""
    begin = time.perf_counter()
    fitted, held = judge.rows(candidate, train, valid)
    last = name == _stages(config)[-1]
    epochs = config.epochs if last else max(CHECK_EVERY, round(config.epochs * config.first_share))
    before = None
    if result.model is not None:
        before = (model_rows(result.model, _without(held, result.model)) - held.target).square()
    done = _train(candidate, fitted, held, name, epochs, config, result.loss, progress)
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


def _without(rows: Rows, model: ArmModel) -> Rows:
    memory = {name: rows.memory[name] for name in model.effects if name in rows.memory}
    return Rows(rows.pressure, rows.direction, memory, rows.target, rows.block)


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


def _train(model, rows: Rows, held: Rows, name, epochs, config, losses, progress) -> int:
    """Adam with a cosine schedule; the model ends as its best running average on held-out rows."""
    weights = range_weights(rows.target)
    generator = torch.Generator().manual_seed(config.seed)
    count = len(rows.target)
    batch = min(config.batch, max(32, count // 16))
    steps = max(1, count // batch)
    rate = config.learning_rate
    optimiser = torch.optim.Adam(model.parameters(), lr=rate)
    schedule = torch.optim.lr_scheduler.LambdaLR(
        optimiser, lambda step: _cosine(step, epochs * steps, warm_up=2 * steps)
    )

    average = copy.deepcopy(model)
    fast, slow = list(model.parameters()), list(average.parameters())

    def error_on_held() -> float:
        return float(weighted_mse(model_rows(average, held), held.target, weights))

    best, best_state, waited, total = error_on_held(), copy.deepcopy(model.state_dict()), 0, 0.0
    epoch = 0
    for epoch in range(1, epochs + 1):
        order = torch.randperm(count, generator=generator)
        for part in order[: steps * batch].split(batch):
            loss = weighted_mse(
                model.shape(
                    rows.pressure[part],
                    rows.direction[part],
                    {key: value[part] for key, value in rows.memory.items()},
                ),
                rows.target[part],
                weights,
            )
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            optimiser.step()
            schedule.step()
            with torch.no_grad():
                share = max(1 / (AVERAGE_EPOCHS * steps), 1 / (schedule.last_epoch + 1))
                torch._foreach_lerp_(slow, fast, share)
        total = float(loss.detach())
        if epoch % CHECK_EVERY == 0 or epoch == epochs:
            now = error_on_held()
            losses.append((name, epoch, total, now))
            if now < best:
                best, best_state, waited = now, copy.deepcopy(average.state_dict()), 0
            else:
                waited += 1
            if progress is not None:
                progress(name, epoch, epochs, best)
            if waited >= PATIENCE:
                break
    model.load_state_dict(best_state)
    return epoch


def _cosine(step: int, steps: int, warm_up: int) -> float:
    if step < warm_up:
        return (step + 1) / warm_up
    share = (step - warm_up) / max(steps - warm_up, 1)
    return 0.5 * (1 + math.cos(math.pi * min(share, 1.0))) + 1e-3
