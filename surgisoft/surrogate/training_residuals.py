"""Training residuals: where a fitted model is known to be off.

The validated error states how large the model's error is; its residuals on a sample of the rows of
its fit state at which actuation. A later residual that differs from them at like actuation is no
error of the model: the arm or its setup has changed since (conditioning on known discrepancies,
Kennedy & O'Hagan 2001).
"""

from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors.torch import load_file, save
from torch import Tensor

FILE = "known_error.safetensors"
"""Name of the file in a model's folder; it is part of the folder's format 1."""
ROWS = 1500
"""Largest number of rows that are stored."""
PAST_ROWS = 50_000
"""Largest number of rows of actuation that are stored: 1.2 MB for three chambers. Of more rows (40
minutes at 20 Hz) every second one is stored, or fewer, beside those of the residuals."""
PAST = "past_"
"""What the names of the arrays of `Past` begin with in the file."""


@dataclass(frozen=True, eq=False)
class Past:
    """Actuation of the runs of a fit over time, one run after another."""

    t_s: Tensor
    """(K,) time in the run's recording, s, ascending in each run."""
    actuation: Tensor
    """(K, m) actuation, in the arm's unit."""
    run: Tensor
    """(K,) number of the run, ascending."""
    row: Tensor
    """(S,) place of each row of the residuals among the K."""
    stood: Tensor | None = None
    """(R, m) where each run begins (`History.stood`), NaN where at rest; None for models that were
    fitted before it was kept."""

    def check(self, rows: int, chambers: int) -> None:
        """Raise ValueError unless it can be the past of S rows of m chambers."""
        count = len(self.t_s)
        shapes = self.t_s.shape, self.actuation.shape, self.run.shape, self.row.shape
        if shapes != ((count,), (count, chambers), (count,), (rows,)):
            raise ValueError("the actuation over time does not have the shapes of its rows")
        if not (self.t_s.isfinite().all() and self.actuation.isfinite().all()):
            raise ValueError("its actuation over time is NaN or infinite")
        same = self.run.diff() == 0
        if (self.run.diff() < 0).any() or (self.t_s.diff()[same] < 0).any():
            raise ValueError("its actuation over time is not in order")
        runs = len(torch.unique_consecutive(self.run))
        if self.stood is not None and self.stood.shape != (runs, chambers):
            raise ValueError("it does not say of each run where it begins")
        if rows and not 0 <= int(self.row.min()) <= int(self.row.max()) < count:
            raise ValueError("its rows are not among those of the actuation over time")


@dataclass(frozen=True, eq=False)
class TrainingResiduals:
    """Residuals of a model on rows of its fit."""

    actuation: Tensor
    """(S, m) actuation, in the arm's unit."""
    direction: Tensor
    """(S, m) direction of change."""
    residual_mm: Tensor
    """(S, n, 3) measured less predicted, mm, base frame; NaN where missing."""
    past: Past | None = None
    """The actuation before these rows; None for models that were fitted before it was kept."""

    def save(self, folder: Path) -> None:
        """Write the residuals into a model's folder."""
        arrays = {name: value for name, value in vars(self).items() if name != "past"}
        if self.past is not None:
            past = {name: value for name, value in vars(self.past).items() if value is not None}
            arrays |= {f"{PAST}{name}": value for name, value in past.items()}
        (folder / FILE).write_bytes(save(arrays))

    @classmethod
    def load(cls, folder: Path) -> "TrainingResiduals | None":
        """The residuals in a model's folder; None where the folder has none."""
        if not (folder / FILE).is_file():
            return None
        arrays = load_file(folder / FILE)
        past = {
            name.removeprefix(PAST): arrays.pop(name)
            for name in list(arrays)
            if name.startswith(PAST)
        }
        known = cls(**arrays, past=Past(**past) if past else None)
        rows, points = known.actuation.shape[:1], known.residual_mm.shape[1:]
        fits = known.actuation.ndim == 2 and known.direction.shape == known.actuation.shape
        if not fits or known.residual_mm.shape != (*rows, *points) or points[1:] != (3,):
            raise ValueError("its arrays do not have the same rows")
        if not (known.actuation.isfinite().all() and known.direction.isfinite().all()):
            raise ValueError("its actuation is NaN or infinite")
        if known.residual_mm.isinf().any():
            raise ValueError("its residuals are infinite")
        if known.past is not None:
            known.past.check(*known.actuation.shape)
        return known
