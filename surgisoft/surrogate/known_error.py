"""Training residuals: where a fitted model is known to be off.

The validated error states how large the model's error is; its residuals on a sample of the rows of
its fit state at which actuation. A later residual that differs from them at like actuation is no
error of the model: the arm or its setup has changed since (conditioning on known discrepancies,
Kennedy & O'Hagan 2001).
"""

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from safetensors.torch import load_file, save
from torch import Tensor

from surgisoft.surrogate.history import History
from surgisoft.surrogate.model import ArmModel

FILE = "known_error.safetensors"
"""Name of the file in a model's folder."""
ROWS = 1500
"""Largest number of rows that are stored."""


@dataclass(frozen=True, eq=False)
class KnownError:
    """Residuals of a model on rows of its fit."""

    actuation: Tensor
    """(S, m) actuation, in the arm's unit."""
    direction: Tensor
    """(S, m) direction of change."""
    residual_mm: Tensor
    """(S, n, 3) measured less predicted, mm, base frame; NaN where missing."""

    @classmethod
    @torch.no_grad()
    def of(cls, model: ArmModel, histories: Iterable[History], rows: int = ROWS) -> "KnownError":
        """Residuals on at most `rows` measured rows of some histories, evenly thinned."""
        parts = []
        for history in histories:
            residual = history.rows(history.key_points - model.predict(history))
            seen = (~residual.isnan()).all(-1).any(-1)
            direction = history.rows(model.trace(history).direction)
            parts.append((history.rows(history.pressure)[seen], direction[seen], residual[seen]))
        whole = [torch.cat(part) for part in zip(*parts, strict=True)]
        step = max(1, -(-len(whole[0]) // rows))
        return cls(*(part[::step].float().contiguous() for part in whole))

    def save(self, folder: Path) -> None:
        """Write the residuals into a model's folder."""
        (folder / FILE).write_bytes(save(asdict(self)))

    @classmethod
    def load(cls, folder: Path) -> "KnownError | None":
        """The residuals in a model's folder; None where the folder has none."""
        if not (folder / FILE).is_file():
            return None
        return cls(**load_file(folder / FILE))
