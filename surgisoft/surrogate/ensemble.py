"""Ensembles: networks trained side by side, each with another share of the data left out.

The effects and the prior mean of a fitted model stay as they are. Runs, or long blocks of time,
are dealt into as many folds as there are members, and each member is trained from new weights on
all folds but its own (bagging over blocks: Breiman 1996). The mean of the members is the
prediction. Each row was left out by one member; that member's error on it is what cross-validation
finds, and calibrates the interval (CV+, Barber et al. 2021).

All members are trained at once by batched products. Of their running averages after every tenth
epoch those of one epoch are taken, the same for all members: that of the least cross-validated
error. A network that has seen few runs gets worse elsewhere long before its training ends, and one
choice of some twenty for all rows leaves the errors of rows left out close to those of new rows.
"""

import copy
import math
from collections.abc import Callable

import torch
from torch import Tensor

from surgisoft.surrogate.interval import ErrorInterval, calibrate, distance_across
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import HawEnsemble, HawNN, range_weights
from surgisoft.surrogate.training import (
    AVERAGE_EPOCHS,
    CHECK_EVERY,
    Data,
    cosine_schedule,
    dealt,
    measured_rows,
)

MOST_ELEMENTS = 2**22
"""Largest number of activations of a layer that are evaluated at once."""


def train_ensemble(
    model: ArmModel,
    data: Data,
    members: int,
    epochs: int,
    config,
    losses: list,
    progress: Callable[[str, int, int, float], None] | None = None,
) -> tuple[ArmModel, ErrorInterval | None]:
    """The model with an ensemble in the place of its network, and the interval of its errors.

    config: a `FitConfig`. Appends ("ensemble", epoch, training loss, cross-validated loss), both
    in mm^2 and weighted by motion range, to `losses`.
    """
    with torch.no_grad():
        trace = model.trace(data.train)
    history = data.train
    seen = measured_rows(history)
    rows = [history.rows(x)[seen] for x in (trace.behind["material"], trace.direction)]
    target = history.rows(history.key_points)[seen]
    group = dealt(history)[seen]
    if data.held is not None:
        free = ~history.rows(data.held)[seen]
        rows, target, group = [x[free] for x in rows], target[free], group[free]
    generator = torch.Generator().manual_seed(config.seed)
    fold = _folds(group, members, generator)
    assert isinstance(model.network, HawNN)
    ensemble = _untrained(model.network, members)
    weights = range_weights(target)
    known, target = ~target.isnan(), target.nan_to_num()
    batch = min(config.batch, max(32, len(target) // 16))
    steps = max(1, len(target) // batch)
    trained = [parameter for parameter in ensemble.parameters() if parameter.requires_grad]
    optimiser = torch.optim.Adam(trained, lr=config.learning_rate)
    schedule = cosine_schedule(optimiser, epochs * steps, 2 * steps)
    average = copy.deepcopy(ensemble)
    fast: list[Tensor] = list(ensemble.parameters())
    slow: list[Tensor] = list(average.parameters())
    number = torch.arange(members)[:, None]
    best, least = copy.deepcopy(average.state_dict()), math.inf
    for epoch in range(1, epochs + 1):
        # Every member takes the rows in another order.
        order = torch.stack(
            [torch.randperm(len(target), generator=generator) for _ in range(members)]
        )
        for part in order[:, : steps * batch].split(batch, dim=1):
            points = ensemble.members_at(rows[0][part], rows[1][part])
            counts = known[part] & (fold[part] != number)[..., None, None]
            square = weights * (points - target[part]).square() * counts
            loss = square.sum((1, 2, 3)) / counts.sum((1, 2, 3)).clamp(min=1)
            optimiser.zero_grad(set_to_none=True)
            loss.sum().backward()
            optimiser.step()
            schedule.step()
            with torch.no_grad():
                share = max(1 / (AVERAGE_EPOCHS * steps), 1 / (schedule.last_epoch + 1))
                torch._foreach_lerp_(slow, fast, share)
        if epoch % CHECK_EVERY == 0 or epoch == epochs:
            left = _left_out(average, rows, fold) - target
            held = float((weights * left.square() * known).sum() / known.sum())
            losses.append(("ensemble", epoch, float(loss.detach().mean()), held))
            if held < least:
                best, least = copy.deepcopy(average.state_dict()), held
            if progress is not None:
                progress("ensemble", epoch, epochs, least)
    average.load_state_dict(best)
    left = (_left_out(average, rows, fold) - target).where(known, torch.nan)
    signal = history.rows(history.pressure)[seen]
    signal = signal if data.held is None else signal[free]
    distance = distance_across(signal, fold, torch.tensor(model.spec.span))
    interval = calibrate(left.norm(dim=-1), distance, group, "cross-validation")
    return model.replace(network=average), interval


def _untrained(network: HawNN, members: int) -> HawEnsemble:
    """An ensemble of networks of the same layout and normalisation, with new weights."""
    made = []
    for _ in range(members):
        fresh = copy.deepcopy(network)
        for layer in fresh.layers:
            if isinstance(layer, torch.nn.Linear):
                layer.reset_parameters()
        made.append(fresh)
    ensemble = HawEnsemble.of(made).requires_grad_(True)
    if ensemble.prior is not None:
        ensemble.prior.requires_grad_(False)
    return ensemble


def _folds(group: Tensor, folds: int, generator: torch.Generator) -> Tensor:
    """(S,) fold of each row; groups (S,) are dealt whole, in random order."""
    names, index = group.unique(return_inverse=True)
    order = torch.randperm(len(names), generator=generator)
    place = torch.empty_like(order)
    place[order] = torch.arange(len(names)) % folds
    return place[index]


@torch.no_grad()
def _left_out(ensemble: HawEnsemble, rows: list[Tensor], fold: Tensor) -> Tensor:
    """(S, n, 3) key points in mm of each row by the member whose training left it out."""
    size = max(1, MOST_ELEMENTS // (ensemble.members * max(ensemble.hidden)))
    found = []
    for part in torch.arange(len(fold)).split(size):
        each = ensemble.each(rows[0][part], rows[1][part])
        found.append(each[fold[part], torch.arange(len(part))])
    return torch.cat(found)
