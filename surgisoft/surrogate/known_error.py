"""Where a network is known to be off: its residual on a sample of the rows that it was fitted to.

The validated error says how large the network's own error is; these rows say where it is which.
A later residual that differs from them at like actuation is no error of the network: something has
changed since (the conditioning of Kennedy & O'Hagan 2001 on what is known already).
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
"""Its name in a model's folder."""
ROWS = 1500
"""Most rows that are kept."""


@dataclass(frozen=True, eq=False)
class KnownError:
    """A model's residual on rows of its own fit."""

    actuation: Tensor
    """(S, m) actuation, in the arm's unit."""
    direction: Tensor
    """(S, m) direction of change."""
    residual_mm: Tensor
    """(S, n, 3) measured less predicted, mm, base frame; NaN where missing."""

    @classmethod
    @torch.no_grad()
    def of(cls, model: ArmModel, histories: Iterable[History], rows: int = ROWS) -> "KnownError":
        """At most `rows` measured rows of some histories, evenly thinned."""
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
        """Write it into a model's folder."""
        (folder / FILE).write_bytes(save(asdict(self)))

    @classmethod
    def load(cls, folder: Path) -> "KnownError | None":
        """What a model's folder says; None where it says nothing."""
        if not (folder / FILE).is_file():
            return None
        return cls(**load_file(folder / FILE))
