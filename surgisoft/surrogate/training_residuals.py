"""Training residuals: where a fitted model is known to be off.

The validated error states how large the model's error is; its residuals on a sample of the rows of
its fit state at which actuation. A later residual that differs from them at like actuation is no
error of the model: the arm or its setup has changed since (conditioning on known discrepancies,
Kennedy & O'Hagan 2001).
"""

from dataclasses import asdict, dataclass
from pathlib import Path

from safetensors.torch import load_file, save
from torch import Tensor

FILE = "known_error.safetensors"
"""Name of the file in a model's folder; it is part of the folder's format 1."""
ROWS = 1500
"""Largest number of rows that are stored."""


@dataclass(frozen=True, eq=False)
class TrainingResiduals:
    """Residuals of a model on rows of its fit."""

    actuation: Tensor
    """(S, m) actuation, in the arm's unit."""
    direction: Tensor
    """(S, m) direction of change."""
    residual_mm: Tensor
    """(S, n, 3) measured less predicted, mm, base frame; NaN where missing."""

    def save(self, folder: Path) -> None:
        """Write the residuals into a model's folder."""
        (folder / FILE).write_bytes(save(asdict(self)))

    @classmethod
    def load(cls, folder: Path) -> "TrainingResiduals | None":
        """The residuals in a model's folder; None where the folder has none."""
        if not (folder / FILE).is_file():
            return None
        known = cls(**load_file(folder / FILE))
        rows, points = known.actuation.shape[:1], known.residual_mm.shape[1:]
        fits = known.actuation.ndim == 2 and known.direction.shape == known.actuation.shape
        if not fits or known.residual_mm.shape != (*rows, *points) or points[1:] != (3,):
            raise ValueError("its arrays do not have the same rows")
        if not (known.actuation.isfinite().all() and known.direction.isfinite().all()):
            raise ValueError("its actuation is NaN or infinite")
        if known.residual_mm.isinf().any():
            raise ValueError("its residuals are infinite")
        return known
