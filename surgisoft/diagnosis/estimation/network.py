"""Re-tune the network's last layer behind the effects where that lowers the held-out error.

A network that was fitted without an effect has taken some of it for its own shape. The last layer
is linear, so its best change D is a ridge regression in the activations h of the layer before,

    min_D  sum_rows |r - h D|^2 + ridge rows var_range (h D),

whose second term holds the network's shape over its whole range of actuation, also where the
recordings do not go; a shift of everything is free. Residuals behind body and sensor effects are
taken for those of the network: what these effects turn or bend is small.

The ridge is the one with the least error on motion that is held out in turn, so that error says too
little about whether the new layer helps: the ridge was selected on it, and the effects in front of
the network were fitted to all of it. So the layer is judged once more, by a nested validation
(Varma & Simon 2006): each quarter of the time is left out of the fit of the effects, of the choice
of the ridge and of the layer, and the layer is kept only where it lowers the error over all four.
"""

import copy
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import stdtr
from torch import Tensor, nn

from surgisoft.diagnosis.estimation.effects import fitted_model
from surgisoft.diagnosis.estimation.nuisance import held_out_parts
from surgisoft.diagnosis.residuals import Problem
from surgisoft.diagnosis.statistics import block_interval, block_sums
from surgisoft.surrogate.model import ArmModel
from surgisoft.surrogate.networks import HawNN

RIDGES = 10.0 ** np.arange(-4.0, 2.1, 0.5)
"""Ridges that are tried."""
RANGE_ROWS = 4000
"""Random actuations over the range where the network is held."""
LEAST_GAIN = 0.05
"""Least fall of the held-out squared error that is worth a change, as a share of it."""
CHANCE = 0.025
"""Chance of so large a gain if there were none, one-sided."""
QUARTERS = 4
"""Stretches of time that are left out of effects and layer in turn; each is as long a part of the
training rows as the held-out rows are of a recording."""


@dataclass(frozen=True, eq=False)
class Retuned:
    """A network's last layer tried anew."""

    model: ArmModel
    """The model with the new layer, or the old one where that was not rewarded."""
    kept: bool
    """Whether the left-out quarters together reward the new layer."""
    gain: float
    """Fall of the squared error over the quarters that were left out of both fits, as a share of
    it; where the layer was rejected before they were looked at, over the parts that its ridge was
    chosen on."""


def retune(model: ArmModel, problem: Problem, effects: Iterable[str] = ()) -> Retuned:
    """Re-tune the last layer of a model's network on a problem's rows; the given one stays.

    effects: names of the model's effects that were fitted to these rows. They are fitted again
    without each left-out quarter, so that no step has seen it. Effects that are not named stay.
    """
    if not isinstance(model.network, HawNN):
        return Retuned(model, False, 0.0)
    problem = problem.with_model(model)
    tuned = best_layer(model, problem)
    if not tuned.kept:
        return tuned
    left: list[tuple[np.ndarray, np.ndarray]] = []
    for out in _quarters(problem):
        unseen = problem.without_blocks(~out)
        alone, both = _fitted_without(problem.without_blocks(out), tuple(effects))
        left.append((_squares(unseen.with_model(alone)), _squares(unseen.with_model(both))))
    before, after = (np.concatenate(sums) for sums in zip(*left, strict=True))
    kept = _falls(before, after)
    return Retuned(tuned.model if kept else model, kept, 1.0 - float(after.sum() / before.sum()))


def _quarters(problem: Problem) -> Iterator[np.ndarray]:
    """(B,) bool, one for each stretch of time: the blocks that belong to it."""
    count = len(problem.motion)
    for blocks in np.array_split(np.arange(count), min(QUARTERS, count)):
        yield np.isin(np.arange(count), blocks)


def _fitted_without(inside: Problem, effects: tuple[str, ...]) -> tuple[ArmModel, ArmModel]:
    """The models without and with a new layer that the rows of a problem lead to."""
    alone = fitted_model(inside, list(effects)) if effects else inside.model
    return alone, best_layer(alone, inside.with_model(alone)).model


def _squares(problem: Problem) -> np.ndarray:
    """(B,) sum of squared residuals of each block of time, mm^2."""
    return block_sums(np.nansum(np.square(problem.residual), axis=(1, 2)), problem.block)


def _falls(before: np.ndarray, after: np.ndarray) -> bool:
    """Whether sums of squares (B,) of blocks fall: the 95 % interval of the fall is above zero."""
    low, _ = block_interval(np.subtract, (before, after))
    return bool(low > 0)


@torch.no_grad()
def best_layer(model: ArmModel, problem: Problem) -> Retuned:
    """The layer that fits a problem best, kept where motion that is held out in turn rewards it.

    problem: with the residuals of the model.
    """
    network = model.network
    assert isinstance(network, HawNN)
    trace = model.trace(problem.history)
    hidden = _hidden(
        network,
        problem.rows(trace.behind["material"]),
        problem.rows(trace.direction),
    )
    count = len(hidden)
    anywhere = _hidden(network, *_over_range(model))
    held = np.cov(anywhere.T, bias=True)
    held += 1e-6 * np.trace(held) / len(held) * np.eye(len(held))
    residual = problem.residual.reshape(count, -1)
    part = held_out_parts(problem)
    found = _held_out(hidden, residual, part, held)
    best = int(np.argmin([np.square(left).sum() for left in found]))
    gain = _gain_by_block(residual, found[best], problem.block)
    total = float(np.nansum(np.square(residual)))
    share = float(gain.sum()) / max(total, 1e-30)
    with np.errstate(invalid="ignore", divide="ignore"):  # of gains that are all alike
        t = gain.mean() / (gain.std(ddof=1) / np.sqrt(len(gain)))
    chance = stdtr(len(gain) - 1, -t)  # one-sided (Student 1908)
    if not (share >= LEAST_GAIN and chance < CHANCE):
        return Retuned(model, False, share)
    change = torch.from_numpy(_ridge(hidden, residual, held, RIDGES[[best]])[0]).float()
    network = copy.deepcopy(network)
    last = network.layers[-1]
    assert isinstance(last, nn.Linear)
    last.weight.add_(change[:-1].T / network.scale[:, None])
    last.bias.add_(change[-1] / network.scale)
    fresh = model.replace(network=network).eval().requires_grad_(False)
    better = np.nansum(np.square(problem.with_model(fresh).residual)) < total
    return Retuned(fresh if better else model, bool(better), share)


def _hidden(network: HawNN, actuation: Tensor, direction: Tensor) -> np.ndarray:
    """(S, H + 1) activations before the last layer, and 1."""
    x = (actuation - network.centre) / network.half_range
    if network.directions:
        x = torch.cat([x, direction * network.use], dim=-1)
    hidden = network.layers[:-1](x).double().numpy()
    return np.concatenate([hidden, np.ones((len(hidden), 1))], axis=1)


def _over_range(model: ArmModel) -> tuple[Tensor, Tensor]:
    """Random actuations over the arm's range and random directions, (K, m) each."""
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor(model.spec.low), torch.tensor(model.spec.high)
    actuation = low + (high - low) * torch.rand(RANGE_ROWS, len(low), generator=generator)
    direction = torch.randint(0, 2, actuation.shape, generator=generator) * 2.0 - 1.0
    return actuation, direction


def _ridge(
    hidden: np.ndarray, residual: np.ndarray, held: np.ndarray, ridges: np.ndarray
) -> np.ndarray:
    """(R, H + 1, 3n) change of the layer for each ridge (R,); a row with a missing key point does
    not count for it, and the layer of one that is never seen does not change."""
    answer = np.zeros((len(ridges), hidden.shape[1], residual.shape[1]))
    known: dict[bytes, list[int]] = {}
    for k in range(residual.shape[1]):
        known.setdefault(np.isfinite(residual[:, k]).tobytes(), []).append(k)
    for columns in known.values():
        seen = np.isfinite(residual[:, columns[0]])
        if not seen.any():
            continue
        inside = hidden[seen]
        normal, right = inside.T @ inside, inside.T @ residual[seen][:, columns]
        for change, ridge in zip(answer, ridges, strict=True):
            change[:, columns] = np.linalg.solve(normal + ridge * held * seen.sum(), right)
    return answer


def _held_out(
    hidden: np.ndarray, residual: np.ndarray, part: np.ndarray, held: np.ndarray
) -> list[np.ndarray]:
    """For each ridge, (S, 3n) what is left of each row by the layer fitted without its part, mm."""
    found = [np.zeros_like(residual) for _ in RIDGES]
    for number in np.unique(part):
        rows = part == number
        changes = _ridge(hidden[~rows], residual[~rows], held, RIDGES)
        for left, change in zip(found, changes, strict=True):
            left[rows] = residual[rows] - hidden[rows] @ change
    return [np.nan_to_num(left) for left in found]


def _gain_by_block(before: np.ndarray, after: np.ndarray, block: np.ndarray) -> np.ndarray:
    """(B,) fall of the sum of squares of each block of time, mm^2."""
    gain = (np.square(np.nan_to_num(before)) - np.square(after)).sum(1)
    return np.bincount(block, weights=gain)
