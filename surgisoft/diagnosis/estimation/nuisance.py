"""Model discrepancy as a nuisance: the network's own static error, projected out of a fit.

What a flexible function of actuation and direction explains at the size of the model's validated
error is no evidence for an effect (generalised least squares under the prior of `discrepancy`:
Kennedy & O'Hagan 2001). With features F of unit-normal weights, a residual r of one
key point has the precision

    W = I - F (F' F + ridge I)^-1 F',      ridge = (noise^2 + rows left^2) / validated^2,

left: RMS of what no effect explains, which hangs together over some rows; validated: RMS of the
model's own error.
"""

from dataclasses import dataclass

import numpy as np
from scipy import linalg
from scipy.sparse import csgraph

from surgisoft.diagnosis.cross_validation import static_features
from surgisoft.diagnosis.residuals import Problem

PERSISTENCE = 10.0
"""Rows over which what is left hangs together: so many fewer of them are independent."""
LEAST_RUNS = 3
"""Fewest runs that are left out as runs; of fewer, blocks of time are."""
ALIKE = 0.1
"""Largest difference of the actuation's mean and spread, in half ranges, of runs of one kind."""
MOST_PARTS = 5
"""Most parts that take turns in being left out."""


@dataclass(frozen=True, eq=False)
class Nuisance:
    """The weights W of each key point's residual."""

    features: np.ndarray
    """(S, F) features of actuation and direction."""
    seen: np.ndarray
    """(S, n) bool: which key points were measured."""
    factors: tuple
    """Cholesky factor of F' F + ridge I of each of the n key points."""

    @classmethod
    def of(cls, problem: Problem, residual: np.ndarray) -> "Nuisance":
        """The weights for a problem whose effects leave the residual (S, n, 3), mm."""
        seen = np.isfinite(residual).all(2)
        square = np.where(seen, np.square(residual).sum(-1), 0.0).sum(0) / np.maximum(
            seen.sum(0), 1
        )
        prior = np.maximum(problem.discrepancy_mm, 0.1 * problem.noise_mm) ** 2
        ridge = (problem.noise_mm**2 + PERSISTENCE * square) / prior
        features = static_features(problem.pressure, problem.direction)
        grams, factors = {}, []
        for k, mask in enumerate(seen.T):
            key = mask.tobytes()
            if key not in grams:
                grams[key] = features[mask].T @ features[mask]
            factors.append(linalg.cho_factor(grams[key] + ridge[k] * np.eye(features.shape[1])))
        return cls(features, seen, tuple(factors))

    def weighted(self, field: np.ndarray) -> np.ndarray:
        """(S, n, 3, ...) W times a field of that shape; zero where nothing was measured."""
        answer = np.empty_like(field)
        for k, factor in enumerate(self.factors):
            mask = self.seen[:, k]
            flat = np.where(mask[:, None], field[:, k].reshape(len(field), -1), 0.0)
            weights = linalg.cho_solve(factor, self.features.T @ flat, check_finite=False)
            flat = np.where(mask[:, None], flat - self.features @ weights, 0.0)
            answer[:, k] = flat.reshape(field[:, k].shape)
        return answer

    def held_out(self, residual: np.ndarray, block: np.ndarray) -> np.ndarray:
        """(S, n, 3) residual (S, n, 3) of each block less the static error by all other blocks.

        block: (S,) block of each row. What the fit to all rows leaves, W r, follows the block's own
        rows; without them it is (W_bb)^-1 (W r)_b (leave-one-out residuals; Cook & Weisberg 1982,
        sec. 2.2). Zero where nothing was measured.
        """
        answer = self.weighted(residual)
        for k, (factor, lower) in enumerate(self.factors):
            mask = self.seen[:, k]
            triangle = factor if lower else factor.T
            half = linalg.solve_triangular(
                triangle, self.features.T, lower=True, check_finite=False
            )
            for number in np.unique(block):
                rows = np.flatnonzero((block == number) & mask)
                own = np.eye(len(rows)) - half[:, rows].T @ half[:, rows]
                answer[rows, k] = linalg.solve(own, answer[rows, k], assume_a="pos")
        return answer

    def misfit(self, residual: np.ndarray) -> float:
        """r' W r of a residual (S, n, 3): its sum of squares without the static error, mm^2."""
        return float(
            (self.weighted(residual) * np.where(self.seen[..., None], residual, 0.0)).sum()
        )


def held_out_parts(problem: Problem) -> np.ndarray:
    """(S,) part of the rows that each row is held out with.

    A fit must predict motion of another kind, and kinds of motion come in runs; so the parts are
    kinds of runs where there are several, and folds of blocks otherwise. A repeated run is of the
    same kind.
    """
    _, run = np.unique(problem.history.run_of_row[problem.index].numpy(), return_inverse=True)
    if run.max() + 1 < LEAST_RUNS:
        return problem.fold[problem.block]
    kind = kinds(problem.pressure, run)
    return (kind[run] if kind.max() + 1 >= LEAST_RUNS else run) % MOST_PARTS


def kinds(pressure: np.ndarray, run: np.ndarray) -> np.ndarray:
    """(R,) number of the kind of each run, from the actuation (S, m) in -1 to 1 and runs (S,).

    Runs whose actuation has nearly the same mean and spread in every chamber are of one kind, and
    so are those that a chain of such runs joins.
    """
    rows = [pressure[run == number] for number in range(run.max() + 1)]
    looks = np.array([np.concatenate([part.mean(0), part.std(0)]) for part in rows])
    apart = np.abs(looks[:, None] - looks[None]).max(-1)
    return csgraph.connected_components(apart <= ALIKE)[1]
