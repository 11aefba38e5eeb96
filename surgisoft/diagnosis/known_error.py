"""What a model got wrong before a change, as a function of the actuation and its past.

Where recordings from before a change were made with another actuation, no paired difference can be
taken. What the model lacked before the change (damping, a swing, loops of its own) is still in the
residuals afterwards and resembles the effects of the list. It is learned from BEFORE, by a ridge
regression without physics on the actuation, its past, and products of the past with the present,
and is subtracted from the residuals of AFTER. Its error on motions of BEFORE that were left out of
its fit replaces, in proportion, the model's validated error. Where nothing can be learned, the
penalty is large and nothing is subtracted.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial import cKDTree

from surgisoft.diagnosis.history_features import Memory
from surgisoft.diagnosis.residuals import (
    FOLDS,
    MOTION_ALIKE,
    ROWS,
    Problem,
    Reference,
    ResidualTable,
    half_range,
    model_discrepancy,
    motion_states,
)
from surgisoft.diagnosis.statistics import cross_validated_ridge
from surgisoft.surrogate.arm import ArmSpec

KNOWN_ROWS = 6000
"""Most rows of BEFORE that its error is learned from; more are thinned evenly."""
KNOWN_BLOCK_S = 15.0
"""Length of the blocks of time of BEFORE that are held out together, s: three times those of an
identification, since slow memories connect neighbours."""
KNOWN_PENALTIES = (1e-3, 1e-2, 1e-1, 1.0, 10.0)
"""Ridge penalties that are tried, as shares of the number of rows; the last one leaves nothing."""


@dataclass(frozen=True, eq=False)
class KnownError:
    """The learned error of a model before a change."""

    correction_mm: np.ndarray
    """(N, n, 3) what the model is expected to get wrong in each row of AFTER, mm."""
    ratio: float
    """Held-out error on BEFORE with the correction over the one without, at most 1."""
    reference: Reference
    """What the correction leaves of BEFORE, each row by a fit that left its block out."""

    def problem_of(self, after: ResidualTable, rows: int = ROWS) -> Problem:
        """The identification problem of AFTER's training rows without what was known before."""
        measured = after.measured_mm - self.correction_mm
        points = after.history.key_points.clone()
        points[after.history.valid] = torch.from_numpy(measured).to(points.dtype)
        corrected = replace(
            after, measured_mm=measured, history=replace(after.history, key_points=points)
        )
        discrepancy = self.ratio * model_discrepancy(after.model, after.noise_mm)
        problem = corrected.training(rows)
        return replace(
            problem,
            discrepancy_mm=discrepancy,
            tolerance_mm=discrepancy,
            reference=self.reference,
        )


def known_error(after: ResidualTable, before: ResidualTable) -> KnownError:
    """Learn what a model gets wrong on BEFORE, and predict it for AFTER."""
    rows = np.flatnonzero(np.isfinite(before.residual_mm).all(2).any(1))
    rows = rows[:: max(1, -(-len(rows) // KNOWN_ROWS))]
    known, asked = _inputs(before.memory, before.spec, rows), _inputs(after.memory, after.spec)
    # Beyond what BEFORE has shown nothing was learned.
    asked = np.clip(asked, known.min(axis=0), known.max(axis=0))
    block = _first_blocks(before, rows)
    fold = np.random.default_rng(0).permutation(int(block.max()) + 1)[block] % FOLDS
    target = before.residual_mm[rows].reshape(len(rows), -1)
    nothing = np.full((len(asked), target.shape[1]), np.nan)
    found = cross_validated_ridge(
        np.concatenate([known, asked]),
        np.concatenate([target, nothing]),
        np.append(fold, np.full(len(asked), fold.max() + 1)),
        KNOWN_PENALTIES,
    ).predicted
    left = target - found[: len(rows)]
    ratio = float(np.sqrt(np.nansum(np.square(left)) / max(np.nansum(np.square(target)), 1e-30)))
    shape = before.residual_mm.shape[1:]
    some = slice(None, None, max(1, -(-len(rows) // ROWS)))
    return KnownError(
        correction_mm=found[len(rows) :].reshape(-1, *shape) if ratio < 1.0 else np.zeros(1),
        ratio=min(ratio, 1.0),
        reference=Reference(
            pressure=before.scaled_pressure[rows][some],
            direction=before.direction[rows][some],
            residual=(left if ratio < 1.0 else target)[some].reshape(-1, *shape),
        ),
    )


def _first_blocks(before: ResidualTable, rows: np.ndarray) -> np.ndarray:
    """(R,) block of time of BEFORE in which the motion of each of R rows came for the first time.

    Where BEFORE repeats a motion, what is learned of the motion from its own repeats would be no
    test of what is known of the motions of AFTER. Rows with the same actuation and the same past
    (`residuals.MOTION_ALIKE`) are held out together.
    """
    state = motion_states(before.history, half_range(before.spec))[rows]
    near = cKDTree(state).query_ball_point(state, MOTION_ALIKE, p=np.inf)
    first = rows[[min(some) for some in near]]
    part = before.run[first] * 1e6 + before.t_s[first] // KNOWN_BLOCK_S
    return np.unique(part, return_inverse=True)[1]


def _inputs(memory: Memory, spec: ArmSpec, rows: np.ndarray | slice = slice(None)) -> np.ndarray:
    """(N, F) actuation of N rows, its past, and their products with the actuation; of order 1.

    Neither time nor what comes once in a recording (the largest actuation so far) is among them: it
    would not come again.
    """
    half = half_range(spec)
    pressure, play, low_pass = (
        each[rows] for each in (memory.pressure, memory.play, memory.low_pass)
    )
    x = (pressure - np.array(spec.low)) / half - 1.0
    past = [play[..., k] - pressure for k in range(play.shape[-1])]
    past += [pressure - low_pass[..., k] for k in range(low_pass.shape[-1])]
    own = np.concatenate([x, memory.direction[rows], *(each / half for each in past)], axis=1)
    products = (own[:, :, None] * x[:, None, :]).reshape(len(x), -1)
    return np.concatenate([own, products], axis=1)
