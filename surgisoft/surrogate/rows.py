"""Rows of histories: what a static model sees in each, which are held out, and their error."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from surgisoft.surrogate.history import History
from surgisoft.surrogate.model import ArmModel, Trace

HOLD_BLOCKS = 20
"""Blocks that a single run is cut into where no validation recording is given."""


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


def measured_rows(history: History) -> Tensor:
    """(S,) rows, without padding, in which at least one key point was measured."""
    return history.rows((~history.key_points.isnan()).all(-1).any(-1))


@dataclass(frozen=True)
class Data:
    """What a model is fitted to and what judges it."""

    train: History
    """Histories to fit to."""
    valid: History | None
    """Histories that judge; None: the rows of `train` in `held` do."""
    held: Tensor | None
    """(R, T) rows of `train` that are held out; None with a validation history."""

    @classmethod
    def split(cls, train: History, valid: History | None, seed: int) -> "Data":
        """Judge by a validation history, or by held-out runs or blocks without one."""
        return cls(train, valid, hold_out(train, seed) if valid is None else None)

    @property
    def judge(self) -> History:
        """The history that the judging rows are part of."""
        return self.train if self.valid is None else self.valid

    def fitted_rows(self, model: ArmModel, trace: Trace | None = None) -> Rows:
        """The rows to fit to, as the model sees them."""
        rows = make_rows(model, self.train, trace)
        if self.held is None:
            return rows
        return rows.take(~self.train.rows(self.held)[measured_rows(self.train)])

    def judging_rows(self, model: ArmModel) -> Rows:
        """The rows that judge, as the model sees them."""
        if self.valid is not None:
            return make_rows(model, self.valid)
        held = self.train.rows(self.held)[measured_rows(self.train)]
        return make_rows(model, self.train).take(held)

    @property
    def targets(self) -> Tensor:
        """(R, T, n, 3) key points to fit to, mm; NaN where missing or held out."""
        if self.held is None:
            return self.train.key_points
        return torch.where(self.held[..., None, None], torch.nan, self.train.key_points)


def make_rows(
    model: ArmModel, history: History, trace: Trace | None = None, block_rows: int = 25
) -> Rows:
    """The measured rows of a history as the model sees them."""
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


def validated_error(target: Tensor, predicted: Tensor) -> dict:
    """Held-out error: RMSE of each key point's distance and of all, mm; and the number of rows."""
    square = (predicted - target).square().sum(-1)
    return {
        "rmse_mm": math.sqrt(float(square.nanmean())),
        "per_key_point_mm": [
            None if math.isnan(x) else math.sqrt(x) for x in square.nanmean(0).tolist()
        ],
        "rows": len(target),
    }


def normalise(network: nn.Module, history: History) -> None:
    """Set a network's output mean and scale (3n,) in mm from the measured key points."""
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
