"""Training of a model: rows of histories, held-out rows, and Adam with memories through windows."""

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.chain import Scanning, Signal, Taps
from surgisoft.surrogate.effects import Context
from surgisoft.surrogate.history import History
from surgisoft.surrogate.model import ArmModel, Validation
from surgisoft.surrogate.networks import RecurrentArm, range_weights, weighted_mse

HOLD_BLOCKS = 20
"""Blocks that a single run is cut into where no validation recording is given."""
RUNS = 5
"""Fewest runs of which whole ones are held out, and not blocks of time."""


@dataclass(frozen=True)
class Rows:
    """Rows of histories without padding, with the inputs of a static model in each."""

    pressure: Tensor
    """(S, m) chamber pressure, in the arm's unit."""
    direction: Tensor
    """(S, m) direction of change."""
    memory: dict[str, Tensor]
    """(S, ...) memory of each effect in front of the network."""
    target: Tensor
    """(S, n, 3) measured key points, mm, base frame; NaN where missing."""
    block: Tensor
    """(S,) number of the block of time that a row belongs to, for significance tests."""

    def take(self, index: Tensor) -> "Rows":
        """The rows at an index or mask (S,)."""
        return Rows(
            self.pressure[index],
            self.direction[index],
            {name: value[index] for name, value in self.memory.items()},
            self.target[index],
            self.block[index],
        )


def hold_out(history: History, seed: int) -> Tensor:
    """(R, T) mask of held-out rows: a fifth of the runs, or of long blocks where runs are few.

    Runs without a measured key point are not held out, since they could validate nothing; blocks
    are cut from the measured rows where the key points of a recording have long gaps.
    """
    generator = torch.Generator().manual_seed(seed)
    held = torch.zeros_like(history.valid)
    measured = history.valid & _seen(history)
    dealt_runs = measured.any(1).nonzero()[:, 0]
    if len(dealt_runs) >= RUNS:
        order = dealt_runs[torch.randperm(len(dealt_runs), generator=generator)]
        held[order[: max(1, round(0.2 * len(dealt_runs)))]] = True
        return held & history.valid
    for rows in (history.valid, measured):
        held = _held_blocks(rows, dealt_runs.tolist(), generator)
        if (held & measured).any() and (~held & measured).any():
            break
    return held


def _held_blocks(rows: Tensor, runs: list[int], generator: torch.Generator) -> Tensor:
    """(R, T) mask of a fifth of the blocks of equal length into which rows (R, T) of runs are
    cut."""
    held = torch.zeros_like(rows)
    for run in runs:
        own = rows[run].nonzero()[:, 0]
        edges = torch.linspace(0, len(own), HOLD_BLOCKS + 1).round().long()
        for block in torch.randperm(HOLD_BLOCKS, generator=generator)[: HOLD_BLOCKS // 5].tolist():
            held[run, own[edges[block] : edges[block + 1]]] = True
    return held


def dealt(history: History) -> Tensor:
    """(S,) number of the run of each row, or of its block of time where runs are few.

    Such groups are held out together; runs with measured rows are few below `RUNS`, as in
    `hold_out`.
    """
    if int((history.valid & _seen(history)).any(1).sum()) >= RUNS:
        return history.run_of_row
    count = history.valid.sum(1, keepdim=True).clamp(min=1)
    along = torch.arange(history.valid.shape[1]) * HOLD_BLOCKS // count
    runs = torch.arange(history.runs)[:, None]
    return history.rows(runs * HOLD_BLOCKS + along)


def _seen(history: History) -> Tensor:
    """(R, T) rows, padding included, in which at least one key point was measured."""
    return history.seen


def measured_rows(history: History) -> Tensor:
    """(S,) rows, without padding, in which at least one key point was measured."""
    return history.rows(_seen(history))


@dataclass(frozen=True)
class Data:
    """Training and validation data of a fit."""

    train: History
    """Histories to fit to."""
    valid: History | None
    """Validation histories; None: the rows of `train` in `held` validate."""
    held: Tensor | None
    """(R, T) rows of `train` that are held out; None with a validation history."""

    @classmethod
    def split(cls, train: History, valid: History | None, seed: int) -> "Data":
        """Data that validate on `valid`, or without it on held-out runs or blocks of `train`."""
        return cls(train, valid, hold_out(train, seed) if valid is None else None)

    @property
    def validation(self) -> History:
        """The history that the validation rows are part of."""
        return self.train if self.valid is None else self.valid

    def fitted_rows(self, model: ArmModel, trace: Taps | None = None) -> Rows:
        """The rows to fit to, with the inputs that a static model gets in each."""
        rows = make_rows(model, self.train, trace)
        if self.held is None:
            return rows
        return rows.take(~self.train.rows(self.held)[measured_rows(self.train)])

    def validation_rows(self, model: ArmModel) -> Rows:
        """The validation rows, with the inputs that a static model gets in each."""
        if self.valid is not None:
            return make_rows(model, self.valid)
        assert self.held is not None, "without validation runs, rows are held out"
        held = self.train.rows(self.held)[measured_rows(self.train)]
        return make_rows(model, self.train).take(held)

    @property
    def fitted(self) -> History:
        """The history to fit to, with key points missing in the rows that are held out."""
        return replace(self.train, key_points=self.targets)

    @property
    def targets(self) -> Tensor:
        """(R, T, n, 3) key points to fit to, mm; NaN where missing or held out."""
        if self.held is None:
            return self.train.key_points
        return torch.where(self.held[..., None, None], torch.nan, self.train.key_points)


def make_rows(
    model: ArmModel, history: History, trace: Taps | None = None, block_rows: int = 25
) -> Rows:
    """The measured rows of a history, with the inputs that a static model gets in each."""
    if trace is None:
        with torch.no_grad():
            trace = model.trace(history)
    seen = measured_rows(history)
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
                    rows.pressure[at],
                    rows.direction[at],
                    {k: v[at] for k, v in rows.memory.items()},
                )
                for at in torch.arange(len(rows.pressure)).split(16384)
            ]
        )


def validated_error(target: Tensor, predicted: Tensor) -> Validation:
    """Validation error of predicted against measured key points, both (S, n, 3) in mm."""
    square = (predicted - target).square().sum(-1)
    points = [None if math.isnan(x) else math.sqrt(x) for x in square.nanmean(0).tolist()]
    return Validation(math.sqrt(float(square.nanmean())), tuple(points), len(target))


@torch.no_grad()
def normalise(network: Any, history: History) -> None:
    """Set a network's output mean and scale (3n,) in mm from the measured key points.

    With a prior mean: from what it leaves of them.
    """
    points = history.rows(history.key_points)
    if getattr(network, "prior", None) is not None:
        points = points - network.prior(history.rows(history.pressure))
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


CHECK_EVERY = 10
"""Epochs between validations (Chen et al. 2025)."""
PATIENCE = 10
"""Validations without improvement before training stops (Chen et al. 2025)."""
RATES = {"constant curvature": 10.0}
"""Factors on the learning rate: a few parameters of size one need larger steps."""
AVERAGE_EPOCHS = 3
"""Span of the running average of the weights (Polyak & Juditsky 1992) that is validated."""
WINDOW = 1024
"""Rows of a window of a run through which memories are trained."""
WINDOWS = 4
"""Windows per step."""
MEMORY_STEPS = 3
"""Steps through windows after each epoch of rows."""
MEMORY_FIRST = 3
"""Epochs of rows before the memory parameters are trained, too."""
MEMORY_RATE = 10.0
"""Learning rate of memory parameters, times that of the others."""


def train(
    model: ArmModel, data: Data, name: str, epochs: int, config, losses: list, progress
) -> int:
    """Train by Adam with a cosine schedule; the model ends with its best running average.

    The best average is that of least validation error (early stopping). Memory parameters are
    trained in the stages of effects only. Appends (name, epoch, training loss, validation loss) to
    `losses`; returns the number of epochs done. After Ctrl-C, which is raised again, the model has
    the best average of the validations so far.
    """
    every = [p for effect in model.effects.values() for p in effect.memory_parameters()]
    every += [p for _, effect in model.stage("line") for p in effect.amplitudes().values()]
    mine = {id(p) for p in every}
    deep = every if name in model.effects else []
    flat = [p for p in model.parameters() if id(p) not in mine]
    generator = torch.Generator().manual_seed(config.seed)
    trace = _trace(model, data)
    rows = data.fitted_rows(model, trace)
    weights = range_weights(rows.target)
    batch = min(config.batch, max(32, len(rows.target) // 16))
    steps = max(1, len(rows.target) // batch)
    optimiser = torch.optim.Adam(flat, lr=RATES.get(name, 1.0) * config.learning_rate)
    schedule = cosine_schedule(optimiser, epochs * steps, 2 * steps)
    through = _Through(model, data, deep, weights, config, epochs, generator) if deep else None
    average = copy.deepcopy(model)
    fast: list[Tensor] = list(model.parameters())
    slow: list[Tensor] = list(average.parameters())

    fixed_rows = None if deep else data.validation_rows(average)

    def validation_loss() -> float:
        held_out = fixed_rows or data.validation_rows(average)
        return float(weighted_mse(model_rows(average, held_out), held_out.target, weights))

    best, best_state, waited, loss = validation_loss(), copy.deepcopy(model.state_dict()), 0, 0.0
    epoch = 0
    try:
        for epoch in range(1, epochs + 1):
            order = torch.randperm(len(rows.target), generator=generator)
            for part in order[: steps * batch].split(batch):
                loss = _step(model, rows.take(part), weights, optimiser)
                schedule.step()
                with torch.no_grad():
                    share = max(1 / (AVERAGE_EPOCHS * steps), 1 / (schedule.last_epoch + 1))
                    torch._foreach_lerp_(slow, fast, share)
            if through is not None and epoch > MEMORY_FIRST:
                through.steps(trace)
                trace = _trace(model, data)
                rows = data.fitted_rows(model, trace)
            if epoch % CHECK_EVERY == 0 or epoch == epochs:
                now = validation_loss()
                waited = 0 if now < best else waited + 1
                if now < best:
                    best, best_state = now, copy.deepcopy(average.state_dict())
                losses.append((name, epoch, loss, now))
                if progress is not None:
                    progress(name, epoch, epochs, best)
                if waited >= PATIENCE:
                    break
    finally:
        model.load_state_dict(best_state)
    return epoch


@dataclass(frozen=True)
class JointTraining:
    """Settings of `train_jointly`."""

    batch: int = 128
    """Most rows per step; a 32nd of the rows where they are few."""
    learning_rate: float = 3e-3
    """Adam's largest learning rate, that of a fit; it falls along a cosine."""
    memory_steps: int = 6
    """Steps of the memory parameters through windows after each epoch."""
    seed: int = 0
    """Seed of the order of rows and windows."""


def train_jointly(
    model: ArmModel,
    data: Data,
    epochs: int,
    config: JointTraining,
    hold: Callable[[ArmModel], None] | None = None,
) -> None:
    """Train the network of a model and all its effects together, in place, on the fitted rows.

    The number of epochs is fixed and no validation row is looked at, so two models are compared
    after the same training. The model ends with the running average of its weights; its prior mean
    stays as it is. hold: called after each epoch, to keep parameters in their ranges.
    """
    deep = [p for effect in model.effects.values() for p in effect.memory_parameters()]
    deep += [p for _, effect in model.stage("line") for p in effect.amplitudes().values()]
    mine = {id(p) for p in deep}
    model.train().requires_grad_(True)
    prior = getattr(model.network, "prior", None)
    if prior is not None:  # without validation and ridges, arcs would extrapolate badly
        prior.requires_grad_(False)
    flat = [p for p in model.parameters() if id(p) not in mine and p.requires_grad]
    generator = torch.Generator().manual_seed(config.seed)
    trace = _trace(model, data)
    rows = data.fitted_rows(model, trace)
    weights = range_weights(rows.target)
    batch = min(config.batch, max(16, len(rows.target) // 32))
    steps = max(1, len(rows.target) // batch)
    optimiser = torch.optim.Adam(flat, lr=config.learning_rate)
    schedule = cosine_schedule(optimiser, epochs * steps, 2 * steps)
    through = None
    if deep:
        steps_each = config.memory_steps
        through = _Through(model, data, deep, weights, config, epochs, generator, steps_each)
    average = copy.deepcopy(model)
    fast: list[Tensor] = list(model.parameters())
    slow: list[Tensor] = list(average.parameters())
    for _ in range(epochs):
        order = torch.randperm(len(rows.target), generator=generator)
        for part in order[: steps * batch].split(batch):
            _step(model, rows.take(part), weights, optimiser)
            schedule.step()
            with torch.no_grad():
                share = max(1 / (AVERAGE_EPOCHS * steps), 1 / (schedule.last_epoch + 1))
                torch._foreach_lerp_(slow, fast, share)
        if through is not None:
            through.steps(trace)
        if hold is not None:
            hold(model)
        if through is not None:
            trace = _trace(model, data)
            rows = data.fitted_rows(model, trace)
    model.load_state_dict(average.state_dict())
    if hold is not None:
        hold(model)
    model.eval().requires_grad_(False)


def _trace(model: ArmModel, data: Data) -> Taps:
    with torch.no_grad():
        return model.trace(data.train)


def _step(model: ArmModel, rows: Rows, weights: Tensor, optimiser) -> float:
    points = model.shape(rows.pressure, rows.direction, rows.memory)
    loss = weighted_mse(points, rows.target, weights)
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    optimiser.step()
    return float(loss.detach())


class _Through:
    """Training of memory parameters by gradients through windows of runs."""

    def __init__(
        self,
        model,
        data: Data,
        parameters,
        weights,
        config,
        epochs,
        generator,
        steps_each=MEMORY_STEPS,
    ):
        self.steps_each = steps_each
        self.model, self.weights, self.generator = model, weights, generator
        self.history, self.targets = data.train, data.targets
        self.first = model.first_pressure(data.train)
        self.optimiser = torch.optim.Adam(parameters, lr=MEMORY_RATE * config.learning_rate)
        self.schedule = cosine_schedule(self.optimiser, epochs * steps_each, 0)
        lengths = data.train.valid.sum(1)
        self.window = min(WINDOW, int(lengths.max()))
        self.starts = torch.tensor(
            [
                (run, start)
                for run, length in enumerate(lengths.tolist())
                for start in range(0, max(length - self.window // 2, 1), self.window // 2)
            ]
        )

    def steps(self, trace: Taps) -> None:
        """A few steps, each through some windows that begin with the memory of the trace."""
        order = torch.randperm(len(self.starts), generator=self.generator)
        for number in range(self.steps_each):
            picked = order[(torch.arange(WINDOWS) + number * WINDOWS) % len(order)]
            self._step(trace, self.starts[picked.unique()])
            self.schedule.step()

    def _context(self, rows: Tensor, columns: Tensor) -> Context:
        room = self.history.temperature_C
        return Context(
            self.history.dt_s[rows, columns],
            self.history.t_s[rows, columns].float(),
            None if room is None else room[rows, columns],
        )

    def _step(self, trace: Taps, starts: Tensor) -> None:
        last = trace.pressure.shape[1] - 1
        rows = starts[:, :1]
        columns = starts[:, 1:] + torch.arange(self.window)
        inside = columns <= last
        columns = columns.clamp(max=last)
        context = self._context(rows, columns)
        chain = self.model.chain
        rest = chain.standing(self.first[starts[:, 0]], signals=False)[0].memory
        first, start = starts[:, 1] == 0, {}
        for name, memory in trace.memory.items():
            before = memory[starts[:, 0], (starts[:, 1] - 1).clamp(min=0)]
            start[name] = torch.where(first.view(-1, *[1] * (before.ndim - 1)), rest[name], before)
        mode = Scanning(start, context, direction=trace.direction[rows, columns])
        signal = chain.walk(Signal(self.history.pressure[rows, columns]), mode, chain.inner)
        points = chain.hold(signal.pressure, signal.direction, mode.memory)
        wanted = torch.where(inside[..., None, None], self.targets[rows, columns], torch.nan)
        loss = weighted_mse(points.flatten(0, 1), wanted.flatten(0, 1), self.weights)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self.optimiser.step()


def cosine_schedule(optimiser, steps: int, warm_up: int):
    """Linear warm-up, then a cosine down to a thousandth."""

    def factor(step: int) -> float:
        if step < warm_up:
            return (step + 1) / warm_up
        share = min((step - warm_up) / max(steps - warm_up, 1), 1.0)
        return 0.5 * (1 + math.cos(math.pi * share)) + 1e-3

    return torch.optim.lr_scheduler.LambdaLR(optimiser, factor)


RECURRENT_WINDOW = 96
"""Rows of a training window."""
BURN_IN = 32
"""First rows of a window, whose error does not count: the hidden state has to form."""


def train_recurrent(
    model: ArmModel, data: Data, epochs: int, rate: float, seed: int, losses: list, progress=None
) -> int:
    """Train a recurrent model by Adam on windows; it ends with its best validated weights.

    Appends ("recurrent", epoch, training loss, validation loss) to `losses`; returns the number of
    epochs done. After Ctrl-C, which is raised again, the model has the best weights so far.
    """
    train = data.train
    generator = torch.Generator().manual_seed(seed)
    network = model.network
    assert isinstance(network, RecurrentArm)
    with torch.no_grad():
        trace = model.trace(train)
    weights = range_weights(train.rows(train.key_points))
    target = data.targets
    window = min(RECURRENT_WINDOW, train.valid.shape[1])
    burn = min(BURN_IN, window // 3)
    stride = max(1, window // 4)
    starts = torch.tensor(
        [
            (run, start)
            for run in range(train.runs)
            for start in range(0, max(int(train.valid[run].sum()) - window, 0) + 1, stride)
        ]
    )
    batch = max(1, min(32, len(starts) // 4))
    optimiser = torch.optim.Adam(model.parameters(), lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
        optimiser, epochs * max(1, len(starts) // batch)
    )
    best, waited, epoch = float("inf"), 0, 0
    best_state = copy.deepcopy(model.state_dict())
    along = torch.arange(window)
    try:
        for epoch in range(1, epochs + 1):
            for part in torch.randperm(len(starts), generator=generator).split(batch):
                rows, columns = starts[part, :1], starts[part, 1:] + along
                pressure, direction = trace.pressure[rows, columns], trace.direction[rows, columns]
                points = network(pressure, direction, network.scan(pressure, direction))
                # The first window of a run starts where the run starts, so nothing has to form.
                counts = (along >= burn) | (starts[part, 1:] == 0)
                wanted = torch.where(counts[..., None, None], target[rows, columns], torch.nan)
                loss = weighted_mse(points.flatten(0, 1), wanted.flatten(0, 1), weights)
                optimiser.zero_grad(set_to_none=True)
                loss.backward()
                torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
                optimiser.step()
                schedule.step()
            if epoch % CHECK_EVERY == 0 or epoch == epochs:
                now = held_error(model, data, weights)
                waited = 0 if now < best else waited + 1
                if now < best:
                    best, best_state = now, copy.deepcopy(model.state_dict())
                losses.append(("recurrent", epoch, float(loss.detach()), now))
                if progress is not None:
                    progress("recurrent", epoch, epochs, best)
                if waited >= PATIENCE:
                    break
    finally:
        model.load_state_dict(best_state)
    return epoch


def held_rows(model: ArmModel, data: Data) -> tuple[Tensor, Tensor]:
    """(predicted, measured) key points (S, n, 3) in mm on the validation rows."""
    mask = data.validation.valid if data.held is None else data.held
    with torch.no_grad():
        return model.predict(data.validation)[mask], data.validation.key_points[mask]


def held_error(model: ArmModel, data: Data, weights: Tensor) -> float:
    """Weighted MSE in mm^2 on the validation rows."""
    predicted, measured = held_rows(model, data)
    return float(weighted_mse(predicted, measured, weights))


def new_recurrent(spec: ArmSpec) -> ArmModel:
    """An untrained recurrent baseline for an arm."""
    low, high = torch.tensor(spec.low), torch.tensor(spec.high)
    return ArmModel(spec, RecurrentArm(low, high, spec.key_points))
