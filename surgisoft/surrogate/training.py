"""The training loop of a static arm model (Chen et al. 2025, sec. III-A)."""

import copy
import math

import torch

from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.network import range_weights, weighted_mse
from surgisoft.surrogate.rows import Rows, model_rows

CHECK_EVERY = 10
"""Epochs between validations (Chen et al. 2025)."""
PATIENCE = 10
"""Validations without improvement before training stops (Chen et al. 2025)."""
AVERAGE_EPOCHS = 3
"""Span of the running average of the weights (Polyak & Juditsky 1992) that is validated."""


def train(
    model: ArmModel, rows: Rows, held: Rows, name: str, epochs: int, config, losses, progress
) -> int:
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
