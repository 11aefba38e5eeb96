"""The training loop of an arm model (Chen et al. 2025, sec. III-A).

Rows in random batches train what a row needs alone: the network, and how effects read their
memory. Parameters that the memory itself depends on, and all of the line's, are trained through
windows of whole runs, whose first memory comes from the last pass over all of them.
"""

import copy
import math

import torch
from torch import Tensor

from surgisoft.surrogate.effects import Context, Stage
from surgisoft.surrogate.model import ArmModel, Trace
from surgisoft.surrogate.network import range_weights, weighted_mse
from surgisoft.surrogate.rows import Data, Rows, model_rows

CHECK_EVERY = 10
"""Epochs between validations (Chen et al. 2025)."""
PATIENCE = 10
"""Validations without improvement before training stops (Chen et al. 2025)."""
RATES = {"constant curvature": 10.0}
"""Factors on the learning rate: a handful of parameters of size one takes larger steps."""
AVERAGE_EPOCHS = 3
"""Span of the running average of the weights (Polyak & Juditsky 1992) that is validated."""
WINDOW = 1024
"""Rows of a window of a run through which memories are trained."""
WINDOWS = 4
"""Windows a step."""
MEMORY_STEPS = 3
"""Steps through windows after each epoch of rows."""
MEMORY_FIRST = 3
"""Epochs of rows before the memory is touched."""
MEMORY_RATE = 10.0
"""Learning rate of memory parameters, times that of the others."""


def train(
    model: ArmModel, data: Data, name: str, epochs: int, config, losses: list, progress
) -> int:
    """Adam with a cosine schedule; the model ends as its best running average on judging rows.

    Memories are trained in the stages of effects only. Appends (name, epoch, training loss,
    judging loss) to `losses`; returns the epochs done.
    """
    every = [p for effect in model.effects.values() for p in effect.memory_parameters()]
    every += [p for _, effect in model.stage("line") for p in effect.strengths().values()]
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
    schedule = _schedule(optimiser, epochs * steps, 2 * steps)
    through = _Through(model, data, deep, weights, config, epochs, generator) if deep else None
    average = copy.deepcopy(model)
    fast, slow = list(model.parameters()), list(average.parameters())

    judging = None if deep else data.judging_rows(average)

    def judge() -> float:
        judged = judging or data.judging_rows(average)
        return float(weighted_mse(model_rows(average, judged), judged.target, weights))

    best, best_state, waited, loss = judge(), copy.deepcopy(model.state_dict()), 0, 0.0
    epoch = 0
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
            now = judge()
            losses.append((name, epoch, loss, now))
            waited = 0 if now < best else waited + 1
            if now < best:
                best, best_state = now, copy.deepcopy(average.state_dict())
            if progress is not None:
                progress(name, epoch, epochs, best)
            if waited >= PATIENCE:
                break
    model.load_state_dict(best_state)
    return epoch


def _trace(model: ArmModel, data: Data) -> Trace:
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
    """Training of memory parameters through windows of runs."""

    def __init__(self, model, data: Data, parameters, weights, config, epochs, generator):
        self.model, self.weights, self.generator = model, weights, generator
        self.history, self.targets = data.train, data.targets
        self.first = model.first_pressure(data.train)
        self.optimiser = torch.optim.Adam(parameters, lr=MEMORY_RATE * config.learning_rate)
        self.schedule = _schedule(self.optimiser, epochs * MEMORY_STEPS, 0)
        lengths = data.train.valid.sum(1)
        self.window = min(WINDOW, int(lengths.max()))
        self.starts = torch.tensor(
            [
                (run, start)
                for run, length in enumerate(lengths.tolist())
                for start in range(0, max(length - self.window // 2, 1), self.window // 2)
            ]
        )

    def steps(self, trace: Trace) -> None:
        """A few steps, each through some windows that begin with the memory of the trace."""
        order = torch.randperm(len(self.starts), generator=self.generator)
        for number in range(MEMORY_STEPS):
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

    def _step(self, trace: Trace, starts: Tensor) -> None:
        last = trace.pressure.shape[1] - 1
        rows = starts[:, :1]
        columns = starts[:, 1:] + torch.arange(self.window)
        inside = columns <= last
        columns = columns.clamp(max=last)
        context = self._context(rows, columns)
        rest = self.model.first_state(self.first[starts[:, 0]]).memory
        first = starts[:, 1] == 0
        memory = {}

        def along(stage: Stage, signal: Tensor) -> Tensor:
            for name, effect in self.model.stage(stage):
                before = trace.memory[name][starts[:, 0], (starts[:, 1] - 1).clamp(min=0)]
                begin = first.view(-1, *[1] * (before.ndim - 1))
                start = torch.where(begin, rest[name], before)
                memory[name] = effect.scan(start, signal, context)
                signal = effect.apply(signal, memory[name])
            return signal

        chamber = self.model.chambers(along("line", self.history.pressure[rows, columns]))
        along("material", chamber)
        points = self.model.shape(chamber, trace.direction[rows, columns], memory)
        wanted = torch.where(inside[..., None, None], self.targets[rows, columns], torch.nan)
        loss = weighted_mse(points.flatten(0, 1), wanted.flatten(0, 1), self.weights)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        self.optimiser.step()


def _schedule(optimiser, steps: int, warm_up: int):
    """Linear warm-up, then a cosine down to a thousandth."""

    def factor(step: int) -> float:
        if step < warm_up:
            return (step + 1) / warm_up
        share = min((step - warm_up) / max(steps - warm_up, 1), 1.0)
        return 0.5 * (1 + math.cos(math.pi * share)) + 1e-3

    return torch.optim.lr_scheduler.LambdaLR(optimiser, factor)
