"""Training of the recurrent baseline on windows of whole runs."""

import copy

import torch
from torch import Tensor

from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.network import range_weights, weighted_mse
from surgisoft.surrogate.recurrent import RecurrentArm
from surgisoft.surrogate.rows import Data
from surgisoft.surrogate.training import CHECK_EVERY, PATIENCE

WINDOW = 96
"""Rows of a training window."""
BURN_IN = 32
"""First rows of a window, whose error does not count: the hidden state has to form."""


def train_recurrent(
    model: ArmModel, data: Data, epochs: int, rate: float, seed: int, progress=None
) -> tuple[list[tuple[str, int, float, float]], int]:
    """Adam on windows; ends as the best on judging rows. Returns (losses, epochs done)."""
    train = data.train
    generator = torch.Generator().manual_seed(seed)
    network: RecurrentArm = model.network
    with torch.no_grad():
        trace = model.trace(train)
    weights = range_weights(train.rows(train.key_points))
    target = data.targets
    window = min(WINDOW, train.valid.shape[1])
    burn = min(BURN_IN, window // 3)
    starts = [
        (run, start)
        for run in range(train.runs)
        for start in range(0, max(int(train.valid[run].sum()) - window, 0) + 1, max(1, window // 4))
    ]
    starts = torch.tensor(starts)
    batch = max(1, min(32, len(starts) // 4))
    optimiser = torch.optim.Adam(model.parameters(), lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(
        optimiser, epochs * max(1, len(starts) // batch)
    )
    losses, best, waited, epoch = [], float("inf"), 0, 0
    best_state = copy.deepcopy(model.state_dict())
    along = torch.arange(window)
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
            losses.append(("recurrent", epoch, float(loss.detach()), now))
            waited = 0 if now < best else waited + 1
            if now < best:
                best, best_state = now, copy.deepcopy(model.state_dict())
            if progress is not None:
                progress("recurrent", epoch, epochs, best)
            if waited >= PATIENCE:
                break
    model.load_state_dict(best_state)
    return losses, epoch


def held_rows(model: ArmModel, data: Data) -> tuple[Tensor, Tensor]:
    """(predicted, measured) key points (S, n, 3) in mm on the judging rows."""
    mask = data.judge.valid if data.held is None else data.held
    with torch.no_grad():
        return model.predict(data.judge)[mask], data.judge.key_points[mask]


def held_error(model: ArmModel, data: Data, weights: Tensor) -> float:
    """Weighted MSE in mm^2 on the judging rows."""
    predicted, measured = held_rows(model, data)
    return float(weighted_mse(predicted, measured, weights))


def new_recurrent(spec: ArmSpec) -> ArmModel:
    """An untrained recurrent baseline for an arm."""
    low, high = torch.tensor(spec.low), torch.tensor(spec.high)
    return ArmModel(spec, RecurrentArm(low, high, spec.key_points))
