"""What a model got wrong before a change, as a function of the actuation and its past.

Where recordings from before a change were made with another actuation, no paired difference can be
taken. What the model lacked before the change (damping, a swing, loops of its own) is still in the
residuals afterwards and resembles the effects of the list. It is learned from BEFORE, by a ridge
regression without physics on the actuation, its past, and products of the past with the present,
and is subtracted from the residuals of AFTER. The rows of its fit that a model keeps can take the
place of BEFORE: what is left has changed since the fit. The error on motions of BEFORE that were
left out of the regression replaces, in proportion, the model's validated error. Where nothing can
be learned, the penalty is large and nothing is subtracted.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch

from surgisoft.compiled import compiled
from surgisoft.diagnosis.history_features import Memory, memory_of
from surgisoft.diagnosis.residuals import (
    FOLDS,
    MOTION_ALIKE,
    ROWS,
    Problem,
    Reference,
    ResidualTable,
    agree,
    half_range,
    model_discrepancy,
    motion_states,
)
from surgisoft.diagnosis.statistics import cross_validated_ridge
from surgisoft.errors import InputError
from surgisoft.surrogate.arm import ArmSpec
from surgisoft.surrogate.history import pack
from surgisoft.surrogate.training_residuals import TrainingResiduals

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


@dataclass(frozen=True, eq=False)
class KnownRows:
    """R rows on which a model's error is known: of recordings from before, or of its fit."""

    inputs: np.ndarray
    """(R, F) what the error is learned from."""
    residual_mm: np.ndarray
    """(R, n, 3) measured less predicted, base frame, mm; NaN where missing."""
    block: np.ndarray
    """(R,) block of time in which the motion of the row came for the first time: 0, 1, ..."""
    pressure: np.ndarray
    """(R, m) actuation, scaled to [-1, 1] over the model's range."""
    direction: np.ndarray
    """(R, m) direction of change of the chambers."""


def rows_before(before: ResidualTable) -> KnownRows:
    """The rows of recordings from before a change."""
    rows = np.flatnonzero(np.isfinite(before.residual_mm).all(2).any(1))
    if not len(rows):
        raise InputError(
            f"{' + '.join(before.names)}: every key point is missing in every row, expected "
            "positions; give other recordings from before the change"
        )
    rows = rows[:: max(1, -(-len(rows) // KNOWN_ROWS))]
    state = motion_states(before.history, half_range(before.spec))
    return KnownRows(
        inputs=_inputs(before.memory, before.spec, rows),
        residual_mm=before.residual_mm[rows],
        block=_first_blocks(state, before.t_s, before.run, rows),
        pressure=before.scaled_pressure[rows],
        direction=before.direction[rows],
    )


def rows_of_fit(known: TrainingResiduals, spec: ArmSpec) -> KnownRows | None:
    """The rows that a model keeps of its fit; None where it does not keep what came before them."""
    past = known.past
    if past is None or not len(past.row):
        return None
    runs = torch.unique_consecutive(past.run, return_counts=True)[1].tolist()
    parts = [torch.split(each, runs) for each in (past.t_s, past.actuation)]
    nowhere = [torch.full((count, 1, 3), torch.nan) for count in runs]
    history = pack(list(parts[0]), list(parts[1]), nowhere)
    rows = past.row.numpy()
    half = half_range(spec)
    memory = memory_of(history, spec)
    return KnownRows(
        inputs=_inputs(memory, spec, rows),
        residual_mm=known.residual_mm.double().numpy(),
        block=_first_blocks(motion_states(history, half), past.t_s.numpy(), past.run.numpy(), rows),
        pressure=(known.actuation.double().numpy() - np.array(spec.low)) / half - 1.0,
        direction=known.direction.double().numpy(),
    )


def known_error(after: ResidualTable, known: KnownRows) -> KnownError:
    """Learn what a model gets wrong on rows from before, and predict it for AFTER."""
    asked = _inputs(after.memory, after.spec)
    # Beyond what BEFORE has shown nothing was learned.
    asked = np.clip(asked, known.inputs.min(axis=0), known.inputs.max(axis=0))
    block = known.block
    fold = np.random.default_rng(0).permutation(int(block.max()) + 1)[block] % FOLDS
    count = len(block)
    target = known.residual_mm.reshape(count, -1)
    nothing = np.full((len(asked), target.shape[1]), np.nan)
    found = cross_validated_ridge(
        np.concatenate([known.inputs, asked]),
        np.concatenate([target, nothing]),
        np.append(fold, np.full(len(asked), fold.max() + 1)),
        KNOWN_PENALTIES,
    ).predicted
    left = target - found[:count]
    ratio = float(np.sqrt(np.nansum(np.square(left)) / max(np.nansum(np.square(target)), 1e-30)))
    shape = known.residual_mm.shape[1:]
    some = slice(None, None, max(1, -(-count // ROWS)))
    return KnownError(
        correction_mm=found[count:].reshape(-1, *shape) if ratio < 1.0 else np.zeros(1),
        ratio=min(ratio, 1.0),
        reference=Reference(
            pressure=known.pressure[some],
            direction=known.direction[some],
            residual=(left if ratio < 1.0 else target)[some].reshape(-1, *shape),
        ),
    )


def _first_blocks(
    state: np.ndarray, t_s: np.ndarray, run: np.ndarray, rows: np.ndarray
) -> np.ndarray:
    """(R,) block of time in which the motion of each of R rows came for the first time.

    state: (N, k) motion of all rows (`motion_states`); t_s, run: (N,) their time and run. Where
    BEFORE repeats a motion, what is learned of the motion from its own repeats would be no test of
    what is known of the motions of AFTER. Rows with the same actuation and the same past
    (`residuals.MOTION_ALIKE`) are held out together.
    """
    first = rows[_first_alike(np.ascontiguousarray(state[rows]), MOTION_ALIKE)]
    part = run[first] * 1e6 + t_s[first] // KNOWN_BLOCK_S
    return np.unique(part, return_inverse=True)[1]


@compiled
def _first_alike(points, near):
    """(R,) for each row of points (R, k) the first one that differs from it by at most `near` in
    every column."""
    answer = np.arange(len(points))
    for row in range(len(points)):
        for other in range(row):
            if agree(points, row, other, near):
                answer[row] = other
                break
    return answer


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
